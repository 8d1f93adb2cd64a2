"""Which commands a sensor follows, how late and how far, and where from: beside a model's response, without a filter.

By correlation at every shift of its clock, and, at none, by its motion, its zero, and motion of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
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
_PIECES, _MOVING = 20, 4.0  # short pieces of a run, and how many must move; a zero that scatters over them wanders
_SLIGHT = 0.1  # share of the greatest motion below which commands tell nothing at a shift
FOLLOWS = 0.95  # correlation from which there is nothing to ask
GAIN = 3.0  # factor on a motion up to which it may be a gain
_NOISY = 3.0  # times the noise, up to which a distance is noise
_FAR = 5.0  # sds beyond which chance is no explanation
_UNLIKELY = 3.5  # sds of priors beyond which they are none
_MODEL = 0.01  # share of a motion that a wrong model makes look like another zero
_SMOOTH = 0.0  # correlation of one step and the next from which they are a motion; that of noise is −0.5


Rows: TypeAlias = tuple[TimeArray, FloatArray]  # stamps [ns] and values


class Grid(NamedTuple):
    """Even bins over a run, and further ones on both sides for shifts."""

    time: TimeArray  # the middle of each bin, int64 ns, (n + 2m,)
    step: float  # their width [s]
    margin: int  # m, how many on each side

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

    def mean(self, stamp: TimeArray, value: FloatArray) -> FloatArray:
        """The mean of the values in each bin without the margins, NaN without any, (n,)."""
        size = len(self.time) - 2 * self.margin
        rows = np.floor((stamp - self.time[self.margin]) / (self.step * 1e9) + 0.5).astype(np.int64)
        inside = (rows >= 0) & (rows < size)
        number = np.bincount(rows[inside], minlength=size)
        total = np.bincount(rows[inside], weights=value[inside], minlength=size)
        return np.divide(total, number, out=np.full(size, np.nan), where=number > 0)


class Match(NamedTuple):
    """What explains the motion that a sensor measures on an axis."""

    axis: str  # the axis whose commands it follows
    shift: float  # how late it is [s]; 0 where that is no more than a wrong delay or latency explains
    correlation: float  # with the commanded motion then, apart from a constant and a trend
    slope: float  # measured over commanded motion
    is_steady: bool  # whether short pieces of the run, each about its mean, tell about the same slope: drifts do not


class _Fits(NamedTuple):
    """Regressions of one measured motion on A commanded ones at S shifts, beside a constant and a trend: (A, S)."""

    correlation: FloatArray
    slope: FloatArray  # measured over commanded motion
    unexplained: FloatArray  # log of the share of the measured variance that is left


def matches(measured: Mapping[str, FloatArray], led: Mapping[str, FloatArray], grid: Grid) -> dict[str, Match]:
    """The simplest good explanation of what a sensor measures on each of its axes.

    That is the axis's own commands about when they act; or, where that leaves much less unexplained, the commands of
    another axis, or all axes at another time: a sensor has one clock. ``measured`` are means of :meth:`Grid.mean`,
    (n,), ``led`` where the commands lead at ``grid.time``, (n + 2m,).
    """
    names, commanded = list(led), np.stack([value - value.mean() for value in led.values()])
    every = np.arange(-grid.margin, grid.margin + 1)
    near = np.flatnonzero(np.abs(every * grid.step) <= max(SMALL_SHIFT, grid.step))
    fits = {axis: _fits(value, commanded, grid.margin) for axis, value in measured.items()}
    places_taken, cost, together = dict[str, tuple[int, int]](), 0.0, np.zeros(len(every))
    for axis, fit in fits.items():
        column, same = names.index(axis), np.where(fit.slope > 0.0, fit.unexplained, np.inf)
        # Of shifts about as good one counts at which both move the same way.
        alike = same[:, near].min(axis=1) <= fit.unexplained[:, near].min(axis=1) + _AS_GOOD
        places = [_nearest(unexplained, near) for unexplained in np.where(alike[:, None], same, fit.unexplained)]
        costs = fit.unexplained[range(len(names)), places] + _MUCH_BETTER * (np.arange(len(names)) != column)
        best = int(np.argmin(costs))
        places_taken[axis], cost = (best, places[best]), cost + float(costs[best])
        together += np.where(fit.slope[column] > 0.0, fit.unexplained[column], 0.0)
    late = _nearest(together, np.arange(len(every)))
    shift = 0.0
    if together[late] + _MUCH_BETTER < cost:
        places_taken = {axis: (names.index(axis), late) for axis in fits}
        shift = (float(every[late]) + _between(together, late)) * grid.step
    by_axis = dict[str, Match]()
    for axis, (other, at) in places_taken.items():
        slope, first = float(fits[axis].slope[other, at]), 2 * grid.margin - at
        steady, _ = slope_of_pieces(measured[axis], commanded[other][first : first + len(measured[axis])])
        is_steady = abs(steady - slope) < 0.5 * abs(slope)
        by_axis[axis] = Match(names[other], shift, float(fits[axis].correlation[other, at]), slope, is_steady)
    return by_axis


def far_shift(led: Mapping[str, Rows], measured: Mapping[str, Rows], near: tuple[float, float]) -> float | None:
    """How late a sensor is whose clock is another one [s]; None where it follows nothing, or about at once.

    Both are laid side by side from their own beginnings on and shifted by up to half of the run, and to where their
    clocks would be one; of shifts that are about as good the one counts that is nearest to none. Stamps [ns] ascend;
    ``near`` are the lags [s] on one clock.
    """
    first, begin = (min(int(stamp[0]) for stamp, _ in series.values()) for series in (led, measured))
    until, last = (max(int(stamp[-1]) for stamp, _ in series.values()) for series in (led, measured))
    apart, span, overlap = (begin - first) / 1e9, (last - begin) / 1e9, last > first and begin < until
    farthest = max(0.5 * span, abs(apart) + near[1] if overlap else 0.0)
    period = max(float(np.median(np.diff(stamp))) for stamp, _ in led.values()) / 1e9
    step = max(period, _FINEST, (span + 2.0 * farthest) / _MOST_FAR)
    grid = Grid.around(begin, span, step, math.ceil(farthest / step))
    lag = apart + step * np.arange(-grid.margin, grid.margin + 1)
    left, correlation, telling = np.zeros(len(lag)), np.zeros(len(lag)), np.zeros(len(lag))
    for axis, (stamp, value) in measured.items():
        fit = _fits(grid.mean(stamp, value), np.interp(grid.time - begin + first, *led[axis])[None], grid.margin)
        left += fit.unexplained[0]
        correlation = np.maximum(correlation, np.abs(fit.correlation[0]))
        telling += fit.correlation[0] != 0.0
    late, here = _nearest(left, np.arange(len(lag))), (near[0] <= lag) & (lag <= near[1])
    at_once = left[here].min(initial=np.inf) <= left[late] + _MUCH_BETTER
    is_edge = telling[max(late - 1, 0) : late + 2].min() < telling[late]  # beside it commands tell nothing, or less
    if correlation[late] < _CLEARLY or is_edge or (overlap and at_once):
        return None
    return float(lag[late]) + _between(left, late) * step


def lateness(measured: Mapping[str, FloatArray], led: Mapping[str, FloatArray], grid: Grid) -> FloatArray:
    """Log of the share of a sensor's motion that its own axes' commands leave unexplained at each shift, summed, (S,).

    As of :func:`matches`; motion against the commands is not explained.
    """
    fits = [_fits(value, (led[axis] - led[axis].mean())[None], grid.margin) for axis, value in measured.items()]
    return np.sum([np.where(fit.slope[0] > 0.0, fit.unexplained[0], 0.0) for fit in fits], axis=0)


def best_shift(unexplained: FloatArray, grid: Grid) -> float:
    """The shift at which least is left [s]; of those that are about as good the one nearest to none."""
    row = _nearest(unexplained, np.arange(len(unexplained)))
    return (row - grid.margin + _between(unexplained, row)) * grid.step


def slope_of_pieces(measured: FloatArray, led: FloatArray) -> tuple[float, float]:
    """Slope of measured over commanded motion in short pieces of a run, each about its mean, and its standard error."""
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
    """Values that are no single or double outliers, far from the median of the five around them, (n,)."""
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
    """The regressions of values, NaN where there is none, (n,), on motions about zero, (A, n + 2m), at −m to m bins."""
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


def _nearest(unexplained: FloatArray, places: IntArray) -> int:
    """Where, of ``places``, the least is unexplained; of valleys that are about as low the one nearest to no shift."""
    beside = np.pad(unexplained, 1, constant_values=np.inf)[np.add.outer(places, [0, 2])]
    low = unexplained[places]
    valley = (low <= beside.min(axis=1)) & (low <= low.min() + _AS_GOOD) | (low == low.min())
    return int(min(places[valley], key=lambda row: abs(row - len(unexplained) // 2)))


def _between(unexplained: FloatArray, row: int) -> float:
    """How far from a place a parabola through what is left there and beside it is lowest; 0 at an edge."""
    before, here, after = np.exp(np.pad(unexplained, 1, mode="edge")[row : row + 3]).tolist()
    bend = before - 2.0 * here + after
    return 0.5 * (before - after) / bend if bend > 0.0 and 0 < row < len(unexplained) - 1 else 0.0


@dataclass(frozen=True)
class Tracking:
    """Up to 500 positions that a sensor measures on an axis, and where the commands lead, relative to the start."""

    time: FloatArray  # since the first [s], (n,)
    measured: FloatArray  # [m or rad], (n,)
    led: FloatArray  # [m or rad], (n,)
    before: FloatArray  # where the commands had led shortly before each [m or rad], (n,)
    noise: float  # standard deviation of what varies [m or rad]
    zero_sd: float  # that of the difference of both zeros, by the priors [m or rad]
    drift: float  # density of the random walk [m/√s or rad/√s]

    @cached_property
    def _near(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Time, measured and commanded motion without outliers, and that shortly before, (k,) each.

        At rest all is near: what is off by no more than the motion, as a wrong delay makes it, is no outlier.
        """
        distance = self.measured - self.led
        distance = np.abs(distance - median(distance))
        near = distance <= max(10.0 * median(distance), float(np.ptp(self.led))) + 1e-12
        kept = slice(None) if near.all() else near
        return self.time[kept], self.measured[kept], self.led[kept], self.before[kept]

    @cached_property
    def _moved(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The same about zero, without time."""
        _, measured, led, before = (part - part.mean() for part in self._near)
        return measured, led, before

    @property
    def rests(self) -> bool:
        """Whether all values are one."""
        return float(np.ptp(self.measured)) == 0.0

    @cached_property
    def correlation(self) -> float:
        """Of measured and commanded motion; 0 where one of them rests."""
        measured, led, _ = self._moved
        power = math.sqrt(float(measured @ measured) * float(led @ led))
        return float(measured @ led) / power if power > 0.0 else 0.0

    @property
    def slope(self) -> float:
        """Measured over commanded motion; 0 where the commands rest."""
        measured, led, _ = self._moved
        return float(measured @ led) / power if (power := float(led @ led)) > 0.0 else 0.0

    @property
    def follows(self) -> bool:
        """Whether there is nothing to ask: it moves about as far as commanded, about then, or is off by its noise."""
        measured, led, before = self._moved
        if _spread(measured - led) <= _NOISY * self.noise or not led.any():
            return True
        if self.correlation < FOLLOWS:
            return False
        slope, step = self.slope, led - before
        left = measured - slope * led
        along, power = float(left @ step), max(float(step @ step), 1e-30)
        is_late = abs(along) > 0.5 * slope * power and along**2 > 0.5 * power * float(left @ left)
        return 1.0 / GAIN < slope < GAIN and not is_late

    @property
    def lacks_motion(self) -> bool:
        """Whether less than half of the commanded motion is there, by three standard errors."""
        measured, led, _ = self._moved
        slope, error = slope_of_pieces(measured, led)
        return slope + 3.0 * error < 0.5 and _spread(led) > self.noise

    @cached_property
    def own_motion(self) -> float:
        """How far it moves while the commands rest [m or rad]; 0 if they do not, or if it is noise or drift."""
        time, measured, led, _ = self._near
        if np.ptp(led) > 0.0 or len(measured) < 3:
            return 0.0
        steps = np.diff(measured)
        expected = math.hypot(math.sqrt(2.0) * self.noise, self.drift * math.sqrt(float(np.median(np.diff(time)))))
        power = float(steps @ steps)
        is_smooth = float(steps[1:] @ steps[:-1]) > _SMOOTH * power
        far = math.sqrt(power / len(steps)) > _FAR * expected
        return float(np.ptp(measured)) if is_smooth and far else 0.0

    @cached_property
    def zero(self) -> float:
        """How far its zero is from the commands' [m or rad]; 0 if chance and priors explain it.

        The constant of a regression on where the commands lead and on how that changes, so that a wrong gain or lag
        does not count. Where the zero wanders, its scatter is its error.
        """
        _, measured, led, before = self._near
        _, moved, moved_before = self._moved
        motions = (led, moved), (led - before, moved - moved_before)
        columns = [column for column, about_zero in motions if _spread(about_zero) > self.noise]
        regressors, off = np.array([np.ones(len(led)), *columns]), measured - led
        gram = regressors @ regressors.T
        line = np.linalg.lstsq(gram, regressors @ off)[0]
        if not self.excludes(float(line[0])):
            return 0.0
        left = off - line @ regressors
        wanders = float(np.std([piece.mean() for piece in np.array_split(left, _PIECES)]))
        # at a distance from the start that hardly changes, the constant is as uncertain as the slope
        chance = wanders * math.sqrt(len(left) * float(np.linalg.pinv(gram, hermitian=True)[0, 0]))
        error = max(chance, _MODEL * float(np.ptp(led)))
        return float(line[0]) if abs(line[0]) > _FAR * error else 0.0

    def excludes(self, zero: float) -> bool:
        """Whether the priors do not expect such a difference of the zeros [m or rad]."""
        return abs(zero) > _UNLIKELY * self.zero_sd


def _spread(about_zero: FloatArray) -> float:
    """Standard deviation of values whose mean is 0."""
    return math.sqrt(float(about_zero @ about_zero) / len(about_zero))
