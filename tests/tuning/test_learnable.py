"""What nothing can be learnt from is refused in one line that says why and what to do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.logs.run import Source
from tuning_runs import LONG, later, learnt, outage, quietly, scenario, spoiled


def changed(name: str, change: Callable[[Source], Source]) -> pf.Run:
    """A run of tracker and camera with one of them changed."""
    run = outage(1).run
    return replace(run, sensors={**run.sensors, name: change(run.sensors[name])})


def refused(runs: Sequence[pf.Run], config: pf.FusionConfig | None = None, **more: object) -> str:
    """The one line."""
    with pytest.raises(pf.PumafuseError) as said:
        quietly(lambda: pf.tune(runs, outage(1).config if config is None else config, **more))
    line = str(said.value)
    assert len(line.splitlines()) == 1 and len(line) < 250
    return line


def scaled(factor: float) -> Callable[[Source], Source]:
    return lambda one: replace(one, values={axis: factor * value for axis, value in one.values.items()})


def delayed(seconds: float) -> Callable[[Source], Source]:
    return lambda one: replace(one, stamp=one.stamp + round(seconds * 1e9))


# ---- too little -----------------------------------------------------------------------------------------------------


def test_no_run_and_no_measurement() -> None:
    """None at all, none of a configured sensor, none but gaps, none after the first command."""
    run, camera = outage(1).run, outage(1).run.sensors["vision"]
    assert refused([]) == "no run to learn from"
    nothing = "no measurement of a configured sensor lies within the runs: nothing to learn from"
    gaps = replace(camera, values={axis: np.full(len(value), np.nan) for axis, value in camera.values.items()})
    early = replace(camera, stamp=camera.stamp - 3_600_000_000_000)
    for sensors in ({}, {"eye": camera}, {"vision": gaps}, {"vision": early}):
        assert refused([replace(run, sensors=sensors)]) == nothing


def test_a_run_given_twice() -> None:
    """Its measurements would count twice."""
    run = outage(1).run
    assert refused([run, run]) == f"run '{run.name}' is given twice: its measurements would count twice"


def test_nothing_that_may_move() -> None:
    """Everything that is asked for is held."""
    assert refused([outage(1).run], fit=["delay"], hold=["delay_ms"]).startswith(
        "everything that could be fitted is held"
    )


def test_too_few_measurements() -> None:
    """Fewer than 30 of an axis, counted over all runs; with so many it goes on."""
    run, camera = outage(1).run, outage(1).run.sensors["vision"]
    few = replace(run, sensors={"vision": camera.rows(slice(0, 29))})
    assert refused([few], validate=run) == "tangential: only 29 measurements; to learn from, at least 30 are needed"
    assert len(learnt(replace(run, sensors={"vision": camera.rows(slice(0, 30))}), outage(1).config).free) > 0
    assert len(learnt([few, few], outage(1).config).free) > 0


def test_no_motion() -> None:
    """Commands that stay, or move by less than the noise; how far they do is said."""
    run, rng = outage(1).run, np.random.default_rng(1)
    camera = run.sensors["vision"]
    noise = {axis: 5e-4 * rng.standard_normal(len(value)) for axis, value in camera.values.items()}
    for far in (0.0, 1e-3):
        told = {axis: far / np.ptp(value) * value for axis, value in run.command.values.items()}
        command = replace(run.command, values=told)
        still = replace(run, command=command, sensors={"vision": replace(camera, values=noise)})
        line = refused([still])
        assert line.startswith("no axis is commanded to move by more than its sensors' noise")
        assert f"(at most {1e3 * far:.3g} mm)" in line
        assert line.endswith("record a run with motion")


def test_an_axis_that_rests_has_its_noise_at_rest_learnt() -> None:
    """Beside one that moves, with a note: no maneuver noise, no delay and no plant; its sds as good as the other's."""
    sim = pf.simulate(scenario("panel-tracker-outage", 0.2, 0.0), 1)
    found = learnt(sim.run, spoiled(sim.config), ("noise", "delay"))
    assert list(found.notes) == ["vertical: does not move; only its noise at rest was learnt"]
    keys = {one.key for one in found.free if ".vertical" in one.key}
    assert keys == {
        "process.vertical.input_noise_mm_rtHz",
        "process.vertical.drift_mm_rts",
        "sensors.tracker.sd_mm.vertical",
        "sensors.vision.sd_mm.vertical",
    }
    assert {"axes.tangential.delay_ms", "process.tangential.maneuver_drift_mm_rts_per_m_s"} <= {
        one.key for one in found.free
    }
    best = found.best.config
    assert best.arm.axes["vertical"] == sim.config.arm.axes["vertical"]
    assert best.process["vertical"].maneuver_drift == spoiled(sim.config).process["vertical"].maneuver_drift
    for name, sd in (("tracker", 5e-5), ("vision", 5e-4)):
        assert best.sensors[name].sd_of("vertical") == pytest.approx(sd, rel=0.2)


# ---- what does not go where the arm goes ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["tracker", "vision"])
def test_a_sensor_with_the_wrong_sign(name: str) -> None:
    """It moves against the commands, and −1 is what a scale may be."""
    line = refused([changed(name, scaled(-1.0))])
    assert line.startswith(f"sensor '{name}' moves against the commands of tangential (correlation -1.00): ")
    assert "is its scale right (-1 for a distance that falls)" in line


@pytest.mark.parametrize(("factor", "said"), [(1e-3, "0.001"), (100.0, "100")])
def test_a_sensor_in_another_unit(factor: float, said: str) -> None:
    """Metres under a name in mm: it goes the right way, but not as far; nothing learnt from that would hold."""
    line = refused([changed("tracker", scaled(factor))])
    assert line.startswith(f"sensor 'tracker' moves {said} times as far as the commands of tangential")
    assert line.endswith("is a unit wrong?")


