"""The forward pass: events in their order through the filter of each axis, an estimate where one is asked for.

Offline all events are there; as live they are fed in the order of arrival, and what comes late makes the pass go back
to a checkpoint and run on from there, as in the window of a stream; for a likelihood outcomes may be given.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..arrays import NEVER, BoolArray, FloatArray, IntArray, TimeArray
from ..compiled import compiled, inlined, kernel
from .axis import (
    DISTURBANCE,
    DRIFT,
    NOISE,
    NONE,
    OFFSET,
    PERIOD,
    REST,
    STATES,
    Model,
    Sensors,
    State,
    apply_command,
    copy_estimate,
    copy_rows,
    innovation,
    noise,
    position_of,
    predict_plant,
    predict_rest,
    update,
    variance_of_motion,
)
from .events import COMMAND, FUSED, Events, Results
from .gate import NOBODY, agrees, contradicted, count_fused, count_reacquired, count_rejected
from .outcome import Outcome

REJECTED, REACQUIRED = np.int64(Outcome.REJECTED), np.int64(Outcome.REACQUIRED)
# Numbers of a type: a literal as an argument would compile what is called once more.
ZERO, ONE = np.int64(0), np.int64(1)
INTERVAL = np.int64(-1)  # the row of an entry of the history that is no update


class Output(IntEnum):
    """What an estimate says of an axis, relative to its start level; first index of outputs, (8, A, n)."""

    POSITION = 0  # p [m]
    POSITION_SD = 1
    VELOCITY = 2  # mean over the coming update period [m/s]
    VELOCITY_SD = 3
    OFFSET = 4  # o [m]
    OFFSET_SD = 5
    DISTURBANCE = 6  # d [m]; left as it is where the model has none
    DISTURBANCE_SD = 7


class History(NamedTuple):
    """What the smoother needs of the forward pass: intervals and updates of each axis, and states at estimates.

    Attributes:
        first: Where each axis's entries begin, (A + 1,); all 0 where nothing is to be kept.
        used: How many each axis has, (A,).
        time: The instant after each, int64 ns, (k,).
        row: Which event's update it was, or ``INTERVAL``, (k,).
        noise: Input noise density squared of an interval [m²·s], R of an update [m²], (k,).
        drift: Drift density squared of an interval [m²/s]; of an update by how much the offset widened [m²], (k,).
        gain: K of an update, (k, s).
        x: Filtered mean at each estimate, (A, n, s).
        P: Its covariance, (A, n, s, s).
    """

    first: IntArray
    used: IntArray
    time: TimeArray
    row: IntArray
    noise: FloatArray
    drift: FloatArray
    gain: FloatArray
    x: FloatArray
    P: FloatArray


NO_TIMES = np.zeros(0, dtype=np.int64)
ALL_THERE = NO_TIMES, NO_TIMES, np.zeros(0, dtype=np.bool_)  # arrival, queue and arrived of events that are not late
NO_ESTIMATES = NO_TIMES, np.zeros((len(Output), 0, 0))  # times and outputs


class Filter(NamedTuple):
    """All arrays of a forward pass."""

    model: Model
    sensors: Sensors
    events: Events
    state: State
    results: Results
    history: History

    def flat(self) -> Flat:
        """As plain tuples, which a kernel takes a hundred times faster from Python."""
        return tuple(tuple(part) for part in self)


Flat: TypeAlias = tuple[Any, ...]


@inlined
def opened(flat: Flat) -> Filter:
    """The names again."""
    return Filter(
        Model(*flat[0]), Sensors(*flat[1]), Events(*flat[2]), State(*flat[3]), Results(*flat[4]), History(*flat[5])
    )


def no_history(axes: int, states: int) -> History:
    """A history in which nothing is kept, of axes with so many states."""
    none, table = np.zeros(0, dtype=np.int64), np.zeros((0, states))
    estimates = np.zeros((axes, 0, states)), np.zeros((axes, 0, states, states))
    first, used = np.zeros(axes + 1, dtype=np.int64), np.zeros(axes, dtype=np.int64)
    return History(first, used, none, none, np.zeros(0), np.zeros(0), table, *estimates)


@kernel
def filter_events(
    flat: Flat,
    given: bool,
    begin: int,
    end: int,
    filled: int,
    arrival: TimeArray,
    queue: IntArray,
    arrived: BoolArray,
    places: int,
    times: TimeArray,
    outputs: FloatArray,
) -> None:
    """Events in their order, and an estimate at each of ``times`` (ascending) by the events until then.

    Args:
        flat: A :class:`Filter`. Its state is before the events, and after them in the end; its results get what became
            of them, its history what the smoother needs, but not where events arrive late.
        given: Whether the outcomes in the results are repeated, whatever a gate would say now.
        begin: The first event.
        end: After the last one.
        filled: After the last row of the table; an estimate knows the commands in rows that are not yet run.
        arrival: When each event arrives, int64 ns, (n,). It and the next two are ``ALL_THERE`` where none is late.
        queue: The rows by ``arrival``. What comes late makes the filter go back and run on.
        arrived: All false, (n,).
        places: For checkpoints: more than rows may have to be taken back; 0 where none may.
        times: Of the estimates, int64 ns.
        outputs: Gets the estimates.
    """
    f = opened(flat)
    due, done = ZERO, begin
    for n in range(len(times) + 1):
        until = times[n] if n < len(times) else NEVER
        first = done
        while due < len(queue) and arrival[queue[due]] <= until:
            arrived[queue[due]] = True
            first = min(first, queue[due])
            due += 1
        if first < done:
            copy_rows(f.state, checkpoint_of(f.model, first, places), ZERO, len(f.model.kind))
        while done < end and f.events.time[done] <= until:
            done += 1
        run_events(f, first, done, given, arrived, places)
        if n < len(times):
            estimate(f, done, filled, times[n], outputs, n)


@inlined
def run_events(f: Filter, begin: int, end: int, given: bool, arrived: BoolArray, places: int) -> None:
    """Rows ``begin`` to ``end`` that have arrived: apply commands, gate measurements, update with what passes.

    Before each row the state is kept in one of its ``places``; with none, nothing can be taken back.
    """
    for row in range(begin, end):
        if places > 0:
            copy_rows(f.state, ZERO, checkpoint_of(f.model, row, places), len(f.model.kind))
        if len(arrived) == 0 or arrived[row]:
            run_event(f, row, given)


@inlined
def run_event(f: Filter, row: int, given: bool) -> None:
    """One row: a command of some axes, or a measurement."""
    source, axes = f.events.source[row], len(f.model.kind)
    f.results.contradicts[row] = NOBODY
    first = ZERO
    while first < axes:
        last = axes if source != COMMAND and f.sensors.gate_rows[source] else first + 1
        if source != COMMAND:
            add_measurement(f.model, f.sensors, f.events, f.state, row, first, last, given, f.results, f.history)
        else:
            add_command(f.model, f.events, f.state, row, first, f.history)
        first = last


@compiled
def add_command(model: Model, events: Events, state: State, row: int, axis: int, history: History) -> None:
    """One axis of one row."""
    if events.known[row, axis] == FUSED:
        advance(model, state, axis, events.time[row], history)
        apply_command(model, state, axis, axis, events.value[row, axis])


@compiled
def add_measurement(
    model: Model,
    sensors: Sensors,
    events: Events,
    state: State,
    row: int,
    first: int,
    end: int,
    given: bool,
    results: Results,
    history: History,
) -> None:
    """Axes ``first`` to ``end`` of one row, which pass the gate together or not at all."""
    sensor, time, gate, beyond = events.source[row], events.time[row], sensors.gate[events.source[row]], False
    for axis in range(first, end):
        results.outcome[row, axis] = events.known[row, axis] if not given else results.outcome[row, axis]
        if events.known[row, axis] != FUSED:
            continue
        advance(model, state, axis, time, history)
        predict_rest(model, state, axis, axis)
        R = noise_of(model, sensors, events, state, row, axis)
        nu, S = innovation(model, sensors, state, axis, sensor, events.value[row, axis], R)
        results.innovation[row, axis], results.innovation_sd[row, axis] = nu, math.sqrt(S)
        beyond |= gate > 0.0 and abs(nu) > gate * math.sqrt(S)
    reacquires = False
    if beyond and not given:
        reacquires = decide(model, sensors, events, state, row, first, end, results)
    for axis in range(first, end):
        if events.known[row, axis] != FUSED:
            continue
        nu, sd = results.innovation[row, axis], results.innovation_sd[row, axis]
        outcome = results.outcome[row, axis]
        if not given:
            outcome = REJECTED if beyond and not reacquires else FUSED
            if reacquires and abs(nu) > gate * sd:
                outcome = REACQUIRED
            results.outcome[row, axis] = outcome
        if outcome == REJECTED:
            continue
        R, widened = noise_of(model, sensors, events, state, row, axis), 0.0
        if outcome == REACQUIRED:
            widened = (nu / sensors.scale[sensor]) ** 2
            count_reacquired(state, axis, sensor, widened, time)
            _, S = innovation(model, sensors, state, axis, sensor, events.value[row, axis], R)
            results.innovation_sd[row, axis] = math.sqrt(S)
        update(model, state, axis, nu, R)
        count_fused(state, axis, sensor, time)
        write_history(history, axis, time, row, R, widened, state.work)


@compiled
def decide(
    model: Model, sensors: Sensors, events: Events, state: State, row: int, first: int, end: int, results: Results
) -> bool:
    """Whether a row beyond its gate re-acquires; if not, it is remembered, and whom it contradicts noted."""
    sensor, time = events.source[row], events.time[row]
    all_agree, again, other = True, False, NOBODY
    for axis in range(first, end):
        nu, sd = results.innovation[row, axis], results.innovation_sd[row, axis]
        if events.known[row, axis] == FUSED and abs(nu) > sensors.gate[sensor] * sd:
            R = noise_of(model, sensors, events, state, row, axis)
            agreement = agrees(model, sensors, state, axis, sensor, nu, R, time)
            all_agree &= agreement == 1
            again |= agreement < 0
            other = max(other, contradicted(sensors, state, axis, sensor, time))
    if all_agree and other == NOBODY:
        return True
    if all_agree:
        results.contradicts[row] = other
    for axis in range(first, end):
        if events.known[row, axis] == FUSED:
            R = noise_of(model, sensors, events, state, row, axis)
            count_rejected(state, axis, sensor, results.innovation[row, axis], R, time, again)
    return False


@compiled
def noise_of(model: Model, sensors: Sensors, events: Events, state: State, row: int, axis: int) -> float:
    """R of a value of the table, here and now."""
    spread = events.spread[row, axis] if len(events.spread) else 1.0
    return noise(model, sensors, state, axis, events.source[row], spread)


@compiled
def advance(model: Model, state: State, axis: int, time: int, history: History) -> None:
    """Predict the plant's mean of one axis to ``time`` [ns], and keep the interval for the smoother."""
    if time > state.clock[axis]:
        write_history(history, axis, time, INTERVAL, state.drive[axis, NOISE], state.drive[axis, DRIFT], state.work)
        predict_plant(model, state, axis, axis, time)


