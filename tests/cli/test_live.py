"""`pumafuse live` as a process: lines in, lines out, signals, and the numbers of `fuse --as-live`."""

from __future__ import annotations

import json
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
from pumafuse.cli.live_status import status
from streams import Both, events_of, line, lines

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


def test_a_replay_says_what_as_live_says(data) -> None:
    """The demo's run, as fast as it can be: one line a command, the numbers of `fuse --as-live`, and a summary."""
    done = pumafuse("live", f"replay:{data / 'scan1'}?speed=max", "-c", data / "fusion.toml")
    offline = pf.fuse(pf.Run.read(data / "scan1"), pf.FusionConfig.load(data / "fusion.toml"), as_live=True)
    found = [json.loads(line) for line in done.stdout.splitlines()]
    for axis, track in offline.axes.items():
        assert [line[axis]["position_mm"] for line in found] == (track.position * 1e3).tolist()
        assert [line[axis]["sd_mm"] for line in found] == (track.position_sd * 1e3).tolist()
    assert "commands: 2143 fused; 2143 estimates" in done.stderr
    assert "vision" in done.stderr


def test_how_late_a_sensor_is_is_told_in_ms(data) -> None:
    """Ten rows 40 ms behind the newest stamp and one 90 ms: 44.5 ms in the mean, 90 at most."""
    told = ['{"t": 100.0, "command": {"radial": 560.0}}']
    for number in range(11):
        now, late = 101.0 + 0.1 * number, 0.09 if number == 5 else 0.04
        told.append(json.dumps({"t": now, "command": {"radial": 560.0}}))
        told.append(json.dumps({"t": round(now - late, 3), "sensor": "tracker", "radial": 560.0}))
    command = [str(EXECUTABLE), "live", "stdin", "-c", str(data / "fusion.toml")]
    done = subprocess.run(command, input="\n".join(told) + "\n", capture_output=True, text=True, timeout=60, check=True)
    row = next(line.split() for line in done.stderr.splitlines() if line.split()[:1] == ["tracker"])
    assert (row[1], row[3], row[4]) == ("11", f"{(10 * 40 + 90) / 11:.1f}", "90.0")


def test_lines_from_standard_input(data) -> None:
    """Five seconds of the run with some nonsense between: estimates for each command, the nonsense told and counted."""
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
        rest, told = process.communicate(timeout=30)
    assert process.returncode == 0, told
    for estimate in (first + rest).splitlines():
        assert "radial" in json.loads(estimate)
    assert "estimates" in told
    assert "Traceback" not in told


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
        rest, told = process.communicate(timeout=30)
    assert np.allclose(times, 10.0 + np.arange(30) / 50)
    assert json.loads(rest.splitlines()[-1])["t"] >= 11.0
    assert b"2 lines, 0 of them bad; commands: 2 fused" in told


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("stdout", "no source 'stdout'"),
        ("replay:nowhere", "nowhere"),
        ("replay:nowhere?speed=-1", "positive number or max"),
    ],
)
def test_wrong_sources_are_one_line(data, source: str, said: str) -> None:
    """What, where, what to do; exit code 1."""
    done = pumafuse("live", source, "-c", data / "fusion.toml", code=1)
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_closed_input_and_a_full_output_are_one_line(data) -> None:
    """No standard input at all, and no room for the estimates: one line, exit code 1."""
    arguments = f"-c {data / 'fusion.toml'}"
    for command, said in (
        (f"{EXECUTABLE} live stdin {arguments} <&-", "standard input: cannot be read"),
        (f"{EXECUTABLE} live replay:{data / 'scan1'}?speed=max {arguments} > /dev/full", "standard output"),
        (f"{EXECUTABLE} live replay:{data / 'scan1'}?speed=max {arguments} >&-", "standard output is closed"),
    ):
        done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 1
        assert said in done.stderr
        assert "Traceback" not in done.stderr


@pytest.mark.parametrize("log", ["2> /dev/full", "2>&-"])
def test_a_log_that_cannot_be_written_costs_no_estimate(data, log: str) -> None:
    """A full partition of logs, or none."""
    command = f"{EXECUTABLE} live 'replay:{data / 'scan1'}?speed=max' -c {data / 'fusion.toml'} {log}"
    done = subprocess.run(["sh", "-c", command], stdout=subprocess.PIPE, text=True, timeout=60, check=True)
    assert len(done.stdout.splitlines()) == 2143


def test_wrong_options_are_usage(data) -> None:
    """Exit code 2."""
    for option in ("--rate", "--window", "--stale-after"):
        pumafuse("live", "stdin", "-c", data / "fusion.toml", option, "0", code=2)
    done = pumafuse("live", "stdin", "-c", data / "fusion.toml", "--window", "7200", code=1)
    assert "at most an hour" in done.stderr


def test_the_status_screen(data) -> None:
    """On a terminal one screen shows axes and sensors; estimates still go to standard output."""
    import os
    import pty

    ours, theirs = pty.openpty()
    command = [
        str(EXECUTABLE),
        "live",
        f"replay:{data / 'scan1'}?speed=20",
        "-c",
        str(data / "fusion.toml"),
        "--status",
    ]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "140", "LINES": "40"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=theirs, env=environment) as process:
        os.close(theirs)
        shown = b""
        while True:
            try:
                piece = os.read(ours, 65536)
            except OSError:
                break
            shown += piece
            if b"vision" in shown and b"velocity" in shown and process.poll() is None:
                process.send_signal(signal.SIGTERM)
                break
        out, _ = process.communicate(timeout=30)
    os.close(ours)
    assert b"position, mm" in shown
    assert json.loads(out.splitlines()[0])["t"] >= 0.0
    assert process.returncode == 0


def test_the_status_shows_milliseconds_and_millimetres() -> None:
    """Half a second late is 500.0 ms, 0.57 m is 570.000 mm; what is stale is marked, and what is counted said."""
    both = Both()
    both.feed(lines(4.0) + line(3.49, "tracker", radial=570.0) + line(6.0, radial=570.0))
    out = Console(width=140, record=True, file=StringIO())
    out.print(status(both.stream))
    shown = out.export_text()
    late = both.live.health().sensors["tracker"].lateness_max
    assert f"{late * 1e3:.1f}" in shown
    assert late == pytest.approx(0.486 + 0.01, abs=0.03)
    assert "570.000" in shown
    assert "stale" in shown
    assert "2.0" in shown
    assert "outcomes count components" in shown
