"""Messages of a running robot as events, read as the same ``run.toml`` reads them from a recording."""

from __future__ import annotations

import math
import re
import statistics
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from itertools import chain, takewhile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..arrays import NO_STAMP, REACH_NS, BoolArray, FloatArray, TimeArray
from ..errors import ConfigError
from ..logs import bags
from ..logs.columns import LOG_TIME, NAMES, SPLIT_STAMPS, Table, Where, holders
from ..logs.manifest import CommandEntry, Manifest, SourceEntry
from ..logs.reading import read_source
from ..logs.recordings import PATH, TRANSFORMS, CommandedPath, begin_of, trajectory_in
from ..logs.source import PAUSE, Source
from ..units import POSITIONS, TIMES, divisor
from .sources import events_of
from .tool import ORIENTATION
from .wire import Event

_LACKS = (IndexError, ValueError, TypeError)  # of a message that has no such element, or no number there
_USUAL = 101  # gaps between commands of which the median is the usual one


@cache
def getter(path: str) -> Callable[[Any], Any]:
    """What follows a field path, see :mod:`pumafuse.logs.columns`, into a message.

    What it raises: AttributeError where the type has no such field, IndexError or ValueError where a message has no
    such element.
    """
    steps = re.findall(r"([^.\[\]]+)|\[([^\]]*)\]", path)

    def get(message: Any) -> Any:
        value = holder = message
        for name, element in steps:
            if name:
                holder, value = value, getattr(value, name)
            elif element.isdigit():
                value = value[int(element)]
            else:
                value = value[list(getattr(holder, NAMES)).index(element)]
        return value

    return get


@dataclass(frozen=True)
class Messages(Table):
    """Messages that were received at one instant, as a table whose columns are the field paths in them."""

    messages: Sequence[Any] = ()
    received: int = 0  # ns
    # the latest value [rad] of each angle that goes on over turns, and what was added to it
    turns: dict[str, tuple[float, float]] = field(default_factory=dict[str, tuple[float, float]])

    def numbers(self, name: str, unit: str = "") -> tuple[FloatArray, None]:
        """A column of positions [m or rad], NaN where a message has none."""
        return self.plain(name)[0] / divisor(unit or self._ending(name, POSITIONS, "mm")), None

    def plain(self, name: str) -> tuple[FloatArray, None]:
        """A column of numbers without conversion, NaN where a message has none."""
        get = getter(name)
        return np.array([_number(get, message) for message in self.messages], dtype=np.float64), None

    def meets(self, where: Where) -> BoolArray:
        """Messages in which each of some fields has a value, (rows,)."""
        return np.array([_meets(message, where) for message in self.messages], dtype=np.bool_)

    def stamps(self, name: str, nanoseconds: str = "", unit: str = "") -> tuple[TimeArray, None]:
        """Stamps in int64 ns, ``NO_STAMP`` where a message has none."""
        stamps = (self._stamp(message, name, nanoseconds, unit) for message in self.messages)
        return np.fromiter((stamp if abs(stamp) < REACH_NS else NO_STAMP for stamp in stamps), np.int64), None

    def unwrapped(self, key: str, /, angle: FloatArray, turn: float) -> FloatArray:
        """Angles that go on from those of the messages before, as numpy's unwrap has it."""
        return np.array([self._goes_on(key, value, turn) for value in angle.tolist()])

    def _stamp(self, message: Any, name: str, nanoseconds: str, unit: str) -> int:
        if name == LOG_TIME:
            return self.received
        try:
            value = getter(name)(message)
            if nanoseconds:
                return int(value) * 10**9 + int(getter(nanoseconds)(message))
            for seconds, fraction in SPLIT_STAMPS:
                if hasattr(value, seconds) and hasattr(value, fraction):
                    return getattr(value, seconds) * 10**9 + getattr(value, fraction)
            per_unit = 10 ** (9 - 3 * TIMES.index(unit or self._ending(name, TIMES, "s")))
            return value * per_unit if isinstance(value, int) else round(value * per_unit)
        except (*_LACKS, OverflowError):
            return NO_STAMP

    def _goes_on(self, key: str, value: float, turn: float) -> float:
        before, turns = self.turns.get(key, (math.nan, 0.0))
        step = value - before
        if abs(step) >= 0.5 * turn:
            short = (step + 0.5 * turn) % turn - 0.5 * turn
            turns += (0.5 * turn if short == -0.5 * turn and step > 0.0 else short) - step
        if value == value:
            self.turns[key] = value, turns
        return value + turns


def _number(get: Callable[[Any], Any], message: Any) -> float:
    """A number of a message; NaN where it has none."""
    try:
        return float(get(message))
    except _LACKS:
        return math.nan


def _meets(message: Any, where: Where) -> bool:
    """Whether each of some fields has a value."""
    try:
        return all(getter(path)(message) == value for path, value in where.items())
    except _LACKS:
        return False


