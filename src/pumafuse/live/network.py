"""Events from the network, and estimates into it: datagrams, and lines over TCP.

What waits is bounded. A TCP sender that is too fast is slowed down, as its connection is not read any more; of
datagrams that are too many the oldest are let go and counted, and so are those that the system let go before.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

from ..errors import RunError
from .address import Address, Place, bound, receiver, shown
from .lines import Lines
from .sampler import Sampler
from .sources import QUIET

_LARGEST = 65_536  # bytes of a datagram, and of a piece of a connection
_MOST_WAITING = 65_536  # datagrams
_MOST_BYTES = 16 << 20  # of waiting datagrams
_MOST_AT_ONCE = 64  # datagrams taken in before the socket is emptied again: about a ms of work
_ROOM = 8 << 20  # bytes that the system is asked to keep for a socket; it may give less
_SO_MEMINFO, _DROPS = 55, 8  # Linux: a socket's counters, and which of them counts what found no room
_MOST_CONNECTIONS = 256
_MOST_PIECES = 16
_FIRST_WAIT, _LONGEST_WAIT = 0.5, 30.0  # s until a connection is tried again
_PATIENCE = 10.0  # s for a connection to be made

Allowed = Callable[[str], bool]


class Source(Protocol):
    """Lines from the network."""

    async def start(self) -> None:
        """Be there.

        Raises:
            RunError: The system refuses.
        """
        ...

    async def get(self) -> list[bytes]:
        """The next lines; none after a tenth of a second without any."""
        ...

    async def stop(self) -> list[bytes]:
        """Be gone; the lines that have come and were not given yet."""
        ...

    def told(self) -> str:
        """What there was, in a sentence."""
        ...


def source(address: Address, listen: str | None, allow: list[str], say: Callable[[str], None]) -> Source:
    """The source of an address.

    Args:
        address: Of kind ``udp``, ``tcp-listen`` or ``tcp``.
        listen: See :func:`pumafuse.live.address.bound`.
        allow: As well.
        say: Takes a sentence for the log.

    Raises:
        ConfigError: The address may not be listened on.
    """
    if address.kind == "tcp":
        return Client(address, say)
    place, allowed = bound(address, listen, allow)
    if listen is not None:
        say(
            f"{address.kind}: heard on {shown(*place[1])} from {', '.join(allow)}, neither encrypted nor authenticated;"
            " a tunnel should carry what leaves the cell"
        )
    return (Udp if address.kind == "udp" else Server)(place, allowed, say)


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


class _Tcp:
    """Connections whose lines come together, in the order in which they come in."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._log = say, Sampler(say)
        self._pieces = asyncio.Queue[list[bytes]](_MOST_PIECES)

    async def get(self) -> list[bytes]:
        """Some lines of one connection."""
        try:
            return self._pieces.get_nowait()
        except asyncio.QueueEmpty:
            pass
        try:
            async with asyncio.timeout(QUIET):
                return await self._pieces.get()
        except TimeoutError:
            return []

    def _left(self) -> list[bytes]:
        """Lines that have come and were not given."""
        lines: list[bytes] = []
        while not self._pieces.empty():
            lines += self._pieces.get_nowait()
        return lines

    async def _read(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        """All lines of a connection until it ends, a last one without its end, too; whether there was anything."""
        lines, some = Lines(), False
        try:
            _keep_alive(writer.get_extra_info("socket"))
            while piece := await reader.read(_LARGEST):
                some = True
                if whole := lines.cut(piece):
                    await self._pieces.put(whole)
        except OSError:
            pass
        finally:
            writer.close()
        if rest := lines.rest():
            await self._pieces.put(rest)
        return some


class Server(_Tcp):
    """Lines from all who connect."""

    def __init__(self, place: Place, allowed: Allowed, say: Callable[[str], None]) -> None:
        """Not open yet."""
        super().__init__(say)
        self._place, self._allowed = place, allowed
        self._open = set[asyncio.Task[None]]()
        self._connections = self._refused = 0

    async def start(self) -> None:
        """Listen."""
        family, place = self._place
        try:
            self._server = await asyncio.start_server(self._meet, *place, family=family, limit=_LARGEST)
        except OSError as error:
            reason = error.strerror or str(error)
            raise RunError(f"tcp-listen://{shown(*place)}: cannot be listened at: {reason}") from None
        self._name = f"tcp-listen://{shown(*self._server.sockets[0].getsockname()[:2])}"
        self._say(f"listening at {self._name}")

    async def stop(self) -> list[bytes]:
        """Close all connections."""
        self._server.close()
        for task in self._open:
            task.cancel()
        await asyncio.gather(*self._open)
        return self._left()

    def told(self) -> str:
        """How many connections there were and are."""
        said = f"{self._name}: connections: {self._connections}, {len(self._open)} open"
        return f"{said}, {self._refused} refused" if self._refused else said

    async def _meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = str((writer.get_extra_info("peername") or ("somewhere",))[0])
        why = "" if self._allowed(peer) else "--allow does not name it"
        why = f"{_MOST_CONNECTIONS} are open" if not why and len(self._open) >= _MOST_CONNECTIONS else why
        if why:
            self._refused += 1
            self._log.say("refused", f"a connection from {peer}: refused, {why}")
            writer.transport.abort()
            return
        self._connections += 1
        self._log.say("connected", f"{peer} has connected")
        task = asyncio.current_task()
        assert task is not None
        self._open.add(task)
        try:
            await self._read(reader, writer)
        except asyncio.CancelledError:  # at the end; asyncio would log a task that was cancelled
            return
        finally:
            self._open.discard(task)
        self._log.say("gone", f"the connection from {peer} has ended")


class Client(_Tcp):
    """Lines from a server, to which the connection is made again whenever it ends."""

    def __init__(self, address: Address, say: Callable[[str], None]) -> None:
        """Not connected yet."""
        super().__init__(say)
        self._address, self._name = address, address.text
        self._made, self._connected = 0, False

    async def start(self) -> None:
        """Begin to try."""
        self._task = asyncio.create_task(self._keep_connected())

    async def stop(self) -> list[bytes]:
        """Close the connection."""
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        return self._left()

    def told(self) -> str:
        """How often the connection was made, and whether it is there."""
        return f"{self._name}: connections made: {self._made}, {'open' if self._connected else 'none open'}"

    async def _keep_connected(self) -> None:
        wait = _FIRST_WAIT
        while True:
            try:
                async with asyncio.timeout(_PATIENCE):
                    reader, writer = await asyncio.open_connection(
                        self._address.host, self._address.port, limit=_LARGEST
                    )
            except (OSError, UnicodeError) as error:  # a TimeoutError is an OSError
                reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else "no answer"
                reason = error.strerror or reason if isinstance(error, socket.gaierror) else reason
                self._log.say("unreachable", f"{self._name}: cannot be reached: {reason}; tried again in {wait:g} s")
                await asyncio.sleep(wait)
                wait = min(2.0 * wait, _LONGEST_WAIT)
                continue
            self._made, self._connected = self._made + 1, True
            self._log.say("connected", f"{self._name}: connected")
            if await self._read(reader, writer):
                wait = _FIRST_WAIT
            self._connected = False
            self._log.say("ended", f"{self._name}: the connection has ended; made again in {wait:g} s")
            await asyncio.sleep(wait)
            wait = min(2.0 * wait, _LONGEST_WAIT)


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


def _keep_alive(connection: socket.socket) -> None:
    """Find within half a minute that the other side is gone without a word."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 4)):
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
