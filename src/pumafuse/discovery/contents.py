"""What a log holds: its files or topics, their clocks, and their columns of positions."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as papq
from msgspec import structs

from ..arrays import NO_STAMP, FloatArray, IntArray, TimeArray, median
from ..errors import RunError, plural, printable
from ..logs import formats, recordings, tables
from ..logs.columns import LOG_TIME, Table, Topic, leaf, longest, numeric_paths, prefixes, sentinel, without
from ..logs.frames import CARTESIAN
from ..logs.manifest import ERROR, Time, is_error
from ..logs.recordings import PATH, PATH_TIME
from ..logs.source import Source, standing_clock
from ..logs.stamps import packets
from ..units import TIMES, Kind, divisor, ending, kind_of, si_of, unwrapped, wraps
from . import names
from .orientations import QUATERNION, Attitude, are_units, attitudes_in

_TABLES = (".csv", ".csv.gz", ".tsv", *tables.JSON_LINES, ".parquet")
_ACCEPTED = "accepted: CSV, JSON, Parquet, .xlsx, .mat, .npy, .npz, MCAP, bags of ROS, .ulg, .rrd"
_CONVERTED = {
    **dict.fromkeys((".xls", ".ods"), "save it as .xlsx, or as CSV"),
    **dict.fromkeys((".pkl", ".pickle"), "in Python: pandas.read_pickle(FILE).to_parquet('log.parquet')"),
    ".feather": "in Python: pandas.read_feather(FILE).to_parquet('log.parquet')",
    **dict.fromkeys((".h5", ".hdf5", ".hdf"), "in Python: numpy.savez('log.npz', **{name: array of h5py.File(FILE)})"),
}
_TEXTS = (".txt", ".dat", ".lvm")  # tables, too; in a folder they may be anything
_MOST_PARTS = 200  # files or topics
_MOST_COLUMNS = 200  # of positions in one of them
_MOST_READ = 2_000  # columns of one of them
_FEWEST_ROWS, _MANY_ROWS = 10, 100  # so many tell a clock by nothing but that they rise
_GAP = 5.0  # times the typical interval
_IN_ORDER = 0.95  # share of rows, or of blocks, of a clock that are not before the row or block above
_BLOCK = 20  # rows; who writes from several threads writes some of them out of order
_OF_TICK = 0.2  # of a tick, by which ticks of a clock differ: those of a loop that sleeps
_MOST_LEFT = 0.5  # share of what a clock has told, from which it may begin anew
_MOST_KEYS, _IN_TURNS = 40, 0.3  # axes and sources in rows of their own; share of rows that are another's than before
RANGES: dict[Kind, tuple[str, str, float]] = {  # small and large unit, and beyond which number it is the large one
    "length": ("m", "mm", 10.0),
    "angle": ("rad", "deg", 2.0 * math.pi),
}
_USUALLY = 0.995  # share of the values of a column, among which there is none that leaps away
_NUMBER = re.compile(r"\[?\d+\]?$")  # of a column in a list
_OF_JOINT, _NAMED = re.compile(r"positions\[(\d+)\]$"), re.compile(r"(|.*\.)name(\d+)")
_EPOCHS = {"s": (1e9, 4e9), "ms": (1e12, 4e12), "us": (1e15, 4e15), "ns": (1e18, 4e18)}  # from 2001 to 2096
_INTERVALS = {"s": 2.0, "ms": 2e3, "us": 2e6}  # rows of a robot's log are 2 ms to 2 s apart; shorter: a finer unit
_SLOW, _LONGEST_STROKE = 0.05, 60.0  # of these, from which the unit may be a finer one; s that a robot's stroke takes
_DAYS = ((2e4, 8e4), (7e5, 8e5))  # since 1899 or, as MATLAB counts, since the year 0: from 1954 or 1917 on
_TICKS = ((1.2e17, 1.6e17), (6.27e17, 6.67e17))  # since 1601 or, as .NET counts, since the year 1: from 1981 or 1988 on
_FINEST_DAY = 2.5e-5  # days, 2 s: rows of a clock that counts seconds are never so near
_EVEN = 0.1  # share by which most steps of a counter may differ from the usual one
_LONGEST_WAIT = 3.0  # packets, that a row waits: of rows that come in bursts by themselves some wait longer
_ROUNDED, _FLOAT32 = 1.5e-6, 1.2e-7  # s, of stamps in us; share, of stamps in float32
_ALIKE_SPANS = 1.2  # factor between the spans that two clocks of a table tell
_BOTH_WAYS = 0.5  # steps back for each step on, from which a column is no clock
_GUESSED, _ANOTHER = ("interval", "motion"), "another clock"  # by which the unit of a clock is known: hardly, or well
_SHARED = 0.5  # of the time that two tables tell, which both do if they are of one time: units are 1000 apart
_OF_STEP = 0.01  # by which no step of a clock that was counted differs from the others
_METRES = names.words_in(
    "Pose PoseStamped PoseWithCovarianceStamped Point PointStamped Odometry TransformStamped TFMessage tfMessage"
)
# s, over which a way is compared with what a velocity adds up to: beyond the digits of a position, within a motion.
_OF_WAY = 0.1
# Shares of the variance of the ways that a velocity explains as it is, as a correlation of 0.95 does, and the most that
# the other way round may: on a circle at 1 rad/s each coordinate is the velocity of the other.
_IS_VELOCITY, _EITHER = 0.9, 0.5
_MOST_WAYS = 5_000  # that are compared with what adds up to them
_TRIAL = re.compile(r"[^\[]*\[(\d+)\]")  # of a list of trials
_ECHO = re.compile(r"^field\.(transforms0\.)?")
_ECHOED = re.compile(r"field\..*(position|translation|point)\.[xyz]$")  # of a message by `rostopic echo -p`: in m, too
_RADIANS = ("JointState", "JointTrajectory", "JointTrajectoryControllerState")
_OTHER_TYPES = names.words_in(
    "Image CompressedImage CameraInfo PointCloud2 LaserScan Imu Log DiagnosticArray Clock Wrench WrenchStamped"
    " ParameterEvent Joy OccupancyGrid MarkerArray"
)
_VELOCITIES = names.words_in("Twist TwistStamped TwistWithCovariance TwistWithCovarianceStamped")
RESTS = "always"  # what a column is that never changes
_SPEEDS = names.words_in("velocity velocities vel speed twist rpm rps mps kmh")  # why columns are no positions
ARE_SPEEDS = (
    "{} are velocities, and commands must be positions: integrate them along the measured heading, as docs/own-log.md"
    " does under 'Commands that are velocities'"
)
_ARE_VELOCITIES, _UNDECODED = "velocities, no positions", "its messages cannot be decoded"
_OF_FRAME = ["header", "child_frame_id", "transform"]  # of a transform
_PX4 = "PX4"  # whose numbers are in SI units; of its hundred topics those have positions that are called so:
_PX4_TOPICS = names.words_in("position attitude odometry trajectory pose gimbal joint joints angle angles servo")
_PX4_OTHERS = names.words_in("gps global estimator status rates triplet sensor selector")  # and by none of these
_ELEMENT = re.compile(r"(.*)\[(\d+)\]")
_TOLD = {"command", "reference"}  # roles in a table by which it is a run of its own, where others are beside them
_CHILD = "child_frame_id"
_BASES = names.words_in("base world map odom root origin")  # words of frames that stand still
_HANDS = names.TOOLS | names.words_in("hand gripper")
_NUMBERS = re.compile(r"\d+")  # as in tool0_controller
_STREAM_NS = 250_000_000  # between trajectories of one point, up to which they are commands that are sent as they act


@dataclass(frozen=True)
class Clock:
    """The stamps of a part."""

    time: Time
    basis: str  # how the unit is known, in words
    stamp: TimeArray  # int64 ns, (rows,)
    notes: tuple[str, ...] = ()  # what was wrong with them, a sentence each
    doubt: str = ""  # what may be wrong with them, as a question; empty: nothing
    counts: bool = False  # whether they may as well count the rows

    @staticmethod
    def of(table: Table, time: Time, basis: str, doubt: str = "") -> Clock:
        """The clock of a table."""
        stamp, notes = time.stamps(table)
        return Clock(time, basis, stamp, tuple(notes), doubt)


@dataclass(frozen=True)
class Signal:
    """A column of positions."""

    column: str  # its name or field path
    axis: str  # what it seems to be called
    unit: str  # 'mm', 'rad', …
    basis: str  # how the unit is known: 'name', 'type', 'turn', or 'range', which is a guess
    plain: FloatArray  # its numbers in that unit, (rows,)
    turns: bool = False  # whether it is an angle that begins anew after each turn
    has_velocity: bool = False  # whether another column adds up to it
    # in which of the rows it is this axis, where others are in rows of their own
    where: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def name(self) -> str:
        """Its name: that of its column, behind what tells which rows are its own."""
        return _called(self.column, self.where)

    @property
    def value(self) -> FloatArray:
        """Its numbers in m or rad, (rows,); angles go on beyond a turn."""
        value = si_of(self.plain, f"_{self.unit}")
        return unwrapped(value) if self.turns else value


@dataclass(frozen=True)
class Part:
    """A table of a log: a file, a topic or an entity."""

    file: Path
    topic: str = ""  # which topic of it
    entity: str = ""  # which entity of it
    where: Mapping[str, Any] = field(default_factory=dict[str, Any])  # which of its rows
    type: str = ""  # of its messages; empty of a table
    rows: int = 0
    clock: Clock | None = None  # its stamps; None: none was found
    signals: tuple[Signal, ...] = ()  # its columns of positions
    # its other columns of numbers, and why they are none
    left_out: Mapping[str, str] = field(default_factory=dict[str, str])
    notes: tuple[str, ...] = ()  # what is to be said of it
    attitudes: tuple[Attitude, ...] = ()  # its orientations, each beside x, y, z of the same source

    @property
    def label(self) -> str:
        """What a person calls it."""
        return self.topic or self.entity or self.file.name

    @property
    def stem(self) -> str:
        """Its name without the endings of files."""
        frame = [str(value) for column, value in self.where.items() if column.endswith(_CHILD)]
        return "_".join([self.topic or self.entity or self.file.name.split(".")[0], *frame])


def parts_of(log: Path, rate: float = 0.0) -> list[Part]:
    """What a log has: a table, a recording, or a folder of them; ``rate`` is that of rows without stamps [Hz], or 0."""
    parts, texts = list[Part](), list[Part]()
    for path in _files(log):
        is_known = path.name.endswith(_TABLES) or formats.has_tables(path) or tables.is_recording(path)
        if path != log and not is_known:
            with suppress(RunError):  # beside others it may be anything, if it is no table with a clock of its own
                texts += [part for part in _tabled(path, rate) if part.signals or part.clock]
        elif tables.is_recording(path):
            parts += _recorded(path)
        else:
            try:
                several = formats.names(path) if formats.has_tables(path) else ("",)
            except RunError as error:  # beside others it may be anything
                if path == log:
                    raise
                parts.append(Part(path, notes=(str(error).removeprefix(f"{path}: "),)))
                continue
            parts += [part for name in several for part in _tabled(path, rate, name)]
        if len(parts) + len(texts) > _MOST_PARTS:
            raise RunError(f"{log}: more than {_MOST_PARTS} tables or topics; give the log of one run")
    timed = [part for part in texts if part.clock and not part.clock.time.rate]
    parts = _of_one_run(parts + timed if parts else texts)
    return [part if part.clock is None else replace(part, clock=_beside(part, part.clock, parts)) for part in parts]


def _of_one_run(parts: Sequence[Part]) -> list[Part]:
    """The parts of a log without further runs: of files or sheets of the same columns, or of trials, the first.

    Tables of one file that share the stamps were written together, as of two arms: these are one run.
    """

    def columns(part: Part) -> set[str]:
        return {*part.left_out, *(signal.column for signal in part.signals)}

    def is_whole(part: Part) -> bool:
        roles = {names.column_role(signal.name) for signal in part.signals}
        return len(roles) > 1 and not roles.isdisjoint(_TOLD)

    def is_together(part: Part, first: Part) -> bool:
        if part.clock is None or first.clock is None or not formats.has_tables(part.file):
            return True
        return np.array_equal(part.clock.stamp, first.clock.stamp)

    def is_another(part: Part, first: Part) -> bool:
        trials = [match[1] for match in map(_TRIAL.match, (part.topic, first.topic)) if match]
        if part.file == first.file and len({*trials}) > 1:
            return True  # it may have other columns
        if part.file == first.file and len(trials) < 2 and is_together(part, first):
            return False
        return part is not first and columns(part) == columns(first)

    first = next(filter(is_whole, parts), None)
    again = [] if first is None else [part for part in parts if is_another(part, first)]
    if first is None or not again:
        return list(parts)
    notes = (*first.notes, f"{plural(len(again), 'other table')}, a run each, left out: {again[0].label} …")
    return [replace(part, notes=notes) if part is first else part for part in parts if part not in again]


def _files(log: Path) -> list[Path]:
    """The tables and recordings in a folder, or the log itself."""
    if not os.path.exists(log):  # noqa: PTH110 - Path.exists raises on a name that is too long
        raise RunError(f"{log}: no such file or folder")
    tables.refuse_endless(log)
    if not log.is_dir():
        is_known = log.name.endswith(_TABLES + _TEXTS + formats.ENDINGS) or tables.is_recording(log)
        if not (is_known or tables.holds_numbers(log)):
            raise RunError(f"{log}: no log that can be read; {_CONVERTED.get(log.suffix, _ACCEPTED)}")
        return [log]
    inside = sorted(path for path in log.rglob("*") if path.is_file())
    if (log / "metadata.yaml").is_file() or (inside and all(path.suffix in (".db3", ".mcap") for path in inside)):
        return [log]  # a bag
    if (log / "meta" / "info.json").is_file():  # LeRobot: many files of many episodes
        inside = [path for path in inside if log / "data" in path.parents][:1]
    files = [path for path in inside if path.name.endswith(_TABLES + _TEXTS) or tables.is_recording(path)]
    files = files or _arrays_joined([path for path in inside if path.name.endswith(formats.ENDINGS)])
    files = files or [path for path in inside if tables.holds_numbers(path)]
    if not files:
        raise RunError(f"{log}: no log in it that can be read; {_ACCEPTED}")
    return files


def _arrays_joined(files: Sequence[Path]) -> list[Path]:
    """Files, a folder of arrays as one table where just one of those that are as long runs like a clock."""
    kept = list(files)
    for folder in sorted({file.parent for file in files if file.suffix == formats.ARRAY}):
        with suppress(RunError):  # none of them is an array
            every = [tables.read(folder, topic=name) for name in formats.names(folder)]
            clocks = [len(_risers(table, table.columns)) for table in every if len(table.columns) > 1]
            inside = {folder / f"{name}{formats.ARRAY}" for table in every for name in table.columns}
            if max(clocks, default=0) == 1 and inside <= {*kept}:
                kept = [folder, *(path for path in kept if path not in inside)]
    return kept


def _part(table: Table, source: Part, labels: Mapping[str, list[str]], rate: float = 0.0) -> Part:
    signals, left_out, times, paths = list[Signal](), dict[str, str](), list[str](), list(_numeric_paths(table))
    joints, counts = _joints(table, paths), {name for name in _columns(table) if _counts(table, name) is not None}
    rows, matrices = _axes_in_rows(table), _matrices(table, paths)
    told = attitudes_in(table, paths) if rows == [{}] else []
    attitudes = [attitude for attitude in told if attitude.turns]
    turning = {path for attitude in attitudes for path in attitude.columns.columns}
    paths = paths if len(paths) <= _MOST_COLUMNS else names.likeliest_first(paths)
    for path, where in product(paths, rows):
        name, listed = _called(path, where), labels.get(leaf(path), [])
        if path in where or path in turning:
            continue
        if matrices.get(path) == "":
            left_out[name] = "of a matrix, beside its x, y and z"
        elif path not in matrices and names.is_time(path):
            times.append(path)
        elif path in counts:
            left_out[path] = "rises evenly: a count or a clock"
        elif why := _no_position(table, path, name) or names.no_position(_labelled(path, listed)):
            still = _signal(table, path, where, source, listed, None) if names.column_role(name) == "command" else why
            left_out[name] = still if isinstance(still, str) and still.startswith(RESTS) else why
        elif len(signals) == _MOST_COLUMNS:
            left_out[name] = f"more than {_MOST_COLUMNS} columns"
        elif isinstance(signal_or_why := _signal(table, path, where, source, listed, joints.get(path)), Signal):
            signals.append(signal_or_why)
        elif signal_or_why:
            left_out[name] = signal_or_why
    inches, points = names.inches_in(paths), _points(paths) | matrices
    signals = [_placed(signal, told, inches, points) for signal in _drop_quaternions(signals, left_out)]
    called = [signal.column for signal in signals if not names.number_of_nameless(signal.column)]
    if signals and (why := names.no_position_by_place(source.stem, called)):
        left_out |= {signal.name: f"{why}, as {source.label} is called" for signal in signals}
        signals = []
    read = f"the {len(table.columns)} are read whose names tell most; say in run.toml which others are meant"
    notes = [f"{table.path.name}: of {len(table.names)} columns {read}"] if len(table.names) > _MOST_READ else []
    beside = [names.role_words(signal.column) for signal in signals if signal.axis in CARTESIAN]
    for attitude in attitudes:
        left_out |= {} if attitude.role_words in beside else dict.fromkeys(attitude.columns.columns, "turning")
    clock, why_none = _clock(table, signals, sorted(counts))
    if clock is None or clock.counts:
        clock = _counted(table, rate) if rate else _rising(table, _stroke(signals), counts) or clock
    used = () if clock is None else tuple(clock.time.columns)
    if clock:
        sums = _velocities([signal for signal in signals if signal.column not in used], clock.stamp)
        left_out |= {name: f"velocity: it adds up to {position} by the clock" for name, position in sums.items()}
        positions = [signal for signal in signals if signal.name not in sums]
        signals = [replace(signal, has_velocity=signal.name in sums.values()) for signal in positions]
    left_out |= {path: "another clock" if clock else _no_clock(table, path) for path in times}
    accounted = {path for path in left_out if path in used or path.startswith(tuple(f"{path}." for path in used))}
    return replace(
        source,
        rows=table.rows,
        clock=clock,
        signals=_set_units([signal for signal in signals if signal.column not in used]),
        left_out={path: why for path, why in left_out.items() if path not in accounted},
        notes=(*why_none, *(() if clock is None else clock.notes), *source.notes, *table.notes, *notes),
        attitudes=tuple(attitude for attitude in attitudes if attitude.role_words in beside),
    )


def _points(paths: Iterable[str]) -> dict[str, str]:
    """The axes x, y and z of lists of three elements that are places, by their columns.

    These are a tool's, or named p: control engineers write p for places and q for joints.
    """
    return {
        column: axis
        for name, columns in names.lists(paths).items()
        if len(columns) == len(CARTESIAN)
        and (names.is_of_space(name) or (names.words(name)[:1] == ["p"] and columns[0].endswith("]")))
        for column, axis in zip(columns, CARTESIAN, strict=True)
    }


def _matrices(table: Table, paths: Iterable[str]) -> dict[str, str]:
    """The elements of matrices of a pose, four by four, one column or row after the other: x, y, z; empty of others."""
    axes = dict[str, str]()
    for columns in names.lists(paths).values():
        for point, others in (((12, 13, 14), (3, 7, 11)), ((3, 7, 11), (12, 13, 14))) if len(columns) == 16 else ():
            with suppress(RunError):
                if all((table.plain(columns[k])[0] == float(k == 15)).all() for k in (*others, 15)):
                    axes |= dict.fromkeys(columns, "")
                    axes |= {columns[k]: axis for k, axis in zip(point, CARTESIAN, strict=True)}
    return axes


def is_nameless(signals: Iterable[Signal], clock: Clock) -> bool:
    """Whether no column has a name: those of a table without a header, or of an array that has its clock in it."""
    array, bracket, _ = clock.time.column.partition("[")
    columns = [signal.column for signal in signals]
    return all(names.number_of_nameless(column) or (bracket and column.startswith(f"{array}[")) for column in columns)


@np.errstate(over="ignore", invalid="ignore")  # of numbers that are none, nothing is a velocity
def _velocities(signals: Sequence[Signal], stamp: TimeArray) -> dict[str, str]:
    """The velocities among some columns, each with the position that it adds up to over time, by their names."""
    stamped = stamp != NO_STAMP
    steps = np.diff(stamp[stamped]) / 1e9
    rows = max(1, round(_OF_WAY / max(median(steps), 1e-6))) if len(steps) else 1
    if len(signals) < 2 or len(steps) - rows < _FEWEST_ROWS:
        return {}
    begin = np.unique(np.linspace(0, len(steps) - rows, _MOST_WAYS).astype(np.intp))
    plain, again = ((signal.plain[stamped] for signal in signals) for _ in range(2))  # one at a time in memory
    sums = (np.pad(np.cumsum(0.5 * (value[1:] + value[:-1]) * steps), (1, 0)) for value in again)
    ways, added = (np.stack([value[begin + rows] - value[begin] for value in values]) for values in (plain, sums))
    # by adding up the second, of the variance of the first
    spread, power = np.var(ways, axis=1), np.mean(ways**2, axis=1)[:, None] + np.mean(added**2, axis=1)
    both = ways @ added.T / ways.shape[1]
    as_it_is, mirrored = (
        1.0 - (power - sign * 2.0 * both) / np.maximum(spread, 1e-30)[:, None] for sign in (1.0, -1.0)
    )
    is_velocity = (as_it_is > _IS_VELOCITY) & ~(np.maximum(as_it_is, mirrored).T > _EITHER)
    return {
        signals[column].name: signals[int(np.nanargmax(as_it_is[:, column]))].name
        for column in np.flatnonzero(is_velocity.any(axis=0)).tolist()
        if signals[column].basis == "range"
    }


def _placed(
    signal: Signal, attitudes: Iterable[Attitude], inches: Mapping[str, str], points: Mapping[str, str]
) -> Signal:
    """A signal with the axis or the unit that columns beside it imply: an orientation, inches, or a list of x, y, z."""
    beside = next((attitude for attitude in attitudes if signal.column in attitude.coordinates), None)
    if beside is not None:
        unit = {"unit": beside.place_unit, "basis": "name"} if beside.place_unit else {}
        signal = replace(signal, axis=beside.coordinates[signal.column], **unit)
    if signal.column in inches:
        return replace(signal, axis=names.axis_of(inches[signal.column], []), unit="inch", basis="name")
    return replace(signal, axis=points.get(signal.column, signal.axis))


def _likeliest(columns: Sequence[str]) -> list[str]:
    return list(columns) if len(columns) <= _MOST_READ else names.likeliest_first(columns)[:_MOST_READ]


def _drop_quaternions(signals: Sequence[Signal], left_out: dict[str, str]) -> list[Signal]:
    """Signals without quaternions: four columns of one list, or four numbered ones, whose norm is 1 in each row."""
    lists = dict[str, list[Signal]]()
    for signal in signals:
        if (number := _NUMBER.search(signal.column)) is not None:
            lists.setdefault(_called(signal.column[: number.start()], signal.where), []).append(signal)
    for four in lists.values():
        if len(four) == 4 and are_units(np.column_stack([signal.plain for signal in four])):
            left_out |= {signal.name: "of a quaternion" for signal in four}
    return [signal for signal in signals if signal.name not in left_out]


def _joints(table: Table, paths: Sequence[str]) -> dict[str, str]:
    """The names of joints, by the column of their position, where another column holds these names.

    These are ``joint_names`` of a trajectory or its controller, and ``name0`` as ``rostopic echo -p`` writes it.
    """
    column = table.columns.get("joint_names")
    listed: Any = None if column is None or not len(column) else column[0].as_py()
    joints = cast(list[Any], listed if isinstance(listed, list) else [])
    joints_by_path = {
        path: names.identifier(str(joints[int(match[1])]))
        for path in paths
        if (match := _OF_JOINT.search(path)) and int(match[1]) < len(joints)
    }
    for name, column in table.columns.items():
        if (match := _NAMED.fullmatch(name)) and pa.types.is_string(column.type) and column.null_count < len(column):
            joints_by_path[f"{match[1]}position{match[2]}"] = names.identifier(column.drop_null()[0].as_py())
    return joints_by_path


def _axes_in_rows(table: Table) -> list[dict[str, Any]]:
    """The rows of each axis or source, where a column tells which row is whose; else one choice, of all rows.

    Such a column changes from row to row, or from one block of rows to the next. A column of numbers must be called
    after what it tells apart (``id``, ``joint``); a ``status`` tells nothing apart.
    """
    for name, column in table.columns.items():
        whose = names.has_word(leaf(name), names.WHOSE)
        words = pa.types.is_string(column.type) and not table.is_dated(name)
        if not (whose and pa.types.is_integer(column.type)) and not (words and (whose or not names.no_position(name))):
            continue
        counts = pc.value_counts(column.drop_null())
        several: list[Any] = counts.to_pylist() if len(counts) <= _MOST_KEYS else []
        keys = [key for key in several if key["counts"] >= _FEWEST_ROWS]  # a limit switch changes once
        if len(keys) < 2 or sum(key["counts"] for key in keys) < _IN_ORDER * table.rows:
            continue
        changed = pc.fill_null(pc.not_equal(column[1:], column[:-1]), True).cast(pa.uint8())
        changes = np.from_dlpack(changed.combine_chunks())
        others = [column for column in table.columns if column != name]
        is_below = changes.sum() == len(several) - 1 and (whose or not any(map(names.role_words, others)))
        if changes.mean() > _IN_TURNS or (is_below and _begins_anew(table, others, np.flatnonzero(changes) + 1)):
            return [{name: key["values"]} for key in keys]
    return [{}]


def _begins_anew(table: Table, columns: Iterable[str], rows: IntArray) -> bool:
    """Whether one of some columns runs like a clock that begins anew in just these rows."""
    for name in columns:
        with suppress(RunError):
            values = table.stamps(name)[0] if table.is_dated(name) else table.plain(name)[0]
            if np.array_equal(falls_back(values), rows):
                return True
    return False


def _labelled(path: str, listed: list[str]) -> str:
    """The name of a list with the log's name for one of its elements; empty where the log names no elements."""
    label = names.label_of(path, listed)
    return "" if label is None else f"{leaf(path).partition('[')[0]}_{label}"


