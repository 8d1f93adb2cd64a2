"""The chi-square distribution: scipy, which has it, takes a quarter of a second to import."""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

_ENOUGH = 1e-15  # of a sum, below which no term counts


def tail(degrees: int, x: float) -> float:
    """P(χ² > x): the regularised incomplete gamma function Q(n/2, x/2).

    Below its mean from the series of P = 1 − Q, above it from Legendre's continued fraction of Q (Abramowitz & Stegun,
    6.5.29 and 6.5.31; Lentz's method).
    """
    a, y = 0.5 * degrees, 0.5 * x
    if y <= 0.0:
        return 1.0
    front = math.exp(a * math.log(y) - y - math.lgamma(a))
    if y < a + 1.0:
        term = total = 1.0 / a
        k = a
        while term > _ENOUGH * total:
            k += 1.0
            term *= y / k
            total += term
        return 1.0 - front * total
    b = y + 1.0 - a
    c, d = math.inf, 1.0 / b
    share, k, ratio = d, 0.0, 0.0
    while abs(ratio - 1.0) > _ENOUGH:
        k += 1.0
        b += 2.0
        d = 1.0 / (b - k * (k - a) * d)
        c = b - k * (k - a) / c
        ratio = c * d
        share *= ratio
    return front * share


@lru_cache(maxsize=1024)
def upper_quantile(degrees: int, share: float) -> float:
    """The x with P(χ² > x) = ``share``: Newton's steps for ln x, from Wilson and Hilferty's approximation."""
    a, width = 0.5 * degrees, math.sqrt(2.0 / (9.0 * degrees))
    cube = 1.0 - width**2 + width * NormalDist().inv_cdf(1.0 - share)
    smallest = 2.0 * math.exp((math.log1p(-share) + math.lgamma(a + 1.0)) / a)  # P ≈ y^a / Γ(a + 1) near 0
    x = max(degrees * cube**3, smallest)
    for _ in range(50):
        density = math.exp(a * math.log(0.5 * x) - 0.5 * x - math.lgamma(a))  # over ln x
        step = (tail(degrees, x) - share) / density
        x *= math.exp(max(min(step, 1.0), -1.0))
        if abs(step) < 1e-14:
            break
    return x
