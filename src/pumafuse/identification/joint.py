"""One plant for many trials: q and p shared, every trial with a delay, a gain and a zero of its own.

A delay that jitters from step to step would look like lag if it were shared. Each trial weighs by its own noise:
neither large steps nor noisy ones rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from .estimate import Estimate, t_quantile
from .fit import StepFit
from .rows import Order, Point, Rows
from .trials import Trial

_STARTS = (0.0, 0.05, 0.15, 0.25, 0.4, 1.0)  # p/q² to begin with
_NOISELESS = 1e-6  # of the step: less noise than this is none
_RESOLVED = 1e-9  # of the information in 1/ω², what must be left when delay and q have had their share


@dataclass(frozen=True)
class Parts:
    """Each trial's part in q and p; of first order what belongs to p is 0.

    Attributes:
        influence: n times each trial's part in the errors of q and p, which are their mean; corrected for its leverage,
            (n, 2).
        expected: What its noise lets expect of each trial's influence, (n, 2, 2).
        information: Of each trial in q (and p), whatever its delay does, (n, k, k).
        coupling: −∂Td/∂(q, p), (n, k).
        delay_sd: Of each Td by the trial's noise [s], infinite where it tells nothing, (n,).
    """

    influence: FloatArray
    expected: FloatArray
    information: FloatArray
    coupling: FloatArray
    delay_sd: FloatArray

    def half_width(self, slope: Sequence[float]) -> float:
        """Half the 95 % interval of a quantity that follows q and p with ``slope`` (2,).

        Clustered by trial, with a t distribution of as many degrees of freedom as trials have a say (Bell & McCaffrey,
        Survey Methodology 28, 2002): a few large steps may outweigh the others.
        """
        c, n = np.asarray(slope), len(self.influence)
        variance = float(np.sum((self.influence @ c) ** 2)) / n**2
        shares = np.einsum("i,nij,j->n", c, self.expected, c)
        freedom = max(float(shares.sum() ** 2 / np.sum(shares**2)) * (n - 1) / n, 1.0) if shares.any() else 1.0
        return float(t_quantile(freedom) * np.sqrt(variance))


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
        left: What is left of each trial, over its noise, (n, m).
        parts: Each trial's in q and p.
        delay_slope: ∂Td/∂(q, p).
        gain_slope: ∂K/∂(q, p).
        gain_sd: Of each K by the trial's noise.
    """

    q: float
    p: float
    delay: FloatArray
    gain: FloatArray
    rms: FloatArray
    count: FloatArray
    cost: float
    left: FloatArray
    parts: Parts
    delay_slope: FloatArray
    gain_slope: FloatArray
    gain_sd: FloatArray


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
    # what a trial tells best is the area over its response
    lag = np.array([fit.shape.delay + fit.shape.q for fit in own])
    middle = float(np.median([fit.shape.q for fit in own]))
    found: list[Point] = []
    for ratio in _STARTS[: 1 if order == 1 else None]:
        q = middle if ratio == 0.0 else 1.3 * middle
        found.append(rows.together(q, ratio * q * q, np.maximum(lag - q, 0.0), order))
    best = min(found, key=lambda point: float(point.cost.sum()))
    return _result(rows, best, order, step, noise)


def _result(rows: Rows, at: Point, order: Order, step: FloatArray, noise: FloatArray) -> JointFit:
    n, p = len(step), at.shape[:, 2]
    slopes, amplitude_slopes = rows.slopes(at, order)
    parts = _parts(rows, at, slopes)
    if order == 2 and not _resolved(parts, slopes):
        # a pole much faster than the sampling is like a delay: it is only known how slow it can be
        slopes, amplitude_slopes = rows.slopes(at, order, (p, np.median(rows.spacing) * at.shape[:, 1]))
        parts = _parts(rows, at, slopes)
    delay_slope, gain_slope = np.zeros((n, 2)), np.zeros((n, 2))
    delay_slope[:, :order] = -parts.coupling
    gain_slope[:, :order] = (amplitude_slopes[1:] - parts.coupling.T * amplitude_slopes[0]).T / step[:, None]
    told = np.isfinite(parts.delay_sd)
    by_delay = np.where(told, amplitude_slopes[0] * np.where(told, parts.delay_sd, 0.0), np.inf)
    return JointFit(
        q=float(at.shape[0, 1]),
        p=float(p[0]),
        delay=at.shape[:, 0],
        gain=at.amplitude / step,
        rms=np.sqrt(at.cost / rows.count) * noise,
        count=rows.count,
        cost=float(at.cost.sum()),
        parts=parts,
        left=at.left,
        delay_slope=delay_slope,
        gain_slope=gain_slope,
        gain_sd=np.hypot(1.0 / np.sqrt(np.sum(at.unit**2, axis=1)), by_delay) / np.abs(step),
    )


