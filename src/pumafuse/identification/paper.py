"""The paper's own method: delay and gain are read off a trial, the plant minimises equation 10.

It reproduces published numbers. The window may end before the arm has settled; then the gain that is read off is too
low (5 to 10 % in the paper's 169 ms). :mod:`pumafuse.identification.fit` avoids this by fitting all at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..arrays import FloatArray
from ..model.unit_response import unit_response
from .batch import Order
from .fit import Shape, StepFit, inverse, reached, sensitivity
from .trials import Trial

_REST = 5  # samples of the rest level, at least
_LAST = 3  # samples that the gain is read off
_SIGMAS, _SHARE = 3.0, 0.02  # of the noise at rest, of the step: threshold of motion
_STARTS = ((1.0, 0.0), (1.0, 0.05), (1.2, 0.25), (0.8, 0.5), (0.8, 1.5))  # q over the mean lag, p/q²


def onset(trial: Trial) -> float:
    """When the arm first is further from rest than 3 standard deviations and 2 % of the step [s]; NaN: never."""
    level, sd = _rest(trial)
    away = np.abs(trial.position - level)
    moved = (away > max(_SIGMAS * sd, _SHARE * abs(trial.step))) & (trial.time >= 0.0)
    return float(trial.time[np.argmax(moved)]) if moved.any() else np.nan


def fit_as_published(trial: Trial) -> tuple[StepFit, StepFit]:
    """Fit the plant of first and of second order with delay, gain and zero as read off."""
    time, position = trial.time, trial.position
    level, _ = _rest(trial)
    seen = onset(trial)
    delay = seen if seen < time[-1] else 0.0
    gain = (float(position[-_LAST:].mean()) - level) / trial.step
    read = StepFit(1, Shape(delay, 0.0, 0.0), gain, level, 0.0, len(time), np.zeros((5, 5)), 0.0, 1)
    return _refit(trial, read, 1), _refit(trial, read, 2)


def minimise(trials: Sequence[Trial], read: Sequence[StepFit], order: Order) -> tuple[float, float]:
    """The q [s] and p [s²] that minimise equation 10 over one or more trials, given each one's delay, gain and zero."""
    from scipy.optimize import least_squares

    t, z, height = _since_onset(trials, read)
    span, spacing = float(t.max()), float(np.median(np.diff(trials[0].time)))
    moving = (t > 0.0) & (height != 0.0)
    lag = float(np.clip(span * np.mean(1.0 - (z / height)[moving]), spacing, span)) if moving.any() else spacing
    found: list[tuple[float, float, float]] = []
    for stretch, ratio in _STARTS[: 1 if order == 1 else None]:
        q = stretch * lag
        least, most = [1e-3 * spacing, 0.0][:order], [20.0 * span, (5.0 * span) ** 2][:order]
        best = least_squares(
            lambda x: z - height * unit_response(t, x[0], x[1] if order == 2 else 0.0),
            np.clip([q, ratio * q * q][:order], least, most),
            bounds=(least, most),
            x_scale=np.array([lag, lag * lag])[:order],
            xtol=1e-10,
            ftol=1e-12,
            gtol=1e-15,
            max_nfev=200,
        )
        found.append((float(best.cost), float(best.x[0]), float(best.x[1]) if order == 2 else 0.0))
    return min(found)[1:]


def _rest(trial: Trial) -> tuple[float, float]:
    """Level and standard deviation [m] of the samples before the command; of the first five where those are fewer."""
    before = int(np.searchsorted(trial.time, 0.0))
    level = trial.position[: max(before, _REST)]
    return float(level.mean()), float(level.std(ddof=1))


def _since_onset(trials: Sequence[Trial], read: Sequence[StepFit]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time since each onset [s], motion since then [m], and its final height [m], of all samples of all trials."""
    pairs = list(zip(trials, read, strict=True))
    return (
        np.concatenate([trial.time - fit.shape.delay for trial, fit in pairs]),
        np.concatenate([trial.position - fit.zero for trial, fit in pairs]),
        np.concatenate([np.full(len(trial.time), fit.gain * trial.step) for trial, fit in pairs]),
    )


def _refit(trial: Trial, read: StepFit, order: Order) -> StepFit:
    shape = Shape(read.shape.delay, *minimise([trial], [read], order))
    t, z, height = _since_onset([trial], [read])
    residual = z - height * unit_response(t, shape.q, shape.p)
    slopes = height[:, None] * sensitivity(t, Shape(0.0, shape.q, shape.p), order)[:, 1:]
    covariance = np.zeros((5, 5))  # what is read off has no interval of its own
    fitted = slice(1, order + 1)
    covariance[fitted, fitted] = inverse(slopes) * float(residual @ residual) / max(len(t) - order, 1)
    rms = float(np.sqrt(np.mean(residual**2)))
    return StepFit(order, shape, read.gain, read.zero, rms, len(t), covariance, reached(trial.time, shape), order)
