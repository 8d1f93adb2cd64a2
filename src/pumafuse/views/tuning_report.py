"""The report of a tuning: one HTML page that loads nothing, a sentence above each figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FormatStrFormatter, LogLocator, MaxNLocator, NullLocator

from ..arrays import FloatArray
from ..fusion.consistency import Consistency, consistency
from ..fusion.estimates import Estimates
from ..fusion.score import Z95
from ..logs.run import Run
from ..tuning.intervals import Profile
from ..tuning.summary import Fitted, TuningSummary
from ..tuning.tune import Tuning
from ..tuning.validation import fused
from . import colours, formatting
from .canvas import drawing, render, svg
from .figures import draw_correlations, draw_innovations

_Pair: TypeAlias = tuple[Consistency | None, Consistency | None]  # before and after
_WHITE = 0.01  # p-value from which innovations count as white
_COLUMNS = 5  # of profiles
_WIDTH = 11.0  # inch; as wide as a page
_TITLE = 32  # letters over a panel
_WITHIN_REACH = 10.0  # last over first of a log scale, up to which its ticks are evenly spaced
_SMOOTH = 100  # points of a profile's curve
_DEEPEST = -6.2  # of a profile; what lies below −5 has room for the number before


def page(tuning: Tuning, runs: Sequence[Run]) -> str:
    """The text of ``report.html``: the fitted parameters, their intervals, and the validation."""
    summary = tuning.details
    fitted = {parameter.key: parameter for parameter in summary.parameters}
    before, after = (fused(runs[0], config) for config in (tuning.before, tuning.config))
    pairs = [(sensor, axis) for axis in after.axes for sensor in after.measurements.sensors]
    tests = {pair: (consistency(before, *pair), consistency(after, *pair)) for pair in pairs}
    tests = {pair: both for pair, both in tests.items() if any(both)}
    intervals = tuning.conf_int()
    configured = [
        (parameter.before, *intervals[parameter.key])
        for parameter in summary.parameters
        if parameter.before is not None
    ]
    validated = [check.axis for check in summary.validation or ()]
    content = {
        "answer": _answer(summary),
        "axes": [_axis(summary, axis) for axis in dict.fromkeys([*summary.lags, *validated])],
        "predicted": any(check.after.rmse is None for check in summary.validation or ()),
        "tuning": summary,
        "notes": [
            *summary.notes,
            *summary.not_identifiable,
            *map(formatting.together, summary.correlations),
            *formatting.chosen_orders(summary.orders),
        ],
        "lag_words": formatting.lag(tuning.config.arm),
        "fitted": formatting.fitted_rows(summary),
        "config": tuning.config,
        "known": configured,
        "outside": sum(not low <= value <= high for value, low, high in configured),
        "zero": sum(parameter.value == 0.0 for parameter in summary.parameters),
        "open": not summary.interrupted and any(None in parameter.ci95 for parameter in summary.parameters),
        "two_maxima": [profile.key for profile in tuning.profiles if profile.bimodal],
        "profiles": profile_figure(tuning.profiles, fitted) if tuning.profiles else None,
        "validation": [(formatting.validation_rows(check), check) for check in summary.validation or ()],
        "innovations": [
            (innovation_figure(before, after, *pair, both), _sentence(*pair, both)) for pair, both in tests.items()
        ],
        "nearer": sum(abs(np.log(new.nis)) < abs(np.log(old.nis)) for old, new in tests.values() if old and new),
        "white": [
            sum(test is not None and test.whiteness > _WHITE for test in some)
            for some in zip(*tests.values(), strict=True)
        ],
        "white_p": _WHITE,
    }
    return render("tuning.html", content)


def _answer(summary: TuningSummary) -> str:
    """What the tuning is good for, in a sentence or two."""
    checks = summary.validation
    if not checks:
        gain = sum(likelihood.after - likelihood.before for likelihood in summary.likelihood.values())
        return f"Not validated: the log-likelihood of what it was fitted on rose by {gain:.1f}."
    better, worse = ([check for check in checks if check.change == change] for change in ("better", "worse"))
    holding = sum(check.holds for check in checks)
    axes = "axis" if len(checks) == 1 else "axes"
    answer = f"Better on {len(better)} of {len(checks)} {axes}, on measurements that nothing had been fitted on"
    answer += f", worse on {len(worse)}" if worse else ""
    return f"{answer}. The error bars hold on {holding} of {len(checks)}."


def _axis(summary: TuningSummary, axis: str) -> Mapping[str, Any]:
    """An axis's error and lag before and after, and what the validation says."""
    check = next((check for check in summary.validation or () if check.axis == axis), None)
    error, verdict, late = "–", "not validated", "–"
    if check is not None:
        pair = (check.before, check.after)
        verdict = check.change
        if verdict == "better" and not check.holds:
            verdict = "better, but its error bars do not hold"
        if check.after.rmse is not None:
            error = formatting.change_of_positions([state.rmse for state in pair], check.kind)
        else:
            skills = {
                name: [getattr(state.sensors.get(name), "skill", None) for state in pair]
                for name, sensor in check.after.sensors.items()
                if sensor.skill is not None
            }
            error = "; ".join(f"{name} {formatting.change(both, '.2f')}" for name, both in skills.items()) or "–"
    if lag := summary.lags.get(axis):
        late = f"{lag.before_ms:.4g} → {lag.lag_ms:.4g} ({formatting.limits(lag.lag_ms_ci95)})"
    doubtful = check is not None and (check.worse or not check.holds)
    return {"axis": axis, "numbers": [error, late], "verdict": verdict, "doubtful": doubtful}


