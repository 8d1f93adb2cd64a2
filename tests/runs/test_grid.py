"""A controller's own ticks are found behind jittered stamps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pumafuse.errors import RunError
from pumafuse.runs.grid import regular_grid

SECOND = 1_000_000_000
PERIOD = 0.028
TICK = 28_000_000

properties = settings(derandomize=True, deadline=None, max_examples=50)


def refusal(call: Callable[[], object]) -> str:
    with pytest.raises(RunError) as caught:
        call()
    text = str(caught.value)
    assert len(text.splitlines()) == 1, text
    return text


def grid_of(ticks: np.ndarray, period_ns: float = TICK, origin: int = 1_700_000_000 * SECOND) -> np.ndarray:
    return origin + np.rint(ticks * period_ns).astype(np.int64)


@properties
@given(st.sampled_from([PERIOD, 0.004, 1 / 30, 0.0281234567]), st.integers(200, 500), st.integers(0, 2**32 - 1))
def test_the_grid_behind_jittered_stamps_is_even_to_a_nanosecond(period: float, count: int, seed: int) -> None:
    """Stamps off by up to a fifth of a period, with commands missing, come back on ticks of exactly T."""
    rng = np.random.default_rng(seed)
    ticks = np.cumsum(rng.integers(1, 6, count))
    jitter = rng.uniform(-0.2, 0.2, count) * period * SECOND
    stamp = grid_of(ticks, period * SECOND) + np.rint(jitter).astype(np.int64)
    got, note = regular_grid(stamp, period, "host")
    assert note is None
    np.testing.assert_allclose(got - got[0], (ticks - ticks[0]) * period * SECOND, rtol=0, atol=1.001)  # rounded twice
    assert abs(float(np.median(stamp - got))) <= 1.0


def test_the_grid_lies_where_the_ticks_were() -> None:
    """With many commands the jitter averages out: the grid is within 4 standard errors of the true ticks."""
    ticks = np.flatnonzero(np.random.default_rng(1).random(4000) < 0.8)
    truth = grid_of(ticks)
    sd = 1.5e6
    stamp = truth + np.rint(np.random.default_rng(2).normal(0.0, sd, len(ticks))).astype(np.int64)
    got, note = regular_grid(stamp, PERIOD, "host")
    assert note is None
    assert set(np.unique(np.diff(got) - np.diff(truth))) == {0}
    assert abs(int(got[0] - truth[0])) < 4 * sd * np.sqrt(np.pi / 2 / len(ticks))  # of a median


@pytest.mark.parametrize("ppm", [50.0, -50.0, 400.0])
def test_a_drifting_clock_is_followed_and_told(ppm: float) -> None:
    """50 ppm over an hour are 180 ms, six ticks: the grid stays on the true ticks, and the note tells the drift."""
    ticks = np.flatnonzero(np.random.default_rng(3).random(130_000) < 0.9)
    truth = grid_of(ticks, TICK * (1 + ppm * 1e-6))
    jitter = np.random.default_rng(4).normal(0.0, 1e6, len(ticks))
    got, note = regular_grid(truth + np.rint(jitter).astype(np.int64), PERIOD, "host")
    assert np.abs(got - truth).max() < 4 * 1e6 * np.sqrt((4 + np.pi / 2) / len(ticks))  # slope and median together
    assert note is not None
    assert "host" in note
    assert f"{ppm:+.1f} ppm" in note


@pytest.mark.parametrize(("stamp", "wanted"), [([5], [5]), ([5, TICK + 1005], [505, TICK + 505])])
def test_one_or_two_stamps_are_a_grid(stamp: list[int], wanted: list[int]) -> None:
    """Stamps too few to fit a drift to keep T, and share the error."""
    got, note = regular_grid(np.array(stamp), PERIOD, "host")
    assert note is None
    assert got.tolist() == wanted


@pytest.mark.parametrize("count", [3, 5, 10, 20, 40])
def test_a_short_run_with_jitter_has_a_grid(count: int) -> None:
    """1 ms of jitter on a few commands is no wrong period: the slope's own error is allowed for."""
    for seed in range(20):
        jitter = np.rint(np.random.default_rng(seed).normal(0.0, 1e6, count)).astype(np.int64)
        got, note = regular_grid(grid_of(np.arange(count)) + jitter, PERIOD, "host")
        np.testing.assert_array_equal(np.diff(got), TICK)
        assert note is None


