"""Frame, marker, lag and plant at once, by robust least squares: Gauss and Newton's steps on the rotations themselves.

A row is off by e = p + R m − c − s S (z − z̄) [m] and, where the sensor tells an orientation, by the rotation that
takes S R_sensor Qᵀ to R [rad]; p, R are the arm's response, z and R_sensor what is measured, S the frame's rotation,
m the marker's place, Q its rotation, c where the mean z̄ of what is measured lies, s a scale. Rows
have the weights of Cauchy's distribution. Their errors are whitened by direction, since an arm errs more along its path
than across it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import FloatArray, median
from ..space.rotations import cross_matrix
from .intervals import Blocks, blocks, inverse, of_poses
from .motion import Answer, Plant, Poses

ROTATION, CENTRE, MARKER, TURN, SCALE, POSITION, ANGLE = (
    slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 13), slice(13, 15), slice(15, 17)
)  # fmt: skip  # of a step: delay and log τ in the last two
SIZE = 17
CAUCHY = 3.0  # standard deviations from which a row counts half
MEDIAN = 1.5382  # of the length of three standard normal deviates
_LEAST = 1e-9  # m or rad: rounding
_ROUNDS, _EVEN = 5, 0.2  # of a covariance; how much of it is the same in all directions: sensors are noisy in each
_NORMAL = 1.96  # standard deviations: both sides 95 %
_RADIAN = 0.3  # m that count as a radian: an arm errs alike at nearer poses; three times as far changes little
_STEPS = 50  # at most
_HALVED = 6  # times that a step which leads up is halved
_ENOUGH = 1e-8  # of the sum per row: a step that gains less is the last
_SHORTEST, _LONGEST = 1e-3, 2.0  # s, of a time constant
_FASTEST = 0.3  # s, by which a dead time changes in a step at most; τ and scale change by a factor of e


class State(NamedTuple):
    """What is looked for."""

    rotation: FloatArray  # S, base from sensor, (3, 3)
    centre: FloatArray  # where the mean of what the sensor measures lies in the base [m], (3,)
    marker: FloatArray  # its place on the tool [m], (3,)
    turn: FloatArray  # Q, tool from marker, (3, 3)
    scale: float  # of the base's lengths over the sensor's
    position: Plant  # the plant of positions
    angle: Plant  # the plant of orientations

    def move(self, step: FloatArray) -> State:
        """After a step, (17,)."""
        plants = [
            Plant(
                part.delay + float(np.clip(by[0], -_FASTEST, _FASTEST)),
                float(np.clip(part.time_constant * np.exp(np.clip(by[1], -1.0, 1.0)), _SHORTEST, _LONGEST)),
            )
            for part, by in ((self.position, step[POSITION]), (self.angle, step[ANGLE]))
        ]
        return State(
            Rotation.from_rotvec(step[ROTATION]).as_matrix() @ self.rotation,
            self.centre + step[CENTRE],
            self.marker + step[MARKER],
            Rotation.from_rotvec(step[TURN]).as_matrix() @ self.turn,
            self.scale * float(np.exp(np.clip(step[SCALE][0], -1.0, 1.0))),
            *plants,
        )


class Rows(NamedTuple):
    """What a sensor measured, the rows of all runs after one another."""

    answer: Answer  # where the tool is by its commands
    centred: FloatArray  # z − z̄ [m], (n, 3); z̄ is any point in the middle
    turned: FloatArray | None  # r_sensor, (n, 3, 3); None where it is not told


class Off(NamedTuple):
    """How far rows are off."""

    blocks: list[FloatArray]  # lengths [m], (n, 3), and angles [rad] where the sensor tells orientation, (n, 3)
    poses: Poses  # where the tool is

    def noise(self) -> FloatArray:
        """The standard deviation of each block, by the median."""
        return np.array([max(median(_length(block)) / MEDIAN, _LEAST) for block in self.blocks])

    def whitening(self) -> list[FloatArray]:
        """The matrix that gives each block standard deviations of 1 along all directions, (3, 3)."""
        return [_whitening(block) for block in self.blocks]

    def rms(self) -> list[float]:
        """RMS of each block, over rows that are within ten medians."""
        lengths = [_length(block) for block in self.blocks]
        kept = [length[length <= 10.0 * median(length) + _LEAST] for length in lengths]
        return [float(np.sqrt(np.mean(length**2))) for length in kept]

    def cost(self, whitening: Sequence[FloatArray]) -> float:
        """Cauchy's sum."""
        white = [block @ by for block, by in zip(self.blocks, whitening, strict=True)]
        return float(sum(np.log1p((_length(block) / CAUCHY) ** 2).sum() for block in white))


class Fit(NamedTuple):
    """The least squares that were found."""

    state: State  # what was looked for
    off: Off  # how far each row is off
    free: FloatArray  # the steps that are allowed, as columns, (17, k)
    blocks: Blocks  # what blocks of rows tell of them
    of_poses: FloatArray  # the covariance of their score by what the arm errs with the pose, (k, k)

    def left(self) -> float:
        """The standard deviation of positions [m]."""
        return float(self.off.noise()[0])

    def half_widths(self, numbers: FloatArray) -> FloatArray:
        """Half the 95 % interval of numbers that change so with a step, (q, 17) → (q,)."""
        numbers = numbers @ self.free
        by = numbers @ inverse(self.blocks.information.sum(axis=0))
        return np.hypot(self.blocks.half_widths(numbers), _NORMAL * np.sqrt(np.sum(by @ self.of_poses * by, axis=1)))


