"""Sensor against sensor: how much later one tells the same motion than another, with what scale, and whether it steps.

Both see one path: p = responses to the commands (of any linear arm: none has to be known) + what these leave, which the
sensor with more rows tells. Least squares of both sensors' rows on it have the latency, and a scale and biases for each
axis, as unknowns. What the intervals count is how much the latency depends on any twentieth of the motion (jackknife):
errors that last, and those of the path itself, are in it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..arrays import NO_STAMP, FloatArray, TimeArray
from ..logs.run import Run
from ..logs.source import Source
from ..units import MS
from .following import following, in_seconds, isolated, phase
from .paths import ASIDE, Basis, Path, Residue, Shrunk, clipped_rms, interpolated, path, quantile_sd, residue, shrunk

_FOLLOWS = 0.5  # correlation of changes below which two sensors do not see one motion
_FEWEST = 40  # rows of a sensor from which its latency is looked for
_MOST = 10_000  # rows of a sensor that are used: more only take longer
_CLEANED = 2  # times outliers are left out: some are beside others
_STILL = 20  # rows of one value, of which none is used
_PAUSE = 5.0  # mean intervals, over which a path by a sensor does not go on
_ROUNDS, _FITTED, _CLOSE = 40, 3, 1e-5  # at the most; in which the noise is fitted anew; s
_FARTHEST = 0.03  # s, by which a round moves the latency
_BETTER = 0.98  # of what a smooth path leaves of the second sensor: one through all rows of the first must leave less
_BEYOND = 3.0  # sds from which a row counts less (Huber)
_PIECES = 20  # of the motion
_FINEST = 6e-5  # s: between two commands the path is known no better, see benchmarks/lag.py, and no stamp of a log is
# Of an update period, where a sensor sees one instant of each: the path may have steps there. By simulation,
# benchmarks/lag.py --in-step
_UNSEEN = 0.05
_REACH, _STEP = 0.3, 0.005  # s: how far a latency steps at the most, and the grid on which steps are looked for
_TABLE, _DENSE = 50_000, 2e-3  # instants at which a path is computed for these, at the most; s between them
_FAR = 25.0  # squared sds, beyond which a row says no more about a step
_GAIN = 50.0  # by how many squared sds a step must explain the rows better to be looked at
_FURTHER = 3.0  # half intervals of both parts together, by which latencies before and after a step must differ
_SMALLEST_STEP = 2e-3  # s
_SCALES = 0.01  # from 1, of a scale that is named
_SURELY = 4.0  # sds from which a jitter is named
_SMALLEST_JITTER = 1e-3  # s
_OF_BOTH = 2.0  # times that of the other sensor, at the least: what both see is the path's
_SAME_BUNCH, _BUNCHED = 0.2, 0.2  # of the mean interval; share of the intervals
_RANDOM = 0.5  # mean intervals; those of stamps at random scatter by 0.86


@dataclass(frozen=True)
class Step:
    """A latency that steps: when [s after the first command], from what and to what [s]."""

    time: float
    before: float
    after: float


@dataclass(frozen=True)
class Alignment:
    """How much later a sensor tells the same motion than another."""

    latency: float  # by how much [s]; where it steps, that of the longest part
    latency_ci95: tuple[float, float]  # its 95 % interval; where it steps, of all parts
    scale: float  # how far it moves where the other moves by 1; ± 1 where that may be, or axes do not agree
    scale_ci95: tuple[float, float] | None  # the interval of the factor that was fitted; None where axes do not agree
    sd: dict[str, float]  # its noise on each axis at rest [m or rad]
    latency_sd: float  # standard deviation of the latency from row to row [s]; 0: not seen to
    bunched: bool  # whether its rows arrive in bunches
    steps: Sequence[Step] = ()  # where the latency steps

    @property
    def half(self) -> float:
        """Half of the interval [s]."""
        return 0.5 * (self.latency_ci95[1] - self.latency_ci95[0])

    @property
    def unsteadiness(self) -> float:
        """How far the latency of a row is from the one that is told, RMS [s]: its scatter, and its steps."""
        parts = [step.after - self.latency for step in self.steps]
        parts += [self.steps[0].before - self.latency] if self.steps else [0.0]
        return math.hypot(self.latency_sd, math.sqrt(sum(part**2 for part in parts) / len(parts)))

    def doubts(self, name: str, other: str) -> Iterator[str]:
        """What one latency of this sensor does not say, beside that other one: steps, a drift, jitter, a scale."""
        rises = {step.after > step.before for step in self.steps}
        if len(self.steps) > 1 and len(rises) == 1:
            first, last = self.steps[0], self.steps[-1]
            yield (
                f"the latency of {name} drifts from {first.before * MS:.0f} to {last.after * MS:.0f} ms: its clock runs"
                f" {'slower' if last.after < first.before else 'faster'} than that of {other}"
            )
        else:
            for step in self.steps:
                yield (
                    f"the latency of {name} steps from {step.before * MS:.0f} to {step.after * MS:.0f} ms"
                    f" {step.time:.1f} s after the first command: use parts, --from and --to"
                )
        if self.latency_sd:
            bunched = "; its rows arrive in bunches" if self.bunched else ""
            yield (
                f"the latency of {name} scatters by {self.latency_sd * MS:.1f} ms from row to row{bunched}: write"
                f" latency_sd_ms = {self.latency_sd * MS:.2g}, or stamp rows when they are measured"
            )
        if abs(self.scale) != 1.0 and self.scale_ci95 is not None:
            low, high = self.scale_ci95
            yield f"{name} moves {self.scale:.4g} ({low:.4g} to {high:.4g}) times as far as {other}: its scale"


def aligned(runs: Sequence[Run], first: str, second: str) -> Alignment | None:
    """How much later the second sensor is than the first; None where they see no common motion."""
    alignments = [alignment for run in runs if (alignment := _of_run(run, first, second)) is not None]
    if len(alignments) < 2:
        return alignments[0] if alignments else None
    weight = np.array([alignment.half**-2 for alignment in alignments])
    latency = np.array([alignment.latency for alignment in alignments])
    mean = float(weight @ latency / weight.sum())
    # Runs that differ by more than their intervals widen that of their mean (Birge, 1932).
    birge = math.sqrt(max(1.0, float(weight @ (latency - mean) ** 2) * 1.96**2 / (len(alignments) - 1)))
    half = birge / math.sqrt(float(weight.sum()))
    best = alignments[int(np.argmax(weight))]
    sd = {axis: value for alignment in reversed(alignments) for axis, value in alignment.sd.items()}
    steps = [step for alignment in alignments for step in alignment.steps]
    return replace(best, latency=mean, latency_ci95=(mean - half, mean + half), sd=sd, steps=steps)


def noise(command: Source, source: Source, axis: str, lag: float) -> float:
    """Noise of a sensor beside the path of its axis [m or rad]; infinite where it has too few rows for one."""
    origin = int(command.stamp[command.stamp != NO_STAMP].min(initial=2**62))
    s, z = _thinned(*in_seconds(*_clean(source.stamp, source.values[axis]), origin))
    told = in_seconds(command.stamp, command.values[axis], origin)
    return path(told, lag, s, z).sd if len(s) >= _FEWEST else math.inf


# ---- rows -----------------------------------------------------------------------------------------------------------


class _Design(NamedTuple):
    """Responses at instants, without their means, how fast they change [1/s], (n, k), and their products, (k, k)."""

    responses: FloatArray
    slopes: FloatArray
    square: FloatArray


def _design(basis: Basis, at: FloatArray) -> _Design:
    responses = basis(at)
    responses -= responses.mean(axis=0)
    slopes = (basis(at + ASIDE) - basis(at - ASIDE)) / (2.0 * ASIDE)
    return _Design(responses, slopes, responses.T @ responses)


@dataclass(frozen=True)
class _Axis:
    """The rows of two sensors on an axis [s, m or rad]; the denser sensor is the first, and the path is by it."""

    name: str
    path: Path
    s: FloatArray
    z1: FloatArray
    x: FloatArray
    z2: FloatArray
    lag: float
    slope: float
    finest: float  # to which its path is known between rows [s]

    @cached_property
    def first(self) -> _Design:
        """The design of the first sensor's rows, which no latency changes."""
        return _design(self.path.basis, self.s)

    def between(self, begin: float, end: float) -> _Axis:
        """Its rows between two stamps of the second sensor [s]."""
        late = self.lag
        in_first, two = (begin - late <= self.s) & (self.s < end - late), (begin <= self.x) & (self.x < end)
        return replace(self, s=self.s[in_first], z1=self.z1[in_first], x=self.x[two], z2=self.z2[two])


