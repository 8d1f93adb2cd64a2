"""Trajectories, transforms and velocities as commands, and messages that cannot be decoded."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from mcap_ros2.writer import Writer as Ros2Writer

from bag_files import definition_of
from discovery.test_survey import written
from pumafuse.arrays import FloatArray
from pumafuse.discovery.survey import survey
from pumafuse.errors import RunError
from pumafuse.logs import tables
from refusals import one_line

START = 1_790_000_000
LAG = 0.08  # s
GOAL = "control_msgs/action/FollowJointTrajectory_Goal"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


def split(time: float) -> dict[str, int]:
    ns = round(time * 1e9)
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}


def smooth(share: FloatArray) -> FloatArray:
    share = np.clip(share, 0.0, 1.0)
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)


def trajectory(
    joints: Sequence[str], points: Sequence[tuple[float, Sequence[float]]], stamp: float = 0.0, **more: Any
) -> dict[str, Any]:
    """A JointTrajectory through points: their times since its start [s] and positions."""
    rest: dict[str, Any] = {"velocities": [], "accelerations": [], "effort": [], **more}
    return {
        "header": {"stamp": split(stamp), "frame_id": ""},
        "joint_names": list(joints),
        "points": [{**rest, "positions": list(at), "time_from_start": split(time)} for time, at in points],
    }


def states(joints: Sequence[str], where: FloatArray, time: FloatArray) -> list[tuple[str, str, float, Any]]:
    kind = "sensor_msgs/msg/JointState"
    return [
        ("/joint_states", kind, START + t, {"header": {"stamp": split(START + t)}, "name": joints, "position": list(x)})
        for t, x in zip(time, where, strict=True)
    ]


def bag(path: Path, messages: Sequence[tuple[str, str, float, Any]]) -> Path:
    """An MCAP: messages of ROS 2, or, where there is no definition at hand, of JSON."""
    messages = sorted(messages, key=lambda one: one[2])
    with path.open("wb") as file:
        if any(kind == GOAL for _, kind, _, _ in messages):
            writer = Writer(file)
            writer.start("", "")
            channels = {
                topic: writer.register_channel(topic, "json", writer.register_schema(kind, "jsonschema", b"{}"))
                for topic, kind in {one[0]: one[1] for one in messages}.items()
            }
            for topic, _, time, fields in messages:
                writer.add_message(channels[topic], round(time * 1e9), json.dumps(fields).encode(), round(time * 1e9))
        else:
            writer = Ros2Writer(file)
            schemas = {kind: writer.register_msgdef(kind, definition_of(kind)) for _, kind, _, _ in messages}
            for topic, kind, time, fields in messages:
                writer.write_message(topic, schemas[kind], fields, round(time * 1e9), round(time * 1e9))
        writer.finish()
    return path


def moves(time: FloatArray) -> FloatArray:
    """Where two joints are commanded: three moves of 2 s with pauses of 1 s, from 1 s on, (n, 2)."""
    ends = np.array([[0.0, 0.2], [0.9, -0.5], [-0.3, 0.4], [0.0, 0.2]])
    steps = [smooth((time - 1.0 - 3.0 * n) / 2.0)[:, None] * (ends[n + 1] - ends[n]) for n in range(3)]
    return ends[0] + np.sum(steps, axis=0)


def test_the_path_of_trajectories_is_the_commands(tmp_path: Path) -> None:
    """Goals with trajectories that name joints in another order and have 21 points: the lag is found."""
    messages, time = [], np.arange(0.0, 11.0, 0.01)
    for n in range(3):
        since = 0.1 * np.arange(21)
        one = trajectory(
            ["wrist", "boom"], list(zip(since, moves(1.0 + 3.0 * n + since)[:, ::-1].tolist(), strict=True))
        )
        messages.append(("/arm/execute", GOAL, START + 1.0 + 3.0 * n, {"trajectory": one}))
    found = survey(bag(tmp_path / "log.mcap", [*messages, *states(["boom", "wrist"], moves(time - LAG), time)]))
    assert set(found.run.axes) == {"boom", "wrist"}
    assert found.run.kinds == {"boom": "angle", "wrist": "angle"}
    for axis in found.run.axes:
        assert found.relations["joint_states", axis].lag == pytest.approx(LAG, abs=0.003)
        assert found.relations["joint_states", axis].slope == pytest.approx(1.0, abs=0.02)
    read, _ = written(found, tmp_path)
    assert np.array_equal(read.command.values["boom"], found.run.command.values["boom"])
    assert np.array_equal(read.command.stamp, found.run.command.stamp)


def test_a_plan_of_many_points_is_commands_as_one_of_few_is(tmp_path: Path) -> None:
    """All moves in one message of 451 points, as planners write them; and a new one of 120 points every 0.1 s."""
    time, since = np.arange(0.0, 11.0, 0.01), 0.02 * np.arange(451)
    whole = [(1.0, trajectory(["boom", "wrist"], list(zip(since, moves(1.0 + since).tolist(), strict=True))))]
    begins, ahead = np.arange(0.0, 10.0, 0.1), 0.02 * np.arange(1, 121)
    anew = [
        (t, trajectory(["boom", "wrist"], list(zip(ahead, moves(t + ahead).tolist(), strict=True)))) for t in begins
    ]
    for plans in (whole, anew):
        sent = [("/arm/plan", TRAJECTORY, START + t, plan) for t, plan in plans]
        found = survey(bag(tmp_path / "log.mcap", [*sent, *states(["boom", "wrist"], moves(time - LAG), time)]))
        for axis in ("boom", "wrist"):
            assert found.relations["joint_states", axis].lag == pytest.approx(LAG, abs=0.003)


def path_of(file: Path, joint: str) -> tuple[FloatArray, FloatArray]:
    """Times since the start [s] and places of a joint on the path."""
    table = tables.read(file, topic="/go", fields=["path.time_ns", f"path.position[{joint}]"])
    return (table.stamps("path.time_ns")[0] - START * 10**9) / 1e9, table.plain(f"path.position[{joint}]")[0]


def test_a_trajectory_ends_the_one_before_and_begins_where_that_was(tmp_path: Path) -> None:
    """From 0 to 4 in 4 s; at 1 s a new one to 5 within 2 s begins at 1; one without points stops it at 3, at 2 s."""
    messages = [
        ("/go", TRAJECTORY, START + 0.0, trajectory(["lift"], [(0.0, [0.0]), (4.0, [4.0])])),
        ("/go", TRAJECTORY, START + 1.0, trajectory(["lift"], [(2.0, [5.0])])),
        ("/go", TRAJECTORY, START + 2.0, trajectory(["lift"], [])),
    ]
    time, place = path_of(bag(tmp_path / "a.mcap", messages), "lift")
    assert (np.diff(time) > 0.0).all()
    assert np.allclose(place, np.where(time < 1.0, time, np.minimum(1.0 + 2.0 * (time - 1.0), 3.0)), atol=1e-9)


def test_a_trajectory_begins_when_its_header_says_and_goes_round_by_its_velocities(tmp_path: Path) -> None:
    """Stamped 0.7 s after it was sent; position t² with velocity 2 t is a cubic between two points."""
    one = trajectory(["lift"], [(0.0, [0.0]), (2.0, [4.0])], stamp=START + 0.7)
    for point, velocity in zip(one["points"], (0.0, 4.0), strict=True):
        point["velocities"] = [velocity]
    time, place = path_of(bag(tmp_path / "a.mcap", [("/go", TRAJECTORY, START + 0.0, one)]), "lift")
    assert time[0] == pytest.approx(0.7, abs=1e-6)
    assert np.allclose(place, (time - 0.7) ** 2, atol=1e-6)


def test_a_stream_of_trajectories_of_one_point_stays_commands_as_they_are_sent(tmp_path: Path) -> None:
    """MoveIt's servo sends one every 20 ms: version 0.2 took its points as commands, and so they stay."""
    time = np.arange(0.0, 10.0, 0.02)
    sent = [
        ("/servo/joint_trajectory", TRAJECTORY, START + t, trajectory(["boom"], [(0.02, [x[0]])], stamp=START + t))
        for t, x in zip(time, moves(time), strict=True)
    ]
    found = survey(bag(tmp_path / "a.mcap", [*sent, *states(["boom"], moves(time - LAG)[:, :1], time)]))
    assert len(found.run.command.stamp) == len(time)
    assert found.relations["joint_states", "boom"].lag == pytest.approx(LAG, abs=0.003)


