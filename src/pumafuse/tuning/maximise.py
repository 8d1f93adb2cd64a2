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
from ..filter.events import Results
from ..fusion.config import FusionConfig
from .likelihood import Derivatives, Likelihood, Linearised, in_threads
from .parameters import Parameter, coordinates, moved, with_axis_of
from .steps import bounded_step

_ITERATIONS = 60
_TOLERANCE = 2e-3  # expected gain in log-likelihood that is not worth another step
_FIRST_DAMPING = 1e-4
_LAST_DAMPING = 1e8  # at which the search gives up
_DOUBLES = (2.0, 4.0, 8.0)
_NOTHING, _CREEPING = 2e-4, 3  # log-likelihood; steps in a row that gain less: at a cusp, the score promises too much
_POOR = 0.1  # of the expected gain, from which a step was too long
_GOOD = 0.5  # of the expected gain, from which derivatives are carried along to the next step, if that was
_NEARBY = 2.0  # at most in log-likelihood: farther away they change too much
_MORE = 1.1  # of the expected gain, from which a longer step is tried
_PROMISE = 5.0  # times the gain expected of the last step, beyond which no further steps are hoped to lead
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
        results: What became of each component, for each segment.
    """

    config: FusionConfig
    log_likelihood: float
    axes: FloatArray
    results: Sequence[Results]

    @property
    def outcomes(self) -> list[CodeArray]:
        """The outcome of each component, for each segment, (m, A)."""
        return [one.outcome for one in self.results]

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
    return Point(config, found.total, found.axes + prior, found.results)


def derivatives(likelihood: Likelihood, at: Point, free: Sequence[Parameter]) -> Derivatives:
    """Score and information of the log-posterior at a point."""
    return with_priors(likelihood.linearised(at.config, free, at.outcomes), at, free)


def with_priors(linear: Linearised, at: Point, free: Sequence[Parameter]) -> Derivatives:
    """Score and information of the log-posterior, from the innovations around a point to first order."""
    found = linear.derivatives()
    score, information = found.score.copy(), found.information.copy()
    for number, one in enumerate(free):
        more, known = one.prior_score(at.config)
        score[number] += more
        information[number, number] += known
    return Derivatives(score, information, found.scatter)


def maximise(
    likelihood: Likelihood,
    start: FusionConfig,
    free: Sequence[Parameter],
    notify: Notify = ignore,
    outcomes: Sequence[CodeArray] | None = None,
    tolerance: float = _TOLERANCE,
    worth: float = -np.inf,
) -> Point:
    """Find the nearest maximum of the log-posterior.

    Args:
        likelihood: The likelihood.
        start: Where to start.
        free: The parameters to vary.
        notify: Called with each better point.
        outcomes: The outcome of each component, to be repeated; None: the gates decide.
        tolerance: Gain in log-likelihood that is not worth another step.
        worth: The log-posterior below which a maximum is not wanted: where it is out of reach, the search ends early.
    """
    return Ascent(likelihood, free, outcomes, tolerance).maximum(start, notify, worth)


class Ascent:
    """Steps from one point to a maximum.

    After a good small step the derivatives are carried along (:meth:`Likelihood.moved`): new ones cost ten times as
    much as the step. Where those promise nothing more, or a step by them fails, new ones are computed.

    Attributes:
        linear: The derivatives at the last point; None before the first one.
    """

    def __init__(
        self,
        likelihood: Likelihood,
        free: Sequence[Parameter],
        outcomes: Sequence[CodeArray] | None = None,
        tolerance: float = _TOLERANCE,
        near: Linearised | None = None,
    ) -> None:
        """Args as for :func:`maximise`; ``near``: derivatives from nearby, which are good enough to stop by."""
        self._likelihood, self._free, self._outcomes, self._tolerance = likelihood, free, outcomes, tolerance
        self._low, self._high = np.array([one.range for one in free]).reshape(-1, 2).T
        self._reach = _REACH * np.array([one.scale for one in free])
        self._axis = [-1 if one.axis is None else likelihood.axes.index(one.axis) for one in free]
        self._damping, self._near, self.linear = np.full(len(free), _FIRST_DAMPING), near is not None, near

    def maximum(self, start: FusionConfig, notify: Notify = ignore, worth: float = -np.inf) -> Point:
        """The maximum next to a configuration; a point on the way to it if that is not going to be ``worth`` it."""
        best, small = self._point(start), 0
        if not self._free:
            return best
        if self.linear is None:
            self._renew(best)
        else:
            self.linear = self._likelihood.moved(self.linear, np.zeros(len(self._free)), best.results)
        for _ in range(_ITERATIONS):
            trial, step, expected = self._better(best)
            if trial is best:
                return best
            gained = trial.log_posterior - best.log_posterior
            trial = self._farther(best, trial, step, gained / expected)
            notify(trial)
            small = small + 1 if gained < _NOTHING else 0
            if trial.log_posterior + _PROMISE * expected < worth:
                return trial
            if small == _CREEPING or (self._may_stop and max(gained, expected) < self._tolerance):
                return trial
            self._follow(best, trial, _GOOD * expected < gained < _NEARBY)
            best = trial
        return best

    @property
    def _may_stop(self) -> bool:
        return self._near or (self.linear is not None and self.linear.exact)

    def _point(self, config: FusionConfig) -> Point:
        return point(self._likelihood, config, self._free, self._outcomes)

    def _renew(self, at: Point) -> None:
        self.linear = self._likelihood.linearised(at.config, self._free, at.outcomes)

    def _better(self, best: Point) -> tuple[Point, FloatArray, float]:
        """A better point, the step to it and what it was expected to gain; ``best`` itself if there is none."""
        at, failed = coordinates(best.config, self._free), False
        while True:
            assert self.linear is not None
            found = with_priors(self.linear, best, self._free)
            low, high = np.maximum(self._low - at, -self._reach), np.minimum(self._high - at, self._reach)
            step = bounded_step(found.score, found.information, low, high, self._damping)
            expected = float(found.score @ step) - 0.5 * float(step @ found.information @ step)
            if not self._may_stop and expected < self._tolerance:
                self._renew(best)
                continue
            if not expected > 0.0 or self._damping.min() > _LAST_DAMPING:
                return best, step, expected
            trial = self._point(moved(best.config, self._free, at + step))
            gained = trial.log_posterior - best.log_posterior
            worse = np.append(trial.axes < best.axes, gained < 0.0)[self._axis]
            if gained > 0.0:
                less = worse | (gained < _POOR * expected)
                self._damping = np.where(less, 10.0 * self._damping, 0.1 * self._damping)
                return trial, step, expected
            if not self.linear.exact:
                self._renew(best)
                continue
            self._damping = np.where(worse | failed, 10.0 * np.maximum(self._damping, _FIRST_DAMPING), self._damping)
            failed = True
            if expected < self._tolerance:
                return best, step, expected

    def _farther(self, best: Point, trial: Point, step: FloatArray, share: float) -> Point:
        """A point beyond ``trial`` that gained a larger ``share`` than expected: along a ridge steps are too short."""
        at = coordinates(best.config, self._free)
        for double in _DOUBLES if share > _MORE else ():
            there = np.clip(at + double * step, self._low, self._high)
            longer = self._point(moved(best.config, self._free, there))
            if longer.log_posterior < trial.log_posterior + _TOLERANCE:
                break
            trial = longer
        return trial

    def _follow(self, before: Point, now: Point, good: bool) -> None:
        """Carry the derivatives along after a good step that changed no outcome; else compute new ones."""
        if good and self.linear is not None and all(map(np.array_equal, now.outcomes, before.outcomes)):
            step = coordinates(now.config, self._free) - coordinates(before.config, self._free)
            self.linear = self._likelihood.moved(self.linear, step, now.results)
        else:
            self._renew(now)


def maximise_by_axis(
    likelihood: Likelihood,
    start: FusionConfig,
    free: Sequence[Parameter],
    notify: Notify,
    tolerance: float,
    beside: Point | None = None,
) -> Point:
    """Find the nearest maximum of each axis, several at a time; of all together where a parameter is shared.

    What is not going to be as high as the point ``beside`` is not followed to its end.
    """
    worth = np.full(len(likelihood.axes), -np.inf) if beside is None else beside.axes
    if any(one.axis is None for one in free):
        return maximise(likelihood, start, free, notify, tolerance=tolerance, worth=float(worth.sum()))

    def of(axis: str) -> FusionConfig:
        mine, least = [one for one in free if one.axis == axis], float(worth[likelihood.axes.index(axis)])
        return maximise(likelihood.of_axis(axis), start, mine, tolerance=tolerance, worth=least).config

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
        near = [point(likelihood, one.move(best.config, one.coordinate(at + shift)), free) for shift in _BUMPS]
        beside = max(near, key=lambda found: found.log_posterior)
        if beside.log_posterior > best.log_posterior + _TOLERANCE:
            best = maximise(likelihood, beside.config, free, notify)
    return best
