"""The controller's own ticks behind stamps that jitter: an even grid of T."""

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray, IntArray, TimeArray
from ..errors import RunError

_BLOCK = 64  # commands over which the two clocks' drift is small against T
_MOST_DRIFT = 1e-3  # two quartz clocks differ by 1e-4 at the worst
_MOST_ASTRAY = 0.05  # share of stamps that may be more than half a period off their tick
_LONGEST_QUEUE = 8  # commands that a stalled logger may stamp late in a row


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
