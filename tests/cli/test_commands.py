"""The real executable on real files."""

import json
import subprocess
import sys
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from executable import pumafuse

DATA = Path(str(files("pumafuse") / "data"))
SCAN, FUSION = DATA / "scan1", DATA / "fusion.toml"


def refused(*arguments: object) -> str:
    """The one line that a refusal prints."""
    lines = [line for line in pumafuse(*arguments, code=1).stderr.splitlines() if not line.startswith("warning: ")]
    assert len(lines) == 1, lines
    return lines[0]


def scores(folders: Sequence[Path], *more: object) -> list[dict[str, dict[str, float]]]:
    return [entry["axes"] for entry in json.loads(pumafuse("compare", *folders, *more, "--json").stdout)]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "result"
    out = pumafuse("demo", "-o", folder).stdout
    for name in ("fused.png", "fused.rrd", "summary.json"):
        assert f"{folder / name}" in out.replace("\n", "")
    return folder


@pytest.fixture(scope="module")
def with_tracker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tracker") / "result"
    pumafuse("fuse", SCAN, "-c", FUSION, "-o", folder, "--sensors", "tracker,vision", "--rate", 200)
    return folder


def test_the_demo_leaves_everything_it_promises(demo: Path) -> None:
    """Tables, the configuration as used, a picture and a recording that rerun accepts."""
    names = {path.name for path in demo.iterdir()}
    tables = {"estimates.parquet", "measurements.parquet", "reference.parquet"}
    figures = {"fused.png", "error.png", "validation.png"}
    assert names == tables | figures | {"summary.json", "fusion.toml", "arm.toml", "fused.rrd"}
    assert all((demo / name).read_bytes().startswith(b"\x89PNG") for name in figures)
    rerun = Path(sys.executable).parent / "rerun"
    assert subprocess.run([str(rerun), "rrd", "verify", str(demo / "fused.rrd")], check=False).returncode == 0


def test_the_scan_is_fused_as_well_as_promised(demo: Path, with_tracker: Path) -> None:
    """Vision alone within 0.40 / 0.23 / 0.20 mm, with the tracker within 0.090 / 0.056 / 0.066, coverage 90 to 99 %."""
    axes = ("tangential", "radial", "vertical")
    for found, limits in zip(scores([demo, with_tracker]), ((0.40, 0.23, 0.20), (0.090, 0.056, 0.066)), strict=True):
        for axis, limit in zip(axes, limits, strict=True):
            assert found[axis]["rmse_mm"] <= limit
            assert 0.90 <= found[axis]["coverage"] <= 0.99


def test_result_tables_have_the_documented_columns(with_tracker: Path) -> None:
    """Names and row counts of design and README: an even grid, every component of both sensors with its outcome."""
    estimates = pq.read_table(with_tracker / "estimates.parquet")
    kinds = ("position_mm", "position_sd_mm", "velocity_mm_s", "velocity_sd_mm_s", "offset_mm", "offset_sd_mm")
    expected = [f"{axis}.{kind}" for axis in ("tangential", "radial", "vertical") for kind in kinds]
    assert estimates.column_names == ["time_s", *expected]
    assert estimates["time_s"].to_pylist()[:3] == [0.0, 0.005, 0.01]
    measurements = pq.read_table(with_tracker / "measurements.parquet")
    assert measurements.column_names == [
        *("time_s", "stamp_s", "sensor", "axis", "value_mm"),
        *("innovation_mm", "innovation_sd_mm", "nis", "outcome"),
    ]
    assert measurements.num_rows == 3 * (5999 + 1704)
    summary = json.loads((with_tracker / "summary.json").read_text())
    counted = sum(
        n for axis in summary["axes"].values() for s in axis["sensors"].values() for n in s["outcomes"].values()
    )
    assert counted == measurements.num_rows


@pytest.mark.long
def test_the_configuration_as_used_gives_the_same_result(demo: Path, tmp_path: Path) -> None:
    """fusion.toml and arm.toml of a result folder reproduce it to the last bit."""
    again = tmp_path / "again"
    pumafuse("fuse", SCAN, "-c", demo / "fusion.toml", "-o", again, "--sensors", "vision", "--rate", 200)
    assert pq.read_table(again / "estimates.parquet").equals(pq.read_table(demo / "estimates.parquet"))


