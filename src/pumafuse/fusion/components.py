"""The components of all measurements in their total order, and what is known of each before any filter.

Rows of one valid time come in the order of the sensors, then by stamp and place in the file; components of a row by
axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..arrays import NO_STAMP, CodeArray, FloatArray, IndexArray, IntArray, TimeArray
from ..logs.clock import TOLERATED_STEP_BACK_NS, behind
from ..logs.run import Run, Source
from ..logs.run import note_rows as tell
from .config import FusionConfig, Sensor
from .outcome import Outcome, plausible

_REASONS: Mapping[Outcome, str] = {
    Outcome.INVALID: "no stamp",
    Outcome.DUPLICATE: "the stamp and values of an earlier row",
    Outcome.BEFORE_START: "a time before the first command",
    Outcome.TOO_LATE: "a stamp more than 1 s behind an earlier one",
    Outcome.UNKNOWN: "no sensor of this name in the configuration",
}


@dataclass(frozen=True)
class Components:
    """The components of all measurements in the order of processing; arrays are (m,).

    Attributes:
        valid: The instant each is true of, int64 ns (``NO_STAMP`` without a stamp).
        stamp: As logged, int64 ns (``NO_STAMP`` without one, or if it is stray).
        sensor: Index into ``sensors``.
        axis: Index into the timeline's axes.
        value: z [m] as logged.
        row: Components of one row of one sensor share this number; it never falls.
        spread: By what a frame scales the noise of each; None without one.
        outcome: What is known before filtering; ``Outcome.FUSED`` where the filter is to decide.
        sensors: Sensor names, the configured ones first in their order.
    """

    valid: TimeArray
    stamp: TimeArray
    sensor: IndexArray
    axis: IndexArray
    value: FloatArray
    row: IntArray
    spread: FloatArray | None
    outcome: CodeArray
    sensors: tuple[str, ...]

    @cached_property
    def candidates(self) -> IntArray:
        """Indices of the components that the filter is to decide on."""
        return np.flatnonzero(self.outcome == Outcome.FUSED)


def components_of(run: Run, config: FusionConfig, names: tuple[str, ...], origin: int, notes: list[str]) -> Components:
    """Put the measurements of a run into their total order.

    Args:
        run: One segment of a recorded run.
        config: Latency and noise of the sensors.
        names: The sensors to use, the configured ones first in their order.
        origin: The first command, int ns.
        notes: Gets a sentence on everything that is wrong with the rows.
    """
    heard = [_heard(run, config, name, origin, notes) for name in names]
    valid = np.concatenate([np.zeros(0, dtype=np.int64), *(part.valid for part in heard)])
    stamp = np.concatenate([np.zeros(0, dtype=np.int64), *(part.stamp for part in heard)])
    sensor = np.repeat(np.arange(len(names), dtype=np.int16), [len(part.valid) for part in heard])
    # Each sensor's rows are in order, and the sensors in theirs: a stable sort by valid time keeps both.
    order = np.argsort(valid, kind="stable")
    width = np.array([len(part.axes) for part in heard], dtype=np.int64)[sensor[order]]
    count = int(width.sum())
    first = np.empty(len(order), dtype=np.int64)  # where each row's components begin
    first[order] = np.cumsum(width) - width
    axis, value, outcome = np.empty(count, np.int16), np.empty(count), np.empty(count, np.uint8)
    spread = np.ones(count) if any(run.sensors[name].spread for name in names) else None
    begin = 0
    for part in heard:
        at = first[begin : begin + len(part.valid)]
        begin += len(part.valid)
        for place, number in enumerate(part.axes):
            here = at + place
            axis[here], value[here], outcome[here] = number, part.value[place], part.outcome[place]
            if spread is not None and part.spread is not None:
                spread[here] = part.spread[place]
    return Components(
        np.repeat(valid[order], width),
        np.repeat(stamp[order], width),
        np.repeat(sensor[order], width),
        axis,
        value,
        np.repeat(np.arange(len(order)), width),
        spread,
        outcome,
        names,
    )


class _Heard(NamedTuple):
    """One sensor's rows in order; of its k axes: their numbers (k,), and value, spread and outcome (k, rows)."""

    valid: TimeArray
    stamp: TimeArray
    axes: IndexArray
    value: FloatArray
    spread: FloatArray | None
    outcome: CodeArray


def _heard(run: Run, config: FusionConfig, name: str, origin: int, notes: list[str]) -> _Heard:
    source, sensor = run.sensors[name], config.sensors.get(name)
    label = source.label_for(name)
    latency = 0 if sensor is None else round(sensor.latency * 1e9)
    valid = np.where(source.stamp == NO_STAMP, NO_STAMP, source.stamp - latency)
    outcomes = _row_outcomes(source, sensor, valid, origin)
    tell(notes, label, behind(source.stamp) > 0, "a stamp that steps back: sorted")
    for kind, reason in _REASONS.items():
        tell(notes, label, outcomes == kind, f"{reason}: {kind.word}")
    axes = [(number, axis) for number, axis in enumerate(run.axes) if axis in source.values]
    shape = (len(axes), len(valid))
    value = np.empty(shape)
    spread = np.ones(shape) if source.spread else None
    outcome = np.repeat(outcomes[None], len(axes), axis=0)
    for place, (_, axis) in enumerate(axes):
        value[place] = source.values[axis]
        if spread is not None and axis in source.spread:
            spread[place] = source.spread[axis]
        if sensor is not None and sensor.sd_of(axis) is None:
            notes.append(f"{label}: sd_mm has no entry for {axis}, which is not used: {Outcome.UNKNOWN.word}")
            outcome[place] = Outcome.UNKNOWN
            continue
        hollow = (outcomes == Outcome.FUSED) & ~plausible(value[place])
        outcome[place, hollow] = Outcome.INVALID
        tell(notes, label, hollow, f"no finite {axis} value: {Outcome.INVALID.word}")
    heard = _Heard(
        valid, source.stamp, np.array([number for number, _ in axes], dtype=np.int16), value, spread, outcome
    )
    if (np.diff(valid) >= 0).all():
        return heard
    order = np.argsort(valid, kind="stable")
    return heard._replace(
        valid=valid[order],
        stamp=source.stamp[order],
        value=value[:, order],
        spread=None if spread is None else spread[:, order],
        outcome=outcome[:, order],
    )


def _row_outcomes(source: Source, sensor: Sensor | None, valid: TimeArray, origin: int) -> CodeArray:
    """What is known of each row whatever its axes say, the strongest reason last."""
    outcome = np.full(len(valid), Outcome.FUSED, dtype=np.uint8)
    outcome[valid < origin] = Outcome.BEFORE_START
    outcome[behind(source.stamp) > TOLERATED_STEP_BACK_NS] = Outcome.TOO_LATE
    outcome[source.repeated()] = Outcome.DUPLICATE
    outcome[source.stamp == NO_STAMP] = Outcome.INVALID
    if sensor is None:
        outcome[:] = Outcome.UNKNOWN
    return outcome
