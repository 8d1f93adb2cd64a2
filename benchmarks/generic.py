"""What the commands are worth: pumafuse against filters that know nothing of them, as tables of errors.

    python benchmarks/generic.py [--only TEXT] [--json FILE]

The generic filters believe in constant velocity (white acceleration) or constant acceleration (white jerk), see the
readings that pumafuse sees and know of the sensors and of the start what it knows. All are tuned on the same run and
scored in the same way at the same instants, those of the commands; an estimate knows every reading valid by then.
"""

from __future__ import annotations

import argparse
import json
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numba
import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

import pumafuse as pf
from pumafuse.fusion.score import interpolated
from pumafuse.fusion.timeline import REOPEN_AFTER, REOPEN_SPAN_NS, build

Array = npt.NDArray[np.float64]
Config = pf.FusionConfig

HERE = Path(__file__).resolve().parent
DATA = Path(pf.__file__).parent / "data"
SCENARIOS = HERE.parent / "scenarios"
SERVO = HERE.parents[1] / "shared" / "data" / "servo"  # recordings that are not part of this repository
SEED = 1
GATE = 5.0  # standard deviations, for all filters and sensors
LEARNT = 40.0  # s; of the scan, where its end is held back
FASTEST, QUICKEST = 1.0, 10.0  # m/s and m/s²: what the generic filters take for possible at the start
KINDS = {"velocity": 2, "acceleration": 3}  # what is constant, and how many states the position takes
FITS = {"noise": ["noise"], "delay, plant": ["noise", "delay", "plant"], "gain": ["noise", "delay", "plant", "gain"]}
STARTS = 4  # of the search, the best of a grid
_GRID = np.log(10.0) * np.arange(-5.0, 4.01, 0.5)  # densities [m/s^(order - 1/2)]
_SDS = np.log([0.3, 1.0, 3.0])  # over those of the configuration


class Known(NamedTuple):
    """What a generic filter is told; of the S sensors scale, wander of the latency [s], and prior of the bias [m]."""

    scale: Array
    latency_sd: Array
    bias_sd: Array
    start: float
    start_sd: float


class Heard(NamedTuple):
    """The readings of one axis in order: when each is valid [s since the first command], which sensor's, value [m]."""

    time: Array
    sensor: npt.NDArray[np.int64]
    value: Array


@numba.njit(cache=True, error_model="numpy")
def follow(order: int, numbers: Array, known: Known, heard: Heard, times: Array, position: Array) -> float:
    """Filter all readings; writes the position at each of ``times`` [m] and returns the log-likelihood, m in mm.

    ``numbers`` are logarithms of the process's density and of each sensor's sd. The state is the position with its
    ``order`` - 1 derivatives, and the bias of every sensor; what is gated counts as if it were at the gate.
    """
    sensors = len(known.scale)
    size, density, sds = order + sensors, math.exp(2.0 * numbers[0]), np.exp(numbers[1:])
    x, P, H, K = np.zeros(size), np.zeros((size, size)), np.zeros(size), np.zeros(size)
    rejected, since = np.zeros(sensors), np.zeros(sensors)
    factorial = np.array([1.0, 1.0, 2.0])
    x[0], P[0, 0], P[1, 1] = known.start, known.start_sd**2, FASTEST**2
    if order == 3:
        P[2, 2] = QUICKEST**2
    for i in range(sensors):
        P[order + i, order + i] = known.bias_sd[i] ** 2
    now, total, n = 0.0, 0.0, 0
    for k in range(len(heard.time)):
        while n < len(times) and times[n] < heard.time[k]:
            position[n] = ahead(x, order, times[n] - now)
            n += 1
        dt = heard.time[k] - now
        now = heard.time[k]
        for i in range(order):  # rows from the top: those below are still of before
            for j in range(i + 1, order):
                f = dt ** (j - i) / factorial[j - i]
                x[i] += f * x[j]
                P[i] += f * P[j]
        for i in range(order):
            for j in range(i + 1, order):
                P[:, i] += dt ** (j - i) / factorial[j - i] * P[:, j]
        for i in range(order):
            for j in range(order):
                a, b = order - 1 - i, order - 1 - j
                P[i, j] += density * dt ** (a + b + 1) / (factorial[a] * factorial[b] * (a + b + 1))
        s = heard.sensor[k]
        H[:] = 0.0
        H[0], H[order + s] = known.scale[s], 1.0
        R = sds[s] ** 2 + (known.scale[s] * x[1] * known.latency_sd[s]) ** 2
        nu = heard.value[k] - known.scale[s] * x[0] - x[order + s]
        S = R + seen(P, H, K)
        beyond = abs(nu) > GATE * math.sqrt(S)
        if rejected[s] == 0:
            since[s] = now
        reopens = beyond and rejected[s] >= REOPEN_AFTER and now - since[s] >= REOPEN_SPAN_NS / 1e9
        rejected[s] = rejected[s] + 1 if beyond and not reopens else 0
        if reopens:
            P[0, 0] += nu * nu
            S = R + seen(P, H, K)
        square = GATE**2 if beyond and not reopens else nu * nu / S
        total -= 0.5 * (math.log(2.0e6 * math.pi * S) + square)
        if not beyond or reopens:
            for i in range(size):
                x[i] += K[i] / S * nu
                for j in range(size):
                    P[i, j] -= K[i] * K[j] / S
    for rest in range(n, len(times)):
        position[rest] = ahead(x, order, times[rest] - now)
    return total


