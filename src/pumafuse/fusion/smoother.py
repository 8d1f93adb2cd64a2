"""The smoother: what all later measurements say of a state, carried backward over the events as information.

In the deviation δ from the filter's own mean the inputs cancel, and the later measurements' likelihood is
exp(−½ δᵀ N δ + ηᵀ δ). From the last event backward, N = 0 and η = 0 at first:

    over an interval   η ← Fᵀ (I + N Q)⁻¹ η,            N ← Fᵀ (I + N Q)⁻¹ N F
    over an update     η ← η + N K ν + Hᵀ ν / R,        N ← N + Hᵀ H / R

and with the filter's covariance P the smoothed state is x + P_s η with P_s = (I + P N)⁻¹ P. No covariance is inverted
(the predicted one is singular: the delay states are known), and nothing is subtracted, as P − P Λ P would be in the
equivalent Bryson-Frazier form: with a wide prior that difference loses the error bars altogether.
(Fraser & Potter, "The optimum linear smoother as a combination of two optimum linear filters", IEEE Trans. AC 14(4),
1969.)
"""

from __future__ import annotations

import numpy as np

from ..arrays import FloatArray, IntArray, TimeArray
from ..model.plants import Plant
from .track import Hindsight, Track, process_noise, transitions


def hindsight(track: Track, plant: Plant) -> Hindsight:
    """η and N of every entry of a track: what the events after it say of its state."""
    count, size = track.mean.shape
    eta, N = np.zeros((count, size)), np.zeros((count, size, size))
    interval = np.diff(track.time)
    moves, place = transitions(plant, interval, size)
    Q = process_noise(track, np.arange(count - 1, dtype=np.int64), moves, place, interval)
    updates = track.updates
    made = np.full(count, -1)  # which update made each entry, −1 for none
    made[updates.entry] = np.arange(len(updates.entry))
    offset = len(plant.state_space()[0])
    for entry in range(count - 2, -1, -1):
        later_eta, later_N, number = eta[entry + 1], N[entry + 1], made[entry + 1]
        if number < 0:
            eta[entry], N[entry] = _over(moves.F[place[entry]], Q[entry], later_eta, later_N)
            continue
        H, nu, R = updates.H[number], updates.nu[number], updates.R[number]
        before_eta = later_eta + later_N @ updates.K[number] * nu + H * (nu / R)
        before_N = later_N + np.outer(H, H) / R
        if updates.widened[number] > 0.0:  # a gate that reacquired let the offset move
            jump = np.zeros((size, size))
            jump[offset, offset] = updates.widened[number]
            before_eta, before_N = _over(np.eye(size), jump, before_eta, before_N)
        eta[entry], N[entry] = before_eta, before_N
    return Hindsight(eta, N)


def hindsight_at(track: Track, found: Hindsight, entry: IntArray, time: TimeArray, plant: Plant) -> Hindsight:
    """η and N at any ``time`` [int64 ns], (n,), each held by ``entry``: the rest of its interval carried backward."""
    size = track.mean.shape[1]
    following = np.minimum(entry + 1, len(track.time) - 1)
    rest = np.where(entry + 1 < len(track.time), track.time[following] - time, 0)
    moves, place = transitions(plant, rest, size)
    Q = process_noise(track, entry, moves, place, rest)
    eta, N = _over(moves.F[place], Q, found.eta[following], found.N[following])
    return Hindsight(eta, N)


def _over(F: FloatArray, Q: FloatArray, eta: FloatArray, N: FloatArray) -> tuple[FloatArray, FloatArray]:
    """η and N carried backward over an interval; leading axes are independent."""
    size = N.shape[-1]
    both = np.linalg.solve(np.eye(size) + N @ Q, np.concatenate((N @ F, eta[..., None]), axis=-1))
    back = F.swapaxes(-1, -2) @ both
    before = back[..., :size]
    return back[..., size], 0.5 * (before + before.swapaxes(-1, -2))
