"""`pumafuse live ros2:` between processes on real ROS 2 (Fast DDS), on this computer alone."""

import contextlib
import json
import math
import os
import runpy
import subprocess
import sys
from collections.abc import Callable, Generator
from dataclasses import replace
from importlib.util import find_spec
from itertools import accumulate
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import bag_files
import pumafuse as pf
from executable import EXECUTABLE, pumafuse, refused
from listening import LONGEST, Live, live

pytestmark = pytest.mark.skipif(find_spec("rclpy") is None, reason="there are wheels of ROS 2 for Linux alone")
PLAYER = Path(__file__).parents[1] / "ros2_player.py"
BEGIN = bag_files.START_NS


@pytest.fixture(autouse=True)
def ros(monkeypatch: pytest.MonkeyPatch) -> None:
    """Find ROS's libraries, and talk to this computer alone, on a domain of our own."""
    libraries = [f"{sys.prefix}/lib", *map(str, Path(find_spec("rclpy").origin).parents[1].glob("ros_*.libs"))]
    monkeypatch.setenv("LD_LIBRARY_PATH", ":".join(libraries))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("PYTHONPATH", str(PLAYER.parent))


@pytest.fixture
def start() -> Generator[Callable[..., Live]]:
    """Starts nodes, `pumafuse live ros2:`, and ends those that are left."""
    with contextlib.ExitStack() as stack:

        def begin(folder: Path, *options: str) -> Live:
            words = f"ros2:{folder / 'run.toml'}", folder / "fusion.toml", *options
            node = stack.enter_context(live(*words, out=False))
            node.until("listening at")
            return node

        yield begin


def cell(folder: Path, run: str = bag_files.ROS) -> None:
    """The arm, its filter and its topics; sensors that the run has not are left out."""
    (folder / "arm.toml").write_text(bag_files.ARM)
    head, *sensors = bag_files.FUSION.split("[sensors.")
    kept = [one for one in sensors if f"[sensors.{one.partition(']')[0]}]" in run]
    (folder / "fusion.toml").write_text("[sensors.".join([head, *kept]))
    (folder / "run.toml").write_text(run.format(file="drive.mcap"))


def played(folder: Path, samples: list[bag_files.Sample], node: str = "pumafuse") -> list[dict[str, Any]]:
    """Play a bag of them; what was published meanwhile."""
    bag_files.mcap(folder / "drive.mcap", samples)
    return what_is_published(folder, node, "/command", "/camera")


def publish(folder: Path, sent: list[bag_files.Sent]) -> list[dict[str, Any]]:
    """Play messages; what was published meanwhile."""
    bag_files.messages(folder / "drive.mcap", sent)
    return what_is_published(folder, "pumafuse", sent[-1][0])


def player(folder: Path, *arguments: str) -> list[str]:
    return [sys.executable, str(PLAYER), str(folder / "drive.mcap"), str(folder / "published.jsonl"), *arguments]


def what_is_published(folder: Path, *arguments: str) -> list[dict[str, Any]]:
    subprocess.run(player(folder, *arguments), check=True, timeout=LONGEST)
    return [json.loads(line) for line in (folder / "published.jsonl").read_text().splitlines()]


STAMPED = bag_files.ROS[: bag_files.ROS.index("[sensors.level]")]  # without what is stamped when it is received


