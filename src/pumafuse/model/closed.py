"""Transitions of first- and second-order plants in closed form, for any interval, compiled.

Over an interval t the response g of the free plant (g″ = −2σ g′ − ω² g, g(0) = 0, g′(0) = 1) gives

    Φ = [ g′ + 2σ g, g; −ω² g, g′ ],   Q11 = ω⁴ ∫ g², Q12 = ½ ω⁴ g², Q22 = ω² Q11 + 2σ Q12 + ω⁴ g g′

for unit noise on the input. While the fastest pole turns by less than half a radian, g and ∫ g² come from their Taylor
series: closed forms would lose all digits of Q11 ~ t³. Beyond it from exponentials, in the form that does not cancel.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled
from .plants import PLANTS, FirstOrder

_TERMS = 16  # of each series: the next would be below 1e-16 of the sum
_TINY, _FEW = 0.1, 10  # rad, terms: enough for most intervals between measurements
_SHORT = 0.5  # rad; fastest pole × interval up to which the series are used
_HEAD = 6  # constants before the series
_CLOSE = 0.05  # of what it would be with the signs alike: distance to the plant's poles, below which sums cancel
_APART = 0.5  # difference of the poles over their sum, below which exponentials of the two cancel

SIZE = _HEAD + 3 * _TERMS


@lru_cache(maxsize=1024)
def constants(plant: PLANTS) -> FloatArray:
    """What the kernels need to know of a plant, (c,): of first order its rate; of second order ω, σ, β², r, series.

    Kept for plants that come again: not to be changed.
    """
    found = np.zeros(SIZE)
    if isinstance(plant, FirstOrder):
        found[0] = 1.0 / plant.time_constant
        return found
    omega = plant.natural_frequency
    sigma = plant.damping * omega
    square = (plant.damping - 1.0) * (plant.damping + 1.0) * omega**2
    fastest = sigma + math.sqrt(square) if square > 0.0 else omega
    found[:4] = omega, sigma, square, fastest
    s, w = sigma / fastest, (omega / fastest) ** 2  # in the time u = r t, where no coefficient overflows
    g = np.zeros(_TERMS + 2)
    g[1] = 1.0
    for k in range(_TERMS):
        g[k + 2] = -(2.0 * s * (k + 1) * g[k + 1] + w * g[k]) / ((k + 1) * (k + 2))
    # y = g² obeys y‴ = −6σ y″ − (8σ² + 4ω²) y′ − 8σω² y
    y = np.zeros(_TERMS + 3)
    y[2] = 1.0
    for k in range(_TERMS):
        y[k + 3] = -(
            6.0 * s * (k + 1) * (k + 2) * y[k + 2] + (8.0 * s * s + 4.0 * w) * (k + 1) * y[k + 1] + 8.0 * s * w * y[k]
        ) / ((k + 1) * (k + 2) * (k + 3))
    order = np.arange(_TERMS)
    found[_HEAD : _HEAD + _TERMS] = g[1 : _TERMS + 1]  # g / u
    found[_HEAD + _TERMS : _HEAD + 2 * _TERMS] = g[1 : _TERMS + 1] * (order + 1)  # g′
    found[_HEAD + 2 * _TERMS :] = y[2 : _TERMS + 2] / (order + 3)  # ∫ g² / u³
    return found


@compiled
def transition(
    order: int, constants: FloatArray, axis: int, dt: float
) -> tuple[float, float, float, float, float, float, float]:
    """Φ11, Φ12, Φ21, Φ22, Q11, Q12, Q22 of a plant over ``dt`` [s]; its constants are in row ``axis``.

    A first-order plant has a rate, too, that is always 0: the filter's algebra is the same for both orders.
    """
    if order == 1:
        rate = constants[axis, 0]
        lost = math.expm1(-rate * dt)
        return 1.0 + lost, 0.0, 0.0, 0.0, -0.5 * rate * lost * (2.0 + lost), 0.0, 0.0
    omega, sigma, square, fastest = constants[axis, 0], constants[axis, 1], constants[axis, 2], constants[axis, 3]
    u = fastest * dt
    if u <= _SHORT:
        g, rate, power = _series(constants, axis, u)
        g, power = g / fastest, power / (fastest * fastest * fastest)
    else:
        g, rate, power = _exponentials(omega, sigma, square, dt)
    w2 = omega * omega
    h, h_rate = w2 * g, w2 * rate
    q11, q12 = w2 * w2 * power, 0.5 * h * h
    return rate + 2.0 * sigma * g, g, -h, rate, q11, q12, w2 * q11 + 2.0 * sigma * q12 + h * h_rate


@compiled
def gain_error(step: float, slope: float, intercept: float, period: float) -> float:
    """What the gain adds to a step of the command [m]: (K(speed) − 1) · step, K = slope · |step| / T + intercept."""
    return ((slope * (abs(step) / period) + intercept) - 1.0) * step


@compiled
def decaying_response(
    order: int, constants: FloatArray, axis: int, decay: float, dt: float, f11: float, f12: float, f22: float
) -> tuple[float, float, float]:
    """Position and rate that an input e^(−decay·t) of 1 m makes in ``dt`` [s], and what is left of the input then.

    Γ_e = ∫ e^(A s) B e^(−decay (dt − s)) ds: the divided differences of exp at the plant's poles and at −decay [1/s].
    ``f11``, ``f12`` and ``f22`` are of Φ over ``dt``.
    """
    left = math.exp(-decay * dt)
    if order == 1:
        rate = constants[axis, 0]
        if abs(rate - decay) > _CLOSE * (rate + decay):
            return rate * (left - f11) / (rate - decay), 0.0, left
        return rate * _divided_difference(rate, decay, dt), 0.0, left
    omega, sigma, square, fastest = constants[axis, 0], constants[axis, 1], constants[axis, 2], constants[axis, 3]
    w2 = omega * omega
    product = decay * decay - 2.0 * sigma * decay + w2  # of the distances between the input's pole and the plant's
    if abs(product) > _CLOSE * (decay * decay + 2.0 * sigma * decay + w2):
        h, g = (left - f22 - (2.0 * sigma - decay) * f12) / product, f12
    elif square > (_APART * sigma) ** 2 and fastest * dt > _SHORT:
        slow = w2 / fastest
        h, g = (_divided_difference(slow, decay, dt) - _divided_difference(fastest, decay, dt)) / (fastest - slow), f12
    else:
        h, g = _close_poles(omega, sigma, max(fastest, decay), decay, dt)
    return w2 * h, w2 * (g - decay * h), left


@compiled
def _divided_difference(a: float, b: float, t: float) -> float:
    """∫ e^(−a s) e^(−b (t − s)) ds = (e^(−b t) − e^(−a t)) / (a − b), in the form that does not cancel."""
    apart = abs(a - b)
    return math.exp(-min(a, b) * t) * (t if apart == 0.0 else -math.expm1(-apart * t) / apart)


@compiled
def _close_poles(omega: float, sigma: float, fastest: float, decay: float, t: float) -> tuple[float, float]:
    """H = ∫ g(s) e^(−decay (t − s)) ds and g where divided differences cancel: series of a short interval, doubled."""
    doublings = max(math.ceil(math.log2(fastest * t / _SHORT)), 0) if t > 0.0 else 0
    u, s, w, b = fastest * t / 2.0**doublings, sigma / fastest, (omega / fastest) ** 2, decay / fastest
    g_k, g_next, h_k, power = 0.0, 1.0, 0.0, 1.0  # coefficients of u^k in g and h
    g, rate, h = 0.0, 0.0, 0.0
    for k in range(_TERMS + 2):
        g, h = g + g_k * power, h + h_k * power
        rate += (k + 1) * g_next * power
        h_k = (g_k - b * h_k) / (k + 1)
        g_k, g_next = g_next, -(2.0 * s * (k + 1) * g_next + w * g_k) / ((k + 1) * (k + 2))
        power *= u
    left = math.exp(-b * u)
    for _ in range(doublings):
        f11, f21 = rate + 2.0 * s * g, -w * g
        h_rate = g - b * h
        h = f11 * h + g * h_rate + left * h
        g, rate = (f11 + rate) * g, f21 * g + rate * rate
        left *= left
    return h / (fastest * fastest), g / fastest


@compiled
def _series(constants: FloatArray, axis: int, u: float) -> tuple[float, float, float]:
    """g, g′ and ∫ g² in the time u; even and odd powers apart, so that sums wait for half as many others."""
    g, rate, power, g_odd, rate_odd, power_odd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    v = u * u
    for k in range((_FEW if u <= _TINY else _TERMS) - 2, -1, -2):
        g = g * v + constants[axis, _HEAD + k]
        rate = rate * v + constants[axis, _HEAD + _TERMS + k]
        power = power * v + constants[axis, _HEAD + 2 * _TERMS + k]
        g_odd = g_odd * v + constants[axis, _HEAD + k + 1]
        rate_odd = rate_odd * v + constants[axis, _HEAD + _TERMS + k + 1]
        power_odd = power_odd * v + constants[axis, _HEAD + 2 * _TERMS + k + 1]
    return (g + u * g_odd) * u, rate + u * rate_odd, (power + u * power_odd) * u * v


@compiled
def _exponentials(omega: float, sigma: float, square: float, t: float) -> tuple[float, float, float]:
    """g, g′ and ∫ g² over an interval that is long against the fastest pole."""
    beta = math.sqrt(abs(square))
    if square < 0.0:
        decay = math.exp(-sigma * t)
        sine, cosine = math.sin(beta * t), math.cos(beta * t)
        g = decay * sine / beta
        rate = decay * cosine - sigma * g
        if beta > _APART * sigma:
            twice = decay * decay
            straight = -math.expm1(-2.0 * sigma * t) / (2.0 * sigma)
            turning = (
                2.0 * sigma * (1.0 - twice * (cosine - sine) * (cosine + sine)) + 4.0 * beta * twice * sine * cosine
            ) / (4.0 * omega * omega)
            return g, rate, (straight - turning) / (2.0 * beta * beta)
        return g, rate, _energy(omega, sigma, g, rate)
    slow, fast = omega * omega / (sigma + beta), sigma + beta
    lasting = math.exp(-slow * t)
    if beta > _APART * sigma:
        brief = math.exp(-fast * t)
        g = (lasting - brief) / (2.0 * beta)
        rate = (fast * brief - slow * lasting) / (2.0 * beta)
        power = (
            -math.expm1(-2.0 * slow * t) / (2.0 * slow)
            + math.expm1(-2.0 * sigma * t) / sigma
            - math.expm1(-2.0 * fast * t) / (2.0 * fast)
        ) / (4.0 * beta * beta)
        return g, rate, power
    g = lasting * t if beta == 0.0 else -lasting * math.expm1(-2.0 * beta * t) / (2.0 * beta)
    rate = 0.5 * lasting * (1.0 + math.exp(-2.0 * beta * t)) - sigma * g
    return g, rate, _energy(omega, sigma, g, rate)


@compiled
def _energy(omega: float, sigma: float, g: float, rate: float) -> float:
    """∫ g² of poles that lie together, from the balance of energy: 4σ ∫ g′² = 1 − g′² − ω² g², ω² ∫ g² = ∫ g′² − …."""
    w2 = omega * omega
    moving = (1.0 - rate * rate - w2 * g * g) / (4.0 * sigma)  # ∫ g′²
    return (moving - sigma * g * g - g * rate) / w2
