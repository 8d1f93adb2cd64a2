"""What a live view shows: the last seconds of every axis, how far measurements are from the estimate, the path, the health.

Entities as in :mod:`pumafuse.views.live`.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..arrays import FloatArray
from ..units import MM
from . import colours as style
from . import styles as looks
from .live_frames import Band, Frame, Header, Met, Path, SensorHead, SensorsNow

_SHOWN = 30.0  # s
_MARGIN = 8.0  # s on the left for a legend
_SIGHT = np.array([450.0, -750.0, 450.0])  # mm from the first point of a path to the eye
_KEPT = 5.0  # s of estimates that measurements may still be compared with
_MOST_KEPT = 20_000
_LONGEST_GAP = 0.25  # s between estimates; in a longer one the arm may have gone anywhere
_TRAIL_STEP = 0.1  # s between points of a path, but for the newest
_AVERAGED = 1000  # measurements that a bias is averaged over


class Picture:
    """Draws frames into one stream of rerun-sdk."""

    def __init__(self, stream: rr.RecordingStream, header: Header) -> None:
        """Send how it looks.

        Args:
            stream: Connected.
            header: The axes and sensors.
        """
        self._stream, self._header = stream, header
        self._tracks = {axis: _Track() for axis in header.axes}
        self._trails: dict[str, _Trail] = {}
        self._sensors = {
            (axis, name): _Compared(sensor, self._tracks[axis])
            for axis in header.axes
            for name, sensor in header.sensors.items()
        }
        stream.send_blueprint(_blueprint(header))
        colours = style.sensor_colours(list(header.sensors))
        for axis in header.axes:
            self._look(f"{axis}/command", looks.line(style.COMMAND, "command", step=True))
            self._look(f"{axis}/estimate", looks.line(style.ESTIMATE, "estimate"))
            for path in (f"{axis}/estimate", f"residual/{axis}"):
                self._look(f"{path}/upper", looks.edge("+2σ"))
                self._look(f"{path}/lower", looks.edge("−2σ"))
            for name, colour in colours.items():
                self._look(f"{axis}/{name}", looks.points(colour, name))
                self._look(f"{axis}/{name}/rejected", looks.points(style.REJECTED, "rejected", "Cross"))
                self._look(f"residual/{axis}/{name}", looks.points(colour, name))
        for name, colour in colours.items():
            self._look(f"nis/{name}", looks.line(colour, name))
            self._look(f"rate/{name}", looks.line(colour, name))
        self._colours = {"command": style.COMMAND, "estimate": style.ESTIMATE, **colours}

    def draw(self, frame: Frame) -> None:
        """Send what a frame holds."""
        for axis, series in frame.commands.items():
            self._plot(f"{axis}/command", np.array(series.time), np.array(series.value))
        for axis, band in frame.estimates.items():
            self._estimate(axis, band)
        for name, axes in frame.measurements.items():
            for axis, met in axes.items():
                self._sensors[axis, name].hear(met)
        for (axis, name), compared in self._sensors.items():
            self._measurements(axis, name, compared)
        for name, path in frame.paths.items():
            self._path(name, path)
        if frame.health is not None:
            self._health(frame.health)

    def _estimate(self, axis: str, band: Band) -> None:
        time, position, half = np.array(band.time), np.array(band.position), 2.0 * np.array(band.sd)
        self._tracks[axis].add(time, position)
        self._plot(f"{axis}/estimate", time, position)
        self._plot(f"{axis}/estimate/upper", time, position + half)
        self._plot(f"{axis}/estimate/lower", time, position - half)
        self._plot(f"residual/{axis}/upper", time, half)
        self._plot(f"residual/{axis}/lower", time, -half)

    def _measurements(self, axis: str, name: str, compared: _Compared) -> None:
        time, position, residual, rejected = compared.take()
        fused, shown = ~rejected, self._tracks[axis].nearby(position)
        self._plot(f"{axis}/{name}", time[fused], position[fused])
        self._plot(f"{axis}/{name}/rejected", time[rejected], shown[rejected])
        self._plot(f"residual/{axis}/{name}", time[fused], residual[fused])

    def _path(self, name: str, path: Path) -> None:
        """The last seconds of a path; measurements as points. A negative radius is in points of the screen."""
        points = np.array(path.position).reshape(-1, 3) * MM
        there = np.isfinite(points).all(axis=1)
        if not there.any():
            return
        if not self._trails:
            self._stream.send_blueprint(_blueprint(self._header, points[there][0]))
        trail = self._trails.setdefault(name, _Trail())
        trail.add(np.array(path.time)[there], points[there])
        strip, colour = trail.points(), style.rgb(self._colours[name])
        self._stream.set_time(looks.TIMELINE, duration=path.time[-1])
        if name in self._header.sensors:
            self._stream.log(f"path/{name}", rr.Points3D(strip, colors=[colour], radii=-1.0))
        else:
            width = -0.7 if name == "command" else -1.2
            self._stream.log(f"path/{name}", rr.LineStrips3D([strip], colors=[colour], radii=width))
        if name == "estimate":
            tool = rr.Points3D(strip[-1:], colors=[style.rgb(style.REJECTED)], radii=-5.0)
            self._stream.log("path/tool", tool)

    def _health(self, health: SensorsNow) -> None:
        for kind, values in (("nis", health.nis), ("rate", health.rate)):
            for name, value in values.items():
                looks.send(self._stream, f"{kind}/{name}", np.array([health.time]), np.array([value]))

    def _plot(self, path: str, time: FloatArray, position: FloatArray) -> None:
        looks.send(self._stream, path, time, position * MM)

    def _look(self, path: str, look: rr.SeriesLines | rr.SeriesPoints) -> None:
        self._stream.log(path, look, static=True)


class _Track:
    """The last estimates of one axis, in their order of time."""

    def __init__(self) -> None:
        self.time, self._position = np.empty(0), np.empty(0)
        self._spans: deque[tuple[float, float, float]] = deque()

    def add(self, time: FloatArray, position: FloatArray) -> None:
        """Take in estimates [m] at times [s], ascending."""
        if not len(time):
            return
        if len(self.time) and time[0] < self.time[-1]:
            self.time, self._position = np.empty(0), np.empty(0)
        kept = (self.time > time[-1] - _KEPT)[-_MOST_KEPT:]
        self.time = np.concatenate([self.time[-_MOST_KEPT:][kept], time])
        self._position = np.concatenate([self._position[-_MOST_KEPT:][kept], position])
        self._spans.append((float(time[-1]), float(position.min()), float(position.max())))
        while self._spans[0][0] < time[-1] - _SHOWN:
            self._spans.popleft()

    def at(self, time: FloatArray) -> FloatArray:
        """Positions [m] between the estimates; NaN before the first one and in a gap."""
        found = np.interp(time, self.time, self._position)
        after = np.clip(np.searchsorted(self.time, time), 1, len(self.time) - 1)
        known = (time >= self.time[0]) & (self.time[after] - self.time[after - 1] <= _LONGEST_GAP)
        return np.where(known, found, np.nan)

    def nearby(self, position: FloatArray) -> FloatArray:
        """Positions [m] with those far off moved to the edge: one wild measurement would flatten the plot."""
        if not self._spans:
            return position
        low, high = min(span[1] for span in self._spans), max(span[2] for span in self._spans)
        margin = 0.3 * (high - low) + 5.0 / MM
        return np.clip(position, low - margin, high + margin)


class _Trail:
    """The last seconds of a path, thinned."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, FloatArray]] = deque()

    def add(self, time: FloatArray, points: FloatArray) -> None:
        """Take in points (n, 3) at times [s], (n,)."""
        for moment, point in zip(time.tolist(), points, strict=True):
            if len(self._points) > 1 and 0.0 <= moment - self._points[-2][0] < _TRAIL_STEP:
                self._points.pop()
            self._points.append((moment, point))
        while not 0.0 <= self._points[-1][0] - self._points[0][0] <= _SHOWN:
            self._points.popleft()

    def points(self) -> FloatArray:
        """From the oldest to the newest, (n, 3)."""
        return np.array([point for _, point in self._points])


