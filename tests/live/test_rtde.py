"""A robot of Universal Robots as a source: between a robot's end of our own and `pumafuse live`, by UR's protocol."""

import contextlib
import json
import math
import socket
import struct
import threading
import time
from collections.abc import Callable, Generator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from listening import live, until
from pumafuse.live.address import Address
from pumafuse.live.rtde import RtdeSource
from pumafuse.logs import manifest

RUN = """
[command]
file = "robot.csv"
time = { column = "timestamp", unit = "s" }
elbow = { column = "target_q_2", unit = "rad" }
x = { column = "target_TCP_pose_0", unit = "m" }

[sensors.encoder]
file = "robot.csv"
time = { column = "timestamp", unit = "s" }
elbow = { column = "actual_q_2", unit = "rad" }
"""
ARM = """
name = "ur"
update_period_ms = 8.0
delay_ms = 20.0
[axes.x]
plant = "first-order"
time_constant_ms = 20.0
[axes.elbow]
kind = "angle"
plant = "first-order"
time_constant_ms = 20.0
"""
FUSION = """
arm = "arm.toml"
[process]
input_noise_mm_rtHz = 0.3
drift_mm_rts = 0.3
input_noise_deg_rtHz = 0.3
drift_deg_rts = 0.3
[sensors.encoder]
sd_deg = 0.1
[sensors.tracker]
sd_mm = 0.1
"""
TYPES = {"timestamp": "DOUBLE", "target_q": "VECTOR6D", "target_TCP_pose": "VECTOR6D", "actual_q": "VECTOR6D"}
TYPES |= {"robot_mode": "INT32", "output_int_register_0": "INT32"}
ROWS = 80


def state(k: int) -> dict[str, list[float]]:
    """What the robot is and wants at its k-th step of 8 ms."""
    angle = 0.5 * math.sin(k / 40.0)
    joints = [0.1, 0.2, angle, 0.4, 0.5, 0.6]
    actual = [*joints[:2], 0.5 * math.sin((k - 5) / 40.0), *joints[3:]]
    pose = [0.3 * math.cos(k / 30.0), 0.0, 0.4, 0.0, 3.1, 0.0]
    found = {"timestamp": [100.0 + 0.008 * k], "target_q": joints, "target_TCP_pose": pose, "actual_q": actual}
    return found | {"robot_mode": [7], "output_int_register_0": [k]}


class Robot:
    """A robot's end: it agrees on what it sends, sends ``rows`` packages to each who asks, and hangs up."""

    def __init__(self, rows: int = ROWS, version: int = 2, types: dict[str, str] | None = None) -> None:
        self.rows, self.version, self.types = rows, version, TYPES if types is None else types
        self.asked: list[tuple[float, list[str]]] = []
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                self.answer(self.socket.accept()[0])

    def answer(self, connection: socket.socket) -> None:
        def send(kind: bytes, body: bytes) -> None:
            connection.sendall(struct.pack(">H", 3 + len(body)) + kind + body)

        stream, names = connection.makefile("rb"), list[str]()
        with connection, contextlib.suppress(OSError):
            while head := stream.read(3):
                size, kind = struct.unpack(">Hc", head)
                body = stream.read(size - 3)
                if kind == b"V":
                    send(b"V", bytes([struct.unpack(">H", body)[0] == self.version]))
                elif kind == b"O":
                    names = body[8:].decode().split(",")
                    self.asked.append((struct.unpack(">d", body[:8])[0], names))
                    send(b"O", b"\x01" + ",".join(self.types.get(name, "NOT_FOUND") for name in names).encode())
                elif kind == b"S":
                    send(b"M", b"\x05hello\x02us\x01")  # it may say something at any time
                    send(b"S", b"\x01")
                    self.send_rows(send, names)
                    return

    def send_rows(self, send: Callable[[bytes, bytes], None], names: list[str]) -> None:
        letters = {"DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i"}
        begin = time.monotonic()
        for k in range(self.rows):
            time.sleep(max(begin + 0.008 * k - time.monotonic(), 0.0))
            values = [struct.pack(">" + letters[self.types[name]], *state(k)[name]) for name in names]
            send(b"U", b"\x01" + b"".join(values))


@pytest.fixture
def robot() -> Generator[Callable[..., Robot]]:
    robots = list[Robot]()

    def begin(*given: object, **more: object) -> Robot:
        robots.append(Robot(*given, **more))
        return robots[-1]

    yield begin
    for one in robots:
        one.socket.close()


def written(folder: Path) -> Path:
    """What UR's record.py writes of the same, with its names, a blank between columns; and the run.toml of it."""
    names = ["timestamp", *(f"{name}_{k}" for name in ("target_q", "target_TCP_pose", "actual_q") for k in range(6))]
    rows = [" ".join(names)]
    for k in range(ROWS):
        one = state(k)
        rows.append(
            " ".join(map(repr, [*one["timestamp"], *one["target_q"], *one["target_TCP_pose"], *one["actual_q"]]))
        )
    (folder / "robot.csv").write_text("\n".join(rows) + "\n")
    for name, text in {"run": RUN, "arm": ARM, "fusion": FUSION}.items():
        (folder / f"{name}.toml").write_text(text)
    return folder / "run.toml"


