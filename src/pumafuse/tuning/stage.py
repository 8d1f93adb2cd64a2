"""One stage of a fit: which parameters are free, the search for them, unknown biases, what is not identifiable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..fusion.config import FusionConfig, Process
from ..fusion.score import Z95
from ..logs.run import Run
from ..units import SCREEN, Kind, as_length, of_kind
from .arm_search import ArmSearch
from .identifiability import (
    NotIdentifiable,
    excited_axes,
    few_measurements,
    for_few,
    lone_drifts,
    not_identifiable,
    not_identifiable_noise,
    shared_times,
)
from .likelihood import Likelihood, Point
from .maximise import Notify, ignore, maximise_with_gates, point
from .parameters import (
    LATENCIES,
    Fit,
    Parameter,
    changed,
    is_fixed,
    parameters,
    set_disturbance,
    set_drifts,
    set_gates,
    set_own_delays,
    smallest_sd,
)
from .search import FreeOf, Search, arm_searches

# Gates of the fit. Below the narrowest, rejecting good measurements would pay, the more the smaller the noise; beyond
# the widest, a few outliers or jerks would widen all error bars. A sensor with a narrower one is fitted with `_GATE`.
_GATE, _NARROWEST, _WIDEST = 5.0, 3.0, 8.0
_MOST_FIXED = 8  # combinations of which one parameter each is fixed, at most
_AT_REST = ("input_noise_mm_rtHz", "drift_mm_rts", "sd_mm")  # what an axis at rest still determines
_BIAS_GAIN = 3.0  # log-likelihood that a bias must gain; the width of its prior is already paid for in it
_BIAS_WIDTHS = (1e-3, 1e-2, 1e-1)  # m or rad, of the prior
_FAR = 20.0  # times all that is uncertain, from which a gap is no noise
_ROOM = 3.0  # width of the prior over the gap that was found
_NOISES = {"input_noise", "drift", "maneuver_noise", "maneuver_drift", "disturbance_sd"}
_WIDTHS, _HALVINGS = (1e-4, 10.0), 16  # times the misfit of the arm
_UNSEEN = 0.1  # log-likelihood that noise must be worth


@dataclass(frozen=True)
class Plan:
    """What a stage fits."""

    fit: Sequence[Fit]  # the kinds of parameters
    fixed: Sequence[str]  # names of parameters to leave as they are
    sensors: Sequence[str] | None = None  # the sensors to use; None: all
    # the sensor that the arm was fitted on: only parameters of other sensors are free; None: all
    trusted: str | None = None
    sd_prior: bool = True  # whether a sensor's noise is believed to be what second differences show
    one_delay: bool = False  # whether all axes share one delay whatever the measurements say


@dataclass(frozen=True)
class Stage:
    """The result of a stage."""

    likelihood: Likelihood  # the likelihood of the measurements it was fitted on
    best: Point  # the most likely point
    free: Sequence[Parameter]  # the parameters that were fitted
    # what the measurements do not determine, so that one parameter of each was fixed
    not_identifiable: Sequence[NotIdentifiable]
    # the reasons for the order of each axis's plant, for its gain and for its disturbance, where chosen
    orders: dict[str, str]
    notes: Sequence[str]  # everything else noticed
    arms: Mapping[str, ArmSearch]  # the arms that were looked for, by axis
    adapts: Sequence[str]  # axes whose noise is to adapt; all numbers are fitted with noise that does not
    hidden: Mapping[str, float]  # sd of the disturbance that axes without any noise are to have [m or rad]; as above


def run_stage(runs: Sequence[Run], config: FusionConfig, plan: Plan, notify: Notify = ignore) -> Stage:
    """Fit the parameters of a plan; where a combination is not identifiable, fix one of it and go on.

    Raises a PumafuseError where nothing can be fitted.
    """
    likelihood = likelihood_of(runs, config, plan)
    excited, fixed = excited_axes(likelihood, config), list[NotIdentifiable]()
    believed: dict[tuple[str, str], float] = {}  # noise of sensors, when arms are known

    def free(at: FusionConfig) -> list[Parameter]:
        names = [*plan.fixed, *(combination.fixed for combination in fixed)]
        every = parameters(at, config, likelihood.sensors, plan.fit, names, likelihood.resolution, believed)
        return for_few(likelihood, [parameter for parameter in every if _may_vary(parameter, at, plan, excited)])

    start, notes = likelihood.config, list[str]()
    own_delays = set_own_delays(start, excited)
    if any(parameter.fit == "delay" for parameter in free(own_delays)):
        start = own_delays
    if "bias" in plan.fit:
        drifting = set_drifts(start)
        fixed += lone_drifts(likelihood.sensors, free(drifting), config)
        start = set_drifts(start, [combination.fixed for combination in fixed])
    if "noise" in plan.fit:
        start, notes = set_large_biases(likelihood, start, plan.fixed)
    if "latency" in plan.fit:
        fixed += shared_times(likelihood.sensors, excited, free(start), start)
    arms = arm_searches(likelihood, start, free, plan.sd_prior)
    searched = {axis: search for axis, search in arms.items() if search.freedom.free}
    if plan.sd_prior:
        believed |= likelihood.scatter
        believed |= {
            (name, axis): noise for axis, search in arms.items() for name, noise in search.likely_noise.items()
        }
    search = Search(likelihood, free, arms, notify)
    best, orders = search.best(start, plan.one_delay)
    if "noise" in plan.fit:
        biased, more = set_small_biases(likelihood, best, plan.fixed)
        if more:
            best, notes = maximise_with_gates(likelihood, biased, free(biased), notify), [*notes, *more]
    best = _identified(likelihood, best, free, config, fixed, notify)
    best = drop_unseen_noise(likelihood, best, free(best.config))
    used = {name for names in likelihood.sensors.values() for name in names}
    still = [axis for axis in likelihood.sensors if axis not in excited]
    notes += [f"{axis}: does not move; only its noise at rest was fitted" for axis in still]
    notes += [
        f"{name}: was fitted with a gate of {_GATE:g}, not of {sensor.gate:g}: a narrow one would"
        " reject good measurements, too, while it is fitted"
        for name, sensor in config.sensors.items()
        if 0.0 < sensor.gate < _NARROWEST and name in used
    ]
    notes += few_measurements(likelihood, free(best.config))
    hidden = hidden_disturbances(likelihood, best, free(best.config), search.may_be_disturbed(best.config))
    for axis, sd in hidden.items():
        screen = best.config.arm.screen_of(axis)
        why = f"disturbance: none shows, one of {sd * screen.scale:.2g} {screen.unit} may be hidden in the noise"
        orders[axis] = "; ".join([*filter(None, [orders.get(axis)]), why])
    return Stage(likelihood, best, free(best.config), fixed, orders, notes, searched, search.adapts, hidden)


def refitted(stage: Stage, runs: Sequence[Run], config: FusionConfig, plan: Plan, until: float) -> FusionConfig:
    """The numbers of a stage fitted anew to the measurements until then [s after the first command].

    What they are numbers of stays: orders of plants, kinds of gains and of disturbances.
    """
    part = likelihood_of(runs, config, plan, until)
    return maximise_with_gates(part, set_gates(config, part.config), stage.free).config


def likelihood_of(runs: Sequence[Run], config: FusionConfig, plan: Plan, until: float | None = None) -> Likelihood:
    """The likelihood of the runs; where latencies vary, without what one could put before the first command."""
    latest = None
    if "latency" in plan.fit:
        latest = LATENCIES[1] + max((sensor.latency for sensor in config.sensors.values()), default=0.0)
    for name, sensor in config.sensors.items():
        gate = _GATE if 0.0 < sensor.gate < _NARROWEST else min(sensor.gate, _WIDEST)
        config = changed(config, ("sensors", name, "gate"), gate)
    return Likelihood(runs, config, plan.sensors, until=until, latest=latest)


def _may_vary(parameter: Parameter, config: FusionConfig, plan: Plan, excited: Sequence[str]) -> bool:
    """Whether a parameter is not the trusted sensor's, and measurements of its axis can tell it."""
    if parameter.fit == "delay" and parameter.axis is None:
        return plan.trusted is None and any(config.arm.axes[axis].delay is None for axis in excited)
    moves = (
        parameter.axis is None
        or parameter.axis in excited
        or any(as_length(part) in _AT_REST for part in parameter.key.split("."))
    )
    return moves and (plan.trusted is None or parameter.sensor not in (None, plan.trusted))


