"""The path of an axis between the rows of a sensor: what any linear arm makes of the commands, and what it leaves."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray

Basis = Callable[[FloatArray], FloatArray]

# s: knots of an impulse response, fine where most are steep; 14 ms are no multiple of a usual period of commands, whose
# steps would else always fall on knots.
_KNOTS: FloatArray = np.concatenate([np.arange(0.0, 0.4, 0.014), np.arange(0.4, 0.7, 0.05), np.arange(0.7, 1.31, 0.1)])
_PLACED, _EVEN = 2, 0.3  # how often knots are placed where the response is; the share of them that stays spread evenly
_BEFORE, _SHORT, _LONG = 0.1, 0.1, 0.3  # s: of a lag so much is before it, between these bounds, and a margin
_HELD = 10.0  # s, before the first and after the last command, where these are in force
_RIDGES = 10.0 ** np.arange(-5.5, 0.1, 0.5)  # of the largest singular value; products of columns know no less
_ROWS_A_KNOT = (2, 3, 5, 8, 16, 32, 64, 128)
_FEWEST_KNOTS = 6
_CLIP = 10.0
ASIDE = 1e-3  # s, beside an instant, for speeds


def _placed(knots: FloatArray, coefficients: FloatArray) -> FloatArray:
    """As many knots, most of them where an impulse response is [s]."""
    impulse = np.abs(np.concatenate([[0.0], np.cumsum(coefficients[::-1])[::-1], [0.0]]))
    area = 0.5 * (impulse[1:] + impulse[:-1]) * np.diff(knots)
    share = np.concatenate([[0.0], np.cumsum(area / max(float(area.sum()), 1e-300))])
    even = np.linspace(0.0, 1.0, len(knots))
    return np.interp(even, (1.0 - _EVEN) * share + _EVEN * (knots - knots[0]) / (knots[-1] - knots[0]), knots)


def _responses(t: FloatArray, u: FloatArray, knots: FloatArray) -> Basis:
    """Responses to held commands that make up that of any linear arm: those to integrated hats."""
    from scipy.interpolate import PPoly

    held = np.concatenate([u[:1], u]) - u.mean()
    bounds = np.concatenate([t[:1] - _HELD, t, t[-1:] + _HELD])
    twice = PPoly(held[None], bounds).antiderivative(2)

    def basis(at: FloatArray) -> FloatArray:
        slopes = -np.diff(twice(np.clip(at[:, None] - knots, bounds[0], bounds[-1])), axis=1) / np.diff(knots)
        # Penalised sums of neighbours leave an impulse response smooth; that of single hats may be anything between
        # the instants of a slow sensor.
        return np.cumsum(-np.diff(slopes, axis=1), axis=1)

    return basis


@dataclass(frozen=True)
class Shrunk:
    """Coefficients of least squares with a ridge, (k,), that ridge, and the degrees of freedom that it leaves them."""

    coefficients: FloatArray
    penalty: float
    freedom: float


def shrunk(square: FloatArray, score: FloatArray, total: float, rows: int, penalty: float | None = None) -> Shrunk:
    """Least squares with a ridge; None: that with the least generalised cross-validation error.

    By products of columns without means, (k, k), of these with what they are to explain, (k,), and its square.
    """
    power, V = np.linalg.eigh(square)
    power = np.maximum(power, 0.0)
    b = V.T @ score
    ridges = _RIDGES * math.sqrt(max(float(power[-1]), 1e-300)) if penalty is None else np.array([penalty])
    share = 1.0 / (power + ridges[:, None] ** 2)
    freedom = (power * share).sum(axis=1)
    left = total - (b**2 * (2.0 * share - power * share**2)).sum(axis=1)
    best = int(np.argmin(left / np.maximum(rows - 2.0 - freedom, 1.0) ** 2))
    return Shrunk(V @ (share[best] * b), float(ridges[best]), float(freedom[best]))


@dataclass(frozen=True)
class Residue:
    """What the commands leave of a path: a spline whose knots are as far apart as cross-validation says, or nothing."""

    spline: Callable[[FloatArray], FloatArray] | None = None  # None: 0
    begin: float = 0.0  # where it begins [s]
    end: float = 0.0  # where it ends [s]
    freedom: float = 0.0  # its degrees of freedom

    def __call__(self, at: FloatArray) -> FloatArray:
        """Its value at instants [s], (n,)."""
        return np.zeros(len(at)) if self.spline is None else self.spline(np.clip(at, self.begin, self.end))

    def slope(self, at: FloatArray) -> FloatArray:
        """How fast it changes at instants [s], (n,)."""
        return (self(at + ASIDE) - self(at - ASIDE)) / (2.0 * ASIDE)


def residue(s: FloatArray, residual: FloatArray, freedom: float) -> Residue:
    """The residue of what the commands leave at ascending instants [s], after a fit with some degrees of freedom."""
    from scipy.interpolate import make_lsq_spline

    def error(left: FloatArray, used: float) -> float:
        return float(left @ left) / max(len(s) - used, 0.0) ** 2 if len(s) > used + 1.0 else math.inf

    best, least = Residue(), error(residual, freedom)
    for rows in _ROWS_A_KNOT:
        if len(s) < _FEWEST_KNOTS * rows:
            break
        knots = np.concatenate([np.repeat(s[0], 4), s[rows:-rows:rows], np.repeat(s[-1], 4)])
        spline, more = make_lsq_spline(s, residual, knots, method="norm-eq"), len(knots) - 4.0
        if (residue_here := error(residual - spline(s), freedom + more)) < least:
            best, least = Residue(spline, float(s[0]), float(s[-1]), more), residue_here
    return best


def interpolated(s: FloatArray, left: FloatArray) -> Residue:
    """The residue that goes through all rows: what a sensor of little noise sees of a motion that nobody commanded."""
    return Residue(lambda at: np.interp(at, s, left), float(s[0]), float(s[-1]))


@dataclass(frozen=True)
class Path:
    """The path of an axis by one sensor."""

    basis: Basis  # of the responses to the commands
    coefficients: FloatArray  # of these
    level: float  # its constant [m or rad]
    residue: Residue  # what the commands leave
    sd: float  # noise of the sensor [m or rad]

    def __call__(self, at: FloatArray) -> FloatArray:
        """Positions at instants [s], (n,) [m or rad]."""
        return self.basis(at) @ self.coefficients + self.level + self.residue(at)


def path(command: tuple[FloatArray, FloatArray], lag: float, s: FloatArray, z: FloatArray) -> Path:
    """The path by the rows of a sensor, which follows roughly ``lag`` [s] late; instants [s] ascend."""
    knots = _KNOTS + lag - _BEFORE - min(max(lag, _SHORT), _LONG)
    basis, weights, residual = _explained(command, knots, s, z)
    for _ in range(_PLACED):
        basis, weights, residual = _explained(command, knots := _placed(knots, weights.coefficients), s, z)
    level = float(residual.mean())
    left = residue(s, residual - level, weights.freedom)
    free = max(len(s) - 1.0 - weights.freedom - left.freedom, 1.0)
    sd = quantile_sd(residual - level - left(s)) * math.sqrt(len(s) / free)
    return Path(basis, weights.coefficients, level, left, sd)


def _explained(
    command: tuple[FloatArray, FloatArray], knots: FloatArray, s: FloatArray, z: FloatArray
) -> tuple[Basis, Shrunk, FloatArray]:
    """Responses, their coefficients, and what they leave of a sensor, (n,)."""
    basis = _responses(*command, knots)
    X = basis(s)
    centred, told = X - X.mean(axis=0), z - z.mean()
    ridge = shrunk(centred.T @ centred, centred.T @ told, float(told @ told), len(told))
    return basis, ridge, z - X @ ridge.coefficients


def clipped_rms(left: FloatArray) -> float:
    """Root of the mean square, of each not more than ten robust deviations: what many rows have is no outlier."""
    kept = np.clip(left, *(_CLIP * quantile_sd(left) * np.array([-1.0, 1.0])))
    return math.sqrt(float(kept @ kept) / len(kept))


def quantile_sd(left: FloatArray) -> float:
    """Standard deviation by the 90 % quantile: a tenth may be outliers, and most may be at rest."""
    return float(np.quantile(np.abs(left), 0.9)) / 1.645
