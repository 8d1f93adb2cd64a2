"""The wire format: one JSON object a line, in and out; mm, s and ns there, m and s or ns here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import msgspec
from msgspec import UNSET, UnsetType

from ..errors import ConfigError
from ..logs.frames import CARTESIAN
from ..units import MM
from .answers import LiveEstimate
from .lines import LONGEST

_NAMES = ("t", "t_ns", "command", "sensor")


class BadLine(Exception):  # noqa: N818 - it is what the line is called, and never leaves the stream
    """A line that is no event; its text says why."""


class Event(NamedTuple):
    """A command (no sensor) or a measurement.

    Attributes:
        t: Float seconds or int nanoseconds.
        sensor: Its name, empty for a command.
        values: By axis [m]; what a line gives under unknown names is in it as it stands.
    """

    t: float | int
    sensor: str
    values: Mapping[str, Any]


class Wire:
    """Lines of a stream whose arm has certain axes."""

    def __init__(self, axes: Sequence[str], framed: bool) -> None:
        """Prepare for the axes' names, and for x, y, z where there is a frame.

        Raises:
            ConfigError: An axis has the name of another part of a line.
        """
        self._axes = tuple(dict.fromkeys((*axes, *(CARTESIAN if framed else ()))))
        for axis in self._axes:
            if axis in _NAMES:
                raise ConfigError(f"axis '{axis}': lines of a stream call something else so ({', '.join(_NAMES)})")
        fields = [(f"axis_{number}", float | UnsetType | None, UNSET) for number in range(len(self._axes))]
        names = {f"axis_{number}": axis for number, axis in enumerate(self._axes)}
        command = msgspec.defstruct("Command", fields, rename=names, forbid_unknown_fields=True, gc=False)
        line = msgspec.defstruct(
            "Line",
            [
                ("t", float | None, None),
                ("t_ns", int | None, None),
                ("command", command | None, None),
                ("sensor", str | None, None),
                *fields,
            ],
            rename=names,
            forbid_unknown_fields=True,
            gc=False,
        )
        self._decoder = msgspec.json.Decoder(line)

    def decode(self, line: bytes) -> Event:
        """The event that a line is.

        Raises:
            BadLine: It is none.
        """
        if len(line) > LONGEST:
            raise BadLine("longer than 64 KiB")
        try:
            found, strangers = self._decoder.decode(line), {}
        except msgspec.ValidationError as error:
            if "unknown field" not in str(error):
                raise BadLine(str(error)) from None
            found, strangers = self._with_strangers(line)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise BadLine(f"not JSON: {error}") from None
        t, t_ns, command, sensor, *values = msgspec.structs.astuple(found)
        if command is not None:
            values, given = msgspec.structs.astuple(command), [value for value in values if value is not UNSET]
            if sensor is not None or given:
                raise BadLine("gives a command and a measurement at once")
            sensor = ""
        elif sensor is None:
            raise BadLine("gives neither 'command' nor 'sensor'")
        elif not sensor:
            raise BadLine("'sensor' is empty")
        by_axis: dict[str, Any] = {
            axis: float("nan") if value is None else cast(float, value) / MM
            for axis, value in zip(self._axes, values, strict=True)
            if value is not UNSET
        }
        return Event(_time(t, t_ns), sensor, by_axis | strangers)

    def _with_strangers(self, line: bytes) -> tuple[msgspec.Struct, dict[str, Any]]:
        """A line with unknown names: these apart, to be told, and the rest of it."""
        try:
            tree = cast(dict[str, Any], msgspec.json.decode(line))
            known = {*_NAMES, *self._axes}
            strangers = {name: tree.pop(name) for name in list(tree) if name not in known}
            if isinstance(tree.get("command"), dict):
                command = cast(dict[str, Any], tree["command"])
                strangers |= {name: command.pop(name) for name in list(command) if name not in self._axes}
            return self._decoder.decode(msgspec.json.encode(tree)), strangers
        except msgspec.ValidationError as error:
            raise BadLine(str(error)) from None
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise BadLine(f"not JSON: {error}") from None


def _time(t: float | None, t_ns: int | None) -> float | int:
    if (t is None) == (t_ns is None):
        raise BadLine("needs one of 't' (s) and 't_ns' (ns)")
    return cast(float | int, t if t_ns is None else t_ns)


def encode(estimate: LiveEstimate, whole: bool) -> bytes:
    """An estimate as a line: position, its sd and velocity of each axis, x, y, z with a frame, and what is stale.

    Args:
        estimate: The estimate.
        whole: Give the time as ``t_ns``, too.
    """
    line: dict[str, Any] = {"t": estimate.time}
    if whole:
        line["t_ns"] = estimate.stamp
    for name, axis in estimate.axes.items():
        line[name] = {
            "position_mm": axis.position * MM,
            "sd_mm": axis.position_sd * MM,
            "velocity_mm_s": axis.velocity * MM,
        }
    for name, position in (estimate.cartesian or {}).items():
        line[f"{name}_mm"] = position * MM
    if estimate.stale:
        line["stale"] = estimate.stale
    return msgspec.json.encode(line) + b"\n"
