"""A recorded run: commands, measurements and a reference as the log has them, in SI units and file order.

Nothing is repaired here: stamps that repeat, step back, are stray or missing and values that are not finite stay where
they are. Each measurement gets its outcome when the run is fused.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
import numpy.typing as npt

from .. import toml
from ..arrays import ALWAYS, NEVER, NO_STAMP, REACH_NS, BoolArray, TimeArray
from ..errors import RunError, UnknownNameError
from ..model.arm import CANONICAL_AXES, ArmModel
from ..units import Kind, ending
from . import manifest, reading, tables
from .frames import CARTESIAN, Frame
from .source import Source, of_arrays

if TYPE_CHECKING:
    from .entities import Recording

Clock = Literal["stamps", "regular"]
REFERENCE = "reference"  # the name of a run's reference among its sensors


class NoCommandError(RunError):
    """A run does not command one of its axes."""


@dataclass(frozen=True, repr=False)
class Run:
    """A recorded run.

    Attributes:
        name: For people and for result folders.
        command: The commands u.
        sensors: The measurements by sensor.
        reference: Positions to score against, where there are any; no filter uses them.
        start: The start level u₀ [m] of axes that rest elsewhere than at their first command.
        clock: Whether the commands' stamps are used as they are (``stamps``) or replaced by a grid of T (``regular``).
        tool: The reference orientation R₀ of the axes rx, ry, rz as a rotation vector [rad], once there are such axes.
        frame: The arm's axes in the log's x, y, z, for sources that give these.
        kinds: Of what kind the axes are, where the units of a log say so.
        notes: What was wrong with the files, a sentence each.
        recording: The Rerun recording that it was read from, if it was one.
        robot: The chain by which its joints are poses, where there are any.
        without_strays: Whether stray stamps are removed already, see :func:`pumafuse.logs.clock.without_strays`.
        since: Where the part to use begins [s after the first command], see :meth:`between`; None: with the log.
        until: Where it ends, likewise.
    """

    name: str
    command: Source
    sensors: Mapping[str, Source]
    reference: Source | None = None
    start: Mapping[str, float] = field(default_factory=dict[str, float])
    clock: Clock = "stamps"
    frame: Frame | None = None
    kinds: Mapping[str, Kind] = field(default_factory=dict[str, Kind])
    notes: tuple[str, ...] = ()
    recording: Recording | None = None
    robot: manifest.Robot | None = None
    without_strays: bool = False
    tool: tuple[float, float, float] | None = None
    since: float | None = None
    until: float | None = None

    def __repr__(self) -> str:
        sources = {"commands": self.command, **self.measured}
        counts = ", ".join(f"{len(source.stamp):,} {name}" for name, source in sources.items())
        return f"Run({self.name!r} of {', '.join(self.axes)}: {counts})"

    def __post_init__(self) -> None:
        where = f"run '{self.name}'"
        named = {f"sensor {name}": source.values for name, source in self.sensors.items()}
        named |= {} if self.reference is None else {"the reference": self.reference.values}
        framed = self.frame is not None or not set(self.axes).union(*named.values()).isdisjoint(CARTESIAN)
        accepted = dict.fromkeys((*self.axes, *CARTESIAN, *CANONICAL_AXES)) if framed else self.axes
        for what, values in {**named, "start": self.start}.items():
            for axis in values:
                if axis not in accepted:
                    raise UnknownNameError(f"{where}: {what} and the commands have other axes", "axis", axis, accepted)
        if self.clock not in get_args(Clock):
            raise UnknownNameError(where, "clock", str(self.clock), get_args(Clock))
        for axis, level in self.start.items():
            if not np.isfinite(_number(level, np.nan)):
                raise RunError(f"{where}: the start level of {axis} is not finite")
        scored = self.reference
        if scored is not None and not all(0.0 <= scored.sd_of(axis) < np.inf for axis in scored.values):
            raise RunError(f"{where}: the reference's sd must be finite and not negative")
        for axis, command in self.command.values.items():
            if not (np.isfinite(command) & (self.command.stamp != NO_STAMP)).any():
                raise NoCommandError(f"{self.command.label}: no command for axis '{axis}' has both a stamp and a value")

    @property
    def axes(self) -> tuple[str, ...]:
        """The commanded axes, in the order of the log."""
        return tuple(self.command.values)

    @property
    def measured(self) -> dict[str, Source]:
        """Its sensors, and ``reference``, by name."""
        return {**self.sensors, **({} if self.reference is None else {REFERENCE: self.reference})}

    @property
    def has_orientation(self) -> bool:
        """Whether one of its sources tells an orientation that is not yet made axes of."""
        return any(source.orientation is not None for source in (self.command, *self.measured.values()))

    def between(self, since: float | None = None, until: float | None = None) -> Run:
        """A part of the run, for example one that begins in mid-motion.

        Measurements and rows of the reference that are stamped outside do not count, and estimates are given only
        inside. All commands before it do: the arm moves by them from the log's beginning on, so that at ``since`` it is
        in motion if they move it, and as uncertain as its model says.

        Args:
            since: Where the part begins [s after the first command]; None: where the log does.
            until: Where it ends, likewise.

        Raises:
            RunError: That is no interval after the first command.
        """
        low, high = (_number(given_end, end) for given_end, end in ((since, 0.0), (until, np.inf)))
        if not (0.0 <= low < high and low < np.inf):
            raise RunError(f"run '{self.name}': from {since} to {until} s is no interval after the first command")
        return replace(self, since=since, until=until if high < np.inf else None)

    @property
    def interval(self) -> str:
        """The part to use in words; empty for the whole run."""
        ends = ("from", self.since), ("to", self.until)
        return " ".join(f"{word} {end:g} s" for word, end in ends if end is not None)

    def ends(self, origin: int) -> tuple[int, int]:
        """First and last stamp of the part to use, int ns; ``origin`` is the first command's."""
        since = ALWAYS if self.since is None else origin + round(min(self.since * 1e9, REACH_NS))
        until = NEVER if self.until is None else origin + round(min(self.until * 1e9, REACH_NS))
        return min(since, NEVER), min(until, NEVER)

    def within(self, stamp: TimeArray, origin: int) -> BoolArray:
        """Rows stamped in the part to use, (rows,); in the whole run all rows, also those without a stamp."""
        since, until = self.ends(origin)
        return (stamp >= since) & (stamp <= until) if self.interval else np.ones(len(stamp), dtype=np.bool_)

    def delayed(self, arm: ArmModel) -> Run:
        """The run with joints told as much later as they answer, with a note where this would need other commands."""
        if self.command.joints is None:
            return replace(self, notes=tuple(dict.fromkeys([*self.notes, *arm.joint_doubts()])))
        return replace(self, command=self.command.delayed(arm.later))

    def each(self, change: Callable[[str, Source], Source]) -> Run:
        """The run with each of its sources changed; ``change`` is given its name in notes, too."""
        return replace(
            self,
            command=change(self.command.label, self.command),
            sensors={name: change(source.label_for(name), source) for name, source in self.sensors.items()},
            reference=None if self.reference is None else change(self.reference.label, self.reference),
        )

    @staticmethod
    def read(path: str | Path) -> Run:
        """Read a folder with ``run.toml``, a ``run.toml`` itself, or one table with every source in its columns.

        Raises:
            PumafuseError: Nothing there, or not a recorded run; says what, where, and what is accepted.
        """
        path = Path(path)
        if os.path.isdir(path):  # noqa: PTH112 - Path.is_dir raises on a name that is too long
            path = path / "run.toml"
        if path.suffix == ".toml":
            return _read(manifest.load(path), path.parent)
        return of_table(tables.read(path, growing=True))

    @staticmethod
    def from_arrays(
        time: npt.ArrayLike,
        command: Mapping[str, npt.ArrayLike],
        sensors: Mapping[str, tuple[npt.ArrayLike, Mapping[str, npt.ArrayLike]]] | None = None,
        reference: tuple[npt.ArrayLike, Mapping[str, npt.ArrayLike]] | None = None,
        *,
        reference_sd: float | Mapping[str, float] = 0.0,
        start: Mapping[str, float] | None = None,
        clock: Clock = "stamps",
        frame: Frame | None = None,
        name: str = "run",
    ) -> Run:
        """A run from arrays in memory; they are copied.

        Args:
            time: Stamps of the commands, float seconds or int64 ns, (n,).
            command: u [m or rad] for each axis, (n,). Of a tool that turns also its ``orientation``, quaternions x, y,
                z, w, (n, 4), here and in what follows.
            sensors: For each sensor its stamps (m,) and its values for each axis, (m,). A column ``noise`` is by what
                the sensor's noise is scaled in each row.
            reference: Stamps (k,) and reference positions for each axis, (k,).
            reference_sd: Standard deviation of the reference's own noise, for all axes or for each.
            start: Start level of axes that rest elsewhere than at their first command.
            clock: ``stamps`` or ``regular``.
            frame: For sources in x, y, z.
            name: For people.

        Raises:
            RunError: Lengths differ, or there is no command.
        """
        notes = list[str]()
        commands = of_arrays("command", (time, command), notes)
        streams = {name: of_arrays(name, arrays, notes) for name, arrays in (sensors or {}).items()}
        scored = None if reference is None else replace(of_arrays(REFERENCE, reference, notes), sd=reference_sd)
        if len(commands.noise) or (scored is not None and len(scored.noise)):
            raise RunError("noise: only rows of sensors have one")
        return Run(name, commands, streams, scored, dict(start or {}), clock, frame, notes=tuple(notes))


