"""How late estimates are on a running ROS 2: from a command's header stamp to when its estimate is published.

    python benchmarks/ros2.py [--hz RATE] [--seconds S] [--busy]

A player sends commands at 36 Hz and measurements of three axes at RATE, on this computer alone; `pumafuse live ros2:`
estimates; a node here takes the poses. Both stamps are of one clock: what is measured is the way there through the
middleware, the filter, and the making of the message. With --busy another process keeps one of the
processors busy meanwhile.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy
import numpy as np

COMMAND_S = 0.028
LIBRARIES = [f"{sys.prefix}/lib", *map(str, Path(numpy.__file__).parents[1].glob("ros_*.libs"))]  # of the wheels
TOPIC = """
[{source}]
file = "no file"
topic = "/{topic}"
time = "header.stamp"
x = {{ column = "point.x", unit = "m" }}
y = {{ column = "point.y", unit = "m" }}
z = {{ column = "point.z", unit = "m" }}
"""
ARM = 'name = "bench"\nupdate_period_ms = 28.0\ndelay_ms = 20.0\n' + "".join(
    f'[axes.{axis}]\nplant = "second-order"\nnatural_frequency_rad_s = 30.0\ndamping = 0.8\n' for axis in "xyz"
)
FUSION = 'arm = "arm.toml"\n[process]\ninput_noise_mm_rtHz = 0.3\ndrift_mm_rts = 0.3\n[sensors.tracker]\nsd_mm = 0.5\n'


def play(hz: float, seconds: float) -> None:
    """Send what is due until the time is over."""
    import rclpy
    from geometry_msgs.msg import PointStamped
    from rclpy.qos import qos_profile_sensor_data

    rclpy.init()
    node = rclpy.create_node("player")
    command, tracker = (node.create_publisher(PointStamped, f"/{name}", qos_profile_sensor_data) for name in "ct")
    message = PointStamped()
    until = time.monotonic() + 20.0
    while command.get_subscription_count() + tracker.get_subscription_count() < 2:
        time.sleep(0.05)
        if time.monotonic() > until:
            sys.exit("nobody has subscribed")
    begin = time.monotonic()
    due = {command: (0.0, COMMAND_S), tracker: (0.0, 1.0 / hz)}
    while True:
        publisher, (at, step) = min(due.items(), key=lambda one: one[1][0])
        if at > seconds:
            break
        time.sleep(max(begin + at - time.monotonic(), 0.0))
        message.header.stamp = node.get_clock().now().to_msg()
        message.point.x = float(0.1 * np.sin(at))
        publisher.publish(message)
        due[publisher] = at + step, step
    time.sleep(0.5)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hz", type=float, default=1000.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--busy", action="store_true")
    parser.add_argument("--play", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if LIBRARIES[0] not in os.environ.get("LD_LIBRARY_PATH", ""):  # the loader reads it when a process begins
        path = ":".join([*LIBRARIES, os.environ.get("LD_LIBRARY_PATH", "")])
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | {"LD_LIBRARY_PATH": path})
    if args.play:
        play(args.hz, args.seconds)
    else:
        measure(args.hz, args.seconds, args.busy)


def measure(hz: float, seconds: float, busy: bool) -> None:
    """Play, estimate, and print how late the poses were."""
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped

    os.environ |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "88"}
    delays = list[float]()

    def take(message: PoseWithCovarianceStamped, info: dict[str, int]) -> None:
        stamp = message.header.stamp
        delays.append((info["source_timestamp"] - stamp.sec * 10**9 - stamp.nanosec) / 1e6)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "arm.toml").write_text(ARM)
        (folder / "fusion.toml").write_text(FUSION)
        (folder / "run.toml").write_text(
            TOPIC.format(source="command", topic="c") + TOPIC.format(source="sensors.tracker", topic="t")
        )
        rclpy.init()
        node = rclpy.create_node("receiver")
        node.create_subscription(PoseWithCovarianceStamped, "/pumafuse/pose", take, 1000)
        words = [sys.executable, "-m", "pumafuse", "live", f"ros2:{folder / 'run.toml'}", "-c"]
        live = subprocess.Popen([*words, str(folder / "fusion.toml")], stderr=subprocess.PIPE, text=True)
        others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(busy)]
        words = [sys.executable, __file__, "--play", "--hz", str(hz), "--seconds", str(seconds)]
        player = subprocess.Popen(words)
        while player.poll() is None:
            rclpy.spin_once(node, timeout_sec=0.1)
        live.send_signal(signal.SIGTERM)
        said = live.communicate()[1]
        for process in others:
            process.kill()
    print(said, file=sys.stderr)
    p50, p99, most = np.percentile(delays, [50, 99, 100])
    print(f"{len(delays)} poses at {hz:g} Hz: median {p50:.2f} ms, 99 % {p99:.2f} ms, most {most:.2f} ms")


if __name__ == "__main__":
    main()
