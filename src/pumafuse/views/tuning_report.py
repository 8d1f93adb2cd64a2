"""The report of a tuning: one HTML page that loads nothing, a sentence above each figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FormatStrFormatter, LogLocator, MaxNLocator, NullLocator

from .. import toml
from ..arrays import FloatArray
from ..filter.outcome import Outcome
from ..fusion.config import ARM_FILE
from ..fusion.consistency import LAGS, Consistency, consistency
from ..fusion.estimates import Estimates
from ..fusion.score import Z95
from ..logs.run import Run
from ..tuning.intervals import Profile
from ..tuning.summary import Fitted, TuningSummary
from ..tuning.tune import Tuning
from ..tuning.validation import Check, fused
from . import colours, formatting
from .canvas import drawing, render

_Pair: TypeAlias = tuple[Consistency | None, Consistency | None]  # before and after
_WHITE = 0.01  # p-value from which innovations count as white


def page(found: Tuning, runs: Sequence[Run]) -> str:
    """The text of ``report.html``: the fitted parameters, their intervals, and the validation.

    Args:
        found: The tuning.
        runs: The runs that it was fitted on; innovations are shown on the first.
    """
    summary = found.summary
    fitted = {one.key: one for one in summary.parameters}
    axes = dict.fromkeys(one.axis for one in found.profiles)  # None: shared by all
    drawn = [[one for one in found.profiles if one.axis == axis] for axis in axes]
    before, after = (fused(runs[0], config) for config in (found.before, found.config))
    tests = _tests(before, after)
    known = [one for one in summary.parameters if one.before is not None]
    both = [pair for pair in tests.values() if all(pair)]
    content = {
        "title": f"Tuning: {', '.join(summary.runs)}",
        "tuning": summary,
        "notes": _notes(summary),
        "parameters": [_parameter(one, summary.interrupted) for one in summary.parameters],
        "known": len(known),
        "outside": sum(not _contains(one.ci95, one.before) for one in known),
        "zero": sum(one.value == 0.0 for one in summary.parameters),
        "open": not summary.interrupted and any(None in one.ci95 for one in summary.parameters),
        "profiles": [Markup(profile_figure(some, fitted)) for some in drawn],
        "validation": [_check(one) for one in summary.validation or ()],
        "innovations": [
            {
                "figure": Markup(innovation_figure(before, after, sensor, axis)),
                "sentence": _sentence(sensor, axis, pair),
            }
            for (sensor, axis), pair in tests.items()
        ],
        "nearer": sum(abs(np.log(new.nis)) < abs(np.log(old.nis)) for old, new in both if old and new),
        "white": [
            sum(one is not None and one.whiteness > _WHITE for one in some)
            for some in zip(*tests.values(), strict=True)
        ],
        "white_p": _WHITE,
        "fusion": toml.text({**toml.builtins(found.config), "arm": ARM_FILE}),
        "arm": found.config.arm.to_toml(),
    }
    return render("tuning.html", content)


def _tests(before: Estimates, after: Estimates) -> dict[tuple[str, str], _Pair]:
    """The tests of the innovations by sensor and axis, where there are any before or after."""
    pairs = [(sensor, axis) for axis in after.axes for sensor in after.measurements.sensors]
    tests = {pair: (consistency(before, *pair), consistency(after, *pair)) for pair in pairs}
    return {pair: both for pair, both in tests.items() if any(both)}


def _notes(summary: TuningSummary) -> list[str]:
    together = [formatting.together(pair) for pair in summary.correlations]
    orders = [f"{axis}: {why}" for axis, why in summary.orders.items()]
    return [*summary.notes, *summary.not_identifiable, *together, *orders]


def _parameter(one: Fitted, interrupted: bool) -> Mapping[str, Any]:
    low, high = ("…" if end is None else f"{end:.4g}" for end in one.ci95)
    before = "–" if one.before is None else f"{one.before:.4g}"
    interval = "–" if interrupted and one.ci95 == (None, None) else f"{low} to {high}"
    return {"key": one.key, "numbers": [before, f"{one.value:.4g}", interval], "notes": one.notes}


def _check(one: Check) -> Mapping[str, Any]:
    states = (one.before, one.after)
    names = list(dict.fromkeys(name for state in states for name in state.sensors))
    pairs = [[state.sensors.get(name) for state in states] for name in names]
    return {
        "run": f"{one.run} from\u00a0{one.since_s:.1f}\u00a0s" if one.since_s else one.run,
        "axis": one.axis,
        "sensors": [
            names,
            [formatting.change([None if check is None else check.nis for check in pair], ".2f") for pair in pairs],
            [
                formatting.change([None if check is None else check.correlation for check in pair], "+z.2f")
                for pair in pairs
            ],
        ],
        "numbers": [
            formatting.change([state.rejected for state in states], "d"),
            formatting.change([state.rmse_mm for state in states], ".3f"),
            formatting.change([state.coverage for state in states], ".3f"),
        ],
        "verdict": one.verdict,
        "worse": one.worse,
    }


def _contains(interval: tuple[float | None, float | None], value: float | None) -> bool:
    low, high = interval
    return value is None or ((low is None or low <= value) and (high is None or value <= high))


def _sentence(sensor: str, axis: str, tests: _Pair) -> str:
    """NIS and whiteness of one sensor on one axis, before and after."""
    nis = formatting.change([None if one is None else one.nis for one in tests], ".2f")
    white = " → ".join("–" if one is None else formatting.p_value(one.whiteness) for one in tests)
    after = tests[1]
    expected = "" if after is None else f" (expected {after.nis_band[0]:.2f} to {after.nis_band[1]:.2f})"
    return f"{axis}, {sensor}: NIS {nis}{expected}; whiteness p {white}."


_COLUMNS = 5  # of profiles
_WIDTH = 11.0  # inch; as wide as a page
_TITLE = 32  # letters over a panel
_TICKS = 3
_WITHIN_REACH = 4.0  # last over first of a log scale, up to which its ticks are evenly spaced
_DECADES = 100.0  # likewise, beyond which only decades have ticks
_SMOOTH = 100  # points of its curve
_DEEPEST = -6.2  # of a profile; what lies below −5 has room for the number before


def profile_figure(found: Sequence[Profile], fitted: Mapping[str, Fitted]) -> str:
    """Draw the log-likelihood along each parameter, with its 95 % interval and its value before, as SVG text."""
    rows = -(-len(found) // _COLUMNS)
    with drawing(_COLUMNS, rows, width=_WIDTH, height=1.95, room=(0.45, 0.3, 0.42)) as sheet:
        for axes, one in zip(sheet.axes, found, strict=False):
            _profile(axes, one, fitted[one.key])
        for axes in sheet.axes[len(found) :]:
            axes.set_visible(False)
        for axes in sheet.axes[::_COLUMNS]:
            axes.set_ylabel("log-likelihood")
    return sheet.svg


def innovation_figure(before: Estimates, after: Estimates, sensor: str, axis: str) -> str:
    """Draw a sensor's normalised innovations on an axis before and after, with autocorrelations, as SVG text."""
    colour = colours.sensor_colours(after.measurements.sensors)[sensor]
    with drawing(3, width=_WIDTH, height=2.2, ratios=(2.2, 2.2, 1.0), room=(0.6, 0.45, 0.25)) as sheet:
        *series, correlation = sheet.axes
        highest = 4.0
        for number, (axes, est) in enumerate(zip(series, (before, after), strict=True)):
            measurements = est.measurements.of(sensor, axis)
            fused = measurements.where(measurements.outcome == Outcome.FUSED)
            normalised = fused.innovation / fused.innovation_sd
            highest = max(highest, 1.05 * float(np.abs(normalised).max(initial=0.0)))
            axes.plot(fused.time, normalised, ".", ms=1.5, color=(colours.COMMAND, colour)[number], rasterized=True)
            axes.axhspan(-Z95, Z95, color=colours.ESTIMATE, alpha=0.15, lw=0)
            axes.set_title(f"{('before', 'after')[number]}: {_cut(axis)}, {_cut(sensor)}", loc="left")
            axes.set_xlabel("time since the first command [s]")
        for axes in series:
            axes.set_ylim(-highest, highest)
            axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
        series[0].set_ylabel("innovation / sd")
        tests = [consistency(est, sensor, axis) for est in (before, after)]
        _correlations(correlation, tests, (colours.COMMAND, colour))
    return sheet.svg


