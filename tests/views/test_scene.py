"""A tool that turns, as Rerun is given it, against scipy's rotations."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import pumafuse as pf
import turning
from pumafuse.logs.frames import Cylindrical
from pumafuse.views.rerun import to_rerun
from recordings import columns, times

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
