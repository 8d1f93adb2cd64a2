"""``tuning.json``: the result of a tuning. The classes here are its schema.

Fitted parameters are in the units of their keys; what else belongs to an axis is in SI here and in its units there.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType

import msgspec
import numpy as np

from .. import toml
from ..fusion.config import SD_BOUNDS, FusionConfig
from ..fusion.score import Z95
from ..logs.run import Run
from ..units import MS, Kind
from .identifiability import Correlation
from .intervals import ConfidenceInterval, Distances, lag_slopes
from .parameters import Parameter
from .plain import LONGEST
from .validation import Check, fused

_FROM_PRIOR = 0.8  # of the prior's interval, from which the measurements say hardly anything


class Fitted(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter that was fitted, in the unit of its key.

    Attributes:
        key: Its name: table, axis or sensor, and key as in ``fusion.toml`` or ``arm.toml``.
        before: As configured; null where it was not.
        value: As fitted.
        ci95: Its 95 % interval; null at an end that the measurements do not limit.
        profiled: Whether the interval is from the profile of the likelihood, not only from its curvature.
        notes: What to know of it; empty if nothing.
    """

    key: str
    before: float | None
    value: float
    ci95: tuple[float | None, float | None]
    profiled: bool
    notes: str


class FittedLag(msgspec.Struct, frozen=True, kw_only=True):
    """An axis's total lag behind the held command at constant, slow velocity; behind the commanded path it is T/2 more.

    Attributes:
        before_ms: As configured.
        lag_ms: As fitted.
        lag_ms_ci95: Its 95 % interval, the latencies that are fixed being right; null at an end that the measurements
            do not limit.
    """

    before_ms: float
    lag_ms: float
    lag_ms_ci95: tuple[float | None, float | None]


class FoundBias(toml.Reported, frozen=True, kw_only=True):
    """The bias of a sensor on an axis in a run, in the log's coordinates."""

    run: str  # the run's name
    sensor: str  # the sensor
    axis: str  # the axis
    kind: Kind  # whether that is a length or an angle
    bias: float = msgspec.field(name="bias_mm")  # the bias [m or rad]
    sd: float = msgspec.field(name="sd_mm")  # its standard deviation [m or rad]


class AxisLikelihood(msgspec.Struct, frozen=True, kw_only=True):
    """Log-likelihood of an axis's components in the runs fitted on, with positions in mm or mrad."""

    components: int  # the number of components
    before: float  # under the configuration as given
    after: float  # under the tuned one


class TuningSummary(msgspec.Struct, frozen=True, kw_only=True):
    """``tuning.json``.

    Attributes:
        pumafuse: Version that wrote it.
        runs: Names of the runs fitted on.
        parts: Of those that only a part was used of, from and to [s after the first command]; null: from or to the end.
        commands: By run, how many rows of its commands are ``used``, and how many are left out for what.
        rows: By run and sensor, how many rows the filter decides on (``fused``), and how many are left out for what.
        fit: The kinds of parameters fitted.
        fixed: Names that were fixed, as asked.
        trusted: The trusted sensor, if there is one.
        sd_prior: Whether sensors' noises were believed to be what second differences show, within a factor of 2.
        interrupted: Whether it was stopped before the end; the numbers are the best until then.
        likelihood: By axis.
        lags: Of each axis of whose arm anything was fitted that the lag depends on.
        parameters: The fitted parameters.
        biases: Of the sensors that have one to estimate.
        correlations: Pairs beyond ± 0.9.
        not_identifiable: Combinations that the measurements do not determine, a sentence each.
        orders: What was chosen for each axis: the order of its plant, its gain, its disturbance, its delay; in brackets
            the log-odds of the alternative, of a disturbance what it gains less the penalty for its numbers (BIC).
        validation: Before and after on what was validated on; null where nothing was.
        worse: Whether any axis got worse there.
        notes: Everything noticed, a sentence each.
    """

    pumafuse: str
    runs: list[str]
    parts: dict[str, tuple[float | None, float | None]] = {}
    commands: dict[str, dict[str, int]] = {}
    rows: dict[str, dict[str, dict[str, int]]] = {}
    fit: list[str]
    fixed: list[str]
    trusted: str | None
    sd_prior: bool
    interrupted: bool
    likelihood: dict[str, AxisLikelihood]
    lags: dict[str, FittedLag]
    parameters: list[Fitted]
    biases: list[FoundBias]
    correlations: list[Correlation]
    not_identifiable: list[str]
    orders: dict[str, str]
    validation: list[Check] | None
    worse: bool
    notes: list[str]

    def __repr__(self) -> str:
        return f"TuningSummary({', '.join(self.runs)}: {len(self.parameters)} parameters, {len(self.notes)} notes)"