def _profile(axes: Axes, one: Profile, fitted: Fitted) -> None:
    low, high = float(one.values[0]), float(one.values[-1])
    if one.log:
        axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.set_ylim(_DEEPEST, max(0.5, 1.1 * float(one.drop.max())))
    ends = [edge if end is None else end for end, edge in zip(fitted.ci95, (low, high), strict=True)]
    axes.axvspan(*ends, color=colours.ESTIMATE, alpha=0.15, lw=0)
    axes.axhline(-0.5 * Z95**2, color=colours.COMMAND, lw=0.8, ls="--")
    axes.plot(*_smooth(one), color=colours.ESTIMATE, lw=1.2)
    if fitted.before is not None:
        _before(axes, fitted.before, low, high)
    wide = high / low if one.log else 1.0
    subs = (1.0,) if wide > _DECADES else (1.0, 3.0)
    axes.xaxis.set_major_locator(MaxNLocator(_TICKS) if wide < _WITHIN_REACH else LogLocator(subs=subs))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%.4g"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_locator(FixedLocator([-4.0, -2.0, 0.0]))
    axes.tick_params(labelsize=8)
    parts = one.key.split(".")
    axes.set_title("\n".join(_cut(".".join(half)) for half in (parts[:2], parts[2:])), loc="left", fontsize=8)


