"""Figures with matplotlib: the fused run, its error, and the validation of the filter."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..arrays import FloatArray
from ..filter.outcome import Outcome
from ..fusion.consistency import LAGS, consistency
from ..fusion.estimates import Estimates
from ..fusion.score import Z95, interpolated
from ..logs.axes import in_axes
from ..logs.run import Run
from ..units import MM, seconds
from . import colours

_ZOOM_S = 2.0  # length of the detail in which the band and single measurements can be seen


def fused_figure(est: Estimates, run: Run, path: Path) -> None:
    """Draw the fused run: per axis the whole of it, and its busiest two seconds with measurements and 95 % band.

    Args:
        est: The estimates.
        run: The run that they were made from.
        path: Where the picture goes; its ending says which format.
    """
    commanded = in_axes(run, est.config.frame)[0].command
    time = seconds(commanded.stamp, est.origin)
    start, end = est.busiest(_ZOOM_S)
    with _figure(est, path, len(est.axes), 2) as grid:
        for (whole, zoom), name in zip(grid, est.axes, strict=True):
            position = est[name].position
            for axes in (whole, zoom):
                axes.step(time, commanded.values[name] * MM, where="post", color=colours.COMMAND, lw=1, label="command")
                _measurements(axes, est, name)
                _band(axes, est, name, position)
                axes.plot(est.time, position * MM, color=colours.ESTIMATE, lw=1.0, label="estimate")
                axes.set_ylabel(f"{name} [mm]")
            _limits(whole, position * MM)
            zoom.set_xlim(start, end)
            _limits(zoom, position[(est.time >= start) & (est.time <= end)] * MM)
        grid[0][1].legend(loc="best", ncols=2, frameon=False)


def error_figure(est: Estimates, path: Path) -> None:
    """Draw the error against the reference with its 95 % band, over the errors of the measurements.

    Args:
        est: Estimates of a run that has a reference.
        path: Where the picture goes.

    Raises:
        ValueError: The run has no reference.
    """
    if est.reference is None:
        raise ValueError("the run has no reference")
    errors = {
        name: est[name].position - interpolated(est.time, est.segment, est.reference, name)
        for name in est.axes
        if name in est.reference.position
    }
    errors = {name: error for name, error in errors.items() if np.isfinite(error).any()}
    if not errors:
        return
    with _figure(est, path, len(errors), 1) as grid:
        for (axes,), (name, error) in zip(grid, errors.items(), strict=True):
            for sensor, colour in colours.sensor_colours(est.measurements.sensors).items():
                measured = est.measured_positions(sensor, name)
                first = np.zeros(len(measured.time), dtype=np.int64)  # only the first segment: enough for a picture
                raw = measured.value - interpolated(measured.time, first, est.reference, name)
                label = f"{sensor}, latency removed"
                axes.plot(measured.time, raw * MM, ".", ms=1.5, color=colour, alpha=0.6, label=label)
            _band(axes, est, name, np.zeros(len(est.time)))
            axes.plot(est.time, error * MM, color=colours.REFERENCE, lw=0.8, label="estimate")
            rms = float(np.sqrt(np.nanmean(error**2))) * MM
            axes.set_title(f"{name}: RMS error {rms:.3f} mm", loc="left", fontsize=9)
            axes.set_ylabel("error [mm]")
            limit = max(1.3 * float(np.nanmax(np.abs(error))) * MM, 1e-6)
            axes.set_ylim(-limit, limit)
        grid[0][0].legend(loc="upper right", ncols=3, frameon=False)


def validation_figure(est: Estimates, path: Path) -> None:
    """Draw the innovations of each sensor and axis, three panels a row, with the verdict above them.

    Left: normalised innovations, 95 % of which lie within the band. Middle: their histogram and the normal density
    that they should have. Right: their autocorrelation, which lies within its band if they are white.

    Args:
        est: The estimates.
        path: Where the picture goes.
    """
    pairs = [(sensor, axis) for axis in est.axes for sensor in est.measurements.sensors]
    rows = [(sensor, axis, found) for sensor, axis in pairs if (found := consistency(est, sensor, axis)) is not None]
    if not rows:
        return
    by_sensor = colours.sensor_colours(est.measurements.sensors)
    at = np.linspace(-4.5, 4.5, 91)
    with _figure(est, path, len(rows), 3, share_time=False) as grid:
        for (series, histogram, correlation), (sensor, axis, found) in zip(grid, rows, strict=True):
            measurements, colour = est.measurements.of(sensor, axis), by_sensor[sensor]
            fused = measurements.where(measurements.outcome == Outcome.FUSED)
            normalised = fused.innovation / fused.innovation_sd
            series.plot(fused.time, normalised, ".", ms=1.5, color=colour)
            series.axhspan(-Z95, Z95, color=colours.ESTIMATE, alpha=0.15, lw=0)
            series.set_title(f"{axis}, {sensor}. {found.verdict}", loc="left", fontsize=9)
            series.set_ylabel("innovation / sd")
            inside = np.clip(normalised, at[0], at[-1])
            histogram.hist(inside, bins=45, range=(at[0], at[-1]), density=True, color=colour, alpha=0.6)
            histogram.plot(at, np.exp(-0.5 * at**2) / np.sqrt(2.0 * np.pi), color=colours.REFERENCE, lw=1.0)
            histogram.set_ylabel("density")
            correlation.bar(np.arange(1, len(found.correlation) + 1), found.correlation, color=colour, width=0.6)
            band = found.correlation_band
            correlation.axhspan(-band, band, color=colours.ESTIMATE, alpha=0.2, lw=0)
            correlation.set_ylim(min(-0.3, 1.1 * float(found.correlation.min(initial=0.0))), 1.0)
            correlation.set_xlim(0, LAGS + 1)
            correlation.set_ylabel("autocorrelation")
        for axes, label in zip(grid[-1], ("time [s]", "innovation / sd", "lag [measurements]"), strict=True):
            axes.set_xlabel(label)


@contextmanager
def _figure(
    est: Estimates, path: Path, rows: int, columns: int, *, share_time: bool = True
) -> Generator[list[list[Axes]]]:
    """A grid of axes, written to ``path`` on leaving the block."""
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(13.0, 2.4 * rows + 0.8), layout="constrained")
        ratios = [3.0, 1.0, 1.0] if columns == 3 else [1.0] * columns
        grid = figure.subplots(rows, columns, squeeze=False, sharex="col" if share_time else False, width_ratios=ratios)
        yield grid.tolist()
        if share_time:
            for axes in grid[-1]:
                axes.set_xlabel("time since the first command [s]")
        sensors = ", ".join(est.measurements.sensors) or "commands only"
        figure.suptitle(f"{est.run}: {sensors}, {est.mode}, arm {est.config.arm.name}")
        figure.savefig(path, dpi=130)


def _band(axes: Axes, est: Estimates, name: str, centre: FloatArray) -> None:
    half = Z95 * est[name].position_sd
    low, high = (centre - half) * MM, (centre + half) * MM
    axes.fill_between(est.time, low, high, color=colours.ESTIMATE, alpha=0.25, lw=0, label="95 % band")


def _measurements(axes: Axes, est: Estimates, name: str) -> None:
    for sensor, colour in colours.sensor_colours(est.measurements.sensors).items():
        measured = est.measured_positions(sensor, name)
        rejected = measured.outcome == Outcome.REJECTED
        axes.plot(measured.time[~rejected], measured.value[~rejected] * MM, ".", ms=2.5, color=colour, label=sensor)
        if rejected.any():
            time, value = measured.time[rejected], measured.value[rejected] * MM
            axes.plot(time, value, "x", ms=4, color=colours.REJECTED, label=f"{sensor}, rejected")


def _limits(axes: Axes, values: FloatArray) -> None:
    low, high = float(np.min(values)), float(np.max(values))
    margin = 0.1 * (high - low) + 0.5
    axes.set_ylim(low - margin, high + margin)
