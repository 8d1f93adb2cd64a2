"""One motion, written as recordings of many kinds by others' libraries, and as CSV."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from mcap.writer import CompressionType, Writer
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as Ros2Writer
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

START_NS = 1_700_000_000_123_456_789
JOINTS = ("lift", "slide")
TYPES = {
    "/command": "geometry_msgs/msg/PoseStamped",
    "/camera": "geometry_msgs/msg/PointStamped",
    "/joints": "sensor_msgs/msg/JointState",
    "/level": "std_msgs/msg/Float64",
}


@dataclass(frozen=True)
class Sample:
    """A message: its topic, stamp and time of recording [ns], and its numbers [m, of the level mm]."""

    topic: str
    stamp: int
    logged: int
    numbers: tuple[float, ...]


def motion(commands: int = 150) -> list[Sample]:
    """A smooth motion in x, y, z from rest: commands every 20 ms, three sensors that see all or one axis of it."""
    draw = np.random.default_rng(5)
    found = []
    for k in range(commands):
        stamp = START_NS + 20_000_000 * k
        path = np.array([0.3, 0.1, 0.05]) * (1.0 - np.cos(np.array([k / 20, k / 15, k / 25])))
        found.append(Sample("/command", stamp, stamp + 1_300_000, tuple(path.tolist())))
        seen = path + draw.normal(scale=1e-3, size=3)
        found.append(Sample("/camera", stamp + 7_000_000, stamp + 9_000_001, tuple(seen.tolist())))
        found.append(
            Sample("/joints", stamp + 3_000_000, stamp + 3_100_003, (9.9, float(path[2] + draw.normal(scale=1e-3))))
        )
        found.append(Sample("/level", stamp + 11_000_017, stamp + 11_000_017, (float(1e3 * seen[0]),)))
    return found


def csv(folder: Path, samples: list[Sample]) -> str:
    """A file for each topic; what run.toml has to say of them."""
    columns = {"/command": "x_m,y_m,z_m", "/camera": "x_m,y_m,z_m", "/joints": "other,z_m", "/level": "x_mm"}
    for topic, names in columns.items():
        rows = [
            ",".join(map(repr, (sample.logged if topic == "/level" else sample.stamp, *sample.numbers)))
            for sample in samples
            if sample.topic == topic
        ]
        (folder / f"{topic[1:]}.csv").write_text("\n".join([f"t_ns,{names}", *rows, ""]))
    return """
[command]
file = "command.csv"
time = "t_ns"
x = "x_m"
y = "y_m"
z = "z_m"
[sensors.camera]
file = "camera.csv"
time = "t_ns"
x = "x_m"
y = "y_m"
z = "z_m"
[sensors.encoder]
file = "joints.csv"
time = "t_ns"
z = "z_m"
[sensors.level]
file = "level.csv"
time = "t_ns"
x = "x_mm"
"""


def stamp(ns: int) -> dict[str, int]:
    """A time of ROS 2."""
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}


def header(ns: int, frame: str = "base") -> dict[str, Any]:
    """A header of ROS 2."""
    return {"stamp": stamp(ns), "frame_id": frame}


ROS = """
[command]
file = "{file}"
topic = "/command"
time = "header.stamp"
x = {{ column = "pose.position.x", unit = "m" }}
y = {{ column = "pose.position.y", unit = "m" }}
z = {{ column = "pose.position.z", unit = "m" }}
[sensors.camera]
file = "{file}"
topic = "/camera"
time = "header.stamp"
x = {{ column = "point.x", unit = "m" }}
y = {{ column = "point.y", unit = "m" }}
z = {{ column = "point.z", unit = "m" }}
[sensors.encoder]
file = "{file}"
topic = "/joints"
time = "header.stamp"
z = {{ column = "position[slide]", unit = "m" }}
[sensors.level]
file = "{file}"
topic = "/level"
time = "log_time"
x = {{ column = "data", unit = "mm" }}
"""


def _fields(sample: Sample) -> dict[str, Any]:
    """The fields of a ROS message. The order of joints changes from message to message, as drivers' may."""
    top = header(sample.stamp)
    point = dict(zip("xyz", sample.numbers, strict=False))
    turned = sample.logged // 1000 % 2 == 0
    names, values = list(JOINTS), list(sample.numbers)
    return {
        "/command": {
            "header": top,
            "pose": {"position": point, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}},
        },
        "/camera": {"header": top, "point": point},
        "/joints": {
            "header": top,
            "name": names[::-1] if turned else names,
            "position": values[::-1] if turned else values,
            "velocity": [],
            "effort": [],
        },
        "/level": {"data": sample.numbers[0]},
    }[sample.topic]


def definition(topic: str) -> str:
    """The definition of the messages of a topic, as ROS 2 writes it into a file."""
    return definition_of(TYPES[topic])


