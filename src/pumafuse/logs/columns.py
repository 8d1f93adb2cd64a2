"""Columns of a table, also nested ones, as SI arrays, whatever state the log is in.

A column is called by its name or by a field path: ``pose.position.x`` is a field of structs, ``position[2]`` an element
of lists, ``position[elbow]`` the element whose place is that of ``elbow`` in the list ``name`` beside ``position``, as
in ROS's ``sensor_msgs/JointState``. A cell that is empty, no number, or not there in its row becomes NaN.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, reduce
from itertools import count
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from .. import units
from ..arrays import NO_STAMP, REACH_NS, BoolArray, FloatArray, IntArray, TimeArray
from ..errors import RunError, UnknownNameError, plural, reason, shortened
from . import dates

Columns: TypeAlias = Mapping[str, pa.ChunkedArray]
Where: TypeAlias = Mapping[str, bool | int | float | str]  # rows in which each of these columns has this value

# Units of stamps beside those of names: their length [s], 1970-01-01 by two programs that count from a day of their
# own, and above which number they are the second one's.
SINCE = {
    "_min": (60.0, 0.0, 0.0, np.inf),
    "_h": (3600.0, 0.0, 0.0, np.inf),
    "_days": (86400.0, 25_569.0, 719_529.0, 3e5),  # Excel, MATLAB's datenum
    "_ticks": (1e-7, 116_444_736e9, 621_355_968e9, 3.5e17),  # FILETIME of Windows and TwinCAT, .NET's DateTime
}
LOG_TIME = "log_time"  # when a row was recorded
NAMES = "name"  # the list beside another one that says what its elements are
# Seconds and nanoseconds in a struct: ROS 2, ROS 1, Foxglove's JSON schemas, google.protobuf.Timestamp.
SPLIT_STAMPS = (("sec", "nanosec"), ("secs", "nsecs"), ("sec", "nsec"), ("seconds", "nanos"))
_NANOSECONDS = re.compile("nano|nsec", re.IGNORECASE)
_GIGA = 10**9
_WHOLE = r"^[+-]?\d{1,19}$"
NUMBER = r"^[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|[iI]nf|inf)$"
_GROUPED = r"^[+-]?\d{1,3}(,\d{3})+(\.\d*)?$"  # 1,000.123
BLANK = ("", "NaN", "nan", "-nan", "NA", "N/A", "n/a", "#N/A", "NULL", "null", "None")
_NUMBERS = (pa.types.is_floating, pa.types.is_integer, pa.types.is_decimal, pa.types.is_null)
_NEITHER_NUMBERS_NOR_TEXT = (pa.types.is_boolean, pa.types.is_temporal, pa.types.is_nested, pa.types.is_union)
_CLOCKS = (pa.types.is_timestamp, pa.types.is_duration, pa.types.is_time)
_LISTS = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
_TEXTS = (pa.types.is_string, pa.types.is_large_string)
# Numbers that stand for "none": nines, and the ends of whole numbers of 16 and 32 bits.
SENTINELS = {
    *(10.0**digits - 1.0 for digits in range(3, 10)),
    *(2.0**bits - less for bits in (15, 16, 31, 32) for less in (0, 1)),
}
_FAR, _OTHERS = 10.0, 10  # times all other numbers of a column; different ones at least: steps may go to 999
_LONGEST_LIST = 64  # elements of a list that are listed one by one
_SOME = 8  # values in an error
_MOST_BYTES = 1 << 30  # of a table


@dataclass(frozen=True)
class Table:
    """One table: a file, or a topic of one."""

    path: Path
    columns: Columns  # by name; they may be nested
    rows: int
    notes: tuple[str, ...]  # what was wrong with the file as a whole, a sentence each
    # names and field paths of all that the file has, also where 'columns' are only some of it
    names: tuple[str, ...] = ()
    # which size in a column stands for "none", where the file has more rows; None: these tell
    sentinel_of: Callable[[str], float | None] | None = None
    units: Mapping[str, str] = field(default_factory=dict[str, str])  # what a line below the header says, by column

    def numbers(self, name: str, unit: str = "") -> tuple[FloatArray, str | None]:
        """A column of positions [m or rad], NaN where a cell has none, and a note on cells of text and sentinels."""
        numbers, note = self.plain(name)
        unit = unit or self._ending(name, units.POSITIONS, "mm")
        size = sentinel(numbers) if self.sentinel_of is None else self.sentinel_of(name)
        values = numbers if size is None else without(numbers, size)
        if (gone := np.isnan(values) & ~np.isnan(numbers)).any():
            number = f"with {numbers[gone][0]:.15g}, ten times as far as all others"
            note = "; ".join(filter(None, (note, self._missing(name, int(gone.sum()), number, int(gone.argmax())))))
        return units.si_of(values, unit), note

    def plain(self, name: str) -> tuple[FloatArray, str | None]:
        """A column of numbers without conversion, with NaN and note as in :meth:`numbers`."""
        column, note = self._numeric(name)
        return _filled(column.cast(pa.float64(), safe=False), np.nan), note

    def texts(self, name: str) -> list[str]:
        """A column as trimmed text, empty where a cell is; whole numbers without a point."""
        column = self.column(name)
        if pa.types.is_floating(column.type):
            whole = pc.and_(pc.less(pc.abs(column), 1e15), pc.equal(column, pc.round(column)))
            column = column.cast(pa.int64()) if pc.all(whole).as_py() else column
        return [(cell or "").strip() for cell in self._cast(name, column, pa.string()).to_pylist()]

    def stamps(self, name: str, nanoseconds: str = "", unit: str = "") -> tuple[TimeArray, str | None]:
        """Stamps in int64 ns, ``NO_STAMP`` where a cell is empty or no time, and a note on cells that were text.

        Numbers, timestamps, dates or times as text, or structs of seconds and nanoseconds; with a column of
        ``nanoseconds`` beside it whole seconds. Whole numbers, also beside cells of text, decimals, dates and Arrow's
        timestamps are exact, and so are seconds and nanoseconds apart. A date without a time zone is in UTC; a time
        without a date is since its midnight. ``unit`` is that of numbers (``_ms``); empty: what the name ends in.
        """
        if nanoseconds:
            return self._of_two(name, nanoseconds)
        column = self.column(name)
        if pa.types.is_struct(column.type):
            fields = {field.name for field in column.type}
            if split := next((pair for pair in SPLIT_STAMPS if fields.issuperset(pair)), None):
                return self._of_two(*(f"{name}.{part}" for part in split))
        if (dated := self._dates(name, column)) is not None:
            return self._within_reach(name, self._of_clock(name, dated[0])), dated[1]
        self._refuse_words(name, self._plain_column(name))
        if unit in SINCE:
            number, note = self.plain(name)
            size, since, another, between = SINCE[unit]
            since = another if np.nanmedian(number) > between else since
            return self._within_reach(name, units.nanoseconds((number - since) * size)), note
        exponent = 9 - 3 * units.TIMES.index(unit or self._ending(name, units.TIMES, "s"))
        return self._of_numbers(name, 10**exponent)

    def frames(self, rate: float, name: str = "") -> tuple[TimeArray, str | None]:
        """Stamps of rows that come at a rate [Hz], in int64 ns since frame 0, and a note on cells that were text."""
        number, note = self.plain(name) if name else (np.arange(self.rows, dtype=np.float64), None)
        time = number / rate
        if (np.abs(time) >= REACH_NS / 1e9).any():
            raise RunError(f"{self.path}: at {rate:g} Hz a row is stamped beyond the year 2115; check rate_hz")
        return units.nanoseconds(time), note

    def meets(self, where: Where) -> BoolArray:
        """Rows in which each of some columns has a value, (rows,)."""
        every = met(self.path, self.columns, conditions(self.path, self.columns, where))
        is_met = _filled(every.cast(pa.uint8()), 0) > 0
        if not is_met.any():
            raise no_row(self.path, [self.columns], where)
        return is_met

    def unwrapped(self, _: str, /, angle: FloatArray, turn: float) -> FloatArray:
        """Angles of a column that go on, from those that begin anew after each turn [all in rad]."""
        return units.unwrapped(angle, turn)

    def is_dated(self, name: str) -> bool:
        """Whether a column has dates, or times of day, and nothing else."""
        with suppress(RunError):  # dates mixed with numbers
            return self._dates(name, self.column(name)) is not None
        return False

    def zoned(self, name: str) -> bool | None:
        """Whether a column of dates says its time zone; None for a column of anything else."""
        column = self.column(name)
        if pa.types.is_timestamp(column.type):
            return column.type.tz is not None
        if not _is_any(column.type, _TEXTS):
            return None
        text, _ = dates.iso(column)
        dated = text.filter(pc.match_substring_regex(text, dates.DATE))
        return pc.any(pc.match_substring_regex(dated, dates.ZONE)).as_py()

    def nanoseconds_beside(self, name: str) -> str | None:
        """A column beside one of seconds that by its name has their nanoseconds; None without one."""
        within = name.rpartition(".")[0]
        return next((path for path in self._of_nanoseconds if path.rpartition(".")[0] == within and path != name), None)

    @cached_property
    def _of_nanoseconds(self) -> list[str]:
        """Columns that are nanoseconds by what is behind the last point of their names."""
        return [path for path in self.names if _NANOSECONDS.search(path.rpartition(".")[2])]

    def column(self, path: str) -> pa.ChunkedArray:
        """The column of a name or a field path, nothing converted. One that has the whole path as its name wins."""
        if path not in self.columns and self.names.count(path) > 1:
            raise RunError(f"{self.path}: two columns are named '{path}'; give one another name")
        return find(self.columns, path, str(self.path))

    def _of_numbers(self, name: str, per_unit: int) -> tuple[TimeArray, str | None]:
        column, note = self._numeric(name)
        if pa.types.is_decimal(column.type):
            exact = pc.multiply(
                column.cast(pa.decimal256(50, column.type.scale)), pa.scalar(per_unit, pa.decimal256(11))
            )
            column, per_unit = pc.round(exact), 1
        with np.errstate(over="ignore"):  # refused below
            rough = _filled(column.cast(pa.float64(), safe=False), np.nan) * per_unit
        self._refuse_beyond(name, np.isfinite(rough) & (np.abs(rough) >= REACH_NS))
        nanoseconds = np.where(np.isfinite(rough), np.rint(rough), NO_STAMP).astype(np.int64)
        if _is_any(column.type, _TEXTS):
            column = pc.if_else(pc.match_substring_regex(column, _WHOLE), column, pa.scalar(None, pa.string()))
        if not pa.types.is_floating(column.type):
            whole = _filled(self._cast(name, column, pa.int64()), NO_STAMP)
            nanoseconds = np.where(whole == NO_STAMP, nanoseconds, whole * per_unit)
        return nanoseconds, note

    def _of_two(self, name: str, nanoseconds: str) -> tuple[TimeArray, str | None]:
        (seconds, note), (fraction, other) = self._whole(name), self._whole(nanoseconds)
        missing = (seconds == NO_STAMP) | (fraction == NO_STAMP)
        self._refuse_beyond(name, ~missing & (np.abs(seconds * 1e9) >= REACH_NS))
        wrong = np.flatnonzero(~missing & ((fraction < 0) | (fraction >= _GIGA)))
        if len(wrong):
            what = f"{fraction[wrong[0]]} is no number of nanoseconds within a second, 0 to {_GIGA - 1}"
            raise self._refusal(nanoseconds, what, int(wrong[0]))
        return np.where(missing, NO_STAMP, np.where(missing, 0, seconds) * _GIGA + fraction), note or other

    def _whole(self, name: str) -> tuple[IntArray, str | None]:
        """Whole numbers of a column, ``NO_STAMP`` where it has none, and a note on cells that were text."""
        column, note = self._numeric(name)
        if pa.types.is_floating(column.type):
            column = pc.if_else(pc.is_finite(column), column, pa.scalar(None, column.type))
            if pc.any(pc.not_equal(column, pc.round(column))).as_py():
                raise self._refusal(name, "is beside another of one time: write it in whole numbers")
        return _filled(self._cast(name, column, pa.int64()), NO_STAMP), note

    def _of_clock(self, name: str, column: pa.ChunkedArray) -> TimeArray:
        """Int64 ns of Arrow's timestamps, in any unit and zone, times of day, and durations."""
        kind = pa.duration("ns") if pa.types.is_duration(column.type) else pa.timestamp("ns", "UTC")
        kind = pa.time64("ns") if pa.types.is_time(column.type) else kind
        return _filled(self._cast(name, column, kind).cast(pa.int64()), NO_STAMP)

    def _dates(self, name: str, column: pa.ChunkedArray) -> tuple[pa.ChunkedArray, str | None] | None:
        """A column of dates or times, also as text, as Arrow's, and a note on other text; None for one without any."""
        if _is_any(column.type, _CLOCKS):
            return column, None
        if not _is_any(column.type, _TEXTS):
            return None
        text, order = dates.iso(column)
        dated, elapsed = pc.match_substring_regex(text, dates.DATE), pc.match_substring_regex(text, dates.ELAPSED)
        good = pc.or_(dated, elapsed)
        if not pc.any(good).as_py():
            return None
        zoned = pc.and_(dated, pc.match_substring_regex(text, dates.ZONE))
        kinds = {
            "a date with a time zone": zoned,
            "a date without one": pc.and_(dated, pc.invert(zoned)),
            "a time without a date": elapsed,
            "a number": pc.match_substring_regex(text, NUMBER),
        }
        rows = {kind: pc.index(mask, value=True).as_py() + 1 for kind, mask in kinds.items() if pc.any(mask).as_py()}
        if len(rows) > 1:
            mixed = ", ".join(f"{kind} in row {row}" for kind, row in rows.items())
            raise self._refusal(name, f"mixes stamps: {mixed}; write all in one way")
        if "a time without a date" in rows:
            return dates.durations(text), self._words(name, column, good, "a time")
        note = self._words(name, column, good, "a date")
        text = pc.replace_substring(pc.if_else(dated, text, pa.scalar(None, text.type)), ",", ".")
        kind = pa.timestamp("ns", "UTC" if "a date with a time zone" in rows else None)
        if order is not None:
            order = f"{self.path.name}: column '{shortened(name)}': {order}"
        return self._cast(name, text, kind), "; ".join(filter(None, (note, order))) or None

    def _refuse_words(self, name: str, column: pa.ChunkedArray) -> None:
        """Refuse a column of text without any number: perhaps it has dates that could be read in two ways."""
        if not _is_any(column.type, _TEXTS):
            return
        text = pc.utf8_trim_whitespace(column)
        word = pc.and_(pc.is_valid(text), pc.invert(pc.is_in(text, value_set=pa.array(BLANK, text.type))))
        if pc.any(word).as_py() and not pc.any(pc.match_substring_regex(text, NUMBER)).as_py():
            row = pc.index(word, value=True).as_py()
            what = f"{text[row].as_py()[:40]!r} is no number and no ISO 8601 date (2026-11-25T10:00:00.125)"
            raise self._refusal(name, what, row)

    def _within_reach(self, name: str, stamp: TimeArray) -> TimeArray:
        self._refuse_beyond(name, (stamp != NO_STAMP) & ((stamp >= int(REACH_NS)) | (stamp <= -int(REACH_NS))))
        return stamp

    def _refuse_beyond(self, name: str, rows: BoolArray) -> None:
        if rows.any():
            what = "a stamp outside of the years 1824 to 2115; is it of the unit that its name or run.toml says?"
            raise self._refusal(name, what, int(rows.argmax()))

    def _refusal(self, name: str, what: str, row: int | None = None) -> RunError:
        where_in_column = "" if row is None else f", row {row + 1}:"
        return RunError(f"{self.path}: column '{shortened(name)}'{where_in_column} {what}")

    def _cast(self, name: str, column: pa.ChunkedArray, kind: pa.DataType) -> pa.ChunkedArray:
        try:
            return column.cast(kind)
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
            raise self._refusal(name, f"cannot be converted: {str(error).splitlines()[0]}") from None

    def _ending(self, name: str, accepted: tuple[str, ...], example: str) -> str:
        unit = units.ending(leaf(name))
        if unit is None or unit not in accepted:
            short = shortened(name)
            raise RunError(
                f"{self.path}: column '{short}' has no unit in its name; it must end in {', '.join(accepted)} (for"
                f" instance '{short}_{example}'), or run.toml says it: {{ column = '{short}', unit = '{example}' }}"
            )
        return unit

    def _plain_column(self, name: str) -> pa.ChunkedArray:
        column = self.column(name)
        if _is_any(column.type, _NEITHER_NUMBERS_NOR_TEXT):
            raise self._refusal(name, f"holds {_in_words(column.type)}, not numbers")
        return column

    def _numeric(self, name: str) -> tuple[pa.ChunkedArray, str | None]:
        """A column of numbers, or of text that is numbers; cells of other text are null, and counted in a note."""
        column = self._plain_column(name)
        if _is_any(column.type, _NUMBERS):
            return column, None
        column = self._cast(name, column, pa.string())
        trimmed = pc.utf8_trim_whitespace(column)
        grouped = pc.match_substring_regex(trimmed, _GROUPED)
        if pc.any(pc.and_(grouped, pc.match_substring(trimmed, "."))).as_py():  # else the comma may be a decimal one
            trimmed = pc.if_else(grouped, pc.replace_substring(trimmed, ",", ""), trimmed)
        numeric = pc.match_substring_regex(trimmed, NUMBER)
        note = self._words(name, column, numeric, "a number")
        return pc.if_else(numeric, trimmed, pa.scalar(None, pa.string())), note

    def _words(self, name: str, column: pa.ChunkedArray, good: pa.ChunkedArray, what: str) -> str | None:
        """A note on the cells of a column of text that are neither good nor blank; None without any."""
        blank = pc.is_in(pc.utf8_trim_whitespace(column), value_set=pa.array(BLANK, column.type))
        words = pc.and_(pc.is_valid(column), pc.invert(pc.or_(good, blank)))
        count = pc.sum(words).as_py() or 0
        if not count:
            return None
        row = pc.index(words, value=True).as_py()
        return self._missing(name, count, f"without {what}", row, f" {column[row].as_py()[:40]!r}")

    def _missing(self, name: str, count: int, what: str, row: int, first: str = "") -> str:
        cells = f"{plural(count, 'cell')} of column '{shortened(name)}' {what}"
        return f"{self.path.name}: {cells}, first{first} in row {row + 1}: taken as missing"


