"""A window of the stream in the compiled filter's own arrays: rows and commands go in where their stamps say.

Rows of readings lie in a ring in their total order, each beside a checkpoint of the filter before it. What comes late
is put in its place, the filter goes back to the checkpoint there and meets everything after it again, by the very
kernels that fuse a recorded run.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false
# pyright: reportCallIssue=false

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

from ..arrays import BoolArray, CodeArray, FloatArray, IntArray, TimeArray
from ..compiled import compiled
from ..fusion.kernels import Axes, Held, Log, Met, Outputs, Rows, Sensors, State, estimate, go_back, keep, meet
from ..fusion.timeline import FARTHEST, Outcome
from ..model.drive_kernels import answered, decayed, tick_time, ticks_worth

NEVER = 2**63 - 1
ALWAYS = -NEVER
DONE, NO_ROOM = 0, 1
ABSENT = 255  # an axis that a row does not give
SECONDS = 60  # how much of the past a tally tells of
ROWS, LATENESS, LATEST, NIS, SCALARS = range(5)

_FUSED, _REOPENED, _INVALID = int(Outcome.FUSED), int(Outcome.REOPENED), int(Outcome.INVALID)
_DUPLICATE, _BEFORE_START, _UNKNOWN = int(Outcome.DUPLICATE), int(Outcome.BEFORE_START), int(Outcome.UNKNOWN)
_FARTHEST = FARTHEST
_FEW, _MANY = 20, 100  # rows before a usual interval is known, and rows that it is a mean of
_LONGEST_DECAY = 60.0  # recovery times after which no error that can be is worth a grid point


class Commands(NamedTuple):
    """The commands of each axis by stamp, and what each row leaves for the next; (A, c) unless said.

    Attributes:
        stamp: Int64 ns.
        value: u [m].
        given: When the command in force was given, int64 ns.
        held: Its u [m].
        step: Its step [m].
        error: Its gain error e [m].
        maneuver: Its maneuver [m/s].
        count: How many rows there are, (A,).
        entries: How many entries of the drive they make, (A,).
        latest: The row of the command that the last entry belongs to, (A,).
        ticks: Which grid point of that command the last entry is, (A,).
        worth: How many grid points its error is worth, (A,).
        start: The level u₀ [m], (A,).
        fixed: Whether u₀ is known beforehand, (A,).
        delay: Td, int64 ns, (A,).
        gain: Slope [s/m], intercept, recovery [s] and T [s], (A, 4).
        process: Variance densities of the input noise and the drift at rest, and the square roots of what a maneuver of
            1 m/s adds to them, (A, 4).
    """

    stamp: TimeArray
    value: FloatArray
    given: TimeArray
    held: FloatArray
    step: FloatArray
    error: FloatArray
    maneuver: FloatArray
    count: IntArray
    entries: IntArray
    latest: IntArray
    ticks: IntArray
    worth: IntArray
    start: FloatArray
    fixed: BoolArray
    delay: TimeArray
    gain: FloatArray
    process: FloatArray


class Heard(NamedTuple):
    """The rows of readings as they came, in a ring of R, and what is asked and answered.

    Attributes:
        span: Positions of the first row and after the last one, and the first command's stamp [ns], (3,).
        stamp: Int64 ns, (R,).
        value: z [m] of each axis, NaN where absent, (R, A).
        spread: By what the noise of each is scaled, (R, A).
        known: What is known of each before filtering: a code of Outcome, or ``ABSENT``, (R, A).
        outcome: What became of each, (R, A).
        latency: Of each sensor, int64 ns, (S,).
        new: Values [m] of the event that comes in, (A,).
        new_spread: By what the noise of each is scaled, (A,).
        told: What became of them, (A,).
        fused: When the last scalar that an estimate knows of was valid, int64 ns, (A,).
    """

    span: IntArray
    stamp: TimeArray
    value: FloatArray
    spread: FloatArray
    known: CodeArray
    outcome: CodeArray
    latency: TimeArray
    new: FloatArray
    new_spread: FloatArray
    told: CodeArray
    fused: TimeArray


class Tally(NamedTuple):
    """What there was of each sensor.

    Attributes:
        outcomes: Scalars that have left the window by their outcome, (S, 8).
        rows: Rows that came, (S,).
        last: Their latest stamp, int64 ns, (S,).
        usual: Their usual interval [s], (S,).
        dropouts: Intervals over three times the usual one, (S,).
        second: Which second of stream time each entry of ``minute`` is, (S, 60).
        minute: For each second: rows, sum and maximum of how late they came [s], sum of NIS, fused scalars, (S, 60, 5).
    """

    outcomes: IntArray
    rows: IntArray
    last: TimeArray
    usual: FloatArray
    dropouts: IntArray
    second: TimeArray
    minute: FloatArray


class Memory(NamedTuple):
    """All of it. ``kept`` has two places more than the ring: one to put the state aside, one for the start."""

    axes: Axes
    sensors: Sensors
    rows: Rows
    state: State
    kept: State
    met: Met
    log: Log
    held: Held
    outputs: Outputs
    commands: Commands
    heard: Heard
    tally: Tally

    def flat(self) -> Flat:
        """As plain tuples, which a kernel takes a hundred times faster."""
        return tuple(tuple(part) for part in self)


Flat: TypeAlias = tuple[tuple[Any, ...], ...]


@compiled
def opened(flat: Flat) -> Memory:
    """The names again."""
    return Memory(
        Axes(*flat[0]),
        Sensors(*flat[1]),
        Rows(*flat[2]),
        State(*flat[3]),
        State(*flat[4]),
        Met(*flat[5]),
        Log(*flat[6]),
        Held(*flat[7]),
        Outputs(*flat[8]),
        Commands(*flat[9]),
        Heard(*flat[10]),
        Tally(*flat[11]),
    )


@compiled
def hear(flat: Flat, stamp: int, sensor: int, given: int, newest: int, horizon: int) -> int:
    """Take in the row in ``heard.new``, of the axes that are bits of ``given``; what became of it is in ``heard.told``.

    Rows valid before ``horizon`` [ns] leave the window; ``newest`` [ns] is the latest stamp of all.
    """
    m = opened(flat)
    retire(m, horizon)
    rows, heard, axes = m.rows, m.heard, len(m.heard.new)
    valid, mask = stamp - heard.latency[sensor], len(rows.valid) - 1
    begin, at = heard.span[0], heard.span[1]
    while at > begin and comes_after(rows, (at - 1) & mask, valid, sensor):
        at -= 1
    if heard.span[1] - begin > mask:
        return NO_ROOM
    last = max(valid, rows.valid[(heard.span[1] - 1) & mask]) if heard.span[1] > begin else valid
    for axis in range(axes):
        if crowded(m, axis, NEVER, last - m.commands.delay[axis]):
            return NO_ROOM
    noted(m.tally, sensor, stamp, newest)
    for axis in range(axes):
        heard.told[axis] = foreknown(m, sensor, axis, given)
    if said_before(m, at, valid, sensor):
        for axis in range(axes):
            if heard.told[axis] != ABSENT:
                heard.told[axis] = _DUPLICATE
                m.tally.outcomes[sensor, _DUPLICATE] += 1
        return DONE
    late = at < heard.span[1]
    for place in range(heard.span[1], at, -1):
        move(m, (place - 1) & mask, place & mask)
    heard.span[1] += 1
    here = at & mask
    rows.valid[here], rows.sensor[here], heard.stamp[here] = valid, sensor, stamp
    for axis in range(axes):
        heard.value[here, axis] = heard.new[axis] if heard.told[axis] != ABSENT else math.nan
        heard.spread[here, axis], heard.known[here, axis] = heard.new_spread[axis], heard.told[axis]
    if late:
        go_back(m.state, m.kept, here)
    replay(m, at)
    for axis in range(axes):
        heard.told[axis] = heard.outcome[here, axis]
    return DONE


@compiled
def command(flat: Flat, stamp: int, given: int, horizon: int) -> int:
    """Take in the command in ``heard.new``, of the axes that are bits of ``given``; the answer is in ``heard.told``."""
    m = opened(flat)
    retire(m, horizon)
    since = NEVER
    for axis in range(len(m.heard.new)):
        m.heard.told[axis] = ABSENT
        if not given >> axis & 1:
            continue
        last = m.rows.valid[(m.heard.span[1] - 1) & (len(m.rows.valid) - 1)] if m.heard.span[1] > m.heard.span[0] else stamp
        if m.commands.count[axis] == m.commands.stamp.shape[1] or crowded(m, axis, stamp, max(stamp, last)):
            return NO_ROOM
    if stamp < m.heard.span[2] and any_value(m, given):
        m.heard.span[2] = stamp
        for axis in range(len(m.heard.new)):
            m.kept.clock[-1, axis] = m.kept.fused[-1, axis] = stamp
            start_again(m, axis)
        since = ALWAYS
    for axis in range(len(m.heard.new)):
        if given >> axis & 1:
            since = min(since, obey(m, axis, stamp, m.heard.new[axis]))
    at = first_valid(m, since)
    if at < m.heard.span[1]:
        go_back(m.state, m.kept, at & (len(m.rows.valid) - 1))
        replay(m, at)
    return DONE


@compiled
def ask(flat: Flat, time: int) -> int:
    """Every axis at ``time`` [ns] by all rows valid until then, into ``outputs``; nothing changes."""
    m = opened(flat)
    for axis in range(len(m.heard.new)):
        until = time - m.commands.delay[axis]
        if crowded(m, axis, NEVER, until):
            return NO_ROOM
        lengthen(m, axis, until)
    mask = len(m.rows.valid) - 1
    aside = mask + 1
    at = m.heard.span[1]
    while at > m.heard.span[0] and m.rows.valid[(at - 1) & mask] > time:
        at -= 1
    keep(m.state, m.kept, aside)
    if at < m.heard.span[1]:
        go_back(m.state, m.kept, at & mask)
    for axis in range(len(m.heard.new)):
        m.heard.fused[axis] = m.state.fused[axis]
    estimate(m.axes, m.state, m.log, time, m.held, m.outputs, 0)
    go_back(m.state, m.kept, aside)
    return DONE


@compiled
def forget(flat: Flat, after: int) -> None:
    """Take back every row and command stamped after ``after`` [ns]: they were of another clock."""
    m = opened(flat)
    mask, heard, commands = len(m.rows.valid) - 1, m.heard, m.commands
    since = NEVER
    for axis in range(len(heard.new)):
        while commands.count[axis] > 0 and commands.stamp[axis, commands.count[axis] - 1] > after:
            commands.count[axis] -= 1
            since = min(since, commands.stamp[axis, commands.count[axis]] + commands.delay[axis])
        cut(m.axes, commands, axis, after + 1)
        if commands.count[axis] > 0:
            drive(m, axis, group(commands, axis, commands.count[axis] - 1))
    left, end = heard.span[0], heard.span[1]
    first = end
    for position in range(heard.span[0], end):
        here = position & mask
        if heard.stamp[here] <= after:
            if left < position:
                move(m, here, left & mask)
            left += 1
            continue
        first = min(first, position)
        for axis in range(len(heard.new)):
            if heard.known[here, axis] != ABSENT:
                m.tally.outcomes[m.rows.sensor[here], _INVALID] += 1
    heard.span[1] = left
    first = min(first, first_valid(m, since))
    if first < end:
        go_back(m.state, m.kept, first & mask)
    replay(m, first)


@compiled
def count(flat: Flat) -> None:
    """Add the rows that are still in the window to the tally."""
    m = opened(flat)
    for position in range(m.heard.span[0], m.heard.span[1]):
        told(m, position & (len(m.rows.valid) - 1))


@compiled
def let_go(flat: Flat, horizon: int) -> None:
    """Let go of the rows valid before ``horizon`` [ns]."""
    retire(opened(flat), horizon)


@compiled
def compact(flat: Flat, oldest: int) -> None:
    """Let go of commands stamped before ``oldest`` [ns], but for the last of them, and of entries that no state needs."""
    m = opened(flat)
    commands, mask = m.commands, len(m.rows.valid) - 1
    for axis in range(len(m.heard.new)):
        gone = max(place_of(commands, axis, oldest - 1) - 1, 0)
        gone = group(commands, axis, gone) if gone > 0 else 0
        commands.count[axis] -= gone
        commands.latest[axis] -= gone
        for row in range(commands.count[axis] if gone > 0 else 0):
            commands.stamp[axis, row], commands.value[axis, row] = (
                commands.stamp[axis, row + gone],
                commands.value[axis, row + gone],
            )
            leave(commands, axis, row + gone, row)
        begin, end = m.heard.span[0], m.heard.span[1]
        spare = m.kept.entry[begin & mask, axis] if begin < end else m.state.entry[axis]
        if spare <= 0:
            continue
        first = m.axes.first[axis]
        commands.entries[axis] -= spare
        for at in range(first, m.axes.first[axis + 1] - spare):
            m.axes.acting[at], m.axes.value[at] = m.axes.acting[at + spare], m.axes.value[at + spare]
            m.axes.noise[at], m.axes.drift[at] = m.axes.noise[at + spare], m.axes.drift[at + spare]
        for at in range(m.axes.first[axis + 1] - spare, m.axes.first[axis + 1]):
            m.axes.acting[at] = NEVER
        m.state.entry[axis] -= spare
        for position in range(begin, end):
            m.kept.entry[position & mask, axis] -= spare


@compiled
def comes_after(rows: Rows, here: int, valid: int, sensor: int) -> bool:
    """Whether a row comes after one of ``sensor`` valid at ``valid`` in the total order."""
    return rows.valid[here] > valid or (rows.valid[here] == valid and rows.sensor[here] > sensor)


@compiled
def foreknown(m: Memory, sensor: int, axis: int, given: int) -> int:
    """What is known of a new scalar before filtering."""
    if not given >> axis & 1:
        return ABSENT
    if math.isnan(m.sensors.sd[sensor, axis]):
        return _UNKNOWN
    return _FUSED if abs(m.heard.new[axis]) < _FARTHEST else _INVALID


@compiled
def said_before(m: Memory, at: int, valid: int, sensor: int) -> bool:
    """Whether the new row's stamp and values are those of one in the window; it would be put at ``at``."""
    mask = len(m.rows.valid) - 1
    for position in range(at - 1, m.heard.span[0] - 1, -1):
        here = position & mask
        if m.rows.valid[here] != valid or m.rows.sensor[here] != sensor:
            return False
        same = True
        for axis in range(len(m.heard.new)):
            a, b = m.heard.value[here, axis], m.heard.new[axis]
            same &= m.heard.known[here, axis] == m.heard.told[axis]
            same &= m.heard.told[axis] == ABSENT or a == b or (math.isnan(a) and math.isnan(b))
        if same:
            return True
    return False


