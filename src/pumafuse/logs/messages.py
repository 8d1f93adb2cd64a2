"""Messages that are no row each: transforms of many frames, and trajectories of many points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ..arrays import FloatArray
from . import bags
from .bags import Faults, Message, Record
from .columns import SPLIT_STAMPS

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

PATH = "path"  # the column of where a trajectory is at each time
PATH_TIME = f"{PATH}.time_ns"
TRANSFORMS = "transforms"  # the only field of ROS's tf messages
_STEP = 4_000_000  # ns, of a path; controllers of joints go on in steps of 1 to 10 ms
_MOST_ROWS = 30_000_000  # of the path of one trajectory: 33 hours
_AROUND = ("request", "goal", "trajectory", "joint_trajectory")  # what goals of actions have a trajectory in


def each_transform(messages: Iterable[tuple[Record, Message]]) -> Iterator[tuple[Record, Message]]:
    """A row for each transform of tf messages."""
    for record, message in messages:
        for transform in message[TRANSFORMS]:
            yield record, bags.fields_of(transform) or {}


def trajectory_in(message: Any) -> Mapping[str, Any] | None:
    """The ``JointTrajectory`` that a message is, or the goal of an action has in it; None without one."""
    if isinstance(message, list):
        message = next(iter(cast(list[Any], message)), None)
    if not isinstance(message, Mapping):
        return None
    fields = cast(Mapping[str, Any], message)
    if {"joint_names", "points"} <= fields.keys():
        return fields
    inside = (trajectory_in(fields[name]) for name in _AROUND if name in fields)
    return next((one for one in inside if one is not None), None)


def each_place(messages: Iterable[tuple[Record, Message]], faults: Faults) -> Iterator[tuple[Record, Message]]:
    """A row for each 4 ms of the paths that trajectories command: ``path.time_ns``, ``.name``, ``.position``.

    A path is a cubic where its points have velocities, else straight between them. A new trajectory ends the one before
    and begins where that was. One without points ends it, too.
    """
    known = [(record, trajectory_in(bags.plain(message))) for record, message in messages]
    known = [(record, one) for record, one in known if one is not None]
    known.sort(key=lambda pair: _begin(*pair))
    before: _Path | None = None
    for place, (record, trajectory) in enumerate(known):
        end = _begin(*known[place + 1]) if place + 1 < len(known) else None
        try:
            path = _Path(record, trajectory, before)
        except bags.DAMAGE as error:
            faults.leave_out("trajectory", error)
            continue
        for time, position in path.rows(end):
            yield record, {PATH: {"time_ns": time, "name": path.joints, "position": position}}
        before = path


class _Path:
    """The path of one trajectory.

    Attributes:
        joints: Their names.
    """

    def __init__(self, record: Record, trajectory: Mapping[str, Any], before: _Path | None) -> None:
        points, begin = cast(list[Mapping[str, Any]], trajectory["points"]), _begin(record, trajectory)
        self.joints: list[str] = list(map(str, trajectory["joint_names"]))
        if before is not None and not points:
            self.joints = before.joints
        time = [begin + _nanoseconds(point["time_from_start"]) for point in points]
        position = [_numbers(point, "positions", self.joints) for point in points]
        velocity = [_numbers(point, "velocities", self.joints) for point in points if len(point["velocities"])]
        curved = len(velocity) == len(time)
        if before is not None and before.joints == self.joints and not (time and time[0] <= begin):
            time, position = [begin, *time], [before.at(begin), *position]
            velocity = [before.at(begin, 1), *velocity]
        if not time or not (np.diff(time) > 0).all():
            raise ValueError("the time_from_start of its points does not rise")
        if time[-1] - time[0] > _MOST_ROWS * _STEP:
            raise ValueError("it takes more than a day")
        self._time, self._last = (time[0], time[-1]), position[-1]
        seconds = (np.array(time) - time[0]) / 1e9
        self._curve = _curve(seconds, np.array(position), np.array(velocity) if curved else None)

    def at(self, time: int, order: int = 0) -> FloatArray:
        """Where it is at a time [ns], (joints,), or with order 1 its velocity [1/s]; behind its end it rests."""
        first, last = self._time
        if time >= last:
            return self._last if order == 0 else np.zeros_like(self._last)
        return self._curve(max(time - first, 0) / 1e9, order)

    def rows(self, end: int | None) -> Iterator[tuple[int, FloatArray]]:
        """Times [ns] and positions up to the last point, or to where the next trajectory begins."""
        first, last = self._time
        times = [one for one in (*range(first, last, _STEP), last) if end is None or one < end]
        return ((one, self.at(one)) for one in times)


def _curve(time: FloatArray, position: FloatArray, velocity: FloatArray | None) -> PPoly:
    """A path through points at some times [s]: a cubic where they have velocities, else straight."""
    from scipy.interpolate import CubicHermiteSpline, PPoly

    if len(time) == 1:
        time, position, velocity = np.append(time, time + 1.0), np.repeat(position, 2, axis=0), None
    if velocity is not None:
        return CubicHermiteSpline(time, position, velocity)
    return PPoly(np.stack([np.diff(position, axis=0) / np.diff(time)[:, None], position[:-1]]), time)


def _begin(record: Record, trajectory: Mapping[str, Any]) -> int:
    """When a trajectory begins [ns]: as its header says, or, where that is 0, when it was recorded."""
    stamp = cast(Mapping[str, Any], trajectory.get("header") or {}).get("stamp")
    return (_nanoseconds(stamp) if stamp else 0) or record.time


def _nanoseconds(time: Mapping[str, int]) -> int:
    """A time, or a duration, of a message."""
    seconds, rest = next(pair for pair in SPLIT_STAMPS if pair[0] in time and pair[1] in time)
    return int(time[seconds]) * 10**9 + int(time[rest])


def _numbers(point: Mapping[str, Any], key: str, joints: Sequence[str]) -> FloatArray:
    """What a point has for each joint, (joints,)."""
    found = np.array(point[key], dtype=np.float64)
    if found.shape != (len(joints),) or not np.isfinite(found).all():
        raise ValueError(f"a point has no {key} for each of its {len(joints)} joints")
    return found
