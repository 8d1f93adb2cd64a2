"""Columns of orientations: by their names, by what stands beside them, and by their numbers.

Four columns are a quaternion where their names say so and their norm is 1 in all rows. Three angles are an orientation
only beside x, y and z of the same source: alone they are axes of joints.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from msgspec import structs

from ..arrays import FloatArray, TimeArray, known_rows
from ..errors import RunError
from ..logs.columns import Table
from ..logs.frames import CARTESIAN
from ..logs.manifest import Orientation
from ..space import rotations
from ..units import ending
from . import names

_NORM = 1e-3  # from 1, of the norm of a quaternion in a text
_FEWEST = 10  # rows
_STILL = 1e-5  # rad: what turns less only changes its last digit
_FULL = 1.001 * math.pi  # rad: a rotation vector is no longer
_CHANGE_NS = 150_000_000  # over which turning is compared: long beside noise, short beside a motion
_LATEST, _STEP = 0.6, 0.02  # s, up to which lag turning is compared, and in which steps
_MOST = 1000  # changes that are compared
_BETTER = 0.05  # share of the turning that the right order explains more than the other
_FRONT, _BACK = r"^(?P<head>|.*[^A-Za-z]|.*[a-z](?=[A-Z]))", r"(?P<end>[\])]?)(?P<tail>|[^A-Za-z0-9].*)$"
QUATERNION = re.compile(
    rf"{_FRONT}(?P<word>(?i:q|quat|quaternion|orientation|orient|ori|rotation|rot|attitude))"
    rf"(?P<join>[_. \[(]?)(?P<part>[wxyzijkWXYZIJK0-4]){_BACK}"
)
_NAMED, _NUMBERED = "wxyz", ("0123", "1234")  # parts of a quaternion, in the order of letters
_UNITS = dict(zip("ijk", "xyz", strict=True))  # parts of a quaternion by its units
_ANGLE = re.compile(rf"{_FRONT}(?P<part>(?i:r[xyz]|roll|pitch|yaw|[abcwprxyz])){_BACK}")
_EULER = {("a", "b", "c"): "kuka", ("w", "p", "r"): "fanuc", ("roll", "pitch", "yaw"): "rpy"}
_NAMED_EULER = {"kuka": "KUKA's angles about z, y, x", "fanuc": "FANUC's angles about x, y, z that stay"}
_UR = re.compile(r"(?i)tcp_?pose$")  # x, y, z in m and a rotation vector in rad
_LONGEST = 20  # elements of a list that are tried: two poses with grippers have 16


@dataclass(frozen=True)
class Attitude:
    """Columns of an orientation."""

    columns: Orientation  # as 'run.toml' has them
    quaternion: FloatArray  # x, y, z, w, NaN in rows that have none, (rows, 4)
    basis: str  # how it is known what they are
    # which axes the columns beside them are, where its own names say it
    coordinates: Mapping[str, str] = field(default_factory=dict[str, str])
    place_unit: str = ""  # of these; empty: their names say it
    doubt: str = ""  # what may be wrong, as a question; empty: nothing

    @property
    def role_words(self) -> list[str]:
        """The words of its columns' names that say whose it is."""
        return names.role_words(self.columns.columns[0])

    @property
    def is_open(self) -> bool:
        """Whether names leave open which column is w."""
        return bool(self.columns.quaternion and self.doubt)

    @property
    def turns(self) -> bool:
        """Whether it ever changes: one that does not tells nothing."""
        valid = self.quaternion[np.isfinite(self.quaternion[:, 0])]
        return len(valid) >= _FEWEST and float(rotations.angle_between(valid, valid[:1]).max()) > _STILL

    @property
    def farthest(self) -> float:
        """How far it is from its mean at the most [rad]."""
        mean = rotations.of_vectors(rotations.mean(self.quaternion)[None])
        return float(np.nanmax(rotations.angle_between(self.quaternion, mean)))

    def exchanged(self) -> Attitude:
        """The same with w at the other end."""
        logged, order = self.quaternion, "wxyz"
        if self.columns.order == "wxyz":
            logged, order = logged[:, [3, 0, 1, 2]], "xyzw"
        columns = structs.replace(self.columns, order=order)
        return replace(self, columns=columns, quaternion=rotations.of_quaternions(logged, order))


