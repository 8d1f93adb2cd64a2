"""The smoother: what all later measurements say of a state, carried backward over the history as information.

In the deviation δ from the filter's own mean the inputs cancel, and the later measurements' likelihood is
exp(−½ δᵀ N δ + ηᵀ δ). From the last event backward, N = 0 and η = 0 at first:

    over an interval   η ← Fᵀ (I + N Q)⁻¹ η,            N ← Fᵀ (I + N Q)⁻¹ N F
    over an update     η ← η + N K ν + Hᵀ ν / R,        N ← N + Hᵀ H / R

and with the filter's covariance P the smoothed state is x + P_s η with P_s = (I + P N)⁻¹ P. No covariance is inverted
(the predicted one is singular: some states are known), and nothing is subtracted, as P − P Λ P would be in the
equivalent Bryson-Frazier form: with a wide prior that difference loses the error bars altogether. Each product with an
inverse is a row of Joseph-form updates: noise enters N as measurements enter P.
(Fraser & Potter, "The optimum linear smoother as a combination of two optimum linear filters", IEEE Trans. AC 14(4),
1969.)
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import math

import numpy as np

from ..arrays import FloatArray, TimeArray
from ..compiled import compiled, compiled_apart, inlined, kernel
from ..model.closed import transition
from ..model.matern import matern
from .axis import (
    DISTURBANCE,
    OFFSET,
    ORDER,
    POSITION_,
    REST,
    REST_,
    REVERTING,
    SMOOTH,
    STATES,
    VARIANCE,
    Model,
    Sensors,
    joseph,
    move_pair,
    observation,
    variance_along,
)
from .events import Events, Results
from .forward import INTERVAL, ONE, ZERO, History, write_outputs

OFFSET_ = np.int64(OFFSET)  # as an argument: see forward.ZERO
_NOTHING = 1e-15  # of a pivot, below which it is rounding


@kernel
def smooth(
    model: Model,
    sensors: Sensors,
    events: Events,
    results: Results,
    history: History,
    origin: int,
    times: TimeArray,
    room: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    outputs: FloatArray,
) -> None:
    """Replace filtered estimates by those that know every measurement.

    Args:
        model: The axes.
        sensors: The sensors.
        events: What the filter was given.
        results: Its innovations.
        history: What it did, with the states at ``times``.
        origin: Where it began, int64 ns.
        times: Of the estimates, int64 ns, ascending.
        room: η (2, s), N (2, s, s), vectors (1, 4, s) and a factor (s + 1, s) to compute in.
        outputs: Gets the estimates.
    """
    eta, N, work, factor = room
    for axis in range(len(model.kind)):
        states, n = model.kind[axis, STATES], len(times) - 1
        for i in range(states):
            eta[0, i] = 0.0
            for j in range(states):
                N[0, i, j] = 0.0
        entry = history.first[axis] + history.used[axis] - 1
        until = history.time[entry] if entry >= history.first[axis] else origin
        while n >= 0 and times[n] >= until:  # nothing later is known: the filter's estimate
            n -= 1
        while entry >= history.first[axis]:
            until = history.time[entry]
            start = history.time[entry - 1] if entry > history.first[axis] else origin
            if history.row[entry] == INTERVAL:
                q, d = history.noise[entry], history.drift[entry]
                while True:
                    asked = n >= 0 and times[n] >= start  # for an estimate, aside, before the interval is over
                    here, at = (times[n], ONE) if asked else (start, ZERO)
                    if asked:
                        for i in range(states):
                            eta[1, i] = eta[0, i]
                            for j in range(states):
                                N[1, i, j] = N[0, i, j]
                    over_interval(model, axis, eta, N, at, until - here, q, d, work)
                    if not asked:
                        break
                    smoothed_estimate(model, axis, n, history, eta, N, ONE, work, factor, outputs)
                    n -= 1
            else:
                over_update(model, sensors, events, results, history, axis, entry, eta, N, work)
            entry -= 1


@inlined
def over_update(
    model: Model,
    sensors: Sensors,
    events: Events,
    results: Results,
    history: History,
    axis: int,
    entry: int,
    eta: FloatArray,
    N: FloatArray,
    work: FloatArray,
) -> None:
    """η[0] and N[0] over an update, backward."""
    states, row = model.kind[axis, STATES], history.row[entry]
    observation(model, sensors, axis, events.source[row], work, ZERO)
    nu, R = results.innovation[row, axis], history.noise[entry]
    for i in range(states):
        for j in range(states):
            eta[0, i] += N[0, i, j] * history.gain[entry, j] * nu
        eta[0, i] += work[0, 0, i] * nu / R
    for i in range(states):
        for j in range(states):
            N[0, i, j] += work[0, 0, i] * work[0, 0, j] / R
    through_noise(eta, N, ZERO, states, OFFSET_, math.sqrt(history.drift[entry]), 0.0, work)  # what re-acquiring added


@inlined
def over_interval(
    model: Model, axis: int, eta: FloatArray, N: FloatArray, at: int, ns: int, q: float, d: float, work: FloatArray
) -> None:
    """η[at] and N[at] over an interval, backward: through its noise, one independent part at a time, then by Fᵀ."""
    dt, states, first = ns / 1e9, model.kind[axis, STATES], REST
    f11, f12, f21, f22, q11, q12, q22 = transition(model.kind[axis, ORDER], model.constants, axis, dt)
    pair_through_noise(eta, N, at, states, POSITION_, q * q11, q * q12, q * q22, work)
    through_noise(eta, N, at, states, OFFSET_, math.sqrt(d * dt), 0.0, work)
    move_back(eta, N, at, states, POSITION_, f11, f12, f21, f22)
    if model.kind[axis, DISTURBANCE] == SMOOTH:
        variance = model.rest[axis, REST, VARIANCE]
        f11, f12, f21, f22, q11, q12, q22 = matern(model.rest[axis, REST, REVERTING], dt)
        pair_through_noise(eta, N, at, states, REST_, variance * q11, variance * q12, variance * q22, work)
        move_back(eta, N, at, states, REST_, f11, f12, f21, f22)
        first = REST + 2
    for i in range(first, states):
        if model.rest[axis, i, REVERTING] > 0.0:
            fading = -model.rest[axis, i, REVERTING] * dt
            noise = math.sqrt(-model.rest[axis, i, VARIANCE] * math.expm1(2.0 * fading))
            through_noise(eta, N, at, states, i, noise, 0.0, work)
            eta[at, i] *= math.exp(fading)
            for j in range(states):
                N[at, i, j] *= math.exp(fading)
                N[at, j, i] *= math.exp(fading)


@compiled
def move_back(
    eta: FloatArray, N: FloatArray, at: int, states: int, i: int, f11: float, f12: float, f21: float, f22: float
) -> None:
    """η ← Fᵀ η and N ← Fᵀ N F where F moves the states ``i`` and ``i + 1``."""
    a, b = eta[at, i], eta[at, i + 1]
    eta[at, i], eta[at, i + 1] = f11 * a + f21 * b, f12 * a + f22 * b
    move_pair(N, at, i, states, f11, f21, f12, f22)


@compiled
def pair_through_noise(
    eta: FloatArray, N: FloatArray, at: int, states: int, i: int, q11: float, q12: float, q22: float, work: FloatArray
) -> None:
    """η[at] and N[at] through the noise of the states ``i`` and ``i + 1``, as two independent parts."""
    first = math.sqrt(q11)
    both = q12 / first if first > 0.0 else 0.0
    through_noise(eta, N, at, states, i, first, both, work)
    through_noise(eta, N, at, states, i + 1, math.sqrt(max(q22 - both * both, 0.0)), 0.0, work)


@compiled_apart
def through_noise(
    eta: FloatArray, N: FloatArray, at: int, states: int, enters: int, first: float, second: float, work: FloatArray
) -> None:
    """η[at] and N[at] through unit noise that enters state ``enters`` by ``first`` and the next one by ``second``."""
    if first == 0.0 and second == 0.0:
        return
    for i in range(states):
        work[0, 0, i] = 0.0
    work[0, 0, enters] = first
    seen = first * eta[at, enters]
    if second != 0.0:
        work[0, 0, enters + 1] = second
        seen += second * eta[at, enters + 1]
    variance_along(N, at, states, 1.0, work, ZERO)
    joseph(N, at, states, 1.0, work, ZERO)
    for i in range(states):
        eta[at, i] -= work[0, 1, i] * seen


@inlined
def smoothed_estimate(
    model: Model,
    axis: int,
    n: int,
    history: History,
    eta: FloatArray,
    N: FloatArray,
    at: int,
    work: FloatArray,
    L: FloatArray,
    outputs: FloatArray,
) -> None:
    """P_s = (I + P N)⁻¹ P and x_s = x + P_s η, one column of N = L Lᵀ at a time: wide priors would cancel in P_s η."""
    x, P, states = history.x[axis], history.P[axis], model.kind[axis, STATES]
    root(N, eta, at, states, L, work[0, 3])
    for k in range(states):
        nu = L[states, k]
        for i in range(states):
            work[0, 0, i] = L[i, k]
        variance_along(P, n, states, 1.0, work, ZERO)
        joseph(P, n, states, 1.0, work, ZERO)
        for i in range(states):
            x[n, i] += work[0, 1, i] * nu
        for m in range(k + 1, states):
            for i in range(states):
                L[states, m] -= L[i, m] * work[0, 1, i] * nu
    write_outputs(model.kind[axis, DISTURBANCE], x, P, n, outputs, axis, n)


@inlined
def root(N: FloatArray, eta: FloatArray, at: int, states: int, L: FloatArray, left: FloatArray) -> None:
    """N[at] = L Lᵀ and η[at] = L y: as columns, measurements with unit noise; y is the last row of L (s + 1, s).

    The state with the largest share of its own information left comes first: N says nothing of some states, or of
    their differences, and in another order a pivot of rounding would be divided by. ``left`` (s,) is room for what is
    left of the diagonal.
    """
    for k in range(states):
        left[k] = N[at, k, k]
        for i in range(states + 1):
            L[i, k] = 0.0
    for k in range(states):
        pivot, most = -1, _NOTHING
        for i in range(states):
            if left[i] > most * N[at, i, i]:
                pivot, most = i, left[i] / N[at, i, i]
        if pivot < 0:
            return
        L[pivot, k] = math.sqrt(left[pivot])
        left[pivot] = 0.0
        rest = eta[at, pivot]
        for m in range(k):
            rest -= L[states, m] * L[pivot, m]
        L[states, k] = rest / L[pivot, k]
        for i in range(states):
            if left[i] > 0.0:
                rest = N[at, i, pivot]
                for m in range(k):
                    rest -= L[i, m] * L[pivot, m]
                L[i, k] = rest / L[pivot, k]
                left[i] -= L[i, k] * L[i, k]
