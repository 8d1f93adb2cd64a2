"""How each sensor does, counted row by row: how many came and how late, what is missing, the NIS of the last minute."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false

from __future__ import annotations

from typing import NamedTuple

from ..arrays import ALWAYS, FloatArray, IntArray, TimeArray
from ..compiled import compiled

SECONDS = 60  # of the past that a tally tells of
ROWS, LATENESS, MOST_LATE, NIS, SCALARS = range(5)  # of each of them
CAME, DROPOUTS, INTERVALS, IN_A_ROW = 8, 9, 10, 11  # of a sensor, after the outcomes

_FEW, _MANY = 20, 100  # intervals before a usual one is known, and those that it is a mean of
_GAP = 1.5  # usual intervals without a row: one is missing
_SLOWER = 1.1  # by dropouts in a row the usual interval grows until a slower sensor has one again


class Tally(NamedTuple):
    """What there was of each sensor.

    Attributes:
        number: Of components that have left the window by their outcome, rows that ``CAME``, ``DROPOUTS``: intervals
            over one and a half times the usual one, of how many ``INTERVALS`` that was learnt, and dropouts
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


@compiled
def unheard(tally: Tally, sensor: int, after: int) -> None:
    """Let a sensor's tally not know of what is stamped after ``after`` [ns]."""
    if tally.last[sensor] > after:
        tally.last[sensor] = ALWAYS
    for slot in range(SECONDS):
        if tally.second[sensor, slot] > after // 1_000_000_000:
            tally.second[sensor, slot] = ALWAYS


@compiled
def came(tally: Tally, sensor: int, stamp: int, newest: int) -> None:
    """Count a row that has come."""
    tally.number[sensor, CAME] += 1
    tally.last[sensor] = max(tally.last[sensor], stamp)
    slot = slot_of(tally, sensor, stamp)
    if slot >= 0:
        lateness = max(newest - stamp, 0) / 1e9
        tally.minute[sensor, slot, ROWS] += 1.0
        tally.minute[sensor, slot, LATENESS] += lateness
        tally.minute[sensor, slot, MOST_LATE] = max(tally.minute[sensor, slot, MOST_LATE], lateness)


@compiled
def followed(tally: Tally, sensor: int, stamp: int) -> None:
    """Look at the interval from the row before; rows leave the window in order, when those that came late are in."""
    number, before = tally.number, tally.left[sensor]
    tally.left[sensor] = stamp
    if before == ALWAYS:
        return
    interval, usual = (stamp - before) / 1e9, tally.usual[sensor]
    number[sensor, INTERVALS] += 1
    if number[sensor, INTERVALS] > _FEW and interval > _GAP * usual:
        number[sensor, DROPOUTS] += 1
        number[sensor, IN_A_ROW] += 1
        if number[sensor, IN_A_ROW] > 1:  # not a row that is missing: the sensor is slower now
            tally.usual[sensor] *= _SLOWER
        return
    number[sensor, IN_A_ROW] = 0
    tally.usual[sensor] = usual + (interval - usual) / min(number[sensor, INTERVALS], _MANY)


@compiled
def slot_of(tally: Tally, sensor: int, stamp: int) -> int:
    """Where the second of a stamp is tallied, −1 if it is over a minute old."""
    second = stamp // 1_000_000_000
    slot = second % SECONDS
    if second < tally.second[sensor, slot]:
        return -1
    if second > tally.second[sensor, slot]:
        tally.second[sensor, slot] = second
        for kind in range(tally.minute.shape[2]):
            tally.minute[sensor, slot, kind] = 0.0
    return slot
