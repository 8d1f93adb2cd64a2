"""95 % confidence intervals from the curvature and the profile of the likelihood, and the profiles to draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..fusion.config import FusionConfig
from ..fusion.score import Z95
from ..toml import Interval
from .identifiability import covariance, within_bounds
from .likelihood import Likelihood, in_threads
from .maximise import Point, derivatives, maximise, point
from .parameters import Parameter, coordinates, moved, rounded

Distances: TypeAlias = tuple[float, float]  # s; to the lower and upper end of an interval, infinite where it is open

_TOLERANCE = 0.02  # log-likelihood to which a profile is maximised
_SKEWED = 0.05  # relative error of the curvature's drop at an end, beyond which the profile is computed
_CLOSE = 0.03  # relative, of √(2 drop)
_FARTHER = 1.5  # times the distance, while an end is not yet between two
_HALVINGS = 26
_LAG_STEP = 1e-5  # of a coordinate
_UNLIMITED = 10.0  # s; an interval of a lag as wide as this is none
_SHARES = np.array((0.3, 0.65, 1.0, 1.5))  # of the way from the best to an end of the interval: points that are drawn


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


@dataclass(frozen=True)
class ConfidenceInterval:
    """The 95 % confidence interval of a parameter.

    Attributes:
        ci95: The 95 % interval [SI]; an end at the parameter's bound is open.
        profiled: Whether the profile of the likelihood was computed, not only its curvature.
        at: The bound at which the value lies, else None.
        open: Which ends of the interval are open: the measurements do not limit them.
        profile: The likelihood along it, to one and a half times the interval each way.
    """

    ci95: Interval
    profiled: bool
    at: Literal["lower", "upper"] | None
    open: tuple[bool, bool]
    profile: Profile


class _View(NamedTuple):
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


def confidence_intervals(
    likelihood: Likelihood, best: Point, free: Sequence[Parameter]
) -> dict[str, ConfidenceInterval]:
    """Compute the 95 % interval of each free parameter, by its key.

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

    def of(one: Parameter) -> ConfidenceInterval:
        low, high = (_end(views[one.axis], best, one, sign) for sign in (-1.0, 1.0))
        peak = one.value(one.at(best.config))
        value, at = one.clipped(rounded(one.get(result))), one.at_bound(result)
        log = one.log and not (one.vanishes and low.value <= one.bounds[0])
        values, drop = np.array(sorted([*low.curve, (peak, 0.0), *high.curve])).T
        return ConfidenceInterval(
            ci95=(
                low.value if low.value < value else one.clipped(value - (peak - low.value)),
                high.value if high.value > value else one.clipped(value + (high.value - peak)),
            ),
            profiled=low.profiled or high.profiled,
            at=one.at_bound(best.config),
            open=(low.open or at == "lower", high.open or at == "upper"),
            profile=Profile(one.key, one.axis, log, values / one.unit, drop),
        )

    return dict(zip([one.key for one in free], in_threads(of, free), strict=True))


def _views(likelihood: Likelihood, best: Point, free: Sequence[Parameter]) -> Mapping[str | None, _View]:
    """The view of each axis, and under None, where a parameter is shared by all axes, the view of everything."""
    inside = within_bounds(free, best.config)
    shared = [one for one in inside if one.axis is None]
    own = {axis: [one for one in inside if one.axis == axis] for axis in likelihood.sensors}
    parts = {axis: (likelihood.of_axis(axis), likelihood.outcomes_of(axis, best.outcomes)) for axis in own}
    informed = {
        axis: _of_shared(part.derivatives(best.config, [*own[axis], *shared], outcomes).information, len(own[axis]))
        for axis, (part, outcomes) in (parts.items() if shared else ())
    }
    views: dict[str | None, _View] = {}
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


def _view(likelihood: Likelihood, outcomes: Sequence[CodeArray], best: Point, free: Sequence[Parameter]) -> _View:
    there = point(likelihood, best.config, free, outcomes)
    return _View(likelihood, outcomes, free, covariance(derivatives(likelihood, there, free).information, free))


class _End(NamedTuple):
    """An end of an interval: where it is [SI], whether it is profiled, whether it is open, and points to draw."""

    value: float
    profiled: bool
    open: bool
    curve: list[tuple[float, float]]


