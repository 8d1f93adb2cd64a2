"""A stream as a recorded run while it comes: a CSV file for each source beside ``run.toml``.

Rows are handed over twice a second to a thread of their own (:mod:`pumafuse.live.writer`), as far as nothing will take
them back any more. Nothing here makes the estimator wait.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Container, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from .. import toml
from ..folders import FolderError
from ..fusion.config import FusionConfig
from ..logs.clock import TOLERATED_STEP_BACK_NS
from ..logs.frames import CARTESIAN
from ..logs.save import check_axis, check_name
from ..model.arm import ordered_axes
from ..units import MM
from .writer import Job, Writer

_FLUSHED = 0.5  # s between two writes
_SAID_AGAIN = 60.0  # s until a trouble that lasts is told again
_MOST_BEFORE = 65_536  # measurements that are kept until the first command
_COMMANDS, _TIME = "commands.csv", "time_ns"


class _Row(NamedTuple):
    stamp: int
    sensor: str | None
    given: list[str]
    line: bytes


class Recorder:
    """What a live estimator believes, written down; see :class:`pumafuse.live.estimator.Journal`.

    A controller's clock that is set anew begins another run, beside the first: ``DIR.2``, ``DIR.3``, and so on.

    Attributes:
        late: How many were left out, as they stood more than 1 s behind an earlier one of their source, which a
            recorded run's clock may not.
        lost: How many were not recorded as the disk refused for too long.
    """

    def __init__(
        self, folder: Path, config: FusionConfig, start: Mapping[str, float], say: Callable[[str], None]
    ) -> None:
        """Make the folder and wait for rows.

        Args:
            folder: New, or empty.
            config: Says which sensors and axes there are, and the frame.
            start: Level [m] of axes that do not rest at their first command before it.
            say: Takes a sentence for the log.

        Raises:
            FolderError: The folder holds something, or cannot be made.
            RunError: A sensor or axis has a name that a recorded run cannot have.
        """
        axes = ordered_axes(set(config.arm.axes))
        for sensor in config.sensors:
            check_name(sensor)
        for axis in axes:
            check_axis(axis)
        framed = CARTESIAN if config.frame is not None else ()
        self._columns = tuple(dict.fromkeys((*axes, *framed)))
        self._frame, self._start, self._say = config.frame, dict(start), say
        self._first = self._folder = folder = folder.absolute()
        self.late = self.lost = self._given = 0
        self._segment = 1
        _make(folder)
        self._writer = Writer(",".join((_TIME, *(f"{axis}_mm" for axis in self._columns))).encode() + b"\n")
        self._due, self._said, self._troubled = 0.0, -math.inf, False
        self._clear()

    def begin(self) -> None:
        """What comes is on another clock: write what was before, and begin a new run if there was a command."""
        if self._commanded:
            self._flush(self._pending)
            self._folder = self._next_folder()
            self._start = {}
            self._say(f"record: another clock, so it goes on in {self._folder}")
        self._clear()

    def taken(self, stamp: int, sensor: str | None, values: Mapping[str, Any]) -> None:
        """An event is believed.

        Args:
            stamp: Int ns.
            sensor: None for a command.
            values: By axis [m].
        """
        cells = {axis: _cell(values[axis]) for axis in self._columns if axis in values}
        if not cells:
            return
        given = [axis for axis, cell in cells.items() if cell]
        if sensor is None and given and not self._commanded:
            self._commanded, self._due = True, 0.0
        elif not self._commanded and len(self._pending) >= _MOST_BEFORE:
            del self._pending[: _MOST_BEFORE // 2]
        line = ",".join([cells.get(axis, "") for axis in self._columns])
        self._pending.append(_Row(stamp, sensor, given, f"{stamp},{line}\n".encode()))

    def forget(self, after: int) -> None:
        """What is stamped after ``after`` [ns] was wrong."""
        self._pending = [row for row in self._pending if row.stamp <= after]

    def tick(self, sure: int | None) -> None:
        """Hand over twice a second what is to be written, and say whether it can be.

        Args:
            sure: The newest stamp [ns] that nothing will take back; None before any.
        """
        if (now := time.monotonic()) < self._due:
            return
        self._due = now + _FLUSHED
        self._tell(now)  # of what was handed over before
        self._flush_until(sure)

    def close(self, sure: int | None) -> None:
        """Write what is left; a disk that does not take it within five seconds does not get it."""
        self._flush_until(sure)
        self._writer.close()
        self.lost += self._given - self._writer.rows
        self._given = self._writer.rows
        with suppress(OSError):  # nothing ever came
            self._first.rmdir()

    def told(self) -> str:
        """What was recorded, in a sentence."""
        return f"{self._first}: {self._state()}"

    def _tell(self, now: float) -> None:
        """Say once a minute what is wrong with the disk, and once that it is well again."""
        trouble = self._writer.trouble
        if trouble and now - self._said >= _SAID_AGAIN:
            self._say(f"record: cannot be written: {trouble}; {self._state()}; estimates go on")
            self._said, self._troubled = now, True
        elif not trouble and self._troubled:
            self._say(f"record: is written again; {self._state()}")
            self._troubled = False

    def _state(self) -> str:
        written = self._writer.rows
        said = [f"{written} rows written"]
        said += [f"{self._given - written} wait"] if self._writer.trouble and self._given > written else []
        said += [f"{self.late} left out, more than 1 s behind their source's newest"] if self.late else []
        said += [f"{self.lost} lost"] if self.lost else []
        return ", ".join(said)

    def _next_folder(self) -> Path:
        """The first of the numbered ones that is not there."""
        while True:
            self._segment += 1
            folder = self._first.with_name(f"{self._first.name}.{self._segment}")
            if not folder.exists():
                return folder

    def _clear(self) -> None:
        """Nothing of this run yet."""
        self._pending: list[_Row] = []
        self._newest: dict[str | None, int] = {}
        self._seen: dict[str | None, set[str]] = {}
        self._listed: set[str | None] = set()  # whose rows have been handed over
        self._commanded = False

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
            if not row.given and row.sensor not in self._seen:  # of no axis yet
                continue
            self._newest[row.sensor] = max(newest, row.stamp)
            self._seen.setdefault(row.sensor, set()).update(row.given)
            by_source.setdefault(row.sensor, []).append(row.line)
        listed = self._listed | by_source.keys()
        number = sum(map(len, by_source.values()))
        if None not in listed:  # the first command was lost: there is no run without one
            self.lost += number
        elif number:
            rows = {_file(sensor): b"".join(lines) for sensor, lines in by_source.items()}
            if self._writer.hand_over(Job(self._folder, rows, self._manifest(listed), number)):
                self._given += number
                self._listed = listed
            else:
                self.lost += number

    def _manifest(self, listed: Container[str | None]) -> str:
        """``run.toml`` with the listed sources and the axes that there have been."""
        entries = {
            sensor: {
                "file": _file(sensor),
                "time": _TIME,
                **{axis: f"{axis}_mm" for axis in self._columns if axis in seen},
            }
            for sensor, seen in self._seen.items()
            if sensor in listed
        }
        tree: dict[str, Any] = {"name": self._folder.name, "command": entries.pop(None)}
        if self._start:
            tree["command"]["start"] = {f"{axis}_mm": level for axis, level in self._start.items()}
        if entries:
            tree["sensors"] = entries
        if self._frame is not None:
            tree["frame"] = toml.builtins(self._frame)
        return toml.text(tree)


def _file(sensor: str | None) -> str:
    return _COMMANDS if sensor is None else f"{sensor}.csv"


def _make(folder: Path) -> None:
    """Make a folder.

    Raises:
        FolderError: It holds something, or cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise FolderError(f"{folder}: is not empty; a recording needs a folder of its own")
    except OSError as error:
        raise FolderError(f"{folder}: cannot be written: {error.strerror}") from None


def _cell(value: object) -> str:
    """A length [m] in mm, with the digits that bring the same float back."""
    if not isinstance(value, float | int) or not math.isfinite(value):
        return ""
    mm = value * MM
    short = f"{mm:.12g}"
    if float(short) / MM == value:
        return short
    around = (mm, math.nextafter(mm, -math.inf), math.nextafter(mm, math.inf))
    return repr(next((one for one in around if one / MM == value), mm))
