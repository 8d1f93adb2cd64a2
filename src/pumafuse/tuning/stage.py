"""One stage of a fit: which parameters are free, the search for them, unknown biases, what is not identifiable."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from ..fusion.config import FusionConfig
from ..fusion.score import Z95
from ..logs.run import Run
from ..units import MM
from .identifiability import NotIdentifiable, excited_axes, not_identifiable, not_identifiable_noise, shared_times
from .likelihood import Likelihood
from .maximise import Notify, Point, ignore, maximise_with_gates, point
from .parameters import LATENCIES, Fit, Parameter, changed, is_fixed, parameters, smallest_sd, with_gates_of
from .search import FreeOf, penalised, search

_GATE = 5.0  # of the fit for a sensor without a gate, as outliers must not count, or with a narrow one:
_NARROWEST = 3.0  # below it rejecting good measurements would pay, the more the smaller the noise
_MOST_FIXED = 8  # combinations of which one parameter each is fixed, at most
_AT_REST = ("input_noise_mm_rtHz", "drift_mm_rts", "sd_mm")  # what an axis at rest still determines
_BIAS_GAIN = 3.0  # log-likelihood that a bias must gain; the width of its prior is already paid for in it
_BIAS_WIDTHS = (1e-3, 1e-2, 1e-1)  # m, of the prior
_FAR = 20.0  # times all that is uncertain, from which a gap is no noise
_ROOM = 3.0  # width of the prior over the gap that was found


@dataclass(frozen=True)
class Plan:
    """What a stage fits.

    Attributes:
        fit: The kinds of parameters.
        fixed: Names of parameters to leave as they are.
        sensors: The sensors to use; None: all.
        trusted: The sensor that the arm was fitted on: only parameters of other sensors are free; None: all.
    """

    fit: Sequence[Fit]
    fixed: Sequence[str]
    sensors: Sequence[str] | None = None
    trusted: str | None = None


@dataclass(frozen=True)
class Stage:
    """The result of a stage.

    Attributes:
        plan: What it was to fit.
        known: The configuration before.
        likelihood: The likelihood of the measurements it was fitted on.
        excited: The axes that move.
        best: The most likely point.
        free: The parameters that were fitted.
        not_identifiable: What the measurements do not determine, so that one parameter of each was fixed.
        orders: The reason for each axis's plant's order, where it was chosen.
        notes: Everything else noticed.
    """

    plan: Plan
    known: FusionConfig
    likelihood: Likelihood
    excited: Sequence[str]
    best: Point
    free: Sequence[Parameter]
    not_identifiable: Sequence[NotIdentifiable]
    orders: dict[str, str]
    notes: Sequence[str]


def run_stage(
    runs: Sequence[Run], config: FusionConfig, plan: Plan, until: float | None = None, notify: Notify = ignore
) -> Stage:
    """Fit the parameters of a plan; where a combination is not identifiable, fix one of it and go on.

    Args:
        runs: The runs to fit on.
        config: The configuration before.
        plan: What to fit.
        until: Leave out measurements after that [s after the first command].
        notify: Called with each better point.

    Raises:
        PumafuseError: Nothing can be fitted to the measurements.
    """
    likelihood = likelihood_of(runs, config, plan, until)
    excited = excited_axes(likelihood, config)
    start, notes = likelihood.config, list[str]()
    if "noise" in plan.fit:
        start, notes = with_large_biases(likelihood, start, plan.fixed)
    fixed: list[NotIdentifiable] = []
    free = _free(plan, config, likelihood, excited, fixed)
    if "latency" in plan.fit:
        fixed += shared_times(likelihood.sensors, excited, free(start), start)
    best, orders = search(likelihood, start, free, notify)
    if "noise" in plan.fit:
        biased, more = with_small_biases(likelihood, best, plan.fixed)
        if more:
            best, notes = maximise_with_gates(likelihood, biased, free(biased), notify), [*notes, *more]
    best = _identified(likelihood, best, free, config, fixed, notify)
    used = {name for names in likelihood.sensors.values() for name in names}
    notes += [
        f"{axis}: does not move; only its noise at rest was fitted"
        for axis in likelihood.sensors
        if axis not in excited
    ]
    notes += [
        f"{name}: was fitted with a gate of {_GATE:g}, not of {sensor.gate:g}: outliers must not count, good"
        " measurements must"
        for name, sensor in config.sensors.items()
        if sensor.gate < _NARROWEST and name in used
    ]
    return Stage(plan, config, likelihood, excited, best, free(best.config), fixed, orders, notes)


def repeat_stage(stage: Stage, runs: Sequence[Run], start: FusionConfig, notify: Notify = ignore) -> Stage:
    """Fit the same parameters to more measurements: the nearest maximum to ``start``, or what a new search finds.

    Where fewer measurements do not separate a delay from a lag or from noise, the nearest maximum to their result is a
    false one of more. So the search begins with the arm as it was given.
    """
    likelihood = likelihood_of(runs, stage.likelihood.config, stage.plan, None)
    fixed = [one for one in stage.not_identifiable if one.fixed.endswith("latency_ms")]
    free = _free(stage.plan, stage.known, likelihood, stage.excited, fixed)
    best, orders = maximise_with_gates(likelihood, start, free(start), notify), stage.orders
    if any(one.fit in ("delay", "plant") for one in free(start)):
        begin = best.config
        for axis in {one.axis for one in free(start) if one.axis is not None and one.fit in ("delay", "plant", "gain")}:
            begin = changed(begin, ("arm", "axes", axis), stage.known.arm.axes[axis])
        found, others = search(likelihood, begin, free, ignore)
        new, old = (float(penalised(likelihood, one, free(one.config)).sum()) for one in (found, best))
        if new > old:
            # no plant of another order is passed on before the stage with its parameters is complete
            best, orders, notify = found, others, ignore
    best = _identified(likelihood, best, free, stage.known, fixed, notify)
    return replace(
        stage, likelihood=likelihood, best=best, free=free(best.config), not_identifiable=fixed, orders=orders
    )


def reset_stage(stage: Stage, config: FusionConfig) -> Stage:
    """The stage as if it had ended at ``config``: its parameters are those of that configuration's plants."""
    free = _free(stage.plan, stage.known, stage.likelihood, stage.excited, stage.not_identifiable)(config)
    best = point(stage.likelihood, with_gates_of(config, stage.likelihood.config), free)
    return replace(stage, best=best, free=free, orders={})


