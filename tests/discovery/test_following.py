"""Lag, gain and level of one signal behind another, against signals that were made with known ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from pumafuse.arrays import FloatArray, TimeArray
from pumafuse.discovery.following import following, resolution


def path(t: FloatArray) -> FloatArray:
    """A smooth motion that does not repeat within a minute [m]."""
    t = np.maximum(t, 0.0)
    return 0.1 * (1.0 - np.cos(0.9 * t)) + 0.04 * np.sin(2.3 * t + 0.4 * np.sin(0.17 * t))


def stamped(t: FloatArray) -> TimeArray:
    return 1_790_000_000_000_000_000 + np.rint(t * 1e9).astype(np.int64)


@settings(max_examples=25)
@given(
    lag=st.floats(-0.3, 0.8),
    gain=st.one_of(st.floats(0.5, 2.0), st.floats(-2.0, -0.5)),
    level=st.floats(-1.0, 1.0),
    rate=st.sampled_from([5.0, 28.0, 100.0]),
    seed=st.integers(0, 99),
)
def test_lag_gain_and_level_are_found(lag: float, gain: float, level: float, rate: float, seed: int) -> None:
    """Within the noise, whatever rate, sign and offset; 1 % of outliers do not matter."""
    draw = np.random.default_rng(seed)
    t, s = np.arange(0.0, 40.0, 0.02), np.arange(1.0, 39.0, 1.0 / rate)
    z = gain * path(s - lag) + level + draw.normal(scale=3e-4, size=len(s))
    z[draw.choice(len(s), len(s) // 100, replace=False)] += 0.02
    found = following((stamped(t), path(t)), (stamped(s), z))
    assert found.lag == pytest.approx(lag, abs=0.006 if rate > 5.0 else 0.015)  # 190 measurements
    assert found.slope == pytest.approx(gain, rel=0.02)
    assert abs(found.correlation) > 0.95
    if rate > 5.0:
        assert 2e-4 < found.scatter < 5e-4
    all_along = float(np.median(z - np.sign(gain) * path(s - lag)))
    about_one = 0.8 < abs(found.slope) < 1.25  # else the level where the motion begins, at 0
    assert found.offset == pytest.approx(all_along if about_one else level, abs=2e-3 if about_one else 4e-3)


@pytest.mark.parametrize("each", [5, 20])
def test_a_value_that_is_repeated_is_no_news(each: int) -> None:
    """Of a sensor of 20 or 5 Hz in a log of 100 Hz: how late it is when it is new, not half an interval more."""
    t = np.arange(0.0, 24.0, 0.01)
    z = path(t - 0.06)[np.arange(len(t)) // each * each]
    found = following((stamped(t), path(t)), (stamped(t), z))
    assert found is not None and found.correlation > 0.98
    assert found.lag == pytest.approx(0.06, abs=0.005)


def test_an_axis_that_a_stop_holds_off_is_not_early() -> None:
    """Up and some way back in 6 s, and an arm that stays where it stops: it follows later, not 0.02 to 0.2 s sooner.

    By how much, 0.1 s, such a motion hardly tells.
    """
    t, s = np.arange(0.0, 6.0, 0.005), np.arange(0.02, 5.9, 0.027)

    def told(time: FloatArray) -> FloatArray:
        return np.where(time < 3.0, 0.5 * (1.0 - np.cos(np.pi * time / 3.0)), 1.0 - 0.1 * (time - 3.0))

    z = np.minimum(0.8 * told(np.maximum(s - 0.1, 0.0)), 0.44)
    z += np.random.default_rng(4).normal(scale=3e-3, size=len(s))
    found = following((stamped(t), told(t)), (stamped(s), z), is_moved=True)
    assert 0.0 <= found.lag < 0.2
    early = following((stamped(t), told(t)), (stamped(s), 0.8 * told(s + 0.1)), is_moved=True)  # by another clock
    assert early is not None and early.lag == pytest.approx(-0.1, abs=0.01)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_curve_that_explains_no_more_is_not_believed(seed: int) -> None:
    """One slow stroke by a clock that is 0.1 s ahead: with another curve any lag explains it, and it stays early."""
    t, s = np.arange(0.0, 6.0, 0.005), np.arange(0.2, 5.7, 0.027)
    z = 0.5 * (1.0 - np.cos(np.pi * (s + 0.1) / 6.0)) + np.random.default_rng(seed).normal(scale=0.01, size=len(s))
    found = following((stamped(t), 0.5 * (1.0 - np.cos(np.pi * t / 6.0))), (stamped(s), z), is_moved=True)
    assert found is not None and found.lag == pytest.approx(-0.1, abs=0.05)


def test_a_motion_that_is_a_small_part_of_a_run_is_no_outlier() -> None:
    """0.6 s in a minute of rest, with a lag of 50 ms: what a shift leaves of it is far beyond the noise at rest."""
    t = np.arange(0.0, 60.0, 0.01)
    late = np.maximum(t - 30.1, 0.0)
    ramp = late - 0.05 * (1.0 - np.exp(-late / 0.05))
    end = ramp[np.argmax(late >= 0.6)]
    z = 0.1 * np.where(late < 0.6, ramp, 0.6 - (0.6 - end) * np.exp(-(late - 0.6) / 0.05))
    noise = np.random.default_rng(2).normal(scale=1e-5, size=len(t))
    found = following((stamped(t), 0.1 * np.clip(t - 30.0, 0.0, 0.6)), (stamped(t), z + noise))
    assert found.lag == pytest.approx(0.15, abs=0.01)
    assert found.correlation > 0.99
    assert found.slope == pytest.approx(1.0, abs=0.02)


def test_values_come_in_steps_or_do_not() -> None:
    """An encoder's do, whatever text they were in; noise does not, and of a few levels nothing can be told."""
    motion = path(np.arange(0.0, 40.0, 0.01))
    counts = np.rint(motion / 1e-4)
    assert resolution(1e-4 * counts) == pytest.approx(1e-4 / np.sqrt(12.0), rel=1e-6)
    assert resolution(np.array([float(f"{one:.4f}") for one in motion])) == pytest.approx(1e-4 / np.sqrt(12.0))
    assert resolution(motion + np.random.default_rng(1).normal(scale=1e-4, size=len(motion))) == 0.0
    assert resolution(np.repeat([0.0, 0.1, 0.2], 100)) == 0.0


