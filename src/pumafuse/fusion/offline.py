"""Offline fusion of a recorded run: :func:`fuse`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar, get_args

import numpy as np
import numpy.typing as npt

from ..arrays import NO_STAMP, TimeArray
from ..errors import warn
from ..filter.events import COMMAND, Events
from ..filter.outcome import ABSENT, Outcome
from ..logs.clock import clock_faults, segments
from ..logs.frames import Cylindrical, Placed
from ..logs.run import Run
from ..logs.source import Source
from ..model.arm import ArmModel
from ..units import Kind, seconds
from .config import FusionConfig
from .engine import Engine, Filtered, filter_segment
from .estimates import AxisEstimate, Estimates, Measurements, Mode
from .faults import Fault, by_axis, check_sensors, latency_questions, starts_in_motion
from .overruns import overrun_notes, overruns
from .placing import in_base
from .score import late_rows, reference_track
from .segments import NO_STAMP_WORD, Segment, best_of, build_segment, nonzero, on_any_axis, output_times, sum_counts
from .verdicts import sensor_problems

S = TypeVar("S", bound=np.generic)
UNCOVERED = "the reference covers no estimate: are both stamped by one clock?"


class Part(NamedTuple):
    """A segment of a run, or a piece of it, that went through the filter."""

    logged: Run
    segment: Segment
    times: TimeArray
    filtered: Filtered


def fuse(
    run: Run,
    config: FusionConfig,
    *,
    sensors: Iterable[str] | None = None,
    rate: float | None = None,
    mode: Mode = "filtered",
    engine: Engine = "compiled",
    progress: Callable[[float], None] | None = None,
) -> Estimates:
    """Blend a run's commands and measurements into the best estimate of where the tool was.

    Args:
        run: The recorded run.
        config: Arm, noise and sensors.
        sensors: Which of the configured sensors to use; all of them for None.
        rate: Estimates on an even grid [Hz] from the first command on; one for each command for None.
        mode: What an estimate knows: ``filtered``, all measurements that are valid by then; ``as-live``, only those
            that had arrived by then, as a live user would have had; ``smoothed``, every measurement of the run.
        engine: ``compiled``, or ``filterpy``, the reference: the same meaning, a thousand times slower.
        progress: Called now and then by the reference engine with the share done, 0 to 1.

    Returns:
        Estimates in the run's own coordinates, and what became of each measurement.

    Warns:
        PumafuseWarning: For each anomaly in the data and each limit of the model that is passed.

    Raises:
        PumafuseError: Run and configuration do not fit together.
        ValueError: ``rate`` is not positive, or there is no such mode or engine.
    """
    if rate is not None and not 0.0 < rate < np.inf:
        raise ValueError(f"rate must be positive and finite, got {rate}")
    for what, chosen, accepted in (("engine", engine, get_args(Engine)), ("mode", mode, get_args(Mode))):
        if chosen not in accepted:
            raise ValueError(f"no {what} '{chosen}'; there are: {', '.join(accepted)}")
    if engine == "filterpy" and mode != "filtered":
        raise ValueError(f"the filterpy engine gives filtered estimates only; mode '{mode}' needs the compiled one")
    selected = None if sensors is None else config.sensor_names(sensors)
    in_place, placed, config = in_base(run, config)
    logged, jumps = segments(in_place)
    parts, clocks, faults, moving = list[Part](), list[str](), list[Fault](), list[str]()
    for part in logged:
        measuring = [name for name in config.sensor_names(selected) if name in part.sensors]
        clocks += clock_faults(part, config.arm.update_period, measuring)
        segment = build_segment(part, config, selected)
        faults += check_sensors(segment, config)
        moving += starts_in_motion(segment, config)
        times = output_times(segment, config, rate, mode == "as-live")
        share = None if progress is None else partial(_share, progress, len(parts), len(logged))
        asked = segment.asking_times(times, rate is not None)
        filtered = filter_segment(segment, config, times, mode, engine, share, asked)
        segment = replace(segment, measurement_rows=Events.empty(len(segment.axes)))  # the result has them
        parts.append(Part(part, segment, times, filtered))
        del segment
    est = estimates_of(run, in_place, placed, config, parts, mode, engine)
    notes = [*clocks, *(fault.sentence for fault in faults), *row_notes(est, parts), *moving]
    notes += latency_questions(config, parts[0].segment.sensors)
    notes += [*jumps, *_reference_notes(est), *config.arm.validity.excess(est.speed, est.radius)]
    notes += overrun_notes([overruns(part.segment, config.arm) for part in parts], config.arm, est.origin)
    parts.clear()  # their tables are as large as what est has of them
    est = replace(est, notes=(*notes, *sensor_problems(est)), rate=rate, selected=selected, faults=by_axis(faults))
    warn(f"run '{run.name}': {note}" for note in est.notes)
    return est


def judge(run: Run, segment: Segment, config: FusionConfig) -> Estimates:
    """What became of the measurements of a run in the arm's axes, which is one ``segment``; no estimate, no note."""
    times = np.empty(0, dtype=np.int64)
    part = Part(run, segment, times, filter_segment(segment, config, times, "filtered"))
    return estimates_of(run, run, None, config, [part])


