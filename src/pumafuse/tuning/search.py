"""Global search for the most likely configuration: several starts, the nearest maximum of each, the best by axis.

Gates make the likelihood jump: from a poor start good measurements are rejected, from a generous one outliers are
explained by noise. So some starts have gates three times as wide, others the configuration's own; at first each
component is rejected for itself, whole rows are rejected only at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TypeAlias

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..fusion.config import FusionConfig, Process
from .identifiability import covariance
from .likelihood import Likelihood
from .maximise import (
    Notify,
    Point,
    derivatives,
    ignore,
    maximise,
    maximise_by_axis,
    maximise_with_gates,
    past_bumps,
    point,
)
from .parameters import (
    DELAYS,
    LATENCIES,
    Parameter,
    changed,
    quickest,
    with_axis_of,
    with_disturbance,
    with_gates,
    with_lag,
    with_order,
    with_recovery,
    with_shared_delay,
)

_ROUGHLY = 0.1  # tolerance in log-likelihood where maxima are only compared
_WIDER = 3.0
_GRID_STEP = 0.010  # s, between delays and latencies that are tried: their maxima are as wide
_LAGS = (1.0, 1.8)  # starts, times the configured; a delay can be taken for a lag and a lag for a delay
_SAME_DELAY = 1e-4  # s, by which delays differ that are tried as one for all axes
_NEARLY = 10.0  # log-likelihood that is lost where the one delay is not yet at its best
_LEAST_SHARE = 0.2  # of a lag that is left where a tick less of it is tried
_GAINS = ((0.0, 0.1), (0.0, 0.4), (0.3, 0.025))  # starts: gain above the configured one, and recovery [s]
_PROCESSES = tuple(  # starts, in units of the distance between the noiseless arm and the measurements
    {"input_noise": noise, "drift": drift, "maneuver_noise": 10.0 * noise, "maneuver_drift": 10.0 * drift}
    for noise, drift in ((0.1, 1.0), (0.01, 0.1), (1.0, 10.0), (0.01, 1.0), (1.0, 0.1))
)

_WANDERS = 2.3  # log-likelihood that a random walk alone must gain: one to ten, as most real arms come back
_SMOOTHER = 3.0  # log-likelihood that a smooth disturbance must gain: the error bars of a rough one hold for either
_WELL_KNOWN = 1.0 / 8.0  # of a logarithm: without it some ½ · 8² would be lost in log-likelihood
_TIMES = (1e-3, 1e3)  # s, of a disturbance: bounds far from the best
_TIME = 0.3  # s, of a disturbance: start
_QUIET = 0.1  # share of noise that is left beside a disturbance: start
_DISTURBANCES = ("none", "smooth (Matérn)", "rough (Ornstein-Uhlenbeck)")

FreeOf: TypeAlias = Callable[[FusionConfig], list[Parameter]]
Reasons: TypeAlias = dict[str, dict[str, str]]  # by axis, then by what was chosen


def search(
    likelihood: Likelihood,
    config: FusionConfig,
    free: FreeOf,
    notify: Notify,
    one_delay: bool = False,
    *,
    near: bool = False,
) -> tuple[Point, dict[str, str]]:
    """Find the most likely configuration.

    Args:
        likelihood: The likelihood.
        config: The configuration as given.
        free: The parameters to vary, which depend on the order of the plants.
        notify: Called with each better point.
        one_delay: Whether all axes whose delay is free share one whatever the measurements say.
        near: Whether the configuration is the most likely one of a part of the measurements: all models are compared
            again, but each is only looked for near it.

    Returns:
        The best point, and for each axis the reasons for the order of its plant, its gain, its disturbance and whether
        it shares the arm's delay.
    """

    def own(at: FusionConfig) -> list[Parameter]:
        return [one for one in free(at) if one.axis is not None]

    def rough(at: FusionConfig) -> list[Parameter]:
        """Without the bound of a disturbance's time, at which a search from afar would stick."""
        return [replace(one, bounds=_TIMES) if one.path[-1] == "disturbance_time" else one for one in own(at)]

    start = config if near else _times(likelihood, with_gates(config, config, _WIDER), free(config))
    found: list[Point] = []
    for model in noise_models(likelihood, start, rough, near):
        first = not (found or near)
        if found and not near:  # the arm of the first model is near that of the others
            model = _with_arm_of(model, found[0].config, free)
        best = with_gates(model, config, 1.0)
        if not near:
            best = best_noise(likelihood, best, rough(best), notify)
        shared = [one for one in free(best) if one.axis is None]
        if shared:
            best = maximise(likelihood, best, shared, notify, tolerance=_ROUGHLY).config
        if first:
            best, _ = _arm(likelihood, best, rough, notify)
        found.append(maximise_by_axis(likelihood, best, rough(best), notify, _ROUGHLY))
    best, disturbances = most_likely_models(likelihood, found, rough)
    best, arm = _arm(likelihood, best, own, notify, again=True)
    best = _without_needless(likelihood, best, own, notify)
    if len(found) > 1:  # near, too: a part of a run may not have told one tick from the next
        best = _past_ticks(likelihood, best, own, notify)
    best, delays = _with_one_delay(likelihood, best, free, one_delay)
    orders: Reasons = {}
    if any(one.axis is None and one.fit == "delay" for one in free(best)):
        best, orders = _orders(likelihood, best, own, notify)  # an own delay can look like a second order
    reasons: Reasons = {}
    for more in (arm, disturbances, delays, orders):
        for axis, why in more.items():
            reasons.setdefault(axis, {}).update(why)
    best = maximise_with_gates(likelihood, with_gates(best, config), free(best), notify)
    return best, {axis: "; ".join(why.values()) for axis, why in reasons.items() if why}


