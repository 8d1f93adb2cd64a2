"""Nonlinear least squares on many trials at once, one trial in a row.

The unit response of a delay, q and p is compared with each row. Gain and zero are linear and always at their optimum
(variable projection). Gauss-Newton steps with Levenberg's damping fit each row by itself, or one plant to all rows
(:meth:`Batch.fit`). Each trial's own delay is eliminated from the normal equations, so that the work is proportional to
the number of trials.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from ..arrays import FloatArray, IntArray
from ..model.plants import unit_response
from .trials import Trial

Order = Literal[1, 2]

_ITERATIONS = 200
_CONVERGED = 1e-10  # relative decrease of the sum of squares: less moves nothing by 1e-5 standard deviations
_MOST_DAMPING = 1e12  # no step helps
_REACH = 1e-5  # of q: step of the numerical derivatives
_RIDGE = 1e-12  # of the diagonal, where a parameter has no effect
_NO_EFFECT = 1e-12  # of the largest effect that a delay could have: less is none


class Point(NamedTuple):
    """A response for each row: its shape (R, 3), residuals and response, projected (R, m), its amplitude (R,)."""

    shape: FloatArray
    residual: FloatArray
    unit: FloatArray
    amplitude: FloatArray

    @property
    def cost(self) -> FloatArray:
        """Weighted sum of squared residuals of each row, (R,)."""
        return np.einsum("ij,ij->i", self.residual, self.residual)


class Equations(NamedTuple):
    """Normal equations in q (and p) of each row with its delay eliminated."""

    shift: FloatArray  # Gauss-Newton step of the delay when q and p stay [s], (R,)
    coupling: FloatArray  # −∂delay/∂(q, p), (R, k)
    information: FloatArray  # (R, k, k)
    score: FloatArray  # (R, k)
    delay_sd: FloatArray  # of each delay under a given plant for unit noise, infinite where it has no effect, (R,)


@dataclass(frozen=True)
class Batch:
    """R trials, padded to one length m."""

    time: FloatArray  # [s] since the command, (R, m)
    position: FloatArray  # [m], (R, m)
    weight: FloatArray  # 0 where a trial has no sample, else the same for all its samples, (R, m)
    count: FloatArray  # samples of each, (R,)

    @staticmethod
    def of(trials: Sequence[Trial], weights: Sequence[float]) -> Batch:
        """Stack one or more trials, each with its weight."""
        count = [len(trial.time) for trial in trials]
        time, position, weight = (np.zeros((len(trials), max(count))) for _ in range(3))
        for row, (trial, n) in enumerate(zip(trials, count, strict=True)):
            time[row, :n], position[row, :n], weight[row, :n] = trial.time, trial.position, weights[row]
        return Batch(time, position, weight, np.array(count, dtype=np.float64))

    def take(self, rows: IntArray) -> Batch:
        """The trials of ``rows``, repeated where these repeat one."""
        return Batch(self.time[rows], self.position[rows], self.weight[rows], self.count[rows])

    def project(self, values: FloatArray) -> FloatArray:
        """Weighted values (R, m) without what a free zero explains."""
        mean = np.sum(np.where(self.weight > 0.0, values, 0.0), axis=1) / self.count
        return self.weight * (values - mean[:, None])

    def point(self, shape: FloatArray) -> Point:
        """The response of (delay, q, p) (R, 3) with the best amplitude and zero in each row."""
        c, z = self.project(_response(self.time, shape)), self.project(self.position)
        amplitude = np.einsum("ij,ij->i", c, z) / _power(c)
        return Point(shape, z - amplitude[:, None] * c, c, amplitude)

    def slopes(self, at: Point, order: Order) -> tuple[FloatArray, FloatArray]:
        """Derivatives by (delay, q, p) of the fitted response (k, R, m) and its amplitude (k, R); order 1 without p."""
        changes = [self.project(change) for change in sensitivity(self.time, at.shape, order)]
        raw = np.stack(changes) * at.amplitude[:, None]
        share = np.einsum("kij,ij->ki", raw, at.unit) / _power(at.unit)
        return raw - share[:, :, None] * at.unit, -share

    def equations(self, at: Point, slopes: FloatArray, damping: FloatArray | float = 0.0) -> Equations:
        """Normal equations of q and p with the delays eliminated, whose own steps are damped.

        A delay takes no part where it has no effect, or where its bound 0 is active.
        """
        squares = np.einsum("ij,ij->i", slopes[0], slopes[0])
        gradient = np.einsum("ij,ij->i", slopes[0], at.residual)
        largest = np.einsum("ij,ij->i", at.unit, at.unit) * (at.amplitude / at.shape[:, 1]) ** 2
        effective = squares > _NO_EFFECT * largest
        delay_sd = np.where(effective, 1.0 / np.sqrt(np.where(effective, squares, 1.0)), np.inf)
        at_bound = (at.shape[:, 0] <= 0.0) & (gradient <= 0.0)
        squares = np.where(at_bound | ~effective, np.inf, squares * (1.0 + damping))
        cross = np.einsum("ij,kij->ik", slopes[0], slopes[1:])
        coupling = cross / squares[:, None]
        information = np.einsum("kij,lij->ikl", slopes[1:], slopes[1:]) - cross[:, :, None] * coupling[:, None, :]
        score = np.einsum("kij,ij->ik", slopes[1:], at.residual) - coupling * gradient[:, None]
        return Equations(gradient / squares, coupling, information, score, delay_sd)

    def step(self, at: Point, order: Order, damping: FloatArray, low: FloatArray, high: FloatArray) -> Point:
        """After a step of each group of rows, whose ``damping`` is (R / size,), between ``low`` and ``high`` (3,)."""
        size = len(at.shape) // len(damping)
        slopes, _ = self.slopes(at, order)
        equations = self.equations(at, slopes, np.repeat(damping, size))
        information, score = _sum_groups(equations.information, size), _sum_groups(equations.score, size)
        plant = _damped_step(at.shape[::size, 1:], information, score, damping)
        plant = np.clip(np.repeat(plant, size, axis=0), low[1:], high[1:])
        plant[:, 0] = np.maximum(plant[:, 0], 0.2 * at.shape[:, 1])
        moved = (plant - at.shape[:, 1:])[:, :order]
        delay = at.shape[:, 0] + equations.shift - np.einsum("ij,ij->i", equations.coupling, moved)
        return self.point(np.column_stack((np.clip(delay, low[0], high[0]), plant)))

    def fit(self, start: FloatArray, order: Order, size: int = 1) -> Point:
        """The nearest minimum from ``start`` (R, 3): of each row by itself, or of one plant for each ``size`` rows.

        Rows that share a plant keep delays of their own.
        """
        end = self.time.max(axis=1)
        most, spacing = float(end.max()), (end - self.time[:, 0]) / (self.count - 1.0)
        low = np.array([0.0, 1e-3 * float(spacing.min()), 0.0])
        high = np.array([most, 20.0 * most, (5.0 * most) ** 2])
        point = self.point(np.clip(start, low, high))
        rows, damping = np.arange(len(start)), np.full(len(start) // size, 1e-3)

        for _ in range(_ITERATIONS):
            here, at = self.take(rows), Point(*(whole[rows] for whole in point))
            new = here.step(at, order, damping, low, high)
            cost = _sum_groups(at.cost, size)
            decrease = cost - _sum_groups(new.cost, size)
            better = decrease >= 0.0
            damping = np.where(better, np.maximum(0.2 * damping, 1e-12), 8.0 * damping)
            going = np.where(better, decrease > _CONVERGED * cost, damping < _MOST_DAMPING)
            better, kept = np.repeat(better, size), np.repeat(going, size)
            for whole, part in zip(point, new, strict=True):
                whole[rows[better]] = part[better]
            rows, damping = rows[kept], damping[going]
            if not len(rows):
                break
        return point


def sensitivity(time: FloatArray, shape: FloatArray, order: Order) -> list[FloatArray]:
    """Derivatives of the unit response at ``time`` (R, m) by (delay, q, p) of ``shape`` (R, 3); order 1 without p.

    The difference quotient of p is one-sided where p is 0.
    """
    q, p = shape[:, 1], shape[:, 2]
    size, sensitivity = _REACH * q, list[FloatArray]()
    ends = [(size, size), (size, size), (np.minimum(size * q, p), size * q)][: order + 1]
    for unit, (below, above) in zip(np.eye(3), ends, strict=False):
        low, high = _response(time, shape - below[:, None] * unit), _response(time, shape + above[:, None] * unit)
        sensitivity.append((high - low) / (above + below)[:, None])
    return sensitivity


def _response(time: FloatArray, shape: FloatArray) -> FloatArray:
    """The unit response of (delay, q, p) (R, 3) at ``time`` (R, m)."""
    return unit_response(time - shape[:, :1], shape[:, 1:2], shape[:, 2:])


def _sum_groups(values: FloatArray, size: int) -> FloatArray:
    """Sums over each ``size`` rows, (R / size, ...)."""
    return values.reshape(-1, size, *values.shape[1:]).sum(axis=1)


def _power(unit: FloatArray) -> FloatArray:
    """Sum of squares of each row, infinite where it is 0, for a division, (R,)."""
    power = np.einsum("ij,ij->i", unit, unit)
    return np.where(power > 0.0, power, np.inf)


def _damped_step(shape: FloatArray, H: FloatArray, g: FloatArray, damping: FloatArray) -> FloatArray:
    """Shapes after a damped Gauss-Newton step in each row; a parameter whose bound 0 is active stays."""
    k = g.shape[1]
    diagonal = np.einsum("ikk->ik", H)
    free = (shape[:, :k] > 0.0) | (g > 0.0)
    damped = H + np.where(diagonal > 0.0, (damping[:, None] + _RIDGE) * diagonal, 1.0)[:, :, None] * np.eye(k)
    damped = damped * (free[:, :, None] & free[:, None, :]) + ~free[:, :, None] * np.eye(k)
    stepped = shape.copy()
    stepped[:, :k] += np.linalg.solve(damped, (g * free)[:, :, None])[:, :, 0]
    return stepped
