"""Messages of bags: MCAP, ROS 1 (``.bag``) and ROS 2 (a folder, ``.mcap``, ``.db3``).

Files are read from the front, a chunk at a time, and only messages that are asked for are decoded. So what was cut off,
or has no index, is read as far as it goes, and a large file needs little memory.

MCAP is read by the format's own library, and messages of ROS are decoded by rosbags, after trials on the same files:
rosbags' readers refuse what was cut off and what is not from ROS, and inflate chunks without a limit; Rerun's reader of
MCAP maps the whole file into memory (1.2 GB resident for a file of 1.1 GB; 0.14 GB here), does not end on a chunk that
is damaged, and knows neither JSON nor ROS 1 nor files without chunks.
"""

from __future__ import annotations

import bz2
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeAlias, cast
from zlib import crc32

import msgspec

from ..errors import RunError, plural, reason

_LARGEST = 128 << 20  # bytes of a record or a chunk; recorders make chunks of about 1 MB
_DEEPEST = 32  # types within types of a message
_LONGEST_ARRAY = 10_000  # elements of an array of fixed length: decoders have a line of code for each
_LONGEST_DEFINITION = 1 << 18  # bytes; parsing takes time: that of a large type of MoveIt has 60 kB
_IDL = ("ros2idl", "omgidl")
_ZSTD = b"\x28\xb5\x2f\xfd"  # the beginning of a message that rosbag2 has compressed alone; no CDR begins like this

Message: TypeAlias = Mapping[str, Any]
Decoder: TypeAlias = Callable[[bytes], Message]


class Channel(NamedTuple):
    """How the messages of a topic are encoded, and the definition of their type in a language of definitions."""

    topic: str
    type: str
    encoding: str
    language: str
    definition: bytes


class Record(NamedTuple):
    """A message as it was recorded, at ``time`` [ns]."""

    channel: Channel
    time: int
    payload: bytes


@dataclass
class Faults:
    """What is wrong with a recording."""

    cut: bool = False  # whether it was cut off
    left_out: Counter[str] = field(default_factory=Counter[str])  # how many things of each kind could not be used
    first: dict[str, str] = field(default_factory=dict[str, str])  # of each kind, what was wrong with the first

    def leave_out(self, what: str, error: Exception) -> None:
        """Count something that cannot be used."""
        self.left_out[what] += 1
        self.first.setdefault(what, reason(error))

    def notes(self, name: str) -> list[str]:
        """A sentence for each fault of the recording of that name."""
        cut = [f"{name}: the recording was cut off: read as far as it goes"] if self.cut else []
        return cut + [f"{name}: {plural(n, what)} left out: {self.first[what]}" for what, n in self.left_out.items()]


# A library says in its own way that bytes are not what they should be.
DAMAGE = (
    *(ValueError, RuntimeError, LookupError, TypeError, AttributeError, AssertionError, OverflowError),
    *(EOFError, struct.error, msgspec.MsgspecError),
)


# Decoders: from bytes to fields.


def decoder_of(channel: Channel) -> Decoder:
    """What decodes the messages of a channel into their fields."""
    match channel.encoding:
        case "cdr" | "ros1":
            return _ros_decoder(channel)
        case "protobuf":
            return _protobuf_decoder(channel)
        case "json":
            return msgspec.json.Decoder(dict[str, Any]).decode
        case other:
            accepted = "accepted: cdr, ros1, json, protobuf"
            raise ValueError(f"topic '{channel.topic}': messages are encoded as '{other}'; {accepted}")


def _protobuf_decoder(channel: Channel) -> Decoder:
    from google.protobuf.message import DecodeError
    from mcap.records import Schema
    from mcap_protobuf.decoder import DecoderFactory

    schema = Schema(id=1, name=channel.type, encoding=channel.language, data=channel.definition)
    try:
        decode = DecoderFactory().decoder_for(channel.encoding, schema)
    except (TypeError, KeyError, DecodeError) as error:
        raise ValueError(f"topic '{channel.topic}': its definition is wrong: {reason(error)}") from None
    if decode is None:
        raise ValueError(f"topic '{channel.topic}': type {channel.type} has no definition in protobuf's language")

    def decoded(payload: bytes) -> Message:
        try:
            return fields_of(decode(payload)) or {}
        except DecodeError as error:
            raise ValueError(reason(error)) from None

    return decoded


