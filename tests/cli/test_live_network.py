"""`pumafuse live` over the network and with a record: the executable, sockets, kills."""

import json
import math
import random
import socket
import subprocess
import time
from pathlib import Path

import pytest

import pumafuse as pf
from executable import EXECUTABLE, FUSION, SCAN, pumafuse
from listening import Live, live
from pumafuse.live.stream import Stream
from streams import lines, wired

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")


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
    """A sender that is not named is refused."""
    with live("udp://:0", FUSION, "--listen", "0.0.0.0", "--allow", "127.0.0.2/32") as process:
        port = process.port()
        for host, radial in (("127.0.0.1", 1.0), ("127.0.0.2", 560.0)):
            with socket.socket(type=socket.SOCK_DGRAM) as ours:
                ours.bind((host, 0))
                ours.sendto(b'{"t": 1.0, "command": {"radial": %f}}' % radial, ("127.0.0.1", port))
        assert json.loads(process.received(1)[0])["radial"]["position_mm"] == 560.0
        assert "1 datagrams taken in, 0 lost, 1 refused" in process.end()


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
