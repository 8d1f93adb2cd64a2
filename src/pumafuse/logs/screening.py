"""Values that tell nothing: commands that nobody sent, and what a sensor says again and again."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray, TimeArray, median
from ..units import TURN
from .source import Source, note_rows

USUAL = 0.9  # of all steps are smaller than the usual one: more are not stray, and jumps of a motion may be as rare
FAR = 5.0  # usual steps from which a value leaps: where a motion begins or turns it is about one
BACK = 0.5  # of a leap, up to which what comes after it is back where it began
MOST_STRAY = 2  # values in a row; three are a motion
FEWEST = 20  # changes, from which a usual step is known
BRIEF = 2.5  # usual intervals between changes, up to which one value may last
_FOLLOWED_NS, _FOLLOWED = 1_000_000_000, 3.0  # within 1 s an arm shows it: by steps so many times as large as before
_BEGINNING = 200  # rows after zeros
_UNLIKE = 3.0  # times as far as any step of these, from which zeros were no position
_STEPS = 10.0  # of its resolution, and ...
_CLEARLY = 5.0  # ... of its usual steps, that a sensor must have missed
_FROZEN = 5  # equal values in a row, from which it is asked whether a sensor froze
_BY_CHANCE = 1e-12  # a probability with which noise explains no row of equal values in any log
_SHARE = 0.2  # of the commanded travel, that nobody takes for play or for stiction
_COARSE = 3.0  # typical over smallest step of a value: below it a sensor counts steps
_MOSTLY = 1.5  # times that each value comes, on the mean: half of them, or more, come again


def lost(position: FloatArray) -> BoolArray:
    """The rows in which x, y and z are all zero, as a sensor writes them when it has lost its target, (n,).

    In the sensor's own frame that place is inside the sensor, where no target can be.
    """
    return (position == 0.0).all(axis=1)


def first_zeros(source: Source, others: Sequence[Source]) -> int:
    """How many rows at the beginning of a source are zeros of variables that nobody had set yet.

    Then all that it tells leaps at once, farther than by any step soon after, to where one of the ``others`` was from
    the first, or leapt in the same row.
    """
    if not source.values or not len(source.stamp) or any(value[0] != 0.0 for value in source.values.values()):
        return 0
    values = np.array(list(source.values.values()))
    first = int(np.argmax((values != 0.0).any(axis=0)))
    after = values[:, first : first + _BEGINNING]
    if first == 0 or after.shape[1] < FEWEST:
        return 0
    leapt = np.abs(after[:, 0]) > _UNLIKE * np.fmax.reduce(np.abs(np.diff(after, axis=1)), axis=1)
    if (values[:, first][~leapt] != 0.0).any():
        return 0

    begin, last, leap = (int(source.stamp[row]) for row in (0, first - 1, first))

    def was_there(axis: str, level: float) -> bool:
        series = (other.series(axis) for other in others if axis in other.values)
        for stamp, value in ((stamp, value) for stamp, value in series if len(stamp)):
            then = max(int(np.searchsorted(stamp, begin, side="right")) - 1, 0)
            set_at = int(np.argmax(value != 0.0))  # unset before, too: nothing follows within a row
            rows = [then, set_at] if last < int(stamp[set_at]) <= leap else [then]
            if any(abs(float(value[row]) - level) < BACK * abs(level) for row in rows):
                return True
        return False

    levels = zip(source.values, values[:, first].tolist(), leapt.tolist(), strict=True)
    return first if all(was_there(axis, level) for axis, level, has_leapt in levels if has_leapt) else 0


def usual_of(steps: FloatArray) -> float:
    """The step that few others exceed; numpy's quantile takes longer, and imports masked arrays (0.02 s)."""
    rank = int(USUAL * len(steps))
    return float(np.partition(steps, rank)[rank])


def leaps(value: float, before: float, usual: float) -> bool:
    """Whether a value is many times the usual step away from the one before, and not by a turn or two of an angle."""
    apart = abs(value - before)
    turns = 1 if apart < 1.5 * TURN else 2
    return apart > FAR * usual and not abs(apart - turns * TURN) <= FAR * usual


