"""The posterior of an axis's arm, averaged over models and delays: how late it is, and how sure that is.

Neither the order of a plant nor the kind of its gain is known, and along a delay the likelihood has many maxima, also
whole update periods away. An interval from one maximum is too narrow. So each model is maximised at delays on both
sides of its maxima, and weighed by what Laplace's approximation makes of the other numbers there (Rue, Martino &
Chopin, "Approximate Bayesian inference by integrated nested Laplace approximations", JRSS B 71, 2009). Intervals are
quantiles of the mixture.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from ..arrays import FloatArray
from ..fusion.config import FusionConfig
from ..model.plants import FirstOrder, SecondOrder
from .identifiability import covariance
from .likelihood import Likelihood
from .maximise import Point, derivatives, maximise, past_bumps, point
from .parameters import (
    Fit,
    Parameter,
    changed,
    coordinates,
    moved,
    parameters,
    with_axis_of,
    with_disturbance,
    with_lag,
    with_order,
    with_recovery,
)
from .search import most_likely_models, noise_models

Quantity: TypeAlias = Literal[
    "lag", "delay", "gain", "gain_recovery", "time_constant", "natural_frequency", "damping"
]  # s, but for the gain, ω [rad/s] and ζ
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
GainKind: TypeAlias = Literal["none", "static", "recovering"]

LONGEST_DELAY = 0.6  # s
_PLANT_BOUNDS = {"time_constant": (1e-3, 2.0), "natural_frequency": (0.5, 2e3), "damping": (0.2, 8.0)}
INTERCEPTS, _INTERCEPT_PRIOR = (0.7, 1.3), (1.0, 0.1)  # of the gain
_RECOVERIES = (0.02, 0.5)  # s; what takes longer is hardly known from a gain that stays
_DAMPING_PRIOR = (0.0, 0.7)  # of ln ζ: what is sold as an axis neither rings for ever nor has two lags far apart
_LOG_RANGE = math.log(2e3)  # of a plant's lag, 1 ms to 2 s, each as likely
_DELAYS = 12  # that are tried at first, at most
_SHARE = 0.98  # of the measurements that least squares are of; the rest may be outliers
_ERRORS, _RECOVERING = (-0.12, -0.05, 0.05), (0.05, 0.12, 0.3)  # starts: gains less 1, recoveries [s]
_EARLIER, _DAMPINGS = (0.0, 0.3, 0.6), (0.6, 1.0, 1.6)  # starts: shares of the lag that are no delay, ζ
_NEARLY = 40.0  # log-likelihood that a better noise may gain
_DOUBT = 20.0  # log-likelihood that a recovery at a bound must gain
_WORSE = 2.0  # log-likelihood behind the best of all, from which a model is looked for again
_SAME = 2e-4  # s, between delays of maxima that are one
_ARM: tuple[Fit, ...] = ("delay", "plant", "gain")
_ROUGHLY = 0.1  # tolerance in log-likelihood
_COARSELY = 1.0  # where only the valley is looked for
_FORLORN = 8.0  # log-likelihood behind the best, after the penalty, from which a model or a delay counts for nothing
_STEP = 0.7  # standard deviations, between delays
_SHORTEST, _LONGEST = 2e-5, 0.03  # s, of a step
_MOST = 12  # steps away from a maximum
_GRID = 2000  # points of a distribution, at most
_REFINED = 8  # points between two delays, along which everything is interpolated
_AS_LIKELY = 0.2  # of the most likely model's probability: the simplest of such models is taken
_OWN_WIDTH = 0.05  # s: how far apart the delays of axes that do not share one are a priori


class Model(NamedTuple):
    """An order of the plant with a kind of gain."""

    order: int
    gain: GainKind

    @property
    def size(self) -> int:
        """How many numbers it has beside the delay."""
        return self.order + ("none", "static", "recovering").index(self.gain)


MODELS = tuple(Model(*one) for one in product((1, 2), ("none", "static", "recovering")))


@dataclass(frozen=True)
class Entry:
    """The most likely arm of a model with one delay.

    Attributes:
        delay: The delay [s].
        config: The configuration.
        log_density: Of the delay and the model, with Laplace's approximation for the other numbers.
        means: Of each quantity that the model has.
        sds: Their standard deviations at this delay.
    """

    delay: float
    config: FusionConfig
    log_density: float
    means: Mapping[Quantity, float]
    sds: Mapping[Quantity, float]


@dataclass(frozen=True)
class Branch:
    """The entries of a model about one of its maxima, by delay."""

    model: Model
    entries: Sequence[Entry]

    @property
    def delays(self) -> FloatArray:
        """Of the entries [s], (n,)."""
        return np.array([one.delay for one in self.entries])

    @property
    def log_density(self) -> FloatArray:
        """Of the entries, (n,)."""
        return np.array([one.log_density for one in self.entries])

    def at(self, delays: FloatArray) -> FloatArray:
        """The log-density at delays, as it falls at the ends beyond them, (m,)."""
        known, found = self.delays, self.log_density
        if len(known) < 2:
            return np.where(np.abs(delays - known[0]) < _SHORTEST, found[0], -np.inf)
        middle = np.interp(delays, known, found)
        low, high = (found[1] - found[0]) / (known[1] - known[0]), (found[-1] - found[-2]) / (known[-1] - known[-2])
        below = found[0] + max(low, 0.0) * (delays - known[0])
        above = found[-1] + min(high, 0.0) * (delays - known[-1])
        return np.where(delays < known[0], below, np.where(delays > known[-1], above, middle))


class Mixture(NamedTuple):
    """Points of all branches between their entries, (n,).

    Attributes:
        weight: Their probabilities.
        model: Numbers in :data:`MODELS`.
        delay: Their delays [s].
        mean: Of each quantity there; NaN where the model does not have it.
        sd: Its standard deviation there.
    """

    weight: FloatArray
    model: FloatArray
    delay: FloatArray
    mean: Mapping[Quantity, FloatArray]
    sd: Mapping[Quantity, FloatArray]

    def quantiles(self, quantity: Quantity, chosen: Callable[[Model], bool], share: float = 0.95) -> tuple[float, ...]:
        """The ends of the middle ``share`` of a quantity under the models that are chosen."""
        from scipy.special import ndtr  # takes a while to import

        models = np.array([chosen(one) for one in MODELS])
        mine = models[self.model.astype(np.int64)] & np.isfinite(self.mean[quantity]) & (self.weight > 1e-9)
        mean, sd, weight = self.mean[quantity][mine], self.sd[quantity][mine], self.weight[mine]
        sd = np.maximum(sd, 1e-12)
        grid = np.unique(np.concatenate([mean + times * sd for times in np.linspace(-4.0, 4.0, 33)]))
        if len(grid) > _GRID:
            grid = grid[np.linspace(0, len(grid) - 1, _GRID).astype(np.int64)]
        below = ndtr((grid[:, None] - mean) / sd) @ weight / weight.sum()
        return tuple(float(np.interp(0.5 + sign * 0.5 * share, below, grid)) for sign in (-1.0, 1.0))


@dataclass(frozen=True)
class AxisPosterior:
    """The posterior of one axis.

    Attributes:
        axis: Its name.
        branches: Of all models that count.
    """

    axis: str
    branches: Sequence[Branch]

    def log_density(self, delays: FloatArray) -> FloatArray:
        """The log-density of the delay, all models together, (m,)."""
        found = np.full(len(delays), -np.inf)
        for model in {branch.model for branch in self.branches}:
            each = [branch.at(delays) for branch in self.branches if branch.model == model]
            found = np.logaddexp(found, np.max(each, axis=0))
        return found

    def mixture(self, others: Callable[[FloatArray], FloatArray]) -> Mixture:
        """The mixture, with the log-density of the delay by other axes."""
        parts = [self._points(branch) for branch in self.branches]
        delay = np.concatenate([part.delay for part in parts])
        logs = np.concatenate([part.weight for part in parts]) + others(delay)
        weight = np.exp(logs - logs.max())
        return Mixture(
            weight / weight.sum(),
            np.concatenate([part.model for part in parts]),
            delay,
            {name: np.concatenate([part.mean[name] for part in parts]) for name in QUANTITIES},
            {name: np.concatenate([part.sd[name] for part in parts]) for name in QUANTITIES},
        )

    def _points(self, branch: Branch) -> Mixture:
        """Points between the entries of a branch; the logarithms of their weights."""
        known, count = branch.delays, len(branch.entries)
        place, index = np.linspace(0.0, count - 1.0, _REFINED * (count - 1) + 1), np.arange(count)
        delay = np.interp(place, index, known)
        width = np.gradient(delay) if len(delay) > 1 else np.array([_SHORTEST])
        log = branch.at(delay) + np.log(width)
        for other in self.branches:  # of two maxima that meet, each counts where it is the higher one
            if other is not branch and other.model == branch.model:
                log = np.where(other.at(delay) > branch.at(delay) + 1e-9, -np.inf, log)

        def between(values: list[float]) -> FloatArray:
            return np.asarray(np.interp(place, index, values), dtype=np.float64)

        return Mixture(
            np.asarray(log, dtype=np.float64),
            np.full(len(delay), float(MODELS.index(branch.model))),
            np.asarray(delay, dtype=np.float64),
            {name: between([one.means.get(name, np.nan) for one in branch.entries]) for name in QUANTITIES},
            {name: between([one.sds.get(name, np.nan) for one in branch.entries]) for name in QUANTITIES},
        )


# ---- one axis -------------------------------------------------------------------------------------------------------


def axis_posterior(likelihood: Likelihood, start: FusionConfig, axis: str) -> AxisPosterior:
    """The posterior of an axis's arm.

    Args:
        likelihood: Of this axis alone.
        start: A configuration with its lag roughly right, and a delay of its own for the axis.
        axis: The axis.
    """
    search = _AxisSearch(likelihood, start, axis)
    peaks = search.peaks()
    best = peaks[0][0]
    branches: list[Branch] = []
    for evidence, model, peak in peaks:
        if evidence > best - _FORLORN and not _walked(branches, model, search.delay_of(peak)):
            highest = max((float(one.log_density.max()) for one in branches), default=-np.inf)
            branches.append(search.walk(model, peak, highest - _FORLORN))
    return AxisPosterior(axis, branches)


def _walked(branches: Sequence[Branch], model: Model, delay: float) -> bool:
    return any(one.model == model and one.delays[0] <= delay <= one.delays[-1] for one in branches)


class _AxisSearch:
    """Maxima of each model of an axis, and the walk from one along the delay."""

    def __init__(self, likelihood: Likelihood, start: FusionConfig, axis: str) -> None:
        self.likelihood, self.start, self.axis = likelihood, start, axis
        self._lag = start.arm.lag_of(axis)
        self._free: dict[tuple[object, ...], list[Parameter]] = {}

    def delay_of(self, peak: Point) -> float:
        return peak.config.arm.delay_of(self.axis)

    def free(self, config: FusionConfig, model: Model, fits: Sequence[Fit]) -> list[Parameter]:
        """The free parameters of a model, of these kinds."""
        arm, process = config.arm.axes[self.axis], config.process[self.axis]
        key = type(arm.plant), arm.gain_recovery is None, process.disturbance_sd > 0.0, model.gain, tuple(fits)
        if key not in self._free:
            self._free[key] = self._listed(config, model, fits)
        return self._free[key]

    def _listed(self, config: FusionConfig, model: Model, fits: Sequence[Fit]) -> list[Parameter]:
        measured, least = {self.axis: self.likelihood.sensors[self.axis]}, self.likelihood.resolution
        every = parameters(config, self.start, measured, fits, resolution=least)
        found: list[Parameter] = []
        for one in every:
            field = one.path[-1]
            if one.axis != self.axis or field.startswith("maneuver") or (field == "intercept" and model.gain == "none"):
                continue
            if one.fit == "noise":
                one = replace(one, prior=None)
            elif one.fit == "delay":
                one = replace(one, bounds=(0.0, LONGEST_DELAY))
            elif field in _PLANT_BOUNDS:
                one = replace(one, bounds=_PLANT_BOUNDS[field], prior=_DAMPING_PRIOR if field == "damping" else None)
            elif field == "intercept":
                one = replace(one, bounds=INTERCEPTS, prior=_INTERCEPT_PRIOR)
            elif field == "gain_recovery":
                one = replace(one, bounds=_RECOVERIES)
            found.append(one)
        return found

    def everything(self, config: FusionConfig, model: Model) -> list[Parameter]:
        """All free parameters but the noises that have vanished."""
        found = self.free(config, model, ("noise", *_ARM))
        return [one for one in found if not (one.vanishes and one.at_bound(config) == "lower")]

    def polished(self, model: Model, config: FusionConfig) -> Point:
        """The maximum next to a configuration, arm and noise together."""
        best = maximise(self.likelihood, config, self.everything(config, model), tolerance=_ROUGHLY)
        return past_bumps(self.likelihood, best, self.everything(best.config, model))

    def maximum(self, model: Model, starts: Iterable[FusionConfig], climbed: int = 2, worth: float = -np.inf) -> Point:
        """The best of the maxima of the arm next to the best starts, the noise as it is.

        What is not going to be ``worth`` it, or as high as the best until then, is not followed to its end.
        """
        tried = [point(self.likelihood, start, self.free(start, model, _ARM)) for start in starts]
        tried.sort(key=lambda one: -one.log_posterior)
        peaks: list[Point] = []
        for one in tried[:climbed]:
            free = self.free(one.config, model, _ARM)
            peaks.append(maximise(self.likelihood, one.config, free, tolerance=_COARSELY, worth=worth))
            worth = max(worth, peaks[-1].log_posterior)
        return max(peaks, key=lambda one: one.log_posterior)

    def with_white_noise(self, config: FusionConfig) -> FusionConfig:
        """The configuration with all that the arm leaves over as noise of the sensors: for least squares."""
        pairs = self.likelihood.responses(config).values()
        left = np.sort(np.abs(np.concatenate([measured - expected for expected, measured in pairs])))
        left = float(np.sqrt(np.mean(left[: math.ceil(_SHARE * len(left))] ** 2)))
        for one in self.free(config, MODELS[0], ["noise"]):
            config = one.put(config, one.clipped(left) if one.sensor else one.bounds[0])
        return with_disturbance(config, self.axis, 0.0, config.process[self.axis].disturbance_time)

    def with_noise(self, config: FusionConfig) -> FusionConfig:
        """The configuration with the most likely noise, with or without a disturbance of either kind."""

        def free(at: FusionConfig) -> list[Parameter]:
            return self.free(at, MODELS[0], ["noise"])

        models = noise_models(self.likelihood, config, free)
        found = [maximise(self.likelihood, model, free(model), tolerance=_ROUGHLY) for model in models]
        return most_likely_models(self.likelihood, found, free)[0]

    def with_noise_of(self, config: FusionConfig, other: FusionConfig) -> FusionConfig:
        """The configuration with the noise of another one."""
        arm = config.arm.axes[self.axis]
        return changed(with_axis_of(config, other, self.axis), ("arm", "axes", self.axis), arm)

    def with_gain(self, config: FusionConfig, gain: float, recovery: float | None) -> FusionConfig:
        """A configuration with another gain, and a plant that makes up for the lag that it brings."""
        now, total = config.arm.axes[self.axis], config.arm.lag_of(self.axis)
        config = with_recovery(config, self.axis, recovery)
        config = changed(config, ("arm", "axes", self.axis, "gain", "intercept"), gain)
        lag = now.plant.lag + total - config.arm.lag_of(self.axis)
        return with_lag(config, self.axis, min(max(lag, 0.1 * now.plant.lag), 2.0))

    def with_delay(self, config: FusionConfig, delay: float) -> FusionConfig:
        """A configuration with another delay, and so much less or more lag of the plant."""
        now, delay = config.arm, min(max(delay, 0.0), LONGEST_DELAY)
        rest = now.axes[self.axis].plant.lag - (delay - now.delay_of(self.axis))
        config = changed(config, ("arm", "axes", self.axis, "delay"), delay)
        return with_lag(config, self.axis, min(max(rest, 0.002, 0.1 * self._lag), 2.0))

    def starts(self, model: Model, config: FusionConfig) -> Iterator[FusionConfig]:
        """Configurations of a model that lag as much as another one does."""
        now = config.arm.axes[self.axis]
        kind = "none" if now.gain.intercept == 1.0 else "static" if now.gain_recovery is None else "recovering"
        order = 1 if isinstance(now.plant, FirstOrder) else 2
        if model.gain == "none":
            gains: list[tuple[float, float | None]] = [(1.0, None)]
        elif model.gain == "static":
            gains = [(now.gain.intercept if kind == "static" else 1.0, None)]
        elif kind == "recovering":
            gains = [(now.gain.intercept, now.gain_recovery)]
        else:
            gains = [(1.0 + error, recovery) for error, recovery in product(_ERRORS, _RECOVERING)]
        for gain, recovery in gains:
            there = self.with_gain(config, gain, recovery)
            if model.order == order:
                yield there
                continue
            there = with_order(there, self.axis, model.order)
            delay, lag = there.arm.delay_of(self.axis), there.arm.axes[self.axis].plant.lag
            shapes = product(_EARLIER, _DAMPINGS if model.order == 2 else (1.0,))
            for earlier, damping in shapes if len(gains) == 1 else ((0.3, 1.0),):
                shaped = self.with_delay(there, delay + (earlier if model.order == 2 else -earlier) * -lag)
                yield shaped if model.order == 1 else self._damped(shaped, damping)

    def _damped(self, config: FusionConfig, damping: float) -> FusionConfig:
        """A configuration with another damping, of the same lag."""
        lag = config.arm.axes[self.axis].plant.lag
        plant = SecondOrder(natural_frequency=2.0 * damping / lag, damping=damping)
        return changed(config, ("arm", "axes", self.axis, "plant"), plant)

    def peaks(self) -> list[tuple[float, Model, Point]]:
        """The maxima of every model with their evidence, the best first.

        By least squares at first: noise that is fitted to a poor arm explains what a better one would. Then with the
        noise that the best arm leaves, each model from the best of all, too; and an update period of delay away.
        """
        plain = self.with_white_noise(self.with_gain(with_order(self.start, self.axis, 1), 1.0, None))
        delays = np.arange(0.0, self._lag, max(0.5 * self.start.arm.update_period, self._lag / _DELAYS))
        best = {MODELS[0]: self.maximum(MODELS[0], [self.with_delay(plain, delay) for delay in delays.tolist()])}
        for model in MODELS[1:]:
            best[model] = self.maximum(model, self.starts(model, self._best(best).config))
        best = self._again(best, self.with_white_noise(self._best(best).config))
        best = self._likely(self._again(best, self.with_noise(self._best(best).config)))
        found = [self._weighed(model, self.polished(model, peak.config)) for model, peak in best.items()]
        highest = max(one[0] for one in found)
        for evidence, model, peak in list(found):
            for start in self._ticks_away(peak.config) if evidence > highest - _FORLORN else ():
                worth = peak.log_posterior - _NEARLY
                beside = self.maximum(model, [start], worth=worth)
                known = [self.delay_of(one) for _, other, one in found if other == model]
                apart = min(abs(self.delay_of(beside) - delay) for delay in known)
                if apart > _SAME and beside.log_posterior > worth:
                    found.append(self._weighed(model, self.polished(model, beside.config)))
        return sorted(found, key=lambda one: -one[0])

    def _again(self, best: Mapping[Model, Point], noise: FusionConfig) -> dict[Model, Point]:
        """The maximum of each model with another noise, from where it was or from the best of all."""
        top, found = self.with_noise_of(self._best(best).config, noise), dict[Model, Point]()
        for model in sorted(best, key=lambda one: -best[one].log_posterior):
            own = self.with_noise_of(best[model].config, noise)
            found[model] = self.maximum(model, [own, *self.starts(model, top)], climbed=1)
            if len(found) == 1:  # the best until now: with commands a period apart a wrong period fits well, too
                ticks_away = self._ticks_away(found[model].config)
                again = self.maximum(model, ticks_away, worth=found[model].log_posterior)
                if again.log_posterior > found[model].log_posterior:
                    found[model], top = again, again.config
        other = self._best(found)
        for model, peak in found.items():
            if peak.log_posterior < other.log_posterior - _WORSE:
                starts = list(self.starts(model, other.config))
                again = self.maximum(model, starts, climbed=1, worth=peak.log_posterior)
                found[model] = max(peak, again, key=lambda one: one.log_posterior)
        return found

    def _ticks_away(self, config: FusionConfig) -> Iterator[FusionConfig]:
        """The configuration with a delay that is an update period shorter, and one that is longer."""
        for ticks in (-1.0, 1.0):
            yield self.with_delay(config, config.arm.delay_of(self.axis) + ticks * config.arm.update_period)

    def _likely(self, found: Mapping[Model, Point]) -> dict[Model, Point]:
        """Those models that a better noise could still bring near the best."""
        evidence = {model: self.evidence(model, peak) for model, peak in found.items()}
        least = max(evidence.values()) - _NEARLY
        return {model: peak for model, peak in found.items() if evidence[model] > least}

    def _best(self, found: Mapping[Model, Point]) -> Point:
        return max(found.values(), key=lambda one: one.log_posterior)

    def _weighed(self, model: Model, peak: Point) -> tuple[float, Model, Point]:
        return self.evidence(model, peak), model, peak

    def evidence(self, model: Model, peak: Point) -> float:
        """The log-density of a maximum with the penalty for the model's numbers, roughly.

        A gain that recovers sooner or later than can be told is hardly one: mostly another model says the same.
        """
        recovery = [one for one in self.free(peak.config, model, ["gain"]) if one.path[-1] == "gain_recovery"]
        doubt = _DOUBT if any(one.at_bound(peak.config) for one in recovery) else 0.0
        arm = [one for one in self.free(peak.config, model, _ARM) if one.at_bound(peak.config) is None]
        information = derivatives(self.likelihood, peak, arm).information
        return (_laplace(peak.log_posterior, information, arm) if arm else peak.log_posterior) - doubt

    def walk(self, model: Model, peak: Point, least: float) -> Branch:
        """The entries of a model about a maximum, until they count for nothing or less than ``least``."""
        arm = self.free(peak.config, model, _ARM)
        cov = covariance(derivatives(self.likelihood, peak, arm).information, arm)
        place = next(number for number, one in enumerate(arm) if one.fit == "delay")
        others = [one for one in arm if one.fit != "delay"]
        sd = float(np.sqrt(cov[place, place]))
        slope = np.delete(cov[:, place] / cov[place, place], place)
        step = min(max(_STEP * sd, _SHORTEST), _LONGEST)
        middle = self._entry(peak, others)
        sides = [
            list(self._side(peak, others, sign * step, sign * step * slope, max(least, middle.log_density - _FORLORN)))
            for sign in (-1.0, 1.0)
        ]
        return Branch(model, [*reversed(sides[0]), middle, *sides[1]])

    def _side(
        self, peak: Point, others: Sequence[Parameter], step: float, move: FloatArray, least: float
    ) -> Iterator[Entry]:
        low, high = np.array([one.range for one in others]).reshape(-1, 2).T
        before = peak.config
        at = coordinates(before, others)
        for _ in range(_MOST):
            delay = before.arm.delay_of(self.axis) + step
            if not -abs(step) < delay <= LONGEST_DELAY:
                return
            there = changed(before, ("arm", "axes", self.axis, "delay"), max(delay, 0.0))
            there = moved(there, others, np.clip(at + move, low, high))
            found = maximise(self.likelihood, there, others, tolerance=_ROUGHLY)
            entry = self._entry(found, others)
            yield entry
            least = max(least, entry.log_density - _FORLORN)
            if entry.log_density < least or delay <= 0.0:
                return
            before, after = found.config, coordinates(found.config, others)
            move, at = after - at, after

    def _entry(self, found: Point, others: Sequence[Parameter]) -> Entry:
        """An entry from the most likely configuration with its delay."""
        inside = [one for one in others if one.at_bound(found.config) is None]
        information = derivatives(self.likelihood, found, inside).information if inside else np.zeros((0, 0))
        cov = covariance(information, inside) if inside else information
        means, sds = dict[Quantity, float](), dict[Quantity, float]()
        for name, measure in _measures(self.axis, found.config).items():
            at = measure(found.config)
            slope = np.array(
                [(measure(one.move(found.config, one.at(found.config) + 1e-5)) - at) / 1e-5 for one in inside]
            )
            means[name], sds[name] = at, float(np.sqrt(max(slope @ cov @ slope, 0.0))) if inside else 0.0
        density = _laplace(found.log_posterior, information, inside)
        return Entry(found.config.arm.delay_of(self.axis), found.config, density, means, sds)


def _laplace(log_posterior: float, information: FloatArray, free: Sequence[Parameter]) -> float:
    """The log-density with the free numbers integrated out, each with its prior's constant."""
    log = log_posterior
    for one in free:
        if one.prior is not None:
            log -= math.log(one.prior[1] * math.sqrt(2.0 * math.pi))
        elif one.fit == "plant":
            log -= _LOG_RANGE
        elif one.fit == "delay":
            log -= math.log(LONGEST_DELAY)
    if len(free):
        size = np.sqrt(np.maximum(np.diag(information), 1e-9))
        _, determinant = np.linalg.slogdet(information / np.outer(size, size) + 1e-9 * np.eye(len(free)))
        log -= 0.5 * (float(determinant) + 2.0 * float(np.log(size).sum())) - 0.5 * len(free) * math.log(2.0 * math.pi)
    return log


