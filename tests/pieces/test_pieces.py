"""Long runs piece by piece: the results of the whole run, whatever is wrong with rows beside a cut."""

import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import pumafuse as pf
from executable import names
from pumafuse.cli import fuse as command
from pumafuse.errors import PumafuseError, RunError
from pumafuse.folders import FolderError
from pumafuse.fusion import results
from pumafuse.fusion.summary import Summary
from pumafuse.logs import tables
from pumafuse.model.arm import AxisModel, Sag
from pumafuse.model.plants import FirstOrder, SecondOrder
from pumafuse.pieces import fusing, reading
from pumafuse.pieces.reading import rows_of

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
MS = 1_000_000
ORIGIN = 1_700_000_000_123_456_789
SPAN = 60.0  # s
CONFIG = pf.FusionConfig(
    arm=pf.ArmModel(
        name="two axes",
        update_period=0.028,
        delay=0.06,
        axes={
            "x": AxisModel(plant=SecondOrder(natural_frequency=20.0, damping=0.8), gain_recovery=0.1, max_speed=0.044),
            "y": AxisModel(plant=FirstOrder(time_constant=0.05), delay=0.02, play=2e-4, sag=Sag(slope=1e-3)),
        },
    ),
    process={
        "x": pf.Process(maneuver_noise=2e-2, drift=1e-3, disturbance_sd=1e-3),
        "y": pf.Process(maneuver_noise=2e-2, drift=2e-3),
    },
    sensors={
        "camera": pf.Sensor(sd=5e-4, latency=0.045, gate=5.0, bias_sd=0.01, latency_sd=1e-3),
        "tracker": pf.Sensor(sd=1e-4, latency=-0.002, gate=5.0, bias_drift_sd=1e-4),
    },
)
Rows = dict[str, np.ndarray]
LAG = {"x": 0.154, "y": 0.084}  # of the model, s


def moved(axis: str, t: np.ndarray) -> np.ndarray:
    """Where the arm goes, which stands still in the pause of the commands."""
    along = np.minimum(t, 15.0) + np.maximum(t - 40.0, 0.0)
    return 0.5 + 0.05 * np.sin(along * (0.9 if axis == "x" else 0.4))


def rows(rate: float, late: float, noise: float, seed: int, axes: str = "xy") -> tuple[Rows, np.ndarray]:
    """Rows of a sensor, and when each is written [s]: some late, twice, without a value, or outliers."""
    rng = np.random.default_rng(seed)
    t = np.arange(-0.2, SPAN, 1.0 / rate) + rng.uniform(0.0, 1e-3)
    found: Rows = {"t": t} | {axis: moved(axis, t - LAG[axis]) + rng.normal(0.0, noise, len(t)) for axis in axes}
    wild = rng.random(len(t)) < 0.02
    found[axes[0]] = np.where(wild, found[axes[0]] + 0.02, found[axes[0]])
    found[axes[-1]] = np.where(rng.random(len(t)) < 0.01, np.nan, found[axes[-1]])
    arrival = t + rng.uniform(0.2, late, len(t)) * (rng.random(len(t)) < 0.05)
    double = rng.random(len(t)) < 0.01
    return {k: np.concatenate([v, v[double]]) for k, v in found.items()}, np.concatenate(
        [arrival, arrival[double] + 0.3]
    )


def sources() -> dict[str, tuple[Rows, np.ndarray]]:
    """Commands with a pause of 25 s and some said twice, two sensors, a reference."""
    t = np.arange(0.0, SPAN, 0.028)
    t = t[(t < 15.0) | (t > 40.0)]
    t = np.sort(np.concatenate([t, t[::50], t[::70] + 0.002]))
    commands = {"t": t, "x": moved("x", np.floor(t / 0.028) * 0.028), "y": moved("y", np.floor(t / 0.028) * 0.028)}
    arrival = t + np.where(np.arange(len(t)) % 97 == 5, 0.4, 0.0)
    exact = np.arange(0.0, SPAN, 0.02)
    truth = {"t": exact, "x": moved("x", exact - LAG["x"]), "y": moved("y", exact - LAG["y"])}
    return {
        "command": (commands, arrival),
        "camera": rows(30.0, 1.4, 5e-4, 1),
        "tracker": rows(100.0, 0.8, 1e-4, 2, "x"),
        "reference": (truth, exact),
    }


