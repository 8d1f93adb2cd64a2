"""Recordings as tables: a topic of MCAP or of a bag of ROS, an entity of a Rerun recording (:mod:`.entities`).

Of MCAP and bags, a row is a message, a column one of its fields, nested as in the message. ``log_time`` is when it was
recorded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from ..arrays import FloatArray
from ..errors import one_line, reason, unknown_part
from . import bags, entities
from .bags import Channel, Faults, Message, Record
from .columns import LOG_TIME, SPLIT_STAMPS, Table, Topic, holders, joined, numeric_paths

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

_BATCH_ROWS, _BATCH_BYTES = 4096, 16 << 20  # of messages that are in memory as Python objects
PATH = "path"  # the column of where a trajectory is at each time
PATH_TIME = f"{PATH}.time_ns"
TRANSFORMS = "transforms"  # the only field of ROS's tf messages
_STEP = 4_000_000  # ns, of a path; controllers of joints go on in steps of 1 to 10 ms
_MOST_ROWS = 30_000_000  # of the path of one trajectory: 33 hours
_AROUND = ("request", "goal", "trajectory", "joint_trajectory")  # what goals of actions have a trajectory in


def read(path: Path, name: str, fields: Sequence[str] | None = None) -> Table:
    """A topic or an entity, its rows in the order of recording; of all fields, or those that are wanted."""
    with one_line(path, "'pumafuse[bags]'"):
        return (entities.read if path.suffix == ".rrd" else _read_topic)(path, name, fields)


def topics(path: Path) -> tuple[Topic, ...]:
    """What a file, or the folder of a ROS 2 bag, has, by topic or entity."""
    with one_line(path, "'pumafuse[bags]'"):
        return (entities.topics if path.suffix == ".rrd" else _topics)(path)


# Topics.


def _read_topic(path: Path, topic: str, fields: Sequence[str] | None) -> Table:
    faults, seen, names = Faults(), set[Channel](), dict[str, None]()
    rows = _rows(_messages(path, topic, faults, seen), fields, faults)
    table = joined(_batches(rows, fields, names), f"topic '{topic}'")
    notes = faults.notes(path.name)
    if table is None:
        raise unknown_part(path, "topic", topic, {channel.topic: channel.type for channel in sorted(seen)}, notes)
    time = table[LOG_TIME].cast(pa.int64())
    if pc.any(pc.greater(time[:-1], time[1:])).as_py():  # chunks and files of one bag may overlap
        table = table.take(pc.sort_indices(time))  # stable
    columns = dict(zip(table.column_names, table.columns, strict=True))
    return Table(path, columns, table.num_rows, tuple(notes), (*names, LOG_TIME))


def _messages(path: Path, topic: str, faults: Faults, seen: set[Channel]) -> Iterator[tuple[Record, Message]]:
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
    messages: Iterator[tuple[Record, Message]], fields: Sequence[str] | None, faults: Faults
) -> Iterable[tuple[Record, Message]]:
    """Messages as rows: each as one, or, where fields of rows in them are asked for, these."""
    first = next(messages, None)
    if first is None:
        return []
    messages, asked = chain([first], messages), holders(fields or ())
    if fields is not None and list(first[1]) == [TRANSFORMS] and TRANSFORMS not in asked:
        return (
            (record, bags.fields_of(transform) or {})
            for record, message in messages
            for transform in message[TRANSFORMS]
        )
    if PATH not in first[1] and PATH in asked:
        return _each_place(messages, faults)
    return messages


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
    faults, seen, counts = Faults(), set[Channel](), Counter[Channel]()
    first, ends = dict[Channel, Record](), dict[Channel, tuple[int, int]]()
    for record in bags.records_of(path, None, faults, seen):
        channel, time = record.channel, record.time
        first.setdefault(channel, record)
        low, high = ends.get(channel, (time, time))
        ends[channel] = min(low, time), max(high, time)
        counts[channel] += 1
    if not seen:
        raise unknown_part(path, "topic", "", {}, faults.notes(path.name))
    return tuple(
        Topic(
            channel.topic,
            channel.type,
            counts[channel],
            *ends.get(channel, (None, None)),
            *_fields_in(first.get(channel)),
        )
        for channel in sorted(seen)
    )


def _fields_in(record: Record | None) -> tuple[tuple[str, ...], str]:
    """The field paths of the numbers in a message, also of those of its rows; or why it cannot be decoded."""
    try:
        message: Any = bags.plain(bags.decoder_of(record.channel)(record.payload)) if record else {}
    except bags.DAMAGE as error:
        return (), reason(error)
    return (*numeric_paths(message), *([PATH_TIME] if trajectory_in(message) else [])), ""


# Messages that are no row each: transforms of many frames, and trajectories of many points.


def trajectory_in(message: Any) -> Mapping[str, Any] | None:
    """The ``JointTrajectory`` that a message is, or the goal of an action has in it; None without one."""
    if isinstance(message, list):
        message = next(iter(cast(list[Any], message)), None)
    if not isinstance(message, Mapping):
        return None
    fields = cast(Mapping[str, Any], message)
    if {"joint_names", "points"} <= fields.keys():
        return fields
    inside = (trajectory_in(fields[name]) for name in _AROUND if name in fields)
    return next((trajectory for trajectory in inside if trajectory is not None), None)


def _each_place(messages: Iterable[tuple[Record, Message]], faults: Faults) -> Iterator[tuple[Record, Message]]:
    """A row for each 4 ms of the paths that trajectories command: ``path.time_ns``, ``.name``, ``.position``.

    A path is a cubic where its points have velocities, else straight between them. A new trajectory ends the one before
    and begins where that was. One without points ends it, too.
    """
    every = ((record, trajectory_in(bags.plain(message))) for record, message in messages)
    begun = (
        (begin_of(trajectory, record.time), record, trajectory)
        for record, trajectory in every
        if trajectory is not None
    )
    ordered = sorted(begun, key=lambda begun_at: begun_at[0])
    before: CommandedPath | None = None
    for (begin, record, trajectory), end in zip_longest(ordered, (begin for begin, _, _ in ordered[1:])):
        try:
            path = CommandedPath(trajectory, begin, before)
        except bags.DAMAGE as error:
            faults.leave_out("trajectory", error)
            continue
        for time, position in path.rows(end):
            yield record, {PATH: {"time_ns": time, "name": path.joints, "position": position}}
        before = path


class CommandedPath:
    """The path of one trajectory that begins at some time [ns], and the names of its ``joints``."""

    def __init__(self, trajectory: Mapping[str, Any], begin: int, before: CommandedPath | None) -> None:
        points = cast(list[Mapping[str, Any]], trajectory["points"])
        self.joints: list[str] = list(map(str, trajectory["joint_names"]))
        if before is not None and not points:
            self.joints = before.joints
        time = [begin + _nanoseconds(point["time_from_start"]) for point in points]
        position = [_numbers(point, "positions", self.joints) for point in points]
        velocity = [_numbers(point, "velocities", self.joints) for point in points if len(point["velocities"])]
        curved = len(velocity) == len(time)
        if before is not None and before.joints == self.joints and not (time and time[0] <= begin):
            time, position = [begin, *time], [before.at(begin), *position]
            velocity = [before.at(begin, 1), *velocity]
        if not time or not (np.diff(time) > 0).all():
            raise ValueError("the time_from_start of its points does not rise")
        if time[-1] - time[0] > _MOST_ROWS * _STEP:
            raise ValueError("it takes more than a day")
        self._time, self._last = (time[0], time[-1]), position[-1]
        seconds = (np.array(time) - time[0]) / 1e9
        self._curve = _curve(seconds, np.array(position), np.array(velocity) if curved else None)

    def at(self, time: int, order: int = 0) -> FloatArray:
        """Where it is at a time [ns], (joints,), or with order 1 its velocity [1/s]; behind its end it rests."""
        first, last = self._time
        if time >= last:
            return self._last if order == 0 else np.zeros_like(self._last)
        return self._curve(max(time - first, 0) / 1e9, order)

    def rows(self, end: int | None = None) -> Iterator[tuple[int, FloatArray]]:
        """Times [ns] and positions, each 4 ms, up to the last point, or to where the next trajectory begins."""
        first, last = self._time
        times = (instant for instant in chain(range(first, last, _STEP), (last,)) if end is None or instant < end)
        return ((time, self.at(time)) for time in times)


def _curve(time: FloatArray, position: FloatArray, velocity: FloatArray | None) -> PPoly:
    """A path through points at some times [s]: a cubic where they have velocities, else straight."""
    from scipy.interpolate import CubicHermiteSpline, PPoly

    if len(time) == 1:
        time, position, velocity = np.append(time, time + 1.0), np.repeat(position, 2, axis=0), None
    if velocity is not None:
        return CubicHermiteSpline(time, position, velocity)
    return PPoly(np.stack([np.diff(position, axis=0) / np.diff(time)[:, None], position[:-1]]), time)


def begin_of(trajectory: Mapping[str, Any], received: int) -> int:
    """When a trajectory begins [ns]: as its header says, or, where that is 0, when it was received."""
    stamp = cast(Mapping[str, Any], trajectory.get("header") or {}).get("stamp")
    return (_nanoseconds(stamp) if stamp else 0) or received


def _nanoseconds(time: Mapping[str, int]) -> int:
    seconds, nanoseconds = next(pair for pair in SPLIT_STAMPS if pair[0] in time and pair[1] in time)
    return int(time[seconds]) * 10**9 + int(time[nanoseconds])


def _numbers(point: Mapping[str, Any], key: str, joints: Sequence[str]) -> FloatArray:
    numbers = np.array(point[key], dtype=np.float64)
    if numbers.shape != (len(joints),) or not np.isfinite(numbers).all():
        raise ValueError(f"a point has no {key} for each of its {len(joints)} joints")
    return numbers
