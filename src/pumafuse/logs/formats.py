"""Files of other programs with one table or several: MATLAB's, NumPy's, Excel's, PX4's, and JSON."""

from __future__ import annotations

import contextlib
import csv
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias, cast

import msgspec
import numpy as np
import numpy.typing as npt
import pyarrow as pa

from ..errors import RunError, one_line, plural, unknown_part, warn

Arrays: TypeAlias = dict[str, npt.NDArray[Any]]
_Tables: TypeAlias = dict[str, pa.Table | bytes]  # by name; of a sheet its cells as CSV

SHEETS = ".xlsx"
ENDINGS = (".mat", ".npy", ".npz", ".json", ".ulg", SHEETS)
ARRAY = ".npy"
_OBJECTS = "objects of Python, which are not loaded, as they may run code; save arrays of numbers"
_FEWEST = 2  # rows: one number is a setting


def has_tables(path: Path) -> bool:
    """Whether a file is of these formats; a folder of .npy is, as if these were arrays of one file."""
    return path.name.endswith(ENDINGS) or (os.path.isdir(path) and any(path.glob(f"*{ARRAY}")))  # noqa: PTH112


def names(path: Path) -> list[str]:
    """The names of the tables of a file; a single table has the empty name."""
    return list(_tables(path, _written(path)))


def table(path: Path, name: str) -> pa.Table | bytes:
    """A table of a file; of a sheet its cells as CSV."""
    read_tables = _tables(path, _written(path))
    if name not in read_tables:
        raise unknown_part(path, "topic", name, dict.fromkeys(read_tables, "a table"), ())
    return read_tables[name]


def turned_note(signals: int, numbers: int) -> str:
    """The note on a table that is read with rows and columns exchanged."""
    return f"has {plural(signals, 'row')} of {plural(numbers, 'number')}: read turned, each row as a column"


def _written(path: Path) -> int:
    """When a file, or the last of a folder, was written [ns since 1970]."""
    files = [*path.glob(f"*{ARRAY}")] if path.is_dir() else [path] if path.is_file() else []
    return max((file.stat().st_mtime_ns for file in files), default=0)


@lru_cache(maxsize=1)
def _tables(path: Path, _written: int) -> _Tables:
    """The tables of a file by name; a file is read once for all of them."""
    with one_line(path, "'pumafuse[formats]'"):
        if path.is_dir():
            tables = _of_value(_loaded(path))
        elif path.is_file() and not path.stat().st_size:
            raise RunError(f"{path}: the file is empty; record or copy it again")
        else:
            with path.open("rb") as file:
                tables = {SHEETS: _sheets, ".ulg": _topics}.get(path.suffix, _arrays)(path, file)
    if not tables:
        raise RunError(f"{path}: no table in it: nothing has rows of numbers; save an array, or a list of records")
    return {"": next(iter(tables.values()))} if len(tables) == 1 else tables


def _sheets(_path: Path, file: BinaryIO) -> _Tables:
    """The sheets of a workbook that have cells, as CSV."""
    from openpyxl import load_workbook

    book: Any = load_workbook(file, read_only=True, data_only=True)
    sheets = _Tables()
    for sheet in book.worksheets:
        text = io.StringIO()
        rows = (row for row in sheet.iter_rows(values_only=True) if any(cell is not None for cell in row))
        csv.writer(text).writerows([c.isoformat() if isinstance(c, datetime) else c for c in row] for row in rows)
        if text.tell():
            sheets[sheet.title] = text.getvalue().encode()
    return sheets


def _topics(path: Path, file: BinaryIO) -> _Tables:
    """The topics of a log of PX4, whose stamps are in us; what its reader prints of a damaged one is a warning."""
    from pyulog import ULog  # pyright: ignore[reportMissingTypeStubs]

    by_topic = _Tables()
    with contextlib.redirect_stdout(io.StringIO()) as said:
        topics = cast(Any, ULog)(file).data_list
    if lines := said.getvalue().splitlines():
        warn([f"{path.name}: damaged, and read as far as it goes; pyulog says: {lines[0]}"])
    for topic in topics:
        data: Mapping[str, npt.NDArray[Any]] = topic.data
        columns = {f"{name}_us" if name.startswith("timestamp") else name: column for name, column in data.items()}
        by_topic[f"{topic.name}_{topic.multi_id}" if topic.multi_id else topic.name] = pa.table(columns)
    return by_topic


