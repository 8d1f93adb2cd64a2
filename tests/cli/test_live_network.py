"""`pumafuse live` over the network and with a record: the executable, sockets, kills."""

from __future__ import annotations

import json
import os
import random
import select
import socket
import subprocess
import time
from importlib.resources import as_file, files
from pathlib import Path

import pytest

import pumafuse as pf
from executable import EXECUTABLE, pumafuse
from listening import LONGEST, live
from pumafuse.live.stream import Stream
from streams import events_of, lines

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")


@pytest.fixture(scope="module")
def data():
    with as_file(files("pumafuse") / "data") as folder:
        yield folder


@pytest.fixture(scope="module")
def scan(data) -> list[bytes]:
    """The shipped run's first seconds as lines, in the order of their stamps."""
    found = []
    for stamp, sensor, values in events_of(pf.Run.read(data / "scan1")):
        if stamp < 4_000_000_000:
            body = {axis: value * 1e3 for axis, value in values.items()}
            found.append(json.dumps({"t_ns": stamp, **({"sensor": sensor, **body} if sensor else {"command": body})}))
    return [line.encode() for line in found]


def expected(data: Path, sent: list[bytes]) -> list[bytes]:
    """What goes out when these lines come in."""
    written: list[bytes] = []
    config = pf.FusionConfig.load(data / "fusion.toml")
    Stream(pf.LiveEstimator(config), written.extend, lambda _: None).take(sent)
    return written


def test_datagrams_in_and_out(data, scan) -> None:
    """Each command's estimate comes back as a datagram at once, the very bytes that lines would have given."""
    found = []
    with live("udp://127.0.0.1:0", data / "fusion.toml") as process, socket.socket(type=socket.SOCK_DGRAM) as ours:
        place = ("127.0.0.1", process.port())
        for line in scan:
            ours.sendto(line, place)
            if b'"command"' in line:
                found += process.received(1)
        log = process.end()
    assert found == expected(data, scan)
    assert f"{len(scan)} datagrams taken in, 0 lost" in log


def test_twenty_thousand_rows_over_tcp(data) -> None:
    """A connection that gives all it can: every row is taken in, every command answered."""
    sent = lines(20_000 * 0.014)
    with live("tcp-listen://127.0.0.1:0", data / "fusion.toml") as process:
        with socket.create_connection(("127.0.0.1", process.port())) as connection:
            connection.sendall(sent)
        last = json.loads(sent.splitlines()[-2])["t"]
        while json.loads(process.received(1)[0])["t"] < last:
            pass
        log = process.end()
    assert "20000 lines, 0 of them bad; commands: 10000 fused; 10000 estimates" in log