def noise_models(likelihood: Likelihood, config: FusionConfig, free: FreeOf, near: bool = False) -> list[FusionConfig]:
    """Without a disturbance, and where one may be fitted with one of each kind and little other noise.

    ``near``: each axis stays as it is in the model that it has already.
    """
    misfit, every = likelihood.misfit(config), config
    for axis in misfit:
        every = with_disturbance(every, axis, misfit[axis], _TIME)
    disturbed = [str(one.axis) for one in free(every) if one.path[-1] == "disturbance_sd"]
    models = [config]
    for axis in disturbed:
        known = config.process[axis]
        models[0] = with_disturbance(models[0], axis, 0.0, known.disturbance_time, known.disturbance_kind)
    for kind in ("matern", "ou") if disturbed else ():
        model = config
        for axis in disturbed:
            model = with_disturbance(model, axis, 0.5 * misfit[axis], config.process[axis].disturbance_time, kind)
        for one in free(model):
            if one.axis in disturbed and one.path[-1] in _PROCESSES[0]:
                model = one.put(model, _QUIET * _PROCESSES[0][one.path[-1]] * misfit[one.axis])
            elif one.axis in disturbed and one.path[-1] == "disturbance_time":
                model = one.put(model, _TIME)
        models.append(model)
    for axis in disturbed if near else ():
        known = config.process[axis]
        own = 0 if known.disturbance_sd == 0.0 else 1 if known.disturbance_kind == "matern" else 2
        models[own] = with_axis_of(models[own], config, axis)
    return models


def most_likely_models(likelihood: Likelihood, peaks: Sequence[Point], free: FreeOf) -> tuple[FusionConfig, Reasons]:
    """The model of noise that is best for each axis after the penalty for its numbers, and why."""
    scores = [_penalised(likelihood, peak, free(peak.config)) for peak in peaks]
    reasons: Reasons = {}
    for number, axis in enumerate(likelihood.axes):
        for peak, score in zip(peaks, scores, strict=True):
            process = peak.config.process[axis]
            if process.disturbance_sd == 0.0:
                score[number] -= _WANDERS
            elif process.disturbance_kind == "matern":
                score[number] -= _SMOOTHER
        mine = [float(score[number]) for score in scores]
        chosen = int(np.argmax(mine))
        if len(peaks) > 1 and axis in likelihood.sensors:
            gain = max(mine[1:]) - mine[0]
            why = f"(one {gain:+.1f})"
            if np.isinf(gain):
                soon = 1e3 * quickest(peaks[chosen].config)
                why = f"(one would be forgotten within {soon:.0f} ms, too soon for an arm)"
            reasons[axis] = {"disturbance": f"disturbance: {_DISTURBANCES[chosen]} {why}"}
    return _best_by_axis(likelihood, peaks, scores), reasons


