"""The compiled smoother: what all later measurements say of a state, carried backward as η and N.

The same algebra as :mod:`pumafuse.fusion.smoother`, which says where it comes from. Over an update
η ← η + N K ν + Hᵀ ν / R and N ← N + Hᵀ H / R; over an interval through its noise, one independent part at a time, and
then by Fᵀ.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import math

from ..arrays import FloatArray, IndexArray, TimeArray
from ..compiled import compiled
from ..model.closed import advance_first, advance_second
from .kernels import Axes, Held, Log, Met, Outputs, Sensors, joseph, observation, write_output

_NOTHING = 1e-15  # of a pivot, below which it is rounding


@compiled
def carry_back(
    axes: Axes,
    axis: int,
    states: int,
    eta: FloatArray,
    N: FloatArray,
    at: int,
    ns: int,
    q: float,
    d: float,
    work: FloatArray,
) -> None:
    """η[at] and N[at] over an interval, backward: through its noise, one independent part at a time, then by Fᵀ."""
    dt = ns / 1e9
    if axes.order[axis] == 1:
        lost, q11 = advance_first(axes.constants, axis, dt)
        pass_noise(eta, N, at, states, 0, math.sqrt(q * q11), 0.0, work)
        pass_noise(eta, N, at, states, 1, math.sqrt(d * dt), 0.0, work)
        kept = 1.0 + lost
        eta[at, 0] *= kept
        for j in range(1, states):
            N[at, 0, j] *= kept
            N[at, j, 0] = N[at, 0, j]
        N[at, 0, 0] *= kept * kept
        return
    f11, f12, f21, f22, q11, q12, q22 = advance_second(axes.constants, axis, dt)
    first = math.sqrt(q * q11)
    both = q * q12 / first if first > 0.0 else 0.0
    pass_noise(eta, N, at, states, 0, first, both, work)
    pass_noise(eta, N, at, states, 1, math.sqrt(max(q * q22 - both * both, 0.0)), 0.0, work)
    pass_noise(eta, N, at, states, 2, math.sqrt(d * dt), 0.0, work)
    a, b = eta[at, 0], eta[at, 1]
    eta[at, 0], eta[at, 1] = f11 * a + f21 * b, f12 * a + f22 * b
    a, b, c = N[at, 0, 0], N[at, 0, 1], N[at, 1, 1]
    u, w = f11 * a + f21 * b, f11 * b + f21 * c
    N[at, 0, 0] = u * f11 + w * f21
    N[at, 0, 1] = N[at, 1, 0] = u * f12 + w * f22
    N[at, 1, 1] = (f12 * a + f22 * b) * f12 + (f12 * b + f22 * c) * f22
    for j in range(2, states):
        a, b = N[at, 0, j], N[at, 1, j]
        N[at, 0, j] = N[at, j, 0] = f11 * a + f21 * b
        N[at, 1, j] = N[at, j, 1] = f12 * a + f22 * b


@compiled
def pass_noise(
    eta: FloatArray, N: FloatArray, at: int, states: int, enters: int, first: float, second: float, work: FloatArray
) -> None:
    """η[at] and N[at] through unit noise that enters state ``enters`` by ``first`` and the next one by ``second``."""
    if first == 0.0 and second == 0.0:
        return
    for i in range(states):
        work[0, i] = 0.0
    work[0, enters] = first
    told = first * eta[at, enters]
    if second != 0.0:
        work[0, enters + 1] = second
        told += second * eta[at, enters + 1]
    joseph(N, at, states, 1.0, work)
    for i in range(states):
        eta[at, i] -= work[1, i] * told


@compiled
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


@compiled
def smooth_output(
    axes: Axes,
    axis: int,
    n: int,
    held: Held,
    eta: FloatArray,
    N: FloatArray,
    at: int,
    work: FloatArray,
    L: FloatArray,
    outputs: Outputs,
) -> None:
    """P_s = (I + P N)⁻¹ P and x_s = x + P_s η, measurement by measurement: at once, wide priors would cancel in P_s η."""
    x, P, states = held.x[axis], held.P[axis], axes.states[axis]
    root(N, eta, at, states, L, work[3])
    for k in range(states):
        nu = L[states, k]
        for i in range(states):
            work[0, i] = L[i, k]
        joseph(P, n, states, 1.0, work)
        for i in range(states):
            x[n, i] += work[1, i] * nu
        for m in range(k + 1, states):
            for i in range(states):
                L[states, m] -= L[i, m] * work[1, i] * nu
    write_output(axes, axis, x, P, n, held.input[axis, n], outputs, n)


@compiled
def smooth_run(
    axes: Axes,
    sensors: Sensors,
    sensor_of: IndexArray,
    met: Met,
    log: Log,
    origin: int,
    times: TimeArray,
    held: Held,
    eta: FloatArray,
    N: FloatArray,
    work: FloatArray,
    L: FloatArray,
    outputs: Outputs,
) -> None:
    """Estimates that know every measurement: the filter's, with what all later ones say, carried backward as η and N.

    Over an update η ← η + N K ν + Hᵀ ν / R and N ← N + Hᵀ H / R. ``sensor_of`` is the sensor of each component; η (2,
    s), N (2, s, s), ``work`` (4, s) and L (s + 1, s) are room to compute in.
    """
    for axis in range(len(axes.order)):
        states, n = axes.states[axis], len(times) - 1
        for i in range(states):
            eta[0, i] = 0.0
            for j in range(states):
                N[0, i, j] = 0.0
        entry = log.first[axis] + log.used[axis] - 1
        while True:
            first = entry < log.first[axis]
            until = origin if first else log.time[entry]
            while n >= 0 and times[n] >= until:
                smooth_output(axes, axis, n, held, eta, N, 0, work, L, outputs)
                n -= 1
            if first:
                break
            if log.component[entry] < 0:
                start = log.time[entry - 1] if entry > log.first[axis] else origin
                q, d = log.noise[entry], log.drift[entry]
                while n >= 0 and times[n] > start:
                    for i in range(states):
                        eta[1, i] = eta[0, i]
                        for j in range(states):
                            N[1, i, j] = N[0, i, j]
                    carry_back(axes, axis, states, eta, N, 1, until - times[n], q, d, work)
                    smooth_output(axes, axis, n, held, eta, N, 1, work, L, outputs)
                    n -= 1
                carry_back(axes, axis, states, eta, N, 0, until - start, q, d, work)
            else:
                take_back(axes, sensors, axis, sensor_of[log.component[entry]], met, log, entry, eta, N, work)
            entry -= 1


@compiled
def take_back(
    axes: Axes,
    sensors: Sensors,
    axis: int,
    sensor: int,
    met: Met,
    log: Log,
    entry: int,
    eta: FloatArray,
    N: FloatArray,
    work: FloatArray,
) -> None:
    """η[0] and N[0] over an update, backward."""
    states = axes.states[axis]
    observation(axes, sensors, axis, sensor, work)
    nu, R = met.innovation[log.component[entry]], log.noise[entry]
    for i in range(states):
        for j in range(states):
            eta[0, i] += N[0, i, j] * log.gain[entry, j] * nu
        eta[0, i] += work[0, i] * nu / R
    for i in range(states):
        for j in range(states):
            N[0, i, j] += work[0, i] * work[0, j] / R
    if log.drift[entry] > 0.0:  # a gate that reacquired let the offset move
        pass_noise(eta, N, 0, states, axes.order[axis], math.sqrt(log.drift[entry]), 0.0, work)
