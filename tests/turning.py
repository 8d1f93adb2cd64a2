"""A tool that moves and turns for four seconds, seen by a camera in a corner that tells where a marker is and how."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

import pumafuse as pf
from pumafuse.logs.frames import Frame

START = 1_700_000_000.0  # s
LATE = 0.060  # s, from a command to the tool
LATENCY = 0.010  # s, of the camera
CORNER, CORNER_TURNED = np.array([2.1, -1.3, 0.7]), Rotation.from_rotvec([-148.0, 52.0, -7.0], degrees=True)
MARKER, MARKER_TURNED = np.array([0.03, -0.05, 0.12]), Rotation.from_rotvec([65.0, -41.0, -6.0], degrees=True)
SHOWN = (("sensors", CORNER, CORNER_TURNED), ("tool/markers", MARKER, MARKER_TURNED))  # below /path of a picture in 3D
SD, SD_DEG = 2e-4, 0.1  # m, of the camera
COLUMNS = ("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
RUN = "".join(
    f'[{table}]\nfile = "{name}.csv"\ntime = "time_s"\nx = "x_mm"\ny = "y_mm"\nz = "z_mm"\n'
    'orientation = { quaternion = ["qx", "qy", "qz", "qw"] }\n'
    for table, name in (("command", "command"), ("sensors.camera", "camera"), ("reference", "truth"))
)


def told(time: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Where the tool is told to be [m], and how it is told to be turned; at rest before 0 s."""
    time = np.maximum(time, 0.0)[:, None]
    point = np.array([0.5, 0.1, 0.4]) + 0.1 * np.sin(time * np.array([1.0, 1.3, 0.7]))
    turn = Rotation.from_rotvec(np.array([0.6, -0.4, 0.3]) * np.sin(time * np.array([1.1, 0.8, 1.4])))
    return point, turn * Rotation.from_euler("xyz", [170.0, 20.0, 60.0], degrees=True)


def sources() -> dict[str, tuple[np.ndarray, np.ndarray, Rotation]]:
    """Stamps [s], points [m] and orientations of the commands, the camera and the truth."""
    noise = np.random.default_rng(5)
    command, seen = 0.02 * np.arange(200), 0.1 + 0.01 * np.arange(390)
    point, turn = told(seen - LATE - LATENCY)
    marker = CORNER_TURNED.inv().apply(point + turn.apply(MARKER) - CORNER)
    turned = Rotation.from_rotvec(np.radians(SD_DEG) * noise.standard_normal((390, 3)))
    camera = marker + SD * noise.standard_normal((390, 3)), CORNER_TURNED.inv() * turned * turn * MARKER_TURNED
    return {
        "command": (START + command, *told(command)),
        "camera": (START + seen, *camera),
        "truth": (START + seen, *told(seen - LATE)),
    }


def recorded() -> pf.Run:
    """The run, from arrays."""
    command, camera, truth = (
        (stamp, {**dict(zip("xyz", point.T, strict=True)), "orientation": turn.as_quat()})
        for stamp, point, turn in sources().values()
    )
    return pf.Run.from_arrays(*command, {"camera": camera}, truth)


def commanded(config: pf.FusionConfig, frame: Frame) -> pf.Estimates:
    """The run without its camera, of an arm with tangential, radial and vertical instead of x, y and z."""
    names = dict(zip(("tangential", "radial", "vertical", "rx", "ry", "rz"), config.arm.axes, strict=True))
    arm = msgspec.structs.replace(config.arm, axes={name: config.arm.axes[axis] for name, axis in names.items()})
    return pf.fuse(replace(recorded(), sensors={}), pf.FusionConfig(arm=arm, frame=frame))


def written(folder: Path) -> Path:
    """The folder, with the run as files in it."""
    for name, (stamp, point, turn) in sources().items():
        rows = np.column_stack([stamp, point * 1e3, turn.as_quat()])
        np.savetxt(folder / f"{name}.csv", rows, "%.9f", ",", header=",".join(("time_s", *COLUMNS)), comments="")
    (folder / "run.toml").write_text(RUN)
    return folder


def configured(folder: Path, more: str = "") -> Path:
    """A ``fusion.toml`` in a folder, which knows where the camera stands and what it sees, with ``more`` before it."""
    plant = 'plant = "first-order"\ntime_constant_ms = 40.0\n'
    lengths, angles = ([f"[axes.{axis}]\n" for axis in axes] for axes in (("x", "y", "z"), ("rx", "ry", "rz")))
    axes = "".join([*(head + plant for head in lengths), *(f'{head}kind = "angle"\n{plant}' for head in angles)])
    (folder / "arm.toml").write_text(f'name = "cell"\nupdate_period_ms = 20.0\ndelay_ms = 20.0\n{axes}')
    placed = {
        name: f"{{ at_mm = {(at * 1e3).tolist()}, rotation_vector_deg = {turn.as_rotvec(degrees=True).tolist()} }}"
        for name, at, turn in (("frame", CORNER, CORNER_TURNED), ("marker", MARKER, MARKER_TURNED))
    }
    (folder / "fusion.toml").write_text(
        f'arm = "arm.toml"\n{more}[start]\noffset_sd_mm = 1.0\noffset_sd_deg = 0.1\n'
        "[process]\ninput_noise_mm_rtHz = 0.3\ndrift_mm_rts = 0.5\ninput_noise_deg_rtHz = 0.05\ndrift_deg_rts = 0.1\n"
        f"[sensors.camera]\nsd_mm = {SD * 1e3}\nsd_deg = {SD_DEG}\nlatency_ms = {LATENCY * 1e3}\n"
        f"frame = {placed['frame']}\nmarker = {placed['marker']}\n"
    )
    return folder / "fusion.toml"
