"""The process that draws for a live view: ``python -m pumafuse.views.live_drawer``, a frame a line on standard input.

It ends with its input. Its reports go to standard output, a sentence a line. A viewer that takes nothing makes it leave
out the oldest frames, not pile them up: rerun-sdk gets more only when the viewer has taken all before it. Entities as
in :mod:`pumafuse.views.live`.
"""

from __future__ import annotations

import contextlib
import os
import queue
import sys
import threading
import uuid
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..arrays import BoolArray, FloatArray
from ..fusion.config import Sensor, Vector
from ..logs.frames import CARTESIAN
from ..space import rotations
from ..space.rotations import TURNING
from ..units import MM, SCREEN, Screen
from . import colours, scene, styles
from .live import Frame, Header
from .live_viewer import Viewer
from .styles import Sink

_WAITING = 20  # frames
_LAST = 1.0  # s for the last frames
_NICE = 5  # the estimator comes first
_SHOWN = 30.0  # s
_MARGIN = 8.0  # s on the left for a legend
_EYE = np.array([450.0, -750.0, 450.0])  # mm from the first point of a path to the eye
_MOST_KEPT = 20_000  # estimates, or measurements that wait for them
_LONGEST_GAP = 0.25  # s between estimates; in a longer one the arm may have gone anywhere
_PATH_POINTS = 300
_AVERAGED = 1000  # measurements that a bias is averaged over
_AXES = 0.1  # m: a tenth of the way from the eye to the tool, whose axes are so long
_LOG = "log"  # of faults
_LARGER = 10.0  # times: an ellipsoid of some tenths of a millimetre is seen then, one of a centimetre fits in


class Picture:
    """Drawing of frames into one stream of rerun-sdk."""

    def __init__(self, stream: rr.RecordingStream, header: Header) -> None:
        """Send the layout and the colours."""
        self._stream, self._header, self._sink = stream, header, Sink(stream)
        self._screens = {axis: SCREEN[kind] for axis, kind in header.axes.items()}
        self._estimates = {axis: Recent(3) for axis in header.axes}
        self._residuals = {
            (axis, name): Residuals(sensor, header.is_biased(name), self._estimates[axis])
            for axis in header.axes
            for name, sensor in header.sensors.items()
        }
        self._paths: dict[str, Recent] = {}
        self._tool = None if header.tool is None else Tool(self._sink, header, header.tool, self._estimates)
        stream.send_blueprint(_blueprint(header))
        self._of_sensors = colours.sensor_colours(list(header.sensors))
        self._colours = {"command": colours.COMMAND, "estimate": colours.ESTIMATE, **self._of_sensors}

    def draw(self, frame: Frame) -> None:
        """Send a frame."""
        for axis, estimate in self._estimates.items():
            screen = self._screens[axis]
            time, command = _columns(frame, f"command/{axis}", 2)
            line = styles.line(colours.COMMAND, "command", step=True)
            self._sink.send_series(f"{axis}/command", line, time, command, screen)
            time, position, sd = estimates = _columns(frame, f"estimate/{axis}", 3)
            estimate.add(estimates)
            self._sink.send_band(f"{axis}/estimate", "estimate ± sd", time, position, sd, screen)
            self._sink.send_band(f"residual/{axis}/estimate", "estimate's sd", time, np.zeros(len(time)), sd, screen)
        taken: dict[tuple[str, str], FloatArray] = {}
        for (axis, name), residuals in self._residuals.items():
            residuals.add(_columns(frame, f"measurement/{axis}/{name}", 3))
            time, position, residual, rejected = residuals.take()
            taken[axis, name] = np.array([time, position, rejected], dtype=np.float64)
            screen, fused = self._screens[axis], ~rejected
            shown = self._estimates[axis].clip(position, screen)
            points = styles.points(self._colours[name], name)
            crosses = styles.points(colours.REJECTED, "rejected", "Cross")
            entity = styles.entity(name)
            self._sink.send_series(f"{axis}/{entity}", points, time[fused], position[fused], screen)
            self._sink.send_series(f"{axis}/{entity}/rejected", crosses, time[rejected], shown[rejected], screen)
            self._sink.send_series(f"residual/{axis}/{entity}", points, time[fused], residual[fused], screen)
        for name, colour in self._of_sensors.items():
            for path in (f"nis/{name}", f"rate/{name}"):
                self._sink.send_series(path, styles.line(colour, name), *_columns(frame, path, 2))
        for moment, level, text in frame.get("log", ()):
            self._sink.log_at(float(moment), _LOG, rr.TextLog(str(text), level=str(level)))
        for name, colour in self._colours.items():
            self._draw_path(name, colour, _columns(frame, f"path/{name}", 4))
        if self._tool is not None:
            self._tool.draw()
            for name, colour in self._of_sensors.items():
                self._tool.draw_measured(name, colour, [taken[axis, name] for axis in CARTESIAN])

    def _draw_path(self, name: str, colour: str, rows: FloatArray) -> None:
        """The last seconds of a path; measurements as points. A negative radius is in points of the screen."""
        rows = rows[:, np.isfinite(rows).all(axis=0)]
        if not rows.size:
            return
        if not self._paths:
            self._stream.send_blueprint(_blueprint(self._header, rows[1:, 0]))
            if self._tool is not None:
                self._tool.place_sensors(rows[1:, 0])
        path = self._paths.setdefault(name, Recent(4))
        path.add(rows)
        strip, rgb = path.rows[1:].T * MM, colours.rgb(colour)
        thinned, now = _thin(strip), float(rows[0, -1])
        if name in self._header.sensors:
            shape = rr.Points3D(thinned, colors=[rgb], radii=-1.0)
        else:
            shape = rr.LineStrips3D([thinned], colors=[rgb], radii=-0.7 if name == "command" else -1.2)
        self._sink.log_at(now, f"path/{name}", shape)
        if name == "estimate" and self._tool is None:
            tool = rr.Points3D(strip[-1:], colors=[colours.rgb(colours.REJECTED)], radii=-5.0)
            self._sink.log_at(now, "path/tool", tool)


