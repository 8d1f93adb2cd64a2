"""Least squares finds an arm of which nothing is known, and refutes one that the likelihood has mistaken."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import pumafuse as pf
from executable import pumafuse
from pumafuse.filter.response import response
from pumafuse.model.arm import AxisModel, Gain
from pumafuse.model.plants import FirstOrder
from pumafuse.tuning.arms import Arm, Measured, Recording
from pumafuse.tuning.likelihood import Likelihood
from pumafuse.tuning.plain import Doubt, PlainArm, doubts, lag_steps, plain_arm, set_plain_arm
from pumafuse.tuning.stage import Plan, run_stage
from pumafuse.tuning.summary import fitted_lags
from pumafuse.tuning.tune import Pipeline
from tuning_runs import free_of, quietly, replaced, scenario

DEAD_BAND = Path(__file__).parent / "data" / "dead-band.csv"
T = 0.02
NOISE = 1e-4  # m
EPOCH = 1_764_000_000_000_000_000  # ns, when a log of today begins


def motion(delay: float, time_constant: float, gain: float, seed: int = 0, commands: int = 1500) -> Recording:
    """Steps and ramps, and a sensor of 50 Hz that is off by 7 mm."""
    rng = np.random.default_rng(seed)
    speed = np.repeat(rng.normal(0.0, 0.1, commands // 25 + 1), 25)[:commands]
    command = 0.5 + np.cumsum(speed * T) + np.cumsum((rng.random(commands) < 0.02) * rng.normal(0.0, 0.02, commands))
    given = np.arange(commands) * round(T * 1e9)
    time = np.sort(rng.integers(0, given[-1], commands))
    axis = AxisModel(plant=FirstOrder(time_constant=time_constant), gain=Gain(intercept=gain))
    path = response(axis, T, delay, given, command, 0.5, time)
    value = 0.007 + path + rng.normal(0.0, NOISE, commands)
    return Recording(given, command, 0.5, time, value, np.zeros(commands, dtype=np.int64), np.ones(commands))


def found_in(*recordings: Recording) -> PlainArm | None:
    return plain_arm(Measured(recordings, T, ["camera"]))


@settings(max_examples=8, phases=[Phase.explicit, Phase.generate])
@given(st.floats(0.0, 0.5), st.floats(0.002, 0.5), st.floats(0.7, 1.3), st.integers(0, 1000))
def test_any_arm_is_found(delay: float, time_constant: float, gain: float, seed: int) -> None:
    """Lag to 3 ms and a hundredth, gain to a hundredth, and no more than its noise is left: from no guess at all."""
    found = found_in(motion(delay, time_constant, gain, seed))
    lag = delay + time_constant
    assert found.arm.total == pytest.approx(lag, abs=3e-3, rel=0.01)
    assert found.lag_ci95[0] - 3e-3 - 0.01 * lag <= lag <= found.lag_ci95[1] + 3e-3 + 0.01 * lag
    assert found.arm.gain == pytest.approx(gain, rel=0.01)
    assert np.std(found.measured.left(found.arm)) < 2.5 * NOISE


@pytest.mark.long
def test_outliers_and_the_length_of_a_recording_do_not_matter() -> None:
    """A hundredth of wild measurements; forty thousand commands, most of which are rest: the same arm."""
    one = motion(0.08, 0.06, 1.0)
    value = one.value.copy()
    value[::100] += 0.3
    wild = found_in(one._replace(value=value))
    rest, step = 40_000, round(T * 1e9)
    given = np.append(np.arange(rest) * step, rest * step + one.stamp)
    long = one._replace(stamp=given, command=np.append(np.full(rest, 0.5), one.command), time=rest * step + one.time)
    late = found_in(long)
    assert wild.arm.total == pytest.approx(0.14, abs=2e-3)
    assert late.arm.total == pytest.approx(0.14, abs=2e-3)


def test_nothing_is_said_of_an_axis_at_rest_or_hardly_measured() -> None:
    one = motion(0.05, 0.05, 1.0)
    assert found_in(one._replace(command=np.full(len(one.command), 0.5))) is None
    assert found_in(one.of(slice(5))) is None
    assert found_in() is None


def test_a_right_arm_is_not_refuted_and_a_wrong_one_is() -> None:
    """Of a simulated arm: its own numbers stand; twice its dead time is farther off than the delayed command."""
    simulated = pf.simulate(scenario("panel-vision", 0.3, 0.02), 2)
    config = simulated.config
    likelihood = quietly(lambda: Likelihood([simulated.run], config))
    plain = {axis: plain_arm(likelihood.measured(axis, config)) for axis in likelihood.axes}
    assert doubts(plain, config) == {}
    slow = replaced(config, arm=replaced(config.arm, delay=5.0 * config.arm.delay))
    one = doubts(plain, slow)["tangential"]  # the vertical axis hardly moves
    assert one.refutes
    assert one.plain.arm.total == pytest.approx(config.arm.lag_of("tangential"), abs=0.02)
    assert "tangential" not in doubts(plain, set_plain_arm(slow, "tangential", one.plain.arm))


@pytest.mark.long
def test_one_command_says_the_lag_of_an_arm_with_a_dead_band(tmp_path: Path) -> None:
    """An encoder of a joint that is 140 ms late and has a dead band of 1°; its increments alone fit 283 ms best."""
    done = pumafuse("fuse", DEAD_BAND, "-o", tmp_path / "run")
    assert done.returncode == 0
    config = pf.FusionConfig.load(tmp_path / "run" / "fusion.toml")
    assert config.arm.lag_of("j") == pytest.approx(0.14, abs=0.01)
    told = quietly(lambda: pf.latency(pf.Run.read(tmp_path / "run")))
    assert told.details.axes["j"].lag == pytest.approx(config.arm.lag_of("j"), abs=0.01)


def test_the_interval_of_a_doubted_lag_covers_both_and_one_that_is_replaced_is_that_of_least_squares() -> None:
    """80 (78 to 82) ms by the likelihood and 50 to 60 ms by least squares are 50 to 82; an open end stays open.

    One that was not fitted, and stays, is in its interval, too.
    """
    simulated = pf.simulate(scenario("panel-vision", 0.1, 0.02), 2)
    config, (first, *others) = simulated.config, simulated.config.arm.axes
    slow = replaced(config.arm.axes[first], delay=config.arm.delay_of(first) + 0.08 - config.arm.lag_of(first))
    slow = replaced(config, arm=replaced(config.arm, axes={**config.arm.axes, first: slow}))
    free = [one for one in free_of(Likelihood([simulated.run], slow), slow, ["delay"]) if one.axis == first]
    replaced_arm = set_plain_arm(slow, others[0], Arm(0.03, 0.025))
    arm = PlainArm(Arm(0.03, 0.025), (0.05, 0.06), Arm(0.054, 0.001), 1e-3, *[Measured([], T, [])] * 2)
    doubted = {axis: Doubt(arm, off=1.5e-3, lag=0.08) for axis in config.arm.axes}

    allowed = {axis: one.lag_ci95 for axis, one in doubted.items()}

    def told(
        below: float, above: float, lost: Sequence[str] = (), after: pf.FusionConfig = replaced_arm
    ) -> dict[str, tuple[float | None, float | None]]:
        found = fitted_lags(free, config, after, {first: (below, above)}, allowed, lost)
        return {axis: one.lag_ms_ci95 for axis, one in found.items()}

    found = told(0.002, 0.002)
    assert found[first] == (50.0, pytest.approx(82.0)) and found[others[0]] == (50.0, 60.0)
    lag = slow.arm.lag_of(others[0]) * 1e3
    assert lag > 60.0 and told(0.002, 0.002, after=slow)[others[0]] == (50.0, pytest.approx(lag))
    assert others[0] not in told(0.002, 0.002, others[:1])
    assert told(0.002, np.inf)[first] == (50.0, None)
    assert [Doubt(arm, off, lag=0.08).refutes for off in (3.9e-3, 4.1e-3)] == [False, True]
    assert Doubt(arm, 1e-3, lag=0.08, is_beaten=True).refutes


@pytest.mark.parametrize("every", [1, 6])
def test_a_sensor_in_step_tells_a_dead_time_to_a_period_and_no_better(every: int) -> None:
    """What it sees 3 ms after commands of 30 Hz is the same for each dead time from 36.4 to 69.6 ms."""
    period, plant = 1.0 / 30.0, 0.001
    time = np.arange(0.0, 80.0 / (30.0 / every), period)
    u = np.interp(time, np.arange(0.0, 90.0, 0.9), 0.1 * np.resize([-1.0, 1.0], 100))
    axis, stamp, first = AxisModel(plant=FirstOrder(time_constant=plant)), np.rint(time * 1e9).astype(np.int64), u[0]
    seen = stamp[3::every] + 3_000_000
    seconds = stamp / 1e9
    paths = [response(axis, period, delay, stamp, u, first, seen) for delay in (0.0371, 0.066)]
    np.testing.assert_allclose(*paths, atol=1e-3)
    value = u[0] + paths[0] + np.random.default_rng(5).normal(0.0, NOISE, len(seen))
    run = pf.Run.from_arrays(seconds, {"x": u}, {"camera": (seen / 1e9, {"x": value})})
    found = quietly(lambda: pf.latency(run))
    low, high = found.details.axes["x"].lag_ci95
    tuned = quietly(lambda: pf.tune(run, found.config, fit=["noise", "delay", "plant"]))
    for ends in ((low * 1e3, high * 1e3), tuned.details.lags["x"].lag_ms_ci95):
        assert ends[0] < 36.4 + 5.0 and ends[1] > 69.6 - 5.0 and ends[1] - ends[0] < 50.0


def test_a_disturbance_takes_no_more_than_a_period_from_the_lag_of_a_sensor_in_step() -> None:
    """150 ms at 50 Hz beside a slow disturbance of half the motion: least squares alone allow any lag up to 0.7 s."""
    rng, period, count = np.random.default_rng(4), 0.02, 4000
    u = np.repeat(rng.uniform(-0.7, 0.7, count // 100), 100)
    stamp = np.arange(count) * 20_000_000
    plant = AxisModel(plant=FirstOrder(time_constant=0.09))
    pushed = np.zeros(count)
    for k in range(1, count):
        pushed[k] = pushed[k - 1] * (1.0 - period / 1.5) + rng.normal(0.0, 0.35 * np.sqrt(2.0 * period / 1.5))
    pushed = np.convolve(pushed, np.ones(5) / 5.0, "same")
    value = response(plant, period, 0.06, stamp, u, u[0], stamp) + pushed + rng.normal(0.0, 1e-3, count)
    run = pf.Run.from_arrays(stamp / 1e9, {"tilt": u}, {"encoder": (stamp / 1e9, {"tilt": value})})
    low, high = quietly(lambda: pf.latency(run)).details.axes["tilt"].lag_ci95
    assert low < 0.15 < high and high - low < 0.1


def steps(rest: float, lag: float) -> Recording:
    """Steps every ``rest`` [s] by an arm of first order, at rest most of the time, by an encoder without noise."""
    rng = np.random.default_rng(2)
    given = np.arange(0, round(400.0 * 1e9), round(T * 1e9))
    level = rng.uniform(0.2, 0.8, 1 + int(400.0 / rest))
    command = level[(given / 1e9 / rest).astype(int)]
    time = np.arange(0, given[-1], round(0.1 * 1e9))
    moved = Measured([Recording(given, command, command[0], time, np.zeros(len(time)), np.zeros(len(time), np.int64),
                                np.ones(len(time)))], T, ["eye"]).responses(Arm(0.5 * lag, 0.5 * lag))[0]  # fmt: skip
    return Recording(given, command, command[0], time, moved, np.zeros(len(time), np.int64), np.ones(len(time)))


def steady() -> tuple[pf.FusionConfig, str]:
    """A configuration with an axis that goes as far as it is commanded, and that axis."""
    config = pf.simulate(scenario("panel-vision", 0.1, 0.02), 2).config
    axis = next(iter(config.arm.axes))
    whole = replaced(config.arm.axes[axis], gain=pf.Gain(slope=0.0, intercept=1.0))
    return replaced(config, arm=replaced(config.arm, axes={**config.arm.axes, axis: whole})), axis


def test_a_lag_that_least_squares_exclude_is_said_and_its_interval_covers_both() -> None:
    """Also of an arm that predicts about as well; a little outside nothing is said. Play makes it no doubt."""
    config, axis = steady()
    lag = config.arm.lag_of(axis)
    plain = found_in(motion(0.5 * lag, 0.5 * lag, 1.0))
    for share, said in ((1.05, False), (1.5, True)):
        low, high = share * lag, share * lag + 0.01
        one = plain._replace(arm=Arm(low, 0.005), lag_ci95=(low, high), delayed=Arm(high, 0.0), delayed_off=np.inf)
        doubt = doubts({axis: one}, config)[axis]
        assert not doubt.is_worse
        assert (f"lag of {1e3 * lag:.4g} ms, least squares" in doubt.sentence(config, axis)) is said
        with_play = replaced(config.arm.axes[axis], play=1e-3)
        bent = replaced(config, arm=replaced(config.arm, axes={**config.arm.axes, axis: with_play}))
        assert doubts({axis: one}, bent) == {}


def test_quite_another_lag_is_said_where_an_axis_hardly_follows_its_commands() -> None:
    """Least squares put it at 320 ms and allow any: the likelihood's 93 ms are not all. One that explains it is."""
    config, axis = steady()
    lag = config.arm.lag_of(axis)
    one, rng = motion(0.5 * lag, 0.5 * lag, 1.0), np.random.default_rng(0)
    grid = np.arange(0.0, 31.0, T)
    pushed = np.zeros(len(grid))
    for k in range(1, len(grid)):  # for a second or so, by more than the axis moves
        pushed[k] = pushed[k - 1] * (1.0 - T) + rng.normal(0.0, 0.04)
    pushed = np.convolve(pushed, np.ones(9) / 9.0, "same")
    plain = found_in(one._replace(value=one.value + np.interp(one.time / 1e9, grid, pushed)))
    low, high = plain.lag_ci95
    assert low < lag < 0.5 * plain.arm.total < high
    doubt = doubts({axis: plain}, config)[axis]
    assert not doubt.refutes and doubt.lag_ci95 == (low, high)
    assert f"lag of {1e3 * lag:.4g} ms, least squares" in doubt.sentence(config, axis)
    clean = found_in(one)._replace(arm=Arm(2.0 * lag, 0.005), lag_ci95=(low, high), delayed_off=np.inf)
    assert doubts({axis: clean}, config) == {}


