"""Messages of a running ROS as events, read as the same ``run.toml`` reads them from a bag."""

from __future__ import annotations

import math
import re
import statistics
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from itertools import chain, takewhile
from types import SimpleNamespace
from typing import Any, TypeAlias

import numpy as np

from ..arrays import FloatArray
from ..errors import ConfigError
from ..logs import bags
from ..logs.columns import LOG_TIME, NAMES, SPLIT_STAMPS, holders, leaf
from ..logs.manifest import Column, CommandEntry, Manifest, Orientation, SourceEntry, Time
from ..logs.recordings import PATH, TRANSFORMS, CommandedPath, begin_of, trajectory_in
from ..logs.source import PAUSE, Source
from ..units import POSITIONS, TIMES, divisor, ending
from .tool import NOISE, ORIENTATION
from .wire import Event

Getter: TypeAlias = Callable[[Any], Any]
_LACKS = (IndexError, ValueError, TypeError)  # of a message that has no such element, or no number there
_NO_STAMP = math.nan
_USUAL = 101  # gaps between commands of which the median is the usual one


def getter(path: str) -> Getter:
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


class _Number:
    """A column of numbers in SI; an angle that begins anew after a turn is made to go on."""

    def __init__(self, column: Column, where: str) -> None:
        unit = column.ending or ending(leaf(column.column))
        if unit not in POSITIONS:
            raise ConfigError(f"{where}: column '{column.column}' has no unit; give unit = 'm' or 'rad' beside it")
        self._get, self._divisor, self._met = getter(column.column), divisor(unit), _condition(column.where)
        self._turn, self._before, self._turns = column.turn, math.nan, 0.0

    def __call__(self, row: Any) -> float:
        try:
            value = float(self._get(row)) / self._divisor if self._met(row) else math.nan
        except _LACKS:
            return math.nan
        if not self._turn or value != value:
            return value
        step = value - self._before
        if abs(step) >= 0.5 * self._turn:  # as numpy's unwrap has it
            short = (step + 0.5 * self._turn) % self._turn - 0.5 * self._turn
            self._turns += (0.5 * self._turn if short == -0.5 * self._turn and step > 0.0 else short) - step
        self._before = value
        return value + self._turns


def _condition(where: Mapping[str, bool | int | float | str]) -> Callable[[Any], bool]:
    """Whether each of some fields has a value."""
    asked = [(getter(path), value) for path, value in where.items()]

    def met(row: Any) -> bool:
        try:
            return all(get(row) == value for get, value in asked)
        except _LACKS:
            return False

    return met


def _quaternion_getter(orientation: Orientation, where: str) -> Callable[[Any], tuple[float, ...] | None]:
    """The quaternion x, y, z, w of a row; None where it has none."""
    plain = orientation.quaternion is not None
    columns = [Column(name, orientation.unit) for name in orientation.columns]
    numbers = [getter(column.column) for column in columns] if plain else [_Number(column, where) for column in columns]

    def turned(row: Any) -> tuple[float, ...] | None:
        try:
            value = np.array([[float(number(row)) for number in numbers]])
        except _LACKS:
            return None
        quaternion = orientation.quaternions(value)[0]
        return None if np.isnan(quaternion).any() else tuple(quaternion.tolist())

    return turned


def _stamp(time: Time, where: str) -> Callable[[Any, int], float | int]:
    """The stamp of a row [ns], by it and by when it was received [ns]; NaN for none."""
    if time.rate or time.counter:
        raise ConfigError(
            f"{where}: time: a running robot's messages need stamps, or '{LOG_TIME}', when they are received"
        )
    shift = round(time.shift * 1e9)
    if time.column == LOG_TIME:
        return lambda _, received: received + shift
    get, get_nanoseconds = getter(time.column), getter(time.nanoseconds)
    unit = time.ending or ending(leaf(time.column))
    per_unit = 10 ** (9 - 3 * TIMES.index(unit)) if unit in TIMES else None

    def stamp(row: Any, _: int) -> float | int:
        try:
            value = get(row)
            if time.nanoseconds:
                return int(value) * 10**9 + int(get_nanoseconds(row)) + shift
            for seconds, nanoseconds in SPLIT_STAMPS:
                if hasattr(value, seconds) and hasattr(value, nanoseconds):
                    return getattr(value, seconds) * 10**9 + getattr(value, nanoseconds) + shift
            if per_unit is None:
                raise ConfigError(f"{where}: column '{time.column}' has no unit; give unit = 's' or 'ns' beside it")
            return value * per_unit + shift if isinstance(value, int) else round(value * per_unit) + shift
        except (*_LACKS, OverflowError):
            return _NO_STAMP

    return stamp


