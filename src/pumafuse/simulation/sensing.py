"""What a sensor makes of a motion: rows at its own rate, noisy, late, lost and wrong as its scenario says."""

from __future__ import annotations

import numpy as np

from ..arrays import BoolArray, FloatArray, TimeArray
from ..logs.run import Source
from .true_sensor import PerAxis, TrueSensor


def valid_times(sensor: TrueSensor, grid: TimeArray, rng: np.random.Generator) -> TimeArray:
    """The instants of the grid (int64 ns, even) at which the sensor measures, ascending, (rows,)."""
    end = grid[-1] / 1e9
    count = int(end * sensor.rate) + 1
    jitter = sensor.rate_jitter * rng.standard_normal(count)
    instant = (rng.random() + np.arange(count)) / sensor.rate + jitter
    nearest = np.unique(np.rint(instant * ((len(grid) - 1) / end)).astype(np.int64))
    return grid[nearest[(nearest >= 0) & (nearest < len(grid))]]


def measure(
    sensor: TrueSensor, name: str, valid: TimeArray, truth: dict[str, FloatArray], rng: np.random.Generator
) -> Source:
    """The rows that the log gets, in the order of their stamps.

    Args:
        sensor: What it does.
        name: For people.
        valid: When it measures, int64 ns, (rows,).
        truth: Positions then, in the coordinates that the sensor is logged in [m], (rows,) each.
        rng: Draws everything random of this sensor.
    """
    noises = rng.spawn(6)  # so that one kind of fault changes no other
    count, seconds = len(valid), valid / 1e9
    wrong = _outliers(sensor, count, list(truth), noises[1])
    values: dict[str, FloatArray] = {}
    for axis, position in truth.items():
        sd = sensor.sd[axis] if isinstance(sensor.sd, dict) else sensor.sd
        bias = _of(sensor.bias, axis) + sensor.bias_sd * noises[2].standard_normal()
        z = sensor.scale * position + bias + sd * noises[0].standard_normal(count) + wrong[axis]
        values[axis] = np.rint(z / sensor.quantisation) * sensor.quantisation if sensor.quantisation else z
    late = sensor.latency + sensor.latency_sd * noises[3].standard_normal(count)
    own_clock = (seconds + late) * (1.0 + sensor.clock_drift * 1e-6) + sensor.clock_offset
    kept = (noises[4].random(count) >= sensor.dropouts) & ~_silent(sensor, seconds, noises[5])
    stamp = np.rint(own_clock * 1e9).astype(np.int64)
    source = Source(stamp, values, name).rows(kept)
    return source.rows(np.argsort(source.stamp, kind="stable").astype(np.int64))


def _of(value: PerAxis, axis: str) -> float:
    return value.get(axis, 0.0) if isinstance(value, dict) else value


def _outliers(sensor: TrueSensor, count: int, axes: list[str], rng: np.random.Generator) -> dict[str, FloatArray]:
    """What is added to each row [m], by axis: 0 for most."""
    if sensor.outliers is None:
        return {axis: np.zeros(count) for axis in axes}
    wild = rng.random(count) < sensor.outliers.share
    found: dict[str, FloatArray] = {}
    for axis in axes:
        size = rng.uniform(sensor.outliers.smallest, sensor.outliers.largest, count)
        found[axis] = wild * size * rng.choice([-1.0, 1.0], count)
    return found


def _silent(sensor: TrueSensor, seconds: FloatArray, rng: np.random.Generator) -> BoolArray:
    """Rows within an outage or a burst of losses."""
    spans = list(sensor.outages)
    if sensor.bursts is not None and len(seconds):
        length = float(seconds[-1])
        starts = rng.uniform(0.0, length, rng.poisson(sensor.bursts.per_minute * length / 60.0))
        spans += [(start, start + sensor.bursts.length) for start in starts.tolist()]
    silent = np.zeros(len(seconds), dtype=np.bool_)
    for start, end in spans:
        silent |= (seconds >= start) & (seconds < end)
    return silent
