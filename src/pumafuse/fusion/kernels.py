"""The compiled filter, event by event: one component kernel for every use, on the plant's states, offset, biases.

Commands wait in the drive until they act, so the state needs no delay chain. Each axis steps from instant to instant
(commands acting, measurements valid) in closed form and meets its components by Joseph-form updates. Everything an axis
has is in arrays that change in place: a copy of them is a checkpoint. No fast-math: the same events give the same bits.
Recorded runs (`run_kernels.py`) and streams (`live/kernels.py`) are both made of these.

State of an axis: the plant's n states (position [m], and its rate [m/s] for a second-order plant), the offset, biases.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import math
from typing import NamedTuple

from ..arrays import BoolArray, CodeArray, FloatArray, IndexArray, IntArray, TimeArray
from ..compiled import compiled
from ..model.closed import advance_first, advance_second
from .outcome import REOPEN_AFTER, REOPEN_SPAN_NS, Outcome

_FUSED, _REJECTED, _REACQUIRED = int(Outcome.FUSED), int(Outcome.REJECTED), int(Outcome.REACQUIRED)
_ROUNDING = 1e-15  # of the variances that S is made of: S cannot be known to be smaller


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
        scale: Of the position in the measurement, (S,).
        level: scale · u₀ of each axis [m], (S, A).
        sd: Noise on each axis [m], (S, A).
        latency_sd: How far the latency wanders [s], (S,).
        gate: In standard deviations, 0 for none, (S,).
        gate_rows: Whether one axis rejected gates the row, (S,).
        bias: Which state is its bias on each axis, −1 for none, (S, A).
    """

    scale: FloatArray
    level: FloatArray
    sd: FloatArray
    latency_sd: FloatArray
    gate: FloatArray
    gate_rows: BoolArray
    bias: IntArray


class Rows(NamedTuple):
    """R rows of measurements in their total order, with the components of each side by side.

    Attributes:
        valid: The instant each is true of, int64 ns, (R,).
        sensor: (R,).
        first: Where each row's components begin, (R,).
        end: Where they end, (R,).
        axis: Of each component, (m,).
        value: z [m] as logged, (m,).
        spread: By what the noise of each is scaled, (m,); (0,) where it is by nothing.
    """

    valid: TimeArray
    sensor: IndexArray
    first: IntArray
    end: IntArray
    axis: IndexArray
    value: FloatArray
    spread: FloatArray


class State(NamedTuple):
    """All that changes; a copy is a checkpoint.

    Attributes:
        x: Mean, (A + 1, s); the last is room for a prediction aside.
        P: Covariance, (A + 1, s, s).
        clock: The instant each axis stands at, int64 ns, (A,).
        entry: The entry of the drive that acts, −1 before the first, counted from the axis's own first, (A,).
        fused: When the last component that was fused was valid, int64 ns, (A,).
        rejected: Rejections in a row, of each sensor's rows (first column) or components by axis, (S, A + 1).
        since: When the first of them was valid, int64 ns, (S, A + 1).
        work: Room for an update's vectors: H, K, P Hᵀ and (I − K H) P Hᵀ, (4, s).
    """

    x: FloatArray
    P: FloatArray
    clock: TimeArray
    entry: IntArray
    fused: TimeArray
    rejected: IntArray
    since: TimeArray
    work: FloatArray


