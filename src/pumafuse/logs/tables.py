"""Tables on disk, text or Parquet: which columns and rows of them are read.

A line of text that does not fit the header is left out, and noted in a sentence.
"""

from __future__ import annotations

import codecs
import math
import os
import re
import stat
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.json as pajson
import pyarrow.parquet as papq

from ..arrays import FloatArray
from ..errors import RunError, UnknownNameError, plural, shortened
from . import formats
from .columns import (
    BLANK,
    NUMBER,
    SENTINELS,
    Table,
    Where,
    conditions,
    find,
    largest,
    longest,
    met,
    no_row,
    prefixes,
    sentinel_among,
)

Choice: TypeAlias = Callable[[Sequence[str]], Sequence[str]]  # of some among all names of columns
_Text: TypeAlias = tuple[pa.Table, list[str], list[str]]  # a table, names of all its columns, what was wrong with it

_COMPRESSED = {".gz", ".bz2", ".lz4", ".zst", ".br"}  # a torn one cannot be read at all
_RECORDINGS = {".mcap", ".bag", ".db3", ".rrd"}
_BATCH = 1 << 16  # rows of Parquet that are in memory before rows are chosen
_READ_AHEAD = 1 << 20  # bytes of a column of Parquet
_COMPRESSION = "zstd"
_HEAD = 1 << 16  # bytes of a text, among which its header is
_DEEPEST, _LONG_LINE = 100, 4096  # levels of a line of JSON; bytes below which no line ends a process
_STEPS = np.zeros(256, dtype=np.int8)  # of the depth, by character
_STEPS[list(b"[{")], _STEPS[list(b"]}")] = 1, -1
_WIDE = 2_000  # columns of a text, beyond which only those asked for are read: pyarrow needs 10 to 20 kB for each
_MOST_SIGNALS, _LONG = 64, 10  # lines of a text that are signals; times as many cells as lines that each then has
_RISES = 0.95  # share of the steps of a clock that are forwards
_SMOOTH, _ROUGH = 0.1, 0.5  # roughness of what follows from cell to cell; of what does not, 1
_FIRST_ROWS = 100  # lines of a text, among which its rows begin
_BESIDE = 3  # rows of numbers that make the line above them a header
_COMMENT = re.compile(r"\s*(#|%|//)\s*")
# In a text as rows of numbers have them; with blanks between cells, as EPICS writes them, a date is two.
_NUMBER = re.compile(
    r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?inf|\d{4}-\d\d-\d\d|\d\d:\d\d:\d\d([.,]\d+)?", re.IGNORECASE
)
_UNITS = r"[µunm]?s|[µumc]?m|m?rad|deg|°|%|[km]?N|Nm|[mk]?[VA]|Hz|(?:mm|m|deg|rad|°)/s²?"
_UNIT = re.compile(rf"[\[(]?(|-|{_UNITS})[\])]?")
_UNIT_ROW = b"pumafuse: units"  # of the columns, with tabs between them, in the metadata of a table of text
# What programs print: `Target X: 70.0 mm | q[0]=1.5 | mode: auto`. A label has up to four words, as in longer ones a
# search would begin anew at each word of a line of prose.
_WORD = r"[^\W\d][\w.]*(?:[\[(][\w°]+[\])])?"
_PLAIN = r"\d\d?:\d\d:\d\d(?:[.,]\d+)?|[+-]?(?:\d+(?:[.,]\d+)?|[.,]\d+)(?:[eE][+-]?\d+)?"
_LABELLED = re.compile(
    rf"(?<![\w.])({_WORD}(?: [\w.]*{_WORD}){{0,3}})[\"']?[ \t]*[:=][ \t]*"
    rf"(?:({_PLAIN})[ \t]*((?:{_UNITS})?)(?!\w|[.:]\w)|([\[(][^\[\]()]*[\])]|[^\W\d]\w*(?![\w[(]|[ \t]*[:=])))"
)
_DATED = re.compile(rf"(?:\d{{4}}-\d\d-\d\d[T ])?(?:{_PLAIN})")  # in front of the first label
_ECHO = "%time,"  # begins the header that `rostopic echo -p` writes
_TRANSFORMS = b"%time,field.transforms0."  # of /tf: a line has all transforms of a message, as many as it likes
_FIRST = "column 1"  # what the first column is called, if it has no name
JSON_LINES = (".jsonl", ".ndjson", ".jsonl.gz", ".ndjson.gz")
_DECIMAL_COMMA = rb"(?:^|[%b\n])[ \"]*[+-]?\d*,\d+(?:[eE][+-]?\d+)?[ \"]*(?:[%b\r\n]|$)"  # between separators
_MOST_TEXT = 2 << 30  # bytes of CSV, all of which are in memory
# The first line of a matrix: its row ends with a semicolon, and the next one with that or with the matrix.
_MATRIX = re.compile(rb"(?m)^[ \t]*(\w+[ \t]*=)?[ \t]*\[(?=[^\]\n]*;[ \t]*\r?\n[^\];\n]*[;\]])")
# A list in one cell, as Python and numpy print it: [0.5, -1.2], [0.5 -1.2], array('d', [0.5]), ['elbow', 'wrist']; or
# numbers with blanks between them.
_BARE_LIST = re.compile(rb"(?<=[,;\t]) *(\[\s*[-+.\d][^\[\]\"]*\])")
_LIST = r"^(array\()?('\w', *)?[\[(]\s*(['\"]|[-+.\d])[^\0]*[\])]$"
_OPEN = re.compile(r'(?:^|[,;\t ])"[^"]*$')  # a cell that begins with a quote and has no other
_BETWEEN = r"\s*[,;]\s*|\s+"
_BETWEEN_WORDS = r"['\"]\s*,?\s*['\"]"
_AROUND_LIST = r"^(array\()?('\w', *)?[\[(]+\s*|\s*[\])]+(, *dtype=\w+\))?$"


