"""The compiled filter: one scalar kernel for every use, on the plant's states, the offset and the biases only.

Commands wait in the drive until they act, so the state needs no delay chain. Each axis steps from instant to instant
(commands acting, readings valid) in closed form and meets its scalars by Joseph-form updates. Everything an axis has is
in arrays that change in place: a copy of them is a checkpoint. No fast-math: the same events give the same bits.

State of an axis: the plant's n states (position [m], and its rate [m/s] for a second-order plant), the offset, biases.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..arrays import BoolArray, CodeArray, FloatArray, IntArray, TimeArray
from ..compiled import compiled
from ..model.closed import advance_first, advance_second
from .timeline import REOPEN_AFTER, REOPEN_SPAN_NS, Outcome

_FUSED, _GATED, _REOPENED = int(Outcome.FUSED), int(Outcome.GATED), int(Outcome.REOPENED)


class Axes(NamedTuple):
    """What drives each of the A axes.

    Attributes:
        order: Of the plant, 1 or 2, (A,).
        constants: See :mod:`pumafuse.model.closed`, (A, c).
        states: How many of the state's entries are used, (A,).
        first: Where each axis's entries of the drive begin, and where the last one's end, (A + 1,).
        acting: When each entry reaches the plant, int64 ns, ascending on each axis, (e,).
        value: v from then on [m], (e,).
        noise: Input noise density squared from then on [m²·s], (e,).
        drift: Density squared of the offset's random walk from then on [m²/s], (e,).
        resting: Noise and drift before the first entry, (A, 2).
    """

    order: IntArray
    constants: FloatArray
    states: IntArray
    first: IntArray
    acting: TimeArray
    value: FloatArray
    noise: FloatArray
    drift: FloatArray
    resting: FloatArray


class Sensors(NamedTuple):
    """What is known of each of the S sensors.

    Attributes:
        scale: Of the position in the reading, (S,).
        latency_sd: How far the latency wanders [s], (S,).
        gate: In standard deviations, 0 for none, (S,).
        rows: Whether one axis gated gates the row, (S,).
        bias: Which state is its bias on each axis, −1 for none, (S, A).
    """

    scale: FloatArray
    latency_sd: FloatArray
    gate: FloatArray
    rows: BoolArray
    bias: IntArray


class Rows(NamedTuple):
    """R rows of readings in their total order, with the scalars of each side by side.

    Attributes:
        valid: The instant each is true of, int64 ns, (R,).
        sensor: (R,).
        first: Where each row's scalars begin, and where the last one's end, (R + 1,).
        axis: Of each scalar, (m,).
        value: z − scale · u₀ [m], (m,).
        sd: Noise [m], (m,).
    """

    valid: TimeArray
    sensor: IntArray
    first: IntArray
    axis: IntArray
    value: FloatArray
    sd: FloatArray


class State(NamedTuple):
    """All that changes; a copy is a checkpoint.

    Attributes:
        x: Mean, (A, s).
        P: Covariance, (A, s, s).
        clock: The instant each axis stands at, int64 ns, (A,).
        entry: The entry of the drive that acts, −1 before the first, counted from the axis's own first, (A,).
        rejected: Rejections in a row, of each sensor's rows (first column) or scalars by axis, (S, A + 1).
        since: When the first of them was valid, int64 ns, (S, A + 1).
        work: Room to compute in: H, K and H P of an update, then a mean and a covariance, (4 + s, s).
    """

    x: FloatArray
    P: FloatArray
    clock: TimeArray
    entry: IntArray
    rejected: IntArray
    since: TimeArray
    work: FloatArray


class Met(NamedTuple):
    """What became of each scalar.

    Attributes:
        innovation: ν [m], (m,).
        innovation_sd: √S [m], (m,).
        outcome: Codes of Outcome, (m,).
    """

    innovation: FloatArray
    innovation_sd: FloatArray
    outcome: CodeArray


class Outputs(NamedTuple):
    """Estimates of each axis, relative to its start level; all (A, n).

    Attributes:
        position: p [m].
        position_sd: [m].
        velocity: C(A x + B v) [m/s].
        velocity_sd: From the covariance of x alone [m/s].
        offset: o [m].
        offset_sd: [m].
    """

    position: FloatArray
    position_sd: FloatArray
    velocity: FloatArray
    velocity_sd: FloatArray
    offset: FloatArray
    offset_sd: FloatArray


class Log(NamedTuple):
    """What happened to each axis, for the smoother: intervals and updates, with room for all.

    Attributes:
        first: Where each axis's entries begin, (A + 1,); all 0 where nothing is to be kept.
        count: How many each axis has, (A,).
        time: The instant after each, int64 ns, (k,).
        scalar: Which scalar's update it was, −1 for an interval, (k,).
        noise: Input noise density squared of an interval [m²·s], R of an update [m²], (k,).
        drift: Drift density squared of an interval [m²/s]; of an update, by how much the offset was widened [m²], (k,).
        gain: Of an update, (k, s).
    """

    first: IntArray
    count: IntArray
    time: TimeArray
    scalar: IntArray
    noise: FloatArray
    drift: FloatArray
    gain: FloatArray


class Held(NamedTuple):
    """Filtered states at the instants of estimates, for the smoother.

    Attributes:
        x: (A, n, s).
        P: (A, n, s, s).
        input: v then [m], (A, n).
    """

    x: FloatArray
    P: FloatArray
    input: FloatArray


@compiled
def step(
    order: int, constants: FloatArray, states: int, x: FloatArray, P: FloatArray, ns: int, v: float, q: float, d: float
) -> None:
    """Predict over ``ns`` with the input held: x⁺ = v + Φ (x − v), P⁺ = Φ P Φᵀ + q Q, offset variance + d Δ."""
    if ns <= 0:
        return
    dt = ns / 1e9
    if order == 1:
        lost, q11 = advance_first(constants, dt)  # lost = Φ − 1
        kept = 1.0 + lost
        x[0] += lost * (x[0] - v)
        for j in range(1, states):
            P[0, j] *= kept
            P[j, 0] = P[0, j]
        P[0, 0] = kept * kept * P[0, 0] + q * q11
        P[1, 1] += d * dt
        return
    f11, f12, f21, f22, q11, q12, q22 = advance_second(constants, dt)
    gap, rate = x[0] - v, x[1]
    x[0] = v + (f11 * gap + f12 * rate)
    x[1] = f21 * gap + f22 * rate
    a, b, c = P[0, 0], P[0, 1], P[1, 1]
    u, w = f11 * a + f12 * b, f11 * b + f12 * c
    P[0, 0] = u * f11 + w * f12 + q * q11
    P[0, 1] = u * f21 + w * f22 + q * q12
    P[1, 0] = P[0, 1]
    P[1, 1] = (f21 * a + f22 * b) * f21 + (f21 * b + f22 * c) * f22 + q * q22
    for j in range(2, states):
        a, b = P[0, j], P[1, j]
        P[0, j] = f11 * a + f12 * b
        P[1, j] = f21 * a + f22 * b
        P[j, 0], P[j, 1] = P[0, j], P[1, j]
    P[2, 2] += d * dt


@compiled
def acting_now(axes: Axes, axis: int, entry: int) -> tuple[float, float, float]:
    """v [m], q [m²·s] and d [m²/s] of an entry of the drive; at rest before the first."""
    if entry < 0:
        return 0.0, axes.resting[axis, 0], axes.resting[axis, 1]
    at = axes.first[axis] + entry
    return axes.value[at], axes.noise[at], axes.drift[at]


@compiled
def advance(axes: Axes, state: State, log: Log, axis: int, time: int) -> None:
    """Bring one axis to ``time`` [ns], over every command that acts until then."""
    following, end = axes.first[axis] + state.entry[axis] + 1, axes.first[axis + 1]
    while True:
        acts = following < end and axes.acting[following] <= time
        until = axes.acting[following] if acts else time
        if until > state.clock[axis]:
            v, q, d = acting_now(axes, axis, state.entry[axis])
            ns = until - state.clock[axis]
            step(axes.order[axis], axes.constants[axis], axes.states[axis], state.x[axis], state.P[axis], ns, v, q, d)
            state.clock[axis] = until
            write_log(log, axis, until, -1, q, d, state.work[1])
        if not acts:
            return
        state.entry[axis] += 1
        following += 1


@compiled
def write_log(
    log: Log, axis: int, time: int, scalar: int, noise: float, drift: float, gain: FloatArray
) -> None:
    """Keep an entry, where entries are kept."""
    at = log.first[axis] + log.count[axis]
    if at < log.first[axis + 1]:
        log.time[at], log.scalar[at], log.noise[at], log.drift[at] = time, scalar, noise, drift
        if scalar >= 0:
            log.gain[at] = gain
        log.count[axis] += 1


@compiled
def velocity(order: int, constants: FloatArray, x: FloatArray, v: float) -> float:
    """C(A x + B v) [m/s]: the model's drift."""
    return x[1] if order == 2 else constants[0] * (v - x[0])


