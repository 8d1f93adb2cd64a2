"""``run.toml``: which file and which columns are the commands, the sensors and the reference of a recorded run."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import Any, Literal, cast

import msgspec
import numpy as np

from .. import toml
from ..arrays import NO_STAMP, FloatArray, TimeArray
from ..errors import ConfigError, PumafuseError, UnknownNameError
from ..space import rotations
from ..space.kinematics import Chain
from ..space.rotations import CONVENTIONS, TURNING
from ..toml import NotNegative, Positive
from ..units import ANGLES, POSITIONS, TIMES, Kind, ending, from_si, kind_of, refuse_name
from .columns import SINCE, Table, leaf
from .frames import CARTESIAN, Frame
from .stamps import drop_wraps, spread

_OF_TIME = {"unit", "nanoseconds", "counter", "shift_s"}  # keys beside a column of stamps
_MOST = 2**63  # more than a whole number of a column can be
_LETTERS = {"".join(letters) for letters in product("xyz", repeat=3) if letters[0] != letters[1] != letters[2]}
_IN_POSE = "position", "orientation"  # what a Pose has, and a Transform:
_IN_TRANSFORM = "translation", "rotation"
_ERROR_WORD = re.compile(r"((?<![A-Za-z])e|E)rr(or)?s?(?![a-z])|(?<![A-Za-z])ERR(OR)?S?(?![A-Za-z])")
ERROR = "if it is the set point less what is measured, the commands are the sum of both"


class Column(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A column or field path, and its unit (``mm``) where its name does not end in it."""

    column: str  # its name or field path
    unit: str = ""  # without the bar
    # after which an angle begins anew [rad]: it is made to go on; 0: never
    turn: NotNegative = msgspec.field(name="turn_deg", default=0.0)
    # in which of the rows it is the axis: those in which each of these columns has this value
    where: dict[str, bool | int | float | str] = {}

    @property
    def ending(self) -> str:
        """Its unit as the ending of a name, empty where only its name says it."""
        return f"_{self.unit}" if self.unit else ""

    @property
    def kind(self) -> Kind | None:
        """The kind of axis that it is of, by its unit."""
        return kind_of(self.ending or leaf(self.column))

    def read(self, table: Table) -> tuple[FloatArray, str | None]:
        """Its numbers, NaN in rows that are another axis's, and a note; an angle that begins anew goes on."""
        numbers, note = table.numbers(self.column, self.ending)
        chosen = np.where(table.meets(self.where), numbers, np.nan) if self.where else numbers
        return table.unwrapped(repr(self), chosen, self.turn) if self.turn else chosen, note