def _ros_decoder(channel: Channel) -> Decoder:
    """What decodes messages of ROS 1 or 2 by the definition in the file.

    rosbags compiles it to Python; its parsers let nothing but identifiers and whole numbers through to the code.
    """
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
    from rosbags.typesys.msg import normalize_msgtype

    label, name, text = f"topic '{channel.topic}'", normalize_msgtype(channel.type), channel.definition.decode()
    if len(text) > _LONGEST_DEFINITION:
        raise ValueError(f"{label}: the definition of its type is longer than {_LONGEST_DEFINITION >> 10} kB")
    store = get_typestore(Stores.EMPTY if text.strip() else Stores.ROS2_HUMBLE)  # bags before 2023 hold no definitions
    try:
        if channel.language in _IDL:
            parts = re.split(r"^=+\nIDL: .*\n", re.sub(r"^#.*$", "", text, flags=re.MULTILINE), flags=re.MULTILINE)
            for part in filter(str.strip, parts):
                store.register(get_types_from_idl(part))
        elif text.strip():
            store.register(get_types_from_msg(text, name))
        _refuse_endless(store.fielddefs, name)
    except (TypesysError, SyntaxError, AssertionError, *DAMAGE) as error:
        raise ValueError(f"{label}: the definition of type {name} cannot be used: {reason(error)}") from None
    decode = store.deserialize_cdr if channel.encoding == "cdr" else store.deserialize_ros1

    def decoded(payload: bytes) -> Message:
        try:
            return fields_of(decode(_inflated(payload, "zstd") if payload.startswith(_ZSTD) else payload, name)) or {}
        except SerdeError as error:
            raise ValueError(reason(error)) from None

    return decoded


def _refuse_endless(types: Mapping[str, Any], name: str) -> None:
    """Refuse a type that holds itself or one without a definition, and arrays of a fixed length beyond reason."""
    from rosbags.interfaces import Nodetype

    checked = set[str]()

    def check(name: str, above: tuple[str, ...]) -> None:
        if name not in types:
            raise ValueError(f"{name} is not defined" if above else "there is none in the file")
        if name in above or len(above) > _DEEPEST:
            raise ValueError(f"{name} holds itself, or types nest more than {_DEEPEST} deep")
        for _, (kind, inner) in () if name in checked else types[name][1]:
            if kind == Nodetype.ARRAY and inner[1] > _LONGEST_ARRAY:
                raise ValueError(f"{name} has an array of {inner[1]} elements")
            if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                kind, inner = inner[0]
            if kind == Nodetype.NAME:
                check(inner, (*above, name))
        checked.add(name)

    check(name, ())


def fields_of(value: Any) -> Message | None:
    """The fields of a decoded message, also of one within a message; None for anything else."""
    if isinstance(value, Mapping):
        return cast(Message, value)
    if hasattr(value, "DESCRIPTOR"):  # protobuf: what can be absent, and is, is null
        fields = value.DESCRIPTOR.fields
        absent = {field.name for field in fields if field.has_presence and not value.HasField(field.name)}
        return {field.name: None if field.name in absent else getattr(value, field.name) for field in fields}
    if hasattr(value, "get_fields_and_field_types"):  # of a running ROS 2
        return {name: getattr(value, name) for name in value.get_fields_and_field_types()}
    if hasattr(value, "__msgtype__"):  # ROS, by rosbags
        return {name: part for name, part in cast(Message, vars(value)).items() if name != "__msgtype__"}
    return None


