"""Kalman filters that know nothing of the commands: constant velocity or constant acceleration, disturbed by noise.

What is constant is a random walk, exactly integrated between the irregular instants at which measurements are valid. Of
the sensors and of the start they know what pumafuse knows; their gate and their likelihood are pumafuse's, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt
from scipy.optimize import differential_evolution, minimize

import pumafuse as pf
from pumafuse.fusion.outcome import REOPEN_AFTER, REOPEN_SPAN_NS
from pumafuse.fusion.score import interpolated
from pumafuse.fusion.timeline import build

Array = npt.NDArray[np.float64]
Whole = npt.NDArray[np.int64]

GATE = 5.0  # standard deviations
REOPEN_SPAN = REOPEN_SPAN_NS / 1e9
REST = (0.01, 0.1)  # m/s and m/s²: how well they know that the arm begins at rest; wider priors cost them up to 0.5 %
ORDERS = {"velocity": 2, "acceleration": 3}  # what is constant, and how many states the motion takes

# Where a search begins: all of a grid are tried, the best are followed downhill.
DENSITIES = np.log(10.0) * np.arange(-5.0, 4.01, 0.5)  # logarithms of the random walk's
SDS = np.log([0.3, 1.0, 3.0])  # and of the sensors' sds over the configured ones
STARTS = 4
REACH = 50.0  # the oracle's sds are at most so many times smaller or greater than the configured ones


class Known(NamedTuple):
    """What a filter is told of one axis.

    Attributes:
        scale: Of the position in each sensor's measurements.
        latency_sd: How far each sensor's latency wanders [s].
        bias: Which of the biases each sensor has, -1 for none.
        bias_sd: Of each bias before any measurement [m].
        start: Where the arm rests before the first command [m].
        start_sd: How well that is known [m].
    """

    scale: Array
    latency_sd: Array
    bias: Whole
    bias_sd: Array
    start: float
    start_sd: float


class Heard(NamedTuple):
    """The measurements of one axis in order: when each is valid [s since the first command], which sensor's, value [m]."""

    time: Array
    sensor: Whole
    value: Array


@numba.njit(cache=True, error_model="numpy")
def follow(order: int, numbers: Array, known: Known, heard: Heard, times: Array, position: Array) -> float:
    """Filter all measurements; write the position at each of ``times`` [m] and return the log-likelihood, m in mm.

    ``numbers`` are logarithms: of the density of the random walk, then of each sensor's sd [m]. The state is the
    position with its derivatives, ``order`` in all, and the biases. A rejected measurement counts as if it were at the
    gate.
    """
    size, density, sds = order + len(known.bias_sd), math.exp(2.0 * numbers[0]), np.exp(numbers[1:])
    x, P, H, K = np.zeros(size), np.zeros((size, size)), np.zeros(size), np.zeros(size)
    rejected, since = np.zeros(len(sds)), np.zeros(len(sds))
    x[0], P[0, 0] = known.start, known.start_sd**2
    for i in range(1, order):
        P[i, i] = REST[i - 1] ** 2
    for i in range(order, size):
        P[i, i] = known.bias_sd[i - order] ** 2
    now, total, n = 0.0, 0.0, 0
    for k in range(len(heard.time)):
        while n < len(times) and times[n] < heard.time[k]:
            position[n] = ahead(x, order, times[n] - now)
            n += 1
        move(x, P, order, density, heard.time[k] - now)
        now, s = heard.time[k], heard.sensor[k]
        H[:] = 0.0
        H[0] = known.scale[s]
        if known.bias[s] >= 0:
            H[order + known.bias[s]] = 1.0
        R = sds[s] ** 2 + (known.scale[s] * x[1] * known.latency_sd[s]) ** 2
        nu, S = heard.value[k], R + spread(P, H, K)
        for i in range(size):
            nu -= H[i] * x[i]
        beyond = abs(nu) > GATE * math.sqrt(S)
        if rejected[s] == 0:
            since[s] = now
        reopens = beyond and rejected[s] >= REOPEN_AFTER and now - since[s] >= REOPEN_SPAN
        rejected[s] = rejected[s] + 1 if beyond and not reopens else 0
        if reopens:
            P[0, 0] += nu * nu
            S = R + spread(P, H, K)
        taken = reopens or not beyond
        total -= 0.5 * (math.log(2.0e6 * math.pi * S) + (nu * nu / S if taken else GATE**2))
        for i in range(size if taken else 0):
            x[i] += K[i] / S * nu
            for j in range(size):
                P[i, j] -= K[i] * K[j] / S
    for rest in range(n, len(times)):
        position[rest] = ahead(x, order, times[rest] - now)
    return total


@numba.njit(cache=True)
def move(x: Array, P: Array, order: int, density: float, dt: float) -> None:
    """To ``dt`` [s] later: x⁺ = F x, P⁺ = F P Fᵀ + Q."""
    factorial = (1.0, 1.0, 2.0)
    for i in range(order):  # from the top: what is below is still of before
        for j in range(i + 1, order):
            f = dt ** (j - i) / factorial[j - i]
            x[i] += f * x[j]
            for column in range(len(x)):
                P[i, column] += f * P[j, column]
    for i in range(order):
        for j in range(i + 1, order):
            f = dt ** (j - i) / factorial[j - i]
            for row in range(len(x)):
                P[row, i] += f * P[row, j]
    for i in range(order):
        for j in range(order):
            a, b = order - 1 - i, order - 1 - j
            P[i, j] += density * dt ** (a + b + 1) / (factorial[a] * factorial[b] * (a + b + 1))


