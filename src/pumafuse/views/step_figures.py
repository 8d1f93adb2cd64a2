"""Figures of an identification and of its verification, as SVG text for a page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FormatStrFormatter, MaxNLocator, NullLocator

from ..identification.anova import Level, factors_of, levels_of, numbers
from ..identification.batch import Batch
from ..identification.identify import Identification, TrialResult
from ..identification.trials import StepTrials, Trial
from ..identification.verify import AxisVerification, Trace
from ..units import MM, MS, SCREEN
from . import colours
from .canvas import drawing, svg

_SECONDS = 1.2  # of a white-noise run that is shown in detail
_GRID = 40  # points each way of a contour plot
_SPREAD = 4.0  # factor by which it reaches above and below ω and ζ


def responses(identification: Identification, trials: StepTrials) -> str:
    """Every trial over its own gain, from its own delay on, beside the combined plant."""
    measured = {trial.name: trial.cut(identification.samples) for trial in trials.trials}

    def draw(axes: Axes, axis: str) -> None:
        plant, longest = identification.axes[axis].model.plant, 0.0
        for trial in identification.trials:
            if trial.axis != axis or trial.common_delay is None or not trial.common_gain:
                continue
            t, height = measured[trial.trial].time - trial.common_delay, trial.common_gain * trial.step
            position = measured[trial.trial].position
            zero = float(np.mean(position - height * plant.step_response(t)))
            axes.plot(t * MS, (position - zero) / height, color=colours.BAND, lw=0.6, alpha=0.7)
            longest = max(longest, float(t[-1]))
        t = np.linspace(-0.02, longest, 400)
        axes.plot(t * MS, plant.step_response(t), color=colours.REFERENCE, lw=1.4)
        axes.set_ylim(-0.15, 1.3)

    return _panels(identification.axes, draw, "share of the final value", "time since the trial's own delay [ms]")


def delays(identification: Identification) -> str:
    """Td of each trial in the order of the campaign."""

    def draw(axes: Axes, axis: str) -> None:
        values = [
            trial.common_delay
            for trial in identification.trials
            if trial.axis == axis and trial.common_delay is not None
        ]
        axes.plot(np.arange(1, len(values) + 1), np.array(values) * MS, ".", color=colours.ESTIMATE, ms=4)
        fitted = identification.axes[axis].delays.fitted
        axes.axhline(fitted.value * MS, color=colours.REFERENCE, lw=1.0)
        axes.axhspan(fitted.ci95[0] * MS, fitted.ci95[1] * MS, color=colours.ESTIMATE, alpha=0.2, lw=0)

    return _panels(identification.axes, draw, "delay [ms]", "trial, in the order of the list")


def gains(identification: Identification) -> str:
    """K of each trial against speed, with the line."""
    screen = SCREEN[identification.kind]

    def draw(axes: Axes, axis: str) -> None:
        used = [trial for trial in identification.trials if trial.axis == axis and trial.common_gain is not None]
        speed = np.array([trial.speed for trial in used])
        gain = [trial.common_gain or np.nan for trial in used]
        axes.plot(speed * screen.fast_scale, gain, ".", color=colours.ESTIMATE, ms=4)
        at = np.linspace(0.0, 1.05 * float(speed.max()), 50)
        axes.plot(at * screen.fast_scale, identification.axes[axis].model.gain.at(at), color=colours.REFERENCE, lw=1.0)

    return _panels(identification.axes, draw, "gain K", f"speed [{screen.fast}]")


def histograms(identification: Identification) -> str:
    """Delay, gain and τ of first-order fits (the paper's Fig. 5)."""
    used = [trial.first for trial in identification.trials if trial.left_out is None]
    columns = {
        "delay [ms]": [fit.delay * MS for fit in used],
        "gain": [fit.gain for fit in used],
        "time constant [ms]": [(fit.time_constant or 0.0) * MS for fit in used],
    }

    def draw(axes: Axes, name: str) -> None:
        axes.hist(columns[name], bins="auto", color=colours.BAND, edgecolor="white")
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))

    return _panels(columns, draw, "trials")


def fits_by_factor(identification: Identification, trials: StepTrials) -> str:
    """RMS of both orders by each factor, with two standard deviations (the paper's Fig. 6); empty without factors."""
    used = [trial for trial in identification.trials if trial.left_out is None]
    names = {trial.trial for trial in used}
    period, screen = identification.arm.update_period, SCREEN[identification.kind]
    factors = factors_of([trial for trial in trials.trials if trial.name in names], period, identification.kind)
    orders = {
        "first order": (np.array([trial.first.rms for trial in used]) * screen.scale, colours.COMMAND, -0.15),
        "second order": (np.array([trial.second.rms for trial in used]) * screen.scale, colours.ESTIMATE, 0.15),
    }

    def draw(axes: Axes, factor: str) -> None:
        for order, (rms, colour, offset) in orders.items():
            _draw_levels(axes, levels_of(rms, factors[factor]), colour, order, offset)
        axes.set_ylim(bottom=0.0)
        if factor == next(iter(factors)):
            axes.legend(frameon=False)

    return _panels(factors, draw, f"RMS of each trial's own fit [{screen.unit}]")


