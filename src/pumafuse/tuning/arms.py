"""Arms against a recorded motion: how well each explains it, under the noise that the best of them leaves.

The response r of an arm is computed exactly at each measurement. Gain and constant biases are linear and projected out.
What is left is a random walk, a disturbance and white noise; a filter for these makes it independent ("whitens" it), so
that sums of squares are likelihoods. The heavy part is in the core (``core/search.hpp``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from msgspec.structs import replace

from ..arrays import NEVER, BoolArray, FloatArray, IntArray, TimeArray
from ..discovery.following import phase
from ..filter.core import AXIS, Record, check, library, ptr
from ..filter.response import record_of
from ..model.arm import AxisModel, Gain, Sag
from ..model.plants import FirstOrder, SecondOrder
from .steps import bounded_step

_NOISE = np.dtype(
    [(name, np.float64) for name in ("walk", "offset_sd", "disturbance_sd", "disturbance_time", "smoothness")]
)
# A sensor's noise is believed to be what second differences show where the arm is calm, as arms jerk, within a factor
# of some 2: the sd of its logarithm, and the share of the rows. Chosen so that error bars of benchmarks/real.py and
# tests hold; there a quarter to a half of the rows and factors of 1.5 to 1.9 say the same.
BELIEF, _CALM = math.log(1.9), 1.0 / 3.0
_LATEST, _PERIODS = 0.6, 5.0  # s, or update periods: the longest dead time
_FAR = 30.0  # times all that is measured: where an offset may begin
_WALKS, _SDS = (1e-8, 10.0), (1e-8, 10.0)  # m/√s, m: bounds
_TIME, _TIMES = 0.3, (1e-3, 1e3)  # s, of a disturbance: start, bounds
_SHARE, _SMALLEST = 0.98, 1e-7  # of the measurements that least squares are of; the rest may be outliers; m
_BEND = 0.6745 * math.sqrt(6.0)  # median of a second difference of white noise, in its standard deviations
_FEW = 3  # outliers in a row
_HARMLESS = 0.02  # of the range that is measured
_SLOW, _FASTEST = 0.1, 0.99  # of the speed that so many rows do not exceed: slower is at rest
_QUARTERS, _FEW_COMMANDS = 4, 200  # of a long recording; of which parts are no excerpt
_SETTLED = 2.6  # s, after which an arm has forgotten earlier commands
_CLOSE = 0.01  # log-likelihood: what is expected to gain less is no step
_STEPS = 12  # of Gauss and Newton, at most
PROMISE = 5.0  # times the gain expected of the last step, beyond which no further steps are hoped to lead
_SHIFT, _LOG_SHIFT = 1e-4, 1e-3  # s, 1: by which responses are varied; delays are coarser than a nanosecond's rounding
# longest step of each coordinate; a slope is linear, and its unit is of any size
_REACH = {
    "delay": 0.03, "lag": 0.7, "damping": 0.7, "recovery": 0.7, "gain": 1.0, "slope": math.inf,
    "play": 0.7, "max_speed": 0.3, "knee": math.inf, "beyond": 0.3, "knee_below": math.inf, "below": 0.3,
}  # fmt: skip
_DAMPINGS = (0.0, 1e-2, 1.0, 1e2, 1e4)  # of a step that fails, one after the other
_NUDGE = 1e-5  # of a coordinate, by which a size is varied
_SINGULAR = 1e-6  # of the largest eigenvalue: what is less was fitted away
_BLOCKS, _STUDENT = 10, 2.262157  # of the motion; the 97.5 % point of Student's t distribution of one fewer
_LOG_2PI = math.log(2.0 * math.pi)

Coordinates: TypeAlias = Sequence[str]  # among the fields below
# what no matrix does, and no kind of plant has: bounds in m and m/s
BENDS = {"play": (1e-6, 1.0), "max_speed": (1e-3, 100.0)}
LOGARITHMIC = ("lag", "damping", "recovery", *BENDS)
SAG = ("knee", "beyond", "knee_below", "below")  # of a line in pieces, one of which is the gain
BEYOND = (-0.98, 1.0)  # bounds of the slope of another: no load moves a tool more than twice as far


class Recording(NamedTuple):
    """What was commanded on an axis, and what was measured of it, in one piece."""

    stamp: TimeArray  # when each command was given, int64 ns, (k,)
    command: FloatArray  # u [m], (k,)
    start: float  # the level [m] at which the axis rests before its first command
    time: TimeArray  # when each measurement is valid, int64 ns, ascending, (m,)
    value: FloatArray  # where the axis was then, relative to 'start'; the sensor's scale is taken out [m], (m,)
    source: IntArray  # the number of its sensor, (m,)
    weight: FloatArray  # 1, or 0 where a measurement does not count, (m,)

    def of(self, rows: Any) -> Recording:
        """With some of the measurements."""
        time, value, source, weight = (part[rows] for part in self[3:])
        return self._replace(time=np.ascontiguousarray(time), value=value, source=source, weight=weight)


@dataclass(frozen=True)
class NoiseModel:
    """What an arm leaves of the measurements."""

    sd: FloatArray  # white noise of each sensor [m], (s,)
    walk: float = 0.0  # density of a random walk [m/√s]
    disturbance_sd: float = 0.0  # [m]; 0: there is none
    disturbance_time: float = _TIME  # [s]
    smoothness: float = 0.5  # 1.5 (Matérn) or 0.5 (Ornstein-Uhlenbeck)


def longest_delay(period: float) -> float:
    """The longest dead time [s] that is looked for of an arm with this update period [s]."""
    return max(_LATEST, _PERIODS * period)


class Arm(NamedTuple):
    """An arm of an axis: what is varied of it."""

    delay: float  # dead time [s]
    lag: float  # of the plant, behind an input of constant velocity: τ or 2 ζ / ω [s]
    damping: float = 0.0  # ζ; 0: the plant is of first order
    recovery: float = 0.0  # time constant with which the gain recovers [s]; 0: it stays
    gain: float = 1.0  # K of slow motion
    slope: float = 0.0  # what it gains with speed [s/m]
    play: float = 0.0  # width of the backlash between drive and tool [m]; 0: it has none
    max_speed: float = 0.0  # the fastest that the drive goes [m/s]; 0: as fast as it is asked to
    knee: float = 0.0  # level above which a load holds the tool off [m], as logged
    beyond: float = 0.0  # what each 1 above it adds; 0: none does. knee_below, below: Likewise below a level
    knee_below: float = 0.0
    below: float = 0.0

    @property
    def total(self) -> float:
        """Lag behind the held command at constant velocity [s]."""
        return self.delay + self.lag + (1.0 - self.gain) * self.recovery

    @property
    def model(self) -> AxisModel:
        """Plant, gain, fastest speed, play, and the knees of its sag."""
        plant: FirstOrder | SecondOrder = FirstOrder(time_constant=self.lag)
        if self.damping:
            plant = SecondOrder(natural_frequency=2.0 * self.damping / self.lag, damping=self.damping)
        gain = Gain(slope=self.slope, intercept=self.gain)
        return AxisModel(
            plant=plant,
            gain=gain,
            gain_recovery=self.recovery or None,
            max_speed=self.max_speed or None,
            play=self.play or None,
            sag=self.sag_beside(Sag()) if self.beyond or self.below else None,
        )

    def sag_beside(self, sag: Sag) -> Sag:
        """A ``sag`` with the knees that the arm has in the place of its own."""
        if self.beyond:
            sag = replace(sag, knee=self.knee, slope_beyond=self.beyond)
        return replace(sag, knee_below=self.knee_below, slope_below=self.below) if self.below else sag

    @classmethod
    def of(cls, axis: AxisModel, delay: float) -> Arm:
        """The arm of an axis's model and its dead time [s]."""
        damping = axis.plant.damping if isinstance(axis.plant, SecondOrder) else 0.0
        gain, bends = axis.gain, (axis.play or 0.0, axis.max_speed or 0.0)
        sag = axis.sag or Sag()
        bends += tuple(number or 0.0 for number in (sag.knee, sag.slope_beyond, sag.knee_below, sag.slope_below))
        return cls(delay, axis.plant.lag, damping, axis.gain_recovery or 0.0, gain.intercept, gain.slope, *bends)

    def coordinate(self, name: str) -> float:
        """One of its numbers; of what can only be positive the logarithm."""
        value: float = getattr(self, name)
        return math.log(value) if name in LOGARITHMIC else value

    def moved(self, names: Coordinates, coordinates: Sequence[float]) -> Arm:
        """With other coordinates."""
        values = zip(names, coordinates, strict=True)
        return self._replace(**{name: math.exp(value) if name in LOGARITHMIC else value for name, value in values})