class Time(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where the stamps of rows are."""

    column: str = ""  # of stamps; with a rate, of numbers of frames, and empty where each row is the next frame
    unit: str = ""  # without the bar
    nanoseconds: str = ""  # a column beside it, which is then of whole seconds
    counter: str = ""  # a column that numbers the rows, where they come in packets: they are spread by it
    # what is added to the stamps [s], as its clock is another one
    shift: float = msgspec.field(name="shift_s", default=0.0)
    # at which frames come [Hz], for a table without stamps; 0: there are some
    rate: NotNegative = msgspec.field(name="rate_hz", default=0.0)

    @property
    def ending(self) -> str:
        """Its unit as the ending of a name, empty where only its name says it."""
        return f"_{self.unit}" if self.unit else ""

    @property
    def columns(self) -> list[str]:
        """The columns that the stamps are read from."""
        return [column for column in (self.column, self.nanoseconds, self.counter) if column]

    def stamps(self, table: Table) -> tuple[TimeArray, list[str]]:
        """Stamps of the rows of a table, which go on where its clock begins anew, and notes."""
        stamp, note = self.as_logged(table)
        notes = [] if note is None else [note]
        if not self.rate:
            stamp, more = drop_wraps(stamp, f"{table.path.name}: {self.column}")
            notes += more
        if self.counter:
            stamp = spread(stamp, table.plain(self.counter)[0])
        if self.shift:
            stamp = np.where(stamp == NO_STAMP, stamp, stamp + round(self.shift * 1e9))
        return stamp, notes

    def as_logged(self, table: Table) -> tuple[TimeArray, str | None]:
        """Stamps as the table has them, without repair, and a note."""
        if self.rate:
            return table.frames(self.rate, self.column)
        return table.stamps(self.column, self.nanoseconds, self.ending)


class Orientation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Columns of an orientation in one of three forms, see :mod:`pumafuse.space.rotations`."""

    quaternion: tuple[str, str, str, str] | None = None
    order: rotations.Order = "xyzw"  # where w is among them
    rotation_vector: tuple[str, str, str] | None = None  # three columns of angles along the base's axes
    euler: tuple[str, str, str] | None = None  # three columns of angles, in the order of the convention's letters
    convention: str = ""  # 'kuka', 'fanuc', 'rpy' or letters as scipy has them; 'abb' for a quaternion w, x, y, z
    unit: str = ""  # of the angles, without the bar, where their names do not end in it

    @property
    def columns(self) -> tuple[str, ...]:
        """All its columns."""
        return self.quaternion or self.rotation_vector or self.euler or ()

    @property
    def letters(self) -> str:
        """The axes that Euler angles turn about, in their order."""
        return CONVENTIONS.get(self.convention, self.convention)

    def read(self, table: Table) -> tuple[FloatArray, list[str]]:
        """Quaternions x, y, z, w of the rows of a table, (rows, 4), and notes; NaN in rows that have none."""
        ending = Column("", self.unit).ending
        parts = [table.plain(column) if self.quaternion else table.numbers(column, ending) for column in self.columns]
        return self.quaternions(np.column_stack([part for part, _ in parts])), [note for _, note in parts if note]

    def quaternions(self, value: FloatArray) -> FloatArray:
        """Quaternions x, y, z, w of the numbers [rad] in its columns, (n, 3 or 4) → (n, 4); NaN for none."""
        if self.quaternion:
            return rotations.of_quaternions(value, "wxyz" if self.convention == "abb" else self.order)
        if self.rotation_vector:
            return rotations.of_vectors(value)
        return rotations.of_angles(value, self.letters)


class RowNoise(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A column that tells how noisy each row is, of the position and of the orientation alike."""

    sd: str = ""  # a column of standard deviations, or of an error
    variance: str = ""  # a column of variances in its place
    typical: Positive  # the value in a row whose noise is that of 'fusion.toml', in the unit of the column

    @property
    def column(self) -> str:
        """The column of standard deviations, or that of variances."""
        return self.sd or self.variance

    def factor(self, value: FloatArray) -> FloatArray:
        """By what the noise of rows is scaled; 1 where the column has no positive number, as in ROS what is unknown."""
        with np.errstate(invalid="ignore"):
            share = np.where((value > 0.0) & np.isfinite(value), value / self.typical, 1.0)
        return share if self.sd else np.sqrt(share)


class Robot(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A serial chain of a URDF, by which joints are a pose.

    Attributes:
        urdf: The file; in ``run.toml`` and ``fusion.toml`` beside these.
        base: The link that stands.
        tip: The link whose pose it is: the tool.
    """

    urdf: str
    base: str
    tip: str

    def beside(self, folder: Path) -> Robot:
        """The same with its file in a folder."""
        return msgspec.structs.replace(self, urdf=str(folder / self.urdf))


def chain_of(robot: Robot) -> Chain:
    """The kinematics of a robot."""
    return Chain.load(robot.urdf, robot.base, robot.tip)


class SourceEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A source of a run: where its rows are, and its columns."""

    file: str  # the table or recording, beside 'run.toml'
    topic: str = ""  # which part of an MCAP or a bag
    entity: str = ""  # which part of a Rerun recording
    # which of the rows: those in which each of these columns has this value
    where: dict[str, bool | int | float | str] = {}
    time: Time
    # whether these are used as they are ('stamps'), or even ticks fitted to them ('regular')
    clock: Literal["stamps", "regular"] = "stamps"
    axes: dict[str, list[Column]]  # for each axis its columns, which are added up
    orientation: Orientation | None = None
    joints: dict[str, list[Column]] = {}  # the columns of the joints of the '[robot]', which are a pose
    noise: RowNoise | None = None  # the column of how noisy each row is; only sensors have one
    arrived: Time | None = None  # when each row came; None: at its stamp

    @property
    def rows(self) -> tuple[str, ...]:
        """Where its rows are: the same for sources that can be read at once."""
        return self.file, self.topic, self.entity, repr(self.where)

    @property
    def fields(self) -> list[str]:
        """All its columns and field paths."""
        axes = [column for columns in (*self.axes.values(), *self.joints.values()) for column in columns]
        names = [*self.time.columns, *(self.arrived.columns if self.arrived else ())]
        names += [*(column.column for column in axes), *(self.orientation.columns if self.orientation else ())]
        names += [self.noise.column] if self.noise else []
        return [*names, *(name for axis in axes for name in axis.where)]

    @property
    def has_own_rows(self) -> bool:
        """Whether its axes are in rows of their own, which its columns choose."""
        return any(column.where for columns in self.axes.values() for column in columns)

    @property
    def turns(self) -> dict[str, float]:
        """After what an axis begins anew [rad], for those that do."""
        turns = {axis: max(column.turn for column in columns) for axis, columns in self.axes.items()}
        return {axis: turn for axis, turn in turns.items() if turn}

    @property
    def label(self) -> str:
        """What a person calls it."""
        return self.topic or self.entity or self.file


class CommandEntry(SourceEntry, frozen=True, kw_only=True):
    """The commands."""

    start: dict[str, float] = {}  # the start level by axis [m or rad]
    kinds: dict[str, Kind] = {}  # the kinds of axes that its keys say
    # in which steps the controller goes on from one command to the next [s]; 0: it holds each
    interpolation: NotNegative = msgspec.field(name="interpolation_ms", default=0.0)


class ReferenceEntry(SourceEntry, frozen=True, kw_only=True):
    """A reference for scoring, with the standard deviation of its own noise, of lengths [m] and of angles [rad]."""

    sd: NotNegative = msgspec.field(name="sd_mm", default=0.0)
    angular_sd: NotNegative = msgspec.field(name="sd_deg", default=0.0)


class Manifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What ``run.toml`` holds, in SI units."""

    command: CommandEntry
    robot: Robot | None = None
    name: str = ""
    sensors: dict[str, SourceEntry] = {}
    reference: ReferenceEntry | None = None
    frame: Frame | None = None

    @property
    def entries(self) -> dict[str, SourceEntry]:
        """Its sources by what messages call them."""
        named = {f"sensor {name}": entry for name, entry in self.sensors.items()}
        return {"command": self.command, **named, **({"reference": self.reference} if self.reference else {})}

    @property
    def fields(self) -> dict[tuple[str, ...], list[str]]:
        """The columns and field paths of all its sources, by where their rows are."""
        fields: dict[tuple[str, ...], list[str]] = {}
        for entry in self.entries.values():
            fields.setdefault(entry.rows, []).extend(entry.fields)
        return fields


def file_of(run: Path) -> Path:
    """The ``run.toml`` of a run that is given as this file or as its folder."""
    return run / "run.toml" if run.is_dir() else run


def load(path: Path) -> Manifest:
    """Read ``run.toml``."""
    if path.name == "run.toml" and path.parent.is_dir() and not path.exists():
        log = shlex.quote(str(path.parent))
        raise ConfigError(f"{path.parent}: has no run.toml; `pumafuse init {log}` looks at the log and writes one")
    listed = of_tables(toml.read(path), str(path))
    for axis, columns in listed.command.axes.items():
        if len(columns) == 1 and is_error(error := columns[0].column):
            sum_of_both = f'{axis} = ["MEASURED", "{error}"]'
            raise ConfigError(f"{path}: command.{axis} is '{error}', which is called an error: {ERROR}: {sum_of_both}")
    return listed


def is_error(column: str) -> bool:
    """Whether a column is called as what is left between a set point and what is measured."""
    return _ERROR_WORD.search(leaf(column)) is not None


def refuse_twice(path: Path) -> None:
    """Refuse a ``run.toml`` in which one column, or sum of some, is what the arm is told and what a sensor measures."""
    listed = load(path)
    told = {frozenset(map(repr, columns)): axis for axis, columns in listed.command.axes.items()}
    for name, entry in listed.sensors.items() if told else ():
        for axis, columns in entry.axes.items() if entry.rows == listed.command.rows else ():
            if twice := told.get(frozenset(map(repr, columns))):
                raise ConfigError(
                    f"{path}: sensors.{name}.{axis} is the column '{columns[0].column}' of {entry.label}, and so is"
                    f" command.{twice}: give each the column of its own, what the arm is told and what is measured"
                )


def of_tables(tree: dict[str, Any], where: str = "run.toml") -> Manifest:
    """What the tables of a ``run.toml`` say, with every number in SI."""
    kinds = {"command": CommandEntry, "reference": ReferenceEntry}
    tree |= {key: _source(tree[key], kind, where, key) for key, kind in kinds.items() if key in tree}
    if not isinstance(tree.setdefault("sensors", {}), dict):
        raise ConfigError(f"{where}: sensors: expected a table for each sensor, as in [sensors.tracker]")
    named = cast(dict[str, Any], tree["sensors"])
    for name in named:
        refuse_name(f"{where}: sensor", name)
    tree["sensors"] = {name: _source(table, SourceEntry, where, f"sensors.{name}") for name, table in named.items()}
    listed = toml.struct(tree, Manifest, where)
    moved = next((name for name, entry in listed.entries.items() if entry.joints), None)
    if moved and listed.robot is None:
        raise ConfigError(f"{where}: {moved} is in joints: give [robot] with its urdf, base and tip")
    return listed


def stamps_of(run: Path) -> dict[str, tuple[int, int]]:
    """Size [bytes] and time of the last change [ns since 1970] of each file of a run; none where they cannot be told.

    Its files are ``run.toml``, the tables and recordings that it lists, and the URDF of its robot.
    """
    listed, files = file_of(run), [run]
    try:
        if listed.suffix == ".toml":
            told = load(listed)
            names = [listed.name, *(entry.file for entry in told.entries.values())]
            names += [] if told.robot is None else [told.robot.urdf]
            files = [listed.parent / name for name in names]
        parts = [part for file in files for part in (file.iterdir() if file.is_dir() else [file])]
        stats = {os.path.relpath(part, listed.parent): part.stat() for part in parts}
    except (PumafuseError, OSError, ValueError):
        return {}
    return {name: (stat.st_size, stat.st_mtime_ns) for name, stat in stats.items()}


def _source(table: Any, kind: type[SourceEntry], where: str, path: str) -> SourceEntry:
    """A source from its table; every key that is none of the source's fields is an axis."""
    if not isinstance(table, dict):
        raise ConfigError(f"{where}: {path}: expected a table, as in [{path}]")
    keys: dict[str, Any] = dict(table)  # pyright: ignore[reportUnknownArgumentType]
    kinds: dict[str, Any] = {}
    if isinstance(keys.get("start"), dict):
        start = {key: axis_of(key, where, f"{path}.start") for key in keys["start"]}
        keys["start"] = {axis: keys["start"][key] for key, axis in start.items()}
        kinds = {axis: kind_of(key) for key, axis in start.items()}
    if "pose" in keys:
        keys = _set_pose(keys, where, path)
    fields_of_kind = {field.encode_name for field in msgspec.structs.fields(kind)} - {"axes", "kinds"}
    named = [key for key in keys if key not in fields_of_kind]
    axes = {axis: _columns(keys.pop(axis), where, f"{path}.{axis}") for axis in named}
    if "orientation" in keys:
        _check_orientation(keys["orientation"], axes, where, f"{path}.orientation")
    if "joints" in keys:
        keys["joints"] = _joints(keys["joints"], [*axes, *keys.keys() & {"orientation"}], where, f"{path}.joints")
    if not axes and not keys.keys() & {"orientation", "joints"}:
        raise ConfigError(f"{where}: [{path}] names no column for any axis, as in x = 'x_mm'")
    if "noise" in keys:
        _check_noise(keys["noise"], kind, where, f"{path}.noise")
    of_whole_rows = next((key for key in ("orientation", "noise", "arrived") if key in keys), None)
    if of_whole_rows and any(column.get("where") for columns in axes.values() for column in columns):
        raise ConfigError(f"{where}: {path}.{of_whole_rows}: axes with rows of their own have none; leave it out")
    for key in [key for key in ("time", "arrived") if key in keys]:
        keys[key] = _time(keys[key], where, f"{path}.{key}")
    if "where" in keys:
        keys["where"] = _where(keys["where"], where, f"{path}.where")
    more = {"kinds": kinds} if kinds else {}
    return toml.struct({**keys, **more, "axes": axes}, kind, where, path)


def _set_pose(keys: dict[str, Any], where: str, path: str) -> dict[str, Any]:
    """The keys of a source with what its ``pose`` stands for: x, y and z in m, and an orientation."""
    pose = keys["pose"]
    if not isinstance(pose, str) or not pose:
        raise ConfigError(f"{where}: {path}.pose: expected the path of a pose in a message, as in 'pose.pose', or '.'")
    if twice := next((key for key in (*CARTESIAN, "orientation") if key in keys), None):
        raise ConfigError(f"{where}: {path}: gives {twice} and a pose, which has it; give one")
    position, orientation = _IN_TRANSFORM if leaf(pose).rpartition(".")[2] == "transform" else _IN_POSE
    inside = "" if pose == "." else f"{pose}."
    without_pose = {key: value for key, value in keys.items() if key != "pose"}
    without_pose |= {axis: {"column": f"{inside}{position}.{axis}", "unit": "m"} for axis in CARTESIAN}
    return without_pose | {"orientation": {"quaternion": [f"{inside}{orientation}.{letter}" for letter in "xyzw"]}}


def _check_orientation(table: Any, axes: dict[str, list[Any]], where: str, path: str) -> None:
    entry = toml.struct(table, Orientation, where, path)
    forms = [entry.quaternion, entry.rotation_vector, entry.euler]
    if sum(form is not None for form in forms) != 1:
        raise ConfigError(
            f"{where}: {path}: expected one of quaternion = ['qx', 'qy', 'qz', 'qw'], rotation_vector = ['rx', 'ry',"
            " 'rz'] and euler = ['A', 'B', 'C']"
        )
    if entry.euler and not (entry.letters in _LETTERS or entry.letters.swapcase() in _LETTERS):
        accepted = ", ".join(CONVENTIONS)
        raise ConfigError(
            f"{where}: {path}.convention: expected {accepted}, or letters as in 'ZYX' (about axes that turn along) or"
            f" 'xyz' (about axes that stay), not '{entry.convention}'"
        )
    if entry.convention and not entry.euler and not (entry.quaternion and entry.convention == "abb"):
        raise ConfigError(
            f"{where}: {path}.convention: only Euler angles have one, and a quaternion of ABB's; leave it out"
        )
    if not entry.quaternion:
        _check_unit(table, ANGLES, where, path)
        if column := next((name for name in entry.columns if Column(name, entry.unit).kind != "angle"), None):
            raise ConfigError(f"{where}: {path}: '{column}' ends in no unit of an angle; give unit = 'deg' or 'rad'")
    if twice := next((axis for axis in TURNING if axis in axes), None):
        raise ConfigError(f"{where}: {path}: the orientation has {twice}, which is an axis of its own, too; give one")


def _check_noise(table: Any, kind: type[SourceEntry], where: str, path: str) -> None:
    noise = toml.struct(table, RowNoise, where, path)
    if bool(noise.sd) == bool(noise.variance):
        raise ConfigError(f"{where}: {path}: expected one of sd = 'error_mm' and variance = 'pose.covariance[0]'")
    if kind is not SourceEntry:
        raise ConfigError(f"{where}: {path}: only rows of sensors have a noise; leave it out")


def _joints(table: Any, beside: Iterable[str], where: str, path: str) -> dict[str, Any]:
    if not isinstance(table, dict) or not table:
        raise ConfigError(f"{where}: {path}: expected a column for each joint, as in {{ j1 = 'j1_deg' }}")
    if twice := next(iter(beside), None):
        raise ConfigError(
            f"{where}: {path}: the pose of the joints is x, y, z and an orientation; {twice} is given, too"
        )
    return {name: _columns(column, where, f"{path}.{name}") for name, column in cast(dict[str, Any], table).items()}


def _columns(table: Any, where: str, path: str) -> list[Any]:
    """The columns of an axis: one or a list, each by its name or as a table."""
    listed = cast(list[Any], table if isinstance(table, list) else [table])
    columns: list[Any] = [{"column": item} if isinstance(item, str) else item for item in listed]
    if not columns or not all(isinstance(item, dict) and cast(dict[str, Any], item).get("column") for item in columns):
        axis = path.rpartition(".")[2]
        raise ConfigError(
            f"{where}: {path}: expected a column name or a list of them, as in {axis} = 'x_mm', or with its unit"
            f" {axis} = {{ column = 'pose.position.x', unit = 'm' }}"
        )
    for column in columns:
        if "where" in column:
            column["where"] = _where(column["where"], where, f"{path}.where")
        toml.check(column, Column, where, path)
        _check_unit(column, POSITIONS, where, path)
        if column.get("turn_deg") and msgspec.convert(column, Column).kind != "angle":
            raise ConfigError(f"{where}: {path}.turn_deg: the column is no angle; leave turn_deg out")
    return columns


def _time(table: Any, where: str, path: str) -> dict[str, Any]:
    match table:
        case str() if table:
            return {"column": table}
        case [str() as seconds, str() as nanoseconds] if seconds and nanoseconds:
            return {"column": seconds, "nanoseconds": nanoseconds}
        case {"column": str() as column, **more} if column and more.keys() <= _OF_TIME:
            _check_unit(more, (*TIMES, *SINCE), where, path)
            return {"column": column, **more}
        case {"rate_hz": float() | int() as rate, **more} if rate and more.keys() <= {"column"}:
            return {"rate_hz": rate, **more}
        case _:
            raise ConfigError(
                f"{where}: {path}: expected a column ('t_s', 'header.stamp'), a column with its unit"
                " ({ column = 't', unit = 's' }), columns of whole seconds and of nanoseconds (['sec', 'nanosec']), or"
                " how often rows come ({ rate_hz = 100 }; by a column of frames, { column = 'frame', rate_hz = 100 });"
                " beside a column shift_s is added to its stamps, and a counter spreads rows that come in packets"
            )


def _where(table: Any, where: str, path: str) -> dict[str, Any]:
    """Values by column, in the unit of the column: they are compared with what is in the file."""
    values = cast(dict[str, Any], table if isinstance(table, dict) else {})
    numbers = [value for value in values.values() if not isinstance(value, str)]
    if not values or not all(isinstance(value, int | float) and abs(value) < _MOST for value in numbers):
        raise ConfigError(
            f"{where}: {path}: expected a number, a text or a boolean for each column, as in {{ episode_index = 3 }};"
            " a field path is quoted, as in { 'meta.episode' = 3 }"
        )
    return from_si(values)


def _check_unit(column: dict[str, Any], accepted: tuple[str, ...], where: str, path: str) -> None:
    names = [unit.removeprefix("_") for unit in accepted]
    if "unit" in column and column["unit"] not in names:
        raise UnknownNameError(f"{where}: {path}", "unit", str(column["unit"]), names)


def axis_of(key: str, where: str, path: str) -> str:
    """``x_mm`` → ``x``; the number itself is already in m or rad."""
    unit = ending(key)
    if unit is None or kind_of(key) is None:
        raise ConfigError(f"{where}: {path}.{key} has no unit in its name, as in {key}_mm or {key}_deg")
    return key.removesuffix(unit)