def returns(value: float, before: float, out: Iterable[float]) -> bool:
    """Whether a value is back near the one before those that leapt ``out``."""
    return abs(value - before) < BACK * min(min(abs(stray - before), abs(stray - value)) for stray in out)


def without_stray_values(command: Source, sensors: Sequence[Source], notes: list[str]) -> Source:
    """The commands without values that nobody sent: NaN, with a note."""
    if command.joints is not None:  # what nobody sent is among these, and a pose is of all of them
        screened = without_stray_values(command.in_joints(), [sensor.in_joints() for sensor in sensors], notes)
        if not len(screened.stray):
            return command
        told = np.column_stack([screened.values[joint] for joint in command.joints.chain.joints])
        values = {**command.values, **{axis: screened.values[axis] for axis in screened.values.keys() & command.values}}
        return replace(command, values=values, stray=screened.stray).posed(command.joints._replace(values=told))
    values, left_out = dict(command.values), np.zeros(len(command.stamp), dtype=np.bool_)
    for axis, value in command.values.items():
        told = command.ordered(axis)
        measured = [sensor.series(axis) for sensor in sensors if axis in sensor.values]
        stray = np.zeros(len(value), dtype=np.bool_)
        stray[told] = _stray(command.stamp[told], value[told], measured)
        if stray.any():
            values[axis], left_out = np.where(stray, np.nan, value), left_out | stray
            what = f"a value of {axis} that leaps away from its neighbours and back, which nothing follows: stray"
            note_rows(notes, command.label, stray, f"{what}, not used")
    return replace(command, values=values, stray=left_out) if left_out.any() else command


def _stray(stamp: TimeArray, value: FloatArray, sensors: Sequence[tuple[TimeArray, FloatArray]]) -> BoolArray:
    """Which of the commands of an axis, by stamp, are stray, (rows,)."""
    is_stray = np.zeros(len(value), dtype=np.bool_)
    begin = np.flatnonzero(np.diff(value, prepend=np.nan) != 0.0)  # a table may say each several times
    if len(begin) <= FEWEST:
        return is_stray
    steps = np.abs(np.diff(value[begin]))
    usual, interval = usual_of(steps), median(np.diff(stamp[begin]).astype(np.float64))
    u, t, end = value[begin].tolist(), stamp[begin].tolist(), [*begin[1:].tolist(), len(value)]

    def pace(row: int, way: int) -> float:
        """How far the commands go beside a row, one stray value apart."""
        beside = (min(max(row + way * many, 0), len(u) - 1) for many in (1, 2))
        return min(abs(u[row_beside] - u[row]) for row_beside in beside)

    row = 1  # the first that may be stray
    for stray_row in (np.flatnonzero(steps > FAR * usual) + 1).tolist():
        if stray_row < row:
            continue
        before = stray_row - 1
        for after in range(stray_row + 1, min(stray_row + MOST_STRAY + 1, len(u))):
            typical, out = max(usual, pace(before, -1), pace(after, 1)), u[stray_row:after]
            brief = t[after] - t[stray_row] <= BRIEF * interval * (after - stray_row)
            away = all(leaps(stray, u[beside], typical) for stray in out for beside in (before, after))
            if brief and away and returns(u[after], u[before], out):
                if not any(_follows(*sensor, t[stray_row]) for sensor in sensors):
                    is_stray[begin[stray_row] : end[after - 1]] = True
                    row = after + 1
                break
    return is_stray


def _follows(stamp: TimeArray, value: FloatArray, leap: int) -> bool:
    """Whether a sensor moves by far larger steps after an instant [ns] than before it, more than once."""
    edges = np.searchsorted(stamp, [leap - _FOLLOWED_NS, leap, leap + _FOLLOWED_NS]).tolist()
    before, after = (np.sort(np.abs(np.diff(value[begin:end]))) for begin, end in pairwise(edges))
    return len(after) > 1 and len(before) > 1 and bool(after[-2] > _FOLLOWED * before[-2])


