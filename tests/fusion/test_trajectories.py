"""Trajectories in the TUM format: what evo, or anyone who splits lines at blanks, reads from them."""

from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from executable import pumafuse
from pumafuse.fusion import results

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
START_NS = 1_700_000_000_123_456_789


def _configured(axes: str, **more: object) -> pf.FusionConfig:
    plant = {"plant": "first-order", "time_constant_ms": 40.0}
    arm = {"name": "cell", "update_period_ms": 20.0, "delay_ms": 30.0, "axes": dict.fromkeys(axes.split(), plant)}
    return pf.FusionConfig.parse({"arm": arm, "sensors": {"camera": {"sd_mm": 1.0}}, **more})


def _recorded(axes: str = "x y z") -> pf.Run:
    time = START_NS + 20_000_000 * np.arange(100)
    turn = 1.0 - np.cos(np.arange(100) / 20)
    paths = {axis: 0.3 + 0.1 * k * turn for k, axis in enumerate(axes.split(), 1)}
    return pf.Run.from_arrays(time, paths, {"camera": (time + 1, paths)}, (time + 7, paths))


def _read(path: Path) -> tuple[list[int], np.ndarray]:
    """Stamps [ns], and the seven numbers of each line."""
    lines = [line.split(" ") for line in path.read_text().splitlines()]
    return [int(Decimal(line[0]) * 10**9) for line in lines], np.array([list(map(float, line[1:])) for line in lines])


def test_a_trajectory_has_every_digit_of_stamps_and_positions(tmp_path: Path) -> None:
    """Stamps are the log's own to the ns, positions are the estimates bit for bit in m, and nothing is turned."""
    est = pf.fuse(_recorded(), _configured("x y z"))
    est.to_tum(tmp_path / "fused.tum")
    stamps, numbers = _read(tmp_path / "fused.tum")
    assert stamps == [START_NS + round(time * 1e9) for time in est.time]
    assert np.array_equal(numbers[:, :3], np.column_stack([est[axis].position for axis in "xyz"]))
    assert np.array_equal(numbers[:, 3:], np.tile([0.0, 0.0, 0.0, 1.0], (len(est.time), 1)))


def test_with_a_frame_the_trajectories_are_in_the_coordinates_of_the_log(tmp_path: Path) -> None:
    """The reference, which is scored in the arm's axes, comes back to within rounding, also from a result folder."""
    config = _configured("tangential radial vertical", frame={"kind": "rotated", "azimuth_deg": 30.0})
    run = _recorded()
    results.write(pf.fuse(run, config), tmp_path / "fused", force=False)
    assert "trajectories written to " in pumafuse("compare", tmp_path / "fused", "--tum", tmp_path / "out").stdout
    stamps, numbers = _read(tmp_path / "out" / "fused.reference.tum")
    assert stamps == [START_NS + 7 + 20_000_000 * k for k in range(100)]
    truth = np.column_stack([run.reference.values[axis] for axis in "xyz"])
    assert np.abs(numbers[:, :3] - truth).max() < 1e-12
    _, estimated = _read(tmp_path / "out" / "fused.tum")
    assert np.abs(estimated[:, :3] - truth).max() < 0.1
