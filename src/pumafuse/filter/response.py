"""Where an axis goes when it is commanded, without noise: exact at any instant."""

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray, TimeArray
from ..model.arm import AxisModel
from ..model.plants import FirstOrder
from .core import AXIS, Record, at, library


def record_of(axis: AxisModel, period: float, delay: float, start: float) -> Record:
    """An axis without noise as the core takes it, (1,).

    Args:
        axis: Plant and gain.
        period: The update period T [s].
        delay: Td [s].
        start: The level u₀ [m] at which it rests; NaN where that is not known.
    """
    found, plant, gain = np.zeros(1, AXIS), axis.plant, axis.gain
    found["period"], found["delay"], found["start"] = period, delay, start
    if isinstance(plant, FirstOrder):
        found["time_constant"] = plant.time_constant
    else:
        found["natural_frequency"], found["damping"] = plant.natural_frequency, plant.damping
    found["slope"], found["intercept"], found["recovery"] = gain.slope, gain.intercept, axis.gain_recovery or 0.0
    return found


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
    position = np.empty(len(time))
    command, time = np.ascontiguousarray(command, dtype=np.float64), np.ascontiguousarray(time)
    record = record_of(axis, period, delay, start)
    library.pf_response(at(record), len(given), at(given), at(command), len(time), at(time), at(position))
    return position
