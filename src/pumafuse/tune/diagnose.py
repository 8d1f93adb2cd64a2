"""How sure a fit is: intervals, parameters that go together, and what the readings cannot tell."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..fusion.config import FusionConfig
from ..fusion.score import Z95
from ..fusion.ticks import usable_cores
from ..model.plants import Interval
from .likelihood import Evidence
from .parameters import Parameter
from .search import Point, climb, moved, point, slopes

_ENOUGH = 0.02  # log-likelihood to which a profile is followed
_SKEWED = 0.05  # relative error of the curvature's drop at an end, beyond which the profile is followed
_STEPS = 8  # of a profile towards its end
_CLOSE = 0.03  # relative, of √(2 drop)
_HALVINGS = 16
_POWER = 3.0  # of a noise, between those with which the likelihood drops where it is small (4) and large (2)
_HIGHLY = 0.9  # a correlation worth naming
_MEMBER = 0.3  # share of the largest weight, from which a parameter belongs to a combination
_AT_BOUND = 1e-6
_CONTRACTS = ("latency", "gain", "plant", "delay")  # what of a combination is held rather than the next


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
class Tie:
    """A combination of parameters that the readings do not tell.

    Attributes:
        members: Their names, those that change most first.
        held: Which of them was held for that.
    """

    members: tuple[str, ...]
    held: str


def covariance(information: FloatArray, free: Sequence[Parameter]) -> FloatArray:
    """Of the coordinates, (k, k), from the information (k, k); what nothing tells has an enormous variance."""
    size = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12 / np.square([one.scale for one in free])))
    values, vectors = np.linalg.eigh(information * np.outer(size, size))
    return (vectors / np.maximum(values, 1e-12)) @ vectors.T * np.outer(size, size)


def at_bound(one: Parameter, config: FusionConfig) -> str | None:
    """``least`` or ``greatest`` where a parameter lies at that bound."""
    low, high = one.range
    at, margin = one.coordinate(one.get(config)), _AT_BOUND * (high - low)
    return "least" if at <= low + margin else "greatest" if at >= high - margin else None


def sureness(evidence: Evidence, best: Point, free: Sequence[Parameter]) -> dict[str, Sure]:
    """The 95 % interval of each free parameter, by its name.

    From the curvature: 1.96 sd of the coordinate each way. Where the likelihood at an end, the others moved along, has
    not dropped by what that says (1.92), the end is where the profile has (Cox & Hinkley, Theoretical Statistics, 9.3).
    """
    inside = [one for one in free if at_bound(one, best.config) is None]
    cov = covariance(slopes(evidence, best, inside).information, inside) if inside else np.zeros((0, 0))

    def of(one: Parameter) -> Sure:
        if one not in inside:
            return _from_the_bound(evidence, best, one, inside)
        number = inside.index(one)
        line = cov[:, number] / np.sqrt(cov[number, number])  # how all move with this one, for one sd of it
        low, high = (_end(evidence, best, inside, number, sign * line) for sign in (-1.0, 1.0))
        ci95 = (one.value(low.coordinate), one.value(high.coordinate))
        return Sure(ci95, low.profiled or high.profiled, None, (low.open, high.open))

    with ThreadPoolExecutor(usable_cores()) as pool:
        return dict(zip([one.key for one in free], pool.map(of, free), strict=True))


@dataclass(frozen=True)
class _End:
    coordinate: float
    profiled: bool
    open: bool


def _end(evidence: Evidence, best: Point, free: Sequence[Parameter], number: int, line: FloatArray) -> _End:
    """One end of the interval of ``free[number]``; ``line`` is how all parameters move for one sd towards it."""
    one = free[number]
    mine = _with(one, free)
    alone, outcomes = _around(evidence, best, mine)
    at = np.array([other.coordinate(other.get(best.config)) for other in mine])
    along = line[[free.index(other) for other in mine]]
    place = mine.index(one)
    low, high = np.array([other.range for other in mine]).T
    others = [other for other in mine if other is not one]
    top = point(alone, best.config, mine, outcomes).height
    reach = Z95
    limit = (high[place] - at[place]) / along[place] if along[place] > 0.0 else (low[place] - at[place]) / along[place]
    profiled = False
    for _ in range(_STEPS):
        reach = min(reach, limit)
        there = moved(best.config, mine, np.clip(at + reach * along, low, high))
        if profiled:
            height = climb(alone, there, others, outcomes=outcomes, enough=_ENOUGH).height + _prior_of(one, there)
        else:
            height = point(alone, there, mine, outcomes).height
        root = float(np.sqrt(2.0 * max(top - height, 1e-9)))
        if not profiled and abs((root / reach) ** 2 - 1.0) < _SKEWED and reach < limit:
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


def _with(one: Parameter, free: Sequence[Parameter]) -> list[Parameter]:
    """The parameters that bear on one: of its axis and of all axes; every one for one of all axes."""
    return [other for other in free if other.axis in (None, one.axis) or one.axis is None]


def _around(evidence: Evidence, best: Point, mine: Sequence[Parameter]) -> tuple[Evidence, Sequence[CodeArray]]:
    """What bears on parameters: their axis alone where none is of all axes."""
    axes = {one.axis for one in mine}
    if len(axes) > 1 or None in axes:
        return evidence, best.value.outcomes
    return evidence.alone(str(axes.pop()), best.value.outcomes)


def _from_the_bound(evidence: Evidence, best: Point, one: Parameter, inside: Sequence[Parameter]) -> Sure:
    """The interval of a parameter at a bound: from there to where the profile has dropped by 1.92.

    The others stay at first, which drops faster; then they move, and the end goes on as a power of the distance says.
    """
    others = _with(one, inside)
    alone, outcomes = _around(evidence, best, [*others, one])
    bound, (low, high) = one.coordinate(one.get(best.config)), one.range
    upwards = bound < 0.5 * (low + high)
    top, enough = point(alone, best.config, [*others, one], outcomes).height, 0.5 * Z95**2
    near, far = (low, high) if upwards else (high, low)
    for _ in range(_HALVINGS):
        middle = 0.5 * (near + far)
        held = point(alone, one.move(best.config, middle), [*others, one], outcomes)
        near, far = (middle, far) if top - held.height < enough else (near, middle)
    end, along = near, best.config
    for _ in range(_STEPS):
        there = climb(alone, one.move(along, end), others, outcomes=outcomes, enough=_ENOUGH)
        drop, along = top - there.height - _prior_of(one, there.config), there.config
        if abs(np.sqrt(max(drop, 0.0) / enough) - 1.0) < _CLOSE or end == far:
            break
        change = np.log(enough / max(drop, 0.02 * enough)) / _POWER
        end = float(np.clip(end + (change if upwards else -change) * (1.0 if one.log else abs(end - bound)), low, high))
    if upwards:
        return Sure((one.bounds[0], one.value(end)), True, "least", (True, False))
    return Sure((one.value(end), one.bounds[1]), True, "greatest", (False, True))


def correlations(evidence: Evidence, best: Point, free: Sequence[Parameter]) -> list[tuple[str, str, float]]:
    """Pairs of parameters that the readings tell only together: |correlation| > 0.9."""
    inside = [one for one in free if at_bound(one, best.config) is None]
    if not inside:
        return []
    cov = covariance(slopes(evidence, best, inside).information, inside)
    sd = np.sqrt(np.diag(cov))
    matrix = cov / np.outer(sd, sd)
    return [
        (inside[i].key, inside[j].key, float(matrix[i, j]))
        for i in range(len(inside))
        for j in range(i)
        if abs(matrix[i, j]) > _HIGHLY
    ]


def untold(evidence: Evidence, best: Point, free: Sequence[Parameter]) -> Tie | None:
    """The combination of delays, latencies, plants and gains that the readings tell least, if they do not tell it.

    They do not where its standard deviation, without any prior, is more than a large change of it: a factor e, a tick
    of 28 ms, a tenth of the gain. The one to hold is a latency first, that of the sensor with the least noise.
    """
    inside = [one for one in free if at_bound(one, best.config) is None]
    arm = [number for number, one in enumerate(inside) if one.fit != "noise"]
    if not arm:
        return None
    found = evidence.slopes(best.config, inside, best.value.outcomes)
    cov = covariance(found.information, inside)[np.ix_(arm, arm)]
    scale = np.array([inside[number].scale for number in arm])
    values, vectors = np.linalg.eigh(cov / np.outer(scale, scale))
    if values[-1] < 1.0:
        return None
    weight = np.abs(vectors[:, -1])
    order = [int(place) for place in np.argsort(-weight) if weight[place] > _MEMBER * weight.max()]
    members = [inside[arm[place]] for place in order]
    held = min(members, key=lambda one: (_CONTRACTS.index(one.fit), _noise_of(one, best.config), one.key))
    return Tie(tuple(one.key for one in members), held.key)


def _noise_of(one: Parameter, config: FusionConfig) -> float:
    """The least noise of the sensor that a latency is of [m]."""
    if one.fit != "latency":
        return 0.0
    sd = config.sensors[one.key.split(".")[1]].sd
    return min(sd.values()) if isinstance(sd, dict) else sd
