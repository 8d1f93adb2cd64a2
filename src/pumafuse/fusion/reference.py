"""The reference of a run in order and in the run's own time, to score estimates against."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import NO_STAMP, BoolArray, FloatArray, IntArray
from ..logs.clock import TOLERATED_STEP_BACK_NS, behind
from ..logs.run import Source
from ..units import seconds


@dataclass(frozen=True)
class ReferenceTrack:
    """The reference in the run's own time.

    Attributes:
        time: [s since the first command], ascending, (k,).
        position: For each axis [m], NaN where it has none, (k,).
        sd: Standard deviation of its own noise on each axis [m], (k,).
        segment: As in :class:`pumafuse.fusion.estimates.Estimates`, (k,).
    """

    time: FloatArray
    position: Mapping[str, FloatArray]
    sd: Mapping[str, FloatArray]
    segment: IntArray


def late_rows(reference: Source) -> BoolArray:
    """Rows stamped more than 1 s behind an earlier one; they are not used, (rows,)."""
    return behind(reference.stamp) > TOLERATED_STEP_BACK_NS


def reference_track(reference: Source, origin: int) -> ReferenceTrack:
    """A run's reference in order, in seconds since ``origin`` (int ns), without rows behind a jump back."""
    kept = reference.rows((reference.stamp != NO_STAMP) & ~late_rows(reference))
    order = np.argsort(kept.stamp, kind="stable")
    position = {axis: value[order] for axis, value in kept.values.items()}
    sd = {axis: reference.sd * kept.spread.get(axis, np.ones(len(order)))[order] for axis in position}
    return ReferenceTrack(seconds(kept.stamp[order], origin), position, sd, np.zeros(len(order), dtype=np.int64))


def joined_references(parts: Sequence[tuple[ReferenceTrack, float, int]]) -> ReferenceTrack:
    """One reference of several segments; ``parts`` gives each with a shift of its time [s] and its segment's number."""
    first = parts[0][0]
    return ReferenceTrack(
        np.concatenate([track.time + shift for track, shift, _ in parts]),
        {axis: np.concatenate([track.position[axis] for track, _, _ in parts]) for axis in first.position},
        {axis: np.concatenate([track.sd[axis] for track, _, _ in parts]) for axis in first.position},
        np.concatenate([np.full(len(track.time), number) for track, _, number in parts]),
    )
