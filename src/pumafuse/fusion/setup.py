"""The filter's arrays from ``fusion.toml``: what is known of axes and sensors, and the state at rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..arrays import ALWAYS
from ..filter.axis import BIASES, DRIFT, NOISE, OFFSET, START, Model, Sensors, State
from ..model import closed
from ..model.plants import FirstOrder
from .config import FusionConfig


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
    return Model(
        order=np.array([1 if isinstance(model.plant, FirstOrder) else 2 for model in models]),
        constants=np.array([closed.constants(model.plant) for model in models]),
        states=np.array([BIASES + len(biased) for biased in biases]),
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
    bias = np.full((len(names), len(axes)), -1)
    for number, biased in enumerate(biases):
        for place, name in enumerate(biased, BIASES):
            bias[names.index(name), number] = place
    return Sensors(
        scale=np.array([1.0 if one is None else one.scale for one in known]),
        sd=np.array(sd).reshape(bias.shape),
        latency_sd=np.array([0.0 if one is None else one.latency_sd for one in known]),
        gate=np.array([0.0 if one is None else one.gate for one in known]),
        gate_rows=np.array([one is None or one.gate_rows for one in known], dtype=np.bool_),
        bias=bias,
    )


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
    count, width = len(axes), BIASES + max((len(biased) for biased in biases), default=0)
    rows = count * (1 + places) + 1
    P, drive = np.zeros((rows, width, width)), np.zeros((rows, 6))
    for number, (axis, biased) in enumerate(zip(axes, biases, strict=True)):
        P[number, OFFSET, OFFSET] = config.start.offset_sd**2
        for place, name in enumerate(biased, BIASES):
            P[number, place, place] = config.sensors[name].bias_sd ** 2
        process = config.process[axis]
        drive[number, [START, NOISE, DRIFT]] = start.get(axis, np.nan), process.input_noise**2, process.drift**2
    return State(
        x=np.zeros((rows, width)),
        P=P,
        clock=np.full(rows, origin),
        drive=drive,
        rejected=np.zeros((rows, sensors, 2)),
        gate_time=np.full((rows, sensors, 2), ALWAYS),
        gate_count=np.zeros((rows, sensors, 2), dtype=np.int64),
        unsettled=np.full(rows, ALWAYS),
        work=np.zeros((4, width)),
    )
