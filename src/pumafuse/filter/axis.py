"""The algebra of one axis: predict, apply a command, innovation, update.

State of an axis, in this order: the plant's position [m] and rate [m/s] (0 for a first-order plant); the offset; the
disturbance d and, where it is smooth, its rate; of each sensor that has them a bias that drifts and one that is
constant. Beside it what the commands have left: the input u and the gain error e, both known, so that they move x and
not P. All is relative to the start level at which the axis rested.

    x⁺ = u + Φ (x − u) + Γ_e e,   P⁺ = Φ P Φᵀ + Q,   var(offset)⁺ = var(offset) + drift² Δ,   e⁺ = e exp(−Δ / recovery)
    d⁺ = Φ_d d (:mod:`pumafuse.model.matern`), or like a drifting bias: b⁺ = b exp(−Δ / time)

The whole position is p = plant + offset + d. Each axis is a row of the arrays, which change in place: a copy of them is
a checkpoint. No fast-math: the same events give the same bits.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray, TimeArray
from ..compiled import compiled, compiled_apart
from ..model.closed import decaying_response, gain_error, transition
from ..model.matern import matern

POSITION, RATE, OFFSET, REST = range(4)  # of a state; the disturbance, if there is one, is the first of the rest
ORDER, DISTURBANCE, STATES, ANSWERS = range(4)  # of a kind
NONE, ROUGH, SMOOTH = range(3)  # disturbances, by how many states they have
REVERTING, VARIANCE = range(2)  # of a state of the rest
START, U, STEP, ERROR, NOISE, DRIFT, DUE11, DUE12, DUE22, DUE_WALK = range(10)  # of a drive
SLOPE, INTERCEPT, DECAY, PERIOD = range(4)  # of a gain
INPUT_NOISE, RANDOM_WALK, MANEUVER_NOISE, MANEUVER_DRIFT = range(4)  # of a process
(
    LENGTH,
    F11,
    F12,
    F21,
    F22,
    Q11,
    Q12,
    Q22,
    ERROR_POSITION,
    ERROR_RATE,
    ERROR_LEFT,
    D11,
    D12,
    D21,
    D22,
    N11,
    N12,
    N22,
) = range(18)  # of what is known of an interval
FIRST_REST = 18 - 2 * REST  # of its numbers for each state of the rest
KEPT = 7  # intervals: a prime, or 5 and 10 ms would be in each other's place
POSITION_, REST_ = np.int64(POSITION), np.int64(REST)  # as arguments: a literal would compile what is called once more
_ROUNDING = 1e-15  # of the variances that S is made of: S cannot be known to be smaller


class Model(NamedTuple):
    """What is known of each of the A axes.

    Attributes:
        kind: ``ORDER`` of the plant, 1 or 2, ``DISTURBANCE``: ``NONE``, ``ROUGH`` (Ornstein-Uhlenbeck) or ``SMOOTH``
            (Matérn), how many ``STATES`` there are, and the first axis that ``ANSWERS`` as this one does: what they do
            in an interval is kept once, (A, 4).
        constants: Of the plant, see :mod:`pumafuse.model.closed`, (A, c).
        rest: How fast each of the state's entries reverts to 0 [1/s] and its stationary variance [m²]: λ and σ² of the
            disturbance; 0 and 0 of what is constant, (A, s, 2).
        gain: ``SLOPE`` [s/m], ``INTERCEPT``, ``DECAY`` of its error [1/s] (0: none) and the ``PERIOD`` T [s], (A, 4).
        process: ``INPUT_NOISE`` [m/√Hz], ``RANDOM_WALK`` [m/√s], and what each m/s of maneuver adds to them, (A, 4).
    """

    kind: IntArray
    constants: FloatArray
    rest: FloatArray
    gain: FloatArray
    process: FloatArray


class Sensors(NamedTuple):
    """What is known of each of the S sensors.

    Attributes:
        scale: Of the position in the measurement, (S,).
        sd: Noise on each axis [m], NaN where the sensor is not used, (S, A).
        latency_sd: How far the latency wanders [s], (S,).
        gate: In standard deviations, 0 for none, (S,).
        gate_rows: Whether one axis rejected rejects the row, (S,).
        bias: Which states are its drifting and its constant bias on each axis, −1 for none, (S, A, 2).
        turn: After which angle a measurement is the same again [rad], 0 for never, (S, A).
    """

    scale: FloatArray
    sd: FloatArray
    latency_sd: FloatArray
    gate: FloatArray
    gate_rows: BoolArray
    bias: IntArray
    turn: FloatArray


class State(NamedTuple):
    """All that changes, one row for each axis; further rows have room for predictions aside and for checkpoints.

    Attributes:
        x: Mean, (r, s).
        P: Covariance, (r, s, s).
        clock: The instant of the plant's mean and e, int64 ns, (r,).
        settled: The instant of P and of what no command moves: they may stay behind until a measurement, (r,).
        drive: Start level u₀ (``START``, NaN before it is known), command in force ``U`` relative to it, its ``STEP``,
            the gain ``ERROR`` e now [m], densities squared in force: ``NOISE`` [m²·s], ``DRIFT`` [m²/s], and what P is
            still due, as it stays behind: noise of the plant, ``DUE11`` to ``DUE22``, and ``DUE_WALK`` [m²], (r, 10).
        rejected: Of each sensor innovation and R of a rejected measurement that another may agree with, (r, S, 2).
        gate_time: When that one was valid, and when the last one was fused, int64 ns, (r, S, 2).
        gate_count: Rejections in a row, and re-acquisitions, (r, S, 2).
        unsettled: When sensors last disagreed while re-acquisitions were counted, int64 ns, ``ALWAYS`` for never, (r,).
        work: Room for the vectors of an update: H, K, P Hᵀ and (I − K H) P Hᵀ, (A, 4, s).
        intervals: What an axis does in an interval [ns], of the latest few: plant, gain error, disturbance and what
            reverts, in the row of the first axis that ``ANSWERS`` so, (A, ``KEPT``, 18 + 2 (s − 3)).
    """

    x: FloatArray
    P: FloatArray
    clock: TimeArray
    settled: TimeArray
    drive: FloatArray
    rejected: FloatArray
    gate_time: TimeArray
    gate_count: IntArray
    unsettled: TimeArray
    work: FloatArray
    intervals: FloatArray

    @property
    def by_row(self) -> tuple[np.ndarray, ...]:
        """The arrays that have a row for each axis and checkpoint."""
        return self[:-2]


@compiled
def predict_plant(model: Model, state: State, axis: int, row: int, time: int) -> None:
    """Bring the plant's mean and e to ``time`` [ns], with the input held, and note the noise until then.

    P and all that no command moves stay behind, until :func:`predict_rest`.
    """
    if time <= state.clock[row]:
        return
    x, drive, known, like = state.x, state.drive, state.intervals, model.kind[axis, ANSWERS]
    at = interval_of(model, known, like, time - state.clock[row])
    f11, f12, f21, f22 = known[like, at, F11], known[like, at, F12], known[like, at, F21], known[like, at, F22]
    u, error, rate = drive[row, U], drive[row, ERROR], x[row, RATE]
    gap = x[row, POSITION] - u
    x[row, POSITION], x[row, RATE] = u + (f11 * gap + f12 * rate), f21 * gap + f22 * rate
    if error != 0.0:
        x[row, POSITION] += known[like, at, ERROR_POSITION] * error
        x[row, RATE] += known[like, at, ERROR_RATE] * error
        drive[row, ERROR] = error * known[like, at, ERROR_LEFT]
    a, b, c, q = drive[row, DUE11], drive[row, DUE12], drive[row, DUE22], drive[row, NOISE]
    d, e = f11 * a + f12 * b, f11 * b + f12 * c
    drive[row, DUE11] = d * f11 + e * f12 + q * known[like, at, Q11]
    drive[row, DUE12] = d * f21 + e * f22 + q * known[like, at, Q12]
    drive[row, DUE22] = (f21 * a + f22 * b) * f21 + (f21 * b + f22 * c) * f22 + q * known[like, at, Q22]
    drive[row, DUE_WALK] += drive[row, DRIFT] * ((time - state.clock[row]) / 1e9)
    state.clock[row] = time


@compiled
def predict_rest(model: Model, state: State, axis: int, row: int) -> None:
    """Bring P and what no command moves to where the plant's mean is."""
    if state.settled[row] == state.clock[row]:
        return
    P, drive, known, like = state.P, state.drive, state.intervals, model.kind[axis, ANSWERS]
    at, size = interval_of(model, known, like, state.clock[row] - state.settled[row]), model.kind[axis, STATES]
    f11, f12, f21, f22 = known[like, at, F11], known[like, at, F12], known[like, at, F21], known[like, at, F22]
    move_pair(P, row, POSITION_, size, f11, f12, f21, f22)
    add_to_pair(P, row, POSITION_, drive[row, DUE11], drive[row, DUE12], drive[row, DUE22])
    P[row, OFFSET, OFFSET] += drive[row, DUE_WALK]
    drive[row, DUE11] = drive[row, DUE12] = drive[row, DUE22] = drive[row, DUE_WALK] = 0.0
    if size > REST:
        revert(model, state, axis, row, like, at)
    state.settled[row] = state.clock[row]


