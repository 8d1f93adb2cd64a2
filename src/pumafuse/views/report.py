"""Tables, sentences and an HTML page of an identification, a verification, or of how late everything is."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from .. import folders, toml
from ..fusion.score import Z95
from ..identification.identify import Identification, OrderFit, TrialResult
from ..identification.trials import StepTrials
from ..identification.verify import AxisVerification, Trace
from ..model.arm import ArmModel
from ..model.plants import FirstOrder
from ..tuning.latency import AxisLag, Latency, LatencySummary
from ..tuning.parameters import rounded
from ..units import KINDS, MS, SCREEN, Kind, Screen
from . import formatting, step_figures
from .canvas import render
from .figures import lag_figures

PAGE = "report.html"
_PHYSICS = 0.005  # s: a usual step of simulators
_TEXT = {  # headings of columns that are no numbers
    *("axis", "axis,\nsensor", "coefficient", "factor", "flags", "level: mean ± sd (trials)", "outlying trials"),
    *("plant", "run", "source", "trial", "verdict"),
}
_PLANT = "a time constant of {} ms", "a natural frequency of {} rad/s with damping {}"
_SPEED: dict[Kind, str] = {"length": "m/s", "angle": "rad/s"}  # the s of a gain line: slopes are per that in arm.toml
_DEFAULTS = {"latency_sd_ms": 0.0, "scale": 1.0}  # of a sensor
T = TypeVar("T")


class TextTable(NamedTuple):
    """A table of text for the terminal and for a page; a cell may have several lines."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def columns(self) -> list[tuple[str, bool]]:
        """The headings, and whether their column is text, not numbers."""
        return [(heading, heading in _TEXT) for heading in self.headings]


def _table(items: Iterable[T], cells: Mapping[str, Callable[[T], str]]) -> TextTable:
    """A row for each item; ``cells`` are by heading."""
    return TextTable(list(cells), [[cell(item) for cell in cells.values()] for item in items])


def models(identification: Identification) -> TextTable:
    """The combined model of each axis (the paper's Table II)."""
    rows, screen = list[list[str]](), SCREEN[identification.kind]
    for axis, model in identification.axes.items():
        delays, plant = model.delays, model.model.plant
        described = formatting.plant(plant).replace(", ", "\n")
        if isinstance(plant, FirstOrder):
            mean, robust = map(formatting.milliseconds, (model.time_constant_mean, model.time_constant_robust))
            described += f"\ntrials' mean {mean},\nrobust {robust} ms"
        gain = formatting.gain(model.model.gain).replace(" + ", "\n+ ")
        times = map(formatting.milliseconds, (delays.lag, delays.fitted, delays.onset))
        rows.append(
            [axis, str(model.trials), *times, described, gain, f"{_rms(identification, axis) * screen.scale:.3f}"]
        )
    line = f"K at speed s [{_SPEED[identification.kind]}]"
    headings = ("axis", "trials", "lag, ms", "Td, ms", "onset, ms", "plant", line, f"RMS, {screen.unit}")
    return TextTable(headings, rows)


def dependences(identification: Identification) -> TextTable:
    """Dependence of each coefficient on each factor (the paper's Table I)."""
    return _table(
        identification.dependences,
        {
            "coefficient": lambda row: row.coefficient,
            "factor": lambda row: row.factor,
            "level: mean ± sd (trials)": lambda row: "\n".join(formatting.level(level) for level in row.levels),
            "i-ratio": lambda row: "–" if row.i_ratio is None else f"{row.i_ratio:.2f}",
            "Welch p": lambda row: formatting.p_value(row.welch_p),
            "adjusted p": lambda row: formatting.p_value(row.adjusted_p),
            "verdict": lambda row: row.verdict,
        },
    )