@dataclass(frozen=True)
class Topic:
    """What a recording has of one topic, or of one entity."""

    name: str  # the topic, or the entity
    type: str  # of its messages, such as 'sensor_msgs/msg/JointState', or the names of its components
    count: int  # number of messages, or of rows
    first: int | None  # when the first was recorded, int ns; None: not known
    last: int | None  # when the last was
    fields: tuple[str, ...]  # field paths of the numbers in its first message; of an entity, also its timelines
    fault: str = ""  # why its messages cannot be decoded; empty if they can


def leaf(path: str) -> str:
    """A field path without an element, or the number of a copy, at its end: the name that may carry a unit."""
    return re.sub(r"(\[[^\]]*\]|(?<=.)\.\d+)+$", "", path)


def sentinel(values: FloatArray) -> float | None:
    """The size of the number that stands for "none" (−9999, 32767) in a column; None without any."""
    sizes = np.abs(values[np.isfinite(values)])
    return sentinel_among(largest(sizes)) if len(sizes) and sizes.max() in SENTINELS else None


def largest(sizes: FloatArray) -> FloatArray:
    """The largest of some sizes, different ones, ascending: as many as tell a sentinel."""
    return np.unique(sizes)[-_OTHERS - 1 :]


def sentinel_among(sizes: FloatArray) -> float | None:
    """The sentinel of a column with these :func:`largest` sizes."""
    if len(sizes) <= _OTHERS or sizes[-1] not in SENTINELS or sizes[-1] <= _FAR * sizes[-2]:
        return None
    return float(sizes[-1])


