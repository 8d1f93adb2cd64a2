"""A constant that nobody told of is found and estimated; one that is not there is not invented."""

from __future__ import annotations

import pytest

import pumafuse as pf
from pumafuse.tuning.biases import far_off, slightly_off
from pumafuse.tuning.climb import point
from pumafuse.tuning.likelihood import Evidence
from tuning_runs import later, learnt, quietly, replaced, scenario, spoiled, with_sensors

AXES = ("tangential", "vertical")
Off = float | dict[str, float]


def recorded(off: Off, seed: int = 1, sensor: str = "vision", height: float = 0.02) -> tuple[pf.Run, pf.FusionConfig]:
    """Tracker and camera, one of them off by a constant [m] that the configuration knows nothing of."""
    found = scenario("panel-tracker-outage", 0.1, height)
    sensors = {**found.sensors, sensor: replaced(found.sensors[sensor], bias=off)}
    sim = pf.simulate(replaced(found, sensors=sensors), seed)
    return sim.run, with_sensors(sim.config, bias_sd=0.0)


def widths(config: pf.FusionConfig) -> dict[str, float]:
    return {name: sensor.bias_sd for name, sensor in config.sensors.items()}


def told(run: pf.Run, config: pf.FusionConfig) -> dict[tuple[str, str], tuple[float, float]]:
    """What the measurements say of each bias, value and sd [m], by sensor and axis."""
    biases = quietly(lambda: pf.fuse(run, config)).biases
    return {(name, axis): (one.value, one.sd) for name, of in biases.items() for axis, one in of.items()}


@pytest.mark.parametrize("seed", [1, later(2), later(3)])
@pytest.mark.parametrize("off", [3e-4, {"tangential": 3e-4, "vertical": -3e-4}, 0.6, -0.6], ids=str)
def test_a_constant_on_the_worse_sensor_is_found(off: Off, seed: int) -> None:
    """0.3 mm, less than its noise, or 600 mm: told on each axis within 3 sd, which is below 0.1 mm; the other has none.

    The prior is wide enough, a note says so, and the noise is learnt as if there were no constant.
    """
    run, config = recorded(off, seed)
    found = learnt(run, spoiled(config))
    best = found.best.config
    (note,) = found.notes
    assert note.startswith("sensor 'vision' is off by a constant")
    true = off if isinstance(off, dict) else dict.fromkeys(AXES, off)
    biases = told(run, best)
    assert biases.keys() == {("vision", axis) for axis in AXES}
    for (_, axis), (value, sd) in biases.items():
        assert value == pytest.approx(true[axis], abs=3.0 * sd)
        assert 2e-5 < sd < 1e-4
    largest = max(map(abs, true.values()))
    assert largest < widths(best)["vision"] <= max(10.0 * largest, 0.01)
    assert widths(best)["tracker"] == 0.0
    without = learnt(recorded(0.0, seed)[0], spoiled(config)).best.config
    for axis in AXES:
        assert best.sensors["vision"].sd_of(axis) == pytest.approx(without.sensors["vision"].sd_of(axis), rel=0.03)


def test_the_summary_has_what_is_found() -> None:
    """Each bias by run, sensor and axis, as the measurements have it with the result; the note is a warning."""
    run, config = recorded(3e-4)
    with pytest.warns(pf.PumafuseWarning, match="sensor 'vision' is off by a constant") as warned:
        found = pf.tune([run], spoiled(config), hold=["process"])
    assert len(warned) == 1
    biases = told(run, found.config)
    assert {(one.sensor, one.axis): (one.bias_mm, one.sd_mm) for one in found.summary.biases} == {
        key: (1e3 * value, 1e3 * sd) for key, (value, sd) in biases.items()
    }
    assert {one.run for one in found.summary.biases} == {run.name} and len(biases) == 2


def test_of_two_sensors_the_worse_is_blamed() -> None:
    """Also where it is the better one that is off: what contradicts it is taken for off, the other way."""
    run, config = recorded(3e-4, sensor="tracker")
    best = learnt(run, config).best.config
    assert widths(best)["tracker"] == 0.0 < widths(best)["vision"]
    for (name, _), (value, sd) in told(run, best).items():
        assert name == "vision" and value == pytest.approx(-3e-4, abs=3.0 * sd)