def test_counts_that_were_rounded_for_a_log_have_the_resolution_of_a_count() -> None:
    """Steps of 0.04 and 0.05 are of 0.044, in radians too, not none, nor 0.01."""
    motion = 30.0 * np.sin(0.01 * np.arange(6000)) + 5.0 * np.sin(0.023 * np.arange(6000))
    logged = np.round(0.044 * np.rint(motion / 0.044), 2)
    for unit in (1.0, np.pi / 180.0):
        assert resolution(unit * logged) == pytest.approx(unit * 0.044 / np.sqrt(12.0), rel=0.01)


def test_of_a_periodic_motion_the_shortest_lag_counts() -> None:
    """A sine fits at every period, and upside down at every half of one."""
    t = np.arange(0.0, 30.0, 0.01)
    u, z = np.sin(2.0 * np.pi * t / 0.5), np.sin(2.0 * np.pi * (t - 0.08) / 0.5)
    found = following((stamped(t), u), (stamped(t), z))
    assert found.lag == pytest.approx(0.08, abs=0.002)
    assert found.slope == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("late", [0.25, 0.4, 0.5])
def test_of_steps_that_are_held_long_no_shorter_lag_counts(late: float) -> None:
    """Levels that are held for 20 s agree to 99 % at any lag; the one that leaves least is most of the arm's, not half.

    Of an arm that is a dead time and as much of a first order later, levels are nearest after 0.85 of both.
    """
    draw = np.random.default_rng(3)
    t, tau = np.arange(0.0, 180.0, 0.01), 0.5 * late
    u = np.repeat([0.0, 0.75, 0.38, 1.1, 0.56, 1.3, 0.94, 1.5, 0.19], 2000)
    z = lfilter([0.01 / tau], [1.0, 0.01 / tau - 1.0], np.pad(u, (round(tau / 0.01), 0))[: len(u)])
    found = following((stamped(t), u), (stamped(t), z + draw.normal(scale=1e-4, size=len(t))))
    assert 0.7 * late < found.lag < late


