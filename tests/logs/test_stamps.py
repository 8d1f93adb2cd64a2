"""Stamps go on where a counter begins anew or a clock is set by an hour; packets are spread by their counter."""

import numpy as np
import pytest

from pumafuse.arrays import NO_STAMP
from pumafuse.logs.stamps import drop_wraps, packets, spread

EVEN = 7_000_000 * np.arange(3000)  # ns


WRAPS = [(1_000, 2**32, "2^32 us"), (1_000_000, 2**32, "2^32 ms"), (1_000_000, 86_400_000, "midnight")]


@pytest.mark.parametrize("epoch", [0, 1_700_000_000_000_000_000])
@pytest.mark.parametrize(("unit", "count", "words"), [WRAPS[0], (1_000_000, 43_200_000, "12 hours")])
def test_clocks_that_begin_anew_go_on(unit: int, count: int, words: str, epoch: int) -> None:
    """After 2^32 us or ms, a day or half of one, bare or on top of a date, to the last digit, over a dropout too."""
    wrap = count * unit
    true = np.delete(EVEN // unit * unit + wrap - 9_999_000_000, slice(1420, 1428))
    found, notes = drop_wraps(epoch + true % wrap, "log: t")
    assert (found == epoch + true).all()
    assert len(notes) == 1
    assert f"{words}, first in row" in notes[0]


@pytest.mark.parametrize("way", [-1, 1])
def test_one_step_of_an_hour_goes_on(way: int) -> None:
    hour = 3_600_000_000_000
    found, notes = drop_wraps(EVEN + way * hour * (np.arange(3000) >= 1234), "log: t")
    assert (found == EVEN).all()
    assert "row 1235" in notes[0]


@pytest.mark.parametrize("step", [-3_590_000_000_000, 3_601_000_000_000, -20_000_000_000, 4_300_000_000_000])
def test_other_steps_stay(step: int) -> None:
    """A clock that is set by something else, and a pause, are left to who cuts runs."""
    stamp = EVEN + step * (np.arange(3000) >= 1000)
    found, notes = drop_wraps(stamp, "log: t")
    assert (found == stamp).all()
    assert not notes


def test_hourly_pauses_stay() -> None:
    stamp = EVEN + 3_600_000_000_000 * (np.arange(3000) // 1000)
    assert (drop_wraps(stamp, "log: t")[0] == stamp).all()


def test_zeros_far_from_all_others_are_missing() -> None:
    """Zeros among stamps since 1970 are none; a clock that begins with 0 keeps it."""
    stamp = EVEN + 1_700_000_000_000_000_000
    stamp[[0, 1, 2, 700, 701, 702, 703]] = 0
    found, notes = drop_wraps(stamp, "log: t")
    assert (found[[0, 702]] == NO_STAMP).all()
    assert "7 stamps of 0" in notes[0]
    assert (drop_wraps(EVEN, "log: t")[0] == EVEN).all()


def test_packets_are_spread_along_their_earliest_arrivals() -> None:
    """Packets of 24 rows, whose transport jitters, some rows lost: each row gets its instant within the least delay."""
    rng = np.random.default_rng(5)
    number = np.delete(np.arange(4096), rng.choice(4096, 200, replace=False))
    made = 1_700_000_000_000_000_000 + 4_000_000 * number
    sent = 1_700_000_000_000_000_000 + 4_000_000 * (24 * (number // 24) + 23)
    delay = 2_000_000 + rng.integers(0, 6_000_000, 4096 // 24 + 1)[number // 24]
    arrived = sent + delay + 30_000 * (number % 24)
    each, every = packets(arrived) or (0.0, 0.0)
    assert each == pytest.approx(24, rel=0.1)
    assert every == pytest.approx(0.096, rel=0.05)
    late = (spread(arrived, number + 5000.0) - made) / 1e6  # ms
    assert late.min() > 2.0
    assert late.max() < 3.5


@pytest.mark.parametrize("every", [1, 40])
def test_rows_that_are_sampled_in_bursts_are_no_packets(every: int) -> None:
    """Rows at 500 Hz, all the time or in bursts of 40 with a pause behind each, are stamped when they are made."""
    stamp = 2_000_000 * np.arange(4000) + 1_000_000_000 * (np.arange(4000) // 40) * (every > 1)
    assert packets(stamp) is None
