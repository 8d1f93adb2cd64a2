"""``scenario.toml``: what it says reaches the simulation, and what it says wrongly is one line on the screen."""

import math
from pathlib import Path
from typing import Any

import msgspec
import pytest

import pumafuse as pf
from pumafuse.simulation.true_arm import TrueAxis
from refusals import one_line

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


RASTER = '[trajectory]\nkind = "raster"\nwidth_mm = 100.0\nheight_mm = 1e6\npitch_mm = 1e-3\nspeed_m_s = 0.1\n'
SCOPE = HEAD + ARM + STEPS + 'scope = "eye"\n'
WRONG: dict[str, tuple[str, ...]] = {
    WHOLE + "[filter.start]\noffset = 0.1\n": ("start.offset", "offset_sd_mm"),
    WHOLE + "[filter.sensor.eye]\nsd_mm = 1.0\n": ("'sensor'", "did you mean 'sensors'?"),
    WHOLE + "[filter.sensors.ear]\nsd_mm = 1.0\n": ("filter.sensors", "'ear'", "eye"),
    WHOLE.replace("0.5", "-0.5"): ("sensors.eye.sd_mm",),
    WHOLE.replace('"hold"', '"rastr"'): ("trajectory.kind", "'rastr'", "did you mean 'raster'?", "white-noise"),
    HEAD + ARM + RASTER + 'along = "vertical"\n': ("across",),
    HEAD + ARM + RASTER + SENSOR: ("trajectory", "at most 200000"),
    WHOLE + LEVEL.replace("500.0", "500.0, radial_m = 0.1"): ("start.level", "twice"),
    WHOLE + "bias_mm = { up = 1.0 }\n": ("sensors.eye.bias_mm", "'up'", *AXES),
    HEAD + ARM + HOLD + SENSOR.replace("0.5", "{ x = 0.5 }") + LEVEL + FRAME: ("sensors.eye.sd_mm", "one number"),
    WHOLE + FRAME: ("start.level.radial_mm",),
    WHOLE + "outliers = { share = 0.1, from_mm = 5.0, to_mm = 1.0 }\n": ("sensors.eye.outliers", "to_mm"),
    WHOLE.replace("30.0", "2143.0"): ("sensors.eye.rate_hz", "at most 2142.86", "2143"),
    WHOLE + "[reference]\nrows_per_command = 61\n": ("reference.rows_per_command", "60"),
    WHOLE.replace("eye", '"../eye"'): ("../eye",),
    WHOLE + "[true_arm.radial]\ndamping = 0.7\n": ("true_arm", "damping", "time_constant_ms"),
    WHOLE + "[true_arm]\ngain_curve = { speed_m_s = [0.1, 0.0], gain = [1.0, 1.1] }\n": ("gain_curve", "ascend"),
    WHOLE + "[process]\ninput_noise_mm_rtHz = 1e160\n": ("process.input_noise_mm_rtHz", "size"),
    WHOLE.replace("0.2", "1e8"): ("trajectory", "at most 200000", "commands"),
    SCOPE + SENSOR + 'axes = ["radial"]\n': ("scope", "tangential"),
    SCOPE + SENSOR + LEVEL + FRAME: ("scope",),
    SCOPE + "rest_s = 0.3\nwindow_s = 0.31\n" + SENSOR: ("window_s", "rest_s"),
    WHOLE.replace('"hold"', '"path"').replace("duration_s = 0.2", 'file = "none.csv"'): ("none.csv", "no such file"),
}


@pytest.mark.parametrize("text", WRONG, ids=lambda text: text[-24:])
def test_a_wrong_scenario_is_refused_in_one_line(text: str, tmp_path: Path) -> None:
    message = one_line(pf.PumafuseError, lambda: load(tmp_path, text))
    assert "scenario.toml" in message and all(words in message for words in WRONG[text]), message


@pytest.mark.parametrize("right", [WHOLE, WHOLE + LEVEL + FRAME, SCOPE + "rest_s = 0.3\nwindow_s = 0.3\n" + SENSOR])
def test_what_the_wrong_ones_are_made_of_is_right(right: str, tmp_path: Path) -> None:
    assert load(tmp_path, right).name == "test"


def test_every_scenario_of_the_repository_loads_and_says_what_it_teaches() -> None:
    """Without a simulation."""
    found = [pf.Scenario.load(path) for path in SCENARIOS.glob("*.toml") if "[trajectory]" in path.read_text()]
    assert len(found) >= 8
    assert all(scenario.teaches for scenario in found)
    assert len({scenario.name for scenario in found}) == len(found)


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
