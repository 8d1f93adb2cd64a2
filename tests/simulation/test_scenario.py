"""``scenario.toml``: what it says reaches the simulation, and what it says wrongly is one line on the screen."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import pytest

import pumafuse as pf
from executable import pumafuse
from pumafuse.simulation.true_arm import TrueAxis

SCENARIOS = Path(__file__).parents[2] / "scenarios"
HEAD = 'name = "test"\n'
ARM = 'arm = "puma560-internal"\n'
HOLD = '[trajectory]\nkind = "hold"\naxes = ["tangential", "radial"]\nduration_s = 0.2\n'
SENSOR = "[sensors.eye]\nrate_hz = 30.0\nsd_mm = 0.5\n"
FRAME = '[frame]\nkind = "cylindrical"\n'
LEVEL = "[start]\nlevel = { radial_mm = 500.0 }\n"
STEPS = '[trajectory]\nkind = "steps"\naxes = ["tangential", "radial"]\nsizes_mm = [2.0]\n'
WHOLE = HEAD + ARM + HOLD + SENSOR
AXES = ("tangential", "radial", "vertical")


def load(folder: Path, text: str) -> pf.Scenario:
    path = folder / "scenario.toml"
    path.write_text(text)
    return pf.Scenario.load(path)


WRONG: dict[str, tuple[str, tuple[str, ...]]] = {
    "unknown key": ("sped = 3\n" + WHOLE, ("'sped'", "did you mean 'seed'?", "trajectory")),
    "unknown key of a sensor": (WHOLE + "rate = 3.0\n", ("sensors.eye.rate", "rate_hz")),
    "unknown key of the filter": (WHOLE + "[filter.start]\noffset = 0.1\n", ("start.offset", "offset_sd_mm")),
    "unknown table of the filter": (
        WHOLE + "[filter.sensor.eye]\nsd_mm = 1.0\n",
        ("'sensor'", "did you mean 'sensors'?"),
    ),
    "negative sd": (WHOLE.replace("0.5", "-0.5"), ("sensors.eye.sd_mm",)),
    "no trajectory": (HEAD + ARM + SENSOR, ("'trajectory' is missing",)),
    "no such arm": (HEAD + 'arm = "arm.tml"\n' + HOLD, ("arm.tml", "puma560-internal, puma560-external")),
    "unknown trajectory": (
        WHOLE.replace('"hold"', '"rastr"'),
        ("trajectory.kind", "'rastr'", "did you mean 'raster'?", "white-noise"),
    ),
    "axis of the trajectory": (WHOLE.replace('"radial"', '"radail"'), ("'radail'", "did you mean 'radial'?")),
    "raster along and across one axis": (
        HEAD
        + ARM
        + '[trajectory]\nkind = "raster"\nalong = "vertical"\nwidth_mm = 9.0\nheight_mm = 9.0\npitch_mm = 3.0\n'
        + "speed_m_s = 0.1\n",
        ("across",),
    ),
    "axis of the start level": (
        WHOLE + "[start]\nlevel = { radail_mm = 1.0 }\n",
        ("'radail'", "did you mean 'radial'?"),
    ),
    "axis of a sensor": (WHOLE + 'axes = ["up"]\n', ("sensors.eye.axes", "'up'", *AXES)),
    "axis without sd": (WHOLE.replace("0.5", "{ radial = 0.5 }"), ("sensors.eye.sd_mm", "tangential")),
    "axis of a sensor's bias": (WHOLE + "bias_mm = { up = 1.0 }\n", ("sensors.eye.bias_mm", "'up'", *AXES)),
    "sd in axes of a sensor in x, y, z": (
        HEAD + ARM + HOLD + SENSOR.replace("0.5", "{ x = 0.5 }") + LEVEL + FRAME,
        ("sensors.eye.sd_mm", "one number"),
    ),
    "sensor of the filter": (WHOLE + "[filter.sensors.ear]\nsd_mm = 1.0\n", ("filter.sensors", "'ear'", "eye")),
    "axis of the filter": (WHOLE + "[filter.process.radail]\ndrift_mm_rts = 1.0\n", ("did you mean 'radial'?",)),
    "damping of a first-order axis": (
        WHOLE + "[true_arm.radial]\ndamping = 0.7\n",
        ("true_arm", "damping", "time_constant_ms"),
    ),
    "gain curve that goes back": (
        WHOLE + "[true_arm]\ngain_curve = { speed_m_s = [0.1, 0.0], gain = [1.0, 1.1] }\n",
        ("gain_curve", "ascend"),
    ),
    "gain curve of two lengths": (
        WHOLE + "[true_arm]\ngain_curve = { speed_m_s = [0.1], gain = [1.0, 1.1] }\n",
        ("gain_curve", "as many entries"),
    ),
    "frame without level": (WHOLE + FRAME, ("start.level.radial_mm",)),
    "outliers from more to less": (WHOLE + "outliers = { share = 0.1, from_mm = 5.0, to_mm = 1.0 }\n", ("to_mm",)),
    "outage that ends before it begins": (WHOLE + "outages_s = [[3.0, 2.0]]\n", ("sensors.eye.outages_s",)),
    "scope that is no sensor": (HEAD + ARM + STEPS + 'scope = "ey"\n' + SENSOR, ("trajectory.scope", "'ey'", "eye")),
    "scope that does not see a stepped axis": (
        HEAD + ARM + STEPS + 'scope = "eye"\n' + SENSOR + 'axes = ["radial"]\n',
        ("scope", "tangential"),
    ),
    "scope in x, y, z": (HEAD + ARM + STEPS + 'scope = "eye"\n' + SENSOR + LEVEL + FRAME, ("scope",)),
    "not TOML": (HEAD + "arm = \n", ("not valid TOML",)),
    "sensor that would overwrite the commands": (
        HEAD + ARM + HOLD + SENSOR.replace("eye", "commands"),
        ("commands",),
    ),
    "sensor outside the folder": (HEAD + ARM + HOLD + SENSOR.replace("eye", '"../eye"'), ("../eye",)),
    "longer than memory": (WHOLE.replace("0.2", "1e8"), ("trajectory", "at most 200000", "commands")),
    "longer than time": (WHOLE.replace("0.2", "1e15"), ("trajectory.duration_s", "nothing can be simulated")),
    "campaign without end": (
        HEAD + ARM + STEPS + 'scope = "eye"\nrest_s = 1e9\n' + SENSOR,
        ("trajectory", "at most 200000"),
    ),
    "window longer than the rest": (
        HEAD + ARM + STEPS + 'scope = "eye"\nrest_s = 0.3\nwindow_s = 0.31\n' + SENSOR,
        ("window_s", "rest_s"),
    ),
    "sensor faster than the grid": (
        WHOLE.replace("30.0", "2143.0"),
        ("sensors.eye.rate_hz", "at most 2142.86", "2143"),
    ),
    "more rows of the reference than the grid has": (
        WHOLE + "[reference]\nrows_per_command = 61\n",
        ("reference.rows_per_command", "60"),
    ),
    "path without a file": (
        WHOLE.replace('"hold"', '"path"').replace("duration_s = 0.2", 'file = "none.csv"'),
        ("none.csv", "no such file"),
    ),
    "a million replicates": (
        HEAD + ARM + STEPS + 'scope = "eye"\nreplicates = 1000000\n' + SENSOR,
        ("trajectory.replicates", "10000"),
    ),
    "a raster of a billion lines": (
        HEAD
        + ARM
        + '[trajectory]\nkind = "raster"\nwidth_mm = 100.0\nheight_mm = 1e6\npitch_mm = 1e-3\nspeed_m_s = 0.1\n'
        + SENSOR,
        ("trajectory", "at most 200000"),
    ),
    "noise of a galaxy": (WHOLE + "[process]\ninput_noise_mm_rtHz = 1e160\n", ("process.input_noise_mm_rtHz", "size")),
    "level twice": (WHOLE + LEVEL.replace("500.0", "500.0, radial_m = 0.1"), ("start.level", "twice")),
    "damping that is missing": (
        WHOLE + "[true_arm.radial]\nplant = 'second-order'\nnatural_frequency_rad_s = 40.0\n",
        ("true_arm.radial, a second-order plant", "'damping' is missing"),
    ),
}


def check(message: str, path: Path, expected: tuple[str, ...]) -> None:
    assert len(message.splitlines()) == 1, message
    assert path.name in message
    for words in expected:
        assert words in message


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_scenario_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    """File, key and the accepted names."""
    text, expected = WRONG[case]
    with pytest.raises((pf.ConfigError, pf.UnknownNameError)) as refused:
        load(tmp_path, text)
    check(str(refused.value), tmp_path / "scenario.toml", expected)


def test_the_executable_refuses_a_wrong_scenario_and_writes_nothing(tmp_path: Path) -> None:
    """The same line, exit code 1, no traceback, and no folder is left behind."""
    text, expected = WRONG["longer than memory"]
    path = tmp_path / "scenario.toml"
    path.write_text(text)
    done = pumafuse("simulate", path, "-o", tmp_path / "out", code=1)
    assert done.stdout == "" and done.stderr.startswith("pumafuse: ")
    check(done.stderr, path, expected)
    assert [entry.name for entry in tmp_path.iterdir()] == ["scenario.toml"]


def test_limits_are_themselves_allowed(tmp_path: Path) -> None:
    """60 rows a period of a sensor and of the reference, a window as long as the rest, the sd of the moving axes."""
    for text in (WHOLE, WHOLE + LEVEL + FRAME, HEAD + ARM + STEPS + 'scope = "eye"\n' + SENSOR):
        assert load(tmp_path, text).name == "test"  # what the wrong ones are made of is right
    whole = WHOLE.replace("30.0", "2142.857142857142") + "[reference]\nrows_per_command = 60\n"
    assert load(tmp_path, whole).reference.rows_per_command == 60
    steps = HEAD + ARM + STEPS + 'scope = "eye"\nrest_s = 0.3\nwindow_s = 0.3\n'
    steps += SENSOR + 'axes = ["tangential", "radial"]\n' + LEVEL + FRAME
    assert load(tmp_path, steps).sensors["eye"].axes == ["tangential", "radial"]
    own_sd = load(tmp_path, WHOLE.replace("0.5", "{ radial = 0.5, tangential = 0.4 }"))
    assert own_sd.config.sensors["eye"].sd_of("radial") == 5e-4


def test_every_scenario_of_the_repository_loads_and_says_what_it_teaches() -> None:
    """Without a simulation."""
    found = [pf.Scenario.load(path) for path in SCENARIOS.glob("*.toml") if "[trajectory]" in path.read_text()]
    assert len(found) >= 8
    assert all(scenario.teaches for scenario in found)
    assert len({scenario.name for scenario in found}) == len(found)


def test_the_true_arm_is_the_model_by_default(tmp_path: Path) -> None:
    """Plant, gain, recovery and delay of each axis."""
    scenario = load(tmp_path, WHOLE)
    for name, model in scenario.arm.axes.items():
        true = scenario.true_axes[name]
        assert (true.plant, true.gain, true.gain_recovery) == (model.plant, model.gain, model.gain_recovery)
        assert true.delay == scenario.arm.delay_of(name)
        assert (true.delay_jitter, true.backlash, true.stiction, true.slow_drift) == (0.0, 0.0, 0.0, 0.0)
        assert true.extra_pole is None and true.gain_curve is None


def test_the_true_arm_differs_on_all_axes_or_on_one(tmp_path: Path) -> None:
    """`[true_arm]` holds for all, `[true_arm.radial]` overrides it; files are in mm and ms, numbers in m and s."""
    text = (
        WHOLE
        + '[true_arm]\ndelay_ms = 66.0\ngain_recovery_ms = "never"\nbacklash_mm = 0.1\n'
        + "[true_arm.radial]\ntime_constant_ms = 50.0\ndelay_ms = 70.0\ngain_recovery_ms = 140.0\n"
        + "[true_arm.tangential]\nnatural_frequency_rad_s = 46.0\nextra_pole_ms = 6.0\n"
        + '[true_arm.vertical]\nplant = "second-order"\nnatural_frequency_rad_s = 40.0\ndamping = 0.5\n'
    )
    scenario = load(tmp_path, text)
    true: dict[str, TrueAxis] = scenario.true_axes
    assert [true[axis].delay for axis in AXES] == [0.066, 0.070, 0.066]
    assert [true[axis].gain_recovery for axis in AXES] == [None, 0.140, None]
    assert [true[axis].backlash for axis in AXES] == [1e-4] * 3
    assert [true[axis].extra_pole for axis in AXES] == [0.006, None, None]
    model = scenario.arm.axes["tangential"].plant
    assert isinstance(model, pf.SecondOrder)
    assert true["tangential"].plant == pf.SecondOrder(natural_frequency=46.0, damping=model.damping)
    assert true["radial"].plant == pf.FirstOrder(time_constant=0.050)
    assert true["vertical"].plant == pf.SecondOrder(natural_frequency=40.0, damping=0.5)
    assert scenario.arm == pf.ArmModel.load("puma560-internal")  # the filter's model stays


FULL = """
[start]
offset_sd_mm = 2.0
[process]
input_noise_mm_rtHz = 0.02
drift_mm_rts = 0.2
[process.radial]
drift_mm_rts = 0.5
[sensors.eye]
rate_hz = 30.0
sd_mm = { tangential = 0.3, radial = 0.4 }
latency_ms = 45.0
latency_sd_ms = 2.0
scale = -1.0
bias_mm = { radial = 4.0 }
bias_sd_mm = 3.0
quantisation_mm = 0.6
[sensors.ear]
rate_hz = 10.0
sd_mm = 0.1
"""


def test_the_filter_is_configured_as_is_simulated(tmp_path: Path) -> None:
    """Every figure of the scenario, with what quantisation adds to the noise and all that is unknown of a bias."""
    config = load(tmp_path, HEAD + ARM + HOLD + FULL).config
    assert config.arm == pf.ArmModel.load("puma560-internal")
    assert config.start == pf.Start(offset_sd=2e-3)
    common = {"input_noise": 2e-5, "maneuver_noise": 0.0, "maneuver_drift": 0.0}
    for axis, drift in (("tangential", 2e-4), ("radial", 5e-4), ("vertical", 2e-4)):
        assert config.process[axis] == pf.Process(drift=drift, **common)
    eye, step = config.sensors["eye"], 6e-4 / math.sqrt(12.0)
    assert eye.sd_of("tangential") == pytest.approx(math.hypot(3e-4, step), rel=1e-12)
    assert eye.sd_of("radial") == pytest.approx(math.hypot(4e-4, step), rel=1e-12)
    assert (eye.latency, eye.latency_sd, eye.scale) == (0.045, 0.002, -1.0)
    assert eye.bias_sd == pytest.approx(5e-3, rel=1e-12)
    assert config.sensors["ear"] == pf.Sensor(sd=1e-4)
    assert list(config.sensors) == ["eye", "ear"]


@pytest.mark.parametrize(
    ("override", "path", "value"),
    [
        ("[filter.sensors.eye]\nlatency_ms = 20.0\n", ("sensors", "eye", "latency_ms"), 0.020),
        ("[filter.sensors.ear]\nsd_mm = 0.7\n", ("sensors", "ear", "sd_mm"), 7e-4),
        ("[filter.sensors.eye]\ngate = 0.0\n", ("sensors", "eye", "gate"), 0.0),
        ("[filter.start]\noffset_sd_mm = 9.0\n", ("start", "offset_sd_mm"), 9e-3),
        ("[filter.process.radial]\ndrift_mm_rts = 3.0\n", ("process", "radial", "drift_mm_rts"), 3e-3),
    ],
)
def test_a_filter_table_changes_only_what_it_names(
    override: str, path: tuple[str, ...], value: float, tmp_path: Path
) -> None:
    """One key changes, every other stays as it is simulated; and what is simulated does not change."""
    plain, changed = (load(tmp_path, HEAD + ARM + HOLD + FULL + more) for more in ("", override))
    was, now = (msgspec.to_builtins(scenario.config, builtin_types=()) for scenario in (plain, changed))
    place: Any = was
    for key in path[:-1]:
        place = place[key]
    assert place[path[-1]] != value
    place[path[-1]] = value
    assert now == was
    assert (changed.sensors, changed.process, changed.start) == (plain.sensors, plain.process, plain.start)


def test_a_process_table_of_the_filter_holds_for_every_axis(tmp_path: Path) -> None:
    """`[filter.process]` holds for all axes, but what it does not name stays each axis's own."""
    override = "[filter.process]\ninput_noise_mm_rtHz = 0.9\n"
    config = load(tmp_path, HEAD + ARM + HOLD + FULL + override).config
    assert {config.process[axis].input_noise for axis in AXES} == {9e-4}
    assert [config.process[axis].drift for axis in AXES] == [2e-4, 5e-4, 2e-4]


