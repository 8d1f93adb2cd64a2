"""Trials side by side, one in a row, and least squares in all of them at once.

A response of any delay, q and p is compared with each row; gain and zero are linear and always at their best (variable
projection). Least squares by Gauss-Newton steps with Levenberg's damping, in each row by itself (:meth:`Rows.each`) or
with one plant for all (:meth:`Rows.together`, where what belongs to one trial alone is eliminated from its equations:
the work grows with the trials and no faster).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from ..arrays import FloatArray, IntArray
from ..model.unit_response import unit_response
from .trials import Trial

Order = Literal[1, 2]

_ITERATIONS = 200
_CONVERGED = 1e-13  # relative fall of the sum of squares
_HOPELESS = 1e12  # damping at which no step helps
_REACH = 1e-5  # of q: how far apart responses are for a slope
_RIDGE = 1e-12  # of the diagonal, where a parameter tells nothing
_TOLD = 1e-12  # of what a delay could tell, below which it tells nothing


class Point(NamedTuple):
    """A response for each row: its shape (R, 3), what it leaves and itself, projected (R, m), its amplitude (R,)."""

    shape: FloatArray
    left: FloatArray
    unit: FloatArray
    amplitude: FloatArray

    @property
    def cost(self) -> FloatArray:
        """Weighted sum of squares of each row, (R,)."""
        return np.einsum("ij,ij->i", self.left, self.left)


class Equations(NamedTuple):
    """Normal equations in q (and p) of each row with its delay eliminated.

    Attributes:
        shift: Of the delay when q and p stay [s], (R,).
        coupling: −∂delay/∂(q, p), (R, k).
        information: (R, k, k).
        score: (R, k).
        delay_sd: Of each delay under a given plant, for noise of 1; infinite where it tells nothing, (R,).
    """

    shift: FloatArray
    coupling: FloatArray
    information: FloatArray
    score: FloatArray
    delay_sd: FloatArray


@dataclass(frozen=True)
class Rows:
    """R trials, padded to one length m.

    Attributes:
        time: [s] since the command, (R, m).
        position: [m], (R, m).
        weight: 0 where a trial has no sample, else the same for all its samples, (R, m).
        count: Samples of each, (R,).
    """

    time: FloatArray
    position: FloatArray
    weight: FloatArray
    count: FloatArray

    @staticmethod
    def of(trials: Sequence[Trial], weights: Sequence[float], samples: int | None) -> Rows:
        """Stack trials.

        Args:
            trials: At least one.
            weights: Of each.
            samples: Use only so many from each step on; all for None.
        """
        windows = [window(trial, samples) for trial in trials]
        longest = max(len(time) for time, _ in windows)
        time, position, weight = (np.zeros((len(trials), longest)) for _ in range(3))
        for row, (t, z) in enumerate(windows):
            time[row, : len(t)], position[row, : len(t)], weight[row, : len(t)] = t, z, weights[row]
        return Rows(time, position, weight, np.array([float(len(t)) for t, _ in windows]))

    def taken(self, rows: IntArray) -> Rows:
        """Some of the rows, again where an index is repeated."""
        return Rows(self.time[rows], self.position[rows], self.weight[rows], self.count[rows])

    @property
    def span(self) -> FloatArray:
        """Time of each last sample [s], (R,)."""
        return self.time.max(axis=1)

    @property
    def spacing(self) -> FloatArray:
        """Mean time between samples [s], (R,)."""
        return (self.span - self.time[:, 0]) / (self.count - 1.0)

    def point(self, shape: FloatArray) -> Point:
        """The best response of a shape (delay, q, p) for each row, (R, 3)."""
        c = self.projected(self._response(shape, 0.0, 0.0, 0.0))
        z = self.projected(self.position)
        power = np.einsum("ij,ij->i", c, c)
        amplitude = np.einsum("ij,ij->i", c, z) / np.where(power > 0.0, power, np.inf)
        return Point(shape, z - amplitude[:, None] * c, c, amplitude)

    def projected(self, values: FloatArray) -> FloatArray:
        """Weighted, and without what a free zero explains, (R, m)."""
        mean = np.sum(np.where(self.weight > 0.0, values, 0.0), axis=1) / self.count
        return self.weight * (values - mean[:, None])

    def slopes(
        self, at: Point, order: Order, chord: tuple[FloatArray, FloatArray] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """∂/∂(delay, q, p) of the fitted response, (k, R, m), and how the amplitude follows each, (k, R).

        Args:
            at: Where.
            order: 1 without p.
            chord: From how far below p to how far above its slope is taken, (R,) each; None: as good as there, on one
                side where p is 0.
        """
        size = _REACH * at.shape[:, 1]
        high = [self._response(at.shape, size, 0.0, 0.0), self._response(at.shape, 0.0, size, 0.0)]
        low = [self._response(at.shape, -size, 0.0, 0.0), self._response(at.shape, 0.0, -size, 0.0)]
        width = [2.0 * size, 2.0 * size]
        if order == 2:
            near = size * at.shape[:, 1]
            below, above = (np.minimum(near, at.shape[:, 2]), near) if chord is None else chord
            high.append(self._response(at.shape, 0.0, 0.0, above))
            low.append(self._response(at.shape, 0.0, 0.0, -below))
            width.append(above + below)
        raw = np.stack([self.projected((up - down) / w[:, None]) for up, down, w in zip(high, low, width, strict=True)])
        raw *= at.amplitude[:, None]
        power = np.einsum("ij,ij->i", at.unit, at.unit)
        share = np.einsum("kij,ij->ki", raw, at.unit) / np.where(power > 0.0, power, np.inf)
        return raw - share[:, :, None] * at.unit, -share

    def equations(self, at: Point, slopes: FloatArray, damping: float = 0.0) -> Equations:
        """What q and p should do, whatever the delays do about it.

        A delay takes no part where it tells nothing, or where its bound 0 holds it back.

        Args:
            at: Where.
            slopes: There, from :meth:`slopes`.
            damping: Of the delays' own steps.
        """
        own = np.einsum("ij,ij->i", slopes[0], slopes[0])
        pull = np.einsum("ij,ij->i", slopes[0], at.left)
        height = np.einsum("ij,ij->i", at.unit, at.unit) * (at.amplitude / at.shape[:, 1]) ** 2
        told = own > _TOLD * height
        delay_sd = np.where(told, 1.0 / np.sqrt(np.where(told, own, 1.0)), np.inf)
        held = (at.shape[:, 0] <= 0.0) & (pull <= 0.0)
        own = np.where(held | ~told, np.inf, own * (1.0 + damping))
        cross = np.einsum("ij,kij->ik", slopes[0], slopes[1:])
        coupling = cross / own[:, None]
        information = np.einsum("kij,lij->ikl", slopes[1:], slopes[1:]) - cross[:, :, None] * coupling[:, None, :]
        score = np.einsum("kij,ij->ik", slopes[1:], at.left) - coupling * pull[:, None]
        return Equations(pull / own, coupling, information, score, delay_sd)

    def each(self, shape: FloatArray, order: Order) -> Point:
        """From a shape for each row to the nearest minimum of that row."""
        found = self.point(self._bounded(shape))
        rows, at = np.arange(len(shape)), found
        damping = np.full(len(shape), 1e-3)
        for _ in range(_ITERATIONS):
            here = self.taken(rows)
            slopes, _ = here.slopes(at, order)
            H = np.einsum("kij,lij->ikl", slopes, slopes)
            g = np.einsum("kij,ij->ik", slopes, at.left)
            new = here.point(here._bounded(_stepped(at.shape, H, g, damping)))
            better = new.cost <= at.cost
            fallen = at.cost - new.cost
            chosen = Point(
                *(
                    np.where(better.reshape(-1, *[1] * (one.ndim - 1)), one, old)
                    for one, old in zip(new, at, strict=True)
                )
            )
            damping = np.where(better, np.maximum(0.2 * damping, 1e-12), 8.0 * damping)
            for whole, part in zip(found, chosen, strict=True):
                whole[rows] = part
            going = np.where(better, fallen > _CONVERGED * at.cost, damping < _HOPELESS)
            if not going.any():
                break
            rows, damping, at = rows[going], damping[going], Point(*(part[going] for part in chosen))
        return found

    def together(self, q: float, p: float, delay: FloatArray, order: Order) -> Point:
        """From one plant for all rows, and a delay for each, to the nearest minimum over all."""
        at, damping = self.point(_shapes(delay, q, p)), 1e-3
        for _ in range(_ITERATIONS):
            slopes, _ = self.slopes(at, order)
            cost = float(at.cost.sum())
            while True:
                found = self.equations(at, slopes, damping)
                H, g = found.information.sum(axis=0)[None], found.score.sum(axis=0)[None]
                plant = _stepped(at.shape[:1, 1:], H, g, np.array([damping]))
                plant = np.clip(plant, [[0.2 * at.shape[0, 1], 0.0]], np.inf)
                delays = at.shape[:, 0] + found.shift - found.coupling @ (plant - at.shape[:1, 1:])[0, :order]
                new = self.point(_shapes(np.maximum(delays, 0.0), *plant[0].tolist()))
                fallen = cost - float(new.cost.sum())
                if fallen >= 0.0 or damping > _HOPELESS:
                    break
                damping *= 8.0
            if fallen >= 0.0:
                at = new
            if fallen <= _CONVERGED * cost:
                break
            damping = max(0.2 * damping, 1e-12)
        return at

    def _bounded(self, shape: FloatArray) -> FloatArray:
        span, least = self.span, 1e-3 * self.spacing
        most = np.stack((span, 20.0 * span, (5.0 * span) ** 2), axis=1)
        return np.clip(shape, np.stack((0.0 * least, least, 0.0 * least), axis=1), most)

    def _response(
        self, shape: FloatArray, later: FloatArray | float, q: FloatArray | float, p: FloatArray | float
    ) -> FloatArray:
        """The unit response at every sample, of a shape and changes to it, (R, m)."""
        delay, slow, square = shape[:, 0] + later, shape[:, 1] + q, shape[:, 2] + p
        return unit_response(self.time - delay[:, None], slow[:, None], square[:, None])


def window(trial: Trial, samples: int | None) -> tuple[FloatArray, FloatArray]:
    """Time [s] and position [m] of what is fitted: ``samples`` from the step on and all before it; all for None."""
    end = len(trial.time) if samples is None else int(np.searchsorted(trial.time, 0.0)) + samples
    return trial.time[:end], trial.position[:end]


def _shapes(delay: FloatArray, q: float, p: float) -> FloatArray:
    return np.stack((delay, np.full(len(delay), q), np.full(len(delay), p)), axis=1)


def _stepped(shape: FloatArray, H: FloatArray, g: FloatArray, damping: FloatArray) -> FloatArray:
    """A damped step in each row; a parameter that its bound 0 holds back takes no part in it."""
    k = g.shape[1]
    diagonal = np.einsum("ikk->ik", H)
    held = (shape[:, :k] <= 0.0) & (g <= 0.0)
    damped = H + np.where(diagonal > 0.0, (damping[:, None] + _RIDGE) * diagonal, 1.0)[:, :, None] * np.eye(k)
    kept = ~held
    damped = damped * (kept[:, :, None] & kept[:, None, :]) + held[:, :, None] * np.eye(k)
    stepped = shape.copy()
    stepped[:, :k] += np.linalg.solve(damped, (g * kept)[:, :, None])[:, :, 0]
    return stepped
