"""Lines from the network: in order, bounded, none lost unseen."""

from __future__ import annotations

import asyncio
import socket
import sys
from collections.abc import Awaitable, Callable

import pytest

import pumafuse as pf
from pumafuse.live import network
from pumafuse.live.address import Address
from pumafuse.live.network import Source, TcpClient, TcpListener, UdpListener, UdpSender

LOOPBACK = (socket.AF_INET, ("127.0.0.1", 0))


def everybody(_: str) -> bool:
    return True


def running(source: Source, work: Callable[[], Awaitable[None]]) -> None:
    """Do something while a source is there; half a minute is too long for anything here."""

    async def both() -> None:
        async with asyncio.timeout(30.0):
            await source.start()
            try:
                await work()
            finally:
                await source.stop()

    asyncio.run(both())


async def until(source: Source, enough: Callable[[list[bytes]], bool]) -> list[bytes]:
    """Lines as they come, until there are enough."""
    lines: list[bytes] = []
    while not enough(lines):
        lines += await source.get()
    return lines


def port_of(notices: list[str]) -> int:
    return int(next(text for text in notices if "listening at" in text).rsplit(":", 1)[1])


def sender(host: str = "127.0.0.1") -> socket.socket:
    ours = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ours.bind((host, 0))
    return ours


class TestUdpListener:
    def setup_method(self) -> None:
        self.notices: list[str] = []
        self.source = UdpListener(LOOPBACK, everybody, self.notices.append)

    def send(self, datagrams: list[bytes], host: str = "127.0.0.1") -> None:
        with sender(host) as ours:
            for datagram in datagrams:
                ours.sendto(datagram, ("127.0.0.1", port_of(self.notices)))

    def test_datagrams_are_lines(self) -> None:
        """One line or several a datagram, in their order; silence is no lines."""

        async def work() -> None:
            assert await self.source.get() == []
            self.send([b"%d\n%d.5\n" % (number, number) for number in range(100)])
            lines = await until(self.source, lambda found: len([line for line in found if line]) == 200)
            assert [float(line) for line in lines if line] == [half / 2 for half in range(200)]

        running(self.source, work)
        assert "100 datagrams taken in, 0 lost" in self.source.summary()

    @pytest.mark.parametrize(("bound", "most"), [("_MOST_DATAGRAMS", 10), ("_MOST_BYTES", 20)])
    def test_the_oldest_are_dropped_and_counted(self, monkeypatch: pytest.MonkeyPatch, bound: str, most: int) -> None:
        """When too many wait, or too many bytes, what remains is the newest."""
        monkeypatch.setattr(network, bound, most)

        async def work() -> None:
            self.send([b"%02d" % number for number in range(50)])
            lines = await until(self.source, lambda found: b"49" in found)
            assert [int(line) for line in lines] == list(range(40, 50))

        running(self.source, work)
        assert "10 datagrams taken in, 40 lost" in self.source.summary()

    @pytest.mark.skipif(sys.platform != "linux", reason="other systems do not tell what they dropped")
    def test_what_the_system_drops_is_counted(self) -> None:
        """Many thousands while nobody takes them in: came and lost together are what was sent."""
        sent = 60_000

        async def work() -> None:
            self.send([b"0"])
            assert await self.source.get() == [b"0"]
            self.send([b"1"] * (sent - 1))
            while await self.source.get():
                pass
            assert self.source._lost() > 0
            assert self.source._received + self.source._lost() == sent  # nothing was dropped here

        running(self.source, work)
        assert any("lost" in text for text in self.notices)

    def test_only_allowed_senders_are_accepted(self) -> None:
        """Others are counted and reported."""
        self.source = UdpListener(LOOPBACK, lambda host: host == "127.0.0.2", self.notices.append)

        async def work() -> None:
            for host in ("127.0.0.1", "127.0.0.2"):
                self.send([host.encode()], host)
            assert await until(self.source, bool) == [b"127.0.0.2"]

        running(self.source, work)
        assert "1 datagrams taken in, 0 lost, 1 refused" in self.source.summary()
        assert any("127.0.0.1, which --allow does not name" in text for text in self.notices)