def likelihood_of(runs: Sequence[Run], config: FusionConfig, plan: Plan, until: float | None = None) -> Likelihood:
    """The likelihood of the runs; where latencies vary, without what one could put before the first command."""
    sensors = {
        name: sensor if sensor.gate >= _NARROWEST else msgspec.structs.replace(sensor, gate=_GATE)
        for name, sensor in config.sensors.items()
    }
    latest = None
    if "latency" in plan.fit:
        latest = LATENCIES[1] + max((sensor.latency for sensor in config.sensors.values()), default=0.0)
    return Likelihood(runs, msgspec.structs.replace(config, sensors=sensors), plan.sensors, until=until, latest=latest)


def _free(
    plan: Plan, known: FusionConfig, likelihood: Likelihood, excited: Sequence[str], fixed: Sequence[NotIdentifiable]
) -> FreeOf:
    """The free parameters of a configuration: those of the plan, without what is ``fixed`` by then."""

    def may_vary(one: Parameter) -> bool:
        at_rest = any(key in one.key.split(".") for key in _AT_REST)
        of_others = plan.trusted is None or one.sensor not in (None, plan.trusted)
        return of_others and (one.axis is None or one.axis in excited or at_rest)

    def free(at: FusionConfig) -> list[Parameter]:
        names = [*plan.fixed, *(one.fixed for one in fixed)]
        return [one for one in parameters(at, known, likelihood.sensors, plan.fit, names) if may_vary(one)]

    return free


