"""The paper's own method: delay and gain are read off a trial, the plant minimises equation 10.

It reproduces published numbers. The window may end before the arm has settled; then the gain that is read off is too
low (5 to 10 % in the paper's 169 ms). :mod:`pumafuse.identification.fit` avoids this by fitting all at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import FloatArray
from ..model.plants import unit_response
from .batch import sensitivity
from .fit import Shape, StepFit, inverse, share_reached
from .trials import Trial

_REST = 5  # samples of the rest level, at least
_LAST = 3  # samples that the gain is read off
_SIGMAS, _SHARE = 3.0, 0.02  # of the noise at rest, of the step: threshold of motion


def onset(trial: Trial) -> float:
    """When the arm first is further from rest than 3 standard deviations and 2 % of the step [s]; NaN: never."""
    level, sd = _level_at_rest(trial)
    away = np.abs(trial.position - level)
    moved = (away > max(_SIGMAS * sd, _SHARE * abs(trial.step))) & (trial.time >= 0.0)
    return float(trial.time[np.argmax(moved)]) if moved.any() else np.nan


def fit_as_published(trial: Trial, fitted: StepFit) -> StepFit:
    """Fit the plant anew with delay, gain and zero as read off; the search starts from what was ``fitted``."""
    seen, (level, _), order = onset(trial), _level_at_rest(trial), fitted.order
    gain = (float(trial.position[-_LAST:].mean()) - level) / trial.step
    delay = seen if seen < trial.time[-1] else 0.0
    read = replace(fitted, shape=fitted.shape._replace(delay=delay), gain=gain, zero=level, parameters=order)
    shape = Shape(delay, *minimise([trial], [read]))
    height, n = gain * trial.step, len(trial.time)
    squares = float(np.sum((trial.position - level - height * unit_response(trial.time - delay, *shape[1:])) ** 2))
    covariance, free = np.zeros((5, 5)), slice(1, order + 1)  # what is read off has no interval of its own
    changes = [height * change[0] for change in sensitivity(trial.time[None], np.array([shape]), order)[1:]]
    covariance[free, free] = inverse(np.column_stack(changes)) * squares / max(n - order, 1)
    end = share_reached(trial.time, shape)
    return replace(read, shape=shape, rms=float(np.sqrt(squares / n)), covariance=covariance, reached=end)


def minimise(trials: Sequence[Trial], read: Sequence[StepFit]) -> tuple[float, float]:
    """The q [s] and p [s²] that minimise equation 10 over one or more trials, given each one's delay, gain and zero."""
    from scipy.optimize import least_squares

    pairs, order = list(zip(trials, read, strict=True)), read[0].order
    t = np.concatenate([trial.time - fit.shape.delay for trial, fit in pairs])
    z = np.concatenate([trial.position - fit.zero for trial, fit in pairs])
    height = np.concatenate([np.full(len(trial.time), fit.gain * trial.step) for trial, fit in pairs])

    def residual(x: FloatArray) -> FloatArray:
        return z - height * unit_response(t, x[0], x[1] if order == 2 else 0.0)

    q, p = np.median([fit.shape[1:] for fit in read], axis=0)
    size = np.array([q, q * q])[:order]
    start, span = np.array([q, min(p, q * q)])[:order], float(t.max())
    bounds = np.array([1e-3 * q, 0.0])[:order], np.array([20.0 * span, (5.0 * span) ** 2])[:order]
    minimum = least_squares(
        residual, np.clip(start, *bounds), bounds=bounds, x_scale=size, xtol=1e-10, ftol=1e-12, gtol=1e-15, max_nfev=200
    )
    return float(minimum.x[0]), float(minimum.x[1]) if order == 2 else 0.0


def _level_at_rest(trial: Trial) -> tuple[float, float]:
    """Level and standard deviation [m] of the samples before the command; of the first five where those are fewer."""
    level = trial.position[: max(int(np.searchsorted(trial.time, 0.0)), _REST)]
    return float(level.mean()), float(level.std(ddof=1))
