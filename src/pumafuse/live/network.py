"""Sources on the network, over UDP and TCP, and estimates sent as datagrams.

Datagrams wait in a :mod:`.backlog`; those that the system dropped before are counted, too. A TCP sender of lines that
is too fast is slowed down: its connection is not read any more.
"""

from __future__ import annotations

import contextlib
import os
import queue
import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeAlias

from ..errors import PumafuseError, RunError
from .address import Address, Allowed, SocketAddress, host_port, listener, receiver
from .backlog import Backlog
from .rate_limit import RateLimitedLog
from .sources import QUIET
from .wire import Event, Lines

_LARGEST = 65_536  # bytes of a datagram, or of a piece of a connection
_MOST_RECEIVED, _MOST_LEFT = 1024, 65_536  # datagrams that are read from the socket at once, and at the end
_RECEIVE_BUFFER = 8 << 20  # bytes that the system is asked to keep for a socket; it may give less
_SO_MEMINFO, _DROPS = 55, 8  # Linux: a socket's counters, and the place of the one of dropped datagrams
_MOST_CONNECTIONS = 256
_MOST_PIECES = 16  # of all connections that wait
_HANDED_OVER = 0.02  # s in which a thread that waited for room hands over its piece
_FIRST_WAIT, _LONGEST_WAIT = 0.5, 30.0  # s until a connection is tried again
_PATIENCE = 10.0  # s for a connection to be made
_SILENT = RateLimitedLog(lambda _: None)  # at the end: a thread that writes while the process ends would stop it

Items: TypeAlias = Sequence[bytes | Event]


def source(address: Address, listen: str | None, allow: list[str], notify: Callable[[str], None]) -> Remote:
    """The source of an address."""
    if address.kind == "tcp":
        return TcpClient(address, notify)
    address_of_socket, allowed = listener(address, listen, allow)
    if listen is not None:
        accepted = f"{address.kind}: accepts {', '.join(allow)} on {host_port(*address_of_socket[1])}"
        notify(f"{accepted}, neither encrypted nor authenticated; a tunnel should carry what leaves the cell")
    return (UdpListener if address.kind == "udp" else TcpListener)(address_of_socket, allowed, notify)


class UdpListener:
    """Lines from datagrams of one or more lines."""

    def __init__(self, socket_address: SocketAddress, allowed: Allowed, notify: Callable[[str], None]) -> None:
        self._address, self._allowed = socket_address, allowed
        self._notify, self._log = notify, RateLimitedLog(notify)
        self._backlog = Backlog[bytes]("datagrams", self._log)
        self._room = memoryview(bytearray(_LARGEST))  # of the next one: to make it each time scatters memory
        self._dropped_before = self._refused = self._reported = 0

    def start(self) -> None:
        """Open the socket."""
        self._socket = socket.socket(self._address[0], socket.SOCK_DGRAM)
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        self._name = self._backlog.name = _listen(self._socket, "udp", self._address[1], self._notify)
        self._socket.setblocking(False)

    def get(self) -> list[bytes]:
        """The lines of some datagrams; none after a tenth of a second without any."""
        if not self._backlog:
            select.select([self._socket], [], [], QUIET)
        self._receive(_MOST_RECEIVED)
        if (lost := self._count_lost()) > self._reported:
            self._reported = lost
            self._log.write("lost", f"{self._name}: {lost} datagrams came faster than they were taken in: lost")
        return _lines(self._backlog.take(time.monotonic()))

    def stop(self) -> list[bytes]:
        """Close the socket, and return the lines that have come and were not given yet."""
        self._receive(_MOST_LEFT)
        self._count_lost()  # for the last time
        self._socket.close()
        return _lines(self._backlog.take_all())

    def summary(self) -> str:
        """How many came, and how many were lost or refused."""
        waited = self._backlog
        taken = waited.received - waited.dropped - waited.shed
        text = f"{self._name}: {taken} datagrams taken in, {self._count_lost()} lost{waited.shed_words}"
        return f"{text}, {self._refused} refused" if self._refused else text

    def _receive(self, most: int) -> None:
        """Read at most so many datagrams from the socket, which is to be empty soon: the system keeps few."""
        now = time.monotonic()
        for _ in range(most):
            try:
                size, sender = self._socket.recvfrom_into(self._room)
            except OSError:  # there is no more
                return
            if not self._allowed(sender[0]):
                self._refused += 1
                self._log.write("refused", f"a datagram from {sender[0]}, which --allow does not name: refused")
                continue
            self._backlog.add(now, bytes(self._room[:size]))

    def _count_lost(self) -> int:
        """How many datagrams were dropped, here or by the system."""
        if sys.platform == "linux" and self._socket.fileno() >= 0:
            with contextlib.suppress(OSError):
                counters = struct.unpack("=9I", self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 36))
                self._dropped_before = counters[_DROPS]
        return self._backlog.dropped + self._dropped_before


