"""What the measurements cannot tell: parameters that only go together, combinations, noises of rare sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from ..fusion.config import FusionConfig
from .climb import Point, slopes
from .likelihood import Evidence
from .parameters import Parameter, least_sd

_HIGHLY = 0.9  # a correlation worth naming
_MEMBER = 0.3  # share of the largest weight, from which a parameter belongs to a combination
_AT_BOUND = 1e-6
_CONTRACTS = ("latency", "gain", "plant", "delay")  # what of a combination is held rather than the next


@dataclass(frozen=True)
class Tie:
    """A combination of parameters that the measurements do not tell.

    Attributes:
        members: Their names, those that change most first.
        held: Which of them was held for that.
    """

    members: tuple[str, ...]
    held: str


def covariance(information: FloatArray, free: Sequence[Parameter]) -> FloatArray:
    """Of the coordinates, (k, k), from the information (k, k); what nothing tells has an enormous variance."""
    size = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12 / np.square([one.scale for one in free])))
    values, vectors = np.linalg.eigh(information * np.outer(size, size))
    return (vectors / np.maximum(values, 1e-12)) @ vectors.T * np.outer(size, size)


def at_bound(one: Parameter, config: FusionConfig) -> str | None:
    """``least`` or ``greatest`` where a parameter lies at that bound."""
    low, high = one.range
    at, margin = one.at(config), _AT_BOUND * (high - low)
    return "least" if at <= low + margin else "greatest" if at >= high - margin else None


def correlations(evidence: Evidence, best: Point, free: Sequence[Parameter]) -> list[tuple[str, str, float]]:
    """Pairs of parameters that the measurements tell only together: |correlation| > 0.9."""
    inside = [one for one in free if at_bound(one, best.config) is None]
    if not inside:
        return []
    cov = covariance(slopes(evidence, best, inside).information, inside)
    sd = np.sqrt(np.diag(cov))
    matrix = cov / np.outer(sd, sd)
    return [
        (inside[i].key, inside[j].key, float(matrix[i, j]))
        for i in range(len(inside))
        for j in range(i)
        if abs(matrix[i, j]) > _HIGHLY
    ]


def untold(evidence: Evidence, best: Point, free: Sequence[Parameter]) -> Tie | None:
    """The combination of delays, latencies, plants and gains that the measurements tell least, if they do not tell it.

    They do not where its standard deviation, without any prior, is more than a large change of it: a factor e, a tick
    of 28 ms, a tenth of the gain. The one to hold is a latency first, that of the sensor with the least noise.
    """
    inside = [one for one in free if at_bound(one, best.config) is None]
    arm = [number for number, one in enumerate(inside) if one.fit != "noise"]
    if not arm:
        return None
    found = evidence.slopes(best.config, inside, best.value.outcomes)
    cov = covariance(found.information, inside)[np.ix_(arm, arm)]
    scale = np.array([inside[number].scale for number in arm])
    values, vectors = np.linalg.eigh(cov / np.outer(scale, scale))
    if values[-1] < 1.0:
        return None
    weight = np.abs(vectors[:, -1])
    order = [int(place) for place in np.argsort(-weight) if weight[place] > _MEMBER * weight.max()]
    members = [inside[arm[place]] for place in order]
    held = min(members, key=lambda one: (_CONTRACTS.index(one.fit), _noise_of(one, best.config), one.key))
    return Tie(tuple(one.key for one in members), held.key)


def untold_noise(evidence: Evidence, best: Point, free: Sequence[Parameter]) -> list[Parameter]:
    """The noises of sensors that the measurements do not tell to a factor of e, as where a rare one is always news."""
    inside = [one for one in free if at_bound(one, best.config) is None]
    sd = np.sqrt(np.diag(covariance(slopes(evidence, best, inside).information, inside))) if inside else np.zeros(0)
    wide = {one.key for one, spread in zip(inside, sd.tolist(), strict=True) if spread > 1.0}
    return [
        one
        for one in free
        if one.fit == "noise" and not one.vanishes and (one.key in wide or at_bound(one, best.config) == "least")
    ]


def _noise_of(one: Parameter, config: FusionConfig) -> float:
    """The least noise of the sensor that a number is of [m]; 0 where it is of none."""
    return 0.0 if one.sensor is None else least_sd(config, one.sensor)


def shared_time(
    heard: Mapping[str, Sequence[str]], axes: Sequence[str], free: Sequence[Parameter], config: FusionConfig
) -> list[Tie]:
    """The latencies to hold because delays may move too: all latencies less and all delays more by as much is the same.

    One of each group of sensors and moving axes that are connected by measurements, unless a delay or a latency among
    them is known; and that of each sensor which hears no axis that moves.

    Args:
        heard: For each axis its sensors.
        axes: Those that move.
        free: What may move.
        config: The most accurate sensor's latency is held.
    """
    delays = {one.axis: one for one in free if one.fit == "delay"}
    latencies = {one.sensor: one for one in free if one.fit == "latency"}
    left, ties = {axis: set(heard[axis]) for axis in axes}, list[Tie]()
    deaf = [name for name in latencies if not any(name in names for names in left.values())]
    ties += [Tie((latencies[name].key,), latencies[name].key) for name in deaf]
    while left:
        group = [next(iter(left))]
        sensors = left.pop(group[0])
        while joined := [axis for axis, names in left.items() if names & sensors]:
            for axis in joined:
                group.append(axis)
                sensors |= left.pop(axis)
        if all(axis in delays for axis in group) and all(name in latencies for name in sensors):
            members = [*(latencies[name] for name in sorted(sensors)), *(delays[axis] for axis in group)]
            held = min((latencies[name] for name in sorted(sensors)), key=lambda one: _noise_of(one, config))
            ties.append(Tie(tuple(one.key for one in members), held.key))
    return ties
