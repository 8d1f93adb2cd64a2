"""Lines from the network: in order, bounded, none lost unseen."""

import socket
import sys
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

import pumafuse as pf
from listening import until
from pumafuse.live import backlog, network
from pumafuse.live.address import Address, listener, receiver
from pumafuse.live.network import TcpClient, TcpListener, UdpListener, UdpSender

LOOPBACK = (socket.AF_INET, ("127.0.0.1", 0))


def everybody(_: str) -> bool:
    return True


def place_of(notices: list[str]) -> tuple[str, int]:
    return "127.0.0.1", int(next(text for text in notices if "listening at" in text).rsplit(":", 1)[1])


def sender() -> socket.socket:
    ours = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ours.bind(("127.0.0.1", 0))
    return ours


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """A backlog that loses patience ten times as soon."""
    for name in ("_OLD", "_FRESH", "_BEHIND", "_AGAIN"):
        monkeypatch.setattr(backlog, name, 0.1 * getattr(backlog, name))


class TestUdpListener:
    def start(self) -> None:
        self.notices: list[str] = []
        self.source = UdpListener(LOOPBACK, everybody, self.notices.append)
        self.source.start()

    def send(self, datagrams: list[bytes]) -> None:
        with sender() as ours:
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
    with sender() as ours, socket.create_server(("127.0.0.1", 0)) as server:
        taken = (ours if kind is UdpListener else server).getsockname()
        with pytest.raises(pf.RunError, match=r"cannot be listened at: .*in use"):
            kind((socket.AF_INET, taken), everybody, print).start()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("stdin", Address("stdin")),
        ("replay:runs/one", Address("replay", "runs/one")),
        ("replay:runs/one?speed=4", Address("replay", "runs/one", 4.0)),
        ("replay:odd?name?speed=max", Address("replay", "odd?name", np.inf)),
        ("udp://:5005", Address("udp", port=5005)),
        ("tcp-listen://[::1]:5005", Address("tcp-listen", host="::1", port=5005)),
        ("tcp://tracker.cell:5005", Address("tcp", host="tracker.cell", port=5005)),
        ("rtde:cell/run.toml?host=[::1]:4", Address("rtde", "cell/run.toml", host="::1", port=4)),
        ("igtl://tracker?time=received", Address("igtl", host="tracker", port=18944, on_receipt=True)),
    ],
)
def test_sources_are_parsed(text: str, expected: Address) -> None:
    assert Address.parse(text) == expected


REFUSED = {
    "no source '.*'; there are: stdin": ["", "replay", "http://127.0.0.1:80", "udp:a:5005"],
    r"expected \?speed=": ["replay:a?speed=0", "replay:a?x=1"],
    "expected udp://HOST:PORT": [
        *("udp://127.0.0.1:66000", "udp://[127.0.0.1:5005", "udp://user@127.0.0.1:5005", "udp://127.0.0.1:5005/path"),
    ],
    "expected tcp://HOST:PORT": ["tcp://:5005", "tcp://127.0.0.1:0"],
    "expected igtl://HOST": ["igtl://a/b", "igtl://a:0", "igtl://a?time=sent"],
    r"expected rtde:run\.toml\?host=HOST": [
        *("rtde:run.toml", "rtde:run.toml?host=", "rtde:?host=a", "rtde:run.toml?port=3", "rtde:run.toml?host=a/b"),
    ],
}


@pytest.mark.parametrize(("expected", "text"), [(why, text) for why, texts in REFUSED.items() for text in texts])
def test_other_sources_are_refused(expected: str, text: str) -> None:
    with pytest.raises(pf.ConfigError, match=expected):
        Address.parse(text)


@pytest.mark.parametrize("text", ["127.0.0.1:5005", "tcp://127.0.0.1:5005", "udp://:5005", "udp://127.0.0.1:0"])
def test_receivers_have_a_host_and_a_port(text: str) -> None:
    """Estimates go as datagrams to one place."""
    with pytest.raises(pf.ConfigError, match="udp://HOST:PORT"):
        receiver(text)


@pytest.mark.parametrize("host", ["", "127.9.9.9", "localhost", "[::1]"])
def test_all_are_accepted_on_loopback(host: str) -> None:
    """A listener is on loopback by default, where nobody else can be."""
    (_, (found, port)), allowed = listener(Address.parse(f"udp://{host}:5005"), None, [])
    assert found.startswith("127.") or found == "::1"
    assert port == 5005
    assert allowed("127.0.0.1")


@pytest.mark.parametrize("host", ["0.0.0.0", "10.0.0.1", "[::]"])
def test_other_addresses_need_listen_and_allow(host: str) -> None:
    """What would open a machine to a network has to be asked for twice."""
    with pytest.raises(pf.ConfigError, match=r"--listen .* --allow"):
        listener(Address.parse(f"tcp-listen://{host}:5005"), None, [])


def test_only_allowed_networks_are_accepted_elsewhere() -> None:
    """The networks that are named and nobody else; an IPv4 address within IPv6 is the IPv4 address."""
    place, allowed = listener(Address.parse("udp://:5005"), "0.0.0.0", ["10.1.0.0/16", "192.168.7.7"])
    assert place[1] == ("0.0.0.0", 5005)
    accepted = ["10.1.2.3", "192.168.7.7", "::ffff:10.1.2.3"]
    refused = ["10.2.2.3", "192.168.7.8", "127.0.0.1", "::1", "::ffff:10.2.2.3", "fe80::1%eth0"]
    assert [allowed(host) for host in accepted + refused] == [True] * 3 + [False] * 6
    assert not listener(Address.parse("udp://:5005"), "0.0.0.0", [])[1]("127.0.0.1")


@pytest.mark.parametrize(
    ("source", "listen", "allow", "message"),
    [
        ("udp://:5005", "0.0.0.0", "10.0.0.1/8", "host bits"),
        ("udp://:5005", "0.0.0.0", "everybody", "expected a network"),
        ("udp://:5005", "no.such.host.invalid", "10.0.0.0/8", "no address of host"),
        ("udp://10.0.0.1:5005", "10.0.0.2", "10.0.0.0/8", "another address"),
    ],
)
def test_what_cannot_be_listened_on(source: str, listen: str, allow: str, message: str) -> None:
    with pytest.raises(pf.ConfigError, match=message):
        listener(Address.parse(source), listen, [allow])
