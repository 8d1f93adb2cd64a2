"""The pose of a tool that turns, in every form in which it is given out, against scipy's rotations."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

import pumafuse as pf
import turning
from executable import pumafuse
from pumafuse.fusion import results
from pumafuse.fusion.config import Tool
from pumafuse.logs.frames import Cylindrical, Frame, Rotated

TURNING = ("rx", "ry", "rz")
QUATERNION = ("qx", "qy", "qz", "qw")
SAMPLES = 200_000

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> pf.FusionConfig:
    return pf.FusionConfig.load(turning.configured(tmp_path_factory.mktemp("config")))


@pytest.fixture(scope="module")
def est(config: pf.FusionConfig) -> pf.Estimates:
    return pf.fuse(turning.recorded(), config)


@pytest.fixture(scope="module")
def saved(est: pf.Estimates, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results") / "fused"
    est.save(folder)
    return folder


def turned(est: pf.Estimates) -> Rotation:
    """Exp(θ) R₀ of the estimates."""
    theta = np.column_stack([est[axis].position for axis in TURNING])
    return Rotation.from_rotvec(theta) * Rotation.from_rotvec(est.config.tool.reference)


def apart(first: Rotation, second: Rotation) -> np.ndarray:
    """The angles between orientations [rad]."""
    return (first * second.inv()).magnitude()


def test_the_pose_is_that_of_its_axes(est: pf.Estimates) -> None:
    """x, y, z, and the orientation Exp(θ) R₀, which is near to how the tool really was turned."""
    assert np.array_equal(est.pose.position, np.column_stack([est[axis].position for axis in "xyz"]))
    assert apart(Rotation.from_quat(est.pose.quaternion), turned(est)).max() < 1e-12
    settled = est.time > 1.0
    point, turn = turning.told(est.time[settled] - turning.LATE)
    assert np.abs(est.pose.position[settled] - point).max() < 5e-3
    assert np.degrees(apart(turned(est)[settled], turn)).max() < 1.0


def with_sds(est: pf.Estimates, sds: dict[str, float]) -> pf.Estimates:
    """The estimates with other error bars [m or rad]."""
    full = {axis: np.full(len(est.time), sd) for axis, sd in sds.items()}
    return replace(est, axes={**est.axes, **{axis: replace(est[axis], position_sd=sd) for axis, sd in full.items()}})


def test_the_covariance_is_that_of_sampled_axes(est: pf.Estimates) -> None:
    """Rotation vectors drawn with the axes' sds turn the tool as J P Jᵀ says, far from R₀, too.

    A variance of 200,000 samples has a relative sd of 0.3 %: a band of 2 % of the largest is six of them.
    """
    row = int(np.argmax(sum(est[axis].position ** 2 for axis in TURNING)))
    theta, rng = np.array([est[axis].position[row] for axis in TURNING]), np.random.default_rng(1)
    sd = np.array([1e-3, 3e-3, 0.3e-3])
    assert np.linalg.norm(theta) > 0.5
    found = with_sds(est, dict(zip(TURNING, sd, strict=True))).pose.covariance[row]
    samples = Rotation.from_rotvec(theta + sd * rng.standard_normal((SAMPLES, 3)))
    wanted = np.cov((samples * Rotation.from_rotvec(theta).inv()).as_rotvec().T)
    assert np.abs(found[3:, 3:] - wanted).max() < 0.02 * wanted.max()
    assert np.abs(np.diag(sd**2) - wanted).max() > 0.05 * wanted.max()  # and not as P itself does
    assert np.array_equal(found[:3, :3], np.diag([est[axis].position_sd[row] ** 2 for axis in "xyz"]))
    assert not found[:3, 3:].any() and not found[3:, :3].any()


@pytest.mark.parametrize("frame", [Cylindrical(base=(0.1, -0.2), positive="clockwise"), Rotated(azimuth=0.5)])
def test_with_a_frame_positions_and_their_covariance_are_in_the_log(frame: Frame, config: pf.FusionConfig) -> None:
    """Axes drawn with their sds lie in x, y, z as the covariance says: within 2 % of the largest variance."""
    names, est = ("tangential", "radial", "vertical"), turning.commanded(config, frame)
    assert est.cartesian is not None
    assert np.array_equal(est.pose.position, np.column_stack([est.cartesian[axis] for axis in "xyz"]))
    row, rng, sd = 150, np.random.default_rng(2), np.array([1e-3, 4e-4, 2e-4])
    found = with_sds(est, dict(zip(names, sd, strict=True))).pose.covariance[row, :3, :3]
    at = [est[name].position[row] + one * rng.standard_normal(SAMPLES) for name, one in zip(names, sd, strict=True)]
    wanted = np.cov([*est.placed.to_log(at[0], at[1]), at[2]])
    assert np.abs(found - wanted).max() < 0.02 * wanted.max()


def test_files_have_the_quaternion_of_the_axes_beside_them(est: pf.Estimates, saved: Path) -> None:
    """`estimates.parquet`, `to_arrow`, and the reference, whose truth comes back; without a sign that changes."""
    tables = [pq.read_table(saved / f"{name}.parquet") for name in ("estimates", "reference")]
    for table in (tables[0], est.to_arrow()):
        found = np.column_stack([table[name].to_numpy() for name in QUATERNION])
        assert apart(Rotation.from_quat(found), turned(est)).max() < 1e-12
        assert (np.sum(found[1:] * found[:-1], axis=1) > 0.0).all()
    reference = Rotation.from_quat(np.column_stack([tables[1][name].to_numpy() for name in QUATERNION]))
    assert apart(reference, turning.sources()["truth"][2]).max() < 1e-12


def test_a_trajectory_has_the_orientation(est: pf.Estimates, saved: Path, tmp_path: Path) -> None:
    """In the TUM format, from Python and from a result folder, which has the reference, too."""
    est.to_tum(tmp_path / "fused.tum")
    pumafuse("compare", saved, "--tum", tmp_path / "out")
    for path in (tmp_path / "fused.tum", tmp_path / "out" / "fused.tum"):
        rows = np.loadtxt(path)
        assert apart(Rotation.from_quat(rows[:, 4:]), turned(est)).max() < 1e-12
        np.testing.assert_allclose(rows[:, 1:4], est.pose.position, atol=1e-12)
    reference = np.loadtxt(tmp_path / "out" / "fused.reference.tum")
    assert apart(Rotation.from_quat(reference[:, 4:]), turning.sources()["truth"][2]).max() < 1e-12


def test_the_angle_of_the_score_is_that_of_the_orientations(est: pf.Estimates, saved: Path) -> None:
    """RMS of scipy's magnitude at the instants at which the truth is known, and as large as expected."""
    assert est.reference is not None
    truth = turning.sources()["truth"]
    shared = np.isin(np.rint(est.time * 1e3), np.rint((truth[0] - turning.START) * 1e3))
    known = np.isin(np.rint((truth[0] - turning.START) * 1e3), np.rint(est.time * 1e3))
    wanted = np.sqrt(np.mean(apart(turned(est)[shared], truth[2][known]) ** 2))
    read = results.read(saved)
    for found in (pf.summarise(est).orientation, read.summary.orientation, read.orientation_score(est.reference)):
        assert found.rows == known.sum()
        assert found.left_out == len(est.time) - found.rows
        assert found.rms == pytest.approx(wanted, rel=1e-9)
        trace = np.trace(est.pose.covariance[shared, 3:, 3:], axis1=1, axis2=2)
        assert found.expected == pytest.approx(np.sqrt(trace.mean()), rel=1e-9)


def test_results_about_other_reference_orientations_are_compared_as_one(
    config: pf.FusionConfig, est: pf.Estimates, saved: Path, tmp_path: Path
) -> None:
    """With R₀ turned by 5° the same tool is the same to a hundredth of a degree, and so is its score."""
    other = Rotation.from_rotvec([5.0, 0.0, 0.0], degrees=True) * Rotation.from_rotvec(est.config.tool.reference)
    tool = Tool(reference=tuple(other.as_rotvec().tolist()))
    pf.fuse(turning.recorded(), msgspec.structs.replace(config, tool=tool)).save(tmp_path / "second")
    reference = ("--reference", saved / "reference.parquet", "--json")
    first, second = msgspec.json.decode(pumafuse("compare", saved, tmp_path / "second", *reference).stdout)
    assert all(second["difference"][axis]["rms_deg"] < 0.02 for axis in TURNING)
    assert second["orientation"]["rms_deg"] == pytest.approx(first["orientation"]["rms_deg"], abs=0.01)
    assert all(second["axes"][axis]["rmse_deg"] < 0.5 for axis in TURNING)