def _arrays(path: Path, file: BinaryIO) -> _Tables:
    if path.suffix == ".json":
        text = file.read()
        try:
            value = msgspec.json.decode(text)
        except msgspec.DecodeError:  # a list of what its lines hold, if each of them is JSON
            value = cast(Any, msgspec.json.Decoder()).decode_lines(text)
    elif path.suffix == ".mat":
        value = _matlab(path, file)
    else:
        try:
            loaded: Any = np.load(file, allow_pickle=False)
        except ValueError as error:
            # of what is no array numpy says that it is pickled, and how to load it unsafely
            what = _OBJECTS if str(error).startswith("Object arrays") else "no array of numpy, or damaged"
            raise RunError(f"{path}: {what}") from None
        value = _of_numbers(path, loaded) if path.suffix == ".npz" else loaded
    return _of_value(value)


def _of_numbers(path: Path, loaded: Mapping[str, npt.NDArray[Any]]) -> Arrays:
    """The arrays of a file without those of objects, which are named."""
    arrays, objects = Arrays(), list[str]()
    for name in loaded:
        try:
            arrays[name] = loaded[name]
        except ValueError:
            objects.append(name)
    if objects:
        warn([f"{path.name}: {', '.join(objects)}: {_OBJECTS}"])
    return arrays


def _loaded(folder: Path) -> Arrays:
    """The arrays of a folder by the names of their files, without files that numpy cannot read."""
    arrays = Arrays()
    for path in sorted(folder.glob(f"*{ARRAY}")):
        with contextlib.suppress(ValueError, OSError, EOFError):
            arrays[path.stem] = np.load(path, allow_pickle=False)
    return arrays


def _of_value(value: Any) -> _Tables:
    """The tables in a value of arrays, structs and lists."""
    tables = _Tables()
    for name, item in _apart(value, ""):
        tables.update(_by_length(item, name))
    return tables


def _matlab(path: Path, file: BinaryIO) -> Any:
    from scipy.io import loadmat  # pyright: ignore

    try:
        return cast(Any, loadmat)(file, simplify_cells=True)
    except NotImplementedError:
        raise RunError(
            f"{path}: MATLAB's format 7.3, which is HDF5; in MATLAB: clear; load('{path.name}');"
            f" save('{path.stem}_v7.mat', '-v7')"
        ) from None


