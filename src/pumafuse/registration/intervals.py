"""Intervals of numbers from what each row does to them, where rows that follow each other err alike.

What an arm does not do as commanded goes on for a second or more: thousands of rows say little more than some dozens.
The sum of the autocovariances of the rows' influences is the variance of a number (Newey and West 1987), up to a
window of so many times the time for which the influences are alike (Sokal 1997); as uncertain as that sum is itself,
the quantile is Student's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit

from ..arrays import FloatArray

_WINDOW = 5.0  # autocorrelation times: beyond them exp(-5) is left
_FITTED = 17.0  # numbers at most: they take as many degrees of freedom, here half of them at most
_LEVEL = 0.975  # both sides 95 %


def half_widths(influence: FloatArray, lengths: Sequence[int]) -> FloatArray:
    """Half the 95 % interval of each number.

    Args:
        influence: By how much each row moves each number, (n, q), in order of time.
        lengths: Rows of each run.
    """
    rows = np.split(influence, np.cumsum(lengths)[:-1])
    most = min(lengths) // 3
    covariance = np.sum([_autocovariance(one, most) for one in rows], axis=0)
    return np.array([_half_width(one, sum(lengths)) for one in covariance.T])


def _autocovariance(influence: FloatArray, most: int) -> FloatArray:
    """Sums of products of rows that are 0, 1, ... apart, (most + 1, q)."""
    size = 2 ** (len(influence) + most).bit_length()
    return np.fft.irfft(np.abs(np.fft.rfft(influence, size, axis=0)) ** 2, size, axis=0)[: most + 1]


def _half_width(covariance: FloatArray, count: int) -> float:
    """From the autocovariances of one number's influences."""
    if covariance[0] <= 0.0:
        return 0.0
    time = 2.0 * np.cumsum(covariance) / covariance[0] - 1.0  # of the influences' alikeness, by window
    enough = np.flatnonzero(np.arange(len(time)) >= _WINDOW * np.maximum(time, 1.0))
    window = int(enough[0]) if len(enough) else len(time) - 1
    free = count / (2.0 * window + 1.0)
    return float(np.sqrt(covariance[0] * max(time[window], 0.5)) * stdtrit(max(free, 1.0), _LEVEL))