@compiled
def move(m: Memory, here: int, there: int) -> None:
    """Copy a row to another place; what follows from it is made anew when it is met again."""
    m.rows.valid[there], m.rows.sensor[there] = m.rows.valid[here], m.rows.sensor[here]
    m.heard.stamp[there] = m.heard.stamp[here]
    for axis in range(len(m.heard.new)):
        m.heard.value[there, axis], m.heard.spread[there, axis] = m.heard.value[here, axis], m.heard.spread[here, axis]
        m.heard.known[there, axis] = m.heard.known[here, axis]


@compiled
def replay(m: Memory, at: int) -> None:
    """Meet every row from position ``at`` on; the state is what it was before the first of them."""
    rows, heard, mask = m.rows, m.heard, len(m.rows.valid) - 1
    if at == heard.span[1]:
        return
    last = rows.valid[(heard.span[1] - 1) & mask]
    for axis in range(len(heard.new)):
        lengthen(m, axis, last - m.commands.delay[axis])
    for position in range(at, heard.span[1]):
        here = position & mask
        keep(m.state, m.kept, here)
        arrange(m, here)
        if rows.end[here] > rows.first[here]:
            meet(m.axes, m.sensors, rows, m.state, m.met, m.log, here)
        for scalar in range(rows.first[here], rows.end[here]):
            heard.outcome[here, rows.axis[scalar]] = m.met.outcome[scalar]


