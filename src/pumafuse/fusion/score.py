"""Scoring against a reference: error, coverage and NEES of the position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray
from .reference import ReferenceTrack

Z95 = 1.959963984540054  # a normal variable lies within ± this in 95 % of cases
_SHORTEST_GAP = 0.050  # s; a reference is interpolated at least across this


@dataclass(frozen=True)
class Score:
    """How one axis did against a reference.

    Attributes:
        rmse: Root mean square error [m].
        bias: Mean of estimate − reference [m].
        coverage: Share of errors within 1.96 standard deviations.
        nees: Mean of error² / variance; 1 for a consistent filter. Estimates known exactly and right do not count.
        rows: Estimates scored.
        left_out: Estimates with no reference near enough.
    """

    rmse: float
    bias: float
    coverage: float
    nees: float
    rows: int
    left_out: int


def score(
    time: FloatArray, segment: IntArray, position: FloatArray, sd: FloatArray, reference: ReferenceTrack, axis: str
) -> Score | None:
    """Score one axis at its estimate times; the reference's own noise adds to the variance.

    Args:
        time: Of the estimates [s], (n,).
        segment: Of the estimates, (n,).
        position: p [m], (n,).
        sd: Its standard deviation [m], (n,).
        reference: The truth.
        axis: Which axis of it.

    Returns:
        The score; None where the reference says nothing about any estimate of this axis.
    """
    if axis not in reference.position:
        return None
    truth = interpolated(time, segment, reference, axis)
    noise = np.interp(time, reference.time, reference.sd[axis]) if len(reference.time) else np.zeros(len(time))
    scored = np.isfinite(truth)
    if not scored.any():
        return None
    error = (position - truth)[scored]
    variance = sd[scored] ** 2 + noise[scored] ** 2
    telling = (variance > 0.0) | (error != 0.0)  # what is known exactly and is right says nothing of the error bars
    with np.errstate(divide="ignore"):
        nees = error[telling] ** 2 / variance[telling]
    return Score(
        rmse=float(np.sqrt(np.mean(error**2))),
        bias=float(np.mean(error)),
        coverage=float(np.mean(np.abs(error) <= Z95 * np.sqrt(variance))),
        nees=float(np.mean(nees)) if len(nees) else 1.0,
        rows=int(scored.sum()),
        left_out=int((~scored).sum()),
    )


def interpolated(time: FloatArray, segment: IntArray, reference: ReferenceTrack, axis: str) -> FloatArray:
    """The reference [m] at ``time``, linear between its rows; NaN outside it and in gaps, (n,).

    A gap is an interval longer than twice the reference's median interval and longer than 50 ms.
    """
    truth = np.full(len(time), np.nan)
    for number in np.unique(segment):
        here = segment == number
        there = (reference.segment == number) & np.isfinite(reference.position[axis])
        truth[here] = _between(time[here], reference.time[there], reference.position[axis][there])
    return truth


def _between(time: FloatArray, known: FloatArray, value: FloatArray) -> FloatArray:
    if not len(known):
        return np.full(len(time), np.nan)
    known, first = np.unique(known, return_index=True)
    longest = max(2.0 * float(np.median(np.diff(known))) if len(known) > 1 else 0.0, _SHORTEST_GAP)
    right = np.minimum(np.searchsorted(known, time, side="right"), len(known) - 1)
    left = np.maximum(np.searchsorted(known, time, side="right") - 1, 0)
    inside: BoolArray = (time >= known[0]) & (time <= known[-1])
    near = (known[right] - known[left] <= longest) | (known[left] == time)
    return np.where(inside & near, np.interp(time, known, value[first]), np.nan)