@compiled
def write_history(
    history: History, axis: int, time: int, row: int, noise: float, drift: float, work: FloatArray
) -> None:
    """Keep an entry, where entries are kept; the gain of an update is in ``work[axis, 1]``."""
    at = history.first[axis] + history.used[axis]
    if at < history.first[axis + 1]:
        history.time[at], history.row[at], history.noise[at], history.drift[at] = time, row, noise, drift
        if row != INTERVAL:
            for i in range(history.gain.shape[1]):
                history.gain[at, i] = work[axis, 1, i]
        history.used[axis] += 1


@inlined
def estimate(f: Filter, pending: int, end: int, time: int, outputs: FloatArray, n: int) -> None:
    """Every axis at ``time`` [ns] into ``outputs``, as estimate ``n``; the state stays as it is.

    Rows from ``pending`` to ``end`` are not in the state yet; of those until ``time`` only commands count.
    """
    model, events, state, history = f.model, f.events, f.state, f.history
    here = len(model.kind)  # a row of the state for predictions aside
    for axis in range(len(model.kind)):
        copy_estimate(state, axis, here)
        follow_commands(model, events, state, axis, here, pending, end, state.clock[axis] - 1, time, time)
        write_outputs(model.kind[axis, DISTURBANCE], state.x, state.P, here, outputs, axis, n)
        if history.x.shape[1]:
            for i in range(model.kind[axis, STATES]):
                history.x[axis, n, i] = state.x[here, i]
                for j in range(model.kind[axis, STATES]):
                    history.P[axis, n, i, j] = state.P[here, i, j]
            outputs[Output.VELOCITY, axis, n] = outputs[Output.VELOCITY_SD, axis, n] = math.nan
            continue
        period = model.gain[axis, PERIOD]
        until = time + int(np.rint(period * 1e9))
        known = variance_of_motion(model, state, axis, here, (until - time) / 1e9)
        for i in range(model.kind[axis, STATES]):
            for j in range(model.kind[axis, STATES]):
                state.P[here, i, j] = 0.0  # what comes is noise alone
        follow_commands(model, events, state, axis, here, pending, end, time, until, time)
        later, noise = position_of(model.kind[axis, DISTURBANCE], state.x, state.P, here)
        outputs[Output.VELOCITY, axis, n] = (later - outputs[Output.POSITION, axis, n]) / period
        outputs[Output.VELOCITY_SD, axis, n] = math.sqrt(known + noise) / period


