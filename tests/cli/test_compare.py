"""`pumafuse compare`: which of several results to take, with a reference and without one."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import pumafuse as pf
from executable import pumafuse
from pumafuse.cli import compare
from tuning_runs import quietly

ARM = {"name": "arm", "update_period_ms": 20, "delay_ms": 30, "axes": {"x": {"plant": "first-order"}}}
ARM["axes"]["x"]["time_constant_ms"] = 40  # pyright: ignore


def recorded(seed: int = 1) -> pf.Run:
    """Ten seconds, seen by a camera and a tracker; the reference is what the model makes of the commands."""
    rng, time = np.random.default_rng(seed), 1.0 + 0.02 * np.arange(500)
    seen = 1.2 + 0.03 * np.arange(320)
    quiet = pf.Run.from_arrays(time, {"x": 0.1 * np.sin(2.0 * time)}, {}, name=f"run {seed}")
    true = pf.fuse(quiet, pf.FusionConfig.parse({"arm": ARM}))["x"].position
    sensors = {
        name: (seen, {"x": np.interp(seen, time, true) + rng.normal(0.0, sd, len(seen))})
        for name, sd in (("camera", 1e-3), ("tracker", 1e-4))
    }
    return pf.Run.from_arrays(time, {"x": 0.1 * np.sin(2.0 * time)}, sensors, (time, {"x": true}), name=f"run {seed}")


def saved(folder: Path, run: pf.Run, camera: float = 1.0, gate: float = 50.0, **how: Any) -> Path:
    """A result with a believed noise of the camera [mm], and its gate."""
    sensors = {"camera": {"sd_mm": camera, "gate": gate}, "tracker": {"sd_mm": 0.1}}
    config = pf.FusionConfig.parse({"arm": ARM, "sensors": sensors})
    quietly(lambda: pf.fuse(run, config, **how)).save(folder)
    return folder


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[list[dict[str, Any]], str]]:
    """What is said of folders: as JSON, and on the screen."""

    def of(*folders: Path) -> tuple[list[dict[str, Any]], str]:
        compare.run(folders, None, json=True)
        found = json.loads(capsys.readouterr().out)
        compare.run(folders, None, json=False)
        return found, capsys.readouterr().out

    return of


Told = Callable[..., tuple[list[dict[str, Any]], str]]


def test_without_a_reference_the_same_measurements_are_the_judge(tmp_path: Path, told: Told) -> None:
    """By the log-likelihood, which is higher with the camera's true noise; and how far the estimates are apart."""
    run = replace(recorded(), reference=None)
    right = saved(tmp_path / "right", run, sensors=["camera"])
    wrong = saved(tmp_path / "wrong", run, 3.0, sensors=["camera"])
    (one, two), out = told(wrong, right)
    ahead = two["log_likelihood"]["x"] - one["log_likelihood"]["x"]
    assert (one["axes"], one["take"], two["take"]) == ({}, False, True)
    assert f"take {right}: the log-likelihood of the same measurements" in (
        out := pumafuse("compare", wrong, right).stdout
    )
    assert f"{ahead:.1f} higher" in out
    positions = [pf.fuse(run, pf.FusionConfig.load(folder / "fusion.toml"), sensors=["camera"])["x"].position
                 for folder in (wrong, right)]  # fmt: skip
    apart = 1e3 * (positions[1] - positions[0])
    assert two["difference"]["x"]["rms_mm"] == pytest.approx(np.sqrt(np.mean(apart**2)), rel=1e-6)
    assert abs(two["difference"]["x"]["largest_mm"]) == pytest.approx(np.abs(apart).max(), rel=1e-6)
    assert not one["difference"]
    assert two["nis"]["x"]["camera"] == pytest.approx(1.0, abs=0.2)
    assert two["rejected"]["x"]["camera"] == 0.0


def test_other_sensors_are_judged_by_what_both_predict(tmp_path: Path, told: Told) -> None:
    """With the tracker the camera's next measurement is predicted better."""
    run = replace(recorded(), reference=None)
    alone, both = saved(tmp_path / "alone", run, sensors=["camera"]), saved(tmp_path / "both", run)
    found, out = told(alone, both)
    assert {one["folder"]: one["take"] for one in found} == {str(alone): False, str(both): True}
    assert "its error of predicting the next measurement" in out


def test_a_reference_decides_where_there_is_one(tmp_path: Path, told: Told) -> None:
    """By the RMSE, whatever the likelihood says."""
    run = recorded()
    alone, both = saved(tmp_path / "alone", run, sensors=["camera"]), saved(tmp_path / "both", run)
    (one, two), out = told(alone, both)
    less = 1.0 - two["axes"]["x"]["rmse_mm"] / one["axes"]["x"]["rmse_mm"]
    assert f"take {both}: its error against the reference" in out
    assert f"is {less:.0%} smaller than that of {alone}" in out


def test_nothing_is_chosen_where_nothing_is_ahead(tmp_path: Path, told: Told) -> None:
    """The same result twice; results of two runs; one result."""
    run = replace(recorded(), reference=None)
    one, again = saved(tmp_path / "one", run), saved(tmp_path / "again", run)
    other = saved(tmp_path / "other", replace(recorded(2), reference=None))
    for folders, said in (((one, again), "no result is ahead"), ((one, other), ""), ((one,), "")):
        found, out = told(*folders)
        assert not any(each["take"] for each in found)
        assert said in out and "take" not in out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda table: table.take(list(range(table.num_rows))[::-1]), "time_s is not ascending"),
        (lambda table: table.set_column(1, table.column_names[1], pa.nulls(table.num_rows, pa.float64())), "missing"),
    ],
)
def test_estimates_that_were_changed_are_refused(
    tmp_path: Path, change: Callable[[pa.Table], pa.Table], said: str
) -> None:
    """One line with the file and what to do, not numbers that mean nothing."""
    folder = saved(tmp_path / "result", recorded())
    path = folder / "estimates.parquet"
    pq.write_table(change(pq.read_table(path)), path)
    with pytest.raises(pf.PumafuseError, match=said) as refusal:
        compare.run([folder], None, json=True)
    assert str(path) in str(refusal.value)
    assert "fuse the run again" in str(refusal.value)


def test_a_picture_shows_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the current folder, in the place of an earlier one; errors with a reference, else differences."""
    monkeypatch.chdir(tmp_path)
    saved(Path("one"), recorded())
    saved(Path("two"), recorded(), 3.0)
    compare.run([Path("one"), Path("two")], None, json=False, draw=True)
    Path(compare.FIGURE).write_text("an earlier one")
    assert "drawn in" in pumafuse("compare", "one", "two", "--figures").stderr
    assert Path(compare.FIGURE).read_bytes().startswith(b"\x89PNG")