def stamps(t: np.ndarray) -> np.ndarray:
    return ORIGIN + np.rint(t * 1e9).astype(np.int64)


def written(folder: Path, *, single: bool, damage: Any = None) -> Path:
    """The run as one Parquet table, or as one for each source with run.toml."""
    given = sources()
    if damage is not None:
        damage(given)
    folder.mkdir()
    if single:
        arrival = np.concatenate([arrival for _, arrival in given.values()])
        order = np.argsort(arrival, kind="stable")
        columns = {"time_ns": np.concatenate([stamps(one["t"]) for one, _ in given.values()])[order]}
        for name, (one, _) in given.items():
            for axis in one.keys() - {"t"}:
                parts = [v[axis] if other == name else np.full(len(v["t"]), np.nan) for other, (v, _) in given.items()]
                columns[f"{name}.{axis}_m"] = np.concatenate(parts)[order]
        pq.write_table(pa.table(columns), folder / "log.parquet")
        return folder / "log.parquet"
    lines = ['name = "log"']
    for name, (one, arrival) in given.items():
        order = np.argsort(arrival, kind="stable")
        columns = {f"{axis}_m": one[axis][order] for axis in sorted(one.keys() - {"t"})}
        error = np.resize([0.2, 0.2, 0.7], len(order))
        table = pa.table({"time_ns": stamps(one["t"])[order], "error_mm": error, **columns})
        pq.write_table(table, folder / f"{name}.parquet")
        head = name if name in ("command", "reference") else f"sensors.{name}"
        axes = "\n".join(f"{column[0]} = '{column}'" for column in columns)
        lines.append(f"[{head}]\nfile = '{name}.parquet'\ntime = 'time_ns'\narrived = 'time_ns'\n{axes}")
        lines += ["noise = { sd = 'error_mm', typical = 0.2 }"] if name == "camera" else []
    (folder / "run.toml").write_text("\n".join(lines))
    return folder


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces of few rows."""
    monkeypatch.setattr(tables, "_BATCH", 300)
    monkeypatch.setattr(fusing, "PIECE", 1000)
    monkeypatch.setattr(reading, "WAIT_NS", 2000 * MS)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    """The run as one table, and not."""
    return {single: written(tmp_path_factory.mktemp("logs") / "log", single=single) for single in (True, False)}


TABLES = results.ESTIMATES, results.MEASUREMENTS, results.REFERENCE


def both_ways(
    path: Path,
    folder: Path,
    part: tuple[float | None, float | None] = (None, None),
    same: Sequence[str] = TABLES,
    progress: Callable[[float], None] | None = None,
    **how: Any,
) -> tuple[Summary, Summary]:
    """Summaries of the run as a whole and in pieces, of which tables must be the same to the last bit."""
    whole = results.write(pf.fuse(pf.Run.read(path).between(*part), CONFIG, **how), folder / "whole", False)
    pieces = fusing.fuse_to(path, folder / "pieces", results.Recipe(CONFIG, part=part, **how), progress=progress)
    assert names(folder / "whole") | {"log.json"} == names(folder / "pieces")
    for name in same:
        assert pq.read_table(folder / "pieces" / name) == pq.read_table(folder / "whole" / name), name
    return whole, pieces


def close(found: Any, expected: Any, relative: float) -> bool:
    return found == expected or abs(found - expected) <= relative * abs(expected)


@pytest.mark.parametrize(
    ("single", "how"),
    [
        (True, {"part": (5.0, 50.0), "rate": 90.0}),
        (False, {"rate": 100.0}),
        *(pytest.param(*one, marks=pytest.mark.long) for one in ((True, {}), (False, {"sensors": ["camera"]}))),
    ],
)
def test_pieces_are_the_whole(logs: dict[bool, Path], tmp_path: Path, single: bool, how: dict[str, Any]) -> None:
    """Estimates, outcomes and the reference to the last bit; counts equal; scores and NIS to rounding.

    There are many pieces, in some of which no command is.
    """
    shares = list[float]()
    expected, found = both_ways(logs[single], tmp_path, progress=shares.append, **how)
    assert len(shares) > 5 and shares == sorted(shares) and shares[-1] == 1.0
    assert any(f"fused in {len(shares)} pieces" in note for note in found.notes)
    overruns = [[note for note in summary.notes if "ask for more" in note] for summary in (found, expected)]
    assert overruns[0] == overruns[1] and len(overruns[0]) == 1
    assert found.estimates == expected.estimates and found.duration_s == expected.duration_s
    if how.get("part", (None, None))[1] is None:  # what comes behind the part is not read
        assert (found.commands, found.rows) == (expected.commands, expected.rows)
    for axis, one in expected.axes.items():
        mine = found.axes[axis]
        assert (mine.score.rows, mine.score.left_out) == (one.score.rows, one.score.left_out)
        for name in ("rmse", "bias", "coverage", "nees_mean"):
            assert close(getattr(mine.score, name), getattr(one.score, name), 1e-9), name
        assert close(mine.score.velocity_rmse, one.score.velocity_rmse, 1e-2)
        assert close(mine.log_likelihood, one.log_likelihood, 1e-12)
        assert mine.nees_band == one.nees_band
        for sensor, its in one.sensors.items():
            other = mine.sensors[sensor]
            assert other.outcomes == its.outcomes
            assert close(other.nis_mean, its.nis_mean, 1e-9) and other.nis_band == its.nis_band
            assert close(other.innovation_rms, its.innovation_rms, 0.02)
            assert np.allclose(other.correlation[:3], its.correlation[:3], atol=0.15)
            assert other.verdict.split(":")[0] == its.verdict.split(":")[0]
            assert close(other.skill.filter.rms, its.skill.filter.rms, 0.05)
            assert close(other.skill.command_alone.rms, its.skill.command_alone.rms, 0.5)


def test_what_stands_for_none_is_told_by_the_whole_file(tmp_path: Path) -> None:
    """Of ten seconds in which a tracker is lost some pieces have nothing else, and the first rows none of it."""

    def is_lost(given: dict[str, tuple[Rows, np.ndarray]]) -> None:
        tracker = given["tracker"][0]
        tracker["x"] = np.where((tracker["t"] > 41.0) & (tracker["t"] < 51.0), -32768.0, tracker["x"])

    path = written(tmp_path / "log", single=False, damage=is_lost)
    for file in path.glob("*.parquet"):
        pq.write_table(pq.read_table(file), file, write_statistics=False)
    expected, found = both_ways(path, tmp_path)
    estimates = pq.read_table(tmp_path / "pieces" / results.ESTIMATES)
    assert np.abs(estimates["x.position_mm"].to_numpy()).max() < 1e3
    assert found.rows["tracker"] == expected.rows["tracker"]


def test_a_fault_is_the_verdict_of_pieces_and_whole(tmp_path: Path) -> None:
    """A camera that moves against the commands of y: no noise is its cause."""

    def is_turned(given: dict[str, tuple[Rows, np.ndarray]]) -> None:
        given["camera"][0]["y"] = 1.0 - given["camera"][0]["y"]

    for summary in both_ways(written(tmp_path / "log", single=False, damage=is_turned), tmp_path):
        of_camera = {axis: of_axis.sensors["camera"] for axis, of_axis in summary.axes.items()}
        assert of_camera["y"].finding == "faulty" and "motion against the commands" in of_camera["y"].verdict
        assert of_camera["x"].finding != "faulty"


@pytest.mark.long
def test_what_stands_for_none_in_a_piece_may_be_a_position_in_the_file(tmp_path: Path) -> None:
    """999 m is ten times as far as all else of its piece; but much later once there are 150 m."""

    def is_far(given: dict[str, tuple[Rows, np.ndarray]]) -> None:
        camera = given["camera"][0]
        camera["y"] = np.where((camera["t"] > 18.0) & (camera["t"] < 24.0), 999.0, camera["y"])
        camera["y"][1600] = 150.0

    path = written(tmp_path / "log", single=False, damage=is_far)
    expected, found = both_ways(path, tmp_path)
    assert found.rows["camera"] == expected.rows["camera"]
    assert not [note for note in found.notes if "ten times as far" in note]


def test_rows_that_come_too_late(tmp_path: Path) -> None:
    """One stray row is left out, with its number; many, or a clock that was set back, are refused."""

    def stray(given: dict[str, tuple[Rows, np.ndarray]]) -> None:
        given["camera"][0]["t"][900] -= 20.0

    path = written(tmp_path / "stray", single=True, damage=stray)
    found = fusing.fuse_to(path, tmp_path / "out", results.Recipe(CONFIG))
    assert [note for note in found.notes if "1 row left out, stamped more than 10 s behind" in note]
    whole = pf.fuse(pf.Run.read(path), CONFIG)
    assert sum(found.rows["camera"].values()) == sum(whole.counts["camera"].values()) - 1
    assert found.rows["tracker"] == whole.counts["tracker"]

    def back(given: dict[str, tuple[Rows, np.ndarray]]) -> None:
        late, arrival = given["camera"]
        late["t"] = np.where(arrival > 50.0, late["t"] - 30.0, late["t"])

    path = written(tmp_path / "back", single=True, damage=back)
    before = set(tmp_path.iterdir())
    with pytest.raises(PumafuseError, match=r"behind an earlier one|set back") as error:
        fusing.fuse_to(path, tmp_path / "refused", results.Recipe(CONFIG))
    assert "\n" not in str(error.value) and set(tmp_path.iterdir()) == before


@pytest.mark.long
def test_stray_and_missing_stamps(tmp_path: Path) -> None:
    """Rows far ahead and rows without a stamp: the same estimates, and the same counts."""

    def ahead(given: dict[str, tuple[Rows, np.ndarray]]) -> None:
        for name, row in (("camera", 700), ("command", 400), ("tracker", 5000)):
            given[name][0]["t"][row] += 1000.0

    path = written(tmp_path / "log", single=False, damage=ahead)
    table = pq.read_table(path / "tracker.parquet")
    stamps = table["time_ns"].to_pylist()
    stamps[3000:3010] = [None] * 10
    pq.write_table(table.set_column(0, "time_ns", pa.array(stamps, pa.int64())), path / "tracker.parquet")
    expected, found = both_ways(path, tmp_path, same=[results.ESTIMATES])
    assert (found.rows, found.commands) == (expected.rows, expected.commands)
    assert found.rows["tracker"]["no_stamp"] == 10 and found.rows["tracker"]["stray"] == 1


def test_what_cannot_be_written_leaves_nothing(
    logs: dict[bool, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk, Ctrl-C in the middle, a run of which nothing is fused, and a part without any estimate."""
    digest = fusing.digest
    for error in (OSError(28, "No space left on device"), KeyboardInterrupt()):
        pieces = iter([None, None, error])

        def interrupted(*arguments: Any, pieces: Any = pieces) -> Any:
            if problem := next(pieces):
                raise problem
            return digest(*arguments)

        with monkeypatch.context() as context:
            context.setattr(fusing, "digest", interrupted)
            with pytest.raises((FolderError, KeyboardInterrupt)):
                fusing.fuse_to(logs[True], tmp_path / "out", results.Recipe(CONFIG))
        assert not list(tmp_path.iterdir())
    with pytest.raises(RunError, match="nothing was fused"):
        fusing.fuse_to(logs[True], tmp_path / "out", results.Recipe(msgspec.structs.replace(CONFIG, sensors={})))
    with pytest.raises(RunError, match=r"there is no tick of 0\.01 Hz in the part of the run"):
        fusing.fuse_to(logs[True], tmp_path / "out", results.Recipe(CONFIG, part=(5.0, 50.0), rate=0.01))
    assert not list(tmp_path.iterdir())