def _measures(axis: str, config: FusionConfig) -> dict[Quantity, Callable[[FusionConfig], float]]:
    """How each quantity is computed from a configuration; those that can only be positive as logarithms."""
    arm = config.arm.axes[axis]
    found: dict[Quantity, Callable[[FusionConfig], float]] = {
        "lag": lambda at: at.arm.lag_of(axis),
        "delay": lambda at: at.arm.delay_of(axis),
        "gain": lambda at: at.arm.axes[axis].gain.intercept,
    }
    for name in ("time_constant", "natural_frequency", "damping"):
        if hasattr(arm.plant, name):
            found[name] = lambda at, name=name: math.log(getattr(at.arm.axes[axis].plant, name))
    if arm.gain_recovery is not None:
        found["gain_recovery"] = lambda at: math.log(at.arm.axes[axis].gain_recovery or 1.0)
    return found


# ---- axes together --------------------------------------------------------------------------------------------------


def sharing(posteriors: Mapping[str, AxisPosterior]) -> list[str]:
    """The axes that share one delay: all but those whose measurements are likelier with one of their own.

    The delays of axes that do not share one are taken to lie within some 50 ms of each other.
    """
    if len(posteriors) < 2:
        return []
    grid = _grid(posteriors.values())
    width = np.gradient(grid)
    logs = {axis: one.log_density(grid) for axis, one in posteriors.items()}

    def evidence(log: FloatArray) -> float:
        top = float(log.max())
        return top + math.log(float(np.exp(log - top) @ width)) if np.isfinite(top) else -np.inf

    alone = {axis: evidence(log) for axis, log in logs.items()}

    def gain(axes: Sequence[str]) -> float:
        """How much likelier one delay for these axes is than one each."""
        price = (len(axes) - 1) * math.log(_OWN_WIDTH)
        return evidence(np.sum([logs[axis] for axis in axes], axis=0)) - sum(alone[axis] for axis in axes) + price

    shares: list[str] = list(posteriors)
    while len(shares) > 1:
        fewer: list[list[str]] = [[axis for axis in shares if axis != one] for one in shares]
        best = max(fewer, key=lambda axes: gain(axes) if len(axes) > 1 else 0.0)
        if gain(shares) >= (gain(best) if len(best) > 1 else 0.0):
            return shares
        shares = best
    return []


