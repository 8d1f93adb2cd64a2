"""A survey of a log: what it holds, who is who in it, and how its motions follow each other."""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ..logs.axes import in_axes
from ..logs.clock import without_strays
from ..logs.manifest import refuse_twice
from ..logs.run import REFERENCE, Run
from ..space.rotations import TURNING
from ..units import MS
from .contents import Part, parts_of, period_of, unused
from .following import LATEST, Following
from .own_frames import FOLLOWS as TURNS
from .own_frames import OwnFrame, own_frames
from .roles import GUESSED_LAG, SAME, Roles, UndecidedError, relations, roles_of, told_as_speeds

FOLLOWS = 0.5  # correlation of changes below which a lag means nothing
AHEAD = 0.02  # s, from which what is ahead of the commands has another clock; less may be noise
_MOST_REASONS = 12  # in a refusal
_SURELY = 0.9  # correlation of changes from which a lag is known well
SOONER = 2e-3  # s: lags are known to 1 ms
_Relations: TypeAlias = dict[tuple[str, str], Following]  # by the name of a source and the axis
_OF_PERIOD = 0.1  # of an update period, to which they are where commands are far apart: a path between them is a guess
_STEPS, _FINEST = 10, 1e-3  # of an update period; s


@dataclass(frozen=True)
class Survey:
    """What was found in a log."""

    log: Path
    # the run in it, in the arm's axes, without sensors in frames of their own. Axes rx, ry, rz are in it where a sensor
    # follows how the tool is turned
    run: Run
    # how each sensor, and 'reference', follows the commands, by its name and the axis
    relations: Mapping[tuple[str, str], Following]
    parts: Sequence[Part] = ()  # its tables or topics; none where it has a 'run.toml'
    roles: Roles | None = None  # who is who; None where a 'run.toml' says it
    manifest: Mapping[str, Any] | None = None  # what that 'run.toml' holds
    # the sensors that seem to stand in frames of their own
    own_frames: Mapping[str, OwnFrame] = field(default_factory=dict[str, OwnFrame])
    # in which steps the run's commands seem to go on between those of the log [s]; 0: they do not. A 'run.toml' is
    # taken as it is, all the same
    interpolation: float = 0.0
    # why a sensor that a 'run.toml' describes is not used on an axis, by its name and the axis
    unused: Mapping[tuple[str, str], str] = field(default_factory=dict[tuple[str, str], str])

    @property
    def name(self) -> str:
        """The log's name without the endings of files."""
        return name_of(self.log)

    def of_source(self, name: str) -> dict[str, Following]:
        """How a source follows the commands, by axis."""
        return {axis: relation for (source, axis), relation in self.relations.items() if source == name}


def name_of(log: Path) -> str:
    """A log's name without the endings of files."""
    log = log.resolve()
    log = log.parent if log.name == "run.toml" else log
    return re.sub(r"(\.(csv|parquet|mcap|bag|db3|rrd|mat|np[yz]|json|xlsx|ulg))?(\.gz)?$", "", log.name) or "log"


def survey(log: Path, rate: float = 0.0) -> Survey:
    """Look at a log of any kind that can be read; ``rate`` is that of rows without stamps [Hz], or 0."""
    described = log if log.name == "run.toml" else log / "run.toml"
    if os.path.isfile(described):  # noqa: PTH113 - Path.is_file raises on a name that is too long
        refuse_twice(described)
        run = without_strays(Run.read(described))
        manifest = tomllib.loads(described.read_text(encoding="utf-8"))
        framed = own_frames(run)
        run = _along_axes(run, framed)
        run, related = _followed(run, relations(run))
        without_early = _drop_early(Survey(log, run, related, manifest=manifest, own_frames=framed))
        return replace(without_early, interpolation=interpolation(without_early))
    parts = parts_of(log, rate)
    roles = roles_of(parts, str(log))
    if speeds := told_as_speeds(roles):
        raise UndecidedError(str(log), speeds, parts, roles)
    _refuse_alone(log, parts, roles, "nothing that measures where they lead")
    run = without_strays(roles.run)
    framed = own_frames(run)
    run = _along_axes(run, framed)
    related = relations(run)
    lags, least = [relation.lag for relation in related.values() if _is_sure(relation)], least_lag(run)
    all_ahead = max(lags, default=0.0) < least
    bad = dict[tuple[str, str], str]()
    others_follow = any(abs(relation.correlation) >= SAME for relation in related.values())
    for key, relation in related.items():
        follows = f"correlation {relation.correlation:+.2f}"
        if abs(relation.correlation) < FOLLOWS and others_follow:
            bad[key] = f"it does not follow the commands ({follows}): are columns exchanged?"
        elif lags and relation.lag < least and not (all_ahead and _is_sure(relation)):
            bad[key] = _ahead(relation)
    bad |= {(name, axis): why for name, why in _without_lag(related).items() for axis in (*run.axes, *TURNING)}
    roles = roles.without({key: why for key, why in bad.items() if key[1] not in TURNING})
    _refuse_alone(log, parts, roles, "nothing that surely follows them")
    kept = {(name, axis) for name, stream in roles.measured.items() for axis in (*stream.axes, *TURNING)}
    related = {key: relation for key, relation in related.items() if key in kept}
    run, related = _followed(_along_axes(without_strays(roles.run), framed), related)
    without_early = Survey(log, run, related, parts, roles, own_frames=framed)
    if step := interpolation(without_early):
        command = without_early.run.command.interpolated(step)
        without_early = replace(without_early, run=replace(without_early.run, command=command), interpolation=step)
    return without_early


