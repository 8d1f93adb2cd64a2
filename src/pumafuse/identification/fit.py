"""One step trial, fitted: z(t) = z₀ + K·step·c(t − Td), by least squares over all that is unknown.

c is the unit step response of 1/(p s² + q s + 1): q = 2ζ/ω (or τ) and p = 1/ω² stay finite where a response is of first
order (p = 0); ω and ζ run off to infinity there. Gain and zero are linear and solved for inside (variable projection);
delay, q and p are searched on a grid first, because a delay makes local minima.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..arrays import FloatArray
from ..model.plants import PLANTS, FirstOrder, SecondOrder
from ..model.unit_response import unit_response
from ..toml import Interval
from .estimate import t_quantile
from .rows import Order, Rows, window
from .trials import Trial

HARDLY_MOVED = "hardly moved (stiction?)"
TOO_FEW = "too few samples tell anything: the gain may be 0"

_STARTS = 4  # cells of the grid to go on from
_RATIOS = (0.0, 0.08, 0.16, 0.25, 0.4, 0.8, 2.0)  # p/q² = 1/(4ζ²): ζ from ∞ to 0.35
_SLOWNESSES = 14  # values of q on the grid
_MOST_DELAYS, _MOST_SAMPLES = 200, 300  # on the grid
_FINE = 8  # instants between samples at which the grid's responses are known
_SETTLED = 0.98  # share of the final value that a settled response has reached at the end
_FASTEST = 1e-3  # of 2ζ/ω, that 1/ω is at least
_MOVES = 0.5  # share of what is usual below which an arm has hardly moved


class Shape(NamedTuple):
    """What of a response is not linear.

    Attributes:
        delay: Td [s].
        q: 2ζ/ω, or τ [s].
        p: 1/ω², 0 of a first-order plant [s²].
    """

    delay: float
    q: float
    p: float


@dataclass(frozen=True)
class StepFit:
    """The best response of one order.

    Attributes:
        order: 1 or 2.
        shape: Delay, q and p.
        gain: K.
        zero: z₀ [m].
        rms: Of what is left [m], eq. 10.
        samples: How many were fitted.
        covariance: Of delay, q, p (order 2 only), K and z₀, (k, k); infinite where the trial does not tell.
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
        """Sum of squares of what is left [m²]."""
        return self.rms**2 * self.samples

    @property
    def plant(self) -> PLANTS:
        """The plant; one of second order whose p is 0 is given the fastest ω that q allows."""
        if self.order == 1:
            return FirstOrder(time_constant=self.shape.q)
        omega = 1.0 / np.sqrt(max(self.shape.p, least_p(self.shape.q)))
        return SecondOrder(natural_frequency=float(omega), damping=float(0.5 * self.shape.q * omega))

    @property
    def delay_sd(self) -> float:
        """Of Td [s]."""
        return self._sd(0)

    @property
    def q_sd(self) -> float:
        """Of 2ζ/ω, or τ [s]."""
        return self._sd(1)

    @property
    def gain_sd(self) -> float:
        """Of K."""
        return self._sd(self.order + 1)

    @property
    def delay_ci95(self) -> Interval:
        """Of Td [s]."""
        return self._interval(self.shape.delay, self.delay_sd)

    @property
    def q_ci95(self) -> Interval:
        """Of 2ζ/ω, or τ [s]."""
        return self._interval(self.shape.q, self.q_sd)

    @property
    def p_ci95(self) -> Interval:
        """Of 1/ω² [s²]."""
        return self._interval(self.shape.p, self._sd(2)) if self.order == 2 else (0.0, 0.0)

    @property
    def gain_ci95(self) -> Interval:
        """Of K."""
        return self._interval(self.gain, self.gain_sd)

    @property
    def natural_frequency_ci95(self) -> Interval:
        """Of ω [rad/s], its upper end infinite where 1/ω² may be 0."""
        low, high = self.p_ci95
        return float(high**-0.5), float(low**-0.5) if low > 0.0 else np.inf

    @property
    def damping_ci95(self) -> Interval:
        """Of ζ = q/(2√p), infinite where 1/ω² may be 0; to first order in q and log p."""
        p, q = self.shape.p, self.shape.q
        if self.p_ci95[0] <= 0.0:
            return 0.0, np.inf
        slope = np.array([1.0 / q, -0.5 / p])
        half = _quantile(self) * float(np.sqrt(slope @ self.covariance[1:3, 1:3] @ slope))
        zeta = 0.5 * q / np.sqrt(p)
        return float(zeta * np.exp(-half)), float(zeta * np.exp(half))

    def at(self, time: FloatArray, step: float) -> FloatArray:
        """The fitted position [m] at ``time`` [s since the command], (n,)."""
        return self.zero + self.gain * step * unit_response(time - self.shape.delay, self.shape.q, self.shape.p)

    def _sd(self, place: int) -> float:
        return float(np.sqrt(self.covariance[place, place]))

    def _interval(self, value: float, sd: float) -> Interval:
        half = _quantile(self) * sd
        return value - half, value + half


