"""Entities of Rerun recordings (``.rrd``) as tables.

A row is what was logged of an entity at once, a column one of its timelines or of its components. A component is called
by the last part of its name (``scalars`` for ``Scalars:scalars``), by all of it where two would be called the same. It
is a list of instances, ``scalars[1]``; where there never was more than one, that one.

Some damaged files make Rerun's reader abort its process. So it has one of its own: ``python -m pumafuse.logs.entities
FILE ENTITY`` writes one stream of Arrow's IPC format after the other. The metadata of their schemas say what they are:
the ids of the recording, then chunks of entities, and at the end what is wrong. If that is missing, it was aborted.
"""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, reduce
from pathlib import Path
from typing import IO, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc

from ..errors import RunError, one_line, unknown_part
from ..units import TIMES
from .columns import LOG_TIME, Table, Topic, holders, joined, numeric_paths

_LARGE_CELL = 4096  # bytes: images and the like hold no positions
_ROW = "rerun.controls.RowId"  # in the order of logging
_READER = "pumafuse.logs.entities"
_SMALL = 16 << 20  # bytes of a file that is read once for all its entities, as a process takes half a second
_NO_ROWS = pa.record_batch({})


@dataclass(frozen=True)
class Recording:
    """The Rerun recording that a run was read from."""

    application: str
    id: str
    timeline: str  # the timeline of the run's stamps; empty: they are on none
    kind: str  # what it holds: 'timestamp[ns]', 'duration[ns]', or whole numbers ('int64')
    unit: int  # what one of these is [ns]


def read(path: Path, entity: str, fields: Sequence[str] | None) -> Table:
    """An entity, its rows in the order in which they were logged."""
    place_of_entity, components_seen = _path(entity), dict[str, set[str]]()
    with _opened(path, place_of_entity) as opened:
        table = joined(_parts(opened.chunks, place_of_entity, fields, components_seen), f"entity '{place_of_entity}'")
    if table is None:
        listed = {name: ", ".join(sorted(components)) for name, components in sorted(components_seen.items())}
        raise unknown_part(path, "entity", entity and place_of_entity, listed, opened.notes)
    table = table.take(pc.sort_indices(table[_ROW])).drop_columns(_ROW)
    timelines = [name for name in table.column_names if name not in components_seen[place_of_entity]]
    names = _names(components_seen[place_of_entity], timelines)
    told = {name: short for name, short in names.items() if name in table.column_names}
    is_filled = [pc.greater(pc.fill_null(pc.list_value_length(table[name]), 0), 0) for name in told]
    table = table.filter(reduce(pc.or_, is_filled)) if is_filled else table
    columns = {name: table[name] for name in timelines}
    columns |= {short: _single(table[name]) for name, short in told.items()}
    return Table(path, columns, table.num_rows, opened.notes, (*timelines, *names.values()))


def topics(path: Path) -> tuple[Topic, ...]:
    """The entities of a recording."""
    components, fields = dict[str, set[str]](), dict[str, dict[str, None]]()
    rows, ends = Counter[str](), dict[str, list[int]]()
    with _opened(path) as opened:
        for name, chunk in opened.chunks:
            components.setdefault(name, set()).update(_components(chunk))
            rows[name] += chunk.num_rows
            fields.setdefault(name, {}).update(dict.fromkeys(_numbers_of(chunk)))
            recorded = ends.setdefault(name, [])
            if LOG_TIME in chunk.column_names and pa.types.is_timestamp(chunk[LOG_TIME].type):
                recorded += pc.min_max(chunk[LOG_TIME].cast(pa.int64())).as_py().values()
    span = {name: (min(some, default=None), max(some, default=None)) for name, some in ends.items()}
    return tuple(
        Topic(name, ", ".join(sorted(components_of)), rows[name], *span[name], tuple(fields[name]))
        for name, components_of in sorted(components.items())
    )


