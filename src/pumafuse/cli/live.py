"""`pumafuse live`."""

from __future__ import annotations

import contextlib
import math
import signal
import sys
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from ..errors import RunError
from ..fusion.config import FusionConfig
from ..fusion.timeline import Outcome
from ..live.estimator import LiveEstimator
from ..live.health import Health
from ..live.sources import QUIET, Address, replayed, standard_input
from ..live.stream import Stream
from ..live.wire import Event
from ..runs.run import Run
from ..units import MM

_REDRAWN = 0.25  # s between two pictures of the status


@dataclass(frozen=True, kw_only=True)
class Options:
    """What the command line asks of a stream; see ``pumafuse live --help``."""

    config: Path
    rate: float | None
    window: float
    stale_after: float
    status: bool


def run(source: str, options: Options) -> None:
    """Estimate from a stream until it ends, or somebody ends it.

    Raises:
        PumafuseError: The configuration, the source or the run is wrong.
    """
    address, config, start = Address.parse(source), FusionConfig.load(options.config), dict[str, float]()
    recorded = Run.read(address.path) if address.kind == "replay" else None
    if recorded is not None:
        start = dict(recorded.start)
        config = msgspec.structs.replace(config, frame=recorded.frame or config.frame)
    errors = Console(stderr=True, highlight=False, width=None if sys.stderr.isatty() else 120)

    def say(text: str) -> None:
        errors.print(text, markup=False, soft_wrap=True)

    def write(lines: bytes) -> None:
        try:
            sys.stdout.buffer.write(lines)
            sys.stdout.buffer.flush()
        except BrokenPipeError:
            raise
        except OSError as error:
            sys.stdout = None  # what is left in its buffer would be tried once more at exit
            raise RunError(f"standard output: cannot be written: {error.strerror}") from None

    live = LiveEstimator(config, window=options.window, stale_after=options.stale_after, start=start, on_notice=say)
    hidden = options.status and sys.stdout.isatty()  # the screen and the lines would write over each other
    stream = Stream(live, (lambda _: None) if hidden else write, say, options.rate)
    pieces = standard_input() if recorded is None else replayed(recorded, config, address.speed)
    with ended_by_signals() as ended, _screen(errors, options.status) as screen:
        _follow(stream, pieces, ended, screen, 1.0 if recorded is None else address.speed)
        stream.end(cut=bool(ended))
    summarise(stream, errors)


def _follow(
    stream: Stream, pieces: Iterator[bytes | list[Event]], ended: list[int], screen: Live | None, speed: float
) -> None:
    """Feed the stream until the source or a signal ends it; when it is quiet its time goes on by the wall's."""
    heard, drawn = time.monotonic(), 0.0
    for piece in pieces:
        now = time.monotonic()
        if piece:
            stream.feed(piece) if isinstance(piece, bytes) else stream.take(piece)
            heard = now
        elif (sure := stream.live.sure) is not None and math.isfinite(speed):
            stream.idle(sure + round((now - heard - QUIET) * speed * 1e9))
        if screen is not None and now - drawn >= _REDRAWN:
            screen.update(status(stream), refresh=True)
            drawn = now
        if ended:
            return


@contextlib.contextmanager
def ended_by_signals() -> Generator[list[int]]:
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


@contextlib.contextmanager
def _screen(errors: Console, wanted: bool) -> Generator[Live | None]:
    if not wanted or not errors.is_terminal:
        yield None
        return
    with Live(console=errors, auto_refresh=False, transient=True) as screen:
        yield screen


def status(stream: Stream) -> Group:
    """One picture of the stream: where the tool is, and how each sensor does."""
    live, health = stream.live, stream.live.health()
    estimate = live.estimate()
    axes = Table(box=box.SIMPLE_HEAD)
    for heading in ("axis", "position, mm", "± sd, mm", "velocity, mm/s", ""):
        axes.add_column(heading, justify="left" if heading in ("axis", "") else "right")
    for name, axis in estimate.axes.items():
        stale = "[red]stale[/red]" if name in estimate.stale else ""
        axes.add_row(
            escape(name),
            f"{axis.position * MM:.3f}",
            f"{axis.position_sd * MM:.3f}",
            f"{axis.velocity * MM:.1f}",
            stale,
        )
    told = "no event yet" if live.newest is None else f"t = {estimate.time:.3f} s, {estimate.reason}"
    return Group(Text(told), axes, sensor_table(health), Text(counted(stream, health)))


def sensor_table(health: Health) -> Table:
    """Rate, lateness, dropouts, NIS and outcomes of each sensor."""
    table = Table(box=box.SIMPLE_HEAD)
    words = [
        word for word in (o.word for o in Outcome) if any(sensor.outcomes[word] for sensor in health.sensors.values())
    ]
    table.add_column("sensor")
    for heading in ("rows", "rate, Hz", "late, ms", "at most", "dropouts", "NIS", "silent, s", *words):
        table.add_column(heading, justify="right")
    for name, sensor in health.sensors.items():
        silent = "never heard" if sensor.silent is None else f"{sensor.silent:.1f}"
        table.add_row(
            escape(name),
            str(sensor.rows),
            f"{sensor.rate:.1f}",
            f"{sensor.lateness * MM:.1f}",
            f"{sensor.lateness_max * MM:.1f}",
            str(sensor.dropouts),
            "" if sensor.nis is None else f"{sensor.nis:.2f}",
            f"[red]{silent}[/red]" if sensor.stale else silent,
            *(str(sensor.outcomes[word]) for word in words),
        )
    return table


def counted(stream: Stream, health: Health) -> str:
    """Lines, commands, restarts and estimates in one sentence."""
    parts = [f"{count} {word}" for word, count in health.commands.items() if count]
    said = [f"commands: {', '.join(parts) or 'none'}", f"{stream.estimates} estimates"]
    if stream.lines:
        said.insert(0, f"{stream.lines} lines, {stream.bad} of them bad")
    if health.unknown:
        said.append(f"{health.unknown} rows of unknown sensors")
    if health.segments > 1:
        said.append(f"{health.segments} segments")
    return "; ".join(said)


def summarise(stream: Stream, errors: Console) -> None:
    """What there was, for people."""
    health = stream.live.health()
    errors.print(counted(stream, health), markup=False)
    if any(sensor.rows for sensor in health.sensors.values()):
        errors.print(sensor_table(health))
