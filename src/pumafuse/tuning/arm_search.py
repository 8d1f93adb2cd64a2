"""The one search for an arm: from any motion, from no guess.

A grid over dead time and lag finds where the likelihood has its maxima: at first by plain least squares, then under the
noise that the best arm leaves. Each model is fitted from there, and followed along the dead time to both sides, with
Laplace's approximation for its other numbers.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from ..arrays import BoolArray, FloatArray
from .arms import (
    BENDS,
    SAG,
    Arm,
    Coordinates,
    Fit,
    Limits,
    Measured,
    NoiseModel,
    covariance,
    longest_delay,
    noise_models,
)
from .bends import Bent, bent_arm
from .parameters import QUICKEST, RECOVERY, RECOVERY_PRIOR
from .plain import COMMANDS, LAGS, ROWS, delays, plain_arm
from .posterior import (
    GAINS,
    SHORTEST,
    AxisPosterior,
    Branch,
    Entry,
    GainKind,
    Mixture,
    Model,
    Quantity,
    chosen_model,
    shared_delay,
    sharing,
)

BOUNDS = {"lag": (5e-4, 4.0), "damping": (0.2, 8.0), "recovery": RECOVERY, "gain": (0.3, 3.0), **BENDS}
_USUAL_GAIN, _BEYOND = (0.7, 1.3), 1.25  # where it may be; where least squares find another, so many times that
# A gain is 1 within a tenth. What is sold as an axis neither rings for ever nor has two lags far apart.
PRIORS = {"gain": (1.0, 0.1), "damping": (0.0, 0.7), "recovery": RECOVERY_PRIOR}
_LOG_RANGE = math.log(2e3)  # of a plant's lag, 1 ms to 2 s, each share of which is as likely; so of play and speed
_STARTS = 3  # maxima of the grid from which an arm is fitted
_NEARLY = 40.0  # log-likelihood that a better noise may gain
_NEAR = 20.0  # log-likelihood behind the best, up to which a maximum of the grid is looked at
_GATED = 2  # times: outliers widen the noise by which they are told
GATE = 6.0  # standard deviations, from which a measurement does not count
_EARLIER, _DAMPED = (0.0, 0.3, 0.6), (0.6, 1.0, 1.6)  # starts: shares of the lag that are no dead time, ζ
_ERRORS, _RECOVERING = (-0.12, -0.05, 0.05), (0.05, 0.12, 0.3)  # starts: gains less 1, recoveries [s]
WANDERS = 2.3  # log-likelihood that a random walk alone must gain: one to ten, as most real arms come back
SMOOTHER = 3.0  # log-likelihood that a smooth disturbance must gain: the error bars of a rough one hold for either
_DOUBT = 20.0  # log-likelihood that a recovery at a bound must gain: mostly another model says the same
_FORLORN = 8.0  # log-likelihood behind the best, from which a model or a dead time counts for nothing
# Update periods, by which a dead time may be on a wrong bump of the likelihood
_TICKS = (-1.0, -0.5, -0.25, 0.25, 0.5, 1.0)
_SAME = 2e-4  # s, between dead times of maxima that are one
_STEP = 0.7  # standard deviations, between dead times
_LONGEST_STEP = 0.03  # s
_IN_PERIOD, _SHORT_STEP = 16, 2e-3  # dead times in a period, where one instant of each is seen; s, at the least
_MOST, _MOST_SHORT = 20, 40  # steps away from a maximum
_SLOWLY, _LONGER = 0.5, 1.5  # log-likelihood that a step loses: with less the next one is so many times as long
_PIECES = 20  # of all recordings, that a model which is right has independent scores in
_ENOUGH = 20_000  # commands or measurements of a recording that an arm is known by: more make none better
_SLOPE = 1e-5  # of a coordinate, by which quantities are varied
_RARE = 1e-4  # probability of an arm, from which it counts
_NONE = Fit(Arm(0.0, 1.0), -math.inf, np.zeros((0, 0)), np.zeros(0))  # is worse than any


class Freedom(NamedTuple):
    """What of an arm is to be found; the rest stays as given."""

    arm: Arm  # as it is configured
    # the coordinates that may vary
    free: Collection[str] = ("delay", "lag", "damping", "recovery", "gain", *BENDS, "sag")
    orders: Sequence[int] = (1, 2)  # the orders of the plant to try
    gains: Sequence[GainKind] = GAINS  # the kinds of gain to try

    @property
    def models(self) -> list[Model]:
        """The models to try, the simplest first."""
        return sorted((Model(*pair) for pair in product(self.orders, self.gains)), key=lambda model: model.size)

    @property
    def bends(self) -> list[str]:
        """What of play and a fastest speed the arm has."""
        return [kind for kind in BENDS if getattr(self.arm, kind)]

    def names(self, model: Model) -> list[str]:
        """The coordinates of a model that are free, the dead time first."""
        names = ["delay", "lag"] if model.order == 1 else ["delay", "lag", "damping"]
        names += {"given": [], "static": ["gain"], "recovering": ["gain", "recovery"]}[model.gain]
        names += self.bends
        return [name for name in names if name in self.free]

    def bent(self, bent: Bent | None) -> Freedom:
        """With the play, fastest speed and sag that were found; without any, those that are given stay."""
        if bent is None:
            return self
        bends = {name: getattr(bent.arm, name) for name in (*BENDS, *SAG)}
        return self._replace(arm=self.arm._replace(**bends))

    def shaped(self, arm: Arm, gain: GainKind) -> Arm:
        """An arm with the kind of gain; one as it is given keeps what is configured of it."""
        if gain == "given":
            return arm._replace(gain=self.arm.gain, recovery=self.arm.recovery, slope=self.arm.slope)
        return arm._replace(recovery=0.0, slope=0.0) if gain == "static" else arm._replace(slope=self.arm.slope)


class LagSds(NamedTuple):
    """Standard deviations of a lag that was measured in step with the commands, at one instant of each period."""

    seen: float  # at the measurements [s], which the next ones correct
    unseen: float  # at the commands, what is more than that [s]: no measurement tells
    apart: float  # so far apart are likely arms there, unseen [m]


class ArmSearch:
    """The arms of an axis: maxima of each model, and the walk from one along the dead time."""

    noise_models: Sequence[NoiseModel]  # of what the best arm leaves: without a disturbance, a smooth, a rough one

    def __init__(self, measured: Measured, freedom: Freedom, least: Sequence[float], believed: bool = False) -> None:
        """``least``: noise of each sensor [m]; ``believed``: to be what second differences show."""
        self._measured, self.sensors = measured.liveliest(_ENOUGH), measured.sensors
        self._longest = longest_delay(measured.period)
        self.phase = measured.phase  # of each update period, where it is seen at one instant of each; else None
        self.plain = plain_arm(measured)
        self.noise = NoiseModel(np.ones(len(measured.sensors)))  # at first: least squares
        is_free = {"delay", "lag"} <= set(freedom.free)
        # their arm with what it has of play, a fastest speed and a sag
        self.bent = bent_arm(self.plain, freedom.arm, [*freedom.free]) if self.plain and is_free else None
        self.freedom = freedom.bent(self.bent)
        self.limits = Limits({"delay": (0.0, self._longest), **BOUNDS}, PRIORS)
        self._fits = self._by_least_squares()
        still = {model: fit for model, fit in self._fits.items() if model.gain == "static"}
        gain = self._best(still).arm.gain if still else 1.0
        low, high = _USUAL_GAIN
        gains = min(low, gain / _BEYOND), max(high, gain * _BEYOND)
        self.limits = self.limits._replace(bounds={**self.limits.bounds, "gain": gains})
        peaks, branches = self._peaks(least, believed), list[Branch]()
        for evidence, model, peak in peaks:
            walked = (branch for branch in branches if branch.model == model)
            if evidence > peaks[0][0] - _FORLORN and not any(
                branch.delays[0] <= peak.arm.delay <= branch.delays[-1] for branch in walked
            ):
                highest = max((float(branch.log_density.max()) for branch in branches), default=-np.inf)
                branches.append(self._walk(model, peak, highest - _FORLORN))
        self.posterior = AxisPosterior(branches)  # of all models that count, along their dead times

    @property
    def likely_noise(self) -> dict[str, float]:
        """The white noise that each sensor is believed to have [m]."""
        jitter = self._measured.jitter(self._best(self._fits).arm)
        return dict(zip(self.sensors, jitter.tolist(), strict=True))

    @property
    def spread(self) -> float:
        """How far the measurements are from the best arm, as a standard deviation [m]."""
        return float(self._measured.white(self._best(self._fits).arm).sd[0])

    @property
    def lag_ci95(self) -> tuple[float, float]:
        """The middle 95 % of its lag under all models [s].

        An arm in step is seen at one instant of each step, and the likelihood may be flat from one dead time to another
        and end there all at once: its curvature at a maximum knows nothing of that.
        """
        low, high = self.posterior.mixture().quantiles("lag", lambda _: True)
        return low, high

    @property
    def in_step(self) -> bool:
        """Whether it is seen at one instant of each update period."""
        return self.phase is not None

    def lag_sds(self, arm: Arm, mixture: Mixture) -> LagSds | None:
        """How well the lag of an arm is known, by all arms of a mixture; None where measurements are not in step."""
        commands, later = (self._measured.at_commands(by) for by in (0.0, self._measured.period))
        way = np.concatenate(later.responses(arm)) - np.concatenate(commands.responses(arm))
        if not self.in_step or not way.any():
            return None
        every = self.posterior.arms(mixture)
        likely, shares = zip(*((arm, share) for arm, share in every if share > _RARE), strict=True)

        def variance(at: Measured) -> float:
            moved = np.hstack(at.responses_of([arm, *likely]))
            return float(shares @ np.mean((moved[1:] - moved[0]) ** 2, axis=1))

        seen = variance(self._measured)
        apart, period = math.sqrt(max(variance(commands) - seen, 0.0)), self._measured.period
        speed = float(np.sqrt(np.mean(way**2))) / period
        return LagSds(math.sqrt(seen) / speed, apart / speed, apart)

    def arm(self, model: Model, delay: float | None = None) -> Arm:
        """The most likely arm of a model; the one with this dead time [s]."""
        entries = [entry for branch in self.posterior.branches if branch.model == model for entry in branch.entries]
        if delay is None:
            return max(entries, key=lambda entry: entry.log_density).arm
        near = min(entries, key=lambda entry: abs(entry.arm.delay - delay)).arm._replace(delay=delay)
        names = [name for name in self.freedom.names(model) if name != "delay"]
        return self._measured.fitted(near, names, self.noise, self.limits).arm

    def lag_scatter(self, model: Model, arm: Arm) -> float:
        """How much more the lag scatters over pieces of the runs than the information says, 1 or more (White, 1982)."""
        names = self.freedom.names(model)
        variances = self._measured.variances(arm, names, self.noise, self.limits, _PIECES, lambda arm: arm.total)
        return max(1.0, math.sqrt(variances[1] / variances[0])) if variances[0] > 0.0 else 1.0

    # ---- maxima -----------------------------------------------------------------------------------------------------

    def _by_least_squares(self) -> dict[Model, Fit]:
        """Each model, from the grid: noise that is fitted to a poor arm explains what a better one would."""
        whole, self._measured = self._measured, self._measured.excerpt(COMMANDS, ROWS)
        self.noise = self._measured.white(self._on_grid(1)[0])
        fits = self._fitted(self._on_grid(_STARTS))
        self.noise = self._measured.white(self._best(fits).arm)
        fits = self._fitted([self._best(fits).arm], fits)
        self._measured = whole
        return fits

    def _likely(self, fits: Mapping[Model, Fit]) -> dict[Model, Fit]:
        """The models that a better noise could still bring near the best."""
        evidence = {model: self._evidence(model, fit) for model, fit in fits.items()}
        least = max(evidence.values()) - _NEARLY
        return {model: fit for model, fit in fits.items() if evidence[model] > least}

    def _peaks(self, least: Sequence[float], believed: bool) -> list[tuple[float, Model, Fit]]:
        """The maxima of every model with their evidence, the best first; those an update period away, too."""
        for _ in range(_GATED):
            self.noise = self._likely_noise(self._best(self._fits).arm, least, believed)
            self._measured = self._measured.gated(self._best(self._fits).arm, self.noise, GATE)
        self._fits = self._likely(self._fitted([self._best(self._fits).arm, *self._on_grid(1)], self._fits))
        self.noise = self._likely_noise(self._best(self._fits).arm, least, believed)
        self._fits = self._likely(self._fitted([self._best(self._fits).arm], self._fits))
        every = [(self._evidence(model, fit), model, fit) for model, fit in self._fits.items()]
        highest = max(peak[0] for peak in every)
        for evidence, model, fit in list(every) if "delay" in self.freedom.free else ():
            for ticks in (-1.0, 1.0) if evidence > highest - _FORLORN else ():
                shifted = self._delayed(fit.arm, fit.arm.delay + ticks * self._measured.period)
                beside = self._fit(model, shifted, fit.log_posterior - 2.0 * _FORLORN)
                delays = [peak.arm.delay for _, other, peak in every if other == model]
                if min(abs(beside.arm.delay - delay) for delay in delays) > _SAME:
                    every.append((self._evidence(model, beside), model, beside))
        return sorted(every, key=lambda peak: -peak[0])

    def _on_grid(self, count: int) -> list[Arm]:
        """The arms of highest likelihood on a grid of first-order plants, no two of them neighbours."""
        start, free = self.freedom.arm, self.freedom
        late = delays(self._measured) if "delay" in free.free else np.array([start.delay])
        lags = LAGS if "lag" in free.free else np.array([start.lag])
        damping = 0.0 if 1 in free.orders else start.damping
        arms = [start._replace(delay=d, lag=lag, damping=damping) for lag, d in product(lags.tolist(), late.tolist())]
        varied = "gain" in free.free
        if varied:
            arms = [free.shaped(arm, "static") for arm in arms]
        log, gain = self._measured.weighed(arms, self.noise, self.limits if varied else None)
        table = log.reshape(len(lags), len(late))
        around = np.pad(table, 1, constant_values=-np.inf)
        highest = np.max([np.roll(around, shift, (0, 1)) for shift in product((-1, 0, 1), repeat=2)], axis=0)[
            1:-1, 1:-1
        ]
        summits = [int(cell) for cell in np.flatnonzero(table >= highest) if log[cell] > log.max() - _NEAR]
        summits.sort(key=lambda cell: -log[cell])
        return [arms[cell]._replace(gain=float(gain[cell])) for cell in summits[:count]]

    def _likely_noise(self, arm: Arm, least: Sequence[float], believed: bool) -> NoiseModel:
        """The most likely of what an arm leaves, after the penalty for its numbers."""
        likely = list(noise_models(self._measured, arm, QUICKEST * self._measured.period, least, believed))
        self.noise_models = [model for model, _ in likely]
        dearer = math.log(max(self._measured.count, 2))  # of two numbers more (BIC)
        prices = [WANDERS, dearer + SMOOTHER, dearer]
        return max(zip(likely, prices, strict=True), key=lambda priced: priced[0][1] - priced[1])[0][0]

    def _fitted(self, starts: Sequence[Arm], earlier: Mapping[Model, Fit] | None = None) -> dict[Model, Fit]:
        """Each model fitted from the best of the starts, from the simpler models, and from where it was."""
        fits = dict[Model, Fit]()
        for model in earlier or self.freedom.models:
            arms = starts if not fits else [self._best(fits).arm]
            begun = [earlier[model].arm] if earlier else []
            fits[model] = self._highest(model, [*begun, *self._likeliest(model, arms, 1 if earlier else 2)])
        best = max(fits, key=lambda model: fits[model].log_posterior)
        ticks = _TICKS if "delay" in self.freedom.free else ()
        for later in (tick * self._measured.period for tick in ticks):
            arm = fits[best].arm
            fits[best] = self._highest(best, [self._delayed(arm, arm.delay + later)], fits[best])
        return fits

    def _likeliest(self, model: Model, arms: Iterable[Arm], count: int) -> list[Arm]:
        """The likeliest arms of a model that are as late as others."""
        tried = [shaped for arm in arms for shaped in self._shapes(model, arm)]
        if len(tried) <= count:
            return tried
        varied = "gain" in self.freedom.names(model)
        return self._measured.likeliest(tried, self.noise, self.limits if varied else None, count)

    def _shapes(self, model: Model, arm: Arm) -> Iterator[Arm]:
        """Arms of a model that are as late as another one."""
        order = 2 if arm.damping else 1
        kind = "recovering" if arm.recovery else "static"
        gains = [arm]
        if model.gain != "recovering" or kind == "recovering":
            gains = [self.freedom.shaped(arm, model.gain)]
        else:
            changes = product(_ERRORS, _RECOVERING)
            gains = [arm._replace(gain=1.0 + error, recovery=recovery) for error, recovery in changes]
        for shape in gains:
            shape = self._as_late(shape, arm.total)
            if model.order == order:
                yield shape
            elif model.order == 1:
                yield shape._replace(damping=0.0)
            else:
                for earlier, damping in product(_EARLIER, _DAMPED) if len(gains) == 1 else ((0.3, 1.0),):
                    yield self._delayed(shape, shape.delay - earlier * shape.delay)._replace(damping=damping)

    def _as_late(self, arm: Arm, total: float) -> Arm:
        """An arm whose plant makes up for what its gain changed of the lag."""
        low, high = BOUNDS["lag"]
        if "lag" not in self.freedom.free:
            return arm
        return arm._replace(lag=min(max(arm.lag + total - arm.total, 0.1 * arm.lag, low), high))

    def _delayed(self, arm: Arm, delay: float) -> Arm:
        """An arm with another dead time, and so much less or more lag of the plant, where these are free."""
        if "delay" not in self.freedom.free:
            return arm
        delay = min(max(delay, 0.0), self._longest)
        later = arm._replace(delay=delay)
        return self._as_late(later, arm.total)

    def _highest(self, model: Model, starts: Iterable[Arm], best: Fit = _NONE) -> Fit:
        """The highest of the maxima next to some arms, and of the best so far."""
        for start in starts:
            best = max(best, self._fit(model, start, best.log_posterior), key=lambda fit: fit.log_posterior)
        return best

    def _fit(self, model: Model, start: Arm, worth: float) -> Fit:
        names = self.freedom.names(model)
        return self._measured.fitted(start, names, self.noise, self.limits, worth)

    def _best(self, fits: Mapping[Model, Fit]) -> Fit:
        return max(fits.values(), key=lambda fit: fit.log_posterior)

    def _evidence(self, model: Model, fit: Fit) -> float:
        """The log-density of a maximum with the penalty for the model's numbers, roughly."""
        names = self.freedom.names(model)
        inside = self.limits.inside(fit.arm, names)
        doubt = _DOUBT if "recovery" in names and not inside[names.index("recovery")] else 0.0
        return self._laplace(fit, names, inside) - doubt

    def _laplace(self, fit: Fit, names: Coordinates, inside: BoolArray) -> float:
        """The log-density with the free numbers integrated out, each with its prior's constant."""
        log = fit.log_posterior
        free = [name for name, is_free in zip(names, inside, strict=True) if is_free]
        some = np.flatnonzero(inside)
        information = self._bounded(fit.information[np.ix_(some, some)], free)
        for name in free:
            log -= math.log(PRIORS[name][1] * math.sqrt(2.0 * math.pi) if name in PRIORS else self._width(name))
        if not np.isfinite(information).all():  # an arm that runs off
            return -math.inf
        if free:
            size = np.sqrt(np.maximum(np.diag(information), 1e-9))
            _, determinant = np.linalg.slogdet(information / np.outer(size, size) + 1e-9 * np.eye(len(free)))
            log -= 0.5 * (float(determinant) + 2.0 * float(np.log(size).sum()) - len(free) * math.log(2.0 * math.pi))
        return log

    def _width(self, name: str) -> float:
        """Of the range in which a coordinate without another prior is as likely everywhere."""
        return self._longest if name == "delay" else _LOG_RANGE

    def _bounded(self, information: FloatArray, names: Coordinates) -> FloatArray:
        """The information with that of the bounds: where the likelihood is flat, it ends there all the same."""
        return information + np.diag([0.0 if name in PRIORS else 12.0 / self._width(name) ** 2 for name in names])

    @property
    def _longest_step(self) -> float:
        """From one dead time to the next [s]; several in a period, where the likelihood may have plateaus in it."""
        several = max(self._measured.period / _IN_PERIOD, _SHORT_STEP)
        return min(several, _LONGEST_STEP) if self.in_step else _LONGEST_STEP

    # ---- the walk ---------------------------------------------------------------------------------------------------

    def _walk(self, model: Model, peak: Fit, least: float) -> Branch:
        """The entries of a model about a maximum, until they count for nothing or less than ``least``."""
        names = self.freedom.names(model)
        if "delay" not in self.freedom.free:
            return Branch(model, [self._entry(peak, names)])
        cov = covariance(peak.information)
        sd, slope = math.sqrt(cov[0, 0]), cov[1:, 0] / cov[0, 0]
        step = min(max(_STEP * sd, SHORTEST), self._longest_step)
        middle = self._at(peak.arm, names[1:])
        sides = [
            list(self._side(peak, names[1:], sign * step, slope, max(least, middle.log_density - _FORLORN)))
            for sign in (-1.0, 1.0)
        ]
        return Branch(model, [*reversed(sides[0]), middle, *sides[1]])

    def _side(self, peak: Fit, names: Coordinates, step: float, slope: FloatArray, least: float) -> Iterator[Entry]:
        low, high = self.limits.range(names)
        before, move, height = peak.arm, step * slope, -np.inf
        for _ in range(_MOST_SHORT if self.in_step else _MOST):
            delay = before.delay + step
            if not -abs(step) < delay <= self._longest:
                return
            at = np.array([before.coordinate(name) for name in names])
            start = before.moved(names, np.clip(at + move, low, high).tolist())._replace(delay=max(delay, 0.0))
            entry = self._at(start, names)
            yield entry
            least = max(least, entry.log_density - _FORLORN)
            if entry.log_density < least or delay <= 0.0:
                return
            before = entry.arm
            move = np.array([before.coordinate(name) for name in names]) - at
            if entry.log_density > height - _SLOWLY:  # the maximum was on a bump of a wide hill
                longer = min(_LONGER * abs(step), self._longest_step) / abs(step)
                step, move = longer * step, longer * move
            height = entry.log_density

    def _at(self, arm: Arm, names: Coordinates) -> Entry:
        """The entry of the best arm with the same dead time."""
        return self._entry(self._measured.fitted(arm, names, self.noise, self.limits), names)

    def _entry(self, fit: Fit, names: Coordinates) -> Entry:
        inside = self.limits.inside(fit.arm, names)
        free = [name for name, is_free in zip(names, inside, strict=True) if is_free]
        cov = covariance(self._bounded(fit.information[np.ix_(inside, inside)], free))
        means = _quantities(fit.arm)
        moved = [_quantities(fit.arm.moved([name], [fit.arm.coordinate(name) + _SLOPE])) for name in free]
        sds: dict[Quantity, float] = {}
        for quantity, mean in means.items():
            slope = np.array([(beside[quantity] - mean) / _SLOPE for beside in moved])
            sds[quantity] = math.sqrt(max(float(slope @ cov @ slope), 0.0)) if free else 0.0
        return Entry(fit.arm, self._laplace(fit, names, inside), means, sds)


