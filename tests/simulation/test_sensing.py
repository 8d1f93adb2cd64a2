"""A sensor's rows against its declared faults, one at a time.

Statistics are over tens of thousands of rows; each band is four standard errors of the figure it holds, the chance of a
false alarm 6e-5 each, and the seeds are fixed.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pumafuse.logs.source import Source
from pumafuse.simulation.motion import grid
from pumafuse.simulation.true_sensor import Bursts, Outliers, TrueSensor, measure, valid_times

Floats = NDArray[np.float64]
ROWS = 20_000


def sensor(**given: Any) -> TrueSensor:
    return TrueSensor(**({"rate": 100.0, "sd": 1e-12} | given))


def even(rows: int = ROWS, rate: float = 100.0) -> NDArray[np.int64]:
    return np.rint((np.arange(rows) + 0.25) / rate * 1e9).astype(np.int64)


def path(valid: NDArray[np.int64]) -> dict[str, Floats]:
    """Two axes that are never at the same place twice, so that a row's position tells its valid time."""
    return {"a": valid / 1e9 * 0.01, "b": 3.0 - valid / 1e9 * 0.02}


def measured(true: TrueSensor, valid: NDArray[np.int64] | None = None, seed: int = 1) -> Source:
    at = even() if valid is None else valid
    return measure(true, "s", at, path(at), np.random.default_rng(seed))


def within(found: float, expected: float, sd: float) -> None:
    assert abs(found - expected) < 4.0 * sd, (found, expected, sd)


def test_noise_has_its_sd_on_each_axis_and_none_in_common() -> None:
    """Variance within four standard errors, correlations between axes and between rows within 4/√n of zero."""
    sd = {"a": 0.0005, "b": 0.002}
    found = measured(sensor(sd=sd))
    noise = {}
    for axis, true in path(even()).items():
        expected = sd[axis] if isinstance(sd, dict) else sd
        noise[axis] = (found.values[axis] - true) / expected
        within(float(np.mean(noise[axis] ** 2)), 1.0, (2.0 / ROWS) ** 0.5)
        within(float(noise[axis].mean()), 0.0, ROWS**-0.5)
        within(float(np.mean(noise[axis][1:] * noise[axis][:-1])), 0.0, ROWS**-0.5)
    within(float(np.mean(noise["a"] * noise["b"])), 0.0, ROWS**-0.5)


def test_latency_is_from_the_valid_time_to_the_stamp() -> None:
    """z(stamp) = p(stamp − latency), also of a sensor that looks ahead."""
    for latency in (0.045, -0.002):
        found = measured(sensor(latency=latency))
        assert (found.stamp - even() == round(latency * 1e9)).all()
        assert found.values["a"] == pytest.approx((found.stamp / 1e9 - latency) * 0.01, abs=1e-11)


def test_latency_wanders_from_row_to_row_and_stamps_stay_in_order() -> None:
    """Each row's own latency, known from its position, has the sd asked for; rows are in the order of their stamps."""
    found = measured(sensor(latency=0.045, latency_sd=0.012))
    late = found.stamp / 1e9 - found.values["a"] / 0.01
    within(float(late.mean()), 0.045, 0.012 / ROWS**0.5)
    within(float(late.var()) / 0.012**2, 1.0, (2.0 / ROWS) ** 0.5)
    assert (np.diff(found.stamp) >= 0).all()
    assert (np.diff(found.values["a"]) < 0.0).any()  # some have overtaken others
    assert found.values["b"] == pytest.approx(3.0 - 2.0 * found.values["a"], abs=1e-10)  # a row stays a row


def test_scale_bias_and_quantisation_act_in_this_order() -> None:
    """Z = scale · p + bias, rounded to whole steps."""
    found = measured(sensor(scale=-1.5, bias={"a": 0.3}, quantisation=0.00025))
    for axis, bias in (("a", 0.3), ("b", 0.0)):
        exact = -1.5 * path(even())[axis] + bias
        steps = found.values[axis] / 0.00025
        assert steps == pytest.approx(np.rint(steps), abs=1e-7)
        assert np.abs(found.values[axis] - exact).max() <= 0.000125 * (1 + 1e-6)
    assert measured(sensor(bias=0.2)).values["b"] == pytest.approx(path(even())["b"] + 0.2, abs=1e-11)


def test_bias_sd_is_one_more_bias_for_each_run_and_axis() -> None:
    """Constant within a run; over 1000 seeds of the sd asked for, about the constant bias, unrelated between axes."""
    few = even(3)
    found = np.array(
        [
            [measured(sensor(bias=0.1, bias_sd=0.002), few, seed).values[axis] - path(few)[axis] for axis in "ab"]
            for seed in range(1000)
        ]
    )
    assert np.ptp(found, axis=2).max() < 1e-10
    drawn = (found[:, :, 0] - 0.1) / 0.002
    for axis in range(2):
        within(float(drawn[:, axis].mean()), 0.0, 1000**-0.5)
        within(float(np.mean(drawn[:, axis] ** 2)), 1.0, (2.0 / 1000) ** 0.5)
    within(float(np.mean(drawn[:, 0] * drawn[:, 1])), 0.0, 1000**-0.5)


