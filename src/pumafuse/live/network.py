"""Where events come from on the network: one source of lines, whatever carries them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from .address import Address, bound, shown
from .tcp import Client, Server
from .udp import Udp


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
