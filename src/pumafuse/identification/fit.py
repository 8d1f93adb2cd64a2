"""Fit of one step trial: z(t) = z₀ + K·step·c(t − Td), by least squares over all that is unknown.

c is the unit step response of 1/(p s² + q s + 1): q = 2ζ/ω (or τ) and p = 1/ω² stay finite where a response is of first
order (p = 0); ω and ζ run off to infinity there. Gain and zero are linear and solved for inside (variable projection);
delay, q and p are looked for on a grid first, because a delay makes local minima: a trial is a short run, and cells are
weighed as those of the search for arms are (:class:`pumafuse.tuning.arms.Measured`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..model.plants import PLANTS, FirstOrder, SecondOrder, unit_response
from ..toml import Interval
from ..tuning.arms import Arm, Limits, Measured, Recording
from .batch import Batch, Order, sensitivity
from .estimate import t_quantile
from .trials import Trial

_LAGS, _DAMPINGS = 10, (0.4, 0.8, 1.6)  # values of q, and of ζ, on the grid
_MOST_DELAYS, _MOST_SAMPLES = 200, 300  # that are looked at there
_STARTS = 4  # cells to search from
ALIKE = 1e-9  # of the sum of squares: less between two minima is rounding
_SETTLED = 0.98  # share of the final value that a settled response has reached at the end
_FASTEST = 1e-3  # of 2ζ/ω, lower bound of 1/ω
_MOVES = 0.5  # share of the usual gain below which an arm has hardly moved


class Shape(NamedTuple):
    """The nonlinear parameters of a response."""

    delay: float  # Td [s]
    q: float  # 2ζ/ω, or τ [s]
    p: float  # 1/ω², 0 of a first-order plant [s²]


class Intervals(NamedTuple):
    """95 % intervals of delay Td [s], q [s], p [s²] and gain K."""

    delay: Interval
    q: Interval
    p: Interval
    gain: Interval


@dataclass(frozen=True)
class StepFit:
    """The best response of one order."""

    order: Order  # 1 or 2
    shape: Shape  # delay, q and p
    gain: float
    zero: float  # z₀ [m]
    rms: float  # of the residuals [m], eq. 10
    samples: int  # how many were fitted
    # of delay, q, p, K and z₀, (5, 5); 0 for what was not fitted, infinite where it is not identifiable
    covariance: FloatArray
    reached: float  # share of its final value that the response has reached with the last sample
    parameters: int  # how many were fitted

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
        """The 95 % interval of the lag [s], by the covariance of its parts: the sum is known much better than each."""
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
        shape = plant_of(q, max(p, least_p(q)))
        return msgspec.structs.replace(shape, natural_frequency_ci95=omega_ci95, damping_ci95=damping_ci95)

    @property
    def _t(self) -> float:
        return t_quantile(max(self.samples - self.parameters, 1))


def fit_steps(trials: Sequence[Trial]) -> list[tuple[StepFit, StepFit]]:
    """Each trial by itself with plants of first and second order; delay, gain and zero are free.

    Second order never fits worse than first: that is its p = 0.
    """
    batch = Batch.of(trials, [1.0 / abs(trial.step) for trial in trials])
    starts = np.stack([_starts(trial) for trial in trials], axis=2)
    first = _fit_best(batch, 1, starts[0])
    second = _fit_best(batch, 2, np.concatenate((first[None], starts[1])))
    return [
        (_fit(trial, start, 1), _fit(trial, two, 2)) for trial, start, two in zip(trials, first, second, strict=True)
    ]


def doubt_words(fit: StepFit, usual: float) -> str | None:
    """Why a trial tells nothing of its axis, whose median gain is ``usual``; None where it does."""
    moved = fit.gain * fit.reached
    if usual == 0.0 or moved / usual < _MOVES:
        return f"hardly moved (stiction?): {max(moved, 0.0):.0%} of the step"
    if not fit.ci95.gain[1] - fit.ci95.gain[0] < 2.0 * abs(fit.gain):
        return "gain not identifiable: it may be 0"
    return None


def flags(fit: StepFit, usual: float = 1.0) -> list[str]:
    """What a user should know before trusting a fit; ``usual`` is the median gain of its axis."""
    useless = doubt_words(fit, usual)
    flags = [] if useless is None else [useless]
    if fit.reached < _SETTLED:
        flags.append(f"not settled: {fit.reached:.0%} reached")
    if fit.order == 2 and fit.ci95.p[0] <= 0.0:
        flags.append("long flat valley: first order may do")
    if fit.shape.delay <= 0.0:
        flags.append("delay at its bound 0")
    return flags


def _fit_best(batch: Batch, order: Order, starts: FloatArray) -> FloatArray:
    """The best shape of each row (R, 3), from several starts (s, R, 3); the first of those that are alike."""
    rows = np.arange(len(batch.time))
    every, flat = batch.take(np.tile(rows, len(starts))), starts.reshape(-1, 3)
    ends = every.point(flat), every.fit(flat, order)  # a fit begins inside its bounds: a start on them may be better
    shapes = np.concatenate([end.shape for end in ends]).reshape(-1, len(rows), 3)
    cost = np.concatenate([end.cost for end in ends]).reshape(-1, len(rows))
    return shapes[(cost <= (1.0 + ALIKE) * cost.min(axis=0)).argmax(axis=0), rows]


def _starts(trial: Trial) -> FloatArray:
    """The best cells of a grid for one trial, of either order and each of another delay, (2, s, 3)."""
    measured, span = _to_recording(trial), float(trial.time[-1])
    spacing = span / min(int(np.count_nonzero(trial.time > 0.0)), _MOST_DELAYS)
    delays: list[float] = np.arange(0.0, 0.8 * span, spacing).tolist()
    lags: list[float] = np.geomspace(0.5 * spacing, span, _LAGS).tolist()
    starts = list[list[Shape]]()
    for dampings in ((0.0,), _DAMPINGS):
        arms, best = [Arm(*cell) for cell in product(delays, lags, dampings)], dict[float, Shape]()
        log, _ = measured.weighed(arms, measured.white(arms[0]), Limits({}, {}))
        places: list[int] = np.argsort(-log, kind="stable").tolist()
        for arm in (arms[number] for number in places):
            p = (0.5 * arm.lag / arm.damping) ** 2 if arm.damping else 0.0
            best.setdefault(arm.delay, Shape(arm.delay, arm.lag, p))
        starts.append(list(best.values())[:_STARTS])
    return np.array(starts)


def _to_recording(trial: Trial) -> Measured:
    """A trial as the search for arms takes it: a recording of one command, in steps; its zero is free."""
    n, value = len(trial.time), trial.position / trial.step
    time, source = np.rint(trial.time * 1e9).astype(np.int64), np.zeros(n, dtype=np.int64)
    recording = Recording(np.zeros(1, dtype=np.int64), np.ones(1), 0.0, time, value, source, np.ones(n))
    # the update period has no effect on a constant gain
    return Measured([recording.of(slice(None, None, n // _MOST_SAMPLES + 1))], 1.0, ["position"])


def _fit(trial: Trial, numbers: FloatArray, order: Order) -> StepFit:
    time, shape, step = trial.time, Shape(*numbers.tolist()), trial.step
    c = unit_response(time - shape.delay, shape.q, shape.p)
    design = np.stack((step * c, np.ones_like(c)), axis=1)
    gain, zero = np.linalg.lstsq(design, trial.position, rcond=None)[0].tolist()
    rms = float(np.sqrt(np.mean((trial.position - design @ [gain, zero]) ** 2)))
    changes = [gain * step * change[0] for change in sensitivity(time[None], numbers[None], order)]
    jacobian = np.column_stack((*changes, design))
    fitted = [0, 1, 2, 3, 4] if order == 2 else [0, 1, 3, 4]
    freedom = max(len(time) - len(fitted), 1)
    covariance = np.zeros((5, 5))
    covariance[np.ix_(fitted, fitted)] = inverse(jacobian) * (rms**2 * len(time) / freedom)
    return StepFit(order, shape, gain, zero, rms, len(time), covariance, share_reached(time, shape), len(fitted))


def share_reached(time: FloatArray, shape: Shape) -> float:
    """Share of its final value that a response has reached with the last sample."""
    return float(unit_response(np.array(time[-1] - shape.delay), shape.q, shape.p))


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
