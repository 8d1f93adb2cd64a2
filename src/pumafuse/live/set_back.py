"""Notices clocks that are set back by less than the window: their stamps go on where there were rows before.

A row that only came late fills a hole. Where a clock was set back, one row after the other is stamped behind the newest
one of its source at its usual interval, and nothing was missing there.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..arrays import ALWAYS

_COMMANDS = 3  # in a row that are set back, with a sensor that is, too, until all clocks are …
_ALONE = 8  # … and where no sensor measures
_ROWS = 5  # of a sensor in a row that are set back, until its clock is
_LEAST, _MOST = 0.5, 1.5  # of the usual interval, within which a row goes on after the one before
_FEW = 20  # intervals of which the usual one is a mean, and rows in order before those that are set back
_SLOWER = 1.1  # by a longer one the usual one grows: a source that is slower now has no holes after a while


@dataclass(slots=True)
class _Source:
    """The stamps of the commands, or of a sensor.

    Attributes:
        last: The stamp of the row that came last [ns].
        newest: The newest stamp [ns].
        hole: Where rows were missing last: none are after it [ns].
        usual: The usual interval [ns]; 0 before any.
        in_order: How many rows in a row have come in order.
        in_a_row: How many rows in a row go on behind the newest one where there were rows.
        since: Which event of all was the first of these.
        event: Which one was the last row.
        back: By how much they are set back [ns].
        at: The newest stamp then [ns].
        told: The ``since`` that was told of.
    """

    last: int = ALWAYS
    newest: int = ALWAYS
    hole: int = ALWAYS
    usual: float = 0.0
    in_order: int = 0
    in_a_row: int = 0
    since: int = 0
    event: int = 0
    back: float = 0.0
    at: int = ALWAYS
    told: int = 0

    def take(self, stamp: int, event: int) -> None:
        """Take the stamp [ns] of the next row, which is the ``event``-th of all."""
        step, self.last, self.event = stamp - self.last, stamp, event
        if stamp > self.newest:
            if 0 < step <= _MOST * self.usual:
                self.usual += (step - self.usual) / _FEW
            elif self.usual or self.newest == ALWAYS:
                self.hole, self.usual = stamp, _SLOWER * self.usual
            else:
                self.usual = step
            self.newest, self.in_order, self.in_a_row = stamp, self.in_order + 1, 0
            return
        if step < 0 and self.in_order >= _FEW and stamp > self.hole:
            self.in_a_row, self.since, self.back, self.at = 1, event, self.usual - step, self.newest
        elif self.in_a_row and _LEAST * self.usual <= step <= _MOST * self.usual and stamp < self.newest:
            self.in_a_row += 1
        else:
            self.in_a_row = 0
        self.in_order = 0

    def went_on(self, since: int) -> bool:
        """Whether its last row, since an event, is its newest."""
        return self.event >= since and self.last == self.newest

    def went_back(self, since: int) -> bool:
        """Whether its last row, since an event, is behind its newest; or before it, if it goes on behind."""
        return self.last < self.newest and (self.event >= since or self.in_a_row > 0)


class SetBack:
    """Looks at all sources of a stream for clocks that are set back."""

    def __init__(self, sensors: int) -> None:
        """Nothing has come yet."""
        self._count = sensors
        self.restart()

    def restart(self) -> None:
        """Begin anew by another clock."""
        self._sources, self._events = [_Source() for _ in range(self._count + 1)], 0

    def take(self, source: int, stamp: int) -> bool:
        """Take the stamp [ns] of the next event of ``COMMAND`` or a sensor; whether it is worth to ask for more."""
        self._events += 1
        one, commands = self._sources[source], self._sources[-1]
        one.take(stamp, self._events)
        return one.in_a_row > 0 or commands.in_a_row > 0

    @property
    def commands(self) -> int:
        """How many commands in a row go on behind the newest one."""
        return self._sources[-1].in_a_row

    def of_all(self) -> float:
        """By how much all clocks were set back [ns], once that shows; else 0."""
        *sensors, commands = self._sources
        went_on = any(one.went_on(commands.since) and commands.back > one.usual > 0.0 for one in sensors)
        went_back = any(one.went_back(commands.since) for one in sensors)
        shows = commands.in_a_row >= (_COMMANDS if went_back else _ALONE) and not went_on
        return commands.back if shows else 0.0

    def of_sensor(self, sensor: int) -> float:
        """By how much the clock of a sensor alone was set back [ns], once, when that shows; else 0."""
        one, commands = self._sources[sensor], self._sources[-1]
        if one.in_a_row < _ROWS or one.told == one.since or not commands.went_on(one.since):
            return 0.0
        one.told = one.since
        return one.back if abs(one.at - commands.at) > one.back else 0.0
