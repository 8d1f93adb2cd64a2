"""Tuning: :func:`tune`."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version

import msgspec
import numpy as np

from ..arrays import NO_STAMP
from ..errors import PumafuseWarning
from ..fusion.config import FusionConfig
from ..model.arm import AxisModel
from ..runs.clock import segments
from ..runs.run import Run
from .climb import Point
from .diagnose import at_bound
from .intervals import Sure, sureness
from .learnable import TuneError, moving
from .lesson import Lesson, Syllabus, again, evidence_of, learn
from .likelihood import Evidence
from .parameters import Fit, Parameter, check_holds, kinds_of, parameters
from .summary import Likelihood, TuningSummary, biases, correlated, fitted, told
from .validate import Check, check
from .variants import with_gates_of

_LEARNT = 2.0 / 3.0  # of a single run; the rest is held back
_NOTHING = 0.01  # log-likelihood that a noise must be worth, or it is none
_DIGITS = 6  # of the numbers written: more would only look exact

_replace = msgspec.structs.replace
Progress = Callable[[str, Point], None]


@dataclass(frozen=True)
class Tuning:
    """What :func:`tune` returns.

    Attributes:
        config: The configuration with what was learnt, ready for :func:`pumafuse.fuse`.
        before: The configuration as given.
        summary: Everything said of it, in the units of files.
        lessons: The searches behind it: one, or two with a teacher.
    """

    config: FusionConfig
    before: FusionConfig
    summary: TuningSummary
    lessons: Sequence[Lesson]

    def to_json(self) -> str:
        """The text of ``tuning.json``."""
        return msgspec.json.format(msgspec.json.encode(self.summary), indent=2).decode() + "\n"


def tune(
    runs: Sequence[Run],
    config: FusionConfig,
    *,
    fit: Iterable[Fit] = ("noise",),
    hold: Iterable[str] = (),
    teacher: str | None = None,
    validate: Run | None = None,
    progress: Progress = lambda _, __: None,
) -> Tuning:
    """Let recorded runs tell noise, delays, plant, gain and latencies by maximum likelihood; no truth is needed.

    Args:
        runs: The recorded runs to learn from.
        config: What is known before.
        fit: What to fit: any of ``noise``, ``delay``, ``plant``, ``gain``, ``latency``.
        hold: What of that stays as it is: names as in the files, or parts of them (``sensors.tracker``,
            ``drift_mm_rts``).
        teacher: A good sensor that teaches the arm and its noise alone. Its latency is believed; of the others only
            their own noise and latency are learnt then.
        validate: A run to compare before and after on. For None the last third of a single run is held back for that,
            and after it the numbers are learnt once more from the whole.
        progress: Called with what is being done and the best point so far.

    Returns:
        The tuned configuration and all that is to be said of it. Interrupted by Ctrl-C, the best until then.

    Warns:
        PumafuseWarning: For each note.

    Raises:
        PumafuseError: Nothing can be learnt from the runs, or they and the configuration do not fit together.
    """
    if not runs:
        raise TuneError("no run to learn from")
    _refuse_twice(runs)
    kinds, names = kinds_of(fit), list(hold)
    check_holds(config, names)
    syllabi = _syllabi(config, kinds, names, teacher)
    course = _Course(runs, config, progress)
    moving(course.evidence(), config)  # of the whole, before a part of it is asked
    until = _held_back(runs[0]) if len(runs) == 1 and validate is None else None
    sure: dict[str, Sure] = {}
    validation: list[Check] | None = None
    interrupted = False
    try:
        course.take(syllabi, until)
        if until is not None:
            validation = check(runs[0], config, course.result(), since=until)
            course.repeat()
        course.keep_the_better()
        if validate is not None:
            validation = check(validate, config, course.result())
        for lesson in [] if course.kept else course.lessons:
            progress("asking how sure it is", lesson.best)
            sure |= sureness(lesson.evidence, lesson.best, lesson.free)
    except KeyboardInterrupt:
        interrupted = True
        course.keep_the_better()
    tuned = _with_provenance(course.result(), sure, [run.name for run in runs])
    summary = TuningSummary(
        pumafuse=version("pumafuse"),
        runs=[run.name for run in runs],
        fit=list(kinds),
        hold=names,
        teacher=teacher,
        interrupted=interrupted,
        likelihood=_likelihoods(course.evidence(), config, tuned),
        parameters=[fitted(one, config, tuned, sure.get(one.key)) for one in course.free(kinds, names)],
        biases=[one for run in runs for one in biases(run, tuned)],
        correlations=[pair for lesson in course.lessons for pair in correlated(lesson)],
        held=[told(tie) for lesson in course.lessons for tie in lesson.ties],
        orders={axis: why for lesson in course.lessons for axis, why in lesson.orders.items()},
        validation=validation,
        worse=any(one.worse for one in validation or ()),
        notes=_notes(course, validation, interrupted),
    )
    for note in summary.notes:
        warnings.warn(note, PumafuseWarning, stacklevel=2)
    return Tuning(tuned, config, summary, tuple(course.lessons))


class _Course:
    """Lessons one after the other, each from where the last one ended; what was best last is kept at any moment."""

    def __init__(self, runs: Sequence[Run], config: FusionConfig, progress: Progress) -> None:
        self.runs, self.config, self.progress = runs, config, progress
        self.best = config
        self.lessons: list[Lesson] = []
        self.kept = False  # whether the configuration as given is the result

    def take(self, syllabi: Sequence[Syllabus], until: float | None) -> None:
        """Every lesson.

        Raises:
            TuneError: Nothing may move in any of them.
        """
        for syllabus in syllabi:
            self.lessons.append(learn(self.runs, self.best, syllabus, until, self._following("searching")))
            self.best = self.lessons[-1].best.config
        if not any(lesson.free for lesson in self.lessons):
            raise TuneError("everything that could be fitted is held: nothing to learn")

    def repeat(self) -> None:
        """All lessons once more, from all readings."""
        for number, lesson in enumerate(self.lessons):
            more = again(lesson, self.runs, self.best, self._following("learning from the whole run"))
            self.lessons[number], self.best = more, more.best.config

    def evidence(self) -> Evidence:
        """The readings of the last lesson, from the whole of the runs."""
        syllabus = self.lessons[-1].syllabus if self.lessons else Syllabus((), ())
        return evidence_of(self.runs, self.config, syllabus, None)

    def free(self, kinds: Sequence[Fit], hold: Sequence[str]) -> list[Parameter]:
        """What was fitted, or what was to be."""
        if not self.lessons:
            return parameters(self.best, self.config, self.evidence().heard, kinds, hold)
        return [one for lesson in self.lessons for one in lesson.free]

    def keep_the_better(self) -> None:
        """Of the last point and the configuration as given: gates make the way to a better one long."""
        evidence = self.evidence()
        before, after = (
            evidence.value(with_gates_of(config, evidence.config)).total for config in (self.config, self.result())
        )
        if after < before - _NOTHING:
            self.best, self.kept = self.config, True

    def result(self) -> FusionConfig:
        """The best configuration: gates as they were, rounded, and without the noise that is worth nothing."""
        best = with_gates_of(self.best, self.config)
        for lesson in self.lessons:
            mine = [one for one in lesson.free if one.given(best) is not None]
            for one in mine:
                best = one.put(best, one.inside(float(f"{one.get(best):.{_DIGITS}g}")))
            for one in mine:
                none = one.put(best, 0.0) if one.vanishes and at_bound(one, best) == "least" else best
                if none is not best and self._worth(lesson, best) - self._worth(lesson, none) < _NOTHING:
                    best = none
        return best

    @staticmethod
    def _worth(lesson: Lesson, config: FusionConfig) -> float:
        """The log-likelihood of a lesson's readings with the gates of the lesson."""
        return lesson.evidence.value(with_gates_of(config, lesson.evidence.config)).total

    def _following(self, what: str) -> Callable[[Point], None]:
        def tell(found: Point) -> None:
            self.best = found.config
            self.progress(what, found)

        return tell