def recording_of(path: Path, entity: str, time: str, unit: str) -> Recording:
    """What a result needs to open on top of the Rerun recording that it was made from, by the entity of its stamps."""
    entity_place = _path(entity)
    with _opened(path, entity_place) as opened:
        chunk = next(chunk for name, chunk in opened.chunks if name == entity_place)
    is_timeline = time in chunk.column_names and time not in _components(chunk)
    kind = chunk[time].type if is_timeline else pa.null()
    count = 10 ** (9 - 3 * TIMES.index(unit)) if pa.types.is_integer(kind) else 1
    return Recording(opened.application, opened.id, time if is_timeline else "", str(kind), count)


def _parts(
    chunks: Iterable[tuple[str, pa.Table]],
    entity_place: str,
    fields: Sequence[str] | None,
    components_seen: dict[str, set[str]],
) -> Iterator[pa.Table]:
    """The chunks of an entity, with the fields asked for; components of all entities go into ``components_seen``."""
    asked = None if fields is None else holders(fields)
    for name, chunk in chunks:
        components = _components(chunk)
        components_seen.setdefault(name, set()).update(components)
        if name == entity_place:
            unwanted = [
                component
                for component in components
                if asked is not None and asked.isdisjoint((component, _last(component)))
            ]
            kept = chunk.drop_columns(unwanted)
            yield kept.take(pc.sort_indices(kept[_ROW]))  # a copy: what was dropped leaves the memory


def _path(entity: str) -> str:
    return f"/{entity.strip('/')}"


def _components(chunk: pa.Table) -> list[str]:
    """The columns of a chunk that are components; the others are timelines and the row's id."""
    return [field.name for field in chunk.schema if (field.metadata or {}).get(b"rerun:kind") == b"data"]


def _last(component: str) -> str:
    return component.rpartition(":")[2]


def _names(components: Iterable[str], timelines: Sequence[str]) -> dict[str, str]:
    """What the components of an entity are called: the last part of their names, where that is nothing else's."""
    called = Counter([*map(_last, components), *timelines])
    return {
        component: _last(component) if called[_last(component)] == 1 else component for component in sorted(components)
    }


