"""One stage: latencies and orders are found, outliers do not count, what is not identifiable is fixed and named."""

import re

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.simulation.true_sensor import Outliers, TrueSensor
from pumafuse.tuning.arms import BELIEF
from pumafuse.tuning.intervals import ConfidenceInterval
from pumafuse.tuning.likelihood import Likelihood
from pumafuse.tuning.maximise import point
from pumafuse.tuning.parameters import parameters
from pumafuse.tuning.stage import Stage, drop_unseen_noise
from tuning_runs import (
    fit_stage,
    intervals_of,
    outage,
    replaced,
    scenario,
    spoiled,
    spoiled_arm,
    with_order,
    with_process,
    with_sensors,
)

AXES = ("tangential", "vertical")


def numbers(stage: Stage) -> dict[str, float]:
    """The fitted values by key, in its unit."""
    return {one.key: one.number(stage.best.config) / one.unit for one in stage.free}


@pytest.mark.parametrize(("seen_after", "lasts"), [(0.019, False), (0.0004, True)])
def test_noise_that_no_measurement_sees_is_none(seen_after: float, lasts: bool) -> None:
    """A drive of 0.5 ms is shaken at each command. 19 ms later nothing of it is left, 0.4 ms later nearly all."""
    rng, period = np.random.default_rng(5), 0.020
    time = np.arange(0.0, 20.0, period)
    command = 0.2 * np.sin(1.3 * time)
    y = command - 0.2 * 1.3 * period * np.cos(1.3 * time) * np.exp(-seen_after / 0.5e-3)
    shaken = 1.0 if lasts else 0.0
    step = np.abs(np.diff(command, n=2, prepend=[0.0, 0.0])) / period
    y += rng.normal(0.0, 1e-5, len(time)) + shaken * 0.01 * step * rng.normal(0.0, 1.0, len(time))
    run = pf.Run.from_arrays(time, {"elbow": command}, {"encoder": (time + seen_after, {"elbow": y})})
    plant = pf.FirstOrder(time_constant=0.5e-3)
    arm = pf.ArmModel(name="cell", update_period=period, delay=0.0, axes={"elbow": pf.AxisModel(plant=plant)})
    process = {"elbow": pf.Process(maneuver_noise=0.5e-3, input_noise=0.0)}
    config = pf.FusionConfig(arm=arm, process=process, sensors={"encoder": pf.Sensor(sd=1e-5)})
    likelihood = Likelihood([run], config)
    free = parameters(config, config, likelihood.sensors, ["noise"])
    best = drop_unseen_noise(likelihood, point(likelihood, config, free), free)
    assert (best.config.process["elbow"].maneuver_noise > 0.0) is lasts
    highest = pf.fuse(run, best.config)["elbow"].position_sd[200:].max()
    assert lasts or highest < 1e-3


# ---- latencies ------------------------------------------------------------------------------------------------------


def wrong_latency(seed: int, believed: float, *size: float) -> tuple[Stage, ConfidenceInterval]:
    """A camera that is 45 ms late and configured otherwise; noise as wrong as elsewhere."""
    sim = pf.simulate(scenario("wrong-latency", *size), seed)
    found = fit_stage(sim.run, with_sensors(spoiled(sim.config), latency=believed), ("noise", "latency"))
    return found, intervals_of(found)["sensors.vision.latency_ms"]


def test_a_wrong_latency_is_found() -> None:
    """45 ms within 4 ms by some 105 rows, from far beyond a tick too; the 95 % interval is at most 16 ms wide."""
    found, interval = wrong_latency(1, 0.135, 0.1, 0.02)
    assert list(found.not_identifiable) == []
    assert found.best.config.sensors["vision"].latency == pytest.approx(0.045, abs=0.004)
    low, high = interval.ci95
    assert low < 0.045 < high < low + 0.016


@pytest.mark.long
def test_intervals_of_latencies_over_80_runs() -> None:
    """They contain the truth in 90 to 100 %: one standard deviation of a share of 95 % in 80 is 2.4 %.

    The mean is within 0.5 ms.
    """
    inside, off = [], []
    for seed in range(80):
        found, interval = wrong_latency(seed, 0.009, 0.3, 0.02)
        inside.append(interval.ci95[0] < 0.045 < interval.ci95[1])
        off.append(found.best.config.sensors["vision"].latency - 0.045)
    assert np.mean(inside) >= 0.90
    assert abs(np.mean(off)) < 5e-4