def scatter(identification: Identification) -> TextTable:
    """Scatter of each coefficient on each axis."""
    return _table(
        identification.scatter,
        {
            "coefficient": lambda row: row.coefficient,
            "axis": lambda row: row.axis,
            "median": lambda row: f"{row.median:.4g}",
            "normal p": lambda row: formatting.p_value(row.normal_p),
            "sd of replicates": lambda row: "–" if row.replicate_sd is None else f"{row.replicate_sd:.2g}",
            "sd by noise": lambda row: f"{row.own_sd:.2g}",
            "outlying trials": lambda row: ", ".join(row.outlying) or "none",
        },
    )


def sentences(identification: Identification) -> list[str]:
    """Which lag is meant, what was decided for each axis, and which trials were left out."""
    lines = formatting.lag(identification.arm)
    for axis, model in identification.axes.items():
        lines.append(f"{axis}: {model.choice.why}; {model.gain_words}")
        if model.delay_spread > 2.0 * model.delay_noise:
            noise = f"; the noise within a trial explains {model.delay_noise * MS:.2g} ms"
            moves = f"the delay moves by {model.delay_spread * MS:.2g} ms (sd) from trial to trial"
            lines.append(f"{axis}: {moves}{noise if identification.method == 'fitted' else ''}")
        lines += [f"{axis}: trial '{trial}' left out: {why}" for trial, why in model.left_out.items()]
    return [*lines, identification.one_delay]


def verifications(verified: Sequence[AxisVerification]) -> list[TextTable]:
    """Errors of the model on each run, axis and source (the paper's Table III), a table for each kind of axis."""
    return [
        _verifications(of_kind, kind)
        for kind in KINDS
        if (of_kind := [result for result in verified if result.kind == kind])
    ]


def _verifications(verified: Sequence[AxisVerification], kind: Kind) -> TextTable:
    screen = SCREEN[kind]
    return _table(
        verified,
        {
            "run": lambda result: result.run,
            "axis": lambda result: result.axis,
            "source": lambda result: result.source,
            f"motion, {screen.unit}": lambda result: f"{result.amplitude * screen.scale:.4g}",
            f"error,\n{screen.unit} RMS": lambda result: f"{result.model.rms * screen.scale:.3f}",
            "of the\nmotion": lambda result: f"{result.model.percent:.1f} %",
            "explained": lambda result: f"{result.model.fit:.1f} %" if np.isfinite(result.model.fit) else "–",
            "gain that\nstays": lambda result: f"{result.without_recovery.rms * screen.scale:.3f}",
            "gain that\nrecovers": lambda result: f"{result.with_recovery.rms * screen.scale:.3f}",
            "best\npossible": lambda result: f"{result.best_in_class.fit.rms * screen.scale:.3f}",
        },
    )


def verdict(result: AxisVerification) -> str:
    """How far off the model is on one axis, how late the arm is here, and what the best model would be."""
    best, screen = result.best_in_class, SCREEN[result.kind]
    plant = formatting.plant(best.plant, *_PLANT)
    left_out = f"; {result.outlying} outlying measurements are left out" if result.outlying else ""
    return (
        f"{result.run}, {result.axis}: the model is off by {result.model.rms * screen.scale:.3f} {screen.unit} RMS,"
        f" {result.model.percent:.1f} % of the motion; the best model of its order would be off by"
        f" {best.fit.rms * screen.scale:.3f}: {result.verdict}; by the model the arm is {result.lag * MS:.1f} ms late,"
        f" here it is {formatting.format_interval(best.lag, best.lag_ci95, MS)} ms; the best model has a gain of"
        f" {best.gain:.3f}, a dead time of {best.delay * MS:.1f} ms and {plant}; the start level is"
        f" {result.start * screen.scale:g} {screen.unit} ({result.start_from}){left_out}"
    )


# ---- how late -------------------------------------------------------------------------------------------------------