@numba.njit(cache=True)
def ahead(x: Array, order: int, dt: float) -> float:
    """The position after ``dt`` [s]."""
    return x[0] + dt * x[1] + (0.5 * dt * dt * x[2] if order == 3 else 0.0)


@numba.njit(cache=True)
def seen(P: Array, H: Array, K: Array) -> float:
    """H P Hᵀ, and P Hᵀ into ``K``."""
    total = 0.0
    for i in range(len(H)):
        K[i] = 0.0
        for j in range(len(H)):
            K[i] += P[i, j] * H[j]
        total += H[i] * K[i]
    return total


@dataclass(frozen=True)
class Axis:
    """All that a generic filter gets of one axis of a run, and the truth to score it by [m], NaN where there is none."""

    name: str
    est: pf.Estimates
    known: Known
    heard: Heard
    sds: Array
    truth: Array

    def estimate(self, order: int, numbers: Array) -> tuple[Array, float]:
        """Positions at the instants of ``est`` [m] and the log-likelihood."""
        position = np.empty(len(self.est.time))
        return position, float(follow(order, numbers, self.known, self.heard, self.est.time, position))

    def held(self, since: float) -> float:
        """RMSE [m] of the best sensor's readings, each held until its next; a level nobody knows is of the first."""
        found = [math.inf]
        for s, scale in enumerate(self.known.scale):
            time, value = self.heard.time[self.heard.sensor == s], self.heard.value[self.heard.sensor == s]
            if len(time):
                level = value[0] - scale * self.known.start if self.known.bias_sd[s] > 0.0 else 0.0
                values = np.append(self.known.start, (value - level) / scale)
                found.append(self.rmse(values[np.searchsorted(time, self.est.time, side="right")], since))
        return min(found)

    def rmse(self, position: Array, since: float = 0.0) -> float:
        """On the reference from ``since`` on [m], by pumafuse's own score."""
        late, est = self.est.time >= since, self.est
        assert est.reference is not None
        parts = (values[late] for values in (est.time, est.segment, position, np.ones(len(position))))
        scored = pf.score(*parts, est.reference, self.name)
        return math.nan if scored is None else scored.rmse

    def tuned(self, order: int, best: Callable[[Array], float], also: Sequence[Array] = ()) -> Array:
        """The numbers for which ``best`` is smallest: the best of a grid (and ``also``), each followed downhill."""
        nominal = np.log(self.sds)
        grid = [np.concatenate(([q], nominal + sd)) for q, sd in product(_GRID, _SDS)]
        starts = [*also, *sorted(grid, key=best)[:STARTS]]
        found = [descend(best, start) for start in starts]
        return min(found, key=best)

    def likeliest(self, order: int) -> Array:
        """By maximum likelihood."""
        return self.tuned(order, lambda numbers: -self.estimate(order, numbers)[1])

    def closest(self, order: int, also: Array) -> Array:
        """By the truth itself, which no user has."""
        scored = np.isfinite(self.truth)
        truth = self.truth[scored]

        def error(numbers: Array) -> float:
            return float(np.sqrt(np.mean((self.estimate(order, numbers)[0][scored] - truth) ** 2)))

        return self.tuned(order, error, [also])


def descend(best: Callable[[Array], float], start: Array) -> Array:
    """Downhill by simplexes, the second one around what the first has found."""
    options = {"adaptive": True, "xatol": 1e-3, "fatol": 1e-9, "maxfev": 600, "initial_simplex": None}
    for size in (0.7, 0.2):
        options["initial_simplex"] = np.vstack((start, start + size * np.eye(len(start))))
        start = minimize(best, start, method="Nelder-Mead", options=options).x
    return start


def axes_of(run: pf.Run, config: Config, est: pf.Estimates) -> Iterator[Axis]:
    """The axes of a run that are heard and have a truth."""
    assert est.reference is not None
    starts = {axis.name: axis.start for axis in build(run, config).axes}
    for number, name in enumerate(est.readings.axes):
        mine = est.readings.where((est.readings.axis == number) & (est.readings.outcome <= pf.Outcome.REOPENED))
        told = np.unique(mine.sensor)
        sensors = [config.sensors[est.readings.sensors[s]] for s in told]
        if len(told) and name in est.reference.position:
            numbers = [np.array([getattr(s, key) for s in sensors]) for key in ("scale", "latency_sd", "bias_sd")]
            known = Known(*numbers, start=starts[name], start_sd=config.start.offset_sd)
            heard = Heard(mine.time, np.searchsorted(told, mine.sensor), mine.value)
            sds = np.array([sensor.sd_of(name) for sensor in sensors])
            yield Axis(name, est, known, heard, sds, interpolated(est.time, est.segment, est.reference, name))