class Reader:
    """What messages of one topic say of one source of a run: a sensor, or the commands, which have no name.

    The commands' reader keeps the last ones by axis [m or rad]: an angle of a sensor that goes on begins at the turn
    that is nearest to them.
    """

    def __init__(self, name: str, entry: SourceEntry, commanded: dict[str, float]) -> None:
        where = f"sensors.{name}" if name else "command"
        self.name, self.entry = name, entry
        self._stamp, self._met = _stamp(entry.time, where), _condition(entry.where)
        self._values = {
            axis: [_Number(column, where) for column in columns]
            for axis, columns in (*entry.axes.items(), *entry.joints.items())
        }
        self._turned = None if entry.orientation is None else _quaternion_getter(entry.orientation, where)
        self._noise = None if entry.noise is None else getter(entry.noise.column)
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
            self._stamp(empty, 0)
        return lacking

    def events(self, message: Any, received: int) -> Iterator[Event]:
        """The events of a message that was received at an instant [ns]."""
        if self._is_of_paths:
            self._follow(message, received)
            return
        rows = _rows(message, self._asks_whole)
        for row in [message] if rows is None else rows:
            for event in self._event(row, received):
                yield from self._between(event)
                yield event

    def due(self, now: int) -> Iterator[Event]:
        """The commands until now [ns] of the path of a trajectory."""
        while self._next is not None and self._next.time_ns <= now:
            row, self._next = self._next, next(self._coming, None)
            yield from self._event(SimpleNamespace(path=row), row.time_ns)

    @property
    def next_due(self) -> int | None:
        """When the next of these is [ns]; None without any."""
        return None if self._next is None else self._next.time_ns

    def _event(self, row: Any, received: int) -> Iterator[Event]:
        if not self._met(row):
            return
        values: dict[str, Any] = {
            axis: sum(number(row) for number in numbers) for axis, numbers in self._values.items()
        }
        if self._turns and self.name:
            self._go_beside(values)
        finite = {axis: value for axis, value in values.items() if value == value}
        if not self.name:
            self._commanded.update(finite)
        if self._turned is not None and (turned := self._turned(row)) is not None:
            finite[ORIENTATION] = turned
        if self._noise is not None and self.entry.noise is not None:
            finite[NOISE] = self.entry.noise.factor(_number(self._noise, row)).item()
        if finite or not self.entry.has_own_rows:
            as_logged = self.name and not self.entry.has_own_rows  # a sensor's row says what it has not, as in a log
            yield Event(self._stamp(row, received), self.name, {**values, **finite} if as_logged else finite or values)

    def _go_beside(self, values: dict[str, Any]) -> None:
        """Move angles that go on by whole turns to where they were commanded when the first of them came."""
        for axis, turn in self._turns.items():
            value = values.get(axis, math.nan)
            if value == value and axis not in self._away and axis in self._commanded:
                self._away[axis] = turn * round((value - self._commanded[axis]) / turn)
            values[axis] = value - self._away.get(axis, 0.0)

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
        for row in range(1, len(path.stamp) - 1):
            at: dict[str, Any] = {axis: float(value[row]) for axis, value in path.values.items()}
            at |= {} if path.orientation is None else {ORIENTATION: tuple(path.orientation[row].tolist())}
            yield Event(int(path.stamp[row]), "", at)

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


def _number(get: Getter, row: Any) -> FloatArray:
    """A number of a row, (); NaN where it has none."""
    try:
        return np.array(float(get(row)))
    except _LACKS:
        return np.array(math.nan)


def _rows(message: Any, whole: bool) -> list[Any] | None:
    """The transforms of a message of tf, unless its fields are asked for as a whole; None of another message."""
    return None if whole or list(bags.fields_of(message) or ()) != [TRANSFORMS] else list(message.transforms)
