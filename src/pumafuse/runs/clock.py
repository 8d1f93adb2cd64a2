"""Stamps that are not what a clock should give: steps back, jumps, and jitter around a controller's own period."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from ..arrays import NO_STAMP, FloatArray, IntArray, TimeArray
from ..errors import RunError
from .run import Run, Source

TOLERATED_STEP_BACK_NS = 1_000_000_000  # up to 1 s rows are out of order; beyond it the clock was set back
_MOST_JUMPS = 100
_BLOCK = 64  # commands over which the two clocks' drift is small against T
_MOST_DRIFT = 1e-3  # two quartz clocks differ by 1e-4 at the worst
_MOST_ASTRAY = 0.05  # share of stamps that may be more than half a period off their tick
_LONGEST_QUEUE = 8  # commands that a stalled logger may stamp late in a row

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


def regular_grid(stamp: TimeArray, period: float, label: str) -> tuple[TimeArray, str | None]:
    """The controller's own ticks behind jittered stamps: an even grid of T fitted to them.

    The grid's offset is the median of what is left. T is taken as exact unless the stamps' own slope differs from it by
    more than 5 standard errors: then the two clocks drift apart, the slope is used and the drift told.

    Args:
        stamp: Strictly ascending stamps, int64 ns, (n,).
        period: T [s].
        label: The source, for messages.

    Returns:
        The stamps on the grid, (n,), and a sentence on drift and late stamps, or None.

    Raises:
        RunError: The stamps do not follow ticks of T.
    """
    tick = period * 1e9
    since = (stamp - stamp[0]).astype(np.float64)
    nearest = _nearest_ticks(since, tick)
    ticks = _ascending(nearest)
    slope, error = _line(ticks, since)
    drift, note = slope / tick - 1.0, None
    significant = len(stamp) >= _BLOCK and abs(drift) * tick > 5.0 * error and abs(drift) * tick * np.ptp(ticks) > 1.0
    if significant and abs(drift) <= _MOST_DRIFT:
        tick = slope
        note = f"{label}: the log's clock runs {drift * 1e6:+.1f} ppm against the controller's; the grid follows it"
    left = since - ticks * tick
    offset = float(np.median(left))
    astray = np.abs(left - offset) > 0.5 * tick
    moved = np.flatnonzero(np.concatenate(([True], ticks == nearest, [True])))
    queue = int(np.diff(moved).max()) - 1  # the longest row of commands that are taken to be late
    if (significant and abs(drift) > _MOST_DRIFT) or np.mean(astray) > _MOST_ASTRAY or queue > _LONGEST_QUEUE:
        usual = float(np.median(np.diff(stamp))) / 1e6
        raise RunError(
            f"{label}: clock = 'regular', but the commands do not come on ticks of {period * 1e3:g} ms (their median"
            f" interval is {usual:.4f} ms); check update_period_ms, or use clock = 'stamps'"
        )
    if astray.any():
        late = (
            f"{label}: {int(astray.sum())} commands are stamped more than half a period late: set back to their ticks"
        )
        note = late if note is None else f"{note}; {late}"
    return stamp[0] + np.rint(ticks * tick + offset).astype(np.int64), note


def _ascending(nearest: IntArray) -> IntArray:
    """Ticks of which no two are one: of two stamps on one tick the first was late, and moves to the tick before."""
    order = np.arange(len(nearest))
    return np.minimum.accumulate((nearest - order)[::-1])[::-1] + order


def _nearest_ticks(since: FloatArray, tick: float) -> IntArray:
    """The number of the tick nearest to each stamp, (n,).

    Each stamp is rounded to the nearest tick of a phase that follows the clocks' slow drift, so that a late stamp moves
    no other. The phase is the circular mean of the stamps over blocks, which no missing tick disturbs; over pauses it
    is carried on with the drift seen between neighbouring blocks.
    """
    pauses = np.flatnonzero(np.diff(since) > _BLOCK * tick) + 1
    edges = np.union1d(np.arange(0, len(since), _BLOCK), pauses)
    size = np.diff(np.append(edges, len(since)))
    turn = np.add.reduceat(np.exp(2j * np.pi * since / tick), edges)
    phase = np.angle(turn) * tick / (2.0 * np.pi)
    middle = np.add.reduceat(since, edges) / size
    apart, moved = np.diff(middle), np.diff(phase)
    moved -= np.rint(moved / tick) * tick
    near = apart <= 2.0 * _BLOCK * tick
    drift = float(np.median(moved[near] / apart[near])) if near.any() else 0.0
    phase = np.unwrap(phase - drift * middle, period=tick) + drift * middle
    block = np.repeat(np.arange(len(edges)), size)
    return np.rint((since - phase[block] - drift * (since - middle[block])) / tick).astype(np.int64)


def _line(ticks: IntArray, since: FloatArray) -> tuple[float, float]:
    """Slope of the stamps over their ticks by least squares, and its standard error [ns]."""
    if len(ticks) < 3:
        return np.inf, np.inf
    centred = ticks - ticks.mean()
    weight = float(centred @ centred)
    slope = float(centred @ since) / weight
    left = since - since.mean() - slope * centred
    return slope, float(np.sqrt(left @ left / (len(ticks) - 2) / weight))


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