def test_no_lag_is_told_of_a_sensor_that_measures_something_else(tmp_path: Path) -> None:
    """Noise of 10° beside commands of ±20°: a note instead of a number."""
    k, rng = np.arange(400), np.random.default_rng(1)
    rows = zip(k * 0.033, 20.0 * np.sin(k / 30.0), rng.normal(0.0, 10.0, 400), strict=True)
    log = tmp_path / "noise.csv"
    log.write_text("time_s,action.j_deg,state.j_deg\n" + "".join(f"{t:.3f},{u:.4f},{z:.4f}\n" for t, u, z in rows))
    done = pumafuse("fuse", log, "-o", tmp_path / "run")
    assert "j: no lag up to 2.6 s explains its motion" in done.stderr
    assert "lag of j" not in done.stdout


def test_an_arm_by_which_a_filter_predicts_better_is_to_take_the_place_of_the_likeliest() -> None:
    """Noise that comes with motion explains any arm of steps: half as late, a filter is far off in each of them."""
    rng, given = np.random.default_rng(3), 0.1 * np.arange(400)
    level = rng.choice([0.0, 0.1, 0.2], 41)
    stamp, later = (np.rint(1e9 * time).astype(np.int64) for time in (np.arange(41.0), given + 0.04))
    one = Recording(stamp, level, level[0], later, np.zeros(400), np.zeros(400, np.int64), np.ones(400))
    moved = level[0] + Measured([one], 1.0, ["encoder"]).responses(Arm(0.18, 0.11))[0]
    seen = moved + rng.normal(0.0, 2e-4, 400)
    run = pf.Run.from_arrays(given, {"j": level.repeat(10)[:400]}, {"encoder": (given + 0.04, {"j": seen})})
    axis = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.11))
    arm = pf.ArmModel(name="servo", update_period=0.1, delay=0.18, axes={"j": axis})
    config = pf.FusionConfig(arm=arm, sensors={"encoder": pf.Sensor(sd=2e-4)})
    pipeline = Pipeline([run], config, [Plan(["noise", "delay", "plant"], [])], lambda _, __: None)
    quietly(pipeline.fit)
    assert not any(one.refutes or one.sentence(pipeline.result(), "j") for one in pipeline.doubts().values())
    early = replaced(arm, delay=0.05, axes={"j": replaced(axis, plant=pf.FirstOrder(time_constant=0.1))})
    pipeline.best = replaced(config, arm=early, process={"j": pf.Process(maneuver_noise=0.1, maneuver_drift=0.01)})
    doubt = pipeline.doubts()["j"]
    assert doubt.is_beaten and doubt.refutes
    assert doubt.plain.arm.total == pytest.approx(0.29, abs=2e-3)
    assert "The arm is that of least squares instead" in doubt.sentence(pipeline.best, "j")