def _single(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """A column of lists of instances, or of instances where there never is more than one."""
    lists = column.combine_chunks()
    length = pc.fill_null(pc.list_value_length(lists), 0)
    if (pc.max(length).as_py() or 0) > 1:
        return column
    index = pc.if_else(
        pc.equal(length, 1), pc.subtract(pc.cumulative_sum(length), length), pa.scalar(None, length.type)
    )
    return pa.chunked_array([lists.flatten().take(index)])


def _numbers_of(chunk: pa.Table) -> Iterator[str]:
    """Timelines, and field paths of numbers in the components of the first row that has any."""
    components = _components(chunk)
    timelines = [name for name in chunk.column_names if name not in (*components, _ROW)]
    yield from timelines
    for component, name in _names(components, timelines).items():
        some = chunk[component].drop_null()[:1]
        if len(some) and some.nbytes < _LARGE_CELL:
            instances = some[0].as_py()
            yield from numeric_paths(instances[0] if len(instances) == 1 else instances, name)


# The process that reads, from outside.


class _Opened(NamedTuple):
    """A recording: its ids, what is wrong with it in a sentence each, and its chunks as they come, by entity."""

    application: str
    id: str
    notes: tuple[str, ...]
    chunks: Iterable[tuple[str, pa.Table]]


@contextmanager
def _opened(path: Path, entity: str = "") -> Generator[_Opened]:
    """A recording, from memory where it is small; of others than an ``entity`` columns may come without rows."""
    with one_line(path, "rerun-sdk"):
        stat = path.stat()
    if stat.st_size > _SMALL:
        with _read(path, entity) as opened:
            yield opened
    else:
        yield _kept(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=1)
def _kept(path: Path, *_: int) -> _Opened:
    """All of a recording, until another one or a later version of it is read."""
    with _read(path, "") as opened:
        return opened._replace(chunks=list(opened.chunks))


@contextmanager
def _read(path: Path, entity: str) -> Generator[_Opened]:
    """A recording, read by a process that ends with the context; see :func:`_recorded`."""
    command = [sys.executable, "-P", "-m", _READER, str(path), entity]
    nothing, pipe = subprocess.DEVNULL, subprocess.PIPE
    try:  # in a session of its own: Ctrl-C is for this process, which then ends the other
        started = subprocess.Popen(command, stdin=nothing, stdout=pipe, stderr=nothing, start_new_session=True)
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {sys.executable} does not start: {error.strerror}") from None
    with started as reader:
        assert reader.stdout is not None
        try:
            if not reader.stdout.read(1):
                why = f"to see why, run: {' '.join(command[:4])}"
                raise RunError(f"{path}: cannot be read: its reader does not start; {why}")
            messages = _messages(path, reader.stdout)
            about, _ = next(messages)
            notes = (about["note"],) if about["note"] else ()
            yield _Opened(
                about["application"], about["id"], notes, ((message["entity"], rows) for message, rows in messages)
            )
        finally:
            reader.kill()


def _messages(path: Path, pipe: IO[bytes]) -> Iterator[tuple[dict[str, str], pa.Table]]:
    while True:
        try:
            with pa.ipc.open_stream(pipe) as stream:
                about, rows = stream.schema.metadata, stream.read_all()
        except (pa.ArrowInvalid, OSError):
            raise RunError(f"{path}: damaged: Rerun's reader fails on it; take another copy, or record anew") from None
        said = {key.decode(): value.decode(errors="surrogateescape") for key, value in about.items()}
        if said.get("end"):
            raise RunError(said["end"])
        if "end" in said:
            return
        yield said, rows


# The process that reads, from inside.


def _main(path: Path, entity: str) -> None:
    sys.stdout.buffer.write(b"\n")  # it has started: if it is aborted from now on, that is the recording's fault
    sys.stdout.buffer.flush()
    fault = ""
    try:
        with one_line(path, "--upgrade rerun-sdk"):
            for about, rows in _recorded(path, entity):
                _send(about, rows)
    except RunError as error:
        fault = str(error)
    _send({"end": fault}, _NO_ROWS)


def _recorded(path: Path, entity: str) -> Iterator[tuple[dict[str, str], pa.RecordBatch]]:
    """The ids of a recording, then what was logged in time, chunk by chunk: metadata and rows.

    Of others than an ``entity`` come the columns without rows; of an empty one all rows come.
    """
    from rerun.chunk import RrdReader

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            reader = RrdReader(path)
            stores = reader.recordings()
        except RuntimeError as error:
            if "exceeds file size" not in str(error):
                raise
            raise RunError(
                f"{path}: the recording was cut off; this saves what is there: rerun rrd merge {path} -o saved.rrd"
            ) from None
    if len(stores) != 1:
        raise RunError(f"{path}: the file has {len(stores)} recordings; a file with one is needed")
    note = f"{path.name}: the recording has no end (cut off, or of an old Rerun): read as far as it goes"
    ids = {"application": stores[0].application_id, "id": stores[0].recording_id}
    yield {**ids, "note": note if caught else ""}, _NO_ROWS
    for chunk in reader.stream(store=stores[0]):
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            names = batch.schema.names  # a component may be called what a timeline is: it cannot be had
            rows = batch.select([names.index(name) for name in dict.fromkeys(names)])
            yield {"entity": chunk.entity_path}, rows if entity in ("", chunk.entity_path) else rows[:0]


def _send(about: Mapping[str, str], rows: pa.RecordBatch) -> None:
    rows = rows.replace_schema_metadata({key: text.encode(errors="surrogateescape") for key, text in about.items()})
    with pa.ipc.new_stream(sys.stdout.buffer, rows.schema) as stream:
        stream.write_batch(rows)
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    _main(Path(sys.argv[1]), sys.argv[2])
