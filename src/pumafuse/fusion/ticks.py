"""The tight path: one axis on its ticks, one sensor, readings at the ticks or missing; one run, or many at a time.

Everything is even here, so one :class:`DiscreteModel` is all there is to know. Runs (or parameter sets on one run) lie
side by side, so that the compiler makes vector instructions of the loop across them; each core takes its share.
The state is the plant's position and rate, and the offset: v[n−1], v[n−2], … are known, and stay in the input.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray
from ..compiled import maybe_compiling
from ..model.discrete import DiscreteModel
from . import tick_kernels as kernels


@dataclass(frozen=True)
class TickEstimates:
    """Estimates at the ticks, relative to the level at which the arm rested; shapes follow the readings.

    Attributes:
        position: p[n] [m], with every reading up to n; with all readings where smoothed.
        position_sd: Its standard deviation [m].
        velocity: The plant's rate [m/s] (of a first-order plant 0: its rate is no state).
        velocity_sd: Its standard deviation [m/s].
        innovation: z[n] less its prediction [m], NaN where missing.
        innovation_sd: Its predicted standard deviation [m].
        log_likelihood: Of each run's readings (in metres), one number a run.
    """

    position: FloatArray
    position_sd: FloatArray
    velocity: FloatArray
    velocity_sd: FloatArray
    innovation: FloatArray
    innovation_sd: FloatArray
    log_likelihood: FloatArray


def filter_ticks(
    model: DiscreteModel | Sequence[DiscreteModel],
    command: npt.ArrayLike,
    readings: npt.ArrayLike,
    sd: npt.ArrayLike,
    *,
    offset_sd: float = 0.0,
) -> TickEstimates:
    """Filter runs whose readings are all at ticks, as :func:`pumafuse.fuse` would, faster.

    Args:
        model: From :func:`pumafuse.discretize`, for all runs or one for each; of one delay and period.
        command: v [m] relative to the level at rest, (steps,) for all runs or (runs, steps).
        readings: z [m] likewise, NaN where missing, (steps,) for one run or (runs, steps).
        sd: Noise of the readings [m], one for all or one for each run.
        offset_sd: Prior standard deviation of the offset [m].

    Raises:
        ValueError: Shapes do not fit, or the models are of several delays.
    """
    many = _Many.of(model, command, readings, sd, offset_sd)
    outputs = [np.empty((many.runs, many.steps)) for _ in range(6)]
    likelihood = np.zeros(many.runs)
    if many.runs == 1:
        with maybe_compiling():
            kernels.filter_one(many.models[0], many.delay, many.command[0], many.readings[0], likelihood, *outputs)
    else:
        many.share(
            lambda first, end, room: kernels.filter_many(
                many.models, many.delay, many.command, many.readings, first, end, room, likelihood, *outputs
            )
        )
    shaped = [part[0] for part in outputs] if np.ndim(readings) == 1 and many.runs == 1 else outputs
    return TickEstimates(*shaped, log_likelihood=likelihood)


def tick_likelihood(
    model: DiscreteModel | Sequence[DiscreteModel],
    command: npt.ArrayLike,
    readings: npt.ArrayLike,
    sd: npt.ArrayLike,
    *,
    offset_sd: float = 0.0,
) -> FloatArray:
    """Only the log-likelihood of :func:`filter_ticks`, for each run or parameter set, (runs,)."""
    many = _Many.of(model, command, readings, sd, offset_sd)
    likelihood = np.zeros(many.runs)
    nothing = [np.empty((many.runs, 0)) for _ in range(6)]
    many.share(
        lambda first, end, room: kernels.filter_many(
            many.models, many.delay, many.command, many.readings, first, end, room, likelihood, *nothing
        )
    )
    return likelihood


@dataclass(frozen=True)
class _Many:
    """Runs or parameter sets side by side.

    Attributes:
        models: The numbers of each, (runs, NUMBERS).
        delay: Whole ticks of delay.
        command: (1 or runs, steps).
        readings: (1 or runs, steps).
    """

    models: FloatArray
    delay: int
    command: FloatArray
    readings: FloatArray

    @property
    def runs(self) -> int:
        return len(self.models)

    @property
    def steps(self) -> int:
        return self.readings.shape[1]

    @staticmethod
    def of(
        model: DiscreteModel | Sequence[DiscreteModel],
        command: npt.ArrayLike,
        readings: npt.ArrayLike,
        sd: npt.ArrayLike,
        offset_sd: float,
    ) -> _Many:
        models = [model] if isinstance(model, DiscreteModel) else list(model)
        u = np.atleast_2d(np.ascontiguousarray(command, dtype=np.float64))
        z = np.atleast_2d(np.ascontiguousarray(readings, dtype=np.float64))
        noise = np.atleast_1d(np.asarray(sd, dtype=np.float64))
        runs = max(len(models), len(u), len(z), len(noise))
        for name, count in (("models", len(models)), ("commands", len(u)), ("readings", len(z)), ("sd", len(noise))):
            if count not in (1, runs):
                raise ValueError(f"{name} are for {count} runs, others for {runs}; give one for all, or one each")
        if u.shape[1] != z.shape[1]:
            raise ValueError(f"{u.shape[1]} commands and {z.shape[1]} readings a run; give one of each for a tick")
        if len({(one.delay, one.period) for one in models}) > 1:
            raise ValueError("the models are of several delays or periods; give one at a time")
        if not ((noise > 0.0) & np.isfinite(noise)).all() or not 0.0 <= offset_sd < np.inf:
            raise ValueError("sd must be positive, offset_sd not negative, both finite")
        numbers = np.empty((runs, kernels.NUMBERS))
        numbers[:] = [_numbers(one) for one in models]
        numbers[:, 12], numbers[:, 13] = noise**2, offset_sd**2
        return _Many(numbers, models[0].split[0], u, z)

    def share(self, work: Callable[[int, int, FloatArray], None]) -> None:
        """Do ``work`` on a share of the runs, in whole groups of lanes, on each core."""
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        groups = -(-self.runs // kernels.LANES)
        edges = [groups * part // cores * kernels.LANES for part in range(cores)] + [self.runs]
        shares = [(first, end, np.empty(kernels.ROOM)) for first, end in pairwise(edges) if first < end]
        with maybe_compiling(), ThreadPoolExecutor(len(shares)) as pool:
            list(pool.map(work, *zip(*shares, strict=True)))


def _numbers(model: DiscreteModel) -> FloatArray:
    """What the kernels need of a model; a first-order plant has a rate that is always 0."""
    found = np.zeros(kernels.NUMBERS)
    delay, rest = model.split
    n = sum(name in ("position", "rate") for name in model.states)
    register = n + ("offset" in model.states)
    recent = model.B[:n, 0] if delay == 0 else model.F[:n, register + delay - 1]
    before = model.F[:n, register + delay] if rest > 0.0 else np.zeros(n)
    found[[0, 1, 2, 3] if n == 2 else [0]] = model.F[:n, :n].ravel()
    found[4 : 4 + n], found[6 : 6 + n] = recent, before
    found[[8, 9, 10] if n == 2 else [8]] = model.Q[:n, :n][np.triu_indices(n)]
    if register > n:
        found[11] = model.Q[n, n]
    return found
