"""``summary.json``: counts, consistency and scores of a fusion. The classes here are its schema, in SI units.

Names of keys are those for lengths; the file has those of each axis's kind: ``rmse_mm`` or ``rmse_deg``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from typing import Any, TypeVar

import msgspec
import numpy as np

from .. import toml
from ..arrays import FloatArray, IntArray
from ..filter.outcome import Outcome
from ..units import SCREEN, Kind, to_si
from .causes import Evidence, Suspect, evidence_of
from .consistency import Consistency, chi_square_band, consistency, log_likelihood
from .estimates import AxisEstimate, Bias, Estimates
from .score import OrientationScore, ReferenceTrack, Score, score, score_orientation, score_velocity
from .skill import Skill, skill
from .verdicts import in_words, sentence

P = TypeVar("P", bound=msgspec.Struct)
_OF_SQUARES = {"rms", "rmse", "expected", "velocity_rmse", "innovation_rms", "innovation_sd"}  # roots of their means
_BEATEN = 1.25  # times the RMS error of a simpler way, from which that is said: a bit less may be chance, or outliers


class FoundCause(toml.Reported, frozen=True, kw_only=True):
    """What explains that a sensor's innovations are not as expected; null what a cause has not.

    Attributes:
        axis: The axis.
        sensor: Whose fault it is; empty: the arm's.
        cause: A word of :class:`pumafuse.fusion.causes.Cause`.
        words: As in the verdict.
        factor: By what a noise is to be multiplied; also null beyond what was tried.
        share: Of the position, or of a scale, by which it errs.
        shift: By how much a latency or a lag is too small, or a latency scatters [s].
        size: Of a constant or of play [m or rad].
    """

    axis: str
    sensor: str
    cause: str
    words: str
    factor: float | None = None
    share: float | None = None
    shift: float | None = msgspec.field(name="shift_ms", default=None)
    size: float | None = msgspec.field(name="size_mm", default=None)


class SensorSummary(toml.Reported, frozen=True, kw_only=True):
    """One sensor on one axis.

    Attributes:
        outcomes: Number of components with each outcome, without those that do not occur.
        innovation_rms: Root mean square of the fused components' innovations [m or rad]; null without any. Without the
            first of a sensor with a bias, which determines the bias.
        innovation_sd: Root mean square of their predicted standard deviations.
        nis_mean: Mean ν²/S of the fused components; 1 for a consistent filter.
        nis_band: Where that mean lies in 95 % of cases for a consistent filter.
        correlation: Autocorrelation of the innovations at lags 1, 2, …
        correlation_band: White innovations' autocorrelations lie within ± this in 95 % of cases.
        whiteness_p: Ljung-Box p-value; small: the innovations are not white.
        finding: What the numbers say, in a word: the verdict as data.
        verdict: In words, with the likely cause and the key to change.
        causes: Those in it, the likeliest first; any of them may be the one.
        bias: The estimated bias in the log's coordinates [m or rad]; null where none is estimated.
        bias_sd: Its standard deviation.
        skill: How well its next measurement is predicted, by this filter and by simpler means; null with fewer than
            two measurements.
    """

    outcomes: dict[str, int]
    innovation_rms: float | None = msgspec.field(name="innovation_rms_mm", default=None)
    innovation_sd: float | None = msgspec.field(name="innovation_sd_mm", default=None)
    nis_mean: float | None = None
    nis_band: tuple[float, float] | None = None
    correlation: list[float] = msgspec.field(default_factory=list[float])
    correlation_band: float | None = None
    whiteness_p: float | None = None
    finding: str | None = None
    verdict: str = "nothing fused"
    causes: list[FoundCause] = msgspec.field(default_factory=list[FoundCause])
    bias: float | None = msgspec.field(name="bias_mm", default=None)
    bias_sd: float | None = msgspec.field(name="bias_sd_mm", default=None)
    skill: Skill | None = None


class ScoreSummary(Score, frozen=True, kw_only=True):
    """One axis against the reference.

    Attributes:
        velocity_rmse: Root mean square error of the mean velocity over the coming update period; null for smoothed
            estimates, which have none.
        velocity_coverage: Share of its errors within 1.96 standard deviations; null likewise.
    """

    velocity_rmse: float | None = msgspec.field(name="velocity_rmse_mm_s", default=None)
    velocity_coverage: float | None = None

    @property
    def nees_mean(self) -> float | None:
        """The mean NEES, as the file calls it."""
        return self.nees


class AxisSummary(msgspec.Struct, frozen=True, kw_only=True):
    """One axis.

    Attributes:
        sensors: By name, those with components on this axis.
        log_likelihood: Of its components, with positions in mm or mrad.
        score: Against the reference; null without one.
        nees_band: Where the mean NEES lies in 95 % of cases for a consistent filter with as many independent errors
            as fused components; null without components.
        kind: Whether it is a length or an angle.
    """

    sensors: dict[str, SensorSummary]
    log_likelihood: float
    score: ScoreSummary | None
    nees_band: tuple[float, float] | None
    kind: Kind = "length"


class ValiditySummary(toml.Reported, frozen=True, kw_only=True):
    """Commands against the arm model's limits; null where there is no limit, ``"not checked"`` without a frame.

    Attributes:
        max_speed: Of lengths [m/s].
        commanded_speed: Likewise; null without an axis that is a length.
        max_angular_speed: Of angles [rad/s].
        commanded_angular_speed: Likewise; null without an axis that is an angle.
        max_radius: Distance from the base's axis [m].
        commanded_radius: Likewise.
    """

    max_speed: float | None = msgspec.field(name="max_speed_m_s")
    commanded_speed: float | None = msgspec.field(name="commanded_speed_m_s")
    max_angular_speed: float | None = msgspec.field(name="max_speed_deg_s", default=None)
    commanded_angular_speed: float | None = msgspec.field(name="commanded_speed_deg_s", default=None)
    max_radius: float | None = msgspec.field(name="max_radius_mm")
    commanded_radius: float | str = msgspec.field(name="commanded_radius_mm")


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """A fusion.

    Attributes:
        pumafuse: Version that wrote it.
        run: The run's name.
        arm: The arm's name.
        mode: Which measurements an estimate uses, as :func:`pumafuse.fuse` has it.
        engine: Which engine computed it.
        origin_ns: Stamp of the first command: time 0 of every table.
        from_s: Where the part of the run that was used begins, since the first command; null: with the run.
        to_s: Where it ends, likewise.
        rate_hz: Of the even grid of estimates; null: one for each command.
        sensors: Those that were asked for; null: all that are configured.
        duration_s: From the first to the last estimate.
        estimates: How many.
        segments: 1, and one more for each time the log's clock was set back.
        commands: How many rows of the commands were ``used``, and of the others how many were left out for what.
        rows: Of each sensor, as ``counts`` of :class:`pumafuse.Estimates`.
        axes: By axis.
        orientation: Of axes rx, ry, rz together, against the reference; null without one.
        validity: Commands against the arm model's limits.
        notes: What was noticed, a sentence each.
    """

    pumafuse: str
    run: str
    arm: str
    mode: str
    engine: str
    origin_ns: int
    from_s: float | None = None
    to_s: float | None = None
    rate_hz: float | None = None
    sensors: list[str] | None = None
    duration_s: float
    estimates: int
    segments: int
    commands: dict[str, int] = {}
    rows: dict[str, dict[str, int]] = {}
    axes: dict[str, AxisSummary]
    orientation: OrientationScore | None = None
    validity: ValiditySummary
    notes: list[str]

    def __repr__(self) -> str:
        return f"Summary({self.run!r}, {self.mode}: {', '.join(self.axes)}; {len(self.notes)} notes)"


def encode(summary: Summary) -> bytes:
    """The text of ``summary.json``."""
    tree = msgspec.to_builtins(summary) | {"validity": toml.reported(summary.validity)}
    tree["axes"] = {axis: toml.reported(axis_summary, axis_summary.kind) for axis, axis_summary in summary.axes.items()}
    tree["orientation"] = summary.orientation and toml.reported(summary.orientation)
    return msgspec.json.format(msgspec.json.Encoder(decimal_format="number").encode(tree), indent=2) + b"\n"


def decode(text: bytes) -> Summary:
    """The summary of the text of ``summary.json``."""
    tree = msgspec.json.decode(text, type=dict[str, Any])
    parts = msgspec.convert(tree, _InUnits)
    axes = {axis: toml.as_lengths(to_si(axis_parts)) for axis, axis_parts in parts.axes.items()}
    orientation = parts.orientation and to_si(parts.orientation)
    in_si = {"axes": axes, "orientation": orientation, "validity": to_si(parts.validity)}
    return msgspec.convert(tree | in_si, Summary)


class _InUnits(msgspec.Struct):
    """The parts of a file that have units."""

    axes: dict[str, dict[str, Any]]
    validity: dict[str, Any]
    orientation: dict[str, Any] | None = None


def summarise(est: Estimates) -> Summary:
    """Counts, consistency and scores of a fusion."""
    return summary_of(est, {axis: axis_summary(est, axis) for axis in est.axes}, orientation_score(est))


def orientation_score(est: Estimates) -> OrientationScore | None:
    """The score of the axes rx, ry, rz together; None without such, or without a reference of them."""
    if est.reference is None:
        return None
    sd = {axis: estimate.position_sd for axis, estimate in est.axes.items()}
    return score_orientation(est.time, est.segment, est.positions, sd, est.reference)


def summary_of(est: Estimates, axes: dict[str, AxisSummary], orientation: OrientationScore | None) -> Summary:
    """The summary of a fusion from those of its axes, and the score of its orientation."""
    limits = est.config.arm.validity
    return Summary(
        pumafuse=version("pumafuse"),
        run=est.run,
        arm=est.config.arm.name,
        mode=est.mode,
        engine=est.engine,
        origin_ns=est.origin,
        from_s=est.since,
        to_s=est.until,
        rate_hz=est.rate,
        sensors=None if est.selected is None else list(est.selected),
        duration_s=float(np.ptp(est.time)),
        estimates=len(est.time),
        segments=int(est.segment[-1]) + 1,
        commands=dict(est.command_counts),
        rows={name: dict(counts) for name, counts in est.counts.items()},
        axes=axes,
        orientation=orientation,
        validity=ValiditySummary(
            max_speed=limits.max_speed,
            commanded_speed=est.speed.get("length"),
            max_angular_speed=limits.max_angular_speed,
            commanded_angular_speed=est.speed.get("angle"),
            max_radius=limits.max_radius,
            commanded_radius="not checked" if est.radius is None else est.radius,
        ),
        notes=list(est.notes),
    )


def beaten_notes(axes: Mapping[str, AxisSummary]) -> list[str]:
    """A sentence on each sensor on an axis whose next measurement a simpler way predicts better than the filter."""
    sentences = list[str]()
    for axis, part in axes.items():
        screen = SCREEN[part.kind]
        for sensor, of_sensor in part.sensors.items():
            if of_sensor.skill is None or (ratio := of_sensor.skill.of_best_other) is None or ratio < _BEATEN:
                continue
            words, least = of_sensor.skill.best_other
            sizes = [f"{error * screen.scale:.3g}" for error in (least, of_sensor.skill.filter.rms)]
            sentences.append(
                f"{axis}: {words} predicts the next measurement of {sensor} better than the fused estimate (RMS"
                f" {sizes[0]} against {sizes[1]} {screen.unit}): the model of arm or noise is wrong somewhere; look at"
                " the verdict, and at --figures"
            )
    return sentences


def weighted_mean(values: Sequence[float | None], weights: Sequence[int]) -> float | None:
    """The weighted mean of the values that there are; None without any."""
    pairs = [(value, weight) for value, weight in zip(values, weights, strict=True) if value is not None]
    total = sum(weight for _, weight in pairs)
    return sum(value * weight for value, weight in pairs) / total if total else None


def pool(parts: Sequence[P], weights: Sequence[int]) -> P | None:
    """Scores of several runs, or of pieces of one, as one: counts are summed, errors weighted; None without any."""
    if not parts:
        return None
    keys = parts[0].__struct_fields__
    return type(parts[0])(**{key: pool_number(key, [getattr(part, key) for part in parts], weights) for key in keys})


def pool_number(key: str, values: Sequence[Any], weights: Sequence[int]) -> Any:
    """A field of several scores as one: a root mean square by the squares, any other by its mean."""
    if isinstance(values[0], msgspec.Struct):
        return pool(values, weights)
    if isinstance(values[0], int):
        return sum(values)
    power = 2 if key in _OF_SQUARES else 1
    mean = weighted_mean([None if value is None else value**power for value in values], weights)
    return None if mean is None else mean ** (1 / power)


def score_axis(
    time: FloatArray, segment: IntArray, estimate: AxisEstimate, reference: ReferenceTrack, axis: str, period: float
) -> ScoreSummary | None:
    """Scores of position and velocity of one axis; None where no estimate has a reference."""
    position = score(time, segment, estimate.position, estimate.position_sd, reference, axis)
    if position is None:
        return None
    velocity = score_velocity(time, segment, estimate.velocity, estimate.velocity_sd, reference, axis, period)
    rmse, coverage = (None, None) if velocity is None else (velocity.rmse, velocity.coverage)
    return ScoreSummary(**msgspec.structs.asdict(position), velocity_rmse=rmse, velocity_coverage=coverage)


def axis_summary(est: Estimates, axis: str) -> AxisSummary:
    """Consistency and scores of one axis."""
    measured = est.measurements.where(est.measurements.axis == est.measurements.axes.index(axis))
    fused = int(np.sum(measured.outcome == Outcome.FUSED))
    score_here = None
    if est.reference is not None:
        score_here = score_axis(est.time, est.segment, est[axis], est.reference, axis, est.config.arm.update_period)
    evidence = cache(lambda: evidence_of(est, axis))
    return AxisSummary(
        sensors={
            name: _sensor_summary(est, name, axis, evidence)
            for name in measured.sensors
            if len(measured.of(name, axis).value)
        },
        log_likelihood=log_likelihood(measured, est.config.sensors),
        score=score_here,
        nees_band=chi_square_band(fused) if fused else None,
        kind=est.config.arm.axes[axis].kind,
    )


def _sensor_summary(est: Estimates, sensor: str, axis: str, evidence: Callable[[], Evidence]) -> SensorSummary:
    measurements, checked = est.measurements.of(sensor, axis), consistency(est, sensor, axis, evidence)
    if checked is None:
        return SensorSummary(outcomes=measurements.counts(), skill=skill(est, measurements))
    fused = measurements.where(measurements.outcome == Outcome.FUSED)
    bias = est.biases.get(sensor, {}).get(axis)
    first = 1 if bias is not None and len(fused.value) > 1 else 0  # the first measurement determines the bias
    rms = [float(np.sqrt(np.mean(values[first:] ** 2))) for values in (fused.innovation, fused.innovation_sd)]
    return sensor_summary(axis, measurements.counts(), checked, rms[0], rms[1], bias, skill(est, measurements))


def sensor_summary(
    axis: str,
    outcomes: dict[str, int],
    consistency: Consistency,
    innovation_rms: float,
    innovation_sd: float,
    bias: Bias | None,
    skill: Skill | None,
) -> SensorSummary:
    """The summary of a sensor on an axis on which it was fused."""
    return SensorSummary(
        outcomes=outcomes,
        innovation_rms=innovation_rms,
        innovation_sd=innovation_sd,
        nis_mean=consistency.nis,
        nis_band=consistency.nis_band,
        correlation=consistency.correlation.tolist(),
        correlation_band=consistency.correlation_band,
        whiteness_p=consistency.whiteness,
        finding=consistency.finding.value,
        verdict=sentence(consistency),
        causes=[_found_cause(axis, cause, consistency) for cause in consistency.causes],
        bias=None if bias is None else bias.value,
        bias_sd=None if bias is None else bias.sd,
        skill=skill,
    )


def _found_cause(axis: str, suspect: Suspect, consistency: Consistency) -> FoundCause:
    size = {suspect.cause.measure: suspect.size} if suspect.cause.measure and 0.0 < abs(suspect.size) < math.inf else {}
    return FoundCause(
        axis=axis, sensor=suspect.sensor, cause=suspect.cause.value, words=in_words(suspect, consistency), **size
    )
