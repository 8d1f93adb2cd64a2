"""Which rows of a log command the arm, and when: in order, without repetitions, by the clock that the run believes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arrays import NO_STAMP, FloatArray, IntArray, TimeArray
from ..logs.clock import behind
from ..logs.grid import regular_grid
from ..logs.run import Run, Source
from ..logs.run import note_rows as tell
from .outcome import plausible


def given_commands(run: Run, period: float, notes: list[str]) -> tuple[Source, dict[str, IntArray]]:
    """The stamped command rows of a run in order, and for each axis which of them command it.

    Args:
        run: One segment of a recorded run.
        period: T [s].
        notes: Gets a sentence on everything that is wrong with the rows.

    Returns:
        The rows, NaN where an axis has no finite command, with their stamps as logged or, where the run says so, on the
        grid of T; and the indices of each axis's commands among them.

    Raises:
        RunError: The run's clock is regular and the stamps do not follow ticks of T.
    """
    command = _sorted(run.command, notes)
    used = {name: _actual(command.stamp, command.values[name], period) for name in run.axes}
    if run.clock == "stamps":
        return command, used
    rows = np.unique(np.concatenate(list(used.values())))
    distinct, place = np.unique(command.stamp[rows], return_inverse=True)
    grid, note = regular_grid(distinct, period, command.label)
    notes.extend([] if note is None else [note])
    stamp = command.stamp.copy()
    stamp[rows] = grid[place]
    return replace(command, stamp=stamp), used


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
    command, used = given_commands(run, period, [])
    values = {name: np.full(len(command.stamp), np.nan) for name in used}
    for name, rows in used.items():
        values[name][rows] = command.values[name][rows]
    return replace(command, values=values).rows(np.unique(np.concatenate(list(used.values()))))


def _sorted(source: Source, notes: list[str]) -> Source:
    """The stamped command rows in order, NaN where an axis has no finite command."""
    missing = source.stamp == NO_STAMP
    tell(notes, source.label, missing, "no stamp: not used")
    tell(notes, source.label, behind(source.stamp) > 0, "a stamp that steps back: sorted")
    tell(notes, source.label, source.repeated() & ~missing, "the stamp and values of an earlier row: duplicate")
    for axis, value in source.values.items():
        tell(notes, source.label, ~plausible(value) & ~missing, f"no finite {axis} command: not used")
    kept = source.rows(~missing)
    order = np.argsort(kept.stamp, kind="stable")
    values = {axis: np.where(plausible(value), value, np.nan)[order] for axis, value in kept.values.items()}
    return Source(kept.stamp[order], values, source.label)


def _actual(stamp: TimeArray, value: FloatArray, period: float) -> IntArray:
    """Indices of the rows that command one axis: with a value, the last of its stamp, and no repetition.

    A repetition is the value of the row before it, said again within half a period: a log that fills its command
    column down to the sensor's rate has one command where the value changes.
    """
    given = np.flatnonzero(np.isfinite(value))
    given = given[np.concatenate((np.diff(stamp[given]) > 0, [True]))]
    again = (np.diff(value[given]) == 0.0) & (np.diff(stamp[given]) < 0.5e9 * period)
    return given[np.concatenate(([True], ~again))]
