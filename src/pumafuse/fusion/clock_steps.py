"""Where the clock of a sensor was set while it measured: from there on it follows the commands later, or sooner.

By its stamps alone a clock that was set ahead looks like an outage, and one that was set back like a few rows too many.
A clock that was set is one that the motion shows, too: how late a sensor follows changes by as much as its stamps leap.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import FloatArray, TimeArray, median
from ..discovery.matching import Grid, Rows, best_shift, lateness, without_spikes
from ..model.arm import ArmModel
from .segments import Segment

_LEAST_NS, _MOST_NS = 40_000_000, 1_200_000_000  # by which stamps leap
_OF_USUAL, _CROWDED = 0.5, 0.75  # of the usual interval: a leap at least; two rows in a row that are nearer are crowded
_MOST = 20  # leaps of a sensor that are looked at, the longest ones: one that often loses rows has more
_SPAN_NS, _SHORTEST_NS = 20_000_000_000, 2_000_000_000  # on both sides of a leap, in which motion is compared
_FEW = 30  # rows on each side
_BIN, _REACH = 0.01, 2.0  # s: bins, and shifts that are tried
_PARTS = 6  # of a side, each of which is left out once: as the lateness scatters then, so uncertain it is
_EXACT = 2e-3  # s, to which a lateness is known at best
_SURELY = 5.0  # standard errors by which lateness changes
_AGREE = 3.0  # standard errors by which the lateness may change by more or less than stamps leap
_LOST = 0.1  # share of the rows of a leap that may be lost, besides one
_ABOUT = 1.0 / 3.0  # of the change, within which a lateness is about as before
_FOLLOWS = math.log(1.0 - 0.9**2)  # what is left of the motion of a sensor that follows: a correlation of 0.9
_BETTER = math.log(2.0)  # what is left about the lateness of the other side, over the least: twice as much or more


class Leap(NamedTuple):
    """Where instants by the stamps of a sensor leap."""

    last: int  # the one before [ns]
    first: int  # the one after it [ns]
    by: float  # by how much more time goes by than the rows take [s]; below 0 there are more rows than time
    rows: int  # how many intervals that are
    usual: float  # the usual one [s]


class ClockStep(NamedTuple):
    """A clock that was set."""

    leap: Leap
    before: float  # how late the sensor follows the commands before it [s]
    after: float  # and after it [s]
    error: float  # standard error of the difference [s]

    @property
    def change(self) -> float:
        """How much later the sensor follows the commands [s]."""
        return self.after - self.before

    @property
    def by(self) -> float:
        """How far the clock was set ahead [s]: what stamps leap by, less the rows that were lost meanwhile."""
        lost = round((self.leap.by - self.change) / self.leap.usual)
        return self.leap.by - lost * self.leap.usual


class _Side(NamedTuple):
    """What a sensor measures on one side of a leap, and where the commands lead."""

    measured: Mapping[str, FloatArray]  # means of bins by axis, (n,)
    led: Mapping[str, FloatArray]  # (n + 2m,)
    grid: Grid

    def error(self) -> float:
        """Standard error of the lateness [s], by leaving out parts."""
        size = len(self.grid.time) - 2 * self.grid.margin
        part = np.arange(size) * _PARTS // size
        each = list[float]()
        for number in range(_PARTS):
            measured = {axis: np.where(part == number, np.nan, value) for axis, value in self.measured.items()}
            each.append(best_shift(lateness(measured, self.led, self.grid), self.grid))
        return math.sqrt(_PARTS - 1) * float(np.std(each))


def find_clock_steps(
    segment: Segment, arm: ArmModel, valid: TimeArray, positions: Mapping[str, Rows]
) -> list[ClockStep]:
    """Where the clock of a sensor was set, in the order of time.

    Its rows are ``valid`` at these instants, also those that measure nothing, ascending [ns], (n,).
    """
    steps, every, edges = list[ClockStep](), find_leaps(valid), list[int]()
    while every:
        likely = [step for leap in every if (step := _clock_step(segment, arm, positions, leap, edges))]
        if likely:  # near a clock that was set, an outage looks like another one until rows beyond are left out
            steps.append(max(likely, key=lambda step: abs(step.change) / step.error))
            edges += [steps[-1].leap.last, steps[-1].leap.first]
        every = [step.leap for step in likely if step is not steps[-1]]
    return sorted(steps, key=lambda step: step.leap.first)


def find_leaps(stamp: TimeArray) -> list[Leap]:
    """Where ascending stamps leap [ns], (n,); the longest first."""
    interval = np.diff(stamp)
    if len(interval) < _FEW or (usual := median(interval)) <= 0.0:
        return []
    least = max(_LEAST_NS, _OF_USUAL * usual)
    begin = np.flatnonzero(interval >= usual + least)
    end = begin + 1
    crowded = np.flatnonzero(stamp[2:] - stamp[:-2] < 2.0 * _CROWDED * usual)
    if len(crowded):
        ends = np.flatnonzero(np.diff(crowded) > 2)  # one that is not, as rows lie between each other, ends nothing
        begin = np.concatenate([begin, crowded[np.append(0, ends + 1)]])
        end = np.concatenate([end, crowded[np.append(ends, -1)] + 2])
    by = stamp[end] - stamp[begin] - (end - begin) * usual
    size = np.abs(by)
    some = np.flatnonzero((size >= least) & (size <= _MOST_NS))
    longest = some[np.argsort(-size[some], kind="stable")][:_MOST].tolist()
    return [
        Leap(int(stamp[begin[k]]), int(stamp[end[k]]), float(by[k]) / 1e9, int(end[k] - begin[k]), usual / 1e9)
        for k in longest
    ]


def _clock_step(
    segment: Segment, arm: ArmModel, positions: Mapping[str, Rows], leap: Leap, edges: Sequence[int]
) -> ClockStep | None:
    """The leap as a clock that was set; None where the motion does not show surely that it was.

    Rows beyond the ``edges`` [ns], where it was set, too, tell nothing.
    """
    begin = max([leap.last - _SPAN_NS, *(edge for edge in edges if edge <= leap.last)])
    end = min([leap.first + _SPAN_NS, *(edge for edge in edges if edge >= leap.first)])
    earlier, later = (_side(segment, arm, positions, *ends) for ends in ((begin, leap.last), (leap.first, end)))
    if earlier is None or later is None:
        return None
    left = lateness(*earlier), lateness(*later)  # log of the share of motion that is left at each shift, (2m + 1,)
    before, after = (best_shift(unexplained, earlier.grid) for unexplained in left)
    if not all(map(_is_following, left)):
        return None
    if _gain(left[0], before, after) < _BETTER or _gain(left[1], after, before) < _BETTER:
        return None
    step = ClockStep(leap, before, after, math.hypot(_EXACT, earlier.error(), later.error()))
    apart = _AGREE * step.error + (1.0 + _LOST * leap.rows) * leap.usual
    agrees = step.change * leap.by > 0.0 and abs(step.change - leap.by) < apart
    return step if agrees and abs(step.change) > _SURELY * step.error else None


def _side(segment: Segment, arm: ArmModel, positions: Mapping[str, Rows], begin: int, end: int) -> _Side | None:
    """What is measured between two instants [ns]; None where that is too little."""
    rows = dict[str, Rows]()
    for axis, (valid, position) in positions.items():
        rows_here = slice(*np.searchsorted(valid, (begin, end + 1)).tolist())
        alike = without_spikes(position[rows_here])
        if np.count_nonzero(alike) >= _FEW:
            rows[axis] = valid[rows_here][alike], position[rows_here][alike]
    if not rows:
        return None
    first, last = min(int(valid[0]) for valid, _ in rows.values()), max(int(valid[-1]) for valid, _ in rows.values())
    if last - first < _SHORTEST_NS:
        return None
    grid = Grid.around(first, (last - first) / 1e9, _BIN, round(_REACH / _BIN))
    led = {axis: segment.response(arm, axis, grid.time) for axis in rows}
    return _Side({axis: grid.mean(*row) for axis, row in rows.items()}, led, grid)


def _is_following(unexplained: FloatArray) -> bool:
    """Whether a sensor follows at the best shift and beside it: where little is commanded there may be no valley."""
    lag = int(np.argmin(unexplained))
    return float(np.pad(unexplained, 1)[lag : lag + 3].max()) < _FOLLOWS


def _gain(unexplained: FloatArray, shift_here: float, other: float) -> float:
    """How much more is left about another lateness [s] than at the best, as a logarithm.

    About: within a third of the way, as a motion that repeats itself looks alike at another lateness.
    """
    shift = _BIN * np.arange(-(len(unexplained) // 2), len(unexplained) // 2 + 1)
    about = np.abs(shift - other) <= max(abs(other - shift_here) * _ABOUT, 0.5 * _BIN)
    return float(unexplained[about].min() - unexplained.min())
