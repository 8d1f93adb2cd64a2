"""Estimates leave Python as tables, folders and figures, and say in a line what they are."""

import math
import sys
from decimal import Decimal
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import pumafuse as pf
from executable import pumafuse
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


START_NS = 1_700_000_000_123_456_789


def _configured(axes: str, **more: object) -> pf.FusionConfig:
    plant = {"plant": "first-order", "time_constant_ms": 40.0}
    arm = {"name": "cell", "update_period_ms": 20.0, "delay_ms": 30.0, "axes": dict.fromkeys(axes.split(), plant)}
    return pf.FusionConfig.parse({"arm": arm, "sensors": {"camera": {"sd_mm": 1.0}}, **more})


def _recorded(axes: str = "x y z") -> pf.Run:
    time = START_NS + 20_000_000 * np.arange(100)
    turn = 1.0 - np.cos(np.arange(100) / 20)
    paths = {axis: 0.3 + 0.1 * k * turn for k, axis in enumerate(axes.split(), 1)}
    return pf.Run.from_arrays(time, paths, {"camera": (time + 1, paths)}, (time + 7, paths))


def _read(path: Path) -> tuple[list[int], np.ndarray]:
    """Stamps [ns], and the seven numbers of each line."""
    lines = [line.split(" ") for line in path.read_text().splitlines()]
    return [int(Decimal(line[0]) * 10**9) for line in lines], np.array([list(map(float, line[1:])) for line in lines])


def test_a_trajectory_has_every_digit_of_stamps_and_positions(tmp_path: Path) -> None:
    """Stamps are the log's own to the ns, positions are the estimates bit for bit in m, and nothing is turned."""
    est = pf.fuse(_recorded(), _configured("x y z"))
    est.to_tum(tmp_path / "fused.tum")
    stamps, numbers = _read(tmp_path / "fused.tum")
    assert stamps == [START_NS + round(time * 1e9) for time in est.time]
    assert np.array_equal(numbers[:, :3], np.column_stack([est[axis].position for axis in "xyz"]))
    assert np.array_equal(numbers[:, 3:], np.tile([0.0, 0.0, 0.0, 1.0], (len(est.time), 1)))


def test_with_a_frame_the_trajectories_are_in_the_coordinates_of_the_log(tmp_path: Path) -> None:
    """The reference, which is scored in the arm's axes, comes back to within rounding, also from a result folder."""
    config = _configured("tangential radial vertical", frame={"kind": "rotated", "azimuth_deg": 30.0})
    run = _recorded()
    results.write(pf.fuse(run, config), tmp_path / "fused", force=False)
    assert "trajectories written to " in pumafuse("compare", tmp_path / "fused", "--tum", tmp_path / "out").stdout
    stamps, numbers = _read(tmp_path / "out" / "fused.reference.tum")
    assert stamps == [START_NS + 7 + 20_000_000 * k for k in range(100)]
    truth = np.column_stack([run.reference.values[axis] for axis in "xyz"])
    assert np.abs(numbers[:, :3] - truth).max() < 1e-12
    _, estimated = _read(tmp_path / "out" / "fused.tum")
    assert np.abs(estimated[:, :3] - truth).max() < 0.1
