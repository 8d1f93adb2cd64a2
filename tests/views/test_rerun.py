"""Recordings are read back and compared with the estimates they were made from."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

import bag_files
import pumafuse as pf
from executable import pumafuse
from pumafuse.logs.frames import Cylindrical
from pumafuse.views.rerun import to_rerun
from recordings import columns, series, times

DATA = Path(pf.__file__).parent / "data"
XYZ, AXES = ("x", "y", "z"), ("tangential", "radial", "vertical")


@pytest.fixture(scope="module")
def fused() -> tuple[pf.Estimates, pf.Run]:
    time = 100.0 + 0.028 * np.arange(50)
    stamps = 100.0 + 0.01 * np.arange(140)
    sight = 0.5 + 1e-4 * np.random.default_rng(1).standard_normal(140)
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


def entities(path: Path) -> set[str]:
    """Every entity of a recording, bar the recording's own properties."""
    return {chunk.entity_path for chunk in RrdReader(str(path)).stream() if not chunk.entity_path.startswith("/__")}


def strip(path: Path, entity: str) -> np.ndarray:
    """The points of an entity's one line in space, (n, 3)."""
    (found,) = [chunk for chunk in columns(path, entity, static=True) if "LineStrips3D:strips" in chunk]
    (line,) = found["LineStrips3D:strips"][0].as_py()
    return np.array(line)


def test_everything_is_in_mm_on_one_clock(fused: tuple[pf.Estimates, pf.Run], recorded: Path) -> None:
    """Seconds since the first command: commands, reference, measurements at stamp − latency, what the filter says.

    But innovations: these are in units of their standard deviation.
    """
    (est, run), measurements = fused, fused[0].measurements
    position, sd = est["radial"].position, est["radial"].position_sd
    used = np.isfinite(measurements.innovation)
    late = 0.01 * np.arange(140) - 0.005
    bad = np.isin(np.arange(140), (0, 70))  # before the first command, and the outlier
    sight = run.sensors["camera"].values["radial"]
    there, good = np.interp(late, est.time, position), ~bad & (late <= est.time[-1])
    innovation = measurements.innovation[used]
    wanted = {
        "radial/command": (0.028 * np.arange(50), run.command.values["radial"]),
        "radial/reference": (0.01 * np.arange(140), np.full(140, 0.5)),
        "radial/camera": (late[~bad], sight[~bad]),
        "radial/camera/rejected": (late[bad], sight[bad]),
        "radial/estimate": (est.time, position),
        "residual/radial/camera": (late[good], (sight - there)[good]),
        "residual/radial/camera/rejected": (late[[70]], (sight - there)[[70]]),
        "residual/radial/estimate": (est.time, np.zeros(len(est.time))),
    }
    plain = {
        "innovation/radial/camera": (measurements.time[used], np.sign(innovation) * np.sqrt(measurements.nis)[used]),
        "innovation/radial/upper": (est.time[[0, -1]], np.full(2, 2.0)),
        "innovation/radial/lower": (est.time[[0, -1]], np.full(2, -2.0)),
    }
    assert used.sum() == 139
    every = {*wanted, *plain, "outcome/camera"}
    assert entities(recorded) == {f"/{name}" for name in every}  # and no path: a position in space needs two axes
    for name, (time, value) in {**plain, **{one: (at, of * 1e3) for one, (at, of) in wanted.items()}}.items():
        found = series(recorded, f"/{name}")
        np.testing.assert_allclose(found[0], time, atol=2e-9, rtol=0, err_msg=name)
        np.testing.assert_allclose(found[1], value, err_msg=name, atol=1e-9)
    for name in ("radial/estimate", "residual/radial/estimate"):
        np.testing.assert_allclose(series(recorded, f"/{name}", "variances")[1], (sd * 1e3) ** 2)


def test_the_layout_is_followed_in_a_browser_too(recorded: Path) -> None:
    """A native viewer takes a layout that is but the default; a browser then makes its own, a panel for each line."""
    viewer = Path(sys.executable).parent / "rerun"
    done = subprocess.run([viewer, "rrd", "print", "-vvv", recorded], capture_output=True, text=True, check=True)
    assert "make_active: true, make_default: true" in done.stdout


