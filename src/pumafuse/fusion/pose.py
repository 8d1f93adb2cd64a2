"""The tool in space: its pose and the covariance of that, from the axes x, y, z and rx, ry, rz."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from ..logs.frames import CARTESIAN, Placed
from ..model.arm import CANONICAL_AXES
from ..space import rotations
from ..space.rotations import TURNING
from .config import FusionConfig


@dataclass(frozen=True, repr=False)
class Pose:
    """Where the tool is and how it is turned, in the frame of the log.

    Attributes:
        position: x, y, z [m], (n, 3).
        quaternion: x, y, z, w of the rotation that takes a vector of the tool to the base, (n, 4).
        covariance: Of the errors of x, y, z [m] and of a small rotation about the base's axes [rad] that turns the
            estimated orientation into the true one, (n, 6, 6). The filter has no covariance between its axes.
    """

    position: FloatArray
    quaternion: FloatArray
    covariance: FloatArray

    def __repr__(self) -> str:
        return f"Pose({len(self.position):,} of position, quaternion and covariance)"


def orientation(position: Mapping[str, FloatArray], config: FusionConfig) -> FloatArray | None:
    """Quaternions x, y, z, w of the axes rx, ry, rz, (n, 4); None where they are not all there."""
    if config.tool is None or not set(TURNING) <= position.keys():
        return None
    return rotations.quaternions(_columns(position), np.array(config.tool.reference))


def relative_to(quaternion: FloatArray, config: FusionConfig) -> dict[str, FloatArray]:
    """The axes rx, ry, rz [rad] of quaternions, (n, 4) → (n,); none where the configuration has no orientation."""
    if config.tool is None:
        return {}
    vector = rotations.vectors(quaternion, np.array(config.tool.reference))
    return dict(zip(TURNING, vector.T.copy(), strict=True))


def turning_covariance(position: Mapping[str, FloatArray], sd: Mapping[str, FloatArray]) -> FloatArray:
    """J P Jᵀ [rad²], (n, 3, 3), of P = diag(sd²) of the rotation vector θ, and J of Exp(θ + δ) ≈ Exp(J δ) Exp(θ).

    Across θ, standard deviations are those of the axes times sin(θ/2)/(θ/2).
    """
    scaled = rotations.left_jacobian(_columns(position)) * _columns(sd)[:, None]
    return scaled @ scaled.transpose(0, 2, 1)


def covariance_in_log(
    placed: Placed | None, position: Mapping[str, FloatArray], sd: Mapping[str, FloatArray]
) -> FloatArray:
    """The covariance of the log's x, y and z [m²], (n, 3, 3)."""
    axes = CARTESIAN if placed is None else CANONICAL_AXES
    scaled = np.eye(3) * np.column_stack([sd[axis] for axis in axes])[:, None]
    if placed is not None:
        scaled[:, :2, :2] = placed.jacobian(position["tangential"], position["radial"]) @ scaled[:, :2, :2]
    return scaled @ scaled.transpose(0, 2, 1)


def _columns(by_axis: Mapping[str, FloatArray]) -> FloatArray:
    return np.column_stack([by_axis[axis] for axis in TURNING])
