"""The reference engine: one `filterpy.kalman.KalmanFilter` per axis on the delay-augmented matrices.

State of an axis: the plant's states, the offset, a constant bias for each sensor that has one, and a register of the
inputs in flight, the newest first. Over an interval the plant follows the register's acting entry:

    x⁺ = Φ x + Γ r_k,   o⁺ = o,   b⁺ = b,   and when an input is issued   r⁺ = (v, r_0, r_1, …).

`discretize` is the same model where commands come every T. Plain and inspectable; the other engines are held to it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter

from ..arrays import FloatArray, IntArray, TimeArray
from ..model.discrete import transition
from ..model.plants import Plant
from .config import FusionConfig, Process, Sensor
from .estimates import Mode
from .outcome import REOPEN_AFTER, REOPEN_SPAN_NS, Outcome
from .smoother import hindsight, hindsight_at
from .timeline import AxisInput, Timeline
from .track import AxisEstimate, Bias, Filtered, Fused, Track, Updates, estimate

Progress = Callable[[float], None]

# H, K (s,), ν and R of an update, and by how much the offset's variance was widened before it.
Update = tuple[FloatArray, FloatArray, float, float, float]
# A state that holds until the next: instant, mean (s,) and covariance (s, s) of plant, offset and biases, and the
# update that made it, if one did.
Held = tuple[int, FloatArray, FloatArray, Update | None]

_ACT, _ISSUE, _READ = 0, 1, 2  # at one instant commands come before readings
_AxisPoint = tuple[int, FloatArray, FloatArray, int]
_Checkpoint = tuple[tuple[_AxisPoint, ...], dict[tuple[str, str], tuple[int, int]]]


class AxisFilter:
    """One axis: steps through the instants of its timeline and meets scalars.

    Attributes:
        time: Every instant at which something happens on this axis, int64 ns, ascending, (k,).
        index: The instant that the filter stands at.
    """

    def __init__(
        self,
        plant: Plant,
        driven: AxisInput,
        process: Process,
        offset_sd: float,
        biases: Sequence[tuple[str, float]],
        origin: int,
        readings: TimeArray,
    ) -> None:
        issued, values, acting = driven.drive.time, driven.drive.value, driven.acting
        times = np.concatenate(([origin], acting, issued, readings))
        kinds = np.repeat([_READ, _ACT, _ISSUE, _READ], [1, len(acting), len(issued), len(readings)])
        order = np.concatenate(([0], 1 + np.lexsort((kinds[1:], times[1:]))))
        self.time: TimeArray = times[order]
        kind = kinds[order]
        entry = np.cumsum(kind == _ACT) - 1  # the acting entry of the drive, −1 before the first
        in_flight = np.cumsum(kind == _ISSUE) - (entry + 1)
        before = entry < 0
        self._input = np.where(before, 0.0, values[entry])
        maneuver = np.where(before, 0.0, driven.drive.maneuver[entry])
        self._noise = process.input_noise**2 + (process.maneuver_noise * maneuver) ** 2
        self._drift = process.drift**2 + (process.maneuver_drift * maneuver) ** 2
        self._in_flight = in_flight
        self._issues = kind == _ISSUE
        self._issued = values[np.maximum(np.cumsum(self._issues) - 1, 0)]

        self._interval = np.diff(self.time) / 1e9
        intervals, self._place = np.unique(self._interval, return_inverse=True)
        self._Phi, self._Gamma, self._Q = transition(plant, intervals)

        A, B, C = plant.state_space()
        self._n = n = len(A)
        self._register = register = n + 1 + len(biases)
        size = register + int(in_flight.max(initial=0)) + 1
        self._position = np.zeros((1, size))
        self._position[:, :n], self._position[0, n] = C, 1.0
        self._rate, self._rate_input = (C @ A)[0], (C @ B).item()
        self._bias = {name: n + 1 + number for number, (name, _) in enumerate(biases)}
        self._shift = np.eye(size)
        self._shift[register:, register:] = np.eye(size - register, k=-1)
        self.kf = KalmanFilter(dim_x=size, dim_z=1, dim_u=1)
        self.kf.B = np.zeros((size, 1))
        self.kf.B[register] = 1.0
        self.kf.P = np.diag([0.0] * n + [offset_sd**2] + [sd**2 for _, sd in biases] + [0.0] * (size - register))
        self.index = 0
        self._held: list[Held] = []
        self._hold()

    def advance(self, index: int) -> None:
        """Predict from instant to instant up to ``index``; a no-op when already there."""
        n, register = self._n, self._register
        while self.index < index:
            step = self._place[self.index]
            F, Q = np.eye(len(self.kf.x)), np.zeros_like(self.kf.P)
            F[:n, :n] = self._Phi[step]
            F[:n, register + self._in_flight[self.index]] = self._Gamma[step][:, 0]
            Q[:n, :n] = self._noise[self.index] * self._Q[step]
            Q[n, n] = self._drift[self.index] * self._interval[self.index]
            self.index += 1
            if self._issues[self.index]:
                self.kf.predict(u=np.array([[self._issued[self.index]]]), F=self._shift @ F, Q=Q)
            else:
                self.kf.predict(F=F, Q=Q)
            self._settle()

    def latest(self, time: int) -> int:
        """The last instant at or before ``time`` [ns]."""
        return int(np.searchsorted(self.time, time, side="right")) - 1

    def observation(self, name: str, sensor: Sensor, sd: float) -> tuple[FloatArray, float]:
        """H (1, m) and R [m²] of a scalar of ``sensor`` here and now; R grows with speed where latency wanders."""
        H = sensor.scale * self._position
        if name in self._bias:
            H[0, self._bias[name]] = 1.0
        speed = float(self._rate @ self.kf.x[: self._n, 0]) + self._rate_input * float(self._input[self.index])
        return H, sd**2 + (sensor.scale * speed * sensor.latency_sd) ** 2

    def innovation(self, z: float, H: FloatArray, R: float) -> tuple[float, float]:
        """ν = z − H x and S = H P Hᵀ + R."""
        return z - (H @ self.kf.x).item(), (H @ self.kf.P @ H.T).item() + R

    def fuse(self, z: float, H: FloatArray, R: float, widened: float = 0.0) -> None:
        """Joseph-form update with one scalar, after the offset's variance was ``widened`` [m²]."""
        if widened:
            P = self.kf.P.copy()
            P[self._n, self._n] += widened
            self.kf.P = P
        self.kf.update(np.array([[z]]), R=np.array([[R]]), H=H)
        kept = self._register
        self._settle((H[0, :kept], self.kf.K[:kept, 0], float(self.kf.y[0, 0]), R, widened))

    def checkpoint(self) -> _AxisPoint:
        """What :meth:`restore` needs to come back to this state."""
        return self.index, self.kf.x, self.kf.P, len(self._held)

    def restore(self, point: _AxisPoint) -> None:
        """Go back to a checkpoint."""
        self.index, self.kf.x, self.kf.P, held = point
        del self._held[held:]

    @property
    def held(self) -> list[Held]:
        """The states so far."""
        return self._held

    def track(self, held: Sequence[Held]) -> Track:
        """States of this filter as arrays."""
        index, mean, covariance, updates = zip(*held, strict=True)
        at = np.array(index)
        made = [(entry, *update) for entry, update in enumerate(updates) if update is not None]
        entry, H, K, nu, R, widened = zip(*made, strict=True) if made else ((), (), (), (), (), ())
        size = self._register
        return Track(
            self.time[at],
            np.array(mean),
            np.array(covariance),
            self._input[at],
            self._noise[at],
            self._drift[at],
            Updates(
                np.array(entry, dtype=np.int64),
                np.array(H, dtype=np.float64).reshape(-1, size),
                np.array(K, dtype=np.float64).reshape(-1, size),
                np.array(nu, dtype=np.float64),
                np.array(R, dtype=np.float64),
                np.array(widened, dtype=np.float64),
            ),
        )

    def _settle(self, update: Update | None = None) -> None:
        # Rounding makes P drift from symmetry by an ulp a step, and that grows over a million steps.
        self.kf.P = 0.5 * (self.kf.P + self.kf.P.T)
        self._hold(update)

    def _hold(self, update: Update | None = None) -> None:
        kept = self._register
        self._held.append((self.index, self.kf.x[:kept, 0].copy(), self.kf.P[:kept, :kept].copy(), update))


