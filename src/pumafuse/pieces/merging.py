"""One summary of a long run from those of its pieces.

Counts, likelihoods and mean squares are those of the whole run. Medians are the mean over the pieces by their numbers;
autocorrelations and the errors of simpler predictors do not know of pairs of measurements in two pieces.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np

from ..filter.outcome import Outcome
from ..fusion.causes import Evidence, evidence_of, together
from ..fusion.config import FusionConfig
from ..fusion.consistency import Consistency, chi_square_band, whiteness_of
from ..fusion.estimates import Estimates
from ..fusion.offline import UNCOVERED
from ..fusion.overruns import Overrun, overrun_notes, overruns
from ..fusion.score import OrientationScore
from ..fusion.segments import sum_counts
from ..fusion.summary import (
    AxisSummary,
    SensorSummary,
    Summary,
    axis_summary,
    orientation_score,
    pool,
    pool_number,
    sensor_summary,
    summary_of,
    weighted_mean,
)
from ..units import Kind

_SIZES = ("innovation_rms", "innovation_sd")
_NUMBER = re.compile(r"\d[\d.,]*(e[+-]?\d+)?")


class Innovations(NamedTuple):
    """The mean of ν/√S of a sensor on an axis, and what the axis tells of causes."""

    mean: float
    evidence: Evidence


class Digest(NamedTuple):
    """What is left of a piece."""

    est: Estimates  # its counts and notes; of the estimates the first and the last instant, and no measurement
    estimates: int  # how many there were
    axes: dict[str, AxisSummary]  # the summary of each axis
    innovations: dict[tuple[str, str], Innovations]  # by axis and sensor, where any was fused
    scored: bool  # whether the run has a reference
    orientation: OrientationScore | None  # the score of the axes rx, ry, rz together
    overruns: dict[str, Overrun]  # of each axis with a fastest speed the commands beyond it


def digest(est: Estimates, span: tuple[int, int]) -> Digest:
    """What has to be kept of a piece, of commands those after and until two instants [ns], for a run's summary."""
    innovations = dict[tuple[str, str], Innovations]()
    for axis in est.axes:
        evidence = evidence_of(est, axis)
        for name in est.measurements.sensors:
            of_pair = est.measurements.of(name, axis)
            fused = of_pair.where(of_pair.outcome == Outcome.FUSED)
            if len(fused.time):
                mean = float(np.mean(fused.innovation / fused.innovation_sd))
                innovations[axis, name] = Innovations(mean, evidence)
    none = est.measurements.where(np.zeros(len(est.measurements.time), dtype=np.bool_))
    small = replace(est, time=est.time[:: max(len(est.time) - 1, 1)].copy(), axes={}, cartesian=None, measurements=none)
    small = replace(small, reference=None, segment=np.zeros(2, dtype=np.int64), segments=())
    axes = {axis: axis_summary(est, axis) for axis in est.axes}
    beyond = overruns(est.segments[0], est.config.arm, span)
    return Digest(small, len(est.time), axes, innovations, est.reference is not None, orientation_score(est), beyond)


def merge(digests: Sequence[Digest]) -> Summary:
    """The summary of a run from what is left of its pieces, in their order."""
    parts = [digest.est for digest in digests]
    first, config = parts[0], parts[0].config
    axes = {axis: _axis(digests, axis) for axis in digests[0].axes}
    speed: dict[Kind, float] = {kind: max(part.speed[kind] for part in parts) for kind in first.speed}
    notes = [*_notes(parts), *config.arm.validity.excess(speed, None)]
    notes += overrun_notes([digest.overruns for digest in digests], config.arm, first.origin)
    if digests[0].scored and not any(axis.score for axis in axes.values()):
        notes.append(UNCOVERED)
    if len(parts) > 1:
        notes.append(
            f"fused in {len(parts)} pieces: medians are means over them, autocorrelations and simpler predictors know"
            " nothing of the piece before"
        )
    whole = replace(
        first,
        time=np.concatenate([part.time for part in parts]),
        command_counts=sum_counts(part.command_counts for part in parts),
        counts={name: sum_counts(part.counts[name] for part in parts) for name in first.counts},
        speed=speed,
        notes=tuple(notes),
    )
    oriented = [digest.orientation for digest in digests if digest.orientation is not None]
    turned = pool(oriented, [score.rows for score in oriented])
    return msgspec.structs.replace(
        summary_of(whole, axes, turned), estimates=sum(digest.estimates for digest in digests)
    )


