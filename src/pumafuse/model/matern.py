"""A disturbance that is smooth and reverts: a stationary Gaussian process of smoothness 3/2, for any interval.

Covariance σ² (1 + λ|s|) exp(−λ|s|) with λ = √3 / time: two states, d and its rate, driven by white noise of density
4 λ³ σ². With a = λ t:

    Φ = e^(−a) [ 1 + a, t; −λ² t, 1 − a ],   Q = P∞ − Φ P∞ Φᵀ,   P∞ = diag(σ², λ² σ²)

With a gain of 0, a large σ and a long time (4 λ³ σ² held) the position is that of a constant-velocity filter.
(Rasmussen & Williams, "Gaussian Processes for Machine Learning", 2006, eq. 4.17; Hartikainen & Särkkä, "Kalman
filtering and smoothing solutions to temporal Gaussian process regression models", 2010.)
"""

from __future__ import annotations

import math

from ..compiled import compiled

_SERIES = 1.0  # 2 λ t up to which the rest of the exponential is summed: what 1 − e^(−y)(1 + y + y²/2) would lose
_TERMS = 16


@compiled
def matern(rate: float, dt: float) -> tuple[float, float, float, float, float, float, float]:
    """Φ (f11, f12, f21, f22) and Q (q11, q12, q22) for σ = 1 over ``dt`` [s]; ``rate`` is λ [1/s]."""
    a, y = rate * dt, 2.0 * rate * dt
    left, both = math.exp(-a), math.exp(-y)
    f11, f12, f21, f22 = left * (1.0 + a), left * dt, -left * rate * a, left * (1.0 - a)
    if y < _SERIES:  # e^y − 1 − y − y²/2
        term = rest = y * y * y / 6.0
        for k in range(4, _TERMS + 4):
            term *= y / k
            rest += term
        rest *= both
    else:
        rest = 1.0 - both * (1.0 + y + 0.5 * y * y)
    return f11, f12, f21, f22, rest, 2.0 * rate * a * a * both, rate * rate * (rest + 2.0 * y * both)
