"""Intervals of numbers of a least squares where rows that follow each other err alike.

What an arm does not do as commanded goes on for seconds, and its kinematics are wrong by what changes with the pose:
thousands of rows say little more than some dozens. So the rows are cut into blocks of the motion, each number is worked
out without one block after another, and how it changes then is its variance: the jackknife by clusters (Cameron and
Miller 2015, CR3). Blocks that tell much by themselves count as much more as they do.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from ..arrays import FloatArray

_BLOCKS = 20  # of a minute each is 3 s, longer than a swing of the arm; fewer leave a quantile unsure
_LEVEL = 0.975  # both sides 95 %
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


def blocks(slope: FloatArray, off: FloatArray, told: FloatArray, weight: FloatArray) -> Blocks:
    """What blocks of rows tell that are ``off`` by so much, (n, 3), and change so with a step, (n, 3, k).

    They are weighted for the information as is ``told``, for the score by their ``weight``, (n,) each.
    """
    first = np.linspace(0.0, len(off), _BLOCKS, endpoint=False).astype(np.int64)
    cuts = [slice(*ends) for ends in pairwise([*first.tolist(), len(off)])]
    both = ((0, 1), (0, 1))
    return Blocks(
        np.array([np.tensordot(told[cut, None, None] * slope[cut], slope[cut], both) for cut in cuts]),
        np.array([np.tensordot(slope[cut], weight[cut, None] * off[cut], both) for cut in cuts]),
    )


def inverse(information: FloatArray) -> FloatArray:
    """The inverse of a matrix whose numbers have units of their own; what rows do not tell does not move."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    return np.linalg.pinv(information / np.outer(size, size), rcond=_SINGULAR, hermitian=True) / np.outer(size, size)
