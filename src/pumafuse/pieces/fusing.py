"""A long run fused a piece at a time: one filter goes through all of it, its state is carried on.

The events of a piece are ordered and classified by the functions that do so for a whole run; of them the new ones go
through the filter.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..arrays import NEVER, NO_STAMP, TimeArray
from ..errors import RunError
from ..filter.axis import Model, Sensors, State
from ..filter.outcome import Outcome
from ..fusion.config import FusionConfig
from ..fusion.consistency import sensor_problems
from ..fusion.engine import Filtered, arranged, filter_piece
from ..fusion.estimates import Bias, Estimates
from ..fusion.faults import latency_questions, sensor_faults, starts_in_motion
from ..fusion.offline import contradictions, gathered, highest_speeds
from ..fusion.segments import (
    NO_STAMP_WORD,
    NOT_SELECTED,
    STRAY,
    Segment,
    added,
    build,
    counts_of_commands,
    counts_of_measurements,
    ticks,
)
from ..logs import manifest
from ..logs.axes import in_axes
from ..logs.clock import clock_faults
from ..logs.frames import Cylindrical
from ..logs.run import Run
from ..units import Kind
from .reading import LOOK_BACK_NS, Piece, pieces

_PERIODS = 4.0  # of update, for which commands are remembered beside delays


@dataclass(frozen=True)
class Part:
    """What a piece adds to the result.

    Attributes:
        est: Its estimates and measurements; its reference has rows from before and after them, too.
        biases: As all measurements until then know them.
        within: After when and until when it is [s since the first command], infinite at the run's ends.
        share: How much of the run was read, 0 to 1.
    """

    est: Estimates
    biases: Mapping[str, Mapping[str, Bias]]
    within: tuple[float, float]
    share: float


def parts(path: Path, config: FusionConfig, sensors: Iterable[str] | None, rate: float | None) -> Iterator[Part]:
    """The filtered estimates of a run, a piece at a time.

    Raises:
        PumafuseError: Run and configuration do not fit together, or the run cannot be fused in pieces.
    """
    chosen = None if sensors is None else config.sensor_names(sensors)
    latencies = [one.latency for one in config.sensors.values()]
    latest, delay = max([0.0, *latencies]), max(config.arm.delay_of(axis) for axis in config.arm.axes)
    overlap = delay + max([0.0, *map(abs, latencies)]) + _PERIODS * config.arm.update_period + 1.0
    fusing = _Fusing(config, chosen, rate)
    for piece in pieces(path, round(latest * 1e9), round(overlap * 1e9)):
        yield fusing.part(piece)


class _Fusing:
    """The filter on its way through a run, and what holds for all of it."""

    def __init__(self, config: FusionConfig, chosen: tuple[str, ...] | None, rate: float | None) -> None:
        self._config, self._chosen, self._rate = config, chosen, rate
        self._first: Segment | None = None
        self._arrays: tuple[Model, Sensors, State] | None = None
        self._has_moved = False
        self._known = set[tuple[str, str]]()  # biases, by sensor and axis

    def part(self, piece: Piece) -> Part:
        """Fuse the next piece."""
        config, first = self._config, self._first
        _check(piece.run, config)
        run, placed = in_axes(piece.run, config.frame)
        run = run if first is None else replace(run, start=first.start)
        segment = build(run, config, self._chosen, None if first is None else first.origin)
        notes = [*segment.notes, *self._faults(run, segment)]
        if self._arrays is None:
            self._first, self._arrays = segment, arranged(segment, config, _biased(run, segment, config))
        times = self._times(segment, piece)
        filtered = filter_piece(segment, config, self._arrays, (piece.after, piece.until), times)
        segment = _with_counts(segment, run, filtered, piece)
        of_piece = replace(filtered, biases=self._first_known(filtered, segment))
        est = gathered(run, config, run, placed, [run], [(segment, times, of_piece)], "filtered", "compiled")
        notes += [*_unplaced(piece), *contradictions(segment, config, filtered, segment.origin)]
        est = replace(_counted(est, piece), speed=_speed(segment, config, first is None))
        est = replace(est, notes=(*notes, *sensor_problems(est)))
        within = (
            -np.inf if first is None else (piece.after - est.origin) / 1e9,
            np.inf if piece.until == NEVER else (piece.until - est.origin) / 1e9,
        )
        return Part(est, filtered.biases, within, piece.share)

    def _first_known(self, filtered: Filtered, segment: Segment) -> dict[str, dict[str, Bias]]:
        """The biases that no measurement before this piece has determined."""
        fused = filtered.results.outcome == Outcome.FUSED
        found: dict[str, dict[str, Bias]] = {}
        for name, biases in filtered.biases.items():
            mine = fused[filtered.events.source == segment.sensors.index(name)].any(axis=0)
            for axis, bias in biases.items():
                if mine[segment.axes.index(axis)] and (name, axis) not in self._known:
                    self._known.add((name, axis))
                    found.setdefault(name, {})[axis] = bias
        return found

    def _faults(self, run: Run, segment: Segment) -> list[str]:
        """What the first piece, and the first one in which every axis moves, show of the sensors."""
        config, found, moves = self._config, list[str](), all(np.ptp(segment.given(axis)[1]) for axis in segment.axes)
        if self._first is None:
            asked = [name for name in config.sensor_names(self._chosen) if name in run.sensors]
            found += clock_faults(run, config.arm.update_period, asked)
            found += [*starts_in_motion(segment, config), *latency_questions(config, segment.sensors)]
        if moves and not self._has_moved:
            self._has_moved = True
            found += sensor_faults(segment, config)
        return found

    def _times(self, segment: Segment, piece: Piece) -> TimeArray:
        """When estimates are asked for among what is new."""
        if self._rate is None:
            given = segment.commands
            return given[(given > piece.after) & (given <= piece.until)]
        last = segment.end(self._config) if piece.until == NEVER else piece.until
        begin = max(piece.after + 1, segment.origin)
        return ticks(segment.origin, begin, last, self._rate) if begin <= last else np.zeros(0, dtype=np.int64)


def _check(run: Run, config: FusionConfig) -> None:
    """Refuse what needs a whole run.

    Raises:
        RunError: It is such a run.
    """
    frame, asks = run.frame or config.frame, "which asks for the whole run, and this one is too long for the memory"
    if run.clock == "regular":
        raise RunError(f"{run.command.label}: clock = 'regular', {asks}: use the stamps, or cut the log")
    if isinstance(frame, Cylindrical):
        raise RunError(f"run '{run.name}': a cylindrical [frame], {asks}: log the axes of the arm, or cut the log")


def _biased(run: Run, segment: Segment, config: FusionConfig) -> list[list[str]]:
    """For each axis the sensors whose bias is in its state: those that have a column for it."""
    known = [name for name in segment.sensors if name in config.sensors]
    return [
        [name for name in known if axis in run.sensors[name].values and config.sensors[name].is_biased(axis)]
        for axis in segment.axes
    ]


def _with_counts(segment: Segment, run: Run, filtered: Filtered, piece: Piece) -> Segment:
    """The segment with counts of what is new alone."""
    rows, counts = segment.command_rows, dict[str, dict[str, int]]()
    new = np.flatnonzero((rows.stamp > piece.after) & (rows.stamp <= piece.until))
    unstamped = int(np.count_nonzero(run.command.stamp == NO_STAMP))
    for name, source in run.sensors.items():
        if name in segment.sensors:
            mine = filtered.events.rows(np.flatnonzero(filtered.events.source == segment.sensors.index(name)))
            counts[name] = counts_of_measurements(mine, mine.stamp)
        else:
            stamp = source.stamp
            is_new = ((stamp > piece.after) & (stamp <= piece.until)) | (stamp == NO_STAMP)
            counts[name] = {NOT_SELECTED: int(np.count_nonzero(is_new))}
    return replace(segment, command_counts=counts_of_commands(rows.rows(new), unstamped), counts=counts)


def _unplaced(piece: Piece) -> list[str]:
    """A sentence on each sensor with rows that found no place."""
    return [
        f"{name}: {count} rows come more than {LOOK_BACK_NS / 1e9:g} s behind later ones: too late, and not in"
        " measurements.parquet"
        for name, count in piece.unplaced.items()
        if count
    ]


def _counted(est: Estimates, piece: Piece) -> Estimates:
    """The estimates with counts of all rows of the piece that are new."""
    strays, unplaced = piece.strays, piece.unplaced
    counts = {name: _counts(one, strays.get(name, 0), unplaced.get(name, 0)) for name, one in est.counts.items()}
    return replace(est, command_counts=_counts(est.command_counts, strays.get(manifest.COMMAND, 0)), counts=counts)


def _counts(known: Mapping[str, int], stray: int, unplaced: int = 0) -> dict[str, int]:
    """The counts of a source with stray stamps apart from none, and the rows that found no place."""
    more = {STRAY: stray, NO_STAMP_WORD: -stray, Outcome.TOO_LATE.word: unplaced}
    return {word: count for word, count in added([known, more]).items() if count}


def _speed(segment: Segment, config: FusionConfig, first: bool) -> dict[Kind, float]:
    """The highest commanded speeds; of a later piece its first command is no step from the start."""
    if not first:
        segment = replace(segment, start={axis: float(segment.given(axis)[1][0]) for axis in segment.axes})
    return highest_speeds([segment], config.arm)
