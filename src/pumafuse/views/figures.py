"""Figures with matplotlib: the fused run, its error, and the validation of the filter."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..arrays import NO_STAMP, FloatArray, known_rows
from ..filter.outcome import Outcome
from ..filter.response import response
from ..fusion.consistency import LAGS, Consistency, consistency
from ..fusion.estimates import Estimates, Measurements, busiest
from ..fusion.results import Result
from ..fusion.score import Z95, ReferenceTrack, interpolate, score
from ..fusion.verdicts import sentence
from ..logs.frames import CARTESIAN, in_space
from ..logs.run import Run
from ..tuning.latency import Latency
from ..units import MS, SCREEN, seconds
from . import colours
from .canvas import draw_legend, drawing, svg

_ZOOM_S = 2.0  # length of the detail in which the band and single measurements can be seen
_NEARLY_ALL, _LEAST = 0.99, 1e-9  # of what is drawn; m or rad
_TIME = "time since the first command [s]"


def fused_figure(est: Estimates) -> Figure:
    """Draw the fused run: each axis as a whole and its busiest two seconds, and below what each measurement leaves.

    Left the whole run, right the busiest part of it. Above positions with the 95 % band; below measurement − estimate
    on the same times, with the band of the estimate and the spread that each sensor's sd claims.

    Args:
        est: The estimates.
    """
    start, end = est.busiest(_ZOOM_S)
    zoomed = (est.time >= start) & (est.time <= end)
    with _figure(est, 2 * len(est.axes), [_TIME, _TIME], [1.0, 1.0]) as figure:
        for number, name in enumerate(est.axes):
            whole, zoom, left, left_zoom = figure.axes[4 * number : 4 * number + 4]
            position, screen = est[name].position, est.config.arm.screen_of(name)
            for axes, shown in ((whole, position), (zoom, position[zoomed])):
                _draw_commands(axes, est, name)
                _draw_measurements(axes, est, name)
                _draw_band(axes, est, name, position)
                axes.plot(est.time, position * screen.scale, color=colours.ESTIMATE, lw=1.0, label="estimate")
                _draw_reference(axes, est.reference, name, screen.scale)
                axes.set(ylabel=f"{name} [{screen.unit}]", ylim=_span(shown * screen.scale))
            for axes in (left, left_zoom):
                _draw_residuals(axes, est, name)
                axes.set_ylabel(f"{name}: measured\n− estimate [{screen.unit}]")
            for axes in (zoom, left_zoom):
                axes.set_xlim(start, end)
            if est.since is not None or est.until is not None:
                for axes in (whole, left):
                    axes.set_xlim(est.time[0], max(est.time[-1], est.time[0] + 1e-3))
        draw_legend(figure)
    return figure


def comparison_figure(results: Mapping[str, Result], reference: ReferenceTrack | None, why: str) -> Figure:
    """Draw results on top of each other, and below their errors, or without a reference how they differ.

    Left the whole run, right the busiest two seconds of the first result; differences are from the first result.
    """
    first = next(iter(results.values()))
    colour = dict(zip(results, colours.several(len(results)), strict=True))
    positions = {name: result.positions(first.config) for name, result in results.items()}
    start, end = busiest(first.time, first.positions(first.config), _ZOOM_S)
    zoomed = (first.time >= start) & (first.time <= end)
    with drawing(2, 2 * len(first.axes), width=13.0, height=2.4, sharex="col") as figure:
        for number, axis in enumerate(first.axes):
            screen = first.config.arm.screen_of(axis)
            of_axis = {name: position[axis] for name, position in positions.items() if axis in position}
            whole, zoom, left, left_zoom = figure.axes[4 * number : 4 * number + 4]
            for axes in (whole, zoom):
                for name, position in of_axis.items():
                    axes.plot(results[name].time, position * screen.scale, lw=1.0, color=colour[name], label=name)
                _draw_reference(axes, reference, axis, screen.scale)
                axes.set_ylabel(f"{axis} [{screen.unit}]")
            what, shown = "difference", [np.zeros(1)]
            for name, position in of_axis.items():
                result = results[name]
                if reference is None and result is first:
                    continue
                if reference is not None and axis in reference.position:
                    what, apart = "error", interpolate(result.time, result.segment, reference, axis)
                else:
                    apart = np.interp(result.time, first.time, first.axes[axis].position)
                shown.append(position - apart)
                for axes in (left, left_zoom):
                    axes.plot(result.time, shown[-1] * screen.scale, lw=0.8, color=colour[name])
            limit = _reach(np.concatenate(shown)) * screen.scale
            for axes in (left, left_zoom):
                axes.set(ylim=(-limit, limit), ylabel=f"{axis}: {what} [{screen.unit}]")
            for axes in (zoom, left_zoom):
                axes.set_xlim(start, end)
            zoom.set_ylim(_span(first.axes[axis].position[zoomed] * screen.scale))
        for axes in figure.axes[-2:]:
            axes.set_xlabel(_TIME)
        draw_legend(figure)
        figure.suptitle(why)
    return figure


def path_figure(est: Estimates, run: Run) -> Figure | None:
    """Draw where the tool was commanded to be and was, in the log's x, y, z; None where it has not all three."""
    positions = est.positions if in_space(est.config.arm) == CARTESIAN else {}
    estimated, command = est.cartesian or positions, run.command.values
    if not all(name in estimated for name in CARTESIAN):
        return None
    with drawing(1, width=8.0, height=7.0, projection="3d") as figure:
        (axes,) = figure.axes
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
        figure.suptitle(f"{est.run}: path, {est.mode}, arm {est.config.arm.name}")
    return figure


