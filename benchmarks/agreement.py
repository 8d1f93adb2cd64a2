"""What every peer has to agree with: a plain dense filter, and smoothing by conditioning on all samples at once."""

from __future__ import annotations

from typing import Any

import numpy as np

from model import Array, Filtered, Model, Problem, Smoothed

# Of each quantity's own size (see `error`). Rounding alone leaves peers some 1e-12 apart; a wrong convention for the
# input, the start or a missing sample shows above 1e-4.
TOLERANCE = 1e-8


def filter_run(model: Model, u: Array, z: Array) -> Filtered:
    """The textbook recursion over one run."""
    x, P = np.zeros(len(model.F)), model.start
    rows: list[tuple[Any, ...]] = []
    total = 0.0
    for command, sample in zip(u, z, strict=True):
        v, S = sample - model.H @ x, model.H @ P @ model.H + model.R
        if not np.isnan(sample):
            K = P @ model.H / S
            x, P = x + K * v, P - np.outer(K, K) * S
            total -= 0.5 * (np.log(2.0 * np.pi * S) + v**2 / S)
        rows.append((x, P, v, S))
        x, P = model.F @ x + model.B * command, model.F @ P @ model.F.T + model.Q
    mean, cov, innovation, variance = map(np.array, zip(*rows, strict=True))
    return Filtered(mean, cov, innovation, variance, np.array(total))


def filter_reference(problem: Problem) -> Filtered:
    """`filter_run` over one run or several."""
    if problem.z.ndim == 1:
        return filter_run(problem.model, problem.u, problem.z)
    runs = [filter_run(problem.model, u, z) for u, z in zip(problem.u, problem.z, strict=True)]
    return Filtered(*(np.array([getattr(run, name) for run in runs]) for name in Filtered.__dataclass_fields__))


def likelihood_reference(problem: Problem) -> Array:
    """Log-likelihood per model of the grid."""
    return np.array([filter_run(model, problem.u, problem.z).log_likelihood for model in problem.grid])


def smooth_reference(problem: Problem) -> Smoothed:
    """The joint Gaussian of all states conditioned on all samples; shares nothing with any recursion but F."""
    model, steps, n = problem.model, len(problem.z), len(problem.model.F)
    prior_mean = np.zeros((steps, n))
    joint = np.zeros((steps, n, steps, n))
    P = model.start
    for k in range(steps):
        across = P
        for later in range(k, steps):
            joint[later, :, k], joint[k, :, later] = across, across.T
            across = model.F @ across
        if k + 1 < steps:
            prior_mean[k + 1] = model.F @ prior_mean[k] + model.B * problem.u[k]
        P = model.F @ P @ model.F.T + model.Q
    kept = ~np.isnan(problem.z)
    cross = (joint @ model.H)[:, :, kept]
    seen = np.einsum("i,kil->kl", model.H, cross)[kept] + model.R * np.eye(kept.sum())
    gain = np.linalg.solve(seen, cross.reshape(steps * n, -1).T).T.reshape(cross.shape)
    mean = prior_mean + gain @ (problem.z - prior_mean @ model.H)[kept]
    cov = np.einsum("kikj->kij", joint) - gain @ cross.swapaxes(-1, -2)
    return Smoothed(mean, cov)


def error(got: Filtered | Smoothed | Array, wanted: Filtered | Smoothed | Array) -> float:
    """The largest difference, each quantity's over its own largest value.

    A state's mean and an entry of the covariance each have a largest value of their own; where it is 0 the difference
    stands as it is. A peer's means and covariance may be of the leading states alone.
    """
    if isinstance(wanted, np.ndarray):
        assert isinstance(got, np.ndarray)
        return float(np.max(np.abs(got - wanted) / np.abs(wanted)))
    assert not isinstance(got, np.ndarray)
    k, m = got.mean.shape[-1], got.cov.shape[-1]
    parts = [(got.mean, wanted.mean[..., :k], 1), (got.cov, wanted.cov[..., :m, :m], 2)]
    if isinstance(wanted, Filtered):
        rest = ("innovation", "innovation_variance", "log_likelihood")
        parts += [(getattr(got, name), getattr(wanted, name), 0) for name in rest]
    return max(_relative(*part) for part in parts)


def _relative(got: Array, wanted: Array, own: int) -> float:
    """The largest difference over the largest of ``wanted``; each index of the last ``own`` axes has its own."""
    if got.shape != wanted.shape or not np.array_equal(np.isnan(got), np.isnan(wanted)):
        return np.inf
    scale = np.nanmax(np.abs(wanted).reshape(-1, *wanted.shape[wanted.ndim - own :]), axis=0)
    return float(np.nanmax(np.abs(got - wanted) / np.where(scale > 0.0, scale, 1.0)))
