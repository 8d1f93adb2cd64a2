"""Recorder of a live stream: a CSV file for each source beside ``run.toml``, while the stream goes on.

Twice a second :class:`Recorder` hands rows that nothing will take back to :class:`Writer`, a thread that waits for the
disk so that the estimator need not. Whole lines go to the end of a file: whoever reads finds a run at any moment, with
a torn last line at worst. A disk that refuses is tried again every second; meanwhile rows wait, up to a bound.
"""

from __future__ import annotations

import math
import os
import queue
import threading
import time
from collections.abc import Callable, Container, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from .. import toml
from ..arrays import ALWAYS
from ..folders import FolderError, check_writable, write_file
from ..fusion.config import ROBOT_FILE, FusionConfig
from ..logs.clock import TOLERATED_STEP_BACK_NS
from ..logs.frames import CARTESIAN
from ..logs.manifest import chain_of
from ..logs.save import check_axis, check_name
from ..space.rotations import TURNING
from ..toml import text_of
from ..units import SI, Kind
from .commands import number
from .rate_limit import RateLimitedLog
from .tool import NOISE, ORIENTATION, takes_orientation

_FLUSHED = 0.5  # s between two writes
_REPORTED_AGAIN = 60.0  # s until a trouble that lasts is reported again
_MOST_BEFORE = 65_536  # measurements that are kept until the first command
_MOST_FOLDERS = 100  # clocks that come after these go on in the last one
_TRIED_AGAIN = 1.0  # s after the disk refused
_MOST_WAITING = 64 << 20  # bytes that wait for a disk
_PATIENCE = 5.0  # s for the disk at the end
_COMMANDS, _MANIFEST, _TIME = "commands.csv", "run.toml", "time_ns"
_ARRIVED = "arrived_ns"  # the newest stamp by then, and 1 ns after the row before: only the order counts
_QUATERNION = ["qx", "qy", "qz", "qw"]  # columns


class _Row(NamedTuple):
    stamp: int
    sensor: str | None
    filled: list[str]  # axes with a value, and whether it has an orientation and a noise
    line: bytes