class _Compared:
    """One sensor's measurements on one axis that wait for the estimate at their valid times."""

    def __init__(self, sensor: SensorHead, track: _Track) -> None:
        self._sensor, self._track = sensor, track
        self._time, self._value, self._rejected = np.empty(0), np.empty(0), np.empty(0, dtype=np.bool_)
        self._bias, self._averaged = 0.0, 0

    def hear(self, met: Met) -> None:
        """Take in measurements; the oldest go when no estimate comes."""
        time = np.array(met.time, dtype=np.float64) - self._sensor.latency
        self._time = np.concatenate([self._time, time])[-_MOST_KEPT:]
        self._value = np.concatenate([self._value, np.array(met.value) / self._sensor.scale])[-_MOST_KEPT:]
        self._rejected = np.concatenate([self._rejected, np.array(met.rejected, dtype=np.bool_)])[-_MOST_KEPT:]

    def take(self) -> tuple[FloatArray, FloatArray, FloatArray, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
        """Valid times [s], positions [m], positions less the estimate [m], and which were rejected."""
        if len(self._track.time) < 2:
            return np.empty(0), np.empty(0), np.empty(0), np.empty(0, dtype=np.bool_)
        ready = self._time <= self._track.time[-1]
        time, position, rejected = self._time[ready], self._value[ready], self._rejected[ready]
        self._time, self._value, self._rejected = self._time[~ready], self._value[~ready], self._rejected[~ready]
        residual = position - self._track.at(time)
        if self._sensor.biased:
            self._average(residual[np.isfinite(residual) & ~rejected])
            position, residual = position - self._bias, residual - self._bias
        return time, position, residual, rejected

    def _average(self, residual: FloatArray) -> None:
        """The mean of what a biased sensor is off the estimate, of its last measurements."""
        if len(residual):
            self._averaged = min(self._averaged + len(residual), _AVERAGED)
            share = min(len(residual) / self._averaged, 1.0)
            self._bias += share * (float(residual.mean()) - self._bias)


def _blueprint(header: Header, first: FloatArray | None = None) -> rrb.Blueprint:
    """Positions, what measurements are off, and on the right the path and the sensors' health; all follow the newest.

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
        right = rrb.Vertical(_scene(first), right, row_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*positions), rrb.Vertical(*residuals), right, column_shares=[4, 3, 3]),
        rrb.TimePanel(state="collapsed", timeline=looks.TIMELINE, play_state="following"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _scene(first: FloatArray | None) -> rrb.Spatial3DView:
    """The path, seen from where the arm's usual reach fits in; of itself the eye would stay as near as it began."""
    eye = None if first is None else rrb.EyeControls3D(position=first + _SIGHT, look_target=first, eye_up=(0, 0, 1))
    name = f"path of the last {_SHOWN:.0f} s [mm]"
    return rrb.Spatial3DView(origin="/path", name=name, line_grid=False, eye_controls=eye)


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
        time_ranges=rrb.VisibleTimeRange(looks.TIMELINE, start=oldest, end=now),
    )
