"""The most likely configuration: several starts, the nearest peak of each, the best of them for each axis.

Gates make the likelihood jump: a poor start has good measurements rejected, a generous one has outliers explained by
noise.
So some starts have gates three times as wide, others the configuration's own, at first with each axis for itself; where
a row is rejected as a whole it is so only at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..fusion.config import FusionConfig, Process
from .climb import Point, Tell, climb, climb_apart, point, settle
from .likelihood import Evidence
from .parameters import DELAYS, LATENCIES, RECOVERY, Parameter
from .variants import with_axis_of, with_gates, with_gates_of, with_lag, with_order

_ROUGHLY = 0.1  # log-likelihood that is not worth another step where peaks are only compared
_WIDER = 3.0
_STEP = 0.010  # s, between delays and latencies that are tried: their peaks are as wide
_LAGS = (1.0, 1.8)  # starts, times the configured; a delay can be taken for a lag and a lag for a delay
_LEAST_SHARE = 0.2  # of a lag that is left where a tick less of it is tried
_GAINS = ((0.0, 0.1), (0.0, 0.4), (0.3, 0.025))  # starts: gain more than configured and recovery [s]; valleys between
_PROCESSES = (  # starts, in units of how far the arm alone is from the measurements
    Process(input_noise=0.1, drift=1.0, maneuver_noise=1.0, maneuver_drift=10.0),
    Process(input_noise=0.01, drift=0.1, maneuver_noise=0.1, maneuver_drift=1.0),
    Process(input_noise=1.0, drift=10.0, maneuver_noise=10.0, maneuver_drift=100.0),
    Process(input_noise=0.01, drift=1.0, maneuver_noise=0.1, maneuver_drift=10.0),
    Process(input_noise=1.0, drift=0.1, maneuver_noise=10.0, maneuver_drift=1.0),
)

Free: TypeAlias = Callable[[FusionConfig], list[Parameter]]


def search(evidence: Evidence, config: FusionConfig, free: Free, tell: Tell) -> tuple[Point, dict[str, str]]:
    """The most likely configuration, and for each axis whose plant is free why it is of its order.

    Args:
        evidence: The measurements.
        config: What is known before.
        free: What may move, which depends on the order of the plants.
        tell: Called with each better point.
    """

    def own(at: FusionConfig) -> list[Parameter]:
        return [one for one in free(at) if one.axis is not None]

    best = _in_time(evidence, with_gates(config, _WIDER), free(config))
    best = _noise_first(evidence, with_gates(with_gates_of(best, config), 1.0), own(config), tell)
    shared = [one for one in free(best) if one.axis is None]
    if shared:
        best = climb(evidence, best, shared, tell, enough=_ROUGHLY).config
    orders: dict[str, str] = {}
    if any(one.fit != "noise" for one in own(best)):
        best, orders = _with_the_arm(evidence, best, own, tell)
    return settle(evidence, with_gates_of(best, config), free(best), tell), orders


def _in_time(evidence: Evidence, config: FusionConfig, free: Sequence[Parameter]) -> FusionConfig:
    """Free delays and latencies near where they belong, those of all axes first, then sensor by sensor.

    Farther away the likelihood has other maxima, with noise in the place of a lag: so they are looked for with several
    levels of noise, before any is fitted.
    """
    noise = [one for one in free if one.fit == "noise"]
    levels = [_with_noise(config, process, evidence.scatter, noise) for process in _processes(evidence, config)[:2]]
    delays = [one for one in free if one.fit == "delay"]
    if delays:
        tried = [
            (shift, point(evidence, _shifted(at, delays, shift), free)) for shift in _grid(DELAYS) for at in levels
        ]
        best = np.argmax([found.heights for _, found in tried], axis=0)
        for one in delays:
            shift, _ = tried[int(best[evidence.axes.index(str(one.axis))])]
            config = _shifted(config, [one], shift)
            levels = [_shifted(at, [one], shift) for at in levels]
    for one in free:
        if one.fit == "latency":
            tried = [
                (shift, point(evidence, _shifted(at, [one], shift), free))
                for shift in _grid(LATENCIES)
                for at in levels
            ]
            shift, _ = max(tried, key=lambda found: found[1].height)
            config = _shifted(config, [one], shift)
            levels = [_shifted(at, [one], shift) for at in levels]
    return config


def _grid(span: tuple[float, float]) -> list[float]:
    """Times from one end to the other [s]."""
    return np.linspace(*span, 1 + round((span[1] - span[0]) / _STEP)).tolist()


def _shifted(config: FusionConfig, times: Sequence[Parameter], shift: float) -> FusionConfig:
    """The configuration with delays or latencies longer by ``shift`` [s], as far as they may be."""
    for one in times:
        config = one.move(config, one.coordinate(one.get(config) + shift))
    return config


def _noise_first(evidence: Evidence, config: FusionConfig, free: Sequence[Parameter], tell: Tell) -> FusionConfig:
    """The best noise that can be climbed to from the best start, with wide gates or without, each axis for itself."""
    noise = [one for one in free if one.fit == "noise"]
    if not noise:
        return config
    peaks: list[Point] = []
    for times in (_WIDER, 1.0):
        start = _best_start(evidence, with_gates(config, times), noise)
        foot = climb_apart(evidence, start, noise, tell, _ROUGHLY).config
        peaks.append(climb_apart(evidence, with_gates_of(foot, config), noise, tell, _ROUGHLY))
    return _best_of_each(evidence, peaks, [peak.heights for peak in peaks])


def _best_start(evidence: Evidence, config: FusionConfig, noise: Sequence[Parameter]) -> FusionConfig:
    """The most likely of many starts, each axis for itself."""
    starts = [
        point(evidence, _with_noise(config, process, sds, noise), noise)
        for process in (config.process, *_processes(evidence, config))
        for sds in ({}, evidence.scatter)
    ]
    return _best_of_each(evidence, starts, [start.heights for start in starts])


def _processes(evidence: Evidence, config: FusionConfig) -> list[dict[str, Process]]:
    """Starts for each axis's process noise, large where the arm alone is far from the measurements."""
    apart = dict(zip(evidence.axes, evidence.misfit(config).tolist(), strict=True))
    return [
        {
            axis: Process(**{name: getattr(one, name) * metres for name in Process.__struct_fields__})
            for axis, metres in apart.items()
        }
        for one in _PROCESSES
    ]