@compiled
def observation(axes: Axes, sensors: Sensors, axis: int, sensor: int, row: FloatArray) -> None:
    """H of a sensor on an axis, into ``row`` (s,)."""
    row[:] = 0.0
    row[0] = row[axes.order[axis]] = sensors.scale[sensor]
    if sensors.bias[sensor, axis] >= 0:
        row[sensors.bias[sensor, axis]] = 1.0


@compiled
def joseph(P: FloatArray, states: int, row: FloatArray, R: float, gain: FloatArray, left: FloatArray) -> None:
    """P⁺ = (I − K H) P (I − K H)ᵀ + K R Kᵀ with K = P Hᵀ / (H P Hᵀ + R), which is left in ``gain``.

    The smoother uses it for its dual, too: information that passes through noise of unit variance along ``row``.
    """
    spread = R
    for i in range(states):
        left[i] = 0.0
        for j in range(states):
            left[i] += P[i, j] * row[j]
        spread += row[i] * left[i]
    for i in range(states):
        gain[i] = left[i] / spread
    for i in range(states):  # W = (I − K H) P
        for j in range(states):
            P[i, j] -= gain[i] * left[j]
    for i in range(states):  # W Hᵀ
        left[i] = 0.0
        for j in range(states):
            left[i] += P[i, j] * row[j]
    for i in range(states):  # W − W Hᵀ Kᵀ + K R Kᵀ
        P[i, i] += gain[i] * R * gain[i] - left[i] * gain[i]
        for j in range(i):
            both = 0.5 * (P[i, j] - left[i] * gain[j] + P[j, i] - left[j] * gain[i]) + gain[i] * R * gain[j]
            P[i, j] = both
            P[j, i] = both


