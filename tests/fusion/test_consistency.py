"""Consistency: the statistics against scipy and by hand, the verdicts on data made exactly by the model.

A filter with the true configuration must be consistent; of a wrong one the verdict must name the fault.
"""

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.special import chdtrc, chdtri

import pumafuse as pf
from fusion.test_causes import PERIOD, SD, changed, config, recorded
from pumafuse.fusion import chi_square
from pumafuse.fusion.consistency import (
    LAGS,
    Consistency,
    chi_square_band,
    consistency,
    ljung_box,
    log_likelihood,
)
from pumafuse.fusion.verdicts import sentence

SEEDS = 120


def swing(count: int) -> np.ndarray:
    """Commands to and fro over 100 mm in 2 s."""
    return 0.05 * (1.0 - np.cos(np.pi * PERIOD * np.arange(count)))


def judged(run: pf.Run, known: pf.FusionConfig) -> dict[str, Consistency]:
    """Consistency of each axis with this configuration."""
    est = pf.fuse(run, known)
    return {axis: one for axis in run.axes if (one := consistency(est, "camera", axis)) is not None}


@pytest.mark.parametrize("count", [1, 1689])
def test_the_band_is_that_of_chi_square(count: int) -> None:
    """95 % of the mean of n squared normals lies in it, the rest equally on both sides."""
    low, high = chi_square_band(count)
    assert (low, high) == pytest.approx(tuple(stats.chi2.ppf([0.025, 0.975], count) / count), rel=1e-9)


@pytest.mark.parametrize(("count", "lags"), [(500, 20), (15, 20)])
def test_ljung_box_against_loops(count: int, lags: int) -> None:
    """Autocorrelations and Q summed term by term; a series shorter than the lags has one lag less than values."""
    values = np.random.default_rng(count).standard_normal(count).cumsum() + 3.0
    centred = [value - sum(values) / count for value in values]
    power = sum(c * c for c in centred)
    wanted = [
        sum(centred[i] * centred[i + lag] for i in range(count - lag)) / power
        for lag in range(1, min(lags, count - 1) + 1)
    ]
    statistic = count * (count + 2) * sum(r * r / (count - lag) for lag, r in enumerate(wanted, 1))
    correlation, p = ljung_box(values, lags)
    assert correlation == pytest.approx(wanted, abs=1e-12)
    assert p == pytest.approx(stats.chi2.sf(statistic, len(wanted)), rel=1e-6, abs=1e-300)


@pytest.mark.parametrize("values", [[0.3], [0.3, 0.3, 0.3]])
def test_ljung_box_of_what_does_not_vary_accuses_nobody(values: list[float]) -> None:
    """One value, or equal ones, cannot be distinguished from white: p = 1 and no correlation."""
    correlation, p = ljung_box(np.array(values))
    assert not correlation.any()
    assert p == 1.0


def test_log_likelihood_is_the_joint_density_of_the_measurements() -> None:
    """Gates off, it is the log density of all measurements in mm as one dense Gaussian: offset walk plus noise."""
    run = recorded(process=0.0, moved=np.zeros_like, seconds=1.0)
    still = {axis: pf.Process(input_noise=0.0, drift=0.3e-3) for axis in run.axes}
    known = changed(config(run), process=still, arm=changed(config(run).arm, delay=3.0))
    est = pf.fuse(run, known)
    time = est.measurements.of("camera", "a").time
    covariance = 2e-3**2 + 0.3e-3**2 * np.minimum.outer(time, time) + SD**2 * np.eye(len(time))
    density = stats.multivariate_normal(np.zeros(len(time)), covariance * 1e6)
    wanted = sum(density.logpdf(run.sensors["camera"].values[axis] * 1e3) for axis in run.axes)
    assert log_likelihood(est.measurements, known.sensors) == pytest.approx(wanted, rel=1e-9)


def test_a_rejected_component_costs_as_much_as_one_at_the_gate() -> None:
    """−½(ln 2πS + gate²) for each rejected component, −½(ln 2πS + ν²/S) for each other: normal densities in mm."""
    run = recorded(axes="a", seconds=6.0)
    wild = np.arange(len(run.sensors["camera"].stamp)) % 20 == 10
    run.sensors["camera"].values["a"][wild] += 0.05
    est = pf.fuse(run, config(run, gate=6.0))
    used, sd = est.measurements, est.measurements.innovation_sd * 1e3
    at = np.where(wild, 6.0 * sd, used.innovation * 1e3)
    assert log_likelihood(used, est.config.sensors) == pytest.approx(stats.norm.logpdf(at, 0.0, sd).sum(), rel=1e-9)


