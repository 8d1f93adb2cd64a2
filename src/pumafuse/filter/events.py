"""Events in one total order, and what a row is before the filter sees it.

A run and the window of a live stream are the same table. An event is a time (when a command acts, when a measurement is
valid), a source (a command, or which sensor) and a value for each axis. At one instant commands come first, then the
sensors in the order of ``fusion.toml``, then stamp, then place of arrival. A command is one event for each distinct
delay of the axes that it moves.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false, reportConstantRedefinition=false
# (an element of an array is a plain number here: numba compiles it, numpy's types do not know)

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import NO_STAMP, BoolArray, CodeArray, FloatArray, IndexArray, IntArray, TimeArray
from ..compiled import compiled, kernel
from .axis import PERIOD, START, Model, Sensors, State
from .outcome import ABSENT, FARTHEST, Outcome

COMMAND = np.int64(-1)  # the source of a command
FUSED, DUPLICATE, BEFORE_START = (np.int64(one) for one in (Outcome.FUSED, Outcome.DUPLICATE, Outcome.BEFORE_START))
TOO_LATE, INVALID, UNKNOWN = (np.int64(one) for one in (Outcome.TOO_LATE, Outcome.INVALID, Outcome.UNKNOWN))


class Events(NamedTuple):
    """n events on A axes.

    Attributes:
        time: When a command acts or a measurement is valid, int64 ns (``NO_STAMP`` where that is not known), (n,).
        source: ``COMMAND``, or which sensor, (n,).
        stamp: As logged, int64 ns, (n,).
        value: [m] as logged, (n, A).
        spread: By what the noise of a value is scaled, (n, A); (0, A) where by nothing.
        known: What each value is before the filter sees it: ``FUSED`` where the filter decides, ``ABSENT`` where the
            row gives none, else why it is not used, (n, A).
    """

    time: TimeArray
    source: IndexArray
    stamp: TimeArray
    value: FloatArray
    spread: FloatArray
    known: CodeArray

    @staticmethod
    def empty(axes: int, events: int = 0) -> Events:
        """Room for some events that give nothing."""
        time, table = np.zeros(events, dtype=np.int64), np.zeros((events, axes))
        known = np.full((events, axes), ABSENT, dtype=np.uint8)
        return Events(time, np.zeros(events, dtype=np.int16), time.copy(), table, np.zeros((0, axes)), known)

    def rows(self, chosen: IntArray | slice) -> Events:
        """Some of the events, in the order of ``chosen``."""

        def of(part: np.ndarray) -> np.ndarray:
            return part[chosen] if isinstance(chosen, slice) else part.take(chosen, axis=0)  # twice as fast

        spread = of(self.spread) if len(self.spread) else self.spread
        return Events(of(self.time), of(self.source), of(self.stamp), of(self.value), spread, of(self.known))

    def where(self, mask: BoolArray) -> Events:
        """The events that a mask (n,) selects; themselves, not copied, if it selects all."""
        return self if mask.all() else self.rows(np.flatnonzero(mask))

    def repeated(self, times: int) -> Events:
        """The events with their axes so many times, one set after the other."""
        value, spread, known = (np.tile(part, times) for part in (self.value, self.spread, self.known))
        return self._replace(value=value, spread=spread, known=known)

    def columns(self, axes: list[int]) -> Events:
        """The events with the values of some axes alone."""
        value, spread, known = (np.ascontiguousarray(part[:, axes]) for part in (self.value, self.spread, self.known))
        return self._replace(value=value, spread=spread, known=known)


class Results(NamedTuple):
    """What became of n events on A axes.

    Attributes:
        innovation: ν [m], (n, A).
        innovation_sd: √S [m], (n, A).
        outcome: Codes of Outcome, (n, A).
        contradicts: The sensor that a rejected row contradicts time after time, −1 for none, (n,).
    """

    innovation: FloatArray
    innovation_sd: FloatArray
    outcome: CodeArray
    contradicts: IndexArray

    @staticmethod
    def room(events: int, axes: int) -> Results:
        """Room for as many events, nothing decided."""
        shape = (events, axes)
        nothing = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, ABSENT, dtype=np.uint8)
        return Results(*nothing, np.full(events, -1, dtype=np.int16))

    def split(self, times: int) -> list[Results]:
        """The parts of as many sets of axes, one after the other."""
        innovation, sd, outcome = (np.split(part, times, axis=1) for part in self[:3])
        return [Results(*part, self.contradicts) for part in zip(innovation, sd, outcome, strict=True)]

    def rows(self, chosen: IntArray) -> Results:
        """What became of some of the events, in the order of ``chosen``."""
        innovation, sd, outcome, contradicts = self
        return Results(
            innovation.take(chosen, axis=0),
            sd.take(chosen, axis=0),
            outcome.take(chosen, axis=0),
            contradicts.take(chosen),
        )


def joined(parts: Sequence[Events]) -> Events:
    """The events of several tables, one after the other."""
    spread = [part.spread for part in parts]
    if any(len(one) for one in spread):
        spread = [part.spread if len(part.spread) else np.ones_like(part.value) for part in parts]
    names = ("time", "source", "stamp", "value", "known")
    return Events(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names},
        spread=np.concatenate(spread),
    )


@compiled
def classify(
    model: Model,
    sensors: Sensors,
    events: Events,
    state: State,
    origin: int,
    row: int,
    axis: int,
    begin: int,
    end: int,
    whole: int,
) -> int:
    """What the value of a row is before the filter sees it: one policy for tables and streams.

    Args:
        model: The axes.
        sensors: The sensors.
        events: In their order, from ``begin`` to ``end``.
        state: Has the start level of each axis.
        origin: The first command [ns].
        row: The row.
        axis: Which of its values.
        begin: The first row that counts.
        end: After the last one.
        whole: What the row is for all axes: a duplicate, too late, or ``FUSED``.
    """
    if events.known[row, axis] == ABSENT:
        return ABSENT
    possible = abs(events.value[row, axis]) < FARTHEST  # neither NaN nor a sentinel such as 3.4e38
    if events.source[row] == COMMAND:
        if not possible:
            return INVALID
        return DUPLICATE if repeats(model, events, row, axis, begin, end) else FUSED
    if math.isnan(sensors.sd[events.source[row], axis]):
        return UNKNOWN
    if events.time[row] == NO_STAMP:
        return INVALID
    if whole != FUSED:
        return whole
    if events.time[row] < origin or math.isnan(state.drive[axis, START]):
        return BEFORE_START
    return FUSED if possible else INVALID


@kernel
def classify_all(
    model: Model, sensors: Sensors, events: Events, state: State, origin: int, too_late: BoolArray, known: CodeArray
) -> None:
    """Classify every value of a table into ``known`` (n, A); ``too_late`` (n,) are rows far behind earlier ones."""
    first, end = np.int64(0), len(events.time)
    for row in range(end):
        whole = TOO_LATE if too_late[row] else FUSED
        if events.source[row] != COMMAND and repeats_earlier(events, row, first):
            whole = DUPLICATE
        for axis in range(known.shape[1]):
            known[row, axis] = classify(model, sensors, events, state, origin, row, axis, first, end, whole)


@compiled
def repeats(model: Model, events: Events, row: int, axis: int, begin: int, end: int) -> bool:
    """Whether a command is none: another of its stamp comes after it, or it says again what the row before it says.

    A log that fills its command column down to the sensor's rate has one command where the value changes: the value of
    the row before, said again within half a period, is a repetition.
    """
    for later in range(row + 1, end):
        if events.time[later] > events.time[row]:
            break
        if gives_command(events, later, axis):
            return True
    half = 0.5e9 * model.gain[axis, PERIOD]
    for before in range(row - 1, begin - 1, -1):
        interval = events.time[row] - events.time[before]
        if interval >= half:
            break
        if interval > 0 and gives_command(events, before, axis):
            return events.value[before, axis] == events.value[row, axis]
    return False


@compiled
def gives_command(events: Events, row: int, axis: int) -> bool:
    """Whether a row is a command with a possible value for an axis."""
    return (
        events.source[row] == COMMAND and events.known[row, axis] != ABSENT and abs(events.value[row, axis]) < FARTHEST
    )


@compiled
def repeats_earlier(events: Events, row: int, begin: int) -> bool:
    """Whether an earlier row of the same source has the same stamp and the same values."""
    for before in range(row - 1, begin - 1, -1):
        if events.time[before] < events.time[row]:
            break
        if events.source[before] == events.source[row] and events.stamp[before] == events.stamp[row]:
            same = True
            for axis in range(events.value.shape[1]):
                a, b = events.value[before, axis], events.value[row, axis]
                absent, other = events.known[before, axis] == ABSENT, events.known[row, axis] == ABSENT
                same &= absent == other and (absent or a == b or (math.isnan(a) and math.isnan(b)))
            if same or events.source[row] == COMMAND:  # of one stamp the last command counts
                return same
    return False