def without(values: FloatArray, size: float) -> FloatArray:
    """Numbers with NaN for those of a size."""
    return np.where(np.abs(values) == size, np.nan, values)


def prefixes(paths: Sequence[str]) -> list[str]:
    """Names of columns, whole or to a field, of which field paths are parts: what has to be read for them.

    ``joints.position[elbow]`` needs ``joints.position`` and the names beside it, ``joints.name``. Some may not exist.
    """
    inner_paths: dict[str, None] = {}
    for path in paths:
        inner_paths[path] = None
        for bracket in re.finditer(r"\[", path):
            whole = path[: bracket.start()]
            beside, dot, _ = whole.rpartition(".")
            inner_paths |= {whole: None, f"{beside}{dot}{NAMES}": None}
    return list(inner_paths)


def holders(fields: Iterable[str]) -> set[str]:
    """The names of columns that are a requested field, or that contain one."""
    return {path[:end] for path in fields for end in _ends(path)}


def numeric_paths(value: Any, path: str = "", names: Any = None) -> Iterator[str]:
    """Field paths of the numbers in a message; elements of lists by ``names``, if there are as many, else by index."""
    if isinstance(value, Mapping):
        message = cast(Mapping[str, Any], value)
        for key, part in message.items():
            yield from numeric_paths(part, f"{path}.{key}" if path else key, message.get("name"))
    elif isinstance(value, list | np.ndarray) and len(elements := cast(Sequence[Any], value)) <= _LONGEST_LIST:
        labels = cast(list[Any], names) if isinstance(names, list) else []
        for label, part in zip(labels if len(labels) == len(elements) else count(), elements, strict=False):
            yield from numeric_paths(part, f"{path}[{label}]")
    elif isinstance(value, int | float | np.number) and not isinstance(value, bool):
        yield path


