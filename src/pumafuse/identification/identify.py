"""A model of the arm from a campaign of step trials: fits of every trial, their combination, and how well it fits."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from importlib.metadata import version

import msgspec
import numpy as np

from .. import toml, units
from ..model.arm import ArmModel
from ..toml import Interval
from ..units import Kind
from . import anova
from .combine import CombinedAxis, Common, Fitted, coefficients, combine, combined_rms, usual_gain
from .estimate import common
from .fit import StepFit, fit_steps, flags
from .paper import fit_as_published, onset
from .trials import FEWEST_SAMPLES, StepTrials, Trial, TrialsError, first_few

# m, the paper's; rad, of 0.1 degrees, which are a millimetre at 0.57 m from the joint
TOLERANCE: dict[Kind, float] = {"length": 1e-3, "angle": units.si(0.1, "_deg")}
_BATCH = 100  # trials a job
_DIGITS = 6
_PLAUSIBLE = (0.1, 10.0)  # gains
_PLAUSIBLE_LAG = (1e-3, 10.0)  # s


class OrderFit(msgspec.Struct, frozen=True, kw_only=True):
    """One trial's fit of one order; plant parameters of the other order are null, as are infinite ends of intervals."""

    lag: float = msgspec.field(name="lag_ms")  # Td + τ, or Td + 2ζ/ω [s]: behind the held command at constant velocity
    lag_ci95: Interval = msgspec.field(name="lag_ms_ci95")
    gain: float
    gain_ci95: Interval
    delay: float = msgspec.field(name="delay_ms")  # Td [s]
    delay_ci95: Interval = msgspec.field(name="delay_ms_ci95")
    time_constant: float | None = msgspec.field(name="time_constant_ms", default=None)  # τ [s]
    time_constant_ci95: Interval | None = msgspec.field(name="time_constant_ms_ci95", default=None)
    natural_frequency: float | None = msgspec.field(name="natural_frequency_rad_s", default=None)  # ω [rad/s]
    # its interval
    natural_frequency_ci95: Interval | None = msgspec.field(name="natural_frequency_rad_s_ci95", default=None)
    damping: float | None = None  # ζ
    damping_ci95: Interval | None = None
    rms: float = msgspec.field(name="rms_mm")  # of the residuals, eq. 10 [m or rad].
    rms_percent: float  # of the step
    fit_percent: float  # 100 (1 − ‖residuals‖ / ‖position without its mean‖)
    flags: list[str]  # what to know before trusting it


class TrialResult(msgspec.Struct, frozen=True, kw_only=True):
    """One trial.

    Attributes:
        trial: Its name.
        axis: Which was stepped.
        step: By how much [m or rad].
        speed: [m/s or rad/s].
        factors: What else was varied.
        onset: When the arm was first seen to move [s]; null: never.
        first: First-order fit.
        second: Second-order fit.
        common_delay: Td under the plant that its axis's trials have in common [s]; null when left out.
        common_gain: K under it.
        combined_rms: Of the combined model's residuals [m or rad]; null without one.
        left_out: Why it is not in the combined model; null when it is.
    """

    trial: str
    axis: str
    step: float = msgspec.field(name="step_mm")
    speed: float = msgspec.field(name="speed_m_s")
    factors: Mapping[str, str]
    onset: float | None = msgspec.field(name="onset_ms")
    first: OrderFit
    second: OrderFit
    common_delay: float | None = msgspec.field(name="common_delay_ms")
    common_gain: float | None
    combined_rms: float | None = msgspec.field(name="combined_rms_mm")
    left_out: str | None


class Identification(msgspec.Struct, frozen=True, kw_only=True):
    """The model of the arm, and all that it rests on.

    Attributes:
        arm: The combined model.
        method: ``fitted``, or ``published`` as in the paper.
        samples: How many from the step on were used; null: all.
        tolerance: RMS up to which the model is called valid [m or rad].
        trials: Every usable trial.
        axes: The combined model of each axis, with how it came about.
        one_delay: Whether all axes share one delay, in words.
        dependences: The paper's Table I.
        scatter: Normality, outlying trials and replicates of each coefficient.
        performance: The paper's Fig. 7.
        notes: What was left out or repaired, a sentence each.
    """

    arm: ArmModel
    method: str
    samples: int | None
    tolerance: float = msgspec.field(name="tolerance_mm")
    trials: list[TrialResult]
    axes: dict[str, CombinedAxis]
    one_delay: str
    dependences: list[anova.Dependence]
    scatter: list[anova.Scatter]
    performance: list[anova.Performance]
    notes: list[str]

    def __repr__(self) -> str:
        return f"Identification({len(self.trials)} trials: {self.arm!r})"

    @property
    def kind(self) -> Kind:
        """What its axes are: all of one kind, as those of a campaign."""
        return next(iter(self.arm.axes.values())).kind

    def to_json(self) -> str:
        """All of it as JSON, in the units of the names."""
        arm = toml.reported(self.arm) | {
            "axes": {name: toml.reported(axis, axis.kind) for name, axis in self.arm.axes.items()},
            "provenance": self.arm.provenance,
        }
        return toml.json_text(toml.reported(self, self.kind) | {"arm": arm})


