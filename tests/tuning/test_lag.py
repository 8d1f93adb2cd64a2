"""The lag's interval: its covariance, its ends at bounds, and that it holds."""

from dataclasses import replace

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.tuning.intervals import lag_intervals
from pumafuse.tuning.likelihood import Likelihood
from pumafuse.tuning.maximise import derivatives, point
from pumafuse.tuning.parameters import set_own_delays
from pumafuse.tuning.summary import fitted_lags
from tuning_runs import free_of, outage, replaced, scenario


def test_it_is_the_covariance_of_delay_and_plant() -> None:
    """By hand: a first-order axis is Td + τ late, and d τ = τ d log τ; the information inverted as it is.

    Or, where that is more, the scatter of the score over 20 pieces of the run between two of its inverses.
    """
    sim = outage(2)
    config = set_own_delays(sim.config, ["vertical"])
    likelihood = Likelihood([sim.run], config)
    free = [one for one in free_of(likelihood, config, ("delay", "plant")) if one.axis == "vertical"]
    best = point(likelihood, config, free)
    tau = sim.config.arm.axes["vertical"].plant.lag
    slope = np.array([1.0 if one.fit == "delay" else tau for one in free])
    _, information, scatter = derivatives(likelihood, best, free)
    part = slope @ np.linalg.inv(information)
    wanted = 1.96 * np.sqrt(max(part @ slope, part @ scatter @ part))
    found = lag_intervals(likelihood, best, free)
    assert set(found) == {"vertical"}
    assert found["vertical"] == pytest.approx((wanted, wanted), rel=1e-3)


def test_the_scatter_is_the_information_where_the_model_is_right() -> None:
    """The median of twelve drawn runs, within a third; three times that where a camera's clock wanders by 20 ms."""
    ratios: dict[bool, list[float]] = {False: [], True: []}
    for seed in range(12):
        sim = outage(seed)
        for wanders, found in ratios.items():
            camera = sim.run.sensors["vision"]
            time = (camera.stamp - camera.stamp[0]) / 1e9
            off = np.rint(2e7 * wanders * np.sin(2.0 * np.pi * time / 1.3)).astype(np.int64)
            run = replace(sim.run, sensors={"vision": replace(camera, stamp=camera.stamp + off)})
            likelihood = Likelihood([run], sim.config)
            free = [one for one in free_of(likelihood, sim.config, ("latency",)) if one.sensor == "vision"]
            _, information, scatter = derivatives(likelihood, point(likelihood, sim.config, free), free)
            found.append(float(scatter[0, 0] / information[0, 0]))
    assert 0.67 < np.median(ratios[False]) < 1.5
    assert np.median(ratios[True]) > 3.0 * np.median(ratios[False])


def test_a_gain_that_recovers_is_part_of_it() -> None:
    """(1 − K) of the recovery: K = 0.9 and 100 ms are 10 ms; the noise alone changes no lag, so none is given."""
    sim = outage(2)
    axes = {
        axis: replaced(one, gain=replaced(one.gain, slope=0.0, intercept=0.9), gain_recovery=0.1)
        for axis, one in sim.config.arm.axes.items()
    }
    config = replaced(sim.config, arm=replaced(sim.config.arm, axes=axes))
    likelihood = Likelihood([sim.run], config)
    delay, plant = sim.config.arm.delay_of("vertical"), axes["vertical"].plant.lag
    free = free_of(likelihood, config, ("noise", "gain"))
    found = fitted_lags(free, config, config, {"vertical": (0.001, np.inf)})["vertical"]
    assert found.lag_ms == pytest.approx(1e3 * (delay + plant + 0.01))
    assert found.lag_ms_ci95 == (pytest.approx(found.lag_ms - 1.0), None)
    assert fitted_lags(free, config, config, {"vertical": (10.0, 0.1)})["vertical"].lag_ms_ci95[0] == 0.0
    assert fitted_lags(free_of(likelihood, config, ("noise",)), config, config, {}) == {}


def test_an_end_is_open_only_where_nothing_can_go_there() -> None:
    """A delay of 0 alone cannot be less, so that end is open; with the plant free both ends are there."""
    found = scenario("panel-tracker-outage", 0.1, 0.02)
    sim = pf.simulate(replaced(found, arm=replaced(found.arm, delay=0.0)), 2)
    config = set_own_delays(sim.config, ["vertical"])
    likelihood = Likelihood([sim.run], config)
    free = [one for one in free_of(likelihood, config, ("delay", "plant")) if one.axis == "vertical"]
    free = [replace(one, bounds=(0.0, 0.3)) if one.fit == "delay" else one for one in free]
    none = point(likelihood, config, free)
    assert none.config.arm.delay_of("vertical") == 0.0
    below, above = lag_intervals(likelihood, none, [one for one in free if one.fit == "delay"])["vertical"]
    assert np.isinf(below) and 0.0 < above < 0.01
    both = lag_intervals(likelihood, none, free)["vertical"]
    assert both[0] == both[1] and 0.0 < both[0] < 0.05
