"""Plants against equations 3 to 9 of the paper, evaluated with 50 digits."""

import mpmath as mp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from pumafuse.model.plants import FirstOrder, SecondOrder

OMEGA = 53.9
NEAR_ONE = [1 + sign * off for off in (1e-12, 1e-9, 1e-6, 1e-4) for sign in (-1, 1)]
DAMPINGS = [0.5, 0.7, 0.864, *NEAR_ONE, 1.0, 1.1, 1.5, 2.0, 50.0, 1e3]
# Times in units of 1/ω, from the first instants to far beyond the end.
TIMES = np.concatenate([[0.0], np.logspace(-9.0, 9.0, 120), np.linspace(0.1, 30.0, 120)])


def second_order_step(omega: float, damping: float, t: float) -> mp.mpf:
    """Equation 6 with the poles of equations 7 and 8 (equation 9 where they are complex), and its limit at ζ = 1."""
    w, z, t = mp.mpf(omega), mp.mpf(damping), mp.mpf(t)
    if z == 1:
        return 1 - mp.exp(-w * t) * (1 + w * t)
    root = mp.sqrt(mp.mpc(z**2 - 1))
    s1, s2 = w * (z + root), w * (z - root)
    return (1 + w / (2 * root) * (mp.exp(-s1 * t) / s1 - mp.exp(-s2 * t) / s2)).real


@mp.workdps(50)
def worst_error(omega: float, damping: float, times: np.ndarray) -> float:
    """The largest distance between the plant's step response and the equations, in units of K."""
    found = SecondOrder(natural_frequency=omega, damping=damping).step_response(times)
    return max(float(abs(second_order_step(omega, damping, t) - mp.mpf(p))) for t, p in zip(times, found, strict=True))


def second_order(damping: float) -> SecondOrder:
    return SecondOrder(natural_frequency=OMEGA, damping=damping)


PLANTS = [FirstOrder(time_constant=0.0425), *map(second_order, [0.1, *DAMPINGS])]


@pytest.mark.parametrize("damping", DAMPINGS)
def test_second_order_step_response_is_the_papers(damping: float) -> None:
    """Equations 6 and 9 and the critical case between them hold to 1e-12 of K at all times."""
    assert worst_error(OMEGA, damping, TIMES / OMEGA) <= 1e-12


@settings(max_examples=60)
@given(omega=st.floats(1e-3, 1e4), damping=st.floats(0.5, 2.0), scaled=st.floats(0.0, 500.0))
@example(omega=1.0, damping=np.nextafter(1.0, 0.0), scaled=3.0)
@example(omega=1.0, damping=np.nextafter(1.0, 2.0), scaled=3.0)
def test_second_order_step_response_holds_for_any_plant(omega: float, damping: float, scaled: float) -> None:
    """The step response agrees with 50 digits for any natural frequency, damping and time."""
    assert worst_error(omega, damping, np.array([scaled / omega])) <= 1e-12


@mp.workdps(50)
@pytest.mark.parametrize("tau", [1e-4, 0.0356, 0.0425, 12.0])
def test_first_order_step_response_is_equation_4(tau: float) -> None:
    """1 − e^(−t/τ) with full relative precision, however short the time."""
    times = tau * np.concatenate([np.logspace(-12.0, 3.0, 100), [1.0]])
    for t, p in zip(times, FirstOrder(time_constant=tau).step_response(times), strict=True):
        exact = 1 - mp.exp(-mp.mpf(t) / mp.mpf(tau))
        assert abs(exact - mp.mpf(p)) <= 1e-15 * exact


@pytest.mark.parametrize("plant", PLANTS, ids=str)
def test_nothing_moves_before_the_step(plant: FirstOrder | SecondOrder) -> None:
    """The response is exactly zero up to and at the step, and not after it; it has the shape of its times."""
    response = plant.step_response(np.array([[-1e9, -1e-12, 0.0], [1e-3, 1e3, 1e9]]))
    assert response.shape == (2, 3)
    assert (response[0] == 0.0).all()
    assert response[1, 0] > 0.0
    assert response[1, 2] == 1.0 == plant.step_response(1e9)


@pytest.mark.parametrize("plant", PLANTS, ids=str)
def test_state_space_answers_as_the_step_response(plant: FirstOrder | SecondOrder) -> None:
    """C ∫₀ᵗ e^(As) ds B by scipy's matrix exponential is the step response."""
    A, B, C = plant.state_space()
    n = len(A)
    times = np.linspace(0.0, 0.5, 60)
    held = expm(np.block([[A, B], [np.zeros((1, n + 1))]]) * times[:, None, None])
    np.testing.assert_allclose((C @ held[:, :n, n:])[:, 0, 0], plant.step_response(times), rtol=0.0, atol=1e-11)
