"""Means and regressions of trials: the textbook's where it has an answer, intervals that hold where it has none."""

import warnings

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats

from pumafuse.identification.estimate import common, mean, regression, robust

SPEEDS = np.repeat([0.07, 0.14, 0.28, 0.57], 5)  # m/s
LINE = np.column_stack((np.ones(20), SPEEDS))
NORMAL = st.lists(st.floats(-100.0, 100.0), min_size=2, max_size=30).map(np.array)


def scattered(seed: int, n: int, between: float, sd: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return between * rng.standard_normal(n) + sd * rng.standard_normal(n)


# ---- one mean -------------------------------------------------------------------------------------------------------


@given(NORMAL)
def test_a_mean_has_the_textbooks_interval(values: np.ndarray) -> None:
    """Student's, as scipy computes it."""
    assume(np.ptp(values) > 1e-6)
    found = mean(values)
    low, high = stats.t.interval(0.95, len(values) - 1, values.mean(), stats.sem(values))
    np.testing.assert_allclose([found.value, *found.ci95], [values.mean(), low, high], rtol=1e-9, atol=1e-9)


def test_a_robust_mean_solves_hubers_equation() -> None:
    """The clipped residuals, in units of 1.4826 times their median size, sum to 0; 1.345 is where they are clipped."""
    values = np.append(np.random.default_rng(3).standard_normal(15), [9.0, 14.0])
    found = robust(values)
    left = values - found.value
    scale = np.median(np.abs(left)) / stats.norm.ppf(0.75)
    assert abs(np.clip(left / scale, -1.345, 1.345).sum()) < 1e-5
    assert (np.abs(left / scale) > 1.345).sum() >= 2
    assert found.ci95 == pytest.approx((-0.81658327, 0.49914297), rel=1e-7)  # of statsmodels 0.15, by its H1


# ---- random effects -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sd", [0.0, 0.2])
def test_equal_sds_give_ordinary_least_squares(sd: float) -> None:
    """A line of 20 values with the t-intervals of scipy's `linregress`; no sd at all likewise."""
    values = 1.0 + 0.05 * SPEEDS + scattered(4, 20, 0.01, np.full(20, 0.005))
    found = regression(values, np.full(20, sd), LINE)
    line, t = stats.linregress(SPEEDS, values), stats.t.ppf(0.975, 18)
    np.testing.assert_allclose(found.values, [line.intercept, line.slope], rtol=1e-9)
    halves = 0.5 * np.diff(found.ci95)[:, 0]
    np.testing.assert_allclose(halves, [t * line.intercept_stderr, t * line.stderr], rtol=1e-9)


@pytest.mark.parametrize(("design", "between"), [(np.ones((20, 1)), 1.0), (LINE, 30.0)], ids=["mean", "line"])
def test_the_variance_between_trials_is_paule_and_mandels(design: np.ndarray, between: float) -> None:
    """Weighted squares equal their degrees of freedom, weights are 1/(sd² + between²) with one `between`."""
    sd = np.geomspace(0.01, 0.2, 20)
    values = scattered(5, 20, between, sd)
    found = regression(values, sd, design)
    weight = found.weights
    variance = 1.0 / weight - sd**2
    np.testing.assert_allclose(variance, variance[0], rtol=1e-6)
    assert variance[0] > 0.0
    left = values - design @ found.values
    assert weight @ left**2 == pytest.approx(20 - design.shape[1], rel=1e-6)
    assert np.abs(design.T @ (weight * left)).max() < 1e-8 * np.abs(design.T @ (weight * np.abs(left))).max()
    assert 0.4 * between < np.sqrt(variance[0]) < 2.0 * between


# ---- what is degenerate ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("values", [[], [3.0], [0.0] * 6, [1.0, 1.0, 1.0, 1.0, 2.0]], ids=str)
@pytest.mark.parametrize("sd", [0.0, 0.5])
def test_degenerate_values_are_taken_without_a_warning(values: list[float], sd: float) -> None:
    """None or one: an open interval; equal ones: that value."""
    given = np.array(values)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = [mean(given), robust(given), common(given, np.full(len(values), sd))]
    assert not [str(one.message) for one in caught]
    for one in found:
        if len(values) < 2:
            assert one.ci95 == (-np.inf, np.inf)
            assert np.isnan(one.value) if not values else one.value == 3.0
        elif len(set(values)) == 1:
            np.testing.assert_allclose([one.value, *one.ci95], values[0], rtol=1e-9, atol=1e-12)
        else:
            assert 1.0 <= one.value < 2.0 and np.isfinite(one.ci95).all()