def fit_poses(rows: Rows, state: State, free: FloatArray) -> Fit:
    """The robust least squares from a start; the steps that are allowed are columns, (17, k)."""
    off = residual(rows, state)
    for _ in range(_STEPS):
        whitening = off.whitening()
        normal = _normal(rows, state, off, whitening, free, expected=False)
        step = normal.step()
        if -(normal.score.sum(axis=0) @ step) < _ENOUGH * len(rows.centred):
            break
        better = _better(rows, state, free @ step, off.cost(whitening), whitening)
        if better is None:
            break
        state, off = better
    normal = _normal(rows, state, off, off.whitening(), free, expected=True)
    return Fit(state, off, free, normal, _of_poses(rows, state, off, free))


def residual(rows: Rows, state: State) -> Off:
    """How far each row is off."""
    poses = rows.answer.poses(state.position, state.angle)
    seen = state.scale * rows.centred @ state.rotation.T
    blocks = [poses.position + poses.rotation @ state.marker - state.centre - seen]
    if rows.turned is not None:
        measured = state.rotation @ rows.turned @ state.turn.T
        blocks.append(Rotation.from_matrix(poses.rotation @ measured.swapaxes(1, 2)).as_rotvec())
    return Off(blocks, poses)


def _better(
    rows: Rows, state: State, step: FloatArray, cost: float, whitening: Sequence[FloatArray]
) -> tuple[State, Off] | None:
    """After a step, halved until it leads down; None where it does not."""
    for _ in range(_HALVED):
        moved = state.move(step)
        off = residual(rows, moved)
        if off.cost(whitening) < cost:
            return moved, off
        step = 0.5 * step
    return None


def _normal(
    rows: Rows, state: State, off: Off, whitening: Sequence[FloatArray], free: FloatArray, *, expected: bool
) -> Blocks:
    """The information of the free steps and the slope of half the sum, of each block of rows."""
    return information_of(
        [slope @ free for slope in slopes(rows, state, off.poses)], off.blocks, whitening, expected=expected
    )


def _of_poses(rows: Rows, state: State, off: Off, free: FloatArray) -> FloatArray:
    """The covariance of the score of the free steps by what the arm errs with the pose."""
    turned, covariance = Rotation.from_matrix(off.poses.rotation), np.zeros((free.shape[1], free.shape[1]))
    pose = np.hstack([off.poses.position / _RADIAN, (turned * turned.mean().inv()).as_rotvec()])
    for slope, residual, by in zip(slopes(rows, state, off.poses), off.blocks, off.whitening(), strict=True):
        white = residual @ by
        covariance += of_poses(by @ slope @ free, white, weights(_length(white), 1.0), pose)
    return covariance


def information_of(
    slope: Sequence[FloatArray], off: Sequence[FloatArray], whitening: Sequence[FloatArray], *, expected: bool
) -> Blocks:
    """The information and the score of rows, by how far they are off and how that changes with a step.

    Positions and orientations count together.

    The information is that of Cauchy's curvature where it is the ``expected`` one, of which intervals are made; else
    the larger one of Gauss and Newton, which leads down more safely.
    """
    parts = list[Blocks]()
    for inner, residual, by in zip(slope, off, whitening, strict=True):
        white = residual @ by
        weight = weights(_length(white), 1.0)
        parts.append(blocks(by @ inner, white, curvature(weight) if expected else weight, weight))
    return Blocks(*(np.sum(blocks, axis=0) for blocks in zip(*parts, strict=True)))


def weights(length: FloatArray, sd: float) -> FloatArray:
    """Weights of rows that are so far off, by Cauchy's distribution, (n,)."""
    return 1.0 / (1.0 + (length / (CAUCHY * sd)) ** 2)


def curvature(weight: FloatArray) -> FloatArray:
    """Weights of rows for the curvature: the mean over the directions in which they may be off, (n,)."""
    return weight * (1.0 + 2.0 * weight) / 3.0


def slopes(rows: Rows, state: State, poses: Poses) -> list[FloatArray]:
    """How each block changes with a step, (n, 3, 17)."""
    moved, turned = rows.answer.slopes(state.position, state.angle, poses)
    seen = state.scale * rows.centred @ state.rotation.T
    arm = poses.rotation @ state.marker
    jacobian = np.zeros((len(seen), 3, SIZE))
    jacobian[:, :, ROTATION] = cross_matrix(seen)
    jacobian[:, :, CENTRE] = -np.eye(3)
    jacobian[:, :, MARKER] = poses.rotation
    jacobian[:, :, SCALE] = -seen[:, :, None]
    jacobian[:, :, POSITION] = np.stack(moved, axis=-1)
    jacobian[:, :, ANGLE] = np.stack([np.cross(vector, arm) for vector in turned], axis=-1)
    if rows.turned is None:
        return [jacobian]
    angle = np.zeros((len(seen), 3, SIZE))
    angle[:, :, ROTATION] = -np.eye(3)
    angle[:, :, TURN] = state.rotation @ rows.turned @ state.turn.T
    angle[:, :, ANGLE] = np.stack(turned, axis=-1)
    return [jacobian, angle]


def _whitening(block: FloatArray) -> FloatArray:
    """The inverse root of the covariance of a block, by Tyler's estimator with shrinkage (Chen, Wiesel and Hero 2011).

    It heeds directions alone, so that outliers count as other rows do; the size is that of the median.
    """
    root = np.eye(3)
    for _ in range(_ROUNDS):
        direction = block / (_length(block @ root) + _LEAST)[:, None]
        shape = direction.T @ direction
        shape *= (1.0 - _EVEN) / max(float(np.trace(shape)), 1e-300)
        square, axes = np.linalg.eigh(shape + _EVEN / 3.0 * np.eye(3))
        root = axes / np.sqrt(square) @ axes.T
    return root / max(median(_length(block @ root)) / MEDIAN, _LEAST)


def _length(vectors: FloatArray) -> FloatArray:
    return np.linalg.norm(vectors, axis=1)
