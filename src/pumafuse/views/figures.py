"""Figures with matplotlib: the fused run, its error, and the validation of the filter."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ..arrays import NO_STAMP, FloatArray, TimeArray
from ..filter.outcome import Outcome
from ..fusion.consistency import LAGS, Consistency, consistency
from ..fusion.estimates import Estimates
from ..fusion.score import Z95, interpolated
from ..logs.axes import in_axes
from ..logs.frames import CARTESIAN, in_space
from ..logs.run import Run
from ..model.response import response
from ..tuning.latency import Latency
from ..units import MS, SCREEN, seconds
from . import colours
from .canvas import drawing

_ZOOM_S = 2.0  # length of the detail in which the band and single measurements can be seen
_TIME = "time since the first command [s]"


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
    zoomed = (est.time >= start) & (est.time <= end)
    with _figure(est, path, len(est.axes), [_TIME, _TIME], [1.0, 1.0]) as panels:
        for name, whole, zoom in zip(est.axes, panels[::2], panels[1::2], strict=True):
            position, screen = est[name].position, est.config.arm.screen_of(name)
            command = commanded.values[name] * screen.scale
            for axes, shown in ((whole, position), (zoom, position[zoomed])):
                axes.step(time, command, where="post", color=colours.COMMAND, lw=1, label="command")
                _measurements(axes, est, name)
                _band(axes, est, name, position)
                axes.plot(est.time, position * screen.scale, color=colours.ESTIMATE, lw=1.0, label="estimate")
                axes.set_ylabel(f"{name} [{screen.unit}]")
                low, high = float(shown.min()) * screen.scale, float(shown.max()) * screen.scale
                margin = 0.1 * (high - low) + 0.5
                axes.set_ylim(low - margin, high + margin)
            zoom.set_xlim(start, end)
            if est.since is not None or est.until is not None:
                whole.set_xlim(est.time[0], max(est.time[-1], est.time[0] + 1e-3))
        panels[1].legend(loc="best", ncols=2, frameon=False)


def path_figure(est: Estimates, run: Run, path: Path) -> None:
    """Draw where the tool was commanded to be and was, in the log's x, y, z; nothing where it has not all three.

    Args:
        est: The estimates.
        run: The run that they were made from.
        path: Where the picture goes.
    """
    own = {name: axis.position for name, axis in est.axes.items()} if in_space(est.config.arm) == CARTESIAN else {}
    estimated, command = est.cartesian or own, run.command.values
    if not all(name in estimated for name in CARTESIAN):
        return
    with drawing(1, width=8.0, height=7.0, projection="3d") as canvas:
        (axes,) = canvas.axes
        lines = {"command": (command, colours.COMMAND, 1.0), "estimate": (estimated, colours.ESTIMATE, 1.2)}
        for label, (values, colour, width) in lines.items():
            if all(name in values for name in CARTESIAN):
                x, y, z = (values[name] * SCREEN["length"].scale for name in CARTESIAN)
                axes.plot(x, y, z, color=colour, lw=width, label=label)
        axes.set(aspect="equal")
        travel = {name: float(np.ptp(estimated[name])) for name in CARTESIAN}
        for name, far in travel.items():
            axis = getattr(axes, f"{name}axis")
            axis.set_major_locator(MaxNLocator(max(round(8.0 * far / max(*travel.values(), 1e-6)), 1)))
            axis.set_label_text(f"{name} [{SCREEN['length'].unit}]")
            axis.labelpad = 12.0
        axes.legend(loc="upper left", frameon=False)
        canvas.figure.suptitle(f"{est.run}: path, {est.mode}, arm {est.config.arm.name}")
        canvas.figure.savefig(path, dpi=130)


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
    with _figure(est, path, len(errors), [_TIME], [1.0]) as panels:
        for axes, (name, error) in zip(panels, errors.items(), strict=True):
            screen = est.config.arm.screen_of(name)
            for sensor, colour in colours.sensor_colours(est.measurements.sensors).items():
                measured = est.measured_positions(sensor, name)
                first = np.zeros(len(measured.time), dtype=np.int64)  # only the first segment: enough for a picture
                raw = measured.value - interpolated(measured.time, first, est.reference, name)
                label = f"{sensor}, latency removed"
                axes.plot(measured.time, raw * screen.scale, ".", ms=1.5, color=colour, alpha=0.6, label=label)
            _band(axes, est, name, np.zeros(len(est.time)))
            axes.plot(est.time, error * screen.scale, color=colours.REFERENCE, lw=0.8, label="estimate")
            rms = float(np.sqrt(np.nanmean(error**2))) * screen.scale
            axes.set_title(f"{name}: RMS error {rms:.3f} {screen.unit}", loc="left")
            axes.set_ylabel(f"error [{screen.unit}]")
            limit = max(1.3 * float(np.nanmax(np.abs(error))) * screen.scale, 1e-6)
            axes.set_ylim(-limit, limit)
        panels[0].legend(loc="upper right", ncols=3, frameon=False)


def validation_figure(est: Estimates, path: Path) -> None:
    """Draw the innovations of each sensor and axis, three panels a row, with the verdict above them.

    Left: normalised innovations, 95 % of which lie within the band. Middle: their histogram and the normal density
    that they should have. Right: their autocorrelation, which lies within its band if they are white.

    Args:
        est: The estimates.
        path: Where the picture goes.
    """
    by_sensor = colours.sensor_colours(est.measurements.sensors)
    pairs = [(sensor, axis) for axis in est.axes for sensor in by_sensor]
    rows = [(sensor, axis, found) for sensor, axis in pairs if (found := consistency(est, sensor, axis)) is not None]
    if not rows:
        return
    at = np.linspace(-4.5, 4.5, 91)
    labels = ["time [s]", "innovation / sd", "lag [measurements]"]
    with _figure(est, path, len(rows), labels, [3.0, 1.0, 1.0]) as panels:
        for number, (sensor, axis, found) in enumerate(rows):
            series, histogram, correlation = panels[3 * number : 3 * number + 3]
            normalised = innovations(series, est, sensor, axis, by_sensor[sensor])
            series.set_title(f"{axis}, {sensor}. {found.verdict}", loc="left")
            series.set_ylabel("innovation / sd")
            inside = np.clip(normalised, at[0], at[-1])
            histogram.hist(inside, bins=45, range=(at[0], at[-1]), density=True, color=by_sensor[sensor], alpha=0.6)
            histogram.plot(at, np.exp(-0.5 * at**2) / np.sqrt(2.0 * np.pi), color=colours.REFERENCE, lw=1.0)
            histogram.set_ylabel("density")
            correlations(correlation, [found], [by_sensor[sensor]])
            correlation.set_ylabel("autocorrelation")


def lag_figures(found: Latency) -> Markup:
    """A row for each axis: command, measurements and model where most happens, and the lag over the run.

    Args:
        found: How late everything is; the run with the most measurements is drawn.
    """
    summary, arm = found.summary, found.config.arm
    run = max(
        found.runs, key=lambda one: len(one.sensors[summary.sensor].stamp) if summary.sensor in one.sensors else 0
    )
    source, origin = run.sensors[summary.sensor], int(np.min(run.command.stamp[run.command.stamp != NO_STAMP]))
    axes = [axis for axis in summary.axes if axis in source.values and axis in run.axes]
    with drawing(2, len(axes), width=12.0, height=2.6, ratios=[3.0, 1.4]) as canvas:
        for axis, motion, course in zip(axes, canvas.axes[::2], canvas.axes[1::2], strict=True):
            screen, one = SCREEN[run.kinds.get(axis, "length")], summary.axes[axis]
            given, command = _known(run.command.stamp, run.command.values[axis])
            stamp, value = _known(source.stamp, source.values[axis])
            fine, model, start = np.union1d(given, stamp), arm.axes[axis], float(command[0])
            moved = start + response(model, arm.update_period, arm.delay_of(axis), given, command, start, fine)
            scale = found.config.sensors[summary.sensor].scale
            apart = value - scale * moved[np.searchsorted(fine, stamp)]
            value = (value - float(np.median(apart))) / scale
            begin = _busiest(seconds(given, origin), command, max(_ZOOM_S, 8.0 * one.lag))
            end = begin + max(_ZOOM_S, 8.0 * one.lag)
            time = seconds(given, origin)
            motion.step(time, command * screen.scale, where="post", color=colours.COMMAND, lw=1, label="command")
            motion.plot(
                seconds(stamp, origin),
                value * screen.scale,
                ".",
                ms=4,
                color=_measured(summary.sensor),
                label=summary.sensor,
            )
            motion.plot(seconds(fine, origin), moved * screen.scale, color=colours.ESTIMATE, lw=1.2, label="model")
            shown = command[(time >= begin - 1.0) & (time <= end)] * screen.scale
            margin = 0.08 * float(np.ptp(shown)) + 1e-3
            motion.set(xlim=(begin, end), ylim=(float(shown.min()) - margin, float(shown.max()) + margin))
            motion.set_title(f"{axis}: {one.lag * MS:.1f} ms late", loc="left")
            motion.set_ylabel(f"{axis} [{screen.unit}]")
            if one.course:
                t, shift, sd = np.array([(part.time, part.shift, part.sd) for part in one.course]).T
                course.errorbar(t, (one.lag + shift) * MS, Z95 * sd * MS, fmt="o", ms=3, color=colours.ESTIMATE, lw=1)
                course.axhspan(*(end * MS for end in one.lag_ci95), color=colours.ESTIMATE, alpha=0.2, lw=0)
            course.set_ylabel("lag [ms]")
        for column in canvas.axes[-2:]:
            column.set_xlabel(_TIME)
        canvas.axes[0].legend(loc="best", ncols=3, frameon=False)
        return canvas.svg()


def _measured(sensor: str) -> str:
    return colours.REFERENCE if sensor == "reference" else colours.sensor_colours([sensor])[sensor]


def _known(stamp: TimeArray, value: FloatArray) -> tuple[TimeArray, FloatArray]:
    """Stamps and values of the rows that have both, in order, one a stamp."""
    there = (stamp != NO_STAMP) & np.isfinite(value)
    time, place = np.unique(stamp[there], return_index=True)
    return time, value[there][place]


def _busiest(time: FloatArray, value: FloatArray, length: float) -> float:
    """Where the part of a length [s] begins in which a command moves most."""
    travel = np.append(0.0, np.cumsum(np.abs(np.diff(value))))
    return float(time[int(np.argmax(np.interp(time + length, time, travel) - travel))])


def innovations(axes: Axes, est: Estimates, sensor: str, axis: str, colour: str) -> FloatArray:
    """Draw a sensor's innovations on an axis over their sd, those that were fused; the values."""
    measurements = est.measurements.of(sensor, axis)
    fused = measurements.where(measurements.outcome == Outcome.FUSED)
    normalised = fused.innovation / fused.innovation_sd
    axes.plot(fused.time, normalised, ".", ms=1.5, color=colour, rasterized=True)
    axes.axhspan(-Z95, Z95, color=colours.ESTIMATE, alpha=0.15, lw=0)
    return normalised


