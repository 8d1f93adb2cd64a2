"""The filter, to be read: a `filterpy.kalman.KalmanFilter` for each axis, on delay-augmented matrices.

The state of an axis, relative to the start level at which it rests before its first command, and what moves it:

    offset o, disturbance d, biases    ȯ = w; the others fade or stay
    plant x, gain error e              ẋ = A x + B (u + e + w),  ė = −e / Tr
    register u, u₁, u₂, …              the command in force, then those in flight

`docs/reference.md` walks through this file beside the equations. It shares no formula with the compiled core, which has
to make the same of any log, and is a thousand times slower.
"""

# pyright: reportConstantRedefinition=false
# (A, F, H, L, P, Q and R are the field's letters)

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
from filterpy.common import van_loan_discretization
from filterpy.kalman import KalmanFilter
from scipy.integrate import solve_ivp

from ..arrays import FloatArray, TimeArray
from ..model.plants import Plant
from .core import FINEST, Model, Output, Record
from .events import COMMAND, Events, Results
from .outcome import Outcome

OFFSET, DISTURBANCE, ITS_RATE, FIRST_BIAS = range(4)  # states; drifting biases come first, constant ones after
GIVEN, ACTS, MEASURED, ASKED = range(4)  # what happens, in the order of one instant; an estimate is asked for
RECENT = 500_000_000  # ns; a sensor fused within this time stands for what is believed
SETTLED = 5_000_000_000  # ns; all sensors in agreement for so long: what was before is forgotten
NEVER, NOBODY = math.inf, -1
MOST = 10.0  # of a score: an outlier that passed the gate is no unrest


class Innovation(NamedTuple):
    """What a measurement says beyond what was expected at ``time`` [ns]: ν, of variance S, R of which is noise."""

    time: int
    nu: float
    S: float
    R: float


