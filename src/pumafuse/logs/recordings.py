"""Recordings as tables: a topic of MCAP or of a bag of ROS, an entity of a Rerun recording (:mod:`.entities`).

Of MCAP and bags, a row is a message, a column one of its fields, nested as in the message. ``log_time`` is when it was
recorded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from ..errors import one_line, reason, unknown_part
from . import bags, entities, messages
from .bags import Channel, Faults, Message, Record
from .columns import LOG_TIME, Table, Topic, holders, joined, numeric_paths

_BATCH_ROWS, _BATCH_BYTES = 4096, 16 << 20  # of messages that are in memory as Python objects


def read(path: Path, name: str, fields: Sequence[str] | None = None) -> Table:
    """A topic or an entity, its rows in the order in which they were recorded.

    Args:
        path: A file, or the folder of a ROS 2 bag.
        name: The topic, or the entity of a Rerun recording.
        fields: Columns, whole or to a field, that are wanted. None: all.

    Raises:
        RunError: It is no such recording, has no such topic or nothing on it, or is too damaged.
    """
    with one_line(path, "'pumafuse[bags]'"):
        return (entities.read if path.suffix == ".rrd" else _read_topic)(path, name, fields)


def topics(path: Path) -> tuple[Topic, ...]:
    """What a recording has, by topic or entity.

    Args:
        path: A file, or the folder of a ROS 2 bag.

    Raises:
        RunError: It is no such recording, or too damaged.
    """
    with one_line(path, "'pumafuse[bags]'"):
        return (entities.topics if path.suffix == ".rrd" else _topics)(path)


# Topics.


def _read_topic(path: Path, topic: str, fields: Sequence[str] | None) -> Table:
    faults, seen, names = Faults(), set[Channel](), dict[str, None]()
    rows = _rows(_messages(path, topic, faults, seen), fields, faults)
    table = joined(_batches(rows, fields, names), f"topic '{topic}'")
    notes = faults.notes(path.name)
    if table is None:
        raise unknown_part(path, "topic", topic, {one.topic: one.type for one in sorted(seen)}, notes)
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


def _rows(
    found: Iterator[tuple[Record, Message]], fields: Sequence[str] | None, faults: Faults
) -> Iterable[tuple[Record, Message]]:
    """Messages as rows: each as one, or, where fields of rows in them are asked for, these; see :mod:`.messages`."""
    first = next(found, None)
    if first is None:
        return []
    found = chain([first], found)
    asked = holders(fields or ())
    if fields is not None and list(first[1]) == [messages.TRANSFORMS] and messages.TRANSFORMS not in asked:
        return messages.each_transform(found)
    if messages.PATH not in first[1] and messages.PATH in asked:
        return messages.each_place(found, faults)
    return found


def _batches(
    messages: Iterable[tuple[Record, Message]], fields: Sequence[str] | None, names: dict[str, None]
) -> Iterator[pa.Table]:
    """Tables of a few messages each, with the fields asked for; ``names`` gets those of all fields of the first."""
    asked = None if fields is None else holders(fields)
    rows, times, size = list[Message](), list[int | None](), 0
    for record, message in messages:
        names.update({} if names else dict.fromkeys(message))
        rows.append({name: bags.plain(value) for name, value in message.items() if asked is None or name in asked})
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
        raise unknown_part(path, "topic", "", {}, faults.notes(path.name))
    return tuple(
        Topic(one.topic, one.type, found[one], *ends.get(one, (None, None)), *_fields_in(first.get(one)))
        for one in sorted(seen)
    )


def _fields_in(record: Record | None) -> tuple[tuple[str, ...], str]:
    """The field paths of the numbers in a message, also of those of its rows; or why it cannot be decoded."""
    if record is None:
        return (), ""
    try:
        message = bags.plain(bags.decoder_of(record.channel)(record.payload))
    except bags.DAMAGE as error:
        return (), reason(error)
    path = [messages.PATH_TIME] if messages.trajectory_in(message) else []
    return (*numeric_paths(message), *path), ""
