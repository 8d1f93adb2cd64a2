"""Numbers of an arm and its sensors to begin with, from how the motions of a log follow each other."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..arrays import FloatArray, TimeArray
from ..errors import RunError
from ..logs.run import REFERENCE, Run
from ..units import Kind
from .contents import period_of
from .following import Following, isolated
from .sensors import Alignment, aligned, noise
from .survey import AHEAD, FOLLOWS, Survey

_DELAY_SHARE = 0.6  # of the lag; the PUMA's is 0.6, a servo's on a bus rather 0.75
_UNKNOWN_LAG = 0.1  # s, where nothing follows
_UNKNOWN_SD, _SMALLEST_SD = 1e-3, 1e-6  # m or rad
_OUTLIERS, _FEWEST_OUTLIERS = 3e-3, 3  # share and number from which a narrow gate pays: one or two may be anything
_GATE, _WIDE_GATE = 5.0, 50.0
_LONGEST_GLITCH = 5  # rows
_FAR = 0.05  # of what a sensor saw: what leaves its neighbours farther is no jerk of an arm
_AWAY = 10.0  # times what the delayed command leaves, from which an arm starts elsewhere than at its first command
_SOON = 0.5  # of the lag, within which a first measurement tells the start
_DIFFERENT = 5.0  # sds
_SURELY = 2.0  # half intervals, from which a sensor is earlier than the densest one


@dataclass(frozen=True)
class AxisGuess:
    """First numbers of an axis: lag [s] behind the held command, plant, and noise [m or rad]."""

    kind: Kind  # whether it is a length or an angle
    follows: str  # the sensor from which it is known; empty: none
    lag: float  # behind the held command at constant velocity [s]
    time_constant: float  # of the plant [s]
    gain: float  # how far it moves when the command moves by 1
    misfit: float  # what the delayed command leaves
    start: float | None  # where it starts, if that is not at its first command; None: it is, or nothing tells
    offset_sd: float  # of [start] in fusion.toml
    input_noise: float  # its density [m/√Hz]
    drift: float  # its density [m/√s]


@dataclass(frozen=True)
class ArmGuess:
    """First numbers of an arm: update period and delay [s], and its axes."""

    period: float
    delay: float
    axes: Mapping[str, AxisGuess]


class Pair(NamedTuple):
    """A sensor beside another one."""

    other: str
    alignment: Alignment


@dataclass(frozen=True)
class SensorGuess:
    """A sensor: noise and biases by axis [m or rad], latency [s] and where it is from, scale, gate (0: none needed).

    ``turns``: whether it measures angles within a turn. ``pair``: what the latency is from, and what that leaves open.
    """

    sd: Mapping[str, float]
    bias: Mapping[str, float]
    latency: float
    latency_words: str
    scale: float
    gate: float
    turns: bool
    pair: Pair | None


def guess(
    survey: Survey, registered: Mapping[str, float] = MappingProxyType({})
) -> tuple[ArmGuess, dict[str, SensorGuess]]:
    """The arm, and each sensor; latencies [s] that a registration found are not looked for."""
    run = survey.run
    period = period_of(run.command)
    if math.isnan(period):
        raise RunError(
            f"{survey.log}: fewer than two commands with stamps of their own; give a log in which several are"
        )
    relations = {  # the axes of a sensor in a frame of its own are others
        (name, axis): relation
        for (name, axis), relation in survey.relations.items()
        if abs(relation.correlation) >= FOLLOWS and name not in survey.own_frames
    }
    first, latencies, pairs = _against_each_other(survey.run, relations, registered)
    leads: dict[str, dict[str, Following]] = {axis: {} for axis in run.axes}
    late: dict[str, list[float]] = {}
    for (name, axis), relation in relations.items():
        if name in run.sensors:
            leads[axis][name] = relation
            late.setdefault(axis, []).append(relation.lag - latencies.get(name, 0.0))
    # Behind the path through the commanded points a held command is late by half a period itself.
    lags = {axis: float(np.median(lags)) - 0.5 * period for axis, lags in late.items()}
    speeds = [own_frame.speeds.lag - 0.5 * period for own_frame in survey.own_frames.values()]
    unknown = max(float(np.median(speeds)), 0.0) if speeds else _UNKNOWN_LAG
    shortest = max(min(lags.values(), default=unknown), 0.0)
    delay = _DELAY_SHARE * shortest
    axes = {axis: _axis(survey, axis, leads[axis], lags.get(axis, unknown), delay) for axis in run.axes}
    sensors = {name: _sensor(survey, name, latencies, first, leads, pairs.get(name)) for name in run.sensors}
    return ArmGuess(period, delay, axes), sensors


def _against_each_other(
    run: Run, relations: Mapping[tuple[str, str], Following], registered: Mapping[str, float]
) -> tuple[str, dict[str, float], dict[str, Pair]]:
    """The reference, else the earliest source; the latency of each beside it [s]; each aligned with the densest."""
    lags: dict[str, list[float]] = {}
    for (name, _), relation in relations.items():
        lags.setdefault(name, []).append(relation.lag)
    if not lags:
        return "", {}, {}
    base = REFERENCE if REFERENCE in lags else max(lags, key=lambda name: len(run.sensors[name].stamp))
    others = [name for name in lags if name != base]
    later = {name: registered[name] - registered.get(base, 0.0) for name in others if name in registered} | {base: 0.0}
    unaligned = [name for name in others if name not in later]
    pairs = {name: Pair(base, alignment) for name in unaligned if (alignment := aligned([run], base, name)) is not None}
    for name, (_, alignment) in pairs.items():
        # One that seems earlier than the densest one, but not surely, would make the time of all wrong by that.
        if not -_SURELY * alignment.half < alignment.latency < 0.0:
            later[name] = alignment.latency
    first = base if base == REFERENCE else min(later, key=later.__getitem__)
    ahead = float(np.median(lags[first]))
    ahead = ahead if ahead < -AHEAD else 0.0
    latencies = {name: ahead + max(later.get(name, 0.0) - later[first], 0.0) for name in later | pairs}
    return first, latencies, pairs


def _axis(survey: Survey, axis: str, followers: Mapping[str, Following], lag: float, delay: float) -> AxisGuess:
    best = max(followers, key=lambda name: abs(followers[name].correlation), default="")
    travel = float(np.nanmax(survey.run.command.values[axis]) - np.nanmin(survey.run.command.values[axis]))
    relation = followers.get(best)
    misfit = max(relation.misfit if relation else 0.02 * travel, _SMALLEST_SD)
    offset = min((abs(follower.offset) for follower in followers.values()), default=0.0)
    lag_of_plant = max(lag - delay, 0.2 * lag, 1e-3)
    return AxisGuess(
        kind=survey.run.kinds.get(axis, "length"),
        follows=best,
        lag=max(lag, delay + lag_of_plant),
        time_constant=lag_of_plant,
        gain=abs(relation.slope) if relation else 1.0,
        misfit=misfit,
        start=_start(survey, axis, best, relation, misfit, travel) if relation else None,
        offset_sd=max(3.0 * misfit, 2.0 * offset if offset < 0.5 * travel else 0.0),
        input_noise=misfit * math.sqrt(lag_of_plant),
        drift=0.5 * misfit,
    )


def _sensor(
    survey: Survey,
    name: str,
    latencies: Mapping[str, float],
    first: str,
    leads: Mapping[str, Mapping[str, Following]],
    pair: Pair | None,
) -> SensorGuess:
    noises, relations = {} if pair is None else pair.alignment.sd, survey.of_source(name)
    mirrored = [relation.slope < 0.0 for relation in relations.values() if abs(relation.correlation) >= FOLLOWS]
    scale = -1.0 if sum(mirrored) > len(mirrored) / 2 else 1.0
    biases = {axis: _bias(survey, axis, relation, scale, leads[axis]) for axis, relation in relations.items()}
    source = survey.run.sensors[name]
    sd = dict.fromkeys(source.values, _UNKNOWN_SD)
    for axis, relation in relations.items():  # how far a slow sensor moves from row to row is none of its noise
        alone = noise(survey.run.command, source, axis, relation.lag)
        sd[axis] = max(min(relation.scatter, alone, noises.get(axis, math.inf)), relation.resolution, _SMALLEST_SD)
    words = "DECIDE: how old a measurement is when it is stamped"
    if first == REFERENCE and name in latencies:
        words = "so much later than the reference, whose stamps are taken to be right"
    elif first and name != first and name in latencies:
        words = f"so much later than {first}; add how old a measurement of that one is"
    turns = survey.roles is not None and any(sensor.turns for sensor in survey.roles.sensors if sensor.name == name)
    gate = min(filter(None, (_gate(*source.series(axis)) for axis in source.values)), default=0.0)
    bias = {axis: size for axis, size in biases.items() if size}
    return SensorGuess(sd, bias, latencies.get(name, 0.0), words, scale, gate, turns, pair)


def _start(survey: Survey, axis: str, name: str, following: Following, misfit: float, travel: float) -> float | None:
    """Where an axis starts by its best sensor [m or rad]; None: at its first command, or nothing tells."""
    (told_at, told), (stamp, seen) = survey.run.command.series(axis), survey.run.measured[name].series(axis)
    near = int(np.argmin(np.abs(stamp - told_at[0])))
    if stamp[near] - told_at[0] > _SOON * max(following.lag, 0.0) * 1e9:
        return None
    level = math.copysign(1.0, following.slope) * (float(seen[near]) - following.offset)
    unsure = _AWAY * (misfit + following.scatter + following.resolution) + abs(abs(following.slope) - 1.0) * travel
    return level if abs(level - float(told[0])) > unsure else None


def _gate(stamp: TimeArray, value: FloatArray) -> float:
    """The gate for a sensor with such values: narrow for many outliers, wide for a few glitches, none for jerks."""
    if not len(value):
        return 0.0
    time = (stamp - stamp[0]) / 1e9
    is_isolated = isolated(time, value)
    if is_isolated.sum() >= _FEWEST_OUTLIERS and is_isolated.mean() > _OUTLIERS:
        return _GATE
    for every in range(1, _LONGEST_GLITCH + 1):  # by which a glitch of so many rows is one
        some = value[::every]
        rows = np.flatnonzero(isolated(time[::every], some))
        beside = 0.5 * (some[rows - 1] + some[rows + 1])
        if (np.abs(some[rows] - beside) > _FAR * np.ptp(np.delete(some, rows))).any():
            return _WIDE_GATE
    return 0.0


def _bias(survey: Survey, axis: str, following: Following, scale: float, others: Mapping[str, Following]) -> float:
    """The prior sd of a sensor's bias; 0 where its zero is near that of the commands and of better sensors."""
    value = survey.run.command.values[axis]
    travel = float(np.nanmax(value) - np.nanmin(value))
    noise = _DIFFERENT * (following.scatter + following.misfit)
    if scale < 0.0 or abs(following.offset) > max(0.5 * travel, noise):
        return 2.0 * max(abs(following.offset), noise)
    best = min(
        (other for other in others.values() if other.slope > 0.0), key=lambda other: other.scatter, default=following
    )
    apart = abs(following.offset - best.offset)
    return 2.0 * apart if apart > noise else 0.0
