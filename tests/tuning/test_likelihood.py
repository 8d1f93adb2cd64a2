"""The likelihood is that of the filter and of the joint Gaussian; score and information are its derivatives."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

import pumafuse as pf
from fusion.test_oracle import CASES, MS, UNDER, Case, Seen, anomalous, every, sensor
from fusion_oracle import AxisOracle
from pumafuse.filter.outcome import ABSENT
from pumafuse.fusion.consistency import densities_of, log_likelihood
from pumafuse.logs.source import Source
from pumafuse.model.arm import AxisModel
from pumafuse.simulation.true_sensor import Outliers
from pumafuse.tuning.likelihood import Likelihood, Point
from pumafuse.tuning.maximise import derivatives, point
from pumafuse.tuning.parameters import moved
from tuning_runs import (
    ALL,
    SCENARIOS,
    free_of,
    quietly,
    replaced,
    scenario,
    spoiled_arm,
    with_order,
    with_process,
    with_sensors,
)

DATA = Path(pf.__file__).parent / "data"
AXES = ("tangential", "vertical")


@cache
def two_sensors(seed: int = 1) -> pf.Simulated:
    """Tracker and camera on two axes for 4 seconds; both throw outliers."""
    found = scenario("panel-tracker-outage", 0.1, 0.02)
    wild = Outliers(share=0.03, smallest=0.005, largest=0.02)
    sensors = {name: replaced(one, outliers=wild) for name, one in found.sensors.items()}
    return pf.simulate(replaced(found, sensors=sensors), seed)


def of_the_filter(run: pf.Run, config: pf.FusionConfig) -> dict[str, float]:
    """By axis, from the measurements of `fuse`."""
    est = quietly(lambda: pf.fuse(run, config))
    mine = {
        axis: est.measurements.where(est.measurements.axis == number)
        for number, axis in enumerate(est.measurements.axes)
    }
    return {axis: log_likelihood(measurements, config.sensors) for axis, measurements in mine.items()}


def by_axis(likelihood: Likelihood, config: pf.FusionConfig) -> dict[str, float]:
    return dict(zip(likelihood.axes, likelihood.evaluate(config).axes.tolist(), strict=True))


# ---- the value ------------------------------------------------------------------------------------------------------


def two_clocks() -> tuple[pf.Run, pf.FusionConfig]:
    """A log whose clock is set back by an hour in its middle."""
    sim = two_sensors()
    cut = int(2e9)

    def back(source: Source) -> Source:
        return replace(source, stamp=np.where(source.stamp > cut, source.stamp - 3_600_000_000_000, source.stamp))

    sensors = {name: back(one) for name, one in sim.run.sensors.items()}
    return replace(sim.run, command=back(sim.run.command), sensors=sensors, reference=None), sim.config


def shipped() -> tuple[pf.Run, pf.FusionConfig]:
    return pf.Run.read(DATA / "scan1"), pf.FusionConfig.load(DATA / "fusion.toml")


def in_x_y_z() -> tuple[pf.Run, pf.FusionConfig]:
    sim = pf.simulate(pf.Scenario.load(SCENARIOS / "cylindrical-cartesian.toml"))
    return sim.run, sim.config


def two_with_outliers() -> tuple[pf.Run, pf.FusionConfig]:
    return two_sensors().run, two_sensors().config


@pytest.mark.parametrize("made", [two_with_outliers, two_clocks, shipped, in_x_y_z])
def test_it_is_the_log_likelihood_of_a_fusion(made: Callable[[], tuple[pf.Run, pf.FusionConfig]]) -> None:
    """By axis and with its gates, which reject some: rows or components, axes and frames, clocks set back, biases."""
    run, config = made()
    for gate_rows in (True, False):
        here = with_sensors(config, gate_rows=gate_rows, gate=3.5)
        likelihood = Likelihood([run], here)
        assert by_axis(likelihood, here) == pytest.approx(of_the_filter(run, here), rel=1e-11)
        outcomes = np.concatenate(likelihood.evaluate(here).outcomes)
        assert (outcomes == pf.Outcome.REJECTED).any()
        assert (outcomes != ABSENT).sum() == likelihood.count.sum()


UNBIASED = {
    name: case
    for name, case in CASES.items()
    if case.seen and not any(seen.sensor.latency_sd or seen.sensor.bias_sd for seen in case.seen.values())
}


@pytest.mark.parametrize("case", UNBIASED.values(), ids=UNBIASED.keys())
def test_without_gates_it_is_the_density_of_the_joint_gaussian(case: Case) -> None:
    """All measurements of an axis at once, with the oracle's mean and covariance, in 50 digits; lengths in mm."""
    run, config = case.made()
    assert all(one.gate == 0.0 for one in config.sensors.values())
    likelihood = Likelihood([run], config)
    for axis, value in by_axis(likelihood, config).items():
        oracle = AxisOracle(run, config, axis)
        if oracle.measurements:
            nu, sd = oracle.innovations()
            wanted = norm.logpdf(1e3 * nu, scale=1e3 * sd).sum()
            assert value == pytest.approx(wanted, rel=1e-7, abs=1e-6), axis
    assert anomalous(run, config) or likelihood.count.sum() == sum(
        len(values) for source in run.sensors.values() for values in source.values.values()
    )


