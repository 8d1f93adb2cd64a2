"""Runs that nothing can be fitted to are refused in one line that gives the reason and the remedy."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

import pumafuse as pf
from changes import Change, delayed, exchanged, of_sensor, scaled
from pumafuse.logs.source import Source
from pumafuse.tuning.parameters import Fit
from tuning_runs import fit_stage, later, outage, quietly, scenario, spoiled


def refused(runs: Sequence[pf.Run], **more: object) -> str:
    """The message of the error."""
    with pytest.raises(pf.PumafuseError) as error:
        quietly(lambda: pf.tune(runs, outage(1).config, **more))
    line = str(error.value)
    assert len(line.splitlines()) == 1 and len(line) < 250
    return line


# ---- too little -----------------------------------------------------------------------------------------------------


def test_no_run_and_no_measurement() -> None:
    """No run, or no measurement: none of a configured sensor, only gaps, all before the first command."""
    run, camera = outage(1).run, outage(1).run.sensors["vision"]
    assert refused([]) == "no run to fit on; give one at least"
    nothing = "no measurement of a configured sensor lies within the runs: are names and clocks the same?"
    gaps = replace(camera, values={axis: np.full(len(value), np.nan) for axis, value in camera.values.items()})
    for sensors in ({}, {"eye": camera}, {"vision": gaps}, {"vision": delayed(-3600.0)(camera)}):
        assert refused([replace(run, sensors=sensors)]) == nothing


def test_a_run_given_twice_and_nothing_free() -> None:
    """Measurements must not count twice; fixing everything leaves nothing to fit."""
    run = outage(1).run
    assert refused([run, run]) == f"run '{run.name}' is given twice: its measurements would count twice; give it once"
    assert (
        refused([run], fit=["delay"], fix=["delay_ms"])
        == "everything that could be fitted is fixed: nothing to fit; fix less"
    )


def test_too_few_measurements() -> None:
    """Fewer than 12 of an axis are refused, counted over all runs."""
    run, camera = outage(1).run, outage(1).run.sensors["vision"]
    few = replace(run, sensors={"vision": camera.rows(slice(0, 11))})
    assert refused([few], validate=run) == "tangential: only 11 measurements; record longer: a fit needs at least 12"
    assert len(fit_stage([few, few], outage(1).config).free) > 0


def test_a_few_measurements_tell_the_lag_and_little_else() -> None:
    """A slow camera of a wide motion: fewer numbers are fitted, and it is said; the lag is right to 15 ms."""
    time = 0.02 * np.arange(280)
    stamp = 0.4 * np.arange(14) + 0.115
    seen = 0.3 * np.sin(np.maximum(stamp - 0.11, 0.0)) + np.random.default_rng(14).normal(0.0, 1e-3, 14)
    run = pf.Run.from_arrays(time, {"x": 0.3 * np.sin(time)}, {"camera": (stamp, {"x": seen})})
    arm = pf.ArmModel(
        name="a", update_period=0.02, delay=0.03, axes={"x": pf.AxisModel(plant=pf.FirstOrder(time_constant=0.03))}
    )
    config = pf.FusionConfig(arm=arm, sensors={"camera": pf.Sensor(sd=1e-3)})
    found = quietly(lambda: pf.tune(run, config, fit=["noise", "delay", "plant", "gain"]))
    assert any(note.startswith("x: only 14 measurements: gain, disturbance") for note in found.details.notes)
    assert found.config.arm.lag_of("x") == pytest.approx(0.1, abs=0.015)
    assert not any("gain" in key or "disturbance" in key for key in found.params)
    assert found.details.validation is None


@pytest.mark.long
def test_few_measurements_for_many_numbers_are_told() -> None:
    """Fewer than 30 for each number that is fitted: with more of the same sensor, or fewer numbers, nothing is said."""
    run, tracker = outage(1).run, outage(1).run.sensors["tracker"]

    def told(rows: int, fit: Sequence[Fit]) -> list[str]:
        part = replace(run, sensors={"tracker": tracker.rows(slice(0, rows))})
        return [one for one in fit_stage([part], outage(1).config, fit).notes if "numbers to fit" in one]

    assert told(60, ["noise"])[0].startswith("tangential: 60 measurements for 5 numbers to fit: with fewer than 30")
    assert told(400, ["noise"]) == told(60, ["delay"]) == []


def test_no_motion() -> None:
    """Commands that stay, or move by less than the noise, are refused with their range."""
    run, rng = outage(1).run, np.random.default_rng(1)
    camera = run.sensors["vision"]
    noise = {axis: 5e-4 * rng.standard_normal(len(value)) for axis, value in camera.values.items()}
    for far in (0.0, 1e-3):
        values = {axis: far / np.ptp(value) * value for axis, value in run.command.values.items()}
        still = replace(run, command=replace(run.command, values=values))
        line = refused([replace(still, sensors={"vision": replace(camera, values=noise)})])
        assert line.startswith("no axis is commanded to move by more than its sensors' noise")
        assert f"(at most {1e3 * far:.3g} mm)" in line
        assert line.endswith("record a run with motion")


def test_of_an_axis_at_rest_only_the_noise_is_fitted() -> None:
    """Beside a moving axis, with a note: no maneuver noise, no delay and no plant; its sds as good as the other's."""
    sim = pf.simulate(scenario("panel-tracker-outage", 0.2, 0.0), 1)
    found = fit_stage(sim.run, spoiled(sim.config), ("noise", "delay"))
    assert list(found.notes) == ["vertical: does not move; only its noise at rest was fitted"]
    keys = {one.key for one in found.free}
    assert {key for key in keys if ".vertical" in key} == {
        "process.vertical.input_noise_mm_rtHz",
        "process.vertical.drift_mm_rts",
        "sensors.tracker.sd_mm.vertical",
        "sensors.vision.sd_mm.vertical",
    }
    assert {"axes.tangential.delay_ms", "process.tangential.maneuver_drift_mm_rts_per_m_s"} <= keys
    best = found.best.config
    assert best.arm.axes["vertical"] == sim.config.arm.axes["vertical"]
    assert best.process["vertical"].maneuver_drift == spoiled(sim.config).process["vertical"].maneuver_drift
    for name, sd in (("tracker", 5e-5), ("vision", 5e-4)):
        assert best.sensors[name].sd_of("vertical") == pytest.approx(sd, rel=0.2)


