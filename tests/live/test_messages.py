"""Messages of a running ROS: a bag's messages, one by one, are the events that reading the whole bag gives."""

import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

import bag_files
import pumafuse as pf
from bag_files import Sent, header, stamp
from pumafuse.errors import ConfigError
from pumafuse.live.messages import Reader
from pumafuse.live.wire import Event
from pumafuse.logs import manifest
from pumafuse.logs.bags import Faults, records_of
from pumafuse.units import unwrapped

START = 1_790_000_000 * 10**9  # ns
STEP = 20_000_000  # ns
TIME = 0.02 * np.arange(200)
MOTION = np.column_stack([0.3 * np.sin(TIME), 0.2 * np.cos(2.0 * TIME), 0.1 * TIME])
TURN = 5.0 * np.sin(TIME)  # rad: it goes on over a turn
STORE = get_typestore(Stores.ROS2_HUMBLE)


def xyz(value: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyz", map(float, value), strict=True))


def quaternion(angle: float) -> dict[str, float]:
    return {"x": 0.0, "y": math.sin(angle / 2.0), "z": 0.0, "w": math.cos(angle / 2.0)}


def written(folder: Path, run: str, sent: Sequence[Sent]) -> Path:
    """A run.toml beside a bag of what was sent."""
    bag_files.messages(folder / "drive.mcap", sent)
    (folder / "run.toml").write_text(run.replace("topic =", 'file = "drive.mcap"\ntopic ='))
    return folder / "run.toml"


def streamed(path: Path) -> list[Event]:
    """The events in the order of their arrival, by messages as they come."""
    listed, commanded = manifest.load(path), dict[str, float]()
    readers = [Reader(name, one, commanded) for name, one in {"": listed.command, **listed.sensors}.items()]
    found = list[Event]()
    for record in records_of(path.parent / listed.command.file, None, Faults(), set()):
        message = STORE.deserialize_cdr(record.payload, record.channel.type)
        for reader in readers:
            if reader.entry.topic == record.channel.topic:
                assert reader.missing_fields(message) == []
                found += reader.events(message, record.time)
        found += readers[0].due(record.time)
    return [*found, *readers[0].due(2**62)]


def assert_equal(path: Path) -> pf.Run:
    """Every number of the run as it is read is that of an event, to the bit, and there is no other event."""
    run, events = pf.Run.read(path.parent), streamed(path)
    for name, source in {"": run.command, **run.sensors}.items():
        mine = sorted((event for event in events if event.sensor == name), key=lambda one: one.t)
        assert [event.t for event in mine] == source.stamp.tolist()
        for axis, value in source.in_joints().values.items():
            assert np.array_equal([event.values.get(axis, math.nan) for event in mine], value, equal_nan=True)
        if source.orientation is not None and source.joints is None:
            turned = [event.values.get("orientation", (math.nan,) * 4) for event in mine]
            assert np.array_equal(turned, source.orientation, equal_nan=True)
        if len(source.noise):
            assert [event.values["noise"] for event in mine] == source.noise.tolist()
    return run


def test_points_poses_and_joints_by_name(tmp_path: Path) -> None:
    """Names of joints in changing order, a topic without a header, stamps apart from times of recording."""
    bag_files.mcap(tmp_path / "drive.mcap", bag_files.motion())
    (tmp_path / "run.toml").write_text(bag_files.ROS.format(file="drive.mcap"))
    assert len(assert_equal(tmp_path / "run.toml").command.stamp) == 150


def test_transforms_of_many_frames(tmp_path: Path) -> None:
    """Of /tf the frames asked for, several in one message, with their orientations; a lost one has none."""
    kind, sent = "tf2_msgs/msg/TFMessage", list[Sent]()
    for k, place in enumerate(MOTION):
        at, lost = START + STEP * k, k % 17 == 3

        def transform(child: str, ns: int, turn: dict[str, float], place: Any = place) -> dict[str, Any]:
            inside = {"translation": xyz(place), "rotation": turn}
            return {"header": header(ns), "child_frame_id": child, "transform": inside}

        nothing = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0}
        both = [transform("goal", at, quaternion(0.01 * k)), transform("wheel", at, quaternion(0.0))]
        sent.append(("/tf", kind, at + 999, {"transforms": both}))
        seen = transform("seen", at + 7_000_001, nothing if lost else quaternion(0.01 * k))
        sent.append(("/tf", kind, at + 9_000_000, {"transforms": [seen]}))
    entry = 'topic = "/tf"\ntime = "header.stamp"\npose = "transform"\nwhere = {{ child_frame_id = "{}" }}\n'
    run = assert_equal(
        written(tmp_path, f"[command]\n{entry.format('goal')}[sensors.eye]\n{entry.format('seen')}", sent)
    )
    assert np.isnan(run.sensors["eye"].orientation).any()


