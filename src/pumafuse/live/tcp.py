"""Lines over TCP: from all who connect, or from a server.

What waits is bounded: a sender that is too fast is slowed down, as its connection is not read any more.
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Callable

from ..errors import RunError
from .address import Address, Allowed, Place, shown
from .lines import Lines
from .sampler import Sampler
from .sources import QUIET

_LARGEST = 65_536  # bytes of a piece of a connection
_MOST_CONNECTIONS = 256
_MOST_PIECES = 16
_FIRST_WAIT, _LONGEST_WAIT = 0.5, 30.0  # s until a connection is tried again
_PATIENCE = 10.0  # s for a connection to be made


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
        """Read one who has connected to the end, unless it may not be heard or too many are."""
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
        """Connect and read, again and again, with waits that double as long as nothing comes."""
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


def _keep_alive(connection: socket.socket) -> None:
    """Find within half a minute that the other side is gone without a word."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 4)):
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