@compiled
def predicted(
    axes: Axes, sensors: Sensors, rows: Rows, state: State, scalar: int, sensor: int
) -> tuple[float, float, float]:
    """ν = z − H x, S = H P Hᵀ + R and R of a scalar here and now; R grows with speed where latency wanders."""
    axis = rows.axis[scalar]
    x, P, row, states = state.x[axis], state.P[axis], state.work[0], axes.states[axis]
    observation(axes, sensors, axis, sensor, row)
    R = rows.sd[scalar] ** 2
    if sensors.latency_sd[sensor] > 0.0:
        v, _, _ = acting_now(axes, axis, state.entry[axis])
        speed = velocity(axes.order[axis], axes.constants[axis], x, v)
        R += (sensors.scale[sensor] * speed * sensors.latency_sd[sensor]) ** 2
    nu, S = rows.value[scalar], R
    for i in range(states):
        nu -= row[i] * x[i]
        for j in range(states):
            S += row[i] * P[i, j] * row[j]
    return nu, S, R


@compiled
def meet(axes: Axes, sensors: Sensors, rows: Rows, state: State, met: Met, log: Log, row: int) -> None:
    """Gate a row and fuse what passes: whole rows or scalar by scalar, as the sensor says."""
    if sensors.rows[rows.sensor[row]]:
        meet_together(axes, sensors, rows, state, met, log, row, rows.first[row], rows.first[row + 1], 0)
    else:
        for scalar in range(rows.first[row], rows.first[row + 1]):
            meet_together(axes, sensors, rows, state, met, log, row, scalar, scalar + 1, rows.axis[scalar] + 1)


