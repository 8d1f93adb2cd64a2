"""The total lag of each axis with its interval: delay, plant and gain are known much better together than each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from ..arrays import FloatArray
from ..fusion.config import FusionConfig
from ..fusion.score import Z95
from ..units import MS
from .identifiability import covariance
from .likelihood import Likelihood
from .maximise import Point, derivatives
from .parameters import Parameter
from .summary import FittedLag

Distances: TypeAlias = tuple[float, float]  # s; to the lower and upper end of an interval, infinite where it is open

_STEP = 1e-5  # of a coordinate
_UNLIMITED = 10.0  # s; an interval as wide as this is none


def fitted_lags(
    free: Sequence[Parameter], before: FusionConfig, after: FusionConfig, around: Mapping[str, Distances]
) -> dict[str, FittedLag]:
    """The lag of each axis that the free parameters change.

    Args:
        free: The parameters that were fitted.
        before: The configuration as given.
        after: The tuned one.
        around: From :func:`lag_intervals`; an axis that is not in it gets no interval.
    """
    found: dict[str, FittedLag] = {}
    for axis in _slopes(free, after):
        lag, (below, above) = after.arm.lag_of(axis), around.get(axis, (np.inf, np.inf))
        ends = [None if np.isinf(end) else end * MS for end in (lag - below, lag + above)]
        found[axis] = FittedLag(before_ms=before.arm.lag_of(axis) * MS, lag_ms=lag * MS, lag_ms_ci95=(ends[0], ends[1]))
    return found


def lag_intervals(likelihood: Likelihood, best: Point, free: Sequence[Parameter]) -> dict[str, Distances]:
    """How far the 95 % interval of each axis's lag reaches down and up, by its gradient and the information.

    Where the score scatters more over pieces of the runs than the information says, the interval is as much wider
    (White, Econometrica 50, 1982): a real arm's lag wanders a little, and the next recording has another one.

    A delay at its bound of 0 counts as if it were inside: plant and delay make up for each other there, too, and
    without it the lag would seem to be known as well as the plant alone. Other parameters at a bound stay there. Where
    all that would move the lag one way are at their bounds, it is open that way.
    """
    slopes = _slopes(free, best.config)
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


def _slopes(free: Sequence[Parameter], config: FusionConfig) -> dict[str, FloatArray]:
    """The derivatives of each axis's lag by the coordinates (k,), where any is not 0."""

    def slope(one: Parameter, axis: str) -> float:
        at = one.at(config)
        up, down = (one.move(config, at + step).arm.lag_of(axis) for step in (_STEP, -_STEP))
        return (up - down) / (2.0 * _STEP)

    found = {axis: np.array([slope(one, axis) for one in free]) for axis in config.arm.axes}
    return {axis: slopes for axis, slopes in found.items() if slopes.any()}
