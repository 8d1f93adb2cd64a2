"""One plant for many trials: q and p are shared, every trial has a delay, a gain and a zero of its own.

A shared delay would make the lag too large where the delay jitters from step to step. Each trial is weighted by its own
noise, so that neither large steps nor noisy ones dominate. Errors are clustered by trial (HC2 sandwich).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from .batch import Batch, Equations, Order, Point
from .estimate import Estimate, t_quantile
from .fit import ALIKE, StepFit
from .trials import Trial

_STARTS = (0.0, 0.05, 0.15, 0.25, 0.4, 1.0)  # p/q² to search from
_NOISELESS = 1e-6  # of the step: less noise than this is none


@dataclass(frozen=True)
class JointFit:
    """The plant that fits all trials best. Arrays are in the order of the trials, (n,), or (n, 2) for q and p."""

    q: float  # 2ζ/ω, or τ [s]
    p: float  # 1/ω² [s²]; 0 of first order
    delay: FloatArray  # Td of each trial under this plant [s]
    gain: FloatArray  # K likewise
    rms: FloatArray  # of the residuals of each trial [m]
    count: FloatArray  # samples of each
    cost: float  # sum of squared residuals, each trial's over its own noise
    residual: FloatArray  # of each trial, over its noise, (n, m)
    # of each trial on q and p (0 of first order), times n: their mean is the error. HC2-corrected
    influence: FloatArray
    expected: FloatArray  # covariance of each influence by the noise within the trial, (n, 2, 2)
    delay_sd: FloatArray  # of each Td by the trial's noise [s], infinite where it is not identifiable
    delay_slope: FloatArray  # ∂Td/∂(q, p)
    gain_slope: FloatArray  # ∂K/∂(q, p)
    gain_sd: FloatArray  # of each K by the trial's noise

    def half_width(self, slope: Sequence[float]) -> float:
        """Half the 95 % interval of a quantity whose gradient by (q, p) is ``slope`` (2,).

        Clustered by trial, with a t distribution of as many degrees of freedom as trials effectively contribute (Bell &
        McCaffrey, Survey Methodology 28, 2002): a few large steps may outweigh the others.
        """
        c, n = np.asarray(slope), len(self.influence)
        variance = float(np.sum((self.influence @ c) ** 2)) / n**2
        shares = np.einsum("i,nij,j->n", c, self.expected, c)
        freedom = max(float(shares.sum() ** 2 / np.sum(shares**2)) * (n - 1) / n, 1.0) if shares.any() else 1.0
        return float(t_quantile(freedom) * np.sqrt(variance))


def fit_together(trials: Sequence[Trial], step_fits: Sequence[StepFit], order: Order) -> JointFit:
    """Fit one plant of an order to all trials of an axis; the RMS of each trial's ``step_fits`` fit is its noise."""
    step = np.array([trial.step for trial in trials])
    noise = np.maximum([fit.rms for fit in step_fits], _NOISELESS * np.abs(step))
    batch = Batch.of(trials, (1.0 / noise).tolist())
    # a trial determines the area over its response best
    lag = np.array([fit.shape.delay + fit.shape.q for fit in step_fits])
    middle = float(np.median([fit.shape.q for fit in step_fits]))
    n, starts = len(step), list[FloatArray]()
    for ratio in _STARTS[: 1 if order == 1 else None]:
        q = middle if ratio == 0.0 else 1.3 * middle
        starts.append(np.stack(np.broadcast_arrays(np.maximum(lag - q, 0.0), q, ratio * q * q), axis=1))
    fits = batch.take(np.tile(np.arange(n), len(starts))).fit(np.concatenate(starts), order, size=n)
    cost = fits.cost.reshape(-1, n).sum(axis=1)
    best = int((cost <= (1.0 + ALIKE) * cost.min()).argmax())
    at = Point(*(every[best * n : (best + 1) * n] for every in fits))
    slopes, amplitude_slopes = batch.slopes(at, order)
    equations = batch.equations(at, slopes)
    influence, expected = _influence(equations)
    delay_slope, gain_slope = np.zeros((n, 2)), np.zeros((n, 2))
    delay_slope[:, :order] = -equations.coupling
    gain_slope[:, :order] = (amplitude_slopes[1:] - equations.coupling.T * amplitude_slopes[0]).T / step[:, None]
    is_known = np.isfinite(equations.delay_sd)
    by_delay = np.where(is_known, amplitude_slopes[0] * np.where(is_known, equations.delay_sd, 0.0), np.inf)
    return JointFit(
        q=float(at.shape[0, 1]),
        p=float(at.shape[0, 2]),
        delay=at.shape[:, 0],
        gain=at.amplitude / step,
        rms=np.sqrt(at.cost / batch.count) * noise,
        count=batch.count,
        cost=float(at.cost.sum()),
        residual=at.residual,
        influence=influence,
        expected=expected,
        delay_sd=equations.delay_sd,
        delay_slope=delay_slope,
        gain_slope=gain_slope,
        gain_sd=np.hypot(1.0 / np.sqrt(np.sum(at.unit**2, axis=1)), by_delay) / np.abs(step),
    )


