"""`pumafuse live`."""

from __future__ import annotations

import contextlib
import gc
import math
import signal
import sys
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import msgspec
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from ..errors import ConfigError, RunError, warn
from ..filter.outcome import Outcome
from ..fusion.config import FusionConfig
from ..fusion.placing import add_tool
from ..live import network
from ..live.address import LISTENERS, NETWORK, OF_A_RUN, POSES, Address
from ..live.estimator import LiveEstimator
from ..live.network import Remote, Several, UdpSender
from ..live.record import Recorder
from ..live.ros2 import Ros2Estimates, Ros2Source
from ..live.rtde import RtdeSource
from ..live.sources import QUIET, replay, standard_input
from ..live.stream import Stream, Watcher
from ..live.wire import Event
from ..logs import manifest
from ..logs.clock import without_strays
from ..logs.run import Run
from ..units import MS
from .tables import Columns, cells, console, headings, print_tables, table

_REDRAWN = 0.25  # s between two pictures of the status
_LAST, _AT_ONCE = 1.0, 256  # s in which what has come is taken in at the end; lines between two looks at the clock
_AXIS: Columns = {
    "position, {unit}": ("position", ".3f", None),
    "± sd, {unit}": ("position_sd", ".3f", None),
    "velocity, {unit}/s": ("velocity", ".1f", None),
}
_SENSOR: Columns = {
    "rows": ("rows", ".0f", 1.0),
    "rate, Hz": ("rate", ".1f", 1.0),
    "late, ms": ("lateness", ".1f", MS),
    "at most": ("lateness_max", ".1f", MS),
    "dropouts": ("dropouts", ".0f", 1.0),
    "NIS": ("nis", ".2f", 1.0),
    "silent, s": ("silent", ".1f", 1.0),
}


def run(
    addresses: list[str],
    config: Path,
    rate: float | None,
    window: float,
    stale_after: float,
    out: str | None,
    record: Path | None,
    rerun: str | None,
    status: bool,
    listen: str | None,
    allow: list[str],
    ros_args: list[str],
) -> None:
    """Estimate from a stream until it ends, or a signal ends it; the arguments are the options, in s and Hz."""
    sources, configured, start = list(map(Address.parse, addresses)), FusionConfig.load(config), dict[str, float]()
    first_source, kinds = sources[0], [source.kind for source in sources]
    if listen and not set(LISTENERS) & set(kinds):
        raise ConfigError(f"--listen: goes with a source udp://HOST:PORT or tcp-listen://HOST:PORT, not {addresses[0]}")
    if len(sources) > 1 and (lonely := {"stdin", "replay"} & set(kinds)):
        raise ConfigError(f"{lonely.pop()}: cannot go with other sources; only those of the network can")
    if kinds.count("ros2") > 1:
        raise ConfigError("ros2: one node is enough; one run.toml may name all topics")
    recorded = without_strays(Run.read(first_source.path)) if first_source.kind == "replay" else None
    if recorded is not None:
        warn(f"run '{recorded.name}': {note}" for note in recorded.notes)
        start = dict(recorded.start)
        configured = add_tool(msgspec.structs.replace(configured, frame=recorded.frame or configured.frame), recorded)
    files = {source: manifest.file_of(Path(source.path)) for source in sources if source.kind in OF_A_RUN}
    listed = {address: manifest.load(file) for address, file in files.items()}
    for address, described_run in listed.items():
        start |= described_run.command.start
        robot = configured.robot if described_run.robot is None else described_run.robot.beside(files[address].parent)
        configured = msgspec.structs.replace(configured, frame=described_run.frame or configured.frame, robot=robot)
    errors = console(sys.stderr)

    def notify(text: str) -> None:
        with contextlib.suppress(OSError):  # a log that is full costs the log, not the estimates
            errors.print(text, markup=False, soft_wrap=True)

    with contextlib.ExitStack() as stack:
        remotes = [
            _open(source, listed.get(source), configured, stack, notify, listen=listen, allow=allow, ros_args=ros_args)
            for source in sources
            if source.kind in (*NETWORK, *OF_A_RUN, POSES)
        ]
        remote = Several(remotes) if len(remotes) > 1 else next(iter(remotes), None)
        ros = next((source for source in remotes if isinstance(source, Ros2Source)), None)
        signals = stack.enter_context(_caught_signals())
        sender = stack.enter_context(contextlib.closing(UdpSender(out))) if out else None
        estimator = partial(
            LiveEstimator, configured, window=window, stale_after=stale_after, start=start, on_notice=notify
        )
        gc.freeze()  # what is here stays: looking through it again and again would take longer than an estimate may
        for doubt in configured.arm.doubts() + ([] if configured.robot else configured.arm.joint_doubts()):
            notify(doubt)
        recorder = Recorder(record, configured, start, notify) if record else None
        live = estimator(event_log=recorder)
        if recorder is not None:
            stack.callback(lambda: recorder.close(live.sure))
        views = list[Watcher]()
        if rerun:
            from ..views.live import LiveView

            views.append(stack.enter_context(contextlib.closing(LiveView(rerun, configured, notify))))
        if ros is not None:
            views.append(Ros2Estimates(ros, live))
        write = sender or _output(published=ros is not None, status=status)
        stream = Stream(live, write, notify, rate, views)
        screen = None
        if status and errors.is_terminal:
            screen = stack.enter_context(Live(console=errors, auto_refresh=False, transient=True))
        summaries = [part.summary for part in (remote, recorder, sender) if part is not None]
        speed = math.inf if ros is not None and ros.simulated else first_source.speed  # a simulation may stand still
        feeder = _Feeder(stream, summaries, speed, recorder, views, screen)
        if remote is not None:
            if left := _listen(remote, feeder, signals):
                notify(f"{left} events had come and are left out: the end was asked for")
        else:
            for items in standard_input() if recorded is None else replay(recorded, configured, first_source.speed):
                feeder.add(items)
                if signals:
                    break
        stream.end()
    for sentence in _sentences(stream, summaries):
        notify(sentence)
    with contextlib.suppress(OSError):
        print_tables([_sensor_table(live, feeder.now)], "stderr")