def _called(column: str, where: Mapping[str, Any]) -> str:
    """The name of a column behind what tells its rows: ``elbow_position``, ``joint_11_position``."""
    return "_".join([*(key if isinstance(key, str) else f"joint_{key}" for key in where.values()), column])


def _name_with_unit(table: Table, path: str) -> str:
    """The name of a column, with the unit that a line below the header says where it says none itself."""
    unit = "" if names.unit_of(path) else table.units.get(path, "")
    return f"{path} [{unit}]" if unit.strip("-") else path


def _no_position(table: Table, path: str, name: str) -> str | None:
    """What a column is by its name, or by a unit below that, if that is no position."""
    told = _name_with_unit(table, path)
    return names.no_position(name) or (None if told == path or names.unit_of(told) else f"in {table.units[path]}")


def _signal(
    table: Table, path: str, where: Mapping[str, Any], source: Part, labels: list[str], joint: str | None
) -> Signal | str:
    """The signal in a column, or the reason why it holds no positions, empty for text."""
    try:
        values, _ = table.plain(path)
        values = values if (none := sentinel(values)) is None else without(values, none)
        values = np.where(table.meets(where), values, np.nan) if where else values
    except RunError as error:
        return printable(str(error).removeprefix(f"{table.path}: "))
    finite = values[np.isfinite(values)]
    if len(finite) < _FEWEST_ROWS:
        is_text = not len(finite) and pa.types.is_string(table.column(path).type)
        return "" if is_text else "hardly any number" if len(finite) else "no number"
    if finite.min() == finite.max() and not names.has_word(path, names.PARTS):
        return f"{RESTS} {finite[0]:g}"
    kind = _RADIANS[0] if joint else source.type.rpartition("/")[2]
    sliding = kind in _RADIANS and names.has_word(joint or path, names.SLIDING)
    metres = kind in _METRES or sliding or _ECHOED.match(path)
    of_type = "m" if metres else "rad" if kind in _RADIANS or path.startswith(f"{PATH}.") else ""
    unit = names.unit_of(_name_with_unit(table, path)) or names.unit_of(source.topic or source.entity)
    basis = "name" if unit else "type" if of_type and not sliding else "range"
    called = _ECHO.sub("", path)
    if (number := names.number_of_nameless(path)) and names.has_word(source.stem, names.JOINTS):
        called = f"joint {number}"
    axis = joint or names.axis_of(_called(called, where), labels)
    if kind == _PX4:
        element = _ELEMENT.fullmatch(path)
        axis = CARTESIAN[int(element[2])] if element and element[1] == "position" else axis
        if axis not in CARTESIAN and not names.is_turning(axis):
            return "neither x, y, z nor an angle by its name"
        of_type, basis = "m" if axis in CARTESIAN else "rad", "name" if unit else "type"
    return Signal(path, axis, unit or of_type, basis, values, where=where)