def read(
    path: Path,
    *,
    growing: bool = False,
    fields: Sequence[str] | Choice | None = None,
    where: Where | None = None,
    topic: str = "",
    entity: str = "",
) -> Table:
    """Read a table (CSV, lines of JSON, gzip allowed for both, Parquet, :mod:`.formats`), or a part of a recording.

    A file may be growing, or its writer may have been killed. A last line of a CSV without its line break may then be
    torn within a number: it is left out, and noted. ``fields`` are columns and field paths that will be asked for, of a
    text also what chooses them among its names; None: all. Parts of a Parquet file that have no row for ``where`` are
    skipped. ``topic`` is also which of several tables in a file.
    """
    where, listed = where or {}, None if callable(fields) else fields
    refuse_endless(path)
    if is_recording(path):
        return _recording(path, topic, entity, listed, where)
    of_several = formats.has_tables(path)
    if (topic and not of_several) or entity:
        key = "topic" if topic else "entity"
        raise RunError(
            f"{path}: a table has no {key}; leave the key out: 'topic' is for MCAP and bags (.mcap, .bag, .db3 or"
            " their folder), 'entity' for .rrd; rows are chosen by 'where'"
        )
    with one_line(path):
        if path.suffix == ".parquet":
            (table, names), notes = _parquet(path, listed, where), list[str]()
        else:
            choice = None if fields is None else partial(_asked, path, fields=fields, where=where)
            if not of_several:
                whole, names, notes = _of_text(path, growing, choice)
            elif isinstance(whole := formats.table(path, topic), bytes):
                whole, names, notes = _of_csv(path, whole, choice)
            else:
                said: dict[bytes, bytes] = whole.schema.metadata or {}
                names, notes = whole.column_names, [f"{path.name}: {note.decode()}" for note in said.values()]
                whole = whole if choice is None or len(names) <= _WIDE else whole.select(_used(names, choice))
            table = _only(path, whole, where)
    if table.num_rows == 0:
        notes = [f"{path.name}: the table has no rows", *notes]
    notes += [
        f"{path.name}: two columns are named '{shortened(name)}': neither is used" for name in sorted(_repeated(names))
    ]
    metadata: dict[bytes, bytes] = table.schema.metadata or {}
    header: list[str] = table.column_names
    below = metadata.get(_UNIT_ROW, b"").decode().split("\t")
    units = {name: unit for name, unit in zip(header, below, strict=False) if unit}
    return Table(path, _named(table), table.num_rows, tuple(notes), tuple(names), units=units)


def chosen(table: Table, where: Where) -> Table:
    """The rows of a table in which each of some columns has a value."""
    if not where:
        return table
    rows = _only(table.path, pa.table(dict(table.columns)), where)
    return replace(table, columns=_named(rows), rows=rows.num_rows)


def in_parts(path: Path, fields: Sequence[str] | None) -> Iterator[Table]:
    """A Parquet table, some rows at a time; see :func:`read`."""
    with one_line(path), _opened(path) as file:
        names = tuple(file.schema.column(index).path for index in range(len(file.schema)))
        wanted, empty = _wanted(path, file, fields, {})
        for part in _parts(file, wanted, None) if file.metadata.num_rows else [empty]:
            yield Table(path, _named(part), part.num_rows, (), names)


def sentinel_of(path: Path, name: str) -> float | None:
    """The size of the number that stands for "none" in all of a column of a Parquet table; None without any."""
    if (most := _largest_by_statistics(path, name)) is not None and most not in SENTINELS:
        return None
    sizes = np.empty(0)
    for part in in_parts(path, [name]):
        with suppress(RunError):  # no row of this part has the element of a list
            values, _ = part.plain(name)
            sizes = largest(np.concatenate([sizes, np.abs(values[np.isfinite(values)])]))
    return sentinel_among(sizes)


def _largest_by_statistics(path: Path, name: str) -> float | None:
    """The largest size in a column by the file's statistics; None where they do not tell, or where it is infinite."""
    with one_line(path):
        largest, most = papq.read_metadata(str(path)), 0.0
    for group in map(largest.row_group, range(largest.num_row_groups)):
        columns = {column.path_in_schema: column for column in map(group.column, range(group.num_columns))}
        told = columns[name].statistics if name in columns else None
        if told is None or not told.has_min_max or not isinstance(told.max, int | float):
            return None
        most = max(most, abs(told.min), abs(told.max))
    return most if math.isfinite(most) else None


def row_count(path: Path) -> int:
    """How many rows a Parquet table has; 0 for what is none that can be read."""
    try:
        return papq.read_metadata(str(path)).num_rows if path.suffix == ".parquet" else 0
    except (OSError, ValueError):
        return 0