def inverse_square(first: JointFit, second: JointFit) -> Estimate:
    """1/ω² with an interval that contains 0 unless the trials agree that second order fits them better.

    Whether it may be 0 is tested on the line between the residuals of both fits: p/p̂ is 1 at one end and 0 at the
    other, and each trial's score is how far its residuals there want to go back. The derivative at p̂ would mislead:
    the response is curved in between, and near 0 it is flat.
    """
    n, p = len(second.delay), second.p
    half = second.half_width([0.0, 1.0])
    if p == 0.0:
        # at the bound the influences do not sum to 0: their mean is how far p would have gone below it
        centre = min(float(second.influence[:, 1].mean()), 0.0)
        upper = centre + half
        return Estimate(value=p, ci95=(-np.inf, upper if upper > 0.0 else half))
    line = first.residual - second.residual
    weight = np.einsum("ij,ij->i", line, line)
    total = max(float(weight.sum()), 1e-300)
    share, score = weight / total, np.einsum("ij,ij->i", second.residual, line) / total
    corrected = score / np.sqrt(np.maximum(1.0 - share, 1e-3))
    freedom = max((n - 1) / n / float(np.sum(share**2)), 1.0) if weight.any() else 1.0
    across = t_quantile(freedom) * float(np.sqrt(np.sum(corrected**2)))  # of p/p̂
    may_be_zero = not weight.any() or across >= 1.0 + float(score.sum())
    half = max(half, p * across, p) if may_be_zero else min(half, p * max(across, 0.5))
    return Estimate(value=p, ci95=(p - half, p + half))


def _influence(equations: Equations) -> tuple[FloatArray, FloatArray]:
    """Influence of each trial (n, 2) and its covariance by the noise (n, 2, 2); see :class:`JointFit`."""
    n, k = equations.score.shape
    corrected = n * _correct(equations.information)
    influence, expected = np.zeros((n, 2)), np.zeros((n, 2, 2))
    influence[:, :k] = np.einsum("ijk,ik->ij", corrected, equations.score)
    expected[:, :k, :k] = corrected @ equations.information @ corrected.swapaxes(1, 2)
    return influence, expected


def _correct(information: FloatArray) -> FloatArray:
    """H^(−1/2) (I − h)^(−1/2) H^(−1/2) of each trial's information, h its share of H (HC2), (n, k, k)."""
    diagonal = np.einsum("nii->i", information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, np.inf))
    scaled = information * np.outer(scale, scale)
    value, vector = np.linalg.eigh(scaled.sum(axis=0))
    root = vector / np.sqrt(np.maximum(value, 1e-14)) @ vector.T
    remaining, basis = np.linalg.eigh(np.eye(len(scale)) - root @ scaled @ root)
    inverse_root = basis / np.sqrt(np.maximum(remaining, 1e-3))[:, None, :] @ basis.swapaxes(1, 2)
    return root @ inverse_root @ root * np.outer(scale, scale)