def _apart(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    """The values that make a table each, by path: trials of a list, and structs within a struct without arrays."""
    if _are_trials(value):
        for index, item in enumerate(value):
            yield from _apart(item, f"{name}[{index}]")
        return
    struct = cast(Mapping[str, Any], value) if isinstance(value, Mapping) else dict[str, Any]()
    inside = {
        key: struct[key]
        for key, item in struct.items()
        if not key.startswith("__") and (isinstance(item, Mapping | list) or np.size(item) > 1)
    }
    if inside and all(isinstance(item, Mapping) and not _is_column(item) for item in inside.values()):
        for key, item in inside.items():
            yield from _apart(item, f"{name}.{key}" if name else key)
    elif len(inside) == 1 and not isinstance(only := next(iter(inside.values())), np.ndarray):
        yield from _apart(only, name)
    else:
        lists = {key: records for key, records in inside.items() if _are_trials(records)}
        for key, item in lists.items():
            yield from _apart(item, f"{name}.{key}" if name else key)
        yield name, {key: item for key, item in struct.items() if key not in lists} if lists else value


def _are_trials(value: Any) -> bool:
    """Whether a list holds runs: records with lists longer than it is itself. Rows with lists of joints are shorter."""
    records = cast(Sequence[Any], value if isinstance(value, list) else [])
    if len(records) < 2 or not all(isinstance(record, Mapping) for record in records):
        return False
    lists = [[cast(list[Any], cells) for cells in record.values() if isinstance(cells, list)] for record in records]
    longest = [max(map(len, some), default=0) for some in lists]
    return min(longest) >= _FEWEST and max(longest) > len(records)


def _is_column(value: Any) -> bool:
    """Whether a table is a column by its rows, as pandas writes it: {"0": 0.5, "1": 0.6}."""
    keys = cast(Mapping[str, Any], value)
    return len(keys) > 0 and all(key.isdigit() for key in keys)


def _by_length(value: Any, name: str) -> dict[str, pa.Table]:
    """Tables of arrays that are equally long, called after their first array where there are several."""
    columns = dict(_columns(value, ""))
    lengths = {len(column) for column in columns.values() if column.ndim == 1}
    groups, turned = dict[int, Arrays](), dict[str, str]()
    for key, column in columns.items():
        along = column.shape[0] in lengths or (column.shape[-1] not in lengths and column.shape[0] >= column.shape[-1])
        if column.ndim == 2 and not along:
            turned |= {} if lengths else {"note": turned_note(*column.shape)}
            column = column.T
        groups.setdefault(len(column), {})[key] = column
    groups = {rows: group for rows, group in groups.items() if rows >= _FEWEST}
    made = {next(iter(group)): _table(group).replace_schema_metadata(turned) for group in groups.values()}
    return {name if len(made) == 1 else ".".join(filter(None, (name, first))): group for first, group in made.items()}


def _table(arrays: Arrays) -> pa.Table:
    """A table of arrays (rows,) or (rows, n); of one array without a name its n columns."""
    if list(arrays) == [""]:
        whole = arrays[""].reshape(len(arrays[""]), -1)
        arrays = {f"column {index + 1}": column for index, column in enumerate(whole.T)}
    columns = {name: pa.array(np.ascontiguousarray(array).ravel()) for name, array in arrays.items()}
    wide = {name: array.shape[1] for name, array in arrays.items() if array.ndim == 2}
    lists = {name: pa.FixedSizeListArray.from_arrays(columns[name], width) for name, width in wide.items()}
    return pa.table({**columns, **lists})


def _columns(value: Any, name: str) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """All arrays within a value, by their paths: numbers, text and times of one or two dimensions."""
    if isinstance(value, Mapping):
        struct = cast(Mapping[str, Any], value)
        if {"columns", "data"} <= struct.keys():  # as pandas splits a table
            struct = dict(zip(struct["columns"], zip(*struct["data"], strict=True), strict=True))
        if _is_column(struct):
            struct, value = {}, list(struct.values())
        for key, item in struct.items():
            if not key.startswith("__"):
                yield from _columns(item, f"{name}.{key}" if name else str(key))
    if isinstance(value, list | tuple):
        rows = cast(Sequence[Any], value)
        if rows and all(isinstance(row, Mapping) for row in rows):
            records = cast(Sequence[Mapping[str, Any]], rows)
            value = {key: [row.get(key) for row in records] for row in records[:1] for key in row}
            yield from _columns(value, name)
            return
        value = _as_array(rows)
    if isinstance(value, np.ndarray):
        array = cast(npt.NDArray[Any], value).squeeze()
        for field in array.dtype.names or ():
            yield from _columns(array[field], f"{name}.{field}" if name else field)
        if array.dtype.kind in "biufUMm" and array.ndim in (1, 2) and array.size:
            yield name, array.astype(array.dtype.newbyteorder("="))


def _as_array(rows: Sequence[Any]) -> npt.NDArray[Any]:
    """A list as an array: of numbers with NaN for none, or of text; empty of anything else."""
    if any(isinstance(row, str) for row in rows):
        return np.array(["" if row is None else str(row) for row in rows])
    try:
        return np.array(rows, dtype=None if all(type(row) is int for row in rows) else np.float64)
    except (ValueError, TypeError, OverflowError):
        return np.empty(0)
