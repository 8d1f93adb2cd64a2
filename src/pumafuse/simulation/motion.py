"""Simulates the motion of the true arm: the plant as a sum of its poles' responses, exact from event to event.

H(s) = Σ r_i / (s − p_i): each pole is a scalar equation ż = p z + u + e + w. The command u is constant from event to
event, the gain error e decays as exp(−bt) with b = 1 / recovery, so that over an interval Δ

    z⁺ = e^(pΔ) z + (e^(pΔ) − 1)/p · u + (e^(pΔ) − e^(−bΔ))/(p + b) · e + ∫ e^(p(Δ−s)) dW(s).

A drive with a fastest speed is no sum of poles: what the commands make of it is integrated (:func:`_limit_speed`), and
the noise moves it as it moves the plant below that speed.

Nothing of the filter's discretisation is used here: the filter is tested against this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from ..arrays import ComplexArray, FloatArray, TimeArray
from ..errors import ConfigError
from ..fusion.config import Process
from ..model.plants import FirstOrder
from . import reverting
from .reverting import sum_of_decays
from .true_arm import TrueAxis

POINTS = 60  # of the grid in each period
_APART = {2: 1e-5, 3: 1e-4}  # equal poles are set this far apart, relatively: it changes the response by its square
_NODES = 3  # of the noise integral: exact to 1e-10 while |p|Δ ≤ _LONGEST_TURN
_LONGEST_TURN = 0.1
_MOST_EVENTS = 20_000_000  # 2 GB of work


def grid(ticks: int, period: float) -> TimeArray:
    """Instants of ``ticks`` periods of T [s] at which measurements and reference rows may be taken, int64 ns.

    All random numbers are drawn on it, so that the motion does not depend on who measures it.
    """
    return np.rint(np.arange(ticks * POINTS + 1) * (period * 1e9 / POINTS)).astype(np.int64)


@dataclass(frozen=True)
class Motion:
    """The true position of one axis."""

    time: TimeArray  # int64 ns, ascending, (k,); it contains the grid
    position: FloatArray  # [m] relative to the start level, (k,)

    def at(self, time: TimeArray) -> FloatArray:
        """Positions [m] at instants of the grid, (n,)."""
        return self.position[np.searchsorted(self.time, time)]


def simulate_axis(
    axis: TrueAxis,
    process: Process,
    offset_sd: float,
    issued: TimeArray,
    command: FloatArray,
    period: float,
    rng: np.random.Generator,
    start: float = 0.0,
) -> Motion:
    """The motion of one axis through its commands, exact on the grid, until one period T [s] after the last.

    A ``command`` [m] relative to the ``start`` level, which the sag needs, is given at each ``issued`` tick of T, int64
    ns, (n,). The process's disturbance is stationary from the start; ``rng`` draws everything random of this axis.

    Raises:
        ConfigError: A time constant is too short for so long a run.
    """
    noises = rng.spawn(5)  # so that one kind of noise changes no other
    delay = np.maximum(axis.delay + axis.delay_jitter * noises[0].standard_normal(len(issued)), 0.0)
    acting = issued + np.rint(delay * 1e9).astype(np.int64)
    acting = np.maximum.accumulate(acting)  # commands do not overtake one another
    poles, residues = _modes(axis)
    time = _events(acting, grid(len(issued), period), float(np.abs(poles).max()))
    interval = np.diff(time) / 1e9
    latest = np.searchsorted(acting, time[:-1], side="right")  # 0: the arm still rests, n: command n − 1 acts

    decay_rate = 0.0 if axis.gain_recovery is None else 1.0 / axis.gain_recovery
    level, error = _plant_input(axis, command, acting, period, decay_rate)
    since = time[:-1] - np.insert(acting, 0, 0)[latest]
    level, error = (np.insert(value, 0, 0.0)[latest] for value in (level, error))
    maneuver = (np.abs(np.diff(command, n=2, prepend=[0.0, 0.0, 0.0])) / period)[latest]
    q = process.input_noise**2 + (process.maneuver_noise * maneuver) ** 2
    drift = process.drift**2 + (process.maneuver_drift * maneuver) ** 2

    node, weight = np.polynomial.legendre.leggauss(_NODES)
    white = noises[1].standard_normal((len(interval), _NODES)) * np.sqrt(0.5 * weight)
    white *= np.sqrt(interval * q)[:, None]
    error = error * np.exp(-decay_rate * since / 1e9)
    distinct, row = np.unique(interval, return_inverse=True)
    position = np.zeros(len(time))
    for pole, residue in zip(poles, residues, strict=True):
        if pole.imag < 0.0:
            continue  # its conjugate stands for both
        share = residue if pole.imag == 0.0 else 2.0 * residue
        response = np.exp(pole * 0.5 * (node + 1.0) * distinct[:, None])[row]
        forced = np.zeros(len(interval), dtype=np.complex128)
        if axis.max_speed is None:
            forced = _response(pole, 0.0, distinct)[row] * level
            forced = forced + _response(pole, -decay_rate, distinct)[row] * error
        forced += np.einsum("ij,ij->i", response, white)
        position[1:] += (share * sum_of_decays(np.exp(pole * distinct)[row], forced)).real
    if axis.max_speed is not None:
        position[1:] += _limit_speed(axis, axis.max_speed, time, level, error, decay_rate)

    position = _backlash(position, axis.backlash or 0.0)
    if axis.sag is not None:
        position += axis.sag.at(start + position)
    position[1:] += np.cumsum(np.sqrt(drift * interval) * noises[2].standard_normal(len(interval)))
    position += offset_sd * noises[3].standard_normal()
    if process.disturbance_sd:
        kind = reverting.smooth if process.disturbance_kind == "matern" else reverting.rough
        position += kind(time, process.disturbance_sd, process.disturbance_time, noises[4])
    if axis.slow_drift:
        position += axis.slow_drift * np.sin(2.0 * np.pi * (time - time[0]) / 1e9 / axis.slow_drift_period)
    return Motion(time, position)


def _plant_input(
    axis: TrueAxis, command: FloatArray, acting: TimeArray, period: float, decay_rate: float
) -> tuple[FloatArray, FloatArray]:
    """The plant's input from each command on: its constant part and the gain error that decays from there [m], (n,).

    With stiction the drive decides when a command acts. It stays, or goes to its input of that instant, and holds
    that until the next command: nothing of its input decays in between.
    """
    step = np.diff(command, prepend=0.0)
    jump = (axis.gain_at(np.abs(step) / period) - 1.0) * step
    decay = np.exp(-decay_rate * np.diff(acting, prepend=acting[0]) / 1e9)
    error = sum_of_decays(decay.astype(np.complex128), jump.astype(np.complex128)).real
    if not axis.stiction:
        return command, error
    wanted = (command + error).tolist()
    held = accumulate(wanted, lambda now, to: to if abs(to - now) > axis.stiction else now, initial=0.0)
    return np.fromiter(held, dtype=np.float64)[1:], np.zeros_like(command)


def _response(pole: complex, rate: float, interval: FloatArray) -> ComplexArray:
    """∫ e^(pole (Δ − s)) e^(rate s) ds over each interval Δ [s]: what a pole makes of an input that grows so."""
    slow, fast = (rate, pole) if pole.real < rate else (pole, rate)
    apart = fast - slow
    growth = np.expm1(apart * interval) / apart if apart else interval  # no digits lost where they nearly coincide
    return np.asarray(np.exp(slow * interval) * growth, dtype=np.complex128)


def _modes(axis: TrueAxis) -> tuple[ComplexArray, ComplexArray]:
    """Poles p_i [rad/s] and residues r_i of the plant in series with its extra pole."""
    plant = axis.plant
    if isinstance(plant, FirstOrder):
        poles = [complex(-1.0 / plant.time_constant)]
    else:
        middle = -plant.damping * plant.natural_frequency
        half = plant.natural_frequency * np.sqrt(complex((plant.damping - 1.0) * (plant.damping + 1.0)))
        far = middle - half
        poles = [far, far.conjugate() if half.imag else plant.natural_frequency**2 / far]
    if axis.extra_pole is not None:
        poles.append(complex(-1.0 / axis.extra_pole))
    apart = _set_apart(np.array(poles))
    differences = apart[:, None] - apart[None, :]
    np.fill_diagonal(differences, 1.0)
    return apart, np.prod(-apart) / np.prod(differences, axis=1)


def _set_apart(poles: ComplexArray) -> ComplexArray:
    """Poles that (nearly) coincide, spread evenly about their mean, so that each is a mode of its own."""
    separate = poles.copy()
    for pole in poles:
        together = np.abs(poles - pole) < max(_APART.values()) * np.abs(pole)
        count = int(together.sum())
        nearest = np.abs(poles[together][:, None] - poles[together][None, :])[np.triu_indices(count, 1)]
        if count > 1 and nearest.min() < _APART[count] * np.abs(pole):
            spread = (np.arange(count) - 0.5 * (count - 1)) * (2.0 * _APART[count])
            separate[together] = poles[together].mean().real * (1.0 + spread)
    return separate


def _events(acting: TimeArray, instants: TimeArray, fastest: float) -> TimeArray:
    """The grid's ``instants``, those at which a command acts, and as many between as the noise integral needs."""
    longest = max(int(_LONGEST_TURN * 1e9 / fastest), 1)
    end = instants[-1]
    if end / longest > _MOST_EVENTS:
        least = end / 1e6 / _MOST_EVENTS / _LONGEST_TURN
        lag = f"a lag or time constant of {1e3 / fastest:.3g} ms"
        raise ConfigError(f"{lag} is too short to follow over {end / 1e9:.0f} s: at least {least:.2g} ms")
    finer = np.arange(0, end if longest < instants[1] else 0, longest, dtype=np.int64)
    time = np.sort(np.concatenate((acting[acting <= end], instants, finer)), kind="stable")  # merges what ascends
    return time[np.diff(time, prepend=-1) > 0]