def definition_of(kind: str) -> str:
    """The definition of a type of messages, likewise."""
    return get_typestore(Stores.ROS2_HUMBLE).generate_msgdef(kind, ros_version=2)[0]


Sent = tuple[str, str, int, dict[str, Any]]  # topic, type, when it was recorded [ns], fields


def _ros2_mcap(path: Path, sent: Sequence[Sent], **options: Any) -> None:
    with path.open("wb") as file:
        writer = Ros2Writer(file, **options)
        kinds = dict.fromkeys(kind for _, kind, _, _ in sent)
        schemas = {kind: writer.register_msgdef(kind, definition_of(kind)) for kind in kinds}
        for topic, kind, time, fields in sent:
            writer.write_message(topic, schemas[kind], fields, time, time)
        writer.finish()


def mcap(path: Path, samples: list[Sample], **options: Any) -> None:
    """An MCAP file of ROS 2, by mcap-ros2-support."""
    _ros2_mcap(path, [(one.topic, TYPES[one.topic], one.logged, _fields(one)) for one in samples], **options)


def messages(path: Path, sent: Sequence[Sent]) -> None:
    """The same of any messages, in the order of their times."""
    _ros2_mcap(path, sorted(sent, key=lambda one: one[2]))


def _message(store: Any, kind: str, fields: dict[str, Any]) -> Any:
    """A message of rosbags from plain fields."""
    found = {}
    for name, (_, inner) in store.fielddefs[kind][1]:
        value = fields.get(name, 0)
        found[name] = _message(store, inner, value) if isinstance(value, dict) else value
        if isinstance(value, list) and not (value and isinstance(value[0], str)):
            found[name] = np.array(value, dtype=np.float64)
    return store.types[kind](**found)


def _bag(writer: Any, store: Any, serialise: Callable[[Any, str], Any], samples: list[Sample]) -> None:
    with writer:
        open_ = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in TYPES.items()}
        for sample in samples:
            kind = TYPES[sample.topic]
            data = serialise(_message(store, kind, _fields(sample)), kind)
            writer.write(open_[sample.topic], sample.logged, data)


def ros2(path: Path, samples: list[Sample], plugin: str, mode: str = "") -> None:
    """The folder of a ROS 2 bag, by rosbags."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[plugin])
    if mode:
        writer.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
    _bag(writer, store, store.serialize_cdr, samples)


def ros1(path: Path, samples: list[Sample], compression: str = "", chunk: int = 1 << 20) -> None:
    """A ROS 1 bag, by rosbags."""
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = rosbag1.Writer(path)
    writer.chunk_threshold = chunk
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    _bag(writer, store, store.serialize_ros1, samples)


FOXGLOVE = (
    ROS.replace("header.stamp", "timestamp").replace("position[slide]", "position[1]").replace("pose.position", "pose")
)


def _flat(sample: Sample) -> dict[str, Any]:
    sec, nsec = divmod(sample.stamp, 10**9)
    point = dict(zip("xyz", sample.numbers, strict=False))
    return {
        "timestamp": {"sec": sec, "nsec": nsec},
        "pose": point,
        "point": point,
        "position": list(sample.numbers),
        "data": sample.numbers[0],
    }


def json_mcap(path: Path, samples: list[Sample]) -> None:
    """An MCAP file of JSON messages, by mcap."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start("", "")
        schema = writer.register_schema("Sample", "jsonschema", b'{"type": "object"}')
        channels = {topic: writer.register_channel(topic, "json", schema) for topic in TYPES}
        for sample in samples:
            data = json.dumps(_flat(sample)).encode()
            writer.add_message(channels[sample.topic], sample.logged, data, sample.logged)
        writer.finish()


def protobuf_mcap(path: Path, samples: list[Sample]) -> None:
    """An MCAP file of protobuf messages, by mcap-protobuf-support."""
    file = descriptor_pb2.FileDescriptorProto(name="sample.proto", package="cell", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    kinds = descriptor_pb2.FieldDescriptorProto
    point = file.message_type.add(name="Point")
    for number, name in enumerate("xyz", 1):
        point.field.add(name=name, number=number, type=kinds.TYPE_DOUBLE, label=kinds.LABEL_OPTIONAL)
    whole = file.message_type.add(name="Sample")
    message = partial(whole.field.add, type=kinds.TYPE_MESSAGE, label=kinds.LABEL_OPTIONAL)
    message(name="timestamp", number=1, type_name=".google.protobuf.Timestamp")
    message(name="pose", number=2, type_name=".cell.Point")
    message(name="point", number=3, type_name=".cell.Point")
    whole.field.add(name="position", number=4, type=kinds.TYPE_DOUBLE, label=kinds.LABEL_REPEATED)
    whole.field.add(name="data", number=5, type=kinds.TYPE_DOUBLE, label=kinds.LABEL_OPTIONAL)
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file)
    made: Any = message_factory.GetMessageClass(pool.FindMessageTypeByName("cell.Sample"))
    with path.open("wb") as out:
        writer = ProtobufWriter(out)
        for sample in samples:
            sec, nsec = divmod(sample.stamp, 10**9)
            flat = _flat(sample) | {"timestamp": {"seconds": sec, "nanos": nsec}}
            writer.write_message(sample.topic, made(**flat), log_time=sample.logged, publish_time=sample.logged)
        writer.finish()


