"""A tuning as one HTML page that needs nothing else, each figure with its sentence."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from markupsafe import Markup

from .. import toml
from ..errors import PumafuseWarning
from ..fusion.config import ARM_FILE, FusionConfig
from ..fusion.consistency import Consistency, consistency
from ..fusion.estimates import Estimates
from ..fusion.offline import fuse
from ..logs.run import Run
from ..tuning.profile import Profile, profiles
from ..tuning.summary import Fitted, TuningSummary
from ..tuning.tune import Tuning
from ..tuning.validate import Check
from . import formatting as words
from . import tuning_figures
from .canvas import render

_Tests: TypeAlias = tuple[Consistency | None, Consistency | None]  # before and after
_WHITE = 0.01  # p-value from which innovations pass for white


def page(found: Tuning, runs: Sequence[Run]) -> str:
    """The text of ``report.html``: what was learnt, how sure it is, and whether it holds.

    Args:
        found: What was learnt.
        runs: From these; innovations are shown on the first.
    """
    summary = found.summary
    fitted = {one.key: one for one in summary.parameters}
    drawn = {} if summary.interrupted else _profiles(found)  # a search that did not end has no peak to look from
    before, after = (_fused(runs[0], config) for config in (found.before, found.config))
    met = _met(before, after)
    content = {
        "title": f"Tuning: {', '.join(summary.runs)}",
        "summary": _summary(summary),
        "notes": _notes(summary),
        "parameters": [_parameter(one, summary.interrupted) for one in summary.parameters],
        "profiles": [Markup(tuning_figures.profiles(some, fitted)) for some in drawn.values()],
        "validation": [_check(one) for one in summary.validation or ()],
        "innovations": [
            {
                "figure": Markup(tuning_figures.innovations(before, after, sensor, axis)),
                "says": _says_tests(sensor, axis, tests),
            }
            for (sensor, axis), tests in met.items()
        ],
        "says": {
            "parameters": _says_parameters(summary),
            "profiles": _says_profiles([one for some in drawn.values() for one in some], fitted),
            "validation": _says_validation(summary.validation or ()),
            "innovations": _says_innovations(runs[0].name, list(met.values())),
        },
        "fusion": toml.text({**toml.builtins(found.config), "arm": ARM_FILE}),
        "arm": found.config.arm.to_toml(),
    }
    return render("tuning.html", content)


def _profiles(found: Tuning) -> dict[str | None, list[Profile]]:
    """The profiles of each axis, and under None those of what all axes share."""
    drawn: dict[str | None, list[Profile]] = {}
    for lesson in found.lessons:
        for one in profiles(lesson, found.summary.parameters):
            drawn.setdefault(one.axis, []).append(one)
    return drawn


def _fused(run: Run, config: FusionConfig) -> Estimates:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PumafuseWarning)  # they are the run's, and `fuse` says them
        return fuse(run, config)


def _met(before: Estimates, after: Estimates) -> dict[tuple[str, str], _Tests]:
    """By sensor and axis, how the innovations fit what was expected; where there are any, before or after."""
    pairs = [(sensor, axis) for axis in after.axes for sensor in after.measurements.sensors]
    tests = {pair: (consistency(before, *pair), consistency(after, *pair)) for pair in pairs}
    return {pair: both for pair, both in tests.items() if any(both)}


def _summary(summary: TuningSummary) -> str:
    runs = f"{len(summary.runs)} run{'s' if len(summary.runs) > 1 else ''} ({', '.join(summary.runs)})"
    taught = "" if summary.teacher is None else f", with {summary.teacher} as the teacher"
    held = f"; held as asked: {', '.join(summary.hold)}" if summary.hold else ""
    gains = "; ".join(
        f"{axis} {one.before:.1f} → {one.after:.1f} ({one.components} measurements)"
        for axis, one in summary.likelihood.items()
    )
    return f"Fitted to {runs}{taught}: {', '.join(summary.fit)}{held}. Log-likelihood before → after: {gains}."


def _notes(summary: TuningSummary) -> list[str]:
    together = [words.together(pair) for pair in summary.correlations]
    orders = [f"{axis}: {why}" for axis, why in summary.orders.items()]
    return [*summary.notes, *summary.held, *together, *orders]


def _parameter(one: Fitted, interrupted: bool) -> Mapping[str, Any]:
    low, high = ("…" if end is None else f"{end:.4g}" for end in one.ci95)
    before = "–" if one.before is None else f"{one.before:.4g}"
    interval = "–" if interrupted and one.ci95 == (None, None) else f"{low} to {high}"
    return {"key": one.key, "numbers": [before, f"{one.value:.4g}", interval], "said": one.said}


def _check(one: Check) -> Mapping[str, Any]:
    states = (one.before, one.after)
    names = list(dict.fromkeys(name for state in states for name in state.sensors))
    pairs = [[state.sensors.get(name) for state in states] for name in names]
    return {
        "run": f"{one.run} from\u00a0{one.since_s:.1f}\u00a0s" if one.since_s else one.run,
        "axis": one.axis,
        "sensors": [
            names,
            [words.change([None if check is None else check.nis for check in pair], ".2f") for pair in pairs],
            [words.change([None if check is None else check.correlation for check in pair], "+z.2f") for pair in pairs],
        ],
        "numbers": [
            words.change([state.rejected for state in states], "d"),
            words.change([state.rmse_mm for state in states], ".3f"),
            words.change([state.coverage for state in states], ".3f"),
        ],
        "verdict": one.verdict,
        "worse": one.worse,
    }


def _says_parameters(summary: TuningSummary) -> str:
    if not summary.parameters:
        return "The search was interrupted before anything was learnt."
    known = [one for one in summary.parameters if one.before is not None]
    outside = sum(not _holds(one.ci95, one.before) for one in known if one.before is not None)
    none = sum(one.value == 0.0 for one in summary.parameters)
    limitless = not summary.interrupted and any(None in one.ci95 for one in summary.parameters)
    return (
        f"{len(summary.parameters)} numbers were fitted, each in the unit that its name ends with. {outside} of the"
        f" {len(known)} that were there before lay outside the interval that the measurements leave them"
        + (f"; {none} turned out to be none (0)." if none else ".")
        + (" An end marked … is not limited by the measurements." if limitless else "")
    )


def _holds(interval: tuple[float | None, float | None], value: float) -> bool:
    low, high = interval
    return (low is None or low <= value) and (high is None or value <= high)


def _says_profiles(drawn: Sequence[Profile], fitted: Mapping[str, Fitted]) -> str:
    """What the curves are, and which number is known best and which worst."""
    share: dict[str, float] = {}
    for one in drawn:
        low, high = fitted[one.key].ci95
        if one.log and low is not None and high is not None:
            share[one.key] = 0.5 * (high - low) / fitted[one.key].value
    best, worst = (choose(share, key=share.__getitem__, default="") for choose in (min, max))
    return (
        "How far the log-likelihood drops as one number moves and the others follow it. It has dropped by 1.92 (dashed)"
        " at the ends of the 95 % interval (shaded); red is the number before, an arrow points to it where it is"
        " farther away."
        + (
            f" Of noises and plants, {best} is known best (± {share[best]:.0%}) and {worst} worst"
            f" (± {share[worst]:.0%})."
            if best != worst
            else ""
        )
    )


def _says_validation(checks: Sequence[Check]) -> str:
    if not checks:
        return ""
    axes = ", ".join(f"{one.axis} is {one.verdict.partition(':')[0]}" for one in checks)
    return (
        f"On measurements that nothing had been learnt from, {axes}. NIS should be 1, the lag-1 correlation of innovations"
        " 0, and coverage, the share of errors within the 95 % band, 0.95."
        + (" After that these measurements were learnt from too." if any(one.since_s for one in checks) else "")
    )


def _says_tests(sensor: str, axis: str, tests: _Tests) -> str:
    nis = words.change([None if one is None else one.nis for one in tests], ".2f")
    white = " → ".join("–" if one is None else words.p_value(one.whiteness) for one in tests)
    after = tests[1]
    expected = "" if after is None else f" (expected {after.nis_band[0]:.2f} to {after.nis_band[1]:.2f})"
    return f"{axis}, {sensor}: NIS {nis}{expected}; whiteness p {white}."


def _says_innovations(run: str, met: Sequence[_Tests]) -> str:
    both = [(before, after) for before, after in met if before is not None and after is not None]
    nearer = sum(abs(np.log(after.nis)) < abs(np.log(before.nis)) for before, after in both)
    white = " → ".join(
        f"{sum(one is not None and one.whiteness > _WHITE for one in some)}" for some in zip(*met, strict=True)
    )
    return (
        f"How far each measurement of {run} lay from what was expected of it, over how far it was expected to: 95 % should"
        " lie in the band, and none should tell the next: their autocorrelations (grey before, coloured after) should"
        f" lie in the band too. NIS, their mean square, should be 1 and came nearer to it for {nearer} of {len(met)};"
        f" {white} of {len(met)} pass for white (p above {_WHITE:g})."
    )
