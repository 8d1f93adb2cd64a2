"""`pumafuse init` by the command line, and `fuse` without a configuration."""

import json
import math
import re
import shlex
import shutil
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pytest
import typer

import pumafuse as pf
from executable import DATA, names, pumafuse, refused
from pumafuse.cli import from_log
from pumafuse.discovery.survey import survey
from pumafuse.filter.response import response

EXAMPLES = Path(__file__).parents[2] / "examples"


def scores(folder: Path) -> dict[str, float]:
    """RMSE of each axis, in its unit."""
    summary = json.loads((folder / "summary.json").read_text())
    return {
        axis: next(value for key, value in part["score"].items() if key.startswith("rmse_"))
        for axis, part in summary["axes"].items()
        if part["score"]
    }


@pytest.mark.long
def test_one_command_fuses_the_shipped_scan_to_a_tenth_of_a_millimetre(tmp_path: Path) -> None:
    """Half of it, without its run.toml: three sensors, one mirrored, a command that is a sum. Its error bars hold."""
    log = tmp_path / "scan"
    shutil.copytree(DATA / "scan1", log)
    (log / "run.toml").unlink()
    pumafuse("fuse", log, "-o", tmp_path / "fused", "--to", 30)
    found = scores(tmp_path / "fused")
    assert set(found) == {"x", "y", "z"}
    assert max(found.values()) < 0.15, found  # mm; the camera's noise is 0.5, and it is 45 ms late at 60 mm/s
    summary = json.loads((tmp_path / "fused" / "summary.json").read_text())
    for axis in summary["axes"].values():
        assert axis["score"]["coverage"] > 0.9


def test_one_command_looks_fits_and_fuses(tmp_path: Path) -> None:
    """Tables that nothing describes: what it found, fitted and fused is said; its folder is a run for every command."""
    log = tmp_path / "log"
    log.mkdir()
    for name in ("robot.csv", "camera.csv"):
        shutil.copy(EXAMPLES / "my-run" / name, log)
    out = pumafuse("fuse", log, "-o", tmp_path / "fused", "--figures").stdout
    lines = [line.split() for line in out.splitlines()]
    assert ["camera.csv", "913", "29.74"] in [line[:3] for line in lines]
    (lag,) = [line for line in lines if line[:4] == ["lag", "of", "x,", "ms"]]
    assert 130.0 < float(lag[5]) < 145.0
    assert "the latency of camera is taken to be 0 ms, not found" in " ".join(out.split())
    assert {"run.toml", "arm.toml", "fusion.toml", "summary.json", "fused.png"} < names(tmp_path / "fused")
    summary = json.loads((tmp_path / "fused" / "summary.json").read_text())
    assert summary["run"] == "log"
    found = {axis: part["sensors"]["camera"]["finding"] for axis, part in summary["axes"].items()}
    assert set(found.values()) == {"untested"}  # the simulated arm strays, and the camera is alone
    again = tmp_path / "again"
    pumafuse("fuse", tmp_path / "fused", "-c", tmp_path / "fused" / "fusion.toml", "-o", again)
    assert (again / "estimates.parquet").read_bytes() == (tmp_path / "fused" / "estimates.parquet").read_bytes()


@pytest.mark.long
def test_every_command_says_how_a_table_of_other_names_is_described(tmp_path: Path) -> None:
    """And that works, word for word."""
    time = 0.02 * np.arange(500)
    target = 30.0 * np.sin(2.0 * np.pi * 0.4 * time) * np.sin(0.9 * time)
    actual = target[:-8] + np.random.default_rng(5).normal(0.0, 0.1, 492)
    log = tmp_path / "mine's.csv"
    pacsv.write_csv(pa.table({"stamp_s": time[8:], "target_deg": target[8:], "actual_deg": actual}), log)
    said = refused("latency", log)
    (advice,) = re.findall("`pumafuse (.*?)`", said)
    pumafuse(*shlex.split(advice), "-o", tmp_path / "mine")
    assert "ms late" in pumafuse("latency", tmp_path / "mine").stdout