def _set_units(signals: list[Signal]) -> tuple[Signal, ...]:
    """Signals with units: where no name says one, the likeliest for the range, which sensors may correct later."""
    in_units = list[Signal]()
    for signal in signals:
        if not signal.unit:
            small, large, most = RANGES["angle" if names.turns(signal.column, signal.axis) else "length"]
            signal = replace(signal, unit=large if usual_size(signal.plain) > most else small)
        if kind_of(f"_{signal.unit}") == "angle" and len(wraps(signal.value)):
            signal = replace(signal, turns=True, basis="turn" if signal.basis == "range" else signal.basis)
        in_units.append(signal)
    return tuple(in_units)


def usual_size(plain: FloatArray) -> float:
    """The usual size of the numbers in a column: a quantile that a few which leap away do not change."""
    return float(np.nanquantile(np.abs(plain), _USUALLY))


def _numeric_paths(table: Table) -> Iterator[str]:
    """Paths of all numbers in the first cells of a table, and columns of text, which may be numbers, too."""
    for name, column in table.columns.items():
        first = column.drop_null()[:1]
        has_no_name = not names.words(name) or names.number_of_nameless(name)
        if not len(first) and has_no_name:  # a separator at the end of each line
            continue
        if not len(first) or pa.types.is_string(first.type):
            yield name
        else:
            beside = table.columns.get("name")
            yield from numeric_paths({"name": None if beside is None else beside[0].as_py(), name: first[0].as_py()})


