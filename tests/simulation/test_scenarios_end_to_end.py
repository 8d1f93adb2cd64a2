"""Every scenario of the repository through the real executable: simulate, fuse, compare.

Bands are for any seed, platform and libm: each was derived from the seeds 1 to 20 of its scenario and ends four or a
little more of their standard deviations from their mean, or where the figure itself ends; a filter without
measurements, without model or with wrong error bars falls out of them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

import pumafuse as pf
from executable import pumafuse
from pumafuse.fusion.consistency import consistency

SCENARIOS = Path(__file__).parents[2] / "scenarios"


class Worked:
    """One scenario, simulated and fused."""

    def __init__(self, name: str, folder: Path) -> None:
        self.run, self.result = folder / "run", folder / "result"
        printed = pumafuse("simulate", SCENARIOS / f"{name}.toml", "-o", self.run).stdout
        assert f"{name}: " in printed
        assert f"next: pumafuse fuse {self.run} -c {self.run / 'fusion.toml'} -o result" in printed
        pumafuse("fuse", self.run, "-c", self.run / "fusion.toml", "-o", self.result)
        self.scores = json.loads(pumafuse("compare", self.result, "--json").stdout)[0]["axes"]
        self.summary: dict[str, Any] = json.loads((self.result / "summary.json").read_text())

    def check(self, axis: str, rmse_mm: tuple[float, float], coverage: tuple[float, float]) -> None:
        score = self.scores[axis]
        assert rmse_mm[0] < score["rmse_mm"] < rmse_mm[1], (axis, score)
        assert coverage[0] < score["coverage"] < coverage[1], (axis, score)

    def sensor(self, axis: str, name: str) -> dict[str, Any]:
        return self.summary["axes"][axis]["sensors"][name]

    def estimates(self, column: str) -> NDArray[np.float64]:
        return pq.read_table(self.result / "estimates.parquet", columns=[column])[column].to_numpy()


def test_every_scenario_is_covered_here() -> None:
    """A new scenario needs figures of its own."""
    found = {path.stem for path in SCENARIOS.glob("*.toml") if "[trajectory]" in path.read_text()}
    tested = Path(__file__).read_text()
    assert len(found) >= 8 and all(name in BENT or f'Worked("{name}", tmp_path)' in tested for name in found)


@pytest.mark.long
def test_a_camera_with_dropouts_and_outliers(tmp_path: Path) -> None:
    """panel-vision: measurements of 0.5 mm noise give 0.21 mm, outliers are rejected, error bars hold."""
    worked = Worked("panel-vision", tmp_path)
    for axis in ("tangential", "vertical"):
        worked.check(axis, (0.15, 0.25), (0.88, 1.0))
        sensor = worked.sensor(axis, "vision")
        assert 0.75 < sensor["nis_mean"] < 1.25
        assert 865 < sensor["outcomes"]["fused"] < 922
        assert 1 <= sensor["outcomes"]["rejected"] <= 22  # 1 % of the rows


@pytest.mark.long
def test_a_camera_that_is_later_than_its_configuration_says(tmp_path: Path) -> None:
    """wrong-latency: a verdict names the latency, 25 ms at 60 mm/s are missing, error bars are worth nothing."""
    worked = Worked("wrong-latency", tmp_path)
    assert any("latency_ms" in worked.sensor(axis, "vision")["verdict"] for axis in ("x", "z"))
    worked.check("x", (1.33, 1.53), (0.0, 0.056))
    worked.check("z", (0.22, 0.36), (0.79, 0.925))
    assert 64.0 < worked.scores["x"]["nees_mean"] < 85.0


@pytest.mark.long
def test_a_tracker_that_loses_its_target(tmp_path: Path) -> None:
    """panel-tracker-outage: within the outage, and only there, the error bars grow to the camera's, and they hold."""
    worked = Worked("panel-tracker-outage", tmp_path)
    time = worked.estimates("time_s")
    stamps = pacsv.read_csv(worked.run / "tracker.csv")["time_s"].to_numpy()
    assert not ((stamps - 0.008 >= 9.0) & (stamps - 0.008 < 15.0)).any()
    lost, seen = (time > 9.5) & (time < 15.0), ((time > 1.0) & (time < 9.0)) | (time > 15.2)
    for axis in ("tangential", "vertical"):
        worked.check(axis, (0.035, 0.25), (0.89, 1.0))
        sd = worked.estimates(f"{axis}.position_sd_mm")
        assert np.median(sd[lost]) > 2.3 * np.median(sd[seen])
        assert np.median(sd[seen]) < 0.085  # the last measurement of 0.05 mm is up to 10 ms old
        assert 0.2 < sd[lost].max() < 0.24  # model and camera together are better than one measurement of the camera