def _notes(parts: Sequence[Estimates]) -> list[str]:
    """The notes of all pieces: those that differ in their numbers alone once, and in how many pieces they are."""
    by_note: dict[str, list[str]] = {}
    for part in parts:
        for note in part.notes:
            by_note.setdefault(_NUMBER.sub("0", note).replace("row has", "rows have"), []).append(note)
    return [
        notes[0] if len(parts) == 1 else f"{notes[0]} [in {len(notes)} of {len(parts)} pieces; numbers of the first]"
        for notes in by_note.values()
    ]


def _axis(digests: Sequence[Digest], axis: str) -> AxisSummary:
    parts = [digest.axes[axis] for digest in digests]
    names = dict.fromkeys(name for part in parts for name in part.sensors)
    sensors = {name: _sensor(digests, axis, name) for name in names}
    fused = sum(_fused(sensor) for sensor in sensors.values())
    scores = [part.score for part in parts if part.score is not None]
    return AxisSummary(
        sensors=sensors,
        log_likelihood=sum(part.log_likelihood for part in parts),
        score=pool(scores, [score.rows for score in scores]),
        nees_band=chi_square_band(fused) if fused else None,
        kind=parts[0].kind,
    )


def _sensor(digests: Sequence[Digest], axis: str, name: str) -> SensorSummary:
    having = [digest for digest in digests if name in digest.axes[axis].sensors]
    parts = [part.axes[axis].sensors[name] for part in having]
    skills = [part.skill for part in parts if part.skill]
    outcomes, skill = sum_counts(part.outcomes for part in parts), pool(skills, [skill.predictions for skill in skills])
    fused = [_fused(part) for part in parts]
    if not sum(fused):
        return SensorSummary(outcomes=outcomes, skill=skill)
    innovations = [digest.innovations.get((axis, name), Innovations(0.0, {})) for digest in having]
    faults = [fault for part in having if (fault := part.est.faults.get((name, axis)))]
    consistency = _consistency(parts, innovations, digests[0].est.config, name, axis)
    consistency = replace(consistency, fault=faults[0] if faults else "")
    rms, sd = (pool_number(key, [getattr(part, key) for part in parts], fused) or 0.0 for key in _SIZES)
    bias = digests[-1].est.biases.get(name, {}).get(axis)
    return sensor_summary(axis, outcomes, consistency, rms, sd, bias, skill)


def _consistency(
    parts: Sequence[SensorSummary], innovations: Sequence[Innovations], config: FusionConfig, name: str, axis: str
) -> Consistency:
    """The consistency of a sensor on an axis in all pieces.

    A piece's autocorrelations are about its own mean: the sums of products about that of all are put together.
    """
    fused = [_fused(part) for part in parts]
    count, lags = sum(fused), max(len(part.correlation) for part in parts)
    nis = weighted_mean([part.nis_mean for part in parts], fused) or 0.0
    mean, power = weighted_mean([innovation.mean for innovation in innovations], fused) or 0.0, 0.0
    products = np.zeros(lags)
    for part, innovation, n in zip(parts, innovations, fused, strict=True):
        within, between = n * ((part.nis_mean or 0.0) - innovation.mean**2), n * (innovation.mean - mean) ** 2
        products += between
        products[: len(part.correlation)] += within * np.array(part.correlation)
        power += within + between
    correlation = products / power if power > 0.0 else products
    white = whiteness_of(correlation, count) if lags else 1.0
    decided = sum(
        part.outcomes.get(outcome.word, 0) for part in parts for outcome in Outcome if outcome <= Outcome.REACQUIRED
    )
    return Consistency(
        count,
        nis,
        chi_square_band(count),
        correlation,
        white,
        rejected=1.0 - count / decided,
        sensor=name,
        kind=config.arm.axes[axis].kind,
        at_bound=config.sensors[name].is_at_bound(axis),
        evidence=lambda: together(innovation.evidence for innovation in innovations),
    )


def _fused(sensor: SensorSummary) -> int:
    return sensor.outcomes.get(Outcome.FUSED.word, 0)
