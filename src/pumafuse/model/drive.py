"""From commands to the plant's input: the gain with its recovery, and the maneuver that scales the noise.

v_n = u_n + e_n with e_n = e(t_n−) + (K(speed_n) − 1)(u_n − u_(n−1)). The error e decays with the recovery time; while a
command is held the decay reaches the plant on a grid of T. Without recovery one step from rest gives exactly K · step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray, TimeArray
from .arm import AxisModel


@dataclass(frozen=True)
class Drive:
    """What one axis's plant is fed, before the delay. All arrays are (entries,), times ascending.

    Attributes:
        time: Int64 ns at which the entry is issued; it acts one delay later.
        value: v relative to the start level [m], held until the next entry.
        maneuver: |u_n − 2u_(n−1) + u_(n−2)| / T [m/s] of the command behind the entry.
        speed: Highest commanded speed [m/s] (0 without commands).
    """

    time: TimeArray
    value: FloatArray
    maneuver: FloatArray
    speed: float


def drive(axis: AxisModel, time: TimeArray, command: FloatArray, start: float, period: float) -> Drive:
    """The plant input that a sequence of commands makes.

    Args:
        axis: Gain and recovery.
        time: When each command was given, int64 ns, strictly ascending, (n,).
        command: u [m], (n,).
        start: The level u₀ [m] at which the arm rests before the first command.
        period: The update period T [s].

    Returns:
        The commands, and between them an entry each T where a gain error decays.
    """
    from .drive_kernels import follow, spread_out

    recovery = np.inf if axis.gain_recovery is None else axis.gain_recovery
    error, maneuver = np.empty(len(time)), np.empty(len(time))
    held = np.empty(len(time), dtype=np.int64)
    gain = axis.gain
    speed = follow(time, command, start, gain.slope, gain.intercept, recovery, period, error, maneuver, held)
    entries = len(time) + int(held.sum())
    made = Drive(np.empty(entries, dtype=np.int64), np.empty(entries), np.empty(entries), speed)
    spread_out(time, command, start, recovery, period, error, maneuver, held, made.time, made.value, made.maneuver)
    return made
