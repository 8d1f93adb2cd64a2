"""Scores of the velocity, on constructed estimates: against the reference's mean velocity over the coming period."""

import numpy as np
import pytest

from pumafuse.fusion.score import ReferenceTrack, score_velocity
from pumafuse.fusion.score import score as score_position

PERIOD = 0.028


def path(time: np.ndarray) -> np.ndarray:
    """Where the axis is [m]."""
    return 0.5 + 0.05 * np.sin(2.0 * time)


def mean_velocity(time: np.ndarray) -> np.ndarray:
    return (path(time + PERIOD) - path(time)) / PERIOD


def track(time: np.ndarray, position: np.ndarray, *, sd: float = 0.0, segment: np.ndarray | None = None):
    whole = np.zeros(len(time), dtype=np.int64) if segment is None else segment
    return ReferenceTrack(time, {"radial": position}, {"radial": np.full(len(time), sd)}, whole)


def score(time: np.ndarray, velocity: np.ndarray, sd: float, reference: ReferenceTrack, **more: np.ndarray):
    segment = more.get("segment", np.zeros(len(time), dtype=np.int64))
    return score_velocity(time, segment, velocity, np.full(len(time), sd), reference, "radial", PERIOD)


def test_the_velocity_is_that_of_the_coming_period() -> None:
    """Exact mean velocities have no error; the last period has no end in the reference and is left out."""
    time = PERIOD * np.arange(200)
    found = score(time, mean_velocity(time) + 1e-3, 1e-3, track(time, path(time)))
    assert (found.rows, found.left_out) == (199, 1)
    assert (found.rmse, found.bias, found.nees) == pytest.approx((1e-3, 1e-3, 1.0), rel=1e-9)
    assert found.coverage == 1.0


def test_both_ends_of_the_period_need_the_reference_in_the_same_segment() -> None:
    """A gap of the reference, NaN in it and the end of a segment leave out every period that touches them."""
    time = 0.01 * np.arange(100)
    reference = path(time)
    reference[40:60] = np.nan  # from 0.39 to 0.60 s there is a gap
    segment = (time > 0.795).astype(np.int64)
    found = score(time, mean_velocity(time), 1e-3, track(time, reference, segment=segment), segment=segment)
    inside = [t for t in range(100) if (t + 2.8 <= 39 or t >= 60) and (t + 2.8 <= 79 or t >= 80) and t + 2.8 <= 99]
    assert (found.rows, found.left_out) == (len(inside), 100 - len(inside))


def test_error_bars_that_hold_have_95_percent_coverage() -> None:
    """The noise of the reference at both ends of the period, 2·sd²/T², is added to the variance of the velocity."""
    rng = np.random.default_rng(1)
    time = 2.0 * PERIOD * np.arange(20_000)  # no two periods share a row of the reference
    rows = PERIOD * np.arange(40_001)
    noisy = path(rows) + 1e-4 * rng.standard_normal(len(rows))
    velocity = mean_velocity(time) + 3e-3 * rng.standard_normal(len(time))
    found = score(time, velocity, 3e-3, track(rows, noisy, sd=1e-4))
    assert found.rmse == pytest.approx(np.hypot(3e-3, np.sqrt(2.0) * 1e-4 / PERIOD), rel=0.02)
    assert found.coverage == pytest.approx(0.95, abs=0.006)
    assert found.nees == pytest.approx(1.0, abs=0.04)


def test_a_reference_between_whose_rows_an_estimate_lies_is_not_known_exactly() -> None:
    """A line across 40 ms is up to 0.8 mm off this path: bars of 0.05 mm hold beside it as they do at its rows."""
    rng = np.random.default_rng(2)
    rows = np.sort(0.04 * np.arange(2_000) + rng.uniform(-0.005, 0.005, 2_000))
    time = np.sort(np.concatenate([rows[5:-5], rng.uniform(rows[5], rows[-5], 4_000)]))
    fast = 0.1 * np.sin(6.0 * time)
    position, sd = fast + 5e-5 * rng.standard_normal(len(time)), np.full(len(time), 5e-5)
    reference = track(rows, 0.1 * np.sin(6.0 * rows))
    at_rows = np.isin(time, rows)
    none = np.zeros(len(time), dtype=np.int64)
    there = score_position(time[at_rows], none[at_rows], position[at_rows], sd[at_rows], reference, "radial")
    between = score_position(time[~at_rows], none[~at_rows], position[~at_rows], sd[~at_rows], reference, "radial")
    assert there.coverage == pytest.approx(0.95, abs=0.015)
    assert there.nees == pytest.approx(1.0, abs=0.07)
    assert between.coverage > 0.95
    assert 0.5 < between.nees < 1.1


def test_rows_of_a_noisy_reference_that_are_stamped_almost_alike_hide_no_error() -> None:
    """Every fifth row comes twice, 1 µs apart, with 0.01 mm of noise: a bend without end. What is 1 mm off is seen."""
    rng = np.random.default_rng(3)
    rows = np.sort(np.concatenate([0.02 * np.arange(1_000), 0.1 * np.arange(200) + 1e-6]))
    time = 0.02 * np.arange(5, 990) + 0.01
    reference = track(rows, path(rows) + 1e-5 * rng.standard_normal(len(rows)))
    sd, none = np.full(len(time), 1e-4), np.zeros(len(time), dtype=np.int64)
    assert score_position(time, none, path(time) + 1e-3, sd, reference, "radial").coverage < 0.01
