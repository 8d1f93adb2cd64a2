"""Commands and encoders in joints, as the pose of the tool."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.csv as pacsv
import pytest

import pumafuse as pf
from pumafuse.logs.axes import in_axes

RECORDED = Path(__file__).parents[1] / "space" / "commands.csv"  # joints and the poses that they are, of a PUMA 560
URDF = Path(__file__).parents[2] / "examples" / "pose-virtual" / "puma560.urdf"
ROBOT = '[robot]\nurdf = "arm.urdf"\nbase = "base_link"\ntip = "tool0"\n'
JOINTS = "joints = { " + ", ".join(f'j{one} = "j{one}_deg"' for one in range(1, 7)) + " }\n"
HEAD = '[command]\nfile = "log.csv"\ntime = { rate_hz = 36 }\n'


def read(folder: Path, text: str) -> pf.Run:
    shutil.copy(RECORDED, folder / "log.csv")
    shutil.copy(URDF, folder / "arm.urdf")
    (folder / "run.toml").write_text(text)
    return pf.Run.read(folder)


def test_commands_in_joints_are_those_in_space(tmp_path: Path) -> None:
    """The chain of the URDF leads to the pose that the controller wrote beside its joints."""
    table = pacsv.read_csv(RECORDED)
    run, _ = in_axes(read(tmp_path, ROBOT + HEAD + JOINTS), None)
    for axis in "xyz":
        np.testing.assert_allclose(run.command.values[axis], table[f"{axis}_mm"].to_numpy() / 1e3, atol=2e-7)
    pose = HEAD + 'x = "x_mm"\ny = "y_mm"\nz = "z_mm"\norientation = { quaternion = ["qx", "qy", "qz", "qw"] }\n'
    (tmp_path / "pose").mkdir()
    told, _ = in_axes(read(tmp_path / "pose", pose), None)
    for axis in ("rx", "ry", "rz"):
        np.testing.assert_allclose(run.command.values[axis], told.command.values[axis], atol=1e-6)


BAD = {
    "no robot": (HEAD + JOINTS, r"command is in joints: give \[robot\]"),
    "a joint without a column": (ROBOT + HEAD + 'joints = { j1 = "j1_deg" }\n', "no column for joint 'j2'"),
    "a length": (ROBOT + HEAD + JOINTS.replace('"j3_deg"', '"x_mm"'), "column 'x_mm' is no angle"),
    "axes beside joints": (ROBOT + HEAD + JOINTS + 'x = "x_mm"\n', "x is given, too"),
    "no such link": (ROBOT.replace("tool0", "hand") + HEAD + JOINTS, "hand"),
    "no such file": (ROBOT.replace("arm.urdf", "other.urdf") + HEAD + JOINTS, "other.urdf"),
}


@pytest.mark.parametrize("case", BAD)
def test_joints_that_are_no_pose_are_refused_in_one_line(case: str, tmp_path: Path) -> None:
    text, words = BAD[case]
    with pytest.raises(pf.PumafuseError, match=words) as error:
        read(tmp_path, text)
    assert "\n" not in str(error.value)


def test_a_joint_that_is_told_later_has_the_values_of_rows_before(tmp_path: Path) -> None:
    """By whole intervals of the commands exactly; half-way between them by the mean; at rest before the first."""
    command = read(tmp_path, ROBOT + HEAD + JOINTS).command
    told, period = command.joints, 1.0 / 36.0
    late = command.delayed({"j2": 2.0 * period, "j5": 0.5 * period}).joints
    np.testing.assert_allclose(late.values[2:, 1], told.values[:-2, 1], atol=1e-7)
    np.testing.assert_allclose(late.values[1:, 4], 0.5 * (told.values[1:, 4] + told.values[:-1, 4]), atol=1e-7)
    np.testing.assert_array_equal(late.values[:, [0, 2, 3, 5]], told.values[:, [0, 2, 3, 5]])
    assert (late.values[:2, 1] == told.values[0, 1]).all()
    position, orientation = told.chain.pose(late.values)
    moved = command.delayed({"j2": 2.0 * period, "j5": 0.5 * period})
    np.testing.assert_array_equal(np.column_stack([moved.values[axis] for axis in "xyz"]), position)
    np.testing.assert_array_equal(moved.orientation, orientation)
    with pytest.raises(pf.PumafuseError, match="joint 'j7'"):
        command.delayed({"j7": period})


def test_an_arm_whose_joints_lag_apart_says_where_they_are_not_heeded(tmp_path: Path) -> None:
    """Commands in joints are told later; of commands in x, y, z a note says that nothing is."""
    arm = pf.ArmModel.parse(
        'name = "arm"\nupdate_period_ms = 28.0\ndelay_ms = 40.0\n[joints.j2]\nlater_ms = 30.0\n'
        '[axes.x]\nplant = "first-order"\ntime_constant_ms = 30.0\n'
    )
    assert pf.ArmModel.parse(arm.to_toml()) == arm
    run = read(tmp_path, ROBOT + HEAD + JOINTS)
    heeded, posed = run.delayed(arm), replace(run, command=replace(run.command, joints=None)).delayed(arm)
    assert not any("heeded" in note for note in heeded.notes)
    np.testing.assert_array_equal(heeded.command.values["x"], run.command.delayed({"j2": 0.03}).values["x"])
    assert [note for note in posed.notes if "j2 30 ms" in note and "not heeded" in note]
    np.testing.assert_array_equal(posed.command.values["x"], run.command.values["x"])


def test_commands_between_commands_are_on_the_line_of_joints(tmp_path: Path) -> None:
    """Half-way the joints are at their mean, and the tool is where these put it: on an arc, not on the chord."""
    command = read(tmp_path, ROBOT + HEAD + JOINTS).command
    finer = command.interpolated(0.5 / 36.0)
    between = 0.5 * (command.joints.values[1:] + command.joints.values[:-1])
    np.testing.assert_allclose(finer.joints.values[1::2], between, atol=1e-12)
    position, orientation = command.joints.chain.pose(between)
    np.testing.assert_allclose(np.column_stack([finer.values[axis] for axis in "xyz"])[1::2], position, atol=1e-9)
    np.testing.assert_allclose(finer.orientation[1::2], orientation, atol=1e-9)
    chord = 0.5 * (command.values["x"][1:] + command.values["x"][:-1])
    assert np.abs(chord - position[:, 0]).max() > 1e-6
