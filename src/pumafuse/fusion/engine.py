"""A segment through the filter: from events to estimates, and what became of each measurement."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..arrays import NO_STAMP, CodeArray, TimeArray
from ..filter.axis import Model, Sensors, State
from ..filter.events import COMMAND, Events, Results
from ..filter.forward import ALL_THERE, NO_ESTIMATES, Filter, History, Output, filter_events, no_history
from ..filter.outcome import Outcome
from ..filter.smoother import smooth
from .config import FusionConfig
from .estimates import AxisEstimate, Bias, Mode
from .segments import Segment
from .setup import Column, at_rest, columns_of, filter_model, filter_sensors

Engine = Literal["compiled", "filterpy"]


@dataclass(frozen=True)
class Filtered:
    """What the filter makes of one segment.

    Attributes:
        axes: Estimates by axis.
        events: What it was given.
        results: What became of them.
        biases: By sensor and axis, as all measurements together know them.
    """

    axes: dict[str, AxisEstimate]
    events: Events
    results: Results
    biases: dict[str, dict[str, Bias]]


def filter_segment(
    segment: Segment,
    config: FusionConfig,
    times: TimeArray,
    mode: Mode,
    engine: Engine = "compiled",
    progress: Callable[[float], None] | None = None,
) -> Filtered:
    """Filter or smooth one segment.

    Args:
        segment: The events.
        config: Arm, noise and sensors.
        times: Of the estimates, int64 ns, ascending, none before the origin.
        mode: Which measurements an estimate knows.
        engine: Which filter; ``filterpy`` only filters.
        progress: Called now and then by the filterpy engine with the share done, 0 to 1.
    """
    events, _ = segment.events(config)
    biases, axes, count = biased_sensors(segment, config), len(segment.axes), len(events.time)
    arrival, queue, places = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), 0
    if mode == "as-live":
        arrival = np.where(events.source == COMMAND, events.stamp, np.maximum(events.stamp, events.time))
        queue = np.argsort(arrival, kind="stable")
        places = _most_taken_back(events.time, arrival, times) + 1
    model, sensors, state = arranged(segment, config, biases, places)
    width, arrived = state.x.shape[1], np.zeros(len(queue), dtype=np.bool_)
    history = _history(events, state, len(times)) if mode == "smoothed" else no_history(axes, width)
    results = Results.room(count, axes)
    results.outcome[:] = events.known
    outputs = np.zeros((len(Output), axes, len(times)))
    if engine == "filterpy":
        from ..filter import filterpy_engine

        plants = [config.arm.axes[axis] for axis in segment.axes]
        filterpy_engine.filter_events(plants, model, sensors, events, state, times, results, outputs, progress)
    else:
        arrays = Filter(model, sensors, events, state, results, history).flat()
        filter_events(arrays, False, 0, count, count, arrival, queue, arrived, places, times, outputs)
    if mode == "smoothed":
        room = np.empty((2, width)), np.empty((2, width, width)), np.empty((1, 4, width)), np.empty((width + 1, width))
        smooth(model, sensors, events, results, history, segment.origin, times, room, outputs)
    estimates = {
        axis: AxisEstimate(segment.start[axis] + outputs[0, number], *outputs[1:, number])
        for number, axis in enumerate(segment.axes)
    }
    return Filtered(estimates, events, results, _known_biases(segment, sensors, state))


def filter_piece(
    segment: Segment,
    carried: tuple[Model, Sensors, State],
    config: FusionConfig,
    times: TimeArray,
    own: tuple[int, int],
) -> Filtered:
    """Filter a piece of a segment as the whole of it would be.

    Args:
        segment: Its events and those around them.
        carried: The filter's arrays (:func:`arranged`); the state is that of the pieces before, and after this one in
            the end.
        config: Arm, noise and sensors.
        times: Of the estimates, int64 ns, ascending.
        own: After which time, and until which, events are the piece's own [int ns].

    Returns:
        The estimates and what became of its own events; those without a stamp come first.
    """
    (model, sensors, state), (events, _) = carried, segment.events(config)
    begin, end = np.searchsorted(events.time, own, side="right").tolist()
    count, axes = len(events.time), len(segment.axes)
    results = Results.room(count, axes)
    results.outcome[:] = events.known
    # Where no estimate is asked for the filter rounds otherwise: so one is, of which no use is made.
    asked = times if len(times) else events.time[begin:end][-1:]
    outputs = np.zeros((len(Output), axes, len(asked)))
    arrays = Filter(model, sensors, events, state, results, no_history(axes, state.x.shape[1])).flat()
    filter_events(arrays, False, begin, end, count, *ALL_THERE, 0, asked, outputs)
    estimates = {
        axis: AxisEstimate(segment.start[axis] + outputs[0, number, : len(times)], *outputs[1:, number, : len(times)])
        for number, axis in enumerate(segment.axes)
    }
    mine = np.r_[: np.searchsorted(events.time, NO_STAMP, side="right"), begin:end]
    return Filtered(estimates, events.rows(mine), results.rows(mine), _known_biases(segment, sensors, state))


def innovations(segment: Segment, config: FusionConfig, outcome: CodeArray | None = None) -> Results:
    """Innovations and outcomes of a segment, without any estimate; by its ``measurement_rows``.

    Args:
        segment: The events.
        config: Arm, noise and sensors.
        outcome: What became of each measurement in an earlier fusion, (m, A), to be repeated whatever the gates would
            say; None: they say.
    """
    columns = columns_of(config, segment.axes, biased_sensors(segment, config))
    return _innovations(segment, config, columns, outcome)


def innovations_of_each(segment: Segment, configs: Sequence[FusionConfig], outcome: CodeArray) -> list[Results]:
    """The same of several configurations, while the outcomes are repeated.

    Those of one time and scale go through the filter side by side: its rows are read once, and what several of them do
    in an interval is computed once.
    """
    alike: dict[Hashable, list[int]] = {}
    for number, config in enumerate(configs):
        sensors = [config.sensors[name] for name in segment.sensors if name in config.sensors]
        shared = tuple((one.scale, one.latency_sd) for one in sensors)
        alike.setdefault((segment.times(config), shared), []).append(number)
    found: dict[int, Results] = {}
    for numbers in alike.values():
        columns: list[Column] = []
        for number in numbers:
            columns += columns_of(configs[number], segment.axes, biased_sensors(segment, configs[number]))
        together = _innovations(segment, configs[numbers[0]], columns, outcome)
        found |= zip(numbers, together.split(len(numbers)), strict=True)
    return [found[number] for number in range(len(configs))]


def _innovations(
    segment: Segment, config: FusionConfig, columns: Sequence[Column], outcome: CodeArray | None
) -> Results:
    """Innovations by ``measurement_rows``; columns are the axes, once or more often, at the times of ``config``."""
    events, place = segment.events(config)
    count, times = len(events.time), len(columns) // len(segment.axes)
    if times > 1:
        events = events.repeated(times)
    model, sensors = filter_model(columns), filter_sensors(columns, segment.sensors)
    state = at_rest(columns, len(segment.sensors), segment.origin, segment.start)
    results = Results.room(count, len(columns))
    if outcome is not None:
        results.outcome[place] = np.tile(outcome, times)
    arrays = Filter(model, sensors, events, state, results, no_history(len(columns), state.x.shape[1])).flat()
    filter_events(arrays, outcome is not None, 0, count, count, *ALL_THERE, 0, *NO_ESTIMATES)
    return results.rows(place)


def arranged(
    segment: Segment, config: FusionConfig, biases: list[list[str]], places: int = 0
) -> tuple[Model, Sensors, State]:
    """The filter's arrays for a segment, and the state at rest."""
    columns = columns_of(config, segment.axes, biases)
    state = at_rest(columns, len(segment.sensors), segment.origin, segment.start, places)
    return filter_model(columns), filter_sensors(columns, segment.sensors), state


