"""The last seconds of a stream: the same table of events, with a checkpoint before each of them.

A new event is put where its time says; the filter goes back to the checkpoint there and runs on, by the forward pass
that fuses a recorded run. Commands that act later than the newest measurement wait until one comes after them.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false
# pyright: reportCallIssue=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import math
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from ..arrays import ALWAYS, NEVER, CodeArray, FloatArray, IndexArray, IntArray, TimeArray
from ..compiled import compiled, compiled_apart, kernel
from .axis import PERIOD, START, STEP, Model, Sensors, State, U, copy_rows
from .counters import CAME, Counters, count_duplicate, count_rows, forget_after
from .events import COMMAND, DUPLICATE, FUSED, Events, Results, classify, repeats_earlier
from .forward import ALL_THERE, NO_TIMES, ONE, ZERO, Filter, Flat, Output, checkpoint_of, filter_events
from .gate import FUSED_AT, NOBODY
from .outcome import ABSENT, Outcome

MOST_ROWS = 65_536  # events; what is more shortens the window
FIRST_ROWS = 4096  # at first
BEGIN, END, DONE, RUN, ORIGIN = range(5)  # of a window's span
FIRST, DELAY = range(2)  # of the times of an axis
VALUE, SPREAD, KNOWN_START = range(3)  # of the values of an axis
NO_ROOM, REPEATED = -1, -2  # in place of a row


class Incoming(NamedTuple):
    """What goes in and comes out of a window, and where it stands.

    Attributes:
        span: The first row (``BEGIN``), after the last one (``END``), after the last one in the state (``DONE``), after
            the last one that is to be in it (``RUN``), and the first command's stamp [ns] (``ORIGIN``, or ``NEVER``),
            (5,).
        times: For each axis the stamp of its ``FIRST`` command (``NEVER`` without one) and its ``DELAY`` Td, int64 ns,
            (A, 2).
        values: For each axis the ``VALUE`` [m] of the event that comes in, the ``SPREAD`` that scales its noise, and
            the level u₀ [m] at rest where it is known beforehand (``KNOWN_START``), (A, 3).
        outcome: What became of the values, ``ABSENT`` for an axis that the event does not give, (A,).
        latency: Of each sensor, int64 ns, (S,).
    """

    span: IntArray
    times: TimeArray
    values: FloatArray
    outcome: CodeArray
    latency: TimeArray


class Memory(NamedTuple):
    """All arrays of a window. Of the places for checkpoints the last one is for the state at rest."""

    filter: Filter
    incoming: Incoming


class Tables(NamedTuple):
    """A :class:`Memory` within a kernel."""

    model: Model
    sensors: Sensors
    events: Events
    state: State
    incoming: Incoming


@compiled
def opened(flat: Flat, incoming: Flat) -> Tables:
    """The names again."""
    return Tables(Model(*flat[0]), Sensors(*flat[1]), Events(*flat[2]), State(*flat[3]), Incoming(*incoming))


@kernel
def put_measurement(flat: Flat, incoming: Flat, stamp: int, sensor: int, given: int, horizon: int) -> int:
    """Put the measurement in ``incoming.values``, of the axes that are bits of ``given``, in its place.

    Events before ``horizon`` [ns] leave the window once they are in the state.

    Returns:
        Its row, which is then to be run; ``NO_ROOM``; or ``REPEATED``: its stamp and values are those of one before.
    """
    m = opened(flat, incoming)
    span, events, outcome = m.incoming.span, m.events, m.incoming.outcome
    retire(m, horizon)
    if span[END] == len(events.time):
        return NO_ROOM
    at = insert(m, stamp - m.incoming.latency[sensor], sensor, stamp, given)
    duplicate = repeats_earlier(events, at, span[BEGIN])
    whole = DUPLICATE if duplicate else FUSED
    for axis in range(len(outcome)):
        outcome[axis] = events.known[at, axis] = classified(m, at, axis, whole)
    if duplicate:
        remove(events, span, at)
        return REPEATED
    span[RUN] = max(span[RUN], at + 1)
    return at


@kernel
def put_command(flat: Flat, incoming: Flat, stamp: int, given: int, horizon: int) -> int:
    """Put the command in ``incoming.values``, of the axes that are bits of ``given``, in its places: for each delay.

    Events before ``horizon`` [ns] leave the window once they are in the state. ``NO_ROOM``: it was not put anywhere.
    """
    m = opened(flat, incoming)
    span, events, times, outcome = m.incoming.span, m.events, m.incoming.times, m.incoming.outcome
    axes, left = len(outcome), given
    retire(m, horizon)
    if span[END] + axes > len(events.time):
        return NO_ROOM
    for axis in range(axes):
        outcome[axis] = ABSENT
    for axis in range(axes):
        together = ZERO  # the axes of this delay
        for other in range(axis, axes):
            if left >> other & 1 and times[other, DELAY] == times[axis, DELAY]:
                together |= 1 << other
        if not left >> axis & 1:
            continue
        left &= ~together
        time = stamp + times[axis, DELAY]
        at = insert(m, time, COMMAND, stamp, together)
        duplicate = repeats_earlier(events, at, span[BEGIN])
        if duplicate:
            remove(events, span, at)
        for other in range(axis, axes):
            if together >> other & 1 and duplicate:
                outcome[other] = DUPLICATE
            elif together >> other & 1:
                first = first_at(events, span, time)
                reclassify(m, other, first, time + int(m.model.gain[other, PERIOD] * 0.5e9))
                outcome[other] = events.known[at, other]
    for axis in range(axes):
        if outcome[axis] == FUSED and stamp <= times[axis, FIRST]:
            begin(m, axis, stamp)
    return ZERO


@compiled
def retire(m: Tables, horizon: int) -> None:
    """Let go of events that nothing can change any more; those that are not in the state yet are to be run first."""
    span, time = m.incoming.span, m.events.time
    while span[BEGIN] < span[DONE] and time[span[BEGIN]] < horizon:
        span[BEGIN] += 1
    while span[RUN] < span[END] and time[span[RUN]] < horizon:
        span[RUN] += 1


@compiled
def restore(m: Tables, row: int) -> None:
    """Bring the state to before a row, if it is past it."""
    if row < m.incoming.span[DONE]:
        copy_rows(m.state, checkpoint_of(m.model, row, len(m.events.time)), ZERO, len(m.incoming.outcome))
        m.incoming.span[DONE] = row


@compiled_apart
def insert(m: Tables, time: int, source: int, stamp: int, given: int) -> int:
    """Put the axes of ``incoming`` that are bits of ``given`` in their place; returns the row."""
    span, values, events = m.incoming.span, m.incoming.values, m.events
    at = span[END]
    while at > span[BEGIN] and comes_after(events, at - 1, time, source, stamp):
        at -= 1
    restore(m, at)
    for row in range(span[END], at, -1):
        move(events, row - 1, row)
    span[END] += 1
    span[RUN] += at < span[RUN]
    events.time[at], events.source[at], events.stamp[at] = time, source, stamp
    for axis in range(len(values)):
        events.known[at, axis] = FUSED if given >> axis & 1 else ABSENT
        events.value[at, axis], events.spread[at, axis] = values[axis, VALUE], values[axis, SPREAD]
    return at


@compiled
def remove(events: Events, span: IntArray, at: int) -> None:
    """Take out a row that was just put in."""
    span[END] -= 1
    span[RUN] -= at < span[RUN]
    for row in range(at, span[END]):
        move(events, row + 1, row)


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
def classified(m: Tables, row: int, axis: int, whole: int) -> int:
    """What a value of the window is before the filter sees it."""
    span = m.incoming.span
    return classify(m.model, m.sensors, m.events, m.state, span[ORIGIN], row, axis, span[BEGIN], span[END], whole)


@compiled_apart
def reclassify(m: Tables, axis: int, first: int, until: int) -> None:
    """Look again at the values of an axis from row ``first`` on that are not after ``until`` [ns]."""
    span, events = m.incoming.span, m.events
    for row in range(first, span[END]):
        if events.time[row] > until:
            return
        if events.known[row, axis] != ABSENT:
            known = classified(m, row, axis, FUSED)
            if known != events.known[row, axis]:
                restore(m, row)
                events.known[row, axis] = known


@compiled
def first_at(events: Events, span: IntArray, time: int) -> int:
    """The first row at ``time`` [ns] or later."""
    at = span[END]
    while at > span[BEGIN] and events.time[at - 1] >= time:
        at -= 1
    return at


@compiled_apart
def begin(m: Tables, axis: int, stamp: int) -> None:
    """Let an axis rest until its first command, which is that of ``stamp`` [ns]; all of them if none was before it."""
    span, incoming, state, events = m.incoming.span, m.incoming, m.state, m.events
    incoming.times[axis, FIRST] = stamp
    earlier = stamp < span[ORIGIN]
    span[ORIGIN] = min(stamp, span[ORIGIN])
    restore(m, span[BEGIN])
    for other in range(len(incoming.outcome)):
        level = incoming.values[other, KNOWN_START]
        if not earlier and (other != axis or not math.isnan(level)):  # where it rested was known before
            continue
        if math.isnan(level):
            level = state.drive[other, START] if other != axis else level
            for row in range(span[BEGIN], span[END]):
                commands = events.source[row] == COMMAND and events.known[row, other] == FUSED
                if commands and events.stamp[row] == incoming.times[other, FIRST]:
                    level = events.value[row, other]
        places = len(events.time) + 1
        copy_rows(state, checkpoint_of(m.model, places - 1, places) + other, np.int64(other), ONE)
        state.drive[other, START] = level
        state.clock[other] = state.settled[other] = span[ORIGIN]
        reclassify(m, other, span[BEGIN], np.int64(NEVER))


@kernel
def last_commands(
    source: IndexArray, stamps: TimeArray, known: CodeArray, first: int, end: int, axis: int, stamp: int
) -> tuple[int, int]:
    """The rows of the last two commands of an axis that are stamped by ``stamp`` [ns], −1 for none."""
    last = -1
    for row in range(end - 1, first - 1, -1):
        if source[row] == COMMAND and known[row, axis] == FUSED and stamps[row] <= stamp:
            if last >= 0:
                return last, row
            last = row
    return last, -1


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
        contradicts: The sensor that the measurement just added contradicts, where it is rejected time after time; −1
            for none.
        floor: What is stamped before it [ns] can no longer be taken, because the stream was too dense for the window.
    """

    def __init__(self, memory: Memory, counters: Counters) -> None:
        """Empty; ``memory`` has room for ``FIRST_ROWS`` events, ``counters`` what was counted before."""
        self.floor, self.contradicts = ALWAYS, NOBODY
        self._counters, self._counted = counters, 0
        model, axes = memory.filter.model, len(memory.incoming.outcome)
        self._behind = int(memory.incoming.latency.max(initial=0)) + int(model.gain[:, PERIOD].max() * 1e9)
        self.innovation = np.zeros(axes)
        self._time, self._outputs = np.zeros(1, dtype=np.int64), np.zeros((len(Output), axes, 1))
        self._set(memory)

    @property
    def origin(self) -> int | None:
        """The first command's stamp, int ns; None before it."""
        origin = self._span.item(ORIGIN)
        return None if origin == NEVER else origin

    def add_measurement(self, stamp: int, sensor: int, given: int, newest: int, oldest: int) -> bool:
        """Take in a measurement; ``newest`` [ns] is the newest stamp of all. See :meth:`add_command`."""
        while (row := put_measurement(*self._flat, stamp, sensor, given, oldest - self._behind)) == NO_ROOM:
            self._make_room()
            if stamp < self.floor:
                return False
        self._run(row)
        self._count(sensor, stamp, newest)
        if row == REPEATED:
            count_duplicate(self._counters, sensor, self.outcome)
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
        while put_command(*self._flat, stamp, given, oldest - self._behind) == NO_ROOM:
            self._make_room()
            if stamp < self.floor:
                return False
        self._run()
        if self._span.item(BEGIN) > self._counted:
            self._count(-1, 0, 0)
        return True

    def estimate(self, time: int) -> list[tuple[list[float], int] | None]:
        """Every axis at an instant [ns] by all measurements valid until then; nothing changes.

        Returns:
            For each axis what :class:`.forward.Output` has, in the stream's own coordinates and SI, and when the last
            measurement was valid that it knows of [ns]; None as long as the axis has no start level.
        """
        (begin, end, row, _, origin), known, axes = self._span.tolist(), self.memory.filter, len(self.outcome)
        events, aside = known.events, list[np.ndarray]()
        if row > begin and events.time.item(row - 1) > time:  # earlier than the state is
            aside = [part[:axes].copy() for part in known.state.by_row]
            row = begin + int(np.searchsorted(events.time[begin:row], time, side="right"))
            self._restore(row)
        self._time[0] = time
        filter_events(self._flat[0], False, row, row, end, *ALL_THERE, len(events.time), self._time, self._outputs)
        fused = np.maximum(known.state.gate_time[:axes, :, FUSED_AT].max(axis=1, initial=ALWAYS), origin).tolist()
        for part, before in zip(known.state.by_row, aside, strict=False):
            part[:axes] = before
        found: list[tuple[list[float], int] | None] = []
        levels = known.state.drive[:axes, START].tolist()  # the rows behind are checkpoints
        for number, outputs in enumerate(self._outputs[:, :, 0].T.tolist()):
            outputs[0] += levels[number]
            found.append(None if math.isnan(levels[number]) else (outputs, fused[number]))
        return found

    @contextmanager
    def hidden(self, after: int) -> Generator[None]:
        """As if nothing that is stamped after ``after`` [ns] had come yet."""
        span, events, axes = self._span, self.memory.filter.events, len(self.outcome)
        begin, end = span.item(BEGIN), span.item(END)
        later = begin + np.flatnonzero(events.stamp[begin:end] > after)
        if not len(later):
            yield
            return
        known, first, before = events.known[later], int(later[0]), span.copy()
        aside = [part[:axes].copy() for part in self.memory.filter.state.by_row]
        events.known[later] = ABSENT
        if first < span[DONE]:
            self._restore(first)
            span[DONE] = first
        span[RUN] = max(first, begin + int(np.searchsorted(events.time[begin:end], after, side="right")))
        ran = span[RUN] > span[DONE]
        self._run()
        try:
            yield
        finally:
            events.known[later], span[:] = known, before
            for part, one in zip(self.memory.filter.state.by_row, aside, strict=False):
                part[:axes] = one
            if ran and first < before[DONE]:  # the checkpoints behind are of what was not hidden
                self._restore(first)
                span[DONE] = first
                self._run()

    def command_at(self, axis: int, stamp: int = NEVER) -> tuple[int, float, float] | None:
        """Stamp [ns], value and step [m] of an axis's last command stamped by ``stamp`` [ns]; None for none."""
        if self.memory.incoming.times[axis, FIRST] == NEVER:
            return None
        events, drive, span = self.memory.filter.events, self.memory.filter.state.drive[axis], self._span
        last, before = last_commands(events.source, events.stamp, events.known, span[BEGIN], span[END], axis, stamp)
        earlier = float(drive[START] + drive[U])  # of those that have left the window
        if last < 0:
            return ALWAYS, earlier, float(drive[STEP])
        value = events.value.item(last, axis)
        step = float(drive[STEP]) if last < span[DONE] else value - earlier
        return events.stamp.item(last), value, step if before < 0 else value - events.value.item(before, axis)

    def forget(self, after: int) -> None:
        """Take back all that is stamped after ``after`` [ns]: it was of another clock. The rest is added again."""
        forget_after(self._counters, after)
        span, times, state = self._span, self.memory.incoming.times, self.memory.filter.state
        begin_row, end_row, axes = int(span[BEGIN]), int(span[END]), len(self.outcome)
        rows = self.memory.filter.events.rows(slice(begin_row, end_row))
        rows = Events(*(part.copy() for part in rows))
        if begin_row < span[DONE]:
            self._restore(begin_row)
        span[[END, DONE, RUN]] = begin_row
        span[ORIGIN] = NEVER if span[ORIGIN] > after else span[ORIGIN]
        rest = len(state.clock) - axes
        for axis in np.flatnonzero((times[:, FIRST] > after) & (times[:, FIRST] < NEVER)).tolist():
            times[axis, FIRST] = NEVER  # it had only just begun
            for part in state.by_row:
                part[axis] = part[rest + axis]
            state.drive[axis, START] = self.memory.incoming.values[axis, KNOWN_START]
            state.clock[axis] = state.settled[axis] = span[ORIGIN]
        first = times[:, FIRST].copy()
        times[first < NEVER, FIRST] = ALWAYS  # it has begun: what left the window since then stays
        bits = 1 << np.arange(axes)
        for row in range(len(rows.time)):
            sensor, given = int(rows.source[row]), int(bits[rows.known[row] != ABSENT].sum())
            if rows.stamp[row] > after:
                if sensor != COMMAND:
                    self._counters.number[sensor, Outcome.INVALID] += np.count_nonzero(rows.known[row] != ABSENT)
                continue
            self.value[:], self.spread[:] = rows.value[row], rows.spread[row]
            if sensor == COMMAND:
                put_command(*self._flat, int(rows.stamp[row]), given, ALWAYS)
            else:
                put_measurement(*self._flat, int(rows.stamp[row]), sensor, given, ALWAYS)
                self._counters.last[sensor] = max(self._counters.last[sensor], rows.stamp[row])
        self._run()
        times[first < NEVER, FIRST] = first[first < NEVER]
        self.spread[:] = 1.0

    def warm_up(self) -> None:
        """Have every kernel compiled and in memory; on a window that nobody needs."""
        self.estimate(0)
        self.memory.incoming.times[0, FIRST] = 0
        self.command_at(0)
        self.forget(0)
        self.counters()

    def count_late(self, sensor: int, stamp: int, newest: int) -> None:
        """Count a measurement that has come too late for the window; ``newest`` [ns] is the latest stamp of all."""
        count_rows(self._flat_counters, *self._counting, self._counted, self._counted, sensor, stamp, newest)

    def uncount_late(self, sensor: int) -> None:
        """Take one back that is fed again."""
        self._counters.number[sensor, CAME] -= 1

    def counters(self) -> Counters:
        """What there was of each sensor until now, with what is still in the window."""
        now = Counters(*(part.copy() for part in self._counters))
        count_rows(tuple(now), *self._rows(), self._counted, self._span.item(END), -1, 0, 0)
        return now

    def _count(self, sensor: int, stamp: int, newest: int) -> None:
        """Count a measurement that has come, and what has left the window."""
        left = self._span.item(BEGIN)
        count_rows(self._flat_counters, *self._counting, self._counted, left, sensor, stamp, newest)
        self._counted = left

    def _restore(self, row: int) -> None:
        """Bring the state to the checkpoint before a row."""
        axes = len(self.outcome)
        first = axes + 1 + axes * row
        for part in self.memory.filter.state.by_row:
            part[:axes] = part[first : first + axes]

    def _run(self, row: int = NO_ROOM) -> None:
        """Bring the state to where it is to be; what became of a ``row`` that is a measurement is known then."""
        done, end, known = self._span.item(DONE), self._span.item(RUN), self.memory.filter
        if done < end:
            places = len(known.events.time)
            filter_events(self._flat[0], False, done, end, end, *ALL_THERE, places, NO_TIMES, self._outputs)
            self._span[DONE] = end
        self.contradicts = NOBODY
        if row >= 0:
            self.outcome[:], self.innovation[:] = known.results.outcome[row], known.results.innovation[row]
            self.contradicts = known.results.contradicts.item(row)

    def _rows(self) -> tuple[Any, ...]:
        events, results = self.memory.filter.events, self.memory.filter.results
        return events.source, events.stamp, results.outcome, results.innovation, results.innovation_sd

    def _make_room(self) -> None:
        """Move what is in the window to the front, into more memory if it needs it; at the limit give up its oldest."""
        span, time = self._span, self.memory.filter.events.time
        rows, used = len(time), int(span[END] - span[BEGIN])
        if rows == MOST_ROWS and used > rows - rows // 8:
            oldest = span[BEGIN] + rows // 8
            self.floor = int(time[oldest]) + 1 + self._behind
            span[RUN] = max(span[RUN], oldest + 1)
            self._run()
            span[BEGIN] = oldest + 1
        self._count(-1, 0, 0)
        self._set(with_rows(self.memory, 2 * rows if used > rows // 2 and rows < MOST_ROWS else rows))
        self._counted = 0

    def _set(self, memory: Memory) -> None:
        self.memory, self._span, self.outcome = memory, memory.incoming.span, memory.incoming.outcome
        self._flat = memory.filter.flat(), tuple(memory.incoming)
        self.value, self.spread = memory.incoming.values[:, VALUE], memory.incoming.values[:, SPREAD]
        self._flat_counters, self._counting = tuple(self._counters), self._rows()


def with_rows(memory: Memory, rows: int) -> Memory:
    """The same window at the front of room for ``rows`` events."""
    known, span = memory.filter, memory.incoming.span.copy()
    axes, first, used = len(memory.incoming.outcome), int(span[BEGIN]), int(span[END] - span[BEGIN])

    def of_rows(part: np.ndarray) -> np.ndarray:
        found = np.zeros((rows, *part.shape[1:]), dtype=part.dtype)
        found[:used] = part[first : first + used]
        return found

    def of_state(part: np.ndarray) -> np.ndarray:
        now = axes + 1
        found = np.zeros((now + axes * (rows + 1), *part.shape[1:]), dtype=part.dtype)
        found[:now], found[-axes:] = part[:now], part[-axes:]
        found[now : now + axes * used] = part[now + axes * first : now + axes * (first + used)]
        return found

    span[[BEGIN, END, DONE, RUN]] -= first
    return Memory(
        known._replace(
            events=Events(*(of_rows(part) for part in known.events)),
            results=Results(*(of_rows(part) for part in known.results)),
            state=known.state._replace(**dict(zip(State._fields, map(of_state, known.state.by_row), strict=False))),
        ),
        memory.incoming._replace(span=span),
    )
