"""The command line on real files: `demo`, `fuse`, `compare`, `discretize`, and refusals of every command."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import pumafuse as pf
from executable import DATA, EXECUTABLE, FUSION, SCAN, names, pumafuse, refused
from pumafuse.cli.fuse import folders_of

pytestmark = pytest.mark.xdist_group("demo")  # one result serves many
AXES = ("tangential", "radial", "vertical")
FUSE_SCAN = ("fuse", SCAN, "-c", FUSION, "--rate", 200)


def scores(folders: Sequence[Path], *more: object) -> list[dict[str, dict[str, float]]]:
    return [entry["axes"] for entry in json.loads(pumafuse("compare", *folders, *more, "--json").stdout)]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "result"
    out = pumafuse("demo", "-o", folder).stdout
    assert all(f"{folder / name}" in out for name in ("fused.png", "fused.rrd", "summary.json"))
    return folder


@pytest.fixture(scope="module")
def with_tracker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tracker") / "result"
    pumafuse(*FUSE_SCAN, "-o", folder, "--sensors", "tracker,vision")
    return folder


def test_the_demo_leaves_everything_it_promises(demo: Path) -> None:
    """Tables, the configuration as used, pictures and a small recording that rerun accepts."""
    tables = {"estimates.parquet", "measurements.parquet", "reference.parquet"}
    figures = {"fused.png", "error.png", "validation.png"}
    assert names(demo) == tables | figures | {"summary.json", "log.json", "fusion.toml", "arm.toml", "fused.rrd"}
    assert all((demo / name).read_bytes().startswith(b"\x89PNG") for name in figures)
    assert 100_000 < (demo / "fused.rrd").stat().st_size < 10_000_000
    rerun = Path(sys.executable).parent / "rerun"
    assert subprocess.run([str(rerun), "rrd", "verify", str(demo / "fused.rrd")], check=False).returncode == 0


def test_the_scan_is_fused_as_well_as_promised(demo: Path, with_tracker: Path) -> None:
    """Vision alone within 0.40 / 0.23 / 0.20 mm, with the tracker within 0.090 / 0.056 / 0.066, coverage 90 to 99 %."""
    for found, limits in zip(scores([demo, with_tracker]), ((0.40, 0.23, 0.20), (0.090, 0.056, 0.066)), strict=True):
        for axis, limit in zip(AXES, limits, strict=True):
            assert found[axis]["rmse_mm"] <= limit
            assert 0.90 <= found[axis]["coverage"] <= 0.99


def test_result_tables_have_the_documented_columns(with_tracker: Path) -> None:
    """Names and row counts of design and README: an even grid, every component of both sensors with its outcome."""
    estimates = pq.read_table(with_tracker / "estimates.parquet")
    kinds = (
        "position_mm",
        "position_sd_mm",
        "velocity_mm_s",
        "velocity_sd_mm_s",
        "offset_mm",
        "offset_sd_mm",
        "disturbance_mm",
        "disturbance_sd_mm",
    )
    assert estimates.column_names == ["time_s", *(f"{axis}.{kind}" for axis in AXES for kind in kinds)]
    assert estimates["time_s"].to_pylist()[:3] == [0.0, 0.005, 0.01]
    measurements = pq.read_table(with_tracker / "measurements.parquet")
    assert measurements.column_names == [
        *("time_s", "stamp_s", "sensor", "axis", "value_mm"),
        *("innovation_mm", "innovation_sd_mm", "nis", "noise_scale", "outcome"),
    ]
    axes = json.loads((with_tracker / "summary.json").read_text())["axes"].values()
    counted = sum(n for axis in axes for sensor in axis["sensors"].values() for n in sensor["outcomes"].values())
    assert counted == measurements.num_rows == 3 * (5999 + 1704)


@pytest.mark.long
@pytest.mark.parametrize("command", ["fuse", "tune"])
def test_a_part_that_is_none_is_refused(command: str, tmp_path: Path) -> None:
    """An option that is no time is a wrong usage; a part without measurements is one line about the data."""
    given = (command, SCAN, "-c", FUSION, "-o", tmp_path / "out")
    for option, ends in {"--to": ("20", "20"), "--from": ("-1", "3"), "--from ": ("nan", "3")}.items():
        error = pumafuse(*given, "--from", ends[0], "--to", ends[1], code=2).stderr
        assert option.strip() in error and "seconds after" in error
    assert "no measurement to use is stamped from 100 s after" in refused(*given, "--from", 100)
    assert not (tmp_path / "out").exists()


def test_only_an_earlier_result_is_replaced_and_only_with_force(with_tracker: Path, tmp_path: Path) -> None:
    """Nothing of it is lost when it is refused; a folder of somebody's files is not a result."""
    before = (with_tracker / "summary.json").read_bytes()
    assert "--force" in refused(*FUSE_SCAN, "-o", with_tracker)
    assert (with_tracker / "summary.json").read_bytes() == before
    for name in ("thesis.tex", "summary.json"):
        (tmp_path / name).write_text("{}")
        assert "holds 'thesis.tex'" in refused(*FUSE_SCAN, "-o", tmp_path, "--force")
    assert names(tmp_path) == {"thesis.tex", "summary.json"}


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("fuse", "none", "-c", FUSION, "-o", "out"), "none: no such file"),
        (("fuse", SCAN, "-c", "none.toml", "-o", "out"), "none.toml: no such file"),
        (("tune", DATA, "-c", FUSION, "-o", "out"), "has no run.toml; `pumafuse init"),
        ((*FUSE_SCAN, "-o", "out", "--sensors", "trackr"), "did you mean 'tracker'?"),
        (("discretize", "puma761"), "not a preset (puma560-internal, puma560-external)"),
        (("discretize", "puma560-internal", "--axis", "radail"), "did you mean 'radial'?"),
    ],
)
def test_bad_input_is_one_line_that_says_what_to_do(arguments: tuple[object, ...], expected: str) -> None:
    assert expected in refused(*arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        ("fuse",),
        (*FUSE_SCAN, "-o", "out", "--rate", "-5"),
        (*FUSE_SCAN, "-o", "out", "--smooth", "--as-live"),
        ("nonsense",),
        ("simulate", "short.toml", "-o", "out", "--runs", "0"),
        ("identify", "none", "-o", "out", "--period", "nan"),
        ("live", "udp://:5005", "-c", FUSION, "--listen", "0.0.0.0"),
        ("live", "udp://:5005", "-c", FUSION, "--allow", "10.0.0.0/8"),
    ],
)
def test_wrong_usage_exits_with_2(arguments: tuple[object, ...]) -> None:
    assert pumafuse(*arguments, code=2).stdout == ""