class TestTcpListener:
    def setup_method(self) -> None:
        self.notices: list[str] = []
        self.source = TcpListener(LOOPBACK, everybody, self.notices.append)

    def test_lines_of_several_connections(self) -> None:
        """Each connection's lines are whole and in order, however they are cut; a last one without its end counts."""

        async def send(name: int) -> None:
            _, writer = await asyncio.open_connection("127.0.0.1", port_of(self.notices))
            text = b"\n".join(b"%d %d" % (name, number) for number in range(1000))
            for begin in range(0, len(text), 777):
                writer.write(text[begin : begin + 777])
                await asyncio.sleep(0)
            writer.close()
            await writer.wait_closed()

        async def work() -> None:
            tasks = [asyncio.create_task(send(name)) for name in range(3)]
            lines = await until(self.source, lambda found: len(found) == 3000)
            for name in range(3):
                mine = [int(line.split()[1]) for line in lines if int(line.split()[0]) == name]
                assert mine == list(range(1000))
            await asyncio.gather(*tasks)
            while len(self.source._open):
                await self.source.get()

        running(self.source, work)
        assert "connections: 3, 0 open" in self.source.summary()

    def test_many_short_connections_one_after_another(self) -> None:
        """Each gives a line and is closed at once: all lines come, none is refused."""

        async def send() -> None:
            for number in range(1000):
                _, writer = await asyncio.open_connection("127.0.0.1", port_of(self.notices))
                writer.write(b"%d\n" % number)
                writer.close()

        async def work() -> None:
            task = asyncio.create_task(send())
            lines = await until(self.source, lambda found: len(found) == 1000)
            assert sorted(map(int, lines)) == list(range(1000))
            await task

        running(self.source, work)
        assert "refused" not in self.source.summary()

    def test_a_fast_sender_waits(self) -> None:
        """Nobody takes lines in: the sender is stopped after some MB, the queue stays short; then nothing is lost."""
        total, wide = 600_000, b"x" * 90

        async def work() -> None:
            _, writer = await asyncio.open_connection("127.0.0.1", port_of(self.notices))
            sent = [0]

            async def send() -> None:
                for number in range(total):
                    writer.write(b"%d %b\n" % (number, wide))
                    await writer.drain()
                    sent[0] = number
                writer.close()

            task, before = asyncio.create_task(send()), -1
            while sent[0] != before:
                before = sent[0]
                await asyncio.sleep(0.5)
            assert before < total - 1
            assert self.source._pieces.qsize() == network._MOST_PIECES
            expected = 0
            while expected < total:
                for line in await self.source.get():
                    assert int(line.split()[0]) == expected
                    expected += 1
            await task

        running(self.source, work)

    def test_who_is_not_allowed_or_too_many_is_refused(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The connection is closed at once, counted and notices."""
        monkeypatch.setattr(network, "_MOST_CONNECTIONS", 2)
        self.source = TcpListener(LOOPBACK, lambda host: host != "127.0.0.3", self.notices.append)

        async def work() -> None:
            ends = []
            for host in ("127.0.0.3", "127.0.0.1", "127.0.0.2", "127.0.0.1"):
                reader, writer = await asyncio.open_connection("127.0.0.1", port_of(self.notices), local_addr=(host, 0))
                ends.append(writer)
                if host == "127.0.0.3" or len(ends) == 4:
                    with pytest.raises(ConnectionResetError):
                        if not await reader.read():
                            raise ConnectionResetError
                else:
                    writer.write(host.encode() + b"\n")
                    assert await until(self.source, bool) == [host.encode()]
            for writer in ends:
                writer.close()

        running(self.source, work)
        assert "connections: 2" in self.source.summary()
        assert "2 refused" in self.source.summary()


class TestTcpClient:
    def test_it_connects_again(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Nobody there, then a server that ends each connection in the middle of a line: tried again, no line lost."""
        monkeypatch.setattr(network, "_FIRST_WAIT", 0.01)
        with sender() as place, socket.socket() as reserved:
            del place
            reserved.bind(("127.0.0.1", 0))
            port = reserved.getsockname()[1]
        notices: list[str] = []
        source = TcpClient(Address.parse(f"tcp://127.0.0.1:{port}"), notices.append)
        count = [0]

        async def answer(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(b"%d\n%d.5" % (count[0], count[0]))
            count[0] += 1
            writer.close()

        async def work() -> None:
            while not any("cannot be reached" in text for text in notices):
                assert await source.get() == []
            server = await asyncio.start_server(answer, "127.0.0.1", port)
            lines = await until(source, lambda found: len(found) >= 6)
            assert [float(line) for line in lines[:6]] == [0, 0.5, 1, 1.5, 2, 2.5]
            server.close()

        running(source, work)
        assert "connections made: " in source.summary()

    def test_it_waits_longer_and_longer(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Half a second, twice that, up to half a minute."""
        waits: list[float] = []

        async def sleep(seconds: float) -> None:
            waits.append(seconds)
            if len(waits) == 9:
                raise asyncio.CancelledError

        async def nobody(*_: object, **__: object) -> None:
            raise ConnectionRefusedError(111, "Connection refused")

        monkeypatch.setattr(network.asyncio, "sleep", sleep)
        monkeypatch.setattr(network.asyncio, "open_connection", nobody)
        source = TcpClient(Address.parse("tcp://127.0.0.1:9"), lambda _: None)
        with pytest.raises(asyncio.CancelledError):
            asyncio.run(source._stay_connected())
        assert waits == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0, 30.0]


def test_estimates_are_datagrams() -> None:
    """A line each; to a place where nobody is they go all the same."""
    with sender() as ours:
        out = UdpSender(f"udp://127.0.0.1:{ours.getsockname()[1]}")
        out([b"one\n", b"two\n"])
        assert [ours.recv(100) for _ in range(2)] == [b"one\n", b"two\n"]
    for _ in range(100):
        out([b"three\n"])
    assert out.summary() == ""
    out([b"x" * 100_000])
    out.close()
    assert "1 estimates could not be sent" in out.summary()


@pytest.mark.parametrize("kind", [UdpListener, TcpListener])
def test_a_port_that_is_taken_is_reported(kind: type[UdpListener] | type[TcpListener]) -> None:
    """Two cannot listen at one port."""
    with sender() as ours, socket.create_server(("127.0.0.1", 0)) as server:
        taken = (ours if kind is UdpListener else server).getsockname()
        with pytest.raises(pf.RunError, match=r"cannot be listened at: .*in use"):
            asyncio.run(kind((socket.AF_INET, taken), everybody, print).start())