def answers(summary: LatencySummary) -> list[str]:
    """How late each axis and each sensor is, whether that changes, and what the motion was too poor for."""
    lines = [
        f"{axis} is {formatting.format_range(lag.lag, lag.lag_ci95, MS)} ms late." for axis, lag in summary.axes.items()
    ]
    for name, sensor in summary.sensors.items():
        sign, word = (-1.0, "earlier") if sensor.latency < 0.0 else (1.0, "later")
        low, high = sorted(sign * end for end in sensor.latency_ci95)
        late = formatting.format_range(abs(sensor.latency), (low, high), MS)
        same = ": as late, as far as can be told" if low < 0.0 < high else ""
        lines.append(f"{name} is {late} ms {word} than {summary.sensor}{same}.")
    lines.append(
        "An axis is late behind the held command, at constant velocity; behind the commanded path it is"
        f" {0.5 * summary.update_period * MS:.3g} ms more. The stamps of {summary.sensor} are taken to be right: by as"
        " much as they are late, every axis is less late."
    )
    return [
        *lines,
        *_changes(summary),
        *(f"{axis}: {note}" for axis, lag in summary.axes.items() for note in lag.notes),
    ]


def _changes(summary: LatencySummary) -> list[str]:
    """What is said of the lag over the run."""
    lines: list[str] = []
    if summary.clock_drift is not None:
        lines.append(
            f"All axes together become {summary.clock_drift * MS:+.1f} ms later over the run: a clock drifts, that"
            f" of the commands or that of {summary.sensor}."
        )
    if summary.clock_wander is not None:
        lines.append(
            f"All axes wander together by ± {summary.clock_wander * MS:.1f} ms (one standard deviation): a clock, not"
            " the arm."
        )
    for axis, lag in summary.axes.items():
        if lag.drifts and lag.drift is not None and summary.clock_drift is None:
            lines.append(
                f"{axis} becomes {lag.drift * MS:+.1f} ms later over the run"
                f" (± {Z95 * (lag.drift_sd or 0.0) * MS:.1f})."
            )
        if lag.wander and summary.clock_wander is None:
            lines.append(f"The lag of {axis} wanders by ± {lag.wander * MS:.1f} ms (one standard deviation).")
    has_course = any(axis.course for axis in summary.axes.values())
    return lines or (["The lag stays the same over the run, as far as can be told."] if has_course else [])


def lags(summary: LatencySummary) -> TextTable:
    """A row for each axis and each sensor."""

    def time(value: float, interval: tuple[float, float], shared: bool = False) -> str:
        return formatting.format_range(value, interval, MS).replace(" (", f"{' *' if shared else ''}\n(", 1)

    rows = list[list[str]]()
    for axis, lag in summary.axes.items():
        delay = time(lag.delay, lag.delay_ci95, lag.shared_delay)
        rows.append([axis, time(lag.lag, lag.lag_ci95), delay, _plant_of(lag), _gain_of(lag)])
    rows += [[name, time(sensor.latency, sensor.latency_ci95), "", "", ""] for name, sensor in summary.sensors.items()]
    return TextTable(("axis,\nsensor", "late, ms", "dead time, ms", "plant", "gain"), rows)


def _plant_of(lag: AxisLag) -> str:
    lines, screen = list[str](), SCREEN[lag.kind]
    if lag.time_constant is not None:
        lines.append(f"τ {formatting.format_range(lag.time_constant, lag.time_constant_ci95, MS)} ms")
    else:
        lines.append(f"ω {formatting.format_range(lag.natural_frequency or 0.0, lag.natural_frequency_ci95)} rad/s")
        lines.append(f"ζ {formatting.format_range(lag.damping or 0.0, lag.damping_ci95)}")
    if lag.play:
        lines.append(f"play {formatting.format_range(lag.play, lag.play_ci95, screen.scale)} {screen.unit}")
    if lag.max_speed:
        lines.append(
            f"up to {formatting.format_range(lag.max_speed, lag.max_speed_ci95, screen.scale)} {screen.unit}/s"
        )
    return "\n".join(lines)


