"""One segment of a recorded run as events: which rows command the arm, and what each measurement is before filtering.

Delays and latencies only say when events are, so another configuration's times need no new table
(:meth:`Segment.events`); gains and noise are the filter's alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import reduce
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from ..arrays import ALWAYS, NEVER, NO_STAMP, BoolArray, CodeArray, FloatArray, IntArray, TimeArray
from ..errors import RunError, UnknownNameError
from ..filter.core import Model, classify
from ..filter.events import COMMAND, Events, concatenate
from ..filter.outcome import ABSENT, Outcome
from ..filter.response import response
from ..logs.clock import LONGEST_TAIL_NS, TOLERATED_STEP_BACK_NS, behind, in_order
from ..logs.frames import CARTESIAN
from ..logs.grid import regular_grid
from ..logs.run import Run
from ..logs.screening import held
from ..logs.source import Source, note_rows
from ..model.arm import ArmModel, AxisModel
from ..units import AN, of_kind, seconds
from .config import FusionConfig
from .setup import filter_model

_FUSED = int(Outcome.FUSED)  # numpy asks an enumeration for attributes, as long as it compares a whole column
_MOST_ESTIMATES = 10_000_000
_LAGS = 2.0  # of an arm that is not known yet, until an axis follows its commands
_KEPT = 3  # orders of the events: those of a search's point, and a little earlier and later

# What may become of a row, besides its outcome: a command that says again what is in force; outside of --from and --to;
# without a stamp, or with a stray one; of a sensor that is not among those to use.
REPETITION, OUTSIDE, NO_STAMP_WORD, NOT_SELECTED = "repetition", "outside", "no_stamp", "not_selected"

_REASONS = {
    Outcome.DUPLICATE: "the stamp and values of an earlier row",
    Outcome.BEFORE_START: "a time before the first command",
    Outcome.TOO_LATE: "a stamp more than 1 s behind an earlier one",
}
WHOLE = ALWAYS, NEVER
_Kept: TypeAlias = dict[tuple[int, ...], tuple[Events, IntArray]]  # by delays and latencies


@dataclass(frozen=True)
class Segment:
    """One segment of a run, ready to be filtered.

    Attributes:
        axes: The commanded axes.
        sensors: The sensors, the configured ones first in their order.
        origin: The first command, int ns: time 0 of the run.
        start: The level u₀ [m] of each axis.
        commands: When commands were given, int64 ns, ascending, (n,).
        command_rows: Rows of the commands by stamp, with time = stamp.
        measurement_rows: Rows of all sensors, one sensor after the other, each by stamp.
        notes: Every anomaly once: how many, where first.
        turn: After which angle each sensor's measurements of an axis are the same again [rad], 0 for never, (S, A).
        command_counts: How many rows of the commands are ``used``, and of the others how many are left out for what.
        counts: Likewise of each sensor of the run, ``fused`` being those that the filter decides on.
        ends: First and last stamp of the part that is used, int ns; before it there are commands only.
    """

    axes: tuple[str, ...]
    sensors: tuple[str, ...]
    origin: int
    start: Mapping[str, float]
    commands: TimeArray
    command_rows: Events
    measurement_rows: Events
    notes: tuple[str, ...]
    turn: FloatArray
    command_counts: Mapping[str, int]
    counts: Mapping[str, Mapping[str, int]]
    ends: tuple[int, int] = (ALWAYS, NEVER)
    _latest: _Kept = field(default_factory=_Kept, init=False, repr=False, compare=False)

    def events(self, config: FusionConfig) -> tuple[Events, IntArray]:
        """The events in their total order, by the delays and latencies of ``config``.

        Returns:
            The events; and where among them each of ``measurement_rows`` is.
        """
        times = (*self._delay(config).tolist(), *self._latency(config).tolist())
        cached = self._latest.get(times)  # a search asks for many configurations of the same times
        if cached is None:
            events, order = self._order(config)
            index = np.empty(len(order), dtype=np.int64)
            index[order] = np.arange(len(order))
            cached = self._latest[times] = events, index[len(order) - len(self.measurement_rows.time) :]
            for oldest in list(self._latest)[:-_KEPT]:
                self._latest.pop(oldest, None)  # threads share it
        return cached

    def events_once(self, config: FusionConfig) -> Events:
        """The events in their order where nobody will ask again: nothing of them is kept here."""
        return self._order(config)[0]

    def _order(self, config: FusionConfig) -> tuple[Events, IntArray]:
        """The events by time, a command once for each delay of its axes; and the order that sorts them."""
        delay, rows, measured = self._delay(config), self.command_rows, self.measurement_rows
        parts, shift = list[Events](), list[IntArray]()
        for group in sorted(set(delay.tolist())):
            codes = np.where(delay == group, rows.codes, np.uint8(ABSENT))
            parts.append(rows._replace(codes=codes).where(on_any_axis(codes, Outcome.FUSED)))
            shift.append(np.full(len(parts[-1].time), group))
        unordered = concatenate([*parts, measured])
        time = unordered.stamp + np.concatenate([*shift, -self._latency(config)[measured.source]])
        time[unordered.stamp == NO_STAMP] = NO_STAMP
        order = np.argsort(time, kind="stable")  # each source is in its order: commands, then the sensors'
        return unordered._replace(time=time).rows(order), order

    def _delay(self, config: FusionConfig) -> IntArray:
        """Dead time of each axis, int ns."""
        return np.array([round(config.arm.delay_of(axis) * 1e9) for axis in self.axes])

    def _latency(self, config: FusionConfig) -> IntArray:
        """Latency of each sensor, int ns."""
        latency = [config.sensors[name].latency if name in config.sensors else 0.0 for name in self.sensors]
        return np.rint(np.array(latency) * 1e9).astype(np.int64)

    def commands_of(self, axis: str) -> tuple[TimeArray, FloatArray]:
        """Stamps [int64 ns] and values [m] of the commands of one axis, (n,)."""
        number, rows = self.axes.index(axis), self.command_rows
        chosen = np.flatnonzero(rows.codes[:, number] == _FUSED)
        return rows.stamp.take(chosen), rows.value[:, number].take(chosen)

    def response(self, arm: ArmModel, axis: str, time: TimeArray, model: AxisModel | None = None) -> FloatArray:
        """Where the commands lead an axis [m or rad], beyond its start, at ``time`` [int64 ns], (n,).

        Args:
            arm: Says how the axis answers.
            axis: Which.
            time: Ascending, (n,).
            model: How it answers instead, but for its delay.
        """
        model, delay = model or arm.axes[axis], arm.delay_of(axis)
        return response(model, arm.update_period, delay, *self.commands_of(axis), self.start[axis], time)

    def rows_by_sensor(self) -> dict[str, Events]:
        """The rows of each sensor that has any, by stamp; angles go on beyond a turn."""
        rows = self.measurement_rows._replace(value=self.unwrap())  # one sensor after the other
        begin = np.searchsorted(rows.source, np.arange(len(self.sensors) + 1)).tolist()
        by_sensor = {name: rows.rows(slice(*ends)) for name, ends in zip(self.sensors, pairwise(begin), strict=True)}
        return {name: part for name, part in by_sensor.items() if len(part.time)}

    def unwrap(self) -> FloatArray:
        """Values of ``measurement_rows`` without the jumps of a sensor that measures within a turn, (rows, A)."""
        rows = self.measurement_rows
        if not self.turn.any():
            return rows.value
        value = rows.value.copy()
        for sensor, axis in np.argwhere(self.turn > 0.0).tolist():
            rows_of_sensor = (rows.source == sensor) & np.isfinite(value[:, axis])
            value[rows_of_sensor, axis] = np.unwrap(value[rows_of_sensor, axis], period=float(self.turn[sensor, axis]))
        return value

    def select_axis(self, axis: str, rows: IntArray) -> Segment:
        """The segment with one axis alone, and some of its measurements' ``rows``."""
        column = [self.axes.index(axis)]
        commands = np.flatnonzero(self.command_rows.codes[:, column[0]] == _FUSED)
        return replace(
            self,
            axes=(axis,),
            command_rows=self.command_rows.rows(commands).columns(column),
            measurement_rows=self.measurement_rows.rows(rows).columns(column),
            turn=self.turn[:, column],
        )

    def highest_speed(self, axis: str, period: float) -> float:
        """Highest commanded speed on an axis [m/s or rad/s]."""
        return float(np.abs(np.diff(self.commands_of(axis)[1], prepend=self.start[axis])).max(initial=0.0)) / period

    def end(self, config: FusionConfig, as_live: bool) -> int:
        """Where an even grid of estimates ends, int ns: with the last command or measurement.

        A measurement counts by when it is valid; as live by its stamp, fused or not, since a stream knows the time by
        stamps alone.
        Measurements an hour after the last command are on another clock.
        """
        rows = self.measurement_rows
        if as_live:
            time = rows.stamp
        else:
            time = _valid(rows.stamp, self._latency(config)[rows.source])[on_any_axis(rows.codes, Outcome.FUSED)]
        return int(time[time <= self.commands[-1] + LONGEST_TAIL_NS].max(initial=self.commands[-1]))

    def asking_times(self, times: TimeArray, on_grid: bool) -> TimeArray | None:
        """When a stream gives the estimates at ``times``, by the clock of arrivals [int ns], (n,); None without one.

        It does as each command comes, or ``on_grid`` just before the first event that is stamped later.
        """
        if not len(self.command_rows.arrival) + len(self.measurement_rows.arrival):
            return None
        rows = concatenate([self.command_rows, self.measurement_rows])
        if not on_grid:
            return rows.arrival.take(np.searchsorted(self.command_rows.stamp, times, side="right") - 1)
        order = np.argsort(rows.stamp)
        first = np.minimum.accumulate(np.append(rows.arrival[order], NEVER)[::-1])[::-1]
        return first.take(np.searchsorted(rows.stamp[order], times, side="right")) - 1