@compiled
def write_outputs(
    disturbance: int, x: FloatArray, P: FloatArray, row: int, outputs: FloatArray, axis: int, n: int
) -> None:
    """What a state says of its axis, but for the velocity, as estimate ``n``."""
    outputs[Output.POSITION, axis, n], variance = position_of(disturbance, x, P, row)
    outputs[Output.POSITION_SD, axis, n] = math.sqrt(variance)
    outputs[Output.OFFSET, axis, n] = x[row, OFFSET]
    outputs[Output.OFFSET_SD, axis, n] = math.sqrt(max(P[row, OFFSET, OFFSET], 0.0))
    if disturbance != NONE:
        outputs[Output.DISTURBANCE, axis, n] = x[row, REST]
        outputs[Output.DISTURBANCE_SD, axis, n] = math.sqrt(max(P[row, REST, REST], 0.0))


@compiled
def follow_commands(
    model: Model,
    events: Events,
    state: State,
    axis: int,
    row: int,
    pending: int,
    end: int,
    after: int,
    until: int,
    stamped: int,
) -> None:
    """Predict a row of the state to ``until`` [ns] by commands that act ``after`` … and are ``stamped`` by …."""
    event, over = pending, False
    while not over:
        over = event >= end or events.time[event] > until
        if not over:
            given = events.source[event] == COMMAND and events.known[event, axis] == FUSED
            if not given or events.time[event] <= after or events.stamp[event] > stamped:
                event += 1
                continue
        predict_plant(model, state, axis, row, until if over else events.time[event])
        if not over:
            apply_command(model, state, axis, row, events.value[event, axis])
            event += 1
    predict_rest(model, state, axis, row)


@compiled
def checkpoint_of(model: Model, row: int, places: int) -> int:
    """The first row of the state where it is kept as it was before an event ``row``, in a ring of places."""
    axes = len(model.kind)
    return axes + 1 + axes * (row % places)