class Met(NamedTuple):
    """What became of each component.

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
        used: How many each axis has, (A,).
        time: The instant after each, int64 ns, (k,).
        component: Which component's update it was, −1 for an interval, (k,).
        noise: Input noise density squared of an interval [m²·s], R of an update [m²], (k,).
        drift: Drift density squared of an interval [m²/s]; of an update, by how much the offset was widened [m²], (k,).
        gain: Of an update, (k, s).
    """

    first: IntArray
    used: IntArray
    time: TimeArray
    component: IntArray
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
def step(axes: Axes, axis: int, x: FloatArray, P: FloatArray, at: int, ns: int, entry: int) -> None:
    """Predict x[at] and P[at] of an axis over ``ns`` with an entry of its drive held.

    x⁺ = v + Φ (x − v), P⁺ = Φ P Φᵀ + q Q, and the offset's variance grows by d Δ.
    """
    v, q, d = acting_now(axes, axis, entry)
    dt, states = ns / 1e9, axes.states[axis]
    if axes.order[axis] == 1:
        lost, q11 = advance_first(axes.constants, axis, dt)  # lost = Φ − 1
        kept = 1.0 + lost
        x[at, 0] += lost * (x[at, 0] - v)
        for j in range(1, states):
            P[at, 0, j] *= kept
            P[at, j, 0] = P[at, 0, j]
        P[at, 0, 0] = kept * kept * P[at, 0, 0] + q * q11
        P[at, 1, 1] += d * dt
        return
    f11, f12, f21, f22, q11, q12, q22 = advance_second(axes.constants, axis, dt)
    gap, rate = x[at, 0] - v, x[at, 1]
    x[at, 0] = v + (f11 * gap + f12 * rate)
    x[at, 1] = f21 * gap + f22 * rate
    a, b, c = P[at, 0, 0], P[at, 0, 1], P[at, 1, 1]
    u, w = f11 * a + f12 * b, f11 * b + f12 * c
    P[at, 0, 0] = u * f11 + w * f12 + q * q11
    P[at, 0, 1] = P[at, 1, 0] = u * f21 + w * f22 + q * q12
    P[at, 1, 1] = (f21 * a + f22 * b) * f21 + (f21 * b + f22 * c) * f22 + q * q22
    for j in range(2, states):
        a, b = P[at, 0, j], P[at, 1, j]
        P[at, 0, j] = P[at, j, 0] = f11 * a + f12 * b
        P[at, 1, j] = P[at, j, 1] = f21 * a + f22 * b
    P[at, 2, 2] += d * dt


@compiled
def acting_now(axes: Axes, axis: int, entry: int) -> tuple[float, float, float]:
    """The v [m], q [m²·s] and d [m²/s] of an entry of the drive; at rest before the first."""
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
            step(axes, axis, state.x, state.P, axis, until - state.clock[axis], state.entry[axis])
            state.clock[axis] = until
            if log.first[axis] < log.first[axis + 1]:
                _, q, d = acting_now(axes, axis, state.entry[axis])
                write_log(log, axis, until, -1, q, d, state.work)
        if not acts:
            return
        state.entry[axis] += 1
        following += 1


@compiled
def write_log(log: Log, axis: int, time: int, component: int, noise: float, drift: float, work: FloatArray) -> None:
    """Keep an entry, where entries are kept; an update's gain is in ``work[1]``."""
    at = log.first[axis] + log.used[axis]
    if at < log.first[axis + 1]:
        log.time[at], log.component[at], log.noise[at], log.drift[at] = time, component, noise, drift
        if component >= 0:
            for i in range(log.gain.shape[1]):
                log.gain[at, i] = work[1, i]
        log.used[axis] += 1


@compiled
def velocity(axes: Axes, axis: int, x: FloatArray, at: int, v: float) -> float:
    """C(A x + B v) [m/s]: the model's drift."""
    return x[at, 1] if axes.order[axis] == 2 else axes.constants[axis, 0] * (v - x[at, 0])


@compiled
def observation(axes: Axes, sensors: Sensors, axis: int, sensor: int, work: FloatArray) -> None:
    """H of a sensor on an axis, into ``work[0]``."""
    for i in range(axes.states[axis]):
        work[0, i] = 0.0
    work[0, 0] = work[0, axes.order[axis]] = sensors.scale[sensor]
    if sensors.bias[sensor, axis] >= 0:
        work[0, sensors.bias[sensor, axis]] = 1.0


