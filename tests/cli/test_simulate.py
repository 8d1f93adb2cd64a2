"""`pumafuse simulate` and many runs at a time: real files, real signals."""

import errno
import hashlib
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
import typer

import pumafuse as pf
from executable import EXECUTABLE, FUSION, SCAN, names, pumafuse, refused
from pumafuse import folders
from pumafuse.cli import many
from pumafuse.folders import FolderError, replacing, write_file
from pumafuse.fusion import results
from pumafuse.simulation import simulate as simulation

SCENARIOS = Path(__file__).parents[2] / "scenarios"
SCENARIO = """
name = "short"
teaches = "Nothing much."
seed = 3
arm = "puma560-internal"
trajectory = { kind = "white-noise", axes = ["radial", "vertical"], amplitude_mm = 5.0, duration_s = 2.0 }
sensors.eye = { rate_hz = 30.0, sd_mm = 0.5 }
"""
FILES = {"scenario.toml", "run.toml", "fusion.toml", "arm.toml", "commands.csv", "eye.csv", "truth.csv"}
RESULT = {
    *("estimates.parquet", "measurements.parquet", "reference.parquet", "summary.json"),
    *("log.json", "fusion.toml", "arm.toml"),
}


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text(SCENARIO)
    return path


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


def test_a_run_is_written_whole_and_the_next_command_works(scenario: Path, tmp_path: Path) -> None:
    """What it teaches, what is in it, where it is; and the line that comes next can be typed as it stands."""
    run = tmp_path / "run"
    lines = pumafuse("simulate", scenario, "-o", run).stdout.splitlines()
    rows = len(pf.Run.read(run).sensors["eye"].stamp)
    assert lines[:2] == [
        "short: Nothing much.",
        f"1 run: 73 commands, {rows} rows of measurements, written to {run}",
    ]
    assert names(run) == FILES
    words = lines[2].removeprefix("next: pumafuse ").split()
    pumafuse(*words[:-1], tmp_path / "result")
    assert names(tmp_path / "result") == RESULT


@pytest.mark.long
def test_the_executable_gives_the_bytes_that_python_gives(scenario: Path, tmp_path: Path) -> None:
    """And `--runs` those of single runs with the seeds in a row, on however many cores."""
    printed = pumafuse("simulate", scenario, "-o", tmp_path / "many", "--runs", 3).stdout
    assert "3 runs: 219 commands" in printed and f"next: pumafuse fuse {tmp_path / 'many' / 'seed-*'} -c " in printed
    assert names(tmp_path / "many") == {"seed-3", "seed-4", "seed-5"}
    found = [digests(tmp_path / "many" / f"seed-{seed}") for seed in (3, 4, 5)]
    for seed in (3, 4, 5):
        simulation.write(pf.simulate(pf.Scenario.load(scenario), seed), tmp_path / f"python-{seed}", force=False)
        assert found[seed - 3] == digests(tmp_path / f"python-{seed}")
    assert found[0] != found[1]


@pytest.mark.long
def test_many_runs_are_fused_into_one_table(scenario: Path, tmp_path: Path) -> None:
    """A line for each run and axis, then one for each axis over all of them; a result folder for each run.

    Torn tables and missing runs are listed in the order given, and stop no other.
    """
    runs, out = tmp_path / "runs", tmp_path / "out"
    pumafuse("simulate", scenario, "-o", runs, "--runs", 5)
    (runs / "seed-5" / "eye.csv").write_text("time_s,radial_mm\n")
    given = [runs / "none", *(runs / f"seed-{seed}" for seed in range(3, 8))]
    done = pumafuse("fuse", *given, "-c", runs / "seed-3" / "fusion.toml", "-o", out, code=1)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("warning: ")]
    assert [line.split(": ")[1] for line in lines[:2]] == [str(runs / "none"), str(runs / "seed-5")]
    assert lines[2:] == [f"pumafuse: 2 of 6 runs failed (see above); the others are in {out}"]
    rows = [line.split() for line in done.stdout.splitlines()]
    own = [row for row in rows if row and row[0].startswith("seed-")]
    assert [(row[0], row[1]) for row in own] == [(f"seed-{s}", a) for s in "3467" for a in ("radial", "vertical")]
    assert names(out) == {"seed-3", "seed-4", "seed-6", "seed-7"}
    assert all(names(folder) == RESULT for folder in out.iterdir())
    pooled = {row[2]: row for row in rows if row[:2] == ["all", "4"]}
    for axis in ("radial", "vertical"):
        squares = [float(row[2]) ** 2 for row in own if row[1] == axis]
        assert float(pooled[axis][3]) == pytest.approx((sum(squares) / 4) ** 0.5, abs=0.001)
        assert float(pooled[axis][4]) == pytest.approx(max(squares) ** 0.5, abs=0.001)