def _lines(datagrams: list[bytes]) -> list[bytes]:
    return [line for datagram in datagrams for line in datagram.split(b"\n")]


class _Merged:
    """What several threads put together, in the order in which it comes; they wait where it is too much."""

    def __init__(self) -> None:
        self._pieces = queue.Queue[Items](_MOST_PIECES)

    def add(self, items: Items) -> None:
        """Add what a thread has; it waits where there is no room."""
        self._pieces.put(items)

    def get(self) -> Items:
        """Items of one thread; none after a tenth of a second without any."""
        try:
            return self._pieces.get(timeout=QUIET)
        except queue.Empty:
            return []

    def take_all(self) -> Items:
        """What has come and was not given yet; the threads end with the process."""
        left = list[bytes | Event]()
        with contextlib.suppress(queue.Empty):
            for _ in range(_MOST_PIECES + _MOST_CONNECTIONS):  # and one that each thread holds; a flood has no end
                left += self._pieces.get(timeout=_HANDED_OVER)
        return left


def _read_lines(
    connection: socket.socket, put: Callable[[list[bytes]], None], heard: Callable[[], object] = lambda: None
) -> bool:
    """Read a connection to its end, a last line without its end, too; whether there was anything."""
    lines, some = Lines(), False
    with connection, contextlib.suppress(OSError):
        _keep_alive(connection)
        while piece := connection.recv(_LARGEST):
            if not some:
                heard()
            some = True
            if whole := lines.cut(piece):
                put(whole)
    if remainder := lines.take_last():
        put(remainder)
    return some


class TcpListener(_Merged):
    """Lines from all who connect."""

    def __init__(self, socket_address: SocketAddress, allowed: Allowed, notify: Callable[[str], None]) -> None:
        super().__init__()
        self._address, self._allowed = socket_address, allowed
        self._notify, self._log = notify, RateLimitedLog(notify)
        self._open, self._silent = set[socket.socket](), dict[socket.socket, None]()
        self._accepted = self._refused = 0

    def start(self) -> None:
        """Listen."""
        self._socket = socket.socket(self._address[0], socket.SOCK_STREAM)
        if os.name == "posix":  # elsewhere two could listen at one port
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._name = _listen(self._socket, "tcp-listen", self._address[1], self._notify)
        _in_a_thread(self._accept_all)

    def stop(self) -> Items:
        """What has come and was not given yet; the connections end with the process."""
        self._log = _SILENT
        return self.take_all()

    def summary(self) -> str:
        """How many connections there were and are."""
        text = f"{self._name}: connections: {self._accepted}, {len(self._open)} open"
        return f"{text}, {self._refused} refused" if self._refused else text

    def _accept_all(self) -> None:
        """Read all connections, but not of senders that are not allowed, nor too many at once."""
        while True:
            try:
                connection, (peer, *_) = self._socket.accept()
            except OSError:  # it has gone already, or the process may not have more
                time.sleep(QUIET)
                continue
            why = "" if self._allowed(peer) else "--allow does not name it"
            if not why and len(self._open) >= _MOST_CONNECTIONS and not self._end_a_silent_one():
                why = f"{_MOST_CONNECTIONS} are open"
            if why:
                self._refused += 1
                self._log.write("refused", f"a connection from {peer}: refused, {why}")
                connection.close()
                continue
            self._accepted += 1
            self._log.write("connected", f"{peer} has connected")
            self._open.add(connection)
            self._silent[connection] = None
            _in_a_thread(self._serve, connection, peer)

    def _end_a_silent_one(self) -> bool:
        """End the oldest connection on which nothing has come yet; whether there was one."""
        for connection in tuple(self._silent):
            if self._silent.pop(connection, True) is None:
                self._open.discard(connection)
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
                return True
        return False

    def _serve(self, connection: socket.socket, peer: str) -> None:
        _read_lines(connection, self.add, lambda: self._silent.pop(connection, None))
        self._silent.pop(connection, None)
        self._open.discard(connection)
        self._log.write("gone", f"the connection from {peer} has ended")


