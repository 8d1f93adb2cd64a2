"""`pumafuse simulate` and many runs at a time: real executable, real files, real signals."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

import pumafuse as pf
from executable import EXECUTABLE, pumafuse
from pumafuse import folders
from pumafuse.cli import many
from pumafuse.simulation import simulate as simulation

SCENARIOS = Path(__file__).parents[2] / "scenarios"
SCENARIO = """
name = "short"
teaches = "Nothing much."
seed = 3
arm = "puma560-internal"
[trajectory]
kind = "white-noise"
axes = ["radial", "vertical"]
amplitude_mm = 5.0
duration_s = 2.0
[sensors.eye]
rate_hz = 30.0
sd_mm = 0.5
"""
FILES = {"scenario.toml", "run.toml", "fusion.toml", "arm.toml", "commands.csv", "eye.csv", "truth.csv"}
RESULT = {"estimates.parquet", "measurements.parquet", "reference.parquet", "summary.json", "fusion.toml", "arm.toml"}


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text(SCENARIO)
    return path


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_run_is_written_whole_and_the_next_command_works(scenario: Path, tmp_path: Path) -> None:
    """What it teaches, what is in it, where it is; and the line that comes next can be typed as it stands."""
    run = tmp_path / "run"
    lines = pumafuse("simulate", scenario, "-o", run).stdout.splitlines()
    rows = len(pf.Run.read(run).sensors["eye"].stamp)
    assert lines[0] == "short: Nothing much."
    assert lines[1] == f"1 run: 73 commands, {rows} rows of measurements, written to {run}"
    assert names(run) == FILES
    words = lines[2].removeprefix("next: ").split()
    assert words[:2] == ["pumafuse", "fuse"]
    pumafuse(*words[1:-1], tmp_path / "result")
    assert names(tmp_path / "result") == RESULT


def test_the_executable_gives_the_bytes_that_python_gives(scenario: Path, tmp_path: Path) -> None:
    """And `--runs` those of single runs with the seeds in a row, on however many cores."""
    pumafuse("simulate", scenario, "-o", tmp_path / "one")
    printed = pumafuse("simulate", scenario, "-o", tmp_path / "many", "--runs", 3).stdout
    assert "3 runs: 219 commands" in printed and f"next: pumafuse fuse {tmp_path / 'many' / 'seed-*'} -c " in printed
    assert names(tmp_path / "many") == {"seed-3", "seed-4", "seed-5"}
    for seed in (3, 4, 5):
        simulation.write(pf.simulate(pf.Scenario.load(scenario), seed), tmp_path / f"python-{seed}", force=False)
        assert digests(tmp_path / "many" / f"seed-{seed}") == digests(tmp_path / f"python-{seed}")
    assert digests(tmp_path / "one") == digests(tmp_path / "python-3")
    assert digests(tmp_path / "one") != digests(tmp_path / "python-4")


@pytest.mark.long
def test_many_runs_are_fused_into_one_table(scenario: Path, tmp_path: Path) -> None:
    """A line for each run and axis, then one for each axis over all of them; a result folder for each run."""
    pumafuse("simulate", scenario, "-o", tmp_path / "runs", "--runs", 4)
    runs = sorted((tmp_path / "runs").iterdir())
    config = tmp_path / "runs" / "seed-3" / "fusion.toml"
    table = pumafuse("fuse", *runs, "-c", config, "-o", tmp_path / "out").stdout.splitlines()
    own = [line.split() for line in table if line.strip().startswith("seed-")]
    assert [(line[0], line[1]) for line in own] == [(f"seed-{s}", a) for s in "3456" for a in ("radial", "vertical")]
    pooled = [line.split() for line in table if line.strip().startswith("all 4")]
    assert [line[2] for line in pooled] == ["radial", "vertical"]
    assert names(tmp_path / "out") == {run.name for run in runs}
    assert all(names(folder) == RESULT for folder in (tmp_path / "out").iterdir())
    for axis, number in (("radial", 0), ("vertical", 1)):
        squares = [float(line[2]) ** 2 for line in own if line[1] == axis]
        assert float(pooled[number][3]) == pytest.approx((sum(squares) / 4) ** 0.5, abs=0.001)
        assert float(pooled[number][4]) == pytest.approx(max(squares) ** 0.5, abs=0.001)


def test_one_run_that_fails_stops_no_other(scenario: Path, tmp_path: Path) -> None:
    """It is named at the end, one line for it and one in all, and the exit code is 1."""
    out = tmp_path / "many"
    out.mkdir()
    (out / "seed-4").write_text("in the way")
    done = pumafuse("simulate", scenario, "-o", out, "--runs", 3, code=1)
    assert done.stderr.splitlines() == [
        f"pumafuse: seed-4: {out / 'seed-4'}: exists and is not a folder",
        f"pumafuse: 1 of 3 runs failed (see above); the others are in {out}",
    ]
    assert "2 runs: 146 commands" in done.stdout
    assert names(out / "seed-3") == names(out / "seed-5") == FILES
    assert (out / "seed-4").read_text() == "in the way"


@pytest.mark.long
def test_fusing_goes_on_past_a_run_that_cannot_be_read(scenario: Path, tmp_path: Path) -> None:
    """Torn tables, strange folders and missing runs are listed in the order given."""
    runs = tmp_path / "runs"
    pumafuse("simulate", scenario, "-o", runs, "--runs", 3)
    (runs / "seed-4" / "eye.csv").write_text("time_s,radial_mm\n")
    arguments = [runs / "none", runs / "seed-3", runs / "seed-4", runs / "seed-5"]
    done = pumafuse("fuse", *arguments, "-c", runs / "seed-3" / "fusion.toml", "-o", tmp_path / "out", code=1)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("warning: ")]
    assert [line.split(": ")[1] for line in lines[:2]] == [str(runs / "none"), str(runs / "seed-4")]
    assert lines[2:] == [f"pumafuse: 2 of 4 runs failed (see above); the others are in {tmp_path / 'out'}"]
    assert names(tmp_path / "out") == {"seed-3", "seed-5"}
    assert "all 2" in done.stdout


@pytest.mark.long
def test_when_every_run_fails_nothing_is_promised(scenario: Path, tmp_path: Path) -> None:
    """No table and no next step, only what was wrong."""
    done = pumafuse("fuse", tmp_path / "a", tmp_path / "b", "-c", SCENARIOS / "none.toml", "-o", tmp_path / "o", code=1)
    assert done.stdout == ""
    out = tmp_path / "many"
    out.mkdir()
    for seed in (3, 4):
        (out / f"seed-{seed}").write_text("in the way")
    done = pumafuse("simulate", scenario, "-o", out, "--runs", 2, code=1)
    assert done.stdout.splitlines() == ["short: Nothing much."]
    assert len(done.stderr.splitlines()) == 3


def _square(number: int) -> int:
    return number**2


def _refused() -> int:
    raise pf.ConfigError("not\nso")


def _broken() -> int:
    raise ValueError("several\nlines\nof it")


def test_jobs_are_done_and_reported_in_the_order_given(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Whichever is ready first; a refusal and an unexpected exception are one line each, no failure is no line."""
    many.report_failures({}, 3, "here")
    assert capsys.readouterr().err == ""
    jobs: dict[str, Callable[[], int]] = {f"job-{n}": partial(_square, n) for n in range(6)}
    jobs = {"bad": _refused, **jobs, "worse": _broken}
    done, failed = many.run_jobs("testing", jobs, [tmp_path / name for name in jobs])
    assert done == {f"job-{n}": n**2 for n in range(6)} and list(done) == [f"job-{n}" for n in range(6)]
    assert list(failed) == ["bad", "worse"]
    assert failed["bad"] == "not so"
    assert failed["worse"] == "unexpected ValueError: several lines of it"
    with pytest.raises(pf.PumafuseError, match="2 of 8 runs failed"):
        many.report_failures(failed, 8, "here")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and lines[0] == "pumafuse: bad: not so"
    assert lines[1].startswith("pumafuse: worse: ") and "several" in lines[1] and "of it" in lines[1]