def _source(run: Run, name: str) -> Source | None:
    """The rows of a sensor, or of the reference, in the part of the run that is used."""
    source = run.measured.get(name)
    stamps = run.command.stamp[run.command.stamp != NO_STAMP]
    return None if source is None or not len(stamps) else source.rows(run.within(source.stamp, int(stamps.min())))


def _of_run(run: Run, first: str, second: str) -> Alignment | None:
    source, two = _source(run, first), _source(run, second)
    if source is None or two is None:
        return None
    swapped = _count(two) > _count(source)
    dense, other = (two, source) if swapped else (source, two)
    axes = [axis for name in dense.values if (axis := _axis(run, name, dense, other)) is not None]
    if not axes:
        return None
    latency = float(np.median([axis.lag for axis in axes]))
    parts = _parts([replace(axis, lag=latency) for axis in axes], latency)
    return None if parts is None else _alignment(*parts, swapped, two)


def _count(source: Source) -> int:
    """The number of values of a source, where a bunch counts as one."""
    apart, _ = _intervals(source)
    values = sum(int(np.isfinite(value).sum()) for value in source.values.values())
    return values * (apart + 1) // max(len(source.stamp), 1)


def _axis(run: Run, name: str, first: Source, second: Source) -> _Axis | None:
    """An axis that the commands move and both sensors see to move alike; outliers are left out."""
    if name not in second.values or name not in run.command.values:
        return None
    told = run.command.stamp, run.command.values[name]
    rows = [_clean(source.stamp, source.values[name]) for source in (first, second)]
    between, behind = following(*rows), following(told, rows[0])
    if between is None or behind is None or abs(between.correlation) < _FOLLOWS:
        return None
    origin = int(run.command.stamp[run.command.stamp != NO_STAMP].min())
    (s, z1), (x, z2) = (_thinned(*in_seconds(*row, origin)) for row in rows)
    if len(s) < _FEWEST:
        return None
    after = np.searchsorted(s, x - between.lag)
    inside = (after > 0) & (after < len(s))
    after = np.clip(after, 1, len(s) - 1)
    inside &= s[after] - s[after - 1] < _PAUSE * float(np.diff(s).mean())
    if inside.sum() < _FEWEST:
        return None
    by_first = path(in_seconds(*told, origin), behind.lag, s, z1)
    stamp = np.unique(told[0][told[0] != NO_STAMP])  # a command that is written several times is one
    period = float(np.median(np.diff(stamp))) / 1e9
    in_step = any(phase([(stamp, row[0])], period) is not None for row in rows)
    finest = max(_UNSEEN * period, _FINEST) if in_step else _FINEST
    return _Axis(name, by_first, s, z1, x[inside], z2[inside], between.lag, between.slope, finest)


