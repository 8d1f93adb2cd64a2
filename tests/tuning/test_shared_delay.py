"""Axes share one delay unless the measurements say otherwise; a sensor's drift is fitted where it is asked for."""

import re

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.tuning.intervals import lag_intervals
from pumafuse.tuning.stage import Plan, Stage, run_stage
from tuning_runs import contains, fit_stage, intervals_of, later, replaced

PERIOD, COUNT, DELAY = 0.02, 1500, 0.06
AXES, TIME = "xyz", PERIOD * np.arange(COUNT)


def known(delays: dict[str, float] | None = None, sds: dict[str, float] | None = None) -> pf.FusionConfig:
    """Three axes of different lags, measured by one camera; with ``delays`` and ``sds`` some of their own."""
    lags = {"x": 0.03, "y": 0.05, "z": 0.08}
    axes = {
        axis: pf.AxisModel(plant=pf.FirstOrder(time_constant=lag), delay=(delays or {}).get(axis))
        for axis, lag in lags.items()
    }
    arm = pf.ArmModel(name="three axes", update_period=PERIOD, delay=DELAY, axes=axes)
    camera = pf.Sensor(sd=dict.fromkeys(AXES, 3e-4) | (sds or {}), gate=0.0)
    process = dict.fromkeys(AXES, pf.Process(input_noise=2e-5, drift=1e-4))
    return pf.FusionConfig(arm=arm, process=process, sensors={"camera": camera})


