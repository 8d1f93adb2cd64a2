"""The wire format: one JSON object a line, in and out; mm or degrees, s and ns on the wire, SI or ns inside."""

from __future__ import annotations

import codecs
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec
from msgspec import UNSET, UnsetType

from ..errors import ConfigError, printable
from ..logs.frames import CARTESIAN
from ..space.rotations import TURNING
from ..units import MM, SCREEN, Kind
from .results import LiveEstimate
from .tool import NOISE, ORIENTATION

_LONGEST = 64 * 1024  # bytes of a line
_QUATERNION = "q"  # x, y, z, w; an arm that does not turn a tool may have an axis of this name
_KEYS = {  # of an estimate, and their scale
    kind: (f"position_{screen.unit}", f"sd_{screen.unit}", f"velocity_{screen.unit}_s", screen.scale)
    for kind, screen in SCREEN.items()
}


class Lines:
    """Splitter of a stream's pieces, of any length, into whole lines.

    A line of more than 64 KiB is cut off, so that it needs no memory; :class:`LineDecoder` refuses what is left of it.
    """

    def __init__(self) -> None:
        self._torn, self._too_long = b"", False

    def cut(self, piece: bytes) -> list[bytes]:
        """The lines that end in this piece."""
        *lines, remainder = piece.split(b"\n")
        if lines:
            lines[0] = self._torn + lines[0]
            if self._too_long:
                del lines[0]
            self._torn, self._too_long = b"", False
        if not self._too_long:
            self._torn += remainder
        if len(self._torn) > _LONGEST:
            lines.append(self._torn)
            self._torn, self._too_long = b"", True
        return lines

    def take_last(self) -> list[bytes]:
        """The last line, if the stream ended without a line end."""
        left, self._torn = self._torn, b""
        return [left] if left else []


class BadLine(Exception):  # noqa: N818 - it is what the line is called, and never leaves the stream
    """A line that is no event; its text says why."""


class Event(NamedTuple):
    """A command (no sensor) or a measurement.

    Its values are by axis or joint [m or rad], an orientation as a quaternion x, y, z, w, and perhaps by what the noise
    of a measurement is scaled; those under unknown names are passed on as they are.
    """

    t: float | int  # float seconds or int nanoseconds
    sensor: str  # its name, empty for a command
    values: Mapping[str, Any]


class _Head(msgspec.Struct):
    """What is no value of a line."""

    t: float | None = None
    t_ns: int | None = None
    command: dict[str, Any] | None = None
    sensor: str | None = None
    noise: float | None = None


_HEAD = _Head.__struct_fields__
_TREE = msgspec.json.Decoder(dict[str, Any])


class LineDecoder:
    """Decoder of lines into events, for one arm's axes."""

    def __init__(
        self, kinds: Mapping[str, Kind], framed: bool, joints: Mapping[str, Kind] = MappingProxyType({})
    ) -> None:
        """Prepare for axes and joints, and with a frame for x, y, z; none may be called as a part of a line."""
        every: dict[str, Kind] = {**dict.fromkeys(CARTESIAN if framed else (), "length"), **kinds, **joints}
        turns = _QUATERNION not in kinds or set(TURNING) <= kinds.keys()
        parts = (*_HEAD, _QUATERNION) if turns else _HEAD
        for axis in every:
            what = f"{'joint' if axis in joints else 'axis'} {printable(axis)!r}"
            if axis in parts:
                raise ConfigError(f"{what}: lines of a stream call something else so ({', '.join(parts)})")
            if not axis.isprintable() or set(axis) & set('\\"'):
                raise ConfigError(
                    f"{what}: names in lines of a stream have no quotes, backslashes or control characters"
                )
        types: dict[str, Any] = dict.fromkeys(every, float | UnsetType | None)
        types |= {_QUATERNION: tuple[float, float, float, float] | UnsetType | None} if turns else {}
        self._axes = [(axis, SCREEN[kind].scale) for axis, kind in every.items()]
        self._values, self._turns = frozenset(types), turns
        fields = [(f"value_{number}", kind, UNSET) for number, kind in enumerate(types.values())]
        rename = {f"value_{number}": name for number, name in enumerate(types)}
        self._struct = msgspec.defstruct("Values", fields, rename=rename, gc=False)

    def decode(self, line: bytes) -> Event:
        """The event of a line."""
        if len(line) > _LONGEST:
            raise BadLine("longer than 64 KiB")
        try:
            tree = _TREE.decode(line)
            head = msgspec.convert(tree, _Head)
            fields = tree if head.command is None else head.command
            values = msgspec.structs.astuple(msgspec.convert(fields, self._struct))
        except msgspec.ValidationError as error:
            raise BadLine(str(error)) from None
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            stripped = line.removeprefix(codecs.BOM_UTF8)  # with which PowerShell begins what it pipes
            if stripped != line and not stripped.startswith(codecs.BOM_UTF8):
                return self.decode(stripped)
            raise BadLine(f"not JSON: {error}") from None
        if head.command is not None:
            if head.sensor is not None or NOISE in tree or not self._values.isdisjoint(tree):
                raise BadLine("gives a command and a measurement at once")
        elif not head.sensor:
            raise BadLine("gives neither 'command' nor 'sensor'" if head.sensor is None else "'sensor' is empty")
        t = head.t if head.t_ns is None else head.t_ns
        if t is None or None not in (head.t, head.t_ns):
            raise BadLine("needs one of 't' (s) and 't_ns' (ns)")
        by_axis: dict[str, Any] = {
            axis: math.nan if value is None else value / scale
            for (axis, scale), value in zip(self._axes, values, strict=False)  # the last one may be a quaternion
            if value is not UNSET
        }
        if self._turns and isinstance(values[-1], tuple):
            by_axis[ORIENTATION] = values[-1]
        if NOISE in tree:
            by_axis[NOISE] = head.noise
        by_axis |= {name: value for name, value in tree.items() if name not in self._values and name not in _HEAD}
        if head.command is not None:
            by_axis |= {name: value for name, value in head.command.items() if name not in self._values}
        return Event(t, head.sensor or "", by_axis)


def encode(estimate: LiveEstimate, kinds: Mapping[str, Kind], with_ns: bool) -> bytes:
    """The line of an estimate; with its time as ``t_ns``, too."""
    line: dict[str, Any] = {"t": estimate.time}
    if with_ns:
        line["t_ns"] = estimate.stamp
    for name, axis in estimate.axes.items():
        position, sd, velocity, scale = _KEYS[kinds[name]]
        line[name] = {position: axis.position * scale, sd: axis.position_sd * scale, velocity: axis.velocity * scale}
    for name, position in (estimate.cartesian or {}).items():
        line[f"{name}_mm"] = position * MM
    if estimate.orientation is not None:
        line[_QUATERNION] = estimate.orientation
    if estimate.stale:
        line["stale"] = estimate.stale
    if estimate.doubtful:
        line["doubtful"] = estimate.doubtful
    return msgspec.json.encode(line) + b"\n"