def _clean(stamp: TimeArray, value: FloatArray) -> tuple[TimeArray, FloatArray]:
    """Rows without outliers and without what stays the same for long: at rest it tells nothing, in motion it froze."""
    valid = np.isfinite(value) & (stamp != NO_STAMP)
    stamp, value = stamp[valid], value[valid]
    run = np.cumsum(np.diff(value, prepend=value[:1]) != 0.0)
    moves = np.bincount(run, minlength=1)[run] <= _STILL if len(run) else valid[:0]
    stamp, value = stamp[moves], value[moves]
    for _ in range(_CLEANED):
        kept = ~isolated((stamp - stamp[:1]) / 1e9, value)
        stamp, value = stamp[kept], value[kept]
    return stamp, value


def _thinned(time: FloatArray, value: FloatArray) -> tuple[FloatArray, FloatArray]:
    every = max(-(-len(time) // _MOST), 1)
    return time[::every], value[::every]


# ---- least squares --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Noise:
    """The numbers of an axis that the search for a latency takes as known in one round.

    How far the second sensor moves where the first moves by 1, the noise of both [m or rad], what the commands leave of
    the path, and the ridge of the responses, if it is known yet.
    """

    scale: float
    sd1: float
    sd2: float
    left: Residue
    penalty: float | None = None


@dataclass(frozen=True)
class _Linear:
    """An axis linearised about a latency; of its n rows the first sensor's precede those of the second."""

    axis: _Axis
    at: FloatArray  # when the rows of the second were valid [s]
    columns: FloatArray  # responses, levels of both, position, less the speed, and what is left, weighted, (n, k + 5)
    left: FloatArray  # what is left of each row [sd], (n,)
    speed: FloatArray  # of what it tells [sd/s], (n,)
    shrunk: Shrunk  # the coefficients of the responses
    noise: _Noise  # what to believe next

    def late(self, swapped: bool) -> tuple[FloatArray, FloatArray]:
        """What is left of the rows of the second sensor [sd], of the first if they are swapped, and speeds [sd/s]."""
        rows = slice(len(self.axis.s)) if swapped else slice(len(self.axis.s), None)
        return self.left[rows], self.speed[rows]


def _linear(axis: _Axis, noise: _Noise, latency: float, fitted: bool) -> _Linear:
    """Linearise an axis about a latency; with ``fitted`` its noise is fitted anew."""
    n1, n2, at = len(axis.s), len(axis.x), axis.x - latency
    basis, two = axis.first, _design(axis.path.basis, at)
    left1, left2 = noise.left(axis.s), noise.left(at)
    y1, y2 = axis.z1 - left1, axis.z2 - noise.scale * left2
    y1, y2 = y1 - y1.mean(), y2 - y2.mean()
    weight1, weight2 = 1.0 / noise.sd1**2, noise.scale / noise.sd2**2
    square = weight1 * basis.square + weight2 * noise.scale * two.square
    score = weight1 * (y1 @ basis.responses) + weight2 * (y2 @ two.responses)
    total = weight1 * float(y1 @ y1) + float(y2 @ y2) / noise.sd2**2
    ridge = shrunk(square, score, total, n1 + n2, None if fitted else noise.penalty)
    coefficients, k = ridge.coefficients, len(ridge.coefficients)
    moved1, moved2 = basis.responses @ coefficients, two.responses @ coefficients
    rest1, rest2 = y1 - moved1, y2 - noise.scale * moved2
    rest1, rest2 = rest1 - np.median(rest1), rest2 - np.median(rest2)
    left = np.concatenate([rest1 / noise.sd1, rest2 / noise.sd2])
    speed1 = basis.slopes @ coefficients + noise.left.slope(axis.s)
    speed2 = noise.scale * (two.slopes @ coefficients + noise.left.slope(at))
    speed = np.concatenate([speed1 / noise.sd1, speed2 / noise.sd2])
    columns = np.zeros((n1 + n2, k + 5))
    columns[:n1, :k], columns[n1:, :k] = basis.responses / noise.sd1, noise.scale / noise.sd2 * two.responses
    columns[:n1, k], columns[n1:, k + 1] = 1.0 / noise.sd1, 1.0 / noise.sd2
    columns[n1:, k + 2], columns[n1:, k + 3], columns[:, k + 4] = (moved2 + left2) / noise.sd2, -speed[n1:], left
    columns *= np.sqrt(np.minimum(1.0, _BEYOND / np.maximum(np.abs(left), 1e-300)))[:, None]  # Huber's weights
    used = ridge.freedom * n1 / (n1 + n2)
    sd2 = clipped_rms(rest2) * math.sqrt(n2 / max(n2 - 2.0 - ridge.freedom + used, 1.0))
    noise = replace(noise, sd2=max(sd2, floor := 1e-9 * float(np.ptp(axis.z2))), penalty=ridge.penalty)
    if fitted:
        whole1, whole2 = rest1 + left1, rest2 + noise.scale * left2
        smooth, through = residue(axis.s, whole1, used), interpolated(axis.s, whole1)
        sd1 = clipped_rms(whole1 - smooth(axis.s)) * math.sqrt(n1 / max(n1 - 1.0 - used - smooth.freedom, 1.0))
        off = [clipped_rms(whole2 - noise.scale * curve(at)) for curve in (smooth, through)]
        noise = replace(noise, sd1=max(sd1, floor), left=through if off[1] < _BETTER * off[0] else smooth)
    return _Linear(axis, at, columns, left, speed, ridge, noise)


class _Fit(NamedTuple):
    """The latency of rows between two stamps and half its interval [s], scales by axis with theirs, and the axes."""

    latency: float
    half: float
    scale: FloatArray
    scale_half: FloatArray
    axes: Sequence[_Linear]


def _fit(axes: Sequence[_Axis], latency: float) -> _Fit | None:
    """The latency by Gauss-Newton; None where it does not settle."""
    axes = [axis for axis in axes if min(len(axis.s), len(axis.x)) >= _FEWEST]
    noises = list[_Noise]()
    for axis in axes:
        left, floor = axis.z2 - axis.slope * axis.path(axis.x - latency), 1e-9 * float(np.ptp(axis.z2))
        sds = max(axis.path.sd, floor), max(clipped_rms(left - np.median(left)), floor)
        noises.append(_Noise(axis.slope, *sds, Residue()))
    last, far = 0.0, _FARTHEST
    for count in range(_ROUNDS if axes else 0):
        lines = [_linear(axis, noise, latency, count < _FITTED) for axis, noise in zip(axes, noises, strict=True)]
        grams = _grams(lines)
        step, scales = _solved(grams, lines)
        if not math.isfinite(step):
            return None
        if step * last < 0.0:  # where it goes to and fro, less and less
            far = min(far, 0.5 * abs(last))
        if count > _FITTED and min(abs(step), far) < _CLOSE:
            break
        latency += (last := min(max(step, -far), far))
        noises = [replace(line.noise, scale=line.noise.scale + more) for line, more in zip(lines, scales, strict=True)]
    else:
        return None
    return _jackknife(grams, lines, latency)


def _grams(lines: Sequence[_Linear]) -> list[FloatArray]:
    """For each axis the products of its columns over pieces that tell as much about the latency, (pieces, k+5, k+5)."""
    time = np.concatenate([line.at for line in lines])
    order = np.argsort(time)
    told = np.cumsum(np.concatenate([line.late(False)[1] ** 2 for line in lines])[order])
    edges = np.interp(np.arange(1, _PIECES) / _PIECES, told / told[-1], time[order])

    def of(line: _Linear) -> FloatArray:
        both = zip(np.split(line.columns, [len(line.axis.s)]), (line.axis.s, line.at), strict=True)
        first, second = (
            np.array([some.T @ some for some in np.split(rows, np.searchsorted(when, edges))]) for rows, when in both
        )
        return first + second

    return [of(line) for line in lines]


def _solved(
    grams: Sequence[FloatArray], lines: Sequence[_Linear], without: int | None = None
) -> tuple[float, FloatArray]:
    """By how much the latency [s], and the scale of each axis, differ from those of the lines; without one piece."""
    score = information = 0.0
    scales = list[FloatArray]()
    for gram, line in zip(grams, lines, strict=True):
        G: FloatArray = gram.sum(axis=0) - (0.0 if without is None else gram[without])
        k, penalty = len(line.shrunk.coefficients), line.shrunk.penalty
        normal, right = G[:-2, :-2].copy(), G[:-2, -2:].copy()
        normal[np.arange(k), np.arange(k)] += penalty**2
        right[:k, 1] -= penalty**2 * line.shrunk.coefficients
        size = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = np.asarray(np.linalg.pinv(size[:, None] * normal * size, 1e-13, hermitian=True), dtype=np.float64)
        solution = size[:, None] * (inverse @ (size[:, None] * right))
        score += float(G[-2, -1] - right[:, 0] @ solution[:, 1])
        information += float(G[-2, -2] - right[:, 0] @ solution[:, 0])
        scales.append(solution[k + 2])
    step = score / information if information > 0.0 else math.nan
    return step, np.array([parts[1] - parts[0] * step for parts in scales])


def _jackknife(grams: Sequence[FloatArray], lines: Sequence[_Linear], latency: float) -> _Fit:
    """The latency and scales with 95 % intervals, by leaving out each piece of the motion once."""
    from scipy.special import stdtrit

    pairs = [_solved(grams, lines, piece) for piece in range(_PIECES)]
    each = np.array([[step, *scales] for step, scales in pairs])
    sd = np.sqrt((_PIECES - 1) / _PIECES * ((each - each.mean(axis=0)) ** 2).sum(axis=0))
    half = float(stdtrit(_PIECES - 1, 0.975)) * sd
    scale = np.array([line.noise.scale for line in lines])
    return _Fit(latency, max(float(half[0]), *(line.axis.finest for line in lines)), scale, half[1:], lines)


# ---- steps ----------------------------------------------------------------------------------------------------------


def _parts(axes: Sequence[_Axis], latency: float) -> tuple[list[_Fit], list[Step]] | None:
    """The parts of a run with a latency each, and the steps between them."""
    times = _candidates(axes, latency)
    while times:
        edges = [-math.inf, *times, math.inf]
        fits = [_fit([axis.between(*span) for axis in axes], latency) for span in pairwise(edges)]
        steps = [
            Step(time, fit.latency, two.latency)
            for time, fit, two in zip(times, fits, fits[1:], strict=False)
            if fit is not None
            and two is not None
            and abs(fit.latency - two.latency) > max(_FURTHER * math.hypot(fit.half, two.half), _SMALLEST_STEP)
        ]
        if len(steps) == len(times):
            return [fit for fit in fits if fit is not None], steps
        times = [step.time for step in steps]
    whole = _fit(axes, latency)
    return None if whole is None else ([whole], [])


def _candidates(axes: Sequence[_Axis], latency: float) -> list[float]:
    """Stamps at which a step of the latency explains the rows better [s]: of all times and latencies on a grid."""
    shifts = np.arange(-_REACH, _REACH + 0.5 * _STEP, _STEP)
    time = np.concatenate([axis.x for axis in axes])
    cost = np.concatenate([_costs(axis, latency + shifts) for axis in axes])
    order = np.argsort(time, kind="stable")
    summed = np.concatenate([np.zeros((1, len(shifts))), np.cumsum(cost[order], axis=0)])
    fewest = _FEWEST * len(axes)

    def split(begin: int, end: int) -> list[int]:
        if end - begin < 2 * fewest:
            return []
        at = np.arange(begin + fewest, end - fewest + 1)
        both = (summed[at] - summed[begin]).min(axis=1) + (summed[end] - summed[at]).min(axis=1)
        best = int(np.argmin(both))
        if float((summed[end] - summed[begin]).min()) - float(both[best]) < _GAIN:
            return []
        middle = int(at[best])
        return [*split(begin, middle), middle, *split(middle, end)]

    return [float(time[order][row]) for row in split(0, len(time))]


def _costs(axis: _Axis, latencies: FloatArray) -> FloatArray:
    """What the path by the first sensor leaves of each row of the second at latencies [sd²], (m, l)."""
    begin, end = float(axis.x[0] - latencies[-1]), float(axis.x[-1] - latencies[0])
    table = np.linspace(begin, end, min(_TABLE, int((end - begin) / _DENSE) + 2))
    left = axis.z2[:, None] - axis.slope * np.interp(axis.x[:, None] - latencies, table, axis.path(table))
    left -= np.median(left, axis=0)
    sd = min(map(quantile_sd, left.T))
    return np.minimum((left / max(sd, 1e-9 * float(np.ptp(axis.z2)))) ** 2, _FAR)


# ---- what is told ---------------------------------------------------------------------------------------------------


def _alignment(fits: Sequence[_Fit], steps: Sequence[Step], swapped: bool, late: Source) -> Alignment:
    """The alignment of the second sensor by fits; ``swapped``: these are of the first beside the second."""
    sign, best = -1.0 if swapped else 1.0, max(fits, key=lambda fit: max(np.ptp(axis.axis.x) for axis in fit.axes))
    low, high = min(fit.latency - fit.half for fit in fits), max(fit.latency + fit.half for fit in fits)
    if swapped:
        low, high = -high, -low
        steps = [replace(step, before=-step.before, after=-step.after) for step in steps]
    scale, scale_ci95 = _scale(best, swapped)
    jitter, sd = _jitter(best, swapped)
    apart, interval = _intervals(late)
    narrow, wide = np.quantile(interval, [0.1, 0.9])
    bunched, irregular = apart < (1.0 - _BUNCHED) * len(interval), float(wide - narrow) / 2.563
    # A jitter of stamps may be as large as their intervals scatter, anything where these come near random ones.
    irregular = math.inf if bunched or irregular > _RANDOM * interval.mean() else irregular
    if jitter > irregular or jitter < _OF_BOTH * _jitter(best, not swapped)[0]:
        jitter = 0.0
    return Alignment(sign * best.latency, (low, high), scale, scale_ci95, sd, jitter, bunched, steps)


def _scale(fit: _Fit, swapped: bool) -> tuple[float, tuple[float, float] | None]:
    """The scale of all axes, ± 1 unless it surely differs; its interval where axes agree."""
    sign = math.copysign(1.0, float(np.median(fit.scale)))
    scale, half = sign * fit.scale, np.maximum(fit.scale_half, 1e-6)
    if swapped:
        scale, half = 1.0 / scale, half / scale**2
    weight = half**-2.0
    mean, error = float(weight @ scale / weight.sum()), 1.0 / math.sqrt(float(weight.sum()))
    if (np.abs(scale - mean) > _FURTHER * np.maximum(half, _SCALES)).any():
        return sign, None
    error = max(error, float(np.std(scale)))
    low, high = sorted((sign * (mean - error), sign * (mean + error)))
    return (sign * mean if abs(mean - 1.0) > max(error, _SCALES) else sign), (low, high)


def _jitter(fit: _Fit, swapped: bool) -> tuple[float, dict[str, float]]:
    """Standard deviation of the latency from row to row [s], 0 if none is seen, and the noise at rest by axis.

    By least squares of squared residuals on the squared speed, weighted by what their variance is then.
    """
    rows = [axis.late(swapped) for axis in fit.axes]
    each = [axis.noise.sd1 if swapped else axis.noise.sd2 for axis in fit.axes]
    sds = {axis.axis.name: sd * quantile_sd(left) for axis, sd, (left, _) in zip(fit.axes, each, rows, strict=True)}
    squares, speed = (np.concatenate(some) ** 2 for some in zip(*rows, strict=True))
    number = np.repeat(np.arange(len(rows)), [len(late) for late, _ in rows])
    X = np.column_stack([number[:, None] == np.arange(len(rows)), speed]).astype(np.float64)
    weighted, cov, b = X, np.eye(X.shape[1]), np.append(np.ones(len(rows)), 0.0)
    for _ in range(_FITTED):
        weighted = X / np.maximum(X @ b, 0.1)[:, None] ** 2
        cov = np.linalg.pinv(X.T @ weighted)
        b = np.maximum(cov @ (weighted.T @ squares), 0.0)
    error, jitter = weighted * (squares - X @ b)[:, None], math.sqrt(float(b[-1]))
    variance = cov @ (error.T @ error) @ cov
    if b[-1] < _SURELY * math.sqrt(float(variance[-1, -1])) or jitter < _SMALLEST_JITTER:
        return 0.0, sds
    return jitter, {name: sds[name] * math.sqrt(max(float(factor), 1e-2)) for name, factor in zip(sds, b, strict=False)}


def _intervals(source: Source) -> tuple[int, FloatArray]:
    """How many intervals of its stamps are not within a bunch, and all of them [s]."""
    interval = np.diff(np.sort(source.stamp[source.stamp != NO_STAMP])) / 1e9
    return int(np.count_nonzero(interval > _SAME_BUNCH * interval.mean())) if len(interval) else 0, interval
