"""Validation: a configuration before and after tuning, on measurements that it was not fitted on."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, TypeAlias

import msgspec
import numpy as np

from .. import toml
from ..arrays import FloatArray
from ..errors import PumafuseWarning
from ..filter.outcome import Outcome
from ..fusion.config import FusionConfig
from ..fusion.consistency import chi_square_band, consistency, densities_of
from ..fusion.estimates import AxisEstimate, Estimates, Measurements
from ..fusion.offline import fuse
from ..fusion.score import Z95, interpolate, score
from ..fusion.skill import skill
from ..logs.run import Run
from ..units import MM, Kind, of_kind

_WORSE = 1.02  # RMSE after over before that is worse where it is beyond chance
_FAR_WORSE = 1.2  # likewise, whatever chance would make of it
_COVERAGE = 0.90  # of errors within 95 % error bars, below which these do not hold
_NIS = (0.71, 1.42)  # likewise: normal errors of which 98 and 90 % lie within
_FARTHEST = 5.0  # sd that a component counts as at most
_BATCHES = 20


Change: TypeAlias = Literal["worse", "no different", "better"]


class SensorCheck(msgspec.Struct, frozen=True, kw_only=True):
    """One sensor's innovations on one axis."""

    count: int  # its fused components
    nis: float  # mean ν²/S; 1 for a consistent filter
    whiteness_p: float  # ljung-Box p-value; small: the innovations are not white
    correlation: float  # autocorrelation of the innovations at lag 1
    # error of predicting its next measurement, over that of the best simpler way; null where there is none
    skill: float | None


class State(toml.Reported, frozen=True, kw_only=True):
    """One axis under one configuration."""

    log_likelihood: float  # of its components, with positions in mm or mrad
    rejected: int  # components that were rejected
    sensors: dict[str, SensorCheck]  # by name
    # root mean square error on the reference [m or rad]; null without one
    rmse: float | None = msgspec.field(name="rmse_mm", default=None)
    coverage: float | None = None  # share of errors within 1.96 standard deviations


class Check(toml.Reported, frozen=True, kw_only=True):
    """One axis of one run before and after."""

    run: str  # the run's name
    axis: str  # the axis
    kind: Kind  # whether that is a length or an angle
    since_s: float  # where the part to validate on begins; 0: at the run's begin
    components: int  # the number of components compared
    before: State  # under the configuration as given
    after: State  # under the tuned one
    worse: bool  # whether it got worse
    change: Change
    holds: bool  # whether the error bars of the tuned one do: by the reference's coverage, else by NIS
    verdict: str  # in words


