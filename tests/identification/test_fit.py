"""Fits of one trial: exact without noise, never worse than a grid, intervals that hold."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pumafuse import FirstOrder, SecondOrder
from pumafuse.identification.fit import StepFit, fit_steps, flags
from pumafuse.identification.trials import StepTrials, Trial
from pumafuse.model.plants import unit_response

SHARED = Path(__file__).parents[3] / "shared" / "data"
TIMES = np.arange(60) * 0.00563  # s, the paper's oscilloscope
GAIN, DELAY, ZERO, STEP = 1.02, 0.0604, 0.0003, 0.008
SLOW, SWINGING = (0.04, 0.0), (2 * 0.864 / 53.9, 53.9**-2)  # q and p: first order, the paper's tangential axis


def trial(q: float, p: float, noise: float = 0.0, seed: int = 0, delay: float = DELAY) -> Trial:
    rng = np.random.default_rng(seed)
    position = ZERO + GAIN * STEP * unit_response(TIMES - delay, q, p) + noise * rng.standard_normal(len(TIMES))
    return Trial("1", "radial", STEP, 0.28, {}, TIMES, position)


def fit_step(one: Trial, order: int, samples: int | None = None) -> StepFit:
    return fit_steps([one.cut(samples)])[0][order - 1]


def test_second_order_becomes_first_order() -> None:
    """As p falls to 0, without a step at 0."""
    first = FirstOrder(time_constant=0.04).step_response(TIMES)
    for p in (0.0, 1e-30, 1e-14, 1e-10):
        np.testing.assert_allclose(unit_response(TIMES, 0.04, p), first, rtol=0.0, atol=max(1e3 * p, 1e-12))


# ---- fits -----------------------------------------------------------------------------------------------------------


@settings(max_examples=10)
@given(st.floats(0.01, 0.08), st.floats(0.0, 0.15))
def test_first_order_without_noise_is_found_exactly(tau: float, delay: float) -> None:
    """Time constant, delay, gain and zero to 1e-5."""
    fit = fit_step(trial(tau, 0.0, delay=delay), 1)
    np.testing.assert_allclose([fit.shape.q, fit.gain], [tau, GAIN], rtol=1e-5)
    np.testing.assert_allclose([fit.shape.delay, fit.zero], [delay, ZERO], atol=1e-6)
    assert fit.rms < 1e-8


@settings(max_examples=10)
@given(st.floats(25.0, 150.0), st.floats(0.4, 1.6), st.floats(0.0, 0.12))
def test_second_order_without_noise_is_found_exactly(omega: float, damping: float, delay: float) -> None:
    """ω and ζ to 1e-3, the curve to 1e-7 m."""
    fit = fit_step(trial(2 * damping / omega, omega**-2, delay=delay), 2)
    assert fit.rms < 1e-7
    plant = fit.plant
    assert isinstance(plant, SecondOrder)
    np.testing.assert_allclose([plant.natural_frequency, plant.damping], [omega, damping], rtol=1e-3)


def finest(of: Trial, order: int) -> float:
    """The least sum of squares [m²] over a fine grid, gain and zero by plain regression at every point of it."""
    best = np.inf
    shapes = [0.0] if order == 1 else np.concatenate(([0.0], np.geomspace(0.02, 4.0, 25)))
    for delay in np.arange(0.0, 0.2, 0.002):
        for q in np.geomspace(0.004, 0.15, 40):
            c = unit_response(of.time - delay, q, np.array([[shape * q * q] for shape in shapes]))
            c = c - c.mean(axis=1, keepdims=True)
            left = of.position - of.position.mean()
            power = np.maximum(np.einsum("ij,ij->i", c, c), 1e-12)
            best = min(best, float(left @ left - np.max((c @ left) ** 2 / power)))
    return best


@pytest.mark.long
@pytest.mark.parametrize(
    ("q", "p", "order", "noise"), [(*SLOW, 1, 5e-3), (*SLOW, 2, 0.05e-3), (*SWINGING, 2, 5e-3), (*SWINGING, 1, 0.5e-3)]
)
def test_a_fit_is_never_worse_than_a_fine_grid(q: float, p: float, order: int, noise: float) -> None:
    """Also when the noise is as large as the step and the sum of squares has many minima."""
    for seed in range(2):
        noisy = trial(q, p, noise, seed)
        assert fit_step(noisy, order).squares <= finest(noisy, order) * (1.0 + 1e-9)


def test_second_order_never_fits_worse_than_first() -> None:
    """First order is its p = 0."""
    for first, second in fit_steps([trial(*SLOW, 1e-3, seed) for seed in range(10)]):
        assert second.squares <= first.squares * (1.0 + 1e-12)


@pytest.mark.long
@pytest.mark.parametrize(("order", "shape"), [(1, SLOW), (2, SWINGING)], ids=["first", "second"])
def test_intervals_hold(order: int, shape: tuple[float, float]) -> None:
    """Each truth lies in its 95 % interval in 91 to 99 % of 300 trials (four standard deviations), jitter included."""
    inside = np.zeros(4)
    for seed in range(300):
        delay = DELAY + 0.002 * np.random.default_rng(1000 + seed).standard_normal()
        fit = fit_step(trial(*shape, 0.1e-3, seed, delay), order)
        truths = (delay, shape[0], shape[1], GAIN)
        intervals = (fit.ci95.delay, fit.ci95.q, fit.ci95.p, fit.ci95.gain)
        inside += [low <= truth <= high for truth, (low, high) in zip(truths, intervals, strict=True)]
    share = inside / 300
    assert ((share > 0.90) & (share < 0.995))[[0, 1, 3]].all(), share
    assert share[2] > 0.90


def test_intervals_of_a_second_order_plant_that_is_none_are_open() -> None:
    """A first-order response says how slow ω is at least, and no more; its 1/ω² may be 0."""
    fit = fit_step(trial(*SLOW, 0.1e-3, 3), 2)
    assert fit.ci95.p[0] <= 0.0
    assert fit.plant.natural_frequency_ci95[1] == np.inf and fit.plant.damping_ci95[1] == np.inf
    assert "long flat valley: first order may do" in flags(fit)
    clear = fit_step(trial(*SWINGING, 0.02e-3, 1), 2)
    low, high = clear.plant.natural_frequency_ci95
    assert low < 53.9 < high < 60.0
    assert clear.plant.damping_ci95[0] < 0.864 < clear.plant.damping_ci95[1] < 1.0
    assert flags(clear) == []


def test_flags_name_what_spoils_a_trial() -> None:
    """A drive that sticks, a window that ends too early."""
    still = Trial("1", "radial", STEP, 0.28, {}, TIMES, 0.02e-3 * np.random.default_rng(1).standard_normal(60))
    assert flags(fit_step(still, 1))[0].startswith("hardly moved (stiction?)")
    assert flags(fit_step(trial(*SLOW, 0.01e-3), 1, 25)) == ["not settled: 84% reached"]


# ---- recorded -------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.skipif(not SHARED.exists(), reason="the recorded campaigns are not beside the project")
def test_recorded_trials_of_a_robot_are_read_whole_and_fitted() -> None:
    """90 of an industrial robot, 52 of which begin before their command, at 98 %."""
    robot = StepTrials.read(SHARED / "robot-steps")
    assert (len(robot.trials), robot.notes) == (90, ())
    assert sum(trial.time[0] < 0.0 for trial in robot.trials) == 52
    fits = [first for first, _ in fit_steps(robot.trials)]
    shares = [1.0 - fit.rms / np.std(one.position) for fit, one in zip(fits, robot.trials, strict=True)]
    assert np.median(shares) > 0.98