def _syllabi(config: FusionConfig, kinds: Sequence[Fit], hold: Sequence[str], teacher: str | None) -> list[Syllabus]:
    """One lesson from all sensors; with a teacher one from it, then one on the others' noise and latency."""
    if teacher is None:
        return [Syllabus(kinds, hold)]
    config.sensor_names([teacher])
    arm: list[Fit] = [kind for kind in kinds if kind != "latency"]
    others: list[Fit] = [kind for kind in kinds if kind in ("noise", "latency")]

    def of_others(one: Parameter) -> bool:
        return one.sensor not in (None, teacher)

    return [Syllabus(arm, hold, [teacher]), Syllabus(others, hold, None, of_others)]


def _refuse_twice(runs: Sequence[Run]) -> None:
    """Readings that count twice would make the intervals too narrow.

    Raises:
        TuneError: A run is given twice.
    """
    for number, run in enumerate(runs):
        for other in runs[:number]:
            if _same(run, other):
                raise TuneError(f"run '{run.name}' is given twice: its readings would count twice")


def _same(run: Run, other: Run) -> bool:
    """Whether two runs have the same readings."""
    if run.sensors.keys() != other.sensors.keys():
        return False
    pairs = [(source, other.sensors[name]) for name, source in run.sensors.items()]
    return all(
        np.array_equal(one.stamp, two.stamp)
        and one.values.keys() == two.values.keys()
        and all(np.array_equal(value, two.values[axis], equal_nan=True) for axis, value in one.values.items())
        for one, two in pairs
    )


