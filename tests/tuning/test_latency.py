"""How late is it? Lags, latencies, drifts and gains that were simulated are found, and what cannot be told is said."""

import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from numpy.typing import NDArray
from scipy.signal import lfilter

import pumafuse as pf
from pumafuse.discovery.guesses import guess
from pumafuse.discovery.roles import relations
from pumafuse.discovery.survey import Survey
from pumafuse.tuning import latency as module
from pumafuse.tuning.arms import Arm, NoiseModel
from pumafuse.tuning.latency import Latency
from pumafuse.tuning.likelihood import Likelihood
from tuning_runs import quietly

EXAMPLES = Path(__file__).parents[2] / "examples"
Array = NDArray[np.float64]
STEP, PERIOD, LENGTH = 2e-4, 0.02, 20.0  # s
DELAY, TAU, GAIN, LATENCY = 0.083, 0.041, 0.93, 0.037


def path(kind: str) -> tuple[Array, Array]:
    """Commands of one axis [s], [m]: a smooth motion, or steps."""
    time = np.arange(0.0, LENGTH, PERIOD)
    if kind == "steps":
        level = np.random.default_rng(3).uniform(-0.05, 0.05, 40)
        return time, level[(time / 0.7).astype(np.int64)]
    return time, 0.05 * np.minimum(time, 1.0) * np.sin(2.0 * np.pi * (0.2 + 0.05 * time) * time)


def moved(time: Array, command: Array, at: Array) -> Array:
    """A first-order arm with a gain that stays, on a grid: delayed commands, each for its share of a step."""
    change, acting = np.diff(command, prepend=command[0]), (time + DELAY) / STEP
    jump, cell = np.zeros(int(LENGTH / STEP) + 4000), acting.astype(np.int64)
    np.add.at(jump, cell, change * (1.0 - acting + cell))
    np.add.at(jump, cell + 1, change * (acting - cell))
    left = math.exp(-STEP / TAU)
    position = lfilter([0.0, 1.0 - left], [1.0, -left], GAIN * np.cumsum(jump))
    return command[0] + np.interp(at, STEP * np.arange(len(position)), position)


def recorded(kind: str = "smooth", *, drift: float = 0.0, camera: bool = False, scale: float = 1.0) -> pf.Run:
    """A tracker at 50 Hz, 0.1 mm; its lag grows by ``drift`` [s]; and a camera at 20 Hz that is late."""
    rng, (time, command) = np.random.default_rng(5), path(kind)
    stamp = np.arange(0.3, LENGTH - 0.3, 0.02) + rng.uniform(0.0, 0.001, 970)
    late = drift * (stamp / LENGTH - 0.5)
    sensors = {
        "tracker": (stamp, {"x": scale * moved(time, command, stamp - late) + rng.normal(0.0, 1e-4, len(stamp))})
    }
    if camera:
        seen = np.arange(0.5, LENGTH - 0.5, 0.05)
        sensors["camera"] = (seen, {"x": moved(time, command, seen - LATENCY) + rng.normal(0.0, 3e-4, len(seen))})
    return pf.Run.from_arrays(time, {"x": command}, sensors, name=kind)


@pytest.fixture(scope="module")
def found() -> Latency:
    """The smooth motion, with a camera."""
    return pf.latency(recorded(camera=True), sensor="tracker")


def holds(interval: tuple[float, float] | None, truth: float) -> bool:
    return interval is not None and interval[0] <= truth <= interval[1]


def test_lag_gain_and_plant_are_those_simulated(found: Latency) -> None:
    """Each interval holds the truth; the lag is Td + τ, to a millisecond."""
    axis = found.details.axes["x"]
    assert axis.lag == pytest.approx(DELAY + TAU, abs=1e-3)
    assert holds(axis.lag_ci95, DELAY + TAU)
    assert holds(axis.delay_ci95, DELAY)
    assert holds(axis.gain_ci95, GAIN)
    assert axis.gain_recovery is None
    assert axis.plant == "first-order"
    assert holds(axis.time_constant_ci95, TAU)


def test_a_second_sensor_s_latency_is_found(found: Latency) -> None:
    """The camera is 37 ms late, beside the tracker, whose stamps are right."""
    camera = found.details.sensors["camera"]
    assert camera.latency == pytest.approx(LATENCY, abs=2e-3)
    assert holds(camera.latency_ci95, LATENCY)
    assert found.config.sensors["camera"].latency == pytest.approx(camera.latency, rel=1e-4)


