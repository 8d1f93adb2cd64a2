"""A segment through the filter: from events to estimates, and what became of each measurement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..arrays import NO_STAMP, CodeArray, FloatArray, TimeArray
from ..filter.core import Filter, Model, Record, linearise
from ..filter.events import Events, Results
from ..filter.outcome import Outcome
from .config import FusionConfig
from .estimates import AxisEstimate, Bias, Mode
from .segments import Segment
from .setup import filter_model

Engine = Literal["compiled", "filterpy"]
_NO_TIMES = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class Filtered:
    """What the filter makes of one segment."""

    axes: dict[str, AxisEstimate]  # estimates by axis
    events: Events  # what it was given
    results: Results  # what became of them
    biases: dict[str, dict[str, Bias]]  # by sensor and axis, as all measurements together know them


def filter_segment(
    segment: Segment,
    config: FusionConfig,
    times: TimeArray,
    mode: Mode,
    engine: Engine = "compiled",
    progress: Callable[[float], None] | None = None,
    asked: TimeArray | None = None,
) -> Filtered:
    """Filter or smooth one segment; ``times`` of the estimates ascend, int64 ns, none before the origin.

    As live they know what had come until they are ``asked`` for, see :meth:`.Segment.asking_times`.
    """
    events = segment.events_once(config)
    model, results = model_of(segment, config), _allocate_results(events)
    if engine == "filterpy":
        from ..filter import reference

        plants = [config.arm.axes[axis].plant for axis in segment.axes]
        slow_core = reference.Filter(plants, model, segment.origin, events)
        outputs = slow_core.run(results, times, progress)
        return _build_filtered(segment, outputs, events, results, slow_core.bias)
    core = Filter(model, segment.origin)
    return _build_filtered(segment, core.run(events, results, times, mode, asked=asked), events, results, core.bias)


def filter_piece(
    segment: Segment, core: Filter, config: FusionConfig, times: TimeArray, span: tuple[int, int]
) -> Filtered:
    """Filter a piece of a segment as the whole of it would be, with the filter as the pieces before have left it.

    Events after and until the instants ``span`` [int ns] are the piece's own; those without a stamp come first.
    """
    events = segment.events_once(config)
    begin, end = np.searchsorted(events.time, span, side="right").tolist()
    results = _allocate_results(events)
    outputs = core.run(events, results, times, span=(begin, end))
    rows = np.r_[: np.searchsorted(events.time, NO_STAMP, side="right"), begin:end]
    return _build_filtered(segment, outputs, events.rows(rows), results.rows(rows), core.bias)


def innovations(segment: Segment, config: FusionConfig, outcome: CodeArray | None = None) -> Results:
    """Innovations and outcomes of a segment, without any estimate; by its ``measurement_rows``.

    With outcomes of an earlier fusion, (m, A), these are repeated whatever the gates would say.
    """
    events, index = segment.events(config)
    results = _allocate_results(events)
    if outcome is not None:
        results.outcome[index] = outcome
    core = Filter(_drop_doubts(model_of(segment, config)), segment.origin)
    core.run(events, results, _NO_TIMES, "filtered" if outcome is None else "repeated")
    return results.rows(index)


def innovation_derivatives(
    segment: Segment, config: FusionConfig, outcome: CodeArray, beside: Sequence[tuple[FusionConfig, float]]
) -> tuple[Results, FloatArray, FloatArray]:
    """Innovations as of :func:`innovations`, and derivatives of ν and of S by k parameters, (k, m, A) each.

    ``beside`` has, for each, a configuration with another value of it, and by how much that is more: the numbers of a
    model are linear in it.
    """
    events, index = segment.events(config)
    results = _allocate_results(events)
    results.outcome[index] = outcome
    model, *others = (_drop_doubts(model_of(segment, each)) for each in (config, *(other for other, _ in beside)))
    slopes = [_slopes(*parts, widths=[width for _, width in beside]) for parts in zip(model, *others, strict=True)]
    tangents = [Model(*parts) for parts in zip(*slopes, strict=True)]
    d_nu, d_s = linearise(model, tangents, segment.origin, events, results)
    return results.rows(index), d_nu[:, index], d_s[:, index]


def _slopes(records: Record, *others: Record, widths: Sequence[float]) -> Record:
    """How every number of some records changes to each of ``others``, ``widths`` of a parameter apart, (k, …)."""
    numbers = np.stack([each.view(np.float64) for each in (records, *others)])
    change = (numbers[1:] - numbers[0]) / np.reshape(widths, (-1, *[1] * records.ndim))
    return np.nan_to_num(change).view(records.dtype)  # NaN where there is none: no level, no sd


def model_of(segment: Segment, config: FusionConfig) -> Model:
    """What the filter knows of a segment's axes and sensors, with the biases of those that measure."""
    return filter_model(config, segment.axes, segment.sensors, segment.start, biased_sensors(segment, config))


def _drop_doubts(model: Model) -> Model:
    """The model without error bars of lag and gain, which depend on the numbers that are fitted and change no ν."""
    model.axis["lag_sd"] = model.axis["gain_sd"] = 0.0
    return model


def biased_sensors(segment: Segment, config: FusionConfig) -> list[list[str]]:
    """For each axis the sensors whose bias is in its state: those that measure it, in their order."""
    rows = segment.measurement_rows
    return [
        [
            name
            for number, name in enumerate(segment.sensors)
            if name in config.sensors
            and config.sensors[name].is_biased(axis)
            and (codes[rows.source == number] == int(Outcome.FUSED)).any()
        ]
        for axis, codes in zip(segment.axes, rows.codes.T, strict=True)
    ]


def _allocate_results(events: Events) -> Results:
    """Room for what becomes of events, which begins with their codes."""
    results = Results.room(*events.codes.shape)
    results.outcome[:] = events.codes
    return results


def _build_filtered(
    segment: Segment,
    outputs: FloatArray,
    events: Events,
    results: Results,
    bias: Callable[[int, int], tuple[float, float] | None],
) -> Filtered:
    axes, biases = dict[str, AxisEstimate](), dict[str, dict[str, Bias]]()
    for number, axis in enumerate(segment.axes):
        axes[axis] = AxisEstimate(segment.start[axis] + outputs[0, number], *outputs[1:, number])
        for index, name in enumerate(segment.sensors):
            if (state_of_bias := bias(index, number)) is not None:
                biases.setdefault(name, {})[axis] = Bias(*state_of_bias)
    return Filtered(axes, events, results, biases)
