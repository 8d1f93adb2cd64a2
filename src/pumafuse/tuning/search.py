"""The search for the most likely configuration: arms from any motion, then their noise, then everything together.

The arm of each axis comes from :mod:`.arm_search`, which needs no guess, and with it what that arm leaves: without a
disturbance and with one of each kind. Each of these is maximised with all numbers free, under the gates; the one that
is worth its numbers is taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..filter.outcome import Outcome
from ..fusion.config import FusionConfig
from .arm_search import SMOOTHER, WANDERS, ArmSearch, Freedom, chosen_arms
from .arms import BENDS, Arm
from .identifiability import covariance
from .likelihood import Likelihood, Point, in_threads
from .maximise import Notify, derivatives, maximise, maximise_by_axis, maximise_with_gates, point
from .parameters import (
    LATENCIES,
    Parameter,
    adapting,
    changed,
    quickest,
    rings,
    set_arm,
    set_axis_of,
    set_disturbance,
    set_gates,
    set_noise,
    set_shared_delay,
)
from .posterior import GAINS, GainKind, Mixture, Model

_ROUGHLY = 0.1  # tolerance in log-likelihood where maxima are only compared
_STEP = 0.010  # s, between latencies that are tried: their maxima are as wide
_WELL_KNOWN = 1.0 / 8.0  # of a logarithm: without it some ½ · 8² would be lost in log-likelihood
_NARROWER, _WIDER = 0.6, 3.0  # times the gates
_NARROWEST = 3.0  # gate: below it rejecting good measurements pays
_SLOW = 2.0  # s, of a disturbance that is large at first
_BELIEVED = math.log(20.0)  # odds that it adapts: bars of loaded servos and a trunk hold better so in another motion
_QUIET = 0.03  # share of what the rest is, that other noise begins with
_CALM, _KINDS = "none", {"matern": "smooth (Matérn)", "ou": "rough (Ornstein-Uhlenbeck)"}  # of disturbances
_HANDICAPS = {_CALM: WANDERS, _KINDS["matern"]: SMOOTHER, _KINDS["ou"]: 0.0}  # log-likelihood
_WALKING = ("input_noise", "drift", "maneuver_noise", "maneuver_drift")  # noise without a disturbance
_NAMES = {  # of an arm's coordinates, by the fields that they are in a configuration
    "delay": "delay",
    "time_constant": "lag",
    "natural_frequency": "lag",
    "damping": "damping",
    "intercept": "gain",
    "gain_recovery": "recovery",
    "play": "play",
    "max_speed": "max_speed",
    "slope_beyond": "sag",
}

FreeOf: TypeAlias = Callable[[FusionConfig], list[Parameter]]


class Search:
    """The search for the most likely configuration of a likelihood with some free parameters."""

    def __init__(self, likelihood: Likelihood, free: FreeOf, arms: Mapping[str, ArmSearch], notify: Notify) -> None:
        """A search from ``arms`` that were looked for; what is ``free`` depends on the order of the plants."""
        self.likelihood, self.free, self.arms, self.notify = likelihood, free, arms, notify
        # for the order of the plant of an axis, its gain, its disturbance and whether it shares a delay
        self.reasons: dict[str, list[str]] = {axis: [] for axis in likelihood.sensors}
        self.adapts: list[str] = []  # axes whose noise is to adapt, once all else is fitted

    def best(self, config: FusionConfig, one_delay: bool) -> tuple[Point, dict[str, str]]:
        """The best point from a configuration as given, and the reasons by axis.

        With ``one_delay`` all axes whose delay is free share one whatever the measurements say.
        """
        config = self._set_arms(config, one_delay)
        for parameter in self.free(config):
            if parameter.fit == "latency":
                config = self._nearest_latency(config, parameter)
        points = list[Point]()
        for start in self._noise_models(config):
            if points:  # an arm that is likeliest under one noise is near that under another
                start = self._set_arm_of(start, points[0].config)
            points.append(self._set_delay(self._maximum(start)))
        likeliest = self._likeliest(points)
        smooth = self._smoothly_disturbed(likeliest)
        if self._likeliest([*points, *smooth]) != likeliest:
            points += smooth
        best = self._drop_needless(self._from_wider_gates(self._likeliest(points, explains=True)))
        likeliest = set_gates(best, config)
        peak = maximise_with_gates(self.likelihood, likeliest, self.free(likeliest), self.notify)
        self._adapt(peak)
        for axis, why in self.reasons.items():
            if rings(peak.config, axis):
                why.append("its plant rings: what holds the tool off is a disturbance, not noise that shakes the plant")
        return peak, {axis: "; ".join(why) for axis, why in self.reasons.items() if why}

    # ---- arms and latencies -----------------------------------------------------------------------------------------

    def _set_arms(self, config: FusionConfig, one_delay: bool) -> FusionConfig:
        """The configuration with the likeliest arm of each axis; one delay for those that share it."""
        searched = {axis: search for axis, search in self.arms.items() if search.freedom.free}
        delayed = [axis for axis, search in searched.items() if "delay" in search.freedom.free]
        choices, delay = chosen_arms(searched, delayed, one_delay)
        for axis, choice in choices.items():
            config, why = set_arm(config, axis, choice.arm), self.reasons[axis]
            why += _why(searched[axis].freedom, choice.mixture, choice.model)
            if (bent := searched[axis].bent) is not None:
                why += bent.sentences(msgspec.structs.replace(bent.arm.model, kind=config.arm.axes[axis].kind))
            if len(delayed) > 1 and axis in delayed:
                gain = "" if choice.worth is None else f" (own {choice.worth:+.1f})"
                why.append(f"delay: {'shared' if choice.shares else 'its own'}{gain}")
        shares = [axis for axis, choice in choices.items() if choice.shares]
        return config if delay is None else set_shared_delay(config, shares, delay)

    def _nearest_latency(self, config: FusionConfig, latency: Parameter) -> FusionConfig:
        """The configuration with the likeliest latency of a sensor on a grid."""
        middle, steps = latency.number(config), round((LATENCIES[1] - LATENCIES[0]) / _STEP)
        shifts: list[float] = np.linspace(*LATENCIES, 1 + steps).tolist()
        tried = [latency.set(config, latency.clipped(middle + shift)) for shift in shifts]
        points = (point(self.likelihood, at, self.free(at)) for at in tried)
        return max(points, key=lambda peak: peak.log_posterior).config

    def _set_arm_of(self, config: FusionConfig, other: FusionConfig) -> FusionConfig:
        """The configuration with the arm of another, and with its numbers that all axes share."""
        config = msgspec.structs.replace(config, arm=other.arm)
        for parameter in self.free(other):
            if parameter.axis is None:
                config = parameter.set(config, parameter.number(other))
        return config

    # ---- noise ------------------------------------------------------------------------------------------------------

    def _noise_models(self, config: FusionConfig) -> list[FusionConfig]:
        """With what the arms leave: without a disturbance, and where one may be fitted with either kind.

        Noise that is not free stays as it is.
        """
        models = list[FusionConfig]()
        for number in range(3):
            model = config
            for axis, search in self.arms.items():
                model = set_noise(model, axis, search.noise_models[number], search.sensors)
            models.append(self._set_free_noise(config, model))
        distinct = [model for number, model in enumerate(models) if model not in models[:number]]
        return [self._set_quiet(model) for model in distinct]

    def _smoothly_disturbed(self, config: FusionConfig) -> list[Point]:
        """The maximum with a smooth disturbance of axes that have none, from all that the arm leaves.

        From little of it, beside noise that is not the best yet, it vanishes.
        """
        calm = [axis for axis in self.may_be_disturbed(config) if config.process[axis].disturbance_sd == 0.0]
        model = config
        for axis in calm:
            model = set_disturbance(model, axis, self.arms[axis].spread, _SLOW)
        return [self._maximum(model, axes=calm)] if calm else []

    def _set_free_noise(self, config: FusionConfig, model: FusionConfig) -> FusionConfig:
        """The configuration with the noises of a model that are free."""
        for axis in self.may_be_disturbed(config):
            new = model.process[axis]
            config = set_disturbance(config, axis, new.disturbance_sd, new.disturbance_time, new.disturbance_kind)
        for parameter in self.free(config):
            if parameter.fit == "noise" and (parameter.sensor or parameter.path[-1] in _WALKING):
                none = parameter.vanishes and parameter.at_bound(model) == "lower"
                config = parameter.set(config, 0.0 if none else parameter.clipped(parameter.number(model)))
        return config

    def may_be_disturbed(self, config: FusionConfig) -> list[str]:
        """The axes of which a disturbance is free."""
        for axis in self.likelihood.sensors:
            config = set_disturbance(config, axis, 1.0, 1.0)
        return [str(parameter.axis) for parameter in self.free(config) if parameter.path[-1] == "disturbance_sd"]

    def _set_quiet(self, config: FusionConfig) -> FusionConfig:
        """The configuration with a little of each free noise that is none in it, from which it can grow."""
        for parameter in self.free(config):
            if (
                parameter.fit == "noise"
                and parameter.vanishes
                and parameter.axis in self.arms
                and parameter.number(config) <= 30 * parameter.bounds[0]
            ):
                share = _QUIET * (10.0 if parameter.path[-1].startswith("maneuver") else 1.0)
                little = max(share * self.arms[str(parameter.axis)].spread, 30.0 * parameter.bounds[0])
                config = parameter.set(config, parameter.clipped(little))
        return config

    # ---- maxima -----------------------------------------------------------------------------------------------------

    def _maximum(self, config: FusionConfig, times: float | None = None, axes: Sequence[str] | None = None) -> Point:
        """The maximum next to a configuration, each component being rejected for itself, by way of wider gates.

        Gates make the likelihood jump: outliers that narrow gates reject are explained by noise where gates are wide.
        By default gates are narrower first. Only the numbers of some ``axes`` are free, if they are given.
        """

        def free(at: FusionConfig) -> list[Parameter]:
            return [parameter for parameter in self.free(at) if axes is None or parameter.axis in axes]

        gated, at = any(sensor.gate > 0.0 for sensor in config.sensors.values()), config
        for wider in (times or _narrower(config), 1.0) if gated else (1.0,):
            at = set_gates(at, config, wider)
            if shared := [parameter for parameter in free(at) if parameter.axis is None]:
                at = maximise(self.likelihood, at, shared, self.notify, tolerance=_ROUGHLY).config
            of_axes = [parameter for parameter in free(at) if parameter.axis is not None]
            at = maximise_by_axis(self.likelihood, at, of_axes, self.notify, _ROUGHLY).config
        if any(parameter.axis is None and parameter.sensor is not None for parameter in free(at)):
            at = maximise(self.likelihood, at, free(at), self.notify, tolerance=_ROUGHLY).config  # trades with noise
        return point(self.likelihood, at, self._of_axes(at))

    def _set_delay(self, peak: Point) -> Point:
        """The higher of a maximum without a delay and of what the same lag with a third of it as delay leads to.

        Delay and plant are a ridge with several tops. Its end is one, and last digits decided whether a search left it.
        """
        config, free = peak.config, self.free(peak.config)
        shaped = {parameter.axis for parameter in free if parameter.fit == "plant"}
        for parameter in free:
            if parameter.fit == "delay" and parameter.at_bound(config) == "lower":
                axes = self.likelihood.axes if parameter.axis is None else [parameter.axis]
                plants = {axis: Arm.of(config.arm.axes[axis], 0.0) for axis in axes}
                delay = min(arm.lag for arm in plants.values()) / 3.0
                config = parameter.set(config, delay)
                for axis, arm in plants.items():
                    if axis in shaped:
                        plant = arm._replace(lag=arm.lag - delay).model.plant
                        config = changed(config, ("arm", "axes", axis, "plant"), plant)
        if config == peak.config:
            return peak
        other = self._maximum(config)
        best = _best_by_axis(self.likelihood, [peak, other], [peak.posteriors, other.posteriors])
        return point(self.likelihood, best, self._of_axes(best))

    def _from_wider_gates(self, config: FusionConfig) -> FusionConfig:
        """The higher maximum of each axis, this one or that reached by way of wider gates, where any are rejected."""
        best = point(self.likelihood, config, self._of_axes(config))
        if not any((outcomes == int(Outcome.REJECTED)).any() for outcomes in best.outcomes):
            return config
        peaks = [best, self._maximum(config, _WIDER)]
        return _best_by_axis(self.likelihood, peaks, [peak.posteriors for peak in peaks])

    def _of_axes(self, config: FusionConfig) -> list[Parameter]:
        """The free parameters that belong to an axis."""
        return [parameter for parameter in self.free(config) if parameter.axis is not None]

    # ---- which noise pays -------------------------------------------------------------------------------------------

    def _likeliest(self, peaks: Sequence[Point], explains: bool = False) -> FusionConfig:
        """The model of noise that is best for each axis after the penalty for its numbers; the reasons get why."""
        scores = [_penalised(self.likelihood, peak, self.free(peak.config)) for peak in peaks]
        for number, axis in enumerate(self.likelihood.axes):
            best_of_kind: dict[str, float] = {}
            for peak, score in zip(peaks, scores, strict=True):
                kind = _kind(peak.config, axis)
                score[number] -= _HANDICAPS[kind]
                best_of_kind[kind] = max(float(score[number]), best_of_kind.get(kind, -np.inf))
            if explains and len(best_of_kind) > 1 and axis in self.reasons:
                best = max(best_of_kind, key=lambda kind: best_of_kind[kind])
                calm = best_of_kind.pop(_CALM, -np.inf)
                why = f"(one {max(best_of_kind.values()) - calm:+.1f})"
                if np.isinf(max(best_of_kind.values())):
                    soon = 1e3 * quickest(peaks[0].config)
                    why = f"(one would be forgotten within {soon:.0f} ms, too soon for an arm)"
                self.reasons[axis].append(f"disturbance: {best} {why}")
        return _best_by_axis(self.likelihood, peaks, scores)

    def _drop_needless(self, config: FusionConfig) -> FusionConfig:
        """The configuration without the noises that are not worth their penalty, one kind after the other.

        Beside a disturbance it is twice as high: real arms jerk, and any noise that is large at that moment gains
        likelihood without being true elsewhere. One that is known to an eighth of itself is needed, whatever it costs.
        """
        needed = _well_known(self.likelihood, config, self.free(config))
        for field in _WALKING:
            without = config
            for parameter in self.free(config):
                if parameter.path[-1] == field and parameter.key not in needed:
                    without = parameter.set(without, parameter.bounds[0])
            if without == config:
                continue
            peaks = [point(self.likelihood, config, self.free(config))]
            peaks.append(maximise_by_axis(self.likelihood, without, self._of_axes(without), self.notify, _ROUGHLY))
            scores = [_penalised(self.likelihood, peak, self.free(peak.config), of_noise=2.0) for peak in peaks]
            config = _best_by_axis(self.likelihood, peaks, scores)
        return config

    def _adapt(self, best: Point) -> None:
        """Note which axes are to get noise that grows where innovations show it: those whose likelihood allows it.

        A recording of one motion hardly tells; real arms are livelier in others. What is not livelier is as tuned.
        """
        with_adaptation, may = best.config, self.may_be_disturbed(best.config)
        for axis in may:
            with_adaptation = adapting(with_adaptation, axis)
        gains = point(self.likelihood, with_adaptation, self.free(with_adaptation)).posteriors - best.posteriors
        for axis, gain in zip(self.likelihood.axes, gains.tolist(), strict=True):
            if axis in may and gain > -_BELIEVED and best.config.process[axis].adaptation == 0.0:
                self.adapts.append(axis)
                self.reasons[axis].append(f"noise: adapts ({gain:+.1f})")


def arm_searches(likelihood: Likelihood, config: FusionConfig, free: FreeOf, believed: bool) -> dict[str, ArmSearch]:
    """The arm of each axis as far as it is free, and what it leaves, by sensors whose latency is known and steady.

    ``believed``: the sensors' noise, to be what second differences show.
    """
    late = {parameter.sensor for parameter in free(config) if parameter.fit == "latency"}
    late |= {name for name, sensor in config.sensors.items() if sensor.latency_sd}

    def of(axis: str) -> ArmSearch:
        names = [name for name in likelihood.sensors[axis] if name not in late] or list(likelihood.sensors[axis])
        least = [likelihood.resolution.get((name, axis), 0.0) for name in names]
        measured = likelihood.measured(axis, config, names)
        return ArmSearch(measured, _freedom(config, free, axis), least, believed)

    return dict(zip(likelihood.sensors, in_threads(of, list(likelihood.sensors)), strict=True))


def _freedom(config: FusionConfig, free: FreeOf, axis: str) -> Freedom:
    """What of an axis's arm the free parameters leave open."""
    arm = Arm.of(config.arm.axes[axis], config.arm.delay_of(axis))
    bends = {"play": 1e-3, "max_speed": 1.0, "beyond": -0.1}
    other = set_arm(config, axis, Arm(0.0, 0.1, 0.0 if arm.damping else 1.0, 0.1, **bends))
    here, elsewhere = (
        {parameter.path[-1] for parameter in free(at) if parameter.axis == axis} for at in (config, other)
    )
    if any(parameter.fit == "delay" for parameter in free(config) if parameter.axis in (None, axis)):
        here.add("delay")
    plants = {"natural_frequency", "damping"}, {"time_constant"}
    whole = any(plant <= here for plant in plants) and any(plant <= elsewhere for plant in plants)
    gains: Sequence[GainKind] = ("given",)
    if "intercept" in here and "gain_recovery" in elsewhere:
        here, gains, arm = here | {"gain_recovery"}, GAINS, arm._replace(gain=1.0, recovery=0.0, slope=0.0)
    elif "intercept" in here:
        gains = ("recovering" if arm.recovery else "static",)
    here |= plants[0] | (elsewhere & {*BENDS, "slope_beyond"}) if whole else here
    names = {_NAMES[field] for field in here if field in _NAMES}
    order = 2 if arm.damping else 1
    return Freedom(arm, names, (1, 2) if whole else (order,), gains)


