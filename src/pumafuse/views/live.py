"""A live estimator's view in Rerun: :class:`LiveView`.

The drawing is done by a process of its own (:mod:`pumafuse.views.live_drawer`), which gets a frame twice a second
through a pipe. Whatever becomes of it, of the viewer or of the connection between them, the estimator does not wait:
a thread writes into the pipe, and a frame that comes while others wait is left out.

Entities are those of a recorded result (:mod:`pumafuse.views.rerun`, :mod:`pumafuse.views.scene`), with a frame
``path/<sensor>``, and ``nis/<sensor>``, ``rate/<sensor>``; ``log``, the faults that begin and end. All against seconds
since the first event, positions in mm or degrees. With a frame, commands and measurements in x, y, z are in 3D only. A
sensor with a bias is drawn less its mean distance from the estimate.
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from ..errors import ConfigError
from ..filter.outcome import Outcome
from ..fusion.config import Sensor, Vector
from ..live.results import COMPARED
from ..logs.frames import CARTESIAN, in_space
from ..space.rotations import TURNING
from ..units import Kind

if TYPE_CHECKING:
    from ..fusion.config import FusionConfig
    from ..live.health import Health
    from ..live.results import LiveEstimate, UpdateResult
    from ..live.wire import Event

# Everything since the frame before, as rows that begin with their time [s]; the first word of a name says what follows:
# ``command/<axis>`` u [m]; ``measurement/<axis>/<sensor>`` z [m] and whether it was rejected (0 or 1);
# ``estimate/<axis>`` position and sd [m]; ``path/command``, ``path/estimate`` and ``path/<sensor>`` a position in space
# [m]; ``nis/<sensor>``; ``rate/<sensor>`` [Hz]; ``log`` a level and a sentence.
Frame: TypeAlias = dict[str, list[tuple[float | str, ...]]]


class Header(msgspec.Struct):
    """What is drawn, and where."""

    mode: str  # spawn, connect or web
    axes: dict[str, Kind]  # the arm's, in their order
    space: tuple[str, ...]  # the three axes, or x, y, z, that are a position in space; empty without
    tool: Vector | None  # of a tool that turns the orientation at which rx, ry, rz are 0, a rotation vector [rad]
    sensors: dict[str, Sensor]
    port: int  # where the viewer listens
    web_port: int  # where its page is served

    def is_biased(self, sensor: str) -> bool:
        """Whether a constant bias must be found before a sensor's measurements are positions."""
        return any(self.sensors[sensor].bias_sd_of(axis) > 0.0 for axis in self.axes)


MODES = ("spawn", "connect", "web")
PORT = 9876  # of the viewer or its server
WEB_PORT = 9090  # of the page
_FRAME = 0.5  # s between frames: a browser without a graphics card takes no more, and would fall behind for good
_HEALTH = 1.0  # s between two readings of the health
_MOST = 1000  # rows of one source in a frame; a plot is not wider
_LONGEST_END = 2.0  # s