@compiled
def interval_of(model: Model, known: FloatArray, like: int, interval: int) -> int:
    """Where what an axis does in an interval [ns] is kept; ``like`` is the first that answers so."""
    at = interval % KEPT
    if known[like, at, LENGTH] != interval:
        respond(model, known, like, at, interval)
    return at


@compiled_apart
def respond(model: Model, known: FloatArray, axis: int, at: int, interval: int) -> None:
    """Compute what an axis does in an interval [ns]: the same few come again and again."""
    dt, order = interval / 1e9, model.kind[axis, ORDER]
    known[axis, at, LENGTH] = interval
    f11, f12, f21, f22, q11, q12, q22 = transition(order, model.constants, axis, dt)
    known[axis, at, F11], known[axis, at, F12], known[axis, at, F21], known[axis, at, F22] = f11, f12, f21, f22
    known[axis, at, Q11], known[axis, at, Q12], known[axis, at, Q22] = q11, q12, q22
    if model.gain[axis, SLOPE] != 0.0 or model.gain[axis, INTERCEPT] != 1.0:
        position, rate, left = decaying_response(
            order, model.constants, axis, model.gain[axis, DECAY], dt, f11, f12, f22
        )
        known[axis, at, ERROR_POSITION], known[axis, at, ERROR_RATE], known[axis, at, ERROR_LEFT] = position, rate, left
    for i in range(REST, model.kind[axis, STATES]):
        fading = -model.rest[axis, i, REVERTING] * dt
        known[axis, at, FIRST_REST + 2 * i] = math.exp(fading)
        known[axis, at, FIRST_REST + 2 * i + 1] = math.expm1(2.0 * fading)
    if model.kind[axis, DISTURBANCE] == SMOOTH:
        f11, f12, f21, f22, q11, q12, q22 = matern(model.rest[axis, REST, REVERTING], dt)
        known[axis, at, D11], known[axis, at, D12], known[axis, at, D21], known[axis, at, D22] = f11, f12, f21, f22
        known[axis, at, N11], known[axis, at, N12], known[axis, at, N22] = q11, q12, q22


