"""Processes that revert to 0 against their covariance functions, which nothing of how they are drawn knows."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import pumafuse as pf
from draws import OneDraw
from pumafuse.simulation import reverting
from pumafuse.simulation.motion import Motion, simulate_axis
from pumafuse.simulation.true_arm import TrueAxis
from pumafuse.simulation.true_sensor import TrueSensor, measure

Floats = NDArray[np.float64]
SD = 0.7
#: Instants [ns] with equal, tiny (1 ns), zero and long gaps.
TIMES = np.cumsum([5, 20_000_000, 20_000_000, 1, 0, 3_000, 470_000, 900_000_000, 20_000_000, 40_000_000_000])
ARM = pf.ArmModel.load("puma560-internal")
RADIAL = ARM.axis("radial")
AXIS = TrueAxis(plant=RADIAL.plant, gain=RADIAL.gain, gain_recovery=RADIAL.gain_recovery, delay=ARM.delay)


def matern(apart: Floats, length: float) -> Floats:
    rate = np.sqrt(3.0) / length
    return SD**2 * (1.0 + rate * apart) * np.exp(-rate * apart)


def ornstein_uhlenbeck(apart: Floats, length: float) -> Floats:
    return SD**2 * np.exp(-apart / length)


@pytest.mark.parametrize("length", [0.002, 1e4])
@pytest.mark.parametrize(
    ("process", "expected"),
    [(reverting.smooth, matern), (reverting.rough, ornstein_uhlenbeck)],
    ids=["smooth", "rough"],
)
def test_a_process_has_exactly_its_covariance_function(process: Any, expected: Any, length: float) -> None:
    """L Lᵀ to 1e-12 of the variance, L being what each number drawn does: from the first instant on, however far apart.

    Over a gap of 1 ns a process of smoothness 3/2 differs by less than that: that its increments are right to 1e-6 of
    their own variance is asked apart.
    """
    L = np.array([process(TIMES, SD, length, OneDraw(number)) for number in range(2 * len(TIMES))]).T
    apart = np.abs(TIMES[:, None] - TIMES[None, :]) / 1e9
    assert pytest.approx(expected(apart, length), abs=1e-12 * SD**2) == L @ L.T
    grown, gap = np.square(np.diff(L, axis=0)).sum(axis=1), np.diff(TIMES) / 1e9
    rate = np.sqrt(3.0) / length  # the variance of an increment: (λ σ Δ)² (1 − ⅔ λΔ …), or 2 σ² (1 − e^(−λΔ))
    if process is reverting.smooth:
        short = rate * gap < 1e-4
        assert grown[short] == pytest.approx((rate * gap[short] * SD) ** 2, rel=1e-4)
    else:
        assert grown == pytest.approx(-2.0 * SD**2 * np.expm1(-gap / length), rel=1e-9)


def moved(seed: int, kind: Any = "matern", sd: float = 0.0) -> Motion:
    """Through five commands, with a disturbance of 0.2 s."""
    issued, command = np.arange(5) * 28_000_000, np.linspace(0.0, 0.01, 5)
    process = pf.Process(disturbance_sd=sd, disturbance_time=0.2, disturbance_kind=kind)
    return simulate_axis(AXIS, process, 0.001, issued, command, 0.028, np.random.default_rng(seed))


@pytest.mark.parametrize(("kind", "process"), [("matern", reverting.smooth), ("ou", reverting.rough)])
def test_a_disturbance_is_the_process_of_its_sd_and_time(kind: str, process: Any) -> None:
    """To rounding the one that the axis's own random numbers for it give."""
    disturbed = moved(7, kind, SD)
    own = np.random.default_rng(7).spawn(5)[4]
    expected = process(disturbed.time, SD, 0.2, own)
    assert disturbed.position - moved(7).position == pytest.approx(expected, abs=1e-14)


def test_a_sensor_drifts_on_each_axis_by_itself() -> None:
    """Over a long run the drift has its sd and forgets as exp(−Δ / bias_time), and axes have nothing in common."""
    valid = np.arange(40_000) * 50_000_000
    true = {"a": np.zeros(len(valid)), "b": np.zeros(len(valid))}
    sensor = TrueSensor(rate=20.0, sd=1e-12, scale=-2.0, bias_drift_sd=0.004, bias_time=0.5)
    a, b = (measure(sensor, "s", valid, true, np.random.default_rng(3)).values[axis] / 0.004 for axis in "ab")
    se = (2.0 * 20.0 / len(valid)) ** 0.5  # 20 rows to an independent one
    for one in (a, b):
        assert np.mean(one**2) == pytest.approx(1.0, abs=4.0 * se)
        assert np.mean(one[10:] * one[:-10]) == pytest.approx(np.exp(-1.0), abs=4.0 * se)
    assert np.mean(a * b) == pytest.approx(0.0, abs=4.0 * se)
    config = sensor.to_config()
    assert (config["bias_drift_sd_mm"], config["bias_time_s"], config["bias_sd_mm"]) == (0.004, 0.5, 0.0)
