"""Offline fusion of a recorded run: :func:`fuse`."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import get_args

import numpy as np

from ..arrays import NO_STAMP, FloatArray, TimeArray
from ..errors import PumafuseWarning
from ..filter.events import COMMAND
from ..filter.outcome import ABSENT, Outcome
from ..logs.axes import in_axes
from ..logs.clock import segments
from ..logs.frames import Cylindrical, Placed
from ..logs.run import Run
from ..units import MM, seconds
from .config import FusionConfig
from .consistency import sensor_problems
from .engine import Engine, Filtered, filter_segment
from .estimates import AxisEstimate, Estimates, Measurements, Mode
from .reference import joined_references, late_rows, reference_track
from .score import interpolated
from .segments import Segment, build, output_times


def fuse(
    run: Run,
    config: FusionConfig,
    *,
    sensors: Iterable[str] | None = None,
    rate: float | None = None,
    smooth: bool = False,
    as_live: bool = False,
    engine: Engine = "compiled",
    progress: Callable[[float], None] | None = None,
) -> Estimates:
    """Blend a run's commands and measurements into the best estimate of where the tool was.

    Args:
        run: The recorded run.
        config: Arm, noise and sensors.
        sensors: Which of the configured sensors to use; all of them for None.
        rate: Estimates on an even grid [Hz] from the first command on; one for each command for None.
        smooth: An estimate knows every measurement of the run, later ones too.
        as_live: An estimate knows only the measurements that had arrived by then, as a live user would have had.
        engine: ``compiled``, or ``filterpy``, the reference: the same meaning, hundreds of times slower.
        progress: Called now and then by the reference engine with the share done, 0 to 1.

    Returns:
        Estimates in the run's own coordinates, and what became of each measurement.

    Warns:
        PumafuseWarning: For each anomaly in the data and each limit of the model that is passed.

    Raises:
        PumafuseError: Run and configuration do not fit together.
        ValueError: ``rate`` is not positive, there is no such engine, or ``smooth`` and ``as_live`` are both asked for.
    """
    if rate is not None and not 0.0 < rate < np.inf:
        raise ValueError(f"rate must be positive and finite, got {rate}")
    if engine not in get_args(Engine):
        raise ValueError(f"no engine '{engine}'; there are: {', '.join(get_args(Engine))}")
    if smooth and as_live:
        raise ValueError("smooth uses every measurement and as_live only those that had arrived; choose one")
    if engine == "filterpy" and (smooth or as_live):
        raise ValueError("the filterpy engine gives filtered estimates only; smooth and as_live need the compiled one")
    mode: Mode = "smoothed" if smooth else "as-live" if as_live else "filtered"
    chosen = None if sensors is None else tuple(sensors)
    in_place, placed = in_axes(run, config.frame)
    logged, jumps = segments(in_place)
    parts: list[Estimates] = []
    for number, part in enumerate(logged):
        built = build(part, config, chosen)
        times = output_times(built, config, rate)
        share = None if progress is None else _share(progress, number, len(logged))
        parts.append(_fuse_segment(part, placed, built, times, config, mode, engine, share))
    joined = _joined(parts, jumps)
    excess = config.arm.validity.excess(joined.speed, joined.radius)
    joined = replace(
        joined, notes=(*joined.notes, *_reference_notes(joined, logged), *excess, *sensor_problems(joined))
    )
    for note in joined.notes:
        warnings.warn(f"run '{run.name}': {note}", PumafuseWarning, stacklevel=2)
    return joined


def _reference_notes(est: Estimates, parts: Sequence[Run]) -> list[str]:
    """What is wrong with the reference: rows behind a jump of its clock, or nothing near any estimate."""
    if est.reference is None:
        return []
    sources = [part.reference for part in parts if part.reference is not None]
    late = sum(int(np.sum(late_rows(source))) for source in sources)
    found = (
        [f"{sources[0].label}: {late} rows are stamped more than 1 s behind an earlier one: not used"] if late else []
    )
    known = [name for name in est.axes if name in est.reference.position]
    if not any(np.isfinite(interpolated(est.time, est.segment, est.reference, name)).any() for name in known):
        found.append("the reference covers no estimate: are both stamped by one clock?")
    return found


def _share(progress: Callable[[float], None], number: int, count: int) -> Callable[[float], None]:
    return lambda done: progress((number + done) / count)


def _fuse_segment(
    run: Run,
    placed: Placed | None,
    segment: Segment,
    times: TimeArray,
    config: FusionConfig,
    mode: Mode,
    engine: Engine,
    progress: Callable[[float], None] | None,
) -> Estimates:
    filtered = filter_segment(segment, config, times, mode, engine, progress)
    origin = segment.origin
    return Estimates(
        run=run.name,
        time=seconds(times, origin),
        axes=filtered.axes,
        cartesian=None if placed is None else _cartesian(placed, filtered.axes),
        measurements=_measurements(segment, filtered),
        biases=filtered.biases,
        reference=None if run.reference is None else reference_track(run.reference, origin),
        origin=origin,
        last_command=(int(segment.commands[-1]) - origin) / 1e9,
        segment=np.zeros(len(times), dtype=np.int64),
        mode=mode,
        engine=engine,
        config=config,
        speed=segment.highest_speed(config.arm.update_period),
        radius=_highest_radius(run, placed),
        notes=(*segment.notes, *_contradictions(segment, filtered)),
    )


def _cartesian(placed: Placed, axes: Mapping[str, AxisEstimate]) -> dict[str, FloatArray]:
    """Estimates in the log's x, y and z [m], those that the axes give."""
    found: dict[str, FloatArray] = {}
    if "tangential" in axes and "radial" in axes:
        found["x"], found["y"] = placed.to_log(axes["tangential"].position, axes["radial"].position)
    if "vertical" in axes:
        found["z"] = axes["vertical"].position.copy()
    return found