class _Client:
    """A connection to a server, made again whenever it ends."""

    def __init__(self, address: Address, notify: Callable[[str], None]) -> None:
        self._name, self._log = address.text, RateLimitedLog(notify)
        self._address = (address.host, address.port)
        self._made, self._open = 0, False
        self._stopped = threading.Event()

    def start(self) -> None:
        """Begin to connect."""
        _in_a_thread(self._stay_connected)

    def summary(self) -> str:
        """How often the connection was made, and whether it is there."""
        return f"{self._name}: connections made: {self._made}, {'open' if self._open else 'none open'}"

    def _end(self) -> None:
        """Make no connection any more, and be silent; one that is open ends with the process."""
        self._stopped.set()
        self._log = _SILENT

    def _stay_connected(self) -> None:
        """Connect and read, again and again, with waits that double as long as nothing comes."""
        wait = _FIRST_WAIT
        while not self._stopped.is_set():
            try:
                connection = socket.create_connection(self._address, _PATIENCE)
            except (OSError, UnicodeError) as error:
                reason = getattr(error, "strerror", None) or "no answer"
                self._log.write("unreachable", f"{self._name}: cannot be reached: {reason}; tried again in {wait:g} s")
            else:
                connection.settimeout(None)
                self._made, self._open = self._made + 1, True
                self._log.write("connected", f"{self._name}: connected")
                if self._read(connection):
                    wait = _FIRST_WAIT
                self._open = False
                self._log.write("ended", f"{self._name}: the connection has ended; made again in {wait:g} s")
            self._stopped.wait(wait)
            wait = min(2.0 * wait, _LONGEST_WAIT)

    def _read(self, connection: socket.socket) -> bool:
        """Read a connection to its end, and close it; whether there was anything."""
        raise NotImplementedError


class TcpClient(_Client):
    """Lines from a server."""

    def __init__(self, address: Address, notify: Callable[[str], None]) -> None:
        super().__init__(address, notify)
        self._merged = _Merged()

    def get(self) -> Items:
        """Some lines; none after a tenth of a second without any."""
        return self._merged.get()

    def stop(self) -> Items:
        """What has come and was not given yet; no connection is made any more."""
        self._end()
        return self._merged.take_all()

    def _read(self, connection: socket.socket) -> bool:
        return _read_lines(connection, self._merged.add)


class Refused(Exception):  # noqa: N818 - what a server does, and never leaves the thread that reads
    """A server sends what it should not, or does not do what it was asked; the text says what."""


