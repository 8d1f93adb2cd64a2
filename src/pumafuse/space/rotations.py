"""Orientations: the conventions of logs, and the axes ``rx``, ``ry``, ``rz``.

A quaternion has the order x, y, z, w and takes a vector of the tool to the base. The axes of an orientation R are those
of the rotation vector θ = Log(R R₀ᵀ) [rad] along the base's axes, relative to a reference orientation R₀.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from ..arrays import FloatArray, IntArray

TURNING = ("rx", "ry", "rz")
Order = Literal["xyzw", "wxyz"]
# Letters of scipy: capital ones turn about the axes that turned before, small ones about axes that stay.
# A, B, C of KUKA are about Z, Y, X in this order; W, P, R of FANUC and roll, pitch, yaw about x, y, z that stay.
CONVENTIONS = {"kuka": "ZYX", "fanuc": "xyz", "rpy": "xyz"}
_NORM = 0.05  # by which a quaternion's norm is off 1 that was rounded; what is farther off is none
_ROUNDED = 1e-15  # by which the norm of a unit quaternion is off 1: it stays as it is, to the bit
_SMALL = 1e-4  # rad, below which series replace quotients: their next terms are below 1e-10


def of_quaternions(value: FloatArray, order: Order = "xyzw") -> FloatArray:
    """Unit quaternions x, y, z, w of logged ones, (n, 4); NaN in rows that have none, as of a sensor that is lost."""
    value = value[:, [1, 2, 3, 0]] if order == "wxyz" else value
    with np.errstate(invalid="ignore", over="ignore"):
        norm = np.sqrt(np.sum(value**2, axis=1))
        is_unit, off = np.abs(norm - 1.0) < _NORM, np.abs(norm - 1.0) > _ROUNDED
    return np.where(is_unit[:, None], value / np.where(is_unit & off, norm, 1.0)[:, None], np.nan)


def of_vectors(vector: FloatArray) -> FloatArray:
    """Quaternions of rotation vectors [rad], (n, 3) → (n, 4)."""
    half = 0.5 * np.sqrt(np.sum(vector**2, axis=1, keepdims=True))
    return np.column_stack([0.5 * np.sinc(half / np.pi) * vector, np.cos(half)])


def of_angles(angle: FloatArray, letters: str) -> FloatArray:
    """Quaternions of Euler angles [rad] about the axes that ``letters`` name, (n, 3) → (n, 4).

    Capital letters, as in ``ZYX``, turn about axes that turn along, small ones about axes that stay, as in scipy.
    """
    quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (len(angle), 1))
    for letter, about in zip(letters, angle.T, strict=True):
        turn = np.zeros((len(angle), 3))
        turn[:, "xyz".index(letter.lower())] = about
        step = of_vectors(turn)
        quaternion = product(quaternion, step) if letters.isupper() else product(step, quaternion)
    return quaternion


def mean(quaternion: FloatArray) -> FloatArray:
    """The mean of orientations as a rotation vector [rad], (n, 4) → (3,); those that are NaN do not count.

    The quaternion nearest to all, whatever their signs (Markley et al. 2007).
    """
    valid = quaternion[np.isfinite(quaternion).all(axis=1)]
    nearest = np.linalg.eigh(valid.T @ valid)[1][:, -1]
    return vectors(nearest[None], np.zeros(3))[0]


def vectors(quaternion: FloatArray, reference: FloatArray) -> FloatArray:
    """θ = Log(R R₀ᵀ) of quaternions of R, at most π long [rad], (n, 4) → (n, 3); R₀ is a rotation vector [rad]."""
    relative = product(quaternion, of_vectors(-reference[None]))
    relative = relative * np.where(relative[:, 3:] < 0.0, -1.0, 1.0)  # q and -q are one orientation
    sine = np.sqrt(np.sum(relative[:, :3] ** 2, axis=1, keepdims=True))
    angle = 2.0 * np.arctan2(sine, np.ascontiguousarray(relative[:, 3:]))  # else its bits depend on how many rows
    return relative[:, :3] * np.where(sine < _SMALL, 2.0 + angle**2 / 12.0, angle / np.where(sine < _SMALL, 1.0, sine))


def quaternions(vector: FloatArray, reference: FloatArray) -> FloatArray:
    """The inverse of :func:`vectors`: quaternions of Exp(θ) R₀, (n, 3) → (n, 4)."""
    return product(of_vectors(vector), of_vectors(reference[None]))


def product(left: FloatArray, right: FloatArray) -> FloatArray:
    """Quaternions of R_left R_right, row by row, (n, 4); either may be one row for all."""
    (a, w), (b, v) = ((quaternion[:, :3], quaternion[:, 3:]) for quaternion in (left, right))
    return np.concatenate([w * b + v * a + cross(a, b), w * v - np.sum(a * b, axis=1, keepdims=True)], axis=1)


def inverse(quaternion: FloatArray) -> FloatArray:
    """Quaternions of Rᵀ, (n, 4)."""
    return quaternion * np.array([-1.0, -1.0, -1.0, 1.0])


def rotate(quaternion: FloatArray, vector: FloatArray) -> FloatArray:
    """R v, row by row, (n, 4) and (n, 3) → (n, 3); either may be one row for all."""
    across = 2.0 * cross(quaternion[:, :3], vector)
    return vector + quaternion[:, 3:] * across + cross(quaternion[:, :3], across)


def cross(left: FloatArray, right: FloatArray) -> FloatArray:
    """The cross products of rows; numpy's own takes three times as long for one row, as of a stream."""
    first, two = [1, 2, 0], [2, 0, 1]
    return left.take(first, 1) * right.take(two, 1) - left.take(two, 1) * right.take(first, 1)


