"""Cylindrical coordinates row by row, compiled: a run and a stream of single rows get the same bits."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false

from __future__ import annotations

import math

import numpy as np

from ..arrays import FloatArray
from ..compiled import kernel

_TURN = 2.0 * math.pi


@kernel
def to_cylinder(
    x: FloatArray,
    y: FloatArray,
    base_x: float,
    base_y: float,
    radius: float,
    angle: float,
    sign: float,
    near: FloatArray,
    last: float,
    tangential: FloatArray,
    radial: FloatArray,
    spread: FloatArray,
) -> None:
    """Fill in each row's axis positions, NaN for half a row and on the base's axis, which has no angle.

    A row's turn is the one nearest to ``near`` [m]; if that is empty, to the row before; for the first row to ``last``.
    """
    about = sign * last / radius
    for n in range(len(x)):
        dx, dy = x[n] - base_x, y[n] - base_y
        r = math.hypot(dx, dy)
        if not math.isfinite(x[n] + y[n]) or r == 0.0:  # some sensors that lost their target report the base's axis
            tangential[n], radial[n], spread[n] = math.nan, math.nan, 1.0
            continue
        if len(near):
            about = sign * near[n] / radius
        turn = math.atan2(dy, dx) - angle
        turn += _TURN * np.rint((about - turn) / _TURN)
        if not len(near):
            about = turn
        tangential[n], radial[n], spread[n] = sign * radius * turn, r, radius / r


@kernel
def from_cylinder(
    tangential: FloatArray,
    radial: FloatArray,
    base_x: float,
    base_y: float,
    radius: float,
    angle: float,
    sign: float,
    x: FloatArray,
    y: FloatArray,
) -> None:
    """Fill in the log's x and y of axis positions."""
    for n in range(len(x)):
        theta = angle + sign * tangential[n] / radius
        x[n], y[n] = base_x + radial[n] * math.cos(theta), base_y + radial[n] * math.sin(theta)
