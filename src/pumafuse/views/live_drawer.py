"""The process that draws for a live view: ``python -m pumafuse.views.live_drawer``, frames on standard input.

It ends with its input. Its reports go to standard output, a sentence a line. A viewer that takes nothing makes it leave
frames out, not pile them up: rerun-sdk gets more only when the viewer has taken all before it. Entities as in
:mod:`pumafuse.views.live`.
"""

from __future__ import annotations

import contextlib
import os
import queue
import sys
import threading
import time
import uuid
from collections import deque

import msgspec
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..arrays import FloatArray
from ..units import MM
from . import colours, styles
from .live import Frame, Header, SensorHead, bodies
from .live_viewer import Viewer

_WAITING = 20  # frames
_DRAWN = 0.5  # s between pictures: a browser without a graphics card takes no more, and would fall behind for good
_LAST = 0.7  # s for the last frames, twice at most
_NICE = 5  # the estimator comes first
_SHOWN = 30.0  # s
_MARGIN = 8.0  # s on the left for a legend
_EYE = np.array([450.0, -750.0, 450.0])  # mm from the first point of a path to the eye
_MOST_KEPT = 20_000  # estimates, or measurements that wait for them
_LONGEST_GAP = 0.25  # s between estimates; in a longer one the arm may have gone anywhere
_PATH_STEP = 0.1  # s between points of a path, but for the newest
_AVERAGED = 1000  # measurements that a bias is averaged over


class Drawer:
    """Frames that wait to be drawn, and the thread that draws them."""

    def __init__(self, header: Header) -> None:
        """Start the viewer and the drawing."""
        self._header = header
        self._frames: queue.Queue[Frame | None] = queue.Queue(_WAITING)
        self._connected = self._ended = False
        self._left_out = 0
        self._viewer = Viewer(header, report)
        self._thread = threading.Thread(target=self._draw, daemon=True)
        self._thread.start()

    def put(self, frame: Frame) -> None:
        """Have a frame drawn; leave it out if the viewer does not take what came before."""
        if self._frames.full() and not self._connected:
            with contextlib.suppress(queue.Empty):
                self._frames.get_nowait()  # what comes first is old when a viewer opens
        try:
            self._frames.put_nowait(frame)
        except queue.Full:
            if not self._left_out:
                report("Rerun: the viewer does not take what is drawn; frames are left out until it does")
            self._left_out += 1
            return
        if self._left_out:
            report(f"Rerun: the viewer draws again; {self._left_out} frames were left out")
        self._left_out = 0

    def end(self) -> None:
        """Draw what waits, but not for long, and leave."""
        with contextlib.suppress(queue.Full):
            self._frames.put(None, timeout=_LAST)
            self._thread.join(_LAST)
        self._leave()

    def _draw(self) -> None:
        """Draw into the viewer, and into the next one where there may be one."""
        recording = uuid.uuid4()
        while self._viewer.wait():
            stream = rr.RecordingStream("pumafuse live", recording_id=recording)
            try:
                stream.connect_grpc(self._viewer.url)
                stream.send_recording_name("live")
                picture = Picture(stream, self._header)
                self._connected = True
                while not self._ended:
                    picture.draw(self._next())
                    stream.flush()
                return
            except RuntimeError:  # what rerun-sdk raises for a connection that broke
                self._connected = False
        self._leave()

    def _next(self) -> Frame:
        """All frames of the time between two pictures as one."""
        frame, until = Frame(), time.monotonic() + _DRAWN
        with contextlib.suppress(queue.Empty):
            while (more := self._frames.get(timeout=max(until - time.monotonic(), 0.0))) is not None:
                frame.add(more)
            self._ended = True
        return frame

    def _leave(self) -> None:
        """End at once: rerun-sdk would wait for a viewer that is gone."""
        self._viewer.end()
        os._exit(0)


