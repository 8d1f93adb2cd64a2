"""A filter with the true model has error bars that hold: 200 simulated runs, fused, against chi-square.

Simulator and filter share their declared parameters and no line of mathematics, so that each is the other's oracle.
Bands: the NEES summed over independent runs at one instant is chi-square; over all
instants and axes the chance of a false alarm is 1 % (Bonferroni). Innovations of a right filter are independent, so the
NIS summed over every fused component is chi-square too.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

import pumafuse as pf
from pumafuse.fusion.estimates import Mode
from pumafuse.fusion.offline import Engine

pytestmark = pytest.mark.long

RUNS = 200
AXES = ("tangential", "radial")
PRIOR = 3e-3  # m, of the camera's bias
INSTANTS = (0.2, 1.0, 2.0, 3.0, 4.0, 5.0)  # s; far apart against the filter's memory of some 0.2 s
SCENARIO = """
name = "matched"
arm = "puma560-internal"
[trajectory]
kind = "raster"
along = "tangential"
across = "radial"
width_mm = 60.0
height_mm = 40.0
pitch_mm = 20.0
speed_m_s = 0.04
[start]
offset_sd_mm = 2.0
[process]
input_noise_mm_rtHz = 0.03
drift_mm_rts = 0.3
maneuver_noise_mm_rtHz_per_m_s = 1.0
maneuver_drift_mm_rts_per_m_s = 8.0
[sensors.vision]
rate_hz = 30.0
rate_jitter_ms = 2.0
sd_mm = { tangential = 0.4, radial = 0.3 }
latency_ms = 45.0
bias_sd_mm = 3.0
dropouts = 0.1
[sensors.range]
rate_hz = 12.0
axes = ["radial"]
sd_mm = 0.2
latency_ms = 4.0
scale = -1.5
[sensors.wheel]
rate_hz = 7.0
axes = ["tangential"]
sd_mm = 0.15
latency_ms = -3.0
"""
DISTURBED = SCENARIO.replace(
    "[sensors.vision]",
    """[process.tangential]
disturbance_sd_mm = 0.8
disturbance_time_ms = 250.0
[process.radial]
drift_mm_rts = 0.0
disturbance_sd_mm = 0.5
disturbance_time_ms = 150.0
disturbance_kind = "ou"
[sensors.vision]
bias_drift_sd_mm = 0.6
bias_time_s = 0.8""",
)


@dataclass(frozen=True)
class Fused:
    """Errors over sd (runs, axes, estimates), NIS by (sensor, axis), estimated biases over their sd.

    Velocities have one estimate less: the truth of one is the distance to the next estimate, a period later.
    """

    time: NDArray[np.float64]
    error: NDArray[np.float64]
    velocity: NDArray[np.float64]
    nis: dict[tuple[str, str], NDArray[np.float64]]
    bias: NDArray[np.float64]


def fused(scenario: pf.Scenario, runs: int = RUNS, engine: Engine = "compiled", mode: Mode = "filtered") -> Fused:
    errors, velocities, biases = [], [], []
    nis: dict[tuple[str, str], list[float]] = {}
    for seed in range(1, runs + 1):
        simulated = pf.simulate(scenario, seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", pf.PumafuseWarning)
            est = pf.fuse(simulated.run, simulated.config, engine=engine, mode=mode)
        reference = est.reference
        there = np.searchsorted(reference.time, est.time - 1e-9)
        assert np.abs(reference.time[there] - est.time).max() < 1e-9
        errors.append([(est[a].position - reference.position[a][there]) / est[a].position_sd for a in AXES])
        now, period = slice(None, -1), est.config.arm.update_period
        assert np.abs(np.diff(est.time) - period).max() < 1e-9
        moved = {a: np.diff(reference.position[a][there]) / period for a in AXES}
        velocities.append([(est[a].velocity[now] - moved[a]) / est[a].velocity_sd[now] for a in AXES])
        for sensor in est.measurements.sensors:
            for axis in AXES:
                mine = est.measurements.of(sensor, axis)
                kept = mine.nis[mine.outcome == pf.Outcome.FUSED]
                nis.setdefault((sensor, axis), []).extend(kept.tolist())
        # The estimate of a bias b ~ N(0, prior²) has the variance prior² − posterior².
        vision = est.biases["vision"]
        biases.append([vision[a].value / (PRIOR**2 - vision[a].sd ** 2) ** 0.5 for a in AXES])
    gathered = {key: np.array(value) for key, value in nis.items() if value}
    return Fused(est.time, np.array(errors), np.array(velocities), gathered, np.array(biases))


def at_instants(found: Fused) -> NDArray[np.float64]:
    """Mean NEES over the runs, (axes, instants)."""
    picked = np.searchsorted(found.time, INSTANTS)
    return np.mean(found.error[:, :, picked] ** 2, axis=0)


def band(count: int, tests: int = 1) -> tuple[float, float]:
    """Where a mean of ``count`` squares lies in 99 % of cases, ``tests`` of them together."""
    low, high = chi2.ppf([0.005 / tests, 1.0 - 0.005 / tests], count) / count
    return float(low), float(high)


def check_anees(found: Fused) -> None:
    anees = at_instants(found)
    low, high = band(len(found.error), anees.size)
    assert low < anees.min(), anees
    assert anees.max() < high, anees


def check_coverage(error: NDArray[np.float64]) -> None:
    for axis in range(len(AXES)):
        assert np.mean(np.abs(error[:, axis]) < 1.959964) == pytest.approx(0.95, abs=0.01)


def test_the_velocity_s_error_bar_holds(tmp_path: Path) -> None:
    """95 ± 1 % of the true mean velocities lie in the 95 % band, on an axis of each order, over 1,000 runs of 1 s."""
    path = tmp_path / "short.toml"
    path.write_text(
        SCENARIO.replace("width_mm = 60.0", "width_mm = 15.0").replace("height_mm = 40.0", "height_mm = 20.0")
    )
    found = fused(pf.Scenario.load(path), runs=1000)
    assert 0.8 < found.time[-1] < 2.0
    assert len(found.velocity) == 1000
    check_coverage(found.velocity)
    assert np.abs(found.velocity.mean(axis=(0, 2))).max() < 0.02


@pytest.mark.parametrize("mode", ["filtered", "smoothed", "as-live"])
def test_error_bars_hold_with_a_disturbance_and_a_drifting_bias(tmp_path: Path, mode: Mode) -> None:
    """ANEES, 95 ± 1 % of the positions and NIS: Matérn on one axis, Ornstein-Uhlenbeck on the other, with true numbers.

    Estimates of biases spread by √(prior² − posterior²). A filter that is not told of disturbance or drift is seen at
    once.
    """
    path = tmp_path / "disturbed.toml"
    path.write_text(DISTURBED)
    found = fused(pf.Scenario.load(path), mode=mode)
    check_anees(found)
    check_coverage(found.error)
    for nis in found.nis.values():
        low, high = band(len(nis), len(found.nis))
        assert low < nis.mean() < high
    low, high = band(RUNS, len(AXES))
    assert (low < np.mean(found.bias**2, axis=0)).all() and (np.mean(found.bias**2, axis=0) < high).all()
    untold = ("process.tangential]\ndisturbance_sd_mm = 0.0", "sensors.vision]\nbias_drift_sd_mm = 0.0")
    for one in untold if mode == "filtered" else ():
        path.write_text(f"{DISTURBED}[filter.{one}\n")
        nis = fused(pf.Scenario.load(path), runs=20).nis["vision", "tangential"]
        assert nis.mean() > band(len(nis))[1]
