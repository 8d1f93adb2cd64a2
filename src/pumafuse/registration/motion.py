"""What the tool was commanded and what a sensor saw of it, and where the tool is by its commands.

The arm answers by a dead time and a first-order plant, one for positions, one for orientations, between commands that
are held: exact at any instant. An orientation R is Exp(θ) R₀, and each component of θ goes through the plant.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import BoolArray, FloatArray, IntArray, TimeArray
from ..filter.response import response
from ..logs.frames import CARTESIAN
from ..logs.screening import lost
from ..logs.source import Source
from ..model.arm import AxisModel
from ..model.plants import FirstOrder
from ..units import seconds

_NS = 1e9  # in a second
_FARTHEST = 1e6  # m: what is farther is a sentinel, no position
_PERIOD = 1.0  # s: the response does not depend on the update period
_STEP = 1e-5  # s, by which dead times and time constants are varied for slopes


class Motion(NamedTuple):
    """What one source tells of the tool in one run."""

    time: FloatArray  # when [s], ascending, (n,)
    position: FloatArray  # where [m], (n, 3); a row with NaN tells nothing
    quaternion: FloatArray | None = None  # how it is turned, as x, y, z, w, (n, 4); None where the source does not tell

    def valid(self) -> Motion:
        """The rows in which all is known, in the order of time, the first of each instant."""
        good = np.isfinite(self.time) & np.isfinite(self.position).all(axis=1)
        if self.quaternion is not None:
            good &= np.isfinite(self.quaternion).all(axis=1) & (np.abs(self.quaternion) > 0.0).any(axis=1)
        rows = np.flatnonzero(good)
        return self.only(rows[np.unique(self.time[rows], return_index=True)[1]])

    def only(self, rows: BoolArray | IntArray) -> Motion:
        """Some rows."""
        turned = None if self.quaternion is None else self.quaternion[rows]
        return Motion(self.time[rows], self.position[rows], turned)


def motion_of(source: Source) -> Motion:
    """What a source with x, y and z tells."""
    position = np.column_stack([source.values[axis] for axis in CARTESIAN])
    return Motion(seconds(source.stamp), position, source.orientation)


def drop_repeated(source: Source) -> Motion:
    """What a sensor tells, without what is no news: values that it repeats, and zeros, as it writes them when lost."""
    motion = motion_of(source)
    far = ~(np.abs(motion.position) < _FARTHEST).all(axis=1)
    again = (np.diff(motion.position, axis=0, prepend=np.nan) == 0.0).all(axis=1)
    return motion._replace(position=np.where((far | again | lost(motion.position))[:, None], np.nan, motion.position))


class Plant(NamedTuple):
    """How the arm answers."""

    delay: float  # dead time [s], the sensor's latency with it
    time_constant: float  # τ of a first-order plant [s]

    def change(self, delay: float, share: float) -> Plant:
        """With a dead time that is longer [s], and a time constant that is longer by a small share."""
        return Plant(self.delay + delay, self.time_constant * float(np.exp(share)))

    @property
    def lag(self) -> float:
        """At constant velocity [s]."""
        return self.delay + self.time_constant


class Poses(NamedTuple):
    """Where the tool is: position [m], (n, 3), and rotation matrix tool to base, (n, 3, 3)."""

    position: FloatArray
    rotation: FloatArray


class Answer:
    """Where the tool is by the commands of several runs whenever a sensor measures: all rows after one another."""

    def __init__(self, command: Sequence[Motion], time: Sequence[FloatArray]) -> None:
        self.turns = all(motion.quaternion is not None for motion in command)  # whether the orientation is commanded
        self._time = time
        self._start = [float(motion.time[0]) for motion in command]
        self._stamps: list[TimeArray] = [
            np.round((motion.time - motion.time[0]) * _NS).astype(np.int64) for motion in command
        ]
        self._position = [motion.position for motion in command]
        rotations = [Rotation.from_quat(motion.quaternion) for motion in command if motion.quaternion is not None]
        if self.turns:
            self._reference = Rotation.concatenate(rotations).mean()
            self._angle = [(rotation * self._reference.inv()).as_rotvec() for rotation in rotations]

    def poses(self, position: Plant, rotation: Plant) -> Poses:
        """The poses under the plants of both."""
        where = self._through(self._position, position)
        if not self.turns:
            return Poses(where, np.broadcast_to(np.eye(3), (len(where), 3, 3)))
        return Poses(where, self._rotate(rotation).as_matrix() @ self._reference.as_matrix())

    def quaternions(self, rotation: Plant) -> FloatArray:
        """The orientations under a plant, as x, y, z, w, (n, 4); only where they are commanded."""
        return (self._rotate(rotation) * self._reference).as_quat()

    def _rotate(self, rotation: Plant) -> Rotation:
        """The rotations from the mean of the orientations, under a plant."""
        return Rotation.from_rotvec(self._through(self._angle, rotation))

    def slopes(self, position: Plant, rotation: Plant, here: Poses) -> tuple[list[FloatArray], list[FloatArray]]:
        """How position and orientation [rad along the base's axes] change with dead time [s] and log τ, (n, 3) each."""
        moved, turned = list[FloatArray](), list[FloatArray]()
        for delay, share in ((_STEP, 0.0), (0.0, _STEP)):
            poses = self.poses(position.change(delay, share), rotation.change(delay, share))
            moved.append((poses.position - here.position) / _STEP)
            turn = poses.rotation @ here.rotation.swapaxes(1, 2)
            turned.append(0.5 / _STEP * np.stack([turn[:, i - 1, i - 2] - turn[:, i - 2, i - 1] for i in range(3)], -1))
        return moved, turned

    def _through(self, levels: Sequence[FloatArray], plant: Plant) -> FloatArray:
        """Three axes of all runs through a plant, (n, 3)."""
        axis, responses = AxisModel(plant=FirstOrder(time_constant=plant.time_constant)), list[FloatArray]()
        for start, stamps, level, time in zip(self._start, self._stamps, levels, self._time, strict=True):
            at = np.round((time - plant.delay - start) * _NS).astype(np.int64)
            answers = [
                first + response(axis, _PERIOD, 0.0, stamps, column, first, at)
                for first, column in zip(level[0].tolist(), level.T, strict=True)
            ]
            responses.append(np.stack(answers, axis=-1))
        return np.concatenate(responses)
