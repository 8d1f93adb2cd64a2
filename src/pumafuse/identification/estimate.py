"""Numbers with 95 % intervals, from trials that have noise of their own and scatter among themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..toml import Interval

if TYPE_CHECKING:
    from statsmodels.regression.linear_model import RegressionResults


class Estimate(msgspec.Struct, frozen=True, kw_only=True):
    """A number and its 95 % interval (null ends: infinite), in the unit of the key that holds it."""

    value: float
    ci95: Interval


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
    from scipy.stats import median_abs_deviation
    from statsmodels.robust.robust_linear_model import RLM

    if len(values) < 3 or not median_abs_deviation(values, scale="normal") > 0.0:
        return mean(values)
    found = RLM(values, np.ones(len(values))).fit(maxiter=500)
    middle, half = float(found.params[0]), t_quantile(len(values) - 1) * float(found.bse[0])
    return Estimate(value=middle, ci95=(middle - half, middle + half))


def common(values: FloatArray, sd: FloatArray) -> Estimate:
    """The common value of trials, by random-effects meta-analysis.

    Args:
        values: One of each trial, (n,).
        sd: Standard deviation of each by the noise within its trial, (n,).
    """
    if len(values) < 2:
        return mean(values)
    found = regression(values, sd, np.ones((len(values), 1)))
    low, high = found.conf_int()[0].tolist()
    return Estimate(value=float(found.params[0]), ci95=(low, high))


def regression(values: FloatArray, sd: FloatArray, design: FloatArray) -> RegressionResults:
    """Random-effects regression with weights 1/(sd² + between²).

    The variance between trials is the one that makes the weighted squares equal to their degrees of freedom (Paule &
    Mandel, J. Res. NBS 87, 1982). The intervals are Knapp and Hartung's (Statistics in Medicine 22, 2003).

    Args:
        values: (n,).
        sd: As in :func:`common`; zeros give least squares with equal weights, (n,).
        design: (n, k).
    """
    from scipy.optimize import brentq
    from statsmodels.regression.linear_model import WLS

    least = 1e-9 * float(np.abs(values).max()) + 1e-150
    if np.isfinite(sd).sum() <= design.shape[1]:
        sd = np.zeros(len(values))  # the noise does not distinguish the trials: equal weights

    def fitted(between: float) -> RegressionResults:
        return WLS(values, design, weights=1.0 / (sd**2 + between**2 + least**2)).fit()

    def excess(between: float) -> float:
        found = fitted(between)
        return float(found.ssr) - float(found.df_resid)

    widest = 3.0 * float(np.ptp(values)) + least
    return fitted(float(brentq(excess, 0.0, widest)) if excess(0.0) > 0.0 > excess(widest) else 0.0)
