"""The wire format: one JSON object a line, in and out; mm or degrees, s and ns on the wire, SI or ns inside."""

from __future__ import annotations

import codecs
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import msgspec
from msgspec import UNSET, UnsetType

from ..errors import ConfigError, printable
from ..logs.frames import CARTESIAN
from ..space.rotations import TURNING
from ..units import MM, SCREEN, Kind
from .results import LiveEstimate
from .tool import NOISE, ORIENTATION

_LONGEST = 64 * 1024  # bytes of a line
_NAMES = ("t", "t_ns", "command", "sensor", NOISE)
_QUATERNION = "q"  # x, y, z, w; an arm that does not turn a tool may have an axis of this name
_KEYS = {  # of an estimate, and their scale
    kind: (f"position_{one.unit}", f"sd_{one.unit}", f"velocity_{one.unit}_s", one.scale)
    for kind, one in SCREEN.items()
}


class Lines:
    """Splitter of a stream's pieces, of any length, into whole lines.

    A line of more than 64 KiB is cut off, so that it needs no memory; :class:`LineDecoder` refuses what is left of it.
    """

    def __init__(self) -> None:
        self._torn, self._too_long = b"", False

    def cut(self, piece: bytes) -> list[bytes]:
        """The lines that end in this piece."""
        *lines, rest = piece.split(b"\n")
        if lines:
            lines[0] = self._torn + lines[0]
            if self._too_long:
                del lines[0]
            self._torn, self._too_long = b"", False
        if not self._too_long:
            self._torn += rest
        if len(self._torn) > _LONGEST:
            lines.append(self._torn)
            self._torn, self._too_long = b"", True
        return lines

    def rest(self) -> list[bytes]:
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


class LineDecoder:
    """Decoder of lines into events, for one arm's axes."""

    def __init__(
        self, kinds: Mapping[str, Kind], framed: bool, joints: Mapping[str, Kind] = MappingProxyType({})
    ) -> None:
        """Prepare for axes and joints, and with a frame for x, y, z; none may be called as a part of a line."""
        every: dict[str, Kind] = {**dict.fromkeys(CARTESIAN if framed else (), "length"), **kinds, **joints}
        self._axes = tuple(dict.fromkeys((*kinds, *every)))
        self._scales = [SCREEN[every[axis]].scale for axis in self._axes]
        self._turns = _QUATERNION not in kinds or set(TURNING) <= kinds.keys()
        self._names = (*_NAMES, _QUATERNION) if self._turns else _NAMES
        for axis in self._axes:
            what = f"{'joint' if axis in joints else 'axis'} {printable(axis)!r}"
            if axis in self._names:
                raise ConfigError(f"{what}: lines of a stream call something else so ({', '.join(self._names)})")
            if not axis.isprintable() or set(axis) & set('\\"'):
                raise ConfigError(
                    f"{what}: names in lines of a stream have no quotes, backslashes or control characters"
                )
        fields: list[tuple[str, Any, Any]] = [
            (f"axis_{number}", float | UnsetType | None, UNSET) for number in range(len(self._axes))
        ]
        names = {f"axis_{number}": axis for number, axis in enumerate(self._axes)}
        options: dict[str, Any] = {"rename": names, "forbid_unknown_fields": True, "gc": False}
        if self._turns:
            fields.append((_QUATERNION, tuple[float, float, float, float] | UnsetType | None, UNSET))
        command = msgspec.defstruct("Command", fields, **options)
        head = [
            ("t", float | None, None),
            ("t_ns", int | None, None),
            ("command", command | None, None),
            ("sensor", str | None, None),
            (NOISE, float | UnsetType | None, UNSET),
        ]
        self._decoder = msgspec.json.Decoder(msgspec.defstruct("Line", [*head, *fields], **options))

    def decode(self, line: bytes) -> Event:
        """The event of a line."""
        if len(line) > _LONGEST:
            raise BadLine("longer than 64 KiB")
        try:
            try:
                found, unknown = self._decoder.decode(line), {}
            except msgspec.ValidationError as error:
                if "unknown field" not in str(error):
                    raise
                found, unknown = self._without_unknown(line)
        except msgspec.ValidationError as error:
            raise BadLine(str(error)) from None
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            rest = line.removeprefix(codecs.BOM_UTF8)  # with which PowerShell begins what it pipes
            if rest != line and not rest.startswith(codecs.BOM_UTF8):
                return self.decode(rest)
            raise BadLine(f"not JSON: {error}") from None
        t, t_ns, command, sensor, noise, *values = msgspec.structs.astuple(found)
        if command is not None:
            if sensor is not None or any(value is not UNSET for value in (noise, *values)):
                raise BadLine("gives a command and a measurement at once")
            sensor, values = "", [*msgspec.structs.astuple(command)]
        elif not sensor:
            raise BadLine("gives neither 'command' nor 'sensor'" if sensor is None else "'sensor' is empty")
        if (t is None) == (t_ns is None):
            raise BadLine("needs one of 't' (s) and 't_ns' (ns)")
        orientation = values.pop() if self._turns else None
        by_axis: dict[str, Any] = {
            axis: float("nan") if value is None else cast(float, value) / scale
            for axis, scale, value in zip(self._axes, self._scales, values, strict=True)
            if value is not UNSET
        }
        if isinstance(orientation, tuple):
            by_axis[ORIENTATION] = orientation
        if noise is not UNSET:
            by_axis[NOISE] = noise
        return Event(cast(float | int, t if t_ns is None else t_ns), sensor, by_axis | unknown)

    def _without_unknown(self, line: bytes) -> tuple[msgspec.Struct, dict[str, Any]]:
        """A line without its unknown names, and the values under those."""
        tree = cast(dict[str, Any], msgspec.json.decode(line))
        unknown = {name: tree.pop(name) for name in list(tree) if name not in self._names and name not in self._axes}
        if isinstance(tree.get("command"), dict):
            command = cast(dict[str, Any], tree["command"])
            known = {*self._axes, *self._names[len(_NAMES) :]}
            unknown |= {name: command.pop(name) for name in list(command) if name not in known}
        return self._decoder.decode(msgspec.json.encode(tree)), unknown


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