@pytest.mark.parametrize("first", ["tracker", "vision"])
def test_of_two_equals_the_first_in_the_file_is_believed(first: str) -> None:
    """Not one by chance, which another start of Python would decide otherwise."""
    run, config = recorded(2e-3)
    equal = with_sensors(config, sd=5e-4)
    order = sorted(equal.sensors, key=lambda name: name != first)
    config = replaced(equal, sensors={name: equal.sensors[name] for name in order})
    evidence = Evidence([run], config)
    found, _ = slightly_off(evidence, point(evidence, config, []), [])
    assert {name for name, width in widths(found).items() if width > 0.0} == {order[1]}


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_none_is_invented(seed: int) -> None:
    """Without one there is no note and no bias in the result."""
    run, config = recorded(0.0, seed)
    found = learnt(run, spoiled(config))
    assert widths(found.best.config) == {"tracker": 0.0, "vision": 0.0}
    assert list(found.notes) == []


@pytest.mark.long
def test_hardly_any_is_invented_in_100_runs() -> None:
    """A gain of 3 in log-likelihood for a prior 1 mm wide: at most 3 of 100 lines without a constant have one."""
    invented = 0
    for seed in range(100):
        run, config = recorded(0.0, seed, height=0.0)
        invented += learnt(run, spoiled(config)).best.config.sensors["vision"].bias_sd > 0.0
    assert invented <= 3


@pytest.mark.parametrize("hold", ["bias_sd_mm", "vision.bias_sd_mm", "sensors.vision"])
@pytest.mark.parametrize("off", [3e-4, 0.6])
def test_what_is_held_gets_no_bias(hold: str, off: float) -> None:
    """The result has none and says nothing of one."""
    run, config = recorded(off)
    found = learnt(run, config, ("noise",), hold)
    assert widths(found.best.config) == {"tracker": 0.0, "vision": 0.0}
    assert not [note for note in found.notes if "bias" in note]


def test_a_bias_that_is_configured_stays_as_it_is() -> None:
    """Its width too, however wide."""
    run, config = recorded(3e-4)
    config = with_sensors(config, "vision", bias_sd=0.123)
    assert widths(learnt(run, config).best.config) == {"tracker": 0.0, "vision": 0.123}


def test_only_a_fit_of_noise_looks_for_constants() -> None:
    """Without it the sensors stay as they are."""
    run, config = recorded(3e-4)
    assert learnt(run, config, ("delay",)).best.config.sensors == config.sensors


def test_the_prior_of_a_far_one_is_three_times_the_gap_in_one_digit() -> None:
    """Rounded up, of the axis that is farthest off; a sensor within what is uncertain is left alone."""
    for off, width in ((0.6, 2.0), ({"tangential": 0.31, "vertical": 0.06}, 1.0), (0.09, 0.3), (1e-3, 0.0)):
        run, config = recorded(off)
        evidence = Evidence([run], config)
        found, notes = far_off(evidence, config, [])
        assert widths(found) == pytest.approx({"tracker": 0.0, "vision": width})
        assert len(notes) == (width > 0.0)


def test_a_slight_one_is_worth_its_gain() -> None:
    """The gain that is said is what the likelihood has gained, and the width is the best of 1, 10 and 100 mm."""
    run, config = recorded(3e-4)
    evidence = Evidence([run], config)
    best = point(evidence, config, [])
    found, (note,) = slightly_off(evidence, best, [])
    gains = {
        width: evidence.value(with_sensors(config, "vision", bias_sd=width)).total - best.value.total
        for width in (1e-3, 1e-2, 1e-1)
    }
    width = found.sensors["vision"].bias_sd
    assert width == pytest.approx(max(gains, key=lambda tried: gains[tried]))
    assert f"(bias_sd_mm = {1e3 * width:g}) gains {max(gains.values()):.1f} in log-likelihood" in note


def test_a_lone_sensor_has_nothing_to_be_off_from() -> None:
    """A constant of 1 mm in the only camera is the arm's offset."""
    found = scenario("panel-vision", 0.1, 0.02)
    camera = replaced(found.sensors["vision"], bias=1e-3)
    sim = pf.simulate(replaced(found, sensors={"vision": camera}), 1)
    config = replaced(with_sensors(sim.config, bias_sd=0.0), start=pf.Start(offset_sd=5e-3))
    assert learnt(sim.run, config).best.config.sensors["vision"].bias_sd == 0.0


def test_each_run_has_its_own_constant() -> None:
    """Two runs with 0.3 and 0.8 mm: one width for both, each told its own."""
    (one, config), (two, _) = recorded(3e-4, 1), recorded(8e-4, 2)
    best = learnt([one, two], config).best.config
    for run, true in ((one, 3e-4), (two, 8e-4)):
        assert all(value == pytest.approx(true, abs=3.0 * sd) for value, sd in told(run, best).values())
        assert len(told(run, best)) == 2
