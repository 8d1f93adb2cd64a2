"""Skill: each predictor against itself worked out one measurement at a time.

The constant-velocity filter is judged by regression on all earlier measurements at once, the command alone by the
superposition of closed-form responses.
"""

from dataclasses import replace

import numpy as np
import pytest

import pumafuse as pf
from fusion_oracle import Response, commands
from pumafuse.fusion.skill import PredictionError, Skill, skill
from pumafuse.fusion.summary import beaten_notes

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
PERIOD, SD = 0.028, 0.5e-3
ARM = pf.ArmModel(
    name="simulated",
    update_period=PERIOD,
    delay=0.0605,
    axes={
        "radial": pf.AxisModel(
            plant=pf.SecondOrder(natural_frequency=40.0, damping=0.7),
            gain=pf.Gain(slope=0.1, intercept=1.02),
            gain_recovery=0.14,
            delay=0.05,
        ),
        "vertical": pf.AxisModel(plant=pf.FirstOrder(time_constant=0.0425)),
    },
)
DENSITIES = [10.0**power for power in range(-8, 3)]


def config(**sensors: pf.Sensor) -> pf.FusionConfig:
    return pf.FusionConfig(arm=ARM, sensors=sensors)


def found(est: pf.Estimates, sensor: str, axis: str) -> Skill:
    one = skill(est, est.measurements.of(sensor, axis))
    assert one is not None
    return one


def moving_run(seed: int, begin: float = 10.0, count: int = 90) -> pf.Run:
    """Two axes that move after a rest; a camera with gaps, outliers and NaN, and a range sensor of scale −1."""
    rng = np.random.default_rng(seed)
    time = begin + PERIOD * np.arange(count)
    path = {
        "radial": 0.5 + 0.03 * np.sin(1.5 * np.maximum(time - begin - 0.4, 0.0)),
        "vertical": 0.2 + 0.02 * np.maximum(time - begin - 0.4, 0.0),
    }
    seen = np.sort(begin + rng.uniform(0.1, PERIOD * count, 60))
    seen = seen[(seen < begin + 1.0) | (seen > begin + 1.5)]
    sight = {axis: np.interp(seen - 0.1, time, u) + SD * rng.standard_normal(len(seen)) for axis, u in path.items()}
    sight["radial"][[7, 20]] += 0.05, -0.04
    sight["vertical"][11] = np.nan
    ranged = begin + 0.05 + 0.02 * np.arange(80)
    distance = 1.2 - np.interp(ranged - 0.1, time, path["radial"]) + 1e-4 * rng.standard_normal(80)
    distance[30] += 0.02
    return pf.Run.from_arrays(
        time, path, {"camera": (seen + 0.02, sight), "range": (ranged, {"radial": distance})}, name=f"run {seed}"
    )


def one_after_the_other(first: pf.Run, second: pf.Run) -> pf.Run:
    """A log whose clock was set back."""

    def sources(a, b):
        values = {axis: np.concatenate([a.values[axis], b.values[axis]]) for axis in a.values}
        return replace(a, stamp=np.concatenate([a.stamp, b.stamp]), values=values)

    sensors = {name: sources(first.sensors[name], second.sensors[name]) for name in first.sensors}
    return replace(first, command=sources(first.command, second.command), sensors=sensors)


SENSORS = {
    "camera": pf.Sensor(sd=SD, latency=0.02, gate=5.0),
    "range": pf.Sensor(sd=1e-4, scale=-1.0, bias_sd=2.0, gate=5.0),
}
PAIRS = [("camera", "radial"), ("camera", "vertical"), ("range", "radial")]


@pytest.fixture(scope="module")
def runs() -> list[pf.Run]:
    return [moving_run(1), moving_run(2, begin=3.0, count=70)]


@pytest.fixture(scope="module")
def est(runs: list[pf.Run]) -> pf.Estimates:
    return pf.fuse(one_after_the_other(*runs), config(**SENSORS))


def segments_of(est: pf.Estimates, sensor: str, axis: str) -> list[pf.Measurements]:
    """What a sensor gave on an axis that was a measurement, by segment: by the time that starts anew."""
    mine = est.measurements.of(sensor, axis)
    mine = mine.where(mine.outcome <= pf.Outcome.REACQUIRED)
    back = int(np.flatnonzero(np.diff(mine.time) < 0.0)[0]) + 1
    early = np.arange(len(mine.time)) < back
    return [mine.where(early), mine.where(~early)]


def check(got: PredictionError, values: list[float], rel: float = 1e-9) -> None:
    sizes = np.abs(values)
    assert (got.rms, got.median) == pytest.approx((np.sqrt(np.mean(sizes**2)), np.median(sizes)), rel)


@pytest.mark.parametrize(("sensor", "axis"), PAIRS)
def test_last_one_held_and_filter(est: pf.Estimates, sensor: str, axis: str):
    """Differences of successive measurements, and innovations, but for the first of each segment."""
    got, parts = found(est, sensor, axis), segments_of(est, sensor, axis)
    check(got.last_held, [float(b - a) for part in parts for a, b in zip(part.value, part.value[1:], strict=False)])
    check(got.filter, [float(nu) for part in parts for nu in part.innovation[1:]])
    assert got.predictions == sum(len(part.value) - 1 for part in parts)
    counts = pf.summarise(est).axes[axis].sensors[sensor].outcomes
    assert counts["rejected"] >= 1  # and are among the predicted
    assert got.predictions == counts["fused"] + counts["rejected"] + counts.get("reacquired", 0) - 2