def error_figure(est: Estimates) -> Figure | None:
    """Draw the error against the reference with its 95 % band, over the errors of the measurements.

    Above each axis its root mean square, and how many of the errors the band holds. None where no estimate has a
    reference near enough.

    Args:
        est: Estimates of a run that has a reference.

    Raises:
        ValueError: The run has no reference.
    """
    if est.reference is None:
        raise ValueError("the run has no reference")
    scores = {
        name: score(est.time, est.segment, axis.position, axis.position_sd, est.reference, name)
        for name, axis in est.axes.items()
    }
    scored = {name: score for name, score in scores.items() if score is not None}
    if not scored:
        return None
    with _figure(est, len(scored), [_TIME], [1.0]) as figure:
        for axes, (name, scored_axis) in zip(figure.axes, scored.items(), strict=True):
            screen = est.config.arm.screen_of(name)
            error = est[name].position - interpolate(est.time, est.segment, est.reference, name)
            for sensor, colour in colours.sensor_colours(est.measurements.sensors).items():
                measured = est.measured_positions(sensor, name)
                raw = measured.value - interpolate(measured.time, measured.segment, est.reference, name)
                label = f"{sensor}, latency removed"
                axes.plot(measured.time, raw * screen.scale, ".", ms=1.5, color=colour, alpha=0.6, label=label)
            _draw_band(axes, est, name, np.zeros(len(est.time)))
            axes.plot(est.time, error * screen.scale, color=colours.REFERENCE, lw=0.8, label="estimate")
            axes.set_title(
                f"{name}: RMS error {scored_axis.rmse * screen.scale:.3f} {screen.unit}; the 95 % band holds"
                f" {scored_axis.coverage:.1%} of {scored_axis.rows} errors",
                loc="left",
            )
            axes.set_ylabel(f"error [{screen.unit}]")
            limit = _reach(np.concatenate([error, Z95 * est[name].position_sd])) * screen.scale
            axes.set_ylim(-limit, limit)
        draw_legend(figure)
    return figure


def validation_figure(est: Estimates) -> Figure | None:
    """Draw the innovations of each sensor and axis, three panels a row, with the verdict above them.

    Left: normalised innovations, 95 % of which lie within the band. Middle: their histogram and the normal density
    that they should have. Right: their autocorrelation, which lies within its band if they are white. None where
    nothing was fused.

    Args:
        est: The estimates.
    """
    by_sensor = colours.sensor_colours(est.measurements.sensors)
    pairs = [(sensor, axis) for axis in est.axes for sensor in by_sensor]
    rows = [
        (sensor, axis, checked) for sensor, axis in pairs if (checked := consistency(est, sensor, axis)) is not None
    ]
    if not rows:
        return None
    at = np.linspace(-4.5, 4.5, 91)
    labels = ["time [s]", "innovation / sd", "lag [measurements]"]
    with _figure(est, len(rows), labels, [3.0, 1.0, 1.0]) as figure:
        for number, (sensor, axis, checked) in enumerate(rows):
            series, histogram, correlation = figure.axes[3 * number : 3 * number + 3]
            normalised = draw_innovations(series, est, sensor, axis, by_sensor[sensor])
            series.set_title(f"{axis}, {sensor}. {sentence(checked)}", loc="left")
            series.set_ylabel("innovation / sd")
            inside = np.clip(normalised, at[0], at[-1])
            histogram.hist(inside, bins=45, range=(at[0], at[-1]), density=True, color=by_sensor[sensor], alpha=0.6)
            histogram.plot(at, np.exp(-0.5 * at**2) / np.sqrt(2.0 * np.pi), color=colours.REFERENCE, lw=1.0)
            histogram.set_ylabel("density")
            draw_correlations(correlation, [checked], [by_sensor[sensor]])
            correlation.set_ylabel("autocorrelation")
    return figure