def inverse_square(first: JointFit, second: JointFit) -> Estimate:
    """1/ω² with an interval that holds 0 unless the trials agree that second order fits them better.

    Whether it may be 0 is asked of the way between the two fits, refitted at both ends: p/p̂ is 1 at one and 0 at the
    other, and a trial's part in it is how far its residuals there want to go back. A slope at p̂ would not do: the
    response bends on the way, and near 0 it is flat.
    """
    n, p = len(second.delay), second.p
    half = second.parts.half_width([0.0, 1.0])
    if p == 0.0:
        # held at 0, the trials' parts do not sum to 0: their mean is how far it would have gone on
        centre = float(second.parts.influence[:, 1].mean())
        return Estimate(value=p, ci95=(min(centre - half, p), max(centre + half, p)))
    way = first.left - second.left
    weight = np.einsum("ij,ij->i", way, way)
    share = weight / max(float(weight.sum()), 1e-300)
    parts = np.einsum("ij,ij->i", second.left, way) / max(float(weight.sum()), 1e-300)
    corrected = parts / np.sqrt(np.maximum(1.0 - share, 1e-3))
    freedom = max((n - 1) / n / float(np.sum(share**2)), 1.0) if weight.any() else 1.0
    across = t_quantile(freedom) * float(np.sqrt(np.sum(corrected**2)))  # of p/p̂
    may_be_zero = not weight.any() or across >= 1.0 + float(parts.sum())
    half = max(half, p * across, p) if may_be_zero else min(half, p * max(across, 0.5))
    return Estimate(value=p, ci95=(p - half, p + half))


def _parts(rows: Rows, at: Point, slopes: FloatArray) -> Parts:
    n, k = len(at.shape), len(slopes) - 1
    found = rows.equations(at, slopes)
    corrected = n * _corrected(found.information)
    influence, expected = np.zeros((n, 2)), np.zeros((n, 2, 2))
    influence[:, :k] = np.einsum("ijk,ik->ij", corrected, found.score)
    expected[:, :k, :k] = corrected @ found.information @ corrected.swapaxes(1, 2)
    return Parts(influence, expected, found.information, found.coupling, found.delay_sd)


def _corrected(information: FloatArray) -> FloatArray:
    """H^(−1/2) (I − h)^(−1/2) H^(−1/2) of each trial's information, h its share of H (HC2), (n, k, k)."""
    diagonal = np.einsum("nii->i", information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, np.inf))
    scaled = information * np.outer(scale, scale)
    value, vector = np.linalg.eigh(scaled.sum(axis=0))
    root = vector / np.sqrt(np.maximum(value, 1e-14)) @ vector.T
    left, basis = np.linalg.eigh(np.eye(len(scale)) - root @ scaled @ root)
    inverse_root = basis / np.sqrt(np.maximum(left, 1e-3))[:, None, :] @ basis.swapaxes(1, 2)
    return root @ inverse_root @ root * np.outer(scale, scale)


def _resolved(parts: Parts, slopes: FloatArray) -> bool:
    """Whether anything of the information in 1/ω² is left when delay and q have had their share."""
    information = parts.information.sum(axis=0)
    if not information[0, 0] > 0.0:
        return False
    left = information[1, 1] - information[0, 1] ** 2 / information[0, 0]
    return bool(left > _RESOLVED * float(np.sum(slopes[-1] ** 2)))
