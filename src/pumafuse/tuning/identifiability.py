"""Excitation and identifiability: whether runs can be fitted at all, and what their measurements do not determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..errors import PumafuseError
from ..fusion.config import FusionConfig
from ..fusion.faults import Fault
from . import arms
from .likelihood import Likelihood, Point
from .maximise import derivatives
from .parameters import Parameter, smallest_sd

FEWEST, FEW = 12, 30  # components of an axis: to fit anything, and to fit what only many can tell
_OF_MANY = ("maneuver_noise", "maneuver_drift", "disturbance_sd", "disturbance_time", "intercept", "gain_recovery")
_ENOUGH = 30  # components for each number fitted to them; with less, coverage was 45 to 85 % in simulated runs
_EXCITED = 3.0  # commanded motion over noise from which an axis moves
_HIGH = 0.9  # a correlation worth reporting
_MEMBER = 0.3  # share of the largest weight, from which a parameter belongs to a combination
_FIXED_FIRST = ("latency", "scale", "gain", "plant", "delay")  # which kind of a combination is fixed before the next


class TuneError(PumafuseError):
    """Recorded runs that nothing can be fitted to."""


class LostError(TuneError):
    """A sensor that does not follow the commands at all on some axes."""

    def __init__(self, fault: Fault) -> None:
        """The error of the sensor that has a ``fault``."""
        super().__init__(fault.sentence)
        self.fault = fault


class Correlation(msgspec.Struct, frozen=True, kw_only=True):
    """Two highly correlated parameters."""

    first: str
    second: str
    correlation: float


@dataclass(frozen=True)
class NotIdentifiable:
    """A combination of parameters that the measurements do not determine."""

    members: tuple[str, ...]  # their keys, those that change most first
    fixed: str  # which of them was fixed for that reason

    def __str__(self) -> str:
        """A sentence for notes."""
        others = ", ".join(key for key in self.members if key != self.fixed)
        return f"{self.fixed} is fixed: not identifiable" + (f" apart from {others}" if others else "")


# ---- excitation -----------------------------------------------------------------------------------------------------


def excited_axes(likelihood: Likelihood, config: FusionConfig) -> list[str]:
    """The axes that are measured and commanded to move by more than the noise.

    Raises:
        TuneError: There are too few measurements, no axis moves, or a sensor does not follow the commands at all, which
            is a LostError.
    """
    for axis, count in zip(likelihood.axes, likelihood.count.tolist(), strict=True):
        if 0 < count < FEWEST:
            raise TuneError(f"{axis}: only {count} measurements; record longer: a fit needs at least {FEWEST}")
    if not likelihood.count.any():
        raise TuneError("no measurement of a configured sensor lies within the runs: are names and clocks the same?")
    axes: list[str] = []
    for axis, names in likelihood.sensors.items():
        noise = min(likelihood.scatter.get((name, axis), 0.0) for name in names)
        if likelihood.travel[axis] > _EXCITED * noise:
            axes.append(axis)
    if not axes:
        if refused := [fault.sentence for fault in likelihood.faults(config) if fault.refused]:
            raise TuneError(refused[0])  # in another unit the noise seems large
        widest = max(likelihood.travel, key=likelihood.travel.__getitem__)
        screen = config.arm.screen_of(widest)
        farthest = f"{likelihood.travel[widest] * screen.scale:.3g} {screen.unit}"
        raise TuneError(
            f"no axis is commanded to move by more than its sensors' noise (at most {farthest}): an arm at rest"
            " cannot be identified; record a run with motion"
        )
    for name, share in likelihood.share_after_end.items():
        if share > 0.5:
            raise TuneError(
                f"sensor '{name}': {share:.0%} of its measurements lie more than 1 s after the last command: are both"
                " stamped by one clock?"
            )
    for fault in likelihood.faults(config):
        if fault.lost and not set(fault.axes).isdisjoint(axes):
            raise LostError(fault)
    return axes


def for_few(likelihood: Likelihood, free: Sequence[Parameter]) -> list[Parameter]:
    """The parameters that as many measurements as there are can tell."""
    few = {axis for axis, count in zip(likelihood.axes, likelihood.count.tolist(), strict=True) if count < FEW}
    return [
        parameter
        for parameter in free
        if parameter.axis not in few
        or not (parameter.path[-1] in _OF_MANY or (parameter.fit == "plant" and parameter.path[-1] != "time_constant"))
    ]


def few_measurements(likelihood: Likelihood, free: Sequence[Parameter]) -> list[str]:
    """A sentence for each axis with too few measurements for as many numbers, or for some kinds of numbers."""
    many, few = list[str](), list[str]()
    for axis, count in zip(likelihood.axes, likelihood.count.tolist(), strict=True):
        if count < _ENOUGH * (numbers := sum(parameter.axis == axis for parameter in free)):
            many.append(
                f"{axis}: {count} measurements for {numbers} numbers to fit: with fewer than {_ENOUGH} for each, noise"
                " and motion are hard to tell apart and error bars need not hold; fit less, or record for longer"
            )
        if 0 < count < FEW:
            few.append(
                f"{axis}: only {count} measurements: gain, disturbance, maneuvers and the order of the plant stay as"
                " they are"
            )
    return many + few


# ---- identifiability ------------------------------------------------------------------------------------------------


def covariance(information: FloatArray, free: Sequence[Parameter]) -> FloatArray:
    """The covariance of the coordinates, (k, k), from the information (k, k); without information it is enormous."""
    return arms.covariance(information, [parameter.scale for parameter in free])


def within_bounds(free: Sequence[Parameter], config: FusionConfig) -> list[Parameter]:
    """The parameters that are at neither bound."""
    return [parameter for parameter in free if parameter.at_bound(config) is None]


def correlations(likelihood: Likelihood, best: Point, free: Sequence[Parameter]) -> list[Correlation]:
    """Pairs of parameters with a correlation beyond ± 0.9."""
    inside = within_bounds(free, best.config)
    cov = covariance(derivatives(likelihood, best, inside).information, inside)
    sd = np.sqrt(np.diag(cov))
    matrix = cov / np.outer(sd, sd)
    return [
        Correlation(first=inside[i].key, second=inside[j].key, correlation=float(matrix[i, j]))
        for i, j in np.argwhere(np.tril(np.abs(matrix) > _HIGH, -1)).tolist()
    ]


def not_identifiable(likelihood: Likelihood, best: Point, free: Sequence[Parameter]) -> NotIdentifiable | None:
    """The least determined combination of delays, latencies, scales, plants and gains, if it is not identifiable.

    It is not where its standard deviation, without any prior, is more than a large change: a factor e, a tick of 28 ms,
    a tenth of the gain. The one to fix is a latency first, that of the sensor with the least noise.
    """
    inside = within_bounds(free, best.config)
    arm = [number for number, parameter in enumerate(inside) if parameter.fit in _FIXED_FIRST]
    if not arm:
        return None
    derivatives = likelihood.derivatives(best.config, inside, best.outcomes)
    cov = covariance(derivatives.information, inside)[np.ix_(arm, arm)]
    scale = np.array([inside[number].scale for number in arm])
    values, vectors = np.linalg.eigh(cov / np.outer(scale, scale))
    if values[-1] < 1.0:
        return None
    weight = np.abs(vectors[:, -1])
    order = [int(number) for number in np.argsort(-weight) if weight[number] > _MEMBER * weight.max()]
    members = [inside[arm[number]] for number in order]
    fixed = min(
        members, key=lambda member: (_FIXED_FIRST.index(member.fit), _noise_of(member, best.config), member.key)
    )
    return NotIdentifiable(tuple(member.key for member in members), fixed.key)


def not_identifiable_noise(likelihood: Likelihood, best: Point, free: Sequence[Parameter]) -> list[Parameter]:
    """The noises and drifts of sensors that are uncertain by more than a factor of e, or at their lower bound.

    None of which something is believed.
    """
    inside = within_bounds(free, best.config)
    cov = covariance(derivatives(likelihood, best, inside).information, inside)
    wide = {parameter.key for parameter, variance in zip(inside, np.diag(cov), strict=True) if variance > 1.0}
    noises = [parameter for parameter in free if parameter.is_noise or "bias_drift_sd" in parameter.path]
    return [
        noise
        for noise in noises
        if noise.prior is None and (noise.key in wide or noise.at_bound(best.config) == "lower")
    ]


def shared_times(
    sensors: Mapping[str, Sequence[str]], axes: Sequence[str], free: Sequence[Parameter], config: FusionConfig
) -> list[NotIdentifiable]:
    """The latencies to fix where delays are free too: all latencies less and all delays more by as much is the same.

    One of each group of sensors and moving ``axes`` that are connected by measurements, that of the most accurate,
    unless a delay or a latency among them is known; and that of each sensor which measures no axis that moves.
    """
    delays = {parameter.axis: parameter for parameter in free if parameter.fit == "delay"}
    latencies = {parameter.sensor: parameter for parameter in free if parameter.fit == "latency"}
    groups: list[tuple[set[str], set[str]]] = []  # axes and sensors that are connected
    for axis in axes:
        joined = [group for group in groups if group[1] & {*sensors[axis]}]
        groups = [group for group in groups if group not in joined]
        together = {axis}.union(*(axes_there for axes_there, _ in joined))
        groups.append((together, {*sensors[axis]}.union(*(names_there for _, names_there in joined))))
    moved = set[str]().union(*(names for _, names in groups))
    unidentifiable = [
        NotIdentifiable((latency.key,), latency.key) for name, latency in latencies.items() if name not in moved
    ]
    for group, names in groups:
        if group <= delays.keys() and names <= latencies.keys():
            latencies_here = [latencies[name] for name in sorted(names)]
            fixed = min(latencies_here, key=lambda latency: _noise_of(latency, config))
            members = [*latencies_here, *(delays[axis] for axis in sorted(group))]
            unidentifiable.append(NotIdentifiable(tuple(member.key for member in members), fixed.key))
    return unidentifiable


def lone_drifts(
    sensors: Mapping[str, Sequence[str]], free: Sequence[Parameter], config: FusionConfig
) -> list[NotIdentifiable]:
    """The drifts of sensors that measure alone: what they add is as if the arm did it. One that is known stays free."""
    lone = {names[0] for names in sensors.values() if len(names) == 1}
    lone -= {name for names in sensors.values() if len(names) > 1 for name in names}
    drifts = [
        parameter
        for parameter in free
        if parameter.fit == "bias" and parameter.path[-1] != "bias_time" and parameter.sensor in lone
    ]
    return [NotIdentifiable((drift.key,), drift.key) for drift in drifts if not drift.configured(config)]


def _noise_of(parameter: Parameter, config: FusionConfig) -> float:
    """The least noise of the sensor of a parameter [m or rad]; 0 where it has none."""
    return 0.0 if parameter.sensor is None else smallest_sd(config, parameter.sensor)