def identify(
    trials: StepTrials,
    *,
    period: float | None = None,
    samples: int | None = None,
    paper: bool = False,
    tolerance: float | None = None,
    name: str = "identified arm",
) -> Identification:
    """Identify an arm from step trials.

    Args:
        trials: From :meth:`StepTrials.read`.
        period: T [s]; None: step over speed, where all trials agree on it.
        samples: Use only so many from each step on, as the paper's 30; None: all.
        paper: Read delay and gain off each trial, as the paper does, instead of fitting them.
        tolerance: RMS [m or rad] beyond which the model is not called valid; None: 1 mm, or 0.1 degrees.
        name: Of the arm.

    Raises:
        TrialsError: The period is not known, ``samples`` or ``tolerance`` is none, or no axis has trials enough for a
            model.
    """
    if samples is not None and samples < FEWEST_SAMPLES:
        raise TrialsError(f"samples: at least {FEWEST_SAMPLES} of a trial are needed, not {samples}")
    if tolerance is not None and not 0.0 < tolerance < np.inf:
        raise TrialsError(f"tolerance: must be positive and finite, not {tolerance}")
    period, kind = trials.period(period), trials.kind
    tolerance = TOLERANCE[kind] if tolerance is None else tolerance
    fitted = _fit_all(trials.trials, samples, paper)
    by_axis = {axis: [fit for fit in fitted if fit.trial.axis == axis] for axis in trials.axes}
    usual = {axis: usual_gain(of_axis) for axis, of_axis in by_axis.items()}
    notes, axes, commons = list[str](), dict[str, CombinedAxis](), dict[str, Common]()
    for axis, of_axis in by_axis.items():
        combined = combine(of_axis, period, paper, kind)
        if isinstance(combined, str):
            notes.append(f"{axis}: no model: {combined}")
        else:
            axes[axis], commons[axis] = combined
            notes.extend(f"{axis}: {doubt}" for doubt in _doubts(usual[axis], axes[axis].delays.lag.value))
    if not axes:
        reasons = first_few([*notes, *trials.notes])
        raise TrialsError("; ".join(["no axis has trials enough for a model", *reasons]))
    arm, one_delay = _arm(axes, commons, period, name)
    rms = {
        fit.trial.name: combined_rms(fit.trial, arm.axes[fit.trial.axis], arm.delay_of(fit.trial.axis), period)
        for fit in fitted
        if fit.trial.axis in axes
    }
    left_out = {trial: why for axis in axes.values() for trial, why in axis.left_out.items()}
    rms_of_models: dict[str, dict[str, float]] = {
        trial.name: {"common_delay": delay, "common_gain": gain}
        for common in commons.values()
        for trial, delay, gain in zip(common.trials, common.delay.tolist(), common.gain.tolist(), strict=True)
    }
    used = [fit for fit in fitted if fit.trial.name in rms_of_models]
    factors = anova.factors_of([fit.trial for fit in used], period, kind)
    performance = anova.performances(factors, np.array([rms[fit.trial.name] for fit in used]), tolerance, kind)
    fastest = max(fit.trial.speed_at(period) for fit in used)
    provenance = {
        "made_by": f"pumafuse identify {version('pumafuse')}",
        "trials": {axis: result.trials for axis, result in axes.items()},
        "left_out": left_out,
        "order": {axis: result.choice.why for axis, result in axes.items()},
        "delay": one_delay,
        "delay_spread_ms": {axis: round(result.delay_spread * units.MS, 2) for axis, result in axes.items()},
        "gain": {axis: result.gain_words for axis, result in axes.items()},
        "validity": {tested.factor: tested.verdict for tested in performance},
        "samples": "all" if samples is None else samples,
        "method": "delay and gain read off each trial (--paper)" if paper else "all parameters fitted",
    }
    validity = anova.validity(performance, fastest, kind)
    return Identification(
        arm=_round(msgspec.structs.replace(arm, validity=validity, provenance=provenance)),
        method="published" if paper else "fitted",
        samples=samples,
        tolerance=tolerance,
        trials=[
            TrialResult(
                trial=trial.name,
                axis=trial.axis,
                step=trial.step,
                speed=trial.speed_at(period),
                factors=trial.factors,
                onset=fit.onset if np.isfinite(fit.onset) else None,
                first=_order_fit(fit.first, trial, usual[trial.axis]),
                second=_order_fit(fit.second, trial, usual[trial.axis]),
                **rms_of_models.get(trial.name, {"common_delay": None, "common_gain": None}),
                combined_rms=rms.get(trial.name),
                left_out=left_out.get(trial.name),
            )
            for fit, trial in ((fit, fit.trial) for fit in fitted)
        ],
        axes=axes,
        one_delay=one_delay,
        dependences=anova.dependences({key: values for key, (values, _) in coefficients(used).items()}, factors),
        scatter=[
            anova.scatter(coefficient, [fit.trial for fit in of_axis], values, sd)
            for of_axis in by_axis.values()
            for coefficient, (values, sd) in coefficients(of_axis).items()
        ],
        performance=performance,
        notes=[*trials.notes, *notes],
    )


