"""Latencies, scales, steps and jitter of one sensor against another, where all of them were simulated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import pumafuse as pf
from pumafuse.arrays import FloatArray
from pumafuse.discovery.following import isolated, scatter
from pumafuse.discovery.paths import path
from pumafuse.discovery.sensors import Alignment, aligned, noise
from pumafuse.filter.response import response

LENGTH, LATENCY, NOISE = 60.0, 0.045, 3e-4  # s, s, m


def motion(t: FloatArray, phases: FloatArray) -> FloatArray:
    """What is commanded [m]."""
    return 0.05 * np.sin(2.0 * np.pi * np.outer(np.maximum(t, 0.0), [0.1, 0.3, 0.7]) + phases).sum(axis=1)


def recorded(
    seed: int = 0,
    *,
    rate: float = 30.0,
    dense: float = 100.0,
    scale: float = 1.0,
    late: float | FloatArray = LATENCY,
    outliers: float = 0.0,
    noise: float = NOISE,
) -> pf.Run:
    """An arm that no model has: it follows 150 ms late and wanders by 2 mm. An encoder is right, a camera is late."""
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0.0, 6.0, 3)
    t, s = np.arange(0.0, LENGTH, 0.02), np.arange(0.3, LENGTH - 0.5, 1.0 / dense)
    valid = np.arange(0.5, LENGTH - 1.0, 1.0 / rate)

    def arm(at: FloatArray) -> FloatArray:
        return motion(at - 0.15, phases) + 2e-3 * np.sin(1.3 * at)

    z = scale * arm(valid) + 0.3 + rng.normal(0.0, noise, len(valid))
    z[rng.random(len(z)) < outliers] += 0.03
    stamp = valid + (late if isinstance(late, float) else late[: len(valid)])
    order = np.argsort(stamp, kind="stable")
    encoder = s, {"x": arm(s) + rng.normal(0.0, 1e-4, len(s))}
    sensors = {"encoder": encoder, "camera": (stamp[order], {"x": z[order]})}
    return pf.Run.from_arrays(t, {"x": motion(t, phases)}, sensors)


def told(run: pf.Run, first: str = "encoder", second: str = "camera") -> Alignment:
    found = aligned([run], first, second)
    assert found is not None
    return found


@pytest.mark.parametrize(("rate", "dense"), [(5.0, 5.0), (100.0, 10.0)])
def test_a_latency_is_found_whatever_the_rates(rate: float, dense: float) -> None:
    """The denser one is interpolated; which of both is asked for does not matter; outliers do not either.

    The encoder is in step with commands of 50 Hz: the latency is known to a twentieth of 20 ms each way.
    """
    run = recorded(rate=rate, dense=dense, outliers=0.01)
    found, turned = told(run), told(run, "camera", "encoder")
    assert found.latency == pytest.approx(LATENCY, abs=5e-4)
    assert turned.latency == pytest.approx(-found.latency, abs=1e-4)
    assert found.half == pytest.approx(1e-3)
    twice = replace(run, command=run.command.rows(np.repeat(np.arange(len(run.command.stamp)), 3)))
    assert told(twice).half == pytest.approx(1e-3)  # commands that are written three times are one
    assert found.scale == 1.0
    assert found.sd["x"] == pytest.approx(NOISE, rel=0.15)
    assert found.latency_sd == 0.0
    assert not found.steps


@pytest.mark.long
def test_intervals_hold() -> None:
    """Of 20 latencies 95 % lie in theirs: at least 16 do but for one time in 300, and they are not much too wide."""
    every = [told(recorded(seed, rate=10.0, dense=20.0, noise=3e-3)) for seed in range(20)]
    off = np.array([(one.latency - LATENCY) / one.half for one in every])
    assert np.count_nonzero(np.abs(off) < 1.0) >= 16
    assert np.sqrt(np.mean(off**2)) > 0.3  # 0.51 if they are exact


def test_an_encoder_in_step_with_the_commands_does_not_see_the_steps_between_them() -> None:
    """An arm that moves in steps of 50 ms, each to two thirds in that time: one interval of eight held."""
    period, arm = 0.05, pf.AxisModel(plant=pf.FirstOrder(time_constant=0.04))
    t = np.arange(0.0, 40.0, period)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        u, camera = motion(t, rng.uniform(0.0, 6.0, 3)), np.arange(0.5, 38.5, 1.0 / 30.0) + rng.uniform(0.0, 1.0 / 30.0)

        def seen(at: FloatArray, noise: float, u: FloatArray = u, rng: np.random.Generator = rng) -> FloatArray:
            given, valid = (np.rint(1e9 * time).astype(np.int64) for time in (t, at))
            return response(arm, period, 0.01, given, u, u[0], valid) + rng.normal(0.0, noise, len(at))

        encoder = t[5:-5], {"x": seen(t[5:-5], 1e-4)}
        sensors = {"encoder": encoder, "camera": (camera + LATENCY, {"x": seen(camera, NOISE)})}
        found = told(pf.Run.from_arrays(t, {"x": u}, sensors))
        assert abs(found.latency - LATENCY) < found.half < 0.06 * period


def test_a_latency_settles_where_rounds_go_to_and_fro() -> None:
    """An arm that is there 15 ms after each step of 50 ms: rounds of 10 ms there and back went on for ever."""
    period, arm, rng = 0.05, pf.AxisModel(plant=pf.FirstOrder(time_constant=0.015)), np.random.default_rng(0)
    t = np.arange(0.0, 40.0, period)
    u, camera = motion(t, rng.uniform(0.0, 6.0, 3)), np.arange(0.5, 38.5, 1.0 / 30.0) + rng.uniform(0.0, 1.0 / 30.0)
    given, *valid = (np.rint(1e9 * time).astype(np.int64) for time in (t, t[5:-5], camera))
    encoder, seen = (u[0] + response(arm, period, 0.01, given, u, u[0], at) for at in valid)
    encoder, seen = encoder + rng.normal(0.0, 1e-4, len(encoder)), seen + rng.normal(0.0, NOISE, len(seen))
    sensors = {"encoder": (t[5:-5], {"x": encoder}), "camera": (camera + LATENCY, {"x": seen})}
    assert told(pf.Run.from_arrays(t, {"x": u}, sensors)).latency == pytest.approx(LATENCY, abs=2.5e-3)


def test_a_scale_costs_no_latency_on_a_path_in_one_direction() -> None:
    """40 s at constant speed with a rest at each end, where a scale that is not fitted is a latency of its own."""
    rng, scale = np.random.default_rng(3), -1.05
    t, s, x = np.arange(0.0, LENGTH, 0.02), np.arange(0.3, 59.0, 0.01), np.arange(0.5, 58.5, 0.03)

    def ramp(at: FloatArray) -> FloatArray:
        return 0.02 * np.clip(at - 10.0, 0.0, 40.0) + 0.01 * np.sin(0.5 * at)

    camera = scale * ramp(x - 0.15 - LATENCY) + rng.normal(0.0, 1e-4, len(x))
    encoder = ramp(s - 0.15) + rng.normal(0.0, 1e-4, len(s))
    run = pf.Run.from_arrays(t, {"x": ramp(t)}, {"encoder": (s, {"x": encoder}), "camera": (x, {"x": camera})})
    found = told(run)
    assert found.latency == pytest.approx(LATENCY, abs=2e-3)
    assert found.latency_ci95[0] < LATENCY < found.latency_ci95[1]
    assert found.scale == pytest.approx(scale, abs=2e-3)
    turned = told(run, "camera", "encoder")
    assert turned.scale == pytest.approx(1.0 / scale, abs=2e-3)


def test_a_step_of_the_latency_is_named_and_a_steady_one_has_none() -> None:
    """From 45 to 80 ms after 30 s: when, from what, to what; the interval covers both."""
    late = np.where(np.arange(0.5, LENGTH, 1.0 / 30.0) < 30.0, LATENCY, 0.08)
    found = told(recorded(late=late))
    (step,) = found.steps
    assert step.time == pytest.approx(30.0, abs=0.5)
    assert (step.before, step.after) == pytest.approx((LATENCY, 0.08), abs=5e-4)
    assert found.latency_ci95[0] < LATENCY < 0.08 < found.latency_ci95[1]
    assert told(recorded(late=late), "camera", "encoder").steps[0].after == pytest.approx(-0.08, abs=5e-4)


def test_jitter_is_told_from_noise() -> None:
    """10 ms from row to row; the noise at rest is that of the sensor."""
    late = LATENCY + np.random.default_rng(9).normal(0.0, 0.01, 3000)
    found = told(recorded(late=late, dense=20.0))
    assert found.latency_sd == pytest.approx(0.01, rel=0.15)
    assert found.latency_ci95[0] < LATENCY < found.latency_ci95[1]
    assert not found.bunched
    assert found.sd["x"] == pytest.approx(NOISE, rel=0.6)


def test_rows_that_arrive_in_bunches_are_said_to() -> None:
    """Every 100 ms all rows since the last time, with stamps that differ by 10 µs."""
    valid = np.arange(0.5, LENGTH, 1.0 / 30.0)
    late = np.ceil((valid + LATENCY) / 0.1) * 0.1 - valid + 1e-5 * (np.arange(len(valid)) % 5)
    found = told(recorded(late=late))
    assert found.bunched
    assert found.latency == pytest.approx(late.mean(), abs=2e-3)
    assert found.latency_sd == pytest.approx(late.std(), rel=0.15)


def test_a_sensor_that_froze_is_not_followed() -> None:
    """Zeros for 10 s of the motion: neither the latency nor the scale counts them."""
    run = recorded()
    encoder = run.sensors["encoder"]
    frozen = np.where(np.abs(encoder.stamp - encoder.stamp[3000]) < 5e9, 0.0, encoder.values["x"])
    found = told(replace(run, sensors={**run.sensors, "encoder": replace(encoder, values={"x": frozen})}))
    assert found.latency == pytest.approx(LATENCY, abs=5e-4)


def test_only_the_part_of_the_run_counts_and_runs_are_averaged() -> None:
    """Before 30 s the latency is another; two runs that agree tell it better than one."""
    late = np.where(np.arange(0.5, LENGTH, 1.0 / 30.0) < 30.0, LATENCY, 0.08)
    part = recorded(late=late).between(31.0, None)
    assert told(part).latency == pytest.approx(0.08, abs=5e-4)
    runs = [recorded(seed, rate=10.0, dense=20.0, noise=3e-3) for seed in range(3)]
    every = aligned(runs, "encoder", "camera")
    assert every.latency == pytest.approx(LATENCY, abs=2e-3)
    assert every.half < 0.8 * np.mean([told(run).half for run in runs])


def test_sensors_without_common_motion_have_no_latency() -> None:
    run = recorded()
    assert aligned([run], "encoder", "laser") is None
    camera = run.sensors["camera"]
    for other in (
        replace(camera, values={"y": camera.values["x"]}),
        camera.rows(slice(0, 30)),
        camera.rows(slice(0, 0)),
        replace(camera, values={"x": np.random.default_rng(1).normal(size=len(camera.stamp))}),
        replace(camera, values={"x": np.full(len(camera.stamp), np.nan)}),
    ):
        assert aligned([replace(run, sensors={**run.sensors, "camera": other})], "encoder", "camera") is None


def test_a_path_is_that_of_a_linear_arm_between_the_rows_of_a_slow_sensor() -> None:
    """Held steps, 80 ms of dead time and 40 ms of lag at 5 Hz: lines between the rows are off by 10 times as much.

    The noise by third differences is too large by as much as well: they take the motion for it.
    """
    rng = np.random.default_rng(2)
    fine = np.arange(0.0, LENGTH, 1e-3)
    t = fine[::20]
    u = np.repeat(rng.uniform(-0.1, 0.1, 100), rng.integers(20, 60, 100))[: len(t)]
    held = np.repeat(u, 20)[np.maximum(np.arange(len(fine)) - 80, 0)]
    left = np.exp(-1e-3 / 0.04)
    position = lfilter([1.0 - left], [1.0, -left], held - u[0]) + u[0]
    s = np.arange(0.5, 59.0, 0.2) + rng.uniform(-0.01, 0.01, 293)
    z = np.interp(s, fine, position) + rng.normal(0.0, 1e-4, len(s))
    found, at = path((t, u), 0.12, s, z), np.arange(1.0, 58.0, 0.013)
    off, lines = (one - np.interp(at, fine, position) for one in (found(at), np.interp(at, s, z)))
    assert np.sqrt(np.mean(off**2)) < np.sqrt(np.mean(lines**2)) / 10.0
    run = pf.Run.from_arrays(t, {"x": u}, {"camera": (s, {"x": z})})
    assert noise(run.command, run.sensors["camera"], "x", 0.12) < 1e-3 < 0.2 * scatter(z)


def test_what_leaves_and_returns_is_an_outlier_and_a_jerk_is_not() -> None:
    """A row, two on their own; no start, turn or stop of a motion, no jump, and none that dies away."""
    rng = np.random.default_rng(4)
    t = np.arange(400)
    ramp = np.interp(t, [0, 100, 150, 200, 260, 400], [0.0, 0.0, 50.0, 0.0, 10.0, 10.0])
    jumps = np.where(t > 300, 40.0 * np.exp(-np.maximum(t - 301, 0) / 1.0), 0.0) + np.where(t > 350, 30.0, 0.0)
    value = ramp + jumps + rng.normal(0.0, 0.01, len(t))
    assert not isolated(t, value).any()
    value[[50, 120, 230]] += 20.0
    assert np.flatnonzero(isolated(t, value)).tolist() == [50, 120, 230]


def test_a_row_that_is_stamped_late_is_no_outlier() -> None:
    """Read every 6 ms, and stamped when a busy logger comes to it: 5 mm off by its time, by its place not at all."""
    rng, t = np.random.default_rng(6), np.arange(600) * 0.006
    value = np.cos(t) + rng.normal(0.0, 1e-5, len(t))
    t[25::40] += 5e-3
    assert not isolated(t, value).any()
    value[[90, 410]] -= 0.01
    assert np.flatnonzero(isolated(t, value)).tolist() == [90, 410]


def test_rows_that_go_there_and_back_together_are_no_outliers() -> None:
    """A sensor with little noise, of a path whose speed changes with every second row: 12 um, in some curves alone."""
    rng, t = np.random.default_rng(7), np.arange(0.0, 9.0, 0.02)
    speeding = np.clip(t - 4.0, 0.0, 0.5)  # by 40 mm/s^2: 16 um from row to row
    value = 0.02 * speeding**2 + 0.04 * 0.5 * np.maximum(t - 4.5, 0.0) + rng.uniform(-3e-7, 3e-7, len(t))
    value += 1.2e-5 * ((speeding > 0.0) & (speeding < 0.5)) * np.where(np.arange(len(t)) % 2, 1.0, -1.0)
    assert not isolated(t, value).any()
    value[[120, 330]] += 4e-5, 5e-4  # at rest, and beyond the row behind it
    assert np.flatnonzero(isolated(t, value)).tolist() == [120, 330]


@pytest.mark.parametrize("late", [0.3, 1.0])
def test_a_value_that_was_taken_late_or_is_repeated_is_no_outlier(late: float) -> None:
    """Of a carriage at 0.2 m/s, read every 5 ms: by 0.3 of a row, 0.3 mm, or by a whole one; a leap goes beyond."""
    t = np.arange(800) * 0.005
    taken = t - np.where(np.arange(len(t)) % 40 == 7, late * 0.005, 0.0)
    value = 0.2 * np.abs(taken - 2.0) + np.random.default_rng(8).normal(0.0, 1e-6, len(t))
    assert not isolated(t, value).any()
    value[[150, 600]] += 0.004
    assert np.flatnonzero(isolated(t, value)).tolist() == [150, 600]
