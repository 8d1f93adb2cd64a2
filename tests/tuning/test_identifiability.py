"""Correlated and not identifiable parameters are named, and values at a bound are reported."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.filter.response import response
from pumafuse.tuning.identifiability import correlations, covariance, shared_times
from pumafuse.tuning.parameters import Parameter, parameters, set_own_delays
from tuning_runs import fit_stage, outage, quietly, replaced, scenario, with_outliers, with_sensors

ARM = pf.ArmModel.load("puma560-internal")
CONFIG = pf.FusionConfig(arm=ARM, sensors={"tracker": pf.Sensor(sd=5e-5)})


def free(count: int) -> list[Parameter]:
    return parameters(CONFIG, CONFIG, {"radial": ["tracker"], "vertical": ["tracker"]}, ("noise",))[:count]


@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_a_covariance_is_the_inverse_of_the_information(count: int, seed: int) -> None:
    """However far its scales are apart: I C = 1 to 1e-6."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((count, count + 2))
    scale = 10.0 ** rng.uniform(-2.0, 4.0, count)
    information = root @ root.T * np.outer(scale, scale)
    found = covariance(information, free(count))
    unity = (information @ found) * np.outer(1.0 / scale, scale)
    np.testing.assert_allclose(unity, np.eye(count), atol=1e-6)


def test_a_parameter_at_a_bound_is_reported() -> None:
    """A noise of 0 is not significant. A delay that belongs beyond its bound: the model does not fit."""
    sim = outage(1)
    still = [
        f"process.{axis}.{key}"
        for axis in ("tangential", "vertical")
        for key in ("input_noise_mm_rtHz", "drift_mm_rts")
    ]
    found = quietly(lambda: pf.tune([sim.run], sim.config, fix=[*still, "sd_mm"]))
    none = [one for one in found.details.parameters if one.value == 0.0]
    assert none and all(one.notes == "not significant" and one.ci95[0] == 0.0 for one in none)
    assert all(one.ci95[1] is not None and one.ci95[1] > 0.0 for one in none)
    sim = pf.simulate(scenario("panel-vision", 0.1, 0.06), 1)
    early = with_sensors(sim.config, latency=0.12)  # by more than the arm is late
    found = quietly(lambda: pf.tune([sim.run], early, fit=["delay"]))
    for one in found.details.parameters:
        assert one.ci95[0] is None and one.notes.startswith("at its lower bound (0"), one
    arm = found.config.arm
    ends = [one.delay_ci95 for one in (arm, *arm.axes.values()) if one.delay_ci95 is not None]
    assert ends and all(low == 0.0 < high for low, high in ends)  # no dead time is below 0


def test_pairs_beyond_nine_tenths_are_named() -> None:
    """Delay and time constant by a camera alone: the correlations of the inverted information and priors, no others.

    The other axis's delay is known, so that this one has its own.
    """
    sim = with_outliers(1)
    config = set_own_delays(sim.config, ["tangential"])
    found = fit_stage(sim.run, config, ("noise", "delay", "plant"), "axes.tangential.delay_ms", "disturbance_sd_mm")
    inside = [one for one in found.free if one.at_bound(found.best.config) is None]
    information = found.likelihood.derivatives(found.best.config, inside, found.best.outcomes).information
    information += np.diag([one.prior_score(found.best.config)[1] for one in inside])
    inverse = np.linalg.inv(information)
    sd = np.sqrt(np.diag(inverse))
    matrix = inverse / np.outer(sd, sd)
    wanted = {
        frozenset((inside[i].key, inside[j].key)): matrix[i, j]
        for i in range(len(inside))
        for j in range(i)
        if abs(matrix[i, j]) > 0.9
    }
    named = correlations(found.likelihood, found.best, found.free)
    assert {frozenset((one.first, one.second)): one.correlation for one in named} == pytest.approx(wanted, rel=1e-6)
    assert frozenset(("axes.vertical.time_constant_ms", "axes.vertical.delay_ms")) in wanted


GROUPS = {  # sensors of both axes, axes that move, what is fixed as asked; for each latency that is fixed its group
    "all measure all": ("good poor", "good poor", "tv", [], {"good": "good poor t v"}),
    "no axis in common": ("good", "poor", "tv", [], {"good": "good t", "poor": "poor v"}),
    "connected by a third": ("good third", "poor third", "tv", [], {"good": "good poor third t v"}),
    "a delay that is known": ("good poor", "good", "tv", ["axes.t"], {}),
    "a latency that is known": ("good poor", "", "t", ["good.latency_ms"], {}),
    "an axis at rest": ("good", "poor", "t", [], {"poor": "poor", "good": "good t"}),
}


