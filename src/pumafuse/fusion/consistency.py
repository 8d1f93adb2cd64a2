"""Consistency of a filter: NIS, whiteness and log-likelihood of its innovations, with a verdict in words.

The mean NIS ν²/S of n components is 1 where the filter's S is right, and lies in a chi-square band. Innovations of a
right filter are white in the order of measurement, which a Ljung-Box test of their autocorrelation checks. Rejected
components are left out.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..filter.outcome import Outcome
from ..units import MM, MS, SCREEN, Kind, of_kind
from . import chi_square
from .causes import Cause, Evidence, Suspect, evidence_of, suspects
from .config import Sensor
from .estimates import Estimates, Measurements
from .score import Z95

LAGS = 20
_FEW = 30  # fewer components get no verdict
_WIDEST = 1e6  # largest ratio of prior to noise at which double precision keeps the error bars
_COLOURED = 0.01  # p-value below which innovations are not white
_NOTABLE = 0.1  # correlation below which whiteness is beside the point, however significant
_MANY_REJECTED = 0.1  # share of rejected components beyond which the others are a selection
_TOO_SMALL = "rejected: {sd}, latency_ms or the process noise too small"


class Finding(enum.Enum):
    """What the numbers of a sensor on an axis say."""

    FEW = "few"  # too few to tell
    REJECTED = "rejected"  # many were: the others were selected to fit
    CONSISTENT = "consistent"
    AT_BOUND = "at bound"  # consistent, but no measurement determined the noise
    NOT_WHITE = "not white"  # as large as expected, but correlated
    TOO_LARGE = "too large"  # innovations, for their predicted sd
    TOO_SMALL = "too small"


@dataclass(frozen=True)
class Consistency:
    """One sensor's fused components on one axis.

    Attributes:
        count: How many, n.
        nis: Mean ν²/S.
        nis_band: Where that mean lies in 95 % of cases for a right filter.
        correlation: Autocorrelation of the normalised innovations at lags 1 to 20, (lags,).
        whiteness: Ljung-Box p-value over those lags; small: the innovations are not white.
        rejected: Share of components that a gate rejected, beside them.
        sensor: The sensor.
        kind: Of the axis.
        at_bound: Whether the sensor's sd is at a bound of what can be fitted.
        evidence: Of causes, looked for where it makes a difference.
    """

    count: int
    nis: float
    nis_band: tuple[float, float]
    correlation: FloatArray
    whiteness: float
    rejected: float = 0.0
    sensor: str = ""
    kind: Kind = "length"
    at_bound: bool = False
    evidence: Callable[[], Evidence] = dict

    @cached_property
    def finding(self) -> Finding:
        """What the numbers say."""
        low, high = self.nis_band
        if self.count < _FEW:
            return Finding.FEW
        if self.rejected > _MANY_REJECTED:
            return Finding.REJECTED
        if not low <= self.nis <= high:
            return Finding.TOO_LARGE if self.nis > high else Finding.TOO_SMALL
        if self.whiteness < _COLOURED and abs(self.correlation[self.strongest_lag - 1]) > _NOTABLE:
            return Finding.NOT_WHITE
        return Finding.AT_BOUND if self.at_bound else Finding.CONSISTENT

    @cached_property
    def causes(self) -> tuple[Suspect, ...]:
        """What explains that the innovations are not as expected, best first; none where nothing stands out."""
        asked = self.finding in (Finding.NOT_WHITE, Finding.TOO_LARGE, Finding.TOO_SMALL)
        return suspects(self.evidence()) if asked else ()

    @property
    def strongest_lag(self) -> int:
        """At which lag the autocorrelation is farthest from 0."""
        return int(np.argmax(np.abs(self.correlation))) + 1

    @property
    def verdict(self) -> str:
        """In words, with the likely causes and the keys to change."""
        return sentence(self)

    @property
    def correlation_band(self) -> float:
        """Autocorrelations of white noise lie within ± this in 95 % of cases."""
        return Z95 / float(np.sqrt(self.count))


def log_likelihood(measurements: Measurements, sensors: Mapping[str, Sensor]) -> float:
    """Log-likelihood of the components that the filter used or rejected, with positions in mm or mrad."""
    return float(densities_of(measurements.where(measurements.outcome <= Outcome.REACQUIRED), sensors).sum())


def densities_of(components: Measurements, sensors: Mapping[str, Sensor]) -> FloatArray:
    """:func:`log_density` of fused, rejected and re-acquired components, (m,)."""
    gate = np.array([sensors[name].gate if name in sensors else 0.0 for name in components.sensors])
    return log_density(components.innovation, components.innovation_sd, components.outcome, gate[components.sensor])


def log_density(innovation: FloatArray, innovation_sd: FloatArray, outcome: CodeArray, gate: FloatArray) -> FloatArray:
    """Log of each component's predicted density with positions in mm or mrad, (m,).

    −½(ln 2πS + ν²/S) where it was fused or re-acquired; −½(ln 2πS + gate²) where it was rejected, so that a rejected
    measurement never costs less than one at the gate and a tuner cannot gain by rejecting.

    Args:
        innovation: ν [m], (m,).
        innovation_sd: √S [m], (m,).
        outcome: Fused, rejected or re-acquired, (m,).
        gate: Of each component's sensor, (m,).
    """
    rejected = int(Outcome.REJECTED)  # numpy asks an enumeration for attributes; a Ctrl-C that comes then is lost
    square = np.where(outcome == rejected, gate**2, (innovation / innovation_sd) ** 2)
    return -0.5 * (np.log(2.0 * np.pi * (innovation_sd * MM) ** 2) + square)


def chi_square_band(count: int) -> tuple[float, float]:
    """Where the mean of ``count`` squares of standard normal variables lies in 95 % of cases."""
    return chi_square.quantile(count, 0.975) / count, chi_square.quantile(count, 0.025) / count


def ljung_box(values: FloatArray, lags: int = LAGS) -> tuple[FloatArray, float]:
    """Autocorrelations at lags 1 … ``lags`` and the Ljung-Box p-value that all are zero.

    Ljung & Box, "On a measure of lack of fit in time series models", Biometrika 65, 1978.
    """
    centred, count = values - values.mean(), len(values)
    lags = min(lags, count - 1)
    power = float(centred @ centred)
    if power == 0.0 or lags < 1:
        return np.zeros(max(lags, 0)), 1.0
    correlation = np.array([centred[lag:] @ centred[:-lag] for lag in range(1, lags + 1)]) / power
    return correlation, whiteness_of(correlation, count)


def whiteness_of(correlation: FloatArray, count: int) -> float:
    """Ljung-Box p-value that autocorrelations at lags 1, 2, … of ``count`` values are all zero."""
    lags = len(correlation)
    statistic = count * (count + 2) * float(np.sum(correlation**2 / (count - np.arange(1, lags + 1))))
    return chi_square.tail(lags, statistic)


def consistency(
    est: Estimates, sensor: str, axis: str, evidence: Callable[[], Evidence] | None = None
) -> Consistency | None:
    """NIS, whiteness and verdict of one sensor's components on one axis; None where none were fused.

    Args:
        est: The estimates.
        sensor: The sensor.
        axis: The axis.
        evidence: Of causes on this axis, where several sensors share it.
    """
    measurements = est.measurements.of(sensor, axis)
    fused = measurements.where(measurements.outcome == Outcome.FUSED)
    count = len(fused.value)
    if not count:
        return None
    known = est.config.sensors[sensor]
    return Consistency(
        count,
        float(np.mean(fused.nis)),
        chi_square_band(count),
        *ljung_box(fused.innovation / fused.innovation_sd),
        rejected=1.0 - count / np.count_nonzero(measurements.outcome <= Outcome.REACQUIRED),
        sensor=sensor,
        kind=est.config.arm.axes[axis].kind,
        at_bound=known.is_at_bound(axis),
        evidence=evidence or (lambda: evidence_of(est, axis)),
    )


def sensor_problems(est: Estimates) -> list[str]:
    """Notes on sensors with a fault, a sentence each: re-acquired gates, mostly rejected rows."""
    found, given = list[str](), est.measurements
    order, begin = given.grouped
    outcome, ends = given.outcome.take(order), begin.tolist()
    count = np.diff(begin).reshape(len(given.sensors), len(given.axes))
    alone = np.count_nonzero(count.any(axis=1)) < 2
    for number, name in enumerate(given.sensors):
        if not count[number].any():
            continue
        mine = slice(ends[number * len(given.axes)], ends[(number + 1) * len(given.axes)])
        rejected = np.count_nonzero(outcome[mine] == int(Outcome.REJECTED)) / count[number].sum()
        reacquired = len(set(given.time[order[mine][outcome[mine] == int(Outcome.REACQUIRED)]].tolist()))
        times = "once" if reacquired == 1 else f"{reacquired} times"
        width = _width_of_prior(est, name)
        of_axes = [each for each, some in zip(given.axes, count[number].tolist(), strict=True) if some]
        kinds: dict[Kind, None] = {est.config.arm.axes[each].kind: None for each in of_axes}
        sd, bias_sd, offset_sd = (
            "/".join(of_kind(key, kind) for kind in kinds) for key in ("sd_mm", "bias_sd_mm", "offset_sd_mm")
        )
        problems = [
            (
                width > _WIDEST,
                f"its prior ({offset_sd}, {bias_sd}) is {width:.1e} times its noise: more than double precision"
                " resolves; use a narrower prior",
            ),
            (
                reacquired > 0,
                f"its gate reacquired {times}: it contradicts "
                + (
                    f"the model; {sd}, latency_ms or the process noise may be wrong"
                    if alone
                    else f"the others or the model; if it is off by a constant, give it {bias_sd}"
                ),
            ),
            (rejected > _MANY_REJECTED, f"{rejected:.0%} of its components were {_TOO_SMALL.format(sd=sd)}"),
        ]
        found += [f"{name}: {problem}" for holds, problem in problems if holds]
    return found


def _width_of_prior(est: Estimates, name: str) -> float:
    """How many times the prior is as wide as a sensor's noise: beyond 1e6 double precision blurs the error bars."""
    sensor, start = est.config.sensors.get(name), est.config.start
    if sensor is None:
        return 0.0
    widths = [
        max(start.offset_sd_of(axis), sensor.bias_sd_of(axis)) / sd
        for axis in est.axes
        if (sd := sensor.sd_of(axis)) is not None
    ]
    return max(widths, default=0.0)


