"""From a timeline to the compiled kernels' arrays and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..arrays import CodeArray, FloatArray, IntArray, TimeArray
from ..model import closed
from ..model.plants import FirstOrder
from . import kernels, run_kernels, smoother_kernels
from .config import FusionConfig, Sensor
from .estimates import Mode
from .timeline import AxisInput, Timeline
from .track import AxisEstimate, Bias, Fused


def fuse_compiled(timeline: Timeline, config: FusionConfig, times: TimeArray, mode: Mode) -> Fused:
    """Filter or smooth one timeline, with estimates at ``times`` (int64 ns, ascending, none before the origin)."""
    components, candidates = timeline.components, timeline.components.candidates
    axes, sensors, rows, state, biases = _arranged(timeline, config)
    count, width = len(timeline.axes), state.x.shape[1]
    met = kernels.Met(np.empty(len(candidates)), np.empty(len(candidates)), np.empty(len(candidates), dtype=np.uint8))
    outputs = kernels.Outputs(*(np.empty((count, len(times))) for _ in kernels.Outputs._fields))
    smooth = mode == "smoothed"
    kept = len(times) if smooth else 0
    held = kernels.Held(np.empty((count, kept, width)), np.empty((count, kept, width, width)), np.empty((count, kept)))
    log = _log(axes, rows, width) if smooth else _log(axes, None, width)
    if mode == "as-live":
        arrival = np.maximum(components.stamp[candidates[rows.first]], rows.valid)
        queue = np.argsort(arrival, kind="stable")
        back = int((np.maximum.accumulate(queue) - queue).max(initial=0)) + 2
        checkpoints = places(state, back)
        arrived = np.zeros(len(rows.valid), dtype=np.bool_)
        run_kernels.filter_as_live(
            axes, sensors, rows, arrival, queue, arrived, state, checkpoints, times, met, log, held, outputs
        )
    else:
        run_kernels.filter_run(axes, sensors, rows, state, times, met, log, held, outputs)
    if smooth:
        sensor_of = np.repeat(rows.sensor, rows.end - rows.first)
        room = (
            np.empty((2, width)),
            np.empty((2, width, width)),
            np.empty((4, width)),
            np.empty((width + 1, width)),
        )
        smoother_kernels.smooth_run(axes, sensors, sensor_of, met, log, timeline.origin, times, held, *room, outputs)
    outcome = components.outcome.copy()
    outcome[candidates] = met.outcome
    return Fused(
        {axis.name: _estimate(axis, outputs, number) for number, axis in enumerate(timeline.axes)},
        _among_all(met.innovation, candidates, len(components.value)),
        _among_all(met.innovation_sd, candidates, len(components.value)),
        outcome,
        _known_biases(timeline, axes, state, biases),
    )


def innovations(timeline: Timeline, config: FusionConfig, outcome: CodeArray | None = None) -> kernels.Met:
    """What each candidate component tells the filter, without any estimate; in the timeline's order.

    Args:
        timeline: The measurements.
        config: Arm, noise and sensors.
        outcome: What became of each in an earlier fusion, to be repeated whatever the gates would say; None: they say.
    """
    axes, sensors, rows, state, _ = _arranged(timeline, config)
    count, width = len(rows.axis), state.x.shape[1]
    log = _log(axes, None, width)
    if outcome is not None:
        met = kernels.Met(np.empty(count), np.empty(count), outcome.copy())
        run_kernels.replay(axes, sensors, rows, state, met, log)
        return met
    met = kernels.Met(np.empty(count), np.empty(count), np.empty(count, dtype=np.uint8))
    nothing, none = np.empty((len(timeline.axes), 0)), np.empty(0, dtype=np.int64)
    held = kernels.Held(np.empty((len(axes.order), 0, width)), np.empty((len(axes.order), 0, width, width)), nothing)
    outputs = kernels.Outputs(*(nothing for _ in kernels.Outputs._fields))
    run_kernels.filter_run(axes, sensors, rows, state, none, met, log, held, outputs)
    return met


def _arranged(
    timeline: Timeline, config: FusionConfig
) -> tuple[kernels.Axes, kernels.Sensors, kernels.Rows, kernels.State, list[list[str]]]:
    """The kernels' arrays, and for each axis the sensors whose bias is in its state."""
    names, biases = timeline.components.sensors, _biases_on(timeline, config)
    sensors = sensors_of(names, {axis.name: axis.start for axis in timeline.axes}, config, biases)
    axes = _axes(timeline, config, [len(biased) for biased in biases])
    state = start_of(axes, len(names), timeline.origin, config, biases)
    return axes, sensors, _rows(timeline), state, biases


