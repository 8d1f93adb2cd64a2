"""Rerun recordings of a fusion.

Entities: ``<axis>/command``, ``/reference``, ``/estimate`` with ``/upper`` and ``/lower`` at ±2σ, ``/<sensor>`` and
``/<sensor>/rejected``; ``innovation/<axis>/<sensor>`` with its ±2σ band; ``path/command`` and ``path/estimate`` in 3D.
All against seconds since the run's first command, positions in mm or degrees.

The result of a run that was read from a Rerun recording is a layer of that: it has the same ids, so that the viewer
shows both as one. Its entities are below ``pumafuse/``, on the recording's timeline, too; the path is in m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..arrays import FloatArray
from ..filter.outcome import Outcome
from ..fusion.estimates import Estimates
from ..logs.axes import in_axes
from ..logs.entities import Recording
from ..logs.frames import CARTESIAN, in_space
from ..logs.run import Run
from ..units import MM, Screen, seconds
from . import colours, styles

_OPENING_S = 4.0
_PATH_POINTS = 20_000  # a 3D path needs no more, whatever the rate of the estimates


def to_rerun(est: Estimates, run: Run, sink: str | Path | rr.RecordingStream) -> None:
    """Write a fusion as a Rerun recording.

    Args:
        est: The estimates.
        run: The run that they were made from.
        sink: A file to write (``.rrd``), or a stream of rerun-sdk.
    """
    if isinstance(sink, rr.RecordingStream):
        _send_named(est, run, sink)
    elif run.recording is None:
        with rr.RecordingStream("pumafuse") as stream:
            stream.save(str(sink), default_blueprint=_blueprint(est))
            _send_named(est, run, stream)
    else:
        _save_layer(est, run, run.recording, sink)


@dataclass(frozen=True)
class _Sink:
    """Where entities go.

    Attributes:
        stream: The recording.
        times: The timelines of seconds since the first command, (n,).
        root: What their paths begin with.
        scale: How many units of the scene a metre is.
    """

    stream: rr.RecordingStream
    times: Callable[[FloatArray], list[rr.TimeColumn]] = styles.timeline
    root: str = ""
    scale: float = MM

    def log(self, path: str, style: rr.AsComponents) -> None:
        """Send what holds at all times."""
        rr.log(f"{self.root}{path}", style, static=True, recording=self.stream)

    def columns(self, path: str, time: FloatArray, columns: rr.ComponentColumnList) -> None:
        """Send what is for times [s since the first command], (n,)."""
        rr.send_columns(f"{self.root}{path}", self.times(time), columns, recording=self.stream)


def _send_named(est: Estimates, run: Run, stream: rr.RecordingStream) -> None:
    stream.send_recording_name(f"{est.run}, {est.mode}")
    _send(est, run, _Sink(stream))


def _save_layer(est: Estimates, run: Run, under: Recording, path: str | Path) -> None:
    """Save what opens on top of a recording, whose name, properties and layout stay what they are."""

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
        stream.save(str(path))
        _send(est, run, _Sink(stream, times if under.timeline else styles.timeline, "pumafuse/", 1.0))


def _send(est: Estimates, run: Run, sink: _Sink) -> None:
    by_sensor = colours.sensor_colours(est.measurements.sensors)
    command = in_axes(run, est.config.frame)[0].command
    time = seconds(command.stamp, est.origin)
    for name, axis in est.axes.items():
        screen = est.config.arm.screen_of(name)
        line = styles.line(colours.COMMAND, "command", step=True)
        _series(sink, f"{name}/command", line, time, command.values[name], screen)
        if est.reference is not None and name in est.reference.position:
            line = styles.line(colours.REFERENCE_3D, "reference")
            _series(sink, f"{name}/reference", line, est.reference.time, est.reference.position[name], screen)
        for sensor in est.measurements.sensors:
            _sensor(sink, est, sensor, name, by_sensor[sensor])
        _band(sink, f"{name}/estimate", est.time, axis.position, 2.0 * axis.position_sd, screen)
        line = styles.line(colours.ESTIMATE, "estimate")
        _series(sink, f"{name}/estimate", line, est.time, axis.position, screen)
    _paths(sink, est, run)


def _sensor(sink: _Sink, est: Estimates, sensor: str, axis: str, colour: str) -> None:
    measured, screen = est.measured_positions(sensor, axis), est.config.arm.screen_of(axis)
    fused = (measured.outcome == Outcome.FUSED) | (measured.outcome == Outcome.REACQUIRED)
    points = styles.points(colour, sensor)
    _series(sink, f"{axis}/{sensor}", points, measured.time[fused], measured.value[fused], screen)
    crosses = styles.points(colours.REJECTED, "rejected", "Cross")
    _series(sink, f"{axis}/{sensor}/rejected", crosses, measured.time[~fused], measured.value[~fused], screen)
    path = f"innovation/{axis}/{sensor}"
    _series(sink, path, points, measured.time, measured.innovation, screen)
    _band(sink, path, measured.time, np.zeros(len(measured.time)), 2.0 * measured.innovation_sd, screen)


def _paths(sink: _Sink, est: Estimates, run: Run) -> None:
    """Send command and estimate in 3D: the log's x, y, z, or without them tangential, radial, vertical."""
    names = in_space(est.config.arm) if est.cartesian is None else CARTESIAN
    estimated = est.cartesian or {name: axis.position for name, axis in est.axes.items()}
    command = run.command.values
    if not names or not all(name in estimated for name in names):
        return
    if all(name in command for name in names):
        _strip(sink, "path/command", [command[name] for name in names], colours.COMMAND, 0.3e-3)
    _strip(sink, "path/estimate", [estimated[name] for name in names], colours.ESTIMATE, 0.6e-3)
    every = max(1, len(est.time) // _PATH_POINTS)
    position = np.column_stack([estimated[name] for name in names])[::every] * sink.scale
    style = rr.Points3D.from_fields(colors=[colours.rgb(colours.REJECTED)], radii=[2.5e-3 * sink.scale])
    sink.log("path/tool", style)
    sink.columns("path/tool", est.time[::every], rr.Points3D.columns(positions=position))


def _strip(sink: _Sink, path: str, coordinates: list[FloatArray], colour: str, radius: float) -> None:
    points = np.column_stack(coordinates) * sink.scale
    points = points[np.isfinite(points).all(axis=1)]
    points = points[:: max(1, len(points) // _PATH_POINTS)]
    line = rr.LineStrips3D([points], colors=[colours.rgb(colour)], radii=[radius * sink.scale])
    sink.log(path, line)


def _band(sink: _Sink, path: str, time: FloatArray, centre: FloatArray, half: FloatArray, screen: Screen) -> None:
    _series(sink, f"{path}/upper", styles.edge("+2σ"), time, centre + half, screen)
    _series(sink, f"{path}/lower", styles.edge("−2σ"), time, centre - half, screen)


def _series(sink: _Sink, path: str, style: styles.Style, time: FloatArray, value: FloatArray, screen: Screen) -> None:
    """Send the style and the finite values [SI] of an entity; nothing where there are none."""
    there = np.isfinite(time) & np.isfinite(value)
    if there.any():
        sink.log(path, style)
        sink.columns(path, time[there], rr.Scalars.columns(scalars=value[there] * screen.scale))


def _blueprint(est: Estimates) -> rrb.Blueprint:
    """A layout that opens on the busiest seconds: positions on the left, the path and innovations on the right."""
    start, end = est.busiest(_OPENING_S)
    bounds = [rrb.TimeRangeBoundary.absolute(seconds=edge) for edge in (start, end)]
    legend = rrb.PlotLegend(rrb.Corner2D.RightTop)
    positions, innovations = list[rrb.TimeSeriesView](), list[rrb.TimeSeriesView]()
    for name, axis in est.axes.items():
        screen = est.config.arm.screen_of(name)
        opening = axis.position[(est.time >= start) & (est.time <= end)]
        positions.append(
            rrb.TimeSeriesView(
                origin=f"/{name}",
                name=f"{name} [{screen.unit}]",
                plot_legend=legend,
                axis_x=rrb.TimeAxis(view_range=rrb.TimeRange(*bounds)),
                axis_y=rrb.ScalarAxis(range=_span(opening, screen)),
            )
        )
        innovations.append(
            rrb.TimeSeriesView(
                origin=f"/innovation/{name}",
                name=f"{name}: innovations and ±2σ [{screen.unit}]",
                plot_legend=legend,
                axis_y=rrb.ScalarAxis(range=_innovation_span(est, name)),
            )
        )
    left, right = rrb.Vertical(*positions), rrb.Tabs(*innovations)
    if est.cartesian is not None or in_space(est.config.arm):
        right = rrb.Vertical(rrb.Spatial3DView(origin="/path", name="path [mm]"), right)
    return rrb.Blueprint(rrb.Horizontal(left, right, column_shares=[3, 2]), collapse_panels=True)


def _span(position: FloatArray, screen: Screen) -> tuple[float, float]:
    """Limits of a plot, in the unit of the screen, of positions [SI]."""
    low, high = float(position.min()) * screen.scale, float(position.max()) * screen.scale
    margin = 0.2 * (high - low) + 0.5
    return low - margin, high + margin


def _innovation_span(est: Estimates, axis: str) -> tuple[float, float]:
    """Limits of an innovation plot, in the unit of the screen: they show the band and leave out far outliers."""
    mine = est.measurements.where(est.measurements.axis == est.measurements.axes.index(axis))
    known = mine.innovation_sd[np.isfinite(mine.innovation_sd)]
    limit = 6.0 * float(np.median(known)) * est.config.arm.screen_of(axis).scale if len(known) else 1.0
    return -limit, limit
