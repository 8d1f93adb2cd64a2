"""`pumafuse tune`: the real executable on simulated runs: its files, output, refusals, and Ctrl-C."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import time
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import pytest

import pumafuse as pf
from executable import EXECUTABLE, pumafuse
from pumafuse.logs.save import save
from pumafuse.tuning.likelihood import Likelihood
from pumafuse.tuning.summary import TuningSummary
from tuning_runs import quietly, replaced, scenario, spoiled, spoiled_arm, with_outliers

FILES = {"fusion.toml", "arm.toml", "tuning.json"}


@dataclass(frozen=True)
class Place:
    """Runs and configurations on disk."""

    folder: Path

    def run(self, name: str, run: pf.Run) -> Path:
        (self.folder / name).mkdir()
        save(run, self.folder / name)
        return self.folder / name

    def config(self, name: str, config: pf.FusionConfig) -> Path:
        (self.folder / name).mkdir()
        config.save(self.folder / name)
        return self.folder / name / "fusion.toml"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    return Place(tmp_path_factory.mktemp("tune"))


@pytest.fixture(scope="module")
def run(place: Place) -> Path:
    """A camera for 4 seconds, with outliers; without a reference."""
    return place.run("run", replace(with_outliers(4).run, reference=None))


@pytest.fixture(scope="module")
def config(place: Place) -> Path:
    """With an error in every noise."""
    return place.config("before", spoiled(with_outliers(4).config))


@pytest.fixture(scope="module")
def tuned(place: Place, run: Path, config: Path) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """The result folder, and the finished command with --json."""
    out = place.folder / "out"
    return out, pumafuse("tune", run, "-c", config, "-o", out, "--json")


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_the_folder_holds_the_result(
    tuned: tuple[Path, subprocess.CompletedProcess[str]], run: Path, config: Path
) -> None:
    """Two files for `fuse` and the summary, as `pf.tune` has them; --json prints it. Only notes are on stderr."""
    out, done = tuned
    assert names(out) == FILES
    wanted = quietly(lambda: pf.tune([pf.Run.read(run)], pf.FusionConfig.load(config)))
    assert (out / "tuning.json").read_text() == done.stdout == wanted.to_json()
    assert [line.removeprefix("warning: ") for line in done.stderr.splitlines()] == wanted.summary.notes
    assert msgspec.json.decode(done.stdout, type=TuningSummary) == wanted.summary
    found = pf.FusionConfig.load(out / "fusion.toml")
    likelihood = Likelihood([pf.Run.read(run)], found)
    assert likelihood.evaluate(found).total == pytest.approx(likelihood.evaluate(wanted.config).total, abs=1e-6)


def test_worse_on_the_validation_run_is_code_3(place: Place, run: Path) -> None:
    """Validated on a run of far noisier measurements; files are written all the same, the table and the verdict shown.

    With --force they replace an earlier result with its page. The summary has all options; keys, intervals and the
    next command are on the screen.
    """
    found = scenario("panel-vision", 0.1, 0.02)
    noisy = replaced(found, sensors={"vision": replaced(found.sensors["vision"], sd=3e-3)})
    sim = pf.simulate(noisy, 2)
    other, config = place.run("noisy", sim.run), place.config("noisy-config", sim.config)
    longer = place.run("longer", pf.simulate(scenario("panel-vision", 0.12, 0.02), 1).run)
    out = place.folder / "worse"
    out.mkdir()
    for name in (*FILES, "report.html"):
        (out / name).write_text("old")
    done = pumafuse(
        "tune", run, longer, "-c", config, "-o", out, "--fit", "noise,delay", "--fix", "vertical.delay_ms",
        "--fix", "maneuver_noise_mm_rtHz_per_m_s,maneuver_drift_mm_rts_per_m_s", "--validate", other, "--force",
        code=3,
    )  # fmt: skip
    assert names(out) == FILES
    summary = msgspec.json.decode((out / "tuning.json").read_bytes(), type=TuningSummary)
    assert summary.worse and summary.fit == ["noise", "delay"]
    assert summary.fixed == [
        "vertical.delay_ms",
        "maneuver_noise_mm_rtHz_per_m_s",
        "maneuver_drift_mm_rts_per_m_s",
    ]
    keys = [one.key for one in summary.parameters]
    assert "axes.tangential.delay_ms" in keys and "axes.vertical.delay_ms" not in keys
    rows = {line.split()[0]: line for line in done.stdout.splitlines() if line.split()}
    for one in summary.parameters:
        assert f"{one.value:.4g}" in rows[one.key].split(), one.key
        assert all(f"{end:.4g}" in rows[one.key] for end in one.ci95 if end)
    for check in summary.validation or []:
        assert f"{check.run}, {check.axis}: {check.verdict}" in done.stdout
        assert check.verdict.startswith("worse: ")
    assert f"written to {out}" in done.stdout
    assert f"next: pumafuse fuse RUN -c {out / 'fusion.toml'} -o DIR" in done.stdout
    assert set(re.findall("^warning: (.*)$", done.stderr, re.MULTILINE)) == set(summary.notes)


WRONG = {
    "names nothing to fix": (
        1,
        ["--fix", "trakker"],
        "pumafuse: --fix: 'trakker' names nothing that can be fitted; parts",
    ),
    "no such sensor": (1, ["--trust", "tracker"], "pumafuse: sensors: unknown sensor 'tracker'; accepted: vision"),
    "no kind": (2, ["--fit", ","], ""),
    "no such kind": (2, ["--fit", "delai"], ""),
}


@pytest.mark.parametrize(("code", "options", "line"), WRONG.values(), ids=WRONG.keys())
def test_a_wrong_option_is_refused(
    code: int, options: list[str], line: str, run: Path, config: Path, tmp_path: Path
) -> None:
    """With exit code and reason; nothing is written."""
    done = pumafuse("tune", run, "-c", config, "-o", tmp_path / "out", *options, code=code)
    assert done.stdout == "" and done.stderr.startswith(line)
    assert names(tmp_path) == set()


# ---- Ctrl-C ---------------------------------------------------------------------------------------------------------


def interrupted(words: list[str], until: str) -> tuple[int, str, str]:
    """Run in a terminal, interrupt once ``until`` is on its screen: exit code, stdout and the terminal's text."""
    ours, theirs = pty.openpty()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # what ignores it hands that on
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=theirs, text=True, env=os.environ | {"COLUMNS": "200", "TERM": "xterm"}
    )
    signal.signal(signal.SIGINT, before)
    os.close(theirs)
    shown, give_up = "", time.monotonic() + 100.0
    while until not in shown and time.monotonic() < give_up:
        shown += os.read(ours, 4096).decode(errors="replace")
    os.kill(process.pid, signal.SIGINT)
    with open(ours, "rb", buffering=0) as screen:  # noqa: PTH123 - a file descriptor
        try:
            while part := screen.read(4096):
                shown += part.decode(errors="replace")
        except OSError:
            pass  # the terminal's other side is closed
    output, _ = process.communicate(timeout=100)
    return process.returncode, output, shown


