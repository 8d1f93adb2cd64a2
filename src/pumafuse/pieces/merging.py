"""One summary of a long run from those of its pieces.

Counts, likelihoods and mean squares are those of the whole run. Medians are the mean over the pieces by their numbers;
autocorrelations and the errors of simpler predictors do not know of pairs of measurements in two pieces.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
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
from ..fusion.score import OrientationScore
from ..fusion.segments import added
from ..fusion.skill import PredictionError, Skill
from ..fusion.summary import (
    AxisSummary,
    ScoreSummary,
    SensorSummary,
    Summary,
    axis_summary,
    orientation_score,
    sensor_summary,
    summary_of,
)
from ..units import Kind

_NUMBER = re.compile(r"\d[\d.,]*(e[+-]?\d+)?")


class Innovations(NamedTuple):
    """Of a sensor on an axis: the mean of ν/√S; and what the axis tells of causes."""

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


def digest(est: Estimates) -> Digest:
    """What has to be kept of a piece for the summary of the run."""
    found = dict[tuple[str, str], Innovations]()
    for axis in est.axes:
        evidence = evidence_of(est, axis)
        for name in est.measurements.sensors:
            mine = est.measurements.of(name, axis)
            fused = mine.where(mine.outcome == Outcome.FUSED)
            if len(fused.time):
                mean = float(np.mean(fused.innovation / fused.innovation_sd))
                found[axis, name] = Innovations(mean, evidence)
    none = est.measurements.where(np.zeros(len(est.measurements.time), dtype=np.bool_))
    small = replace(est, time=est.time[:: max(len(est.time) - 1, 1)].copy(), axes={}, cartesian=None, measurements=none)
    small = replace(small, reference=None, segment=np.zeros(2, dtype=np.int64), segments=())
    axes = {axis: axis_summary(est, axis) for axis in est.axes}
    return Digest(small, len(est.time), axes, found, est.reference is not None, orientation_score(est))


def merged(digests: Sequence[Digest]) -> Summary:
    """The summary of a run from what is left of its pieces, in their order."""
    parts = [one.est for one in digests]
    first, config = parts[0], parts[0].config
    axes = {axis: _axis(digests, axis) for axis in digests[0].axes}
    speed: dict[Kind, float] = {kind: max(part.speed[kind] for part in parts) for kind in first.speed}
    notes = [*_notes(parts), *config.arm.validity.excess(speed, None)]
    if digests[0].scored and not any(axis.score for axis in axes.values()):
        notes.append(UNCOVERED)
    if len(parts) > 1:
        notes.append(
            f"fused in {len(parts)} pieces: medians are means over them, autocorrelations and simpler predictors know"
            " nothing of the piece before"
        )
    whole = replace(
        first,
        time=np.concatenate([part.time for part in parts] or [np.zeros(1)]),
        command_counts=added(part.command_counts for part in parts),
        counts={name: added(part.counts[name] for part in parts) for name in first.counts},
        speed=speed,
        notes=tuple(notes),
    )
    turned = _orientation([one.orientation for one in digests if one.orientation is not None])
    return msgspec.structs.replace(summary_of(whole, axes, turned), estimates=sum(one.estimates for one in digests))


def _notes(parts: Sequence[Estimates]) -> list[str]:
    """The notes of all pieces: those that differ in their numbers alone once, and in how many pieces they are."""
    found: dict[str, list[str]] = {}
    for part in parts:
        for note in part.notes:
            found.setdefault(_NUMBER.sub("0", note).replace("row has", "rows have"), []).append(note)
    return [
        notes[0] if len(parts) == 1 else f"{notes[0]} [in {len(notes)} of {len(parts)} pieces; numbers of the first]"
        for notes in found.values()
    ]


def _axis(digests: Sequence[Digest], axis: str) -> AxisSummary:
    parts = [one.axes[axis] for one in digests]
    names = dict.fromkeys(name for part in parts for name in part.sensors)
    sensors = {name: _sensor(digests, axis, name) for name in names}
    fused = sum(_fused(sensor) for sensor in sensors.values())
    return AxisSummary(
        sensors=sensors,
        log_likelihood=sum(part.log_likelihood for part in parts),
        score=_score([part.score for part in parts if part.score is not None]),
        nees_band=chi_square_band(fused) if fused else None,
        kind=parts[0].kind,
    )


def _score(parts: Sequence[ScoreSummary]) -> ScoreSummary | None:
    if not parts:
        return None
    rows = [part.rows for part in parts]
    square = _mean([part.rmse**2 for part in parts], rows) or 0.0
    velocity = _mean([None if part.velocity_rmse is None else part.velocity_rmse**2 for part in parts], rows)
    return ScoreSummary(
        rmse=math.sqrt(square),
        bias=_mean([part.bias for part in parts], rows) or 0.0,
        coverage=_mean([part.coverage for part in parts], rows) or 0.0,
        nees_mean=_mean([part.nees_mean for part in parts], rows),
        rows=sum(rows),
        left_out=sum(part.left_out for part in parts),
        velocity_rmse=None if velocity is None else math.sqrt(velocity),
        velocity_coverage=_mean([part.velocity_coverage for part in parts], rows),
    )


def _orientation(parts: Sequence[OrientationScore]) -> OrientationScore | None:
    if not parts:
        return None
    rows = [part.rows for part in parts]
    rms, expected = (
        math.sqrt(_mean([one**2 for one in each], rows) or 0.0)
        for each in ([part.rms for part in parts], [part.expected for part in parts])
    )
    return OrientationScore(rms=rms, expected=expected, rows=sum(rows), left_out=sum(part.left_out for part in parts))


def _sensor(digests: Sequence[Digest], axis: str, name: str) -> SensorSummary:
    having = [one for one in digests if name in one.axes[axis].sensors]
    parts = [one.axes[axis].sensors[name] for one in having]
    outcomes, skill = added(part.outcomes for part in parts), _skill([part.skill for part in parts if part.skill])
    fused = [_fused(part) for part in parts]
    if not sum(fused):
        return SensorSummary(outcomes=outcomes, skill=skill)
    innovations = [one.innovations.get((axis, name), Innovations(0.0, {})) for one in having]
    found = _consistency(parts, innovations, digests[0].est.config, name, axis)
    squares = [
        _mean([None if rms is None else rms**2 for rms in each], fused) or 0.0
        for each in ([part.innovation_rms for part in parts], [part.innovation_sd for part in parts])
    ]
    bias = digests[-1].est.biases.get(name, {}).get(axis)
    return sensor_summary(axis, outcomes, found, math.sqrt(squares[0]), math.sqrt(squares[1]), bias, skill)


def _consistency(
    parts: Sequence[SensorSummary], innovations: Sequence[Innovations], config: FusionConfig, name: str, axis: str
) -> Consistency:
    """The consistency of a sensor on an axis in all pieces.

    A piece's autocorrelations are about its own mean: the sums of products about that of all are put together.
    """
    fused = [_fused(part) for part in parts]
    count, lags = sum(fused), max(len(part.correlation) for part in parts)
    nis = _mean([part.nis_mean for part in parts], fused) or 0.0
    mean, power = _mean([one.mean for one in innovations], fused) or 0.0, 0.0
    products = np.zeros(lags)
    for part, one, n in zip(parts, innovations, fused, strict=True):
        own, aside = n * ((part.nis_mean or 0.0) - one.mean**2), n * (one.mean - mean) ** 2
        products += aside
        products[: len(part.correlation)] += own * np.array(part.correlation)
        power += own + aside
    correlation = products / power if power > 0.0 else products
    white = whiteness_of(correlation, count) if lags else 1.0
    decided = sum(part.outcomes.get(one.word, 0) for part in parts for one in Outcome if one <= Outcome.REACQUIRED)
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
        evidence=lambda: together(one.evidence for one in innovations),
    )


def _skill(parts: Sequence[Skill]) -> Skill | None:
    if not parts:
        return None
    predictions = [part.predictions for part in parts]

    def error(ones: Iterable[PredictionError]) -> PredictionError:
        squares, medians = zip(*((one.rms**2, one.median) for one in ones), strict=True)
        return PredictionError(
            rms=math.sqrt(_mean(squares, predictions) or 0.0), median=_mean(medians, predictions) or 0.0
        )

    return Skill(
        predictions=sum(predictions),
        last_held=error(part.last_held for part in parts),
        constant_velocity=error(part.constant_velocity for part in parts),
        command_alone=error(part.command_alone for part in parts),
        filter=error(part.filter for part in parts),
    )


def _fused(sensor: SensorSummary) -> int:
    return sensor.outcomes.get(Outcome.FUSED.word, 0)


def _mean(values: Sequence[float | None], weights: Sequence[int]) -> float | None:
    """The weighted mean of the values that there are; None without any."""
    known = [(value, weight) for value, weight in zip(values, weights, strict=True) if value is not None]
    total = sum(weight for _, weight in known)
    return sum(value * weight for value, weight in known) / total if total else None
