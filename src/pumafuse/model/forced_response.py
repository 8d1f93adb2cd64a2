"""Where a plant goes when its input steps, without noise: exact at any instant, compiled."""

# pyright: reportArgumentType=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray, TimeArray
from ..compiled import compiled
from .closed import advance_first, advance_second, constants
from .plants import PLANTS, FirstOrder


def forced_response(plant: PLANTS, acting: TimeArray, value: FloatArray, time: TimeArray) -> FloatArray:
    """The position of a plant that rests at 0 until its input steps.

    Args:
        plant: Of unit gain.
        acting: When each value reaches the plant, int64 ns, ascending, (k,).
        value: Of the input from then on [m], (k,).
        time: Asked for, int64 ns, ascending, (n,).

    Returns:
        The position [m], (n,).
    """
    found = np.empty(len(time))
    order = 1 if isinstance(plant, FirstOrder) else 2
    _walk(order, constants(plant)[None], acting, value, time, found)
    return found


@compiled
def _walk(
    order: int, constants: FloatArray, acting: TimeArray, value: FloatArray, time: TimeArray, found: FloatArray
) -> None:
    entry, v, position, rate = 0, 0.0, 0.0, 0.0
    clock = time[0] if len(time) else 0
    for n in range(len(time)):
        while True:
            due = entry < len(acting) and acting[entry] <= time[n]
            until = acting[entry] if due else time[n]
            if until > clock:
                dt, away = (until - clock) * 1e-9, position - v
                if order == 1:
                    position += advance_first(constants, 0, dt)[0] * away
                else:
                    a, b, c, d, _, _, _ = advance_second(constants, 0, dt)
                    position, rate = v + a * away + b * rate, c * away + d * rate
            clock = until
            if not due:
                break
            v = value[entry]
            entry += 1
        found[n] = position