class Chosen(NamedTuple):
    """The likeliest arm of an axis, beside those of the others."""

    arm: Arm  # the arm
    model: Model  # of which order and kind of gain it is
    mixture: Mixture  # all that the axis may be, with what others say of a dead time that it shares
    shares: bool  # whether it shares that
    worth: float | None  # log-likelihood that a dead time of its own gains it; None where that is not asked


def chosen_arms(
    searched: Mapping[str, ArmSearch], delayed: Collection[str], one_delay: bool = False
) -> tuple[dict[str, Chosen], float | None]:
    """The likeliest arm of each axis, and the dead time that some of them share [s]; None: they do not.

    That of ``delayed`` axes is free; with ``one_delay`` they share one whatever the measurements say.
    """
    posteriors = {axis: search.posterior for axis, search in searched.items() if axis in delayed}
    shares, worth = (list(posteriors), dict[str, float]()) if one_delay else sharing(posteriors)
    delay, chosen = shared_delay([posteriors[axis] for axis in shares]) if shares else None, dict[str, Chosen]()
    for axis, search in searched.items():
        is_shared, posterior = axis in shares, search.posterior
        others = [posteriors[other] for other in shares if is_shared and other != axis]
        model = chosen_model(posterior.mixture(others))
        likely = posterior.mixture(others, 1.0 / (1.0 + math.exp(worth[axis])) if is_shared and worth else 1.0)
        chosen[axis] = Chosen(
            search.arm(model, delay if is_shared else None), model, likely, is_shared, worth.get(axis)
        )
    return chosen, delay


def _quantities(arm: Arm) -> dict[Quantity, float]:
    """What is said of an arm; of what can only be positive the logarithm."""
    quantities: dict[Quantity, float] = {"lag": arm.total, "delay": arm.delay, "gain": arm.gain}
    if arm.damping:
        quantities |= {"natural_frequency": math.log(2.0 * arm.damping / arm.lag), "damping": math.log(arm.damping)}
    else:
        quantities["time_constant"] = math.log(arm.lag)
    if arm.recovery:
        quantities["gain_recovery"] = math.log(arm.recovery)
    return quantities | {bend: math.log(size) for bend in BENDS if (size := getattr(arm, bend))}