def test_covariances_row_by_row(tmp_path: Path) -> None:
    """A pose's own variance scales its noise; one of 0, which is unknown, does not."""
    kind, sent = "geometry_msgs/msg/PoseWithCovarianceStamped", list[Sent]()
    for k, place in enumerate(MOTION):
        at, covariance = START + STEP * k, np.zeros(36)
        covariance[0] = (0.0, 1e-6, 9e-6)[k % 3]
        pose = {
            "pose": {"position": xyz(place), "orientation": quaternion(0.01 * k)},
            "covariance": covariance.tolist(),
        }
        for topic, ns in (("/goal", at), ("/seen", at + 3_000_000)):
            sent.append((topic, kind, ns, {"header": header(ns), "pose": pose}))
    entry = 'topic = "{}"\ntime = "header.stamp"\npose = "pose.pose"\n'
    noise = 'noise = { variance = "pose.covariance[0]", typical = 1e-6 }\n'
    run = f"[command]\n{entry.format('/goal')}[sensors.eye]\n{entry.format('/seen')}{noise}"
    read = assert_equal(written(tmp_path, run, sent))
    assert read.sensors["eye"].noise == pytest.approx(np.resize([1.0, 1.0, 3.0], 200))


def test_angles_that_go_on_over_a_turn(tmp_path: Path) -> None:
    """An array without a header as commands; joints that begin anew at 180 degrees go on from the commanded turn."""
    sent = list[Sent]()
    for k, angle in enumerate(TURN):
        at = START + STEP * k
        sent.append(("/go", "std_msgs/msg/Float64MultiArray", at, {"data": [9.0, math.degrees(angle + 2.0 * math.pi)]}))
        within = (angle + math.pi) % (2.0 * math.pi) - math.pi
        state = {
            "header": header(at + 5_000_000),
            "name": ["elbow"] if k != 50 else [],
            "position": [within][: k != 50],
        }
        sent.append(("/joint_states", "sensor_msgs/msg/JointState", at + 6_000_000, state))
    run = """
[command]
topic = "/go"
time = "log_time"
elbow = { column = "data[1]", unit = "deg" }
[sensors.encoder]
topic = "/joint_states"
time = "header.stamp"
elbow = { column = "position[elbow]", unit = "rad", turn_deg = 360.0 }
"""
    run_read = assert_equal(written(tmp_path, run, sent))
    assert np.nanmax(run_read.sensors["encoder"].values["elbow"]) > 2.0 * math.pi


def test_trajectories_as_time_goes_by(tmp_path: Path) -> None:
    """A new trajectory ends the one before when it begins, not when it comes; one without points stops it."""
    kind, sent = "trajectory_msgs/msg/JointTrajectory", list[Sent]()

    def trajectory(sent_at: float, begin: float, points: Sequence[tuple[float, list[float]]]) -> None:
        ns = START + round(begin * 1e9)
        rest = {"velocities": [], "accelerations": [], "effort": []}
        made = [{**rest, "positions": at, "time_from_start": stamp(round(time * 1e9))} for time, at in points]
        fields = {"header": header(ns), "joint_names": ["lift", "slide"], "points": made}
        sent.append(("/go", kind, START + round(sent_at * 1e9), fields))

    trajectory(0.0, 0.1, [(0.0, [0.0, 1.0]), (4.0, [4.0, 1.0])])
    trajectory(0.5, 1.0, [(2.0, [5.0, 0.0])])
    trajectory(1.9, 2.0, [])
    for k in range(200):
        state = {"header": header(START + STEP * k), "name": ["lift"], "position": [0.1]}
        sent.append(("/joint_states", "sensor_msgs/msg/JointState", START + STEP * k, state))
    run = """
[command]
topic = "/go"
time = "path.time_ns"
lift = { column = "path.position[lift]", unit = "rad" }
slide = { column = "path.position[slide]", unit = "rad" }
[sensors.encoder]
topic = "/joint_states"
time = "header.stamp"
lift = { column = "position[lift]", unit = "rad" }
"""
    assert len(assert_equal(written(tmp_path, run, sent)).command.stamp) > 400


