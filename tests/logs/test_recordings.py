"""Recordings by others' libraries: the same numbers as in CSV, and one clear line for whatever is wrong with them."""

import os
import sqlite3
import struct
import subprocess
import sys
import tracemalloc
from contextlib import closing
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, DataEnd, Header, Message, Schema

import bag_files
import pumafuse as pf
from bag_files import KINDS, motion, written
from executable import refused
from pumafuse.errors import PumafuseError, RunError
from pumafuse.logs import entities, recordings, tables
from pumafuse.logs.entities import recording_of
from refusals import one_line


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> pf.FusionConfig:
    folder = tmp_path_factory.mktemp("config")
    return pf.FusionConfig.load(bag_files.configured(folder))


@pytest.fixture(scope="module")
def expected(config: pf.FusionConfig, tmp_path_factory: pytest.TempPathFactory) -> pf.Estimates:
    folder = tmp_path_factory.mktemp("csv")
    (folder / "run.toml").write_text(bag_files.csv(folder, motion()))
    return pf.fuse(pf.Run.read(folder), config)


@pytest.mark.parametrize(
    "kind",
    [
        *("mcap-lz4", "json", "protobuf", "db3-zstd", "mcap-folder", "bag-bz2", "bag-lz4", "rrd"),
        *(pytest.param(kind, marks=pytest.mark.long) for kind in ("mcap", "mcap-plain", "db3", "bag")),
    ],
)
def test_a_recording_fuses_bit_for_bit_like_the_same_data_in_csv(
    kind: str, config: pf.FusionConfig, expected: pf.Estimates, tmp_path: Path
) -> None:
    """Stamps keep their nanoseconds and numbers all their digits, whatever format and compression."""
    written(tmp_path, KINDS[kind], motion())
    est = pf.fuse(pf.Run.read(tmp_path), config)
    assert np.array_equal(est.time, expected.time)
    for axis in "xyz":
        for name in ("position", "position_sd", "velocity"):
            found, other = getattr(est[axis], name), getattr(expected[axis], name)
            assert np.array_equal(found, other, equal_nan=True), (axis, name)
    assert est.measurements.counts() == expected.measurements.counts() == {"fused": 750}  # 150 · (3 + 1 + 1)
    assert est.notes == expected.notes


@pytest.mark.parametrize("kind", ["mcap", "protobuf", "bag", "rrd"])
def test_topics_are_listed_with_type_number_and_numeric_fields(kind: str, tmp_path: Path) -> None:
    """The listing says what is there: as many messages as were written, and the paths that read() takes."""
    samples = motion(20)
    path = written(tmp_path, KINDS[kind], samples)
    listed = {topic.name: topic for topic in recordings.topics(path)}
    for topic, mine in bag_files.topics(samples):
        found = listed[topic]
        assert found.count == len(mine) == 20
        table = recordings.read(path, topic)
        assert table.rows == 20
        for name in found.fields:
            table.column(name)
        if kind != "rrd":
            assert (found.first, found.last) == (mine[0].logged, mine[-1].logged)
    if KINDS[kind].manifest == bag_files.ROS:
        assert listed["/joints"].fields[-2:] == ("position[slide]", "position[lift]")
        assert {name: topic.type.replace("/msg/", "/") for name, topic in listed.items()} == {
            name: one.replace("/msg/", "/") for name, one in bag_files.TYPES.items()
        }