def test_the_command_line_takes_the_way_by_the_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the limits a run goes through in pieces; what needs the whole is done up to a limit, and then refused."""
    path = written(tmp_path / "log", single=False)
    assert rows_of(path) == sum(pq.read_metadata(file).num_rows for file in path.glob("*.parquet"))
    CONFIG.save(tmp_path)
    monkeypatch.setattr(command, "SHORT", 1000)

    def fused(name: str, **how: Any) -> int:
        command.run([path], tmp_path / "fusion.toml", tmp_path / name, **how)
        return pq.ParquetFile(tmp_path / name / "estimates.parquet").num_row_groups

    assert fused("pieces") > 5
    assert fused("whole", mode="smoothed") == 1
    monkeypatch.setattr(command, "MOST_IN_MEMORY", 2000)
    with pytest.raises(RunError, match="--smooth needs the whole run in memory, and 0 million rows are too many"):
        fused("refused", mode="smoothed")
    manifest = path / "run.toml"
    manifest.write_text(manifest.read_text().replace("[command]", "[command]\nclock = 'regular'"))
    with pytest.raises(RunError, match="clock = 'regular' needs the whole run"):
        fused("refused")
    manifest.write_text(manifest.read_text().replace("'camera.parquet'", "'camera.parquet'\nwhere = { x_m = 1.0 }"))
    assert rows_of(path) == 0  # how many are chosen is not known


def test_dates_as_text_are_read_as_a_whole(tmp_path: Path) -> None:
    """All of a column tells which number of 11/12/2026 is the day."""
    path = written(tmp_path / "log", single=False)
    file = path / "command.parquet"
    table = pq.read_table(file)
    dates = pa.array(["11/12/2026 10:00:00"] * len(table))
    pq.write_table(table.set_column(table.schema.get_field_index("time_ns"), "time_ns", dates), file)
    assert rows_of(path) == 0


BIG = """
import resource, sys, warnings
from pathlib import Path
import numpy as np, pyarrow as pa, pyarrow.parquet as pq
import pumafuse as pf
from pumafuse.fusion.results import Recipe
from pumafuse.pieces.fusing import fuse_to