# ---- in words -------------------------------------------------------------------------------------------------------


def sentence(found: Consistency) -> str:
    """The verdict on a sensor's components on an axis, in words."""
    if found.finding is Finding.FEW:
        return f"too few measurements ({found.count}) to tell"
    low, high = found.nis_band
    digits = next(n for n in range(2, 17) if _beside([found.nis, low, high]) == _beside([found.nis, low, high], n))
    nis = f"NIS {found.nis:.{digits}f}, expected {low:.{digits}f} to {high:.{digits}f}"
    sd, lag = of_kind("sd_mm", found.kind), found.strongest_lag if len(found.correlation) else 0
    causes = ", or ".join(in_words(one, found) for one in found.causes)
    match found.finding:
        case Finding.REJECTED:
            return f"{nis}, but {found.rejected:.0%} were {_TOO_SMALL.format(sd=sd)}"
        case Finding.NOT_WHITE:
            white = f"consistent in size, but not white (lag {lag}: {found.correlation[lag - 1]:+.2f})"
            return f"{nis}: {white}" + (f": {causes}" if causes else "")
        case Finding.AT_BOUND:
            return f"{nis}, but {sd} is at a bound of what can be fitted: error bars need not hold; configure it"
        case Finding.CONSISTENT:
            return f"{nis}: consistent"
        case _:
            return f"{nis}: {causes or 'no one cause stands out'}"


