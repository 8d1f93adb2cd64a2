"""A batch of trials: regression in each row, normal equations and minima, as one dense problem has them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from pumafuse.identification.batch import Batch
from pumafuse.identification.trials import Trial
from pumafuse.model.plants import unit_response

STEPS = (0.008, -0.004, 0.002, 0.012)
LENGTHS = (60, 41, 73, 25)
WEIGHTS = (120.0, 250.0, 40.0, 900.0)
DELAYS = np.array([0.0604, 0.0551, 0.0687, 0.0313])
FIRST, SWINGING, DAMPED = (0.04, 0.0), (2 * 0.864 / 53.9, 53.9**-2), (0.06, 4e-4)
KINKS = 1e-5  # of the sum of squares: it has a kink wherever a delay passes a sample
PLANTS = [(1, FIRST), (2, SWINGING), (2, DAMPED)]


def campaign(plant: tuple[float, float], noise: float, seed: int = 0, delays: np.ndarray = DELAYS) -> list[Trial]:
    """Trials that differ in all: length, spacing, jittering stamps, samples before the command, step, gain, zero."""
    rng = np.random.default_rng(seed)
    trials = []
    for place, (step, length, delay) in enumerate(zip(STEPS, LENGTHS, delays, strict=True)):
        spacing = (0.00563, 0.008, 0.004, 0.011)[place]
        time = spacing * (np.arange(length) - 3 * place + 0.3 * rng.random(length))
        position = 0.001 * place + (1.0 + 0.02 * place) * step * unit_response(time - delay, *plant)
        position = position + noise * abs(step) * rng.standard_normal(length)
        trials.append(Trial(str(place), "radial", step, 0.1, {}, time, position))
    return trials


def shapes(plant: tuple[float, float], delays: np.ndarray = DELAYS) -> np.ndarray:
    return np.column_stack((delays, np.tile(plant, (len(delays), 1))))


def dense(trials: list[Trial], x: np.ndarray, order: int) -> np.ndarray:
    """Residuals of all parameters: x is q, p (order 2), then delay, height and zero of each trial."""
    q, p = x[0], x[1] if order == 2 else 0.0
    left = []
    for place, (trial, weight) in enumerate(zip(trials, WEIGHTS, strict=True)):
        delay, height, zero = x[order + 3 * place : order + 3 * place + 3]
        left.append(weight * (trial.position - zero - height * unit_response(trial.time - delay, q, p)))
    return np.concatenate(left)


def linear(trial: Trial, delay: float, plant: tuple[float, float]) -> tuple[float, float]:
    """Height and zero by plain regression."""
    design = np.column_stack((unit_response(trial.time - delay, *plant), np.ones(len(trial.time))))
    height, zero = np.linalg.lstsq(design, trial.position, rcond=None)[0]
    return float(height), float(zero)


def unpacked(trials: list[Trial], plant: tuple[float, float], delays: np.ndarray, order: int) -> np.ndarray:
    own = [(delay, *linear(trial, delay, plant)) for trial, delay in zip(trials, delays, strict=True)]
    return np.concatenate((plant[:order], np.ravel(own)))


# ---- one shape ------------------------------------------------------------------------------------------------------


def test_a_response_that_comes_after_the_last_sample_has_no_height() -> None:
    """It explains nothing: the residual is the trial's own scatter, and its slopes are 0."""
    trials = campaign(FIRST, 0.05)
    batch = Batch.of(trials, WEIGHTS)
    found = batch.point(shapes(FIRST, np.full(4, 9.0)))
    assert not found.amplitude.any()
    scatter = [np.sum((w * (one.position - one.position.mean())) ** 2) for one, w in zip(trials, WEIGHTS, strict=True)]
    np.testing.assert_allclose(found.cost, scatter, rtol=1e-12)
    slopes, heights = batch.slopes(found, 2)
    assert not slopes.any() and not heights.any()
    equations = batch.equations(found, slopes)
    assert not any(part.any() for part in equations[:-1])
    assert (equations.delay_sd == np.inf).all()


@pytest.mark.parametrize(("order", "plant"), PLANTS)
def test_equations_are_the_dense_ones_with_delays_eliminated(order: int, plant: tuple[float, float]) -> None:
    """A Gauss-Newton step in q, p and every delay, and the covariance of q and p, solved all at once."""
    trials = campaign(plant, 0.05)
    batch = Batch.of(trials, WEIGHTS)
    at = batch.point(shapes(plant))
    slopes, _ = batch.slopes(at, order)
    found = batch.equations(at, slopes)
    x = unpacked(trials, plant, DELAYS, order)
    left = dense(trials, x, order)
    J = -least_squares(lambda y: dense(trials, y, order), x, "3-point", max_nfev=1, diff_step=1e-4).jac
    scale = np.linalg.norm(J, axis=0)
    step = np.linalg.lstsq(J / scale, left, rcond=None)[0] / scale
    information, score = found.information.sum(axis=0), found.score.sum(axis=0)
    moved = np.linalg.solve(information, score)
    np.testing.assert_allclose(moved, step[:order], rtol=1e-4)
    np.testing.assert_allclose(found.shift - found.coupling @ moved, step[order::3], rtol=1e-3, atol=1e-7)
    covariance = np.linalg.inv((J / scale).T @ (J / scale)) / np.outer(scale, scale)
    np.testing.assert_allclose(np.linalg.inv(information), covariance[:order, :order], rtol=1e-4)


# ---- minima ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delays", [DELAYS, np.array([0.0, 0.0551, 0.0, 0.0313])], ids=["late", "at once"])
@pytest.mark.parametrize(("order", "plant"), PLANTS)
def test_fit_shared_finds_the_minimum_of_the_dense_problem(
    order: int, plant: tuple[float, float], delays: np.ndarray
) -> None:
    """Bounded least squares starts where it ends and finds nothing better, in four noisy campaigns of each kind.

    Delays of 0 are at their bound. The first trial begins with its command: there a delay of 0 acts like a gain.
    """
    worst = 0.0
    for seed in (0, 5, 10, 38):
        trials = campaign(plant, 0.05, seed, delays)
        start = shapes((1.2 * plant[0], 0.8 * plant[1]), np.maximum(delays - 0.004, 0.0))
        found = Batch.of(trials, WEIGHTS).fit(start, order, size=len(start))
        assert found.shape[:, 0].min() >= 0.0
        x = unpacked(trials, (found.shape[0, 1], found.shape[0, 2]), found.shape[:, 0], order)
        low = np.concatenate(([1e-6, 0.0][:order], np.tile([0.0, -np.inf, -np.inf], 4)))
        best = least_squares(
            lambda y, trials=trials: dense(trials, y, order),
            np.maximum(x, low + 1e-9),
            bounds=(low, np.inf),
            x_scale=np.abs(x) + 1e-6,
            max_nfev=40,
        )
        worst = max(worst, found.cost.sum() / (2.0 * best.cost) - 1.0)
    assert worst < KINKS
