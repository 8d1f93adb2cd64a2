"""A step of Fisher scoring, or of Gauss and Newton, between bounds."""

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray

_ACTIVE_SETS = 8  # that are tried; they may go round in circles
_ROUNDING = 1e-10  # of a matrix with a diagonal of 1, below which its eigenvalues mean nothing


def bounded_step(
    score: FloatArray, information: FloatArray, low: FloatArray, high: FloatArray, damping: FloatArray
) -> FloatArray:
    """The δ between ``low`` and ``high`` that minimises ½ δᵀ(I + λ diag I)δ − gᵀδ, (k,).

    The matrix is scaled to a diagonal of 1 + λ. A parameter without any information does not move.
    """
    diagonal = np.diag(information)
    informed = diagonal > 0.0
    step, size = np.zeros(len(diagonal)), 1.0 / np.sqrt(diagonal[informed])
    matrix = information[np.ix_(informed, informed)] * np.outer(size, size) + np.diag(damping[informed] + _ROUNDING)
    lowest, highest = low[informed] / size, high[informed] / size
    inner = _between(matrix, size * score[informed], lowest, highest)
    if inner is None:
        from scipy.optimize import lsq_linear  # takes a while to import, and is seldom needed

        root = np.asarray(np.linalg.cholesky(matrix), dtype=np.float64)
        aim = np.asarray(np.linalg.solve(root, size * score[informed]), dtype=np.float64)
        inner = lsq_linear(root.T, aim, (lowest, highest), method="bvls").x
    step[informed] = size * inner
    return step


def _between(matrix: FloatArray, score: FloatArray, lowest: FloatArray, highest: FloatArray) -> FloatArray | None:
    """The δ between bounds that minimises ½ δᵀMδ − gᵀδ; None where this does not find it.

    What is beyond a bound is fixed there, and set free again where the score points inside, until nothing changes
    (Hintermüller, Ito & Kunisch, "The primal-dual active set strategy as a semismooth Newton method", SIAM Journal on
    Optimization 13, 2002).
    """
    delta = np.asarray(np.linalg.solve(matrix, score), dtype=np.float64)
    if ((lowest <= delta) & (delta <= highest)).all():
        return delta
    at_low = at_high = np.zeros(len(score), dtype=np.bool_)
    for _ in range(_ACTIVE_SETS):
        free = ~(at_low | at_high)
        delta = np.where(at_low, lowest, np.where(at_high, highest, 0.0))
        delta[free] = np.linalg.solve(matrix[np.ix_(free, free)], (score - matrix @ delta)[free])
        beyond = delta + np.where(free, 0.0, score - matrix @ delta)  # by what remains of the score
        before, at_low, at_high = (at_low, at_high), beyond < lowest, beyond > highest
        if np.array_equal(before, (at_low, at_high)):
            return delta
    return None
