"""Messages through the pipe from a live estimator to the process that draws: one header, then frames.

Each is msgpack with its length before it. Times are seconds since the first event, everything else is SI.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO, TypeAlias

import msgspec

Rows: TypeAlias = dict[str, list[tuple[float, ...]]]

_LENGTH = 4  # bytes
_LARGEST = 1 << 26  # bytes of a frame


class SensorHead(msgspec.Struct, array_like=True):
    """How a sensor's measurements become positions: (z − bias) / scale, at stamp − latency.

    Attributes:
        scale: Of the position in the measurement.
        latency: [s].
        biased: Whether a constant bias must be found first.
    """

    scale: float
    latency: float
    biased: bool


class Header(msgspec.Struct):
    """What is drawn, and where.

    Attributes:
        mode: ``spawn``, ``connect`` or ``web``.
        axes: The arm's, in their order.
        space: The three axes, or x, y, z, that are a position in space; empty without.
        sensors: By name.
        port: Where the viewer listens.
        web_port: Where its page is served.
    """

    mode: str
    axes: tuple[str, ...]
    space: tuple[str, ...]
    sensors: dict[str, SensorHead]
    port: int
    web_port: int


class SensorsNow(msgspec.Struct, array_like=True):
    """NIS and rate [Hz] of the sensors that have them, at one time [s]."""

    time: float
    nis: dict[str, float]
    rate: dict[str, float]


class Frame(msgspec.Struct):
    """Everything since the frame before, as rows that begin with their time [s].

    Attributes:
        commands: By axis, rows with u [m].
        measurements: By ``axis/sensor``, rows with z [m] and whether it was rejected (0 or 1).
        estimates: By axis, rows with position and sd [m].
        paths: By ``command``, ``estimate`` and sensors in x, y, z, rows with a position in space [m].
        health: Now and then.
    """

    commands: Rows = {}
    measurements: Rows = {}
    estimates: Rows = {}
    paths: Rows = {}
    health: SensorsNow | None = None

    def add(self, later: Frame) -> None:
        """Add the rows of a later frame."""
        for kind in ("commands", "measurements", "estimates", "paths"):
            mine: Rows = getattr(self, kind)
            for name, rows in getattr(later, kind).items():
                mine.setdefault(name, []).extend(rows)
        self.health = later.health or self.health


def packed(message: Header | Frame) -> bytes:
    """A message as it goes through the pipe."""
    body = msgspec.msgpack.encode(message)
    return len(body).to_bytes(_LENGTH, "big") + body


def bodies(pipe: BinaryIO) -> Iterator[bytes]:
    """The messages that come out of the pipe, until it ends."""
    while len(head := pipe.read(_LENGTH)) == _LENGTH:
        length = int.from_bytes(head, "big")
        body = pipe.read(length)
        if length > _LARGEST or len(body) < length:
            return
        yield body
