"""The unit step response of 1/(p s² + q s + 1); q = 2ζ/ω (or τ) and p = 1/ω² stay finite for a first order."""

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray

_TOGETHER = 0.3  # (T₁ − T₂)/(T₁ + T₂) of two poles below which their exponentials cancel


def unit_response(time: FloatArray | float, q: FloatArray | float, p: FloatArray | float) -> FloatArray:
    """Unit step response c(t) of 1/(p s² + q s + 1), 0 before t = 0; all three broadcast, p ≥ 0 and q > 0.

    Equations 4, 6 and 9, joined at ζ = 1, where 6 and 9 divide by √|ζ² − 1| and lose all digits.
    """
    half, p = 0.5 * np.asarray(q), np.asarray(p)
    square = half * half - p
    root = np.sqrt(np.abs(square))
    over_damped, apart = square >= 0.0, root > _TOGETHER * half
    forms = (over_damped & apart, _apart), (over_damped & ~apart, _together), (~over_damped, _swinging)
    needed = [(plants, form) for plants, form in forms if plants.any()]
    time, half, root, p, *masks = np.broadcast_arrays(time, half, root, p, *(plants for plants, _ in needed))
    found, begun = np.zeros(time.shape), time > 0.0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # where T₂ or the swing is next to nothing
        for plants, (_, form) in zip(masks, needed, strict=True):
            chosen = plants & begun
            found[chosen] = form(time[chosen], half[chosen], root[chosen], p[chosen])
    return found


def _apart(t: FloatArray, half: FloatArray, root: FloatArray, p: FloatArray) -> FloatArray:
    """Over-damped: time constants T₁ > T₂ are q/2 ± √(q²/4 − p); T₂ may be 0."""
    slow = half + root
    fast = p / slow
    sooner = np.where(fast > 0.0, fast * np.exp(-t / fast), 0.0)
    return 1.0 - (slow * np.exp(-t / slow) - sooner) / (2.0 * root)


def _together(t: FloatArray, half: FloatArray, root: FloatArray, p: FloatArray) -> FloatArray:
    """About ζ = 1: e^(−decay) cosh(turn) would overflow, so that the slow pole is taken out of both terms."""
    turn = root * t / p
    sinhc = np.where(turn > 0.0, -np.expm1(-2.0 * turn) / (2.0 * turn), 1.0)
    return 1.0 - np.exp(-t / (half + root)) * (0.5 * (1.0 + np.exp(-2.0 * turn)) + half * t / p * sinhc)


def _swinging(t: FloatArray, half: FloatArray, root: FloatArray, p: FloatArray) -> FloatArray:
    """Under-damped: e^(−decay) and a swing."""
    decay, turn = half * t / p, root * t / p
    return 1.0 - np.exp(-decay) * (np.cos(turn) + decay * np.sinc(turn / np.pi))
