"""The filter's numbers from ``fusion.toml``: what is known of axes and sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..filter.core import AXIS, SENSOR, VIEW, Model, Record
from ..filter.response import record_of
from ..model.arm import AxisModel
from ..toml import Interval
from .config import FusionConfig
from .score import Z95

_SMOOTHNESS = {"matern": 1.5, "ou": 0.5}


def filter_model(
    config: FusionConfig,
    axes: Sequence[str],
    names: Sequence[str],
    start: Mapping[str, float] | None = None,
    biased: Sequence[Sequence[str]] | None = None,
) -> Model:
    """What the filter knows of axes and sensors, in order; sensors that are not configured have no sd.

    ``start`` has the level u₀ [m] of each axis where it is known, ``biased`` for each the sensors whose bias is in its
    state; None: of no sensor.
    """
    return Model(_axes_of(config, axes, start or {}), *_sensors_of(config, axes, names, biased))


def _axes_of(config: FusionConfig, axes: Sequence[str], levels: Mapping[str, float]) -> Record:
    """What the filter knows of axes, (A,), with the level u₀ [m] of each where it is known."""
    arm, axis = config.arm, np.zeros(len(axes), AXIS)
    for number, name in enumerate(axes):
        process, model = config.process[name], arm.axes[name]
        axis[number] = record_of(model, arm.update_period, arm.delay_of(name), levels.get(name, np.nan))[0]
        record = axis[number]
        record["input_noise"], record["drift"] = process.input_noise, process.drift
        record["maneuver_noise"], record["maneuver_drift"] = process.maneuver_noise, process.maneuver_drift
        record["disturbance_sd"], record["disturbance_time"] = process.disturbance_sd, process.disturbance_time
        record["smoothness"] = _SMOOTHNESS[process.disturbance_kind]
        record["adaptation"] = process.adaptation
        record["offset_sd"] = config.start.offset_sd_of(name)
        by_interval = _sd_of(model.lag_ci95, arm.lag_of(name))
        record["lag_sd"] = by_interval if model.seen_lag_sd is None else model.seen_lag_sd
        record["gain_sd"], record["unseen_lag_sd"] = _gain_sd_of(model), model.unseen_lag_sd or 0.0
    return axis


def _sensors_of(
    config: FusionConfig, axes: Sequence[str], names: Sequence[str], biased: Sequence[Sequence[str]] | None
) -> tuple[Record, Record]:
    """What the filter knows of sensors, (S,), and of what each sees of axes, (S, A); biases as :func:`filter_model`."""
    sensor, view = np.zeros(len(names), SENSOR), np.zeros((len(names), len(axes)), VIEW)
    view["sd"], view["bias_time"], sensor["scale"] = np.nan, 1.0, 1.0
    for row, name in enumerate(names):
        entry = config.sensors.get(name)
        if entry is None:
            continue
        sensor[row] = entry.scale, entry.latency, entry.latency_sd, entry.gate, entry.gates_rows(config.arm)
        for number, axis in enumerate(axes):
            sd = entry.sd_of(axis)
            inside = biased is not None and name in biased[number]
            biases = (entry.bias_sd_of(axis), entry.bias_drift_sd_of(axis)) if inside else (0.0, 0.0)
            view[row, number] = np.nan if sd is None else sd, *biases, entry.bias_time, turn_of(config, name, axis)
    return sensor, view


def _sd_of(ci95: Interval | None, value: float) -> float:
    """The standard deviation that a 95 % interval stands for; an end that is open is as far as 0."""
    ends = (value, value) if ci95 is None else ci95
    return sum(abs(end - value) if math.isfinite(end) else abs(value) for end in ends) / (2.0 * Z95)


def _gain_sd_of(axis: AxisModel) -> float:
    """The standard deviation of the gain as a share of it; 0 of one that recovers: it makes a lag, no distance."""
    intercept = axis.gain.intercept
    if axis.gain_recovery is not None or intercept == 0.0:
        return 0.0
    return _sd_of(axis.gain.intercept_ci95, intercept) / abs(intercept)


def live_model(config: FusionConfig, start: Mapping[str, float] | None = None) -> Model:
    """What the filter of a stream knows: every bias is in the state, since nobody knows which sensors will measure."""
    axes, names = tuple(config.arm.axes), tuple(config.sensors)
    measured = [[name for name in names if config.sensors[name].sd_of(axis) is not None] for axis in axes]
    return filter_model(config, axes, names, start, measured)


def turn_of(config: FusionConfig, sensor: str, axis: str) -> float:
    """After which angle a sensor's measurements of an axis are the same again [rad]; 0: never."""
    configured = config.sensors.get(sensor)
    return configured.turn if configured is not None and config.arm.axes[axis].kind == "angle" else 0.0
