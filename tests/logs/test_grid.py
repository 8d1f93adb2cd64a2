"""A controller's own ticks are found behind jittered stamps."""

from functools import partial
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pumafuse.errors import RunError
from pumafuse.logs.grid import assigned_ticks, regular_grid, ticks_of
from refusals import one_line

SECOND = 1_000_000_000
PERIOD = 0.028
TICK = 28_000_000

properties = settings(max_examples=50)


refusal = partial(one_line, RunError)


def grid_of(ticks: np.ndarray, period_ns: float = TICK, origin: int = 1_700_000_000 * SECOND) -> np.ndarray:
    return origin + np.rint(ticks * period_ns).astype(np.int64)


@properties
@given(st.sampled_from([PERIOD, 0.004, 1 / 30, 0.0281234567]), st.integers(40, 500), st.integers(0, 2**32 - 1))
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


def test_a_drifting_clock_is_followed_and_noted() -> None:
    """50 ppm over an hour are 180 ms, six ticks: the grid stays on the true ticks, and the note has the drift."""
    ppm = -50.0
    ticks = np.flatnonzero(np.random.default_rng(3).random(130_000) < 0.9)
    true = grid_of(ticks, TICK * (1 + ppm * 1e-6))
    jitter = np.random.default_rng(4).normal(0.0, 1e6, len(ticks))
    got, note = regular_grid(true + np.rint(jitter).astype(np.int64), PERIOD, "host")
    assert np.abs(got - true).max() < 4 * 1e6 * np.sqrt((4 + np.pi / 2) / len(ticks))  # slope and median together
    assert note is not None
    assert "host" in note
    assert f"{ppm:+.1f} ppm" in note


@pytest.mark.parametrize(("stamp", "wanted"), [([5], [5]), ([5, TICK + 1005], [505, TICK + 505])])
def test_one_or_two_stamps_are_a_grid(stamp: list[int], wanted: list[int]) -> None:
    """Stamps too few to fit a drift to keep T, and share the error."""
    got, note = regular_grid(np.array(stamp), PERIOD, "host")
    assert note is None
    assert got.tolist() == wanted


def test_a_pause_does_not_hide_the_drift() -> None:
    """50 ppm through a pause of 10 minutes are one tick: the grid is on the true ticks after it."""
    ppm = 50.0
    true = grid_of(np.concatenate([np.arange(20_000), np.arange(20_000) + 41_500]), TICK * (1 + ppm * 1e-6))
    got, note = regular_grid(true, PERIOD, "host")
    assert note is not None
    assert f"{ppm:+.1f} ppm" in note
    assert np.abs(got - true).max() < 1000


@pytest.mark.parametrize(("ratio", "sd"), [(2.0, 0.2), (1.004, 0.0), (64 / 65, 0.1), (0.75, 0.2)])
def test_a_wrong_period_is_refused(ratio: float, sd: float) -> None:
    """Also one that fits as well at each second or 64th command: refused with both periods and what to do."""
    _, stamp = logged(np.arange(500), PERIOD, sd, 5)
    text = refusal(lambda: regular_grid(stamp, PERIOD * ratio, "host"))
    assert text.startswith("host: ")
    for words in (f"ticks of {PERIOD * ratio * 1e3:g} ms", "median interval is 2", "clock = 'stamps'"):
        assert words in text


