"""The search for an arm: odds and quantiles are those of a brute-force integral over all arms."""

import math

import numpy as np
import pytest
from scipy.special import logsumexp

from pumafuse.filter.response import response
from pumafuse.tuning.arm_search import ArmSearch, Freedom
from pumafuse.tuning.arms import Arm, Measured, Recording
from pumafuse.tuning.posterior import chosen_model

T = 0.02
TRUE = Arm(0.07, 0.06)
LONGEST, LAGS = 0.6, math.log(2e3)  # s, of a dead time; range of the logarithm of a lag: uniform priors
GAIN_SD = 0.1


def measured(seed: int, gain: float = 1.0, noise: float = 2e-3) -> Measured:
    """Steps and ramps, by a sensor of 12 Hz."""
    rng = np.random.default_rng(seed)
    given = np.arange(1000) * round(T * 1e9)
    speed = np.repeat(rng.normal(0.0, 0.05, 40), 25)
    command = 0.5 + np.cumsum(speed * T) + np.cumsum((rng.random(1000) < 0.01) * rng.normal(0.0, 0.02, 1000))
    time = np.sort(rng.integers(0, given[-1], 250))
    true = TRUE._replace(gain=gain)
    moved = response(true.model, T, true.delay, given, command, 0.5, time)
    value = moved + rng.normal(0.0, noise, 250)
    one = Recording(given, command, 0.5, time, value, np.zeros(250, dtype=np.int64), np.ones(250))
    return Measured([one], T, ["camera"])


@pytest.fixture(scope="module")
def search() -> ArmSearch:
    freedom = Freedom(Arm(0.0, 0.1), orders=(1,), gains=("given", "static"))
    return ArmSearch(measured(1), freedom, [1e-6])


def table(search: ArmSearch, gain: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The log-likelihood over dead times and logarithms of lags, and both."""
    delays, lags = np.linspace(0.04, 0.105, 66), np.linspace(math.log(0.02), math.log(0.11), 61)
    arms = [Arm(delay, math.exp(lag), gain=gain) for delay in delays.tolist() for lag in lags.tolist()]
    log, _ = measured(1).weighed(arms, search.noise)
    return log.reshape(len(delays), len(lags)), delays, lags


@pytest.mark.long
def test_odds_of_models_are_those_of_the_integrals(search: ArmSearch) -> None:
    """A gain of 1 against one that is 1 ± 0.1: ∫ L over dead time and lag, and over the gain, too; to 0.3."""
    log, delays, lags = table(search, 1.0)
    cell = math.log((delays[1] - delays[0]) * (lags[1] - lags[0]) / (LONGEST * LAGS))
    gains = np.linspace(0.97, 1.03, 31)
    along = [logsumexp(table(search, gain)[0]) - 0.5 * ((gain - 1.0) / GAIN_SD) ** 2 for gain in gains.tolist()]
    width = math.log((gains[1] - gains[0]) / (GAIN_SD * math.sqrt(2.0 * math.pi)))
    odds = (logsumexp(along) + cell + width) - (logsumexp(log) + cell)
    assert search.posterior.mixture().log_odds(lambda one: one.gain == "static") == pytest.approx(odds, abs=0.3)


def test_quantiles_are_those_of_the_integral(search: ArmSearch) -> None:
    """95 % of dead time and of lag, under a gain of 1, to a twelfth of their width."""
    log, delays, lags = table(search, 1.0)
    weight = np.exp(log - log.max())
    totals = delays[:, None] + np.exp(lags)
    for name, values in (("delay", np.broadcast_to(delays[:, None], log.shape)), ("lag", totals)):
        order = np.argsort(values, axis=None)
        below = np.cumsum(weight.ravel()[order]) / weight.sum()
        ends = np.interp([0.025, 0.975], below, values.ravel()[order])
        found = search.posterior.mixture().quantiles(name, lambda one: one.gain == "given")
        assert found == pytest.approx(ends.tolist(), abs=(ends[1] - ends[0]) / 12.0), name


def test_the_noise_that_is_likely_is_what_second_differences_show(search: ArmSearch) -> None:
    """Of what the best arm leaves where it is calm; here that is the white noise of the sensor, to a tenth."""
    entries = [one for branch in search.posterior.branches for one in branch.entries]
    arm, one = max(entries, key=lambda entry: entry.log_density).arm, measured(1).recordings[0]
    path = response(arm.model, T, arm.delay, one.stamp, one.command, one.start, one.time)
    ways = np.ptp(np.lib.stride_tricks.sliding_window_view(path, 3), axis=1)
    calm = ways <= np.quantile(ways, 1.0 / 3.0)
    shown = np.median(np.abs(np.diff(one.value - path, 2))[calm]) / (0.6745 * np.sqrt(6.0))
    assert search.likely_noise == pytest.approx({"camera": shown}, rel=0.02)


@pytest.mark.parametrize(("gain", "kind"), [(1.0, "given"), (2.0, "static")])
def test_the_simplest_arm_that_is_likely_is_taken(gain: float, kind: str) -> None:
    """First order in all; a gain is found to a hundredth of itself."""
    found = ArmSearch(measured(2, gain, 2e-3 * gain), Freedom(Arm(0.0, 0.1)), [1e-6])
    mixture = found.posterior.mixture()
    model = chosen_model(mixture)
    assert (model.order, model.gain) == (1, kind)
    low, high = mixture.quantiles("lag", lambda _: True)
    assert low < TRUE.total < high < low + 0.02
    assert found.arm(model).gain == pytest.approx(gain, rel=0.01)


def test_a_walk_ends_where_the_likelihood_has_fallen(search: ArmSearch) -> None:
    """Both ends of every branch of a model that counts are at least 5 below its top, or at a dead time of 0."""
    top = max(float(branch.log_density.max()) for branch in search.posterior.branches)
    for branch in search.posterior.branches:
        if branch.log_density.max() > top - 1.0:
            assert branch.log_density[0] < branch.log_density.max() - 5.0 or branch.delays[0] == 0.0
            assert branch.log_density[-1] < branch.log_density.max() - 5.0
