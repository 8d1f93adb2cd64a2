"""What somebody would write in an afternoon, for one axis and without a gate: filtered, as live and smoothed.

- Constant velocity and constant acceleration: white noise on the acceleration or on the jerk.
- LSQ+OU: delay, first-order lag, static gain and offset by least squares; an Ornstein-Uhlenbeck process is left.

Their noise and the sensor's are of maximum likelihood, in a Kalman filter and a Rauch-Tung-Striebel smoother.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numba
import numpy as np
from kinematic import Array, descend

SMALLEST_SD = 1e-3  # of a sensor [mm]; nothing else keeps it from 0
STARTS = 3  # of a grid, those that are followed downhill
SETTLED = 1.0  # s after the first command: before, least squares would need to know how the axis came there


@numba.njit(cache=True)
def transition(order: int, density: float, time: float, dt: float) -> tuple[Array, Array]:
    """F and Q over ``dt`` [s]: an Ornstein-Uhlenbeck process for order 1, else white noise integrated so often."""
    F, Q = np.eye(order), np.zeros((order, order))
    if order == 1:
        F[0, 0] = math.exp(-dt / time)
        Q[0, 0] = -0.5 * density**2 * time * math.expm1(-2.0 * dt / time)
        return F, Q
    factorial = (1.0, 1.0, 2.0)
    for i in range(order):
        for j in range(order):
            if j > i:
                F[i, j] = dt ** (j - i) / factorial[j - i]
            a, b = order - 1 - i, order - 1 - j
            Q[i, j] = density**2 * dt ** (a + b + 1) / (factorial[a] * factorial[b] * (a + b + 1))
    return F, Q


@numba.njit(cache=True)
def run(
    order: int, density: float, time: float, sd: float, x: Array, P: Array, when: Array, value: Array, smooth: bool
) -> tuple[float, Array, Array]:
    """Log-likelihood, states (n, order) and covariances at ``when``; where ``value`` is NaN nothing is measured."""
    n, total = len(when), 0.0
    states, covariances = np.empty((n, order)), np.empty((n, order, order))
    predicted, spreads, steps = states.copy(), covariances.copy(), covariances.copy()
    for k in range(n):
        F, Q = transition(order, density, time, when[k] - when[max(k - 1, 0)])
        x, P = F @ x, F @ P @ F.T + Q
        steps[k], predicted[k], spreads[k] = F, x, P
        if not math.isnan(value[k]):
            nu, S, K = value[k] - x[0], P[0, 0] + sd**2, P[:, 0] / (P[0, 0] + sd**2)
            total -= 0.5 * (math.log(2.0 * math.pi * S) + nu * nu / S)
            x, P = x + K * nu, P - np.outer(K, K) * S
        states[k], covariances[k] = x, P
    for k in range(n - 2 if smooth else -1, -1, -1):
        C = np.linalg.solve(spreads[k + 1], steps[k + 1] @ covariances[k]).T
        states[k] += C @ (states[k + 1] - predicted[k + 1])
        covariances[k] += C @ (covariances[k + 1] - spreads[k + 1]) @ C.T
    return total, states, covariances


@dataclass(frozen=True)
class Process:
    """What a position, or what is left of it, is taken for.

    Attributes:
        order: As in :func:`transition`.
        density: Of its white noise [mm/s^(order - 1/2)].
        sd: Of a measurement [mm].
        time: After which an Ornstein-Uhlenbeck process has forgotten [s].
    """

    order: int
    density: float
    sd: float
    time: float = 1.0

    def _run(self, when: Array, value: Array, smooth: bool) -> tuple[float, Array, Array]:
        measured = value[np.isfinite(value)]
        if self.order == 1:
            x, P = np.zeros(1), np.array([[0.5 * self.density**2 * self.time]])
        else:  # as good as unknown: a motion as wide as that of the run, in a tenth of a second
            x, P = np.zeros(self.order), np.diag(np.var(measured) * 100.0 ** np.arange(self.order))
            x[0] = measured[0]
        return run(self.order, self.density, self.time, self.sd, x, P, when, value, smooth)

    def likelihood(self, time: Array, value: Array) -> float:
        """The log-likelihood of measurements [mm] valid at ``time`` [s]."""
        return self._run(time, value, False)[0]

    def estimate(self, time: Array, value: Array, at: Array, late: float = 0.0, smooth: bool = False) -> list[Array]:
        """Mean and standard deviation [mm] at ``at`` [s], from measurements at least ``late`` [s] old, or from all."""
        when = np.concatenate((time, at - late))
        order = np.argsort(when, kind="stable")  # at one instant measurements come first
        asked = np.argsort(order)[len(time) :]
        _, x, P = self._run(when[order], np.append(value, np.full(len(at), np.nan))[order], smooth)
        F, Q = transition(self.order, self.density, self.time, late)
        return [x[asked] @ F[0], np.sqrt(np.einsum("i,kij,j->k", F[0], P[asked], F[0]) + Q[0, 0])]


def likeliest(order: int, time: Array, value: Array) -> Process:
    """The process of maximum likelihood."""
    wide = float(np.std(value))

    def process(numbers: Array) -> Process:
        density, sd, forgets = np.exp(np.clip(numbers, -20.0, 20.0)).tolist()
        return Process(order, density, max(sd, SMALLEST_SD), min(max(forgets, 0.01), 100.0))

    def cost(numbers: Array) -> float:
        return -process(numbers).likelihood(time, value)

    densities, sds = wide * 10.0 ** np.arange(-1.0, 4.0, 0.5), wide * np.array([0.003, 0.03, 0.3])
    grid = np.log(list(product(densities, sds, [0.1, 1.0] if order == 1 else [1.0])))
    return process(min((descend(cost, start) for start in sorted(grid, key=cost)[:STARTS]), key=cost))


@numba.njit(cache=True)
def lagged(time_constant: float, time: Array, command: Array, at: Array) -> Array:
    """A first-order response to held commands at ``at``, ascending, from rest at the first of them."""
    found, x, n = np.empty(len(at)), command[0], 0
    for k in range(len(at)):
        while n + 1 < len(time) and time[n + 1] <= at[k]:
            x = command[n] + (x - command[n]) * math.exp((time[n] - time[n + 1]) / time_constant)
            n += 1
        found[k] = command[n] + (x - command[n]) * math.exp(-max(at[k] - time[n], 0.0) / time_constant)
    return found


@dataclass(frozen=True)
class Response:
    """Where commands lead: delay and time constant [s], static gain, offset [mm]."""

    delay: float
    time_constant: float
    gain: float
    offset: float

    def at(self, time: Array, command: Array, at: Array) -> Array:
        """The position [mm] at ``at`` [s]."""
        return self.offset + self.gain * lagged(self.time_constant, time, command, at - self.delay)


def least_squares(time: Array, command: Array, when: Array, value: Array) -> Response:
    """The response that leaves the smallest squares of measurements [mm] valid at ``when`` [s]."""

    def solved(numbers: Array) -> tuple[float, Response]:
        delay, time_constant = 0.05 * max(numbers[0], 0.0), math.exp(min(max(numbers[1], -7.0), 7.0))
        columns = np.stack((lagged(time_constant, time, command, when - delay), np.ones(len(when))), axis=1)
        gain, offset = np.linalg.lstsq(columns, value)[0].tolist()
        return float(np.sum((value - columns @ [gain, offset]) ** 2)), Response(delay, time_constant, gain, offset)

    def cost(numbers: Array) -> float:
        return solved(numbers)[0]

    grid = [np.array(start) for start in product(np.arange(7.0), np.log([0.02, 0.1, 0.3]))]
    return solved(min((descend(cost, start) for start in sorted(grid, key=cost)[:STARTS]), key=cost))[1]


@dataclass(frozen=True)
class Regression:
    """LSQ+OU: a response, and a process for what it leaves."""

    response: Response
    rest: Process

    @staticmethod
    def fit(time: Array, command: Array, when: Array, value: Array) -> Regression:
        """On commands [mm] and measurements [mm] valid at ``when`` [s]."""
        settled = when > time[0] + SETTLED
        when, value = when[settled], value[settled]
        response = least_squares(time, command, when, value)
        return Regression(response, likeliest(1, when, value - response.at(time, command, when)))
