"""Sources and receivers on the command line, and which senders a listener accepts."""

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.live.address import Address, listener, receiver


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
    """Every kind of source, with and without its options."""
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
    """With what is expected."""
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
    """One line gives the reason."""
    with pytest.raises(pf.ConfigError, match=message):
        listener(Address.parse(source), listen, [allow])
