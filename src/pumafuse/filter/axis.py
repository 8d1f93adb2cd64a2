"""The algebra of one axis: predict, apply a command, innovation, update.

State of an axis, in this order: the plant's position [m] and rate [m/s] (0 for a first-order plant), the offset, and
the bias of each sensor that has one. Beside it what the commands have left: the input u and the gain error e, both
known, so that they move x and not P. All is relative to the start level at which the axis rested.

    x⁺ = u + Φ (x − u) + Γ_e e,   P⁺ = Φ P Φᵀ + Q,   var(offset)⁺ = var(offset) + drift² Δ,   e⁺ = e exp(−Δ / recovery)

Another block of states would have its place between offset and biases, and its transition in :func:`predict`.
Each axis is a row of the arrays, which change in place: a copy of them is a checkpoint. No fast-math: the same events
give the same bits.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

from typing import NamedTuple

from ..arrays import BoolArray, FloatArray, IntArray, TimeArray
from ..compiled import compiled, compiled_apart
from ..model.closed import decaying_response, gain_error, transition

POSITION, RATE, OFFSET, BIASES = range(4)  # of a state
START, U, STEP, ERROR, NOISE, DRIFT = range(6)  # of a drive
SLOPE, INTERCEPT, DECAY, PERIOD = range(4)  # of a gain
INPUT_NOISE, RANDOM_WALK, MANEUVER_NOISE, MANEUVER_DRIFT = range(4)  # of a process
_ROUNDING = 1e-15  # of the variances that S is made of: S cannot be known to be smaller


class Model(NamedTuple):
    """What is known of each of the A axes.

    Attributes:
        order: Of the plant, 1 or 2, (A,).
        constants: Of the plant, see :mod:`pumafuse.model.closed`, (A, c).
        states: How many of the state's entries are used, (A,).
        gain: ``SLOPE`` [s/m], ``INTERCEPT``, ``DECAY`` of its error [1/s] (0: none) and the ``PERIOD`` T [s], (A, 4).
        process: ``INPUT_NOISE`` [m/√Hz], ``RANDOM_WALK`` [m/√s], and what each m/s of maneuver adds to them, (A, 4).
    """

    order: IntArray
    constants: FloatArray
    states: IntArray
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
        bias: Which state is its bias on each axis, −1 for none, (S, A).
    """

    scale: FloatArray
    sd: FloatArray
    latency_sd: FloatArray
    gate: FloatArray
    gate_rows: BoolArray
    bias: IntArray


class State(NamedTuple):
    """All that changes, one row for each axis; further rows have room for predictions aside and for checkpoints.

    Attributes:
        x: Mean, (r, s).
        P: Covariance, (r, s, s).
        clock: The instant of x and P, int64 ns, (r,).
        drive: Start level u₀ (``START``, NaN before it is known), command in force ``U`` relative to it, its ``STEP``,
            the gain ``ERROR`` e now [m], and densities squared in force: ``NOISE`` [m²·s], ``DRIFT`` [m²/s], (r, 6).
        rejected: Of each sensor innovation and R of a rejected measurement that another may agree with, (r, S, 2).
        gate_time: When that one was valid, and when the last one was fused, int64 ns, (r, S, 2).
        gate_count: Rejections in a row, and re-acquisitions, (r, S, 2).
        unsettled: When sensors last disagreed while re-acquisitions were counted, int64 ns, ``ALWAYS`` for never, (r,).
        work: Room for the vectors of an update: H, K, P Hᵀ and (I − K H) P Hᵀ, (4, s).
    """

    x: FloatArray
    P: FloatArray
    clock: TimeArray
    drive: FloatArray
    rejected: FloatArray
    gate_time: TimeArray
    gate_count: IntArray
    unsettled: TimeArray
    work: FloatArray


@compiled
def predict(model: Model, state: State, axis: int, row: int, time: int) -> None:
    """Bring row ``row`` of the state, which is of ``axis``, to ``time`` [ns] with its input held."""
    if time <= state.clock[row]:
        return
    x, P, drive, dt = state.x, state.P, state.drive, (time - state.clock[row]) / 1e9
    f11, f12, f21, f22, q11, q12, q22 = transition(model.order[axis], model.constants, axis, dt)
    u, q = drive[row, U], drive[row, NOISE]
    gap, rate = x[row, POSITION] - u, x[row, RATE]
    x[row, POSITION] = u + (f11 * gap + f12 * rate)
    x[row, RATE] = f21 * gap + f22 * rate
    if drive[row, ERROR] != 0.0:
        decay = model.gain[axis, DECAY]
        position, rate, left = decaying_response(model.order[axis], model.constants, axis, decay, dt, f11, f12, f22)
        x[row, POSITION] += position * drive[row, ERROR]
        x[row, RATE] += rate * drive[row, ERROR]
        drive[row, ERROR] *= left
    a, b, c = P[row, 0, 0], P[row, 0, 1], P[row, 1, 1]
    d, e = f11 * a + f12 * b, f11 * b + f12 * c
    P[row, 0, 0] = d * f11 + e * f12 + q * q11
    P[row, 0, 1] = P[row, 1, 0] = d * f21 + e * f22 + q * q12
    P[row, 1, 1] = (f21 * a + f22 * b) * f21 + (f21 * b + f22 * c) * f22 + q * q22
    for j in range(OFFSET, model.states[axis]):
        a, b = P[row, 0, j], P[row, 1, j]
        P[row, 0, j] = P[row, j, 0] = f11 * a + f12 * b
        P[row, 1, j] = P[row, j, 1] = f21 * a + f22 * b
    P[row, OFFSET, OFFSET] += drive[row, DRIFT] * dt
    state.clock[row] = time


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
        if model.order[axis] == 1:  # ẋ = (u + e − x) / τ
            speed = model.constants[axis, 0] * (drive[axis, U] + drive[axis, ERROR] - x[axis, POSITION])
        R += (sensors.scale[sensor] * speed * sensors.latency_sd[sensor]) ** 2
    return R