def _highest_radius(run: Run, placed: Placed | None) -> float | None:
    """The commands' greatest distance from the base's axis [m]; None where no cylindrical frame says where that is."""
    if placed is None or not isinstance(placed.frame, Cylindrical) or "radial" not in run.command.values:
        return None
    radial = run.command.values["radial"]
    return float(np.max(radial[np.isfinite(radial) & (run.command.stamp != NO_STAMP)]))


def _contradictions(segment: Segment, filtered: Filtered) -> list[str]:
    """A sentence on each pair of sensors of which one contradicts the other time after time."""
    events, results, found = filtered.events, filtered.results, list[str]()
    rows = np.flatnonzero(results.contradicts >= 0)
    if not len(rows):
        return []
    pair = events.source[rows].astype(np.int64) * len(segment.sensors) + results.contradicts[rows]
    for one in np.unique(pair).tolist():
        sensor, other = divmod(one, len(segment.sensors))
        mine = rows[pair == one]
        first, count = mine[0], len(mine)
        rejected = np.flatnonzero(results.outcome[first] == Outcome.REJECTED)
        off = [f"{segment.axes[axis]} by {results.innovation[first, axis] * MM:+.4g} mm" for axis in rejected.tolist()]
        since = (int(events.time[first]) - segment.origin) / 1e9
        found.append(
            f"sensor '{segment.sensors[sensor]}' contradicts '{segment.sensors[other]}' since {since:.2f} s"
            f" ({', '.join(off)}), {count} times: its measurements are rejected; which of the two is wrong?"
        )
    return found


def _measurements(segment: Segment, filtered: Filtered) -> Measurements:
    """Every component of every measurement in the order of the filter."""
    events, results = filtered.events, filtered.results
    given = np.flatnonzero((events.source != COMMAND)[:, None] & (events.known != ABSENT))
    row = given // len(segment.axes)
    axis = given - row * len(segment.axes)
    return Measurements(
        time=seconds(events.time, segment.origin)[row],
        stamp=seconds(events.stamp, segment.origin)[row],
        sensor=events.source[row],
        axis=axis.astype(np.int16),
        value=events.value.take(given),
        innovation=results.innovation.take(given),
        innovation_sd=results.innovation_sd.take(given),
        outcome=results.outcome.take(given),
        sensors=segment.sensors,
        axes=segment.axes,
    )


def _joined(parts: Sequence[Estimates], jumps: Sequence[str]) -> Estimates:
    """Segments one after the other, all in seconds since the run's first command."""
    first = parts[0]
    if len(parts) == 1:
        return first
    late = [(part.origin - first.origin) / 1e9 for part in parts]
    numbers = list(zip(parts, late, range(len(parts)), strict=True))
    axes = {
        name: AxisEstimate(
            *(np.concatenate([getattr(part[name], field) for part in parts]) for field in AxisEstimate.FIELDS)
        )
        for name in first.axes
    }
    cartesian = {
        name: np.concatenate([part.cartesian[name] for part in parts if part.cartesian is not None])
        for name in first.cartesian or ()
    }
    shifted = [
        replace(part.measurements, time=part.measurements.time + t, stamp=part.measurements.stamp + t)
        for part, t, _ in numbers
    ]
    references = [(part.reference, shift, number) for part, shift, number in numbers if part.reference is not None]
    reference = joined_references(references) if references else None
    return replace(
        first,
        time=np.concatenate([part.time + shift for part, shift, _ in numbers]),
        axes=axes,
        cartesian=None if first.cartesian is None else cartesian,
        measurements=Measurements.joined(shifted),
        biases=parts[-1].biases,
        reference=reference,
        last_command=max(part.last_command + shift for part, shift, _ in numbers),
        segment=np.concatenate([np.full(len(part.time), number) for part, _, number in numbers]),
        speed=max(part.speed for part in parts),
        radius=max((part.radius for part in parts if part.radius is not None), default=None),
        notes=(*(note for part in parts for note in part.notes), *jumps),
    )
