"""Which signal follows which, how late, how far: correlation of changes at a lag."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..arrays import NO_STAMP, SD_OF_MEDIAN, BoolArray, FloatArray, TimeArray

_EARLIEST, LATEST = -1.0, 2.0  # s, of a lag
_BEYOND = 1e9  # m or rad, where no robot goes
_COARSE, _FINE = 0.01, 0.001  # s, steps of a lag
# s, over which changes are taken: long where noise is large; from the mean where it is most of the run, as on a path at
# constant speed, which says more of the lag than its ends do.
_SPANS = (0.1, 0.5, 2.0, math.inf)
_MOST, _FEW = 3000, 500  # changes, and for a first look
_FEWEST = 20
_WHOLE = 0.01  # from a whole number, of steps
_ALIKE = 1e-6  # of the smallest step, by which sizes of steps differ at least
_MANY = 0.25  # of all steps, the share at least that are of one count of an encoder
_COARSER = 0.5  # of a count: digits that are coarser hide it
_OUTLYING = 8.0  # sds
_APART = 5.0  # times as far off as its neighbours are: at the start or the turn of a motion it is three times
_FLICKERING = 0.1  # of what changes at all, the share that is the flicker of one count, at least
_ROUNDING = 1e-12  # of a value
_MOST_OUTLYING = 0.05  # of the changes: each outlier is in two, and of few measurements some are more than a clip takes
_SLOW, _FASTEST = 0.1, 0.99  # of the way that so many rows do not exceed: less is rest
_EVENLY = 3.0  # times as many rows as usual, for which a sensor that is slower than its rows holds a value at most
_MOSTLY = 0.5  # share of the rows in motion, from which the median is one of them
_NEARLY = 0.98  # of the highest correlation: of several such hills, as a periodic motion has, the nearest counts
_KNEES = np.linspace(0.0, 1.0, 13)[1:-1]  # of the range that is commanded, where a curve bends
ABOUT_ONE = 1.25  # factor by which one moves less or more than the other, where it moves as far
# Of what is left at a lag before the other moves, as much as is left of it at once: then that lag means nothing. Where
# it is hardly more than noise, also less does.
_AS_WELL, _NOISE = 1.05, 3.0
_IN_STEP = 0.9  # resultant of the measurements' phases: a jitter of 7 % of an update period
_MIRRORED = 0.1  # a negative correlation must be stronger by this than any positive one


@dataclass(frozen=True)
class Following:
    """How one signal follows another."""

    lag: float  # how late it is behind the path through the other's points [s]
    correlation: float  # of their changes at that lag, outliers apart
    slope: float  # by how much it moves when the other moves by 1
    offset: float  # how far its level is from ± 1 times the other's; where they begin, if it moves otherwise [m or rad]
    scatter: float  # its noise, roughly, [m or rad]
    resolution: float  # that of the steps in which its values come
    misfit: float  # standard deviation of what the other, delayed and scaled, leaves of it, outliers apart [m or rad]
    outliers: float  # the share of its values that jump away from their neighbours


def following(
    leader: tuple[TimeArray, FloatArray], follower: tuple[TimeArray, FloatArray], *, is_moved: bool = False
) -> Following | None:
    """How the second signal, stamps [ns] and values, follows the first; None without overlap or if one rests.

    Where one ``is_moved`` by the other, as an arm by its commands, a stop or a load may hold it off.
    """
    origin = int(leader[0][leader[0] != NO_STAMP].min(initial=2**62))
    (t, u), (s, z) = in_seconds(*leader, origin), in_seconds(*follower, origin)
    inside = (s > t[0] if len(t) else s > np.inf) & (s < t[-1] if len(t) else False)
    s, z = s[inside], z[inside]
    news = np.flatnonzero(np.diff(z, prepend=np.nan))
    held = np.diff(news)
    usual = float(np.median(held)) if len(held) >= _FEWEST else 0.0
    if usual > 1.0 and held.max() <= _EVENLY * usual:
        s, z = s[news], z[news]  # it is slower than its rows
    if len(t) < _FEWEST or len(s) < _FEWEST or _stands(u) or _stands(z):
        return None
    noise, steps, outliers, moves = scatter(z), _resolution(z), float(isolated(s, z).mean()), _in_motion(z)

    def at(lag: float, correlation: float, slope: float) -> tuple[float, float, Following]:
        led = np.interp(s - lag, t, u)
        offset, residual = _offset(z, led, slope, float(u[0])), z - slope * led
        left = max(min(noise, scatter(residual)), steps)
        fit = Following(lag, correlation, slope, offset, left, steps, robust_sd(residual[moves]), outliers)
        return fit.misfit, float(np.std(residual)), fit  # in whole counts medians are alike: what jumps decides

    fits = [at(*best) for span in _SPANS if (best := _at_span(t, u, s, z, span))]
    if not fits:
        return None
    least = min(fits, key=lambda fit: fit[:2])[2]
    if is_moved and least.lag < -_COARSE and (later := _along_curve(t, u, s, z, least.lag)) > least.lag:
        led = np.interp(s - later, t, u)
        least = at(later, float(np.corrcoef(led, z)[0, 1]), float(np.polyfit(led, z, 1)[0]))[2]
    if least.lag < 0.0:
        led = np.interp(s, t, u)
        at_once = at(0.0, least.correlation, float(np.polyfit(led, z, 1)[0]))[2]
        is_noise = least.misfit < _NOISE * least.scatter
        return least if is_noise or at_once.misfit > _AS_WELL * least.misfit else at_once
    return least


def _along_curve(t: FloatArray, u: FloatArray, s: FloatArray, z: FloatArray, before: float) -> float:
    """The lag [s] at which it follows a curve over the other's levels, as at a stop or under a load; else ``before``.

    Such an axis seems to turn before its commands do. The curve is a line in pieces, by least squares; it must leave
    half of what a straight line does.
    """
    some = np.unique(np.linspace(0, len(s) - 1, min(_FEW, len(s))).astype(np.int64))

    def left(lag: float, knees: FloatArray) -> float:
        led = np.interp(s[some] - lag, t, u)
        bends = np.maximum(led[:, None] - (u.min() + knees * np.ptp(u)), 0.0)
        columns = np.column_stack([np.ones(len(led)), led, bends])
        return float(np.sum((z[some] - columns @ np.linalg.lstsq(columns, z[some], rcond=None)[0]) ** 2))

    lag = min(np.arange(_EARLIEST, LATEST, _COARSE).tolist(), key=lambda lag: left(lag, _KNEES))
    return lag if left(lag, _KNEES) < 0.5 * left(before, _KNEES[:0]) else before


def _offset(value: FloatArray, led: FloatArray, slope: float, start: float) -> float:
    """How far a level is from that of what leads it, which begins at ``start``.

    Where one moves half as far as the other, they agree where they begin, or nowhere.
    """
    sign = math.copysign(1.0, slope)
    times = sign if 1.0 / ABOUT_ONE < abs(slope) < ABOUT_ONE else slope
    return float(np.median(value - times * (led - start))) - sign * start


def _stands(value: FloatArray) -> bool:
    """Whether a signal moves by no more than what rounding makes of its mean."""
    return float(np.ptp(value)) <= _ROUNDING * float(np.abs(value).max())


def _in_motion(value: FloatArray) -> BoolArray:
    """Rows that tell a lag: those in motion, where most are at rest and any lag and any gain would do, (n,)."""
    way = np.abs(np.gradient(value))
    moves = way >= _SLOW * np.quantile(way, _FASTEST)
    return moves if _FEWEST <= moves.sum() < _MOSTLY * len(value) else np.ones(len(value), dtype=np.bool_)


def in_seconds(stamp: TimeArray, value: FloatArray, origin: int) -> tuple[FloatArray, FloatArray]:
    """Seconds after an origin [ns] and values of the rows that have both, in order, without what no robot reaches."""
    valid = (stamp != NO_STAMP) & (np.abs(value) < _BEYOND)
    time, order = np.unique((stamp[valid] - origin) / 1e9, return_index=True)
    return time, value[valid][order]


def phase(rows: Iterable[tuple[TimeArray, TimeArray]], period: float) -> float | None:
    """How long after a command all measurements are valid, in update periods [s]; None where that differs.

    ``rows``: of each run when commands were given, ascending, and when measurements are valid [ns].
    """
    since = [np.zeros(0)]
    for told, time in rows:
        row = np.searchsorted(told, time, side="right") - 1
        since.append((time[row >= 0] - told[row[row >= 0]]) / (period * 1e9))
    turns = np.exp(2j * np.pi * np.concatenate(since))
    resultant = turns.mean() if len(turns) else 0.0
    return float(np.angle(resultant) / (2.0 * np.pi) % 1.0) if abs(resultant) > _IN_STEP else None


def _at_span(
    t: FloatArray, u: FloatArray, s: FloatArray, z: FloatArray, span: float
) -> tuple[float, float, float] | None:
    """Lag, correlation and slope by the changes over a span [s]."""
    rows = 0 if span == math.inf else max(1, round(span / max(float(np.median(np.diff(s))), 1e-6)))
    if len(s) - rows < _FEWEST:
        return None
    some = np.unique(np.linspace(0, len(s) - rows - 1, min(_MOST, len(s) - rows)).astype(np.int64))
    begin, end = s[some], s[some + rows]

    def changes(at_begin: FloatArray, at_end: FloatArray) -> FloatArray:
        return at_end - (at_begin if rows else at_end.mean(axis=-1, keepdims=True))

    change = changes(z[some], z[some + rows])
    low, high = np.quantile(change, [0.01, 0.99])  # outliers
    change = np.clip(change, low, high)

    def moves(lags: FloatArray, every: int = 1) -> FloatArray:
        later = lags[:, None]
        return changes(np.interp(begin[::every] - later, t, u), np.interp(end[::every] - later, t, u))

    def correlations(lags: FloatArray, every: int = 1) -> FloatArray:
        others, own_moves = moves(lags, every), change[::every]
        norm = np.sqrt(np.einsum("ij,ij->i", others, others) * float(own_moves @ own_moves))
        return (others @ own_moves) / np.where(norm > 0.0, norm, np.inf)

    coarse, every = np.arange(_EARLIEST, LATEST, _COARSE), max(1, len(change) // _FEW)
    by_lag = correlations(coarse, every)
    if not np.abs(by_lag).any():
        return None
    sign = -1.0 if by_lag.max() <= 0.0 or -by_lag.min() > by_lag.max() + _MIRRORED else 1.0
    by_lag *= sign
    high = by_lag >= _NEARLY * by_lag.max()
    hills = np.split(np.arange(len(coarse)), np.flatnonzero(np.diff(high)) + 1)[int(not high[0]) :: 2]
    best = min((float(coarse[hill[np.argmax(by_lag[hill])]]) for hill in hills), key=abs)
    fine = np.arange(best - 1.5 * _COARSE, best + 1.5 * _COARSE, _FINE)
    lag = float(fine[np.argmax(sign * correlations(fine))])
    other = moves(np.array([lag]))[0]
    slope = float(other @ change) / float(other @ other)
    left = change - slope * other
    kept = np.abs(left - np.median(left)) <= _OUTLYING * robust_sd(left)
    is_motion = float(other[kept] @ other[kept]) < (1.0 - 2.0 * _MOST_OUTLYING) * float(other @ other)
    if np.count_nonzero(~kept) <= _MOST_OUTLYING * len(left) and not is_motion:
        other, change = other[kept], change[kept]
    power = math.sqrt(float(other @ other) * float(change @ change))
    return (lag, float(other @ change) / power, slope) if power > 0.0 else None


def scatter(value: FloatArray) -> float:
    """Rough noise of a sensor on a moving axis, (n,), in the unit of ``value``; 0 of fewer than four.

    From third differences, which remove smooth motion: their variance is 20 times the noise's. Their median is robust
    against outliers.
    """
    third = np.abs(np.diff(value, 3))
    return SD_OF_MEDIAN * float(np.median(third)) / math.sqrt(20.0) if len(third) else 0.0


def _resolution(value: FloatArray) -> float:
    """Noise of the steps in which values come."""
    steps = np.diff(np.unique(value))
    return float(steps.min()) / math.sqrt(12.0) if len(steps) else 0.0


def resolution(value: FloatArray) -> float:
    """Noise of the steps in which values come, if they do: all are whole multiples of one digit; else 0.

    Counts of an encoder that were rounded for a log come in steps of two sizes, a digit apart: many of the smallest are
    of one count.
    """
    steps = np.diff(np.unique(value))
    steps = steps[steps > _ROUNDING * np.abs(value).max(initial=0.0)]
    if len(steps) < _FEWEST:
        return 0.0
    smallest, apart = float(steps.min()), np.diff(np.unique(np.append(steps, 0.0)))
    digit = float(apart[apart > _ALIKE * smallest].min())
    multiples = steps / digit
    if (np.abs(multiples - np.rint(multiples)) > _WHOLE).any():
        return 0.0
    counts = steps[steps < smallest + min((1.0 + _WHOLE) * digit, _COARSER * smallest)]
    return (float(counts.mean()) if len(counts) > _MANY * len(steps) else digit) / math.sqrt(12.0)


def isolated(time: FloatArray, value: FloatArray) -> BoolArray:
    """Which values leave their neighbours, two on each side that lie on a line, and are back at once, (n,).

    The line is one over time, and one from row to row: of an even motion rows may be measured late, or stamped late.
    Of an encoder that rests in most rows the least third differences are those of one count, by which it flickers.
    A value between those before and behind it was only taken sooner or later than it is stamped, as of a driver that
    was read twice before it had a new one: no leap.
    """
    is_isolated = np.zeros(len(value), dtype=np.bool_)
    if len(value) < _FEWEST:
        return is_isolated
    third = np.abs(np.diff(value, 3))
    third = third[third > _ROUNDING * np.abs(value).max()]
    flicker = SD_OF_MEDIAN * float(np.quantile(third, _FLICKERING)) if len(third) else 0.0
    least = _OUTLYING * max(scatter(value) or flicker / math.sqrt(20.0), _resolution(value))
    is_isolated[2:-2] = True
    for at in (time, np.arange(len(value), dtype=np.float64)):
        apart, off = _off_line(at, value)
        is_isolated[2:-2] &= apart > np.maximum(least, _APART * off)
    neighbours = is_isolated[:-2] & is_isolated[2:]  # every second value: they go there and back together
    is_isolated[:-2] &= ~neighbours
    is_isolated[2:] &= ~neighbours
    from_both = np.stack([value[1:-1] - value[:-2], value[1:-1] - value[2:]])
    is_isolated[1:-1] &= (from_both.min(axis=0) > least) | (from_both.max(axis=0) < -least)
    return is_isolated


def _off_line(at: FloatArray, value: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far each value is from the line through its neighbours, two on each side, and these at most, (n - 4,)."""
    places, neighbours = (np.stack([part[:-4], part[1:-3], part[3:-1], part[4:]]) for part in (at, value))
    mean, level = places.mean(axis=0), neighbours.mean(axis=0)
    slope = ((places - mean) * neighbours).sum(axis=0) / np.maximum(((places - mean) ** 2).sum(axis=0), 1e-30)
    off = np.abs(neighbours - level - slope * (places - mean)).max(axis=0)
    return np.abs(value[2:-2] - level - slope * (at[2:-2] - mean)), off


def robust_sd(residual: FloatArray) -> float:
    """Standard deviation by the median distance from the median."""
    return SD_OF_MEDIAN * float(np.median(np.abs(residual - np.median(residual))))
