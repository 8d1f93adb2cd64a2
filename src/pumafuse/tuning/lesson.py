"""One lesson: which numbers may move, the search for them, and what the measurements cannot tell apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec

from ..fusion.config import FusionConfig
from ..fusion.score import Z95
from ..logs.run import Run
from .biases import far_off, slightly_off
from .climb import Point, Tell, point, settle
from .diagnose import Tie, shared_time, untold, untold_noise
from .learnable import moving
from .likelihood import Evidence
from .parameters import LATENCIES, RECOVERY, Fit, Parameter, parameters
from .search import Free, penalised, search
from .variants import with_axis, with_gates_of, with_recovery

_GATE = 5.0  # with which a sensor without a gate is learnt from, as outliers must not teach, or with a narrow one:
_NARROWEST = 3.0  # below it rejecting good measurements would pay, the more the smaller the noise
_TIES = 8  # combinations of which one number each is held, at most
_AT_REST = ("input_noise_mm_rtHz", "drift_mm_rts", "sd_mm")  # what an axis that does not move still tells


@dataclass(frozen=True)
class Syllabus:
    """What is to be learnt from which sensors.

    Attributes:
        fit: The kinds.
        hold: Names that are not to move.
        sensors: Which sensors are heard; None: all.
        may: Which of the numbers that kinds and names leave may move.
    """

    fit: Sequence[Fit]
    hold: Sequence[str]
    sensors: Sequence[str] | None = None
    may: Callable[[Parameter], bool] = lambda _: True


@dataclass(frozen=True)
class Lesson:
    """What was learnt.

    Attributes:
        syllabus: What was to be learnt.
        known: What was known before.
        evidence: From these measurements.
        active: The axes that move.
        best: The most likely configuration.
        free: What was fitted.
        ties: What the measurements could not tell, so that one number of each was held.
        orders: Why each axis's plant has its order, where that was chosen.
        notes: What else to know.
    """

    syllabus: Syllabus
    known: FusionConfig
    evidence: Evidence
    active: Sequence[str]
    best: Point
    free: Sequence[Parameter]
    ties: Sequence[Tie]
    orders: dict[str, str]
    notes: Sequence[str]


def learn(runs: Sequence[Run], config: FusionConfig, syllabus: Syllabus, until: float | None, tell: Tell) -> Lesson:
    """Search for the most likely numbers; where the measurements do not tell a combination, hold one of it and go on.

    Args:
        runs: From these.
        config: What is known before.
        syllabus: What is to be learnt.
        until: Measurements after that are left out [s after the first command].
        tell: Called with each better point.

    Raises:
        PumafuseError: Nothing can be learnt from the measurements.
    """
    evidence = evidence_of(runs, config, syllabus, until)
    active = moving(evidence, config)
    begin, notes = evidence.config, list[str]()
    if "noise" in syllabus.fit:
        begin, notes = far_off(evidence, begin, syllabus.hold)
    ties: list[Tie] = []
    free = _free(syllabus, config, evidence, active, ties)
    if "latency" in syllabus.fit:
        ties += shared_time(evidence.heard, active, free(begin), begin)
    best, orders = search(evidence, begin, free, tell)
    if "noise" in syllabus.fit:
        biased, more = slightly_off(evidence, best, syllabus.hold)
        best, notes = (settle(evidence, biased, free(biased), tell), [*notes, *more]) if more else (best, notes)
    best = _told_apart(evidence, best, free, config, ties, tell)
    notes += [
        f"{axis}: does not move; only its noise at rest was learnt" for axis in evidence.heard if axis not in active
    ]
    notes += [
        f"{name}: was learnt from with a gate of {_GATE:g}, not of {sensor.gate:g}: outliers must not teach, good"
        " measurements must"
        for name, sensor in config.sensors.items()
        if sensor.gate < _NARROWEST and any(name in heard for heard in evidence.heard.values())
    ]
    return Lesson(syllabus, config, evidence, active, best, free(best.config), ties, orders, notes)


def again(lesson: Lesson, runs: Sequence[Run], start: FusionConfig, tell: Tell) -> Lesson:
    """The same lesson from more measurements: the nearest maximum to ``start``, or what a new search finds.

    Where fewer measurements do not tell a delay from a lag or from noise, the nearest maximum to what they said is a
    false peak of more. So the search begins with the arm as it was known.
    """
    evidence = evidence_of(runs, lesson.evidence.config, lesson.syllabus, None)
    ties = [tie for tie in lesson.ties if tie.held.endswith("latency_ms")]
    free = _free(lesson.syllabus, lesson.known, evidence, lesson.active, ties)
    best, orders = settle(evidence, start, free(start), tell), lesson.orders
    if any(one.fit in ("delay", "plant") for one in free(start)):
        found, others = search(evidence, _arm_as_known(best.config, lesson.known, free(start)), free, _silently)
        if _penalised(evidence, found, free) > _penalised(evidence, best, free):
            # nobody is told of a plant of another order before the lesson with its numbers is there
            best, orders, tell = found, others, _silently
    best = _told_apart(evidence, best, free, lesson.known, ties, tell)
    return replace(lesson, evidence=evidence, best=best, free=free(best.config), ties=ties, orders=orders)


def _silently(_: Point) -> None:
    """Tell nobody."""


def _arm_as_known(config: FusionConfig, known: FusionConfig, free: Sequence[Parameter]) -> FusionConfig:
    """The configuration with the axes of which a number of the arm is free as they were known."""
    for axis in {one.axis for one in free if one.axis is not None and one.fit in ("delay", "plant", "gain")}:
        config = with_axis(config, axis, known.arm.axes[axis])
    return config


def _penalised(evidence: Evidence, best: Point, free: Free) -> float:
    return float(penalised(evidence, best, free(best.config)).sum())


def kept(lesson: Lesson, config: FusionConfig) -> Lesson:
    """The lesson as if it had ended at ``config``: its numbers are those of that configuration's plants."""
    free = _free(lesson.syllabus, lesson.known, lesson.evidence, lesson.active, lesson.ties)(config)
    best = point(lesson.evidence, with_gates_of(config, lesson.evidence.config), free)
    return replace(lesson, best=best, free=free, orders={})


