"""The filter's arrays from ``fusion.toml``: what is known of axes and sensors, and the state at rest."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from typing import NamedTuple

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
    REVERTING,
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


class Column(NamedTuple):
    """One axis of a filter: of several configurations of one axis, each has its own.

    Attributes:
        config: Arm, noise and sensors.
        axis: Its name.
        biased: The sensors whose bias is in its state, in the state's order.
    """

    config: FusionConfig
    axis: str
    biased: Sequence[str]

    def rest(self) -> tuple[FloatArray, list[tuple[str, bool]]]:
        """The states behind the offset.

        Returns:
            How fast each reverts [1/s] and its variance at the start [m²], (k, 2); of which
            sensor each of the last ones is a bias, and whether that is constant.
        """
        axis, process = self.axis, self.config.process[self.axis]
        found, owners = list[tuple[float, float]](), list[tuple[str, bool]]()
        if self.disturbance == SMOOTH:
            rate, variance = math.sqrt(3.0) / process.disturbance_time, process.disturbance_sd**2
            found += [(rate, variance), (rate, rate * rate * variance)]
        elif self.disturbance == ROUGH:
            found.append((1.0 / process.disturbance_time, process.disturbance_sd**2))
        for name in self.biased:
            sensor = self.config.sensors[name]
            drifting, constant = sensor.bias_drift_sd_of(axis), sensor.bias_sd_of(axis)
            if drifting > 0.0:
                found.append((1.0 / sensor.bias_time, drifting**2))
                owners.append((name, False))
            if constant > 0.0:
                found.append((0.0, constant**2))
                owners.append((name, True))
        return np.array(found).reshape(-1, 2) if found else _NOTHING, owners

    @property
    def disturbance(self) -> int:
        """``NONE``, ``ROUGH`` or ``SMOOTH``."""
        process = self.config.process[self.axis]
        if process.disturbance_sd == 0.0:
            return NONE
        return SMOOTH if process.disturbance_kind == "matern" else ROUGH


def columns_of(config: FusionConfig, axes: Sequence[str], biases: Sequence[Sequence[str]]) -> list[Column]:
    """The axes of one configuration, each with its biased sensors."""
    return [Column(config, axis, biased) for axis, biased in zip(axes, biases, strict=True)]


def filter_model(columns: Sequence[Column]) -> Model:
    """What the filter knows of axes."""
    models = [one.config.arm.axes[one.axis] for one in columns]
    process = [one.config.process[one.axis] for one in columns]
    decays = [0.0 if model.gain_recovery is None else 1.0 / model.gain_recovery for model in models]
    rest = [one.rest()[0] for one in columns]
    table = np.zeros((len(columns), REST + max(map(len, rest), default=0), 2))
    kind, first = np.empty((len(columns), 4), dtype=np.int64), dict[Hashable, int]()
    gain = np.empty((len(columns), 4))
    for number, (one, model, decay, part) in enumerate(zip(columns, models, decays, rest, strict=True)):
        table[number, REST : REST + len(part)] = part
        gain[number] = model.gain.slope, model.gain.intercept, decay, one.config.arm.update_period
        errs = (model.gain.slope, model.gain.intercept) != (0.0, 1.0)
        answer = model.plant, errs, decay, one.disturbance, part[:, REVERTING].tobytes()
        order = 1 if isinstance(model.plant, FirstOrder) else 2
        kind[number] = order, one.disturbance, REST + len(part), first.setdefault(answer, number)
    return Model(
        kind=kind,
        constants=np.array([closed.constants(model.plant) for model in models]),
        rest=table,
        gain=gain,
        process=np.array([[p.input_noise, p.drift, p.maneuver_noise, p.maneuver_drift] for p in process]),
    )


def filter_sensors(columns: Sequence[Column], names: Sequence[str]) -> Sensors:
    """What the filter knows of sensors; those that are not configured have no sd.

    Args:
        columns: The axes; if of several configurations, with scales, wandering latencies and gates that are the same.
        names: The sensors, in order.
    """
    config = columns[0].config
    known = [config.sensors.get(name) for name in names]
    sd, turn = np.full((len(names), len(columns)), np.nan), np.zeros((len(names), len(columns)))
    bias = np.full((len(names), len(columns), 2), -1)
    for number, one in enumerate(columns):
        for row, name in enumerate(names):
            sensor = one.config.sensors.get(name)
            own = None if sensor is None else sensor.sd_of(one.axis)
            sd[row, number] = np.nan if own is None else own
            turn[row, number] = turn_of(one.config, name, one.axis)
        if one.biased:
            states, owners = one.rest()
            for place, (name, constant) in enumerate(owners, REST + len(states) - len(owners)):
                bias[names.index(name), number, int(constant)] = place
    return Sensors(
        scale=np.array([1.0 if one is None else one.scale for one in known]),
        sd=sd,
        latency_sd=np.array([0.0 if one is None else one.latency_sd for one in known]),
        gate=np.array([0.0 if one is None else one.gate for one in known]),
        gate_rows=np.array([one is None or one.gates_rows(config.arm) for one in known], dtype=np.bool_),
        bias=bias,
        turn=turn,
    )


def turn_of(config: FusionConfig, sensor: str, axis: str) -> float:
    """After which angle a sensor's measurements of an axis are the same again [rad]; 0: never."""
    known = config.sensors.get(sensor)
    return known.turn if known is not None and config.arm.axes[axis].kind == "angle" else 0.0


def at_rest(columns: Sequence[Column], sensors: int, origin: int, start: Mapping[str, float], places: int = 0) -> State:
    """The state before the first command: in equilibrium, certain of all but the offset and the biases.

    Args:
        columns: The axes.
        sensors: How many there are.
        origin: The first command, int64 ns.
        start: The level u₀ [m] of each axis where it is known.
        places: Room for how many checkpoints.
    """
    rest = [one.rest()[0] for one in columns]
    count, width = len(columns), REST + max(map(len, rest), default=0)
    rows = count * (1 + places) + 1
    P, drive = np.zeros((rows, width, width)), np.zeros((rows, 10))
    for number, one in enumerate(columns):
        P[number, OFFSET, OFFSET] = one.config.start.offset_sd_of(one.axis) ** 2
        for place, variance in enumerate(rest[number][:, VARIANCE], REST):
            P[number, place, place] = variance
        process = one.config.process[one.axis]
        drive[number, [START, NOISE, DRIFT]] = start.get(one.axis, np.nan), process.input_noise**2, process.drift**2
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
