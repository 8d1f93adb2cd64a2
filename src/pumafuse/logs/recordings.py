"""Recordings as tables: a topic of MCAP or of a bag of ROS, an entity of a Rerun recording.

Of MCAP and bags, a row is a message, a column one of its fields, nested as in the message. ``log_time`` is when it was
recorded.

Of a Rerun recording (``.rrd``), a row is what was logged of an entity at once, a column one of its timelines or of its
components. A component is called by the last part of its name (``scalars`` for ``Scalars:scalars``), by all of it where
two would be called the same. It is a list of instances, ``scalars[1]``; where there never was more than one, that one.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, reduce
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from ..errors import RunError, suggestion
from ..units import TIMES
from . import bags
from .bags import Channel, Faults, Message, Record, reason
from .columns import Table

if TYPE_CHECKING:
    from rerun.chunk import RrdReader, StoreEntry

LOG_TIME = "log_time"
_BATCH_ROWS, _BATCH_BYTES = 4096, 16 << 20  # of messages that are in memory as Python objects
_MOST_BYTES = 1 << 30  # of a table
_LONGEST_LIST = 64  # elements of a list that are listed one by one
_LARGE_CELL = 4096  # bytes: images and the like hold no positions
_ROW = "rerun.controls.RowId"  # in the order of logging


@dataclass(frozen=True)
class Topic:
    """What a recording has of one topic, or of one entity.

    Attributes:
        name: The topic, or the entity.
        type: Of its messages, such as ``sensor_msgs/msg/JointState``, or the names of its components.
        count: Number of messages, or of rows.
        first: When the first was recorded, int ns; None: not known.
        last: When the last was.
        fields: Field paths of the numbers in its first message; of an entity, also its timelines.
    """

    name: str
    type: str
    count: int
    first: int | None
    last: int | None
    fields: tuple[str, ...]


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


def read(path: Path, name: str, fields: Sequence[str] | None = None) -> Table:
    """A topic or an entity, its rows in the order in which they were recorded.

    Args:
        path: A file, or the folder of a ROS 2 bag.
        name: The topic, or the entity of a Rerun recording.
        fields: Columns, whole or to a field, that are wanted. None: all.

    Raises:
        RunError: It is no such recording, has no such topic or nothing on it, or is too damaged.
    """
    with _one_line(path):
        return (_read_entity if path.suffix == ".rrd" else _read_topic)(path, name, fields)


def topics(path: Path) -> tuple[Topic, ...]:
    """What a recording has, by topic or entity.

    Args:
        path: A file, or the folder of a ROS 2 bag.

    Raises:
        RunError: It is no such recording, or too damaged.
    """
    with _one_line(path):
        return (_entities if path.suffix == ".rrd" else _topics)(path)


def numeric_paths(value: Any, path: str = "", names: Any = None) -> Iterator[str]:
    """Field paths of the numbers in a message; elements of lists by ``names``, if there are as many, else by index."""
    if isinstance(value, Mapping):
        message = cast(Message, value)
        for key, part in message.items():
            yield from numeric_paths(part, f"{path}.{key}" if path else key, message.get("name"))
    elif isinstance(value, list | np.ndarray) and len(elements := cast(Sequence[Any], value)) <= _LONGEST_LIST:
        labels = cast(list[Any], names) if isinstance(names, list) else []
        for label, part in zip(labels if len(labels) == len(elements) else count(), elements, strict=False):
            yield from numeric_paths(part, f"{path}[{label}]")
    elif isinstance(value, int | float | np.number) and not isinstance(value, bool):
        yield path


@contextmanager
def _one_line(path: Path) -> Generator[None]:
    """Turn what libraries raise while they read a file into an error of one line."""
    try:
        yield
    except RunError:
        raise
    except ModuleNotFoundError:
        raise RunError(f"{path}: this format needs more libraries: pip install 'pumafuse[bags]'") from None
    except FileNotFoundError:
        raise RunError(f"{path}: no such file") from None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or reason(error)}") from None
    except MemoryError:
        raise RunError(f"{path}: cannot be read: not enough memory") from None
    except Exception as error:
        raise RunError(f"{path}: cannot be read: {reason(error)}") from None


def _unknown(path: Path, key: str, name: str, known: Mapping[str, str], notes: Sequence[str]) -> RunError:
    """What to say where a recording has nothing of a name: what it has, with the types."""
    why = "".join(f"; {note.removeprefix(f'{path.name}: ')}" for note in notes)
    if not known:
        return RunError(f"{path}: the recording is empty{why}")
    if name in known:
        return RunError(f"{path}: {key} '{name}' has nothing that can be read{why}")
    guess, near, _ = suggestion(name, known).partition("?")
    asked = f"no {key} '{name}'" if name else f"the key '{key}' is missing"
    listed = ", ".join(f"{one} ({kind})" for one, kind in known.items())
    return RunError(f"{path}: {asked}; {f'{guess}? ' if near else ''}it has: {listed}{why}")


def _wanted(name: str, fields: Sequence[str] | None) -> bool:
    """Whether a column is, or holds, one of the fields that are asked for."""
    return fields is None or any(path == name or path.startswith((f"{name}.", f"{name}[")) for path in fields)


def _joined(tables: Iterable[pa.Table], what: str) -> pa.Table | None:
    """One table of many, whose columns may differ; None of none.

    Raises:
        ValueError: They do not fit each other, or are too large.
    """
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


# Topics.


def _read_topic(path: Path, topic: str, fields: Sequence[str] | None) -> Table:
    faults, seen, names = Faults(), set[Channel](), dict[str, None]()
    table = _joined(_batches(_messages(path, topic, faults, seen), fields, names), f"topic '{topic}'")
    notes = faults.notes(path.name)
    if table is None:
        raise _unknown(path, "topic", topic, {one.topic: one.type for one in sorted(seen)}, notes)
    time = table[LOG_TIME].cast(pa.int64())
    if pc.any(pc.greater(time[:-1], time[1:])).as_py():  # chunks and files of one bag may overlap
        table = table.take(pc.sort_indices(time))  # stable
    columns = dict(zip(table.column_names, table.columns, strict=True))
    return Table(path, columns, table.num_rows, tuple(notes), (*names, LOG_TIME))


def _messages(path: Path, topic: str, faults: Faults, seen: set[Channel]) -> Iterator[tuple[Record, Message]]:
    """The messages of a topic, recorded and decoded."""
    decoders = dict[Channel, bags.Decoder]()
    for record in bags.records_of(path, topic, faults, seen):
        if record.channel not in decoders:
            decoders[record.channel] = bags.decoder_of(record.channel)
            kinds = sorted({channel.type for channel in decoders})
            if len(kinds) > 1:
                raise ValueError(f"topic '{topic}' has messages of several types: {', '.join(kinds)}")
        try:
            message = decoders[record.channel](record.payload)
        except bags.DAMAGE as error:
            faults.leave_out("message", error)
        else:
            yield record, message


def _batches(
    messages: Iterable[tuple[Record, Message]], fields: Sequence[str] | None, names: dict[str, None]
) -> Iterator[pa.Table]:
    """Tables of a few messages each, with the fields asked for; ``names`` gets those of all fields of the first."""

    @lru_cache
    def wanted(name: str) -> bool:
        return _wanted(name, fields)

    rows, times, size = list[Message](), list[int | None](), 0
    for record, message in messages:
        names.update({} if names else dict.fromkeys(message))
        rows.append({name: bags.plain(value) for name, value in message.items() if wanted(name)})
        times.append(record.time if 0 <= record.time < 2**63 else None)
        size += len(record.payload)
        if len(rows) == _BATCH_ROWS or size > _BATCH_BYTES:
            yield _batch(rows, times)
            rows, times, size = [], [], 0
    if rows:
        yield _batch(rows, times)


def _batch(rows: Sequence[Message], times: Sequence[int | None]) -> pa.Table:
    columns = dict[str, Any]()
    for name in dict.fromkeys(name for row in rows for name in row):
        try:
            columns[name] = pa.array([row.get(name) for row in rows])
        except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError, OverflowError) as error:
            raise ValueError(f"field '{name}' holds values of different kinds: {reason(error)}") from None
    return pa.table({**columns, LOG_TIME: pa.array(times, pa.timestamp("ns"))})


def _topics(path: Path) -> tuple[Topic, ...]:
    faults, seen, found = Faults(), set[Channel](), Counter[Channel]()
    first, ends = dict[Channel, Record](), dict[Channel, tuple[int, int]]()
    for record in bags.records_of(path, None, faults, seen):
        channel, time = record.channel, record.time
        first.setdefault(channel, record)
        low, high = ends.get(channel, (time, time))
        ends[channel] = min(low, time), max(high, time)
        found[channel] += 1
    if not seen:
        raise _unknown(path, "topic", "", {}, faults.notes(path.name))
    return tuple(
        Topic(one.topic, one.type, found[one], *ends.get(one, (None, None)), _numbers_in(first.get(one)))
        for one in sorted(seen)
    )


def _numbers_in(record: Record | None) -> tuple[str, ...]:
    """The field paths of the numbers in a message; none if it cannot be decoded."""
    if record is None:
        return ()
    try:
        return tuple(numeric_paths(bags.plain(bags.decoder_of(record.channel)(record.payload))))
    except bags.DAMAGE:
        return ()


# Entities.


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
    with _one_line(path):
        _, found = _opened(path, [])
        batch = next(batch for name, batch in _chunks(path, []) if name == _place(entity))
        is_timeline = time in batch.schema.names and time not in _components(batch)
        kind = batch.schema.field(time).type if is_timeline else pa.null()
    count = 10 ** (9 - 3 * TIMES.index(unit)) if pa.types.is_integer(kind) else 1
    return Recording(found.application_id, found.recording_id, time if is_timeline else "", str(kind), count)


def _place(entity: str) -> str:
    return f"/{entity.strip('/')}"


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


def _read_entity(path: Path, entity: str, fields: Sequence[str] | None) -> Table:
    place, notes, known = _place(entity), list[str](), dict[str, set[str]]()

    def parts() -> Iterator[pa.Table]:
        for name, batch in _chunks(path, notes):
            components = _components(batch)
            known.setdefault(name, set()).update(components)
            if name == place:
                unwanted = [one for one in components if not (_wanted(one, fields) or _wanted(_last(one), fields))]
                yield pa.table(batch).drop_columns(unwanted)

    table = _joined(parts(), f"entity '{place}'")
    if table is None:
        listed = {one: ", ".join(sorted(components)) for one, components in sorted(known.items())}
        raise _unknown(path, "entity", entity and place, listed, notes)
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


def _entities(path: Path) -> tuple[Topic, ...]:
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