def _without_needless(likelihood: Likelihood, config: FusionConfig, free: FreeOf, notify: Notify) -> FusionConfig:
    """The configuration without the noises that are not worth their penalty, one kind after the other.

    Beside a disturbance it is twice as high: real arms jerk, and any noise that is large at that moment gains
    likelihood without being true elsewhere. One that is known to an eighth of itself is needed, whatever it costs.
    """
    needed = _well_known(likelihood, config, free(config))
    for field in _PROCESSES[0]:
        without = config
        for one in free(config):
            if one.path[-1] == field and one.key not in needed:
                without = one.put(without, one.bounds[0])
        if without == config:
            continue
        peaks = [point(likelihood, config, free(config))]
        peaks.append(maximise_by_axis(likelihood, without, free(without), notify, _ROUGHLY))
        scores = [_penalised(likelihood, peak, free(peak.config), of_noise=2.0) for peak in peaks]
        config = _best_by_axis(likelihood, peaks, scores)
    return config


def _well_known(likelihood: Likelihood, config: FusionConfig, free: Sequence[Parameter]) -> set[str]:
    """The keys of parameters whose logarithm has a small standard deviation by the information."""
    inside = [one for one in free if one.log and one.at_bound(config) is None]
    information = derivatives(likelihood, point(likelihood, config, inside), inside).information
    sd = np.sqrt(np.diag(covariance(information, inside)))
    return {one.key for one, known in zip(inside, sd.tolist(), strict=True) if known < _WELL_KNOWN}


def _penalised_arms(likelihood: Likelihood, peaks: Sequence[Point], free: FreeOf) -> list[FloatArray]:
    """By the numbers of the arm alone: a noise that is next to none is not yet at its bound."""
    numbers = [[one for one in free(peak.config) if one.fit != "noise"] for peak in peaks]
    return [_penalised(likelihood, peak, some) for peak, some in zip(peaks, numbers, strict=True)]


def _penalised(likelihood: Likelihood, peak: Point, free: Sequence[Parameter], of_noise: float = 1.0) -> FloatArray:
    """The log-posterior of each axis less the Bayesian information criterion's penalty for its parameters, (A,).

    A noise at its lower bound is none, and costs nothing. ``of_noise``: how many times its penalty another one of the
    random walk costs beside a disturbance. A disturbance that is forgotten within two update periods is never worth it:
    it is no motion of an arm, but noise of its sensors.
    """
    used = [one for one in free if not (one.vanishes and one.at_bound(peak.config) == "lower")]
    price = np.zeros(len(likelihood.axes))
    for one in used:
        if one.axis is not None:
            beside = one.path[-1] in _PROCESSES[0] and peak.config.process[one.axis].disturbance_sd > 0.0
            price[likelihood.axes.index(one.axis)] += of_noise if beside else 1.0
            if one.path[-1] == "disturbance_time" and one.get(peak.config) < quickest(peak.config):
                price[likelihood.axes.index(one.axis)] = np.inf
    return peak.axes - 0.5 * price * np.log(np.maximum(likelihood.count, 2))


def _times(likelihood: Likelihood, config: FusionConfig, free: Sequence[Parameter]) -> FusionConfig:
    """Delays and latencies near their best: on a grid, the delays of all axes first, then sensor by sensor.

    Farther away the likelihood has other maxima, with noise in the place of a lag. So the grid is evaluated with
    several levels of noise, before any is fitted.
    """
    noise = [one for one in free if one.fit == "noise"]
    levels = [_with_noise(config, process, likelihood.scatter, noise) for process in _processes(likelihood, config)[:2]]

    def on_grid(times: Sequence[Parameter], span: tuple[float, float]) -> list[tuple[float, Point]]:
        shifts: list[float] = np.linspace(*span, 1 + round((span[1] - span[0]) / _GRID_STEP)).tolist()
        return [(shift, point(likelihood, _shifted(at, times, shift), free)) for shift in shifts for at in levels]

    delays = [one for one in free if one.fit == "delay"]
    if delays:
        tried = on_grid(delays, DELAYS)
        highest: list[int] = np.argmax([found.axes for _, found in tried], axis=0).tolist()
        for one in delays:
            shift, _ = tried[highest[likelihood.axes.index(str(one.axis))]]
            config, *levels = (_shifted(at, [one], shift) for at in (config, *levels))
    for one in free:
        if one.fit == "latency":
            shift, _ = max(on_grid([one], LATENCIES), key=lambda found: found[1].log_posterior)
            config, *levels = (_shifted(at, [one], shift) for at in (config, *levels))
    return config