folder, rows = Path(sys.argv[1]), int(sys.argv[2])
config = pf.FusionConfig(arm=pf.ArmModel.load("puma560-internal"), sensors={"tracker": pf.Sensor(sd=1e-3)})
schema = pa.schema([("time_ns", pa.int64()), ("command.radial_mm", pa.float64()), ("tracker.radial_mm", pa.float64())])
with pq.ParquetWriter(folder / "log.parquet", schema) as writer:
    for first in range(0, rows, 1_000_000):
        n = np.arange(first, first + 1_000_000)
        position = 560.0 + np.sin(n * 1e-3)
        command = pa.array(position, mask=n % 28 != 0)
        writer.write_table(pa.table([pa.array(n * 1_000_000), command, pa.array(position)], schema=schema))
warnings.simplefilter("ignore")
fuse_to(folder / "log.parquet", folder / "out", Recipe(config))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.long
def test_memory_does_not_grow_with_the_run(tmp_path: Path) -> None:
    """Six million rows take as much as three, to a fifth."""
    peak = list[int]()
    for rows in (3_000_000, 6_000_000):
        folder = tmp_path / str(rows)
        folder.mkdir()
        done = subprocess.run(
            [sys.executable, "-c", BIG, folder, str(rows)], capture_output=True, text=True, check=True
        )
        peak.append(int(done.stdout))
        assert pq.read_metadata(folder / "out" / "measurements.parquet").num_rows == rows
    assert peak[1] < 1.2 * peak[0]