def test_rows_are_in_the_order_of_recording(tmp_path: Path) -> None:
    """Chunks of a file and files of a folder may overlap in time; what was recorded first comes first."""
    samples = motion(40)
    (tmp_path / "drive").mkdir()
    bag_files.mcap(tmp_path / "drive" / "drive_1.mcap", samples[::2])
    bag_files.mcap(tmp_path / "drive" / "drive_0.mcap", samples[1::2][::-1])
    table = recordings.read(tmp_path / "drive", "/level", ["data"])
    mine = [sample for sample in samples if sample.topic == "/level"]
    assert table.columns["data"].to_pylist() == [sample.numbers[0] for sample in mine]
    assert table.columns["log_time"].cast(pa.int64()).to_pylist() == [sample.logged for sample in mine]


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"topic": "/comand"}, "no topic '/comand'; did you mean '/command'? it has: /camera (geometry_msgs/msg/Point"),
        ({"entity": "/command"}, "the key is 'topic', not 'entity'"),
        ({"topic": "/command", "fields": ["pos.x"]}, "unknown column 'pos.x'; did you mean 'pose'?"),
        (
            {"topic": "/command", "fields": ["header.stamp"], "where": {"id": 3}},
            "unknown column 'id'; accepted: header",
        ),
    ],
)
def test_what_a_recording_does_not_have_is_answered_with_what_it_has(
    how: dict[str, Any], said: str, tmp_path: Path
) -> None:
    """Topics come with the types of their messages, fields with their neighbours."""
    path = written(tmp_path, KINDS["mcap"], motion(5))
    assert said in one_line(PumafuseError, lambda: tables.read(path, **how))


def test_an_entity_that_is_missing_is_answered_with_those_that_are_there(tmp_path: Path) -> None:
    """Entities come with their components; what is static is none of them."""
    path = written(tmp_path, KINDS["rrd"], motion(5))
    said = one_line(RunError, lambda: tables.read(path, entity="comand"))
    assert "no entity '/comand'; did you mean '/command'? it has: /camera (Scalars:scalars), /command (" in said
    assert "/note (TextLog:text)" in said
    assert "the key is 'entity', not 'topic'" in one_line(RunError, lambda: tables.read(path, topic="/command"))


def test_components_of_an_entity_are_called_by_the_last_part_of_their_names(tmp_path: Path) -> None:
    """A list of instances stays one where there is more than one; timelines are columns; equal names stay whole."""
    path = tmp_path / "some.rrd"
    with rr.RecordingStream("cell") as stream:
        stream.save(str(path))
        stream.set_time("sim", duration=1.5)
        stream.set_time("tick", sequence=7)
        stream.log("arm", rr.Scalars([0.1, 0.2]))
        stream.log("arm", rr.AnyValues(scalars=3.5, tick=4.5))
        stream.log("tool", rr.Transform3D(translation=[1.0, 2.0, 3.0]))
    arm = tables.read(path, entity="/arm")
    assert set(arm.columns) == {"log_time", "sim", "tick", "Scalars:scalars", "scalars"}
    assert tables.read(path, entity="tool").numbers("translation[1]", "_m")[0].tolist() == [2.0]


@pytest.mark.long
def test_a_recording_that_no_pipe_holds_at_once_is_read_right(tmp_path: Path) -> None:
    """Rows of 1000 numbers, 8 MB of them, come through bit for bit, whatever is logged beside them."""
    path, numbers = tmp_path / "wide.rrd", np.random.default_rng(3).normal(size=(1000, 1000))
    with rr.RecordingStream("cell") as stream:
        stream.save(str(path))
        for k in range(100):
            times, scalars = [rr.TimeColumn("t", duration=[0.0])], rr.Scalars.columns(scalars=[k])
            rr.send_columns(f"other/{k}", times, scalars, recording=stream)
        rows = rr.Scalars.columns(scalars=numbers.ravel()).partition([1000] * 1000)
        rr.send_columns("/wide", [rr.TimeColumn("t", duration=np.arange(1000))], rows, recording=stream)
    assert np.array_equal(tables.read(path, entity="/wide").columns["scalars"].to_pylist(), numbers)


CUT_OFF = {
    "mcap": ("mcap-lz4", lambda path: path),
    "bag": ("bag-lz4", lambda path: path),
    "db3": ("db3", lambda path: next(path.glob("*.db3"))),
}


