"""Sources of events on this machine: standard input, or the replay of a recorded run."""

from __future__ import annotations

import math
import os
import select
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..arrays import NO_STAMP, TimeArray
from ..errors import RunError
from ..fusion.config import FusionConfig
from ..fusion.segments import believed_commands
from ..logs.clock import segments
from ..logs.run import Run
from ..logs.source import Source
from .tool import NOISE, ORIENTATION
from .wire import Event, Lines

QUIET = 0.1  # s without an event after which a source gives an empty list
_PIECE = 1 << 16  # bytes
_BATCH = 1000  # events that a replay hands over at once when it need not wait


def standard_input(descriptor: int = 0) -> Iterator[list[bytes]]:
    """Lines of standard input as they come; an empty list after a tenth of a second without any."""
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
            yield lines.take_last()
            return
        yield lines.cut(piece)


def replay(run: Run, config: FusionConfig, speed: float) -> Iterator[list[Event]]:
    """A run's events in the order of their arrival, at ``speed`` times its own pace; an empty list while it is quiet.

    A row arrives when the run says that it came; where it does not say, when its stamp says, and one that steps back
    with the row before it. Measurements come before commands of the same instant. What the run has in joints comes so:
    the configuration has its robot.
    """
    if run.clock != "stamps" and run.has_orientation:
        raise RunError(f"run '{run.name}': with orientations its clock = '{run.clock}' cannot be replayed; fuse it")
    for part in segments(run)[0]:
        yield from _pace(*_arrivals(part, config), speed)


def _arrivals(run: Run, config: FusionConfig) -> tuple[TimeArray, list[Event]]:
    """When each event arrives [ns], ascending, (n,), and the events."""
    sources = [*run.sensors.items(), ("", believed_commands(run, config))]
    times = (source.arrival if len(source.arrival) else source.stamp for _, source in sources)
    arrival = np.concatenate([np.maximum.accumulate(stamp) for stamp in times])
    events = [event for name, source in sources for event in events_of(name, source.in_joints())]
    order = np.argsort(arrival, kind="stable")
    return arrival[order], [events[row] for row in order.tolist()]


def events_of(name: str, source: Source) -> Iterator[Event]:
    """The rows of a sensor as events, or of commands (no name), which give only the axes that they have a value for."""
    columns: list[list[float]] = [value.tolist() for value in source.values.values()]
    turned = [None] * len(source.stamp) if source.orientation is None else source.orientation.tolist()
    as_logged = name and not source.apart  # it says what it has not
    noise = source.noise.tolist() or [None] * len(source.stamp)
    for stamp, orientation, scaled, *row in zip(source.stamp.tolist(), turned, noise, *columns, strict=True):
        every = dict(zip(source.values, row, strict=True))
        values: dict[str, Any] = {axis: value for axis, value in every.items() if as_logged or value == value}
        if orientation is not None and orientation[0] == orientation[0]:
            values[ORIENTATION] = orientation
        if scaled is not None:
            values[NOISE] = scaled
        yield Event(math.nan if stamp == NO_STAMP else stamp, name, values or every)


def _pace(arrival: TimeArray, events: list[Event], speed: float) -> Iterator[list[Event]]:
    """Events when they are due by the wall clock; ``arrival`` is when each arrives [ns], ascending, (n,)."""
    first = int(arrival[arrival != NO_STAMP].min(initial=np.iinfo(np.int64).max))
    due = (np.maximum(arrival, first) - first) / 1e9 / speed  # rows without a stamp come at once
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
