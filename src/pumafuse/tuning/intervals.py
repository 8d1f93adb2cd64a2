"""95 % confidence intervals from the curvature and the profile of the likelihood, and the profiles to draw."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..fusion.config import FusionConfig
from ..fusion.score import Z95
from ..toml import Interval
from .identifiability import covariance, within_bounds
from .likelihood import Likelihood, Point, in_threads
from .maximise import REACH, derivatives, maximise, point
from .parameters import Parameter, coordinates, moved, rounded
from .steps import bounded_step

Distances: TypeAlias = tuple[float, float]  # s; to the lower and upper end of an interval, infinite where it is open

_TOLERANCE = 0.05  # log-likelihood to which a profile is maximised: 1.3 % of the distance to an end
_FAR_BELOW = 8.0  # log-likelihood; where a profile has dropped by more, it is enough to know that
_SKEWED = 0.05  # relative error of the curvature's drop at an end, beyond which the profile is computed
_CLOSE = 0.03  # relative, of √(2 drop)
_FARTHER = 1.5  # times the distance, while an end is not yet between two
_HALVINGS = 26
_EXPECTED = 0.2  # log-likelihood that a maximum is expected to gain; a half of it is 2.6 % of the distance to an end
_NEWTON = 5  # steps to an end, at most
_HOPELESS = 5.0  # log-likelihood below the profile, from which they do not lead there
_LAG_STEP = 1e-5  # of a coordinate
_UNLIMITED = 10.0  # s; an interval of a lag as wide as this is none
_SHARES = (0.5, 1.0, 1.5)  # of the way from the best to an end of the interval: points that are drawn
_SAME = 1e-6  # relative, of distances
_VALLEY = 0.3  # log-likelihood between two maxima below the lower one, from which they are two
_NEXT_TO_NONE = 1e-2  # of the upper end, from which a noise's interval is drawn from 0
_FALLEN = 1.2  # times 1.96 standard deviations, from which a maximum may be another one than that inside


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

    @property
    def bimodal(self) -> bool:
        """Whether the curve falls and rises again, by more than the search leaves open."""
        left, right = np.maximum.accumulate(self.drop), np.maximum.accumulate(self.drop[::-1])[::-1]
        return bool(np.max(np.minimum(left, right) - self.drop) > _VALLEY)


@dataclass(frozen=True)
class ConfidenceInterval:
    """The 95 % confidence interval of a parameter."""

    ci95: Interval  # the 95 % interval [SI]; an end at the parameter's bound is open
    profiled: bool  # whether the profile of the likelihood was computed, not only its curvature
    at: Literal["lower", "upper"] | None  # the bound at which the value lies, else None
    open: tuple[bool, bool]  # which ends of the interval are open: the measurements do not limit them
    profile: Profile  # the likelihood along it: drawn, to one and a half times the interval each way


class _View(NamedTuple):
    """The likelihood that the parameters of one axis, or of all, depend on."""

    likelihood: Likelihood  # the likelihood
    outcomes: Sequence[CodeArray]  # the outcomes of its components, which are repeated
    # the free parameters that are not at a bound. The prior of a shared one is the information of other axes
    free: Sequence[Parameter]
    covariance: FloatArray  # of their coordinates, (k, k)
    top: float  # the log-posterior of the maximum


def confidence_intervals(
    likelihood: Likelihood,
    best: Point,
    free: Sequence[Parameter],
    asked: Sequence[Parameter] | None = None,
    *,
    drawn: bool = False,
) -> dict[str, ConfidenceInterval]:
    """Compute the 95 % interval of each free parameter, or of those that are ``asked`` for, by its key.

    ``drawn``: with profiles to draw, too, which takes nearly twice as long.

    From the curvature: 1.96 sd of the coordinate each way. Where the likelihood at an end, the other parameters moved
    along, has not dropped by what that predicts (1.92), the end is where its profile has (Cox & Hinkley, Theoretical
    Statistics, 9.3). Gates make the likelihood jump; the intervals are those of the maximum that it has while the
    outcomes stay as they are. That maximum is not the result: there the gates decide otherwise, and for a lower
    likelihood, or the search would have gone there. So an interval beside the result is extended to it, and beyond it
    by as much as it goes beyond the maximum.
    """
    result = best.config
    best = maximise(likelihood, result, free, outcomes=best.outcomes)
    views = _views(likelihood, best, free)

    def of(parameter: Parameter) -> ConfidenceInterval:
        low, high = (_end(views[parameter.axis], best, parameter, sign, drawn) for sign in (-1.0, 1.0))
        peak = parameter.value(parameter.at(best.config))
        value, at = parameter.clipped(rounded(parameter.number(result))), parameter.at_bound(result)
        log = parameter.log and not (
            parameter.vanishes and low.value <= max(parameter.bounds[0], _NEXT_TO_NONE * high.value)
        )
        values, drop = np.array(sorted([*low.curve, (peak, 0.0), *high.curve])).T
        return ConfidenceInterval(
            ci95=(
                low.value if low.value < value else parameter.clipped(value - (peak - low.value)),
                high.value if high.value > value else parameter.clipped(value + (high.value - peak)),
            ),
            profiled=low.profiled or high.profiled,
            at=parameter.at_bound(best.config),
            open=(low.open or at == "lower", high.open or at == "upper"),
            profile=Profile(parameter.key, parameter.axis, log, values / parameter.unit, drop),
        )

    asked = free if asked is None else asked
    return dict(zip([parameter.key for parameter in asked], in_threads(of, asked), strict=True))


def _views(likelihood: Likelihood, best: Point, free: Sequence[Parameter]) -> Mapping[str | None, _View]:
    """The view of each axis, and under None, where a parameter is shared by all axes, the view of everything."""
    inside = within_bounds(free, best.config)
    shared = [parameter for parameter in inside if parameter.axis is None]
    by_axis = {axis: [parameter for parameter in inside if parameter.axis == axis] for axis in likelihood.sensors}
    parts = {axis: (likelihood.of_axis(axis), likelihood.outcomes_of(axis, best.outcomes)) for axis in by_axis}
    informed = {
        axis: _of_shared(
            part.derivatives(best.config, [*by_axis[axis], *shared], outcomes).information, len(by_axis[axis])
        )
        for axis, (part, outcomes) in (parts.items() if shared else ())
    }
    views: dict[str | None, _View] = {}
    for axis, (part, outcomes) in parts.items():
        elsewhere = sum((informed[other] for other in informed if other != axis), np.zeros(len(shared)))
        priors = [
            replace(parameter, prior=(parameter.at(best.config), 1.0 / np.sqrt(max(float(information), 1e-12))))
            for parameter, information in zip(shared, elsewhere, strict=True)
        ]
        views[axis] = _view(part, outcomes, best, [*by_axis[axis], *priors])
    if any(parameter.axis is None for parameter in free):
        views[None] = _view(likelihood, best.outcomes, best, inside)
    return views


def _of_shared(information: FloatArray, count: int) -> FloatArray:
    """The information of an axis on each shared parameter, its own being free: the Schur complement's diagonal."""
    inner = np.linalg.pinv(information[:count, :count], hermitian=True)
    across = information[:count, count:]
    return np.diag(information[count:, count:] - across.T @ inner @ across)


