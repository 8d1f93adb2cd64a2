"""Scenarios of axes that are angles, and of both kinds."""

import math
from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.simulation.simulate import write

ARM = """
name = "wrist"
update_period_ms = 10.0
delay_ms = 20.0
[axes.x]
plant = "first-order"
time_constant_ms = 40.0
[axes.yaw]
kind = "angle"
plant = "first-order"
time_constant_ms = 30.0
"""
SCENARIO = """
name = "turning"
arm = "arm.toml"
[trajectory]
kind = "sine-sweep"
axes = ["yaw"]
amplitude_deg = 20.0
from_hz = 0.2
to_hz = 1.0
duration_s = 12.0
[start]
offset_sd_mm = 0.1
offset_sd_deg = 0.5
level = { yaw_deg = 30.0 }
[true_arm.yaw]
backlash_deg = 0.05
[process]
input_noise_mm_rtHz = 0.1
input_noise_deg_rtHz = 0.2
drift_deg_rts = 0.1
[reference]
sd_deg = 0.001
[sensors.eye]
rate_hz = 50.0
sd_mm = 0.2
sd_deg = 0.3
bias_deg = { yaw = 1.0 }
quantisation_deg = 0.01
[sensors.eye.outliers]
share = 0.02
from_deg = 10.0
to_deg = 20.0
from_mm = 3.0
to_mm = 5.0
"""
DEG = math.pi / 180.0


def load(folder: Path, text: str = SCENARIO) -> pf.Scenario:
    (folder / "arm.toml").write_text(ARM)
    (folder / "scenario.toml").write_text(text)
    return pf.Scenario.load(folder / "scenario.toml")


def test_a_scenario_of_both_kinds_is_what_it_says(tmp_path: Path) -> None:
    """Commands, noise, bias and outliers have their sizes in degrees, and the written run is the same run."""
    scenario = load(tmp_path)
    made = pf.simulate(scenario)
    command = made.run.command.values["yaw"] / DEG
    assert command[0] == pytest.approx(30.0) and np.ptp(command) == pytest.approx(40.0, rel=0.02)
    seen, true = made.run.sensors["eye"], made.run.reference
    off = (seen.values["yaw"] - np.interp(seen.stamp, true.stamp, true.values["yaw"])) / DEG
    assert np.median(off) == pytest.approx(1.0, abs=0.1)
    far = np.abs(off - 1.0) > 5.0
    assert 0.005 < far.mean() < 0.05 and np.abs(off[far] - 1.0).max() < 21.0
    assert np.std(off[~far]) == pytest.approx(0.3, rel=0.15)
    assert made.config.sensors["eye"].sd == {
        "yaw": pytest.approx(math.hypot(0.3, 0.01 / math.sqrt(12.0)) * DEG),
        "x": 0.2e-3,
    }
    assert made.config.process["yaw"].drift == pytest.approx(0.1 * DEG)
    assert made.config.process["yaw"].input_noise == pytest.approx(0.2 * DEG)
    write(made, tmp_path / "out", force=False)
    again, run = pf.Scenario.load(tmp_path / "out" / "scenario.toml"), pf.Run.read(tmp_path / "out")
    assert again == pf.Scenario.load(tmp_path / "out" / "scenario.toml")
    for axis, values in pf.simulate(again).run.command.values.items():
        np.testing.assert_array_equal(values, run.command.values[axis])
    np.testing.assert_array_equal(run.sensors["eye"].values["yaw"], seen.values["yaw"])
    assert run.kinds["yaw"] == "angle"


WRONG = {
    "amplitude of a length": (
        ("amplitude_deg", "amplitude_mm"),
        "trajectory.amplitude_mm: for an angle it is 'amplitude_deg'",
    ),
    "lengths and angles at once": (('axes = ["yaw"]', 'axes = ["yaw", "x"]'), "moves lengths and angles"),
    "level of a length": (("yaw_deg = 30.0", "yaw_mm = 30.0"), "start.level.yaw_mm: yaw is an angle"),
    "backlash of a length": (("backlash_deg", "backlash_mm"), "true_arm.yaw.backlash_mm.*backlash_deg"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_size_of_the_other_kind_is_refused(case: str, tmp_path: Path) -> None:
    (old, new), message = WRONG[case]
    assert old in SCENARIO
    with pytest.raises(pf.ConfigError, match=message) as caught:
        load(tmp_path, SCENARIO.replace(old, new))
    assert len(str(caught.value).splitlines()) == 1