def find(columns: Columns, path: str, where: str, *, part: bool = False) -> pa.ChunkedArray:
    """What a name or a field path leads to among columns, nothing converted.

    The longest name that fits wins: flat tables have columns that are called ``a.b`` or ``a[0]``. Where they are only a
    part of the rows, these alone need not have the element of a list.
    """
    name = longest(columns, path)
    if name is None:
        raise UnknownNameError(where, "column", path, columns)
    label = f"{where}: column '{shortened(path)}'"
    return _inside(columns[name], path[len(name) :], columns.get(NAMES), label, part)


def conditions(path: Path, columns: Columns, where: Where) -> dict[str, pa.Scalar]:
    """What the columns of ``where`` are compared with: in their own precision, 0.1 is found among float32, too."""
    asked = dict[str, pa.Scalar]()
    for name, value in where.items():
        kind = find(columns, name, str(path)).type
        text, floating = pa.types.is_string(kind) or pa.types.is_large_string(kind), pa.types.is_floating(kind)
        of_type = pa.types.is_integer(kind) or floating or pa.types.is_decimal(kind)
        if isinstance(value, str | bool):
            of_type = text if isinstance(value, str) else pa.types.is_boolean(kind)
        if not of_type:
            what = f"column '{shortened(name)}' holds {shortened(str(kind))}, never {_written(value)}"
            raise RunError(f"{path}: where: {what}")
        asked[name] = pa.scalar(value, kind) if text or floating else pa.scalar(value)
    return asked