def fit_steps(trials: Sequence[Trial], samples: int | None = None) -> list[tuple[StepFit, StepFit]]:
    """Fit trials with delay, gain and zero free, each by itself, with plants of both orders.

    Args:
        trials: What was recorded.
        samples: Use only so many from the step on; all for None.

    Returns:
        First and second order of each trial. Second order never fits worse than first: that is its p = 0.
    """
    rows = Rows.of(trials, [1.0 / abs(trial.step) for trial in trials], samples)
    first = _searched(rows, 1, [])
    second = _searched(rows, 2, [first])
    return [
        (_fit(trial, one, 1, samples), _fit(trial, two, 2, samples))
        for trial, one, two in zip(trials, first, second, strict=True)
    ]


def flags(fit: StepFit, usual: float = 1.0) -> list[str]:
    """What a user should know before trusting a fit.

    Args:
        fit: Of one trial.
        usual: The gain of its axis.
    """
    found: list[str] = []
    moved = fit.gain * fit.reached
    if usual == 0.0 or moved / usual < _MOVES:
        found.append(f"{HARDLY_MOVED}: {max(moved, 0.0):.0%} of the step")
    elif not fit.gain_ci95[1] - fit.gain_ci95[0] < 2.0 * abs(fit.gain):
        found.append(TOO_FEW)
    if fit.reached < _SETTLED:
        found.append(f"not settled: {fit.reached:.0%} reached")
    if fit.order == 2 and fit.p_ci95[0] <= 0.0:
        found.append("long flat valley: first order may do")
    if fit.shape.delay <= 0.0:
        found.append("delay at its bound 0")
    return found


def _searched(rows: Rows, order: Order, more: list[FloatArray]) -> FloatArray:
    """The best shape of each row: refined from the best cells of a grid and from ``more`` (R, 3) shapes, (R, 3)."""
    count = len(rows.time)
    starts = np.concatenate(
        [np.stack([_starts(rows, row, order) for row in range(count)]).swapaxes(0, 1), *(m[None] for m in more)]
    )
    found = rows.taken(np.tile(np.arange(count), len(starts))).each(starts.reshape(-1, 3), order)
    shapes, cost = found.shape.reshape(starts.shape), found.cost.reshape(len(starts), count)
    for shape in more:  # the search begins inside its bounds; a start on them may have been better
        there = rows.point(shape)
        shapes, cost = np.concatenate((shapes, shape[None])), np.concatenate((cost, there.cost[None]))
    return shapes[cost.argmin(axis=0), np.arange(count)]


def _starts(rows: Rows, row: int, order: Order) -> FloatArray:
    """The best cells of the grid for one row, of different delays, (starts, 3)."""
    inside = np.flatnonzero(rows.weight[row] > 0.0)
    inside = inside[:: len(inside) // _MOST_SAMPLES + 1]
    shapes, unit = _grid(rows.time[row, inside].tobytes(), order)
    left = rows.position[row, inside]
    explained = ((unit @ (left - left.mean())) ** 2).reshape(shapes.shape[:2])
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
    slowness, ratio = np.meshgrid(np.geomspace(0.5 * spacing, span, _SLOWNESSES), _RATIOS[: 1 if order == 1 else None])
    q, p = slowness.ravel(), (ratio * slowness**2).ravel()
    # a delay is a shift: one fine response of each plant serves all
    fine = spacing / _FINE
    table = unit_response(np.arange(0.0, span + 2.0 * fine, fine), q[:, None], p[:, None])
    place = np.maximum(np.rint((t - delays[:, None]) / fine).astype(np.int64), 0)
    c = np.ascontiguousarray(table[:, place].swapaxes(0, 1)).reshape(-1, len(t))
    c -= c.mean(axis=1, keepdims=True)
    length = np.sqrt(np.einsum("ij,ij->i", c, c))
    shapes = np.empty((len(delays), len(q), 3))
    shapes[..., 0], shapes[..., 1], shapes[..., 2] = delays[:, None], q, p
    return shapes, c / np.where(length > 1e-9, length, np.inf)[:, None]


def _fit(trial: Trial, found: FloatArray, order: Order, samples: int | None) -> StepFit:
    (time, position), shape, step = window(trial, samples), Shape(*found.tolist()), trial.step
    c = unit_response(time - shape.delay, shape.q, shape.p)
    design = np.stack((step * c, np.ones_like(c)), axis=1)
    gain, zero = np.linalg.lstsq(design, position, rcond=None)[0].tolist()
    rms = float(np.sqrt(np.mean((position - design @ [gain, zero]) ** 2)))
    jacobian = np.column_stack((gain * step * sensitivity(time, shape, order), design))
    freedom = max(len(time) - jacobian.shape[1], 1)
    covariance = inverse(jacobian) * (rms**2 * len(time) / freedom)
    return StepFit(order, shape, gain, zero, rms, len(time), covariance, reached(time, shape), jacobian.shape[1])


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


def least_p(q: float) -> float:
    """The least 1/ω² [s²] beside 2ζ/ω = ``q`` [s]: faster poles are like none."""
    return (_FASTEST * q) ** 2


def _quantile(fit: StepFit) -> float:
    return t_quantile(max(fit.samples - fit.parameters, 1))