def _limit_speed(
    axis: TrueAxis, max_speed: float, time: TimeArray, level: FloatArray, error: FloatArray, decay_rate: float
) -> FloatArray:
    """Where a drive with a fastest speed is at all instants but the first [m], (k,).

    It is asked for the speed that takes back the gap within the plant's lag, but for no more than the fastest. A plant
    of second order follows that with the time constant 1/(2ζω). From each instant, int64 ns, (k + 1,), to the next its
    input is a constant ``level`` and an ``error`` that decays, (k,).
    """
    from scipy.integrate import odeint

    plant, late = axis.plant, axis.extra_pole
    follows = None if isinstance(plant, FirstOrder) else 2.0 * plant.damping * plant.natural_frequency

    def rates(state: FloatArray, t: float, u: float, e: float) -> list[float]:
        x, speed, behind = state.tolist()
        asked = min(max((u + e * math.exp(-decay_rate * t) - x) / plant.lag, -max_speed), max_speed)
        moves = [asked, 0.0] if follows is None else [speed, follows * (asked - speed)]
        return [*moves, 0.0 if late is None else (x - behind) / late]

    state, position = np.zeros(3), np.empty(len(level))
    begins = np.flatnonzero(np.diff(level, prepend=np.nan) != 0.0)  # elsewhere the input goes on as it did
    for begin, end in zip(begins.tolist(), [*begins[1:].tolist(), len(level)], strict=True):
        since = (time[begin : end + 1] - time[begin]) / 1e9
        solved = odeint(rates, state, since, (level[begin], error[begin]), rtol=1e-9, atol=1e-12)
        position[begin:end], state = solved[1:, 0 if late is None else 2], solved[-1]
    return position


def _backlash(position: FloatArray, width: float) -> FloatArray:
    """The position behind a gear with ``width`` [m] of play: y_n = clip(y_(n−1), x_n − width/2, x_n + width/2)."""
    if not width:
        return position
    tool = accumulate(position.tolist(), lambda y, x: min(max(y, x - 0.5 * width), x + 0.5 * width))
    return np.fromiter(tool, dtype=np.float64)