@pytest.mark.parametrize("first", [2000, 10, 3997])
def test_a_late_stamp_moves_no_other_command(first: int) -> None:
    """One stamp more than half a tick late, the next one less: every command is on its own tick."""
    truth = grid_of(np.arange(4000))
    stamp = truth.copy()
    stamp[first] += 15_000_000
    stamp[first + 1] += 3_000_000
    got, note = regular_grid(stamp, PERIOD, "host")
    assert note == "host: 1 commands are stamped more than half a period late: set back to their ticks"
    np.testing.assert_allclose(got - truth, 0, atol=1)


@pytest.mark.parametrize("mean", [2e6, 3e6])
def test_stamps_that_are_only_ever_late_have_a_grid(mean: float) -> None:
    """A logger's delay, exponential with 2 or 3 ms, is now and then over half a tick: the ticks are still clear."""
    truth = grid_of(np.arange(4000))
    late = np.random.default_rng(0).exponential(mean, len(truth)).astype(np.int64)
    got, note = regular_grid(np.maximum.accumulate(truth + late), PERIOD, "host")
    assert note is not None
    assert "ppm" not in note
    np.testing.assert_array_equal(np.diff(got), TICK)


@pytest.mark.parametrize("ppm", [50.0, -50.0])
def test_a_pause_does_not_hide_the_drift(ppm: float) -> None:
    """50 ppm through a pause of 10 minutes are one tick: the grid is on the true ticks after it."""
    truth = grid_of(np.concatenate([np.arange(20_000), np.arange(20_000) + 41_500]), TICK * (1 + ppm * 1e-6))
    got, note = regular_grid(truth, PERIOD, "host")
    assert note is not None
    assert f"{ppm:+.1f} ppm" in note
    assert np.abs(got - truth).max() < 1000


@pytest.mark.parametrize("period", [0.056, 0.030, 0.0281, 0.0279, 0.027, 0.0200])
def test_a_wrong_period_is_refused(period: float) -> None:
    """Stamps 28 ms apart do not fit another period: refused with both periods and what to do."""
    ticks = np.arange(500)
    jitter = np.random.default_rng(5).uniform(-1e6, 1e6, len(ticks))
    text = refusal(lambda: regular_grid(grid_of(ticks) + np.rint(jitter).astype(np.int64), period, "host"))
    assert text.startswith("host: ")
    for words in (f"ticks of {period * 1e3:g} ms", "median interval is 28.0", "clock = 'stamps'"):
        assert words in text


def test_two_commands_in_one_tick_are_refused() -> None:
    """A command between two ticks cannot be on a grid: refused with the period and what to do."""
    text = refusal(lambda: regular_grid(np.array([0, TICK, TICK + TICK // 3, 2 * TICK]), PERIOD, "host"))
    assert text.startswith("host: ")
    for words in ("ticks of 28 ms", "median interval is 18.6667 ms", "clock = 'stamps'"):
        assert words in text


@pytest.mark.parametrize("place", [50, 100, 190, 3900])
def test_a_command_between_two_ticks_is_refused(place: int) -> None:
    """Two commands on one tick are no regular clock; no other command is moved to make room for them."""
    truth = grid_of(np.arange(4000))
    stamp = np.sort(np.append(truth, truth[place] + TICK // 2))
    with pytest.raises(RunError, match="do not come on ticks"):
        regular_grid(stamp, PERIOD, "host")