def _biases_on(timeline: Timeline, config: FusionConfig) -> list[list[str]]:
    """For each axis the sensors whose bias is in its state: those heard on it, in their order."""
    components, chosen, count = timeline.components, _chosen(timeline), len(timeline.axes)
    both = components.sensor[chosen] * count + components.axis[chosen]
    heard = np.bincount(both, minlength=len(components.sensors) * count).reshape(-1, count) > 0
    biased = [name in config.sensors and config.sensors[name].bias_sd > 0.0 for name in components.sensors]
    return [
        [name for index, name in enumerate(components.sensors) if biased[index] and heard[index, axis]]
        for axis in range(len(timeline.axes))
    ]


def sensors_of(
    names: Sequence[str], start: Mapping[str, float], config: FusionConfig, biases: Sequence[Sequence[str]]
) -> kernels.Sensors:
    """What the kernels know of each sensor.

    Args:
        names: The sensors in their order; those that are not configured, too.
        start: The level u₀ [m] of each axis.
        config: Their noise.
        biases: For each axis the sensors whose bias is in its state, in the state's order.
    """
    known = [config.sensors.get(name) for name in names]
    bias = np.full((len(names), len(start)), -1)
    for number, axis in enumerate(start):
        for place, name in enumerate(biases[number], order_of(config, axis) + 1):
            bias[names.index(name), number] = place
    scale = np.array([1.0 if sensor is None else sensor.scale for sensor in known])
    return kernels.Sensors(
        scale,
        scale[:, None] * np.array(list(start.values())),
        np.array([[_noise(sensor, axis) for axis in start] for sensor in known]).reshape(bias.shape),
        np.array([0.0 if sensor is None else sensor.latency_sd for sensor in known]),
        np.array([0.0 if sensor is None else sensor.gate for sensor in known]),
        np.array([sensor is None or sensor.gate_rows for sensor in known], dtype=np.bool_),
        bias,
    )


def order_of(config: FusionConfig, axis: str) -> int:
    """The order of an axis's plant."""
    return 1 if isinstance(config.arm.axes[axis].plant, FirstOrder) else 2


def _axes(timeline: Timeline, config: FusionConfig, biases: list[int]) -> kernels.Axes:
    driven = [(axis, config.process[axis.name]) for axis in timeline.axes]
    order = np.array([order_of(config, axis.name) for axis, _ in driven])
    noise = [p.input_noise**2 + (p.maneuver_noise * axis.drive.maneuver) ** 2 for axis, p in driven]
    drift = [p.drift**2 + (p.maneuver_drift * axis.drive.maneuver) ** 2 for axis, p in driven]
    return kernels.Axes(
        order=order,
        constants=np.array([closed.constants(config.arm.axes[axis.name].plant) for axis, _ in driven]),
        states=order + 1 + np.array(biases),
        first=np.cumsum([0, *(len(axis.drive.time) for axis, _ in driven)]),
        acting=np.concatenate([axis.acting for axis, _ in driven]),
        value=np.concatenate([axis.drive.value for axis, _ in driven]),
        noise=np.concatenate(noise),
        drift=np.concatenate(drift),
        resting=np.array([[p.input_noise**2, p.drift**2] for _, p in driven]),
    )