@pytest.mark.long
def test_a_cylindrical_arm_logged_in_x_y_z(tmp_path: Path) -> None:
    """cylindrical-cartesian: x, y and z come back near the reference, and the range finder's 600 mm are found."""
    worked = Worked("cylindrical-cartesian", tmp_path)
    for axis, least, most in (("tangential", 0.145, 0.225), ("radial", 0.10, 0.175), ("vertical", 0.135, 0.245)):
        worked.check(axis, (least, most), (0.875, 1.0))
    reference, time = pf.Run.read(worked.run).reference, worked.estimates("time_s")
    assert reference is not None and list(reference.values) == ["x", "y", "z"]
    for name in ("x", "y", "z"):
        error = worked.estimates(f"{name}_mm") - np.interp(time, reference.stamp / 1e9, reference.values[name] * 1e3)
        assert 0.08 < np.sqrt(np.mean(error**2)) < 0.25
    found = worked.sensor("radial", "range")
    assert abs(found["bias_mm"] - 600.0) < 3.0 * found["bias_sd_mm"] < 0.1


@pytest.mark.long
def test_white_noise_finds_the_model_right(tmp_path: Path) -> None:
    """white-noise: the model alone is right, so 7500 innovations are white and as large as expected."""
    worked = Worked("white-noise", tmp_path)
    assert list(worked.scores) == ["tangential"]
    worked.check("tangential", (0.027, 0.044), (0.92, 0.98))
    sensor = worked.sensor("tangential", "wheel")
    assert sensor["outcomes"] == {"fused": pytest.approx(7500, abs=30)}
    assert 0.93 < sensor["nis_mean"] < 1.07
    assert abs(sensor["correlation"][0]) < 4.0 / 7500**0.5


@pytest.mark.long
def test_an_arm_that_is_not_as_modelled(tmp_path: Path) -> None:
    """mismatched-arm: process noise keeps the estimate below the tracker's 0.1 mm; a verdict says what is amiss."""
    worked = Worked("mismatched-arm", tmp_path)
    worked.check("tangential", (0.064, 0.087), (0.76, 0.89))
    worked.check("radial", (0.046, 0.069), (0.88, 0.944))
    verdict = worked.sensor("tangential", "tracker")["verdict"]
    assert "the lag is 1" in verdict and "ms too small" in verdict  # 5.6 ms of delay, the poles, a slower recovery
    assert worked.sensor("tangential", "tracker")["nis_mean"] > 1.18


@pytest.mark.long
def test_a_fast_arm_under_a_fast_sensor(tmp_path: Path) -> None:
    """fast-arm: errors are those of a 0.02 mm measurement up to 1 ms old, although stamps jitter by 0.3 ms."""
    worked = Worked("fast-arm", tmp_path)
    for axis, least, most in (("x1", 0.012, 0.0195), ("x2", 0.0155, 0.037)):
        worked.check(axis, (least, most), (0.932, 0.97))
        assert 0.88 < worked.scores[axis]["nees_mean"] < 1.09
        sensor = worked.sensor(axis, "interferometer")
        assert sensor["outcomes"]["fused"] > 9900
        assert 0.93 < sensor["nis_mean"] < 1.07