def estimates_of(
    run: Run,
    in_place: Run,
    placed: Placed | None,
    config: FusionConfig,
    parts: Sequence[Part],
    mode: Mode = "filtered",
    engine: Engine = "compiled",
) -> Estimates:
    """What the segments of a run give together, without notes."""
    _, cut, times, filtered = zip(*parts, strict=True)
    origin = cut[0].origin
    references = _references(parts, origin)
    track = reference_track(references, origin) if references else None
    rows = [_row_counts(segment, part) for segment, part in zip(cut, filtered, strict=True)]
    axes = {
        axis: AxisEstimate(
            *(_concatenate(getattr(part.axes[axis], field) for part in filtered) for field in AxisEstimate.FIELDS)
        )
        for axis in cut[0].axes
    }
    return Estimates(
        run=run.name,
        time=seconds(_concatenate(times), origin),
        axes=axes,
        cartesian=placed and placed.in_log({axis: estimate.position for axis, estimate in axes.items()}),
        measurements=_measurements(cut, filtered),
        biases=filtered[-1].biases,
        reference=track and replace(track, cartesian=placed and placed.in_log(track.position)),
        origin=origin,
        segment=np.repeat(np.arange(len(parts)), [len(part) for part in times]),
        segments=cut,
        mode=mode,
        engine=engine,
        config=config,
        speed=_highest_speeds(cut, config.arm),
        radius=_highest_radius(in_place, placed),
        command_counts=_recount_strays([part.command_counts for part in cut], run.command, in_place.command),
        counts={
            name: _recount_strays([part[name] for part in rows], source, in_place.sensors[name])
            for name, source in run.sensors.items()
        },
        notes=(),
        since=run.since,
        until=run.until,
        placed=placed,
    )


def row_notes(est: Estimates, parts: Sequence[Part]) -> list[str]:
    """A sentence on each thing that is wrong with rows, and on sensors that contradict each other."""
    sentences = [note for part in parts for note in part.segment.notes]
    sentences += [
        note for part in parts for note in _contradictions(part.segment, est.config, part.filtered, est.origin)
    ]
    references = _references(parts, est.origin)
    late = sum(int(np.count_nonzero(late_rows(source.stamp))) for source in references)
    if late:
        sentences.append(
            f"{references[0].label}: {late} rows are stamped more than 1 s behind an earlier one: not used"
        )
    return sentences


def _share(progress: Callable[[float], None], number: int, count: int, done: float) -> None:
    progress((number + done) / count)


def _concatenate(parts: Iterable[npt.NDArray[S]]) -> npt.NDArray[S]:
    """Arrays of segments, one after the other."""
    arrays = list(parts)
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _references(parts: Sequence[Part], origin: int) -> list[Source]:
    """The rows of the reference in the part of each segment that is used."""
    return [
        source.rows(part.logged.within(source.stamp, origin))
        for part in parts
        if (source := part.logged.reference) is not None
    ]


def _reference_notes(est: Estimates) -> list[str]:
    """A sentence if the reference has no row at the time of any estimate."""
    if est.reference is None:
        return []
    is_known = [np.isfinite(value) for axis, value in est.reference.position.items() if axis in est.axes]
    time = est.reference.time[np.any(is_known, axis=0)] if is_known else np.empty(0)
    apart = not len(time) or time.max() < est.time.min() or time.min() > est.time.max()
    return [UNCOVERED] if apart else []


def _highest_speeds(cut: Sequence[Segment], arm: ArmModel) -> dict[Kind, float]:
    """The highest commanded speed of the axes of each kind [m/s or rad/s]."""
    highest_speeds: dict[Kind, float] = {}
    for axis in cut[0].axes:
        fastest = max(part.highest_speed(axis, arm.update_period) for part in cut)
        highest_speeds[arm.axes[axis].kind] = max(highest_speeds.get(arm.axes[axis].kind, 0.0), fastest)
    return highest_speeds


