"""Up the likelihood: Fisher scoring from one configuration to the nearest peak.

A step solves (I + λ diag I) δ = g with the score g and the expected information I of all parameters at once; it is
taken where the likelihood itself, gates and all, is better there (λ as Levenberg and Marquardt have it; Osborne,
"Fisher's method of scoring", International Statistical Review 60, 1992). Numbers that have a prior are moved by it too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..fusion.config import FusionConfig
from ..fusion.ticks import usable_cores
from .likelihood import Evidence, Slopes, Value
from .parameters import Parameter, coordinates, moved
from .variants import with_axis_of

_ITERATIONS = 60
_ENOUGH = 2e-3  # expected gain in log-likelihood that is not worth another step
_LEAST = 1e-4  # damping to begin with
_ROUNDING = 1e-10  # of a matrix with a diagonal of 1, below which its eigenvalues say nothing
_STUBBORN = 1e8  # damping at which no step will do
_DOUBLES = (2.0, 4.0, 8.0)
_SETTLING = 12  # times that the gates are asked again
_BUMPS = tuple(sign * shift for shift in (2e-4, 5e-4, 1e-3, 2e-3) for sign in (-1.0, 1.0))  # s
_SHARES = (1.0, 0.5, 0.2)
_REACH = 1.5  # longest step of a coordinate, in its scale


@dataclass(frozen=True)
class Point:
    """A configuration and what the measurements say of it.

    Attributes:
        config: The configuration.
        value: Its log-likelihood.
        prior: Logarithm of the prior density of each axis's numbers (what all share at the first), but for a constant,
            (A,).
    """

    config: FusionConfig
    value: Value
    prior: FloatArray

    @property
    def heights(self) -> FloatArray:
        """What is maximised, of each axis, (A,)."""
        return self.value.axes + self.prior

    @property
    def height(self) -> float:
        """What is maximised."""
        return float(self.heights.sum())


Tell: TypeAlias = Callable[[Point], None]


def point(
    evidence: Evidence,
    config: FusionConfig,
    free: Sequence[Parameter],
    outcomes: Sequence[CodeArray] | None = None,
) -> Point:
    """What the measurements and the priors say of a configuration; with ``outcomes`` whatever its gates would say."""
    prior = np.zeros(len(evidence.axes))
    for one in free:
        if one.prior is not None:
            z = (one.at(config) - one.prior[0]) / one.prior[1]
            prior[0 if one.axis is None else evidence.axes.index(one.axis)] -= 0.5 * z * z
    return Point(config, evidence.value(config, outcomes), prior)


def slopes(evidence: Evidence, at: Point, free: Sequence[Parameter]) -> Slopes:
    """Score and information at a point, the priors' shares in them."""
    found = evidence.slopes(at.config, free, at.value.outcomes)
    score, information = found.score.copy(), found.information.copy()
    for number, one in enumerate(free):
        if one.prior is not None:
            middle, sd = one.prior
            score[number] -= (one.at(at.config) - middle) / sd**2
            information[number, number] += 1.0 / sd**2
    return Slopes(score, information)


def climb(
    evidence: Evidence,
    start: FusionConfig,
    free: Sequence[Parameter],
    tell: Tell = lambda _: None,
    outcomes: Sequence[CodeArray] | None = None,
    enough: float = _ENOUGH,
) -> Point:
    """The nearest maximum.

    Args:
        evidence: The measurements.
        start: From here.
        free: What may move.
        tell: Called with each better point.
        outcomes: What became of each component, to be repeated; None: the gates decide.
        enough: Gain in log-likelihood that is not worth another step.
    """
    best = point(evidence, start, free, outcomes)
    if not free:
        return best
    low, high = np.array([one.range for one in free]).T
    reach = _REACH * np.array([one.scale for one in free])
    axis = np.array([-1 if one.axis is None else evidence.axes.index(one.axis) for one in free])
    damping = np.full(len(free), _LEAST)
    for _ in range(_ITERATIONS):
        at = coordinates(best.config, free)
        found = slopes(evidence, best, free)
        failed = False
        while True:
            step = _step(found, np.maximum(low - at, -reach), np.minimum(high - at, reach), damping)
            expected = float(found.score @ step) - 0.5 * float(step @ found.information @ step)
            if not expected > 0.0 or damping.min() > _STUBBORN:
                return best
            trial = point(evidence, moved(best.config, free, at + step), free, outcomes)
            gained = trial.height - best.height
            worse = np.append(trial.heights < best.heights, gained < 0.0)[axis]
            if gained > 0.0:
                damping = np.where(worse, 10.0 * damping, 0.1 * damping)
                break
            damping = np.where(worse | failed, 10.0 * np.maximum(damping, _LEAST), damping)
            failed = True
            if expected < enough:
                return best
        best = _farther(evidence, best, trial, step, free, outcomes, low, high)
        tell(best)
        if expected < enough and gained < enough:
            return best
    return best


