"""Figures with matplotlib: the fused run, its error, and whether the filter is as good as it says."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..arrays import FloatArray
from ..fusion.consistency import LAGS, consistency
from ..fusion.estimates import Estimates
from ..filter.outcome import Outcome
from ..fusion.score import Z95, interpolated
from ..logs.axes import in_axes
from ..logs.run import Run
from ..units import MM, seconds
from . import style

_ZOOM_S = 2.0  # of the busiest stretch, where the band and the single measurements can be seen


def fused_figure(est: Estimates, run: Run, path: Path) -> None:
    """The fused run: per axis all of it, and beside it its busiest two seconds with measurements and 95 % band.

    Args:
        est: The estimates.
        run: The run that they were made from.
        path: Where the picture goes; its ending says which format.
    """
    commanded = in_axes(run, est.config.frame)[0].command
    time = seconds(commanded.stamp, est.origin)
    start, end = style.busiest(est, _ZOOM_S)
    with _sheet(est, path, len(est.axes), 2) as grid:
        for (whole, zoom), name in zip(grid, est.axes, strict=True):
            for axes in (whole, zoom):
                axes.step(time, commanded.values[name] * MM, where="post", color=style.COMMAND, lw=1.0, label="command")
                _scatter(axes, est, name)
                _band(axes, est, name, est[name].position)
                axes.plot(est.time, est[name].position * MM, color=style.ESTIMATE, lw=1.0, label="estimate")
                axes.set_ylabel(f"{name} [mm]")
            _limits(whole, est[name].position * MM)
            zoom.set_xlim(start, end)
            _limits(zoom, est[name].position[(est.time >= start) & (est.time <= end)] * MM)
        grid[0][1].legend(loc="best", ncols=2, frameon=False)


def error_figure(est: Estimates, path: Path) -> None:
    """The estimate's error against the reference with its 95 % band, over the measurements' own errors.

    Args:
        est: Estimates of a run that has a reference.
        path: Where the picture goes.
    """
    if est.reference is None:
        raise ValueError("the run has no reference")
    truth = {
        name: interpolated(est.time, est.segment, est.reference, name)
        for name in est.axes
        if name in est.reference.position
    }
    known = [name for name, values in truth.items() if np.isfinite(values).any()]
    if not known:
        return
    with _sheet(est, path, len(known), 1) as grid:
        for (axes,), name in zip(grid, known, strict=True):
            error = est[name].position - truth[name]
            for sensor, colour in style.sensor_colours(est.measurements.sensors).items():
                components = style.positions(est, sensor, name)
                first = np.zeros(len(components.time), dtype=np.int64)  # the first segment's will do for a picture
                raw = components.value - interpolated(components.time, first, est.reference, name)
                label = f"{sensor}, latency removed"
                axes.plot(components.time, raw * MM, ".", ms=1.5, color=colour, alpha=0.6, label=label)
            _band(axes, est, name, np.zeros(len(est.time)))
            axes.plot(est.time, error * MM, color=style.REFERENCE, lw=0.8, label="estimate")
            rms = float(np.sqrt(np.nanmean(error**2))) * MM
            axes.set_title(f"{name}: RMS error {rms:.3f} mm", loc="left", fontsize=9)
            axes.set_ylabel("error [mm]")
            limit = max(1.3 * float(np.nanmax(np.abs(error))) * MM, 1e-6)
            axes.set_ylim(-limit, limit)
        grid[0][0].legend(loc="upper right", ncols=3, frameon=False)


def validation_figure(est: Estimates, path: Path) -> None:
    """Is the filter as good as it says? For each sensor and axis three panels, and the verdict above them.

    Left: normalised innovations, 95 % of which lie within the band. Middle: their spread against the normal curve they
    should follow. Right: their autocorrelation, within the band if each is news.

    Args:
        est: The estimates.
        path: Where the picture goes.
    """
    pairs = [(sensor, axis) for axis in est.axes for sensor in est.measurements.sensors]
    met = [(sensor, axis, found) for sensor, axis in pairs if (found := consistency(est, sensor, axis)) is not None]
    if not met:
        return
    colours = style.sensor_colours(est.measurements.sensors)
    with _sheet(est, path, len(met), 3, share_time=False) as grid:
        for (series, spread, correlation), (sensor, axis, found) in zip(grid, met, strict=True):
            measurements = est.measurements.of(sensor, axis)
            fused = measurements.where(measurements.outcome == Outcome.FUSED)
            normalised = fused.innovation / fused.innovation_sd
            series.plot(fused.time, normalised, ".", ms=1.5, color=colours[sensor])
            series.axhspan(-Z95, Z95, color=style.ESTIMATE, alpha=0.15, lw=0)
            series.set_title(f"{axis}, {sensor}. {found.verdict}", loc="left", fontsize=9)
            series.set_ylabel("innovation / sd")
            spread.set_ylabel("density")
            correlation.set_ylabel("autocorrelation")
            at = np.linspace(-4.5, 4.5, 91)
            spread.hist(
                np.clip(normalised, -4.5, 4.5),
                bins=45,
                range=(-4.5, 4.5),
                density=True,
                color=colours[sensor],
                alpha=0.6,
            )
            spread.plot(at, np.exp(-0.5 * at**2) / np.sqrt(2.0 * np.pi), color=style.REFERENCE, lw=1.0)
            lags = np.arange(1, len(found.correlation) + 1)
            correlation.bar(lags, found.correlation, color=colours[sensor], width=0.6)
            correlation.axhspan(-found.correlation_band, found.correlation_band, color=style.ESTIMATE, alpha=0.2, lw=0)
            correlation.set_ylim(min(-0.3, 1.1 * float(found.correlation.min(initial=0.0))), 1.0)
            correlation.set_xlim(0, LAGS + 1)
        for axes, label in zip(grid[-1], ("time [s]", "innovation / sd", "lag [measurements]"), strict=True):
            axes.set_xlabel(label)


@contextmanager
def _sheet(
    est: Estimates, path: Path, rows: int, columns: int, *, share_time: bool = True
) -> Generator[list[list[Axes]]]:
    """A sheet of axes that is written to ``path`` when done."""
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
    axes.fill_between(est.time, low, high, color=style.ESTIMATE, alpha=0.25, lw=0, label="95 % band")


def _scatter(axes: Axes, est: Estimates, name: str) -> None:
    for sensor, colour in style.sensor_colours(est.measurements.sensors).items():
        components = style.positions(est, sensor, name)
        fused = components.where(components.outcome != Outcome.REJECTED)
        rejected = components.where(components.outcome == Outcome.REJECTED)
        axes.plot(fused.time, fused.value * MM, ".", ms=2.5, color=colour, label=sensor)
        if len(rejected.time):
            axes.plot(rejected.time, rejected.value * MM, "x", ms=4, color=style.REJECTED, label=f"{sensor}, rejected")


def _limits(axes: Axes, values: FloatArray) -> None:
    low, high = float(np.min(values)), float(np.max(values))
    margin = 0.1 * (high - low) + 0.5
    axes.set_ylim(low - margin, high + margin)
