"""A live estimator's view in Rerun: :class:`LiveView`.

The drawing is done by a process of its own (:mod:`pumafuse.views.live_drawer`), which gets a frame ten times a second
through a pipe. Whatever becomes of it, of the viewer or of the connection between them, the estimator does not wait:
a frame that does not fit into the pipe is left out.

Entities: ``<axis>/command``, ``/estimate`` with ``/upper`` and ``/lower`` at ±2σ, ``/<sensor>`` and
``/<sensor>/rejected``; ``residual/<axis>/<sensor>``, the measurement minus the estimate, between ``/upper`` and
``/lower`` of the estimate; ``path/command``, ``path/estimate``, ``path/tool`` in 3D, and with a frame
``path/<sensor>``; ``nis/<sensor>``, ``rate/<sensor>``. All against seconds since the first event, positions in mm. With
a frame, commands and measurements in x, y, z are in 3D only. A sensor with a bias is drawn less its mean distance from
the estimate.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, BinaryIO, TypeAlias

import msgspec

from ..errors import ConfigError
from ..filter.outcome import Outcome
from ..live.results import COMPARED
from ..logs.frames import CARTESIAN
from ..model.arm import CANONICAL_AXES, ordered_axes

if TYPE_CHECKING:
    from ..fusion.config import FusionConfig
    from ..live.results import Health, LiveEstimate, UpdateResult
    from ..live.wire import Event

Rows: TypeAlias = dict[str, list[tuple[float, ...]]]

_LENGTH = 4  # bytes
_LARGEST = 1 << 26  # bytes of a frame


class SensorHead(msgspec.Struct, array_like=True):
    """How a sensor's measurements become positions: (z − bias) / scale, at stamp − latency.

    Attributes:
        scale: Of the position in the measurement.
        latency: [s].
        biased: Whether a constant bias must be found first.
    """

    scale: float
    latency: float
    biased: bool


class Header(msgspec.Struct):
    """What is drawn, and where.

    Attributes:
        mode: ``spawn``, ``connect`` or ``web``.
        axes: The arm's, in their order.
        space: The three axes, or x, y, z, that are a position in space; empty without.
        sensors: By name.
        port: Where the viewer listens.
        web_port: Where its page is served.
    """

    mode: str
    axes: tuple[str, ...]
    space: tuple[str, ...]
    sensors: dict[str, SensorHead]
    port: int
    web_port: int


class SensorsNow(msgspec.Struct, array_like=True):
    """NIS and rate [Hz] of the sensors that have them, at one time [s]."""

    time: float
    nis: dict[str, float]
    rate: dict[str, float]


class Frame(msgspec.Struct):
    """Everything since the frame before, as rows that begin with their time [s].

    Attributes:
        commands: By axis, rows with u [m].
        measurements: By ``axis/sensor``, rows with z [m] and whether it was rejected (0 or 1).
        estimates: By axis, rows with position and sd [m].
        paths: By ``command``, ``estimate`` and sensors in x, y, z, rows with a position in space [m].
        health: Now and then.
    """

    commands: Rows = {}
    measurements: Rows = {}
    estimates: Rows = {}
    paths: Rows = {}
    health: SensorsNow | None = None

    def add(self, later: Frame) -> None:
        """Add the rows of a later frame."""
        for kind in ("commands", "measurements", "estimates", "paths"):
            mine: Rows = getattr(self, kind)
            for name, rows in getattr(later, kind).items():
                mine.setdefault(name, []).extend(rows)
        self.health = later.health or self.health


def packed(message: Header | Frame) -> bytes:
    """A message as it goes through the pipe."""
    body = msgspec.msgpack.encode(message)
    return len(body).to_bytes(_LENGTH, "big") + body


def bodies(pipe: BinaryIO) -> Iterator[bytes]:
    """The messages that come out of the pipe, until it ends."""
    while len(head := pipe.read(_LENGTH)) == _LENGTH:
        length = int.from_bytes(head, "big")
        body = pipe.read(length)
        if length > _LARGEST or len(body) < length:
            return
        yield body


MODES = ("spawn", "connect", "web")
PORT = 9876  # of the viewer or its server
WEB_PORT = 9090  # of the page
_FRAME = 0.1  # s between frames
_HEALTH = 1.0  # s between two readings of the health
_MOST = 500  # rows of one source in a frame; a plot is not wider
_LONGEST_END = 2.0  # s


class _Thinned:
    """Rows since the last frame, evenly thinned where there are too many."""

    def __init__(self) -> None:
        self._rows: list[Any] = []
        self._count, self._every = 0, 1

    def add(self, row: Any) -> None:
        self._count += 1
        if self._count % self._every == 0:
            self._rows.append(row)
            if len(self._rows) >= _MOST:
                del self._rows[::2]
                self._every *= 2

    def take(self) -> list[Any]:
        rows, self._rows = self._rows, []
        self._count, self._every = 0, 1
        return rows


class LiveView:
    """Plots of the events and estimates of a live estimator.

    Attributes:
        dropped: How many frames were left out because the pipe was full.
    """

    def __init__(self, mode: str, config: FusionConfig, notify: Callable[[str], None]) -> None:
        """Start to draw.

        Args:
            mode: ``spawn`` opens a viewer; ``connect`` draws into one that is open; ``web`` serves a page.
            config: Of the estimator.
            notify: Takes a sentence for the log.

        Raises:
            ConfigError: There is no such mode, or drawing is not possible here.
        """
        if mode not in MODES:
            raise ConfigError(f"--rerun: no mode '{mode}'; there are: {', '.join(MODES)}")
        if os.name != "posix":
            raise ConfigError("--rerun: the live view needs Linux or macOS; a result folder can be drawn everywhere")
        if importlib.util.find_spec("rerun") is None or importlib.util.find_spec("rerun_cli") is None:
            raise ConfigError("--rerun: rerun-sdk is not installed; pip install rerun-sdk")
        self.dropped = 0
        self._notify = notify
        self._framed = config.frame is not None
        axes = ordered_axes(set(config.arm.axes))
        self._space: tuple[str, ...] = CARTESIAN if self._framed else CANONICAL_AXES  # of a position in space
        if not self._framed and not set(CANONICAL_AXES) <= set(axes):
            self._space = ()
        unbiased = {name for name, sensor in config.sensors.items() if sensor.scale == 1.0 and not sensor.bias_sd}
        self._in_space = {"", *(unbiased if self._framed else ())}  # sources that are drawn as positions in space
        self._origin: float | None = None
        self._newest = 0.0
        self._segments = 1
        self._events = {name: _Thinned() for name in ("", *config.sensors)}
        self._estimates = _Thinned()
        self._sent = self._health_read = 0.0
        self._unsent, self._notices = b"", b""
        self._child: subprocess.Popen[bytes] | None = _start()
        sensors = {
            name: SensorHead(sensor.scale, sensor.latency, sensor.bias_sd > 0.0)
            for name, sensor in config.sensors.items()
        }
        self._write(packed(Header(mode, axes, self._space, sensors, PORT, WEB_PORT)))

    def event(self, event: Event, result: UpdateResult) -> None:
        """Take in an event and what became of it."""
        if self._child is None or result.outcome not in COMPARED:
            return
        t, sensor, values = event
        moment = t if type(t) is float else t / 1e9
        if self._origin is None:
            self._origin = moment
        self._events[sensor].add((moment - self._origin, values, result.axes))

    def estimate(self, estimate: LiveEstimate) -> None:
        """Take in an estimate."""
        if self._child is None or self._origin is None or estimate.outcome is not Outcome.FUSED:
            return
        moment = estimate.stamp / 1e9 - self._origin
        self._newest = max(moment, self._newest)
        self._estimates.add((moment, estimate.axes, estimate.cartesian))

    def tick(self, health: Callable[[], Health]) -> None:
        """Send a frame if it is due, now and then with the health."""
        now = time.monotonic()
        if self._child is None or now - self._sent < _FRAME:
            return
        self._sent = now
        self._pass_on_notices()
        frame = self._frame()
        if now - self._health_read >= _HEALTH:
            self._health_read = now
            frame.health = self._health(health())
        self._send(frame)

    def close(self) -> None:
        """Send the last frame and end the drawing."""
        if self._child is None:
            return
        child, deadline = self._child, time.monotonic() + _LONGEST_END
        self._send(self._frame())
        while self._unsent and time.monotonic() < deadline:
            time.sleep(0.01)
            self._write(b"")
        _close_input(child)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(max(deadline - time.monotonic(), 0.0))
        self._pass_on_notices()
        self._end()

    def _frame(self) -> Frame:
        """Everything since the frame before."""
        frame = Frame()
        for source, thinned in self._events.items():
            for moment, values, outcomes in thinned.take():
                for axis, outcome in outcomes.items():
                    if axis in values and source and outcome in COMPARED:
                        row = moment, float(values[axis]), float(outcome is Outcome.REJECTED)
                        frame.measurements.setdefault(f"{axis}/{source}", []).append(row)
                    elif axis in values and not source and outcome is Outcome.FUSED:
                        frame.commands.setdefault(axis, []).append((moment, float(values[axis])))
                if source in self._in_space:
                    self._add_position(frame, source or "command", moment, values)
        for moment, axes, cartesian in self._estimates.take():
            for axis, now in axes.items():
                frame.estimates.setdefault(axis, []).append((moment, now.position, now.position_sd))
            place = cartesian if self._framed else {axis: now.position for axis, now in axes.items()}
            self._add_position(frame, "estimate", moment, place or {})
        return frame

    def _add_position(self, frame: Frame, name: str, moment: float, place: Mapping[str, float]) -> None:
        """Add a position in space to a path, if it is one."""
        if self._space and all(coordinate in place for coordinate in self._space):
            row = moment, *(float(place[coordinate]) for coordinate in self._space)
            frame.paths.setdefault(name, []).append(row)

    def _health(self, health: Health) -> SensorsNow:
        """The health for a frame; after a jump of the stream's clock, time goes on where it was."""
        if health.segments != self._segments and health.newest is not None and self._origin is not None:
            self._segments = health.segments
            self._origin = health.newest / 1e9 - self._newest
        nis = {name: sensor.nis for name, sensor in health.sensors.items() if sensor.nis is not None}
        return SensorsNow(self._newest, nis, {name: sensor.rate for name, sensor in health.sensors.items()})

    def _send(self, frame: Frame) -> None:
        """Put a frame into the pipe; leave it out if the one before has not gone in yet."""
        self._write(b"")
        if self._unsent:
            self.dropped += 1
        elif self._child is not None:
            self._write(packed(frame))

    def _write(self, message: bytes) -> None:
        """Write what is left, and a message, as far as the pipe takes it."""
        self._unsent += message
        if self._child is None or not self._unsent:
            return
        assert self._child.stdin is not None
        try:
            self._unsent = self._unsent[os.write(self._child.stdin.fileno(), self._unsent) :]
        except BlockingIOError:
            return
        except OSError:
            self._unsent = b""  # nobody reads: its end is noticed with the next frame

    def _pass_on_notices(self) -> None:
        """Pass on what the drawing process reports; notice its end."""
        child = self._child
        if child is None:
            return
        assert child.stdout is not None
        with contextlib.suppress(BlockingIOError):
            self._notices += os.read(child.stdout.fileno(), 1 << 16)
        *lines, self._notices = self._notices.split(b"\n")
        for line in lines:
            self._notify(line.decode(errors="replace"))
        if code := child.poll():
            how = f"signal {-code}" if code < 0 else f"exit status {code}"
            self._notify(f"Rerun: the drawing process ended by itself ({how}); nothing more is drawn")
        if child.returncode is not None:
            self._end()

    def _end(self) -> None:
        """Leave nothing behind of the drawing process, its server included."""
        child, self._child = self._child, None
        if child is None:
            return
        self._unsent = b""
        self._events = {name: _Thinned() for name in self._events}
        self._estimates = _Thinned()
        with contextlib.suppress(OSError):
            os.killpg(child.pid, signal.SIGKILL)
        _close_input(child)
        child.wait()
        assert child.stdout is not None
        child.stdout.close()


def _start() -> subprocess.Popen[bytes]:
    """The process that draws, in a group of its own: Ctrl-C is for the estimator, which then ends it."""
    child = subprocess.Popen(
        [sys.executable, "-P", "-m", "pumafuse.views.live_drawer"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        bufsize=0,
        start_new_session=True,
    )
    assert child.stdin is not None and child.stdout is not None
    os.set_blocking(child.stdin.fileno(), False)
    os.set_blocking(child.stdout.fileno(), False)
    return child


def _close_input(child: subprocess.Popen[bytes]) -> None:
    assert child.stdin is not None
    with contextlib.suppress(OSError):
        child.stdin.close()