class EventClient(_Client):
    """Events of a server that does not speak in lines; what comes faster than it is taken in waits in a backlog."""

    REFUSED = ""  # before the reason why nothing is read any more

    def __init__(self, address: Address, notify: Callable[[str], None]) -> None:
        super().__init__(address, notify)
        self._backlog = Backlog[Event]("events", self._log, self._name)
        self._came = threading.Condition()

    def get(self) -> list[Event]:
        """Some events in the order in which they came; none after a tenth of a second without any."""
        with self._came:
            if not self._backlog:
                self._came.wait(QUIET)
            return self._backlog.take(time.monotonic())

    def stop(self) -> list[Event]:
        """The events that have come and were not given yet; no connection is made any more."""
        self._end()
        with self._came:
            return self._backlog.take_all()

    def summary(self) -> str:
        """How often the connection was made, how many events came, and how many were lost."""
        waited = self._backlog
        return f"{super().summary()}; {waited.received} events, {waited.dropped} lost{waited.shed_words}"

    def _read(self, connection: socket.socket) -> bool:
        some = False
        with connection, contextlib.suppress(OSError):
            _keep_alive(connection)
            try:
                for events in self._receive(connection):
                    now = time.monotonic()
                    with self._came:
                        for event in events:
                            self._backlog.add(now, event)
                        self._came.notify()
                    some = True
            except (Refused, PumafuseError, struct.error) as error:
                self._log.write("refused", f"{self._name}: {self.REFUSED}{error}")
        return some

    def _receive(self, connection: socket.socket) -> Iterator[list[Event]]:
        """The events of each message; what is refused, or too short, is raised as Refused or struct.error."""
        raise NotImplementedError


class Remote(Protocol):
    """A source that is listened to until the end is asked for."""

    def start(self) -> None:
        """Begin to listen; a PumafuseError where that cannot be."""

    def get(self) -> Items:
        """Some lines or events; none after a tenth of a second without any."""
        ...

    def stop(self) -> Items:
        """The items that have come and were not given yet."""
        ...

    def summary(self) -> str:
        """How many came."""
        ...


class Several(_Merged):
    """Sources, as a robot's controller and a tracker, each asked by a thread of its own."""

    def __init__(self, sources: Sequence[Remote]) -> None:
        super().__init__()
        self._sources, self._ended = sources, threading.Event()
        self._error: Exception | None = None

    def start(self) -> None:
        """Begin to listen."""
        for source in self._sources:
            source.start()
        self._threads = [_in_a_thread(self._ask, source) for source in self._sources]

    def get(self) -> Items:
        """Items of one source; none after a tenth of a second without any. What a source has raised is raised."""
        if self._error is not None:
            raise self._error
        return super().get()

    def stop(self) -> Items:
        """The items that have come and were not given yet."""
        self._ended.set()
        left = list[bytes | Event]()
        while any(thread.is_alive() for thread in self._threads) or not self._pieces.empty():
            left += super().get()
        return [*left, *(item for source in self._sources for item in source.stop())]

    def summary(self) -> str:
        """How many came from each."""
        return "; ".join(filter(None, (source.summary() for source in self._sources)))

    def _ask(self, source: Remote) -> None:
        try:
            while not self._ended.is_set():
                if items := source.get():
                    self.add(items)
        except Exception as error:  # it is the thread that takes what comes that is to end by it
            self._error = error


def _listen(listening: socket.socket, kind: str, address: tuple[str, int], notify: Callable[[str], None]) -> str:
    """Let a socket listen; returns its address as people write it."""
    try:
        listening.bind(address)
        if kind == "tcp-listen":
            listening.listen()
    except OSError as error:
        listening.close()
        raise RunError(f"{kind}://{host_port(*address)}: cannot be listened at: {error.strerror}") from None
    name = f"{kind}://{host_port(*listening.getsockname()[:2])}"
    notify(f"listening at {name}")
    return name


def _in_a_thread(work: Callable[..., None], *arguments: object) -> threading.Thread:
    """Do what may wait for long in a thread that ends with the process."""
    thread = threading.Thread(target=work, args=arguments, name="network", daemon=True)
    thread.start()
    return thread


def _keep_alive(connection: socket.socket) -> None:
    """Find within half a minute that the other side is gone without a word."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 4)):
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class UdpSender:
    """Sender of estimates as datagrams of one line each, whether anybody receives them or not."""

    def __init__(self, text: str) -> None:
        family, self._address = receiver(text)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._text, self._lost = text, 0

    def __call__(self, lines: list[bytes]) -> None:
        """Send lines; what the system does not take is counted."""
        for line in lines:
            try:
                self._socket.sendto(line, self._address)
            except OSError:  # no room, no way there, or too long: the next one may get through
                self._lost += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def summary(self) -> str:
        """How many could not be sent; empty for none."""
        return f"{self._text}: {self._lost} estimates could not be sent" if self._lost else ""
