"""A live estimator's view in Rerun: :class:`LiveView`.

The drawing is done by a process of its own (:mod:`pumafuse.views.live_drawer`), which gets a frame ten times a second
through a pipe. Whatever becomes of it, of the viewer or of the connection between them, the estimator does not wait:
a frame that does not fit into the pipe is left out.

Entities: ``<axis>/command``, ``/estimate`` with ``/upper`` and ``/lower`` at ±2σ, ``/<sensor>`` and
``/<sensor>/rejected``; ``residual/<axis>/<sensor>``, the measurement minus the estimate, between ``/upper`` and
``/lower``
of the estimate; ``path/command``, ``path/estimate``, ``path/tool`` in 3D, and with a frame ``path/<sensor>``;
``nis/<sensor>``, ``rate/<sensor>``. All against seconds since the first event, positions in mm. With a frame, commands
and measurements in x, y, z are in 3D only. A sensor with a bias is drawn less its mean distance from the estimate.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from ..errors import ConfigError
from ..filter.outcome import Outcome
from ..live.answers import MET
from ..logs.frames import CARTESIAN
from ..model.arm import CANONICAL_AXES, ordered_axes
from .live_frames import Band, Frame, Header, Met, Path, SensorHead, SensorsNow, Series, packed

if TYPE_CHECKING:
    from ..fusion.config import FusionConfig
    from ..live.answers import LiveEstimate, UpdateResult
    from ..live.health import Health
    from ..live.wire import Event

MODES = ("spawn", "connect", "web")
PORT = 9876  # of the viewer or its server
WEB_PORT = 9090  # of the page
_FRAME = 0.1  # s between frames
_HEALTH = 1.0  # s between looks at the health
_MOST = 500  # rows of one source in a frame; a plot is not wider
_LONGEST_END = 2.0  # s
_Row: TypeAlias = "tuple[float, Mapping[str, Any], Mapping[str, Outcome]]"


class _Gathered:
    """Rows since the last frame, evenly thinned where there are too many.

    Attributes:
        left_out: How many rows have been left out so far.
    """

    def __init__(self) -> None:
        self.left_out = 0
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
        self.left_out += self._count - len(rows)
        self._count, self._every = 0, 1
        return rows


class LiveView:
    """Draws what a live estimator hears and says.

    Attributes:
        frames: How many frames have been sent.
        dropped: How many were left out because the pipe was full.
    """

    def __init__(self, mode: str, config: FusionConfig, say: Callable[[str], None]) -> None:
        """Start to draw.

        Args:
            mode: ``spawn`` opens a viewer; ``connect`` draws into one that is open; ``web`` serves a page.
            config: Of the estimator.
            say: Takes a sentence for the log.

        Raises:
            ConfigError: There is no such mode, or drawing is not possible here.
        """
        if mode not in MODES:
            raise ConfigError(f"--rerun: no mode '{mode}'; there are: {', '.join(MODES)}")
        if os.name != "posix":
            raise ConfigError("--rerun: the live view needs Linux or macOS; a result folder can be drawn everywhere")
        if importlib.util.find_spec("rerun") is None or importlib.util.find_spec("rerun_cli") is None:
            raise ConfigError("--rerun: rerun-sdk is not installed; pip install rerun-sdk")
        self.frames = self.dropped = 0
        self._say = say
        self._axes = ordered_axes(set(config.arm.axes))
        self._space = _space(config)
        self._in_space = [name for name, sensor in config.sensors.items() if sensor.scale == 1.0 and not sensor.bias_sd]
        self._framed = config.frame is not None
        self._origin: float | None = None
        self._newest = 0.0
        self._segments = 1
        self._events = {name: _Gathered() for name in ("", *config.sensors)}
        self._estimates = _Gathered()
        self._sent = self._asked = 0.0
        self._rest, self._notices = b"", b""
        self._child: subprocess.Popen[bytes] | None = _start()
        self._write(packed(self._header(mode, config)))

    @property
    def left_out(self) -> int:
        """How many events and estimates have been thinned out of frames."""
        return self._estimates.left_out + sum(gathered.left_out for gathered in self._events.values())

    def event(self, event: Event, told: UpdateResult) -> None:
        """Take in an event and what became of it."""
        if self._child is None or told.outcome not in MET:
            return
        t, sensor, values = event
        moment = t if type(t) is float else t / 1e9
        if self._origin is None:
            self._origin = moment
        self._events[sensor].add((moment - self._origin, values, told.axes))

    def estimate(self, estimate: LiveEstimate) -> None:
        """Take in an estimate."""
        if self._child is None or self._origin is None or estimate.outcome is not Outcome.FUSED:
            return
        moment = estimate.stamp / 1e9 - self._origin
        self._newest = max(moment, self._newest)
        self._estimates.add((moment, estimate.axes, estimate.cartesian))

    def tick(self, health: Callable[[], Health]) -> None:
        """Send a frame if it is time; ask for the health now and then."""
        now = time.monotonic()
        if self._child is None or now - self._sent < _FRAME:
            return
        self._sent = now
        self._hear()
        frame = self._frame()
        if now - self._asked >= _HEALTH:
            self._asked = now
            frame.health = self._health(health())
        self._send(frame)

    def close(self) -> None:
        """Send the last frame and end the drawing."""
        if self._child is None:
            return
        child, deadline = self._child, time.monotonic() + _LONGEST_END
        self._send(self._frame())
        while self._rest and time.monotonic() < deadline:
            time.sleep(0.01)
            self._write(b"")
        self._shut(child)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(max(deadline - time.monotonic(), 0.0))
        self._hear()
        self._end()

    def _frame(self) -> Frame:
        frame = Frame()
        for source, gathered in self._events.items():
            rows = gathered.take()
            if rows and source:
                frame.measurements[source] = _met(rows, self._axes)
            elif rows:
                frame.commands = _commanded(rows, self._axes)
            if rows and self._space and (not source or (self._framed and source in self._in_space)):
                path = _path([(t, values) for t, values, _ in rows], self._space)
                frame.paths[source or "command"] = path
        rows = self._estimates.take()
        frame.estimates = _estimated(rows)
        if self._space:
            places = [
                (t, cartesian if self._framed else {axis: now.position for axis, now in axes.items()})
                for t, axes, cartesian in rows
            ]
            frame.paths["estimate"] = _path(places, self._space)
        return frame

    def _health(self, health: Health) -> SensorsNow:
        """The health for a frame; after a jump of the stream's clock, time goes on where it was."""
        if health.segments != self._segments and health.newest is not None and self._origin is not None:
            self._segments = health.segments
            self._origin = health.newest / 1e9 - self._newest
        nis = {name: sensor.nis for name, sensor in health.sensors.items() if sensor.nis is not None}
        return SensorsNow(self._newest, nis, {name: sensor.rate for name, sensor in health.sensors.items()})

    def _header(self, mode: str, config: FusionConfig) -> Header:
        sensors = {
            name: SensorHead(sensor.scale, sensor.latency, sensor.bias_sd > 0.0)
            for name, sensor in config.sensors.items()
        }
        return Header(mode, self._axes, self._space, sensors, PORT, WEB_PORT)

    def _send(self, frame: Frame) -> None:
        """Put a frame into the pipe; leave it out if the one before has not gone in yet."""
        self._write(b"")
        if self._rest:
            self.dropped += 1
        elif self._child is not None:
            self.frames += 1
            self._write(packed(frame))

    def _write(self, message: bytes) -> None:
        """Write what is left, and a message, as far as the pipe takes it."""
        self._rest += message
        if self._child is None or not self._rest:
            return
        assert self._child.stdin is not None
        try:
            self._rest = self._rest[os.write(self._child.stdin.fileno(), self._rest) :]
        except BlockingIOError:
            return
        except OSError:
            self._rest = b""  # nobody reads: its end is noticed with the next frame

    def _hear(self) -> None:
        """Pass on what the drawing process has to say; notice its end."""
        child = self._child
        if child is None:
            return
        assert child.stdout is not None
        with contextlib.suppress(BlockingIOError):
            self._notices += os.read(child.stdout.fileno(), 1 << 16)
        *lines, self._notices = self._notices.split(b"\n")
        for line in lines:
            self._say(line.decode(errors="replace"))
        if child.poll():
            self._say(f"Rerun: the drawing process ended by itself ({_ended(child.returncode)}); nothing more is drawn")
        if child.returncode is not None:
            self._end()

    def _shut(self, child: subprocess.Popen[bytes]) -> None:
        assert child.stdin is not None
        with contextlib.suppress(OSError):
            child.stdin.close()

    def _end(self) -> None:
        """Leave nothing behind of the drawing process, its server included."""
        child, self._child = self._child, None
        if child is None:
            return
        self._rest = b""
        self._events = {name: _Gathered() for name in self._events}
        self._estimates = _Gathered()
        with contextlib.suppress(OSError):
            os.killpg(child.pid, signal.SIGKILL)
        self._shut(child)
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


