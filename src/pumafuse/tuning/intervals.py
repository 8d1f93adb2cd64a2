"""95 % confidence intervals from the curvature and the profile of the likelihood, and profiles to draw."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..fusion.config import FusionConfig
from ..fusion.score import Z95
from ..toml import Interval
from .identifiability import covariance, within_bounds
from .likelihood import Likelihood, in_threads
from .maximise import Point, derivatives, maximise, point
from .parameters import Parameter, coordinates, moved, rounded
from .stage import Stage

_TOLERANCE = 0.02  # log-likelihood to which a profile is maximised
_DRAWN_TOLERANCE = 0.3  # likewise where it is only drawn
_SKEWED = 0.05  # relative error of the curvature's drop at an end, beyond which the profile is computed
_SKEWED_SHARED = 0.2  # likewise of a parameter of all axes, whose profile takes ten times as long
_STEPS = 12  # of a profile towards its end
_CLOSE = 0.03  # relative, of √(2 drop)
_HALVINGS = 26
_SHARES = np.array((0.3, 0.65, 1.0, 1.5))  # of the way from the best to an end of the interval: points that are drawn


@dataclass(frozen=True)
class ConfidenceInterval:
    """The 95 % confidence interval of a parameter.

    Attributes:
        ci95: The 95 % interval [SI]; an end at the parameter's bound is open.
        profiled: Whether the profile of the likelihood was computed, not only its curvature.
        at: The bound at which the value lies, else None.
        open: Which ends of the interval are open: the measurements do not limit them.
    """

    ci95: Interval
    profiled: bool
    at: Literal["lower", "upper"] | None
    open: tuple[bool, bool]


@dataclass(frozen=True)
class View:
    """The likelihood that the parameters of one axis, or of all, depend on.

    Attributes:
        likelihood: The likelihood.
        outcomes: The outcomes of its components, which are repeated.
        free: The free parameters that are not at a bound. The prior of a shared one is the information of other axes.
        covariance: Of their coordinates, (k, k).
    """

    likelihood: Likelihood
    outcomes: Sequence[CodeArray]
    free: Sequence[Parameter]
    covariance: FloatArray

    def at(self, config: FusionConfig, more: Sequence[Parameter] = ()) -> float:
        """The log-posterior of a configuration."""
        return point(self.likelihood, config, [*self.free, *more], self.outcomes).log_posterior

    def without(self, one: Parameter) -> list[Parameter]:
        """The other free parameters."""
        return [other for other in self.free if other.key != one.key]

    def sd(self, one: Parameter) -> float:
        """The standard deviation of the coordinate of a free parameter."""
        place = [other.key for other in self.free].index(one.key)
        return float(np.sqrt(self.covariance[place, place]))

    def slope(self, one: Parameter) -> FloatArray:
        """The change of the other coordinates with this one by regression, Cov(·, a) / Var a; 0 if it is at a bound."""
        keys = [other.key for other in self.free]
        if one.key not in keys:
            return np.zeros(len(keys))
        place = keys.index(one.key)
        return np.delete(self.covariance[:, place] / self.covariance[place, place], place)

    def maximum(self, start: FusionConfig, free: Sequence[Parameter], tolerance: float) -> Point:
        """The nearest maximum, with the outcomes repeated."""
        return maximise(self.likelihood, start, free, outcomes=self.outcomes, tolerance=tolerance)


def confidence_intervals(
    likelihood: Likelihood, best: Point, free: Sequence[Parameter]
) -> dict[str, ConfidenceInterval]:
    """Compute the 95 % interval of each free parameter, by its key.

    From the curvature: 1.96 sd of the coordinate each way. Where the likelihood at an end, the other parameters moved
    along, has not dropped by what that predicts (1.92), the end is where its profile has (Cox & Hinkley, Theoretical
    Statistics, 9.3). Gates make the likelihood jump; the intervals are those of the maximum that it has while the
    outcomes stay as they are. That maximum is not the result: there the gates decide otherwise, and for a lower
    likelihood, or the search would have gone there. So an interval beside the result is extended to it.
    """
    result = best.config
    best = maximise(likelihood, result, free, outcomes=best.outcomes)
    views = views_of(likelihood, best, free)

    def of(one: Parameter) -> ConfidenceInterval:
        ends = [_end(views[one.axis], best, one, sign) for sign in (-1.0, 1.0)]
        low, high = (one.value(coordinate) for coordinate, _, _ in ends)
        value, at = one.clipped(rounded(one.get(result))), one.at_bound(result)
        return ConfidenceInterval(
            ci95=(min(low, value), max(high, value)),
            profiled=any(profiled for _, profiled, _ in ends),
            at=one.at_bound(best.config),
            open=(ends[0][2] or at == "lower", ends[1][2] or at == "upper"),
        )

    return dict(zip([one.key for one in free], in_threads(of, free), strict=True))


def views_of(likelihood: Likelihood, best: Point, free: Sequence[Parameter]) -> Mapping[str | None, View]:
    """The view of each axis, and under None, where a parameter is shared by all axes, the view of everything."""
    inside = within_bounds(free, best.config)
    shared = [one for one in inside if one.axis is None]
    own = {axis: [one for one in inside if one.axis == axis] for axis in likelihood.sensors}
    parts = {axis: (likelihood.of_axis(axis), likelihood.outcomes_of(axis, best.outcomes)) for axis in own}
    informed = {
        axis: _of_shared(part.derivatives(best.config, [*own[axis], *shared], outcomes).information, len(own[axis]))
        for axis, (part, outcomes) in (parts.items() if shared else ())
    }
    views: dict[str | None, View] = {}
    for axis, (part, outcomes) in parts.items():
        elsewhere = sum((informed[other] for other in informed if other != axis), np.zeros(len(shared)))
        priors = [
            replace(one, prior=(one.at(best.config), 1.0 / np.sqrt(max(float(information), 1e-12))))
            for one, information in zip(shared, elsewhere, strict=True)
        ]
        views[axis] = _view(part, outcomes, best, [*own[axis], *priors])
    if any(one.axis is None for one in free):
        views[None] = _view(likelihood, best.outcomes, best, inside)
    return views


def _of_shared(information: FloatArray, own: int) -> FloatArray:
    """The information of an axis on each shared parameter, its own being free: the Schur complement's diagonal."""
    inner = np.linalg.pinv(information[:own, :own], hermitian=True)
    across = information[:own, own:]
    return np.diag(information[own:, own:] - across.T @ inner @ across)