def _along_axes(run: Run, framed: Collection[str]) -> Run:
    """A run in the arm's axes, without the sensors that stand in frames of their own."""
    kept = {name: source for name, source in run.sensors.items() if name not in framed}
    return in_axes(replace(run, sensors=kept), None)[0]


def _followed(run: Run, related: _Relations) -> tuple[Run, _Relations]:
    """A run without orientations that do not follow the commanded one, and how the rest of it follows."""
    turned = set[str]()
    for name in run.measured:  # on its axes together, each as far as the tool is told to turn
        turning = [axis for axis in TURNING if (name, axis) in related]
        power = np.array([np.nanvar(run.command.values[axis]) for axis in turning])
        correlation = np.array([related[name, axis].correlation for axis in turning])
        if turning and float(power @ correlation) >= TURNS * float(power.sum()):
            turned.add(name)
    every = {name: source if name in turned else source.without(TURNING) for name, source in run.measured.items()}
    run = replace(run, sensors={name: every[name] for name in run.sensors}, reference=every.get(REFERENCE))
    if run.sensors and turned.isdisjoint(run.sensors):
        run = replace(run.each(lambda _, source: source.without(TURNING)), tool=None)
    return run, {(name, axis): relation for (name, axis), relation in related.items() if axis in every[name].values}


def _without_lag(related: _Relations) -> dict[str, str]:
    """Sources with an axis that surely moves alike, but at the longest lag of the search, each with a sentence."""
    late: dict[str, list[str]] = {}
    for (name, axis), relation in related.items():
        if relation.lag >= LATEST and _is_sure(relation):
            late.setdefault(name, []).append(axis)
    return {
        name: (
            f"no lag up to {LATEST:g} s explains its motion on {', '.join(axes)}: is it another robot's, or its clock"
            f" another one? If it follows, say so in run.toml: [sensors.{name}], with shift_s = SECONDS in its time"
        )
        for name, axes in late.items()
    }


def least_lag(run: Run) -> float:
    """The least lag behind the path through a run's commands that an arm may have [s]: between them it is guessed."""
    return -max(AHEAD, _OF_PERIOD * period_of(run.command))


def early(survey: Survey, name: str) -> dict[str, float]:
    """By how much a source moves before its commands [s], for each of its axes that surely does."""
    least = least_lag(survey.run)
    sure = {axis: relation for axis, relation in survey.of_source(name).items() if _is_sure(relation)}
    return {axis: -relation.lag for axis, relation in sure.items() if relation.lag < least}


def _drop_early(survey: Survey) -> Survey:
    """The survey without axes of sensors that move before their commands, if other axes of that sensor follow."""
    run, unused = survey.run, dict[tuple[str, str], str]()
    for name, source in run.sensors.items():
        ahead, by_axis = early(survey, name), survey.of_source(name)
        if ahead and len(ahead) < sum(map(_is_sure, by_axis.values())):
            run = replace(run, sensors={**run.sensors, name: source.without(ahead)})
            unused |= {(name, axis): _ahead(by_axis[axis]) for axis in ahead}
    related = {key: relation for key, relation in survey.relations.items() if key not in unused}
    return replace(survey, run=run, relations=related, unused=unused)


def _ahead(following: Following) -> str:
    return f"it moves {-following.lag * MS:.0f} ms before its commands (correlation {following.correlation:+.2f})"


def _is_sure(following: Following) -> bool:
    return abs(following.correlation) >= _SURELY


def too_early(name: str, by: float) -> str:
    """A sentence, with advice, on a source that moves before its commands by so many seconds."""
    return (
        f"{name} is {by:.2g} s early: it moves before its commands, as no arm does, and no lag can be told. Are set"
        " points and measurements exchanged, or stamped by two clocks? In run.toml exchange them, or add shift_s ="
        f" {by + GUESSED_LAG:.3f} to the time of {name}: so it is {GUESSED_LAG * MS:.0f} ms late, which is a guess"
    )


def interpolation(survey: Survey) -> float:
    """In which steps the arm seems to go on between its commands [s]; 0 where it may as well hold each.

    Behind the path through the commanded points, an arm that holds each is late by half an update period and more. One
    that follows this path sooner knows what is between: the log has samples of what a controller interpolates.
    """
    period = period_of(survey.run.command)
    margin = max(SOONER, _OF_PERIOD * period)
    goes_on = -margin <= soonest(survey) < 0.5 * period - margin
    return max(float(f"{period / _STEPS:.1g}"), _FINEST) if goes_on else 0.0


def soonest(survey: Survey) -> float:
    """The least lag of any source behind the path through the commanded points, where it is known well [s]."""
    lags = dict[str, list[float]]()
    for (name, _), relation in survey.relations.items():
        if _is_sure(relation):
            lags.setdefault(name, []).append(relation.lag)
    return min((float(np.median(of_sensor)) for of_sensor in lags.values()), default=math.inf)


def _refuse_alone(log: Path, parts: Sequence[Part], roles: Roles, what: str) -> None:
    """Refuse commands without a sensor, with the reasons why nothing else in the log is one."""
    if not roles.sensors:
        reasons = dict.fromkeys([*(f"{stream.name}: {why}" for stream, why in roles.left_out), *unused(parts)])
        reasons_told = "; ".join([*reasons][:_MOST_REASONS]) or "nothing else is in the log"
        raise UndecidedError(str(log), f"commands, but {what}: {reasons_told}", parts, roles)