def _identified(
    likelihood: Likelihood,
    best: Point,
    free: FreeOf,
    known: FusionConfig,
    fixed: list[NotIdentifiable],
    notify: Notify,
) -> Point:
    """The best point with one parameter fixed of each combination that is not identifiable; appends to ``fixed``."""

    def as_configured(one: Parameter) -> FusionConfig:
        return changed(best.config, one.path, one.given(known))

    while len(fixed) < _MOST_FIXED and (found := not_identifiable(likelihood, best, free(best.config))) is not None:
        (one,) = (one for one in free(best.config) if one.key == found.fixed)
        start = as_configured(one) if _was_given(one, known) else best.config
        fixed.append(found)
        best = maximise_with_gates(likelihood, start, free(best.config), notify)
    for one in not_identifiable_noise(likelihood, best, free(best.config)):
        others = [other for other in free(best.config) if other.key != one.key]
        without = maximise_with_gates(likelihood, as_configured(one), others)
        if without.log_posterior > best.log_posterior - 0.5 * Z95**2:
            fixed.append(NotIdentifiable((one.key,), one.key))
            best = without
    return best


def _was_given(one: Parameter, known: FusionConfig) -> bool:
    """Whether a parameter can be set back: no number of a plant of another order, but a recovery to none."""
    return one.fit != "plant" or one.given(known) is not None


# ---- biases ---------------------------------------------------------------------------------------------------------


def with_large_biases(
    likelihood: Likelihood, config: FusionConfig, fixed: Sequence[str]
) -> tuple[FusionConfig, list[str]]:
    """The configuration with a bias for each sensor that is so far off that nothing could be fitted to it.

    Returns:
        The configuration, and a note for each such sensor.
    """
    gaps: dict[str, float] = {}
    misfit = dict(zip(likelihood.axes, likelihood.misfit(config).tolist(), strict=True))
    for (name, axis), (expected, measured) in likelihood.responses(config, centred=False).items():
        gap = abs(float(np.median(measured - expected)))
        scatter = likelihood.scatter.get(f"sensors.{name}.sd_mm.{axis}", 0.0)
        if gap > _FAR * (scatter + misfit[axis] + config.start.offset_sd):
            gaps[name] = max(gap, gaps.get(name, 0.0))
    widths = {name: _ROOM * gap for name, gap in gaps.items() if _may_be_biased(config, name, fixed)}
    notes = [
        f"sensor '{name}' is off by a constant of up to {gaps[name] * MM:.4g} mm: it was given a bias to estimate"
        for name in widths
    ]
    return _with_biases(config, widths), notes


def with_small_biases(likelihood: Likelihood, best: Point, fixed: Sequence[str]) -> tuple[FusionConfig, list[str]]:
    """The configuration with a bias for each sensor that contradicts a more accurate one by a constant.

    Returns:
        The configuration, and a note for each such sensor.
    """
    config, notes = best.config, list[str]()
    used = {name for names in likelihood.sensors.values() for name in names}
    ranked = sorted((name for name in config.sensors if name in used), key=lambda name: smallest_sd(config, name))
    for name in reversed(ranked[1:]):  # the most accurate is believed, of equals the first in the file
        if not _may_be_biased(config, name, fixed):
            continue
        before = likelihood.evaluate(config).total
        gains = {width: likelihood.evaluate(_with_biases(config, {name: width})).total for width in _BIAS_WIDTHS}
        width = max(gains, key=gains.__getitem__)
        gain = gains[width] - before
        if gain > _BIAS_GAIN:
            config = _with_biases(config, {name: width})
            notes.append(
                f"sensor '{name}' is off by a constant: a bias to estimate (bias_sd_mm = {width * MM:g}) gains"
                f" {gain:.1f} in log-likelihood"
            )
    return config, notes


def _may_be_biased(config: FusionConfig, name: str, fixed: Sequence[str]) -> bool:
    return config.sensors[name].bias_sd == 0.0 and not is_fixed(f"sensors.{name}.bias_sd_mm", fixed)


def _with_biases(config: FusionConfig, widths: Mapping[str, float]) -> FusionConfig:
    """The configuration with biases of these widths [m], rounded up to one digit."""
    for name, width in widths.items():
        digit = 10.0 ** math.floor(math.log10(width))
        config = changed(config, ("sensors", name, "bias_sd"), math.ceil(width / digit - 1e-9) * digit)
    return config
