"""Tuning: :func:`tune`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Literal, TypeAlias, cast

import numpy as np

from ..arrays import NEVER, NO_STAMP
from ..errors import ConfigError, PumafuseWarning
from ..fusion.config import FusionConfig, Process
from ..fusion.faults import latency_questions
from ..fusion.placing import add_tool
from ..logs.clock import segments
from ..logs.run import Run
from ..units import MS
from .arm_search import ArmSearch, LagSds
from .arms import Arm
from .identifiability import FEWEST, TuneError, correlations, excited_axes
from .intervals import ConfidenceInterval, Distances, Profile, confidence_intervals, lag_intervals
from .likelihood import Likelihood, Point
from .parameters import (
    Fit,
    Parameter,
    adapting,
    changed,
    check_fixed,
    kinds_of,
    parameters,
    rounded,
    set_disturbance,
    set_gates,
)
from .plain import LONGEST, Doubt, doubts, lag_steps, set_plain_arm
from .stage import Plan, Stage, likelihood_of, refitted, run_stage
from .summary import (
    AxisLikelihood,
    FittedLag,
    TuningSummary,
    encode,
    fitted,
    fitted_lags,
    found_biases,
    open_interval,
    text,
)
from .validation import Check, check

_FITTED_ON = 2.0 / 3.0  # of a single run; the rest is for validation
_LATE = 0.1  # of a run: measurements that begin later are split for themselves
_BEATEN = 0.8  # of the innovations, which another arm must leave to take the place of the likeliest
_UNSEEN = 0.1  # of an update period: a lag that is known better is not worth a note
_NOTHING = 0.01  # log-likelihood by which the configuration as given must be ahead to be kept

Progress: TypeAlias = Callable[[str, float], None]


@dataclass(frozen=True, repr=False)
class Tuning:
    """The result of :func:`tune`.

    Attributes:
        config: The tuned configuration, ready for :func:`pumafuse.fuse`.
        before: The configuration as given.
        details: What ``tuning.json`` holds, in the units of files.
        profiles: The likelihood along each parameter that has an interval, if it was asked for.
    """

    config: FusionConfig
    before: FusionConfig
    details: TuningSummary
    profiles: Sequence[Profile]

    def __repr__(self) -> str:
        return f"Tuning({', '.join(self.details.runs)}: {len(self.details.parameters)} parameters)"

    @property
    def params(self) -> dict[str, float]:
        """The fitted numbers by their keys as in the files, in the units of these: ``sensors.camera.latency_ms``."""
        return {parameter.key: parameter.value for parameter in self.details.parameters}

    def conf_int(self) -> dict[str, tuple[float, float]]:
        """The 95 % interval of each of :attr:`params`, infinite at an end that the measurements do not limit."""
        return {parameter.key: open_interval(parameter.ci95) for parameter in self.details.parameters}

    def summary(self) -> str:
        """The result as a table in plain text: likelihood, lag of each axis, parameters with intervals, notes."""
        return text(self.details)

    def to_json(self) -> str:
        """The text of ``tuning.json``."""
        return encode(self.details)


def tune(
    runs: Run | Sequence[Run],
    config: FusionConfig,
    *,
    fit: Iterable[Fit] = ("noise",),
    fix: Iterable[str] = (),
    trust: str | None = None,
    validate: Run | None = None,
    sd_prior: bool = True,
    share: Iterable[Literal["delay"]] = (),
    intervals: Iterable[Fit] | None = None,
    profiles: bool = False,
    progress: Progress = lambda _, __: None,
) -> Tuning:
    """Fit noise, delays, plants, gains, latencies, scales and drifts to runs by maximum likelihood, without references.

    Args:
        runs: The recorded run to fit on, or several.
        config: The configuration to start from.
        fit: What to fit: any of ``noise``, ``delay``, ``plant``, ``gain``, ``latency``, ``scale``, ``bias``.
        fix: What of that stays as it is: names as in the files, or parts of them (``sensors.tracker``,
            ``drift_mm_rts``).
        trust: An accurate sensor that arm and process noise are fitted on alone. Its latency is believed; of the others
            only noise, latency and scale are fitted then.
        validate: A run to compare before and after on. For None the numbers that were found on a single run are fitted
            anew to its first two thirds, and compared on the last third.
        sd_prior: Whether a sensor's noise is believed to be what second differences of its measurements show, within a
            factor of 2 (log-normal, one standard deviation); else the likelihood alone decides.
        share: ``delay``: all axes share one whatever the measurements say. Else those share one to which an own one is
            not worth its number (Bayesian information criterion).
        intervals: The kinds of what is fitted that get intervals, which take up to half of the time; None: all. A lag
            has one anyway.
        profiles: Whether to compute the likelihood along each parameter, too, to draw it and to look for a second
            maximum: that takes about a tenth longer.
        progress: Called with what is being done and the best log-likelihood so far.

    Returns:
        The tuned configuration and how sure it is. Interrupted by Ctrl-C, the best until then.

    Warns:
        PumafuseWarning: For each note.

    Raises:
        PumafuseError: Nothing can be fitted to the runs, or they and the configuration do not fit together.
    """
    runs = [runs] if isinstance(runs, Run) else runs
    kinds, fixed = kinds_of(fit), list(fix)
    _check(runs, config, kinds, fixed, share)
    config = add_tool(config, runs[0])
    plan = Plan(kinds, fixed, sd_prior=sd_prior, one_delay="delay" in share)
    pipeline = Pipeline(runs, config, plans(config, plan, trust), progress)
    excited_axes(pipeline.whole, config)  # refuses the runs before a part of them is fitted on
    doubted_axes: dict[str, Doubt] = {}
    doubted: list[str] = []
    until = None
    fewest = min((count for count in pipeline.whole.count.tolist() if count > 0), default=0)  # of an axis
    if len(runs) == 1 and validate is None and _FITTED_ON * fewest >= FEWEST:
        until = _fitted_until(runs[0])
    asked = kinds if intervals is None else kinds_of(intervals)
    by_key: dict[str, ConfidenceInterval] = {}
    around: dict[str, Distances] = {}
    validation: list[Check] | None = None
    interrupted = False
    try:
        pipeline.fit()
        doubted_axes = pipeline.doubts() if "noise" in kinds else {}
        sentences = {axis: doubt.sentence(pipeline.result(), axis) for axis, doubt in doubted_axes.items()}
        doubted = [f"{axis}: {sentence}" for axis, sentence in sentences.items() if sentence]
        if refuted := [axis for axis, doubt in doubted_axes.items() if doubt.refutes]:
            held, start = replace(plan, fixed=[*fixed, *(f"axes.{axis}" for axis in refuted)]), config
            for axis in refuted:
                start = set_plain_arm(start, axis, doubted_axes[axis].plain.arm)
            pipeline = Pipeline(runs, start, plans(start, held, trust), progress)
            pipeline.fit()
        if validate is not None:
            validation = check(validate, config, pipeline.result())
        elif until is not None:
            progress("validating", pipeline.log_likelihood)
            validation = check(runs[0], config, pipeline.fitted_until(until), since=until)
        for stage in pipeline.stages:
            progress("computing intervals", stage.best.log_likelihood)
            around |= lag_intervals(stage.likelihood, stage.best, stage.free)
            some = [parameter for parameter in stage.free if parameter.fit in asked]
            by_key |= confidence_intervals(stage.likelihood, stage.best, stage.free, some, drawn=profiles)
    except KeyboardInterrupt:
        interrupted = True
        pipeline.keep_the_better()
    stages, names = pipeline.stages, [run.name for run in runs]
    free = [parameter for stage in stages for parameter in stage.free]
    if not stages:  # the configuration as given, or interrupted before a stage was complete
        free = parameters(pipeline.best, config, pipeline.whole.sensors, kinds, fixed)
    result, arms = pipeline.result(), {axis: search for stage in stages for axis, search in stage.arms.items()}
    lost = [axis for axis, search in arms.items() if search.plain is None or result.arm.lag_of(axis) > LONGEST]
    unmeasured = [*lost, *(axis for axis in result.arm.axes if axis not in pipeline.whole.sensors)]
    searched = {axis: search for axis, search in arms.items() if {"delay", "lag"} & set(search.freedom.free)}
    allowed = {axis: search.lag_ci95 for axis, search in searched.items() if search.in_step}
    allowed |= {axis: doubt.lag_ci95 for axis, doubt in doubted_axes.items()}
    lags = fitted_lags(free, config, result, around, allowed, unmeasured)
    lag_sds = {
        axis: search.lag_sds(Arm.of(result.arm.axes[axis], result.arm.delay_of(axis)), search.posterior.mixture())
        for axis, search in searched.items()
    }
    tuned = _set_provenance(result, free, by_key, {} if interrupted else lags, lag_sds, names)
    doubted += _unseen_notes(searched, lag_sds, result)
    doubted += lag_steps({axis: search.plain for axis, search in arms.items()}, tuned)
    notes = [*doubted, *pipeline.notes, *(f"{axis}: no lag up to {LONGEST:g} s explains its motion" for axis in lost)]
    if interrupted:
        notes.append("interrupted: these are the best numbers until then, and not all of them have an interval")
    seen = validate is not None and any(_same(validate, run) for run in runs)
    notes += _seen_before(config, runs[0] if validate is None else validate, validation)
    notes += [*latency_questions(tuned, pipeline.whole.share_after_end), *pipeline.whole.overruns(tuned.arm)]
    notes += _validation_notes(validation, seen, interrupted)
    summary = TuningSummary(
        pumafuse=version("pumafuse"),
        runs=names,
        parts={run.name: (run.since, run.until) for run in runs if run.interval},
        commands=pipeline.whole.commands,
        rows=pipeline.whole.rows,
        fit=list(kinds),
        fixed=fixed,
        trusted=trust,
        sd_prior=sd_prior,
        interrupted=interrupted,
        likelihood=_likelihoods(pipeline.whole, config, tuned),
        lags=lags,
        parameters=[fitted(parameter, config, tuned, by_key.get(parameter.key)) for parameter in free],
        biases=[bias for run in runs for bias in found_biases(run, tuned)],
        correlations=[
            correlation for stage in stages for correlation in correlations(stage.likelihood, stage.best, stage.free)
        ],
        not_identifiable=[str(combination) for stage in stages for combination in stage.not_identifiable],
        orders={axis: why for stage in stages for axis, why in stage.orders.items()},
        validation=validation,
        worse=any(check.worse for check in validation or ()),
        notes=list(dict.fromkeys(notes)),
    )
    for note in summary.notes:
        warnings.warn(note, PumafuseWarning, stacklevel=2)
    return Tuning(tuned, config, summary, [interval.profile for interval in by_key.values()] if profiles else [])


def _check(
    runs: Sequence[Run], config: FusionConfig, kinds: Sequence[Fit], fixed: Sequence[str], share: Iterable[str]
) -> None:
    """Whether it can be fitted as asked.

    Raises:
        PumafuseError: No run, one twice, or a name to fix or a word to share that means nothing.
    """
    if not runs:
        raise TuneError("no run to fit on; give one at least")
    for number, run in enumerate(runs):
        if any(_same(run, other) for other in runs[:number]):
            raise TuneError(f"run '{run.name}' is given twice: its measurements would count twice; give it once")
    check_fixed(config, fixed)
    for word in share:
        if word != "delay":
            raise ConfigError(f"--share: unknown '{word}'; accepted: delay")
        if "delay" not in kinds:
            raise ConfigError("--share delay: delays are not fitted; add delay to --fit")


def plans(config: FusionConfig, whole: Plan, trust: str | None) -> list[Plan]:
    """One plan for all sensors; with a trusted sensor one for it, then one for the others' noise, latency and scale.

    Raises:
        UnknownNameError: The trusted sensor is not configured.
    """
    if trust is None:
        return [whole]
    config.sensor_names([trust])
    arm: list[Fit] = [kind for kind in whole.fit if kind not in ("latency", "scale", "bias")]
    others: list[Fit] = [kind for kind in whole.fit if kind in ("noise", "latency", "scale", "bias")]
    return [replace(whole, fit=arm, sensors=[trust]), replace(whole, fit=others, trusted=trust, one_delay=False)]


class Pipeline:
    """Stages one after the other, each from where the last one ended; the best is there at any moment."""

    def __init__(self, runs: Sequence[Run], config: FusionConfig, plans: Sequence[Plan], progress: Progress) -> None:
        self.runs, self.config, self.plans, self.progress = runs, config, plans, progress
        self.whole = likelihood_of(runs, config, plans[-1])  # of all measurements
        self.best = config  # so far, with the gates of the search and all digits
        self.stages: list[Stage] = []  # that are complete; none where the configuration as given is the result
        self.notes: list[str] = []

    def fit(self) -> None:
        """Run every stage; the configuration as given stays where it is more likely.

        Raises:
            TuneError: No stage has any free parameter.
        """
        config, stages = self.config, list[Stage]()

        def notify(point: Point) -> None:
            self.best, self.stages = point.config, stages
            self.progress("searching", point.log_likelihood)

        for plan in self.plans:
            stages.append(run_stage(self.runs, config, plan, notify))
            config = stages[-1].best.config
        if not any(stage.free for stage in stages):
            why = [str(combination) for stage in stages for combination in stage.not_identifiable]
            raise TuneError("; ".join([*why, "everything that could be fitted is fixed: nothing to fit; fix less"]))
        self.best, self.stages = config, stages
        self.notes = [note for stage in stages for note in (*stage.likelihood.notes, *stage.notes)]
        self.keep_the_better()

    def fitted_until(self, until: float) -> FusionConfig:
        """The result with its numbers fitted anew to the measurements until then [s after the first command]."""
        config = self.best
        for plan, stage in zip(self.plans, self.stages, strict=False):  # none where the configuration as given is kept
            config = refitted(stage, self.runs, config, plan, until)
        return self._for_use(self._written(config, rounded))

    @property
    def log_likelihood(self) -> float:
        """The log-likelihood of the best configuration."""
        return _evaluated(self.whole, self.best).log_likelihood

    def doubts(self) -> dict[str, Doubt]:
        """Doubts about the arms that were fitted: see :func:`.plain.doubts`."""
        arms, config = {axis: search for stage in self.stages for axis, search in stage.arms.items()}, self.result()
        doubts_by_axis = doubts({axis: search.plain for axis, search in arms.items()}, config)
        return {
            axis: doubt._replace(is_beaten=self._is_beaten(axis, doubt, config))
            for axis, doubt in doubts_by_axis.items()
        }

    def _is_beaten(self, axis: str, doubt: Doubt, config: FusionConfig) -> bool:
        """Whether the arm of least squares predicts the next measurement better, the noise being as it is."""
        likelihood = self.whole.of_axis(axis)
        instead = set_plain_arm(config, axis, doubt.plain.arm)
        return likelihood.innovation(instead) < _BEATEN * likelihood.innovation(config)

    def keep_the_better(self) -> None:
        """Go back to the configuration as given if it is more likely: with gates the search may pass worse points."""
        before, after = (_evaluated(self.whole, config).log_likelihood for config in (self.config, self._rounded()))
        if after < before - _NOTHING:
            self.best, self.stages = self.config, []
            self.notes.append("nothing more likely was found than the configuration as given, which is kept")

    def result(self) -> FusionConfig:
        """The best configuration, with what the fit itself leaves out: disturbances that may be hidden, adaptation."""
        return self._for_use(self._rounded())

    def _for_use(self, config: FusionConfig) -> FusionConfig:
        for axis, sd in (pair for stage in self.stages for pair in stage.hidden.items()):
            config = set_disturbance(config, axis, rounded(sd), Process().disturbance_time, "ou")
        for axis in (axis for stage in self.stages for axis in stage.adapts):
            config = adapting(config, axis)
        return config

    def _rounded(self) -> FusionConfig:
        """The best configuration: gates as given, numbers rounded, and 0 for a noise at its lower bound.

        A maximum may lie where a gate just takes a row: numbers that leave it by being rounded keep their digits.
        """
        rounded_config, exact = self._written(self.best, rounded), self._written(self.best, float)
        lost = (
            _evaluated(stage.likelihood, exact).log_likelihood
            - _evaluated(stage.likelihood, rounded_config).log_likelihood
            for stage in self.stages
        )
        return exact if any(loss > _NOTHING for loss in lost) else rounded_config

    def _written(self, config: FusionConfig, number: Callable[[float], float]) -> FusionConfig:
        """A configuration with the numbers as they are to be written."""
        best = set_gates(config, self.config)
        for parameter in (
            parameter for stage in self.stages for parameter in stage.free if parameter.configured(best) is not None
        ):
            none = parameter.vanishes and parameter.at_bound(best) == "lower"
            best = parameter.set(best, 0.0 if none else parameter.clipped(number(parameter.number(best))))
        return best


def _evaluated(likelihood: Likelihood, config: FusionConfig) -> Point:
    """The log-likelihood of a configuration under the gates that the likelihood was made with."""
    return likelihood.evaluate(set_gates(config, likelihood.config))


def _same(run: Run, other: Run) -> bool:
    """Whether two runs have the same measurements, and the parts of them to use overlap."""
    (since, until), (begin, end) = run.ends(0), other.ends(0)
    if until <= begin or end <= since:
        return False
    rows, other_rows = (
        {
            name: (source.stamp.tobytes(), {axis: value.tobytes() for axis, value in source.values.items()})
            for name, source in each.sensors.items()
        }
        for each in (run, other)
    )
    return rows == other_rows


def _fitted_until(run: Run) -> float | None:
    """Where the part for validation begins [s after the first command]; None where the clock was set back."""
    if len(segments(run)[0]) > 1:
        return None
    stamp = run.command.stamp[run.command.stamp != NO_STAMP]
    since, end = run.since or 0.0, float(stamp.max() - stamp.min()) / 1e9
    end = min(end, run.until or end)
    first = min(
        float(np.min(sensor.stamp[sensor.stamp != NO_STAMP], initial=NEVER) - stamp.min()) / 1e9
        for sensor in run.sensors.values()
    )
    if since + _LATE * (end - since) < first < end:
        since = first
    return since + _FITTED_ON * (end - since)


def _likelihoods(likelihood: Likelihood, before: FusionConfig, after: FusionConfig) -> dict[str, AxisLikelihood]:
    old, new = (_evaluated(likelihood, config).axes.tolist() for config in (before, after))
    numbers = zip(likelihood.axes, likelihood.count.tolist(), old, new, strict=True)
    return {axis: AxisLikelihood(components=n, before=value, after=two) for axis, n, value, two in numbers if n}


def _set_provenance(
    config: FusionConfig,
    free: Sequence[Parameter],
    intervals: Mapping[str, ConfidenceInterval],
    lags: Mapping[str, FittedLag],
    lag_sds: Mapping[str, LagSds | None],
    runs: list[str],
) -> FusionConfig:
    """The configuration with the intervals of the arm's parameters and lags, and the runs they were fitted on."""
    arm = [parameter for parameter in free if parameter.path[0] == "arm" and parameter.key in intervals]
    for parameter in arm:
        interval = intervals[parameter.key]
        low, high = (
            unlimited if is_open else rounded(end)
            for unlimited, is_open, end in zip((parameter.least, math.inf), interval.open, interval.ci95, strict=True)
        )
        config = changed(config, (*parameter.path[:-1], f"{parameter.path[-1]}_ci95"), (low, high))
    for axis, lag in lags.items():
        low, high = (rounded(end / MS) for end in open_interval(lag.lag_ms_ci95))
        config = changed(config, ("arm", "axes", axis, "lag_ci95"), (low, high))
    for axis, sds in lag_sds.items():
        seen, unseen = (rounded(sds.seen), rounded(sds.unseen)) if sds else (None, None)
        for name, sd in (("seen_lag_sd", seen), ("unseen_lag_sd", unseen)):
            config = changed(config, ("arm", "axes", axis, name), sd)
    earlier = _tuned_on(config)  # what is not fitted now is from there
    return changed(config, ("arm", "provenance", "tuned_on"), [*(run for run in earlier if run not in runs), *runs])


