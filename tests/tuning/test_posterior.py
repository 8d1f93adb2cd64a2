"""The posterior over models and delays: its quantiles, shared delays, and that it finds what was simulated."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from pumafuse.tuning.arms import Arm
from pumafuse.tuning.posterior import (
    MODELS,
    QUANTITIES,
    AxisPosterior,
    Branch,
    Entry,
    Mixture,
    Model,
    chosen_model,
    shared_delay,
    sharing,
)

FIRST, SECOND = Model(1, "given"), Model(2, "static")


def branch(delay: float, sd: float, height: float = 0.0, model: Model = FIRST, lag_sd: float = 1e-3) -> Branch:
    """A Gaussian density of the delay, with a lag of 0.1 s that does not depend on it."""
    at = delay + sd * np.linspace(-5.0, 5.0, 41)
    log = height + norm.logpdf(at, delay, sd)
    pairs = zip(at.tolist(), log.tolist(), strict=True)
    entries = [Entry(Arm(t, 0.1 - t), one, {"lag": 0.1, "delay": t}, {"lag": lag_sd, "delay": 0.0}) for t, one in pairs]
    return Branch(model, entries)


def test_quantiles_of_one_maximum_are_those_of_its_density() -> None:
    """A normal density of the delay: 1.96 standard deviations each way, and the lag's own."""
    found = AxisPosterior([branch(0.08, 2e-3)]).mixture()
    assert found.quantiles("delay", lambda _: True) == pytest.approx((0.08 - 1.96 * 2e-3, 0.08 + 1.96 * 2e-3), abs=3e-5)
    assert found.quantiles("lag", lambda _: True) == pytest.approx((0.1 - 1.96e-3, 0.1 + 1.96e-3), abs=1e-5)
    assert found.weight.sum() == pytest.approx(1.0)


def test_quantiles_over_models_are_those_of_the_mixture() -> None:
    """Two models with odds of 3 to 1: the ends solve 0.75 Φ₁ + 0.25 Φ₂ = 2.5 % and 97.5 %."""
    posterior = AxisPosterior([branch(0.08, 2e-3, math.log(3.0)), branch(0.09, 4e-3, 0.0, SECOND)])
    ends = posterior.mixture().quantiles("delay", lambda _: True)
    below = [0.75 * norm.cdf(end, 0.08, 2e-3) + 0.25 * norm.cdf(end, 0.09, 4e-3) for end in ends]
    assert below == pytest.approx([0.025, 0.975], abs=2e-3)


def test_axes_that_agree_share_a_delay_and_others_do_not() -> None:
    """Delays 1 ms apart, known to 2 ms, are one; one that is 20 ms away is another; at most one is told apart."""
    near = {name: AxisPosterior([branch(at, 2e-3)]) for name, at in (("a", 0.080), ("b", 0.081), ("c", 0.1))}
    assert sharing(near)[0] == ["a", "b"]
    assert sharing({name: near[name] for name in "ac"})[0] == []
    assert sharing({"a": near["a"]})[0] == []


def test_an_own_delay_is_worth_what_the_evidence_gains() -> None:
    """Two axes known to 1 ms and 1 ms apart: ∫ p₁p₂ of normal densities, times 50 ms and the ten to one of sharing."""
    pair = {name: AxisPosterior([branch(at, 1e-3)]) for name, at in (("a", 0.080), ("b", 0.081))}
    shared = norm.logpdf(1e-3, 0.0, math.sqrt(2.0) * 1e-3) + math.log(0.05) + 2.3
    assert sharing(pair)[1] == pytest.approx({"a": -shared, "b": -shared}, abs=0.05)


def test_a_shared_delay_weighs_the_axes_by_what_they_know() -> None:
    """The product of two normal densities: the mean weighted by 1/sd²."""
    posteriors = [AxisPosterior([branch(0.080, 1e-3)]), AxisPosterior([branch(0.083, 2e-3)])]
    assert shared_delay(posteriors) == pytest.approx((0.080 / 1.0 + 0.083 / 4.0) / 1.25, abs=2e-5)
    together = posteriors[1].mixture([posteriors[0]]).quantiles("delay", lambda _: True)
    assert together[1] - together[0] == pytest.approx(2.0 * 1.96 * 1e-3 / math.sqrt(1.25), rel=0.02)


def test_a_dead_time_that_may_be_shared_is_a_mixture() -> None:
    """One to three that it is an axis's own: the ends solve ¾ Φ of both axes + ¼ Φ of its own = 2.5 % and 97.5 %."""
    wide, narrow = AxisPosterior([branch(0.083, 4e-3)]), AxisPosterior([branch(0.080, 1e-3)])
    ends = wide.mixture([narrow], 0.75).quantiles("delay", lambda _: True)
    middle, sd = (0.083 / 16.0 + 0.080) / (1.0 / 16.0 + 1.0), 1e-3 / math.sqrt(1.0 + 1.0 / 16.0)
    below = [0.75 * norm.cdf(end, middle, sd) + 0.25 * norm.cdf(end, 0.083, 4e-3) for end in ends]
    assert below == pytest.approx([0.025, 0.975], abs=3e-3)


def test_the_simplest_of_the_likely_models_is_taken() -> None:
    """A model that is a fifth as likely as the best is preferred where it has fewer numbers, a less likely one not."""

    def mixture(share: float) -> Mixture:
        weight = np.array([share, 1.0 - share])
        model = np.array([MODELS.index(FIRST), MODELS.index(SECOND)], dtype=np.float64)
        none = {name: np.zeros(2) for name in QUANTITIES}
        return Mixture(weight, model, np.zeros(2), none, none, np.zeros(2, dtype=np.int64))

    assert chosen_model(mixture(0.3)) == FIRST
    assert chosen_model(mixture(0.1)) == SECOND
