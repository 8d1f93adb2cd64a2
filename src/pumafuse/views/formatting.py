"""Numbers and their intervals as text for tables and pages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..identification.anova import Level
from ..identification.estimate import Estimate
from ..model.arm import ArmModel, Gain
from ..model.plants import PLANTS, FirstOrder
from ..toml import Interval
from ..units import MS, SCREEN, Kind

if TYPE_CHECKING:
    from ..tuning.identifiability import Correlation
    from ..tuning.summary import TuningSummary
    from ..tuning.validation import Check


def format_interval(value: float, interval: Interval | None, unit: float = 1.0) -> str:
    """``value ± half the interval``, both times ``unit``, rounded to two digits of the interval."""
    if interval is None or not np.isfinite(interval).all():
        return f"{value * unit:.4g}"
    half = 0.5 * (interval[1] - interval[0]) * unit
    digits = min(max(1 - int(np.floor(np.log10(half))), 0), 6) if half > 0.0 else 3
    return f"{value * unit:.{digits}f} ± {half:.{digits}f}"


def format_range(value: float, interval: Interval | None, unit: float = 1.0) -> str:
    """``value (low to high)``, all times ``unit``, to two digits of the interval; without it the value alone."""
    if interval is None:
        return f"{value * unit:.4g}"
    low, high = (end * unit for end in interval)
    ends = [end for end in (low, high, value * unit) if np.isfinite(end)]  # that of a plant may be anything
    width = max(max(ends) - min(ends), 1e-5 * abs(value * unit), 1e-12)
    digits = min(max(1 - int(np.floor(np.log10(width))), 0), 6)
    return f"{value * unit:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})".replace("inf", "∞")


def milliseconds(estimate: Estimate | None) -> str:
    """An estimate [s] with its interval in milliseconds; a dash without one."""
    return "–" if estimate is None else format_interval(estimate.value, estimate.ci95, MS)


def lag(arm: ArmModel) -> list[str]:
    """Which lag is meant of an arm, and what makes it depend on the motion, a sentence each."""
    return [
        "lag: behind the held command at constant velocity (dead time, plant and a gain that recovers); behind the path"
        f" through the commanded points it is T/2 = {0.5 * arm.update_period * MS:g} ms more",
        *arm.bends(),
    ]


def chosen_orders(orders: Mapping[str, str]) -> list[str]:
    """What was chosen for each axis, a line each, below one that says what the numbers are; none for none."""
    head = (
        "chosen, and in brackets what the alternative gains in log-likelihood less the penalty for its numbers (BIC):"
    )
    return [head, *(f"{axis}: {why}" for axis, why in orders.items())] if orders else []


def limits(ci95: tuple[float | None, float | None], computed: bool = True) -> str:
    """The ends of an interval, … where nothing limits it; a dash where it was not computed."""
    low, high = ("…" if end is None else f"{end:.4g}" for end in ci95)
    return f"{low} to {high}" if computed or ci95 != (None, None) else "–"


def fitted_rows(summary: TuningSummary) -> list[list[str]]:
    """Rows of the lags and the parameters: name, before, fitted, 95 % interval, and what to know of it."""
    lags = [
        [f"lag of {axis}, ms", f"{lag.before_ms:.4g}", f"{lag.lag_ms:.4g}", limits(lag.lag_ms_ci95), ""]
        for axis, lag in summary.lags.items()
    ]
    return lags + [
        [
            parameter.key,
            "–" if parameter.before is None else f"{parameter.before:.4g}",
            f"{parameter.value:.4g}",
            limits(parameter.ci95, not summary.interrupted),
            parameter.notes,
        ]
        for parameter in summary.parameters
    ]


def p_value(value: float | None) -> str:
    """A p-value with three decimals; a dash without one."""
    return "–" if value is None else "< 0.001" if value < 1e-3 else f"{value:.3f}"


def level(level: Level) -> str:
    """A level of a factor with mean, standard deviation and number of its trials."""
    spread = "" if level.sd is None else f" ± {level.sd:.2g}"
    return f"{level.level}: {level.mean:.4g}{spread} ({level.trials})"


def plant(plant_shape: PLANTS, first: str = "τ {} ms", second: str = "ω {} rad/s, ζ {}") -> str:
    """A plant's parameters with their intervals, in the words for its order."""
    if isinstance(plant_shape, FirstOrder):
        return first.format(format_interval(plant_shape.time_constant, plant_shape.time_constant_ci95, MS))
    omega = format_interval(plant_shape.natural_frequency, plant_shape.natural_frequency_ci95)
    return second.format(omega, format_interval(plant_shape.damping, plant_shape.damping_ci95))


def gain(gain: Gain) -> str:
    """The gain K as a line over the speed s."""
    line = format_interval(gain.intercept, gain.intercept_ci95)
    return f"{line} + ({format_interval(gain.slope, gain.slope_ci95)}) s" if gain.slope else line


def change(values: Sequence[float | None], form: str) -> str:
    """Numbers before and after, joined by an arrow; ``form`` is a format specification."""
    return " → ".join("–" if value is None else format(value, form) for value in values)


def change_of_positions(values: Sequence[float | None], kind: Kind) -> str:
    """Positions [m or rad] before and after, joined by an arrow, with the unit of the screen."""
    screen = SCREEN[kind]
    shown = change([None if value is None else value * screen.scale for value in values], ".3f")
    return shown if None in values else f"{shown} {screen.unit}"


class Validated(NamedTuple):
    """One axis of one run before and after a tuning, as text; of its sensors in a list each."""

    run: str
    axis: str
    sensors: list[str]
    nis: list[str]
    correlation: list[str]
    rejected: str
    rmse: str
    coverage: str


def validation_rows(check: Check) -> Validated:
    """The numbers of a validation, joined by arrows."""
    states = (check.before, check.after)
    names = list(dict.fromkeys(name for state in states for name in state.sensors))

    def changes(number: str, form: str) -> list[str]:
        pairs = ([getattr(state.sensors.get(name), number, None) for state in states] for name in names)
        return [change(pair, form) for pair in pairs]

    return Validated(
        run=f"{check.run} from {check.since_s:.1f} s" if check.since_s else check.run,
        axis=check.axis,
        sensors=names,
        nis=changes("nis", ".2f"),
        correlation=changes("correlation", "+z.2f"),
        rejected=change([state.rejected for state in states], "d"),
        rmse=change_of_positions([state.rmse for state in states], check.kind),
        coverage=change([state.coverage for state in states], ".3f"),
    )


def together(pair: Correlation) -> str:
    """Two correlated parameters, which the measurements identify only together."""
    return f"{pair.first} and {pair.second} go together: correlation {pair.correlation:+.2f}"
