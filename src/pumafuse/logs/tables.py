"""Tables on disk, CSV or Parquet: columns as SI arrays, whatever state the log is in.

A cell that is empty or no number becomes NaN, a line that does not fit the header is left out; both are counted and
noted in one sentence each.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as papq

from .. import units
from ..arrays import NO_STAMP, REACH_NS, FloatArray, TimeArray
from ..errors import RunError, UnknownNameError, counted

_COMPRESSED = {".gz", ".bz2", ".lz4", ".zst", ".br"}  # a torn one cannot be read at all
_WHOLE = r"^[+-]?\d{1,19}$"
_NUMBER = r"^[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|[iI]nf|inf)$"
_BLANK = ("", "NaN", "nan", "-nan", "NA", "N/A", "n/a", "#N/A", "NULL", "null", "None")
_NUMBERS = (pa.types.is_floating, pa.types.is_integer, pa.types.is_decimal, pa.types.is_null)
_NEITHER_NUMBERS_NOR_TEXT = (pa.types.is_boolean, pa.types.is_temporal, pa.types.is_nested)


@dataclass(frozen=True)
class Table:
    """One table file.

    Attributes:
        path: Where it was read from.
        columns: Its columns by name.
        rows: Number of rows.
        notes: What was wrong with the file as a whole, a sentence each.
    """

    path: Path
    columns: dict[str, pa.ChunkedArray]
    rows: int
    notes: tuple[str, ...]

    def numbers(self, name: str) -> tuple[FloatArray, str | None]:
        """A column of positions [m or rad], NaN where a cell is empty or no number, and a note on cells that were text.

        Raises:
            RunError: The column is absent, its name ends in no unit of a length or an angle, or it holds something else
                than numbers.
        """
        unit = self._unit(name, (*units.LENGTHS, *units.ANGLES), "_mm")
        values, note = self.plain(name)
        return units.si_of(values, unit), note

    def plain(self, name: str) -> tuple[FloatArray, str | None]:
        """A column of numbers without conversion, with NaN and note as in :meth:`numbers`.

        Raises:
            RunError: The column is absent or holds something else than numbers.
        """
        column, note = self._numeric(name)
        return _filled(column.cast(pa.float64(), safe=False), np.nan), note

    def texts(self, name: str) -> list[str]:
        """A column as trimmed text, empty where a cell is; whole numbers without a point.

        Raises:
            RunError: The column is absent or has no text.
        """
        column = self._column(name)
        if pa.types.is_floating(column.type):
            whole = pc.and_(pc.less(pc.abs(column), 1e15), pc.equal(column, pc.round(column)))
            column = column.cast(pa.int64()) if pc.all(whole).as_py() else column
        return [(cell or "").strip() for cell in self._cast(name, column, pa.string()).to_pylist()]

    def stamps(self, name: str) -> tuple[TimeArray, str | None]:
        """A time column in int64 ns, ``NO_STAMP`` where a cell is empty or no time, and a note on cells that were text.

        Whole numbers are exact, also beside cells of text.

        Raises:
            RunError: The column is absent, its name ends in no unit of time, or a stamp is beyond reach of int64 ns.
        """
        column, note, per_unit = self._column(name), None, 1
        if pa.types.is_timestamp(column.type):
            column = self._cast(name, column, pa.timestamp("ns")).cast(pa.int64())
        else:
            per_unit = 10 ** (9 - 3 * units.TIMES.index(self._unit(name, units.TIMES, "_s")))
            column, note = self._numeric(name)
        rough = _filled(column.cast(pa.float64(), safe=False), np.nan) * per_unit
        beyond = np.flatnonzero(np.isfinite(rough) & (np.abs(rough) >= REACH_NS))
        if len(beyond):
            raise RunError(
                f"{self.path}: column '{name}', row {beyond[0] + 1}: a stamp beyond the year 2110; is its unit what its"
                " name says?"
            )
        found = np.where(np.isfinite(rough), np.rint(rough), NO_STAMP).astype(np.int64)
        if pa.types.is_string(column.type):
            column = pc.if_else(pc.match_substring_regex(column, _WHOLE), column, pa.scalar(None, pa.string()))
        if pa.types.is_string(column.type) or pa.types.is_integer(column.type):
            whole = _filled(self._cast(name, column, pa.int64()), NO_STAMP)
            found = np.where(whole == NO_STAMP, found, whole * per_unit)
        return found, note

    def _cast(self, name: str, column: pa.ChunkedArray, kind: pa.DataType) -> pa.ChunkedArray:
        try:
            return column.cast(kind)
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
            raise RunError(f"{self.path}: column '{name}': {str(error).splitlines()[0]}") from None

    def _unit(self, name: str, accepted: tuple[str, ...], example: str) -> str:
        self._column(name)
        unit = units.ending(name)
        if unit is None or unit not in accepted:
            raise RunError(
                f"{self.path}: column '{name}' has no unit in its name; it must end in {', '.join(accepted)}"
                f" (for instance '{name}{example}')"
            )
        return unit

    def _column(self, name: str) -> pa.ChunkedArray:
        if name not in self.columns:
            raise UnknownNameError(str(self.path), "column", name, self.columns)
        return self.columns[name]

    def _numeric(self, name: str) -> tuple[pa.ChunkedArray, str | None]:
        """A column of numbers, or of text that is numbers; cells of other text are null, and counted in a note."""
        column = self._column(name)
        if any(is_kind(column.type) for is_kind in _NUMBERS):
            return column, None
        if any(is_kind(column.type) for is_kind in _NEITHER_NUMBERS_NOR_TEXT):
            raise RunError(f"{self.path}: column '{name}' holds {column.type}, not numbers")
        column = self._cast(name, column, pa.string())
        trimmed = pc.utf8_trim_whitespace(column)
        numeric = pc.match_substring_regex(trimmed, _NUMBER)
        words = pc.and_(pc.is_valid(column), pc.invert(pc.or_(numeric, pc.is_in(trimmed, value_set=pa.array(_BLANK)))))
        count, note = pc.sum(words).as_py() or 0, None
        if count:
            row = pc.index(words, value=True).as_py()
            note = (
                f"{self.path.name}: {counted(count, 'cell')} of column '{name}' without a number, first"
                f" {column[row].as_py()[:40]!r} in row {row + 1}: taken as missing"
            )
        return pc.if_else(numeric, trimmed, pa.scalar(None, pa.string())), note


def read(path: Path, *, growing: bool = False) -> Table:
    """Read a CSV or Parquet table, gzip allowed for CSV (``.csv.gz``).

    Args:
        path: The file.
        growing: Whether it may still be growing, or its writer may have been killed. A last line of a CSV without its
            line break may then be torn within a number: it is left out, and noted.

    Raises:
        RunError: The file is absent, empty, or neither CSV nor Parquet inside.
    """
    try:
        with pa.input_stream(str(path)) as stream:
            content = stream.read()
        if not content:
            raise RunError(f"{path}: the file is empty")
        if path.suffix == ".parquet":
            # Without threads: one that outlives the interpreter aborts it (apache/arrow issue 34314).
            whole = papq.read_table(pa.BufferReader(content), use_threads=False, pre_buffer=False)
            table, notes = whole, list[str]()
        else:
            table, notes = _parsed(path, content, growing)
        names: list[str] = table.column_names
    except UnicodeDecodeError:
        raise RunError(f"{path}: not a table that can be read: its text is not UTF-8") from None
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        reason = str(error).splitlines()[0].removeprefix("CSV parse error: ")
        raise RunError(f"{path}: not a table that can be read: {reason}") from None
    except FileNotFoundError:
        raise RunError(f"{path}: no such file") from None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or str(error).splitlines()[0]}") from None
    if table.num_rows == 0:
        notes = [f"{path.name}: the table has no rows", *notes]
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise RunError(f"{path}: two columns are named '{repeated}'")
    return Table(path, dict(zip(names, table.columns, strict=True)), table.num_rows, tuple(notes))


def write(table: pa.Table, path: Path) -> None:
    """Write a table, as CSV or Parquet by the ending of its name."""
    if path.suffix == ".csv":
        pacsv.write_csv(table, path, pacsv.WriteOptions(quoting_style="needed"))
    else:
        papq.write_table(table, path, compression="zstd")


def _parsed(path: Path, text: bytes, growing: bool) -> tuple[pa.Table, list[str]]:
    """The table in a CSV text; lines with the wrong number of cells, and a torn last line, are left out and noted."""
    notes: list[str] = []
    if growing and b"\n" in text and not text.endswith((b"\n", b"\r")) and path.suffix not in _COMPRESSED:
        text = text[: text.rindex(b"\n") + 1]
        torn = "the last line has no end and may be torn: left out (if it is whole, end it with a line break)"
        notes = [f"{path.name}: {torn}"]
    wrong: list[pacsv.InvalidRow] = []

    def leave_out(row: pacsv.InvalidRow) -> str:
        wrong.append(row)
        return "skip"

    def parsed(**options: Any) -> pa.Table:
        return pacsv.read_csv(
            pa.BufferReader(text),
            read_options=pacsv.ReadOptions(use_threads=False),
            convert_options=pacsv.ConvertOptions(null_values=_BLANK, strings_can_be_null=True),
            **options,
        )

    try:
        return parsed(), notes
    except pa.ArrowInvalid as error:
        if " columns, got " not in str(error):
            raise
    text.decode("utf-8")  # pyarrow cannot hand over a wrong line that is not UTF-8
    table = parsed(parse_options=pacsv.ParseOptions(invalid_row_handler=leave_out))
    note = (
        f"{path.name}: {counted(len(wrong), 'line')} left out: {wrong[0].actual_columns} cells where the header has"
        f" {wrong[0].expected_columns}, first in line {wrong[0].number}"
    )
    if table.num_rows == 0:  # not the kind of table that it should be
        raise RunError(f"{path}: the table has no rows; {note}")
    return table, [note, *notes]


def _filled(column: pa.ChunkedArray, missing: float) -> Any:
    """The numbers of a column, ``missing`` where it has none. Pyarrow's ``to_numpy`` would import pandas (0.2 s)."""
    whole = column.combine_chunks()
    found = np.full(len(whole), missing)
    found[np.from_dlpack(pc.is_valid(whole).cast(pa.uint8())) > 0] = np.from_dlpack(pc.drop_null(whole))
    return found
