"""Another zero is told apart from a wrong gain, a wrong lag, noise and drift; motion of its own from noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from pumafuse.arrays import FloatArray
from pumafuse.discovery.tracking import Tracking

TIME = np.arange(0.0, 60.0, 0.12)
LATER = 0.15  # s, between where the commands lead and where they had led


def motion(time: FloatArray) -> FloatArray:
    """From rest at 0 to and fro, 0.3 m wide."""
    return 0.1 * (1.0 - np.cos(0.7 * time)) + 0.05 * np.sin(1.9 * time)


def tracking(measured: FloatArray, led: FloatArray | None = None, **more: float) -> Tracking:
    known: Mapping[str, float] = {"noise": 5e-4, "zero_sd": 2e-3, "drift": 1e-3, **more}
    return Tracking(TIME, measured, motion(TIME) if led is None else led, motion(TIME - LATER), **known)


@pytest.mark.parametrize("zero", [0.05, -0.2])
@pytest.mark.parametrize(("gain", "late"), [(1.0, 0.0), (0.8, 0.0), (1.3, 0.0), (1.0, 0.05), (0.9, -0.05)])
def test_the_zero_is_the_constant_beside_gain_and_lag(zero: float, gain: float, late: float) -> None:
    """With its sign, to a few mm; without another zero there is none."""
    rng = np.random.default_rng(1)
    measured = gain * motion(TIME - late) + rng.normal(0.0, 5e-4, len(TIME))
    assert tracking(measured + zero).zero == pytest.approx(zero, abs=5e-3)
    assert tracking(measured).zero == 0.0


def test_what_priors_or_wandering_explain_is_no_zero() -> None:
    """Three and a half standard deviations of the priors; a random walk as far as 0.1 m."""
    rng = np.random.default_rng(2)
    noise = rng.normal(0.0, 5e-4, len(TIME))
    assert tracking(motion(TIME) + 0.05 + noise, zero_sd=0.05 / 3.4).zero == 0.0
    assert tracking(motion(TIME) + 0.05 + noise, zero_sd=0.05 / 3.7).zero != 0.0
    for seed in range(20):
        walk = np.cumsum(np.random.default_rng(seed).normal(0.0, 0.01, len(TIME)))
        assert tracking(motion(TIME) + walk + noise).zero == 0.0


def test_motion_while_the_commands_rest_is_neither_noise_nor_drift() -> None:
    """Its range is told; nothing of noise that is larger than told, nor of a walk that is expected."""
    rng, rest = np.random.default_rng(3), np.zeros(len(TIME))
    moved = tracking(motion(TIME) + rng.normal(0.0, 5e-4, len(TIME)), rest)
    assert moved.own_motion == pytest.approx(np.ptp(motion(TIME)), abs=3e-3)
    assert tracking(rng.normal(0.0, 0.05, len(TIME)), rest).own_motion == 0.0
    walk = np.cumsum(rng.normal(0.0, 0.02 * np.sqrt(0.12), len(TIME)))
    assert tracking(walk, rest, drift=0.02).own_motion == 0.0
    assert tracking(motion(TIME)).own_motion == 0.0  # as commanded