def _view(likelihood: Likelihood, outcomes: Sequence[CodeArray], best: Point, free: Sequence[Parameter]) -> _View:
    peak = point(likelihood, best.config, free, outcomes)
    cov = covariance(derivatives(likelihood, peak, free).information, free)
    return _View(likelihood, outcomes, free, cov, peak.log_posterior)


class _End(NamedTuple):
    """An end of an interval: where it is [SI], whether it is profiled, whether it is open, and points of the curve."""

    value: float
    profiled: bool
    open: bool
    curve: list[tuple[float, float]]


def _end(view: _View, best: Point, parameter: Parameter, sign: float, drawn: bool) -> _End:
    """The lower (−1) or upper (+1) end of an interval."""
    if parameter.at_bound(best.config) == ("lower" if sign < 0.0 else "upper"):
        return _End(parameter.number(best.config), True, True, [])
    side = _Side(view, best, parameter, sign)
    end, profiled = side.end()
    value = parameter.clipped(side.value(end))
    is_open = profiled and end >= side.limit and side.root(end) < Z95
    return _End(value, profiled, is_open, side.curve(end, profiled) if drawn else [])


class _Maximum(NamedTuple):
    """A point of a profile: its drop, and where the other coordinates are."""

    drop: float
    others: FloatArray