def _shifted(config: FusionConfig, times: Sequence[Parameter], shift: float) -> FusionConfig:
    """The configuration with delays or latencies longer by ``shift`` [s], within their bounds."""
    for one in times:
        config = one.put(config, one.clipped(one.get(config) + shift))
    return config


def best_noise(likelihood: Likelihood, config: FusionConfig, free: Sequence[Parameter], notify: Notify) -> FusionConfig:
    """The best noise from the best of many starts, with wide gates and with the given ones, by axis."""
    noise = [one for one in free if one.fit == "noise"]
    if not noise:
        return config
    peaks: list[Point] = []
    gated = any(sensor.gate > 0.0 for sensor in config.sensors.values())
    for times in (_WIDER, 1.0) if gated else (1.0,):
        one_by_one = with_gates(config, config, times)
        starts = [
            point(likelihood, _with_noise(one_by_one, process, sds, noise), noise)
            for process in (one_by_one.process, *_processes(likelihood, one_by_one))
            for sds in ({}, likelihood.scatter)
        ]
        start = _best_by_axis(likelihood, starts)
        rough = maximise_by_axis(likelihood, start, noise, notify, _ROUGHLY).config
        peaks.append(maximise_by_axis(likelihood, with_gates(rough, config), noise, notify, _ROUGHLY))
    return _best_by_axis(likelihood, peaks)


def _processes(likelihood: Likelihood, config: FusionConfig) -> list[dict[str, Process]]:
    """Starts for each axis's process noise, in proportion to the misfit of the noiseless arm."""
    misfit = likelihood.misfit(config)
    return [
        {
            axis: msgspec.structs.replace(config.process[axis], **{key: value * metres for key, value in one.items()})
            for axis, metres in misfit.items()
        }
        for one in _PROCESSES
    ]


def _with_noise(
    config: FusionConfig,
    process: Mapping[str, Process],
    sds: Mapping[tuple[str, str], float],
    noise: Sequence[Parameter],
) -> FusionConfig:
    """A start: free noises from ``process`` (by axis) and ``sds`` (by sensor and axis), none near its lower bound."""
    full = msgspec.structs.replace(config, process={**config.process, **process})
    for one in noise:
        value = sds.get((one.sensor or "", one.axis or ""), one.get(full))
        config = one.put(config, max(value, 30.0 * one.bounds[0]))
    return config


def _arm(
    likelihood: Likelihood, config: FusionConfig, free: FreeOf, notify: Notify, *, again: bool = False
) -> tuple[FusionConfig, Reasons]:
    """The best arm and noise from several lags and recoveries, with both orders where the whole plant is free.

    Both kinds of gain are tried where a gain is free. ``again``: the configuration's arm is near the best.
    """

    def maxima(starts: Sequence[FusionConfig]) -> list[Point]:
        return [maximise_by_axis(likelihood, start, free(start), notify, _ROUGHLY) for start in starts]

    whole = [axis for axis in likelihood.axes if _plant_is_free(free(config), axis)]
    second = _with_orders(config, whole, 2)
    lags, gains = (_LAGS[:1], _GAINS[:1]) if again else (_LAGS, _GAINS)
    starts = [_lagging(second, whole, free(second), times=times) for times in lags]
    recovers = static = second
    for axis in _with_free_gain(second, likelihood.axes, free):
        recovers = with_recovery(recovers, axis, second.arm.axes[axis].gain_recovery or _GAINS[0][1])
        static = with_recovery(static, axis, None)
    if recovers != static:
        starts += [_with_gain(recovers, free(recovers), more, recovery) for more, recovery in gains]
    if static != second:
        starts += [_lagging(static, whole, free(static), times=times) for times in lags]
    peaks = maxima(starts)
    scores = _penalised_arms(likelihood, peaks, free)
    kinds = _kinds_of_gain(likelihood, peaks, scores)
    best = _best_by_axis(likelihood, peaks, scores)
    if whole and not again:
        best = _past_ticks(likelihood, best, free, notify)
    best, reasons = _orders(likelihood, best, free, notify)
    for axis, why in kinds.items():
        reasons.setdefault(axis, {})["gain"] = why
    return best, reasons


