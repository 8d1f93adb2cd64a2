"""How sure each number is: 95 % intervals from the curvature, and from the profile where that is not enough."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..fusion.config import FusionConfig
from ..fusion.score import Z95
from ..fusion.ticks import usable_cores
from ..model.plants import Interval
from .climb import Point, climb, moved, point, slopes
from .diagnose import at_bound, covariance
from .likelihood import Evidence
from .parameters import Parameter

_ENOUGH = 0.02  # log-likelihood to which a profile is followed
_SKEWED = 0.05  # relative error of the curvature's drop at an end, beyond which the profile is followed
_SKEWED_FOR_ALL = 0.2  # likewise of a number of all axes, whose profile takes ten times as long
_STEPS = 8  # of a profile towards its end
_CLOSE = 0.03  # relative, of √(2 drop)
_HALVINGS = 16
_POWER = 3.0  # of a noise, between those with which the likelihood drops where it is small (4) and large (2)


@dataclass(frozen=True)
class Sure:
    """How well a parameter is known.

    Attributes:
        ci95: The 95 % interval [SI]; an end at the parameter's bound is open.
        profiled: Whether the likelihood's profile was followed, not only its curvature.
        at: ``least`` or ``greatest`` where the value lies at that bound, else None.
        open: Which ends of the interval are open: the readings do not limit them.
    """

    ci95: Interval
    profiled: bool
    at: str | None
    open: tuple[bool, bool]


@dataclass(frozen=True)
class _View:
    """What bears on the numbers of one axis, or of all.

    Attributes:
        evidence: The readings.
        outcomes: What became of them.
        free: The numbers that may move and are not at a bound. Those of all axes have what the other axes say of them
            as their prior.
        covariance: Of their coordinates, (k, k).
    """

    evidence: Evidence
    outcomes: Sequence[CodeArray]
    free: Sequence[Parameter]
    covariance: FloatArray


def sureness(evidence: Evidence, best: Point, free: Sequence[Parameter]) -> dict[str, Sure]:
    """The 95 % interval of each free parameter, by its name.

    From the curvature: 1.96 sd of the coordinate each way. Where the likelihood at an end, the others moved along, has
    not dropped by what that says (1.92), the end is where the profile has (Cox & Hinkley, Theoretical Statistics, 9.3).
    Gates make the likelihood jump; the intervals are those of the peak that it has while the outcomes stay as they are.
    """
    best = climb(evidence, best.config, free, outcomes=best.value.outcomes)
    views = _views(evidence, best, [one for one in free if at_bound(one, best.config) is None])

    def of(one: Parameter) -> Sure:
        view = views[one.axis]
        if at_bound(one, best.config) is not None:
            return _from_the_bound(view, best, one)
        low, high = (_end(view, best, one, sign) for sign in (-1.0, 1.0))
        ci95 = (one.value(low.coordinate), one.value(high.coordinate))
        return Sure(ci95, low.profiled or high.profiled, None, (low.open, high.open))

    with ThreadPoolExecutor(usable_cores()) as pool:
        return dict(zip([one.key for one in free], pool.map(of, free), strict=True))


def _views(evidence: Evidence, best: Point, inside: Sequence[Parameter]) -> Mapping[str | None, _View]:
    """For each axis what bears on it alone, and under None everything."""
    shared = [one for one in inside if one.axis is None]
    own = {axis: [one for one in inside if one.axis == axis] for axis in evidence.axes}
    alone = {axis: (evidence.alone(axis), evidence.outcomes_of(axis, best.value.outcomes)) for axis in evidence.axes}
    told = {
        axis: _told_of_shared(part.slopes(best.config, [*own[axis], *shared], outcomes).information, len(own[axis]))
        for axis, (part, outcomes) in (alone.items() if shared else ())
    }
    views: dict[str | None, _View] = {}
    for axis, (part, outcomes) in alone.items():
        elsewhere = sum((told[other] for other in told if other != axis), np.zeros(len(shared)))
        priors = [
            replace(one, prior=(one.coordinate(one.get(best.config)), 1.0 / np.sqrt(max(float(told_of), 1e-12))))
            for one, told_of in zip(shared, elsewhere, strict=True)
        ]
        views[axis] = _view(part, outcomes, best, [*own[axis], *priors])
    if shared:
        views[None] = _view(evidence, best.value.outcomes, best, inside)
    return views


def _told_of_shared(information: FloatArray, own: int) -> FloatArray:
    """What an axis says of each shared number, its own being free: the Schur complement's diagonal."""
    inner = np.linalg.pinv(information[:own, :own], hermitian=True)
    across = information[:own, own:]
    return np.diag(information[own:, own:] - across.T @ inner @ across)