@compiled
def meet_together(
    axes: Axes, sensors: Sensors, rows: Rows, state: State, met: Met, log: Log, row: int, begin: int, end: int, part: int
) -> None:
    """Scalars of one row that pass the gate together or not at all."""
    sensor, valid = rows.sensor[row], rows.valid[row]
    gate, any_beyond = sensors.gate[sensor], False
    for scalar in range(begin, end):
        advance(axes, state, log, rows.axis[scalar], valid)
        nu, S, _ = predicted(axes, sensors, rows, state, scalar, sensor)
        met.innovation[scalar], met.innovation_sd[scalar] = nu, math.sqrt(S)
        any_beyond |= gate > 0.0 and abs(nu) > gate * math.sqrt(S)
    if state.rejected[sensor, part] == 0:
        state.since[sensor, part] = valid
    long_enough = valid - state.since[sensor, part] >= REOPEN_SPAN_NS
    reopens = any_beyond and state.rejected[sensor, part] >= REOPEN_AFTER and long_enough
    state.rejected[sensor, part] = state.rejected[sensor, part] + 1 if any_beyond and not reopens else 0
    for scalar in range(begin, end):
        if any_beyond and not reopens:
            met.outcome[scalar] = _GATED
            continue
        axis = rows.axis[scalar]
        nu, S, R = predicted(axes, sensors, rows, state, scalar, sensor)
        widened = nu * nu if abs(nu) > gate * math.sqrt(S) and reopens else 0.0
        P, o = state.P[axis], axes.order[axis]
        if widened > 0.0:
            P[o, o] += widened
            _, S, _ = predicted(axes, sensors, rows, state, scalar, sensor)
            met.innovation_sd[scalar] = math.sqrt(S)
        joseph(P, axes.states[axis], state.work[0], R, state.work[1], state.work[2])
        for i in range(axes.states[axis]):
            state.x[axis, i] += state.work[1, i] * nu
        met.outcome[scalar] = _REOPENED if widened > 0.0 else _FUSED
        write_log(log, axis, valid, scalar, R, widened, state.work[1])


@compiled
def spread_of(P: FloatArray, first: int, second: int) -> float:
    """Standard deviation of the sum of two states."""
    return math.sqrt(max(P[first, first] + 2.0 * P[first, second] + P[second, second], 0.0))


@compiled
def write_output(
    order: int, constants: FloatArray, x: FloatArray, P: FloatArray, v: float, outputs: Outputs, axis: int, at: int
) -> None:
    """The estimate that a state is."""
    outputs.position[axis, at] = x[0] + x[order]
    outputs.position_sd[axis, at] = spread_of(P, 0, order)
    outputs.velocity[axis, at] = velocity(order, constants, x, v)
    own = math.sqrt(max(P[order - 1, order - 1], 0.0))
    outputs.velocity_sd[axis, at] = own if order == 2 else own * constants[0]
    outputs.offset[axis, at] = x[order]
    outputs.offset_sd[axis, at] = math.sqrt(max(P[order, order], 0.0))


@compiled
def estimate(axes: Axes, state: State, log: Log, time: int, held: Held, outputs: Outputs, at: int) -> None:
    """Predict every axis to ``time`` [ns] beside the state, which itself goes on over what acts until then."""
    x, P = state.work[3], state.work[4:]
    for axis in range(len(axes.order)):
        following, end = axes.first[axis] + state.entry[axis] + 1, axes.first[axis + 1]
        while following < end and axes.acting[following] <= time:
            following += 1
        if following - 1 >= axes.first[axis]:
            advance(axes, state, log, axis, axes.acting[following - 1])
        v, q, d = acting_now(axes, axis, state.entry[axis])
        order, constants, states = axes.order[axis], axes.constants[axis], axes.states[axis]
        x[:], P[:] = state.x[axis], state.P[axis]
        step(order, constants, states, x, P, time - state.clock[axis], v, q, d)
        if held.x.shape[1]:
            held.x[axis, at], held.P[axis, at], held.input[axis, at] = x, P, v
        else:
            write_output(order, constants, x, P, v, outputs, axis, at)


@compiled
def filter_run(
    axes: Axes,
    sensors: Sensors,
    rows: Rows,
    state: State,
    times: TimeArray,
    met: Met,
    log: Log,
    held: Held,
    outputs: Outputs,
) -> None:
    """Every row at its valid time, whenever it arrived, and an estimate at each of ``times`` (ascending)."""
    at = 0
    for row in range(len(rows.valid)):
        while at < len(times) and times[at] < rows.valid[row]:
            estimate(axes, state, log, times[at], held, outputs, at)
            at += 1
        meet(axes, sensors, rows, state, met, log, row)
    while at < len(times):
        estimate(axes, state, log, times[at], held, outputs, at)
        at += 1