def _gain_of(lag: AxisLag) -> str:
    gain = "1" if lag.gain_ci95 is None else formatting.format_range(lag.gain, lag.gain_ci95)
    if lag.gain_recovery is None:
        return gain
    return f"{gain}\nrecovers: {formatting.format_range(lag.gain_recovery, lag.gain_recovery_ci95, MS)} ms"


def settings(latency: Latency) -> str:
    """The lines for ``fusion.toml`` and ``arm.toml``; of a sensor what differs from the defaults."""
    lines = list[str]()
    for name, sensor in latency.details.sensors.items():
        numbers = {"latency_ms": sensor.latency, "latency_sd_ms": sensor.latency_sd or 0.0, "scale": sensor.scale}
        kept = {key: rounded(value) for key, value in numbers.items() if value != _DEFAULTS.get(key)}
        lines.append(toml.text({"sensors": {name: kept}}))
    return "\n".join([*lines, latency.config.arm.to_toml()])


def elsewhere(summary: LatencySummary) -> list[str]:
    """What to write for other programs, in their units."""
    latest = max(axis.lag for axis in summary.axes.values()) + 0.5 * summary.update_period
    ends = {axis: [end / _PHYSICS for end in lag.delay_ci95] for axis, lag in summary.axes.items()}
    steps = ", ".join(f"{axis} {max(math.floor(low), 0)} to {math.ceil(high)}" for axis, (low, high) in ends.items())
    plants = ", ".join(f"{axis} {max(lag.lag - lag.delay, 0.0):.4f}" for axis, lag in summary.axes.items())
    dead = ", ".join(f"{axis} {lag.delay:.4f}" for axis, lag in summary.axes.items())
    every = f"{_PHYSICS * MS:g} ms"
    return [
        f"MoveIt Servo, max_expected_latency [s]: {latest:.3f}, of the axis that is latest",
        f"Isaac Lab, DelayedPDActuatorCfg(min_delay, max_delay) [physics steps of {every}]: {steps}",
        f"mjlab, delay_min_lag and delay_max_lag of an actuator [physics steps of {every}]: the same",
        f'MuJoCo, dynprm of dyntype="filterexact" [s]: {plants}; actuator_delay [s]: {dead}',
    ] + [
        f"LeRobot, {name}: a frame shows what was {sensor.latency:.3f} s before its stamp; shift its delta_timestamps"
        " by that, in multiples of 1/fps"
        for name, sensor in summary.sensors.items()
    ]


def write_latency(latency: Latency, folder: Path, force: bool) -> None:
    """Write ``report.html`` with the answers, a picture of each axis, and what to write where."""
    content = {
        "summary": latency.details,
        "answers": answers(latency.details),
        "lags": lags(latency.details),
        "figures": lag_figures(latency),
        "settings": settings(latency),
        "elsewhere": elsewhere(latency.details),
    }
    _write("latency.html", content, folder, force)


def check_writable(folder: Path, force: bool) -> None:
    """Refuse early what the writers would refuse late."""
    folders.check_writable(folder, force, (PAGE,), lambda name: name == PAGE)


def write_identification(identification: Identification, trials: StepTrials, folder: Path, force: bool) -> None:
    """Write ``report.html`` with the paper's tables and figures of an identification."""
    valleys, contours = step_figures.valleys(identification, trials)
    content = {
        "found": identification,
        "rms": _rms(identification) * SCREEN[identification.kind].scale,
        "unit": SCREEN[identification.kind].unit,
        "models": models(identification),
        "sentences": sentences(identification),
        "jittering": [
            axis for axis, model in identification.axes.items() if model.delay_spread > 2.0 * model.delay_noise > 0.0
        ],
        "dependences": dependences(identification),
        "strongest": max(identification.dependences, key=lambda row: row.i_ratio or 0.0, default=None),
        "scatter": scatter(identification),
        "outlying": sorted({name for row in identification.scatter for name in row.outlying}),
        "contours": contours,
        "flat": sum("flat valley" in flag for trial in identification.trials for flag in trial.second.flags),
        "trials": _trials(identification),
        "flagged": sum(
            bool(trial.first.flags or trial.second.flags or trial.left_out) for trial in identification.trials
        ),
        "figures": {
            "responses": step_figures.responses(identification, trials),
            "delays": step_figures.delays(identification),
            "gains": step_figures.gains(identification),
            "histograms": step_figures.histograms(identification),
            "fits": step_figures.fits_by_factor(identification, trials),
            "valleys": valleys,
            "performance": step_figures.performance(identification),
        },
        "arm": identification.arm.to_toml(),
    }
    _write("identification.html", content, folder, force)


