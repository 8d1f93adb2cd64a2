"""Orientations of logs, in the conventions of robots and sensors."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pumafuse as pf
from pumafuse.logs.axes import in_axes

TIME = np.arange(0.0, 2.0, 0.02)
LEVEL = Rotation.from_euler("ZYX", [40.0, -20.0, 100.0], degrees=True)
TURNED = Rotation.from_rotvec(0.3 * np.sin(np.outer(TIME, [1.0, 2.0, 3.0]))) * LEVEL


def read(folder: Path, columns: Mapping[str, np.ndarray], orientation: str, more: str = "") -> pf.Run:
    """A run whose commands and sensor are the same columns."""
    table = {"t_s": TIME, "x_mm": 100.0 * np.sin(TIME), **columns}
    rows = zip(*(value.tolist() for value in table.values()), strict=True)
    lines = [",".join(table), *(",".join(map(repr, row)) for row in rows)]
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    entry = f'file = "log.csv"\ntime = "t_s"\nx = "x_mm"\norientation = {orientation}\n{more}'
    (folder / "run.toml").write_text(f"[command]\n{entry}\n[sensors.tracker]\n{entry}")
    return pf.Run.read(folder)


def columns(names: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(names.split(), values.T, strict=True))


QUATERNION = TURNED.as_quat()
KUKA, FANUC = (TURNED.as_euler(letters, degrees=True) for letters in ("ZYX", "xyz"))
FORMS = {
    "xyzw": (columns("qx qy qz qw", QUATERNION), '{ quaternion = ["qx", "qy", "qz", "qw"] }'),
    "wxyz": (columns("a b c d", QUATERNION[:, [3, 0, 1, 2]]), '{ quaternion = ["a", "b", "c", "d"], order = "wxyz" }'),
    "abb": (
        columns("q1 q2 q3 q4", QUATERNION[:, [3, 0, 1, 2]]),
        '{ quaternion = ["q1", "q2", "q3", "q4"], convention = "abb" }',
    ),
    "a quaternion and its negative by turns": (
        columns("qx qy qz qw", QUATERNION * np.where(np.arange(len(TIME)) % 2, 1.0, -1.0)[:, None]),
        '{ quaternion = ["qx", "qy", "qz", "qw"] }',
    ),
    "a rotation vector": (columns("u v w", TURNED.as_rotvec()), '{ rotation_vector = ["u", "v", "w"], unit = "rad" }'),
    "a rotation vector in degrees": (
        columns("u_deg v_deg w_deg", TURNED.as_rotvec(degrees=True)),
        '{ rotation_vector = ["u_deg", "v_deg", "w_deg"] }',
    ),
    "kuka": (columns("A B C", KUKA), '{ euler = ["A", "B", "C"], convention = "kuka", unit = "deg" }'),
    "fanuc": (columns("W P R", FANUC), '{ euler = ["W", "P", "R"], convention = "fanuc", unit = "deg" }'),
    "rpy": (
        columns("roll_rad pitch_rad yaw_rad", np.radians(FANUC)),
        '{ euler = ["roll_rad", "pitch_rad", "yaw_rad"], convention = "rpy" }',
    ),
    "letters": (
        columns("e f g", TURNED.as_euler("ZXZ")),
        '{ euler = ["e", "f", "g"], convention = "ZXZ", unit = "rad" }',
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_each_convention_gives_the_rotation_vector_from_the_mean_orientation(form: str, tmp_path: Path) -> None:
    """Whatever the columns are, rx, ry, rz are Log(R R₀ᵀ) of scipy, R₀ being the mean of the commands."""
    run, _ = in_axes(read(tmp_path, *FORMS[form]), None)
    assert run.axes == ("x", "rx", "ry", "rz")
    assert run.kinds == {"x": "length", "rx": "angle", "ry": "angle", "rz": "angle"}
    expected = (TURNED * TURNED.mean().inv()).as_rotvec()
    for source in (run.command, run.sensors["tracker"]):
        found = np.column_stack([source.values[axis] for axis in ("rx", "ry", "rz")])
        np.testing.assert_allclose(found, expected, atol=1e-10)


def test_a_run_is_told_relative_to_the_orientation_that_is_given(tmp_path: Path) -> None:
    """A live filter and a second run need the reference of the first one."""
    reference = Rotation.from_rotvec([0.1, 0.2, 0.3]) * LEVEL
    run, _ = in_axes(read(tmp_path, *FORMS["xyzw"]), None, tuple(reference.as_rotvec()))
    found = np.column_stack([run.command.values[axis] for axis in ("rx", "ry", "rz")])
    np.testing.assert_allclose(found, (TURNED * reference.inv()).as_rotvec(), atol=1e-12)


def test_a_sensor_that_lost_its_target_has_no_orientation_in_these_rows(tmp_path: Path) -> None:
    lost = QUATERNION.copy()
    lost[10:20] = 0.0
    run, _ = in_axes(read(tmp_path, columns("qx qy qz qw", lost), FORMS["xyzw"][1]), None)
    assert np.flatnonzero(np.isnan(run.sensors["tracker"].values["ry"])).tolist() == list(range(10, 20))


def test_commands_between_two_rows_turn_evenly_on_the_shortest_way(tmp_path: Path) -> None:
    """A controller that interpolates turns the tool by a share of the rotation between two commands (scipy's Slerp)."""
    from scipy.spatial.transform import Slerp

    run = read(tmp_path, *FORMS["xyzw"])
    command = run.command.interpolated(0.005)
    assert command.orientation is not None
    seconds = (command.stamp - command.stamp[0]) / 1e9
    apart = (
        Rotation.from_quat(command.orientation) * Slerp(TIME, TURNED)(np.minimum(seconds, TIME[-1])).inv()
    ).magnitude()
    assert apart.max() < 1e-7  # stamps are rounded to ns


BAD = {
    "no form": ("{ }", "expected one of quaternion"),
    "two forms": (
        '{ quaternion = ["qx", "qy", "qz", "qw"], rotation_vector = ["qx", "qy", "qz"], unit = "rad" }',
        "expected one of quaternion",
    ),
    "no convention": ('{ euler = ["qx", "qy", "qz"], unit = "deg" }', "kuka, fanuc, rpy, or letters"),
    "no unit": ('{ rotation_vector = ["qx", "qy", "qz"] }', "'qx' ends in no unit of an angle"),
    "convention of a vector": (
        '{ rotation_vector = ["qx", "qy", "qz"], convention = "kuka", unit = "rad" }',
        "only Euler angles have one",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_an_orientation_that_says_too_much_or_too_little_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    orientation, words = BAD[case]
    with pytest.raises(pf.PumafuseError, match=words) as error:
        read(tmp_path, FORMS["xyzw"][0], orientation)
    assert "\n" not in str(error.value)


def test_columns_that_are_no_orientation_are_refused(tmp_path: Path) -> None:
    """Numbers without norm 1 in any row are something else."""
    with pytest.raises(pf.RunError, match="no row of qx, qy, qz, qw is an orientation"):
        read(tmp_path, columns("qx qy qz qw", 3.0 * QUATERNION), FORMS["xyzw"][1])


def test_an_axis_of_its_own_beside_an_orientation_is_refused(tmp_path: Path) -> None:
    table = FORMS["xyzw"][0] | {"rx_deg": np.zeros(len(TIME))}
    with pytest.raises(pf.ConfigError, match="the orientation has rx"):
        read(tmp_path, table, FORMS["xyzw"][1], 'rx = "rx_deg"\n')
