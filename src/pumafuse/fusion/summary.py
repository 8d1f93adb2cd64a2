"""``summary.json``: counts, consistency and scores of a fusion in mm and s. The classes here are its schema."""

from __future__ import annotations

import math
from importlib.metadata import version

import msgspec
import numpy as np

from ..arrays import FloatArray, IntArray
from ..filter.outcome import Outcome
from ..units import MM
from .consistency import chi_square_band, consistency, log_likelihood
from .estimates import AxisEstimate, Estimates
from .score import ReferenceTrack, score, score_velocity
from .skill import Skill, skill


class SensorSummary(msgspec.Struct, frozen=True, kw_only=True):
    """One sensor on one axis.

    Attributes:
        outcomes: Number of components with each outcome, without those that do not occur.
        innovation_rms_mm: Root mean square of the fused components' innovations; null without any. Without the first of
            a sensor with a bias, which determines the bias.
        innovation_sd_mm: Root mean square of their predicted standard deviations.
        nis_mean: Mean ν²/S of the fused components; 1 for a consistent filter.
        nis_band: Where that mean lies in 95 % of cases for a consistent filter.
        correlation: Autocorrelation of the innovations at lags 1, 2, …
        correlation_band: White innovations' autocorrelations lie within ± this in 95 % of cases.
        whiteness_p: Ljung-Box p-value; small: the innovations are not white.
        verdict: In words, with the likely cause and the key to change.
        bias_mm: The estimated bias in the log's coordinates; null where none is estimated.
        bias_sd_mm: Its standard deviation.
        skill: How well its next measurement is predicted, by this filter and by simpler means; null with fewer than
            two measurements.
    """

    outcomes: dict[str, int]
    innovation_rms_mm: float | None = None
    innovation_sd_mm: float | None = None
    nis_mean: float | None = None
    nis_band: tuple[float, float] | None = None
    correlation: list[float] = []
    correlation_band: float | None = None
    whiteness_p: float | None = None
    verdict: str = "nothing fused"
    bias_mm: float | None = None
    bias_sd_mm: float | None = None
    skill: Skill | None = None


class ScoreSummary(msgspec.Struct, frozen=True, kw_only=True):
    """One axis against the reference.

    Attributes:
        rmse_mm: Root mean square error.
        bias_mm: Mean of estimate − reference.
        coverage: Share of errors within 1.96 standard deviations.
        nees_mean: Mean of error²/variance; 1 for a consistent filter; null where a variance is 0.
        rows: Estimates scored.
        left_out: Estimates with no reference near enough.
        velocity_rmse_mm_s: Root mean square error of the mean velocity over the coming update period; null for smoothed
            estimates, which have none.
        velocity_coverage: Share of its errors within 1.96 standard deviations; null likewise.
    """

    rmse_mm: float
    bias_mm: float
    coverage: float
    nees_mean: float | None
    rows: int
    left_out: int
    velocity_rmse_mm_s: float | None = None
    velocity_coverage: float | None = None


class AxisSummary(msgspec.Struct, frozen=True, kw_only=True):
    """One axis.

    Attributes:
        sensors: By name, those with components on this axis.
        log_likelihood: Of its components, with positions in mm.
        score: Against the reference; null without one.
        nees_band: Where the mean NEES lies in 95 % of cases for a consistent filter with as many independent errors
            as fused components; null without components.
    """

    sensors: dict[str, SensorSummary]
    log_likelihood: float
    score: ScoreSummary | None
    nees_band: tuple[float, float] | None


