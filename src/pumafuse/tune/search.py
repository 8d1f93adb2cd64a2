"""The most likely configuration: Fisher scoring from several starts.

A step solves (I + λ diag I) δ = g with the score g and the expected information I of all parameters at once; it is
taken where the likelihood itself, gates and all, is better there (λ as Levenberg and Marquardt have it; Osborne,
"Fisher's method of scoring", International Statistical Review 60, 1992). Numbers that have a prior are moved by it too.

Gates make the likelihood jump: a poor start has good readings rejected, a generous one has outliers explained by noise.
So some starts have gates three times as wide, others the configuration's own, at first with each axis for itself; where
a row is gated as a whole it is so only at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeAlias

import msgspec
import numpy as np

from ..arrays import CodeArray, FloatArray
from ..fusion.config import FusionConfig, Process
from ..fusion.ticks import usable_cores
from .likelihood import Evidence, Slopes, Value
from .parameters import RECOVERY, Parameter, with_axis_of, with_lag, with_order

_ITERATIONS = 60
_ENOUGH = 2e-3  # expected gain in log-likelihood that is not worth another step
_ROUGHLY = 0.1  # likewise, where peaks are only compared
_LEAST = 1e-4  # damping to begin with
_ROUNDING = 1e-10  # of a matrix with a diagonal of 1, below which its eigenvalues say nothing
_STUBBORN = 1e8  # damping at which no step will do
_DOUBLES = (2.0, 4.0, 8.0)
_SETTLING = 12  # times that the gates are asked again
_SHARES = (1.0, 0.5, 0.2)
_REACH = 1.5  # longest step of a coordinate, in its scale
_WIDER = 3.0
_STARTS = ((_WIDER, 1), (1.0, 1))  # how many to climb from with gates so many times as wide
_DELAYS = np.linspace(-0.060, 0.060, 13)  # s, from the configured
_LATENCIES = np.linspace(-0.100, 0.300, 41)  # s, likewise
_LAGS = (1.0, 0.5, 1.8)  # starts, times the configured; a delay can be taken for a lag and a lag for a delay
_GAINS = ((0.0, 0.1), (0.0, 0.4), (0.3, 0.025))  # starts: gain more than configured and recovery [s]; valleys between
_PROCESSES = (  # starts, in units of how far the arm alone is from the readings
    Process(input_noise=0.1, drift=1.0, maneuver_noise=1.0, maneuver_drift=10.0),
    Process(input_noise=0.01, drift=0.1, maneuver_noise=0.1, maneuver_drift=1.0),
    Process(input_noise=1.0, drift=10.0, maneuver_noise=10.0, maneuver_drift=100.0),
    Process(input_noise=0.01, drift=1.0, maneuver_noise=0.1, maneuver_drift=10.0),
    Process(input_noise=1.0, drift=0.1, maneuver_noise=10.0, maneuver_drift=1.0),
)


@dataclass(frozen=True)
class Point:
    """A configuration and what the readings say of it.

    Attributes:
        config: The configuration.
        value: Its log-likelihood.
        prior: Logarithm of the prior density of each axis's numbers (what all share at the first), but for a constant,
            (A,).
    """

    config: FusionConfig
    value: Value
    prior: FloatArray

    @property
    def heights(self) -> FloatArray:
        """What is maximised, of each axis, (A,)."""
        return self.value.axes + self.prior

    @property
    def height(self) -> float:
        """What is maximised."""
        return float(self.heights.sum())


Tell: TypeAlias = Callable[[Point], None]
Free: TypeAlias = Callable[[FusionConfig], list[Parameter]]


def point(
    evidence: Evidence,
    config: FusionConfig,
    free: Sequence[Parameter],
    outcomes: Sequence[CodeArray] | None = None,
) -> Point:
    """What the readings and the priors say of a configuration; with ``outcomes`` whatever its gates would say."""
    prior = np.zeros(len(evidence.axes))
    for one in free:
        if one.prior is not None:
            z = (one.coordinate(one.get(config)) - one.prior[0]) / one.prior[1]
            prior[0 if one.axis is None else evidence.axes.index(one.axis)] -= 0.5 * z * z
    return Point(config, evidence.value(config, outcomes), prior)


def slopes(evidence: Evidence, at: Point, free: Sequence[Parameter]) -> Slopes:
    """Score and information at a point, the priors' shares in them."""
    found = evidence.slopes(at.config, free, at.value.outcomes)
    score, information = found.score.copy(), found.information.copy()
    for number, one in enumerate(free):
        if one.prior is not None:
            middle, sd = one.prior
            score[number] -= (one.coordinate(one.get(at.config)) - middle) / sd**2
            information[number, number] += 1.0 / sd**2
    return Slopes(score, information)