class _Side:
    """The likelihood along a parameter, one way from the maximum.

    Distances are in standard deviations of the coordinate. From a bound they are in the coordinate, from a noise of 0
    in the noise itself.

    Attributes:
        limit: The distance to the parameter's bound.
    """

    def __init__(self, view: _View, best: Point, parameter: Parameter, sign: float) -> None:
        self._view, self._best, self._parameter, self._bound = view, best, parameter, parameter.at_bound(best.config)
        self._others = [other for other in view.free if other.key != parameter.key]
        self._every = [*self._others, parameter]
        slope, sd = np.zeros(len(self._others)), 1.0
        for number, other in enumerate(view.free):
            if other.key == parameter.key:  # by regression, Cov(·, a) / Var a
                slope = np.delete(view.covariance[:, number] / view.covariance[number, number], number)
                sd = float(np.sqrt(view.covariance[number, number]))
        self._unit, self._start = sign * sd, parameter.at(best.config)
        self._slope = self._unit * slope
        self._vanishing = self._bound is not None and parameter.vanishes
        self._range = np.array([other.range for other in self._others]).reshape(-1, 2).T
        self._reach = REACH * np.array([other.scale for other in self._others])
        self._maxima = {0.0: _Maximum(0.0, coordinates(best.config, self._others))}  # by distance
        self._top = view.top + (0.0 if self._bound is None else parameter.log_prior(best.config))
        self.limit = self._distance(parameter.bounds[0 if sign < 0.0 else 1])

    def value(self, distance: float) -> float:
        """The parameter at a distance [SI]."""
        if self._vanishing:
            return self._parameter.bounds[0] + distance
        return self._parameter.value(self._start + distance * self._unit)

    def end(self) -> tuple[float, bool]:
        """The distance at which the profile has dropped by 1.92, or the limit; whether it is from the profile."""
        from scipy.optimize import brentq

        end = min(Z95, self.limit)
        if self._bound is not None:
            places = [0.5**n * self.limit for n in range(_HALVINGS + 1)]
            end = places[
                bisect_left(places, True, hi=_HALVINGS, key=lambda distance: _root(self._drop(distance)) < Z95)
            ]
        elif self.limit > Z95:
            drop = self._drop(Z95)
            if abs(drop / (0.5 * Z95**2) - 1.0) < _SKEWED:
                return Z95, False
            end = min(max(Z95 / _root(drop), 1.0 / _FARTHER), _FARTHER) * Z95
            end = min(end, self.limit)
        if (settled := self._settled(end)) is not None:
            return settled, True
        inner = 0.0
        while self._missing(end) < 0.0 and end < self.limit:
            if inner == 0.0 and self._may_be_none(end):
                return self.limit, True
            aimed = (1.0 + 0.5 * _CLOSE) * Z95 / self.root(end)  # a little beyond, by a parabola
            inner, end = end, min(min(_FARTHER, aimed) * end, self.limit)
        if self._missing(end) > 0.0:
            end = float(brentq(self._missing, inner, end, rtol=_CLOSE))
        return end, True

    def _settled(self, distance: float) -> float | None:
        """The distance at which the profile has dropped by 1.92, from one near it; None where that does not settle.

        Newton's method, for it and for the other coordinates at once (Venzon & Moolgavkar, Applied Statistics 37,
        1988). √(2 drop) is nearly straight along a profile.
        """
        others, last = self._expected(distance), np.inf
        none = np.zeros(len(others))
        for _ in range(_NEWTON):
            here = point(self._view.likelihood, self._along(distance, others), self._every, self._view.outcomes)
            others = coordinates(here.config, self._others)
            score, information, _ = derivatives(self._view.likelihood, here, self._every)
            inner, across, (low, high) = information[:-1, :-1], information[:-1, -1], self._bounds(others)
            ahead = bounded_step(score[:-1], inner, low, high, none)
            gain = float(score[:-1] @ ahead - 0.5 * ahead @ inner @ ahead)
            drop = self._top - here.log_posterior - gain
            root, pace = _root(drop), self._pace(distance)
            if gain < _EXPECTED and abs(root / Z95 - 1.0) < _CLOSE:
                self._maxima[distance] = _Maximum(drop, others + ahead)
                return distance
            steepness = float(across @ ahead - score[-1]) * pace / root
            if steepness <= 0.0 or gain > _HOPELESS:
                return None
            farther = min(max(1.0 + (Z95 - root) / (steepness * distance), 1.0 / _FARTHER), _FARTHER) * distance
            if farther >= self.limit:
                return None
            # a gain that does not fall is stepped over: with a damping of 1 steps are half as long
            damping, step = none + float(gain > 0.5 * last), pace * (farther - distance)
            others = others + bounded_step(score[:-1] - across * step, inner, low, high, damping)
            distance, last = farther, gain
        return None

    def _bounds(self, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far the other coordinates may step down and up, (k,) each."""
        low, high = self._range
        return np.maximum(low - others, -self._reach), np.minimum(high - others, self._reach)

    def _pace(self, distance: float) -> float:
        """How the coordinate changes with the distance."""
        return 1.0 / self.value(distance) if self._vanishing else self._unit

    def root(self, distance: float) -> float:
        """The standard deviations that the drop of the profile at a distance stands for."""
        same = (before for before in self._maxima if math.isclose(before, distance, rel_tol=_SAME))
        distance = next(same, distance)
        if distance not in self._maxima:
            inner = max(before for before in self._maxima if before < distance)
            maximum = self._maximum(distance, self._expected(distance))
            if _root(maximum.drop) > _FALLEN * Z95:  # another maximum, perhaps: the one inside goes on
                beside = self._maximum(distance, self._maxima[inner].others)
                maximum = min(maximum, beside, key=lambda point: point.drop)
            self._maxima[distance] = maximum
        return _root(self._maxima[distance].drop)

    def _may_be_none(self, distance: float) -> bool:
        """Whether a noise that has not dropped at a distance may be 0: on the way there its profile hardly changes."""
        if not self._parameter.vanishes or self._unit > 0.0:
            return False
        maximum = self._maximum(self.limit, self._maxima[distance].others)
        if may_be := _root(maximum.drop) < Z95:
            self._maxima[self.limit] = maximum
        return may_be

    def curve(self, end: float, profiled: bool) -> list[tuple[float, float]]:
        """Points of the profile to one and a half times the end: values [SI] and what the likelihood drops by."""
        middle, value = self.value(0.0), self.value(end)
        if self._parameter.log and min(middle, value) > _NEXT_TO_NONE * max(middle, value) and not self._vanishing:
            places = [share * end for share in _SHARES]
        else:
            places = [self._distance(middle + share * (value - middle)) for share in _SHARES]
        places = [distance for distance in places if distance <= self.limit]
        if profiled:
            for distance in places:
                self.root(distance)
            drops = {distance: point.drop for distance, point in self._maxima.items() if 0.0 < distance <= max(places)}
        else:
            drops = {distance: self._drop(distance) for distance in places}
        return [(self._parameter.clipped(self.value(at)), -drop) for at, drop in drops.items()]

    def _distance(self, value: float) -> float:
        low, high = self._parameter.bounds
        if self._vanishing:
            return value - low
        if not low <= value <= high:
            return np.inf
        return (self._parameter.coordinate(value) - self._start) / self._unit

    def _missing(self, distance: float) -> float:
        """The root at a distance less 1.96; 0 where that is next to none."""
        root = self.root(distance)
        return 0.0 if abs(root / Z95 - 1.0) < _CLOSE else root - Z95

    def _expected(self, distance: float) -> FloatArray:
        """The other coordinates at a distance by those that are known: between two, or onwards from the last."""
        inner, outer = ([at for at in sorted(self._maxima) if (at > distance) == beyond] for beyond in (False, True))
        last, at = inner[-1], self._maxima[inner[-1]].others
        if outer:
            return at + (distance - last) / (outer[0] - last) * (self._maxima[outer[0]].others - at)
        slope = self._slope if last == 0.0 else (at - self._maxima[0.0].others) / last
        return at + np.clip((distance - last) * slope, -self._reach, self._reach)

    def _along(self, distance: float, others: FloatArray) -> FusionConfig:
        config = self._parameter.set(self._best.config, self._parameter.clipped(self.value(distance)))
        return moved(config, self._others, np.clip(others, *self._range))

    def _drop(self, distance: float) -> float:
        """What the likelihood drops by with the others where they are expected."""
        config = self._along(distance, self._maxima[0.0].others + distance * self._slope)
        return self._top - point(self._view.likelihood, config, self._every, self._view.outcomes).log_posterior

    def _maximum(self, distance: float, others: FloatArray) -> _Maximum:
        """The maximum next to these other coordinates."""
        peak = maximise(
            self._view.likelihood,
            self._along(distance, others),
            self._others,
            outcomes=self._view.outcomes,
            tolerance=_TOLERANCE,
            worth=self._top - _FAR_BELOW,
        )
        drop = self._top - peak.log_posterior - self._parameter.log_prior(peak.config)
        return _Maximum(drop, coordinates(peak.config, self._others))


def _root(drop: float) -> float:
    """The standard deviations that a drop of a Gaussian log-likelihood stands for."""
    return float(np.sqrt(2.0 * max(drop, 1e-9)))


# ---- lags -----------------------------------------------------------------------------------------------------------


def lag_intervals(likelihood: Likelihood, best: Point, free: Sequence[Parameter]) -> dict[str, Distances]:
    """How far the 95 % interval of each axis's lag reaches down and up, by its gradient and the information.

    Where the score scatters more over pieces of the runs than the information says, the interval is as much wider
    (White, Econometrica 50, 1982): a real arm's lag wanders a little, and the next recording has another one.

    A delay at its bound of 0 counts as if it were inside: plant and delay make up for each other there, too, and
    without it the lag would seem to be known as well as the plant alone. Other parameters at a bound stay there. Where
    all that would move the lag one way are at their bounds, it is open that way.
    """
    slopes = lag_slopes(free, best.config)
    if not slopes:
        return {}
    bounds = [parameter.at_bound(best.config) for parameter in free]
    inside = [n for n, bound in enumerate(bounds) if bound is None or free[n].fit == "delay"]
    some = [free[n] for n in inside]
    _, information, scatter = derivatives(likelihood, best, some)
    cov = covariance(information, some)
    real = cov @ scatter @ cov
    distances: dict[str, Distances] = {}
    for axis, slope in slopes.items():
        inner = slope[inside]
        half = Z95 * float(np.sqrt(max(inner @ cov @ inner, inner @ real @ inner)))
        half = half if 0.0 < half < _UNLIMITED else np.inf
        moving = [(bounds[n], slope[n] > 0.0) for n in np.flatnonzero(slope)]
        down, up = (
            all(bound == ("lower" if rises == upwards else "upper") for bound, rises in moving)
            for upwards in (True, False)
        )
        distances[axis] = (np.inf if down else half, np.inf if up else half)
    return distances


def lag_slopes(free: Sequence[Parameter], config: FusionConfig) -> dict[str, FloatArray]:
    """The derivatives of each axis's lag by the coordinates (k,), where any is not 0."""

    def slope(parameter: Parameter, axis: str) -> float:
        at = parameter.at(config)
        up, down = (parameter.move(config, at + step).arm.lag_of(axis) for step in (_LAG_STEP, -_LAG_STEP))
        return (up - down) / (2.0 * _LAG_STEP)

    by_axis = {axis: np.array([slope(parameter, axis) for parameter in free]) for axis in config.arm.axes}
    return {axis: slopes for axis, slopes in by_axis.items() if slopes.any()}
