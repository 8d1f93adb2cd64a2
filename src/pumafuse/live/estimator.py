"""The estimator that a program feeds event by event: :class:`LiveEstimator`."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple, SupportsFloat, TypeAlias

import numpy as np

from ..arrays import REACH_NS, FloatArray
from ..errors import ConfigError, UnknownNameError, suggestion
from ..fusion.config import FusionConfig
from ..fusion.timeline import LONGEST_TAIL_NS, Outcome
from ..model.arm import ordered_axes
from ..runs.axes import placed_at
from ..runs.frames import CARTESIAN, Rotated
from .clock import Clock, Verdict
from .command_kernels import COMMANDS, STAMP, U
from .health import Health, health_of
from .kernels import ABSENT, SPREAD, VALUE, Tally
from .window import Window

Time: TypeAlias = float | int  # float seconds, or int nanoseconds
_MOST_ASIDE = 10_000  # events kept in case a clock was set anew
_FUSED, _INVALID, _UNKNOWN, _TOO_LATE = Outcome.FUSED, Outcome.INVALID, Outcome.UNKNOWN, Outcome.TOO_LATE
_BEST = (_FUSED, Outcome.REOPENED, Outcome.GATED, *(outcome for outcome in Outcome if outcome > Outcome.REOPENED))
_REASONS: Mapping[Outcome, str] = {
    Outcome.FUSED: "taken",
    Outcome.GATED: "farther from its prediction than the sensor's gate allows",
    Outcome.REOPENED: "the gate was reopened after many rejections in a row: the offset was widened, the reading taken",
    Outcome.DUPLICATE: "said before: the same stamp and values, or a command repeated within half a period",
    Outcome.BEFORE_START: "valid before the first command",
    Outcome.TOO_LATE: "stamped before the window",
    Outcome.INVALID: "not a finite position",
    Outcome.UNKNOWN: "no such sensor or axis",
}


class Told(NamedTuple):
    """What became of an event.

    Attributes:
        outcome: Of the event: of its axes the best, ``fused`` before ``reopened`` before ``gated`` and so on. A command
            that is taken is ``fused``, too.
        axes: Of each axis that it gives.
        reason: In words.
    """

    outcome: Outcome
    axes: Mapping[str, Outcome]
    reason: str


class AxisNow(NamedTuple):
    """One axis at one instant; SI units.

    Attributes:
        position: [m], in the stream's own coordinates.
        position_sd: [m].
        velocity: The model's drift [m/s].
        velocity_sd: [m/s].
        offset: How far the arm is from its model [m].
        offset_sd: [m].
    """

    position: float
    position_sd: float
    velocity: float
    velocity_sd: float
    offset: float
    offset_sd: float


@dataclass(frozen=True, slots=True)
class LiveEstimate:
    """Where the tool is, was, or will be; ``est["radial"]`` is one axis.

    Attributes:
        stamp: At which instant, int ns.
        axes: Every axis that has been commanded.
        cartesian: With a frame, x, y and z [m] as far as the axes give them.
        stale: Axes on which no reading was fused for longer than the limit.
        outcome: ``fused``; ``before_start`` or ``too_late`` where there is no estimate; ``invalid`` where there is none
            that far ahead.
        reason: In words.
    """

    stamp: int
    axes: Mapping[str, AxisNow]
    cartesian: Mapping[str, float] | None
    stale: tuple[str, ...]
    outcome: Outcome
    reason: str

    @property
    def time(self) -> float:
        """The instant in s."""
        return self.stamp / 1e9

    def __getitem__(self, axis: str) -> AxisNow:
        """The estimate of one axis.

        Raises:
            UnknownNameError: There is none; says why.
        """
        if axis not in self.axes:
            raise UnknownNameError(f"estimate at {self.time:.3f} s ({self.reason})", "axis", axis, self.axes)
        return self.axes[axis]


class _Event(NamedTuple):
    """What was given, to be fed again; ``sensor`` is empty for a command."""

    stamp: int
    sensor: str
    values: Mapping[str, SupportsFloat]


class LiveEstimator:
    """The filter of :func:`pumafuse.fuse`, fed event by event as they arrive, in any order.

    What comes late, up to ``window``, is fused exactly as if it had come in time: once all events of a recorded run are
    in, the estimates are those of ``fuse``, bit for bit. Time is that of the stamps; a stamp that steps back by more
    than the window is too late, and a clock of the commands that was set anew restarts the filter.

    Positions are in m, in the stream's own coordinates; times are float seconds or int nanoseconds.
    """

    def __init__(
        self,
        config: FusionConfig,
        *,
        window: float = 2.0,
        stale_after: float = 1.0,
        start: Mapping[str, float] | None = None,
        on_notice: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Nothing heard yet.

        Args:
            config: Arm, noise, sensors, and the frame for sources in x, y, z.
            window: How late an event may be [s].
            stale_after: For how long [s] an axis may go without a fused reading until it is called stale.
            start: Level [m] of axes that do not rest at their first command before it; x and y with a frame.
            on_notice: Is told in one sentence what a user should know: a clock set anew, and the like.

        Raises:
            PumafuseError: ``window`` or ``stale_after`` is not a time in reach, ``start`` is of no axis, or a model
                cannot be followed live.
        """
        for name, value in {"window": window, "stale_after": stale_after}.items():
            if not 0.0 < value <= LONGEST_TAIL_NS / 1e9:
                raise ConfigError(f"{name}: must be more than 0 s and at most an hour, not {value}")
        self.config = config
        self.segment = 0
        self.axes = ordered_axes(set(config.arm.axes))
        self._sensors = {name: number for number, name in enumerate(config.sensors)}
        self._bits = {name: number for number, name in enumerate(self.axes)}
        self._stale_ns = round(stale_after * 1e9)
        self._longest_latency = round(max([0.0, *(sensor.latency for sensor in config.sensors.values())]) * 1e9)
        self._notice = on_notice
        self._refused: dict[str, dict[Outcome, int]] = {name: dict.fromkeys(Outcome, 0) for name in config.sensors}
        self._strangers = 0
        self._commands = dict.fromkeys(Outcome, 0)
        self._answers: dict[tuple[bytes, str], Told] = {}
        self._aside: list[_Event] = []
        self._clock = Clock(round(window * 1e9))
        self._start = dict(start or {})
        self._begin(None)

    def command(self, t: Time, /, **axes: float) -> Told:
        """The arm is told to go to a position [m] on each of ``axes``.

        Args:
            t: When, float seconds or int nanoseconds.
            **axes: u [m] of each commanded axis; x, y and z with a frame.
        """
        told = self._take(t, "", axes)
        self._commands[told.outcome] += 1
        return told

    def reading(self, t: Time, sensor: str, /, **axes: float) -> Told:
        """A sensor says where the tool was.

        Args:
            t: Its stamp, float seconds or int nanoseconds; its latency is in the configuration.
            sensor: Its name there.
            **axes: z [m] of each axis it saw; x, y and z with a frame.
        """
        return self._take(t, sensor, axes)

    def estimate(self, at: Time | None = None) -> LiveEstimate:
        """Where the tool is.

        Args:
            at: In the past, within the window: filtered by all readings valid until then that have come so far. In
                the future: predicted with the last command held. None: at the newest stamp.
        """
        newest = self._clock.newest
        try:
            stamp = (0 if newest is None else newest) if at is None else nanoseconds(at)
        except (ValueError, OverflowError, TypeError):
            return _nowhere(0, _INVALID, f"no time: {at!r}")
        origin = self._window.origin
        if origin is None or newest is None:
            return _nowhere(stamp, Outcome.BEFORE_START, "no command yet")
        if stamp < origin:
            return _nowhere(stamp, Outcome.BEFORE_START, "before the first command")
        if stamp < self._oldest():
            return _nowhere(stamp, _TOO_LATE, f"{(newest - stamp) / 1e9:.3f} s ago, before the window")
        if stamp > newest + LONGEST_TAIL_NS:
            return _nowhere(stamp, _INVALID, "more than an hour ahead")
        outputs, memory = self._window.estimate(stamp, self._oldest()), self._window.memory
        position = outputs.position[:, 0] + memory.commands.level[:, 0]
        known = memory.commands.number[:, COMMANDS].tolist()
        columns = (position.tolist(), *(part[:, 0].tolist() for part in outputs[1:]))
        rows = zip(self.axes, known, zip(*columns, strict=True), strict=True)
        axes = {axis: AxisNow(*row) for axis, commanded, row in rows if commanded}
        fused = memory.heard.fused.tolist()
        stale = tuple(
            axis
            for axis, since in zip(self.axes, fused, strict=True)
            if axis in axes and stamp - since > self._stale_ns
        )
        reason = "now" if stamp == newest else "filtered" if stamp < newest else "predicted, the last command held"
        return LiveEstimate(stamp, axes, self._to_log(axes), stale, _FUSED, reason)

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

    def until(self, t: Time) -> int | None:
        """Up to which instant [ns] a clock may go on before an event stamped ``t`` comes in; None before the first one.

        To the event's own time if its stamp is plainly right, else no farther than it is.
        """
        try:
            stamp = nanoseconds(t)
        except (ValueError, OverflowError, TypeError):
            return self._clock.newest
        return stamp if self._clock.low <= stamp <= self._clock.high else self._clock.newest

    def health(self) -> Health:
        """How each sensor does, and what became of everything so far."""
        return health_of(
            self._window.tally(),
            self._refused,
            self._commands,
            self._strangers,
            self.segment,
            self._clock.newest,
            self._stale_ns,
        )

    def _begin(self, tally: Tally | None) -> None:
        """An empty window, with what was counted before."""
        frame, start = self.config.frame, self._start
        known = {name: level for name, level in start.items() if name in self._bits}
        self._placed = placed_at(frame, 0.0, 0.0, "") if isinstance(frame, Rotated) else None
        self._placed_since = 0
        self._last_tangential = 0.0
        others = set(start) - set(known)
        if others and (frame is None or not others <= set(CARTESIAN) or ("x" in others) != ("y" in others)):
            raise UnknownNameError("start", "axis", sorted(others)[0], self.axes)
        if frame is not None and "x" in others:
            self._placed = self._placed or placed_at(frame, start["x"], start["y"], "start")
            tangential, radial, _ = self._placed.to_axes(np.array([start["x"]]), np.array([start["y"]]))
            known |= {"tangential": float(tangential[0]), "radial": float(radial[0])}
        if "z" in others:
            known["vertical"] = start["z"]
        self._window = Window(self.config, self.axes, known, tally)
        self._new, self._told = self._window.memory.heard.new[:, VALUE], self._window.memory.heard.told
        # A frame about the base is placed by the first command; one that comes late, but was given before, moves it.
        self._early: list[_Event] | None = [] if frame is not None and self._placed is None else None

    def _oldest(self) -> int:
        """No event stamped before is taken [ns]."""
        return max(self._clock.sure - self._clock.window, self._window.floor)

    def _take(self, t: Time, sensor: str, values: Mapping[str, SupportsFloat]) -> Told:
        """Put an event where its stamp says, if that can be."""
        try:
            stamp = nanoseconds(t)
        except (ValueError, OverflowError, TypeError):
            return self._refuse(sensor, values, _INVALID, f"no time: {t!r:.40}")
        clock = self._clock
        if not clock.low <= stamp <= clock.high:
            refused = self._judged(stamp, sensor, values)
            if refused is not None:
                return refused
        elif clock.newest is not None and stamp > clock.newest:
            clock.advance(stamp)
        if self._aside and not sensor:
            clock.here()
            self._aside = []
        if self._early is not None:
            return self._take_early(_Event(stamp, sensor, values))
        return self._feed(stamp, sensor, values)

    def _judged(self, stamp: int, sensor: str, values: Mapping[str, SupportsFloat]) -> Told | None:
        """What becomes of an event whose stamp is not plainly right; None if it is to be taken."""
        clock = self._clock
        newest = clock.newest
        if newest is None or (self._window.origin is None and (not sensor or stamp > newest)):
            if newest is not None and not sensor:
                self._begin(self._window.tally())  # the commands' clock counts: what was heard before is of another
            clock.start(stamp)
            return None
        verdict = clock.judge(stamp, command=not sensor)
        while verdict is Verdict.CONTRADICTED:
            self._window.forget(clock.bound)
            self._notice(
                f"what was stamped {(newest - stamp) / 1e9:.3f} s ahead of the others is taken back;"
                " are all stamps of one clock?"
            )
            if clock.low <= stamp <= clock.high:
                if stamp > clock.sure:
                    clock.advance(stamp)
                return None
            verdict = clock.judge(stamp, command=not sensor)
        if verdict is Verdict.HERE:
            return None
        if clock.tries and len(self._aside) < _MOST_ASIDE:
            self._aside = [*(self._aside if sensor or clock.tries > 1 else []), _Event(stamp, sensor, dict(values))]
        if verdict is Verdict.ANEW:
            return self._start_anew(newest)
        if verdict is Verdict.BEYOND:
            return self._refuse(sensor, values, _INVALID, f"stamped {(stamp - newest) / 1e9:.0f} s ahead of all others")
        behind = f"stamped {(newest - stamp) / 1e9:.3f} s behind the newest"
        return self._refuse(sensor, values, _TOO_LATE, f"{behind}; the window is {clock.window / 1e9:g} s")

    def _start_anew(self, newest: int) -> Told:
        """A new segment from the events that have shown the commands' clock to be another."""
        events, self._aside = self._aside, []
        first = next(event.stamp for event in events if not event.sensor)
        self.segment += 1
        self._notice(
            f"the commands' clock was set {'back' if first < newest else 'ahead'} by {abs(newest - first) / 1e9:.3f} s:"
            " new segment, filter restarted"
        )
        self._start = {}
        self._begin(self._window.tally())
        self._clock.start(max(event.stamp for event in events))
        return [self._take(*event) for event in events][-1]

    def _take_early(self, event: _Event) -> Told:
        """Take an event while the frame's place may still change; a command before all others moves it."""
        early, newest, origin = self._early, self._clock.sure, self._window.origin
        assert early is not None
        if origin is not None and newest - origin > self._clock.window:
            self._early = None
            return self._feed(*event)
        oldest = self._oldest()
        kept = [one for one in early[-_MOST_ASIDE:] if one.stamp >= oldest] if len(early) > 2 * _MOST_ASIDE else early
        self._early = [*kept, event] if kept is not early else early
        if kept is early:
            early.append(event)
        places = not event.sensor and _finite(event.values, "x", "y")
        if not places or (self._placed is not None and event.stamp >= self._placed_since):
            return self._feed(*event)
        events = [one for one in self._early if one.stamp >= oldest]
        self._begin(None)
        self._early = events
        self._place(event)
        return [self._feed(*one) for one in events][-1]

    def _place(self, command: _Event) -> None:
        """Let a command's position say where the frame about the base is."""
        assert self.config.frame is not None
        x, y = float(command.values["x"]), float(command.values["y"])
        self._placed, self._placed_since = placed_at(self.config.frame, x, y, "the first command"), command.stamp

    def _feed(self, stamp: int, sensor: str, values: Mapping[str, SupportsFloat]) -> Told:
        """Give an event that is in time to the window."""
        number = self._sensors.get(sensor, -1)
        if number < 0 and sensor:
            return self._refuse(
                sensor, values, _UNKNOWN, f"unknown sensor '{sensor:.40}'; {suggestion(sensor, self._sensors)}"
            )
        new, given, stranger = self._new, 0, ""
        for name, value in values.items():
            axis = self._bits.get(name)
            if axis is None:
                stranger = name
                continue
            try:
                new[axis] = value
            except (TypeError, ValueError):
                new[axis] = np.nan
            given |= 1 << axis
        if stranger and self.config.frame is not None and any(name in values for name in CARTESIAN):
            turned, why = self._in_axes(_Event(stamp, sensor, values))
            if why:
                return self._refuse(sensor, values, Outcome.BEFORE_START, why)
            given |= turned
            stranger = next((name for name in values if name not in self._bits and name not in CARTESIAN), "")
        if not given:
            return self._refuse(sensor, values, _UNKNOWN, self._no_axis(stranger))
        oldest = self._oldest()
        if sensor:
            newest = self._clock.newest or stamp
            self._window.hear(stamp, number, given, newest, oldest, oldest - self._longest_latency)
        else:
            self._window.command(stamp, given, oldest, oldest - self._longest_latency)
        if self._placed is not None:
            self._window.memory.heard.new[:, SPREAD] = 1.0
        codes = self._told.tobytes()
        return self._answers.get((codes, stranger)) or self._answer(codes, stranger)

    def _in_axes(self, event: _Event) -> tuple[int, str]:
        """Turn x, y and z of an event into the axes; which ones as bits, and why not."""
        heard, given = self._window.memory.heard, 0
        values = {name: _number(event.values[name]) for name in CARTESIAN if name in event.values}
        if "x" in values or "y" in values:
            if (
                self._placed is None
                and not event.sensor
                and np.isfinite(values.get("x", np.nan) + values.get("y", np.nan))
            ):
                self._place(event)
            if self._placed is None:
                return 0, "no command has said yet where x and y are in the arm's axes"
            x, y = (np.array([values.get(name, np.nan)]) for name in ("x", "y"))
            near = self._commanded(event.stamp) if event.sensor else None
            tangential, radial, spread = self._placed.to_axes(x, y, near, self._last_tangential)
            if not event.sensor and np.isfinite(tangential[0]):
                self._last_tangential = float(tangential[0])
            for axis, value in {"tangential": tangential, "radial": radial}.items():
                if axis in self._bits:
                    heard.new[self._bits[axis], VALUE] = value[0]
                    given |= 1 << self._bits[axis]
            if "tangential" in self._bits:
                heard.new[self._bits["tangential"], SPREAD] = spread[0]
        if "z" in values and "vertical" in self._bits:
            heard.new[self._bits["vertical"], VALUE] = values["z"]
            given |= 1 << self._bits["vertical"]
        return given, ""

    def _commanded(self, stamp: int) -> FloatArray:
        """The tangential position [m] commanded at ``stamp`` or before it, as far as is known, (1,)."""
        commands, axis = self._window.memory.commands, self._bits.get("tangential", 0)
        count = int(commands.number[axis, COMMANDS])
        row = int(np.searchsorted(commands.time[axis, :count, STAMP], stamp, side="right")) - 1
        return commands.row[axis, max(row, 0) : max(row, 0) + 1, U] if count else np.zeros(1)

    def _to_log(self, axes: Mapping[str, AxisNow]) -> dict[str, float] | None:
        """An estimate in the stream's x, y and z."""
        if self._placed is None:
            return None
        found: dict[str, float] = {}
        if "tangential" in axes and "radial" in axes:
            position = (np.array([axes[axis].position]) for axis in ("tangential", "radial"))
            x, y = self._placed.to_log(*position)
            found["x"], found["y"] = float(x[0]), float(y[0])
        if "vertical" in axes:
            found["z"] = axes["vertical"].position
        return found

    def _no_axis(self, stranger: str) -> str:
        return f"unknown axis '{stranger:.40}'; {suggestion(stranger, self.axes)}" if stranger else "gives no axis"

    def _answer(self, codes: bytes, stranger: str) -> Told:
        """What is told of an event by the codes of its axes; the same for all alike."""
        outcomes = {axis: Outcome(code) for axis, code in zip(self.axes, codes, strict=True) if code != ABSENT}
        best = min(outcomes.values(), key=_BEST.index)
        reasons = dict.fromkeys(_REASONS[outcome] for outcome in outcomes.values())
        if stranger:
            outcomes[stranger] = _UNKNOWN
            reasons[self._no_axis(stranger)] = None
        told = Told(best, MappingProxyType(outcomes), "; ".join(reasons))
        if len(self._answers) < _MOST_ASIDE:
            self._answers[codes, stranger] = told
        return told

    def _refuse(self, sensor: str, values: Mapping[str, object], outcome: Outcome, reason: str) -> Told:
        """Count an event that never comes into the window."""
        if sensor in self._refused:
            self._refused[sensor][outcome] += len(values)
        elif sensor:
            self._strangers += 1
        return Told(outcome, MappingProxyType(dict.fromkeys(values, outcome)), reason)


def nanoseconds(t: Time) -> int:
    """Int ns of float seconds or int nanoseconds.

    Raises:
        ValueError: Not finite, or out of reach of int64 ns.
        TypeError: Not a number.
    """
    stamp = round(t * 1e9) if isinstance(t, float) else operator.index(t)
    if not -REACH_NS < stamp < REACH_NS:
        raise ValueError
    return stamp


def _nowhere(stamp: int, outcome: Outcome, reason: str) -> LiveEstimate:
    return LiveEstimate(stamp, {}, None, (), outcome, reason)


def _number(value: object) -> float:
    try:
        return float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):
        return np.nan


def _finite(values: Mapping[str, object], *names: str) -> bool:
    return all(np.isfinite(_number(values.get(name))) for name in names)