def search(evidence: Evidence, config: FusionConfig, free: Free, tell: Tell) -> tuple[Point, dict[str, str]]:
    """The most likely configuration, and for each axis whose plant is free why it is of its order.

    Args:
        evidence: The readings.
        config: What is known before.
        free: What may move, which depends on the order of the plants.
        tell: Called with each better point.
    """

    def own(at: FusionConfig) -> list[Parameter]:
        return [one for one in free(at) if one.axis is not None]

    best = _in_time(evidence, _with_gates(config, _WIDER), free(config))
    best = _noise_first(evidence, _with_gates(with_gates_of(best, config), 1.0), own(config), tell)
    shared = [one for one in free(best) if one.axis is None]
    if shared:
        best = climb(evidence, best, shared, tell, enough=_ROUGHLY).config
    orders: dict[str, str] = {}
    if any(one.fit != "noise" for one in own(best)):
        best, orders = _with_the_arm(evidence, best, own, tell)
    return settle(evidence, with_gates_of(best, config), free(best), tell), orders


def climb(
    evidence: Evidence,
    start: FusionConfig,
    free: Sequence[Parameter],
    tell: Tell = lambda _: None,
    outcomes: Sequence[CodeArray] | None = None,
    enough: float = _ENOUGH,
) -> Point:
    """The nearest maximum.

    Args:
        evidence: The readings.
        start: From here.
        free: What may move.
        tell: Called with each better point.
        outcomes: What became of each scalar, to be repeated; None: the gates decide.
        enough: Gain in log-likelihood that is not worth another step.
    """
    best = point(evidence, start, free, outcomes)
    if not free:
        return best
    low, high = np.array([one.range for one in free]).T
    reach = _REACH * np.array([one.scale for one in free])
    axis = np.array([-1 if one.axis is None else evidence.axes.index(one.axis) for one in free])
    damping = np.full(len(free), _LEAST)
    for _ in range(_ITERATIONS):
        at = np.array([one.coordinate(one.get(best.config)) for one in free])
        found = slopes(evidence, best, free)
        failed = False
        while True:
            step = _step(found, np.maximum(low - at, -reach), np.minimum(high - at, reach), damping)
            expected = float(found.score @ step) - 0.5 * float(step @ found.information @ step)
            if not expected > 0.0 or damping.min() > _STUBBORN:
                return best
            trial = point(evidence, moved(best.config, free, at + step), free, outcomes)
            gained = trial.height - best.height
            worse = np.append(trial.heights < best.heights, gained < 0.0)[axis]
            if gained > 0.0:
                damping = np.where(worse, 10.0 * damping, 0.1 * damping)
                break
            damping = np.where(worse | failed, 10.0 * np.maximum(damping, _LEAST), damping)
            failed = True
            if expected < enough:
                return best
        best = _farther(evidence, best, trial, step, free, outcomes)
        tell(best)
        if expected < enough and gained < enough:
            return best
    return best


def _farther(
    evidence: Evidence,
    start: Point,
    trial: Point,
    step: FloatArray,
    free: Sequence[Parameter],
    outcomes: Sequence[CodeArray] | None,
) -> Point:
    """The best of a step and its doubles: along a valley the information promises too short ones."""
    at = np.array([one.coordinate(one.get(start.config)) for one in free])
    for double in _DOUBLES:
        longer = point(evidence, moved(start.config, free, at + double * step), free, outcomes)
        if longer.height < trial.height + _ENOUGH:
            break
        trial = longer
    return trial


