"""Faults of a log's clock.

Stray stamps, clocks set back, which cut a run into segments, stamps in another unit, clocks that are far apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np

from ..arrays import NO_STAMP, IntArray, TimeArray, median
from ..errors import RunError
from ..units import TIMES, mistaken
from .run import REFERENCE, Run
from .screening import first_zeros, without_stray_values
from .set_back import drop_steps_back
from .source import TOLERATED_STEP_BACK_NS, Source, note_rows

_OTHER_PERIOD, _OTHER_BEAT = 2.0, 1.25  # times the update period from which an interval is another one; a steady one
_MOST_LOST = 2.5  # times the update period, from which more than half of the commands are missing
_NEW_CLOCK = 3  # so many rows in a row with another time: the clock was set anew; fewer are stray
_MOST_JUMPS = 100
_FEW, _MANY = 30, 10_000  # stamps, below which nothing is said about their unit, and from which it is clear
_SCATTERED, _JUMP = 5, 3.0  # periods of a short gap, and steps as large as a usual one that a long one hides
_MANY_LOST, _OFF_TICK = 0.03, 0.25  # shares: of commands in motion, above which it is said; of a period
_CORRECT = "Correct the unit of its time in run.toml"
_LONG_GAP = 1.0  # s, of commands in motion, from which one gap is said
_ALTERNATE = 0.9  # share of intervals from which a short one and a long one take turns
_EVEN = 0.1  # spread of intervals over the usual one, up to which commands are a steady stream
_HOUR_NS = 3_600_000_000_000
_LONG_NS = 87_660 * _HOUR_NS  # ten years: no log is as long
LONGEST_TAIL_NS = _HOUR_NS  # measurements this long after the last command no longer belong to the run
_TAIL_NS = 1_000_000_000  # that belong to the motion after the last command


def behind(stamp: TimeArray) -> TimeArray:
    """Lag of each row behind the latest stamp before it [ns], 0 for a row in order or without a stamp, (rows,)."""
    if _ascends(stamp):
        return np.zeros(len(stamp), dtype=np.int64)
    return np.where(stamp == NO_STAMP, 0, np.maximum.accumulate(stamp) - stamp)


def in_order(stamp: TimeArray, first: int = 0) -> IntArray | slice:
    """The rows by stamp, those without one first, from the ``first`` on; most logs are in order."""
    return slice(first, None) if _ascends(stamp) else np.argsort(stamp, kind="stable")[first:]


def _ascends(stamp: TimeArray) -> bool:
    return bool((stamp[1:] >= stamp[:-1]).all())


def stray_offsets(stamp: TimeArray) -> IntArray:
    """Offset of each stray stamp from the time that the rows around it agree on [ns]; 0 for all others, (rows,).

    One or two rows in a row are stray if the log goes on after them where it was before them. With the row before them
    that is not stray itself, the row after them, and 1 s for "far":

    - each is far ahead of both, or far behind the one before; and the row after is not far behind the one before;
    - at the beginning of the log: each is far ahead of the row after, and of three rows at least;
    - at its end: each is far behind the row before, and three rows at least are before.

    One row is tried before two. Three in a row or more are never stray: there the clock was set anew. A row that is
    ahead and never contradicted is a pause. Rows without a stamp are skipped.
    """
    offsets = np.zeros(len(stamp), dtype=np.int64)
    stamped = np.flatnonzero(stamp != NO_STAMP) if NO_STAMP in stamp else slice(None)
    known_stamps = stamp[stamped]
    back = np.flatnonzero(np.diff(known_stamps) < -TOLERATED_STEP_BACK_NS) + 1
    if not len(back):
        return offsets
    apart = np.zeros(len(known_stamps), dtype=np.int64)
    stamps: list[int] = known_stamps.tolist()
    before, after = -1, 0  # the last row that is not stray before `after`
    for row in np.unique(back[:, None] - [2, 1, 0]).tolist():  # nothing else can begin what ends in a step back
        if row < after:
            continue
        before = before if row == after else row - 1
        after = row + _stray_from(stamps, before, row)
        if after > row:
            apart[row:after] = known_stamps[row:after] - known_stamps[before if before >= 0 else after]
    edges = np.flatnonzero(np.diff(apart != 0, prepend=False, append=False))
    for first, end in edges.reshape(-1, 2).tolist():
        if end - first >= _NEW_CLOCK:
            apart[first:end] = 0
    offsets[stamped] = apart
    return offsets


def _stray_from(stamp: Sequence[int], before: int, row: int) -> int:
    """Number of stray rows from ``row`` on, 0, 1 or 2; ``before`` is the last row before them that is not, −1: none."""
    far = TOLERATED_STEP_BACK_NS
    for after in range(row + 1, min(row + _NEW_CLOCK, len(stamp) + 1)):
        out = stamp[row:after]
        if before < 0:
            stray = len(stamp) - after >= _NEW_CLOCK and min(out) > stamp[after] + far
        elif after == len(stamp):
            stray = before + 1 >= _NEW_CLOCK and max(out) < stamp[before] - far
        else:
            low, high = stamp[before] - far, max(stamp[before], stamp[after]) + far
            stray = stamp[after] >= low and all(row_out < low or row_out > high for row_out in out)
        if stray:
            return after - row
    return 0


def without_strays(run: Run) -> Run:
    """The run without stray stamps (see :func:`stray_offsets`) and commands, and a note on each source that has any.

    Before that, stamps of clocks that were set back by up to 1 s are shifted so that they go on
    (:func:`.set_back.drop_steps_back`).

    Their rows stay, without a stamp: commands are not used, measurements are invalid. Rows of sensors and of the
    reference that are far behind keep their stamps, since they disturb no other: they become too late. This is done
    once, because what is left of nonsense stamps may look stray again.
    """
    if run.without_strays:
        return run
    run, steps = drop_steps_back(run)
    notes = [*run.notes, *steps]

    def mended(label: str, source: Source) -> Source:
        if _ascends(source.stamp):
            return source
        apart = stray_offsets(source.stamp)
        if source is not run.command:
            apart = np.maximum(apart, 0)
        if not apart.any():
            return source
        for side, rows in (("ahead of", apart > 0), ("behind", apart < 0)):
            if rows.any():
                what = f"a stray stamp, more than 1 s {side} the rows around: taken for none"
                note_rows(notes, label, rows, what, f", by {abs(apart[rows][0]) / 1e9:.3f} s")
        return replace(source, stamp=np.where(apart == 0, source.stamp, NO_STAMP))

    screened_run = run.each(mended)

    def set_from(source: Source, label: str, others: Sequence[Source]) -> Source:
        if not (zeros := first_zeros(source, others)):
            return source
        unset = np.arange(len(source.stamp)) < zeros
        note_rows(notes, label, unset, "zeros before the first value, far from it: taken as missing")
        return replace(source, values={axis: np.where(unset, np.nan, value) for axis, value in source.values.items()})

    commanded = screened_run.command
    sensors = {
        name: set_from(source, source.label_for(name), [commanded]) for name, source in screened_run.sensors.items()
    }
    command = set_from(commanded, commanded.label, list(sensors.values()))
    reference = screened_run.reference
    if reference is not None:
        reference = set_from(reference, reference.label, [commanded])
    screened_run = replace(screened_run, command=command, sensors=sensors, reference=reference)
    command = without_stray_values(screened_run.command, list(screened_run.sensors.values()), notes)
    return replace(screened_run, command=command, notes=tuple(notes), without_strays=True)


def segments(run: Run) -> tuple[list[Run], list[str]]:
    """Cut a run where the commands' clock was set back by more than 1 s: the segments, and a sentence on each jump.

    A segment is a run of its own, at rest at its first command. The clocks of the sensors and the reference must have
    been set back as often as that of the commands. A sensor whose clock was set back alone cuts nothing: its rows
    become too late.
    """
    run = without_strays(run)
    cuts = _jumps(run.command)
    if not cuts:
        return [run], []
    if run.interval:
        back = f"the clock is set back in row {cuts[0] + 1}, so that '{run.interval}' is of two times"
        raise RunError(f"{run.command.label}: {back}; cut the log there first")

    def pieces(source: Source) -> list[Source]:
        jumps = _jumps(source)
        if len(jumps) != len(cuts):
            raise RunError(
                f"{run.command.label}: the commands' clock is set back {len(cuts)} times (first in row {cuts[0] + 1}),"
                f" that of {source.label} {len(jumps)} times; cut the log there and fuse the parts one by one"
            )
        return [source.rows(slice(*edges)) for edges in pairwise([0, *jumps, len(source.stamp)])]

    measured = {name: pieces(source) for name, source in run.measured.items()}
    parts = list[Run]()
    for index, command in enumerate(pieces(run.command)):
        sensors = {name: parts[index] for name, parts in measured.items()}
        reference = None if run.reference is None else sensors.pop(REFERENCE)
        part = run if index == 0 else replace(run, start={}, notes=())
        parts.append(replace(part, command=command, sensors=sensors, reference=reference))
    lag, what = behind(run.command.stamp) / 1e9, f"{run.command.label}: the clock is set back by"
    notes = [f"{what} {lag[row]:.3f} s in row {row + 1}: new segment, filter restarted" for row in cuts]
    return parts, notes


def _jumps(source: Source) -> list[int]:
    """Rows at which the clock was set back by more than 1 s."""
    jumps, first = list[int](), 0
    while len(back := np.flatnonzero(behind(source.stamp[first:]) > TOLERATED_STEP_BACK_NS)):
        jumps.append(first := first + int(back[0]))
        if len(jumps) > _MOST_JUMPS:
            raise RunError(
                f"{source.label}: the stamps step back by more than 1 s over {_MOST_JUMPS} times: not one clock,"
                " or many runs in one table (run.toml chooses one by 'where')"
            )
    return jumps


def clock_faults(run: Run, period: float, sensors: Iterable[str]) -> list[str]:
    """A sentence on each of some sensors whose stamps are not of the commands' time; ``period`` is the arm's T [s]."""
    clock_faults, label, stamp = list[str](), run.command.label, run.command.stamp
    command = np.sort(stamp[stamp != NO_STAMP], kind="stable")
    first = run.command.series(run.axes[0])[0] if run.command.apart else command
    sentence, kind = interval_fault(first, period) or ("", "other")
    if kind in ("unit", "lost"):
        advice = _CORRECT if kind == "unit" else "Log every command"
        raise RunError(f"{label}: {sentence} {advice}, or correct update_period_ms in arm.toml")
    clock_faults += [f"{label}: {sentence}"] if sentence else []
    if kind != "senders" and (missing := missing_commands(run.command)) is not None:
        clock_faults.append(f"{label}: {missing}: the model holds the one before; log every command")
    for name in sensors:
        stamp = run.sensors[name].stamp
        stamp = np.sort(stamp[stamp != NO_STAMP], kind="stable")  # fast where they are in order
        if not len(stamp):
            continue
        span, commanded = (float(part[-1] - part[0]) / 1e9 for part in (stamp, command))
        if min(len(stamp), len(command)) >= _FEW and (units := mistaken(span / max(commanded, 1e-9), TIMES)):
            raise RunError(
                f"{run.sensors[name].label_for(name)}: measurements go on for {span:.4g} s, the commands for"
                f" {commanded:.4g} s: {_taken(units)} {_CORRECT}"
            )
        clock_faults += [f"{name}: {fault}" for fault in _apart(stamp, int(command[0]), int(command[-1]))]
    return clock_faults


def interval_fault(stamp: TimeArray, period: float) -> tuple[str, Literal["senders", "unit", "lost", "other"]] | None:
    """What is wrong with the intervals of commands by ascending stamps, beside the update period [s]; None: nothing.

    A sentence, and what it is: commands of two ``senders`` that lie between each other, stamps in another ``unit``, a
    steady stream in which most commands are ``lost``, or another interval (who sends only what changes leaves commands
    out on purpose).
    """
    every = np.diff(stamp[:_MANY])  # rows that share a stamp are there, even if only the last one counts
    intervals = every[every > 0]
    if len(intervals) < _FEW:
        return None
    quarters = len(intervals) * np.arange(1, 4) // 4  # numpy's quantile takes ten times as long
    early, usual, late = map(float, np.partition(intervals, quarters)[quarters] / 1e9)
    pairs = (intervals[1:] + intervals[:-1]) / 1e9
    both = median(pairs)
    near = np.minimum(np.abs(intervals / 1e9 - early), np.abs(intervals / 1e9 - late)) < _EVEN * both
    alternate = min(np.mean(np.abs(pairs - both) < _EVEN * both), np.mean(near)) >= _ALTERNATE
    if alternate and late - early >= _EVEN * both and 1.0 / _OTHER_BEAT < both / period < _OTHER_BEAT:
        each = f"each sends every {both * 1e3:.4g} ms, one {early * 1e3:.4g} ms after the other"
        asked = "is one of them too many? The model follows whichever came last"
        return f"commands of two senders: {each}: {asked}", "senders"
    units, even = mistaken(usual / period, TIMES), late - early <= _EVEN * usual
    if units and even:
        times = f"{usual:.4g} s, {usual / period:.4g} times the arm's update_period_ms = {period * 1e3:g}"
        return f"commands come every {times}: {_taken(units)}", "unit"
    far = _OTHER_BEAT if even else _OTHER_PERIOD
    if 1.0 / far < usual / period < far:
        return None
    lost = "are most of them lost, or is it another one?" if usual > period else "is it another one?"
    times = f"{usual * 1e3:.4g} ms, {usual / period:.3g} times the arm's update_period_ms = {period * 1e3:g}"
    is_lost = even and float(every.mean()) / 1e9 > _MOST_LOST * period
    return f"commands come every {times}: {lost}", "lost" if is_lost else "other"


def missing_commands(command: Source, origin: int | None = None) -> str | None:
    """A sentence if commands of a steady stream are missing where they move: many, or for longer than a second.

    Short gaps count in mid-motion, long ones if the command jumps: who sends a command only when it changes leaves the
    others out on purpose. Times are told since ``origin`` [ns], or the first command.
    """
    rows = np.flatnonzero(command.stamp != NO_STAMP)
    rows = rows[np.append(True, np.diff(command.stamp[rows]) > 0)[: len(rows)]]
    intervals = np.diff(command.stamp[rows]) / 1e9
    if len(intervals) < _FEW or (intervals <= 0.0).any():
        return None
    usual = median(intervals)
    ticks = np.rint(intervals / usual)
    if np.sum(ticks[ticks > 1.0] - 1.0) < _FEW or np.mean(np.abs(intervals / usual - ticks) > _OFF_TICK) > _EVEN:
        return None
    steps = np.abs(np.diff([value[rows] for value in command.values.values()], axis=1))
    largest = np.fmax.reduce(np.where(ticks == 1, steps, 0.0), axis=1, keepdims=True)
    jumps = np.any(steps > _JUMP * largest, axis=0)
    moving = np.pad(np.any(steps > 0.0, axis=0), 1)
    moving, on = moving[1:-1], moving[:-2] & moving[1:-1] & moving[2:]
    gaps = (ticks > 1) & np.where(ticks > _SCATTERED, jumps, on)
    missing, sent = int(np.sum(ticks[gaps] - 1)), int(np.count_nonzero(moving))
    longest = int(np.argmax(np.where(gaps, intervals, 0.0)))
    if missing < _FEW or (missing <= _MANY_LOST * (missing + sent) and intervals[longest] < _LONG_GAP):
        return None
    begin = (command.stamp[rows[longest]] - (command.stamp[rows[0]] if origin is None else origin)) / 1e9
    return (
        f"{missing} of {missing + sent} commands are missing while the arm moves (one is due every"
        f" {usual * 1e3:.4g} ms), the longest gap is {intervals[longest]:.3g} s, from {begin:.2f} s on"
    )


def _taken(units: Sequence[tuple[str, str]]) -> str:
    words = " or ".join(f"{true} that are called {called}" for true, called in units)
    return f"are its stamps {words}?"


def _apart(stamp: TimeArray, first: int, last: int) -> list[str]:
    """A sentence if most stamps, ascending, are before the first command or after the last, or hours after it."""
    middle, tail = int(stamp[len(stamp) // 2]), int(stamp[-1]) - last
    if first <= middle <= last + _TAIL_NS:
        if tail <= LONGEST_TAIL_NS:
            return []
        return [f"measurements go on for {_duration(tail)} after the last command: are both stamped by one clock?"]
    every = stamp[-1] < first or stamp[0] > last
    side, apart = "before the first" if middle < first else "after the last", int(stamp[0]) - first
    hours, why = round(abs(apart) / _HOUR_NS), ""
    if abs(apart) > _LONG_NS:
        why = " One may count from 1970, the other from when a computer was switched on"
    elif hours and abs(abs(apart) - hours * _HOUR_NS) < 60 * _TAIL_NS:
        why = " Is one of another time zone?"
    return [
        f"{'all' if every else 'most'} measurements lie {side} command, their stamps begin {_duration(abs(apart))}"
        f" {'before' if apart < 0 else 'after'} those of the commands: are both stamped by one clock?{why}"
    ]


def _duration(time: int) -> str:
    units = {"years": 8766 * _HOUR_NS, "days": 24 * _HOUR_NS, "hours": _HOUR_NS, "s": _TAIL_NS}
    unit = next((name for name, size in units.items() if time >= size), "s")
    return f"{time / units[unit]:.4g} {unit}"