def test_steps_jitter_and_scale_of_another_sensor_are_said() -> None:
    """The camera moves 0.9 times as far and is 37, then 97 ms late; a second one's stamps scatter by 15 ms."""
    run, rng = recorded(camera=True), np.random.default_rng(8)
    time, command = path("smooth")
    camera = run.sensors["camera"]
    later = replace(camera, stamp=camera.stamp + np.where(np.arange(len(camera.stamp)) < 190, 0, 60_000_000))
    later = replace(later, values={"x": 0.9 * camera.values["x"]})
    valid = np.arange(0.5, LENGTH - 0.5, 0.02)
    seen = moved(time, command, valid) + rng.normal(0.0, 3e-4, len(valid))
    stamp = camera.stamp[0] + np.rint(1e9 * (valid - valid[0] + rng.normal(0.0, 0.015, len(valid)))).astype(np.int64)
    eye = replace(camera, stamp=stamp, values={"x": seen})
    run = replace(run, sensors={**run.sensors, "camera": later, "eye": eye})
    config = module.first_guess([guess(Survey(Path("log"), run, relations(run)))])
    config, sensors, notes = module._sensors([run], config, "tracker", {})
    (step,) = sensors["camera"].steps
    assert (step.before, step.after) == pytest.approx((LATENCY, LATENCY + 0.06), abs=3e-3)
    assert step.time == pytest.approx(10.0, abs=1.0)
    assert config.sensors["camera"].scale == pytest.approx(0.9, abs=5e-3)
    assert config.sensors["eye"].latency_sd == pytest.approx(0.015, rel=0.2)
    assert any("the latency of camera steps from 37 to 97 ms" in note for note in notes), notes
    assert any("the latency of eye scatters by 1" in note for note in notes), notes
    assert any(note.startswith("camera moves 0.9") for note in notes), notes


def test_the_arm_is_ready_for_use(found: Latency) -> None:
    """Written and read again it is the same, with intervals; the configuration fuses the run."""
    arm = found.arm
    assert arm.lag_of("x") == pytest.approx(found.details.axes["x"].lag, abs=1e-6)
    assert arm.provenance == {"identified_on": ["smooth"], "sensor": "tracker"}
    plant = arm.axes["x"].plant
    assert isinstance(plant, pf.FirstOrder)
    assert plant.time_constant_ci95 == found.details.axes["x"].time_constant_ci95
    assert arm.axes["x"].lag_ci95 == found.details.axes["x"].lag_ci95
    est = pf.fuse(found.runs[0], found.config)
    assert np.isfinite(est["x"].position).all()


def test_a_drift_of_the_lag_is_named() -> None:
    """20 ms over the run of steps: later, and by several ms; plant and noise explain some of it (docs/symptoms.md)."""
    axis = pf.latency(recorded("steps", drift=0.02)).details.axes["x"]
    assert axis.drifts
    assert 0.005 < axis.drift < 0.03


def test_shifts_of_parts_are_those_of_a_dense_regression() -> None:
    """Least squares on the columns ∂z/∂lag of each part, whitened by the joint covariance of all measurements."""
    run = recorded()
    arm = pf.ArmModel(
        name="arm",
        update_period=PERIOD,
        delay=DELAY + 0.004,
        axes={"x": pf.AxisModel(plant=pf.FirstOrder(time_constant=TAU), gain=pf.Gain(intercept=GAIN))},
    )
    process, sensor = pf.Process(input_noise=0.0, drift=2e-4), pf.Sensor(sd=1e-4, gate=0.0)
    config = pf.FusionConfig(
        arm=arm, start=pf.Start(offset_sd=1e-3), process={"x": process}, sensors={"tracker": sensor}
    )
    recorded_axis = Likelihood([run], config).measured("x", config)
    true, noise = Arm.of(arm.axes["x"], arm.delay), NoiseModel(np.array([1e-4]), walk=process.drift)
    _, shift, information = recorded_axis.shifts(true, [], noise, 5) or (None, None, None)
    assert shift is not None and information is not None
    stamp, z = run.sensors["tracker"].stamp / 1e9, run.sensors["tracker"].values["x"]
    time, command = path("smooth")

    def response(late: float) -> Array:
        return moved(time, command, stamp - 0.004 - late) - command[0]

    slope = (response(1e-3) - response(-1e-3)) / 2e-3
    cov = 1.0 + process.drift**2 * np.minimum(stamp[:, None], stamp) + 1e-8 * np.eye(len(stamp))
    place = np.minimum(((stamp - stamp[0]) / (stamp[-1] - stamp[0]) * 5).astype(np.int64), 4)
    X = np.where(place[:, None] == np.arange(5), slope[:, None], 0.0)
    weighted = np.linalg.solve(cov, X)
    expected = np.linalg.solve(X.T @ weighted, weighted.T @ (z - command[0] - response(0.0)))
    assert information == pytest.approx(X.T @ weighted, rel=2e-2, abs=1e-3 * float(information.max()))
    assert shift == pytest.approx(expected, abs=1e-4)
    assert shift == pytest.approx(-0.004, abs=1e-3)