def attitudes_in(table: Table, paths: Iterable[str]) -> list[Attitude]:
    """The orientations of a table; ``paths`` are those of its numbers."""
    paths = list(paths)
    return [*_quaternions(table, paths), *_in_order(table, paths), *_angles(table, paths), *_listed(table, paths)]


def _plain(table: Table, columns: Sequence[str]) -> FloatArray | None:
    """Columns of numbers, (rows, k); None where one is something else."""
    try:
        return np.column_stack([table.plain(column)[0] for column in columns])
    except RunError:
        return None


def _groups(form: re.Pattern[str], paths: Iterable[str], keys: Sequence[str]) -> Iterator[dict[str, str]]:
    """Columns whose names differ by one part and their unit, by that part in lower case."""
    groups: dict[tuple[str, ...], dict[str, str]] = {}
    for path in paths:
        if (match := form.match(path)) is not None:
            tail = match["tail"].removesuffix(ending(match["tail"]) or "")
            part = match["part"].lower()
            groups.setdefault((*(match[key] for key in keys), tail), {}).setdefault(_UNITS.get(part, part), path)
    yield from groups.values()


def _quaternions(table: Table, paths: Sequence[str]) -> Iterator[Attitude]:
    for group in _groups(QUATERNION, paths, ("head", "word", "join", "end")):
        parts = "".join(sorted(group))
        if parts != _NAMED and parts not in _NUMBERED:
            continue
        columns = tuple(group[part] for part in ("xyzw" if parts == _NAMED else parts))
        value = _plain(table, columns)
        if value is None or not are_units(value):
            continue
        x, y, z, w = columns
        made = Orientation(quaternion=(x, y, z, w), order="xyzw" if parts == _NAMED else "wxyz")
        doubt = f"is w the first of {x}, {y}, {z}, {w}? No name says it (run.toml, order)" if parts != _NAMED else ""
        quaternion = rotations.of_quaternions(value, made.order)
        yield Attitude(made, quaternion, "a guess: w first" if doubt else "by name", doubt=doubt)


def _in_order(table: Table, paths: Sequence[str]) -> Iterator[Attitude]:
    """Seven columns of a list, or without names, as TUM's and ETH's files have: x, y, z and four of norm 1, w last."""
    nameless = [path for path in paths if names.number_of_nameless(path)]
    for order in (nameless, *(columns for columns in names.lists(paths).values() if len(columns) <= _LONGEST)):
        for first in range(len(order) - 6):
            xyz, (x, y, z, w) = order[first : first + 3], order[first + 3 : first + 7]
            position, value = _plain(table, xyz), _plain(table, [x, y, z, w])
            if position is None or value is None or not _moves(position) or not are_units(value):
                continue
            made = Orientation(quaternion=(x, y, z, w), order="xyzw")
            doubt = f"is w the last of {x}, {y}, {z}, {w}? Their norm is 1, and no name says it (run.toml, order)"
            axes = dict(zip(xyz, CARTESIAN, strict=True))
            yield Attitude(made, rotations.of_quaternions(value, made.order), "a norm of 1: w last", axes, doubt=doubt)


def are_units(value: FloatArray) -> bool:
    """Whether the norm is 1 in all rows, (rows, 4); without those of a sensor that is lost."""
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(value, axis=1)
    norms = norm[np.isfinite(norm) & (norm != 0.0)]
    return len(norms) >= _FEWEST and bool((np.abs(norms - 1.0) < _NORM).all())


def _angles(table: Table, paths: Sequence[str]) -> Iterator[Attitude]:
    """Rotation vectors and Euler angles beside x, y and z that move."""
    for group in _groups(_ANGLE, paths, ("head", "end")):
        forms = [form for form in [rotations.TURNING, *_EULER] if set(form) <= group.keys()]
        if len(forms) == 1 and set(CARTESIAN) <= group.keys():
            xyz, columns = ([group[part] for part in parts] for parts in (CARTESIAN, forms[0]))
            yield from _beside(table, xyz, columns, [_EULER.get(forms[0], "")])


def _listed(table: Table, paths: Sequence[str]) -> Iterator[Attitude]:
    """Six numbers of a tool in one list, x, y, z and three angles: UR's pose, or whatever these may be."""
    for name, columns in names.lists(paths).items():
        if len(columns) == 6 and names.is_of_space(name):
            yield from _beside(table, columns[:3], columns[3:], ["", "rpy"], surely=_UR.search(name) is not None)


