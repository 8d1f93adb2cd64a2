"""What an engine hands over: the state after each event, and the estimates that follow from it at any instant.

An estimate is a side prediction from the last event before it, so asking never changes the state.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..arrays import CodeArray, FloatArray, IntArray, TimeArray
from ..model.discrete import transition
from ..model.plants import Plant


@dataclass(frozen=True)
class Updates:
    """The updates among the entries of a track, for the smoother.

    Attributes:
        entry: Which entry each update made, ascending, (u,).
        H: Its observation row, (u, s).
        K: Its Kalman gain, (u, s).
        nu: Its innovation [m], (u,).
        R: Its measurement's variance [m²], (u,).
        widened: By how much a reacquired gate widened the offset's variance just before [m²], (u,).
    """

    entry: IntArray
    H: FloatArray
    K: FloatArray
    nu: FloatArray
    R: FloatArray
    widened: FloatArray


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
        updates: Which entries are updates, and what they were.
    """

    time: TimeArray
    mean: FloatArray
    covariance: FloatArray
    input: FloatArray
    noise: FloatArray
    drift: FloatArray
    updates: Updates

    def holding(self, time: TimeArray) -> IntArray:
        """The entry that holds at each of ``time``: the last one at or before it."""
        return np.maximum(np.searchsorted(self.time, time, side="right") - 1, 0)


@dataclass(frozen=True)
class Hindsight:
    """What all later measurements say of states, as information on the deviation from the filter's mean.

    Attributes:
        eta: η, (k, s).
        N: Its matrix, (k, s, s).
    """

    eta: FloatArray
    N: FloatArray


@dataclass(frozen=True)
class Filtered:
    """What the filter made of one timeline.

    Attributes:
        tracks: For each axis; one state for each event, or one for each output when filtered as live.
        innovation: ν [m] of each component, NaN where the filter never met it, (m,).
        innovation_sd: √S [m], likewise.
        outcome: What became of each component, (m,).
        biases: For each axis the names of the sensors whose bias is in its state, in order.
        final: For each axis mean (s,) and covariance (s, s) after every measurement.
    """

    tracks: tuple[Track, ...]
    innovation: FloatArray
    innovation_sd: FloatArray
    outcome: CodeArray
    biases: tuple[tuple[str, ...], ...]
    final: tuple[tuple[FloatArray, FloatArray], ...]


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


@dataclass(frozen=True)
class Bias:
    """A sensor's constant bias on one axis [m], in the log's coordinates, and its standard deviation [m]."""

    value: float
    sd: float


@dataclass(frozen=True)
class Fused:
    """What an engine makes of one timeline.

    Attributes:
        axes: Estimates by axis.
        innovation: ν [m] of each component, NaN where the filter never met it, (m,).
        innovation_sd: √S [m], likewise.
        outcome: What became of each component, (m,).
        biases: By sensor and axis, as all measurements together know it.
    """

    axes: dict[str, AxisEstimate]
    innovation: FloatArray
    innovation_sd: FloatArray
    outcome: CodeArray
    biases: dict[str, dict[str, Bias]]


class Moves(NamedTuple):
    """Transitions of plant, offset and biases over some intervals, (k, …).

    Attributes:
        F: (k, s, s), with the constant states' ones.
        Gamma: (k, n).
        Q: Of the plant for unit input noise, (k, n, n).
    """

    F: FloatArray
    Gamma: FloatArray
    Q: FloatArray


def transitions(plant: Plant, interval: IntArray, size: int) -> tuple[Moves, IntArray]:
    """Transitions over the distinct ones of ``interval`` [int ns], and which of them each interval is."""
    distinct, place = np.unique(interval, return_inverse=True)
    Phi, Gamma, Q = transition(plant, distinct / 1e9)
    n = Phi.shape[-1]
    F = np.tile(np.eye(size), (len(distinct), 1, 1))
    F[:, :n, :n] = Phi
    return Moves(F, Gamma[..., 0], Q), place


def process_noise(track: Track, entry: IntArray, moves: Moves, place: IntArray, interval: IntArray) -> FloatArray:
    """Covariance that each interval [int ns] after its ``entry`` adds to the state, (k, s, s)."""
    size, n = moves.F.shape[-1], moves.Q.shape[-1]
    Q = np.zeros((len(entry), size, size))
    Q[:, :n, :n] = moves.Q[place] * track.noise[entry][:, None, None]
    Q[:, n, n] = track.drift[entry] * (interval / 1e9)
    return Q


def estimate(
    track: Track, entry: IntArray, time: TimeArray, plant: Plant, start: float, hindsight: Hindsight | None = None
) -> AxisEstimate:
    """Predict from a held state to each ``time``, (n,), and smooth it where hindsight is given.

    Args:
        track: The states.
        entry: Which of them to predict from, one for each time.
        time: Int64 ns, none before its state.
        plant: The plant of the axis.
        start: The level u₀ [m] that the states are relative to.
        hindsight: What later measurements say of the state at each time.
    """
    A, B, C = plant.state_space()
    n, size = len(A), track.mean.shape[1]
    interval, v = time - track.time[entry], track.input[entry]
    moves, place = transitions(plant, interval, size)
    F = moves.F[place]
    x = np.einsum("kij,kj->ki", F, track.mean[entry])
    x[:, :n] += moves.Gamma[place] * v[:, None]
    P = F @ track.covariance[entry] @ F.swapaxes(1, 2) + process_noise(track, entry, moves, place, interval)
    if hindsight is not None:
        # From the left P keeps the zero rows of states that are known exactly, whatever the solver's pivots.
        told = np.concatenate((np.broadcast_to(np.eye(size), P.shape), hindsight.eta[..., None]), axis=-1)
        smoothed = P @ np.linalg.solve(np.eye(size) + hindsight.N @ P, told)
        np.copyto(P, 0.5 * (smoothed[..., :size] + smoothed[..., :size].swapaxes(1, 2)))
        x += smoothed[..., size]
    position, velocity, offset = np.zeros((3, size))
    position[:n], position[n], velocity[:n], offset[n] = C[0], 1.0, (C @ A)[0], 1.0
    return AxisEstimate(
        position=start + x @ position,
        position_sd=_sd(P, position),
        velocity=x @ velocity + (C @ B).item() * v,
        velocity_sd=_sd(P, velocity),
        offset=x @ offset,
        offset_sd=_sd(P, offset),
    )


def _sd(P: FloatArray, row: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(np.einsum("i,kij,j->k", row, P, row), 0.0))
