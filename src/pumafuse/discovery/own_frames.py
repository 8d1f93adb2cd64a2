"""Sensors that stand in frames of their own: they are as fast as the commands, and their axes do not follow.

How fast a point moves, and how fast a tool turns, is the same in every frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray, TimeArray, known_rows
from ..logs.frames import CARTESIAN
from ..logs.run import Run
from ..logs.source import Source
from ..space import rotations
from ..units import DEG
from .following import Following, following

FOLLOWS = 0.8  # correlation below which an axis does not follow
_AS_FAST = 0.6  # from which speeds do: a marker beside a tool that turns has some of its own
_WINDOW_NS = 150_000_000  # over which speeds are: long beside noise, short beside a motion
_EXPLAINS = 0.25  # of what the axes leave of the motion: a frame that is turned leaves less
_EXCHANGED = 0.9  # correlation from which an axis is another one: then columns are exchanged
_FEWEST = 20  # rows


@dataclass(frozen=True)
class OwnFrame:
    """Why a sensor seems to stand in a frame of its own."""

    speeds: Following  # how its speed follows the commanded one
    least: float  # the correlation of the axis that follows worst
    angle: float  # by how much it is turned [rad]; NaN of a mirrored frame

    @property
    def words(self) -> str:
        """The reasons as a sentence without its subject."""
        turned = "mirrored" if math.isnan(self.angle) else f"turned by about {self.angle * DEG:.0f}°"
        return (
            f"looks to stand in a frame of its own, {turned}: speeds follow (correlation"
            f" {self.speeds.correlation:+.2f}, {self.speeds.lag * 1e3:.0f} ms late), axes do not (down to"
            f" {self.least:+.2f})"
        )


def own_frames(run: Run) -> dict[str, OwnFrame]:
    """The sensors of a run that seem to stand in frames of their own, by name."""
    return {
        name: own_frame
        for name, source in run.sensors.items()
        if (own_frame := _own_frame(run.command, source)) is not None
    }


def speeds_follow(command: Source, source: Source) -> Following | None:
    """How the speed of a sensor follows the commanded one, of its place or of its turning, whichever does so better."""
    axes = _axes(command, source)
    if len(axes) < 2:
        return None
    pairs = [(_rows(command, axes), _rows(source, axes))]
    if command.orientation is not None and source.orientation is not None:
        pairs.append((_turning(command), _turning(source)))
    fast = [
        following((t, _speed(t, told)), (s, _speed(s, seen)))
        for (t, told), (s, seen) in pairs
        if min(len(t), len(s)) >= _FEWEST
    ]
    return max(filter(None, fast), key=lambda relation: relation.correlation, default=None)


def _axes(command: Source, source: Source) -> list[str]:
    """The axes among x, y and z that both sources have."""
    return [axis for axis in CARTESIAN if axis in command.values and axis in source.values]


def _own_frame(command: Source, source: Source) -> OwnFrame | None:
    axes = _axes(command, source)
    speeds = speeds_follow(command, source)
    if speeds is None or speeds.correlation < _AS_FAST:
        return None
    (t, told), (s, seen) = _rows(command, axes), _rows(source, axes)
    late = s - round(speeds.lag * 1e9)
    inside = (late >= t[0]) & (late <= t[-1])
    if np.count_nonzero(inside) < _FEWEST:
        return None
    led = _path(t, told, late[inside])
    led, seen = led - led.mean(axis=0), seen[inside] - np.median(seen[inside], axis=0)
    near = np.abs(seen).max(axis=1) <= 2.0 * np.sqrt(np.sum(led**2, axis=1).max(initial=0.0))  # no outlier
    if np.count_nonzero(near) < _FEWEST or not led[near].any():
        return None
    led, seen = led[near] - led[near].mean(axis=0), seen[near] - seen[near].mean(axis=0)
    power = np.sqrt(np.sum(seen**2, axis=0)[:, None] * np.sum(led**2, axis=0))
    crossed = (seen.T @ led) / np.where(power > 0.0, power, np.inf)  # correlations, (k, k)
    moves = [axis for axis in range(len(axes)) if np.ptp(led[:, axis]) > 0.0]
    least = min((float(crossed[axis, axis]) for axis in moves), default=1.0)
    if least >= FOLLOWS:
        return None
    as_it_is = float(np.sum(seen * led)) / max(math.sqrt(float(np.sum(seen**2) * np.sum(led**2))), 1e-30)
    rotation, turned = rotations.aligning(seen, led)
    _, mirrored = rotations.aligning(seen * np.where(np.arange(len(axes)) == 0, -1.0, 1.0), led)
    is_mirrored = 1.0 - mirrored**2 < _EXPLAINS * (1.0 - turned**2)
    size = np.abs(crossed) if is_mirrored else crossed
    others = {int(np.argmax(size[:, axis])) for axis in moves}
    exchanged = len(others) == len(moves) and all(size[:, axis].max() >= _EXCHANGED for axis in moves)
    if exchanged or 1.0 - max(turned, mirrored) ** 2 > _EXPLAINS * (1.0 - as_it_is * abs(as_it_is)):
        return None
    return OwnFrame(speeds, least, math.nan if is_mirrored else angle_of(rotation))


def angle_of(rotation: FloatArray) -> float:
    """By how much a rotation turns [rad], (k, k) with k of 2 or 3."""
    cosine = (float(np.trace(rotation)) - (len(rotation) - 2)) / 2.0
    return math.acos(min(max(cosine, -1.0), 1.0))


def _rows(source: Source, axes: Sequence[str]) -> tuple[TimeArray, FloatArray]:
    """Stamps and positions, (n, k), of the rows that have all of the axes, in the order of time."""
    return known_rows(source.stamp, np.column_stack([source.values[axis] for axis in axes]))


def _turning(source: Source) -> tuple[TimeArray, FloatArray]:
    """Stamps and orientations, relative to their mean [rad], (n, 3), in the order of time.

    Another frame and a marker that is turned on the tool only turn these vectors, all alike.
    """
    assert source.orientation is not None
    stamp, told = known_rows(source.stamp, source.orientation)
    return stamp, rotations.vectors(told, rotations.mean(told)) if len(told) else np.empty((0, 3))


def _speed(stamp: TimeArray, position: FloatArray) -> FloatArray:
    """How far a point, or a rotation vector, moves in the 0.15 s around each stamp [m or rad], (n,)."""
    half = _WINDOW_NS // 2
    moved = _path(stamp, position, stamp + half) - _path(stamp, position, stamp - half)
    return np.sqrt(np.sum(moved**2, axis=1))


def _path(stamp: TimeArray, position: FloatArray, time: TimeArray) -> FloatArray:
    """Where a point is at some times [m], (m, k)."""
    return np.column_stack([np.interp(time, stamp, position[:, axis]) for axis in range(position.shape[1])])