def build_segment(
    run: Run,
    config: FusionConfig,
    sensors: Iterable[str] | None = None,
    begun: Segment | None = None,
    span: tuple[int, int] = WHOLE,
) -> Segment:
    """Put a segment of a recorded run into a table of events.

    A piece of a run has the origin and the start levels of the one that has ``begun`` it; of its rows those after and
    until the instants ``span`` [int ns] are counted, the others are there to be compared with them.
    """
    _check_axes(run, config.arm)
    label, notes = run.command.label, list(run.notes)
    chosen = config.sensor_names(sensors)
    strangers = [name for name in run.sensors if name not in config.sensors] if sensors is None else []
    used = (*(name for name in chosen if name in run.sensors), *strangers)
    policy = _policy(config, run.axes, used)
    rows = _command_rows(run, policy, notes)
    unstamped = len(run.command.stamp) - len(rows.stamp)
    command_counts = _command_counts(rows.rows(owned_rows(rows.stamp, span)), unstamped)
    rows = _on_ticks(run, config, rows, notes)
    used_rows = on_any_axis(rows.codes, Outcome.FUSED)
    origin = begun.origin if begun else int(rows.stamp[used_rows][0])
    ends = run.ends(origin)
    within = rows.stamp <= ends[1]
    outside = int(np.count_nonzero((used_rows & ~within)[owned_rows(rows.stamp, span)]))
    command_counts = nonzero(command_counts | {"used": command_counts["used"] - outside, OUTSIDE: outside})
    commands, rows = rows.stamp[used_rows & within], rows.where(within)
    notes += _unmatched_notes([name for name in chosen if name not in run.sensors], strangers)
    commands = commands[np.diff(commands, prepend=commands[0] - 1) > 0]
    late = [axis for axis, codes in zip(run.axes, rows.codes.T, strict=True) if _FUSED not in codes]
    if late and not begun:
        raise RunError(f"{label}: no command for axis '{late[0]}' {run.interval} after the first command")
    first_fused = {axis: (rows.codes[:, number] == _FUSED).argmax() for number, axis in enumerate(run.axes)}
    first = {axis: float(rows.value[row, number]) for number, (axis, row) in enumerate(first_fused.items())}
    parts = [
        _measurement_rows(run, config, number, used, policy, rows, origin, span, notes) for number in range(len(used))
    ]
    measured = concatenate([Events.empty(len(run.axes)), *(part for part, _ in parts)])
    counts = {
        name: {NOT_SELECTED: len(sensor.stamp[owned_rows(sensor.stamp, span)])} for name, sensor in run.sensors.items()
    }
    counts |= {name: held for name, (_, held) in zip(used, parts, strict=True)}
    if run.interval and span == WHOLE and not (measured.codes == _FUSED).any():
        raise RunError(f"run '{run.name}': no measurement to use is stamped {run.interval} after the first command")
    return Segment(
        axes=run.axes,
        sensors=used,
        origin=origin,
        start=begun.start if begun else {**first, **run.start},
        commands=commands,
        command_rows=rows,
        measurement_rows=measured,
        notes=tuple(notes),
        turn=np.ascontiguousarray(policy.view["turn"]),
        command_counts=command_counts,
        counts=counts,
        ends=ends,
    )


