"""The command line on a log that somebody got wrong: one line, exit code 1, no folder; or a warning before all."""

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pytest

from executable import pumafuse, refused
from pumafuse.arrays import FloatArray
from tuning_runs import later

MY_RUN = Path(__file__).parents[2] / "examples/my-run"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return Path(shutil.copytree(MY_RUN, tmp_path / "log"))


def edit(path: Path, *changes: tuple[str, str]) -> None:
    text = path.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")


def fuse(log: Path) -> tuple[object, ...]:
    return "fuse", log, "-c", log / "fusion.toml", "-o", log / "result"


WRONG = {
    "m called mm": ("robot.csv", [("_target_m", "_target_mm")], ["moves 1000 times", "mm called m"]),
    "us called ns": ("robot.csv", [("stamp_us", "stamp_ns")], ["every 2.8e-05 s", "us that are called ns"]),
    "camera's us called ms": ("camera.csv", [("arrived_us", "arrived_ms")], ["camera.csv", "2115"]),
    "misspelt": ("run.toml", [("sensors.camera", "sensors.camra")], ["'camra' has 913 unknown", "'camera'"]),
    "another year": ("camera.csv", [("\n179", "\n176")], ["nothing was fused", "'camera' has 913 before_start"]),
}


@pytest.mark.parametrize(("name", "changes", "words"), WRONG.values(), ids=WRONG.keys())
def test_what_would_be_wrong_by_construction_is_refused(
    log: Path, name: str, changes: list[tuple[str, str]], words: list[str]
) -> None:
    """In one line that names what is wrong; nothing is written."""
    for table in ("run.toml", name) if name != "run.toml" else ("run.toml",):
        text = (log / table).read_text(encoding="utf-8")
        edit(log / table, *[(old, new) for old, new in changes if old in text])
    line = refused(*fuse(log))
    assert all(word in line for word in words), line
    assert not (log / "result").exists()


def test_what_is_inferred_is_told_before_the_result_and_kept_in_it(log: Path) -> None:
    """Exchanged columns: the first warning, the first note of the summary, exit code 0."""
    edit(log / "run.toml", ('\nx = "x_mm"', '\nx = "z_mm"'), ('\nz = "z_mm"', '\nz = "x_mm"'))
    done = pumafuse(*fuse(log))
    first, summary = done.stderr.splitlines()[0], json.loads((log / "result/summary.json").read_text(encoding="utf-8"))
    assert "are its columns exchanged in run.toml?" in first and summary["notes"][0] in first


def swings(time: FloatArray) -> FloatArray:
    """A motion [deg] that is not periodic."""
    return 30.0 * np.sin(1.1 * time) + 14.0 * np.sin(2.7 * time + 0.4)


@pytest.mark.long
@pytest.mark.parametrize("early", [0.05, later(0.31)])
def test_of_what_moves_before_its_commands_no_lag_is_told(early: float, tmp_path: Path) -> None:
    """Fuse and latency refuse it in one line; with the shift_s that this names its lag is the guess."""
    time = np.arange(0.0, 30.0, 0.02)
    measured = swings(time + early) + np.random.default_rng(4).normal(0.0, 0.02, len(time))
    columns = {"t_s": time, "goal_j_deg": swings(time), "encoder_j_deg": measured}
    pacsv.write_csv(pa.table(columns), tmp_path / "wrist.csv")
    line = refused("fuse", tmp_path / "wrist.csv", "-o", tmp_path / "fused")
    assert "moves before its commands" in line and "shift_s" in line and line.endswith("writes one)")
    folder = tmp_path / "folder"
    pumafuse("init", tmp_path / "wrist.csv", "-o", folder)
    assert "no lag can be told" in refused("latency", folder)
    assert "writes one" not in refused("fuse", folder, "-o", tmp_path / "fused")  # it is there
    head, _, tail = (folder / "run.toml").read_text(encoding="utf-8").partition("[sensors.")
    shift = re.search(r"shift_s = ([\d.]+)", line)
    tail = tail.replace('time = "t_s"', f'time = {{ column = "t_s", {shift[0]} }}')
    (folder / "run.toml").write_text(f"{head}[sensors.{tail}", encoding="utf-8")
    told = json.loads(pumafuse("latency", folder, "--json").stdout)["axes"]["j"]
    assert told["lag_ms"] == pytest.approx(90.0, abs=5.0)  # behind the held command: T/2 less than behind their path