class Habit(NamedTuple):
    """How the values of a sensor on an axis change from one to another."""

    smallest: float  # of its steps [m or rad]
    typical: float  # their median
    usual: float  # the one than which few are larger
    times: int  # how often each value comes in a row, typically, if it holds its samples; else 1

    @staticmethod
    def of(steps: FloatArray, lengths: IntArray) -> Habit:
        """The habit by steps other than 0, and by how often each value came.

        A long row of equal values at rest is one row of many, and coarse steps repeat by themselves: neither is held.
        """
        low, middle = float(steps.min()), median(steps)
        holds = middle >= _COARSE * low and lengths.mean() >= _MOSTLY
        return Habit(low, middle, usual_of(steps), int(median(lengths.astype(np.float64))) if holds else 1)

    def froze(self, count: int, moved: float, travel: float, leapt: bool, repeats: float) -> bool:
        """Whether a value that came ``count`` times is that of a sensor that froze, not of an axis that rests.

        Meanwhile the commands ``moved`` the axis, of its whole ``travel`` [m or rad]. It may have ``leapt`` away from
        the values beside it; other values are repeated so often, of 1.
        """
        if count < _FROZEN * self.times or moved <= self.clear:
            return False
        unlikely = self.times == 1 and repeats ** (count - 1) < _BY_CHANCE
        return leapt or unlikely or moved > _SHARE * travel

    @property
    def clear(self) -> float:
        """The motion [m or rad] beyond which one is clearly more than the steps of the values."""
        return max(_STEPS * self.smallest, _CLEARLY * self.typical)

    def is_again(self, count: int) -> bool:
        """Whether a value that has come ``count`` times before in a row is that of a sample that is held."""
        return self.times > 1 and count % (2 * self.times) != 0


def held(stamp: TimeArray, value: FloatArray, command: tuple[TimeArray, FloatArray], lag: int) -> tuple[BoolArray, int]:
    """Which values of a sensor on an axis are no news, (rows,); how often it gives each of them.

    A sensor that is slower than its rows gives each value several times: of these the first counts. One that froze
    gives one value while the commands move the axis by clearly more than its steps. Stamps ascend, values are finite,
    and the axis follows its commands up to ``lag`` [ns] late.
    """
    begin = np.flatnonzero(np.diff(value, prepend=np.nan) != 0.0)
    if len(begin) <= FEWEST or len(begin) == len(value):
        return np.zeros(len(value), dtype=np.bool_), 1
    count, steps = np.diff(begin, append=len(value)), np.pad(np.abs(np.diff(value[begin])), 1)
    habit = Habit.of(steps[1:-1], count[:-1])
    index = np.arange(len(value)) - np.repeat(begin, count)
    is_held = np.array([habit.is_again(index) for index in range(int(count.max()))])[index]
    leaps, travel, repeats = steps > FAR * habit.usual, float(np.ptp(command[1])), len(value) - len(begin)
    for run in np.flatnonzero(count >= _FROZEN).tolist():
        first, last = int(begin[run]), int(begin[run] + count[run] - 1)
        low, high = np.searchsorted(command[0], [stamp[first], stamp[last] - lag], side="right").tolist()
        meanwhile = slice(max(low - 1, 0), high)
        told = command[1][meanwhile]
        moved = float(np.ptp(told)) if len(told) else 0.0
        elsewhere = (repeats - count[run] + 1) / (len(value) - count[run])
        if habit.froze(int(count[run]), moved, travel, bool(leaps[run : run + 2].any()), elsewhere):
            if not leaps[run]:  # what it leaps to is where nobody was; before it is moved, an axis rests
                since = _moved_since(command[0][meanwhile], told, habit.clear, int(stamp[first]), lag)
                first = max(first + 1, int(np.searchsorted(stamp, since)))
            is_held[first : last + 1] = True
    return is_held, habit.times


def _moved_since(told_at: TimeArray, told: FloatArray, clear: float, since: int, lag: int) -> int:
    """When commands [ns] begin to move an axis clearly that had rested for longer than it follows; else ``since``."""
    until = int(np.argmax(np.abs(told - told[0]) > clear))
    changes = told_at[1 : until + 1][np.diff(told[: until + 1]) != 0.0]
    rests = np.flatnonzero(np.diff(changes, prepend=since) > lag)
    return int(changes[rests[-1]]) if len(rests) else since
