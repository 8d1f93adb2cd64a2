"""Sources of a run from the rows of its tables, as ``run.toml`` or the names of columns say where they are."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from ..arrays import NO_STAMP, BoolArray, FloatArray
from ..errors import RunError
from ..space.kinematics import Chain, Joints
from ..units import AN, Kind
from .columns import Table
from .frames import CARTESIAN
from .grid import regular_grid, ticks_of
from .manifest import Column, Manifest, Robot, SourceEntry, Time, chain_of
from .source import FEW_ROWS, Source, note_standing_clock


def read_source(table: Table, entry: SourceEntry) -> tuple[Source, list[str]]:
    """A source from its columns, those of an axis added up, and notes; joints are axes of their own."""
    stamp, notes = entry.time.stamps(table)
    values = dict[str, FloatArray]()
    for axis, columns in (*entry.axes.items(), *entry.joints.items()):
        parts = [column.read(table) for column in columns]
        values[axis] = sum((numbers for numbers, _ in parts), np.zeros(len(stamp)))
        notes += [note for _, note in parts if note is not None]
    turned, noise = None, np.zeros(0)
    if entry.orientation is not None:
        turned, faults = entry.orientation.read(table)
        notes += faults
    if entry.noise is not None:
        noise = entry.noise.factor(table.plain(entry.noise.column)[0])
    source = Source(stamp, values, entry.label, orientation=turned, apart=entry.has_own_rows, noise=noise)
    return source, notes


def sources_of(
    listed: Manifest, robot: Robot | None, read_table: Callable[[SourceEntry], Table]
) -> tuple[dict[str, Source], dict[str, Kind], list[str]]:
    """The sources that ``run.toml`` lists, by what messages call them, the kinds of their axes, and notes."""
    notes, kinds, sources = list[str](), dict(listed.command.kinds), dict[str, Source]()
    read, zones, chain = dict[tuple[str, ...], Table](), dict[bool, str](), None if robot is None else chain_of(robot)
    for name, entry in listed.entries.items():
        if entry.rows not in read:
            read[entry.rows] = read_table(entry)
            _add(notes, read[entry.rows].notes)
        zone = None if entry.time.rate else read[entry.rows].zoned(entry.time.column)
        if zone is not None:
            zones.setdefault(zone, name)
        sources[name] = _source(read[entry.rows], entry, chain, notes, kinds)
        if entry.clock == "regular" and entry is not listed.command:
            sources[name] = _on_ticks(sources[name], notes)
    _drop_rows_of_others(sources, listed)
    if listed.command.interpolation:
        sources["command"] = sources["command"].interpolated(listed.command.interpolation)
    command, scored = sources["command"], listed.reference
    sources = {name: source.beside(command, listed.entries[name].turns) for name, source in sources.items()}
    if scored is not None:
        of_kind = {"length": scored.sd, "angle": scored.angular_sd}
        sds = {axis: of_kind[kinds[axis]] for axis in sources["reference"].values}
        sd = sds if len(set(sds.values())) > 1 else next(iter(sds.values()))
        sources["reference"] = replace(sources["reference"], sd=sd)
    if len(zones) > 1:
        notes.append(f"{zones[False]}: dates without a time zone, beside {zones[True]} with one: taken as UTC")
    return sources, kinds, notes


def sources_in(table: Table) -> tuple[dict[str, Source], dict[str, Kind], list[str]]:
    """The same of a table that is a run: its columns are called ``<source>.<axis>_mm``."""
    path, clock, listed = table.path, clock_of(table), ", ".join(table.columns)
    groups: dict[str, dict[str, list[Column]]] = {}
    for column in (name for name in table.columns if "." in name):
        name, _, inner = column.partition(".")
        axis = inner.rpartition("_")[0]
        if axis in groups.setdefault(name, {}):
            raise RunError(f"{path}: two columns for {name}.{axis}; give one")
        groups[name][axis] = [Column(column)]
    if "command" not in groups:
        raise RunError(f"{path}: no column 'command.<axis>_mm'; it has: {listed}; {_described(table)}")
    notes, kinds, sources = list(table.notes), dict[str, Kind](), dict[str, Source]()
    for name, axes in groups.items():
        source = _source(table, SourceEntry(file=name, time=Time(clock), axes=axes), None, notes, kinds)
        sources[name] = source.rows(source.has_value)
    if left := [column for column in table.columns if "." not in column and column != clock]:
        notes.append(f"{path.name}: columns not of the form <source>.<axis>_mm are not used: {', '.join(left)}")
    return sources, kinds, notes


def clock_of(table: Table) -> str:
    """The column of stamps of a table that is a run."""
    clocks = [name for name in table.columns if name.startswith("time_")]
    if len(clocks) != 1:
        listed = ", ".join(table.columns)
        raise RunError(
            f"{table.path}: a single table needs one time column, 'time_s'; it has: {listed}; {_described(table)}"
        )
    return clocks[0]


def _described(table: Table) -> str:
    """What to do with a table of other names."""
    return f"`pumafuse init {shlex.quote(str(table.path))}` finds out what its columns are and writes a run.toml"


def _source(table: Table, entry: SourceEntry, chain: Chain | None, notes: list[str], kinds: dict[str, Kind]) -> Source:
    """A source whose columns are checked, joints as the pose to which they move a chain; notes and kinds are added."""
    source, faults = read_source(table, entry)
    _check_kinds(table, entry, kinds)
    if source.orientation is not None and entry.orientation is not None and np.isnan(source.orientation).all():
        raise RunError(f"{table.path}: no row of {', '.join(entry.orientation.columns)} is an orientation")
    _add(notes, faults)
    beside = None if entry.time.nanoseconds else table.nanoseconds_beside(entry.time.column)
    advice = f"write time = ['{entry.time.column}', '{beside}']" if beside else "name a finer column of time"
    note_standing_clock(notes, source.without(entry.joints), advice)
    if entry.arrived is not None:
        arrival, _ = entry.arrived.stamps(table)
        if untold := np.count_nonzero(arrival == NO_STAMP):
            notes.append(f"{entry.label}: rows that do not tell when they came: {untold}, taken as at their stamp")
        source = replace(source, arrival=np.where(arrival == NO_STAMP, source.stamp, arrival))
    if chain is not None and entry.joints:
        source = _posed(source, table, entry, chain, kinds)
    if entry.entity:
        source, note = source.on_timeline()
        _add(notes, [] if note is None else [note])
    return source.pivoted() if entry.has_own_rows else source


def _add(notes: list[str], more: Iterable[str]) -> None:
    """Append the notes that are not among some yet."""
    notes.extend(note for note in dict.fromkeys(more) if note not in notes)


def _check_kinds(table: Table, entry: SourceEntry, kinds: dict[str, Kind]) -> None:
    """Refuse an axis that is of another kind elsewhere."""
    for axis, columns in entry.axes.items():
        for column in columns:
            kind = column.kind or "length"
            if kinds.setdefault(axis, kind) != kind:
                raise RunError(
                    f"{table.path}: column '{column.column}' is {AN[kind]}, but {axis} is {AN[kinds[axis]]} elsewhere"
                    " in run.toml: in another source, or in its start"
                )


def _posed(source: Source, table: Table, entry: SourceEntry, chain: Chain, kinds: dict[str, Kind]) -> Source:
    """The source with the pose of the tip to which its joints move a chain."""
    for joint, kind in chain.kinds.items():
        if joint not in entry.joints:
            listed = ", ".join(entry.joints)
            raise RunError(f"{table.path}: no column for joint '{joint}' of the [robot]; there are {listed}")
        if wrong := next((column.column for column in entry.joints[joint] if column.kind not in (kind, None)), None):
            raise RunError(f"{table.path}: column '{wrong}' is no {kind}, which joint '{joint}' moves by")
    kinds |= dict.fromkeys(CARTESIAN, "length")
    joints = np.column_stack([source.values[joint] for joint in chain.kinds])
    return source.without(entry.joints).posed(Joints(chain, joints))


def _drop_rows_of_others(sources: dict[str, Source], listed: Manifest) -> None:
    """Drop rows without a value where another source of the table has one: these are its."""
    rows_of = {name: entry.rows for name, entry in listed.entries.items() if not entry.has_own_rows}
    empty = dict[tuple[str, ...], BoolArray]()  # rows of a table in which none of its sources has a value
    for name, rows in rows_of.items():
        empty[rows] = ~sources[name].has_value & empty.get(rows, True)
    for name, rows in rows_of.items():
        sources[name] = sources[name].rows(sources[name].has_value | empty[rows])


def _on_ticks(source: Source, notes: list[str]) -> Source:
    """A source on the even ticks of its own clock; those of the commands are of T, which is not known here."""
    stamped = source.stamp != NO_STAMP
    distinct, tick = np.unique(source.stamp[stamped], return_inverse=True)
    if len(distinct) < FEW_ROWS:
        return source
    grid, note = regular_grid(distinct, ticks_of(distinct), source.label, "rows")
    notes.extend([] if note is None else [note])
    stamp = source.stamp.copy()
    stamp[stamped] = grid[tick]
    return replace(source, stamp=stamp)
