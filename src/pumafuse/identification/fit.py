"""Fit of one step trial: z(t) = z₀ + K·step·c(t − Td), by least squares over all that is unknown.

c is the unit step response of 1/(p s² + q s + 1): q = 2ζ/ω (or τ) and p = 1/ω² stay finite where a response is of first
order (p = 0); ω and ζ run off to infinity there. Gain and zero are linear and solved for inside (variable projection);
delay, q and p are searched on a grid first, because a delay makes local minima.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..model.plants import PLANTS, FirstOrder, SecondOrder
from ..model.unit_response import unit_response
from ..toml import Interval
from .batch import Batch, Order
from .estimate import t_quantile
from .trials import Trial

_STARTS = 4  # cells of the grid to search from
_RATIOS = (0.0, 0.08, 0.16, 0.25, 0.4, 0.8, 2.0)  # p/q² = 1/(4ζ²): ζ from ∞ to 0.35
_LAGS = 14  # values of q on the grid
_MOST_DELAYS, _MOST_SAMPLES = 200, 300  # on the grid
_FINE = 8  # instants between samples at which the grid's responses are known
_SETTLED = 0.98  # share of the final value that a settled response has reached at the end
_FASTEST = 1e-3  # of 2ζ/ω, lower bound of 1/ω
_MOVES = 0.5  # share of the usual gain below which an arm has hardly moved


class Shape(NamedTuple):
    """The nonlinear parameters of a response.

    Attributes:
        delay: Td [s].
        q: 2ζ/ω, or τ [s].
        p: 1/ω², 0 of a first-order plant [s²].
    """

    delay: float
    q: float
    p: float


class Intervals(NamedTuple):
    """95 % intervals of delay Td [s], q [s], p [s²] and gain K."""

    delay: Interval
    q: Interval
    p: Interval
    gain: Interval


@dataclass(frozen=True)
class StepFit:
    """The best response of one order.

    Attributes:
        order: 1 or 2.
        shape: Delay, q and p.
        gain: K.
        zero: z₀ [m].
        rms: Of the residuals [m], eq. 10.
        samples: How many were fitted.
        covariance: Of delay, q, p, K and z₀, (5, 5); 0 for what was not fitted, infinite where it is not identifiable.
        reached: Share of its final value that the response has reached with the last sample.
        parameters: How many were fitted.
    """

    order: Order
    shape: Shape
    gain: float
    zero: float
    rms: float
    samples: int
    covariance: FloatArray
    reached: float
    parameters: int

    @property
    def squares(self) -> float:
        """Sum of squared residuals [m²]."""
        return self.rms**2 * self.samples

    @cached_property
    def sd(self) -> FloatArray:
        """Standard deviations of delay, q, p, K and z₀, (5,)."""
        return np.sqrt(np.diag(self.covariance))

    @cached_property
    def ci95(self) -> Intervals:
        """95 % intervals."""
        pairs = zip((*self.shape, self.gain), (self._t * self.sd).tolist(), strict=False)
        return Intervals(*((value - half, value + half) for value, half in pairs))

    @property
    def lag(self) -> float:
        """Td + τ, or Td + 2ζ/ω [s]."""
        return self.shape.delay + self.shape.q

    @property
    def lag_ci95(self) -> Interval:
        """Its 95 % interval [s], by the covariance of both; they are known much better together than each."""
        half = self._t * float(np.sqrt(self.covariance[:2, :2].sum()))
        return self.lag - half, self.lag + half

    @cached_property
    def plant(self) -> PLANTS:
        """The plant with its intervals; one of second order whose p is 0 gets the highest ω that q allows.

        Where 1/ω² may be 0, ω and ζ may be infinite. The interval of ζ = q/(2√p) is to first order in q and log p.
        """
        _, q, p = self.shape
        if self.order == 1:
            return FirstOrder(time_constant=q, time_constant_ci95=self.ci95.q)
        omega_ci95, damping_ci95 = (float(self.ci95.p[1] ** -0.5), np.inf), (0.0, np.inf)
        if self.ci95.p[0] > 0.0:
            slope = np.array([1.0 / q, -0.5 / p])
            wide = float(np.exp(self._t * np.sqrt(slope @ self.covariance[1:3, 1:3] @ slope)))
            zeta = 0.5 * q * p**-0.5
            omega_ci95, damping_ci95 = (omega_ci95[0], self.ci95.p[0] ** -0.5), (zeta / wide, zeta * wide)
        found = plant_of(q, max(p, least_p(q)))
        return msgspec.structs.replace(found, natural_frequency_ci95=omega_ci95, damping_ci95=damping_ci95)

    @property
    def _t(self) -> float:
        return t_quantile(max(self.samples - self.parameters, 1))


def fit_steps(trials: Sequence[Trial]) -> list[tuple[StepFit, StepFit]]:
    """Fit each trial by itself with plants of both orders; delay, gain and zero are free.

    Returns:
        First and second order of each trial. Second order never fits worse than first: that is its p = 0.
    """
    batch = Batch.of(trials, [1.0 / abs(trial.step) for trial in trials])
    first = _search(batch, 1, [])
    second = _search(batch, 2, [first])
    return [(_fit(trial, one, 1), _fit(trial, two, 2)) for trial, one, two in zip(trials, first, second, strict=True)]


def doubt(fit: StepFit, usual: float) -> str | None:
    """Why a trial tells nothing of its axis, whose median gain is ``usual``; None where it does."""
    moved = fit.gain * fit.reached
    if usual == 0.0 or moved / usual < _MOVES:
        return f"hardly moved (stiction?): {max(moved, 0.0):.0%} of the step"
    if not fit.ci95.gain[1] - fit.ci95.gain[0] < 2.0 * abs(fit.gain):
        return "gain not identifiable: it may be 0"
    return None


def flags(fit: StepFit, usual: float = 1.0) -> list[str]:
    """What a user should know before trusting a fit; ``usual`` is the median gain of its axis."""
    useless = doubt(fit, usual)
    found = [] if useless is None else [useless]
    if fit.reached < _SETTLED:
        found.append(f"not settled: {fit.reached:.0%} reached")
    if fit.order == 2 and fit.ci95.p[0] <= 0.0:
        found.append("long flat valley: first order may do")
    if fit.shape.delay <= 0.0:
        found.append("delay at its bound 0")
    return found


def _search(batch: Batch, order: Order, more: list[FloatArray]) -> FloatArray:
    """The best shape of each row (R, 3), searched from the best cells of a grid and from ``more`` (R, 3) shapes."""
    count = len(batch.time)
    grid = np.stack([_starts(batch, row, order) for row in range(count)], axis=1)
    starts = np.concatenate([grid, *(shape[None] for shape in more)])
    found = batch.take(np.tile(np.arange(count), len(starts))).fit(starts.reshape(-1, 3), order)
    shapes, cost = found.shape.reshape(starts.shape), found.cost.reshape(len(starts), count)
    for shape in more:  # the search begins inside its bounds; a start on them may have been better
        shapes, cost = np.concatenate((shapes, shape[None])), np.concatenate((cost, batch.point(shape).cost[None]))
    return shapes[cost.argmin(axis=0), np.arange(count)]


def _starts(batch: Batch, row: int, order: Order) -> FloatArray:
    """The best cells of the grid for one row, of different delays, (starts, 3)."""
    inside = np.flatnonzero(batch.weight[row] > 0.0)
    inside = inside[:: len(inside) // _MOST_SAMPLES + 1]
    shapes, unit = _grid(batch.time[row, inside].tobytes(), order)
    position = batch.position[row, inside]
    explained = ((unit @ (position - position.mean())) ** 2).reshape(shapes.shape[:2])
    best = explained.argmax(axis=1)
    chosen = np.argsort(-explained.max(axis=1), kind="stable")[:_STARTS]
    return shapes[chosen, best[chosen]]


@lru_cache(maxsize=8)
def _grid(time: bytes, order: Order) -> tuple[FloatArray, FloatArray]:
    """Shapes by delay (d, g, 3), and their centred responses, each of unit length, (d·g, n)."""
    t = np.frombuffer(time)
    span = float(t[-1])
    spacing = max(float(np.mean(np.diff(t))), span / _MOST_DELAYS)
    delays = np.arange(0.0, 0.8 * span, 0.75 * spacing)
    lags, ratio = np.meshgrid(np.geomspace(0.5 * spacing, span, _LAGS), _RATIOS[: 1 if order == 1 else None])
    q, p = lags.ravel(), (ratio * lags**2).ravel()
    # a delay is a shift: one fine response of each plant serves all
    fine = spacing / _FINE
    table = unit_response(np.arange(0.0, span + 2.0 * fine, fine), q[:, None], p[:, None])
    place = np.maximum(np.rint((t - delays[:, None]) / fine).astype(np.int64), 0)
    c = np.ascontiguousarray(table[:, place].swapaxes(0, 1)).reshape(-1, len(t))
    c -= c.mean(axis=1, keepdims=True)
    length = np.linalg.norm(c, axis=1)
    shapes = np.empty((len(delays), len(q), 3))
    shapes[..., 0], shapes[..., 1], shapes[..., 2] = delays[:, None], q, p
    return shapes, c / np.where(length > 1e-9, length, np.inf)[:, None]


def _fit(trial: Trial, found: FloatArray, order: Order) -> StepFit:
    time, shape, step = trial.time, Shape(*found.tolist()), trial.step
    c = unit_response(time - shape.delay, shape.q, shape.p)
    design = np.stack((step * c, np.ones_like(c)), axis=1)
    gain, zero = np.linalg.lstsq(design, trial.position, rcond=None)[0].tolist()
    rms = float(np.sqrt(np.mean((trial.position - design @ [gain, zero]) ** 2)))
    jacobian = np.column_stack((gain * step * sensitivity(time, shape, order), design))
    fitted = [0, 1, 2, 3, 4] if order == 2 else [0, 1, 3, 4]
    freedom = max(len(time) - len(fitted), 1)
    covariance = np.zeros((5, 5))
    covariance[np.ix_(fitted, fitted)] = inverse(jacobian) * (rms**2 * len(time) / freedom)
    return StepFit(order, shape, gain, zero, rms, len(time), covariance, reached(time, shape), len(fitted))


def reached(time: FloatArray, shape: Shape) -> float:
    """Share of its final value that a response has reached with the last sample."""
    return float(unit_response(np.array(time[-1] - shape.delay), shape.q, shape.p))


def sensitivity(time: FloatArray, shape: Shape, order: Order) -> FloatArray:
    """∂c/∂(delay, q, p) by differences, (n, order + 1)."""
    columns: list[FloatArray] = []
    for place, size in enumerate((1e-5 * shape.q, 1e-5 * shape.q, 1e-5 * shape.q**2)[: order + 1]):
        low, high = np.array(shape), np.array(shape)
        low[place], high[place] = max(low[place] - size, 0.0), high[place] + size
        responses = [unit_response(time - one[0], one[1], one[2]) for one in (low, high)]
        columns.append((responses[1] - responses[0]) / (high[place] - low[place]))
    return np.stack(columns, axis=1)


def inverse(jacobian: FloatArray) -> FloatArray:
    """(JᵀJ)⁻¹; infinite on the diagonal where columns depend on one another."""
    length = np.linalg.norm(jacobian, axis=0)
    if (length == 0.0).any() or np.linalg.matrix_rank(jacobian / length, tol=1e-8) < len(length):
        return np.diag(np.full(len(length), np.inf))
    inverse = np.linalg.inv(np.linalg.qr(jacobian / length, mode="r"))
    return (inverse @ inverse.T) / np.outer(length, length)


def plant_of(q: float, p: float) -> PLANTS:
    """The plant 1/(p s² + q s + 1), of first order where p is 0."""
    if p == 0.0:
        return FirstOrder(time_constant=q)
    return SecondOrder(natural_frequency=p**-0.5, damping=0.5 * q * p**-0.5)


def least_p(q: float) -> float:
    """The least 1/ω² [s²] beside 2ζ/ω = ``q`` [s]: faster poles have no visible effect."""
    return (_FASTEST * q) ** 2
