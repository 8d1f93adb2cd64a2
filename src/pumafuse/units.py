"""Conversion of units: names carry the unit, Python carries SI.

Every number in a file, a column or on a screen has its unit as the ending of its name (``latency_ms``, ``x_mm``). All
units are powers of ten of an SI unit, so conversion moves the decimal point of the shortest decimal form of the number:
60.45 ms is exactly the float 0.06045 s, and comes back as 60.45.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from decimal import Decimal
from typing import Any, cast

import numpy as np

from .arrays import NO_STAMP, FloatArray, TimeArray
from .errors import ConfigError

_ENDINGS = {  # power of ten to SI -> endings of names
    0: ("_m", "_s", "_m_s", "_rad_s", "_s_m"),
    -3: ("_mm", "_ms", "_mm_s", "_mm_rtHz", "_mm_rts", "_mm_rtHz_per_m_s", "_mm_rts_per_m_s"),
    -6: ("_um", "_us"),
    -9: ("_ns",),
}
EXPONENTS = {ending: exponent for exponent, endings in _ENDINGS.items() for ending in endings}
LENGTHS = ("_m", "_mm", "_um")
TIMES = ("_s", "_ms", "_us", "_ns")
MM = 1e3  # mm in a metre: SI arrays times this are what files and screens show
MS = 1e3  # ms in a second, likewise
PROVENANCE = "provenance"  # a table of this name is kept as it is
INTERVAL = "_ci95"  # `time_constant_ms_ci95` is in ms


def ending(name: str) -> str | None:
    """The longest known unit at the end of ``name``, so that ``max_speed_m_s`` is in m/s; None without one."""
    stem = name.removesuffix(INTERVAL)
    return max((unit for unit in EXPONENTS if stem.endswith(unit)), key=len, default=None)


def to_si(tree: Mapping[str, Any]) -> dict[str, Any]:
    """A parsed TOML table with every number that has a unit in SI; the names stay as they are.

    A unit holds for lists and for the entries of a sub-table: ``sd_mm = { radial = 0.05 }``. Provenance is kept as is.

    Raises:
        ConfigError: A number outside an interval (``_ci95``) is not finite.
    """
    return _converted(tree, 0, "", _si)


def from_si(tree: Mapping[str, Any]) -> dict[str, Any]:
    """The inverse of :func:`to_si`: SI numbers in the units of their names."""
    return _converted(tree, 0, "", _in_unit)


def refuse_unit(kind: str, name: str) -> None:
    """Refuse the name of an axis or a sensor that ends like a unit.

    Its table's numbers would be taken to have that unit, and ``<axis>_mm`` would have two.

    Raises:
        ConfigError: It does.
    """
    unit = ending(name)
    if unit is not None:
        raise ConfigError(f"{kind} '{name}': a name must not end in a unit ({unit})")


def shifted(value: float | Decimal, exponent: int) -> float:
    """``value`` × 10^exponent, exact in the shortest decimal form of ``value`` (no binary rounding in between)."""
    decimal = value if isinstance(value, Decimal) else Decimal(repr(value))
    return float(decimal.scaleb(exponent))


def seconds(stamp: TimeArray, origin: int = 0) -> FloatArray:
    """Seconds since ``origin`` [ns] of int64 ns stamps; NaN for ``NO_STAMP``."""
    since = np.asarray((stamp - origin) / 1e9, dtype=np.float64)
    since[stamp == NO_STAMP] = np.nan
    return since


def nanoseconds(time: FloatArray) -> TimeArray:
    """Int64 ns of seconds; ``NO_STAMP`` where they are not finite."""
    finite = np.isfinite(time)
    return np.where(finite, np.rint(np.where(finite, time, 0.0) * 1e9).astype(np.int64), NO_STAMP)


def _converted(value: Any, exponent: int | None, path: str, convert: Callable[[Any, int, str], Any]) -> Any:
    """``value`` with every number in it converted; ``exponent`` is that of its unit, None within provenance."""
    if isinstance(value, Mapping):
        found: dict[str, Any] = {}
        for key, item in cast(Mapping[str, Any], value).items():
            place, unit = f"{path}.{key}" if path else key, ending(key)
            known = exponent is not None and place != PROVENANCE
            inner = exponent if unit is None else EXPONENTS[unit]
            found[key] = _converted(item, inner if known else None, place, convert)
        return found
    if isinstance(value, list | tuple):
        return [_converted(item, exponent, path, convert) for item in cast(list[Any], value)]
    if isinstance(value, float | Decimal) or (type(value) is int and exponent):
        return float(value) if exponent is None else convert(value, exponent, path)
    return value


def _si(value: float | Decimal, exponent: int, path: str) -> float:
    number = shifted(value, exponent)
    if not math.isfinite(number) and not path.endswith(INTERVAL):
        raise ConfigError(f"{path}: {str(value)[:24]} is not a finite number")
    return number


def _in_unit(value: float, exponent: int, _: str) -> float | Decimal:
    decimal = Decimal(repr(float(value))).scaleb(-exponent)
    plain = float(decimal)
    return plain if Decimal(repr(plain)) == decimal else decimal  # the 17th digit would be lost in a float