@pytest.mark.long
@pytest.mark.parametrize("death", ["os._exit(9)", "os.kill(os.getpid(), signal.SIGKILL)"])
def test_a_worker_that_dies_is_one_line(death: str, tmp_path: Path) -> None:
    """As when memory runs out: the command says so and ends; what was half written is swept, what is whole is kept."""
    script, out = tmp_path / "dies.py", tmp_path / "out"
    script.write_text(
        "import os, signal, sys, time\nfrom functools import partial\nfrom pathlib import Path\n"
        "from pumafuse import folders\nfrom pumafuse.cli import many, main\n"
        f"out = Path({str(out)!r})\n"
        "def whole():\n    with folders.replacing(out / 'a') as new:\n        (new / 'x').write_text('')\n"
        "def die():\n    while not (out / 'a').exists():\n        time.sleep(0.01)\n"
        f"    with folders.replacing(out / 'b'):\n        {death}\n"
        "def app():\n    jobs = {'a': whole, 'b': die}\n"
        "    many.report_failures(many.run_jobs('x', jobs, [out / name for name in jobs])[1], 2, 'here')\n"
        "if __name__ == '__main__':\n    main.app = app\n    main.main()\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    lines = done.stderr.splitlines()
    assert len(lines) == 1 and lines[0].startswith("pumafuse: a worker process died"), done.stderr
    assert "of 2 runs are done and kept" in lines[0]
    assert names(out) == {"a"} and names(out / "a") == {"x"}


def interrupted(words: list[object], out: Path, finished: int, group: bool) -> set[str]:
    """Interrupt a command once it has ``finished`` some folders; the folders that are left when it has ended."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # what ignores it hands that on
    command = [str(EXECUTABLE), *map(str, words)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    signal.signal(signal.SIGINT, before)
    give_up = time.monotonic() + 100.0
    while process.poll() is None and time.monotonic() < give_up:
        if out.exists() and len([path for path in out.iterdir() if not path.name.startswith(".")]) >= finished:
            break
        time.sleep(0.01)
    assert process.poll() is None, process.communicate()
    if group:
        os.killpg(process.pid, signal.SIGINT)  # Ctrl-C reaches every process of the terminal
    else:
        os.kill(process.pid, signal.SIGINT)
    _, message = process.communicate(timeout=100)
    assert process.returncode == 130
    assert "Traceback" not in message and "interrupted: " in message
    time.sleep(1.0)  # what is still running would still write
    return names(out)


@pytest.mark.long
@pytest.mark.parametrize("group", [True, False], ids=["terminal", "one"])
def test_an_interrupted_simulation_keeps_whole_runs_and_nothing_else(group: bool, tmp_path: Path) -> None:
    """Exit code 130, a line that says how many are done; every folder is a whole run, and nothing hidden is left."""
    out = tmp_path / "out"
    left = interrupted(["simulate", SCENARIOS / "step-campaign.toml", "-o", out, "--runs", 300], out, 3, group)
    assert 3 <= len(left) < 300
    for name in left:
        assert names(out / name) == (FILES - {"eye.csv"}) | {"scope.csv", "trials.csv", "samples.csv"}
        assert pf.Run.read(out / name).name.endswith(f"seed {name.removeprefix('seed-')}")


def ours(name: str) -> bool:
    return name in ("run.toml", "a.csv")


def test_a_folder_is_writable_when_it_is_absent_empty_or_ours_with_force(tmp_path: Path) -> None:
    """Only an earlier output needs --force."""
    (tmp_path / "empty").mkdir()
    for name in ("absent", "empty", "deep/er"):
        folders.check_writable(tmp_path / name, False, ["run.toml"], ours)
    earlier = tmp_path / "earlier"
    earlier.mkdir()
    for name in ("run.toml", "a.csv"):
        (earlier / name).write_text("")
    with pytest.raises(folders.FolderError, match="exists; --force replaces it"):
        folders.check_writable(earlier, False, ["run.toml"], ours)
    folders.check_writable(earlier, True, ["run.toml"], ours)


@pytest.mark.parametrize("force", [False, True])
def test_strange_folders_are_never_ours(force: bool, tmp_path: Path) -> None:
    """A file in the place, something else in it, a folder in it, or our kind of file without the marker."""

    def refused(path: Path) -> str:
        with pytest.raises(folders.FolderError) as error:
            folders.check_writable(path, force, ["run.toml"], ours)
        return str(error.value)

    (tmp_path / "file").write_text("")
    assert "is not a folder" in refused(tmp_path / "file")
    for name, entries in {
        "strange": ["run.toml", "b.txt"],
        "unmarked": ["a.csv"],
        "hidden": ["run.toml", ".git"],
    }.items():
        (tmp_path / name).mkdir()
        for entry in entries:
            (tmp_path / name / entry).write_text("")
    assert "holds 'b.txt'" in refused(tmp_path / "strange")
    assert "holds no output of pumafuse" in refused(tmp_path / "unmarked")
    assert "holds '.git'" in refused(tmp_path / "hidden")
    (tmp_path / "nested" / "a.csv").mkdir(parents=True)
    (tmp_path / "nested" / "run.toml").write_text("")
    assert "holds 'a.csv'" in refused(tmp_path / "nested")


def test_an_output_that_fails_half_way_leaves_the_old_one_and_no_trace(tmp_path: Path) -> None:
    """Whatever goes wrong while it is written."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.toml").write_text("old")

    def half() -> None:
        with folders.replacing(tmp_path / "run") as new:
            (new / "run.toml").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half()
    assert names(tmp_path) == {"run"} and (tmp_path / "run" / "run.toml").read_text() == "old"
    with folders.replacing(tmp_path / "run") as new:
        (new / "run.toml").write_text("new")
    assert names(tmp_path) == {"run"} and (tmp_path / "run" / "run.toml").read_text() == "new"