# Clocks.


def _clock(table: Table, signals: Sequence[Signal], counts: Sequence[str]) -> tuple[Clock | None, list[str]]:
    """The first column that runs like a clock, and what is wrong with those before it.

    Of a header before others; when it was recorded only for want of any. Where none is called so, one in a unit of time
    may be, ``uptime_s``, one of dates, such as the index of pandas, or the first, if it rises and has no name, or
    LabVIEW's; at the end a whole number that rises evenly.
    """
    notes, stroke, coarse = list[str](), _stroke(signals), 0.0
    called = sorted(_stamp_columns(table), key=lambda name: (name == LOG_TIME, "header" not in names.words(name)))
    in_units = [name for name in table.columns if ending(leaf(name)) in TIMES and name not in called]
    first = next(iter(table.columns), "")
    nameless = first == "X_Value" or names.number_of_nameless(first)

    def candidates() -> Iterator[Clock | None]:
        yield from (_clock_of(table, name, stroke) for name in called)
        yield from (_clock_of(table, name, stroke) for name in in_units)
        yield from (_clock_of(table, name, stroke) for name in table.columns if table.is_dated(name))
        if nameless and not called:
            yield _nameless_clock(table, stroke)
        yield from (_clock_of(table, name, stroke, coarse) for name in counts if _counts(table, name) != 1.0)

    for clock in filter(None, candidates()):
        source = Source(clock.stamp, {signal.name: signal.plain for signal in signals}, table.path.name)
        if not signals or not (stands := standing_clock(source)):
            apart = ((name, _clock_of(table, name, stroke)) for name in (*called, *in_units))
            others = {name: other for name, other in apart if other and name not in clock.time.columns}
            clock = _or_another(table, clock, (other for name, other in others.items() if name in called))
            return _numbered(table, _spread(table, clock, others.values(), counts), counts), notes
        notes.append(f"{clock.time.column} is no clock: {stands}")
        coarse = coarse or float(np.ptp(clock.stamp[clock.stamp != NO_STAMP])) / 1e9
    return None, notes


