"""Intervals of numbers of a least squares where rows that follow each other, or of poses beside each other, err alike.

What an arm does not do as commanded goes on for seconds, and its kinematics are wrong by what changes with the pose:
thousands of rows say little more than some dozens. So the rows are cut into blocks of the motion, each number is worked
out without one block after another, and how it changes then is its variance: the jackknife by clusters (Cameron and
Miller 2015, CR3). Blocks that tell much by themselves count as much more as they do.

What an arm errs with the pose comes again in each block, so that no block tells it from what is looked for. It is told
by what is left, which is alike at poses beside each other, and counts beside the jackknife.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import stdtrit

from ..arrays import FloatArray

_BLOCKS = 20  # of a minute each is 3 s, longer than a swing of the arm; fewer leave a quantile unsure
_LEVEL = 0.975  # both sides 95 %
_GROUPS = 500  # of rows, of each the mean: 0.1 s of a minute, in which a pose hardly changes
_CHANCE = 2.0  # standard deviations of a variance that white noise makes: only what is more is one of poses
_SINGULAR = 1e-11  # of the largest eigenvalue: what is smaller is not told by the rows


class Blocks(NamedTuple):
    """What the blocks of rows tell at the least squares."""

    information: FloatArray  # of the numbers of a step, (b, k, k)
    score: FloatArray  # the slope of half the sum of squares, (b, k): all together 0

    def step(self) -> FloatArray:
        """Gauss and Newton's step, (k,); what rows do not tell does not move."""
        return -inverse(self.information.sum(axis=0)) @ self.score.sum(axis=0)

    def half_widths(self, numbers: FloatArray) -> FloatArray:
        """Half the 95 % interval of numbers that change so with a step, (q, k) → (q,)."""
        whole, count = self.information.sum(axis=0), len(self.score)
        without = [inverse(whole - of) @ score for of, score in zip(self.information, self.score, strict=True)]
        variance = (1.0 - 1.0 / count) * np.sum((np.array(without) @ numbers.T) ** 2, axis=0)
        return np.sqrt(variance) * float(stdtrit(count - 1.0, _LEVEL))


def blocks(slope: FloatArray, off: FloatArray, curvature: FloatArray, weight: FloatArray) -> Blocks:
    """What blocks of rows tell that are ``off`` by so much, (n, 3), and change so with a step, (n, 3, k).

    They are weighted for the information by their ``curvature``, for the score by their ``weight``, (n,) each.
    """
    first = np.linspace(0.0, len(off), _BLOCKS, endpoint=False).astype(np.int64)
    cuts = [slice(*ends) for ends in pairwise([*first.tolist(), len(off)])]
    both = ((0, 1), (0, 1))
    return Blocks(
        np.array([np.tensordot(curvature[cut, None, None] * slope[cut], slope[cut], both) for cut in cuts]),
        np.array([np.tensordot(slope[cut], weight[cut, None] * off[cut], both) for cut in cuts]),
    )


def of_poses(slope: FloatArray, off: FloatArray, weight: FloatArray, pose: FloatArray) -> FloatArray:
    """The covariance of the score, (k, k), by what goes with the pose, (n, d); of rows as :func:`blocks` has them.

    It is alike by exp(−distance). Its variance and that of white noise are those of which squares and products of what
    is left are expected to be what they are (Rao 1971, MINQUE).
    """
    first, both = np.unique(np.linspace(0.0, len(off), _GROUPS, endpoint=False).astype(np.int64)), ((0, 1), (0, 1))
    size = np.diff([*first.tolist(), len(off)])[:, None]
    root = np.sqrt(weight)[:, None]
    rows = (root * off, root, pose, (root[:, :, None] * slope).reshape(len(off), -1))
    left, root, pose, flat = (np.add.reduceat(each, first) / size for each in rows)
    slope = flat.reshape(len(first), 3, -1)
    alike = root * np.exp(-cdist(pose, pose)) * root.T
    score = np.tensordot(alike, slope, 1)
    information, covariance = np.tensordot(slope, slope, both), np.tensordot(slope, score, both)
    without = inverse(information)
    fitted = without @ covariance
    traces = left.size - np.trace(without @ information), 3.0 * np.trace(alike) - np.trace(fitted)
    square = (
        3.0 * np.sum(alike**2) - 2.0 * np.sum(without * np.tensordot(score, score, both)) + np.sum(fitted * fitted.T)
    )
    variances = np.linalg.inv([traces, (traces[1], square)])
    white, of_pose = (variances @ [np.sum(left**2), np.sum(left * (alike @ left))]).tolist()
    beyond = max(of_pose - _CHANCE * white * float(np.sqrt(2.0 * variances[1, 1])), 0.0)
    return beyond * (len(off) / len(first)) ** 2 * covariance


def inverse(information: FloatArray) -> FloatArray:
    """The inverse of a matrix whose numbers have units of their own; what rows do not tell does not move."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    return np.linalg.pinv(information / np.outer(size, size), rcond=_SINGULAR, hermitian=True) / np.outer(size, size)
