"""From commands to the plant's input: the gain with its recovery, and the maneuver that scales the noise.

v_n = u_n + e_n with e_n = e(t_n−) + (K(speed_n) − 1)(u_n − u_(n−1)). The error e decays with the recovery time; while a
command is held the decay reaches the plant on a grid of T. Without recovery one step from rest gives exactly K · step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray, IntArray, TimeArray
from .arm import AxisModel, commanded_speed

_NEGLIGIBLE = 1e-15  # m; below it a decaying gain error no longer changes any estimate


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
    step = np.diff(command, prepend=start)
    speed = commanded_speed(step, period)
    maneuver = np.abs(np.diff(step, prepend=0.0)) / period
    kick = (axis.gain.at(speed) - 1.0) * step
    interval = np.diff(time) / 1e9
    recovery = np.inf if axis.gain_recovery is None else axis.gain_recovery
    error = _decaying_sum(np.exp(-np.concatenate(([0.0], interval)) / recovery), kick)
    highest = float(speed.max(initial=0.0))
    if not np.isfinite(recovery) or not error.any():
        return Drive(time, command - start + error, maneuver, highest)
    held = _grid_points(time, error, recovery, period)
    source = np.repeat(np.arange(len(time)), held + 1)
    tick = np.arange(len(source)) - np.repeat(np.cumsum(held + 1) - held - 1, held + 1)
    value = (command - start)[source] + error[source] * np.exp(-tick * period / recovery)
    return Drive(time[source] + np.rint(tick * (period * 1e9)).astype(np.int64), value, maneuver[source], highest)


def _grid_points(time: TimeArray, error: FloatArray, recovery: float, period: float) -> IntArray:
    """How many grid points of T lie strictly inside each command's hold, as long as its error is worth decaying."""
    with np.errstate(divide="ignore"):
        worth = np.ceil(np.log(np.abs(error) / _NEGLIGIBLE) * (recovery / period))
    inside, hold, tick = np.full(len(time), np.inf), np.diff(time), period * 1e9
    inside[:-1] = np.ceil(hold / tick) - 1.0
    inside[:-1] -= np.rint(inside[:-1] * tick) >= hold  # a point that rounds onto the next command is not inside
    return np.maximum(np.minimum(inside, worth), 0.0).astype(np.int64)


def _decaying_sum(decay: FloatArray, kick: FloatArray) -> FloatArray:
    """s_n = decay_n · s_(n−1) + kick_n from s = 0, by doubling strides: log2(n) passes and no loop over samples."""
    factor, total, stride = decay.copy(), kick.copy(), 1
    while stride < len(total) and factor[stride:].any():
        total[stride:] += factor[stride:] * total[:-stride].copy()
        factor[stride:] *= factor[:-stride].copy()
        factor[:stride] = 0.0
        stride *= 2
    return total
