"""Estimates leave Python as tables, folders and figures, and say in a line what they are."""

import math
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.fusion import results

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
COMMANDS = 1.0 + 0.02 * np.arange(100)
ARM = {
    "name": "arm",
    "update_period_ms": 20,
    "delay_ms": 30,
    "axes": {
        "x": {"plant": "first-order", "time_constant_ms": 40},
        "yaw": {"kind": "angle", "plant": "first-order", "time_constant_ms": 20},
    },
}
CONFIG = {"arm": ARM, "sensors": {"camera": {"sd_mm": 0.5, "sd_deg": 0.1}}}


@pytest.fixture(scope="module")
def run() -> pf.Run:
    rng, x, yaw = np.random.default_rng(1), 0.05 * np.sin(3.0 * COMMANDS), 0.2 * np.cos(2.0 * COMMANDS)
    seen = {"x": x + rng.normal(0.0, 5e-4, 100), "yaw": yaw + rng.normal(0.0, 2e-3, 100)}
    return pf.Run.from_arrays(COMMANDS, {"x": x, "yaw": yaw}, {"camera": (COMMANDS + 0.07, seen)}, name="a run")


@pytest.fixture(scope="module")
def est(run: pf.Run) -> pf.Estimates:
    return pf.fuse(run, pf.FusionConfig.parse(CONFIG))


def test_tables_are_in_si_with_the_units_in_their_names(run: pf.Run) -> None:
    """In m and rad; the files have mm and degrees; what there is not is null, not NaN."""
    est = pf.fuse(run, pf.FusionConfig.parse(CONFIG), mode="smoothed")
    table = est.to_arrow()
    assert table.column_names[:3] == ["time_s", "x.position_m", "x.position_sd_m"]
    for axis, unit in (("x", "m"), ("yaw", "rad")):
        for name in ("position", "position_sd", "offset", "offset_sd"):
            np.testing.assert_array_equal(table[f"{axis}.{name}_{unit}"], getattr(est[axis], name))
        assert table[f"{axis}.velocity_{unit}_s"].null_count == len(est.time)
    files = results.estimates_table(est)
    np.testing.assert_allclose(files["x.position_mm"], 1e3 * est["x"].position)
    np.testing.assert_allclose(files["yaw.position_deg"], np.degrees(est["yaw"].position))


def test_data_frames_have_the_table(est: pf.Estimates, monkeypatch: pytest.MonkeyPatch) -> None:
    """What pandas makes of it; polars has a function of its own, and without it Python says what is missing."""
    frame, polars = est.to_pandas(), ModuleType("polars")
    assert list(frame) == est.to_arrow().column_names
    np.testing.assert_array_equal(frame["yaw.velocity_rad_s"], est["yaw"].velocity)
    polars.from_arrow = lambda table: ("a frame", table)  # pyright: ignore
    monkeypatch.setitem(sys.modules, "polars", polars)
    assert est.to_polars() == ("a frame", est.to_arrow())
    monkeypatch.setitem(sys.modules, "polars", None)
    with pytest.raises(ImportError, match="polars"):
        est.to_polars()


def test_a_saved_folder_is_read_again(est: pf.Estimates, tmp_path: Path) -> None:
    """What the command line writes; not over something else, and over an earlier result only by force."""
    est.save(tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"estimates.parquet", "summary.json", "arm.toml"}
    np.testing.assert_allclose(results.read(tmp_path / "out").axes["x"].position, est["x"].position, rtol=1e-12)
    with pytest.raises(pf.PumafuseError):
        est.save(tmp_path / "out")
    est.save(str(tmp_path / "out"), force=True)


def test_a_configuration_is_made_of_a_dict_or_a_text() -> None:
    """With the keys and units of the files; what is wrong is said as of a file."""
    config = pf.FusionConfig.parse(CONFIG)
    assert config.sensors["camera"].sd_of("yaw") == pytest.approx(math.radians(0.1), rel=1e-15)
    assert pf.FusionConfig.parse(config.to_toml(), config.arm) == config
    assert pf.ArmModel.parse(config.arm.to_toml()) == config.arm == pf.ArmModel.parse(ARM)
    assert pf.FusionConfig.parse({"arm": "puma560-internal"}).arm == pf.ArmModel.load("puma560-internal")
    for wrong, said in (
        ({**CONFIG, "sensors": {"camera": {"sd": 1.0}}}, r"unknown key 'sensors.camera.sd'; accepted: sd_mm"),
        ({"sensors": {}}, r"'arm' must be a preset \(puma560-internal, .*\), a table, or given as arm="),
        ({"arm": {**ARM, "update_period_ms": math.nan}}, r"arm.update_period_ms: nan is not a finite number"),
        ({"arm": {**ARM, "axes": {"x": {"plant": "lag"}}}}, r"arm: axes.x.plant: unknown plant 'lag'"),
        ("arm = ", "not valid TOML"),
        (None, "expected a text or a dict, got NoneType"),
        (b"arm = 1", "expected a text or a dict, got bytes"),
        ({"arm": ARM, "sensors": {1: {"sd_mm": 1.0}}}, "sensors: a key is 1, not a text"),
        ({"arm": {**ARM, "provenance": {"file": Path("x")}}}, "arm.provenance.file: expected a number, a text"),
        ({"arm": ARM, "sensors": {"camera": {"sd_mm": np.zeros(2)}}}, "sensors.camera.sd_mm: expected a number"),
    ):
        with pytest.raises(pf.ConfigError, match=said):
            pf.FusionConfig.parse(wrong)  # pyright: ignore
    for arm in ("puma560-internal", ARM):
        with pytest.raises(pf.ConfigError, match="arm= takes what"):
            pf.FusionConfig.parse({}, arm)  # pyright: ignore


@pytest.mark.parametrize("number", [np.float32(0.5), np.array(0.5)])
def test_numbers_of_numpy_are_numbers(number: Any) -> None:
    """As `np.std` gives them; what is parsed can be written."""
    arm = {**ARM, "name": np.str_("arm"), "provenance": {"sd": number}}
    config = pf.FusionConfig.parse({"arm": arm, "sensors": {"camera": {"sd_mm": number, "sd_deg": number}}})
    assert config.sensors["camera"].sd_of("x") == pytest.approx(1e-3 * float(number), rel=1e-15)
    assert pf.ArmModel.parse(config.arm.to_toml()) == config.arm