@pytest.mark.long
@pytest.mark.parametrize(("ahead", "said"), [(0.012, "12 ms ahead of the commands"), (-0.003, "interpolation_ms = 2 ")])
def test_an_arm_that_is_sooner_than_one_can_be_is_reported(ahead: float, said: str) -> None:
    """Where it follows the path before its points are logged, or between them; no dead time is below 0 all the same."""
    time, command = path("smooth")
    rng, stamp = np.random.default_rng(5), np.arange(0.3, LENGTH - 0.3, 0.02)
    position = np.interp(stamp + ahead, time, command) + rng.normal(0.0, 1e-4, len(stamp))
    run = pf.Run.from_arrays(time, {"x": command}, {"tracker": (stamp, {"x": position})})
    with pytest.warns(pf.PumafuseWarning, match=said):
        late = pf.latency(run)
    one = late.details.axes["x"]
    assert 0.0 <= one.delay_ci95[0] <= one.delay <= one.delay_ci95[1]


@pytest.mark.long
def test_an_encoder_that_rests_most_of_the_time_is_not_taken_for_exact() -> None:
    """At rest all its values are one: its noise is that of its steps, and the arm is found in the motions between."""
    step = 1e-4
    time, stamp = np.arange(0.0, LENGTH, PERIOD), np.arange(0.3, LENGTH - 0.3, 0.02) + 0.003
    begins, far = (3.0, 9.0, 15.0), (0.05, 0.03, -0.04)
    moves = [1.0 - np.cos(2.0 * np.pi * np.clip((time - begin) / 1.5, 0.0, 1.0)) for begin in begins]
    command = 0.5 * np.array(far) @ np.array(moves)
    position = step * np.rint(moved(time, command, stamp) / step)
    run = pf.Run.from_arrays(time, {"x": command}, {"encoder": (stamp, {"x": position})})
    found = pf.latency(run)
    rough = structs.replace(found.config, sensors={"encoder": pf.Sensor(sd={"x": step}, gate=0.0)})
    tuned = quietly(lambda: pf.tune(run, rough, fit=["noise", "delay", "plant"]))  # an sd is at its bound
    for config in (found.config, tuned.config):
        assert config.arm.lag_of("x") == pytest.approx(DELAY + TAU, abs=2e-3)
        assert config.sensors["encoder"].sd_of("x") == pytest.approx(step / math.sqrt(12.0), rel=0.5)
    (noise,) = [one for one in tuned.details.parameters if one.key == "sensors.encoder.sd_mm.x"]
    assert noise.notes == "that of the steps in which its values come"


def test_a_mirrored_sensor_is_followed() -> None:
    """A distance that falls while the axis moves on: the same lag."""
    found = pf.latency(recorded("steps", scale=-1.0))
    assert found.config.sensors["tracker"].scale == -1.0
    assert holds(found.details.axes["x"].lag_ci95, DELAY + TAU)


@pytest.mark.long
def test_a_reference_is_trusted_where_there_is_one() -> None:
    """By default its stamps are right; another sensor can be asked for, an unknown one is refused by name."""
    run = recorded()
    known = replace(run, reference=run.sensors["tracker"], sensors={})
    assert pf.latency(known).details.sensor == "reference"
    with pytest.raises(pf.UnknownNameError, match="laser"):
        pf.latency(run, sensor="laser")


def test_what_tells_nothing_is_refused() -> None:
    """An arm at rest; no sensor; a sensor in another unit; a sensor that moves before its commands."""
    run = recorded()
    rest = replace(run.command, values={"x": 1e-7 * run.command.values["x"]})
    with pytest.raises(pf.PumafuseError):
        pf.latency(replace(run, command=rest))
    with pytest.raises(pf.TuneError, match="no sensor"):
        pf.latency(replace(run, sensors={}))
    metres = replace(run.sensors["tracker"], values={"x": 1e3 * run.sensors["tracker"].values["x"]})
    with pytest.raises(pf.PumafuseError, match="times as far as the commands"):
        pf.latency(replace(run, sensors={"tracker": metres}))
    early = replace(run.sensors["tracker"], stamp=run.sensors["tracker"].stamp - 400_000_000)
    with pytest.raises(pf.TuneError, match=r"is 0\.27 s early"):
        pf.latency(replace(run, sensors={"tracker": early}))


@pytest.mark.long
def test_no_interval_ends_at_its_estimate() -> None:
    """Half a minute of a soft arm: models that are about as likely lag by milliseconds more than the chosen one."""
    run = replace(pf.Run.read(EXAMPLES / "trunk-servo" / "0g"), until=30.0)
    axes = quietly(lambda: pf.latency(run)).details.axes
    assert len(axes) == 6
    for name, one in axes.items():
        low, high = one.lag_ci95
        assert low < one.lag < high, name
        assert one.lag - low > 1e-4 and high - one.lag > 1e-4, name  # s


@pytest.mark.long
def test_no_digit_depends_on_how_a_process_hashes() -> None:
    """Python orders a set of names anew in each process: the result of two axes is the same to the last digit."""
    code = f"import pumafuse as pf; print(pf.latency(pf.Run.read({str(EXAMPLES / 'my-run')!r})).to_json())"
    found = [
        subprocess.run(
            [sys.executable, "-W", "ignore", "-c", code],
            env={**os.environ, "PYTHONHASHSEED": str(seed)},
            capture_output=True,
            check=True,
        ).stdout
        for seed in (1, 2)
    ]
    assert found[0] == found[1]
