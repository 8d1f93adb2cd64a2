"""Numbers with 95 % intervals, from trials that have noise of their own and scatter among themselves."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..toml import Interval

_CLIPPED = 1.345  # robust standard deviations from Huber's mean: a value beyond counts as one there


class Estimate(msgspec.Struct, frozen=True, kw_only=True):
    """A number and its 95 % interval (null ends: infinite), in the unit of the key that holds it."""

    value: float
    ci95: Interval


class Line(NamedTuple):
    """A weighted linear fit of n values by k parameters."""

    values: FloatArray  # of the parameters, (k,)
    ci95: FloatArray  # their 95 % intervals, (k, 2)
    weights: FloatArray  # of the fitted values, (n,)
    squares: float  # weighted sum of squared residuals
    freedom: int  # of the residuals: n less the rank of the design

    def p_against(self, simpler: Line) -> float:
        """P of the hypothesis that a simpler design, nested in this one, explains as much: an F-test."""
        from scipy.stats import f

        more = simpler.freedom - self.freedom
        ratio = (simpler.squares - self.squares) / more / (self.squares / self.freedom)
        return float(f.sf(ratio, more, self.freedom))


def t_quantile(freedom: float) -> float:
    """The 97.5 % point of Student's t distribution."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.975))


def mean(values: FloatArray) -> Estimate:
    """Mean of independent values with its t-interval; the interval of a single value is infinite."""
    middle = float(values.mean()) if len(values) else np.nan
    if len(values) < 2:
        return Estimate(value=middle, ci95=(-np.inf, np.inf))
    half = t_quantile(len(values) - 1) * float(values.std(ddof=1) / np.sqrt(len(values)))
    return Estimate(value=middle, ci95=(middle - half, middle + half))


def robust(values: FloatArray) -> Estimate:
    """Huber's mean: an outlier counts no more than a value at Huber's bound."""
    from scipy.special import ndtri
    from scipy.stats import median_abs_deviation

    n = len(values)
    if n < 3 or not median_abs_deviation(values, scale="normal") > 0.0:
        return mean(values)
    middle, size, bound = float(values.mean()), np.abs(values - values.mean()), 0.0
    for _ in range(500):
        bound = _CLIPPED * float(np.median(size)) / ndtri(0.75)
        before, middle = middle, float(np.average(values, weights=bound / np.maximum(size, bound)))
        size = np.abs(values - middle)
        if abs(middle - before) <= 1e-9 * bound:
            break
    # its standard error: Huber, Robust Statistics, 1981, eq. 7.6.5
    within = float(np.mean(size < bound))
    sd = (float(np.sum(np.minimum(size, bound) ** 2)) / n / (n - 1)) ** 0.5 / within
    half = t_quantile(n - 1) * sd * (1.0 + (1.0 - within) / within / n)
    return Estimate(value=middle, ci95=(middle - half, middle + half))


def common(values: FloatArray, sd: FloatArray) -> Estimate:
    """The common value of trials, by random-effects meta-analysis; arguments as of :func:`regression`."""
    if len(values) < 2:
        return mean(values)
    regressed = regression(values, sd, np.ones((len(values), 1)))
    low, high = regressed.ci95[0].tolist()
    return Estimate(value=float(regressed.values[0]), ci95=(low, high))


def regression(values: FloatArray, sd: FloatArray, design: FloatArray) -> Line:
    """Random-effects regression of values (n,) by a design (n, k) with weights 1/(sd² + between²).

    The ``sd`` of each value is by the noise within its trial, (n,); zeros give least squares with equal weights. The
    variance between trials is the one that makes the weighted squares equal to their degrees of freedom (Paule &
    Mandel, J. Res. NBS 87, 1982). The intervals are Knapp and Hartung's (Statistics in Medicine 22, 2003).
    """
    from scipy.optimize import brentq

    least = 1e-9 * float(np.abs(values).max()) + 1e-150
    if np.isfinite(sd).sum() <= design.shape[1]:
        sd = np.zeros(len(values))  # the noise does not distinguish the trials: equal weights

    def fitted(between: float) -> Line:
        return fit_weighted(values, 1.0 / (sd**2 + between**2 + least**2), design)

    def excess(between: float) -> float:
        estimate = fitted(between)
        return estimate.squares - estimate.freedom

    widest = 3.0 * float(np.ptp(values)) + least
    return fitted(float(brentq(excess, 0.0, widest)) if excess(0.0) > 0.0 > excess(widest) else 0.0)


def fit_weighted(values: FloatArray, weights: FloatArray, design: FloatArray) -> Line:
    """Weighted least squares of values (n,) by a design (n, k), whose columns may depend on one another."""
    root = np.sqrt(weights)
    inverse = np.linalg.pinv(design * root[:, None])
    fitted = inverse @ (values * root)
    left, freedom = (values - design @ fitted) * root, len(values) - int(np.linalg.matrix_rank(design))
    squares = float(left @ left)
    half = t_quantile(freedom) * np.sqrt(np.sum(inverse**2, axis=1) * squares / freedom) if freedom else np.inf
    return Line(fitted, np.stack((fitted - half, fitted + half), axis=1), weights, squares, freedom)
