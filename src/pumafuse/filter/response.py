"""Where an axis goes when it is commanded, without noise: exact at any instant."""

from __future__ import annotations

import numpy as np

from ..arrays import ALWAYS, FloatArray, TimeArray
from ..model.arm import AxisModel
from ..model.plants import FirstOrder
from .core import AXIS, MOTION, Record, check, library, ptr


def record_of(axis: AxisModel, period: float, delay: float, start: float) -> Record:
    """An axis without noise as the core takes it, (1,): T, Td in s, the level of its rest [m], NaN if not known."""
    record, plant, gain = np.zeros(1, AXIS), axis.plant, axis.gain
    record["period"], record["delay"], record["start"] = period, delay, start
    if isinstance(plant, FirstOrder):
        record["time_constant"] = plant.time_constant
    else:
        record["natural_frequency"], record["damping"] = plant.natural_frequency, plant.damping
    record["slope"], record["intercept"], record["recovery"] = gain.slope, gain.intercept, axis.gain_recovery or 0.0
    record["max_speed"], record["play"] = axis.max_speed or 0.0, axis.play or 0.0
    if (sag := axis.sag) is not None:
        record["sag_offset"], record["sag_slope"], record["sag_knee"] = sag.offset, sag.slope, sag.knee or 0.0
        record["sag_slope_beyond"] = sag.slope if sag.slope_beyond is None else sag.slope_beyond
        record["sag_knee_below"] = sag.knee_below or 0.0
        record["sag_slope_below"] = sag.slope if sag.slope_below is None else sag.slope_below
    return record


def response(
    axis: AxisModel, period: float, delay: float, stamp: TimeArray, command: FloatArray, start: float, time: TimeArray
) -> FloatArray:
    """The position [m] relative to ``start`` of an axis that rests there until its first command, (n,).

    Period T and delay Td are in s. Each command u [m] has a ``stamp``, int64 ns, ascending, (k,). The position is
    asked for at each ``time``, int64 ns, ascending, (n,).
    """
    position = np.empty(len(time))
    command, time = np.ascontiguousarray(command, dtype=np.float64), np.ascontiguousarray(time)
    record = record_of(axis, period, delay, start)
    commands, asked = (len(stamp), ptr(stamp), ptr(command)), (len(time), ptr(time), ptr(position))
    check(library.pf_response(1, ptr(record), *commands, *asked))
    return position


def at_rest() -> Record:
    """What an axis does before its first command, (1,)."""
    at_rest = np.zeros(1, MOTION)
    at_rest["time"] = ALWAYS
    return at_rest


def follow(axis: Record, motion: Record, stamp: TimeArray, command: FloatArray, time: TimeArray) -> FloatArray:
    """The position [m] of an axis from what it does after a command on, (n,).

    No bit of it depends on what else is asked for, or on the pieces in which commands come. The axis, (1,), is of
    :func:`record_of`, with a start level of 0; its ``motion``, (1,), becomes that after the last command. A command u
    [m] relative to the level of its rest has a ``stamp``, int64 ns, ascending, (k,); ``time`` likewise, (n,).
    """
    position = np.empty(len(time))
    commands, asked = (len(stamp), ptr(stamp), ptr(command)), (len(time), ptr(time), ptr(position))
    library.pf_follow(ptr(axis), ptr(motion), *commands, *asked)
    return position
