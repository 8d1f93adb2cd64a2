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

Told = tuple[float, ...]  # the joints of a chain, in their order [rad or m]


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
        self._told_at, self._told = list[int](), list[Told]()

    def parse(self, values: Mapping[str, Any]) -> Told | None:
        """Where an event tells the joints to be; None if it tells of none."""
        if self.kinds.keys().isdisjoint(values):
            return None
        told = tuple(number(values.get(joint)) for joint in self.kinds)
        lacking = [joint for joint, value in zip(self.kinds, told, strict=True) if not math.isfinite(value)]
        if lacking:
            raise ValueError(f"a pose needs all joints of the [robot]; it has no {', '.join(lacking)}")
        if far := next((joint for joint, value in zip(self.kinds, told, strict=True) if abs(value) > MOST), None):
            raise ValueError(f"joint {far} is told to be where no robot can be")
        if twice := next((name for name in (*CARTESIAN, *TURNING, ORIENTATION) if name in values), None):
            raise ValueError(f"gives joints and {twice}, which their pose has; give one")
        return told

    def to_pose(self, values: Mapping[str, Any], told: Told) -> dict[str, Any]:
        """The values of an event with the pose of the tool in the place of joints."""
        return {name: value for name, value in values.items() if name not in self.kinds} | self._pose(told)

    def _pose_of(self, told: Told) -> dict[str, Any]:
        position, orientation = self._chain.pose(np.array([told]))
        pose: dict[str, Any] = dict(zip(CARTESIAN, position[0].tolist(), strict=True))
        return pose | {ORIENTATION: tuple(orientation[0].tolist())} if self._turns else pose

    def command(self, stamp: int, told: Told, oldest: int) -> dict[int, Told]:
        """Add a command; by stamps where it tells each joint to be, and where those tell it that it changes.

        A joint that answers later is told later, on the line from command to command, as
        :meth:`pumafuse.logs.run.Source.delayed` has it.
        """
        at = bisect_left(self._told_at, stamp)
        again = at < len(self._told_at) and self._told_at[at] == stamp
        self._told_at[at : at + again], self._told[at : at + again] = [stamp], [told]
        until = self._told_at[at + 1] + self._latest if at + 1 < len(self._told_at) else stamp
        end = max(bisect_left(self._told_at, until), at + 1) if self._late else at + 1
        command = {self._told_at[row]: self._delay(row) for row in range(at, end)}
        while len(self._told_at) > 1 and self._told_at[1] <= oldest - self._latest:  # one is on the line to the next
            del self._told_at[0], self._told[0]
        return command

    def _delay(self, row: int) -> Told:
        """Where a command tells the joints to be, those that are later by what was told before."""
        told = list(self._told[row])
        for joint, by in self._late.items():
            at = self._told_at[row] - by
            before = max(bisect_right(self._told_at, at) - 1, 0)
            after = min(before + 1, len(self._told_at) - 1)
            share = max(at - self._told_at[before], 0) / max(self._told_at[after] - self._told_at[before], 1)
            value = self._told[before][joint]
            told[joint] = value + share * (self._told[after][joint] - value)
        return tuple(told)

    def forget(self, after: int) -> None:
        """Take back the commands stamped after an instant [ns]; what came before does not depend on them."""
        row = bisect_right(self._told_at, after)
        del self._told_at[row:], self._told[row:]