@pytest.mark.parametrize("kind", CUT_OFF)
def test_what_was_cut_off_is_read_as_far_as_it_goes(kind: str, tmp_path: Path) -> None:
    """Wherever the end is missing: the rows before it, bit for bit, and a note; a line, where there are none."""
    name, file_of = CUT_OFF[kind]
    path = file_of(written(tmp_path, KINDS[name], motion(150)))
    whole, content = recordings.read(path, "/level", ["data"]).columns["data"].to_pylist(), path.read_bytes()
    found = []
    for end in np.linspace(0, len(content) - 1, 25).astype(int) // (4096 if kind == "db3" else 1):
        end *= 4096 if kind == "db3" else 1
        path.write_bytes(content[:end])
        try:
            table = recordings.read(path, "/level", ["data"])
        except RunError as error:
            assert len(str(error).splitlines()) == 1
            found.append(0)
        else:
            rows = table.columns["data"].to_pylist()
            # the pages of a database are not in the order of its rows
            assert rows == ([one for one in whole if one in rows] if kind == "db3" else whole[: table.rows])
            assert table.notes == (f"{path.name}: the recording was cut off: read as far as it goes",) or (
                table.rows == len(whole) and not table.notes
            )
            found.append(table.rows)
    assert found == sorted(found)
    assert len({rows for rows in found if rows}) > 5


def test_a_database_that_ends_within_a_page_says_how_to_read_what_is_there(tmp_path: Path) -> None:
    """SQLite would take zeros for the rest of the page, and with them wrong numbers."""
    path = next(written(tmp_path, KINDS["db3"], motion(150)).glob("*.db3"))
    content = path.read_bytes()
    path.write_bytes(content[:70_000])
    assert "head -c 69632 drive.db3 > saved.db3" in one_line(RunError, lambda: recordings.read(path, "/level"))
    path.write_bytes(content[:69_632])
    assert recordings.read(path, "/level").rows > 50


@pytest.mark.parametrize(
    "kind",
    [
        *("mcap-lz4", "json", "bag-bz2", "db3"),
        pytest.param("rrd", marks=pytest.mark.long),  # a process for each example
    ],
)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40, suppress_health_check=list(HealthCheck))
def test_bytes_that_are_wrong_are_never_more_than_a_line(kind: str, seed: int, tmp_path_factory: Any) -> None:
    """Some bytes of a file replaced by others: rows or one line; where the format has checksums, right rows."""
    folder = tmp_path_factory.getbasetemp() / f"wrong-{kind}"
    if not folder.exists():
        folder.mkdir()
        written(folder, KINDS[kind], motion(30))
    path = folder / KINDS[kind].name
    path = next(path.glob("*.db3")) if path.is_dir() else path
    draw, content = np.random.default_rng(seed), bytearray(path.read_bytes())
    for place in draw.integers(0, len(content), draw.choice([1, 20])):
        content[place] = draw.integers(256)
    wrong = path.with_stem("wrong")
    wrong.write_bytes(content)
    try:
        table = recordings.read(wrong, "/level")
    except RunError as error:
        assert len(str(error).splitlines()) == 1
        return
    finally:
        wrong.unlink()
    if "mcap" in kind:
        mine = {sample.numbers[0] for sample in motion(30)}
        assert mine.issuperset(table.columns["data"].to_pylist())


@pytest.mark.long
def test_a_file_that_aborts_the_reader_of_rerun_is_a_line(tmp_path: Path) -> None:
    """Rerun's reader ends its process on this file, the first 1147 bytes of a recording with byte 487 replaced."""
    damaged = Path(__file__).parent / "data" / "damaged.rrd"
    assert refused("init", damaged, "-o", tmp_path / "new").startswith(f"pumafuse: {damaged}: damaged: Rerun's reader ")


