"""``tuning.json``: what was learnt and how sure it is, in the units of files. The classes here are its schema."""

from __future__ import annotations

import warnings

import msgspec

from ..errors import PumafuseWarning
from ..fusion.config import FusionConfig
from ..fusion.offline import fuse
from ..logs.run import Run
from ..units import MM
from .diagnose import Tie, correlations
from .intervals import ConfidenceInterval
from .lesson import Lesson
from .parameters import Parameter
from .validate import Check


class Fitted(msgspec.Struct, frozen=True, kw_only=True):
    """A number that was fitted, in the unit of its key.

    Attributes:
        key: Its name: table, axis or sensor, and key as in ``fusion.toml`` or ``arm.toml``.
        before: As configured; null where it was not there.
        value: As fitted.
        ci95: Its 95 % interval; null at an end that the measurements do not limit.
        profiled: Whether the likelihood's profile was followed to the ends, not only its curvature.
        said: What to know of it, in words; empty if nothing.
    """

    key: str
    before: float | None
    value: float
    ci95: tuple[float | None, float | None]
    profiled: bool
    said: str


class Correlation(msgspec.Struct, frozen=True, kw_only=True):
    """Two numbers that the measurements tell only together."""

    first: str
    second: str
    correlation: float


class FoundBias(msgspec.Struct, frozen=True, kw_only=True):
    """The constant that a sensor is off by on an axis in a run, in the log's coordinates.

    Attributes:
        run: The run's name.
        sensor: The sensor.
        axis: The axis.
        bias_mm: The bias.
        sd_mm: Its standard deviation.
    """

    run: str
    sensor: str
    axis: str
    bias_mm: float
    sd_mm: float


class Likelihood(msgspec.Struct, frozen=True, kw_only=True):
    """Log-likelihood of an axis's components in the runs learnt from, with positions in mm.

    Attributes:
        components: How many.
        before: With the configuration as given.
        after: As tuned.
    """

    components: int
    before: float
    after: float


class TuningSummary(msgspec.Struct, frozen=True, kw_only=True):
    """``tuning.json``.

    Attributes:
        pumafuse: Version that wrote it.
        runs: Names of the runs learnt from.
        fit: What was fitted.
        hold: What of it was held, as asked.
        teacher: The sensor that taught the arm, if one did.
        interrupted: Whether it was stopped before the end; the numbers are the best until then.
        likelihood: By axis.
        parameters: What was fitted.
        biases: Of the sensors that have one to estimate.
        correlations: Pairs beyond 0.9.
        held: Combinations that the measurements do not tell, a sentence each.
        orders: Why each axis's plant has its order, where that was chosen.
        validation: Before and after on what was held back; null where nothing was.
        worse: Whether any axis got worse there.
        notes: Everything noticed, a sentence each.
    """

    pumafuse: str
    runs: list[str]
    fit: list[str]
    hold: list[str]
    teacher: str | None
    interrupted: bool
    likelihood: dict[str, Likelihood]
    parameters: list[Fitted]
    biases: list[FoundBias]
    correlations: list[Correlation]
    held: list[str]
    orders: dict[str, str]
    validation: list[Check] | None
    worse: bool
    notes: list[str]


def fitted(one: Parameter, before: FusionConfig, after: FusionConfig, interval: ConfidenceInterval | None) -> Fitted:
    """A parameter in the unit of its key; without its interval where nobody asked for it."""
    earlier, value = one.given(before), one.get(after)
    ends: tuple[float | None, float | None] = (None, None)
    if interval is not None:
        low, high = interval.ci95
        ends = (None if interval.open[0] else low / one.unit, None if interval.open[1] else high / one.unit)
        if interval.open[0] and one.vanishes:
            ends = (0.0, ends[1])
    return Fitted(
        key=one.key,
        before=None if earlier is None else earlier / one.unit,
        value=value / one.unit,
        ci95=ends,
        profiled=interval is not None and interval.profiled,
        said="" if interval is None else _said(one, interval),
    )


def _said(one: Parameter, interval: ConfidenceInterval) -> str:
    low, high = (f"{bound / one.unit:g}" for bound in one.bounds)
    if interval.at == "least" and one.vanishes:
        return "the measurements show no sign of it"
    if interval.at is not None:
        bound = low if interval.at == "least" else high
        return f"at the {interval.at} that is looked for ({bound}): the model does not fit"
    if all(interval.open):
        return "the measurements tell nothing of it"
    if interval.open[0]:
        return (
            "it may as well be none"
            if one.vanishes
            else f"the measurements do not limit it below ({low} is looked for)"
        )
    return f"the measurements do not limit it above ({high} is looked for)" if interval.open[1] else ""


def biases(run: Run, config: FusionConfig) -> list[FoundBias]:
    """What a configuration finds the sensors of a run to be off by."""
    if all(sensor.bias_sd == 0.0 for sensor in config.sensors.values()):
        return []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PumafuseWarning)  # they are the run's, and `fuse` says them
        found = fuse(run, config).biases
    return [
        FoundBias(run=run.name, sensor=sensor, axis=axis, bias_mm=one.value * MM, sd_mm=one.sd * MM)
        for sensor, by_axis in found.items()
        for axis, one in by_axis.items()
    ]


def correlated(lesson: Lesson) -> list[Correlation]:
    """The pairs of a lesson that its measurements tell only together."""
    pairs = correlations(lesson.evidence, lesson.best, lesson.free)
    return [Correlation(first=first, second=second, correlation=value) for first, second, value in pairs]


def told(tie: Tie) -> str:
    """What was held and why, in words."""
    others = ", ".join(key for key in tie.members if key != tie.held)
    if not others:
        return f"{tie.held} is held: the measurements do not tell it"
    return f"{tie.held} is held: the measurements do not tell it from {others}"
