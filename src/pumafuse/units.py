"""Conversion of units: names carry the unit, Python carries SI.

Every number in a file, a column or on a screen has its unit as the ending of its name (``latency_ms``, ``x_mm``). A
number is converted in its shortest decimal form: 60.45 ms is exactly the float 0.06045 s, and comes back as 60.45. So
does an angle given in degrees.

An axis is a length (m inside) or an angle (rad inside). Names in the code are those of lengths (``sd_mm``); files and
screens have those of the axis's kind (``sd_deg``): :func:`of_kind`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from decimal import Context, Decimal
from functools import lru_cache
from typing import Any, Literal, TypeAlias, cast

import numpy as np

from .arrays import NO_STAMP, FloatArray, IntArray, TimeArray
from .errors import ConfigError

Kind: TypeAlias = Literal["length", "angle"]
KINDS: tuple[Kind, ...] = ("length", "angle")


@dataclass(frozen=True)
class Screen:
    """The unit in which files and screens show positions of a kind of axis.

    Attributes:
        unit: Of a position, and the ending of its name.
        scale: How many of them an SI unit is: an SI array times this is what is shown.
        fast: Unit of commanded speeds, which are of whole axes or paths.
        fast_scale: How many of these an SI unit is.
    """

    unit: str
    scale: float
    fast: str
    fast_scale: float


MM = 1e3  # mm in a metre
MS = 1e3  # ms in a second
DEG = 180.0 / math.pi  # degrees in a radian
TURN = 2.0 * math.pi
SCREEN: dict[Kind, Screen] = {
    "length": Screen("mm", MM, "m/s", 1.0),
    "angle": Screen("deg", DEG, "deg/s", DEG),
}
SI: dict[Kind, Screen] = {"length": Screen("m", 1.0, "m/s", 1.0), "angle": Screen("rad", 1.0, "rad/s", 1.0)}
AN: dict[Kind, str] = {"length": "a length", "angle": "an angle"}
LENGTHS = ("_m", "_mm", "_um")
ANGLES = ("_rad", "_mrad", "_deg")
TIMES = ("_s", "_ms", "_us", "_ns")
GUESSED: dict[Kind, tuple[str, ...]] = {"length": LENGTHS, "angle": ANGLES}  # where no name says a unit
OF_KIND: dict[Kind, tuple[str, ...]] = {"length": (*LENGTHS, "_cm", "_inch"), "angle": ANGLES}
POSITIONS = (*OF_KIND["length"], *ANGLES)
SPEEDS: dict[Kind, tuple[str, ...]] = {"length": ("_m_s", "_mm_s"), "angle": ("_deg_s", "_rad_s")}  # first: on screens
_SAME = 1.2  # tolerance of a factor between two units
_ONE, _THOUSANDTH, _MILLIONTH = (Decimal(10) ** -power for power in (0, 3, 6))
_UNITS: dict[str, Decimal | None] = {  # endings of names -> their size in SI; None: degrees
    **dict.fromkeys(("_m", "_s", "_m_s", "_s_m", "_rad", "_rad_s", "_s_rad"), _ONE),
    **dict.fromkeys(("_deg_rtHz_per_deg_s", "_deg_rts_per_deg_s"), _ONE),
    **dict.fromkeys(("_mm", "_ms", "_mm_s", "_mm_rtHz", "_mm_rts", "_mrad"), _THOUSANDTH),
    **dict.fromkeys(("_mm_rtHz_per_m_s", "_mm_rts_per_m_s"), _THOUSANDTH),
    **dict.fromkeys(("_um", "_us"), _MILLIONTH),
    "_ns": Decimal("1e-9"),
    "_cm": Decimal("0.01"),
    "_inch": Decimal("0.0254"),
    **dict.fromkeys(("_deg", "_deg_s", "_deg_rtHz", "_deg_rts"), None),
}
_AS_ANGLE = {  # endings that carry the kind of an axis
    "_mm_rtHz_per_m_s": "_deg_rtHz_per_deg_s",
    "_mm_rts_per_m_s": "_deg_rts_per_deg_s",
    "_mm_rtHz": "_deg_rtHz",
    "_mm_rts": "_deg_rts",
    "_mm_s": "_deg_s",
    "_mm": "_deg",
    "_m_s": "_deg_s",
    "_s_m": "_s_rad",
}
_AS_LENGTH = {angle: length for length, angle in _AS_ANGLE.items() if length != "_m_s"}
_PRECISE = Context(prec=50)
_RADIANS = Decimal("0.017453292519943295769236907684886127134428718885417254560971914402")  # in a degree
PROVENANCE = "provenance"  # a table of this name is kept as it is
INTERVAL = "_ci95"  # `time_constant_ms_ci95` is in ms
_BESIDE = np.array([0, 1, 3, 4])  # places of the two steps before and after one, with two before the first
_NOISE = 0.2 / DEG  # rad, of an encoder
_FEW_JUMPS = 0.05  # of the rows: more are a rotation of nearly a turn from row to row
_JUMP, _STEP, _ALIKE = 0.75 * TURN, 0.25 * TURN, 3.0  # rad; times the steps beside it, as which a jump goes on


@lru_cache(4096)  # a search asks time and again
def ending(name: str) -> str | None:
    """The longest known unit at the end of ``name``, so that ``max_speed_m_s`` is in m/s; None without one."""
    stem = name.removesuffix(INTERVAL)
    return max((unit for unit in _UNITS if stem.endswith(unit)), key=len, default=None)


def kind_of(name: str) -> Kind | None:
    """The kind of axis of which a name that ends in a unit of position is; None for any other name."""
    unit = ending(name)
    return next((kind for kind in KINDS if unit in OF_KIND[kind]), None)


def of_kind(name: str, kind: Kind) -> str:
    """The name with the unit for a kind of axis, from the name for a length: ``sd_mm`` → ``sd_deg``."""
    stem = name.removesuffix(INTERVAL)
    unit = ending(name) if kind == "angle" else None
    if unit not in _AS_ANGLE:
        return name
    return stem.removesuffix(unit) + _AS_ANGLE[unit] + name[len(stem) :]


def as_length(name: str) -> str:
    """The inverse of :func:`of_kind` for the quantities of one axis: ``sd_deg`` → ``sd_mm``."""
    stem, unit = name.removesuffix(INTERVAL), ending(name)
    return name if unit not in _AS_LENGTH else stem.removesuffix(unit) + _AS_LENGTH[unit] + name[len(stem) :]


def divisor(unit: str) -> float:
    """What a number in the unit of an ending is divided by to be in SI; that rounds once, of inches twice."""
    size = _UNITS[unit]
    return DEG if size is None else float(1 / size)


def si_of(values: FloatArray, unit: str) -> FloatArray:
    """An array of numbers in the unit of an ending, in SI."""
    with np.errstate(invalid="ignore"):  # a table may have NaNs that signal
        return values / divisor(unit)


def to_si(tree: Mapping[str, Any]) -> dict[str, Any]:
    """A parsed TOML table with every number that has a unit in SI; the names stay as they are.

    A unit holds for lists and for the entries of a sub-table: ``sd_mm = { x = 0.05 }``. Provenance is kept as is.
    """
    return _converted(tree, "", "", _si)


def from_si(tree: Mapping[str, Any]) -> dict[str, Any]:
    """The inverse of :func:`to_si`: SI numbers in the units of their names."""
    return _converted(tree, "", "", lambda value, unit, _: in_unit(value, unit) if unit else float(value))


def mistaken(factor: float, endings: Iterable[str]) -> list[tuple[str, str]]:
    """The units that numbers may be in, each with the one that they are taken to be in, if they come out wrong.

    Args:
        factor: How many times too large they come out, within a fifth.
        endings: The units that a name can have, ``TIMES`` or those of a kind; what is cm or inch is called so.
    """
    sizes = {unit[1:]: si(1.0, unit) for unit in endings}
    return [
        (true, called)
        for true, size in sizes.items()
        for called, taken in sizes.items()
        if called not in ("cm", "inch", true) and abs(math.log(factor * size / taken)) < math.log(_SAME)
    ]


def refuse_name(kind: str, name: str) -> None:
    """Refuse the name of an axis or a sensor that ends like a unit, or that no screen can show.

    Its table's numbers would be taken to have that unit, and ``<axis>_mm`` would have two.
    """
    unit = ending(name)
    if unit is not None:
        raise ConfigError(f"{kind} '{name}': a name must not end in a unit ({unit})")
    if not name.isprintable():
        raise ConfigError(f"{kind} '{name}': a name must not have control characters")


def si(value: float | Decimal, unit: str) -> float:
    """A number in the unit of an ending in SI, from its shortest decimal form (no binary rounding in between)."""
    decimal, size = value if isinstance(value, Decimal) else Decimal(repr(value)), _UNITS[unit]
    return float(_PRECISE.multiply(decimal, _RADIANS if size is None else size))


def in_unit(value: float, unit: str) -> float | Decimal:
    """The inverse of :func:`si`: the shortest decimal that is read as ``value`` again, a float if it is one's."""
    size = _UNITS[unit]
    if size is not None:
        decimal = _PRECISE.divide(Decimal(repr(float(value))), size)
    elif not math.isfinite(value):
        return value
    else:
        exact = _PRECISE.divide(Decimal(value), _RADIANS)
        rounded = (Context(prec=digits).plus(exact) for digits in range(15, 25))
        decimal = next(number for number in rounded if si(number, unit) == value)
    plain = float(decimal)
    return plain if Decimal(repr(plain)) == decimal else decimal  # the 17th digit would be lost in a float


