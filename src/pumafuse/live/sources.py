"""Where events come from on this machine: standard input, or a recorded run as it happened."""

from __future__ import annotations

import math
import os
import select
import time
from collections.abc import Iterator

import numpy as np

from ..arrays import NO_STAMP, FloatArray, TimeArray
from ..errors import RunError
from ..fusion.commands import as_commanded
from ..fusion.config import FusionConfig
from ..logs.clock import segments
from ..logs.run import Run, Source
from .lines import Lines
from .wire import Event

QUIET = 0.1  # s without an event after which a source says so
_PIECE = 1 << 16
_BATCH = 1000  # events that a replay hands over at once when nothing makes it wait


def standard_input(descriptor: int = 0) -> Iterator[list[bytes]]:
    """Lines of standard input as they come; none whenever it is quiet.

    Raises:
        RunError: It cannot be read.
    """
    lines = Lines()
    while True:
        try:
            if os.name == "posix" and not select.select([descriptor], [], [], QUIET)[0]:
                yield []
                continue
            piece = os.read(descriptor, _PIECE)
        except OSError as error:
            raise RunError(f"standard input: cannot be read: {error.strerror}") from None
        if not piece:
            yield lines.rest()
            return
        yield lines.cut(piece)


def replayed(run: Run, config: FusionConfig, speed: float) -> Iterator[list[Event]]:
    """A run's events in the order of their arrival, at a multiple of its own pace; an empty list whenever it is quiet.

    A row has arrived when its stamp says, one that steps back with the row before it; measurements come before commands
    of the same instant.

    Raises:
        RunError: The clocks of the run cannot be followed.
    """
    for part in segments(run)[0]:
        yield from _paced(*_arrivals(part, config), speed)


def _arrivals(run: Run, config: FusionConfig) -> tuple[TimeArray, list[Event]]:
    """When each event arrives [ns], ascending, (n,), and the events."""
    arrival: list[TimeArray] = []
    events: list[Event] = []
    command = as_commanded(run, config.arm.update_period)
    for name, source in [*run.sensors.items(), ("", command)]:
        events += _events(name, source)
        arrival.append(np.maximum.accumulate(source.stamp))
    order = np.argsort(np.concatenate(arrival), kind="stable")
    return np.concatenate(arrival)[order], [events[place] for place in order.tolist()]


def _events(name: str, source: Source) -> list[Event]:
    """The rows of a source in their order; without a name they are commands, of the axes that each has a value for."""
    columns: list[list[float]] = [value.tolist() for value in source.values.values()]
    stamps: list[float | int] = [math.nan if stamp == NO_STAMP else stamp for stamp in source.stamp.tolist()]
    rows = zip(stamps, zip(*columns, strict=True), strict=True)
    if name:
        return [Event(stamp, name, dict(zip(source.values, row, strict=True))) for stamp, row in rows]
    return [
        Event(stamp, name, {axis: u for axis, u in zip(source.values, row, strict=True) if u == u})  # NaN: no command
        for stamp, row in rows
    ]


def _paced(arrival: TimeArray, events: list[Event], speed: float) -> Iterator[list[Event]]:
    """Events when their time has come by the wall's clock, given when each arrives, int64 ns, ascending, (n,)."""
    first = int(arrival[arrival != NO_STAMP].min(initial=np.iinfo(np.int64).max))
    due: FloatArray = (np.maximum(arrival, first) - first) / 1e9 / speed  # rows without a stamp come at once
    begin, at = time.monotonic(), 0
    while at < len(events):
        gone = time.monotonic() - begin
        end = min(max(int(np.searchsorted(due, gone, side="right")), at), at + _BATCH)
        if end == at:
            time.sleep(min(float(due[at]) - gone, QUIET))
            if due[at] - gone > QUIET:
                yield []
            continue
        yield events[at:end]
        at = end
