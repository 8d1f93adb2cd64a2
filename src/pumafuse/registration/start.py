"""Where to begin: the lag and the unit by speeds, which need no frame, the rotation by Kabsch's closed form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from ..arrays import FloatArray, median
from ..space.rotations import nearest
from .findings import Reading
from .motion import Motion

_TICK = 0.01  # s, between lags that are looked at
_LAGS = range(-50, 201)  # ticks
_WINDOWS = (0.15, 0.6)  # s, over which speeds are taken: the longer one where a sensor is noisy
_MOST = 30_000  # ticks of a run that are looked at
_FEWEST = 100  # ticks that are compared
_QUIET = 0.99  # quantile at which speeds are cut off: a jump must not decide
_FAST = 0.8  # quantile of speeds
_STANDS = 1e-9  # m
_MOVED = 1e-3  # m, within a window
_LEVER = 0.1  # m, about, from a tool point to what is seen: a tool that turns in place moves it
_OUTLIER = 5  # rows of a running median
_OVER = (0.6, 0.06)  # s: noise counts little beside lengths; degrees read as rad turn by less than half a turn
_APART = (0.09, 0.21, 0.37)  # of all rows: between orientations that are compared
_HALF_TURN = 2.6  # rad, beyond which the axis of a rotation may point either way


class Rough(NamedTuple):
    """How a sensor follows by its speeds."""

    lag: float  # behind the commands [s]
    scale: float  # of the base's lengths over the sensor's; NaN where the tool keeps its place
    correlation: float  # of the speeds


def rough(command: Sequence[Motion], sensor: Sequence[Motion]) -> Rough:
    """Lag and scale for which the speeds are most alike, lengths and angles."""
    best = Rough(0.0, np.nan, 0.0)
    for window in _WINDOWS:
        steps = round(window / _TICK)
        commanded = [_speeds(path, steps, held=True) for path in command]
        seen = [_speeds(path, steps, held=False) for path in sensor]
        starts = [round((b.time[0] - a.time[0]) / _TICK) for a, b in zip(command, sensor, strict=True)]
        for by, of in ((0, 0), (1, 1), (1, 0)):
            if all(len(path) > by for path in commanded) and all(len(path) > of for path in seen):
                pairs = [(a[by], b[of], at) for a, b, at in zip(commanded, seen, starts, strict=True)]
                for lag in _LAGS:
                    left, right = _beside(pairs, lag)
                    alike = _correlation(left, right)
                    if alike > best.correlation:
                        best = Rough(lag * _TICK, _ratio(commanded, seen, starts, lag), alike)
    return best


def _speeds(motion: Motion, steps: int, *, held: bool) -> list[FloatArray]:
    """How far it goes [m], and turns [rad] where that is known, within so many ticks; by ticks from its first row.

    Commands are held, measurements are samples of a path.
    """
    grid = np.arange(motion.time[0], min(motion.time[-1], motion.time[0] + _MOST * _TICK), _TICK)
    last = np.searchsorted(motion.time, grid, side="right") - 1
    path: FloatArray = motion.position[last]
    if not held:
        smooth = despike(motion.position)
        for axis in range(3):
            path[:, axis] = np.interp(grid, motion.time, smooth[:, axis])
    speeds = [np.linalg.norm(path[steps:] - path[:-steps], axis=1)]
    if motion.quaternion is not None:
        turned = Rotation.from_quat(motion.quaternion[last])
        speeds.append((turned[steps:] * turned[:-steps].inv()).magnitude())
    return [np.minimum(part, np.quantile(part, _QUIET)) for part in speeds if len(part)]


def despike(position: FloatArray) -> FloatArray:
    """Positions without single outliers."""
    return median_filter(position, size=(_OUTLIER, 1), mode="nearest")


def _beside(pairs: Sequence[tuple[FloatArray, FloatArray, int]], lag: int) -> tuple[FloatArray, FloatArray]:
    """What was commanded so many ticks before what was seen, where there are both, of all runs."""
    left, right = list[FloatArray](), list[FloatArray]()
    for commanded, seen, start in pairs:
        first = max(0, lag - start)
        count = max(min(len(seen) - first, len(commanded) - (first + start - lag)), 0)
        left.append(commanded[first + start - lag :][:count])
        right.append(seen[first:][:count])
    return np.concatenate(left), np.concatenate(right)


def _ratio(
    commanded: Sequence[list[FloatArray]], seen: Sequence[list[FloatArray]], starts: list[int], lag: int
) -> float:
    """How far a marker should go, over how far it is seen to, where the tool is fast; NaN where it keeps its place."""
    moved, distance = _beside([(a[0], b[0], at) for a, b, at in zip(commanded, seen, starts, strict=True)], lag)
    fast = moved >= np.quantile(moved, _FAST)
    if median(moved[fast]) < _MOVED:
        return np.nan
    if all(len(path) > 1 for path in commanded):
        turned = _beside([(a[1], b[0], at) for a, b, at in zip(commanded, seen, starts, strict=True)], lag)[0]
        moved = np.hypot(moved, _LEVER * turned)
    return median(moved[fast]) / max(median(distance[fast]), _STANDS)


def ratio(command: Sequence[Motion], sensor: Sequence[Motion], lag: float, *, turns: bool) -> float:
    """How far the tool is commanded to move or turn over how far it is seen to, where it is fast; NaN if unknown."""
    steps, column = round(_OVER[turns] / _TICK), int(turns)
    commanded, seen = (
        [_speeds(path, steps, held=held) for path in of] for of, held in ((command, True), (sensor, False))
    )
    if any(len(path) <= column for path in (*commanded, *seen)):
        return np.nan
    starts = [round((b.time[0] - a.time[0]) / _TICK) for a, b in zip(command, sensor, strict=True)]
    pairs = [(a[column], b[column], at) for a, b, at in zip(commanded, seen, starts, strict=True)]
    moved, distance = _beside(pairs, round(lag / _TICK))
    if not len(moved):
        return np.nan
    fast = moved >= np.quantile(moved, _FAST)
    return median(moved[fast]) / max(median(distance[fast]), _STANDS)


def _correlation(first: FloatArray, other: FloatArray) -> float:
    """Correlation of two speeds; 0 where one is constant."""
    if len(first) < _FEWEST:
        return 0.0
    a, b = first - first.mean(), other - other.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 1e-12 * len(a) * float(first.max() * other.max()) else 0.0


def kabsch(to: FloatArray, of: FloatArray) -> tuple[FloatArray, float]:
    """The rotation that takes one set of vectors nearest to another, and the sum of squares that it leaves."""
    rotation = nearest(to.T @ of)
    return rotation, float(np.sum((to - of @ rotation.T) ** 2))


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors about their mean, of mean square 1."""
    about = vectors - vectors.mean(axis=0)
    return about / max(float(np.linalg.norm(about)) / np.sqrt(len(about)), 1e-300)


def rotations_between(turned: Rotation) -> FloatArray:
    """Rotation vectors [rad] along the base's axes from some orientations to others, (m, 3)."""
    count = len(turned)
    shifts = [max(round(share * count), 1) for share in _APART]
    return np.concatenate([(turned[shift:] * turned[:-shift].inv()).as_rotvec() for shift in shifts])


def align_turns(commanded: Rotation, seen: Rotation) -> tuple[FloatArray, FloatArray]:
    """Rotations between the same rows of both, those of which the axis is sure."""
    turns, other = rotations_between(commanded), rotations_between(seen)
    sure = np.maximum(np.linalg.norm(turns, axis=1), np.linalg.norm(other, axis=1)) < _HALF_TURN
    return turns[sure], other[sure]


def read(quaternion: FloatArray, reading: Reading) -> FloatArray:
    """Quaternions x, y, z, w that were read otherwise."""
    match reading:
        case Reading.AS_IT_IS:
            return quaternion
        case Reading.INVERSE:
            return quaternion * np.array([-1.0, -1.0, -1.0, 1.0])
        case Reading.W_FIRST:
            return quaternion[:, [1, 2, 3, 0]]
        case Reading.W_LAST:
            return quaternion[:, [3, 0, 1, 2]]
