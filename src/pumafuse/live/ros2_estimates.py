"""Estimates as topics of ROS 2: ``/pumafuse/pose``, ``/pumafuse/joints`` and ``/pumafuse/diagnostics``."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ..filter.outcome import Outcome
from ..fusion.pose import covariance_in_log, turning_covariance
from ..logs.frames import CARTESIAN
from ..model.arm import CANONICAL_AXES
from ..space.rotations import TURNING
from ..units import MS
from .estimator import LiveEstimator
from .health import Health, SensorHealth
from .results import LiveEstimate, UpdateResult
from .ros2 import FRAME_ID, Ros2Source, load
from .wire import Event

_EVERY = 1.0  # s between two diagnostics
_UNKNOWN = 1e6  # rad², of an orientation that nobody tells
_DEPTH = 10  # estimates that are kept for a slow receiver


class Ros2Estimates:
    """A watcher of a stream that publishes its estimates."""

    def __init__(self, source: Ros2Source, live: LiveEstimator) -> None:
        self._source, self._live, node = source, live, source.node
        poses, joints = load("geometry_msgs.msg"), load("sensor_msgs.msg")
        self._diagnostic, axes = load("diagnostic_msgs.msg"), live.axes
        in_space = CARTESIAN if live.config.frame is None else CANONICAL_AXES
        self._joints = [axis for axis in axes if axis not in (*in_space, *TURNING)]
        self._pose: Any = None
        self._state: Any = None
        if set(in_space) <= set(axes):
            self._pose = poses.PoseWithCovarianceStamped()
            self._publish_pose = node.create_publisher(type(self._pose), "~/pose", _DEPTH).publish
        if self._joints:
            self._state = joints.JointState()
            self._publish_joints = node.create_publisher(type(self._state), "~/joints", _DEPTH).publish
        array = self._diagnostic.DiagnosticArray
        self._publish_diagnostics = node.create_publisher(array, "~/diagnostics", _DEPTH).publish
        self._told = 0.0

    def event(self, event: Event, result: UpdateResult) -> None:
        """Nothing is published of what came."""

    def estimate(self, estimate: LiveEstimate) -> None:
        """Publish an estimate."""
        if self._pose is not None and self._set_pose(estimate):
            self._set_header(self._pose.header, estimate.stamp)
            self._publish_pose(self._pose)
        if self._state is not None:
            there = [name for name in self._joints if name in estimate.axes]
            self._state.name = there
            self._state.position = [estimate.axes[name].position for name in there]
            self._state.velocity = [estimate.axes[name].velocity for name in there]
            self._set_header(self._state.header, estimate.stamp)
            self._publish_joints(self._state)

    def tick(self, health: Callable[[], Health]) -> None:
        """Publish diagnostics once a second."""
        now = time.monotonic()
        if now - self._told >= _EVERY:
            self._told = now
            array = self._diagnostic.DiagnosticArray(status=list(self._statuses(health())))
            self._set_header(array.header, self._source.clock())
            self._publish_diagnostics(array)

    def _set_header(self, header: Any, stamp: int) -> None:
        """Set the stamp [ns], and the frame: that of the parameter, or of the commands."""
        header.stamp.sec, header.stamp.nanosec = divmod(stamp, 10**9)
        header.frame_id = self._source.node.get_parameter(FRAME_ID).value or self._source.frame

    def _set_pose(self, estimate: LiveEstimate) -> bool:
        """Set the pose and its covariance; whether the estimate has one."""
        position = {name: axis.position for name, axis in estimate.axes.items()}
        there = position if estimate.cartesian is None else estimate.cartesian
        if not set(CARTESIAN) <= there.keys():
            return False
        pose = self._pose.pose.pose
        pose.position.x, pose.position.y, pose.position.z = (there[axis] for axis in CARTESIAN)
        rows = {name: np.array([value]) for name, value in position.items()}
        sd = {name: np.array([axis.position_sd]) for name, axis in estimate.axes.items()}
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = covariance_in_log(self._live.placed, rows, sd)[0]
        if estimate.orientation is not None:
            turned = pose.orientation
            turned.x, turned.y, turned.z, turned.w = estimate.orientation
            covariance[3:, 3:] = turning_covariance(rows, sd)[0]
        else:
            covariance[3:, 3:] = _UNKNOWN * np.eye(3)
        self._pose.pose.covariance = covariance.ravel()
        return True

    def _statuses(self, health: Health) -> list[Any]:
        """The status of the estimates, and of each sensor."""
        kind, estimate = self._diagnostic.DiagnosticStatus, self._live.estimate()
        stale, doubtful = ", ".join(estimate.stale), ", ".join(estimate.doubtful)
        fused = estimate.outcome is Outcome.FUSED
        level = kind.WARN if doubtful or health.faults else kind.STALE if stale or not fused else kind.OK
        words = [] if fused else [estimate.reason]
        words += [f"doubtful: {doubtful}"] if doubtful else []
        words += [f"stale: {stale}"] if stale else []
        whole = self._status(
            "estimates",
            level,
            "; ".join([*words, *health.faults]) or "as expected",
            {
                "stale": stale,
                "doubtful": doubtful,
                **{f"commands {word}": str(count) for word, count in health.commands.items() if count},
                "segments": str(health.segments),
            },
        )
        return [whole, *(self._of_sensor(name, one, health) for name, one in health.sensors.items())]

    def _of_sensor(self, name: str, sensor: SensorHealth, health: Health) -> Any:
        kind = self._diagnostic.DiagnosticStatus
        faults = [fault for fault in health.faults if f"'{name}'" in fault]
        level = kind.STALE if sensor.stale else kind.WARN if faults else kind.OK
        silent = "no row yet" if sensor.silent is None else f"silent for {sensor.silent:.1f} s"
        values = {
            "rows": str(sensor.rows),
            "rate [Hz]": f"{sensor.rate:.1f}",
            "late [ms]": f"{sensor.lateness * MS:.1f}",
            "dropouts": str(sensor.dropouts),
            "NIS": "" if sensor.nis is None else f"{sensor.nis:.2f}",
            **{word: str(count) for word, count in sensor.outcomes.items() if count or word == Outcome.REJECTED.word},
        }
        return self._status(name, level, "; ".join(faults) or (silent if sensor.stale else "fused"), values)

    def _status(self, name: str, level: bytes, message: str, values: dict[str, str]) -> Any:
        pairs = [self._diagnostic.KeyValue(key=key, value=value) for key, value in values.items()]
        arm = self._live.config.arm.name
        named = f"{self._source.node.get_name()}: {name}"
        return self._diagnostic.DiagnosticStatus(
            level=level, name=named, message=message, hardware_id=arm, values=pairs
        )
