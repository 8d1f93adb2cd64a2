"""Transitions in closed form against integrals of exponentials worked out with 160 digits."""

import math
from dataclasses import dataclass
from itertools import product

import mpmath
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mpmath import mpf

from pumafuse.filter import core
from pumafuse.filter.response import record_of
from pumafuse.model.arm import AxisModel
from pumafuse.model.plants import PLANTS, FirstOrder, SecondOrder

DIGITS = 160  # close poles over a nanosecond cancel a hundred of them
TINY = mpf(1e-290)  # below it numbers are subnormal somewhere on the way


@dataclass(frozen=True)
class Step:
    """A transition with position, and rate over ω, as its states: all entries of Φ then are of order 1.

    Attributes:
        Phi: (2, 2).
        Q: For unit noise on the input, (2, 2).
    """

    Phi: mpmath.matrix
    Q: mpmath.matrix


def wanted(omega: float, zeta: float, t: float) -> Step:
    """From the two poles, or the double one: g is a sum of exponentials, and so is what there is to integrate."""
    with mpmath.workdps(DIGITS):
        w, z, t = mpf(omega), mpf(zeta), mpf(t)
        s = z * w
        if z == 1:
            e, ee = mpmath.exp(-w * t), mpmath.exp(-2 * w * t)
            g, rate = t * e, (1 - w * t) * e
            zeroth, first = (1 - ee) / (2 * w), (1 - ee * (1 + 2 * w * t)) / (4 * w**2)
            second = (1 - ee * (1 + 2 * w * t + 2 * (w * t) ** 2)) / (4 * w**3)  # ∫ t^n e^(−2ωt)
            gg, rr = second, zeroth - 2 * w * first + w**2 * second
        else:
            b = w * mpmath.sqrt(mpmath.mpc((z - 1) * (z + 1)))
            p, m = -s + b, -s - b
            one, two, both = (mpmath.expm1(r * t) / r for r in (2 * p, 2 * m, p + m))
            g = ((mpmath.exp(p * t) - mpmath.exp(m * t)) / (p - m)).real
            rate = ((p * mpmath.exp(p * t) - m * mpmath.exp(m * t)) / (p - m)).real
            gg = ((one + two - 2 * both) / (p - m) ** 2).real
            rr = ((p**2 * one + m**2 * two - 2 * p * m * both) / (p - m) ** 2).real
        Phi = mpmath.matrix([[rate + 2 * s * g, w * g], [-w * g, rate]])
        Q = mpmath.matrix([[w**4 * gg, w**3 * g**2 / 2], [w**3 * g**2 / 2, w**2 * rr]])
        return Step(Phi, Q)


def step_of(plant: PLANTS, t: float, decay: float = 0.0) -> list[float]:
    """Φ and Q over an interval; position, rate and rest of an input of 1 m that decays."""
    recovery = 1.0 / decay if decay else None
    axis = record_of(AxisModel(plant=plant, gain_recovery=recovery), 0.028, 0.0, 0.0)
    values = core.transition(axis, t)[:10].tolist()
    assert all(map(math.isfinite, values))
    return values


def found(omega: float, zeta: float, t: float) -> Step:
    """What the core says, brought to the same states."""
    values = step_of(SecondOrder(natural_frequency=omega, damping=zeta), t)
    f11, f12, f21, f22, q11, q12, q22 = map(mpf, values[:7])
    with mpmath.workdps(DIGITS):
        w = mpf(omega)
        Q = mpmath.matrix([[q11, q12 / w], [q12 / w, q22 / w**2]])
        return Step(mpmath.matrix([[f11, f12 * w], [f21 / w, f22]]), Q)


def check(got: Step, right: Step, phi: float, q: float) -> None:
    """Entries of Φ to ``phi``, of Q to ``q`` of √(Qii Qjj)."""
    with mpmath.workdps(DIGITS):
        for i, j in product(range(2), repeat=2):
            assert abs(got.Phi[i, j] - right.Phi[i, j]) <= phi, f"Φ{i + 1}{j + 1}"
        if right.Q[0, 0] > TINY and right.Q[1, 1] > TINY:
            for i, j in product(range(2), repeat=2):
                off, scale = abs(got.Q[i, j] - right.Q[i, j]), mpmath.sqrt(right.Q[i, i] * right.Q[j, j])
                assert off <= q * scale, f"Q{i + 1}{j + 1}: {mpmath.nstr(off / scale, 3)}"


def blurred(omega: float, zeta: float, t: float) -> float:
    """By how much a relative change of ω alone turns Φ: the oscillation's phase, as far as it has not died away."""
    return 1.0 + omega * t * math.exp(-min(zeta * omega * t, 700.0)) * (zeta < 1.0)


# ---- second order ---------------------------------------------------------------------------------------------------

CRITICAL = [1.0, 1.0 + 2**-52, 1.0 - 2**-53, 1.0 + 1e-12, 1.0 - 1e-12, 1.0 + 1e-9, 1.0 - 1e-9, 1.0 + 1e-4, 1.0 - 1e-4]
DAMPINGS = [*CRITICAL, 1e-6, 1e-3, 0.1, 0.6, 0.864, 0.95, 0.99, 1.01, 1.05, 1.2, 2.0, 10.0, 1e3, 1e4]


