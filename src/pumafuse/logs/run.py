"""A recorded run: commands, measurements and a reference as the log has them, in SI units and file order.

Nothing is repaired here: stamps that repeat, step back, are stray or missing and values that are not finite stay where
they are. Each measurement gets its outcome when the run is fused.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import numpy as np
import numpy.typing as npt

from .. import toml
from ..arrays import ALWAYS, NEVER, NO_STAMP, REACH_NS, BoolArray, FloatArray, IntArray, TimeArray
from ..errors import RunError, UnknownNameError, plural
from ..model.arm import CANONICAL_AXES, ArmModel
from ..space import rotations
from ..space.kinematics import Chain, Joints
from ..units import AN, Kind, ending, nanoseconds, unwrapped
from . import manifest, tables
from .frames import CARTESIAN, Frame
from .grid import regular_grid, ticks_of

if TYPE_CHECKING:
    from .entities import Recording

Clock = Literal["stamps", "regular"]
REFERENCE = "reference"  # the name of a run's reference among its sensors
NOISE = "noise"  # what arrays and events call how noisy a row is
TOLERATED_STEP_BACK_NS = 1_000_000_000  # up to 1 s rows are out of order; beyond it the clock was set back

_LONGEST_TICK = 0.1  # s, of a clock that stamps several rows alike
_FEW_ROWS = 10  # too few to judge a clock by
_MOST_ROWS = 30_000_000  # of interpolated commands, all of which are in memory
_ABOUT = 1.01  # times the interval of commands, a median of stamps that jitter, which is written with few digits
_MOST_STEPS, PAUSE = 1000, 5.0  # between two commands; times the median interval, which is no path


class NoCommandError(RunError):
    """A run does not command one of its axes."""


@dataclass(frozen=True, repr=False)
class Source:
    """One stream of rows, in the order of the file.

    Attributes:
        stamp: When the logger stamped each row, int64 ns, ``NO_STAMP`` where it did not, (rows,).
        values: For each axis the value [m], NaN where the row has none, (rows,).
        label: What a person calls it: the file, or the column group of a single table.
        spread: For an axis computed by a frame, the factor on the noise of each row, (rows,).
        sd: Standard deviation of the noise of a reference [m or rad], for all axes or for each.
        apart: Whether axes may have rows of their own: NaN is then not invalid, but another axis's row.
        orientation: That of each row as logged, a quaternion x, y, z, w, NaN where it has none, (rows, 4); None where
            the source tells none. :func:`pumafuse.logs.axes.in_axes` makes axes of it.
        stray: Rows of commands of which a value is left out, as nobody sent it, (rows,); (0,) where none is.
        joints: Where the joints are of which x, y, z and the orientation are the pose; None where none are told.
        noise: By what a sensor's noise is scaled in each row, on all axes, (rows,); (0,) where by nothing.
        arrival: When each row came, int64 ns, (rows,); (0,) where at its stamp.
    """

    stamp: TimeArray
    values: Mapping[str, FloatArray]
    label: str
    spread: Mapping[str, FloatArray] = field(default_factory=dict[str, FloatArray])
    sd: float | Mapping[str, float] = 0.0
    apart: bool = False
    orientation: FloatArray | None = None
    stray: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    joints: Joints | None = None
    noise: FloatArray = field(default_factory=lambda: np.zeros(0))
    arrival: TimeArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def sd_of(self, axis: str) -> float:
        """Standard deviation of the noise of a reference on one axis [m or rad]."""
        return self.sd if isinstance(self.sd, float | int) else self.sd.get(axis, 0.0)

    def label_for(self, name: str) -> str:
        """The name of the source in notes, with its label where that is another one."""
        return name if name == self.label else f"{name} ({self.label})"

    def __repr__(self) -> str:
        return f"Source({self.label!r}: {len(self.stamp):,} rows of {', '.join(self.values)})"

    def repeated(self) -> BoolArray:
        """Rows whose stamp and values are all those of an earlier row, (rows,)."""
        if (np.diff(self.stamp) > 0).all():
            return np.zeros(len(self.stamp), dtype=bool)
        numbers = [*self.values.values(), *(() if self.orientation is None else self.orientation.T)]
        columns = [self.stamp, *(np.ascontiguousarray(value).view(np.int64) for value in numbers)]
        _, first = np.unique(np.stack(columns, axis=1), axis=0, return_index=True)
        return ~np.isin(np.arange(len(self.stamp)), first)

    @property
    def has_value(self) -> BoolArray:
        """Rows that have a value for any axis, (rows,)."""
        has_number = [~np.isnan(value) for value in self.values.values()]
        if self.orientation is not None:
            has_number.append(~np.isnan(self.orientation[:, 0]))
        return np.any(has_number, axis=0)

    def posed(self, joints: Joints) -> Source:
        """The source with the pose of the tip to which joints move their chain."""
        position, orientation = joints.chain.pose(joints.values)
        values = dict(self.values) | dict(zip(CARTESIAN, position.T.copy(), strict=True))
        return replace(self, values=values, orientation=orientation, joints=joints)

    def delayed(self, later: Mapping[str, float]) -> Source:
        """The pose as if joints had been told later, each by its own time [s], on the line from value to value.

        Raises:
            UnknownNameError: The chain has no joint of such a name.
        """
        if self.joints is None or not any(later.values()):
            return self
        told, late = self.joints.values.copy(), self.joints.chain.columns(later, self.label)
        complete = np.flatnonzero(np.isfinite(told).all(axis=1) & (self.stamp != NO_STAMP))
        set_back = np.flatnonzero(np.diff(self.stamp[complete]) < -TOLERATED_STEP_BACK_NS) + 1
        for part in np.split(complete, set_back):
            rows = part[np.argsort(self.stamp[part], kind="stable")]
            time = self.stamp[rows]
            last = np.flatnonzero(np.diff(time, append=NEVER))  # of a stamp the last command counts
            for column, by in late.items():
                told[rows, column] = _on_the_line(time[last], told[rows[last], column], time - by)
        return self.posed(Joints(self.joints.chain, told))

    def in_joints(self) -> Source:
        """The source with joints as its axes, in the place of the pose to which they move the tool."""
        if self.joints is None:
            return self
        told = dict(zip(self.joints.chain.joints, self.joints.values.T.copy(), strict=True))
        return replace(self, values={**self.without(CARTESIAN).values, **told}, orientation=None, joints=None)

    def without(self, axes: Container[str]) -> Source:
        """The source without some axes."""
        return replace(self, values={axis: value for axis, value in self.values.items() if axis not in axes})

    def ordered(self, axis: str) -> IntArray:
        """The rows that have a stamp and a value of an axis, by stamp, (n,)."""
        rows = np.flatnonzero(np.isfinite(self.values[axis]) & (self.stamp != NO_STAMP))
        return rows[np.argsort(self.stamp[rows], kind="stable")]

    def series(self, axis: str) -> tuple[TimeArray, FloatArray]:
        """Stamps and values of these rows, (n,) each."""
        rows = self.ordered(axis)
        return self.stamp[rows], self.values[axis][rows]

    def travel(self, axis: str) -> float:
        """How far an axis moves, outliers apart [m or rad]."""
        value = self.values[axis]
        low, high = np.nanquantile(value, [0.02, 0.98])
        return float(high - low) or float(np.nanmax(value) - np.nanmin(value))

    def beside(self, command: Source, turns: Mapping[str, float]) -> Source:
        """The source with angles that go on moved by whole ``turns`` [rad], by axis, to where they are commanded."""
        values = dict(self.values)
        for axis in turns.keys() & values.keys() & command.values.keys():
            turn, told, (stamp, positions) = turns[axis], command.series(axis), self.series(axis)
            if len(told[0]) and len(stamp):
                apart = np.median(positions - np.interp(stamp, *told))
                values[axis] = values[axis] - turn * np.round(apart / turn)
        return replace(self, values=values)

    def pivoted(self) -> Source:
        """The source with axes that have rows of their own beside each other, where these have one stamp.

        Axes that stand one below another, each with stamps that begin anew, are brought into the order of time first.
        """
        with_values = self.rows(self.has_value)
        inside = [np.flatnonzero(np.isfinite(value)) for value in with_values.values.values()]
        ends = sorted((int(rows[0]), int(rows[-1])) for rows in inside if len(rows))
        reach = accumulate((end for _, end in ends), max)
        begins = {begin for (begin, _), end in zip(ends[1:], reach, strict=False) if begin > end}
        falls = np.flatnonzero(np.diff(with_values.stamp) < 0) + 1
        if len(falls) and begins.issuperset(falls.tolist()):
            return with_values.rows(np.argsort(with_values.stamp, kind="stable")).pivoted()
        has_number = {axis: np.isfinite(value) for axis, value in self.values.items()}
        group = np.cumsum(np.diff(self.stamp, prepend=self.stamp[:1]) != 0)
        first = np.searchsorted(group, group)
        number = np.zeros(len(group), dtype=np.int64)  # of an axis with several values of one stamp
        for mask in has_number.values():
            count = np.cumsum(mask)
            number = np.maximum(number, np.where(mask, count - (count - mask)[first], 0))
        key = group * (number.max(initial=0) + 1) + number
        _, row, together = np.unique(key, return_index=True, return_inverse=True)
        values = {axis: np.full(len(row), np.nan) for axis in self.values}
        for axis, mask in has_number.items():
            values[axis][together[mask]] = self.values[axis][mask]
        pivoted = replace(self, stamp=self.stamp[row], values=values, apart=True)
        return pivoted.rows(pivoted.has_value)

    def interpolated(self, step: float) -> Source:
        """The source with values between its rows, on the line from each to the next, for a controller that does so.

        A pause, longer than five times the median interval, stays one. Axes with rows of their own are apart here, too.

        Args:
            step: From one value to the next, about [s].

        Raises:
            RunError: That is not between a thousandth of the median interval and the interval.
        """
        if self.apart:
            alone = {axis: self.rows(np.isfinite(value)) for axis, value in self.values.items()}
            some = [replace(source, values={axis: source.values[axis]}, apart=False) for axis, source in alone.items()]
            every = [source.interpolated(step) for source in some]
            stamp = np.concatenate([source.stamp for source in every])
            number = np.repeat(np.arange(len(every)), [len(source.stamp) for source in every])
            value = np.concatenate([value for source in every for value in source.values.values()])
            values = {axis: np.where(number == of_axis, value, np.nan) for of_axis, axis in enumerate(self.values)}
            whole = replace(every[0], stamp=stamp, values=values)
            return whole.rows(np.argsort(stamp, kind="stable")).pivoted()
        stamped = self.stamp != NO_STAMP
        gap = np.where(stamped[1:] & stamped[:-1], np.diff(self.stamp), -1).astype(np.float64)
        interval = float(np.median(gap[gap > 0.0])) if (gap > 0.0).any() else np.nan
        if not interval / _MOST_STEPS <= step * 1e9 <= _ABOUT * interval:
            raise RunError(
                f"{self.label}: interpolation_ms = {step * 1e3:g} is not between a thousandth of the interval of the"
                f" commands, {interval / 1e6:.4g} ms, and that"
            )
        goes_on = (gap > 0.0) & (gap <= PAUSE * interval)
        parts = np.maximum(np.rint(np.append(np.where(goes_on, gap, 0.0), 0.0) / (step * 1e9)), 1.0).astype(np.int64)
        if parts.sum() > _MOST_ROWS:
            raise RunError(
                f"{self.label}: interpolation_ms = {step * 1e3:g} makes {parts.sum() / 1e6:.0f} million commands, more"
                f" than {_MOST_ROWS / 1e6:.0f} million: a longer step, or a shorter run"
            )
        row = np.repeat(np.arange(len(parts)), parts)
        share = (np.arange(len(row)) - (np.cumsum(parts) - parts)[row]) / parts[row]

        def between(value: FloatArray) -> FloatArray:
            change = np.append(np.diff(value), 0.0)[row]
            return value[row] + np.where(share > 0.0, share * change, 0.0)

        stamp = self.stamp[row] + np.rint(share * np.append(gap, 0.0)[row]).astype(np.int64)
        values = {axis: between(value) for axis, value in self.values.items()}
        arrival = self.arrival[row + (share > 0.0)] if len(self.arrival) else self.arrival
        finer = replace(self, stamp=stamp, values=values, arrival=arrival)
        if self.joints is not None:
            told = np.column_stack([between(value) for value in self.joints.values.T])
            return finer.posed(Joints(self.joints.chain, told))
        turned = None if self.orientation is None else rotations.slerp(self.orientation, row, share)
        return replace(finer, orientation=turned)

    def on_timeline(self) -> tuple[Source, str | None]:
        """The source as Rerun shows it, where its clock steps back: by stamps, the first of each; and a note.

        Rerun keeps rows by their time, in whatever order they were logged; a time that was logged anew counts once.
        """
        order = np.argsort(self.stamp, kind="stable")
        if (np.diff(self.stamp) >= -TOLERATED_STEP_BACK_NS).all():
            return self, None
        again = np.append(False, (np.diff(self.stamp[order]) == 0) & (np.diff(order) > 1))
        values_in_order = [value[order] for value in self.values.values()]
        other = again & np.any([value != np.roll(value, 1) for value in values_in_order], axis=0)
        twice = f"; {plural(int(again.sum()), 'row')} of a time that was there already left out" if again.any() else ""
        twice += f", {other.sum()} of them with another value" if other.any() else ""
        return self.rows(order[~again]), f"{self.label}: rows are not in the order of time: put in order{twice}"

    def rows(self, chosen: BoolArray | IntArray | slice) -> Source:
        """The chosen rows, in the order chosen; not copied if they are all or a slice."""
        if isinstance(chosen, np.ndarray) and chosen.dtype == np.bool_ and chosen.all():
            return self
        values = {axis: value[chosen] for axis, value in self.values.items()}
        spread = {axis: value[chosen] for axis, value in self.spread.items()}
        stray = self.stray[chosen] if len(self.stray) else self.stray
        turned = None if self.orientation is None else self.orientation[chosen]
        joints = None if self.joints is None else Joints(self.joints.chain, self.joints.values[chosen])
        noise = self.noise[chosen] if len(self.noise) else self.noise
        kept = replace(self, stamp=self.stamp[chosen], values=values, spread=spread, orientation=turned, joints=joints)
        arrival = self.arrival[chosen] if len(self.arrival) else self.arrival
        return replace(kept, stray=stray, noise=noise, arrival=arrival)


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
        commands = _from_arrays("command", (time, command), notes)
        streams = {name: _from_arrays(name, arrays, notes) for name, arrays in (sensors or {}).items()}
        scored = None if reference is None else replace(_from_arrays(REFERENCE, reference, notes), sd=reference_sd)
        if len(commands.noise) or (scored is not None and len(scored.noise)):
            raise RunError("noise: only rows of sensors have one")
        return Run(name, commands, streams, scored, dict(start or {}), clock, frame, notes=tuple(notes))


def _on_the_line(stamp: TimeArray, value: FloatArray, at: TimeArray) -> FloatArray:
    """Values at some instants on the lines from one to the next, (m,); before the first that.

    No bit of it depends on other values than the two beside an instant: a stream tells the same of what it has by then.
    """
    before = np.clip(np.searchsorted(stamp, at, side="right") - 1, 0, None)
    after = np.minimum(before + 1, len(stamp) - 1)
    share = np.clip(at - stamp[before], 0, None) / np.maximum(stamp[after] - stamp[before], 1)
    return value[before] + share * (value[after] - value[before])


def note_rows(notes: list[str], label: str, rows: BoolArray, what: str, first: str = "") -> None:
    """Append a note: how many ``rows`` of a source have ``what``, and the first of them; nothing without any."""
    numbers = np.flatnonzero(rows)
    if len(numbers):
        plural = "row has" if len(numbers) == 1 else "rows have"
        notes.append(f"{label}: {len(numbers)} {plural} {what} (first: row {numbers[0] + 1}{first})")


def standing_clock(source: Source) -> str:
    """What is wrong with a clock that stands still while values go on, in words; empty of any other.

    Too coarse is a clock that ticks every 0.1 s or more, where most values of an axis change within a tick, and not by
    far less than from one tick to the next, as a measurement that is repeated at a standstill does. On scan1 and
    trunk-servo, stamped by such clocks, ticks up to 15.6 ms (Windows) raise the RMSE by a quarter at most, 50 ms double
    it, 0.1 s raise it up to 4 times, 1 s up to 10 times.
    """
    axis, changes = _most_changes(source)
    most = changes.sum()
    if not most:
        return ""
    has_number = np.isfinite(source.values[axis]) & (source.stamp != NO_STAMP)
    step, tick = np.abs(np.diff(source.values[axis][has_number])), np.diff(source.stamp[has_number])
    ticks = int((tick != 0).sum()) + 1
    period = np.median(tick[tick > 0]) / 1e9 if (tick > 0).any() else np.inf
    going_on = 2.0 * step[tick == 0].mean() >= (step[tick != 0].mean() if ticks > 1 else 0.0)
    if most <= ticks or most < _FEW_ROWS or period < _LONGEST_TICK or not going_on:
        return ""
    every = f", one every {period:.3g} s" if np.isfinite(period) else ""
    each = np.median(np.diff(np.flatnonzero(tick))) if ticks > 2 else np.nan
    rate = f": {each / period:.4g} rows a second" if np.isfinite(each / period) else ""
    return (
        f"{plural(ticks, 'distinct stamp')}{every}, in {len(step) + 1} rows with {axis}, which goes on while the clock"
        f" stands still{rate}"
    )


def _note_standing_clock(notes: list[str], source: Source, advice: str) -> None:
    """Append a note on rows with the stamp of the row before and another value; refuse a clock that stands still."""
    if stands := standing_clock(source):
        raise RunError(f"{source.label}: {stands}; {advice}")
    axis, changes = _most_changes(source)
    what = f"the stamp of the row before and another {axis} (of commands, the last of a stamp counts)"
    note_rows(notes, source.label, changes, what)


def _most_changes(source: Source) -> tuple[str, BoolArray]:
    """The axis with the most rows that have the stamp of the row before and another value, and these rows, (rows,)."""
    changes = {"": np.zeros(len(source.stamp), dtype=np.bool_)}
    for axis, value in source.values.items() if (np.diff(source.stamp) == 0).any() else ():
        rows = np.flatnonzero(np.isfinite(value) & (source.stamp != NO_STAMP))
        changes[axis] = np.zeros(len(value), dtype=np.bool_)
        changes[axis][rows[1:]] = (np.diff(source.stamp[rows]) == 0) & (np.diff(value[rows]) != 0)
    axis = max(changes, key=lambda axis: changes[axis].sum())
    return axis, changes[axis]


def _number(value: float | None, absent: float) -> float:
    """A number that a user gave, NaN for what is none; ``absent`` for None."""
    try:
        return absent if value is None else float(value)
    except (TypeError, ValueError):
        return np.nan


def _from_arrays(label: str, arrays: Any, notes: list[str]) -> Source:
    match arrays:
        case [_, Mapping()]:
            time, values = cast(tuple[npt.ArrayLike, Mapping[str, npt.ArrayLike]], arrays)
        case _:
            raise RunError(f"{label}: give (stamps, {{axis: values}})")
    try:
        stamp = _stamps(np.array(time))
        columns = {axis: np.array(value, dtype=np.float64) for axis, value in values.items()}
        turned, noise = columns.pop("orientation", None), columns.get(NOISE, np.zeros(0))
    except (ValueError, TypeError, OverflowError) as error:
        raise RunError(
            f"{label}: stamps are int ns, float seconds or datetime64, values are numbers: {error}"
        ) from None
    for axis, column in columns.items():
        if stamp.ndim != 1 or column.shape != stamp.shape:
            shapes = f"has shape {column.shape}, its stamps {stamp.shape}"
            raise RunError(f"{label}: {axis} {shapes}; one value a stamp is needed")
    if turned is not None and turned.shape != (*stamp.shape, 4):
        raise RunError(f"{label}: orientation has shape {turned.shape}; a quaternion x, y, z, w a stamp is needed")
    if (not columns and turned is None) or not len(stamp):
        raise RunError(f"{label}: no values")
    if columns.pop(NOISE, None) is not None and not (noise > 0.0).all():
        raise RunError(f"{label}: noise is by what that of each row is scaled: a positive number a stamp is needed")
    oriented = None if turned is None else rotations.of_quaternions(turned)
    source = Source(stamp, columns, label, orientation=oriented, noise=noise)
    _note_standing_clock(notes, source, "give stamps as fine as the rows")
    return source


def _stamps(time: npt.NDArray[Any]) -> TimeArray:
    """Int64 ns of datetime64, int ns or float seconds."""
    kind = time.dtype.kind
    if kind not in "Miuf":
        raise TypeError(f"got {time.dtype}")
    if kind == "f":
        missing, rough = ~np.isfinite(time), time.astype(np.float64)
    else:
        missing = np.isnat(time) if kind == "M" else time == NO_STAMP
        rough = time.astype("M8[s]").astype(np.float64) if kind == "M" else time / 1e9
    if (np.abs(rough[~missing]) >= REACH_NS / 1e9).any():
        raise ValueError("a stamp outside of the years 1824 to 2115")
    return nanoseconds(rough) if kind == "f" else time.astype("M8[ns]").astype(np.int64)


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
    """A run from its tables; ``read_table`` is asked once for sources of one table."""
    scored, notes, units = listed.reference, list[str](), dict(listed.command.kinds)
    entries, read = listed.entries, dict[tuple[str, ...], tables.Table]()
    robot = None if listed.robot is None else listed.robot.beside(folder)
    chain = None if robot is None else manifest.chain_of(robot)
    naive, zoned = list[str](), list[str]()

    def source(name: str) -> Source:
        entry = entries[name]
        if entry.rows not in read:
            read[entry.rows] = read_table(entry)
            notes.extend(note for note in read[entry.rows].notes if note not in notes)
        zone = None if entry.time.rate else read[entry.rows].zoned(entry.time.column)
        if zone is not None:
            (zoned if zone else naive).append(name)
        source = _source(read[entry.rows], entry.time, entry.axes, entry.label, notes, units, entry.orientation)
        if entry.noise is not None:
            source = replace(source, noise=entry.noise.factor(read[entry.rows].plain(entry.noise.column)[0]))
        if entry.arrived is not None:
            arrival, _ = entry.arrived.stamps(read[entry.rows])
            if untold := np.count_nonzero(arrival == NO_STAMP):
                notes.append(f"{entry.label}: rows that do not tell when they came: {untold}, taken as at their stamp")
            source = replace(source, arrival=np.where(arrival == NO_STAMP, source.stamp, arrival))
        if chain is not None and entry.joints:
            source = _posed(source, read[entry.rows], entry.joints, chain, units)
        if entry.entity:
            source, note = source.on_timeline()
            notes.extend([] if note is None else [note])
        source = source.pivoted() if entry.has_own_rows else source
        return _on_ticks(source, notes) if entry.clock == "regular" and entry is not listed.command else source

    sources = {name: source(name) for name in entries}
    has_value = {name: sources[name].has_value for name, entry in entries.items() if not entry.has_own_rows}
    empty: dict[tuple[str, ...], BoolArray] = {}  # rows of a table in which none of its sources has a value
    for name, has_row in has_value.items():
        empty[entries[name].rows] = ~has_row & empty.get(entries[name].rows, True)
    for name, has_row in has_value.items():  # where only others of its table have any, a row is theirs
        sources[name] = sources[name].rows(has_row | empty[entries[name].rows])
    if listed.command.interpolation:
        sources["command"] = sources["command"].interpolated(listed.command.interpolation)
    command = sources["command"]
    sources = {name: source.beside(command, entries[name].turns) for name, source in sources.items()}
    reference, sensors = sources.get("reference"), {name: sources[f"sensor {name}"] for name in listed.sensors}
    if reference is not None and scored is not None:
        of_kind = {"length": scored.sd, "angle": scored.angular_sd}
        sds = {axis: of_kind[units[axis]] for axis in reference.values}
        reference = replace(reference, sd=sds if len(set(sds.values())) > 1 else next(iter(sds.values())))
    if naive and zoned:
        notes.append(f"{naive[0]}: dates without a time zone, beside {zoned[0]} with one: taken as UTC")
    name, start, clock = listed.name or folder.resolve().name, listed.command.start, listed.command.clock
    return Run(name, command, sensors, reference, start, clock, listed.frame, units, tuple(notes), robot=robot)


def _on_ticks(source: Source, notes: list[str]) -> Source:
    """A source on the even ticks of its own clock; those of the commands are of T, which is not known here."""
    stamped = source.stamp != NO_STAMP
    distinct, tick = np.unique(source.stamp[stamped], return_inverse=True)
    if len(distinct) < _FEW_ROWS:
        return source
    grid, note = regular_grid(distinct, ticks_of(distinct), source.label, "rows")
    notes.extend([] if note is None else [note])
    stamp = source.stamp.copy()
    stamp[stamped] = grid[tick]
    return replace(source, stamp=stamp)


def clock_of(table: tables.Table) -> str:
    """The column of stamps of a table that is a run."""
    clocks = [name for name in table.columns if name.startswith("time_")]
    if len(clocks) != 1:
        listed = ", ".join(table.columns)
        raise RunError(
            f"{table.path}: a single table needs one time column, 'time_s'; it has: {listed}; {_described(table)}"
        )
    return clocks[0]


def _described(table: tables.Table) -> str:
    """What to do with a table of other names."""
    return f"`pumafuse init {shlex.quote(str(table.path))}` finds out what its columns are and writes a run.toml"


def of_table(table: tables.Table) -> Run:
    """A run from one table: ``time_s``, ``command.<axis>_mm``, ``<sensor>.<axis>_mm``, ``reference.<axis>_mm``."""
    path, clock, listed = table.path, clock_of(table), ", ".join(table.columns)
    groups: dict[str, dict[str, list[manifest.Column]]] = {}
    for column in (name for name in table.columns if "." in name):
        source, _, inner = column.partition(".")
        axis = inner.rpartition("_")[0]
        if axis in groups.setdefault(source, {}):
            raise RunError(f"{path}: two columns for {source}.{axis}; give one")
        groups[source][axis] = [manifest.Column(column)]
    if "command" not in groups:
        raise RunError(f"{path}: no column 'command.<axis>_mm'; it has: {listed}; {_described(table)}")
    notes, sources, units = list(table.notes), dict[str, Source](), dict[str, Kind]()
    for name, axes in groups.items():
        source = _source(table, manifest.Time(clock), axes, name, notes, units)
        sources[name] = source.rows(source.has_value)
    if left := [column for column in table.columns if "." not in column and column != clock]:
        notes.append(f"{path.name}: columns not of the form <source>.<axis>_mm are not used: {', '.join(left)}")
    command, reference = sources.pop("command"), sources.pop("reference", None)
    return Run(path.name.split(".")[0], command, sources, reference, kinds=units, notes=tuple(notes))


def _source(
    table: tables.Table,
    time: manifest.Time,
    axes: Mapping[str, Sequence[manifest.Column]],
    label: str,
    notes: list[str],
    units: dict[str, Kind],
    orientation: manifest.Orientation | None = None,
) -> Source:
    """A source from its columns, those of an axis added up; new notes and new kinds of axes are put in."""
    stamp, of_time = time.stamps(table)
    values, faults = dict[str, FloatArray](), list[str | None](of_time)
    for axis, columns in axes.items():
        parts = [_numbers(table, column) for column in columns]
        for column in columns:
            kind = column.kind or "length"
            if units.setdefault(axis, kind) != kind:
                raise RunError(
                    f"{table.path}: column '{column.column}' is {AN[kind]}, but {axis} is {AN[units[axis]]} elsewhere"
                    " in run.toml: in another source, or in its start"
                )
        values[axis] = np.sum([numbers for numbers, _ in parts], 0)
        faults.extend(note for _, note in parts)
    turned = None
    if orientation is not None:
        turned, more = orientation.read(table)
        faults += more
        if np.isnan(turned).all():
            raise RunError(f"{table.path}: no row of {', '.join(orientation.columns)} is an orientation")
    notes.extend(note for note in faults if note is not None and note not in notes)
    source = Source(stamp, values, label, orientation=turned)
    beside = None if time.nanoseconds else table.nanoseconds_beside(time.column)
    advice = f"write time = ['{time.column}', '{beside}']" if beside else "name a finer column of time"
    _note_standing_clock(notes, source, advice)
    return source


def _posed(
    source: Source,
    table: tables.Table,
    joints: Mapping[str, Sequence[manifest.Column]],
    chain: Chain,
    units: dict[str, Kind],
) -> Source:
    """The source with the pose of the tip to which its joints move a chain."""
    values = list[FloatArray]()
    for joint, kind in chain.kinds.items():
        if joint not in joints:
            raise RunError(f"{table.path}: no column for joint '{joint}' of the [robot]; there are {', '.join(joints)}")
        if wrong := next((joint.column for joint in joints[joint] if joint.kind not in (kind, None)), None):
            raise RunError(f"{table.path}: column '{wrong}' is no {kind}, which joint '{joint}' moves by")
        values.append(np.sum([_numbers(table, joint)[0] for joint in joints[joint]], 0))
    units |= dict.fromkeys(CARTESIAN, "length")
    return source.posed(Joints(chain, np.column_stack(values)))


def _numbers(table: tables.Table, column: manifest.Column) -> tuple[FloatArray, str | None]:
    """The numbers of a column, NaN in rows that are another axis's, and a note; an angle that begins anew goes on."""
    numbers, note = table.numbers(column.column, column.ending)
    chosen = np.where(tables.meets(table, column.where), numbers, np.nan) if column.where else numbers
    return unwrapped(chosen, column.turn) if column.turn else chosen, note