def test_a_result_with_a_run_toml_stays_unless_it_is_made_anew(tmp_path: Path) -> None:
    """Else the run would be lost to who fuses it into its own folder; nothing is fitted before that is clear."""
    mine, config = tmp_path / "mine", EXAMPLES / "my-run" / "fusion.toml"
    pumafuse("fuse", EXAMPLES / "my-run", "-c", config, "-o", mine)
    (mine / "run.toml").write_text("[command]")
    assert "holds 'run.toml', which is not ours" in refused(
        "fuse", EXAMPLES / "my-run", "-c", config, "-o", mine, "--force"
    )
    assert "mine: exists; --force replaces it" in refused("fuse", EXAMPLES / "my-run", "-o", mine)


def exit_code_here(folder: Path) -> int:
    """How `fuse` of the example ends in this process, where not by itself."""
    with pytest.raises(typer.Exit) as ended:
        from_log.run(EXAMPLES / "my-run", folder, None, None, "filtered", [], "compiled", False, (None, 15.0))
    return ended.value.exit_code


@pytest.mark.long
def test_one_command_fuses_with_the_best_until_ctrl_c(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As `tune` keeps it; the exit code says so."""

    @contextmanager
    def impatient() -> Generator[Callable[[str, float], None]]:
        calls = count()

        def progress(_what: str, _log_likelihood: float) -> None:
            if next(calls) == 20:  # late in the search
                raise KeyboardInterrupt

        yield progress

    monkeypatch.setattr(from_log, "fitting", impatient)
    with pytest.warns(pf.PumafuseWarning, match="interrupted: these are the best"):
        assert exit_code_here(tmp_path) == 130
    assert {"run.toml", "summary.json"} < names(tmp_path)


@pytest.mark.long
def test_one_command_says_that_the_fit_is_worse_as_tune_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Than the first guess, on the last third of the log: exit code 3, and the result is there."""

    def worse(*given: Any, **how: Any) -> pf.Tuning:
        found = pf.tune(*given, **how)
        return replace(found, details=msgspec.structs.replace(found.details, worse=True))

    monkeypatch.setattr(from_log, "tune", worse)
    assert exit_code_here(tmp_path) == 3
    assert {"run.toml", "summary.json"} < names(tmp_path)


@pytest.mark.long
def test_one_command_says_where_no_arm_was_found(tmp_path: Path) -> None:
    """An encoder that is at each command in the same row; with commands that are gone on from, as is advised, it is."""
    rng, time = np.random.default_rng(1), 0.1 * np.arange(300)
    command = np.sin(0.2 * time) + rng.normal(0.0, 0.055, 300)
    columns = {"t_s": time, "told_rad": command, "seen_rad": command + rng.normal(0.0, 0.02, 300)}
    pacsv.write_csv(pa.table(columns), tmp_path / "log.csv")
    described = """
        [command]
        file = "../log.csv"
        time = "t_s"
        j = "told_rad"
        {}
        [sensors.encoder]
        file = "../log.csv"
        time = "t_s"
        j = "seen_rad"
    """
    log, out = tmp_path / "log", tmp_path / "fused"
    log.mkdir()
    (log / "run.toml").write_text(described.format(""))
    done = pumafuse("fuse", log, "-o", out, code=3)
    (line,) = [one for one in done.stdout.splitlines() if "no arm was found by which j follows" in one]
    told = re.search(r"j: encoder is ([\d.]+) deg off the path .* predicts it to ([\d.]+):", line)
    assert told and float(told[1]) == pytest.approx(np.degrees(0.02), rel=0.1)
    assert float(told[2]) > 2.0 * float(told[1])
    assert {"run.toml", "summary.json"} < names(out)
    (log / "run.toml").write_text(described.format("interpolation_ms = 10"))
    done = pumafuse("fuse", log, "-o", out, "--force")
    assert "no arm was found" not in done.stdout


def smoothed(z: np.ndarray, s: np.ndarray) -> np.ndarray:
    """By a low-pass of 50 ms."""
    found = z.copy()
    for row in range(1, len(z)):
        found[row] += (found[row - 1] - found[row]) * np.exp(-(s[row] - s[row - 1]) / 0.05)
    return found


def lasting(z: np.ndarray, s: np.ndarray) -> np.ndarray:
    """With a noise of 0.3 mm that lasts for 0.2 s."""
    random, wander = np.random.default_rng(1), 0.0
    found = z.copy()
    for row in range(1, len(z)):
        keep = np.exp(-(s[row] - s[row - 1]) / 0.2)
        wander = keep * wander + random.normal(0.0, 3e-4 * np.sqrt(1.0 - keep**2))
        found[row] += wander
    return found


@pytest.mark.long
@pytest.mark.parametrize("fault", [None, smoothed, lasting])
def test_one_command_says_what_one_sensor_alone_does_not_show(
    tmp_path: Path, fault: Callable[[np.ndarray, np.ndarray], np.ndarray] | None
) -> None:
    """Where its values are filtered or its noise lasts the arm seems to stray, and error bars are too small.

    The innovations are as expected then, and yet not "consistent". White noise alone has no such line.
    """
    t, s = np.arange(0.0, 15.0, 0.028), np.arange(0.2, 15.0, 0.01)
    u = 0.05 * np.sin(1.3 * t) + 0.02 * np.sin(3.1 * t)
    plant = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.05))
    given, valid = (np.rint(one * 1e9).astype(np.int64) for one in (t, s))
    led = response(plant, 0.028, 0.06, given, u, 0.0, valid)
    seen = led + np.random.default_rng(0).normal(0.0, 2e-4, len(s))
    for name, time, value in (("commands", t, u), ("tracker", s, fault(seen, s) if fault else seen)):
        pacsv.write_csv(pa.table({"t_s": time, "x_mm": 1e3 * value}), tmp_path / f"{name}.csv")
    said = pumafuse("fuse", tmp_path, "-o", tmp_path / "out").stdout
    assert ("tracker alone measures x: what strays there is taken for the arm" in said) is (fault is not None)
    told = json.loads((tmp_path / "out" / "summary.json").read_text())["axes"]["x"]["sensors"]["tracker"]
    assert told["finding"] == ("untested" if fault else "consistent")
    assert told["verdict"].endswith(": untested" if fault else ": consistent")