@compiled_apart
def revert(model: Model, state: State, axis: int, row: int, like: int, at: int) -> None:
    """Bring disturbance and drifting biases an interval on: they revert to 0; what they lose comes back as noise."""
    x, P, size, first, known = state.x, state.P, model.kind[axis, STATES], REST, state.intervals
    if model.kind[axis, DISTURBANCE] == SMOOTH:
        variance = model.rest[axis, REST, VARIANCE]
        f11, f12, f21, f22 = known[like, at, D11], known[like, at, D12], known[like, at, D21], known[like, at, D22]
        d, rate = x[row, REST], x[row, REST + 1]
        x[row, REST], x[row, REST + 1] = f11 * d + f12 * rate, f21 * d + f22 * rate
        move_pair(P, row, REST_, size, f11, f12, f21, f22)
        q11, q12, q22 = known[like, at, N11], known[like, at, N12], known[like, at, N22]
        add_to_pair(P, row, REST_, variance * q11, variance * q12, variance * q22)
        first = REST + 2
    for i in range(first, size):
        if model.rest[axis, i, REVERTING] > 0.0:
            left = known[like, at, FIRST_REST + 2 * i]
            x[row, i] *= left
            for j in range(size):
                P[row, i, j] *= left
                P[row, j, i] *= left
            P[row, i, i] -= model.rest[axis, i, VARIANCE] * known[like, at, FIRST_REST + 2 * i + 1]


