"""Poses by OpenIGTLink: what pyigtl packs and sends, and what others do by the protocol."""

import contextlib
import json
import math
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyigtl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyigtl.messages import MessageBase
from scipy.spatial.transform import Rotation

import pumafuse as pf
import turning
from listening import live, until
from pumafuse.live.address import Address
from pumafuse.live.openigtlink import OpenIgtLinkSource
from pumafuse.live.wire import Event

SERVER = Path(__file__).parents[1] / "igtl_server.py"
STAMP = 1_700_000_000.25  # s: its fraction is exact on the wire
TURN = Rotation.from_rotvec([0.3, -1.1, 0.7])
POINT = np.array([120.5, -40.25, 7.0])  # mm, exact in 32 bits
SECONDS = 2.0  # of the tool's motion
TURNING = ["x", "y", "z", "orientation"]


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> pf.FusionConfig:
    """Of an arm that turns its tool."""
    return pf.FusionConfig.load(configured(tmp_path_factory.mktemp("cell")))


def configured(folder: Path) -> Path:
    turned = turning.told(np.zeros(1))[1].as_rotvec(degrees=True)[0].tolist()
    return turning.configured(folder, f"[tool]\nreference_rotation_vector_deg = {turned}\n")


def taken(
    sent: bytes,
    config: pf.FusionConfig,
    option: str = "",
    enough: Callable[[list[Event], list[str]], object] = lambda found, _: found,
) -> tuple[list[Event], list[str]]:
    """The events of what a server sends before it hangs up, and the notices."""
    notices = list[str]()
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = Address.parse(f"igtl://127.0.0.1:{server.getsockname()[1]}{option}")
        source = OpenIgtLinkSource(address, config, notices.append)
        source.start()
        with server.accept()[0] as connection:
            threading.Thread(target=connection.sendall, args=(sent,)).start()
            found = until(source, lambda found: enough(found, notices))
            with contextlib.suppress(OSError):  # it has hung up
                connection.shutdown(socket.SHUT_RDWR)
        while not any("ended" in notice for notice in notices):
            time.sleep(0.01)
        return [*found, *source.stop()], notices


def transform(device: str = "camera", version: int = 1, **metadata: str) -> bytes:
    """A pose as pyigtl packs it."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = TURN.as_matrix(), POINT
    message = pyigtl.TransformMessage(matrix, timestamp=STAMP, device_name=device)
    message.header_version, message.metadata = version, metadata
    return message.pack()


def message(kind: str, content: bytes, device: str = "camera") -> bytes:
    """One of a kind that pyigtl does not know, or has otherwise."""
    one = MessageBase(timestamp=STAMP, device_name=device)
    one._message_type, one._pack_content = kind, lambda: content
    return one.pack()


def listed(name: str, numbers: list[float]) -> bytes:
    return struct.pack(f">20sBx{len(numbers)}f", name.encode(), 2, *numbers)


COLUMNS = [*TURN.as_matrix().T.ravel(), *POINT]
QUATERNION = [*POINT, *TURN.as_quat()]


@pytest.mark.parametrize(
    "sent",
    [
        transform(),
        transform(version=2),
        transform(version=2, TransformStatus="OK", MRMLNodeName="LinearTransform"),
        message("QTRANS", struct.pack(">7f", *QUATERNION)),
        message("POSITION", struct.pack(">7f", *QUATERNION)),
        message("TDATA", listed("camera", COLUMNS)),
        message("QTDATA", listed("camera", QUATERNION)),
    ],
    ids=["transform", "version 2", "metadata", "qtrans", "position", "tdata", "qtdata"],
)
def test_every_form_of_a_pose(sent: bytes, config: pf.FusionConfig) -> None:
    """The same point and orientation, as far as 32 bits have them, and the stamp to the ns."""
    [event], _ = taken(sent, config)
    assert (event.sensor, event.t) == ("camera", 1_700_000_000_250_000_000)
    assert [event.values[axis] for axis in "xyz"] == (POINT / 1e3).tolist()
    off = Rotation.from_quat(event.values["orientation"]) * TURN.inv()
    assert off.magnitude() < 1e-6


def test_several_devices_and_commands(config: pf.FusionConfig) -> None:
    """A list is an event each, in its order; the device ``command`` is the commands."""
    sent = transform("command") + message("TDATA", listed("left", COLUMNS) + listed("right", COLUMNS))
    events, _ = taken(sent, config, enough=lambda found, _: len(found) == 3)
    assert [event.sensor for event in events] == ["", "left", "right"]
    assert all(list(event.values) == TURNING for event in events)


@pytest.mark.parametrize("status", ["MISSING", "INVALID", "OUT_OF_WINDOW"])
def test_a_device_that_is_not_seen_has_no_values(status: str, config: pf.FusionConfig) -> None:
    """Its row is there, as that of a sensor that is lost."""
    [event], _ = taken(transform(version=2, TransformStatus=status), config)
    assert list(event.values) == ["x", "y", "z"]
    assert all(math.isnan(value) for value in event.values.values())


def test_what_an_arm_has_not_is_not_given() -> None:
    """Without axes that turn no orientation, and of an arm in x and y no z."""
    axes = {axis: pf.AxisModel(plant=pf.FirstOrder(time_constant=0.04)) for axis in "xy"}
    arm = pf.ArmModel(name="flat", update_period=0.02, delay=0.02, axes=axes)
    [event], _ = taken(transform(), pf.FusionConfig(arm=arm))
    assert event.values == dict(zip("xy", POINT / 1e3, strict=False))


def test_times_of_receipt(config: pf.FusionConfig) -> None:
    """By the option, and where a server gives no stamp."""
    before = time.time_ns()
    stamps = [taken(transform(), config, "?time=received")[0][0].t]
    unstamped = bytearray(transform())
    unstamped[34:42] = bytes(8)
    stamps.append(taken(bytes(unstamped), config)[0][0].t)
    assert all(before <= stamp <= time.time_ns() for stamp in stamps)


@pytest.mark.parametrize(
    ("sent", "words"),
    [
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nUser-Agent: none at all, but long\r\n\r\n", "a header of version"),
        (message("TRANSFORM", bytes(70_000)), "a TRANSFORM of 70000 bytes"),
        (message("TRANSFORM", bytes(20)), "no OpenIGTLink"),
        (message("TDATA", listed("camera", COLUMNS)[:-1]), "no OpenIGTLink"),
    ],
)
def test_what_is_no_openigtlink_is_said(sent: bytes, words: str, config: pf.FusionConfig) -> None:
    """One sentence, no event."""
    events, notices = taken(sent, config, enough=lambda _, said: any(words in one for one in said))
    assert events == []
    assert sum(words in notice for notice in notices) == 1


BODIES = st.sampled_from([b"", bytes(12), bytes(48), bytes(28), b"\xff" * 48, bytes(70)]) | st.binary(max_size=80)


@given(
    st.lists(st.tuples(st.sampled_from(["TRANSFORM", "TDATA", "QTDATA", "POSITION", "X"]), BODIES), max_size=4),
    st.integers(0, 4),
    st.binary(max_size=60),
)
@settings(max_examples=60)
def test_whatever_a_server_sends_ends_in_a_sentence(
    config: pf.FusionConfig, messages: list[tuple[str, bytes]], version: int, rest: bytes
) -> None:
    """No exception in the thread, and no value that is not of the protocol's types."""
    sent = b"".join(struct.pack(">H", version) + message(kind, body)[2:] for kind, body in messages) + rest
    source = OpenIgtLinkSource(Address.parse("igtl://127.0.0.1"), config, lambda _: None)
    ours, theirs = socket.socketpair()
    theirs.sendall(sent)
    theirs.close()
    source._read(ours)
    assert all(set(event.values) <= {*TURNING} for event in source.stop())