def output_times(
    segment: Segment, config: FusionConfig, rate: float | None, as_live: bool = False, span: tuple[int, int] = WHOLE
) -> TimeArray:
    """When estimates are asked for: at each command, or on an even grid of ``rate`` [Hz] from the first command on."""
    since, until = max(segment.ends[0], span[0] + 1), min(segment.ends[1], span[1])
    if rate is None:
        times = segment.commands[(segment.commands >= since) & (segment.commands <= until)]
    else:
        last = min(until, segment.end(config, as_live)) if span[1] >= segment.ends[1] else until
        times = _grid(segment.origin, max(since, segment.origin), last, rate)
    if not len(times) and span == WHOLE:
        raise no_estimates(rate)
    return times


def no_estimates(rate: float | None) -> RunError:
    """The error for a part of a run in which no estimate is asked for."""
    what = "no command" if rate is None else f"no tick of {rate:g} Hz"
    return RunError(f"there is {what} in the part of the run to use, so no estimate: a longer one, or another --rate")


def _grid(origin: int, first: int, last: int, rate: float) -> TimeArray:
    """Ticks 0, 1/rate, … [1/Hz] after ``origin`` that lie from ``first`` to ``last``, int64 ns, (n,)."""
    span = max(last - first, 0)
    begin, count = int((first - origin) / 1e9 * rate), int(span / 1e9 * rate) + 2
    if count > _MOST_ESTIMATES:
        raise RunError(
            f"{rate:g} estimates a second over {span / 86400e9:.1f} days are {count:.1e} estimates, more than"
            f" {_MOST_ESTIMATES:.0e}: a lower --rate? Or are not all stamps on one clock?"
        )
    grid = origin + np.rint(np.arange(begin, begin + count) * (1e9 / rate)).astype(np.int64)
    return grid[(grid >= first) & (grid <= last)]


