"""Faults of a log that show before anything is filtered.

A sensor with another unit, axis, sign, clock or zero, repeated values, a begin in mid-motion.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from ..arrays import FloatArray, TimeArray
from ..discovery.matching import SMALL_SHIFT, Grid, Match, matches, slope_of_pieces, without_spikes
from ..errors import RunError
from ..filter.outcome import Outcome
from ..model.response import response
from ..units import OF_KIND, Kind, mistaken
from .config import FusionConfig
from .segments import Segment
from .setup import turn_of

_FEW = 30  # rows, or changes of a value, below which nothing is said
_ENOUGH = 500  # values that tell where a sensor is
_FAR = 5.0  # sds beyond which chance and priors are no explanation
_TAIL_NS = 1_000_000_000  # after the last command
_ALIKE, _UNEQUAL = 3, 0.3  # first steps, and how far they may be from their mean, over it
_SETTLED = 5.0  # lags of the plant
_MOVED = 0.5  # share of a motion
_FEWEST = 4  # measurements of a sensor
_MOST = 10_000  # commands before the first
_COARSE = 3.0  # typical over smallest change of a value: below it the sensor counts steps
_FOLLOWS, _CLEAR, _LOST = 0.95, 0.9, 0.5  # correlations: nothing to ask; a cause is clear; the commands do not show
_NOISY = 3.0  # times the noise, up to which a distance is noise
_GAIN, _SCALE = 3.0, 10.0  # factors on a motion up to which it may be a gain, or a scale that can be fitted
_ALIKE_SIZE = 0.2  # by how much, over it, the same fault of two sensors may differ

_Cause: TypeAlias = Literal["unit", "columns", "sign", "clock", "nothing"]


@dataclass(frozen=True)
class Fault:
    """Why a sensor, or all, are not where the commands lead.

    Attributes:
        sensors: Which; all that measure these axes if it is the commands that are wrong.
        axes: On which they are not.
        cause: What is wrong.
        size: How late they are [s], or how many times as far they move.
        sentence: What shows it, and what to write instead.
        refused: Whether estimates would be wrong by construction.
        lost: Whether they follow the commands so little that nothing can be fitted to them.
    """

    sensors: tuple[str, ...]
    axes: tuple[str, ...]
    cause: _Cause
    size: float
    sentence: str
    refused: bool
    lost: bool

    def is_like(self, other: Fault) -> bool:
        """Whether the other fault, also of another sensor, may come from the same commands."""
        alike = math.isclose(self.size, other.size, rel_tol=_ALIKE_SIZE, abs_tol=SMALL_SHIFT * (self.cause == "clock"))
        return self.cause == other.cause and alike and not set(self.axes).isdisjoint(other.axes)


def sensor_faults(segment: Segment, config: FusionConfig) -> list[str]:
    """A sentence on each configured sensor that does not follow, is off by a constant, or repeats its values.

    Raises:
        RunError: A sensor, or the commands, are in another unit than their name says.
    """
    given = _given(segment, config)
    paths = _paths(segment, config, given)
    faults = _not_following(segment, config, given, paths)
    if refused := [one.sentence for one in faults if one.refused]:
        raise RunError(refused[0])
    found, told = [one.sentence for one in faults], {name for one in faults for name in one.sensors}
    for name, axes in given.items():
        times = max((_times_each(value) for _, value in axes.values()), default=1)
        if times > 1:
            found.append(
                f"sensor '{name}' gives each value {times} times: a sample that is held? Each counts as a measurement"
                " of its own, at its own stamp; log each once"
            )
    off = [
        _off(config, name, axis, path)
        for name, mine in paths.items()
        if name not in told
        for axis, path in mine.items()
    ]
    return [*found, *(one for one in off if one is not None)]


def not_following(segment: Segment, config: FusionConfig) -> list[Fault]:
    """What is wrong with sensors whose measurements are not where the commands lead: unit, axis, sign or clock."""
    given = _given(segment, config)
    return _not_following(segment, config, given, _paths(segment, config, given))


def starts_in_motion(segment: Segment, config: FusionConfig) -> list[str]:
    """A sentence if the arm is in motion at the first command already, where the model has it at rest.

    That commands begin with a speed is not enough: an arm at rest may be commanded so. Measurements of the moving axes
    together must follow a motion that was there before, at least half of it, rather than one that begins.
    """
    speeds = {axis: speed for axis in segment.axes if (speed := _first_speed(segment, axis))}
    evidence = [_evidence(segment, config, axis, speed) for axis, speed in speeds.items()]
    score, information = sum(one[0] for one in evidence), sum(one[1] for one in evidence)
    if score <= _MOVED * information + 3.0 * math.sqrt(information):  # three standard deviations
        return []
    off = {axis: abs(speed) * config.arm.lag_of(axis, abs(speed)) for axis, speed in speeds.items()}
    most = max(off, key=off.__getitem__)
    screen = config.arm.screen_of(most)
    return [
        f"the run begins in motion ({speeds[most] * screen.scale:.3g} {screen.unit}/s on {most}), the model at rest:"
        f" estimates are wrong by up to {off[most] * screen.scale:.2g} {screen.unit} at first; record from rest, or use"
        f" --from"
        f" {max(_settled(config, axis) for axis in speeds):.2g} or later"
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


@dataclass(frozen=True)
class _Path:
    """Up to 500 positions that a sensor measures on an axis, and where the commands lead, relative to the start.

    Attributes:
        measured: [m or rad], (n,).
        led: [m or rad], (n,).
        before: Where the commands had led ``SMALL_SHIFT`` before each [m or rad], (n,).
        noise: Standard deviation of what varies [m or rad].
        expected: That of their distance, by all that is uncertain [m or rad].
    """

    measured: FloatArray
    led: FloatArray
    before: FloatArray
    noise: float
    expected: float

    @cached_property
    def distance(self) -> FloatArray:
        """From where the commands lead [m or rad], (n,)."""
        return self.measured - self.led

    @cached_property
    def median(self) -> float:
        """Of the distances [m or rad]."""
        return float(np.median(self.distance))

    @cached_property
    def spread(self) -> float:
        """Median distance from their median [m or rad]."""
        return float(np.median(np.abs(self.distance - self.median)))

    @cached_property
    def moved(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Measured and commanded motion without outliers, and that shortly before, about zero [m or rad], (k,) each.

        At rest all is near: what is off by no more than the motion, as a wrong delay makes it, is no outlier.
        """
        near = np.abs(self.distance - self.median) <= max(10.0 * self.spread, float(np.ptp(self.led))) + 1e-12
        measured, led, before = (part[near] - part[near].mean() for part in (self.measured, self.led, self.before))
        return measured, led, before

    @cached_property
    def correlation(self) -> float:
        """Of measured and commanded motion; 0 where one of them rests."""
        measured, led, _ = self.moved
        power = math.sqrt(float(measured @ measured) * float(led @ led))
        return float(measured @ led) / power if power > 0.0 else 0.0

    @property
    def follows(self) -> bool:
        """Whether there is nothing to ask: it moves about as far as commanded, about then, or is off by its noise."""
        measured, led, before = self.moved
        if float(np.std(measured - led)) <= _NOISY * self.noise:
            return True
        if self.correlation < _FOLLOWS:
            return False
        slope = float(measured @ led) / float(led @ led)
        left, step = measured - slope * led, led - before
        along, power = float(left @ step), max(float(step @ step), 1e-30)
        is_late = abs(along) > 0.5 * slope * power and along**2 > 0.5 * power * float(left @ left)
        return 1.0 / _GAIN < slope < _GAIN and not is_late

    @property
    def lacks_motion(self) -> bool:
        """Whether less than half of the commanded motion is there, by three standard errors."""
        measured, led, _ = self.moved
        slope, error = slope_of_pieces(measured, led)
        return slope + 3.0 * error < 0.5 and float(np.std(led)) > self.noise


