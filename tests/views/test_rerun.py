"""Recordings are read back and compared with the estimates they were made from."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

import bag_files
import pumafuse as pf
from executable import pumafuse
from pumafuse.logs.frames import Cylindrical
from recordings import columns, series, times

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
        arm=pf.ArmModel.load("puma560-internal"),
        process={"radial": pf.Process(drift=1e-4, adaptation=1.0)},
        sensors={"camera": pf.Sensor(sd=1e-3, latency=0.005, gate=5.0)},
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
    plain["innovation/radial/noise"] = measurements.time[used], np.sqrt(measurements.noise_scale[used])
    assert measurements.noise_scale[used].max() > 1.1
    assert used.sum() == 139
    every = {*wanted, *plain, "outcome/camera"}
    assert entities(recorded) == {f"/{name}" for name in every}  # and no path: a position in space needs two axes
    for name, (time, value) in {**plain, **{one: (at, of * 1e3) for one, (at, of) in wanted.items()}}.items():
        found = series(recorded, f"/{name}")
        np.testing.assert_allclose(found[0], time, atol=2e-9, rtol=0, err_msg=name)
        np.testing.assert_allclose(found[1], value, err_msg=name, atol=1e-9)
    for name in ("radial/estimate", "residual/radial/estimate"):
        np.testing.assert_allclose(series(recorded, f"/{name}", "variances")[1], (sd * 1e3) ** 2)


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


def gantry(*names: str) -> pf.ArmModel:
    """An arm whose axes answer alike; the one called yaw turns."""
    plant = pf.FirstOrder(time_constant=0.05)
    axes = {name: pf.AxisModel(kind="angle" if name == "yaw" else "length", plant=plant) for name in names}
    return pf.ArmModel(name="gantry", update_period=0.028, delay=0.03, axes=axes)


PUMA = pf.ArmModel.load("puma560-internal")


@pytest.mark.parametrize(
    ("arm", "told", "frame", "path"),
    [
        (PUMA, XYZ, Cylindrical(base=(0.1, -0.2), positive="clockwise"), XYZ),
        (gantry("z", "yaw", "x", "y"), ("z", "yaw", "x", "y"), None, XYZ),
        (
            gantry("slide", "lift", "reach", "rail"),
            ("slide", "lift", "reach", "rail"),
            None,
            ("slide", "lift", "reach"),
        ),
    ],
)
def test_the_path_in_space_is_in_the_logs_own_coordinates(
    arm: pf.ArmModel, told: tuple[str, ...], frame: Cylindrical | None, path: tuple[str, ...], tmp_path: Path
) -> None:
    """Command, estimate and tool in mm, beside plots of the axes: x, y, z with a frame or of an arm that has them.

    Else the first three lengths, of whatever names; two are a position in a plane. An angle is no part of it.
    """
    angle = np.linspace(0.5, 1.5, 80)
    circle = (0.1 + 0.4 * np.cos(angle), -0.2 + 0.4 * np.sin(angle), np.linspace(0.0, 0.1, 80), 0.3 * angle)
    values = dict(zip(told, circle, strict=False))
    run = pf.Run.from_arrays(100.0 + 0.028 * np.arange(80), values, frame=frame)
    est, file = pf.fuse(run, pf.FusionConfig(arm=arm), rate=50.0), tmp_path / "p.rrd"
    pf.to_rerun(est, run, file)
    position = est.cartesian if frame else {name: axis.position for name, axis in est.axes.items()}
    for entity, of in (("estimate", position), ("command", values)):
        wanted = np.column_stack([of[name] for name in path]) * 1e3
        found = strip(file, f"/path/{entity}")
        assert np.allclose(found[:, : len(path)], wanted, rtol=1e-6, atol=1e-4)
        assert not found[:, len(path) :].any()
    tool = columns(file, "/path/tool")
    points = np.concatenate([[row.as_py()[0] for row in chunk["Points3D:positions"]] for chunk in tool])
    assert np.allclose(times(tool), est.time, atol=1e-9, rtol=0)
    assert np.allclose(points, strip(file, "/path/estimate"), rtol=1e-6, atol=1e-4)
    assert {entity.split("/")[1] for entity in entities(file)} == {*arm.axes, "path"}
    if frame:
        assert np.allclose(series(file, "/radial/command")[1], 400.0)
        assert np.allclose(series(file, "/tangential/command")[1], np.linspace(0.0, -400.0, 80))
    if "yaw" in est.axes:
        assert np.allclose(series(file, "/yaw/estimate")[1], np.rad2deg(est["yaw"].position), atol=1e-9)


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


@pytest.mark.parametrize("timeline", ["timestamp", pytest.param("sequence", marks=pytest.mark.long)])
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
