"""Figures with matplotlib."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..arrays import NO_STAMP, FloatArray
from ..fusion.estimates import Estimates, Readings
from ..fusion.score import Z95, interpolated
from ..fusion.timeline import Outcome
from ..runs.run import Run
from ..units import MM
from . import style


def fused_figure(est: Estimates, run: Run, path: Path) -> None:
    """The fused run: per axis the path with its readings, and beside it the error against the reference.

    Without a reference the right column shows the estimate's 95 % interval alone.

    Args:
        est: The estimates.
        run: The run that they were made from.
        path: Where the picture goes; its ending says which format.
    """
    rows = len(est.axes)
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(13.0, 2.6 * rows + 0.8), layout="constrained")
        grid = figure.subplots(rows, 2, squeeze=False, sharex=True)
        for (left, right), name in zip(grid, est.axes, strict=True):
            _path(left, est, run, name)
            _error(right, est, name)
        grid[0][0].legend(loc="upper right", ncols=2, frameon=False)
        grid[0][1].legend(loc="upper right", ncols=2, frameon=False)
        for axes in grid[-1]:
            axes.set_xlabel("time since the first command [s]")
        figure.suptitle(f"{run.name}: {', '.join(est.readings.sensors) or 'commands only'}, arm {est.config.arm.name}")
        figure.savefig(path, dpi=130)


def _path(axes: Axes, est: Estimates, run: Run, name: str) -> None:
    commanded = run.command.stamp != NO_STAMP
    time = (run.command.stamp[commanded] - est.origin) * 1e-9
    axes.step(
        time, run.command.values[name][commanded] * MM, where="post", color=style.COMMAND, lw=1.0, label="command"
    )
    for sensor, colour in style.sensor_colours(est.readings.sensors).items():
        scalars = _positions(est, est.readings.of(sensor, name), sensor)
        fused = scalars.outcome == Outcome.FUSED
        axes.plot(scalars.time[fused], scalars.value[fused] * MM, ".", ms=1.5, color=colour, label=sensor)
        rejected = scalars.outcome == Outcome.GATED
        axes.plot(scalars.time[rejected], scalars.value[rejected] * MM, "x", ms=4, color=style.REJECTED, label="gated")
    axes.plot(est.time, est[name].position * MM, color=style.ESTIMATE, lw=1.0, label="estimate")
    low, high = np.nanmin(est[name].position) * MM, np.nanmax(est[name].position) * MM
    margin = 0.1 * (high - low) + 1.0
    axes.set_ylim(low - margin, high + margin)
    axes.set_ylabel(f"{name} [mm]")


def _error(axes: Axes, est: Estimates, name: str) -> None:
    band = Z95 * est[name].position_sd * MM
    axes.fill_between(est.time, -band, band, color=style.ESTIMATE, alpha=0.25, lw=0, label="95 % interval")
    axes.axhline(0.0, color=style.COMMAND, lw=0.5)
    axes.set_ylabel("error [mm]" if est.reference is not None else "95 % interval [mm]")
    limit = 2.5 * float(np.quantile(band, 0.99))
    if est.reference is not None and name in est.reference.position:
        truth = interpolated(est.time, est.segment, est.reference, name)
        error = (est[name].position - truth) * MM
        for sensor, colour in style.sensor_colours(est.readings.sensors).items():
            scalars = _positions(est, est.readings.of(sensor, name), sensor)
            raw = (scalars.value - _reference_at(est, scalars.time, name)) * MM
            axes.plot(scalars.time, raw, ".", ms=1.5, color=colour, alpha=0.6, label=f"{sensor}, latency removed")
        axes.plot(est.time, error, color=style.REFERENCE, lw=0.8, label="estimate")
        axes.set_title(f"{name}: RMS error {_rms(error):.3f} mm", fontsize=9, loc="left")
        limit = max(limit, 1.5 * float(np.nanmax(np.abs(error), initial=0.0)))
    axes.set_ylim(-limit, limit)


def _positions(est: Estimates, scalars: Readings, sensor: str) -> Readings:
    """The scalars of a sensor that reads the position itself; none of one that reads something else."""
    configured = est.config.sensors.get(sensor)
    reads_position = configured is not None and configured.scale == 1.0 and configured.bias_sd == 0.0
    return scalars.where(np.full(len(scalars.value), reads_position))


def _reference_at(est: Estimates, time: FloatArray, name: str) -> FloatArray:
    assert est.reference is not None
    segment = np.full(len(time), est.segment[0] if len(est.segment) else 0)
    return interpolated(time, segment, est.reference, name)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