def _why(freedom: Freedom, mixture: Mixture, model: Model) -> list[str]:
    """Which order and which kind of gain are likely, and by how much the alternative is behind in log-probability."""
    reasons = list[str]()
    if len(freedom.orders) > 1:
        ahead = mixture.log_odds(lambda model: model.order == 2)
        reasons.append(f"order: {'second' if model.order == 2 else 'first'} (second {ahead:+.1f})")
    if len(freedom.gains) > 1:
        ahead = mixture.log_odds(lambda model: model.gain == "recovering")
        reasons.append(f"gain: {'recovering' if model.gain == 'recovering' else 'constant'} (recovering {ahead:+.1f})")
    return reasons


def _narrower(config: FusionConfig) -> float:
    """The factor by which gates may be narrower without being too narrow."""
    gates = [sensor.gate for sensor in config.sensors.values() if sensor.gate > 0.0]
    return min(max(_NARROWER, _NARROWEST / min(gates, default=_NARROWEST)), 1.0)


def _kind(config: FusionConfig, axis: str) -> str:
    """What disturbance an axis has, in words."""
    process = config.process[axis]
    return _CALM if process.disturbance_sd == 0.0 else _KINDS[process.disturbance_kind]


def _well_known(likelihood: Likelihood, config: FusionConfig, free: Sequence[Parameter]) -> set[str]:
    """The keys of parameters whose logarithm has a small standard deviation by the information."""
    inside = [parameter for parameter in free if parameter.log and parameter.at_bound(config) is None]
    information = derivatives(likelihood, point(likelihood, config, inside), inside).information
    sd = np.sqrt(np.diag(covariance(information, inside)))
    return {parameter.key for parameter, sd_here in zip(inside, sd.tolist(), strict=True) if sd_here < _WELL_KNOWN}


