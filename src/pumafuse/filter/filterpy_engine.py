"""The reference engine: a `filterpy.kalman.KalmanFilter` for each axis on the delay-augmented matrices.

Fed with the same events, for filtered estimates. State of an axis: the plant's states, the offset, the disturbance, the
biases, the gain error e, and a register of the inputs in flight, the newest first. Over an interval the plant follows
the register's acting entry r_k and e, which decays; a command shifts the register when it is given and moves e when it
acts:

    x⁺ = Φ x + Γ r_k + Γ_e e,   o⁺ = o,   b⁺ = b,   e⁺ = e exp(−Δ / recovery),   r⁺ = (u, r_0, r_1, …)

`discretize` is the same model where commands come every T. Plain and inspectable, hundreds of times slower; its
transitions are matrix exponentials, so that it shares nothing with the closed forms of the compiled filter.
"""

# pyright: reportConstantRedefinition=false
# (F, H, Q and R are the field's letters)

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache

import numpy as np
from filterpy.kalman import KalmanFilter

from ..arrays import FloatArray, TimeArray
from ..model.arm import AxisModel
from ..model.discrete import transition
from ..model.plants import SecondOrder
from .axis import (
    DECAY,
    DISTURBANCE,
    INPUT_NOISE,
    INTERCEPT,
    MANEUVER_DRIFT,
    MANEUVER_NOISE,
    OFFSET,
    PERIOD,
    RANDOM_WALK,
    REST,
    SLOPE,
    SMOOTH,
    START,
    STATES,
    Model,
    Sensors,
    State,
)
from .events import COMMAND, Events, Results
from .forward import Output
from .gate import RECENT_NS, SETTLED_NS
from .outcome import Outcome

Matrices = tuple[FloatArray, FloatArray]  # F and Q