@compiled
def keep(state: State, kept: State, place: int) -> None:
    """Copy a state into place ``place`` of many."""
    kept.x[place], kept.P[place] = state.x, state.P
    kept.clock[place], kept.entry[place] = state.clock, state.entry
    kept.rejected[place], kept.since[place] = state.rejected, state.since


@compiled
def go_back(state: State, kept: State, place: int) -> None:
    """Undo everything since :func:`keep`."""
    state.x[:], state.P[:] = kept.x[place], kept.P[place]
    state.clock[:], state.entry[:] = kept.clock[place], kept.entry[place]
    state.rejected[:], state.since[:] = kept.rejected[place], kept.since[place]


@compiled
def filter_as_live(
    axes: Axes,
    sensors: Sensors,
    rows: Rows,
    arrival: TimeArray,
    queue: IntArray,
    state: State,
    kept: State,
    times: TimeArray,
    met: Met,
    log: Log,
    held: Held,
    outputs: Outputs,
) -> None:
    """At each of ``times`` only the rows that had arrived: late ones make the filter go back and replay.

    ``queue`` lists the rows by ``arrival``; ``kept`` has as many places as rows may have to be taken back, and two.
    """
    arrived = np.zeros(len(rows.valid), dtype=np.bool_)
    due, done, reach = 0, 0, 0  # rows before `done` are dealt with: fused, or not here yet
    places = len(kept.clock)
    for at in range(len(times) + 1):
        earliest = done
        while due < len(queue) and (at == len(times) or arrival[queue[due]] <= times[at]):
            row = queue[due]
            arrived[row] = True
            earliest, reach = min(earliest, row), max(reach, row + 1)
            due += 1
        if earliest < done:
            go_back(state, kept, earliest % places)
        for row in range(earliest, reach):
            keep(state, kept, row % places)
            if arrived[row]:
                meet(axes, sensors, rows, state, met, log, row)
        done = reach
        if at < len(times):
            keep(state, kept, done % places)  # estimates let the state go on, rows still to come may be before that
            estimate(axes, state, log, times[at], held, outputs, at)
            go_back(state, kept, done % places)


@compiled
def carry_back(
    order: int, constants: FloatArray, states: int, eta: FloatArray, N: FloatArray, ns: int, q: float, d: float,
    work: FloatArray,
) -> None:
    """η and N over an interval, backward: through its noise, one independent part at a time, then by Fᵀ."""
    dt = ns / 1e9
    if order == 1:
        lost, q11 = advance_first(constants, dt)
        pass_noise(eta, N, states, 0, math.sqrt(q * q11), 0.0, work)
        pass_noise(eta, N, states, 1, math.sqrt(d * dt), 0.0, work)
        kept = 1.0 + lost
        eta[0] *= kept
        for j in range(1, states):
            N[0, j] *= kept
            N[j, 0] = N[0, j]
        N[0, 0] *= kept * kept
        return
    f11, f12, f21, f22, q11, q12, q22 = advance_second(constants, dt)
    first = math.sqrt(q * q11)
    both = q * q12 / first if first > 0.0 else 0.0
    pass_noise(eta, N, states, 0, first, both, work)
    pass_noise(eta, N, states, 1, math.sqrt(max(q * q22 - both * both, 0.0)), 0.0, work)
    pass_noise(eta, N, states, 2, math.sqrt(d * dt), 0.0, work)
    eta[0], eta[1] = f11 * eta[0] + f21 * eta[1], f12 * eta[0] + f22 * eta[1]
    a, b, c = N[0, 0], N[0, 1], N[1, 1]
    u, w = f11 * a + f21 * b, f11 * b + f21 * c
    N[0, 0] = u * f11 + w * f21
    N[0, 1] = u * f12 + w * f22
    N[1, 0] = N[0, 1]
    N[1, 1] = (f12 * a + f22 * b) * f12 + (f12 * b + f22 * c) * f22
    for j in range(2, states):
        a, b = N[0, j], N[1, j]
        N[0, j] = f11 * a + f21 * b
        N[1, j] = f12 * a + f22 * b
        N[j, 0], N[j, 1] = N[0, j], N[1, j]


