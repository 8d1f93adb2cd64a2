"""Which commands a sensor follows, how late and how far: correlation at every shift of its clock, without a filter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray, TimeArray, median

SMALL_SHIFT = 0.15  # s; a wrong delay, lag or latency may explain as much
_FARTHEST, _SHARE = 30.0, 0.75  # shifts that are looked for: s, and share of the run
_FINEST, _MOST = 0.01, 16_384  # s; bins of a run, and how many
_MOST_FAR, _CLEARLY = 131_072, 0.9  # bins where clocks differ; correlation from which it is known by how much
_MUCH_BETTER = math.log(4.0)  # another cause than the simplest must leave a quarter of the variance that this leaves
_AS_GOOD = math.log(1.5)  # of such valleys the nearest counts: a motion may repeat itself
_LEAST = 1e-6  # share of a variance that is left at least: bins are no finer
_ROUNDING = 1e-9  # share of a power below which a variance is the rounding of transforms
_SPIKE, _MOST_SPIKES = 10.0, 0.25  # times the usual distance from the values around, and the most that are outliers
_PIECES, _MOVING = 20, 4.0  # short pieces of a run, and how many of them must move
_SLIGHT = 0.1  # share of the greatest motion below which commands tell nothing at a shift


Rows: TypeAlias = tuple[TimeArray, FloatArray]  # stamps [ns] and values


class Grid(NamedTuple):
    """Even bins over a run, and further ones on both sides for shifts.

    Attributes:
        time: The middle of each bin, int64 ns, (n + 2m,).
        step: Their width [s].
        margin: m, how many on each side.
    """

    time: TimeArray
    step: float
    margin: int

    @staticmethod
    def over(first: int, last: int, period: float) -> Grid:
        """Bins from ``first`` to ``last`` [ns] as wide as the ``period`` [s] of the commands, or 10 ms."""
        span, step = (last - first) / 1e9, max(period, _FINEST)
        margin = math.ceil(min(_FARTHEST, _SHARE * span) / step)
        return Grid.around(first, span, step, margin)

    @staticmethod
    def around(first: int, span: float, step: float, margin: int) -> Grid:
        """Bins over ``span`` [s] from ``first`` [ns] on, with margins."""
        count = np.arange(-margin, math.ceil(span / step) + margin)
        return Grid(first + np.rint((count + 0.5) * (step * 1e9)).astype(np.int64), step, margin)

    @staticmethod
    def longest(period: float) -> int:
        """What the transforms are limited to [ns]."""
        return round(_MOST * max(period, _FINEST) * 1e9)

    @property
    def inner(self) -> slice:
        """The bins without the margins."""
        return slice(self.margin, len(self.time) - self.margin)

    def mean(self, stamp: TimeArray, value: FloatArray) -> FloatArray:
        """The mean of the values in each bin without the margins, NaN without any, (n,)."""
        size = len(self.time) - 2 * self.margin
        place = np.floor((stamp - self.time[self.margin]) / (self.step * 1e9) + 0.5).astype(np.int64)
        inside = (place >= 0) & (place < size)
        number = np.bincount(place[inside], minlength=size)
        total = np.bincount(place[inside], weights=value[inside], minlength=size)
        return np.divide(total, number, out=np.full(size, np.nan), where=number > 0)


class Match(NamedTuple):
    """What explains the motion that a sensor measures on an axis.

    Attributes:
        axis: The axis whose commands it follows.
        shift: How late it is [s]; 0 where that is no more than a wrong delay or latency explains.
        correlation: With the commanded motion then, apart from a constant and a trend.
        slope: Measured over commanded motion.
        is_steady: Whether short pieces of the run, each about its mean, tell about the same slope: drifts do not.
    """

    axis: str
    shift: float
    correlation: float
    slope: float
    is_steady: bool


class _Fits(NamedTuple):
    """Regressions of one measured motion on A commanded ones at S shifts, beside a constant and a trend.

    Attributes:
        correlation: (A, S).
        slope: Measured over commanded motion, (A, S).
        unexplained: Log of the share of the measured variance that is left, (A, S).
    """

    correlation: FloatArray
    slope: FloatArray
    unexplained: FloatArray


def matches(measured: Mapping[str, FloatArray], led: Mapping[str, FloatArray], grid: Grid) -> dict[str, Match]:
    """The simplest good explanation of what a sensor measures on each of its axes.

    That is the axis's own commands about when they act; or, where that leaves much less unexplained, the commands of
    another axis, or all axes at another time: a sensor has one clock.

    Args:
        measured: By axis, the means of :meth:`Grid.mean`, (n,).
        led: By commanded axis, where the commands lead, at ``grid.time``, (n + 2m,).
        grid: The bins.
    """
    names, commanded = list(led), np.stack([value - value.mean() for value in led.values()])
    every = np.arange(-grid.margin, grid.margin + 1)
    near = np.flatnonzero(np.abs(every * grid.step) <= max(SMALL_SHIFT, grid.step))
    fits = {axis: _fits(value, commanded, grid.margin) for axis, value in measured.items()}
    place, cost, together = dict[str, tuple[int, int]](), 0.0, np.zeros(len(every))
    for axis, fit in fits.items():
        own = names.index(axis)
        places = [_nearest_best(fit, other, near) for other in range(len(names))]
        costs = fit.unexplained[range(len(names)), places] + _MUCH_BETTER * (np.arange(len(names)) != own)
        best = int(np.argmin(costs))
        place[axis], cost = (best, places[best]), cost + float(costs[best])
        together += np.where(fit.slope[own] > 0.0, fit.unexplained[own], 0.0)
    late = _nearest(together, np.arange(len(every)))
    shift = 0.0
    if together[late] + _MUCH_BETTER < cost:
        place = {axis: (names.index(axis), late) for axis in fits}
        shift = (float(every[late]) + _between(np.exp(together[max(late - 1, 0) : late + 2]))) * grid.step
    return {
        axis: _match(names[other], shift, measured[axis], commanded[other], fits[axis], other, at)
        for axis, (other, at) in place.items()
    }


def far_shift(led: Mapping[str, Rows], measured: Mapping[str, Rows], near: tuple[float, float]) -> float | None:
    """How late a sensor is whose clock is another one [s]; None where it follows nothing, or about at once.

    Both are laid side by side from their own beginnings on and shifted by up to half of the run, and to where their
    clocks would be one; of shifts that are about as good the one counts that is nearest to none.

    Args:
        led: Stamps [ns], ascending, and commanded values, by axis, (n,).
        measured: Likewise of the sensor, of the same axes, (m,).
        near: From and to what lag [s] it would be on the commands' clock.
    """
    first, begin = (min(int(stamp[0]) for stamp, _ in one.values()) for one in (led, measured))
    until, last = (max(int(stamp[-1]) for stamp, _ in one.values()) for one in (led, measured))
    apart, span, overlap = (begin - first) / 1e9, (last - begin) / 1e9, last > first and begin < until
    farthest = max(0.5 * span, abs(apart) + near[1] if overlap else 0.0)
    period = max(float(np.median(np.diff(stamp))) for stamp, _ in led.values()) / 1e9
    step = max(period, _FINEST, (span + 2.0 * farthest) / _MOST_FAR)
    grid = Grid.around(begin, span, step, math.ceil(farthest / step))
    lag = apart + step * np.arange(-grid.margin, grid.margin + 1)
    left, correlation = np.zeros(len(lag)), np.zeros(len(lag))
    for axis, (stamp, value) in measured.items():
        fit = _fits(grid.mean(stamp, value), np.interp(grid.time - begin + first, *led[axis])[None], grid.margin)
        left += fit.unexplained[0]
        correlation = np.maximum(correlation, np.abs(fit.correlation[0]))
    late, here = _nearest(left, np.arange(len(lag))), (near[0] <= lag) & (lag <= near[1])
    at_once = left[here].min(initial=np.inf) <= left[late] + _MUCH_BETTER
    if correlation[late] < _CLEARLY or (overlap and at_once):
        return None
    return float(lag[late]) + _between(np.exp(left[max(late - 1, 0) : late + 2])) * step


def _match(name: str, shift: float, measured: FloatArray, led: FloatArray, fits: _Fits, axis: int, place: int) -> Match:
    """The match of a measured motion (n,) with a commanded one (n + 2m,), at one of the shifts."""
    slope, first = float(fits.slope[axis, place]), len(led) - len(measured) - place
    steady = slope_of_pieces(measured, led[first : first + len(measured)])[0]
    return Match(name, shift, float(fits.correlation[axis, place]), slope, abs(steady - slope) < 0.5 * abs(slope))


def slope_of_pieces(measured: FloatArray, led: FloatArray) -> tuple[float, float]:
    """Slope of measured over commanded motion in short pieces of a run, each about its mean, and its standard error.

    Args:
        measured: NaN where there is nothing, (n,).
        led: (n,).

    Returns:
        Both; 0 and infinity where nothing moves. The error is what the pieces scatter, infinite where few move.
    """
    seen = np.isfinite(measured)
    pieces = zip(*(np.array_split(part[seen], _PIECES) for part in (measured, led)), strict=True)
    centred = [(value - value.mean(), motion - motion.mean()) for value, motion in pieces if len(value)]
    along, power = (np.array(sums) for sums in zip(*((a @ b, b @ b) for a, b in centred), strict=True))
    total = float(power.sum())
    if total == 0.0:
        return 0.0, math.inf
    slope = float(along.sum()) / total
    few = total**2 < _MOVING * float(power @ power)
    return slope, math.inf if few else float(np.linalg.norm(along - slope * power)) / total


def without_spikes(value: FloatArray) -> BoolArray:
    """Values that are no single or double outliers, far from the median of the five around them, (n,).

    A motion is none, however fast: where it goes on, each value is that median itself.
    """
    if len(value) < 3:
        return np.ones(len(value), dtype=np.bool_)
    padded = np.concatenate((value[2:0:-1], value, value[-2:-4:-1]))  # reflected
    a, b, c, d, e = (padded[k : k + len(value)] for k in range(5))
    low, high = np.maximum(np.minimum(a, b), np.minimum(c, d)), np.minimum(np.maximum(a, b), np.maximum(c, d))
    around = np.maximum(np.minimum(low, high), np.minimum(e, np.maximum(low, high)))  # the median of five
    far = np.abs(value - around)
    spikes = far > _SPIKE * median(far)
    return ~spikes if np.count_nonzero(spikes) < _MOST_SPIKES * len(value) else np.ones(len(value), dtype=np.bool_)


def _fits(measured: FloatArray, led: FloatArray, margin: int) -> _Fits:
    """The regressions at shifts from −margin to margin bins, by sums over the bins that have measurements.

    Args:
        measured: NaN where there is nothing, (n,).
        led: About zero, (A, n + 2m).
        margin: m.
    """
    seen = np.isfinite(measured)
    count, numbers = np.count_nonzero(seen), np.arange(len(measured))
    trend = np.where(seen, numbers - numbers[seen].mean(), 0.0)
    trend /= math.sqrt(trend @ trend) or 1.0
    value = np.where(seen, measured - measured[seen].mean(), 0.0)
    value -= (value @ trend) * trend
    size = 1 << (led.shape[1] - 1).bit_length()
    of_led, of_square = np.fft.rfft(led, size), np.fft.rfft(led**2, size)

    def sums(weight: FloatArray, transform: NDArray[np.complexfloating[Any, Any]]) -> FloatArray:
        """Σ a(k) b(k − shift) over the bins k, (A, S)."""
        return np.fft.irfft(transform * np.conj(np.fft.rfft(weight, size)), size)[:, 2 * margin :: -1]

    ones = seen.astype(np.float64)
    spread = sums(ones, of_square) - sums(ones, of_led) ** 2 / count - sums(trend, of_led) ** 2
    least = np.maximum(_SLIGHT * spread.max(axis=1), _ROUNDING * count * np.max(led**2, axis=1))[:, None]
    both, power = sums(value, of_led), float(value @ value)
    moves = (spread > least) & (power > 0.0)
    slope = np.divide(both, spread, out=np.zeros(both.shape), where=moves)
    correlation = np.divide(both, np.sqrt(np.where(moves, spread * power, 1.0)), out=np.zeros(both.shape), where=moves)
    return _Fits(correlation, slope, np.log(np.maximum(1.0 - correlation**2, _LEAST)))


def _nearest_best(fits: _Fits, axis: int, places: IntArray) -> int:
    """The best of ``places``, of those about as good one where both move the same way, and of these the nearest."""
    same = np.where(fits.slope[axis] > 0.0, fits.unexplained[axis], np.inf)
    best = fits.unexplained[axis, places].min()
    return _nearest(same if same[places].min() <= best + _AS_GOOD else fits.unexplained[axis], places)


def _nearest(unexplained: FloatArray, places: IntArray) -> int:
    """Where, of ``places``, the least is unexplained; of valleys that are about as low the one nearest to no shift."""
    beside = np.pad(unexplained, 1, constant_values=np.inf)[np.add.outer(places, [0, 2])]
    low = unexplained[places]
    valley = (low <= beside.min(axis=1)) & (low <= low.min() + _AS_GOOD) | (low == low.min())
    return int(min(places[valley], key=lambda place: abs(place - len(unexplained) // 2)))


def _between(valley: FloatArray) -> float:
    """How far from the middle one of three values, (3,), a parabola through them is lowest; 0 at an edge."""
    if len(valley) < 3:
        return 0.0
    bend = float(valley[0] - 2.0 * valley[1] + valley[2])
    return 0.5 * float(valley[0] - valley[2]) / bend if bend > 0.0 else 0.0
