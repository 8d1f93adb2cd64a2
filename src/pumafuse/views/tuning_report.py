"""The report of a tuning: one HTML page that loads nothing, a sentence above each figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from markupsafe import Markup

from .. import toml
from ..fusion.config import ARM_FILE
from ..fusion.consistency import Consistency, consistency
from ..fusion.estimates import Estimates
from ..logs.run import Run
from ..tuning.intervals import Profile, profiles
from ..tuning.summary import Fitted, TuningSummary
from ..tuning.tune import Tuning
from ..tuning.validation import Check, fused
from . import formatting, tuning_figures
from .canvas import render

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
    drawn = {} if summary.interrupted else _profiles(found)  # a search that did not end has no peak to look from
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
        "profiles": [Markup(tuning_figures.profiles(some, fitted)) for some in drawn.values()],
        "validation": [_check(one) for one in summary.validation or ()],
        "innovations": [
            {
                "figure": Markup(tuning_figures.innovations(before, after, sensor, axis)),
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


def _profiles(found: Tuning) -> dict[str | None, list[Profile]]:
    """The profiles of each axis, and under None those of shared parameters."""
    drawn: dict[str | None, list[Profile]] = {}
    intervals = {one.key: one.ci95 for one in found.summary.parameters}
    for stage in found.stages:
        for one in profiles(stage, intervals):
            drawn.setdefault(one.axis, []).append(one)
    return drawn


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
