"""How sure each number is: 95 % intervals from the curvature, and from the profile where that is not enough."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..fusion.config import FusionConfig
from ..fusion.score import Z95
from ..fusion.ticks import usable_cores
from ..toml import Interval
from .climb import Point, climb, point, slopes
from .diagnose import at_bound, covariance
from .likelihood import Evidence
from .parameters import Parameter, coordinates, moved, rounded

_ENOUGH = 0.02  # log-likelihood to which a profile is followed
_SKEWED = 0.05  # relative error of the curvature's drop at an end, beyond which the profile is followed
_SKEWED_FOR_ALL = 0.2  # likewise of a number of all axes, whose profile takes ten times as long
_STEPS = 12  # of a profile towards its end
_CLOSE = 0.03  # relative, of √(2 drop)
_HALVINGS = 26


@dataclass(frozen=True)
class ConfidenceInterval:
    """The 95 % confidence interval of a parameter.

    Attributes:
        ci95: The 95 % interval [SI]; an end at the parameter's bound is open.
        profiled: Whether the likelihood's profile was followed, not only its curvature.
        at: ``least`` or ``greatest`` where the value lies at that bound, else None.
        open: Which ends of the interval are open: the measurements do not limit them.
    """

    ci95: Interval
    profiled: bool
    at: str | None
    open: tuple[bool, bool]


@dataclass(frozen=True)
class View:
    """What bears on the numbers of one axis, or of all.

    Attributes:
        evidence: The measurements.
        outcomes: What became of them.
        free: The numbers that may move and are not at a bound. Those of all axes have what the other axes say of them
            as their prior.
        covariance: Of their coordinates, (k, k).
    """

    evidence: Evidence
    outcomes: Sequence[CodeArray]
    free: Sequence[Parameter]
    covariance: FloatArray


def confidence_intervals(evidence: Evidence, best: Point, free: Sequence[Parameter]) -> dict[str, ConfidenceInterval]:
    """The 95 % interval of each free parameter, by its name.

    From the curvature: 1.96 sd of the coordinate each way. Where the likelihood at an end, the others moved along, has
    not dropped by what that says (1.92), the end is where the profile has (Cox & Hinkley, Theoretical Statistics, 9.3).
    Gates make the likelihood jump; the intervals are those of the peak that it has while the outcomes stay as they are.
    That peak is not what is told: at it the gates decide otherwise, and to a lower likelihood, or the search would have
    gone there. What the search ended with is the likeliest that is known, so an interval beside it reaches to it.
    """
    told = best.config
    best = climb(evidence, told, free, outcomes=best.value.outcomes)
    views = views_of(evidence, best, free)

    def of(one: Parameter) -> ConfidenceInterval:
        view = views[one.axis]
        if at_bound(one, best.config) is not None:
            return _reaching(_from_the_bound(view, best, one), one, told)
        low, high = (_end(view, best, one, sign) for sign in (-1.0, 1.0))
        ci95 = (one.value(low.coordinate), one.value(high.coordinate))
        found = ConfidenceInterval(ci95, low.profiled or high.profiled, None, (low.open, high.open))
        return _reaching(found, one, told)

    with ThreadPoolExecutor(usable_cores()) as pool:
        return dict(zip([one.key for one in free], pool.map(of, free), strict=True))


def _reaching(found: ConfidenceInterval, one: Parameter, told: FusionConfig) -> ConfidenceInterval:
    """The interval as far as to the value that is told, as it is written; open where that is at a bound."""
    value, at, (low, high) = one.inside(rounded(one.get(told))), at_bound(one, told), found.ci95
    ends = (found.open[0] or at == "least", found.open[1] or at == "greatest")
    return replace(found, ci95=(min(low, value), max(high, value)), open=ends)


def views_of(evidence: Evidence, best: Point, free: Sequence[Parameter]) -> Mapping[str | None, View]:
    """For each axis what bears on it alone, and under None, where a number is of all axes, everything."""
    inside = [one for one in free if at_bound(one, best.config) is None]
    shared = [one for one in inside if one.axis is None]
    own = {axis: [one for one in inside if one.axis == axis] for axis in evidence.heard}
    alone = {axis: (evidence.alone(axis), evidence.outcomes_of(axis, best.value.outcomes)) for axis in evidence.heard}
    told = {
        axis: _told_of_shared(part.slopes(best.config, [*own[axis], *shared], outcomes).information, len(own[axis]))
        for axis, (part, outcomes) in (alone.items() if shared else ())
    }
    views: dict[str | None, View] = {}
    for axis, (part, outcomes) in alone.items():
        elsewhere = sum((told[other] for other in told if other != axis), np.zeros(len(shared)))
        priors = [
            replace(one, prior=(one.at(best.config), 1.0 / np.sqrt(max(float(told_of), 1e-12))))
            for one, told_of in zip(shared, elsewhere, strict=True)
        ]
        views[axis] = _view(part, outcomes, best, [*own[axis], *priors])
    if any(one.axis is None for one in free):
        views[None] = _view(evidence, best.value.outcomes, best, inside)
    return views


def _told_of_shared(information: FloatArray, own: int) -> FloatArray:
    """What an axis says of each shared number, its own being free: the Schur complement's diagonal."""
    inner = np.linalg.pinv(information[:own, :own], hermitian=True)
    across = information[:own, own:]
    return np.diag(information[own:, own:] - across.T @ inner @ across)