def _highest_radius(run: Run, placed: Placed | None) -> float | None:
    """The commands' greatest distance from the base's axis [m]; None where no cylindrical frame says where that is."""
    if placed is None or not isinstance(placed.frame, Cylindrical) or "radial" not in run.command.values:
        return None
    radial = run.command.values["radial"]
    return float(np.max(radial[np.isfinite(radial) & (run.command.stamp != NO_STAMP)]))


def _contradictions(segment: Segment, config: FusionConfig, filtered: Filtered, origin: int) -> list[str]:
    """A sentence on each pair of sensors of which one contradicts the other time after time."""
    events, results, contradictions = filtered.events, filtered.results, list[str]()
    rows = np.flatnonzero(results.contradicts >= 0)
    pairs = events.source[rows].astype(np.int64) * len(segment.sensors) + results.contradicts[rows]
    for pair in sorted(set(pairs.tolist())):
        sensor, other = divmod(pair, len(segment.sensors))
        rows_of_pair = rows[pairs == pair]
        first, count = rows_of_pair[0], len(rows_of_pair)
        rejected = np.flatnonzero(results.outcome[first] == Outcome.REJECTED)
        off = [
            f"{name} by {screen.scale * results.innovation[first, axis]:+.4g} {screen.unit}"
            for axis in rejected.tolist()
            if (screen := config.arm.screen_of(name := segment.axes[axis]))
        ]
        contradictions.append(
            f"sensor '{segment.sensors[sensor]}' contradicts '{segment.sensors[other]}' since"
            f" {(int(events.time[first]) - origin) / 1e9:.2f} s ({', '.join(off)}), {count} times:"
            " its measurements are rejected; which of the two is wrong?"
        )
    return contradictions


def _row_counts(segment: Segment, filtered: Filtered) -> dict[str, dict[str, int]]:
    """What became of the rows of each sensor in one segment, those included that the filter decided on."""
    source, codes = filtered.events.source, filtered.events.codes
    decided = np.flatnonzero((source != COMMAND) & on_any_axis(codes, Outcome.FUSED))
    best = best_of(filtered.results.outcome)[decided]
    cell, size = source[decided].astype(np.int64) * len(Outcome) + best, len(segment.sensors) * len(Outcome)
    table = np.bincount(cell, minlength=size).reshape(-1, len(Outcome)).tolist()
    counts_of = {name: dict(counts) for name, counts in segment.counts.items()}
    for name, row in zip(segment.sensors, table, strict=True):
        if counts_of[name].pop(Outcome.FUSED.word, 0):
            counts_of[name] |= {outcome.word: row[outcome] for outcome in Outcome if row[outcome]}
    return counts_of


def _recount_strays(parts: Sequence[Mapping[str, int]], logged: Source, mended: Source) -> dict[str, int]:
    """The sum of the segments' counts of a source, stray stamps apart from none."""
    total = sum_counts(parts)
    unstamped, word = total.get(NO_STAMP_WORD, 0), Outcome.STRAY.word
    stray = min(int(np.count_nonzero(logged.stamp != mended.stamp)), unstamped)
    return nonzero(total | {NO_STAMP_WORD: unstamped - stray, word: total.get(word, 0) + stray})


def _measurements(cut: Sequence[Segment], filtered: Sequence[Filtered]) -> Measurements:
    """Every component of every measurement in the order of the filter."""
    first, columns = cut[0], list[tuple[npt.NDArray[Any], ...]]()
    for number, (events, results) in enumerate((part.events, part.results) for part in filtered):
        measured = np.repeat(events.source != COMMAND, len(first.axes))  # (n, 1) & (n, A) is slow
        rows = np.flatnonzero(measured & (events.codes != ABSENT).ravel())
        row = rows // len(first.axes)
        time, stamp = (seconds(part, first.origin).take(row) for part in (events.time, events.stamp))
        sensor, axis = events.source.take(row), (rows - row * len(first.axes)).astype(np.int16)
        del row, measured  # of a long run each array counts
        segment = np.full(len(rows), number, dtype=np.int16)
        spread = events.spread if len(events.spread) else np.ones_like(events.value)
        numbers = events.value, spread, results.innovation, results.innovation_sd, results.noise_scale, results.outcome
        columns.append((time, stamp, sensor, axis, segment, *(part.take(rows) for part in numbers)))
    return Measurements(*map(_concatenate, zip(*columns, strict=True)), sensors=first.sensors, axes=first.axes)
