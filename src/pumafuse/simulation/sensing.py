"""Simulates the rows that a sensor logs of a motion: at its own rate, noisy, late, lost and wrong."""

from __future__ import annotations

import numpy as np

from ..arrays import BoolArray, FloatArray, TimeArray
from ..fusion.config import of_axis
from ..logs.run import Source
from . import reverting
from .true_sensor import TrueSensor


def valid_times(sensor: TrueSensor, grid: TimeArray, rng: np.random.Generator) -> TimeArray:
    """The instants of the even ``grid`` (int64 ns) at which the sensor measures, ascending, (rows,)."""
    end = grid[-1] / 1e9
    count = int(end * sensor.rate) + 1
    jitter = sensor.rate_jitter * rng.standard_normal(count)
    instant = (rng.random() + np.arange(count)) / sensor.rate + jitter
    nearest = np.unique(np.rint(instant * ((len(grid) - 1) / end)).astype(np.int64))
    return grid[nearest[(nearest >= 0) & (nearest < len(grid))]]


def measure(
    sensor: TrueSensor, name: str, valid: TimeArray, position: dict[str, FloatArray], rng: np.random.Generator
) -> Source:
    """The sensor's log, in the order of its stamps.

    It measures at ``valid`` instants, int64 ns, (rows,), true positions [m or rad] in the coordinates of its log.
    """
    noises = rng.spawn(7)  # so that one kind of fault changes no other
    count, seconds = len(valid), valid / 1e9
    outlier = _outliers(sensor, count, list(position), noises[1])
    values: dict[str, FloatArray] = {}
    for axis, true in position.items():
        sd, step = of_axis(sensor.sd, axis), of_axis(sensor.quantisation, axis)
        bias = of_axis(sensor.bias, axis) + of_axis(sensor.bias_sd, axis) * noises[2].standard_normal()
        if drift := of_axis(sensor.bias_drift_sd, axis):
            bias = bias + reverting.rough(valid, drift, sensor.bias_time, noises[6])
        z = sensor.scale * true + bias + sd * noises[0].standard_normal(count) + outlier[axis]
        values[axis] = np.rint(z / step) * step if step else z
    late = sensor.latency + sensor.latency_sd * noises[3].standard_normal(count)
    own_clock = (seconds + late) * (1.0 + sensor.clock_drift * 1e-6) + sensor.clock_offset
    logged = (noises[4].random(count) >= sensor.dropouts) & ~_lost(sensor, seconds, noises[5])
    source = Source(np.rint(own_clock * 1e9).astype(np.int64), values, name).rows(logged)
    return source.rows(np.argsort(source.stamp, kind="stable").astype(np.int64))


def _outliers(sensor: TrueSensor, count: int, axes: list[str], rng: np.random.Generator) -> dict[str, FloatArray]:
    """The error that is added to each row [m or rad], by axis: 0 for rows that are no outliers."""
    if sensor.outliers is None:
        return dict.fromkeys(axes, np.zeros(count))
    chosen = rng.random(count) < sensor.outliers.share
    errors: dict[str, FloatArray] = {}
    for axis in axes:
        size = rng.uniform(of_axis(sensor.outliers.smallest, axis), of_axis(sensor.outliers.largest, axis), count)
        errors[axis] = chosen * size * rng.choice([-1.0, 1.0], count)
    return errors


def _lost(sensor: TrueSensor, seconds: FloatArray, rng: np.random.Generator) -> BoolArray:
    """Rows within an outage or a burst of losses."""
    spans = list(sensor.outages)
    if sensor.bursts is not None and len(seconds):
        length = float(seconds[-1])
        starts = rng.uniform(0.0, length, rng.poisson(sensor.bursts.per_minute * length / 60.0))
        spans += [(start, start + sensor.bursts.length) for start in starts.tolist()]
    lost = np.zeros(len(seconds), dtype=np.bool_)
    for start, end in spans:
        lost |= (seconds >= start) & (seconds < end)
    return lost