def _beside(
    table: Table, xyz: Sequence[str], columns: Sequence[str], conventions: Iterable[str], *, surely: bool = False
) -> Iterator[Attitude]:
    """Three angles beside x, y and z that move, by the first convention that their numbers allow.

    ``surely`` they are a rotation vector in rad, beside m.
    """
    position, (first, second, third) = _plain(table, xyz), columns
    if position is None or not _moves(position):
        return
    options = (_of_angles(table, (first, second, third), convention) for convention in conventions)
    made, unit = next(filter(None, options), None), names.unit_of(first)
    if surely:
        made = Orientation(rotation_vector=(first, second, third), unit="rad")
    if made is not None:
        euler = _NAMED_EULER.get(made.convention, "angles about x, y and z that stay")
        what = f"{euler if made.euler else 'a rotation vector'}{'' if unit else f', in {made.unit}'}"
        doubt = "" if surely else f"are {', '.join(columns)} {what}? No name says it (run.toml)"
        axes = dict(zip(xyz, CARTESIAN, strict=True))
        yield Attitude(made, made.read(table)[0], "by name", axes, "m" if surely else "", doubt)


def _moves(position: FloatArray) -> bool:
    valid = position[np.isfinite(position).all(axis=1)]
    return len(valid) > 0 and bool(np.ptp(valid, axis=0).any())


def _of_angles(table: Table, columns: tuple[str, str, str], convention: str) -> Orientation | None:
    """Three angles as an orientation; None where their numbers or units are none of one."""
    value, unit = _plain(table, columns), names.unit_of(columns[0])
    if value is None or not np.isfinite(value).all(axis=1).any() or unit not in ("", "rad", "deg"):
        return None
    if convention:
        largest = float(np.nanmax(np.abs(value)))
        unit = unit or ("rad" if convention == "rpy" and largest <= 2.0 * math.pi else "deg")
        return Orientation(euler=columns, convention=convention, unit=unit)
    is_vector = unit != "deg" and float(np.nanmax(np.linalg.norm(value, axis=1))) <= _FULL
    return Orientation(rotation_vector=columns, unit="rad") if is_vector else None


def in_order(attitude: Attitude, stamp: TimeArray, other: Attitude, other_stamp: TimeArray, *, leads: bool) -> Attitude:
    """An orientation whose order is open in the order in which it turns with another one, where that tells."""
    both, other_turns = [attitude, attitude.exchanged()], (other_stamp, other.quaternion)
    pairs = [((stamp, option.quaternion), other_turns) for option in both]
    shares = [_turning_alike(*(pair if leads else pair[::-1])) for pair in pairs]
    if abs(shares[0] - shares[1]) < _BETTER:
        return attitude
    best = both[int(np.argmax(shares))]
    return replace(best, basis=f"w {'first' if best.columns.order == 'wxyz' else 'last'}: so it turns alike", doubt="")


def _turning_alike(leader: tuple[TimeArray, FloatArray], follower: tuple[TimeArray, FloatArray]) -> float:
    """The share of a turning motion that another one explains at its best lag, in whatever frame it is seen.

    A frame turns all changes of orientation alike, by a proper rotation; a wrong order mirrors them.
    """
    (t, led), (s, seen) = (known_rows(*rows) for rows in (leader, follower))
    begin, end = (max(t[0], s[0]), min(t[-1], s[-1]) - _CHANGE_NS) if len(t) and len(s) else (0, 0)
    if end <= begin:
        return 0.0
    time = np.linspace(begin, end, _MOST).astype(np.int64)
    measured = _changes(s, seen, time)
    return max(
        rotations.aligning(_changes(t, led, time - round(lag * 1e9)), measured)[1]
        for lag in np.arange(0.0, _LATEST, _STEP)
    )


def _changes(stamp: TimeArray, quaternion: FloatArray, time: TimeArray) -> FloatArray:
    """By how much something turns over a short while from each time on, along the axes that stay [rad], (n, 3)."""
    first, last = (
        quaternion[np.clip(np.searchsorted(stamp, at, side="right") - 1, 0, None)] for at in (time, time + _CHANGE_NS)
    )
    return rotations.vectors(rotations.product(last, rotations.inverse(first)), np.zeros(3))