@pytest.mark.parametrize(("times", "reason"), [([0.0, 1.0, 1.0], "does not rise"), ([0.0, 9e5], "a day")])
def test_a_trajectory_that_cannot_be_followed_is_left_out_with_the_reason(
    times: list[float], reason: str, tmp_path: Path
) -> None:
    good = trajectory(["lift"], [(0.0, [0.0]), (1.0, [1.0])])
    wrong = trajectory(["lift"], [(time, [0.0]) for time in times])
    file = bag(tmp_path / "a.mcap", [("/go", TRAJECTORY, START + 0.0, good), ("/go", TRAJECTORY, START + 5.0, wrong)])
    assert any(
        "1 trajectory left out" in note and reason in note
        for note in tables.read(file, topic="/go", fields=["path"]).notes
    )


def transforms(time: FloatArray, robots: Sequence[tuple[str, float]]) -> list[tuple[str, str, float, Any]]:
    """Messages of /tf: each robot's tool [m] from its base, late, a link that turns, and another thing that moves."""
    found = []
    for t in time:
        listed = []
        for name, late in robots:
            tool = moves(np.array([t - late]))[0]
            for parent, child, at, angle in (
                (f"{name}base", f"{name}tool0", (*tool, 0.3), 0.0),
                (f"{name}base_link", f"{name}link_1", (0.0, 0.0, 0.1), float(tool[0])),
                ("world", f"{name}cart", (0.1 * t, 0.0, 0.0), 0.0),
            ):
                place = dict(zip("xyz", map(float, at), strict=True))
                turned = {"x": 0.0, "y": 0.0, "z": np.sin(angle / 2), "w": np.cos(angle / 2)}
                head = {"stamp": split(START + t), "frame_id": parent}
                transform = {"translation": place, "rotation": turned}
                listed.append({"header": head, "child_frame_id": child, "transform": transform})
        found.append(("/tf", "tf2_msgs/msg/TFMessage", START + t, {"transforms": listed}))
    return found


