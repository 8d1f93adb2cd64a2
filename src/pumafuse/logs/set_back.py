"""Clocks that were set back by up to 1 s within a recorded run, as by NTP or a leap second.

Rows that only came late fill a hole. Where a clock was set back, rows go on at their interval where there were rows
before. If all sources show it at once, by the same amount, one clock was set back: their stamps are made to go on.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np

from ..arrays import NO_STAMP, IntArray, TimeArray
from .run import Run
from .source import TOLERATED_STEP_BACK_NS, Source

_IN_ORDER = 20  # rows in order before a step
_LEAST, _OF_ALL, _OF_ONE = 1, 3, 5  # rows behind: of each source; of one at least, if all step back; if one does alone
_MANY = 100  # intervals of which the usual one is the median
_HOLE, _HOLE_OF_STEP = 1.5, 0.25  # of the usual interval, or of the step: a longer interval is a hole
_REGULAR = 0.8  # of the rows that are expected where it was covered before, and is again
_AGREE = 0.75  # intervals of both sources by which their steps may differ: they sample at other instants
_MOST = 100  # steps


class Step(NamedTuple):
    """A step back of one source's stamps."""

    row: int  # the first row after it, of those with a stamp
    newest: int  # the stamp before it [ns]
    back: float  # by how much it steps back [ns]
    usual: float  # the usual interval of the rows [ns]
    behind: int  # how many rows are behind 'newest'


def drop_steps_back(run: Run) -> tuple[Run, list[str]]:
    """A run whose stamps go on where all clocks were set back, and a sentence on each step, also of a source alone."""
    notes = list[str]()
    for _ in range(_MOST):
        steps = {name: steps_back(source.stamp) for name, source in _sources(run).items()}
        common = next(filter(None, (_common(run, candidate, steps) for candidate in _candidates(steps))), None)
        if common is None:
            return run, [*notes, *_alone(run, steps)]
        later = _rows_after(run.command, common)
        row = f" in row {later[0] + 1}" if len(later) else ""
        apart = run.reference is not None and not _shows(run.reference.stamp, common)
        but = "; that of the reference is not" if apart else ""
        step = f"set back by {common.back / 1e9:.3f} s{row}"
        notes.append(f"{run.command.label}: all clocks are {step}: stamps go on from there{but}")
        moved = _moved(run, common)
        run = replace(moved, reference=run.reference) if apart else moved
    return run, notes


def steps_back(stamp: TimeArray) -> list[Step]:
    """Where stamps step back by up to 1 s and go on where rows were before, (rows,)."""
    if (stamp[1:] >= stamp[:-1]).all():
        return []
    stamp = stamp[stamp != NO_STAMP]
    back: IntArray = np.flatnonzero(np.diff(stamp) < 0) + 1
    apart = np.diff(back, prepend=0, append=len(stamp))
    begins, ends = back - apart[:-1], back + apart[1:]
    some = np.flatnonzero((apart[:-1] > _IN_ORDER) & (apart[1:] > _LEAST))
    steps = [_step(stamp, int(begins[row]), int(back[row]), int(ends[row])) for row in some.tolist()]
    return [step for step in steps if step is not None]


def _step(stamp: TimeArray, begin: int, row: int, end: int) -> Step | None:
    """The step back at a row, which ends rows in order from ``begin`` and begins some until ``end``; if it is one."""
    newest, first = int(stamp[row - 1]), int(stamp[row])
    usual = float(np.median(np.diff(stamp[max(begin, row - _MANY) : row])))
    if newest - first > TOLERATED_STEP_BACK_NS or stamp[begin] > first or usual <= 0.0:
        return None
    before = stamp[begin + int(np.searchsorted(stamp[begin:row], first, side="right")) - 1 : row]
    after = stamp[row : row + int(np.searchsorted(stamp[row:end], newest, side="right")) + 1][: end - row]
    expected = (newest - first) / usual
    hole = max(_HOLE * usual, _HOLE_OF_STEP * (newest - first))
    behind = int(np.count_nonzero(after <= newest))
    few = min(len(before) - 1, behind) < _REGULAR * expected
    longest = max(int(np.diff(stamps).max(initial=0)) for stamps in (before, after))
    if behind < _LEAST or few or longest > hole:
        return None
    return Step(row, newest, newest - first + usual, usual, behind)