def _view(evidence: Evidence, outcomes: Sequence[CodeArray], best: Point, free: Sequence[Parameter]) -> View:
    if not free:
        return View(evidence, outcomes, free, np.zeros((0, 0)))
    there = point(evidence, best.config, free, outcomes)
    return View(evidence, outcomes, free, covariance(slopes(evidence, there, free).information, free))


@dataclass(frozen=True)
class _End:
    coordinate: float
    profiled: bool
    open: bool


def _end(view: View, best: Point, one: Parameter, sign: float) -> _End:
    """The lower (−1) or upper (+1) end of an interval."""
    place = [other.key for other in view.free].index(one.key)
    others = [other for other in view.free if other.key != one.key]
    at = coordinates(best.config, view.free)
    along = sign * view.covariance[:, place] / np.sqrt(view.covariance[place, place])  # how all move for one sd of it
    low, high = np.array([other.range for other in view.free]).T
    top = point(view.evidence, best.config, view.free, view.outcomes).height
    limit = float(((high if along[place] > 0.0 else low)[place] - at[place]) / along[place])

    def curvature(reach: float) -> float:
        there = moved(best.config, view.free, np.clip(at + reach * along, low, high))
        return _root(top - point(view.evidence, there, view.free, view.outcomes).height)

    def profile(reach: float) -> float:
        nonlocal along
        there = moved(best.config, view.free, np.clip(at + reach * along, low, high))
        peak = climb(view.evidence, there, others, outcomes=view.outcomes, enough=_ENOUGH)
        along = (coordinates(peak.config, view.free) - at) / reach
        return _root(top - peak.height - _prior_of(one, there))

    skewed = _SKEWED if one.axis else _SKEWED_FOR_ALL
    if limit > Z95 and abs((curvature(Z95) / Z95) ** 2 - 1.0) < skewed:
        return _End(float(at[place] + Z95 * along[place]), profiled=False, open=False)
    unit = float(along[place])
    reach, beyond = _crossing(profile, min(Z95, limit), limit)
    return _End(float(at[place] + reach * unit), profiled=True, open=beyond)


def _from_the_bound(view: View, best: Point, one: Parameter) -> ConfidenceInterval:
    """The interval of a parameter at a bound: from there to where the profile has dropped by 1.92.

    It begins where the likelihood has dropped as far with the others held, which is too near.
    """
    every = [*view.free, one]
    bound, (low, high) = one.at(best.config), one.range
    upwards, span = bound < 0.5 * (low + high), high - low
    top, along = point(view.evidence, best.config, every, view.outcomes).height, best.config

    def place(distance: float) -> float:
        """The coordinate so far from the bound; of a noise that may be none, far in the noise itself."""
        if one.vanishes:
            return one.coordinate(one.bounds[0] + distance)
        return bound + (distance if upwards else -distance)

    def held(distance: float) -> float:
        there = point(view.evidence, one.move(best.config, place(distance)), every, view.outcomes)
        return _root(top - there.height)

    def profile(distance: float) -> float:
        nonlocal along
        peak = climb(view.evidence, one.move(along, place(distance)), view.free, outcomes=view.outcomes, enough=_ENOUGH)
        along = peak.config
        return _root(top - peak.height - _prior_of(one, along))

    limit = one.bounds[1] - one.bounds[0] if one.vanishes else span
    first = limit
    for _ in range(_HALVINGS):
        if held(first) < Z95:
            break
        first *= 0.5
    distance, beyond = _crossing(profile, first, limit)
    end = one.value(place(distance))
    if upwards:
        return ConfidenceInterval((one.bounds[0], end), True, "least", (True, beyond))
    return ConfidenceInterval((end, one.bounds[1]), True, "greatest", (beyond, True))


def _root(drop: float) -> float:
    """What a drop of the likelihood is in standard deviations, were it a parabola."""
    return float(np.sqrt(2.0 * max(drop, 1e-9)))


def _crossing(root: Callable[[float], float], first: float, limit: float) -> tuple[float, bool]:
    """How far a root of the drop is 1.96, and whether that is beyond the limit; ``first`` is where to begin.

    Bracketed, then by its logarithm, which is nearly a line over that of the distance.
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


def _prior_of(one: Parameter, config: FusionConfig) -> float:
    if one.prior is None:
        return 0.0
    return -0.5 * ((one.at(config) - one.prior[0]) / one.prior[1]) ** 2
