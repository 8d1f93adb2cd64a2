"""Where an axis goes when it is commanded, without noise: exact at any instant, compiled."""

# pyright: reportArgumentType=false, reportConstantRedefinition=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray, TimeArray
from ..compiled import kernel
from .arm import AxisModel
from .closed import constants, decaying_response, gain_error, transition
from .plants import FirstOrder

_ONLY = np.int64(0)  # row of constants: a literal would compile what the filter has compiled already


def response(
    axis: AxisModel, period: float, delay: float, given: TimeArray, command: FloatArray, start: float, time: TimeArray
) -> FloatArray:
    """The position of an axis that rests until its first command.

    Args:
        axis: Plant and gain.
        period: The update period T [s].
        delay: Td [s].
        given: When each command is given, int64 ns, ascending, (k,).
        command: u [m], (k,).
        start: The level u₀ [m] at which the axis rests.
        time: Asked for, int64 ns, ascending, (n,).

    Returns:
        The position [m] relative to ``start``, (n,).
    """
    found, gain = np.empty(len(time)), axis.gain
    order = 1 if isinstance(axis.plant, FirstOrder) else 2
    decay = 0.0 if axis.gain_recovery is None else 1.0 / axis.gain_recovery
    acting = given + round(delay * 1e9)
    known, by_gain = constants(axis.plant)[None], (gain.slope, gain.intercept, decay, period)
    _respond(order, known, by_gain, acting, command - start, time, found)
    return found


@kernel
def _respond(
    order: int,
    constants: FloatArray,
    by_gain: tuple[float, float, float, float],
    acting: TimeArray,
    command: FloatArray,
    time: TimeArray,
    found: FloatArray,
) -> None:
    slope, intercept, decay, period = by_gain
    at, u, error, position, rate = 0, 0.0, 0.0, 0.0, 0.0
    clock = min(time[0], acting[0]) if len(time) and len(acting) else 0
    for n in range(len(time)):
        while True:
            due = at < len(acting) and acting[at] <= time[n]
            until = acting[at] if due else time[n]
            if until > clock:
                dt, gap = (until - clock) * 1e-9, position - u
                f11, f12, f21, f22, _, _, _ = transition(order, constants, _ONLY, dt)
                a, b, left = decaying_response(order, constants, _ONLY, decay, dt, f11, f12, f22)
                position, rate = u + f11 * gap + f12 * rate + a * error, f21 * gap + f22 * rate + b * error
                error *= left
            clock = until
            if not due:
                break
            error += gain_error(command[at] - u, slope, intercept, period)
            u = command[at]
            at += 1
        found[n] = position
