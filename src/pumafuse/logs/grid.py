"""Fit of a controller's even ticks of T to stamps that jitter."""

from __future__ import annotations

import math
from typing import cast

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray, TimeArray
from ..errors import RunError

COMMANDS = "commands"
_MOST_LATE = 9  # a stamp's ticks are sought from this many before it ...
_CHOICES = _MOST_LATE + 3  # ... to two after it
_LATE, _LATE_COST, _LATER_COST = math.sqrt(0.5), 0.5, 0.01
_BLOCK = 64  # commands over which the two clocks' drift is small against T
_MOST_DRIFT = 1e-3  # two quartz clocks differ by 1e-4 at the worst
_MOST_ASTRAY = 0.08  # share of stamps that may be more than half a period off their tick
_LONGEST_QUEUE = 8  # commands that a stalled logger may stamp late in a row
_LEAST_CLEAR = 0.2  # resultant of the stamps' phases: that of a Gaussian jitter of 0.29 T; 0 where there are no ticks
_MOST_EARLY = 5.0  # standard deviations of the jitter; nothing but jitter stamps a command before it is given
_ROUGHLY, _FIRST = 0.03, 32  # share by which the median interval may differ from a tick; rows that are looked at first
_MOST_ASIDE = 0.01  # share of commands that the jitter may put on a free tick beside their own, unseen


def regular_grid(stamp: TimeArray, period: float, label: str, what: str = COMMANDS) -> tuple[TimeArray, str | None]:
    """The stamps moved to the controller's even ticks of T, with a note on drift and stamps off their ticks.

    Each command has a tick of its own, in the order of the stamps. Of all such assignments the one with the least sum
    of squared distances is taken, which for a Gaussian jitter is the likeliest. Stamps more than 0.7 T late cost the
    same however late they are, since a logger that stalls stamps a queue of commands at once: they are set back between
    their neighbours and move no other.

    The grid's offset is the median of the residuals. T is exact unless the slope of the stamps differs from it by more
    than 5 standard errors: then the two clocks drift apart, the slope is used and the drift is noted.

    A wrong assignment shows in the residuals and is refused: too many stamps off their ticks, a row of them on one side
    longer than a logger's queue, one earlier than the jitter explains, phases so spread that any period would fit as
    well, or so much jitter beside missing ticks that more than 1 % of the commands may be a tick aside.
    """
    tick = period * 1e9
    since = (stamp - stamp[0]).astype(np.float64)
    indices = _places(since, tick)
    ticks = assigned_ticks(indices)
    if ticks is None:
        shared = int(np.sum(np.diff(np.rint(indices)) <= 0))
        fault = f"{shared} of {len(stamp)} are stamped nearest to the tick of the one before"
        raise _refusal(fault, stamp, period, label, what)
    notes: list[str] = []
    if len(stamp) >= _BLOCK:
        fit = cast(tuple[FloatArray, FloatArray], np.polyfit(ticks, since, 1, cov=True))
        slope, error = float(fit[0][0]), math.sqrt(fit[1][0, 0])
        drift = slope / tick - 1.0
        if abs(slope - tick) > max(5.0 * error, 1.0 / np.ptp(ticks)):
            if abs(drift) > _MOST_DRIFT:
                raise _refusal(f"on the nearest ticks they are {slope / 1e6:.4f} ms a tick", stamp, period, label, what)
            tick = slope
            notes.append(f"the log's clock runs {drift * 1e6:+.1f} ppm against the controller's; the grid follows it")
    residual = since - ticks * tick
    offset = float(np.median(residual))
    off = (residual - offset) / tick
    astray, early = int(np.sum(np.abs(off) > 0.5)), int(np.sum(off < -0.5))
    if doubt := _doubt(ticks, off):
        fault = f"{astray} of {len(stamp)} are stamped more than half a period off their ticks, {doubt}"
        raise _refusal(fault, stamp, period, label, what)
    if astray:
        how = "late: set back to their ticks" if not early else f"off their ticks, {early} of them early: put on them"
        notes.append(f"{astray} {what} are stamped more than half a period {how}")
    note = f"{label}: {'; '.join(notes)}" if notes else None
    return stamp[0] + np.rint(ticks * tick + offset).astype(np.int64), note


def ticks_of(stamp: TimeArray) -> float:
    """The period [s] of ascending stamps that jitter, by their periodogram: of a few rows first, then of more."""
    since = (stamp - stamp[0]).astype(np.float64)
    tick, width, size = float(np.median(np.diff(since))), _ROUGHLY, _FIRST
    while True:
        some = since[:size]
        count = max(some[-1] / tick, 1.0)
        tried = tick * (1.0 + np.arange(-width, width, 0.1 / count))  # a tenth of a turn at the last row
        clear = [abs(np.exp(2j * np.pi / tick * some).mean()) for tick in tried.tolist()]
        tick = float(tried[int(np.argmax(clear))])
        if size >= len(since):
            slope = cast(FloatArray, np.polyfit(np.rint(_places(since, tick)), since, 1))[0]
            return float(slope) / 1e9
        width, size = 0.5 / count, 8 * size


def _refusal(fault: str, stamp: TimeArray, period: float, label: str, what: str) -> RunError:
    advice = "check update_period_ms, or " if what == COMMANDS else ""
    median = float(np.median(np.diff(stamp))) / 1e6
    return RunError(
        f"{label}: clock = 'regular', but the {what} do not come on ticks of {period * 1e3:g} ms: {fault} (their"
        f" median interval is {median:.4f} ms); {advice}use clock = 'stamps'"
    )


