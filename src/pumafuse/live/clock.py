"""Clock of a stream, from its stamps alone: which are late, ahead, of another clock, or of a clock that was reset.

The commands are the master: their controller is what the arm obeys. A stamp within the window behind the newest one is
late, one that is farther behind is too late. One that is ahead of all by more than usual is accepted, since everything
may have paused, and taken back if what comes next still has the old time: if one sensor ran ahead, anything that comes;
if a command did, the next command. Three commands in a row that have another time mean that the clock was reset: the
filter starts again there.
"""

from __future__ import annotations

import enum
import operator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from ..arrays import ALWAYS, REACH_NS
from ..fusion.segments import LONGEST_TAIL_NS

Time: TypeAlias = float | int  # float seconds, or int nanoseconds

LEAST_NS = 1_000_000_000  # a window is no shorter: the stamps of several senders differ, and commands may pause
RESET_AFTER = 3  # commands in a row that have another time: the clock was reset

# So many commands in a row behind the newest show that all clocks were set back: where a sensor steps back, too, and
# where no sensor measures.
_COMMANDS, _ALONE = 3, 8
_ROWS = 5  # of a sensor in a row that are set back, until its clock is
_LEAST, _MOST = 0.5, 1.5  # of the usual interval, within which a row goes on after the one before
_FEW = 20  # intervals of which the usual one is a mean, and rows in order before those that are set back
_SLOWER = 1.1  # by a longer one the usual one grows: a source that is slower now has no holes after a while


def stamp_of(t: Time) -> int:
    """Int ns of float seconds or int nanoseconds."""
    try:
        if isinstance(t, bool):
            raise TypeError
        stamp = round(float(t) * 1e9) if isinstance(t, (float, np.floating)) else operator.index(t)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("no time: expected float seconds or int nanoseconds") from None
    if not -REACH_NS < stamp < REACH_NS:
        raise ValueError("a time out of reach: the years 1824 to 2115 are in ns since 1970")
    return stamp


class Verdict(enum.Enum):
    """What a stamp means."""

    ACCEPTED = enum.auto()
    CONTRADICTED = enum.auto()  # what ran ahead was wrong and is to be taken back
    BEHIND = enum.auto()
    AHEAD = enum.auto()
    RESET = enum.auto()  # a new segment begins


class Clock:
    """The newest stamp of a stream, and whether it is in doubt."""

    def __init__(self, window: int) -> None:
        """Begin without a time.

        How far a stamp may be behind the newest one, and ahead of it without a doubt, is one ``window`` [ns]: else what
        is plainly right ahead would put all others too far behind.
        """
        self.window = max(window, LEAST_NS)
        self.newest: int | None = None  # that is accepted [ns]
        self.low, self.high = 1, 0  # stamps within are plainly right [ns]; none is while there is a doubt
        self.ahead_of: str | None = None  # whose stamp raised the latest doubt: a sensor, None for a command
        self._sure: int | None = None  # the newest stamp before a jump ahead that is still in doubt
        self._jumped, self._commands = 0, 0  # where it jumped to, and how many commands have confirmed it
        self.other: list[int] = []  # stamps of the commands in a row that have another time, until one is plainly right

    @property
    def doubtful(self) -> bool:
        """Whether the newest stamps may have to be taken back."""
        return self._sure is not None

    @property
    def sure(self) -> int:
        """The newest stamp that nothing can take back any more, int ns."""
        assert self.newest is not None
        return self.newest if self._sure is None else self._sure

    @property
    def now(self) -> int:
        """The newest stamp that is not one sensor's alone while that is in doubt, int ns."""
        assert self.newest is not None
        return self.newest if self._sure is None or self._commands else self._sure

    @property
    def bound(self) -> int:
        """Stamps after it are in doubt [ns]."""
        return self.sure + self.window

    def ends_doubt(self, stamp: int, source: str | None) -> bool:
        """Whether a stamp that is taken shows that a jump ahead was right."""
        if self._sure is None or self.newest is None:
            return False
        if not self.newest - self.window <= stamp <= self.newest + LONGEST_TAIL_NS:
            return False
        return self._is_agreed(stamp, source, self._commands + (source is None))

    def _is_agreed(self, stamp: int, source: str | None, commands: int) -> bool:
        return commands >= 2 or (source == self.ahead_of and stamp - self._jumped >= LEAST_NS)

    def start(self, stamp: int) -> None:
        """Set the clock to ``stamp`` [ns], whatever was before."""
        self.other = []
        self.settle(stamp)

    def settle(self, newest: int) -> None:
        """Set the newest stamp [ns], without a doubt."""
        self._sure, self._commands = None, 0
        self.newest = newest
        self.low, self.high = newest - self.window, newest + self.window

    def judge(self, stamp: int, source: str | None) -> Verdict:
        """Judge a stamp that is not between ``low`` and ``high``, and move on to it if it is accepted."""
        assert self.newest is not None
        command = source is None
        if self._sure is not None and self._sure - self.window <= stamp < self.newest - self.window:
            if command or not self._commands:
                self.settle(self._sure)
                return Verdict.CONTRADICTED
            if stamp > self.bound:
                return Verdict.AHEAD
            self._sure = max(self._sure, stamp)
            return Verdict.ACCEPTED
        if stamp < self.newest - self.window or stamp > self.newest + LONGEST_TAIL_NS:
            return self._elsewhere(stamp, command)
        self.other = [] if command else self.other
        if self._sure is None and stamp > self.newest + self.window:
            self._sure, self._jumped, self._commands, self.ahead_of = self.newest, stamp, 0, source
            self.low, self.high = 1, 0
        self._commands += command
        self.newest = max(self.newest, stamp)
        if self._sure is None or self._is_agreed(stamp, source, self._commands):
            self.settle(self.newest)
        return Verdict.ACCEPTED

    def _elsewhere(self, stamp: int, command: bool) -> Verdict:
        """Judge a stamp that is too late or too far ahead: wrong, or of a clock that was reset."""
        assert self.newest is not None
        if command:
            follows = self.other and self.other[-1] < stamp <= self.other[-1] + LONGEST_TAIL_NS
            self.other = [*self.other, stamp] if follows else [stamp]
            if len(self.other) >= RESET_AFTER:
                return Verdict.RESET
        return Verdict.BEHIND if stamp < self.newest else Verdict.AHEAD


