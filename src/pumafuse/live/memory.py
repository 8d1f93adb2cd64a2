"""The arrays behind a window: what is in each, how they are made, and how they get more room."""

# pyright: reportCallIssue=false

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..arrays import ALWAYS, NEVER, CodeArray, FloatArray, IntArray, TimeArray
from ..compiled import compiled
from ..fusion.config import FusionConfig
from ..fusion.engine import order_of, places, sensors_of, start_of
from ..fusion.kernels import Axes, Met, Rows, Sensors, State, keep
from ..model import closed
from .command_kernels import Commands
from .tally_kernels import IN_A_ROW, SECONDS, Tally

BEGIN, END, ORIGIN, CHANGED = range(4)  # of a window's span
ABSENT = 255  # an axis that a row does not give
VALUE, SPREAD = range(2)
KNOWN, BECAME = range(2)
_ROWS, _COMMANDS, _ENTRIES = 4096, 512, 1024  # at first


class Heard(NamedTuple):
    """The rows of measurements as they came, in a ring of R, and what is asked and answered.

    Attributes:
        span: Positions of the first row (``BEGIN``) and after the last one (``END``), the first command's stamp [ns]
            (``ORIGIN``), and the position of the first row for which an event ``CHANGED`` something, (4,).
        stamp: Int64 ns, (R,).
        value: z [m] of each axis, and by what its noise is scaled, (R, A, 2).
        code: What is ``KNOWN`` of each component before filtering and what ``BECAME`` of it: codes of Outcome, or
            ``ABSENT``, (R, A, 2).
        latency: Of each sensor, int64 ns, (S,).
        new: Values [m] of the event that comes in, and by what the noise of each is scaled, (A, 2).
        told: What became of them, (A,).
        fused: When the last component that an estimate knows of was valid, int64 ns, (A,).
    """

    span: IntArray
    stamp: TimeArray
    value: FloatArray
    code: CodeArray
    latency: TimeArray
    new: FloatArray
    told: CodeArray
    fused: TimeArray


class Nothing(NamedTuple):
    """Empty arrays, for a smoother's log that nobody keeps: (A + 1,), (0,) and (0, s)."""

    whole: IntArray
    real: FloatArray
    table: FloatArray


class Memory(NamedTuple):
    """All of it. ``kept`` has two places more than the ring: one to put the state aside, one for the start."""

    axes: Axes
    sensors: Sensors
    rows: Rows
    state: State
    kept: State
    met: Met
    commands: Commands
    heard: Heard
    tally: Tally
    nothing: Nothing

    def flat(self) -> Flat:
        """As plain tuples, which a kernel takes a hundred times faster."""
        return tuple(tuple(part) for part in self)


Flat: TypeAlias = tuple[tuple[Any, ...], ...]


@compiled
def opened(flat: Flat) -> Memory:
    """The names again."""
    return Memory(
        Axes(*flat[0]),
        Sensors(*flat[1]),
        Rows(*flat[2]),
        State(*flat[3]),
        State(*flat[4]),
        Met(*flat[5]),
        Commands(*flat[6]),
        Heard(*flat[7]),
        Tally(*flat[8]),
        Nothing(*flat[9]),
    )