@pytest.mark.long
def test_many_runs_are_resumed(scenario: Path, tmp_path: Path) -> None:
    """After a kill --resume fuses what is left, to the same files; results made otherwise are refused."""
    runs, out, once = tmp_path / "runs", tmp_path / "out", tmp_path / "once"
    pumafuse("simulate", scenario, "-o", runs, "--runs", 4)
    given = [runs / f"seed-{seed}" for seed in range(3, 7)]
    same = "-c", runs / "seed-3" / "fusion.toml", "--rate", 50
    whole = pumafuse("fuse", *given, *same, "-o", once).stdout
    words = [str(EXECUTABLE), "fuse", *map(str, [*given, *same]), "-o", str(out)]
    process = subprocess.Popen(words, start_new_session=True)
    while not out.is_dir() or not any(path.name.startswith("seed-") for path in out.iterdir()):
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    kept = {path: path.stat().st_mtime_ns for path in out.glob("seed-*/*")}
    assert kept
    resumed = pumafuse("fuse", *given, *same, "-o", out, "--resume").stdout
    before = len({path.parent for path in kept})
    assert f"written to {out}; {before} of 4 were there already" in resumed
    assert resumed.splitlines()[:-1] == whole.splitlines()[:-1]
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert all(digests(out / folder.name) == digests(folder) for folder in once.iterdir())
    assert "there already: " in pumafuse("fuse", given[0], *same, "-o", out / "seed-3", "--resume").stdout
    for option, what in (
        (["--smooth"], "with another mode"),
        (["--as-live"], "with another mode"),
        (["--sensors", "eye"], "with other --sensors"),
        (["--to", 1.0], "with another --from or --to"),
        (["--figures"], "with no fused.png"),
    ):
        assert what in refused("fuse", *given, *same, "-o", out, "--resume", *option)
    recorded = next((runs / "seed-4").glob("*.csv*"))
    before = recorded.stat().st_mtime_ns
    for years in (1, -1):  # recorded anew, or an older file in its place
        os.utime(recorded, ns=(before, before + years * 31_536_000_000_000_000))
        assert f"{out / 'seed-4'}: an earlier result, with other files of the run;" in refused(
            "fuse", *given, *same, "-o", out, "--resume"
        )
    text = recorded.read_bytes()
    recorded.write_bytes(text + text.splitlines(keepends=True)[-1])
    os.utime(recorded, ns=(before, before))
    assert "with other files of the run;" in refused("fuse", *given, *same, "-o", out, "--resume")
    recorded.write_bytes(text)
    os.utime(recorded, ns=(before, before))
    edited = runs / "seed-3" / "fusion.toml"
    edited.write_text(edited.read_text().replace("[start]", "[start]\n# as before\n"))
    pumafuse("fuse", *given, *same, "-o", out, "--resume")
    edited.write_text(edited.read_text().replace("latency_ms = ", "latency_ms = 1"))
    assert f"{out / 'seed-3'}: an earlier result, with another fusion.toml;" in refused(
        "fuse", *given, *same, "-o", out, "--resume"
    )
    pumafuse("fuse", *given, *same, "-o", out, "--resume", "--force", code=2)


def test_sweeping_up_takes_nothing_of_others(tmp_path: Path) -> None:
    """Neither a hidden folder of the user's nor what another process is writing beside, whatever a batch ends like."""
    users = tmp_path / ".scan.backup"
    users.mkdir()
    (users / "notes.txt").write_text("mine")
    with folders.replacing(tmp_path / "scan") as new:  # this process is no worker of its own
        (new / "x").write_text("")
        many.run_jobs("testing", {"scan": partial(abs, 2)}, [tmp_path / "scan"])
    assert names(tmp_path) == {".scan.backup", "scan"}
    assert (users / "notes.txt").read_text() == "mine"
    assert names(tmp_path / "scan") == {"x"}