def plain(value: Any) -> Any:
    """A decoded value as what Arrow takes: messages as dictionaries, also within lists."""
    if (parts := fields_of(value)) is not None:
        return {str(name): plain(part) for name, part in parts.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [plain(element) for element in cast(Sequence[Any], value)]
    return float(value) if isinstance(value, int) and value >= 2**63 else value  # Arrow infers no unsigned integers


# Containers: from files to records.


def records_of(path: Path, topic: str | None, faults: Faults, seen: set[Channel]) -> Iterator[Record]:
    """The messages of a topic, or of all for None, in the order of the file or files; all channels go into ``seen``."""
    if path.is_dir():
        listed = sorted(path.iterdir())  # metadata.yaml says no more, and is missing where recording was cut off
        parts = [part for part in listed if part.suffix in (".mcap", ".db3")]
        if not parts:
            packed = any(part.suffix == ".zstd" for part in listed)
            advice = "; unpack its files first: zstd -d *.zstd" if packed else ""
            raise RunError(f"{path}: cannot be read: no bag of ROS 2, the folder has no .mcap and no .db3{advice}")
        for part in parts:
            yield from records_of(part, topic, faults, seen)
    elif path.suffix == ".db3":
        yield from _sqlite_records(path, topic, faults, seen)
    else:
        records = _ros1_records if path.suffix == ".bag" else _mcap_records
        with path.open("rb") as file:
            every = records(_Whole(file, path.stat().st_size), faults, seen)
            yield from (record for record in every if topic in (None, record.channel.topic))


class _Whole:
    """A file of ``size`` bytes, of which ``left`` are not read yet.

    Its reads give all that was asked for or nothing, so that nothing torn is taken for whole.
    """

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self.size, self.left = file, size, size

    def read(self, size: int) -> bytes:
        """The next ``size`` bytes, or none where there are fewer: a length that lies allocates nothing."""
        if not 0 <= size <= self.left:
            return b""
        if size > _LARGEST:
            raise ValueError(f"a record has {size >> 20} MB; up to {_LARGEST >> 20} MB are accepted")
        self.left -= size
        return self._file.read(size)


def _inflated(data: bytes, compression: str, most: int = _LARGEST) -> bytes:
    """The first ``most`` + 1 bytes of what was compressed."""
    if most > _LARGEST:
        raise ValueError(f"a chunk of {most >> 20} MB; up to {_LARGEST >> 20} MB are accepted")
    match compression:
        case "" | "none":
            return data
        case "zstd":
            import zstandard

            return zstandard.ZstdDecompressor(max_window_size=_LARGEST).stream_reader(data).read(most + 1)
        case "lz4":
            from lz4.frame import LZ4FrameDecompressor  # pyright: ignore

            return cast(Any, LZ4FrameDecompressor)().decompress(data, max_length=most + 1)
        case "bz2":
            return bz2.BZ2Decompressor().decompress(data, max_length=most + 1)
        case _:
            raise ValueError(f"unknown compression '{compression}'")


def _mcap_records(source: _Whole, faults: Faults, seen: set[Channel]) -> Iterator[Record]:
    from mcap import records

    schemas, channels = {0: records.Schema(0, b"", "", "without a type")}, dict[int, Channel]()
    for piece in _mcap_pieces(source, faults):
        match piece:
            case records.Schema():
                schemas[piece.id] = piece
            case records.Channel() if piece.schema_id in schemas:
                of = schemas[piece.schema_id]
                channel = Channel(piece.topic, of.name, piece.message_encoding, of.encoding, of.data)
                channels[piece.id] = channel
                seen.add(channel)
            case records.Message() if piece.channel_id in channels:
                yield Record(channels[piece.channel_id], piece.log_time, piece.data)
            case records.Message():
                faults.leave_out("message without a channel", ValueError("the channel was lost"))
            case _:
                pass


def _mcap_pieces(source: _Whole, faults: Faults, *, inside: bool = False) -> Iterator[Any]:
    """Records of the format up to the end of the data; those of chunks, too."""
    from mcap.exceptions import EndOfFile
    from mcap.records import Chunk, DataEnd
    from mcap.stream_reader import StreamReader

    reader = StreamReader(cast(Any, source), skip_magic=inside, emit_chunks=True, record_size_limit=_LARGEST)
    try:
        for record in reader.records:
            if isinstance(record, DataEnd):
                return
            if not isinstance(record, Chunk):
                yield record
            elif not inside:
                size, crc = record.uncompressed_size, record.uncompressed_crc
                yield from _inside(_mcap_pieces, faults, record.data, record.compression, size, crc)
    except EndOfFile:
        if inside and source.left:
            raise ValueError("it ends within a record") from None
        faults.cut = faults.cut or not inside


def _inside(
    pieces: Callable[..., Iterator[Any]], faults: Faults, data: bytes, compression: str, size: int, crc: int = 0
) -> list[Any]:
    """The pieces of a chunk: all of them, or none if it is damaged, or not what its head says."""
    try:
        inside = _inflated(data, compression, size)
        if len(inside) != size:
            raise ValueError("it is not as long as it claims to be")
        if crc and crc32(inside) != crc:
            raise ValueError("its checksum is wrong")
        return list(pieces(_Whole(BytesIO(inside), size), faults, inside=True))
    except Exception as error:  # bytes that are not what they should be: every library has its own errors for that
        faults.leave_out("chunk", error)
        return []


def _ros1_records(source: _Whole, faults: Faults, seen: set[Channel]) -> Iterator[Record]:
    from rosbags.rosbag1.reader import Header, RecordType, normalize

    if source.read(13) != b"#ROSBAG V2.0\n":
        raise ValueError("not a bag of ROS 1, version 2.0")
    channels = dict[int, Channel]()
    for head, data in _ros1_pieces(source, faults):
        match head.get_uint8("op"):
            case RecordType.CONNECTION:
                more = Header.read(BytesIO(struct.pack("<L", len(data)) + data))
                name, kind = normalize(head.get_string("topic")), more.get_string("type")
                channel = Channel(name, kind, "ros1", "ros1msg", more["message_definition"])
                channels[head.get_uint32("conn")] = channel
                seen.add(channel)
            case RecordType.MSGDATA if head.get_uint32("conn") in channels:
                yield Record(channels[head.get_uint32("conn")], head.get_time("time"), data)
            case RecordType.MSGDATA:
                faults.leave_out("message without a connection", ValueError("the connection was lost"))
            case _:
                pass


def _ros1_pieces(source: _Whole, faults: Faults, *, inside: bool = False) -> Iterator[tuple[Any, bytes]]:
    """Head and data of each record of the format; of those in chunks, too."""
    from rosbags.rosbag1.reader import Header, ReaderError, RecordType, read_bytes, read_uint32

    while source.left:
        try:
            head = Header.read(cast(Any, source))
            data = read_bytes(cast(Any, source), read_uint32(cast(Any, source)))
        except ReaderError:
            if inside:
                raise
            faults.cut = True
            return
        kind = head.get_uint8("op")
        if kind == RecordType.BAGHEADER:  # says where the index is; 0 until the recorder ends
            faults.cut = faults.cut or not 0 < head.get_uint64("index_pos") < source.size
        if kind == RecordType.CHUNK and not inside:
            yield from _inside(_ros1_pieces, faults, data, head.get_string("compression"), head.get_uint32("size"))
        elif kind != RecordType.CHUNK:
            yield head, data


def _has_lost_pages(path: Path) -> bool:
    """Whether a database is shorter than its head says, which SQLite itself does not always notice."""
    with path.open("rb") as file:
        head = file.read(32)
    if len(head) < 32:
        raise ValueError("not a bag of ROS 2: no database")
    (page,), (pages,) = struct.unpack_from(">H", head, 16), struct.unpack_from(">I", head, 28)
    page, length = 65536 if page == 1 else page, path.stat().st_size  # sqlite.org/fileformat.html, 1.3
    if page and length % page:
        copied = f"head -c {length - length % page} {path.name} > saved.db3"
        cut = "the recording was cut off within a page; what is there can be read from a copy of whole pages"
        raise RunError(f"{path}: {cut}: {copied}")
    return length < page * pages


def _sqlite_records(path: Path, topic: str | None, faults: Faults, seen: set[Channel]) -> Iterator[Record]:
    import sqlite3

    journal = path.with_name(f"{path.name}-wal")
    if journal.exists() and journal.stat().st_size:
        advice = f'put them in first: sqlite3 {path.name} "pragma wal_checkpoint(truncate)"'
        raise RunError(f"{path}: its last messages are still in {journal.name}; {advice}")
    faults.cut |= _has_lost_pages(path)
    address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    with closing(sqlite3.connect(address, uri=True)) as database:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LARGEST)
        database.execute("PRAGMA trusted_schema = OFF")
        if faults.cut:  # what SQLite's own .recover does to read what is there; nothing is written
            database.execute("PRAGMA writable_schema = ON")
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not tables.issuperset(("topics", "messages")):
            raise ValueError("not a bag of ROS 2: it has no tables 'topics' and 'messages'")
        definitions = dict[str, tuple[str, bytes]]()
        if "message_definitions" in tables:  # since 2023
            columns = "topic_type, encoding, encoded_message_definition"
            for kind, language, text in database.execute(f"SELECT {columns} FROM message_definitions"):
                definitions[str(kind)] = str(language), str(text).encode()
        channels = dict[int, Channel]()
        for number, name, kind, encoding in database.execute("SELECT id, name, type, serialization_format FROM topics"):
            channels[number] = Channel(str(name), str(kind), str(encoding), *definitions.get(str(kind), ("", b"")))
        seen.update(channels.values())
        wanted = [number for number, channel in channels.items() if topic in (None, channel.topic)]
        places = ", ".join("?" * len(wanted))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({places})"
        try:
            for number, time, data in database.execute(query, wanted):
                if isinstance(time, int) and isinstance(data, bytes):
                    yield Record(channels[number], time, data)
                else:
                    faults.leave_out("row", ValueError("it holds no time and bytes"))
        except sqlite3.DatabaseError:
            faults.cut = True
