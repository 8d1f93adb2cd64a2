"""Logs of which nothing is known, with sensors in frames of their own."""

from __future__ import annotations

import gzip
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pumafuse as pf

RECORDED = Path(__file__).parents[2] / "examples" / "pose-virtual" / "inspect1"
TURNED = {  # of the simulation that the run is from [deg]
    "mocap": (-148.119668, 52.631573, -6.871825),
    "tracker": (-1.993468, 0.207007, -112.001045),
}


def pumafuse(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pumafuse", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def log(folder: Path, *names: str, until: float = 31.0) -> Path:
    """The first half minute of some files, without a word on what they are."""
    folder.mkdir()
    for name in names:
        head, *lines = gzip.decompress((RECORDED / f"{name}.csv.gz").read_bytes()).decode().splitlines()
        kept = [line for line in lines if float(line.partition(",")[0]) < until]
        (folder / f"{name}.csv").write_text("\n".join([head, *kept]) + "\n")
    return folder


def error(config: Path, name: str) -> float:
    """By how much a frame is turned against the true one [deg]."""
    sensor = pf.FusionConfig.load(config).sensors[name]
    assert sensor.frame is not None
    true = Rotation.from_rotvec(TURNED[name], degrees=True)
    return float(np.degrees((Rotation.from_rotvec(sensor.frame.rotation) * true.inv()).magnitude()))


@pytest.mark.long
def test_init_registers_sensors_in_frames_of_their_own(tmp_path: Path) -> None:
    """Where speeds follow and axes do not, frames are found and written, and ``latency`` says what to do instead."""
    done = pumafuse("init", log(tmp_path / "log", "commands", "mocap", "tracker"), "-o", tmp_path / "found")
    assert done.returncode == 0, done.stderr
    assert "looks to stand in a frame of its own" in done.stdout
    for name in TURNED:
        assert error(tmp_path / "found" / "fusion.toml", name) < 0.35
    late = pumafuse("latency", tmp_path / "found")
    assert late.returncode == 1
    assert "`pumafuse register` finds it" in late.stderr
    assert len(late.stderr.splitlines()) == 1


@pytest.mark.long
def test_fuse_of_such_a_log_is_of_the_tool(tmp_path: Path) -> None:
    """The one command registers, tunes and fuses: the tool is known to half a millimetre about a constant."""
    done = pumafuse("fuse", log(tmp_path / "log", "commands", "tracker"), "-o", tmp_path / "fused")
    assert done.returncode in (0, 3), done.stderr
    assert error(tmp_path / "fused" / "fusion.toml", "tracker") < 0.5
    est = pf.fuse(pf.Run.read(tmp_path / "fused"), pf.FusionConfig.load(tmp_path / "fused" / "fusion.toml"))
    true = pf.Run.read(RECORDED).reference
    assert true is not None
    time = (true.stamp - est.origin) / 1e9
    for axis in "xyz":
        off = est[axis].position - np.interp(est.time, time, true.values[axis])
        assert np.std(off[est.time > 3.0]) < 0.7e-3, axis
