"""Logs with one mistake each: named before anything is filtered, with the number that shows it; good ones: nothing."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest

import pumafuse as pf
from changes import Change, delayed, exchanged, of_sensor, scaled
from pumafuse.arrays import FloatArray
from pumafuse.filter.response import response
from pumafuse.fusion.consistency import Finding, consistency
from pumafuse.fusion.faults import check_sensors, find_not_following
from pumafuse.fusion.segments import build_segment
from pumafuse.fusion.summary import summarise
from pumafuse.logs.clock import clock_faults
from tuning_runs import scenario, with_sensors

REPOSITORY = Path(__file__).parents[2]
SCENARIOS = sorted((Path(__file__).parents[2] / "scenarios").glob("*.toml"))
pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
DATA = Path(pf.__file__).parent / "data"
LOGS = {
    "scan1": (DATA / "scan1", DATA / "fusion.toml"),
    "my-run": (REPOSITORY / "examples/my-run", REPOSITORY / "examples/my-run/fusion.toml"),
    "trunk-servo": (REPOSITORY / "examples/trunk-servo/0g", REPOSITORY / "examples/trunk-servo/fusion.toml"),
}
SENSORS = [("scan1", "vision"), ("trunk-servo", "camera")]
of_every_log = pytest.mark.parametrize(("log", "sensor"), SENSORS)


@cache
def logged(log: str) -> tuple[pf.Run, pf.FusionConfig]:
    path, config = LOGS[log]
    return pf.Run.read(path), pf.FusionConfig.load(config)


def of_commands(log: str, change: Change) -> pf.Run:
    run, _ = logged(log)
    return replace(run, command=change(run.command))


def clocked(factor: float) -> Change:
    """Stamps in another unit, beginning where they did."""
    return lambda one: replace(one, stamp=one.stamp[0] + np.rint((one.stamp - one.stamp[0]) * factor).astype(np.int64))


def moved_by(far: float | FloatArray, axis: str) -> Change:
    return lambda one: replace(one, values={**one.values, axis: one.values[axis] + far})


def notes(run: pf.Run, log: str) -> list[str]:
    """What ``fuse`` says, the cause first."""
    return list(pf.fuse(run, logged(log)[1]).notes)


def refusal(run: pf.Run, log: str) -> str:
    with pytest.raises(pf.PumafuseError) as error:
        notes(run, log)
    assert "\n" not in str(error.value)
    return str(error.value)


def number_before(words: str, note: str) -> float:
    return float(note.split(words)[0].split()[-1])


# ---- one mistake each -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("log", "sensor", "small"), [("scan1", "vision", True), ("trunk-servo", "camera", False)])
def test_another_unit_is_refused_with_both_names(log: str, sensor: str, small: bool) -> None:
    """Millimetres called metres, or degrees called radians, and the reverse: about 1000 or 57.3 times as far."""
    run, config = logged(log)
    kind = config.arm.axes[run.axes[0]].kind
    factor, units = (1000.0, ("mm", "m")) if kind == "length" else (180.0 / np.pi, ("deg", "rad"))
    true, called = reversed(units) if small else units
    line = refusal(of_sensor(logged(log)[0], sensor, scaled(1.0 / factor if small else factor)), log)
    assert line.startswith(f"sensor '{sensor}' moves ") and f"{true} called {called}" in line and "run.toml" in line
    times = number_before(" times as far", line)
    assert 0.9 < times / (1.0 / factor if small else factor) < 1.1


def test_commands_in_another_unit_are_told_by_all_sensors() -> None:
    """Two sensors of three axes that agree with each other: it is the commands."""
    line = refusal(of_commands("scan1", scaled(1e-3)), "scan1")
    assert line.startswith("sensor 'tracker' moves") and "'vision' too: is it the unit of the commands?" in line


@pytest.mark.parametrize(("factor", "words"), [(7.0, "moves 7 times as far as"), (100.0, "cm called m")])
def test_a_scale_that_no_unit_explains_is_a_warning(factor: float, words: str) -> None:
    """Seven times as far; a hundred times may be cm, or a scale."""
    (first, *_) = notes(of_sensor(logged("my-run")[0], "camera", scaled(factor)), "my-run")
    assert words in first and "scale" in first


@of_every_log
def test_exchanged_columns_are_named_with_both_correlations(log: str, sensor: str) -> None:
    """Each follows the commands of the other, and not its own; no turn makes it so, as two exchanged are a mirror."""
    axes = logged(log)[0].axes
    for first, second in {(axes[0], axes[-1]), tuple(axes[-2:])}:
        (note, *_) = notes(of_sensor(logged(log)[0], sensor, exchanged(first, second)), log)
        assert f"sensor '{sensor}' follows on {first} the commands of {second} (correlation +" in note
        assert f"on {second} the commands of {first}" in note and "are its columns exchanged" in note
        ratio = [float(part.split(")")[0].split()[0].rstrip(",")) for part in note.split("(correlation ")[1:]]
        own = [float(part.split(")")[0].split()[-1]) for part in note.split("with those of ")[1:]]
        assert min(ratio) > 0.95 and max(map(abs, own)) < 0.5


@pytest.mark.parametrize(
    ("change", "shown"),
    [
        (exchanged("radial", "vertical"), "exchanged columns"),
        (scaled(2.5), "another size"),
    ],
)
def test_a_verdict_names_the_fault_and_no_noise(change: Change, shown: str) -> None:
    """What a clock or a unit does to the innovations, no other process noise mends."""
    run = logged("scan1")[0]
    est = pf.fuse(replace(run, sensors={"tracker": change(run.sensors["tracker"])}), logged("scan1")[1])
    (faulty, *_) = [axis for name, axis in est.faults if name == "tracker"]
    of_axis = summarise(est).axes[faulty].sensors["tracker"]
    assert of_axis.finding == "faulty" and of_axis.causes == []
    assert shown in of_axis.verdict and "noise" not in of_axis.verdict


def test_a_fault_that_does_no_harm_is_no_verdict() -> None:
    """A constant of 30 mm is named, and taken up by the offset. What is as expected stays consistent."""
    est = pf.fuse(of_sensor(logged("scan1")[0], "tracker", moved_by(0.03, "radial")), logged("scan1")[1])
    assert any("sensor 'tracker' is off from where the commands lead" in note for note in est.notes) and not est.faults
    for axis in est.axes:
        checked = consistency(est, "tracker", axis)
        assert checked is not None and checked.finding is not Finding.FAULTY
        usual = replace(checked, nis=1.0, correlation=np.zeros(20), rejected=0.0, fault="clock")
        assert usual.finding is Finding.CONSISTENT and replace(usual, nis=9.0).finding is Finding.FAULTY


@of_every_log
def test_a_sign_is_named(log: str, sensor: str) -> None:
    """All axes: a scale of -1 turns it; one axis: its column."""
    run, _ = logged(log)
    (note, *_) = notes(of_sensor(logged(log)[0], sensor, scaled(-1.0)), log)
    assert note.startswith(f"sensor '{sensor}' moves against the commands of {', '.join(run.axes)} (correlation -")
    assert "scale = -1 turns it" in note
    (note, *_) = notes(of_sensor(logged(log)[0], sensor, scaled(-1.0, run.axes[0])), log)
    assert f"moves against the commands of {run.axes[0]} (" in note and "scale" not in note
    assert "sign of a column" in note


@pytest.mark.parametrize(("log", "sensor", "seconds"), [("scan1", "tracker", -0.7), ("trunk-servo", "camera", 3.0)])
def test_another_clock_is_found_in_both_directions(log: str, sensor: str, seconds: float) -> None:
    """With its number, and a latency that makes up for it: with that the note is gone."""
    run = of_sensor(logged(log)[0], sensor, delayed(seconds))
    (note, *_) = notes(run, log)
    assert f"{'late' if seconds > 0 else 'early'}: it follows the commands of " in note
    assert number_before(" s ", note) == pytest.approx(abs(seconds), abs=0.03)
    latency = float(note.split("latency_ms = ")[1].split()[0]) / 1e3
    config = with_sensors(logged(log)[1], sensor, latency=latency)
    assert find_not_following(build_segment(run, config), config) == []


def test_a_clock_that_all_sensors_contradict_is_the_commands() -> None:
    """Commands stamped 0.7 s late: once, with the names of the others."""
    found = [note for note in notes(of_commands("scan1", delayed(0.7)), "scan1") if "early" in note]
    assert len(found) == 1 and "('vision', 'range' too: is it the clock of the commands? Else mend each)" in found[0]


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (-7200.0, "before the first command, their stamps begin 2 hours before those of the commands"),
        (1.79e9, "One may count from 1970, the other from when a computer was switched on"),
        (200.0, "all measurements lie after the last command, their stamps begin 200.1 s after"),
    ],
)
def test_clocks_far_apart_are_told_with_their_distance(seconds: float, words: str) -> None:
    """No overlap at all: hours, a time zone, since 1970 beside since boot."""
    (note, *_) = notes(of_sensor(logged("scan1")[0], "vision", delayed(seconds)), "scan1")
    assert note.startswith("vision: all measurements lie") and words in note and "stamped by one clock?" in note
    assert ("time zone" in note) == (abs(seconds) in (3600.0, 7200.0))


def test_of_a_clock_that_leaves_little_within_the_commands_nothing_else_is_told() -> None:
    """What is left of the run would follow anything, at any shift, with any zero; it contradicts the tracker."""
    said = [
        note for note in notes(of_sensor(logged("scan1")[0], "vision", delayed(-45.0)), "scan1") if "vision" in note
    ]
    assert any(note.startswith("vision: most measurements lie") for note in said)
    assert not [note for note in said if note.startswith("sensor 'vision'") and "contradicts" not in note]


@pytest.mark.parametrize(
    ("log", "factor", "taken"), [("scan1", 1e3, "ms that are called s"), ("trunk-servo", 1e-3, "s that are called ms")]
)
def test_stamps_in_another_unit_are_refused(log: str, factor: float, taken: str) -> None:
    """Of the commands by their interval, of a sensor by how long it lasts, of both by the former."""
    run, config = logged(log)
    line = refusal(of_commands(log, clocked(factor)), log)
    assert "commands come every" in line and f"update_period_ms = {config.arm.update_period * 1e3:g}" in line
    assert taken in line and "run.toml" in line
    sensor = "vision" if log == "scan1" else "camera"
    line = refusal(of_sensor(logged(log)[0], sensor, clocked(factor)), log)
    assert line.startswith(f"{sensor} (") and "measurements go on for" in line and taken in line
    assert "commands come every" in refusal(run.each(lambda _, one: clocked(factor)(one)), log)


@pytest.mark.parametrize(("log", "sensor", "far"), [("scan1", "vision", 0.05), ("trunk-servo", "camera", 0.1)])
def test_a_zero_that_differs_is_told_with_the_key(log: str, sensor: str, far: float) -> None:
    """50 mm and 46 degrees, where priors are 5 mm and 5 degrees."""
    run, config = logged(log)
    axis = run.axes[0]
    kind = config.arm.axes[axis].kind
    far *= 1.0 if kind == "length" else 8.0
    screen = config.arm.screen_of(axis)
    moved = of_sensor(logged(log)[0], sensor, moved_by(far, axis))
    note = next(one for one in notes(moved, log) if "where the commands lead" in one)
    assert number_before(f" {screen.unit} on {axis} (", note) == pytest.approx(far * screen.scale, rel=0.3, abs=2.0)
    assert f"bias_sd_{screen.unit} = {{ {axis} = " in note and f"[start] offset_sd_{screen.unit} = {{" in note
    width = float(note.split(f"bias_sd_{screen.unit} = {{ {axis} = ")[1].split(" }")[0]) / screen.scale
    config = with_sensors(config, sensor, bias_sd={axis: width})
    assert check_sensors(build_segment(moved, config), config) == []


def test_a_zero_that_all_sensors_contradict_is_the_commands() -> None:
    """One sentence, and a prior that lets estimates begin where the sensors see the arm: as right as before."""
    run, config = logged("scan1")
    moved = of_commands("scan1", moved_by(0.05, "radial"))
    found = notes(moved, "scan1")
    assert [one.split(" are ")[0] for one in found if "where the commands lead" in one] == [
        "sensors 'tracker', 'vision'"
    ]
    assert "[start] offset_sd_mm = { radial = 50 }" in found[0] and "bias" not in found[0]
    start = msgspec.structs.replace(config.start, offset_sd={**dict.fromkeys(run.axes, 0.002), "radial": 0.05})
    est = pf.fuse(moved, msgspec.structs.replace(config, start=start))
    assert not [one for one in est.notes if "where the commands lead" in one]
    scores = [pf.summarise(one).axes["radial"].score for one in (est, pf.fuse(run, config))]
    assert scores[0] and scores[1] and scores[0].rmse < 1.3 * scores[1].rmse


def test_a_sensor_that_moves_while_its_commands_rest_is_told() -> None:
    """A wrong column that is constant."""
    log, axis = "trunk-servo", logged("trunk-servo")[0].axes[0]
    (note, *_) = notes(
        of_commands(log, lambda one: replace(one, values={**one.values, axis: 0.0 * one.values[axis]})), log
    )
    assert f" on {axis}, whose commands rest: is it the right column" in note


def test_a_misspelt_sensor_is_named_with_the_other_name() -> None:
    """The run has vison, the configuration vision."""
    run, _ = logged("scan1")
    sensors = {("vison" if name == "vision" else name): one for name, one in run.sensors.items()}
    found = notes(replace(run, sensors=sensors), "scan1")
    assert any("'vision' of the configuration" in note and "'vison'" in note for note in found)
    assert any("1704 rows have no sensor of this name" in note for note in found)


# ---- no false alarm -------------------------------------------------------------------------------------------------


def alarms(run: pf.Run, config: pf.FusionConfig) -> list[str]:
    segment = build_segment(run, config)
    faults = check_sensors(segment, config)
    return [*clock_faults(run, config.arm.update_period, run.sensors), *(fault.sentence for fault in faults)]


@pytest.mark.parametrize("log", LOGS)
def test_a_good_log_gives_no_alarm(log: str) -> None:
    """The shipped scan, the example, a real robot: whole, and any part of them."""
    run, config = logged(log)
    assert notes(run, log) == []
    middle = float(np.ptp(run.command.stamp)) / 2e9
    for part in (run.between(0.0, middle), run.between(middle), run.between(middle, middle + 5.0)):
        assert check_sensors(build_segment(part, config), config) == []


@pytest.mark.long
@pytest.mark.parametrize("name", [path.stem for path in SCENARIOS if "[trajectory]" in path.read_text("utf-8")])
def test_no_scenario_gives_an_alarm(name: str) -> None:
    """As they are shipped."""
    sim = pf.simulate(scenario(name), 1)
    found = pf.fuse(sim.run, sim.config).notes
    assert not [one for one in found if one.startswith("sensor '") and "contradicts" not in one]


COMMANDS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "to and fro": lambda t: 0.1 * np.abs(t / 4.0 % 2.0 - 1.0),
    "sine": lambda t: 0.02 * np.sin(2.0 * np.pi * t / 1.5),
    "mostly rest": lambda t: 0.05 * np.clip(t - 15.0, 0.0, 1.0),
    "stairs": lambda t: 0.01 * np.floor(t / 3.0),
    "rest": lambda t: 0.0 * t,
}
ODD: dict[str, dict[str, float]] = {
    "noise": {"sd": 0.05},
    "noise that is not told": {"sd": 0.01, "told_sd": 1e-4},
    "short": {"seconds": 2.0},
    "gain": {"gain": 0.8},
    "latency that is not told": {"latency": 0.045},
    "slower arm": {"lag": 0.12},
    "scale": {"scale": 0.9},
    "distance": {"scale": -1.0},
    "bias that is told": {"bias": 0.5},
    "drift": {"drift": 2e-3},
    "slow sensor": {"rate": 2.0},
    "outliers": {"outliers": 0.05},
}


@pytest.mark.parametrize("odd", ODD.values(), ids=ODD.keys())
@pytest.mark.parametrize("motion", [COMMANDS["sine"], COMMANDS["mostly rest"]], ids=["sine", "mostly rest"])
def test_what_is_odd_but_no_mistake_gives_no_alarm(
    motion: Callable[[FloatArray], FloatArray], odd: dict[str, float]
) -> None:
    """Noise, gain, lag, latency, a scale or a bias that is configured; one axis moves so, another by stairs."""
    period, plant = 0.028, pf.FirstOrder(time_constant=odd.get("lag", 0.05))
    true = pf.AxisModel(plant=plant, gain=pf.Gain(intercept=odd.get("gain", 1.0)))
    for seed in range(2):
        rng = np.random.default_rng(seed)
        seconds, rate, scale = odd.get("seconds", 30.0), odd.get("rate", 30.0), odd.get("scale", 1.0)
        time, seen = np.arange(0.0, seconds, period), np.arange(0.1, seconds, 1.0 / rate)
        command = {"x": motion(time), "y": COMMANDS["stairs"](time)}
        given, valid = (np.rint(part * 1e9).astype(np.int64) for part in (time, seen - odd.get("latency", 0.0)))
        values: dict[str, FloatArray] = {}
        for axis, u in command.items():
            moved = response(true, period, 0.06, given, u, float(u[0]), valid) + u[0]
            walk = np.cumsum(rng.normal(0.0, odd.get("drift", 1e-4) / np.sqrt(rate), len(seen)))
            wild = (rng.random(len(seen)) < odd.get("outliers", 0.0)) * rng.uniform(-1.0, 1.0, len(seen))
            noise = rng.normal(0.0, odd.get("sd", 1e-4), len(seen))
            values[axis] = scale * (moved + walk) + noise + wild + odd.get("bias", 0.0)
        run = pf.Run.from_arrays(time, command, {"camera": (seen, values)})
        axes = {axis: pf.AxisModel(plant=pf.FirstOrder(time_constant=0.05)) for axis in command}
        arm = pf.ArmModel(name="an arm", update_period=period, delay=0.06, axes=axes)
        sd, bias = odd.get("told_sd", odd.get("sd", 1e-4)), 2.0 * odd.get("bias", 0.0)
        config = pf.FusionConfig(arm=arm, sensors={"camera": pf.Sensor(sd=sd, scale=scale, bias_sd=bias)})
        assert alarms(run, config) == [], seed


def test_commands_that_are_missing_in_motion_are_told() -> None:
    """With their number, to a few that an end of a motion hides; those that change nothing may be left out."""
    run, config = logged("scan1")
    stamps, drawn = run.command.stamp, np.random.default_rng(3).random(len(run.command.stamp))
    steps = np.any([np.diff(value, append=value[-1]) != 0.0 for value in run.command.values.values()], axis=0)
    kept = run.command.rows(np.flatnonzero(drawn > 0.05))
    (note,) = clock_faults(replace(run, command=kept), config.arm.update_period, [])
    told, moving = int(number_before(" of ", note)), int(np.count_nonzero(steps & (drawn <= 0.05)))
    assert 0.9 * moving < told <= np.count_nonzero(drawn <= 0.05)
    assert "are missing while the arm moves" in note
    changed = run.command.rows(np.flatnonzero(np.append(True, steps[:-1])))
    assert len(changed.stamp) < 0.99 * len(stamps)
    assert not clock_faults(replace(run, command=changed), config.arm.update_period, [])


@pytest.mark.parametrize("every", [2, 3])
def test_a_log_without_most_commands_is_told_or_refused(every: int) -> None:
    """Of steady ones, that is: the model would hold each for periods in which the arm went on."""
    config = logged("scan1")[1]
    some = of_commands("scan1", lambda one: one.rows(np.arange(0, len(one.stamp), every)))
    if every == 2:
        assert "2 times the arm's update_period_ms" in " ".join(clock_faults(some, config.arm.update_period, []))
        return
    line = refusal(some, "scan1")
    assert "commands come every" in line and f"{every} times the arm's update_period_ms = 28" in line
    assert line.endswith("Log every command, or correct update_period_ms in arm.toml")