def powers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


dampings = st.one_of(
    st.sampled_from(DAMPINGS),
    powers(-6.0, 4.0),
    st.builds(lambda sign, by: 1.0 + sign * by, st.sampled_from([-1.0, 1.0]), powers(-15.0, -0.3)),
)


def fastest(omega: float, zeta: float) -> float:
    return omega * (zeta + math.sqrt(zeta * zeta - 1.0)) if zeta > 1.0 else omega


@st.composite
def transitions(draw: st.DrawFn) -> tuple[float, float, float]:
    """ω, ζ and an interval: anything, or near what the fastest pole, the slower one, or their difference turns in."""
    omega, zeta = draw(powers(-3.0, 6.0)), draw(dampings)
    apart = omega * math.sqrt(abs((zeta - 1.0) * (zeta + 1.0))) or omega
    near = draw(st.sampled_from([None, fastest(omega, zeta), omega, omega**2 / fastest(omega, zeta), apart]))
    t = draw(powers(-9.0, 5.0)) if near is None else draw(powers(-1.5, 1.5)) / near
    return omega, zeta, min(max(t, 1e-9), 1e5)


@pytest.mark.long
@settings(max_examples=1500)
@given(transitions())
@example((9997.97309637579, 0.999999999998836, 147.78737883089568))
@example((29562.580357190545, 1.0 - 2**-53, 1e5))
@example((0.07393011252651258, 1e4, 0.00033815720290611775))
def test_any_transition_is_that_of_the_plant(made: tuple[float, float, float]) -> None:
    """Φ to 2e-15 (times the phase, for an oscillation that lasts) and Q to 1e-13, with digits left where Q ~ t³."""
    check(found(*made), wanted(*made), 2e-15 * blurred(*made), 1e-13)


@pytest.mark.parametrize("zeta", DAMPINGS[::2])
@pytest.mark.parametrize("omega", [1e-3, 53.9])
def test_a_transition_over_any_interval(omega: float, zeta: float) -> None:
    """From 1 ns to 1e5 s, densely where the plant answers: the same digits everywhere."""
    for t in {*(10.0 ** np.arange(-9.0, 6.0)), *(10.0 ** np.arange(-2.0, 2.01, 0.25) / fastest(omega, zeta))}:
        if 1e-9 <= t <= 1e5:
            made = omega, zeta, float(t)
            check(found(*made), wanted(*made), 2e-15 * blurred(*made), 1e-13)


@settings(max_examples=200)
@given(transitions())
def test_process_noise_is_a_covariance(made: tuple[float, float, float]) -> None:
    """Q11 and Q22 are never negative, and no correlation is beyond 1 by more than an ulp or two."""
    Q = found(*made).Q
    assert Q[0, 0] >= 0
    assert Q[1, 1] >= 0
    if Q[0, 0] > TINY and Q[1, 1] > TINY:
        assert Q[0, 1] ** 2 <= Q[0, 0] * Q[1, 1] * (1 + 4e-16)


@pytest.mark.parametrize("turn", [0.1, 0.5])
@pytest.mark.parametrize("zeta", DAMPINGS[1::2])
def test_nothing_jumps_where_one_form_takes_over_from_another(zeta: float, turn: float) -> None:
    """On either side of the intervals where series end, and are lengthened, a transition is the same to 1e-13."""
    omega = 53.9
    middle = turn / fastest(omega, zeta)
    below, above = (found(omega, zeta, middle * (1.0 + by)) for by in (-1e-15, 1e-15))
    check(below, above, 4e-15, 1e-13)
    check(below, wanted(omega, zeta, middle * (1.0 - 1e-15)), 2e-15, 1e-13)


