"""The commands of a stream: which one is in force at an instant, and what is odd about them."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..arrays import FloatArray
from ..filter.outcome import Outcome
from ..logs.clock import interval_fault, missing_commands
from ..logs.frames import Cylindrical, Frame
from ..logs.source import Source
from ..model.arm import ArmModel, Validity
from ..units import Kind
from .rate_limit import RateLimitedLog

_FIRST, _MANY = 100, 1000  # commands whose interval is looked at, and those that missing ones are counted among
_FUSED = int(Outcome.FUSED)


class Commands:
    """What was commanded on each axis, as far back as a window needs it."""

    def __init__(self, start: Sequence[float]) -> None:
        """No command yet; ``start`` is the level [m] of each axis before its first one, NaN: that of the first one."""
        self._start = start
        self._commanded: list[list[tuple[int, float]]] = [[] for _ in start]  # stamps and values, by stamp
        self._ends = [(math.inf, -math.inf) for _ in start]

    def add(self, stamp: int, codes: bytes, values: Sequence[float], oldest: int) -> None:
        """Add the values [m] of a command that were fused, in the place of what the axis had at that stamp [ns]."""
        for axis, (commanded, code, value) in enumerate(zip(self._commanded, codes, values, strict=True)):
            if code != _FUSED:
                continue
            low, high = self._ends[axis]
            self._ends[axis] = min(low, value), max(high, value)
            if not commanded or stamp > commanded[-1][0]:
                commanded.append((stamp, value))
            else:
                row = bisect_left(commanded, (stamp,))
                commanded[row : bisect_left(commanded, (stamp + 1,))] = [(stamp, value)]
            if len(commanded) > 2 and commanded[2][0] <= oldest:  # one was in force then, and one is for its step
                del commanded[0]

    def at(self, axis: int, stamp: int) -> float | None:
        """What is commanded on an axis at ``stamp`` [ns], in m; None before any command."""
        commanded = self._commanded[axis]
        row = bisect_left(commanded, (stamp + 1,))
        return commanded[row - 1][1] if row else self._before(axis) if commanded else None

    def travel(self, axis: int) -> float:
        """How far apart the commands of an axis have been [m]; 0 before any."""
        low, high = self._ends[axis]
        return max(high - low, 0.0)

    def latest(self) -> list[tuple[int, float, float] | None]:
        """Stamp [ns], value and step [m] of the latest command of each axis; None before any."""
        return [self._latest(axis, commanded) if commanded else None for axis, commanded in enumerate(self._commanded)]

    def forget(self, after: int) -> None:
        """Take back those that are stamped after ``after`` [ns]."""
        for commanded in self._commanded:
            del commanded[bisect_left(commanded, (after + 1,)) :]

    def _latest(self, axis: int, commanded: list[tuple[int, float]]) -> tuple[int, float, float]:
        stamp, value = commanded[-1]
        return stamp, value, value - (commanded[-2][1] if len(commanded) > 1 else self._before(axis))

    def _before(self, axis: int) -> float:
        """Where an axis rests before its first command [m]."""
        start = self._start[axis]
        return self._commanded[axis][0][1] if math.isnan(start) else start


class CommandWatch:
    """Says when commands leave what the arm model is valid for, come at another interval, or are missing."""

    def __init__(self, arm: ArmModel, frame: Frame | None, log: RateLimitedLog) -> None:
        self._arm, self._log = arm, log
        self._cylindrical = isinstance(frame, Cylindrical)
        self._knows_interval, self._senders = False, False
        self._recent: list[tuple[int, Mapping[str, Any]]] = []

    def restart(self) -> None:
        """Begin anew by another clock."""
        self._recent = []

    def forget(self, after: int) -> None:
        """Take back all that is stamped after an instant [ns]."""
        self._recent = [row for row in self._recent if row[0] <= after]

    def watch_limits(self, commands: Commands) -> None:
        """Say when the latest commands leave what the arm model is valid for."""
        arm = self._arm
        if arm.validity == Validity():
            return
        latest = {axis: last for axis, last in zip(arm.axes, commands.latest(), strict=True) if last is not None}
        speed: dict[Kind, float] = {}
        for axis, (_, _, step) in latest.items():
            kind = arm.axes[axis].kind
            speed[kind] = max(speed.get(kind, 0.0), abs(step) / arm.update_period)
        radius = latest["radial"][1] if self._cylindrical and "radial" in latest else None
        for passed in arm.validity.excess(speed, radius):
            stamp = max(stamp for stamp, _, _ in latest.values())
            self._log.write(passed.split(" reach")[0], f"{passed}, at {stamp / 1e9:.3f} s")

    def watch_intervals(self, stamp: int, values: Mapping[str, Any]) -> None:
        """Look at a fused command; say if they come at another interval than the update period, or many are missing."""
        recent = self._recent
        recent.append((stamp, values))
        if len(recent) == _FIRST and not self._knows_interval:
            self._knows_interval = True
            stamps = np.sort(np.array([stamp for stamp, _ in recent]))
            if (fault := interval_fault(stamps, self._arm.update_period)) is not None:
                sentence, kind = fault
                self._senders = kind == "senders"
                where = " A stream has t in s, or t_ns in ns" if kind == "unit" else ""
                self._log.write("interval of commands", sentence + where)
        if len(recent) >= _MANY:
            self._recent = []
            if not self._senders:
                self._find_missing(sorted(recent, key=lambda recent_row: recent_row[0]))

    def _find_missing(self, recent: list[tuple[int, Mapping[str, Any]]]) -> None:
        stamps = np.array([stamp for stamp, _ in recent])
        table = {axis: np.array([number(values.get(axis)) for _, values in recent]) for axis in recent[0][1]}
        steady: dict[str, FloatArray] = {axis: column for axis, column in table.items() if np.isfinite(column).all()}
        if steady and (missing := missing_commands(Source(stamps, steady, "commands"), 0)) is not None:
            note = f"until {recent[-1][0] / 1e9:.3f} s {missing}: the model holds the one before; send every command"
            self._log.write("missing commands", note)


def number(value: object) -> float:
    """A number as it is; NaN for what is none."""
    if isinstance(value, str | bytes | bool):
        return math.nan
    try:
        return float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        return math.nan
