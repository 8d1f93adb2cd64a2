"""A long run fused in pieces is the run fused as a whole."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as papq
import pytest

import pumafuse as pf
from pumafuse.errors import PumafuseError
from pumafuse.fusion.summary import Summary, decode
from pumafuse.logs import tables
from pumafuse.pieces import reading, writing

SECONDS, ORIGIN = 240, 1_700_000_000_000_000_000
CONFIG = """
arm = "arm.toml"
[start]
offset_sd_mm = 2.0
[process.x]
input_noise_mm_rtHz = 0.3
drift_mm_rts = 2.0
disturbance_sd_mm = 0.5
disturbance_time_ms = 500.0
[process.y]
input_noise_mm_rtHz = 0.3
drift_mm_rts = 4.0
maneuver_drift_mm_rts_per_m_s = 5.0
[sensors.tracker]
sd_mm = 0.1
gate = 8.0
[sensors.camera]
sd_mm = 0.5
latency_ms = 45.0
bias_sd_mm = 3.0
gate = 8.0
"""
ARM = """
name = "two delays"
update_period_ms = 28.0
delay_ms = 40.0
[axes.x]
plant = "first-order"
time_constant_ms = 60.0
[axes.y]
plant = "second-order"
natural_frequency_rad_s = 20.0
damping = 0.8
gain = { slope_s_m = 0.05, intercept = 1.01 }
gain_recovery_ms = 100.0
delay_ms = 90.0
"""


def source(rate: float, seed: int, gap: tuple[float, float] | None = None) -> dict[str, np.ndarray]:
    """Rows of two smooth axes with noise, in mm; none in the gap [s]."""
    draw = np.random.default_rng(seed)
    time = np.arange(int(SECONDS * rate)) / rate
    if gap is not None:
        time = time[(time < gap[0]) | (time > gap[1])]
    table = {"t_ns": ORIGIN + np.rint(time * 1e9).astype(np.int64)}
    for axis, turn in (("x", 0.7), ("y", 0.4)):
        table[f"{axis}_mm"] = 40.0 * np.sin(turn * time) + draw.normal(0.0, 0.1, len(time))
    return table


def spoilt(table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The rows with duplicates, rows too late and a little late, outliers, cells without a value."""
    draw = np.random.default_rng(7)
    count = len(table["t_ns"])
    order = np.arange(count)
    for row, places in ((700, 20), (3000, 150), (4100, 600)):  # at 100 Hz: 0.2, 1.5 and 6 s late
        order = np.insert(np.delete(order, row), row + places, row)
    order = np.insert(order, [501, 2504, 9001], order[[500, 2503, 9000]])
    spoilt = {name: column[order] for name, column in table.items()}
    spoilt["x_mm"][draw.choice(count, 40)] += 30.0
    spoilt["y_mm"][draw.choice(count, 40)] = np.nan
    return spoilt


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of four tables: commands with a gap, two sensors, of which one has faults, and a reference."""
    folder = tmp_path_factory.mktemp("long")
    commands = source(1 / 0.028, 1, gap=(100.0, 150.0))
    parts = {
        "command": commands,
        "tracker": spoilt(source(100.0, 2)),
        "camera": source(30.0, 3),
        "reference": source(50.0, 4),
    }
    manifest = []
    for name, table in parts.items():
        papq.write_table(pa.table(table), folder / f"{name}.parquet")
        head = f"[{name}]" if name in ("command", "reference") else f"[sensors.{name}]"
        manifest += [head, f'file = "{name}.parquet"', 'time = "t_ns"', 'x = "x_mm"', 'y = "y_mm"']
    (folder / "run.toml").write_text("\n".join(manifest))
    (folder / "arm.toml").write_text(ARM)
    (folder / "fusion.toml").write_text(CONFIG)
    return folder


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Pieces of some seconds; no warnings."""
    monkeypatch.setattr(reading, "PIECE", 3000)
    monkeypatch.setattr(tables, "_BATCH", 700)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pf.PumafuseWarning)
        yield


def both(run: Path, folder: Path, rate: float | None = None) -> tuple[Summary, Summary]:
    """The run as a whole and in pieces."""
    config = pf.FusionConfig.load(run / "fusion.toml")
    pf.fuse(pf.Run.read(run), config, rate=rate).save(folder / "whole")
    count = len(list(reading.pieces(run, 0, 0)))
    assert count > 5
    writing.fuse_in_pieces(run, config, folder / "pieces", rate=rate)
    whole, in_pieces = (decode((folder / name / "summary.json").read_bytes()) for name in ("whole", "pieces"))
    return whole, in_pieces


@pytest.mark.parametrize("rate", [None, 20.0])
def test_pieces_are_the_whole_to_the_bit(run: Path, tmp_path: Path, rate: float | None) -> None:
    """Late and repeated rows, rejected ones, a gap of the commands: the same estimates and measurements."""
    whole, in_pieces = both(run, tmp_path, rate)
    for name in ("estimates", "measurements", "reference"):
        tables_ = [papq.read_table(tmp_path / kind / f"{name}.parquet") for kind in ("whole", "pieces")]
        assert tables_[0].equals(tables_[1]), name
    assert in_pieces.rows == whole.rows
    assert in_pieces.commands == whole.commands
    assert (in_pieces.estimates, in_pieces.duration_s) == (whole.estimates, whole.duration_s)
    print(whole.rows, whole.notes, in_pieces.notes)
    for axis, one in whole.axes.items():
        other = in_pieces.axes[axis]
        assert other.log_likelihood == pytest.approx(one.log_likelihood, rel=1e-12)
        assert one.score is not None and other.score is not None
        assert other.score.rows == one.score.rows
        assert other.score.left_out == one.score.left_out
        assert other.score.rmse == pytest.approx(one.score.rmse, rel=1e-12)
        assert other.score.nees_mean == pytest.approx(one.score.nees_mean, rel=1e-12)
        for name, sensor in one.sensors.items():
            mine = other.sensors[name]
            assert mine.outcomes == sensor.outcomes
            assert mine.nis_mean == pytest.approx(sensor.nis_mean, rel=1e-12)
            assert mine.innovation_rms == pytest.approx(sensor.innovation_rms, rel=1e-12)
            assert mine.correlation == pytest.approx(sensor.correlation, abs=0.05)
            assert mine.bias == sensor.bias
            print(mine.verdict, sensor.verdict)


def test_a_failed_write_leaves_nothing(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that is full after some pieces leaves neither a folder nor a part of one."""
    calls: list[int] = []

    def full(*_: object) -> None:
        calls.append(1)
        if len(calls) > 8:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(papq.ParquetWriter, "write_table", full)
    with pytest.raises(PumafuseError, match="cannot be written: No space left on device"):
        writing.fuse_in_pieces(run, pf.FusionConfig.load(run / "fusion.toml"), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