@compiled
def arrange(m: Memory, here: int) -> None:
    """Line up the scalars of a row that the filter is to decide on."""
    rows, heard, axes = m.rows, m.heard, len(m.heard.new)
    scalar = here * axes
    rows.first[here] = scalar
    for axis in range(axes):
        heard.outcome[here, axis] = heard.known[here, axis]
        if heard.known[here, axis] != _FUSED:
            continue
        if m.commands.count[axis] == 0 or rows.valid[here] < heard.span[2]:
            heard.outcome[here, axis] = _BEFORE_START
            continue
        rows.axis[scalar], rows.value[scalar] = axis, heard.value[here, axis]
        rows.spread[scalar] = heard.spread[here, axis]
        scalar += 1
    rows.end[here] = scalar


@compiled
def retire(m: Memory, horizon: int) -> None:
    """Let go of rows that nothing can change any more."""
    mask = len(m.rows.valid) - 1
    while m.heard.span[0] < m.heard.span[1] and m.rows.valid[m.heard.span[0] & mask] < horizon:
        told(m, m.heard.span[0] & mask)
        m.heard.span[0] += 1


@compiled
def noted(tally: Tally, sensor: int, stamp: int, newest: int) -> None:
    """A row has come."""
    tally.rows[sensor] += 1
    if tally.last[sensor] == ALWAYS:
        tally.last[sensor] = stamp
    elif stamp > tally.last[sensor]:
        interval = (stamp - tally.last[sensor]) / 1e9
        tally.last[sensor] = stamp
        if tally.rows[sensor] > _FEW and interval > 3.0 * tally.usual[sensor]:
            tally.dropouts[sensor] += 1
        else:
            tally.usual[sensor] += (interval - tally.usual[sensor]) / min(tally.rows[sensor] - 1, _MANY)
    lateness = max(newest - stamp, 0) / 1e9
    slot = slot_of(tally, sensor, stamp)
    if slot >= 0:
        tally.minute[sensor, slot, ROWS] += 1.0
        tally.minute[sensor, slot, LATENESS] += lateness
        tally.minute[sensor, slot, LATEST] = max(tally.minute[sensor, slot, LATEST], lateness)


