"""Scores against a reference: error, coverage and NEES of position and velocity, the angle; the reference in order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from .. import toml
from ..arrays import NO_STAMP, BoolArray, FloatArray, IndexArray, IntArray, TimeArray, median
from ..logs.clock import TOLERATED_STEP_BACK_NS, behind, in_order
from ..logs.source import Source
from ..space import rotations
from ..space.rotations import TURNING
from ..units import seconds
from .pose import turning_covariance

Z95 = 1.959963984540054  # a normal variable lies within ± this in 95 % of cases
_ALIKE = 0.5  # of the usual interval of a reference: noise of rows that are nearer would look like a bend without end
_SHORTEST_GAP = 0.050  # s; a reference is interpolated at least across this


@dataclass(frozen=True, repr=False)
class ReferenceTrack:
    """The reference in the run's own time.

    Attributes:
        time: [s since the first command], ascending, (k,).
        position: For each axis [m], NaN where it has none, (k,).
        sd: Standard deviation of its own noise on each axis [m], (k,).
        segment: As in :class:`pumafuse.fusion.estimates.Estimates`, (k,).
        cartesian: With a frame, its ``x``, ``y`` and ``z`` in the log [m], (k,).
    """

    time: FloatArray
    position: Mapping[str, FloatArray]
    sd: Mapping[str, FloatArray]
    segment: IntArray
    cartesian: Mapping[str, FloatArray] | None = None

    def between(self, after: float, until: float) -> ReferenceTrack:
        """The rows after one instant and until another [s]."""
        rows = (self.time > after) & (self.time <= until)
        position, sd, cartesian = (
            {name: value[rows] for name, value in by_axis.items()}
            for by_axis in (self.position, self.sd, self.cartesian or {})
        )
        return ReferenceTrack(self.time[rows], position, sd, self.segment[rows], cartesian or None)

    def __repr__(self) -> str:
        return f"ReferenceTrack({len(self.time):,} of {', '.join(self.position)})"


def late_rows(stamp: TimeArray) -> BoolArray:
    """Rows stamped more than 1 s behind an earlier one; they are not used, (rows,)."""
    return behind(stamp) > TOLERATED_STEP_BACK_NS


def reference_track(parts: Sequence[Source], origin: int) -> ReferenceTrack:
    """The reference of a run's segments in order, in seconds since ``origin`` (int ns), without late rows."""
    parts_known = [part.rows((part.stamp != NO_STAMP) & ~late_rows(part.stamp)) for part in parts]
    used = [part.rows(in_order(part.stamp)) for part in parts_known]
    return ReferenceTrack(
        seconds(np.concatenate([part.stamp for part in used]), origin),
        {axis: np.concatenate([part.values[axis] for part in used]) for axis in used[0].values},
        {
            axis: np.concatenate([part.sd_of(axis) * part.spread.get(axis, np.ones(len(part.stamp))) for part in used])
            for axis in used[0].values
        },
        np.repeat(np.arange(len(used)), [len(part.stamp) for part in used]),
    )


class Score(toml.Reported, frozen=True, kw_only=True):
    """Errors of one axis against a reference, in m or rad for positions, those in a second for velocities.

    Attributes:
        rmse: Root mean square error.
        bias: Mean of estimate − reference.
        coverage: Share of errors within 1.96 standard deviations.
        nees: Mean of error² / variance; 1 for a consistent filter. Estimates known exactly and right do not count. None
            where a variance is 0.
        rows: Estimates scored.
        left_out: Estimates with no reference near enough.
    """

    rmse: float = msgspec.field(name="rmse_mm")
    bias: float = msgspec.field(name="bias_mm")
    coverage: float
    nees: float | None = msgspec.field(name="nees_mean")
    rows: int
    left_out: int


def score(
    time: FloatArray, segment: IntArray, position: FloatArray, sd: FloatArray, reference: ReferenceTrack, axis: str
) -> Score | None:
    """Score the positions of one axis.

    The variance of the reference's own noise is added to the estimates', and between its rows that of how far off a
    line may be.

    Args:
        time: Of the estimates [s], (n,).
        segment: Of the estimates, (n,).
        position: p [m], (n,).
        sd: Its standard deviation [m], (n,).
        reference: What is taken for the true positions.
        axis: The axis of the reference.

    Returns:
        The score; None where no estimate of this axis has a reference.
    """
    if axis not in reference.position:
        return None
    true, noise = _true(time, segment, reference, axis)
    return _score(position - true, sd**2 + noise)


def score_velocity(
    time: FloatArray,
    segment: IntArray,
    velocity: FloatArray,
    sd: FloatArray,
    reference: ReferenceTrack,
    axis: str,
    period: float,
) -> Score | None:
    """Score the mean velocities over the coming ``period`` T of one axis against (p_ref(t + T) − p_ref(t)) / T.

    The reference is interpolated at t and t + T; an estimate is left out where it has no value at one of the two within
    the estimate's segment. The variance of both values' own noise, over T², is added to that of the estimates. None
    where no velocity of this axis has a reference.
    """
    if axis not in reference.position:
        return None
    (before, noise), (after, more) = (_true(t, segment, reference, axis) for t in (time, time + period))
    return _score(velocity - (after - before) / period, sd**2 + (noise + more) / period**2)


