"""The total order of events: what acts on the plant when, and which reading is valid when.

Time is int64 ns. At one instant commands come before readings, then sensors in the order of ``fusion.toml``, then
stamp, place in the file and axis. The axes are independent but for row gates, so rows are kept together and each axis
still meets its scalars in the order (time, sensor, stamp, place in the file).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from ..arrays import NO_STAMP, BoolArray, CodeArray, FloatArray, IndexArray, IntArray, TimeArray
from ..errors import RunError, UnknownNameError
from ..model.drive import Drive, drive
from ..runs.clock import TOLERATED_STEP_BACK_NS, behind
from ..runs.frames import CARTESIAN
from ..runs.grid import regular_grid
from ..runs.run import Run, Source
from .config import FusionConfig, Sensor
from .outcome import FARTHEST, Outcome

LONGEST_TAIL_NS = 3_600_000_000_000  # readings this long after the last command no longer belong to the run
T = TypeVar("T", bound=np.generic)
_MOST_ESTIMATES = 10_000_000


@dataclass(frozen=True)
class AxisInput:
    """What drives one axis.

    Attributes:
        name: The axis.
        start: The level u₀ [m] that everything inside the filter is relative to.
        given: When each command was given, int64 ns, (n,).
        command: u as logged [m], (n,).
        drive: The plant's input, by the time it is issued.
        delay: Td, int ns.
    """

    name: str
    start: float
    given: TimeArray
    command: FloatArray
    drive: Drive
    delay: int

    @property
    def acting(self) -> TimeArray:
        """When each entry of the drive reaches the plant, int64 ns."""
        return self.drive.time + self.delay


@dataclass(frozen=True)
class Scalars:
    """The scalars of all readings in the order of processing; arrays are (m,).

    Attributes:
        valid: The instant each is true of, int64 ns (``NO_STAMP`` without a stamp).
        stamp: As logged, int64 ns.
        sensor: Index into ``sensors``.
        axis: Index into the timeline's axes.
        value: z [m] as logged.
        row: Scalars of one row of one sensor share this number; it never falls.
        spread: By what a frame scales the noise of each; None without one.
        outcome: What is known before filtering; ``Outcome.FUSED`` where the filter is to decide.
        sensors: Sensor names, the configured ones first in their order.
    """

    valid: TimeArray
    stamp: TimeArray
    sensor: IndexArray
    axis: IndexArray
    value: FloatArray
    row: IntArray
    spread: FloatArray | None
    outcome: CodeArray
    sensors: tuple[str, ...]

    @cached_property
    def candidates(self) -> IntArray:
        """Indices of the scalars that the filter is to decide on."""
        return np.flatnonzero(self.outcome == Outcome.FUSED)


@dataclass(frozen=True)
class Timeline:
    """One segment of a run, ready to be filtered.

    Attributes:
        origin: The first command, int ns: time 0 of the run.
        commands: Stamps of the commands, ascending, int64 ns, (n,).
        axes: What drives each axis.
        scalars: The readings.
        end: Where an even grid of estimates ends, int ns: with the last command or reading. Readings an hour after the
            last command are on another clock.
        speed: Highest commanded speed on any axis [m/s].
        notes: Every anomaly once: how many, where first.
    """

    origin: int
    commands: TimeArray
    axes: tuple[AxisInput, ...]
    scalars: Scalars
    end: int
    speed: float
    notes: tuple[str, ...]


def build(run: Run, config: FusionConfig, sensors: Iterable[str] | None = None) -> Timeline:
    """Put a run's commands and readings into their total order.

    Args:
        run: One segment of a recorded run.
        config: Arm and sensors.
        sensors: Which of the configured sensors to use; all for None.

    Raises:
        PumafuseError: The run commands an axis that the arm has not, or a chosen sensor is not configured.
    """
    arm, notes = config.arm, list(run.notes)
    for axis in run.axes:
        if axis in CARTESIAN and axis not in arm.axes:
            raise RunError(f"{run.command.label}: commands are in x, y, z; give a [frame] in run.toml or fusion.toml")
        if axis not in arm.axes:
            raise UnknownNameError(
                f"{run.command.label}: the arm '{arm.name}' has no such axis", "axis", axis, arm.axes
            )
    for name, source in run.sensors.items():
        if any(axis in CARTESIAN and axis not in run.axes for axis in source.values):
            raise RunError(
                f"sensor '{name}' is in x, y, z, the commands are not; give a [frame], and them in x, y, z too"
            )
    command = _sorted_commands(run.command, notes)
    used = {name: _actual_commands(command.stamp, command.values[name], arm.update_period) for name in run.axes}
    stamp = command.stamp
    if run.clock == "regular":
        stamp, note = _on_grid(command, used, arm.update_period)
        notes.extend([] if note is None else [note])
    inputs: list[AxisInput] = []
    for name in run.axes:
        given, values = stamp[used[name]], command.values[name][used[name]]
        start = run.start.get(name, float(values[0]))
        driven = drive(arm.axes[name], given, values, start, arm.update_period)
        inputs.append(AxisInput(name, start, given, values, driven, round(arm.delay_of(name) * 1e9)))
    same = all(np.array_equal(axis.given, inputs[0].given) for axis in inputs)
    commands = inputs[0].given if same else np.unique(np.concatenate([axis.given for axis in inputs]))
    origin = int(commands[0])

    named = tuple(name for name in config.sensor_names(sensors) if name in run.sensors)
    others = tuple(name for name in run.sensors if name not in config.sensors) if sensors is None else ()
    silent = [name for name in config.sensor_names(sensors) if name not in run.sensors]
    notes.extend(f"sensor '{name}' of the configuration has no readings in this run" for name in silent)
    scalars = _scalars(run, config, named + others, origin, notes)
    valid = scalars.valid[scalars.candidates]
    end = int(valid[valid <= commands[-1] + LONGEST_TAIL_NS].max(initial=commands[-1]))
    speed = max(axis.drive.speed for axis in inputs)
    return Timeline(origin, commands, tuple(inputs), scalars, end, speed, tuple(notes))


def as_commanded(run: Run, period: float) -> Source:
    """The rows of a run's commands as they are believed: as logged, or where the run says so on the grid of T.

    Args:
        run: One segment of a recorded run.
        period: T [s].

    Raises:
        RunError: The stamps do not follow ticks of T.
    """
    if run.clock == "stamps":
        return run.command
    command = _sorted_commands(run.command, [])
    used = {name: _actual_commands(command.stamp, command.values[name], period) for name in command.values}
    stamp, _ = _on_grid(command, used, period)
    values = {name: np.full(len(stamp), np.nan) for name in used}
    for name, rows in used.items():
        values[name][rows] = command.values[name][rows]
    return replace(command, stamp=stamp, values=values).rows(np.unique(np.concatenate(list(used.values()))))


def _on_grid(command: Source, used: Mapping[str, IntArray], period: float) -> tuple[TimeArray, str | None]:
    """Stamps with those of the used rows on the grid of T, and what is to be said of it."""
    rows = np.unique(np.concatenate(list(used.values())))
    distinct, place = np.unique(command.stamp[rows], return_inverse=True)
    grid, note = regular_grid(distinct, period, command.label)
    stamp = command.stamp.copy()
    stamp[rows] = grid[place]
    return stamp, note


def output_times(timeline: Timeline, rate: float | None) -> TimeArray:
    """When estimates are asked for: at each command, or on an even grid of ``rate`` [Hz] from the first command on."""
    if rate is None:
        return timeline.commands
    span = timeline.end - timeline.origin
    count = int(span / 1e9 * rate) + 2
    if count > _MOST_ESTIMATES:
        raise RunError(
            f"{rate:g} estimates a second over {span / 86400e9:.1f} days are {count:.1e} estimates, more than"
            f" {_MOST_ESTIMATES:.0e}: a lower --rate? Or are not all stamps on one clock?"
        )
    grid = np.rint(np.arange(count) * (1e9 / rate)).astype(np.int64)
    return timeline.origin + grid[grid <= span]


def _sorted_commands(source: Source, notes: list[str]) -> Source:
    """The stamped command rows in order, NaN where an axis has no finite command."""
    missing = source.stamp == NO_STAMP
    _tell(notes, source.label, missing, "no stamp: not used")
    _tell(notes, source.label, behind(source.stamp) > 0, "a stamp that steps back: sorted")
    _tell(notes, source.label, _said_before(source) & ~missing, "the stamp and values of an earlier row: duplicate")
    for axis, value in source.values.items():
        _tell(notes, source.label, ~_plausible(value) & ~missing, f"no finite {axis} command: not used")
    kept = source.rows(~missing)
    order = np.argsort(kept.stamp, kind="stable")
    values = {axis: np.where(_plausible(value), value, np.nan)[order] for axis, value in kept.values.items()}
    return Source(kept.stamp[order], values, source.label)


def _actual_commands(stamp: TimeArray, value: FloatArray, period: float) -> IntArray:
    """Indices of the rows that command one axis: with a value, the last of its stamp, and no repetition.

    A repetition is the value of the row before it, said again within half a period: a log that fills its command
    column down to the sensor's rate has one command where the value changes.
    """
    given = np.flatnonzero(np.isfinite(value))
    given = given[np.concatenate((np.diff(stamp[given]) > 0, [True]))]
    again = (np.diff(value[given]) == 0.0) & (np.diff(stamp[given]) < 0.5e9 * period)
    return given[np.concatenate(([True], ~again))]


def _scalars(run: Run, config: FusionConfig, names: tuple[str, ...], origin: int, notes: list[str]) -> Scalars:
    heard = [_heard(run, config, name, origin, notes) for name in names]
    valid = np.concatenate([np.zeros(0, dtype=np.int64), *(part.valid for part in heard)])
    stamp = np.concatenate([np.zeros(0, dtype=np.int64), *(part.stamp for part in heard)])
    sensor = np.repeat(np.arange(len(names), dtype=np.int16), [len(part.valid) for part in heard])
    # Each sensor's rows are in order, and the sensors in theirs: a stable sort by valid time keeps both.
    order = np.argsort(valid, kind="stable")
    width = np.array([len(part.axes) for part in heard], dtype=np.int64)[sensor[order]]
    count = int(width.sum())
    first = np.empty(len(order), dtype=np.int64)  # where each row's scalars begin
    first[order] = np.cumsum(width) - width
    axis, value, outcome = np.empty(count, np.int16), np.empty(count), np.empty(count, np.uint8)
    spread = np.ones(count) if any(run.sensors[name].spread for name in names) else None
    begin = 0
    for part in heard:
        at = first[begin : begin + len(part.valid)]
        begin += len(part.valid)
        for place, number in enumerate(part.axes):
            here = at + place
            axis[here], value[here], outcome[here] = number, part.value[place], part.outcome[place]
            if spread is not None and part.spread is not None:
                spread[here] = part.spread[place]
    return Scalars(
        np.repeat(valid[order], width),
        np.repeat(stamp[order], width),
        np.repeat(sensor[order], width),
        axis,
        value,
        np.repeat(np.arange(len(order)), width),
        spread,
        outcome,
        names,
    )


class _Heard(NamedTuple):
    """One sensor's rows in order; of its k axes: their numbers (k,), and value, spread and outcome (k, rows)."""

    valid: TimeArray
    stamp: TimeArray
    axes: IndexArray
    value: FloatArray
    spread: FloatArray | None
    outcome: CodeArray