def fused(run: Run, config: FusionConfig) -> Estimates:
    """The estimates of a run without its warnings, which ``fuse`` reports."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PumafuseWarning)
        return fuse(run, config)


def check(run: Run, before: FusionConfig, after: FusionConfig, since: float = 0.0) -> list[Check]:
    """Compare the configuration as given and the tuned one on a run that neither was fitted on.

    Only what comes ``since`` then [s after the first command] counts; the filter runs from the beginning.
    """
    pair = [_from(fused(run, config), since) for config in (before, after)]
    return [_check(run.name, axis, since, *pair) for axis in pair[0].axes if len(_of_axis(pair[0], axis).value)]


def _from(est: Estimates, since: float) -> Estimates:
    """Estimates and measurements from ``since`` [s] on; measurements by their stamps, which no latency changes."""
    late = est.time >= since
    axes: Mapping[str, AxisEstimate] = {
        name: AxisEstimate(*(getattr(axis, field)[late] for field in AxisEstimate.FIELDS))
        for name, axis in est.axes.items()
    }
    measurements = est.measurements.where(
        (est.measurements.outcome <= Outcome.REACQUIRED) & (est.measurements.stamp >= since)
    )
    return replace(est, time=est.time[late], segment=est.segment[late], axes=axes, measurements=measurements)


def _of_axis(est: Estimates, axis: str) -> Measurements:
    return est.measurements.where(est.measurements.axis == est.measurements.axes.index(axis))


def _check(run: str, axis: str, since: float, before: Estimates, after: Estimates) -> Check:
    old, new, gains = _state(before, axis), _state(after, axis), _gains(before, after, axis)
    gained, chance = float(gains.sum()), Z95 * float(np.sqrt(np.sum(gains**2)))
    closer = None if old.rmse is None or new.rmse is None else new.rmse / max(old.rmse, 1e-12)
    farther = closer is not None and (
        closer > _FAR_WORSE or (closer > _WORSE and _beyond_chance(_squares(after, axis) - _squares(before, axis)))
    )
    change: Change = "worse" if gained < -chance or farther else "better" if gained > chance else "no different"
    verdict = f"log-likelihood {gained:+.1f} (chance: ± {chance:.1f})"
    if closer is not None:
        verdict += f", RMSE {100.0 * (closer - 1.0):+.1f} %"
    doubts = _doubts(after, axis, new)
    head: str = change
    if doubts and change == "better":
        head += f", but its error bars do not hold ({', '.join(doubts)})"
    simple = [f"{name} {check.skill:.2f}" for name, check in new.sensors.items() if (check.skill or 0.0) > _WORSE]
    if simple:
        verdict += f"; a simpler way predicts the next measurement better (error over its: {', '.join(simple)})"
    return Check(
        run=run,
        axis=axis,
        kind=after.config.arm.axes[axis].kind,
        since_s=since,
        components=len(gains),
        before=old,
        after=new,
        worse=change == "worse",
        change=change,
        holds=not doubts,
        verdict=f"{head}: {verdict}",
    )


def _doubts(est: Estimates, axis: str, state: State) -> list[str]:
    """Why error bars do not hold: a noise at a bound; NIS, or coverage on the reference, off by more than chance."""
    sd = of_kind("sd_mm", est.config.arm.axes[axis].kind)
    doubts = [f"{sd} of {name} is at its bound" for name in state.sensors if est.config.sensors[name].is_at_bound(axis)]
    for name, check in state.sensors.items():
        low, high = chi_square_band(check.count)
        if check.nis < min(low, _NIS[0]) or check.nis > max(high, _NIS[1]):
            doubts.append(f"NIS of {name} {check.nis:.2f}")
    if state.coverage is not None and state.coverage < _COVERAGE:
        inside = np.sqrt(_squares(est, axis)) <= Z95 * est[axis].position_sd
        if _beyond_chance(_COVERAGE - inside.astype(np.float64)):
            doubts.append(f"coverage {state.coverage:.0%}")
    return doubts


def _squares(est: Estimates, axis: str) -> FloatArray:
    """Squared errors on the reference [m²], NaN where it has a gap, (n,)."""
    if est.reference is None:
        return np.zeros(len(est.time))
    return (est[axis].position - interpolate(est.time, est.segment, est.reference, axis)) ** 2


def _beyond_chance(growth: FloatArray) -> bool:
    """Whether a mean is above 0 by more than chance; neighbours are correlated, so means of batches are compared."""
    means = [float(batch.mean()) for batch in np.array_split(growth[np.isfinite(growth)], _BATCHES) if len(batch)]
    if len(means) < 2:
        return True
    return bool(np.mean(means) > Z95 * np.std(means, ddof=1) / np.sqrt(len(means)))


def _gains(before: Estimates, after: Estimates, axis: str) -> FloatArray:
    """The gain in log density of each component that both configurations decided on, (m,).

    If both are equally good, the sum has a variance of about Σ gain² (Vuong, Econometrica 57, 1989).
    """
    old, new = _of_axis(before, axis), _of_axis(after, axis)
    keys = [np.rint(part.stamp * 1e6).astype(np.int64) * len(part.sensors) + part.sensor for part in (old, new)]
    _, elsewhere, here = np.intersect1d(keys[0], keys[1], return_indices=True)
    return _bounded(new)[here] - _bounded(old)[elsewhere]


def _bounded(components: Measurements) -> FloatArray:
    """Log of each component's predicted density, none farther off than 5 sd: else a few outliers would decide, (m,)."""
    square = np.minimum(components.nis, _FARTHEST**2)
    return -0.5 * (np.log(2.0 * np.pi * (components.innovation_sd * MM) ** 2) + square)


def _state(est: Estimates, axis: str) -> State:
    components = _of_axis(est, axis)
    scored = None
    if est.reference is not None and len(est.time):
        scored = score(est.time, est.segment, est[axis].position, est[axis].position_sd, est.reference, axis)
    sensors: dict[str, SensorCheck] = {}
    for name in components.sensors:
        check = consistency(est, name, axis)
        if check is not None and len(check.correlation):
            predicted = skill(est, est.measurements.of(name, axis))
            sensors[name] = SensorCheck(
                count=check.count,
                nis=check.nis,
                whiteness_p=check.whiteness,
                correlation=float(check.correlation[0]),
                skill=None if predicted is None else predicted.of_best_other,
            )
    return State(
        log_likelihood=float(densities_of(components, est.config.sensors).sum()),
        rejected=int(np.count_nonzero(components.outcome == Outcome.REJECTED)),
        sensors=sensors,
        rmse=None if scored is None else scored.rmse,
        coverage=None if scored is None else scored.coverage,
    )
