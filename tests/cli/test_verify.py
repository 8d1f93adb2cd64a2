"""`pumafuse verify`: the command line on a simulated white-noise run."""

import json
from pathlib import Path

import pytest

import pumafuse as pf
from executable import pumafuse, refused

SCENARIO = """
name = "noise"
seed = 4
arm = "puma560-internal"
trajectory = { kind = "white-noise", axes = ["radial", "vertical"], amplitude_mm = 8.0, duration_s = 6.0 }
start = { level = { radial_mm = 560.0 } }
process = { input_noise_mm_rtHz = 0.0, drift_mm_rts = 0.0 }
sensors.scope = { rate_hz = 100.0, sd_mm = 0.05 }
sensors.eye = { rate_hz = 30.0, sd_mm = 0.5 }
"""
SOURCES = ("--sensors", "scope,eye")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("verify")
    (folder / "noise.toml").write_text(SCENARIO)
    pumafuse("simulate", folder / "noise.toml", "-o", folder / "run")
    return folder / "run"


@pytest.fixture(scope="module")
def found(run: Path) -> list[dict[str, object]]:
    return json.loads(pumafuse("verify", run, "--arm", run / "arm.toml", *SOURCES, "--json").stdout)


def test_json_has_the_numbers_of_python(run: Path, found: list[dict[str, object]]) -> None:
    """Every number with its unit, in the order of the axes; of a run of the arm itself only the noise is left."""
    arm, sensors = pf.ArmModel.load(run / "arm.toml"), ["scope", "eye"]
    expected = [one for one, _ in pf.verify(pf.Run.read(run), arm, sensors=sensors)]
    assert len(found) == 4
    for one, other in zip(found, expected, strict=True):
        assert set(one) == {
            *("run", "axis", "kind", "source", "lag_ms", "measurements", "amplitude_mm", "start_mm", "start_from"),
            *("model", "without_recovery", "with_recovery", "recovery_ms", "best_in_class", "outlying", "commands"),
            *("rows", "holds", "verdict", "notes"),
        }
        assert [one[key] for key in ("axis", "source", "verdict")] == [other.axis, other.source, other.verdict]
        assert set(one["model"]) == {"rms_mm", "percent_of_signal", "fit_percent"}
        assert one["model"]["rms_mm"] == pytest.approx(1e3 * other.model.rms, rel=1e-9)
        assert one["model"]["rms_mm"] == pytest.approx({"scope": 0.05, "eye": 0.5}[one["source"]], rel=0.2)
        best = one["best_in_class"]
        assert one["lag_ms"] == pytest.approx(1e3 * arm.lag_of(one["axis"], 0.0), abs=6.0)
        low, high = best["lag_ms_ci95"]
        assert low < best["lag_ms"] < high
        assert best["delay_ms"] == pytest.approx(1e3 * other.best_in_class.delay, rel=1e-9)
        assert best["plant"]["time_constant_ms"] == pytest.approx(1e3 * other.best_in_class.plant.time_constant)
        assert (one["recovery_ms"], one["amplitude_mm"]) == pytest.approx((100.0, 8.0))


def test_what_is_not_there_is_one_line(run: Path, tmp_path: Path) -> None:
    """A missing arm or sensor, another arm's axes."""
    arm, elbow = run / "arm.toml", tmp_path / "elbow.toml"
    assert "none.toml" in refused("verify", run, "--arm", tmp_path / "none.toml")
    assert "has no sensor 'camera'; it has scope, eye" in refused("verify", run, "--arm", arm, "--sensors", "camera")
    elbow.write_text(arm.read_text().replace("[axes.radial", "[axes.elbow"))
    assert "'radial'" in refused("verify", run, "--arm", elbow)


def test_a_model_that_does_not_hold_ends_with_3(run: Path, tmp_path: Path) -> None:
    """What is printed is complete all the same; a model that holds ends with 0."""
    arm = run / "arm.toml"
    slow = tmp_path / "slow.toml"
    slow.write_text(pf.ArmModel.load(arm).to_toml().replace("delay_ms = ", "delay_ms = 40"))
    options = ("--sensors", "scope", "--json", "--report", tmp_path / "report")
    found = json.loads(pumafuse("verify", run, "--arm", slow, *options, code=3).stdout)
    assert not any(one["holds"] for one in found)
    assert (tmp_path / "report" / "report.html").exists()