class Tool:
    """A tool that turns, what sensors see of it, and where they stand, as a recorded result has it."""

    def __init__(self, sink: Sink, header: Header, reference: Vector, estimates: Mapping[str, Recent]) -> None:
        """Send how it looks."""
        self._sink, self._sensors = sink, header.sensors
        self._reference, self._estimates = np.array(reference), estimates
        self._seen = {name: Recent(5) for name in header.sensors}
        scene.send_look(self._sink, _AXES, _LARGER)

    def place_sensors(self, point: FloatArray) -> None:
        """Send where the sensors stand and what they see, as the tool is about at a point [m], (3,)."""
        for name, colour in colours.sensor_colours(list(self._sensors)).items():
            scene.send_placed(self._sink, name, self._sensors[name], colour, point, _AXES)

    def draw(self) -> None:
        """Send the newest estimate, with its ellipsoid."""
        if not all(self._estimates[axis].rows.size for axis in (*CARTESIAN, *TURNING)):
            return
        lengths, angles = ([self._estimates[axis].rows for axis in axes] for axes in (CARTESIAN, TURNING))
        point, turn = (np.array([[rows[1, -1] for rows in axes]]) for axes in (lengths, angles))
        turned, root = rotations.quaternions(turn, self._reference), np.diag([rows[2, -1] for rows in lengths])
        scene.send_tool(self._sink, lengths[0][0, -1:], point, turned, root[None], _LARGER)

    def draw_measured(self, name: str, colour: str, taken: Sequence[FloatArray]) -> None:
        """Send where the last seconds of a sensor's measurements put the tool."""
        shared = scene.in_all([time for time, _, _ in taken])
        if not len(shared[0]):
            return
        axes = [axis[:, row] for axis, row in zip(taken, shared, strict=True)]
        seen = self._seen[name]
        seen.add(np.array([axes[0][0], *(axis[1] for axis in axes), np.max([axis[2] for axis in axes], axis=0)]))
        rows, flag = seen.rows[1:4].T, seen.rows[4] > 0.0
        fused, rejected = _thin(rows[~flag]), _thin(rows[flag])  # each by itself: few are rejected
        red = np.repeat([False, True], [len(fused), len(rejected)])
        points = scene.measured_points(np.concatenate([fused, rejected]) * MM, red, colour)
        self._sink.log_at(float(seen.rows[0, -1]), scene.measured_entity(name), points)