def biased_sensors(segment: Segment, config: FusionConfig) -> list[list[str]]:
    """For each axis the sensors whose bias is in its state: those that measure it, in their order."""
    rows = segment.measurement_rows
    return [
        [
            name
            for number, name in enumerate(segment.sensors)
            if name in config.sensors
            and config.sensors[name].is_biased(axis)
            and (known[rows.source == number] == Outcome.FUSED).any()
        ]
        for axis, known in zip(segment.axes, rows.known.T, strict=True)
    ]


def _history(events: Events, state: State, estimates: int) -> History:
    """Room for what happens to each axis: an interval for each command, an interval and an update for a measurement."""
    axes, width = events.known.shape[1], state.x.shape[1]
    measured, decided = events.source != COMMAND, [column == Outcome.FUSED for column in events.known.T]
    room = [np.count_nonzero(fused) + np.count_nonzero(fused & measured) for fused in decided]
    size = sum(room)
    return History(
        np.concatenate(([0], np.cumsum(room))),
        np.zeros(axes, dtype=np.int64),
        np.empty(size, dtype=np.int64),
        np.empty(size, dtype=np.int64),
        np.empty(size),
        np.empty(size),
        np.empty((size, width)),
        np.empty((axes, estimates, width)),
        np.empty((axes, estimates, width, width)),
    )


def _most_taken_back(time: TimeArray, arrival: TimeArray, times: TimeArray) -> int:
    """How many events the filter may be past one that arrives late."""
    estimate = np.searchsorted(times, arrival)  # the first estimate that knows of each event
    until = np.append(np.searchsorted(time, times, side="right"), len(time))[estimate]
    before = np.append(0, np.searchsorted(time, times, side="right"))[estimate]  # how far the filter was until then
    return int(np.maximum(np.maximum(until, before) - np.arange(len(time)), 0).max(initial=0)) + 1


def _known_biases(segment: Segment, sensors: Sensors, state: State) -> dict[str, dict[str, Bias]]:
    """The constant biases at the end."""
    found: dict[str, dict[str, Bias]] = {}
    for number, axis in enumerate(segment.axes):
        for name, place in zip(segment.sensors, sensors.bias[:, number, 1].tolist(), strict=True):
            if place >= 0:
                sd = float(np.sqrt(max(state.P[number, place, place], 0.0)))
                found.setdefault(name, {})[axis] = Bias(float(state.x[number, place]), sd)
    return found