def test_a_simulated_run_is_replaced_only_with_force(scenario: Path, tmp_path: Path) -> None:
    """What was there is untouched when it is refused, and a table of the user's own is never replaced."""
    run = tmp_path / "run"
    pumafuse("simulate", scenario, "-o", run)
    before = digests(run)
    scenario.write_text(SCENARIO.replace("seed = 3", "seed = 4"))
    assert "--force" in pumafuse("simulate", scenario, "-o", run, code=1).stderr
    assert digests(run) == before
    pumafuse("simulate", scenario, "-o", run, "--force")
    after = digests(run)
    assert after != before and names(run) == FILES
    (run / "mine.csv").write_text("time_s,note\n0.0,1\n")
    assert "'mine.csv'" in pumafuse("simulate", scenario, "-o", run, "--force", code=1).stderr
    assert {name: digest for name, digest in digests(run).items() if name != "mine.csv"} == after


@pytest.mark.long
@pytest.mark.parametrize(("more", "runs"), [((), ()), (("fusion.toml", "arm.toml"), ("--runs", 1))])
def test_a_run_that_was_recorded_is_not_replaced_even_with_force(
    more: tuple[str, ...], runs: tuple[object, ...], scenario: Path, tmp_path: Path
) -> None:
    """A folder with run.toml and tables of its own is somebody's measurement, not our output."""
    recorded = tmp_path / "measured" / "seed-3" if runs else tmp_path / "measured"
    recorded.mkdir(parents=True)
    (recorded / "run.toml").write_text('[command]\nfile = "host.csv"\ntime = "t_s"\nradial = "u_mm"\n')
    (recorded / "host.csv").write_text("t_s,u_mm\n0.0,1.0\n")
    for name in more:
        (recorded / name).write_text("")
    before = digests(recorded)
    done = pumafuse("simulate", scenario, "-o", tmp_path / "measured", "--force", *runs, code=1)
    assert "holds no output of pumafuse, which is not ours to replace" in done.stderr
    assert digests(recorded) == before
    assert names(tmp_path / "measured") == ({"seed-3"} if runs else set(before))


