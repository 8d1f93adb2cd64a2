"""The tight path: one axis on its ticks, one sensor, measurements at the ticks or missing; one run, or many at a time.

Everything is even here, so one :class:`DiscreteModel` is all there is to know. Runs (or parameter sets on one run) lie
side by side, so that the compiler makes vector instructions of the loop across them; each core takes its share.
The state is the plant's position and rate, and the offset: v[n−1], v[n−2], … are known, and stay in the input.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray
from ..model.discrete import DiscreteModel
from . import tick_kernels as kernels


@dataclass(frozen=True)
class TickEstimates:
    """Estimates at the ticks, relative to the level at which the arm rested; shapes follow the measurements.

    Attributes:
        position: p at each tick [m], with every measurement up to it; with all of them where smoothed.
        position_sd: Its standard deviation [m].
        innovation: Measurement less its prediction [m], NaN where missing.
        innovation_sd: Its predicted standard deviation [m].
        log_likelihood: Of each run's measurements (in metres), one number a run.
    """

    position: FloatArray
    position_sd: FloatArray
    innovation: FloatArray
    innovation_sd: FloatArray
    log_likelihood: FloatArray


def filter_ticks(
    model: DiscreteModel | Sequence[DiscreteModel],
    command: npt.ArrayLike,
    measurements: npt.ArrayLike,
    sd: npt.ArrayLike,
    *,
    offset_sd: float = 0.0,
) -> TickEstimates:
    """Filter runs whose measurements are all at ticks, as :func:`pumafuse.fuse` would with this plant and noise, faster.

    There is no gain here (``command`` is v, what the gain makes of u) and no gate, and the prior of the offset is 0
    unless it is given (that of :class:`pumafuse.Start` is 5 mm).

    Args:
        model: From :func:`pumafuse.discretize`, for all runs or one for each; of one delay and period.
        command: v [m] relative to the level at rest, (steps,) for all runs or (runs, steps).
        measurements: z [m] likewise, (steps,) for one run or (runs, steps); what is not finite, or masked, is missing.
        sd: Noise of the measurements [m], one for all or one for each run.
        offset_sd: Prior standard deviation of the offset [m].

    Raises:
        ValueError: Shapes do not fit, or the models are of several delays.
    """
    many = _Many.of(model, command, measurements, sd, offset_sd)
    outputs = _room(many.runs, many.steps)
    likelihood = many.filter(outputs)
    return _shaped(outputs, likelihood, measurements)


def smooth_ticks(
    model: DiscreteModel, command: npt.ArrayLike, measurements: npt.ArrayLike, sd: float, *, offset_sd: float = 0.0
) -> TickEstimates:
    """One run as :func:`filter_ticks` has it, with positions that know every measurement of the run.

    Raises:
        ValueError: As :func:`filter_ticks`.
    """
    many = _Many.of(model, command, measurements, sd, offset_sd)
    if many.runs != 1:
        raise ValueError("smooth_ticks takes one run at a time")
    outputs, before = _room(1, many.steps), np.empty((many.steps, 4))
    likelihood = many.filter(outputs, before)
    kernels.smooth_one(many.models[0], many.prior, outputs[2], before, *outputs[:2])
    return _shaped(outputs, likelihood, measurements)


def tick_likelihood(
    model: DiscreteModel | Sequence[DiscreteModel],
    command: npt.ArrayLike,
    measurements: npt.ArrayLike,
    sd: npt.ArrayLike,
    *,
    offset_sd: float = 0.0,
) -> FloatArray:
    """Only the log-likelihood of :func:`filter_ticks`, for each run or parameter set, (runs,)."""
    many = _Many.of(model, command, measurements, sd, offset_sd)
    return many.filter(_room(many.runs, 0))


_LEAST, _MOST = 1e-15, 1e15  # m; squares and products of eight of them fit
_Outputs: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def _shaped(outputs: _Outputs, likelihood: FloatArray, measurements: npt.ArrayLike) -> TickEstimates:
    """One run given as (steps,) comes back as (steps,)."""
    flat = np.ndim(measurements) == 1 and len(likelihood) == 1
    return TickEstimates(*(part[0] if flat else part for part in outputs), log_likelihood=likelihood)


def _room(runs: int, steps: int) -> _Outputs:
    """In one piece, which costs the system half the work of four."""
    position, position_sd, innovation, innovation_sd = np.empty((4, runs, steps))
    return position, position_sd, innovation, innovation_sd


@dataclass(frozen=True)
class _Many:
    """Runs or parameter sets side by side.

    Attributes:
        models: The numbers of each, (runs, NUMBERS).
        prior: Variance of the offset at the start [m²]; None where there is none, ever.
        delay: Whole ticks of delay.
        command: (1 or runs, steps).
        measurements: (1 or runs, steps).
    """

    models: FloatArray
    prior: float | None
    delay: int
    command: FloatArray
    measurements: FloatArray

    @property
    def runs(self) -> int:
        return len(self.models)

    @property
    def steps(self) -> int:
        return self.measurements.shape[1]

    @staticmethod
    def of(
        model: DiscreteModel | Sequence[DiscreteModel],
        command: npt.ArrayLike,
        measurements: npt.ArrayLike,
        sd: npt.ArrayLike,
        offset_sd: float,
    ) -> _Many:
        models = [model] if isinstance(model, DiscreteModel) else list(model)
        u, z = _in_rows(command), _in_rows(measurements)
        noise = np.atleast_1d(np.asarray(sd, dtype=np.float64))
        runs = max(len(models), len(u), len(z), len(noise))
        for name, count in (
            ("models", len(models)),
            ("commands", len(u)),
            ("measurements", len(z)),
            ("sd", len(noise)),
        ):
            if count not in (1, runs):
                raise ValueError(f"{name} are for {count} runs, others for {runs}; give one for all, or one each")
        if u.ndim != 2 or z.ndim != 2:
            raise ValueError("commands and measurements are (steps,) or (runs, steps)")
        if not np.isfinite(u).all():
            raise ValueError("a command that is not a finite number")
        if u.shape[1] != z.shape[1]:
            raise ValueError(f"{u.shape[1]} commands and {z.shape[1]} measurements a run; give one of each for a tick")
        if len({(one.delay, one.period) for one in models}) > 1:
            raise ValueError("the models are of several delays or periods; give one at a time")
        if noise.ndim != 1 or not ((noise >= _LEAST) & (noise <= _MOST)).all() or not 0.0 <= offset_sd <= _MOST:
            raise ValueError(
                f"sd must be one number, or one for each run, of {_LEAST:g} to {_MOST:g} m; offset_sd too, or 0"
            )
        if any("position" not in one.states for one in models):
            raise ValueError("the tight path knows plants of first and second order")
        numbers = np.empty((runs, kernels.NUMBERS))
        numbers[:] = [_numbers(one) for one in models]
        numbers[:, 12] = noise**2
        prior = offset_sd**2 if numbers[:, 11].any() or offset_sd else None
        return _Many(numbers, prior, models[0].split[0], u, z)

    def filter(self, outputs: _Outputs, before: FloatArray | None = None) -> FloatArray:
        """Fill the outputs; returns the log-likelihood of each run. Each core has its share of the runs."""
        likelihood = np.zeros(self.runs)
        if self.runs == 1:
            before = np.empty((0, 4)) if before is None else before
            one = (self.models[0], self.prior, self.delay, self.command[0], self.measurements[0], likelihood)
            kernels.filter_one(*one, *outputs, before)
            return likelihood
        cores, groups = usable_cores(), -(-self.runs // kernels.LANES)
        edges = [groups * part // cores * kernels.LANES for part in range(cores)] + [self.runs]
        shares = [(first, end) for first, end in pairwise(edges) if first < end]
        many = (self.models, self.prior, self.delay, self.command, self.measurements, likelihood)

        def work(share: tuple[int, int]) -> None:
            kernels.filter_many(*many, *outputs, *share, np.empty(kernels.ROOM))

        with ThreadPoolExecutor(len(shares)) as pool:
            list(pool.map(work, shares))
        return likelihood


def _in_rows(values: npt.ArrayLike) -> FloatArray:
    """(runs, steps), NaN where a masked array is masked."""
    masked = np.ma.asarray(values, dtype=np.float64)
    return np.atleast_2d(np.ascontiguousarray(masked.filled(np.nan)))


def usable_cores() -> int:
    """Of this process, where the system says; else all."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
    found[[8, 9, 10] if n == 2 else [8]] = model.Q[[0, 0, 1][: 2 * n - 1], [0, 1, 1][: 2 * n - 1]]
    if register > n:
        found[11] = model.Q[n, n]
    return found