def _ended(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit status {code}"


def _space(config: FusionConfig) -> tuple[str, ...]:
    """What a position in space is made of."""
    if config.frame is not None:
        return CARTESIAN
    return CANONICAL_AXES if set(CANONICAL_AXES) <= set(config.arm.axes) else ()


def _commanded(rows: Sequence[_Row], axes: Sequence[str]) -> dict[str, Series]:
    found = {axis: Series() for axis in axes}
    for moment, values, outcomes in rows:
        for axis, outcome in outcomes.items():
            if outcome is Outcome.FUSED and axis in values:
                found[axis].time.append(moment)
                found[axis].value.append(float(values[axis]))
    return found


def _met(rows: Sequence[_Row], axes: Sequence[str]) -> dict[str, Met]:
    found = {axis: Met() for axis in axes}
    for moment, values, outcomes in rows:
        for axis, outcome in outcomes.items():
            if outcome in MET and axis in values:
                one = found[axis]
                one.time.append(moment)
                one.value.append(float(values[axis]))
                one.rejected.append(outcome is Outcome.REJECTED)
    return found


def _estimated(rows: Sequence[tuple[float, Mapping[str, Any], Any]]) -> dict[str, Band]:
    found: dict[str, Band] = {}
    for moment, axes, _ in rows:
        for axis, now in axes.items():
            band = found.get(axis) or found.setdefault(axis, Band())
            band.time.append(moment)
            band.position.append(now.position)
            band.sd.append(now.position_sd)
    return found


def _path(rows: Sequence[tuple[float, Mapping[str, float] | None]], space: Sequence[str]) -> Path:
    first, second, third = space
    path = Path()
    for moment, place in rows:
        if place is not None and first in place and second in place and third in place:
            path.time.append(moment)
            path.position.append((float(place[first]), float(place[second]), float(place[third])))
    return path