def slerp(quaternion: FloatArray, row: IntArray, share: FloatArray) -> FloatArray:
    """Orientations on the shortest turn from some rows (m,) of (n, 4) to the ones after them, (m, 4).

    The share says how far, 0 to 1, (m,); from the last row on there is no turn.
    """
    step = vectors(product(inverse(quaternion[:-1]), quaternion[1:]), np.zeros(3))
    step = np.vstack([step, np.zeros(3)])[row]
    part = np.where(share[:, None] > 0.0, share[:, None] * step, 0.0)
    return product(quaternion[row], of_vectors(part))


def matrix(vector: FloatArray) -> FloatArray:
    """The rotation matrix of a rotation vector [rad], (3,) → (3, 3)."""
    return rotate(of_vectors(vector[None]), np.eye(3)).T


def nearest(matrix: FloatArray) -> FloatArray:
    """The proper rotation R that maximises tr(Rᵀ M) of a matrix M (Kabsch 1976), (k, k) with k of 2 or 3."""
    left, _, right = np.linalg.svd(matrix)
    left[:, -1] *= np.linalg.det(left) * np.linalg.det(right)  # no mirror
    return np.asarray(left @ right, dtype=np.float64)


def aligning(first: FloatArray, second: FloatArray) -> tuple[FloatArray, float]:
    """The rotation that takes vectors nearest to others, (n, k) each, and the correlation of both so turned."""
    matrix = second.T @ first
    rotation = nearest(matrix)
    power = math.sqrt(float(np.sum(first**2)) * float(np.sum(second**2)))
    return rotation, float(np.sum(rotation * matrix)) / power if power > 0.0 else 0.0


def cross_matrix(vectors: FloatArray) -> FloatArray:
    """The matrices that take w to v × w, (n, 3) → (n, 3, 3)."""
    return np.cross(vectors[:, None, :], np.eye(3)).swapaxes(1, 2)


def left_jacobian(vector: FloatArray) -> FloatArray:
    """J of Exp(θ + δ) ≈ Exp(J δ) Exp(θ), (n, 3) → (n, 3, 3): how small changes of θ turn the tool.

    Across θ it is sin(θ/2)/(θ/2) long, along θ 1 (Solà, Deray and Atchuthan 2018, eq. 145).
    """
    angle = np.sqrt(np.sum(vector**2, axis=1))
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    of_cosine = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)[:, None, None]
    two = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)[:, None, None]
    cross = cross_matrix(vector)
    return np.eye(3) + of_cosine * cross + two * (cross @ cross)


def spread(vector: FloatArray) -> FloatArray:
    """How much larger the noise of θ is than that of the orientation, (n,): 1 near R₀.

    The same along all axes: a third of the trace of J⁻¹ J⁻ᵀ, of which J is 1 long along θ and sin(θ/2)/(θ/2) across it.
    """
    x, y, z = np.square(np.where(np.isfinite(vector), vector, 0.0)).T
    return np.sqrt((1.0 + 2.0 / np.sinc(np.sqrt(x + y + z) / (2.0 * np.pi)) ** 2) / 3.0)


def angle_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """The angle between orientations, row by row [rad], (n,)."""
    between = product(first, inverse(second))
    return 2.0 * np.arctan2(np.sqrt(np.sum(between[:, :3] ** 2, axis=1)), np.abs(between[:, 3]))
