"""Stamps that go on where a counter begins anew or a clock is set by an hour, and stamps of rows in packets."""

from __future__ import annotations

import math

import numpy as np

from ..arrays import NO_STAMP, FloatArray, TimeArray
from ..errors import plural

_HOUR_NS = 3_600_000_000_000
_PERIODS = {  # ns, after which counters of 32 bits begin anew, and times of day without a date
    2**32 * 1_000: "2^32 us",
    2**32 * 1_000_000: "2^32 ms",
    24 * _HOUR_NS: "midnight",
    12 * _HOUR_NS: "12 hours",
}
_CLOSE = 10  # usual intervals, within which a step is one of these: a dropout may hide some rows
_FAR_NS = 60_000_000_000  # from all other stamps: a stamp of 0 that is as far is none; rows so far apart tell no step
_WAITS = 10.0  # times the usual interval, from which a row begins another packet
_FEWEST, _MANY = 10, 0.005  # packets, and their share of the rows; fewer are pauses
_AT_ONCE_NS = 300_000  # between rows of a packet: nothing that moves an arm is sampled at 3 kHz
_LEAST_WAIT = 0.02  # s, from which it matters


def drop_wraps(stamp: TimeArray, label: str) -> tuple[TimeArray, list[str]]:
    """Stamps that go on over wraps of 32 bits, midnight and one step of an hour, without zeros, and notes on each."""
    if len(stamp) < 2:
        return stamp, []
    notes, zero = list[str](), stamp == 0
    others = stamp[~zero & (stamp != NO_STAMP)]
    if zero.any() and len(others) >= _FEWEST and np.abs(others).min() >= max(_FAR_NS, float(np.ptp(others))):
        notes.append(f"{label}: {plural(int(zero.sum()), 'stamp')} of 0, far from all others: taken as missing")
        stamp = np.where(zero, NO_STAMP, stamp)
    rows = np.flatnonzero(stamp != NO_STAMP)
    steps = np.diff(stamp[rows])
    close = _CLOSE * float(np.median(steps[steps > 0])) if (steps > 0).any() else math.inf
    if close > _FAR_NS or int(np.abs(steps).max()) < _HOUR_NS // 2:
        return stamp, notes
    back = np.zeros(len(steps), dtype=np.int64)

    def take(turns: TimeArray, period: int, words: str) -> None:
        back[:] += turns * period
        first = rows[np.flatnonzero(turns)[0] + 1] + 1
        notes.append(f"{label}: {words}, first in row {first}: time goes on")

    for period, words in _PERIODS.items():
        turns = np.where(np.abs(np.abs(steps) - period) <= close, np.sign(steps), 0)
        if turns.any() and turns[np.flatnonzero(turns)[0]] < 0:  # what leaps ahead first is a pause
            take(turns, period, f"begins anew after {words}")
    hours = np.where((back == 0) & (np.abs(np.abs(steps) - _HOUR_NS) <= close), np.sign(steps), 0)
    if np.count_nonzero(hours) == 1:
        take(hours, _HOUR_NS, f"is set {'back' if hours.sum() < 0 else 'ahead'} by an hour, as for daylight saving")
    unwrapped = stamp.copy()
    unwrapped[rows[1:]] -= np.cumsum(back)
    return unwrapped, notes


def packets(stamp: TimeArray) -> tuple[float, float] | None:
    """How many rows arrive at once, and how long after the packet before [s]; None where rows come one by one."""
    steps = np.diff(stamp[stamp != NO_STAMP])
    usual = float(np.median(steps)) if len(steps) else math.inf
    begins = steps > _WAITS * max(usual, 1.0)
    count = int(np.count_nonzero(begins))
    if usual > _AT_ONCE_NS or count < max(_FEWEST, _MANY * len(steps)) or 2 * count > len(steps):
        return None
    every = float(np.median(steps[begins])) / 1e9
    return ((len(steps) + 1) / (count + 1), every) if every >= _LEAST_WAIT else None


def spread(stamp: TimeArray, number: FloatArray) -> TimeArray:
    """Stamps of rows that a counter numbers, evenly along the earliest arrivals: when each was made, or little later.

    No row arrives before it is made. So the line from number to stamp lies below all arrivals; of such lines it is
    the one that is nearest to them on average, an edge of their convex hull.
    """
    has_both = (stamp != NO_STAMP) & np.isfinite(number)
    if not has_both.any():
        return stamp
    origin, middle = stamp[has_both].min(), float(np.median(number[has_both]))
    hull: list[tuple[float, float]] = []
    at, arrival = number[has_both] - middle, (stamp[has_both] - origin).astype(np.float64)
    order = np.lexsort((arrival, at))
    for point in zip(at[order].tolist(), arrival[order].tolist(), strict=True):
        if hull and point[0] == hull[-1][0]:  # a number again, later
            continue
        while len(hull) > 1:
            (a, low), (b, high) = hull[-2:]
            if (high - low) * (point[0] - a) < (point[1] - low) * (b - a):  # the way over the last one bends up
                break
            hull.pop()
        hull.append(point)
    if len(hull) < 2:
        return stamp
    corner = min(max(int(np.searchsorted([point for point, _ in hull], float(at.mean()))), 1), len(hull) - 1)
    (begin, low), (end, high) = hull[corner - 1], hull[corner]
    slope = (high - low) / (end - begin)
    even = origin + np.rint(low + slope * (np.nan_to_num(number) - middle - begin)).astype(np.int64)
    return np.where(has_both, even, NO_STAMP)
