"""Faults of sensors that show before anything is filtered: another zero, repeated values, a negative latency."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from ..arrays import FloatArray, TimeArray
from ..filter.outcome import Outcome
from ..model.response import response
from ..units import MM
from .config import FusionConfig
from .segments import Segment

_FEW = 30  # rows, or changes of a value, below which nothing is said
_ENOUGH = 500  # values that tell where a sensor is
_FAR = 5.0  # sds beyond which chance and priors are no explanation
_TAIL_NS = 1_000_000_000  # after the last command
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
    of_sensor = math.hypot(sensor.sd_of(axis) or 0.0, sensor.bias_sd, sensor.bias_drift_sd) / abs(sensor.scale)
    expected = math.hypot(config.start.offset_sd, walked, process.disturbance_sd, of_sensor)
    if abs(median) <= _FAR * max(spread, expected):
        return None
    return (
        f"sensor '{name}' is {median * MM:+.4g} mm from where the commands lead {axis}, all the time (noise and priors:"
        f" {expected * MM:.2g} mm): has it another zero? Give it bias_sd_mm, or say in run.toml where the arm starts"
    )


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
