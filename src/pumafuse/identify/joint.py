"""One plant for many trials: q and p shared, every trial with a delay, a gain and a zero of its own.

A delay that jitters from step to step would look like lag if it were shared. Each trial weighs by its own noise:
neither large steps nor noisy ones rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from ..arrays import FloatArray
from .fit import StepFit
from .rows import Order, Point, Rows
from .trials import Trial

_STARTS = (0.0, 0.05, 0.15, 0.25, 0.4, 1.0)  # p/q² to begin with
_NOISELESS = 1e-6  # of the step: less noise than this is none
_RESOLVED = 1e-9  # of the information in 1/ω², what must be left when delay and q have had their share


@dataclass(frozen=True)
class JointFit:
    """The plant that fits all trials best. Arrays are in the order of the trials, (n,), or (n, 2) for q and p.

    Attributes:
        q: 2ζ/ω, or τ [s].
        p: 1/ω² [s²]; 0 of first order.
        delay: Td of each trial under this plant [s].
        gain: K likewise.
        rms: Of what is left of each trial [m].
        count: Samples of each.
        cost: Sum of squares of what is left, each trial's over its own noise.
        influence: n times each trial's part in the errors of q and p, their mean; corrected for its leverage.
        expected: What its noise lets expect of each trial's influence, (n, 2, 2).
        delay_slope: ∂Td/∂(q, p).
        gain_slope: ∂K/∂(q, p).
        delay_sd: Of each Td by the trial's noise [s].
        gain_sd: Of each K likewise.
    """

    q: float
    p: float
    delay: FloatArray
    gain: FloatArray
    rms: FloatArray
    count: FloatArray
    cost: float
    influence: FloatArray
    expected: FloatArray
    delay_slope: FloatArray
    gain_slope: FloatArray
    delay_sd: FloatArray
    gain_sd: FloatArray

    def half_width(self, slope: Sequence[float]) -> float:
        """Half the 95 % interval of a quantity that follows q and p with ``slope`` (2,).

        Clustered by trial, with a t distribution of as many degrees of freedom as trials have a say (Bell & McCaffrey,
        Survey Methodology 28, 2002): a few large steps may outweigh the others.
        """
        c, n = np.asarray(slope), len(self.delay)
        variance = float(np.sum((self.influence @ c) ** 2)) / n**2
        shares = np.einsum("i,nij,j->n", c, self.expected, c)
        freedom = max(float(shares.sum() ** 2 / np.sum(shares**2)) * (n - 1) / n, 1.0) if shares.any() else 1.0
        return float(stdtrit(freedom, 0.975) * np.sqrt(variance))


def fit_together(trials: Sequence[Trial], own: Sequence[StepFit], order: Order, samples: int | None) -> JointFit:
    """Fit one plant to all trials.

    Args:
        trials: Of one axis.
        own: The fit of each by itself, whose RMS is its noise.
        order: Of the plant.
        samples: Use only so many from each step on; all for None.
    """
    step = np.array([trial.step for trial in trials])
    noise = np.maximum([fit.rms for fit in own], _NOISELESS * np.abs(step))
    rows = Rows.of(trials, (1.0 / noise).tolist(), samples)
    lag = np.array(
        [fit.shape.delay + fit.shape.q for fit in own]
    )  # what a trial tells best: the area over its response
    middle = float(np.median([fit.shape.q for fit in own]))
    found: list[Point] = []
    for ratio in _STARTS[: 1 if order == 1 else None]:
        q = middle if ratio == 0.0 else 1.3 * middle
        found.append(rows.together(q, ratio * q * q, np.maximum(lag - q, 0.0), order))
    best = min(found, key=lambda point: float(point.cost.sum()))
    return _result(rows, best, order, step, noise)


def _result(rows: Rows, at: Point, order: Order, step: FloatArray, noise: FloatArray) -> JointFit:
    slopes, amplitude_slopes = rows.slopes(at, order)
    equations = rows.equations(slopes, at.left)
    if order == 2 and not _resolved(equations.information.sum(axis=0), float(np.sum(slopes[-1] ** 2))):
        # a second pole much faster than the sampling is like a delay: what is known of 1/ω² is how large it can be
        reach = float(np.median(rows.spacing)) / float(at.shape[0, 1])
        slopes, amplitude_slopes = rows.slopes(at, order, reach)
        equations = rows.equations(slopes, at.left)
    n = len(step)
    influence, delay_slope, gain_slope = (np.zeros((n, 2)) for _ in range(3))
    expected = np.zeros((n, 2, 2))
    corrected = n * _corrected(equations.information)
    influence[:, :order] = np.einsum("ijk,ik->ij", corrected, equations.score)
    expected[:, :order, :order] = corrected @ equations.information @ corrected.swapaxes(1, 2)
    own = np.sum(slopes[0] ** 2, axis=1)
    delay_sd = 1.0 / np.sqrt(np.where(own > 0.0, own, np.nan))
    power = np.sum(at.unit**2, axis=1)
    gain_sd = np.hypot(1.0 / np.sqrt(power), amplitude_slopes[0] * delay_sd) / np.abs(step)
    delay_slope[:, :order] = -equations.coupling
    gain_slope[:, :order] = (amplitude_slopes[1:] - equations.coupling.T * amplitude_slopes[0]).T / step[:, None]
    return JointFit(
        q=float(at.shape[0, 1]),
        p=float(at.shape[0, 2]),
        delay=at.shape[:, 0],
        gain=at.amplitude / step,
        rms=np.sqrt(at.cost / rows.count) * noise,
        count=rows.count,
        cost=float(at.cost.sum()),
        influence=influence,
        expected=expected,
        delay_slope=delay_slope,
        gain_slope=gain_slope,
        delay_sd=delay_sd,
        gain_sd=gain_sd,
    )


def _corrected(information: FloatArray) -> FloatArray:
    """H^(−1/2) (I − h)^(−1/2) H^(−1/2) of each trial's information, h its share of H (HC2), (n, k, k)."""
    scale = 1.0 / np.sqrt(np.einsum("nii->i", information))
    scaled = information * np.outer(scale, scale)
    value, vector = np.linalg.eigh(scaled.sum(axis=0))
    root = vector / np.sqrt(np.maximum(value, 1e-14)) @ vector.T
    left, basis = np.linalg.eigh(np.eye(len(scale)) - root @ scaled @ root)
    inverse_root = basis / np.sqrt(np.maximum(left, 1e-3))[:, None, :] @ basis.swapaxes(1, 2)
    return root @ inverse_root @ root * np.outer(scale, scale)


def _resolved(information: FloatArray, bare: float) -> bool:
    """Whether anything of the information in 1/ω² is left when delay and q have had their share."""
    left = information[1, 1] - information[0, 1] ** 2 / information[0, 0]
    return bool(left > _RESOLVED * bare)