def unwrapped(angle: FloatArray, turn: float = TURN) -> FloatArray:
    """Angles that go on, from those that begin anew after each turn [all in rad]; NaN stays."""
    unwrapped, is_known = angle.copy(), np.isfinite(angle)
    unwrapped[is_known] = np.unwrap(angle[is_known], period=turn)
    return unwrapped


def wraps(angle: FloatArray) -> IntArray:
    """Rows in which an angle [rad] begins a turn, or two, anew: it jumps by nearly that, but else goes on as around.

    A step of nearly a turn from rest, and steps at random, are none. An angle that also goes on over turns, as before
    or after a restart of what counts them, jumps by a turn while it moves, or its noise does.
    """
    rows = np.flatnonzero(np.isfinite(angle))
    turns = math.ceil(np.ptp(angle[rows]) / TURN - 1e-6) if len(rows) > 3 else 0
    step = np.diff(angle[rows])
    if turns in (1, 2):
        jumps = np.flatnonzero(np.abs(step) > turns * _JUMP)
        turn = turns * TURN
        pad = np.pad(np.abs(step - turn * np.round(step / turn)), 2, mode="edge")
        beside = np.max([pad[jumps + shift] for shift in _BESIDE], axis=0)
        true = (beside < _STEP) & (pad[jumps + 2] <= _ALIKE * beside + 1.0 / DEG)
        if len(jumps) and true.mean() > 0.9:
            return rows[jumps + 1]
    jumps = np.flatnonzero(np.abs(step) > _JUMP)
    if turns < 2 or len(jumps) > _FEW_JUMPS * len(step):
        return rows[:0]
    pad = np.pad(step - TURN * np.round(step / TURN), 2, mode="edge")
    around = pad[jumps[:, None] + _BESIDE]
    beside = np.abs(around).max(axis=1)
    goes_on = np.abs(pad[jumps + 2] - around.mean(axis=1)) <= 0.5 * beside + _NOISE
    true = (beside > 0.0) & (beside < _STEP) & goes_on
    return rows[jumps + 1] if len(jumps) and true.mean() > 0.9 else rows[:0]


