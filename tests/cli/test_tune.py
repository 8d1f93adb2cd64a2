"""`pumafuse tune`: the command line on simulated runs: its files, output, refusals, and Ctrl-C."""

import os
import pty
import re
import signal
import subprocess
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

import pumafuse as pf
from executable import EXECUTABLE, names, pumafuse
from pumafuse.logs.save import save
from pumafuse.tuning.likelihood import Likelihood
from pumafuse.tuning.summary import TuningSummary
from tuning_runs import quietly, replaced, scenario, spoiled, spoiled_arm, with_outliers

FILES = {"fusion.toml", "arm.toml", "tuning.json"}


def written(folder: Path, run: pf.Run, config: pf.FusionConfig | None = None) -> tuple[Path, Path]:
    """A run and a configuration on disk: the folder, and the configuration's file."""
    folder.mkdir()
    save(run, folder)
    if config is not None:
        config.save(folder)
    return folder, folder / "fusion.toml"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tune")


@pytest.fixture(scope="module")
def given(place: Path) -> tuple[Path, Path]:
    """A camera for 4 seconds, with outliers, without a reference; a configuration with an error in every noise."""
    sim = with_outliers(4)
    return written(place / "run", replace(sim.run, reference=None), spoiled(sim.config))


@pytest.fixture(scope="module")
def tuned(place: Path, given: tuple[Path, Path]) -> tuple[Path, subprocess.CompletedProcess[str]]:
    return place / "out", pumafuse("tune", given[0], "-c", given[1], "-o", place / "out", "--json")


def test_the_folder_holds_the_result(
    tuned: tuple[Path, subprocess.CompletedProcess[str]], given: tuple[Path, Path]
) -> None:
    """Two files for `fuse` and the summary, as `pf.tune` has them; --json prints it. Only notes are on stderr."""
    (out, done), run, known = tuned, pf.Run.read(given[0]), pf.FusionConfig.load(given[1])
    assert names(out) == FILES
    wanted = quietly(lambda: pf.tune([run], known))
    assert (out / "tuning.json").read_text() == done.stdout == wanted.to_json()
    assert [line.removeprefix("warning: ") for line in done.stderr.splitlines()] == wanted.details.notes
    assert msgspec.json.decode(done.stdout, type=TuningSummary) == wanted.details
    found = pf.FusionConfig.load(out / "fusion.toml")
    likelihood = Likelihood([run], found)
    assert likelihood.evaluate(found).log_likelihood == pytest.approx(
        likelihood.evaluate(wanted.config).log_likelihood, abs=1e-6
    )


def test_worse_on_the_validation_run_is_code_3(place: Path, given: tuple[Path, Path]) -> None:
    """Validated on a run of far noisier measurements; files are written all the same, the table and the verdict shown.

    With --force they replace an earlier result with its page. The summary has all options; keys, intervals and the
    next command are on the screen.
    """
    found = scenario("panel-vision", 0.1, 0.02)
    sim = pf.simulate(replaced(found, sensors={"vision": replaced(found.sensors["vision"], sd=3e-3)}), 2)
    other, config = written(place / "noisy", sim.run, sim.config)
    longer, _ = written(place / "longer", pf.simulate(scenario("panel-vision", 0.12, 0.02), 1).run)
    out = place / "worse"
    out.mkdir()
    for name in (*FILES, "report.html"):
        (out / name).write_text("old")
    maneuver = ["maneuver_noise_mm_rtHz_per_m_s", "maneuver_drift_mm_rts_per_m_s"]
    fit = ("--fit", "noise", "--fit", "delay", "--fix", "vertical.delay_ms", "--fix", ",".join(maneuver))
    done = pumafuse("tune", given[0], longer, "-c", config, "-o", out, *fit, "--validate", other, "--force", code=3)
    assert names(out) == FILES
    summary = msgspec.json.decode((out / "tuning.json").read_bytes(), type=TuningSummary)
    assert summary.worse and summary.fit == ["noise", "delay"]
    assert summary.fixed == ["vertical.delay_ms", *maneuver]
    keys = [one.key for one in summary.parameters]
    assert "axes.tangential.delay_ms" in keys and "axes.vertical.delay_ms" not in keys
    rows = {line.split()[0]: line for line in done.stdout.splitlines() if line.split()}
    for one in summary.parameters:
        assert f"{one.value:.4g}" in rows[one.key].split(), one.key
        assert all(f"{end:.4g}" in rows[one.key] for end in one.ci95 if end)
    for check in summary.validation or []:
        assert f"{check.run}, {check.axis}: {check.verdict}" in done.stdout
        assert check.verdict.startswith("worse: ")
    assert f"written to {out}\nnext: pumafuse fuse RUN -c {out / 'fusion.toml'} -o DIR" in done.stdout
    assert set(re.findall("^warning: (.*)$", done.stderr, re.MULTILINE)) == set(summary.notes)