@pytest.mark.parametrize(
    ("first", "fitted", "play", "said"),
    [
        *((118.0, 40.0, 0.0, True), (10.0, 45.0, 0.0, False), (118.0, 373.0, 1e-4, True), (118.0, 373.0, 5e-2, False)),
    ],
)
def test_a_lag_far_from_that_of_the_first_look_is_not_to_be_trusted(
    first: float, fitted: float, play: float, said: bool
) -> None:
    """As of an arm that sticks and was fitted as a slow one, or a quick one; not where a few ms are many times others.

    What has so much play that this explains it lags otherwise with each motion.
    """
    found = survey(EXAMPLES / "my-run")
    axes = {axis: pf.AxisModel(plant=pf.FirstOrder(time_constant=0.05), play=play) for axis in found.run.axes}
    arm = pf.ArmModel(name="arm", update_period=0.028, delay=0.06, axes=axes)
    lags = {"x": pf.FittedLag(before_ms=first, lag_ms=fitted, lag_ms_ci95=(None, None))}
    text = "".join(from_log.otherwise_than_at_first(found, lags, arm))
    assert text.startswith(f"do not trust the lag of x ({first:.0f} ms at the first look, {fitted:.0f} fitted)") is said
    assert bool(text) is said


def test_one_command_is_for_one_log(tmp_path: Path) -> None:
    """Several runs need one configuration."""
    done = pumafuse("fuse", EXAMPLES / "my-run", *[EXAMPLES / "trunk-servo" / "0g"], "-o", tmp_path / "out", code=2)
    assert "--config: is needed for several runs, and to --resume" in " ".join(done.stderr.split())


@pytest.mark.long
def test_first_guesses_for_a_real_robot_are_better_than_its_camera(tmp_path: Path) -> None:
    """Angles, 0.3° of camera noise five times a second: the camera, held, is 2.2 to 6.5° off (README)."""
    made = tmp_path / "made"
    pumafuse("init", EXAMPLES / "trunk-servo" / "0g", "-o", made)
    pumafuse("fuse", made, "-c", made / "fusion.toml", "-o", tmp_path / "fused")
    found = scores(tmp_path / "fused")
    assert len(found) == 6
    assert max(found.values()) < 2.0, found  # as found: 0.6 to 1.6; after tune 0.5 to 0.8