@dataclass(slots=True)
class _Source:
    """The stamps of the commands, or of a sensor."""

    last: int = ALWAYS  # the stamp of the row that came last [ns]
    newest: int = ALWAYS  # the newest stamp [ns]
    hole: int = ALWAYS  # where rows were missing last: none are after it [ns]
    usual: float = 0.0  # the usual interval [ns]; 0 before any
    in_order: int = 0  # how many rows in a row have come in order
    in_a_row: int = 0  # how many rows in a row go on behind the newest one where there were rows
    since: int = 0  # which event of all was the first of these
    event: int = 0  # which one was the last row
    back: float = 0.0  # by how much they are set back [ns]
    at: int = ALWAYS  # the newest stamp then [ns]
    reported: int = 0  # the ``since`` that was reported

    def add(self, stamp: int, event: int) -> None:
        """Add the stamp [ns] of the next row, which is the ``event``-th of all."""
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

    def has_gone_on(self, since: int) -> bool:
        """Whether its last row, since an event, is its newest."""
        return self.event >= since and self.last == self.newest

    def has_gone_back(self, since: int) -> bool:
        """Whether its last row, since an event, is behind its newest; or before it, if it goes on behind."""
        return self.last < self.newest and (self.event >= since or self.in_a_row > 0)


class SetBack:
    """Notices clocks that are set back by less than the window: their stamps go on where there were rows before.

    A row that only came late fills a hole. Where a clock was set back, one row after the other is stamped behind the
    newest one of its source at its usual interval, and nothing was missing there.
    """

    def __init__(self, sensors: int) -> None:
        self._count = sensors
        self.restart()

    def restart(self) -> None:
        """Begin anew by another clock."""
        self._sources, self._events = [_Source() for _ in range(self._count + 1)], 0

    def add(self, source: int, stamp: int) -> bool:
        """Add the stamp [ns] of the next event of ``COMMAND`` or a sensor; whether it is worth to ask for more."""
        self._events += 1
        clock, commands = self._sources[source], self._sources[-1]
        clock.add(stamp, self._events)
        return clock.in_a_row > 0 or commands.in_a_row > 0

    @property
    def commands(self) -> int:
        """How many commands in a row go on behind the newest one."""
        return self._sources[-1].in_a_row

    def of_all(self) -> float:
        """How far all clocks were set back [ns], once that shows; else 0."""
        *sensors, commands = self._sources
        went_on = any(sensor.has_gone_on(commands.since) and commands.back > sensor.usual > 0.0 for sensor in sensors)
        went_back = any(sensor.has_gone_back(commands.since) for sensor in sensors)
        shows = commands.in_a_row >= (_COMMANDS if went_back else _ALONE) and not went_on
        return commands.back if shows else 0.0

    def of_sensor(self, sensor: int) -> float:
        """How far the clock of a sensor alone was set back [ns], once, when that shows; else 0."""
        clock, commands = self._sources[sensor], self._sources[-1]
        if clock.in_a_row < _ROWS or clock.reported == clock.since or not commands.has_gone_on(clock.since):
            return 0.0
        clock.reported = clock.since
        return clock.back if abs(clock.at - commands.at) > clock.back else 0.0
