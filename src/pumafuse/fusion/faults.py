"""Faults of a log that show before anything is filtered: another zero, repeated values, a begin in mid-motion."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from ..arrays import FloatArray, TimeArray
from ..filter.outcome import Outcome
from ..model.response import response
from .config import FusionConfig, Sensor
from .segments import Segment

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


def sensor_faults(segment: Segment, config: FusionConfig) -> list[str]:
    """A sentence on each configured sensor that is off by a constant, or whose values come several times each."""
    found: list[str] = []
    for name, rows in segment.rows_by_sensor().items():
        if name not in config.sensors:
            continue
        known = rows.known == int(Outcome.FUSED)
        columns = [number for number in range(len(segment.axes)) if known[:, number].any()]
        times = max((_times_each(rows.value[known[:, column], column]) for column in columns), default=1)
        if times > 1:
            found.append(
                f"sensor '{name}' gives each value {times} times: a sample that is held? Each counts as a measurement"
                " of its own, at its own stamp; log each once"
            )
        for column in columns:
            mine = known[:, column] & (rows.stamp <= segment.commands[-1] + _TAIL_NS)
            off = _off(segment, config, name, segment.axes[column], rows.stamp[mine], rows.value[mine, column])
            found.extend([] if off is None else [off])
    return found


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


def _off(
    segment: Segment, config: FusionConfig, name: str, axis: str, stamp: TimeArray, value: FloatArray
) -> str | None:
    """A sentence if values [m], (n,), are where the commands do not lead, by the same distance throughout."""
    if len(value) < _FEW:
        return None
    some = slice(None, None, 1 + len(value) // _ENOUGH)
    stamp, value = stamp[some], value[some]
    sensor, process, model = config.sensors[name], config.process[axis], config.arm.axes[axis]
    start, (given, command) = segment.start[axis], segment.given(axis)
    valid = stamp - round(sensor.latency * 1e9)
    led = response(model, config.arm.update_period, config.arm.delay_of(axis), given, command, start, valid)
    distance = value / sensor.scale - start - led
    median = float(np.median(distance))
    spread = 1.4826 * float(np.median(np.abs(distance - median)))
    walked = process.drift * math.sqrt(float(valid[-1] - valid[0]) / 1e9)
    of_sensor = _sd_and_bias(sensor, axis) / abs(sensor.scale)
    expected = math.hypot(config.start.offset_sd_of(axis), walked, process.disturbance_sd, of_sensor)
    if abs(median) <= _FAR * max(spread, expected):
        return None
    screen = config.arm.screen_of(axis)
    return (
        f"sensor '{name}' is {median * screen.scale:+.4g} {screen.unit} from where the commands lead {axis}, all the"
        f" time (noise and priors: {expected * screen.scale:.2g} {screen.unit}): has it another zero? Give it"
        f" bias_sd_{screen.unit}, or say in run.toml where the arm starts"
    )


def _sd_and_bias(sensor: Sensor, axis: str) -> float:
    """Noise and biases of a sensor on one axis together [m or rad]."""
    return math.hypot(sensor.sd_of(axis) or 0.0, sensor.bias_sd_of(axis), sensor.bias_drift_sd_of(axis))


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