def met(path: Path, columns: Columns, asked: Mapping[str, pa.Scalar]) -> pa.ChunkedArray:
    """Which rows of some columns meet all conditions; what is null meets none."""
    every = (pc.equal(find(columns, name, str(path), part=True), value) for name, value in asked.items())
    return reduce(pc.and_, every)


def no_row(path: Path, parts: Iterable[Columns], where: Where) -> RunError:
    """What to say when no row is left: what the columns hold, their range or some of it."""
    held: dict[str, list[Any]] = {name: [] for name in where}
    for columns in parts:
        for name, values in held.items():
            values_seen = {*values, *pc.unique(find(columns, name, str(path), part=True).drop_null()).to_pylist()}
            ordered = sorted(values_seen)
            held[name] = ordered[:_SOME] if isinstance(where[name], str) else ordered[:1] + ordered[1:][-1:]
    wanted = " and ".join(f"{shortened(name)} = {_written(value)}" for name, value in where.items())
    ranges = list[str]()
    for name, values in held.items():
        said = list(map(_written, values))
        words = f"is {', '.join(said)}{', …' if len(said) == _SOME else ''}" if said else "has no value"
        if len(set(said)) > 1 and not isinstance(where[name], str):
            words = f"goes from {said[0]} to {said[-1]}"
        ranges.append(f"{shortened(name)} {words}")
    return RunError(f"{path}: no row has {wanted}; in this file {', '.join(ranges)}")