def test_ctrl_c_keeps_the_best_so_far(place: Place) -> None:
    """In the middle of the search: exit code 130, the folder is whole, loads, and is likelier than before.

    The screen offers it, and screen and summary report it.
    """
    sim = pf.simulate(scenario("panel-tracker-outage"), 1)
    known = spoiled_arm(sim.config)
    run, config, out = place.run("long", sim.run), place.config("long-config", known), place.folder / "stopped"
    words = [str(EXECUTABLE), "tune", str(run), "-c", str(config), "-o", str(out), "--fit", "noise,delay,plant,gain"]
    code, output, shown = interrupted(words, "log-likelihood")
    assert code == 130, shown
    assert "Traceback" not in shown and "Ctrl-C keeps the best so far" in shown
    assert "interrupted: these are the best numbers until then" in shown
    assert names(out) == FILES
    assert not [path for path in place.folder.iterdir() if path.name.startswith(".stopped")]
    summary = msgspec.json.decode((out / "tuning.json").read_bytes(), type=TuningSummary)
    assert summary.interrupted
    found, likelihood = pf.FusionConfig.load(out / "fusion.toml"), Likelihood([sim.run], known)
    assert likelihood.evaluate(found).total > likelihood.evaluate(known).total
    assert f"written to {out}" in output