def _free(
    syllabus: Syllabus, known: FusionConfig, evidence: Evidence, active: Sequence[str], ties: Sequence[Tie]
) -> Free:
    """What may move: as the syllabus says, without what is held because of ``ties`` by then."""

    def free(at: FusionConfig) -> list[Parameter]:
        held = [*syllabus.hold, *(tie.held for tie in ties)]
        found = parameters(at, known, evidence.heard, syllabus.fit, held)
        return [one for one in found if syllabus.may(one) and (one.axis is None or one.axis in active or _rests(one))]

    return free


def _told_apart(evidence: Evidence, best: Point, free: Free, known: FusionConfig, ties: list[Tie], tell: Tell) -> Point:
    """The best point with one number held of each combination that the measurements do not tell; ``ties`` has them then."""
    while len(ties) < _TIES and (tie := untold(evidence, best, free(best.config))) is not None:
        held = next(one for one in free(best.config) if one.key == tie.held)
        ties.append(tie)
        best = settle(evidence, _as_configured(held, best.config, known), free(best.config), tell)
    for one in untold_noise(evidence, best, free(best.config)):
        others = [other for other in free(best.config) if other.key != one.key]
        held = settle(evidence, _as_configured(one, best.config, known), others)
        if held.height > best.height - 0.5 * Z95**2:
            ties.append(Tie((one.key,), one.key))
            best = held
    return best


def _as_configured(one: Parameter, config: FusionConfig, known: FusionConfig) -> FusionConfig:
    """The configuration with a number back where it was, if it was there."""
    value = one.given(known)
    if value is None and one.axis is not None and one.key.endswith(RECOVERY):
        return with_recovery(config, one.axis, None)
    return config if value is None else one.put(config, value)


def _rests(one: Parameter) -> bool:
    return any(key in one.key.split(".") for key in _AT_REST)


def evidence_of(runs: Sequence[Run], config: FusionConfig, syllabus: Syllabus, until: float | None) -> Evidence:
    """The measurements; where latencies move, without those that a latency could put before the first command."""
    rejected = {
        name: sensor if sensor.gate >= _NARROWEST else msgspec.structs.replace(sensor, gate=_GATE)
        for name, sensor in config.sensors.items()
    }
    latest = None
    if "latency" in syllabus.fit:
        latest = LATENCIES[1] + max((sensor.latency for sensor in config.sensors.values()), default=0.0)
    return Evidence(
        runs, msgspec.structs.replace(config, sensors=rejected), syllabus.sensors, until=until, latest=latest
    )