def believed_commands(run: Run, config: FusionConfig) -> Source:
    """The rows of a run's commands as they are believed: as logged, or where the run says so on the grid of T."""
    if run.clock == "stamps":
        return run.command
    rows = _on_ticks(run, config, _command_rows(run, _policy(config, run.axes, ()), []), [])
    value = np.where(rows.codes == _FUSED, rows.value, np.nan)
    return Source(rows.stamp, dict(zip(run.axes, value.T, strict=True)), run.command.label)


def _check_axes(run: Run, arm: ArmModel) -> None:
    """Whether the arm has the axes of the run, of its kinds and in its frame."""
    label = run.command.label
    for axis in run.axes:
        if axis in CARTESIAN and axis not in arm.axes:
            raise RunError(
                f"{label}: commands are in x, y, z, the arm '{arm.name}' has {', '.join(arm.axes)}: write an arm.toml"
                " with axes x, y, z, or give a [frame] in run.toml or fusion.toml"
            )
        if axis not in arm.axes:
            raise UnknownNameError(f"{label}: the arm '{arm.name}' has no such axis", "axis", axis, arm.axes)
    for axis, kind in run.kinds.items():
        if axis in arm.axes and kind != arm.axes[axis].kind:
            raise RunError(
                f"run '{run.name}': {axis} is {AN[kind]}, the arm '{arm.name}' says {AN[arm.axes[axis].kind]}; give"
                f' [axes.{axis}] kind = "{kind}", or columns of the other unit; without -c `fuse` fits an arm anew'
            )
    for name, source in run.sensors.items():
        if any(axis in CARTESIAN and axis not in run.axes for axis in source.values):
            raise RunError(
                f"sensor '{name}' is in x, y, z, the commands are not; give a [frame], and them in x, y, z too"
            )


