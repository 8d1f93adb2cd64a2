"""Maximising the log-posterior: Fisher scoring from one configuration to the nearest maximum.

A step solves (I + λ diag I) δ = g with the score g and the expected information I of all parameters at once. It is
taken where the log-posterior itself, gates included, is greater there (λ as in Levenberg and Marquardt; Osborne,
"Fisher's method of scoring", International Statistical Review 60, 1992). Score and information include the priors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..fusion.config import FusionConfig
from .arms import PROMISE
from .likelihood import Derivatives, Likelihood, Point, in_threads
from .parameters import Parameter, coordinates, moved, set_axis_of
from .steps import bounded_step

_ITERATIONS = 60
_TOLERANCE = 2e-3  # expected gain in log-likelihood that is not worth another step
_FIRST_DAMPING = 1e-4
_LAST_DAMPING = 1e8  # at which the search gives up
_DOUBLES = (2.0, 4.0, 8.0)
_NOTHING, _CREEPING = 2e-4, 3  # log-likelihood; steps in a row that gain less: at a cusp, the score promises too much
_POOR = 0.1  # of the expected gain, from which a step was too long
_MORE = 1.1  # of the expected gain, from which a longer step is tried
_GATE_ROUNDS = 12  # times that the gates decide again
_BUMPS = tuple(sign * shift for shift in (2e-4, 5e-4, 1e-3, 2e-3) for sign in (-1.0, 1.0))  # s
_SHARES = (1.0, 0.5, 0.2)
REACH = 1.5  # longest step of a coordinate, in its scale


Notify: TypeAlias = Callable[[Point], None]


def ignore(_: Point) -> None:
    """Do nothing with a better point."""


def point(
    likelihood: Likelihood, config: FusionConfig, free: Sequence[Parameter], outcomes: Sequence[CodeArray] | None = None
) -> Point:
    """Evaluate a configuration; with ``outcomes`` these are repeated and its gates are not applied."""
    prior = np.zeros(len(likelihood.axes))
    for parameter in free:
        prior[0 if parameter.axis is None else likelihood.axes.index(parameter.axis)] += parameter.log_prior(config)
    return replace(likelihood.evaluate(config, outcomes), priors=prior)


def derivatives(likelihood: Likelihood, at: Point, free: Sequence[Parameter]) -> Derivatives:
    """Score and information of the log-posterior at a point."""
    derivatives_here = likelihood.derivatives(at.config, free, at.outcomes)
    score, information = derivatives_here.score.copy(), derivatives_here.information.copy()
    for number, parameter in enumerate(free):
        more, information_here = parameter.prior_score(at.config)
        score[number] += more
        information[number, number] += information_here
    return Derivatives(score, information, derivatives_here.scatter)


def maximise(
    likelihood: Likelihood,
    start: FusionConfig,
    free: Sequence[Parameter],
    notify: Notify = ignore,
    outcomes: Sequence[CodeArray] | None = None,
    tolerance: float = _TOLERANCE,
    worth: float = -np.inf,
) -> Point:
    """Find the nearest maximum of the log-posterior; for ``outcomes`` of None the gates decide on them.

    A gain in log-likelihood of less than the ``tolerance`` is not worth another step, and a maximum below ``worth`` is
    not wanted: where that is out of reach, the search ends early.
    """
    best, small = point(likelihood, start, free, outcomes), 0
    ascent = _Ascent(likelihood, free, outcomes, tolerance)
    for _ in range(_ITERATIONS if free else 0):
        trial, step, expected = ascent.better(best)
        if trial is best:
            return best
        gained = trial.log_posterior - best.log_posterior
        best = ascent.farther(best, trial, step, gained / expected)
        notify(best)
        small = small + 1 if gained < _NOTHING else 0
        if small == _CREEPING or max(gained, expected) < tolerance or best.log_posterior + PROMISE * expected < worth:
            return best
    return best


class _Ascent:
    """Steps from one point to a maximum; each axis has a damping of its own."""

    def __init__(
        self, likelihood: Likelihood, free: Sequence[Parameter], outcomes: Sequence[CodeArray] | None, tolerance: float
    ) -> None:
        self._likelihood, self._free, self._outcomes, self._tolerance = likelihood, free, outcomes, tolerance
        self._low, self._high = np.array([parameter.range for parameter in free]).reshape(-1, 2).T
        self._reach = REACH * np.array([parameter.scale for parameter in free])
        self._axis = [-1 if parameter.axis is None else likelihood.axes.index(parameter.axis) for parameter in free]
        self._damping = np.full(len(free), _FIRST_DAMPING)

    def better(self, best: Point) -> tuple[Point, FloatArray, float]:
        """A better point, the step to it and what it was expected to gain; ``best`` itself if there is none."""
        at, failed = coordinates(best.config, self._free), False
        slopes = derivatives(self._likelihood, best, self._free)
        low, high = np.maximum(self._low - at, -self._reach), np.minimum(self._high - at, self._reach)
        while True:
            step = bounded_step(slopes.score, slopes.information, low, high, self._damping)
            expected = float(slopes.score @ step) - 0.5 * float(step @ slopes.information @ step)
            if not expected > 0.0 or self._damping.min() > _LAST_DAMPING:
                return best, step, expected
            trial = self._point(best, at + step)
            gained = trial.log_posterior - best.log_posterior
            worse = np.append(trial.posteriors < best.posteriors, gained < 0.0)[self._axis]
            if gained > 0.0:
                less = worse | (gained < _POOR * expected)
                self._damping = np.where(less, 10.0 * self._damping, 0.1 * self._damping)
                return trial, step, expected
            self._damping = np.where(worse | failed, 10.0 * np.maximum(self._damping, _FIRST_DAMPING), self._damping)
            failed = True
            if expected < self._tolerance:
                return best, step, expected

    def farther(self, best: Point, trial: Point, step: FloatArray, share: float) -> Point:
        """A point beyond ``trial`` that gained a larger ``share`` than expected: along a ridge steps are too short."""
        at = coordinates(best.config, self._free)
        for double in _DOUBLES if share > _MORE else ():
            longer = self._point(best, np.clip(at + double * step, self._low, self._high))
            if longer.log_posterior < trial.log_posterior + _TOLERANCE:
                break
            trial = longer
        return trial

    def _point(self, best: Point, at: FloatArray) -> Point:
        return point(self._likelihood, moved(best.config, self._free, at), self._free, self._outcomes)


def maximise_by_axis(
    likelihood: Likelihood, start: FusionConfig, free: Sequence[Parameter], notify: Notify, tolerance: float
) -> Point:
    """Find the nearest maximum of each axis, several at a time; of all together where a parameter is shared."""
    if any(parameter.axis is None for parameter in free):
        return maximise(likelihood, start, free, notify, tolerance=tolerance)

    def of(axis: str) -> FusionConfig:
        own_parameters = [parameter for parameter in free if parameter.axis == axis]
        return maximise(likelihood.of_axis(axis), start, own_parameters, tolerance=tolerance).config

    best, axes = start, list(likelihood.sensors)
    for axis, config in zip(axes, in_threads(of, axes), strict=True):
        best = set_axis_of(best, config, axis)
    peak = point(likelihood, best, free)
    notify(peak)
    return peak


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
        target = coordinates(peak.config, free)
        for share in _SHARES:
            trial = point(likelihood, moved(best.config, free, at + share * (target - at)), free)
            if trial.log_posterior > best.log_posterior + _TOLERANCE:
                break
        else:
            return best
        best = trial
        notify(best)
    return best


def past_bumps(likelihood: Likelihood, best: Point, free: Sequence[Parameter], notify: Notify = ignore) -> Point:
    """Pass the small bumps that the likelihood has along a time, where measurements pass commands and each other."""
    for parameter in free:
        if parameter.fit not in ("delay", "latency"):
            continue
        at = parameter.at(best.config)
        near = [
            point(likelihood, parameter.move(best.config, parameter.coordinate(at + shift)), free) for shift in _BUMPS
        ]
        beside = max(near, key=lambda peak: peak.log_posterior)
        if beside.log_posterior > best.log_posterior + _TOLERANCE:
            best = maximise(likelihood, beside.config, free, notify)
    return best
