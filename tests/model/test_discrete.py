"""The exact discrete form against closed forms with 80 digits, ODE integration, and a published example."""

import math
from itertools import pairwise

import control
import mpmath as mp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from pumafuse.model.arm import AxisModel, Gain
from pumafuse.model.discrete import DiscreteModel, discretize, transition
from pumafuse.model.plants import FirstOrder, Plant, SecondOrder

MICROSECOND, DAY = 1e-6, 86400.0
TANGENTIAL = SecondOrder(natural_frequency=53.9, damping=0.864)
RADIAL = FirstOrder(time_constant=0.0425)

first_order = st.builds(FirstOrder, time_constant=st.floats(0.005, 0.5))
second_order = st.builds(SecondOrder, natural_frequency=st.floats(2.0, 200.0), damping=st.floats(0.1, 3.0))
plants = first_order | second_order
periods = st.floats(0.002, 0.05)


def powers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


@mp.workdps(80)
def exact_transition(plant: Plant, interval: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Φ, Γ and Q in closed form: Γ from the unit gain, Q as P − Φ P Φᵀ with the stationary covariance P."""
    h = mp.mpf(interval)
    if isinstance(plant, FirstOrder):
        tau = mp.mpf(plant.time_constant)
        Phi, P = mp.matrix([[mp.exp(-h / tau)]]), mp.matrix([[1 / (2 * tau)]])
    else:
        w, z = mp.mpf(plant.natural_frequency), mp.mpf(plant.damping)
        a, b = z * w, mp.sqrt(mp.mpc(w**2 * (z**2 - 1)))
        cosh, sinhc = mp.cosh(b * h).real, (mp.sinh(b * h) / b).real if b else h
        Phi = mp.exp(-a * h) * mp.matrix([[cosh + a * sinhc, sinhc], [-(w**2) * sinhc, cosh - a * sinhc]])
        P = mp.diag([w / (4 * z), w**3 / (4 * z)])
    rest = mp.matrix([1] + [0] * (Phi.rows - 1))
    return tuple(np.array(m.tolist(), dtype=float) for m in (Phi, rest - Phi * rest, P - Phi * P * Phi.T))


def assert_transition(plant: Plant, interval: float, rtol: float = 1e-9) -> None:
    """Each element is right to ``rtol`` of its natural scale: √(Qii Qjj) for Q, the like for Φ and Γ."""
    Phi, Gamma, Q = exact_transition(plant, interval)
    found = transition(plant, interval)
    sd = np.sqrt(np.diag(Q))
    size = np.array([1.0, getattr(plant, "natural_frequency", 1.0)])[: len(Phi)]
    largest = np.minimum(np.sqrt(interval) * sd, size)  # |Γi| ≤ √(h Qii) by Cauchy-Schwarz
    assert (np.abs(found.Q - Q) <= rtol * np.outer(sd, sd)).all()
    assert (np.abs(found.Phi - Phi) <= rtol * np.outer(size, 1.0 / size)).all()
    assert (np.abs(found.Gamma[:, 0] - Gamma[:, 0]) <= rtol * largest).all()


def delayed_response(plant: Plant, period: float, delay: float, inputs: np.ndarray) -> np.ndarray:
    """Position at each tick from the plant's differential equation, integrated from switch to switch."""
    ticks = np.arange(len(inputs)) * period
    switches = ticks + delay
    breaks = np.union1d(ticks, switches[switches < ticks[-1]])
    position = {0.0: 0.0}
    x = np.zeros(2)
    for begin, end in pairwise(breaks):
        acting = np.searchsorted(switches, begin, side="right") - 1
        v = inputs[acting] if acting >= 0 else 0.0
        solved = solve_ivp(motion, (0.0, end - begin), x, "DOP853", args=(plant, v), rtol=1e-11, atol=1e-13)
        x = solved.y[:, -1]
        position[end] = x[0]
    return np.array([position[t] for t in ticks])


def motion(_: float, x: np.ndarray, plant: Plant, v: float) -> list[float]:
    """τ ṗ + p = v, or p̈ + 2ζω ṗ + ω² p = ω² v."""
    if isinstance(plant, FirstOrder):
        return [(v - x[0]) / plant.time_constant, 0.0]
    w, z = plant.natural_frequency, plant.damping
    return [x[1], w * w * (v - x[0]) - 2.0 * z * w * x[1]]


def simulate(model: DiscreteModel, inputs: np.ndarray) -> np.ndarray:
    """Position at each tick from rest: the inputs' convolution with the impulse response."""
    impulse = np.diff(model.step_response(len(inputs)), prepend=0.0)
    return np.convolve(inputs, impulse)[: len(inputs)]


def test_published_example() -> None:
    """MATLAB's c2d example: 10/(s² + 3s + 10), 0.25 s late, at 0.1 s, is z⁻³ (0.01187 z² + …) / (z² − 1.655 z + …)."""
    plant = SecondOrder(natural_frequency=math.sqrt(10.0), damping=1.5 / math.sqrt(10.0))
    model = discretize(plant, 0.1, 0.25)
    denominator = np.poly(model.poles[np.abs(model.poles) > 1e-6]).real
    impulse = np.diff(model.step_response(10), prepend=0.0)
    numerator = np.convolve(impulse, denominator)[:10]
    assert [f"{c:.4g}" for c in denominator] == ["1", "-1.655", "0.7408"]
    assert [f"{c:.4g}" for c in numerator[3:6]] == ["0.01187", "0.06408", "0.009721"]
    np.testing.assert_allclose(np.delete(numerator, [3, 4, 5]), 0.0, atol=1e-14)


DELAYS = st.one_of(
    st.just(0.0),
    st.integers(1, 8).map(float),
    st.floats(0.0, 1.0),
    st.floats(0.0, 12.0),
    st.tuples(st.integers(1, 6), st.floats(-1e-10, 1e-10)).map(sum),
)


@settings(max_examples=30)
@given(plant=plants, period=periods, periods_late=DELAYS, seed=st.integers(0, 2**32 - 1))
@example(plant=TANGENTIAL, period=0.028, periods_late=0.06045 / 0.028, seed=0)
@example(plant=RADIAL, period=0.028, periods_late=0.0385 / 0.028, seed=0)
@example(plant=SecondOrder(natural_frequency=50.0, damping=1.0), period=0.028, periods_late=2.5, seed=0)
def test_model_is_the_delayed_plant(plant: Plant, period: float, periods_late: float, seed: int) -> None:
    """At every tick the model is where the plant's differential equation is, under any held input and delay."""
    inputs = np.random.default_rng(seed).normal(size=18)
    delay = periods_late * period
    found = simulate(discretize(plant, period, delay), inputs)
    np.testing.assert_allclose(found, delayed_response(plant, period, delay, inputs), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("late", "past"), [(0.0, 0), (0.3, 1), (1.0 - 1e-10, 1), (1.0, 1), (1.7, 2), (2.00001, 3), (40.0 + 1e-12, 40)]
)
def test_as_many_past_inputs_as_are_needed(late: float, past: int) -> None:
    """Td = d·T + τ′ takes d + 1 past inputs, or d when τ′ is 0 but for rounding; each is a pole at zero."""
    axis = AxisModel(plant=TANGENTIAL, gain=Gain(slope=0.08, intercept=0.9), gain_recovery=0.1, delay=0.0385)
    model, by_axis = (discretize(which, 0.028, late * 0.028) for which in (TANGENTIAL, axis))
    assert (by_axis.F == model.F).all() and (by_axis.B == model.B).all()
    assert model.states == ("position", "rate", *(f"v[n-{age}]" for age in range(1, past + 1)))
    w, z = 53.9, 0.864
    poles = np.exp(0.028 * w * (-z + 1j * np.sqrt(1.0 - z * z) * np.array([-1.0, 1.0])))
    np.testing.assert_allclose(np.sort_complex(model.poles)[-2:], np.sort_complex(poles), atol=1e-12)
    assert np.abs(np.sort_complex(model.poles)[:-2]).max(initial=0.0) <= 1e-12


@settings(max_examples=60)
@given(omega=powers(-1.0, 5.0), damping=powers(-2.0, 3.0), interval=powers(-6.0, 5.0))
@example(omega=0.1, damping=1.0, interval=DAY)
@example(omega=1e5, damping=1 - 1e-9, interval=MICROSECOND)
@example(omega=53.9, damping=1 + 1e-9, interval=0.028)
def test_transition_is_exact_everywhere(omega: float, damping: float, interval: float) -> None:
    """Φ, Γ and Q hold for any natural frequency, damping and interval, from a microsecond to a day, stiff or soft."""
    assert_transition(SecondOrder(natural_frequency=omega, damping=damping), interval)
    assert_transition(FirstOrder(time_constant=1.0 / omega), interval)


@pytest.mark.parametrize("plant", [TANGENTIAL, RADIAL], ids=["second-order", "first-order"])
def test_many_intervals_at_once_are_each_its_own(plant: Plant) -> None:
    """A table of intervals gives a table of transitions; an interval of zero changes nothing."""
    intervals = np.array([[0.0, MICROSECOND, 0.028], [0.5, 60.0, DAY]])
    together, n = transition(plant, intervals), len(plant.state_space()[0])
    assert [part.shape for part in together] == [(2, 3, n, n), (2, 3, n, 1), (2, 3, n, n)]
    for index, interval in np.ndenumerate(intervals):
        for all_at_once, alone in zip(together, transition(plant, interval), strict=True):
            np.testing.assert_allclose(all_at_once[index], alone, rtol=1e-13, atol=0.0)
    for part, expected in zip(together, (np.eye(n), np.zeros((n, 1)), np.zeros((n, n))), strict=True):
        assert (part[0, 0] == expected).all()


def test_an_offset_stays_and_is_measured() -> None:
    """The offset adds to p for ever, moves nothing else, and no input moves it. Past inputs carry no noise."""
    inputs = np.random.default_rng(3).normal(size=20)
    plain = discretize(TANGENTIAL, 0.028, 0.06045)
    model = discretize(TANGENTIAL, 0.028, 0.06045, input_noise=3e-5, drift=4e-4)
    offset = model.states.index("offset")
    assert model.states == ("position", "rate", "offset", "v[n-1]", "v[n-2]", "v[n-3]")
    assert "offset" not in plain.states
    assert not model.Q[3:].any() and not model.Q[:, 3:].any()
    x = np.eye(len(model.F))[:, [offset]] * 0.7
    for v, p in zip(inputs, simulate(plain, inputs), strict=True):
        assert (model.H @ x).item() == pytest.approx(p + 0.7, abs=1e-14)
        assert x[offset] == 0.7
        x = model.F @ x + model.B * v


@pytest.mark.parametrize(("late", "drift"), [(0.0, None), (1.0, 4e-4), (2.16, None)])
def test_control_answers_the_same(late: float, drift: float | None) -> None:
    """The `control` system has our period and our step response, offset or not."""
    model = discretize(TANGENTIAL, 0.028, late * 0.028, drift=drift)
    system = model.to_control()
    assert system.dt == 0.028
    assert system.nstates == len(model.F) - (drift is not None)
    response = control.step_response(system, np.arange(40) * 0.028)
    np.testing.assert_allclose(response.outputs, model.step_response(40), rtol=0.0, atol=1e-12)


def test_filterpy_predicts_the_same() -> None:
    """The `filterpy` filter starts at rest and certain of it, and predicts the plant and the growth of its variance."""
    model = discretize(TANGENTIAL, 0.028, 0.06045, input_noise=3e-5, drift=4e-4)
    kf = model.to_filterpy()
    inputs = np.random.default_rng(4).normal(size=20)
    expected = delayed_response(TANGENTIAL, 0.028, 0.06045, inputs)
    for n, (v, p) in enumerate(zip(inputs, expected, strict=True)):
        noise = 3e-5**2 * exact_transition(TANGENTIAL, n * 0.028)[2][0, 0] + 4e-4**2 * n * 0.028
        assert (kf.H @ kf.x).item() == pytest.approx(p, abs=1e-9)
        assert (kf.H @ kf.P @ kf.H.T).item() == pytest.approx(noise, rel=1e-11)
        kf.predict(u=np.array([[v]]))
    kf.F += 1.0
    assert (model.F != kf.F).all()  # the filter's matrices are its own


@pytest.mark.parametrize(
    ("period", "delay"),
    [(0.0, 0.06), (math.inf, 0.06), (0.028, -1e-12), (0.028, math.nan)],
)
def test_an_impossible_period_or_delay_is_refused(period: float, delay: float) -> None:
    """Neither a positive finite period with a finite delay ≥ 0: a ValueError that names both numbers."""
    with pytest.raises(ValueError, match="period must be > 0 and delay ≥ 0"):
        discretize(TANGENTIAL, period, delay)