def test_outcomes_are_states_and_silence_is_one(tmp_path: Path) -> None:
    """A camera at 50 Hz, its 30th frame wild, quiet for 2 s: fused, rejected, fused, silent, fused, silent."""
    stamp = np.concatenate([0.5 + 0.02 * np.arange(50), 3.5 + 0.02 * np.arange(50)])
    seen = np.where(np.arange(100) == 30, 0.6, 0.5)
    run = pf.Run.from_arrays(
        0.028 * np.arange(200), {"radial": np.full(200, 0.5)}, {"camera": (stamp, {"radial": seen})}
    )
    sensors = {"camera": pf.Sensor(sd=1e-3, gate=5.0)}
    est = pf.fuse(run, pf.FusionConfig(arm=pf.ArmModel.load("puma560-internal"), sensors=sensors))
    pf.to_rerun(est, run, tmp_path / "fused.rrd")
    chunks = columns(tmp_path / "fused.rrd", "/outcome/camera")
    states = [state for chunk in chunks for (state,) in chunk["StateChange:state"].to_pylist()]
    assert states == ["fused", "rejected", "fused", "silent", "fused", "silent"]
    np.testing.assert_allclose(times(chunks)[[0, 1, 2, 4]], stamp[[0, 30, 31, 50]], atol=1e-9)
    assert stamp[49] < times(chunks)[3] < stamp[50]


@pytest.mark.parametrize("count", [2, 4])
def test_lengths_of_any_names_are_a_path(count: int, tmp_path: Path) -> None:
    """Two are a position in a plane; of more than three the first three are one in space."""
    names = ["slide", "lift", "reach", "rail"][:count]
    axis = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.05))
    arm = pf.ArmModel(name="gantry", update_period=0.02, delay=0.03, axes=dict.fromkeys(names, axis))
    time = np.arange(100) * 0.02
    run = pf.Run.from_arrays(time, {name: 0.1 * number * np.sin(time) for number, name in enumerate(names, 1)})
    est = pf.fuse(run, pf.FusionConfig(arm=arm))
    pf.to_rerun(est, run, tmp_path / "fused.rrd")
    wanted = np.zeros((len(est.time), 3))
    for number, name in enumerate(names[:3]):
        wanted[:, number] = 1e3 * est[name].position
    np.testing.assert_allclose(strip(tmp_path / "fused.rrd", "/path/estimate"), wanted, atol=1e-4)


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


@pytest.mark.parametrize(("names", "frame"), [(XYZ, Cylindrical(base=(0.1, -0.2), positive="clockwise")), (AXES, None)])
def test_the_path_in_space_is_in_the_logs_own_coordinates(
    names: tuple[str, str, str], frame: Cylindrical | None, tmp_path: Path
) -> None:
    """Command, estimate and tool in mm: x, y, z with a frame, beside plots of the axes; else these."""
    angle = np.linspace(0.5, 1.5, 80)
    values = (0.1 + 0.4 * np.cos(angle), -0.2 + 0.4 * np.sin(angle), np.linspace(0.0, 0.1, 80))
    run = pf.Run.from_arrays(100.0 + 0.028 * np.arange(80), dict(zip(names, values, strict=True)), frame=frame)
    est, path = pf.fuse(run, pf.FusionConfig(arm=pf.ArmModel.load("puma560-internal")), rate=50.0), tmp_path / "p.rrd"
    pf.to_rerun(est, run, path)
    position = est.cartesian if frame else {name: axis.position for name, axis in est.axes.items()}
    estimated = np.column_stack([position[name] for name in names]) * 1e3
    assert np.allclose(strip(path, "/path/command"), np.column_stack(values) * 1e3, rtol=1e-6, atol=1e-4)
    assert np.allclose(strip(path, "/path/estimate"), estimated, rtol=1e-6, atol=1e-4)
    tool = columns(path, "/path/tool")
    points = np.concatenate([[row.as_py()[0] for row in chunk["Points3D:positions"]] for chunk in tool])
    assert np.allclose(times(tool), est.time, atol=1e-9, rtol=0)
    assert np.allclose(points, estimated, rtol=1e-6, atol=1e-4)
    assert {entity.split("/")[1] for entity in entities(path)} == {*AXES, "path"}
    if frame:
        assert np.allclose(series(path, "/radial/command")[1], 400.0)
        assert np.allclose(series(path, "/tangential/command")[1], np.linspace(0.0, -400.0, 80))


def test_x_y_z_of_an_arm_are_a_path_in_space(tmp_path: Path) -> None:
    """Without a frame, in the arm's own order of axes; an axis that is an angle is no part of it."""
    axis, turning = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.05)), pf.FirstOrder(time_constant=0.04)
    axes = {"z": axis, "yaw": pf.AxisModel(kind="angle", plant=turning), "x": axis, "y": axis}
    arm = pf.ArmModel(name="gantry", update_period=0.02, delay=0.03, axes=axes)
    time = np.arange(100) * 0.02
    command = {name: 0.1 * number * np.sin(time) for number, name in enumerate(axes, 1)}
    run = pf.Run.from_arrays(time, command)
    est = pf.fuse(run, pf.FusionConfig(arm=arm))
    assert tuple(est.axes) == tuple(axes)
    pf.to_rerun(est, run, tmp_path / "fused.rrd")
    (chunk,) = columns(tmp_path / "fused.rrd", "/path/tool")
    shown = np.array([row.as_py()[0] for row in chunk["Points3D:positions"]])
    wanted = np.column_stack([1e3 * est[name].position for name in "xyz"])
    np.testing.assert_allclose(shown, wanted, atol=1e-4)
    _, degrees = series(tmp_path / "fused.rrd", "/yaw/estimate")
    np.testing.assert_allclose(degrees, np.rad2deg(est["yaw"].position), atol=1e-9)


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
    _, shown = series(tmp_path / "range.rrd", "/innovation/radial/range")
    assert np.allclose(shown, est.measurements.innovation / est.measurements.innovation_sd)


