"""`pumafuse live`."""

from __future__ import annotations

import contextlib
import gc
import math
import signal
import sys
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import msgspec
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from ..errors import ConfigError, RunError
from ..filter.outcome import Outcome
from ..fusion.config import FusionConfig
from ..live import network
from ..live.address import LISTENERS, NETWORK, Address
from ..live.estimator import LiveEstimator
from ..live.network import UdpSender
from ..live.record import Recorder
from ..live.results import Health
from ..live.sources import QUIET, replayed, standard_input
from ..live.stream import Stream
from ..live.wire import Event
from ..logs.run import Run
from ..units import MM, MS

if TYPE_CHECKING:
    from ..views.live import LiveView

_REDRAWN = 0.25  # s between two pictures of the status


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command line, in s and Hz; see ``pumafuse live --help``."""

    config: Path
    rate: float | None
    window: float
    stale_after: float
    status: bool
    out: str | None
    record: Path | None
    rerun: str | None
    listen: str | None
    allow: list[str]


def run(source: str, options: Options) -> None:
    """Estimate from a stream until it ends, or a signal ends it.

    Raises:
        PumafuseError: The configuration, the source, the run or a folder is wrong.
    """
    address, config, start = Address.parse(source), FusionConfig.load(options.config), dict[str, float]()
    if options.listen and address.kind not in LISTENERS:
        raise ConfigError(f"--listen: goes with a source udp://HOST:PORT or tcp-listen://HOST:PORT, not {source}")
    recorded = Run.read(address.path) if address.kind == "replay" else None
    if recorded is not None:
        start = dict(recorded.start)
        config = msgspec.structs.replace(config, frame=recorded.frame or config.frame)
    errors = _console()

    def notify(text: str) -> None:
        with contextlib.suppress(OSError):  # a log that is full costs the log, not the estimates
            errors.print(text, markup=False, soft_wrap=True)

    remote = network.source(address, options.listen, options.allow, notify) if address.kind in NETWORK else None
    with contextlib.ExitStack() as stack:
        signals = stack.enter_context(_caught_signals())
        out = stack.enter_context(contextlib.closing(UdpSender(options.out))) if options.out else None
        estimator = partial(
            LiveEstimator, config, window=options.window, stale_after=options.stale_after, start=start, on_notice=notify
        )
        estimator().warm_up()  # before anything is made or listens: meanwhile datagrams would be lost
        gc.freeze()  # what is here stays: looking through it again and again would take longer than an estimate may
        recorder = Recorder(options.record, config, start, notify) if options.record else None
        live = estimator(event_log=recorder)
        if recorder is not None:
            stack.callback(lambda: recorder.close(live.sure))
        view = None
        if options.rerun:
            from ..views.live import LiveView

            view = LiveView(options.rerun, config, notify)
            stack.callback(view.close)
        stream = Stream(live, _output(out, options.status), notify, options.rate, [] if view is None else [view])
        parts = [part for part in (remote, recorder, out) if part is not None]
        screen = None
        if options.status and errors.is_terminal:
            screen = stack.enter_context(Live(console=errors, auto_refresh=False, transient=True))
        feeder = _Feeder(stream, parts, address.speed, recorder, view, screen)
        if remote is not None:
            _listen(remote, feeder, signals)
        else:
            for items in standard_input() if recorded is None else replayed(recorded, config, address.speed):
                feeder.take(items)
                if signals:
                    break
        stream.end()
    with contextlib.suppress(OSError):
        summarise(stream, parts, errors)


def _console() -> Console:
    """Standard error, or nothing where it is closed."""
    there = sys.stderr is not None  # pyright: ignore[reportUnnecessaryComparison]
    file = sys.stderr if there else StringIO()
    return Console(file=file, highlight=False, width=None if file.isatty() else 120)


def _output(out: UdpSender | None, status: bool) -> Callable[[list[bytes]], None]:
    """Where estimates go: not to the screen that shows the status, as both would write over each other."""
    if out is not None:
        return out
    if sys.stdout is None:  # pyright: ignore[reportUnnecessaryComparison]
        raise RunError("standard output is closed; send the estimates elsewhere with --out udp://HOST:PORT")
    return (lambda _: None) if status and sys.stdout.isatty() else _to_standard_output


def _to_standard_output(lines: list[bytes]) -> None:
    try:
        sys.stdout.buffer.write(b"".join(lines))
        sys.stdout.buffer.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        sys.stdout = None  # what is left in its buffer would be tried once more at exit
        raise RunError(f"standard output: cannot be written: {error.strerror}") from None


def _listen(remote: network.Source, feeder: _Feeder, signals: list[int]) -> None:
    """Feed what comes from the network until a signal ends it, and what has come until then."""
    remote.start()
    try:
        while not signals:
            feeder.take(remote.get())
    finally:
        left = remote.stop()
    feeder.take(left)


class _Feeder:
    """Feeds a stream, and gives the recorder, the view and the screen their turn."""

    def __init__(
        self,
        stream: Stream,
        parts: Sequence[Part],
        speed: float,
        recorder: Recorder | None,
        view: LiveView | None,
        screen: Live | None,
    ) -> None:
        self._stream, self._parts, self._speed = stream, parts, speed
        self._recorder, self._view, self._screen = recorder, view, screen
        self._sure: int | None = None
        self._moved = self._drawn = time.monotonic()

    def take(self, items: Sequence[bytes | Event]) -> None:
        """Feed some items, or none: where the stream's time stands still it goes on by the wall clock's."""
        stream, now = self._stream, time.monotonic()
        if items:
            stream.take(items)
        sure = stream.live.sure
        if sure != self._sure:
            self._sure, self._moved = sure, now
        elif sure is not None and now - self._moved > QUIET and math.isfinite(self._speed):
            stream.idle(sure + round((now - self._moved - QUIET) * self._speed * 1e9))
        if self._recorder is not None:
            self._recorder.tick(sure)
        if self._view is not None:
            self._view.tick(stream.live.health)
        if self._screen is not None and now - self._drawn >= _REDRAWN:
            self._screen.update(status(stream, self._parts), refresh=True)
            self._drawn = now


@contextlib.contextmanager
def _caught_signals() -> Generator[list[int]]:
    """The signals that have asked for an end: Ctrl-C and SIGTERM; a second one ends at once."""
    caught: list[int] = []

    def catch(number: int, _: object) -> None:
        if caught:
            raise KeyboardInterrupt
        caught.append(number)

    before = {number: signal.signal(number, catch) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Part(Protocol):
    """Part beside a stream: the source, the recorder, the sender of estimates."""

    def summary(self) -> str:
        """What there was, in a sentence; empty for nothing."""
        ...


def status(stream: Stream, parts: Sequence[Part] = ()) -> Group:
    """One screen: the position of each axis, and how each sensor does."""
    live, health = stream.live, stream.live.health()
    estimate = live.estimate()
    axes = Table(box=box.SIMPLE_HEAD)
    for heading in ("axis", "position, mm", "± sd, mm", "velocity, mm/s", ""):
        axes.add_column(heading, justify="left" if heading in ("axis", "") else "right")
    for name, axis in estimate.axes.items():
        axes.add_row(
            escape(name),
            f"{axis.position * MM:.3f}",
            f"{axis.position_sd * MM:.3f}",
            f"{axis.velocity * MM:.1f}",
            "[red]stale[/red]" if name in estimate.stale else "",
        )
    now = "no event yet" if live.newest is None else f"t = {estimate.time:.3f} s, {estimate.reason}"
    return Group(Text(now), axes, _sensor_table(health), *map(Text, _sentences(stream, health, parts)))


def summarise(stream: Stream, parts: Sequence[Part], errors: Console) -> None:
    """Print the counts of a stream and of the parts beside it, and how each sensor did."""
    health = stream.live.health()
    for sentence in _sentences(stream, health, parts):
        errors.print(sentence, markup=False, soft_wrap=True)
    if any(sensor.rows for sensor in health.sensors.values()):
        errors.print(_sensor_table(health))


def _sensor_table(health: Health) -> Table:
    """Rate, lateness, dropouts and NIS of each sensor, and its components by outcome."""
    caption = "outcomes count components: each axis of a row by itself"
    table = Table(box=box.SIMPLE_HEAD, caption=caption, caption_justify="left")
    words = [one.word for one in Outcome if any(sensor.outcomes[one.word] for sensor in health.sensors.values())]
    table.add_column("sensor")
    for heading in ("rows", "rate, Hz", "late, ms", "at most", "dropouts", "NIS", "silent, s", *words):
        table.add_column(heading, justify="right")
    for name, sensor in health.sensors.items():
        silent = "no row yet" if sensor.silent is None else f"{sensor.silent:.1f}"
        table.add_row(
            escape(name),
            str(sensor.rows),
            f"{sensor.rate:.1f}",
            f"{sensor.lateness * MS:.1f}",
            f"{sensor.lateness_max * MS:.1f}",
            str(sensor.dropouts),
            "" if sensor.nis is None else f"{sensor.nis:.2f}",
            f"[red]{silent}[/red]" if sensor.stale else silent,
            *(str(sensor.outcomes[word]) for word in words),
        )
    return table


def _sentences(stream: Stream, health: Health, parts: Sequence[Part]) -> list[str]:
    """The counts of lines, commands, estimates and restarts; then the summary of each part beside the stream."""
    commands = [f"{count} {word}" for word, count in health.commands.items() if count]
    counts = [f"{stream.lines} lines, {stream.bad} of them bad"] if stream.lines else []
    counts += [f"commands: {', '.join(commands) or 'none'}", f"{stream.estimates} estimates"]
    counts += [f"{health.unknown} rows of unknown sensors"] if health.unknown else []
    counts += [f"{health.segments} segments"] if health.segments > 1 else []
    return ["; ".join(counts), *filter(None, (part.summary() for part in parts))]
