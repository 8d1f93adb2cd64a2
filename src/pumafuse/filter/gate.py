"""Which measurements are believed: the gate, and what lifts it.

A measurement with |ν| > gate · √S is rejected. Outliers are independent, a wrong model persists: when two rejected
measurements of one sensor, at least T apart and none fused between, agree with each other, the second is believed and
ν² is added to the offset's variance (it re-acquires). But not where another sensor was fused on the same axis within
the last 0.5 s and has not re-acquired more often: then one of the two is wrong, it cannot be known which, and what
was believed goes on to be. Re-acquisitions are forgotten when all sensors of the axis agreed for 5 s.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false

from __future__ import annotations

import math

from ..arrays import ALWAYS
from ..compiled import compiled
from .axis import OFFSET, PERIOD, Model, Sensors, State, nearest, noise_of_motion, variance_of_motion

NU, R_THEN = range(2)  # of State.rejected
REJECTED_AT, FUSED_AT = range(2)  # of State.gate_time
IN_A_ROW, REACQUIRED = range(2)  # of State.gate_count
RECENT_NS = 500_000_000  # a sensor fused within this time stands for what is believed
SETTLED_NS = 5_000_000_000  # all sensors in agreement for so long: re-acquisitions before are forgotten
NOBODY = -1


@compiled
def agrees(model: Model, sensors: Sensors, state: State, axis: int, sensor: int, nu: float, R: float, time: int) -> int:
    """Whether a rejected measurement agrees with the one before: 1, or 0, or −1 if that is less than T ago.

    |ν₂ − ν₁| ≤ gate · √(R₁ + R₂ + the variance of the motion between), both predicted from an estimate that did not
    follow them.
    """
    if state.gate_count[axis, sensor, IN_A_ROW] == 0:
        return 0
    between = time - state.gate_time[axis, sensor, REJECTED_AT]
    if between < model.gain[axis, PERIOD] * 1e9:
        return -1
    dt, scale = between / 1e9, sensors.scale[sensor]
    motion = variance_of_motion(model, state, axis, axis, dt) + noise_of_motion(model, state, axis, dt)
    variance = state.rejected[axis, sensor, R_THEN] + R + scale * scale * motion
    apart = nearest(nu - state.rejected[axis, sensor, NU], sensors.turn[sensor, axis])
    return int(abs(apart) <= sensors.gate[sensor] * math.sqrt(variance))


@compiled
def contradicted(sensors: Sensors, state: State, axis: int, sensor: int, time: int) -> int:
    """The sensor that stands for what is believed on an axis and contradicts ``sensor``; ``NOBODY`` for none."""
    for other in range(len(sensors.scale)):
        fused = state.gate_time[axis, other, FUSED_AT]
        recently = fused > ALWAYS and time - fused <= RECENT_NS
        more_often = state.gate_count[axis, other, REACQUIRED] > state.gate_count[axis, sensor, REACQUIRED]
        if other != sensor and recently and not more_often:
            return other
    return NOBODY


@compiled
def count_rejected(state: State, axis: int, sensor: int, nu: float, R: float, time: int, again: bool) -> None:
    """Remember a rejected measurement; ``again`` if it comes less than T after the one that is remembered."""
    if not again or state.gate_count[axis, sensor, IN_A_ROW] == 0:
        state.rejected[axis, sensor, NU], state.rejected[axis, sensor, R_THEN] = nu, R
        state.gate_time[axis, sensor, REJECTED_AT] = time
    state.gate_count[axis, sensor, IN_A_ROW] += 1
    if state.gate_count[axis, sensor, IN_A_ROW] > 1 and state.unsettled[axis] > ALWAYS:
        state.unsettled[axis] = time


@compiled
def count_reacquired(state: State, axis: int, sensor: int, widened: float, time: int) -> None:
    """The offset may have moved by ν: its variance is ``widened`` by ν² / scale² [m²]."""
    state.P[axis, OFFSET, OFFSET] += widened
    state.gate_count[axis, sensor, REACQUIRED] += 1
    state.unsettled[axis] = time


@compiled
def count_fused(state: State, axis: int, sensor: int, time: int) -> None:
    """Forget what was rejected before; and re-acquisitions, once all sensors of the axis have agreed for long."""
    state.gate_count[axis, sensor, IN_A_ROW] = 0
    state.gate_time[axis, sensor, FUSED_AT] = time
    if state.unsettled[axis] == ALWAYS or time - state.unsettled[axis] < SETTLED_NS:
        return
    for other in range(state.gate_time.shape[1]):
        fused = state.gate_time[axis, other, FUSED_AT]
        if fused > ALWAYS and time - fused > SETTLED_NS:
            return
    state.unsettled[axis] = ALWAYS
    for other in range(state.gate_time.shape[1]):
        state.gate_count[axis, other, REACQUIRED] = 0