def test_a_path_with_a_hole_is_refused(tmp_path: Path) -> None:
    """Named with the scenario, when that is loaded."""
    (tmp_path / "path.csv").write_text("time_s,radial_mm\n0,0\n1,5\n2,50,9\n3,5\n")
    path = '[trajectory]\nkind = "path"\nfile = "path.csv"\naxes = ["radial"]\n'
    with pytest.raises(pf.ConfigError, match=r"scenario\.toml: .*1 line left out"):
        load(tmp_path, HEAD + ARM + path + SENSOR)


@pytest.mark.parametrize("axis", ["file", "start"])
def test_an_axis_that_run_toml_could_not_tell_is_refused(axis: str, tmp_path: Path) -> None:
    """Before anything is simulated."""
    arm = f'name = "a"\nupdate_period_ms = 28.0\ndelay_ms = 60.0\n[axes.{axis}]\nplant = "first-order"\n'
    (tmp_path / "arm.toml").write_text(arm + "time_constant_ms = 40.0\n")
    hold = f'[trajectory]\nkind = "hold"\naxes = ["{axis}"]\nduration_s = 1.0\n'
    with pytest.raises(pf.ConfigError, match=f"axis '{axis}': run.toml uses this word itself"):
        load(tmp_path, HEAD + 'arm = "arm.toml"\n' + hold + SENSOR)


def test_what_cannot_be_followed_is_refused_when_it_is_simulated(tmp_path: Path) -> None:
    """Commands across the base's axis, where cylindrical coordinates fold; a lag of nothing, which needs all memory."""
    sweep = '[trajectory]\nkind = "sine-sweep"\naxes = ["radial"]\namplitude_mm = 600.0\nfrom_hz = 0.1\nto_hz = 0.2\n'
    crossing = load(tmp_path, HEAD + ARM + sweep + "duration_s = 20.0\n" + SENSOR + LEVEL + FRAME)
    with pytest.raises(pf.ConfigError, match="cross the base's axis"):
        pf.simulate(crossing)
    stiff = load(tmp_path, WHOLE + "[true_arm]\nextra_pole_ms = 1e-8\n")
    with pytest.raises(pf.ConfigError, match=r"too short to follow over 0 s: at least [0-9.e-]+ ms"):
        pf.simulate(stiff)
