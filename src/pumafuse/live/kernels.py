"""A window of the stream in the compiled filter's own arrays: rows and commands go in where their stamps say.

Rows of measurements lie in a ring in their total order, each beside a checkpoint of the filter before it. What comes
late is put in its place, the filter goes back to the checkpoint there and meets everything after it again, by the very
kernels that fuse a recorded run.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false
# pyright: reportCallIssue=false

from __future__ import annotations

import math

from ..arrays import ALWAYS, NEVER, FloatArray, IntArray, TimeArray
from ..compiled import compiled
from ..fusion.kernels import Held, Log, Met, Outputs, Rows, Sensors, State, estimate, go_back, keep, meet
from ..fusion.outcome import FARTHEST, Outcome
from .command_kernels import (
    COMMANDS,
    DELAY,
    GIVEN,
    STAMP,
    Commands,
    U,
    crowded,
    drive,
    drop_entries,
    drop_rows,
    first_alike,
    lengthen,
    put,
    withdraw,
)
from .memory import (
    ABSENT,
    BECAME,
    BEGIN,
    CHANGED,
    END,
    KNOWN,
    ORIGIN,
    SPREAD,
    VALUE,
    Flat,
    Heard,
    Nothing,
    opened,
)
from .tally_kernels import NIS, SCALARS, Tally, came, followed, slot_of, unheard

DONE, NO_ROOM = range(2)

_FUSED, _REACQUIRED, _INVALID = int(Outcome.FUSED), int(Outcome.REACQUIRED), int(Outcome.INVALID)
_DUPLICATE, _BEFORE_START, _UNKNOWN = int(Outcome.DUPLICATE), int(Outcome.BEFORE_START), int(Outcome.UNKNOWN)


@compiled
def hear(flat: Flat, stamp: int, sensor: int, given: int, newest: int, horizon: int) -> int:
    """Take in the row in ``heard.new``, of the axes that are bits of ``given``; what became of it is in ``heard.told``.

    Rows valid before ``horizon`` [ns] leave the window; ``newest`` [ns] is the latest stamp of all. Without an axis
    nothing comes in: the rows from ``CHANGED`` on are met again.
    """
    m = opened(flat)
    rows, heard, axes, mask = m.rows, m.heard, len(m.heard.told), len(m.rows.valid) - 1
    at, late, valid = heard.span[CHANGED], True, ALWAYS
    if given:
        retire(rows, m.met, heard, m.tally, horizon)
        valid = stamp - heard.latency[sensor]
        if heard.span[END] - heard.span[BEGIN] > mask:
            return NO_ROOM
    last = max(valid, rows.valid[(heard.span[END] - 1) & mask]) if heard.span[END] > heard.span[BEGIN] else valid
    for axis in range(axes):
        if crowded(m.axes, m.commands, axis, NEVER, last - m.commands.number[axis, DELAY]):
            return NO_ROOM
    if given:
        at = row_place(rows, heard, valid, sensor)
        came(m.tally, sensor, stamp, newest)
        if not insert(m.sensors, rows, heard, at, stamp, valid, sensor, given):
            for axis in range(axes):
                if heard.told[axis] != ABSENT:
                    heard.told[axis] = _DUPLICATE
                    m.tally.number[sensor, _DUPLICATE] += 1
            return DONE
        late = at + 1 < heard.span[END]
    log = no_log(m.nothing)
    for axis in range(axes):
        lengthen(m.axes, m.commands, axis, last - m.commands.number[axis, DELAY])
    if late:
        go_back(m.state, m.kept, at & mask)
    for position in range(at, heard.span[END]):
        here = position & mask
        keep(m.state, m.kept, here)
        arrange(rows, m.commands, heard, here)
        if rows.end[here] > rows.first[here]:
            meet(m.axes, m.sensors, rows, m.state, m.met, log, here)
        for component in range(rows.first[here], rows.end[here]):
            heard.code[here, rows.axis[component], BECAME] = m.met.outcome[component]
    if given:
        for axis in range(axes):
            heard.told[axis] = heard.code[at & mask, axis, BECAME]
    return DONE


@compiled
def command(flat: Flat, stamp: int, given: int, horizon: int) -> int:
    """Take in the command in ``heard.new``, of the axes that are bits of ``given``; the answer is in ``heard.told``."""
    m = opened(flat)
    axes, commands, heard, mask = m.axes, m.commands, m.heard, len(m.rows.valid) - 1
    retire(m.rows, m.met, heard, m.tally, horizon)
    last = max(stamp, m.rows.valid[(heard.span[END] - 1) & mask]) if heard.span[END] > heard.span[BEGIN] else stamp
    since, first = NEVER, False
    for axis in range(len(heard.told)):
        heard.told[axis] = ABSENT
        if given >> axis & 1:
            if commands.number[axis, COMMANDS] == commands.time.shape[1] or crowded(axes, commands, axis, stamp, last):
                return NO_ROOM
            heard.told[axis] = _FUSED if abs(heard.new[axis, VALUE]) < FARTHEST else _INVALID
            first |= heard.told[axis] == _FUSED and stamp < heard.span[ORIGIN]
    if first:
        since, heard.span[ORIGIN] = ALWAYS, stamp
        for axis in range(len(heard.told)):
            m.kept.clock[-1, axis] = m.kept.fused[-1, axis] = stamp
            start_again(m.state, m.kept, heard, axis)
    for axis in range(len(heard.told)):
        if heard.told[axis] == _FUSED:
            at = put(commands, axis, stamp, heard.new[axis, VALUE])
            if at < 0:
                heard.told[axis] = _DUPLICATE
                continue
            at_once = first_alike(commands, axis, at)
            if at_once == 0 and settle(m.sensors, commands, axis):
                start_again(m.state, m.kept, heard, axis)
            drive(axes, commands, axis, at_once)
            since = min(since, stamp + commands.number[axis, DELAY] if at_once > 0 else ALWAYS)
            if commands.time[axis, at, GIVEN] != stamp:
                heard.told[axis] = _DUPLICATE
    heard.span[CHANGED] = first_valid(m.rows, heard, since)
    return DONE


@compiled
def ask(flat: Flat, held: tuple[FloatArray, ...], outputs: tuple[FloatArray, ...], time: int) -> int:
    """Every axis at ``time`` [ns] by all rows valid until then, into ``outputs``; nothing changes."""
    m = opened(flat)
    for axis in range(len(m.heard.told)):
        until = time - m.commands.number[axis, DELAY]
        if crowded(m.axes, m.commands, axis, NEVER, until):
            return NO_ROOM
        lengthen(m.axes, m.commands, axis, until)
    mask = len(m.rows.valid) - 1
    at = first_valid(m.rows, m.heard, time + 1)
    keep(m.state, m.kept, mask + 1)
    if at < m.heard.span[END]:
        go_back(m.state, m.kept, at & mask)
    for axis in range(len(m.heard.told)):
        m.heard.fused[axis] = m.state.fused[axis]
    log = no_log(m.nothing)
    estimate(m.axes, m.state, log, time, Held(*held), Outputs(*outputs), 0)
    go_back(m.state, m.kept, mask + 1)
    return DONE


@compiled
def forget(flat: Flat, after: int) -> None:
    """Take back every row and command stamped after ``after`` [ns]: they were of another clock."""
    m = opened(flat)
    rows, heard, mask, since = m.rows, m.heard, len(m.rows.valid) - 1, NEVER
    for axis in range(len(heard.told)):
        stamp = withdraw(m.axes, m.commands, axis, after)
        if stamp < NEVER and m.commands.number[axis, COMMANDS] == 0:  # it had only just begun
            since = ALWAYS
            start_again(m.state, m.kept, heard, axis)
        elif stamp < NEVER:
            since = min(since, stamp + m.commands.number[axis, DELAY])
    for sensor in range(len(m.tally.last)):
        unheard(m.tally, sensor, after)
    left, first, end = heard.span[BEGIN], heard.span[END], heard.span[END]
    for position in range(heard.span[BEGIN], end):
        here = position & mask
        if heard.stamp[here] <= after:
            sensor = rows.sensor[here]
            m.tally.last[sensor] = max(m.tally.last[sensor], heard.stamp[here])
            if left < position:
                move(rows, heard, here, left & mask)
            left += 1
            continue
        first = min(first, position)
        for axis in range(len(heard.told)):
            if heard.code[here, axis, KNOWN] != ABSENT:
                m.tally.number[rows.sensor[here], _INVALID] += 1
    heard.span[END] = left
    heard.span[CHANGED] = min(first, first_valid(rows, heard, since))
    if heard.span[CHANGED] == left and left < end:
        go_back(m.state, m.kept, left & mask)


@compiled
def count(flat: Flat) -> None:
    """Add the rows that are still in the window to the tally."""
    m = opened(flat)
    for position in range(m.heard.span[BEGIN], m.heard.span[END]):
        became(m.rows, m.met, m.heard, m.tally, position & (len(m.rows.valid) - 1))


@compiled
def let_go(flat: Flat, horizon: int) -> None:
    """Let go of the rows valid before ``horizon`` [ns]."""
    m = opened(flat)
    retire(m.rows, m.met, m.heard, m.tally, horizon)


@compiled
def compact(flat: Flat, oldest: int) -> None:
    """Let go of commands stamped before ``oldest`` [ns], all but the last, and of entries that no state needs."""
    m = opened(flat)
    begin, end, mask = m.heard.span[BEGIN], m.heard.span[END], len(m.rows.valid) - 1
    for axis in range(len(m.heard.told)):
        drop_rows(m.commands, axis, oldest)
        gone = m.kept.entry[begin & mask, axis] if begin < end else m.state.entry[axis]
        if gone > 0:
            drop_entries(m.axes, m.commands, axis, gone)
            m.state.entry[axis] -= gone
            for position in range(begin, end):
                m.kept.entry[position & mask, axis] -= gone


@compiled
def row_place(rows: Rows, heard: Heard, valid: int, sensor: int) -> int:
    """The position of a new row in the total order: time, sensor, then as they come."""
    mask, at = len(rows.valid) - 1, heard.span[END]
    while at > heard.span[BEGIN]:
        before = (at - 1) & mask
        if rows.valid[before] < valid or (rows.valid[before] == valid and rows.sensor[before] <= sensor):
            return at
        at -= 1
    return at


@compiled
def insert(
    sensors: Sensors, rows: Rows, heard: Heard, at: int, stamp: int, valid: int, sensor: int, given: int
) -> bool:
    """Put the new row at its position; False if its stamp and values are those of a row before."""
    mask = len(rows.valid) - 1
    for axis in range(len(heard.told)):
        heard.told[axis] = ABSENT
        if given >> axis & 1:
            possible = abs(heard.new[axis, VALUE]) < FARTHEST
            heard.told[axis] = _UNKNOWN if math.isnan(sensors.sd[sensor, axis]) else _FUSED if possible else _INVALID
    for position in range(at - 1, heard.span[BEGIN] - 1, -1):
        here = position & mask
        if rows.valid[here] != valid or rows.sensor[here] != sensor:
            break
        if same(heard, here):
            return False
    for position in range(heard.span[END], at, -1):
        move(rows, heard, (position - 1) & mask, position & mask)
    heard.span[END] += 1
    here = at & mask
    rows.valid[here], rows.sensor[here], heard.stamp[here] = valid, sensor, stamp
    for axis in range(len(heard.told)):
        heard.code[here, axis, KNOWN] = heard.told[axis]
        heard.value[here, axis, VALUE], heard.value[here, axis, SPREAD] = (
            heard.new[axis, VALUE],
            heard.new[axis, SPREAD],
        )
    return True


@compiled
def same(heard: Heard, here: int) -> bool:
    """Whether a row gives what the new one gives."""
    for axis in range(len(heard.told)):
        if heard.code[here, axis, KNOWN] != heard.told[axis]:
            return False
        a, b = heard.value[here, axis, VALUE], heard.new[axis, VALUE]
        if heard.told[axis] != ABSENT and not (a == b or (math.isnan(a) and math.isnan(b))):
            return False
    return True


@compiled
def move(rows: Rows, heard: Heard, here: int, there: int) -> None:
    """Copy a row to another place; what follows from it is made anew when it is met again."""
    rows.valid[there], rows.sensor[there], heard.stamp[there] = rows.valid[here], rows.sensor[here], heard.stamp[here]
    for axis in range(len(heard.told)):
        heard.code[there, axis, KNOWN] = heard.code[here, axis, KNOWN]
        for kind in range(2):
            heard.value[there, axis, kind] = heard.value[here, axis, kind]


@compiled
def arrange(rows: Rows, commands: Commands, heard: Heard, here: int) -> None:
    """Line up the components of a row that the filter is to decide on."""
    axes = len(heard.told)
    component = here * axes
    rows.first[here] = component
    for axis in range(axes):
        known = heard.code[here, axis, KNOWN]
        unstarted = commands.number[axis, COMMANDS] == 0 and commands.level[axis, 1] == 0.0
        if known == _FUSED and (unstarted or rows.valid[here] < heard.span[ORIGIN]):
            known = _BEFORE_START
        heard.code[here, axis, BECAME] = known
        if known == _FUSED:
            rows.axis[component], rows.value[component] = axis, heard.value[here, axis, VALUE]
            rows.spread[component] = heard.value[here, axis, SPREAD]
            component += 1
    rows.end[here] = component


@compiled
def retire(rows: Rows, met: Met, heard: Heard, tally: Tally, horizon: int) -> None:
    """Let go of rows that nothing can change any more."""
    mask = len(rows.valid) - 1
    while heard.span[BEGIN] < heard.span[END] and rows.valid[heard.span[BEGIN] & mask] < horizon:
        became(rows, met, heard, tally, heard.span[BEGIN] & mask)
        heard.span[BEGIN] += 1


@compiled
def became(rows: Rows, met: Met, heard: Heard, tally: Tally, here: int) -> None:
    """Count what became of a row."""
    sensor = rows.sensor[here]
    followed(tally, sensor, heard.stamp[here])
    for axis in range(len(heard.told)):
        if heard.code[here, axis, BECAME] != ABSENT:
            tally.number[sensor, heard.code[here, axis, BECAME]] += 1
    slot = slot_of(tally, sensor, heard.stamp[here])
    for component in range(rows.first[here], rows.end[here]):
        fused = met.outcome[component] == _FUSED or met.outcome[component] == _REACQUIRED
        if fused and slot >= 0:
            tally.minute[sensor, slot, NIS] += (met.innovation[component] / met.innovation_sd[component]) ** 2
            tally.minute[sensor, slot, SCALARS] += 1.0


@compiled
def first_valid(rows: Rows, heard: Heard, since: int) -> int:
    """Position of the first row valid at ``since`` [ns] or later: commands come before measurements of the same instant."""
    mask, at = len(rows.valid) - 1, heard.span[END]
    while at > heard.span[BEGIN] and rows.valid[(at - 1) & mask] >= since:
        at -= 1
    return at


@compiled
def no_log(nothing: Nothing) -> Log:
    """A smoother's log that nothing is written to."""
    whole, real = nothing.whole, nothing.real
    return Log(whole, whole, whole, whole, real, real, nothing.table)


