"""Several sources at once, as a robot's controller and a tracker: each is asked by a thread of its own."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Sequence
from typing import Protocol, TypeAlias

from .sources import QUIET
from .wire import Event

Items: TypeAlias = Sequence[bytes | Event]
_MOST = 16  # pieces of all sources that wait


class Remote(Protocol):
    """A source that is listened to until the end is asked for."""

    def start(self) -> None:
        """Begin to listen."""

    def get(self) -> Items:
        """Some lines or events; none after a tenth of a second without any."""
        ...

    def stop(self) -> Items:
        """Those that have come and were not given yet."""
        ...

    def summary(self) -> str:
        """How many came."""
        ...


class Several:
    """Sources whose lines and events are put together in the order in which they come."""

    def __init__(self, sources: Sequence[Remote]) -> None:
        """Prepare; :meth:`start` begins to listen."""
        self._sources = sources
        self._pieces = queue.Queue[Items](_MOST)
        self._ended = threading.Event()
        self._error: Exception | None = None

    def start(self) -> None:
        """Begin to listen.

        Raises:
            PumafuseError: A source cannot be listened to.
        """
        for source in self._sources:
            source.start()
        self._threads = [threading.Thread(target=self._ask, args=(one,), daemon=True) for one in self._sources]
        for thread in self._threads:
            thread.start()

    def get(self) -> Items:
        """Some of one source; none after a tenth of a second without any.

        Raises:
            Exception: What a source has raised.
        """
        if self._error is not None:
            raise self._error
        try:
            return self._pieces.get(timeout=QUIET)
        except queue.Empty:
            return []

    def stop(self) -> Items:
        """Those that have come and were not given yet."""
        self._ended.set()
        found = list[bytes | Event]()
        while any(thread.is_alive() for thread in self._threads) or not self._pieces.empty():
            with contextlib.suppress(queue.Empty):
                found += self._pieces.get(timeout=QUIET)
        return [*found, *(item for source in self._sources for item in source.stop())]

    def summary(self) -> str:
        """How many came from each."""
        return "; ".join(filter(None, (source.summary() for source in self._sources)))

    def _ask(self, source: Remote) -> None:
        try:
            while not self._ended.is_set():
                if items := source.get():
                    self._pieces.put(items)
        except Exception as error:  # it is the thread that takes what comes that is to end by it
            self._error = error