def performance(identification: Identification) -> str:
    """RMS of the combined model by each factor (the paper's Fig. 7); empty without factors."""
    levels, screen = (
        {performance.factor: performance.levels for performance in identification.performance},
        SCREEN[identification.kind],
    )
    tolerance = identification.tolerance * screen.scale

    def draw(axes: Axes, factor: str) -> None:
        _draw_levels(axes, levels[factor], colours.ESTIMATE, "combined model", 0.0)
        top = max(level.mean + 2.0 * (level.sd or 0.0) for level in levels[factor])
        if tolerance < 3.0 * top:
            axes.axhline(tolerance, color=colours.REJECTED, lw=0.8, ls="--")
        axes.set_ylim(bottom=0.0)

    return _panels(levels, draw, f"RMS of the combined model [{screen.unit}]")


def valleys(identification: Identification, trials: StepTrials) -> tuple[str, list[str]]:
    """RMS over ω and ζ of one trial of each axis (the paper's Fig. 4), and which trials those are.

    The trial is the one whose ω is known worst, so that a long flat valley shows where there is any.
    """
    measured = {trial.name: trial.cut(identification.samples) for trial in trials.trials}

    def width(trial: TrialResult) -> float:
        low, high = trial.second.natural_frequency_ci95 or (1.0, np.inf)
        return high / max(low, 1e-9)

    every = [trial for trial in identification.trials if trial.left_out is None]
    chosen = [max((trial for trial in every if trial.axis == axis), key=width) for axis in identification.axes]
    named = {f"{trial.axis}, trial {trial.trial}": trial for trial in chosen}

    def draw(axes: Axes, name: str) -> None:
        _draw_valley(axes, named[name], measured[named[name].trial])

    return _panels(named, draw, "damping ζ", "natural frequency ω [rad/s]"), [trial.trial for trial in chosen]


def verification(verified: AxisVerification, trace: Trace) -> str:
    """Measured and modelled position, without means: the first second in detail (the paper's Figs. 8 and 9)."""
    screen = SCREEN[verified.kind]
    with drawing(1, width=9.0) as figure:
        axes = figure.axes[0]
        shown = trace.time <= trace.time[0] + _SECONDS
        time, scale = trace.time[shown], screen.scale
        axes.plot(time, trace.measured[shown] * scale, color=colours.REFERENCE, lw=1.0, label="measured")
        axes.plot(time, trace.modelled[shown] * scale, "--", color=colours.ESTIMATE, lw=1.2, label="model")
        axes.set_title(f"{verified.run}: {verified.axis}, {verified.source}", loc="left")
        axes.set(xlabel="time since the first command [s]", ylabel=f"position without its mean [{screen.unit}]")
        axes.legend(frameon=False, ncols=2, loc="upper right")
        return svg(figure)


def _panels(names: Iterable[str], draw: Callable[[Axes, str], None], ylabel: str, xlabel: str = "") -> str:
    """One panel for each name, side by side: its title, or its label below where there is no other; empty without."""
    every = list(names)
    if not every:
        return ""
    with drawing(len(every)) as figure:
        for axes, name in zip(figure.axes, every, strict=True):
            draw(axes, name)
            axes.set_title(name if xlabel else "", loc="left")
            axes.set_xlabel(xlabel or name)
        figure.axes[0].set_ylabel(ylabel)
        return svg(figure)


def _draw_valley(axes: Axes, result: TrialResult, trial: Trial) -> None:
    fit = result.second
    omega, zeta = fit.natural_frequency or 1.0, fit.damping or 1.0
    omega, zeta = (omega, zeta) if zeta < 5.0 else (omega * 5.0 / zeta, 5.0)  # the valley runs off to infinity
    across = np.geomspace(omega / _SPREAD, omega * _SPREAD, _GRID)
    up = np.geomspace(zeta / _SPREAD, zeta * _SPREAD, _GRID)
    w, z = (grid.ravel() for grid in np.meshgrid(across, up))
    q, p = 2.0 * z / w, w**-2.0
    # the delay follows so that the area over the response stays: a trial determines that best
    delay = np.maximum(fit.delay + 2.0 * zeta / omega - q, 0.0)
    batch = Batch.of([trial], [1.0]).take(np.zeros(len(w), dtype=np.int64))
    rms = np.sqrt(batch.point(np.stack((delay, q, p), axis=1)).cost / batch.count) * MM
    levels = np.geomspace(float(rms.min()) * 1.02, float(rms.max()), 12)
    axes.contour(across, up, rms.reshape(_GRID, _GRID), levels=levels, colors=colours.ESTIMATE, linewidths=0.7)
    axes.plot(fit.natural_frequency or omega, fit.damping or zeta, "x", color=colours.REJECTED)
    axes.set(xscale="log", yscale="log")
    for side, ends in ((axes.xaxis, across), (axes.yaxis, up)):
        marks = float(f"{ends[0]:.1g}") * 2.0 ** np.arange(0, 6)
        side.set_major_locator(FixedLocator(marks.tolist()))
        side.set_major_formatter(FormatStrFormatter("%.3g"))
        side.set_minor_locator(NullLocator())
    axes.set(xlim=(across[0], across[-1]), ylim=(up[0], up[-1]))


def _draw_levels(axes: Axes, levels: Sequence[Level], colour: str, label: str, offset: float) -> None:
    """Means with bars of two standard deviations, one for each level."""
    at = np.arange(len(levels)) + offset
    bars = [2.0 * (level.sd or 0.0) for level in levels]
    axes.errorbar(
        at, [level.mean for level in levels], bars, fmt="o", ms=4, capsize=3, color=colour, lw=1.0, label=label
    )
    axes.set_xticks(np.arange(len(levels)), [level.level for level in levels])
    if numbers([level.level for level in levels]) is None:
        axes.tick_params(axis="x", rotation=20)
