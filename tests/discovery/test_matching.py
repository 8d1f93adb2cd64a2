"""Which commands a sensor follows: the sums by transforms against least squares, and peaks that stand for nothing.

Another zero is told apart from a wrong gain, a wrong lag, noise and drift; motion of its own from noise.
"""

from collections.abc import Mapping

import numpy as np
import pytest

from pumafuse.arrays import FloatArray
from pumafuse.discovery.matching import Grid, Tracking, _fits, matches, slope_of_pieces, without_spikes

SECOND = 1_000_000_000
TIME = np.arange(0.0, 60.0, 0.12)
LATER = 0.15  # s, between where the commands lead and where they had led


def smooth(rng: np.random.Generator, count: int) -> FloatArray:
    return np.convolve(rng.standard_normal(count + 40), np.hanning(41), mode="valid")


def test_a_regression_at_a_shift_is_that_of_least_squares() -> None:
    """Slope and correlation beside a constant and a trend, of the bins that have measurements."""
    rng, margin, size = np.random.default_rng(1), 30, 200
    led = np.stack([smooth(rng, size + 2 * margin), 3.0 + np.arange(size + 2.0 * margin) ** 2 * 1e-3])
    measured = smooth(rng, size) + 5.0 - 0.02 * np.arange(size)
    measured[rng.random(size) < 0.3] = np.nan
    fits = _fits(measured, led - led.mean(axis=1, keepdims=True), margin)
    seen = np.isfinite(measured)
    for axis in (0, 1):
        for shift in (-30, -7, 0, 12, 30):
            moved = led[axis, margin - shift : margin - shift + size][seen]
            beside = np.stack([np.ones(size), np.arange(size)], axis=1)[seen]
            (slope, *_), (left,), *_ = np.linalg.lstsq(np.column_stack([moved, beside]), measured[seen], rcond=None)
            _, (alone,), *_ = np.linalg.lstsq(beside, measured[seen], rcond=None)
            assert fits.slope[axis, margin + shift] == pytest.approx(slope, rel=1e-6)
            assert fits.correlation[axis, margin + shift] ** 2 == pytest.approx(1.0 - left / alone, rel=1e-6, abs=1e-9)
            assert np.sign(fits.correlation[axis, margin + shift]) == np.sign(slope)


@pytest.mark.parametrize("shift", [-2.0, 0.31])
def test_a_shift_is_found_between_the_bins(shift: float) -> None:
    """To a hundredth of a second, with bins of 28 ms and a sensor of 20 Hz."""
    rng = np.random.default_rng(2)
    grid = Grid.over(0, 60 * SECOND, 0.028)
    time = grid.time / 1e9
    motion = np.interp(np.arange(-60.0, 120.0, 0.5), np.arange(-60.0, 120.0, 0.5), rng.standard_normal(360))

    def at(when: FloatArray) -> FloatArray:
        return np.interp(when, np.arange(-60.0, 120.0, 0.5), motion)

    stamp = np.arange(0.0, 60.0, 0.05)
    seen = grid.mean(np.rint(stamp * 1e9).astype(np.int64), at(stamp - shift))
    found = matches({"x": seen}, {"x": at(time), "y": at(time[::-1])}, grid)["x"]
    assert (found.axis, found.is_steady) == ("x", True)
    assert found.shift == pytest.approx(shift, abs=0.01)
    assert found.slope == pytest.approx(1.0, abs=0.02) and found.correlation > 0.99


def test_the_mean_of_a_bin_is_of_what_is_in_it() -> None:
    """Measurements at a bin's edges and outside of all bins."""
    grid = Grid.over(SECOND, 2 * SECOND, 0.1)
    stamp = np.array([SECOND - 1, SECOND, SECOND + 99_999_999, SECOND + 100_000_000, 2 * SECOND - 1, 9 * SECOND])
    mean = grid.mean(stamp, np.array([9.0, 1.0, 2.0, 5.0, 7.0, 9.0]))
    assert mean[[0, 1, 9]].tolist() == [1.5, 5.0, 7.0] and np.isnan(mean[2:9]).all()


def test_spikes_are_found_and_motions_are_none() -> None:
    """One or two in a row, of noise; not a ramp in a log that rests, nor a motion from end to end."""
    rng = np.random.default_rng(3)
    noise, spiked = rng.normal(0.0, 1e-3, 500), [7, 100, 101, 499]
    wild = noise.copy()
    wild[spiked] += 1.0
    assert np.flatnonzero(~without_spikes(wild)).tolist() == spiked
    ramp = noise + np.clip(np.arange(500) - 400, 0, 20)
    assert without_spikes(ramp).all() and without_spikes(rng.choice([0.0, 1.0], 500) + noise).all()


def test_a_drift_is_not_steady_and_a_motion_is() -> None:
    """Both correlate with a slow command; in short pieces only one of them does."""
    rng, time = np.random.default_rng(4), np.arange(2000.0)
    led = np.sin(time / 80.0) + np.sin(time / 500.0)
    drift = 30.0 * np.sin(time / 500.0) + led + rng.normal(0.0, 0.1, 2000)
    slope, error = slope_of_pieces(drift, led)
    assert abs(slope) < 12.0 and error < 3.0
    slope, error = slope_of_pieces(5.0 * led + rng.normal(0.0, 0.1, 2000), led)
    assert slope == pytest.approx(5.0, rel=0.01) and error < 0.05
    assert slope_of_pieces(led, np.zeros(2000)) == (0.0, np.inf)


def motion(time: FloatArray) -> FloatArray:
    """From rest at 0 to and fro, 0.3 m wide."""
    return 0.1 * (1.0 - np.cos(0.7 * time)) + 0.05 * np.sin(1.9 * time)


def tracking(measured: FloatArray, led: FloatArray | None = None, **more: float) -> Tracking:
    known: Mapping[str, float] = {"noise": 5e-4, "zero_sd": 2e-3, "drift": 1e-3, **more}
    return Tracking(TIME, measured, motion(TIME) if led is None else led, motion(TIME - LATER), **known)


@pytest.mark.parametrize(("zero", "gain", "late"), [(0.05, 1.3, 0.0), (-0.2, 0.9, -0.05)])
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
