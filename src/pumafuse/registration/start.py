"""Where to begin: the lag and the unit by speeds, which need no frame, the rotation by Kabsch's closed form."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import medfilt
from scipy.spatial.transform import Rotation, Slerp

from ..arrays import FloatArray
from .findings import Reading
from .motion import Motion

_TICK = 0.01  # s, between lags that are looked at
_LAGS = range(-50, 201)  # ticks
_WINDOWS = (0.15, 0.6)  # s, over which speeds are taken: the longer one where a sensor is noisy
_MOST = 30_000  # ticks of a run that are looked at
_FEWEST = 100  # ticks that are compared
_QUIET = 0.99  # quantile at which speeds are cut off: a jump must not decide
_OUTLIER = 5  # rows of a running median
_APART = (0.09, 0.21, 0.37)  # of all rows: between orientations that are compared
_HALF_TURN = 2.6  # rad, beyond which the axis of a rotation may point either way


class Rough(NamedTuple):
    """How a sensor follows by its speeds.

    Attributes:
        lag: Behind the commands [s].
        scale: Of the base's lengths over the sensor's; NaN where the tool keeps its place.
        correlation: Of the speeds.
    """

    lag: float
    scale: float
    correlation: float


def rough(command: Sequence[Motion], sensor: Sequence[Motion]) -> Rough:
    """Lag and scale for which the speeds are most alike, lengths and angles."""
    best = Rough(0.0, np.nan, 0.0)
    for window in _WINDOWS:
        steps = round(window / _TICK)
        told = [_speeds(one, steps) for one in command]
        seen = [_speeds(one, steps) for one in sensor]
        starts = [round((b.time[0] - a.time[0]) / _TICK) for a, b in zip(command, sensor, strict=True)]
        for by, of in ((0, 0), (1, 1), (1, 0)):
            if all(len(one) > max(by, of) for one in told + seen):
                pairs = [(a[by], b[of], at) for a, b, at in zip(told, seen, starts, strict=True)]
                for lag in _LAGS:
                    left, right = (np.concatenate(one) for one in zip(*_shifted(pairs, lag), strict=True))
                    alike = _correlation(left, right)
                    if alike > best.correlation:
                        scale = (
                            np.median(left[_upper(left)]) / np.median(right[_upper(left)]) if by == of == 0 else np.nan
                        )
                        best = Rough(lag * _TICK, float(scale), alike)
    return best


def _speeds(motion: Motion, steps: int) -> list[FloatArray]:
    """How far it goes [m], and turns [rad] where it is told, within so many ticks; by ticks from its first row."""
    grid = np.arange(motion.time[0], min(motion.time[-1], motion.time[0] + _MOST * _TICK), _TICK)
    place = np.stack([np.interp(grid, motion.time, one) for one in despiked(motion.position).T], axis=-1)
    found = [np.linalg.norm(place[steps:] - place[:-steps], axis=1)]
    if motion.quaternion is not None:
        turned = Slerp(motion.time, Rotation.from_quat(motion.quaternion))(grid)
        found.append((turned[steps:] * turned[:-steps].inv()).magnitude())
    return [np.minimum(one, np.quantile(one, _QUIET)) for one in found if len(one)]


def despiked(position: FloatArray) -> FloatArray:
    """Positions without single outliers."""
    return medfilt(position, (_OUTLIER, 1)) if len(position) > _OUTLIER else position


def _shifted(pairs: Sequence[tuple[FloatArray, FloatArray, int]], lag: int) -> Iterator[tuple[FloatArray, FloatArray]]:
    """What was told so many ticks before what was seen, where there are both."""
    for told, seen, start in pairs:
        first = max(0, lag - start)
        count = max(min(len(seen) - first, len(told) - (first + start - lag)), 0)
        yield told[first + start - lag :][:count], seen[first:][:count]


def _correlation(one: FloatArray, other: FloatArray) -> float:
    """Of two speeds; 0 where one is constant."""
    if len(one) < _FEWEST:
        return 0.0
    a, b = one - one.mean(), other - other.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 1e-12 * len(a) * float(one.max() * other.max()) else 0.0


def _upper(speed: FloatArray) -> FloatArray:
    return speed >= np.quantile(speed, 0.5)


def kabsch(to: FloatArray, of: FloatArray) -> tuple[FloatArray, float]:
    """The rotation that takes one set of vectors nearest to another, and the share of them that it leaves, of 1.

    scipy's warns where the answer is one of several; here that one does.
    """
    left, _, right = np.linalg.svd(to.T @ of)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ flip @ right
    return rotation, float(np.sqrt(np.mean((to - of @ rotation.T) ** 2) / max(float(np.mean(to**2)), 1e-300)))


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors about their mean, of mean square 1."""
    about = vectors - vectors.mean(axis=0)
    return about / max(float(np.sqrt(np.mean(about**2) * 3.0)), 1e-300)


def between(turned: Rotation) -> FloatArray:
    """Rotation vectors [rad] along the base's axes from some orientations to others, (m, 3)."""
    count = len(turned)
    shifts = [max(round(share * count), 1) for share in _APART]
    return np.concatenate([(turned[shift:] * turned[:-shift].inv()).as_rotvec() for shift in shifts])


def aligned_turns(told: Rotation, seen: Rotation) -> tuple[FloatArray, FloatArray]:
    """Rotations between the same rows of both, those of which the axis is sure."""
    one, other = between(told), between(seen)
    sure = np.maximum(np.linalg.norm(one, axis=1), np.linalg.norm(other, axis=1)) < _HALF_TURN
    return one[sure], other[sure]


def read(quaternion: FloatArray, reading: Reading) -> FloatArray:
    """Quaternions x, y, z, w that were read otherwise."""
    match reading:
        case Reading.AS_TOLD:
            return quaternion
        case Reading.INVERSE:
            return quaternion * np.array([-1.0, -1.0, -1.0, 1.0])
        case Reading.W_FIRST:
            return quaternion[:, [1, 2, 3, 0]]
        case Reading.W_LAST:
            return quaternion[:, [3, 0, 1, 2]]
