"""What a stream says that tells nothing: commands that nobody sent wait for the next, repeated values are held."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from ctypes import Array, c_double
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..arrays import ALWAYS, NEVER
from ..logs.screening import BRIEF, FAR, MOST_STRAY, Habit, leaps, returns, usual_of
from .commands import Commands, number

_REMEMBERED, _LOOKED_AT = 256, 64  # steps of an axis; after so many new ones the usual one is worked out anew
_KNOWN = 64  # steps, from which a usual one is known
_BELIEVED = 1.0 / 3.0  # of a step that was believed, is usual: another of its size is no leap
_ODD = 1e-4  # a probability of equal values in a row from which they wait
_PATIENCE = 5.0  # update periods, after which a command that came alone is believed


class Screened(NamedTuple):
    """A command that is decided: its stamp [ns], the values to use, and those that are stray [m]."""

    stamp: int
    values: dict[str, Any]
    stray: dict[str, float]


class Steps:
    """The latest value of an axis and its steps."""

    def __init__(self) -> None:
        self.value, self.pace = math.nan, 0.0  # the latest one, and its step, 0 for none
        self.usual = 0.0  # the step than which few are larger; 0: not known yet
        self._recent, self._new = deque[float](maxlen=_REMEMBERED), 0

    def add(self, value: float, consecutive: bool = True) -> None:
        """Add the next value; one that is not ``consecutive`` tells of no step."""
        self.pace, self.value = abs(value - self.value) if consecutive else 0.0, value
        if not self.pace > 0.0:
            return
        self._recent.append(self.pace)
        self._new += 1
        if len(self._recent) < _KNOWN:
            return
        self.usual = max(self.usual, _BELIEVED * self.pace)
        if self._new >= _LOOKED_AT:
            steps = np.array(self._recent)
            self._new, self.usual = 0, max(usual_of(steps), _BELIEVED * float(steps.max()))

    def has_leapt(self, value: float) -> bool:
        """Whether the next value is many times the usual step away."""
        return self.usual > 0.0 and leaps(value, self.value, max(self.usual, self.pace))


class _Repeated:
    """One axis of a sensor: its latest value, since when it has come, how often, where the axis was led meanwhile."""

    def __init__(self) -> None:
        self.value, self.stamp, self.since, self.count, self.leapt = math.nan, ALWAYS, ALWAYS, 0, False
        self.low, self.high = 0.0, 0.0
        self.waiting, self.believed = list[tuple[int, float, float]](), False
        self.habit: Habit | None = None
        self._steps, self._lengths = deque[float](maxlen=_REMEMBERED), deque[int](maxlen=_REMEMBERED)
        self._new = 0

    def is_new(self, stamp: int, value: float) -> bool:
        """Add the next value; whether it is another one."""
        self.stamp = stamp
        if value == self.value:
            self.count += 1
            return False
        if (step := abs(value - self.value)) < math.inf:
            self.leapt = self.habit is not None and step > FAR * self.habit.usual
            self._steps.append(step)
            self._lengths.append(self.count)
            self._new += 1
            if self._new >= _LOOKED_AT and len(self._steps) >= _KNOWN:
                self._new, self.habit = 0, Habit.of(np.array(self._steps), np.array(self._lengths))
        self.value, self.since, self.count = value, stamp, 1
        self.waiting, self.believed = [], False
        return True

    def forget(self) -> None:
        """Begin anew with the next value, as one has come that was before the latest."""
        self.value, self.waiting = math.nan, []

    @property
    def repeats(self) -> float:
        """How often the latest values were repeated, of 1."""
        return 1.0 - len(self._lengths) / (sum(self._lengths) + 1)


Kept: TypeAlias = tuple[int, float, float]  # of a value: stamp [ns], value [m], and by what its noise is scaled


class Judged(NamedTuple):
    """What a measured value is."""

    held: bool  # whether it is not used, at least not now
    sure: bool  # whether it never will be
    released: Sequence[Kept] = ()  # of those before it that were not used, and are news after all


NEWS = Judged(False, False)


class HoldWatch:
    """Judges which values of a sensor on an axis are no news: see :func:`pumafuse.logs.screening.held`.

    One that repeats the value before, against the sensor's habit or while the commands go on, waits: it is used once
    another one comes, or nothing moves, and held once the commands have clearly moved the axis.
    """

    def __init__(self, patience: int) -> None:
        """No value yet; none waits for longer than ``patience`` [ns]."""
        self._patience = patience
        self.restart()

    def restart(self) -> None:
        """Begin anew by another clock."""
        self._seen = dict[tuple[int, int], _Repeated]()

    def judge(
        self, key: tuple[int, int], stamp: int, value: float, spreads: Array[c_double], commands: Commands, lag: int
    ) -> Judged:
        """Judge a value of a sensor and an axis, late by up to a lag [ns]; out of order nothing is held."""
        if (repeated := self._seen.get(key)) is None:
            repeated = self._seen[key] = _Repeated()
        axis, waited = key[1], repeated.waiting
        if stamp <= repeated.stamp:
            repeated.forget()
            return Judged(False, False, waited) if waited else NEWS
        if repeated.is_new(stamp, value):
            return Judged(False, False, waited) if waited else NEWS
        if (habit := repeated.habit) is None:
            return NEWS
        if repeated.count == 2:
            repeated.low = repeated.high = commands.at(axis, repeated.since) or 0.0
        if stamp - lag >= repeated.since and (led := commands.at(axis, stamp - lag)) is not None:
            repeated.low, repeated.high = min(repeated.low, led), max(repeated.high, led)
        moved = repeated.high - repeated.low
        if habit.is_again(repeated.count - 1) or habit.froze(
            repeated.count, moved, commands.travel(axis), repeated.leapt, repeated.repeats
        ):
            repeated.waiting = []
            return Judged(True, True)
        led, before = (commands.at(axis, instant) or 0.0 for instant in (stamp, repeated.since - lag))
        odd = led != before and (repeated.leapt or repeated.repeats ** (repeated.count - 1) < _ODD)
        if repeated.believed or not (odd or max(led - repeated.low, repeated.high - led) > habit.clear):
            return NEWS
        waited.append((stamp, value, spreads[axis]))
        if stamp - waited[0][0] <= self._patience:
            return Judged(True, False)
        repeated.waiting, repeated.believed = [], True
        return Judged(True, False, waited)


class CommandScreen:
    """Lets commands through but those that leap away, which wait: if the next ones are back they are stray."""

    def __init__(self, period: float) -> None:
        """Screen commands that come every ``period`` [s]."""
        self._apart, self._patience = round(BRIEF * period * 1e9), round(_PATIENCE * period * 1e9)
        self._axes: dict[str, Steps] = {}
        self.restart()

    def restart(self) -> None:
        """Begin anew by another clock; usual steps stay."""
        self._last, self.until = ALWAYS, NEVER  # who waits is believed when something is stamped later [ns]
        self._waiting: list[tuple[int, dict[str, Any]]] = []

    def add(self, stamp: int, values: Mapping[str, Any]) -> list[Screened]:
        """Add a command; those that are decided by now, without what is stray, and that."""
        consecutive, self._last = 0 < stamp - self._last <= self._apart, stamp
        decided = list[Screened]()
        if self._waiting and consecutive:
            decided = self._judge_waiting(values)
            if not decided and len(self._waiting) < MOST_STRAY:
                self._waiting.append((stamp, dict(values)))
                return []
        decided = decided or self.take_waiting()
        if consecutive and any(self._leaps(name, value) for name, value in values.items()):
            self._waiting, self.until = [(stamp, dict(values))], stamp + self._patience
            return decided
        self._learn(values, consecutive)
        return [*decided, Screened(stamp, dict(values), {})]

    def take_waiting(self) -> list[Screened]:
        """The commands that wait, as nothing has shown that they are stray."""
        waiting, self._waiting, self.until = self._waiting, [], NEVER
        for _, values in waiting:
            self._learn(values, True)
        return [Screened(stamp, values, {}) for stamp, values in waiting]

    def _judge_waiting(self, now: Mapping[str, Any]) -> list[Screened]:
        """The commands that wait, without what is stray, if each axis that has leapt is back now; else none."""
        judged = list[Screened]()
        for stamp, values in self._waiting:
            out = {name: number(value) for name, value in values.items() if self._leaps(name, value)}
            for name, value in out.items():
                if not returns(number(now.get(name)), self._axes[name].value, [value]):
                    return []
            judged.append(Screened(stamp, {name: value for name, value in values.items() if name not in out}, out))
        self._waiting, self.until = [], NEVER
        return judged

    def _leaps(self, name: str, value: Any) -> bool:
        return name in self._axes and self._axes[name].has_leapt(number(value))

    def _learn(self, values: Mapping[str, Any], consecutive: bool) -> None:
        for name, value in values.items():
            if math.isfinite(cell := number(value)):
                self._axes.setdefault(name, Steps()).add(cell, consecutive)