def discretize(A: FloatArray, L: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """F and Q of ẋ = A x + L w over ``dt`` [s]: over a time so short that e^(−A dt) does not grow, which is doubled."""
    doublings = math.ceil(math.log2(max(1.0, dt * np.abs(np.linalg.eigvals(A)).max())))
    F, Q = van_loan_discretization(A, L, dt / 2**doublings)
    for _ in range(doublings):
        F, Q = F @ F, F @ Q @ F.T + Q
    return F, 0.5 * (Q + Q.T)


class Bent:
    """What the commands alone make of an axis with a fastest speed, play or sag, which no matrix does."""

    def __init__(self, plant: Plant, axis: Record) -> None:
        self.axis, self.state, self.tool = axis, np.zeros(len(plant.state_space()[0])), 0.0
        self.lag, self.fastest, self.half = plant.lag, float(axis["max_speed"]) or math.inf, 0.5 * float(axis["play"])
        self.follows = 2.0 * float(axis["damping"] * axis["natural_frequency"])  # how fast the speed does [1/s]

    def speed(self, state: FloatArray, goal: float) -> float:
        """Speed of the drive: a plant of first order has the speed that it is asked for."""
        asked = min(max((goal - state[0]) / self.lag, -self.fastest), self.fastest)
        return float(asked if len(state) == 1 else state[1])

    def rates(self, state: FloatArray, goal: float) -> list[float]:
        """How the drive's state changes."""
        asked, speed = self.speed(state[:1], goal), self.speed(state, goal)
        return [speed] if len(state) == 1 else [speed, self.follows * (asked - speed)]

    def move(self, u: float, e: float, dt: float) -> None:
        """Over an interval, at whose beginning the gain error is e; the tool stays where the drive turns."""

        def goal(t: float) -> float:
            return u + e * math.exp(-t / self.axis["recovery"]) if self.axis["recovery"] else u + e

        solved = solve_ivp(
            lambda t, state: self.rates(state, goal(t)), (0.0, dt), self.state, "LSODA",
            events=lambda t, state: self.speed(state, goal(t)), rtol=1e-12, atol=1e-14,
        )  # fmt: skip
        self.state = solved.y[:, -1]
        for x in (*(turned[0] for turned in solved.y_events[0]), self.state[0]):
            self.tool = min(max(self.tool, float(x) - self.half), float(x) + self.half)

    def motion(self, goal: float) -> FloatArray:
        """Position and speed of the tool, which rests while the drive does not push it, (2,)."""
        axis, speed, level = self.axis, self.speed(self.state, goal), float(self.axis["start"]) + self.tool
        slope, knee = axis["sag_slope"], level
        if level > axis["sag_knee"]:
            slope, knee = axis["sag_slope_beyond"], axis["sag_knee"]
        elif level < axis["sag_knee_below"]:
            slope, knee = axis["sag_slope_below"], axis["sag_knee_below"]
        sag = axis["sag_offset"] + axis["sag_slope"] * knee + slope * (level - knee)
        x = float(self.state[0])
        rests = self.tool not in (x - self.half, x + self.half) or (self.tool - x) * speed > 0.0
        return np.array((self.tool + sag, 0.0 if rests else speed * (1.0 + slope)))


class Axis:
    """An axis, at rest at ``origin`` [ns]: its filter, with room for so many commands in flight, and its gate."""

    def __init__(self, plant: Plant, axis: Record, sensors: Record, views: Record, origin: int, in_flight: int) -> None:
        self.axis, self.sensors, self.views, self.gate = axis, sensors, views, Gate()
        self.period, self.time, self.step, self.unrest = float(axis["period"]), origin, 0.0, 0.0
        self.in_flight: list[int] = []  # when each command acts that is given and does not act yet [ns]

        A, B, C = plant.state_space()
        d, drifting = slice(DISTURBANCE, FIRST_BIAS), slice(FIRST_BIAS, FIRST_BIAS + len(sensors))
        constant = slice(drifting.stop, drifting.stop + len(sensors))
        x = slice(constant.stop, constant.stop + len(A))
        self.e, self.u, size = x.stop, x.stop + 1, x.stop + 2 + in_flight
        sd, fades = np.zeros(size), np.zeros(size)  # of each state at the start, and how fast it fades [1/s]
        sd[OFFSET], sd[drifting], sd[constant] = axis["offset_sd"], views["bias_drift_sd"], views["bias_sd"]
        sd[DISTURBANCE], fades[DISTURBANCE] = axis["disturbance_sd"], 1.0 / axis["disturbance_time"]
        fades[drifting] = 1.0 / views["bias_time"]
        fades[self.e] = 1.0 / axis["recovery"] if axis["recovery"] else 0.0
        self.A, self.L = np.diag(-fades), np.diag(sd * np.sqrt(2.0 * fades))  # ẋ = A x + L w
        self.A[x, x], self.A[x, [self.e, self.u]] = A, B
        if axis["smoothness"] > 1.0:  # d″ = −rate² d − 2 rate d′ + w, where the second state is d′ / rate
            rate, sd[ITS_RATE] = math.sqrt(3.0) * fades[DISTURBANCE], sd[DISTURBANCE]
            self.A[d, d] = rate * np.array([[0.0, 1.0], [-1.0, -2.0]])
            self.L[d, d] = np.diag([0.0, sd[DISTURBANCE] * math.sqrt(4.0 * rate)])
        fading = d, *(slice(i, i + 1) for i in range(drifting.start, drifting.stop))
        self.parts = [slice(OFFSET, 1), *(part for part in fading if sd[part].any()), slice(x.start, self.u + 1)]
        self.set_noise(maneuver=0.0)
        self.of_arm = np.array([i not in range(drifting.start, drifting.stop) for i in range(size)])  # not of a sensor

        self.h = np.zeros(size)  # the position is h x
        self.h[OFFSET], self.h[DISTURBANCE], self.h[x] = 1.0, 1.0, C
        self.speed = self.h @ self.A
        self.speed[DISTURBANCE] = 0.0  # a rough disturbance has none
        self.unit, self.shift = np.eye(size), np.eye(size)
        self.shift[self.u :, self.u :] = np.eye(1 + in_flight, k=1)
        self.H = sensors["scale"][:, np.newaxis] * self.h + self.unit[drifting] + self.unit[constant]
        self.kf = KalmanFilter(dim_x=size, dim_z=1)
        self.kf.x, self.kf.P, self.kf.Q = np.zeros(size), np.diag(sd**2), np.zeros((size, size))
        self.path = np.zeros(size)  # the state by commands alone, as it would be without what bends it
        bends = any(axis[name] for name in axis.dtype.names or () if name.startswith(("max_speed", "play", "sag")))
        self.bent = Bent(plant, axis) if bends else None
        self.doubts = np.array((axis["lag_sd"], axis["gain_sd"]))  # of its lag [s], and of its size
        self.by = np.zeros((2, size))  # how these have changed the state, by way of measurements

    def set_noise(self, maneuver: float) -> None:
        """The noise on offset and input from now on."""
        axis, self.L = self.axis, self.L.copy()
        self.L[OFFSET, OFFSET] = math.hypot(axis["drift"], axis["maneuver_drift"] * maneuver)
        self.L[:, self.u] = math.hypot(axis["input_noise"], axis["maneuver_noise"] * maneuver) * self.A[:, self.u]

    def over(self, ns: int) -> tuple[FloatArray, FloatArray]:
        """F and Q over an interval in which no command is given or acts."""
        F, Q, L = self.unit.copy(), np.zeros_like(self.unit), self.L * np.exp(0.5 * self.unrest * self.of_arm)
        for part in self.parts:
            F[part, part], Q[part, part] = discretize(self.A[part, part], L[part, part], ns / 1e9)
        Q[self.e :, :] = Q[:, self.e :] = 0.0  # it is, but for rounding
        return F, Q

    def predict(self, time: int) -> None:
        """To ``time`` [ns]."""
        if time > self.time:
            F, Q = self.over(time - self.time)
            self.kf.predict(F=F, Q=Q)
            if self.bent is not None:
                self.bent.move(float(self.path[self.u]), float(self.path[self.e]), (time - self.time) / 1e9)
            self.path, self.by, self.time = F @ self.path, self.by @ F.T, time

    def add_command(self, time: int, command: float, acts: int) -> None:
        """A command [m], which acts at ``acts`` [ns], goes to the end of the register."""
        self.predict(time)
        self.in_flight = [*self.in_flight, acts]
        self.apply(self.unit, command - float(self.axis["start"]), self.unit[self.u + len(self.in_flight)])

    def apply(self, F: FloatArray, u: float, B: FloatArray) -> None:
        """A command enters what is known of the state, and what is known by commands alone."""
        self.kf.predict(F=F, u=u, B=B)
        self.path = F @ self.path + B * u

    def command(self, time: int) -> None:
        """The first command in flight acts: the gain error jumps, and the register moves on."""
        self.predict(time)
        self.in_flight = self.in_flight[1:]
        step = float(self.kf.x[self.u + 1] - self.kf.x[self.u])
        gain = self.axis["slope"] * abs(step) / self.period + self.axis["intercept"]
        self.apply(self.shift, float(gain - 1.0) * step, self.unit[self.e])
        self.set_noise(maneuver=abs(step - self.step) / self.period)
        self.step = step

    def innovation(self, s: int, z: float, spread: float) -> Innovation:
        """ν and S of a measurement [m] of sensor ``s``, whose noise is scaled by ``spread``."""
        sensor, view, H, x, P = self.sensors[s], self.views[s], self.H[s], self.kf.x, self.kf.P
        position, speed = self.bend()
        R = (spread * view["sd"]) ** 2 + (sensor["scale"] * (self.speed @ x + speed) * sensor["latency_sd"]) ** 2
        level = sensor["scale"] * (self.axis["start"] + position)
        nu = math.remainder(z - level - H @ x, view["turn"] or math.inf)
        return Innovation(self.time, nu, H @ P @ H + R, R)

    def update(self, s: int, innovation: Innovation, reacquires: bool) -> float:
        """Fuse a measurement; where it re-acquires, the offset may have moved by ν before. Returns √S."""
        if reacquires:
            self.kf.P[OFFSET, OFFSET] += (innovation.nu / self.sensors[s]["scale"]) ** 2
        self.kf.update(self.H[s] @ self.kf.x + innovation.nu, R=innovation.R, H=self.H[s : s + 1])
        missed = self.sensors[s]["scale"] * self.by_doubt() - self.by @ self.H[s]  # how ν changes
        self.by = self.by + np.outer(missed, self.kf.K)
        self.kf.P = 0.5 * (self.kf.P + self.kf.P.T)  # or rounding leads away from symmetry, over a million steps
        self.gate.fuse(s, innovation.time, reacquires)
        if not reacquires:
            self.learn(innovation)
        return math.sqrt(self.kf.S[0, 0])

    def learn(self, innovation: Innovation) -> None:
        """The arm's noise follows what a measurement says of it, by the score of the likelihood."""
        nu, S, R = innovation.nu, innovation.S, innovation.R
        score = min((1.0 - R / S) * (nu**2 / S - 1.0), MOST)
        self.unrest = max(self.unrest + self.axis["adaptation"] * score, 0.0)

    def by_doubt(self) -> FloatArray:
        """How the position by commands alone changes with its lag [m/s] and with its size [m], (2,)."""
        position, speed = self.bend()
        return np.array((-(self.speed @ self.path + speed), self.h @ self.path + position))

    def bend(self) -> FloatArray:
        """How far position and speed are from what the path says, (2,)."""
        if self.bent is None:
            return np.zeros(2)
        goal = float(self.path[self.u] + self.path[self.e])
        return self.bent.motion(goal) - (self.h @ self.path, self.speed @ self.path)

    def agreement(self, s: int, now: Innovation) -> bool | None:
        """Whether a rejected measurement agrees with the one before; None where that is less than T ago."""
        before, sensor = self.gate.rejected.get(s), self.sensors[s]
        if before is None:
            return False
        if now.time - before.time < self.period * 1e9:
            return None
        motion = self.variance_of_motion(*self.over(now.time - before.time))
        apart = abs(math.remainder(now.nu - before.nu, self.views[s]["turn"] or math.inf))
        return apart <= sensor["gate"] * math.sqrt(before.R + now.R + sensor["scale"] ** 2 * motion)

    def variance_of_motion(self, F: FloatArray, Q: FloatArray) -> float:
        """Variance of the way that the position moves over an interval [m²]."""
        row = self.h @ (F - self.unit)
        return float(row @ self.kf.P @ row + self.h @ Q @ self.h)

    def estimate(self, time: int) -> FloatArray:
        """What is known at ``time`` [ns], by ``Output``; the velocity is the mean over the coming period."""
        self.predict(time)
        h, T, x, P, until = self.h, self.period, self.kf.x, self.kf.P, time + round(self.period * 1e9)
        left = self.by_doubt() - self.by @ h  # how what is not known of the position changes
        later = copy(self)
        later.kf, later.bent = copy(self.kf), copy(self.bent)
        later.kf.P = np.zeros_like(P)  # which becomes what noise adds until then
        while later.in_flight and later.in_flight[0] <= until:
            later.command(later.in_flight[0])
        later.predict(until)
        moves = self.variance_of_motion(self.over(until - time)[0], later.kf.P)
        bend, bends = self.bend()[0], (later.bend() - self.bend())[0]
        mean = np.array((h @ x + bend, (h @ (later.kf.x - x) + bends) / T, x[OFFSET], x[DISTURBANCE]))
        variance = np.array((h @ P @ h, moves / T**2, P[OFFSET, OFFSET], P[DISTURBANCE, DISTURBANCE]))
        moves_by = (later.by_doubt() - later.by @ h - left) / T
        doubts = np.stack((left, moves_by, self.by[:, OFFSET], self.by[:, DISTURBANCE]))
        variance += doubts**2 @ self.doubts**2
        sd = np.maximum(np.sqrt(np.maximum(variance, 0.0)), FINEST / np.array((1.0, T, 1.0, 1.0)))
        way = later.by_doubt()[1] - self.by_doubt()[1]  # of the response
        sd[0] = math.hypot(sd[0], self.axis["unseen_lag_sd"] * way / T)
        sd[3] *= self.axis["disturbance_sd"] > 0.0  # else there is none
        return np.stack((mean, sd), axis=1).ravel()


class Gate:
    """What is remembered of the sensors on an axis, to tell a jump from outliers and whom to believe."""

    def __init__(self) -> None:
        self.rejected: dict[int, Innovation] = {}  # of a sensor: a measurement that another may agree with
        self.fused: dict[int, int] = {}  # when its last one was fused [ns]
        self.reacquired = Counter[int]()  # how often it did
        self.unsettled = NEVER  # when sensors last disagreed while re-acquisitions are counted [ns]

    def contradicted(self, s: int, time: int) -> int:
        """The sensor that stands for what is believed, against sensor ``s``; or nobody."""
        for other, fused in sorted(self.fused.items()):
            if other != s and time - fused <= RECENT and self.reacquired[other] <= self.reacquired[s]:
                return other
        return NOBODY

    def reject(self, s: int, innovation: Innovation, too_soon: bool) -> None:
        """Remember a measurement, unless it comes too soon after one that is remembered."""
        if s in self.rejected and self.unsettled < NEVER:
            self.unsettled = innovation.time
        if s not in self.rejected or not too_soon:
            self.rejected[s] = innovation

    def fuse(self, s: int, time: int, reacquires: bool) -> None:
        """Forget what was rejected; and re-acquisitions, once all sensors have agreed for long."""
        self.rejected.pop(s, None)
        self.fused[s] = time
        if reacquires:
            self.reacquired[s] += 1
            self.unsettled = time
        if time - self.unsettled >= SETTLED and all(time - fused <= SETTLED for fused in self.fused.values()):
            self.reacquired.clear()
            self.unsettled = NEVER


class Filter:
    """The axes of an arm at rest at ``origin`` [ns], and the events that they are to follow."""

    def __init__(self, plants: Sequence[Plant], model: Model, origin: int, events: Events) -> None:
        self.sensors, self.events, self.decides = model.sensor, events, events.codes == Outcome.FUSED
        self.axes: list[Axis] = []
        for a, plant in enumerate(plants):
            commands_here = self.decides[:, a] & (events.source == COMMAND)
            stamped = np.searchsorted(events.stamp[commands_here], events.time[commands_here], side="right")
            in_flight = int((stamped - np.arange(len(stamped))).max(initial=0))
            self.axes.append(Axis(plant, model.axis[a], model.sensor, model.view[:, a], origin, in_flight))

    def run(self, results: Results, times: TimeArray, progress: Callable[[float], None] | None = None) -> FloatArray:
        """All events in their order, and an estimate at each of ``times`` [ns] by those until then, (8, A, n).

        ``results`` gets what became of each measurement; ``progress`` is called now and then with the share done.
        """
        events, outputs = self.events, np.zeros((len(Output), len(self.axes), len(times)))
        agenda = [(time, ASKED, n, list(range(len(self.axes)))) for n, time in enumerate(times.tolist())]
        for row in np.flatnonzero(self.decides.any(axis=1)).tolist():
            time, source, axes = int(events.time[row]), events.source[row], np.flatnonzero(self.decides[row]).tolist()
            if source == COMMAND:
                agenda += [(int(events.stamp[row]), GIVEN, row, axes), (time, ACTS, row, axes)]
            else:
                parts = [axes] if self.sensors[source]["gate_rows"] else [[a] for a in axes]
                agenda += [(time, MEASURED, row, part) for part in parts]
        for done, (time, what, n, axes) in enumerate(sorted(agenda)):
            if what == MEASURED:
                self.measurement(n, axes, results)
            for a in axes:
                if what == GIVEN:
                    self.axes[a].add_command(time, events.value[n, a], acts=int(events.time[n]))
                elif what == ACTS:
                    self.axes[a].command(time)
                elif what == ASKED:
                    outputs[:, a, n] = self.axes[a].estimate(time)
            if progress is not None and done % 1000 == 0:
                progress(done / len(agenda))
        return outputs

    def measurement(self, row: int, axes: list[int], results: Results) -> None:
        """Axes of a measurement, which pass the gate together or not at all."""
        events, s, time = self.events, int(self.events.source[row]), int(self.events.time[row])
        gate, innovations = self.sensors[s]["gate"], dict[int, Innovation]()
        for a in axes:
            self.axes[a].predict(time)
            spread = events.spread[row, a] if len(events.spread) else 1.0
            innovations[a] = self.axes[a].innovation(s, events.value[row, a], spread)
            results.innovation[row, a], results.innovation_sd[row, a] = innovations[a].nu, math.sqrt(innovations[a].S)
            results.noise_scale[row, a] = math.exp(self.axes[a].unrest)
        beyond = [a for a in axes if gate > 0.0 and abs(innovations[a].nu) > gate * math.sqrt(innovations[a].S)]
        agree = [self.axes[a].agreement(s, innovations[a]) for a in beyond]
        against = max((self.axes[a].gate.contradicted(s, time) for a in beyond), default=NOBODY)
        if all(agree) and against != NOBODY:
            results.contradicts[row] = against
        for a in axes:
            if all(agree) and against == NOBODY:
                results.outcome[row, a] = Outcome.REACQUIRED if a in beyond else Outcome.FUSED
                results.innovation_sd[row, a] = self.axes[a].update(s, innovations[a], reacquires=a in beyond)
            else:
                results.outcome[row, a] = Outcome.REJECTED
                self.axes[a].gate.reject(s, innovations[a], too_soon=None in agree)

    def bias(self, sensor: int, axis: int) -> tuple[float, float] | None:
        """Mean and sd [m] of the constant bias of a sensor on an axis; None where none is in the state."""
        state, i = self.axes[axis], FIRST_BIAS + len(self.sensors) + sensor
        variance = max(state.kf.P[i, i], 0.0) + float(state.by[:, i] ** 2 @ state.doubts**2)
        return (float(state.kf.x[i]), max(math.sqrt(variance), FINEST)) if state.views[sensor]["bias_sd"] else None