def _identified(
    likelihood: Likelihood,
    best: Point,
    free: FreeOf,
    configured: FusionConfig,
    fixed: list[NotIdentifiable],
    notify: Notify,
) -> Point:
    """The best point with one parameter fixed of each combination that is not identifiable; appends to ``fixed``.

    It is fixed as configured, unless the measurements know better than that: then as it was found.
    """

    def as_configured(parameter: Parameter) -> FusionConfig:
        return changed(best.config, parameter.path, parameter.configured(configured))

    while (
        len(fixed) < _MOST_FIXED and (combination := not_identifiable(likelihood, best, free(best.config))) is not None
    ):
        (fixed_one,) = (parameter for parameter in free(best.config) if parameter.key == combination.fixed)
        # while no recovery can be set back to none
        other_order = fixed_one.fit == "plant" and fixed_one.configured(configured) is None
        starts = [best.config] if other_order else [as_configured(fixed_one), best.config]
        fixed.append(combination)
        peaks = (maximise_with_gates(likelihood, start, free(start), notify) for start in starts)
        best = next((peak for peak in peaks if peak.log_posterior > best.log_posterior - 0.5 * Z95**2), best)
    for noise in not_identifiable_noise(likelihood, best, free(best.config)):
        start = as_configured(noise)
        without = maximise_with_gates(likelihood, start, [other for other in free(start) if other.key != noise.key])
        if without.log_posterior > best.log_posterior - 0.5 * Z95**2:
            fixed.append(NotIdentifiable((noise.key,), noise.key))
            best = without
    return best