def _policy(config: FusionConfig, axes: Sequence[str], sensors: Sequence[str]) -> Model:
    """The model by which values are classified before the filter runs; every axis has a start level."""
    return filter_model(config, axes, sensors, dict.fromkeys(axes, 0.0))


def _unmatched_notes(silent: Sequence[str], strangers: Sequence[str]) -> list[str]:
    """A sentence on each configured sensor that the run does not have: one of another name may be the same."""
    unmatched: list[str] = []
    for name in silent:
        close = strangers if len(silent) == len(strangers) == 1 else get_close_matches(name, strangers, n=1)
        similar = (
            f"; is '{close[0]}', which the configuration does not have, the same? One name for both" if close else ""
        )
        unmatched.append(f"sensor '{name}' of the configuration has no measurements in this run{similar}")
    return unmatched


def _command_rows(run: Run, policy: Model, notes: list[str]) -> Events:
    """The stamped command rows of a segment in order, with time = stamp, each value classified; ``notes`` are added."""
    source = run.command
    missing, label = source.stamp == NO_STAMP, source.label
    note_rows(notes, label, missing, "no stamp: not used")
    note_rows(notes, label, behind(source.stamp) > 0, "a stamp that steps back: sorted")
    order = in_order(source.stamp, int(np.count_nonzero(missing)))
    rows = _build_table(source, run.axes, order, COMMAND)
    if len(rows.arrival):  # what is sent again is there from the first time on
        again = (np.diff(rows.stamp) == 0) & (np.diff(np.nan_to_num(rows.value), axis=0) == 0.0).all(axis=1)
        first = np.maximum.accumulate(np.where(np.append(False, again), 0, np.arange(len(rows.stamp))))
        rows = rows._replace(arrival=rows.arrival.take(first))
    rows = rows._replace(codes=classify(policy, rows, 0, np.zeros_like(missing[order])))
    if len(source.stray):
        rows.codes[source.stray[order][:, None] & (rows.codes == int(Outcome.INVALID))] = int(Outcome.STRAY)
    note_rows(notes, label, source.repeated() & ~missing, "the stamp and values of an earlier row: duplicate")
    for number, axis in enumerate(run.axes):
        codes, hollow = rows.codes[:, number], np.zeros(len(missing), dtype=np.bool_)
        hollow[order] = codes == int(Outcome.INVALID)
        note_rows(notes, label, hollow, f"no finite {axis} command: not used")
        if not (codes == _FUSED).any():
            raise RunError(f"{label}: no command for axis '{axis}' is a number below 1e6 m or rad")
    return rows


def _command_counts(rows: Events, unstamped: int) -> dict[str, int]:
    """How many rows of the commands are what, those without a stamp too; of a stamp the last one counts."""
    best = best_of(rows.codes)
    again, hidden = best == int(Outcome.DUPLICATE), np.diff(rows.stamp, append=NEVER) == 0
    return {
        "used": int(np.count_nonzero(best == _FUSED)),
        Outcome.DUPLICATE.word: int(np.count_nonzero(again & hidden)),
        REPETITION: int(np.count_nonzero(again & ~hidden)),
        **{outcome.word: int(np.count_nonzero(best == int(outcome))) for outcome in (Outcome.INVALID, Outcome.STRAY)},
        NO_STAMP_WORD: unstamped,
    }