def test_files_that_are_there_stay_unless_forced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line says which; other files in the folder, which is called after the log, do not matter."""
    monkeypatch.chdir(tmp_path)
    made = Path("my-run-fusion")
    made.mkdir()
    (made / "notes.txt").write_text("mine")
    (made / "arm.toml").write_text("mine")
    text = refused("init", EXAMPLES / "my-run")
    assert text.endswith("has arm.toml already; --force replaces it, or choose another folder")
    assert names(made) == {"notes.txt", "arm.toml"}
    pumafuse("init", EXAMPLES / "my-run", "--force")
    assert names(made) == {"notes.txt", "run.toml", "arm.toml", "fusion.toml"}


def undecided(folder: Path, *names: str) -> tuple[Path, np.ndarray]:
    """A log of an arm that settles with 60 ms, and a sine, in columns that are called as asked."""
    rng, t = np.random.default_rng(4), np.arange(0.0, 30.0, 0.028)
    told = np.cumsum(rng.normal(0.0, 3.0, len(t)) * (rng.random(len(t)) < 0.1))
    left, at = math.exp(-0.028 / 0.06), 0.0
    seen = np.array([at := left * at + (1.0 - left) * before for before in np.append(0.0, told[:-1])])
    columns = {"t": t, **dict(zip(names, (told, seen + rng.normal(0.0, 0.1, len(t)), np.sin(t)), strict=True))}
    pacsv.write_csv(pa.table({name: value.round(3) for name, value in columns.items()}), folder / "log.csv")
    return folder / "log.csv", t


def without_marks(text: str, table: str, *lines: str) -> str:
    """A run.toml, with lines of a table that are comments no longer."""
    head, header, body = text.partition(f"\n[{table}]")
    mine, rest, others = body.partition("\n\n")
    for line in lines:
        assert f"\n# {line}" in mine
        mine = mine.replace(f"\n# {line}", f"\n{line}")
    return f"{head}{header}{mine}{rest}{others}"


def test_of_a_loop_of_speeds_the_sketch_has_what_measures(tmp_path: Path) -> None:
    """What is no position by its name is written down beside commands, too: named as a sensor, it is fused."""
    log, _ = undecided(tmp_path, "setpoint", "wheel_speed", "battery")
    made = tmp_path / "made"
    refused("init", log, "-o", made)
    text = (made / "run.toml").read_text()
    assert '# wheel_speed = "wheel_speed"' in text
    used = ['file = "../log.csv"', 'time = { column = "t", unit = "s" }']
    used = ["[sensors.wheel]", *used, 'position = { column = "wheel_speed", unit = "mm" }', ""]
    (made / "run.toml").write_text(text + "\n".join(used))
    pumafuse("fuse", made, "-o", tmp_path / "fused")
    tuned = pf.FusionConfig.load(tmp_path / "fused" / "fusion.toml").arm
    assert tuned.lag_of("position") == pytest.approx(0.06, abs=3e-3)


@pytest.mark.long
def test_a_table_that_does_not_say_who_is_who_is_written_down_and_sorted(tmp_path: Path) -> None:
    """What is refused is fused when the advice is followed: two lines are taken, and axes are called the same."""
    log, _ = undecided(tmp_path, "north", "south", "up")
    line = refused("fuse", log, "-o", tmp_path / "fused")
    assert "which numbers are the commands" in line and line.endswith(f"`pumafuse init {log}` writes one to sort")
    made = tmp_path / "made"
    line = refused("init", log, "-o", made)
    assert line.endswith(f"written to {made / 'run.toml'}: sort it, then `pumafuse fuse {made} -o DIR`")
    assert names(made) == {"run.toml"}
    text = (made / "run.toml").read_text()
    assert "# up = " in text
    assert "[command] names no column" in refused("fuse", made, "-o", tmp_path / "fused")
    text = without_marks(without_marks(text, "command", "north"), "sensors.measured", "south")
    (made / "run.toml").write_text(text.replace("\nsouth = ", "\nnorth = "))
    pumafuse("fuse", made, "-o", tmp_path / "fused")
    tuned = pf.FusionConfig.load(tmp_path / "fused" / "fusion.toml").arm
    assert tuned.lag_of("north") == pytest.approx(0.06, abs=3e-3)