def drawn(truth: pf.FusionConfig, seed: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Commands of random levels and the path of each axis, drawn from the truth in ten steps to a command."""
    rng = np.random.default_rng(seed)
    command = {axis: np.repeat(0.02 * rng.standard_normal(COUNT // 25), 25) for axis in AXES}
    paths, fine = dict[str, np.ndarray](), PERIOD / 10
    for axis in AXES:
        late, lag = truth.arm.delay_of(axis), truth.arm.axes[axis].plant.lag
        at = np.arange(10 * COUNT) * fine
        held = command[axis][np.clip(np.floor((at - late) / PERIOD + 1e-9).astype(int), 0, None)]
        held[at < late] = command[axis][0]
        pushed = held + 2e-5 / np.sqrt(fine) * rng.standard_normal(len(at))
        path, left = np.empty(len(at)), np.exp(-fine / lag)
        path[0] = command[axis][0]
        for n in range(1, len(at)):
            path[n] = pushed[n - 1] + left * (path[n - 1] - pushed[n - 1])
        walk = np.cumsum(1e-4 * np.sqrt(PERIOD) * rng.standard_normal(COUNT))
        paths[axis] = path[::10] + walk
    return command, paths


def measured(truth: pf.FusionConfig, seed: int) -> pf.Run:
    """The run, with a camera's white noise on every second sample."""
    (command, paths), rng = drawn(truth, seed), np.random.default_rng(100 + seed)
    sd = truth.sensors["camera"].sd_of
    seen = {axis: path[::2] + sd(axis) * rng.standard_normal(COUNT // 2) for axis, path in paths.items()}
    return pf.Run.from_arrays(TIME, command, {"camera": (TIME[::2], seen)})


def stage(truth: pf.FusionConfig, seed: int, one_delay: bool = False) -> Stage:
    start = replaced(known(), arm=replaced(known().arm, delay=0.075), sensors=truth.sensors)
    return run_stage([measured(truth, seed)], start, Plan(("delay", "plant"), (), one_delay=one_delay))


@pytest.mark.parametrize("seed", [1, later(2)])
def test_the_same_delay_is_found_as_one(seed: int) -> None:
    """One number of the arm and none of any axis; the truth is in its interval, and every lag in its own."""
    found = stage(known(), seed)
    arm = found.best.config.arm
    assert [one.key for one in found.free if one.fit == "delay"] == ["delay_ms"]
    assert {one.delay for one in arm.axes.values()} == {None}
    (shared,) = (one for one in found.free if one.fit == "delay")
    assert contains(intervals_of(found)["delay_ms"], shared, known())
    for axis, (below, above) in lag_intervals(found.likelihood, found.best, found.free).items():
        assert -1.5 * below < known().arm.lag_of(axis) - arm.lag_of(axis) < 1.5 * above
    assert all("delay: shared (own -" in why for why in found.orders.values())


@pytest.mark.long
@pytest.mark.parametrize(("seed", "sds"), [(1, {}), (2, {}), (1, {"x": 1e-3, "y": 1e-3})])
def test_another_delay_stays_the_axis_own(seed: int, sds: dict[str, float]) -> None:
    """An axis that is 12 ms later than the two others is not pressed into their delay, unless it is asked for.

    Nor are they into its own, where it is measured best.
    """
    truth = known({"z": DELAY + 0.012}, sds)
    found = stage(truth, seed)
    arm = found.best.config.arm
    assert (arm.axes["x"].delay, arm.axes["y"].delay) == (None, None)
    assert arm.axes["z"].delay == pytest.approx(DELAY + 0.012, abs=0.004)
    assert arm.delay == pytest.approx(DELAY, abs=0.004)
    assert "delay: its own (own +" in found.orders["z"]
    forced = stage(truth, seed, one_delay=True).best.config.arm
    assert {one.delay for one in forced.axes.values()} == {None}


@pytest.mark.long
def test_another_delay_that_hardly_shows_is_said_to_be_doubtful_and_costs_no_lag() -> None:
    """8 ms later, by a camera of 2 mm: a second order with the others' delay says the same, odds of less than e³.

    The lag is right to 2 ms either way.
    """
    truth = known({"z": DELAY + 0.008}, {"z": 2e-3})
    found = stage(truth, 1)
    assert found.best.config.arm.lag_of("z") == pytest.approx(truth.arm.lag_of("z"), abs=2e-3)
    assert abs(float(re.findall(r"own ([-+]\d+\.\d)", found.orders["z"])[0])) < 3.0


def test_what_is_fixed_is_not_shared() -> None:
    """An axis whose delay is known keeps it to the last bit, and its model goes on without the others' delay."""
    start = replaced(known(), arm=replaced(known().arm, delay=0.075))
    found = fit_stage(measured(known(), 1), start, ("delay",), "axes.y.delay_ms")
    assert found.best.config.arm.delay_of("y") == 0.075
    assert found.best.config.arm.delay_of("x") == pytest.approx(DELAY, abs=0.004)


def test_a_drift_is_fitted_on_request() -> None:
    """A stationary Gauss-Markov error of 0.5 mm and 5 s in one of two sensors: sd and time are in their intervals."""
    rng, (command, paths) = np.random.default_rng(7), drawn(known(), 5)
    left, drift = np.exp(-PERIOD / 5.0), 5e-4 * rng.standard_normal(COUNT)
    for n in range(1, COUNT):
        drift[n] = left * drift[n - 1] + np.sqrt(1.0 - left**2) * drift[n]
    noise = 3e-4 * rng.standard_normal((2, COUNT))
    sources = {
        "camera": (TIME[::2], {"x": (paths["x"] + noise[0])[::2]}),
        "tracker": (TIME[1::2], {"x": (paths["x"] + drift + noise[1])[1::2]}),
    }
    run = pf.Run.from_arrays(TIME, command, sources)
    camera = known().sensors["camera"]
    config = replaced(known(), sensors={"camera": camera, "tracker": camera})
    found = fit_stage(run, config, ("bias",), "sensors.camera")
    tracker = replaced(camera, bias_drift_sd=5e-4, bias_time=5.0)
    truth, ends = replaced(config, sensors={"camera": camera, "tracker": tracker}), intervals_of(found)
    assert {one.key for one in found.free} == {"sensors.tracker.bias_drift_sd_mm", "sensors.tracker.bias_time_s"}
    for one in found.free:
        assert contains(ends[one.key], one, truth), one.key