def in_words(one: Suspect, found: Consistency) -> str:
    """A cause as a clause."""
    sd, drift, bias = (of_kind(key, found.kind) for key in ("sd_mm", "bias_drift_sd_mm", "bias_sd_mm"))
    maneuvers = of_kind("maneuver_drift_mm_rts_per_m_s", found.kind)
    mine = f" of {one.sensor}" if one.sensor not in ("", found.sensor) else ""
    size, small, screen = abs(one.size), "small" if one.size > 0.0 else "large", SCREEN[found.kind]
    match one.cause:
        case Cause.NOISE:
            return f"{sd}{mine} is {_factor(one.size)}"
        case Cause.PROCESS:
            return f"the process noise is {_factor(one.size)}"
        case Cause.MANEUVERS:
            return f"the arm strays more where its speed changes ({maneuvers})"
        case Cause.CORRELATED:
            return f"the noise{mine} is correlated, as of filtered or repeated values ({drift}, bias_time_s)"
        case Cause.OUTLIERS:
            return (
                f"a few innovations{mine} are far larger than the others: outliers of the sensor, or jerks of the arm"
            )
        case Cause.LATENCY:
            return f"latency_ms{mine} is {size * MS:.3g} ms too {small}"
        case Cause.LAG | Cause.PLANT:
            whose, keys = ("the", "latency_ms, ") if one.sensor else ("the arm's", "")
            return f"{whose} lag is {size * MS:.3g} ms too {small} ({keys}delay_ms or plant)"
        case Cause.DYNAMICS:
            return "the error follows the acceleration: delay_ms against the plant, or a sensor that smooths its values"
        case Cause.SCALE:
            return f"scale{mine} is {size:.2g} of itself too {small}"
        case Cause.POSITION:
            share = f" by {one.size:+.1%} of it" if size else ""
            scale = "scale, " if one.sensor else ""
            return f"the error follows the position{share}: {scale}gain or a sag"
        case Cause.BIAS:
            return f"{one.sensor} is off by a constant of {size * screen.scale:.2g} {screen.unit} ({bias})"
        case Cause.PLAY:
            return f"the error turns with the direction: a play of about {size * screen.scale:.2g} {screen.unit}"
        case Cause.LIMIT:
            return "the arm falls behind where it is fastest: a limit of its speed"


def _factor(size: float) -> str:
    """By what a noise is to be multiplied."""
    small, times = ("small", size) if size > 1.0 else ("large", 1.0 / size if size else math.inf)
    return f"too {small}" + ("" if math.isinf(times) else f" by a factor of {times:.2g}")


def _beside(numbers: list[float], digits: int = 16) -> tuple[bool, bool]:
    """Whether a number, as printed, is below a band and whether it is above."""
    value, low, high = (round(number, digits) for number in numbers)
    return value < low, value > high
