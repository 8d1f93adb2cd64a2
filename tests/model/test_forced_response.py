"""The position that a sequence of inputs makes: superposed steps, the plant's equation, and what lies at the edges."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from pumafuse import FirstOrder, SecondOrder
from pumafuse.arrays import FloatArray, TimeArray
from pumafuse.model.forced_response import forced_response
from pumafuse.model.plants import PLANTS

EPOCH = 1_790_000_000_000_000_000  # ns: stamps of a logger in 2026, too large for a float to hold
KNOWN: dict[str, PLANTS] = {
    "first order": FirstOrder(time_constant=0.0425),
    "under-damped": SecondOrder(natural_frequency=53.9, damping=0.2),
    "critical": SecondOrder(natural_frequency=60.0, damping=1.0),
    "nearly critical": SecondOrder(natural_frequency=60.0, damping=1.0 + 1e-9),
    "over-damped": SecondOrder(natural_frequency=60.0, damping=2.5),
}
PLANT = st.one_of(
    st.builds(lambda tau: FirstOrder(time_constant=tau), st.floats(1e-3, 1.0)),
    st.builds(
        lambda omega, damping: SecondOrder(natural_frequency=omega, damping=damping),
        st.floats(2.0, 500.0),
        st.one_of(st.floats(0.05, 0.95), st.floats(0.95, 1.05), st.just(1.0), st.floats(1.05, 8.0)),
    ),
)


def superposed(plant: PLANTS, acting: TimeArray, value: FloatArray, time: TimeArray) -> FloatArray:
    """Every change of the input as a step of its own, each from rest."""
    since = (time[:, None] - acting[None]) * 1e-9
    return plant.step_response(since) @ np.diff(value, prepend=0.0)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(PLANT, st.integers(0, 10**6), st.integers(0, 40), st.integers(0, 60))
def test_inputs_superpose(plant: PLANTS, seed: int, commands: int, times: int) -> None:
    """Any inputs at irregular times, asked for at any times, also the same instant twice, in stamps of a real clock."""
    rng = np.random.default_rng(seed)
    acting = EPOCH + np.sort(rng.integers(0, 2 * 10**9, commands))
    time = EPOCH + np.sort(rng.integers(-(10**8), 3 * 10**9, times))
    value = rng.normal(0.0, 0.01, commands)
    found = forced_response(plant, acting, value, time)
    assert found.shape == (times,)
    np.testing.assert_allclose(found, superposed(plant, acting, value, time), rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("name", KNOWN)
def test_the_plants_equation_is_solved(name: str) -> None:
    """State space driven by held inputs, integrated by a Runge-Kutta method from one input to the next."""
    plant = KNOWN[name]
    A, B, C = plant.state_space()
    rng = np.random.default_rng(5)
    acting = np.cumsum(rng.integers(2 * 10**6, 90 * 10**6, 12))
    value = rng.normal(0.0, 1.0, 12)
    time = np.sort(rng.integers(0, int(acting[-1]) + 3 * 10**8, 80))
    state, expected = np.zeros(len(A)), np.zeros(80)
    for k, begin in enumerate(acting):
        end = acting[k + 1] if k + 1 < len(acting) else time[-1] + 1
        here = np.flatnonzero((time >= begin) & (time < end))
        asked = np.append(time[here], end)
        solved = solve_ivp(
            lambda _, x, v=value[k]: A @ x + B[:, 0] * v, (0.0, (end - begin) * 1e-9), state, "DOP853",
            (asked - begin) * 1e-9, rtol=1e-12, atol=1e-13,
        )  # fmt: skip
        expected[here] = (C @ solved.y)[0, :-1]
        state = solved.y[:, -1]
    np.testing.assert_allclose(forced_response(plant, acting, value, time), expected, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("name", KNOWN)
def test_at_the_instant_of_an_input_it_has_moved_nothing_yet(name: str) -> None:
    """Positions are continuous: the input that acts at an instant shows only after it, the one before it is whole."""
    plant = KNOWN[name]
    acting = np.array([0, 30, 70], dtype=np.int64) * 10**6
    value = np.array([1.0, -2.0, 0.5])
    for at in (0, 1, 2):
        found = forced_response(plant, acting, value, acting[at : at + 1])
        without = superposed(plant, acting[:at], value[:at], acting[at : at + 1])
        np.testing.assert_allclose(found, without, rtol=0.0, atol=1e-14)
    soon = forced_response(plant, acting, value, np.array([10**5]))[0]
    assert soon == pytest.approx(float(plant.step_response(1e-4)), abs=1e-15)
    assert soon > 0.0


@pytest.mark.parametrize("name", KNOWN)
def test_of_two_inputs_at_one_instant_the_later_one_counts(name: str) -> None:
    """As if the first had not been."""
    time = np.arange(0, 200, 7) * 10**6
    twice = forced_response(KNOWN[name], np.array([10, 10, 50]) * 10**6, np.array([9.0, 1.0, 2.0]), time)
    once = forced_response(KNOWN[name], np.array([10, 50]) * 10**6, np.array([1.0, 2.0]), time)
    np.testing.assert_array_equal(twice, once)


@pytest.mark.parametrize("name", KNOWN)
def test_nothing_moves_before_the_first_input_or_without_one(name: str) -> None:
    """Exactly 0, not nearly; and no times give no positions."""
    acting, value = np.array([EPOCH]), np.array([3.0])
    before = EPOCH + np.array([-(10**12), -1, 0])
    np.testing.assert_array_equal(forced_response(KNOWN[name], acting, value, before), 0.0)
    np.testing.assert_array_equal(forced_response(KNOWN[name], acting[:0], value[:0], before), 0.0)
    assert forced_response(KNOWN[name], acting, value, before[:0]).shape == (0,)
    assert forced_response(KNOWN[name], acting[:0], value[:0], before[:0]).shape == (0,)


@pytest.mark.parametrize("name", KNOWN)
def test_what_is_asked_for_changes_no_answer(name: str) -> None:
    """More times between and the position at the others stays, but for rounding; inputs are left as they were."""
    rng = np.random.default_rng(1)
    acting = np.sort(rng.integers(0, 10**9, 30))
    value = rng.normal(0.0, 1.0, 30)
    time = np.sort(rng.integers(0, 10**9, 400))
    kept = acting.copy(), value.copy(), time.copy()
    dense = forced_response(KNOWN[name], acting, value, time)
    np.testing.assert_allclose(
        forced_response(KNOWN[name], acting, value, time[::13]), dense[::13], rtol=0.0, atol=1e-13
    )
    for now, then in zip((acting, value, time), kept, strict=True):
        np.testing.assert_array_equal(now, then)


@pytest.mark.parametrize("name", KNOWN)
def test_it_settles_at_its_input_however_long_it_rests(name: str) -> None:
    """Unit gain: an hour later it is where it was sent, to the last bits."""
    hour = 3600 * 10**9
    found = forced_response(KNOWN[name], np.array([0, hour]), np.array([0.56, 0.57]), np.array([hour, 2 * hour]))
    np.testing.assert_allclose(found, [0.56, 0.57], rtol=1e-15)