def _with_noise(
    config: FusionConfig, process: Mapping[str, Process], sds: Mapping[str, float], noise: Sequence[Parameter]
) -> FusionConfig:
    """A start: what is free of ``process`` (by axis) and of ``sds`` (by key); nothing begins at none."""
    full = msgspec.structs.replace(config, process={**config.process, **process})
    for one in noise:
        config = one.put(config, max(sds.get(one.key, one.get(full)), 30.0 * one.bounds[0]))
    return config


def _with_the_arm(
    evidence: Evidence, config: FusionConfig, free: Free, tell: Tell
) -> tuple[FusionConfig, dict[str, str]]:
    """The best of the arm's numbers too, from several lags and recoveries, with both orders where the plant is free."""
    whole = [axis for axis in evidence.axes if _plant_is_free(free(config), axis)]
    second = config
    for axis in whole:
        second = with_order(second, axis, 2)
    starts = [_with_lag(second, whole, free(second), times) for times in _LAGS]
    if any(one.key.endswith(RECOVERY) for one in free(second)):
        starts += [_with_gain(second, free(second), more, recovery) for more, recovery in _GAINS]
    peaks = [climb_apart(evidence, start, free(start), tell, _ROUGHLY) for start in starts]
    best = _best_of_each(evidence, peaks, [peak.heights for peak in peaks])
    if not whole:
        return best, {}
    beside = [_lagging_more(best, whole, free(best), ticks) for ticks in (-1.0, 1.0)]
    peaks = [point(evidence, best, free(best)), *(climb_apart(evidence, at, free(at), tell, _ROUGHLY) for at in beside)]
    best = _best_of_each(evidence, peaks, [peak.heights for peak in peaks])
    first = best
    for axis in whole:
        first = with_order(first, axis, 1)
    pair = [climb_apart(evidence, at, free(at), tell, _ROUGHLY) for at in (best, first)]
    gains = pair[0].heights - pair[1].heights
    lowered = [penalised(evidence, peak, free(peak.config)) for peak in pair]
    orders: dict[str, str] = {}
    for number, axis in enumerate(evidence.axes):
        if axis in whole:
            ahead = float(lowered[0][number] - lowered[1][number])
            orders[axis] = (
                f"{'second' if ahead >= 0.0 else 'first'} order: second gains {gains[number]:.1f} in log-likelihood,"
                f" {ahead:+.1f} after the penalty for one number more (BIC)"
            )
    return _best_of_each(evidence, pair, lowered), orders


def penalised(evidence: Evidence, peak: Point, free: Sequence[Parameter]) -> FloatArray:
    """The height of each axis, less the Bayesian information criterion's penalty for its numbers, (A,)."""
    count = np.array([sum(one.axis == axis for one in free) for axis in evidence.axes])
    return peak.heights - 0.5 * count * np.log(np.maximum(evidence.count, 2))


def _plant_is_free(free: Sequence[Parameter], axis: str) -> bool:
    """Whether all the numbers of an axis's plant may move, and so its order."""
    mine = {one.key.rpartition(".")[2] for one in free if one.axis == axis and one.fit == "plant"}
    return mine in ({"time_constant_ms"}, {"natural_frequency_rad_s", "damping"})


def _with_lag(config: FusionConfig, axes: Sequence[str], free: Sequence[Parameter], times: float) -> FusionConfig:
    """The configuration with plants that lag so many times as long, and delays that make up for it where they may."""
    for axis in axes:
        lag = config.arm.axes[axis].plant.lag
        config = with_lag(config, axis, times * lag)
        for one in free:
            if one.axis == axis and one.fit == "delay":
                config = _shifted(config, [one], (1.0 - times) * lag)
    return config


def _lagging_more(config: FusionConfig, axes: Sequence[str], free: Sequence[Parameter], ticks: float) -> FusionConfig:
    """The configuration with plants that lag so many ticks more, and delays that are as much shorter where they may be.

    The arm is told where to go once a tick: the likelihood has a false peak a tick of delay on either side.
    """
    for axis in axes:
        more = ticks * config.arm.update_period / config.arm.axes[axis].plant.lag
        config = _with_lag(config, [axis], free, max(1.0 + more, _LEAST_SHARE))
    return config


def _with_gain(config: FusionConfig, free: Sequence[Parameter], more: float, recovery: float) -> FusionConfig:
    """The configuration with every gain that may move greater by ``more``, every recovery at ``recovery`` [s]."""
    for one in free:
        if one.key.endswith(RECOVERY):
            config = one.put(config, recovery)
        elif one.fit == "gain":
            config = one.put(config, one.get(config) + more)
    return config


def _best_of_each(evidence: Evidence, peaks: Sequence[Point], heights: Sequence[FloatArray]) -> FusionConfig:
    """The best peak as a whole, with each axis from where that axis is highest."""
    best = peaks[int(np.argmax([height.sum() for height in heights]))].config
    for number, axis in enumerate(evidence.axes):
        highest = peaks[int(np.argmax([height[number] for height in heights]))]
        best = with_axis_of(best, highest.config, axis)
    return best
