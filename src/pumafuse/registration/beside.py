"""How late one sensor is beside another that saw the same tool: by what both tell, never as a difference of lags.

What the arm does not do as commanded is the same to both, and so costs nothing here. Frames and markers that are
slightly wrong leave an affine function of the position, which is projected out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..arrays import FloatArray
from .intervals import half_widths
from .motion import Motion
from .register import Quantity
from .start import despiked

_SPEED = 0.05  # s, over which a velocity is taken
_ROUNDS = 10  # of the weights
_FEWEST = 60  # rows
_UNKNOWN = 0.05  # s, of half an interval


def later(first: Sequence[Motion], other: Sequence[Motion], about: float = 0.0) -> Quantity | None:
    """By how much the stamps of one sensor's rows are later than those of another's [s], with its 95 % interval.

    Args:
        first: What one sensor tells of the tool in the base's frame, one entry a run.
        other: What the other one tells of it, likewise.
        about: By how much, roughly [s].

    Returns:
        None where they have too little in common, or nothing moves, or it is not known to 50 ms.
    """
    shifted = [one._replace(time=one.time - about) for one in other]
    pairs = [_compared(a.valid(), b.valid()) for a, b in zip(first, shifted, strict=True)]
    pairs = [pair for pair in pairs if len(pair[0]) >= _FEWEST]
    if not pairs:
        return None
    apart, speed = (np.concatenate(part) for part in zip(*pairs, strict=True))
    weight = np.ones(len(apart))
    energy = float(np.sum(speed**2))
    if energy <= 0.0:
        return None
    late = 0.0
    for _ in range(_ROUNDS):  # Cauchy's weights
        late = -float(np.sum(weight[:, None] * speed * apart)) / energy
        off = np.sqrt(np.sum((apart + late * speed) ** 2, axis=1))
        weight = 1.0 / (1.0 + (off / max(float(np.median(off)), 1e-12)) ** 2)
        energy = float(np.sum(weight[:, None] * speed**2))
    influence = -np.sum(weight[:, None] * speed * (apart + late * speed), axis=1) / energy
    half = float(half_widths(influence[:, None], [len(pair[0]) for pair in pairs])[0])
    return None if half > _UNKNOWN else Quantity(about + late, (about + late - half, about + late + half))


def _compared(first: Motion, other: Motion) -> tuple[FloatArray, FloatArray]:
    """What the second sensor's rows are apart from the first [m], and its velocity [m/s], without what is affine."""
    ends = (first.time[0] + _SPEED, first.time[-1] - _SPEED) if len(first.time) else (0.0, -1.0)
    other = other.only((other.time >= ends[0]) & (other.time <= ends[1]))
    if not len(other.time):
        return np.zeros((0, 3)), np.zeros((0, 3))
    smooth = despiked(first.position)

    def at(time: FloatArray) -> FloatArray:
        return np.column_stack([np.interp(time, first.time, smooth[:, axis]) for axis in range(3)])

    there = at(other.time)
    speed = (at(other.time + _SPEED) - at(other.time - _SPEED)) / (2.0 * _SPEED)
    basis = np.linalg.qr(np.column_stack([there - there.mean(axis=0), np.ones(len(there))]))[0]
    apart = other.position - there
    return apart - basis @ (basis.T @ apart), speed - basis @ (basis.T @ speed)
