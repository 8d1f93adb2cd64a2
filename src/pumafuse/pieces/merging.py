"""The summary of a long run from those of its pieces."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..filter.outcome import Outcome
from ..fusion.config import FusionConfig
from ..fusion.consistency import LATE, Consistency, chi_square_band, verdict, whiteness
from ..fusion.estimates import Bias
from ..fusion.segments import added
from ..fusion.skill import PredictionError, Skill
from ..fusion.summary import AxisSummary, ScoreSummary, SensorSummary, Summary, ValiditySummary


def merged(
    parts: Sequence[Summary],
    config: FusionConfig,
    biases: Mapping[str, Mapping[str, Bias]],
    duration: float,
) -> Summary:
    """One summary of all, without notes: counts add up, means are weighted by numbers, verdicts are made anew.

    Args:
        parts: The summaries of the pieces, in order; each with the biases that its measurements determine first.
        config: Of the fusion.
        biases: At the end.
        duration: From the first to the last estimate [s].
    """
    first = parts[0]
    return Summary(
        pumafuse=first.pumafuse,
        run=first.run,
        arm=first.arm,
        mode=first.mode,
        engine=first.engine,
        origin_ns=first.origin_ns,
        duration_s=duration,
        estimates=sum(one.estimates for one in parts),
        segments=1,
        commands=added([one.commands for one in parts]),
        rows={name: added([one.rows[name] for one in parts]) for name in first.rows},
        axes={axis: _axis(parts, axis, config, biases) for axis in first.axes},
        validity=_validity([one.validity for one in parts]),
        notes=[],
    )


def _axis(
    parts: Sequence[Summary], axis: str, config: FusionConfig, biases: Mapping[str, Mapping[str, Bias]]
) -> AxisSummary:
    mine = [one.axes[axis] for one in parts]
    sensors: dict[str, SensorSummary] = {}
    for name in dict.fromkeys([*config.sensors, *(name for one in mine for name in one.sensors)]):
        if found := [one.sensors[name] for one in mine if name in one.sensors]:
            sensors[name] = _sensor(found, name, axis, config, biases.get(name, {}).get(axis))
    fused = sum(one.outcomes.get(Outcome.FUSED.word, 0) for one in sensors.values())
    return AxisSummary(
        sensors=sensors,
        log_likelihood=sum(one.log_likelihood for one in mine),
        score=_score([(one.axes[axis].score, one.estimates) for one in parts]),
        nees_band=chi_square_band(fused) if fused else None,
        kind=mine[0].kind,
    )


def _sensor(
    parts: Sequence[SensorSummary], name: str, axis: str, config: FusionConfig, bias: Bias | None
) -> SensorSummary:
    outcomes = added([one.outcomes for one in parts])
    found = SensorSummary(
        outcomes={one.word: outcomes[one.word] for one in Outcome if one.word in outcomes},
        skill=_skill([one.skill for one in parts if one.skill is not None]),
    )
    fused = [(one, one.outcomes[Outcome.FUSED.word]) for one in parts if Outcome.FUSED.word in one.outcomes]
    if not fused:
        return found
    without_first = [(one, count - (one.bias is not None and count > 1)) for one, count in fused]
    count = sum(number for _, number in fused)
    correlation = _correlation(fused)
    known = Consistency(
        count,
        _mean([(one.nis_mean, number) for one, number in fused]),
        chi_square_band(count),
        correlation,
        whiteness(correlation, count),
        verdict="",
    )
    decided = sum(outcomes.get(one.word, 0) for one in Outcome if one <= Outcome.REACQUIRED)
    late = sum(number for one, number in fused if one.verdict.endswith(LATE))
    return msgspec.structs.replace(
        found,
        innovation_rms=_rms([(one.innovation_rms, number) for one, number in without_first]),
        innovation_sd=_rms([(one.innovation_sd, number) for one, number in without_first]),
        nis_mean=known.nis,
        nis_band=known.nis_band,
        correlation=known.correlation.tolist(),
        correlation_band=known.correlation_band,
        whiteness_p=known.whiteness,
        verdict=verdict(config, name, axis, known, 1.0 - count / decided, lambda: 2 * late > count),
        bias=None if bias is None else bias.value,
        bias_sd=None if bias is None else bias.sd,
    )


def _correlation(parts: Sequence[tuple[SensorSummary, int]]) -> FloatArray:
    """Autocorrelations of all innovations; those of a piece have the weight of its innovations' power."""
    lags = max(len(one.correlation) for one, _ in parts)
    power = [(one.nis_mean or 0.0) * number for one, number in parts]
    padded = [np.pad(one.correlation, (0, lags - len(one.correlation))) for one, _ in parts]
    return np.average(padded, axis=0, weights=power)


def _skill(parts: Sequence[Skill]) -> Skill | None:
    """Root mean squares of all predictions; medians are means of the pieces' medians."""
    count = sum(one.predictions for one in parts)
    if not count:
        return None

    def of(name: str) -> PredictionError:
        errors = [(getattr(one, name), one.predictions) for one in parts]
        median = _mean((error.median, number) for error, number in errors)
        return PredictionError(rms=_rms((error.rms, number) for error, number in errors), median=median)

    ways = ("last_held", "constant_velocity", "command_alone", "filter")
    return Skill(predictions=count, **{name: of(name) for name in ways})


def _score(parts: Sequence[tuple[ScoreSummary | None, int]]) -> ScoreSummary | None:
    """The score of all from those of pieces, each with the number of its estimates."""
    known = [(one, one.rows) for one, _ in parts if one is not None]
    if not known:
        return None
    rows = sum(number for _, number in known)
    moving = [(one, number) for one, number in known if one.velocity_rmse is not None]
    return ScoreSummary(
        rmse=_rms((one.rmse, number) for one, number in known),
        bias=_mean((one.bias, number) for one, number in known),
        coverage=_mean((one.coverage, number) for one, number in known),
        nees_mean=None
        if any(one.nees_mean is None for one, _ in known)
        else _mean((one.nees_mean, n) for one, n in known),
        rows=rows,
        left_out=sum(estimates for _, estimates in parts) - rows,
        velocity_rmse=_rms((one.velocity_rmse, number) for one, number in moving) if moving else None,
        velocity_coverage=_mean((one.velocity_coverage, number) for one, number in moving) if moving else None,
    )


def _validity(parts: Sequence[ValiditySummary]) -> ValiditySummary:
    """The limits, and the highest speeds."""
    speeds = [one.commanded_speed for one in parts if one.commanded_speed is not None]
    turning = [one.commanded_angular_speed for one in parts if one.commanded_angular_speed is not None]
    return msgspec.structs.replace(
        parts[0],
        commanded_speed=max(speeds, default=None),
        commanded_angular_speed=max(turning, default=None),
    )


def _mean(parts: Iterable[tuple[float | None, int]]) -> float:
    """The mean of numbers, each a mean of so many; those that there are."""
    known = [(value, number) for value, number in parts if value is not None]
    return sum(value * number for value, number in known) / max(sum(number for _, number in known), 1)


def _rms(parts: Iterable[tuple[float | None, int]]) -> float:
    """The root mean square of root mean squares, each of so many."""
    return math.sqrt(_mean((value if value is None else value**2, number) for value, number in parts))