@pytest.mark.parametrize("place", [50, 3900])
def test_a_command_between_two_ticks_is_refused(place: int) -> None:
    """Two commands on one tick are no regular clock; no other command is moved to make room for them."""
    true = grid_of(np.arange(4000))
    stamp = np.sort(np.append(true, true[place] + TICK // 2))
    with pytest.raises(RunError, match="do not come on ticks"):
        regular_grid(stamp, PERIOD, "host")


def logged(ticks: np.ndarray, period: float, sd: float, seed: int, ppm: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """True instants, and stamps with a Gaussian jitter of ``sd`` periods; a logger writes no two within 1 µs."""
    true = grid_of(ticks, period * SECOND * (1 + ppm * 1e-6))
    jitter = np.random.default_rng(seed).normal(0.0, sd * period * SECOND, len(ticks))
    return true, in_order(true + np.rint(jitter).astype(np.int64))


def in_order(stamp: np.ndarray) -> np.ndarray:
    apart = 1000 * np.arange(len(stamp))
    return np.maximum.accumulate(stamp - apart) + apart


def share_right(got: np.ndarray, true: np.ndarray, period: float) -> float:
    return float(np.mean(np.abs(got - true) < 0.4 * period * SECOND))


@pytest.mark.parametrize(("sd", "period", "ppm"), [(0.25, 0.002, 0.0), (0.25, PERIOD, 50.0), (0.05, 0.004, 50.0)])
def test_jitter_of_a_quarter_of_a_period_is_fitted(sd: float, period: float, ppm: float) -> None:
    """Of 0.25 T every twentieth stamp is nearer to another tick: without missing ticks the order decides."""
    for seed in range(3):
        true, stamp = logged(np.arange(5000), period, sd, seed, ppm)
        got, _ = regular_grid(stamp, period, "host")
        assert share_right(got, true, period) >= 0.9995


@pytest.mark.parametrize(("sd", "length"), [(0.0, 1), (0.2, 8)])
def test_a_queue_behind_a_stalled_logger_is_set_back_to_its_ticks(sd: float, length: int) -> None:
    """Up to 8 commands stamped when the logger goes on, then a tick missing soon after: all are on their own ticks."""
    ticks = np.delete(np.arange(4000), [1020, 2020])
    true, stamp = logged(ticks, 0.002, sd, 5)
    for first in (1000, 2000, 3000):
        at = int(np.searchsorted(ticks, first))
        stamp[at : at + length] = true[at + length] - 20_000 + 1000 * np.arange(length)
    got, note = regular_grid(in_order(stamp), 0.002, "host")
    assert share_right(got, true, 0.002) >= 0.9995
    assert note is not None
    assert "more than half a period" in note


@properties
@given(
    st.sampled_from([0.002, PERIOD]), st.floats(0.0, 0.4), st.sampled_from([0.0, 0.02, 0.5]), st.integers(0, 2**32 - 1)
)
def test_a_grid_that_is_given_is_right(period: float, sd: float, missing: float, seed: int) -> None:
    """Whatever the jitter: refused, or all but 3 % of the commands on their ticks, and those a tick beside."""
    rng = np.random.default_rng(seed)
    ticks = np.flatnonzero(rng.random(int(rng.integers(300, 2000))) >= missing)
    true, stamp = logged(ticks, period, sd, seed)
    try:
        got, _ = regular_grid(stamp, period, "host")
    except RunError:
        assert sd > (0.2 if missing < 0.1 else 0.15)
        return
    tick = period * SECOND
    assert np.all(np.diff(got) > 0.99 * tick)
    assert np.abs(got - true).max() < 1.5 * tick
    assert share_right(got, true, period) > 0.97


@properties
@given(st.integers(40, 3000), st.floats(1.0, 5.0), st.integers(0, 2**32 - 1))
def test_stamps_without_ticks_are_refused(count: int, apart: float, seed: int) -> None:
    """Commands at any time lie within half a period of some tick: that is not taken for a jitter."""
    gaps = np.random.default_rng(seed).uniform(0.5, 1.5, count) * apart * TICK
    text = refusal(lambda: regular_grid(np.cumsum(gaps).astype(np.int64), PERIOD, "host"))
    assert "do not come on ticks of 28 ms: " in text
    assert text.endswith("; check update_period_ms, or use clock = 'stamps'")


@pytest.mark.parametrize("seed", [0, 1])
def test_much_jitter_beside_many_missing_ticks_is_refused(seed: int) -> None:
    """Of 0.25 T, with every second tick missing, some 2 % lie nearer to a free tick: no order decides which."""
    rng = np.random.default_rng(seed)
    ticks = np.flatnonzero(rng.random(5000) < 0.5)
    place = np.sort(ticks + rng.normal(0.0, 0.25, len(ticks)))
    assert "beside missing ticks may be of those" in refusal(lambda: regular_grid(grid_of(place), PERIOD, "host"))


def cost(off: np.ndarray) -> np.ndarray:
    return np.where(off > np.sqrt(0.5), 0.5 + 0.01 * (off - np.sqrt(0.5)), off**2)


@properties
@given(st.lists(st.floats(0.0, 5.0), min_size=1, max_size=5))
def test_of_all_rows_of_ticks_the_cheapest_is_found(places: list[float]) -> None:
    """No other strictly ascending row of ticks costs less: all of them are tried."""
    place = np.sort(np.array(places))
    ticks = assigned_ticks(place)
    assert np.all(np.diff(ticks) > 0)
    rows = np.array(list(combinations(range(-5, 9), len(place))))
    least = cost(place - rows).sum(axis=1).min()
    assert cost(place - ticks).sum() == pytest.approx(least, abs=1e-9)


@pytest.mark.parametrize(("period", "jitter"), [(0.0033367, 0.02), (0.101, 0.15)])
def test_the_ticks_of_a_sensor_are_found_in_its_stamps(period: float, jitter: float) -> None:
    """With one row in ten missing, as well as the jitter lets a straight line through the stamps tell it."""
    rng = np.random.default_rng(7)
    ticks = np.flatnonzero(rng.random(3000) < 0.9)
    stamp = np.sort(grid_of(ticks + rng.normal(0.0, jitter, len(ticks)), period * SECOND))
    stamp = stamp[np.append(True, np.diff(stamp) > 0)]
    found = ticks_of(stamp)
    assert abs(found / period - 1.0) * ticks[-1] < 8.0 * jitter / np.sqrt(len(ticks)) * np.sqrt(12.0)