def test_runs_add_up_and_so_do_axes() -> None:
    """The sum over two runs, and over the axes: value, score and information."""
    one, two = two_sensors(1), two_sensors(2)
    config = with_sensors(spoiled_arm(one.config), gate=5.0)
    both, each = Likelihood([one.run, two.run], config), [Likelihood([sim.run], config) for sim in (one, two)]
    free = free_of(both, config, ALL)
    known = [likelihood.evaluate(config) for likelihood in each]
    together = both.evaluate(config)
    np.testing.assert_allclose(together.axes, known[0].axes + known[1].axes, rtol=1e-12)
    found = both.derivatives(config, free, together.outcomes)
    parts = [
        likelihood.derivatives(config, free, value.outcomes) for likelihood, value in zip(each, known, strict=True)
    ]
    np.testing.assert_allclose(found.score, parts[0].score + parts[1].score, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.information, parts[0].information + parts[1].information, rtol=1e-9, atol=1e-6)
    assert (together.axes != 0.0).all() and tuple(both.axes) == AXES
    shares, informations = [], []
    for number, axis in enumerate(AXES):
        alone, outcomes = both.of_axis(axis), both.outcomes_of(axis, together.outcomes)
        value = alone.evaluate(config, outcomes)
        assert value.axes[number] == pytest.approx(together.axes[number], rel=1e-12)
        assert value.log_likelihood == value.axes[number]
        derived = alone.derivatives(config, free, outcomes)
        foreign = [place for place, parameter in enumerate(free) if parameter.axis not in (None, axis)]
        assert not derived.score[foreign].any() and not derived.information[foreign].any()
        shares.append(derived.score)
        informations.append(derived.information)
    np.testing.assert_allclose(sum(shares), found.score, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(sum(informations), found.information, rtol=1e-9, atol=1e-6)


def test_until_leaves_out_what_is_valid_later() -> None:
    """The others have the densities they had: a filter does not depend on later measurements.

    With ``latest`` 0.5 s those stamped in the first half second are left out too.
    """
    sim, until = two_sensors(), 1.7
    est = pf.fuse(sim.run, sim.config)
    early = est.measurements.where(est.measurements.time <= until)
    density = densities_of(early, sim.config.sensors)
    likelihood = Likelihood([sim.run], sim.config, until=until)
    assert likelihood.count.sum() == len(early.value) < len(est.measurements.value)
    wanted = [density[early.axis == number].sum() for number in range(2)]
    np.testing.assert_allclose(likelihood.evaluate(sim.config).axes, wanted, rtol=1e-12)
    stamps = [one.stamp for one in sim.run.sensors.values() for _ in one.values]
    kept = sum(int(np.sum(stamp >= int(0.5e9))) for stamp in stamps)
    assert Likelihood([sim.run], sim.config, latest=0.5).count.sum() <= kept < sum(map(len, stamps))


# ---- another arm and other latencies --------------------------------------------------------------------------------


def with_axis(config: pf.FusionConfig, axis: str, **changes: object) -> pf.FusionConfig:
    arm = config.arm
    return replaced(config, arm=replaced(arm, axes={**arm.axes, axis: replaced(arm.axes[axis], **changes)}))


def test_of_more_measurements_than_a_fit_needs_those_count_during_which_an_axis_is_told_to_move() -> None:
    """Two axes for 50 s at 1000 Hz; each moves a fifth of the time, at times of its own."""
    t = np.arange(0.0, 50.0, 1e-3)
    beginning = {"radial": 0.4, "vertical": 2.9}
    moves = {axis: (t - begin) % 6.25 < 1.2 for axis, begin in beginning.items()}
    command = {axis: np.cumsum(moving * np.sin(9.0 * t)) * 1e-3 for axis, moving in moves.items()}
    run = pf.Run.from_arrays(t, command, {"resolver": (t, command)})
    arm = pf.ArmModel.load("puma560-internal")
    config = pf.FusionConfig(arm=arm, sensors={"resolver": pf.Sensor(sd=1e-4)})
    likelihood = Likelihood([run], config)
    assert likelihood.count.sum() == pytest.approx(80_000, rel=0.01)
    assert any("80% of 100,000 measurements" in note for note in likelihood.notes)
    for axis, moving in moves.items():
        (recording,) = likelihood.measured(axis, config).recordings
        assert np.isin(np.round(1e9 * t[moving]), recording.time).mean() > 0.99


def test_another_configuration_is_as_if_built_with_it() -> None:
    """Delays, gains, plants and latencies moved afterwards, past each other: as anew, row by row.

    Only measurements that no latency here puts before the first command.
    """
    sim = two_sensors()
    late = {name: replace(one.rows(one.stamp > int(0.2e9))) for name, one in sim.run.sensors.items()}
    run = replace(sim.run, sensors=late)
    config = with_axis(sim.config, "vertical", delay=0.1, gain_recovery=0.4)
    config = with_axis(config, "tangential", gain=pf.Gain(slope=0.05, intercept=0.7))
    config = with_sensors(with_order(config, "vertical", 2), "vision", latency=-0.03)
    config = with_sensors(config, "tracker", latency=0.0712345678, sd=1e-4)
    config = with_process(config, drift=1e-3, maneuver_noise=1e-3)
    old, new = Likelihood([run], sim.config), Likelihood([run], config)
    moved_there, built_there = old.evaluate(config), new.evaluate(config)
    np.testing.assert_allclose(moved_there.axes, built_there.axes, rtol=1e-13)
    assert np.sum(moved_there.outcomes[0]) == np.sum(built_there.outcomes[0]) > 0
    assert moved_there.log_likelihood != pytest.approx(old.evaluate(sim.config).log_likelihood, abs=0.1)
    free = free_of(new, config, ALL)
    found, wanted = (
        likelihood.derivatives(config, free, value.outcomes)
        for likelihood, value in ((old, moved_there), (new, built_there))
    )
    np.testing.assert_allclose(found.score, wanted.score, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.information, wanted.information, rtol=1e-6, atol=1e-4)


# ---- score and information ------------------------------------------------------------------------------------------


def far_from_the_maximum(order: int) -> tuple[Likelihood, Point, pf.FusionConfig]:
    """Two sensors under a configuration with an error in everything."""
    sim = two_sensors()
    config = spoiled_arm(sim.config)
    for axis in AXES:
        config = with_order(config, axis, order)
    config = with_axis(config, "tangential", gain_recovery=0.06)
    config = with_sensors(config, "vision", latency=0.04, gate=4.0)
    config = with_process(config, maneuver_noise=3e-4, maneuver_drift=2e-3, adaptation=0.1)
    likelihood = Likelihood([sim.run], config)
    return likelihood, point(likelihood, config, free_of(likelihood, config, ALL)), config


@pytest.mark.parametrize("order", [1, 2])
def test_the_score_is_the_derivative_of_the_log_likelihood(order: int) -> None:
    """For every kind of parameter, by central differences with fixed outcomes, with and without priors.

    To 1e-5 of it and of a standard deviation; some measurements are rejected.
    """
    likelihood, at, config = far_from_the_maximum(order)
    free = free_of(likelihood, config, ALL)
    kinds = {one.key.rpartition(".")[2] if one.fit != "noise" else one.key.split(".")[2] for one in free}
    plant = {"time_constant_ms"} if order == 1 else {"natural_frequency_rad_s", "damping"}
    assert kinds >= {"sd_mm", "drift_mm_rts", "delay_ms", "intercept", "gain_recovery_ms", "latency_ms", *plant}
    assert (np.concatenate(at.outcomes) == pf.Outcome.REJECTED).any()
    bare, found = likelihood.derivatives(config, free, at.outcomes), derivatives(likelihood, at, free)
    steep = 0
    for number, one in enumerate(free):
        here, step = one.coordinate(one.number(config)), 1e-6 if one.log else 1e-7  # past no edge of what adapts
        up, down = (
            point(likelihood, moved(config, [one], [here + sign * step]), free, at.outcomes) for sign in (1, -1)
        )
        sd = 1.0 / np.sqrt(found.information[number, number])
        within = 1e-5 / sd
        wanted = (up.log_likelihood - down.log_likelihood) / (2.0 * step)
        assert bare.score[number] == pytest.approx(wanted, rel=1e-5, abs=within), one.key
        with_prior = (up.log_posterior - down.log_posterior) / (2.0 * step)
        assert found.score[number] == pytest.approx(with_prior, rel=1e-5, abs=within), one.key
        _, more = one.prior_score(config)
        assert found.information[number, number] - bare.information[number, number] == pytest.approx(more, rel=1e-6)
        steep += abs(wanted) * sd > 1.0
    assert steep > 0.6 * len(free)


WITH_NOISE = Case(
    {"radial": AxisModel(plant=UNDER, gain=pf.Gain(slope=0.05, intercept=1.1), gain_recovery=0.06)},
    process=pf.Process(input_noise=3e-4, drift=2e-3, maneuver_noise=2e-3, maneuver_drift=1e-2),
    seen={
        "tracker": Seen(sensor(4e-4, latency=0.008), every(50, 20, 30 * MS)),
        "vision": Seen(sensor(1e-3, latency=0.07), every(25, 10, 47 * MS)),
    },
)


def test_scores_and_information_are_those_of_the_joint_gaussian() -> None:
    """For every kind of parameter, with measurements drawn from the oracle's mean m and covariance K.

    The score of each draw is r′K⁻¹∂m + ½ (r′K⁻¹∂K K⁻¹r − tr K⁻¹∂K), to 5e-5 standard deviations. The
    information is random but for its mean ∂m′K⁻¹∂m + ½ tr K⁻¹∂K K⁻¹∂K: that of 100 draws is within 4 standard errors.
    """
    run, config = WITH_NOISE.made()
    likelihood = Likelihood([run], config)
    free = free_of(likelihood, config, ALL)

    def jointly(at: pf.FusionConfig) -> tuple[np.ndarray, np.ndarray]:
        return AxisOracle(run, at, "radial").jointly()

    mean, covariance = jointly(config)
    inverse = np.linalg.inv(covariance)
    d_mean, d_covariance = [], []
    for one in free:
        at, step = one.coordinate(one.number(config)), 1e-3 if one.log else 2e-5
        (m_up, K_up), (m_down, K_down) = (jointly(one.move(config, at + sign * step)) for sign in (1, -1))
        d_mean.append((m_up - m_down) / (2.0 * step))
        d_covariance.append(inverse @ (K_up - K_down) / (2.0 * step))
    moved_by = np.array(d_mean)
    traces = np.array([[np.trace(one @ other) for other in d_covariance] for one in d_covariance])
    wanted = moved_by @ inverse @ moved_by.T + 0.5 * traces
    sd = np.sqrt(np.diag(wanted))
    rng, root, found = np.random.default_rng(1), np.linalg.cholesky(covariance), []
    measurements = AxisOracle(run, config, "radial").measurements
    for _ in range(100):
        drawn = mean + root @ rng.standard_normal(len(mean))
        for measurement, value in zip(measurements, drawn.tolist(), strict=True):
            run.sensors[measurement.sensor].values["radial"][measurement.row] = value
        likelihood = Likelihood([run], config)
        there = likelihood.derivatives(config, free, likelihood.evaluate(config).outcomes)
        r = inverse @ (drawn - mean)
        score = [
            d_m @ r + 0.5 * (r @ covariance @ d_K @ r - np.trace(d_K))
            for d_m, d_K in zip(d_mean, d_covariance, strict=True)
        ]
        np.testing.assert_allclose(there.score / sd, score / sd, atol=5e-5, rtol=0.0)
        found.append(there.information / np.outer(sd, sd))
    scatter = np.std(found, axis=0, ddof=1) / np.sqrt(len(found))
    off = np.abs(np.mean(found, axis=0) - wanted / np.outer(sd, sd))
    assert (off < 4.0 * scatter + 2e-3).all(), np.argwhere(off >= 4.0 * scatter + 2e-3)
    assert scatter.max() < 0.08


# ---- rough estimates ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, 0.02])
def test_scatter_is_the_noise_whatever_the_motion(share: float) -> None:
    """From one measurement to the next, on a swing of 50 mm: to 8 %, and to 20 % with 2 % of wild measurements."""
    rng = np.random.default_rng(3)
    time = np.arange(3000) * 0.01
    swing = 0.05 * np.sin(2.0 * time)
    noise = {"tracker": 0.05e-3, "camera": 0.4e-3}
    wild = (rng.random(len(time)) < share) * rng.choice([-0.02, 0.02], len(time))
    read = {name: (time, {"radial": swing + sd * rng.standard_normal(len(time)) + wild}) for name, sd in noise.items()}
    run = pf.Run.from_arrays(time[::3], {"radial": swing[::3]}, read)
    arm = pf.ArmModel.load("puma560-internal")
    likelihood = Likelihood([run], pf.FusionConfig(arm=arm, sensors={name: pf.Sensor(sd=7.0) for name in noise}))
    wanted = {(name, "radial"): sd for name, sd in noise.items()}
    assert likelihood.scatter == pytest.approx(wanted, rel=0.2 if share else 0.08)


def test_measurements_are_as_far_from_the_noiseless_arm_as_from_the_oracles() -> None:
    """As each sensor would measure it: with scale, start levels and delays."""
    case = CASES["axes and missing values"]
    run, config = case.made()
    likelihood = Likelihood([run], config)
    apart = likelihood.apart(config)
    assert {name for name, _ in apart} == set(case.seen)
    for (name, axis), (left,) in apart.items():
        oracle = AxisOracle(run, config, axis)
        mine = [measurement for measurement in oracle.measurements if measurement.sensor == name]
        position, _ = oracle.undisturbed(np.array([measurement.valid for measurement in mine]))
        value = np.array([measurement.value for measurement in mine])
        np.testing.assert_allclose(left, value - config.sensors[name].scale * position, atol=1e-12)
