"""The log-likelihood along one parameter at a time, the others following: what an interval is read off."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..fusion.config import FusionConfig
from ..fusion.ticks import usable_cores
from .climb import Point, climb, point
from .intervals import View, views_of
from .lesson import Lesson
from .likelihood import Evidence
from .parameters import Parameter, coordinates, moved
from .summary import Fitted

_SHARES = (0.3, 0.65, 1.0, 1.5)  # of the way from the best to an end of the interval, where the points are
_ENOUGH = 0.3  # log-likelihood to which the ridge is climbed there


@dataclass(frozen=True)
class Profile:
    """The log-likelihood along one parameter.

    Attributes:
        key: The parameter's name.
        axis: The axis it is of; None where it is of all.
        log: Whether it belongs on a log scale. A noise that may be none does not: none must be on the scale too.
        values: The parameter, in the unit of its key, ascending, (n,).
        drop: The log-likelihood there less that of the peak, (n,).
    """

    key: str
    axis: str | None
    log: bool
    values: FloatArray
    drop: FloatArray


def profiles(lesson: Lesson, fitted: Sequence[Fitted]) -> list[Profile]:
    """The log-likelihood along each parameter of a lesson, to one and a half times its interval each way.

    The others follow the line of their regression on it, Cov(·, a) / Var a, bent to where they are most likely at the
    interval's ends. That is a lower bound of the profile likelihood, and close to it. As for the intervals, what became
    of each measurement stays as it is at the best point, and the peak is the one that it has then.

    Args:
        lesson: What was learnt.
        fitted: Its parameters with their intervals, perhaps among others.

    Returns:
        One for each parameter but those whose interval has no width.
    """
    ci95 = {one.key: one.ci95 for one in fitted}
    best = climb(lesson.evidence, lesson.best.config, lesson.free, outcomes=lesson.best.value.outcomes)
    views = views_of(lesson.evidence, best, lesson.free)

    def of(one: Parameter) -> Profile:
        return _profile(_ridge(views[one.axis], best, one), ci95[one.key])

    with ThreadPoolExecutor(usable_cores()) as pool:
        return [one for one in pool.map(of, lesson.free) if len(one.values) > 1]


@dataclass(frozen=True)
class _Ridge:
    """Where the likelihood is highest for each value of one parameter.

    Attributes:
        evidence: The measurements that it and what follows it bear on.
        outcomes: What became of them.
        best: The best point.
        mine: The parameter, and after it those that follow it.
        start: Their coordinates at the best point, (k,).
        line: How they change with the first, (k,).
    """

    evidence: Evidence
    outcomes: Sequence[CodeArray]
    best: Point
    mine: Sequence[Parameter]
    start: FloatArray
    line: FloatArray

    def straight(self, coordinate: float) -> FloatArray:
        """All coordinates for one of the first, by regression, (k,); as a noise shrinks, on its variance."""
        change = coordinate - float(self.start[0])
        if self.mine[0].fit == "noise" and change < 0.0:
            change = 0.5 * math.expm1(2.0 * change)
        return np.append(coordinate, (self.start + self.line * change)[1:])

    def at(self, coordinates: FloatArray) -> Point:
        """What the measurements say there."""
        return point(self.evidence, self.config(coordinates), self.mine, self.outcomes)

    def config(self, coordinates: FloatArray) -> FusionConfig:
        """The configuration there, or the nearest that may be."""
        low, high = np.array([one.range for one in self.mine]).T
        return moved(self.best.config, self.mine, np.clip(coordinates, low, high))

    def bend(self, coordinate: float) -> FloatArray:
        """How far beside the straight line the ridge lies there, (k,)."""
        straight = self.straight(coordinate)
        others = self.mine[1:]
        there = climb(self.evidence, self.config(straight), others, outcomes=self.outcomes, enough=_ENOUGH).config
        return np.append(0.0, coordinates(there, others) - straight[1:])


def _ridge(view: View, best: Point, one: Parameter) -> _Ridge:
    keys = [other.key for other in view.free]
    mine = [one, *(other for other in view.free if other.key != one.key)]
    line = np.zeros(len(mine))
    if one.key in keys:
        number = keys.index(one.key)
        along = view.covariance[:, number] / view.covariance[number, number]
        line = along[[keys.index(other.key) for other in mine]]
    start = coordinates(best.config, mine)
    return _Ridge(view.evidence, view.outcomes, best, mine, start, line)


def _profile(ridge: _Ridge, ci95: tuple[float | None, float | None]) -> Profile:
    one = ridge.mine[0]
    ends = [bound if end is None else end * one.unit for end, bound in zip(ci95, one.bounds, strict=True)]
    log = one.log and not (one.vanishes and ends[0] <= one.bounds[0])
    best, top = one.value(float(ridge.start[0])), ridge.at(ridge.start).height
    values, drop = [best], [0.0]
    for end in ends:
        for value, height in _side(ridge, best, max(end, one.bounds[0]), log):
            values.append(value)
            drop.append(height - top)
    order = np.argsort(values)
    return Profile(one.key, one.axis, log, np.array(values)[order] / one.unit, np.array(drop)[order])


def _side(ridge: _Ridge, best: float, end: float, log: bool) -> list[tuple[float, float]]:
    """Values [SI] from the best to beyond an end of the interval, and the height of each."""
    if math.isclose(end, best):
        return []
    one = ridge.mine[0]
    shares = np.array(_SHARES)
    values = best * (end / best) ** shares if log else best + (end - best) * shares
    within = (values >= one.bounds[0]) & (values <= one.bounds[1]) | (shares == 1.0)
    bend = ridge.bend(one.coordinate(end))
    return [
        (value, ridge.at(ridge.straight(one.coordinate(value)) + bend * share**2).height)
        for value, share in zip(values[within].tolist(), shares[within].tolist(), strict=True)
    ]