def test_nothing_happens_in_no_time() -> None:
    """Over an interval of 0 every plant stands still, exactly."""
    for plant in [FirstOrder(time_constant=0.04), *(SecondOrder(natural_frequency=53.9, damping=z) for z in DAMPINGS)]:
        rate = float(isinstance(plant, SecondOrder))  # which a lag has not
        assert step_of(plant, 0.0, 10.0) == [1.0, 0.0, 0.0, rate, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


# ---- first order ----------------------------------------------------------------------------------------------------


@settings(max_examples=200)
@given(powers(-6.0, 3.0), powers(-9.0, 5.0))
def test_any_lag_is_that_of_the_plant(tau: float, t: float) -> None:
    """Φ = e^(−t/τ) to an ulp of 1, Q = (1 − e^(−2t/τ)) / 2τ to 2e-15 of itself."""
    phi, *others, q, cross, rate = step_of(FirstOrder(time_constant=tau), t)[:7]
    assert (*others, cross, rate) == (0.0, 0.0, 0.0, 0.0, 0.0)
    with mpmath.workdps(DIGITS):
        turned = mpf(t) / mpf(tau)
        assert abs(mpf(phi) - mpmath.exp(-turned)) < 3e-16
        assert abs(mpf(q) / (-mpmath.expm1(-2 * turned) / (2 * mpf(tau))) - 1) < 2e-15


# ---- an input that decays -------------------------------------------------------------------------------------------


def wanted_decaying(plant: PLANTS, decay: float, t: float) -> tuple[mpf, mpf, mpf]:
    """Position, rate over ω and what is left of the input, from the exponential of plant and input as one system."""
    with mpmath.workdps(50):
        if isinstance(plant, FirstOrder):
            pole, turned = 1 / mpf(plant.time_constant), mpf(t)
            A = mpmath.matrix([[-pole, pole], [0, -mpf(decay)]]) * turned
            power = mpmath.expm(A)
            return power[0, 1], mpf(0), power[1, 1]
        w, z, b = mpf(plant.natural_frequency), mpf(plant.damping), mpf(decay)
        power = mpmath.expm(mpmath.matrix([[0, 1, 0], [-1, -2 * z, 1], [0, 0, -b / w]]) * w * mpf(t))
        return power[0, 2], power[1, 2], power[2, 2]


def check_decaying(plant: PLANTS, decay: float, t: float, tolerance: float = 1e-13) -> None:
    position, rate, left = step_of(plant, t, decay)[7:]
    omega = plant.natural_frequency if isinstance(plant, SecondOrder) else 1.0
    blur = blurred(omega, plant.damping, t) if isinstance(plant, SecondOrder) else 1.0
    for got, right in zip((position, rate / omega, left), wanted_decaying(plant, decay, t), strict=True):
        assert abs(mpf(got) - right) <= tolerance * blur


@st.composite
def decaying(draw: st.DrawFn) -> tuple[PLANTS, float, float]:
    """A plant, a decay anywhere or on, or a hair beside, one of the plant's poles, and an interval."""
    omega, zeta = draw(powers(-1.0, 4.0)), draw(dampings)
    plant = draw(
        st.sampled_from([FirstOrder(time_constant=1.0 / omega), SecondOrder(natural_frequency=omega, damping=zeta)])
    )
    poles = [omega, omega * zeta, fastest(omega, zeta), omega**2 / fastest(omega, zeta)]
    hair = draw(st.one_of(st.just(0.0), powers(-16.0, -0.3))) * draw(st.sampled_from([-1.0, 1.0]))
    decay = draw(st.one_of(st.just(0.0), powers(-4.0, 6.0), st.sampled_from(poles).map(lambda p: p * (1.0 + hair))))
    near = draw(st.sampled_from([None, *poles, decay or omega]))
    t = draw(powers(-9.0, 3.0)) if near is None else draw(powers(-2.0, 2.0)) / near
    return plant, decay, min(max(t, 1e-9), 1e3)


@settings(max_examples=120)
@given(decaying())
def test_any_response_to_a_decaying_input(made: tuple[PLANTS, float, float]) -> None:
    """Position and rate over ω to 1e-13, wherever the input's pole lies and however long the interval is."""
    check_decaying(*made)


@pytest.mark.parametrize("plant", [FirstOrder(time_constant=0.04), SecondOrder(natural_frequency=53.9, damping=0.8)])
def test_an_input_that_stays_is_a_step_and_one_that_is_gone_at_once_is_nothing(plant: PLANTS) -> None:
    """Decay 0 gives the step response; a decay of a nanosecond leaves its impulse; over a day nothing overflows."""
    for t in (1e-3, 0.03, 0.5, 86400.0):
        position, _, left = step_of(plant, t)[7:]
        assert left == 1.0
        assert position == pytest.approx(float(plant.step_response(t)), abs=1e-14)
        for decay in (1e-12, 1e9, 1e15):
            check_decaying(plant, decay, t)


# ---- a smooth disturbance -------------------------------------------------------------------------------------------


@settings(max_examples=150)
@given(powers(-4.0, 5.0), powers(-9.0, 5.0))
@example(0.5, 1.0 - 1e-15)  # where a series ends
@example(0.5, 1.0 + 1e-15)
def test_any_disturbance_is_that_of_its_covariance(rate: float, t: float) -> None:
    """Φ and Q for d and its rate over λ, from k(s) = (1 + λ|s|) e^(−λ|s|): P(t) P(0)⁻¹ and P(0) − Φ P(0) Φᵀ."""
    axis = record_of(AxisModel(plant=FirstOrder(time_constant=1.0)), 0.028, 0.0, 0.0)
    axis["disturbance_time"] = math.sqrt(3.0) / rate
    f11, f12, f21, f22, q11, q12, q22 = map(mpf, core.transition(axis, t)[10:].tolist())
    with mpmath.workdps(DIGITS):
        rate, a = mpf(rate), mpf(rate) * mpf(t)
        Phi = mpmath.exp(-a) * mpmath.matrix([[1 + a, a], [-a, 1 - a]])  # k, k' and k'' at t; at 0 they are 1, 0, -1
        right = Step(Phi, mpmath.eye(2) - Phi * Phi.T)
        Q = mpmath.matrix([[q11, q12 / rate], [q12 / rate, q22 / rate**2]])
        check(Step(mpmath.matrix([[f11, f12 * rate], [f21 / rate, f22]]), Q), right, 2e-15, 1e-13)