@pytest.mark.filterwarnings("ignore::pumafuse.errors.PumafuseWarning")  # the arm is not the one that moved
def test_poses_are_those_of_the_bag_fused_as_live(tmp_path: Path, start: Callable[..., Live]) -> None:
    """To the last bit, with covariance and frame; the record fuses to the same; diagnostics tell of each sensor."""
    cell(tmp_path, STAMPED)
    node = start(tmp_path, "--record", str(tmp_path / "record"))
    published = played(tmp_path, bag_files.motion(60))
    log = node.end()
    assert "60 fused; 60 estimates" in log
    assert "/pumafuse: 180 events, 0 lost" in log
    config = pf.FusionConfig.load(tmp_path / "fusion.toml")
    for source in (tmp_path, tmp_path / "record"):
        est = pf.fuse(pf.Run.read(source), config, mode="as-live")
        poses = [one for one in published if one["topic"] == "pose"]
        assert [one["stamp"] for one in poses] == (est.origin + np.rint(est.time * 1e9).astype(int)).tolist()
        assert {one["frame"] for one in poses} == {"base"}
        for column, axis in enumerate("xyz"):
            assert np.array_equal([one["pose"][column] for one in poses], est[axis].position)
            variance = np.array([one["covariance"][7 * column] for one in poses])
            assert np.allclose(variance, est[axis].position_sd ** 2, rtol=1e-12)
        assert poses[0]["pose"][3:] == [0.0, 0.0, 0.0, 1.0]
        assert poses[0]["covariance"][35] > 1e3
    status = [one for one in published if one["topic"] == "diagnostics"][-1]["status"]
    assert set(status) == {"pumafuse: estimates", "pumafuse: camera", "pumafuse: encoder"}
    assert "far larger than expected" in status["pumafuse: camera"][1]  # its arm is not the one that moved
    assert status["pumafuse: camera"][2]["rejected"].isdigit()
    first = next(one for one in published if one["topic"] == "diagnostics")["status"]
    assert first["pumafuse: estimates"][:2] == [3, "no command yet"]  # STALE


@pytest.mark.long
def test_publishers_come_late_leave_and_return(tmp_path: Path, start: Callable[..., Live]) -> None:
    """Each is said, as two of commands and a wrong type are; --ros-args move topics and the node, and give a frame."""
    cell(tmp_path, STAMPED.replace('topic = "/command"', 'topic = "/orders"').replace("/joints", "/level"))
    arguments = ["-r", "__node:=left", "-r", "/orders:=/command", "-p", "frame_id:=cell"]
    node = start(tmp_path, "--ros-args", *arguments)
    node.until("/command: nobody publishes it so far")
    bag_files.mcap(tmp_path / "drive.mcap", bag_files.motion(20))
    words = player(tmp_path, "left", "/command", "/command", "/camera")
    with subprocess.Popen([*words[:3], str(tmp_path / "second.jsonl"), *words[4:]]):
        subprocess.run(words, check=True, timeout=LONGEST)
    log = node.until("/command: nobody publishes it any more")
    assert "/command: 2 publishers" in log
    assert "/level: is of type std_msgs/msg/Float64, which has no header.stamp, position[slide]" in log
    later = [replace(one, stamp=one.stamp + 10**9) for one in bag_files.motion(20)]
    poses = [one for one in played(tmp_path, later, "left") if one["topic"] == "pose"]
    assert "40 fused" in node.end()
    assert [one["stamp"] for one in poses] == [one.stamp for one in later if one.topic == "/command"]
    assert {one["frame"] for one in poses} == {"cell"}


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["ros2:{}/nowhere.toml"], 1, "nowhere.toml"),
        (["ros2:{}/run.toml", "ros2:{}/run.toml"], 1, "one node is enough"),
        (["stdin", "--ros-args", "-r", "a:=b"], 2, "goes with a source ros2:run.toml"),
    ],
)
def test_wrong_arguments(tmp_path: Path, options: list[str], code: int, words: str) -> None:
    cell(tmp_path, STAMPED)
    given = [one.format(tmp_path) for one in options]
    assert words in pumafuse("live", "-c", tmp_path / "fusion.toml", *given, code=code).stderr


