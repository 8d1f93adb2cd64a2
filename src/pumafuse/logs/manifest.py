"""``run.toml``: which file and which columns are the commands, the sensors and the reference of a recorded run."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, cast

import msgspec

from .. import toml
from ..errors import ConfigError
from ..toml import NotNegative
from ..units import Kind, ending, kind_of
from .frames import Frame


class SourceEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A source of a run: its ``file``, its ``time`` column, and the columns of each axis, which are added up."""

    file: str
    time: str
    axes: dict[str, list[str]]


class CommandEntry(SourceEntry, frozen=True, kw_only=True):
    """The commands, with the start level by axis [m or rad], the kinds that its keys say, and how to use the stamps."""

    start: dict[str, float] = {}
    kinds: dict[str, Kind] = {}
    clock: Literal["stamps", "regular"] = "stamps"


class ReferenceEntry(SourceEntry, frozen=True, kw_only=True):
    """A reference for scoring, with the standard deviation of its own noise, of lengths [m] and of angles [rad]."""

    sd: NotNegative = msgspec.field(name="sd_mm", default=0.0)
    angular_sd: NotNegative = msgspec.field(name="sd_deg", default=0.0)


class Manifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What ``run.toml`` holds, in SI units."""

    command: CommandEntry
    name: str = ""
    sensors: dict[str, SourceEntry] = {}
    reference: ReferenceEntry | None = None
    frame: Frame | None = None


def load(path: Path) -> Manifest:
    """Read ``run.toml``.

    Raises:
        ConfigError: The file is no manifest; names the key and the accepted ones.
    """
    tree, where = toml.read(path), str(path)
    for key, kind in (("command", CommandEntry), ("reference", ReferenceEntry)):
        if key in tree:
            tree[key] = _source(tree[key], kind, where, key)
    sensors: Any = tree.get("sensors", {})
    if not isinstance(sensors, dict):
        raise ConfigError(f"{where}: sensors: expected a table for each sensor, as in [sensors.tracker]")
    named = cast(dict[str, Any], sensors)
    tree["sensors"] = {name: _source(table, SourceEntry, where, f"sensors.{name}") for name, table in named.items()}
    return toml.struct(tree, Manifest, where)


def _source(table: Any, kind: type[SourceEntry], where: str, path: str) -> SourceEntry:
    """A source from its table; every key that is none of the source's fields is an axis."""
    if not isinstance(table, dict):
        raise ConfigError(f"{where}: {path}: expected a table")
    keys: dict[str, Any] = dict(table)  # pyright: ignore[reportUnknownArgumentType]
    kinds: dict[str, Any] = {}
    if isinstance(keys.get("start"), dict):
        given = {key: axis_of(key, where, f"{path}.start") for key in keys["start"]}
        keys["start"] = {axis: keys["start"][key] for key, axis in given.items()}
        kinds = {axis: kind_of(key) for key, axis in given.items()}
    own = {field.encode_name for field in msgspec.structs.fields(kind)} - {"axes", "kinds"}
    axes = {axis: keys.pop(axis) for axis in list(keys) if axis not in own}
    for axis, columns in axes.items():
        if not columns or not isinstance(columns, str | list):
            raise ConfigError(
                f"{where}: {path}.{axis}: expected a column name or a list of them, as in {axis} = 'x_mm'"
            )
        axes[axis] = [columns] if isinstance(columns, str) else columns
    if not axes:
        raise ConfigError(f"{where}: [{path}] names no column for any axis, as in radial = 'y_mm'")
    more = {"kinds": kinds} if kinds else {}
    return toml.struct({**keys, **more, "axes": axes}, kind, where, path)


def axis_of(key: str, where: str, path: str) -> str:
    """``radial_mm`` → ``radial``; the number itself is already in m or rad.

    Raises:
        ConfigError: The key ends in no unit of a length or an angle.
    """
    unit = ending(key)
    if unit is None or kind_of(key) is None:
        raise ConfigError(f"{where}: {path}.{key} has no unit in its name, as in {key}_mm or {key}_deg")
    return key.removesuffix(unit)
