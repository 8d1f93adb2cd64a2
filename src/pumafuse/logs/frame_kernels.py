"""Positions in a log's x and y as axis positions and back, one at a time: a run and a stream get the same bits."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false

from __future__ import annotations

import math

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled

_TURN = 2.0 * math.pi


@compiled
def turned(x: float, y: float, base_x: float, base_y: float, angle: float) -> tuple[float, float]:
    """θ − θ0 [rad], some whole turns off, and r [m]; NaN on the base's axis, which has no angle, and for half a row.

    On the axis is where some sensors say they are when they are lost.
    """
    dx, dy = x - base_x, y - base_y
    r = math.hypot(dx, dy)
    if not math.isfinite(x + y) or r == 0.0:
        return math.nan, math.nan
    return math.atan2(dy, dx) - angle, r


@compiled
def nearest_turn(turn: float, about: float) -> float:
    """``turn`` [rad] and as many whole turns as bring it nearest to ``about``."""
    return turn + _TURN * np.rint((about - turn) / _TURN)


@compiled
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
    """Each row's axis positions; its turn is the one nearest to ``near`` [m], or where that is empty to the row before.

    ``last`` [m] is what the first row's turn is nearest to then.
    """
    about = sign * last / radius
    for n in range(len(x)):
        turn, r = turned(x[n], y[n], base_x, base_y, angle)
        if len(near):
            about = sign * near[n] / radius
        turn = nearest_turn(turn, about)
        if not len(near) and not math.isnan(turn):
            about = turn
        tangential[n], radial[n] = sign * radius * turn, r
        spread[n] = 1.0 if math.isnan(r) else radius / r


@compiled
def to_plane(
    x: FloatArray, y: FloatArray, cos: float, sin: float, sign: float, tangential: FloatArray, radial: FloatArray
) -> None:
    """Each row's axis positions in a rotated frame."""
    for n in range(len(x)):
        missing = not math.isfinite(x[n] + y[n])
        tangential[n] = math.nan if missing else sign * (y[n] * cos - x[n] * sin)
        radial[n] = math.nan if missing else x[n] * cos + y[n] * sin


@compiled
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
    """The log's x and y of axis positions."""
    for n in range(len(x)):
        theta = angle + sign * tangential[n] / radius
        x[n], y[n] = base_x + radial[n] * math.cos(theta), base_y + radial[n] * math.sin(theta)