@compiled
def innovation(sensors: Sensors, state: State, axis: int, sensor: int, z: float, R: float) -> tuple[float, float]:
    """ν = z − H x and S = H P Hᵀ + R of a measurement ``z`` [m] as logged, here and now."""
    x, P, scale, bias = state.x, state.P, sensors.scale[sensor], sensors.bias[sensor, axis]
    nu = z - scale * state.drive[axis, START] - scale * (x[axis, POSITION] + x[axis, OFFSET])
    own = scale * scale * (P[axis, POSITION, POSITION] + P[axis, OFFSET, OFFSET])
    S = own + 2.0 * scale * scale * P[axis, POSITION, OFFSET]
    if bias >= 0:
        nu -= x[axis, bias]
        S += 2.0 * scale * (P[axis, POSITION, bias] + P[axis, OFFSET, bias]) + P[axis, bias, bias]
        own += P[axis, bias, bias]
    return nu, max(S + R, R, _ROUNDING * own)


@compiled
def update(model: Model, sensors: Sensors, state: State, axis: int, sensor: int, nu: float, R: float) -> None:
    """x⁺ = x + K ν and P⁺ in Joseph form; H and K stay in ``work[0]`` and ``work[1]``."""
    observation(sensors, axis, sensor, model.states[axis], state.work)
    joseph(state.P, axis, model.states[axis], R, state.work)
    for i in range(model.states[axis]):
        state.x[axis, i] += state.work[1, i] * nu


@compiled
def observation(sensors: Sensors, axis: int, sensor: int, states: int, work: FloatArray) -> None:
    """H of a sensor on an axis, into ``work[0]``."""
    for i in range(states):
        work[0, i] = 0.0
    work[0, POSITION] = work[0, OFFSET] = sensors.scale[sensor]
    if sensors.bias[sensor, axis] >= 0:
        work[0, sensors.bias[sensor, axis]] = 1.0


@compiled
def joseph(P: FloatArray, at: int, states: int, R: float, work: FloatArray) -> None:
    """P⁺ = (I − K H) P (I − K H)ᵀ + K R Kᵀ with H in ``work[0]`` and K = P Hᵀ / (H P Hᵀ + R), left in ``work[1]``.

    The smoother uses it for its dual, too: information that passes through noise of unit variance along H. A state that
    H does not see and that shares nothing with the others changes no bit of theirs. A quotient is exactly 1 where a
    prior is all there is to S; a product with 1/S would leave a variance below 0.
    """
    S, own = R, 0.0
    for i in range(states):
        own += work[0, i] * work[0, i] * P[at, i, i]
        across = 0.0
        for j in range(states):
            across += P[at, i, j] * work[0, j]
        work[2, i] = across
        S += work[0, i] * across
    S = max(S, R, _ROUNDING * own)
    for i in range(states):
        work[1, i] = work[2, i] / S
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
    for i in range(states):  # rounding beside a prior 1e16 times as wide: known, as far as doubles go
        if P[at, i, i] < 0.0:
            for j in range(states):
                P[at, i, j] = P[at, j, i] = 0.0


@compiled
def position_of(state: State, row: int) -> tuple[float, float]:
    """Plant and offset together [m], relative to the start level, and their variance [m²]."""
    P = state.P
    variance = P[row, POSITION, POSITION] + 2.0 * P[row, POSITION, OFFSET] + P[row, OFFSET, OFFSET]
    return state.x[row, POSITION] + state.x[row, OFFSET], max(variance, 0.0)


@compiled
def variance_of_motion(model: Model, state: State, axis: int, row: int, dt: float) -> float:
    """Variance [m²] of the motion over ``dt`` [s] that the state leads to: h (Φ − I) P (Φ − I)ᵀ hᵀ; h makes p of it."""
    P = state.P
    f11, f12, _, _, _, _, _ = transition(model.order[axis], model.constants, axis, dt)
    a, b = f11 - 1.0, f12
    return a * a * P[row, POSITION, POSITION] + 2.0 * a * b * P[row, POSITION, RATE] + b * b * P[row, RATE, RATE]


@compiled
def copy_estimate(state: State, here: int, there: int) -> None:
    """Copy a row of the state to another, but for what the gate remembers."""
    state.clock[there] = state.clock[here]
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