def _open(
    address: Address,
    listed: manifest.Manifest | None,
    config: FusionConfig,
    stack: contextlib.ExitStack,
    notify: Callable[[str], None],
    *,
    listen: str | None,
    allow: list[str],
    ros_args: list[str],
) -> Remote:
    """A source of the network; the stack closes what has to be."""
    if address.kind == POSES:
        from ..live.openigtlink import OpenIgtLinkSource

        return OpenIgtLinkSource(address, config, notify)
    if listed is None:
        return network.source(address, listen, allow, notify)
    if address.kind == "rtde":
        return RtdeSource(address, listed, 1.0 / config.arm.update_period, notify)
    return stack.enter_context(contextlib.closing(Ros2Source(listed, ros_args, notify)))


def _output(*, published: bool, status: bool) -> Callable[[list[bytes]], None]:
    """Writer to standard output; not of what is published, nor to the screen that shows the status."""
    if published:
        return lambda _: None
    if sys.stdout is None:  # pyright: ignore[reportUnnecessaryComparison]
        raise RunError("standard output is closed; send the estimates elsewhere with --out udp://HOST:PORT")
    if status and sys.stdout.isatty():
        return lambda _: None
    return _to_standard_output


def _to_standard_output(lines: list[bytes]) -> None:
    try:
        sys.stdout.buffer.write(b"".join(lines))
        sys.stdout.buffer.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        sys.stdout = None  # what is left in its buffer would be tried once more at exit
        raise RunError(f"standard output: cannot be written: {error.strerror}") from None


def _listen(remote: Remote, feeder: _Feeder, signals: list[int]) -> int:
    """Feed what comes from the network until a signal ends it, and then for at most 1 s what has come until then."""
    remote.start()
    try:
        while not signals:
            feeder.add(remote.get())
    finally:
        left = remote.stop()
    until = time.monotonic() + _LAST
    for begin in range(0, len(left), _AT_ONCE):
        if time.monotonic() > until:
            return len(left) - begin
        feeder.add(left[begin : begin + _AT_ONCE])
    return 0