def _or_another(table: Table, clock: Clock, others: Iterable[Clock]) -> Clock:
    """A clock with a question where another one tells another time; that other one if this one was only counted."""
    for other in others:
        spans = [_span(timed) for timed in (clock, other)]
        if max(spans) > _ALIKE_SPANS * min(spans) > 0.0:
            steps = np.diff([clock.stamp, other.stamp])
            counted = (np.ptp(steps, axis=1) <= _OF_STEP * np.median(steps, axis=1)).tolist() == [True, False]
            first, second = clock.time.column, other.time.column
            lasts = f"By {first} it lasts {spans[0]:.4g} s, by {second} {spans[1]:.4g} s"
            taken = f"; {first} is exactly even, as what is counted, so {second} is taken" if counted else ""
            doubt = f"which is the clock of {table.path.name}? {lasts}{taken}"
            return replace(other if counted else clock, doubt=doubt)
    return clock


def _span(clock: Clock) -> float:
    return float(np.ptp(clock.stamp[clock.stamp != NO_STAMP])) / 1e9


def _spread(table: Table, clock: Clock, others: Iterable[Clock], counts: Sequence[str]) -> Clock:
    """A clock; where rows come in packets, another that stamps each row, or one spread by a count, else a question.

    The other clock lasts as long: that of a loop beside the stamps of a camera's frames.
    """
    if (sent := packets(clock.stamp)) is None or _axes_in_rows(table) != [{}]:
        return clock
    each, every = sent
    what = f"{table.path.name}: rows arrive {each:.3g} at a time, every {every:.3g} s"
    for counter in (name for name in counts if name not in clock.time.columns and _counts(table, name) == 1.0):
        even = Clock.of(table, structs.replace(clock.time, counter=counter), f"{clock.basis}, spread by {counter}")
        if float(np.ptp(clock.stamp - even.stamp)) / 1e9 < _LONGEST_WAIT * every:
            return replace(even, notes=(*even.notes, f"{what}: stamped by {counter}, along the earliest arrivals"))
    for other in others:
        if packets(other.stamp) is None and 1.0 / _ALIKE_SPANS < _span(other) / _span(clock) < _ALIKE_SPANS:
            said = f"{what}, by {clock.time.column}: stamped by {other.time.column}"
            return replace(other, notes=(*other.notes, said))
    return replace(clock, doubt=f"{what}, and no column counts them: when was each made?")


def _numbered(table: Table, clock: Clock, counts: Sequence[str]) -> Clock:
    """A clock with a question where its stamps are exactly a row count over a rate: they were not measured."""
    for name in counts if not (clock.time.counter or clock.doubt) else ():
        number, since = table.plain(name)[0], (clock.stamp - clock.stamp[0]) / 1e9
        number -= number[0]
        rate = float(number[-1] / since[-1]) if since[-1] > 0.0 and name not in clock.time.columns else 0.0
        rounding = max(_ROUNDED, _FLOAT32 * float(np.abs(since).max(initial=0.0)))
        if rate and _counts(table, name) == 1.0 and (np.abs(since - number / rate) <= rounding).all():
            stamps = f"The stamps of {table.path.name} are exactly {name} / {rate:.4g}: they were counted, not measured"
            doubt = f"did the loop run at {rate:.4g} Hz? {stamps}. If it ran slower, lags are as much longer"
            return replace(clock, doubt=doubt)
    return clock


def _counts(table: Table, name: str) -> float | None:
    """The usual step of a column of whole numbers that rise evenly, as a clock's or a counter's; None of any other."""
    with suppress(RunError):
        numbers = table.plain(name)[0]
        if names.unit_of(name) or not np.isfinite(numbers).all() or (numbers % 1.0).any():
            return None
        steps = np.diff(numbers)
        usual = float(np.median(steps)) if len(steps) >= _FEWEST_ROWS else 0.0
        if usual > 0.0 and np.mean(np.abs(steps - usual) <= _EVEN * usual) >= _IN_ORDER:
            return usual
    return None