def _written(value: Any) -> str:
    return shortened(repr(value) if isinstance(value, str) else str(value).lower())


def longest(columns: Container[str], path: str) -> str | None:
    """The longest name that is the path, or that the path goes on from."""
    return next((path[:end] for end in reversed(_ends(path)) if path[:end] in columns), None)


def _ends(path: str) -> list[int]:
    """Where names of columns may end in a field path."""
    return [index for index, letter in enumerate(f"{path}.") if letter in ".["]


def joined(tables: Iterable[pa.Table], what: str) -> pa.Table | None:
    """One table of many, whose columns may differ; None of none."""
    parts, size = list[pa.Table](), 0
    for table in tables:
        parts.append(table)
        size += table.nbytes
        if size > _MOST_BYTES:
            raise ValueError(f"the fields asked for of {what} hold more than {_MOST_BYTES >> 30} GB")
    try:
        return pa.concat_tables(parts, promote_options="permissive") if parts else None
    except (pa.ArrowInvalid, pa.ArrowTypeError) as error:
        raise ValueError(f"{what} changes its type: {reason(error)}") from None


def _inside(
    column: pa.ChunkedArray, inner: str, names: pa.ChunkedArray | None, label: str, part: bool
) -> pa.ChunkedArray:
    """What the rest of a field path, ``[2].x``, leads to in a column; ``names`` is the list of names beside it."""
    if not inner:
        return column.cast(column.type.value_type) if pa.types.is_dictionary(column.type) else column
    if inner.startswith("["):
        key, closed, inner = inner[1:].partition("]")
        if not closed:
            raise RunError(f"{label}: '[' without ']'; an element is written position[2] or position[elbow]")
        return _inside(_element(column, key, names, label, part), inner, None, label, part)
    if not inner.startswith("."):
        raise RunError(f"{label}: '.' or '[' is missing before '{shortened(inner)}'")
    if not pa.types.is_struct(column.type):
        raise RunError(f"{label}: no field '{shortened(inner[1:])}' in {_in_words(column.type)}")
    fields = {field.name: pc.struct_field(column, [index]) for index, field in enumerate(column.type)}
    name = longest(fields, inner[1:])
    if name is None:
        raise UnknownNameError(label, "field", inner[1:], fields)
    return _inside(fields[name], inner[1 + len(name) :], fields.get(NAMES), label, part)


