"""Stream of a live estimator: lines of events in, lines of estimates out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from ..errors import ConfigError
from ..filter.outcome import Outcome
from .clock import stamp_of
from .estimator import LiveEstimator
from .health import Health
from .rate_limit import RateLimitedLog
from .results import COMPARED, LiveEstimate, UpdateResult
from .tool import NOISE
from .wire import BadLine, Event, LineDecoder, encode

_SHOWN = 60  # characters of a bad line in the log
_MOST_AT_ONCE = 50_000  # estimates on the grid between two events
_FASTEST = 1e4  # Hz
_USUAL = COMPARED | {Outcome.STRAY, Outcome.HELD}  # what may be stray or held waits, and is said once it surely is


class Watcher(Protocol):
    """Receiver of all events and estimates, called at once: it must not take long."""

    def event(self, event: Event, result: UpdateResult) -> None:
        """Receive an event and what became of it; of one that was taken what it tells of the tool."""

    def estimate(self, estimate: LiveEstimate) -> None:
        """Receive an estimate that goes out."""

    def tick(self, health: Callable[[], Health]) -> None:
        """Do what is due, whether something has come or not."""


class Stream:
    """A live estimator between lines that come in and lines that go out."""

    def __init__(
        self,
        live: LiveEstimator,
        write: Callable[[list[bytes]], None],
        notify: Callable[[str], None],
        rate: float | None = None,
        watchers: Sequence[Watcher] = (),
    ) -> None:
        """Wait for lines."""
        if rate is not None and not 0.0 < rate <= _FASTEST:
            raise ConfigError(f"rate: at most {_FASTEST:g} estimates a second, not {rate:g}")
        self.live, self.lines, self.bad, self.estimates = live, 0, 0, 0
        self._write, self._watchers = write, tuple(watchers)
        self._kinds = live.config.arm.kind_of
        self._decoder = LineDecoder(self._kinds, live.config.frame is not None, live.joints)
        self._step = None if rate is None else 1e9 / rate
        self._grid: tuple[int, int] | None = None  # the segment, and where its grid begins [ns]
        self._due = 0
        self._asked: list[int] = []  # where commands came of which the estimate is not written yet [ns]
        self._with_ns = False  # whether the stream gives its time in ns
        self._out: list[bytes] = []
        self._log = RateLimitedLog(notify)

    def add(self, items: Iterable[bytes | Event]) -> None:
        """Add lines and events, and write the estimates that are due after each."""
        for item in items:
            if isinstance(item, bytes):
                self._add_line(item)
            else:
                self._add_event(item)
            self.flush()

    def _add_line(self, line: bytes) -> None:
        """Add one line."""
        if not line.strip():
            return
        self.lines += 1
        try:
            event = self._decoder.decode(line)
        except BadLine as error:
            self.bad += 1
            shown = repr(line[:_SHOWN])[1:] + (" ..." if len(line) > _SHOWN else "")
            reason = str(error)
            self._log.write(f"bad line, {reason.partition(':')[0]}", f"bad line {self.lines}: {reason[:200]}: {shown}")
            return
        self._add_event(event)

    def _add_event(self, event: Event) -> None:
        """Add one event."""
        live, (t, sensor, values) = self.live, event
        self._with_ns = isinstance(t, int)
        if self._step is not None and values.keys() - {NOISE}:  # what gives no axis is in no record
            self._on_grid(live.until(t, sensor or None))
        result = live.measurement(t, sensor, **values) if sensor else live.command(t, **values)
        if self._watchers and result.outcome in COMPARED:
            event = event._replace(values=live.of_tool(t, sensor, values))
        for watcher in self._watchers:
            watcher.event(event, result)
        waits = result.outcome is Outcome.STRAY
        if not _USUAL.issuperset((result.outcome, *result.axes.values())):
            who = sensor if sensor in live.config.sensors else "unknown sensor" if sensor else "command"
            became = f"{result.reason} ({result.outcome.word})"
            self._log.write(f"{who} {result.outcome.word}", f"{sensor[:40] or who}{_at(t)}: {became}")
        if self._step is None and not sensor and (waits or result.outcome is Outcome.FUSED):
            self._asked.append(stamp_of(t))
        if self._asked and live.sure is not None:
            self._at_commands(live.sure)

    def idle(self, now: int) -> None:
        """Go on with the grid until ``now`` [ns] of the stream's own time, as nothing has come for a while."""
        if self._step is not None:
            self._on_grid(now + 1)
            self.flush()

    def end(self) -> None:
        """Write the estimates until the last event: no more will come."""
        if self._step is not None and self.live.sure is not None:
            self._on_grid(self.live.sure + 1)
        self._at_commands(self.live.newest or 0)
        self.flush()

    def _at_commands(self, until: int) -> None:
        """Estimate where commands came, up to an instant [ns]; what has jumped ahead waits, and may be taken back."""
        asked, newest = self._asked, self.live.newest or 0
        self._asked = [at for at in asked if until < at <= newest]
        for at in asked:
            if at <= until:
                self._send(self.live.estimate(at))

    def flush(self) -> None:
        """Write the estimates that are ready."""
        if self._out:
            lines, self._out = self._out, []
            self._write(lines)

    def _on_grid(self, before: int | None) -> None:
        """Estimate at each point of the grid before an instant [ns]; a long pause is left out."""
        origin = self.live.origin
        if origin is None or before is None or self._step is None:
            return
        if self._grid is None or self._grid[0] != self.live.segment:
            self._grid, self._due = (self.live.segment, origin), 0
        missing = int((before - self._grid[1]) / self._step) - self._due
        if missing > _MOST_AT_ONCE:
            self._due += missing
            self._log.write("pause", f"a pause of {missing * self._step / 1e9:.0f} s: no estimates on the grid over it")
        while (at := self._grid[1] + round(self._due * self._step)) < before:
            self._send(self.live.estimate_as_live(at))
            self._due += 1

    def _send(self, estimate: LiveEstimate) -> None:
        if estimate.outcome is Outcome.FUSED:
            self.estimates += 1
            self._out.append(encode(estimate, self._kinds, self._with_ns))
            for watcher in self._watchers:
                watcher.estimate(estimate)


def _at(t: float | int) -> str:
    """A stamp for people; empty where it is no time."""
    try:
        return f" at {stamp_of(t) / 1e9:.3f} s"
    except ValueError:
        return ""
