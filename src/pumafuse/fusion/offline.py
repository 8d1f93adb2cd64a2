"""Offline fusion of a recorded run: :func:`fuse`."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from ..arrays import NO_STAMP, TimeArray
from ..errors import PumafuseWarning
from ..runs.clock import segments
from ..runs.run import Reference, Run
from ..units import seconds
from . import timeline as timelines
from .config import FusionConfig
from .estimates import Estimates, Mode, Readings, ReferenceTrack
from .timeline import Timeline
from .track import AxisEstimate, Filtered, estimate

Engine = Literal["filterpy"]


def fuse(
    run: Run,
    config: FusionConfig,
    *,
    sensors: Iterable[str] | None = None,
    rate: float | None = None,
    as_live: bool = False,
    engine: Engine = "filterpy",
    progress: Callable[[float], None] | None = None,
) -> Estimates:
    """Blend a run's commands and readings into the best estimate of where the tool was.

    Args:
        run: The recorded run.
        config: Arm, noise and sensors.
        sensors: Which of the configured sensors to use; all of them for None.
        rate: Estimates on an even grid [Hz] from the first command on; one for each command for None.
        as_live: An estimate knows only the readings that had arrived by then, as a live user would have had.
        engine: ``filterpy``, the reference engine.
        progress: Called now and then with the share done, 0 to 1.

    Returns:
        Estimates in the run's own coordinates, and what became of each reading.

    Warns:
        PumafuseWarning: For each anomaly in the data and each limit of the model that is passed.

    Raises:
        PumafuseError: Run and configuration do not fit together.
        ValueError: ``rate`` is not positive, or there is no such engine.
    """
    if rate is not None and not 0.0 < rate < np.inf:
        raise ValueError(f"rate must be positive and finite, got {rate}")
    if engine != "filterpy":
        raise ValueError(f"no engine '{engine}'; there is: filterpy")
    chosen = None if sensors is None else tuple(sensors)
    parts, said = segments(run)
    fused: list[Estimates] = []
    for number, part in enumerate(parts):
        built = timelines.build(part, config, chosen)
        times = timelines.output_times(built, rate)
        share = None if progress is None else _share(progress, number, len(parts))
        fused.append(_fuse_segment(part, built, times, config, as_live, share))
    joined = _joined(fused, said)
    excess = config.arm.validity.excess(joined.speed, None)
    joined = replace(joined, notes=(*joined.notes, *excess))
    for note in joined.notes:
        warnings.warn(f"run '{run.name}': {note}", PumafuseWarning, stacklevel=2)
    return joined


def _share(progress: Callable[[float], None], number: int, count: int) -> Callable[[float], None]:
    return lambda done: progress((number + done) / count)


def _fuse_segment(
    run: Run,
    timeline: Timeline,
    times: TimeArray,
    config: FusionConfig,
    as_live: bool,
    progress: Callable[[float], None] | None,
) -> Estimates:
    from .augmented import ReferenceEngine

    engine = ReferenceEngine(timeline, config)
    filtered = engine.filter_as_live(times, progress) if as_live else engine.filter(progress)
    axes: dict[str, AxisEstimate] = {}
    for axis, track in zip(timeline.axes, filtered.tracks, strict=True):
        held = track if as_live else track.at(times)
        axes[axis.name] = estimate(held, times, config.arm.axes[axis.name].plant, axis.start)
    mode: Mode = "as-live" if as_live else "filtered"
    origin = timeline.origin
    return Estimates(
        run=run.name,
        time=seconds(times, origin),
        axes=axes,
        readings=_readings(timeline, filtered),
        reference=None if run.reference is None else reference_track(run.reference, origin),
        origin=origin,
        segment=np.zeros(len(times), dtype=np.int64),
        mode=mode,
        engine="filterpy",
        config=config,
        speed=timeline.speed,
        notes=timeline.notes,
    )


def _readings(timeline: Timeline, filtered: Filtered) -> Readings:
    scalars = timeline.scalars
    return Readings(
        time=seconds(scalars.valid, timeline.origin),
        stamp=seconds(scalars.stamp, timeline.origin),
        sensor=scalars.sensor,
        axis=scalars.axis,
        value=scalars.value,
        innovation=filtered.innovation,
        innovation_sd=filtered.innovation_sd,
        outcome=filtered.outcome,
        sensors=scalars.sensors,
        axes=tuple(axis.name for axis in timeline.axes),
    )


def reference_track(reference: Reference, origin: int) -> ReferenceTrack:
    """A run's reference in order and in seconds since ``origin`` (int ns)."""
    order = np.argsort(reference.stamp, kind="stable")
    order = order[reference.stamp[order] != NO_STAMP]
    position = {axis: value[order] for axis, value in reference.values.items()}
    return ReferenceTrack(
        seconds(reference.stamp[order], origin), position, reference.sd, np.zeros(len(order), dtype=np.int64)
    )


def _joined(parts: Sequence[Estimates], said: Sequence[str]) -> Estimates:
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
    shifted = [
        replace(part.readings, time=part.readings.time + t, stamp=part.readings.stamp + t) for part, t, _ in numbers
    ]
    references = [(part.reference, shift, number) for part, shift, number in numbers if part.reference is not None]
    reference = None
    if references:
        reference = ReferenceTrack(
            np.concatenate([track.time + shift for track, shift, _ in references]),
            {
                axis: np.concatenate([track.position[axis] for track, _, _ in references])
                for axis in references[0][0].position
            },
            references[0][0].sd,
            np.concatenate([np.full(len(track.time), number) for track, _, number in references]),
        )
    return replace(
        first,
        time=np.concatenate([part.time + shift for part, shift, _ in numbers]),
        axes=axes,
        readings=Readings.joined(shifted),
        reference=reference,
        segment=np.concatenate([np.full(len(part.time), number) for part, _, number in numbers]),
        speed=max(part.speed for part in parts),
        notes=(*(note for part in parts for note in part.notes), *said),
    )