@contextmanager
def _interrupted_bar(_what: str, _total: float) -> Generator[Callable[[float], None]]:
    """A progress bar during whose first move the user presses Ctrl-C."""

    def move(_done: float) -> None:
        raise KeyboardInterrupt

    yield move


def _writes(folder: Path, seconds: float) -> None:
    with folders.replacing(folder) as new:
        time.sleep(seconds)
        (new / "x").write_text("")


@pytest.mark.long
@pytest.mark.usefixtures("two_cores")
def test_no_worker_writes_any_more_when_the_sweep_comes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where Ctrl-C comes while the bar is drawn, not while a result is waited for."""
    monkeypatch.setattr(many, "progress_bar", _interrupted_bar)
    jobs = {
        name: partial(_writes, tmp_path / name, seconds) for name, seconds in {"a": 0.05, "b": 0.5, "c": 0.5}.items()
    }
    with pytest.raises(typer.Exit):
        many.run_jobs("testing", jobs, [tmp_path / name for name in jobs])
    time.sleep(0.7)  # what is still running would still write
    assert names(tmp_path) == {"a"}


@pytest.mark.long
@pytest.mark.usefixtures("two_cores")
def test_a_worker_that_dies_is_one_line(tmp_path: Path) -> None:
    """As when memory runs out: the command says so and ends; what was half written is swept, what is whole is kept.

    Of what processes shared joblib may have to clean up something, of which it would warn.
    """
    script, out = tmp_path / "dies.py", tmp_path / "out"
    script.write_text(
        "import os, signal, time\nfrom pathlib import Path\n"
        "from pumafuse import folders\nfrom pumafuse.cli import many, main\n"
        f"out = Path({str(out)!r})\n"
        "def whole():\n    with folders.replacing(out / 'a') as new:\n        (new / 'x').write_text('')\n"
        "def die():\n    while not (out / 'a').exists():\n        time.sleep(0.01)\n"
        "    with folders.replacing(out / 'b'):\n        os.kill(os.getpid(), signal.SIGKILL)\n"
        "def app(*_, **__):\n    from joblib.externals.loky.backend import resource_tracker\n"
        "    resource_tracker.register('/loky-left', 'semlock')\n"
        "    many.run_jobs('x', {'a': whole, 'b': die}, [out / 'a', out / 'b'])\n"
        "if __name__ == '__main__':\n    main.app = app\n    main.main()\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("pumafuse: a worker process died") and "of 2 runs are done and kept" in line
    assert names(out) == {"a"} and names(out / "a") == {"x"}


def simulating(out: Path) -> subprocess.Popen[str]:
    """300 runs that are being simulated, as from a terminal of their own."""
    words = [str(EXECUTABLE), "simulate", str(SCENARIOS / "step-campaign.toml"), "-o", str(out), "--runs", "300"]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="children are listed there")
@pytest.mark.parametrize("later", [0.05, 0.2])
def test_workers_that_only_start_end_without_a_word(later: float, tmp_path: Path) -> None:
    """Ctrl-C reaches them, too, while they import; and it is not lost while they are started."""
    process = simulating(tmp_path)
    children, give_up = Path(f"/proc/{process.pid}/task/{process.pid}/children"), time.monotonic() + 100.0
    while time.monotonic() < give_up and not children.read_text().split():
        time.sleep(0.001)
    time.sleep(later)
    os.killpg(process.pid, signal.SIGINT)
    _, message = process.communicate(timeout=100)
    assert process.returncode == 130
    assert message.startswith("interrupted: ") and len(message.splitlines()) == 1


@pytest.mark.long
@pytest.mark.parametrize("kill", [os.killpg, os.kill], ids=["terminal", "one"])
def test_an_interrupted_simulation_keeps_whole_runs_and_nothing_else(
    kill: Callable[[int, int], None], tmp_path: Path
) -> None:
    """Exit code 130, a line that says how many are done; every folder is a whole run, and nothing hidden is left.

    Ctrl-C reaches every process of a terminal, a signal only one.
    """
    out = tmp_path / "out"
    process = simulating(out)
    give_up = time.monotonic() + 100.0
    while time.monotonic() < give_up and len([path for path in out.glob("*") if not path.name.startswith(".")]) < 3:
        time.sleep(0.01)
    assert process.poll() is None, process.communicate()
    kill(process.pid, signal.SIGINT)
    _, message = process.communicate(timeout=100)
    assert process.returncode == 130
    assert "Traceback" not in message and "interrupted: " in message
    time.sleep(1.0)  # what is still running would still write
    assert 3 <= len(names(out)) < 300
    files = (FILES - {"eye.csv"}) | {"scope.csv", "trials.csv", "samples.csv"}
    assert {name: names(out / name) for name in names(out)} == dict.fromkeys(names(out), files)
    for name in names(out):
        assert pf.Run.read(out / name).name.endswith(f"seed {name.removeprefix('seed-')}")


# ---- Output folders -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("entries", "forced", "unforced"),
    [
        ([], None, None),
        (["run.toml", "a.csv"], None, "exists; --force replaces it"),
        (["run.toml", ".git"], "holds '.git'", "holds '.git'"),
        (["a.csv"], "holds no output of pumafuse", "holds no output of pumafuse"),
        (["run.toml", "a.csv/"], "holds 'a.csv'", "holds 'a.csv'"),
    ],
)
def test_a_folder_is_writable_when_it_is_empty_or_ours_with_force(
    entries: list[str], forced: str | None, unforced: str | None, tmp_path: Path
) -> None:
    """Only an earlier output needs --force; with something else in it, or without the marker, it is never ours."""
    for entry in entries:
        path = tmp_path / entry
        path.mkdir() if entry.endswith("/") else path.write_text("")
    for force, message in ((True, forced), (False, unforced)):
        check = partial(folders.check_writable, tmp_path, force, ["run.toml"], {"run.toml", "a.csv"}.__contains__)
        if message is None:
            check()
        else:
            with pytest.raises(folders.FolderError, match=message):
                check()


def test_an_output_that_fails_half_way_leaves_the_old_one_and_no_trace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever goes wrong while it is written, and if the last rename fails."""
    run, rename = tmp_path / "run", Path.replace

    def write(text: str, error: type[BaseException] | None = None) -> None:
        with folders.replacing(run) as new:
            (new / "run.toml").write_text(text)
            if error is not None:
                raise error

    def broken(self: Path, target: Path) -> Path:
        if self.name == "new":
            raise OSError(errno.EIO, "")
        return rename(self, target)

    write("old")
    with pytest.raises(KeyboardInterrupt):
        write("half", KeyboardInterrupt)
    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", broken)
        with pytest.raises(folders.FolderError, match="Input/output error"):
            write("new")
    assert names(tmp_path) == {"run"} and (run / "run.toml").read_text() == "old"
    write("new")
    assert names(tmp_path) == {"run"} and (run / "run.toml").read_text() == "new"