@pytest.mark.long
def test_what_is_left_over_is_smooth_and_the_camera_drifts(tmp_path: Path) -> None:
    """smooth-disturbance: error bars hold and NIS is 1; a random walk instead is worse, and its NIS is not."""
    worked = Worked("smooth-disturbance", tmp_path)
    for axis in ("tangential", "vertical"):
        worked.check(axis, (0.135, 0.311), (0.90, 1.0))
        assert 0.69 < worked.sensor(axis, "vision")["nis_mean"] < 1.29
        assert 0.5 < worked.sensor(axis, "tracker")["nis_mean"] < 1.54
    told = pf.FusionConfig.load(worked.run / "fusion.toml")
    process = dict.fromkeys(told.process, pf.Process(input_noise=3e-5, drift=3e-3))
    est = pf.fuse(pf.Run.read(worked.run), pf.FusionConfig(arm=told.arm, process=process, sensors=told.sensors))
    for axis in ("tangential", "vertical"):
        found = consistency(est, "vision", axis)
        assert found is not None and found.nis < 0.65


# RMSE in degrees and coverage, with the arm as it is; RMSE and coverage with an arm that is taken to be linear.
BENT = {
    "saturating-servo": ((0.31, 0.48), (0.90, 1.0), (4.9, 5.9), (0.67, 0.77)),
    "tool-with-play": ((0.16, 0.21), (0.90, 0.99), (1.08, 1.23), (0.04, 0.07)),
    "sagging-lever": ((0.13, 0.20), (0.90, 1.0), (1.30, 1.51), (0.11, 0.21)),
}


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
@pytest.mark.parametrize("name", BENT)
def test_an_arm_that_is_not_linear(name: str, tmp_path: Path) -> None:
    """Its error bars hold; those of a linear arm do not, whose error is six to thirteen times as large."""
    worked = Worked(name, tmp_path)
    rmse, coverage, linear_rmse, linear_coverage = BENT[name]
    config, run = pf.FusionConfig.load(worked.run / "fusion.toml"), pf.Run.read(worked.run)
    (axis,) = config.arm.axes
    linear = msgspec.structs.replace(config.arm.axes[axis], max_speed=None, play=0.0, sag=None)
    arm = msgspec.structs.replace(config.arm, axes={axis: linear})
    score = worked.scores[axis]
    assert rmse[0] < score["rmse_deg"] < rmse[1]
    assert coverage[0] < score["coverage"] < coverage[1]
    score = pf.summarise(pf.fuse(run, msgspec.structs.replace(config, arm=arm))).axes[axis].score
    assert linear_rmse[0] < score.rmse_deg < linear_rmse[1]
    assert linear_coverage[0] < score.coverage < linear_coverage[1]


@pytest.mark.long
def test_a_campaign_of_steps(tmp_path: Path) -> None:
    """step-campaign: the arm that `identify` finds from its 86 trials has the true gains, and the sensor's zeros."""
    worked = Worked("step-campaign", tmp_path)
    trials = pf.StepTrials.read(worked.run)
    assert (len(trials.trials), trials.notes) == (86, ())
    arm = pf.identify(trials).arm
    zeros = {"tangential": 0.3, "radial": -0.2, "vertical": 0.1}
    for axis, (slope, intercept) in {"tangential": (0.0518, 1.010), "radial": (0.0818, 0.933)}.items():
        speed = np.array([0.07, 0.3, 0.6])
        np.testing.assert_allclose(arm.axes[axis].gain.at(speed), slope * speed + intercept, rtol=0.01)
    for axis, zero in zeros.items():
        worked.check(axis, (0.006, 0.033), (0.76, 1.0))  # one unknown zero for the whole run: errors go together
        found = worked.sensor(axis, "scope")
        assert abs(found["bias_mm"] - zero) < 0.06
        assert 0.93 < found["nis_mean"] < 1.07
