"""`pumafuse live` as a process: lines in, lines out, signals, and the numbers of `fuse --as-live`."""

import json
import os
import pty
import signal
import subprocess
import time

import numpy as np
import pytest

import pumafuse as pf
from executable import DATA, EXECUTABLE, FUSION, SCAN, pumafuse, refused
from streams import lines, wired

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
LIVE = (str(EXECUTABLE), "live")
STDIN = (*LIVE, "stdin", "-c", str(FUSION))
AT_ONCE = f"replay:{SCAN}?speed=max"


def test_a_replay_gives_what_as_live_gives() -> None:
    """The demo's run, as fast as it can be: one line a command, the numbers of `fuse --as-live`, and a summary."""
    done = pumafuse("live", AT_ONCE, "-c", FUSION)
    offline = pf.fuse(pf.Run.read(SCAN), pf.FusionConfig.load(FUSION), mode="as-live")
    found = [json.loads(line) for line in done.stdout.splitlines()]
    for axis, track in offline.axes.items():
        assert [line[axis]["position_mm"] for line in found] == (track.position * 1e3).tolist()
        assert [line[axis]["sd_mm"] for line in found] == (track.position_sd * 1e3).tolist()
    assert "commands: 2143 fused; 2143 estimates" in done.stderr
    assert "vision" in done.stderr


def test_lines_from_standard_input() -> None:
    """Five seconds of the run with some nonsense between: estimates for each command, the nonsense counted."""
    good = wired(pf.Run.read(SCAN), 5.0)
    mixed = b"\n".join([*good[:300], b"nonsense", b"{}", *good[300:]]) + b"\n"
    done = subprocess.run(STDIN, input=mixed, capture_output=True, timeout=60, check=True)
    commands = sum(b'"command"' in line for line in good)
    assert len(done.stdout.splitlines()) == commands
    assert f"{len(good) + 2} lines, 2 of them bad; commands: {commands} fused" in done.stderr.decode()
    assert b"bad line 301: not JSON" in done.stderr


def test_signals_end_with_a_summary() -> None:
    """Ctrl-C and SIGTERM: whole lines only, a summary, exit code 0."""
    command = (*LIVE, f"replay:{SCAN}?speed=1", "-c", str(FUSION))
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        first = process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        rest, log = process.communicate(timeout=30)
    assert process.returncode == 0, log
    assert all("radial" in json.loads(estimate) for estimate in (first + rest).splitlines())
    assert "estimates" in log and "Traceback" not in log


def test_an_open_pipe_is_answered_at_once() -> None:
    """An estimate comes as soon as its command is in, while the sender waits; a last line without its end counts."""
    command = (*STDIN, "--rate", "50")
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["stdout"], "no source 'stdout'"),
        (["replay:nowhere"], "nowhere"),
        (["tcp://127.0.0.1:5005", "--listen", "0.0.0.0", "--allow", "10.0.0.0/8"], "tcp-listen://HOST:PORT"),
        (["stdin", "--record", "/dev/null"], "/dev/null"),
        (["stdin", "--rerun", "paper"], "--rerun: no mode 'paper'; there are: spawn, connect, web"),
    ],
)
def test_what_is_wrong_is_one_line(words: list[str], message: str) -> None:
    """What, where, what to do; exit code 1."""
    assert message in refused("live", *words, "-c", FUSION)


@pytest.mark.parametrize(
    ("redirection", "message"),
    [
        ("<&-", "standard input: cannot be read"),
        ("> /dev/full", "standard output"),
        ("2> /dev/full", None),
    ],
)
def test_a_closed_input_and_a_full_output_are_one_line(redirection: str, message: str | None) -> None:
    """No standard input at all, and no room for the estimates: exit code 1. A log that is full costs no estimate."""
    words, sent = ["sh", "-c", f"{' '.join(STDIN)} {redirection}"], "nonsense\n" + lines(2.8).decode()
    done = subprocess.run(words, input=sent, capture_output=True, text=True, timeout=60, check=False)
    assert "Traceback" not in done.stderr
    if message is None:
        assert done.returncode == 0 and len(done.stdout.splitlines()) == 100
    else:
        assert done.returncode == 1 and message in done.stderr


def test_the_status_screen() -> None:
    """On a terminal one screen shows axes and sensors; estimates still go to standard output."""
    ours, theirs = pty.openpty()
    command = [*LIVE, "replay:scan1?speed=20", "-c", "fusion.toml", "--status"]
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "140", "LINES": "40"}
    with subprocess.Popen(command, cwd=DATA, stdout=subprocess.PIPE, stderr=theirs, env=environment) as process:
        os.close(theirs)
        shown = b""
        while not (b"vision" in shown and b"position, mm" in shown):
            shown += os.read(ours, 65536)
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=30)
    os.close(ours)
    assert json.loads(out.splitlines()[0])["t"] >= 0.0
    assert process.returncode == 0
