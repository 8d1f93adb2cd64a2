"""Kalman filters that know nothing of the commands: constant velocity or constant acceleration, disturbed by noise.

What is constant is a random walk, exactly integrated between the irregular instants at which measurements are valid. Of
the sensors and of the start they know what pumafuse knows; their gate and their likelihood are pumafuse's, too, but for
this: a re-acquisition makes not the position alone uncertain but all of the motion, as it was before the first
measurement. Filters with different noise run side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import differential_evolution

import pumafuse as pf
from pumafuse.fusion.score import interpolate
from pumafuse.fusion.segments import build_segment

Array = npt.NDArray[np.float64]
Whole = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Cost = Callable[[Array], Array]  # of c candidates with d logarithms each, (d, c) to (c,)

GATE = 5.0  # standard deviations
RECENT = 0.5  # s, as in core/gate.hpp
REST = (0.01, 0.1)  # m/s and m/s²: how well they know that the arm begins at rest; wider priors cost them up to 0.5 %
ORDERS = {"velocity": 2, "acceleration": 3}  # what is constant, and how many states the motion takes

DENSITIES = (1e-5, 1e4)  # of the random walk: where a search looks
REACH = 50.0  # and by how much sds are smaller or greater than the configured ones


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


class Filters:
    """Filters side by side, each with noise of its own; they are the last index of all arrays.

    The state is the position with its derivatives, ``order`` in all, and the biases.
    """

    def __init__(self, order: int, numbers: Array, known: Known) -> None:
        """Before the first command; ``numbers`` as in :func:`follow`."""
        self.order, self.known, self.density, self.R = order, known, np.exp(2.0 * numbers[0]), np.exp(2.0 * numbers[1:])
        prior = np.array([known.start_sd, *REST[: order - 1], *known.bias_sd])
        size, shape = len(prior), self.R.shape
        self.x, self.P = np.zeros((size, shape[1])), np.zeros((size, size, shape[1]))
        self.x[0], self.P[np.diag_indices(size)] = known.start, prior[:, None] ** 2
        self.H = np.zeros((len(known.scale), size))
        self.H[:, 0], biased = known.scale, known.bias >= 0
        self.H[biased, order + known.bias[biased]] = 1.0
        # Of each sensor: the last rejected measurement, whose R is 0 where there is none; what was fused, re-acquired.
        self.nu, self.r, self.then, self.reacquired = (np.zeros(shape) for _ in range(4))
        self.fused = np.full(shape, -np.inf)

    def predict(self, F: Array, Q: Array) -> None:
        """x⁺ = F x, P⁺ = F P Fᵀ + Q; ``Q`` is of the motion, for a density of 1."""
        self.x, FP = F @ self.x, (F @ self.P.reshape(len(F), -1)).reshape(self.P.shape)
        self.P = F @ FP
        self.P[: self.order, : self.order] += Q[..., None] * self.density

    def measure(self, s: int, now: float, z: float) -> tuple[Array, Array]:
        """A measurement of sensor ``s``: S, and ν²/S, which for a rejected one is that at the gate."""
        scale, H, R = self.known.scale[s], self.H[s], self.R[s]
        if self.known.latency_sd[s]:
            R = R + (scale * self.x[1] * self.known.latency_sd[s]) ** 2
        nu, (PH, S) = z - H @ self.x, self.along(H, R)
        beyond = nu * nu > GATE**2 * S
        if beyond.any():
            believed = self.doubt(s, now, nu, R, beyond)
            self.P[0, 0] += believed * (nu / scale) ** 2
            for i in range(1, self.order):  # without commands the motion is as much in doubt as the position
                self.P[i, i] += believed * REST[i - 1] ** 2
            PH, S = self.along(H, R)
            taken = believed | ~beyond
            K, distance = taken * PH / S, np.where(taken, nu * nu / S, GATE**2)
            self.r[s, taken], self.fused[s, taken] = 0.0, now
        else:
            K, distance = PH / S, nu * nu / S
            self.r[s], self.fused[s] = 0.0, now
        self.x += K * nu
        self.P -= K * PH[:, None]
        return S, distance

    def along(self, H: Array, R: Array) -> tuple[Array, Array]:
        """P Hᵀ and S = H P Hᵀ + R."""
        PH = (H @ self.P.reshape(len(H), -1)).reshape(self.x.shape)
        return PH, H @ PH + R

    def doubt(self, s: int, now: float, nu: Array, R: Array, beyond: Mask) -> Mask:
        """Which re-acquire by a measurement beyond the gate; the others keep it in mind."""
        before, dt, P = beyond & (self.r[s] > 0.0), now - self.then[s], self.P
        again = before & (dt < self.known.period)
        motion = dt**2 * P[1, 1] + self.density * (dt**3 / 3.0 if self.order == 2 else dt**5 / 20.0)
        if self.order == 3:
            motion += dt**3 * P[1, 2] + 0.25 * dt**4 * P[2, 2]
        between = self.r[s] + R + self.known.scale[s] ** 2 * motion
        believed = before & ~again & ((nu - self.nu[s]) ** 2 <= GATE**2 * between)
        for other in range(len(self.R)):
            if other != s:
                believed &= (now - self.fused[other] > RECENT) | (self.reacquired[other] > self.reacquired[s])
        rejected = beyond & ~believed & ~again
        self.nu[s, rejected], self.r[s, rejected], self.then[s, rejected] = nu[rejected], R[rejected], now
        self.reacquired[s] += believed
        return believed


def follow(order: int, numbers: Array, known: Known, measured: Measured, times: Array) -> tuple[Array, Array]:
    """Filter all measurements with c filters.

    Args:
        order: How many states the motion takes.
        numbers: Logarithms: of the density of the random walk, then of each sensor's sd [m], (1 + sensors, c).
        known: Of the axis.
        measured: The measurements.
        times: Of the positions [s], ascending, (n,).

    Returns:
        Positions [m], (n, c), and log-likelihoods, m in mm, (c,). A rejected measurement counts as if it were at the
        gate.
    """
    filters, rows = Filters(order, numbers, known), len(measured.time)
    F, Q = np.tile(np.eye(len(filters.x)), (rows, 1, 1)), np.zeros((rows, order, order))
    F[:, :order, :order], Q[:] = integrated(order, np.diff(measured.time, prepend=0.0))
    motion, S = np.empty((rows + 1, *filters.x[:order].shape)), np.empty((rows, numbers.shape[1]))
    motion[0], distance = filters.x[:order], np.empty_like(S)
    columns = (column.tolist() for column in (measured.sensor, measured.time, measured.value))
    for k, (s, now, z) in enumerate(zip(*columns, strict=True)):
        filters.predict(F[k], Q[k])
        S[k], distance[k] = filters.measure(s, now, z)
        motion[k + 1] = filters.x[:order]
    last = np.searchsorted(measured.time, times, side="right")
    ahead, _ = integrated(order, times - np.append(0.0, measured.time)[last])
    position = np.sum(ahead[:, 0, :, None] * motion[last], axis=1)
    return position, -0.5 * np.sum(np.log(2.0e6 * np.pi * S) + distance, axis=0)


def integrated(order: int, dt: Array) -> tuple[Array, Array]:
    """F and Q over each ``dt`` [s] of white noise of density 1 that is integrated so often, (..., order, order)."""
    factorial = (1.0, 1.0, 2.0)
    F, Q = np.zeros((*dt.shape, order, order)), np.zeros((*dt.shape, order, order))
    for i in range(order):
        for j in range(order):
            a, b = order - 1 - i, order - 1 - j
            Q[..., i, j] = dt ** (a + b + 1) / (factorial[a] * factorial[b] * (a + b + 1))
            if j >= i:
                F[..., i, j] = dt ** (j - i) / factorial[j - i]
    return F, Q


def searched(cost: Cost, ranges: Sequence[tuple[float, float]], begin: Array | None = None) -> Array:
    """The logarithms of numbers, each in its range, that have the least cost, (d,).

    By evolution: gates make many valleys, and candidates of one generation are filtered side by side. ``begin`` is
    among the first.
    """
    many = {"popsize": 15, "vectorized": True, "updating": "deferred"}
    end = {"tol": 1e-9, "maxiter": 60, "polish": False}
    return differential_evolution(cost, np.log(ranges), x0=begin, rng=1, **many, **end).x


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

    def position(self, order: int, numbers: Array) -> Array:
        """Positions [m] by one filter."""
        return follow(order, numbers[:, None], self.known, self.measured, self.times)[0][:, 0]

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
        return self._searched(lambda numbers: -follow(order, numbers, self.known, self.measured, self.times[:0])[1])

    def closest(self, order: int, likeliest: Array) -> Array:
        """The numbers of the least error, which only the truth can tell."""
        scored = np.isfinite(self.truth)
        times, truth = self.times[scored], self.truth[scored, None]

        def rmse(numbers: Array) -> Array:
            return np.sqrt(np.mean((follow(order, numbers, self.known, self.measured, times)[0] - truth) ** 2, axis=0))

        return self._searched(rmse, likeliest)

    def _searched(self, cost: Cost, begin: Array | None = None) -> Array:
        return searched(cost, [DENSITIES, *((sd / REACH, sd * REACH) for sd in self.sds)], begin)


def axes_of(run: pf.Run, config: pf.FusionConfig) -> dict[str, Axis]:
    """The axes of a run that are measured and have a reference."""
    est, starts, period = pf.fuse(run, config), build_segment(run, config).start, config.arm.update_period
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
            truth = interpolate(est.time, est.segment, est.reference, name)
            found[name] = Axis(name, est.time, truth, known, measured, sds)
    return found
