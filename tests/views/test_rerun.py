"""Recordings are read back and compared with the estimates they were made from."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import rerun as rr
from rerun.chunk import RrdReader

import pumafuse as pf
from pumafuse.logs.frames import Cylindrical

DATA = Path(pf.__file__).parent / "data"


@pytest.fixture(scope="module")
def fused() -> tuple[pf.Estimates, pf.Run]:
    time = 100.0 + 0.028 * np.arange(50)
    rng = np.random.default_rng(1)
    stamps = 100.0 + 0.01 * np.arange(140)
    sight = 0.5 + 1e-4 * rng.standard_normal(140)
    sight[70] += 0.1
    run = pf.Run.from_arrays(
        time,
        {"radial": 0.5 + 1e-4 * np.arange(50)},
        {"camera": (stamps, {"radial": sight})},
        (stamps, {"radial": np.full(140, 0.5)}),
    )
    config = pf.FusionConfig(
        arm=pf.ArmModel.load("puma560-internal"), sensors={"camera": pf.Sensor(sd=1e-3, latency=0.005, gate=5.0)}
    )
    with pytest.warns(pf.PumafuseWarning, match="before_start"):
        return pf.fuse(run, config, rate=100.0), run


@pytest.fixture(scope="module")
def recorded(fused: tuple[pf.Estimates, pf.Run], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "fused.rrd"
    pf.to_rerun(*fused, path)
    return path


def columns(path: Path, entity: str, *, static: bool) -> list[dict[str, object]]:
    """The recorded columns of one entity, chunk by chunk."""
    batches = [
        chunk.to_record_batch()
        for chunk in RrdReader(str(path)).stream()
        if chunk.entity_path == entity and chunk.is_static == static
    ]
    return [dict(zip(batch.schema.names, batch.columns, strict=True)) for batch in batches]


def entities(path: Path) -> set[str]:
    """Every entity of a recording, bar the recording's own properties."""
    return {chunk.entity_path for chunk in RrdReader(str(path)).stream() if not chunk.entity_path.startswith("/__")}


def moments(column: object) -> npt.NDArray[np.float64]:
    """A column of durations in seconds."""
    return column.to_numpy(zero_copy_only=False).astype("m8[ns]") / np.timedelta64(1, "s")


def series(path: Path, entity: str) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Times [s] and values of one entity."""
    found = columns(path, entity, static=False)
    values = np.concatenate([chunk["Scalars:scalars"].flatten().to_numpy() for chunk in found])
    return np.concatenate([moments(chunk["time"]) for chunk in found]), values


def strip(path: Path, entity: str) -> npt.NDArray[np.float64]:
    """The points of an entity's one line in space, (n, 3)."""
    (found,) = [chunk for chunk in columns(path, entity, static=True) if "LineStrips3D:strips" in chunk]
    (line,) = found["LineStrips3D:strips"][0].as_py()
    return np.array(line)