@pytest.mark.long
def test_a_reference_from_elsewhere_scores_the_same(demo: Path) -> None:
    """The run itself, or the reference table of a result, gives the scores of the folder's own reference."""
    own = scores([demo])
    for elsewhere in (SCAN, demo / "reference.parquet"):
        for axis, score in scores([demo], "--reference", elsewhere)[0].items():
            assert score == pytest.approx(own[0][axis], rel=1e-6)


def test_as_live_has_fewer_measurements(demo: Path, tmp_path: Path) -> None:
    """Vision is 45 ms late: an estimate that waits for it beats one that cannot, and the summary says which."""
    folder = tmp_path / "live"
    pumafuse("fuse", SCAN, "-c", FUSION, "-o", folder, "--sensors", "vision", "--rate", 200, "--as-live")
    live, waited = scores([folder, demo])
    assert live["tangential"]["rmse_mm"] > 1.1 * waited["tangential"]["rmse_mm"]
    assert json.loads((folder / "summary.json").read_text())["mode"] == "as-live"


@pytest.mark.long
def test_several_runs_get_a_folder_each_and_a_failure_stops_no_other(tmp_path: Path) -> None:
    """The good runs are there, the bad one is named, the exit code says that something failed."""
    done = pumafuse("fuse", tmp_path / "none", SCAN, "-c", FUSION, "-o", tmp_path / "out", "--sensors", "range", code=1)
    assert "none: no such file" in done.stderr
    assert "1 of 2 runs failed" in done.stderr
    assert (tmp_path / "out" / "scan1" / "summary.json").exists()


def test_an_existing_folder_is_replaced_only_with_force(demo: Path) -> None:
    """And nothing of it is lost when it is refused."""
    before = (demo / "summary.json").read_bytes()
    assert "--force" in refused("fuse", SCAN, "-c", FUSION, "-o", demo)
    assert (demo / "summary.json").read_bytes() == before


def test_force_never_replaces_a_folder_that_holds_something_else(tmp_path: Path) -> None:
    """A folder of somebody's files is not a result."""
    (tmp_path / "thesis.tex").write_text("…")
    assert "holds 'thesis.tex'" in refused("fuse", SCAN, "-c", FUSION, "-o", tmp_path, "--force")
    (tmp_path / "summary.json").write_text("{}")
    assert "holds 'thesis.tex'" in refused("fuse", SCAN, "-c", FUSION, "-o", tmp_path, "--force")
    assert (tmp_path / "thesis.tex").exists()


@pytest.mark.long
def test_force_replaces_an_earlier_result(tmp_path: Path) -> None:
    """The new result takes the old one's place whole."""
    folder = tmp_path / "result"
    pumafuse("fuse", SCAN, "-c", FUSION, "-o", folder, "--sensors", "range")
    pumafuse("fuse", SCAN, "-c", FUSION, "-o", folder, "--sensors", "vision", "--force")
    assert list(json.loads((folder / "summary.json").read_text())["axes"]["radial"]["sensors"]) == ["vision"]
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("fuse", "none", "-c", FUSION, "-o", "out"), "none: no such file"),
        (("fuse", SCAN, "-c", "none.toml", "-o", "out"), "none.toml: no such file"),
        (("fuse", SCAN, "-c", FUSION, "-o", "out", "--sensors", "trackr"), "did you mean 'tracker'?"),
        (("compare", SCAN), "no result folder"),
        (("discretize", "puma761"), "not a preset (puma560-internal, puma560-external)"),
        (("discretize", "puma560-internal", "--axis", "radail"), "did you mean 'radial'?"),
    ],
)
def test_bad_input_is_one_line_that_says_what_to_do(arguments: tuple[object, ...], expected: str) -> None:
    """What, where, and the accepted names; exit code 1."""
    assert expected in refused(*arguments)


