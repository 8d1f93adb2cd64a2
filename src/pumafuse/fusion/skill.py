"""Skill: how well a sensor's next measurement is predicted, without a reference; by the filter, and by simpler means.

Every predictor has the same measurements to predict: those that the filter decided on, rejected ones too, but for the
first of each segment, before which the others know nothing. All but the command alone know the sensor's earlier ones:

- the last one held;
- a constant-velocity filter of this sensor alone: white acceleration, no gate, the rate unknown at the start. What it
  predicts depends on the density of its noise over R alone: of eleven densities the one that, in hindsight, has the
  smallest RMS. It is a limit of our filter: see :mod:`pumafuse.model.matern`;
- the command alone: the arm's delay, plant and gain, and the sensor's scale. An unknown constant bias is the mean of
  what was left over at the earlier measurements that the gate let pass;
- the filter, by its innovations. It may know other sensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np

from .. import toml
from ..arrays import FloatArray, median
from ..filter.core import constant_velocity
from ..filter.outcome import Outcome
from ..units import nanoseconds
from .estimates import Estimates, Measurements
from .setup import turn_of

_DENSITIES = np.logspace(-8.0, 2.0, 11)  # of the acceleration, over R and the cube of the median interval


class PredictionError(toml.Reported, frozen=True, kw_only=True):
    """Errors of predicting a sensor's measurements [m or rad]: root mean square, and median of their sizes."""

    rms: float = msgspec.field(name="rms_mm")
    median: float = msgspec.field(name="median_mm")


class Skill(msgspec.Struct, frozen=True, kw_only=True):
    """How well a sensor's next measurement on one axis is predicted.

    Attributes:
        predictions: How many: those fused, rejected and re-acquired, without the first of each segment.
        last_held: By the measurement before it.
        constant_velocity: By a constant-velocity filter of this sensor, with the noise that is best in hindsight.
        command_alone: By the commands through the arm's delay, plant and gain.
        filter: By this filter, which may know other sensors.
    """

    predictions: int
    last_held: PredictionError
    constant_velocity: PredictionError
    command_alone: PredictionError
    filter: PredictionError

    @property
    def best_other(self) -> tuple[str, float]:
        """The simpler way with the smallest RMS error, in words, and that error [m or rad]."""
        ways = {
            "the last measurement": self.last_held,
            "a constant velocity": self.constant_velocity,
            "the command through the arm alone": self.command_alone,
        }
        return min(((words, way.rms) for words, way in ways.items()), key=lambda way: way[1])

    @property
    def of_best_other(self) -> float | None:
        """RMS of the filter's errors over the smallest of the others'; None where another makes no error."""
        best = self.best_other[1]
        return self.filter.rms / best if best > 0.0 else None


def skill(est: Estimates, measured: Measurements) -> Skill | None:
    """Errors of predicting the next measurement of a sensor on an axis; None with fewer than two in every segment."""
    predicted = np.isfinite(measured.innovation)
    parts = [measured.where(predicted & (measured.segment == number)) for number in range(len(est.segments))]
    parts = [part for part in parts if len(part.value) > 1]
    if not parts:
        return None
    sensor, axis = measured.sensors[int(measured.sensor[0])], measured.axes[int(measured.axis[0])]
    if turn := turn_of(est.config, sensor, axis):
        parts = [replace(part, value=np.unwrap(part.value, period=turn)) for part in parts]
    return Skill(
        predictions=sum(len(part.value) - 1 for part in parts),
        last_held=_summarise(np.concatenate([np.diff(part.value) for part in parts])),
        constant_velocity=_summarise(_by_constant_velocity(parts)),
        command_alone=_summarise(np.concatenate([_by_command(est, sensor, axis, part) for part in parts])),
        filter=_summarise(np.concatenate([part.innovation[1:] for part in parts])),
    )


def _summarise(error: FloatArray) -> PredictionError:
    return PredictionError(rms=float(np.sqrt(error @ error / len(error))), median=median(np.abs(error)))


def _by_command(est: Estimates, sensor: str, axis: str, measured: Measurements) -> FloatArray:
    """Measurements of one segment less what the commands say of them [m or rad], without the first, (n - 1,)."""
    configured, segment = est.config.sensors[sensor], est.segments[int(measured.segment[0])]
    time = est.origin + nanoseconds(measured.time)
    left = measured.value - configured.scale * (segment.start[axis] + segment.response(est.config.arm, axis, time))
    if turn := turn_of(est.config, sensor, axis):
        left = left - turn * round(float(left[0]) / turn)
    if configured.bias_sd_of(axis) == 0.0:
        return left[1:]
    passed = measured.outcome != Outcome.REJECTED
    bias = np.cumsum(np.where(passed, left, 0.0)) / np.maximum(np.cumsum(passed), 1)
    return left[1:] - bias[:-1]


def _by_constant_velocity(parts: Sequence[Measurements]) -> FloatArray:
    """Innovations [m or rad] of the best constant-velocity filter on each segment, without the first of each, (n,)."""
    intervals = np.concatenate([np.diff(part.time) for part in parts])
    unit = median(intervals[intervals > 0.0]) if (intervals > 0.0).any() else 1.0
    square, by_constant_velocity, end = np.zeros(len(_DENSITIES)), np.empty(len(intervals)), 0
    for part in parts:
        constant_velocity(part.time / unit, part.value, _DENSITIES, square)
    best = _DENSITIES[[np.argmin(square)]]
    for part in parts:
        begin, end = end, end + len(part.value) - 1
        constant_velocity(part.time / unit, part.value, best, np.zeros(1), by_constant_velocity[begin:end])
    return by_constant_velocity