def tool(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Times [s] and positions (n, 3) of the tool's point in space."""
    found = columns(path, "/path/tool", static=False)
    points = np.concatenate([np.array([row.as_py()[0] for row in chunk["Points3D:positions"]]) for chunk in found])
    return np.concatenate([moments(chunk["time"]) for chunk in found]), points


def test_estimates_and_band_are_in_mm_at_their_own_times(fused: tuple[pf.Estimates, pf.Run], recorded: Path) -> None:
    """Position and ±2σ stand at seconds since the first command."""
    est = fused[0]
    for entity, factor in (("", 0.0), ("/upper", 2.0), ("/lower", -2.0)):
        time, value = series(recorded, f"/radial/estimate{entity}")
        assert np.allclose(time, est.time, atol=1e-9, rtol=0)
        assert np.allclose(value, (est["radial"].position + factor * est["radial"].position_sd) * 1e3)


def test_commands_measurements_and_reference_are_on_the_same_clock(
    fused: tuple[pf.Estimates, pf.Run], recorded: Path
) -> None:
    """Commands from 0, measurements at stamp − latency, the reference at its stamps."""
    est, run = fused
    time, value = series(recorded, "/radial/command")
    assert np.allclose(time, 0.028 * np.arange(50))
    assert np.allclose(value, run.command.values["radial"] * 1e3)
    time, _ = series(recorded, "/radial/camera")
    assert np.allclose(time, np.delete(0.01 * np.arange(1, 140) - 0.005, 69))
    time, _ = series(recorded, "/radial/reference")
    assert np.allclose(time, 0.01 * np.arange(140))
    assert est.measurements.counts() == {"fused": 138, "rejected": 1, "before_start": 1}


def test_a_rejected_measurement_is_marked(recorded: Path) -> None:
    """The outlier stands among the rejected ones, not among the fused."""
    time, value = series(recorded, "/radial/camera/rejected")
    assert np.allclose(time, [-0.005, 0.695])
    assert value[1] > 590.0


def test_innovations_stand_in_their_band(fused: tuple[pf.Estimates, pf.Run], recorded: Path) -> None:
    """Every component that the filter used or rejected: ν at its valid time between ±2√S, in mm."""
    measurements = fused[0].measurements
    used = np.isfinite(measurements.innovation)
    assert used.sum() == 139
    for entity, wanted in (
        ("", measurements.innovation),
        ("/upper", 2.0 * measurements.innovation_sd),
        ("/lower", -2.0 * measurements.innovation_sd),
    ):
        time, value = series(recorded, f"/innovation/radial/camera{entity}")
        assert np.allclose(time, measurements.time[used], atol=1e-9, rtol=0)
        assert np.allclose(value, wanted[used] * 1e3)


def test_one_axis_has_no_path_in_space(recorded: Path) -> None:
    """A point in space needs three coordinates; nothing is made up for the others."""
    assert not any(entity.startswith("/path") for entity in entities(recorded))


def test_a_stream_of_the_caller_gets_the_same(
    fused: tuple[pf.Estimates, pf.Run], recorded: Path, tmp_path: Path
) -> None:
    """A sink may be a stream of rerun-sdk: the same entities and values as in a file of our own."""
    path = tmp_path / "mine.rrd"
    with rr.RecordingStream("mine") as stream:
        stream.save(str(path))
        pf.to_rerun(*fused, stream)
    assert entities(path) == entities(recorded)
    assert np.array_equal(series(path, "/radial/estimate"), series(recorded, "/radial/estimate"))


def circling(names: tuple[str, str, str], frame: Cylindrical | None) -> tuple[pf.Estimates, pf.Run]:
    """Commands round (0.1, −0.2) while rising, and no sensor."""
    angle = np.linspace(0.5, 1.5, 80)
    values = (0.1 + 0.4 * np.cos(angle), -0.2 + 0.4 * np.sin(angle), np.linspace(0.0, 0.1, 80))
    run = pf.Run.from_arrays(100.0 + 0.028 * np.arange(80), dict(zip(names, values, strict=True)), frame=frame)
    return pf.fuse(run, pf.FusionConfig(arm=pf.ArmModel.load("puma560-internal")), rate=50.0), run


@pytest.mark.parametrize(
    ("names", "frame"),
    [
        (("x", "y", "z"), Cylindrical(base=(0.1, -0.2), positive="clockwise")),
        (("tangential", "radial", "vertical"), None),
    ],
)
def test_the_path_in_space_is_in_the_logs_own_coordinates(
    names: tuple[str, str, str], frame: Cylindrical | None, tmp_path: Path
) -> None:
    """Command, estimate and tool in mm: x, y, z with a frame, else tangential, radial, vertical."""
    est, run = circling(names, frame)
    pf.to_rerun(est, run, tmp_path / "path.rrd")
    position = est.cartesian if frame else {name: axis.position for name, axis in est.axes.items()}
    estimated = np.column_stack([position[name] for name in names]) * 1e3
    commanded = np.column_stack([run.command.values[name] for name in names]) * 1e3
    assert np.allclose(strip(tmp_path / "path.rrd", "/path/command"), commanded, rtol=1e-6, atol=1e-4)
    assert np.allclose(strip(tmp_path / "path.rrd", "/path/estimate"), estimated, rtol=1e-6, atol=1e-4)
    time, points = tool(tmp_path / "path.rrd")
    assert np.allclose(time, est.time, atol=1e-9, rtol=0)
    assert np.allclose(points, estimated, rtol=1e-6, atol=1e-4)


def test_with_a_frame_the_plots_are_of_the_axes(tmp_path: Path) -> None:
    """The radial command is the distance from the base; no plot is named after x, y or z."""
    est, run = circling(("x", "y", "z"), Cylindrical(base=(0.1, -0.2)))
    pf.to_rerun(est, run, tmp_path / "axes.rrd")
    assert np.allclose(series(tmp_path / "axes.rrd", "/radial/command")[1], 400.0)
    assert np.allclose(series(tmp_path / "axes.rrd", "/tangential/command")[1], np.linspace(0.0, 400.0, 80))
    assert {entity.split("/")[1] for entity in entities(tmp_path / "axes.rrd")} == {
        "tangential",
        "radial",
        "vertical",
        "path",
    }


def test_measurements_are_shown_where_they_put_the_tool(tmp_path: Path) -> None:
    """A sensor 300 mm off, upside down and doubled: its estimated bias and its scale are taken off, ν is left alone."""
    stamps = np.arange(0.01, 1.6, 0.01)
    noise = 5e-4 * np.random.default_rng(2).standard_normal(len(stamps))
    run = pf.Run.from_arrays(
        0.028 * np.arange(60), {"radial": np.full(60, 0.5)}, {"range": (stamps, {"radial": -2.0 * 0.5 + 0.3 + noise})}
    )
    sensor = pf.Sensor(sd=5e-4, scale=-2.0, bias_sd=1.0, gate=0.0)
    config = pf.FusionConfig(arm=pf.ArmModel.load("puma560-internal"), sensors={"range": sensor})
    est = pf.fuse(run, config)
    pf.to_rerun(est, run, tmp_path / "range.rrd")
    _, value = series(tmp_path / "range.rrd", "/radial/range")
    bias = est.biases["range"]["radial"].value
    assert np.allclose(value, (run.sensors["range"].values["radial"] - bias) / -2.0 * 1e3)
    assert abs(np.mean(value) - 500.0) < 5.0
    assert np.allclose(series(tmp_path / "range.rrd", "/innovation/radial/range")[1], est.measurements.innovation * 1e3)


def test_the_shipped_scan_makes_a_small_file_that_rerun_accepts(tmp_path: Path) -> None:
    """A minute, three axes, three sensors at 200 estimates a second: under 10 MB, and `rerun rrd verify` agrees."""
    run = pf.Run.read(DATA / "scan1")
    path = tmp_path / "scan1.rrd"
    pf.to_rerun(pf.fuse(run, pf.FusionConfig.load(DATA / "fusion.toml"), rate=200.0), run, path)
    assert 100_000 < path.stat().st_size < 10_000_000
    rerun = Path(sys.executable).parent / "rerun"
    done = subprocess.run([str(rerun), "rrd", "verify", str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert {"/path/command", "/path/estimate", "/path/tool"} <= entities(path)
    for sensor, axes in (("tracker", 3), ("vision", 3), ("range", 1)):
        assert sum(entity.endswith(f"/{sensor}") for entity in entities(path)) == 2 * axes
