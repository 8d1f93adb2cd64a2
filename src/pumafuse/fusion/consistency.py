"""Consistency of a filter: NIS, whiteness and log-likelihood of its innovations, and what they say.

The mean NIS ν²/S of n components is 1 where the filter's S is right, and lies in a chi-square band. Innovations of a
right filter are white in the order of measurement, which a Ljung-Box test of their autocorrelation checks. Rejected
components are left out.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import CodeArray, FloatArray
from ..filter.outcome import Outcome
from ..units import MM, Kind, nanoseconds
from . import chi_square
from .causes import Evidence, Suspect, evidence_of, suspects
from .config import Sensor
from .estimates import Estimates, Measurements
from .score import Z95

LAGS = 20
_FEW = 30  # fewer components get no verdict
_COLOURED = 0.01  # p-value below which innovations are not white
_NOTABLE = 0.1  # correlation below which whiteness is beside the point, however significant
# How far an estimate is from the response, in its sds, from which it strays: where that distance is noise of the sensor
# alone, 95 % error bars hold 81 % of the errors.
_STRAYS = 1.5
MANY_REJECTED = 0.1  # share of rejected components beyond which the others are a selection


class Finding(enum.Enum):
    """What the numbers of a sensor on an axis say."""

    FEW = "few"  # too few to tell
    REJECTED = "rejected"  # many were: the others were selected to fit
    FAULTY = "faulty"  # a fault of the log makes them other than expected
    CONSISTENT = "consistent"
    UNTESTED = "untested"  # as expected, but fitted to this run, and what strays may be the sensor or the arm
    AT_BOUND = "at bound"  # consistent, but no measurement determined the noise
    NOT_WHITE = "not white"  # as large as expected, but correlated
    TOO_LARGE = "too large"  # innovations, for their predicted sd
    TOO_SMALL = "too small"


_OTHER_THAN_EXPECTED = Finding.REJECTED, Finding.NOT_WHITE, Finding.TOO_LARGE, Finding.TOO_SMALL


@dataclass(frozen=True)
class Consistency:
    """One sensor's fused components on one axis."""

    count: int  # how many, n
    nis: float  # mean ν²/S
    nis_band: tuple[float, float]  # where that mean lies in 95 % of cases for a right filter
    correlation: FloatArray  # autocorrelation of the normalised innovations at lags 1 to 20, (lags,)
    whiteness: float  # Ljung-Box p-value over those lags; small: the innovations are not white
    rejected: float = 0.0  # share of components that a gate rejected, beside them
    sensor: str = ""
    kind: Kind = "length"  # of the axis
    at_bound: bool = False  # whether the sensor's sd is at a bound of what can be fitted
    untested: bool = False  # whether nothing tells its noise from what the arm strays
    fault: str = ""  # what is wrong with the log, as Fault.cause; "": nothing
    evidence: Callable[[], Evidence] = dict  # of causes, looked for where it makes a difference

    @cached_property
    def finding(self) -> Finding:
        """What the numbers say, or which fault explains them."""
        finding = self._by_numbers
        return Finding.FAULTY if self.fault and finding in _OTHER_THAN_EXPECTED else finding

    @property
    def _by_numbers(self) -> Finding:
        low, high = self.nis_band
        if self.count < _FEW:
            return Finding.FEW
        if self.rejected > MANY_REJECTED:
            return Finding.REJECTED
        if not low <= self.nis <= high:
            return Finding.TOO_LARGE if self.nis > high else Finding.TOO_SMALL
        if self.whiteness < _COLOURED and abs(self.correlation[self.strongest_lag - 1]) > _NOTABLE:
            return Finding.NOT_WHITE
        if self.at_bound:
            return Finding.AT_BOUND
        return Finding.UNTESTED if self.untested else Finding.CONSISTENT

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
    """
    rejected = int(Outcome.REJECTED)  # numpy asks an enumeration for attributes; a Ctrl-C that comes then is lost
    square = np.where(outcome == rejected, gate**2, (innovation / innovation_sd) ** 2)
    return -0.5 * (np.log(2.0 * np.pi * (innovation_sd * MM) ** 2) + square)


def chi_square_band(count: int) -> tuple[float, float]:
    """Where the mean of ``count`` squares of standard normal variables lies in 95 % of cases."""
    return chi_square.upper_quantile(count, 0.975) / count, chi_square.upper_quantile(count, 0.025) / count


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

    The evidence of causes is given where several sensors share the axis.
    """
    measurements = est.measurements.of(sensor, axis)
    fused = measurements.where(measurements.outcome == Outcome.FUSED)
    count = len(fused.value)
    if not count:
        return None
    configured = est.config.sensors[sensor]
    return Consistency(
        count,
        float(np.mean(fused.nis)),
        chi_square_band(count),
        *ljung_box(fused.innovation / fused.innovation_sd),
        rejected=1.0 - count / np.count_nonzero(measurements.outcome <= Outcome.REACQUIRED),
        sensor=sensor,
        kind=est.config.arm.axes[axis].kind,
        at_bound=configured.is_at_bound(axis),
        untested=est.fitted and _is_told_by_one(est, sensor, axis),
        fault=est.faults.get((sensor, axis), ""),
        evidence=evidence or (lambda: evidence_of(est, axis)),
    )


def _is_told_by_one(est: Estimates, sensor: str, axis: str) -> bool:
    """Whether a sensor is alone on an axis, and tells that the arm strays from its commands.

    A fit tells the noise of such a sensor from what the arm strays by one thing alone: that it is white. Filtered
    values, or a noise that lasts, are taken for the arm then, and the innovations are as expected.
    """
    others = (name for name in est.measurements.sensors if name != sensor)
    if any(len(est.measurements.of(name, axis).value) for name in others):
        return False
    strays, time = est[axis].position.copy(), est.origin + nanoseconds(est.time)
    for number in np.unique(est.segment).tolist():
        rows = est.segment == number
        strays[rows] -= est.segments[number].response(est.config.arm, axis, time[rows])
        strays[rows] -= strays[rows].mean()
    return float(np.std(strays)) > _STRAYS * float(np.median(est[axis].position_sd))