class LiveView:
    """Plots of the events and estimates of a live estimator."""

    def __init__(self, mode: str, config: FusionConfig, notify: Callable[[str], None]) -> None:
        """Start to draw."""
        if mode not in MODES:
            raise ConfigError(f"--rerun: no mode '{mode}'; there are: {', '.join(MODES)}")
        if os.name != "posix":
            raise ConfigError("--rerun: the live view needs Linux or macOS; a result folder can be drawn everywhere")
        self.dropped = 0  # frames that were left out because others waited
        self._notify = notify
        self._framed = config.frame is not None
        self._space = CARTESIAN if self._framed else in_space(config.arm)  # of a position in space
        turns = {*CARTESIAN, *TURNING} <= config.arm.axes.keys()
        tool = config.tool.reference if turns and config.tool is not None else None
        header = Header(mode, config.arm.kind_of, self._space, tool, config.sensors, PORT, WEB_PORT)
        unbiased = [
            name for name, sensor in config.sensors.items() if sensor.scale == 1.0 and not header.is_biased(name)
        ]
        self._in_space = {  # sources that are drawn as positions in space; of a tool that turns the drawer makes these
            "",
            *(unbiased if self._space == CARTESIAN and tool is None else ()),
        }
        self._origin: float | None = None
        self._newest = 0.0
        self._segments, self._faults = 1, tuple[str, ...]()
        self._events: dict[str, list[Any]] = {name: [] for name in ("", *config.sensors)}
        self._estimates: list[Any] = []
        self._sent = self._health_read = 0.0
        self._waiting = queue.Queue[bytes | None](1)
        self._child, self._draws, self._closed = _start(), True, False
        threading.Thread(target=self._write_all, name="frames", daemon=True).start()
        self._listener = threading.Thread(target=self._listen, name="notices", daemon=True)
        self._listener.start()
        self._write(header)

    def event(self, event: Event, result: UpdateResult) -> None:
        """Add an event and what became of it."""
        if not self._draws or result.outcome not in COMPARED:
            return
        t, sensor, values = event
        moment = t if type(t) is float else t / 1e9
        if self._origin is None:
            self._origin = moment
        self._events[sensor].append((moment - self._origin, values, result.axes))

    def estimate(self, estimate: LiveEstimate) -> None:
        """Add an estimate."""
        if not self._draws or self._origin is None or estimate.outcome is not Outcome.FUSED:
            return
        moment = estimate.stamp / 1e9 - self._origin
        self._newest = max(moment, self._newest)
        self._estimates.append((moment, estimate.axes, estimate.cartesian))

    def tick(self, health: Callable[[], Health]) -> None:
        """Send a frame if it is due, now and then with the health."""
        now = time.monotonic()
        if not self._draws or now - self._sent < _FRAME:
            return
        self._sent = now
        frame = self._frame()
        if now - self._health_read >= _HEALTH:
            self._health_read = now
            self._add_health(frame, health())
        self._write(frame)

    def close(self) -> None:
        """Send the last frame and end the drawing."""
        self._closed, deadline = True, time.monotonic() + _LONGEST_END
        with contextlib.suppress(queue.Full):
            for message in (_encode(self._frame()), None) if self._draws else ():
                self._waiting.put(message, timeout=max(deadline - time.monotonic(), 0.0))
        self._listener.join(max(deadline - time.monotonic(), 0.0))
        if self._listener.is_alive():
            self._kill()
        self._listener.join()

    def _frame(self) -> Frame:
        """Everything since the frame before, evenly thinned where there is too much."""
        frame: Frame = {}
        for source, events in self._events.items():
            for moment, values, outcomes in _take(events):
                for axis, outcome in outcomes.items():
                    if axis in values and source and outcome in COMPARED:
                        row = moment, float(values[axis]), float(outcome is Outcome.REJECTED)
                        frame.setdefault(f"measurement/{axis}/{source}", []).append(row)
                    elif axis in values and not source and outcome is Outcome.FUSED:
                        frame.setdefault(f"command/{axis}", []).append((moment, float(values[axis])))
                if source in self._in_space:
                    self._add_position(frame, source or "command", moment, values)
        for moment, axes, cartesian in _take(self._estimates):
            for axis, now in axes.items():
                frame.setdefault(f"estimate/{axis}", []).append((moment, now.position, now.position_sd))
            positions = cartesian if self._framed else {axis: now.position for axis, now in axes.items()}
            self._add_position(frame, "estimate", moment, positions or {})
        return frame

    def _add_position(self, frame: Frame, name: str, moment: float, position: Mapping[str, float]) -> None:
        """Add a position in space to a path, if it is one."""
        if self._space and all(coordinate in position for coordinate in self._space):
            plane = (0.0,) * (3 - len(self._space))
            row = moment, *(float(position[coordinate]) for coordinate in self._space), *plane
            frame.setdefault(f"path/{name}", []).append(row)

    def _add_health(self, frame: Frame, health: Health) -> None:
        """Add the health; after a jump of the stream's clock, time goes on where it was."""
        if health.segments != self._segments and health.newest is not None and self._origin is not None:
            self._segments = health.segments
            self._origin = health.newest / 1e9 - self._newest
        before, self._faults = self._faults, health.faults
        begun = [(self._newest, "WARN", fault) for fault in health.faults if fault not in before]
        over = [(self._newest, "INFO", f"no longer: {fault}") for fault in before if fault not in health.faults]
        frame["log"] = [*over, *begun]
        for name, sensor in health.sensors.items():
            frame[f"rate/{name}"] = [(self._newest, sensor.rate)]
            if sensor.nis is not None:
                frame[f"nis/{name}"] = [(self._newest, sensor.nis)]

    def _write(self, message: Header | Frame) -> None:
        """Have a message written; leave it out if the one before waits."""
        if self._waiting.full():
            self.dropped += 1
        else:
            self._waiting.put(_encode(message))

    def _write_all(self) -> None:
        """Write what waits, as soon as the pipe takes it."""
        assert self._child.stdin is not None
        with contextlib.suppress(OSError), self._child.stdin as pipe:  # nobody reads: its end is noticed
            while (message := self._waiting.get()) is not None:
                pipe.write(message)
                pipe.flush()

    def _listen(self) -> None:
        """Pass on what the drawing process reports, and its end, of which nothing is left behind."""
        assert self._child.stdout is not None
        with self._child.stdout as reports:
            for line in reports:
                self._notify(line.decode(errors="replace").removesuffix("\n"))
        self._draws, code = False, self._child.wait()
        self._kill()
        if code and not self._closed:
            how = f"signal {-code}" if code < 0 else f"exit status {code}"
            self._notify(f"Rerun: the drawing process ended by itself ({how}); nothing more is drawn")

    def _kill(self) -> None:
        """End the drawing process, its server included."""
        with contextlib.suppress(OSError):
            os.killpg(self._child.pid, signal.SIGKILL)


def _encode(message: Header | Frame) -> bytes:
    return msgspec.json.encode(message, enc_hook=float) + b"\n"


def _take(rows: list[Any]) -> list[Any]:
    """The rows, evenly thinned where they are too many; the list is empty then."""
    taken = rows[:: 1 + len(rows) // _MOST]
    rows.clear()
    return taken


def _start() -> subprocess.Popen[bytes]:
    """The process that draws, in a group of its own: Ctrl-C is for the estimator, which then ends it."""
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "pumafuse.views.live_drawer"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
