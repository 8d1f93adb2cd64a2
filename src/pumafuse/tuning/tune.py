"""Tuning: :func:`tune`."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version

import msgspec
import numpy as np

from ..arrays import NO_STAMP
from ..errors import PumafuseWarning
from ..fusion.config import FusionConfig
from ..logs.clock import segments
from ..logs.run import Run
from ..model.arm import AxisModel
from .course import Course, Progress, syllabi
from .intervals import ConfidenceInterval, confidence_intervals
from .learnable import TuneError, moving
from .lesson import Lesson
from .likelihood import Evidence
from .parameters import Fit, check_holds, kinds_of, rounded
from .summary import Likelihood, TuningSummary, biases, correlated, fitted, told
from .validate import Check, check
from .variants import with_gates_of

_LEARNT = 2.0 / 3.0  # of a single run; the rest is held back

_replace = msgspec.structs.replace


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
    lessons = syllabi(config, kinds, names, teacher)
    course = Course(runs, config, progress)
    moving(course.evidence(), config)  # of the whole, before a part of it is asked
    until = _held_back(runs[0]) if len(runs) == 1 and validate is None else None
    intervals: dict[str, ConfidenceInterval] = {}
    validation: list[Check] | None = None
    interrupted = False
    try:
        course.take(lessons, until)
        if until is not None:
            validation = check(runs[0], config, course.result(), since=until)
            course.repeat()
        course.keep_the_better()
        if validate is not None:
            validation = check(validate, config, course.result())
        for lesson in [] if course.kept else course.lessons:
            progress("asking how sure it is", lesson.best)
            intervals |= confidence_intervals(lesson.evidence, lesson.best, lesson.free)
    except KeyboardInterrupt:
        interrupted = True
        course.keep_the_better()
    tuned = _with_provenance(course.result(), intervals, [run.name for run in runs])
    summary = TuningSummary(
        pumafuse=version("pumafuse"),
        runs=[run.name for run in runs],
        fit=list(kinds),
        hold=names,
        teacher=teacher,
        interrupted=interrupted,
        likelihood=_likelihoods(course.evidence(), config, tuned),
        parameters=[fitted(one, config, tuned, intervals.get(one.key)) for one in course.free(kinds, names)],
        biases=[one for run in runs for one in biases(run, tuned)],
        correlations=[pair for lesson in course.lessons for pair in correlated(lesson)],
        held=[told(tie) for lesson in course.lessons for tie in lesson.ties],
        orders={axis: why for lesson in course.lessons for axis, why in lesson.orders.items()},
        validation=validation,
        worse=any(one.worse for one in validation or ()),
        notes=_notes(
            course, validation, interrupted, known=validate is not None and any(_same(validate, run) for run in runs)
        ),
    )
    for note in summary.notes:
        warnings.warn(note, PumafuseWarning, stacklevel=2)
    return Tuning(tuned, config, summary, tuple(course.lessons))


def _refuse_twice(runs: Sequence[Run]) -> None:
    """Measurements that count twice would make the intervals too narrow.

    Raises:
        TuneError: A run is given twice.
    """
    for number, run in enumerate(runs):
        for other in runs[:number]:
            if _same(run, other):
                raise TuneError(f"run '{run.name}' is given twice: its measurements would count twice")


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


def _held_back(run: Run) -> float | None:
    """From when on a single run is held back [s after the first command]; None where its clock was set back."""
    if len(segments(run)[0]) > 1:
        return None
    stamp = run.command.stamp[run.command.stamp != NO_STAMP]
    return _LEARNT * float(stamp.max() - stamp.min()) / 1e9


def _likelihoods(evidence: Evidence, before: FusionConfig, after: FusionConfig) -> dict[str, Likelihood]:
    old, new = (evidence.value(with_gates_of(config, evidence.config)).axes for config in (before, after))
    return {
        axis: Likelihood(components=int(evidence.count[n]), before=float(old[n]), after=float(new[n]))
        for n, axis in enumerate(evidence.axes)
        if evidence.count[n]
    }


def _with_provenance(
    config: FusionConfig, intervals: Mapping[str, ConfidenceInterval], runs: Sequence[str]
) -> FusionConfig:
    """The arm with the intervals of what was fitted, and where it is from."""
    axes: dict[str, AxisModel] = {}
    for axis, model in config.arm.axes.items():
        found = {
            key.removeprefix(f"axes.{axis}."): one.ci95
            for key, one in intervals.items()
            if key.startswith(f"axes.{axis}.")
        }
        for key, ci95 in found.items():
            interval = tuple(rounded(end) for end in ci95)
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
    tuned = any(key.startswith("axes.") for key in intervals)
    provenance = {**config.arm.provenance, "tuned_on": list(runs)} if tuned else config.arm.provenance
    return _replace(config, arm=_replace(config.arm, axes=axes, provenance=provenance))


def _notes(course: Course, validation: Sequence[Check] | None, interrupted: bool, known: bool) -> list[str]:
    """Everything noticed, each once; ``known``: what was validated on had been learnt from."""
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
    if known and validation:
        found.append("validated on a run that was learnt from: nothing says whether the numbers hold elsewhere")
    if validation == []:
        found.append("what was held back has no measurement of a sensor that is used: nothing says whether it helped")
    found += [f"{one.run}, {one.axis}: {one.verdict}" for one in validation or () if one.worse]
    return list(dict.fromkeys(found))