def sum_counts(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """The sums of several counts."""
    return dict(sum(map(Counter[str], counts), Counter[str]()))


def nonzero(counts: Mapping[str, int]) -> dict[str, int]:
    """The counts that are not 0."""
    return {word: count for word, count in counts.items() if count}


def _on_ticks(run: Run, config: FusionConfig, rows: Events, notes: list[str]) -> Events:
    """The command rows; where the run's clock is regular those that are used, on a grid of T."""
    if run.clock == "stamps":
        return rows
    label = run.command.label
    rows = rows.where(on_any_axis(rows.codes, Outcome.FUSED))
    distinct, tick = np.unique(rows.stamp, return_inverse=True)
    grid, note = regular_grid(distinct, config.arm.update_period, label)
    notes.extend([] if note is None else [note])
    return rows._replace(time=grid[tick], stamp=grid[tick])


def _measurement_rows(
    run: Run,
    config: FusionConfig,
    number: int,
    names: Sequence[str],
    policy: Model,
    commands: Events,
    origin: int,
    span: tuple[int, int],
    notes: list[str],
) -> tuple[Events, dict[str, int]]:
    """The rows of one of the sensors ``names`` by stamp, each value classified; how many rows have which outcome."""
    name = names[number]
    source, sensor = run.sensors[name], config.sensors.get(name)
    label, used = source.label_for(name), run.within(source.stamp, origin)
    lag, missing = np.where(used, behind(source.stamp), 0), used & (source.stamp == NO_STAMP)
    order = in_order(source.stamp)
    latency = 0 if sensor is None else round(sensor.latency * 1e9)
    rows = _build_table(source, run.axes, order, number, latency)
    rows = rows._replace(codes=classify(policy, rows, origin, lag[order] > TOLERATED_STEP_BACK_NS))
    rows.codes[~used[order]] = ABSENT
    if sensor is not None:
        notes += _mark_held(rows, commands, config, name, label, run.axes, origin)
    kept = rows.where(used[order])
    stamps = source.stamp[owned_rows(_valid(source.stamp, latency), span)]
    counts = _measurement_counts(kept.rows(owned_rows(kept.time, span)), stamps)
    note_rows(notes, label, lag > 0, "a stamp that steps back: sorted")
    if sensor is None:
        note_rows(notes, label, used, "no sensor of this name in the configuration: unknown")
        return kept, counts
    note_rows(notes, label, missing, f"no stamp: {Outcome.INVALID.word}")
    if ((rows.codes == _FUSED) | (rows.codes == ABSENT)).all():
        return kept, counts
    codes = np.empty_like(rows.codes)
    codes[order] = rows.codes
    for kind, reason in _REASONS.items():
        note_rows(notes, label, on_any_axis(codes, kind), f"{reason}: {kind.word}")
    for column, axis in enumerate(run.axes):
        if axis in source.values and sensor.sd_of(axis) is None:
            sd = of_kind("sd_mm", config.arm.axes[axis].kind)
            notes.append(f"{label}: {sd} has no entry for {axis}, which is not used: {Outcome.UNKNOWN.word}")
        hollow = (codes[:, column] == int(Outcome.INVALID)) & ~missing
        note_rows(notes, label, hollow, f"no finite {axis} value: {Outcome.INVALID.word}")
    return kept, counts


def _mark_held(
    rows: Events, commands: Events, config: FusionConfig, name: str, label: str, axes: Sequence[str], origin: int
) -> list[str]:
    """Mark what one sensor says again and again as held; a sentence on each axis where it does."""
    notes = list[str]()
    for column, axis in enumerate(axes):
        rows_seen, rows_commanded = (
            np.flatnonzero(table_of_rows.codes[:, column] == _FUSED) for table_of_rows in (rows, commands)
        )
        stamp, command = rows.stamp[rows_seen], (commands.stamp[rows_commanded], commands.value[rows_commanded, column])
        again, times = held(stamp, rows.value[rows_seen, column], command, latest_follow(config, name, axis))
        if again.any():
            rows.codes[rows_seen[again], column] = int(Outcome.HELD)
            first, last = seconds(stamp[again][[0, -1]], origin).tolist()
            slow = f"{axis} gives each value {times} times, as a sensor that is slower than its rows"
            froze = f"{axis} repeats its value to the last digit while the commands move it (did it freeze?)"
            notes.append(
                f"{label}: {slow if times > 1 else froze}, from {first:.2f} to {last:.2f} s: each value counts once,"
                f" {np.count_nonzero(again)} are {Outcome.HELD.word}"
            )
    return notes


def latest_follow(config: FusionConfig, sensor: str, axis: str) -> int:
    """How long after its command a sensor shows that an axis moves, at most [ns]: the arm may not be known yet."""
    late = config.arm.lag_of(axis) + abs(config.sensors[sensor].latency)
    return round((_LAGS * late + config.arm.update_period) * 1e9)


def _measurement_counts(kept: Events, stamp: TimeArray) -> dict[str, int]:
    """How many rows of a sensor are what, those of every ``stamp``, of which ``kept`` are in the part to use."""
    unstamped = int(np.count_nonzero(stamp == NO_STAMP))
    best = best_of(kept.codes)[kept.stamp != NO_STAMP]
    number = np.bincount(best, minlength=len(Outcome)).tolist()
    of_outcomes = {outcome.word: number[outcome] for outcome in Outcome}
    return nonzero({**of_outcomes, NO_STAMP_WORD: unstamped, OUTSIDE: len(stamp) - unstamped - len(best)})


def _build_table(
    source: Source, axes: tuple[str, ...], order: IntArray | slice, number: int, latency: int = 0
) -> Events:
    """Rows of a source in an order, everything that it gives for the filter to decide on."""
    stamp = source.stamp[order].copy()
    shape = len(stamp), len(axes)
    value, codes = np.full(shape, np.nan), np.full(shape, ABSENT, dtype=np.uint8)
    spread = np.ones(shape if source.spread or len(source.noise) else (0, len(axes)))
    for axis, column in source.values.items():
        at = axes.index(axis)
        value[:, at] = column[order]
        codes[:, at] = np.where(np.isnan(value[:, at]), ABSENT, _FUSED) if source.apart else _FUSED
        if axis in source.spread:
            spread[:, at] = source.spread[axis][order]
    if len(source.noise):
        spread *= source.noise[order, None]
    time, numbers = _valid(stamp, latency), np.full(len(stamp), number, dtype=np.int16)
    arrival = source.arrival[order].copy() if len(source.arrival) else source.arrival
    return Events(time, numbers, stamp, value, spread, codes, arrival)


def best_of(codes: CodeArray) -> CodeArray:
    """The outcome of each row that got farthest, (n,)."""
    return reduce(np.minimum, codes.T)


def on_any_axis(codes: CodeArray, kind: Outcome) -> BoolArray:
    """Rows of which a value is of a kind, (n,); ``any(axis=1)`` takes twenty times as long for few axes."""
    return reduce(np.logical_or, (codes == int(kind)).T)


def owned_rows(time: TimeArray, span: tuple[int, int]) -> IntArray | slice:
    """Which rows of a piece are its own: those without a stamp too, which no other piece has."""
    if span == WHOLE:
        return slice(None)
    return np.flatnonzero((time > span[0]) & (time <= span[1]) | (time == NO_STAMP))


def _valid(stamp: TimeArray, latency: IntArray | int) -> TimeArray:
    """When measurements are valid, int64 ns; ``NO_STAMP`` without a stamp."""
    return np.where(stamp == NO_STAMP, NO_STAMP, stamp - latency)