def lag_figures(latency: Latency) -> Markup:
    """A row for each axis: command, measurements and model where most happens, and the lag over the run."""
    summary, arm = latency.details, latency.config.arm
    run = max(
        latency.runs, key=lambda run: len(run.sensors[summary.sensor].stamp) if summary.sensor in run.sensors else 0
    )
    source, origin = run.sensors[summary.sensor], int(np.min(run.command.stamp[run.command.stamp != NO_STAMP]))
    axes = [axis for axis in summary.axes if axis in source.values and axis in run.axes]
    of_reference = summary.sensor == "reference"
    colour = colours.REFERENCE if of_reference else colours.sensor_colours([summary.sensor])[summary.sensor]
    with drawing(2, len(axes), width=12.0, height=2.6, ratios=[3.0, 1.4]) as figure:
        for axis, motion, course in zip(axes, figure.axes[::2], figure.axes[1::2], strict=True):
            screen, lag = SCREEN[run.kinds.get(axis, "length")], summary.axes[axis]
            commanded_at, command = known_rows(run.command.stamp, run.command.values[axis])
            stamp, value = known_rows(source.stamp, source.values[axis])
            fine, model, start = np.union1d(commanded_at, stamp), arm.axes[axis], float(command[0])
            moved = start + response(model, arm.update_period, arm.delay_of(axis), commanded_at, command, start, fine)
            scale = latency.config.sensors[summary.sensor].scale
            apart = value - scale * moved[np.searchsorted(fine, stamp)]
            value = (value - float(np.median(apart))) / scale
            time, seen, length = seconds(commanded_at, origin), seconds(stamp, origin), max(_ZOOM_S, 8.0 * lag.lag)
            begin, end = busiest(time, {axis: command}, length)
            motion.step(time, command * screen.scale, where="post", color=colours.COMMAND, lw=1, label="command")
            motion.plot(seen, value * screen.scale, ".", ms=4, color=colour, label=summary.sensor)
            motion.plot(seconds(fine, origin), moved * screen.scale, color=colours.ESTIMATE, lw=1.2, label="model")
            shown = command[(time >= begin - 1.0) & (time <= end)] * screen.scale
            margin = 0.08 * float(np.ptp(shown)) + 1e-3
            motion.set(xlim=(begin, end), ylim=(float(shown.min()) - margin, float(shown.max()) + margin))
            motion.set_title(f"{axis}: {lag.lag * MS:.1f} ms late", loc="left")
            motion.set_ylabel(f"{axis} [{screen.unit}]")
            if lag.course:
                t, shift, sd = np.array([(part.time, part.shift, part.sd) for part in lag.course]).T
                course.errorbar(t, (lag.lag + shift) * MS, Z95 * sd * MS, fmt="o", ms=3, color=colours.ESTIMATE, lw=1)
                course.axhspan(*(end * MS for end in lag.lag_ci95), color=colours.ESTIMATE, alpha=0.2, lw=0)
            course.set_ylabel("lag [ms]")
        for column in figure.axes[-2:]:
            column.set_xlabel(_TIME)
        figure.axes[0].legend(loc="best", ncols=3, frameon=False)
        return svg(figure)


def draw_innovations(axes: Axes, est: Estimates, sensor: str, axis: str, colour: str) -> FloatArray:
    """Draw a sensor's innovations on an axis over their sd, those that were fused; the values."""
    measurements = est.measurements.of(sensor, axis)
    fused = measurements.where(measurements.outcome == Outcome.FUSED)
    normalised = fused.innovation / fused.innovation_sd
    axes.plot(fused.time, normalised, ".", ms=1.5, color=colour, rasterized=True)
    axes.axhspan(-Z95, Z95, color=colours.ESTIMATE, alpha=0.15, lw=0)
    return normalised


def draw_correlations(axes: Axes, tests: Sequence[Consistency | None], by_test: Sequence[str]) -> None:
    """Draw autocorrelations side by side in their colours, with the narrowest of their bands."""
    highest, band, width = 0.12, 1.0, 0.8 / len(tests)
    for number, (check, colour) in enumerate(zip(tests, by_test, strict=True)):
        if check is not None:
            lags = np.arange(1, len(check.correlation) + 1) + width * (number - 0.5 * (len(tests) - 1))
            axes.bar(lags, check.correlation, color=colour, width=width)
            highest = max(highest, 1.1 * float(np.abs(check.correlation).max(initial=0.0)))
            band = min(band, check.correlation_band)
    axes.axhspan(-band, band, color=colours.ESTIMATE, alpha=0.2, lw=0)
    axes.set(xlim=(0, LAGS + 1), ylim=(-highest, highest))


