"""Rerun recordings of a fusion.

Entities: ``<axis>/command``, ``/estimate`` with its variance, ``/<sensor>`` and ``/<sensor>/rejected``, and the
``/reference``; ``innovation/<axis>/<sensor>``, divided by its standard deviation, with the band of ±2
and, of an arm whose noise adapts, ``innovation/<axis>/noise``: how many times as large as configured its sd was;
``residual/<axis>/<sensor>``, the measurement minus the estimate, about ``residual/<axis>/estimate``, 0 with the
estimate's variance; ``outcome/<sensor>``, a state; ``path``, in 3D (``scene.py``). All against seconds since the run's
first command, positions in mm or degrees.

The result of a run that was read from a Rerun recording is a layer of that: it has the same ids, so that the viewer
shows both as one. Its entities are below ``pumafuse/``, on the recording's timeline, too; the path is in m.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from .. import folders
from ..arrays import FloatArray
from ..filter.outcome import Outcome
from ..fusion.estimates import Estimates
from ..fusion.placing import in_base
from ..logs.entities import Recording
from ..logs.frames import in_space
from ..logs.run import Run
from ..units import Screen, seconds
from . import colours, styles
from .scene import by_kind, send_scene, views
from .styles import Sink

_OPENING_S = 4.0
_TWO_COLUMNS = 4  # axes
_SILENT, _SILENT_S = 10.0, 0.5  # times the median interval, and s: a sensor that is quiet for longer is silent
_NOISE = "arm's noise / as configured"  # standard deviations
_BY_GRAVITY = sorted(Outcome, key=lambda outcome: outcome is Outcome.REJECTED)  # a rejected row is the worst


def to_rerun(est: Estimates, run: Run, sink: str | Path | rr.RecordingStream) -> None:
    """Write a fusion as a Rerun recording.

    Args:
        est: The estimates.
        run: The run that they were made from.
        sink: A file to write (``.rrd``), complete or not at all, or a stream of rerun-sdk.

    Raises:
        FolderError: The file cannot be written.
    """
    if isinstance(sink, rr.RecordingStream):
        _send_named(est, run, sink)
    else:
        folders.write_file(Path(sink), recording_of(est, run))


def recording_of(est: Estimates, run: Run) -> bytes:
    """The content of an ``.rrd`` file of a fusion.

    It is not left to rerun-sdk to write it, which may say nothing where the disk is full.
    """
    if run.recording is not None:
        return _layer(est, run, run.recording)
    with rr.RecordingStream("pumafuse") as stream:
        memory = stream.memory_recording()
        stream.send_blueprint(_blueprint(est, run), make_active=True)  # a browser follows no other
        _send_named(est, run, stream)
        return memory.drain_as_bytes()


def _send_named(est: Estimates, run: Run, stream: rr.RecordingStream) -> None:
    stream.send_recording_name(f"{est.run}, {est.mode}")
    _send(est, run, Sink(stream))


def _layer(est: Estimates, run: Run, under: Recording) -> bytes:
    """What opens on top of a recording, whose name, properties and layout stay what they are."""

    def times(time: FloatArray) -> list[rr.TimeColumn]:
        stamp = est.origin + np.rint(time * 1e9).astype(np.int64)
        match under.kind:
            case "timestamp[ns]":
                return [rr.TimeColumn(under.timeline, timestamp=stamp.astype("M8[ns]"))]
            case "duration[ns]":
                return [rr.TimeColumn(under.timeline, duration=stamp.astype("m8[ns]"))]
            case _:
                return [rr.TimeColumn(under.timeline, sequence=np.rint(stamp / under.unit).astype(np.int64))]

    with rr.RecordingStream(under.application, recording_id=under.id, send_properties=False) as stream:
        memory = stream.memory_recording()
        _send(est, run, Sink(stream, times if under.timeline else styles.timeline, "pumafuse/", 1.0))
        return memory.drain_as_bytes()


def _send(est: Estimates, run: Run, sink: Sink) -> None:
    by_sensor = colours.sensor_colours(est.measurements.sensors)
    command = in_base(run, est.config)[0].command
    time = seconds(command.stamp, est.origin)
    for name, axis in est.axes.items():
        screen = est.config.arm.screen_of(name)
        line = styles.line(colours.COMMAND, "command", step=True)
        sink.send_series(f"{name}/command", line, time, command.values[name], screen)
        if est.reference is not None and name in est.reference.position:
            line = styles.line(colours.REFERENCE_3D, "reference")
            sink.send_series(f"{name}/reference", line, est.reference.time, est.reference.position[name], screen)
        for sensor in est.measurements.sensors:
            _send_sensor(sink, est, sensor, name, by_sensor[sensor])
        sink.send_band(f"{name}/estimate", "estimate ± sd", est.time, axis.position, axis.position_sd, screen)
        if name not in _measured_axes(est):
            continue
        nothing = np.zeros(len(est.time))
        sink.send_band(f"residual/{name}/estimate", "estimate's sd", est.time, nothing, axis.position_sd, screen)
        for edge in (2.0, -2.0):
            path = f"innovation/{name}/{'upper' if edge > 0.0 else 'lower'}"
            line = styles.line(colours.BAND, f"{edge:+.0f}", width=0.7)
            sink.send_series(path, line, est.time[[0, -1]], np.full(2, edge))
        if _adapts(est, name):
            on_axis = est.measurements.where(est.measurements.axis == est.measurements.axes.index(name))
            line = styles.line(colours.ESTIMATE, _NOISE, step=True)
            sink.send_series(f"innovation/{name}/noise", line, on_axis.time, np.sqrt(on_axis.noise_scale))
    for sensor in est.measurements.sensors:
        _send_outcomes(sink, est, sensor)
    send_scene(sink, est, run)


def _measured_axes(est: Estimates) -> list[str]:
    """The axes that sensors give values for."""
    return [est.measurements.axes[number] for number in np.unique(est.measurements.axis)]


def _adapts(est: Estimates, axis: str) -> bool:
    return est.config.process[axis].adaptation > 0.0


def _send_sensor(sink: Sink, est: Estimates, sensor: str, axis: str, colour: str) -> None:
    measured, screen = est.measured_positions(sensor, axis), est.config.arm.screen_of(axis)
    fused = (measured.outcome == Outcome.FUSED) | (measured.outcome == Outcome.REACQUIRED)
    name = styles.entity(sensor)
    points, crosses = styles.points(colour, sensor), styles.points(colours.REJECTED, "rejected", "Cross")
    position = np.interp(measured.time, est.time, est[axis].position, left=np.nan, right=np.nan)
    for path, value in ((axis, measured.value), (f"residual/{axis}", measured.value - position)):
        sink.send_series(f"{path}/{name}", points, measured.time[fused], value[fused], screen)
        sink.send_series(f"{path}/{name}/rejected", crosses, measured.time[~fused], value[~fused], screen)
    normalised = measured.innovation / measured.innovation_sd
    sink.send_series(f"innovation/{axis}/{name}", points, measured.time, normalised)


def _send_outcomes(sink: Sink, est: Estimates, sensor: str) -> None:
    """Send what became of a sensor's rows: the worst of its axes, where that changes; and when it falls silent."""
    measured = est.measurements.where(est.measurements.sensor == est.measurements.sensors.index(sensor))
    measured = measured.where(np.isfinite(measured.stamp))
    if not len(measured.stamp):
        return
    time, row = np.unique(measured.stamp, return_inverse=True)
    worst = np.zeros(len(time), dtype=np.int64)
    np.maximum.at(worst, row, np.argsort(_BY_GRAVITY)[measured.outcome])
    gap = np.diff(time, append=np.inf)
    usual = float(np.median(gap[:-1])) if len(gap) > 1 else 0.0
    silent = gap > max(_SILENT_S, _SILENT * usual)
    begins = np.flatnonzero((np.diff(worst, prepend=-1) != 0) | np.append(False, silent[:-1]))
    words = [*(outcome.word for outcome in _BY_GRAVITY), "silent"]
    states = [(float(time[begin]), words[int(worst[begin])]) for begin in begins]
    states = sorted([*states, *((float(time[row]) + usual, "silent") for row in np.flatnonzero(silent))])
    shades = [colours.rgb(colours.OUTCOMES.get(word, colours.COMMAND)) for word in words]
    sink.log(f"outcome/{sensor}", rr.StateConfiguration(values=words, colors=shades))
    changes = rr.StateChange.columns(state=[word for _, word in states])
    sink.send_columns(f"outcome/{sensor}", np.array([at for at, _ in states]), changes)