@compiled
def joseph_three(
    a: float, b: float, c: float, d: float, e: float, f: float, h0: float, h1: float, h2: float, R: float, S: float
) -> tuple[float, float, float, float, float, float]:
    """(I − K H) P (I − K H)ᵀ + K R Kᵀ with P = [a b d; b c e; d e f]; S is infinite without a measurement.

    A quotient is exactly 1 where a prior is all there is to S; a product with 1/S would leave a variance below 0.
    """
    s0, s1, s2 = a * h0 + b * h1 + d * h2, b * h0 + c * h1 + e * h2, d * h0 + e * h1 + f * h2
    k0, k1, k2 = s0 / S, s1 / S, s2 / S
    w00, w01, w02 = a - k0 * s0, b - k0 * s1, d - k0 * s2
    w10, w11, w12 = b - k1 * s0, c - k1 * s1, e - k1 * s2
    w20, w21, w22 = d - k2 * s0, e - k2 * s1, f - k2 * s2
    r0 = w00 * h0 + w01 * h1 + w02 * h2
    r1 = w10 * h0 + w11 * h1 + w12 * h2
    r2 = w20 * h0 + w21 * h1 + w22 * h2
    return (
        0.5 * (w00 - r0 * k0 + w00 - r0 * k0) + k0 * R * k0,
        0.5 * (w10 - r1 * k0 + w01 - r0 * k1) + k1 * R * k0,
        0.5 * (w11 - r1 * k1 + w11 - r1 * k1) + k1 * R * k1,
        0.5 * (w20 - r2 * k0 + w02 - r0 * k2) + k2 * R * k0,
        0.5 * (w21 - r2 * k1 + w12 - r1 * k2) + k2 * R * k1,
        0.5 * (w22 - r2 * k2 + w22 - r2 * k2) + k2 * R * k2,
    )


@compiled
def joseph(P: FloatArray, at: int, states: int, R: float, work: FloatArray) -> None:
    """P⁺ = (I − K H) P (I − K H)ᵀ + K R Kᵀ with H in ``work[0]`` and K = P Hᵀ / (H P Hᵀ + R), left in ``work[1]``.

    The smoother uses it for its dual, too: information that passes through noise of unit variance along H. A state that
    H does not see and that shares nothing with the others changes no bit of theirs.
    """
    spread, seen = R, 0.0
    for i in range(states):
        seen += work[0, i] * work[0, i] * P[at, i, i]
        across = 0.0
        for j in range(states):
            across += P[at, i, j] * work[0, j]
        work[2, i] = across
        spread += work[0, i] * across
    spread = max(spread, R, _ROUNDING * seen)
    for i in range(states):
        work[1, i] = work[2, i] / spread
    if states == 3:  # what most axes have, in registers
        P[at, 0, 0], P[at, 0, 1], P[at, 1, 1], P[at, 0, 2], P[at, 1, 2], P[at, 2, 2] = joseph_three(
            P[at, 0, 0], P[at, 0, 1], P[at, 1, 1], P[at, 0, 2], P[at, 1, 2], P[at, 2, 2],
            work[0, 0], work[0, 1], work[0, 2], R, spread,
        )  # fmt: skip
        P[at, 1, 0], P[at, 2, 0], P[at, 2, 1] = P[at, 0, 1], P[at, 0, 2], P[at, 1, 2]
        return
    for i in range(states):  # W = (I − K H) P and W Hᵀ
        across = 0.0
        for j in range(states):
            P[at, i, j] -= work[1, i] * work[2, j]
            across += P[at, i, j] * work[0, j]
        work[3, i] = across
    for i in range(states):  # W − W Hᵀ Kᵀ + K R Kᵀ; the last apart, or beside a wide prior it would be rounded away
        for j in range(i + 1):
            left = P[at, i, j] - work[3, i] * work[1, j] + P[at, j, i] - work[3, j] * work[1, i]
            P[at, i, j] = P[at, j, i] = 0.5 * left + work[1, i] * R * work[1, j]


@compiled
def noise(axes: Axes, sensors: Sensors, rows: Rows, state: State, component: int, sensor: int) -> float:
    """R of a component here and now [m²]; it grows with speed where latency wanders."""
    axis = rows.axis[component]
    sd = sensors.sd[sensor, axis] * (rows.spread[component] if len(rows.spread) else 1.0)
    R = sd * sd
    if sensors.latency_sd[sensor] > 0.0:
        v, _, _ = acting_now(axes, axis, state.entry[axis])
        speed = velocity(axes, axis, state.x, axis, v)
        R += (sensors.scale[sensor] * speed * sensors.latency_sd[sensor]) ** 2
    return R