_Given: TypeAlias = Mapping[str, Mapping[str, tuple[TimeArray, FloatArray]]]  # stamps and values, by sensor and axis
_Paths: TypeAlias = Mapping[str, Mapping[str, _Path]]


def _given(segment: Segment, config: FusionConfig) -> _Given:
    """What the filter is given of each configured sensor, by stamp."""
    found: dict[str, dict[str, tuple[TimeArray, FloatArray]]] = {}
    for name, rows in segment.rows_by_sensor().items():
        if name not in config.sensors:
            continue
        known = {axis: rows.known[:, number] == int(Outcome.FUSED) for number, axis in enumerate(segment.axes)}
        found[name] = {
            axis: (rows.stamp[mine], rows.value[:, number][mine])
            for number, (axis, mine) in enumerate(known.items())
            if mine.any()
        }
    return found


def _paths(segment: Segment, config: FusionConfig, given: _Given) -> _Paths:
    """The paths of each sensor until 1 s after the last command, without axes of which there is little."""
    found: dict[str, dict[str, _Path]] = {}
    for name, axes in given.items():
        found[name] = {}
        for axis, (stamp, value) in axes.items():
            count = int(np.searchsorted(stamp, int(segment.commands[-1]) + _TAIL_NS, side="right"))
            if count >= _FEW:
                some = slice(None, count, 1 + count // _ENOUGH)
                alike = without_spikes(value[some])
                found[name][axis] = _path(segment, config, name, axis, stamp[some][alike], value[some][alike])
    return found


def _path(segment: Segment, config: FusionConfig, name: str, axis: str, stamp: TimeArray, value: FloatArray) -> _Path:
    sensor, process = config.sensors[name], config.process[axis]
    valid = stamp - round(sensor.latency * 1e9)
    both = np.concatenate([valid, valid - round(SMALL_SHIFT * 1e9)])
    order, position = np.argsort(both), np.empty(len(both))
    position[order] = _led(segment, config, axis, both[order])
    led, before = position[: len(valid)], position[len(valid) :]
    of_sensor = math.hypot(sensor.sd_of(axis) or 0.0, sensor.bias_drift_sd_of(axis)) / abs(sensor.scale)
    walked = process.drift * math.sqrt((int(valid[-1]) - int(valid[0])) / 1e9)
    noise, bias = math.hypot(of_sensor, process.disturbance_sd), sensor.bias_sd_of(axis) / abs(sensor.scale)
    expected = math.hypot(noise, bias, config.start.offset_sd_of(axis), walked)
    measured, turn = value / sensor.scale - segment.start[axis], turn_of(config, name, axis) / abs(sensor.scale)
    if turn:
        measured -= turn * np.round(np.median(measured - led) / turn)
    return _Path(measured, led, before, noise, expected)


def _led(segment: Segment, config: FusionConfig, axis: str, time: TimeArray) -> FloatArray:
    """Where the commands lead an axis [m or rad], relative to its start, (n,)."""
    model, period, delay = config.arm.axes[axis], config.arm.update_period, config.arm.delay_of(axis)
    return response(model, period, delay, *segment.given(axis), segment.start[axis], time)


def _off(config: FusionConfig, name: str, axis: str, path: _Path) -> str | None:
    """A sentence if a sensor is where the commands do not lead, by the same distance throughout."""
    if abs(path.median) <= _FAR * max(1.4826 * path.spread, path.expected):
        return None
    screen = config.arm.screen_of(axis)
    width = _digits(abs(path.median) * screen.scale, 1)
    return (
        f"sensor '{name}' is {path.median * screen.scale:+.4g} {screen.unit} from where the commands lead {axis}, all"
        f" the time (noise and priors: {path.expected * screen.scale:.2g} {screen.unit}): has it another zero? Give it"
        f" bias_sd_{screen.unit} = {width}, or say in run.toml where the arm starts"
    )


# ---- a sensor that does not follow ----------------------------------------------------------------------------------


def _not_following(segment: Segment, config: FusionConfig, given: _Given, paths: _Paths) -> list[Fault]:
    found: list[Fault] = []
    for name, mine in paths.items():
        if odd := [axis for axis, path in mine.items() if not path.follows]:
            causes = _matches(segment, config, name, {axis: given[name][axis] for axis in mine})
            found += _faults(config, name, mine, {axis: causes[axis] for axis in odd})
    return _of_commands(found, paths)


def _matches(
    segment: Segment, config: FusionConfig, name: str, given: Mapping[str, tuple[TimeArray, FloatArray]]
) -> dict[str, Match]:
    """What explains the motion that a sensor measures on each axis, without single outliers."""
    sensor, grid = config.sensors[name], _busiest(segment, config.arm.update_period)
    led = {axis: _led(segment, config, axis, grid.time) for axis in segment.axes}
    measured: dict[str, FloatArray] = {}
    for axis, (stamp, value) in given.items():
        alike = without_spikes(value)
        valid = stamp[alike] - round(sensor.latency * 1e9)
        measured[axis] = grid.mean(valid, value[alike] / sensor.scale - segment.start[axis])
    return matches(measured, led, grid)


def _busiest(segment: Segment, period: float) -> Grid:
    """The bins of a segment; of a long one those of the part in which most is commanded, all axes having one weight."""
    first, last = int(segment.commands[0]), int(segment.commands[-1]) + _TAIL_NS
    length, travelled = Grid.longest(period), np.zeros(1)
    count = 1 + (last - first) // length
    for axis in segment.axes if count > 1 else ():
        stamp, command = segment.given(axis)
        steps = np.abs(np.diff(command, prepend=command[0]))
        share = np.bincount((stamp - first) // length, weights=steps, minlength=count)
        travelled = travelled + share / max(float(steps.sum()), 1e-30)
    begin = first + int(np.argmax(travelled)) * length
    return Grid.over(begin, min(begin + length, last), period)


def _faults(config: FusionConfig, name: str, paths: Mapping[str, _Path], causes: Mapping[str, Match]) -> list[Fault]:
    """The faults of one sensor, from what explains its motion on the axes that it does not follow."""
    found: list[Fault] = []

    def fault(axes: Sequence[str], cause: _Cause, size: float, words: str, refused: bool = False) -> None:
        lost = cause == "nothing" or any(paths[axis].correlation < _LOST for axis in axes)
        lost |= cause == "unit" and not 1.0 / _SCALE < size < _SCALE
        found.append(Fault((name,), tuple(axes), cause, size, f"sensor '{name}' {words}", refused, lost))

    clear = {axis: one for axis, one in causes.items() if _is_clear(axis, one, paths[axis])}
    if late := [axis for axis, one in clear.items() if one.shift != 0.0]:
        best = max(late, key=lambda axis: clear[axis].correlation)
        fault(list(paths), "clock", clear[best].shift, _late(config, name, best, paths[best], clear[best]))
    if exchanged := [axis for axis, one in clear.items() if one.axis != axis]:
        both = list(dict.fromkeys([*exchanged, *(clear[axis].axis for axis in exchanged if clear[axis].axis in paths)]))
        fault(both, "columns", 1.0, _exchanged({axis: (paths[axis], clear[axis]) for axis in exchanged}))
    own = {axis: one for axis, one in clear.items() if one.axis == axis}
    if turned := [axis for axis, one in own.items() if one.slope < 0.0]:
        fault(turned, "sign", -1.0, _turned(config, name, turned, own, len(paths)))
    for axis, one in own.items():
        size = abs(one.slope)
        if not 1.0 / _GAIN < size < _GAIN:
            refused, words = _unit(config.arm.axes[axis].kind, size)
            times, correlation = _digits(size, 3), f"{one.correlation:+.3f}"
            moves = f"moves {times} times as far as the commands of {axis} (correlation {correlation}): {words}"
            fault([axis], "unit", size, moves, refused)
    told = {axis for one in found for axis in one.axes}
    for axis in causes:
        if axis not in told and abs(causes[axis].correlation) < _LOST and paths[axis].lacks_motion:
            fault([axis], "nothing", 1.0, _nothing(axis, paths[axis]))
    return found


def _is_clear(axis: str, cause: Match, path: _Path) -> bool:
    """Whether what explains a motion does so well: two causes at once must do better, another time better than now."""
    other_size = not 1.0 / _GAIN < abs(cause.slope) < _GAIN
    causes = (cause.axis != axis) + (cause.shift != 0.0) + (cause.slope < 0.0) + other_size
    least = max(_FOLLOWS if causes > 1 else _CLEAR, path.correlation if cause.shift else 0.0)
    return cause.is_steady and abs(cause.correlation) >= least


def _late(config: FusionConfig, name: str, axis: str, path: _Path, cause: Match) -> str:
    side, latency = ("late" if cause.shift > 0.0 else "early"), config.sensors[name].latency + cause.shift
    return (
        f"is {abs(cause.shift):.2f} s {side}: it follows the commands of {axis} with a correlation of"
        f" {path.correlation:+.3f} as stamped, of {cause.correlation:+.3f} when shifted by that; are both stamped by"
        f" one clock? latency_ms = {latency * 1e3:.0f} makes up for it"
    )


def _exchanged(found: Mapping[str, tuple[_Path, Match]]) -> str:
    follows = [
        f"on {axis} the commands of {cause.axis} (correlation {cause.correlation:+.3f}, with those of {axis}"
        f" {path.correlation:+.2f})"
        for axis, (path, cause) in found.items()
    ]
    return f"follows {' and '.join(follows)}: are its columns exchanged in run.toml?"


def _turned(config: FusionConfig, name: str, axes: Sequence[str], causes: Mapping[str, Match], measured: int) -> str:
    correlation = min(causes[axis].correlation for axis in axes)
    scale = f" scale = {-config.sensors[name].scale:g} turns it;" if len(axes) == measured else ""
    return (
        f"moves against the commands of {', '.join(axes)} (correlation {correlation:+.3f}):{scale} is it a distance"
        " that falls, or is the sign of a column wrong?"
    )


def _unit(kind: Kind, factor: float) -> tuple[bool, str]:
    """Whether a factor is one between units that columns may have, and a question about its cause."""
    pairs = mistaken(factor, OF_KIND[kind])
    if not pairs:
        return False, "is its scale in fusion.toml right, or a unit?"
    taken = " or ".join(f"{true} called {called}" for true, called in pairs)
    if any(f"_{true}" in OF_KIND[kind] for true, _ in pairs):
        return True, f"are its values {taken}, or the commands the reverse? Correct the unit in run.toml, or the scale"
    return False, f"are its values {taken}, or is its scale in fusion.toml another one?"


def _digits(number: float, count: int) -> str:
    """A number to so many digits, without an exponent where it is about 1000."""
    return f"{float(f'{number:.{count}g}'):g}"


def _nothing(axis: str, path: _Path) -> str:
    rests = "" if np.ptp(path.measured) > 0.0 else "rests and "
    return (
        f"{rests}does not follow the commands of {axis} (correlation {path.correlation:+.2f}), nor those of"
        " another axis or another time: is it that axis, are both stamped by one clock, is arm.toml that of this arm?"
    )


def _of_commands(faults: Sequence[Fault], paths: _Paths) -> list[Fault]:
    """The faults; one that all of several sensors of its axes have is told once, as one of the commands."""
    found: list[Fault] = []
    for one in faults:
        alike = [other for other in faults if one.is_like(other)]
        measuring = [name for name, mine in paths.items() if not mine.keys().isdisjoint(one.axes)]
        if len(alike) < max(len(measuring), 2) or one.cause == "nothing":
            found.append(one)
        elif one is alike[0]:
            names = [name for other in alike for name in other.sensors]
            others = ", ".join(f"'{name}'" for name in names[1:])
            sentence = f"{one.sentence} ({others} too: is it the {one.cause} of the commands?)"
            found.append(replace(one, sensors=tuple(names), sentence=sentence))
    return found


# ---- a begin in mid-motion, held samples, a latency below 0 ---------------------------------------------------------


def _first_speed(segment: Segment, axis: str) -> float:
    """The commanded speed [m/s] that a segment begins with; 0 where its first steps are not alike."""
    given, command = (part[: _ALIKE + 1] for part in segment.given(axis))
    steps = np.diff(command)
    if len(steps) < _ALIKE or command[0] != segment.start[axis]:
        return 0.0
    if np.abs(steps - steps.mean()).max() > _UNEQUAL * abs(steps.mean()):
        return 0.0
    return float(command[-1] - command[0]) / (int(given[-1] - given[0]) / 1e9)


def _settled(config: FusionConfig, axis: str) -> float:
    """How long the model of an axis remembers where it began [s]."""
    return config.arm.delay_of(axis) + _SETTLED * config.arm.axes[axis].plant.lag


def _evidence(segment: Segment, config: FusionConfig, axis: str, speed: float) -> tuple[float, float]:
    """Score and information on the share of a motion at ``speed`` [m/s] that was there before the first command.

    What such a motion adds to one from rest is fitted to the measurements until the model has settled, beside a
    constant of each sensor. Score over information is the share, 1/√information its standard deviation.
    """
    model, delay, period = config.arm.axes[axis], config.arm.delay_of(axis), config.arm.update_period
    settled, column, score, information = _settled(config, axis), segment.axes.index(axis), 0.0, 0.0
    (given, command), start = segment.given(axis), segment.start[axis]
    before = np.arange(-min(int(settled / period) + 1, _MOST), 0.0)
    earlier = np.concatenate([given[0] + np.rint(before * (period * 1e9)).astype(np.int64), given])
    moving = np.concatenate([start + before * (period * speed), command])
    for name, rows in segment.rows_by_sensor().items():
        if (sensor := config.sensors.get(name)) is None:
            continue
        valid = rows.stamp - round(sensor.latency * 1e9)
        early = (rows.known[:, column] == int(Outcome.FUSED)) & (valid <= given[0] + round(settled * 1e9))
        if np.count_nonzero(early) < _FEWEST:
            continue
        valid, value = valid[early], rows.value[early, column] / sensor.scale
        rest = start + response(model, period, delay, given, command, start, valid)
        added = moving[0] + response(model, period, delay, earlier, moving, float(moving[0]), valid) - rest
        added -= added.mean()
        left = value - rest
        left -= left.mean()
        along, size = float(added @ left), max(float(added @ added), 1e-30)
        noise = max((sensor.sd_of(axis) or 0.0) / abs(sensor.scale), float(np.std(left - added * (along / size))))
        score, information = score + along / noise**2, information + size / noise**2
    return score, information


def _times_each(values: FloatArray) -> int:
    """How often each value of a sensor comes in a row, typically, if it holds its samples; else 1.

    Not at rest, where a long row of equal values is one row of many, and not where coarse steps repeat by themselves.
    """
    changes = np.flatnonzero(np.diff(values))
    if len(changes) < _FEW:
        return 1
    times = int(np.median(np.diff(changes)))
    if times > 1:
        steps = np.abs(np.diff(values)[changes])
        if np.median(steps) < _COARSE * steps.min():
            return 1
    return times