@pytest.mark.long
def test_an_arm_that_takes_the_place_of_another_is_kept() -> None:
    """Of two axes one is held at the arm of least squares: that stays, the other one's is the one that was found."""
    simulated = pf.simulate(scenario("panel-vision", 0.25, 0.02), 2)
    config, kinds = simulated.config, ("noise", "delay", "plant")
    first = quietly(lambda: run_stage([simulated.run], config, Plan(kinds, []))).best.config
    held = set_plain_arm(config, "tangential", Arm(0.031, 0.042))
    again = [Plan(kinds, ["axes.tangential"])]
    second = Pipeline([simulated.run], held, again, lambda _, __: None)
    quietly(second.fit)
    replaced_arm = second.result().arm
    assert replaced_arm.axes["tangential"].plant == FirstOrder(time_constant=0.042)
    assert replaced_arm.delay_of("tangential") == 0.031
    assert replaced_arm.lag_of("vertical") == pytest.approx(first.arm.lag_of("vertical"), abs=2e-3)


def test_a_lag_that_steps_is_said_of_one_sensor_alone() -> None:
    """60 ms more from 0.7 of the run on, of which a plant of second order and a gain might make up: both, and when."""
    one, later = (motion(delay, 0.06, 1.0, commands=1500) for delay in (0.08, 0.14))
    one = one._replace(stamp=one.stamp + EPOCH, time=one.time + EPOCH)
    edge = one.time[int(0.7 * len(one.time))]
    found = found_in(one._replace(value=np.where(one.time < edge, one.value, later.value)))
    assert found.step.time == pytest.approx((edge - one.stamp[0]) / 1e9, abs=0.05 * (one.time[-1] - one.time[0]) / 1e9)
    assert (found.step.before, found.step.after) == pytest.approx((0.14, 0.20), abs=0.01)
    assert f"{1e3 * found.step.before:.0f} ms until about {found.step.time:.0f} s" in str(found.step)
    for steady in (one, later, motion(0.02, 0.3, 0.9, commands=1500)):
        plain = found_in(steady)
        assert plain is not None and plain.step is None


