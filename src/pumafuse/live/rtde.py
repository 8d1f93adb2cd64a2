"""A robot of Universal Robots as a source of events: what its controller tells by RTDE, version 2 of the protocol.

Where the controller wants the arm to be (``target_q``, ``target_TCP_pose``) are the commands, its encoders
(``actual_q``, ``actual_TCP_pose``) a sensor, and more than one may listen. Names are those that UR's own ``record.py``
gives to the columns of its CSV files, so the ``run.toml`` that reads such a file reads the running robot: an element of
a vector is ``target_q_0``.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace

from ..errors import ConfigError
from ..logs.columns import LOG_TIME
from ..logs.manifest import Manifest
from .address import Address
from .messages import readers_of
from .network import EventClient, Refused
from .wire import Event

_HEAD = struct.Struct(">HB")  # bytes of a package, and its type
_VERSION, _OUTPUTS, _BEGIN, _DATA, _TEXT = b"VOSUM"  # types of packages
_PROTOCOL = 2
_TYPES = {  # of variables, in big endian
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
_PATIENCE = 5.0  # s without a package, of a robot that sends one every few ms


class RtdeSource(EventClient):
    """Events of a robot."""

    def __init__(self, address: Address, listed: Manifest, rate: float, notify: Callable[[str], None]) -> None:
        """Prepare; the robot is to send at a ``rate`` [Hz]: it knows up to 125, of the e-Series up to 500."""
        super().__init__(address, notify)
        self._readers = readers_of(listed)
        asked = [column for reader in self._readers for column in reader.entry.fields if column != LOG_TIME]
        self._variables = dict.fromkeys(map(_variable, asked))
        self._rate = rate
        if not self._variables:
            raise ConfigError(f"{self._name}: run.toml names no column of the robot, as in target_q_0")

    def _receive(self, connection: socket.socket) -> Iterator[list[Event]]:
        connection.settimeout(_PATIENCE)
        packages = _packages(connection)
        recipe, layout, columns = self._agree(connection, packages)
        for kind, body in packages:
            received = time.time_ns()
            if kind == _DATA and body[:1] == recipe:
                row = SimpleNamespace(**dict(zip(columns, layout.unpack_from(body, 1), strict=True)))
                yield [event for reader in self._readers for event in reader.events(row, received)]

    def _agree(
        self, connection: socket.socket, packages: Iterator[tuple[int, bytes]]
    ) -> tuple[bytes, struct.Struct, list[str]]:
        """Agree on what is sent, and let the robot begin: the first byte of data packages, and the columns after it."""

        def ask(kind: int, body: bytes) -> bytes:
            connection.sendall(_HEAD.pack(_HEAD.size + len(body), kind) + body)
            for answer, content in packages:
                if answer == kind:
                    return content
            raise Refused("the robot has ended the connection instead of an answer")

        if ask(_VERSION, struct.pack(">H", _PROTOCOL)) != b"\x01":
            raise Refused(f"the robot does not know version {_PROTOCOL} of RTDE (software 3.3 or newer does)")
        answer = ask(_OUTPUTS, struct.pack(">d", self._rate) + ",".join(self._variables).encode())
        types = dict(zip(self._variables, answer[1:].decode("ascii", "replace").split(","), strict=False))
        if unknown := [name for name in self._variables if types.get(name) not in _TYPES]:
            raise Refused(f"the robot has no variable {', '.join(unknown)}; names are those of record.py")
        sizes = {name: int(_TYPES[kind][:-1] or 1) for name, kind in types.items()}
        columns = [
            column
            for name, size in sizes.items()
            for column in ([name] if size == 1 else [f"{name}_{index}" for index in range(size)])
        ]
        empty = SimpleNamespace(**dict.fromkeys(columns, 0.0))
        if lacking := [path for reader in self._readers for path in reader.missing_fields(empty)]:
            raise Refused(f"the robot has no column {', '.join(lacking)}; it has {', '.join(columns)}")
        if ask(_BEGIN, b"") != b"\x01":
            raise Refused(f"the robot does not begin to send {self._rate:g} times a second")
        return answer[:1], struct.Struct(">" + "".join(_TYPES[kind] for kind in types.values())), columns


def _variable(column: str) -> str:
    """The variable that a column is of: ``target_q_0`` is an element of ``target_q``; registers are numbered alike."""
    name, _, index = column.rpartition("_")
    return name if len(index) == 1 and index.isdigit() and not name.endswith("_register") else column


def _packages(connection: socket.socket) -> Iterator[tuple[int, bytes]]:
    """Type and body of each package, until the connection ends."""
    with connection.makefile("rb") as stream:
        while len(head := stream.read(_HEAD.size)) == _HEAD.size:
            size, kind = _HEAD.unpack(head)
            body = stream.read(max(size - _HEAD.size, 0))
            if len(body) < size - _HEAD.size:
                return
            yield kind, body
