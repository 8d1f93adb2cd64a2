"""The reference of a run in order and in the run's own time, to score estimates against."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import NO_STAMP, BoolArray, FloatArray, IntArray, TimeArray
from ..logs.clock import TOLERATED_STEP_BACK_NS, behind
from ..logs.run import Reference
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


def late_rows(stamp: TimeArray) -> BoolArray:
    """Rows stamped more than 1 s behind an earlier one; they are not used, (rows,)."""
    return behind(stamp) > TOLERATED_STEP_BACK_NS


def reference_track(parts: Sequence[Reference], origin: int) -> ReferenceTrack:
    """The reference of a run's segments in order, in seconds since ``origin`` (int ns), without late rows."""
    used = [part.rows((part.stamp != NO_STAMP) & ~late_rows(part.stamp)) for part in parts]
    used = [part.rows(np.argsort(part.stamp, kind="stable")) for part in used]
    noise = [{axis: part.sd * part.spread.get(axis, np.ones(len(part.stamp))) for axis in part.values} for part in used]
    return ReferenceTrack(
        seconds(np.concatenate([part.stamp for part in used]), origin),
        {axis: np.concatenate([part.values[axis] for part in used]) for axis in used[0].values},
        {axis: np.concatenate([sd[axis] for sd in noise]) for axis in noise[0]},
        np.repeat(np.arange(len(used)), [len(part.stamp) for part in used]),
    )
