"""What goes through the pipe from a live estimator to the process that draws: one header, then frames.

Each is msgpack with its length before it. Times are seconds since the first event, everything else is SI.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

import msgspec

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


class Series(msgspec.Struct, array_like=True):
    """Values [m] at times [s]."""

    time: list[float] = []
    value: list[float] = []


class Met(msgspec.Struct, array_like=True):
    """One sensor's components [m] on one axis at their stamps [s], and which of them were rejected."""

    time: list[float] = []
    value: list[float] = []
    rejected: list[bool] = []


class Band(msgspec.Struct, array_like=True):
    """Positions [m] with their standard deviations [m]."""

    time: list[float] = []
    position: list[float] = []
    sd: list[float] = []


class Path(msgspec.Struct, array_like=True):
    """Positions in space [m]."""

    time: list[float] = []
    position: list[tuple[float, float, float]] = []


class SensorsNow(msgspec.Struct, array_like=True):
    """NIS and rate [Hz] of the sensors that have them, at one time [s]."""

    time: float
    nis: dict[str, float]
    rate: dict[str, float]


class Frame(msgspec.Struct):
    """What has come since the frame before.

    Attributes:
        commands: By axis.
        measurements: By sensor and axis.
        estimates: By axis.
        paths: Of ``command``, ``estimate`` and sensors in x, y, z.
        health: Now and then.
    """

    commands: dict[str, Series] = {}
    measurements: dict[str, dict[str, Met]] = {}
    estimates: dict[str, Band] = {}
    paths: dict[str, Path] = {}
    health: SensorsNow | None = None

    def add(self, later: Frame) -> None:
        """Take in what came after."""
        for axis, series in later.commands.items():
            mine = self.commands.setdefault(axis, Series())
            mine.time += series.time
            mine.value += series.value
        for sensor, axes in later.measurements.items():
            for axis, met in axes.items():
                mine = self.measurements.setdefault(sensor, {}).setdefault(axis, Met())
                mine.time += met.time
                mine.value += met.value
                mine.rejected += met.rejected
        for axis, band in later.estimates.items():
            mine = self.estimates.setdefault(axis, Band())
            mine.time += band.time
            mine.position += band.position
            mine.sd += band.sd
        for name, path in later.paths.items():
            mine = self.paths.setdefault(name, Path())
            mine.time += path.time
            mine.position += path.position
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
