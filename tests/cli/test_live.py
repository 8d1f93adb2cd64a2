"""`pumafuse live` as a process: lines in, lines out, signals, and the numbers of `fuse --as-live`."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import time
from importlib.resources import as_file, files
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

import pumafuse as pf
from executable import EXECUTABLE, pumafuse
from pumafuse.cli.live import status
from streams import Both, events_of, line

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")


@pytest.fixture(scope="module")
def data():
    with as_file(files("pumafuse") / "data") as folder:
        yield folder


def text_of(run: pf.Run, seconds: float) -> str:
    """A run's first seconds on the wire."""
    found = []
    for event in events_of(run):
        if event.stamp < seconds * 1e9:
            values = {axis: value * 1e3 for axis, value in event.values.items()}
            body = {"sensor": event.sensor, **values} if event.sensor else {"command": values}
            found.append(json.dumps({"t_ns": event.stamp, **body}))
    return "\n".join(found) + "\n"


def test_a_replay_gives_what_as_live_gives(data) -> None:
    """The demo's run, as fast as it can be: one line a command, the numbers of `fuse --as-live`, and a summary."""
    done = pumafuse("live", f"replay:{data / 'scan1'}?speed=max", "-c", data / "fusion.toml")
    offline = pf.fuse(pf.Run.read(data / "scan1"), pf.FusionConfig.load(data / "fusion.toml"), as_live=True)
    found = [json.loads(line) for line in done.stdout.splitlines()]
    for axis, track in offline.axes.items():
        assert [line[axis]["position_mm"] for line in found] == (track.position * 1e3).tolist()
        assert [line[axis]["sd_mm"] for line in found] == (track.position_sd * 1e3).tolist()
    assert "commands: 2143 fused; 2143 estimates" in done.stderr
    assert "vision" in done.stderr


def test_the_status_shows_milliseconds_and_millimetres() -> None:
    """Ten rows 40 ms late and one 90 ms: 44.5 ms in the mean, 90 at most; 0.57 m is 570.000 mm; stale is marked."""
    both = Both()
    both.feed(line(100.0, radial=570.0))
    for number in range(11):
        now, late = 101.0 + 0.1 * number, 0.09 if number == 5 else 0.04
        both.feed(line(now, radial=570.0) + line(round(now - late, 3), "tracker", radial=570.0))
    both.feed(line(104.0, radial=570.0))
    out = Console(width=140, record=True, file=StringIO())
    out.print(status(both.stream))
    shown = out.export_text()
    rows = {words[0]: words for words in map(str.split, shown.splitlines()) if words}
    assert rows["tracker"][1] == "11"
    assert rows["tracker"][3:5] == [f"{(10 * 40 + 90) / 11:.1f}", "90.0"]
    assert rows["radial"][1] == "570.000"
    assert rows["radial"][-1] == "stale"
    assert "outcomes count components" in shown


def test_lines_from_standard_input(data) -> None:
    """Five seconds of the run with some nonsense between: estimates for each command, the nonsense counted."""
    good = text_of(pf.Run.read(data / "scan1"), 5.0).splitlines()
    mixed = "\n".join([*good[:300], "nonsense", "{}", *good[300:]]) + "\n"
    command = [str(EXECUTABLE), "live", "stdin", "-c", str(data / "fusion.toml")]
    done = subprocess.run(command, input=mixed, capture_output=True, text=True, timeout=60, check=True)
    commands = sum('"command"' in line for line in good)
    assert len(done.stdout.splitlines()) == commands
    assert f"{len(good) + 2} lines, 2 of them bad; commands: {commands} fused" in done.stderr
    assert "bad line 301: not JSON" in done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_with_a_summary(data, number: int) -> None:
    """Ctrl-C and SIGTERM: whole lines only, a summary, exit code 0."""
    command = [str(EXECUTABLE), "live", f"replay:{data / 'scan1'}?speed=1", "-c", str(data / "fusion.toml")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        process.send_signal(number)
        rest, log = process.communicate(timeout=30)
    assert process.returncode == 0, log
    for estimate in (first + rest).splitlines():
        assert "radial" in json.loads(estimate)
    assert "estimates" in log
    assert "Traceback" not in log


def test_an_open_pipe_is_answered_at_once(data) -> None:
    """An estimate comes as soon as its command is in, while the sender waits; a last line without its end counts."""
    command = [str(EXECUTABLE), "live", "stdin", "-c", str(data / "fusion.toml"), "--rate", "50"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(b'{"t": 10.0, "command": {"radial": 560.0}}\n')
        process.stdin.flush()
        begin = time.monotonic()
        times = [json.loads(process.stdout.readline())["t"] for _ in range(30)]  # the grid goes on in silence
        assert 0.3 < time.monotonic() - begin < 30.0
        process.stdin.write(b'{"t": 11.0, "command": {"radial": 560.0}}')
        rest, log = process.communicate(timeout=30)
    assert np.allclose(times, 10.0 + np.arange(30) / 50)
    assert json.loads(rest.splitlines()[-1])["t"] >= 11.0
    assert b"2 lines, 0 of them bad; commands: 2 fused" in log


@pytest.mark.parametrize("option", ["--rate", "--window", "--stale-after"])
def test_an_option_that_is_not_positive_is_usage(data, option: str) -> None:
    """Exit code 2."""
    pumafuse("live", "stdin", "-c", data / "fusion.toml", option, "0", code=2)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["stdout"], "no source 'stdout'"),
        (["replay:nowhere"], "nowhere"),
        (["stdin", "--window", "7200"], "at most an hour"),
    ],
)
def test_what_is_wrong_is_one_line(data, words: list[str], message: str) -> None:
    """What, where, what to do; exit code 1."""
    done = pumafuse("live", *words, "-c", data / "fusion.toml", code=1)
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("source", "redirection", "message"),
    [
        ("stdin", "<&-", "standard input: cannot be read"),
        ("replay:scan1?speed=max", "> /dev/full", "standard output"),
        ("replay:scan1?speed=max", ">&-", "standard output is closed"),
    ],
)
def test_a_closed_input_and_a_full_output_are_one_line(data, source: str, redirection: str, message: str) -> None:
    """No standard input at all, and no room for the estimates: one line, exit code 1."""
    command = f"{EXECUTABLE} live '{source}' -c fusion.toml {redirection}"
    done = subprocess.run(["sh", "-c", command], cwd=data, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert message in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("log", ["2> /dev/full", "2>&-"])
def test_a_log_that_cannot_be_written_costs_no_estimate(data, log: str) -> None:
    """A full partition of logs, or none."""
    command = f"{EXECUTABLE} live 'replay:scan1?speed=max' -c fusion.toml {log}"
    done = subprocess.run(["sh", "-c", command], cwd=data, stdout=subprocess.PIPE, text=True, timeout=60, check=True)
    assert len(done.stdout.splitlines()) == 2143


def test_the_status_screen(data) -> None:
    """On a terminal one screen shows axes and sensors; estimates still go to standard output."""
    ours, theirs = pty.openpty()
    command = [str(EXECUTABLE), "live", "replay:scan1?speed=20", "-c", "fusion.toml", "--status"]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "140", "LINES": "40"}
    with subprocess.Popen(command, cwd=data, stdout=subprocess.PIPE, stderr=theirs, env=environment) as process:
        os.close(theirs)
        shown = b""
        while not (b"vision" in shown and b"position, mm" in shown):
            shown += os.read(ours, 65536)
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=30)
    os.close(ours)
    assert json.loads(out.splitlines()[0])["t"] >= 0.0
    assert process.returncode == 0