class Limits(NamedTuple):
    """Where the numbers of an arm may lie, and what is believed of them: mean and sd of a coordinate."""

    bounds: dict[str, tuple[float, float]]
    priors: dict[str, tuple[float, float]]

    def range(self, names: Coordinates) -> FloatArray:
        """Lower and upper bounds of coordinates, (2, k)."""
        logs = [[math.log(end) if name in LOGARITHMIC else end for end in self.bounds[name]] for name in names]
        return np.array(logs, dtype=np.float64).reshape(-1, 2).T

    def inside(self, arm: Arm, names: Coordinates) -> BoolArray:
        """Which coordinates of an arm are not at a bound, (k,)."""
        low, high = self.range(names)
        at = np.array([arm.coordinate(name) for name in names])
        return (at > low + 1e-6) & (at < high - 1e-6)

    def log_prior(self, arm: Arm, names: Coordinates) -> float:
        """Logarithm of the prior density, but for a constant."""
        return -0.5 * sum(
            ((arm.coordinate(name) - self.priors[name][0]) / self.priors[name][1]) ** 2
            for name in names
            if name in self.priors
        )


class Fit(NamedTuple):
    """An arm that was fitted."""

    arm: Arm  # the arm
    log_posterior: float  # with the biases at their best
    information: FloatArray  # of the coordinates that were varied, the biases being at their best, (k, k)
    score: FloatArray  # how the logarithm rises with these, (k,)


