"""The paper's own method: delay and gain are read off a trial, the rest minimises equation 10.

It is kept to reproduce published numbers. The window may end before the arm has settled; then the gain that is read off
is too low (5 to 10 % in the paper's 169 ms), which :mod:`pumafuse.identification.fit` avoids by fitting all at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..arrays import FloatArray
from ..model.unit_response import unit_response
from .fit import Shape, StepFit, inverse, reached, sensitivity
from .rows import Order, window
from .trials import Trial

_REST = 5  # samples that show the rest level, at least
_LAST = 3  # samples of which the gain is read off
_SIGMAS, _SHARE = 3.0, 0.02  # of the noise at rest, of the step: what counts as motion
_REACH = 1e-3  # of q and q², over which a second derivative is taken
_STARTS = ((1.0, 0.0), (1.0, 0.05), (1.2, 0.25), (0.8, 0.5), (0.8, 1.5))  # q over the mean lag, p/q²


def rest(trial: Trial) -> tuple[float, float]:
    """Level and standard deviation [m] of the samples before the command; of the first five where those are fewer."""
    before = int(np.searchsorted(trial.time, 0.0))
    level = trial.position[: max(before, _REST)]
    return float(level.mean()), float(level.std(ddof=1))


def onset(trial: Trial) -> float:
    """When the arm first is further from rest than 3 standard deviations and 2 % of the step [s]; NaN: never."""
    level, sd = rest(trial)
    away = np.abs(trial.position - level)
    moved = (away > max(_SIGMAS * sd, _SHARE * abs(trial.step))) & (trial.time >= 0.0)
    return float(trial.time[np.argmax(moved)]) if moved.any() else np.nan


def fit_as_published(trial: Trial, samples: int | None = None) -> tuple[StepFit, StepFit]:
    """Fit τ, and ω and ζ, with delay, gain and zero as read off.

    Args:
        trial: What was recorded.
        samples: Use only so many from the step on; all for None.

    Returns:
        First and second order.
    """
    time, position = window(trial, samples)
    level, _ = rest(trial)
    seen = onset(trial)
    delay = seen if seen < time[-1] else 0.0
    gain = (float(position[-_LAST:].mean()) - level) / trial.step
    read = StepFit(1, Shape(delay, 0.0, 0.0), gain, level, 0.0, len(time), np.zeros((4, 4)), 0.0, 1)
    return _refitted(trial, read, 1, samples), _refitted(trial, read, 2, samples)


def minimised(
    trials: Sequence[Trial], read: Sequence[StepFit], order: Order, samples: int | None
) -> tuple[float, float]:
    """Q [s] and p [s²] of the least equation 10 over trials.

    Args:
        trials: At least one.
        read: Delay, gain and zero of each.
        order: 1 or 2.
        samples: Use only so many from each step on; all for None.
    """
    from scipy.optimize import least_squares

    t, z, height = _since_onset(trials, read, samples)
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


def sensitivities(
    trials: Sequence[Trial], read: Sequence[StepFit], q: float, p: float, samples: int | None
) -> FloatArray:
    """Each trial's part in the errors of q and p, times how many trials there are, (n, 2).

    With delay and gain as read the response is off for a while in every trial alike, so the whole second derivative of
    the squares counts, not only that of the slopes.
    """
    since = [_since_onset([trial], [fit], samples) for trial, fit in zip(trials, read, strict=True)]

    def scores(at: FloatArray) -> FloatArray:
        q, p = at.tolist()
        shape = Shape(0.0, q, p)
        return np.array(
            [
                (height[:, None] * sensitivity(t, shape, 2)[:, 1:]).T @ (z - height * unit_response(t, q, p))
                for t, z, height in since
            ]
        )

    at = np.array([q, p])
    changes = np.minimum(_REACH * np.array([q, q * q]), 0.5 * at)
    bent = [
        (scores(at - change).sum(axis=0) - scores(at + change).sum(axis=0)) / (2.0 * change.sum())
        for change in np.diag(changes)
    ]
    return len(trials) * scores(at) @ np.linalg.pinv(np.array(bent).T)


def _since_onset(
    trials: Sequence[Trial], read: Sequence[StepFit], samples: int | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time since each onset [s], motion since then [m], and its final height [m], of all samples of all trials."""
    windows = [window(trial, samples) for trial in trials]
    pairs = list(zip(windows, read, trials, strict=True))
    return (
        np.concatenate([time - fit.shape.delay for (time, _), fit, _ in pairs]),
        np.concatenate([position - fit.zero for (_, position), fit, _ in pairs]),
        np.concatenate([np.full(len(time), fit.gain * trial.step) for (time, _), fit, trial in pairs]),
    )


def _refitted(trial: Trial, read: StepFit, order: Order, samples: int | None) -> StepFit:
    shape = Shape(read.shape.delay, *minimised([trial], [read], order, samples))
    t, z, height = _since_onset([trial], [read], samples)
    left = z - height * unit_response(t, shape.q, shape.p)
    slopes = height[:, None] * sensitivity(t, Shape(0.0, shape.q, shape.p), order)[:, 1:]
    covariance = np.zeros((order + 3, order + 3))  # what is read off has no interval of its own
    covariance[1 : order + 1, 1 : order + 1] = inverse(slopes) * float(left @ left) / max(len(t) - order, 1)
    time = window(trial, samples)[0]
    rms = float(np.sqrt(np.mean(left**2)))
    return StepFit(order, shape, read.gain, read.zero, rms, len(t), covariance, reached(time, shape), order)
