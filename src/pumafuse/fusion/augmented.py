"""One axis of the filterpy engine: a `filterpy.kalman.KalmanFilter` on the delay-augmented matrices.

State of an axis: the plant's states, the offset, a constant bias for each sensor that has one, and a register of the
inputs in flight, the newest first. Over an interval the plant follows the register's acting entry:

    x⁺ = Φ x + Γ r_k,   o⁺ = o,   b⁺ = b,   and when an input is issued   r⁺ = (v, r_0, r_1, …).

`discretize` is the same model where commands come every T. Plain and inspectable; the other engines are held to it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from filterpy.kalman import KalmanFilter

from ..arrays import FloatArray, TimeArray
from ..model.discrete import transition
from ..model.plants import Plant
from .config import Process, Sensor
from .timeline import AxisInput
from .track import Track, Updates

# H, K (s,), ν and R of an update, and by how much the offset's variance was widened before it.
Update = tuple[FloatArray, FloatArray, float, float, float]
# A state that holds until the next: instant, mean (s,) and covariance (s, s) of plant, offset and biases, and the
# update that made it, if one did.
Held = tuple[int, FloatArray, FloatArray, Update | None]
# What brings a filter back: the instant, x, P, and how many states were held.
AxisPoint = tuple[int, FloatArray, FloatArray, int]

_ACT, _ISSUE, _READ = 0, 1, 2  # at one instant commands come before measurements


class AxisFilter:
    """One axis: steps through the instants of its timeline and meets components.

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
        measurements: TimeArray,
    ) -> None:
        issued, values, acting = driven.drive.time, driven.drive.value, driven.acting
        times = np.concatenate(([origin], acting, issued, measurements))
        kinds = np.repeat([_READ, _ACT, _ISSUE, _READ], [1, len(acting), len(issued), len(measurements)])
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
        """H (1, m) and R [m²] of a component of ``sensor`` here and now; R grows with speed where latency wanders."""
        H = sensor.scale * self._position
        if name in self._bias:
            H[0, self._bias[name]] = 1.0
        speed = float(self._rate @ self.kf.x[: self._n, 0]) + self._rate_input * float(self._input[self.index])
        return H, sd**2 + (sensor.scale * speed * sensor.latency_sd) ** 2

    def innovation(self, z: float, H: FloatArray, R: float) -> tuple[float, float]:
        """ν = z − H x and S = H P Hᵀ + R."""
        return z - (H @ self.kf.x).item(), (H @ self.kf.P @ H.T).item() + R

    def fuse(self, z: float, H: FloatArray, R: float, widened: float = 0.0) -> None:
        """Joseph-form update with one component, after the offset's variance was ``widened`` [m²]."""
        if widened:
            P = self.kf.P.copy()
            P[self._n, self._n] += widened
            self.kf.P = P
        self.kf.update(np.array([[z]]), R=np.array([[R]]), H=H)
        kept = self._register
        self._settle((H[0, :kept], self.kf.K[:kept, 0], float(self.kf.y[0, 0]), R, widened))

    def checkpoint(self) -> AxisPoint:
        """What :meth:`restore` needs to come back to this state."""
        return self.index, self.kf.x, self.kf.P, len(self._held)

    def restore(self, point: AxisPoint) -> None:
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