class Picture:
    """Drawing of frames into one stream of rerun-sdk."""

    def __init__(self, stream: rr.RecordingStream, header: Header) -> None:
        """Send the layout and the colours.

        Args:
            stream: Connected.
            header: The axes and sensors.
        """
        self._stream, self._header = stream, header
        self._estimates = {axis: _EstimateHistory() for axis in header.axes}
        self._paths: dict[str, _PathHistory] = {}
        self._residuals = {
            (axis, name): _Residuals(sensor, self._estimates[axis])
            for axis in header.axes
            for name, sensor in header.sensors.items()
        }
        stream.send_blueprint(_blueprint(header))
        of_sensors = colours.sensor_colours(list(header.sensors))
        for axis in header.axes:
            self._look(f"{axis}/command", styles.line(colours.COMMAND, "command", step=True))
            self._look(f"{axis}/estimate", styles.line(colours.ESTIMATE, "estimate"))
            for path in (f"{axis}/estimate", f"residual/{axis}"):
                self._look(f"{path}/upper", styles.edge("+2σ"))
                self._look(f"{path}/lower", styles.edge("−2σ"))
            for name, colour in of_sensors.items():
                self._look(f"{axis}/{name}", styles.points(colour, name))
                self._look(f"{axis}/{name}/rejected", styles.points(colours.REJECTED, "rejected", "Cross"))
                self._look(f"residual/{axis}/{name}", styles.points(colour, name))
        for name, colour in of_sensors.items():
            self._look(f"nis/{name}", styles.line(colour, name))
            self._look(f"rate/{name}", styles.line(colour, name))
        self._colours = {"command": colours.COMMAND, "estimate": colours.ESTIMATE, **of_sensors}

    def draw(self, frame: Frame) -> None:
        """Send a frame."""
        for axis, rows in frame.commands.items():
            self._plot(f"{axis}/command", *_columns(rows))
        for axis, rows in frame.estimates.items():
            time, position, sd = _columns(rows)
            self._estimates[axis].add(time, position)
            self._plot(f"{axis}/estimate", time, position)
            for edge, half in (("upper", 2.0 * sd), ("lower", -2.0 * sd)):
                self._plot(f"{axis}/estimate/{edge}", time, position + half)
                self._plot(f"residual/{axis}/{edge}", time, half)
        for (axis, name), residuals in self._residuals.items():
            if rows := frame.measurements.get(f"{axis}/{name}"):
                residuals.add(*_columns(rows))
            self._draw_measurements(axis, name, residuals)
        for name, rows in frame.paths.items():
            self._draw_path(name, *_columns(rows))
        if frame.health is not None:
            for kind, values in (("nis", frame.health.nis), ("rate", frame.health.rate)):
                for name, value in values.items():
                    styles.send(self._stream, f"{kind}/{name}", np.array([frame.health.time]), np.array([value]))

    def _draw_measurements(self, axis: str, name: str, residuals: _Residuals) -> None:
        time, position, residual, rejected = residuals.take()
        fused, shown = ~rejected, self._estimates[axis].clip(position)
        self._plot(f"{axis}/{name}", time[fused], position[fused])
        self._plot(f"{axis}/{name}/rejected", time[rejected], shown[rejected])
        self._plot(f"residual/{axis}/{name}", time[fused], residual[fused])

    def _draw_path(self, name: str, time: FloatArray, *coordinates: FloatArray) -> None:
        """The last seconds of a path; measurements as points. A negative radius is in points of the screen."""
        points = np.column_stack(coordinates) * MM
        there = np.isfinite(points).all(axis=1)
        if not there.any():
            return
        if not self._paths:
            self._stream.send_blueprint(_blueprint(self._header, points[there][0]))
        path = self._paths.setdefault(name, _PathHistory())
        path.add(time[there], points[there])
        strip, colour = path.points(), colours.rgb(self._colours[name])
        self._stream.set_time(styles.TIMELINE, duration=float(time[-1]))
        if name in self._header.sensors:
            self._stream.log(f"path/{name}", rr.Points3D(strip, colors=[colour], radii=-1.0))
        else:
            width = -0.7 if name == "command" else -1.2
            self._stream.log(f"path/{name}", rr.LineStrips3D([strip], colors=[colour], radii=width))
        if name == "estimate":
            tool = rr.Points3D(strip[-1:], colors=[colours.rgb(colours.REJECTED)], radii=-5.0)
            self._stream.log("path/tool", tool)

    def _plot(self, path: str, time: FloatArray, position: FloatArray) -> None:
        styles.send(self._stream, path, time, position * MM)

    def _look(self, path: str, look: rr.SeriesLines | rr.SeriesPoints) -> None:
        self._stream.log(path, look, static=True)


class _EstimateHistory:
    """The last estimates of one axis, in their order of time."""

    def __init__(self) -> None:
        self.time, self._position = np.empty(0), np.empty(0)

    def add(self, time: FloatArray, position: FloatArray) -> None:
        """Add estimates [m] at times [s], ascending; of an earlier time only they are kept."""
        if len(self.time) and time[0] < self.time[-1]:
            self.time, self._position = np.empty(0), np.empty(0)
        kept = self.time > time[-1] - _SHOWN
        self.time = np.concatenate([self.time[kept], time])[-_MOST_KEPT:]
        self._position = np.concatenate([self._position[kept], position])[-_MOST_KEPT:]

    def at(self, time: FloatArray) -> FloatArray:
        """Positions [m] between the estimates, of which there are two; NaN before the first one and in a gap."""
        found = np.interp(time, self.time, self._position)
        after = np.clip(np.searchsorted(self.time, time), 1, len(self.time) - 1)
        known = (time >= self.time[0]) & (self.time[after] - self.time[after - 1] <= _LONGEST_GAP)
        return np.where(known, found, np.nan)

    def clip(self, position: FloatArray) -> FloatArray:
        """Positions [m] with those far off moved to the edge: one wild measurement would flatten the plot."""
        if not len(self._position):
            return position
        low, high = self._position.min(), self._position.max()
        margin = 0.3 * (high - low) + 5.0 / MM
        return np.clip(position, low - margin, high + margin)