def drop_unseen_noise(likelihood: Likelihood, best: Point, free: Sequence[Parameter]) -> Point:
    """The point without the noise of plants that no measurement sees.

    A quick plant has forgotten by the next measurement what shook it at a command. So any such noise is as likely, and
    error bars in between have no bound.
    """
    for field in ("input_noise", "maneuver_noise"):
        noises = [noise for noise in free if noise.path[-1] == field and noise.number(best.config) > noise.bounds[0]]
        none = best.config
        for noise in noises:
            none = noise.set(none, 0.0)
        lost = best.posteriors - point(likelihood, none, free).posteriors
        unseen = [noise for noise in noises if lost[likelihood.axes.index(str(noise.axis))] < _UNSEEN]
        without = best.config
        for noise in unseen:
            without = noise.set(without, 0.0)
        best = point(likelihood, without, free) if unseen else best
    return best


def hidden_disturbances(
    likelihood: Likelihood, best: Point, free: Sequence[Parameter], axes: Sequence[str]
) -> dict[str, float]:
    """How far ``axes`` without any process noise may stray without showing it: the sd [m or rad] that costs 1.

    No arm is perfect. At a likeliest noise of 0 error bars count none, though measurements exclude only what is larger.
    """
    hidden, misfit = dict[str, float](), likelihood.misfit(best.config)
    for axis in axes:
        process, alone, number = best.config.process[axis], likelihood.of_axis(axis), likelihood.axes.index(axis)
        least = {noise.path[-1] for noise in free if noise.axis == axis and noise.at_bound(best.config) == "lower"}
        if any(getattr(process, field) for field in _NOISES - least):
            continue
        low, high = np.log(_WIDTHS) + np.log(misfit[axis])
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            disturbed = set_disturbance(best.config, axis, float(np.exp(middle)), Process().disturbance_time, "ou")
            falls = best.axes[number] - alone.evaluate(disturbed).axes[number] > 1.0
            low, high = (low, middle) if falls else (middle, high)
        hidden[axis] = float(np.exp(low))
    return hidden