def climb_apart(evidence: Evidence, start: FusionConfig, free: Sequence[Parameter], tell: Tell, enough: float) -> Point:
    """The nearest maximum of each axis for itself, several at a time; of all together where they share a number."""
    if any(one.axis is None for one in free):
        return climb(evidence, start, free, tell, enough=enough)

    def of(axis: str) -> FusionConfig:
        mine = [one for one in free if one.axis == axis]
        return climb(evidence.alone(axis), start, mine, enough=enough).config

    best = start
    with ThreadPoolExecutor(usable_cores()) as pool:
        for axis, config in zip(evidence.axes, pool.map(of, evidence.axes), strict=True):
            best = with_axis_of(best, config, axis)
    found = point(evidence, best, free)
    tell(found)
    return found


def settle(evidence: Evidence, start: FusionConfig, free: Sequence[Parameter], tell: Tell = lambda _: None) -> Point:
    """The nearest maximum under the gates' own decisions: climb with the outcomes as they are, ask the gates again.

    A row that a gate newly rejects costs more than what a step gains, so a climb that asked at every step would stop at
    the first one. Where the peak with the old outcomes turns out worse, a part of the way there is tried.
    """
    apart = all(not sensor.gate_rows for sensor in start.sensors.values())
    best = climb_apart(evidence, start, free, tell, _ENOUGH) if apart else climb(evidence, start, free, tell)
    for _ in range(_SETTLING):
        peak = climb(evidence, best.config, free, outcomes=best.value.outcomes)
        at = np.array([one.coordinate(one.get(best.config)) for one in free])
        there = np.array([one.coordinate(one.get(peak.config)) for one in free])
        for share in _SHARES:
            trial = point(evidence, moved(best.config, free, at + share * (there - at)), free)
            if trial.height > best.height + _ENOUGH:
                break
        else:
            return best
        best = trial
        tell(best)
    return best


def moved(config: FusionConfig, free: Sequence[Parameter], coordinates: Iterable[float]) -> FusionConfig:
    """The configuration with every parameter at its coordinate."""
    for one, coordinate in zip(free, coordinates, strict=True):
        config = one.move(config, float(coordinate))
    return config


def _step(found: Slopes, low: FloatArray, high: FloatArray, damping: FloatArray) -> FloatArray:
    """The δ in the box from ``low`` to ``high`` that gains most: ½ δᵀ(I + λ diag I)δ − gᵀδ is least there.

    The matrix is scaled so that its diagonal is 1 + λ. What nothing tells does not move.
    """
    from scipy.linalg import solve_triangular
    from scipy.optimize import lsq_linear

    diagonal = np.diag(found.information)
    told = diagonal > 0.0
    step, size = np.zeros(len(diagonal)), 1.0 / np.sqrt(diagonal[told])
    matrix = found.information[np.ix_(told, told)] * np.outer(size, size) + np.diag(damping[told] + _ROUNDING)
    root = np.asarray(np.linalg.cholesky(matrix), dtype=np.float64)
    aim = solve_triangular(root, size * found.score[told], lower=True)
    step[told] = size * lsq_linear(root.T, aim, (low[told] / size, high[told] / size), method="bvls").x
    return step


def _in_time(evidence: Evidence, config: FusionConfig, free: Sequence[Parameter]) -> FusionConfig:
    """Free delays and latencies near where they belong, those of all axes first, then sensor by sensor.

    Farther away the likelihood has other maxima, with noise in the place of a lag: so they are looked for with several
    levels of noise, before any is fitted.
    """
    noise = [one for one in free if one.fit == "noise"]
    levels = [_with_noise(config, process, evidence.scatter, noise) for process in _processes(evidence, config)[:2]]
    delays = [one for one in free if one.fit == "delay"]
    if delays:
        tried = [(shift, point(evidence, _shifted(at, delays, shift), free)) for shift in _DELAYS for at in levels]
        best = np.argmax([found.heights for _, found in tried], axis=0)
        for one in delays:
            shift, _ = tried[int(best[evidence.axes.index(str(one.axis))])]
            config = _shifted(config, [one], shift)
            levels = [_shifted(at, [one], shift) for at in levels]
    for one in free:
        if one.fit == "latency":
            tried = [
                (shift, point(evidence, _shifted(at, [one], shift), free)) for shift in _LATENCIES for at in levels
            ]
            shift, _ = max(tried, key=lambda found: found[1].height)
            config = _shifted(config, [one], shift)
            levels = [_shifted(at, [one], shift) for at in levels]
    return config


