"""Rerun recordings of a fusion.

Entities: ``<axis>/command``, ``/reference``, ``/estimate`` with ``/upper`` and ``/lower`` at ±2σ, ``/<sensor>`` and
``/<sensor>/rejected``; ``innovation/<axis>/<sensor>`` with its ±2σ band; ``path/command`` and ``path/estimate`` in 3D.
All against seconds since the run's first command, positions in mm or degrees.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..arrays import FloatArray
from ..filter.outcome import Outcome
from ..fusion.estimates import Estimates
from ..logs.axes import in_axes
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
        _send(est, run, sink)
        return
    with rr.RecordingStream("pumafuse") as stream:
        stream.save(str(sink), default_blueprint=_blueprint(est))
        _send(est, run, stream)


def _send(est: Estimates, run: Run, stream: rr.RecordingStream) -> None:
    stream.send_recording_name(f"{est.run}, {est.mode}")
    by_sensor = colours.sensor_colours(est.measurements.sensors)
    command = in_axes(run, est.config.frame)[0].command
    time = seconds(command.stamp, est.origin)
    for name, axis in est.axes.items():
        screen = est.config.arm.screen_of(name)
        line = styles.line(colours.COMMAND, "command", step=True)
        _series(stream, f"{name}/command", line, time, command.values[name], screen)
        if est.reference is not None and name in est.reference.position:
            line = styles.line(colours.REFERENCE_3D, "reference")
            _series(stream, f"{name}/reference", line, est.reference.time, est.reference.position[name], screen)
        for sensor in est.measurements.sensors:
            _sensor(stream, est, sensor, name, by_sensor[sensor])
        _band(stream, f"{name}/estimate", est.time, axis.position, 2.0 * axis.position_sd, screen)
        line = styles.line(colours.ESTIMATE, "estimate")
        _series(stream, f"{name}/estimate", line, est.time, axis.position, screen)
    _paths(stream, est, run)


def _sensor(stream: rr.RecordingStream, est: Estimates, sensor: str, axis: str, colour: str) -> None:
    measured, screen = est.measured_positions(sensor, axis), est.config.arm.screen_of(axis)
    fused = (measured.outcome == Outcome.FUSED) | (measured.outcome == Outcome.REACQUIRED)
    points = styles.points(colour, sensor)
    _series(stream, f"{axis}/{sensor}", points, measured.time[fused], measured.value[fused], screen)
    crosses = styles.points(colours.REJECTED, "rejected", "Cross")
    _series(stream, f"{axis}/{sensor}/rejected", crosses, measured.time[~fused], measured.value[~fused], screen)
    path = f"innovation/{axis}/{sensor}"
    _series(stream, path, points, measured.time, measured.innovation, screen)
    _band(stream, path, measured.time, np.zeros(len(measured.time)), 2.0 * measured.innovation_sd, screen)


def _paths(stream: rr.RecordingStream, est: Estimates, run: Run) -> None:
    """Send command and estimate in 3D: the log's x, y, z, or without them tangential, radial, vertical."""
    names = in_space(est.config.arm) if est.cartesian is None else CARTESIAN
    estimated = est.cartesian or {name: axis.position for name, axis in est.axes.items()}
    command = run.command.values
    if not names or not all(name in estimated for name in names):
        return
    if all(name in command for name in names):
        _strip(stream, "path/command", [command[name] for name in names], colours.COMMAND, 0.3)
    _strip(stream, "path/estimate", [estimated[name] for name in names], colours.ESTIMATE, 0.6)
    every = max(1, len(est.time) // _PATH_POINTS)
    position = np.column_stack([estimated[name] for name in names])[::every] * MM
    style = rr.Points3D.from_fields(colors=[colours.rgb(colours.REJECTED)], radii=[2.5])
    rr.log("path/tool", style, static=True, recording=stream)
    time = rr.TimeColumn(styles.TIMELINE, duration=est.time[::every])
    rr.send_columns("path/tool", [time], rr.Points3D.columns(positions=position), recording=stream)


def _strip(stream: rr.RecordingStream, path: str, coordinates: list[FloatArray], colour: str, radius: float) -> None:
    points = np.column_stack(coordinates) * MM
    points = points[np.isfinite(points).all(axis=1)]
    points = points[:: max(1, len(points) // _PATH_POINTS)]
    line = rr.LineStrips3D([points], colors=[colours.rgb(colour)], radii=[radius])
    rr.log(path, line, static=True, recording=stream)


def _band(
    stream: rr.RecordingStream, path: str, time: FloatArray, centre: FloatArray, half: FloatArray, screen: Screen
) -> None:
    _series(stream, f"{path}/upper", styles.edge("+2σ"), time, centre + half, screen)
    _series(stream, f"{path}/lower", styles.edge("−2σ"), time, centre - half, screen)


def _series(
    stream: rr.RecordingStream, path: str, style: styles.Style, time: FloatArray, value: FloatArray, screen: Screen
) -> None:
    """Send the style and the finite values [SI] of an entity; nothing where there are none."""
    if (np.isfinite(time) & np.isfinite(value)).any():
        rr.log(path, style, static=True, recording=stream)
        styles.send(stream, path, time, value * screen.scale)


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