def _doubt(ticks: IntArray, off: FloatArray) -> str | None:
    """The reason why the assignment may be wrong, or None; ``off`` are the residuals in periods, (n,)."""
    if len(off) <= 2:
        return None
    late, early = off > 0.5, -float(off.min())
    row = max(_longest(late), _longest(off < -0.5))
    clear = min(float(np.abs(np.mean(np.exp(2j * np.pi * off)))), 1.0)
    spread = math.sqrt(-2.0 * math.log(clear)) / (2.0 * math.pi) if clear > 0.0 else math.inf
    beside = _commands_aside(ticks, late, spread)
    least = max(_LEAST_CLEAR, 3.0 / math.sqrt(len(off) + 9))  # of stamps without ticks one in e⁹ reaches this
    doubts = {
        f"and more than {_MOST_ASTRAY:.0%} is too many": np.mean(np.abs(off) > 0.5) > _MOST_ASTRAY,
        f"{row} of them in a row": row > _LONGEST_QUEUE,
        "and the others lie about the ticks as they would about any": clear < least,
        f"one of them {early:.2f} periods early, where the jitter's standard deviation is {spread:.2f}": (
            early > max(0.5, _MOST_EARLY * spread)
        ),
        f"and some {beside:.0f} beside missing ticks may be of those": beside > max(_MOST_ASIDE * len(off), 2.0),
    }
    return next((words for words, holds in doubts.items() if holds), None)


def _commands_aside(ticks: IntArray, late: BoolArray, spread: float) -> float:
    """Expected number of commands a tick aside: by the jitter beside a free tick, or in a queue behind one."""
    free = np.concatenate(([False], np.diff(ticks) > 1))
    order = np.arange(len(ticks))
    queue = np.maximum.accumulate(np.where(late, 0, order + 1))  # first row of each queue of late ones
    behind = late & (np.maximum.accumulate(np.where(free, order, -1)) >= queue)
    beside = math.erfc(0.5 / (spread * math.sqrt(2.0))) if spread > 0.0 else 0.0
    return float(behind.sum()) + beside * float(free.sum())


def _longest(flag: BoolArray) -> int:
    return int(np.diff(np.flatnonzero(np.concatenate(([True], ~flag, [True])))).max()) - 1


def assigned_ticks(positions: FloatArray) -> IntArray | None:
    """Ascending ticks of least total cost for stamps in periods, (n,); None if there are too few ticks.

    Each stamp costs least on its nearest tick. Where these ticks do not ascend, the stamps about there form a group,
    which takes the cheapest ascending ticks of its own. It is widened until its ticks ascend among those around it:
    then each part costs the least it can, and so does the whole.
    """
    ticks = np.rint(positions).astype(np.int64)
    tied = np.zeros(len(positions), dtype=np.bool_)  # stamps in the group of the one before
    reach = 1
    while len(clash := np.flatnonzero(np.diff(ticks) <= 0) + 1):
        tied[np.clip(clash[:, None] + np.arange(-reach, reach + 1), 1, len(positions) - 1)] = True
        group = np.cumsum(~tied)
        rows = np.isin(group, group[clash])
        cheapest = _cheapest_ticks(positions[rows], tied[rows])
        if cheapest is None:
            return None
        ticks[rows] = cheapest
        reach *= 2  # where no tick is free for a thousand stamps, few rounds find the next one
    return ticks


def _cheapest_ticks(positions: FloatArray, tied: BoolArray) -> IntArray | None:
    """Ticks that ascend within each group at the least total cost, (n,); None if there are too few about the stamps.

    A stamp's cost is the square of its distance from the tick in periods; beyond 0.7 late it hardly grows. ``tied`` are
    stamps in the group of the one before, (n,).
    """
    first = np.floor(positions).astype(np.int64) - _MOST_LATE
    choices = np.arange(_CHOICES)
    off = positions[:, None] - (first[:, None] + choices)
    total = np.where(off > _LATE, _LATE_COST + _LATER_COST * (off - _LATE), off * off)
    # Least cost so far if the last stamp's tick is one of its first 0, 1, 2, ...; at the end 0, the cost of no stamp.
    least = np.concatenate(([math.inf], np.zeros(_CHOICES + 1)))
    # For each tick of a stamp: how many of those open to the stamp before come before it.
    before = np.clip(choices + np.diff(first, prepend=0)[:, None], 0, _CHOICES)
    before[~tied] = _CHOICES + 1
    for row, index in zip(total, before, strict=True):
        row += least[index]
        np.minimum.accumulate(row, out=least[1:-1])
    if np.isinf(total.min(axis=1)).any():
        return None
    lowest = total == np.minimum.accumulate(total, axis=1)
    choice = np.maximum.accumulate(np.where(lowest, choices, 0), axis=1)  # the cheapest one up to each
    ticks, upto = np.empty_like(first), _CHOICES
    for n in range(len(positions) - 1, -1, -1):
        chosen = choice[n, min(upto, _CHOICES) - 1]
        ticks[n], upto = first[n] + chosen, before[n, chosen]
    return ticks


def _places(since: FloatArray, tick: float) -> FloatArray:
    """The stamps in periods, (n,): whole numbers where they do not jitter.

    They are relative to a phase that follows the clocks' slow drift, so that a late stamp moves no other. The phase is
    the circular mean of the stamps over blocks, which no missing tick disturbs; over pauses it is extrapolated with the
    drift between neighbouring blocks.
    """
    start = np.concatenate(([0], np.flatnonzero(np.diff(since) > _BLOCK * tick) + 1))
    # What is between two pauses is cut evenly, so that each block has enough stamps for a phase.
    size = np.diff(np.append(start, len(since)))
    count = -(-size // _BLOCK)
    number = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    edges = np.repeat(start, count) + number * np.repeat(size, count) // np.repeat(count, count)
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
    return (since - phase[block] - drift * (since - middle[block])) / tick