def empty(config: FusionConfig, axes: tuple[str, ...], start: Mapping[str, float]) -> Memory:
    """Room for a few thousand rows, and the filter at rest before them.

    Args:
        config: Arm, noise and sensors.
        axes: Every axis in its order.
        start: The level u₀ [m] of axes that do not rest at their first command before it.
    """
    names, count = tuple(config.sensors), len(axes)
    level = {axis: start.get(axis, 0.0) for axis in axes}
    biases = [
        [name for name, sensor in config.sensors.items() if sensor.bias_sd > 0.0 and sensor.sd_of(axis) is not None]
        for axis in axes
    ]
    models, process = [config.arm.axes[axis] for axis in axes], [config.process[axis] for axis in axes]
    order = np.array([order_of(config, axis) for axis in axes])
    driven = Axes(
        order=order,
        constants=np.array([closed.constants(model.plant) for model in models]),
        states=order + 1 + np.array([len(biased) for biased in biases]),
        first=np.arange(count + 1) * _ENTRIES,
        acting=np.full(count * _ENTRIES, NEVER),
        value=np.zeros(count * _ENTRIES),
        noise=np.zeros(count * _ENTRIES),
        drift=np.zeros(count * _ENTRIES),
        resting=np.array([[part.input_noise**2, part.drift**2] for part in process]),
    )
    state = start_of(driven, len(names), NEVER, config, biases)
    components, width = _ROWS * count, state.x.shape[1]
    kept = places(state, _ROWS + 2)
    keep(state, kept, _ROWS + 1)
    table = (count, _COMMANDS)
    return Memory(
        driven,
        sensors_of(names, level, config, biases),
        Rows(
            np.zeros(_ROWS, np.int64),
            np.zeros(_ROWS, np.int16),
            np.zeros(_ROWS, np.int64),
            np.zeros(_ROWS, np.int64),
            np.zeros(components, np.int16),
            np.zeros(components),
            np.zeros(components),
        ),
        state,
        kept,
        Met(np.zeros(components), np.zeros(components), np.zeros(components, np.uint8)),
        Commands(
            time=np.zeros((*table, 2), np.int64),
            row=np.zeros((*table, 5)),
            number=np.array([[0, 0, 0, 0, 0, round(config.arm.delay_of(axis) * 1e9)] for axis in axes]),
            level=np.array([[u, float(axis in start)] for axis, u in level.items()]),
            gain=np.array(
                [
                    [
                        model.gain.slope,
                        model.gain.intercept,
                        np.inf if model.gain_recovery is None else model.gain_recovery,
                        config.arm.update_period,
                    ]
                    for model in models
                ]
            ),
            process=np.array(
                [[part.input_noise**2, part.drift**2, part.maneuver_noise, part.maneuver_drift] for part in process]
            ),
        ),
        Heard(
            span=np.array([0, 0, NEVER, 0]),
            stamp=np.zeros(_ROWS, np.int64),
            value=np.zeros((_ROWS, count, 2)),
            code=np.zeros((_ROWS, count, 2), np.uint8),
            latency=np.array([round(sensor.latency * 1e9) for sensor in config.sensors.values()], dtype=np.int64),
            new=np.tile([0.0, 1.0], (count, 1)),
            told=np.zeros(count, np.uint8),
            fused=np.zeros(count, np.int64),
        ),
        Tally(
            number=np.zeros((len(names), IN_A_ROW + 1), np.int64),
            last=np.full(len(names), ALWAYS),
            left=np.full(len(names), ALWAYS),
            usual=np.zeros(len(names)),
            second=np.full((len(names), SECONDS), ALWAYS),
            minute=np.zeros((len(names), SECONDS, 5)),
        ),
        Nothing(np.zeros(count + 1, np.int64), np.zeros(0), np.zeros((0, width))),
    )


def with_rows(memory: Memory, rows: int) -> Memory:
    """The same with room for ``rows`` rows in the ring; what is in it keeps its positions."""
    held, axes = len(memory.heard.stamp), len(memory.heard.told)
    positions: IntArray = np.arange(int(memory.heard.span[BEGIN]), int(memory.heard.span[END]), dtype=np.int64)
    here, there = positions % held, positions % rows
    extra = np.array([held, held + 1])

    def of_rows(part: np.ndarray) -> np.ndarray:
        found = np.zeros((rows, *part.shape[1:]), dtype=part.dtype)
        found[there] = part[here]
        return found

    def of_components(part: np.ndarray) -> np.ndarray:
        return of_rows(part.reshape(held, axes)).reshape(-1)

    def of_places(part: np.ndarray) -> np.ndarray:
        found = np.zeros((rows + 2, *part.shape[1:]), dtype=part.dtype)
        found[there], found[rows:] = part[here], part[extra]
        return found

    components_begin = memory.rows.first - np.arange(held) * axes  # 0 for each row that was ever arranged
    first = of_rows(components_begin) + np.arange(rows) * axes
    return memory._replace(
        rows=Rows(
            of_rows(memory.rows.valid),
            of_rows(memory.rows.sensor),
            first,
            first + of_rows(memory.rows.end - memory.rows.first),
            of_components(memory.rows.axis),
            of_components(memory.rows.value),
            of_components(memory.rows.spread),
        ),
        kept=State(
            **{name: of_places(part) for name, part in memory.kept._asdict().items() if name != "work"},
            work=memory.kept.work,
        ),
        met=Met(*(of_components(part) for part in memory.met)),
        heard=memory.heard._replace(
            stamp=of_rows(memory.heard.stamp),
            value=of_rows(memory.heard.value),
            code=of_rows(memory.heard.code),
        ),
    )


def with_commands(memory: Memory) -> Memory:
    """The same with twice the room for commands."""
    commands = memory.commands
    time, row = (np.concatenate((part, np.zeros_like(part)), axis=1) for part in (commands.time, commands.row))
    return memory._replace(commands=commands._replace(time=time, row=row))


def with_entries(memory: Memory) -> Memory:
    """The same with twice the room for the entries that commands make."""
    count, axes = len(memory.heard.told), memory.axes

    def wider(part: np.ndarray, filled: float = 0) -> np.ndarray:
        table = part.reshape(count, -1)
        return np.concatenate((table, np.full_like(table, filled)), axis=1).reshape(-1)

    return memory._replace(
        axes=axes._replace(
            first=axes.first * 2,
            acting=wider(axes.acting, NEVER),
            value=wider(axes.value),
            noise=wider(axes.noise),
            drift=wider(axes.drift),
        )
    )