def _sources(run: Run) -> dict[str, Source]:
    """The commands and the sensors of a run: a reference may have a clock of its own, which nobody set."""
    return {"": run.command, **run.sensors}


def _candidates(steps: Mapping[str, list[Step]]) -> Iterable[Step]:
    """The steps of all sources, the first ones first; of one instant those of the densest source."""
    return sorted(chain(*steps.values()), key=lambda step: (step.newest - step.back, step.usual))[:_MOST]


def _common(run: Run, step: Step, steps: Mapping[str, list[Step]]) -> Step | None:
    """The surest step back of all clocks at a step of one clock; None where some clock went on."""
    by_source = {name: [other for other in steps[name] if _agree(other, step)][:1] for name in steps}
    agreeing, several = [*chain(*by_source.values())], sum(map(len, by_source.values())) > 1 or not run.sensors
    others = (source for name, source in _sources(run).items() if not by_source[name])
    apart = any(_goes_on(source.stamp, step) for source in others) or (steps[""] and not by_source[""])
    if apart or not several or max(other.behind for other in agreeing) < _OF_ALL:
        return None
    surest = min(agreeing, key=lambda step: step.usual)
    return surest._replace(newest=max(other.newest for other in agreeing))


def _agree(step: Step, other: Step) -> bool:
    apart = _AGREE * (step.usual + other.usual)
    return abs(step.back - other.back) <= apart and abs(step.newest - other.newest) <= apart


def _goes_on(stamp: TimeArray, step: Step) -> bool:
    """Whether a source goes on over a step as if there was none: it has rows just before and after, and no step."""
    stamps = stamp[stamp != NO_STAMP]
    near = stamps[np.abs(stamps - step.newest) <= step.back + TOLERATED_STEP_BACK_NS]
    if len(near) < _LEAST or not (near.min() < step.newest - step.back and near.max() > step.newest):
        return False
    return bool((np.diff(near) >= 0).all()) and float(np.median(np.diff(near))) < step.back


def _shows(stamp: TimeArray, step: Step) -> bool:
    """Whether a reference has an interval that is shorter by about a step, near that step."""
    stamps = stamp[stamp != NO_STAMP]
    interval, near = np.diff(stamps), np.abs(stamps[1:] - step.newest) <= step.back + TOLERATED_STEP_BACK_NS
    return bool(near.any()) and float(interval[near].min()) < float(np.median(interval)) - 0.5 * step.back


def _rows_after(source: Source, step: Step) -> IntArray:
    """The rows of a source that came after a step, of those with a stamp: from where its interval is shorter by it."""
    stamped = np.flatnonzero(source.stamp != NO_STAMP)
    stamp = source.stamp[stamped]
    interval = np.diff(stamp)
    near = np.flatnonzero((stamp[1:] > step.newest - step.back) & (stamp[:-1] <= step.newest + step.usual))
    if not len(near):
        return stamped[np.searchsorted(stamp, step.newest, side="right") :]
    return stamped[near[np.argmin(np.abs(interval[near] + step.back - np.median(interval)))] + 1 :]


def _moved(run: Run, step: Step) -> Run:
    def moved(_: str, source: Source) -> Source:
        stamp = source.stamp.copy()
        stamp[_rows_after(source, step)] += round(step.back)
        return replace(source, stamp=stamp)

    return run.each(moved)


def _alone(run: Run, steps: Mapping[str, list[Step]]) -> list[str]:
    """A sentence on each sensor whose clock was set back while the commands' went on."""
    return [
        f"{source.label_for(name)}: its clock is set back by {step.back / 1e9:.3f} s in row"
        f" {int(np.flatnonzero(source.stamp != NO_STAMP)[step.row]) + 1}, and others are not: rows are sorted by their"
        " stamps; where it was right before, they are stamped too early from there on"
        for name, source in run.sensors.items()
        for step in steps[name]
        if step.behind >= _OF_ONE and _goes_on(run.command.stamp, step)
    ]