def _tuned_on(config: FusionConfig) -> list[str]:
    """The runs on which a configuration was fitted, by the provenance of its arm."""
    tuned_on: object = config.arm.provenance.get("tuned_on", [])
    return [str(run) for run in cast(list[object], tuned_on)] if isinstance(tuned_on, list) else [str(tuned_on)]


def _unseen_notes(
    arms: Mapping[str, ArmSearch], lag_sds: Mapping[str, LagSds | None], config: FusionConfig
) -> list[str]:
    """A sentence for sensors in step with commands, where arms that say the same of all measurements are far apart."""
    off = dict[tuple[str, float], list[str]]()
    for axis, (_, unseen, apart) in ((axis, sds) for axis, sds in lag_sds.items() if sds):
        names, phase, screen = arms[axis].sensors, arms[axis].phase, config.arm.screen_of(axis)
        is_noise = apart < min(config.sensors[name].sd_of(axis) or 0.0 for name in names)
        if phase is not None and unseen > _UNSEEN * config.arm.update_period and not is_noise:
            late = round(1e3 * phase * config.arm.update_period)
            size = f"{apart * screen.scale:.2g} {screen.unit} on {axis}"
            off.setdefault((" and ".join(names), late), []).append(size)
    return [
        f"{names}: {late} ms after each command, which is one instant of each step; of the rest nothing tells: at the"
        f" commands arms that are as likely differ by about {', '.join(sizes)}, which error bars count"
        " (unseen_lag_sd_ms in arm.toml). A controller that goes on between commands is told by interpolation_ms in"
        " run.toml; a sensor of another rate tells, too"
        for (names, late), sizes in off.items()
    ]


def _seen_before(config: FusionConfig, run: Run, validation: Sequence[Check] | None) -> list[str]:
    """A sentence if the configuration to start from was fitted on what the result was validated on."""
    if not validation or run.name not in _tuned_on(config):
        return []
    return [
        f"the configuration as given was fitted on '{run.name}' (tuned_on in [provenance] of its arm), so that it knows"
        " the part validated on: the comparison with it says little; start from one that does not, or --validate"
        " another run"
    ]


def _validation_notes(validation: Sequence[Check] | None, seen: bool, interrupted: bool) -> list[str]:
    """What to know of the validation; ``seen``: it was on a run that was fitted on."""
    beside = "what was fitted, beside what it began with, on measurements that neither was fitted on"
    notes = [f"{check.run}, {check.axis}: {beside}: {check.verdict}" for check in validation or () if check.worse]
    why = ""
    if validation is None and not interrupted:
        why = "no run was left to validate on (--validate RUN)"
    elif validation == []:
        why = "the part to validate on has no measurement of a sensor that is used"
    elif seen and validation:
        why = "validated on a run that was fitted on"
    return [*notes, f"{why}: whether the numbers hold elsewhere is not known"] if why else notes