@compiled
def told(m: Memory, here: int) -> None:
    """Count what became of a row."""
    sensor = m.rows.sensor[here]
    for axis in range(len(m.heard.new)):
        if m.heard.outcome[here, axis] != ABSENT:
            m.tally.outcomes[sensor, m.heard.outcome[here, axis]] += 1
    slot = slot_of(m.tally, sensor, m.heard.stamp[here])
    for scalar in range(m.rows.first[here], m.rows.end[here]):
        fused = m.met.outcome[scalar] == _FUSED or m.met.outcome[scalar] == _REOPENED
        if fused and slot >= 0:
            m.tally.minute[sensor, slot, NIS] += (m.met.innovation[scalar] / m.met.innovation_sd[scalar]) ** 2
            m.tally.minute[sensor, slot, SCALARS] += 1.0


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


@compiled
def first_valid(m: Memory, since: int) -> int:
    """Position of the first row valid at ``since`` [ns] or later: commands come before readings of the same instant."""
    mask, at = len(m.rows.valid) - 1, m.heard.span[1]
    while at > m.heard.span[0] and m.rows.valid[(at - 1) & mask] >= since:
        at -= 1
    return at


@compiled
def any_value(m: Memory, given: int) -> bool:
    """Whether the new event gives any axis a value that can be."""
    for axis in range(len(m.heard.new)):
        if given >> axis & 1 and abs(m.heard.new[axis]) < _FARTHEST:
            return True
    return False


