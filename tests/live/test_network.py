"""Lines from the network: in order, bounded, none lost unseen."""

import socket
import sys
import threading
import time
from collections.abc import Callable

import pytest

import pumafuse as pf
from listening import until
from pumafuse.live import backlog, network
from pumafuse.live.address import Address
from pumafuse.live.network import TcpClient, TcpListener, UdpListener, UdpSender

LOOPBACK = (socket.AF_INET, ("127.0.0.1", 0))


def everybody(_: str) -> bool:
    return True


def place_of(notices: list[str]) -> tuple[str, int]:
    return "127.0.0.1", int(next(text for text in notices if "listening at" in text).rsplit(":", 1)[1])


def sender(host: str = "127.0.0.1") -> socket.socket:
    ours = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ours.bind((host, 0))
    return ours


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """A backlog that loses patience ten times as soon."""
    for name in ("_OLD", "_FRESH", "_BEHIND", "_AGAIN"):
        monkeypatch.setattr(backlog, name, 0.1 * getattr(backlog, name))


class TestUdpListener:
    def start(self, allowed: Callable[[str], bool] = everybody) -> None:
        self.notices: list[str] = []
        self.source = UdpListener(LOOPBACK, allowed, self.notices.append)
        self.source.start()

    def send(self, datagrams: list[bytes], host: str = "127.0.0.1") -> None:
        with sender(host) as ours:
            for datagram in datagrams:
                ours.sendto(datagram, place_of(self.notices))

    @pytest.mark.usefixtures("hasty")
    def test_where_it_falls_behind_measurements_are_shed_and_commands_are_not(self) -> None:
        """A reader that takes too long: what waits for longer and longer goes, oldest first, is counted and said."""
        self.start()
        sent = [b'{"command": %d}' % number if number % 10 == 0 else b"%d" % number for number in range(4000)]
        self.send(sent)
        lines = list[bytes]()
        for _ in range(40):
            lines += self.source.get()
            time.sleep(0.01)
        lines += self.source.stop()
        shed = len(sent) - len(lines)
        assert shed > 1000
        assert [one for one in lines if b"command" in one] == sent[::10]
        assert lines == [one for one in sent if one in {*lines}]
        assert any("datagrams wait for 0." in one for one in self.notices)
        assert any(f"{shed} of measurements shed so far" in one for one in self.notices)
        assert f"{len(lines)} datagrams taken in, 0 lost, {shed} shed" in self.source.summary()

    def test_datagrams_are_lines(self) -> None:
        """One line or several a datagram, in their order; silence is no lines; what waits at the end comes, too."""
        self.start()
        assert self.source.get() == []
        self.send([b"%d\n%d.5\n" % (number, number) for number in range(100)])
        lines = [*self.source.get(), *self.source.stop()]
        assert [float(line) for line in lines if line] == [half / 2 for half in range(200)]
        assert "100 datagrams taken in, 0 lost" in self.source.summary()

    @pytest.mark.skipif(sys.platform != "linux", reason="other systems do not tell what they dropped")
    def test_what_the_system_drops_is_counted(self) -> None:
        """Many thousands while nobody takes them in: came and lost together are what was sent."""
        self.start()
        self.send([b"1"] * 60_000)
        came = len(until(self.source, lambda _: self.source.get() == []))
        self.source.stop()
        assert self.source._count_lost() > 0
        assert self.source._backlog.received + self.source._count_lost() == 60_000 > came
        assert any("lost" in text for text in self.notices)

    def test_only_allowed_senders_are_accepted(self) -> None:
        """Others are counted and reported."""
        self.start(lambda host: host == "127.0.0.2")
        for host in ("127.0.0.1", "127.0.0.2"):
            self.send([host.encode()], host)
        assert until(self.source, bool) == [b"127.0.0.2"]
        self.source.stop()
        assert "1 datagrams taken in, 0 lost, 1 refused" in self.source.summary()
        assert any("127.0.0.1, which --allow does not name" in text for text in self.notices)


