"""The log-likelihood of recorded runs under a configuration, its score and its expected information.

The likelihood is the one of :func:`pumafuse.fusion.consistency.log_density`, gates included, on the compiled engine.
Score and information come from how innovations ν and their variances S change with each parameter while the outcomes
stay as they are:

    ∂L/∂a = Σ −ν ∂ν/S + ½ (ν²/S − 1) ∂S/S,    information = Σ ∂ν ∂ν′/S + ½ ∂S ∂S′/S²

(Gupta & Mehra, "Computational aspects of maximum likelihood estimation", IEEE Trans. AC 19(6), 1974).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np

from ..arrays import SD_OF_MEDIAN, BoolArray, CodeArray, FloatArray, IntArray, TimeArray
from ..discovery.following import resolution, scatter
from ..filter.events import Results
from ..filter.outcome import ABSENT, Outcome
from ..fusion.config import FusionConfig, Process, Start
from ..fusion.consistency import log_density
from ..fusion.engine import innovation_derivatives, innovations
from ..fusion.faults import Fault, find_not_following, find_turns, starts_in_motion
from ..fusion.overruns import overrun_notes, overruns
from ..fusion.placing import in_base
from ..fusion.segments import Segment, build_segment, sum_counts
from ..logs.clock import clock_faults, segments
from ..logs.run import Run
from ..model.arm import ArmModel
from .arms import Measured, Recording
from .parameters import Parameter

_STEP = 1e-4  # of a coordinate
_PIECES = 20  # of a run, that a model which is right has independent scores in
_COUNTED = 0.98  # of the innovations
_MOST, _STRETCHES = 80_000, 8  # components of all axes that are enough for a fit; of longer runs, in so many stretches
_SMALLEST = 1e-6  # m; misfit of a simulated arm without any noise

T = TypeVar("T")
R = TypeVar("R")


def in_threads(work: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """The results of ``work`` for each item, on all usable cores; on one, or of one item, without a thread."""
    from joblib import cpu_count  # takes 0.1 s

    cores = min(len(items), cpu_count()) if len(items) > 1 else 1
    if cores == 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(cores) as pool:
        return list(pool.map(work, items))


@dataclass(frozen=True)
class Point:
    """A configuration with its log-likelihood and its log-posterior."""

    config: FusionConfig  # the configuration
    axes: FloatArray  # the log-likelihood of each axis's components, with positions in mm or mrad, (A,)
    # logarithms of priors, but for a constant, of each axis's parameters; of shared ones they count for the first, (A,)
    priors: FloatArray
    results: Sequence[Results]  # what became of each measurement on each axis, for each segment

    @property
    def outcomes(self) -> list[CodeArray]:
        """The outcome of each measurement on each axis, for each segment, (m, A)."""
        return [result.outcome for result in self.results]

    @property
    def log_likelihood(self) -> float:
        """The log-likelihood of all axes."""
        return float(self.axes.sum())

    @property
    def posteriors(self) -> FloatArray:
        """The log-posterior of each axis, (A,)."""
        return self.axes + self.priors

    @property
    def log_posterior(self) -> float:
        """The log-posterior of all axes: what is maximised."""
        return float(self.posteriors.sum())


class Derivatives(NamedTuple):
    """Score and information of k parameters."""

    score: FloatArray  # ∂L/∂a, (k,)
    information: FloatArray  # the expected −∂²L/∂a², (k, k)
    # what it is by the scatter of the score over pieces of the runs; the same where the model is right, (k, k)
    scatter: FloatArray


@dataclass(frozen=True)
class _Part:
    """One axis of one segment."""

    whole: int  # the index of the segment
    axis: int  # the index of the axis in :attr:`Likelihood.axes`
    segment: Segment  # only this axis and its measurements
    rows: IntArray  # the rows of these among the whole segment's measurements, (m,)
    column: int  # the column of the axis there


class Likelihood:
    """The likelihood of the measurements of runs, as a function of the configuration.

    Attributes:
        config: The configuration that the segments were built with.
        axes: All commanded axes, in their order.
        sensors: For each axis with measurements the sensors that have them.
        count: The number of components of each axis, (A,).
        notes: Every anomaly of the runs, a sentence each.
        commands: By run, how many rows of its commands are ``used``, and how many are left out for what.
        rows: By run and sensor, how many rows the filter decides on (``fused``), and how many are left out for what.
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
        """Prepare the measurements of runs by some ``sensors``, or all.

        Without those that are valid later than ``until`` after the first command [s], and those that would lie before
        it with the ``latest`` latency [s], or their own. Raises a PumafuseError where a run does not fit the
        configuration.
        """
        chosen = config.sensor_names(sensors)
        named = [(run.name, part) for run in runs for part in segments(in_base(run, config)[0])[0]]
        built = list[Segment]()
        self.notes, counted = list[str](), dict[str, list[Segment]]()
        for name, part in named:
            asked = [name for name in chosen if name in part.sensors]
            clocks = clock_faults(part, config.arm.update_period, asked)
            built.append(build_segment(part, config, chosen))
            turns = [fault.sentence for fault in find_turns(built[-1], config)]
            notes = (*clocks, *built[-1].notes, *turns, *starts_in_motion(built[-1], config))
            self.notes += [f"run '{name}': {note}" for note in notes]
            counted.setdefault(name, []).append(built[-1])
        self.commands = {name: sum_counts(part.command_counts for part in parts) for name, parts in counted.items()}
        self.rows = {
            name: {sensor: sum_counts(part.counts[sensor] for part in parts) for sensor in parts[0].counts}
            for name, parts in counted.items()
        }
        self.config = config
        self.axes = tuple(axis for axis in config.arm.axes if any(axis in segment.axes for segment in built))
        self._segments = [_decided(segment, until, latest) for segment in built]
        self._runs = [name for name, _ in named]
        every = sum(int(np.count_nonzero(part.measurement_rows.codes == Outcome.FUSED)) for part in self._segments)
        if every > _MOST:
            self._segments = [_liveliest(segment, _MOST / every) for segment in self._segments]
            share = f"{_MOST / every:.0%} of {every:,} measurements"
            self.notes.append(f"fitted to {share}: of each axis where it moves most, in {_STRETCHES} parts of a run")
        self._parts = [
            _Part(number, self.axes.index(axis), segment.select_axis(axis, rows), rows, column)
            for number, segment in enumerate(self._segments)
            for column, axis in enumerate(segment.axes)
            if len(rows := np.flatnonzero(segment.measurement_rows.codes[:, column] == Outcome.FUSED))
        ]
        self.count = np.zeros(len(self.axes), dtype=np.int64)
        measured: dict[str, set[str]] = {}
        for part in self._parts:
            self.count[part.axis] += len(part.rows)
            measured.setdefault(self.axes[part.axis], set()).update(part.segment.rows_by_sensor())
        self.sensors: Mapping[str, Sequence[str]] = {
            axis: [name for name in chosen if name in measured[axis]] for axis in self.axes if axis in measured
        }

    def measured(self, axis: str, config: FusionConfig, sensors: Sequence[str] | None = None) -> Measured:
        """What was commanded on an axis and measured of it, by all sensors or some, in their order."""
        names, recordings = list(self.sensors[axis] if sensors is None else sensors), list[Recording]()
        for segment in (part.segment for part in self._of(axis)):
            start, parts = segment.start[axis], list[tuple[TimeArray, FloatArray, IntArray]]()
            for name, rows in segment.rows_by_sensor().items():
                if name in names:
                    sensor = config.sensors[name]
                    time, value = rows.stamp - round(sensor.latency * 1e9), rows.value[:, 0] / sensor.scale - start
                    parts.append((time, value, np.full(len(time), names.index(name))))
            if parts:
                time, value, source = (np.concatenate(column) for column in zip(*parts, strict=True))
                every = Recording(*segment.commands_of(axis), start, time, value, source, np.ones(len(time)))
                recordings.append(every.of(np.argsort(time, kind="stable")))
        return Measured(recordings, config.arm.update_period, names, config.arm.axes[axis])

    def of_axis(self, axis: str) -> Likelihood:
        """The likelihood of the measurements of one axis; ``axes`` stay as they are."""
        likelihood, parts = copy(self), self._of(axis)
        likelihood._segments = [part.segment for part in parts]
        likelihood._parts = [
            replace(part, whole=number, rows=np.arange(len(part.rows)), column=0) for number, part in enumerate(parts)
        ]
        return likelihood

    def outcomes_of(self, axis: str, outcomes: Sequence[CodeArray]) -> list[CodeArray]:
        """The outcomes of one axis's measurements, for each segment of :meth:`of_axis`."""
        return [outcomes[part.whole][part.rows, part.column, None] for part in self._of(axis)]

    def _of(self, axis: str) -> list[_Part]:
        return [part for part in self._parts if self.axes[part.axis] == axis]

    @cached_property
    def _values(self) -> dict[tuple[str, str], list[FloatArray]]:
        """What a sensor measured of an axis, by the names of both, of each segment."""
        by_sensor: dict[tuple[str, str], list[FloatArray]] = {}
        for part in self._parts:
            for name, rows in part.segment.rows_by_sensor().items():
                by_sensor.setdefault((name, self.axes[part.axis]), []).append(rows.value[:, 0])
        return by_sensor

    @cached_property
    def scatter(self) -> dict[tuple[str, str], float]:
        """Rough noise of each sensor on each axis [m or rad], by the names of both."""
        sds = {key: [scatter(value) for value in values if len(value) > 3] for key, values in self._values.items()}
        return {key: float(np.median(each)) for key, each in sds.items() if each and min(each) > 0.0}

    @cached_property
    def resolution(self) -> dict[tuple[str, str], float]:
        """Noise of the steps in which values of a sensor on an axis come, if they do [m or rad], by both names."""
        every = {key: resolution(np.concatenate(values)) for key, values in self._values.items()}
        return {key: noise for key, noise in every.items() if noise > 0.0}

    @cached_property
    def share_after_end(self) -> dict[str, float]:
        """The share of each sensor's measurements that lies more than 1 s after the last command."""
        late, every = dict[str, int](), dict[str, int]()
        for segment in self._segments:
            end = int(segment.commands[-1]) + 1_000_000_000
            for name, rows in segment.rows_by_sensor().items():
                late[name] = late.get(name, 0) + int(np.count_nonzero(rows.time > end))
                every[name] = every.get(name, 0) + len(rows.time)
        return {name: late[name] / count for name, count in every.items() if count}

    def overruns(self, arm: ArmModel) -> list[str]:
        """A sentence on each axis of each run with commands beyond the fastest speed that an arm goes."""
        return [
            f"run '{name}': {note}"
            for name, segment in zip(self._runs, self._segments, strict=True)
            for note in overrun_notes([overruns(segment, arm)], arm, segment.origin)
        ]

    @cached_property
    def travel(self) -> dict[str, float]:
        """The range of the commands of each axis, of the run where it is greatest [m]."""
        travel = dict.fromkeys(self.axes, 0.0)
        for segment in self._segments:
            for axis in segment.axes:
                reached = float(np.ptp(np.append(segment.commands_of(axis)[1], segment.start[axis])))
                travel[axis] = max(travel[axis], reached)
        return travel

    def apart(self, config: FusionConfig) -> dict[tuple[str, str], list[FloatArray]]:
        """How far the measurements of each sensor on an axis are from the noiseless arm [m], of each segment (m,)."""
        certain, apart = _certain(config), dict[tuple[str, str], list[FloatArray]]()
        for part in self._parts:
            left = innovations(part.segment, certain).innovation[:, 0]
            for number, name in enumerate(part.segment.sensors):
                if (its_rows := part.segment.measurement_rows.source == number).any():
                    apart.setdefault((name, self.axes[part.axis]), []).append(left[its_rows])
        return apart

    def misfit(self, config: FusionConfig) -> dict[str, float]:
        """The median distance of the noiseless arm from the nearest sensor's measurements [m], by axis."""
        by_axis: dict[str, list[float]] = {axis: [] for axis in self.axes}
        for (name, axis), parts in self.apart(config).items():
            left = np.concatenate([part - np.median(part) for part in parts])
            apart = SD_OF_MEDIAN * float(np.median(np.abs(left)))
            by_axis[axis].append(max(apart / abs(config.sensors[name].scale), _SMALLEST))
        return {axis: min(apart, default=_SMALLEST) for axis, apart in by_axis.items()}

    def innovation(self, config: FusionConfig) -> float:
        """Root mean square of all innovations [m or rad], whatever their sd, but for the largest fiftieth: outliers."""
        every = [innovations(segment, config).innovation for segment in self._segments]
        squares = np.sort(np.concatenate([innovation[np.isfinite(innovation)] ** 2 for innovation in every]))
        return float(np.sqrt(squares[: math.ceil(_COUNTED * len(squares))].mean())) if len(squares) else 0.0

    def faults(self, config: FusionConfig) -> list[Fault]:
        """Why sensors do not follow the commands, those that do not."""
        return [fault for segment in self._segments for fault in find_not_following(segment, config)]

    def evaluate(self, config: FusionConfig, outcomes: Sequence[CodeArray] | None = None) -> Point:
        """The log-likelihood of the measurements, without priors; for ``outcomes`` of None the gates decide on them."""
        axes, results, densities = np.zeros(len(self.axes)), list[Results](), list[FloatArray]()
        for number, segment in enumerate(self._segments):
            filtered = innovations(segment, config, None if outcomes is None else outcomes[number])
            gates = np.array([config.sensors[name].gate for name in segment.sensors])[segment.measurement_rows.source]
            densities.append(log_density(filtered.innovation, filtered.innovation_sd, filtered.outcome, gates[:, None]))
            results.append(filtered)
        for part in self._parts:
            axes[part.axis] += float(densities[part.whole][part.rows, part.column].sum())
        return Point(config, axes, np.zeros(len(axes)), results)

    def derivatives(
        self, config: FusionConfig, parameters: Sequence[Parameter], outcomes: Sequence[CodeArray]
    ) -> Derivatives:
        """Score and information of parameters while each component's outcome stays as it is."""

        def of(part: _Part) -> tuple[list[int], FloatArray, FloatArray]:
            """Which parameters a part depends on, the scores of its pieces (p, pieces), and its information (p, p)."""
            outcome = outcomes[part.whole][part.rows, part.column]
            numbers = [
                number for number, parameter in enumerate(parameters) if parameter.axis in (None, self.axes[part.axis])
            ]
            beside = list[tuple[FusionConfig, float]]()
            for parameter in (parameters[number] for number in numbers):
                other = parameter.move(config, parameter.at(config) + _STEP)
                beside.append((other, math.expm1(_STEP) if parameter.log else _STEP))
            filtered, d_nu, d_s = innovation_derivatives(part.segment, config, outcome[:, None], beside)
            fused, sd = outcome != int(Outcome.REJECTED), filtered.innovation_sd[:, 0]
            r, d_nu, d_s = filtered.innovation[:, 0] / sd, d_nu[:, :, 0] * (fused / sd), d_s[:, :, 0] / sd**2
            excess = np.where(fused, r * r - 1.0, -1.0)
            begins = np.unique(np.arange(_PIECES) * len(r) // _PIECES)
            score = np.add.reduceat(0.5 * d_s * excess - d_nu * r, begins, axis=1)
            return numbers, score, d_nu @ d_nu.T + 0.5 * d_s @ d_s.T

        k = len(parameters)
        information, scores = np.zeros((k, k)), np.zeros((len(self._segments), k, _PIECES))
        for part, (numbers, score, information_here) in zip(self._parts, in_threads(of, self._parts), strict=True):
            scores[part.whole, numbers, : score.shape[1]] += score
            information[np.ix_(numbers, numbers)] += information_here
        return Derivatives(scores.sum(axis=(0, 2)), information, np.einsum("nip,njp->ij", scores, scores))


def _certain(config: FusionConfig) -> FusionConfig:
    """The configuration of an arm without any noise: no measurement moves its estimate."""
    sensors = {
        name: msgspec.structs.replace(sensor, bias_sd=0.0, bias_drift_sd=0.0, gate=0.0)
        for name, sensor in config.sensors.items()
    }
    process = dict.fromkeys(config.process, Process(input_noise=0.0, drift=0.0))
    return msgspec.structs.replace(config, start=Start(offset_sd=0.0), process=process, sensors=sensors)


def _decided(segment: Segment, until: float | None, latest: float | None) -> Segment:
    """A segment with only the measurements that a filter decides on."""
    rows = segment.measurement_rows
    chosen = np.ones(len(rows.time), dtype=np.bool_)
    if until is not None:
        chosen &= rows.time <= segment.origin + round(until * 1e9)
    if latest is not None:
        chosen &= rows.stamp - round(latest * 1e9) >= segment.origin
    return _of_rows(segment, (rows.codes == Outcome.FUSED) & chosen[:, None])


def _of_rows(segment: Segment, chosen: BoolArray) -> Segment:
    """A segment with some of its measurements, (m, A)."""
    rows = segment.measurement_rows
    codes = np.where(chosen, rows.codes, ABSENT).astype(np.uint8)
    return replace(segment, measurement_rows=rows._replace(codes=codes).rows(np.flatnonzero(chosen.any(axis=1))))


def _liveliest(segment: Segment, share: float) -> Segment:
    """A segment with a share of each axis's measurements: in each part of it those during which most is commanded.

    Where a sensor measures within a turn all stay: in between nobody knows how often it goes round.
    """
    rows = segment.measurement_rows
    fused = rows.codes == Outcome.FUSED
    chosen = fused & segment.turn.any()
    for column, axis in enumerate(segment.axes):
        stamp, command = segment.commands_of(axis)
        way = np.append(0.0, np.cumsum(np.abs(np.diff(command))))
        by_stamp = np.flatnonzero(fused[:, column])
        by_stamp = by_stamp[np.argsort(rows.stamp[by_stamp], kind="stable")]
        for part in np.array_split(by_stamp, _STRETCHES):
            length = math.ceil(share * len(part))
            until = np.interp(rows.stamp[part], stamp, way)
            first = int(np.argmax(until[length - 1 :] - until[: len(part) - length + 1])) if length else 0
            chosen[part[first : first + length], column] = True
    return _of_rows(segment, chosen)
