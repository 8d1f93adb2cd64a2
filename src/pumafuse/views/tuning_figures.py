"""Figures of a tuning, as SVG text for a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FormatStrFormatter, LogLocator, MaxNLocator, NullLocator

from ..fusion.consistency import LAGS, Consistency, consistency
from ..fusion.estimates import Estimates
from ..fusion.score import Z95
from ..fusion.timeline import Outcome
from ..tune.profile import Profile
from ..tune.summary import Fitted
from . import style
from .sheet import drawing

_COLUMNS = 5  # of profiles
_WIDTH = 11.0  # inch; as wide as a page
_TITLE = 32  # letters over a panel
_TICKS = 3
_WITHIN_REACH = 4.0  # last over first of a log scale, up to which its ticks are evenly spaced
_DEEPEST = -6.2  # of a profile; what lies below −5 has room for the number before


def profiles(found: Sequence[Profile], fitted: Mapping[str, Fitted]) -> str:
    """How the log-likelihood drops along each parameter, with its 95 % interval and where it was before."""
    rows = -(-len(found) // _COLUMNS)
    with drawing(_COLUMNS, rows, width=_WIDTH, height=1.9) as sheet:
        for axes, one in zip(sheet.axes, found, strict=False):
            _profile(axes, one, fitted[one.key])
        for axes in sheet.axes[len(found) :]:
            axes.set_visible(False)
        for axes in sheet.axes[::_COLUMNS]:
            axes.set_ylabel("log-likelihood")
    return sheet.svg


def innovations(before: Estimates, after: Estimates, sensor: str, axis: str) -> str:
    """One sensor's normalised innovations on one axis before and after, and their autocorrelations."""
    colour = style.sensor_colours(after.readings.sensors)[sensor]
    with drawing(3, width=_WIDTH, height=2.2, ratios=(2.2, 2.2, 1.0)) as sheet:
        *series, correlation = sheet.axes
        highest = 4.0
        for number, (axes, est) in enumerate(zip(series, (before, after), strict=True)):
            readings = est.readings.of(sensor, axis)
            fused = readings.where(readings.outcome == Outcome.FUSED)
            normalised = fused.innovation / fused.innovation_sd
            highest = max(highest, 1.05 * float(np.abs(normalised).max(initial=0.0)))
            axes.plot(fused.time, normalised, ".", ms=1.5, color=(style.COMMAND, colour)[number], rasterized=True)
            axes.axhspan(-Z95, Z95, color=style.ESTIMATE, alpha=0.15, lw=0)
            axes.set_title(f"{axis}, {sensor}: {('before', 'after')[number]}", loc="left")
            axes.set_xlabel("time since the first command [s]")
            tests = consistency(est, sensor, axis)
            if tests is not None:
                shade = (style.COMMAND, colour)[number]
                _correlation(correlation, tests, shade, ("before", "after")[number], 0.2 * (2 * number - 1))
        for axes in series:
            axes.set_ylim(-highest, highest)
        series[0].set_ylabel("innovation / sd")
        correlation.set_title("autocorrelation", loc="left")
        correlation.set_xlabel("lag [readings]")
        correlation.set_xlim(0, LAGS + 1)
        correlation.legend(frameon=False, fontsize=8)
    return sheet.svg


def _profile(axes: Axes, one: Profile, fitted: Fitted) -> None:
    low, high = float(one.values[0]), float(one.values[-1])
    if one.log:
        axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.set_ylim(_DEEPEST, 0.5)
    ends = [edge if end is None else end for end, edge in zip(fitted.ci95, (low, high), strict=True)]
    axes.axvspan(*ends, color=style.ESTIMATE, alpha=0.15, lw=0)
    axes.axhline(-0.5 * Z95**2, color=style.COMMAND, lw=0.8, ls="--")
    axes.plot(one.values, one.drop, color=style.ESTIMATE, lw=1.2)
    if fitted.before is not None:
        _before(axes, fitted.before, low, high)
    axes.xaxis.set_major_locator(FixedLocator(_ticks(low, high, one.log)))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%.4g"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_locator(FixedLocator([-4.0, -2.0, 0.0]))
    axes.tick_params(labelsize=8)
    parts = one.key.split(".")
    axes.set_title("\n".join(_cut(".".join(half)) for half in (parts[:2], parts[2:])), loc="left", fontsize=8)


def _before(axes: Axes, before: float, low: float, high: float) -> None:
    """A tick at the number before, or its value and the way to it where it lies outside."""
    if low <= before <= high:
        axes.plot([before, before], [_DEEPEST, -5.0], color=style.REJECTED, lw=1.6)
        return
    left = before < low
    text = f"← {before:.4g}" if left else f"{before:.4g} →"
    at, side = (0.02, "left") if left else (0.98, "right")
    axes.text(at, 0.02, text, transform=axes.transAxes, ha=side, va="bottom", fontsize=8, color=style.REJECTED)


def _ticks(low: float, high: float, log: bool) -> list[float]:
    """A few round numbers on a scale."""
    if log and high > _WITHIN_REACH * low:
        found = LogLocator(subs=(1.0, 2.0, 5.0)).tick_values(low, high)
    else:
        found = MaxNLocator(_TICKS).tick_values(low, high)
    within = [float(tick) for tick in found if low <= tick <= high]
    return within[:: max(-(-len(within) // (_TICKS + 1)), 1)]


def _cut(text: str) -> str:
    return text if len(text) <= _TITLE else f"{text[: _TITLE - 1]}…"


def _correlation(axes: Axes, tests: Consistency, colour: str, label: str, aside: float) -> None:
    lags = np.arange(1, len(tests.correlation) + 1)
    axes.bar(lags + aside, tests.correlation, color=colour, width=0.4, label=label)
    axes.axhspan(-tests.correlation_band, tests.correlation_band, color=style.ESTIMATE, alpha=0.1, lw=0)
