"""Tuning: :func:`tune`."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import TypeAlias

import msgspec
import numpy as np

from ..arrays import NO_STAMP
from ..errors import PumafuseWarning
from ..fusion.config import FusionConfig
from ..logs.clock import segments
from ..logs.run import Run
from .identifiability import TuneError, correlations, excited_axes
from .intervals import ConfidenceInterval, confidence_intervals
from .likelihood import Likelihood
from .maximise import Notify, Point
from .parameters import Fit, Parameter, changed, check_fixed, kinds_of, parameters, rounded, with_gates_of
from .stage import Plan, Stage, likelihood_of, repeat_stage, reset_stage, run_stage
from .summary import AxisLikelihood, Correlation, TuningSummary, fitted, found_biases
from .validation import Check, check

_FITTED_ON = 2.0 / 3.0  # of a single run; the rest is for validation
_NOTHING = 0.01  # log-likelihood that a noise must gain, or it is 0

Progress: TypeAlias = Callable[[str, Point], None]


@dataclass(frozen=True)
class Tuning:
    """The result of :func:`tune`.

    Attributes:
        config: The tuned configuration, ready for :func:`pumafuse.fuse`.
        before: The configuration as given.
        summary: What ``tuning.json`` holds, in the units of files.
        stages: The stages of the fit: one, or two with a trusted sensor.
    """

    config: FusionConfig
    before: FusionConfig
    summary: TuningSummary
    stages: Sequence[Stage]

    def to_json(self) -> str:
        """The text of ``tuning.json``."""
        return msgspec.json.format(msgspec.json.encode(self.summary), indent=2).decode() + "\n"


def tune(
    runs: Sequence[Run],
    config: FusionConfig,
    *,
    fit: Iterable[Fit] = ("noise",),
    fix: Iterable[str] = (),
    trust: str | None = None,
    validate: Run | None = None,
    progress: Progress = lambda _, __: None,
) -> Tuning:
    """Fit noise, delays, plants, gains and latencies to recorded runs by maximum likelihood; no reference is needed.

    Args:
        runs: The recorded runs to fit on.
        config: The configuration to start from.
        fit: What to fit: any of ``noise``, ``delay``, ``plant``, ``gain``, ``latency``.
        fix: What of that stays as it is: names as in the files, or parts of them (``sensors.tracker``,
            ``drift_mm_rts``).
        trust: An accurate sensor that arm and process noise are fitted on alone. Its latency is believed; of the others
            only noise and latency are fitted then.
        validate: A run to compare before and after on. For None a single run is fitted on its first two thirds,
            validated on the last third, and then fitted once more as a whole.
        progress: Called with what is being done and the best point so far.

    Returns:
        The tuned configuration and its summary. Interrupted by Ctrl-C, the best until then.

    Warns:
        PumafuseWarning: For each note.

    Raises:
        PumafuseError: Nothing can be fitted to the runs, or they and the configuration do not fit together.
    """
    if not runs:
        raise TuneError("no run to fit on")
    for number, run in enumerate(runs):
        if any(_same(run, other) for other in runs[:number]):
            raise TuneError(f"run '{run.name}' is given twice: its measurements would count twice")
    kinds, fixed = kinds_of(fit), list(fix)
    check_fixed(config, fixed)
    pipeline = Pipeline(runs, config, plans(config, kinds, fixed, trust), progress)
    excited_axes(pipeline.likelihood(), config)  # refuses the runs before a part of them is fitted on
    until = _fitted_until(runs[0]) if len(runs) == 1 and validate is None else None
    intervals: dict[str, ConfidenceInterval] = {}
    validation: list[Check] | None = None
    interrupted = False
    try:
        pipeline.fit(until)
        if until is not None:
            validation = check(runs[0], config, pipeline.result(), since=until)
            pipeline.repeat()
        pipeline.keep_the_better()
        if validate is not None:
            validation = check(validate, config, pipeline.result())
        for stage in [] if pipeline.kept else pipeline.stages:
            progress("computing intervals", stage.best)
            intervals |= confidence_intervals(stage.likelihood, stage.best, stage.free)
    except KeyboardInterrupt:
        interrupted = True
        pipeline.keep_the_better()
    stages, names = pipeline.stages, [run.name for run in runs]
    free = [one for stage in stages for one in stage.free]
    if not stages:  # interrupted before the first was complete
        free = parameters(pipeline.best, config, pipeline.likelihood().sensors, kinds, fixed)
    tuned = _with_provenance(pipeline.result(), free, intervals, names)
    notes = [note for stage in stages for note in (*stage.likelihood.notes, *stage.notes)]
    if pipeline.kept:
        notes.append("nothing more likely was found than the configuration as given, which is kept")
    if interrupted:
        notes.append("interrupted: these are the best numbers until then, and not all of them have an interval")
    known = validate is not None and any(_same(validate, run) for run in runs)
    notes += _validation_notes(validation, known, interrupted)
    summary = TuningSummary(
        pumafuse=version("pumafuse"),
        runs=names,
        fit=list(kinds),
        fixed=fixed,
        trusted=trust,
        interrupted=interrupted,
        likelihood=_likelihoods(pipeline.likelihood(), config, tuned),
        parameters=[fitted(one, config, tuned, intervals.get(one.key)) for one in free],
        biases=[one for run in runs for one in found_biases(run, tuned)],
        correlations=[
            Correlation(first=first, second=second, correlation=value)
            for stage in stages
            for first, second, value in correlations(stage.likelihood, stage.best, stage.free)
        ],
        not_identifiable=[str(one) for stage in stages for one in stage.not_identifiable],
        orders={axis: why for stage in stages for axis, why in stage.orders.items()},
        validation=validation,
        worse=any(one.worse for one in validation or ()),
        notes=list(dict.fromkeys(notes)),
    )
    for note in summary.notes:
        warnings.warn(note, PumafuseWarning, stacklevel=2)
    return Tuning(tuned, config, summary, tuple(stages))


def plans(config: FusionConfig, kinds: Sequence[Fit], fixed: Sequence[str], trust: str | None) -> list[Plan]:
    """One plan for all sensors; with a trusted sensor one for it, then one for the others' noise and latency.

    Raises:
        UnknownNameError: The trusted sensor is not configured.
    """
    if trust is None:
        return [Plan(kinds, fixed)]
    config.sensor_names([trust])
    arm: list[Fit] = [kind for kind in kinds if kind != "latency"]
    others: list[Fit] = [kind for kind in kinds if kind in ("noise", "latency")]
    return [Plan(arm, fixed, [trust]), Plan(others, fixed, trusted=trust)]


class Pipeline:
    """Stages one after the other, each from where the last one ended; the best is there at any moment.

    Attributes:
        best: The best configuration so far, with the gates of the search and all digits.
        stages: The stages that are complete.
        kept: Whether the configuration as given is the result.
    """

    def __init__(self, runs: Sequence[Run], config: FusionConfig, plans: Sequence[Plan], progress: Progress) -> None:
        self.runs, self.config, self.plans, self.progress = runs, config, plans, progress
        self.best = config
        self.stages: list[Stage] = []
        self.kept = False

    def fit(self, until: float | None) -> None:
        """Run every stage on the measurements until then [s after the first command].

        Raises:
            TuneError: No stage has any free parameter.
        """
        for plan in self.plans:
            self.stages.append(run_stage(self.runs, self.best, plan, until, self._notify("searching")))
            self.best = self.stages[-1].best.config
        if not any(stage.free for stage in self.stages):
            raise TuneError("everything that could be fitted is fixed: nothing to fit")

    def repeat(self) -> None:
        """Run every stage once more, on all measurements."""
        for number, stage in enumerate(self.stages):
            more = repeat_stage(stage, self.runs, self.best, self._notify("fitting on the whole run"))
            self.stages[number], self.best = more, more.best.config

    def likelihood(self) -> Likelihood:
        """The likelihood of the last stage's measurements, of whole runs."""
        plan = self.stages[-1].plan if self.stages else Plan((), ())
        return likelihood_of(self.runs, self.config, plan)

    def keep_the_better(self) -> None:
        """Go back to the configuration as given if it is more likely: with gates the search may pass worse points."""
        likelihood = self.likelihood()
        before, after = (
            likelihood.evaluate(with_gates_of(config, likelihood.config)).total
            for config in (self.config, self.result())
        )
        if after < before - _NOTHING:
            self.best, self.kept = self.config, True
            self.stages = [reset_stage(stage, self.config) for stage in self.stages]

    def result(self) -> FusionConfig:
        """The best configuration: gates as given, numbers rounded, noise that gains nothing set to 0."""
        best = with_gates_of(self.best, self.config)
        for stage in self.stages:
            mine = [one for one in stage.free if one.given(best) is not None]
            for one in mine:
                best = one.put(best, one.clipped(rounded(one.get(best))))
            for one in mine:
                if one.vanishes and one.at_bound(best) == "lower":
                    none = one.put(best, 0.0)
                    with_it, without = (
                        stage.likelihood.evaluate(with_gates_of(config, stage.likelihood.config)).total
                        for config in (best, none)
                    )
                    if with_it - without < _NOTHING:
                        best = none
        return best

    def _notify(self, what: str) -> Notify:
        def notify(found: Point) -> None:
            self.best = found.config
            self.progress(what, found)

        return notify