# ---- biases ---------------------------------------------------------------------------------------------------------


def set_large_biases(
    likelihood: Likelihood, config: FusionConfig, fixed: Sequence[str]
) -> tuple[FusionConfig, list[str]]:
    """With a bias for each sensor that is so far off that nothing could be fitted to it, and a note for each."""
    gaps: dict[tuple[str, Kind], float] = {}
    misfit = likelihood.misfit(config)
    for (name, axis), apart in likelihood.apart(config).items():
        gap = abs(float(np.median(np.concatenate(apart))))
        scatter = likelihood.scatter.get((name, axis), 0.0)
        if gap > _FAR * (scatter + misfit[axis] + config.start.offset_sd_of(axis)):
            of = name, config.arm.axes[axis].kind
            gaps[of] = max(gap, gaps.get(of, 0.0))
    notes: list[str] = []
    for (name, kind), gap in gaps.items():
        if _may_be_biased(config, name, kind, fixed):
            config, screen = _set_bias(config, name, kind, _ROOM * gap), SCREEN[kind]
            notes.append(
                f"sensor '{name}' is off by a constant of up to {gap * screen.scale:.4g} {screen.unit}: it was given a"
                " bias to estimate"
            )
    return config, notes


def set_small_biases(likelihood: Likelihood, best: Point, fixed: Sequence[str]) -> tuple[FusionConfig, list[str]]:
    """With a bias for each sensor that contradicts a more accurate one by a constant, and a note for each."""
    config, notes = best.config, list[str]()
    used = {name for names in likelihood.sensors.values() for name in names}
    ranked = sorted((name for name in config.sensors if name in used), key=lambda name: smallest_sd(config, name))
    for name in reversed(ranked[1:]):  # the most accurate is believed, of equals the first in the file
        for kind in config.arm.kinds:
            if not _may_be_biased(config, name, kind, fixed):
                continue
            before = likelihood.evaluate(config).log_likelihood
            biased = [_set_bias(config, name, kind, width) for width in _BIAS_WIDTHS]
            gains = [likelihood.evaluate(biased_config).log_likelihood - before for biased_config in biased]
            best_width = int(np.argmax(gains))
            if gains[best_width] > _BIAS_GAIN:
                config = biased[best_width]
                width = f"{of_kind('bias_sd_mm', kind)} = {_BIAS_WIDTHS[best_width] * SCREEN[kind].scale:.3g}"
                notes.append(
                    f"sensor '{name}' is off by a constant: a bias to estimate ({width}) gains"
                    f" {gains[best_width]:.1f} in log-likelihood"
                )
    return config, notes


def _may_be_biased(config: FusionConfig, name: str, kind: Kind, fixed: Sequence[str]) -> bool:
    """Whether a sensor without a bias on the axes of a kind may be given one."""
    sensor = config.sensors[name]
    biased = any(sensor.bias_sd_of(axis) for axis, model in config.arm.axes.items() if model.kind == kind)
    return not biased and not is_fixed(f"sensors.{name}.{of_kind('bias_sd_mm', kind)}", fixed)


def _set_bias(config: FusionConfig, name: str, kind: Kind, width: float) -> FusionConfig:
    """The configuration with a bias of this width [m or rad], to one digit, of a sensor on the axes of a kind."""
    new = float(f"{width:.0e}")
    if len(config.arm.kinds) > 1:
        sensor, axes = config.sensors[name], config.arm.axes.items()
        new = {axis: new if model.kind == kind else sensor.bias_sd_of(axis) for axis, model in axes}
    return changed(config, ("sensors", name, "bias_sd"), new)
