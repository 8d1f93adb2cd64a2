"""Entities of Rerun recordings (``.rrd``) as tables.

A row is what was logged of an entity at once, a column one of its timelines or of its components. A component is called
by the last part of its name (``scalars`` for ``Scalars:scalars``), by all of it where two would be called the same. It
is a list of instances, ``scalars[1]``; where there never was more than one, that one.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa
import pyarrow.compute as pc

from ..errors import RunError, unknown_part
from ..units import TIMES
from .columns import LOG_TIME, Table, Topic, joined, numeric_paths, wanted

if TYPE_CHECKING:
    from rerun.chunk import RrdReader, StoreEntry

_LARGE_CELL = 4096  # bytes: images and the like hold no positions
_ROW = "rerun.controls.RowId"  # in the order of logging


@dataclass(frozen=True)
class Recording:
    """The Rerun recording that a run was read from.

    Attributes:
        application: Its application id.
        id: Its recording id.
        timeline: The timeline of the run's stamps; empty: they are on none.
        kind: What it holds: ``timestamp[ns]``, ``duration[ns]``, or whole numbers (``int64``).
        unit: What one of these is [ns].
    """

    application: str
    id: str
    timeline: str
    kind: str
    unit: int


def read(path: Path, entity: str, fields: Sequence[str] | None) -> Table:
    """An entity, its rows in the order in which they were logged.

    Raises:
        RunError: It is no such recording, or has no such entity or nothing on it.
    """
    place, notes, known = _place(entity), list[str](), dict[str, set[str]]()

    def parts() -> Iterator[pa.Table]:
        for name, batch in _chunks(path, notes):
            components = _components(batch)
            known.setdefault(name, set()).update(components)
            if name == place:
                unwanted = [one for one in components if not (wanted(one, fields) or wanted(_last(one), fields))]
                yield pa.table(batch).drop_columns(unwanted)

    table = joined(parts(), f"entity '{place}'")
    if table is None:
        listed = {one: ", ".join(sorted(components)) for one, components in sorted(known.items())}
        raise unknown_part(path, "entity", entity and place, listed, notes)
    table = table.take(pc.sort_indices(table[_ROW])).drop_columns(_ROW)
    timelines = [name for name in table.column_names if name not in known[place]]
    names = _names(known[place], timelines)
    there = [
        pc.greater(pc.fill_null(pc.list_value_length(table[name]), 0), 0)
        for name in names
        if name in table.column_names
    ]
    table = table.filter(reduce(pc.or_, there)) if there else table
    columns = {name: table[name] for name in table.column_names if name not in names}
    columns |= {short: _single(table[name]) for name, short in names.items() if name in table.column_names}
    return Table(path, columns, table.num_rows, tuple(notes), (*timelines, *names.values()))


def topics(path: Path) -> tuple[Topic, ...]:
    """The entities of a recording.

    Raises:
        RunError: It is no such recording.
    """
    components, fields = dict[str, set[str]](), dict[str, dict[str, None]]()
    rows, ends = Counter[str](), dict[str, list[int]]()
    for name, batch in _chunks(path, []):
        components.setdefault(name, set()).update(_components(batch))
        rows[name] += batch.num_rows
        if LOG_TIME in batch.schema.names and pa.types.is_timestamp(batch.schema.field(LOG_TIME).type):
            ends.setdefault(name, []).extend(pc.min_max(batch[LOG_TIME].cast(pa.int64())).as_py().values())
        fields.setdefault(name, {}).update(dict.fromkeys(_numbers_of(batch)))
    return tuple(
        Topic(
            name,
            ", ".join(sorted(found)),
            rows[name],
            min(ends.get(name, ()), default=None),
            max(ends.get(name, ()), default=None),
            tuple(fields[name]),
        )
        for name, found in sorted(components.items())
    )


def recording_of(path: Path, entity: str, time: str, unit: str) -> Recording:
    """What a result needs to open on top of the Rerun recording that it was made from.

    Args:
        path: The file.
        entity: The entity whose stamps are those of the run.
        time: What they are called.
        unit: The ending of their unit, if they are numbers.

    Raises:
        RunError: It is no recording.
    """
    _, found = _opened(path, [])
    batch = next(batch for name, batch in _chunks(path, []) if name == _place(entity))
    is_timeline = time in batch.schema.names and time not in _components(batch)
    kind = batch.schema.field(time).type if is_timeline else pa.null()
    count = 10 ** (9 - 3 * TIMES.index(unit)) if pa.types.is_integer(kind) else 1
    return Recording(found.application_id, found.recording_id, time if is_timeline else "", str(kind), count)


def _place(entity: str) -> str:
    return f"/{entity.strip('/')}"


def _components(batch: pa.RecordBatch) -> list[str]:
    """The columns of a batch that are components; the others are timelines and the row's id."""
    return [one.name for one in batch.schema if (one.metadata or {}).get(b"rerun:kind") == b"data"]


def _last(component: str) -> str:
    return component.rpartition(":")[2]


def _names(components: Iterable[str], timelines: Sequence[str]) -> dict[str, str]:
    """What the components of an entity are called: the last part of their names, where that is nothing else's."""
    called = Counter([*map(_last, components), *timelines])
    return {one: _last(one) if called[_last(one)] == 1 else one for one in sorted(components)}


def _single(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """A column of lists of instances, or of instances where there never is more than one."""
    lists = column.combine_chunks()
    length = pc.fill_null(pc.list_value_length(lists), 0)
    if (pc.max(length).as_py() or 0) > 1:
        return column
    place = pc.if_else(
        pc.equal(length, 1), pc.subtract(pc.cumulative_sum(length), length), pa.scalar(None, length.type)
    )
    return pa.chunked_array([lists.flatten().take(place)])


def _numbers_of(batch: pa.RecordBatch) -> Iterator[str]:
    """Timelines, and field paths of numbers in the components of the first row that has any."""
    components = _components(batch)
    timelines = [name for name in batch.schema.names if name not in (*components, _ROW)]
    yield from timelines
    for component, name in _names(components, timelines).items():
        some = batch[component].drop_null()[:1]
        if len(some) and some.nbytes < _LARGE_CELL:
            instances = some[0].as_py()
            yield from numeric_paths(instances[0] if len(instances) == 1 else instances, name)


def _opened(path: Path, notes: list[str]) -> tuple[RrdReader, StoreEntry]:
    """The reader of a file and its recording."""
    from rerun.chunk import RrdReader

    path.stat()  # of a file that is not there, that is what is to be said
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            reader = RrdReader(path)
            found = reader.recordings()
        except RuntimeError as error:
            if "exceeds file size" not in str(error):
                raise
            raise RunError(
                f"{path}: the recording was cut off; this saves what is there: rerun rrd merge {path} -o saved.rrd"
            ) from None
    if caught:
        notes.append(f"{path.name}: the recording has no end (cut off, or of an old Rerun): read as far as it goes")
    if len(found) != 1:
        raise RunError(f"{path}: the file has {len(found)} recordings; a file with one is needed")
    return reader, found[0]


def _chunks(path: Path, notes: list[str]) -> Iterator[tuple[str, pa.RecordBatch]]:
    """What was logged in time, in pieces: the entity, and rows with columns of timelines and components."""
    reader, recording = _opened(path, notes)
    for chunk in reader.stream(store=recording):
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            names = batch.schema.names  # a component may be called what a timeline is: it cannot be had
            yield chunk.entity_path, batch.select([names.index(name) for name in dict.fromkeys(names)])