def correlations(axes: Axes, tests: Sequence[Consistency | None], by_test: Sequence[str]) -> None:
    """Draw autocorrelations side by side in their colours, with the narrowest of their bands."""
    highest, band, width = 0.12, 1.0, 0.8 / len(tests)
    for number, (found, colour) in enumerate(zip(tests, by_test, strict=True)):
        if found is not None:
            lags = np.arange(1, len(found.correlation) + 1) + width * (number - 0.5 * (len(tests) - 1))
            axes.bar(lags, found.correlation, color=colour, width=width)
            highest = max(highest, 1.1 * float(np.abs(found.correlation).max(initial=0.0)))
            band = min(band, found.correlation_band)
    axes.axhspan(-band, band, color=colours.ESTIMATE, alpha=0.2, lw=0)
    axes.set_xlim(0, LAGS + 1)
    axes.set_ylim(-highest, highest)


@contextmanager
def _figure(
    est: Estimates, path: Path, rows: int, labels: Sequence[str], ratios: Sequence[float]
) -> Generator[list[Axes]]:
    """Axes row by row, a column for each label below; written to ``path`` on leaving the block."""
    with drawing(len(labels), rows, width=13.0, height=2.4 + 0.8 / rows, ratios=ratios, sharex="col") as canvas:
        yield canvas.axes
        for axes, label in zip(canvas.axes[-len(labels) :], labels, strict=True):
            axes.set_xlabel(label)
        sensors = ", ".join(est.measurements.sensors) or "commands only"
        canvas.figure.suptitle(f"{est.run}: {sensors}, {est.mode}, arm {est.config.arm.name}")
        canvas.figure.savefig(path, dpi=130)


def _band(axes: Axes, est: Estimates, name: str, centre: FloatArray) -> None:
    half, scale = Z95 * est[name].position_sd, est.config.arm.screen_of(name).scale
    low, high = (centre - half) * scale, (centre + half) * scale
    axes.fill_between(est.time, low, high, color=colours.ESTIMATE, alpha=0.25, lw=0, label="95 % band")


def _measurements(axes: Axes, est: Estimates, name: str) -> None:
    scale = est.config.arm.screen_of(name).scale
    for sensor, colour in colours.sensor_colours(est.measurements.sensors).items():
        measured = est.measured_positions(sensor, name)
        rejected = measured.outcome == Outcome.REJECTED
        axes.plot(measured.time[~rejected], measured.value[~rejected] * scale, ".", ms=2.5, color=colour, label=sensor)
        if rejected.any():
            time, value = measured.time[rejected], measured.value[rejected] * scale
            axes.plot(time, value, "x", ms=4, color=colours.REJECTED, label=f"{sensor}, rejected")