@pytest.fixture(scope="module")
def matched() -> dict[str, Consistency]:
    """Consistency of a filter with the true configuration, for each of 120 seeds."""
    run = recorded(axes=[f"axis{number}" for number in range(SEEDS)], seconds=6.3)
    return judged(run, config(run))


def test_the_nis_of_a_right_filter_lies_in_its_band(matched: dict[str, Consistency]) -> None:
    """In 95 % of the seeds, and its mean over all of them is 1 within 3 standard errors."""
    inside = sum(found.nis_band[0] <= found.nis <= found.nis_band[1] for found in matched.values())
    assert stats.binom.cdf(inside, SEEDS, 0.95) > 0.005
    assert stats.binom.sf(inside - 1, SEEDS, 0.95) > 0.005
    assert {found.count for found in matched.values()} == {300}
    assert np.mean([found.nis for found in matched.values()]) == pytest.approx(1.0, abs=3 * math.sqrt(2 / 300 / SEEDS))


def test_the_innovations_of_a_right_filter_are_white(matched: dict[str, Consistency]) -> None:
    """Ljung-Box p > 0.01 in 99 % of the seeds and p evenly spread; 95 % of the correlations lie in their band."""
    p = np.array([found.whiteness for found in matched.values()])
    assert stats.binom.sf(int((p <= 0.01).sum()) - 1, SEEDS, 0.01) > 0.005
    assert stats.kstest(p, "uniform").pvalue > 0.005
    within = [np.abs(found.correlation) <= found.correlation_band for found in matched.values()]
    assert np.mean(within) == pytest.approx(0.95, abs=0.015)
    assert all(len(found.correlation) == LAGS for found in matched.values())


def test_a_right_filter_is_called_consistent(matched: dict[str, Consistency]) -> None:
    """In at least nine seeds of ten; none is blamed on latency or colour."""
    verdicts = [sentence(found) for found in matched.values()]
    assert sum(verdict.endswith(": consistent") for verdict in verdicts) >= 0.9 * SEEDS
    assert not any("latency_ms" in verdict for verdict in verdicts)


@pytest.fixture(scope="module")
def moving() -> pf.Run:
    """Six axes on the move for 18 s."""
    return recorded(axes="abcdef", seconds=18.0, told=swing)


@pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
def test_a_verdict_on_what_a_gate_has_left_says_so(moving: pf.Run) -> None:
    """With a third of the noise and a gate of 2 the rest fits by selection: the verdict is how many were rejected."""
    for axis, found in judged(moving, config(moving, sd=SD / 3.0, gate=2.0)).items():
        assert re.search(r"but \d\d% were rejected", sentence(found)), (axis, sentence(found))


def test_the_verdict_on_smoothed_estimates_needs_no_velocity_of_theirs(moving: pf.Run) -> None:
    """They have none; a latency 30 ms too long is still found on every axis."""
    est = pf.fuse(moving, config(moving, latency=0.050), mode="smoothed")
    for axis in est.axes:
        assert re.search("is (29|30|31).* ms too large", sentence(consistency(est, "camera", axis)))


@pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
@pytest.mark.parametrize(("sds", "said", "prior"), [(2e6, True, "bias_sd"), (0.5e6, False, "offset_sd")])
def test_a_prior_too_wide_for_double_precision_is_said(moving: pf.Run, prior: str, sds: float, said: bool) -> None:
    """Of the offset or of a bias, more than a million times the noise."""
    known = config(moving)
    if prior == "bias_sd":
        known = config(moving, bias_sd=sds * SD)
    else:
        known = changed(known, start=pf.Start(offset_sd=sds * SD))
    notes = [note for note in pf.fuse(moving, known).notes if note.startswith("camera: its prior")]
    assert len(notes) == said
    assert all("is 2.0e+06 times its noise" in note for note in notes)


# From a share of 0.999 on scipy's own inverse is up to 1e-6 off, at millions of degrees of freedom.
@given(st.integers(1, 10_000_000), st.floats(1e-6, 0.999), st.floats(0.0, 30.0))
def test_chi_square_is_scipys(degrees: int, share: float, times: float) -> None:
    """Quantiles to 1e-10, and the tail to 1e-7 of itself wherever a double holds it."""
    assert chi_square.upper_quantile(degrees, share) == pytest.approx(chdtri(degrees, share), rel=1e-10)
    for x in (degrees * times, chdtri(degrees, share)):
        assert chi_square.tail(degrees, x) == pytest.approx(chdtrc(degrees, x), rel=1e-7, abs=1e-290)