def _rows(timeline: Timeline) -> kernels.Rows:
    components, chosen = timeline.components, _chosen(timeline)
    sensor, axis, row = components.sensor[chosen], components.axis[chosen], components.row[chosen]
    begins = np.flatnonzero(np.diff(row, prepend=-1))
    return kernels.Rows(
        valid=components.valid[chosen][begins],
        sensor=sensor[begins],
        first=begins,
        end=np.append(begins, len(row))[1:],
        axis=axis,
        value=components.value[chosen],
        spread=np.empty(0) if components.spread is None else components.spread[chosen],
    )


def _chosen(timeline: Timeline) -> slice | IntArray:
    """The candidates among all components; a slice where they are all of them, which copies nothing."""
    candidates = timeline.components.candidates
    return slice(None) if len(candidates) == len(timeline.components.value) else candidates


def start_of(
    axes: kernels.Axes, sensors: int, origin: int, config: FusionConfig, biases: Sequence[Sequence[str]]
) -> kernels.State:
    """At rest at the start level at ``origin`` [ns], certain of all but the offset and the biases.

    Args:
        axes: Which states each axis has.
        sensors: How many there are.
        origin: The first command.
        config: How uncertain the start is.
        biases: As in :func:`sensors_of`.
    """
    count, width = len(axes.order), int(axes.states.max())
    P = np.zeros((count + 1, width, width))
    for number, names in enumerate(biases):
        offset = axes.order[number]
        P[number, offset, offset] = config.start.offset_sd**2
        for place, name in enumerate(names, offset + 1):
            P[number, place, place] = config.sensors[name].bias_sd ** 2
    return kernels.State(
        x=np.zeros((count + 1, width)),
        P=P,
        clock=np.full(count, origin),
        entry=np.full(count, -1),
        fused=np.full(count, origin),
        rejected=np.zeros((sensors, count + 1), dtype=np.int64),
        since=np.zeros((sensors, count + 1), dtype=np.int64),
        work=np.zeros((4, width)),
    )


def places(state: kernels.State, count: int) -> kernels.State:
    """Room for ``count`` checkpoints of a state."""
    room: dict[str, Any] = {
        name: np.empty((count, *part.shape), dtype=part.dtype)
        for name, part in state._asdict().items()
        if name != "work"
    }
    return kernels.State(**room, work=state.work)


def _log(axes: kernels.Axes, rows: kernels.Rows | None, width: int) -> kernels.Log:
    """Room for what happens to each axis: an interval for each command, an interval and an update for each component."""
    count = len(axes.order)
    room = np.zeros(count, dtype=np.int64)
    if rows is not None:
        room = np.diff(axes.first) + 2 * np.bincount(rows.axis, minlength=count)
    size = int(room.sum())
    return kernels.Log(
        np.concatenate(([0], np.cumsum(room))),
        np.zeros(count, dtype=np.int64),
        np.empty(size, dtype=np.int64),
        np.empty(size, dtype=np.int64),
        np.empty(size),
        np.empty(size),
        np.empty((size, width)),
    )


def _estimate(axis: AxisInput, outputs: kernels.Outputs, number: int) -> AxisEstimate:
    parts = {name: getattr(outputs, name)[number] for name in AxisEstimate.FIELDS}
    parts["position"] += axis.start
    return AxisEstimate(**parts)


def _known_biases(
    timeline: Timeline, axes: kernels.Axes, state: kernels.State, biases: list[list[str]]
) -> dict[str, dict[str, Bias]]:
    found: dict[str, dict[str, Bias]] = {}
    for number, axis in enumerate(timeline.axes):
        for place, name in enumerate(biases[number], int(axes.order[number]) + 1):
            sd = float(np.sqrt(max(state.P[number, place, place], 0.0)))
            found.setdefault(name, {})[axis.name] = Bias(float(state.x[number, place]), sd)
    return found


def _noise(sensor: Sensor | None, axis: str) -> float:
    sd = None if sensor is None else sensor.sd_of(axis)
    return np.nan if sd is None else sd


def _among_all(values: FloatArray, candidates: IntArray, size: int) -> FloatArray:
    """Values of the candidates among all components, NaN for the others."""
    if len(values) == size:
        return values
    found = np.full(size, np.nan)
    found[candidates] = values
    return found