@dataclass(frozen=True)
class _Row:
    """The scalars of one row that the filter is to decide on."""

    sensor: str
    scalars: IntArray
    valid: int
    stamp: int


class ReferenceEngine:
    """Filters one timeline on all axes together: rows in their total order, each axis catching up to them."""

    def __init__(self, timeline: Timeline, config: FusionConfig) -> None:
        self._scalars = scalars = timeline.scalars
        self._sensors = config.sensors
        self._names = [axis.name for axis in timeline.axes]
        candidates = scalars.candidates
        self._filters: list[AxisFilter] = []
        self._biases: list[tuple[str, ...]] = []
        for number, axis in enumerate(timeline.axes):
            mine = candidates[scalars.axis[candidates] == number]
            heard = [scalars.sensors[int(index)] for index in np.unique(scalars.sensor[mine])]
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
                    np.unique(scalars.valid[mine]),
                )
            )
        self._starts = [axis.start for axis in timeline.axes]
        self._rows = self._gather(candidates)
        self._streaks: dict[tuple[str, str], tuple[int, int]] = {}
        self._innovation = np.full(len(scalars.value), np.nan)
        self._innovation_sd = np.full(len(scalars.value), np.nan)
        self._outcome = scalars.outcome.copy()

    def filter(self, progress: Progress | None = None) -> Filtered:
        """Every reading at its valid time, whenever it arrived."""
        for number, row in enumerate(self._rows):
            self._meet(row)
            if progress is not None and number % 1000 == 0:
                progress(number / len(self._rows))
        for axis in self._filters:
            axis.advance(len(axis.time) - 1)
        return self._filtered(tuple(axis.track(axis.held) for axis in self._filters))

    def filter_as_live(self, times: TimeArray, progress: Progress | None = None) -> Filtered:
        """At each of ``times`` only the readings that had arrived: late ones make the filter go back and replay.

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
        """Gate a row and fuse what passes: whole rows or scalar by scalar, as the sensor says."""
        sensor = self._sensors[row.sensor]
        if sensor.gate_rows:
            self._meet_together(row, sensor, row.scalars, "")
        else:
            for scalar in row.scalars:
                self._meet_together(row, sensor, (scalar,), self._names[self._scalars.axis[scalar]])

    def _meet_together(self, row: _Row, sensor: Sensor, scalars: Sequence[int] | IntArray, part: str) -> None:
        """Scalars of one row that pass the gate together or not at all."""
        met = [self._predicted(row, sensor, int(scalar)) for scalar in scalars]
        beyond = [sensor.gate > 0.0 and abs(nu) > sensor.gate * np.sqrt(S) for _, _, _, _, nu, S in met]
        key = (row.sensor, part)
        if not any(beyond):
            self._streaks.pop(key, None)
        count, since = self._streaks.get(key, (0, row.valid))
        reopens = count >= REOPEN_AFTER and row.valid - since >= REOPEN_SPAN_NS
        if any(beyond) and not reopens:
            self._streaks[key] = (count + 1, since)
        for scalar, outside, (axis, z, H, R, nu, S) in zip(scalars, beyond, met, strict=True):
            gated, widened = any(beyond) and not reopens, nu**2 if outside and reopens else 0.0
            if widened:
                self._streaks.pop(key, None)
            if not gated:
                axis.fuse(z, H, R, widened)
            spread = S if gated else float(axis.kf.S[0, 0])
            self._innovation[scalar], self._innovation_sd[scalar] = nu, np.sqrt(spread)
            self._outcome[scalar] = Outcome.GATED if gated else Outcome.REOPENED if outside else Outcome.FUSED

    def _predicted(
        self, row: _Row, sensor: Sensor, scalar: int
    ) -> tuple[AxisFilter, float, FloatArray, float, float, float]:
        """The axis filter at the scalar's valid time with z, H, R, ν and S."""
        number = int(self._scalars.axis[scalar])
        axis = self._filters[number]
        axis.advance(axis.latest(row.valid))
        sd = sensor.sd_of(self._names[number])
        assert sd is not None  # a scalar without one is `unknown` and never gets here
        H, R = axis.observation(
            row.sensor, sensor, sd if (spread := self._scalars.spread) is None else sd * float(spread[scalar])
        )
        z = float(self._scalars.value[scalar]) - sensor.scale * self._starts[number]
        return axis, z, H, R, *axis.innovation(z, H, R)

    def _gather(self, candidates: IntArray) -> list[_Row]:
        scalars = self._scalars
        edges = np.flatnonzero(np.diff(scalars.row[candidates])) + 1
        return [
            _Row(
                scalars.sensors[scalars.sensor[part[0]]], part, int(scalars.valid[part[0]]), int(scalars.stamp[part[0]])
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


def fuse_reference(
    timeline: Timeline, config: FusionConfig, times: TimeArray, mode: Mode, progress: Progress | None = None
) -> Fused:
    """Filter or smooth one timeline by the reference engine, with estimates at ``times`` (int64 ns)."""
    engine = ReferenceEngine(timeline, config)
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