def _held_back(run: Run) -> float | None:
    """From when on a single run is held back [s after the first command]; None where its clock was set back."""
    if len(segments(run)[0]) > 1:
        return None
    stamp = run.command.stamp[run.command.stamp != NO_STAMP]
    return _LEARNT * float(stamp.max() - stamp.min()) / 1e9


def _likelihoods(evidence: Evidence, before: FusionConfig, after: FusionConfig) -> dict[str, Likelihood]:
    old, new = (evidence.value(with_gates_of(config, evidence.config)).axes for config in (before, after))
    return {
        axis: Likelihood(scalars=int(evidence.count[n]), before=float(old[n]), after=float(new[n]))
        for n, axis in enumerate(evidence.axes)
        if evidence.count[n]
    }


def _with_provenance(config: FusionConfig, sure: Mapping[str, Sure], runs: Sequence[str]) -> FusionConfig:
    """The arm with the intervals of what was fitted, and where it is from."""
    axes: dict[str, AxisModel] = {}
    for axis, model in config.arm.axes.items():
        found = {
            key.removeprefix(f"axes.{axis}."): one.ci95 for key, one in sure.items() if key.startswith(f"axes.{axis}.")
        }
        for key, ci95 in found.items():
            interval = tuple(float(f"{end:.{_DIGITS}g}") for end in ci95)
            match key:
                case "delay_ms":
                    model = _replace(model, delay_ci95=interval)
                case "gain.intercept":
                    model = _replace(model, gain=_replace(model.gain, intercept_ci95=interval))
                case "gain_recovery_ms":
                    model = _replace(model, gain_recovery_ci95=interval)
                case _:
                    name = key.removesuffix("_ms").removesuffix("_rad_s")
                    model = _replace(model, plant=_replace(model.plant, **{f"{name}_ci95": interval}))
        axes[axis] = model
    tuned = any(key.startswith("axes.") for key in sure)
    provenance = {**config.arm.provenance, "tuned_on": list(runs)} if tuned else config.arm.provenance
    return _replace(config, arm=_replace(config.arm, axes=axes, provenance=provenance))


def _notes(course: _Course, validation: Sequence[Check] | None, interrupted: bool) -> list[str]:
    found = [note for lesson in course.lessons for note in (*lesson.evidence.notes, *lesson.notes)]
    if course.kept:
        found.append("nothing more likely was found than the configuration as given, which is kept")
    if interrupted:
        found.append(
            "interrupted: these are the best numbers until then, and not all of them were asked how sure they are"
        )
    elif validation is None:
        found.append(
            "nothing was held back to validate on (--validate RUN): nothing says whether the numbers hold elsewhere"
        )
    if validation == []:
        found.append("what was held back has no reading of a sensor that is used: nothing says whether it helped")
    found += [f"{one.run}, {one.axis}: {one.verdict}" for one in validation or () if one.worse]
    return list(dict.fromkeys(found))