def _stroke(signals: Sequence[Signal]) -> float:
    """How many rows a motion takes from the lower to the upper third of its range, in the middle of all columns.

    That tells noise, which crosses in a few rows, from motion, and needs no unit; 0 without a column.
    """
    ends = list[float]()
    for signal in signals:
        value = signal.plain[np.isfinite(signal.plain)]
        low, high = np.quantile(value, [0.05, 0.95])
        side = np.where(value > high - (high - low) / 3.0, 1, np.where(value < low + (high - low) / 3.0, -1, 0))
        side = side[side != 0]
        ends.append(len(value) / (np.count_nonzero(np.diff(side)) + 1))
    return float(np.median(ends)) if ends else 0.0


def _stamp_columns(table: Table) -> Iterator[str]:
    """Paths of columns that hold stamps by their type or their name."""

    def inside(path: str, kind: pa.DataType, depth: int) -> Iterator[str]:
        if pa.types.is_struct(kind):
            fields = {field.name for field in kind}
            if fields & {"nanosec", "nsecs", "nsec", "nanos"}:
                yield path
            else:
                for field in kind if depth else ():
                    yield from inside(f"{path}.{field.name}", field.type, depth - 1)
        elif pa.types.is_timestamp(kind) or (not pa.types.is_nested(kind) and names.is_time(path)):
            yield path

    for name, column in table.columns.items():
        yield from inside(name, column.type, 3)


def _clock_of(table: Table, name: str, stroke: float, span: float = 0.0) -> Clock | None:
    """The stamps of a column; None if they do not run like those of a clock.

    A motion takes ``stroke`` rows; another clock says that the table lasts ``span`` [s], 0: none does.
    """
    doubt, counts = "", False
    try:
        kind = table.column(name).type
        if pa.types.is_nested(kind) or pa.types.is_temporal(kind) or table.is_dated(name):
            dated = table.zoned(name) is not None
            apart = "seconds and nanoseconds" if pa.types.is_nested(kind) else "a time without a date"
            time, basis = Time(name), "a date" if dated else apart
        elif pa.types.is_integer(kind) and (beside := table.nanoseconds_beside(name)):
            time, basis = Time(name, nanoseconds=beside), "seconds and nanoseconds"
        elif (unit := ending(leaf(name))) in TIMES:
            time, basis = Time(name), f"{unit[1:]} by name"
        elif unit := names.time_unit_of(_name_with_unit(table, name)):
            time, basis = Time(name, unit), f"{unit} by name"
        else:
            values = table.plain(name)[0]
            unit, basis, doubt = _time_unit(values, stroke, span)
            if counts := basis in _GUESSED and bool((np.diff(values) == 1.0).all()):
                doubt = (
                    f"a count of rows? It rises by exactly 1 in each, so it tells no unit: {unit} is a guess. If it"
                    " counts, tell `pumafuse init` by --rate HZ how many rows a second has, and fuse what that writes"
                )
            time, basis = Time(name, unit), f"{unit} by {basis}"
        clock = Clock.of(table, time, basis, doubt and f"is {name} of {table.path.name} {doubt}")
    except RunError:
        return None
    return replace(clock, counts=counts) if _runs(clock.stamp[clock.stamp != NO_STAMP]) else None


def _beside(part: Part, clock: Clock, parts: Iterable[Part]) -> Clock:
    """A clock in a unit in which it covers the time of another table, where its own unit is a guess and does not."""
    if not clock.basis.endswith(_GUESSED):
        return clock
    clocks = [(other.file, other.clock) for other in parts if other.clock]
    others = [_ends(other) for file, other in clocks if (file, other.time) != (part.file, clock.time)]

    def shares(size: float) -> bool:
        first, last = size * _ends(clock)
        return any(min(last, to) - max(first, at) > _SHARED * (max(last, to) - min(first, at)) for at, to in others)

    units = {unit[1:]: divisor(clock.time.ending) / divisor(unit) for unit in TIMES}
    fit = [unit for unit, size in units.items() if shares(size)]
    if not fit or clock.time.unit in fit:
        return clock
    stamp = np.where(clock.stamp == NO_STAMP, NO_STAMP, np.rint(clock.stamp * units[fit[0]]).astype(np.int64))
    return Clock(structs.replace(clock.time, unit=fit[0]), f"{fit[0]} by {_ANOTHER}", stamp, clock.notes)


def _ends(clock: Clock) -> FloatArray:
    """The first and the last stamp [ns], (2,)."""
    stamps = clock.stamp[clock.stamp != NO_STAMP]
    return np.array([stamps.min(initial=2**62), stamps.max(initial=-(2**62))], dtype=np.float64)