def test_a_stop_is_no_lag_that_steps() -> None:
    """An axis that goes a third as far in the last part of a run, where it stalls, follows as late there as before."""
    one, held = (motion(0.08, 0.06, gain) for gain in (1.0, 0.3))
    edge = one.time[int(0.6 * len(one.time))]
    found = found_in(one._replace(value=np.where(one.time < edge, one.value, held.value)))
    assert found is not None and found.step is None


def test_a_fastest_speed_is_no_lag_that_steps() -> None:
    """Slow at first, then faster than it goes: said of a straight arm, and not of the arm that it is."""
    config = pf.simulate(scenario("saturating-servo"), 2).config
    axis, rng = config.arm.axes["joint"], np.random.default_rng(3)
    given = np.arange(3000) * 10_000_000
    phase = np.cumsum(np.where(np.arange(3000) < 2000, 0.5, 3.0)) * 0.02 * np.pi
    command, time = np.deg2rad(45.0) * np.sin(phase), np.sort(rng.integers(0, given[-1], 600))
    path = response(axis, 0.01, config.arm.delay_of("joint"), given, command, float(command[0]), time)
    value = command[0] + path + rng.normal(0.0, 5e-3, len(time))
    one = Recording(given, command, command[0], time, value, np.zeros(len(time), dtype=np.int64), np.ones(len(time)))
    found = plain_arm(Measured((one,), 0.01, ["camera"]))
    assert found is not None and found.step is not None and found.step.after > found.step.before + 0.01
    arm = replaced(config.arm, axes={"joint": replaced(axis, max_speed=None)})
    assert lag_steps({"joint": found}, config) == []
    assert lag_steps({"joint": found}, replaced(config, arm=arm)) == [f"joint: {found.step}"]
