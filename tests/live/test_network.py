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


def port_of(said: list[str]) -> int:
    return int(next(text for text in said if "listening at" in text).rsplit(":", 1)[1])


def sender(host: str = "127.0.0.1") -> socket.socket:
    ours = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ours.bind((host, 0))
    return ours


class TestUdp:
    def test_datagrams_are_lines(self) -> None:
        """One line or several a datagram, in their order; silence is no lines."""
        said: list[str] = []
        source = UdpListener(LOOPBACK, everybody, said.append)

        async def work() -> None:
            assert await source.get() == []
            with sender() as ours:
                for number in range(100):
                    ours.sendto(b"%d\n%d.5\n" % (number, number), ("127.0.0.1", port_of(said)))
            lines = await until(source, lambda found: len([line for line in found if line]) == 200)
            assert [float(line) for line in lines if line] == [half / 2 for half in range(200)]

        running(source, work)
        assert "100 datagrams taken in, 0 lost" in source.summary()

    def test_the_oldest_are_let_go_and_counted(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """When too many wait, what remains is the newest."""
        monkeypatch.setattr(network, "_MOST_DATAGRAMS", 10)
        said: list[str] = []
        source = UdpListener(LOOPBACK, everybody, said.append)

        async def work() -> None:
            with sender() as ours:
                for number in range(50):
                    ours.sendto(b"%d" % number, ("127.0.0.1", port_of(said)))
            lines = await until(source, lambda found: b"49" in found)
            assert [int(line) for line in lines] == list(range(40, 50))

        running(source, work)
        assert "10 datagrams taken in, 40 lost" in source.summary()

    def test_large_ones_wait_only_up_to_a_size(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Sixty datagrams of 10 kB where 50 kB may wait."""
        monkeypatch.setattr(network, "_MOST_BYTES", 50_000)
        said: list[str] = []
        source = UdpListener(LOOPBACK, everybody, said.append)

        async def work() -> None:
            with sender() as ours:
                for _ in range(6):
                    for _ in range(10):
                        ours.sendto(b"x" * 10_000, ("127.0.0.1", port_of(said)))
                    await asyncio.sleep(0)
            await asyncio.sleep(0.1)
            assert len(source._waiting) == 5

        running(source, work)
        assert "5 datagrams taken in, 55 lost" in source.summary()

    @pytest.mark.skipif(sys.platform != "linux", reason="other systems do not tell what they dropped")
    def test_what_the_system_drops_is_counted(self) -> None:
        """Many thousands while nobody takes them in: came and lost together are what was sent."""
        said: list[str] = []
        source = UdpListener(LOOPBACK, everybody, said.append)
        sent = 60_000

        async def work() -> None:
            with sender() as ours:
                for number in range(sent):
                    ours.sendto(b"%d" % number, ("127.0.0.1", port_of(said)))
                    if number == 0:
                        assert await source.get() == [b"0"]
            while await source.get():
                pass
            assert source._lost() > 0
            assert source._received + source._lost() == sent  # nothing was let go here
            source._next_report = 0.0
            await source.get()

        running(source, work)
        assert any("lost" in text for text in said)

    def test_only_who_is_allowed_is_heard(self) -> None:
        """Others are counted, and said."""
        said: list[str] = []
        source = UdpListener(LOOPBACK, lambda host: host == "127.0.0.2", said.append)

        async def work() -> None:
            for host in ("127.0.0.1", "127.0.0.2"):
                with sender(host) as ours:
                    ours.sendto(host.encode(), ("127.0.0.1", port_of(said)))
            assert await until(source, bool) == [b"127.0.0.2"]

        running(source, work)
        assert "1 datagrams taken in, 0 lost, 1 refused" in source.summary()
        assert any("127.0.0.1, which --allow does not name" in text for text in said)

    def test_a_place_that_is_taken_is_said(self) -> None:
        """Two cannot listen at one port."""
        with sender() as ours:
            source = UdpListener((socket.AF_INET, ours.getsockname()), everybody, print)
            with pytest.raises(pf.RunError, match="in use"):
                asyncio.run(source.start())


class TestServer:
    def test_lines_of_several_connections(self) -> None:
        """Each connection's lines are whole and in order, however they are cut; a last one without its end counts."""
        said: list[str] = []
        source = TcpListener(LOOPBACK, everybody, said.append)

        async def send(name: int) -> None:
            _, writer = await asyncio.open_connection("127.0.0.1", port_of(said))
            text = b"\n".join(b"%d %d" % (name, number) for number in range(1000))
            for begin in range(0, len(text), 777):
                writer.write(text[begin : begin + 777])
                await asyncio.sleep(0)
            writer.close()
            await writer.wait_closed()

        async def work() -> None:
            tasks = [asyncio.create_task(send(name)) for name in range(3)]
            lines = await until(source, lambda found: len(found) == 3000)
            for name in range(3):
                mine = [int(line.split()[1]) for line in lines if int(line.split()[0]) == name]
                assert mine == list(range(1000))
            await asyncio.gather(*tasks)
            while len(source._open):
                await source.get()

        running(source, work)
        assert "connections: 3, 0 open" in source.summary()

    def test_many_short_connections_one_after_another(self) -> None:
        """Each gives a line and is closed at once: all lines come, none is refused."""
        said: list[str] = []
        source = TcpListener(LOOPBACK, everybody, said.append)

        async def send() -> None:
            for number in range(1000):
                _, writer = await asyncio.open_connection("127.0.0.1", port_of(said))
                writer.write(b"%d\n" % number)
                writer.close()

        async def work() -> None:
            task = asyncio.create_task(send())
            lines = await until(source, lambda found: len(found) == 1000)
            assert sorted(map(int, lines)) == list(range(1000))
            await task

        running(source, work)
        assert "refused" not in source.summary()

    def test_a_fast_sender_waits(self) -> None:
        """Nobody takes lines in: the sender is stopped after some MB, the queue stays short; then nothing is lost."""
        said: list[str] = []
        source = TcpListener(LOOPBACK, everybody, said.append)
        total, wide = 600_000, b"x" * 90

        async def work() -> None:
            _, writer = await asyncio.open_connection("127.0.0.1", port_of(said))
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
            assert source._pieces.qsize() == network._MOST_PIECES
            expected = 0
            while expected < total:
                for line in await source.get():
                    assert int(line.split()[0]) == expected
                    expected += 1
            await task

        running(source, work)

    def test_who_is_not_allowed_or_too_many_is_refused(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The connection is closed at once, counted and said."""
        monkeypatch.setattr(network, "_MOST_CONNECTIONS", 2)
        said: list[str] = []
        source = TcpListener(LOOPBACK, lambda host: host != "127.0.0.3", said.append)

        async def work() -> None:
            ends = []
            for host in ("127.0.0.3", "127.0.0.1", "127.0.0.2", "127.0.0.1"):
                reader, writer = await asyncio.open_connection("127.0.0.1", port_of(said), local_addr=(host, 0))
                ends.append(writer)
                if host == "127.0.0.3" or len(ends) == 4:
                    with pytest.raises(ConnectionResetError):
                        if not await reader.read():
                            raise ConnectionResetError
                else:
                    writer.write(host.encode() + b"\n")
                    assert await until(source, bool) == [host.encode()]
            for writer in ends:
                writer.close()

        running(source, work)
        assert "connections: 2" in source.summary()
        assert "2 refused" in source.summary()


class TestClient:
    def test_it_connects_again(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Nobody there, then a server that ends each connection in the middle of a line: tried again, no line lost."""
        monkeypatch.setattr(network, "_FIRST_WAIT", 0.01)
        with sender() as place, socket.socket() as reserved:
            del place
            reserved.bind(("127.0.0.1", 0))
            port = reserved.getsockname()[1]
        said: list[str] = []
        source = TcpClient(Address.parse(f"tcp://127.0.0.1:{port}"), said.append)
        count = [0]

        async def answer(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(b"%d\n%d.5" % (count[0], count[0]))
            count[0] += 1
            writer.close()

        async def work() -> None:
            while not any("cannot be reached" in text for text in said):
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
