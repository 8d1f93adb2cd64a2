"""Tables on disk, CSV or Parquet: columns as SI arrays, whatever state the log is in.

A cell that is empty or no number becomes NaN, a line that does not fit the header is left out; both are counted and
told in one sentence each. Nothing here knows what a command or a sensor is.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as papq

from .. import units
from ..arrays import NO_STAMP, FloatArray, TimeArray
from ..errors import RunError, UnknownNameError

_EPOCH_LIMIT_S = 9.2e9  # |stamp| that int64 ns can hold


@dataclass(frozen=True)
class Table:
    """One table file.

    Attributes:
        path: Where it was read from.
        columns: Its columns by name.
        rows: How many rows it has.
        notes: What was wrong with the file as a whole, a sentence each.
    """

    path: Path
    columns: dict[str, pa.ChunkedArray]
    rows: int
    notes: tuple[str, ...]

    def numbers(self, name: str) -> tuple[FloatArray, str | None]:
        """A length column in metres, NaN where a cell is empty or no number, and a note on cells that were text.

        Raises:
            RunError: The column is absent or its name ends in no unit of length.
        """
        exponent = self._exponent(name, units.LENGTHS, "_mm")
        values, note = self._floats(name)
        # Division by the exact power of ten rounds once: 1.1 mm and 0.0011 m are the same float.
        return (values / 10.0**-exponent if exponent < 0 else values), note

    def stamps(self, name: str) -> tuple[TimeArray, str | None]:
        """A time column in int64 ns, ``NO_STAMP`` where a cell is empty or no time, and a note on cells that were text.

        Raises:
            RunError: The column is absent, its name ends in no unit of time, or its stamps do not fit int64 ns.
        """
        column = self._column(name)
        if pa.types.is_timestamp(column.type):
            ticks = column.cast(pa.timestamp("ns")).cast(pa.int64())
            return _filled(ticks), None
        per_unit = 10 ** (9 + self._exponent(name, units.TIMES, "_s"))
        if pa.types.is_integer(column.type):
            ticks = _filled(column.cast(pa.int64()))
            beyond = (ticks != NO_STAMP) & (np.abs(ticks) > _EPOCH_LIMIT_S * 1e9 / per_unit)
            note = None
            ticks = np.where(ticks == NO_STAMP, NO_STAMP, ticks * per_unit)
        else:
            values, note = self._floats(name)
            beyond = np.abs(values) > _EPOCH_LIMIT_S * 1e9 / per_unit
            with np.errstate(invalid="ignore"):
                ticks = np.where(np.isfinite(values), np.rint(values * per_unit), NO_STAMP).astype(np.int64)
            beyond &= np.isfinite(values)
        if beyond.any():
            row = int(np.flatnonzero(beyond)[0])
            raise RunError(
                f"{self.path}: column '{name}', row {row + 1}: a stamp beyond the year 2260; is its unit what its name"
                " says?"
            )
        return ticks, note

    def _exponent(self, name: str, accepted: tuple[str, ...], example: str) -> int:
        self._column(name)
        unit = units.ending(name)
        if unit not in accepted:
            raise RunError(
                f"{self.path}: column '{name}' has no unit in its name; it must end in {', '.join(accepted)}"
                f" (for instance '{name}{example}')"
            )
        return units.EXPONENTS[unit]

    def _column(self, name: str) -> pa.ChunkedArray:
        if name not in self.columns:
            raise UnknownNameError(str(self.path), "column", name, self.columns)
        return self.columns[name]

    def _floats(self, name: str) -> tuple[FloatArray, str | None]:
        column = self._column(name)
        if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
            numeric = pc.match_substring_regex(pc.utf8_trim_whitespace(column), _NUMBER)
            text = pc.and_(pc.is_valid(column), pc.invert(pc.or_(numeric, _is_blank(column))))
            count = pc.sum(text).as_py() or 0
            note = None
            if count:
                row = pc.index(text, value=True).as_py()
                note = (
                    f"{self.path.name}: {count} cells of column '{name}' hold no number, first"
                    f" '{column[row].as_py()}' in row {row + 1}: taken as missing"
                )
            column = pc.if_else(numeric, pc.utf8_trim_whitespace(column), pa.scalar(None, pa.string()))
            return _to_numpy(column.cast(pa.float64())), note
        if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type) or pa.types.is_null(column.type)):
            raise RunError(f"{self.path}: column '{name}' holds {column.type}, not numbers")
        return _to_numpy(column.cast(pa.float64())), None


_NUMBER = r"^[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|[iI]nf|inf)$"
_BLANK = {"", "NaN", "nan", "-nan", "NA", "N/A", "n/a", "#N/A", "NULL", "null", "None"}


def read(path: Path) -> Table:
    """Read a CSV or Parquet table, gzip allowed for CSV (``.csv.gz``).

    Raises:
        RunError: The file is absent, empty, or neither CSV nor Parquet inside.
    """
    try:
        if path.suffix == ".parquet":
            table, notes = papq.read_table(path), ()
        else:
            table, notes = _read_csv(path)
    except FileNotFoundError:
        raise RunError(f"{path}: no such file") from None
    except UnicodeDecodeError:
        raise RunError(f"{path}: not a table that can be read: its text is not UTF-8") from None
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        reason = str(error).splitlines()[0].removeprefix("CSV parse error: ")
        raise RunError(f"{path}: not a table that can be read: {reason}") from None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or str(error).splitlines()[0]}") from None
    if table.num_rows == 0:
        raise RunError(f"{path}: the table has no rows")
    names = table.column_names
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise RunError(f"{path}: two columns are named '{repeated}'")
    return Table(path, dict(zip(names, table.columns, strict=True)), table.num_rows, tuple(notes))


def write(table: pa.Table, path: Path) -> None:
    """Write a Parquet table."""
    papq.write_table(table, path, compression="zstd")


def _read_csv(path: Path) -> tuple[pa.Table, list[str]]:
    """A CSV file; lines with the wrong number of cells (a torn last line) are left out and told."""
    torn: list[pacsv.InvalidRow] = []

    def leave_out(row: pacsv.InvalidRow) -> str:
        torn.append(row)
        return "skip"

    def skip(_: pacsv.InvalidRow) -> str:
        return "skip"

    if path.stat().st_size == 0:
        raise RunError(f"{path}: the file is empty")
    parse = pacsv.ParseOptions(invalid_row_handler=leave_out)
    serial = pacsv.ReadOptions(use_threads=False)
    blanks = pacsv.ConvertOptions(null_values=sorted(_BLANK), strings_can_be_null=True)
    try:
        table = pacsv.read_csv(path, read_options=serial, parse_options=parse, convert_options=blanks)
    except pa.ArrowInvalid as error:
        if "conversion error" not in str(error):
            raise
        # Types are guessed from the first block; text further down is met by reading every cell as text.
        torn.clear()
        names = pacsv.open_csv(path, parse_options=pacsv.ParseOptions(invalid_row_handler=skip)).schema.names
        blanks.column_types = dict.fromkeys(names, pa.string())
        table = pacsv.read_csv(path, read_options=serial, parse_options=parse, convert_options=blanks)
    if not torn:
        return table, []
    where = "" if torn[0].number is None else f", first in line {torn[0].number}"
    return table, [
        f"{path.name}: {len(torn)} lines with {torn[0].actual_columns} cells where the header has"
        f" {torn[0].expected_columns}{where}: left out"
    ]


def _is_blank(column: pa.ChunkedArray) -> pa.ChunkedArray:
    return pc.is_in(pc.utf8_trim_whitespace(column), value_set=pa.array(sorted(_BLANK)))


def _filled(column: pa.ChunkedArray) -> TimeArray:
    return column.fill_null(NO_STAMP).to_numpy().astype(np.int64)


def _to_numpy(column: pa.ChunkedArray) -> npt.NDArray[np.float64]:
    return column.to_numpy(zero_copy_only=False).astype(np.float64)