# ---- sensors that do not follow the commands ------------------------------------------------------------------------

AGAINST = "moves against the commands of tangential, vertical (correlation -1.000): scale = -1 turns it"
FAULTS: dict[str, tuple[str, Change, str]] = {
    "sign": ("vision", scaled(-1.0), AGAINST),
    "cm as m": ("tracker", scaled(100.0), "(correlation +1.000): are its values cm called m"),
    "axes exchanged": ("vision", exchanged("tangential", "vertical"), "follows on tangential the commands of vertical"),
    "frozen": ("vision", scaled(0.0), "rests and does not follow the commands of tangential"),
    "clock 2 s behind": ("vision", delayed(-2.0), "are both stamped by one clock"),
}


@pytest.mark.parametrize(("name", "fault", "line"), FAULTS.values(), ids=FAULTS.keys())
def test_a_sensor_that_does_not_follow_is_refused(name: str, fault: Change, line: str) -> None:
    """Its name and the likely reason are in the message."""
    message = refused([of_sensor(outage(1).run, name, fault)])
    assert message.startswith(f"sensor '{name}' ") and line in message


@pytest.mark.parametrize("seconds", [-10.0, later(3600.0)])
def test_a_sensor_whose_clock_is_far_off_is_named(seconds: float) -> None:
    """All its measurements before the first or after the last command: refused, or a note with the reason."""
    run = of_sensor(outage(1).run, "vision", delayed(seconds))
    try:
        notes = quietly(lambda: pf.tune([run], outage(1).config, fix=["process"])).details.notes
    except pf.PumafuseError as error:
        notes = [str(error)]
    assert any("vision" in note and "command" in note for note in notes), notes


@pytest.mark.long
def test_outliers_do_not_make_a_sensor_fail() -> None:
    """A camera with a tenth of its measurements metres off still follows the commands."""
    rng = np.random.default_rng(2)

    def wild(one: Source) -> Source:
        off = np.where(rng.random(len(one.stamp)) < 0.1, 5.0, 0.0)
        return replace(one, values={axis: value + off for axis, value in one.values.items()})

    found = fit_stage(of_sensor(outage(1).run, "vision", wild), spoiled(outage(1).config))
    assert found.best.config.sensors["vision"].sd_of("vertical") == pytest.approx(5e-4, rel=0.25)


def test_an_axis_that_rests_most_of_the_time_is_followed() -> None:
    """A tracker that shows the simulated arm, which moves by 20 mm once: after 60 to 90 % of the run."""
    count, rng = 400, np.random.default_rng(1)
    command = np.clip(0.004 * (np.arange(count) - 0.9 * count), 0.0, 0.02)
    time = 0.028 * np.arange(count)
    arm = outage(1).config.arm
    bare = pf.FusionConfig(arm=arm)
    position = pf.fuse(pf.Run.from_arrays(time, {"radial": command}), bare, rate=100.0)["radial"].position
    measured = position + 5e-5 * rng.standard_normal(len(position))
    stamp = 0.01 * np.arange(len(measured))
    run = pf.Run.from_arrays(time, {"radial": command}, {"tracker": (stamp, {"radial": measured})})
    best = fit_stage(run, pf.FusionConfig(arm=arm, sensors={"tracker": pf.Sensor(sd=5e-5)})).best.config
    assert best.sensors["tracker"].sd_of("radial") == pytest.approx(5e-5, rel=0.15)