@pytest.mark.long
def test_of_delays_and_latencies_one_latency_is_fixed() -> None:
    """That of the sensor with the least noise, named with the delays and the other latency, and left as configured.

    Only their sum is identifiable: where that latency is configured longer, delays are as much shorter and the other
    latency as much longer, and the likelihood is the same.
    """
    believed = -0.004
    sim = outage(1)
    config = with_sensors(sim.config, "tracker", latency=believed)
    found = fit_stage(sim.run, config, ("noise", "delay", "latency"))
    (combination,) = found.not_identifiable
    assert combination.fixed == "sensors.tracker.latency_ms"
    delays = {f"axes.{axis}.delay_ms" for axis in AXES}  # each axis's own, before any is shared
    assert set(combination.members) == {*delays, "sensors.tracker.latency_ms", "sensors.vision.latency_ms"}
    assert found.best.config.sensors["tracker"].latency == believed
    more = 1e3 * (believed - 0.008)
    for axis in AXES:
        assert 1e3 * found.best.config.arm.delay_of(axis) == pytest.approx(60.45 - more, abs=2.5)
    assert numbers(found)["sensors.vision.latency_ms"] == pytest.approx(45.0 + more, abs=3.0)
    right = fit_stage(sim.run, sim.config, ("noise", "delay", "latency"))
    one, other = (1e3 * stage.best.config.arm.delay_of("vertical") for stage in (found, right))
    assert one + more == pytest.approx(other, abs=0.1)
    assert found.best.log_posterior == pytest.approx(right.best.log_posterior, abs=0.1)


# ---- gains ----------------------------------------------------------------------------------------------------------


def test_a_gain_of_one_does_not_run_away() -> None:
    """With K = 1 nothing recovers: the gain is constant, near 1; delay and plant are as without."""
    arm = outage(1).config.arm
    flat = {axis: replaced(model, gain=pf.Gain(slope=0.0, intercept=1.0)) for axis, model in arm.axes.items()}
    sim = pf.simulate(scenario("panel-tracker-outage", 0.1, 0.02, arm=replaced(arm, axes=flat)), 1)
    found = fit_stage(sim.run, spoiled(sim.config), ("noise", "gain"))
    for axis in AXES:
        model = found.best.config.arm.axes[axis]
        assert model.gain_recovery is None and model.gain.slope == 0.0
        assert model.gain.intercept == pytest.approx(1.0, abs=0.06)
        assert found.best.config.arm.delay_of(axis) == pytest.approx(0.06045, abs=0.003)
    assert not [key for key in numbers(found) if key.endswith("gain_recovery_ms")]


# ---- orders ---------------------------------------------------------------------------------------------------------


@pytest.mark.long
# With a delay of its own the second of seed 3 looks like second order.
@pytest.mark.parametrize(("seed", "begin"), [(1, (2, 2)), (2, (1, 1)), (3, (1, 2))])
def test_the_order_of_a_plant_is_its_own(seed: int, begin: tuple[int, int]) -> None:
    """By the odds: second for ω = 53.9 rad/s, ζ = 0.864, first for τ = 35.6 ms, whichever it was configured to be.

    Numbers are within 20 % of the truth.
    """
    sim = outage(seed)
    config = spoiled_arm(sim.config)
    for axis, order in zip(AXES, begin, strict=True):
        config = with_order(config, axis, order)
    found = fit_stage(sim.run, config, ("noise", "delay", "plant"))
    second, first = (found.best.config.arm.axes[axis].plant for axis in AXES)
    assert isinstance(second, pf.SecondOrder) and isinstance(first, pf.FirstOrder)
    assert second.natural_frequency == pytest.approx(53.9, rel=0.2)
    assert second.damping == pytest.approx(0.864, rel=0.2)
    assert first.time_constant == pytest.approx(0.0356, rel=0.2)
    for axis, word, sign in zip(AXES, ("second", "first"), (1.0, -1.0), strict=True):
        assert found.orders[axis].startswith(f"order: {word} (second ")
        (ahead,) = map(float, re.findall(r"[-+]\d+\.\d", found.orders[axis].partition(";")[0]))
        assert sign * ahead > 0.0


def test_an_order_that_is_fixed_stays() -> None:
    """A plant with a fixed parameter keeps its order, and no order is reported."""
    sim = outage(1)
    found = fit_stage(sim.run, with_order(sim.config, "vertical", 2), ("noise", "plant"), "damping")
    assert isinstance(found.best.config.arm.axes["vertical"].plant, pf.SecondOrder)
    assert "axes.vertical.natural_frequency_rad_s" in numbers(found)
    assert not [why for why in found.orders.values() if "order" in why]