def _number(value: float | None, absent: float) -> float:
    """A number that a user gave, NaN for what is none; ``absent`` for None."""
    try:
        return absent if value is None else float(value)
    except (TypeError, ValueError):
        return np.nan


def described(text: str, folder: Path) -> Run:
    """The run that the text of a ``run.toml`` in a folder describes."""
    return _read(manifest.of_tables(toml.parsed(text, "run.toml")), folder)


def _read(listed: manifest.Manifest, folder: Path) -> Run:
    fields = listed.fields

    def read(entry: manifest.SourceEntry) -> tables.Table:
        file, chosen = folder / entry.file, {"topic": entry.topic, "entity": entry.entity}
        return tables.read(file, growing=True, fields=fields[entry.rows], where=entry.where, **chosen)

    run = of_tables(listed, folder, read)
    logged = next((entry for entry in listed.entries.values() if entry.entity), None)
    if logged is None:
        return run
    from .entities import recording_of

    unit = logged.time.ending or ending(logged.time.column) or ""
    return replace(run, recording=recording_of(folder / logged.file, logged.entity, logged.time.column, unit))


def of_tables(
    listed: manifest.Manifest, folder: Path, read_table: Callable[[manifest.SourceEntry], tables.Table]
) -> Run:
    """The run that ``run.toml`` describes, from its tables; ``read_table`` is asked once for sources of one table."""
    robot = None if listed.robot is None else listed.robot.beside(folder)
    sources, kinds, notes = reading.sources_of(listed, robot, read_table)
    sensors = {name: sources[f"sensor {name}"] for name in listed.sensors}
    name, start, clock = listed.name or folder.resolve().name, listed.command.start, listed.command.clock
    command, reference = sources["command"], sources.get(REFERENCE)
    return Run(name, command, sensors, reference, start, clock, listed.frame, kinds, tuple(notes), robot=robot)


def of_table(table: tables.Table) -> Run:
    """The run of one table: ``time_s``, ``command.<axis>_mm``, ``<sensor>.<axis>_mm``, ``reference.<axis>_mm``."""
    sources, kinds, notes = reading.sources_in(table)
    command, reference = sources.pop("command"), sources.pop(REFERENCE, None)
    return Run(table.path.name.split(".")[0], command, sources, reference, kinds=kinds, notes=tuple(notes))
