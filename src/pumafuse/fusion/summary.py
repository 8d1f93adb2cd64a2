"""``summary.json``: what happened in a fusion, in the units of screens (mm, s). The classes here are its schema."""

from __future__ import annotations

from importlib.metadata import version

import msgspec
import numpy as np

from ..units import MM
from .consistency import log_likelihood
from .estimates import Estimates, Readings
from .score import Score, score
from .timeline import Outcome


class SensorSummary(msgspec.Struct, frozen=True, kw_only=True):
    """One sensor on one axis.

    Attributes:
        outcomes: How many scalars met each outcome, those that occur.
        innovation_rms_mm: Root mean square of the fused scalars' innovations; null without any.
        innovation_sd_mm: Root mean square of what the filter expected of them.
        nis_mean: Mean ν²/S of the fused scalars; 1 for a consistent filter.
    """

    outcomes: dict[str, int]
    innovation_rms_mm: float | None
    innovation_sd_mm: float | None
    nis_mean: float | None


class ScoreSummary(msgspec.Struct, frozen=True, kw_only=True):
    """One axis against the reference.

    Attributes:
        rmse_mm: Root mean square error.
        bias_mm: Mean of estimate − reference.
        coverage: Share of errors within 1.96 standard deviations.
        nees_mean: Mean of error²/variance; 1 for a consistent filter.
        rows: Estimates scored.
        left_out: Estimates with no reference near enough.
    """

    rmse_mm: float
    bias_mm: float
    coverage: float
    nees_mean: float
    rows: int
    left_out: int


class AxisSummary(msgspec.Struct, frozen=True, kw_only=True):
    """One axis: its sensors, the log-likelihood of its scalars (positions in mm), and its score; null without one."""

    sensors: dict[str, SensorSummary]
    log_likelihood: float
    score: ScoreSummary | None


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
        mode: ``filtered`` (every reading valid by then) or ``as-live`` (those that had arrived).
        engine: Which engine computed it.
        origin_ns: Stamp of the first command: time 0 of every table.
        duration_s: From the first to the last estimate.
        estimates: How many.
        segments: 1, and one more for each time the log's clock was set back.
        axes: By axis.
        validity: Commands against the arm model's limits.
        notes: Everything noticed, a sentence each.
    """

    pumafuse: str
    run: str
    arm: str
    mode: str
    engine: str
    origin_ns: int
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
        duration_s=float(np.ptp(est.time)),
        estimates=len(est.time),
        segments=int(est.segment[-1]) + 1,
        axes={axis: _axis_summary(est, axis) for axis in est.axes},
        validity=ValiditySummary(
            max_speed_m_s=limits.max_speed,
            commanded_speed_m_s=est.speed,
            max_radius_mm=None if limits.max_radius is None else limits.max_radius * MM,
            commanded_radius_mm="not checked",
        ),
        notes=list(est.notes),
    )


def score_summary(found: Score) -> ScoreSummary:
    """A score in mm."""
    return ScoreSummary(
        rmse_mm=found.rmse * MM,
        bias_mm=found.bias * MM,
        coverage=found.coverage,
        nees_mean=found.nees,
        rows=found.rows,
        left_out=found.left_out,
    )


def _axis_summary(est: Estimates, axis: str) -> AxisSummary:
    mine = est.readings.where(est.readings.axis == est.readings.axes.index(axis))
    sensors = {name: _sensor_summary(mine.of(name, axis)) for name in mine.sensors}
    found = None
    if est.reference is not None:
        found = score(est.time, est.segment, est[axis].position, est[axis].position_sd, est.reference, axis)
    return AxisSummary(
        sensors={name: summary for name, summary in sensors.items() if summary.outcomes},
        log_likelihood=log_likelihood(mine, est.config.sensors),
        score=None if found is None else score_summary(found),
    )


def _sensor_summary(readings: Readings) -> SensorSummary:
    fused = readings.where(readings.outcome == Outcome.FUSED)
    if not len(fused.value):
        return SensorSummary(outcomes=readings.counts(), innovation_rms_mm=None, innovation_sd_mm=None, nis_mean=None)
    return SensorSummary(
        outcomes=readings.counts(),
        innovation_rms_mm=float(np.sqrt(np.mean(fused.innovation**2))) * MM,
        innovation_sd_mm=float(np.sqrt(np.mean(fused.innovation_sd**2))) * MM,
        nis_mean=float(np.mean(fused.nis)),
    )