@compiled
def start_again(state: State, kept: State, heard: Heard, axis: int) -> None:
    """Put an axis to rest at its start level, before all that is still in the window."""
    if heard.span[BEGIN] == heard.span[END]:
        rest(state.x, state.P, state.clock, state.entry, state.fused, kept, axis)
    else:
        first = heard.span[BEGIN] & (len(heard.stamp) - 1)
        rest(kept.x[first], kept.P[first], kept.clock[first], kept.entry[first], kept.fused[first], kept, axis)


@compiled
def rest(
    x: FloatArray, P: FloatArray, clock: TimeArray, entry: IntArray, fused: TimeArray, kept: State, axis: int
) -> None:
    """One axis as it is at rest, which is kept in the last place."""
    clock[axis], entry[axis], fused[axis] = kept.clock[-1, axis], kept.entry[-1, axis], kept.fused[-1, axis]
    for i in range(x.shape[1]):
        x[axis, i] = kept.x[-1, axis, i]
        for j in range(x.shape[1]):
            P[axis, i, j] = kept.P[-1, axis, i, j]


@compiled
def settle(sensors: Sensors, commands: Commands, axis: int) -> bool:
    """Let the axis start from its first command, where its start level is not known; True if that is a new level."""
    last = 0
    while last + 1 < commands.number[axis, COMMANDS] and (
        commands.time[axis, last + 1, STAMP] == commands.time[axis, 0, STAMP]
    ):
        last += 1
    u = commands.row[axis, last, U]
    if commands.level[axis, 1] > 0.0 or commands.level[axis, 0] == u:
        return False
    commands.level[axis, 0] = u
    for sensor in range(len(sensors.scale)):
        sensors.level[sensor, axis] = sensors.scale[sensor] * u
    return True