@compiled
def predicted(
    axes: Axes, sensors: Sensors, rows: Rows, state: State, component: int, sensor: int
) -> tuple[float, float]:
    """ν = z − H x and S = H P Hᵀ + R of a component here and now."""
    axis, R = rows.axis[component], noise(axes, sensors, rows, state, component, sensor)
    x, P, o, scale, bias = state.x, state.P, axes.order[axis], sensors.scale[sensor], sensors.bias[sensor, axis]
    nu = rows.value[component] - sensors.level[sensor, axis] - scale * (x[axis, 0] + x[axis, o])
    S = scale * scale * (P[axis, 0, 0] + 2.0 * P[axis, 0, o] + P[axis, o, o])
    if bias >= 0:
        nu -= x[axis, bias]
        S += 2.0 * scale * (P[axis, 0, bias] + P[axis, o, bias]) + P[axis, bias, bias]
    seen = scale * scale * (P[axis, 0, 0] + P[axis, o, o]) + (P[axis, bias, bias] if bias >= 0 else 0.0)
    return nu, max(S + R, R, _ROUNDING * seen)


@compiled
def meet(axes: Axes, sensors: Sensors, rows: Rows, state: State, met: Met, log: Log, row: int) -> None:
    """Gate a row and fuse what passes: whole rows or component by component, as the sensor says."""
    component, together = rows.first[row], sensors.gate_rows[rows.sensor[row]]
    while component < rows.end[row]:  # one call: each would be compiled as a copy of its own
        end, part = (rows.end[row], 0) if together else (component + 1, rows.axis[component] + 1)
        meet_together(axes, sensors, rows, state, met, log, row, component, end, part)
        component = end


@compiled
def meet_together(
    axes: Axes,
    sensors: Sensors,
    rows: Rows,
    state: State,
    met: Met,
    log: Log,
    row: int,
    first: int,
    end: int,
    part: int,
) -> None:
    """Components ``first`` to ``end`` of one row, which pass the gate together or not at all.

    ``part`` is where their rejections in a row are counted (:class:`State`): 0 for whole rows, axis + 1 for a
    component.
    """
    sensor, valid = rows.sensor[row], rows.valid[row]
    gate, any_beyond = sensors.gate[sensor], False
    for component in range(first, end):
        advance(axes, state, log, rows.axis[component], valid)
        nu, S = predicted(axes, sensors, rows, state, component, sensor)
        sd = math.sqrt(S)
        met.innovation[component], met.innovation_sd[component] = nu, sd
        any_beyond |= gate > 0.0 and abs(nu) > gate * sd
    if state.rejected[sensor, part] == 0:
        state.since[sensor, part] = valid
    long_enough = valid - state.since[sensor, part] >= REOPEN_SPAN_NS
    reopens = any_beyond and state.rejected[sensor, part] >= REOPEN_AFTER and long_enough
    state.rejected[sensor, part] = state.rejected[sensor, part] + 1 if any_beyond and not reopens else 0
    for component in range(first, end):
        if any_beyond and not reopens:
            met.outcome[component] = _REJECTED
        else:
            fuse(axes, sensors, rows, state, met, log, row, component, gate if reopens else math.inf)


@compiled
def fuse(
    axes: Axes, sensors: Sensors, rows: Rows, state: State, met: Met, log: Log, row: int, component: int, gate: float
) -> None:
    """Update with one component; one beyond the ``gate``, which reopens, widens the offset by ν² first."""
    sensor, axis = rows.sensor[row], rows.axis[component]
    nu = met.innovation[component]
    R = noise(axes, sensors, rows, state, component, sensor)
    widened = nu * nu if abs(nu) > gate * met.innovation_sd[component] else 0.0
    if widened > 0.0:
        state.P[axis, axes.order[axis], axes.order[axis]] += widened
        _, S = predicted(axes, sensors, rows, state, component, sensor)
        met.innovation_sd[component] = math.sqrt(S)
    observation(axes, sensors, axis, sensor, state.work)
    joseph(state.P, axis, axes.states[axis], R, state.work)
    for i in range(axes.states[axis]):
        state.x[axis, i] += state.work[1, i] * nu
    state.fused[axis] = rows.valid[row]
    met.outcome[component] = _REACQUIRED if widened > 0.0 else _FUSED
    write_log(log, axis, rows.valid[row], component, R, widened, state.work)