def _view(evidence: Evidence, outcomes: Sequence[CodeArray], best: Point, free: Sequence[Parameter]) -> _View:
    if not free:
        return _View(evidence, outcomes, free, np.zeros((0, 0)))
    there = point(evidence, best.config, free, outcomes)
    return _View(evidence, outcomes, free, covariance(slopes(evidence, there, free).information, free))


@dataclass(frozen=True)
class _End:
    coordinate: float
    profiled: bool
    open: bool


def _end(view: _View, best: Point, one: Parameter, sign: float) -> _End:
    """The lower (−1) or upper (+1) end of an interval."""
    place = [other.key for other in view.free].index(one.key)
    others = [other for other in view.free if other.key != one.key]
    at = np.array([other.coordinate(other.get(best.config)) for other in view.free])
    along = sign * view.covariance[:, place] / np.sqrt(view.covariance[place, place])  # how all move for one sd of it
    low, high = np.array([other.range for other in view.free]).T
    top = point(view.evidence, best.config, view.free, view.outcomes).height
    reach = Z95
    limit = (high[place] - at[place]) / along[place] if along[place] > 0.0 else (low[place] - at[place]) / along[place]
    profiled = False
    for _ in range(_STEPS):
        reach = min(reach, limit)
        there = moved(best.config, view.free, np.clip(at + reach * along, low, high))
        if profiled:
            peak = climb(view.evidence, there, others, outcomes=view.outcomes, enough=_ENOUGH)
            height = peak.height + _prior_of(one, there)
            along = (np.array([other.coordinate(other.get(peak.config)) for other in view.free]) - at) / reach
        else:
            height = point(view.evidence, there, view.free, view.outcomes).height
        root = float(np.sqrt(2.0 * max(top - height, 1e-9)))
        if (
            not profiled
            and abs((root / reach) ** 2 - 1.0) < (_SKEWED if one.axis else _SKEWED_FOR_ALL)
            and reach < limit
        ):
            break
        if profiled and (abs(root / Z95 - 1.0) < _CLOSE or (reach >= limit and root < Z95)):
            break
        if profiled:
            reach *= min(max(Z95 / root, 0.4), 3.0)
        profiled = True
    return _End(float(at[place] + reach * along[place]), profiled, bool(reach >= limit))


def _prior_of(one: Parameter, config: FusionConfig) -> float:
    if one.prior is None:
        return 0.0
    return -0.5 * ((one.coordinate(one.get(config)) - one.prior[0]) / one.prior[1]) ** 2


def _from_the_bound(view: _View, best: Point, one: Parameter) -> Sure:
    """The interval of a parameter at a bound: from there to where the profile has dropped by 1.92.

    The others stay at first, which drops faster; then they move, and the end goes on as a power of the distance says.
    """
    every = [*view.free, one]
    bound, (low, high) = one.coordinate(one.get(best.config)), one.range
    upwards = bound < 0.5 * (low + high)
    top, enough = point(view.evidence, best.config, every, view.outcomes).height, 0.5 * Z95**2
    near, far = (low, high) if upwards else (high, low)
    for _ in range(_HALVINGS):
        middle = 0.5 * (near + far)
        held = point(view.evidence, one.move(best.config, middle), every, view.outcomes)
        near, far = (middle, far) if top - held.height < enough else (near, middle)
    end, along = near, best.config
    for _ in range(_STEPS):
        there = climb(view.evidence, one.move(along, end), view.free, outcomes=view.outcomes, enough=_ENOUGH)
        drop, along = top - there.height - _prior_of(one, there.config), there.config
        if abs(np.sqrt(max(drop, 0.0) / enough) - 1.0) < _CLOSE or end == far:
            break
        change = np.log(enough / max(drop, 0.02 * enough)) / _POWER
        end = float(np.clip(end + (change if upwards else -change) * (1.0 if one.log else abs(end - bound)), low, high))
    if upwards:
        return Sure((one.bounds[0], one.value(end)), True, "least", (True, False))
    return Sure((one.value(end), one.bounds[1]), True, "greatest", (False, True))