@pytest.mark.parametrize(("of_t", "of_v", "moving", "fixed", "wanted"), GROUPS.values(), ids=GROUPS)
def test_one_latency_is_fixed_of_each_connected_group(
    of_t: str, of_v: str, moving: str, fixed: list[str], wanted: dict[str, str]
) -> None:
    """Groups of sensors and moving axes that measurements connect, with all times free; the most accurate sensor's.

    The latency of a sensor which measures nothing that moves is fixed alone.
    """
    sensors = {name: pf.Sensor(sd=sd) for name, sd in (("poor", 1e-3), ("third", 2e-3), ("good", 1e-4))}
    arm = replaced(ARM, axes=dict.fromkeys("tv", ARM.axes["radial"]))
    config = set_own_delays(pf.FusionConfig(arm=arm, sensors=sensors), "tv")
    sensors_of = {"t": of_t.split(), "v": of_v.split()}
    founds = shared_times(
        sensors_of, moving, parameters(config, config, sensors_of, ("delay", "latency"), fixed), config
    )
    named = {one.fixed.split(".")[1]: {key.split(".")[1] for key in one.members} for one in founds}
    assert named == {name: set(group.split()) for name, group in wanted.items()}


def in_step(delay: float, lag: float, after: float, rate: float) -> tuple[pf.Tuning, float, float]:
    """What is tuned on an encoder ``after`` each command [s], and error and error bar at the commands, RMS [m]."""
    T, rng = 28_000_000, np.random.default_rng(5)
    commands = T * np.arange(700)
    path = 0.5 + 0.1 * np.sin(commands / 1e9)
    axis = pf.AxisModel(plant=pf.FirstOrder(time_constant=lag))
    stamp = np.sort(T * 10 + round(after * 1e9) + np.rint(rate * T * np.arange(680)).astype(np.int64))
    seen, truth = (0.5 + response(axis, 0.028, delay, commands, path, 0.5, at) for at in (stamp, commands))
    seen += 5e-5 * rng.standard_normal(680)
    run = pf.Run.from_arrays(commands, {"x": path}, {"encoder": (stamp, {"x": seen})})
    arm = pf.ArmModel(name="an arm", update_period=0.028, delay=0.03, axes={"x": axis})
    config = pf.FusionConfig(arm=arm, sensors={"encoder": pf.Sensor(sd=5e-5)})
    tuned = quietly(lambda: pf.tune([run], config, fit=["noise", "delay", "plant"]))
    estimate = pf.fuse(run, tuned.config)["x"]
    error, sd = (np.sqrt(np.mean(rows[20:] ** 2)) for rows in (estimate.position - truth, estimate.position_sd))
    return tuned, float(error), float(sd)


def test_what_sensors_in_step_do_not_see_counts_in_error_bars() -> None:
    """Arms that are there 2 ms after their dead time, seen 20 ms after each command alone: when they go is unseen.

    So at the commands the estimates of some are off by a whole step, by 20 times the encoder's noise and more. Of six
    dead times over a period, errors have an RMS of 0.4 to 1.6 of their error bars.
    """
    ratios = list[float]()
    for delay in 0.05 + 0.028 / 6.0 * np.arange(6):
        tuned, error, sd = in_step(float(delay), 0.002, 0.020, 1.0)
        (note,) = (note for note in tuned.details.notes if "one instant" in note)
        (size,) = re.findall(r"^encoder: 20 ms after each command, .* about ([\d.]+) mm on x", note)
        assert float(size) == pytest.approx(1e3 * sd, rel=0.1)
        ratios.append(error / sd)
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.6


@pytest.mark.parametrize(
    ("lag", "after", "rate"),
    [(0.040, 0.020, 1.0), (0.002, 0.020, 0.93), (0.002, 0.0, 1.0)],
    ids=["an arm that moves on", "another rate", "at the commands"],
)
def test_what_sensors_see_is_not_unseen(lag: float, after: float, rate: float) -> None:
    """A slow arm, instants all over each period, or those of the estimates: bars are of the size of the noise."""
    tuned, error, sd = in_step(0.05, lag, after, rate)
    assert not any("one instant" in note for note in tuned.details.notes)
    assert error < 2.0 * sd < 3e-4
