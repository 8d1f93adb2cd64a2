"""The filter's arrays from ``fusion.toml``: what is known of axes and sensors, and the state at rest."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..arrays import ALWAYS, FloatArray
from ..filter.axis import (
    DRIFT,
    FIRST_REST,
    KEPT,
    NOISE,
    NONE,
    OFFSET,
    REST,
    ROUGH,
    SMOOTH,
    START,
    VARIANCE,
    Model,
    Sensors,
    State,
)
from ..model import closed
from ..model.plants import FirstOrder
from .config import FusionConfig

_NOTHING = np.zeros((0, 2))


def _rest(config: FusionConfig, axis: str, biased: Sequence[str]) -> tuple[FloatArray, list[tuple[str, bool]]]:
    """The states of an axis behind the offset.

    Returns:
        How fast each reverts [1/s] and its variance at the start [m²], (k, 2); of which
        sensor each of the last ones is a bias, and whether that is constant.
    """
    process, found, owners = config.process[axis], list[tuple[float, float]](), list[tuple[str, bool]]()
    if _disturbance(config, axis) == SMOOTH:
        rate, variance = math.sqrt(3.0) / process.disturbance_time, process.disturbance_sd**2
        found += [(rate, variance), (rate, rate * rate * variance)]
    elif _disturbance(config, axis) == ROUGH:
        found.append((1.0 / process.disturbance_time, process.disturbance_sd**2))
    for name in biased:
        sensor = config.sensors[name]
        drifting, constant = sensor.bias_drift_sd_of(axis), sensor.bias_sd_of(axis)
        if drifting > 0.0:
            found.append((1.0 / sensor.bias_time, drifting**2))
            owners.append((name, False))
        if constant > 0.0:
            found.append((0.0, constant**2))
            owners.append((name, True))
    return np.array(found).reshape(-1, 2) if found else _NOTHING, owners


def _disturbance(config: FusionConfig, axis: str) -> int:
    process = config.process[axis]
    if process.disturbance_sd == 0.0:
        return NONE
    return SMOOTH if process.disturbance_kind == "matern" else ROUGH


def filter_model(config: FusionConfig, axes: Sequence[str], biases: Sequence[Sequence[str]]) -> Model:
    """What the filter knows of axes.

    Args:
        config: Arm and noise.
        axes: Their names, in order.
        biases: For each axis the sensors whose bias is in its state, in the state's order.
    """
    models, process = [config.arm.axes[axis] for axis in axes], [config.process[axis] for axis in axes]
    decay = [0.0 if model.gain_recovery is None else 1.0 / model.gain_recovery for model in models]
    period = config.arm.update_period
    rest = [_rest(config, axis, biased)[0] for axis, biased in zip(axes, biases, strict=True)]
    table = np.zeros((len(axes), REST + max(map(len, rest), default=0), 2))
    for number, part in enumerate(rest):
        table[number, REST : REST + len(part)] = part
    return Model(
        kind=np.array(
            [
                (1 if isinstance(model.plant, FirstOrder) else 2, _disturbance(config, axis), REST + len(part))
                for axis, model, part in zip(axes, models, rest, strict=True)
            ]
        ),
        constants=np.array([closed.constants(model.plant) for model in models]),
        rest=table,
        gain=np.array([[m.gain.slope, m.gain.intercept, rate, period] for m, rate in zip(models, decay, strict=True)]),
        process=np.array([[p.input_noise, p.drift, p.maneuver_noise, p.maneuver_drift] for p in process]),
    )


def filter_sensors(
    config: FusionConfig, names: Sequence[str], axes: Sequence[str], biases: Sequence[Sequence[str]]
) -> Sensors:
    """What the filter knows of sensors; those that are not configured have no sd.

    Args:
        config: Their noise.
        names: The sensors, in order.
        axes: As in :func:`filter_model`.
        biases: As in :func:`filter_model`.
    """
    known = [config.sensors.get(name) for name in names]
    sd = [[np.nan if one is None or (own := one.sd_of(axis)) is None else own for axis in axes] for one in known]
    bias = np.full((len(names), len(axes), 2), -1)
    for number, (axis, biased) in enumerate(zip(axes, biases, strict=True)):
        states, owners = _rest(config, axis, biased)
        for place, (name, constant) in enumerate(owners, REST + len(states) - len(owners)):
            bias[names.index(name), number, int(constant)] = place
    return Sensors(
        scale=np.array([1.0 if one is None else one.scale for one in known]),
        sd=np.array(sd).reshape(bias.shape[:2]),
        latency_sd=np.array([0.0 if one is None else one.latency_sd for one in known]),
        gate=np.array([0.0 if one is None else one.gate for one in known]),
        gate_rows=np.array([one is None or one.gates_rows(config.arm) for one in known], dtype=np.bool_),
        bias=bias,
        turn=np.array([[turn_of(config, name, axis) for axis in axes] for name in names]).reshape(bias.shape[:2]),
    )


def turn_of(config: FusionConfig, sensor: str, axis: str) -> float:
    """After which angle a sensor's measurements of an axis are the same again [rad]; 0: never."""
    known = config.sensors.get(sensor)
    return known.turn if known is not None and config.arm.axes[axis].kind == "angle" else 0.0


def at_rest(
    config: FusionConfig,
    axes: Sequence[str],
    sensors: int,
    biases: Sequence[Sequence[str]],
    origin: int,
    start: Mapping[str, float],
    places: int = 0,
) -> State:
    """The state before the first command: in equilibrium, certain of all but the offset and the biases.

    Args:
        config: How uncertain the start is, and the noise at rest.
        axes: As in :func:`filter_model`.
        sensors: How many there are.
        biases: As in :func:`filter_model`.
        origin: The first command, int64 ns.
        start: The level u₀ [m] of each axis where it is known.
        places: Room for how many checkpoints.
    """
    rest = [_rest(config, axis, biased)[0] for axis, biased in zip(axes, biases, strict=True)]
    count, width = len(axes), REST + max(map(len, rest), default=0)
    rows = count * (1 + places) + 1
    P, drive = np.zeros((rows, width, width)), np.zeros((rows, 6))
    for number, axis in enumerate(axes):
        P[number, OFFSET, OFFSET] = config.start.offset_sd_of(axis) ** 2
        for place, variance in enumerate(rest[number][:, VARIANCE], REST):
            P[number, place, place] = variance
        process = config.process[axis]
        drive[number, [START, NOISE, DRIFT]] = start.get(axis, np.nan), process.input_noise**2, process.drift**2
    return State(
        x=np.zeros((rows, width)),
        P=P,
        clock=np.full(rows, origin),
        settled=np.full(rows, origin),
        drive=drive,
        rejected=np.zeros((rows, sensors, 2)),
        gate_time=np.full((rows, sensors, 2), ALWAYS),
        gate_count=np.zeros((rows, sensors, 2), dtype=np.int64),
        unsettled=np.full(rows, ALWAYS),
        work=np.zeros((count, 4, width)),
        intervals=np.zeros((count, KEPT, FIRST_REST + 2 * width)),
    )
