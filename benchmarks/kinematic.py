"""Kalman filters that know nothing of the commands: constant velocity or constant acceleration, disturbed by noise.

What is constant is a random walk, exactly integrated between the irregular instants at which measurements are valid. Of
the sensors and of the start they know what pumafuse knows; their gate and their likelihood are pumafuse's, too, but for
this: a re-acquisition makes not the position alone uncertain but all of the motion, as it was before the first
measurement.
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
from pumafuse.filter.gate import RECENT_NS
from pumafuse.fusion.score import interpolated
from pumafuse.fusion.segments import build

Array = npt.NDArray[np.float64]
Whole = npt.NDArray[np.int64]

GATE = 5.0  # standard deviations
RECENT = RECENT_NS / 1e9
REST = (0.01, 0.1)  # m/s and m/s²: how well they know that the arm begins at rest; wider priors cost them up to 0.5 %
ORDERS = {"velocity": 2, "acceleration": 3}  # what is constant, and how many states the motion takes

# Where a search begins: all of a grid are tried, the best are followed downhill.
DENSITIES = np.log(10.0) * np.arange(-5.0, 4.01, 0.5)  # logarithms of the random walk's
SDS = np.log([0.3, 1.0, 3.0])  # and of the sensors' sds over the configured ones
STARTS = 4
REACH = 50.0  # the oracle's sds are at most so many times smaller or greater than the configured ones


class Known(NamedTuple):
    """What a filter is given of one axis.

    Attributes:
        scale: Of the position in each sensor's measurements.
        latency_sd: How far each sensor's latency wanders [s].
        bias: Which of the biases each sensor has, -1 for none.
        bias_sd: Of each bias before any measurement [m].
        start: Where the arm rests before the first command [m].
        start_sd: How well that is known [m].
        period: Two rejected measurements that agree are at least so far apart [s].
    """

    scale: Array
    latency_sd: Array
    bias: Whole
    bias_sd: Array
    start: float
    start_sd: float
    period: float


class Measured(NamedTuple):
    """Measurements of one axis in order: when each is valid [s since the first command], which sensor's, value [m]."""

    time: Array
    sensor: Whole
    value: Array


@numba.njit(cache=True, error_model="numpy")
def follow(order: int, numbers: Array, known: Known, measured: Measured, times: Array, position: Array) -> float:
    """Filter all measurements; write the position at each of ``times`` [m] and return the log-likelihood, m in mm.

    ``numbers`` are logarithms: of the density of the random walk, then of each sensor's sd [m]. The state is the
    position with its derivatives, ``order`` in all, and the biases. A rejected measurement counts as if it were at the
    gate.
    """
    size, density, sds = order + len(known.bias_sd), math.exp(2.0 * numbers[0]), np.exp(numbers[1:])
    x, P, H, K = np.zeros(size), np.zeros((size, size)), np.zeros(size), np.zeros(size)
    rejected, reacquired, fused = np.zeros((len(sds), 3)), np.zeros(len(sds)), np.full(len(sds), -np.inf)
    x[0], P[0, 0] = known.start, known.start_sd**2
    for i in range(1, order):
        P[i, i] = REST[i - 1] ** 2
    for i in range(order, size):
        P[i, i] = known.bias_sd[i - order] ** 2
    now, total, n = 0.0, 0.0, 0
    for k in range(len(measured.time)):
        while n < len(times) and times[n] < measured.time[k]:
            position[n] = ahead(x, order, times[n] - now)
            n += 1
        move(x, P, order, density, measured.time[k] - now)
        now, s = measured.time[k], measured.sensor[k]
        H[:] = 0.0
        H[0] = known.scale[s]
        if known.bias[s] >= 0:
            H[order + known.bias[s]] = 1.0
        R = sds[s] ** 2 + (known.scale[s] * x[1] * known.latency_sd[s]) ** 2
        nu, S = measured.value[k], R + spread(P, H, K)
        for i in range(size):
            nu -= H[i] * x[i]
        beyond, believed, again = abs(nu) > GATE * math.sqrt(S), False, False
        if beyond:
            nu_then, R_then, then = rejected[s]  # R is 0 where there is none
            dt = now - then
            again = R_then > 0.0 and dt < known.period
            motion = dt**2 * P[1, 1] + (density * dt**3 / 3.0 if order == 2 else density * dt**5 / 20.0)
            if order == 3:
                motion += dt**3 * P[1, 2] + 0.25 * dt**4 * P[2, 2]
            spread_between = R_then + R + known.scale[s] ** 2 * motion
            believed = R_then > 0.0 and not again and abs(nu - nu_then) <= GATE * math.sqrt(spread_between)
            for other in range(len(sds)):
                if other != s and now - fused[other] <= RECENT and reacquired[other] <= reacquired[s]:
                    believed = False
        if believed:
            P[0, 0] += (nu / known.scale[s]) ** 2
            for i in range(1, order):  # without commands the motion is as much in doubt as the position
                P[i, i] += REST[i - 1] ** 2
            reacquired[s] += 1
            S = R + spread(P, H, K)
        elif beyond and not again:
            rejected[s] = nu, R, now
        taken = believed or not beyond
        if taken:
            rejected[s, 1], fused[s] = 0.0, now
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
        measured: The measurements that pumafuse gets.
        sds: Of the sensors as configured [m].
    """

    name: str
    times: Array
    truth: Array
    known: Known
    measured: Measured
    sds: Array

    def follow(self, order: int, numbers: Array) -> tuple[Array, float]:
        """Positions [m] and the log-likelihood."""
        position = np.empty(len(self.times))
        return position, follow(order, numbers, self.known, self.measured, self.times, position)

    def held(self) -> list[Array]:
        """Each sensor's last measurement as a position [m], the start before the first; a bias is the first one's."""
        found: list[Array] = []
        for s, scale in enumerate(self.known.scale):
            valid, value = (values[self.measured.sensor == s] for values in (self.measured.time, self.measured.value))
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
    """The axes of a run that are measured and have a reference."""
    est, starts, period = pf.fuse(run, config), build(run, config).start, config.arm.update_period
    assert est.reference is not None
    found: dict[str, Axis] = {}
    for number, name in enumerate(est.measurements.axes):
        mine = est.measurements.where(
            (est.measurements.axis == number) & (est.measurements.outcome <= pf.Outcome.REACQUIRED)
        )
        used = np.unique(mine.sensor)
        if len(used) and name in est.reference.position:
            sensors = [config.sensors[est.measurements.sensors[s]] for s in used]
            numbers = [(s.scale, s.latency_sd, s.bias_sd, s.sd_of(name)) for s in sensors]
            scale, latency_sd, bias_sd, sds = np.array(numbers, dtype=np.float64).T.copy()
            biased = bias_sd > 0.0
            bias = np.where(biased, np.cumsum(biased) - 1, -1)
            known = Known(scale, latency_sd, bias, bias_sd[biased], starts[name], config.start.offset_sd, period)
            measured = Measured(mine.time, np.searchsorted(used, mine.sensor), mine.value)
            truth = interpolated(est.time, est.segment, est.reference, name)
            found[name] = Axis(name, est.time, truth, known, measured, sds)
    return found
