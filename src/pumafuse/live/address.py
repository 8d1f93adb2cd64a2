"""Addresses on the command line: sources, receivers, and which senders a listener accepts."""

from __future__ import annotations

import math
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from ipaddress import IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from typing import TypeAlias
from urllib.parse import urlsplit

from ..errors import ConfigError

SocketAddress: TypeAlias = tuple[socket.AddressFamily, tuple[str, int]]
Allowed: TypeAlias = Callable[[str], bool]  # whether a sender's host is accepted

LISTENERS = ("udp", "tcp-listen")
NETWORK = (*LISTENERS, "tcp")  # of lines
POSES = "igtl"  # a server that speaks OpenIGTLink
OF_A_RUN = ("ros2", "rtde")  # what comes is read by a run.toml
_RTDE, _IGTL = 30004, 18944  # the ports of a controller, and of a server of poses
_LOOPBACK = "127.0.0.1"
_SOURCES = (
    "stdin, udp://HOST:PORT, tcp-listen://HOST:PORT, tcp://HOST:PORT, ros2:run.toml, rtde:run.toml?host=HOST,"
    " igtl://HOST, igtl://HOST:PORT?time=received, replay:RUN, replay:RUN?speed=4 (or max)"
)


@dataclass(frozen=True)
class Address:
    """A source as the command line names it."""

    kind: str  # ``stdin``, ``replay``, ``ros2``, ``rtde``, ``igtl``, ``udp``, ``tcp-listen`` or ``tcp``
    path: str = ""  # of the run to replay, or of a ``run.toml`` that names topics or columns
    speed: float = 1.0  # seconds of the run in one second; infinite: as fast as it can be
    host: str = ""  # of a network source, empty where none is given
    port: int = 0  # of a network source
    on_receipt: bool = False  # whether poses are stamped when they are received

    @staticmethod
    def parse(text: str) -> Address:
        """Parse a source, as in ``udp://127.0.0.1:5005`` or ``replay:RUN?speed=4``."""
        kind, colon, after = text.partition(":")
        if text == "stdin":
            return Address("stdin")
        if kind == "replay" and colon:
            return _replay(text, after)
        if kind == "ros2" and after:
            return Address("ros2", after)
        if kind == "rtde" and after:
            return _rtde(text, after)
        if kind == POSES and after.startswith("//"):
            return _poses(text, after)
        if kind in NETWORK and after.startswith("//"):
            return _network_address(text, f"source '{text}'")
        raise ConfigError(f"no source '{text}'; there are: {_SOURCES}")

    @property
    def text(self) -> str:
        """A network source as it is written."""
        return f"{self.kind}://{host_port(self.host, self.port)}"


def host_port(host: str, port: int) -> str:
    """A host and port as people write them."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def receiver(text: str) -> SocketAddress:
    """The socket address of ``udp://HOST:PORT``, to send to."""
    where = f"--out '{text}'"
    address = _network_address(text, where) if text.startswith("udp://") else None
    if address is None or not address.host or not address.port:
        raise ConfigError(f"{where}: expected udp://HOST:PORT")
    return _resolve(address.host, address.port, where)


def listener(address: Address, listen: str | None, allow: Sequence[str]) -> tuple[SocketAddress, Allowed]:
    """Where a source listens, and which senders it accepts: on loopback all, elsewhere only those that are allowed."""
    networks = [_network(text) for text in allow]
    where = f"source '{address.text}'"
    family, socket_address = _resolve(listen or address.host or _LOOPBACK, address.port, where)
    if listen is None:
        if not ip_address(socket_address[0]).is_loopback:
            raise ConfigError(
                f"{where}: listens on loopback only; to be reached from elsewhere, give"
                f" --listen {socket_address[0]} --allow CIDR, as in --allow 192.168.1.0/24"
            )
        return (family, socket_address), lambda _: True
    if address.host and address.host != listen:
        host = _resolve(address.host, 0, where)[1][0]
        if host != socket_address[0] and not ip_address(host).is_loopback:
            raise ConfigError(f"{where}: names another address than --listen {listen}")

    @lru_cache(maxsize=4096)
    def allowed(host: str) -> bool:
        peer = ip_address(host.partition("%")[0])
        peer = peer.ipv4_mapped or peer if isinstance(peer, IPv6Address) else peer
        return any(peer in network for network in networks)

    return (family, socket_address), allowed


def _resolve(host: str, port: int, where: str) -> SocketAddress:
    try:
        family, _, _, _, socket_address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "not a host's name"
        raise ConfigError(f"{where}: no address of host '{host}' is known: {reason}") from None
    return family, (str(socket_address[0]), port)


def _replay(text: str, after: str) -> Address:
    path, question, option = after.rpartition("?")
    if not question:
        return Address("replay", after)
    name, _, value = option.partition("=")
    try:
        speed = math.inf if value == "max" else float(value)
    except ValueError:
        speed = math.nan
    if name != "speed" or not speed > 0.0:
        raise ConfigError(f"source '{text}': expected ?speed= and a positive number or max after the run")
    return Address("replay", path, speed)


def _rtde(text: str, after: str) -> Address:
    path, _, option = after.rpartition("?")
    name, _, address = option.partition("=")
    host, port = _host_and_port(address, _RTDE)
    if not (path and name == "host" and host and port):
        raise ConfigError(
            f"source '{text}': expected rtde:run.toml?host=HOST or HOST:PORT, the address of the robot's controller"
        )
    return Address("rtde", path, host=host, port=port)


def _poses(text: str, after: str) -> Address:
    address, question, option = after.removeprefix("//").partition("?")
    host, port = _host_and_port(address, _IGTL)
    if not (host and port) or (question and option != "time=received"):
        raise ConfigError(
            f"source '{text}': expected igtl://HOST or igtl://HOST:PORT, and ?time=received for times of receipt"
        )
    return Address(POSES, host=host, port=port, on_receipt=bool(question))


def _network_address(text: str, where: str) -> Address:
    kind, _, host_and_port = text.partition("://")
    host, port = _host_and_port(host_and_port)
    if port is None or (kind == "tcp" and not (host and port)):
        raise ConfigError(f"{where}: expected {kind}://HOST:PORT, as in {kind}://{_LOOPBACK}:5005")
    return Address(kind, host=host, port=port)


def _host_and_port(address: str, usual: int | None = None) -> tuple[str, int | None]:
    """Host and port of HOST:PORT, or of HOST with the usual port; no port of anything else."""
    address = address if ":" in address or usual is None else f"{address}:{usual}"
    try:
        parts = urlsplit(f"//{address}")
        host, port = parts.hostname or "", parts.port
    except ValueError:
        return "", None
    plain = port is not None and address.lower() == host_port(host, port)
    return host, port if plain else None


def _network(text: str) -> IPv4Network | IPv6Network:
    try:
        return ip_network(text)
    except ValueError as error:
        raise ConfigError(f"--allow {text}: {error}; expected a network, as in 192.168.1.0/24") from None