def _smooth(one: Profile) -> tuple[FloatArray, FloatArray]:
    """A curve through a profile's points: the root of its drop is nearly a straight line."""
    peak = int(np.argmax(one.drop))
    root: FloatArray = np.sqrt(one.drop[peak] - one.drop) * np.sign(np.arange(len(one.drop)) - peak)
    places: FloatArray = np.log(one.values) if one.log else one.values
    at = np.linspace(float(places[0]), float(places[-1]), _SMOOTH)
    return np.exp(at) if one.log else at, one.drop[peak] - np.interp(at, places, root) ** 2


def _before(axes: Axes, before: float, low: float, high: float) -> None:
    """Draw a tick at the value before, or an arrow and the value where it lies outside."""
    if low <= before <= high:
        axes.plot([before, before], [_DEEPEST, -5.0], color=colours.REJECTED, lw=1.6)
        return
    left = before < low
    text = f"← {before:.4g}" if left else f"{before:.4g} →"
    at, side = (0.02, "left") if left else (0.98, "right")
    axes.text(at, 0.02, text, transform=axes.transAxes, ha=side, va="bottom", fontsize=8, color=colours.REJECTED)


def _cut(text: str) -> str:
    return text if len(text) <= _TITLE else f"{text[: _TITLE - 1]}…"


def _correlations(axes: Axes, tests: Sequence[Consistency | None], pair: Sequence[str]) -> None:
    """Draw autocorrelations before and after side by side, with the narrower band of the two."""
    highest, band = 0.12, 1.0
    for number, (one, colour) in enumerate(zip(tests, pair, strict=True)):
        if one is not None:
            lags = np.arange(1, len(one.correlation) + 1) + 0.2 * (2 * number - 1)
            axes.bar(lags, one.correlation, color=colour, width=0.4)
            highest = max(highest, 1.1 * float(np.abs(one.correlation).max(initial=0.0)))
            band = min(band, one.correlation_band)
    axes.axhspan(-band, band, color=colours.ESTIMATE, alpha=0.15, lw=0)
    axes.set_title("autocorrelation", loc="left")
    axes.set_xlabel("lag [measurements]")
    axes.set_xlim(0, LAGS + 1)
    axes.set_ylim(-highest, highest)