def _heard(run: Run, config: FusionConfig, name: str, origin: int, notes: list[str]) -> _Heard:
    source, sensor = run.sensors[name], config.sensors.get(name)
    label = source.told_as(name)
    latency = 0 if sensor is None else round(sensor.latency * 1e9)
    valid = np.where(source.stamp == NO_STAMP, NO_STAMP, source.stamp - latency)
    outcomes = _row_outcomes(source, sensor, valid, origin)
    _tell(notes, label, behind(source.stamp) > 0, "a stamp that steps back: sorted")
    for kind, reason in _REASONS.items():
        _tell(notes, label, outcomes == kind, f"{reason}: {kind.word}")
    axes = [(number, axis) for number, axis in enumerate(run.axes) if axis in source.values]
    shape = (len(axes), len(valid))
    value = np.empty(shape)
    spread = np.ones(shape) if source.spread else None
    outcome = np.repeat(outcomes[None], len(axes), axis=0)
    for place, (_, axis) in enumerate(axes):
        value[place] = source.values[axis]
        if spread is not None and axis in source.spread:
            spread[place] = source.spread[axis]
        if sensor is not None and sensor.sd_of(axis) is None:
            notes.append(f"{label}: sd_mm has no entry for {axis}, which is not used: {Outcome.UNKNOWN.word}")
            outcome[place] = Outcome.UNKNOWN
            continue
        hollow = (outcomes == Outcome.FUSED) & ~_plausible(value[place])
        outcome[place, hollow] = Outcome.INVALID
        _tell(notes, label, hollow, f"no finite {axis} value: {Outcome.INVALID.word}")
    heard = _Heard(
        valid, source.stamp, np.array([number for number, _ in axes], dtype=np.int16), value, spread, outcome
    )
    if (np.diff(valid) >= 0).all():
        return heard
    order = np.argsort(valid, kind="stable")
    return heard._replace(
        valid=valid[order],
        stamp=source.stamp[order],
        value=value[:, order],
        spread=None if spread is None else spread[:, order],
        outcome=outcome[:, order],
    )


