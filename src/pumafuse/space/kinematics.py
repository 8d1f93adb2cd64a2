"""Forward kinematics of one serial chain of a URDF: the pose of its tip, of its links, and the Jacobian.

The frame of a joint is that of its parent link, placed by ``origin`` and moved by the joint about or along ``axis``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..arrays import FloatArray
from ..errors import ConfigError, UnknownNameError
from ..units import Kind
from .rotations import cross, of_angles, product, rotate
from .urdf import MOST, Joint, read

_STRAIGHT = np.array([0.0, 0.0, 0.0, 1.0])  # the quaternion of no turn


@dataclass(frozen=True)
class _Motion:
    """A joint whose origin is turned by ``turn``, a quaternion, and which is at ``multiplier · q[column] + offset``."""

    joint: Joint
    turn: FloatArray
    column: int
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Chain:
    """A serial chain of links and joints, from a base to a tip."""

    links: tuple[str, ...]  # the links, from the base to the tip
    # what each joint moves by that must be known, in the order of the chain. A joint that mimics another is not among
    # them; the one that it mimics is, also where it is outside of the chain
    kinds: dict[str, Kind]
    _motions: tuple[_Motion, ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints that must be known."""
        return tuple(self.kinds)

    def columns(self, later: Mapping[str, float], where: str) -> dict[int, int]:
        """Which joints are later, by their places among ``joints``, and by how much [ns].

        Args:
            later: By name [s].
            where: The file, for errors.

        Raises:
            UnknownNameError: There is no joint of such a name.
        """
        if unknown := next((name for name in later if name not in self.kinds), None):
            raise UnknownNameError(f"{where}: joints of the arm", "joint", unknown, self.joints)
        by = {self.joints.index(name): round(delay * 1e9) for name, delay in later.items()}
        return {column: delay for column, delay in by.items() if delay}

    @classmethod
    def load(cls, path: str | Path, base: str, tip: str) -> Chain:
        """The chain that leads from one link of a URDF file to another.

        Raises:
            UnknownNameError: There is no such link, or a joint mimics one that does not exist.
            ConfigError: The file is no URDF, no joints lead from the base to the tip, or one of them is of a type that
                no chain has.
        """
        urdf = read(Path(path))
        kinds: dict[str, Kind] = {}
        motions = list[_Motion]()
        for name in urdf.route(base, tip):
            joint, column, multiplier, offset = urdf.joints[name], 0, 0.0, 0.0
            if joint.kind is not None:
                driver, multiplier, offset = urdf.driver(name)
                if (kind := urdf.joints[driver].kind) is None:
                    raise ConfigError(f"{joint.where} mimics '{driver}', which is fixed")
                if not joint.axis.any():
                    raise ConfigError(f"{joint.where}: axis 0 0 0 is no direction")
                kinds.setdefault(driver, kind)
                column = list(kinds).index(driver)
            motions.append(_Motion(joint, of_angles(np.array([joint.rpy]), "xyz"), column, multiplier, offset))
        return cls((base, *(motion.joint.child for motion in motions)), kinds, tuple(motions))

    def pose(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The tip in the frame of the base.

        Args:
            q: The joints in the order of ``joints`` [rad or m], (n, J).

        Returns:
            Position (n, 3) [m], and quaternion x, y, z, w (n, 4), whose sign is continuous along a motion. NaN in rows
            where a joint is not finite.
        """
        return deque(self._frames(q), maxlen=1).pop()

    def jacobian(self, q: FloatArray) -> FloatArray:
        """How the tip moves with each joint, along the axes of the base.

        Args:
            q: As for :meth:`pose`.

        Returns:
            (n, 6, J), of 1 rad/s or 1 m/s of a joint: the velocity of the tip's origin [m/s] in rows 0 to 2, the
            angular velocity [rad/s] in rows 3 to 5. NaN in rows where a joint is not finite.
        """
        frames = list(self._frames(q))
        tip, _ = frames[-1]
        jacobian = np.zeros((6, len(self.kinds))) + 0.0 * tip[:, :1, None]  # what is NaN stays it
        for motion, (position, turn) in zip(self._motions, frames[1:], strict=True):
            if motion.joint.kind is None:
                continue
            velocity = motion.multiplier * rotate(turn, motion.joint.axis)
            if motion.joint.kind == "angle":
                jacobian[:, 3:, motion.column] += velocity
                velocity = cross(velocity, tip - position)
            jacobian[:, :3, motion.column] += velocity
        return jacobian

    def frames(self, q: FloatArray) -> FloatArray:
        """Each of ``links`` in the frame of the base.

        Args:
            q: As for :meth:`pose`.

        Returns:
            (n, L, 4, 4): orientation and position [m]. NaN in rows where a joint is not finite.
        """
        frames = np.zeros((len(q), len(self.links), 4, 4))
        frames[..., 3, 3] = 1.0
        for link, (position, turn) in enumerate(self._frames(q)):
            frames[:, link, :3, 3] = position
            for column, unit in enumerate(np.eye(3)):
                frames[:, link, :3, column] = rotate(turn, unit[None])
        return frames

    def _frames(self, q: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Position (n, 3) [m] and orientation (n, 4) of each link in the frame of the base."""
        if q.ndim != 2 or q.shape[1] != len(self.kinds):
            raise ConfigError(f"joints: shape {q.shape}; expected (n, {len(self.kinds)}): {', '.join(self.kinds)}")
        finite = (np.abs(q) <= MOST).all(axis=1, keepdims=True)
        q = np.where(finite, q, np.nan)
        position = np.where(finite, np.zeros(3), np.nan)
        turn = np.where(finite, _STRAIGHT, np.nan)
        yield position, turn
        for motion in self._motions:
            position = position + rotate(turn, motion.joint.at)
            turn = product(turn, motion.turn)
            if motion.joint.kind is not None:
                value = motion.multiplier * q[:, motion.column, None] + motion.offset
                if motion.joint.kind == "angle":
                    turn = product(turn, _about(motion.joint.axis, value))
                else:
                    position = position + value * rotate(turn, motion.joint.axis)
            yield position, turn


class Joints(NamedTuple):
    """Where the joints of a chain are.

    Attributes:
        chain: What they move.
        values: In the order of its joints [rad or m], (n, J).
    """

    chain: Chain
    values: FloatArray


def _about(axis: FloatArray, angle: FloatArray) -> FloatArray:
    """The quaternions (n, 4) of turns by angles (n, 1) [rad] about an axis (1, 3)."""
    return np.concatenate([np.sin(angle / 2.0) * axis, np.cos(angle / 2.0)], axis=1)