def _same(run: Run, other: Run) -> bool:
    """Whether two runs have the same measurements."""
    if run.sensors.keys() != other.sensors.keys():
        return False
    pairs = [(source, other.sensors[name]) for name, source in run.sensors.items()]
    return all(
        np.array_equal(one.stamp, two.stamp)
        and one.values.keys() == two.values.keys()
        and all(np.array_equal(value, two.values[axis], equal_nan=True) for axis, value in one.values.items())
        for one, two in pairs
    )


def _fitted_until(run: Run) -> float | None:
    """Where the part for validation begins [s after the first command]; None where the clock was set back."""
    if len(segments(run)[0]) > 1:
        return None
    stamp = run.command.stamp[run.command.stamp != NO_STAMP]
    return _FITTED_ON * float(stamp.max() - stamp.min()) / 1e9


def _likelihoods(likelihood: Likelihood, before: FusionConfig, after: FusionConfig) -> dict[str, AxisLikelihood]:
    old, new = (likelihood.evaluate(with_gates_of(config, likelihood.config)).axes for config in (before, after))
    return {
        axis: AxisLikelihood(components=int(likelihood.count[n]), before=float(old[n]), after=float(new[n]))
        for n, axis in enumerate(likelihood.axes)
        if likelihood.count[n]
    }