def _sentence(sensor: str, axis: str, tests: _Pair) -> str:
    """NIS and whiteness of one sensor on one axis, before and after."""
    nis = formatting.change([None if test is None else test.nis for test in tests], ".2f")
    white = " → ".join("–" if test is None else formatting.p_value(test.whiteness) for test in tests)
    after = tests[1]
    expected = "" if after is None else f" (expected {after.nis_band[0]:.2f} to {after.nis_band[1]:.2f})"
    return f"{axis}, {sensor}: NIS {nis}{expected}; whiteness p {white}."


def profile_figure(profiles: Sequence[Profile], fitted: Mapping[str, Fitted]) -> Markup:
    """Draw the log-likelihood along each parameter, with its 95 % interval and its value before, as SVG text."""
    rows = -(-len(profiles) // _COLUMNS)
    with drawing(_COLUMNS, rows, width=_WIDTH, height=1.95) as figure:
        for axes, profile in zip(figure.axes, profiles, strict=False):
            _draw_profile(axes, profile, fitted[profile.key])
        for axes in figure.axes[len(profiles) :]:
            axes.set_visible(False)
        for axes in figure.axes[::_COLUMNS]:
            axes.set_ylabel("log-likelihood")
        return svg(figure)


def innovation_figure(before: Estimates, after: Estimates, sensor: str, axis: str, tests: _Pair) -> Markup:
    """Draw a sensor's normalised innovations on an axis before and after, with autocorrelations, as SVG text."""
    pair = (colours.COMMAND, colours.sensor_colours(after.measurements.sensors)[sensor])
    with drawing(3, width=_WIDTH, height=2.2, ratios=(2.2, 2.2, 1.0)) as figure:
        *series, correlation = figure.axes
        for axes, when, est, colour in zip(series, ("before", "after"), (before, after), pair, strict=True):
            draw_innovations(axes, est, sensor, axis, colour)
            axes.set_title(f"{when}: {axis}, {sensor}", loc="left")
            axes.set_xlabel("time since the first command [s]")
        highest = max(4.0, *(abs(end) for axes in series for end in axes.get_ylim()))
        for axes in series:
            axes.set_ylim(-highest, highest)
            axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
        series[0].set_ylabel("innovation / sd")
        draw_correlations(correlation, tests, pair)
        correlation.set_title("autocorrelation", loc="left")
        correlation.set_xlabel("lag [measurements]")
        return svg(figure)


def _draw_profile(axes: Axes, profile: Profile, fitted: Fitted) -> None:
    low, high = float(profile.values[0]), float(profile.values[-1])
    if profile.log:
        axes.set_xscale("log")
    axes.set(xlim=(low, high), ylim=(_DEEPEST, max(0.5, 1.1 * float(profile.drop.max()))))
    ends = [edge if end is None else end for end, edge in zip(fitted.ci95, (low, high), strict=True)]
    axes.axvspan(*ends, color=colours.ESTIMATE, alpha=0.15, lw=0)
    axes.axhline(-0.5 * Z95**2, color=colours.COMMAND, lw=0.8, ls="--")
    axes.plot(*_smooth(profile), color=colours.ESTIMATE, lw=1.2)
    before = fitted.before
    if before is not None and low <= before <= high:
        axes.plot([before, before], [_DEEPEST, -5.0], color=colours.REJECTED, lw=1.6)
    elif before is not None:
        at, side, text = (0.02, "left", f"← {before:.4g}") if before < low else (0.98, "right", f"{before:.4g} →")
        axes.text(at, 0.02, text, transform=axes.transAxes, ha=side, va="bottom", fontsize=8, color=colours.REJECTED)
    wide = profile.log and high > _WITHIN_REACH * low
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)) if wide else MaxNLocator(3))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%.4g"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_locator(FixedLocator([-4.0, -2.0, 0.0]))
    axes.tick_params(labelsize=8)
    parts = profile.key.split(".")
    axes.set_title("\n".join(_cut(".".join(half)) for half in (parts[:2], parts[2:])), loc="left", fontsize=8)


def _smooth(profile: Profile) -> tuple[FloatArray, FloatArray]:
    """A curve through a profile's points: the root of its drop is nearly a straight line."""
    peak = int(np.argmax(profile.drop))
    root: FloatArray = np.sqrt(profile.drop[peak] - profile.drop) * np.sign(np.arange(len(profile.drop)) - peak)
    places: FloatArray = np.log(profile.values) if profile.log else profile.values
    at = np.linspace(float(places[0]), float(places[-1]), _SMOOTH)
    return np.exp(at) if profile.log else at, profile.drop[peak] - np.interp(at, places, root) ** 2


def _cut(text: str) -> str:
    return text if len(text) <= _TITLE else f"{text[: _TITLE - 1]}…"