def _end(view: _View, best: Point, one: Parameter, sign: float) -> _End:
    """The lower (−1) or upper (+1) end of an interval.

    Distances are in standard deviations of the coordinate. From a bound they are in the coordinate, from a noise of 0
    in the noise itself.
    """
    from scipy.optimize import brentq

    bound, start = one.at_bound(best.config), one.at(best.config)
    if bound == ("lower" if sign < 0.0 else "upper"):
        return _End(one.value(start), True, True, [])
    others, more = [other for other in view.free if other.key != one.key], [] if bound is None else [one]
    at, slope, sd = coordinates(best.config, others), np.zeros(len(others)), 1.0
    for place, other in enumerate(view.free):
        if other.key == one.key:  # by regression, Cov(·, a) / Var a
            slope = np.delete(view.covariance[:, place] / view.covariance[place, place], place)
            sd = float(np.sqrt(view.covariance[place, place]))
    low, high = np.array([other.range for other in others]).reshape(-1, 2).T
    vanishing = bound is not None and one.vanishes
    unit = sign * sd
    direction = unit * slope
    top = point(view.likelihood, best.config, [*view.free, *more], view.outcomes).log_posterior

    def distance_to(value: float) -> float:
        return value - one.bounds[0] if vanishing else (one.coordinate(value) - start) / unit

    def value_at(distance: float) -> float:
        return one.bounds[0] + distance if vanishing else one.value(start + distance * unit)

    def along(distance: float) -> FusionConfig:
        there = np.clip(at + distance * direction, low, high)
        return moved(one.put(best.config, one.clipped(value_at(distance))), others, there)

    def drop(distance: float) -> float:
        return top - point(view.likelihood, along(distance), [*view.free, *more], view.outcomes).log_posterior

    @cache
    def missing(distance: float) -> float:
        """The root of the profile's drop less 1.96 standard deviations; 0 where that is next to none."""
        nonlocal direction
        if distance == 0.0:
            return -Z95
        peak = maximise(view.likelihood, along(distance), others, outcomes=view.outcomes, tolerance=_TOLERANCE)
        direction = (coordinates(peak.config, others) - at) / distance
        root = _root(top - peak.log_posterior - one.log_prior(peak.config))
        return 0.0 if abs(root / Z95 - 1.0) < _CLOSE else root - Z95

    limit = distance_to(one.bounds[0 if sign < 0.0 else 1])
    end, profiled, beyond = min(Z95, limit), True, False
    if bound is not None:
        end = limit
        for _ in range(_HALVINGS):
            if _root(drop(end)) < Z95:
                break
            end *= 0.5
    elif limit > Z95:
        profiled = abs(drop(Z95) / (0.5 * Z95**2) - 1.0) >= _SKEWED
    if profiled:
        inner = 0.0
        while missing(end) < 0.0 and not beyond:
            inner, end, beyond = end, min(_FARTHER * end, limit), end >= limit
        if not beyond and missing(end) > 0.0:
            end = brentq(missing, inner, end, rtol=_CLOSE)
    value, middle = one.clipped(value_at(end)), one.value(start)
    linear = not one.log or (one.vanishes and (vanishing or value <= one.bounds[0]))
    points = middle + (value - middle) * _SHARES if linear else middle * (value / middle) ** _SHARES
    drawn = [one.clipped(there) for there in points[:-1].tolist()]
    if one.bounds[0] <= points[-1] <= one.bounds[1]:  # it lies beyond the end
        drawn.append(float(points[-1]))
    return _End(value, profiled, beyond, [(there, -drop(distance_to(there))) for there in drawn])


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
    bounds = [one.at_bound(best.config) for one in free]
    inside = [n for n, (one, bound) in enumerate(zip(free, bounds, strict=True)) if bound is None or one.fit == "delay"]
    some = [free[n] for n in inside]
    _, information, scatter = derivatives(likelihood, best, some)
    cov = covariance(information, some)
    real = cov @ scatter @ cov
    found: dict[str, Distances] = {}
    for axis, slope in slopes.items():
        inner = slope[inside]
        half = Z95 * float(np.sqrt(max(inner @ cov @ inner, inner @ real @ inner)))
        half = half if 0.0 < half < _UNLIMITED else np.inf
        moving = [(bounds[n], slope[n] > 0.0) for n in np.flatnonzero(slope)]
        down, up = (
            all(bound == ("lower" if rises == upwards else "upper") for bound, rises in moving)
            for upwards in (True, False)
        )
        found[axis] = (np.inf if down else half, np.inf if up else half)
    return found


def lag_slopes(free: Sequence[Parameter], config: FusionConfig) -> dict[str, FloatArray]:
    """The derivatives of each axis's lag by the coordinates (k,), where any is not 0."""

    def slope(one: Parameter, axis: str) -> float:
        at = one.at(config)
        up, down = (one.move(config, at + step).arm.lag_of(axis) for step in (_LAG_STEP, -_LAG_STEP))
        return (up - down) / (2.0 * _LAG_STEP)

    found = {axis: np.array([slope(one, axis) for one in free]) for axis in config.arm.axes}
    return {axis: slopes for axis, slopes in found.items() if slopes.any()}
