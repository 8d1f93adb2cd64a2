"""Fusion of logs in x, y, z: the shipped scan written in them, circles, and the way back to x, y, z."""

from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.fusion.summary import summarise
from pumafuse.logs.frames import Cylindrical

DATA = Path(pf.__file__).parent / "data"
CARTESIAN = {"tangential": "x", "radial": "y", "vertical": "z"}
ROTATED = 'kind = "rotated"\nazimuth_deg = 90.0\npositive = "clockwise"\n'
CYLINDRICAL = 'kind = "cylindrical"\npositive = "clockwise"\n'


def scan_in_xyz(folder: Path, frame: str) -> pf.Run:
    """The shipped scan with a manifest that names x, y and z; the range sensor still names the axis it looks along."""
    text = (DATA / "scan1" / "run.toml").read_text()
    for axis, letter in CARTESIAN.items():
        for column in (f'["nominal_{letter}_mm"', f'"{letter}_mm"'):
            text = text.replace(f"{axis} = {column}", f"{letter} = {column}")
    assert text.count("\nx = ") == text.count("\ny = ") == text.count("\nz = ") == 4
    assert 'radial = "range_mm"' in text
    text = text.replace('file = "', f'file = "{(DATA / "scan1").as_posix()}/')
    (folder / "run.toml").write_text(f"{text}\n[frame]\n{frame}")
    return pf.Run.read(folder)


@pytest.fixture(scope="module")
def config() -> pf.FusionConfig:
    return pf.FusionConfig.load(DATA / "fusion.toml")


@pytest.fixture(scope="module")
def by_axes(config: pf.FusionConfig) -> pf.Estimates:
    """The scan as shipped, x taken for tangential and y for radial."""
    return pf.fuse(pf.Run.read(DATA / "scan1"), config, sensors=["vision", "range"])


@pytest.fixture(scope="module")
def cylindrical(config: pf.FusionConfig, tmp_path_factory: pytest.TempPathFactory) -> pf.Estimates:
    """The scan about its base; the range sensor looks along y, which is no axis then."""
    return pf.fuse(scan_in_xyz(tmp_path_factory.mktemp("scan"), CYLINDRICAL), config, sensors=["vision"])


def test_the_scan_in_a_rotated_frame_is_the_scan(
    config: pf.FusionConfig, by_axes: pf.Estimates, tmp_path: Path
) -> None:
    """At azimuth 90°, clockwise, every estimate and outcome is that of the axes, and x, y, z are the axes."""
    est = pf.fuse(scan_in_xyz(tmp_path, ROTATED), config, sensors=["vision", "range"])
    assert by_axes.cartesian is None
    assert est.measurements.outcome.tolist() == by_axes.measurements.outcome.tolist()
    for axis, letter in CARTESIAN.items():
        for field in pf.AxisEstimate.FIELDS:
            np.testing.assert_allclose(
                getattr(est[axis], field), getattr(by_axes[axis], field), rtol=0, atol=1e-9, err_msg=field
            )
        np.testing.assert_allclose(est.cartesian[letter], est[axis].position, rtol=0, atol=1e-15)
    assert summarise(est).validity.commanded_radius_mm == "not checked"


def test_a_framed_reference_scores_the_axes(cylindrical: pf.Estimates, by_axes: pf.Estimates) -> None:
    """The reference turns with the run: its radius and arc are those of its x and y, and every axis is scored."""
    x, y = (by_axes.reference.position[axis] for axis in ("tangential", "radial"))
    radius, azimuth = np.hypot(-150.0, 560.0) / 1e3, np.arctan2(560.0, -150.0)
    found = cylindrical.reference.position
    np.testing.assert_allclose(found["radial"], np.hypot(x, y), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found["tangential"], radius * (azimuth - np.arctan2(y, x)), rtol=0, atol=1e-12)
    scores = {axis: summary.score for axis, summary in summarise(cylindrical).axes.items()}
    assert scores["tangential"].rmse_mm < 0.4
    assert scores["radial"].rmse_mm < 0.25
    assert min(score.coverage for score in scores.values()) > 0.9


def about_the_base(positive: str = "counterclockwise") -> pf.FusionConfig:
    frame = Cylindrical(base=(0.1, -0.2), positive=positive)
    return pf.FusionConfig(arm=pf.ArmModel.load("puma560-internal"), frame=frame)


def test_a_commanded_circle_stays_a_circle() -> None:
    """Its lag lies along the circle, not across it: the tool trails the command at the command's own radius."""
    angle = np.linspace(0.5, 2.0, 100)
    values = {"x": 0.1 + 0.4 * np.cos(angle), "y": -0.2 + 0.4 * np.sin(angle), "z": np.linspace(0.0, 0.1, 100)}
    est = pf.fuse(pf.Run.from_arrays(0.028 * np.arange(100), values), about_the_base("clockwise"))
    dx, dy = est.cartesian["x"] - 0.1, est.cartesian["y"] + 0.2
    np.testing.assert_allclose(np.hypot(dx, dy), 0.4, rtol=0, atol=1e-12)
    behind = angle - np.arctan2(dy, dx)
    rate = 1.5 / 99 / 0.028
    assert behind[0] == pytest.approx(0.0, abs=1e-12)
    assert 0.06045 * rate < behind[50] < 0.15 * rate