def write_verification(
    verified: Sequence[tuple[AxisVerification, Trace]], arm: ArmModel, folder: Path, force: bool
) -> None:
    """Write ``report.html`` with Table III and Figs. 8 and 9."""
    every = [result for result, _ in verified]
    content = {
        "arm": arm,
        "runs": {result.run for result in every},
        "lag": formatting.lag(arm),
        "worst": max(every, key=lambda result: result.model.rms / max(result.best_in_class.fit.rms, 1e-12)),
        "table_iii": verifications(every),
        "figures": [(step_figures.verification(result, trace), verdict(result)) for result, trace in verified],
    }
    _write("verification.html", content, folder, force)


def _rms(identification: Identification, axis: str | None = None) -> float:
    """RMS of the combined model over the trials that it is made of [m or rad]; of all axes for None."""
    used = [trial for trial in identification.trials if trial.left_out is None and axis in (None, trial.axis)]
    return float(np.sqrt(np.mean([trial.combined_rms**2 for trial in used if trial.combined_rms is not None])))


def _trials(identification: Identification) -> TextTable:
    factors, screen = list(identification.trials[0].factors), SCREEN[identification.kind]
    rows = [
        [
            *(trial.trial, trial.axis, f"{trial.step * screen.scale:g}", f"{trial.speed * screen.fast_scale:.3g}"),
            *(trial.factors[name] for name in factors),
            *_coefficients(trial.first, screen),
            *_coefficients(trial.second, screen),
            *("–" if trial.combined_rms is None else f"{trial.combined_rms * screen.scale:.3f}", _flags(trial)),
        ]
        for trial in identification.trials
    ]
    rms = f"RMS, {screen.unit}"
    first = ("lag, ms", "K", "Td, ms", "τ, ms", rms)
    second = ("lag, ms", "K", "Td, ms", "ω, rad/s", "ζ", rms)
    settings = ("trial", "axis", f"step, {screen.unit}", f"speed, {screen.fast}", *factors)
    return TextTable((*settings, *first, *second, f"combined {rms}", "flags"), rows)


def _flags(trial: TrialResult) -> str:
    first, second = trial.first.flags, trial.second.flags
    flags = [] if trial.left_out is None else [f"left out: {trial.left_out}"]
    flags += [flag if flag in second else f"{flag} (first order)" for flag in first]
    return "; ".join([*flags, *(f"{flag} (second order)" for flag in second if flag not in first)])


def _coefficients(fit: OrderFit, screen: Screen) -> list[str]:
    values = [(fit.lag, fit.lag_ci95, MS), (fit.gain, fit.gain_ci95, 1.0), (fit.delay, fit.delay_ci95, MS)]
    values += [(fit.time_constant, fit.time_constant_ci95, MS)]
    values += [(fit.natural_frequency, fit.natural_frequency_ci95, 1.0), (fit.damping, fit.damping_ci95, 1.0)]
    coefficients = [formatting.format_interval(value, ci95, unit) for value, ci95, unit in values if value is not None]
    return [*coefficients, f"{fit.rms * screen.scale:.3f} ({fit.rms_percent:.1f} %)"]


def _write(template: str, content: Mapping[str, Any], folder: Path, force: bool) -> None:
    check_writable(folder, force)
    text = render(template, content)
    with folders.replacing(folder) as new:
        (new / PAGE).write_text(text, encoding="utf-8")
