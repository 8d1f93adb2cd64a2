"""The search ends on a maximum, and on the highest that an unhurried global search finds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import differential_evolution

import pumafuse as pf
from pumafuse.simulate.scenario import Outliers
from pumafuse.tune.likelihood import Evidence, Slopes
from pumafuse.tune.parameters import Fit, Parameter
from pumafuse.tune.search import Point, _step, climb, moved, point, search, settle, slopes, with_gates_of
from tuning import free_of, learnt, replaced, scenario, spoiled, spoiled_arm, with_process, with_sensors


def with_outliers(seed: int, share: float = 0.03) -> pf.Simulated:
    """A camera on two axes for 4 seconds: some 105 rows, a few of them 5 to 20 mm off."""
    found = scenario("panel-vision", 0.1, 0.02)
    wild = Outliers(share=share, smallest=0.005, largest=0.02)
    camera = replaced(found.sensors["vision"], outliers=wild, dropouts=0.0)
    return pf.simulate(replaced(found, sensors={"vision": camera}), seed)


def outage(seed: int) -> pf.Simulated:
    """Tracker and camera on two axes for 4 seconds."""
    return pf.simulate(scenario("panel-tracker-outage", 0.1, 0.02), seed)


def coordinates(free: Sequence[Parameter], config: pf.FusionConfig) -> np.ndarray:
    return np.array([one.coordinate(one.get(config)) for one in free])


def still_to_gain(evidence: Evidence, at: Point, free: Sequence[Parameter]) -> float:
    """What a quadratic through a point promises beyond it, ½ gᵀ I⁻¹ g, of all that could still move that way."""
    found, where = slopes(evidence, at, free), coordinates(free, at.config)
    low, high = np.array([one.range for one in free]).T
    inside = ~((where <= low + 1e-9) & (found.score < 0.0) | (where >= high - 1e-9) & (found.score > 0.0))
    g, information = found.score[inside], found.information[np.ix_(inside, inside)]
    return 0.5 * float(g @ np.linalg.solve(information, g))


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


def test_a_climb_rises_at_every_step_and_stays_in_its_box() -> None:
    """From corners of the box, with what is told on the way."""
    sim = outage(3)
    evidence = Evidence([sim.run], sim.config)
    free = free_of(evidence, sim.config, ("noise", "delay", "plant"))
    rng = np.random.default_rng(4)
    for _ in range(4):
        # far out, but not so that double precision ends: the outermost fifth of the box
        share = rng.choice([0.2, 0.8], len(free)) + rng.uniform(-0.2, 0.2, len(free))
        low, high = np.array([one.range for one in free]).T
        start = moved(sim.config, free, low + share * (high - low))
        seen = [point(evidence, start, free)]
        best = climb(evidence, start, free, seen.append)
        heights = [one.height for one in seen]
        assert len(heights) > 3 and (np.diff(heights) > 0.0).all()
        assert best.height == heights[-1]
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
    """Readings of a process without drift and maneuvers: their least values, where the score still points outward."""
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
    low, high = (np.where(rng.random(count) < 0.2, 0.0, end) for end in (low, -high))
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


@pytest.mark.parametrize("gate_rows", [True, False], ids=["rows", "scalars"])
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
    assert (np.concatenate(asked.outcomes) == pf.Outcome.GATED).any()
    assert still_to_gain(evidence, best, free) < 0.5
    again = settle(evidence, best.config, free)
    assert best.height <= again.height < best.height + 0.1


def test_a_search_gives_back_the_gates_as_they_were() -> None:
    """It widens them on its way and gates scalar by scalar; the result has each sensor's own."""
    sim = outage(5)
    config = with_sensors(with_sensors(sim.config, "tracker", gate=6.5), "vision", gate=3.25, gate_rows=False)
    evidence = Evidence([sim.run], config)
    best, orders = search(evidence, config, lambda at: free_of(evidence, at, ("noise",)), lambda _: None)
    assert orders == {}
    for name, sensor in best.config.sensors.items():
        assert (sensor.gate, sensor.gate_rows) == (config.sensors[name].gate, config.sensors[name].gate_rows)
    assert with_gates_of(with_sensors(best.config, gate=0.0), config) == best.config


def test_where_it_starts_does_not_matter() -> None:
    """From the truth, from noise thirty times too large or too small, and from none: within 0.1 of one another."""
    sim = with_outliers(2)
    starts = [sim.config, spoiled(sim.config)]
    for times in (30.0, 1.0 / 30.0):
        config = with_sensors(sim.config, sd=times * 0.5e-3)
        starts.append(with_process(config, input_noise=times * 3e-5, drift=times * 3e-4, maneuver_drift=0.0))
    starts.append(with_process(sim.config, input_noise=0.0, drift=0.0, maneuver_noise=0.0, maneuver_drift=0.0))
    heights = [learnt(sim.run, config).best.height for config in starts]
    assert max(heights) - min(heights) < 0.1


# ---- against a global search ----------------------------------------------------------------------------------------


def best_of_all(
    evidence: Evidence, config: pf.FusionConfig, free: Sequence[Parameter], seed: int, generations: int
) -> float:
    """Differential evolution under the gates themselves, and the nearest maximum to what it found."""

    def cost(coordinates: np.ndarray) -> float:
        return -point(evidence, moved(config, free, coordinates), free).height

    box = [
        (max(low, np.log(1e-6)), min(high, np.log(0.1))) if one.fit == "noise" else (low, high)
        for one in free
        for low, high in [one.range]
    ]
    found = differential_evolution(
        cost, box, popsize=6, maxiter=generations, rng=seed, polish=False, tol=1e-9, init="sobol"
    )
    return max(-found.fun, settle(evidence, moved(config, free, found.x), free).height)


def test_nothing_higher_is_found_by_differential_evolution() -> None:
    """Noise of two axes with outliers in the readings, from a poor start: within 0.1 of a global search's best."""
    sim = with_outliers(4)
    config = with_sensors(spoiled(sim.config), gate=4.0)
    found = learnt(sim.run, config)
    assert (np.concatenate(found.best.value.outcomes) == pf.Outcome.GATED).sum() >= 4
    assert len(found.free) == 10
    assert found.best.height > best_of_all(found.evidence, config, found.free, 1, 40) - 0.1


@pytest.mark.long
@pytest.mark.parametrize("seed", [5, 6, 7])
@pytest.mark.parametrize("gate_rows", [True, False], ids=["rows", "scalars"])
def test_nothing_higher_is_found_by_long_differential_evolution(seed: int, gate_rows: bool) -> None:
    """Likewise with 6 % of outliers, narrower gates and 250 generations from two starts."""
    sim = with_outliers(seed, 0.06)
    config = with_sensors(spoiled(sim.config), gate=3.5, gate_rows=gate_rows)
    found = learnt(sim.run, config)
    for start in (1, 2):
        assert found.best.height > best_of_all(found.evidence, config, found.free, start, 250) - 0.1


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_arm_is_likelier_to_differential_evolution(seed: int) -> None:
    """Noise, delay and plant of one axis, by a tracker and a camera; the plant of the order that was chosen."""
    sim = outage(seed)
    config = spoiled_arm(sim.config)
    found = learnt(sim.run, config, ("noise", "delay", "plant"), "tangential")
    assert len(found.free) >= 8
    assert found.best.height > best_of_all(found.evidence, found.best.config, found.free, seed, 300) - 0.1
