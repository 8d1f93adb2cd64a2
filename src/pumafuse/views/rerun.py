"""Rerun recordings: the one bridge to rerun-sdk.

Entities: ``<axis>/command``, ``/reference``, ``/estimate`` with ``/upper`` and ``/lower`` at ±2σ, ``/<sensor>`` and
``/<sensor>/rejected``; ``innovation/<axis>/<sensor>`` with its ±2σ band; ``path/command`` and ``path/estimate`` in 3D.
All against seconds since the run's first command, positions in mm.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..arrays import FloatArray
from ..fusion.estimates import Estimates, Measurements
from ..filter.outcome import Outcome
from ..logs.axes import in_axes
from ..logs.frames import CARTESIAN
from ..logs.run import Run
from ..model.arm import CANONICAL_AXES
from ..units import MM, seconds
from . import looks, style

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
        _send(est, run, sink)
        return
    with rr.RecordingStream("pumafuse") as stream:
        stream.save(str(sink), default_blueprint=_blueprint(est))
        _send(est, run, stream)


def _send(est: Estimates, run: Run, stream: rr.RecordingStream) -> None:
    stream.send_recording_name(f"{est.run}, {est.mode}")
    colours = style.sensor_colours(est.measurements.sensors)
    command = in_axes(run, est.config.frame)[0].command
    time = seconds(command.stamp, est.origin)
    for name, axis in est.axes.items():
        _line(stream, f"{name}/command", time, command.values[name], style.COMMAND, step=True)
        if est.reference is not None and name in est.reference.position:
            _line(stream, f"{name}/reference", est.reference.time, est.reference.position[name], style.REFERENCE_3D)
        for sensor in est.measurements.sensors:
            _sensor(stream, est, sensor, name, colours[sensor])
        half = 2.0 * axis.position_sd
        _band(stream, f"{name}/estimate", est.time, axis.position + half, axis.position - half)
        _line(stream, f"{name}/estimate", est.time, axis.position, style.ESTIMATE)
    _paths(stream, est, run)


def _sensor(stream: rr.RecordingStream, est: Estimates, sensor: str, axis: str, colour: str) -> None:
    seen = style.positions(est, sensor, axis)
    if not len(seen.value):
        return
    fused = (seen.outcome == Outcome.FUSED) | (seen.outcome == Outcome.REACQUIRED)
    _points(stream, f"{axis}/{sensor}", seen.time[fused], seen.value[fused], colour)
    _points(stream, f"{axis}/{sensor}/rejected", seen.time[~fused], seen.value[~fused], style.REJECTED, marker="Cross")
    _innovations(stream, f"innovation/{axis}/{sensor}", seen.where(np.isfinite(seen.innovation)), colour)


def _innovations(stream: rr.RecordingStream, path: str, met: Measurements, colour: str) -> None:
    _points(stream, path, met.time, met.innovation, colour)
    _band(stream, path, met.time, 2.0 * met.innovation_sd, -2.0 * met.innovation_sd)


def _paths(stream: rr.RecordingStream, est: Estimates, run: Run) -> None:
    """Command and estimate in space: the log's x, y, z with a frame, else tangential, radial, vertical."""
    if est.cartesian is not None:
        command, estimated, names = run.command.values, est.cartesian, CARTESIAN
    else:
        command, names = run.command.values, CANONICAL_AXES
        estimated = {name: axis.position for name, axis in est.axes.items()}
    if not all(name in estimated for name in names):
        return
    if all(name in command for name in names):
        _strip(stream, "path/command", [command[name] for name in names], style.COMMAND, 0.3)
    _strip(stream, "path/estimate", [estimated[name] for name in names], style.ESTIMATE, 0.6)
    every = max(1, len(est.time) // _PATH_POINTS)
    position = np.column_stack([estimated[name] for name in names])[::every] * MM
    look = rr.Points3D.from_fields(colors=[style.rgb(style.REJECTED)], radii=[2.5])
    rr.log("path/tool", look, static=True, recording=stream)
    columns = rr.Points3D.columns(positions=position)
    rr.send_columns("path/tool", [rr.TimeColumn(looks.TIMELINE, duration=est.time[::every])], columns, recording=stream)


def _strip(stream: rr.RecordingStream, path: str, coordinates: list[FloatArray], colour: str, radius: float) -> None:
    points = np.column_stack(coordinates) * MM
    points = points[np.isfinite(points).all(axis=1)]
    points = points[:: max(1, len(points) // _PATH_POINTS)]
    line = rr.LineStrips3D([points], colors=[style.rgb(colour)], radii=[radius])
    rr.log(path, line, static=True, recording=stream)


def _band(stream: rr.RecordingStream, path: str, time: FloatArray, upper: FloatArray, lower: FloatArray) -> None:
    _series(stream, f"{path}/upper", looks.edge("+2σ"), time, upper)
    _series(stream, f"{path}/lower", looks.edge("−2σ"), time, lower)


def _line(
    stream: rr.RecordingStream, path: str, time: FloatArray, value: FloatArray, colour: str, *, step: bool = False
) -> None:
    _series(stream, path, looks.line(colour, path.rpartition("/")[2], step=step), time, value)


def _points(
    stream: rr.RecordingStream,
    path: str,
    time: FloatArray,
    value: FloatArray,
    colour: str,
    marker: looks.Marker = "Circle",
) -> None:
    _series(stream, path, looks.points(colour, path.rpartition("/")[2], marker), time, value)


def _series(
    stream: rr.RecordingStream, path: str, look: rr.SeriesLines | rr.SeriesPoints, time: FloatArray, value: FloatArray
) -> None:
    if (np.isfinite(time) & np.isfinite(value)).any():
        rr.log(path, look, static=True, recording=stream)
        looks.send(stream, path, time, value * MM)


def _blueprint(est: Estimates) -> rrb.Blueprint:
    """Opens on the busiest seconds: positions on the left; the path and all innovations on the right."""
    start, end = style.busiest(est, _OPENING_S)
    bounds = [rrb.TimeRangeBoundary.absolute(seconds=edge) for edge in (start, end)]
    legend = rrb.PlotLegend(rrb.Corner2D.RightTop)
    positions = [
        rrb.TimeSeriesView(
            origin=f"/{name}",
            name=f"{name} [mm]",
            plot_legend=legend,
            axis_x=rrb.TimeAxis(view_range=rrb.TimeRange(*bounds)),
            axis_y=rrb.ScalarAxis(range=_span(axis.position[(est.time >= start) & (est.time <= end)])),
        )
        for name, axis in est.axes.items()
    ]
    innovations = [
        rrb.TimeSeriesView(
            origin=f"/innovation/{name}",
            name=f"{name}: innovations and ±2σ [mm]",
            plot_legend=legend,
            axis_y=rrb.ScalarAxis(range=_innovation_span(est, name)),
        )
        for name in est.axes
    ]
    path = rrb.Spatial3DView(origin="/path", name="path [mm]")
    left, right = rrb.Vertical(*positions), rrb.Vertical(path, rrb.Tabs(*innovations))
    return rrb.Blueprint(rrb.Horizontal(left, right, column_shares=[3, 2]), collapse_panels=True)


def _span(position: FloatArray) -> tuple[float, float]:
    """A plot's limits [mm] about some positions [m]."""
    low, high = float(position.min()) * MM, float(position.max()) * MM
    margin = 0.2 * (high - low) + 0.5
    return low - margin, high + margin


def _innovation_span(est: Estimates, axis: str) -> tuple[float, float]:
    """Limits [mm] that show the band and leave the far outliers out."""
    mine = est.measurements.where(est.measurements.axis == est.measurements.axes.index(axis))
    known = mine.innovation_sd[np.isfinite(mine.innovation_sd)]
    limit = 6.0 * float(np.median(known)) * MM if len(known) else 1.0
    return -limit, limit
