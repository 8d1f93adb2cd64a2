"""Fusion of a long run piece by piece: one filter whose state goes on from piece to piece.

Each piece is a table of events of its own (:func:`pumafuse.fusion.segments.build_segment`) with some rows of the pieces
before and after it, so that every row has the neighbours that it has in the whole run: estimates and outcomes are the
same to the last bit. What the neighbourhood of a row says in words (notes, skill) is said piece by piece.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from .. import folders
from ..arrays import ALWAYS, NEVER
from ..errors import RunError, warn
from ..filter.core import Filter
from ..fusion import results
from ..fusion.config import FusionConfig
from ..fusion.engine import filter_piece
from ..fusion.estimates import Estimates
from ..fusion.faults import by_axis, check_sensors, latency_questions, starts_in_motion
from ..fusion.offline import Part, estimates_of, row_notes
from ..fusion.placing import in_base
from ..fusion.results import Recipe
from ..fusion.segments import Segment, build_segment, no_estimates, output_times
from ..fusion.setup import filter_model
from ..fusion.summary import Summary, encode
from ..fusion.verdicts import sensor_problems
from ..logs import tables
from ..logs.clock import TOLERATED_STEP_BACK_NS, behind, clock_faults
from ..logs.manifest import stamps_of
from ..logs.run import Run
from ..logs.set_back import drop_steps_back
from .merging import Digest, digest, merge
from .reading import Log

PIECE = 1_000_000  # rows that are read at a time
_SETTLED = 10.0  # lags after which a motion is over
_IN_ORDER = "so long a run is fused piece by piece, in the order of time: cut the log there"


def fuse_to(
    path: Path, folder: Path, recipe: Recipe, force: bool = False, progress: Callable[[float], None] | None = None
) -> Summary:
    """Fuse a long run, filtered, into a result folder that is written as it goes: complete, or not at all."""
    results.check_writable(folder, force)
    stamps = stamps_of(path)
    with folders.replacing(folder) as new:
        results.write_stamps(new, stamps)
        digests = list[Digest]()
        with ExitStack() as files:
            names = results.ESTIMATES, results.MEASUREMENTS, results.REFERENCE
            write = [files.enter_context(tables.appending(new / name)) for name in names]
            for est, span, done in _pieces(Log(path), recipe):
                write[0](results.estimates_table(est))
                write[1](results.measurements_table(est))
                if est.reference is not None:
                    since, until = ((instant - est.origin) / 1e9 for instant in span)
                    write[2](results.reference_table(est.reference.between(since, until), est.config))
                digests.append(digest(est, span))
                if progress is not None:
                    progress(done)
        if not any(digest.estimates for digest in digests):
            raise no_estimates(recipe.rate)
        summary = merge(digests)
        results.check_fused(summary.rows, recipe.config)
        recipe.config.save(new)
        (new / results.SUMMARY).write_bytes(encode(summary))
    warn(f"run '{summary.run}': {note}" for note in summary.notes)
    return summary


def _pieces(log: Log, recipe: Recipe) -> Iterator[tuple[Estimates, tuple[int, int], float]]:
    """The estimates of each piece, after and until which instants [ns], and which share of the run is done by then."""
    ahead, overlap = _margins(recipe.config)
    begun, after, until = None, ALWAYS, ALWAYS
    while until < NEVER:
        cut = log.read_on(PIECE)
        run = log.run()
        if run is None or cut - ahead <= after:
            continue
        run = run.between(*recipe.part)
        begun = begun or _begin(run, recipe.config, recipe.selected)
        over = cut - ahead > run.ends(begun[0].origin)[1] + overlap
        until = NEVER if cut == NEVER or over else cut - ahead
        est = _piece(run, recipe, *begun, (after, until))
        yield est, (after, until), 1.0 if until == NEVER else log.done / log.rows
        stamps = [est.segments[0].commands_of(axis)[0] for axis in est.axes]
        log.drop(until - overlap, np.concatenate([stamp[stamp <= until][-1:] for stamp in stamps]))
        after = until


def _margins(config: FusionConfig) -> tuple[int, int]:
    """How far a piece must be read ahead, and how far it goes back into the one before [int ns]."""
    latency = max((abs(sensor.latency) for sensor in config.sensors.values()), default=0.0)
    lag = max(config.arm.lag_of(axis) for axis in config.arm.axes)
    ahead = round((latency + 2.0 * config.arm.update_period) * 1e9)
    return ahead, ahead + TOLERATED_STEP_BACK_NS + round(_SETTLED * lag * 1e9)


def _begin(run: Run, config: FusionConfig, chosen: Sequence[str] | None) -> tuple[Segment, Filter]:
    """What the pieces of a run share, by its first rows: its first segment, and the filter, at rest before it."""
    run = in_base(run.between(), config)[0]
    segment = build_segment(run, config, chosen)
    biases = [
        [
            name
            for name in segment.sensors
            if name in config.sensors and config.sensors[name].is_biased(axis) and axis in run.sensors[name].values
        ]
        for axis in segment.axes
    ]
    model = filter_model(config, segment.axes, segment.sensors, segment.start, biases)
    return segment, Filter(model, segment.origin)


def _piece(run: Run, recipe: Recipe, begun: Segment, core: Filter, span: tuple[int, int]) -> Estimates:
    """The estimates of the rows after and until the instants ``span`` [int ns], with notes."""
    moved, steps = drop_steps_back(run)
    if moved is not run:
        raise RunError(f"{steps[0]}; {_IN_ORDER}")
    in_place, placed, config = in_base(run, recipe.config, whole=False)
    lag, label = behind(in_place.command.stamp) / 1e9, run.command.label
    if lag.max() * 1e9 > TOLERATED_STEP_BACK_NS:
        raise RunError(f"{label}: the clock is set back by {lag.max():.3f} s; {_IN_ORDER}")
    segment = build_segment(in_place, config, recipe.selected, begun, span)
    times = output_times(segment, config, recipe.rate, span=span)
    filtered = filter_piece(segment, core, config, times, span)
    first = span[0] == ALWAYS
    if not first:  # for those who ask where the commands lead: the arm rests at what was commanded before
        segment = replace(segment, start={axis: float(segment.commands_of(axis)[1][0]) for axis in segment.axes})
    part = Part(in_place, segment, times, filtered)
    est = estimates_of(run, in_place, placed, config, [part])
    faults = check_sensors(segment, config)
    notes = [*clock_faults(in_place, config.arm.update_period, []), *(fault.sentence for fault in faults)]
    notes += row_notes(est, [part])
    if first:
        notes += [*starts_in_motion(segment, config), *latency_questions(config, segment.sensors)]
    notes += sensor_problems(est)
    return replace(est, notes=tuple(notes), rate=recipe.rate, selected=recipe.selected, faults=by_axis(faults))
