"""What shows before anything is filtered: another zero, a negative latency, a begin in mid-motion."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pumafuse as pf
from changes import of_sensor
from fusion.test_between import cut
from pumafuse.logs.source import Source
from pumafuse.tuning.likelihood import Likelihood
from tuning_runs import SCENARIOS, outage, scenario, with_process, with_sensors

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
CONFIG = outage(1).config


def notes(run: pf.Run, config: pf.FusionConfig = CONFIG) -> list[str]:
    given = [one for one in pf.fuse(run, config).notes if one.startswith(("sensor '", "sensors."))]
    return [one for one in given if "contradicts" not in one]


def changed(one: Source, change: Callable[[np.ndarray], np.ndarray]) -> Source:
    return replace(one, values={axis: change(value) for axis, value in one.values.items()})


def moved(off: float, one: Source) -> Source:
    return changed(one, lambda value: value + off)


def elsewhere(run: pf.Run, config: pf.FusionConfig = CONFIG) -> list[str]:
    return [one for one in notes(run, config) if "where the commands lead" in one]


def test_another_zero_is_said_where_nothing_told_is_as_uncertain() -> None:
    """50 mm where noise and priors are 2 mm; not 3 mm, not with anything as uncertain as that, not in a good run."""
    assert not notes(outage(1).run) and not notes(of_sensor(outage(1).run, "vision", lambda one: moved(0.003, one)))
    run = of_sensor(outage(1).run, "vision", lambda one: moved(0.05, one))
    assert len(elsewhere(run)) == 1
    for told in (
        with_sensors(CONFIG, "vision", bias_sd=0.05),
        with_sensors(CONFIG, "vision", bias_drift_sd=0.05),
        with_process(CONFIG, disturbance_sd=0.05),
    ):
        assert not elsewhere(run, told)


def test_what_scatters_that_far_has_no_other_zero() -> None:
    """20 mm in 30 mm of scatter, of a sensor that claims 0.5 mm."""
    rng = np.random.default_rng(1)

    def scattered(one: Source) -> Source:
        return changed(one, lambda value: value + rng.normal(0.02, 0.03, len(value)))

    assert not elsewhere(of_sensor(outage(1).run, "vision", scattered))


def test_a_negative_latency_is_questioned() -> None:
    """By its key and value, for a sensor that is in the run."""
    config, run = with_sensors(CONFIG, "vision", latency=-0.02), outage(1).run
    assert [one[:33] for one in notes(run, config)] == ["sensors.vision.latency_ms is -20,"]
    assert not notes(replace(run, sensors={"tracker": run.sensors["tracker"]}), config)[1:]


# ---- a log that begins in mid-motion --------------------------------------------------------------------------------


def begun(run: pf.Run, config: pf.FusionConfig) -> list[str]:
    return [one for one in pf.fuse(run, config).notes if "begins in motion" in one]


@pytest.mark.parametrize("name", ["panel-tracker-outage", "mismatched-arm"])
def test_a_log_that_was_cut_in_mid_motion_says_so(name: str) -> None:
    """With speed and what it is off by; not the whole log, which begins at rest with commands that move at once.

    Nor the same part of the whole log, nor the file from where the note says on.
    """
    sim = pf.simulate(scenario(name, 0.2, 0.02), 1)
    file = cut(sim.run, 0.5)
    assert not begun(sim.run, sim.config) and not begun(sim.run.between(0.5), sim.config)
    (note,) = begun(file, sim.config)
    assert "(60 mm/s on tangential)" in note and "up to 5.5 mm" in note
    since = float(note.split("--from ")[1].split()[0])
    assert 0.2 < since < 0.3 and not begun(file.between(since), sim.config)
    (fitted,) = [one for one in Likelihood([file], sim.config).notes if "begins in motion" in one]
    assert fitted == f"run '{file.name}': {note}"


def test_runs_that_begin_at_rest_are_not_told_to_be_in_motion() -> None:
    """White noise, a step, one that rests elsewhere with one of its axes; and all with a sensor that hardly knows."""
    white = pf.simulate(pf.Scenario.load(SCENARIOS / "white-noise.toml"), 1)
    assert not begun(white.run, white.config)
    steps = pf.simulate(pf.Scenario.load(SCENARIOS / "step-campaign.toml"), 1)
    first = int(np.flatnonzero(np.diff(steps.run.command.values["tangential"]))[0]) * 0.028
    for since in (0.0, first, first + 0.028):
        assert not begun(cut(steps.run, since), steps.config)
    assert not begun(cut(outage(1).run, 0.5), with_sensors(CONFIG, sd=0.02))


def looks_turned(run: pf.Run, config: pf.FusionConfig) -> list[float]:
    """The angles of the sensors that are said to be turned [deg]."""
    found = [one for one in notes(run, config) if "looks turned by" in one]
    assert all("pumafuse register" in one for one in found)
    return [float(one.partition("looks turned by ")[2].partition("°")[0]) for one in found]


def seen_turned(angle: float, axis: str = "y", noise: float = 5e-4) -> pf.Run:
    """A run in x, y, z of an arm that is 90 ms late; its camera stands elsewhere, turned about an axis [deg]."""
    t = 0.02 * np.arange(1000)

    def places(at: np.ndarray) -> np.ndarray:
        return np.array([0.15, 0.1, 0.2]) * (1.0 - np.cos(np.maximum(at, 0.0)[:, None] * np.array([0.9, 1.4, 0.6])))

    turn = Rotation.from_euler(axis, angle, degrees=True)
    seen = turn.apply(places(t - 0.09)) + np.random.default_rng(5).normal(0.0, noise, (1000, 3))
    seen += np.array([1.0, -2.0, 0.5]) * bool(angle)
    told, measured = (dict(zip("xyz", value.T, strict=True)) for value in (places(t), seen))
    return pf.Run.from_arrays(t, told, {"camera": (t, measured)})


def late_arm(delay: float = 0.08) -> pf.FusionConfig:
    """An arm that is 10 ms later than its delay [s], as it holds each command for 20 ms."""
    axis = pf.AxisModel(plant=pf.FirstOrder(time_constant=1e-4))
    arm = pf.ArmModel(name="late", update_period=0.02, delay=delay, axes=dict.fromkeys("xyz", axis))
    return pf.FusionConfig(arm=arm, sensors={"camera": pf.Sensor(sd=5e-4)})


def by_camera(run: pf.Run, **values: np.ndarray) -> pf.Run:
    """The run with other values of some axes of its camera."""
    camera = run.sensors["camera"]
    return replace(run, sensors={"camera": replace(camera, values={**camera.values, **values})})


@pytest.mark.parametrize(("axis", "angle"), [("x", 3.0), ("y", -5.0), ("z", 130.0)])
def test_a_sensor_that_is_turned_is_named_with_its_angle(angle: float, axis: str) -> None:
    """To 0.2 degrees, from 3 degrees on, wherever it stands; and nothing else is said of it."""
    run = seen_turned(angle, axis)
    assert looks_turned(run, late_arm()) == pytest.approx([abs(angle)], abs=0.2)
    assert len(notes(run, late_arm())) == 1


def test_an_arm_with_a_wrong_delay_has_no_turned_sensor() -> None:
    """A model that is 50 ms off is off by the speed, in all directions alike."""
    assert not looks_turned(seen_turned(0.0), late_arm(0.13))


def test_noise_a_gain_and_a_straight_line_are_no_turn() -> None:
    """Much noise; 2 degrees; 0.8 times as far on one axis; one axis that moves, others that tremble."""
    assert not looks_turned(seen_turned(0.0, noise=0.1), late_arm())
    assert not looks_turned(seen_turned(2.0), late_arm())
    run = seen_turned(0.0)
    assert not looks_turned(by_camera(run, x=0.8 * run.sensors["camera"].values["x"]), late_arm())
    draw, still = np.random.default_rng(2), np.zeros(1000)
    line = by_camera(run, **{axis: draw.normal(0.0, 5e-4, 1000) for axis in "xy"})
    line = replace(line, command=replace(line.command, values={**line.command.values, "x": still, "y": still}))
    assert not looks_turned(line, late_arm())