def test_what_ros_refuses_is_a_line(tmp_path: Path) -> None:
    """In a process that has ROS."""
    cell(tmp_path, STAMPED.replace("/joints", "no topic"))
    command = [str(EXECUTABLE), "live", "-c", str(tmp_path / "fusion.toml"), f"ros2:{tmp_path}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=LONGEST)
    assert done.returncode == 1 and "topic 'no topic' is no name of ROS 2" in done.stderr
    assert "Traceback" not in done.stderr


def test_without_ros_the_way_to_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where its libraries are not found, and where a source has no topic."""
    monkeypatch.setitem(sys.modules, "rclpy", None)
    cell(tmp_path)
    words = "live", f"ros2:{tmp_path / 'run.toml'}", "-c", tmp_path / "fusion.toml"
    assert "pip install 'pumafuse[ros2]'" in refused(*words)
    (tmp_path / "run.toml").write_text((tmp_path / "run.toml").read_text().replace('topic = "/level"', ""))
    assert "sensor 'level' has no topic" in refused(*words)


ANGLE = """
name = "lever"
update_period_ms = 4.0
delay_ms = 30.0
[axes.elbow]
kind = "angle"
plant = "first-order"
time_constant_ms = 40.0
"""
ENCODER = """
arm = "arm.toml"
[process]
input_noise_deg_rtHz = 0.3
drift_deg_rts = 0.3
[sensors.encoder]
sd_deg = 0.1
"""
JOINTS = """
[command]
file = "drive.mcap"
topic = "/go"
time = "{time}"
elbow = {{ column = "{column}", unit = "rad" }}
[sensors.encoder]
file = "drive.mcap"
topic = "/joint_states"
time = "{stamps}"
elbow = {{ column = "position[elbow]", unit = "rad", turn_deg = 360.0 }}
"""


def lever(folder: Path, **run: str) -> None:
    """An arm of one joint, and its encoder."""
    for name, text in {"arm": ANGLE, "fusion": ENCODER, "run": JOINTS.format(**run)}.items():
        (folder / f"{name}.toml").write_text(text)


def states(begin: int, count: int) -> list[bag_files.Sent]:
    """An encoder at 50 Hz from an instant [ns] on that stands at 0.2 rad, a turn too far."""
    kind, value = "sensor_msgs/msg/JointState", 0.2 + 2.0 * np.pi
    every = [(20_000_000 * k, {"name": ["lift", "elbow"], "position": [9.0, value]}) for k in range(count)]
    return [("/joint_states", kind, begin + t, {"header": bag_files.header(0), **one}) for t, one in every]


@pytest.mark.long
def test_joints_by_a_trajectory(tmp_path: Path, start: Callable[..., Live]) -> None:
    """A path is commanded as time goes by from when it comes; the joint is published at each command."""
    lever(tmp_path, time="path.time_ns", column="path.position[elbow]", stamps="log_time")
    node = start(tmp_path, "--record", str(tmp_path / "record"))
    points = [(0.0, 0.0), (1.0, 0.4)]
    rest = {"velocities": [], "accelerations": [], "effort": []}
    made = [{**rest, "positions": [at], "time_from_start": bag_files.stamp(round(t * 1e9))} for t, at in points]
    goal = {"header": bag_files.header(0), "joint_names": ["elbow"], "points": made}
    sent = [
        ("/go", "trajectory_msgs/msg/JointTrajectory", BEGIN, goal),
        *states(BEGIN + 100_000_000, 65),
    ]
    joints = [one for one in publish(tmp_path, sent) if one["topic"] == "joints"]
    assert "251 fused; 251 estimates" in node.end()
    assert [one["name"] for one in joints] == [["elbow"]] * 251
    run = pf.Run.read(tmp_path / "record")
    assert [one["stamp"] for one in joints] == run.command.stamp.tolist()
    assert np.allclose(run.command.values["elbow"], np.linspace(0.0, 0.4, 251), atol=1e-9)
    assert np.allclose(run.sensors["encoder"].values["elbow"], 0.2)  # without its turn
    assert all(abs(one["position"][0] - 0.2) < 0.2 for one in joints[20:])


@pytest.mark.long
def test_the_time_of_a_simulation(tmp_path: Path, start: Callable[..., Live]) -> None:
    """What has no stamp is stamped by /clock, which runs at half the pace of the day."""
    lever(tmp_path, time="log_time", column="data[0]", stamps="log_time")
    node = start(tmp_path, "--record", str(tmp_path / "record"), "--ros-args", "-p", "use_sim_time:=true")
    sent = list[bag_files.Sent]()
    for k in range(200):
        clock = bag_files.stamp(100 * 10**9 + 5_000_000 * k)
        sent.append(("/clock", "rosgraph_msgs/msg/Clock", BEGIN + 10_000_000 * k, {"clock": clock}))
    for k in range(80):
        at = BEGIN + 400_000_000 + 20_000_000 * k + 1_000_000
        sent.append(("/go", "std_msgs/msg/Float64MultiArray", at, {"data": [0.1]}))
    publish(tmp_path, [*sent, *states(BEGIN + 403_000_000, 80)])
    node.end()
    run = pf.Run.read(tmp_path / "record")
    for source in (run.command, run.sensors["encoder"]):
        assert 100.15 < source.stamp[0] / 1e9 < 100.25
        assert np.median(np.diff(source.stamp)) == 10_000_000


def test_the_launch_file_starts_the_node(
    tmp_path: Path, start: Callable[..., Live], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its words, with the arguments as a launch fills them in, are ones that the command takes."""
    cell(tmp_path, STAMPED)
    given = {"folder": str(tmp_path), "name": "left", "frame_id": "", "use_sim_time": "false"}
    kept = SimpleNamespace
    monkeypatch.setitem(sys.modules, "launch", kept(LaunchDescription=list))
    actions = kept(DeclareLaunchArgument=lambda name, **_: name, ExecuteProcess=lambda cmd, **_: cmd)
    monkeypatch.setitem(sys.modules, "launch.actions", actions)
    monkeypatch.setitem(sys.modules, "launch.substitutions", kept(LaunchConfiguration=given.get))
    file = PLAYER.parents[1] / "examples" / "ros2" / "pumafuse.launch.py"
    *names, command = runpy.run_path(str(file))["generate_launch_description"]()
    assert names == list(given)
    words = [word if isinstance(word, str) else "".join(word) for word in command]
    assert words[:4] == ["pumafuse", "live", f"ros2:{tmp_path / 'run.toml'}", "-c"]
    node = start(tmp_path, *words[5:])
    assert "estimates" in node.end()


def moved(begin: int, seconds: float, phase: float) -> tuple[list[bag_files.Sent], np.ndarray]:
    """A lever, 30 ms and a lag of 50 ms late, that is told each 10 ms and seen at 50 Hz; where it is then [rad]."""
    time_ = 0.01 * np.arange(round(100 * seconds))
    told = 0.5 * np.sin(1.3 * time_ + phase) * np.sin(0.4 * time_) ** 2 + 0.2 * np.sin(3.1 * time_) ** 2
    share, late = math.exp(-0.01 / 0.05), np.concatenate([np.zeros(3), told[:-3]])
    where = np.array(list(accumulate(late, lambda at, to: share * at + (1.0 - share) * to)))
    seen = where + np.random.default_rng(7).normal(scale=np.radians(0.2), size=len(where))
    sent = list[bag_files.Sent]()
    for k in range(len(time_)):
        at = begin + 10_000_000 * k
        state = {"header": bag_files.header(at), "name": ["elbow"]}
        sent.append(("/arm/command", "sensor_msgs/msg/JointState", at, {**state, "position": [float(told[k])]}))
        if k % 2:
            one = {**state, "header": bag_files.header(at - 100), "position": [float(seen[k])]}
            sent.append(("/joint_states", "sensor_msgs/msg/JointState", at + 4_000_000, one))
    return sent, where


@pytest.mark.long
def test_from_a_bag_to_the_node_nothing_is_edited(tmp_path: Path, start: Callable[..., Live]) -> None:
    """`fuse BAG` prints the line that runs the node; its estimates are twice as good as the sensor."""
    (tmp_path / "drive").mkdir()
    bag_files.messages(tmp_path / "drive" / "drive_0.mcap", moved(1_790_000_000 * 10**9, 40.0, 0.0)[0])
    command = [str(EXECUTABLE), "fuse", str(tmp_path / "drive"), "-o", str(tmp_path / "mine")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    line = next(one for one in done.stdout.splitlines() if one.startswith("or as a node of ROS 2: "))
    assert line.split()[-4:] == ["live", f"ros2:{tmp_path}/mine/run.toml", "-c", f"{tmp_path}/mine/fusion.toml"]
    node = start(tmp_path / "mine")
    sent, where = moved(BEGIN, 8.0, 1.0)
    joints = [one for one in publish(tmp_path, sent) if one["topic"] == "joints"]
    log = node.end()
    assert "800 fused; 800 estimates" in log
    wrong = np.degrees([one["position"][0] for one in joints] - where)[100:]
    assert np.sqrt(np.mean(wrong**2)) < 0.1