def _farther(
    evidence: Evidence,
    start: Point,
    trial: Point,
    step: FloatArray,
    free: Sequence[Parameter],
    outcomes: Sequence[CodeArray] | None,
    low: FloatArray,
    high: FloatArray,
) -> Point:
    """The best of a step and its doubles in the box: along a valley the information promises too short ones."""
    at = coordinates(start.config, free)
    for double in _DOUBLES:
        longer = point(evidence, moved(start.config, free, np.clip(at + double * step, low, high)), free, outcomes)
        if longer.height < trial.height + _ENOUGH:
            break
        trial = longer
    return trial


def climb_apart(evidence: Evidence, start: FusionConfig, free: Sequence[Parameter], tell: Tell, enough: float) -> Point:
    """The nearest maximum of each axis for itself, several at a time; of all together where they share a number."""
    if any(one.axis is None for one in free):
        return climb(evidence, start, free, tell, enough=enough)

    def of(axis: str) -> FusionConfig:
        mine = [one for one in free if one.axis == axis]
        return climb(evidence.alone(axis), start, mine, enough=enough).config

    best, axes = start, list(evidence.heard)
    with ThreadPoolExecutor(usable_cores()) as pool:
        for axis, config in zip(axes, pool.map(of, axes), strict=True):
            best = with_axis_of(best, config, axis)
    found = point(evidence, best, free)
    tell(found)
    return found


def settle(evidence: Evidence, start: FusionConfig, free: Sequence[Parameter], tell: Tell = lambda _: None) -> Point:
    """The nearest maximum under the gates' own decisions: climb with the outcomes as they are, ask the gates again.

    A row that a gate newly rejects costs more than what a step gains, so a climb that asked at every step would stop at
    the first one. Where the peak with the old outcomes turns out worse, a part of the way there is tried.
    """
    apart = all(not sensor.gate_rows for sensor in start.sensors.values())
    best = climb_apart(evidence, start, free, tell, _ENOUGH) if apart else climb(evidence, start, free, tell)
    best = _past_bumps(evidence, best, free, tell)
    for _ in range(_SETTLING):
        peak = climb(evidence, best.config, free, outcomes=best.value.outcomes)
        at = coordinates(best.config, free)
        there = coordinates(peak.config, free)
        for share in _SHARES:
            trial = point(evidence, moved(best.config, free, at + share * (there - at)), free)
            if trial.height > best.height + _ENOUGH:
                break
        else:
            return best
        best = trial
        tell(best)
    return best


def _past_bumps(evidence: Evidence, best: Point, free: Sequence[Parameter], tell: Tell) -> Point:
    """Over the small bumps that the likelihood has in a time, where measurements pass commands and each other."""
    times = [one for one in free if one.fit in ("delay", "latency")]
    for one in times:
        at = one.at(best.config)
        beside = max((point(evidence, one.move(best.config, at + shift), free) for shift in _BUMPS), key=_height)
        if beside.height > best.height + _ENOUGH:
            best = climb(evidence, beside.config, free, tell)
    return best


def _height(found: Point) -> float:
    return found.height


def _step(found: Slopes, low: FloatArray, high: FloatArray, damping: FloatArray) -> FloatArray:
    """The δ in the box from ``low`` to ``high`` that gains most: ½ δᵀ(I + λ diag I)δ − gᵀδ is least there.

    The matrix is scaled so that its diagonal is 1 + λ. What nothing tells does not move.
    """
    from scipy.linalg import solve_triangular
    from scipy.optimize import lsq_linear

    diagonal = np.diag(found.information)
    told = diagonal > 0.0
    step, size = np.zeros(len(diagonal)), 1.0 / np.sqrt(diagonal[told])
    matrix = found.information[np.ix_(told, told)] * np.outer(size, size) + np.diag(damping[told] + _ROUNDING)
    root = np.asarray(np.linalg.cholesky(matrix), dtype=np.float64)
    aim = solve_triangular(root, size * found.score[told], lower=True)
    step[told] = size * lsq_linear(root.T, aim, (low[told] / size, high[told] / size), method="bvls").x
    return step
