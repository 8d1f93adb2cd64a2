"""`pumafuse verify`: the real executable on a simulated white-noise run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import pumafuse as pf
from executable import pumafuse

SCENARIO = """
name = "noise"
seed = 4
arm = "puma560-internal"
[trajectory]
kind = "white-noise"
axes = ["radial", "vertical"]
amplitude_mm = 8.0
duration_s = 6.0
[start.level]
radial_mm = 560.0
[process]
input_noise_mm_rtHz = 0.0
drift_mm_rts = 0.0
[sensors.scope]
rate_hz = 100.0
sd_mm = 0.05
[sensors.eye]
rate_hz = 30.0
sd_mm = 0.5
"""
MEASURED = {"rms_mm", "percent_of_signal", "fit_percent"}


def refused(*arguments: object) -> str:
    """The one line that a refusal prints; nothing on stdout."""
    done = pumafuse(*arguments, code=1)
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    return line


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("verify")
    (folder / "noise.toml").write_text(SCENARIO)
    pumafuse("simulate", folder / "noise.toml", "-o", folder / "run")
    return folder / "run"


@pytest.fixture(scope="module")
def found(run: Path) -> list[dict[str, object]]:
    sensors = ("--sensors", "scope,eye")
    return json.loads(pumafuse("verify", run, "--arm", run / "arm.toml", *sensors, "--json").stdout)


def test_json_has_the_numbers_of_python(run: Path, found: list[dict[str, object]]) -> None:
    """Every number with its unit, in the order of the axes; of a run of the arm itself only the noise is left."""
    expected = [
        one for one, _ in pf.verify(pf.Run.read(run), pf.ArmModel.load(run / "arm.toml"), sensors=["scope", "eye"])
    ]
    assert [(one["axis"], one["source"]) for one in found] == [(one.axis, one.source) for one in expected]
    assert len(found) == 4
    for one, other in zip(found, expected, strict=True):
        assert set(one) == {
            *("run", "axis", "source", "measurements", "amplitude_mm", "start_mm", "start_from", "model"),
            *("without_recovery", "with_recovery", "recovery_ms", "best_in_class", "outlying", "verdict", "notes"),
        }
        assert set(one["model"]) == MEASURED
        assert set(one["best_in_class"]) == {"fit", "delay_ms", "gain", "plant"}
        assert one["model"]["rms_mm"] == pytest.approx(1e3 * other.model.rms, rel=1e-9)
        assert one["model"]["rms_mm"] == pytest.approx({"scope": 0.05, "eye": 0.5}[one["source"]], rel=0.2)
        best, expected_best = one["best_in_class"], other.best_in_class
        assert best["delay_ms"] == pytest.approx(1e3 * expected_best.delay, rel=1e-9)
        assert best["plant"]["time_constant_ms"] == pytest.approx(1e3 * expected_best.plant.time_constant)
        assert (one["recovery_ms"], one["verdict"]) == (pytest.approx(100.0), other.verdict)
        assert one["amplitude_mm"] == pytest.approx(8.0)


def test_the_table_shows_the_same_numbers(run: Path, found: list[dict[str, object]]) -> None:
    """One line a source with the RMS in three digits, then a sentence for each."""
    shown = pumafuse("verify", run, "--arm", run / "arm.toml", "--sensors", "scope,eye").stdout
    rows = [line for line in shown.splitlines() if " scope " in line or " eye " in line]
    assert len(rows) == 4
    for row, one in zip(rows, found, strict=True):
        for number in (one["model"]["rms_mm"], one["best_in_class"]["fit"]["rms_mm"]):
            assert f"{number:.3f}" in row.split()
    joined = " ".join(shown.split())
    for one in found:
        best = one["best_in_class"]
        assert f"start level {one['start_mm']:g} mm ({one['start_from']})" in joined
        assert f"the best in class is K {best['gain']:.3f}, Td {best['delay_ms']:.1f} ms" in joined


@pytest.mark.long
def test_several_runs_and_a_preset(run: Path) -> None:
    """A preset by its name; each run is there, compared with its reference, which fits better than any sensor."""
    done = pumafuse("verify", run, run, "--arm", "puma560-internal", "--json")
    found = json.loads(done.stdout)
    assert [(one["axis"], one["source"]) for one in found] == [("radial", "reference"), ("vertical", "reference")] * 2
    assert all(one["model"]["rms_mm"] < 0.001 for one in found)


@pytest.mark.long
def test_a_start_level_can_be_given(run: Path) -> None:
    """By axis, in millimetres; no number is a usage error, an axis that the run has not is one line."""
    arguments = ("verify", run, "--arm", run / "arm.toml", "--sensors", "scope", "--json", "--start")
    found = json.loads(pumafuse(*arguments, "radial=555.5", "--start", "vertical=3").stdout)
    assert [one["start_mm"] for one in found] == pytest.approx([555.5, 3.0])
    assert [one["start_from"] for one in found] == ["given", "given"]
    pumafuse(*arguments, "radial=far", code=2)
    assert "elbow" in refused(*arguments, "elbow=3")


def test_what_is_not_there_is_one_line(run: Path, tmp_path: Path) -> None:
    """A missing arm, run or sensor, another arm's axes."""
    arm = run / "arm.toml"
    assert "none.toml" in refused("verify", run, "--arm", tmp_path / "none.toml")
    assert "none" in refused("verify", tmp_path / "none", "--arm", arm)
    assert "has no sensor 'camera'; it has scope, eye" in refused("verify", run, "--arm", arm, "--sensors", "camera")
    other = arm.read_text().replace("[axes.radial", "[axes.elbow")
    (tmp_path / "elbow.toml").write_text(other)
    assert "'radial'" in refused("verify", run, "--arm", tmp_path / "elbow.toml")
