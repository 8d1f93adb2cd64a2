"""pumafuse's own adapters, see `peers`.

It knows its start exactly, at rest, on the tick of the first command. The problem's first sample comes one period
after that, so pumafuse is given one tick more, at the front, without a sample; what it says of that tick is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from peers import Peer

import pumafuse as pf
from model import DELAY, OMEGA, PERIOD, ZETA, Array, Filtered, Model, Problem, Smoothed


def discrete(model: Model) -> pf.DiscreteModel:
    """The same model from the plant's own numbers; not timed, as for the peers."""
    plant = pf.SecondOrder(natural_frequency=OMEGA, damping=ZETA)
    return pf.discretize(plant, PERIOD, DELAY, input_noise=model.input_noise)


def from_rest(problem: Problem) -> tuple[Array, Array]:
    """Commands and samples with the tick at rest in front."""
    front = [(0, 0)] * (problem.z.ndim - 1) + [(1, 0)]
    return np.pad(problem.u, front), np.pad(problem.z, front, constant_values=np.nan)


def filtered(problem: Problem) -> Callable[[], pf.TickEstimates]:
    """One run or many."""
    model, sd = discrete(problem.model), np.sqrt(problem.model.R)
    u, z = from_rest(problem)
    return partial(pf.filter_ticks, model, u, z, sd)


def smoothed(problem: Problem) -> Callable[[], pf.TickEstimates]:
    """One run."""
    model, sd = discrete(problem.model), float(np.sqrt(problem.model.R))
    u, z = from_rest(problem)
    return partial(pf.smooth_ticks, model, u, z, sd)


def one_by_one(problem: Problem) -> Callable[[], Array]:
    """One call per model."""
    models = [(discrete(m), np.sqrt(m.R)) for m in problem.grid]
    u, z = from_rest(problem)
    return lambda: np.concatenate([pf.tick_likelihood(model, u, z, sd) for model, sd in models])


def grid(problem: Problem) -> Callable[[], Array]:
    """One call for all models."""
    models, sd = [discrete(m) for m in problem.grid], np.sqrt([m.R for m in problem.grid])
    u, z = from_rest(problem)
    return partial(pf.tick_likelihood, models, u, z, sd)


def as_filtered(est: pf.TickEstimates) -> Filtered:
    """Position alone, variances for standard deviations."""
    position, variance = est.position[..., 1:, None], est.position_sd[..., 1:, None, None] ** 2
    one = est.position.ndim == 1
    total = est.log_likelihood[0] if one else est.log_likelihood
    return Filtered(position, variance, est.innovation[..., 1:], est.innovation_sd[..., 1:] ** 2, np.asarray(total))


def as_smoothed(est: pf.TickEstimates) -> Smoothed:
    """Likewise."""
    return Smoothed(est.position[1:, None], est.position_sd[1:, None, None] ** 2)


OUTPUTS = "gives the position alone, its sd, and innovations with theirs"
OURS: tuple[Peer, ...] = (
    Peer("pumafuse", "filter", filtered, OUTPUTS, result=as_filtered),
    Peer("pumafuse", "batch", filtered, "the same; all cores", result=as_filtered),
    Peer("pumafuse", "likelihood", one_by_one, "one call for each model"),
    Peer("pumafuse", "grid", grid, "one call for all models; all cores"),
    Peer("pumafuse", "smooth", smoothed, "the same as for filter", result=as_smoothed),
)