@compiled
def move_pair(M: FloatArray, at: int, i: int, size: int, f11: float, f12: float, f21: float, f22: float) -> None:
    """M⁺ = F M Fᵀ where F moves the states ``i`` and ``i + 1`` of ``size``."""
    k = i + 1
    a, b, c = M[at, i, i], M[at, i, k], M[at, k, k]
    d, e = f11 * a + f12 * b, f11 * b + f12 * c
    M[at, i, i] = d * f11 + e * f12
    M[at, i, k] = M[at, k, i] = d * f21 + e * f22
    M[at, k, k] = (f21 * a + f22 * b) * f21 + (f21 * b + f22 * c) * f22
    for j in range(size):
        if j < i or j > k:
            a, b = M[at, i, j], M[at, k, j]
            M[at, i, j] = M[at, j, i] = f11 * a + f12 * b
            M[at, k, j] = M[at, j, k] = f21 * a + f22 * b


@compiled
def add_to_pair(P: FloatArray, at: int, i: int, q11: float, q12: float, q22: float) -> None:
    """P⁺ = P + Q where Q is of the states ``i`` and ``i + 1``."""
    P[at, i, i] += q11
    P[at, i, i + 1] += q12
    P[at, i + 1, i] += q12
    P[at, i + 1, i + 1] += q22


@compiled
def apply_command(model: Model, state: State, axis: int, row: int, command: float) -> None:
    """From now on u is ``command`` [m] as logged; e jumps by (K(speed) − 1) · step, noise follows the maneuver."""
    drive, gain, process = state.drive, model.gain, model.process
    u = command - drive[row, START]
    step = u - drive[row, U]
    maneuver = abs(step - drive[row, STEP]) / gain[axis, PERIOD]
    drive[row, ERROR] += gain_error(step, gain[axis, SLOPE], gain[axis, INTERCEPT], gain[axis, PERIOD])
    drive[row, U], drive[row, STEP] = u, step
    noise, drift = process[axis, MANEUVER_NOISE] * maneuver, process[axis, MANEUVER_DRIFT] * maneuver
    drive[row, NOISE] = process[axis, INPUT_NOISE] * process[axis, INPUT_NOISE] + noise * noise
    drive[row, DRIFT] = process[axis, RANDOM_WALK] * process[axis, RANDOM_WALK] + drift * drift


@compiled
def noise(model: Model, sensors: Sensors, state: State, axis: int, sensor: int, spread: float) -> float:
    """R = (spread · sd)² + (scale · speed · latency_sd)² [m²] here and now: larger where latency wanders."""
    sd = sensors.sd[sensor, axis] * spread
    R = sd * sd
    if sensors.latency_sd[sensor] > 0.0:
        x, drive = state.x, state.drive
        speed = x[axis, RATE]
        if model.kind[axis, ORDER] == 1:  # ẋ = (u + e − x) / τ
            speed = model.constants[axis, 0] * (drive[axis, U] + drive[axis, ERROR] - x[axis, POSITION])
        if model.kind[axis, DISTURBANCE] == SMOOTH:
            speed += x[axis, REST + 1]
        R += (sensors.scale[sensor] * speed * sensors.latency_sd[sensor]) ** 2
    return R