@pytest.mark.parametrize(
    "arguments", [("fuse",), ("fuse", SCAN, "-c", FUSION, "-o", "out", "--rate", "-5"), ("nonsense",), ("compare",)]
)
def test_wrong_usage_exits_with_2(arguments: tuple[object, ...]) -> None:
    """Missing arguments and impossible options are usage errors."""
    pumafuse(*arguments, code=2)


def test_discretize_prints_the_model_it_names() -> None:
    """The JSON is the matrices of `pumafuse.discretize`, and its step response settles at 1."""
    import numpy as np

    import pumafuse as pf

    shown = json.loads(pumafuse("discretize", "puma560-internal", "--json").stdout)
    arm = pf.ArmModel.load("puma560-internal")
    assert list(shown["axes"]) == ["tangential", "radial", "vertical"]
    for name, axis in shown["axes"].items():
        model = pf.discretize(arm.axes[name], 0.028, 0.06045, input_noise=1.0)
        for letter in "FBHQ":
            assert np.array_equal(axis[letter], getattr(model, letter))
        assert axis["delay_ms"] == 60.45
        assert axis["step_response_mm"][-1] == pytest.approx(1.0, abs=2e-3)


def test_help_imports_nothing_heavy() -> None:
    """`--help` stays fast because parsing needs no numpy."""
    code = (
        "import sys; from pumafuse.cli.main import app\n"
        "try: app(['fuse', '--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'scipy', 'pyarrow', 'rerun', 'filterpy', 'matplotlib', 'rich'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def servo(name: str) -> Path:
    folder = Path(__file__).parents[2] / "../shared/data/servo" / name
    if not folder.exists():
        pytest.skip("the recordings of the real servo are not part of this repository")
    return folder


@pytest.mark.long
@pytest.mark.parametrize(("name", "limit"), [("sin_sin", 1.4), ("sin_time_square", 5.4)])
def test_a_real_servo_is_followed_between_rare_measurements(name: str, limit: float, tmp_path: Path) -> None:
    """Within 1.4 and 5.4 mm, where the last measurement held is 10 and 26.6 mm off.

    Commands come every 20 ± 3 ms, the encoder is read once in 100 ms, and arm.toml is written by hand.
    """
    (tmp_path / "arm.toml").write_text(
        'name = "STS3250"\nupdate_period_ms = 20.0\ndelay_ms = 5.0\n'
        '[axes.tip]\nplant = "first-order"\ntime_constant_ms = 30.0\ngain = { intercept = 0.98 }\n'
    )
    (tmp_path / "fusion.toml").write_text(
        'arm = "arm.toml"\n[process]\ninput_noise_mm_rtHz = 0.5\ndrift_mm_rts = 5.0\n'
        "[sensors.encoder]\nsd_mm = 0.1\ngate = 0\n"
    )
    pumafuse("fuse", servo(name), "-c", tmp_path / "fusion.toml", "-o", tmp_path / "out", "--rate", 200)
    assert scores([tmp_path / "out"])[0]["tip"]["rmse_mm"] <= limit


def test_a_result_that_cannot_be_swapped_in_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the last rename fails, what stood there before stands there still."""
    from pumafuse import folders

    folder = tmp_path / "result"
    folder.mkdir()
    (folder / "summary.json").write_text("old")
    rename = Path.replace

    def broken(self: Path, target: Path) -> Path:
        if self.name == "new":
            raise OSError(5, "disk gone")
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", broken)
    with pytest.raises(folders.FolderError, match="disk gone"), folders.replacing(folder) as new:
        (new / "summary.json").write_text("new")
    assert (folder / "summary.json").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


def test_folders_of_runs_that_share_a_name_do_not_meet(tmp_path: Path) -> None:
    """`a/scan`, `b/scan` and `scan_2` get a folder each, and dots in a folder's name stay."""
    from pumafuse.cli.fuse import _folders

    runs = [tmp_path / name for name in ("scan_2", "a/scan", "b/scan", "scan_0.5mm", "scan_0.8mm")]
    for run in runs:
        run.mkdir(parents=True)
    assert [folder.name for folder in _folders(runs, tmp_path)] == [
        "scan_2",
        "scan",
        "scan_3",
        "scan_0.5mm",
        "scan_0.8mm",
    ]