@compiled
def write_output(
    axes: Axes, axis: int, x: FloatArray, P: FloatArray, at: int, v: float, outputs: Outputs, n: int
) -> None:
    """The estimate that a state is, as output ``n``."""
    o = axes.order[axis]
    outputs.position[axis, n] = x[at, 0] + x[at, o]
    outputs.position_sd[axis, n] = math.sqrt(max(P[at, 0, 0] + 2.0 * P[at, 0, o] + P[at, o, o], 0.0))
    outputs.velocity[axis, n] = velocity(axes, axis, x, at, v)
    own = math.sqrt(max(P[at, o - 1, o - 1], 0.0))
    outputs.velocity_sd[axis, n] = own if o == 2 else own * axes.constants[axis, 0]
    outputs.offset[axis, n] = x[at, o]
    outputs.offset_sd[axis, n] = math.sqrt(max(P[at, o, o], 0.0))


@compiled
def estimate(axes: Axes, state: State, log: Log, time: int, held: Held, outputs: Outputs, n: int) -> None:
    """Predict every axis to ``time`` [ns] beside the state, which itself goes on over what acts until then."""
    aside = len(axes.order)
    for axis in range(len(axes.order)):
        following, end = axes.first[axis] + state.entry[axis] + 1, axes.first[axis + 1]
        while following < end and axes.acting[following] <= time:
            following += 1
        if following - 1 >= axes.first[axis]:
            advance(axes, state, log, axis, axes.acting[following - 1])
        for i in range(axes.states[axis]):
            state.x[aside, i] = state.x[axis, i]
            for j in range(axes.states[axis]):
                state.P[aside, i, j] = state.P[axis, i, j]
        step(axes, axis, state.x, state.P, aside, time - state.clock[axis], state.entry[axis])
        v, _, _ = acting_now(axes, axis, state.entry[axis])
        if held.x.shape[1]:
            held.input[axis, n] = v
            for i in range(axes.states[axis]):
                held.x[axis, n, i] = state.x[aside, i]
                for j in range(axes.states[axis]):
                    held.P[axis, n, i, j] = state.P[aside, i, j]
        else:
            write_output(axes, axis, state.x, state.P, aside, v, outputs, n)


@compiled
def keep(state: State, kept: State, place: int) -> None:
    """Copy a state to ``place`` among many."""
    for axis in range(len(state.clock)):
        kept.clock[place, axis], kept.entry[place, axis] = state.clock[axis], state.entry[axis]
        kept.fused[place, axis] = state.fused[axis]
        for i in range(state.x.shape[1]):
            kept.x[place, axis, i] = state.x[axis, i]
            for j in range(state.x.shape[1]):
                kept.P[place, axis, i, j] = state.P[axis, i, j]
    for sensor in range(state.since.shape[0]):
        for part in range(state.since.shape[1]):
            kept.rejected[place, sensor, part] = state.rejected[sensor, part]
            kept.since[place, sensor, part] = state.since[sensor, part]


@compiled
def go_back(state: State, kept: State, place: int) -> None:
    """Undo everything since :func:`keep`."""
    for axis in range(len(state.clock)):
        state.clock[axis], state.entry[axis] = kept.clock[place, axis], kept.entry[place, axis]
        state.fused[axis] = kept.fused[place, axis]
        for i in range(state.x.shape[1]):
            state.x[axis, i] = kept.x[place, axis, i]
            for j in range(state.x.shape[1]):
                state.P[axis, i, j] = kept.P[place, axis, i, j]
    for sensor in range(state.since.shape[0]):
        for part in range(state.since.shape[1]):
            state.rejected[sensor, part] = kept.rejected[place, sensor, part]
            state.since[sensor, part] = kept.since[place, sensor, part]
