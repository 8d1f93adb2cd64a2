"""The unit step response of 1/(p s² + q s + 1); q = 2ζ/ω (or τ) and p = 1/ω² stay finite for a first order."""

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray

_TOGETHER = 0.3  # (T₁ − T₂)/(T₁ + T₂) of two poles below which their exponentials cancel


def unit_response(time: FloatArray | float, q: FloatArray | float, p: FloatArray | float) -> FloatArray:
    """Unit step response c(t) of 1/(p s² + q s + 1), 0 before t = 0; all three broadcast, p ≥ 0 and q > 0.

    Equations 4, 6 and 9, joined at ζ = 1, where 6 and 9 divide by √|ζ² − 1| and lose all digits. Time constants T₁ ≥ T₂
    of an over-damped plant are q/2 ± √(q²/4 − p).
    """
    t, half = np.maximum(time, 0.0), 0.5 * np.asarray(q)
    square = half * half - p
    root = np.sqrt(np.abs(square))
    slow = half + root
    fast = p / slow
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        apart = 1.0 - (slow * np.exp(-t / slow) - np.where(fast > 0.0, fast * np.exp(-t / fast), 0.0)) / (2.0 * root)
        decay, turn = half * t / p, root * t / p
        swinging = 1.0 - np.exp(-decay) * (np.cos(turn) + decay * np.sinc(turn / np.pi))
        # e^(−decay) cosh(turn) would overflow: the slow pole is taken out of both terms
        sinhc = np.where(turn > 0.0, -np.expm1(-2.0 * turn) / (2.0 * turn), 1.0)
        together = 1.0 - np.exp(-t / slow) * (0.5 * (1.0 + np.exp(-2.0 * turn)) + decay * sinhc)
    over_damped = np.where(root > _TOGETHER * half, apart, together)
    return np.where(t > 0.0, np.where(square >= 0.0, over_damped, swinging), 0.0)