def _fit_all(trials: Sequence[Trial], samples: int | None, paper: bool) -> list[Fitted]:
    """Every trial with its fits, on all cores where there are many trials."""
    from joblib import Parallel, delayed

    cut = [trial.cut(samples) for trial in trials]
    batches = [cut[first : first + _BATCH] for first in range(0, len(cut), _BATCH)]
    parallel = Parallel(n_jobs=-1 if len(batches) > 1 else 1, return_as="generator")
    try:
        fits = [pair for batch in parallel(delayed(fit_steps)(batch) for batch in batches) for pair in batch]
    except BrokenProcessPool:
        raise TrialsError(
            "a worker process died (out of memory?) while trials were fitted; use fewer, or --samples"
        ) from None
    if paper:
        fits = [
            (fit_as_published(trial, first), fit_as_published(trial, second))
            for trial, (first, second) in zip(cut, fits, strict=True)
        ]
    return [Fitted(cut_trial, *pair, onset(trial)) for trial, cut_trial, pair in zip(trials, cut, fits, strict=True)]


def _doubts(gain: float, lag: float) -> Iterator[str]:
    """What looks wrong about an axis's gain, or about its lag [s]."""
    if gain < 0.0:
        yield "the arm moves against its commands; is a sign wrong?"
    if not _PLAUSIBLE[0] < abs(gain) < _PLAUSIBLE[1]:
        yield f"the arm moves {gain:.3g} times as far as it is commanded; is a unit wrong?"
    if not _PLAUSIBLE_LAG[0] < lag < _PLAUSIBLE_LAG[1]:
        yield f"the arm is {lag:.3g} s behind its commands; is the unit of time wrong?"


def _arm(
    axes: Mapping[str, CombinedAxis], commons: Mapping[str, Common], period: float, name: str
) -> tuple[ArmModel, str]:
    """The arm with one delay, or one for each axis where they differ significantly, and which in words."""
    delays = [common.delay for common in commons.values()]
    every = common(np.concatenate(delays), np.concatenate([common.delay_sd for common in commons.values()]))
    models, p = {axis: result.model for axis, result in axes.items()}, anova.welch(delays)
    if p is not None and p < 0.05:
        words = f"a delay for each axis: they differ (Welch's test, p {'< 0.001' if p < 1e-3 else f'= {p:.2g}'})"
    else:
        models = {axis: msgspec.structs.replace(model, delay=None, delay_ci95=None) for axis, model in models.items()}
        words = "one delay" + ("" if p is None else f": the axes do not differ (Welch's test, p = {p:.2g})")
    return ArmModel(name=name, update_period=period, delay=every.value, delay_ci95=every.ci95, axes=models), words


def _round(arm: ArmModel) -> ArmModel:
    """The arm in six digits of the file's units: more would suggest a precision that it has not."""
    text = json.dumps(units.from_si(msgspec.to_builtins(arm)), default=float)
    tree = json.loads(text, parse_float=lambda number: float(f"{float(number):.{_DIGITS}g}"))
    return msgspec.convert(units.to_si(tree), ArmModel)


def _order_fit(fit: StepFit, trial: Trial, usual: float) -> OrderFit:
    moved = float(np.std(trial.position))
    read = fit.covariance[0, 0] == 0.0  # off the trial, delay and gain: the noise says nothing of their errors
    unknown = (-np.inf, np.inf)
    return OrderFit(
        lag=fit.lag,
        lag_ci95=unknown if read else fit.lag_ci95,
        gain=fit.gain,
        gain_ci95=unknown if read else fit.ci95.gain,
        delay=fit.shape.delay,
        delay_ci95=unknown if read else fit.ci95.delay,
        **msgspec.structs.asdict(fit.plant),
        rms=fit.rms,
        rms_percent=100.0 * fit.rms / abs(trial.step),
        fit_percent=100.0 * (1.0 - fit.rms / moved) if moved > 0.0 else 0.0,
        flags=flags(fit, usual),
    )
