"""The last seconds of a stream: the same table of events, with a checkpoint before each of them.

A new event is put where its time says; the filter goes back to the checkpoint there and runs on, by the forward pass
that fuses a recorded run. Commands that act later than the newest measurement wait until one comes after them.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false
# pyright: reportCallIssue=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..arrays import ALWAYS, NEVER, CodeArray, FloatArray, IntArray, TimeArray
from ..compiled import compiled, compiled_apart
from .axis import PERIOD, START, STEP, Model, Sensors, State, U
from .counters import NIS, SCALARS, Counters, count_interval, count_row, forget_after, slot_of
from .events import COMMAND, DUPLICATE, FUSED, INVALID, Events, Results, classify, said_before
from .forward import REACQUIRED, History, Kept, Outputs, checkpoint, estimate, restore, run_events
from .gate import FUSED_AT, NOBODY
from .outcome import ABSENT

MOST_ROWS = 65_536  # events; what is more shortens the window
FIRST_ROWS = 4096  # at first
BEGIN, END, DONE, RUN, ORIGIN = range(5)  # of a window's span
ACCEPTED, NO_ROOM = range(2)


class Incoming(NamedTuple):
    """What goes in and comes out of a window, and where it stands.

    Attributes:
        span: The first row (``BEGIN``), after the last one (``END``), after the last one in the state (``DONE``), after
            the last one that is to be in it (``RUN``), the first command's stamp [ns] (``ORIGIN``), (5,).
        first: The stamp of each axis's first command [ns] (``NEVER`` without one), (A,).
        start: The level u₀ [m] of each axis at rest where it is known beforehand, else NaN, (A,).
        delay: Td of each axis, int64 ns, (A,).
        latency: Of each sensor, int64 ns, (S,).
        value: Of the event that comes in [m], (A,).
        spread: By what the noise of each of its values is scaled, (A,).
        outcome: What became of them, ``ABSENT`` for an axis that it does not give, (A,).
        innovation: ν of each value [m], (A,).
        contradicts: The sensor that a rejected measurement contradicts, ``NOBODY`` for none, (1,).
        fused: When the last measurement was valid that an estimate knows of, int64 ns, (A,).
        rest_covariance: P of the state at rest, (A, s, s).
        rest_drive: Its drive, (A, 6).
    """

    span: IntArray
    first: TimeArray
    start: FloatArray
    delay: TimeArray
    latency: TimeArray
    value: FloatArray
    spread: FloatArray
    outcome: CodeArray
    innovation: FloatArray
    contradicts: IntArray
    fused: TimeArray
    rest_covariance: FloatArray
    rest_drive: FloatArray


class Memory(NamedTuple):
    """All arrays of a window; ``kept`` has one place more than there are rows, to put the state aside."""

    model: Model
    sensors: Sensors
    events: Events
    state: State
    results: Results
    history: History
    kept: Kept
    counters: Counters
    incoming: Incoming

    def flat(self) -> Flat:
        """As plain tuples, which a kernel takes a hundred times faster from Python."""
        return tuple(tuple(part) for part in self)


Flat: TypeAlias = tuple[tuple[Any, ...], ...]


@compiled
def opened(flat: Flat) -> Memory:
    """The names again."""
    return Memory(
        Model(*flat[0]),
        Sensors(*flat[1]),
        Events(*flat[2]),
        State(*flat[3]),
        Results(*flat[4]),
        History(*flat[5]),
        Kept(*flat[6]),
        Counters(*flat[7]),
        Incoming(*flat[8]),
    )


@compiled_apart
def add_measurement(flat: Flat, stamp: int, sensor: int, given: int, newest: int, horizon: int) -> int:
    """Take in the measurement in ``incoming.value``, of the axes that are bits of ``given``.

    Events before ``horizon`` [ns] leave the window; ``newest`` [ns] is the latest stamp of all.
    """
    m = opened(flat)
    span, incoming, events = m.incoming.span, m.incoming, m.events
    retire(m, horizon)
    if span[END] == len(events.time):
        return NO_ROOM
    at = insert(m, stamp - incoming.latency[sensor], sensor, stamp, given)
    count_row(m.counters, sensor, stamp, newest)
    duplicate = said_before(events, at, span[BEGIN])
    for axis in range(len(incoming.value)):
        whole = DUPLICATE if duplicate else FUSED
        incoming.outcome[axis] = events.known[at, axis] = classified(m, at, axis, whole)
    incoming.contradicts[0] = NOBODY
    if duplicate:
        remove(m, at)
        catch_up(m)
        for axis in range(len(incoming.value)):
            if incoming.outcome[axis] != ABSENT:
                m.counters.number[sensor, incoming.outcome[axis]] += 1
        return ACCEPTED
    span[RUN] = max(span[RUN], at + 1)
    catch_up(m)
    incoming.contradicts[0] = m.results.contradicts[at]
    for axis in range(len(incoming.value)):
        incoming.outcome[axis], incoming.innovation[axis] = m.results.outcome[at, axis], m.results.innovation[at, axis]
    return ACCEPTED


@compiled_apart
def add_command(flat: Flat, stamp: int, given: int, horizon: int) -> int:
    """Take in the command in ``incoming.value``, of the axes that are bits of ``given``: an event for each delay."""
    m = opened(flat)
    span, incoming, events, axes = m.incoming.span, m.incoming, m.events, len(m.incoming.value)
    retire(m, horizon)
    if span[END] + axes > len(events.time):
        return NO_ROOM
    left = given
    for axis in range(axes):
        incoming.outcome[axis] = ABSENT
    for axis in range(axes):
        together = 0  # the axes of this delay
        for other in range(axis, axes):
            if left >> other & 1 and incoming.delay[other] == incoming.delay[axis]:
                together |= 1 << other
        if not left >> axis & 1:
            continue
        left &= ~together
        time = stamp + incoming.delay[axis]
        at = insert(m, time, COMMAND, stamp, together)
        if said_before(events, at, span[BEGIN]):
            for other in range(axis, axes):
                if together >> other & 1:
                    incoming.outcome[other] = DUPLICATE
            remove(m, at)
            continue
        for other in range(axis, axes):
            if together >> other & 1:
                reclassify(m, other, first_at(m, time), time + int(m.model.gain[other, PERIOD] * 0.5e9))
                incoming.outcome[other] = events.known[at, other]
    for axis in range(axes):
        if incoming.outcome[axis] == FUSED and stamp <= incoming.first[axis]:
            begin(m, axis, stamp)
    catch_up(m)
    return ACCEPTED


@compiled_apart
def estimate_at(flat: Flat, outputs: tuple[FloatArray, ...], time: int) -> None:
    """Every axis at ``time`` [ns] by all measurements valid until then, into ``outputs``; nothing changes."""
    m = opened(flat)
    span, incoming, aside = m.incoming.span, m.incoming, len(m.kept.clock) - 1
    pending = span[DONE]
    while pending > span[BEGIN] and m.events.time[pending - 1] > time:
        pending -= 1
    checkpoint(m.state, m.kept, aside)
    if pending < span[DONE]:
        restore(m.state, m.kept, pending)
    estimate(m.model, m.events, m.state, pending, span[END], time, m.history, Outputs(*outputs), 0)
    for axis in range(len(incoming.value)):
        incoming.fused[axis] = span[ORIGIN]
        for sensor in range(len(incoming.latency)):
            incoming.fused[axis] = max(incoming.fused[axis], m.state.gate_time[sensor, axis, FUSED_AT])
    restore(m.state, m.kept, aside)


@compiled_apart
def forget(flat: Flat, after: int) -> None:
    """Take back every event stamped after ``after`` [ns]: it was of another clock."""
    m = opened(flat)
    span, incoming, events = m.incoming.span, m.incoming, m.events
    for sensor in range(len(incoming.latency)):
        forget_after(m.counters, sensor, after)
    first = span[BEGIN]
    while first < span[END] and events.stamp[first] <= after:
        first += 1
    go_back(m, first)
    kept_rows, run = first, span[RUN]
    for row in range(first, span[END]):
        if events.stamp[row] <= after:
            move(events, row, kept_rows)
            kept_rows += 1
            continue
        span[RUN] -= row < run
        for axis in range(len(incoming.value)):
            if events.source[row] != COMMAND and events.known[row, axis] != ABSENT:
                m.counters.number[events.source[row], INVALID] += 1
    span[END] = kept_rows
    for row in range(span[BEGIN], span[END]):
        if events.source[row] != COMMAND:
            sensor = events.source[row]
            m.counters.last[sensor] = max(m.counters.last[sensor], events.stamp[row])
    if span[ORIGIN] > after:
        span[ORIGIN] = NEVER
    for axis in range(len(incoming.value)):
        if NEVER > incoming.first[axis] > after:  # it had only just begun
            begin(m, axis, NEVER)
        reclassify(m, axis, span[BEGIN], NEVER)
    catch_up(m)


@compiled_apart
def count_window(flat: Flat) -> None:
    """Count the measurements that are still in the window."""
    m = opened(flat)
    for row in range(m.incoming.span[BEGIN], m.incoming.span[END]):
        count_outcome(m, row)


@compiled_apart
def let_go(flat: Flat, horizon: int) -> None:
    """Let go of the events before ``horizon`` [ns]."""
    retire(opened(flat), horizon)


@compiled_apart
def command_at(flat: Flat, axis: int, stamp: int) -> tuple[int, float, float]:
    """Stamp [ns] (``ALWAYS`` for none), value and step [m] of the last command of an axis stamped by ``stamp`` [ns]."""
    m = opened(flat)
    span, drive, last = m.incoming.span, m.state.drive, -1
    for row in range(span[END] - 1, span[BEGIN] - 1, -1):
        if m.events.source[row] == COMMAND and m.events.known[row, axis] == FUSED and m.events.stamp[row] <= stamp:
            value = m.events.value[row, axis]
            if last >= 0:
                return m.events.stamp[last], m.events.value[last, axis], m.events.value[last, axis] - value
            last = row
    commanded = drive[axis, START] + drive[axis, U]  # those before have left the window
    if last < 0:
        return ALWAYS, commanded, drive[axis, STEP]
    value = m.events.value[last, axis]
    return m.events.stamp[last], value, drive[axis, STEP] if last < span[DONE] else value - commanded


@compiled
def retire(m: Memory, horizon: int) -> None:
    """Let go of events that nothing can change any more."""
    span = m.incoming.span
    while span[RUN] < span[END] and m.events.time[span[RUN]] < horizon:
        span[RUN] += 1
    catch_up(m)
    while span[BEGIN] < span[DONE] and m.events.time[span[BEGIN]] < horizon:
        count_outcome(m, span[BEGIN])
        span[BEGIN] += 1


@compiled_apart
def go_back(m: Memory, row: int) -> None:
    """Bring the state to before a row, if it is past it."""
    if row < m.incoming.span[DONE]:
        restore(m.state, m.kept, row)
        m.incoming.span[DONE] = row


@compiled_apart
def catch_up(m: Memory) -> None:
    """Bring the state to where it is to be."""
    span = m.incoming.span
    if span[DONE] < span[RUN]:
        run_events(m.model, m.sensors, m.events, m.state, span[DONE], span[RUN], False, m.results, m.history, m.kept)
        span[DONE] = span[RUN]


@compiled_apart
def insert(m: Memory, time: int, source: int, stamp: int, given: int) -> int:
    """Put the axes of ``incoming`` that are bits of ``given`` in their place; returns the row."""
    span, incoming, events = m.incoming.span, m.incoming, m.events
    at = span[END]
    while at > span[BEGIN] and comes_after(events, at - 1, time, source, stamp):
        at -= 1
    go_back(m, at)
    for row in range(span[END], at, -1):
        move(events, row - 1, row)
    span[END] += 1
    span[RUN] += at < span[RUN]
    events.time[at], events.source[at], events.stamp[at] = time, source, stamp
    for axis in range(len(incoming.value)):
        events.known[at, axis] = FUSED if given >> axis & 1 else ABSENT
        events.value[at, axis], events.spread[at, axis] = incoming.value[axis], incoming.spread[axis]
    return at


@compiled
def remove(m: Memory, at: int) -> None:
    """Take out a row that was just put in."""
    span = m.incoming.span
    span[END] -= 1
    span[RUN] -= at < span[RUN]
    for row in range(at, span[END]):
        move(m.events, row + 1, row)


@compiled
def comes_after(events: Events, row: int, time: int, source: int, stamp: int) -> bool:
    """Whether a row comes after a new one: by time, then source, then stamp; of those alike the new one is the last."""
    if events.time[row] != time:
        return events.time[row] > time
    if events.source[row] != source:
        return events.source[row] > source
    return events.stamp[row] > stamp


@compiled
def move(events: Events, here: int, there: int) -> None:
    """Copy a row of the table to another place."""
    events.time[there], events.source[there], events.stamp[there] = (
        events.time[here],
        events.source[here],
        events.stamp[here],
    )
    for axis in range(events.value.shape[1]):
        events.known[there, axis] = events.known[here, axis]
        events.value[there, axis], events.spread[there, axis] = events.value[here, axis], events.spread[here, axis]


@compiled
def classified(m: Memory, row: int, axis: int, whole: int) -> int:
    """What a value of the window is before the filter sees it."""
    span = m.incoming.span
    return classify(m.model, m.sensors, m.events, m.state, span[ORIGIN], row, axis, span[BEGIN], span[END], whole)


@compiled_apart
def reclassify(m: Memory, axis: int, first: int, until: int) -> None:
    """Look again at the values of an axis from row ``first`` on that are not after ``until`` [ns]."""
    span, events = m.incoming.span, m.events
    for row in range(first, span[END]):
        if events.time[row] > until:
            return
        if events.known[row, axis] != ABSENT:
            known = classified(m, row, axis, FUSED)
            if known != events.known[row, axis]:
                go_back(m, row)
                events.known[row, axis] = known


@compiled
def first_at(m: Memory, time: int) -> int:
    """The first row at ``time`` [ns] or later."""
    at = m.incoming.span[END]
    while at > m.incoming.span[BEGIN] and m.events.time[at - 1] >= time:
        at -= 1
    return at


@compiled_apart
def begin(m: Memory, axis: int, stamp: int) -> None:
    """Let an axis rest until its first command, which is that of ``stamp`` [ns] (``NEVER``: it has none)."""
    span, incoming, state, events = m.incoming.span, m.incoming, m.state, m.events
    incoming.first[axis] = stamp
    earlier = stamp < span[ORIGIN]
    if earlier:
        span[ORIGIN] = stamp
    go_back(m, span[BEGIN])
    for other in range(len(incoming.value)):
        level = incoming.start[other]
        if not earlier and (other != axis or not math.isnan(level)):  # where it rested was known before
            continue
        if math.isnan(level):
            for row in range(span[BEGIN], span[END]):
                commands = events.source[row] == COMMAND and events.known[row, other] == FUSED
                if commands and events.stamp[row] == incoming.first[other]:
                    level = events.value[row, other]
            if math.isnan(level) and other != axis:
                level = state.drive[other, START]
        rest(state, incoming, other, level, span[ORIGIN])
        reclassify(m, other, span[BEGIN], NEVER)


@compiled
def rest(state: State, incoming: Incoming, axis: int, level: float, origin: int) -> None:
    """Put an axis in equilibrium at its start level."""
    for i in range(state.x.shape[1]):
        state.x[axis, i] = 0.0
        for j in range(state.x.shape[1]):
            state.P[axis, i, j] = incoming.rest_covariance[axis, i, j]
    for k in range(state.drive.shape[1]):
        state.drive[axis, k] = incoming.rest_drive[axis, k]
    state.drive[axis, START], state.clock[axis], state.unsettled[axis] = level, origin, ALWAYS
    for sensor in range(len(state.rejected)):
        for k in range(2):
            state.gate_time[sensor, axis, k], state.gate_count[sensor, axis, k] = ALWAYS, 0


@compiled
def count_outcome(m: Memory, row: int) -> None:
    """Count what became of a measurement."""
    sensor, results, counters = m.events.source[row], m.results, m.counters
    if sensor == COMMAND:
        return
    count_interval(counters, sensor, m.events.stamp[row])
    slot = slot_of(counters, sensor, m.events.stamp[row])
    for axis in range(len(m.incoming.value)):
        outcome = results.outcome[row, axis]
        if outcome == ABSENT:
            continue
        counters.number[sensor, outcome] += 1
        if outcome in (FUSED, REACQUIRED) and slot >= 0:
            counters.minute[sensor, slot, NIS] += (
                results.innovation[row, axis] / results.innovation_sd[row, axis]
            ) ** 2
            counters.minute[sensor, slot, SCALARS] += 1.0


class Window:
    """The last seconds of a stream, and the filter at every one of their events.

    An event comes in through ``value`` and ``spread``, then :meth:`add_measurement` or :meth:`add_command`, which say
    which of their axes it gives; what became of these is in ``outcome`` then.

    Attributes:
        memory: All arrays.
        value: Of the event that comes in [m], (A,).
        spread: By what the noise of each of its values is scaled, 1 if nobody says otherwise, (A,).
        outcome: What became of its axes: codes of Outcome, or ``ABSENT`` for an axis that it does not give, (A,).
        innovation: ν of each value of a measurement [m], (A,).
        contradicts: The sensor that it contradicts where it is rejected time after time, ``NOBODY`` for none, (1,).
        floor: What is stamped before it [ns] can no longer be taken, because the stream was too dense for the window.
    """

    def __init__(self, memory: Memory) -> None:
        """Empty; ``memory`` has room for ``FIRST_ROWS`` events."""
        self.floor = ALWAYS
        self._latency = int(memory.incoming.latency.max(initial=0))
        self._behind = self._latency + int(memory.model.gain[:, PERIOD].max() * 1e9)
        self._outputs = np.zeros((len(Outputs._fields), len(memory.incoming.value), 1))
        self._places = tuple(self._outputs)
        self._set(memory)

    @property
    def origin(self) -> int | None:
        """The first command's stamp, int ns; None before it."""
        origin = int(self.memory.incoming.span[ORIGIN])
        return None if origin == NEVER else origin

    def add_measurement(self, stamp: int, sensor: int, given: int, newest: int, oldest: int) -> bool:
        """Take in a measurement; see :meth:`add_command`."""
        while add_measurement(self._flat, stamp, sensor, given, newest, oldest - self._behind) == NO_ROOM:
            self._make_room()
            if stamp < self.floor:
                return False
        return True

    def add_command(self, stamp: int, given: int, oldest: int) -> bool:
        """Take in a command.

        Args:
            stamp: Int ns.
            given: The axes that it gives, as bits.
            oldest: No event stamped before will ever come [ns].

        Returns:
            False if to make room the window had to let go of its time.
        """
        while add_command(self._flat, stamp, given, oldest - self._behind) == NO_ROOM:
            self._make_room()
            if stamp < self.floor:
                return False
        return True

    def estimate(self, time: int) -> list[tuple[list[float], int] | None]:
        """Every axis at an instant [ns].

        Returns:
            For each axis what :class:`Outputs` has, in the stream's own coordinates and SI, and when the last
            measurement was valid that it knows of [ns]; None as long as the axis has no start level.
        """
        estimate_at(self._flat, self._places, time)
        found: list[tuple[list[float], int] | None] = []
        levels, fused = self.memory.state.drive[:, START].tolist(), self.memory.incoming.fused.tolist()
        for number, outputs in enumerate(self._outputs[:, :, 0].T.tolist()):
            outputs[0] += levels[number]
            found.append(None if math.isnan(levels[number]) else (outputs, fused[number]))
        return found

    def command_at(self, axis: int, stamp: int = NEVER) -> tuple[int, float, float] | None:
        """Stamp [ns], value and step [m] of an axis's last command stamped by ``stamp`` [ns]; None for none."""
        if self.memory.incoming.first[axis] == NEVER:
            return None
        return command_at(self._flat, axis, stamp)

    def forget(self, after: int) -> None:
        """Take back all that is stamped after ``after`` [ns]."""
        forget(self._flat, after)

    def warm_up(self) -> None:
        """Have every kernel compiled and in memory; on a window that nobody needs."""
        self.estimate(0)
        self.command_at(0)
        self.forget(0)
        self.counters()
        let_go(self._flat, 0)

    def counters(self) -> Counters:
        """What there was of each sensor until now, with what is still in the window."""
        now = Counters(*(part.copy() for part in self.memory.counters))
        count_window(self.memory._replace(counters=now).flat())
        return now

    def _make_room(self) -> None:
        """Move what is in the window to the front, into more memory if it needs it; at the limit give up its oldest."""
        span, rows = self.memory.incoming.span, len(self.memory.events.time)
        used = int(span[END] - span[BEGIN])
        crowded = used > rows // 2
        if rows == MOST_ROWS and used > rows - rows // 8:
            self.floor = int(self.memory.events.time[span[BEGIN] + rows // 8]) + 1 + self._behind
            let_go(self._flat, self.floor - self._behind)
        self._set(with_rows(self.memory, 2 * rows if crowded and rows < MOST_ROWS else rows))

    def _set(self, memory: Memory) -> None:
        self.memory, self._flat = memory, memory.flat()
        incoming = memory.incoming
        self.value, self.spread, self.outcome = incoming.value, incoming.spread, incoming.outcome
        self.innovation, self.contradicts = incoming.innovation, incoming.contradicts


def with_rows(memory: Memory, rows: int) -> Memory:
    """The same window at the front of room for ``rows`` events."""
    begin_row, end_row = int(memory.incoming.span[BEGIN]), int(memory.incoming.span[END])

    def moved(part: np.ndarray, extra: int = 0) -> np.ndarray:
        found = np.zeros((rows + extra, *part.shape[1:]), dtype=part.dtype)
        found[: end_row - begin_row] = part[begin_row:end_row]
        return found

    span = memory.incoming.span.copy()
    span[[BEGIN, END, DONE, RUN]] -= begin_row
    kept = Kept(np.ones(rows + 1, dtype=np.bool_), *(moved(part, 1) for part in memory.kept[1:]))
    return memory._replace(
        events=Events(*(moved(part) for part in memory.events)),
        results=Results(*(moved(part) for part in memory.results)),
        kept=kept,
        incoming=memory.incoming._replace(span=span),
    )