def shared_delay(posteriors: Sequence[AxisPosterior]) -> float:
    """The delay of axes that share one [s]: the median of what they say together."""
    grid = _grid(posteriors)
    log: FloatArray = np.sum([one.log_density(grid) for one in posteriors], axis=0)
    weight: FloatArray = np.exp(log - log.max()) * np.asarray(np.gradient(grid), dtype=np.float64)
    below: FloatArray = np.cumsum(weight) - 0.5 * weight
    return float(np.interp(0.5 * float(weight.sum()), below, grid))


def _grid(posteriors: Iterable[AxisPosterior]) -> FloatArray:
    """Delays that resolve the densities of all axes [s], ascending."""
    known = np.unique(np.concatenate([branch.delays for one in posteriors for branch in one.branches]))
    if len(known) < 2:
        return known[0] + _SHORTEST * np.arange(-1.0, 2.0)
    place = np.linspace(0.0, len(known) - 1.0, _REFINED * (len(known) - 1) + 1)
    return np.interp(place, np.arange(len(known)), known)


def chosen_model(mixture: Mixture) -> Model:
    """The simplest of the models that are about as likely as the most likely one."""
    shares = [float(mixture.weight[mixture.model == number].sum()) for number in range(len(MODELS))]
    likely = [model for model, share in zip(MODELS, shares, strict=True) if share >= _AS_LIKELY * max(shares)]
    return min(likely, key=lambda model: model.size)


def fitted_with(
    likelihood: Likelihood, start: FusionConfig, posterior: AxisPosterior, model: Model, delay: float | None
) -> Point:
    """The most likely configuration of a model with this delay, or at its best.

    Args:
        likelihood: Of this axis alone.
        start: What the posterior was found from.
        posterior: The posterior.
        model: The model.
        delay: The delay [s]; None: the best.
    """
    search = _AxisSearch(likelihood, start, posterior.axis)
    entries = [one for branch in posterior.branches if branch.model == model for one in branch.entries]
    if delay is None:
        best = max(entries, key=lambda one: one.log_density).config
        free = search.everything(best, model)
        return past_bumps(likelihood, maximise(likelihood, best, free), free)
    near = min(entries, key=lambda one: abs(one.delay - delay)).config
    there = changed(near, ("arm", "axes", posterior.axis, "delay"), delay)
    return maximise(likelihood, there, [one for one in search.everything(there, model) if one.fit != "delay"])