@pytest.mark.parametrize("scenario_beside", [False, True])
def test_what_somebody_made_is_not_replaced_even_with_force(
    scenario_beside: bool, scenario: Path, tmp_path: Path
) -> None:
    """A run.toml with tables of its own is a measurement; a scenario with its path is written by hand."""
    mine = tmp_path / "mine"
    mine.mkdir()
    if scenario_beside:
        path = 'trajectory = { kind = "path", file = "path.csv", axes = ["radial"] }\n'
        scenario = mine / "scenario.toml"
        scenario.write_text(f'name = "mine"\narm = "puma560-internal"\n{path}')
        (mine / "path.csv").write_text("time_s,radial_mm\n0.0,1.0\n1.0,2.0\n")
    else:
        (mine / "run.toml").write_text('[command]\nfile = "commands.csv"\ntime = "t_s"\nradial = "u_mm"\n')
        (mine / "commands.csv").write_text("t_s,u_mm\n0.0,1.0\n")
    before = digests(mine)
    assert "not ours to replace" in pumafuse("simulate", scenario, "-o", mine, "--force", code=1).stderr
    assert digests(mine) == before


@pytest.mark.long
def test_a_run_along_a_path_is_simulated_anew_where_it_lies(tmp_path: Path) -> None:
    """Its table goes with it: the same bytes, also in its own place."""
    along, one, two = tmp_path / "along.toml", tmp_path / "one", tmp_path / "two"
    (tmp_path / "way.csv").write_text("time_s,radial_mm\n0.0,0.0\n1.0,20.0\n2.0,5.0\n")
    path = 'trajectory = { kind = "path", file = "way.csv", axes = ["radial"] }'
    lines = [path if line.startswith("trajectory") else line for line in SCENARIO.splitlines()]
    along.write_text("\n".join(lines))
    pumafuse("simulate", along, "-o", one)
    before = digests(one)
    assert "path.csv" in before
    pumafuse("simulate", one / "scenario.toml", "-o", two)
    pumafuse("simulate", one / "scenario.toml", "-o", one, "--force")
    assert digests(two) == before == digests(one)


