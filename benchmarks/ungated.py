"""What somebody would write in an afternoon, for one axis and without a gate: filtered, as live and smoothed.

- Constant velocity and constant acceleration: white noise on the acceleration or on the jerk.
- LSQ+OU: delay, first-order lag, static gain and offset by least squares; an Ornstein-Uhlenbeck process is left.

Their noise and the sensor's are of maximum likelihood, in a Kalman filter and a Rauch-Tung-Striebel smoother. All takes
one candidate, or several side by side, which are then the last index of numbers and the first of matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from kinematic import Array, integrated, searched

Number = float | Array  # of one candidate, or of each, (c,)

SMALLEST_SD = 1e-3  # of a sensor [mm]; nothing else keeps it from 0
SETTLED = 1.0  # s after the first command: before, least squares would need to know how the axis came there


def matrices(number: Number) -> Array:
    """Numbers as matrices of one row and column."""
    return np.asarray(number)[..., None, None]


def transition(order: int, density: Number, time: Number, dt: Number) -> tuple[Array, Array]:
    """F and Q over ``dt`` [s]: an Ornstein-Uhlenbeck process for order 1, else white noise integrated so often."""
    if order == 1:
        Q = -0.5 * density**2 * time * np.expm1(-2.0 * dt / time)
        return matrices(np.exp(-dt / time)), matrices(Q)
    F, Q = integrated(order, np.asarray(dt))
    return F, matrices(density) ** 2 * Q


def run(F: Array, Q: Array, R: Array, x: Array, P: Array, value: Array, smooth: bool) -> tuple[Array, Array, Array]:
    """Log-likelihoods, states (n, ..., order, 1) and covariances; where ``value`` is NaN nothing is measured.

    ``F`` and ``Q`` lead to each of n instants from the one before.
    """
    n, total = len(value), np.zeros_like(R)
    covariances = np.empty(np.broadcast_shapes(F.shape, Q.shape))
    states = np.empty((*covariances.shape[:-1], 1))
    predicted, spreads = states.copy(), covariances.copy()
    for k in range(n):
        x, P = F[k] @ x, F[k] @ P @ F[k].mT + Q[k]
        predicted[k], spreads[k] = x, P
        if not math.isnan(value[k]):
            nu, S = value[k] - x[..., :1, :], P[..., :1, :1] + R
            K = P[..., :, :1] / S
            total -= 0.5 * (np.log(2.0 * math.pi * S) + nu * nu / S)
            x, P = x + K * nu, P - K * S * K.mT
        states[k], covariances[k] = x, P
    if smooth:
        C = np.linalg.solve(spreads[1:], F[1:] @ covariances[:-1]).mT
        for k in range(n - 2, -1, -1):
            states[k] += C[k] @ (states[k + 1] - predicted[k + 1])
            covariances[k] += C[k] @ (covariances[k + 1] - spreads[k + 1]) @ C[k].mT
    return total[..., 0, 0], states, covariances


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
    density: Number
    sd: Number
    time: Number = 1.0

    def _run(self, when: Array, value: Array, smooth: bool) -> tuple[Array, Array, Array]:
        measured = value[np.isfinite(value)]
        if self.order == 1:
            x, P = np.zeros((1, 1)), matrices(0.5 * self.density**2 * self.time)
        else:  # as good as unknown: a motion as wide as that of the run, in a tenth of a second
            x, P = np.zeros((self.order, 1)), np.diag(np.var(measured) * 100.0 ** np.arange(self.order))
            x[0] = measured[0]
        dt = np.diff(when, prepend=when[0]).reshape(-1, *[1] * np.ndim(self.density))
        F, Q = transition(self.order, self.density, self.time, dt)
        return run(F, Q, matrices(self.sd) ** 2, x, P, value, smooth)

    def likelihood(self, time: Array, value: Array) -> Array:
        """The log-likelihood of measurements [mm] valid at ``time`` [s]."""
        return self._run(time, value, False)[0]

    def estimate(self, time: Array, value: Array, at: Array, late: float = 0.0, smooth: bool = False) -> list[Array]:
        """Mean and standard deviation [mm] at ``at`` [s], from measurements at least ``late`` [s] old, or from all."""
        when = np.concatenate((time, at - late))
        order = np.argsort(when, kind="stable")  # at one instant measurements come first
        asked = np.argsort(order)[len(time) :]
        _, x, P = self._run(when[order], np.append(value, np.full(len(at), np.nan))[order], smooth)
        F, Q = transition(self.order, self.density, self.time, late)
        return [(F[:1] @ x[asked])[:, 0, 0], np.sqrt((F[:1] @ P[asked] @ F[:1].T)[:, 0, 0] + Q[0, 0])]


def likeliest(order: int, time: Array, value: Array) -> Process:
    """The process of maximum likelihood."""

    def process(numbers: Array) -> Process:
        return Process(order, *np.exp(numbers))

    wide = float(np.std(value))
    ranges = [(0.1 * wide, 1e4 * wide), (SMALLEST_SD, wide), *([(0.01, 100.0)] if order == 1 else [])]
    return process(searched(lambda numbers: -process(numbers).likelihood(time, value), ranges))


def lagged(time_constant: Array, time: Array, command: Array, at: Array) -> Array:
    """First-order responses to held commands at ``at``, (n, c), from rest at the first of them."""
    left = np.exp(-np.diff(time)[:, None] / time_constant)
    x = np.full((len(time), len(time_constant)), command[0])
    for n in range(len(time) - 1):
        x[n + 1] = command[n] + (x[n] - command[n]) * left[n]
    n = np.maximum(np.searchsorted(time, at, side="right") - 1, 0)
    left = np.exp(-np.maximum(at - time[n], 0.0) / time_constant)
    return command[n] + (x[n, np.arange(len(time_constant))] - command[n]) * left


@dataclass(frozen=True)
class Response:
    """Where commands lead: delay and time constant [s], static gain, offset [mm]."""

    delay: float
    time_constant: float
    gain: float
    offset: float

    def at(self, time: Array, command: Array, at: Array) -> Array:
        """The position [mm] at ``at`` [s]."""
        moved = lagged(np.array([self.time_constant]), time, command, at[:, None] - self.delay)
        return self.offset + self.gain * moved[:, 0]


def least_squares(time: Array, command: Array, when: Array, value: Array) -> Response:
    """The response that leaves the smallest squares of measurements [mm] valid at ``when`` [s]."""

    def fitted(numbers: Array) -> tuple[Array, ...]:
        delay, time_constant = np.exp(numbers)
        moved = lagged(time_constant, time, command, when[:, None] - delay)
        mean, level = np.mean(moved, axis=0), np.mean(value)
        off = value[:, None] - level
        gain = np.sum((moved - mean) * off, axis=0) / np.sum((moved - mean) ** 2, axis=0)
        rest = np.sum((off - gain * (moved - mean)) ** 2, axis=0)
        return rest, delay, time_constant, gain, level - gain * mean

    best = searched(lambda numbers: fitted(numbers)[0], [(1e-3, 0.5), (1e-3, 1.0)])
    return Response(*(float(one[0]) for one in fitted(best[:, None])[1:]))


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
