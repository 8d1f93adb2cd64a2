"""A configuration with one thing different."""

from __future__ import annotations

import msgspec

from ..fusion.config import FusionConfig, Process, Sensor
from ..model.arm import AxisModel
from ..model.plants import FirstOrder, SecondOrder

_replace = msgspec.structs.replace


def with_axis(config: FusionConfig, axis: str, model: AxisModel) -> FusionConfig:
    """The configuration with another model of an axis."""
    return _replace(config, arm=_replace(config.arm, axes={**config.arm.axes, axis: model}))


def with_sensor(config: FusionConfig, name: str, sensor: Sensor) -> FusionConfig:
    """The configuration with another sensor of a name."""
    return _replace(config, sensors={**config.sensors, name: sensor})


def with_process(config: FusionConfig, axis: str, process: Process) -> FusionConfig:
    """The configuration with another process noise of an axis."""
    return _replace(config, process={**config.process, axis: process})


def with_sd(config: FusionConfig, name: str, axis: str, sd: float) -> FusionConfig:
    """The configuration with another noise of a sensor on one axis [m]."""
    sensor = config.sensors[name]
    every = sensor.sd if isinstance(sensor.sd, dict) else dict.fromkeys(config.arm.axes, sensor.sd)
    return with_sensor(config, name, _replace(sensor, sd={**every, axis: sd}))


def with_order(config: FusionConfig, axis: str, order: int) -> FusionConfig:
    """The configuration with an axis's plant of this order, which lags as far behind as before."""
    model = config.arm.axes[axis]
    if (1 if isinstance(model.plant, FirstOrder) else 2) == order:
        return config
    lag = model.plant.lag
    plant = FirstOrder(time_constant=lag) if order == 1 else SecondOrder(natural_frequency=2.0 / lag, damping=1.0)
    return with_axis(config, axis, _replace(model, plant=plant))


def with_recovery(config: FusionConfig, axis: str, recovery: float | None) -> FusionConfig:
    """The configuration with another recovery of an axis's gain [s], or none."""
    model = _replace(config.arm.axes[axis], gain_recovery=recovery, gain_recovery_ci95=None)
    return with_axis(config, axis, model)


def with_lag(config: FusionConfig, axis: str, lag: float) -> FusionConfig:
    """The configuration with an axis's plant so far behind an input of constant velocity [s], in the same shape."""
    model = config.arm.axes[axis]
    if isinstance(model.plant, FirstOrder):
        return with_axis(config, axis, _replace(model, plant=FirstOrder(time_constant=lag)))
    plant = _replace(model.plant, natural_frequency=2.0 * model.plant.damping / lag)
    return with_axis(config, axis, _replace(model, plant=plant))


def with_axis_of(config: FusionConfig, other: FusionConfig, axis: str) -> FusionConfig:
    """The configuration with all numbers of one axis as another has them: its model, its noise and its measurements'."""
    config = with_axis(config, axis, other.arm.axes[axis])
    for name, sensor in other.sensors.items():
        if isinstance(sensor.sd, dict) and axis in sensor.sd:
            config = with_sd(config, name, axis, sensor.sd[axis])
    return with_process(config, axis, other.process[axis])


def with_gates(config: FusionConfig, times: float) -> FusionConfig:
    """The configuration with gates so many times as wide, each component for itself."""
    sensors = {
        name: _replace(sensor, gate=times * sensor.gate, gate_rows=False) for name, sensor in config.sensors.items()
    }
    return _replace(config, sensors=sensors)


def with_gates_of(config: FusionConfig, other: FusionConfig) -> FusionConfig:
    """The configuration with the gates that another has."""
    sensors = {
        name: _replace(sensor, gate=other.sensors[name].gate, gate_rows=other.sensors[name].gate_rows)
        for name, sensor in config.sensors.items()
    }
    return _replace(config, sensors=sensors)
