"""Lessons one after the other, and the configuration that they end with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

from ..fusion.config import FusionConfig
from ..logs.run import Run
from .climb import Point
from .diagnose import at_bound
from .learnable import TuneError
from .lesson import Lesson, Syllabus, again, evidence_of, kept, learn
from .likelihood import Evidence
from .parameters import Fit, Parameter, parameters, rounded
from .variants import with_gates_of

_NOTHING = 0.01  # log-likelihood that a noise must be worth, or it is none

Progress: TypeAlias = Callable[[str, Point], None]


def syllabi(config: FusionConfig, kinds: Sequence[Fit], hold: Sequence[str], teacher: str | None) -> list[Syllabus]:
    """One lesson from all sensors; with a teacher one from it, then one on the others' noise and latency.

    Raises:
        UnknownNameError: The teacher is not configured.
    """
    if teacher is None:
        return [Syllabus(kinds, hold)]
    config.sensor_names([teacher])
    arm: list[Fit] = [kind for kind in kinds if kind != "latency"]
    others: list[Fit] = [kind for kind in kinds if kind in ("noise", "latency")]

    def of_others(one: Parameter) -> bool:
        return one.sensor not in (None, teacher)

    return [Syllabus(arm, hold, [teacher]), Syllabus(others, hold, None, of_others)]


class Course:
    """Lessons one after the other, each from where the last one ended; what was best last is kept at any moment.

    Attributes:
        best: The best configuration so far, with the gates and the digits of the search.
        lessons: Those that were taken.
        kept: Whether the configuration as given is the result.
    """

    def __init__(self, runs: Sequence[Run], config: FusionConfig, progress: Progress) -> None:
        self.runs, self.config, self.progress = runs, config, progress
        self.best = config
        self.lessons: list[Lesson] = []
        self.kept = False

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
        """All lessons once more, from all measurements."""
        for number, lesson in enumerate(self.lessons):
            more = again(lesson, self.runs, self.best, self._following("learning from the whole run"))
            self.lessons[number], self.best = more, more.best.config

    def evidence(self) -> Evidence:
        """The measurements of the last lesson, from the whole of the runs."""
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
            self.lessons = [kept(lesson, self.config) for lesson in self.lessons]

    def result(self) -> FusionConfig:
        """The best configuration: gates as they were, rounded, and without the noise that is worth nothing."""
        best = with_gates_of(self.best, self.config)
        for lesson in self.lessons:
            mine = [one for one in lesson.free if one.given(best) is not None]
            for one in mine:
                best = one.put(best, one.inside(rounded(one.get(best))))
            for one in mine:
                none = one.put(best, 0.0) if one.vanishes and at_bound(one, best) == "least" else best
                if none is not best and self._worth(lesson, best) - self._worth(lesson, none) < _NOTHING:
                    best = none
        return best

    @staticmethod
    def _worth(lesson: Lesson, config: FusionConfig) -> float:
        """The log-likelihood of a lesson's measurements with the gates of the lesson."""
        return lesson.evidence.value(with_gates_of(config, lesson.evidence.config)).total

    def _following(self, what: str) -> Callable[[Point], None]:
        def tell(found: Point) -> None:
            self.best = found.config
            self.progress(what, found)

        return tell