@contextmanager
def _figure(est: Estimates, rows: int, labels: Sequence[str], ratios: Sequence[float]) -> Generator[Figure]:
    """A figure with a column for each label below, and above it what is drawn."""
    with drawing(len(labels), rows, width=13.0, height=2.4 + 0.8 / rows, ratios=ratios, sharex="col") as figure:
        yield figure
        for axes, label in zip(figure.axes[-len(labels) :], labels, strict=True):
            axes.set_xlabel(label)
        used = [name for name in est.measurements.sensors if name in est.config.sensors]
        sensors = ", ".join(used) or "commands only"
        figure.suptitle(f"{est.run}: {sensors}, {est.mode}, arm {est.config.arm.name}")


def _span(values: FloatArray) -> tuple[float, float]:
    """Limits of an axis that shows all values."""
    margin = 0.1 * float(np.ptp(values)) + 0.5
    return float(values.min()) - margin, float(values.max()) + margin


def _reach(values: FloatArray) -> float:
    """How far an axis has to reach for nearly all of the values: a few at the start would flatten the others."""
    distances = np.abs(values[np.isfinite(values)])
    if not len(distances):
        return _LEAST
    most, usual = np.quantile(distances, [_NEARLY_ALL, 0.75]).tolist()
    return max(min(1.4 * most, 6.0 * usual) if usual > 0.0 else 1.4 * most, _LEAST)


def _draw_commands(axes: Axes, est: Estimates, name: str) -> None:
    commands = [
        (seconds(time, est.origin), value) for time, value in (segment.commands_of(name) for segment in est.segments)
    ]
    time, value = (np.concatenate(part) for part in zip(*commands, strict=True))
    scale = est.config.arm.screen_of(name).scale
    axes.step(time, value * scale, where="post", color=colours.COMMAND, lw=1, label="command")


def _draw_reference(axes: Axes, reference: ReferenceTrack | None, name: str, scale: float) -> None:
    if reference is not None and name in reference.position:
        value = reference.position[name] * scale
        axes.plot(reference.time, value, color=colours.REFERENCE, lw=0.8, ls="--", label="reference")


def _draw_band(axes: Axes, est: Estimates, name: str, centre: FloatArray) -> None:
    half, scale = Z95 * est[name].position_sd, est.config.arm.screen_of(name).scale
    low, high = (centre - half) * scale, (centre + half) * scale
    axes.fill_between(est.time, low, high, color=colours.ESTIMATE, alpha=0.25, lw=0, label="95 % band")


def _draw_measurements(axes: Axes, est: Estimates, name: str) -> None:
    """Measurements; a cross where the axis itself was beyond the gate, pale where another one of its row was."""
    scale = est.config.arm.screen_of(name).scale
    for sensor, colour in colours.sensor_colours(est.measurements.sensors).items():
        _draw_dots(axes, est, sensor, est.measured_positions(sensor, name), scale, colour)


def _draw_residuals(axes: Axes, est: Estimates, name: str) -> None:
    """Measurement − estimate, the band of the estimate, and what each sensor's sd claims."""
    scale, shown = est.config.arm.screen_of(name).scale, [Z95 * est[name].position_sd]
    _draw_band(axes, est, name, np.zeros(len(est.time)))
    for sensor, colour in colours.sensor_colours(est.measurements.sensors).items():
        measured = est.measured_positions(sensor, name)
        left = measured.value.copy()
        for number in np.unique(measured.segment).tolist():
            rows, here = measured.segment == number, est.segment == number
            estimates = est.time[here], est[name].position[here]
            left[rows] -= np.interp(measured.time[rows], *estimates, left=np.nan, right=np.nan)
        _draw_dots(axes, est, sensor, replace(measured, value=left), scale, colour)
        shown.append(left[measured.outcome != Outcome.REJECTED])
        if sensor in est.config.sensors and (sd := est.config.sensors[sensor].sd_of(name)) is not None:
            for sign in (-1.0, 1.0):
                spread = sign * Z95 * sd / abs(est.config.sensors[sensor].scale)
                axes.axhline(spread * scale, color=colour, lw=0.8, ls=":")
    limit = _reach(np.concatenate(shown)) * scale
    axes.set_ylim(-limit, limit)


def _draw_dots(axes: Axes, est: Estimates, sensor: str, measured: Measurements, scale: float, colour: str) -> None:
    rejected = measured.outcome == Outcome.REJECTED
    gate = est.config.sensors[sensor].gate if sensor in est.config.sensors else 0.0
    itself = rejected & (np.abs(measured.innovation) > gate * measured.innovation_sd)
    time, value = measured.time, measured.value * scale
    axes.plot(time[~rejected], value[~rejected], ".", ms=2.5, color=colour, label=sensor)
    if itself.any():
        axes.plot(time[itself], value[itself], "x", ms=4, color=colours.REJECTED, label=f"{sensor}, rejected")
    if (others := rejected & ~itself).any():
        axes.plot(time[others], value[others], "x", ms=3, color=colour, alpha=0.5, label=f"{sensor}, with its row")
