"""What is called target may be what a camera looks at, and what only looks like following is not fused."""

from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from executable import pumafuse, refused
from pumafuse.discovery import names
from pumafuse.discovery.survey import survey

CORNER = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # how a camera in the corner is turned


def path(time: np.ndarray) -> np.ndarray:
    """A motion in space [m], (n, 3), at rest before 0 s."""
    time = np.maximum(time, 0.0)[:, None]
    return np.array([0.5, 0.1, 0.4]) + 0.1 * np.sin(time * [1.0, 1.7, 0.6]) + 0.04 * np.sin(time * [4.1, 3.3, 5.0])


def write(file: Path, time: np.ndarray, at: np.ndarray) -> None:
    rows = ["time_s,x_m,y_m,z_m", *(f"{t:.4f},{x:.6f},{y:.6f},{z:.6f}" for t, (x, y, z) in zip(time, at, strict=True))]
    file.write_text("\n".join(rows) + "\n")


def seen(time: np.ndarray, late: float, noise: float = 2e-4) -> np.ndarray:
    """What a camera in a frame of its own sees of it, so late [s]."""
    return path(time - late) @ CORNER.T + [1.0, 2.0, 0.5] + np.random.default_rng(3).normal(0.0, noise, (len(time), 3))


@pytest.mark.parametrize(("name", "role"), [
    ("ir_target", "command"), ("target_pose", "command"), ("camera_target", "sensor"), ("marker_target", "sensor"),
    ("aruco_pose", "sensor"), ("fiducial_7", "sensor"), ("apriltag", "sensor"), ("target_tag", "sensor"),
    ("marker_cmd", "command"), ("vicon/target_0", "sensor"), ("base_link", None),
])  # fmt: skip
def test_a_name_of_a_marker_is_a_sensors(name: str, role: str | None) -> None:
    """A target alone may be commanded; a camera's, or a marker called target, is what a sensor looks at."""
    assert names.role_of(name) == role


def test_motion_outweighs_the_name_target(tmp_path: Path) -> None:
    """Even rows that nothing names, which a target's run behind in a frame of its own, are the commands."""
    rng = np.random.default_rng(5)
    time, frames = np.arange(0.0, 40.0, 0.02), np.sort(rng.uniform(0.5, 39.5, 1200))
    write(tmp_path / "base_link_hinge.csv", time, path(time))
    write(tmp_path / "ir_target.csv", frames, seen(frames, 0.06))
    found = survey(tmp_path).roles
    assert found.command.part.stem == "base_link_hinge"
    assert [(one.part.stem, "follows 'base_link_hinge'" in one.why) for one in found.sensors] == [("ir_target", True)]


def test_joints_of_which_few_run_behind_are_commanded(tmp_path: Path) -> None:
    """Seven joints called target; what nothing names leads two of them by chance, and follows the others."""
    time, rng = np.arange(0.0, 40.0, 0.02), np.random.default_rng(8)
    waves = np.cumsum(rng.normal(size=(7, len(time))), axis=1) * 0.02

    def late(wave: np.ndarray, by: float) -> np.ndarray:
        return np.interp(time - by, time, wave)

    seen = [late(wave, 0.06 if joint < 5 else -0.06) for joint, wave in enumerate(waves)]
    columns = [f"target_joint_{joint}" for joint in range(7)] + [f"real_position_joint_{joint}" for joint in range(7)]
    rows = [",".join(f"{value:.5f}" for value in row) for row in zip(time, *waves, *seen, strict=True)]
    log = tmp_path / "log.csv"
    log.write_text("\n".join([",".join(["time_s", *(one.replace("real_", "") for one in columns)]), *rows, ""]))
    found = survey(log)
    assert found.roles is not None and found.roles.command.role == "command"
    assert all(signals[0].column.startswith("target") for signals in found.roles.command.axes.values())
    assert set(found.run.sensors) and len(found.run.axes) == 5


def test_a_motion_that_is_only_alike_is_not_fused(tmp_path: Path) -> None:
    """Of an axis that is as late as lags are looked for nothing is known: the line says what to write in run.toml."""
    time, log = np.arange(0.0, 60.0, 0.02), tmp_path / "log.csv"
    other = np.column_stack([path(time - late)[:, axis] for axis, late in enumerate((2.2, 2.4, 0.3))])
    head = ",".join(["time_s", *(f"{who}_{axis}_m" for who in ("command", "camera") for axis in "xyz")])
    np.savetxt(log, np.column_stack([time, path(time), other]), "%.6f", ",", header=head, comments="")
    words = r"no lag up to 2 s explains its motion on x.* in run.toml: \[sensors.camera\], with shift_s"
    with pytest.raises(pf.RunError, match=words):
        survey(log)


@pytest.mark.long
def test_what_cannot_be_registered_leaves_a_run_toml_to_be_mended(tmp_path: Path) -> None:
    """A frame that drifts: registering is refused, and what was read is written, says where, and can be read."""
    log, time = tmp_path / "log", np.arange(0.0, 40.0, 0.02)
    log.mkdir()
    drift = 0.06 * np.sin(0.11 * time[:, None] * [1.0, 1.3, 0.7])
    write(log / "command.csv", time, path(time))
    write(log / "camera.csv", time, seen(time, 0.06) + drift)
    line = pumafuse("init", log, "-o", tmp_path / "made", code=1).stderr
    assert "no frame explains how" in line and f"{tmp_path / 'made' / 'run.toml'}: mend it" in line
    assert [one.name for one in (tmp_path / "made").iterdir()] == ["run.toml"]
    assert tuple(pf.Run.read(tmp_path / "made").sensors) == ("camera",)
    assert "has run.toml already" in refused("init", log, "-o", tmp_path / "made")
    write(log / "camera.csv", time, seen(time, 0.06))
    pumafuse("init", tmp_path / "made", "-o", tmp_path / "made", "--force")
    assert (tmp_path / "made" / "fusion.toml").exists()
