"""The plant's input as a stream's commands make it: each command is put where its stamp says, whenever it comes."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false

from __future__ import annotations

import math
from typing import NamedTuple

from ..arrays import ALWAYS, NEVER, FloatArray, IntArray, TimeArray
from ..compiled import compiled
from ..fusion.kernels import Axes
from ..model.drive_kernels import answered, decayed, tick_time, ticks_worth

STAMP, GIVEN = range(2)  # of a row of commands: its own, and that of the command in force then
U, HELD, STEP, ERROR, MANEUVER = range(5)  # of a row: its u, and of the command in force u, step, e [m], maneuver [m/s]
COMMANDS, ENTRIES, LATEST, TICK, WORTH, DELAY = range(6)  # of an axis
SLOPE, INTERCEPT, RECOVERY, PERIOD = range(4)
INPUT_NOISE, DRIFT, MANEUVER_NOISE, MANEUVER_DRIFT = range(4)
_LONGEST_DECAY = 60.0  # recovery times after which no error that can be is worth a grid point


class Commands(NamedTuple):
    """The commands of each axis by stamp, and what each row leaves for the next.

    Attributes:
        time: ``STAMP`` and ``GIVEN``, int64 ns, ``ALWAYS`` where none was given, (A, c, 2).
        row: ``U``, ``HELD``, ``STEP``, ``ERROR`` and ``MANEUVER``, (A, c, 5).
        number: Of rows (``COMMANDS``), ``ENTRIES`` of the drive, the row of the command that the last entry belongs to
            (``LATEST``) and which of its grid points that is (``TICK``) of how many that its error is ``WORTH``, and Td
            [ns] (``DELAY``), (A, 6).
        level: u₀ [m], and 1 where it is known beforehand, (A, 2).
        gain: ``SLOPE`` [s/m], ``INTERCEPT``, ``RECOVERY`` [s] and ``PERIOD`` [s], (A, 4).
        process: Densities squared of input noise and drift at rest, and by how much a maneuver of 1 m/s raises the
            densities themselves, (A, 4).
    """

    time: TimeArray
    row: FloatArray
    number: IntArray
    level: FloatArray
    gain: FloatArray
    process: FloatArray


@compiled
def place_of(commands: Commands, axis: int, stamp: int) -> int:
    """Where a row of this stamp goes: after those of the same one."""
    at = commands.number[axis, COMMANDS]
    while at > 0 and commands.time[axis, at - 1, STAMP] > stamp:
        at -= 1
    return at


@compiled
def first_alike(commands: Commands, axis: int, at: int) -> int:
    """The first of the rows that share the stamp of row ``at``."""
    while at > 0 and commands.time[axis, at - 1, STAMP] == commands.time[axis, at, STAMP]:
        at -= 1
    return at


@compiled
def put(commands: Commands, axis: int, stamp: int, u: float) -> int:
    """Put in a row; returns its place, −1 if it only says again what the last row of its stamp says."""
    at = place_of(commands, axis, stamp)
    time, row = commands.time, commands.row
    if at > 0 and time[axis, at - 1, STAMP] == stamp and row[axis, at - 1, U] == u:
        return -1
    for later in range(commands.number[axis, COMMANDS], at, -1):
        time[axis, later, STAMP], row[axis, later, U] = time[axis, later - 1, STAMP], row[axis, later - 1, U]
    time[axis, at, STAMP], row[axis, at, U] = stamp, u
    commands.number[axis, COMMANDS] += 1
    return at


@compiled
def drive(axes: Axes, commands: Commands, axis: int, first: int) -> None:
    """Make the entries of every command from row ``first`` on anew.

    Of rows with one stamp the last counts; the value of the row before, said again within half a period, is none.
    """
    time, table, number = commands.time, commands.row, commands.number
    cut(axes, commands, axis, time[axis, first, STAMP])
    for row in range(first, number[axis, COMMANDS]):
        stamp, u = time[axis, row, STAMP], table[axis, row, U]
        superseded = row + 1 < number[axis, COMMANDS] and time[axis, row + 1, STAMP] == stamp
        before = first_alike(commands, axis, row) - 1
        again = before >= 0 and u == table[axis, before, U]
        again = again and stamp - time[axis, before, STAMP] < 0.5e9 * commands.gain[axis, PERIOD]
        if (superseded or again) and row > 0:
            leave(commands, axis, row - 1, row)
        elif superseded:
            time[axis, row, GIVEN] = ALWAYS
        else:
            answer(axes, commands, axis, row)


@compiled
def answer(axes: Axes, commands: Commands, axis: int, row: int) -> None:
    """What the command of a row makes of the one in force before it."""
    time, table, number, gain = commands.time, commands.row, commands.number, commands.gain
    stamp, u = time[axis, row, STAMP], table[axis, row, U]
    step, interval, step_before, error = u - commands.level[axis, 0], 0.0, 0.0, 0.0
    if row > 0 and time[axis, row - 1, GIVEN] > ALWAYS:
        lengthen(axes, commands, axis, stamp - 1)
        step, interval = u - table[axis, row - 1, HELD], (stamp - time[axis, row - 1, GIVEN]) / 1e9
        step_before, error = table[axis, row - 1, STEP], table[axis, row - 1, ERROR]
    recovery, period = gain[axis, RECOVERY], gain[axis, PERIOD]
    error, maneuver, _ = answered(
        step, step_before, error, interval, gain[axis, SLOPE], gain[axis, INTERCEPT], recovery, period
    )
    time[axis, row, GIVEN] = stamp
    table[axis, row, HELD], table[axis, row, STEP] = u, step
    table[axis, row, ERROR], table[axis, row, MANEUVER] = error, maneuver
    number[axis, LATEST], number[axis, TICK], number[axis, WORTH] = row, 0, ticks_worth(error, recovery, period)
    enter(axes, commands, axis, stamp, (u - commands.level[axis, 0]) + error, maneuver)


@compiled
def leave(commands: Commands, axis: int, here: int, there: int) -> None:
    """What is in force after one row is so after another."""
    commands.time[axis, there, GIVEN] = commands.time[axis, here, GIVEN]
    for kind in range(HELD, MANEUVER + 1):
        commands.row[axis, there, kind] = commands.row[axis, here, kind]


@compiled
def cut(axes: Axes, commands: Commands, axis: int, since: int) -> None:
    """Take back the entries issued at ``since`` [ns] or later, and see how far the command before is carried on."""
    time, number, gain = commands.time, commands.number, commands.gain
    delay, first = number[axis, DELAY], axes.first[axis]
    at = first + number[axis, ENTRIES] - 1
    while at >= first and axes.acting[at] - delay >= since:
        axes.acting[at] = NEVER
        at -= 1
    number[axis, ENTRIES] = at + 1 - first
    row = place_of(commands, axis, since - 1) - 1
    number[axis, LATEST], number[axis, TICK], number[axis, WORTH] = row, 0, 0
    if row >= 0 and time[axis, row, GIVEN] > ALWAYS:
        held = axes.acting[at] - delay - time[axis, row, GIVEN]
        number[axis, TICK] = int(held / (gain[axis, PERIOD] * 1e9) + 0.5)
        number[axis, WORTH] = ticks_worth(commands.row[axis, row, ERROR], gain[axis, RECOVERY], gain[axis, PERIOD])


@compiled
def lengthen(axes: Axes, commands: Commands, axis: int, until: int) -> None:
    """Carry the latest command on over the grid points of T up to ``until`` [ns], as far as its error lasts."""
    number, row = commands.number, commands.number[axis, LATEST]
    recovery, period = commands.gain[axis, RECOVERY], commands.gain[axis, PERIOD]
    while number[axis, TICK] < number[axis, WORTH]:
        tick = number[axis, TICK] + 1
        issued = commands.time[axis, row, GIVEN] + tick_time(tick, period)
        if issued > until:
            return
        value = decayed(commands.row[axis, row, ERROR], tick, recovery, period)
        value = (commands.row[axis, row, HELD] - commands.level[axis, 0]) + value
        number[axis, TICK] = tick
        enter(axes, commands, axis, issued, value, commands.row[axis, row, MANEUVER])


@compiled
def enter(axes: Axes, commands: Commands, axis: int, issued: int, value: float, maneuver: float) -> None:
    """One more entry of the drive."""
    process, at = commands.process, axes.first[axis] + commands.number[axis, ENTRIES]
    noise, drift = process[axis, MANEUVER_NOISE] * maneuver, process[axis, MANEUVER_DRIFT] * maneuver
    axes.acting[at], axes.value[at] = issued + commands.number[axis, DELAY], value
    axes.noise[at] = process[axis, INPUT_NOISE] + noise * noise
    axes.drift[at] = process[axis, DRIFT] + drift * drift
    commands.number[axis, ENTRIES] += 1


@compiled
def crowded(axes: Axes, commands: Commands, axis: int, since: int, until: int) -> bool:
    """Whether the entries might not fit that rows from ``since`` [ns] on make, with grid points up to ``until``."""
    recovery, period = commands.gain[axis, RECOVERY], commands.gain[axis, PERIOD]
    first, count = place_of(commands, axis, since), commands.number[axis, COMMANDS]
    made = count - first + 2
    if recovery < math.inf and count > 0:
        begins = commands.time[axis, first - 1, STAMP] if first > 0 else since
        ends = max(until, commands.time[axis, count - 1, STAMP])
        most = (made + 1) * (_LONGEST_DECAY * recovery / period + 1.0)
        if since == NEVER:  # no new command: only what is left of the latest one's grid
            most = float(commands.number[axis, WORTH] - commands.number[axis, TICK])
        made += int(min((ends - begins) / (period * 1e9) + 1.0, most))
    return commands.number[axis, ENTRIES] + made > axes.first[axis + 1] - axes.first[axis]


@compiled
def withdraw(axes: Axes, commands: Commands, axis: int, after: int) -> int:
    """Take back the rows stamped after ``after`` [ns]; returns the stamp of the first of them, or ``NEVER``."""
    first = place_of(commands, axis, after)
    if first == commands.number[axis, COMMANDS]:
        return NEVER
    stamp = commands.time[axis, first, STAMP]
    commands.number[axis, COMMANDS] = first
    cut(axes, commands, axis, after + 1)
    if first > 0:
        drive(axes, commands, axis, first_alike(commands, axis, first - 1))
    return stamp


@compiled
def drop_rows(commands: Commands, axis: int, oldest: int) -> None:
    """Let go of the rows stamped before ``oldest`` [ns], but for the last of them."""
    last = place_of(commands, axis, oldest - 1) - 1
    gone = first_alike(commands, axis, last) if last > 0 else 0
    if gone == 0:
        return
    commands.number[axis, COMMANDS] -= gone
    # The row in force may be gone; the first that is left carries the same, for only repetitions follow it there.
    commands.number[axis, LATEST] = max(commands.number[axis, LATEST] - gone, 0)
    for row in range(commands.number[axis, COMMANDS]):
        commands.time[axis, row, STAMP] = commands.time[axis, row + gone, STAMP]
        commands.row[axis, row, U] = commands.row[axis, row + gone, U]
        leave(commands, axis, row + gone, row)


@compiled
def drop_entries(axes: Axes, commands: Commands, axis: int, gone: int) -> None:
    """Let go of the first ``gone`` entries."""
    end = axes.first[axis + 1]
    commands.number[axis, ENTRIES] -= gone
    for at in range(axes.first[axis], end - gone):
        axes.acting[at], axes.value[at] = axes.acting[at + gone], axes.value[at + gone]
        axes.noise[at], axes.drift[at] = axes.noise[at + gone], axes.drift[at + gone]
    for at in range(end - gone, end):
        axes.acting[at] = NEVER
