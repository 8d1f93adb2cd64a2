"""A long run fused in pieces is the run fused as a whole."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as papq
import pytest
from typer.testing import CliRunner

import pumafuse as pf
from pumafuse.cli.main import app
from pumafuse.errors import PumafuseError
from pumafuse.fusion import results
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
[sensors.range]
sd_mm = 0.3
latency_ms = -5.0
bias_sd_mm = 2.0
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
    commands, late = source(1 / 0.028, 1, gap=(100.0, 150.0)), source(20.0, 5, gap=(-1.0, 60.0))
    some = {"command": commands, "tracker": spoilt(source(100.0, 2)), "camera": source(30.0, 3), "range": late}
    return written(tmp_path_factory.mktemp("long"), some | {"reference": source(50.0, 4)})


def written(folder: Path, parts: dict[str, dict[str, np.ndarray]]) -> Path:
    """A run folder of a Parquet table for each source, and its configuration."""
    manifest: list[str] = []
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
    assert_same_tables(tmp_path)
    assert in_pieces.rows == whole.rows
    assert in_pieces.commands == whole.commands
    assert (in_pieces.estimates, in_pieces.duration_s) == (whole.estimates, whole.duration_s)
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
            assert mine.correlation == pytest.approx(sensor.correlation, abs=0.1)  # pieces of some hundred
            assert mine.bias == sensor.bias


def test_one_table_with_all_sources(tmp_path: Path) -> None:
    """Commands, a sensor and a reference in the columns of one table, at the rate of the sensor."""
    table = source(100.0, 2)
    held = np.arange(len(table["t_ns"])) % 3 == 0
    columns = {"time_ns": table["t_ns"], "tracker.x_mm": table["x_mm"], "reference.x_mm": source(100.0, 3)["x_mm"]}
    columns["command.x_mm"] = np.where(held, source(100.0, 4)["x_mm"], np.nan)
    papq.write_table(pa.table(columns), tmp_path / "log.parquet")
    (tmp_path / "arm.toml").write_text(ARM)
    (tmp_path / "fusion.toml").write_text(CONFIG)
    config = pf.FusionConfig.load(tmp_path / "fusion.toml")
    pf.fuse(pf.Run.read(tmp_path / "log.parquet"), config).save(tmp_path / "whole")
    writing.fuse_in_pieces(tmp_path / "log.parquet", config, tmp_path / "pieces")
    assert_same_tables(tmp_path)


def test_stray_stamps_are_taken_for_none(tmp_path: Path) -> None:
    """A stray stamp of a command and of a sensor: the estimates of the whole, and its counts."""
    parts = {"command": source(1 / 0.028, 1), "tracker": source(100.0, 2)}
    parts["command"]["t_ns"][4000] += 3600 * 10**9
    parts["command"]["t_ns"][5000] -= 3600 * 10**9
    parts["tracker"]["t_ns"][9000] += 3600 * 10**9
    run = written(tmp_path, parts)
    whole, in_pieces = both(run, tmp_path)
    assert_same_tables(tmp_path, "estimates")
    assert in_pieces.rows == whole.rows
    assert in_pieces.commands == whole.commands
    assert (whole.rows["tracker"]["stray"], whole.commands["stray"]) == (1, 2)


def test_rows_far_behind_are_counted(tmp_path: Path) -> None:
    """A sensor that sends rows of a minute ago: too late, as in the whole; the others are fused as they are there."""
    parts = {"command": source(1 / 0.028, 1), "tracker": source(100.0, 2)}
    again = np.concatenate([np.arange(15_000), np.arange(9_000, 9_500), np.arange(15_000, 24_000)])
    parts["tracker"] = {name: column[again] for name, column in parts["tracker"].items()}
    parts["tracker"]["x_mm"] += np.arange(len(again)) * 1e-9  # no row is a duplicate
    whole, in_pieces = both(written(tmp_path, parts), tmp_path)
    assert_same_tables(tmp_path, "estimates")
    assert in_pieces.rows == whole.rows
    assert in_pieces.rows["tracker"]["too_late"] == 500
    assert any("not in measurements.parquet" in note for note in in_pieces.notes)


def assert_same_tables(folder: Path, *names: str) -> None:
    """The tables of the run as a whole and in pieces have the same bits."""
    for name in names or ("estimates", "measurements", "reference"):
        whole, in_pieces = (papq.read_table(folder / kind / f"{name}.parquet") for kind in ("whole", "pieces"))
        assert whole.equals(in_pieces), name


def test_what_needs_the_whole_run_is_refused(tmp_path: Path) -> None:
    """A clock that was set back, one of the grid, a cylindrical frame, tables that are not sorted: a line each."""
    parts = {"command": source(1 / 0.028, 1), "tracker": source(100.0, 2)}
    back = {name: column.copy() for name, column in parts["command"].items()}
    back["t_ns"][5000:] -= 30 * 10**9
    assert_refused(written(tmp_path, parts | {"command": back}), "command.parquet: the clock is set back")
    run = written(tmp_path, parts)
    manifest = (run / "run.toml").read_text()
    (run / "run.toml").write_text(manifest.replace("[command]", '[command]\nclock = "regular"'))
    assert_refused(run, "clock = 'regular', which asks for the whole run")
    (run / "run.toml").write_text(f'{manifest}\n[frame]\nkind = "cylindrical"\nbase_mm = [0.0, 0.0]\n')
    assert_refused(run, "cylindrical .frame., which asks for the whole run")


def assert_refused(run: Path, line: str) -> None:
    """The run is refused with a line, and nothing is left."""
    with pytest.raises(PumafuseError, match=line):
        writing.fuse_in_pieces(run, pf.FusionConfig.load(run / "fusion.toml"), run / "out")
    assert not [path for path in run.iterdir() if "out" in path.name]


@pytest.mark.parametrize("option", ["--smooth", "--as-live", "--rrd", "--figures", "--from 3", "--engine filterpy"])
def test_options_that_need_the_whole_run_are_refused(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    """A long run is not fused with them; the line says how many rows are too many."""
    monkeypatch.setattr(writing, "MOST_IN_MEMORY", 10_000)
    arguments = ["fuse", str(run), "-c", str(run / "fusion.toml"), "-o", str(tmp_path / "out"), *option.split()]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 1
    assert f"{option.split()[0]} does not go with" in " ".join(str(result.exception or result.output).split())
    assert not (tmp_path / "out").exists()


def test_the_command_line_takes_a_long_run_in_pieces(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the number of its rows alone; what it writes is a result folder like any other."""
    monkeypatch.setattr(writing, "MOST_IN_MEMORY", 10_000)
    arguments = ["fuse", str(run), "-c", str(run / "fusion.toml"), "-o", str(tmp_path / "out"), "--rate", "20"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert results.read(tmp_path / "out").summary.notes[-1].startswith("fused in ")


def test_progress_is_the_share_of_rows(run: Path, tmp_path: Path) -> None:
    """It rises from piece to piece to 1."""
    shares: list[float] = []
    config = pf.FusionConfig.load(run / "fusion.toml")
    writing.fuse_in_pieces(run, config, tmp_path / "out", progress=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert len(shares) > 5


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


def long_run(folder: Path, rows: int) -> Path:
    """A run of one axis at 1 kHz with a command every 28 ms, written some rows at a time."""
    folder.mkdir()
    for name, period, noise in (("command", 28_000_000, 0.0), ("tracker", 1_000_000, 0.1)):
        count, writer = rows * 1_000_000 // period, None
        for begin in range(0, count, 1_000_000):
            time = np.arange(begin, min(begin + 1_000_000, count)) * period
            value = 40.0 * np.sin(7e-10 * time) + np.random.default_rng(begin).normal(0.0, noise, len(time))
            table = pa.table({"t_ns": ORIGIN + time, "x_mm": value})
            writer = writer or papq.ParquetWriter(folder / f"{name}.parquet", table.schema)
            writer.write_table(table)
        assert writer is not None
        writer.close()
    source = 'file = "{0}.parquet"\ntime = "t_ns"\nx = "x_mm"\n'
    manifest = f"[command]\n{source.format('command')}[sensors.tracker]\n{source.format('tracker')}"
    (folder / "run.toml").write_text(manifest)
    (folder / "arm.toml").write_text(ARM[: ARM.index("[axes.y]")])
    (folder / "fusion.toml").write_text(
        'arm = "arm.toml"\n[process.x]\ndrift_mm_rts = 2.0\n[sensors.tracker]\nsd_mm = 0.1\n'
    )
    return folder


@pytest.mark.long
def test_memory_does_not_grow_with_the_run(tmp_path: Path) -> None:
    """Ten million rows take the memory of five million."""
    program = (
        "import resource, sys, warnings; from pathlib import Path; import pumafuse as pf\n"
        "from pumafuse.pieces.writing import fuse_in_pieces; warnings.simplefilter('ignore')\n"
        "run = Path(sys.argv[1])\n"
        "fuse_in_pieces(run, pf.FusionConfig.load(run / 'fusion.toml'), run / 'out')\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    peaks: list[int] = []
    for millions in (5, 10):
        run = long_run(tmp_path / str(millions), millions * 1_000_000)
        done = subprocess.run([sys.executable, "-c", program, str(run)], capture_output=True, text=True, check=True)
        peaks.append(int(done.stdout))
    assert peaks[1] < 1.2 * peaks[0]
