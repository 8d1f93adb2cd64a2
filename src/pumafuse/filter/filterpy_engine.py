"""The reference engine, `filterpy`: rows met in their total order by one augmented filter for each axis.

Plain and inspectable; the compiled engine is held to it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray, IntArray, TimeArray
from .augmented import AxisFilter, AxisPoint, Held
from .config import FusionConfig, Sensor
from .estimates import Mode
from .outcome import REOPEN_AFTER, REOPEN_SPAN_NS, Outcome
from .smoother import hindsight, hindsight_at
from .timeline import Timeline
from .track import AxisEstimate, Bias, Filtered, Fused, Track, estimate

Progress = Callable[[float], None]

_Checkpoint = tuple[tuple[AxisPoint, ...], dict[tuple[str, str], tuple[int, int]]]


@dataclass(frozen=True)
class _Row:
    """The components of one row that the filter is to decide on."""

    sensor: str
    components: IntArray
    valid: int
    stamp: int


class FilterpyEngine:
    """Filters one timeline on all axes together: rows in their total order, each axis catching up to them."""

    def __init__(self, timeline: Timeline, config: FusionConfig) -> None:
        self._components = components = timeline.components
        self._sensors = config.sensors
        self._names = [axis.name for axis in timeline.axes]
        candidates = components.candidates
        self._filters: list[AxisFilter] = []
        self._biases: list[tuple[str, ...]] = []
        for number, axis in enumerate(timeline.axes):
            mine = candidates[components.axis[candidates] == number]
            heard = [components.sensors[int(index)] for index in np.unique(components.sensor[mine])]
            biases = [(name, self._sensors[name].bias_sd) for name in heard if self._sensors[name].bias_sd]
            self._biases.append(tuple(name for name, _ in biases))
            self._filters.append(
                AxisFilter(
                    config.arm.axes[axis.name].plant,
                    axis,
                    config.process[axis.name],
                    config.start.offset_sd,
                    biases,
                    timeline.origin,
                    np.unique(components.valid[mine]),
                )
            )
        self._starts = [axis.start for axis in timeline.axes]
        self._rows = self._gather(candidates)
        self._streaks: dict[tuple[str, str], tuple[int, int]] = {}
        self._innovation = np.full(len(components.value), np.nan)
        self._innovation_sd = np.full(len(components.value), np.nan)
        self._outcome = components.outcome.copy()

    def filter(self, progress: Progress | None = None) -> Filtered:
        """Every measurement at its valid time, whenever it arrived."""
        for number, row in enumerate(self._rows):
            self._meet(row)
            if progress is not None and number % 1000 == 0:
                progress(number / len(self._rows))
        for axis in self._filters:
            axis.advance(len(axis.time) - 1)
        return self._filtered(tuple(axis.track(axis.held) for axis in self._filters))

    def filter_as_live(self, times: TimeArray, progress: Progress | None = None) -> Filtered:
        """At each of ``times`` only the measurements that had arrived: late ones make the filter go back and replay.

        The tracks hold one state for each of ``times``.
        """
        arrival = np.array([max(row.stamp, row.valid) for row in self._rows], dtype=np.int64)
        queue = np.argsort(arrival, kind="stable")
        edges = np.searchsorted(arrival[queue], times, side="right")
        due = np.split(queue, edges)  # due[k]: the rows that arrive by times[k]; the last part comes after all of them
        arrived = np.zeros(len(self._rows), dtype=bool)
        before = [self._checkpoint()]  # before[i]: as it was before row i; the rows until the last are dealt with
        kept: list[list[Held]] = [[] for _ in self._filters]
        reach = 0
        for number, new in enumerate(due):
            arrived[new] = True
            if new.min(initial=len(before)) < len(before) - 1:
                del before[new.min() + 1 :]
                self._restore(before[-1])
            reach = max(reach, int(new.max(initial=-1)) + 1)
            for index in range(len(before) - 1, reach):
                if arrived[index]:
                    self._meet(self._rows[index])
                before.append(self._checkpoint())
            if number < len(times):
                here = self._checkpoint()
                for axis, states in zip(self._filters, kept, strict=True):
                    axis.advance(axis.latest(int(times[number])))
                    states.append(axis.held[-1])
                self._restore(here)
            if progress is not None and number % 1000 == 0:
                progress(number / len(due))
        return self._filtered(tuple(axis.track(states) for axis, states in zip(self._filters, kept, strict=True)))

    def _meet(self, row: _Row) -> None:
        """Gate a row and fuse what passes: whole rows or component by component, as the sensor says."""
        sensor = self._sensors[row.sensor]
        if sensor.gate_rows:
            self._meet_together(row, sensor, row.components, "")
        else:
            for component in row.components:
                self._meet_together(row, sensor, (component,), self._names[self._components.axis[component]])

    def _meet_together(self, row: _Row, sensor: Sensor, components: Sequence[int] | IntArray, part: str) -> None:
        """Components of one row that pass the gate together or not at all."""
        met = [self._predicted(row, sensor, int(component)) for component in components]
        beyond = [sensor.gate > 0.0 and abs(nu) > sensor.gate * np.sqrt(S) for _, _, _, _, nu, S in met]
        key = (row.sensor, part)
        if not any(beyond):
            self._streaks.pop(key, None)
        count, since = self._streaks.get(key, (0, row.valid))
        reopens = count >= REOPEN_AFTER and row.valid - since >= REOPEN_SPAN_NS
        if any(beyond) and not reopens:
            self._streaks[key] = (count + 1, since)
        for component, outside, (axis, z, H, R, nu, S) in zip(components, beyond, met, strict=True):
            rejected, widened = any(beyond) and not reopens, nu**2 if outside and reopens else 0.0
            if widened:
                self._streaks.pop(key, None)
            if not rejected:
                axis.fuse(z, H, R, widened)
            spread = S if rejected else float(axis.kf.S[0, 0])
            self._innovation[component], self._innovation_sd[component] = nu, np.sqrt(spread)
            self._outcome[component] = (
                Outcome.REJECTED if rejected else Outcome.REACQUIRED if outside else Outcome.FUSED
            )

    def _predicted(
        self, row: _Row, sensor: Sensor, component: int
    ) -> tuple[AxisFilter, float, FloatArray, float, float, float]:
        """The axis filter at the component's valid time with z, H, R, ν and S."""
        number = int(self._components.axis[component])
        axis = self._filters[number]
        axis.advance(axis.latest(row.valid))
        sd = sensor.sd_of(self._names[number])
        assert sd is not None  # a component without one is `unknown` and never gets here
        H, R = axis.observation(
            row.sensor, sensor, sd if (spread := self._components.spread) is None else sd * float(spread[component])
        )
        z = float(self._components.value[component]) - sensor.scale * self._starts[number]
        return axis, z, H, R, *axis.innovation(z, H, R)

    def _gather(self, candidates: IntArray) -> list[_Row]:
        components = self._components
        edges = np.flatnonzero(np.diff(components.row[candidates])) + 1
        return [
            _Row(
                components.sensors[components.sensor[part[0]]],
                part,
                int(components.valid[part[0]]),
                int(components.stamp[part[0]]),
            )
            for part in np.split(candidates, edges)
            if len(part)
        ]

    def _checkpoint(self) -> _Checkpoint:
        return tuple(axis.checkpoint() for axis in self._filters), self._streaks.copy()

    def _restore(self, point: _Checkpoint) -> None:
        for axis, state in zip(self._filters, point[0], strict=True):
            axis.restore(state)
        self._streaks = point[1].copy()

    def _filtered(self, tracks: tuple[Track, ...]) -> Filtered:
        final = tuple(axis.held[-1][1:3] for axis in self._filters)
        return Filtered(tracks, self._innovation, self._innovation_sd, self._outcome, tuple(self._biases), final)