def fitted_lags(
    free: Sequence[Parameter],
    before: FusionConfig,
    after: FusionConfig,
    around: Mapping[str, Distances],
    allowed: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    lost: Collection[str] = (),
) -> dict[str, FittedLag]:
    """The lag of each axis that the free parameters change, or that has ``allowed`` ones, but for those ``lost``.

    Intervals are ``around`` it, from :func:`lag_intervals`; they cover the lags that are ``allowed`` [s] where least
    squares doubt the arm or it is seen in step, and where it was not fitted they are that and the lag itself.
    """
    lags, slopes = dict[str, FittedLag](), lag_slopes(free, after)
    for axis in (axis for axis in dict.fromkeys([*slopes, *allowed]) if axis not in lost):
        lag, (below, above) = after.arm.lag_of(axis), around.get(axis, (np.inf, np.inf))
        low, high = max(lag - below, min(lag, 0.0)), lag + above  # no arm is there before its commands
        if axis in allowed:
            least, most = allowed[axis]
            low, high = (low, high) if axis in slopes else (lag, lag)
            low, high = min(low, least), max(high, most)
        ends = [end * MS if abs(end) <= LONGEST else None for end in (low, high)]
        lags[axis] = FittedLag(before_ms=before.arm.lag_of(axis) * MS, lag_ms=lag * MS, lag_ms_ci95=(ends[0], ends[1]))
    return lags


def open_interval(ci95: tuple[float | None, float | None]) -> tuple[float, float]:
    """An interval with an infinite end where it has none."""
    low, high = ci95
    return -math.inf if low is None else low, math.inf if high is None else high


def text(summary: TuningSummary) -> str:
    """A tuning as plain text, as statistical packages print their results."""
    width = max([len(parameter.key) for parameter in summary.parameters], default=0)
    lines = [f"tuned on {', '.join(summary.runs)}: {', '.join(summary.fit)}", ""]
    for axis, by_axis in summary.likelihood.items():
        lines.append(
            f"{axis}: log-likelihood {by_axis.before:.1f} -> {by_axis.after:.1f} of {by_axis.components:,} components"
        )
    for axis, lag in summary.lags.items():
        low, high = open_interval(lag.lag_ms_ci95)
        lines.append(f"{axis}: lag {lag.before_ms:.4g} -> {lag.lag_ms:.4g} ms ({low:.4g} to {high:.4g})")
    lines += ["", f"{'':{width}}  {'before':>10}  {'value':>10}  {'[0.025':>10}  {'0.975]':>10}"]
    for likelihood in summary.parameters:
        before = "" if likelihood.before is None else f"{likelihood.before:.4g}"
        low, high = open_interval(likelihood.ci95)
        lines.append(f"{likelihood.key:{width}}  {before:>10}  {likelihood.value:>10.4g}  {low:>10.4g}  {high:>10.4g}")
    notes = [*summary.notes, *summary.not_identifiable]
    return "\n".join([*lines, *(["", *notes] if notes else [])])


def encode(summary: TuningSummary) -> str:
    """The text of ``tuning.json``: what belongs to an axis is in the units of its kind."""
    tree = msgspec.to_builtins(summary) | {"biases": [toml.reported(bias, bias.kind) for bias in summary.biases]}
    if summary.validation is not None:
        tree["validation"] = [toml.reported(check, check.kind) for check in summary.validation]
    return toml.json_text(tree) + "\n"


def fitted(
    parameter: Parameter, before: FusionConfig, after: FusionConfig, interval: ConfidenceInterval | None
) -> Fitted:
    """A parameter in the unit of its key; without its interval where none was computed."""
    earlier, value = parameter.configured(before), parameter.number(after)
    ends: tuple[float | None, float | None] = (None, None)
    if interval is not None:
        low, high = interval.ci95
        ends = (None if interval.open[0] else low / parameter.unit, None if interval.open[1] else high / parameter.unit)
        if interval.open[0] and parameter.vanishes:
            ends = (0.0, ends[1])
    return Fitted(
        key=parameter.key,
        before=None if earlier is None else earlier / parameter.unit,
        value=value / parameter.unit,
        ci95=ends,
        profiled=interval is not None and interval.profiled,
        notes="" if interval is None else _notes(parameter, interval),
    )


def _notes(parameter: Parameter, interval: ConfidenceInterval) -> str:
    bounds = {
        name: f"{bound / parameter.unit:g}" for name, bound in zip(("lower", "upper"), parameter.bounds, strict=True)
    }
    if interval.at == "lower" and parameter.vanishes:
        return "not significant"
    if interval.at == "lower" and parameter.is_noise and parameter.bounds[0] > SD_BOUNDS[0]:
        return "that of the steps in which its values come"
    if interval.at is not None:
        return f"at its {interval.at} bound ({bounds[interval.at]}): the model does not fit"
    if all(interval.open):
        return "not identifiable"
    if interval.open[0]:
        return "not significant: the interval includes 0" if parameter.vanishes else f"open down to {bounds['lower']}"
    if interval.open[1]:
        return f"open up to {bounds['upper']}"
    low, high = interval.ci95
    if parameter.sensor and parameter.prior and math.log(high / low) > _FROM_PRIOR * 2.0 * Z95 * parameter.prior[1]:
        return "mostly by its prior, what second differences show within a factor of 2: the likelihood hardly tells it"
    return "the likelihood has two maxima along it" if interval.profile.bimodal else ""


def found_biases(run: Run, config: FusionConfig) -> list[FoundBias]:
    """The biases of the sensors in a run under a configuration."""
    if not any(sensor.bias_sd_of(axis) for sensor in config.sensors.values() for axis in config.arm.axes):
        return []
    return [
        FoundBias(run=run.name, sensor=sensor, axis=axis, kind=config.arm.axes[axis].kind, bias=bias.value, sd=bias.sd)
        for sensor, by_axis in fused(run, config).biases.items()
        for axis, bias in by_axis.items()
    ]
