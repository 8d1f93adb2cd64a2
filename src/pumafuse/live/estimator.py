"""The estimator that a program feeds event by event: :class:`LiveEstimator`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..arrays import NEVER, FloatArray
from ..errors import ConfigError, RunError, suggestion
from ..filter.outcome import ABSENT, FARTHEST, Outcome
from ..filter.window import MOST_ROWS, Counters, Window
from ..fusion.config import FusionConfig
from ..fusion.segments import LONGEST_TAIL_NS
from ..fusion.setup import live_model
from ..logs.clock import missing_commands, other_interval
from ..logs.frames import CARTESIAN, Cylindrical
from ..logs.run import Source
from ..model.arm import Validity
from ..units import Kind
from .clock import Clock, Time, Verdict, nanoseconds
from .frame_start import FrameStart
from .rate_limit import RateLimitedLog
from .results import AxisNow, Health, LiveEstimate, UpdateResult, health_of, no_estimate, update_result

_MOST_AXES = 62  # the core takes the axes of an event as bits
_FIRST, _MANY = 100, 1000  # commands whose interval is looked at, and those that missing ones are counted among
_MOST_ASIDE = 10_000  # events kept in case a clock was set anew
_FUSED, _INVALID, _UNKNOWN, _TOO_LATE = Outcome.FUSED, Outcome.INVALID, Outcome.UNKNOWN, Outcome.TOO_LATE


class _Event(NamedTuple):
    """What was given, to be fed again; without a sensor it is a command."""

    stamp: int
    sensor: str | None
    values: Mapping[str, Any]


class EventLog(Protocol):
    """Log of the events that a live estimator accepts."""

    def begin_segment(self) -> None:
        """Begin anew: what comes from here on is stamped by another clock."""
        ...

    def append(self, stamp: int, sensor: str | None, values: Mapping[str, Any], /) -> None:
        """Add an event, whose stamp [ns] is accepted; without a sensor it is a command; values in m."""
        ...

    def discard(self, after: int, /) -> None:
        """Remove the events stamped after ``after`` [ns]: that was wrong."""
        ...


class LiveEstimator:
    """The filter of :func:`pumafuse.fuse`, fed event by event as they arrive, in any order.

    What comes late, up to ``window``, is fused exactly as if it had come in time: once all events of a recorded run are
    in, the estimates are those of ``fuse``, bit for bit. Time is that of the stamps. One that is farther behind than
    the window is too late; a clock of the commands that was set anew restarts the filter.

    Positions are in m, in the stream's own coordinates; times are float seconds or int nanoseconds. Where several
    threads feed one estimator, they take turns by a lock of theirs.

    Attributes:
        config: As given.
        axes: The arm's, in their order.
        segment: How often the commands' clock was set anew.
    """

    def __init__(
        self,
        config: FusionConfig,
        *,
        window: float = 2.0,
        stale_after: float = 1.0,
        start: Mapping[str, float] | None = None,
        on_notice: Callable[[str], None] = lambda _: None,
        event_log: EventLog | None = None,
    ) -> None:
        """Make an estimator without any event.

        Args:
            config: Arm, noise, sensors, and the frame for sources in x, y, z.
            window: How late an event may be [s]; less than 1 s counts as 1 s.
            stale_after: For how long [s] an axis may go without a fused measurement until it is called stale.
            start: Level [m] of axes that do not rest at their first command before it; x and y with a frame.
            on_notice: Called with a sentence that a user should know: a clock set anew, and the like. Of what happens
                again and again it gets the first, the tenth, the hundredth …
            event_log: Receives the events that are accepted.

        Raises:
            PumafuseError: ``window`` or ``stale_after`` is not a time in reach, ``start`` is of no axis, or a model
                cannot be followed live.
        """
        if len(config.arm.axes) > _MOST_AXES:
            raise ConfigError(f"arm '{config.arm.name}': a stream is followed on at most {_MOST_AXES} axes")
        for name, value in {"window": window, "stale_after": stale_after}.items():
            if not 0.0 < _number(value) <= LONGEST_TAIL_NS / 1e9:
                raise ConfigError(f"{name}: must be more than 0 s and at most an hour, not {value!r:.40}")
        for name, value in (start or {}).items():
            if not abs(_number(value)) < FARTHEST:
                raise ConfigError(f"start: the level of {name} must be a finite position in m, not {value!r:.40}")
        self.config = config
        self.segment = 0
        self.axes = tuple(config.arm.axes)
        self._sensors = {name: number for number, name in enumerate(config.sensors)}
        self._bits = {name: number for number, name in enumerate(self.axes)}
        self._stale_ns = round(stale_after * 1e9)
        self._no_spread = [1.0] * len(self.axes)
        self._log, self._event_log = RateLimitedLog(on_notice), event_log
        self._refused: dict[str, dict[Outcome, int]] = {name: dict.fromkeys(Outcome, 0) for name in config.sensors}
        self._strangers = self._refusals = 0
        self._doubtful = 0  # commands that may have to be taken back
        self._commands = dict.fromkeys(Outcome, 0)
        self._answers: dict[bytes, UpdateResult] = {}
        self._aside: list[tuple[_Event, Outcome]] = []
        self._contradicting: dict[str, str] = {}  # sensors, and whom they contradict now
        self._knows_interval = False
        self._clock = Clock(round(window * 1e9))
        self._start, self._before = dict(start or {}), None
        self._begin(None)

    def command(self, t: Time, /, **axes: float) -> UpdateResult:
        """Add a command: the arm is to go to a position [m] on each of ``axes``.

        Args:
            t: When, float seconds or int nanoseconds.
            **axes: u [m] of each commanded axis; x, y and z with a frame.
        """
        return self._take(t, None, axes)

    def measurement(self, t: Time, sensor: str, /, **axes: float) -> UpdateResult:
        """Add a measurement of where the tool was.

        Args:
            t: Its stamp, float seconds or int nanoseconds; its latency is in the configuration.
            sensor: Its name there.
            **axes: z [m] of each axis it saw; x, y and z with a frame.
        """
        return self._take(t, str(sensor), axes)

    def estimate(self, at: Time | None = None) -> LiveEstimate:
        """Where the tool is.

        Args:
            at: In the past, within the window: filtered by all measurements valid until then that have come so far. In
                the future: predicted with the last command held. None: at the newest stamp (but not at one that a
                sensor alone has run ahead to).
        """
        return self._estimate(at, NEVER)

    def _estimate(self, at: Time | None, after: int) -> LiveEstimate:
        """The same by nothing that is stamped after ``after`` [ns]."""
        newest = self._clock.newest
        now = 0 if newest is None else self._clock.now
        try:
            stamp = now if at is None else nanoseconds(at)
        except ValueError as error:
            return no_estimate(0, _INVALID, str(error))
        origin = self._window.origin
        if origin is None or newest is None:
            return no_estimate(stamp, Outcome.BEFORE_START, "no command yet")
        if stamp < origin:
            return no_estimate(stamp, Outcome.BEFORE_START, "before the first command")
        if stamp < self._oldest():
            return no_estimate(stamp, _TOO_LATE, f"{(newest - stamp) / 1e9:.3f} s ago, before the window")
        if stamp > newest + LONGEST_TAIL_NS:
            return no_estimate(stamp, _INVALID, "more than an hour ahead")
        axes: dict[str, AxisNow] = {}
        stale: list[str] = []
        for axis, found in zip(self.axes, self._window.estimate(stamp, after), strict=True):
            if found is not None:
                outputs, fused = found
                axes[axis] = AxisNow(*outputs)
                if stamp - fused > self._stale_ns:
                    stale.append(axis)
        reason = "now" if stamp == now else "filtered" if stamp < now else "predicted, the last command held"
        placed = None
        if self._frame_start.placed is not None:
            placed = self._frame_start.in_log({axis: now.position for axis, now in axes.items()})
        return LiveEstimate(stamp, axes, placed, tuple(stale), _FUSED, reason)

    @property
    def newest(self) -> int | None:
        """The newest stamp that is believed, int ns; None before any event."""
        return self._clock.newest

    @property
    def sure(self) -> int | None:
        """The newest stamp that nothing will take back, int ns: behind ``newest`` just after a jump ahead."""
        return None if self._clock.newest is None else self._clock.sure

    @property
    def origin(self) -> int | None:
        """The first command's stamp (of this segment), int ns; None before it."""
        return self._window.origin

    def estimate_as_live(self, stamp: int) -> LiveEstimate:
        """The estimate for an instant [ns] in the window by nothing that is stamped later, as if that had not come."""
        return self._estimate(stamp, stamp)

    def until(self, t: Time, sensor: str | None = None) -> int | None:
        """Up to which instant [ns] a clock may go on before an event stamped ``t`` comes in; None before the first one.

        To the event's own time if its stamp is plainly right, or shows that a jump ahead was; else no farther than it
        is.
        """
        try:
            stamp = nanoseconds(t)
        except ValueError:
            return self.sure
        known = sensor is None or sensor in self._sensors
        right = self._clock.low <= stamp <= self._clock.high or (known and self._clock.ends_doubt(stamp, sensor))
        return stamp if right else self.sure

    def health(self, at: Time | None = None) -> Health:
        """How each sensor does, and what became of everything so far.

        Args:
            at: Until when a sensor that is silent has been so; None: until the newest stamp.

        Raises:
            ValueError: ``at`` is no time.
        """
        newest = None if self._clock.newest is None else max(self._clock.now, nanoseconds(at or 0))
        return health_of(
            self._window.counters(),
            self._refused,
            self._commands,
            self._strangers,
            self.segment,
            newest,
            self._stale_ns,
        )

    def _begin(self, counters: Counters | None) -> None:
        """An empty window, with what was counted before."""
        self._before = counters
        self._frame_start = FrameStart(self.config.frame, self.axes)
        self._window = Window(live_model(self.config, self._frame_start.start(self._start)), counters)
        self._recent: list[_Event] = []  # commands that are still to be looked at
        # A frame that waits is placed by the first command; one that comes later, but was given before it, moves it.
        # With each goes its outcome, and whether it never came into the window.
        self._early: list[tuple[_Event, Outcome, bool]] | None = [] if self._frame_start.waits else None

    def _oldest(self) -> int:
        """No event stamped before is taken [ns]."""
        return max(self._clock.sure - self._clock.window, self._window.port.floor)

    def _take(self, t: Time, sensor: str | None, values: Mapping[str, Any]) -> UpdateResult:
        """Put an event where its stamp says, if that can be."""
        try:
            stamp = nanoseconds(t)
        except ValueError as error:
            return self._refuse(sensor, values, _INVALID, str(error))
        if sensor is not None and sensor not in self._sensors:
            return self._refuse(sensor, values, _UNKNOWN, f"unknown sensor; {suggestion(sensor, self._sensors)}")
        clock = self._clock
        if not clock.low <= stamp <= clock.high:
            refused = self._judged(_Event(stamp, sensor, values))
            if refused is not None:
                return refused
        elif clock.newest is not None and stamp > clock.newest:
            clock.settle(stamp)
        if sensor is None and self._aside:
            clock.confirm()
            self._aside = []
        if self._event_log is not None:
            self._event_log.append(stamp, sensor, values)
        if self._early is not None:
            return self._take_early(_Event(stamp, sensor, dict(values)))
        return self._feed(stamp, sensor, values)

    def _judged(self, event: _Event) -> UpdateResult | None:
        """What becomes of an event whose stamp is not plainly right; None if it is to be taken."""
        clock, (stamp, sensor, values) = self._clock, event
        newest, command = clock.newest, sensor is None
        if newest is None or (self._window.origin is None and (command or stamp > newest)):
            if newest is not None and command:
                self._begin(self._window.counters())  # the commands' clock counts: what came before is of another
                if self._event_log is not None:
                    self._event_log.begin_segment()
            clock.start(stamp)
            return None
        verdict = clock.judge(stamp, sensor)
        while verdict is Verdict.CONTRADICTED:
            self._window.forget(clock.bound)
            if self._event_log is not None:
                self._event_log.discard(clock.bound)
            self._commands[_FUSED] -= self._doubtful
            self._commands[_INVALID] += self._doubtful
            self._doubtful = 0
            who = "a command" if clock.ahead_of is None else f"sensor '{clock.ahead_of}'"
            ahead = (newest - stamp) / 1e9
            self._log.write(
                who, f"{who} ran {ahead:.3f} s ahead of the others: taken back; are all stamps of one clock?"
            )
            if clock.low <= stamp <= clock.high:
                clock.settle(max(stamp, clock.sure))
                return None
            verdict = clock.judge(stamp, sensor)
        if not clock.doubtful:
            self._doubtful = 0
        if verdict is Verdict.ACCEPTED:
            return None
        if verdict is Verdict.RESET:
            return self._start_anew(event, newest)
        outcome = _TOO_LATE if verdict is Verdict.BEHIND else _INVALID
        if len(clock.other) == 1 and command:
            self._aside = []
        if clock.other and len(self._aside) < _MOST_ASIDE:
            self._aside.append((event._replace(values=dict(values)), outcome))
        if verdict is Verdict.AHEAD:
            return self._refuse(sensor, values, outcome, f"stamped {(stamp - newest) / 1e9:.0f} s ahead of all others")
        if outcome == _TOO_LATE:
            return self._refuse_late(stamp, sensor, values)
        return self._refuse(sensor, values, outcome, self._behind(stamp))

    def _behind(self, stamp: int) -> str:
        """Why a stamp is too late."""
        if stamp >= self._clock.sure - self._clock.window:
            return f"more than {MOST_ROWS} events came since: the window holds no more"
        late = (self._clock.sure - stamp) / 1e9
        return f"stamped {late:.3f} s behind the newest; the window is {self._clock.window / 1e9:g} s"

    def _start_anew(self, event: _Event, newest: int) -> UpdateResult:
        """A new segment from the events that have shown the commands' clock to be another."""
        aside, self._aside = self._aside, []
        first = next(other.stamp for other, _ in aside if other.sensor is None)
        for (_, sensor, values), outcome in aside:
            self._count(sensor, values, outcome, -1)
        self.segment += 1
        way = "back" if first < newest else "ahead"
        moved = f"{way} by {abs(newest - first) / 1e9:.3f} s"
        self._log.write("clock", f"the commands' clock was set {moved}: new segment, filter restarted")
        self._start = {}
        self._begin(self._window.counters())
        if self._event_log is not None:
            self._event_log.begin_segment()
        self._clock.start(first)
        for other, _ in aside:
            self._take(*other)
        return self._take(*event)

    def _take_early(self, event: _Event) -> UpdateResult:
        """Take an event while the frame's place may still change; a command before all others moves it."""
        assert self._early is not None
        oldest, origin, since = self._oldest(), self._window.origin, self._frame_start.since
        if origin is not None and self._clock.sure - origin > self._clock.window:
            self._early = None
            return self._feed(*event)
        x, y = (_number(event.values.get(name)) for name in ("x", "y"))
        if event.sensor is None and math.isfinite(x + y) and (since is None or event.stamp < since):
            frame_start = FrameStart(self.config.frame, self.axes)
            try:
                frame_start.place(event.stamp, x, y)
            except RunError as error:
                return self._refuse(None, event.values, _INVALID, str(error))
            events = [one for one, _, _ in self._early if one.stamp >= oldest]
            for (_, sensor, values), outcome, refused in self._early:
                if sensor is None or refused:
                    self._count(sensor, values, outcome, -1)
            self._begin(self._before)
            self._frame_start = frame_start
            for one in events:
                self._feed_early(one)
        return self._feed_early(event)

    def _feed_early(self, event: _Event) -> UpdateResult:
        """Feed an event, and keep it for when the frame's place changes."""
        assert self._early is not None
        before = self._refusals
        result = self._feed(*event)
        if len(self._early) >= _MOST_ASIDE:
            del self._early[: _MOST_ASIDE // 2]
        self._early.append((event, result.outcome, self._refusals > before))
        return result

    def _feed(self, stamp: int, sensor: str | None, values: Mapping[str, Any]) -> UpdateResult:
        """Give an event that is in time to the window."""
        window, given, stranger = self._window, 0, ""
        new = window.value
        for name, value in values.items():
            axis = self._bits.get(name)
            if axis is None:
                stranger = name
                continue
            new[axis] = value if type(value) is float else _number(value)
            given |= 1 << axis
        if stranger and self.config.frame is not None:
            given |= self._turned(stamp, sensor, values)
            stranger = next((name for name in values if name not in self._bits and name not in CARTESIAN), "")
        oldest = self._oldest()
        if stamp < oldest:
            return self._refuse_late(stamp, sensor, values)
        if not given:
            missing = not stranger and len(values) > 0
            why = "no command has shown yet where x and y are in the arm's axes" if missing else self._no_axis(stranger)
            return self._refuse(sensor, values, Outcome.BEFORE_START if missing else _UNKNOWN, why)
        if sensor is None:
            taken = window.add_command(stamp, given, oldest)
        else:
            taken = window.add_measurement(stamp, self._sensors[sensor], given, self._clock.sure, oldest)
        if self.config.frame is not None:
            window.spread[:] = self._no_spread
        if not taken:
            return self._refuse_late(stamp, sensor, values)
        codes = bytes(window.outcome)
        result = self._answers.get(codes) if not stranger else None
        result = result or self._answer(codes, stranger)
        if sensor is None:
            self._commands[result.outcome] += 1
            self._doubtful += self._clock.doubtful and result.outcome is _FUSED
            self._watch_limits()
            if result.outcome is _FUSED:
                self._recent.append(_Event(stamp, None, values))
                self._watch_commands()
        elif window.port.contradicts >= 0:
            self._say_contradiction(stamp, sensor)
        elif sensor in self._contradicting and result.outcome is _FUSED:
            del self._contradicting[sensor]
        return result

    def _watch_limits(self) -> None:
        """Say when a command leaves what the arm model is valid for."""
        validity = self.config.arm.validity
        if validity == Validity():
            return
        latest = {axis: found for axis, found in zip(self.axes, self._window.commands(), strict=True) if found}
        if not latest:
            return
        stamp = max(stamp for stamp, _, _ in latest.values())
        speed: dict[Kind, float] = {}
        for axis, (_, _, step) in latest.items():
            kind = self.config.arm.axes[axis].kind
            speed[kind] = max(speed.get(kind, 0.0), abs(step) / self.config.arm.update_period)
        radius = latest["radial"][1] if isinstance(self.config.frame, Cylindrical) and "radial" in latest else None
        for passed in validity.excess(speed, radius):
            self._log.write(passed.split(" reach")[0], f"{passed}, at {stamp / 1e9:.3f} s")

    def _watch_commands(self) -> None:
        """Say if commands come at another interval than the arm's update period, and if many of them are missing."""
        recent = self._recent
        if len(recent) == _FIRST and not self._knows_interval:
            self._knows_interval = True
            stamps = np.sort(np.array([one.stamp for one in recent]))
            if (other := other_interval(stamps, self.config.arm.update_period)) is not None:
                sentence, kind = other
                where = " A stream has t in s, or t_ns in ns" if kind == "unit" else ""
                self._log.write("interval of commands", sentence + where)
        if len(recent) < _MANY:
            return
        self._recent = []
        recent.sort(key=lambda one: one.stamp)
        table = {axis: np.array([_number(one.values.get(axis)) for one in recent]) for axis in recent[0].values}
        steady = {axis: values for axis, values in table.items() if np.isfinite(values).all()}
        source = Source(np.array([one.stamp for one in recent]), steady, "commands")
        if steady and (missing := missing_commands(source)) is not None:
            self._log.write("missing commands", f"until {recent[-1].stamp / 1e9:.3f} s {missing}; send every command")

    def _turned(self, stamp: int, sensor: str | None, values: Mapping[str, Any]) -> int:
        """Put an event's x, y and z into the window's ``value`` and ``spread`` as axes; which ones, as bits."""
        window, given = self._window, 0
        placed = self._frame_start.in_axes(
            {name: _number(values[name]) for name in CARTESIAN if name in values},
            None if sensor is None else self._commanded("tangential", stamp),
        )
        for name, component in placed.items():
            axis = self._bits[name]
            window.value[axis], window.spread[axis] = component
            given |= 1 << axis
        return given

    def _commanded(self, axis: str, stamp: int) -> FloatArray:
        """The position [m] commanded on an axis at ``stamp`` [ns], as far as is known, (1,)."""
        found = self._window.commands(stamp)[self._bits[axis]] if axis in self._bits else None
        return np.array([0.0 if found is None else found[1]])

    def _say_contradiction(self, stamp: int, sensor: str) -> None:
        """Say which other sensor one contradicts, by how much, and since when."""
        window = self._window
        other = tuple(self._sensors)[window.port.contradicts]
        if self._contradicting.get(sensor) == other:
            return
        self._contradicting[sensor] = other
        found = list(zip(self.axes, window.outcome, window.innovation, strict=True))
        screens = {axis: self.config.arm.screen_of(axis) for axis, _, _ in found}
        off = ", ".join(
            f"{axis} by {nu * screens[axis].scale:+.4g} {screens[axis].unit}"
            for axis, outcome, nu in found
            if outcome == Outcome.REJECTED
        )
        self._log.write(
            f"{sensor} contradicts {other}",
            f"sensor '{sensor}' contradicts '{other}' since {stamp / 1e9:.3f} s ({off}): its measurements are rejected",
        )

    def _no_axis(self, stranger: str) -> str:
        """Why what an event gives under a name is of no axis."""
        if stranger in CARTESIAN and self.config.frame is None:
            return f"'{stranger}' needs a [frame] in fusion.toml; {suggestion(stranger, self.axes)}"
        return f"unknown axis '{stranger:.40}'; {suggestion(stranger, self.axes)}" if stranger else "gives no axis"

    def _answer(self, codes: bytes, stranger: str) -> UpdateResult:
        """The result of an event by the codes of its axes; the same object for equal codes, but for unknown names."""
        outcomes = {axis: Outcome(code) for axis, code in zip(self.axes, codes, strict=True) if code != ABSENT}
        result = update_result(outcomes)
        if stranger:
            axes = MappingProxyType({**outcomes, stranger: _UNKNOWN})
            return result._replace(axes=axes, reason=f"{result.reason}; {self._no_axis(stranger)}")
        return self._answers.setdefault(codes, result)

    def _refuse_late(self, stamp: int, sensor: str | None, values: Mapping[str, Any]) -> UpdateResult:
        """Count an event that is behind the window; how late it is shows which window it would take."""
        if sensor is not None:
            self._window.count_late(self._sensors[sensor], stamp, self._clock.now)
        return self._refuse(sensor, values, _TOO_LATE, self._behind(stamp))

    def _refuse(self, sensor: str | None, values: Mapping[str, Any], outcome: Outcome, reason: str) -> UpdateResult:
        """Count an event that never comes into the window."""
        self._refusals += 1
        self._count(sensor, values, outcome, 1)
        return UpdateResult(outcome, MappingProxyType(dict.fromkeys(values, outcome)), reason)

    def _count(self, sensor: str | None, values: Mapping[str, Any], outcome: Outcome, times: int) -> None:
        """Count an event's outcome, a measurement's for each of its components; ``times`` −1 takes it back."""
        if sensor is None:
            self._commands[outcome] += times
        elif sensor in self._refused:
            self._refused[sensor][outcome] += times * len(values)
            if outcome == _TOO_LATE and times < 0:
                self._window.uncount_late(self._sensors[sensor])
        else:
            self._strangers += times


def _number(value: object) -> float:
    """A number as it is; NaN for what is none."""
    if isinstance(value, str | bytes | bool):
        return math.nan
    try:
        return float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        return math.nan