class Reader:
    """What messages of one topic say of one source of a run: a sensor, or the commands, which have no name.

    The commands' reader keeps the last ones by axis [m or rad]: an angle of a sensor that goes on begins at the turn
    that is nearest to them.
    """

    def __init__(self, name: str, entry: SourceEntry, commanded: dict[str, float]) -> None:
        if entry.time.rate or entry.time.counter or entry.time.ending == "_days":
            where = f"sensors.{name}" if name else "command"
            raise ConfigError(
                f"{where}: time: a running robot's messages need stamps, or '{LOG_TIME}', when they are received"
            )
        self.name, self.entry = name, entry
        self._table = Messages(Path(entry.label), {}, 0, ())
        self._commanded, self._turns, self._away = commanded, entry.turns, dict[str, float]()
        self._is_of_paths = PATH in holders(entry.fields)
        if self._is_of_paths:
            import_module("scipy.interpolate")  # takes a second, which the first path would wait
        self._asks_whole = TRANSFORMS in holders(entry.fields)
        self._step = entry.interpolation if isinstance(entry, CommandEntry) else 0.0
        self._before: Event | None = None
        self._gaps = deque[float](maxlen=_USUAL)  # between commands [ns]
        self._path: CommandedPath | None = None
        self._coming: Iterator[SimpleNamespace] = iter(())
        self._next: SimpleNamespace | None = None  # of the path; then come the others
        self._read([], 0)  # refuses columns without a unit

    def missing_fields(self, empty: Any) -> list[str]:
        """The fields that a type of messages has not, of which this is an empty one."""
        parts = _rows(empty, self._asks_whole)
        if self._is_of_paths:
            return [] if trajectory_in(bags.plain(empty)) is not None else [PATH]
        lacking = list[str]()
        for path in (*self.entry.fields, *self.entry.where):
            try:
                if path != LOG_TIME:
                    for row in [empty] if parts is None else parts[:1]:
                        getter(path)(row)
            except AttributeError:
                lacking.append(path)
            except _LACKS:
                pass
        if not lacking and parts is None:
            self.entry.time.stamps(self._table_of([empty], 0))  # refuses stamps without a unit
        return lacking

    def events(self, message: Any, received: int) -> Iterator[Event]:
        """The events of a message that was received at an instant [ns]."""
        if self._is_of_paths:
            self._follow(message, received)
            return
        rows = _rows(message, self._asks_whole)
        yield from self._events([message] if rows is None else rows, received)

    def due(self, now: int) -> Iterator[Event]:
        """The commands until now [ns] of the path of a trajectory."""
        while self._next is not None and self._next.time_ns <= now:
            row, self._next = self._next, next(self._coming, None)
            yield from self._events([SimpleNamespace(path=row)], row.time_ns)

    @property
    def next_due(self) -> int | None:
        """When the next of these is [ns]; None without any."""
        return None if self._next is None else self._next.time_ns

    def _events(self, messages: Sequence[Any], received: int) -> Iterator[Event]:
        chosen = [message for message in messages if _meets(message, self.entry.where)]
        for event in events_of(self.name, self._read(chosen, received)):
            if not self.name:
                self._commanded.update({axis: value for axis, value in event.values.items() if value == value})
                yield from self._between(event)
            yield event

    def _table_of(self, messages: Sequence[Any], received: int) -> Messages:
        return replace(self._table, rows=len(messages), messages=messages, received=received)

    def _read(self, messages: Sequence[Any], received: int) -> Source:
        source, _ = read_source(self._table_of(messages, received), self.entry)
        if self.name and self._turns:
            values = {axis: self._beside(axis, value) for axis, value in source.values.items()}
            source = replace(source, values=values)
        return source.rows(source.has_value) if source.apart else source

    def _beside(self, axis: str, value: FloatArray) -> FloatArray:
        """An angle that goes on, moved by whole turns to where it was commanded when the first of it came."""
        turn, came = self._turns.get(axis, 0.0), value[~np.isnan(value)]
        if turn and len(came) and axis not in self._away and axis in self._commanded:
            self._away[axis] = turn * round((float(came[0]) - self._commanded[axis]) / turn)
        return value - self._away.get(axis, 0.0)

    def _between(self, event: Event) -> Iterator[Event]:
        """The commands on the line from the one before, for a controller that goes on so; not over a pause.

        They are known once this one has come, and are late by that: the filter takes them as if they had not been.
        """
        step, before = self._step, self._before
        if not step or event.t != event.t:
            return
        self._before = event
        if before is None or event.t - before.t <= step * 1e9:
            return
        self._gaps.append(event.t - before.t)
        if event.t - before.t > PAUSE * statistics.median(self._gaps):
            return
        both = [before.values, event.values]
        values = {axis: np.array([row[axis] for row in both]) for axis in both[0].keys() & both[1].keys()}
        turned = values.pop(ORIENTATION, None)
        stamp = np.array([before.t, event.t], dtype=np.int64)
        path = Source(stamp, values, "command", orientation=turned).interpolated(step)
        yield from events_of("", path.rows(slice(1, -1)))

    def _follow(self, message: Any, received: int) -> None:
        """Follow the path of a trajectory, in the place of what is left of the one before."""
        trajectory = trajectory_in(bags.plain(message))
        if trajectory is None:
            raise ValueError("it is no trajectory")
        begin = begin_of(trajectory, received)
        left = self._coming if self._next is None else chain([self._next], self._coming)
        self._path = path = CommandedPath(trajectory, begin, self._path)
        rows = (SimpleNamespace(time_ns=time, name=path.joints, position=at) for time, at in path.rows())
        self._coming = chain(takewhile(lambda row: row.time_ns < begin, left), rows)
        self._next = next(self._coming, None)


def readers_of(listed: Manifest) -> list[Reader]:
    """The readers of all sources of a ``run.toml``; of one instant commands come last."""
    commanded, entries = dict[str, float](), {**listed.sensors, "": listed.command}
    return [Reader(name, entry, commanded) for name, entry in entries.items()]


def _rows(message: Any, whole: bool) -> list[Any] | None:
    """The transforms of a message of tf, unless its fields are asked for as a whole; None of another message."""
    return None if whole or list(bags.fields_of(message) or ()) != [TRANSFORMS] else list(message.transforms)