def source(robot: Robot, run: str, notices: list[str]) -> RtdeSource:
    listed = manifest.of_tables(manifest.toml.parsed(run, "run.toml"))
    return RtdeSource(Address.parse(f"rtde:run.toml?host=127.0.0.1:{robot.port}"), listed, 125.0, notices.append)


def test_a_running_robot_is_what_its_record_says(tmp_path: Path, robot: Callable[..., Robot]) -> None:
    """Row by row as the CSV file that UR's record.py writes is read; asked for no more than is needed."""
    run, one = pf.Run.read(written(tmp_path).parent), robot()
    found = source(one, RUN, [])
    found.start()
    came = until(found, lambda taken: len(taken) >= 2 * ROWS)[: 2 * ROWS]
    found.stop()
    assert one.asked[0][0] == 125.0
    assert sorted(one.asked[0][1]) == ["actual_q", "target_TCP_pose", "target_q", "timestamp"]
    for name, kept in {"": run.command, **run.sensors}.items():
        mine = [event for event in came if event.sensor == name]
        assert [event.t for event in mine] == kept.stamp.tolist()
        for axis, value in kept.values.items():
            assert np.array_equal([event.values[axis] for event in mine], value)


def test_a_robot_that_hangs_up_is_called_again(robot: Callable[..., Robot]) -> None:
    """As a server of lines is."""
    notices = list[str]()
    one = robot(rows=20)
    found = source(one, RUN, notices)
    found.start()
    until(found, lambda taken: len(taken) >= 60)
    found.stop()
    assert any("the connection has ended" in notice for notice in notices)
    assert "connections made: 2" in found.summary()


@pytest.mark.parametrize(
    ("more", "run", "words"),
    [
        ({"version": 1}, RUN, "does not know version 2"),
        ({"types": {"timestamp": "DOUBLE", "target_q": "VECTOR6D"}}, RUN, "no variable actual_q, target_TCP_pose"),
        ({"types": TYPES | {"target_q": "DOUBLE"}}, RUN, "no column target_q_2"),
        ({}, RUN.replace(', unit = "s"', ""), "column 'timestamp' has no unit"),
    ],
)
def test_what_a_robot_refuses_is_said(
    robot: Callable[..., Robot], more: dict[str, object], run: str, words: str
) -> None:
    notices = list[str]()
    found = source(robot(**more), run, notices)
    found.start()
    assert until(found, lambda _: any(words in notice for notice in notices)) == []
    found.stop()
    assert sum(words in notice for notice in notices) == 1


BODIES = st.sampled_from([b"", b"\x01", b"\x01DOUBLE,VECTOR6D,VECTOR6D,VECTOR6D", bytes(160)]) | st.binary(max_size=60)


@given(st.lists(st.tuples(st.sampled_from(list(b"VOSUMx")), BODIES), max_size=6), st.binary(max_size=5))
@settings(max_examples=100)
def test_whatever_a_server_sends_ends_in_a_sentence(packages: list[tuple[int, bytes]], rest: bytes) -> None:
    """One that speaks another protocol, or a broken one: no exception in the thread."""
    listed = manifest.of_tables(manifest.toml.parsed(RUN, "run.toml"))
    found = RtdeSource(Address.parse("rtde:a?host=127.0.0.1"), listed, 125.0, lambda _: None)
    ours, theirs = socket.socketpair()
    answers = [(ord("V"), b"\x01"), *packages]
    theirs.sendall(b"".join(struct.pack(">HB", 3 + len(body), kind) + body for kind, body in answers) + rest)
    theirs.shutdown(socket.SHUT_WR)
    found._read(ours)
    theirs.close()
    assert all(event.sensor in ("", "encoder") for event in found.stop())


def test_with_a_tracker_beside_it(tmp_path: Path, robot: Callable[..., Robot]) -> None:
    """Two sources at once: the robot's commands and encoders, and lines of a tracker; all is recorded and fuses."""
    run = written(tmp_path)
    run.write_text(RUN.replace('{ column = "timestamp", unit = "s" }', '"log_time"'))
    one = robot(rows=160)
    address = f"rtde:{run}?host=127.0.0.1:{one.port}"
    options = "udp://127.0.0.1:0", "--record", str(tmp_path / "record")
    with live(address, tmp_path / "fusion.toml", *options) as process:
        place = ("127.0.0.1", process.port())
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tracker:
            estimates = [json.loads(process.received(1)[0]) for _ in range(30)]
            for _ in range(30):
                tracker.sendto(json.dumps({"t_ns": time.time_ns(), "sensor": "tracker", "x": 300.0}).encode(), place)
                estimates.append(json.loads(process.received(1)[0]))
        log = process.end()
    assert one.asked[0][0] == 125.0  # once an update period
    assert {"x", "elbow"} <= estimates[-1].keys()
    assert "30 datagrams taken in, 0 lost" in log
    assert "connections made: 1" in log
    recorded = pf.Run.read(tmp_path / "record")
    assert len(recorded.sensors["tracker"].stamp) == 30
    assert len(recorded.sensors["encoder"].stamp) >= 60
