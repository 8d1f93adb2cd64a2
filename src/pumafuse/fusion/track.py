"""What an engine hands over: the state after each event, and the estimates that follow from it at any instant.

An estimate is a side prediction from the last event before it, so asking never changes the state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import CodeArray, FloatArray, TimeArray
from ..model.discrete import transition
from ..model.plants import Plant


@dataclass(frozen=True)
class Track:
    """States of one axis that each hold until the next event; everything relative to the start level.

    The state is the plant's n states, the offset, and the biases: s in all.

    Attributes:
        time: When each state holds from, int64 ns, (k,).
        mean: (k, s).
        covariance: (k, s, s).
        input: v acting from then on [m], (k,).
        noise: Its input noise density squared, two-sided [m²·s], (k,).
        drift: Density squared of the offset's random walk [m²/s], (k,).
    """

    time: TimeArray
    mean: FloatArray
    covariance: FloatArray
    input: FloatArray
    noise: FloatArray
    drift: FloatArray

    def at(self, time: TimeArray) -> Track:
        """The state that holds at each of ``time`` (the last event at or before it)."""
        index = np.maximum(np.searchsorted(self.time, time, side="right") - 1, 0)
        return Track(
            self.time[index],
            self.mean[index],
            self.covariance[index],
            self.input[index],
            self.noise[index],
            self.drift[index],
        )


@dataclass(frozen=True)
class Filtered:
    """What the filter made of one timeline.

    Attributes:
        tracks: For each axis; one state for each event, or one for each output when filtered as live.
        innovation: ν [m] of each scalar, NaN where the filter never met it, (m,).
        innovation_sd: √S [m], likewise.
        outcome: What became of each scalar, (m,).
        biases: For each axis the names of the sensors whose bias is in its state, in order.
    """

    tracks: tuple[Track, ...]
    innovation: FloatArray
    innovation_sd: FloatArray
    outcome: CodeArray
    biases: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class AxisEstimate:
    """Estimates of one axis in the log's coordinates, SI units, arrays (n,).

    Attributes:
        position: p [m].
        position_sd: Its standard deviation [m].
        velocity: C(A x + B v) [m/s], without the noise's share.
        velocity_sd: From the covariance of x alone [m/s].
        offset: o [m], what the model cannot explain.
        offset_sd: Its standard deviation [m].
    """

    position: FloatArray
    position_sd: FloatArray
    velocity: FloatArray
    velocity_sd: FloatArray
    offset: FloatArray
    offset_sd: FloatArray

    FIELDS = ("position", "position_sd", "velocity", "velocity_sd", "offset", "offset_sd")


def estimate(held: Track, time: TimeArray, plant: Plant, start: float) -> AxisEstimate:
    """Predict from each held state to its ``time``, (n,).

    Args:
        held: The state to predict from, one for each time.
        time: Int64 ns, none before its held state.
        plant: The plant of the axis.
        start: The level u₀ [m] that the states are relative to.
    """
    A, B, C = plant.state_space()
    n = len(A)
    distinct, place = np.unique(time - held.time, return_inverse=True)
    Phi, Gamma, Q = (part[place] for part in transition(plant, distinct / 1e9))
    x = (Phi @ held.mean[:, :n, None] + Gamma * held.input[:, None, None])[..., 0]
    Pxx = Phi @ held.covariance[:, :n, :n] @ Phi.swapaxes(1, 2) + Q * held.noise[:, None, None]
    Pxo = (Phi @ held.covariance[:, :n, n, None])[..., 0]
    Poo = held.covariance[:, n, n] + held.drift * (time - held.time) / 1e9
    offset = held.mean[:, n]
    rate = (C @ A)[0]
    position_variance = np.einsum("i,kij,j->k", C[0], Pxx, C[0]) + 2.0 * Pxo @ C[0] + Poo
    velocity_variance = np.einsum("i,kij,j->k", rate, Pxx, rate)
    return AxisEstimate(
        position=start + x @ C[0] + offset,
        position_sd=np.sqrt(np.maximum(position_variance, 0.0)),
        velocity=x @ rate + (C @ B).item() * held.input,
        velocity_sd=np.sqrt(np.maximum(velocity_variance, 0.0)),
        offset=offset.copy(),
        offset_sd=np.sqrt(np.maximum(Poo, 0.0)),
    )