@compiled
def pass_noise(
    eta: FloatArray, N: FloatArray, states: int, at: int, first: float, second: float, work: FloatArray
) -> None:
    """η and N through noise of unit variance that enters state ``at`` by ``first`` and the next one by ``second``."""
    if first == 0.0 and second == 0.0:
        return
    row, gain = work[0], work[1]
    row[:] = 0.0
    row[at] = first
    if second != 0.0:
        row[at + 1] = second
    joseph(N, states, row, 1.0, gain, work[2])
    told = row[at] * eta[at] + second * eta[at + 1] if second != 0.0 else row[at] * eta[at]
    for i in range(states):
        eta[i] -= gain[i] * told


@compiled
def smoothed(x: FloatArray, P: FloatArray, states: int, eta: FloatArray, N: FloatArray, work: FloatArray) -> None:
    """P_s = (I + P N)⁻¹ P and x_s = x + P_s η in place: N = L Lᵀ is met column by column, as readings of unit noise."""
    L = work[4 : 4 + len(x)]
    for j in range(states):
        pivot = N[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        for i in range(states):
            L[i, j] = 0.0
        if pivot <= 1e-15 * N[j, j]:  # nothing is said beyond the columns before
            continue
        L[j, j] = math.sqrt(pivot)
        for i in range(j + 1, states):
            rest = N[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = rest / L[j, j]
    for j in range(states):
        for i in range(states):
            work[0, i] = L[i, j]
        joseph(P, states, work[0], 1.0, work[1], work[2])
    for i in range(states):
        for j in range(states):
            x[i] += P[i, j] * eta[j]


@compiled
def smooth_run(
    axes: Axes,
    sensors: Sensors,
    rows: Rows,
    log: Log,
    met: Met,
    sensor_of: IntArray,
    origin: int,
    times: TimeArray,
    held: Held,
    outputs: Outputs,
) -> None:
    """Estimates that know every reading: the filter's, with what all later ones say, carried backward as η and N.

    Over an update η ← η + N K ν + Hᵀ ν / R and N ← N + Hᵀ H / R; ``sensor_of`` is the sensor of each scalar.
    """
    width = held.x.shape[2]
    eta, N, row = np.zeros(width), np.zeros((width, width)), np.zeros(width)
    part_eta, part_N, work = np.zeros(width), np.zeros((width, width)), np.zeros((4 + width, width))
    for axis in range(len(axes.order)):
        order, constants, states = axes.order[axis], axes.constants[axis], axes.states[axis]
        eta[:], N[:], at = 0.0, 0.0, len(times) - 1
        for entry in range(log.first[axis] + log.count[axis] - 1, log.first[axis] - 2, -1):
            before_all = entry < log.first[axis]
            until = origin if before_all else log.time[entry]
            while at >= 0 and times[at] >= until:
                smooth_output(axes, axis, at, held, eta, N, work, outputs)
                at -= 1
            if before_all:
                break
            scalar = log.scalar[entry]
            if scalar < 0:
                start = log.time[entry - 1] if entry > log.first[axis] else origin
                while at >= 0 and times[at] > start:
                    part_eta[:], part_N[:] = eta, N
                    rest = until - times[at]
                    carry_back(
                        order, constants, states, part_eta, part_N, rest, log.noise[entry], log.drift[entry], work
                    )
                    smooth_output(axes, axis, at, held, part_eta, part_N, work, outputs)
                    at -= 1
                carry_back(order, constants, states, eta, N, until - start, log.noise[entry], log.drift[entry], work)
                continue
            observation(axes, sensors, axis, sensor_of[scalar], row)
            nu, R, gain = met.innovation[scalar], log.noise[entry], log.gain[entry]
            for i in range(states):
                for j in range(states):
                    eta[i] += N[i, j] * gain[j] * nu
                eta[i] += row[i] * nu / R
            for i in range(states):
                for j in range(states):
                    N[i, j] += row[i] * row[j] / R
            if log.drift[entry] > 0.0:  # a gate that reopened let the offset move
                pass_noise(eta, N, states, order, math.sqrt(log.drift[entry]), 0.0, work)


@compiled
def smooth_output(
    axes: Axes, axis: int, at: int, held: Held, eta: FloatArray, N: FloatArray, work: FloatArray, outputs: Outputs
) -> None:
    """One smoothed estimate."""
    x, P = held.x[axis, at], held.P[axis, at]
    smoothed(x, P, axes.states[axis], eta, N, work)
    write_output(axes.order[axis], axes.constants[axis], x, P, held.input[axis, at], outputs, axis, at)