def _plausible(value: FloatArray) -> BoolArray:
    """Finite and no sentinel such as 3.4e38: within a thousand kilometres."""
    return np.abs(value) < FARTHEST


def _row_outcomes(source: Source, sensor: Sensor | None, valid: TimeArray, origin: int) -> CodeArray:
    """What is known of each row whatever its axes say, the strongest reason last."""
    outcome = np.full(len(valid), Outcome.FUSED, dtype=np.uint8)
    outcome[valid < origin] = Outcome.BEFORE_START
    outcome[behind(source.stamp) > TOLERATED_STEP_BACK_NS] = Outcome.TOO_LATE
    outcome[_said_before(source)] = Outcome.DUPLICATE
    outcome[source.stamp == NO_STAMP] = Outcome.INVALID
    if sensor is None:
        outcome[:] = Outcome.UNKNOWN
    return outcome


def _said_before(source: Source) -> BoolArray:
    """Rows whose stamp and values all stood in an earlier row, (rows,)."""
    found = np.zeros(len(source.stamp), dtype=bool)
    if (np.diff(source.stamp) > 0).all():
        return found
    keys = [source.stamp, *(np.ascontiguousarray(value).view(np.int64) for value in source.values.values())]
    order = np.lexsort(keys)
    again = np.all([np.diff(key[order]) == 0 for key in keys], axis=0)
    found[order[1:][again]] = True
    return found


_REASONS: Mapping[Outcome, str] = {
    Outcome.INVALID: "no stamp",
    Outcome.DUPLICATE: "the stamp and values of an earlier row",
    Outcome.BEFORE_START: "a time before the first command",
    Outcome.TOO_LATE: "a stamp more than 1 s behind an earlier one",
    Outcome.UNKNOWN: "no sensor of this name in the configuration",
}


def _tell(notes: list[str], label: str, rows: BoolArray, what: str) -> bool:
    """Note how many rows have ``what``, and where the first is; True if any has."""
    found = np.flatnonzero(rows)
    if len(found):
        plural = "row has" if len(found) == 1 else "rows have"
        notes.append(f"{label}: {len(found)} {plural} {what} (first: row {found[0] + 1})")
    return len(found) > 0
