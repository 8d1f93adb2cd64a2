"""Stationary Gaussian processes that revert to 0, drawn exactly at any instants: a disturbance, a drifting bias.

Ornstein-Uhlenbeck: over an interval Δ, d⁺ = e^(−λΔ) d + n, var n = σ²(1 − e^(−2λΔ)), λ = 1 / time.

Smoothness 3/2 with λ = √3 / time is two of them in series. With v = ḋ + λ d, white noise W of density 4 λ³ σ²:

    v̇ = −λ v + W,   ḋ = −λ d + v:   v⁺ = e^(−λΔ) v + n_v,   d⁺ = e^(−λΔ) (d + Δ v) + n_d

and the covariance of (n_v, n_d) is that of (v, d) at stationarity, [2λ² λ; λ 1] σ², each entry times a regularised
incomplete gamma function P(1), P(2), P(3) of 2λΔ: nothing cancels over short intervals.
"""

from __future__ import annotations

import math

import numpy as np

from ..arrays import ComplexArray, FloatArray, TimeArray


def sum_of_decays(decay: ComplexArray, added: ComplexArray) -> ComplexArray:
    """z_n = decay_n · z_(n−1) + added_n from z = 0, by doubling strides."""
    factor, total, stride = decay.copy(), added.copy(), 1
    while stride < len(total) and np.abs(factor[stride:]).max() > 1e-30:
        total[stride:] += factor[stride:] * total[:-stride].copy()
        factor[stride:] *= factor[:-stride].copy()
        factor[:stride] = 0.0
        stride *= 2
    return total


def rough(time: TimeArray, sd: float, length: float, rng: np.random.Generator) -> FloatArray:
    """An Ornstein-Uhlenbeck process of this ``sd`` at ``time`` (int64 ns, ascending, (n,)); ``length`` [s], (n,)."""
    fading = -np.diff(time) / 1e9 / length
    share = np.concatenate((np.ones(min(len(time), 1)), np.sqrt(-np.expm1(2.0 * fading))))
    return _sum(fading, sd * share * rng.standard_normal(len(time)))


def smooth(time: TimeArray, sd: float, length: float, rng: np.random.Generator) -> FloatArray:
    """A Matérn process of smoothness 3/2 and this ``sd`` at ``time`` (int64 ns, ascending, (n,)); ``length`` [s], (n,).

    ``length`` is the time of its covariance σ² (1 + λ|s|) exp(−λ|s|), λ = √3 / length.
    """
    from scipy.special import gammainc

    rate, interval = math.sqrt(3.0) / length, np.diff(time) / 1e9
    distinct, row = np.unique(interval, return_inverse=True)
    begun = np.ones((3, 1))  # stationarity is where an endless interval leads
    p1, p2, p3 = np.hstack((begun, gammainc(np.array([[1.0], [2.0], [3.0]]), 2.0 * rate * distinct)[:, row]))
    first, second = rng.standard_normal((2, len(time)))
    sd_v = rate * np.sqrt(2.0 * p1)  # the covariance's Cholesky factor [sd_v 0; along across]
    along = np.divide(rate * p2, sd_v, out=np.zeros(len(time)), where=sd_v > 0.0)
    across = np.sqrt(np.maximum(p3 - along**2, 0.0))
    v = _sum(-rate * interval, sd * sd_v * first)
    fed = sd * (along * first + across * second)
    fed[1:] += interval * np.exp(-rate * interval) * v[:-1]
    return _sum(-rate * interval, fed)


def _sum(fading: FloatArray, added: FloatArray) -> FloatArray:
    """A process from what it ``added`` at each instant, (n,), and the logarithm by which it faded between, (n − 1,)."""
    decay = np.concatenate((np.zeros(min(len(added), 1)), np.exp(fading)))
    return sum_of_decays(decay.astype(np.complex128), added.astype(np.complex128)).real