@compiled
def start_again(m: Memory, axis: int) -> None:
    """Put an axis to rest at its start level at the beginning of all that is still in the window."""
    mask = len(m.rows.valid) - 1
    start = mask + 2
    if m.heard.span[0] == m.heard.span[1]:
        copy_axis(m.kept, start, axis, m.state)
        return
    aside, first = mask + 1, m.heard.span[0] & mask
    keep(m.state, m.kept, aside)
    go_back(m.state, m.kept, first)
    copy_axis(m.kept, start, axis, m.state)
    keep(m.state, m.kept, first)
    go_back(m.state, m.kept, aside)


@compiled
def copy_axis(kept: State, place: int, axis: int, state: State) -> None:
    """Put back one axis as it was kept."""
    state.clock[axis], state.entry[axis], state.fused[axis] = (
        kept.clock[place, axis],
        kept.entry[place, axis],
        kept.fused[place, axis],
    )
    for i in range(state.x.shape[1]):
        state.x[axis, i] = kept.x[place, axis, i]
        for j in range(state.x.shape[1]):
            state.P[axis, i, j] = kept.P[place, axis, i, j]


@compiled
def place_of(commands: Commands, axis: int, stamp: int) -> int:
    """Where a row of this stamp goes: after those of the same one."""
    at = commands.count[axis]
    while at > 0 and commands.stamp[axis, at - 1] > stamp:
        at -= 1
    return at


