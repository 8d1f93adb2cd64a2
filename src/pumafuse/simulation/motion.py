"""How the true arm moves: the plant as a sum of its poles' responses, integrated exactly from event to event.

H(s) = Σ r_i / (s − p_i): each pole is a component equation ż = p z + v + w, and over an interval Δ of constant v
z⁺ = e^(pΔ) z + (e^(pΔ) − 1)/p · v + ∫ e^(p(Δ−s)) dW(s). Nothing of the filter's discretisation is used here: this is
what it is tested against.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, TimeArray
from ..errors import ConfigError
from ..fusion.config import Process
from ..model.plants import FirstOrder
from .lattice import lattice
from .true_arm import TrueAxis

ComplexArray: TypeAlias = npt.NDArray[np.complex128]

_APART = {2: 1e-5, 3: 1e-4}  # equal poles are set this far apart, relatively: it changes the response by its square
_NODES = 3  # of the noise integral: exact to 1e-10 while |p|Δ ≤ 0.1
_TURN = 0.1
_MOST_EVENTS = 20_000_000  # 2 GB of work


@dataclass(frozen=True)
class Motion:
    """Where the tool truly was on one axis.

    Attributes:
        time: Int64 ns, ascending, (k,); among them the lattice.
        position: [m] relative to the start level, (k,).
    """

    time: TimeArray
    position: FloatArray

    def at(self, time: TimeArray) -> FloatArray:
        """Positions [m] at instants of the lattice, (n,)."""
        return self.position[np.searchsorted(self.time, time)]


def move(
    axis: TrueAxis,
    process: Process,
    offset_sd: float,
    issued: TimeArray,
    command: FloatArray,
    period: float,
    rng: np.random.Generator,
) -> Motion:
    """Move one axis through its commands.

    Args:
        axis: The true axis.
        process: How it strays.
        offset_sd: Of its offset at the start [m].
        issued: When each command is given, on the ticks of T, int64 ns, (n,).
        command: Relative to the start level [m], (n,).
        period: T [s].
        rng: Draws everything random of this axis.

    Returns:
        The motion, exact on the lattice, until one period after the last command.
    """
    noises = rng.spawn(4)  # so that one kind of noise changes no other
    acting = issued + np.rint(_delays(axis, len(issued), noises[0]) * 1e9).astype(np.int64)
    acting = np.maximum.accumulate(acting)  # commands do not overtake one another
    poles, residues = _modes(axis)
    time = _events(acting, lattice(len(issued), period), float(np.abs(poles).max()))
    interval = np.diff(time) / 1e9
    entry = np.searchsorted(acting, time[:-1], side="right") - 1  # −1: the arm still rests
    resting = entry < 0
    v = np.where(resting, 0.0, _plant_input(axis, command, period)[entry])
    maneuver = np.abs(np.diff(command, n=2, prepend=[0.0, 0.0])) / period
    m = np.where(resting, 0.0, maneuver[entry])
    q = process.input_noise**2 + (process.maneuver_noise * m) ** 2
    drift = process.drift**2 + (process.maneuver_drift * m) ** 2

    smooth = np.zeros(len(time))
    smooth[1:] = _response(poles, residues, interval, v, np.sqrt(q), noises[1])
    position = _play(smooth, axis.backlash)
    offset = np.cumsum(np.sqrt(drift * interval) * noises[2].standard_normal(len(interval)))
    position[1:] += offset
    position += offset_sd * noises[3].standard_normal()
    if axis.slow_drift:
        position += axis.slow_drift * np.sin(2.0 * np.pi * (time - time[0]) / 1e9 / axis.slow_drift_period)
    return Motion(time, position)


def _delays(axis: TrueAxis, count: int, rng: np.random.Generator) -> FloatArray:
    """Td of each command [s], never negative."""
    return np.maximum(axis.delay + axis.delay_jitter * rng.standard_normal(count), 0.0)


def _plant_input(axis: TrueAxis, command: FloatArray, period: float) -> FloatArray:
    """Command, gain error that recovers from tick to tick, and what sticking lets through [m]."""
    step = np.diff(command, prepend=0.0)
    kick = (axis.gain_at(np.abs(step) / period) - 1.0) * step
    kept = 1.0 if axis.gain_recovery is None else float(np.exp(-period / axis.gain_recovery))
    v = command + _sum_of_decays(np.full(len(kick), kept, dtype=np.complex128), kick.astype(np.complex128)).real
    return _stick(v, axis.stiction) if axis.stiction else v


def _stick(v: FloatArray, stiction: float) -> FloatArray:
    """The drive stays where it is until its input is ``stiction`` [m] away, then goes all the way."""
    found, held = np.empty_like(v), 0.0
    for number, wanted in enumerate(v.tolist()):
        if abs(wanted - held) > stiction:
            held = wanted
        found[number] = held
    return found


def _modes(axis: TrueAxis) -> tuple[ComplexArray, ComplexArray]:
    """Poles p_i [rad/s] and residues r_i of the plant, and of the extra pole in series with it."""
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
    found = poles.copy()
    for pole in poles:
        together = np.abs(poles - pole) < max(_APART.values()) * np.abs(pole)
        count = int(together.sum())
        nearest = np.abs(poles[together][:, None] - poles[together][None, :])[np.triu_indices(count, 1)]
        if count > 1 and nearest.min() < _APART[count] * np.abs(pole):
            spread = (np.arange(count) - 0.5 * (count - 1)) * (2.0 * _APART[count])
            found[together] = poles[together].mean().real * (1.0 + spread)
    return found


def _events(acting: TimeArray, lattice: TimeArray, fastest: float) -> TimeArray:
    """Where something changes or may be looked at, and as many instants between as the noise integral needs."""
    longest = max(int(_TURN * 1e9 / fastest), 1)
    acting = acting[acting <= lattice[-1]]
    if lattice[-1] / longest > _MOST_EVENTS:
        shortest = lattice[-1] / 1e6 / _MOST_EVENTS / _TURN
        raise ConfigError(
            f"a lag or time constant of {1e3 / fastest:.3g} ms is too short to follow over {lattice[-1] / 1e9:.0f} s:"
            f" at least {shortest:.2g} ms"
        )
    finer = np.arange(0, lattice[-1] if longest < lattice[1] else 0, longest, dtype=np.int64)
    return np.unique(np.concatenate((acting, lattice, finer)))


def _response(
    poles: ComplexArray,
    residues: ComplexArray,
    interval: FloatArray,
    v: FloatArray,
    density: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """The plant's position after each interval [m], from rest, (intervals,)."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    white = rng.standard_normal((len(interval), _NODES)) * np.sqrt(0.5 * weight)
    white *= (np.sqrt(interval) * density)[:, None]
    distinct, place = np.unique(interval, return_inverse=True)
    position = np.zeros(len(interval))
    for pole, residue in zip(poles, residues, strict=True):
        if pole.imag < 0.0:
            continue  # its conjugate stands for both
        share = residue if pole.imag == 0.0 else 2.0 * residue
        aged = np.exp(pole * 0.5 * (node + 1.0) * distinct[:, None])[place]
        forced = (np.expm1(pole * distinct) / pole)[place] * v
        kick = np.einsum("ij,ij->i", aged, white) + forced
        position += (share * _sum_of_decays(np.exp(pole * distinct)[place], kick)).real
    return position


def _sum_of_decays(decay: ComplexArray, kick: ComplexArray) -> ComplexArray:
    """z_n = decay_n · z_(n−1) + kick_n from z = 0, by doubling strides."""
    factor, total, stride = decay.copy(), kick.copy(), 1
    while stride < len(total) and np.abs(factor[stride:]).max() > 1e-30:
        total[stride:] += factor[stride:] * total[:-stride].copy()
        factor[stride:] *= factor[:-stride].copy()
        factor[:stride] = 0.0
        stride *= 2
    return total


def _play(position: FloatArray, width: float) -> FloatArray:
    """What is left behind a gear with ``width`` [m] of backlash: y_n = clip(y_(n−1), x_n − width/2, x_n + width/2).

    Clips chain into clips, so doubling strides do all of them.
    """
    if not width:
        return position
    low, high = position - 0.5 * width, position + 0.5 * width
    low[0] = high[0] = position[0]
    stride = 1
    while stride < len(low):
        low[stride:], high[stride:] = (
            np.clip(low[:-stride], low[stride:], high[stride:]),
            np.clip(high[:-stride], low[stride:], high[stride:]),
        )
        stride *= 2
    return low
