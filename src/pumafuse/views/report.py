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


def models(found: Identification) -> TextTable:
    """The combined model of each axis (the paper's Table II)."""
    rows, screen = list[list[str]](), SCREEN[found.kind]
    for axis, one in found.axes.items():
        delays, plant = one.delays, one.model.plant
        described = formatting.plant(plant).replace(", ", "\n")
        if isinstance(plant, FirstOrder):
            mean, robust = map(formatting.milliseconds, (one.time_constant_mean, one.time_constant_robust))
            described += f"\ntrials' mean {mean},\nrobust {robust} ms"
        gain = formatting.gain(one.model.gain).replace(" + ", "\n+ ")
        times = map(formatting.milliseconds, (delays.lag, delays.fitted, delays.onset))
        rows.append([axis, str(one.trials), *times, described, gain, f"{_rms(found, axis) * screen.scale:.3f}"])
    line = f"K at speed s [{_SPEED[found.kind]}]"
    headings = ("axis", "trials", "lag, ms", "Td, ms", "onset, ms", "plant", line, f"RMS, {screen.unit}")
    return TextTable(headings, rows)


def dependences(found: Identification) -> TextTable:
    """Dependence of each coefficient on each factor (the paper's Table I)."""
    return _table(
        found.dependences,
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


def scatter(found: Identification) -> TextTable:
    """Scatter of each coefficient on each axis."""
    return _table(
        found.scatter,
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


def sentences(found: Identification) -> list[str]:
    """Which lag is meant, what was decided for each axis, and which trials were left out."""
    lines = [formatting.lag(found.arm.update_period)]
    for axis, one in found.axes.items():
        lines.append(f"{axis}: {one.choice.why}; {one.gain_words}")
        if one.delay_spread > 2.0 * one.delay_noise:
            noise = f"; the noise within a trial explains {one.delay_noise * MS:.2g} ms"
            moves = f"the delay moves by {one.delay_spread * MS:.2g} ms (sd) from trial to trial"
            lines.append(f"{axis}: {moves}{noise if found.method == 'fitted' else ''}")
        lines += [f"{axis}: trial '{trial}' left out: {why}" for trial, why in one.left_out.items()]
    return [*lines, found.one_delay]


def verifications(verified: Sequence[AxisVerification]) -> list[TextTable]:
    """Errors of the model on each run, axis and source (the paper's Table III), a table for each kind of axis."""
    return [
        _verifications(of_kind, kind) for kind in KINDS if (of_kind := [one for one in verified if one.kind == kind])
    ]


def _verifications(verified: Sequence[AxisVerification], kind: Kind) -> TextTable:
    screen = SCREEN[kind]
    return _table(
        verified,
        {
            "run": lambda one: one.run,
            "axis": lambda one: one.axis,
            "source": lambda one: one.source,
            f"motion, {screen.unit}": lambda one: f"{one.amplitude * screen.scale:.4g}",
            f"error,\n{screen.unit} RMS": lambda one: f"{one.model.rms * screen.scale:.3f}",
            "of the\nmotion": lambda one: f"{one.model.percent:.1f} %",
            "explained": lambda one: f"{one.model.fit:.1f} %" if np.isfinite(one.model.fit) else "–",
            "gain that\nstays": lambda one: f"{one.without_recovery.rms * screen.scale:.3f}",
            "gain that\nrecovers": lambda one: f"{one.with_recovery.rms * screen.scale:.3f}",
            "best\npossible": lambda one: f"{one.best_in_class.fit.rms * screen.scale:.3f}",
        },
    )


def verdict(one: AxisVerification) -> str:
    """How far off the model is on one axis, how late the arm is here, and what the best model would be."""
    best, screen = one.best_in_class, SCREEN[one.kind]
    plant = formatting.plant(best.plant, *_PLANT)
    left_out = f"; {one.outlying} outlying measurements are left out" if one.outlying else ""
    return (
        f"{one.run}, {one.axis}: the model is off by {one.model.rms * screen.scale:.3f} {screen.unit} RMS,"
        f" {one.model.percent:.1f} % of the motion; the best model of its order would be off by"
        f" {best.fit.rms * screen.scale:.3f}: {one.verdict}; by the model the arm is {one.lag * MS:.1f} ms late,"
        f" here it is {formatting.with_interval(best.lag, best.lag_ci95, MS)} ms; the best model has a gain of"
        f" {best.gain:.3f}, a dead time of {best.delay * MS:.1f} ms and {plant}; the start level is"
        f" {one.start * screen.scale:g} {screen.unit} ({one.start_from}){left_out}"
    )


# ---- how late -------------------------------------------------------------------------------------------------------


def answers(found: LatencySummary) -> list[str]:
    """How late each axis and each sensor is, whether that changes, and what the motion was too poor for."""
    lines = [f"{axis} is {formatting.between(one.lag, one.lag_ci95, MS)} ms late." for axis, one in found.axes.items()]
    for name, one in found.sensors.items():
        sign, word = (-1.0, "earlier") if one.latency < 0.0 else (1.0, "later")
        low, high = sorted(sign * end for end in one.latency_ci95)
        late = formatting.between(abs(one.latency), (low, high), MS)
        same = ": as late, as far as can be told" if low < 0.0 < high else ""
        lines.append(f"{name} is {late} ms {word} than {found.sensor}{same}.")
    lines.append(
        "An axis is late behind the held command, at constant velocity; behind the commanded path it is"
        f" {0.5 * found.update_period * MS:.3g} ms more. The stamps of {found.sensor} are taken to be right: by as much"
        " as they are late, every axis is less late."
    )
    return [*lines, *_changes(found), *(f"{axis}: {note}" for axis, one in found.axes.items() for note in one.notes)]


def _changes(found: LatencySummary) -> list[str]:
    """What is said of the lag over the run."""
    lines: list[str] = []
    if found.clock_drift is not None:
        lines.append(
            f"All axes together become {found.clock_drift * MS:+.1f} ms later over the run: a clock drifts, that of the"
            f" commands or that of {found.sensor}."
        )
    if found.clock_wander is not None:
        lines.append(
            f"All axes wander together by ± {found.clock_wander * MS:.1f} ms (one standard deviation): a clock, not"
            " the arm."
        )
    for axis, one in found.axes.items():
        if one.drifts and one.drift is not None and found.clock_drift is None:
            lines.append(
                f"{axis} becomes {one.drift * MS:+.1f} ms later over the run"
                f" (± {Z95 * (one.drift_sd or 0.0) * MS:.1f})."
            )
        if one.wander and found.clock_wander is None:
            lines.append(f"The lag of {axis} wanders by ± {one.wander * MS:.1f} ms (one standard deviation).")
    told = any(one.course for one in found.axes.values())
    return lines or (["The lag stays the same over the run, as far as can be told."] if told else [])


def lags(found: LatencySummary) -> TextTable:
    """A row for each axis and each sensor."""

    def time(value: float, interval: tuple[float, float], shared: bool = False) -> str:
        return formatting.between(value, interval, MS).replace(" (", f"{' *' if shared else ''}\n(", 1)

    rows = list[list[str]]()
    for axis, one in found.axes.items():
        delay = time(one.delay, one.delay_ci95, one.shared_delay)
        rows.append([axis, time(one.lag, one.lag_ci95), delay, _plant_of(one), _gain_of(one)])
    rows += [[name, time(one.latency, one.latency_ci95), "", "", ""] for name, one in found.sensors.items()]
    return TextTable(("axis,\nsensor", "late, ms", "dead time, ms", "plant", "gain"), rows)


def _plant_of(one: AxisLag) -> str:
    lines, screen = list[str](), SCREEN[one.kind]
    if one.time_constant is not None:
        lines.append(f"τ {formatting.between(one.time_constant, one.time_constant_ci95, MS)} ms")
    else:
        lines.append(f"ω {formatting.between(one.natural_frequency or 0.0, one.natural_frequency_ci95)} rad/s")
        lines.append(f"ζ {formatting.between(one.damping or 0.0, one.damping_ci95)}")
    if one.play:
        lines.append(f"play {formatting.between(one.play, one.play_ci95, screen.scale)} {screen.unit}")
    if one.max_speed:
        lines.append(f"up to {formatting.between(one.max_speed, one.max_speed_ci95, screen.scale)} {screen.unit}/s")
    return "\n".join(lines)


def _gain_of(one: AxisLag) -> str:
    gain = "1" if one.gain_ci95 is None else formatting.between(one.gain, one.gain_ci95)
    if one.gain_recovery is None:
        return gain
    return f"{gain}\nrecovers: {formatting.between(one.gain_recovery, one.gain_recovery_ci95, MS)} ms"


def settings(found: Latency) -> str:
    """The lines for ``fusion.toml`` and ``arm.toml``; of a sensor what differs from the defaults."""
    lines = list[str]()
    for name, one in found.details.sensors.items():
        numbers = {"latency_ms": one.latency, "latency_sd_ms": one.latency_sd or 0.0, "scale": one.scale}
        kept = {key: rounded(value) for key, value in numbers.items() if value != _DEFAULTS.get(key)}
        lines.append(toml.text({"sensors": {name: kept}}))
    return "\n".join([*lines, found.config.arm.to_toml()])


def elsewhere(found: LatencySummary) -> list[str]:
    """What to write for other programs, in their units."""
    latest = max(one.lag for one in found.axes.values()) + 0.5 * found.update_period
    ends = {axis: [end / _PHYSICS for end in one.delay_ci95] for axis, one in found.axes.items()}
    steps = ", ".join(f"{axis} {max(math.floor(low), 0)} to {math.ceil(high)}" for axis, (low, high) in ends.items())
    plants = ", ".join(f"{axis} {max(one.lag - one.delay, 0.0):.4f}" for axis, one in found.axes.items())
    dead = ", ".join(f"{axis} {one.delay:.4f}" for axis, one in found.axes.items())
    every = f"{_PHYSICS * MS:g} ms"
    return [
        f"MoveIt Servo, max_expected_latency [s]: {latest:.3f}, of the axis that is latest",
        f"Isaac Lab, DelayedPDActuatorCfg(min_delay, max_delay) [physics steps of {every}]: {steps}",
        f"mjlab, delay_min_lag and delay_max_lag of an actuator [physics steps of {every}]: the same",
        f'MuJoCo, dynprm of dyntype="filterexact" [s]: {plants}; actuator_delay [s]: {dead}',
    ] + [
        f"LeRobot, {name}: a frame shows what was {one.latency:.3f} s before its stamp; shift its delta_timestamps by"
        " that, in multiples of 1/fps"
        for name, one in found.sensors.items()
    ]


def write_latency(found: Latency, folder: Path, force: bool) -> None:
    """Write ``report.html`` with the answers, a picture of each axis, and what to write where."""
    content = {
        "summary": found.details,
        "answers": answers(found.details),
        "lags": lags(found.details),
        "figures": lag_figures(found),
        "settings": settings(found),
        "elsewhere": elsewhere(found.details),
    }
    _write("latency.html", content, folder, force)


def check_writable(folder: Path, force: bool) -> None:
    """Refuse early what the writers would refuse late."""
    folders.check_writable(folder, force, (PAGE,), lambda name: name == PAGE)


def write_identification(found: Identification, trials: StepTrials, folder: Path, force: bool) -> None:
    """Write ``report.html`` with the paper's tables and figures of an identification."""
    valleys, contours = step_figures.valleys(found, trials)
    content = {
        "found": found,
        "rms": _rms(found) * SCREEN[found.kind].scale,
        "unit": SCREEN[found.kind].unit,
        "models": models(found),
        "sentences": sentences(found),
        "jittering": [axis for axis, one in found.axes.items() if one.delay_spread > 2.0 * one.delay_noise > 0.0],
        "dependences": dependences(found),
        "strongest": max(found.dependences, key=lambda row: row.i_ratio or 0.0, default=None),
        "scatter": scatter(found),
        "outlying": sorted({name for row in found.scatter for name in row.outlying}),
        "contours": contours,
        "flat": sum("flat valley" in flag for one in found.trials for flag in one.second.flags),
        "trials": _trials(found),
        "flagged": sum(bool(one.first.flags or one.second.flags or one.left_out) for one in found.trials),
        "figures": {
            "responses": step_figures.responses(found, trials),
            "delays": step_figures.delays(found),
            "gains": step_figures.gains(found),
            "histograms": step_figures.histograms(found),
            "fits": step_figures.fits_by_factor(found, trials),
            "valleys": valleys,
            "performance": step_figures.performance(found),
        },
        "arm": found.arm.to_toml(),
    }
    _write("identification.html", content, folder, force)


def write_verification(
    verified: Sequence[tuple[AxisVerification, Trace]], arm: ArmModel, folder: Path, force: bool
) -> None:
    """Write ``report.html`` with Table III and Figs. 8 and 9."""
    every = [one for one, _ in verified]
    content = {
        "arm": arm,
        "runs": {one.run for one in every},
        "lag": formatting.lag(arm.update_period),
        "worst": max(every, key=lambda one: one.model.rms / max(one.best_in_class.fit.rms, 1e-12)),
        "table_iii": verifications(every),
        "figures": [(step_figures.verification(one, trace), verdict(one)) for one, trace in verified],
    }
    _write("verification.html", content, folder, force)


def _rms(found: Identification, axis: str | None = None) -> float:
    """Of the combined model over the trials that it is made of [m or rad]; of all axes for None."""
    used = [one for one in found.trials if one.left_out is None and axis in (None, one.axis)]
    return float(np.sqrt(np.mean([one.combined_rms**2 for one in used if one.combined_rms is not None])))


def _trials(found: Identification) -> TextTable:
    factors, screen = list(found.trials[0].factors), SCREEN[found.kind]
    rows = [
        [
            *(one.trial, one.axis, f"{one.step * screen.scale:g}", f"{one.speed * screen.fast_scale:.3g}"),
            *(one.factors[name] for name in factors),
            *_coefficients(one.first, screen),
            *_coefficients(one.second, screen),
            *("–" if one.combined_rms is None else f"{one.combined_rms * screen.scale:.3f}", _flags(one)),
        ]
        for one in found.trials
    ]
    rms = f"RMS, {screen.unit}"
    first = ("lag, ms", "K", "Td, ms", "τ, ms", rms)
    second = ("lag, ms", "K", "Td, ms", "ω, rad/s", "ζ", rms)
    settings = ("trial", "axis", f"step, {screen.unit}", f"speed, {screen.fast}", *factors)
    return TextTable((*settings, *first, *second, f"combined {rms}", "flags"), rows)


def _flags(one: TrialResult) -> str:
    first, second = one.first.flags, one.second.flags
    found = [] if one.left_out is None else [f"left out: {one.left_out}"]
    found += [flag if flag in second else f"{flag} (first order)" for flag in first]
    return "; ".join([*found, *(f"{flag} (second order)" for flag in second if flag not in first)])


def _coefficients(fit: OrderFit, screen: Screen) -> list[str]:
    values = [(fit.lag, fit.lag_ci95, MS), (fit.gain, fit.gain_ci95, 1.0), (fit.delay, fit.delay_ci95, MS)]
    values += [(fit.time_constant, fit.time_constant_ci95, MS)]
    values += [(fit.natural_frequency, fit.natural_frequency_ci95, 1.0), (fit.damping, fit.damping_ci95, 1.0)]
    found = [formatting.with_interval(value, ci95, unit) for value, ci95, unit in values if value is not None]
    return [*found, f"{fit.rms * screen.scale:.3f} ({fit.rms_percent:.1f} %)"]


def _write(template: str, content: Mapping[str, Any], folder: Path, force: bool) -> None:
    check_writable(folder, force)
    text = render(template, content)
    with folders.replacing(folder) as new:
        (new / PAGE).write_text(text, encoding="utf-8")
