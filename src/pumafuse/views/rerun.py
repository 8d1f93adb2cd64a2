"""Rerun recordings: the one bridge to rerun-sdk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..arrays import FloatArray
from ..fusion.estimates import Estimates
from ..fusion.timeline import Outcome
from ..runs.run import Run
from ..units import MM, seconds
from . import style

_TIMELINE = "time"  # seconds since the run's first command


def to_rerun(est: Estimates, run: Run, sink: str | Path | rr.RecordingStream) -> None:
    """Write a fusion as a Rerun recording, positions in mm against seconds since the first command.

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
    colours = style.sensor_colours(est.readings.sensors)
    command_time = seconds(run.command.stamp, est.origin)
    for name, axis in est.axes.items():
        _line(stream, f"{name}/command", command_time, run.command.values[name], style.COMMAND, step=True)
        if est.reference is not None and name in est.reference.position:
            _line(stream, f"{name}/reference", est.reference.time, est.reference.position[name], style.REFERENCE)
        for sensor in est.readings.sensors:
            scalars = est.readings.of(sensor, name)
            rejected = (scalars.outcome != Outcome.FUSED) & (scalars.outcome != Outcome.REOPENED)
            _points(stream, f"{name}/{sensor}", scalars.time[~rejected], scalars.value[~rejected], colours[sensor])
            _points(
                stream, f"{name}/{sensor}/rejected", scalars.time[rejected], scalars.value[rejected], style.REJECTED
            )
        _line(
            stream,
            f"{name}/estimate/upper",
            est.time,
            axis.position + 2.0 * axis.position_sd,
            style.ESTIMATE,
            width=0.5,
        )
        _line(
            stream,
            f"{name}/estimate/lower",
            est.time,
            axis.position - 2.0 * axis.position_sd,
            style.ESTIMATE,
            width=0.5,
        )
        _line(stream, f"{name}/estimate", est.time, axis.position, style.ESTIMATE)


def _line(
    stream: rr.RecordingStream,
    path: str,
    time: FloatArray,
    value: FloatArray,
    colour: str,
    *,
    width: float = 1.5,
    step: bool = False,
) -> None:
    mode = "StepAfter" if step else "Linear"
    look = rr.SeriesLines(colors=[style.rgb(colour)], widths=width, names=path, interpolation_mode=mode)
    _series(stream, path, look, time, value)


def _points(stream: rr.RecordingStream, path: str, time: FloatArray, value: FloatArray, colour: str) -> None:
    look = rr.SeriesPoints(colors=[style.rgb(colour)], marker_sizes=2.0, names=path)
    _series(stream, path, look, time, value)


def _series(
    stream: rr.RecordingStream, path: str, look: rr.SeriesLines | rr.SeriesPoints, time: FloatArray, value: FloatArray
) -> None:
    there = np.isfinite(time) & np.isfinite(value)
    if not there.any():
        return
    rr.log(path, look, static=True, recording=stream)
    columns = rr.Scalars.columns(scalars=value[there] * MM)
    rr.send_columns(path, [rr.TimeColumn(_TIMELINE, duration=time[there])], columns, recording=stream)


def _blueprint(est: Estimates) -> rrb.Blueprint:
    plots = [rrb.TimeSeriesView(origin=f"/{name}", name=f"{name} [mm]") for name in est.axes]
    return rrb.Blueprint(rrb.Vertical(*plots), collapse_panels=True)
