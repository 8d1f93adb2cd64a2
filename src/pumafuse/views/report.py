"""An identification or a verification as one HTML page that needs nothing else, each figure with its sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from .. import folders
from ..identification.identify import Identification, OrderFit, TrialResult
from ..identification.trials import StepTrials
from ..identification.verify import AxisVerification, Trace
from ..model.arm import ArmModel
from ..units import MM, MS
from . import formatting as words
from . import step_figures
from .canvas import render

PAGE = "report.html"


def check_writable(folder: Path, force: bool) -> None:
    """Refuse early what the writers would refuse late.

    Raises:
        FolderError: The folder exists and is not to be replaced, or holds something else than a report.
    """
    folders.check_writable(folder, force, (PAGE,), lambda name: name == PAGE)


def write_identification(found: Identification, trials: StepTrials, folder: Path, force: bool) -> None:
    """Write ``report.html`` with the paper's tables and figures of an identification.

    Args:
        found: What was identified.
        trials: From these.
        folder: Where the page goes.
        force: Whether an earlier report may be replaced.

    Raises:
        FolderError: See :func:`check_writable`, or the disk refuses.
    """
    contour, names = step_figures.valleys(found, trials)
    figures = {
        "responses": step_figures.responses(found, trials),
        "delays": step_figures.delays(found),
        "gains": step_figures.gains(found),
        "histograms": step_figures.histograms(found),
        "fits": step_figures.fits_by_factor(found, trials),
        "valleys": contour,
        "performance": step_figures.performance(found),
    }
    factors = list(found.trials[0].factors)
    content = {
        "title": f"Identification: {found.arm.name}",
        "summary": _summary(found),
        "found": found,
        "models": [
            {
                "axis": axis,
                "trials": one.trials,
                "order": "first" if one.choice.order == 1 else "second",
                "plant": words.plant(one.model.plant),
                "gain": words.gain(one.model.gain),
                "delay": words.milliseconds(one.delays.fitted),
            }
            for axis, one in found.axes.items()
        ],
        "choices": [f"{axis}: {one.choice.why}; {one.gain_words}." for axis, one in found.axes.items()],
        "delays": [
            {
                "axis": axis,
                "onset": words.milliseconds(one.delays.onset),
                "fitted": words.milliseconds(one.delays.fitted),
                "lag": words.milliseconds(one.delays.lag),
                "spread": f"{one.delay_spread * MS:.2g}",
                "noise": f"{one.delay_noise * MS:.2g}",
            }
            for axis, one in found.axes.items()
        ],
        "dependences": [
            {
                "coefficient": row.coefficient,
                "factor": row.factor,
                "levels": [words.level(level) for level in row.levels],
                "ratio": "–" if row.i_ratio is None else f"{row.i_ratio:.2f}",
                "welch": words.p_value(row.welch_p),
                "adjusted": words.p_value(row.adjusted_p),
                "verdict": row.verdict,
            }
            for row in found.dependences
        ],
        "scatter": [
            {
                "coefficient": row.coefficient,
                "axis": row.axis,
                "median": f"{row.median:.4g}",
                "normal": words.p_value(row.normal_p),
                "replicates": "–" if row.replicate_sd is None else f"{row.replicate_sd:.2g}",
                "noise": f"{row.own_sd:.2g}",
                "outlying": ", ".join(row.outlying) or "none",
            }
            for row in found.scatter
        ],
        "factors": factors,
        "trials": [_trial(one, factors) for one in found.trials],
        "flagged": sum(bool(one.first.flags or one.second.flags or one.left_out) for one in found.trials),
        "figures": {name: Markup(svg) for name, svg in figures.items()},
        "says": _sentences(found, names),
        "arm": found.arm.to_toml(),
    }
    _write("identification.html", content, folder, force)


def write_verification(
    verified: Sequence[tuple[AxisVerification, Trace]], arm: ArmModel, folder: Path, force: bool
) -> None:
    """Write ``report.html`` with Table III and Figs. 8 and 9.

    Args:
        verified: From :func:`pumafuse.verify`, of one run or several.
        arm: The model.
        folder: Where the page goes.
        force: Whether an earlier report may be replaced.

    Raises:
        FolderError: See :func:`check_writable`, or the disk refuses.
    """
    worst = max((one for one, _ in verified), key=lambda one: one.model.rms / max(one.floor.fit.rms, 1e-12))
    content = {
        "title": f"Verification: {arm.name}",
        "summary": (
            f"The model was driven by the commands of {len({one.run for one, _ in verified})} runs and compared with"
            f" what was measured, both without their means. Furthest from its floor is {worst.run}, {worst.axis}:"
            f" {worst.verdict}."
        ),
        "rows": [
            {
                "names": [one.run, one.axis, one.source],
                "numbers": words.verification(one),
                "verdict": one.verdict,
                "figure": Markup(step_figures.verification(one, trace)),
                "says": (
                    f"The model's RMS error is {one.model.rms * MM:.3f} mm, {one.model.percent:.1f} % of the"
                    f" {one.amplitude * MM:g} mm commanded; start level {one.start * MM:g} mm ({one.start_from})."
                    f" The best linear model of this order, refitted here (K {one.floor.gain:.3f},"
                    f" Td {one.floor.delay * MS:.1f} ms, {words.plant(one.floor.plant)}), leaves"
                    f" {one.floor.fit.rms * MM:.3f} mm."
                ),
            }
            for one, trace in verified
        ],
        "says": (
            "The floor is what noise, friction and everything else that is not linear leave to the best model of the"
            " same order on this very run: a model near it is as good as it can be; far above it does not hold here."
        ),
    }
    _write("verification.html", content, folder, force)


def _summary(found: Identification) -> str:
    used = sum(one.trials for one in found.axes.values())
    rms = [one.combined_rms for one in found.trials if one.combined_rms is not None and one.left_out is None]
    how = "with delay and gain read off, as published" if found.method == "published" else "each fitted whole"
    window = "all samples" if found.samples is None else f"{found.samples} samples from each step on"
    return (
        f"{len(found.trials)} step trials, {how} ({window}); {used} of them are in the combined model, which leaves"
        f" {float(np.sqrt(np.mean(np.square(rms)))) * MM:.3g} mm RMS of them (eq. 10). {found.one_delay[0].upper()}"
        f"{found.one_delay[1:]}."
    )


def _sentences(found: Identification, contours: Sequence[str]) -> dict[str, str]:
    """What each table and figure shows, on these data."""
    moving = [axis for axis, one in found.axes.items() if one.delay_spread > 2.0 * one.delay_noise > 0.0]
    strongest = max(
        (row for row in found.dependences if row.i_ratio is not None), key=lambda row: row.i_ratio or 0.0, default=None
    )
    outlying = sorted({name for row in found.scatter for name in row.outlying})
    flat = [one for one in found.trials if any("flat valley" in flag for flag in one.second.flags)]
    lower = {axis: 1.0 - one.choice.second_rms / one.choice.first_rms for axis, one in found.axes.items()}
    return {
        "responses": (
            "Each thin line is a trial, divided by its own gain and set back by its own delay; the thick line is the"
            " combined plant. Where thin lines leave it together, no single linear plant follows the arm there."
        ),
        "delays": (
            (
                f"The delay moves from trial to trial by more than the noise explains ({', '.join(moving)}): a filter"
                " should allow for it (latency_sd_ms of its sensors, or input noise)."
                if moving
                else "The delay does not move from trial to trial by more than the noise explains."
            )
            + " Points are trials in the order of the list; the band is the 95 % interval of their common value."
        ),
        "gains": " ".join(f"{axis}: {one.gain_words}." for axis, one in found.axes.items()),
        "dependences": (
            "An i-ratio above 1 says that the means differ between levels."
            + (
                f" The strongest dependence is of {strongest.coefficient} on {strongest.factor}"
                f" (i-ratio {strongest.i_ratio:.2f}, {strongest.verdict})."
                if strongest is not None
                else ""
            )
            + " Welch's test does not assume equal variances; the adjusted p looks at a factor beside all the others."
        ),
        "scatter": (
            (f"Outlying trials: {', '.join(outlying)}." if outlying else "No trial is outlying.")
            + " A small normal p says that a coefficient is not normally distributed: read its mean and i-ratio with"
            " care."
        ),
        "fits": (
            "Own fits of both orders with bars of two standard deviations. A common plant of second order leaves "
            + ", ".join(f"{share:.0%} less on {axis}" for axis, share in lower.items())
            + " than one of first order."
        ),
        "valleys": (
            f"RMS over ω and ζ of the trials whose ω is known worst ({', '.join(contours)}); crosses mark the fits."
            f" {len(flat)} of {len(found.trials)} trials have a long flat valley: many ω and ζ fit them equally well,"
            " and first order may do."
        ),
        "performance": " ".join(f"By {one.factor}: {one.verdict}." for one in found.performance),
    }


def _trial(one: TrialResult, factors: Sequence[str]) -> Mapping[str, Any]:
    first, second = one.first, one.second
    shared = [flag for flag in first.flags if flag in second.flags]
    flags = [*shared, *(f"{flag} (first order)" for flag in first.flags if flag not in shared)]
    flags += [f"{flag} (second order)" for flag in second.flags if flag not in shared]
    if one.left_out is not None:
        flags.insert(0, f"left out: {one.left_out}")
    return {
        "name": one.trial,
        "axis": one.axis,
        "numbers": [
            f"{one.step * MM:g}",
            f"{one.speed:.3g}",
            *(one.factors[name] for name in factors),
            *_coefficients(first),
            *_coefficients(second),
            "–" if one.combined_rms is None else f"{one.combined_rms * MM:.3f}",
        ],
        "flags": "; ".join(flags),
    }


def _coefficients(fit: OrderFit) -> list[str]:
    found = [
        words.with_interval(fit.gain, fit.gain_ci95),
        words.with_interval(fit.delay, fit.delay_ci95, MS),
    ]
    if fit.time_constant is not None:
        found.append(words.with_interval(fit.time_constant, fit.time_constant_ci95, MS))
    if fit.natural_frequency is not None and fit.damping is not None:
        found.append(words.with_interval(fit.natural_frequency, fit.natural_frequency_ci95))
        found.append(words.with_interval(fit.damping, fit.damping_ci95))
    return [*found, f"{fit.rms * MM:.3f} ({fit.rms_percent:.1f} %)"]


def _write(template: str, content: Mapping[str, Any], folder: Path, force: bool) -> None:
    check_writable(folder, force)
    text = render(template, content)
    with folders.replacing(folder) as new:
        (new / PAGE).write_text(text, encoding="utf-8")
