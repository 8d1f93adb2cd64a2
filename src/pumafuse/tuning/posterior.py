"""The posterior of an axis's arm, averaged over models and dead times: how late it is, and how sure that is.

Neither the order of a plant nor the kind of its gain is known, and along a dead time the likelihood has many maxima,
also whole update periods away. An interval from one maximum is too narrow. So intervals are quantiles of the mixture of
all models at all dead times about their maxima (Rue, Martino & Chopin, "Approximate Bayesian inference by integrated
nested Laplace approximations", JRSS B 71, 2009); :mod:`.arm_search` finds these.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from ..arrays import FloatArray, IntArray
from .arms import BENDS, Arm

# s, but for the gain, ω [rad/s], ζ, play [m] and the fastest speed [m/s]
QUANTITIES = ("lag", "delay", "gain", "gain_recovery", "time_constant", "natural_frequency", "damping", *BENDS)
Quantity: TypeAlias = str  # one of these
GainKind: TypeAlias = Literal["given", "static", "recovering"]
GAINS: tuple[GainKind, ...] = get_args(GainKind)

SHORTEST = 2e-5  # s, between two dead times that differ
_NEVER = 1e-9  # a probability that is as good as none
_GRID = 2000  # points of a distribution, at most
_REFINED = 8  # points between two dead times, along which everything is interpolated
_AS_LIKELY = 0.2  # of the most likely model's probability: the simplest of such models is taken
_SHARED = 2.3  # log-odds that an axis has the delay of the others: ten to one, since it is mostly the controller's
_OWN_WIDTH = 0.05  # s: how far apart the dead times of axes that do not share one are a priori


class Model(NamedTuple):
    """An order of the plant with a kind of gain."""

    order: int
    gain: GainKind

    @property
    def size(self) -> int:
        """How many numbers it has beside the delay."""
        return self.order + GAINS.index(self.gain)


MODELS = tuple(Model(*pair) for pair in product((1, 2), GAINS))


@dataclass(frozen=True)
class Entry:
    """The most likely arm of a model with one delay."""

    arm: Arm  # the arm
    log_density: float  # of the delay and the model, with Laplace's approximation for the other numbers
    means: Mapping[Quantity, float]  # of each quantity that the model has
    sds: Mapping[Quantity, float]  # their standard deviations at this delay


@dataclass(frozen=True)
class Branch:
    """The entries of a model about one of its maxima, by delay."""

    model: Model
    entries: Sequence[Entry]

    @property
    def delays(self) -> FloatArray:
        """Delays of the entries [s], (n,)."""
        return np.array([entry.arm.delay for entry in self.entries])

    @property
    def log_density(self) -> FloatArray:
        """Log-densities of the entries, (n,)."""
        return np.array([entry.log_density for entry in self.entries])

    def at(self, delays: FloatArray) -> FloatArray:
        """The log-density at delays, (m,): beyond the ends as it falls there; where it does not, that is not known."""
        here, logs = self.delays, self.log_density
        if len(here) < 2:
            return np.where(np.abs(delays - here[0]) < SHORTEST, logs[0], -np.inf)
        low, high = (logs[1] - logs[0]) / (here[1] - here[0]), (logs[-1] - logs[-2]) / (here[-1] - here[-2])
        below = logs[0] + low * (delays - here[0]) if low > 0.0 else -np.inf
        above = logs[-1] + high * (delays - here[-1]) if high < 0.0 else -np.inf
        middle = np.interp(delays, here, logs)
        return np.where(delays < here[0], below, np.where(delays > here[-1], above, middle))


class Mixture(NamedTuple):
    """Points of all branches between their entries, (n,)."""

    weight: FloatArray  # their probabilities
    model: FloatArray  # numbers in :data:`MODELS`
    delay: FloatArray  # their delays [s]
    mean: Mapping[Quantity, FloatArray]  # of each quantity there; NaN where the model does not have it
    sd: Mapping[Quantity, FloatArray]  # its standard deviation there
    nearest: IntArray  # numbers of the nearest entries, in order of branches

    def log_odds(self, chosen: Callable[[Model], bool]) -> float:
        """The logarithm of how much likelier the models that are chosen are than the others."""
        models = np.array([chosen(model) for model in MODELS])[self.model.astype(np.int64)]
        chosen_weight, others = (float(self.weight[some].sum()) for some in (models, ~models))
        return math.log(max(chosen_weight, _NEVER)) - math.log(max(others, _NEVER))

    def quantiles(self, quantity: Quantity, chosen: Callable[[Model], bool]) -> tuple[float, ...]:
        """The ends of the middle 95 % of a quantity under the models that are chosen."""
        from scipy.special import ndtr  # takes a while to import

        models = np.array([chosen(model) for model in MODELS])
        rows = models[self.model.astype(np.int64)] & np.isfinite(self.mean[quantity]) & (self.weight > 1e-9)
        mean, sd, weight = self.mean[quantity][rows], self.sd[quantity][rows], self.weight[rows]
        sd = np.maximum(sd, 1e-12)
        grid = np.unique(np.concatenate([mean + times * sd for times in np.linspace(-4.0, 4.0, 33)]))
        if len(grid) > _GRID:
            grid = grid[np.linspace(0, len(grid) - 1, _GRID).astype(np.int64)]
        below = ndtr((grid[:, None] - mean) / sd) @ weight / weight.sum()
        return tuple(float(np.interp(0.5 + sign * 0.475, below, grid)) for sign in (-1.0, 1.0))


@dataclass(frozen=True)
class AxisPosterior:
    """The posterior of one axis."""

    branches: Sequence[Branch]  # of all models that count

    def arms(self, mixture: Mixture) -> list[tuple[Arm, float]]:
        """The arms of all entries with their probabilities by a :meth:`mixture`."""
        entries = [entry for branch in self.branches for entry in branch.entries]
        weight = np.bincount(mixture.nearest, mixture.weight, len(entries))
        return [(entry.arm, share) for entry, share in zip(entries, weight.tolist(), strict=True)]

    def log_density(self, delays: FloatArray) -> FloatArray:
        """The log-density of the delay, all models together, (m,)."""
        densities = np.full(len(delays), -np.inf)
        for model in dict.fromkeys(branch.model for branch in self.branches):  # one order in every process: it rounds
            each = [branch.at(delays) for branch in self.branches if branch.model == model]
            densities = np.logaddexp(densities, np.max(each, axis=0))
        return densities

    def mixture(self, others: Iterable[AxisPosterior] = (), sharing: float = 1.0) -> Mixture:
        """The mixture, with what other axes say of the dead time, as it is likely by ``sharing`` that they share it."""
        parts = [self._points(branch) for branch in self.branches]
        firsts = np.cumsum([0, *(len(branch.entries) for branch in self.branches[:-1])])
        delay = np.concatenate([part.delay for part in parts])
        weights = np.concatenate([part.weight for part in parts])
        shared = weights + sum(other.log_density(delay) for other in others)
        together, alone = (np.exp(logs - logs.max()) for logs in (shared, weights))
        return Mixture(
            sharing * together / together.sum() + (1.0 - sharing) * alone / alone.sum(),
            np.concatenate([part.model for part in parts]),
            delay,
            {name: np.concatenate([part.mean[name] for part in parts]) for name in QUANTITIES},
            {name: np.concatenate([part.sd[name] for part in parts]) for name in QUANTITIES},
            np.concatenate([first + part.nearest for first, part in zip(firsts, parts, strict=True)]),
        )

    def _points(self, branch: Branch) -> Mixture:
        """Points between the entries of a branch; the logarithms of their weights."""
        delays, count = branch.delays, len(branch.entries)
        position, index = np.linspace(0.0, count - 1.0, _REFINED * (count - 1) + 1), np.arange(count)
        delay = np.interp(position, index, delays)
        width = np.gradient(delay) if len(delay) > 1 else np.array([SHORTEST])
        log = branch.at(delay) + np.log(width)
        for other in self.branches:  # of two maxima that meet, each counts where it is the higher one
            if other is not branch and other.model == branch.model:
                log = np.where(other.at(delay) > branch.at(delay) + 1e-9, -np.inf, log)

        def between(values: list[float]) -> FloatArray:
            return np.asarray(np.interp(position, index, values), dtype=np.float64)

        return Mixture(
            np.asarray(log, dtype=np.float64),
            np.full(len(delay), float(MODELS.index(branch.model))),
            np.asarray(delay, dtype=np.float64),
            {name: between([entry.means.get(name, np.nan) for entry in branch.entries]) for name in QUANTITIES},
            {name: between([entry.sds.get(name, np.nan) for entry in branch.entries]) for name in QUANTITIES},
            np.rint(position).astype(np.int64),
        )


# ---- axes together --------------------------------------------------------------------------------------------------


def sharing(posteriors: Mapping[str, AxisPosterior]) -> tuple[list[str], dict[str, float]]:
    """The axes that share one delay, and by how much the measurements of each axis are likelier with one of its own.

    Those share one to which an own one is not worth it. The delays of axes that do not are taken to lie within some
    50 ms of each other.
    """
    gain, shares = _gain_of_sharing(posteriors) if len(posteriors) > 1 else None, list(posteriors)
    while gain and len(shares) > 1:
        worth = {
            axis: gain(other for other in shares if other != axis) - gain(dict.fromkeys([*shares, axis]))
            for axis in posteriors
        }
        alone = max(shares, key=lambda axis: worth[axis])
        if worth[alone] <= 0.0:
            return shares, worth
        shares.remove(alone)
    return [], {}


def _gain_of_sharing(posteriors: Mapping[str, AxisPosterior]) -> Callable[[Iterable[str]], float]:
    """How much likelier one delay for some axes is than one each."""
    grid = _grid(posteriors.values())
    width = np.gradient(grid)
    logs = {axis: posterior.log_density(grid) for axis, posterior in posteriors.items()}

    def evidence(log: FloatArray) -> float:
        top = float(log.max())
        return top + math.log(float(np.exp(log - top) @ width)) if np.isfinite(top) else -np.inf

    alone = {axis: evidence(log) for axis, log in logs.items()}

    def gain(axes: Iterable[str]) -> float:
        together = list(axes)
        if len(together) < 2:
            return 0.0
        price = (len(together) - 1) * (math.log(_OWN_WIDTH) + _SHARED)
        return (
            evidence(np.sum([logs[axis] for axis in together], axis=0)) - sum(alone[axis] for axis in together) + price
        )

    return gain


def shared_delay(posteriors: Sequence[AxisPosterior]) -> float:
    """The delay of axes that share one [s]: the median of what they say together."""
    grid = _grid(posteriors)
    log: FloatArray = np.sum([posterior.log_density(grid) for posterior in posteriors], axis=0)
    weight: FloatArray = np.exp(log - log.max()) * np.asarray(np.gradient(grid), dtype=np.float64)
    below: FloatArray = np.cumsum(weight) - 0.5 * weight
    return float(np.interp(0.5 * float(weight.sum()), below, grid))


def _grid(posteriors: Iterable[AxisPosterior]) -> FloatArray:
    """Delays that resolve the densities of all axes [s], ascending."""
    delays = np.unique(np.concatenate([branch.delays for posterior in posteriors for branch in posterior.branches]))
    if len(delays) < 2:
        return delays[0] + SHORTEST * np.arange(-1.0, 2.0)
    position = np.linspace(0.0, len(delays) - 1.0, _REFINED * (len(delays) - 1) + 1)
    return np.interp(position, np.arange(len(delays)), delays)


def chosen_model(mixture: Mixture) -> Model:
    """The simplest of the models that are about as likely as the most likely one."""
    shares = [float(mixture.weight[mixture.model == number].sum()) for number in range(len(MODELS))]
    likely = [model for model, share in zip(MODELS, shares, strict=True) if share >= _AS_LIKELY * max(shares)]
    return min(likely, key=lambda model: model.size)