class Measured:
    """All recordings of an axis, as a function of the arm and of the noise that it leaves."""

    def __init__(
        self, recordings: Sequence[Recording], period: float, sensors: Sequence[str], model: AxisModel | None = None
    ) -> None:
        """Measurements by ``sensors`` of an axis with the update ``period`` [s] that sags as the ``model`` does."""
        self.recordings, self.period, self.sensors, self._model = recordings, period, sensors, model
        self.count = int(sum(recording.weight.sum() for recording in recordings))
        self.range = max(
            (float(np.ptp(recording.value)) for recording in recordings if len(recording.value)), default=0.0
        )
        self._offset = _FAR * max(self.range, 1e-6)

    def of(self, recordings: Sequence[Recording]) -> Measured:
        """Other recordings of the same axis by the same sensors."""
        return Measured(recordings, self.period, self.sensors, self._model)

    @cached_property
    def moving(self) -> BoolArray:
        """Which of the measurements that count are of an axis in motion: a tenth of its fastest or more, (n,)."""
        parts = list[BoolArray]()
        for recording in self.recordings:
            value = recording.value[recording.weight > 0.0]
            way = np.abs(np.gradient(value)) if len(value) > 1 else np.zeros(len(value))
            parts.append(way >= _SLOW * np.quantile(way, _FASTEST) if way.any() else way == 0.0)
        return np.concatenate(parts)

    @property
    def phase(self) -> float | None:
        """How long after a command all measurements are valid, in update periods; None where that differs."""
        return phase(((recording.stamp, recording.time) for recording in self.recordings), self.period)

    def at_commands(self, later: float = 0.0) -> Measured:
        """The instants of the commands from the first measurement to the last, or so much ``later`` [s], unmeasured."""
        parts = list[Recording]()
        for recording in self.recordings:
            first, last = recording.time.min(initial=NEVER), recording.time.max(initial=0)
            within = (recording.stamp >= first) & (recording.stamp <= last)
            time = recording.stamp[within] + round(later * 1e9)
            none = np.zeros(len(time))
            parts.append(recording._replace(time=time, value=none, source=none.astype(np.int64), weight=none))
        return self.of(parts)

    def left(self, arm: Arm) -> FloatArray:
        """What an arm leaves of the measurements that count, of each recording about its mean [m]."""
        parts = zip(self.residuals(arm), self.recordings, strict=True)
        counted = [left[part.weight > 0.0] for left, part in parts if part.weight.any()]
        return np.concatenate([left - left.mean() for left in counted] or [np.zeros(0)])

    def squares(self, arm: Arm) -> float:
        """The sum of the squares that an arm leaves [m²]."""
        left = self.left(arm)
        return float(left @ left)

    @property
    def power(self) -> float:
        """The sum of squares of all that is measured [m²], of each recording about its mean."""
        values = [recording.value for recording in self.recordings if len(recording.value)]
        return sum(float(np.var(value) * len(value)) for value in values)

    def without_far_from(self, arm: Arm, times: float) -> Measured:
        """Without measurements so many times as far off an arm as half of them are: those in motion, and those at rest.

        What is nearer than a small part of the motion does no harm.
        """
        residuals = [left - np.median(left) if len(left) else left for left in self.residuals(arm)]
        left = np.abs(np.concatenate(residuals))
        moving = self.of(
            [recording._replace(weight=np.ones(len(recording.time))) for recording in self.recordings]
        ).moving
        limit = np.full(len(left), _HARMLESS * self.range)
        for some in (moving, ~moving):
            limit[some] = np.maximum(limit[some], times * np.median(left[some]) if some.any() else 0.0)
        near = np.split(left <= limit, np.cumsum([len(recording.time) for recording in self.recordings])[:-1])
        return self.of(
            [
                recording._replace(weight=np.where(kept, recording.weight, 0.0))
                for recording, kept in zip(self.recordings, near, strict=True)
            ]
        )

    def white(self, arm: Arm) -> NoiseModel:
        """All that an arm leaves as noise of the sensors: for least squares."""
        left = np.sort(np.abs(self.left(arm)))
        left = left[: math.ceil(_SHARE * len(left))]
        sd = max(float(np.sqrt(np.mean(left**2))), _SMALLEST) if len(left) else 1.0
        return NoiseModel(np.full(len(self.sensors), sd))

    def jitter(self, arm: Arm) -> FloatArray:
        """White noise of each sensor [m], (s,), by second differences of what an arm leaves where it is calm."""
        sds = np.full(len(self.sensors), float(self.white(arm).sd[0]))
        responses = self.responses(arm)
        for number in range(len(sds)):
            bends, ways = list[FloatArray](), list[FloatArray]()
            for recording, moved in zip(self.recordings, responses, strict=True):
                rows = (recording.source == number) & (recording.weight > 0.0)
                if rows.sum() > 2:
                    path = moved[rows]
                    bends.append(np.abs(np.diff(recording.value[rows] - path, 2)))
                    ways.append(np.ptp([path[:-2], path[1:-1], path[2:]], axis=0))
            if ways:
                way = np.concatenate(ways)
                calm = np.concatenate(bends)[way <= np.quantile(way, _CALM)]
                sds[number] = max(float(np.median(calm)) / _BEND, _SMALLEST)
        return sds

    def gated(self, arm: Arm, noise: NoiseModel, gate: float) -> Measured:
        """Without measurements whose innovation beside an arm is beyond so many standard deviations.

        More than a few of them in a row are no outliers: it is the arm that moves otherwise.
        """
        left, parts = self.residuals(arm), list[Recording]()
        for recording, left_here in zip(self.recordings, left, strict=True):
            white, _ = self._white(recording, noise, left_here[None])
            parts.append(recording._replace(weight=np.where(lonely(np.abs(white[0]) > gate), 0.0, recording.weight)))
        return self.of(parts)

    def liveliest(self, most: int) -> Measured:
        """Where each quarter of a recording moves most: of so many commands and measurements in all, about.

        Shorter recordings, and those of few commands, are whole.
        """
        parts = list[Recording]()
        for recording in self.recordings:
            commands, long = len(recording.stamp), max(len(recording.stamp), len(recording.time))
            if long <= most or commands < _FEW_COMMANDS:
                parts.append(recording)
                continue
            edges = np.linspace(0, commands, _QUARTERS + 1).astype(int).tolist()
            longest = max(commands * most // long, _FEW_COMMANDS) // _QUARTERS
            parts += [_liveliest(recording, longest, *ends) for ends in pairwise(edges)]
        return self.of(parts)

    def excerpt(self, commands: int, rows: int) -> Measured:
        """The part of each recording with the most motion, and some of its measurements, evenly."""
        parts = [_liveliest(recording, commands, 0, len(recording.stamp)) for recording in self.recordings]
        return self.of([part.of(slice(None, None, len(part.time) // rows + 1)) for part in parts])

    def responses(self, arm: Arm) -> list[FloatArray]:
        """The response of each recording [m], relative to its start."""
        return [moved[0] for moved in self.responses_of([arm])]

    def residuals(self, arm: Arm) -> list[FloatArray]:
        """What an arm leaves of each recording [m]."""
        return [recording.value - moved for recording, moved in zip(self.recordings, self.responses(arm), strict=True)]

    def whitened(self, noise: NoiseModel, columns: Sequence[FloatArray]) -> tuple[FloatArray, float]:
        """Columns (c, m) of each recording, one recording after the other, whitened; and the sum of log S."""
        white_parts, log_determinant = list[FloatArray](), 0.0
        for recording, some in zip(self.recordings, columns, strict=True):
            white, log = self._white(recording, noise, some)
            white_parts.append(white)
            log_determinant += log
        return np.concatenate(white_parts, axis=1), log_determinant

    def weighed(
        self, arms: Sequence[Arm], noise: NoiseModel, limits: Limits | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """The log-likelihood of each arm with its best gain, and that gain; for ``limits`` of None the gain is given.

        Arms in a row that differ in their dead times alone take little longer than one of them.

        Returns:
            Both, (n,).
        """
        records = self._records(arms)
        c = len(self.sensors)  # the measurements, and for each sensor but the first whether it is that
        products, columns_alone, log_determinant = np.zeros((len(arms), 2, 2 + c)), np.zeros((c, c)), 0.0
        for recording in self.recordings:
            white, log = self._white(recording, noise, self._columns(recording))
            columns_alone, log_determinant = columns_alone + white @ white.T, log_determinant + log
            products_here, record = np.empty_like(products), self._noise_record(noise)
            variance = self._variance(recording, noise)
            records["start"] = recording.start
            rows = len(recording.time), ptr(recording.time), ptr(variance), c, ptr(white)
            commands = len(recording.stamp), ptr(recording.stamp), ptr(recording.command)
            check(library.pf_weigh(ptr(record), *rows, *commands, len(arms), ptr(records), ptr(products_here)))
            products += products_here
        every = np.zeros((len(arms), 2 + c, 2 + c))  # products of plain response, gain, measurements and biases
        every[:, :2], every[:, :, :2], every[:, 2:, 2:] = products, products.swapaxes(1, 2), columns_alone
        gain, parts = np.array([arm.gain for arm in arms]), np.zeros((len(arms), 1 + c, 2 + c))
        parts[:, 0, 0], parts[:, 0, 1], parts[:, 0, 2] = -1.0, 0.0 if limits else 1.0 - gain, 1.0  # what is left
        parts[:, 1, 1], parts[:, 2:, 3:] = 1.0, np.eye(c - 1)  # gain, and biases
        left, free = parts @ every @ parts.swapaxes(1, 2), [*range(1 if limits else 2, 1 + c)]
        if limits:
            mean, sd = limits.priors.get("gain", (1.0, math.inf))
            left[:, 1, 1] += 1.0 / sd**2
            left[:, (0, 1), (1, 0)] += (mean - 1.0) / sd**2
        inner = left[:, free][:, :, free] + 1e-12 * np.eye(len(free)) * np.maximum(left[:, free, free], 1e-30)[:, None]
        best = np.linalg.solve(inner, left[:, free, 0][:, :, None])[:, :, 0] if free else np.zeros((len(arms), 0))
        squares = left[:, 0, 0] - np.einsum("ni,ni->n", best, left[:, free, 0])
        gain = 1.0 + best[:, 0] if limits else gain
        log = -0.5 * (np.maximum(squares, 0.0) + log_determinant + self.count * _LOG_2PI)
        return np.asarray(log, dtype=np.float64), np.asarray(gain, dtype=np.float64)

    def fitted(
        self, start: Arm, names: Coordinates, noise: NoiseModel, limits: Limits, worth: float = -math.inf
    ) -> Fit:
        """The arm of the highest posterior near another one, by Gauss and Newton.

        One below ``worth`` is not wanted: where that is out of reach, the search ends early.
        """
        low, high = limits.range(names)
        reach = np.array([_REACH[name] for name in names])
        arm = start.moved(names, np.clip([start.coordinate(name) for name in names], low, high).tolist())
        best = self._linear(arm, names, noise, limits)
        for _ in range(_STEPS if names else 0):
            here = np.array([best.arm.coordinate(name) for name in names])
            for damping in _DAMPINGS:
                ends = np.maximum(low - here, -reach), np.minimum(high - here, reach)
                step = bounded_step(best.score, best.information, *ends, np.full(len(names), damping))
                expected = float(best.score @ step) - 0.5 * float(step @ best.information @ step)
                if expected < _CLOSE or best.log_posterior + PROMISE * expected < worth:
                    return best
                trial = self._linear(best.arm.moved(names, (here + step).tolist()), names, noise, limits)
                if trial.log_posterior > best.log_posterior:
                    best = trial
                    break
            else:
                break
        return best

    def variances(
        self, arm: Arm, names: Coordinates, noise: NoiseModel, limits: Limits, pieces: int, size: Callable[[Arm], float]
    ) -> tuple[float, float]:
        """The variance of a size by the information, and by the scatter of the score over pieces of the recordings.

        Both are the same where the model is right (White, Econometrica 50, 1982). Coordinates at a bound stay there.
        """
        free = [name for name, inside in zip(names, limits.inside(arm, names), strict=True) if inside]
        beside = [arm.moved([name], [arm.coordinate(name) + _NUDGE]) for name in free]
        slope = np.array([(size(arm_beside) - size(arm)) / _NUDGE for arm_beside in beside])
        left, slopes, _ = self._sloped(arm, free, noise)
        scores = np.add.reduceat(slopes * left, np.unique(np.arange(pieces) * len(left) // pieces), axis=1)
        weight = covariance(self._linear(arm, free, noise, limits).information) @ slope
        return float(slope @ weight), float(np.sum((weight @ scores) ** 2))

    def half_width(
        self, arm: Arm, names: Coordinates, noise: NoiseModel, limits: Limits, size: Callable[[Arm], float]
    ) -> float:
        """Half the 95 % interval of a size.

        What an arm leaves is correlated, and each measurement alone would count far too much: a block of the motion
        counts as one observation (Bester, Conley & Hansen, J. Econometrics 165, 2011).
        """
        _, variance = self.variances(arm, names, noise, limits, _BLOCKS, size)
        return _STUDENT * math.sqrt(variance * _BLOCKS / (_BLOCKS - 1))

    def shifts(
        self, arm: Arm, names: Coordinates, noise: NoiseModel, count: int
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """How much later an arm is in each of ``count`` parts of the longest recording than on the whole.

        They are least squares on what a lag that is longer in one part alone adds to the motion. The coordinates of
        ``names`` were fitted to the same measurements, and may have explained a part of it.

        Returns:
            The middles of the parts [s after the first command], the shifts [s] and their information [1/s²], (n,),
            (n,) and (n, n); None where there are too few measurements.
        """
        longest = self.of([max(self.recordings, key=lambda recording: len(recording.time))])
        (recording,) = longest.recordings
        since: FloatArray = (recording.time - int(recording.stamp[0])) / 1e9
        if len(since) < 3 * count:
            return None
        edges = np.linspace(float(since[0]), float(since[-1]), count + 1)
        part = np.clip(np.searchsorted(edges, since, side="right") - 1, 0, count - 1)
        (moved,) = longest._derivatives(arm, ["delay", *names])
        response, rate, others = moved[0], moved[1], moved[2:]
        later = np.where(part == np.arange(count)[:, None], rate, 0.0)
        white, _ = longest.whitened(noise, [np.vstack([recording.value - response, later, others])])
        left, moved, fitted = np.split(white, [1, 1 + count])
        basis = np.linalg.qr(fitted.T)[0]
        moved -= (moved @ basis) @ basis.T
        information = moved @ moved.T
        inverse = np.asarray(np.linalg.pinv(information, _SINGULAR, hermitian=True), dtype=np.float64)
        return 0.5 * (edges[:-1] + edges[1:]), np.asarray(inverse @ moved @ left[0], dtype=np.float64), information

    def likeliest(self, arms: Sequence[Arm], noise: NoiseModel, limits: Limits | None, count: int) -> list[Arm]:
        """The likeliest of some arms, the best first, each with its best gain; for ``limits`` of None with its own."""
        log, gain = self.weighed(arms, noise, limits)
        return [arms[number]._replace(gain=float(gain[number])) for number in np.argsort(-log)[:count].tolist()]

    def _linear(self, arm: Arm, names: Coordinates, noise: NoiseModel, limits: Limits) -> Fit:
        """Posterior, score and information at an arm."""
        left, slopes, log_determinant = self._sloped(arm, names, noise)
        information, score = slopes @ slopes.T, slopes @ left
        for row, name in enumerate(names):
            if name in limits.priors:
                mean, sd = limits.priors[name]
                information[row, row] += 1.0 / sd**2
                score[row] -= (arm.coordinate(name) - mean) / sd**2
        log = -0.5 * (float(left @ left) + log_determinant + self.count * _LOG_2PI)
        return Fit(arm, log + limits.log_prior(arm, names), information, score)

    def _sloped(self, arm: Arm, names: Coordinates, noise: NoiseModel) -> tuple[FloatArray, FloatArray, float]:
        """What an arm leaves and how it changes with each coordinate, whitened, without biases; the sum of log S."""
        moved = self._derivatives(arm, names)
        columns = [
            np.vstack([recording.value - rows[0], rows[1:], self._columns(recording)[1:]])
            for recording, rows in zip(self.recordings, moved, strict=True)
        ]
        white, log_determinant = self.whitened(noise, columns)
        left, slopes, others = np.split(white, [1, 1 + len(names)])
        if len(others):
            basis = np.linalg.qr(others.T)[0]
            left, slopes = left - (left @ basis) @ basis.T, slopes - (slopes @ basis) @ basis.T
        return left[0], slopes, log_determinant

    def _derivatives(self, arm: Arm, names: Coordinates) -> list[FloatArray]:
        """The response of each recording, and how it changes with each coordinate, (1 + k, m)."""
        is_linear = not any((arm.play, arm.max_speed, arm.beyond, arm.below)) and not self.sags
        is_scale = is_linear and "gain" in names and not (arm.recovery or arm.slope)  # of a gain that stays
        varied = [name for name in names if not (is_scale and name == "gain")]
        steps = [_LOG_SHIFT if name in LOGARITHMIC else _SHIFT for name in varied]
        if is_linear:
            steps = [1.0 if name in ("gain", "slope") else step for name, step in zip(varied, steps, strict=True)]
        beside = [arm.moved([name], [arm.coordinate(name) + step]) for name, step in zip(varied, steps, strict=True)]
        responses = self.responses_of([arm, *beside])
        for moved in responses:
            moved[1:] = (moved[1:] - moved[0]) / np.array(steps)[:, None]
        if is_scale:
            row = 1 + names.index("gain")
            responses = [np.insert(moved, row, moved[0] / arm.gain, axis=0) for moved in responses]
        return responses

    @property
    def sags(self) -> bool:
        """Whether the axis is known to sag."""
        return self._model is not None and self._model.sag is not None

    def _columns(self, recording: Recording) -> FloatArray:
        """The measurements, and for each sensor but the first which are its, (s, m)."""
        others = [recording.source == other for other in range(1, len(self.sensors))]
        return np.array([recording.value, *others], dtype=np.float64)

    def responses_of(self, arms: Sequence[Arm]) -> list[FloatArray]:
        """The responses of arms, for each recording (n, m)."""
        records, responses = self._records(arms), list[FloatArray]()
        for recording in self.recordings:
            records["start"] = recording.start
            moved = np.empty((len(arms), len(recording.time)))
            commands = len(recording.stamp), ptr(recording.stamp), ptr(recording.command)
            asked = len(recording.time), ptr(recording.time), ptr(moved)
            check(library.pf_response(len(arms), ptr(records), *commands, *asked))
            responses.append(moved)
        return responses

    def _records(self, arms: Sequence[Arm]) -> Record:
        """Arms as the core takes them, (n,)."""
        records, columns = np.zeros(len(arms), AXIS), np.array(arms).T
        delay, lag, damping, recovery, gain, slope, play, max_speed, *sag = columns
        if self._model is not None:
            records[:] = record_of(self._model, self.period, 0.0, 0.0)
        records["period"], records["delay"] = self.period, delay
        records["time_constant"] = np.where(damping > 0.0, 0.0, lag)
        records["natural_frequency"], records["damping"] = 2.0 * damping / lag, damping
        records["slope"], records["intercept"], records["recovery"] = slope, gain, recovery
        records["play"], records["max_speed"] = play, max_speed
        for name, knee, other in (("beyond", *sag[:2]), ("below", *sag[2:])):
            where, bent = f"sag_knee{'_below' * (name == 'below')}", other != 0.0
            records[where][bent], records[f"sag_slope_{name}"][bent] = knee[bent], other[bent]
        return records

    def _variance(self, recording: Recording, noise: NoiseModel) -> FloatArray:
        return np.where(recording.weight > 0.0, np.square(noise.sd)[recording.source], np.inf)

    def _noise_record(self, noise: NoiseModel) -> Record:
        record = np.zeros(1, _NOISE)
        record[0] = noise.walk, self._offset, noise.disturbance_sd, noise.disturbance_time, noise.smoothness
        return record

    def _white(self, recording: Recording, noise: NoiseModel, columns: FloatArray) -> tuple[FloatArray, float]:
        record, variance, white, log = (
            self._noise_record(noise), self._variance(recording, noise), np.empty_like(columns), np.empty(1)
        )  # fmt: skip
        rows = len(recording.time), ptr(recording.time), ptr(variance)
        check(library.pf_whiten(ptr(record), *rows, len(columns), ptr(columns), ptr(white), ptr(log)))
        return white, float(log[0])


def lonely(far: BoolArray) -> BoolArray:
    """Which of some rows are but a few in a row, (n,)."""
    begins = np.flatnonzero(np.append(True, far[1:] != far[:-1]))
    in_a_row = np.repeat(np.diff(begins, append=len(far)), np.diff(begins, append=len(far)))
    return far & (in_a_row <= _FEW)


def _liveliest(recording: Recording, most: int, begin: int, end: int) -> Recording:
    """What was measured while so many commands moved most, of those between two; with commands that still act then."""
    if len(recording.stamp) <= most:
        return recording
    most = min(most, end - begin)
    firsts = np.append(np.arange(begin, end - most, max(most // 2, 1)), end - most)
    way = np.append(0.0, np.cumsum(np.abs(np.diff(recording.command))))
    first = int(max(firsts, key=lambda row: way[row + most - 1] - way[row]))
    last = first + most - 1
    part = recording.of((recording.time >= recording.stamp[first]) & (recording.time <= recording.stamp[last]))
    act = int(np.searchsorted(recording.stamp, int(recording.stamp[first]) - round(_SETTLED * 1e9)))
    start = float(recording.command[act]) if act else recording.start
    times, command = recording.stamp[act : last + 1], recording.command[act : last + 1]
    return part._replace(stamp=times, command=command, start=start, value=part.value + recording.start - start)


def covariance(information: FloatArray, scale: float | Sequence[float] = 1.0) -> FloatArray:
    """The covariance of coordinates, (k, k), a large change of which is ``scale``; without information enormous."""
    size = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12 / np.square(scale)))
    values, vectors = np.linalg.eigh(information * np.outer(size, size))
    return (vectors / np.maximum(values, 1e-12)) @ vectors.T * np.outer(size, size)


# ---- the noise ------------------------------------------------------------------------------------------------------


def noise_models(
    measured: Measured, arm: Arm, quickest: float, least: Sequence[float], believed: bool = False
) -> Iterator[tuple[NoiseModel, float]]:
    """The most likely noise that an arm leaves, without a disturbance and with one of each kind, and its log-posterior.

    A disturbance is not quicker than ``quickest`` [s], the noise of each sensor is at ``least`` that [m], and it may be
    ``believed`` to be what second differences show.
    """
    from scipy.optimize import minimize  # takes 0.2 s to import

    left = [residual[None] for residual in measured.residuals(arm)]
    spread = max(float(np.std(np.concatenate([row[0] for row in left]))), 1e-7)
    sensors = [(max(sd, _SDS[0]), _SDS[1]) for sd in least]
    white = np.clip(measured.jitter(arm), *np.transpose(sensors))
    s, means = len(white), np.log(np.maximum(white, least))
    for smoothness in (0.0, 1.5, 0.5):
        begin, bounds = [0.1 * spread], [*sensors, _WALKS]
        if smoothness:
            begin, bounds = [0.01 * spread, 0.7 * spread, _TIME], [*bounds, _SDS, (quickest, _TIMES[1])]

        def model_of(x: FloatArray, smoothness: float = smoothness) -> NoiseModel:
            sd, (walk, *disturbance) = np.exp(x[:s]), np.exp(x[s:]).tolist()
            return NoiseModel(sd, walk, *disturbance, smoothness=smoothness) if disturbance else NoiseModel(sd, walk)

        def cost(x: FloatArray, model_of: Callable[[FloatArray], NoiseModel] = model_of) -> float:
            white, log_determinant = measured.whitened(model_of(x), left)
            loss = 0.5 * (float(np.vdot(white, white)) + log_determinant + measured.count * _LOG_2PI)
            return loss + 0.5 * float(np.sum(((x[:s] - means) / BELIEF) ** 2)) * believed

        at, options = np.log([*white, *begin]), {"ftol": 1e-3, "eps": 1e-4}
        minimum = minimize(cost, at, method="SLSQP", bounds=np.log(bounds), options=options)
        yield model_of(minimum.x), -minimum.fun
