"""A bias that is not configured is found and estimated; where there is none, none is found."""

from dataclasses import replace

import pytest

import pumafuse as pf
from tuning_runs import fit_stage, outage, quietly, replaced, scenario, spoiled, with_sensors

AXES = ("tangential", "vertical")
Off = float | dict[str, float]


def recorded(off: Off, seed: int = 1, sensor: str = "vision", height: float = 0.02) -> tuple[pf.Run, pf.FusionConfig]:
    """Tracker and camera, one of them off by a constant [m] that is not configured."""
    found = scenario("panel-tracker-outage", 0.1, height)
    sensors = {**found.sensors, sensor: replaced(found.sensors[sensor], bias=off)}
    sim = pf.simulate(replaced(found, sensors=sensors), seed)
    return sim.run, with_sensors(sim.config, bias_sd=0.0)


def widths(config: pf.FusionConfig) -> dict[str, float]:
    return {name: sensor.bias_sd for name, sensor in config.sensors.items()}


def found_biases(run: pf.Run, config: pf.FusionConfig) -> dict[tuple[str, str], tuple[float, float]]:
    """Value and sd [m] of each bias, by sensor and axis."""
    biases = quietly(lambda: pf.fuse(run, config)).biases
    return {(name, axis): (one.value, one.sd) for name, of in biases.items() for axis, one in of.items()}


@pytest.mark.long
@pytest.mark.parametrize(("off", "seed"), [({"tangential": 3e-4, "vertical": -3e-4}, 1), (3e-4, 2), (-0.6, 3)], ids=str)
def test_a_constant_on_the_worse_sensor_is_found(off: Off, seed: int) -> None:
    """0.3 mm, less than its noise, or 600 mm: on each axis within 3 sd, which is below 0.1 mm; the other has none.

    The prior is wide enough, there is a note, and the noise is fitted as without a constant,
    where there is no bias and no note.
    """
    run, config = recorded(off, seed)
    found = fit_stage(run, spoiled(config))
    best = found.best.config
    (note,) = found.notes
    assert note.startswith("sensor 'vision' is off by a constant")
    true = off if isinstance(off, dict) else dict.fromkeys(AXES, off)
    biases = found_biases(run, best)
    assert biases.keys() == {("vision", axis) for axis in AXES}
    for (_, axis), (value, sd) in biases.items():
        assert value == pytest.approx(true[axis], abs=3.0 * sd)
        assert 2e-5 < sd < 1e-4
    largest = max(map(abs, true.values()))
    assert largest < widths(best)["vision"] <= max(10.0 * largest, 0.01)
    assert widths(best)["tracker"] == 0.0
    without = fit_stage(recorded(0.0, seed)[0], spoiled(config))
    assert not without.notes and not any(widths(without.best.config).values())
    for axis in AXES:
        wanted = without.best.config.sensors["vision"].sd_of(axis)
        assert best.sensors["vision"].sd_of(axis) == pytest.approx(wanted, rel=0.03)


def test_of_two_sensors_the_less_accurate_gets_the_bias() -> None:
    """Also where it is the accurate one that is off: the other's bias has the opposite sign."""
    run, config = recorded(3e-4, sensor="tracker")
    best = fit_stage(run, config).best.config
    assert widths(best)["tracker"] == 0.0 < widths(best)["vision"]
    for (name, _), (value, sd) in found_biases(run, best).items():
        assert name == "vision" and value == pytest.approx(-3e-4, abs=3.0 * sd)


@pytest.mark.long
def test_hardly_any_false_bias_is_found_in_60_runs() -> None:
    """A gain of 3 in log-likelihood for a prior 1 mm wide: at most 1 of 60 lines without a constant have one."""
    false = 0
    for seed in range(60):
        run, config = recorded(0.0, seed, height=0.0)
        false += fit_stage(run, spoiled(config)).best.config.sensors["vision"].bias_sd > 0.0
    assert false <= 1


def test_a_fixed_sensor_gets_no_bias() -> None:
    """The result has none and no note on one."""
    run, config = recorded(0.6)
    found = fit_stage(run, config, ("noise",), "sensors.vision")
    assert widths(found.best.config) == {"tracker": 0.0, "vision": 0.0}
    assert not [note for note in found.notes if "bias" in note]


def test_a_lone_sensor_gets_no_bias() -> None:
    """A constant of 1 mm in the only camera is the arm's offset."""
    found = scenario("panel-vision", 0.1, 0.02)
    camera = replaced(found.sensors["vision"], bias=1e-3)
    sim = pf.simulate(replaced(found, sensors={"vision": camera}), 1)
    config = replaced(with_sensors(sim.config, bias_sd=0.0), start=pf.Start(offset_sd=5e-3))
    assert fit_stage(sim.run, config).best.config.sensors["vision"].bias_sd == 0.0


def test_each_run_has_its_own_constant() -> None:
    """Two runs with 0.3 and 0.8 mm: one width for both, in each its own value in the summary, and a note."""
    (one, config), (two, _) = recorded(3e-4, 1), recorded(8e-4, 2)
    two = replace(two, name="another run")
    summary = quietly(lambda: pf.tune([one, two], config, fix=["process"])).details
    biases = summary.biases
    assert [note for note in summary.notes if note.startswith("sensor 'vision' is off by a constant")]
    assert {(each.run, each.sensor, each.axis) for each in biases} == {
        (run.name, "vision", axis) for run in (one, two) for axis in AXES
    }
    for each in biases:
        assert each.bias_mm == pytest.approx(0.3 if each.run == one.name else 0.8, abs=3.0 * each.sd_mm)


def test_a_drift_that_the_only_sensor_cannot_tell_is_none() -> None:
    """It is set back to what is configured, and said."""
    sim = outage(1)
    config = replaced(sim.config, sensors={"vision": sim.config.sensors["vision"]})
    found = fit_stage(sim.run, config, ("noise", "bias"))
    said = [str(one) for one in found.not_identifiable if "bias" in one.fixed]
    assert said == ["sensors.vision.bias_drift_sd_mm is fixed: not identifiable"]
    assert found.best.config.sensors["vision"].bias_drift_sd == 0.0
    assert not [one.key for one in found.free if one.fit == "bias"]