@pytest.mark.parametrize("described", [True, later(False)])
def test_an_axis_that_moves_before_its_commands_does_not_refuse_the_others(described: bool, tmp_path: Path) -> None:
    """It is left out, and said to be; where run.toml describes it, it goes by its commands, and has no lag.

    Neither has it the lag of the delay that the others share.
    """
    time, rng = np.arange(0.0, 10.0, 0.02), np.random.default_rng(6)
    columns = {"t_s": time}
    for axis, late, slower in (("a", 0.09, 1.0), ("b", -0.12, 0.83), ("c", 0.09, 1.21)):
        columns |= {f"goal_{axis}_deg": swings(slower * time)}
        columns |= {f"encoder_{axis}_deg": swings(slower * (time - late)) + rng.normal(0.0, 0.02, len(time))}
    log = tmp_path / "two.csv"
    pacsv.write_csv(pa.table(columns), log)
    if described:
        log = tmp_path / "run.toml"
        sources = [
            f'[{table}]\nfile = "two.csv"\ntime = "t_s"\na = "{name}_a_deg"\nb = "{name}_b_deg"\nc = "{name}_c_deg"\n'
            for table, name in (("command", "goal"), ("sensors.encoder", "encoder"))
        ]
        log.write_text('name = "two"\n' + "".join(sources), encoding="utf-8")
    done = pumafuse("fuse", log, "-o", tmp_path / "fused")
    assert "b: it moves 120 ms before its commands" in " ".join(done.stdout.split())
    axes = json.loads((tmp_path / "fused/summary.json").read_text(encoding="utf-8"))["axes"]
    assert axes["a"]["sensors"]["encoder"]["outcomes"]["fused"] == len(time)
    assert set(axes) == ({"a", "b", "c"} if described else {"a", "c"})
    assert "lag of b" not in done.stdout and (
        not described or axes["b"]["sensors"]["encoder"]["outcomes"].get("fused", 0) == 0
    )


@pytest.mark.parametrize("others", [True, later(False)])
def test_an_axis_that_follows_nothing_does_not_refuse_the_others(others: bool, tmp_path: Path) -> None:
    """Described, it is left out, and why is said; alone, it is refused with the same sentence."""
    time, rng = np.arange(0.0, 10.0, 0.02), np.random.default_rng(9)
    columns, lines = {"t_s": time}, dict[str, str]()
    for axis, slower in (("tilt", 0.9), ("lift", 1.1))[: 1 + others]:
        late = swings(slower * (time - 0.07))
        if axis == "tilt":  # motion of its own
            late = np.interp(time, np.arange(0.0, 16.0, 0.4), 0.3 * np.std(late) * rng.normal(size=40))
        columns |= {f"goal_{axis}_deg": swings(slower * time)}
        columns |= {f"gyro_{axis}_deg": late + rng.normal(0.0, 0.02, len(time))}
    pacsv.write_csv(pa.table(columns), tmp_path / "arm.csv")
    for table, name in (("command", "goal"), ("sensors.gyro", "gyro")):
        axes = "\n".join(f'{one[5:-4]} = "{name}{one[4:]}"' for one in columns if one.startswith("goal"))
        lines[table] = f'[{table}]\nfile = "arm.csv"\ntime = "t_s"\n{axes}\n'
    (tmp_path / "run.toml").write_text('name = "arm"\n' + "".join(lines.values()), encoding="utf-8")
    what = ("fuse", tmp_path / "run.toml", "-o", tmp_path / "fused")
    why = "sensor 'gyro' does not follow the commands of tilt (correlation "
    if not others:
        assert why in pumafuse(*what, code=1).stderr
        return
    said = " ".join(pumafuse(*what).stdout.split())
    assert f"left out: {why}" in said and " with the model)" in said
    axes = json.loads((tmp_path / "fused/summary.json").read_text(encoding="utf-8"))["axes"]
    assert axes["lift"]["sensors"]["gyro"]["outcomes"]["fused"] == len(time)
    assert "gyro" not in axes["tilt"]["sensors"] or not axes["tilt"]["sensors"]["gyro"]["outcomes"].get("fused", 0)


def test_an_exception_that_nobody_foresaw_is_a_line_for_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It names what was being read, the exception, where it happened and what to send; exit code 70."""

    def broken(*_: object) -> None:
        raise ZeroDivisionError("float division\nby zero")

    monkeypatch.setattr("pumafuse.discovery.contents._part", broken)
    for name in ("command", "encoder"):
        (tmp_path / f"{name}.csv").write_text("time_s,x_mm\n0,1\n1,2\n")
    done = pumafuse("fuse", tmp_path, "-o", tmp_path / "out", code=70)
    (line,) = done.stderr.splitlines()
    assert f"fuse {tmp_path} -o {tmp_path / 'out'}: unexpected ZeroDivisionError: float division by zero" in line
    assert f"reading {tmp_path / 'command.csv'}." in line
    assert "please report it with this line and the log" in line and "discovery/contents.py:" in line
    assert done.stdout == "" and not (tmp_path / "out").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes here")
def test_a_pipe_that_nobody_writes_into_is_refused_at_once(tmp_path: Path) -> None:
    """Reading it would wait for ever."""
    os.mkfifo(pipe := tmp_path / "log.mcap")
    why = "a pipe or a device, which may never end; write it into a file first"
    assert refused("latency", pipe) == f"pumafuse: {pipe}: {why}"
