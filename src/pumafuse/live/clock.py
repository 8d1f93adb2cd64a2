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
from typing import TypeAlias

import numpy as np

from ..arrays import REACH_NS
from ..fusion.segments import LONGEST_TAIL_NS

Time: TypeAlias = float | int  # float seconds, or int nanoseconds

LEAST_NS = 1_000_000_000  # a window is no shorter: the stamps of several senders differ, and commands may pause
RESET_AFTER = 3  # commands in a row that have another time: the clock was reset


def nanoseconds(t: Time) -> int:
    """Int ns of float seconds or int nanoseconds.

    Raises:
        ValueError: No finite number, or out of reach of int64 ns; says which.
    """
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
    """The newest stamp of a stream, and whether it is in doubt.

    Attributes:
        window: How far a stamp may be behind the newest one, or ahead of it without a doubt [ns]: one limit, or what
            is plainly right ahead would put all others too far behind. At least a second.
        newest: The newest stamp that is accepted, int ns; None at first.
        low: Stamps from here …
        high: … to here are plainly right [ns]; none is while there is a doubt.
        other: Stamps of the commands in a row that have another time.
        ahead_of: Whose stamp raised the latest doubt: a sensor's name, None for a command.
    """

    def __init__(self, window: int) -> None:
        """Begin without a time."""
        self.window = max(window, LEAST_NS)
        self.newest: int | None = None
        self.low, self.high = 1, 0
        self.ahead_of: str | None = None
        self._sure: int | None = None  # the newest stamp before a jump ahead that is still in doubt
        self._jumped, self._commands = 0, 0  # where it jumped to, and how many commands have confirmed it
        self.other: list[int] = []

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
        return self._agrees(stamp, source, self._commands + (source is None))

    def _agrees(self, stamp: int, source: str | None, commands: int) -> bool:
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

    def confirm(self) -> None:
        """Forget commands that had another time, as one has come that is plainly right."""
        self.other = []

    def judge(self, stamp: int, source: str | None) -> Verdict:
        """Judge a stamp that is not between ``low`` and ``high``, and move on to it if it is accepted.

        Args:
            stamp: Int ns.
            source: The sensor that gave it; None for a command.
        """
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
        if self._sure is None or self._agrees(stamp, source, self._commands):
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
