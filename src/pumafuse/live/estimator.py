"""The estimator that a program feeds event by event: :class:`LiveEstimator`.

The road of an event, late or not:

    command, measurement    what a program calls
    _add                    reads its stamp and its values; a clock judges the stamp; the record gets the event
    _screen_event           lets a command that leaps wait for the next one
    _add_in_frame           places x, y and z, as soon as a command tells where a cylindrical frame starts
    _add_row                of a measurement: where it sees the tool, how noisy it is, which values are no news
    _update                 gives it to :meth:`.Window.add`, and counts what became of it

That an event is late matters to ``Window::insert`` of the core alone (``core/window.hpp``): it puts the event in its
place by time and restores the state before it, from where the filter runs on over all rows that are later.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np

from ..arrays import NEVER, IntArray
from ..errors import ConfigError, RunError, suggestion
from ..filter.events import COMMAND
from ..filter.outcome import ABSENT, FARTHEST, Outcome
from ..filter.window import MOST_EVENTS, Window
from ..fusion.config import FusionConfig
from ..fusion.segments import LONGEST_TAIL_NS, latest_follow
from ..fusion.setup import live_model
from ..logs.frames import CARTESIAN, Placed
from ..space.rotations import TURNING
from ..units import Kind
from .clock import Clock, SetBack, Time, Verdict, stamp_of
from .commands import Commands, CommandWatch, number
from .diagnosis import Diagnosis
from .frame_start import FrameStart
from .health import Counts, Health, by_word
from .joints import Joints
from .rate_limit import RateLimitedLog
from .results import REASONS, AxisNow, LiveEstimate, UpdateResult, no_estimate, refuse, update_result
from .screening import NEWS, CommandScreen, HoldWatch, Screened
from .tool import NO_TOOL, NOISE, ORIENTATION, Row, axes_of, check_tool, parse_noise, tool_of

_MOST_AXES = 62  # the core takes the axes of an event as bits
_MOST_KEPT = 10_000  # events kept in case a clock was set anew
_ABSENT = bytes((ABSENT,))
_FUSED, _INVALID, _UNKNOWN, _TOO_LATE = Outcome.FUSED, Outcome.INVALID, Outcome.UNKNOWN, Outcome.TOO_LATE
_STRAY, _HELD = Outcome.STRAY, Outcome.HELD
_REJECTED = "its measurements are rejected"
_Values: TypeAlias = Mapping[str, Any]  # of an event, by axis or joint


class _Event(NamedTuple):
    """An event whose stamp [ns] is a time; without a sensor it is a command."""

    stamp: int
    sensor: str | None
    values: _Values


class _Counted(NamedTuple):
    """An event that may have to be fed again, and what it was counted as."""

    event: _Event
    result: UpdateResult
    as_row: bool  # whether a row was counted, too


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
            if not 0.0 < number(value) <= LONGEST_TAIL_NS / 1e9:
                raise ConfigError(f"{name}: must be more than 0 s and at most an hour, not {value!r:.40}")
        for name, value in (start or {}).items():
            if not abs(number(value)) < FARTHEST:
                raise ConfigError(f"start: the level of {name} must be a finite position in m, not {value!r:.40}")
        check_tool(config, start or {})
        self._joints = None if config.robot is None else Joints(config)
        self.config = config
        self.segment = 0
        self.axes = tuple(config.arm.axes)
        self._sensors = {name: number for number, name in enumerate(config.sensors)}
        self._bits = {name: number for number, name in enumerate(self.axes)}
        self._stale_ns = round(stale_after * 1e9)
        self._no_spread = [1.0] * len(self.axes)
        self._log, self._event_log = RateLimitedLog(on_notice), event_log
        self._refused: IntArray = np.zeros((len(self._sensors) + 1, len(Outcome)), dtype=np.int64)
        self._of_unknown_sensors = 0
        self._doubtful = 0  # commands that may have to be taken back
        self._answers: dict[bytes, UpdateResult] = {}
        self._of_new_clock: list[_Counted] = []  # what may be stamped by a new clock of the commands
        self._behind: list[_Counted] = []  # what came since that clock may be set back within the window
        self._contradicting: dict[str, str] = {}  # sensors, and whom they contradict now
        self._clock = Clock(round(window * 1e9))
        self._watch = CommandWatch(config.arm, config.frame, self._log)
        self._diagnosis, self._set_back = Diagnosis(config, self._log), SetBack(len(self._sensors))
        self._screen, self._holds = CommandScreen(config.arm.update_period), HoldWatch(self._clock.window // 2)
        self._follows = [[latest_follow(config, name, axis) for axis in self.axes] for name in config.sensors]
        self._start = dict(start or {})
        self._restart(Counts(len(self._sensors)))

    def command(self, t: Time, /, **axes: Any) -> UpdateResult:
        """Add a command: the arm is to go to a position [m] on each of ``axes``.

        Args:
            t: When, float seconds or int nanoseconds.
            **axes: u [m] of each commanded axis; x, y and z with a frame; and ``orientation``, a quaternion x, y, z, w,
                for a tool that turns. Or all joints [rad or m] of the configuration's robot.
        """
        return self._add(t, None, axes)

    def measurement(self, t: Time, sensor: str, /, **axes: Any) -> UpdateResult:
        """Add a measurement of where the tool was.

        Args:
            t: Its stamp, float seconds or int nanoseconds; its latency is in the configuration.
            sensor: Its name there.
            **axes: z [m] of each axis it saw; x, y and z with a frame; and ``orientation``, likewise; or all joints. Of
                a sensor with a frame or a marker all are as it measures them. ``noise`` is by what that of the sensor
                is scaled.
        """
        return self._add(t, str(sensor), axes)

    def estimate(self, at: Time | None = None) -> LiveEstimate:
        """Where the tool is.

        Args:
            at: In the past, within the window: filtered by all measurements valid until then that have come so far. In
                the future: predicted with the last command held. None: at the newest stamp (but not at one that a
                sensor alone has run ahead to).
        """
        return self._estimate(at, NEVER)

    def estimate_as_live(self, stamp: int) -> LiveEstimate:
        """The estimate for an instant [ns] in the window by nothing that is stamped later, as if that had not come."""
        return self._estimate(stamp, stamp)

    def health(self, at: Time | None = None) -> Health:
        """How each sensor does, and what became of everything so far.

        Args:
            at: Until when a sensor that is silent has been so; None: until the newest stamp.

        Raises:
            ValueError: ``at`` is no time.
        """
        newest = None if self._clock.newest is None else max(self._clock.now, stamp_of(at or 0))
        counts = self._counts.snapshot(self._window)
        sensors = {
            name: counts.health(sensor, self._refused[sensor], newest, self._stale_ns)
            for name, sensor in self._sensors.items()
        }
        commands = by_word(counts.outcomes[COMMAND] + self._refused[COMMAND])
        rejected = (
            f"sensor '{name}' contradicts '{other}': {_REJECTED}" for name, other in self._contradicting.items()
        )
        faults = (*self._diagnosis.shown, *rejected)
        return Health(newest, self.segment + 1, commands, sensors, self._of_unknown_sensors, faults)

    @property
    def joints(self) -> Mapping[str, Kind]:
        """What the joints that events may be in move by; empty without a robot."""
        return {} if self._joints is None else self._joints.kinds

    @property
    def placed(self) -> Placed | None:
        """The frame at its start; None without one, or before it has started."""
        return self._frame_start.placed

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

    def until(self, t: Time, sensor: str | None = None) -> int | None:
        """Up to which instant [ns] a clock may go on before an event stamped ``t`` comes in; None before the first one.

        That is the event's stamp, if it is plausible or confirms a jump ahead; else the newest stamp that is confirmed.
        """
        try:
            stamp = stamp_of(t)
        except ValueError:
            return self.sure
        is_configured = sensor is None or sensor in self._sensors
        right = self._clock.low <= stamp <= self._clock.high or (
            is_configured and self._clock.ends_doubt(stamp, sensor)
        )
        return stamp if right else self.sure

    def of_tool(self, t: Time, sensor: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """What an event that was taken tells of the tool: its orientation as axes, its position along the base's axes.

        Args:
            t: Its stamp.
            sensor: Its name; empty for a command.
            values: As it came.
        """
        parsed = self._parse(sensor or None, {name: value for name, value in values.items() if name != NOISE})
        if self._tool is None or not sensor:
            return parsed
        return self._tool.to_tool(sensor, stamp_of(t), parsed).values

    def _estimate(self, at: Time | None, after: int) -> LiveEstimate:
        """Where the tool is, by nothing that is stamped after ``after`` [ns]."""
        newest = self._clock.newest
        now = 0 if newest is None else self._clock.now
        try:
            stamp = now if at is None else stamp_of(at)
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
        for axis, estimate in zip(self.axes, self._window.estimate(stamp, after), strict=True):
            if estimate is not None:
                outputs, fused = estimate
                axes[axis] = AxisNow(*outputs)
                if stamp - fused > self._stale_ns:
                    stale.append(axis)
        reason = "now" if stamp == now else "filtered" if stamp < now else "predicted, the last command held"
        placed = self._frame_start.in_log({axis: now.position for axis, now in axes.items()})
        orientation = None
        if self._tool is not None:
            orientation = self._tool.orientation([axes[axis].position for axis in TURNING if axis in axes])
        return LiveEstimate(stamp, axes, placed, tuple(stale), _FUSED, reason, orientation, self._diagnosis.doubtful)

    # ---- the road of an event ----------------------------------------------------------------------------------------

    def _add(self, t: Time, sensor: str | None, values: _Values) -> UpdateResult:
        """Add an event where its stamp says, if that can be."""
        try:
            event = _Event(stamp_of(t), sensor, values)
            parsed = self._parse(sensor, values)
        except ValueError as error:
            return self._refuse(sensor, values, _INVALID, str(error))
        if sensor is not None and sensor not in self._sensors:
            return self._refuse(sensor, values, _UNKNOWN, f"unknown sensor; {suggestion(sensor, self._sensors)}")
        clock, stamp = self._clock, event.stamp
        if not clock.low <= stamp <= clock.high:
            if (refusal := self._judge(event)) is not None:
                return refusal
        elif clock.newest is not None and stamp > clock.newest:
            clock.settle(stamp)
        if sensor is None and self._of_new_clock:
            clock.other, self._of_new_clock = [], []
        if self._event_log is not None:
            self._event_log.append(*event)
        result = self._screen_event(event, parsed)
        if self._set_back.add(COMMAND if sensor is None else self._sensors[sensor], stamp):
            return self._watch_clocks(event, result)
        return result

    def _parse(self, sensor: str | None, values: _Values) -> _Values:
        """An event's values with a pose in the place of joints, and a commanded orientation as axes."""
        if self._joints is not None and (joints := self._joints.parse(values)) is not None:
            values = self._joints.to_pose(values, joints)
        if self._tool is not None:
            return self._tool.parse(sensor, values)
        if ORIENTATION in values:
            raise ValueError(NO_TOOL)
        return values

    def _judge(self, event: _Event) -> UpdateResult | None:
        """What becomes of an event whose stamp is not plainly right; None if it is to be taken."""
        clock, (stamp, sensor, values) = self._clock, event
        newest, command = clock.newest, sensor is None
        if newest is None or (self._window.origin is None and (command or stamp > newest)):
            if newest is not None and command:
                # The commands' clock counts: what came before is of another.
                self._restart(self._counts.snapshot(self._window))
                if self._event_log is not None:
                    self._event_log.begin_segment()
            clock.start(stamp)
            return None
        verdict = clock.judge(stamp, sensor)
        while verdict is Verdict.CONTRADICTED:
            self._forget(clock.bound)
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
        if is_late := verdict is Verdict.BEHIND:
            result = self._refuse_late(stamp, sensor, values, self._refused)
        else:
            ahead = f"stamped {(stamp - newest) / 1e9:.0f} s ahead of all others"
            result = self._refuse(sensor, values, _INVALID, ahead)
        if len(clock.other) == 1 and command:
            self._of_new_clock = []
        if clock.other and len(self._of_new_clock) < _MOST_KEPT:
            self._of_new_clock.append(_Counted(event._replace(values=dict(values)), result, is_late))
        return result

    def _screen_event(self, event: _Event, parsed: _Values) -> UpdateResult:
        """Add an event whose stamp is right, as it came and as it is used; a command that leaps waits for the next."""
        stamp, sensor, values = event
        if sensor is not None:
            if stamp > self._screen.until:
                self._add_screened(self._screen.take_waiting())
            return self._add_in_frame(stamp, sensor, parsed)
        self._counts.outcomes[COMMAND, _STRAY] += 1  # as long as it waits for the next
        in_joints = not self.joints.keys().isdisjoint(values)  # which are screened: a pose is of all of them
        settled = self._add_screened(self._screen.add(stamp, values if in_joints else parsed))
        waits = "leaps by many times the usual step: not used unless the next one is there, too"
        return settled.get(stamp) or refuse(values, _STRAY, waits)

    def _add_screened(self, commands: Sequence[Screened]) -> dict[int, UpdateResult]:
        """Add commands that have waited, or need not, without what is stray; what became of each, by its stamp."""
        settled = dict[int, UpdateResult]()
        for stamp, values, stray in commands:
            for name in stray:
                self._log.write(
                    f"stray {name}",
                    f"a command of {name} at {stamp / 1e9:.3f} s leaps away from those before and after it: stray, not"
                    " used",
                )
            if not self.joints.keys().isdisjoint(stray):  # a pose is of all joints
                values = {name: value for name, value in values.items() if name not in self.joints}
            if values or not stray:
                self._counts.outcomes[COMMAND, _STRAY] -= 1
                settled[stamp] = self._add_command(stamp, values)
        return settled

    def _add_command(self, stamp: int, values: _Values) -> UpdateResult:
        """Add a command that is to be used; one in joints changes the poses of others, where joints are later."""
        oldest = self._oldest()
        if self._joints is None or (joints := self._joints.parse(values)) is None:
            return self._add_in_frame(stamp, None, values)
        by_stamp = {stamp: joints} if stamp < oldest else self._joints.command(stamp, joints, oldest)
        try:
            first = self._parse(None, self._joints.to_pose(values, by_stamp.pop(stamp)))
            others = {other: self._parse(None, self._joints.to_pose({}, moved)) for other, moved in by_stamp.items()}
        except ValueError as error:
            return self._refuse(None, values, _INVALID, str(error))
        result = self._add_in_frame(stamp, None, first)
        for other, pose in others.items():
            self._add_in_frame(other, None, pose, judged=True)
        return result

    def _add_in_frame(self, stamp: int, sensor: str | None, values: _Values, judged: bool = False) -> UpdateResult:
        """Add an event that is to be used; ``judged``: in the place of a command of the same stamp."""
        if self._early is not None:
            try:
                self._add_early(_Event(stamp, sensor, dict(values)), judged)
            except RunError as error:
                return self._refuse(None, values, _INVALID, str(error))
        return self._add_to_window(stamp, sensor, values, judged)

    def _add_early(self, event: _Event, judged: bool) -> None:
        """Keep an event while the frame's place may still change; a command before all others moves it."""
        assert self._early is not None
        early, oldest, origin, since = self._early, self._oldest(), self._window.origin, self._frame_start.since
        if origin is not None and self._clock.sure - origin > self._clock.window:
            self._early = None
            return
        if judged:
            early[:] = [earlier for earlier in early if earlier.sensor is not None or earlier.stamp != event.stamp]
        x, y = (number(event.values.get(name)) for name in ("x", "y"))
        if event.sensor is None and math.isfinite(x + y) and (since is None or event.stamp < since):
            frame_start = FrameStart(self.config.frame, self.axes)
            frame_start.start_at_command(event.stamp, x, y)
            early = [earlier for earlier in early if earlier.stamp >= oldest]
            self._restart(self._counts_before)
            self._early, self._frame_start = early, frame_start
            for earlier in early:
                self._add_to_window(*earlier)
        if len(early) >= _MOST_KEPT:
            del early[: _MOST_KEPT // 2]
        early.append(event)

    def _add_to_window(self, stamp: int, sensor: str | None, values: _Values, judged: bool = False) -> UpdateResult:
        """Add an event that is in time to the window; ``judged``: it is not held, nor counted anew."""
        if sensor is not None and not judged:
            return self._add_row(stamp, sensor, values)
        bits, unknown = self._fill(stamp, sensor, values)
        if stamp < (oldest := self._oldest()):
            return self._refuse_late(stamp, sensor, values, self._counts.outcomes)
        return self._update(_Event(stamp, sensor, values), bits, unknown, oldest, judged)

    def _add_row(self, stamp: int, sensor: str, values: _Values) -> UpdateResult:
        """Put a measurement into the window: as it tells of the tool, as noisy as it says, without what is no news."""
        window, tool, of_tool, noise = self._window, self._tool, None, 1.0
        if self._spreads:
            window.spread[:] = self._no_spread
        if NOISE in values:
            noise, self._spreads = parse_noise(values), True
            values = {name: value for name, value in values.items() if name != NOISE}
        if tool is not None:
            of_tool = tool.to_tool(sensor, stamp, values)
            values = of_tool.values
        bits, unknown = self._fill(stamp, sensor, values)
        if stamp < (oldest := self._oldest()):
            return self._refuse_late(stamp, sensor, values, self._counts.outcomes)
        if of_tool is not None:
            for name in of_tool.spread.keys() & self._bits.keys():
                window.spread[self._bits[name]] = of_tool.spread[name]
        if noise != 1.0:
            window.spread[:] = [noise * factor for factor in window.spread]
        if tool is not None and of_tool is not None and of_tool.seen is not None:
            tool.add(sensor, Row(stamp, of_tool.seen, [*window.value, *window.spread], noise), oldest)
        held, released = self._find_held(stamp, sensor, bits)
        if released or held:
            return self._add_news(stamp, sensor, bits, held, released)
        return self._update(_Event(stamp, sensor, values), bits, unknown, oldest)

    def _fill(self, stamp: int, sensor: str | None, values: _Values) -> tuple[int, str]:
        """Put an event's values into the window's ``value``; which axes these are, as bits, and a name that is none."""
        new, bits, unknown = self._window.value, 0, ""
        for name, value in values.items():
            axis = self._bits.get(name)
            if axis is None:
                unknown = name
                continue
            new[axis] = value if type(value) is float else number(value)
            bits |= 1 << axis
        if unknown and self.config.frame is not None:
            bits |= self._fill_axes(stamp, sensor, values)
            unknown = next((name for name in values if name not in self._bits and name not in CARTESIAN), "")
        return bits, unknown

    def _fill_axes(self, stamp: int, sensor: str | None, values: _Values, noise: float = 1.0) -> int:
        """Put an event's x, y and z into the window's ``value`` and ``spread`` as axes; which ones, as bits."""
        window, bits, near = self._window, 0, None
        if sensor is not None:
            commanded = self._commands.at(self._bits["tangential"], stamp) if "tangential" in self._bits else None
            near = np.array([commanded or 0.0])
        point = {name: number(values[name]) for name in CARTESIAN if name in values}
        placed = self._frame_start.in_axes(point, near)
        for name, component in placed.items():
            axis = self._bits[name]
            window.value[axis], spread = component
            window.spread[axis] = noise * spread
            bits |= 1 << axis
        return bits

    def _find_held(self, stamp: int, sensor: str, bits: int) -> tuple[int, list[tuple[int, str, float, float]]]:
        """Which of the axes that a measurement gives are no news, as bits; values of before that are news after all."""
        held, released, number = 0, list[tuple[int, str, float, float]](), self._sensors[sensor]
        follows, values, spread = self._follows[number], self._window.value, self._window.spread
        for axis, name in enumerate(self.axes):
            if not bits >> axis & 1:
                continue
            judge = self._holds.judge((number, axis), stamp, values[axis], spread, self._commands, follows[axis])
            if judge is NEWS:
                continue
            held |= judge.held << axis
            self._counts.outcomes[number, _HELD] += judge.held - len(judge.released)
            released += [(earlier, name, component, factor) for earlier, component, factor in judge.released]
            if judge.sure:
                self._log.write(
                    f"{sensor} {name} held",
                    f"sensor '{sensor}' repeats its value of {name} to the last digit at {stamp / 1e9:.3f} s: did it"
                    " freeze, or is it slower than its rows? Held, not used",
                )
        return held, released

    def _add_news(
        self, stamp: int, sensor: str, bits: int, held: int, released: Sequence[tuple[int, str, float, float]]
    ) -> UpdateResult:
        """Add to the window what is news of a measurement that has come to it, and what was not used before and is."""
        self._counts.add_row(self._sensors[sensor], stamp, self._clock.sure)
        kept = {name: self._window.value[axis] for name, axis in self._bits.items() if (bits & ~held) >> axis & 1}
        again = [name for name, axis in self._bits.items() if held >> axis & 1]
        result = self._add_to_window(stamp, sensor, kept, judged=True) if kept else refuse(again, _HELD, REASONS[_HELD])
        for earlier, name, value, spread in released:
            self._window.spread[self._bits[name]] = spread
            self._add_to_window(earlier, sensor, {name: value}, judged=True)
        return result

    def _update(self, event: _Event, bits: int, unknown: str, oldest: int, judged: bool = False) -> UpdateResult:
        """Let the filter run on from the place of an event that fills the window's ``value``; what became of it."""
        window, counts, diagnosis, (stamp, sensor, values) = self._window, self._counts, self._diagnosis, event
        if not bits:
            missing = not unknown and len(values) > 0
            why = "no command has shown yet where x and y are in the arm's axes" if missing else self._why_not(unknown)
            outcome = Outcome.BEFORE_START if missing else _UNKNOWN
            return self._refuse(sensor, values, outcome, why, counts.outcomes)
        rows, source = window.port.end, COMMAND if sensor is None else self._sensors[sensor]
        diagnosis.recent.add(stamp, source, bits, window.value, window.spread)
        if not window.add(stamp, source, bits, oldest):
            return self._refuse_late(stamp, sensor, values, counts.outcomes)
        codes = bytes(window.outcome)
        result = self._answers.get(codes) if not unknown else None
        result = result or self._answer(codes, unknown)
        counts.count(window)
        is_due = self._clock.sure >= diagnosis.due or Outcome.REACQUIRED in codes
        if is_due and self._screen.until == NEVER:  # a command that waits may explain it all
            diagnosis.diagnose(window, self._clock.sure)
        if sensor is None:
            self._follow_command(event, codes, result.outcome, oldest, judged)
        else:
            self._follow_measurement(stamp, sensor, codes, result.outcome, window.port.end == rows, judged)
        return result

    def _follow_command(self, event: _Event, codes: bytes, outcome: Outcome, oldest: int, judged: bool) -> None:
        """What a command in the window changes beside the filter: counts, watches, measurements that it places."""
        stamp, _, values = event
        if not judged:
            self._counts.outcomes[COMMAND, outcome] += 1
            self._doubtful += outcome is _FUSED and self._clock.doubtful
            if outcome in (_FUSED, Outcome.DUPLICATE):
                self._watch.watch_intervals(stamp, values)
        self._commands.add(stamp, codes, self._window.value[:], oldest)
        self._watch.watch_limits(self._commands)
        if self._tool is not None:
            self._amend(self._tool.command(stamp, values, oldest))

    def _follow_measurement(
        self, stamp: int, sensor: str, codes: bytes, outcome: Outcome, repeats: bool, judged: bool
    ) -> None:
        """Count a measurement that is in the window, or ``repeats`` one there; say whom it contradicts."""
        source, counts = self._sensors[sensor], self._counts
        if not judged:
            counts.add_row(source, stamp, self._clock.sure)
        for code in codes.replace(_ABSENT, b"") if repeats else b"":
            counts.outcomes[source, code] += 1
        if self._window.port.contradicts >= 0:
            self._say_contradiction(stamp, sensor)
        elif sensor in self._contradicting and outcome is _FUSED:
            del self._contradicting[sensor]

    def _amend(self, since: int | None) -> None:
        """Put measurements that the commands place where they are by now, those valid from an instant [ns] on."""
        if self._tool is None or since is None:
            return
        window = self._window
        for sensor, rows, points in self._tool.placed_since(since):
            before = np.array([row.numbers for row in rows])
            for row, point in zip(rows, points, strict=True):
                values: dict[str, float] = dict(zip(CARTESIAN, point, strict=True))
                window.value[:], window.spread[:] = row.numbers[: len(self.axes)], row.numbers[len(self.axes) :]
                for name in values.keys() & self._bits.keys():
                    window.value[self._bits[name]] = values[name]
                if self.config.frame is not None:
                    self._fill_axes(row.stamp, sensor, values, row.noise)
                row.numbers = [*window.value, *window.spread]
            stamps, now = np.array([row.stamp for row in rows]), np.array([row.numbers for row in rows])
            window.amend(self._sensors[sensor], stamps, before, now)
        window.spread[:] = self._no_spread

    # ---- events that are refused, and what is said of them -----------------------------------------------------------

    def _oldest(self) -> int:
        """No event stamped before is taken [ns]."""
        return max(self._clock.sure - self._clock.window, self._window.port.floor)

    def _refuse_late(self, stamp: int, sensor: str | None, values: _Values, outcomes: IntArray) -> UpdateResult:
        """Count an event that is behind the window; how late it is shows which window it would take."""
        if sensor is not None:
            self._counts.add_row(self._sensors[sensor], stamp, self._clock.now)
        late, window = self._clock.sure - stamp, self._clock.window
        why = f"stamped {late / 1e9:.3f} s behind the newest; the window is {window / 1e9:g} s"
        if late <= window:
            why = f"more than {MOST_EVENTS} events came since: the window holds no more"
        return self._refuse(sensor, values, _TOO_LATE, why, outcomes)

    def _refuse(
        self, sensor: str | None, values: _Values, outcome: Outcome, reason: str, outcomes: IntArray | None = None
    ) -> UpdateResult:
        """Count an event that never comes into the window, a measurement for each of its axes, among ``outcomes``."""
        outcomes, result = self._refused if outcomes is None else outcomes, refuse(axes_of(values), outcome, reason)
        if sensor is None:
            outcomes[COMMAND, outcome] += 1
        elif sensor in self._sensors:
            outcomes[self._sensors[sensor], outcome] += len(result.axes)
        else:
            self._of_unknown_sensors += 1
        return result

    def _answer(self, codes: bytes, unknown: str) -> UpdateResult:
        """The result of an event by the codes of its axes; the same object for equal codes, but for unknown names."""
        outcomes = {axis: Outcome(code) for axis, code in zip(self.axes, codes, strict=True) if code != ABSENT}
        result = update_result(outcomes)
        if unknown:
            axes = MappingProxyType({**outcomes, unknown: _UNKNOWN})
            return result._replace(axes=axes, reason=f"{result.reason}; {self._why_not(unknown)}")
        return self._answers.setdefault(codes, result)

    def _why_not(self, unknown: str) -> str:
        """Why what an event gives under a name is of no axis."""
        if unknown in CARTESIAN and self.config.frame is None:
            return f"'{unknown}' needs a [frame] in fusion.toml; {suggestion(unknown, self.axes)}"
        if not unknown:
            return "gives no axis"
        return f"unknown axis '{unknown:.40}'; {suggestion(unknown, [*self.axes, *self.joints])}"

    def _say_contradiction(self, stamp: int, sensor: str) -> None:
        """Say which other sensor one contradicts, by how much, and since when."""
        window = self._window
        other = tuple(self._sensors)[window.port.contradicts]
        if self._contradicting.get(sensor) == other:
            return
        self._contradicting[sensor] = other
        screens = map(self.config.arm.screen_of, self.axes)
        off = ", ".join(
            f"{axis} by {nu * screen.scale:+.4g} {screen.unit}"
            for axis, screen, outcome, nu in zip(self.axes, screens, window.outcome, window.innovation, strict=True)
            if outcome == Outcome.REJECTED
        )
        self._log.write(
            f"{sensor} contradicts {other}",
            f"sensor '{sensor}' contradicts '{other}' since {stamp / 1e9:.3f} s ({off}): {_REJECTED}",
        )

    # ---- other clocks ------------------------------------------------------------------------------------------------

    def _watch_clocks(self, event: _Event, result: UpdateResult) -> UpdateResult:
        """Say that a sensor's clock was set back within the window, and start anew where all clocks were."""
        stamp, sensor, values = event
        if sensor is not None and (back := self._set_back.of_sensor(self._sensors[sensor])):
            self._diagnosis.set_back[sensor] = stamp
            note = (
                f"sensor '{sensor}': its stamps step back by {back / 1e9:.3f} s at {stamp / 1e9:.3f} s and go on there:"
                " was its clock set? If it was right before, its measurements are stamped too early by that now"
            )
            self._log.write(f"{sensor} set back", note)
        if sensor is None and self._set_back.commands == 1:
            self._behind = []
        if not self._set_back.commands:
            return result
        self._behind.append(_Counted(event._replace(values=dict(values)), result, True))
        if not (back := self._set_back.of_all()):
            return result
        note = f"all clocks were set back by {back / 1e9:.3f} s at {stamp / 1e9:.3f} s: new segment, filter restarted"
        self._log.write("clock", note)
        return self._begin_segment(self._behind)

    def _forget(self, after: int) -> None:
        """Take back all that is stamped after ``after`` [ns]."""
        self._counts.forget(self._window, after)
        for part in (self._window, self._commands, self._watch, self._diagnosis.recent, self._joints):
            if part is not None:
                part.forget(after)
        if self._tool is not None:
            self._amend(self._tool.forget(after))
        self._screen.restart()
        if self._event_log is not None:
            self._event_log.discard(after)
        self._counts.outcomes[COMMAND, _FUSED] -= self._doubtful
        self._counts.outcomes[COMMAND, _INVALID] += self._doubtful
        self._doubtful = 0

    def _start_anew(self, event: _Event, newest: int) -> UpdateResult:
        """A new segment from the events that have shown the commands' clock to be another."""
        of_new_clock, self._of_new_clock = self._of_new_clock, []
        first = next(counted.event.stamp for counted in of_new_clock if counted.event.sensor is None)
        way = "back" if first < newest else "ahead"
        moved = f"{way} by {abs(newest - first) / 1e9:.3f} s"
        self._log.write("clock", f"the commands' clock was set {moved}: new segment, filter restarted")
        return self._begin_segment(of_new_clock, event)

    def _begin_segment(self, counted: Sequence[_Counted], *new: _Event) -> UpdateResult:
        """Begin a segment with events of the new clock, which are counted anew; what becomes of the last."""
        for (_, sensor, _), result, as_row in counted:
            source = COMMAND if sensor is None else self._sensors[sensor]
            for outcome in [result.outcome] if sensor is None else result.axes.values():
                self._counts.outcomes[source, outcome] -= 1
            if sensor is not None:
                self._counts.rows[source] -= as_row
        events = [*(entry.event for entry in counted), *new]
        self.segment += 1
        self._start = {}
        if self._joints is not None:
            self._joints.restart()
        self._restart(self._counts.snapshot(self._window))
        if self._event_log is not None:
            self._event_log.begin_segment()
        self._clock.start(next(event.stamp for event in events if event.sensor is None))
        return [self._add(*event) for event in events][-1]

    def _restart(self, counts: Counts) -> None:
        """An empty window; ``counts`` go on."""
        self._frame_start = FrameStart(self.config.frame, self.axes)
        model = live_model(self.config, self._frame_start.start_at_level(self._start))
        self._window, self._commands = Window(model), Commands(model.axis["start"].tolist())
        self._tool = tool_of(self.config, self._log)
        self._spreads = self._tool is not None or self.config.frame is not None  # whether noise is scaled, as is known
        for part in (self._watch, self._screen, self._holds, self._diagnosis, self._set_back, counts):
            part.restart()
        # A frame that waits is placed by the first command; one that comes later, but was given before it, moves it:
        # what came is fed again then, and counted anew.
        self._early: list[_Event] | None = [] if self._frame_start.waits else None
        self._counts, self._counts_before = counts, copy.deepcopy(counts)