def test_commands_between_commands(tmp_path: Path) -> None:
    """A controller that goes on in steps of 4 ms, but not over a pause; the filter takes them without a word."""
    sent = list[Sent]()
    for k, place in enumerate(MOTION):
        at = START + STEP * (k + 30 * (k > 120)) + 1000 * (k % 7)
        pose = {"position": xyz(place), "orientation": quaternion(0.3 * math.sin(k / 9.0))}
        sent.append(("/go", "geometry_msgs/msg/PoseStamped", at, {"header": header(at), "pose": pose}))
        seen = at + 3_000_000
        sent.append(("/eye", "geometry_msgs/msg/PoseStamped", seen, {"header": header(seen), "pose": pose}))
    entry = 'time = "header.stamp"\npose = "pose"\n'
    run = f'[command]\ntopic = "/go"\n{entry}interpolation_ms = 4.0\n[sensors.eye]\ntopic = "/eye"\n{entry}'
    path = written(tmp_path, run, sent)
    assert len(assert_equal(path).command.stamp) == 5 * (len(TIME) - 2) + 2
    (tmp_path / "arm.toml").write_text(bag_files.ARM.replace("20.0", "4.0"))
    (tmp_path / "fusion.toml").write_text(bag_files.FUSION.partition("[sensors.")[0] + "[sensors.eye]\nsd_mm = 1.0\n")
    config, notices = pf.FusionConfig.load(tmp_path / "fusion.toml"), list[str]()
    live = pf.LiveEstimator(config, on_notice=notices.append)
    for event in streamed(path):
        values = {axis: event.values[axis] for axis in "xyz"}
        live.measurement(event.t, event.sensor, **values) if event.sensor else live.command(event.t, **values)
    assert [one for one in notices if "larger than expected" not in one] == []


@given(st.lists(st.floats(-20.0, 20.0) | st.just(math.nan), max_size=30), st.sampled_from([90.0, 360.0]))
def test_an_angle_goes_on_as_numpy_has_it(angle: list[float], turn: float) -> None:
    """Number by number as the whole column at once, to the bit."""
    column = {"column": "a", "unit": "rad", "turn_deg": math.radians(turn)}  # as tables are in SI
    listed = manifest.of_tables({"command": {"file": "f", "topic": "/t", "time": "log_time", "elbow": column}})
    reader = Reader("", listed.command, {})
    events = [event for k, one in enumerate(angle) for event in reader.events(SimpleNamespace(a=one), k)]
    found = [event.values["elbow"] for event in events]
    assert np.array_equal(found, unwrapped(np.array(angle), math.radians(turn)), equal_nan=True)


@pytest.mark.parametrize("time", [{"column": "t", "unit": "s", "counter": "seq"}, {"rate_hz": 100}])
def test_what_no_stream_has_is_refused(time: dict[str, Any]) -> None:
    """Stamps that only a whole log tells."""
    entry = {"file": "f", "topic": "/a", "time": time, "x": {"column": "x", "unit": "m"}}
    with pytest.raises(ConfigError, match="a running robot's messages need stamps"):
        Reader("", manifest.of_tables({"command": entry}).command, {})


@pytest.mark.parametrize(
    ("time", "message", "ns"),
    [
        ({"column": "log_time", "shift_s": 0.25}, {}, 1_250_000_000),
        ({"column": "t_ms", "shift_s": -0.5}, {"t_ms": 2500}, 2_000_000_000),
        ({"column": "t_s", "shift_s": 1.0}, {"t_s": 0.1234567891}, 1_123_456_789),
        ({"column": "s", "nanoseconds": "n", "shift_s": 1.0}, {"s": 3, "n": 5}, 4_000_000_005),
    ],
)
def test_stamps_in_ns_with_a_shift(time: dict[str, Any], message: dict[str, Any], ns: int) -> None:
    """Whole numbers and decimals in their unit, two numbers, and when a message was received, here 1 s."""
    entry = {"file": "f", "topic": "/t", "time": time, "x": {"column": "x", "unit": "m"}}
    reader = Reader("", manifest.of_tables({"command": entry}).command, {})
    (event,) = reader.events(SimpleNamespace(x=0.1, **message), 1_000_000_000)
    assert event.t == ns