def _blueprint(est: Estimates, run: Run) -> rrb.Blueprint:
    """A layout that opens on the busiest seconds: positions on the left; the path, residuals and outcomes right.

    Of a tool that turns the path has the left side, and positions are beside rotations.
    """
    start, end = est.busiest(_OPENING_S)
    whole = float(est.time[0]), float(est.time[-1])
    shown = (est.time >= start) & (est.time <= end)
    positions, innovations, residuals = (dict[str, rrb.View]() for _ in range(3))
    for name, axis in est.axes.items():
        screen, limit = est.config.arm.screen_of(name), _residual_span(est, name)
        span, unit = _span(axis.position[shown], screen), screen.unit
        positions[name] = _plot(f"/{name}", f"{name} [{unit}]", (start, end), span, legend=not positions)
        if name in _measured_axes(est):
            title = f"{name}: innovation / its sd, ±2" + (f"; {_NOISE}" if _adapts(est, name) else "")
            innovations[name] = _plot(f"/innovation/{name}", title, whole, (-5.0, 5.0))
            title = f"{name}: measurement − estimate [{unit}]"
            residuals[name] = _plot(f"/residual/{name}", title, whole, (-limit, limit))
    of_sensors = {"innovations": innovations, "residuals": residuals} if innovations else {}
    columns_beside = list[tuple[rrb.View | rrb.Container, float]]()  # with their shares of the height
    if est.turns:
        columns_beside += zip(views(est, run), (5.0, 3.0), strict=False)
    elif est.cartesian is not None or in_space(est.config.arm):
        columns_beside.append((rrb.Spatial3DView(origin="/path", name="path [mm]"), 3.0))
    if of_sensors and not est.turns:
        tabs = (rrb.Vertical(*plots.values(), name=name) for name, plots in of_sensors.items())
        columns_beside.append((rrb.Tabs(*tabs), 4.0))
    if of_sensors:
        time = rrb.TimeAxis(view_range=_range(whole))
        outcomes = rrb.StateTimelineView(origin="/outcome", name="outcomes", time_view=time)
        columns_beside.append((outcomes, 0.6 + 0.4 * len(est.measurements.sensors)))
    column = rrb.Vertical(*(view for view, _ in columns_beside), row_shares=[share for _, share in columns_beside])
    if est.turns:
        every = {"positions": positions} | of_sensors
        tabs = (by_kind(plots, est.config.arm.kind_of, name) for name, plots in every.items())
        return rrb.Blueprint(rrb.Horizontal(column, rrb.Tabs(*tabs), column_shares=[1, 1]), collapse_panels=True)
    grid = rrb.Grid(*positions.values(), grid_columns=1 if len(positions) < _TWO_COLUMNS else 2)
    layout = rrb.Horizontal(grid, column, column_shares=[3, 2]) if columns_beside else grid
    return rrb.Blueprint(layout, collapse_panels=True)


