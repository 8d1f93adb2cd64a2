"""Consistency: the statistics against scipy and by hand, the verdicts on data made exactly by the model.

The simulation draws from section 2's model itself: a first-order plant with white noise at its input, an offset on a
random walk, measurements with white noise and a latency. A filter with the true configuration must then be
consistent; of a wrong one the verdict must name the fault.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.special import chdtrc, chdtri

import pumafuse as pf
from pumafuse.fusion import chi_square
from pumafuse.fusion.consistency import (
    LAGS,
    Consistency,
    chi_square_band,
    consistency,
    ljung_box,
    log_likelihood,
)
from pumafuse.fusion.verdicts import sentence
from tuning_runs import with_sensors

PERIOD, DELAY, TAU = 28_000_000, 60_450_000, 0.0425  # ns, ns, s
FIRST = 40_000_000  # ns, of the first measurement
SEEDS = 120


@dataclass(frozen=True)
class World:
    """What the simulation does and, field by field replaced, what the filter is configured with. SI units."""

    input_noise: float = 0.05e-3
    drift: float = 0.3e-3
    offset_sd: float = 2e-3
    sd: float = 0.5e-3
    latency: float = 0.020
    gate: float = 0.0

    def config(self, run: pf.Run) -> pf.FusionConfig:
        plant = pf.AxisModel(plant=pf.FirstOrder(time_constant=TAU))
        process = pf.Process(input_noise=self.input_noise, drift=self.drift)
        return pf.FusionConfig(
            arm=pf.ArmModel(
                name="simulated", update_period=PERIOD / 1e9, delay=DELAY / 1e9, axes=dict.fromkeys(run.axes, plant)
            ),
            start=pf.Start(offset_sd=self.offset_sd),
            process=dict.fromkeys(run.axes, process),
            sensors={"camera": pf.Sensor(sd=self.sd, latency=self.latency, gate=self.gate, gate_rows=False)},
        )


def simulated(world: World, command: np.ndarray, every: float, count: int, axes: int, seed: int) -> pf.Run:
    """A run of ``axes`` independent axes with the same commands [m], and a camera read ``count`` times."""
    rng = np.random.default_rng(seed)
    valid = FIRST + np.rint(every * 1e9 * np.arange(count)).astype(np.int64)
    given = PERIOD * np.arange(len(command))
    change = dict(zip((given + DELAY).tolist(), command - command[0], strict=True))
    measurement = set(valid.tolist())
    x, o = np.zeros(axes), world.offset_sd * rng.standard_normal(axes)
    v, now, z = 0.0, 0, list[np.ndarray]()
    for instant in sorted(measurement | {time for time in change if time <= valid[-1]}):
        dt = (instant - now) / 1e9
        decay = math.exp(-dt / TAU)
        spread = world.input_noise * math.sqrt((1.0 - decay**2) / (2.0 * TAU))
        x = decay * x + (1.0 - decay) * v + spread * rng.standard_normal(axes)
        o = o + world.drift * math.sqrt(dt) * rng.standard_normal(axes)
        now, v = instant, change.get(instant, v)
        if instant in measurement:
            z.append(command[0] + x + o + world.sd * rng.standard_normal(axes))
    names = [f"axis{number}" for number in range(axes)]
    stamps = valid + round(world.latency * 1e9)
    return pf.Run.from_arrays(
        given,
        dict.fromkeys(names, command),
        {"camera": (stamps, dict(zip(names, np.array(z).T, strict=True)))},
    )


def swing(duration: float, period: float = 2.0) -> np.ndarray:
    """Commands to and fro over 100 mm."""
    time = np.arange(0.0, duration, PERIOD / 1e9)
    return 0.05 * (1.0 - np.cos(2.0 * np.pi * time / period))


def judged(run: pf.Run, configured: World) -> Mapping[str, Consistency]:
    """Consistency of each axis with this configuration."""
    est = pf.fuse(run, configured.config(run))
    return {axis: consistency(est, "camera", axis) for axis in run.axes}


@pytest.mark.parametrize("count", [1, 2, 30, 1689, 100_000])
def test_the_band_is_that_of_chi_square(count: int) -> None:
    """95 % of the mean of n squared normals lies in it, the rest equally on both sides."""
    low, high = chi_square_band(count)
    assert (low, high) == pytest.approx(tuple(stats.chi2.ppf([0.025, 0.975], count) / count), rel=1e-9)


@pytest.mark.parametrize(("count", "lags"), [(500, 20), (40, 20), (15, 20), (2, 20), (100, 1)])
def test_ljung_box_against_loops(count: int, lags: int) -> None:
    """Autocorrelations and Q summed term by term; a series shorter than the lags has one lag less than values."""
    values = np.random.default_rng(count).standard_normal(count).cumsum() + 3.0
    centred = [value - sum(values) / count for value in values]
    power = sum(c * c for c in centred)
    wanted = [
        sum(centred[i] * centred[i + lag] for i in range(count - lag)) / power
        for lag in range(1, min(lags, count - 1) + 1)
    ]
    statistic = count * (count + 2) * sum(r * r / (count - lag) for lag, r in enumerate(wanted, 1))
    correlation, p = ljung_box(values, lags)
    assert correlation == pytest.approx(wanted, abs=1e-12)
    assert p == pytest.approx(stats.chi2.sf(statistic, len(wanted)), rel=1e-6, abs=1e-300)


@pytest.mark.parametrize("values", [[0.3], [0.3, 0.3, 0.3]])
def test_ljung_box_of_what_does_not_vary_accuses_nobody(values: list[float]) -> None:
    """One value, or equal ones, cannot be distinguished from white: p = 1 and no correlation."""
    correlation, p = ljung_box(np.array(values))
    assert not correlation.any()
    assert p == 1.0


def test_log_likelihood_is_the_joint_density_of_the_measurements() -> None:
    """Gates off, it is the log density of all measurements in mm as one dense Gaussian: offset walk plus noise."""
    world = World(input_noise=0.0)
    run = simulated(world, np.zeros(30), 0.02, 40, 2, 1)
    est = pf.fuse(run, world.config(run))
    time = FIRST / 1e9 + 0.02 * np.arange(40)
    covariance = world.offset_sd**2 + world.drift**2 * np.minimum.outer(time, time) + world.sd**2 * np.eye(40)
    density = stats.multivariate_normal(np.zeros(40), covariance * 1e6)
    wanted = sum(density.logpdf(run.sensors["camera"].values[axis] * 1e3) for axis in run.axes)
    assert log_likelihood(est.measurements, est.config.sensors) == pytest.approx(wanted, rel=1e-9)


def test_a_rejected_component_costs_as_much_as_one_at_the_gate() -> None:
    """−½(ln 2πS + gate²) for each rejected component, −½(ln 2πS + ν²/S) for each other: normal densities in mm."""
    world = World(gate=6.0)
    run = simulated(world, swing(6.0), 0.02, 250, 1, 2)
    wild = np.arange(250) % 20 == 10
    run.sensors["camera"].values["axis0"][wild] += 0.05
    est = pf.fuse(run, world.config(run))
    used, sd = est.measurements, est.measurements.innovation_sd * 1e3
    at = np.where(wild, 6.0 * sd, used.innovation * 1e3)
    assert log_likelihood(used, est.config.sensors) == pytest.approx(stats.norm.logpdf(at, 0.0, sd).sum(), rel=1e-9)


@pytest.fixture(scope="module")
def matched() -> Mapping[str, Consistency]:
    """Consistency of a filter with the true configuration, for each of 120 seeds."""
    world = World()
    return judged(simulated(world, swing(5.0), 0.015, 300, SEEDS, 3), world)


def test_the_nis_of_a_right_filter_lies_in_its_band(matched: Mapping[str, Consistency]) -> None:
    """In 95 % of the seeds, and its mean over all of them is 1 within 3 standard errors."""
    inside = sum(found.nis_band[0] <= found.nis <= found.nis_band[1] for found in matched.values())
    assert stats.binom.cdf(inside, SEEDS, 0.95) > 0.005
    assert stats.binom.sf(inside - 1, SEEDS, 0.95) > 0.005
    counts = {found.count for found in matched.values()}
    assert counts == {300}
    assert np.mean([found.nis for found in matched.values()]) == pytest.approx(1.0, abs=3 * math.sqrt(2 / 300 / SEEDS))


def test_the_innovations_of_a_right_filter_are_white(matched: Mapping[str, Consistency]) -> None:
    """Ljung-Box p > 0.01 in 99 % of the seeds and p evenly spread; 95 % of the correlations lie in their band."""
    p = np.array([found.whiteness for found in matched.values()])
    assert stats.binom.sf(int((p <= 0.01).sum()) - 1, SEEDS, 0.01) > 0.005
    assert stats.kstest(p, "uniform").pvalue > 0.005
    within = [np.abs(found.correlation) <= found.correlation_band for found in matched.values()]
    assert np.mean(within) == pytest.approx(0.95, abs=0.015)
    assert all(len(found.correlation) == LAGS for found in matched.values())


def test_a_right_filter_is_called_consistent(matched: Mapping[str, Consistency]) -> None:
    """In at least nine seeds of ten; none is blamed on latency or colour."""
    verdicts = [sentence(found) for found in matched.values()]
    assert sum(verdict.endswith(": consistent") for verdict in verdicts) >= 0.9 * SEEDS
    assert not any("latency_ms" in verdict for verdict in verdicts)


@pytest.fixture(scope="module")
def moving() -> pf.Run:
    """Six axes on the move, seen at 30 Hz for 18 s."""
    return simulated(World(), swing(19.0), 0.033, 540, 6, 4)


@pytest.mark.parametrize(
    ("latency", "verdict"),
    [
        (-0.010, r": the lag is (29|30)[.\d]* ms too small \(latency_ms, delay_ms or plant\)$"),
        (0.015, r"the lag is [3-7][.\d]* ms too small \(latency_ms, "),
        (0.025, r"the lag is [3-7][.\d]* ms too large \(latency_ms, "),
        (0.050, r"the lag is (29|30|31)[.\d]* ms too large \(latency_ms, "),
    ],
)
@pytest.mark.filterwarnings("ignore:.*latency_ms is -10:pumafuse.PumafuseWarning")
def test_verdicts_name_the_key_that_is_wrong(moving: pf.Run, latency: float, verdict: str) -> None:
    """A latency that is 5 and 30 ms too small and too large: on every axis."""
    for axis, found in judged(moving, World(latency=latency)).items():
        assert re.search(verdict, sentence(found)), (axis, sentence(found))


@pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
def test_a_verdict_on_what_a_gate_has_left_says_so(moving: pf.Run) -> None:
    """With a third of the noise and a gate of 2 the rest fits by selection: the verdict is how many were rejected."""
    for axis, found in judged(moving, World(sd=0.17e-3, gate=2.0)).items():
        assert re.search(r"but \d\d% were rejected", sentence(found)), (axis, sentence(found))


def test_innovations_are_looked_at_beyond_the_next_one(moving: pf.Run) -> None:
    """Each like the third before it (w + 0.5 w₋₃ has a correlation of 0.4 there): not white, and the lag is named."""
    world = World()
    est = pf.fuse(moving, world.config(moving))
    noise = np.random.default_rng(3).standard_normal(len(est.measurements.value) + 3)
    coloured = (noise[3:] + 0.5 * noise[:-3]) / math.sqrt(1.25)
    order = np.lexsort((est.measurements.time, est.measurements.axis))
    innovation = np.empty(len(order))
    innovation[order] = coloured * est.measurements.innovation_sd[order]
    spoilt = replace(est, measurements=replace(est.measurements, innovation=innovation))
    found = [consistency(spoilt, "camera", axis) for axis in est.axes]
    assert found and all(re.search(r"not white \(lag 3: \+0\.[345]", sentence(one)) for one in found if one)


def test_the_verdict_on_smoothed_estimates_needs_no_velocity_of_theirs(moving: pf.Run) -> None:
    """They have none; a latency 30 ms too long is still found on every axis."""
    est = pf.fuse(moving, World(latency=0.050).config(moving), mode="smoothed")
    for axis in est.axes:
        assert re.search("is (29|30|31).* ms too large", sentence(consistency(est, "camera", axis)))


@pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
@pytest.mark.parametrize(("sds", "said"), [(2e6, True), (0.5e6, False)])
@pytest.mark.parametrize("prior", ["offset_sd", "bias_sd"])
def test_a_prior_too_wide_for_double_precision_is_said(moving: pf.Run, prior: str, sds: float, said: bool) -> None:
    """Of the offset or of a bias, more than a million times the noise."""
    config = World().config(moving)
    if prior == "bias_sd":
        config = with_sensors(config, bias_sd=sds * World.sd)
    else:
        config = msgspec.structs.replace(config, start=pf.Start(offset_sd=sds * World.sd))
    notes = [note for note in pf.fuse(moving, config).notes if note.startswith("camera: its prior")]
    assert len(notes) == said
    assert all("is 2.0e+06 times its noise" in note for note in notes)


@given(st.integers(1, 10_000_000), st.floats(1e-6, 1.0 - 1e-6), st.floats(0.0, 30.0))
def test_chi_square_is_scipys(degrees: int, share: float, times: float) -> None:
    """Quantiles to 1e-10, and the tail to 1e-7 of itself wherever a double holds it."""
    assert chi_square.quantile(degrees, share) == pytest.approx(chdtri(degrees, share), rel=1e-10)
    for x in (degrees * times, chdtri(degrees, share)):
        assert chi_square.tail(degrees, x) == pytest.approx(chdtrc(degrees, x), rel=1e-7, abs=1e-290)
