"""Recorded runs: a folder with its manifest, one table, or arrays, all meaning the same."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv as pacsv
import pyarrow.parquet as papq
import pytest

from pumafuse.arrays import NO_STAMP
from pumafuse.errors import PumafuseError
from pumafuse.logs import manifest
from pumafuse.logs.run import Run
from pumafuse.logs.source import Source
from refusals import one_line

HOST = "t_ms,nominal_mm,correction_um,z_m,note\n0,560,500,0.1,a\n28,561,-500,0.2,b\n56,561,,0.2,c\n"
TRACKER = "stamp_us,y_mm,z_mm\n5000,569.5,\n15000,,-93\n"
TRUTH = "t_s,y_mm\n0.0,560.25\n0.1,561.25\n"

COMMAND = """
[command]
file = "host.csv"
time = "t_ms"
radial = ["nominal_mm", "correction_um"]
vertical = "z_m"
"""
SENSOR = """
[sensors.tracker]
file = "tracker.csv"
time = "stamp_us"
radial = "y_mm"
vertical = "z_mm"
"""
REFERENCE = """
[reference]
file = "truth.csv"
time = "t_s"
radial = "y_mm"
"""
SINGLE = (
    "time_s,command.vertical_mm,command.radial_mm,tracker.radial_um,reference.radial_m,weather,speed_mm_s\n"
    "0,10,560,,,dry,1\n0.01,,,569500,,,\n0.028,20,,,0.5,,\n0.03,,,,,,\n"
)
COLUMNS = "t_ms, nominal_mm, correction_um, z_m, note"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "scan"
    folder.mkdir()
    for name, text in {"host.csv": HOST, "tracker.csv": TRACKER, "truth.csv": TRUTH}.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def read(folder: Path, manifest: str) -> Run:
    (folder / "run.toml").write_text(manifest, encoding="utf-8")
    return Run.read(folder)


def single(folder: Path, text: str, name: str = "log.csv") -> Run:
    (folder / name).write_text(text, encoding="utf-8")
    return Run.read(folder / name)


def refusal(call: Callable[[], object], kind: type[PumafuseError] = PumafuseError) -> str:
    return one_line(kind, call)


def check_source(source: Source, stamp: list[int], **values: list[float]) -> None:
    assert source.stamp.tolist() == stamp
    assert set(source.values) == set(values)
    for axis, wanted in values.items():
        np.testing.assert_allclose(source.values[axis], wanted, rtol=4e-16, atol=0)  # sums round in metres


def test_a_manifest_says_where_everything_stands(folder: Path) -> None:
    """Commands are sums of columns, if all have a value; each source has its own clock; empty cells are NaN."""
    start = "start = { radial_um = 560500 }\n"
    run = read(folder, 'name = "scan1"\n' + COMMAND + start + SENSOR + REFERENCE + "sd_mm = 0.02\n")
    assert run.name == "scan1"
    assert run.axes == ("radial", "vertical")
    stamp = [0, 28_000_000, 56_000_000]
    check_source(run.command, stamp, radial=[0.5605, 0.5605, np.nan], vertical=[0.1, 0.2, 0.2])
    check_source(run.sensors["tracker"], [5_000_000, 15_000_000], radial=[0.5695, np.nan], vertical=[np.nan, -0.093])
    check_source(run.reference, [0, 100_000_000], radial=[0.56025, 0.56125])
    assert run.reference.sd == 2e-5
    assert (run.start, run.clock, run.notes) == ({"radial": 0.5605}, "stamps", ())


MANIFEST_REFUSALS: dict[str, tuple[str, tuple[str, ...]]] = {
    # what the manifest says: what the one line must name
    "no command at all": ("", ("run.toml", "'command'")),
    "file is absent": (COMMAND.replace("host", "absent"), ("absent.csv", "no such file")),
    "file with a null character": (COMMAND.replace("host.csv", "a\\u0000b"), ("NUL",)),
    "time is absent": (COMMAND.replace("t_ms", "t_s"), ("host.csv", "'t_s'", "did you mean 't_ms'", COLUMNS)),
    "start without unit": (COMMAND + "start = { radial = 560.0 }", ("run.toml", "command.start.radial", "radial_mm")),
    "sensor of an unknown axis": (COMMAND + SENSOR + 'radail = "y_mm"', ("tracker", "'radail'", "radial, vertical")),
    "sensor with noise": (COMMAND + SENSOR + "sd_mm = 0.1", ("run.toml", "sensors.tracker.sd_mm", "column")),
    "unknown key": ("commands = 3\n" + COMMAND, ("run.toml", "'commands'", "did you mean 'command'", "sensors")),
    "endless nesting": (f"x = {'[' * 5000}{']' * 5000}\n{COMMAND}", ("run.toml", "nest")),
}


@pytest.mark.parametrize("case", MANIFEST_REFUSALS)
def test_a_wrong_manifest_is_refused_in_one_line(folder: Path, case: str) -> None:
    manifest, named = MANIFEST_REFUSALS[case]
    text = refusal(lambda: read(folder, manifest))
    assert all(words in text for words in named), text


def test_a_path_without_a_run_is_refused(tmp_path: Path) -> None:
    for name in ("absent", "absent.toml", "absent.csv"):
        assert "no such file" in refusal(lambda name=name: Run.read(tmp_path / name))
    assert refusal(lambda: Run.read(tmp_path)).startswith(f"{tmp_path}: has no run.toml; `pumafuse init ")


def test_a_single_table_holds_every_source(tmp_path: Path) -> None:
    """Each source has the rows where it says something, in the units of its columns."""
    run = single(tmp_path, SINGLE)
    assert (run.name, run.axes) == ("log", ("vertical", "radial"))
    check_source(run.command, [0, 28_000_000], radial=[0.56, np.nan], vertical=[0.01, 0.02])
    assert list(run.sensors) == ["tracker"]
    check_source(run.sensors["tracker"], [10_000_000], radial=[0.5695])
    assert run.reference is not None
    check_source(run.reference, [28_000_000], radial=[0.5])
    (note,) = run.notes
    assert "<source>.<axis>_mm are not used: weather, speed_mm_s" in note
    papq.write_table(pacsv.read_csv(tmp_path / "log.csv"), tmp_path / "log.parquet")
    again = Run.read(tmp_path / "log.parquet")
    for one, other in ((run.command, again.command), (run.sensors["tracker"], again.sensors["tracker"])):
        check_source(one, other.stamp.tolist(), **other.values)


@pytest.mark.parametrize(
    ("header", "named"),
    [
        ("stamp_s,command.radial_mm", ("time_s", "stamp_s, command.radial_mm")),
        ("time_s,time_ms", ("one time column", "time_s, time_ms")),
        ("time_s,tracker.radial_mm", ("command.<axis>_mm", "tracker.radial_mm")),
        ("time_s,command.radial_mm,tracker.radial_mm,tracker.radial_um", ("two columns", "tracker.radial")),
        ("time_s,command.radial_mm,tracker.vertical_mm", ("tracker", "'vertical'", "radial")),
    ],
)
def test_a_wrong_single_table_is_refused_in_one_line(tmp_path: Path, header: str, named: tuple[str, ...]) -> None:
    row = ",".join(["1"] * len(header.split(",")))
    text = refusal(lambda: single(tmp_path, f"{header}\n{row}\n"))
    assert all(words in text for words in named), text


def test_stamps_of_arrays_are_seconds_or_whole_nanoseconds() -> None:
    """Floats are seconds, rounded to ns, not finite means no stamp; integers are ns, to the last digit."""
    stamps = [1_700_000_000_123_456_789, 1_700_000_000_123_456_790]
    assert Run.from_arrays(stamps, {"radial": [0.0, 1.0]}).command.stamp.tolist() == stamps
    seconds = [0.1, np.nan, 123456.000000001, np.inf]
    run = Run.from_arrays(seconds, {"radial": np.zeros(4)})
    assert run.command.stamp.tolist() == [100_000_000, NO_STAMP, 123_456_000_000_001, NO_STAMP]
    dates = [*stamps, NO_STAMP, -1]  # datetime64 of any unit is exact, from 1970 on and before it
    run = Run.from_arrays(np.array(dates).view("M8[ns]"), {"radial": np.zeros(4)})
    assert run.command.stamp.tolist() == dates
    run = Run.from_arrays(np.array(["1970-01-02", "NaT"], "M8[D]"), {"radial": np.zeros(2)})
    assert run.command.stamp.tolist() == [86_400_000_000_000, NO_STAMP]


def test_what_a_run_is_read_from(folder: Path) -> None:
    """run.toml, each table once, each part of a recording that is a folder, and the URDF; of one table that alone."""
    bag = folder.parent / "bags" / "one"
    bag.mkdir(parents=True)
    for name in ("metadata.yaml", "one_0.db3"):
        (bag / name).write_text(name)
    (folder / "arm.urdf").write_text("<robot/>")
    robot = '[robot]\nurdf = "arm.urdf"\nbase = "a"\ntip = "b"\n'
    camera = SENSOR.replace("tracker", "camera", 1).replace("tracker.csv", "../bags/one")
    (folder / "run.toml").write_text(robot + COMMAND + SENSOR + camera + REFERENCE.replace("truth", "tracker"))
    parts = ["../bags/one/metadata.yaml", "../bags/one/one_0.db3"]
    found = manifest.stamps_of(folder)
    assert sorted(found) == [*parts, "arm.urdf", "host.csv", "run.toml", "tracker.csv"]
    assert found == manifest.stamps_of(folder / "run.toml")
    assert found["host.csv"] == (len(HOST), (folder / "host.csv").stat().st_mtime_ns)
    assert manifest.stamps_of(folder / "host.csv") == {"host.csv": found["host.csv"]}
    (folder / "arm.urdf").write_text("<robot></robot>")
    assert {name for name, stamp in manifest.stamps_of(folder).items() if stamp != found[name]} == {"arm.urdf"}
    (folder / "tracker.csv").unlink()
    assert manifest.stamps_of(folder) == manifest.stamps_of(folder / "none.csv") == {}


TRUTH_ROWS = ([0.0], {"radial": [0.0]})

ARRAY_REFUSALS: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    # what is given instead of two commands: what the one line must name
    "too few values": ({"command": {"radial": [1.0]}}, ("command", "radial", "(1,)", "(2,)")),
    "two dimensions": ({"time": [[0.0]], "command": {"radial": [[1.0]]}}, ("command", "(1, 1)")),
    "stamp and value in no row": ({"time": [0.0, np.nan], "command": {"radial": [np.inf, 1.0]}}, ("command", "radial")),
    "reference of an unknown axis": ({"reference": ([0.0], {"vertical": [1.0]})}, ("reference", "vertical", "radial")),
    "text for values": ({"command": {"radial": ["a", "b"]}}, ("command", "number")),
    "seconds beyond reach": ({"time": [0.0, 4.6e9]}, ("command", "stamp")),
    "dates beyond reach": ({"time": np.array(["1970-01-01", "2200-01-01"], "M8[D]")}, ("command", "stamp")),
    "reference with negative sd": ({"reference": TRUTH_ROWS, "reference_sd": -1.0}, ("reference", "sd")),
    "start nan": ({"start": {"radial": np.nan}}, ("start", "radial", "finite")),
}


@pytest.mark.parametrize("case", ARRAY_REFUSALS)
def test_arrays_that_do_not_fit_are_refused(case: str) -> None:
    more, named = ARRAY_REFUSALS[case]
    text = refusal(lambda: Run.from_arrays(**{"time": [0.0, 1.0], "command": {"radial": [0.0, 1.0]}, **more}))
    assert all(words in text for words in named), text