def _penalised(likelihood: Likelihood, peak: Point, free: Sequence[Parameter], of_noise: float = 1.0) -> FloatArray:
    """The log-posterior of each axis less the Bayesian information criterion's penalty for its parameters, (A,).

    A noise at its lower bound is none, and costs nothing. ``of_noise``: how many times its penalty another one of the
    random walk costs beside a disturbance. A disturbance that is forgotten within two update periods is never worth it:
    it is no motion of an arm, but noise of its sensors.
    """
    price = np.zeros(len(likelihood.axes))
    for parameter in free:
        if parameter.axis is not None and not (parameter.vanishes and parameter.at_bound(peak.config) == "lower"):
            beside = parameter.path[-1] in _WALKING and peak.config.process[parameter.axis].disturbance_sd > 0.0
            price[likelihood.axes.index(parameter.axis)] += of_noise if beside else 1.0
            if parameter.path[-1] == "disturbance_time" and parameter.at_bound(peak.config) == "lower":
                price[likelihood.axes.index(parameter.axis)] = np.inf
    return peak.posteriors - 0.5 * price * np.log(np.maximum(likelihood.count, 2))


def _best_by_axis(likelihood: Likelihood, peaks: Sequence[Point], scores: Sequence[FloatArray]) -> FusionConfig:
    """The point that is best as a whole, with each axis from the point where that axis is best."""
    table = np.array(scores)
    best = peaks[int(np.argmax(table.sum(axis=1)))].config
    for axis, highest in zip(likelihood.axes, np.argmax(table, axis=0), strict=True):
        best = set_axis_of(best, peaks[int(highest)].config, axis)
    return best
