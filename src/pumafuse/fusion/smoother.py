"""The smoother: what all later readings say of a state, run backward over the events.

The modified Bryson-Frazier form (Bierman, "Fixed interval smoothing with discrete measurements", Int. J. Control 18,
1973) inverts no predicted covariance, which is singular here: the delay states are known. Per event, from the last:

    over an interval   λ ← Fᵀ λ,                    Λ ← Fᵀ Λ F
    over an update     λ ← −Hᵀ ν/S + (I − K H)ᵀ λ,  Λ ← Hᵀ H/S + (I − K H)ᵀ Λ (I − K H)

Known inputs drop out of both, and so does the widening of the offset when a gate reopens: it is noise.
"""

from __future__ import annotations

import numpy as np

from ..arrays import TimeArray
from ..model.plants import Plant
from .track import Adjoint, Track, extended


def adjoints(track: Track, plant: Plant) -> Adjoint:
    """λ and Λ of every entry of a track: what the events after it say of its state."""
    count, size = track.mean.shape
    mean, covariance = np.zeros((count, size)), np.zeros((count, size, size))
    interval, place = np.unique(np.diff(track.time), return_inverse=True)
    F = extended(plant, interval, size)[0]
    update = dict(zip(track.updates.entry.tolist(), range(len(track.updates.entry)), strict=True))
    for entry in range(count - 2, -1, -1):
        number = update.get(entry + 1)
        if number is None:
            step = F[place[entry]]
            mean[entry] = step.T @ mean[entry + 1]
            covariance[entry] = step.T @ covariance[entry + 1] @ step
        else:
            H, K = track.updates.H[number], track.updates.K[number]
            nu, S = track.updates.nu[number], track.updates.S[number]
            kept = np.eye(size) - np.outer(K, H)
            mean[entry] = kept.T @ mean[entry + 1] - H * (nu / S)
            covariance[entry] = kept.T @ covariance[entry + 1] @ kept + np.outer(H, H) / S
    return Adjoint(mean, covariance)


def adjoints_at(track: Track, found: Adjoint, time: TimeArray, plant: Plant) -> Adjoint:
    """λ and Λ at any ``time`` [int64 ns], (n,): carried back over the rest of the interval from the next event."""
    following = np.searchsorted(track.time, time, side="right")
    last = following == len(track.time)
    following = np.minimum(following, len(track.time) - 1)
    rest, place = np.unique(np.where(last, 0, track.time[following] - time), return_inverse=True)
    F = extended(plant, rest, track.mean.shape[1])[0][place]
    after = np.where(last, 0.0, 1.0)
    mean = np.einsum("kji,kj->ki", F, found.mean[following]) * after[:, None]
    covariance = F.swapaxes(1, 2) @ found.covariance[following] @ F * after[:, None, None]
    return Adjoint(mean, covariance)