class OrientationScore(toml.Reported, frozen=True, kw_only=True):
    """Angles between the estimated orientations and those of a reference.

    Attributes:
        rms: Their root mean square [rad].
        expected: What it is by the covariance of the estimates and the reference's own noise [rad].
        rows: Estimates scored.
        left_out: Estimates with no reference near enough.
    """

    rms: float = msgspec.field(name="rms_deg")
    expected: float = msgspec.field(name="expected_deg")
    rows: int
    left_out: int


def score_orientation(
    time: FloatArray,
    segment: IntArray,
    position: Mapping[str, FloatArray],
    sd: Mapping[str, FloatArray],
    reference: ReferenceTrack,
) -> OrientationScore | None:
    """Score the axes rx, ry, rz together, which are relative to one orientation in both."""
    if not (set(TURNING) <= position.keys() and set(TURNING) <= reference.position.keys()):
        return None
    true = {axis: _true(time, segment, reference, axis) for axis in TURNING}
    is_known = np.isfinite([value for value, _ in true.values()]).all(axis=0)
    if not is_known.any():
        return None
    turned = {axis: position[axis][is_known] for axis in TURNING}
    noise = {axis: np.sqrt(sd[axis] ** 2 + variance)[is_known] for axis, (_, variance) in true.items()}
    vectors = np.column_stack([*turned.values()]), np.column_stack([value[is_known] for value, _ in true.values()])
    angle = rotations.angle_between(*map(rotations.of_vectors, vectors))
    variance: FloatArray = np.einsum("nii->n", turning_covariance(turned, noise))
    return OrientationScore(
        rms=float(np.sqrt(np.mean(angle**2))),
        expected=float(np.sqrt(np.mean(variance))),
        rows=int(is_known.sum()),
        left_out=int((~is_known).sum()),
    )


def interpolate(time: FloatArray, segment: IntArray | IndexArray, reference: ReferenceTrack, axis: str) -> FloatArray:
    """The reference [m] at ``time``, linear between its rows; NaN outside it and in gaps, (n,).

    A gap is an interval longer than twice the reference's median interval and longer than 50 ms.
    """
    return _interpolate(time, segment, reference, axis)[0]


def _score(error: FloatArray, variance: FloatArray) -> Score | None:
    """The score of errors, NaN where there is no reference, with the variance that they should have."""
    is_known = np.isfinite(error)
    if not is_known.any():
        return None
    left_out = int((~is_known).sum())
    error, variance = error[is_known], variance[is_known]
    counted = (variance > 0.0) | (error != 0.0)  # what is known exactly and right says nothing about the error bars
    with np.errstate(divide="ignore"):
        nees = float(np.mean(error[counted] ** 2 / variance[counted])) if counted.any() else 1.0
    return Score(
        rmse=float(np.sqrt(np.mean(error**2))),
        bias=float(np.mean(error)),
        coverage=float(np.mean(np.abs(error) <= Z95 * np.sqrt(variance))),
        nees=nees if np.isfinite(nees) else None,
        rows=len(error),
        left_out=left_out,
    )


def _true(time: FloatArray, segment: IntArray, reference: ReferenceTrack, axis: str) -> tuple[FloatArray, FloatArray]:
    """The reference [m] at ``time``, and the variance of its own noise and of its interpolation [m²], (n,)."""
    sd = np.interp(time, reference.time, reference.sd[axis]) if len(reference.time) else np.zeros(len(time))
    track, off = _interpolate(time, segment, reference, axis)
    return track, sd**2 + off**2


def _interpolate(
    time: FloatArray, segment: IntArray | IndexArray, reference: ReferenceTrack, axis: str
) -> tuple[FloatArray, FloatArray]:
    """The reference [m] at ``time`` as :func:`interpolate` has it, and how far off that may be [m], (n,)."""
    track, off = np.full(len(time), np.nan), np.zeros(len(time))
    for number in set(segment.tolist()):
        here = segment == number
        rows = (reference.segment == number) & np.isfinite(reference.position[axis])
        at, first = np.unique(reference.time[rows], return_index=True)
        if len(at):
            track[here], off[here] = _between(time[here], at, reference.position[axis][rows][first])
    return track, off


def _between(time: FloatArray, at: FloatArray, value: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A line between rows leaves (t − a)(b − t)/2 of what the path bends there."""
    longest = max(2.0 * median(np.diff(at)) if len(at) > 1 else 0.0, _SHORTEST_GAP)
    after = np.searchsorted(at, time, side="right")
    right, left = np.minimum(after, len(at) - 1), np.maximum(after - 1, 0)
    inside = (time >= at[0]) & (time <= at[-1])
    near = (at[right] - at[left] <= longest) | (at[left] == time)
    track = np.where(inside & near, np.interp(time, at, value), np.nan)
    if len(at) < 2:
        return track, np.zeros(len(time))
    gap = np.diff(at)
    usual = np.sort(gap)[3 * len(gap) // 4]
    apart = np.append(True, gap > _ALIKE * usual)
    bend = np.abs(np.gradient(np.gradient(value[apart], at[apart]), at[apart]))  # m/s²
    off = 0.5 * (time - at[left]) * (at[right] - time) * np.interp(time, at[apart], bend)
    return track, np.where(inside, off, 0.0)