def _view(likelihood: Likelihood, outcomes: Sequence[CodeArray], best: Point, free: Sequence[Parameter]) -> View:
    if not free:
        return View(likelihood, outcomes, free, np.zeros((0, 0)))
    there = point(likelihood, best.config, free, outcomes)
    return View(likelihood, outcomes, free, covariance(derivatives(likelihood, there, free).information, free))


def _end(view: View, best: Point, one: Parameter, sign: float) -> tuple[float, bool, bool]:
    """The lower (−1) or upper (+1) end of an interval: its coordinate, whether it is profiled, whether it is open.

    Distances are in standard deviations of the coordinate. From a bound they are in the coordinate, from a noise of 0
    in the noise itself.
    """
    bound, start = one.at_bound(best.config), one.at(best.config)
    if bound == ("lower" if sign < 0.0 else "upper"):
        return start, True, True
    others = view.without(one)
    at, (low, high) = coordinates(best.config, others), _ranges(others)
    if bound is None:
        unit = sign * view.sd(one)
        limit = (one.range[0 if sign < 0.0 else 1] - start) / unit
    else:
        unit, limit = sign, one.range[1] - one.range[0]
    vanishing = bound is not None and one.vanishes
    if vanishing:
        limit = one.bounds[1] - one.bounds[0]
    direction = unit * view.slope(one)
    top = view.at(best.config, [] if bound is None else [one])

    def place(distance: float) -> float:
        return one.coordinate(one.bounds[0] + distance) if vanishing else start + distance * unit

    def along(distance: float) -> FusionConfig:
        there = np.clip(at + distance * direction, low, high)
        return moved(one.move(best.config, place(distance)), others, there)

    def straight(distance: float) -> float:
        return _root(top - view.at(along(distance), [] if bound is None else [one]))

    def profile(distance: float) -> float:
        nonlocal direction
        peak = view.maximum(along(distance), others, _TOLERANCE)
        direction = (coordinates(peak.config, others) - at) / distance
        return _root(top - peak.log_posterior - one.log_prior(peak.config))

    if bound is None:
        first = min(Z95, limit)
        skewed = _SKEWED if one.axis else _SKEWED_SHARED
        if limit > Z95 and abs((straight(Z95) / Z95) ** 2 - 1.0) < skewed:
            return place(Z95), False, False
    else:
        first = limit
        for _ in range(_HALVINGS):
            if straight(first) < Z95:
                break
            first *= 0.5
    distance, beyond = _crossing(profile, first, limit)
    return place(distance), True, beyond


def _ranges(free: Sequence[Parameter]) -> tuple[FloatArray, FloatArray]:
    """Lower and upper bounds as coordinates, (k,)."""
    low, high = np.array([one.range for one in free]).reshape(-1, 2).T
    return low, high