def has_slashes(path: Path, name: str) -> bool:
    """Whether a column of a Parquet table has dates with slashes, by its first cell."""
    kinds = {field.name: field.type for field in papq.read_schema(path)}
    if name not in kinds or not (pa.types.is_string(kinds[name]) or pa.types.is_large_string(kinds[name])):
        return False
    cells = next(in_parts(path, [name])).columns[name].drop_null()
    return len(cells) > 0 and "/" in cells[0].as_py()


def refuse_endless(path: Path) -> None:
    """Refuse a pipe, a socket or a device, which a reader may wait for for ever and cannot go back in."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):  # what is not there is for others to say
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise RunError(f"{path}: a pipe or a device, which may never end; write it into a file first")


def holds_numbers(path: Path) -> bool:
    """Whether a file begins as a text with rows of numbers does, whatever it is called."""
    with one_line(path), path.open("rb") as file:
        read = file.read(_HEAD)
    head = "" if b"\0" in read else read.decode("utf-8", errors="replace")
    lines = head.splitlines()
    return bool(_labels(head)) or any(
        _begins(lines, row, _separator(lines[row])) for row in range(min(len(lines), _FIRST_ROWS))
    )


def is_recording(path: Path) -> bool:
    """Whether a file or folder is an MCAP, a bag or a Rerun recording, which has topics or entities."""
    is_folder = os.path.isdir(path)  # noqa: PTH112 - Path.is_dir raises on a long name
    return path.suffix in _RECORDINGS or (is_folder and not formats.has_tables(path))


def write(table: pa.Table, path: Path) -> None:
    """Write a table, as CSV or Parquet by the ending of its name."""
    if path.suffix == ".csv":
        pacsv.write_csv(table, path, pacsv.WriteOptions(quoting_style="needed"))
    else:
        papq.write_table(table, path, compression=_COMPRESSION)


@contextmanager
def appending(path: Path) -> Generator[Callable[[pa.Table], None]]:
    """What writes tables of one schema into a Parquet file, one after the other; without any there is no file."""
    with ExitStack() as stack:
        writers: list[papq.ParquetWriter] = []

        def append(table: pa.Table) -> None:
            if not writers:
                writer = papq.ParquetWriter(str(path), table.schema, compression=_COMPRESSION)
                writers.append(stack.enter_context(writer))
            writers[0].write_table(table)

        yield append


@contextmanager
def one_line(path: Path) -> Generator[None]:
    """Turn what pyarrow raises while it reads a table into an error of one line."""
    try:
        yield
    except UnicodeDecodeError:
        raise RunError(f"{path}: not a table that can be read: its text is not UTF-8; save it as UTF-8") from None
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        reason = str(error).splitlines()[0].removeprefix("CSV parse error: ")
        reason = "a row of more than 1 MB: is a quote not closed?" if "straddling" in reason else reason
        raise RunError(f"{path}: not a table that can be read: {reason}") from None
    except FileNotFoundError:
        raise RunError(f"{path}: no such file") from None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or str(error).splitlines()[0]}") from None


def _recording(path: Path, topic: str, entity: str, fields: Sequence[str] | None, where: Where) -> Table:
    from . import recordings

    key, name, wrong, other = "topic", topic, "entity", entity
    if path.suffix == ".rrd":
        key, name, wrong, other = wrong, other, key, name
    if other:
        raise RunError(f"{path}: of such a file the key is '{key}', not '{wrong}'")
    asked = None if fields is None else [*fields, *where]
    recording = recordings.read(path, name, None if asked is None else prefixes(asked))
    _asked(path, recording.names, fields=asked or (), where={})
    return chosen(recording, where)


def _asked(path: Path, names: Sequence[str], *, fields: Sequence[str] | Choice, where: Where) -> list[str]:
    """The names of columns, whole or to a field, that have to be read."""
    asked, columns = [*(fields(names) if callable(fields) else fields), *where], set(names)
    for column in asked:
        if longest(columns, column) is None:
            raise UnknownNameError(str(path), "column", column, names)
    return prefixes(asked)


def _used(names: Sequence[str], choice: Choice) -> list[str]:
    """Names of columns that are chosen, in their order."""
    chosen = set(choice(names))
    return [name for name in names if name in chosen]


def _of_text(path: Path, growing: bool, choice: Choice | None) -> _Text:
    """The table in a text; lines with the wrong number of cells, and a torn last line, are left out and noted."""
    notes = list[str]()
    with pa.input_stream(str(path)) as stream:  # decompressed
        text = stream.read(_MOST_TEXT + 1)
    if not text:
        raise RunError(f"{path}: the file is empty; record or copy it again")
    if text.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):  # what PowerShell redirects into a file
        text = text.decode("utf-16").encode()
    if len(text) > _MOST_TEXT:
        raise RunError(f"{path}: more than {_MOST_TEXT >> 30} GB of text; as Parquet it is read some rows at a time")
    if growing and b"\n" in text and not text.endswith((b"\n", b"\r")) and path.suffix not in _COMPRESSED:
        text = text[: text.rindex(b"\n") + 1]
        torn = "the last line has no end and may be torn: left out (if it is whole, end it with a line break)"
        notes = [f"{path.name}: {torn}"]
    if path.name.endswith(JSON_LINES):
        _refuse_deep_lines(path, text)
        block = len(text) if text.find(b"\n") > _HEAD else None  # no row may be longer than a block
        table = pajson.read_json(pa.BufferReader(text), pajson.ReadOptions(use_threads=False, block_size=block))
        _refuse_deep_columns(path, table)
        names = table.column_names
        return table if choice is None or len(names) <= _WIDE else table.select(_used(names, choice)), names, notes
    table, names, more = _of_csv(path, text, choice)
    return table, names, [*more, *notes]


def _refuse_deep_lines(path: Path, text: bytes) -> None:
    """Refuse lines that would end the process: pyarrow goes into each level with a call of its own."""
    codes = np.frombuffer(text, dtype=np.uint8)
    ends = np.concatenate([[-1], np.flatnonzero(codes == ord("\n")), [len(codes)]])
    for line in np.flatnonzero(np.diff(ends) > _LONG_LINE).tolist():
        if np.cumsum(_STEPS[codes[ends[line] + 1 : ends[line + 1]]], dtype=np.int64).max() > _DEEPEST:
            raise RunError(f"{path}: line {line + 1} is nested more than {_DEEPEST} deep: no log; write rows of JSON")


def _refuse_deep_columns(path: Path, table: pa.Table) -> None:
    level = [column.type for column in table.columns]
    for _ in range(_DEEPEST):
        level = [kind.field(index).type for kind in level for index in range(kind.num_fields)]
        if not level:
            return
    raise RunError(f"{path}: nested more than {_DEEPEST} deep: no log; write rows of JSON")


def _of_csv(path: Path, text: bytes, choice: Choice | None) -> _Text:
    try:
        table, names, more = _parsed(path, text, choice)
    except (UnicodeDecodeError, pa.ArrowInvalid) as error:
        if b"\0" in text or not (isinstance(error, UnicodeDecodeError) or "UTF8" in str(error)):
            raise
        table, names, more = _parsed(path, text.decode("cp1252").encode(), choice)
        more = [f"{path.name}: its text is not UTF-8: taken for Windows-1252", *more]
    numbered, twice = _numbered(path, table.column_names)
    listed = pa.table([_listed(column) for column in table.columns], numbered, metadata=table.schema.metadata)
    return listed, names or numbered, [*twice, *more]


def _numbered(path: Path, header: Sequence[str]) -> tuple[list[str], list[str]]:
    """Names of columns of which none is empty or there twice, and a note on those that were there twice."""
    names, count = [name or _column(index) for index, name in enumerate(header)], Counter[str]()
    if not (repeated := sorted(_repeated(names))):
        return names, []
    for index, name in enumerate(names):
        names[index] = f"{name}.{count[name]}" if count[name] else name  # as pandas calls them
        count[name] += 1
    twice = ", ".join(map(shortened, repeated))
    return names, [f"{path.name}: headers that are there twice: {twice}; the second of each is called .1"]


def _listed(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """A column of text that are lists as lists of numbers, or of words; any other as it is."""
    if not pa.types.is_string(column.type):
        return column
    first = next(iter(pc.utf8_trim_whitespace(column.drop_null()[:1]).to_pylist()), "")
    match, cells = re.match(_LIST, first), first.split()
    if not match and (len(cells) < 2 or not all(re.match(NUMBER, cell) for cell in cells)):
        return column
    inside = pc.replace_substring_regex(pc.utf8_trim_whitespace(column), _AROUND_LIST, "")
    words = match is not None and match[3] in ("'", '"')
    lists = pc.split_pattern_regex(inside, _BETWEEN_WORDS if words else _BETWEEN).combine_chunks()
    elements = lists.flatten()
    if words:
        elements = pc.replace_substring_regex(elements, "['\"]", "")
    else:
        numeric = pc.match_substring_regex(elements, NUMBER)
        elements = pc.if_else(numeric, elements, None).cast(pa.float64())
    return pa.chunked_array([pa.ListArray.from_arrays(lists.offsets, elements, mask=lists.is_null())])


def _parsed(path: Path, text: bytes, choice: Choice | None) -> _Text:
    """The table in a CSV text, what was left out of it, and, where only some columns are read, the names of all."""
    text = _unbracketed(text)
    if (match := _BARE_LIST.search(text, 0, _HEAD)) and b'"' not in text[: match.start()]:
        text = _BARE_LIST.sub(rb'"\1"', text)
    text = _transforms_apart(text) if text.startswith(_TRANSFORMS) else text
    text, printed = _unlabelled(path, text)
    if (turned := _turned(text)) is not None:
        note = formats.turned_note(turned.num_columns, turned.num_rows)
        return turned, [], [f"{path.name}: {note}"]
    layout = _layout(text)
    if layout.separator == " ":
        text = re.sub(rb"(?m)^[ \t]+|[ \t]+(?=\r?$)|(?<=[ \t])[ \t]+", b"", text)
    wrong: list[pacsv.InvalidRow] = []
    above = [f"{path.name}: {plural(layout.above, 'line')} above the header left out"] if layout.above else []
    notes = [*printed, *above]
    names, used = list[str](), list[str]()
    if choice is not None and layout.names is not None and len(layout.names) > _WIDE:
        names, twice = _numbered(path, layout.names)
        layout = layout._replace(names=names)
        used, notes = _used(names, choice), [*twice, *notes]

    def leave_out(row: pacsv.InvalidRow) -> str:
        wrong.append(row)
        return "skip"

    def parsed(layout: _Layout, **options: Any) -> pa.Table:
        table = pacsv.read_csv(
            pa.BufferReader(text),
            read_options=pacsv.ReadOptions(
                use_threads=False,
                skip_rows=layout.skipped,
                column_names=layout.names,
                skip_rows_after_names=int(layout.units is not None),
            ),
            parse_options=pacsv.ParseOptions(delimiter=layout.separator, newlines_in_values=layout.broken, **options),
            convert_options=pacsv.ConvertOptions(
                null_values=BLANK, strings_can_be_null=True, decimal_point=layout.point, include_columns=used
            ),
        )
        return table if used or layout.units is None else table.replace_schema_metadata({_UNIT_ROW: layout.units})

    try:
        table = parsed(layout)
        _ = table.column_names  # only now it is seen whether they are UTF-8
        return table, names, notes
    except pa.ArrowInvalid as error:
        if " columns, got " not in str(error):
            raise
    text.decode("utf-8")  # pyarrow cannot hand over a wrong line that is not UTF-8
    table = parsed(layout, invalid_row_handler=leave_out)
    if not table.num_rows and (short := _short_header(path, names or table.column_names, layout, wrong)):
        layout, note = short
        return parsed(layout), (names and layout.names) or [], [note, *notes]
    note = (
        f"{path.name}: {plural(len(wrong), 'line')} left out: {wrong[0].actual_columns} cells where the first has"
        f" {wrong[0].expected_columns}, first in line {wrong[0].number}"
    )
    if table.num_rows == 0:  # not the kind of table that it should be
        advice = "name each cell in the header, or take the header out: columns are called column 1, column 2, … then"
        raise RunError(f"{path}: the table has no rows; {note}; {advice}")
    return table, names, [note, *notes]


def _unbracketed(text: bytes) -> bytes:
    """A matrix as MATLAB writes it, a row in each line, without brackets and semicolons; any other text as it is."""
    if (match := _MATRIX.search(text, 0, _HEAD)) is None:
        return text
    return text[: match.start()] + re.sub(rb"(?m)[ \t]*(;|\][ \t]*;?)[ \t]*(?=\r?$)", b"", text[match.end() :])


def _unlabelled(path: Path, text: bytes) -> tuple[bytes, list[str]]:
    """What a program has printed, each value behind its label, as a CSV text, and a note; any other text as it is."""
    if not (names := _labels(text[:_HEAD].decode("utf-8", errors="replace"))):
        return text, []
    rows = _labelled(text.decode("utf-8"))
    kept = [";".join(cells) for header, cells in rows if header == names]
    said = f"lines of labels and values, read as a table: {', '.join(filter(None, names))}"
    left = f"; {plural(len(rows) - len(kept), 'line')} without these left out" if len(kept) < len(rows) else ""
    return "\n".join([";".join(names), *kept, ""]).encode(), [f"{path.name}: {said}{left}"]


def _labels(head: str) -> tuple[str, ...]:
    """The two or more labels that most lines of a text have, empty for a number in front; none for other texts."""
    rows = _labelled(head)
    names, count = Counter(names for names, _ in rows).most_common(1)[0] if rows else ((), 0)
    return names if 2 * count > len(rows) and len(list(filter(None, names))) > 1 else ()


def _labelled(text: str) -> list[tuple[tuple[str, ...], list[str]]]:
    """The labels and values of each line of a text that is not blank, a label with the unit behind its value.

    A line that begins with several cells without labels has none.
    """
    rows = list[tuple[tuple[str, ...], list[str]]]()
    for line in filter(str.strip, text.splitlines()):
        pairs = list(_LABELLED.finditer(line))
        front = line[: pairs[0].start()] if pairs else ""
        if len(re.findall("[,;\t]", front)) > 1:
            front, pairs = "", []
        stamp = _DATED.search(front)
        names = [f"{pair[1]} [{pair[3]}]" if pair[3] else pair[1] for pair in pairs]
        cells = [pair[2] or f'"{pair[4]}"' for pair in pairs]
        rows.append((("", *names), [stamp[0], *cells]) if stamp else (tuple(names), cells))
    return rows


def _turned(text: bytes) -> pa.Table | None:
    """The table in a text whose lines are signals, each with or without its name in front; None of any other.

    So it is where a line, and only one, rises from cell to cell as a clock does, or where lines are smooth and columns
    of them are not.
    """
    if len([*islice(re.finditer(b"\n", text), _MOST_SIGNALS + 1)]) > _MOST_SIGNALS:
        return None
    lines = [line.strip() for line in text.removeprefix(codecs.BOM_UTF8).split(b"\n")]
    lines = [line for line in lines if line and not _COMMENT.match(line[:4].decode("latin-1"))]
    if len(lines) < 2:
        return None
    separator = _separator(lines[0].decode())
    delimiter = None if separator == " " else separator.encode()
    least = _LONG * len(lines)
    if min(len(line) for line in lines) < least or len({len(line.split(delimiter)) for line in lines}) > 1:
        return None
    begins = [_cells(line[:_LONG_LINE].decode(), separator)[0] for line in lines]
    named = not any(map(_NUMBER.fullmatch, begins))
    columns = list[pa.ChunkedArray]()
    for line in lines:
        below = b"\n".join(line.split(delimiter))
        table = pacsv.read_csv(
            pa.BufferReader(below),
            pacsv.ReadOptions(use_threads=False, column_names=["one"], skip_rows=int(named), block_size=len(below)),
            pacsv.ParseOptions(delimiter=separator, ignore_empty_lines=False),
            pacsv.ConvertOptions(null_values=BLANK, decimal_point=_point(text[:_HEAD], separator)),
        )
        columns.append(table.column(0))
    if not all(pa.types.is_floating(column.type) or pa.types.is_integer(column.type) for column in columns):
        return None
    filled = [column.cast(pa.float64()).fill_null(np.nan).combine_chunks() for column in columns]
    value = np.array(list(map(np.from_dlpack, filled)), dtype=np.float64)
    steps = np.diff(value)
    clocks = (np.mean(steps > 0.0, axis=1) >= _RISES) & ~(steps < 0.0).any(axis=1)
    is_smooth = _roughness(value) < _SMOOTH and _roughness(value.T) > _ROUGH
    if value.shape[1] < least or not (clocks.sum() == 1 or is_smooth):
        return None
    return pa.table(columns, begins if named else list(map(_column, range(len(lines)))))


def _roughness(value: FloatArray) -> float:
    """Of the rows of an array, half the mean square of steps in it over the variance: 1 of numbers without order."""
    with np.errstate(invalid="ignore", divide="ignore"):
        each = np.nanmean(np.diff(value) ** 2, axis=1) / (2.0 * np.nanvar(value, axis=1))
    return float(np.nanmedian(each)) if np.isfinite(each).any() else math.inf


def _transforms_apart(text: bytes) -> bytes:
    """The text of ``rostopic echo -p /tf`` with a line for each transform."""
    header, *lines = text.splitlines()
    width = header.count(_TRANSFORMS.removeprefix(b"%time"))
    apart = [b",".join(header.split(b",")[: 1 + width])]
    for time, *cells in (line.split(b",") for line in lines):
        apart += [b",".join([time, *cells[first : first + width]]) for first in range(0, len(cells), width)]
    return b"\n".join([*apart, b""])


def _short_header(
    path: Path, names: list[str], layout: _Layout, rows: Sequence[pacsv.InvalidRow]
) -> tuple[_Layout, str] | None:
    """The layout of a text whose header lacks one name, and a note; None of any other.

    R leaves out that of its row names, in quotes in front. Rows that count without quotes may be either.
    """
    if {row.actual_columns for row in rows} != {len(names) + 1}:
        return None
    what = f"{path.name}: the header has {plural(len(names), 'name')}, each of {len(rows)} rows {len(names) + 1} cells"
    first = [_split(row.text, layout.separator)[0].strip() for row in rows[:_BESIDE]]
    in_front = all(label.startswith('"') for label in first)
    if not in_front and first in ([str(begin + n) for n in range(len(first))] for begin in (0, 1)):
        raise RunError(f"{what}: is the name of the first or of the last column missing? Add it to the header")
    index = 0 if in_front else len(names)
    whole = [*names[:index], _column(index), *names[index:]]
    skipped = layout.skipped + (layout.names is None)
    return layout._replace(names=whole, skipped=skipped), f"{what}: the {'first' if in_front else 'last'} has no name"


class _Layout(NamedTuple):
    """How a CSV text is laid out.

    ``names`` are given where the header is a comment (``# t x y``) or several lines (Position above X, Y, Z), or there
    is none, or they are many.
    """

    separator: str  # between cells; a blank stands for any number of them
    point: str  # of decimals: 1,5;2 as well as 1.5,2
    skipped: int  # lines above the header; with it where names are given
    names: list[str] | None
    units: str | None = None  # of a line below the header, with tabs between them; None: there is no such line
    above: int = 0  # how many of the lines above are no comments and not blank
    broken: bool = False  # whether cells in quotes go on in the next line


def _layout(text: bytes) -> _Layout:
    head = text[: max(_HEAD, text.find(b"\n") + 1)].removeprefix(codecs.BOM_UTF8).decode("utf-8", errors="replace")
    *lines, last = re.split("\r\n|\r|\n", head)
    lines, broken = _whole_lines([*lines, last] if not lines or (last and len(text) <= _HEAD) else lines)
    full = [n for n, line in enumerate(lines) if line.strip() and not _COMMENT.match(line)] or [0]
    first = full[0]
    comment = _COMMENT.sub("", lines[first - 1], 1) if first > 0 else ""
    separator = _separator(comment)
    names = _cells(comment, separator)
    rows_below = lines[first - 1].startswith(_ECHO) or _begins(lines, first, separator)
    if first > 0 and len(names) == len(_cells(lines[first], separator)) and rows_below:
        return _Layout(separator, _point(text, separator), first, names, broken=broken)
    if (between := _properties(lines, full)) is not None:
        named, rows = between
        separator, above = _separator(lines[rows]), sum(n < rows for n in full) - 1
        return _Layout(separator, _point(text, separator), rows, _cells(lines[named], separator), above=above)
    separator = _separator(lines[first])
    header = -1 if _is_headless(lines, first, separator) else _header(lines, full)
    rows = next((n for n in full if n > header), header)
    of_rows = _separator(lines[rows])
    width = len(_cells(lines[rows], of_rows))
    # What stands above rows of numbers and has another number of cells is no header of theirs, but for a first line of
    # words, which may lack a name. A row with more cells, as EPICS writes alarms, is none.
    cells = _cells(lines[header], of_rows)
    is_other = (first < header or not _is_text(cells)) and _begins(lines, rows, of_rows) and len(cells) != width
    if header < 0 or is_other:
        above = [n for n in full if n < rows][-1:]
        wide = re.split(r"\s{2,}|\t", lines[above[0]].strip()) if above and of_rows == " " else []
        is_header = len(wide) == width and _is_text(wide)  # names of several words, each above its column
        names, top = (wide, above[0]) if is_header else (list(map(_column, range(width))), rows)
        separator, skipped, units = of_rows, rows, None
    else:
        separator = _separator(lines[header])
        cells = _cells(lines[header], separator)
        told = [_UNIT.fullmatch(cell) for cell in cells] if header > first else [None]
        units = "\t".join(match[1] for match in told if match) if all(told) else None
        top, names = _told_apart(lines, header - (units is not None), separator)
        names = cells if names is None and len(cells) > _WIDE else names
        skipped = header - (units is not None) + (names is not None)
    return _Layout(separator, _point(text, separator), skipped, names, units, sum(n < top for n in full), broken)


def _properties(lines: Sequence[str], full: Sequence[int]) -> tuple[int, int] | None:
    """The line of names and that of the first row, where between them columns have properties, as TwinCAT writes them.

    None where no line begins with ``Name``, or the first row is right below it.
    """
    named = next((n for n in reversed(full) if re.match(r'"?Name"?[;,\t]', lines[n])), len(lines))
    rows = next((n for n in full if n > named and re.match(r'"?[+-]?[\d.]+"?[;,\t]', lines[n])), 0)
    cells = [len(_cells(lines[n], _separator(lines[rows]))) for n in (named, rows) if n < len(lines)]
    return (named, rows) if rows > named + 1 and len({*cells}) == 1 else None


def _whole_lines(lines: Sequence[str]) -> tuple[list[str], bool]:
    """Lines of a text, joined where a cell in quotes goes on in the next one; and whether any were."""
    lines_whole, is_open = list[list[str]](), False
    for line in lines:
        odd = line.count('"') % 2 == 1
        if is_open:
            lines_whole[-1].append(line)
            is_open = not odd
        else:
            lines_whole.append([line])
            is_open = odd and _OPEN.search(line) is not None
    return ["\n".join(parts) for parts in lines_whole], len(lines_whole) < len(lines)


def _header(lines: Sequence[str], full: Sequence[int]) -> int:
    """Where the header is: the first full line, if rows of as many cells, as most lines have, begin below it.

    Else it is what stands right above rows of numbers: recorders write their settings on top (``Format Version,1.23``);
    but for what a program has written in between (``INFO started``).
    """
    header, separator = full[0], _separator(lines[full[0]])
    if '"' in lines[header]:  # a name may go on in the next line
        return header
    first, *below = (_cells(lines[n], separator) for n in full[: 1 + _BESIDE])
    begins = (n for n in full[1:] if _begins(lines, n, separator) or _begins(lines, n, _separator(lines[n - 1])))
    begin = next(begins, header + 1)
    between = [_cells(lines[n], separator) for n in full[1:] if n < begin]
    most = Counter(len(_split(lines[n], separator)) for n in full).most_common(1)[0][0]
    even = all(len(row) == len(first) == most > 1 for row in below)
    if even and not (between and all(map(_is_text, between))):
        return header
    count = len(_cells(lines[begin], separator)) if begin < len(lines) else 0
    right_above = _cells(lines[begin - 1], separator)
    return header if len(right_above) != count == len(first) > 1 and _is_text(first) else begin - 1


def _told_apart(lines: Sequence[str], header: int, separator: str) -> tuple[int, list[str] | None]:
    """The first line that names come from, and the names; None where they are just the header's.

    Those that are the same have the ones above before them: X, Y, Z of a Rotation and of a Position.
    """
    top, names = header, _cells(lines[header], separator)
    while top > 0 and len(set(names)) < len(names):
        above = _cells(lines[top - 1], separator)
        if len(above) != len(names):
            break
        top, names = top - 1, [f"{word} {other}".strip() for word, other in zip(above, names, strict=True)]
    return top, names if top < header else None


def _begins(lines: Sequence[str], number: int, separator: str) -> bool:
    """Whether rows of numbers begin at a line, the same number of them in each of the next few."""
    rows = [_cells(line, separator) for line in lines[number : number + _BESIDE]]
    return len(rows) > 1 and all(
        len(row) == len(rows[0]) > 1 and 2 * sum(_NUMBER.fullmatch(cell) is not None for cell in row) > len(row)
        for row in rows
    )


def _is_headless(lines: Sequence[str], first: int, separator: str) -> bool:
    """Whether rows begin with the first line: it has a number wherever the next one has, and does not count columns.

    That does the header of pandas for an array: 0,1,2.
    """
    if not _begins(lines, first, separator):
        return False
    row, below = (_cells(lines[first + n], separator) for n in (0, 1))
    of_numbers = [cell for cell, other in zip(row, below, strict=True) if _NUMBER.fullmatch(other)]
    return all(map(_NUMBER.fullmatch, of_numbers)) and row != list(map(str, range(len(row))))


def _column(index: int) -> str:
    return _FIRST.replace("1", str(index + 1))


def _is_text(row: Sequence[str]) -> bool:
    """Whether a row is no row of data: it has words, and no cell that begins like a number or a date."""
    return any(cell not in BLANK for cell in row) and not any(re.match(r"[+-]?[.,]?\d", cell) for cell in row)


def _point(text: bytes, separator: str) -> str:
    """What stands before decimals."""
    around = separator.encode()
    return "," if separator != "," and re.search(_DECIMAL_COMMA % (around, around), text) else "."


def _separator(line: str) -> str:
    """What separates the cells of a line: of equals the first; a blank only where there is nothing else."""
    line = re.sub('"[^"]*"', "", line)
    separator = max(",", ";", "\t", key=line.count)
    return " " if separator not in line and " " in line.strip() else separator


def _cells(line: str, separator: str) -> list[str]:
    return [cell.strip().strip('"').strip().replace("\0", separator) for cell in _split(line, separator)]


def _split(line: str, separator: str) -> list[str]:
    """The cells of a line as written, a separator that is in quotes being a zero."""
    if separator == " ":
        return line.split()
    return re.sub('"[^"]*"', lambda quoted: quoted[0].replace(separator, "\0"), line).split(separator)


def _parquet(path: Path, fields: Sequence[str] | None, where: Where) -> tuple[pa.Table, list[str]]:
    """The columns asked for and the rows, some at a time; and the names of all that the file has."""
    with _opened(path) as file:
        wanted, empty = _wanted(path, file, fields, where)
        asked = conditions(path, _named(empty), where)
        every = range(file.num_row_groups)
        groups = [index for index in every if _may_hold(file.metadata.row_group(index), asked)]
        kept = [part.filter(met(path, _named(part), asked)) if where else part for part in _parts(file, wanted, groups)]
        if where and not any(part.num_rows for part in kept):
            raise no_row(path, map(_named, _parts(file, prefixes(list(where)), None)), where)
        names = [file.schema.column(index).path for index in range(len(file.schema))]
        return pa.concat_tables(kept) if kept else empty, names


def _opened(path: Path) -> papq.ParquetFile:
    """A Parquet file, to be read without threads.

    One that outlives the interpreter aborts it (apache/arrow issue 34314). So pyarrow's data sets, which filter by
    themselves, are no way.
    """
    return papq.ParquetFile(str(path), pre_buffer=False, buffer_size=_READ_AHEAD)


def _wanted(
    path: Path, file: papq.ParquetFile, fields: Sequence[str] | None, where: Where
) -> tuple[list[str] | None, pa.Table]:
    """Which columns have to be read, None: all; and the table of these without rows."""
    schema = file.schema_arrow
    wanted = None if fields is None else _asked(path, schema.names, fields=fields, where=where)
    if wanted is not None:
        names = set(schema.names)
        used = {longest(names, path) for path in wanted}
        schema = pa.schema([field for field in schema if field.name in used])
    empty = _filterable(schema.empty_table())
    columns = _named(empty)
    for field in fields or ():
        find(columns, field, str(path))
    return wanted, empty


def _parts(file: papq.ParquetFile, columns: list[str] | None, groups: list[int] | None) -> Iterator[pa.Table]:
    for batch in file.iter_batches(_BATCH, row_groups=groups, columns=columns, use_threads=False):
        yield _filterable(pa.Table.from_batches([batch]))


def _filterable(table: pa.Table) -> pa.Table:
    """A table with plain text for text in views, as polars writes it: pyarrow cannot filter these."""
    kinds = [field.with_type(pa.string()) if pa.types.is_string_view(field.type) else field for field in table.schema]
    return table.cast(pa.schema(kinds))


def _only(path: Path, whole: pa.Table, where: Where) -> pa.Table:
    if not where:
        return whole
    columns = _named(whole)
    chosen = whole.filter(met(path, columns, conditions(path, columns, where)))
    if not chosen.num_rows:
        raise no_row(path, [columns], where)
    return chosen


def _may_hold(group: Any, asked: Mapping[str, pa.Scalar]) -> bool:
    """Whether a part of Parquet may have rows that meet all conditions, by the least and the greatest of its values."""
    for column in map(group.column, range(group.num_columns if asked else 0)):
        name = column.path_in_schema
        told = column.statistics if column.is_stats_set and name in asked else None
        if told is not None and told.has_min_max and not told.min <= asked[name].as_py() <= told.max:
            return False
    return True


def _named(table: pa.Table) -> dict[str, pa.ChunkedArray]:
    repeated = _repeated(table.column_names)
    return {name: table.column(name) for name in table.column_names if name not in repeated}


def _repeated(names: Sequence[str]) -> set[str]:
    return {name for name, count in Counter(names).items() if count > 1}
