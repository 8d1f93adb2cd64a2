"""Faults of a log that show before anything is filtered.

A sensor with another unit, axis, sign, clock or zero, a begin in mid-motion.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from ..arrays import FloatArray, TimeArray, median
from ..discovery.matching import FOLLOWS, GAIN, SMALL_SHIFT, Grid, Match, Rows, Tracking, matches, without_spikes
from ..discovery.own_frames import angle_of
from ..errors import RunError
from ..filter.outcome import ABSENT, Outcome
from ..filter.response import response
from ..logs.frames import CARTESIAN
from ..model.arm import CANONICAL_AXES
from ..space.rotations import nearest
from ..units import DEG, GUESSED, MM, OF_KIND, Kind, mistaken, wraps
from .causes import Cause
from .clock_steps import ClockStep, find_clock_steps
from .config import FusionConfig
from .consistency import Finding
from .segments import Segment
from .setup import turn_of

_FEW = 30  # rows, or changes of a value, below which nothing is said
_ENOUGH = 500  # values that tell where a sensor is
_TAIL_NS = 1_000_000_000  # after the last command
_ALIKE, _UNEQUAL = 3, 0.3  # first steps, and how far they may be from their mean, over it
_SETTLED = 5.0  # lags of the plant
_MOVED = 0.5  # share of a motion
_FEWEST = 4  # measurements of a sensor
_MOST = 10_000  # commands before the first
_CLEAR, _LOST = 0.9, 0.5  # correlations: a cause is clear; the commands do not show
_SCALE = 10.0  # factor on a motion up to which it may be a scale that can be fitted
_ALIKE_SIZE = 0.2  # by how much, over it, the same fault of two sensors may differ

_TURNED = math.radians(2.8)  # from which a sensor that is turned is named: of 3°, less how well it is known
_SURELY = 4.0  # standard deviations of the angle, likewise
_STRAIGHTER = 0.7  # of the misfit along its axes: turned back a sensor must leave half of the variance or less
_ALIGNED = 0.8  # cosine of the angle from which on axes still follow their commands
_EXCHANGED = 0.99  # cosine within which each axis is another one, or against one: columns or signs, no frame
_HARDLY = 1e-3  # of the motion along its main direction, below which other directions tell nothing of a turn
_MOVE = 1e9  # ns, of the moves that are compared: less is noise, over more noise wanders
_PARTS = 8  # of a run, each of which is left out once: as the angle scatters then, so uncertain it is

_OF_CLOCKS = "clock", "nothing"  # how a clock that was set looks over all of a run
_Cause: TypeAlias = (
    Literal["turns", "unit", "columns", "sign", "clock", "set", "frame", "nothing", "motion", "zero"] | Cause | Finding
)


@dataclass(frozen=True)
class Fault:
    """Why a sensor, or all, are not where the commands lead."""

    # which; all that measure these axes if it is the commands that are wrong, none of their turns
    sensors: tuple[str, ...]
    axes: tuple[str, ...]  # on which they are not
    cause: _Cause  # what is wrong
    # how late they are or by how much their clock was set ahead [s], by how much they are turned [rad] or off [m or
    # rad], how many times as far they move, or how often they turn
    size: float
    sentence: str  # what shows it, and what to write instead
    refused: bool = False  # whether estimates would be wrong by construction
    lost: bool = False  # whether they follow the commands so little that nothing can be fitted to them
    at: int = 0  # the stamp since when, of a clock that was set [ns]

    def is_like(self, other: Fault) -> bool:
        """Whether the other fault, also of another sensor, may come from the same commands."""
        alike = math.isclose(self.size, other.size, rel_tol=_ALIKE_SIZE, abs_tol=SMALL_SHIFT * (self.cause == "clock"))
        return self.cause == other.cause and alike and not set(self.axes).isdisjoint(other.axes)


def check_sensors(segment: Segment, config: FusionConfig) -> list[Fault]:
    """Each fault of a configured sensor, or of the commands, with which there may be estimates.

    Raises:
        RunError: Estimates would be wrong by construction.
    """
    faults = find_faults(segment, config)
    if refused := [fault.sentence for fault in faults if fault.refused]:
        raise RunError(refused[0])
    return faults


def by_axis(faults: Iterable[Fault]) -> dict[tuple[str, str], str]:
    """Why measurements are not where the commands lead, by sensor and axis; a constant by which they are off apart."""
    return {
        (name, axis): fault.cause
        for fault in faults
        if isinstance(fault.cause, str) and fault.cause != "zero"
        for name in fault.sensors
        for axis in fault.axes
    }


def find_faults(segment: Segment, config: FusionConfig, origin: int | None = None) -> list[Fault]:
    """What is wrong with angles within a turn, and with sensors that do not follow or are off by a constant.

    Times are told since ``origin`` [ns], or the segment's.
    """
    positions = _positions(segment, config)
    trackings = _trackings(segment, config, positions)
    clocks = _find_set_clocks(segment, config, positions, segment.origin if origin is None else origin)
    named = {name for clock in clocks for name in clock.sensors}
    faults = [
        fault
        for fault in _find_not_following(segment, config, positions, trackings)
        if fault.cause not in _OF_CLOCKS or named.isdisjoint(fault.sensors)
    ]
    faults = [*clocks, *faults]
    named = {name for fault in faults for name in fault.sensors}
    quiet = {name: tracking for name, tracking in trackings.items() if name not in named}
    beside = [*_find_moving_alone(config, quiet), *_find_offsets(segment, config, quiet)]
    return [*find_turns(segment, config), *faults, *beside]


def find_not_following(segment: Segment, config: FusionConfig) -> list[Fault]:
    """What is wrong with sensors whose measurements are not where the commands lead: unit, axis, sign or clock."""
    positions = _positions(segment, config)
    return _find_not_following(segment, config, positions, _trackings(segment, config, positions))


def starts_in_motion(segment: Segment, config: FusionConfig) -> list[str]:
    """A sentence if the arm is in motion at the first command already, where the model has it at rest.

    That commands begin with a speed is not enough: an arm at rest may be commanded so. Measurements of the moving axes
    together must follow a motion that was there before, at least half of it, rather than one that begins.
    """
    speeds = {axis: speed for axis in segment.axes if (speed := _first_speed(segment, axis))}
    positions: _Positions = _positions(segment, config) if speeds else {}
    evidence = [_evidence(segment, config, axis, speed, positions) for axis, speed in speeds.items()]
    score, information = sum(pair[0] for pair in evidence), sum(pair[1] for pair in evidence)
    if score <= _MOVED * information + 3.0 * math.sqrt(information):  # three standard deviations
        return []
    off = {axis: abs(speed) * config.arm.lag_of(axis, abs(speed)) for axis, speed in speeds.items()}
    most = max(off, key=off.__getitem__)
    screen = config.arm.screen_of(most)
    return [
        f"the run begins in motion ({speeds[most] * screen.scale:.3g} {screen.unit}/s on {most}), the model at rest:"
        f" estimates are wrong by up to {off[most] * screen.scale:.2g} {screen.unit} at first; record from rest, or use"
        f" --from {max(settling_time(config, axis) for axis in speeds):.2g} or later"
    ]


def latency_questions(config: FusionConfig, names: Iterable[str]) -> list[str]:
    """A question about each of the sensors ``names`` with a negative latency."""
    return [
        f"sensors.{name}.latency_ms is {config.sensors[name].latency * 1e3:.4g}, so its measurements are stamped before"
        " they are made: is a delay_ms too large by that, or are commands stamped by another clock?"
        for name in names
        if name in config.sensors and config.sensors[name].latency < 0.0
    ]


# ---- where the commands lead ----------------------------------------------------------------------------------------


_Positions: TypeAlias = Mapping[str, Mapping[str, Rows]]  # when valid, and without the scale, by sensor and axis
_Trackings: TypeAlias = Mapping[str, Mapping[str, Tracking]]


def find_turns(segment: Segment, config: FusionConfig) -> list[Fault]:
    """A fault for each angle of the commands or of a sensor that begins anew after each turn."""
    faults, angles = list[Fault](), [axis for axis in segment.axes if config.arm.axes[axis].kind == "angle"]
    positions: _Positions = _positions(segment, config) if angles else {}
    for axis in angles:
        if times := len(wraps(segment.commands_of(axis)[1])):
            words = (
                f"the commands: an angle that begins anew on {axis} after each turn, {times} times: the model goes back"
                " by a turn then; turn_deg = 360 beside their column in run.toml makes them go on"
            )
            faults.append(Fault((), (axis,), "turns", times, words))
        for name, axes in positions.items():
            if axis in axes and (times := len(wraps(config.sensors[name].scale * axes[axis][1]))):
                words = (
                    f"sensor '{name}': an angle that begins anew on {axis} after each turn, {times} times: turn_deg ="
                    " 360 in its table makes it go on"
                )
                faults.append(Fault((name,), (axis,), "turns", times, words))
    return faults


def _positions(segment: Segment, config: FusionConfig) -> _Positions:
    """What the filter is given of each configured sensor, by stamp."""
    positions: dict[str, dict[str, Rows]] = {}
    for name, rows in segment.rows_by_sensor().items():
        if (sensor := config.sensors.get(name)) is not None:
            valid, fused = rows.stamp - round(sensor.latency * 1e9), rows.codes == int(Outcome.FUSED)
            positions[name] = {
                axis: (valid[here], rows.value[here, number] / sensor.scale)
                for number, axis in enumerate(segment.axes)
                if (here := fused[:, number]).any()
            }
    return positions


def _trackings(segment: Segment, config: FusionConfig, positions: _Positions) -> _Trackings:
    """How each sensor tracks the commands until 1 s after the last command, without axes of which there is little.

    Where most of it lies outside of the commands it is the clock that is wrong: the rest would tell of anything.
    """
    trackings: dict[str, dict[str, Tracking]] = {name: {} for name in positions}
    every, until = segment.rows_by_sensor(), int(segment.commands[-1]) + _TAIL_NS
    for name, axes in positions.items():
        for axis, (valid, position) in axes.items():
            count = int(np.searchsorted(valid, until - round(config.sensors[name].latency * 1e9), side="right"))
            codes = every[name].codes[:, segment.axes.index(axis)]
            if count >= max(_FEW, np.count_nonzero(codes != ABSENT) / 2):
                chosen = slice(None, count, 1 + count // _ENOUGH)
                alike = without_spikes(position[chosen])
                rows = valid[chosen][alike], position[chosen][alike]
                trackings[name][axis] = _tracking(segment, config, name, axis, rows)
    return trackings


def _response_at(segment: Segment, config: FusionConfig, axis: str, valid: TimeArray) -> tuple[FloatArray, FloatArray]:
    """Where the commands lead an axis at some instants, and where they had led shortly before."""
    early = segment.response(config.arm, axis, valid - round(SMALL_SHIFT * 1e9))
    return segment.response(config.arm, axis, valid), early


def _tracking(segment: Segment, config: FusionConfig, name: str, axis: str, rows: Rows) -> Tracking:
    (valid, position), (led, before) = rows, _response_at(segment, config, axis, rows[0])
    sensor, process = config.sensors[name], config.process[axis]
    of_sensor = math.hypot(sensor.sd_of(axis) or 0.0, sensor.bias_drift_sd_of(axis)) / abs(sensor.scale)
    noise = math.hypot(of_sensor, process.disturbance_sd)
    zero_sd = math.hypot(noise, sensor.bias_sd_of(axis) / abs(sensor.scale), config.start.offset_sd_of(axis))
    measured, turn = position - segment.start[axis], turn_of(config, name, axis) / abs(sensor.scale)
    if turn:
        measured -= turn * round(median(measured - led) / turn)
    return Tracking((valid - valid[0]) / 1e9, measured, led, before, noise, zero_sd, process.drift)


def _find_offsets(segment: Segment, config: FusionConfig, trackings: _Trackings) -> list[Fault]:
    """A fault for each sensor that is off by a constant; of all sensors of an axis one, on the commands."""
    off = {
        name: {axis: tracking.zero for axis, tracking in of_sensor.items() if tracking.zero}
        for name, of_sensor in trackings.items()
    }
    faults = list[Fault]()
    for name, zeros in off.items():
        alone: dict[str, float] = {}
        for axis, zero in zeros.items():
            measuring = [other for other, axes in trackings.items() if axis in axes and axes[axis].excludes(zero)]
            alike = [name for name in measuring if math.isclose(off[name].get(axis, 0.0), zero, rel_tol=_ALIKE_SIZE)]
            if len(alike) < len(measuring) or len(alike) == 1:
                alone[axis] = zero
            elif name == alike[0]:
                faults.append(Fault(tuple(alike), (axis,), "zero", zero, _common_zero_words(config, axis, zero, alike)))
        if scaled := [axis for axis in alone if _is_scaled(trackings[name][axis], segment.start[axis])]:
            scale = median(np.array([trackings[name][axis].slope for axis in scaled]))
            faults.append(Fault((name,), tuple(scaled), "unit", scale, _scale_words(config, name, scaled, scale)))
        if unscaled := {axis: zero for axis, zero in alone.items() if axis not in scaled}:
            largest = max(unscaled.values(), key=abs)
            faults.append(
                Fault((name,), tuple(unscaled), "zero", largest, _zero_words(config, name, unscaled, trackings[name]))
            )
    return faults


def _is_scaled(tracking: Tracking, start: float) -> bool:
    """Whether motion and zero are larger by one factor: that of positions, as by a wrong scale."""
    more = tracking.slope - 1.0
    return abs(more) > _ALIKE_SIZE / 2.0 and math.isclose(tracking.zero, more * start, rel_tol=_ALIKE_SIZE)


def _scale_words(config: FusionConfig, name: str, axes: Sequence[str], factor: float) -> str:
    scale = _digits(config.sensors[name].scale * factor, 3)
    return (
        f"sensor '{name}' measures {_digits(factor, 3)} times the position of {', '.join(axes)}: is the unit of its"
        f" columns another one, or its scale? scale = {scale} makes up for it"
    )


def _common_zero_words(config: FusionConfig, axis: str, zero: float, sensors: Sequence[str]) -> str:
    names, width = ", ".join(f"'{sensor}'" for sensor in sensors), _width(config, "offset_sd", {axis: zero})
    return (
        f"sensors {names} are {_length(config, axis, zero)} from where the commands lead {axis}, all the time: is the"
        f" zero of the commands another? Then give [start] {width}"
    )


def _zero_words(config: FusionConfig, name: str, zeros: Mapping[str, float], trackings: Mapping[str, Tracking]) -> str:
    offsets = ", ".join(
        f"{_length(config, axis, zero)} on {axis} (noise and priors:"
        f" {_length(config, axis, trackings[axis].zero_sd, '.2g')})"
        for axis, zero in zeros.items()
    )
    widths = _width(config, "bias_sd", zeros), _width(config, "offset_sd", zeros)
    return (
        f"sensor '{name}' is off from where the commands lead, all the time: by {offsets}; has it another zero?"
        f" Then give it {widths[0]}. Or have the commands? Then give [start] {widths[1]}"
    )


def _length(config: FusionConfig, axis: str, size: float, digits: str = "+.4g") -> str:
    """A distance on an axis, in the unit of screens."""
    screen = config.arm.screen_of(axis)
    return f"{size * screen.scale:{digits}} {screen.unit}"


def _width(config: FusionConfig, key: str, zeros: Mapping[str, float]) -> str:
    """The lines that give axes a prior as wide as their zeros, a key for each kind."""
    by_kind: dict[str, list[str]] = {}
    for axis, zero in zeros.items():
        screen = config.arm.screen_of(axis)
        width = f"{axis} = {_digits(abs(zero) * screen.scale, 1)}"
        by_kind.setdefault(f"{key}_{screen.unit}", []).append(width)
    return ", ".join(f"{key} = {{ {', '.join(widths)} }}" for key, widths in by_kind.items())


def _find_moving_alone(config: FusionConfig, trackings: _Trackings) -> list[Fault]:
    """A fault for each sensor that moves while the commands of its axis rest."""
    return [
        Fault(
            (name,),
            (axis,),
            "motion",
            tracking.own_motion,
            f"sensor '{name}' moves over {_length(config, axis, tracking.own_motion, '.3g')} on {axis}, whose commands"
            " rest: is it the right column of the commands?",
        )
        for name, of_sensor in trackings.items()
        for axis, tracking in of_sensor.items()
        if tracking.own_motion
    ]


# ---- a clock that was set in mid-run ---------------------------------------------------------------------------------


def _find_set_clocks(segment: Segment, config: FusionConfig, positions: _Positions, origin: int) -> list[Fault]:
    """A fault for each time that the clock of a sensor was set; ``origin`` [ns] is time 0."""
    clocks_set, rows = list[Fault](), segment.rows_by_sensor()
    for name, position in positions.items():
        latency = round(config.sensors[name].latency * 1e9)
        for step in find_clock_steps(segment, config.arm, rows[name].stamp - latency, position):
            at = step.leap.first + latency
            clocks_set.append(
                Fault((name,), tuple(position), "set", step.by, _clock_words(name, step, (at - origin) / 1e9), at=at)
            )
    return clocks_set


def _clock_words(name: str, step: ClockStep, at: float) -> str:
    """What shows that a clock was set, and what to do; rows that are stamped as they arrive leap with their latency."""
    leap, later, slower, more = (
        ("leap ahead", "later", "slower", "more") if step.by > 0.0 else ("step back", "earlier", "faster", "less")
    )
    return (
        f"sensor '{name}': its stamps {leap} by {abs(step.by):.3f} s at {at:.2f} s, and"
        f" from there on it follows the commands {abs(step.change):.3f} s {later} than before: was its clock set, or is"
        f" it {slower} since? Correct its stamps, or use parts (--to, --from), with {abs(step.by) * 1e3:.0f} {more}"
        " latency_ms in the later one"
    )


# ---- a sensor that does not follow ----------------------------------------------------------------------------------


def _find_not_following(
    segment: Segment, config: FusionConfig, positions: _Positions, trackings: _Trackings
) -> list[Fault]:
    faults = _find_turned_frames(segment, config, positions, trackings)
    turned = {name for fault in faults for name in fault.sensors}
    for name, of_sensor in trackings.items():
        if name in turned:
            continue
        if odd := [axis for axis, tracking in of_sensor.items() if not tracking.follows]:
            grid = _busiest(segment, config.arm.update_period)
            causes = _matches(segment, config, {axis: positions[name][axis] for axis in of_sensor}, grid)
            faults += _find_faults(
                config, name, of_sensor, {axis: causes[axis] for axis in odd}, grid.margin * grid.step
            )
    return _merge_faults(faults, trackings)


def _matches(segment: Segment, config: FusionConfig, positions: Mapping[str, Rows], grid: Grid) -> dict[str, Match]:
    """What explains the motion that a sensor measures on each axis, without single outliers."""
    led = {axis: segment.response(config.arm, axis, grid.time) for axis in segment.axes}
    measured: dict[str, FloatArray] = {}
    for axis, (valid, position) in positions.items():
        alike = without_spikes(position)
        measured[axis] = grid.mean(valid[alike], position[alike] - segment.start[axis])
    return matches(measured, led, grid)


def _busiest(segment: Segment, period: float) -> Grid:
    """The bins of a segment; of a long one those of the part in which most is commanded, all axes having one weight."""
    first, last = int(segment.commands[0]), int(segment.commands[-1]) + _TAIL_NS
    length, travelled = Grid.longest(period), np.zeros(1)
    count = 1 + (last - first) // length
    for axis in segment.axes if count > 1 else ():
        stamp, command = segment.commands_of(axis)
        steps = np.abs(np.diff(command, prepend=command[0]))
        share = np.bincount((stamp - first) // length, weights=steps, minlength=count)
        travelled = travelled + share / max(float(steps.sum()), 1e-30)
    begin = first + int(np.argmax(travelled)) * length
    return Grid.over(begin, min(begin + length, last), period)


def _find_faults(
    config: FusionConfig, name: str, trackings: Mapping[str, Tracking], causes: Mapping[str, Match], searched: float
) -> list[Fault]:
    """The faults of one sensor, from what explains its motion on the axes that it does not follow.

    Shifts were ``searched`` up to so many seconds.
    """
    faults: list[Fault] = []

    def fault(axes: Sequence[str], cause: _Cause, size: float, words: str, refused: bool = False) -> None:
        lost = cause == "nothing" or any(trackings[axis].correlation < _LOST for axis in axes)
        lost |= cause == "unit" and not 1.0 / _SCALE < size < _SCALE
        faults.append(Fault((name,), tuple(axes), cause, size, f"sensor '{name}' {words}", refused, lost))

    clear = {axis: cause for axis, cause in causes.items() if _is_clear(axis, cause, trackings[axis])}
    if late := [axis for axis, cause in clear.items() if cause.shift != 0.0]:
        best = max(late, key=lambda axis: clear[axis].correlation)
        fault(
            list(trackings), "clock", clear[best].shift, _late_words(config, name, best, trackings[best], clear[best])
        )
    if exchanged := [axis for axis, cause in clear.items() if cause.axis != axis]:
        others = [clear[axis].axis for axis in exchanged if clear[axis].axis in trackings]
        both = list(dict.fromkeys([*exchanged, *others]))
        fault(both, "columns", 1.0, _exchange_words({axis: (trackings[axis], clear[axis]) for axis in exchanged}))
    on_axis = {axis: cause for axis, cause in clear.items() if cause.axis == axis}
    if turned := [axis for axis, cause in on_axis.items() if cause.slope < 0.0]:
        fault(turned, "sign", -1.0, _sign_words(config, name, turned, on_axis, len(trackings)))
    for axis, match in on_axis.items():
        size = abs(match.slope)
        if not 1.0 / GAIN < size < GAIN:
            refused, words = _unit_words(config.arm.axes[axis].kind, size)
            times, correlation = _digits(size, 3), f"{match.correlation:+.3f}"
            moves = f"moves {times} times as far as the commands of {axis} (correlation {correlation}): {words}"
            fault([axis], "unit", size, moves, refused)
    faulty = {axis for fault in faults for axis in fault.axes}
    odd = {axis: trackings[axis] for axis in causes if axis not in faulty and abs(causes[axis].correlation) < _LOST}
    if lost := {axis: cause for axis, cause in odd.items() if cause.lacks_motion}:
        fault(list(lost), "nothing", 1.0, _nothing_words(lost, searched))
    return faults


def _is_clear(axis: str, cause: Match, tracking: Tracking) -> bool:
    """Whether what explains a motion does so well: two causes at once must do better, another time better than now."""
    other_size = not 1.0 / GAIN < abs(cause.slope) < GAIN
    causes = (cause.axis != axis) + (cause.shift != 0.0) + (cause.slope < 0.0) + other_size
    least = max(FOLLOWS if causes > 1 else _CLEAR, tracking.correlation if cause.shift else 0.0)
    return cause.is_steady and abs(cause.correlation) >= least


def _late_words(config: FusionConfig, name: str, axis: str, tracking: Tracking, cause: Match) -> str:
    side, latency = ("late" if cause.shift > 0.0 else "early"), config.sensors[name].latency + cause.shift
    return (
        f"is {abs(cause.shift):.2f} s {side}: it follows the commands of {axis} with a correlation of"
        f" {tracking.correlation:+.3f} as stamped, of {cause.correlation:+.3f} when shifted by that; are both stamped"
        f" by one clock? latency_ms = {latency * 1e3:.0f} makes up for it, but for the last ms"
    )


def _exchange_words(matches: Mapping[str, tuple[Tracking, Match]]) -> str:
    follows = [
        f"on {axis} the commands of {cause.axis} (correlation {cause.correlation:+.3f}, with those of {axis}"
        f" {tracking.correlation:+.2f})"
        for axis, (tracking, cause) in matches.items()
    ]
    return f"follows {' and '.join(follows)}: are its columns exchanged in run.toml?"


def _sign_words(
    config: FusionConfig, name: str, axes: Sequence[str], causes: Mapping[str, Match], measured: int
) -> str:
    correlation = min(causes[axis].correlation for axis in axes)
    scale = f" scale = {-config.sensors[name].scale:g} turns it;" if len(axes) == measured else ""
    return (
        f"moves against the commands of {', '.join(axes)} (correlation {correlation:+.3f}):{scale} is it a distance"
        " that falls, or is the sign of a column wrong?"
    )


def _unit_words(kind: Kind, factor: float) -> tuple[bool, str]:
    """Whether a factor is one between units that columns may have, and a question about its cause."""
    pairs = mistaken(factor, OF_KIND[kind])
    if not pairs:
        return False, "is its scale in fusion.toml right, or a unit?"
    taken = " or ".join(f"{true} called {called}" for true, called in pairs)
    is_likely = any(f"_{true}" in GUESSED[kind] for true, _ in pairs)
    return is_likely, f"are its values {taken}, or the commands the reverse? Correct the unit in run.toml, or the scale"


def _digits(number: float, count: int) -> str:
    """A number to so many digits, without an exponent where it is about 1000."""
    return f"{float(f'{number:.{count}g}'):g}"


def _nothing_words(trackings: Mapping[str, Tracking], searched: float) -> str:
    rests = "rests and " if all(tracking.rests for tracking in trackings.values()) else ""
    axes = ", ".join(
        f"{axis} (correlation {tracking.correlation:+.2f} with the model)" for axis, tracking in trackings.items()
    )
    return (
        f"{rests}does not follow the commands of {axes}, nor those of other axes or of up to {searched:.2g} s before or"
        " after: is it that axis of this run, are both stamped by one clock, is arm.toml of this arm?"
    )


def _merge_faults(faults: Sequence[Fault], trackings: _Trackings) -> list[Fault]:
    """The faults; one that all of several sensors of its axes have is reported once, as one of the commands."""
    of_commands: list[Fault] = []
    for fault in faults:
        alike = [other for other in faults if fault.is_like(other)]
        measuring = [name for name, of_sensor in trackings.items() if not of_sensor.keys().isdisjoint(fault.axes)]
        if len(alike) < max(len(measuring), 2) or fault.cause == "nothing":
            of_commands.append(fault)
        elif fault is alike[0]:
            names = [name for other in alike for name in other.sensors]
            others = ", ".join(f"'{name}'" for name in names[1:])
            sentence = f"{fault.sentence} ({others} too: is it the {fault.cause} of the commands? Else mend each)"
            of_commands.append(replace(fault, sensors=tuple(names), sentence=sentence))
    return of_commands


# ---- a sensor that is turned against its axes ------------------------------------------------------------------------


def _find_turned_frames(
    segment: Segment, config: FusionConfig, positions: _Positions, trackings: _Trackings
) -> list[Fault]:
    """The faults of sensors that see the commanded motion turned, by 3° or more."""
    faults = list[Fault]()
    for name, of_sensor in trackings.items():
        axes = [axis for axis in (CARTESIAN if "x" in of_sensor else CANONICAL_AXES) if axis in of_sensor]
        if len(axes) < 2 or (turned := _find_turned_frame(segment, config, positions[name], axes)) is None:
            continue
        angle, along, back = turned
        lengths = f"{_digits(back * MM, 2)} mm instead of {_digits(along * MM, 2)} mm"
        sentence = (
            f"sensor '{name}' looks turned by {angle * DEG:.1f}° against {', '.join(axes)}: turned back, its moves of a"
            f" second are within {lengths} of those commanded; `pumafuse register` finds how it stands, which is its"
            " frame in fusion.toml"
        )
        faults.append(Fault((name,), tuple(axes), "frame", angle, sentence, False, math.cos(angle) < _ALIGNED))
    return faults


def _find_turned_frame(
    segment: Segment, config: FusionConfig, positions: Mapping[str, Rows], axes: Sequence[str]
) -> tuple[float, float, float] | None:
    """How far a sensor is turned [rad], and how far its moves are from the response's as it is and turned back [m].

    None where it is not turned surely. Moves of a second are compared, as noise that wanders is no turn. Where the
    response is late is none either: its speed and a constant are fitted beside it.
    """
    valid = reduce(_common, (positions[axis][0] for axis in axes))
    valid = valid[:: 1 + len(valid) // _ENOUGH]
    if len(valid) < _FEW:
        return None
    each = (positions[axis] for axis in axes)
    value = np.column_stack([position[np.searchsorted(every, valid)] for every, position in each])
    alike = np.all([without_spikes(column) for column in value.T], axis=0)
    valid, value = valid[alike], value[alike]
    if len(valid) < _FEW:
        return None
    ends = [_response_at(segment, config, axis, valid) for axis in axes]
    led, before = (np.column_stack(part) for part in zip(*ends, strict=True))
    over = round(_MOVE / max(float(np.median(np.diff(valid))), 1.0))
    if not 1 <= over < len(valid) // _PARTS:
        return None
    value, led, before = (rows[over:] - rows[:-over] for rows in (value, led, before))
    parts = np.arange(len(value)) * _PARTS // len(value)
    turn, of_columns, along, back = _turn(value, led, led - before)
    angle = angle_of(turn)
    if angle < _TURNED or back > _STRAIGHTER * along or (math.cos(angle) < _ALIGNED and of_columns):
        return None
    others = np.array(
        [
            angle_of(turn.T @ _turn(*(rows[parts != part] for rows in (value, led, led - before))).rotation)
            for part in range(_PARTS)
        ]
    )
    scatter = math.sqrt((_PARTS - 1) / _PARTS * float(others @ others))
    return None if angle < _SURELY * scatter else (angle, along, back)


def _common(first: TimeArray, other: TimeArray) -> TimeArray:
    """The instants of both, once each; both are ascending, and not empty (``intersect1d`` imports numpy.ma)."""
    beside = other[np.searchsorted(other, first).clip(max=len(other) - 1)]
    return first[(beside == first) & (np.diff(first, prepend=first[:1] - 1) > 0)]


class _Turn(NamedTuple):
    """How measurements are turned against a response."""

    rotation: FloatArray  # (k, k)
    of_columns: bool  # whether each column is another one, or against one: also as a mirror, which no rotation is
    along: float  # RMS of what is left of the measurements along their axes [m]
    back: float  # and when they are turned back [m]


def _turn(value: FloatArray, led: FloatArray, step: FloatArray) -> _Turn:
    """The turn of measurements against a response; where that does not go, nothing tells of one: there it is none."""
    value, led, step = (np.asarray(rows - rows.mean(axis=0), dtype=np.float64) for rows in (value, led, step))
    regressors = np.hstack([led, step])
    seen = np.asarray(np.linalg.lstsq(regressors, value)[0], dtype=np.float64)[: led.shape[1]]  # value ≈ led · seen + …
    moved = led.T @ led
    turned = seen.T @ moved + _HARDLY * float(np.linalg.norm(moved, 2)) * np.eye(len(moved))
    rotation, (left, _, right) = nearest(turned), np.linalg.svd(turned)
    of_columns = bool((np.abs(left @ right).max(axis=0) > _EXCHANGED).all())

    def misfit(rotated: FloatArray) -> float:
        off = value - rotated
        late = np.asarray(np.linalg.lstsq(step, off)[0], dtype=np.float64)
        return math.sqrt(float(np.sum((off - step @ late) ** 2)) / len(off))

    return _Turn(rotation, of_columns, misfit(led), misfit(led @ rotation.T))


# ---- a begin in mid-motion, a latency below 0 ---------------------------------------------------------


def _first_speed(segment: Segment, axis: str) -> float:
    """The commanded speed [m/s] that a segment begins with; 0 where its first steps are not alike."""
    stamp, command = (part[: _ALIKE + 1] for part in segment.commands_of(axis))
    steps = np.diff(command)
    if len(steps) < _ALIKE or command[0] != segment.start[axis]:
        return 0.0
    if np.abs(steps - steps.mean()).max() > _UNEQUAL * abs(steps.mean()):
        return 0.0
    return float(command[-1] - command[0]) / (int(stamp[-1] - stamp[0]) / 1e9)


def settling_time(config: FusionConfig, axis: str) -> float:
    """How long the model of an axis remembers where it began [s]."""
    return config.arm.delay_of(axis) + _SETTLED * config.arm.axes[axis].plant.lag


def _evidence(
    segment: Segment, config: FusionConfig, axis: str, speed: float, positions: _Positions
) -> tuple[float, float]:
    """Score and information on the share of a motion at ``speed`` [m/s] that was there before the first command.

    What such a motion adds to one from rest is fitted to the measurements until the model has settled, beside a
    constant of each sensor. Score over information is the share, 1/√information its standard deviation.
    """
    model, delay, period = config.arm.axes[axis], config.arm.delay_of(axis), config.arm.update_period
    until, score, information = settling_time(config, axis), 0.0, 0.0
    (stamp, command), start = segment.commands_of(axis), segment.start[axis]
    before = np.arange(-min(int(until / period) + 1, _MOST), 0.0)
    earlier = np.concatenate([stamp[0] + np.rint(before * (period * 1e9)).astype(np.int64), stamp])
    moving = np.concatenate([start + before * (period * speed), command])
    for name, (valid, position) in ((name, axes[axis]) for name, axes in positions.items() if axis in axes):
        count = int(np.searchsorted(valid, int(stamp[0]) + round(until * 1e9), side="right"))
        if count < _FEWEST:
            continue
        sensor, valid = config.sensors[name], valid[:count]
        at_rest = start + response(model, period, delay, stamp, command, start, valid)
        added = moving[0] + response(model, period, delay, earlier, moving, float(moving[0]), valid) - at_rest
        added -= added.mean()
        left = position[:count] - at_rest
        left -= left.mean()
        along, size = float(added @ left), max(float(added @ added), 1e-30)
        noise = max((sensor.sd_of(axis) or 0.0) / abs(sensor.scale), float(np.std(left - added * (along / size))))
        score, information = score + along / noise**2, information + size / noise**2
    return score, information