def test_a_folder_with_a_scenario_of_ones_own_is_not_replaced_even_with_force(tmp_path: Path) -> None:
    """A hand-written scenario.toml and the path beside it are nobody's output."""
    mine = tmp_path / "mine"
    mine.mkdir()
    path = '[trajectory]\nkind = "path"\nfile = "path.csv"\naxes = ["radial"]\n'
    (mine / "scenario.toml").write_text('name = "mine"\narm = "puma560-internal"\n' + path)
    (mine / "path.csv").write_text("time_s,radial_mm\n0.0,1.0\n1.0,2.0\n")
    before = digests(mine)
    pumafuse("simulate", mine / "scenario.toml", "-o", mine, "--force", code=1)
    assert digests(mine) == before


@pytest.mark.long
def test_a_run_along_a_path_is_simulated_anew_where_it_lies(scenario: Path, tmp_path: Path) -> None:
    """Its table goes with it: the same bytes, also in its own place."""
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "way.csv").write_text("time_s,radial_mm\n0.0,0.0\n1.0,20.0\n2.0,5.0\n")
    path = '[trajectory]\nkind = "path"\nfile = "there/way.csv"\naxes = ["radial"]\n'
    along = scenario.with_name("along.toml")
    along.write_text(SCENARIO[: SCENARIO.index("[trajectory]")] + path + SCENARIO[SCENARIO.index("[sensors.eye]") :])
    pumafuse("simulate", along, "-o", tmp_path / "one")
    before = digests(tmp_path / "one")
    assert "path.csv" in before
    pumafuse("simulate", tmp_path / "one" / "scenario.toml", "-o", tmp_path / "two")
    pumafuse("simulate", tmp_path / "one" / "scenario.toml", "-o", tmp_path / "one", "--force")
    assert digests(tmp_path / "two") == before == digests(tmp_path / "one")