def _root(drop: float) -> float:
    """The standard deviations that a drop of a Gaussian log-likelihood stands for."""
    return float(np.sqrt(2.0 * max(drop, 1e-9)))


def _crossing(root: Callable[[float], float], first: float, limit: float) -> tuple[float, bool]:
    """Solve root(distance) = 1.96 from ``first`` on; whether the solution is beyond the limit.

    Bracketed, then by the secant of its logarithm, which is nearly a line over that of the distance.
    """
    below, above, at = (0.0, 0.0), (np.inf, np.inf), first
    for _ in range(_STEPS):
        found = root(at)
        if abs(found / Z95 - 1.0) < _CLOSE:
            break
        if found < Z95:
            if at >= limit:
                return limit, True
            below = (at, found)
        else:
            above = (at, found)
        if above[0] == np.inf:
            at = min(at * min(max(Z95 / found, 1.2), 4.0), limit)
        elif below[0] == 0.0:
            at *= max(Z95 / found, 0.1)
        else:
            share = np.log(Z95 / below[1]) / np.log(above[1] / below[1])
            at = float(below[0] * (above[0] / below[0]) ** min(max(share, 0.1), 0.9))
    return at, False


# ---- profiles to draw -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Profile:
    """The log-likelihood along one parameter.

    Attributes:
        key: The parameter's key.
        axis: Its axis; None where it is shared.
        log: Whether to draw it on a log scale. A noise whose interval includes 0 needs a linear one.
        values: The parameter, in the unit of its key, ascending, (n,).
        drop: The log-likelihood there less that of the maximum, (n,).
    """

    key: str
    axis: str | None
    log: bool
    values: FloatArray
    drop: FloatArray


def profiles(stage: Stage, intervals: Mapping[str, tuple[float | None, float | None]]) -> list[Profile]:
    """Compute the log-likelihood along each parameter of a stage, to one and a half times its interval each way.

    The other parameters follow the line of their regression on it, bent to where they are most likely at the ends of
    the interval. That is a lower bound of the profile likelihood, and close to it. As for the intervals, the outcomes
    stay as they are at the best point, and the maximum is the one for these outcomes.

    Args:
        stage: The stage.
        intervals: The 95 % intervals of its parameters, by key, in the units of their keys; None: an open end.

    Returns:
        One for each parameter but those whose interval has no width.
    """
    best = maximise(stage.likelihood, stage.best.config, stage.free, outcomes=stage.best.outcomes)
    views = views_of(stage.likelihood, best, stage.free)
    found = in_threads(lambda one: _profile(views[one.axis], best.config, one, intervals[one.key]), stage.free)
    return [one for one in found if len(one.values) > 1]


def _profile(view: View, best: FusionConfig, one: Parameter, ci95: tuple[float | None, float | None]) -> Profile:
    others, start, slope = view.without(one), one.at(best), view.slope(one)
    at, (low, high) = coordinates(best, others), _ranges(others)

    def line(coordinate: float) -> FloatArray:
        """The others' coordinates by regression, (k − 1,); where a noise shrinks, on its variance."""
        change = coordinate - start
        if one.fit == "noise" and change < 0.0:
            change = 0.5 * math.expm1(2.0 * change)
        return at + slope * change

    def config(coordinate: float, others_at: FloatArray) -> FusionConfig:
        return moved(one.move(best, one.coordinate(one.value(coordinate))), others, np.clip(others_at, low, high))

    more = [] if one.at_bound(best) is None else [one]
    ends = [bound if end is None else end * one.unit for end, bound in zip(ci95, one.bounds, strict=True)]
    log = one.log and not (one.vanishes and ends[0] <= one.bounds[0])
    value, top = one.value(start), view.at(best, more)
    values, drop = [value], [0.0]
    for end in (max(end, one.bounds[0]) for end in ends):
        if math.isclose(end, value):
            continue
        to = one.coordinate(end)
        bend = coordinates(view.maximum(config(to, line(to)), others, _DRAWN_TOLERANCE).config, others) - line(to)
        along = value * (end / value) ** _SHARES if log else value + (end - value) * _SHARES
        for share, there in zip(_SHARES.tolist(), along.tolist(), strict=True):
            if one.bounds[0] <= there <= one.bounds[1] or share == 1.0:
                place = one.coordinate(there)
                values.append(there)
                drop.append(view.at(config(place, line(place) + bend * share**2), more) - top)
    order = np.argsort(values)
    return Profile(one.key, one.axis, log, np.array(values)[order] / one.unit, np.array(drop)[order])