def test_a_server_that_is_connected_to(data, scan) -> None:
    """Lines from a server, whose connection breaks off in between: it is made again, and no line is lost."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(LONGEST)
        port = server.getsockname()[1]
        with live(f"tcp://127.0.0.1:{port}", data / "fusion.toml") as process:
            middle = len(scan) // 2
            for part in (scan[:middle], scan[middle:]):
                connection, _ = server.accept()
                connection.sendall(b"\n".join(part) + b"\n")
                connection.close()
            want = expected(data, scan)
            assert process.received(len(want)) == want
            log = process.end()
    assert "connections made: 2" in log
    assert "the connection has ended; made again in 0.5 s" in log


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["udp://:5005", "--listen", "0.0.0.0"], 2, "go together"),
        (["udp://:5005", "--allow", "10.0.0.0/8"], 2, "go together"),
        (["tcp://127.0.0.1:5005", "--listen", "0.0.0.0", "--allow", "10.0.0.0/8"], 1, "tcp-listen://HOST:PORT"),
        (["stdin", "--out", "tcp://127.0.0.1:5005"], 1, "expected udp://HOST:PORT"),
        (["stdin", "--record", "/dev/null"], 1, "/dev/null"),
        (["stdin", "--rerun", "paper"], 1, "paper"),
    ],
)
def test_what_cannot_be_is_one_line(data, words: list[str], code: int, message: str) -> None:
    """What, where, what to do."""
    done = pumafuse("live", *words, "-c", data / "fusion.toml", code=code)
    assert message in done.stderr
    assert code == 2 or len(done.stderr.splitlines()) == 1


def test_only_allowed_senders_are_accepted_elsewhere(data) -> None:
    """A sender that is not named is refused."""
    options = ("--listen", "0.0.0.0", "--allow", "127.0.0.2/32")
    with live("udp://:0", data / "fusion.toml", *options) as process:
        port = process.port()
        for host, radial in (("127.0.0.1", 1.0), ("127.0.0.2", 560.0)):
            with socket.socket(type=socket.SOCK_DGRAM) as ours:
                ours.bind((host, 0))
                ours.sendto(b'{"t": 1.0, "command": {"radial": %f}}' % radial, ("127.0.0.1", port))
        assert json.loads(process.received(1)[0])["radial"]["position_mm"] == 560.0
        log = process.end()
    assert "1 datagrams taken in, 0 lost, 1 refused" in log


def test_a_record_holds_what_came(data, scan, tmp_path) -> None:
    """SIGTERM: everything that came is in the record, and the command line fuses it."""
    with live("udp://127.0.0.1:0", data / "fusion.toml", "--record", str(tmp_path / "run")) as process:
        place = ("127.0.0.1", process.port())
        with socket.socket(type=socket.SOCK_DGRAM) as ours:
            for line in scan:
                ours.sendto(line, place)
                if b'"command"' in line:
                    process.received(1)
        log = process.end()
    assert f"{tmp_path / 'run'}: {len(scan)} rows written" in log
    done = pumafuse("fuse", tmp_path / "run", "-c", data / "fusion.toml", "-o", tmp_path / "out")
    assert "run" in done.stdout + done.stderr
    found = pf.Run.read(tmp_path / "run")
    assert len(found.command.stamp) + sum(len(source.stamp) for source in found.sensors.values()) == len(scan)


class Fed:
    """A live process that gets lines of the time at which they are sent, and is killed."""

    def __init__(self, data: Path, folder: Path) -> None:
        self.folder, self.sent, self.killed = folder, list[tuple[float, int]](), 0.0
        words = [str(EXECUTABLE), "live", "stdin", "-c", str(data / "fusion.toml"), "--record", str(folder)]
        self.process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)

    def feed(self, step: int) -> None:
        stamp = time.time_ns()
        body = {"command": {"radial": 560.0}} if step % 6 == 0 else {"sensor": "tracker", "radial": 560.0}
        assert self.process.stdin is not None
        os.write(self.process.stdin.fileno(), json.dumps({"t_ns": stamp, **body}).encode() + b"\n")
        self.sent.append((time.monotonic(), stamp))

    def drain(self) -> bool:
        """Read what has come out; whether anything has."""
        assert self.process.stdout is not None
        descriptor, some = self.process.stdout.fileno(), False
        while select.select([descriptor], [], [], 0.0)[0] and os.read(descriptor, 65536):
            some = True
        return some

    def kill(self) -> None:
        self.killed = time.monotonic()
        self.process.kill()
        self.process.communicate()


@pytest.mark.long
@pytest.mark.parametrize("seed", range(10))
def test_killed_at_any_moment(data, tmp_path, seed: int) -> None:
    """Fifty kills at random moments: each record fuses, and lacks the last second at most."""
    rng, config = random.Random(seed), pf.FusionConfig.load(data / "fusion.toml")
    fed = [Fed(data, tmp_path / f"run{number}") for number in range(5)]
    answered, step = set[int](), 0
    while len(answered) < len(fed):
        for number, one in enumerate(fed):
            one.feed(step)
            if one.drain():
                answered.add(number)
        step += 1
        time.sleep(0.005)
    due = {number: time.monotonic() + 0.6 + rng.uniform(0.0, 2.0) for number in range(len(fed))}
    while due:
        for number in list(due):
            if time.monotonic() > due[number]:
                fed[number].kill()
                del due[number]
            else:
                fed[number].feed(step)
                fed[number].drain()
        step += 1
        time.sleep(0.005)
    for one in fed:
        found = pf.Run.read(one.folder)
        pf.fuse(found, config)
        there = {stamp for source in (found.command, *found.sensors.values()) for stamp in source.stamp.tolist()}
        first = int(found.command.stamp[0])
        missing = [at for at, stamp in one.sent if stamp >= first and at < one.killed - 1.0 and stamp not in there]
        assert missing == []


def broken(rng: random.Random, good: bytes, other: bytes) -> bytes:
    """A datagram with bytes changed, cut, doubled, or spliced with another."""
    found = bytearray(good)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(found) + 1)
        match rng.randrange(6):
            case 0:
                found[at : at + 1] = rng.randbytes(1)
            case 1:
                del found[at : at + rng.randint(1, 10)]
            case 2:
                found[at:at] = rng.randbytes(rng.randint(1, 20))
            case 3:
                found[at:at] = rng.choice(
                    (b"9" * 30, b"e308", b"-", b"[" * 50, b"{", b'"', b"null", b"NaN", b"\0", b"\n")
                )
            case 4:
                found[at:] = other[at:]
            case _:
                found[at:at] = found[: rng.randrange(len(found) + 1)]
    return bytes(found)


def is_json(line: bytes) -> bool:
    """Whether the standard library reads a line as an object."""
    try:
        return isinstance(json.loads(line), dict)
    except (ValueError, RecursionError):
        return False


@pytest.mark.long
def test_a_million_broken_datagrams(data) -> None:
    """No crash, no hang, no memory; every estimate is, to the last bit, what it would be without the garbage."""
    count = 1_000_000
    rng, written = random.Random(count), list[bytes]()
    shadow = Stream(pf.LiveEstimator(pf.FusionConfig.load(data / "fusion.toml")), written.extend, lambda _: None)
    garbage, least = 0, 0
    with live("udp://127.0.0.1:0", data / "fusion.toml") as process, socket.socket(type=socket.SOCK_DGRAM) as ours:
        place = ("127.0.0.1", process.port())
        for piece in range(count // 100):
            t, radial = piece * 0.028, 560.0 + rng.gauss(0.0, 0.05)
            measurement = {"t": t, "sensor": "tracker", "radial": radial, "vertical": -90.0}
            command = {"t": t, "command": {"radial": 560.0, "vertical": -90.0}}
            good = [json.dumps(body).encode() for body in (measurement, command)]
            for _ in range(100):
                datagram = broken(rng, rng.choice(good), rng.choice(good))
                ours.sendto(datagram, place)
                events = [line for line in datagram.split(b"\n") if is_json(line)]
                shadow.take(events)
                garbage += not events
            for line in good:
                ours.sendto(line, place)
            shadow.take(good)
            assert process.received(len(written)) == written
            written.clear()
            if piece == count // 500:
                least = process.memory()
        assert process.memory() < least + 4096, "memory grows"
        log = process.end()
    assert garbage > 0.5 * count
    assert f"{count + 2 * (count // 100)} datagrams taken in, 0 lost" in log