class TestTcpListener:
    def start(self, allowed: Callable[[str], bool] = everybody) -> None:
        self.notices: list[str] = []
        self.source = TcpListener(LOOPBACK, allowed, self.notices.append)
        self.source.start()

    def connect(self, host: str = "127.0.0.1") -> socket.socket:
        return socket.create_connection(place_of(self.notices), 30.0, (host, 0))

    def test_lines_of_several_connections(self) -> None:
        """Each connection's lines are whole and in order, however they are cut; a last one without its end counts."""
        self.start()
        ends = [self.connect() for _ in range(3)]
        texts = [b"\n".join(b"%d %d" % (name, number) for number in range(1000)) for name in range(3)]
        for begin in range(0, max(map(len, texts)), 777):
            for end, text in zip(ends, texts, strict=True):
                end.sendall(text[begin : begin + 777])
        for end in ends:
            end.close()
        lines = until(self.source, lambda found: len(found) == 3000)
        for name in range(3):
            assert [int(line.split()[1]) for line in lines if line.startswith(b"%d" % name)] == list(range(1000))
        until(self.source, lambda _: "connections: 3, 0 open" in self.source.summary())

    def test_a_fast_sender_waits(self) -> None:
        """Nobody takes lines in: the sender is stopped after some MB, the queue stays short; then nothing is lost."""
        self.start()
        total, wide = 250_000, b"x" * 90
        text = b"".join(b"%d %b\n" % (number, wide) for number in range(total))
        with self.connect() as end:
            sending = threading.Thread(target=end.sendall, args=(text,))
            sending.start()
            sending.join(0.5)
            assert sending.is_alive()
            lines = until(self.source, lambda found: len(found) >= total)
            sending.join()
        assert [int(line.split()[0]) for line in lines] == list(range(total))

    def test_who_is_not_allowed_or_too_many_is_refused(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The connection is closed at once, counted and reported."""
        monkeypatch.setattr(network, "_MOST_CONNECTIONS", 2)
        self.start(lambda host: host != "127.0.0.3")
        ends = [self.connect(host) for host in ("127.0.0.3", "127.0.0.1", "127.0.0.2")]
        for accepted in (1, 2):
            ends[accepted].sendall(b"%d\n" % accepted)
            assert until(self.source, bool) == [b"%d" % accepted]
        ends.append(self.connect("127.0.0.1"))
        assert [ends[refused].recv(1) for refused in (0, 3)] == [b"", b""]
        for end in ends:
            end.close()
        assert "connections: 2" in self.source.summary()
        assert "2 refused" in self.source.summary()

    def test_silent_connections_lock_nobody_out(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The oldest one on which nothing has come makes room; one that has sent stays."""
        monkeypatch.setattr(network, "_MOST_CONNECTIONS", 3)
        self.start(lambda _: True)
        sending = self.connect("127.0.0.1")
        sending.sendall(b"0\n")
        assert until(self.source, bool) == [b"0"]
        silent = [self.connect("127.0.0.1") for _ in range(2)]
        new = self.connect("127.0.0.1")
        new.sendall(b"1\n")
        assert until(self.source, bool) == [b"1"]
        assert silent[0].recv(1) == b""
        sending.sendall(b"2\n")
        assert until(self.source, bool) == [b"2"]
        for end in (sending, new, *silent):
            end.close()


class TestTcpClient:
    def test_it_connects_again(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Nobody there, then a server that ends each connection in the middle of a line: tried again, no line lost."""
        monkeypatch.setattr(network, "_FIRST_WAIT", 0.01)
        with socket.create_server(("127.0.0.1", 0)) as reserved:
            place = reserved.getsockname()
        notices: list[str] = []
        source = TcpClient(Address.parse(f"tcp://127.0.0.1:{place[1]}"), notices.append)
        source.start()
        assert until(source, lambda _: any("cannot be reached" in text for text in notices)) == []
        with socket.create_server(place) as server:
            for number in range(3):
                with server.accept()[0] as connection:
                    connection.sendall(b"%d\n%d.5" % (number, number))
            lines = until(source, lambda found: len(found) == 6)
        source.stop()
        assert [float(line) for line in lines] == [0, 0.5, 1, 1.5, 2, 2.5]
        assert "connections made: 3" in source.summary()


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
            kind((socket.AF_INET, taken), everybody, print).start()
