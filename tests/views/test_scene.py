"""A tool that turns, as Rerun is given it, against scipy's rotations."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import pumafuse as pf
import turning
from pumafuse.fusion.config import Placement
from pumafuse.logs.frames import Cylindrical
from pumafuse.views.rerun import to_rerun
from pumafuse.views.scene import cell_eye
from recordings import columns, times

VIEWER = Path(sys.executable).parent / "rerun"
TWO_LINKS = """<robot name="two">
  <link name="base"/><link name="upper"/><link name="lower"/><link name="tip"/>
  <joint name="a" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/></joint>
  <joint name="b" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.3 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="end" type="fixed"><parent link="lower"/><child link="tip"/><origin xyz="0.2 0 0.1"/></joint>
</robot>"""
IN_JOINTS = """[robot]
urdf = "two.urdf"
base = "base"
tip = "tip"
[command]
file = "joints.csv"
time = "time_s"
joints = { a = "a_deg", b = "b_deg" }
"""

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.errors.PumafuseWarning")


@pytest.fixture(scope="module")
def fused(tmp_path_factory: pytest.TempPathFactory) -> tuple[pf.Estimates, Path]:
    folder = tmp_path_factory.mktemp("scene")
    run = turning.recorded()
    est = pf.fuse(run, pf.FusionConfig.load(turning.configured(folder)))
    to_rerun(est, run, folder / "fused.rrd")
    return est, folder / "fused.rrd"


def numbers(path: Path, entity: str, component: str, *, static: bool = False) -> np.ndarray:
    """The values of a component, row by row, (n, …)."""
    chunks = [one for one in columns(path, entity, static=static) if component in one]
    return np.array([row[0] for chunk in chunks for row in chunk[component].to_pylist()])


def layout(path: Path) -> str:
    """A recording as text, with what its layout shows."""
    return subprocess.run([VIEWER, "rrd", "print", "-vvv", path], capture_output=True, text=True, check=True).stdout


def test_the_tool_is_where_the_pose_is(fused: tuple[pf.Estimates, Path]) -> None:
    """At every estimate its place in mm and its quaternion."""
    est, path = fused
    assert np.allclose(times(columns(path, "/path/tool")), est.time, atol=1e-9, rtol=0)
    found = numbers(path, "/path/tool", "Transform3D:translation")
    np.testing.assert_allclose(found, est.pose.position * 1e3, atol=1e-3)
    turned = Rotation.from_quat(numbers(path, "/path/tool", "Transform3D:quaternion"))
    assert (turned * Rotation.from_quat(est.pose.quaternion).inv()).magnitude().max() < 1e-6
    assert numbers(path, "/path/tool", "TransformAxes3D:axis_length", static=True)[0] > 1.0


def test_the_ellipsoid_is_that_of_95_percent(fused: tuple[pf.Estimates, Path], tmp_path: Path) -> None:
    """The unit sphere is mapped to the ellipsoid of the covariance, as many times as large as its label says.

    So it is along axes that are askew in space, which have covariances between x and y.
    """
    est, path = fused
    other = turning.commanded(est.config, Cylindrical(base=(0.1, -0.2)))
    wide = replace(other["radial"], position_sd=5.0 * other["radial"].position_sd)
    other = replace(other, axes={**other.axes, "radial": wide})
    to_rerun(other, replace(turning.recorded(), sensors={}), tmp_path / "askew.rrd")
    for one, recording in ((est, path), (other, tmp_path / "askew.rrd")):
        map_of = numbers(recording, "/path/uncertainty", "Transform3D:mat3x3").reshape(-1, 3, 3).transpose(0, 2, 1)
        (label,) = numbers(recording, "/path/uncertainty", "Ellipsoids3D:labels", static=True)
        larger = float(label.split()[2])
        wanted = chi2.ppf(0.95, 3) * (larger * 1e3) ** 2 * one.pose.covariance[:, :3, :3]
        np.testing.assert_allclose(map_of @ map_of.transpose(0, 2, 1), wanted, rtol=1e-4, atol=1e-4 * wanted.max())
        assert larger in {1.0, 10.0, 100.0}
    assert np.abs(other.pose.covariance[:, 0, 1]).max() > 0.1 * other.pose.covariance[:, 0, 0].max()


def test_measurements_lie_where_they_put_the_tool(fused: tuple[pf.Estimates, Path]) -> None:
    """Frame · z − R · marker, with R of the same row."""
    _, path = fused
    _, seen, turned = turning.sources()["camera"]
    turn = turning.CORNER_TURNED * turned * turning.MARKER_TURNED.inv()
    wanted = turning.CORNER + turning.CORNER_TURNED.apply(seen) - turn.apply(turning.MARKER)
    (chunk,) = [one for one in columns(path, "/path/measured/camera", static=True) if "Points3D:positions" in one]
    np.testing.assert_allclose(chunk["Points3D:positions"].to_pylist()[0], wanted * 1e3, atol=1e-3)


def test_a_sensor_stands_in_the_scene_and_its_marker_on_the_tool(fused: tuple[pf.Estimates, Path]) -> None:
    """Both with their names, in mm and as they are turned; the axes of a sensor as long as 0.15 of its distance."""
    est, path = fused
    for place, at, turned in turning.SHOWN:
        entity = f"/path/{place}/camera"
        assert np.allclose(numbers(path, entity, "Transform3D:translation", static=True), at * 1e3, atol=1e-3)
        found = Rotation.from_quat(numbers(path, entity, "Transform3D:quaternion", static=True)[0])
        assert (found * turned.inv()).magnitude() < 1e-6
        assert numbers(path, entity, "Points3D:labels", static=True).tolist() == ["camera"]
        length = numbers(path, entity, "TransformAxes3D:axis_length", static=True)[0]
        away = np.linalg.norm(est.pose.position.mean(axis=0) - turning.CORNER)
        tool = numbers(path, "/path/tool", "TransformAxes3D:axis_length", static=True)[0]
        assert length == pytest.approx(0.5 * tool if "markers" in entity else 0.15 * 1e3 * away, rel=1e-4)


@pytest.mark.long
def test_a_robot_whose_joints_are_commanded_moves(tmp_path: Path) -> None:
    """A line through its links, worked out by hand for two in a plane, at 2500 of 5000 commands; in a view of the cell.

    Without joints there is none.
    """
    time = 0.02 * np.arange(5000)
    a, b = 40.0 + 30.0 * np.sin(0.5 * time), -20.0 + 40.0 * np.cos(0.8 * time)
    rows = np.column_stack([time, a, b])
    np.savetxt(tmp_path / "joints.csv", rows, "%.9f", ",", header="time_s,a_deg,b_deg", comments="")
    (tmp_path / "two.urdf").write_text(TWO_LINKS)
    (tmp_path / "run.toml").write_text(IN_JOINTS)
    run = pf.Run.read(tmp_path)
    config = pf.FusionConfig(arm=pf.FusionConfig.load(turning.configured(tmp_path)).arm)
    to_rerun(pf.fuse(run, config), run, tmp_path / "fused.rrd")
    found = columns(tmp_path / "fused.rrd", "/path/robot")
    upper, both = np.radians(a), np.radians(a + b)
    elbow = 300.0 * np.column_stack([np.cos(upper), np.sin(upper), 0.0 * upper])
    tip = elbow + np.column_stack([200.0 * np.cos(both), 200.0 * np.sin(both), 100.0 + 0.0 * both])
    wanted = np.stack([0.0 * elbow, 0.0 * elbow, elbow, tip], axis=1)
    assert np.allclose(times(found), time[::2], atol=1e-8, rtol=0)
    np.testing.assert_allclose(
        numbers(tmp_path / "fused.rrd", "/path/robot", "LineStrips3D:strips"), wanted[::2], atol=1e-3
    )
    assert "cell [mm]" in layout(tmp_path / "fused.rrd")

    still = replace(run, command=replace(run.command, joints=None))
    to_rerun(pf.fuse(still, config), still, tmp_path / "still.rrd")
    assert not columns(tmp_path / "still.rrd", "/path/robot") and "cell [mm]" not in layout(tmp_path / "still.rrd")


@pytest.mark.parametrize("at", [(2.1, -1.3, 0.7), (-3.0, 0.4, -0.2)])
def test_the_eye_sees_the_whole_cell(at: tuple[float, float, float]) -> None:
    """Path, base, sensor and robot lie within 30 degrees of where it looks, in mm; it stands on the right and above."""
    path = 0.4 + 0.1 * np.random.default_rng(1).normal(size=(50, 3))
    links = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.6], [0.4, 0.4, 0.4]])
    eye = cell_eye(path, [Placement(at=at), None], links)
    assert eye is not None and eye.position is not None and eye.look_target is not None
    place, target = (np.array(one.as_arrow_array().to_pylist()[0]) for one in (eye.position, eye.look_target))
    towards, all_of = target - place, 1e3 * np.vstack([path, links, [at], np.zeros((1, 3))])
    rays = all_of - place
    cosine = rays @ towards / (np.linalg.norm(rays, axis=1) * np.linalg.norm(towards))
    assert np.degrees(np.arccos(cosine)).max() < 30.0
    assert np.linalg.norm(towards) < 1.5 * np.linalg.norm(np.ptp(all_of, axis=0))  # no farther than it needs
    assert np.sign(-towards).tolist() == [1.0, -1.0, 1.0]
    assert cell_eye(path, [None]) is None


def test_the_layout_opens_on_the_tool_and_the_cell(fused: tuple[pf.Estimates, Path]) -> None:
    """A view of each, tabs of six axes, and a file that the viewer accepts."""
    _, path = fused
    subprocess.run([VIEWER, "rrd", "verify", path], capture_output=True, check=True)
    shown = layout(path)
    for name in ("tool [mm]; where it is with 95 %", "cell [mm]", "positions", "rx [deg]", "outcomes"):
        assert name in shown
