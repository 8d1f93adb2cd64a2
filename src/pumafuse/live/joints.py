"""Commands and encoders in joints, in a stream: the poses to which they move the tool."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from ..errors import ConfigError
from ..fusion.config import FusionConfig
from ..logs.frames import CARTESIAN
from ..logs.manifest import chain_of
from ..space.rotations import TURNING
from ..space.urdf import MOST
from ..units import Kind
from .commands import number
from .tool import NO_TOOL, ORIENTATION, takes_orientation

JointValues = tuple[float, ...]  # the joints of a chain, in their order [rad or m]


class Joints:
    """What joints tell of the tool, and the commands in joints by all that have come, in whatever order."""

    def __init__(self, config: FusionConfig) -> None:
        assert config.robot is not None
        self._chain = chain_of(config.robot)
        self.kinds: Mapping[str, Kind] = self._chain.kinds
        axes = config.arm.axes
        if config.frame is None and not set(CARTESIAN) <= axes.keys():
            raise ConfigError(f"[robot]: its joints tell x, y and z, which the arm '{config.arm.name}' has not")
        if set(TURNING) <= axes.keys() and config.tool is None:
            raise ConfigError(f"[robot]: {NO_TOOL}")
        if twice := next((joint for joint in self.kinds if joint in {*axes, *CARTESIAN, ORIENTATION}), None):
            raise ConfigError(f"[robot]: its joint '{twice}' is called as an axis is: rename it in the URDF")
        self._late = self._chain.columns(config.arm.later, "[robot]")  # ns, by the place of a joint
        self._latest = max(self._late.values(), default=0)
        self._turns = takes_orientation(config)
        self._pose = lru_cache(maxsize=64)(self._pose_of)  # a command's is asked for twice where no joint is later
        self.restart()

    def restart(self) -> None:
        """Begin anew by another clock."""
        self._stamps, self._commanded = list[int](), list[JointValues]()

    def parse(self, values: Mapping[str, Any]) -> JointValues | None:
        """Where an event tells the joints to be; None if it tells of none."""
        if self.kinds.keys().isdisjoint(values):
            return None
        joints = tuple(number(values.get(joint)) for joint in self.kinds)
        lacking = [joint for joint, value in zip(self.kinds, joints, strict=True) if not math.isfinite(value)]
        if lacking:
            raise ValueError(f"a pose needs all joints of the [robot]; it has no {', '.join(lacking)}")
        if far := next((joint for joint, value in zip(self.kinds, joints, strict=True) if abs(value) > MOST), None):
            raise ValueError(f"joint {far} is where no robot can be")
        if twice := next((name for name in (*CARTESIAN, *TURNING, ORIENTATION) if name in values), None):
            raise ValueError(f"gives joints and {twice}, which their pose has; give one")
        return joints

    def to_pose(self, values: Mapping[str, Any], joints: JointValues) -> dict[str, Any]:
        """The values of an event with the pose of the tool in the place of joints."""
        return {name: value for name, value in values.items() if name not in self.kinds} | self._pose(joints)

    def _pose_of(self, joints: JointValues) -> dict[str, Any]:
        position, orientation = self._chain.pose(np.array([joints]))
        pose: dict[str, Any] = dict(zip(CARTESIAN, position[0].tolist(), strict=True))
        return pose | {ORIENTATION: tuple(orientation[0].tolist())} if self._turns else pose

    def command(self, stamp: int, joints: JointValues, oldest: int) -> dict[int, JointValues]:
        """Add a command; by stamps where it tells each joint to be, and where those tell it that it changes.

        A joint that answers later is commanded later, on the line from command to command, as
        :meth:`pumafuse.logs.source.Source.delayed` has it.
        """
        at = bisect_left(self._stamps, stamp)
        again = at < len(self._stamps) and self._stamps[at] == stamp
        self._stamps[at : at + again], self._commanded[at : at + again] = [stamp], [joints]
        until = self._stamps[at + 1] + self._latest if at + 1 < len(self._stamps) else stamp
        end = max(bisect_left(self._stamps, until), at + 1) if self._late else at + 1
        command = {self._stamps[row]: self._delay(row) for row in range(at, end)}
        while len(self._stamps) > 1 and self._stamps[1] <= oldest - self._latest:  # one is on the line to the next
            del self._stamps[0], self._commanded[0]
        return command

    def _delay(self, row: int) -> JointValues:
        """Where a command tells the joints to be, those that are later by what was commanded before."""
        joints = list(self._commanded[row])
        for joint, by in self._late.items():
            at = self._stamps[row] - by
            before = max(bisect_right(self._stamps, at) - 1, 0)
            after = min(before + 1, len(self._stamps) - 1)
            share = max(at - self._stamps[before], 0) / max(self._stamps[after] - self._stamps[before], 1)
            value = self._commanded[before][joint]
            joints[joint] = value + share * (self._commanded[after][joint] - value)
        return tuple(joints)

    def forget(self, after: int) -> None:
        """Take back the commands stamped after an instant [ns]; what came before does not depend on them."""
        row = bisect_right(self._stamps, after)
        del self._stamps[row:], self._commanded[row:]