FUSE = [str(EXECUTABLE), "fuse", str(SCAN), "-c", str(FUSION), "-o"]


def test_a_result_that_the_disk_cuts_short_is_absent(tmp_path: Path) -> None:
    """A table has no room, or the recording has not: no folder without it, none with a part of it; one line."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, 3_000_000))

    words = [*FUSE, str(tmp_path / "out"), "--rrd"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False, preexec_fn=limited)
    assert done.returncode == 1
    assert done.stderr == f"pumafuse: {tmp_path / 'out'}: cannot be written: File too large\n"
    assert not list(tmp_path.iterdir())


def test_a_full_standard_output_is_one_line(tmp_path: Path) -> None:
    """Exit code 1, and what was written stays."""
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*FUSE, "out"], stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False, cwd=tmp_path
        )
    assert done.returncode == 1
    assert done.stderr.splitlines() == ["pumafuse: standard output: No space left on device"]
    assert len(results.read(tmp_path / "out").time)


def test_a_closed_standard_output_is_no_fault(tmp_path: Path) -> None:
    """Whoever closes it does not want the tables."""
    line = f'"{EXECUTABLE}" fuse "{SCAN}" -c "{FUSION}" -o out'
    done = subprocess.run(f"{line} >&-", shell=True, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "summary.json").exists()


def test_two_that_write_one_folder_at_once(tmp_path: Path) -> None:
    """The first one to end wins, the other one says so and leaves nothing."""
    refuses = pytest.raises(FolderError, match="another process has written it meanwhile")
    with refuses, replacing(tmp_path / "out") as mine:
        (mine / "mine").touch()
        with replacing(tmp_path / "out") as theirs:
            (theirs / "theirs").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "theirs"]


def test_two_that_write_one_file_at_once(tmp_path: Path) -> None:
    """Where none was to be replaced, the one that comes second says so, and the first one's stays."""
    write_file(tmp_path / "arm.toml", "first")
    with pytest.raises(FolderError, match=r"arm\.toml: another process has written it meanwhile"):
        write_file(tmp_path / "arm.toml", "second", replace=False)
    assert (tmp_path / "arm.toml").read_text() == "first"
    write_file(tmp_path / "arm.toml", "second")
    assert (tmp_path / "arm.toml").read_text() == "second"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_nothing_is_left_by_a_signal(number: signal.Signals, tmp_path: Path) -> None:
    """The command ends as after an error, with 128 and the signal's number."""
    code = (
        "import sys, time\nfrom pathlib import Path\n"
        "from pumafuse import folders\nfrom pumafuse.cli import main\n"
        "def wait(*_, **__):\n"
        "    with folders.replacing(Path('out')):\n        print('writing', flush=True)\n        time.sleep(60)\n"
        "main.app = wait\nmain.main()\n"
    )

    words = [sys.executable, "-c", code]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=tmp_path)
    assert process.stdout.readline() == "writing\n"
    assert list(tmp_path.iterdir())
    process.send_signal(number)
    assert process.wait(30) == 128 + number
    process.stdout.close()
    assert not list(tmp_path.iterdir())