def test_what_is_not_taken_in_is_shed(config: pf.FusionConfig) -> None:
    """A server far faster than the filter: commands stay, the oldest measurements go, and that is said."""
    notices = list[str]()
    source = OpenIgtLinkSource(Address.parse("igtl://127.0.0.1"), config, notices.append)
    waiting = source._backlog
    commands, rows = [Event(k, "", {}) for k in range(100)], [Event(k, "camera", {}) for k in range(9000)]
    for event in (*commands, *rows):
        waiting.add(0.0, event)
    taken = [event for age in range(40) for event in waiting.take(0.1 * age)]  # the oldest waits longer and longer
    assert taken[:100] == commands and len(taken) + waiting.shed == 9100
    assert f"{waiting.shed} shed" in source.summary()
    assert any("shed so far" in notice for notice in notices)


@pytest.mark.filterwarnings("ignore:.*the run begins in motion")
def test_a_server_in_another_process(tmp_path: Path) -> None:
    """Commands and a camera of a tool that turns: estimates as of the record, and these within 0.5 mm of the truth."""
    poses: list[tuple[float, str, Any]] = []
    for name, (stamps, points, turns) in turning.sources().items():
        for stamp, point, turn in zip(stamps, points, turns, strict=True):
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), point * 1e3
            poses.append((stamp, name, matrix.tolist()))
    poses.sort(key=lambda one: (one[0], one[1] == "command"))  # as --as-live has them
    (tmp_path / "poses.json").write_text(
        json.dumps([one for one in poses if one[1] != "truth" and one[0] < turning.START + SECONDS])
    )
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, str(SERVER), str(port), str(tmp_path / "poses.json")]
    options = "--record", str(tmp_path / "record")
    with (
        subprocess.Popen(command) as server,
        live(f"igtl://127.0.0.1:{port}", configured(tmp_path), *options) as process,
    ):
        lines = [json.loads(line) for line in process.received(round(50 * SECONDS))]
        server.wait(60)
        log = process.end()
    assert f"{round(150 * SECONDS) - 10} events, 0 lost" in log
    est = pf.fuse(pf.Run.read(tmp_path / "record"), pf.FusionConfig.load(tmp_path / "fusion.toml"), mode="as-live")
    for axis in "xyz":
        assert [line[axis]["position_mm"] / 1e3 for line in lines] == pytest.approx(est[axis].position, abs=1e-12)
    truth = turning.told(est.time + est.origin / 1e9 - turning.START - turning.LATE)[0]
    off = est.pose.position - truth
    assert np.sqrt(np.mean(off[50:] ** 2)) < 0.5e-3