RRD = (
    ROS.replace("topic =", "entity =")
    .replace('"header.stamp"', '"robot_time"')
    .replace('"log_time"', '"robot_time"')
    .replace("pose.position.x", "scalars[0]")
    .replace("pose.position.y", "scalars[1]")
    .replace("pose.position.z", "scalars[2]")
    .replace("point.x", "scalars[0]")
    .replace("point.y", "scalars[1]")
    .replace("point.z", "scalars[2]")
    .replace("position[slide]", "scalars[1]")
    .replace('"data"', '"scalars"')
)


def rrd(path: Path, samples: list[Sample], *, recording: str = "take-7", timeline: str = "timestamp") -> None:
    """A recording of Rerun: an entity for each topic, on the timeline ``robot_time``, and a label on another entity."""
    with rr.RecordingStream("robot_cell", recording_id=recording) as stream:
        stream.save(str(path))
        rr.log("/command", rr.SeriesLines(names="command"), static=True, recording=stream)
        rr.log("/note", rr.TextLog("the door is open"), recording=stream)
        for topic in TYPES:
            mine = [sample for sample in samples if sample.topic == topic]
            times = np.array([sample.logged if topic == "/level" else sample.stamp for sample in mine])
            since = times - START_NS
            column = {
                "timestamp": rr.TimeColumn("robot_time", timestamp=times.astype("M8[ns]")),
                "duration": rr.TimeColumn("robot_time", duration=since.astype("m8[ns]")),
                "sequence": rr.TimeColumn("robot_time", sequence=since),
            }[timeline]
            values = np.array([sample.numbers for sample in mine])
            parts = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
            rr.send_columns(topic, [column], parts, recording=stream)


ARM = """
name = "lift"
update_period_ms = 20.0
delay_ms = 30.0
""" + "".join(
    f"""
[axes.{axis}]
plant = "first-order"
time_constant_ms = 40.0
"""
    for axis in "xyz"
)
FUSION = """
arm = "arm.toml"
[start]
offset_sd_mm = 2.0
[process]
input_noise_mm_rtHz = 0.05
drift_mm_rts = 0.2
[sensors.camera]
sd_mm = 1.0
[sensors.encoder]
sd_mm = 1.0
[sensors.level]
sd_mm = 2.0
latency_ms = 4.0
"""


def configured(folder: Path) -> Path:
    """The ``fusion.toml``, and its arm beside it, that fuses the motion."""
    (folder / "arm.toml").write_text(ARM)
    (folder / "fusion.toml").write_text(FUSION)
    return folder / "fusion.toml"


@dataclass(frozen=True)
class Kind:
    """A kind of recording: the name of a file of it, how it is written, and what run.toml says of it."""

    name: str
    write: Callable[[Path, list[Sample]], None]
    manifest: str


KINDS = {
    "mcap": Kind("drive.mcap", mcap, ROS),
    "mcap-lz4": Kind("drive.mcap", partial(mcap, compression=CompressionType.LZ4, chunk_size=5000), ROS),
    "mcap-plain": Kind("drive.mcap", partial(mcap, compression=CompressionType.NONE), ROS),
    "json": Kind("drive.mcap", json_mcap, FOXGLOVE),
    "protobuf": Kind("drive.mcap", protobuf_mcap, FOXGLOVE),
    "db3": Kind("drive", partial(ros2, plugin="SQLITE3"), ROS),
    "db3-zstd": Kind("drive", partial(ros2, plugin="SQLITE3", mode="MESSAGE"), ROS),
    "mcap-folder": Kind("drive", partial(ros2, plugin="MCAP"), ROS),
    "bag": Kind("drive.bag", ros1, ROS),
    "bag-bz2": Kind("drive.bag", partial(ros1, compression="BZ2"), ROS),
    "bag-lz4": Kind("drive.bag", partial(ros1, compression="LZ4", chunk=5000), ROS),
    "rrd": Kind("drive.rrd", rrd, RRD),
}


def written(folder: Path, kind: Kind, samples: list[Sample]) -> Path:
    """A run of one kind of recording in a folder; the path of the recording."""
    path = folder / kind.name
    kind.write(path, samples)
    (folder / "run.toml").write_text(kind.manifest.format(file=kind.name))
    return path


def topics(samples: list[Sample]) -> Iterator[tuple[str, list[Sample]]]:
    """The samples of each topic."""
    for topic in TYPES:
        yield topic, [sample for sample in samples if sample.topic == topic]