def _shifted(config: FusionConfig, times: Sequence[Parameter], shift: float) -> FusionConfig:
    """The configuration with delays or latencies longer by ``shift`` [s], as far as they may be."""
    for one in times:
        config = one.move(config, one.coordinate(one.get(config) + shift))
    return config


def _noise_first(evidence: Evidence, config: FusionConfig, free: Sequence[Parameter], tell: Tell) -> FusionConfig:
    """The best noise that can be climbed to from the best starts, each axis for itself."""
    noise = [one for one in free if one.fit == "noise"]
    if not noise:
        return config
    peaks = [
        climb_apart(
            evidence,
            with_gates_of(climb_apart(evidence, start, noise, tell, _ROUGHLY).config, config),
            noise,
            tell,
            _ROUGHLY,
        )
        for gates, count in _STARTS
        for start in _best_starts(evidence, _with_gates(config, gates), noise, count)
    ]
    return _best_of_each(evidence, peaks, [peak.heights for peak in peaks])


def _best_starts(
    evidence: Evidence, config: FusionConfig, noise: Sequence[Parameter], count: int
) -> list[FusionConfig]:
    """The most likely of many starts, each axis for itself."""
    starts = [
        point(evidence, _with_noise(config, process, sds, noise), noise)
        for process in (config.process, *_processes(evidence, config))
        for sds in ({}, evidence.scatter)
    ]
    ranked = np.argsort([-start.heights for start in starts], axis=0)
    found: list[FusionConfig] = []
    for rank in range(count):
        best = config
        for number, axis in enumerate(evidence.axes):
            best = with_axis_of(best, starts[int(ranked[rank, number])].config, axis)
        found.append(best)
    return found


def _processes(evidence: Evidence, config: FusionConfig) -> list[dict[str, Process]]:
    """Starts for each axis's process noise, large where the arm alone is far from the readings."""
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
    """The best of the arm's numbers too, from several recoveries and with both orders where the plant is free."""
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
    first = best
    for axis in whole:
        first = with_order(first, axis, 1)
    pair = [climb_apart(evidence, at, free(at), tell, _ROUGHLY) for at in (best, first)]
    gains = pair[0].heights - pair[1].heights
    parts = [np.array([sum(one.axis == axis for one in free(peak.config)) for axis in evidence.axes]) for peak in pair]
    penalised = [
        peak.heights - 0.5 * count * np.log(np.maximum(evidence.count, 2))
        for peak, count in zip(pair, parts, strict=True)
    ]
    orders: dict[str, str] = {}
    for number, axis in enumerate(evidence.axes):
        if axis in whole:
            ahead = float(penalised[0][number] - penalised[1][number])
            orders[axis] = (
                f"{'second' if ahead >= 0.0 else 'first'} order: second gains {gains[number]:.1f} in log-likelihood,"
                f" {ahead:+.1f} after the penalty for one number more (BIC)"
            )
    return _best_of_each(evidence, pair, penalised), orders


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


def _with_gates(config: FusionConfig, times: float) -> FusionConfig:
    """The configuration with gates so many times as wide, each scalar for itself."""
    sensors = {
        name: msgspec.structs.replace(sensor, gate=times * sensor.gate, gate_rows=False)
        for name, sensor in config.sensors.items()
    }
    return msgspec.structs.replace(config, sensors=sensors)


def with_gates_of(config: FusionConfig, other: FusionConfig) -> FusionConfig:
    """The configuration with the gates that another has."""
    sensors = {
        name: msgspec.structs.replace(sensor, gate=other.sensors[name].gate, gate_rows=other.sensors[name].gate_rows)
        for name, sensor in config.sensors.items()
    }
    return msgspec.structs.replace(config, sensors=sensors)