@compiled
def group(commands: Commands, axis: int, at: int) -> int:
    """The first of the rows that share the stamp of row ``at``."""
    while at > 0 and commands.stamp[axis, at - 1] == commands.stamp[axis, at]:
        at -= 1
    return at


@compiled
def obey(m: Memory, axis: int, stamp: int, u: float) -> int:
    """Take in one axis's command; returns from which instant [ns] on its plant's input changes."""
    commands = m.commands
    if not abs(u) < _FARTHEST:
        m.heard.told[axis] = _INVALID
        return NEVER
    at = place_of(commands, axis, stamp)
    if at > 0 and commands.stamp[axis, at - 1] == stamp and commands.value[axis, at - 1] == u:
        m.heard.told[axis] = _DUPLICATE
        return NEVER
    for row in range(commands.count[axis], at, -1):
        commands.stamp[axis, row], commands.value[axis, row] = (
            commands.stamp[axis, row - 1],
            commands.value[axis, row - 1],
        )
    commands.stamp[axis, at], commands.value[axis, at] = stamp, u
    commands.count[axis] += 1
    first = group(commands, axis, at)
    if first == 0:
        settle(m, axis)
    drive(m, axis, first)
    m.heard.told[axis] = _FUSED if commands.given[axis, at] == stamp else _DUPLICATE
    return ALWAYS if first == 0 else stamp + commands.delay[axis]


@compiled
def settle(m: Memory, axis: int) -> None:
    """Let the axis start from its first command, where its start level is not known otherwise."""
    commands, last = m.commands, 0
    while last + 1 < commands.count[axis] and commands.stamp[axis, last + 1] == commands.stamp[axis, 0]:
        last += 1
    if not commands.fixed[axis] and commands.start[axis] != commands.value[axis, last]:
        commands.start[axis] = commands.value[axis, last]
        for sensor in range(len(m.sensors.scale)):
            m.sensors.level[sensor, axis] = m.sensors.scale[sensor] * commands.start[axis]
        start_again(m, axis)


@compiled
def drive(m: Memory, axis: int, first: int) -> None:
    """Make the entries of every command from row ``first`` on anew.

    Of rows with one stamp the last counts; the value of the row before, said again within half a period, is none.
    """
    commands = m.commands
    slope, intercept, recovery, period = (
        commands.gain[axis, 0],
        commands.gain[axis, 1],
        commands.gain[axis, 2],
        commands.gain[axis, 3],
    )
    cut(m.axes, commands, axis, commands.stamp[axis, first])
    for row in range(first, commands.count[axis]):
        stamp, u = commands.stamp[axis, row], commands.value[axis, row]
        superseded = row + 1 < commands.count[axis] and commands.stamp[axis, row + 1] == stamp
        before = group(commands, axis, row) - 1
        again = before >= 0 and u == commands.value[axis, before]
        again = again and stamp - commands.stamp[axis, before] < 0.5e9 * period
        if superseded or again:
            if row > 0:
                leave(commands, axis, row - 1, row)
            else:
                commands.given[axis, row] = ALWAYS
            continue
        if row > 0 and commands.given[axis, row - 1] > ALWAYS:
            lengthen(m, axis, stamp - 1)
            step, interval = u - commands.held[axis, row - 1], (stamp - commands.given[axis, row - 1]) / 1e9
            step_before, error = commands.step[axis, row - 1], commands.error[axis, row - 1]
        else:
            step, interval, step_before, error = u - commands.start[axis], 0.0, 0.0, 0.0
        error, maneuver, _ = answered(step, step_before, error, interval, slope, intercept, recovery, period)
        commands.given[axis, row], commands.held[axis, row], commands.step[axis, row] = stamp, u, step
        commands.error[axis, row], commands.maneuver[axis, row] = error, maneuver
        commands.latest[axis], commands.ticks[axis] = row, 0
        commands.worth[axis] = ticks_worth(error, recovery, period)
        enter(m.axes, commands, axis, stamp, (u - commands.start[axis]) + error, maneuver)