@dataclass
class _Feeder:
    """Feeds a stream, and gives the recorder, the views and the screen their turn."""

    stream: Stream
    summaries: Sequence[Callable[[], str]]
    speed: float
    recorder: Recorder | None
    views: Sequence[Watcher]
    screen: Live | None
    sure: int | None = None
    now: int | None = None
    moved: float = field(default_factory=time.monotonic)
    drawn: float = field(default_factory=time.monotonic)

    def add(self, items: Sequence[bytes | Event]) -> None:
        """Feed some items, or none: where the stream's time stands still it goes on by the wall clock's."""
        now = time.monotonic()
        self.stream.add(items)
        sure = self.stream.live.sure
        if sure != self.sure:
            self.sure, self.now, self.moved = sure, None, now
        elif sure is not None and now - self.moved > QUIET and math.isfinite(self.speed):
            self.now = sure + round((now - self.moved - QUIET) * self.speed * 1e9)
            self.stream.idle(self.now)
        if self.recorder is not None:
            self.recorder.tick(sure)
        for view in self.views:
            view.tick(lambda: self.stream.live.health(self.now))
        if self.screen is not None and now - self.drawn >= _REDRAWN:
            self.screen.update(status(self.stream, self.summaries, self.now), refresh=True)
            self.drawn = now


@contextlib.contextmanager
def _caught_signals() -> Generator[list[int]]:
    """The signals that have asked for an end: Ctrl-C, SIGTERM and SIGHUP; a second one ends at once."""
    caught: list[int] = []

    def catch(number: int, _: object) -> None:
        if caught:
            raise KeyboardInterrupt
        caught.append(number)

    names = "SIGINT", "SIGTERM", "SIGHUP"  # Windows has no SIGHUP; nohup ignores it
    numbers = [number for name in names if (number := getattr(signal, name, None)) is not None]
    ending = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, catch) for number in ending}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def status(stream: Stream, summaries: Sequence[Callable[[], str]] = (), now: int | None = None) -> Group:
    """One screen: the position of each axis, and how each sensor does."""
    estimate = stream.live.estimate(now)
    time = "no event yet" if stream.live.newest is None else f"t = {estimate.time:.3f} s, {estimate.reason}"
    doubts = {"stale": estimate.stale, "doubtful": estimate.doubtful}
    arm, tables = stream.live.config.arm, list[Table]()
    for kind in arm.kinds:
        rows = [
            [name, *cells(axis, _AXIS, kind), ", ".join(word for word, axes in doubts.items() if name in axes)]
            for name, axis in estimate.axes.items()
            if arm.axes[name].kind == kind
        ]
        tables.append(table(["axis", *headings(_AXIS, kind), ""], rows))
    return Group(Text(time), *tables, _sensor_table(stream.live, now), *map(Text, _sentences(stream, summaries)))


def _sensor_table(live: LiveEstimator, now: int | None) -> Table:
    """Rate, lateness, dropouts and NIS of each sensor, and its components by outcome."""
    sensors = live.health(now).sensors
    words = [outcome.word for outcome in Outcome if any(sensor.outcomes[outcome.word] for sensor in sensors.values())]
    rows = [
        [
            name,
            *cells(sensor, _SENSOR),
            "stale" if sensor.stale else "",
            *(str(sensor.outcomes[word]) for word in words),
        ]
        for name, sensor in sensors.items()
    ]
    made = table(["sensor", *_SENSOR, "", *words], rows)
    made.caption = "outcomes count components: each axis of a row by itself"
    return made


def _sentences(stream: Stream, summaries: Sequence[Callable[[], str]]) -> list[str]:
    """The counts of lines, commands, estimates and restarts; then the summary of each part beside the stream."""
    health = stream.live.health()
    commands = [f"{count} {word}" for word, count in health.commands.items() if count]
    counts = [f"{stream.lines} lines, {stream.bad} of them bad"] if stream.lines else []
    counts += [f"commands: {', '.join(commands) or 'none'}", f"{stream.estimates} estimates"]
    counts += [f"{health.unknown} rows of unknown sensors"] if health.unknown else []
    counts += [f"{health.segments} segments"] if health.segments > 1 else []
    return ["; ".join(counts), *health.faults, *filter(None, (summary() for summary in summaries))]