class ValiditySummary(msgspec.Struct, frozen=True, kw_only=True):
    """Commands against the arm model's limits; null where there is no limit, ``"not checked"`` without a frame."""

    max_speed_m_s: float | None
    commanded_speed_m_s: float
    max_radius_mm: float | None
    commanded_radius_mm: float | str


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """A fusion.

    Attributes:
        pumafuse: Version that wrote it.
        run: The run's name.
        arm: The arm's name.
        mode: Which measurements an estimate uses: ``filtered`` (all valid by then), ``as-live`` (those that had
            arrived) or ``smoothed`` (all of the run).
        engine: Which engine computed it.
        origin_ns: Stamp of the first command: time 0 of every table.
        from_s: Where the part of the run that was used begins, since the first command; null: with the run.
        to_s: Where it ends, likewise.
        duration_s: From the first to the last estimate.
        estimates: How many.
        segments: 1, and one more for each time the log's clock was set back.
        axes: By axis.
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
    duration_s: float
    estimates: int
    segments: int
    axes: dict[str, AxisSummary]
    validity: ValiditySummary
    notes: list[str]


def summarise(est: Estimates) -> Summary:
    """Counts, consistency and scores of a fusion."""
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
        duration_s=float(np.ptp(est.time)),
        estimates=len(est.time),
        segments=int(est.segment[-1]) + 1,
        axes={axis: _axis_summary(est, axis) for axis in est.axes},
        validity=ValiditySummary(
            max_speed_m_s=limits.max_speed,
            commanded_speed_m_s=est.speed,
            max_radius_mm=None if limits.max_radius is None else limits.max_radius * MM,
            commanded_radius_mm="not checked" if est.radius is None else est.radius * MM,
        ),
        notes=list(est.notes),
    )


def score_axis(
    time: FloatArray, segment: IntArray, estimate: AxisEstimate, reference: ReferenceTrack, axis: str, period: float
) -> ScoreSummary | None:
    """Scores of position and velocity of one axis in mm and mm/s; None where no estimate has a reference.

    Args:
        time: Of the estimates [s], (n,).
        segment: Of the estimates, (n,).
        estimate: The axis.
        reference: What is taken for the true positions.
        axis: The axis of the reference.
        period: Update period T [s] over which the velocity is a mean.
    """
    position = score(time, segment, estimate.position, estimate.position_sd, reference, axis)
    if position is None:
        return None
    velocity = score_velocity(time, segment, estimate.velocity, estimate.velocity_sd, reference, axis, period)
    return ScoreSummary(
        rmse_mm=position.rmse * MM,
        bias_mm=position.bias * MM,
        coverage=position.coverage,
        nees_mean=position.nees if math.isfinite(position.nees) else None,
        rows=position.rows,
        left_out=position.left_out,
        velocity_rmse_mm_s=None if velocity is None else velocity.rmse * MM,
        velocity_coverage=None if velocity is None else velocity.coverage,
    )


def _axis_summary(est: Estimates, axis: str) -> AxisSummary:
    mine = est.measurements.where(est.measurements.axis == est.measurements.axes.index(axis))
    fused = int(np.sum(mine.outcome == Outcome.FUSED))
    found = None
    if est.reference is not None:
        found = score_axis(est.time, est.segment, est[axis], est.reference, axis, est.config.arm.update_period)
    return AxisSummary(
        sensors={name: _sensor_summary(est, name, axis) for name in mine.sensors if len(mine.of(name, axis).value)},
        log_likelihood=log_likelihood(mine, est.config.sensors),
        score=found,
        nees_band=chi_square_band(fused) if fused else None,
    )


def _sensor_summary(est: Estimates, sensor: str, axis: str) -> SensorSummary:
    measurements, found = est.measurements.of(sensor, axis), consistency(est, sensor, axis)
    if found is None:
        return SensorSummary(outcomes=measurements.counts(), skill=skill(est, measurements))
    fused = measurements.where(measurements.outcome == Outcome.FUSED)
    bias = est.biases.get(sensor, {}).get(axis)
    first = 1 if bias is not None and len(fused.value) > 1 else 0  # the first measurement determines the bias
    return SensorSummary(
        outcomes=measurements.counts(),
        innovation_rms_mm=float(np.sqrt(np.mean(fused.innovation[first:] ** 2))) * MM,
        innovation_sd_mm=float(np.sqrt(np.mean(fused.innovation_sd[first:] ** 2))) * MM,
        nis_mean=found.nis,
        nis_band=found.nis_band,
        correlation=found.correlation.tolist(),
        correlation_band=found.correlation_band,
        whiteness_p=found.whiteness,
        verdict=found.verdict,
        bias_mm=None if bias is None else bias.value * MM,
        bias_sd_mm=None if bias is None else bias.sd * MM,
        skill=skill(est, measurements),
    )
