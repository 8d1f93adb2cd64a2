"""One stream of rows of a run: what a sensor or the commands say, in SI units and in the order of the file."""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from ..arrays import NEVER, NO_STAMP, REACH_NS, BoolArray, FloatArray, IntArray, TimeArray
from ..errors import RunError, plural
from ..space import rotations
from ..space.kinematics import Joints
from ..units import nanoseconds
from .frames import CARTESIAN

NOISE = "noise"  # what arrays and events call how noisy a row is
TOLERATED_STEP_BACK_NS = 1_000_000_000  # up to 1 s rows are out of order; beyond it the clock was set back

_LONGEST_TICK = 0.1  # s, of a clock that stamps several rows alike
FEW_ROWS = 10  # too few to judge a clock by
_MOST_ROWS = 30_000_000  # of interpolated commands, all of which are in memory
_ABOUT = 1.01  # times the interval of commands, a median of stamps that jitter, which is written with few digits
_MOST_STEPS, PAUSE = 1000, 5.0  # between two commands; times the median interval, which is no path


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
    if most <= ticks or most < FEW_ROWS or period < _LONGEST_TICK or not going_on:
        return ""
    every = f", one every {period:.3g} s" if np.isfinite(period) else ""
    each = np.median(np.diff(np.flatnonzero(tick))) if ticks > 2 else np.nan
    rate = f": {each / period:.4g} rows a second" if np.isfinite(each / period) else ""
    return (
        f"{plural(ticks, 'distinct stamp')}{every}, in {len(step) + 1} rows with {axis}, which goes on while the clock"
        f" stands still{rate}"
    )


def note_standing_clock(notes: list[str], source: Source, advice: str) -> None:
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


def of_arrays(label: str, arrays: Any, notes: list[str]) -> Source:
    """A source of arrays in memory, stamps and values by axis; they are copied."""
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
    note_standing_clock(notes, source, "give stamps as fine as the rows")
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