@pytest.fixture
def readers(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    found, start = [], subprocess.Popen

    def noted(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        found.append(start(*arguments, **options))
        return found[-1]

    monkeypatch.setattr(subprocess, "Popen", noted)
    return found


@pytest.mark.long
def test_no_process_outlives_what_it_reads(
    readers: list[subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It ends where all is read, where a part is enough, and at Ctrl-C; a small recording needs one only once."""
    path = written(tmp_path, KINDS["rrd"], motion(2000))  # more than a pipe holds
    recordings.read(path, "/level")
    assert recording_of(path, "/level", "robot_time", "").id == "take-7"
    assert len(readers) == 1
    monkeypatch.setattr(entities, "_SMALL", 0)
    recordings.read(path, "/level")
    assert recording_of(path, "/level", "robot_time", "").id == "take-7"

    def interrupted(_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pa.ipc, "open_stream", interrupted)
    with pytest.raises(KeyboardInterrupt):
        recordings.read(path, "/level")
    assert len(readers) == 4
    assert all(reader.returncode is not None for reader in readers)


def test_the_process_that_reads_imports_what_pumafuse_does(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Files of the folder that one works in are not taken for libraries; a library that is missing is named."""
    path, paths = written(tmp_path, KINDS["rrd"], motion(5)), os.environ.get("PYTHONPATH", "")
    for name in ("numpy", "pyarrow", "rerun", "pumafuse"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(entities, "_SMALL", 0)
    assert recordings.read(path, "/level").rows == 5
    (tmp_path / "old" / "rerun").mkdir(parents=True)
    (tmp_path / "old" / "rerun" / "__init__.py").touch()
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "old"), *filter(None, [paths])]))
    assert "pip install --upgrade rerun-sdk" in one_line(RunError, lambda: recordings.read(path, "/level"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert "its reader does not start" in one_line(RunError, lambda: recordings.read(path, "/level"))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    assert "does not start: No such file" in one_line(RunError, lambda: recordings.read(path, "/level"))


def _mcap(
    path: Path, *records: Any, definition: str = "float64 data\n", language: str = "ros2msg", encoding: str = "cdr"
) -> Path:
    """An MCAP file with a channel and records, as no writer would write them."""
    builder = RecordBuilder()
    builder.write(b"\x89MCAP0\r\n")
    schema = Schema(id=1, name="cell_msgs/msg/Level", encoding=language, data=definition.encode())
    channel = Channel(id=1, topic="/level", message_encoding=encoding, metadata={}, schema_id=1)
    for record in (Header(profile="ros2", library=""), schema, channel, *records, DataEnd(data_section_crc=0)):
        record.write(builder)
    path.write_bytes(builder.end())
    return path


def _message(number: float, payload: bytes | None = None) -> Message:
    data = b"\0\1\0\0" + struct.pack("<d", number) if payload is None else payload
    return Message(channel_id=1, log_time=bag_files.START_NS, data=data, publish_time=0, sequence=0)


def _chunk(data: bytes, compression: str, size: int) -> Chunk:
    return Chunk(compression, data, 0, 0, uncompressed_crc=0, uncompressed_size=size)


def _bomb(size: int) -> bytes:
    pressed = zstandard.ZstdCompressor().compressobj(size=size)
    return b"".join(pressed.compress(bytes(1 << 24)) for _ in range(size >> 24)) + pressed.flush()


LARGE = 1 << 28
BOMBS = {
    "claims what it has": lambda: _chunk(_bomb(LARGE), "zstd", LARGE),
    "claims less": lambda: _chunk(_bomb(LARGE), "zstd", 1000),
    "claims an exabyte": lambda: _chunk(zstandard.compress(bytes(1000)), "zstd", 1 << 60),
    "claims less, lz4": lambda: _chunk(lz4.frame.compress(bytes(LARGE)), "lz4", 1000),
    "claims more, lz4": lambda: _chunk(lz4.frame.compress(bytes(1000)), "lz4", 1 << 60),
}
PEAK = """
import resource, sys
from pathlib import Path
from pumafuse.logs import recordings
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sys.argv[3:]:
    table = recordings.read(Path(path), *sys.argv[1:2], sys.argv[2:3])
    print(table.rows, *table.notes, sep="\\n")
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)
"""


def _peak(topic: str, field: str, *paths: Path) -> tuple[list[str], int]:
    """The numbers of rows and the notes that reading gives, and the memory that it takes at most [bytes]."""
    command = [sys.executable, "-c", PEAK, topic, field, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    *lines, peak = done.stdout.splitlines()
    return lines, int(peak)


def test_a_chunk_that_inflates_beyond_reason_is_left_out(tmp_path: Path) -> None:
    """Whatever it claims, it takes little memory, and what is beside it is read."""
    bombs = {
        f"{name}.mcap": _mcap(tmp_path / f"{name}.mcap", _message(1.5), bomb(), _message(2.5))
        for name, bomb in BOMBS.items()
    }
    lines, peak = _peak("/level", "data", *bombs.values())
    assert lines[::2] == ["2"] * len(bombs)
    for name, note in zip(bombs, lines[1::2], strict=True):
        assert note.startswith(f"{name}: 1 chunk left out: ")
    assert peak < 200e6


IDL = f"""{"=" * 80}
IDL: cell_msgs/msg/Level
#include "cell_msgs/msg/Inside.idl"
module cell_msgs {{ module msg {{ struct Level {{ cell_msgs::msg::Inside data; }}; }}; }};
{"=" * 80}
IDL: cell_msgs/msg/Inside
module cell_msgs {{ module msg {{ struct Inside {{ double value; }}; }}; }};
"""


def test_definitions_in_idl_and_messages_of_ros_1_in_mcap_are_decoded(tmp_path: Path) -> None:
    """Recorders write either language, and tools convert bags of ROS 1 to MCAP."""
    path = _mcap(tmp_path / "idl.mcap", _message(1.5), definition=IDL, language="ros2idl")
    assert recordings.read(path, "/level").column("data.value").to_pylist() == [1.5]
    ros1 = _message(0.0, struct.pack("<IId", 7, 8, 1.5))
    path = _mcap(tmp_path / "1.mcap", ros1, definition="time t\nfloat64 data\n", language="ros1msg", encoding="ros1")
    assert recordings.read(path, "/level").columns["t"].to_pylist() == [{"sec": 7, "nanosec": 8}]
    path = _mcap(tmp_path / "other.mcap", _message(1.5), encoding="cbor")
    assert "encoded as 'cbor'; accepted: cdr, ros1" in one_line(RunError, lambda: recordings.read(path, "/level"))


def test_bags_without_definitions_have_those_of_ros_2_humble(tmp_path: Path) -> None:
    """Until 2023 a database had only the names of types; one that is not standard is a line."""
    path = next(written(tmp_path, KINDS["db3"], motion(5)).glob("*.db3"))
    with closing(sqlite3.connect(path)) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("UPDATE topics SET type = 'cell_msgs/msg/Level' WHERE name = '/level'")
        database.commit()
    assert recordings.read(path, "/command").column("pose.position.x").to_pylist()[0] == 0.0
    assert "definition of type cell_msgs/msg/Level" in one_line(RunError, lambda: recordings.read(path, "/level"))


NESTED = "\n".join(f"{'=' * 80}\nMSG: cell_msgs/C{k}\nC{k + 1} c\nC{k + 1} d" for k in range(60))
DEFINITIONS = {
    "": "there is none in the file",
    "cell_msgs/Other other\n": "cell_msgs/msg/Other is not defined",
    "Level inside\n": "holds itself",
    f"C0 c\n{NESTED}\n": "nest more than 32 deep",
    "string[4000000000] names\n": "has an array of 4000000000 elements",
    "float64 data; import os\n": "cannot be used",
    "float64 data\n" * 30_000: "is longer than 256 kB",
}


@pytest.mark.parametrize("definition", DEFINITIONS)
def test_a_definition_that_is_of_no_use_is_a_line(definition: str, tmp_path: Path) -> None:
    path = _mcap(tmp_path / "odd.mcap", _message(1.0), definition=definition)
    assert DEFINITIONS[definition] in one_line(RunError, lambda: recordings.read(path, "/level"))


def test_messages_that_cannot_be_decoded_are_left_out_and_counted(tmp_path: Path) -> None:
    """A message that is too short, and one with a list that is longer than itself, are two that are missing."""
    lying = b"\0\1\0\0" + struct.pack("<I", 2**32 - 1)
    path = _mcap(tmp_path / "odd.mcap", _message(1.0), _message(0.0, b"\0\1\0\0abc"), _message(2.0))
    table = recordings.read(path, "/level")
    assert table.columns["data"].to_pylist() == [1.0, 2.0]
    assert table.notes[0].startswith("odd.mcap: 1 message left out: ")
    path = _mcap(tmp_path / "odd.mcap", _message(0.0, lying), definition="float64[] data\n")
    assert "nothing that can be read; 1 message left out" in one_line(RunError, lambda: recordings.read(path, "/level"))


@pytest.mark.parametrize(
    ("ending", "content"),
    [
        *((".mcap", b""), (".bag", b"t_s,x_mm\n0,1\n"), (".db3", bytes(5000))),
        (".rrd", b"t_s,x_mm\n0,1\n"),  # a process for each
    ],
)
def test_a_file_that_is_not_what_its_ending_says_is_a_line(ending: str, content: bytes, tmp_path: Path) -> None:
    """Empty, text or zeros: the file is named, and nothing is written beside it."""
    path = tmp_path / f"drive{ending}"
    path.write_bytes(content)
    for call in (lambda: recordings.read(path, "/level"), lambda: recordings.topics(path)):
        assert one_line(RunError, call).startswith(f"{path}: ")
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


def test_paths_that_are_no_recordings_say_why(tmp_path: Path) -> None:
    """A file that is not there, a folder without a bag, one that is compressed as a whole, a journal beside it."""
    assert "no such file" in one_line(RunError, lambda: recordings.read(tmp_path / "none.mcap", "/level"))
    assert "no such file" in one_line(RunError, lambda: recordings.read(tmp_path / "none.rrd", "/level"))
    assert "no bag of ROS 2" in one_line(RunError, lambda: recordings.read(tmp_path, "/level"))
    (tmp_path / "drive_0.db3.zstd").write_bytes(b"")
    assert "zstd -d" in one_line(RunError, lambda: recordings.read(tmp_path, "/level"))
    path = next(written(tmp_path, KINDS["db3"], motion(5)).glob("*.db3"))
    path.with_name(f"{path.name}-wal").write_bytes(b"123")
    assert "wal_checkpoint" in one_line(RunError, lambda: recordings.read(path, "/level"))


def test_tables_cost_no_library_of_recordings(tmp_path: Path) -> None:
    (tmp_path / "run.toml").write_text(bag_files.csv(tmp_path, motion(5)))
    others = "{'mcap', 'rosbags', 'rerun', 'zstandard', 'lz4', 'google', 'sqlite3', 'pumafuse.logs.recordings'}"
    code = f"import sys, pumafuse as pf; pf.Run.read({str(tmp_path)!r}); print({others} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.long
def test_a_large_recording_takes_little_memory(tmp_path: Path) -> None:
    """Of 1 GB with images, the topic that is asked for is read in bounded memory, the images' stamps as well."""
    image = "uint32 width\nuint8[] data\n"
    path, draw = tmp_path / "large.mcap", np.random.default_rng(1)
    with path.open("wb") as file:
        writer = bag_files.Ros2Writer(file)
        kinds = (
            writer.register_msgdef("cell_msgs/msg/Image", image),
            writer.register_msgdef("a/msg/B", "float64 data\n"),
        )
        for k in range(1100):
            time = bag_files.START_NS + k * 10**7
            pixels = {"width": 1000, "data": draw.integers(0, 256, 10**6, dtype=np.uint8).tobytes()}
            writer.write_message("/camera", kinds[0], pixels, log_time=time)
            for j in range(10):
                writer.write_message("/level", kinds[1], {"data": k + j / 10}, log_time=time + j)
        writer.finish()
    assert path.stat().st_size > 1e9
    for topic, field, rows in (("/level", "data", "11000"), ("/camera", "width", "1100")):
        lines, peak = _peak(topic, field, path)
        assert lines == [rows]
        assert peak < 200e6


def test_stamps_of_images_in_a_rerun_recording_take_little_memory(tmp_path: Path) -> None:
    """Of 30 MB of images, their stamps alone stay in memory."""
    path, draw = tmp_path / "images.rrd", np.random.default_rng(1)
    with rr.RecordingStream("cell") as stream:
        stream.save(str(path))
        for k in range(30):
            stream.set_time("t", duration=k)
            stream.log("/camera", rr.Image(draw.integers(0, 256, (1000, 1000), dtype=np.uint8)))
    tracemalloc.start()
    try:
        assert recordings.read(path, "/camera", ["t"]).rows == 30
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 10e6
