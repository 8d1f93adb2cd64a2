"""Maximising the log-posterior: Fisher scoring from one configuration to the nearest maximum.

A step solves (I + λ diag I) δ = g with the score g and the expected information I of all parameters at once. It is
taken where the log-posterior itself, gates included, is greater there (λ as in Levenberg and Marquardt; Osborne,
"Fisher's method of scoring", International Statistical Review 60, 1992). Score and information include the priors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..fusion.config import FusionConfig
from .likelihood import Derivatives, Likelihood, in_threads
from .parameters import Parameter, coordinates, moved, with_axis_of

_ITERATIONS = 60
_TOLERANCE = 2e-3  # expected gain in log-likelihood that is not worth another step
_FIRST_DAMPING = 1e-4
_ROUNDING = 1e-10  # of a matrix with a diagonal of 1, below which its eigenvalues mean nothing
_LAST_DAMPING = 1e8  # at which the search gives up
_DOUBLES = (2.0, 4.0, 8.0)
_NOTHING, _CREEPING = 2e-4, 3  # log-likelihood; steps in a row that gain less: at a cusp, the score promises too much
_POOR = 0.1  # of the expected gain, from which a step was too long
_MORE = 1.1  # of the expected gain, from which a longer step is tried
_GATE_ROUNDS = 12  # times that the gates decide again
_BUMPS = tuple(sign * shift for shift in (2e-4, 5e-4, 1e-3, 2e-3) for sign in (-1.0, 1.0))  # s
_SHARES = (1.0, 0.5, 0.2)
_REACH = 1.5  # longest step of a coordinate, in its scale


@dataclass(frozen=True)
class Point:
    """A configuration with its log-likelihood and its log-posterior.

    Attributes:
        config: The configuration.
        log_likelihood: Its log-likelihood.
        axes: The log-posterior of each axis but for a constant (shared parameters' priors count for the first), (A,).
        outcomes: The outcome of each component, for each segment, (m,).
    """

    config: FusionConfig
    log_likelihood: float
    axes: FloatArray
    outcomes: Sequence[CodeArray]

    @property
    def log_posterior(self) -> float:
        """The log-posterior of all axes: what is maximised."""
        return float(self.axes.sum())


Notify: TypeAlias = Callable[[Point], None]


def ignore(_: Point) -> None:
    """Do nothing with a better point."""


def point(
    likelihood: Likelihood,
    config: FusionConfig,
    free: Sequence[Parameter],
    outcomes: Sequence[CodeArray] | None = None,
) -> Point:
    """Evaluate a configuration; with ``outcomes`` these are repeated and its gates are not applied."""
    found, prior = likelihood.evaluate(config, outcomes), np.zeros(len(likelihood.axes))
    for one in free:
        prior[0 if one.axis is None else likelihood.axes.index(one.axis)] += one.log_prior(config)
    return Point(config, found.total, found.axes + prior, found.outcomes)


def derivatives(likelihood: Likelihood, at: Point, free: Sequence[Parameter]) -> Derivatives:
    """Score and information of the log-posterior at a point."""
    found = likelihood.derivatives(at.config, free, at.outcomes)
    score, information = found.score.copy(), found.information.copy()
    for number, one in enumerate(free):
        if one.prior is not None:
            mean, sd = one.prior
            score[number] -= (one.at(at.config) - mean) / sd**2
            information[number, number] += 1.0 / sd**2
    return Derivatives(score, information, found.scatter)


def maximise(
    likelihood: Likelihood,
    start: FusionConfig,
    free: Sequence[Parameter],
    notify: Notify = ignore,
    outcomes: Sequence[CodeArray] | None = None,
    tolerance: float = _TOLERANCE,
) -> Point:
    """Find the nearest maximum of the log-posterior.

    Args:
        likelihood: The likelihood.
        start: Where to start.
        free: The parameters to vary.
        notify: Called with each better point.
        outcomes: The outcome of each component, to be repeated; None: the gates decide.
        tolerance: Gain in log-likelihood that is not worth another step.
    """
    best = point(likelihood, start, free, outcomes)
    if not free:
        return best
    low, high = np.array([one.range for one in free]).T
    reach = _REACH * np.array([one.scale for one in free])
    axis = np.array([-1 if one.axis is None else likelihood.axes.index(one.axis) for one in free])
    damping, small = np.full(len(free), _FIRST_DAMPING), 0
    for _ in range(_ITERATIONS):
        at = coordinates(best.config, free)
        found = derivatives(likelihood, best, free)
        failed = False
        while True:
            step = _step(found, np.maximum(low - at, -reach), np.minimum(high - at, reach), damping)
            expected = float(found.score @ step) - 0.5 * float(step @ found.information @ step)
            if not expected > 0.0 or damping.min() > _LAST_DAMPING:
                return best
            trial = point(likelihood, moved(best.config, free, at + step), free, outcomes)
            gained = trial.log_posterior - best.log_posterior
            worse = np.append(trial.axes < best.axes, gained < 0.0)[axis]
            if gained > 0.0:
                less = worse | (gained < _POOR * expected)
                damping = np.where(less, 10.0 * damping, 0.1 * damping)
                break
            damping = np.where(worse | failed, 10.0 * np.maximum(damping, _FIRST_DAMPING), damping)
            failed = True
            if expected < tolerance:
                return best
        for double in _DOUBLES if gained > _MORE * expected else ():  # along a ridge steps turn out too short
            there = moved(best.config, free, np.clip(at + double * step, low, high))
            longer = point(likelihood, there, free, outcomes)
            if longer.log_posterior < trial.log_posterior + _TOLERANCE:
                break
            trial = longer
        best = trial
        notify(best)
        small = small + 1 if gained < _NOTHING else 0
        if small == _CREEPING or max(gained, expected) < tolerance:
            return best
    return best


def maximise_by_axis(
    likelihood: Likelihood, start: FusionConfig, free: Sequence[Parameter], notify: Notify, tolerance: float
) -> Point:
    """Find the nearest maximum of each axis, several at a time; of all together where a parameter is shared."""
    if any(one.axis is None for one in free):
        return maximise(likelihood, start, free, notify, tolerance=tolerance)

    def of(axis: str) -> FusionConfig:
        mine = [one for one in free if one.axis == axis]
        return maximise(likelihood.of_axis(axis), start, mine, tolerance=tolerance).config

    best, axes = start, list(likelihood.sensors)
    for axis, config in zip(axes, in_threads(of, axes), strict=True):
        best = with_axis_of(best, config, axis)
    found = point(likelihood, best, free)
    notify(found)
    return found


def maximise_with_gates(
    likelihood: Likelihood, start: FusionConfig, free: Sequence[Parameter], notify: Notify = ignore
) -> Point:
    """Find the nearest maximum under the gates' own decisions: maximise with fixed outcomes, apply the gates again.

    A row that a gate newly rejects costs more than a step gains, so a search that applied the gates at every step would
    stop at the first one. Where the maximum with the old outcomes turns out worse, a part of the way there is tried.
    """
    if not any(sensor.gates_rows(start.arm) for sensor in start.sensors.values()):
        best = maximise_by_axis(likelihood, start, free, notify, _TOLERANCE)
    else:
        best = maximise(likelihood, start, free, notify)
    best = past_bumps(likelihood, best, free, notify)
    for _ in range(_GATE_ROUNDS):
        peak = maximise(likelihood, best.config, free, outcomes=best.outcomes)
        at = coordinates(best.config, free)
        there = coordinates(peak.config, free)
        for share in _SHARES:
            trial = point(likelihood, moved(best.config, free, at + share * (there - at)), free)
            if trial.log_posterior > best.log_posterior + _TOLERANCE:
                break
        else:
            return best
        best = trial
        notify(best)
    return best


def past_bumps(likelihood: Likelihood, best: Point, free: Sequence[Parameter], notify: Notify = ignore) -> Point:
    """Pass the small bumps that the likelihood has along a time, where measurements pass commands and each other."""
    for one in free:
        if one.fit not in ("delay", "latency"):
            continue
        at = one.at(best.config)
        near = [point(likelihood, one.move(best.config, at + shift), free) for shift in _BUMPS]
        beside = max(near, key=lambda found: found.log_posterior)
        if beside.log_posterior > best.log_posterior + _TOLERANCE:
            best = maximise(likelihood, beside.config, free, notify)
    return best


def _step(found: Derivatives, low: FloatArray, high: FloatArray, damping: FloatArray) -> FloatArray:
    """The δ between ``low`` and ``high`` that minimises ½ δᵀ(I + λ diag I)δ − gᵀδ, (k,).

    The matrix is scaled to a diagonal of 1 + λ. A parameter without any information does not move.
    """
    diagonal = np.diag(found.information)
    known = diagonal > 0.0
    step, size = np.zeros(len(diagonal)), 1.0 / np.sqrt(diagonal[known])
    matrix = found.information[np.ix_(known, known)] * np.outer(size, size) + np.diag(damping[known] + _ROUNDING)
    root = np.asarray(np.linalg.cholesky(matrix), dtype=np.float64)
    aim = np.asarray(np.linalg.solve(root, size * found.score[known]), dtype=np.float64)
    inner, lowest, highest = np.linalg.solve(root.T, aim), low[known] / size, high[known] / size
    if not ((inner >= lowest) & (inner <= highest)).all():
        from scipy.optimize import lsq_linear  # takes a while to import, and is seldom needed

        inner = lsq_linear(root.T, aim, (lowest, highest), method="bvls").x
    step[known] = size * inner
    return step