def test_outliers_are_counted_and_jerks_are_not() -> None:
    """A value that both neighbours contradict is an outlier; a step of the motion is none."""
    draw = np.random.default_rng(1)
    t = np.arange(0.0, 60.0, 0.02)
    steps = np.cumsum(draw.random(len(t)) < 0.01) % 2 * 0.05
    for share in (0.0, 0.02):
        z = np.interp(t - 0.1, t, path(t) + steps) + draw.normal(scale=1e-4, size=len(t))
        z[draw.random(len(t)) < share] += 0.03
        found = following((stamped(t), path(t) + steps), (stamped(t), z))
        assert found.outliers == pytest.approx(share, abs=0.004)


def test_what_cannot_be_compared_has_no_relation() -> None:
    """Other times, too few rows, or no motion: nothing, and no warning of numpy."""
    t = np.arange(0.0, 20.0, 0.02)
    u, still = path(t), np.zeros(len(t))
    assert following((stamped(t), u), (stamped(t) - 10**18, u)) is None
    assert following((stamped(t), u), (stamped(t)[:5], u[:5])) is None
    assert following((stamped(t), still), (stamped(t), u)) is None
    assert following((stamped(t)[:0], u[:0]), (stamped(t), u)) is None
    assert following((stamped(t), np.full(len(t), np.nan)), (stamped(t), u)) is None


def test_a_command_that_is_constant_but_for_rounding_leads_nothing() -> None:
    """The mean of 0.05 is not 0.05 to the last digit; what is left of it is no motion."""
    time = np.arange(0, 20_000_000_000, 20_000_000)
    rng = np.random.default_rng(3)
    for level in (0.05, 0.08, -1e-3, 0.0):
        constant, noise = np.full(len(time), level), level + rng.normal(0.0, 1e-4, len(time))
        assert following((time, constant), (time, noise)) is None
        assert following((time, noise), (time, constant)) is None


def test_of_a_run_that_mostly_rests_the_motion_tells_the_gain() -> None:
    """Steps in whole counts at 10 Hz: at rest, two rows of three, any gain would do, and 0.74 was found.

    It is 1; changes over half a second, of commands that are logged up to 0.1 s late, see 0.92 of it.
    """
    fine = 0.001 * np.arange(40_000)
    told = np.where((fine > 4.0) & ((fine - 4.0) % 3.0 < 1.0), 500.0, 0.0)
    moved = lfilter([1.0 / 110.0], [1.0, 1.0 / 110.0 - 1.0], np.append(np.zeros(190), told[:-190]))
    stamp = stamped(fine[::100])
    found = following((stamp, told[::100]), (stamp, np.rint(moved[::100])))
    assert found.slope == pytest.approx(0.92, abs=0.03)
    assert found.correlation > 0.98
    assert found.misfit > 10.0


@pytest.mark.parametrize("wanders", [True, False])
def test_a_lead_that_explains_no_more_is_none(wanders: bool) -> None:
    """By 15 ms, of an arm that wanders by 30 mm; beside noise of 0.2 mm it is a clock that is off."""
    t, draw = np.arange(0.0, 40.0, 0.02), np.random.default_rng(11)
    beside = 0.03 * np.sin(4.1 * t + np.sin(0.3 * t)) if wanders else draw.normal(scale=2e-4, size=len(t))
    found = following((stamped(t), path(t)), (stamped(t), path(t + 0.015) + beside))
    assert found is not None
    assert found.lag == pytest.approx(0.0 if wanders else -0.015, abs=2e-3)