def _orders(likelihood: Likelihood, config: FusionConfig, free: FreeOf, notify: Notify) -> tuple[FusionConfig, Reasons]:
    """The better order of each plant that is wholly free, and why."""
    whole = [axis for axis in likelihood.axes if _plant_is_free(free(config), axis)]
    if not whole:
        return config, {}
    starts = [_with_orders(config, whole, order) for order in (2, 1)]
    pair = [maximise_by_axis(likelihood, start, free(start), notify, _ROUGHLY) for start in starts]
    gained, scores = pair[0].axes - pair[1].axes, _penalised_arms(likelihood, pair, free)
    reasons: Reasons = {}
    for number, axis in enumerate(likelihood.axes):
        if axis in whole:
            ahead = float(scores[0][number] - scores[1][number])
            order = f"order: {'second' if ahead >= 0.0 else 'first'}"
            reasons[axis] = {"order": f"{order} (second {ahead:+.1f}, before its penalty {gained[number]:+.1f})"}
    return _best_by_axis(likelihood, pair, scores), reasons


def _past_ticks(likelihood: Likelihood, config: FusionConfig, free: FreeOf, notify: Notify) -> FusionConfig:
    """The best of a configuration and the maxima a tick of delay on either side, as much less or more being lag.

    The arm gets one command a tick: the likelihood has false maxima there.
    """
    whole = [axis for axis in likelihood.axes if _plant_is_free(free(config), axis)]
    peaks = [point(likelihood, config, free(config))]
    for ticks in (-1.0, 1.0) if whole else ():
        there = _lagging(config, whole, free(config), ticks=ticks)
        peaks.append(maximise_by_axis(likelihood, there, free(there), notify, _ROUGHLY, beside=peaks[0]))
    return _best_by_axis(likelihood, peaks)


def _with_one_delay(
    likelihood: Likelihood, config: FusionConfig, free: FreeOf, whatever: bool
) -> tuple[FusionConfig, Reasons]:
    """One delay for the axes to which an own one is not worth its number, or for all; and for each axis the reason.

    Delay and lag of an axis are known much better together than each. So axes of which each has its own delay seem to
    differ where they do not. The price of an own one is twice that of another number (BIC): along a delay the
    likelihood has bumps, of which the highest gains more by chance than a number of a smooth likelihood does.
    """
    own = {str(one.axis): one for one in free(config) if one.fit == "delay" and one.axis is not None}
    if len(own) < 2:
        return config, {}
    alone = point(likelihood, config, free(config)).axes
    price = np.full(len(alone), np.inf) if whatever else np.log(np.maximum(likelihood.count, 2))
    delays = sorted(one.get(config) for one in own.values())
    tried: list[Point] = []
    for delay in [delays[0], *(late for early, late in pairwise(delays) if late - early > _SAME_DELAY)]:
        there = config
        for axis, one in own.items():
            there = _delayed(there, axis, free(there), one.clipped(delay) - one.get(there))
        rest = [one for one in free(there) if one.fit != "delay"]
        tried.append(maximise_by_axis(likelihood, there, rest, ignore, _ROUGHLY))
    places = {axis: likelihood.axes.index(axis) for axis in own}
    peak = max(tried, key=lambda one: float(np.maximum(one.axes, alone - price)[list(places.values())].sum()))
    gains = {axis: float((alone - peak.axes - price)[place]) for axis, place in places.items()}
    shares = [axis for axis in own if gains[axis] < _NEARLY]
    while len(shares) > 1:
        there = config
        for axis in shares:
            there = with_axis_of(there, peak.config, axis)
        there = with_shared_delay(there, shares, peak.config.arm.delay_of(shares[0]))
        mine = [one for one in free(there) if one.axis is None or one.axis in shares]
        peak = past_bumps(likelihood, maximise(likelihood, there, mine, tolerance=_ROUGHLY), mine)
        gains |= {axis: float((alone - peak.axes - price)[places[axis]]) for axis in shares}
        worst = max(shares, key=gains.__getitem__)
        if gains[worst] <= 0.0:
            break
        shares.remove(worst)
    else:
        shares, peak = [], point(likelihood, config, free(config))
    reasons = {
        axis: {
            "delay": f"delay: {'shared' if axis in shares else 'its own'}" + ("" if whatever else f" (own {gain:+.1f})")
        }
        for axis, gain in gains.items()
    }
    return peak.config, reasons