# ---- outliers and noise ---------------------------------------------------------------------------------------------


def camera(share: float, seed: int) -> tuple[pf.Run, pf.FusionConfig]:
    """Some 310 rows of a camera; the same seed gives the same noise with and without outliers."""
    found = scenario("panel-vision", 0.3, 0.02)
    wild = Outliers(share=share, smallest=0.005, largest=0.02) if share else None
    one = replaced(found.sensors["vision"], outliers=wild, dropouts=0.0)
    sim = pf.simulate(replaced(found, sensors={"vision": one}), seed)
    return sim.run, spoiled(sim.config)


@pytest.mark.long
def test_outliers_do_not_count() -> None:
    """1 % of measurements 5 to 20 mm off leave the fitted sd within 3 % of the same run's without them.

    A gate of 2 in the configuration is one of 5 in the fit, with a note. One that is off stays off: outliers count.
    """
    clean = fit_stage(*camera(0.0, 1))
    run, config = camera(0.01, 1)
    off = run.sensors["vision"].values["vertical"] - camera(0.0, 1)[0].sensors["vision"].values["vertical"]
    assert np.sum(np.abs(off) > 4.9e-3) == np.sum(off != 0.0) >= 1
    for gate in (5.0, 2.0):
        found = fit_stage(run, with_sensors(config, gate=gate))
        assert found.best.config.sensors["vision"].gate == 5.0
        for axis in AXES:
            sd, wanted = (stage.best.config.sensors["vision"].sd_of(axis) for stage in (found, clean))
            assert sd == pytest.approx(wanted, rel=0.03)
        assert [note[:46] for note in found.notes] == ["vision: was fitted with a gate of 5, not of 2:"] * (gate == 2.0)
    off = fit_stage(run, with_sensors(config, gate=0.0), sd_prior=False)
    assert off.best.config.sensors["vision"].gate == 0.0 and not off.notes
    with_all, without = (stage.best.config.sensors["vision"].sd_of("vertical") for stage in (off, clean))
    assert with_all is not None and without is not None and with_all > 1.3 * without


@pytest.mark.long
def test_a_noise_that_is_not_identifiable_is_fixed() -> None:
    """A gauge of a few micrometres, rare beside a camera: its innovations hardly depend on its sd.

    It stays as configured and is named alone. With its prior it has an interval, of which that prior makes up the most.
    """
    camera_alone = scenario("panel-vision", 0.1, 0.02)
    gauge = TrueSensor(rate=5.0, sd=4e-6)
    sim = pf.simulate(replaced(camera_alone, sensors={**camera_alone.sensors, "gauge": gauge}), 1)
    config = with_sensors(sim.config, "gauge", sd=5e-6)
    found = fit_stage(sim.run, config, sd_prior=False)
    keys = [f"sensors.gauge.sd_mm.{axis}" for axis in AXES]
    assert sorted(one.fixed for one in found.not_identifiable) == keys
    assert all(one.members == (one.fixed,) for one in found.not_identifiable)
    assert all(found.best.config.sensors["gauge"].sd_of(axis) == 5e-6 for axis in AXES)
    assert not set(keys) & set(numbers(found))
    believed = fit_stage(sim.run, config)
    assert list(believed.not_identifiable) == []
    for key, one in intervals_of(believed).items():
        if key in keys:
            assert not any(one.open)
            assert 0.5 < np.log(one.ci95[1] / one.ci95[0]) / (2.0 * 1.96 * BELIEF) < 1.1


def test_what_is_fixed_stays_to_the_last_bit_and_the_rest_moves() -> None:
    """A sensor, a noise of every axis and one number of one axis."""
    sim = outage(1)
    config = with_process(spoiled_arm(sim.config), drift=1.234e-4)
    fixed = ("sensors.tracker", "drift_mm_rts", "vertical.time_constant_ms")
    found = fit_stage(sim.run, config, ("noise", "delay", "plant"), *fixed)
    best = found.best.config
    assert replaced(best.sensors["tracker"], gate=50.0) == config.sensors["tracker"]  # the fit has a gate of its own
    assert {one.drift for one in best.process.values()} == {1.234e-4}
    assert best.arm.axes["vertical"].plant == config.arm.axes["vertical"].plant
    for one in found.free:
        assert one.number(best) != one.number(config), one.key
    assert "axes.tangential.damping" in numbers(found)
    assert any(one.fit == "delay" for one in found.free)