def by_velocity(time: np.ndarray, value: np.ndarray, density: float) -> list[float]:
    """Each value less a regression on those before: on level, slope, and an integrated random walk of the slope."""
    t, y = time - time[0], value - value[0]
    early, late = np.minimum.outer(t, t), np.maximum.outer(t, t)
    walk = density * early**2 * (late / 2.0 - early / 6.0)
    line, prior = np.stack([np.ones(len(t)), t], axis=1), np.diag([0.0, 1e-6])  # precision: the level is unknown
    found = [float(y[1])]  # after one measurement no slope is known but 0
    for k in range(2, len(t)):
        weighted = np.linalg.solve(walk[:k, :k] + np.eye(k), np.column_stack([line[:k], y[:k], walk[:k, k]]))
        fit = np.linalg.solve(line[:k].T @ weighted[:, :2] + prior, line[:k].T @ weighted[:, 2])
        found.append(float(y[k] - line[k] @ fit - weighted[:, 3] @ (y[:k] - line[:k] @ fit)))
    return found


@pytest.mark.parametrize(("sensor", "axis"), PAIRS)
def test_constant_velocity(est: pf.Estimates, sensor: str, axis: str):
    """The best of eleven regressions, each told all earlier measurements at once."""
    parts = segments_of(est, sensor, axis)
    unit = np.median(np.concatenate([np.diff(part.time) for part in parts]))
    tried = [[e for part in parts for e in by_velocity(part.time / unit, part.value, d)] for d in DENSITIES]
    check(found(est, sensor, axis).constant_velocity, min(tried, key=lambda one: sum(e * e for e in one)), 1e-6)


@pytest.mark.parametrize(("sensor", "axis"), PAIRS)
def test_command_alone(est: pf.Estimates, runs: list[pf.Run], sensor: str, axis: str):
    """Superposed responses to the steps of the commands; a constant bias is the mean of what was left over before."""
    left: list[float] = []
    response, known = Response(ARM.axes[axis]), SENSORS[sensor]
    for run, part in zip(runs, segments_of(est, sensor, axis), strict=True):
        given, start = commands(run, est.config, axis), float(run.command.values[axis][0])
        begin, before = int(run.command.stamp[0]) - est.origin, list[float]()
        for n, time in enumerate(part.time.tolist()):
            since = (round(time * 1e9) - begin - given.acting) * 1e-9
            acts = since > 0.0
            moved = given.step[acts] @ response.step(since[acts]) + given.error[acts] @ response.gain_error(since[acts])
            error = float(part.value[n] - known.scale * (start + moved))
            left += [error - (sum(before) / max(len(before), 1) if known.bias_sd else 0.0)] if n else []
            before += [error] if part.outcome[n] != pf.Outcome.REJECTED else []
    check(found(est, sensor, axis).command_alone, left, 1e-7)


def test_nothing_to_predict():
    """One measurement predicts nothing, two predict one; neither do rows that are no measurement, nor one a segment."""
    run = moving_run(1)
    sight, camera = run.sensors["camera"], SENSORS["camera"]

    def first(count: int, stamp: float = 0.0) -> pf.Run:
        some = sight.rows(np.arange(count))
        return replace(run, sensors={"camera": replace(some, stamp=some.stamp + round(stamp * 1e9))})

    def skill_of(run: pf.Run, of: pf.FusionConfig) -> Skill | None:
        est = pf.fuse(run, of)
        summary = pf.summarise(est).axes["radial"].sensors["camera"]
        assert summary.skill == skill(est, est.measurements.of("camera", "radial"))
        return summary.skill

    assert skill_of(first(1), config(camera=camera)) is None
    assert skill_of(first(2), config(camera=camera)).predictions == 1
    assert skill_of(first(30), config()) is None  # unknown
    assert skill_of(first(30, -100.0), config(camera=camera)) is None  # before the start
    assert skill_of(one_after_the_other(first(1), replace(first(1, -8.0), name="x")), config(camera=camera)) is None


def test_a_simpler_way_that_predicts_better_is_said() -> None:
    """By a filter that is a quarter of a second late and sure of it; not by one that is right."""
    rng, time = np.random.default_rng(8), np.arange(0.0, 40.0, 0.02)
    command = 0.2 * np.sin(0.8 * time) + 0.05 * np.sin(2.1 * time)
    moved = np.interp(time - 0.31, time, command)
    run = pf.Run.from_arrays(time, {"x": command}, {"rule": (time, {"x": moved + rng.normal(0.0, 1e-4, len(time))})})

    def said(delay: float) -> list[str]:
        plant = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.01))
        arm = pf.ArmModel(name="slow", update_period=0.02, delay=delay, axes={"x": plant})
        sensor = pf.Sensor(sd=1e-4, gate=0.0)
        process = {"x": pf.Process(input_noise=1e-5, drift=1e-4)}
        return beaten_notes(
            pf.summarise(pf.fuse(run, pf.FusionConfig(arm=arm, process=process, sensors={"rule": sensor}))).axes
        )

    assert not said(0.29)
    (sentence,) = said(0.05)
    assert sentence.startswith("x: a constant velocity predicts the next measurement of rule better")
