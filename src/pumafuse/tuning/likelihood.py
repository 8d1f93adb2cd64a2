"""What recorded runs say of a configuration: the log-likelihood of their measurements, and how it changes.

The likelihood is the one of :func:`pumafuse.fusion.consistency.log_density`, gates and all, on the compiled engine. Its
slopes come from how innovations ν and their variances S move with each parameter while the outcomes stay as they are:

    ∂L/∂a = Σ −ν ∂ν/S + ½ (ν²/S − 1) ∂S/S,    information = Σ ∂ν ∂ν′/S + ½ ∂S ∂S′/S²

(Gupta & Mehra, "Computational aspects of maximum likelihood estimation", IEEE Trans. AC 19(6), 1974).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import msgspec
import numpy as np

from ..arrays import CodeArray, FloatArray, IntArray
from ..filter.outcome import Outcome
from ..fusion.config import FusionConfig, Process, Start
from ..fusion.consistency import log_density
from ..fusion.engine import innovations
from ..fusion.segments import Timeline, build
from ..fusion.ticks import usable_cores
from ..logs.axes import in_axes
from ..logs.clock import segments
from ..logs.run import Run
from ..model.arm import ordered_axes
from .parameters import Parameter
from .retimed import retimed, subset

_LOG_STEP = 1e-4  # of a logarithm, by which slopes are taken: their error is half of it, the rounding 1e-11
_STEP = 2e-5  # s, or of a gain; both ways, as a measurement that passes a command bends the likelihood
_SMALLEST = 1e-6  # m; misfit of a simulated arm without any noise


@dataclass(frozen=True)
class Value:
    """The log-likelihood of a configuration.

    Attributes:
        axes: Of each axis's components, with positions in mm, (A,).
        outcomes: What became of each component, for each segment, (m,).
    """

    axes: FloatArray
    outcomes: Sequence[CodeArray]

    @property
    def total(self) -> float:
        """Of all axes."""
        return float(self.axes.sum())


@dataclass(frozen=True)
class Slopes:
    """How the log-likelihood changes with k parameters.

    Attributes:
        score: ∂L/∂a, (k,).
        information: The expected −∂²L/∂a², (k, k).
    """

    score: FloatArray
    information: FloatArray


@dataclass(frozen=True)
class _Strand:
    """One axis of one segment.

    Attributes:
        number: The axis among those of the evidence.
        timeline: Its components alone.
        places: Where they are among the segment's, (m,).
    """

    number: int
    timeline: Timeline
    places: IntArray


@dataclass(frozen=True)
class _Segment:
    whole: Timeline
    strands: tuple[_Strand, ...]


class Evidence:
    """The measurements of runs, ready to be met again and again.

    Attributes:
        config: Where the search starts; timelines are built with it.
        axes: All commanded axes, in their order.
        heard: For each axis with measurements the sensors that have them.
        count: How many components each axis has, (A,).
        notes: Every anomaly of the runs, a sentence each.
    """

    def __init__(
        self,
        runs: Sequence[Run],
        config: FusionConfig,
        sensors: Iterable[str] | None = None,
        *,
        until: float | None = None,
        latest: float | None = None,
    ) -> None:
        """Put the measurements of runs in order.

        Args:
            runs: Recorded runs.
            config: Arm and sensors.
            sensors: Which to use; all for None.
            until: Leave out measurements valid later than this after the first command [s].
            latest: Leave out measurements that would lie before the first command with this latency [s]; None: each
                with its own.

        Raises:
            PumafuseError: A run and the configuration do not fit together.
        """
        chosen = config.sensor_names(sensors)
        named = [(run.name, part) for run in runs for part in segments(in_axes(run, config.frame)[0])[0]]
        built = [build(part, config, chosen) for _, part in named]
        self.notes = [
            f"run '{name}': {note}" for (name, _), timeline in zip(named, built, strict=True) for note in timeline.notes
        ]
        self.config = config
        self.axes = ordered_axes({axis.name for timeline in built for axis in timeline.axes})
        parts = [_kept(timeline, until, latest) for timeline in built]
        self._segments = [_Segment(part, tuple(_strands(part, self.axes))) for part in parts]
        told: set[tuple[str, str]] = {
            (self.axes[strand.number], strand.timeline.components.sensors[sensor])
            for segment in self._segments
            for strand in segment.strands
            for sensor in np.unique(strand.timeline.components.sensor).tolist()
        }
        self.heard: Mapping[str, Sequence[str]] = {
            axis: [name for name in chosen if (axis, name) in told]
            for axis in self.axes
            if any((axis, name) in told for name in chosen)
        }
        self.count = np.zeros(len(self.axes), dtype=np.int64)
        for segment in self._segments:
            for strand in segment.strands:
                self.count[strand.number] += len(strand.places)

    def alone(self, axis: str) -> Evidence:
        """The measurements of one axis; ``axes`` stay as they are."""
        number = self.axes.index(axis)
        found = copy(self)
        found._segments = [
            _Segment(strand.timeline, (replace(strand, places=np.arange(len(strand.places))),))
            for segment in self._segments
            for strand in segment.strands
            if strand.number == number
        ]
        return found

    def outcomes_of(self, axis: str, outcomes: Sequence[CodeArray]) -> list[CodeArray]:
        """The outcomes of one axis's components among those of all, for each segment of :meth:`alone`."""
        number = self.axes.index(axis)
        return [
            outcome[strand.places]
            for segment, outcome in zip(self._segments, outcomes, strict=True)
            for strand in segment.strands
            if strand.number == number
        ]

    @cached_property
    def scatter(self) -> dict[str, float]:
        """What each sensor's measurements scatter by from one to the next on each axis [m], by the name of its sd.

        From third differences, which smooth motion leaves alone: their variance is 20 times the noise's. Outliers
        hardly move the median.
        """
        found: dict[str, list[float]] = {}
        for segment in self._segments:
            for strand in segment.strands:
                components = strand.timeline.components
                for number, name in enumerate(components.sensors):
                    third = np.diff(components.value[components.sensor == number], 3)
                    if len(third):
                        sd = 1.4826 * float(np.median(np.abs(third))) / math.sqrt(20.0)
                        found.setdefault(f"sensors.{name}.sd_mm.{self.axes[strand.number]}", []).append(sd)
        return {key: float(np.median(sds)) for key, sds in found.items() if min(sds) > 0.0}

    @cached_property
    def afterwards(self) -> dict[str, float]:
        """Which share of each sensor's measurements lies more than 1 s after the last command."""
        late, every = dict[str, int](), dict[str, int]()
        for segment in self._segments:
            components, end = segment.whole.components, int(segment.whole.commands[-1]) + 1_000_000_000
            for number, name in enumerate(components.sensors):
                mine = components.valid[components.sensor == number]
                late[name] = late.get(name, 0) + int(np.count_nonzero(mine > end))
                every[name] = every.get(name, 0) + len(mine)
        return {name: late[name] / count for name, count in every.items() if count}

    @cached_property
    def travel(self) -> dict[str, float]:
        """How far each axis is commanded to move in a run, at most [m]."""
        found = dict.fromkeys(self.axes, 0.0)
        for segment in self._segments:
            for axis in segment.whole.axes:
                reached = float(np.ptp(np.append(axis.command, axis.start)))
                found[axis.name] = max(found[axis.name], reached)
        return found

    def answers(
        self, config: FusionConfig, *, centred: bool = True
    ) -> dict[tuple[str, str], tuple[FloatArray, FloatArray]]:
        """What the arm alone would show each sensor on each axis, and what was read, [m], (m,).

        Args:
            config: The configuration.
            centred: Both from their medians in each run.
        """
        certain = msgspec.structs.replace(
            config,
            start=Start(offset_sd=0.0),
            process=dict.fromkeys(config.process, Process(input_noise=0.0, drift=0.0)),
            sensors={name: msgspec.structs.replace(one, bias_sd=0.0, gate=0.0) for name, one in config.sensors.items()},
        )
        found: dict[tuple[str, str], list[tuple[FloatArray, FloatArray]]] = {}
        for segment in self._segments:
            for strand in segment.strands:
                components = strand.timeline.components
                expected = components.value - innovations(strand.timeline, certain).innovation
                for number, name in enumerate(components.sensors):
                    mine = components.sensor == number
                    if mine.any():
                        answer, seen = expected[mine], components.value[mine]
                        if centred:
                            answer, seen = answer - np.median(answer), seen - np.median(seen)
                        found.setdefault((name, self.axes[strand.number]), []).append((answer, seen))
        return {
            key: (np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs]))
            for key, pairs in found.items()
        }

    def misfit(self, config: FusionConfig) -> FloatArray:
        """How far the arm alone is from the measurements of each axis [m], by the median of each sensor's, (A,)."""
        found: list[list[float]] = [[0.0] for _ in self.axes]
        for (name, axis), (answer, seen) in self.answers(config).items():
            apart = 1.4826 * float(np.median(np.abs(seen - answer)))
            found[self.axes.index(axis)].append(apart / abs(config.sensors[name].scale))
        return np.array([max(min(apart[1:], default=0.0), _SMALLEST) for apart in found])

    def value(self, config: FusionConfig, outcomes: Sequence[CodeArray] | None = None) -> Value:
        """The log-likelihood of the measurements under a configuration.

        Args:
            config: The configuration.
            outcomes: What became of each component, to be repeated; None: the configuration's gates decide.
        """
        axes, found = np.zeros(len(self.axes)), list[CodeArray]()
        for number, segment in enumerate(self._segments):
            now = retimed(segment.whole, self.config, config)
            met = innovations(now.timeline, config, None if outcomes is None else now.there(outcomes[number]))
            components = now.timeline.components
            gates = np.array([config.sensors[name].gate for name in components.sensors])
            density = log_density(met.innovation, met.innovation_sd, met.outcome, gates[components.sensor])
            density, outcome = now.back(density), now.back(met.outcome)
            found.append(outcome)
            for strand in segment.strands:
                axes[strand.number] += float(density[strand.places].sum())
        return Value(axes, found)

    def slopes(self, config: FusionConfig, parameters: Sequence[Parameter], outcomes: Sequence[CodeArray]) -> Slopes:
        """How the log-likelihood changes with parameters while each component's outcome stays as it is."""
        score, information = np.zeros(len(parameters)), np.zeros((len(parameters), len(parameters)))
        jobs = [
            (strand, outcome[strand.places])
            for segment, outcome in zip(self._segments, outcomes, strict=True)
            for strand in segment.strands
        ]

        def one(job: tuple[_Strand, CodeArray]) -> tuple[list[int], FloatArray, FloatArray]:
            return self._strand_slopes(job[0], job[1], config, parameters)

        with ThreadPoolExecutor(min(usable_cores(), len(jobs))) as pool:
            for mine, part, square in pool.map(one, jobs):
                score[mine] += part
                information[np.ix_(mine, mine)] += square
        return Slopes(score, information)

    def _strand_slopes(
        self, strand: _Strand, outcome: CodeArray, config: FusionConfig, parameters: Sequence[Parameter]
    ) -> tuple[list[int], FloatArray, FloatArray]:
        axis = self.axes[strand.number]
        mine = [number for number, one in enumerate(parameters) if one.axis in (None, axis)]
        nu, S = self._met(strand, outcome, config)
        fused = outcome != Outcome.REJECTED
        d_nu, d_S = np.empty((len(mine), len(nu))), np.empty((len(mine), len(nu)))
        for place, number in enumerate(mine):
            one = parameters[number]
            at = one.at(config)
            if one.log:
                nu_up, S_up = self._met(strand, outcome, one.move(config, at + _LOG_STEP))
                d_nu[place], d_S[place] = (nu_up - nu) / _LOG_STEP, (S_up - S) / _LOG_STEP
            else:
                nu_up, S_up = self._met(strand, outcome, one.put(config, at + _STEP))
                nu_down, S_down = self._met(strand, outcome, one.put(config, at - _STEP))
                d_nu[place] = (nu_up - nu_down) / (2.0 * _STEP)
                d_S[place] = (S_up - S_down) / (2.0 * _STEP)
        d_nu *= fused / np.sqrt(S)
        d_S /= S
        r = nu / np.sqrt(S)
        excess = np.where(fused, r * r - 1.0, -1.0)
        score = -d_nu @ r + 0.5 * d_S @ excess
        return mine, score, d_nu @ d_nu.T + 0.5 * d_S @ d_S.T

    def _met(self, strand: _Strand, outcome: CodeArray, config: FusionConfig) -> tuple[FloatArray, FloatArray]:
        """ν and S of a strand's components, whose outcomes are known."""
        now = retimed(strand.timeline, self.config, config)
        met = innovations(now.timeline, config, now.there(outcome))
        return now.back(met.innovation), now.back(met.innovation_sd**2)


def _kept(timeline: Timeline, until: float | None, latest: float | None) -> Timeline:
    """A timeline with only the components that a filter decides on."""
    components = timeline.components
    chosen = components.outcome == Outcome.FUSED
    if until is not None:
        chosen &= components.valid <= timeline.origin + round(until * 1e9)
    if latest is not None:
        chosen &= components.stamp - round(latest * 1e9) >= timeline.origin
    return replace(timeline, components=subset(components, np.flatnonzero(chosen)))


def _strands(timeline: Timeline, axes: Sequence[str]) -> Iterable[_Strand]:
    for number, axis in enumerate(timeline.axes):
        places = np.flatnonzero(timeline.components.axis == number)
        if len(places):
            components = subset(timeline.components, places)
            alone = replace(components, axis=np.zeros_like(components.axis))
            yield _Strand(axes.index(axis.name), replace(timeline, axes=(axis,), components=alone), places)