class _Axis:
    """One axis: a filter that follows the commands of the table."""

    def __init__(self, plant: AxisModel, model: Model, state: State, events: Events, axis: int) -> None:
        self._plant, self._gain, self._process = plant.plant, model.gain[axis], model.process[axis]
        self.period = float(self._gain[PERIOD])
        mine = (events.source == COMMAND) & (events.known[:, axis] == Outcome.FUSED)
        self._acts, self._given = events.time[mine], events.stamp[mine]
        self._u = events.value[mine, axis] - state.drive[axis, START]
        when = np.concatenate((self._given, self._acts))
        order = np.argsort(when, kind="stable")  # at one instant a command is given before it acts
        self._instants: list[tuple[int, int, bool]] = list(
            zip(when[order].tolist(), (order % len(self._u)).tolist(), (order >= len(self._u)).tolist(), strict=True)
        )
        issued = np.searchsorted(self._given, self._acts, side="right")
        in_flight = int((issued - np.arange(len(self._u))).max(initial=1))
        A, _, C = self._plant.state_space()
        self.n = len(A)
        self.rest = self.n + 1
        self.reverts = model.rest[axis, REST : model.kind[axis, STATES]]
        self.disturbance = int(model.kind[axis, DISTURBANCE])
        self.biases = self.rest + self.disturbance
        self.error = self.rest + len(self.reverts)
        size = self.error + 1 + in_flight + 1
        self.position = np.zeros((1, size))
        self.position[0, : self.n], self.position[0, self.n] = C[0], 1.0
        self.position[0, self.rest : self.biases][:1] = 1.0
        self.kf = KalmanFilter(dim_x=size, dim_z=1, dim_u=size)
        self.kf.P = np.zeros((size, size))
        prior = range(self.n, self.error)
        self.kf.P[prior, prior] = np.diagonal(state.P[axis])[OFFSET : OFFSET + len(prior)]
        self.kf.B = np.eye(size)
        self.clock: int = int(state.clock[axis])
        self._next, self._acting, self._issued = 0, -1, 0

    @cached_property
    def _shift(self) -> FloatArray:
        """The register moved on by one."""
        F, first = np.eye(len(self.position[0])), self.error + 1
        F[first:, first:] = np.eye(len(F) - first, k=-1)
        return F

    @lru_cache(maxsize=10_000)  # noqa: B019 - lives as long as the axis
    def _moves(self, ns: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
        """Φ, Γ, Q for unit noise, Γ_e and the decay of e over an interval."""
        from scipy.linalg import expm

        n, dt = self.n, ns / 1e9
        A, B, _ = self._plant.state_space()
        driven = np.zeros((n + 2, n + 2))  # of the plant, an input that is held, and one that decays
        driven[:n, :n], driven[:n, n : n + 1], driven[:n, n + 1 :] = A, B, B
        driven[-1, -1] = -self._gain[DECAY]
        moved = expm(driven * dt)
        if dt < 0.5 / np.abs(A).sum():  # short: Van Loan's exponential, once; `transition` doubles it for longer ones
            van_loan = expm(np.block([[-A, B @ B.T], [np.zeros((n, n)), A.T]]) * dt)
            Q = van_loan[n:, n:].T @ van_loan[:n, n:]
            Q = 0.5 * (Q + Q.T)
        else:
            Q = transition(self._plant, dt).Q
        return moved[:n, :n], moved[:n, n], Q, moved[:n, n + 1], float(moved[-1, -1])

    @lru_cache(maxsize=10_000)  # noqa: B019 - lives as long as the axis
    def _smooth(self, ns: int) -> Matrices:
        """F and Q of a smooth disturbance: d″ = −λ² d − 2 λ d′ + λ² w is a plant with white noise at its input."""
        rate, variance = self.reverts[0]
        found = transition(SecondOrder(natural_frequency=rate, damping=1.0), ns / 1e9)
        return found.Phi, found.Q * (4.0 * variance / rate)  # 4 λ³ σ² is the density at d′

    def matrices(self, ns: int) -> Matrices:
        """F and Q over an interval of the state with the command that acts now."""
        n, size = self.n, len(self.position[0])
        Phi, Gamma, Q_unit, Gamma_e, left = self._moves(ns)
        F, Q = np.eye(size), np.zeros((size, size))
        F[:n, :n], F[:n, self.error], F[self.error, self.error] = Phi, Gamma_e, left
        if self._acting >= 0:
            F[:n, self.error + self._issued - self._acting] = Gamma
        maneuver = self._maneuver(self._acting)
        process = self._process
        Q[:n, :n] = Q_unit * (process[INPUT_NOISE] ** 2 + (process[MANEUVER_NOISE] * maneuver) ** 2)
        first = self.rest
        if self.disturbance == SMOOTH:
            first = self.biases
            F[self.rest : first, self.rest : first], Q[self.rest : first, self.rest : first] = self._smooth(ns)
        for i, (rate, variance) in enumerate(self.reverts[first - self.rest :], first):
            F[i, i], Q[i, i] = np.exp(-rate * ns / 1e9), -variance * np.expm1(-2.0 * rate * ns / 1e9)
        Q[n, n] = (process[RANDOM_WALK] ** 2 + (process[MANEUVER_DRIFT] * maneuver) ** 2) * (ns / 1e9)
        return F, Q

    def advance(self, time: int) -> None:
        """Predict to ``time`` [ns], over everything that is given or acts until then."""
        while self._next < len(self._instants) and self._instants[self._next][0] <= time:
            when, command, acts = self._instants[self._next]
            F, Q = self.matrices(when - self.clock)
            control = np.zeros((len(F), 1))
            if acts:
                control[self.error] = self._kick(command)
                self._acting = command
            else:
                F, control[self.error + 1] = self._shift @ F, self._u[command]
                self._issued = command + 1
            self.kf.predict(u=control, F=F, Q=Q)
            self.clock, self._next = when, self._next + 1
        F, Q = self.matrices(time - self.clock)
        self.kf.predict(F=F, Q=Q)
        self.clock = time

    def later(self, time: int, until: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """F, Q and x at ``until`` [ns] by the commands given by ``time``, where the filter stands; nothing moves."""
        before = self.clock, self._acting
        F_all, Q_all, x = np.eye(len(self.kf.x)), np.zeros_like(self.kf.P), self.kf.x.copy()
        acting = [c for c in range(self._acting + 1, len(self._u)) if self._acts[c] <= until and self._given[c] <= time]
        for when, command in [*((int(self._acts[c]), c) for c in acting), (until, None)]:
            F, Q = self.matrices(when - self.clock)
            F_all, Q_all, x = F @ F_all, F @ Q_all @ F.T + Q, F @ x
            if command is not None:
                x[self.error] += self._kick(command)
                self._acting = command
            self.clock = when
        self.clock, self._acting = before
        return F_all, Q_all, x

    @property
    def speed(self) -> float:
        """C(A x + B (u + e)) [m/s]."""
        A, B, C = self._plant.state_space()
        u = self._u[self._acting] if self._acting >= 0 else 0.0
        v = u + self.kf.x[self.error, 0]
        rate = self.kf.x[self.rest + 1, 0] if self.disturbance == SMOOTH else 0.0
        return float((C @ (A @ self.kf.x[: self.n, 0] + B[:, 0] * v))[0] + rate)

    def _step(self, command: int) -> float:
        before = self._u[command - 1] if command > 0 else 0.0
        return float(self._u[command] - before) if command >= 0 else 0.0

    def _kick(self, command: int) -> float:
        step = self._step(command)
        return (self._gain[SLOPE] * abs(step) / self.period + self._gain[INTERCEPT] - 1.0) * step

    def _maneuver(self, command: int) -> float:
        if command < 0:
            return 0.0
        return abs(self._step(command) - self._step(command - 1)) / self.period


class _Gate:
    """What :mod:`pumafuse.filter.gate` does, for one sensor and axis at a time."""

    def __init__(self, sensors: int, axes: int) -> None:
        self.rejected: dict[tuple[int, int], tuple[float, float, int]] = {}  # ν, R and time of the one to agree with
        self.streak = dict.fromkeys(((s, a) for s in range(sensors) for a in range(axes)), 0)
        self.reacquired = self.streak.copy()
        self.fused: dict[tuple[int, int], int] = {}
        self.unsettled: dict[int, int] = {}

    def agreement(
        self, key: tuple[int, int], nu: float, R: float, time: int, gate: float, axis: _Axis, scale: float, turn: float
    ) -> int:
        """1 if a rejected measurement agrees with the one before, 0 if not, −1 if that is less than T ago."""
        if key not in self.rejected:
            return 0
        nu_then, R_then, then = self.rejected[key]
        if time - then < axis.period * 1e9:
            return -1
        F, Q = axis.matrices(time - then)
        h = axis.position[0]
        row = h @ (F - np.eye(len(F)))
        row[axis.biases :] = 0.0
        motion = row @ axis.kf.P @ row + h @ Q @ h
        return int(abs(_nearest(nu - nu_then, turn)) <= gate * np.sqrt(R_then + R + scale**2 * motion))

    def contradicted(self, sensor: int, axis: int, time: int) -> int:
        """The sensor that stands for what is believed; −1 for none."""
        for (other, there), fused in sorted(self.fused.items()):
            fewer = self.reacquired[other, axis] <= self.reacquired[sensor, axis]
            if there == axis and other != sensor and time - fused <= RECENT_NS and fewer:
                return other
        return -1

    def count_rejected(self, key: tuple[int, int], nu: float, R: float, time: int, again: bool) -> None:
        if not again or key not in self.rejected:
            self.rejected[key] = nu, R, time
        self.streak[key] += 1
        if self.streak[key] > 1 and key[1] in self.unsettled:
            self.unsettled[key[1]] = time

    def count_fused(self, key: tuple[int, int], time: int) -> None:
        self.rejected.pop(key, None)
        self.streak[key], self.fused[key] = 0, time
        axis = key[1]
        mine = [fused for (_, there), fused in self.fused.items() if there == axis]
        settled = axis in self.unsettled and time - self.unsettled[axis] >= SETTLED_NS
        if settled and all(time - fused <= SETTLED_NS for fused in mine):
            del self.unsettled[axis]
            self.reacquired.update({one: 0 for one in self.reacquired if one[1] == axis})


def filter_events(
    plants: Sequence[AxisModel],
    model: Model,
    sensors: Sensors,
    events: Events,
    state: State,
    times: TimeArray,
    results: Results,
    outputs: FloatArray,
    progress: Callable[[float], None] | None = None,
) -> None:
    """What :func:`pumafuse.filter.forward.filter_events` does; ``state`` gets the final biases."""
    axes = [_Axis(plant, model, state, events, number) for number, plant in enumerate(plants)]
    gate = _Gate(len(sensors.scale), len(axes))
    at = 0
    for row in range(len(events.time)):
        while at < len(times) and times[at] < events.time[row]:
            _estimate(axes, int(times[at]), outputs, at)
            at += 1
        if events.source[row] != COMMAND:
            together = sensors.gate_rows[events.source[row]]
            decided = [number for number in range(len(axes)) if events.known[row, number] == Outcome.FUSED]
            for part in [decided] if together else [[number] for number in decided]:
                _add(axes, sensors, events, state, gate, row, part, results)
        if progress is not None and row % 1000 == 0:
            progress(row / len(events.time))
    for number in range(at, len(times)):
        _estimate(axes, int(times[number]), outputs, number)
    for number, axis in enumerate(axes):
        rest = slice(REST, REST + len(axis.reverts))
        state.x[number, rest] = axis.kf.x[axis.rest : axis.error, 0]
        state.P[number, rest, rest] = axis.kf.P[axis.rest : axis.error, axis.rest : axis.error]


def _nearest(difference: float, turn: float) -> float:
    """A difference of angles without whole turns; ``turn`` 0: as it is."""
    return difference - turn * round(difference / turn) if turn else difference


def _add(
    axes: Sequence[_Axis],
    sensors: Sensors,
    events: Events,
    state: State,
    gate: _Gate,
    row: int,
    part: Sequence[int],
    results: Results,
) -> None:
    """Axes of a row that pass the gate together or not at all."""
    sensor, time, scale = int(events.source[row]), int(events.time[row]), float(sensors.scale[events.source[row]])
    met: dict[int, tuple[float, FloatArray, float, float, float]] = {}
    for number in part:
        axis = axes[number]
        axis.advance(time)
        H = scale * axis.position
        for bias in sensors.bias[sensor, number]:
            if bias >= 0:
                H[0, axis.rest + bias - REST] = 1.0
        sd = sensors.sd[sensor, number] * (events.spread[row, number] if len(events.spread) else 1.0)
        R = float(sd**2 + (scale * axis.speed * sensors.latency_sd[sensor]) ** 2)
        z = float(events.value[row, number] - scale * state.drive[number, START])
        predicted, S = (H @ axis.kf.x).item(), (H @ axis.kf.P @ H.T).item() + R
        nu = _nearest(z - predicted, float(sensors.turn[sensor, number]))
        z = predicted + nu if sensors.turn[sensor, number] else z
        met[number] = z, H, R, nu, S
        results.innovation[row, number], results.innovation_sd[row, number] = nu, np.sqrt(S)
    limit = float(sensors.gate[sensor])
    beyond = [n for n, (_, _, _, nu, S) in met.items() if limit > 0.0 and abs(nu) > limit * np.sqrt(S)]
    turns = sensors.turn[sensor].tolist()
    agreements = [
        gate.agreement((sensor, n), met[n][3], met[n][2], time, limit, axes[n], scale, turns[n]) for n in beyond
    ]
    other = max((gate.contradicted(sensor, n, time) for n in beyond), default=-1)
    agreed = all(one == 1 for one in agreements)
    if beyond and agreed and other >= 0:
        results.contradicts[row] = other
    if beyond and not (agreed and other < 0):
        for number, (_, _, R, nu, _) in met.items():
            results.outcome[row, number] = Outcome.REJECTED
            gate.count_rejected((sensor, number), nu, R, time, -1 in agreements)
        return
    for number, (z, H, R, nu, _) in met.items():
        axis = axes[number]
        results.outcome[row, number] = Outcome.REACQUIRED if number in beyond else Outcome.FUSED
        if number in beyond:
            axis.kf.P = axis.kf.P.copy()
            axis.kf.P[axis.n, axis.n] += (nu / scale) ** 2
            gate.reacquired[sensor, number] += 1
            gate.unsettled[number] = time
        axis.kf.update(np.array([[z]]), R=np.array([[R]]), H=H)
        # Rounding makes P drift from symmetry by an ulp a step, and that grows over a million steps.
        axis.kf.P = 0.5 * (axis.kf.P + axis.kf.P.T)
        results.innovation_sd[row, number] = float(np.sqrt(axis.kf.S[0, 0]))
        gate.count_fused((sensor, number), time)


def _estimate(axes: Sequence[_Axis], time: int, outputs: FloatArray, n: int) -> None:
    """Every axis at ``time`` [ns], as estimate ``n``; a filter that is brought there changes nothing by it."""
    for number, axis in enumerate(axes):
        axis.advance(time)
        h, x, P, period = axis.position[0], axis.kf.x[:, 0], axis.kf.P, axis.period
        outputs[Output.POSITION, number, n] = h @ x
        outputs[Output.POSITION_SD, number, n] = np.sqrt(max(h @ P @ h, 0.0))
        outputs[Output.OFFSET, number, n] = x[axis.n]
        outputs[Output.OFFSET_SD, number, n] = np.sqrt(max(P[axis.n, axis.n], 0.0))
        if axis.disturbance:
            outputs[Output.DISTURBANCE, number, n] = x[axis.rest]
            outputs[Output.DISTURBANCE_SD, number, n] = np.sqrt(max(P[axis.rest, axis.rest], 0.0))
        F, Q, later = axis.later(time, time + round(period * 1e9))
        row = h @ F - h
        row[axis.biases :] = 0.0  # known: the inputs and e
        outputs[Output.VELOCITY, number, n] = (h @ later[:, 0] - h @ x) / period
        outputs[Output.VELOCITY_SD, number, n] = np.sqrt(max(row @ P @ row + h @ Q @ h, 0.0)) / period