@compiled_apart
def innovation(
    model: Model, sensors: Sensors, state: State, axis: int, sensor: int, z: float, R: float
) -> tuple[float, float]:
    """ν = z − H x and S = H P Hᵀ + R of a measurement ``z`` [m] as logged, here and now; H stays in ``work``.

    An angle that is measured within a turn is the nearest of all turns.
    """
    work, scale, states = state.work, sensors.scale[sensor], model.kind[axis, STATES]
    observation(model, sensors, axis, sensor, work, axis)
    nu = z - scale * state.drive[axis, START]
    for i in range(states):
        nu -= work[axis, 0, i] * state.x[axis, i]
    nu = nearest(nu, sensors.turn[sensor, axis])
    return nu, variance_along(state.P, axis, states, R, work, axis)


@compiled
def nearest(difference: float, turn: float) -> float:
    """A difference of measurements, less the whole turns in it; ``turn`` 0: as it is."""
    return difference - turn * math.floor(difference / turn + 0.5) if turn > 0.0 else difference


@compiled
def observation(model: Model, sensors: Sensors, axis: int, sensor: int, work: FloatArray, at: int) -> None:
    """H of a sensor on an axis, into ``work[at, 0]``."""
    for i in range(model.kind[axis, STATES]):
        work[at, 0, i] = 0.0
    work[at, 0, POSITION] = work[at, 0, OFFSET] = sensors.scale[sensor]
    if model.kind[axis, DISTURBANCE] != NONE:
        work[at, 0, REST] = sensors.scale[sensor]
    for k in range(2):
        if sensors.bias[sensor, axis, k] >= 0:
            work[at, 0, sensors.bias[sensor, axis, k]] = 1.0


@compiled
def variance_along(P: FloatArray, row: int, states: int, R: float, work: FloatArray, at: int) -> float:
    """S = H P Hᵀ + R with H in ``work[at, 0]``; P Hᵀ and S stay in ``work[at, 2]`` and ``work[at, 3, 0]``."""
    S, own = R, 0.0
    for i in range(states):
        own += work[at, 0, i] * work[at, 0, i] * P[row, i, i]
        across = 0.0
        for j in range(states):
            across += P[row, i, j] * work[at, 0, j]
        work[at, 2, i] = across
        S += work[at, 0, i] * across
    work[at, 3, 0] = max(S, R, _ROUNDING * own)
    return work[at, 3, 0]


@compiled_apart
def update(model: Model, state: State, axis: int, nu: float, R: float) -> None:
    """x⁺ = x + K ν and P⁺ in Joseph form, right after :func:`innovation`; K stays in ``work``."""
    joseph(state.P, axis, model.kind[axis, STATES], R, state.work, axis)
    for i in range(model.kind[axis, STATES]):
        state.x[axis, i] += state.work[axis, 1, i] * nu


@compiled
def joseph(P: FloatArray, row: int, states: int, R: float, work: FloatArray, at: int) -> None:
    """P⁺ = (I − K H) P (I − K H)ᵀ + K R Kᵀ right after :func:`variance_along`; K = P Hᵀ / S stays in ``work[at, 1]``.

    The smoother uses it for its dual, too: information that passes through noise of unit variance along H. A state that
    H does not see and that shares nothing with the others changes no bit of theirs. A quotient is exactly 1 where a
    prior is all there is to S; a product with 1/S would leave a variance below 0.
    """
    S = work[at, 3, 0]
    for i in range(states):
        work[at, 1, i] = work[at, 2, i] / S
    for i in range(states):  # W = (I − K H) P and W Hᵀ
        across = 0.0
        for j in range(states):
            P[row, i, j] -= work[at, 1, i] * work[at, 2, j]
            across += P[row, i, j] * work[at, 0, j]
        work[at, 3, i] = across
    for i in range(states):  # W − W Hᵀ Kᵀ + K R Kᵀ; the last apart, or beside a wide prior it would be rounded away
        for j in range(i + 1):
            left = P[row, i, j] - work[at, 3, i] * work[at, 1, j] + P[row, j, i] - work[at, 3, j] * work[at, 1, i]
            P[row, i, j] = P[row, j, i] = 0.5 * left + work[at, 1, i] * R * work[at, 1, j]
    for i in range(states):  # rounding beside a prior 1e16 times as wide: known, as far as doubles go
        if P[row, i, i] < 0.0:
            for j in range(states):
                P[row, i, j] = P[row, j, i] = 0.0