class Recent:
    """The last seconds of rows that begin with their time [s]."""

    def __init__(self, width: int) -> None:
        """Rows of so many numbers."""
        self.rows: FloatArray = np.empty((width, 0))  # by columns: time and what belongs to it, (k, n)

    def add(self, rows: FloatArray) -> None:
        """Add rows (k, n); what is old goes, and what would be later than the newest, as after a jump of the clock."""
        rows = np.concatenate([self.rows, rows], axis=1)[:, -_MOST_KEPT:]
        age = rows[0, -1:] - rows[0]
        self.rows = rows[:, (age >= 0.0) & (age <= _SHOWN)]

    def at(self, time: FloatArray) -> FloatArray:
        """The second column between two rows, of which there are two; NaN before the first one and in a gap."""
        times: FloatArray = self.rows[0]
        values: FloatArray = self.rows[1]
        after = np.clip(np.searchsorted(times, time), 1, len(times) - 1)
        is_near = (time >= times[0]) & (times[after] - times[after - 1] <= _LONGEST_GAP)
        return np.where(is_near, np.interp(time, times, values), np.nan)

    def clip(self, position: FloatArray, screen: Screen) -> FloatArray:
        """Positions [SI] with those far off moved to the edge: one wild measurement would flatten the plot."""
        if not self.rows.size:
            return position
        low, high = self.rows[1].min(), self.rows[1].max()
        margin = 0.3 * (high - low) + 5.0 / screen.scale
        return np.clip(position, low - margin, high + margin)


class Residuals:
    """One sensor's measurements on one axis, which wait for the estimate at their valid times."""

    def __init__(self, sensor: Sensor, biased: bool, estimates: Recent) -> None:
        """Residuals of a sensor, against the estimates of an axis."""
        self._sensor, self._biased, self._estimates = sensor, biased, estimates
        self._waiting = np.empty((3, 0))
        self._bias, self._averaged = 0.0, 0

    def add(self, rows: FloatArray) -> None:
        """Add stamps [s], measurements [SI] and whether they were rejected; the oldest go when no estimate comes."""
        stamp, value, rejected = rows
        rows = np.array([stamp - self._sensor.latency, value / self._sensor.scale, rejected])
        self._waiting = np.concatenate([self._waiting, rows], axis=1)[:, -_MOST_KEPT:]

    def take(self) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        """Valid times [s], positions, positions less the estimate [SI], and which were rejected."""
        if self._estimates.rows.shape[1] < 2:
            return np.empty(0), np.empty(0), np.empty(0), np.empty(0, dtype=np.bool_)
        ready = self._waiting[0] <= self._estimates.rows[0, -1]
        (time, position, flag), self._waiting = self._waiting[:, ready], self._waiting[:, ~ready]
        rejected, residual = flag > 0.0, position - self._estimates.at(time)
        good = residual[np.isfinite(residual) & ~rejected]
        if self._biased and len(good):
            self._averaged = min(self._averaged + len(good), _AVERAGED)
            self._bias += min(len(good) / self._averaged, 1.0) * (float(good.mean()) - self._bias)
        return time, position - self._bias, residual - self._bias, rejected