def _delayed(config: FusionConfig, axis: str, free: Sequence[Parameter], more: float) -> FusionConfig:
    """The configuration with a longer delay of an axis [s], and so much less lag where its plant is free."""
    config = changed(config, ("arm", "axes", axis, "delay"), config.arm.delay_of(axis) + more)
    if not _plant_is_free(free, axis):
        return config
    lag = config.arm.axes[axis].plant.lag
    return with_lag(config, axis, max(lag - more, _LEAST_SHARE * lag))


def _with_free_gain(config: FusionConfig, axes: Sequence[str], free: FreeOf) -> list[str]:
    """The axes whose gain may be of either kind: where it is free, and with a recovery that too."""
    for axis in axes:
        config = with_recovery(config, axis, config.arm.axes[axis].gain_recovery or _GAINS[0][1])
    fields = [(one.axis, one.path[-1]) for one in free(config)]
    return [axis for axis in axes if (axis, "intercept") in fields and (axis, "gain_recovery") in fields]


def _kinds_of_gain(likelihood: Likelihood, peaks: Sequence[Point], scores: Sequence[FloatArray]) -> dict[str, str]:
    """For each axis that was fitted with both kinds of gain, which is the better one and by how much."""
    found: dict[str, str] = {}
    for number, axis in enumerate(likelihood.axes):
        best: dict[bool, float] = {}
        for peak, score in zip(peaks, scores, strict=True):
            recovers = peak.config.arm.axes[axis].gain_recovery is not None
            best[recovers] = max(float(score[number]), best.get(recovers, -np.inf))
        if len(best) > 1:
            ahead = best[True] - best[False]
            kind = "recovering" if ahead > 0.0 else "constant"
            found[axis] = f"gain: {kind} (recovering {ahead:+.1f})"
    return found


def _with_arm_of(config: FusionConfig, other: FusionConfig, free: FreeOf) -> FusionConfig:
    """The configuration with the arm of another, and with its numbers that all axes share."""
    config = msgspec.structs.replace(config, arm=other.arm)
    for one in free(other):
        if one.axis is None:
            config = one.put(config, one.get(other))
    return config


def _plant_is_free(free: Sequence[Parameter], axis: str) -> bool:
    """Whether all parameters of an axis's plant are free, and so its order."""
    mine = {one.path[-1] for one in free if one.axis == axis and one.fit == "plant"}
    return mine in ({"time_constant"}, {"natural_frequency", "damping"})


def _with_orders(config: FusionConfig, axes: Sequence[str], order: int) -> FusionConfig:
    for axis in axes:
        config = with_order(config, axis, order)
    return config


def _lagging(
    config: FusionConfig, axes: Sequence[str], free: Sequence[Parameter], times: float = 1.0, ticks: float = 0.0
) -> FusionConfig:
    """The configuration with plants that lag so many times or ticks more, and delays that make up for it where free."""
    for axis in axes:
        lag = config.arm.axes[axis].plant.lag
        longer = max(times * lag + ticks * config.arm.update_period, _LEAST_SHARE * lag)
        config = with_lag(config, axis, longer)
        delays = [one for one in free if one.axis == axis and one.fit == "delay"]
        config = _shifted(config, delays, lag - longer)
    return config


def _with_gain(config: FusionConfig, free: Sequence[Parameter], more: float, recovery: float) -> FusionConfig:
    """The configuration with every free gain greater by ``more`` and every free recovery at ``recovery`` [s]."""
    for one in free:
        if one.path[-1] == "gain_recovery":
            config = one.put(config, recovery)
        elif one.fit == "gain":
            config = one.put(config, one.get(config) + more)
    return config


def _best_by_axis(
    likelihood: Likelihood, peaks: Sequence[Point], scores: Sequence[FloatArray] | None = None
) -> FusionConfig:
    """The point that is best as a whole, with each axis from the point where that axis is best.

    Args:
        likelihood: The likelihood.
        peaks: The points.
        scores: How good each axis of each is, (A,); its log-posterior for None.
    """
    table = np.array([peak.axes for peak in peaks] if scores is None else scores)
    best = peaks[int(np.argmax(table.sum(axis=1)))].config
    for axis, highest in zip(likelihood.axes, np.argmax(table, axis=0), strict=True):
        best = with_axis_of(best, peaks[int(highest)].config, axis)
    return best