def test_the_shipped_scan_makes_a_small_file_that_rerun_accepts(tmp_path: Path) -> None:
    """A minute, three axes, three sensors at 200 estimates a second: under 10 MB, and `rerun rrd verify` agrees."""
    run = pf.Run.read(DATA / "scan1")
    path = tmp_path / "scan1.rrd"
    pf.to_rerun(pf.fuse(run, pf.FusionConfig.load(DATA / "fusion.toml"), rate=200.0), run, path)
    assert 100_000 < path.stat().st_size < 10_000_000
    rerun = Path(sys.executable).parent / "rerun"
    done = subprocess.run([str(rerun), "rrd", "verify", str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for sensor, axes in (("tracker", 3), ("vision", 3), ("range", 1)):
        assert sum(entity.endswith(f"/{sensor}") for entity in entities(path)) == 3 * axes + 1


@pytest.mark.parametrize(
    "timeline",
    ["timestamp", pytest.param("duration", marks=pytest.mark.long), pytest.param("sequence", marks=pytest.mark.long)],
)
def test_the_result_of_a_recording_is_a_layer_of_it(timeline: str, tmp_path: Path) -> None:
    """It has the recording's ids and its timeline: merged they are one recording, with the same stamps in both."""
    path = bag_files.written(tmp_path, bag_files.KINDS["rrd"], bag_files.motion())
    bag_files.rrd(path, bag_files.motion(), timeline=timeline)
    if timeline == "sequence":
        manifest = (tmp_path / "run.toml").read_text().replace('"robot_time"', '{ column = "robot_time", unit = "ns" }')
        (tmp_path / "run.toml").write_text(manifest)
    pumafuse("fuse", tmp_path, "-c", bag_files.configured(tmp_path), "-o", tmp_path / "fused", "--rrd")
    layer = tmp_path / "fused" / "fused.rrd"
    merged = tmp_path / "merged.rrd"
    viewer = Path(sys.executable).parent / "rerun"
    subprocess.run([viewer, "rrd", "merge", path, layer, "-o", merged], check=True, capture_output=True)
    (one,) = RrdReader(merged).recordings()
    assert (one.application_id, one.recording_id) == ("robot_cell", "take-7")
    assert not RrdReader(layer).blueprints()
    found = [columns(merged, entity) for entity in ("/command", "/pumafuse/z/command")]
    stamps = [np.concatenate([chunk["robot_time"].cast("int64").to_numpy() for chunk in chunks]) for chunks in found]
    assert np.array_equal(*stamps)
    assert columns(merged, "/pumafuse/path/tool")


@pytest.mark.long
def test_the_result_of_a_recording_that_nothing_describes_is_a_layer_of_it(tmp_path: Path) -> None:
    """By `fuse` without a configuration, too."""
    path = bag_files.written(tmp_path, bag_files.KINDS["rrd"], bag_files.motion())
    pumafuse("fuse", path, "-o", tmp_path / "fused", "--rrd")
    (one,) = RrdReader(tmp_path / "fused" / "fused.rrd").recordings()
    assert (one.application_id, one.recording_id) == ("robot_cell", "take-7")


def test_a_sensor_called_like_a_line_has_an_entity_of_its_own(tmp_path: Path) -> None:
    """Its points would be drawn into the estimate's line."""
    stamps = np.arange(50) * 28_000_000
    there = {"radial": 0.56 + 1e-3 * np.sin(np.arange(50) / 5.0)}
    run = pf.Run.from_arrays(stamps, there, {"estimate": (stamps[::5] + 14_000_000, {"radial": there["radial"][::5]})})
    arm = pf.ArmModel.load("puma560-internal")
    est = pf.fuse(run, pf.FusionConfig(arm=arm, sensors={"estimate": pf.Sensor(sd=1e-3)}))
    to_rerun(est, run, tmp_path / "fused.rrd")
    assert len(series(tmp_path / "fused.rrd", "/radial/estimate")[0]) == 50
    assert len(series(tmp_path / "fused.rrd", "/radial/estimate_sensor")[0]) == 10