def _plot(
    origin: str, name: str, time: tuple[float, float], span: tuple[float, float], *, legend: bool = False
) -> rrb.TimeSeriesView:
    """A plot over a time [s]."""
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
        axis_x=rrb.TimeAxis(view_range=_range(time)),
        axis_y=rrb.ScalarAxis(range=span),
    )


def _range(time: tuple[float, float]) -> rrb.TimeRange:
    return rrb.TimeRange(*(rrb.TimeRangeBoundary.absolute(seconds=edge) for edge in time))


def _span(position: FloatArray, screen: Screen) -> tuple[float, float]:
    """Limits of a plot, in the unit of the screen, of positions [SI]."""
    low, high = float(position.min()) * screen.scale, float(position.max()) * screen.scale
    margin = 0.2 * (high - low) + 0.5
    return low - margin, high + margin


def _residual_span(est: Estimates, axis: str) -> float:
    """The limit of a plot of measurements less the estimate, in the unit of the screen: far outliers are left out."""
    sds = [est.measurements.of(sensor, axis).innovation_sd for sensor in est.measurements.sensors]
    medians = [float(np.median(sd[np.isfinite(sd)])) for sd in sds if np.isfinite(sd).any()]
    return 4.0 * max(medians, default=1e-3) * est.config.arm.screen_of(axis).scale