def _thin(rows: FloatArray) -> FloatArray:
    """The rows that a path needs, evenly thinned, the newest among them."""
    return rows[:: -(1 + len(rows) // _PATH_POINTS)]


def _columns(frame: Frame, name: str, width: int) -> FloatArray:
    """The columns of the rows of a name, (width, n)."""
    return np.array(frame.get(name, ()), dtype=np.float64).reshape(-1, width).T


def _blueprint(header: Header, first: FloatArray | None = None) -> rrb.Blueprint:
    """Positions, residuals, the path and the sensors' health; all follow the newest."""
    units = {axis: SCREEN[kind].unit for axis, kind in header.axes.items()}
    first_axis = next(iter(units))
    positions = {axis: _plot(f"/{axis}", f"{axis} [{unit}]", legend=axis == first_axis) for axis, unit in units.items()}
    residuals = {
        axis: _plot(f"/residual/{axis}", f"{axis}: measurement − estimate [{unit}]", legend=False)
        for axis, unit in units.items()
    }
    names = {"/nis": "NIS [1 as configured]", "/rate": "measurements [Hz]"}
    health = [_plot(origin, name, legend=True) for origin, name in names.items()]
    if header.tool is not None:
        layout = _of_turning(header, first, positions, residuals, health)
    else:
        parts, shares = [rrb.Tabs(*health), _faults()], [2, 1]
        if header.space:
            name = f"path of the last {_SHOWN:.0f} s [mm]"
            path = rrb.Spatial3DView(origin="/path", name=name, line_grid=False, eye_controls=_eye(first))
            parts, shares = [path, *parts], [3, *shares]
        right = rrb.Vertical(*parts, row_shares=shares)
        left, middle = rrb.Vertical(*positions.values()), rrb.Vertical(*residuals.values())
        layout = rrb.Horizontal(left, middle, right, column_shares=[4, 3, 3])
    return rrb.Blueprint(
        layout,
        rrb.TimePanel(state="collapsed", timeline=styles.TIMELINE, play_state="following"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _of_turning(
    header: Header,
    first: FloatArray | None,
    positions: Mapping[str, rrb.View],
    residuals: Mapping[str, rrb.View],
    health: Sequence[rrb.View],
) -> rrb.Container:
    """The scene on the left, as of a recorded result; on the right tabs of plots, those of positions in front."""
    frames = [sensor.frame for sensor in header.sensors.values()]
    cell = None if first is None else scene.cell_eye(first[None], frames)
    views = scene.two_views(f"tool, last {_SHOWN:.0f} s", _LARGER, _eye(first), cell)
    plots = {"positions": positions, "residuals": residuals}
    tabs = [scene.by_kind(of_axis, header.axes, name) for name, of_axis in plots.items()]
    left = rrb.Vertical(*views, row_shares=[5, 3][: len(views)])
    plotted = rrb.Tabs(*tabs, rrb.Vertical(*health, name="sensors"))
    return rrb.Horizontal(left, rrb.Vertical(plotted, _faults(), row_shares=[5, 1]), column_shares=[1, 1])


def _faults() -> rrb.TextLogView:
    """What is wrong, as it begins and ends."""
    columns = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(origin=f"/{_LOG}", name="faults", columns=columns)


def _eye(first: FloatArray | None) -> rrb.EyeControls3D | None:
    """An eye from where the arm's usual reach fits in; of itself it would stay as near as it began."""
    if first is None:
        return None
    return rrb.EyeControls3D(position=first * MM + _EYE, look_target=first * MM, eye_up=[0.0, 0.0, 1.0])


def _plot(origin: str, name: str, *, legend: bool) -> rrb.TimeSeriesView:
    """The last seconds, with an empty margin on the left."""
    left, oldest, now = (
        rrb.TimeRangeBoundary.cursor_relative(seconds=seconds) for seconds in (-_SHOWN - _MARGIN, -_SHOWN, 0.0)
    )
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


def _draw(viewer: Viewer, header: Header, frames: queue.Queue[Frame | None]) -> None:
    """Draw into the viewer, and into the next one where there may be one."""
    recording = uuid.uuid4()
    while viewer.wait():
        stream = rr.RecordingStream("pumafuse live", recording_id=recording)
        with contextlib.suppress(RuntimeError):  # what rerun-sdk raises for a connection that broke
            stream.connect_grpc(viewer.url)
            stream.send_recording_name("live")
            picture = Picture(stream, header)
            while (frame := frames.get()) is not None:
                picture.draw(frame)
                stream.flush()
            break
    _leave(viewer)


def _add_frame(frames: queue.Queue[Frame | None], frame: Frame | None) -> None:
    """Have a frame drawn, or the drawing ended; where too many wait, the oldest is left out."""
    if frames.full():
        with contextlib.suppress(queue.Empty):
            frames.get_nowait()
    frames.put(frame)


def _leave(viewer: Viewer) -> None:
    """End at once: rerun-sdk would wait for a viewer that is gone."""
    viewer.end()
    os._exit(0)


def main() -> None:
    """Draw the frames that come on standard input until it ends."""
    os.nice(_NICE)
    first = sys.stdin.buffer.readline()
    if not first:
        return
    header = msgspec.json.decode(first, type=Header)
    viewer, frames = Viewer(header, report), queue.Queue[Frame | None](_WAITING)
    drawing = threading.Thread(target=_draw, args=(viewer, header, frames), daemon=True)
    drawing.start()
    for line in sys.stdin.buffer:
        if line.endswith(b"\n"):  # the last one may be torn
            _add_frame(frames, msgspec.json.decode(line))
    _add_frame(frames, None)
    drawing.join(_LAST)
    _leave(viewer)


if __name__ == "__main__":
    main()
