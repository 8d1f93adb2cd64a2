"""Constant biases of sensors, and latencies that wander."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from fusion.test_oracle import MS, PANEL, TRACKER, UNDER, Case, Seen, every, one, sensor
from fusion_oracle import AxisOracle
from pumafuse.fusion.config import FusionConfig, Process
from pumafuse.fusion.offline import fuse
from pumafuse.logs.run import Run

# ---- biases ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("level", "start"), [(-2.0, None), (3.0, 5e-3)])
def test_a_bias_is_in_the_coordinates_of_the_log(level: float, start: float | None) -> None:
    """Measurements 600.4 mm − p have a bias of 600.4 mm wherever the arm starts, configured or by its first command."""
    case = Case(seen={"panel": PANEL, "tracker": TRACKER}, start={} if start is None else {"radial": 0.5 + start})
    run, config = case.made()
    shift = level - 0.5
    for name, bias in (("panel", 0.6004), ("tracker", 0.0)):
        of, values = config.sensors[name], run.sensors[name].values["radial"]
        values[:] = of.scale * (AxisOracle(run, config, "radial").undisturbed(case.seen[name].valid)[0] + shift) + bias
    run.command.values["radial"][:] += shift
    moved = replace(run, start={axis: u + shift for axis, u in run.start.items()})
    bias = fuse(moved, config).biases["panel"]["radial"]
    assert abs(bias.value - 0.6004) < 2.0 * bias.sd**2 / 1.0**2  # all that the prior of 0 ± 1 m takes from it, twice
    assert bias.sd < 0.5e-3


# ---- latencies that wander ------------------------------------------------------------------------------------------

SCALE, JITTER, DRIFT = -1.5, 0.004, 0.3e-3


def moving(seen: Seen, process: Process) -> tuple[Run, FusionConfig]:
    """Three seconds of swinging to and fro by 60 mm at up to 0.11 m/s, commands every 10 ms."""
    times = np.arange(300) * 10 * MS
    case = Case(one(UNDER), times=times, period=0.01, process=process, offset_sd=1e-3, seen={"tracker": seen})
    run, config = case.made()
    run.command.values["radial"][:] = 0.5 + 0.03 * np.sin(2.0 * np.pi * 0.6e-9 * times)
    return run, config


def jittering_nis(latency_sd: float, seed: int) -> np.ndarray:
    """NIS of 150 measurements whose latency really wanders, of an arm whose offset really walks."""
    rng, valid = np.random.default_rng(seed), every(50, 150)
    of = sensor(0.1e-3, latency=0.02, scale=SCALE, latency_sd=latency_sd)
    run, config = moving(Seen(of, valid), Process(input_noise=0.0, drift=DRIFT))
    actual = np.maximum(valid + np.rint(rng.normal(0.0, JITTER * 1e9, len(valid))).astype(np.int64), 0)
    order = np.argsort(actual)
    offset = np.empty(len(valid))
    step = np.sqrt(np.diff(actual[order], prepend=0) * 1e-9) * DRIFT
    offset[order] = rng.normal(0.0, config.start.offset_sd) + np.cumsum(step * rng.normal(size=len(valid)))
    position = AxisOracle(run, config, "radial").undisturbed(actual)[0] + offset
    run.sensors["tracker"].values["radial"][:] = SCALE * position + rng.normal(0.0, 0.1e-3, len(valid))
    return fuse(run, config).measurements.nis


def test_measurements_whose_latency_wanders_are_consistent_where_latency_sd_says_so() -> None:
    """Mean NIS over many runs is 1 within the 99.9 % band of χ²; without latency_sd the errors look far too large."""
    right, wrong = (np.concatenate([jittering_nis(sd, seed) for seed in range(25)]) for sd in (JITTER, 0.0))
    low, high = chi2.ppf([0.0005, 0.9995], len(right)) / len(right)
    assert low < right.mean() < high
    assert wrong.mean() > 3.0
