"""A long run from Parquet, a piece at a time; each begins with rows of the one before."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ..arrays import ALWAYS, NEVER, NO_STAMP, BoolArray
from ..errors import RunError
from ..filter.outcome import FARTHEST
from ..logs import manifest, tables
from ..logs.clock import TOLERATED_STEP_BACK_NS, behind, stray_offsets
from ..logs.manifest import COMMAND
from ..logs.run import Run, Source, listed_run, listed_sources, located, single_run, single_sources, zones
from ..logs.tables import Table
from ..units import Kind

PIECE = 500_000  # rows that are read before a piece is fused
LOOK_BACK_NS = 10 * TOLERATED_STEP_BACK_NS  # rows this far behind an earlier one still find their place
_MOST_WAITING = 40  # pieces whose rows may wait for those of another source
_LAST = 5  # stamps whose median says how far a table was read: two of them may be stray


@dataclass(frozen=True)
class Piece:
    """A part of a run.

    Attributes:
        run: Its rows, and those from before it that say what they are.
        after: What is valid, or given as a command, later than this is new [int ns].
        until: All of the run that is valid until this is there [int ns].
        unplaced: How many rows of each sensor came when what is valid at their time was fused already: too late.
        strays: How many rows of each source have lost a stray stamp.
        share: How much of the run was read, 0 to 1.
    """

    run: Run
    after: int
    until: int
    unplaced: Mapping[str, int]
    strays: Mapping[str, int]
    share: float


def rows_of(path: Path) -> int | None:
    """How many rows the tables of a run have together; None if not all are Parquet."""
    path = located(path)
    files = {path}
    if path.suffix == ".toml":
        files = {path.parent / entry.file for entry in manifest.load(path).entries.values()}
    if not all(file.suffix == ".parquet" and file.is_file() for file in files):
        return None
    return sum(map(tables.rows_of, files))


def pieces(path: Path, latest: int, overlap: int) -> Iterator[Piece]:
    """A run in pieces; each is a run of its own, in which every new row has the neighbours that it has in the whole.

    Args:
        path: As of :meth:`Run.read`.
        latest: By how much a measurement is valid before its stamp at most [ns].
        overlap: How long before its new rows a piece begins [ns].

    Raises:
        RunError: The run cannot be read, or not in pieces.
    """
    log, after, floor = _Log(located(path)), ALWAYS, ALWAYS
    while True:
        unplaced = log.read(floor)
        strays, cut = log.without_strays(), log.reached
        until = NEVER if cut == NEVER else cut - LOOK_BACK_NS - latest
        yield Piece(log.run(cut), after, until, unplaced, strays, log.share)
        if cut == NEVER:
            return
        after, floor = until, cut - LOOK_BACK_NS
        log.forget(until - overlap)


class _Table:
    """A table that is read forwards; it gives the rows of its sources."""

    def __init__(self, parts: Iterator[Table], sources: Callable[[Table], dict[str, Source]]) -> None:
        self.reached = ALWAYS  # up to which stamp, int ns
        self.rows = 0
        self.first: Table | None = None
        self._parts, self._sources = parts, sources

    def read(self) -> dict[str, Source]:
        """Its next rows by source; none at its end."""
        part = next(self._parts, None)
        if part is None:
            self.reached = NEVER
            return {}
        self.first, self.rows = self.first or part, self.rows + part.rows
        found = self._sources(part)
        stamps = [one.stamp[one.stamp != NO_STAMP][-_LAST:] for one in found.values()]
        self.reached = max([self.reached, *(int(np.sort(last)[len(last) // 2]) for last in stamps if len(last))])
        return found


class _Log:
    """The rows of a run that are still needed, and the tables that more come from."""

    def __init__(self, path: Path) -> None:
        self._path, self._notes = path, list[str]()
        self._listed = manifest.load(path) if path.suffix == ".toml" else None
        self._units = dict[str, Kind]() if self._listed is None else dict(self._listed.command.kinds)
        self._tables = {(): self._single()} if self._listed is None else self._of(self._listed)
        self._kept, self._total = dict[str, Source](), rows_of(path) or 1

    @property
    def share(self) -> float:
        """How much was read, 0 to 1."""
        return min(sum(table.rows for table in self._tables.values()) / self._total, 1.0)

    @property
    def reached(self) -> int:
        """The stamp up to which every table was read [int ns]."""
        return min(table.reached for table in self._tables.values())

    def read(self, floor: int) -> dict[str, int]:
        """Read the rows of a piece, from the table that is behind the others.

        Args:
            floor: Rows stamped until this have no place any more [int ns].

        Returns:
            How many rows of each source had none.
        """
        parts = {name: [one] for name, one in self._kept.items()}
        begun, unplaced = sum(table.rows for table in self._tables.values()), dict[str, int]()
        while self.reached < NEVER:
            count = sum(table.rows for table in self._tables.values()) - begun
            if count >= PIECE and self.reached > floor + 2 * LOOK_BACK_NS and self._commands_all(parts):
                break
            if sum(len(one.stamp) for sources in parts.values() for one in sources) > _MOST_WAITING * PIECE:
                raise RunError(
                    f"{self._path}: too long to wait in memory for rows that belong to those read; are all sources"
                    " stamped by one clock, and every table sorted by time?"
                )
            for name, one in min(self._tables.values(), key=lambda table: table.reached).read().items():
                placed = (one.stamp > floor) | (one.stamp == NO_STAMP) | (name == COMMAND)  # stray, or refused below
                unplaced[name] = unplaced.get(name, 0) + int(np.count_nonzero(~placed))
                parts.setdefault(name, []).append(
                    one if placed.all() else _only(name, one, placed, parts.get(name, []))
                )
        self._kept = {name: _joined(sources) for name, sources in parts.items()}
        return _by_sensor(unplaced)

    def without_strays(self) -> dict[str, int]:
        """Remove stray stamps, as :func:`pumafuse.logs.clock.without_strays`; how many of each source.

        Raises:
            RunError: The commands' clock was set back.
        """
        found: dict[str, int] = {}
        for name, one in self._kept.items():
            apart = stray_offsets(one.stamp)
            apart = apart if name == COMMAND else np.maximum(apart, 0)
            found[name] = int(np.count_nonzero(apart))
            if found[name]:
                self._kept[name] = replace(one, stamp=np.where(apart == 0, one.stamp, NO_STAMP))
        if (behind(self._kept[COMMAND].stamp) > TOLERATED_STEP_BACK_NS).any():
            raise RunError(
                f"{self._kept[COMMAND].label}: the clock is set back by more than 1 s, which a run that is read in"
                " pieces must not have; cut the log there and fuse the parts one by one"
            )
        return _by_sensor(found)

    def run(self, cut: int) -> Run:
        """The rows that are needed, stamped until ``cut`` [int ns]."""
        sources = {name: one.rows(one.stamp <= cut) for name, one in self._kept.items()}
        if self._listed is None:
            run = single_run(self._path, sources, self._units, self._notes)
        else:
            read = {rows: table.first for rows, table in self._tables.items() if table.first is not None}
            notes = [*self._notes, *zones(self._listed.entries, read)]
            run = listed_run(self._listed, self._path, sources, self._units, notes)
        self._notes.clear()
        return replace(run, without_strays=True)

    def forget(self, until: int) -> None:
        """Forget the rows stamped until then [int ns], but for the last command of each axis."""
        for name, one in self._kept.items():
            needed = one.stamp > until
            if name == COMMAND:
                needed |= _last_of_each_axis(one, ~needed & (one.stamp != NO_STAMP))
            self._kept[name] = one.rows(needed)

    def _single(self) -> _Table:
        def sources(table: Table) -> dict[str, Source]:
            return single_sources(table, self._notes, self._units)

        return _Table(tables.parts(self._path, None, {}), sources)

    def _of(self, listed: manifest.Manifest) -> dict[tuple[str, ...], _Table]:
        found: dict[tuple[str, ...], _Table] = {}
        for rows, fields in listed.fields.items():
            mine = {name: entry for name, entry in listed.entries.items() if entry.rows == rows}
            first = next(iter(mine.values()))
            parts = tables.parts(self._path.parent / first.file, fields, first.where)
            found[rows] = _Table(parts, partial(self._listed_sources, mine))
        return found

    def _listed_sources(self, entries: Mapping[str, manifest.SourceEntry], table: Table) -> dict[str, Source]:
        return listed_sources(entries, lambda _: table, self._notes, self._units)

    def _commands_all(self, parts: Mapping[str, list[Source]]) -> bool:
        """Whether every axis has a command in what was read."""
        commands = [one.rows(one.stamp <= self.reached) for one in parts.get(COMMAND, ())]
        return bool(commands) and all(
            any((_possible(one, axis) & (one.stamp != NO_STAMP)).any() for one in commands)
            for axis in commands[0].values
        )


def _only(name: str, one: Source, placed: BoolArray, before: list[Source]) -> Source:
    """The rows that still have a place; the others must be late for their own source, too."""
    newest = max((int(part.stamp.max()) for part in before if len(part.stamp)), default=ALWAYS)
    if newest - int(one.stamp[~placed].max()) <= TOLERATED_STEP_BACK_NS:
        raise RunError(f"{one.label}: rows of {name} come after later ones of other sources; sort the table by time")
    return one.rows(placed)


def _by_sensor(counts: Mapping[str, int]) -> dict[str, int]:
    return {name.removeprefix(manifest.sensor("")): count for name, count in counts.items()}


def _joined(parts: list[Source]) -> Source:
    """The rows of parts of a source, one after the other."""
    values = {axis: np.concatenate([one.values[axis] for one in parts]) for axis in parts[0].values}
    return replace(parts[0], stamp=np.concatenate([one.stamp for one in parts]), values=values)


def _possible(source: Source, axis: str) -> BoolArray:
    return np.abs(source.values[axis]) < FARTHEST


def _last_of_each_axis(source: Source, among: BoolArray) -> BoolArray:
    """Of the rows ``among`` all, by stamp, the last with a position of each axis, (rows,)."""
    found, order = np.zeros(len(source.stamp), dtype=np.bool_), np.argsort(source.stamp, kind="stable")
    for axis in source.values:
        mine = order[(among & _possible(source, axis))[order]]
        found[mine[-1:]] = True
    return found
