"""Maximising: each step is the best in its box, and the search ends at a maximum."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.tuning.likelihood import Derivatives, Likelihood, Point
from pumafuse.tuning.maximise import derivatives, maximise, point
from pumafuse.tuning.parameters import Fit, Parameter, moved
from pumafuse.tuning.steps import bounded_step
from tuning_runs import free_of, outage, spoiled_arm


def coordinates(free: Sequence[Parameter], config: pf.FusionConfig) -> np.ndarray:
    return np.array([one.coordinate(one.number(config)) for one in free])


def still_to_gain(likelihood: Likelihood, at: Point, free: Sequence[Parameter]) -> float:
    """The gain that a quadratic predicts from a point, ½ gᵀ I⁻¹ g, for all parameters that are not at a bound.

    For one with hardly any information, a noise near 0, it is the score times the distance to the bound.
    """
    found, where = derivatives(likelihood, at, free), coordinates(free, at.config)
    low, high = np.array([one.range for one in free]).T
    inside = ~((where <= low + 1e-9) & (found.score < 0.0) | (where >= high - 1e-9) & (found.score > 0.0))
    known = inside & (np.diag(found.information) > 1e-6)
    g, information = found.score[known], found.information[np.ix_(known, known)]
    room = np.where(found.score > 0.0, high - where, where - low)[inside & ~known]
    return 0.5 * float(g @ np.linalg.solve(information, g)) + float(np.abs(found.score[inside & ~known]) @ room)


@pytest.mark.parametrize(("fit", "seed"), [(("noise",), 1), (("noise", "delay", "plant"), 2)], ids=["noise", "plant"])
def test_a_search_ends_at_a_maximum(seed: int, fit: Sequence[Fit]) -> None:
    """With fixed outcomes the likelihood is smooth: at the end ½ gᵀ I⁻¹ g is below 0.01, at the start above 100.

    Nothing near it is higher, along any parameter and in 50 random directions. Every step rises and stays in the box.
    """
    sim = outage(seed)
    config = spoiled_arm(sim.config)
    likelihood = Likelihood([sim.run], config)
    outcomes = likelihood.evaluate(sim.config).outcomes
    free = free_of(likelihood, config, fit)
    start = point(likelihood, config, free, outcomes)
    assert still_to_gain(likelihood, start, free) > 100.0
    seen = [start]
    best = maximise(likelihood, config, free, seen.append, outcomes)
    assert len(seen) > 3 and (np.diff([one.log_posterior for one in seen]) > 0.0).all()
    for one in free:
        low, high = one.bounds
        assert all(low * (1.0 - 1e-12) <= one.number(at.config) <= high * (1.0 + 1e-12) for at in seen)
    again = point(likelihood, best.config, free, outcomes)
    assert seen[-1].log_posterior == best.log_posterior == again.log_posterior > start.log_posterior + 100.0
    assert still_to_gain(likelihood, best, free) < 0.01
    rng, here = np.random.default_rng(seed), coordinates(free, best.config)
    size = 0.3 * np.array([one.scale for one in free])
    ways = [*np.diag(size), *-np.diag(size), *(rng.standard_normal((50, len(free))) * 0.3 * size)]
    for way in ways:
        there = moved(best.config, free, here + way)
        assert point(likelihood, there, free, outcomes).log_posterior < best.log_posterior + 0.01


def test_a_search_ends_early_only_where_it_cannot_be_worth_it() -> None:
    """Half below the maximum, the end is the same to the bit; far above it, a few steps show it out of reach."""
    sim = outage(1)
    config = spoiled_arm(sim.config)
    likelihood = Likelihood([sim.run], config)
    outcomes = likelihood.evaluate(sim.config).outcomes
    free = free_of(likelihood, config, ("noise", "delay", "plant"))
    whole, some = list[Point](), list[Point]()
    best = maximise(likelihood, config, free, whole.append, outcomes)
    worth = maximise(likelihood, config, free, outcomes=outcomes, worth=best.log_posterior - 0.5)
    assert worth.log_posterior == best.log_posterior
    left = maximise(likelihood, config, free, some.append, outcomes, worth=best.log_posterior + 1e5)
    assert len(some) < len(whole) // 2
    assert left.log_posterior == some[-1].log_posterior < best.log_posterior - 0.5


@st.composite
def problems(draw: st.DrawFn) -> tuple[Derivatives, np.ndarray, np.ndarray, np.ndarray]:
    """A score, an information with scales apart by up to 10⁶ and at times nearly singular, a box with 0 in it."""
    count, seed = draw(st.integers(1, 7)), draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-3.0, 3.0, count)
    root = rng.standard_normal((count, draw(st.integers(max(1, count - 1), count + 3))))
    information = root @ root.T * np.outer(scale, scale)
    low, high = (-rng.exponential(draw(st.sampled_from([0.1, 1.0, 10.0])), count) / scale for _ in range(2))
    edge = rng.random(count)  # a number at a bound can move but one way
    low, high = np.where(edge < 0.2, 0.0, low), np.where(edge > 0.8, 0.0, -high)
    damping = np.full(count, draw(st.sampled_from([1e-4, 1e-2, 1.0])))
    return Derivatives(rng.standard_normal(count) * scale, information, information), low, high, damping


@settings(max_examples=200)
@given(problems())
def test_a_step_is_the_best_there_is_in_its_box(
    problem: tuple[Derivatives, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Karush, Kuhn and Tucker: inside, the slope of ½ δᵀ(I + λ diag I)δ − gᵀδ is 0, at an edge it points outward."""
    found, low, high, damping = problem
    step = bounded_step(found.score, found.information, low, high, damping)
    size = 1.0 / np.sqrt(np.diag(found.information))
    tiny = 1e-9 * (high - low)
    assert ((step >= low - tiny) & (step <= high + tiny)).all()
    matrix = found.information + np.diag(damping * np.diag(found.information))
    slope = size * (found.score - matrix @ step)
    close = 1e-6 * (1.0 + np.abs(size * found.score).max())
    assert (slope[step > low + tiny] > -close).all()
    assert (slope[step < high - tiny] < close).all()