def _runs(stamp: TimeArray) -> bool:
    """Whether stamps go on from row to row, or where many rows are out of order from some rows to the next.

    What hardly changes, and goes back as often as on, is a duration.
    """
    steps = np.diff(stamp)
    if not len(steps) or not steps.any():
        return False
    if (steps >= 0).mean() >= _IN_ORDER:
        return bool(np.count_nonzero(steps < 0) <= _BOTH_WAYS * np.count_nonzero(steps > 0))
    blocks = [np.median(block) for block in np.array_split(stamp, len(stamp) // _BLOCK or 1)]
    return len(blocks) >= _FEWEST_ROWS and bool((np.diff(blocks) > 0).mean() >= _IN_ORDER)


def _nameless_clock(table: Table, stroke: float) -> Clock | None:
    """The clock in the first column, which has no name, if its numbers rise and do not merely count rows."""
    first, *others = table.columns
    try:
        numbers = table.plain(first)[0]
        other_values = table.plain(others[0])[0] if others else np.full(len(numbers), np.nan)
        whole = (numbers % 1.0 == 0.0) & (other_values % 1.0 == 0.0) & (other_values >= 0.0) & (other_values < 1e9)
        if whole.all() and np.median(other_values) > 1e6:
            return Clock.of(table, Time(first, nanoseconds=others[0]), "seconds and nanoseconds")
    except RunError:
        return None
    steps = np.diff(numbers)
    rises = len(steps) and (steps > 0.0).mean() >= _IN_ORDER and (steps != 1.0).any()
    return _clock_of(table, first, stroke) if rises or _ticks(steps) else None


def _rising(table: Table, stroke: float, counts: Container[str]) -> Clock | None:
    """The clock that is the only column to rise from row to row, counts apart; None where none or several do."""
    risers = _risers(table, _columns(table), below=_axes_in_rows(table) != [{}])
    rising = [name for name in risers if name not in counts]
    clock = _clock_of(table, rising[0], stroke) if len(rising) == 1 else None
    what = f"is {rising[0]} the clock of {table.path.name}? It alone rises from row to row" if clock else ""
    return clock and replace(clock, doubt=clock.doubt or what)


def _columns(table: Table) -> Iterable[str]:
    """The columns of a table; of one array its elements."""
    return table.columns if len(table.columns) > 1 else _numeric_paths(table)


def _risers(table: Table, columns: Iterable[str], *, below: bool = False) -> list[str]:
    """The columns that rise from row to row as clocks do; if any of them has the name of a clock, only these.

    With ``below`` a table may hold signals one below another, with a clock that begins anew for each.
    """
    risers = list[str]()
    for name in columns:
        with suppress(RunError):
            values = table.plain(name)[0]
            steps = np.diff(values[np.isfinite(values)])
            fewest = _FEWEST_ROWS if names.is_time(name) else _MANY_ROWS
            enough = len(steps) >= max(fewest, _IN_ORDER * table.rows)
            goes_on = (steps >= 0.0).all() or (below and len(falls_back(values)))
            if enough and goes_on and (steps > 0.0).mean() >= _IN_ORDER:
                risers.append(name)
    return [name for name in risers if names.is_time(name)] or risers


def falls_back(stamp: TimeArray | FloatArray) -> IntArray:
    """Rows in which stamps begin anew: they fall by most of what they rose by since the last such row.

    None where anything else falls, or where hardly any rises.
    """
    steps = np.diff(stamp)
    rows = np.flatnonzero(steps < 0) + 1
    first, last = stamp[np.append(0, rows)[:-1]], stamp[rows - 1]
    whole = (stamp[rows] - first <= _MOST_LEFT * (last - first)).all() and (steps > 0).sum() >= _IN_ORDER * len(steps)
    return rows if whole and len(rows) <= _MOST_KEYS else rows[:0]


def _ticks(steps: FloatArray) -> bool:
    """Whether steps from row to row are those of a clock that ticks more slowly than rows are written.

    Then all ticks are about as long, with about as many rows in each: no position goes on like that.
    """
    changes = np.flatnonzero(steps)
    ticks, rows = steps[changes], np.diff(changes)
    if len(rows) < _FEWEST_ROWS or ticks.min() <= 0.0:
        return False
    alike = (np.abs(ticks / np.median(ticks) - 1.0) < _OF_TICK).mean() >= _IN_ORDER
    return bool(alike and (np.abs(rows - rows.mean()) <= 1.5).mean() >= _IN_ORDER)


def _counted(table: Table, rate: float) -> Clock:
    """The clock of frames that come at a given rate [Hz], numbered by a column that counts them or else by rows."""
    basis = f"at {rate:g} Hz, as given"
    for name in table.columns:
        with suppress(RunError):
            steps = np.diff(table.plain(name)[0]) if names.has_word(leaf(name), names.COUNTERS) else np.zeros(1)
            if (steps >= 1.0).all() and (steps % 1.0 == 0.0).all() and (steps == 1.0).mean() > 0.5:
                return Clock.of(table, Time(name, rate=rate), basis)
    return Clock.of(table, Time(rate=rate), basis)


def without_clock(part: Part) -> str:
    """Why a part that has positions has no clock."""
    return next((note for note in part.notes if " is no clock: " in note), f"no clock for its {part.rows} rows")


def unused(parts: Iterable[Part]) -> list[str]:
    """What a log holds and pumafuse does not use, with reasons: tables without a clock, then columns, then files."""
    parts = list(parts)
    reasons = [(part.label, without_clock(part)) for part in parts if part.signals and part.clock is None]
    reasons += [reason for part in parts for reason in part.left_out.items()]
    reasons += [(part.label, part.notes[0]) for part in parts if part.notes and not (part.signals or part.left_out)]
    return [printable(f"{what} ({why})", 200) for what, why in dict.fromkeys(reasons)]


def _no_clock(table: Table, name: str) -> str:
    """Why a column with the name of a clock is none."""
    try:
        table.stamps(name, unit="_s")
    except RunError as error:
        return str(error).removeprefix(f"{table.path}: column '{name}', ")
    return "does not run like a clock"


def _time_unit(values: FloatArray, stroke: float, span: float) -> tuple[str, str, str]:
    """The unit of stamps, by what it is known, and a question where that may be wrong."""
    finite = values[np.isfinite(values)]
    if len(finite) < 2:
        return "s", "default", ""
    middle, steps = float(np.median(finite)), np.diff(finite)
    interval = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
    stroke *= float((steps > 0.0).mean())  # in stamps: several rows may have one
    for unit, (low, high) in _EPOCHS.items():
        if low <= middle <= high and not span and interval <= _INTERVALS.get(unit, np.inf):
            return unit, "range", ""
    if interval < _FINEST_DAY and any(low <= middle <= high for low, high in _DAYS):
        return "days", "range", ""
    if not span and any(low <= middle <= high for low, high in _TICKS):
        return "ticks", "range", ""
    for unit, most in _INTERVALS.items():
        second = most / _INTERVALS["s"]
        if span and 1.0 / _ALIKE_SPANS < float(np.ptp(finite)) / second / span < _ALIKE_SPANS:
            return unit, _ANOTHER, ""
        if not span and interval <= most:
            if interval <= _SLOW * most or stroke * interval <= _LONGEST_STROKE * second:
                return unit, "interval", ""
            slow = f"{float(np.ptp(finite)) / second:.4g} s, and a stroke takes {stroke * interval / second:.3g} s"
            finer = {"s": "ms", "ms": "us", "us": "ns"}[unit]
            return finer, "motion", f"in {finer}? In {unit} the log lasts {slow} (run.toml, time)"
    return "ns", "interval", ""


# Tables.


def _tabled(path: Path, rate: float, topic: str = "") -> Iterator[Part]:
    """The parts of a table: of several runs the first, of a sensor its valid rows, of transforms each frame apart."""
    read = partial(tables.read, path, growing=True, topic=topic)
    px4 = path.suffix == ".ulg"
    if px4 and (not names.has_word(topic, _PX4_TOPICS) or names.has_word(topic, _PX4_OTHERS)):
        yield Part(path, topic, type=_PX4, notes=("no positions, by its name",))
        return
    if path.suffix == ".parquet":
        with tables.one_line(path):  # images are binary
            fields = _likeliest([field.name for field in papq.read_schema(path) if "binary" not in str(field.type)])
        some = [name for name in names.EPISODES if name in fields]
        where = _first_run(read(fields=some)) if some else {}
        table = read(fields=fields, where=where)
    else:
        table = read(fields=_likeliest)
        where = _first_run(table)
        table = tables.chosen(table, where)
    notes = [f"has several runs: only {key} = {value!r} is used" for key, value in where.items()]
    if valid := _validity(table) if names.role_of(path.name.split(".")[0]) in ("sensor", "reference") else {}:
        where, rows = {**where, **valid}, table.rows
        table = tables.chosen(table, valid)
        notes += [f"{rows - table.rows} of {rows} rows are not {key}: left out" for key in valid]
    type_ = _PX4 if px4 else ""
    for source, rows in _by_frame(table, Part(path, topic, where=where, type=type_, notes=tuple(notes))):
        yield _part(rows, source, _labels(path), rate)


def _by_frame(table: Table, source: Part) -> Iterator[tuple[Part, Table]]:
    """A table of transforms as one part for each frame that moves as seen from a base; any other table as it is.

    If frames of tools are among them, only these count. A joint turns its link, whose origin stays where it was in the
    frame of the link before.
    """
    child = next((name for name in table.columns if name.endswith(_CHILD)), "")
    parent, translation = child.replace(_CHILD, "header.frame_id"), child.replace(_CHILD, "transform.translation.")
    if not child or longest(table.columns, translation + "x") is None:
        yield source, table
        return
    frames = list(zip(table.texts(parent), table.texts(child), strict=True))
    at = np.stack([table.plain(translation + axis)[0] for axis in "xyz"])
    rows = {pair: np.array([frame == pair for frame in frames]) for pair in dict.fromkeys(frames)}
    links = {name for _, name in rows}
    moving = [pair for pair, here in rows.items() if np.ptp(at[:, here], axis=1).max() > 0.0]
    chosen = [pair for pair in moving if pair[0] not in links or names.has_word(_NUMBERS.sub("", pair[0]), _BASES)]
    chosen = [pair for pair in chosen if names.has_word(_NUMBERS.sub("", pair[1]), _HANDS)] or chosen
    if not chosen:
        yield replace(source, notes=(*source.notes, "no frame in it moves as seen from a base: links only turn")), table
    others = [f"{frame} → {name}" for frame, name in rows if (frame, name) not in chosen]
    notes = [f"transforms of {plural(len(others), 'other frame')} left out: {', '.join(others[:3])}"] if others else []
    for frame, name in chosen:
        where = {child: name, **({parent: frame} if sum(name == each for _, each in rows) > 1 else {})}
        where = where if others or len(chosen) > 1 else {}
        own_part = replace(source, where={**source.where, **where}, notes=(*source.notes, *notes))
        yield own_part, tables.chosen(table, where)


def _validity(table: Table) -> dict[str, Any]:
    """The choice of valid rows, where a column of 0 and 1, or of false and true, flags them; else empty."""
    for name, column in table.columns.items():
        is_flag = pa.types.is_boolean(column.type) or pa.types.is_integer(column.type)
        if is_flag and names.has_word(name, names.VALID):
            values = pc.unique(column.drop_null()).sort().to_pylist()
            if values == [0, 1]:
                return {name: values[1]}
    return {}


def _first_run(table: Table) -> dict[str, Any]:
    """The choice of rows of the first run, where a column numbers several runs; else empty."""
    for name in filter(table.columns.__contains__, names.EPISODES):
        if pa.types.is_nested(table.columns[name].type):  # an array of signals may be called run, too
            continue
        values = pc.unique(table.columns[name].drop_null())
        value: Any = values[0].as_py() if 1 < len(values) <= table.rows // _FEWEST_ROWS else None
        if isinstance(value, int | str | float):
            return {name: int(value) if isinstance(value, float) and value.is_integer() else value}
    return {}


class _Info(msgspec.Struct):
    """The columns of a LeRobot data set, each with ``names``: a list, or a table with a list in it."""

    features: dict[str, dict[str, Any]]


def _labels(path: Path) -> dict[str, list[str]]:
    """The names of the elements of lists, by column, in a LeRobot data set."""
    labels, info = dict[str, list[str]](), _Info({})
    with suppress(msgspec.MsgspecError, OSError, StopIteration):
        about = (above / "meta" / "info.json" for above in path.resolve().parents[:4])
        info = msgspec.json.decode(next(filter(Path.is_file, about)).read_bytes(), type=_Info)
    for key, feature in info.features.items():
        inside: Any = feature.get("names")
        while isinstance(inside, dict | list) and inside:  # a list in a list, as Unitree's converter writes it
            listed = cast(list[Any], inside)
            inside = cast(Any, inside[0] if isinstance(inside, list) else next(iter(cast(Any, inside).values())))
            labels[key] = [str(label) for label in listed]  # also of { x = 0, y = 1 }
    return labels


# Topics and entities.


def _recorded(path: Path) -> Iterator[Part]:
    topics = recordings.topics(path)
    if (count := len(topics)) > _MOST_PARTS:
        raise RunError(f"{path}: has {count} topics or entities, more than {_MOST_PARTS}; describe it in run.toml")
    for topic in topics:
        source = Part(path, "", topic.name) if path.suffix == ".rrd" else Part(path, topic.name)
        source = replace(source, type=topic.type, rows=topic.count)
        if why := _unread(topic):
            yield replace(source, notes=(why,))
            continue
        try:
            for part, table in _by_frame(recordings.read(path, topic.name, _wanted(topic)), source):
                yield _part(table, part, {})
        except RunError as error:
            yield replace(source, notes=(str(error).removeprefix(f"{path}: "),))


def _unread(topic: Topic) -> str:
    """Why a topic or entity is not read; empty where it may hold positions."""
    kind = topic.type.rpartition("/")[2]
    if kind in _VELOCITIES:
        return _ARE_VELOCITIES
    has_any = PATH_TIME in topic.fields or any(not names.no_position(name) for name in topic.fields)
    if kind in _OTHER_TYPES or not (topic.fault or has_any):
        return "no positions in messages of this type"
    return topic.fault and f"{_UNDECODED} ({topic.fault})"


def _wanted(topic: Topic) -> list[str]:
    """The fields of a topic that may be positions or their stamps."""
    if topic.type.lower().endswith("/tfmessage"):  # of the first ROS: tf/tfMessage
        return _OF_FRAME
    # Of many points none is listed.
    single, several = (any(f"points[{n}]" in name for name in topic.fields) for n in (0, 1))
    streamed = single and not several and (topic.last or 0) - (topic.first or 0) < _STREAM_NS * (topic.count - 1)
    if PATH_TIME in topic.fields and not streamed:
        return [PATH]
    wanted = [name for name in _likeliest(topic.fields) if QUATERNION.match(name) or not names.no_position(name)]
    return prefixes([*wanted, "header", "timestamp", "stamp", "joint_names"])


def no_commands(parts: Iterable[Part]) -> str:
    """Sentences on what looks like commands and cannot be used, with advice; empty where nothing does."""
    parts = list(parts)
    clockless = any(part.signals and part.clock is None for part in parts)
    advice = ["if rows come at a constant rate, give it to init as --rate HZ"] if clockless else list[str]()
    told = any(names.column_role(signal.name) == "command" for part in parts for signal in part.signals)
    for part in parts:
        others = dict[str, str]() if told else part.left_out
        called = [column for column, why in others.items() if why.partition(":")[0] in _SPEEDS]
        speeds = [column for column in called if names.column_role(column) == "command"]
        if _ARE_VELOCITIES in part.notes or speeds:
            what = f"{', '.join(speeds[:3])} of {part.label}" if speeds else part.label
            advice.append(ARE_SPEEDS.format(what))
        if error := next((name for name in others if is_error(name) and not names.has_word(name, _SPEEDS)), ""):
            of_axis = f'AXIS = ["MEASURED", "{error}"]'
            advice.append(f"{error} of {part.label} is an error: {ERROR}: {of_axis} under [command] in run.toml")
        advice += [f"{part.label}: {note}" for note in part.notes if note.startswith(_UNDECODED)]
        stamp = part.clock.stamp if part.clock else np.empty(0, dtype=np.int64)
        stamped = np.flatnonzero(stamp != NO_STAMP)
        if len(rows := falls_back(stamp[stamped])):
            advice.append(
                f"the clock of {part.label} begins anew in row {stamped[rows[0]] + 1}: if its rows are signals one"
                " below another, add a column of words that say which signal a row is of, such as command_x and"
                " measured_x"
            )
    return "".join(f"{printable(sentence, 300)}; " for sentence in advice) + ("or " if advice else "")


def period_of(command: Source) -> float:
    """Median time between the commands of an axis [s], of several axes in the middle; NaN of fewer than two."""
    periods = [rate_of(command.stamp[np.isfinite(value)])[0] for value in command.values.values()]
    return float(np.nanmedian(periods)) if np.isfinite(periods).any() else math.nan


def rate_of(stamp: TimeArray) -> tuple[float, FloatArray]:
    """Median time between stamps [s], and the gaps: those that are more than five times that [s]."""
    steps = np.diff(np.sort(stamp[stamp != NO_STAMP])) / 1e9
    interval = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else float("nan")
    return interval, steps[steps > _GAP * interval]
