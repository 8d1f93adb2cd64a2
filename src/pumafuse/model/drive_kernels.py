"""The plant's input command by command: what a recorded run and a live stream are both made of, to the last bit."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false

from __future__ import annotations

import math

import numpy as np

from ..arrays import FloatArray, IntArray, TimeArray
from ..compiled import compiled

_NEGLIGIBLE = 1e-15  # m; below it a decaying gain error no longer changes any estimate
_NEVER = 2**63 - 1


@compiled
def answered(
    step: float,
    step_before: float,
    error: float,
    interval: float,
    slope: float,
    intercept: float,
    recovery: float,
    period: float,
) -> tuple[float, float, float]:
    """Error e_n [m], maneuver [m/s] and speed [m/s] of a command that comes ``interval`` [s] after another with e."""
    speed = abs(step) / period
    kick = ((slope * speed + intercept) - 1.0) * step
    return error * math.exp(-interval / recovery) + kick, abs(step - step_before) / period, speed


@compiled
def ticks_worth(error: float, recovery: float, period: float) -> int:
    """On how many grid points of T a held command's error is worth decaying."""
    if error == 0.0 or recovery == math.inf:
        return 0
    return max(math.ceil(math.log(abs(error) / _NEGLIGIBLE) * (recovery / period)), 0)


@compiled
def tick_time(tick: int, period: float) -> int:
    """When a grid point comes, int ns after its command."""
    return int(np.rint(tick * (period * 1e9)))


@compiled
def decayed(error: float, tick: int, recovery: float, period: float) -> float:
    """What is left of an error [m] at a grid point."""
    return error * math.exp(-tick * period / recovery)


@compiled
def follow(
    time: TimeArray,
    command: FloatArray,
    start: float,
    slope: float,
    intercept: float,
    recovery: float,
    period: float,
    error: FloatArray,
    maneuver: FloatArray,
    held: IntArray,
) -> float:
    """Error and maneuver of each command, how many grid points lie in its hold, and the highest speed [m/s]."""
    e, before, step_before, highest = 0.0, start, 0.0, 0.0
    for n in range(len(time)):
        step = command[n] - before
        interval = (time[n] - time[n - 1]) / 1e9 if n > 0 else 0.0
        e, maneuver[n], speed = answered(step, step_before, e, interval, slope, intercept, recovery, period)
        error[n], before, step_before, highest = e, command[n], step, max(highest, speed)
        held[n] = _ticks_held(e, time[n + 1] - time[n] if n + 1 < len(time) else _NEVER, recovery, period)
    return highest


@compiled
def _ticks_held(error: float, hold: int, recovery: float, period: float) -> int:
    """Grid points that are worth it strictly inside a hold [ns]; one that rounds onto its end is not inside."""
    worth = ticks_worth(error, recovery, period)
    if worth == 0 or tick_time(worth, period) < hold:
        return worth
    inside = min(int(hold / (period * 1e9)) + 1, worth)
    while inside > 0 and tick_time(inside, period) >= hold:
        inside -= 1
    return inside


@compiled
def spread_out(
    time: TimeArray,
    command: FloatArray,
    start: float,
    recovery: float,
    period: float,
    error: FloatArray,
    maneuver: FloatArray,
    held: IntArray,
    entry_time: TimeArray,
    entry_value: FloatArray,
    entry_maneuver: FloatArray,
) -> None:
    """The entries of every command: itself, and the grid points in its hold."""
    at = 0
    for n in range(len(time)):
        for tick in range(held[n] + 1):
            entry_time[at] = time[n] + tick_time(tick, period)
            entry_value[at] = (command[n] - start) + (decayed(error[n], tick, recovery, period) if tick else error[n])
            entry_maneuver[at] = maneuver[n]
            at += 1
