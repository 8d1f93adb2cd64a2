"""A process of its own that plays a bag of ROS 2 and writes down what `pumafuse live` publishes; run as a script.

    python ros2_player.py BAG OUT NODE TOPIC...

Messages go out at the pace of their recording, once the node tells that it is there and listens to the topics, each of
which has as many publishers as it is named. OUT gets a JSON object a line: of a topic its stamp [ns] and numbers.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from pumafuse.logs.bags import Faults, records_of

LONGEST = 30.0  # s that anything here may take
DIAGNOSTICS = 2  # that come after the last message, one a second: then all estimates have come


def play(bag: Path, out: Path, name: str, topics: Sequence[str]) -> None:
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import JointState

    rclpy.init()
    node: Any = rclpy.create_node("player")
    written: list[dict[str, Any]] = []

    def write(topic: str, message: Any, **more: Any) -> None:
        stamp, frame = message.header.stamp, message.header.frame_id
        written.append({"topic": topic, "stamp": stamp.sec * 10**9 + stamp.nanosec, "frame": frame, **more})

    def pose(message: Any) -> None:
        at, turned = message.pose.pose.position, message.pose.pose.orientation
        numbers = [at.x, at.y, at.z, turned.x, turned.y, turned.z, turned.w]
        write("pose", message, pose=numbers, covariance=message.pose.covariance.tolist())

    def joints(message: Any) -> None:
        write("joints", message, name=list(message.name), position=list(message.position))

    def diagnostics(message: Any) -> None:
        status = {
            one.name: [ord(one.level), one.message, {v.key: v.value for v in one.values}] for one in message.status
        }
        write("diagnostics", message, status=status)

    node.create_subscription(PoseWithCovarianceStamped, f"/{name}/pose", pose, 10_000)
    node.create_subscription(JointState, f"/{name}/joints", joints, 10_000)
    node.create_subscription(DiagnosticArray, f"/{name}/diagnostics", diagnostics, 100)
    records = sorted(records_of(bag, None, Faults(), set()), key=lambda record: record.time)
    publishers: dict[str, Any] = {}
    for record in records:
        if record.channel.topic not in publishers:
            package, _, kind = record.channel.type.split("/")
            message = getattr(import_module(f"{package}.msg"), kind)
            publishers[record.channel.topic] = node.create_publisher(
                message, record.channel.topic, qos_profile_sensor_data
            )
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(node)

    def wait(until: float, enough: Callable[[], bool] = lambda: False) -> None:
        while not enough() and (left := until - time.time()) > 0.0:
            executor.spin_once(timeout_sec=min(left, 0.05))

    def told() -> int:
        return sum(one["topic"] == "diagnostics" for one in written)

    def are_there(topic: str) -> bool:
        return publishers[topic].get_subscription_count() and node.count_publishers(topic) >= topics.count(topic)

    wait(time.time() + LONGEST, lambda: told() > 0 and all(map(are_there, topics)))
    later = time.time() - records[0].time / 1e9
    for record in records:
        wait(record.time / 1e9 + later)
        publishers[record.channel.topic].publish(record.payload)
    enough = told() + DIAGNOSTICS
    wait(time.time() + LONGEST, lambda: told() >= enough)
    out.write_text("".join(json.dumps(one) + "\n" for one in written))


if __name__ == "__main__":
    play(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], sys.argv[4:])
