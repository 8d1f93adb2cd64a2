"""Plants: how an axis responds to its input, behind gain and delay. All have unit gain.

Equations 3 to 9 of "A Practical Dynamic Model of a Puma 560 Manipulator for Aircraft Maintenance", without the gain K.
A new plant is a class here with a tag and the methods of :class:`Plant`, added to ``PLANTS``.
"""

from __future__ import annotations

from typing import Annotated, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray
from ..toml import MOST, Interval, Positive

Delay = Annotated[float, msgspec.Meta(ge=0, le=1e4)]  # s
Frequency = Annotated[float, msgspec.Meta(ge=1e-6, le=MOST)]  # rad/s; of a lower one the lag would overflow
_TOGETHER = 0.3  # (T₁ − T₂)/(T₁ + T₂) of two poles below which their exponentials cancel


class Plant(msgspec.Struct, frozen=True, kw_only=True, tag_field="plant", forbid_unknown_fields=True):
    """Base of the plants: ẋ = A x + B v, p = C x, with v and p in metres."""

    def state_space(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A (n, n) [1/s], B (n, 1) and C (1, n); x in equilibrium under v = 0 is 0."""
        raise NotImplementedError

    def step_response(self, time: npt.ArrayLike) -> FloatArray:
        """Position p [m] at ``time`` [s] after v stepped from 0 to 1 m; 0 before the step; the shape of ``time``."""
        raise NotImplementedError

    @property
    def lag(self) -> float:
        """The plant's lag behind an input of constant velocity [s]."""
        raise NotImplementedError


class FirstOrder(Plant, frozen=True, kw_only=True, tag="first-order", forbid_unknown_fields=True):
    """H(s) = 1 / (τs + 1), equation 3.

    Attributes:
        time_constant: τ [s].
        time_constant_ci95: Its 95 % interval [s], if it was identified.
    """

    time_constant: Positive = msgspec.field(name="time_constant_ms")
    time_constant_ci95: Interval | None = msgspec.field(name="time_constant_ms_ci95", default=None)

    def state_space(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """One state, the position [m]."""
        rate = 1.0 / self.time_constant
        return np.array([[-rate]]), np.array([[rate]]), np.array([[1.0]])

    @property
    def lag(self) -> float:
        """τ."""
        return self.time_constant

    def step_response(self, time: npt.ArrayLike) -> FloatArray:
        """Equation 4: 1 − e^(−t/τ)."""
        t = np.maximum(np.asarray(time, dtype=np.float64), 0.0)
        return -np.expm1(-t / self.time_constant)


class SecondOrder(Plant, frozen=True, kw_only=True, tag="second-order", forbid_unknown_fields=True):
    """H(s) = ω² / (s² + 2ζωs + ω²), equation 5.

    Attributes:
        natural_frequency: ω [rad/s].
        damping: ζ; below 1 under-damped, above 1 over-damped.
        natural_frequency_ci95: 95 % interval of ω [rad/s], if it was identified.
        damping_ci95: 95 % interval of ζ.
    """

    natural_frequency: Frequency = msgspec.field(name="natural_frequency_rad_s")
    damping: Positive
    natural_frequency_ci95: Interval | None = msgspec.field(name="natural_frequency_rad_s_ci95", default=None)
    damping_ci95: Interval | None = None

    def state_space(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Two states, the position [m] and its rate [m/s]."""
        square = self.natural_frequency**2
        A = np.array([[0.0, 1.0], [-square, -2.0 * self.damping * self.natural_frequency]])
        return A, np.array([[0.0], [square]]), np.array([[1.0, 0.0]])

    @property
    def lag(self) -> float:
        """2ζ/ω."""
        return 2.0 * self.damping / self.natural_frequency

    def step_response(self, time: npt.ArrayLike) -> FloatArray:
        """Equations 6 and 9, and ζ = 1 between them; see :func:`unit_response`."""
        return unit_response(np.asarray(time, dtype=np.float64), self.lag, self.natural_frequency**-2)


PLANTS: TypeAlias = FirstOrder | SecondOrder


def unit_response(time: FloatArray | float, q: FloatArray | float, p: FloatArray | float) -> FloatArray:
    """Unit step response c(t) of 1/(p s² + q s + 1), 0 before t = 0; all three broadcast, p ≥ 0 and q > 0.

    Equations 4, 6 and 9, joined at ζ = 1, where 6 and 9 divide by √|ζ² − 1| and lose all digits.
    """
    half, p = 0.5 * np.asarray(q), np.asarray(p)
    square = half * half - p
    root = np.sqrt(np.abs(square))
    over_damped, apart = square >= 0.0, root > _TOGETHER * half
    forms = (over_damped & apart, _apart), (over_damped & ~apart, _together), (~over_damped, _swinging)
    needed = [(plants, form) for plants, form in forms if plants.any()]
    time, half, root, p, *masks = np.broadcast_arrays(time, half, root, p, *(plants for plants, _ in needed))
    unit_response, begun = np.zeros(time.shape), time > 0.0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # where T₂ or the swing is next to nothing
        for plants, (_, form) in zip(masks, needed, strict=True):
            chosen = plants & begun
            unit_response[chosen] = form(time[chosen], half[chosen], root[chosen], p[chosen])
    return unit_response


def _apart(t: FloatArray, half: FloatArray, root: FloatArray, p: FloatArray) -> FloatArray:
    """Over-damped: time constants T₁ > T₂ are q/2 ± √(q²/4 − p); T₂ may be 0."""
    slow = half + root
    fast = p / slow
    sooner = np.where(fast > 0.0, fast * np.exp(-t / fast), 0.0)
    return 1.0 - (slow * np.exp(-t / slow) - sooner) / (2.0 * root)


def _together(t: FloatArray, half: FloatArray, root: FloatArray, p: FloatArray) -> FloatArray:
    """About ζ = 1: e^(−decay) cosh(turn) would overflow, so that the slow pole is taken out of both terms."""
    turn = root * t / p
    sinhc = np.where(turn > 0.0, -np.expm1(-2.0 * turn) / (2.0 * turn), 1.0)
    return 1.0 - np.exp(-t / (half + root)) * (0.5 * (1.0 + np.exp(-2.0 * turn)) + half * t / p * sinhc)


def _swinging(t: FloatArray, half: FloatArray, root: FloatArray, p: FloatArray) -> FloatArray:
    """Under-damped: e^(−decay) and a swing."""
    decay, turn = half * t / p, root * t / p
    return 1.0 - np.exp(-decay) * (np.cos(turn) + decay * np.sinc(turn / np.pi))