@compiled
def leave(commands: Commands, axis: int, here: int, there: int) -> None:
    """What is in force after one row is so after another."""
    commands.given[axis, there], commands.held[axis, there] = commands.given[axis, here], commands.held[axis, here]
    commands.step[axis, there], commands.error[axis, there] = commands.step[axis, here], commands.error[axis, here]
    commands.maneuver[axis, there] = commands.maneuver[axis, here]


@compiled
def cut(axes: Axes, commands: Commands, axis: int, since: int) -> None:
    """Take back the entries issued at ``since`` [ns] or later, and see how far the command before is carried on."""
    acting = since + commands.delay[axis]
    at = axes.first[axis] + commands.entries[axis] - 1
    while at >= axes.first[axis] and axes.acting[at] >= acting:
        axes.acting[at] = NEVER
        at -= 1
    commands.entries[axis] = at + 1 - axes.first[axis]
    row = place_of(commands, axis, since - 1) - 1
    commands.latest[axis], commands.ticks[axis], commands.worth[axis] = row, 0, 0
    if row >= 0 and commands.given[axis, row] > ALWAYS:
        recovery, period = commands.gain[axis, 2], commands.gain[axis, 3]
        commands.worth[axis] = ticks_worth(commands.error[axis, row], recovery, period)
        since_given = axes.acting[at] - commands.delay[axis] - commands.given[axis, row]
        commands.ticks[axis] = int(since_given / (period * 1e9) + 0.5)


@compiled
def lengthen(m: Memory, axis: int, until: int) -> None:
    """Carry the last entry's command on over the grid points of T up to ``until`` [ns], as far as its error lasts."""
    commands = m.commands
    if commands.ticks[axis] >= commands.worth[axis]:
        return
    row = commands.latest[axis]
    given, recovery, period = commands.given[axis, row], commands.gain[axis, 2], commands.gain[axis, 3]
    while commands.ticks[axis] < commands.worth[axis]:
        tick = commands.ticks[axis] + 1
        time = given + tick_time(tick, period)
        if time > until:
            return
        value = decayed(commands.error[axis, row], tick, recovery, period)
        value = (commands.held[axis, row] - commands.start[axis]) + value
        commands.ticks[axis] = tick
        enter(m.axes, commands, axis, time, value, commands.maneuver[axis, row])


@compiled
def enter(axes: Axes, commands: Commands, axis: int, issued: int, value: float, maneuver: float) -> None:
    """One more entry of the drive."""
    at = axes.first[axis] + commands.entries[axis]
    axes.acting[at], axes.value[at] = issued + commands.delay[axis], value
    more_noise, more_drift = commands.process[axis, 2] * maneuver, commands.process[axis, 3] * maneuver
    axes.noise[at] = commands.process[axis, 0] + more_noise * more_noise
    axes.drift[at] = commands.process[axis, 1] + more_drift * more_drift
    commands.entries[axis] += 1


@compiled
def crowded(m: Memory, axis: int, since: int, until: int) -> bool:
    """Whether the entries might not fit that commands from ``since`` [ns] on make, with grid points up to ``until``."""
    commands, recovery, period = m.commands, m.commands.gain[axis, 2], m.commands.gain[axis, 3]
    first, count = place_of(commands, axis, since), commands.count[axis]
    made = count - first + 2
    if recovery < math.inf and count > 0:
        begins = commands.stamp[axis, first - 1] if first > 0 else since
        ends = max(until, commands.stamp[axis, count - 1])
        most = (made + 1) * (_LONGEST_DECAY * recovery / period + 1.0)
        made += int(min((ends - begins) / (period * 1e9) + 1.0, most))
    return commands.entries[axis] + made > m.axes.first[axis + 1] - m.axes.first[axis]