def seconds(stamp: TimeArray, origin: int = 0) -> FloatArray:
    """Seconds since ``origin`` [ns] of int64 ns stamps; NaN for ``NO_STAMP``."""
    since = np.asarray((stamp - origin) / 1e9, dtype=np.float64)
    since[stamp == NO_STAMP] = np.nan
    return since


def nanoseconds(time: FloatArray) -> TimeArray:
    """Int64 ns of seconds; ``NO_STAMP`` where they are not finite."""
    finite = np.isfinite(time)
    return np.where(finite, np.rint(np.where(finite, time, 0.0) * 1e9).astype(np.int64), NO_STAMP)


def _converted(value: Any, unit: str | None, path: str, convert: Callable[[Any, str, str], Any]) -> Any:
    """``value`` with every number in it converted; ``unit`` is "" for none, None within provenance."""
    if isinstance(value, Mapping):
        converted: dict[str, Any] = {}
        for key, item in cast(Mapping[str, Any], value).items():
            key_path, unit_of_key = f"{path}.{key}" if path else key, ending(key)
            is_converted = unit is not None and key_path != PROVENANCE
            converted[key] = _converted(
                item, (unit if unit_of_key is None else unit_of_key) if is_converted else None, key_path, convert
            )
        return converted
    if isinstance(value, list | tuple):
        return [_converted(item, unit, path, convert) for item in cast(list[Any], value)]
    if isinstance(value, float | Decimal) or (type(value) is int and unit and _UNITS[unit] != _ONE):
        return float(value) if unit is None else convert(value, unit, path)
    return value


def _si(value: float | Decimal, unit: str, path: str) -> float:
    number = si(value, unit) if unit else float(value)
    if not math.isfinite(number) and not path.endswith(INTERVAL):
        raise ConfigError(f"{path}: {str(value)[:24]} is not a finite number")
    return number