@pytest.mark.parametrize(
    ("code", "options", "line"),
    [
        (1, ["--fix", "trakker"], "pumafuse: --fix: 'trakker' names nothing that can be fitted; parts"),
        (1, ["--trust", "tracker"], "pumafuse: sensors: unknown sensor 'tracker'; accepted: vision"),
        (1, ["--share", "delay"], "pumafuse: --share delay: delays are not fitted; add delay to --fit"),
        (2, ["--fit", "delai"], ""),
    ],
)
def test_a_wrong_option_is_refused(
    code: int, options: list[str], line: str, given: tuple[Path, Path], tmp_path: Path
) -> None:
    """With exit code and reason; nothing is written."""
    done = pumafuse("tune", given[0], "-c", given[1], "-o", tmp_path / "out", *options, code=code)
    assert done.stdout == "" and done.stderr.startswith(line)
    assert names(tmp_path) == set()


def interrupted(words: list[str], until: str) -> tuple[int, str, str]:
    """Run in a terminal, interrupt once ``until`` is on its screen: exit code, stdout and the terminal's text."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=theirs, text=True, env=os.environ | {"COLUMNS": "200", "TERM": "xterm"}
    )
    os.close(theirs)
    shown, give_up = "", time.monotonic() + 100.0
    while until not in shown and time.monotonic() < give_up:
        shown += os.read(ours, 4096).decode(errors="replace")
    os.kill(process.pid, signal.SIGINT)
    # that the terminal's other side is closed is an error
    with open(ours, "rb", buffering=0) as screen, suppress(OSError):  # noqa: PTH123 - a file descriptor
        while part := screen.read(4096):
            shown += part.decode(errors="replace")
    output, _ = process.communicate(timeout=100)
    return process.returncode, output, shown


@pytest.mark.long
def test_ctrl_c_keeps_the_best_so_far(tmp_path: Path) -> None:
    """In the middle of the search: exit code 130, the folder is whole, loads, and is likelier than before.

    The screen offers it, and screen and summary report it.
    """
    sim = pf.simulate(scenario("panel-tracker-outage"), 1)
    known = spoiled_arm(sim.config)
    (run, config), out = written(tmp_path / "long", sim.run, known), tmp_path / "stopped"
    words = [str(EXECUTABLE), "tune", str(run), "-c", str(config), "-o", str(out), "--fit", "noise,delay,plant,gain"]
    code, output, shown = interrupted(words, "log-likelihood")
    assert code == 130, shown
    assert "Traceback" not in shown and "Ctrl-C keeps the best so far" in shown
    assert "interrupted: these are the best numbers until then" in shown
    assert names(out) == FILES and names(tmp_path) == {"long", "stopped"}
    summary = msgspec.json.decode((out / "tuning.json").read_bytes(), type=TuningSummary)
    assert summary.interrupted
    found, likelihood = pf.FusionConfig.load(out / "fusion.toml"), Likelihood([sim.run], known)
    assert likelihood.evaluate(found).log_likelihood > likelihood.evaluate(known).log_likelihood
    assert f"written to {out}" in output