@compiled
def position_of(disturbance: int, x: FloatArray, P: FloatArray, row: int) -> tuple[float, float]:
    """Plant, offset and disturbance together [m], relative to the start level, and their variance [m²]."""
    position = x[row, POSITION] + x[row, OFFSET]
    variance = P[row, POSITION, POSITION] + 2.0 * P[row, POSITION, OFFSET] + P[row, OFFSET, OFFSET]
    if disturbance != NONE:
        position += x[row, REST]
        variance += 2.0 * (P[row, POSITION, REST] + P[row, OFFSET, REST]) + P[row, REST, REST]
    return position, max(variance, 0.0)


@compiled_apart
def variance_of_motion(model: Model, state: State, axis: int, row: int, dt: float) -> float:
    """Variance [m²] of the motion over ``dt`` [s] that the state leads to: h (Φ − I) P (Φ − I)ᵀ hᵀ; h makes p of it."""
    P, work = state.P, state.work
    f11, f12, _, _, _, _, _ = transition(model.kind[axis, ORDER], model.constants, axis, dt)
    a, b = f11 - 1.0, f12
    if model.kind[axis, DISTURBANCE] == NONE:
        own = a * a * P[row, POSITION, POSITION] + 2.0 * a * b * P[row, POSITION, RATE] + b * b * P[row, RATE, RATE]
        return max(own, 0.0)
    for i in range(model.kind[axis, STATES]):
        work[axis, 0, i] = 0.0
    work[axis, 0, POSITION], work[axis, 0, RATE] = a, b
    if model.kind[axis, DISTURBANCE] == ROUGH:
        work[axis, 0, REST] = math.expm1(-model.rest[axis, REST, REVERTING] * dt)
    elif model.kind[axis, DISTURBANCE] == SMOOTH:
        f11, f12, _, _, _, _, _ = matern(model.rest[axis, REST, REVERTING], dt)
        work[axis, 0, REST], work[axis, 0, REST + 1] = f11 - 1.0, f12
    return variance_along(state.P, row, model.kind[axis, STATES], 0.0, work, axis)


@compiled_apart
def noise_of_motion(model: Model, state: State, axis: int, dt: float) -> float:
    """Variance [m²] of the motion over ``dt`` [s] that comes from noise on the way: h Q hᵀ."""
    _, _, _, _, q11, _, _ = transition(model.kind[axis, ORDER], model.constants, axis, dt)
    noise = state.drive[axis, NOISE] * q11 + state.drive[axis, DRIFT] * dt
    if model.kind[axis, DISTURBANCE] == ROUGH:
        noise -= model.rest[axis, REST, VARIANCE] * math.expm1(-2.0 * model.rest[axis, REST, REVERTING] * dt)
    elif model.kind[axis, DISTURBANCE] == SMOOTH:
        _, _, _, _, q11, _, _ = matern(model.rest[axis, REST, REVERTING], dt)
        noise += model.rest[axis, REST, VARIANCE] * q11
    return noise


@compiled
def copy_estimate(state: State, here: int, there: int) -> None:
    """Copy a row of the state to another, but for what the gate remembers."""
    state.clock[there], state.settled[there] = state.clock[here], state.settled[here]
    for k in range(state.drive.shape[1]):
        state.drive[there, k] = state.drive[here, k]
    for i in range(state.x.shape[1]):
        state.x[there, i] = state.x[here, i]
        for j in range(state.x.shape[1]):
            state.P[there, i, j] = state.P[here, i, j]


@compiled_apart
def copy_rows(state: State, here: int, there: int, count: int) -> None:
    """Copy rows of the state to others."""
    for row in range(count):
        a, b = here + row, there + row
        copy_estimate(state, a, b)
        state.unsettled[b] = state.unsettled[a]
        for sensor in range(state.rejected.shape[1]):
            for k in range(2):
                state.rejected[b, sensor, k] = state.rejected[a, sensor, k]
                state.gate_time[b, sensor, k] = state.gate_time[a, sensor, k]
                state.gate_count[b, sensor, k] = state.gate_count[a, sensor, k]
