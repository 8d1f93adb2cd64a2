"""The paper's own method: what is read off, and equation 10 at its least with that given."""

from dataclasses import replace

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.identification.fit import StepFit, fit_steps
from pumafuse.identification.paper import fit_as_published, onset
from pumafuse.identification.trials import Trial
from pumafuse.model.plants import unit_response

TIMES = np.arange(60) * 0.00563  # s
SWINGING = (2 * 0.864 / 53.9, 53.9**-2)


def trial(seed: int, step: float = 0.008, delay: float = 0.0604, noise: float = 5e-5) -> Trial:
    rng = np.random.default_rng(seed)
    position = 0.0003 + 1.02 * step * unit_response(TIMES - delay, *SWINGING)
    return Trial(str(seed), "tip", step, 0.28, {}, TIMES, position + noise * rng.standard_normal(len(TIMES)))


def equation_10(one: Trial, read: StepFit, q: float, p: float) -> float:
    model = read.zero + read.gain * one.step * unit_response(one.time - read.shape.delay, q, p)
    return float(np.sqrt(np.mean((one.position - model) ** 2)))


@pytest.mark.parametrize("step", [0.008, -0.008])
def test_the_onset_is_the_first_sample_that_is_away(step: float) -> None:
    """By more than 3 standard deviations and 2 % of the step, either way; written out sample by sample."""
    one = trial(1, step)
    level, sd = np.mean(one.position[:5]), np.std(one.position[:5], ddof=1)
    away = [abs(z - level) > max(3 * sd, 0.02 * abs(step)) for z in one.position]
    assert onset(one) == TIMES[away.index(True)]
    assert 0.0604 < onset(one) < 0.0604 + 0.015
    assert np.isnan(onset(replace(one, position=np.full(60, 0.001))))


def test_gain_delay_and_zero_are_those_that_are_read() -> None:
    """The last three samples over the step, the onset, the rest level; the plant is that of the least eq. 10."""
    one = trial(2)
    for order, fitted in enumerate(fit_steps([one])[0], 1):
        fit = fit_as_published(one, fitted)
        zero = np.mean(one.position[:5])
        assert fit.zero == pytest.approx(zero, rel=1e-12)
        assert fit.gain == pytest.approx((np.mean(one.position[-3:]) - zero) / one.step, rel=1e-12)
        assert fit.shape.delay == onset(one)
        assert fit.rms == pytest.approx(equation_10(one, fit, fit.shape.q, fit.shape.p), rel=1e-9)
        ratios = [0.0] if order == 1 else [0.0, *np.geomspace(0.02, 3.0, 60)]
        grid = [equation_10(one, fit, q, r * q * q) for q in np.geomspace(0.005, 0.1, 200) for r in ratios]
        assert fit.rms <= min(grid) * (1.0 + 1e-9)


def test_a_factor_called_radius_limits_the_arm_in_its_own_unit() -> None:
    """Trials beyond 700 mm that go another way: max_radius lies between the levels, in metres in Python."""
    trials = []
    for number in range(16):
        radius = (350, 500, 650, 800)[number % 4]
        made = trial(number, 0.008)
        odd = 0.0005 * np.sin(40.0 * TIMES) * (radius > 700)
        trials.append(replace(made, factors={"radius_mm": str(radius)}, position=made.position + odd))
    limit = pf.identify(pf.StepTrials(tuple(trials), ()), period=0.028, tolerance=2e-4).arm.validity.max_radius
    assert limit is not None and 0.65 < limit < 0.80