def test_discretize_prints_the_model_it_names() -> None:
    """The JSON is the matrices of `pumafuse.discretize`, and its step response settles at 1."""
    shown = json.loads(pumafuse("discretize", "puma560-internal", "--json").stdout)
    arm = pf.ArmModel.load("puma560-internal")
    assert tuple(shown["axes"]) == AXES
    for name, axis in shown["axes"].items():
        model = pf.discretize(arm.axes[name], 0.028, 0.06045, input_noise=1.0)
        assert all(np.array_equal(axis[letter], getattr(model, letter)) for letter in "FBHQ")
        assert axis["delay_ms"] == 60.45
        assert axis["step_response_mm"][-1] == pytest.approx(1.0, abs=2e-3)


@pytest.mark.long
def test_an_interrupt_of_a_command_is_a_line() -> None:
    """Exit code 130, while it works, too."""
    code = (
        "import os, signal, sys\n"
        "import pumafuse.cli.fuse as command\n"
        "command.run = lambda *_: os.kill(os.getpid(), signal.SIGINT)\n"
        f"sys.argv = ['pumafuse', 'fuse', '{SCAN}', '-c', '{FUSION}', '-o', 'none']\n"
        "from pumafuse.cli.main import main\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_a_configuration_if_somebody_writes_into_it(tmp_path: Path) -> None:
    """A line where nobody does, not a wait for ever; what a shell's `<(...)` runs may take its time."""
    pipe = tmp_path / "fusion.toml"
    os.mkfifo(pipe)
    assert "nobody writes" in refused("fuse", SCAN, "-c", pipe, "-o", tmp_path / "none")
    slowly = f"'{EXECUTABLE}' fuse '{SCAN}' -c <(sleep 4; exec cat '{FUSION}') -o '{tmp_path / 'fused'}'"
    subprocess.run(["bash", "-c", slowly], capture_output=True, check=True)


@pytest.mark.parametrize(
    ("words", "heavy"),
    [
        (["fuse", "--help"], {"numpy", "scipy", "pyarrow", "rerun", "filterpy", "matplotlib", "rich"}),
        (
            [*map(str, FUSE_SCAN), "-o", "out"],
            {"control", "rerun", "filterpy", "matplotlib", "statsmodels", "numpy.ma"},
        ),
    ],
)
def test_nothing_is_imported_that_is_not_needed(words: list[str], heavy: set[str], tmp_path: Path) -> None:
    """`--help` stays fast because parsing needs no numpy. pyarrow would import pandas for any list made a column."""
    code = (
        "import sys; from pumafuse.cli.main import app\n"
        f"try: app({words})\n"
        "except SystemExit as end: assert not end.code\n"
        f"sys.exit(str(found) if (found := {heavy | {'pandas'}} & set(sys.modules)) else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_folders_of_runs_that_share_a_name_do_not_meet(tmp_path: Path) -> None:
    """`a/scan`, `b/scan` and `scan_2` get a folder each; dots in a folder's name stay, endings of a table go."""
    runs = [tmp_path / name for name in ("scan_2", "a/scan", "b/scan", "scan_0.5mm", "scan_0.8mm")]
    for run in runs:
        run.mkdir(parents=True)
    places = folders_of([*runs, tmp_path / "one.csv.gz"], tmp_path)
    assert [folder.name for folder in places] == ["scan_2", "scan", "scan_3", "scan_0.5mm", "scan_0.8mm", "one"]