def test_dropouts_lose_their_share_one_by_one() -> None:
    """The share is binomial, and one loss says nothing of the next."""
    lost = ~np.isin(even(), measured(sensor(dropouts=0.1)).stamp)
    within(float(lost.mean()), 0.1, (0.09 / ROWS) ** 0.5)
    within(float(np.mean(lost[1:] & lost[:-1])), 0.01, (0.01 / ROWS) ** 0.5)


def test_bursts_lose_rows_together() -> None:
    """As many as asked for a minute, Poisson; each of its length: the share that is left is e^(−rate · length)."""
    rate, length, seconds = 6.0 / 60.0, 0.5, ROWS / 100.0
    shares, starts = [], []
    for seed in range(50):
        kept = np.isin(even(), measured(sensor(bursts=Bursts(per_minute=6.0, length=length)), seed=seed).stamp)
        shares.append(kept.mean())
        edges = np.flatnonzero(np.diff(np.concatenate(([1], kept.astype(int), [1]))))
        runs = edges[1::2] - edges[::2]
        starts.append(len(runs))
        assert all(run >= length * 100.0 - 1 for run in runs[:-1])  # the last may be cut off by the end
    within(float(np.mean(shares)), np.exp(-rate * length), float(np.std(shares)) / 50**0.5)
    # A burst counts as one unless another began within its length before it.
    within(float(np.mean(starts)), rate * seconds * np.exp(-rate * length), (rate * seconds / 50) ** 0.5)


def test_outliers_have_their_share_size_and_either_sign() -> None:
    """A wild row is wild on every axis, uniformly between from and to, up as often as down; others are untouched."""
    found = measured(sensor(outliers=Outliers(share=0.05, smallest=0.005, largest=0.020)))
    wrong = {axis: found.values[axis] - true for axis, true in path(even()).items()}
    wild = np.abs(wrong["a"]) > 1e-9
    assert (wild == (np.abs(wrong["b"]) > 1e-9)).all()
    within(float(wild.mean()), 0.05, (0.05 * 0.95 / ROWS) ** 0.5)
    count = int(wild.sum())
    for axis in "ab":
        size = np.abs(wrong[axis][wild])
        assert size.min() >= 0.005 - 1e-10 and size.max() <= 0.020 + 1e-10
        within(float(size.mean()), 0.0125, 0.015 / 12**0.5 / count**0.5)
        within(float(np.mean(wrong[axis][wild] > 0.0)), 0.5, 0.5 / count**0.5)


def test_outages_lose_exactly_their_rows() -> None:
    """By valid time, from the start of each up to its end."""
    found = measured(sensor(latency=0.045, outages=[(9.0, 15.0), (100.0, 100.5)]))
    valid = found.stamp / 1e9 - 0.045
    kept = np.array([not (9.0 <= t < 15.0 or 100.0 <= t < 100.5) for t in (even() / 1e9).tolist()])
    assert len(valid) == kept.sum()
    assert valid == pytest.approx(even()[kept] / 1e9, abs=1e-9)


def test_a_sensors_clock_is_off_and_drifts() -> None:
    """Stamp = (t + latency) · (1 + drift) + offset, to the nanosecond."""
    found = measured(sensor(latency=0.01, clock_offset=-0.25, clock_drift=50.0))
    expected = (even() / 1e9 + 0.01) * (1.0 + 50e-6) - 0.25
    assert np.abs(found.stamp - expected * 1e9).max() <= 1.0


STEP = 0.028 / 60  # s, of the grid


def test_rows_come_at_their_rate() -> None:
    """Evenly from a random phase, each at the nearest instant of the grid, with the jitter asked for."""
    jitter = 0.0008
    phases, instants = [], grid(2000, 0.028)
    spread = (jitter**2 + STEP**2 / 12.0) ** 0.5
    for seed in range(12):
        valid = valid_times(sensor(rate=30.7, rate_jitter=jitter), instants, np.random.default_rng(seed))
        assert np.isin(valid, instants).all()
        assert abs(len(valid) - 56 * 30.7) <= 1.5
        assert (np.diff(valid) > 0).all()
        row = valid / 1e9 * 30.7
        off = (row - np.arange(len(row)) - row[0]) / 30.7
        phases.append(row[0])
        if jitter == 0.0:
            assert np.ptp(off) < STEP + 2e-9
        else:
            within(float(off.std()) / spread, 1.0, (0.5 / 1719) ** 0.5)
            within(float(np.diff(off).std()) / spread, 2**0.5, (1.5 / 1719) ** 0.5)  # it does not add up
    within(float(np.mean(phases)), 0.5, 12**-0.5 / 12**0.5)
    assert np.ptp(phases) > 0.5


LOSSES = {"dropouts": 0.3}, {"bursts": Bursts(per_minute=30.0, length=0.2)}, {"outages": [(1.0, 2.0)]}


@pytest.mark.parametrize("fault", LOSSES)
def test_losing_rows_changes_no_other_row(fault: dict[str, Any]) -> None:
    """What is left is what would have been there anyway, to the last bit."""
    plain = {"sd": 0.001, "latency": 0.02, "bias_sd": 0.01, "latency_sd": 0.001}
    whole, left = measured(sensor(**plain)), measured(sensor(**plain, **fault))
    assert 0 < len(left.stamp) < len(whole.stamp)
    there = np.searchsorted(whole.stamp, left.stamp)
    assert (whole.stamp[there] == left.stamp).all()
    for axis in "ab":
        assert (whole.values[axis][there] == left.values[axis]).all()