def test_a_sensor_with_a_scale_that_is_told_is_not_refused() -> None:
    """The same measurements with the scale in the configuration, a large constant in them too."""
    run = changed("vision", lambda one: replace(one, values={a: 0.7 - v for a, v in one.values.items()}))
    config = outage(1).config
    camera = pf.Sensor(sd=5e-4, latency=0.045, scale=-1.0, bias_sd=1.0)
    found = learnt(run, pf.FusionConfig(arm=config.arm, sensors={**config.sensors, "vision": camera}))
    sd = found.best.config.sensors["vision"].sd_of("tangential")
    assert sd == pytest.approx(5e-4, rel=0.2)


@pytest.mark.parametrize("seconds", [-2.0, -1.0, 1.0, pytest.param(2.0, marks=LONG)])
def test_a_sensor_stamped_by_another_clock(seconds: float) -> None:
    """Seconds early or late, it does not follow, or moves against, the commands; one clock is asked for."""
    line = refused([changed("vision", delayed(seconds))])
    assert line.startswith(("sensor 'vision' does not follow the", "sensor 'vision' moves against the"))
    assert line.endswith("are both stamped by one clock?")


def test_a_sensor_of_another_axis() -> None:
    """Its axes exchanged: one of them is named."""

    def exchanged(one: Source) -> Source:
        tangential, vertical = one.values.values()
        return replace(one, values={"tangential": vertical, "vertical": tangential})

    line = refused([changed("vision", exchanged)])
    assert "sensor 'vision' does not follow the commands of" in line and "is it that axis" in line


def test_a_sensor_that_shows_one_value_only() -> None:
    """It froze before the first command."""
    assert "sensor 'vision' does not follow the commands of tangential" in refused([changed("vision", scaled(0.0))])


@pytest.mark.parametrize("seconds", [-10.0, 10.0, pytest.param(3600.0, marks=LONG)])
def test_a_sensor_whose_clock_is_far_off_is_said_to_be(seconds: float) -> None:
    """All its measurements before the first or after the last command: refused, or a note that names it and why."""
    run = changed("vision", delayed(seconds))
    try:
        found = quietly(lambda: pf.tune([run], outage(1).config, hold=["process"]))
    except pf.PumafuseError as error:
        said = [str(error)]
    else:
        said = found.summary.notes
    about = [note for note in said if "vision" in note]
    assert any("command" in note for note in about), said


def test_outliers_do_not_make_a_sensor_disagree() -> None:
    """A camera with a tenth of its measurements metres off still follows the commands."""
    rng = np.random.default_rng(2)

    def wild(one: Source) -> Source:
        off = np.where(rng.random(len(one.stamp)) < 0.1, 5.0, 0.0)
        return replace(one, values={axis: value + off for axis, value in one.values.items()})

    found = learnt(changed("vision", wild), spoiled(outage(1).config))
    assert found.best.config.sensors["vision"].sd_of("vertical") == pytest.approx(5e-4, rel=0.25)


@pytest.mark.parametrize("share", [0.6, 0.75, 0.9])
def test_an_axis_that_rests_most_of_the_time_is_followed(share: float) -> None:
    """A tracker that shows exactly what the arm does, which moves by 20 mm once: after 60 to 90 % of the run."""
    count, rng = 400, np.random.default_rng(1)
    command = np.clip(0.004 * (np.arange(count) - share * count), 0.0, 0.02)
    time = 0.028 * np.arange(count)
    arm = outage(1).config.arm
    config = pf.FusionConfig(arm=arm, sensors={"tracker": pf.Sensor(sd=5e-5)})
    bare = pf.FusionConfig(arm=arm)
    position = pf.fuse(pf.Run.from_arrays(time, {"radial": command}), bare, rate=100.0)["radial"].position
    seen = position + 5e-5 * rng.standard_normal(len(position))
    stamp = 0.01 * np.arange(len(seen))
    run = pf.Run.from_arrays(time, {"radial": command}, {"tracker": (stamp, {"radial": seen})})
    assert learnt(run, config).best.config.sensors["tracker"].sd_of("radial") == pytest.approx(5e-5, rel=0.15)


@pytest.mark.parametrize(
    "fit", [("noise",), later(("noise", "latency")), later(("noise", "delay", "plant"))], ids="-".join
)
def test_an_axis_that_nobody_hears_is_left_as_it_is(fit: Sequence[str]) -> None:
    """Commanded, but read by no sensor: what belongs to it stays, the others are learnt as without it."""
    run, config = outage(1).run, spoiled(outage(1).config)
    deaf = {name: replace(one, values={"tangential": one.values["tangential"]}) for name, one in run.sensors.items()}
    found = quietly(lambda: pf.tune([replace(run, sensors=deaf)], config, fit=fit))
    assert not [one.key for one in found.summary.parameters if "vertical" in one.key]
    assert found.config.process["vertical"] == config.process["vertical"]
    assert found.config.arm.axes["vertical"] == config.arm.axes["vertical"]
    command = replace(run.command, values={"tangential": run.command.values["tangential"]})
    alone = replace(run, command=command, sensors=deaf, reference=None, start={"tangential": run.start["tangential"]})
    other = quietly(lambda: pf.tune([alone], config, fit=fit))
    for one, same in zip(found.summary.parameters, other.summary.parameters, strict=True):
        assert one.key == same.key
        assert one.value == pytest.approx(same.value, rel=1e-4, abs=1e-9)
