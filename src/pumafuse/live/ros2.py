"""A node of ROS 2: a source of events from the topics that a ``run.toml`` names, and estimates as topics.

Types of messages are those that publishers have, so a topic is subscribed to once somebody publishes it. Subscriptions
take what reliable publishers send and what sensors do (best effort). What comes in a burst waits in a :mod:`.backlog`,
in the order of its receipt. Estimates go out as ``~/pose``, ``~/joints`` and ``~/diagnostics``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from ..errors import ConfigError, PumafuseError, reason, suggestion
from ..filter.outcome import Outcome
from ..fusion.pose import covariance_in_log, turning_covariance
from ..logs.bags import DAMAGE
from ..logs.frames import CARTESIAN
from ..logs.manifest import Manifest
from ..model.arm import CANONICAL_AXES
from ..space.rotations import TURNING
from ..units import MS
from .backlog import Backlog
from .estimator import LiveEstimator
from .health import Health, SensorHealth
from .messages import Reader, readers_of
from .rate_limit import RateLimitedLog
from .results import LiveEstimate, UpdateResult
from .sources import QUIET
from .wire import Event

EXTRA = "pip install 'pumafuse[ros2]'"
FRAME_ID = "frame_id"  # the node's parameter
_NAME = "pumafuse"  # of the node, where --ros-args names none
_DEPTH = 1000  # messages of a topic that the middleware keeps
_LOOK = 0.5  # s between two looks at who publishes
_ALONE = 5.0  # s without a publisher until that is said
_EVERY = 1.0  # s between two diagnostics
_UNKNOWN = 1e6  # rad², of an orientation that nobody tells
_KEPT = 10  # estimates for a slow receiver


@dataclass
class Topic:
    """A topic that is listened to."""

    name: str  # as run.toml has it
    readers: Sequence[Reader]  # of the sources that are in its messages
    subscription: Any = None  # once somebody publishes it
    kind: str = ""  # of messages that is subscribed to
    publishers: int | None = None  # at the last look; None before anybody was
    lost: int = 0  # messages, by the middleware


class Ros2Source:
    """Events from the topics of a running robot, whose commands, and time, may be those of a frame and a simulation."""

    def __init__(self, listed: Manifest, arguments: Sequence[str], notify: Callable[[str], None]) -> None:
        """Make the node, with ``--ros-args`` and what is behind it; :meth:`close` ends it."""
        for name, entry in {**listed.sensors, "": listed.command}.items():
            if not entry.topic:
                who = f"sensor '{name}' has" if name else "the commands have"
                raise ConfigError(f"run.toml: {who} no topic; give the running robot's, as in topic = '/joint_states'")
        readers = readers_of(listed)
        names = dict.fromkeys(reader.entry.topic for reader in readers)
        self._topics = [Topic(name, [reader for reader in readers if reader.entry.topic == name]) for name in names]
        self._command = readers[-1]
        self._notify, self._log = notify, RateLimitedLog(notify)
        self._backlog = Backlog[Event]("messages", self._log)
        self._burst = list[tuple[int, Event]]()  # by when each was received [ns]
        self._rclpy, no_signals = load("rclpy"), load("rclpy.signals").SignalHandlerOptions.NO  # pumafuse has its own
        try:
            self._rclpy.init(args=list(arguments), signal_handler_options=no_signals)
            self.node: Any = self._rclpy.create_node(_NAME)
        except Exception as error:  # of the middleware, of many kinds
            self._rclpy.try_shutdown()
            raise ConfigError(f"--ros-args: {reason(error)}") from None
        self.node.declare_parameter(FRAME_ID, "")
        self.frame, self.simulated = "", bool(self.node.get_parameter("use_sim_time").value)
        self._executor: Any = load("rclpy.executors").SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._backlog.name = self.node.get_fully_qualified_name()
        for topic in self._topics:
            try:
                self._resolve(topic)
            except Exception as error:  # of the middleware
                self.close()
                raise ConfigError(f"run.toml: topic '{topic.name}' is no name of ROS 2: {reason(error)}") from None

    def start(self) -> None:
        """Listen."""
        self._notify(f"{self._backlog.name}: listening at {', '.join(map(self._resolve, self._topics))}")
        self._began = time.monotonic()
        self._find_publishers(self._began)

    def get(self) -> list[Event]:
        """Some events in the order of their receipt; none after a tenth of a second without any."""
        due = self._command.next_due
        wait = QUIET if due is None else min(max((due - self.clock()) / 1e9, 0.0), QUIET)
        self._executor.spin_once(timeout_sec=0.0 if self._backlog else wait)
        now = time.monotonic()
        self._receive(now)
        if now - self._looked > _LOOK:
            self._find_publishers(now)
        return self._backlog.take(now)

    def stop(self) -> list[Event]:
        """The events that have come and were not given yet."""
        self._receive(time.monotonic())
        return self._backlog.take_all()

    def close(self) -> None:
        """End the node."""
        self._executor.shutdown(0.0)
        self.node.destroy_node()
        self._rclpy.try_shutdown()

    def summary(self) -> str:
        """How many events came, and how many messages were lost."""
        waited = self._backlog
        lost = sum(topic.lost for topic in self._topics) + waited.dropped
        return f"{waited.name}: {waited.received} events, {lost} lost{waited.shed_words}"

    def clock(self) -> int:
        """The time of the node's clock [ns]."""
        return self.node.get_clock().now().nanoseconds

    def _receive(self, now: float) -> None:
        """Put all that has come into the backlog."""
        for topic in self._topics:
            if (subscription := topic.subscription) is not None:
                with subscription.handle:
                    for _ in range(_DEPTH):
                        taken = subscription.handle.take_message(subscription.msg_type, False)
                        if taken is None:
                            break
                        self._add(topic, *taken)
        if self._command.next_due is not None:
            at = self.clock()
            self._burst += [(at, event) for event in self._command.due(at)]
        self._burst.sort(key=lambda received: received[0])
        for _, event in self._burst:
            self._backlog.add(now, event)
        self._burst.clear()

    def _add(self, topic: Topic, message: Any, info: Mapping[str, Any]) -> None:
        received = self.clock() if self.simulated else info["received_timestamp"]
        for reader in topic.readers:
            try:
                self._burst += [(received, event) for event in reader.events(message, received)]
            except DAMAGE as error:
                self._log.write(f"{topic.name} bad", f"{topic.name}: a message is left out: {reason(error)}")
        if not self.frame and not topic.readers[-1].name:
            self.frame = getattr(getattr(message, "header", None), "frame_id", "")

    def _resolve(self, topic: Topic) -> str:
        return self.node.resolve_topic_name(topic.name)

    def _find_publishers(self, now: float) -> None:
        """Look at who publishes, and subscribe to what somebody does."""
        self._looked, self.simulated = now, bool(self.node.get_parameter("use_sim_time").value)
        for topic in self._topics:
            name, before = self._resolve(topic), topic.publishers
            count = self.node.count_publishers(name)
            if count and topic.subscription is None:
                self._subscribe(topic, name)
            if count == before:
                continue
            if not count and before is None:
                if now - self._began < _ALONE:
                    continue
                names = [other for other, _ in self.node.get_topic_names_and_types() if other != name]
                self._notify(f"{name}: nobody publishes it so far; {suggestion(name, names)}")
            elif not count:
                self._log.write(f"{name} gone", f"{name}: nobody publishes it any more")
            elif not before:
                self._log.write(f"{name} there", f"{name}: is published")
            if count > max(before or 0, 1) and not topic.kind.endswith("/TFMessage"):  # which many send
                self._log.write(f"{name} many", f"{name}: {count} publishers; their messages are taken as if of one")
            topic.publishers = count

    def _subscribe(self, topic: Topic, name: str) -> None:
        """Subscribe by the first of the publishers' types that has what ``run.toml`` asks for."""
        infos = self.node.get_publishers_info_by_topic(name)
        for kind in dict.fromkeys(info.topic_type for info in infos):
            package, _, type_name = kind.partition("/")
            try:
                message = getattr(import_module(f"{package}.msg"), type_name.rpartition("/")[2])
                lacking = [path for reader in topic.readers for path in reader.missing_fields(message())]
            except (ImportError, AttributeError):
                self._log.write(f"{name} {kind}", f"{name}: no package here has its type {kind}: source one that does")
                continue
            except PumafuseError as error:
                self._log.write(f"{name} {kind}", str(error))
                continue
            if lacking:
                self._log.write(f"{name} {kind}", f"{name}: is of type {kind}, which has no {', '.join(lacking)}")
                continue
            qos = load("rclpy.qos")
            depth = qos.QoSProfile(depth=_DEPTH, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
            handler, take = load("rclpy.event_handler"), partial(self._add, topic)
            lost = handler.SubscriptionEventCallbacks(message_lost=partial(self._count_lost, topic))
            subscribe = partial(self.node.create_subscription, message, topic.name, take, depth)
            try:
                topic.subscription = subscribe(event_callbacks=lost)
            except handler.UnsupportedEventTypeError:  # not every middleware tells
                topic.subscription = subscribe()
            topic.kind = kind
            return

    def _count_lost(self, topic: Topic, status: Any) -> None:
        topic.lost += status.total_count_change
        self._log.write(f"{topic.name} lost", f"{topic.name}: {topic.lost} messages lost on the way")


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
            self._publish_pose = node.create_publisher(type(self._pose), "~/pose", _KEPT).publish
        if self._joints:
            self._state = joints.JointState()
            self._publish_joints = node.create_publisher(type(self._state), "~/joints", _KEPT).publish
        array = self._diagnostic.DiagnosticArray
        self._publish_diagnostics = node.create_publisher(array, "~/diagnostics", _KEPT).publish
        self._published = 0.0

    def event(self, event: Event, result: UpdateResult) -> None:
        """Nothing is published of what came."""

    def estimate(self, estimate: LiveEstimate) -> None:
        """Publish an estimate."""
        if self._pose is not None and self._set_pose(estimate):
            self._set_header(self._pose.header, estimate.stamp)
            self._publish_pose(self._pose)
        if self._state is not None:
            joints = [name for name in self._joints if name in estimate.axes]
            self._state.name = joints
            self._state.position = [estimate.axes[name].position for name in joints]
            self._state.velocity = [estimate.axes[name].velocity for name in joints]
            self._set_header(self._state.header, estimate.stamp)
            self._publish_joints(self._state)

    def tick(self, health: Callable[[], Health]) -> None:
        """Publish diagnostics once a second."""
        now = time.monotonic()
        if now - self._published >= _EVERY:
            self._published = now
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
        position_of = position if estimate.cartesian is None else estimate.cartesian
        if not set(CARTESIAN) <= position_of.keys():
            return False
        pose = self._pose.pose.pose
        pose.position.x, pose.position.y, pose.position.z = (position_of[axis] for axis in CARTESIAN)
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
        return [whole, *(self._of_sensor(name, sensor, health) for name, sensor in health.sensors.items())]

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


def load(module: str) -> Any:
    """A module of ROS 2."""
    try:
        return import_module(module)
    except ImportError as error:
        why = "" if isinstance(error, ModuleNotFoundError) else f" ({reason(error)})"
        raise ConfigError(f"ROS 2 has no '{module}' here{why}: source the robot's own, or {EXTRA}") from None