def fuse_filterpy(
    timeline: Timeline, config: FusionConfig, times: TimeArray, mode: Mode, progress: Progress | None = None
) -> Fused:
    """Filter or smooth one timeline by the filterpy engine, with estimates at ``times`` (int64 ns)."""
    engine = FilterpyEngine(timeline, config)
    filtered = engine.filter_as_live(times, progress) if mode == "as-live" else engine.filter(progress)
    axes: dict[str, AxisEstimate] = {}
    biases: dict[str, dict[str, Bias]] = {}
    for number, (axis, track) in enumerate(zip(timeline.axes, filtered.tracks, strict=True)):
        plant = config.arm.axes[axis.name].plant
        entry = np.arange(len(times)) if mode == "as-live" else track.holding(times)
        later = hindsight_at(track, hindsight(track, plant), entry, times, plant) if mode == "smoothed" else None
        axes[axis.name] = estimate(track, entry, times, plant, axis.start, later)
        (mean, covariance), names = filtered.final[number], filtered.biases[number]
        for place, name in enumerate(names, len(mean) - len(names)):
            sd = float(np.sqrt(covariance[place, place]))
            biases.setdefault(name, {})[axis.name] = Bias(float(mean[place]), sd)
    return Fused(axes, filtered.innovation, filtered.innovation_sd, filtered.outcome, biases)
