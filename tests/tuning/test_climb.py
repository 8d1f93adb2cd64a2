"""The way up: each step is the best there is, and it ends where nothing is left to gain."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.tuning.climb import Point, _step, climb, point, settle, slopes
from pumafuse.tuning.likelihood import Evidence, Slopes
from pumafuse.tuning.parameters import Fit, Parameter, moved
from tuning_runs import (
    free_of,
    outage,
    replaced,
    scenario,
    spoiled,
    spoiled_arm,
    with_outliers,
    with_process,
    with_sensors,
)


def coordinates(free: Sequence[Parameter], config: pf.FusionConfig) -> np.ndarray:
    return np.array([one.coordinate(one.get(config)) for one in free])


def still_to_gain(evidence: Evidence, at: Point, free: Sequence[Parameter]) -> float:
    """What a quadratic through a point promises beyond it, ½ gᵀ I⁻¹ g, of all that could still move that way.

    What the measurements hardly tell, a noise near none, promises its slope times all the room it has.
    """
    found, where = slopes(evidence, at, free), coordinates(free, at.config)
    low, high = np.array([one.range for one in free]).T
    inside = ~((where <= low + 1e-9) & (found.score < 0.0) | (where >= high - 1e-9) & (found.score > 0.0))
    told = inside & (np.diag(found.information) > 1e-6)
    g, information = found.score[told], found.information[np.ix_(told, told)]
    room = np.where(found.score > 0.0, high - where, where - low)[inside & ~told]
    return 0.5 * float(g @ np.linalg.solve(information, g)) + float(np.abs(found.score[inside & ~told]) @ room)


# ---- one climb ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("fit", [("noise",), ("noise", "delay", "plant")], ids=["noise", "plant"])
def test_a_climb_ends_where_nothing_is_left_to_gain(seed: int, fit: Sequence[Fit]) -> None:
    """With outcomes as they are the likelihood is smooth: at the end ½ gᵀ I⁻¹ g is below 0.01, far below at the start.

    Nothing near it is higher: not along any number, and not in 50 random directions.
    """
    sim = outage(seed)
    config = spoiled_arm(sim.config)
    evidence = Evidence([sim.run], config)
    outcomes = evidence.value(sim.config).outcomes
    free = free_of(evidence, config, fit)
    start = point(evidence, config, free, outcomes)
    assert still_to_gain(evidence, start, free) > 100.0
    best = climb(evidence, config, free, outcomes=outcomes)
    assert best.height == point(evidence, best.config, free, outcomes).height > start.height + 100.0
    assert still_to_gain(evidence, best, free) < 0.01
    rng, here = np.random.default_rng(seed), coordinates(free, best.config)
    size = 0.3 * np.array([one.scale for one in free])
    ways = [*np.diag(size), *-np.diag(size), *(rng.standard_normal((50, len(free))) * 0.3 * size)]
    for way in ways:
        there = moved(best.config, free, here + way)
        assert point(evidence, there, free, outcomes).height < best.height + 0.01


@cache
def from_corners() -> list[tuple[Sequence[Parameter], list[Point], Point]]:
    """Climbs from far out in the box, the outermost fifth of it: what is free, all that is told, and the end."""
    sim = outage(3)
    evidence = Evidence([sim.run], sim.config)
    free = free_of(evidence, sim.config, ("noise", "delay", "plant"))
    low, high = np.array([one.range for one in free]).T
    rng, found = np.random.default_rng(4), []
    for _ in range(2):
        share = rng.choice([0.2, 0.8], len(free)) + rng.uniform(-0.2, 0.2, len(free))
        start = moved(sim.config, free, low + share * (high - low))
        seen = [point(evidence, start, free)]
        found.append((free, seen, climb(evidence, start, free, seen.append)))
    return found


def test_a_climb_rises_at_every_step() -> None:
    """From corners of the box, with what is told on the way; its end is the last of that."""
    for _, seen, best in from_corners():
        heights = [one.height for one in seen]
        assert len(heights) > 3 and (np.diff(heights) > 0.0).all()
        assert best.height == heights[-1]


def test_a_climb_stays_in_its_box() -> None:
    """From corners of the box no number is ever below its least or above its greatest value."""
    for free, seen, _ in from_corners():
        for one in seen:
            assert all(p.bounds[0] <= p.get(one.config) * (1.0 + 1e-12) for p in free)
            assert all(p.get(one.config) <= p.bounds[1] * (1.0 + 1e-12) for p in free)


def test_a_climb_of_nothing_stays_where_it_is() -> None:
    """And says what is there."""
    sim = outage(1)
    evidence = Evidence([sim.run], sim.config)
    best = climb(evidence, sim.config, [])
    assert best.config == sim.config and best.height == evidence.value(sim.config).total


def test_a_noise_that_is_not_there_goes_to_its_bound() -> None:
    """Measurements of a process without drift and maneuvers: their least values, where the score still points outward."""
    found = scenario("panel-tracker-outage", 0.1, 0.02)
    calm = dict.fromkeys(("tangential", "vertical"), pf.Process(input_noise=0.0, drift=0.0))
    sim = pf.simulate(replaced(found, process=calm), 2)
    evidence = Evidence([sim.run], with_process(sim.config, input_noise=3e-5, drift=3e-4))
    free = free_of(evidence, evidence.config, ("noise",))
    best = climb(evidence, evidence.config, free)
    where, (low, _) = coordinates(free, best.config), np.array([one.range for one in free]).T
    least = where <= low + 1e-9
    assert least.any()
    assert (slopes(evidence, best, free).score[least] < 0.0).all()
    assert all(one.vanishes for one, at in zip(free, least.tolist(), strict=True) if at)
    assert still_to_gain(evidence, best, free) < 0.01


@st.composite
def problems(draw: st.DrawFn) -> tuple[Slopes, np.ndarray, np.ndarray, np.ndarray]:
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
    return Slopes(rng.standard_normal(count) * scale, information), low, high, damping


@settings(derandomize=True, deadline=None, max_examples=200)
@given(problems())
def test_a_step_is_the_best_there_is_in_its_box(problem: tuple[Slopes, np.ndarray, np.ndarray, np.ndarray]) -> None:
    """Karush, Kuhn and Tucker: inside, the slope of ½ δᵀ(I + λ diag I)δ − gᵀδ is 0, at an edge it points outward."""
    found, low, high, damping = problem
    step = _step(found, low, high, damping)
    size = 1.0 / np.sqrt(np.diag(found.information))
    tiny = 1e-9 * (high - low)
    assert ((step >= low - tiny) & (step <= high + tiny)).all()
    matrix = found.information + np.diag(damping * np.diag(found.information))
    slope = size * (found.score - matrix @ step)
    close = 1e-6 * (1.0 + np.abs(size * found.score).max())
    assert (slope[step > low + tiny] > -close).all()
    assert (slope[step < high - tiny] < close).all()


def test_what_nothing_tells_does_not_move() -> None:
    """A number without any information stays, the others step as if it were not there."""
    information = np.diag([4.0, 0.0, 1.0])
    step = _step(Slopes(np.array([2.0, 0.0, -3.0]), information), -np.ones(3), np.ones(3), np.zeros(3))
    np.testing.assert_allclose(step, [0.5, 0.0, -1.0], atol=1e-9)


# ---- with gates -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gate_rows", [True, False], ids=["rows", "components"])
def test_settling_under_the_gates_never_loses(gate_rows: bool) -> None:
    """The gates decide at the end as they would, and what settles there stays."""
    sim = with_outliers(4, 0.06)
    config = with_sensors(spoiled(sim.config), gate=3.0, gate_rows=gate_rows)
    evidence = Evidence([sim.run], config)
    free = free_of(evidence, config, ("noise",))
    best = settle(evidence, config, free)
    assert best.height > point(evidence, config, free).height + 5.0
    asked = evidence.value(best.config)
    assert asked.total == best.value.total
    assert [part.tolist() for part in asked.outcomes] == [part.tolist() for part in best.value.outcomes]
    assert (np.concatenate(asked.outcomes) == pf.Outcome.REJECTED).any()
    assert still_to_gain(evidence, best, free) < 0.5
    again = settle(evidence, best.config, free)
    assert best.height <= again.height < best.height + 0.1