@numba.njit(cache=True)
def ahead(x: Array, order: int, dt: float) -> float:
    """The position ``dt`` [s] later [m]."""
    return x[0] + dt * x[1] + (0.5 * dt * dt * x[2] if order == 3 else 0.0)


@numba.njit(cache=True)
def spread(P: Array, H: Array, K: Array) -> float:
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
    """One axis of a run as these filters have it: the instants of estimates are those of pumafuse's.

    Attributes:
        name: The axis.
        times: Of estimates [s since the first command].
        truth: The reference then [m], NaN where there is none.
        known: What they know.
        heard: The measurements that pumafuse meets.
        sds: Of the sensors as configured [m].
    """

    name: str
    times: Array
    truth: Array
    known: Known
    heard: Heard
    sds: Array

    def follow(self, order: int, numbers: Array) -> tuple[Array, float]:
        """Positions [m] and the log-likelihood."""
        position = np.empty(len(self.times))
        return position, follow(order, numbers, self.known, self.heard, self.times, position)

    def held(self) -> list[Array]:
        """Each sensor's last measurement as a position [m], with the start before the first; a bias is the first one's."""
        found: list[Array] = []
        for s, scale in enumerate(self.known.scale):
            valid, value = (values[self.heard.sensor == s] for values in (self.heard.time, self.heard.value))
            level = value[0] - scale * self.known.start if self.known.bias[s] >= 0 else 0.0
            values = np.append(self.known.start, (value - level) / scale)
            found.append(values[np.searchsorted(valid, self.times, side="right")])
        return found

    def likeliest(self, order: int) -> Array:
        """The numbers of maximum likelihood: what ``pumafuse tune`` is to a generic filter."""

        def cost(numbers: Array) -> float:
            return -self.follow(order, numbers)[1]

        return self._search(cost)

    def closest(self, order: int, likeliest: Array) -> Array:
        """The numbers of the least error, which only the truth can tell; gates make many valleys, so by evolution."""
        scored = np.isfinite(self.truth)

        def rmse_mm(numbers: Array) -> float:
            return 1e3 * float(np.sqrt(np.mean((self.follow(order, numbers)[0] - self.truth)[scored] ** 2)))

        bounds = [(DENSITIES[0], DENSITIES[-1]), *((math.log(sd / REACH), math.log(sd * REACH)) for sd in self.sds)]
        evolved = differential_evolution(rmse_mm, bounds, popsize=12, maxiter=60, polish=False, rng=1).x
        return self._search(rmse_mm, likeliest, evolved)

    def _search(self, cost: Callable[[Array], float], *also: Array) -> Array:
        grid = [np.concatenate(([q], np.log(self.sds) + sd)) for q, sd in product(DENSITIES, SDS)]
        return min((descend(cost, start) for start in (*also, *sorted(grid, key=cost)[:STARTS])), key=cost)


def descend(cost: Callable[[Array], float], start: Array) -> Array:
    """Downhill by simplexes, the second one around what the first has found."""
    for size in (0.7, 0.2):
        simplex = np.vstack((start, start + size * np.eye(len(start))))
        options = {"initial_simplex": simplex, "adaptive": True, "xatol": 1e-3, "fatol": 1e-7, "maxfev": 600}
        start = minimize(cost, start, method="Nelder-Mead", options=options).x
    return start


def axes_of(run: pf.Run, config: pf.FusionConfig) -> dict[str, Axis]:
    """The axes of a run that are heard and have a truth."""
    est, starts = pf.fuse(run, config), {axis.name: axis.start for axis in build(run, config).axes}
    assert est.reference is not None
    found: dict[str, Axis] = {}
    for number, name in enumerate(est.measurements.axes):
        mine = est.measurements.where(
            (est.measurements.axis == number) & (est.measurements.outcome <= pf.Outcome.REACQUIRED)
        )
        used = np.unique(mine.sensor)
        if len(used) and name in est.reference.position:
            sensors = [config.sensors[est.measurements.sensors[s]] for s in used]
            told = [(s.scale, s.latency_sd, s.bias_sd, s.sd_of(name)) for s in sensors]
            scale, latency_sd, bias_sd, sds = np.array(told, dtype=np.float64).T.copy()
            biased = bias_sd > 0.0
            bias = np.where(biased, np.cumsum(biased) - 1, -1)
            known = Known(scale, latency_sd, bias, bias_sd[biased], starts[name], config.start.offset_sd)
            heard = Heard(mine.time, np.searchsorted(used, mine.sensor), mine.value)
            truth = interpolated(est.time, est.segment, est.reference, name)
            found[name] = Axis(name, est.time, truth, known, heard, sds)
    return found
