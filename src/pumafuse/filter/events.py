"""Events in one total order, and what became of them.

A run and the window of a live stream are the same table. An event is a time (when a command acts, when a measurement is
valid), a source (a command, or which sensor) and a value for each axis. At one instant commands come first, then the
sensors in the order of ``fusion.toml``, then stamp, then place of arrival. A command is one event for each distinct
delay of the axes that it moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import BoolArray, CodeArray, FloatArray, IndexArray, IntArray, TimeArray
from .outcome import ABSENT

COMMAND = -1  # the source of a command


class Events(NamedTuple):
    """n events on A axes.

    Attributes:
        time: When a command acts or a measurement is valid, int64 ns (``NO_STAMP`` where that is not known), (n,).
        source: ``COMMAND``, or which sensor, (n,).
        stamp: As logged, int64 ns, (n,).
        value: [m] as logged, (n, A).
        spread: By what the noise of a value is scaled, (n, A); (0, A) where by nothing.
        codes: What each value is before the filter sees it: ``FUSED`` where the filter decides, ``ABSENT`` where the
            row gives none, else why it is not used, (n, A).
        arrival: When it came, int64 ns, (n,); (0,) where at its stamp.
    """

    time: TimeArray
    source: IndexArray
    stamp: TimeArray
    value: FloatArray
    spread: FloatArray
    codes: CodeArray
    arrival: TimeArray = np.zeros(0, dtype=np.int64)

    @staticmethod
    def empty(axes: int, events: int = 0) -> Events:
        """Room for some events that give nothing."""
        time, table = np.zeros(events, dtype=np.int64), np.zeros((events, axes))
        codes = np.full((events, axes), ABSENT, dtype=np.uint8)
        return Events(time, np.zeros(events, dtype=np.int16), time.copy(), table, np.zeros((0, axes)), codes)

    def rows(self, chosen: IntArray | slice) -> Events:
        """The events that are ``chosen``, in that order."""

        def of(part: np.ndarray) -> np.ndarray:
            return part[chosen] if isinstance(chosen, slice) else part.take(chosen, axis=0)  # twice as fast

        return Events._make(of(part) if len(part) else part for part in self)

    def where(self, mask: BoolArray) -> Events:
        """The events that a mask (n,) selects; themselves, not copied, if it selects all."""
        return self if mask.all() else self.rows(np.flatnonzero(mask))

    def columns(self, axes: list[int]) -> Events:
        """The events with the values of some axes alone."""
        value, spread, codes = (np.ascontiguousarray(part[:, axes]) for part in (self.value, self.spread, self.codes))
        return self._replace(value=value, spread=spread, codes=codes)


class Results(NamedTuple):
    """What became of n events on A axes."""

    innovation: FloatArray  # ν [m], (n, A)
    innovation_sd: FloatArray  # √S [m], (n, A)
    noise_scale: FloatArray  # how many times as large as configured the arm's variances were, (n, A)
    outcome: CodeArray  # codes of Outcome, (n, A)
    contradicts: IndexArray  # the sensor that a rejected row contradicts time after time, −1 for none, (n,)

    @staticmethod
    def room(events: int, axes: int) -> Results:
        """Room for as many events, nothing decided."""
        shape = (events, axes)
        nu, sd, scale = (np.full(shape, np.nan) for _ in range(3))
        return Results(nu, sd, scale, np.full(shape, ABSENT, dtype=np.uint8), np.full(events, -1, dtype=np.int16))

    def rows(self, chosen: IntArray) -> Results:
        """What became of some of the events, in the order of ``chosen``."""
        return Results._make(part.take(chosen, axis=0) for part in self)


def concatenate(parts: Sequence[Events]) -> Events:
    """The events of several tables, one after the other."""
    if any(len(part.spread) for part in parts):
        parts = [part if len(part.spread) else part._replace(spread=np.ones_like(part.value)) for part in parts]
    if any(len(part.arrival) for part in parts):
        parts = [part if len(part.arrival) else part._replace(arrival=part.stamp) for part in parts]
    return Events._make(map(np.concatenate, zip(*parts, strict=True)))
