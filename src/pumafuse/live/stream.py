"""Events in, estimates out: what ``pumafuse live`` does with each line."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from ..fusion.timeline import Outcome
from .estimator import LiveEstimator, Told, nanoseconds
from .wire import LONGEST, BadLine, Event, Wire, encode

_SHOWN = 60  # characters of a bad line in the log
_TAKEN = (Outcome.FUSED, Outcome.REOPENED, Outcome.GATED)


class Stream:
    """A live estimator between lines that come in and lines that go out.

    Attributes:
        live: The estimator.
        lines: How many lines have come.
        bad: How many of them were no event.
        estimates: How many have gone out.
    """

    def __init__(
        self,
        live: LiveEstimator,
        write: Callable[[bytes], None],
        say: Callable[[str], None],
        rate: float | None = None,
    ) -> None:
        """Nothing in, nothing out.

        Args:
            live: The estimator.
            write: Takes whole lines of estimates, some at a time.
            say: Takes a sentence for the log.
            rate: Estimates on an even grid [Hz] from the first command on; one for each command for None.
        """
        self.live, self.lines, self.bad, self.estimates = live, 0, 0, 0
        self._write, self._say = write, say
        self._wire = Wire(live.axes, live.config.frame is not None)
        self._step = None if rate is None else 1e9 / rate
        self._grid: tuple[int, int] | None = None  # the segment, and where its grid begins [ns]
        self._due = 0
        self._whole = False  # whether the stream tells its time in ns
        self._torn, self._too_long = b"", False
        self._out: list[bytes] = []
        self._counts: dict[str, int] = {}

    def feed(self, data: bytes) -> None:
        """Take in a piece of the stream, of any length, and write what is to be said after it."""
        *lines, rest = data.split(b"\n")
        for line in lines:
            if self._too_long:
                self._too_long = False
            elif len(self._torn) + len(line) > LONGEST:
                self._bad("longer than 64 KiB", self._torn + line)
            else:
                self.line(self._torn + line)
            self._torn = b""
        if not self._too_long:
            self._torn += rest
            if len(self._torn) > LONGEST:
                self._bad("longer than 64 KiB", self._torn)
                self._torn, self._too_long = b"", True
        self.flush()

    def line(self, line: bytes) -> None:
        """Take in one line."""
        if not line.strip():
            return
        self.lines += 1
        try:
            event = self._wire.decode(line)
        except BadLine as error:
            self.lines -= 1
            self._bad(str(error), line)
            return
        self.event(event)

    def event(self, event: Event) -> None:
        """Take in one event."""
        live, (t, sensor, values) = self.live, event
        self._whole = isinstance(t, int)
        if self._step is not None:
            self._on_grid(live.until(t))
        told = live.reading(t, sensor, **values) if sensor else live.command(t, **values)
        if told.outcome not in _TAKEN or len(told.axes) != len(values) or Outcome.UNKNOWN in told.axes.values():
            self._sampled(f"{sensor or 'command'} {told.outcome.word}", f"{sensor or 'command'} at {t}: {_said(told)}")
        if self._step is None and not sensor and told.outcome is Outcome.FUSED:
            self._estimate(nanoseconds(t))

    def take(self, events: Iterable[Event]) -> None:
        """Take in events, and write what is to be said after them."""
        for event in events:
            self.event(event)
        self.flush()

    def idle(self, now: int) -> None:
        """Nothing has come for a while, and by the stream's own time it is ``now`` [ns]: the grid goes on."""
        if self._step is not None:
            self._on_grid(now + 1)
            self.flush()

    def end(self) -> None:
        """No more will come."""
        if self._torn:
            self.line(self._torn)
            self._torn = b""
        if self._step is not None and self.live.sure is not None:
            self._on_grid(self.live.sure + 1)
        self.flush()

    def flush(self) -> None:
        """Write the estimates that are ready."""
        if self._out:
            lines, self._out = b"".join(self._out), []
            self._write(lines)

    def _on_grid(self, before: int | None) -> None:
        """An estimate at each point of the grid before an instant [ns]."""
        origin = self.live.origin
        if origin is None or before is None or self._step is None:
            return
        if self._grid is None or self._grid[0] != self.live.segment:
            self._grid, self._due = (self.live.segment, origin), 0
        while (at := self._grid[1] + round(self._due * self._step)) < before:
            self._estimate(at)
            self._due += 1
            if len(self._out) >= _FLUSHED:
                self.flush()

    def _estimate(self, stamp: int) -> None:
        estimate = self.live.estimate(stamp)
        if estimate.outcome is Outcome.FUSED:
            self.estimates += 1
            self._out.append(encode(estimate, self._whole))

    def _bad(self, reason: str, line: bytes) -> None:
        self.lines += 1
        self.bad += 1
        shown = repr(line[:_SHOWN])[1:] + (" ..." if len(line) > _SHOWN else "")
        self._sampled(f"bad line, {reason.partition(':')[0]}", f"bad line {self.lines}: {reason[:200]}: {shown}")

    def _sampled(self, kind: str, text: str) -> None:
        """Say the first of a kind, the tenth, the hundredth and so on."""
        count = self._counts.get(kind, 0) + 1 if kind in self._counts or len(self._counts) < _KINDS else 0
        if count:
            self._counts[kind] = count
            if count == 10 ** (len(str(count)) - 1):
                self._say(text if count == 1 else f"{text} ({count} of this kind so far)")


_FLUSHED = 1000  # lines that are written at once
_KINDS = 1000


def _said(told: Told) -> str:
    return f"{told.outcome.word}, {told.reason}"