def _with_provenance(
    config: FusionConfig, free: Sequence[Parameter], intervals: Mapping[str, ConfidenceInterval], runs: list[str]
) -> FusionConfig:
    """The configuration with the intervals of the arm's parameters, and the runs they were fitted on."""
    arm = [one for one in free if one.path[0] == "arm" and one.key in intervals]
    for one in arm:
        low, high = intervals[one.key].ci95
        config = changed(config, (*one.path[:-1], f"{one.path[-1]}_ci95"), (rounded(low), rounded(high)))
    return changed(config, ("arm", "provenance", "tuned_on"), runs) if arm else config


def _validation_notes(validation: Sequence[Check] | None, known: bool, interrupted: bool) -> list[str]:
    """What to know of the validation; ``known``: it was on a run that was fitted on."""
    unknown = "whether the numbers hold elsewhere is not known"
    notes = [f"{one.run}, {one.axis}: {one.verdict}" for one in validation or () if one.worse]
    if validation is None and not interrupted:
        notes.append(f"no run was left to validate on (--validate RUN): {unknown}")
    if known and validation:
        notes.append(f"validated on a run that was fitted on: {unknown}")
    if validation == []:
        notes.append(
            "the part to validate on has no measurement of a sensor that is used: whether it is better is not known"
        )
    return notes
