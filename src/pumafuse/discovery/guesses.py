"""Numbers of an arm and its sensors to begin with, from how the motions of a log follow each other."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from ..errors import RunError
from ..logs.run import Run
from ..units import Kind
from .contents import period_of
from .following import Following, isolated
from .sensors import REFERENCE, aligned, noise
from .survey import AHEAD, FOLLOWS, Survey

_DELAY_SHARE = 0.6  # of the lag; the PUMA's is 0.6, a servo's on a bus rather 0.75
_UNKNOWN_LAG = 0.1  # s, where nothing follows
_UNKNOWN_SD, _SMALLEST_SD = 1e-3, 1e-6  # m or rad
_OUTLIERS, _FEWEST_OUTLIERS = 3e-3, 3  # share and number from which a gate pays: one or two may be anything
_GATE = 5.0
_DIFFERENT = 5.0  # sds


@dataclass(frozen=True)
class AxisGuess:
    """An axis: lag [s] behind the held command, plant, and noise [m or rad].

    Attributes:
        kind: Whether it is a length or an angle.
        follows: The sensor from which it is known; empty: none.
        lag: Behind the held command at constant velocity [s].
        time_constant: Of the plant [s].
        gain: How far it moves when the command moves by 1.
        misfit: What the delayed command leaves.
        offset_sd: For ``[start]``.
        input_noise: Its density [m/√Hz].
        drift: Its density [m/√s].
    """

    kind: Kind
    follows: str
    lag: float
    time_constant: float
    gain: float
    misfit: float
    offset_sd: float
    input_noise: float
    drift: float


@dataclass(frozen=True)
class ArmGuess:
    """Update period and delay [s], and the axes."""

    period: float
    delay: float
    axes: Mapping[str, AxisGuess]


@dataclass(frozen=True)
class SensorGuess:
    """A sensor: noise and biases by axis [m or rad], latency [s] and where it is from, scale, gate (0: none needed).

    ``turns``: whether it measures angles within a turn.
    """

    sd: Mapping[str, float]
    bias: Mapping[str, float]
    latency: float
    latency_words: str
    scale: float
    gate: float
    turns: bool


def guess(found: Survey) -> tuple[ArmGuess, dict[str, SensorGuess]]:
    """The arm, and each sensor.

    Raises:
        RunError: There are fewer than two commands.
    """
    run = found.run
    period = period_of(run.command)
    if math.isnan(period):
        raise RunError(f"{found.log}: fewer than two commands with stamps of their own")
    relations = {key: one for key, one in found.relations.items() if abs(one.correlation) >= FOLLOWS}
    first, latencies, noises = _against_each_other(found.run, relations)
    leads = {
        axis: {name: relations[name, axis] for name in run.sensors if (name, axis) in relations} for axis in run.axes
    }
    # Behind the path through the commanded points a held command is late by half a period itself.
    lags = {
        axis: float(np.median([one.lag - latencies.get(name, 0.0) for name, one in mine.items()])) - 0.5 * period
        for axis, mine in leads.items()
        if mine
    }
    shortest = max(min(lags.values(), default=_UNKNOWN_LAG), 0.0)
    delay = _DELAY_SHARE * shortest
    axes = {axis: _axis(found, axis, leads[axis], lags.get(axis, _UNKNOWN_LAG), delay) for axis in run.axes}
    sensors = {name: _sensor(found, name, latencies, first, leads, noises.get(name, {})) for name in run.sensors}
    return ArmGuess(period, delay, axes), sensors


def _against_each_other(
    run: Run, relations: Mapping[tuple[str, str], Following]
) -> tuple[str, dict[str, float], dict[str, Mapping[str, float]]]:
    """The source that is earliest, the reference if there is one; how much later each is [s]; noise by axis [m or rad].

    Without sensors that have no motion in common with the one that has the most rows.
    """
    lags: dict[str, list[float]] = {}
    for (name, _), one in relations.items():
        lags.setdefault(name, []).append(one.lag)
    if not lags:
        return "", {}, {}
    base = REFERENCE if REFERENCE in lags else max(lags, key=lambda name: len(run.sensors[name].stamp))
    pairs = {name: aligned([run], base, name) for name in lags if name != base}
    later = {base: 0.0, **{name: one.latency for name, one in pairs.items() if one is not None}}
    first = base if base == REFERENCE else min(later, key=later.__getitem__)
    ahead = float(np.median(lags[first]))
    ahead = ahead if ahead < -AHEAD else 0.0
    latencies = {name: ahead + max(late - later[first], 0.0) for name, late in later.items()}
    return first, latencies, {name: one.sd for name, one in pairs.items() if one is not None}


def _axis(found: Survey, axis: str, followers: Mapping[str, Following], lag: float, delay: float) -> AxisGuess:
    best = max(followers, key=lambda name: abs(followers[name].correlation), default="")
    travel = float(np.nanmax(found.run.command.values[axis]) - np.nanmin(found.run.command.values[axis]))
    one = followers.get(best)
    misfit = max(one.misfit if one else 0.02 * travel, _SMALLEST_SD)
    offset = min((abs(one.offset) for one in followers.values()), default=0.0)
    rest = max(lag - delay, 0.2 * lag, 1e-3)
    return AxisGuess(
        kind=found.run.kinds.get(axis, "length"),
        follows=best,
        lag=max(lag, delay + rest),
        time_constant=rest,
        gain=abs(one.slope) if one else 1.0,
        misfit=misfit,
        offset_sd=max(3.0 * misfit, 2.0 * offset if offset < 0.5 * travel else 0.0),
        input_noise=misfit * math.sqrt(rest),
        drift=0.5 * misfit,
    )


def _sensor(
    found: Survey,
    name: str,
    latencies: Mapping[str, float],
    first: str,
    leads: Mapping[str, Mapping[str, Following]],
    noises: Mapping[str, float],
) -> SensorGuess:
    relations = {axis: found.relations.get((name, axis)) for axis in found.run.sensors[name].values}
    known = {axis: one for axis, one in relations.items() if one is not None}
    mirrored = [one.slope < 0.0 for one in known.values() if abs(one.correlation) >= FOLLOWS]
    scale = -1.0 if sum(mirrored) > len(mirrored) / 2 else 1.0
    bias = {axis: size for axis, one in known.items() if (size := _bias(found, axis, one, scale, leads[axis]))}
    sd = dict.fromkeys(relations, _UNKNOWN_SD)
    sd |= {axis: _noise(found, name, axis, one, noises.get(axis, math.inf)) for axis, one in known.items()}
    words = "DECIDE: how old a measurement is when it is stamped"
    if first == REFERENCE and name in latencies:
        words = "so much later than the reference, whose stamps are taken to be right"
    elif first and name != first and name in latencies:
        words = f"so much later than {first}; add how old a measurement of that one is"
    turns = found.roles is not None and any(one.turns for one in found.roles.sensors if one.name == name)
    gate = _GATE if any(map(_has_outliers, found.run.sensors[name].values.values())) else 0.0
    return SensorGuess(sd, bias, latencies.get(name, 0.0), words, scale, gate, turns)


def _noise(found: Survey, name: str, axis: str, one: Following, beside: float) -> float:
    """The least of three estimates [m or rad]: how far a slow sensor moves from row to row is none of its noise.

    By its differences, beside the path that it tells itself, and beside that of another sensor.
    """
    alone = noise(found.run.command, found.run.sensors[name], axis, one.lag)
    return max(min(one.scatter, alone, beside), one.resolution, _SMALLEST_SD)


def _has_outliers(value: FloatArray) -> bool:
    """Whether a gate pays: values that leave their neighbours and are back at once are more than a few."""
    value = value[np.isfinite(value)]
    count = int(isolated(value).sum())
    return count >= _FEWEST_OUTLIERS and count > _OUTLIERS * len(value)


def _bias(found: Survey, axis: str, one: Following, scale: float, others: Mapping[str, Following]) -> float:
    """The prior sd of a sensor's bias: where its zero is far from the commands', or from a better sensor's; 0: none."""
    value = found.run.command.values[axis]
    travel = float(np.nanmax(value) - np.nanmin(value))
    noise = _DIFFERENT * (one.scatter + one.misfit)
    if scale < 0.0 or abs(one.offset) > max(0.5 * travel, noise):
        return 2.0 * max(abs(one.offset), noise)
    best = min((other for other in others.values() if other.slope > 0.0), key=lambda other: other.scatter, default=one)
    apart = abs(one.offset - best.offset)
    return 2.0 * apart if apart > noise else 0.0
