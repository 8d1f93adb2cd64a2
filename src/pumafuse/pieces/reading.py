"""A long run read piece by piece: some rows of each of its Parquet tables at a time, in the order of time.

A piece is a :class:`pumafuse.Run` of the rows at hand, made by the code that reads a whole run. Rows stay at hand as
long as later ones have to be compared with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from itertools import chain
from pathlib import Path

import numpy as np
import pyarrow as pa

from ..arrays import ALWAYS, NEVER, NO_STAMP, BoolArray, TimeArray
from ..errors import RunError, plural
from ..fusion.config import FusionConfig
from ..logs import manifest, tables
from ..logs.clock import stray_offsets
from ..logs.frames import CARTESIAN, Cylindrical
from ..logs.reading import clock_of
from ..logs.run import NoCommandError, Run, of_table, of_tables
from ..logs.tables import Table
from ..units import TIMES

WAIT_NS = 10_000_000_000  # for rows that come late; one that comes later yet is left out
_MOST_LATE = 100  # rows of a table that are left out; more are no strays
_UNSETTLED = 2  # rows at the end of what is read, which may prove stray


class Log:
    """A run whose tables are read some rows at a time."""

    def __init__(self, path: Path) -> None:
        """Open a folder with ``run.toml``, ``run.toml`` itself, or one table; see :func:`rows_of`."""
        self._listed = None if path.suffix == ".parquet" else manifest.load(manifest.file_of(path))
        self._folder = path if path.is_dir() else path.parent
        self.done, self._cut = 0, ALWAYS  # rows that are read
        if self._listed is None:
            self._tables: dict[tuple[str, ...], _Rows] = {(): _Rows(path)}
        else:
            fields, command = self._listed.fields, self._listed.command
            entries = {entry.rows: entry for entry in self._listed.entries.values()}
            self._tables = {
                rows: _Rows(self._folder / entry.file, entry, fields[rows], command if command.rows == rows else None)
                for rows, entry in entries.items()
            }
        self.rows = sum(tables.row_count(table.path) for table in self._tables.values())  # that there are

    @property
    def ended(self) -> bool:
        """Whether everything is read."""
        return all(table.ended for table in self._tables.values())

    def read_on(self, rows: int) -> int:
        """Read about as many more ``rows``, from whichever table is behind the others."""
        until = self.done + rows
        while not self.ended and self.done < until:
            behind = min(
                (table for table in self._tables.values() if not table.ended), key=lambda table: table.frontier
            )
            self.done += behind.read_on(self._cut)
        frontier = min(table.frontier for table in self._tables.values())
        self._cut = NEVER if frontier == NEVER else max(self._cut, frontier - WAIT_NS)
        return self._cut

    def run(self) -> Run | None:
        """The run of the rows at hand; None as long as these do not command every axis."""
        try:
            if self._listed is None:
                return of_table(self._tables[()].table())
            return of_tables(self._listed, self._folder, lambda entry: self._tables[entry.rows].table())
        except NoCommandError:
            if self.ended:
                raise
            return None

    def drop(self, before: int, but: TimeArray) -> None:
        """Let go of rows stamped ``before`` an instant [int ns], ``but`` some stamps, and of those without a stamp."""
        for table in self._tables.values():
            table.drop(before, but)


def rows_of(path: Path) -> int:
    """How many rows a run has that can be read piece by piece; 0 for one that cannot.

    It can if all its tables are Parquet, each with one column of stamps, and no rows are chosen by ``where``. Of dates
    with slashes all of a column tells how to read them.
    """
    if path.suffix == ".parquet":
        count = tables.row_count(path)
        return 0 if count and any(tables.has_slashes(path, f"time{unit}") for unit in TIMES) else count
    if not (listed := manifest.file_of(path)).is_file() or listed.suffix != ".toml":
        return 0
    entries = list(manifest.load(listed).entries.values())
    clocks = {(entry.rows, repr(entry.time)) for entry in entries}
    files = {entry.rows: listed.parent / entry.file for entry in entries}
    chosen = any(entry.where or entry.has_own_rows or entry.topic or entry.entity for entry in entries)
    if len(clocks) > len(files) or chosen:
        return 0
    counts = [tables.row_count(file) for file in files.values()]
    if not all(counts) or any(tables.has_slashes(files[entry.rows], entry.time.column) for entry in entries):
        return 0
    return sum(counts)


def needs_whole(path: Path, config: FusionConfig) -> str | None:
    """What a run has that needs all of it in memory; None without anything.

    A grid of ticks is fitted to all rows; whole turns about a base, and rows at a rate, are counted from the first
    row on.
    """
    if path.suffix == ".parquet":
        return "a cylindrical [frame]" if isinstance(config.frame, Cylindrical) else None
    listed = manifest.load(manifest.file_of(path))
    entries = listed.entries.values()
    oriented = [entry for entry in entries if entry.orientation or entry.joints]
    turning = {name for name, entry in listed.sensors.items() if entry in oriented}
    lacks_turns = any(sensor.marker is not None and name not in turning for name, sensor in config.sensors.items())
    framed = isinstance(listed.frame or config.frame, Cylindrical)
    needs = {
        "clock = 'regular'": any(entry.clock == "regular" for entry in entries),
        "interpolation_ms": listed.command.interpolation,
        "turn_deg": any(entry.turns for entry in entries),
        "rate_hz": any(entry.time.rate for entry in entries),
        "a counter or shift_s": any(entry.time.counter or entry.time.shift for entry in entries),
        "joints of which some answer later,": listed.command.joints and any(config.arm.later.values()),
        "an orientation, and no [tool] in fusion.toml,": oriented and config.tool is None,
        "a marker of a sensor that tells no orientation": oriented and lacks_turns,
        "a cylindrical [frame]": framed and any(not set(CARTESIAN).isdisjoint(entry.axes) for entry in entries),
    }
    return next((what for what, need in needs.items() if need), None)


class _Rows:
    """The rows of one table that are at hand."""

    def __init__(
        self,
        path: Path,
        entry: manifest.SourceEntry | None = None,
        fields: Sequence[str] | None = None,
        command: manifest.CommandEntry | None = None,
    ) -> None:
        """Open a table: of a source, of which ``fields`` are read and in which may be the commands, or a whole run."""
        self.path, self.ended, self.frontier = path, False, ALWAYS
        parts = tables.in_parts(path, fields)
        self._first = next(parts)
        self._parts = chain([self._first], parts)
        self._time = manifest.Time(clock_of(self._first)) if entry is None else entry.time
        if entry is None:
            self._commands = [manifest.Column(name) for name in self._first.columns if name.startswith("command.")]
        else:
            self._commands = list(
                chain.from_iterable([*command.axes.values(), *command.joints.values()] if command else [])
            )
        self._held, self._stamp = list[pa.Table](), np.empty(0, dtype=np.int64)
        self._late, self._left_out, self._read = 0, 0, 0
        self._sentinel_of = cache(partial(tables.sentinel_of, path))

    def read_on(self, cut: int) -> int:
        """Read on; rows stamped before the ``cut`` [int ns] come too late. Returns how many were read."""
        part = next(self._parts, None)
        if part is None:
            self.ended, self.frontier = True, NEVER
            return 0
        stamp, notes = self._time.stamps(part)
        if (stamp != self._time.as_logged(part)[0]).any():
            raise RunError(f"{'; '.join(notes)}; so long a run is fused piece by piece: cut it there")
        self._held.append(pa.table(dict(part.columns)))
        self._stamp = np.concatenate([self._stamp, stamp])
        self._read += part.rows
        stray = stray_offsets(self._stamp)
        late = (self._stamp < cut) & (self._stamp != NO_STAMP)
        late[: len(late) - part.rows] = False
        if late.any():
            self._leave_out(late, stray < 0)
            stray = stray[~late]
        settled = self._stamp[(stray == 0) & (self._stamp != NO_STAMP)][:-_UNSETTLED]
        self.frontier = max(self.frontier, int(settled.max(initial=ALWAYS)))
        return part.rows

    def _leave_out(self, late: BoolArray, stray: BoolArray) -> None:
        """Leave out rows that come too late, if each is a stray one, and they are few."""
        self._left_out += int(np.count_nonzero(late))
        rows = np.flatnonzero(late & ~stray if self._left_out <= _MOST_LATE else late)
        if len(rows):
            row = self._read - len(late) + int(rows[0]) + 1
            lag = (self._stamp[: rows[0]].max() - self._stamp[rows[0]]) / 1e9
            raise RunError(
                f"{self.path}: row {row} is stamped {lag:.3f} s behind an earlier one, and so are others; so long a run"
                " is fused piece by piece, in the order of time: sort the table by its stamps, or cut it where its"
                " clock was set back"
            )
        self._late += int(np.count_nonzero(late))
        self._choose(~late)

    def table(self) -> Table:
        """The rows at hand."""
        notes = list[str]()
        if self._late:
            rows = plural(self._late, "row")
            notes = [f"{self.path.name}: {rows} left out, stamped more than 10 s behind an earlier one"]
        return self._table(self._at_hand(), notes)

    def drop(self, before: int, but: TimeArray) -> None:
        """See :meth:`Log.drop`.

        Stray rows have had their turn, too: those that are ahead, and commands also behind, are none of any time.
        """
        stray = stray_offsets(self._stamp)
        gone = (stray > 0) | (self._stamp == NO_STAMP) | self._is_command(stray < 0)
        self._choose(~gone & ((self._stamp >= before) | np.isin(self._stamp, but)))
        self._late = 0

    def _is_command(self, among: BoolArray) -> BoolArray:
        """Which of some rows give a command, (rows,)."""
        is_command = np.zeros(len(among), dtype=np.bool_)
        if among.any():
            some = self._table(self._at_hand().filter(_bits(among)))
            for column in self._commands:
                is_command[among] |= np.isfinite(some.numbers(column.column, column.ending)[0])
        return is_command

    def _at_hand(self) -> pa.Table:
        return pa.concat_tables(self._held) if self._held else pa.table(dict(self._first.columns)).slice(0, 0)

    def _table(self, rows: pa.Table, notes: Sequence[str] = ()) -> Table:
        columns = dict(zip(rows.column_names, rows.columns, strict=True))
        return Table(self.path, columns, rows.num_rows, tuple(notes), self._first.names, self._sentinel_of)

    def _choose(self, rows: BoolArray) -> None:
        self._held = [self._at_hand().filter(_bits(rows))]
        self._stamp = self._stamp[rows]


def _bits(chosen: BoolArray) -> pa.Array:
    """A mask for Arrow; ``pa.array`` would import pandas."""
    return pa.Array.from_buffers(pa.bool_(), len(chosen), [None, pa.py_buffer(np.packbits(chosen, bitorder="little"))])
