"""How each sensor of a stream does: how many rows came and how late, what is missing, the NIS of the last minute."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..arrays import ALWAYS, CodeArray, FloatArray, IndexArray, IntArray, TimeArray
from ..compiled import compiled, kernel
from .outcome import ABSENT, Outcome

SECONDS = 60  # of the past that are counted
ROWS, LATENESS, MOST_LATE, NIS, SCALARS = range(5)  # of each of them
CAME, DROPOUTS, INTERVALS, IN_A_ROW = 8, 9, 10, 11  # of a sensor, after the outcomes

_FUSED, _REACQUIRED = int(Outcome.FUSED), int(Outcome.REACQUIRED)
_FEW, _MANY = 20, 100  # intervals before a usual one is known, and those that it is a mean of
_GAP = 1.5  # usual intervals without a row: one is missing
_SLOWER = 1.1  # by dropouts in a row the usual interval grows until a slower sensor has one again


class Counters(NamedTuple):
    """What there was of each sensor.

    Attributes:
        number: Of components that have left the window by their outcome, rows that ``CAME``, ``DROPOUTS``: intervals
            over one and a half times the usual one, of how many ``INTERVALS`` the usual one is a mean, and dropouts
            ``IN_A_ROW``, (S, 12).
        last: Latest stamp, int64 ns, ``ALWAYS`` without one, (S,).
        left: Stamp of the latest row that has left the window, int64 ns, ``ALWAYS`` without one, (S,).
        usual: Usual interval [s], (S,).
        second: Which second of stream time each entry of ``minute`` is, (S, 60).
        minute: For each second: rows, sum and maximum of how late they came [s], sum of NIS, fused components, (S, 60,
            5).
    """

    number: IntArray
    last: TimeArray
    left: TimeArray
    usual: FloatArray
    second: TimeArray
    minute: FloatArray

    @staticmethod
    def none(sensors: int) -> Counters:
        """Nothing counted yet."""
        return Counters(
            number=np.zeros((sensors, IN_A_ROW + 1), dtype=np.int64),
            last=np.full(sensors, ALWAYS),
            left=np.full(sensors, ALWAYS),
            usual=np.zeros(sensors),
            second=np.full((sensors, SECONDS), ALWAYS),
            minute=np.zeros((sensors, SECONDS, 5)),
        )


@kernel
def count_rows(
    flat: tuple[Any, ...],
    source: IndexArray,
    stamps: TimeArray,
    outcome: CodeArray,
    innovation: FloatArray,
    innovation_sd: FloatArray,
    first: int,
    end: int,
    sensor: int,
    stamp: int,
    newest: int,
) -> None:
    """Count what became of the rows ``first`` to ``end``, and a measurement of ``sensor`` (−1: none) that has come.

    ``newest`` [ns] is the latest stamp of all when it came.
    """
    counters = Counters(*flat)
    for row in range(first, end):
        if source[row] >= 0:
            count_outcome(counters, source[row], stamps[row], outcome, innovation, innovation_sd, row)
    if sensor < 0:
        return
    counters.number[sensor, CAME] += 1
    counters.last[sensor] = max(counters.last[sensor], stamp)
    slot = slot_of(counters, sensor, stamp)
    if slot >= 0:
        lateness = max(newest - stamp, 0) / 1e9
        counters.minute[sensor, slot, ROWS] += 1.0
        counters.minute[sensor, slot, LATENESS] += lateness
        counters.minute[sensor, slot, MOST_LATE] = max(counters.minute[sensor, slot, MOST_LATE], lateness)


@compiled
def count_outcome(
    counters: Counters,
    sensor: int,
    stamp: int,
    outcome: CodeArray,
    innovation: FloatArray,
    innovation_sd: FloatArray,
    row: int,
) -> None:
    """Count what became of a measurement, and look at the interval from the one before: rows leave in order."""
    count_interval(counters, sensor, stamp)
    slot = slot_of(counters, sensor, stamp)
    for axis in range(outcome.shape[1]):
        if outcome[row, axis] == ABSENT:
            continue
        counters.number[sensor, outcome[row, axis]] += 1
        if outcome[row, axis] in (_FUSED, _REACQUIRED) and slot >= 0:
            counters.minute[sensor, slot, NIS] += (innovation[row, axis] / innovation_sd[row, axis]) ** 2
            counters.minute[sensor, slot, SCALARS] += 1.0


def count_duplicate(counters: Counters, sensor: int, outcome: CodeArray) -> None:
    """Count the values (A,) of a measurement that repeats another."""
    counters.number[sensor] += np.bincount(outcome[outcome != ABSENT], minlength=counters.number.shape[1])


def forget_after(counters: Counters, after: int) -> None:
    """Let the counters not know of what is stamped after ``after`` [ns]."""
    counters.last[counters.last > after] = ALWAYS
    counters.second[counters.second > after // 1_000_000_000] = ALWAYS


@compiled
def count_interval(counters: Counters, sensor: int, stamp: int) -> None:
    """Look at the interval from the row before; rows leave the window in order, when those that came late are in."""
    number, before = counters.number, counters.left[sensor]
    counters.left[sensor] = stamp
    if before == ALWAYS:
        return
    interval, usual = (stamp - before) / 1e9, counters.usual[sensor]
    number[sensor, INTERVALS] += 1
    if number[sensor, INTERVALS] > _FEW and interval > _GAP * usual:
        number[sensor, DROPOUTS] += 1
        number[sensor, IN_A_ROW] += 1
        if number[sensor, IN_A_ROW] > 1:  # not a row that is missing: the sensor is slower now
            counters.usual[sensor] *= _SLOWER
        return
    number[sensor, IN_A_ROW] = 0
    counters.usual[sensor] = usual + (interval - usual) / min(number[sensor, INTERVALS], _MANY)


@compiled
def slot_of(counters: Counters, sensor: int, stamp: int) -> int:
    """Where the second of a stamp is counted, −1 if it is over a minute old."""
    second = stamp // 1_000_000_000
    slot = second % SECONDS
    if second < counters.second[sensor, slot]:
        return -1
    if second > counters.second[sensor, slot]:
        counters.second[sensor, slot] = second
        for kind in range(counters.minute.shape[2]):
            counters.minute[sensor, slot, kind] = 0.0
    return slot