def test_of_transforms_the_tools_of_each_robot_are_found(tmp_path: Path) -> None:
    """Two robots in one /tf: the tool of the first leads, that of the second follows it; links and carts are named."""
    file = bag(tmp_path / "log.mcap", transforms(np.arange(0.0, 11.0, 0.02), [("left/", 0.0), ("right/", LAG)]))
    found = survey(file)
    assert found.run.axes == ("x", "y")
    assert set(found.run.sensors) == {"tf_right_tool0"}
    assert found.relations["tf_right_tool0", "x"].lag == pytest.approx(LAG, abs=0.003)
    assert any("left/base_link → left/link_1" in note for part in found.parts for note in part.notes)
    assert np.array_equal(written(found, tmp_path)[0].command.values["x"], found.run.command.values["x"])


def test_transforms_as_rostopic_writes_them(tmp_path: Path) -> None:
    """A line has all transforms of a message, some lines two and some one: the tool is found in any of them."""
    time, lines = np.arange(0.0, 11.0, 0.02), []
    fields = "header.seq header.stamp header.frame_id child_frame_id transform.translation.x transform.translation.y"
    fields += (
        " transform.translation.z transform.rotation.x transform.rotation.y transform.rotation.z transform.rotation.w"
    )
    for n, t in enumerate(time):
        stamp = round((START + t) * 1e9)
        (x, y), rest = moves(np.array([t]))[0], "0.0,0.0,0.0,1.0"
        tool = f"0,{stamp},world,tcp,{x:.6f},{y:.6f},0.2,{rest}"
        link = f"0,{stamp},link_2,link_3,0.0,0.1,0.0,{rest}"
        lines.append(f"{stamp + 900},{','.join([link, tool] if n % 3 else [tool])}")
    header = ",".join(f"field.transforms0.{name}" for name in fields.split())
    (tmp_path / "frames.csv").write_text("\n".join([f"%time,{header}", *lines, ""]))
    seen = moves(time - LAG)
    rows = [f"{START + t:.3f},{a:.6f},{b:.6f}" for t, (a, b) in zip(time, seen, strict=True)]
    (tmp_path / "laser_tracker.csv").write_text("\n".join(["time,x_m,y_m", *rows, ""]))
    found = survey(tmp_path)
    assert found.run.axes == ("x", "y")
    assert len(found.run.command.stamp) == len(time)
    assert found.relations["laser_tracker", "x"].lag == pytest.approx(LAG, abs=0.003)
    assert found.relations["laser_tracker", "x"].slope == pytest.approx(1.0, abs=0.01)


def test_commands_that_are_velocities_are_named(tmp_path: Path) -> None:
    """Of a topic by the type, of a table by the name: and what is needed instead."""
    time, zero = np.arange(0.0, 8.0, 0.05), {"x": 0.0, "y": 0.0, "z": 0.0}
    kind, twist = "geometry_msgs/msg/Twist", [np.cos(t) for t in time]
    sent = [
        ("/drive", kind, START + t, {"linear": {**zero, "x": v}, "angular": zero})
        for t, v in zip(time, twist, strict=True)
    ]
    file = bag(tmp_path / "log.mcap", [*sent, *states(["boom"], moves(time)[:, :1], time)])
    refusal = one_line(RunError, lambda: survey(file))
    assert "/drive are velocities, and commands must be positions" in refusal
    columns = zip(time, twist, np.sin(time), strict=True)
    (tmp_path / "a.csv").write_text("\n".join(["time_s,cmd_vel_x,x_m", *(f"{t},{v},{x}" for t, v, x in columns), ""]))
    assert "cmd_vel_x of a.csv are velocities" in one_line(RunError, lambda: survey(tmp_path / "a.csv"))


def test_a_type_without_a_definition_is_named(tmp_path: Path) -> None:
    """An old bag has no definitions, and a type of the robot's maker is in no library."""
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("", "")
        schema = writer.register_schema("acme_msgs/msg/SetPoint", "ros2msg", b"")
        channel = writer.register_channel("/acme/setpoint", "cdr", schema)
        for n in range(50):
            writer.add_message(channel, n * 10**7, b"\0\1\0\0" + bytes(16), n * 10**7)
        writer.finish()
    refusal = one_line(RunError, lambda: survey(tmp_path / "a.mcap"))
    assert "/acme/setpoint: its messages cannot be decoded" in refusal
    assert "acme_msgs/msg/SetPoint" in refusal
