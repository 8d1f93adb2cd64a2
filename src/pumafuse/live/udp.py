"""Datagrams: those of lines that come in, and those of estimates that go out.

What waits is bounded: of datagrams that are too many the oldest are let go and counted, and so are those that the
system let go before.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Callable

from ..errors import RunError
from .address import Allowed, Place, receiver, shown
from .sampler import Sampler
from .sources import QUIET

_LARGEST = 65_536  # bytes of a datagram
_MOST_WAITING = 65_536  # datagrams
_MOST_BYTES = 16 << 20  # of waiting datagrams
_MOST_AT_ONCE = 64  # datagrams taken in before the socket is emptied again: about a ms of work
_ROOM = 8 << 20  # bytes that the system is asked to keep for a socket; it may give less
_SO_MEMINFO, _DROPS = 55, 8  # Linux: a socket's counters, and which of them counts what found no room


class Udp:
    """Datagrams of one or more lines."""

    def __init__(self, place: Place, allowed: Allowed, say: Callable[[str], None]) -> None:
        """Not open yet."""
        self._place, self._allowed, self._say, self._log = place, allowed, say, Sampler(say)
        self._waiting, self._bytes = deque[bytes](), 0
        self._some = asyncio.Event()
        self._came = self._let_go = self._dropped = self._refused = self._told = 0
        self._next_look = 0.0

    async def start(self) -> None:
        """Open the socket."""
        family, place = self._place
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _ROOM)
            self._socket.bind(place)
        except OSError as error:
            self._socket.close()
            raise RunError(f"udp://{shown(*place)}: cannot be listened at: {error.strerror}") from None
        self._name = f"udp://{shown(*self._socket.getsockname()[:2])}"
        self._say(f"listening at {self._name}")
        asyncio.get_running_loop().add_reader(self._socket, self._empty)

    async def get(self) -> list[bytes]:
        """The lines of some datagrams."""
        if self._waiting:
            await asyncio.sleep(0)  # the socket is emptied first
        else:
            self._some.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(QUIET):
                    await self._some.wait()
        self._tell_drops()
        return self._lines(_MOST_AT_ONCE)

    async def stop(self) -> list[bytes]:
        """Close the socket."""
        asyncio.get_running_loop().remove_reader(self._socket)
        self._empty()
        self._lost()  # for the last time
        self._socket.close()
        return self._lines(_MOST_WAITING)

    def told(self) -> str:
        """How many came, and how many were lost or refused."""
        said = f"{self._name}: {self._came - self._let_go} datagrams taken in, {self._lost()} lost"
        return f"{said}, {self._refused} refused" if self._refused else said

    def _lines(self, most: int) -> list[bytes]:
        """The lines of at most so many datagrams."""
        lines: list[bytes] = []
        for _ in range(min(len(self._waiting), most)):
            datagram = self._waiting.popleft()
            self._bytes -= len(datagram)
            lines += datagram.split(b"\n")
        return lines

    def _empty(self) -> None:
        """Take what has come out of the system's hands."""
        for _ in range(1024):
            try:
                datagram, sender = self._socket.recvfrom(_LARGEST)
            except OSError:  # there is no more
                break
            if not self._allowed(sender[0]):
                self._refused += 1
                self._log.say("refused", f"a datagram from {sender[0]}, which --allow does not name: refused")
                continue
            self._came += 1
            self._waiting.append(datagram)
            self._bytes += len(datagram)
            while len(self._waiting) > _MOST_WAITING or self._bytes > _MOST_BYTES:
                self._bytes -= len(self._waiting.popleft())
                self._let_go += 1
        self._some.set()

    def _lost(self) -> int:
        """How many datagrams found no room, here or in the system."""
        if sys.platform == "linux" and self._socket.fileno() >= 0:
            with contextlib.suppress(OSError):
                counters = struct.unpack("=9I", self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 36))
                self._dropped = counters[_DROPS]
        return self._let_go + self._dropped

    def _tell_drops(self) -> None:
        """Say now and then that datagrams are lost."""
        if (now := time.monotonic()) >= self._next_look:
            self._next_look = now + 1.0
            if (lost := self._lost()) > self._told:
                self._told = lost
                self._log.say("lost", f"{self._name}: {lost} datagrams came faster than they were taken in: lost")


class Out:
    """Estimates as datagrams, one each; nobody needs to be there."""

    def __init__(self, text: str) -> None:
        """A socket to send to ``udp://HOST:PORT``.

        Raises:
            ConfigError: It is no such address.
        """
        family, self._place = receiver(text)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._text, self._lost = text, 0

    def __call__(self, lines: list[bytes]) -> None:
        """Send lines; what the system does not take is counted."""
        for line in lines:
            try:
                self._socket.sendto(line, self._place)
            except OSError:  # no room, no way there, or too long: the next one may get through
                self._lost += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def told(self) -> str:
        """How many could not be sent; empty for none."""
        return f"{self._text}: {self._lost} estimates could not be sent" if self._lost else ""