@pytest.mark.long
def test_a_reference_without_rows_is_a_note_and_commands_without_rows_are_refused(
    scenario: Path, tmp_path: Path
) -> None:
    """A reference that was never recorded: exit code 0, no score, and the summary says so. No run without commands."""
    run, result = tmp_path / "run", tmp_path / "result"
    pumafuse("simulate", scenario, "-o", run)
    (run / "truth.csv").write_text((run / "truth.csv").read_text().splitlines()[0] + "\n")
    done = pumafuse("fuse", run, "-c", run / "fusion.toml", "-o", result)
    summary = json.loads((result / "summary.json").read_text())
    assert "truth.csv: the table has no rows" in done.stderr
    assert "truth.csv: the table has no rows" in summary["notes"]
    assert [summary["axes"][axis]["score"] for axis in ("radial", "vertical")] == [None, None]

    (run / "commands.csv").write_text((run / "commands.csv").read_text().splitlines()[0] + "\n")
    done = pumafuse("fuse", run, "-c", run / "fusion.toml", "-o", tmp_path / "none", code=1)
    assert len(done.stderr.splitlines()) == 1 and "commands.csv" in done.stderr
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("arguments", [("--runs", "0"), ("--runs", "-1"), ("--runs", "two"), ()])
def test_wrong_usage_exits_with_2(arguments: tuple[str, ...], scenario: Path) -> None:
    """Impossible numbers of runs, and no output folder."""
    pumafuse("simulate", scenario, *(("-o", "out", *arguments) if arguments else ()), code=2)