def _element(
    column: pa.ChunkedArray, key: str, names: pa.ChunkedArray | None, label: str, part: bool
) -> pa.ChunkedArray:
    """An element of the list in each row, by its place or its name; null in a row that has none."""
    if not _is_any(column.type, _LISTS):
        raise RunError(f"{label}: no element '{shortened(key)}' in {_in_words(column.type)}")
    elements, lengths, starts = _elements(column)
    if key.isascii() and key.isdigit():
        index = int(key) if len(key) < 10 else _GIGA
    elif names is None or not _is_any(names.type, _LISTS) or not _is_any(names.type.value_type, _TEXTS):
        raise RunError(
            f"{label}: no list '{NAMES}' of text beside it says which element is '{shortened(key)}'; by their place"
            " they are 0, 1, 2"
        )
    else:
        index = _places(names, key)
    in_list = (index >= 0) & (index < lengths)
    if len(in_list) and not in_list.any() and not part:
        what = f"at most {lengths.max()} elements"
        if names is not None and not isinstance(index, int):
            names_seen = pc.unique(pc.list_flatten(names).drop_null()).to_pylist()[:20]
            what = ", ".join(map(shortened, names_seen)) or "no names"
        raise RunError(f"{label}: no row has an element '{shortened(key)}'; they have {what}")
    return pa.chunked_array([elements.take(pa.array(starts + index, mask=~in_list))])


def _elements(column: pa.ChunkedArray) -> tuple[pa.Array, IntArray, IntArray]:
    """The elements of all lists of a column, one after the other; how many each row has, and where its first is."""
    lengths = _filled(pc.list_value_length(column).cast(pa.int64()), 0)
    return pc.list_flatten(column).combine_chunks(), lengths, np.cumsum(lengths) - lengths


def _places(names: pa.ChunkedArray, key: str) -> IntArray:
    """Place of a name in the list of each row, −1 where it is not there, (rows,)."""
    elements, lengths, starts = _elements(names)
    positions = np.flatnonzero(_filled(pc.equal(elements, key).cast(pa.uint8()), 0))
    rows = np.repeat(np.arange(len(lengths)), lengths)[positions]
    places = np.full(len(lengths), -1)
    places[rows[::-1]] = (positions - starts[rows])[::-1]  # the first of several
    return places


def _is_any(kind: pa.DataType, kinds: Sequence[Callable[[pa.DataType], bool]]) -> bool:
    return any(is_kind(kind) for is_kind in kinds)


def _in_words(kind: pa.DataType) -> str:
    """A type as errors call it, and the way into it where it has an inside."""
    if pa.types.is_struct(kind) and kind.num_fields:
        return f"structs of {', '.join(field.name for field in kind)} (as in .{kind.field(0).name})"
    if _is_any(kind, _LISTS):
        return "lists (an element is written [0])"
    return shortened(str(kind))


def _filled(column: Any, missing: float) -> Any:
    """The numbers of a column, ``missing`` where it has none. Pyarrow's ``to_numpy`` would import pandas (0.2 s)."""
    whole = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    values_there = np.full(len(whole), missing)
    values_there[np.from_dlpack(pc.is_valid(whole).cast(pa.uint8())) > 0] = np.from_dlpack(pc.drop_null(whole))
    return values_there
