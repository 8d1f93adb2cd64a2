"""Every scenario of the repository through the real executable: simulate, fuse, compare.

Bands are for any seed, platform and libm: each was derived from the seeds 1 to 20 of its scenario and ends four or a
little more of their standard deviations from their mean, or where the figure itself ends; a filter without
measurements, without model or with wrong error bars falls out of them.
"""

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import pumafuse as pf
from executable import pumafuse

pytestmark = pytest.mark.long
SCENARIOS = Path(__file__).parents[2] / "scenarios"
Band = tuple[float, float]
# By scenario and axis: RMSE [mm] and coverage; by sensor the mean NIS on each of the axes.
FIGURES: dict[str, tuple[dict[str, tuple[Band, Band]], dict[str, Band]]] = {
    # A camera of 0.5 mm, with dropouts and outliers.
    "panel-vision": (dict.fromkeys(("tangential", "vertical"), ((0.15, 0.25), (0.88, 1.0))), {"vision": (0.75, 1.25)}),
    # 25 ms at 60 mm/s are missing: the error bars are worth nothing.
    "wrong-latency": ({"x": ((1.33, 1.53), (0.0, 0.056)), "z": ((0.22, 0.36), (0.79, 0.925))}, {}),
    "panel-tracker-outage": (dict.fromkeys(("tangential", "vertical"), ((0.035, 0.25), (0.89, 1.0))), {}),
    "cylindrical-cartesian": (
        {
            "tangential": ((0.145, 0.225), (0.875, 1.0)),
            "radial": ((0.10, 0.175), (0.875, 1.0)),
            "vertical": ((0.135, 0.245), (0.875, 1.0)),
        },
        {},
    ),
    "white-noise": ({"tangential": ((0.027, 0.044), (0.92, 0.98))}, {"wheel": (0.93, 1.07)}),
    # Process noise keeps the estimate below the tracker's 0.1 mm.
    "mismatched-arm": ({"tangential": ((0.064, 0.087), (0.76, 0.89)), "radial": ((0.046, 0.069), (0.88, 0.944))}, {}),
    # Errors are those of a measurement of 0.02 mm up to 1 ms old, although stamps jitter by 0.3 ms.
    "fast-arm": (
        {"x1": ((0.012, 0.0195), (0.932, 0.97)), "x2": ((0.0155, 0.037), (0.932, 0.97))},
        {"interferometer": (0.93, 1.07)},
    ),
    "smooth-disturbance": (
        dict.fromkeys(("tangential", "vertical"), ((0.135, 0.311), (0.90, 1.0))),
        {"vision": (0.69, 1.29), "tracker": (0.5, 1.54)},
    ),
    # One unknown zero for the whole run: errors go together.
    "step-campaign": (
        dict.fromkeys(("tangential", "radial", "vertical"), ((0.006, 0.033), (0.76, 1.0))),
        {"scope": (0.93, 1.07)},
    ),
}
LATE = {"wrong-latency": ("vision", "latency_ms"), "mismatched-arm": ("tracker", "ms too small")}  # what verdicts say
# RMSE in degrees and coverage, with the arm as it is; RMSE and coverage with an arm that is taken to be linear.
BENT = {
    "saturating-servo": ((0.31, 0.48), (0.90, 1.0), (4.9, 5.9), (0.67, 0.77)),
    "tool-with-play": ((0.16, 0.21), (0.90, 0.99), (1.08, 1.23), (0.04, 0.07)),
    "sagging-lever": ((0.13, 0.20), (0.90, 1.0), (1.30, 1.51), (0.11, 0.21)),
}


def worked(name: str, folder: Path) -> tuple[Path, dict[str, Any], dict[str, Any]]:
    """The run of a scenario, its scores, and the summary of each axis."""
    run, result = folder / "run", folder / "result"
    printed = pumafuse("simulate", SCENARIOS / f"{name}.toml", "-o", run).stdout
    assert f"{name}: " in printed
    assert f"next: pumafuse fuse {run} -c {run / 'fusion.toml'} -o result" in printed
    pumafuse("fuse", run, "-c", run / "fusion.toml", "-o", result)
    scores = json.loads(pumafuse("compare", result, "--json").stdout)[0]["axes"]
    return run, scores, json.loads((result / "summary.json").read_text())["axes"]


def within(value: float, band: Band) -> bool:
    return band[0] < value < band[1]


def test_every_scenario_is_covered_here() -> None:
    """A new scenario needs figures of its own."""
    found = {path.stem for path in SCENARIOS.glob("*.toml") if "[trajectory]" in path.read_text()}
    assert found == {*FIGURES, *BENT}


@pytest.mark.parametrize("name", FIGURES)
def test_errors_and_error_bars_are_as_the_scenario_teaches(name: str, tmp_path: Path) -> None:
    """RMSE, coverage and NIS; where the lag is wrong a verdict says so."""
    axes, sensors = FIGURES[name]
    _, scores, summary = worked(name, tmp_path)
    assert list(scores) == list(axes)
    for axis, (rmse, coverage) in axes.items():
        assert within(scores[axis]["rmse_mm"], rmse) and within(scores[axis]["coverage"], coverage), scores[axis]
        for sensor, nis in sensors.items():
            assert within(summary[axis]["sensors"][sensor]["nis_mean"], nis), (axis, sensor)
    if name in LATE:
        sensor, words = LATE[name]
        assert any(words in one["sensors"][sensor]["verdict"] for one in summary.values())


@pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
@pytest.mark.parametrize("name", BENT)
def test_an_arm_that_is_not_linear(name: str, tmp_path: Path) -> None:
    """Its error bars hold; those of a linear arm do not, whose error is six to thirteen times as large."""
    folder, scores, _ = worked(name, tmp_path)
    rmse, coverage, linear_rmse, linear_coverage = BENT[name]
    config, run = pf.FusionConfig.load(folder / "fusion.toml"), pf.Run.read(folder)
    (axis,) = config.arm.axes
    linear = msgspec.structs.replace(config.arm.axes[axis], max_speed=None, play=0.0, sag=None)
    arm = msgspec.structs.replace(config.arm, axes={axis: linear})
    assert within(scores[axis]["rmse_deg"], rmse) and within(scores[axis]["coverage"], coverage)
    score = pf.summarise(pf.fuse(run, msgspec.structs.replace(config, arm=arm))).axes[axis].score
    assert within(score.rmse_deg, linear_rmse) and within(score.coverage, linear_coverage)


def test_a_campaign_of_steps_is_identified(tmp_path: Path) -> None:
    """step-campaign: the arm that `identify` finds from its 86 trials has the true gains."""
    pumafuse("simulate", SCENARIOS / "step-campaign.toml", "-o", tmp_path / "run")
    trials = pf.StepTrials.read(tmp_path / "run")
    assert (len(trials.trials), trials.notes) == (86, ())
    arm, speed = pf.identify(trials).arm, np.array([0.07, 0.3, 0.6])
    for axis, (slope, intercept) in {"tangential": (0.0518, 1.010), "radial": (0.0818, 0.933)}.items():
        np.testing.assert_allclose(arm.axes[axis].gain.at(speed), slope * speed + intercept, rtol=0.01)
