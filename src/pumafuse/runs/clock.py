"""Stamps that step back: how far, and where a clock was set back, which cuts a run."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from ..arrays import NO_STAMP, TimeArray
from ..errors import RunError
from .run import Run, Source

TOLERATED_STEP_BACK_NS = 1_000_000_000  # up to 1 s rows are out of order; beyond it the clock was set back
_MOST_JUMPS = 100

S = TypeVar("S", bound=Source)


def behind(stamp: TimeArray) -> TimeArray:
    """How far each row is behind the latest stamp before it [ns], 0 for a row in order or without a stamp, (rows,)."""
    return np.where(stamp == NO_STAMP, 0, np.maximum.accumulate(stamp) - stamp)


def segments(run: Run) -> tuple[list[Run], list[str]]:
    """Cut a run where the commands' clock was set back by more than 1 s.

    A segment is a run of its own: the arm is taken to rest at its first command again. The sensors and the reference
    must have jumped as often as the commands; a sensor that jumped alone is left to the timeline, which calls its rows
    too late.

    Returns:
        The segments in order, and a sentence on each jump.

    Raises:
        RunError: The commands' clock jumped and another source's did not, or it jumps all the time.
    """
    cuts = _jumps(run.command)
    if not cuts:
        return [run], []
    for source in (*run.sensors.values(), *([] if run.reference is None else [run.reference])):
        if len(_jumps(source)) != len(cuts):
            raise RunError(
                f"{run.command.label}: the commands' clock is set back {len(cuts)} times (first in row {cuts[0] + 1}),"
                f" that of {source.label} {len(_jumps(source))} times; cut the log there and fuse the parts one by one"
            )
    parts = [
        replace(
            run,
            command=_piece(run.command, index),
            sensors={name: _piece(source, index) for name, source in run.sensors.items()},
            reference=None if run.reference is None else _piece(run.reference, index),
            start=run.start if index == 0 else {},
            notes=run.notes if index == 0 else (),
        )
        for index in range(len(cuts) + 1)
    ]
    lag = behind(run.command.stamp)
    said = [
        f"{run.command.label}: the clock is set back by {lag[row] / 1e9:.3f} s in row {row + 1}: new segment, filter"
        " restarted"
        for row in cuts
    ]
    return parts, said


def _jumps(source: Source) -> list[int]:
    """Rows at which the clock was set back by more than is tolerated."""
    stamped = np.flatnonzero(source.stamp != NO_STAMP)
    stamp, found, first = source.stamp[stamped], list[int](), 0
    while True:
        back = np.flatnonzero(behind(stamp[first:]) > TOLERATED_STEP_BACK_NS)
        if not len(back):
            return found
        first += int(back[0])
        found.append(int(stamped[first]))
        if len(found) > _MOST_JUMPS:
            raise RunError(
                f"{source.label}: the stamps step back by more than 1 s over {_MOST_JUMPS} times: not one clock"
            )


def _piece(source: S, index: int) -> S:
    """Segment ``index`` of a source: the rows between two of its jumps."""
    edges = [0, *_jumps(source), len(source.stamp)]
    return source.rows(slice(edges[index], edges[index + 1]))
