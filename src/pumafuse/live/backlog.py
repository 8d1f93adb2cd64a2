"""What has come and waits to be taken in: bounded, and shed where it gets older and older.

Of too many the oldest are dropped and counted. Where those that wait get older and older, measurements are shed, oldest
first; commands are not.
"""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

from .rate_limit import RateLimitedLog
from .wire import Event

_MOST = 65_536  # items that wait
_MOST_BYTES = 16 << 20  # of waiting items
_MOST_AT_ONCE = 64  # items handed out until the next ones are let in: about a ms of work
_EVENT_BYTES = 500  # of an event, about
_COMMAND = b'"command"'  # in a datagram with a command
_OLD, _FRESH = 0.2, 0.05  # s for which an item waits until that is said, and to which what waits is shed
_BEHIND = 2.0  # s for which some wait for longer, and do not catch up by half, until they are shed
_AGAIN = 10.0  # s after that in which they are shed at once

T = TypeVar("T", bytes, Event)


class Backlog(Generic[T]):
    """Datagrams or events that wait."""

    def __init__(self, what: str, log: RateLimitedLog, name: str = "") -> None:
        """Nothing waits of ``what``, in the plural, that comes from ``name``."""
        self.what, self.name = what, name
        self.received = self.dropped = self.shed = 0  # dropped: as too many waited; shed: as they waited for too long
        self._log = log
        self._waiting, self._bytes = deque[tuple[float, T]](), 0  # when each came [s], and what
        self._since, self._oldest = 0.0, 0.0  # since when they are old, how old they were at most [s]
        self._shed_at = -_AGAIN  # when last [s]

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def shed_words(self) -> str:
        """How many were shed, for the end of a sentence."""
        return f", {self.shed} shed" if self.shed else ""

    def add(self, now: float, item: T) -> None:
        """Add an item that has come at ``now`` [s]."""
        self.received += 1
        self._waiting.append((now, item))
        self._bytes += _size(item)
        while len(self._waiting) > _MOST or self._bytes > _MOST_BYTES:
            self._bytes -= _size(self._waiting.popleft()[1])
            self.dropped += 1

    def take(self, now: float) -> list[T]:
        """The oldest items, at ``now`` [s]; that they wait for long is said, and where it goes on, some are shed."""
        self._keep_up(now)
        taken = [self._waiting.popleft()[1] for _ in range(min(len(self._waiting), _MOST_AT_ONCE))]
        self._bytes -= sum(map(_size, taken))
        return taken

    def take_all(self) -> list[T]:
        """All that wait."""
        taken = [item for _, item in self._waiting]
        self._waiting.clear()
        self._bytes = 0
        return taken

    def _keep_up(self, now: float) -> None:
        """Say that items wait for long, and shed measurements where that goes on."""
        age = now - self._waiting[0][0] if self._waiting else 0.0
        if age < _OLD:
            self._since = 0.0
            return
        if not self._since:
            self._since, self._oldest = now, age
            self._log.write("behind", f"{self.name}: {self.what} wait for {age:.2f} s: estimates are as late")
        self._oldest = max(self._oldest, age)
        patience = 0.0 if now - self._shed_at < _AGAIN else _BEHIND
        if now - self._since < patience or age < 0.5 * self._oldest:
            return
        kept = [waiting for waiting in self._waiting if waiting[0] > now - _FRESH or _is_command(waiting[1])]
        self.shed += len(self._waiting) - len(kept)
        self._waiting, self._bytes = deque(kept), sum(_size(item) for _, item in kept)
        self._since, self._oldest, self._shed_at = 0.0, 0.0, now
        self._log.write(
            "shed",
            f"{self.name}: {self.what} waited for {age:.2f} s, longer and longer: {self.shed} of measurements shed so"
            " far, the oldest first; a smaller --window takes less time for rows that come late",
        )


def _size(item: bytes | Event) -> int:
    return len(item) if isinstance(item, bytes) else _EVENT_BYTES


def _is_command(item: bytes | Event) -> bool:
    return _COMMAND in item if isinstance(item, bytes) else not item.sensor