class Recorder:
    """Event log of a live estimator that becomes a recorded run; see :class:`pumafuse.live.estimator.EventLog`.

    A clock of the controller that was reset begins another run, beside the first: ``DIR.2``, ``DIR.3``, and so on, up
    to a hundred; a controller that is reset for ever fills no disk with folders.
    """

    def __init__(
        self, folder: Path, config: FusionConfig, start: Mapping[str, float], notify: Callable[[str], None]
    ) -> None:
        """Make the folder, which is new or empty, and wait for rows."""
        turns = takes_orientation(config)
        axes = [axis for axis in config.arm.axes if not (turns and axis in TURNING)]
        for sensor in config.sensors:
            check_name(sensor)
        for axis in axes:
            check_axis(axis)
        self._robot = config.robot
        self._joints = {} if config.robot is None else chain_of(config.robot).kinds
        kinds: dict[str, Kind] = dict.fromkeys(CARTESIAN if config.frame is not None else (), "length")
        kinds = {**{axis: config.arm.axes[axis].kind for axis in axes}, **kinds, **self._joints}
        self._columns = {axis: f"{axis}_{SI[kind].unit}" for axis, kind in kinds.items()}
        self._frame, self._start, self._notify = config.frame, dict(start), notify
        self._first = self._folder = folder = folder.absolute()
        self.late = 0  # rows left out, more than 1 s behind an earlier one of their source: no recorded run's may be
        self.lost = self._taken = 0  # rows that the disk refused for too long, and that the writer has got
        self._log = RateLimitedLog(notify)
        self._segment = self._folders = 1
        check_writable(folder, force=False, markers=(), ours=lambda _: False)
        folder.mkdir(parents=True, exist_ok=True)
        self._turning = _QUATERNION if turns else []
        header = ",".join((_TIME, _ARRIVED, *self._columns.values(), *self._turning, NOISE)).encode() + b"\n"
        beside = {} if self._robot is None else {ROBOT_FILE: text_of(Path(self._robot.urdf))}
        self._writer = Writer(header, beside)
        self._due, self._reported = 0.0, -math.inf
        self._clear()

    def begin_segment(self) -> None:
        """Write what was before, and begin a new run if there was a command: what comes is on another clock."""
        if self._commanded:
            self._flush(self._pending)
            if self._folders == _MOST_FOLDERS:
                self._pending, self._newest = [], {}
                self._log.write("shared", f"record: {_MOST_FOLDERS} folders are enough, all goes on in {self._folder}")
                return
            self._folders += 1
            self._folder = self._next_folder()
            self._start = {}
            self._notify(f"record: another clock, so it goes on in {self._folder}")
        self._clear()

    def append(self, stamp: int, sensor: str | None, values: Mapping[str, Any]) -> None:
        """Add an event."""
        cells = {axis: _cell(values[axis]) for axis in self._columns if axis in values}
        turned = [repr(number(value)) for value in values[ORIENTATION]] if ORIENTATION in values else []
        noise = _cell(values.get(NOISE))
        if not cells and not turned:
            return
        filled = [axis for axis, cell in cells.items() if cell] + [ORIENTATION] * bool(turned) + [NOISE] * bool(noise)
        if sensor is None and filled and not self._commanded:
            self._commanded, self._due = True, 0.0
        elif not self._commanded and len(self._pending) >= _MOST_BEFORE:
            del self._pending[: _MOST_BEFORE // 2]
        line = ",".join(
            [cells.get(axis, "") for axis in self._columns] + (turned or [""] * len(self._turning)) + [noise]
        )
        self._arrived = max(stamp, self._arrived + 1)
        self._pending.append(_Row(stamp, sensor, filled, f"{stamp},{self._arrived},{line}\n".encode()))

    def discard(self, after: int) -> None:
        """Remove the events stamped after ``after`` [ns]."""
        self._pending = [row for row in self._pending if row.stamp <= after]

    def tick(self, sure: int | None) -> None:
        """Hand over twice a second what is to be written, and report whether it can be."""
        if (now := time.monotonic()) < self._due:
            return
        self._due = now + _FLUSHED
        self._report(now)  # on what was handed over before
        self._flush_until(sure)

    def close(self, sure: int | None) -> None:
        """Write what is left; a disk that does not take it within five seconds does not get it."""
        self._flush_until(sure)
        self._writer.close()
        self.lost += self._taken - self._writer.rows
        self._taken = self._writer.rows
        with suppress(OSError):  # nothing ever came
            self._first.rmdir()

    def summary(self) -> str:
        """What was recorded, in a sentence."""
        more = "" if self._folders == 1 else f" to {self._folder.name}, {self._folders} folders"
        return f"{self._first}{more}: {self._state()}"

    def _report(self, now: float) -> None:
        """Report once a minute what is wrong with the disk, and once that it is well again."""
        trouble = self._writer.trouble
        if trouble and now - self._reported >= _REPORTED_AGAIN:
            self._notify(f"record: cannot be written: {trouble}; {self._state()}; estimates go on")
            self._reported = now
        elif not trouble and self._reported > -math.inf:
            self._notify(f"record: is written again; {self._state()}")
            self._reported = -math.inf

    def _state(self) -> str:
        written = self._writer.rows
        parts = [f"{written} rows written"]
        parts += [f"{self._taken - written} wait"] if self._writer.trouble and self._taken > written else []
        parts += [f"{self.late} left out, more than 1 s behind their source's newest"] if self.late else []
        parts += [f"{self.lost} lost"] if self.lost else []
        return ", ".join(parts)

    def _next_folder(self) -> Path:
        """The first of the numbered ones that is not there."""
        while True:
            self._segment += 1
            folder = self._first.with_name(f"{self._first.name}.{self._segment}")
            if not folder.exists():
                return folder

    def _clear(self) -> None:
        self._pending: list[_Row] = []
        self._newest: dict[str | None, int] = {}  # stamp of each source
        self._seen: dict[str | None, set[str]] = {}  # axes of each source
        self._listed: set[str | None] = set()  # sources whose rows have been handed over
        self._commanded, self._arrived = False, ALWAYS

    def _flush_until(self, sure: int | None) -> None:
        """Hand over the rows that nothing will take back."""
        if self._commanded and sure is not None:
            ready = [row for row in self._pending if row.stamp <= sure]
            self._pending = [row for row in self._pending if row.stamp > sure]
            self._flush(ready)

    def _flush(self, ready: list[_Row]) -> None:
        """Hand over rows, with the manifest that names their files."""
        by_source: dict[str | None, list[bytes]] = {}
        for row in ready:
            newest = self._newest.get(row.sensor, row.stamp)
            if row.stamp < newest - TOLERATED_STEP_BACK_NS:
                self.late += 1
                continue
            if not row.filled and row.sensor not in self._seen:  # of no axis yet
                continue
            self._newest[row.sensor] = max(newest, row.stamp)
            self._seen.setdefault(row.sensor, set()).update(row.filled)
            by_source.setdefault(row.sensor, []).append(row.line)
        listed = self._listed | by_source.keys()
        number = sum(map(len, by_source.values()))
        if None not in listed:  # the first command was lost: there is no run without one
            self.lost += number
        elif number:
            rows = {_file(sensor): b"".join(lines) for sensor, lines in by_source.items()}
            if self._writer.add(Job(self._folder, rows, self._manifest(listed), number)):
                self._taken += number
                self._listed = listed
            else:
                self.lost += number

    def _manifest(self, listed: Container[str | None]) -> str:
        """``run.toml`` with the listed sources and the axes that they have given."""
        entries = {
            sensor: {
                "file": _file(sensor),
                "time": _TIME,
                "arrived": _ARRIVED,
                **{axis: column for axis, column in self._columns.items() if axis in seen - self._joints.keys()},
                **(
                    {"joints": {joint: self._columns[joint] for joint in self._joints}}
                    if seen & self._joints.keys()
                    else {}
                ),
                **({ORIENTATION: {"quaternion": self._turning}} if ORIENTATION in seen else {}),
                **({NOISE: {"sd": NOISE, "typical": 1.0}} if NOISE in seen else {}),
            }
            for sensor, seen in self._seen.items()
            if sensor in listed
        }
        tree: dict[str, Any] = {"name": self._folder.name, "command": entries.pop(None)}
        if self._start:
            tree["command"]["start"] = {self._columns[axis]: level for axis, level in self._start.items()}
        if entries:
            tree["sensors"] = entries
        if self._frame is not None:
            tree["frame"] = toml.builtins(self._frame)
        if self._robot is not None:
            tree["robot"] = {**toml.builtins(self._robot), "urdf": ROBOT_FILE}
        return toml.text(tree)


class Job(NamedTuple):
    """Rows to be written."""

    folder: Path  # where; made if it is not there
    rows: dict[str, bytes]  # whole lines for the end of each file, by its name; what is written is removed
    manifest: str  # the text of ``run.toml``, written if it has changed
    number: int  # how many rows these are


class Writer:
    """Thread that writes a record, and waits for the disk."""

    def __init__(self, header: bytes, beside: Mapping[str, str]) -> None:
        """Start to wait for jobs; ``header`` begins every file, ``beside`` are texts of files beside ``run.toml``."""
        self.trouble, self.rows = "", 0  # why the disk refuses, or that the folder had gone; how many are written
        self._header, self._beside = header, beside
        self._begin(Path())
        self._jobs = queue.SimpleQueue[Job | None]()
        self._taken = self._done = 0  # bytes; each is counted by one thread alone
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name="record", daemon=True)  # a dead disk may hold it
        self._thread.start()

    def add(self, job: Job) -> bool:
        """Add a job if there is room for it; whether there was."""
        size = sum(map(len, job.rows.values()))
        if self._taken - self._done + size > _MOST_WAITING:
            return False
        self._taken += size
        self._jobs.put(job)
        return True

    def close(self) -> None:
        """Write what waits and end; a disk that does not take it within five seconds does not get it."""
        self._ended.set()
        self._jobs.put(None)
        self._thread.join(_PATIENCE)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            size = sum(map(len, job.rows.values()))
            while not self._write_rest(job):
                if self._ended.wait(_TRIED_AGAIN) and not self._write_rest(job):
                    return
            self._done += size
            self.rows += job.number

    def _begin(self, folder: Path) -> None:
        self._folder, self._manifest = folder, ""
        self._sizes: dict[str, int] = {}  # of each file, as far as its rows are complete

    def _write_rest(self, job: Job) -> bool:
        """Write what is left of a job; whether all of it is written."""
        try:
            if job.folder != self._folder:
                self._begin(job.folder)
            job.folder.mkdir(exist_ok=True)
            gone = [self._append(job, name) for name in list(job.rows)]
            if job.manifest != self._manifest or not (job.folder / _MANIFEST).exists():
                for name, text in self._beside.items():
                    write_file(job.folder / name, text)
                write_file(job.folder / _MANIFEST, job.manifest)
                self._manifest = job.manifest
        except (OSError, FolderError) as error:
            self.trouble = f"{job.folder}: {getattr(error, 'strerror', None) or error}"
            return False
        self.trouble = f"{job.folder} or a file in it had gone, and is begun anew" if any(gone) else ""
        return True

    def _append(self, job: Job, name: str) -> bool:
        """Write a file's rows, in the place of what a full disk took of them before; whether the file had gone."""
        descriptor = os.open(job.folder / name, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            size = self._sizes.get(name, 0)
            gone = os.fstat(descriptor).st_size < size
            self._sizes[name] = size = 0 if gone else size
            os.ftruncate(descriptor, size)
            rows = job.rows[name] if size else self._header + job.rows[name]
            while rows:
                rows = rows[os.write(descriptor, rows) :]
            self._sizes[name] = os.fstat(descriptor).st_size
        finally:
            os.close(descriptor)
        del job.rows[name]
        return gone


def _file(sensor: str | None) -> str:
    return _COMMANDS if sensor is None else f"{sensor}.csv"


def _cell(value: object) -> str:
    """A position [m or rad] with the digits that bring the same float back; empty for what is no finite number.

    It stays in SI: of the floats of a decade not every one is that of a number of mm.
    """
    return repr(float(value)) if isinstance(value, float | int) and math.isfinite(value) else ""