class _PathHistory:
    """The last seconds of a path, thinned."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, FloatArray]] = deque()

    def add(self, time: FloatArray, points: FloatArray) -> None:
        """Add points (n, 3) at times [s], (n,)."""
        for moment, point in zip(time.tolist(), points, strict=True):
            if len(self._points) > 1 and 0.0 <= moment - self._points[-2][0] < _PATH_STEP:
                self._points.pop()
            self._points.append((moment, point))
        while not 0.0 <= self._points[-1][0] - self._points[0][0] <= _SHOWN:
            self._points.popleft()

    def points(self) -> FloatArray:
        """From the oldest to the newest, (n, 3)."""
        return np.array([point for _, point in self._points])


class _Residuals:
    """One sensor's measurements on one axis, which wait for the estimate at their valid times."""

    def __init__(self, sensor: SensorHead, estimates: _EstimateHistory) -> None:
        self._sensor, self._estimates = sensor, estimates
        self._waiting = np.empty((3, 0))
        self._bias, self._averaged = 0.0, 0

    def add(self, stamp: FloatArray, value: FloatArray, rejected: FloatArray) -> None:
        """Add measurements [m] at their stamps [s]; the oldest go when no estimate comes."""
        rows = np.array([stamp - self._sensor.latency, value / self._sensor.scale, rejected])
        self._waiting = np.concatenate([self._waiting, rows], axis=1)[:, -_MOST_KEPT:]

    def take(self) -> tuple[FloatArray, FloatArray, FloatArray, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
        """Valid times [s], positions [m], positions less the estimate [m], and which were rejected."""
        if len(self._estimates.time) < 2:
            return np.empty(0), np.empty(0), np.empty(0), np.empty(0, dtype=np.bool_)
        ready = self._waiting[0] <= self._estimates.time[-1]
        (time, position, flag), self._waiting = self._waiting[:, ready], self._waiting[:, ~ready]
        rejected, residual = flag > 0.0, position - self._estimates.at(time)
        if self._sensor.biased:
            self._average(residual[np.isfinite(residual) & ~rejected])
            position, residual = position - self._bias, residual - self._bias
        return time, position, residual, rejected

    def _average(self, residual: FloatArray) -> None:
        """Update the bias of the last measurements with further residuals [m]."""
        if len(residual):
            self._averaged = min(self._averaged + len(residual), _AVERAGED)
            share = min(len(residual) / self._averaged, 1.0)
            self._bias += share * (float(residual.mean()) - self._bias)


def _columns(rows: list[tuple[float, ...]]) -> FloatArray:
    """The columns of rows, (k, n)."""
    return np.array(rows, dtype=np.float64).T


def _blueprint(header: Header, first: FloatArray | None = None) -> rrb.Blueprint:
    """Positions, residuals, and on the right the path and the sensors' health; all follow the newest.

    Args:
        header: The axes.
        first: Where the path begins [mm], (3,).
    """
    positions = [
        _plot(f"/{axis}", f"{axis} [mm]", legend=not number, margin=_MARGIN) for number, axis in enumerate(header.axes)
    ]
    residuals = [
        _plot(f"/residual/{axis}", f"{axis}: measurement − estimate [mm]", legend=False) for axis in header.axes
    ]
    right: rrb.Container = rrb.Tabs(
        _plot("/nis", "NIS [1 as configured]", legend=True, margin=_MARGIN),
        _plot("/rate", "measurements [Hz]", legend=True, margin=_MARGIN),
    )
    if header.space:
        # The eye is where the arm's usual reach fits in; of itself it would stay as near as it began.
        eye = None if first is None else rrb.EyeControls3D(position=first + _EYE, look_target=first, eye_up=(0, 0, 1))
        name = f"path of the last {_SHOWN:.0f} s [mm]"
        path = rrb.Spatial3DView(origin="/path", name=name, line_grid=False, eye_controls=eye)
        right = rrb.Vertical(path, right, row_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*positions), rrb.Vertical(*residuals), right, column_shares=[4, 3, 3]),
        rrb.TimePanel(state="collapsed", timeline=styles.TIMELINE, play_state="following"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _plot(origin: str, name: str, *, legend: bool, margin: float = 0.0) -> rrb.TimeSeriesView:
    """The last seconds, with an empty margin [s] on the left."""
    now = rrb.TimeRangeBoundary.cursor_relative(seconds=0.0)
    oldest = rrb.TimeRangeBoundary.cursor_relative(seconds=-_SHOWN)
    left = rrb.TimeRangeBoundary.cursor_relative(seconds=-_SHOWN - margin)
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
        axis_x=rrb.TimeAxis(view_range=rrb.TimeRange(left, now)),
        time_ranges=rrb.VisibleTimeRange(styles.TIMELINE, start=oldest, end=now),
    )


def report(text: str) -> None:
    """Send a sentence to the estimator's log."""
    with contextlib.suppress(OSError):
        os.write(sys.stdout.fileno(), text.encode() + b"\n")


def main() -> None:
    """Draw the frames that come on standard input until it ends."""
    os.nice(_NICE)
    messages = bodies(sys.stdin.buffer)
    header = next(messages, None)
    if header is None:
        return
    drawer = Drawer(msgspec.msgpack.decode(header, type=Header))
    decoder = msgspec.msgpack.Decoder(Frame)
    for message in messages:
        drawer.put(decoder.decode(message))
    drawer.end()


if __name__ == "__main__":
    main()
