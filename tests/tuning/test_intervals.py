"""Intervals end where the likelihood has dropped by 1.92, and hold the truth as often as they say."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq, minimize, minimize_scalar
from scipy.stats import multivariate_normal

import pumafuse as pf
from pumafuse.tuning.climb import climb, point, settle
from pumafuse.tuning.intervals import ConfidenceInterval, confidence_intervals
from pumafuse.tuning.likelihood import Evidence
from pumafuse.tuning.parameters import Fit, Parameter, moved, rounded
from tuning_runs import free_of, holds, learnt, outage, scenario, spoiled, spoiled_arm, sure_of

ROOT = 1.96  # √(2 · 1.92): how far an interval's end is from the best, in signed roots of twice the drop
ARM = pf.ArmModel(
    name="at rest", update_period=0.02, delay=0.0, axes={"tip": pf.AxisModel(plant=pf.FirstOrder(time_constant=0.04))}
)


def at_rest(values: np.ndarray, drift: float, sd: float) -> tuple[Evidence, pf.FusionConfig]:
    """Measurements 50 times a second of an arm that is told to stay, its offset known to be 0 at first; what walks drifts.

    Without input noise the measurements are a random walk of density ``drift`` under white noise of ``sd``, nothing
    else.
    """
    time = 0.02 * np.arange(len(values))
    run = pf.Run.from_arrays(time, {"tip": np.zeros(len(values))}, {"eye": (time, {"tip": values})})
    config = pf.FusionConfig(
        arm=ARM,
        start=pf.Start(offset_sd=0.0),
        process={"tip": pf.Process(input_noise=0.0, drift=drift)},
        sensors={"eye": pf.Sensor(sd=sd, gate=0.0)},
    )
    return Evidence([run], config), config


def sure(
    evidence: Evidence, config: pf.FusionConfig, *keys: str
) -> tuple[pf.FusionConfig, dict[str, ConfidenceInterval]]:
    """The best configuration and the intervals of these numbers, all others held."""
    free = [one for one in free_of(evidence, config, ("noise", "latency")) if one.key in keys]
    best = climb(evidence, config, free)
    return best.config, confidence_intervals(evidence, best, free)


# ---- against likelihoods that no filter works out -------------------------------------------------------------------


@pytest.mark.parametrize("count", [12, 40, 3000])
def test_a_lone_sd_has_the_interval_of_white_noise(count: int) -> None:
    """L(σ) = −n ln σ − Σz²/2σ²: both ends where that has dropped by 1.92, to 3 % of the root, for few measurements too.

    Few measurements make it skew: the curvature alone would put the ends of 12 measurements at σ e^(±1.96/√24), 20 %
    off.
    """
    z = 2e-4 * np.random.default_rng(count).standard_normal(count)
    evidence, config = at_rest(z, drift=0.0, sd=1e-3)
    best, found = sure(evidence, config, "sensors.eye.sd_mm.tip")
    one, top = found["sensors.eye.sd_mm.tip"], float(np.sqrt(np.mean(z**2)))
    assert best.sensors["eye"].sd_of("tip") == pytest.approx(top, rel=1e-3)

    def root(sigma: float) -> float:
        drop = count * (np.log(sigma / top) + 0.5 * (top / sigma) ** 2 - 0.5)
        return float(np.sign(sigma - top) * np.sqrt(2.0 * drop))

    assert [root(end) for end in one.ci95] == pytest.approx([-ROOT, ROOT], rel=0.03)
    assert one.open == (False, False) and one.at is None
    assert one.profiled == (count < 100)
    wanted = [brentq(lambda s, sign=sign: root(s) - sign * ROOT, 0.2 * top, 5.0 * top) for sign in (-1, 1)]
    assert one.ci95 == pytest.approx(wanted, rel=0.06 * ROOT / np.sqrt(count))


def walking(drift: float, seed: int, count: int = 80) -> np.ndarray:
    rng = np.random.default_rng(seed)
    walk = np.concatenate([[0.0], np.cumsum(drift * np.sqrt(0.02) * rng.standard_normal(count - 1))])
    return walk + 2e-4 * rng.standard_normal(count)


def dense(values: np.ndarray) -> Callable[[float, float], float]:
    """The log density of a random walk under white noise, by drift and sd [mm], as one joint Gaussian."""
    time = 0.02 * np.arange(len(values))
    common = np.minimum.outer(time, time)

    def density(drift: float, sd: float) -> float:
        return float(multivariate_normal(cov=drift**2 * common + sd**2 * np.eye(len(time))).logpdf(1e3 * values))

    return density


def profile_of_drift(values: np.ndarray, drift: float) -> float:
    density = dense(values)
    best = minimize_scalar(lambda s: -density(drift, np.exp(s)), bounds=(np.log(0.02), np.log(2.0)), method="bounded")
    return -float(best.fun)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_profile_is_the_one_of_the_joint_gaussian(seed: int) -> None:
    """A walk under noise, both unknown: at each end of the drift's interval its profile has dropped by 1.92 (± 8 %).

    The other number is where it is most likely given the first; the best point is the highest of a global search.
    """
    values = walking(1e-3, seed)
    evidence, config = at_rest(values, drift=3e-3, sd=1e-3)
    best, found = sure(evidence, config, "sensors.eye.sd_mm.tip", "process.tip.drift_mm_rts")
    density = dense(values)
    top = minimize(lambda p: -density(*np.exp(p)), np.log([1.0, 0.2]), method="Nelder-Mead", options={"xatol": 1e-5})
    assert 1e3 * best.process["tip"].drift == pytest.approx(np.exp(top.x[0]), rel=0.02)
    assert 1e3 * float(best.sensors["eye"].sd_of("tip") or 0.0) == pytest.approx(np.exp(top.x[1]), rel=0.01)
    drift = found["process.tip.drift_mm_rts"]
    assert drift.open == (False, False)
    for end in drift.ci95:
        dropped = -top.fun - profile_of_drift(values, 1e3 * end)
        assert dropped == pytest.approx(0.5 * ROOT**2, rel=0.08)


def test_a_noise_that_is_none_has_an_interval_from_none_on() -> None:
    """White noise alone: no drift is best, and the interval ends where its profile has dropped by 1.92 (± 8 %)."""
    values = walking(0.0, 5)
    evidence, config = at_rest(values, drift=3e-3, sd=1e-3)
    best, found = sure(evidence, config, "sensors.eye.sd_mm.tip", "process.tip.drift_mm_rts")
    drift = found["process.tip.drift_mm_rts"]
    assert best.process["tip"].drift < 1e-6 and drift.ci95[0] == pytest.approx(1e-7, rel=1e-6)
    assert drift.open == (True, False) and drift.profiled
    none, end = (profile_of_drift(values, 1e3 * value) for value in (1e-7, drift.ci95[1]))
    assert none - end == pytest.approx(0.5 * ROOT**2, rel=0.08)


def test_an_end_that_measurements_do_not_limit_is_open() -> None:
    """A drift that is there, but so weak that none at all would hardly be less likely."""
    for seed in range(20):
        values = walking(2e-4, seed)
        evidence, config = at_rest(values, drift=3e-4, sd=2e-4)
        best, found = sure(evidence, config, "sensors.eye.sd_mm.tip", "process.tip.drift_mm_rts")
        drift = found["process.tip.drift_mm_rts"]
        peak = profile_of_drift(values, 1e3 * best.process["tip"].drift)
        if drift.at is None and peak - profile_of_drift(values, 1e-4) < 1.5:
            assert drift.open == (True, False)
            assert drift.ci95[0] == pytest.approx(1e-7, rel=1e-6)
            assert peak - profile_of_drift(values, 1e3 * drift.ci95[1]) == pytest.approx(0.5 * ROOT**2, rel=0.08)
            return
    pytest.fail("no such run among 20")


def of_one_axis(run: pf.Run, axis: str) -> pf.Run:
    sensors = {name: replace(one, values={axis: one.values[axis]}) for name, one in run.sensors.items()}
    command = replace(run.command, values={axis: run.command.values[axis]})
    return replace(run, command=command, sensors=sensors, start={axis: run.start[axis]}, reference=None)


def test_a_number_of_all_axes_has_the_profile_of_all_measurements() -> None:
    """A camera's latency, two axes, their noises following by Nelder and Mead: dropped by 1.92 (± 20 %) at both ends.

    The information adds up: one over its square, the width is the sum of those from each axis's measurements (± 25 %).
    """
    sim = outage(2)
    names = ["sensors.vision.latency_ms", "sensors.vision.sd_mm.tangential", "sensors.vision.sd_mm.vertical"]
    evidence = Evidence([sim.run], sim.config, ["vision"])
    best, found = sure(evidence, sim.config, *names)
    free = {one.key: one for one in free_of(evidence, best, ("noise", "latency"))}
    latency, *noise = (free[name] for name in names)
    outcomes = evidence.value(best).outcomes
    start = [other.coordinate(other.get(best)) for other in noise]

    def highest(value: float) -> float:
        held = latency.put(best, value)
        cost = minimize(lambda at: -evidence.value(moved(held, noise, at), outcomes).total, start, method="Nelder-Mead")
        return -float(cost.fun)

    top, ends = highest(latency.get(best)), found[latency.key].ci95
    for end in ends:
        assert top - highest(end) == pytest.approx(0.5 * ROOT**2, rel=0.2)
    inverse_squares = 0.0
    for axis in evidence.axes:
        alone = Evidence([of_one_axis(sim.run, axis)], sim.config, ["vision"])
        low, high = sure(alone, sim.config, *names)[1][latency.key].ci95
        inverse_squares += (high - low) ** -2
    assert (ends[1] - ends[0]) ** -2 == pytest.approx(inverse_squares, rel=0.25)


def test_a_number_of_an_axis_knows_what_the_others_say_of_a_shared_one() -> None:
    """A camera's latency is free, and one axis's delay: it is told by the latency, which is told by the other axis.

    From its own measurements the delay is not told at all. At both ends its profile, the latency following over the
    measurements of both axes, has dropped by 1.92 (± 20 %).
    """
    sim = outage(2)
    names = ["axes.vertical.delay_ms", "sensors.vision.latency_ms"]
    evidence = Evidence([sim.run], sim.config, ["vision"])
    free = [one for one in free_of(evidence, sim.config, ("delay", "latency")) if one.key in names]
    best = climb(evidence, sim.config, free)
    delay, latency = (next(one for one in free if one.key == name) for name in names)
    found, outcomes = confidence_intervals(evidence, best, free)[delay.key], best.value.outcomes

    def highest(value: float) -> float:
        held, near = delay.put(best.config, value), latency.get(best.config)
        cost = minimize_scalar(
            lambda at: -evidence.value(latency.put(held, at), outcomes).total,
            bounds=(near - 0.02, near + 0.02),
            method="bounded",
        )
        return -float(cost.fun)

    assert found.open == (False, False)
    top = highest(delay.get(best.config))
    for end in found.ci95:
        assert top - highest(end) == pytest.approx(0.5 * ROOT**2, rel=0.2)


def test_an_interval_reaches_to_what_is_told() -> None:
    """Where gates stop the search beside the peak that the likelihood has with their outcomes held, or at none."""
    sim = outage(2)
    evidence = Evidence([sim.run], sim.config)
    free = [one for one in free_of(evidence, sim.config, ("noise",), "vision") if one.axis == "vertical"]
    free = [one for one in free if "maneuver" not in one.key]
    peak = settle(evidence, sim.config, free)
    for one in free:
        low, high = confidence_intervals(evidence, peak, free)[one.key].ci95
        for aside in (0.5 * low, 2.0 * high, one.bounds[0] if one.vanishes else low):
            value = one.inside(rounded(aside))
            there = point(evidence, one.put(peak.config, value), free, peak.value.outcomes)
            found = confidence_intervals(evidence, there, free)[one.key]
            assert found.ci95[0] <= value <= found.ci95[1], one.key
            assert found.open[0] or value > one.bounds[0], one.key


# ---- how often they hold --------------------------------------------------------------------------------------------


def shares(
    name: str, seeds: Sequence[int], fit: Sequence[Fit], wrong: Callable[[pf.FusionConfig], pf.FusionConfig]
) -> tuple[dict[str, float], float]:
    """For each number the share of runs in which its interval holds the truth, and the share over all."""
    inside = defaultdict[str, list[bool]](list)
    for seed in seeds:
        sim = pf.simulate(scenario(name), seed)
        found = learnt(sim.run, wrong(sim.config), fit)
        sures = sure_of(found)
        for one in found.free:
            inside[one.key].append(knows(one, sim.config) and holds(one, sures[one.key], sim.config))
    every = [held for hits in inside.values() for held in hits]
    return {key: float(np.mean(hits)) for key, hits in inside.items()}, float(np.mean(every))


def knows(one: Parameter, truth: pf.FusionConfig) -> bool:
    """Whether the truth has this number: a plant of another order has not, and no interval holds it."""
    return one.given(truth) is not None


@pytest.mark.long
def test_intervals_of_noise_hold_over_200_runs() -> None:
    """A camera with outliers, fitted from noise that is wrong by factors of 2 to 3.

    One standard deviation of a share of 95 % in 200 is 1.5 %: each number's is in 90 to 99.5 %, and all together in
    93.5 to 97.5 %: a noise that may be none is held more often where it is none.
    """
    each, together = shares("panel-vision", range(1, 201), ("noise",), spoiled)
    assert len(each) == 10
    assert all(0.90 <= share <= 0.995 for share in each.values()), each
    assert 0.935 <= together <= 0.975, each


@pytest.mark.long
def test_intervals_of_an_arm_hold_over_40_runs() -> None:
    """Noise, delay and plant by a tracker with an outage and a camera, the arm too slow and too late to begin with.

    One standard deviation of a share of 95 % in 40 is 3.4 %: each number's is at least 82 %, and all together in 92 to
    98 %. A plant of the wrong order counts as not held.
    """
    each, together = shares("panel-tracker-outage", range(1, 41), ("noise", "delay", "plant"), spoiled_arm)
    assert {"axes.tangential.damping", "axes.vertical.time_constant_ms"} <= set(each)
    assert all(share >= 0.82 for share in each.values()), each
    assert 0.92 <= together <= 0.98, each
