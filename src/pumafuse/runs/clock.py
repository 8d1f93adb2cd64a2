"""Stamps that are not what a clock should give: steps back, jumps, and jitter around a controller's own period."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arrays import NO_STAMP, IntArray, TimeArray
from ..errors import RunError
from .run import Reference, Run, Source

TOLERATED_STEP_BACK_NS = 1_000_000_000  # up to 1 s rows are out of order; beyond it the clock was set back
_MOST_JUMPS = 100


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
    streams = {**run.sensors, **({} if run.reference is None else {"reference": run.reference})}
    cut = {name: _jumps(source) for name, source in streams.items()}
    for name, others in cut.items():
        if len(others) != len(cuts):
            raise RunError(
                f"{run.command.label}: the commands' clock is set back {len(cuts)} times (first in row {cuts[0] + 1}),"
                f" that of {name} {len(others)} times; cut the log there and fuse the parts one by one"
            )
    parts: list[Run] = []
    for index in range(len(cuts) + 1):
        pieces = {name: _piece(source, cut[name], index) for name, source in streams.items()}
        reference = pieces.pop("reference", None)
        parts.append(
            replace(
                run,
                command=_piece(run.command, cuts, index),
                sensors=pieces,
                reference=reference if isinstance(reference, Reference) else None,
                start=run.start if index == 0 else {},
                notes=run.notes if index == 0 else (),
            )
        )
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
        stamp: Ascending stamps, int64 ns, (n,).
        period: T [s].
        label: The source, for messages.

    Returns:
        The stamps on the grid, (n,), and a sentence on clock drift or None.

    Raises:
        RunError: Two stamps fall on one tick, or the stamps' period is not T.
    """
    tick_ns = period * 1e9
    ticks = np.concatenate(([0], np.cumsum(np.rint(np.diff(stamp) / tick_ns)))).astype(np.int64)
    same = np.flatnonzero(np.diff(ticks) == 0)
    if len(same):
        apart = (stamp[same[0] + 1] - stamp[same[0]]) * 1e-6
        raise RunError(
            f"{label}: clock = 'regular', but two commands are only {apart:.3f} ms apart, less than half the period of"
            f" {period * 1e3:g} ms (stamp {stamp[same[0]] / 1e9:.6f} s); use clock = 'stamps'"
        )
    since = (stamp - stamp[0]).astype(np.float64)
    note = None
    if len(stamp) > 2:
        centred = ticks - ticks.mean()
        slope = float(centred @ since / (centred @ centred))
        left = since - since.mean() - slope * centred
        error = float(np.sqrt(left @ left / (len(stamp) - 2) / (centred @ centred)))
        drift = slope / tick_ns - 1.0
        if abs(drift) > 1e-3:
            raise RunError(
                f"{label}: clock = 'regular', but the commands come every {slope * 1e-6:.4f} ms, not every"
                f" {period * 1e3:g} ms; check update_period_ms, or use clock = 'stamps'"
            )
        if abs(slope - tick_ns) > 5.0 * error and abs(slope - tick_ns) * ticks[-1] > 1.0:
            tick_ns = slope
            note = f"{label}: the log's clock runs {drift * 1e6:+.1f} ppm against the controller's; the grid follows it"
    offset = float(np.median(since - ticks * tick_ns))
    return stamp[0] + np.rint(ticks * tick_ns + offset).astype(np.int64), note


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


def _piece(source: Source, cuts: list[int], index: int) -> Source:
    rows: IntArray = np.arange(len(source.stamp))
    edges = [0, *cuts, len(rows)]
    part = source.where((rows >= edges[index]) & (rows < edges[index + 1]))
    return Reference(part.stamp, part.values, part.label, source.sd) if isinstance(source, Reference) else part
