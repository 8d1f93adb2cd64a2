"""`pumafuse live` as a process: lines in, lines out, signals, and the numbers of `fuse --as-live`."""

import json
import math
import os
import pty
import random
import signal
import socket
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from executable import DATA, EXECUTABLE, FUSION, SCAN, pumafuse, refused
from listening import Live, live
from pumafuse.live.stream import Stream
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
    """An estimate comes as soon as its command is in, while the sender waits; a last line without its end counts.

    A line that is nonsense is counted and named.
    """
    command = (*STDIN, "--rate", "50")
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(b'{"t": 10.0, "command": {"radial": 560.0}}\nnonsense\n')
        process.stdin.flush()
        begin = time.monotonic()
        times = [json.loads(process.stdout.readline())["t"] for _ in range(30)]  # the grid goes on in silence
        assert 0.3 < time.monotonic() - begin < 30.0
        process.stdin.write(b'{"t": 11.0, "command": {"radial": 560.0}}')
        rest, log = process.communicate(timeout=30)
    assert np.allclose(times, 10.0 + np.arange(30) / 50)
    assert json.loads(rest.splitlines()[-1])["t"] >= 11.0
    assert b"bad line 2: not JSON" in log and b"3 lines, 1 of them bad; commands: 2 fused" in log


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


@pytest.fixture(scope="module")
def scan() -> list[bytes]:
    """The shipped run's first seconds as lines, in the order of their stamps."""
    return wired(pf.Run.read(SCAN), 4.0)


def send(process: Live, scan: list[bytes]) -> list[bytes]:
    """Send each line as a datagram, wait for the estimate of each command, and return those."""
    found, place = [], ("127.0.0.1", process.port())
    with socket.socket(type=socket.SOCK_DGRAM) as ours:
        for line in scan:
            ours.sendto(line, place)
            if b'"command"' in line:
                found += process.received(1)
    return found


def test_datagrams_in_and_out_and_a_record_of_them(scan: list[bytes], tmp_path: Path) -> None:
    """Each command's estimate comes back as a datagram at once, the very bytes that lines would have given.

    After SIGTERM everything that came is in the record, and the command line fuses it.
    """
    run = tmp_path / "run"
    with live("udp://127.0.0.1:0", FUSION, "--record", str(run)) as process:
        found = send(process, scan)
        log = process.end()
    expected: list[bytes] = []
    Stream(pf.LiveEstimator(pf.FusionConfig.load(FUSION)), expected.extend, lambda _: None).add(scan)
    assert found == expected
    assert f"{len(scan)} datagrams taken in, 0 lost" in log
    assert f"{run}: {len(scan)} rows written" in log
    pumafuse("fuse", run, "-c", FUSION, "-o", tmp_path / "out")
    recorded = pf.Run.read(run)
    assert len(recorded.command.stamp) + sum(len(one.stamp) for one in recorded.sensors.values()) == len(scan)


def test_lines_over_tcp() -> None:
    """A connection that gives all it can: every row is taken in, every command answered."""
    with live("tcp-listen://127.0.0.1:0", FUSION) as process:
        with socket.create_connection(("127.0.0.1", process.port())) as connection:
            connection.sendall(lines(2.8))
        process.received(100)
        assert "200 lines, 0 of them bad; commands: 100 fused; 100 estimates" in process.end()


def test_only_allowed_senders_are_accepted_elsewhere() -> None:
    with live("udp://:0", FUSION, "--listen", "0.0.0.0", "--allow", "127.0.0.2/32") as process:
        port = process.port()
        for host, radial in (("127.0.0.1", 1.0), ("127.0.0.2", 560.0)):
            with socket.socket(type=socket.SOCK_DGRAM) as ours:
                ours.bind((host, 0))
                ours.sendto(b'{"t": 1.0, "command": {"radial": %f}}' % radial, ("127.0.0.1", port))
        assert json.loads(process.received(1)[0])["radial"]["position_mm"] == 560.0
        log = process.end()
    assert "127.0.0.1, which --allow does not name" in log and "1 datagrams taken in, 0 lost, 1 refused" in log


@pytest.mark.long
@pytest.mark.parametrize("seed", range(10))
def test_killed_at_any_moment(tmp_path: Path, seed: int) -> None:
    """Kills at random moments: each record fuses, and lacks the last second at most."""
    run, sent, due = tmp_path / "run", list[tuple[float, int]](), math.inf
    words = [str(EXECUTABLE), "live", "stdin", "-c", str(FUSION), "--record", str(run)]
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdin is not None
        while (now := time.monotonic()) < due:
            sent.append((now, time.time_ns()))
            body = {"sensor": "tracker", "radial": 560.0} if len(sent) % 6 else {"command": {"radial": 560.0}}
            process.stdin.write(json.dumps({"t_ns": sent[-1][1], **body}).encode() + b"\n")
            process.stdin.flush()
            if due == math.inf and (run / "run.toml").exists():
                due = now + random.Random(seed).uniform(0.0, 2.0)
            time.sleep(0.005)
        process.kill()
        killed = time.monotonic()
    found = pf.Run.read(run)
    pf.fuse(found, pf.FusionConfig.load(FUSION))
    there = {stamp for source in (found.command, *found.sensors.values()) for stamp in source.stamp.tolist()}
    assert [
        at for at, stamp in sent if stamp >= found.command.stamp[0] and stamp not in there and at < killed - 1.0
    ] == []
