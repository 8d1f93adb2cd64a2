"""Sensors in frames of their own and a tool that turns."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pumafuse as pf
from pumafuse.fusion.placing import in_base

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
PERIOD, DELAY, LAG = 0.02, 0.05, 0.04  # s
AXES = ("x", "y", "z", "rx", "ry", "rz")
FRAME, FRAME_AT = Rotation.from_rotvec([0.9, -1.7, 0.4]), np.array([2.1, -1.3, 0.7])
MARKER, MARKER_AT = Rotation.from_rotvec([-0.4, 0.6, 1.1]), np.array([0.03, -0.05, 0.12])
LEVEL = Rotation.from_rotvec([-1.5, 0.2, 0.3])


def config(**sensors: dict[str, object]) -> pf.FusionConfig:
    axes = {axis: {"kind": "angle"} | PLANT if axis.startswith("r") else PLANT for axis in AXES}
    arm = {"name": "arm", "update_period_ms": PERIOD * 1e3, "delay_ms": DELAY * 1e3, "axes": axes}
    return pf.FusionConfig.parse({"arm": arm, "sensors": sensors, "process": NOISE})


PLANT = {"plant": "first-order", "time_constant_ms": LAG * 1e3}
NOISE = {axis: {"input_noise_deg_rtHz": 0.05} if axis.startswith("r") else {} for axis in AXES}
PLACE = {
    "frame": {"at_mm": (FRAME_AT * 1e3).tolist(), "rotation_vector_deg": FRAME.as_rotvec(degrees=True).tolist()},
    "marker": {"at_mm": (MARKER_AT * 1e3).tolist(), "rotation_vector_deg": MARKER.as_rotvec(degrees=True).tolist()},
}
CAMERA = {"sd_mm": 0.2, "sd_deg": 0.1, "latency_ms": 10.0, "gate": 0.0}


def motion(time: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Where the tool is told to be, (n, 3) [m], and how it is told to be turned."""
    position = 0.1 * np.sin(np.outer(time, [1.0, 1.7, 2.3]) + np.array([0.0, 1.0, 2.0]))
    turn = 0.5 * np.sin(np.outer(time, [1.3, 0.8, 1.9]) + np.array([1.0, 0.3, 0.0]))
    return position, Rotation.from_rotvec(turn) * LEVEL


def of_axes(position: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip("xyz", position.T, strict=True))


def pose_run(turn: Rotation | None = None, seed: int = 1) -> tuple[pf.Run, np.ndarray, Rotation]:
    """A run whose camera sees a marker in a frame of its own, with noise, and what it sees of the tool [m].

    ``turn`` turns the robot's base, and with it all commands, about its origin.
    """
    turn, rng = turn or Rotation.identity(), np.random.default_rng(seed)
    time = np.arange(0.0, 8.0, PERIOD)
    told, turned = motion(time)
    stamp = np.arange(0.3, 8.0, 0.013)
    point, oriented = motion(stamp - DELAY - LAG - 0.01)
    point = point + rng.normal(0.0, 2e-4, point.shape)
    oriented = Rotation.from_rotvec(rng.normal(0.0, np.radians(0.1), point.shape)) * oriented
    seen = FRAME.inv().apply(point + oriented.apply(MARKER_AT) - FRAME_AT)
    facing = (FRAME.inv() * oriented * MARKER).as_quat()
    run = pf.Run.from_arrays(
        time,
        {**of_axes(turn.apply(told)), "orientation": (turn * turned).as_quat()},
        {"camera": (stamp, {**of_axes(seen), "orientation": facing})},
    )
    return run, point, oriented


def test_a_camera_in_its_own_frame_gives_what_one_along_the_base_gives() -> None:
    """The tool point is base_from_sensor z − R marker, by scipy and by hand, and so are the estimates."""
    run, point, oriented = pose_run()
    stamp = run.sensors["camera"].stamp
    along = replace(
        run,
        sensors={"camera": replace(run.sensors["camera"], values=of_axes(point), orientation=oriented.as_quat())},
    )
    own = pf.fuse(run, config(camera=CAMERA | PLACE))
    there, _, used = in_base(run, config(camera=CAMERA | PLACE))
    values = there.sensors["camera"].values
    np.testing.assert_allclose(np.column_stack([values[axis] for axis in "xyz"]), point, atol=1e-12)
    theta = (oriented * Rotation.from_rotvec(used.tool.reference).inv()).as_rotvec()
    np.testing.assert_allclose(np.column_stack([values[axis] for axis in AXES[3:]]), theta, atol=1e-12)
    assert len(stamp) == len(theta)
    given = pf.fuse(along, config(camera=CAMERA))
    for axis in AXES[3:]:  # positions have the noise of the orientation times the lever beside their own
        np.testing.assert_allclose(own[axis].position, given[axis].position, atol=1e-12)


def test_zeros_of_a_sensor_that_lost_its_target_are_not_followed() -> None:
    """Without a gate the estimates are those of a run in which these rows tell nothing."""
    run = pose_run()[0]
    camera = run.sensors["camera"]
    assert camera.orientation is not None
    lost = np.arange(len(camera.stamp)) % 10 == 0

    def estimates(position: float, oriented: list[float]) -> pf.Estimates:
        values = {axis: np.where(lost, position, value) for axis, value in camera.values.items()}
        facing = np.where(lost[:, None], oriented, camera.orientation)
        return pf.fuse(
            replace(run, sensors={"camera": replace(camera, values=values, orientation=facing)}),
            config(camera=CAMERA | PLACE),
        )

    with pytest.warns(pf.PumafuseWarning, match=r"rows have no finite \w+ value: invalid"):
        zeros, nothing = estimates(0.0, [0.0, 0.0, 0.0, 1.0]), estimates(np.nan, [np.nan] * 4)
    for axis in AXES:
        np.testing.assert_array_equal(zeros[axis].position, nothing[axis].position)


def test_an_orientation_without_noise_is_not_used_for_the_marker_either() -> None:
    """An attitude that is 12° off its positions, and has no sd_deg: the commands say how the tool is turned."""
    run = pose_run()[0]
    camera = run.sensors["camera"]
    turned = Rotation.from_rotvec([0.0, 12.0, 0.0], degrees=True) * Rotation.from_quat(camera.orientation)
    without = {key: value for key, value in CAMERA.items() if key != "sd_deg"} | PLACE
    wrong, none = (
        pf.fuse(replace(run, sensors={"camera": replace(camera, orientation=told)}), config(camera=without))
        for told in (turned.as_quat(), None)
    )
    for axis in AXES:
        np.testing.assert_array_equal(wrong[axis].position, none[axis].position)
        np.testing.assert_array_equal(wrong[axis].position_sd, none[axis].position_sd)


@pytest.mark.parametrize("degrees", [-35.0, 25.0])
def test_a_sensor_by_which_the_tool_is_turned_as_no_arm_is_is_refused(degrees: float) -> None:
    """Beyond 30 degrees from where it is commanded to be for most of the run: with that angle, and what to give."""
    run, _, oriented = pose_run()
    wrong = Rotation.from_rotvec([0.0, degrees, 0.0], degrees=True)
    marker = PLACE["marker"] | {"rotation_vector_deg": (MARKER * wrong).as_rotvec(degrees=True).tolist()}
    given = config(camera=CAMERA | PLACE | {"marker": marker})
    told = oriented * MARKER * (MARKER * wrong).inv()
    last = np.searchsorted(run.command.stamp, run.sensors["camera"].stamp, side="right") - 1
    apart = Rotation.from_quat(run.command.orientation[last]).inv() * told
    median = float(np.degrees(np.median(apart.magnitude())))
    assert (median > 30.0) is (abs(degrees) > 30.0)
    if median > 30.0:
        with pytest.raises(pf.RunError, match=rf"turned {median:.0f}° .*give rotation_vector_deg of sensors.cam"):
            in_base(run, given)
    else:
        in_base(run, given)


def test_a_run_that_is_turned_as_a_whole_gives_the_turned_estimate() -> None:
    """Commands, frame and reference orientation turned by Q: p becomes Q p and θ Q θ, to 1e-9."""
    turn = Rotation.from_rotvec([0.3, -0.8, 1.9])
    frame = turn * FRAME
    place = PLACE | {
        "frame": {
            "at_mm": (turn.apply(FRAME_AT) * 1e3).tolist(),
            "rotation_vector_deg": frame.as_rotvec(degrees=True).tolist(),
        }
    }
    one = pf.fuse(pose_run()[0], config(camera=CAMERA | PLACE), mode="smoothed")
    other = pf.fuse(pose_run(turn)[0], config(camera=CAMERA | place), mode="smoothed")
    for axes in (AXES[:3], AXES[3:]):
        before, after = (np.column_stack([est[axis].position for axis in axes]) for est in (one, other))
        np.testing.assert_allclose(after, turn.apply(before), atol=1e-9)


def test_a_marker_of_a_sensor_that_tells_no_orientation_is_turned_with_the_response() -> None:
    """R of a tracker's rows is where the commands have turned the tool by then: a first-order lag behind them."""
    time = np.arange(0.0, 4.0, PERIOD)
    about = np.where(time < 1.0, 0.0, 0.8)  # a step about the base's z
    turned = Rotation.from_rotvec(np.outer(about, [0.0, 0.0, 1.0])) * LEVEL
    still = np.zeros((len(time), 3))
    stamp = np.arange(0.5, 4.0, 0.017)
    latency = 0.01
    since = np.maximum(stamp - latency - 1.0 - DELAY, 0.0)
    angle = 0.8 * (1.0 - np.exp(-since / LAG))
    orientation = Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0])) * LEVEL
    seen = FRAME.inv().apply(orientation.apply(MARKER_AT) - FRAME_AT)
    run = pf.Run.from_arrays(
        time, {**of_axes(still), "orientation": turned.as_quat()}, {"tracker": (stamp, of_axes(seen))}
    )
    given = config(tracker={"sd_mm": 0.1, "sd_deg": 1.0, "latency_ms": latency * 1e3} | PLACE)
    given = msgspec.structs.replace(given, tool=pf.Tool(reference=tuple(LEVEL.as_rotvec().tolist())))
    values = in_base(run, given)[0].sensors["tracker"].values
    np.testing.assert_allclose([values[axis] for axis in "xyz"], np.zeros((3, len(stamp))), atol=1e-12)


def test_noise_along_the_axes_of_a_sensor_becomes_noise_along_those_of_the_base() -> None:
    """The sds of a camera that sees depth less well are the square roots of the diagonal of R diag(sd²) Rᵀ."""
    sds = np.array([0.1, 0.1, 0.4])
    sensor = config(camera=CAMERA | PLACE | {"sd_mm": sds.tolist()}).sensors["camera"]
    expected = np.sqrt(np.diag(FRAME.as_matrix() @ np.diag((sds * 1e-3) ** 2) @ FRAME.as_matrix().T))
    np.testing.assert_allclose([sensor.sd_of(axis) for axis in "xyz"], expected, rtol=1e-12)
    along = config(camera=CAMERA | {"sd_mm": sds.tolist()}).sensors["camera"]
    assert [along.sd_of(axis) for axis in "xyz"] == (sds * 1e-3).tolist()


def test_noise_along_one_axis_of_the_base_is_none_along_the_others() -> None:
    """What a sensor in a frame of its own has of noise by name of an axis is along that axis of the arm, and no other.

    So `tune` finds it axis by axis: a camera that sees depth less well has along each what its three axes make of it.
    """
    sds = {"x": 0.1, "y": 0.2, "z": 0.4}
    sensor = config(camera=CAMERA | PLACE | {"sd_mm": sds}).sensors["camera"]
    assert [sensor.sd_of(axis) for axis in "xyz"] == pytest.approx([1e-4, 2e-4, 4e-4])
    run, _, _ = pose_run()
    camera = run.sensors["camera"]
    blur = np.random.default_rng(5).normal(0.0, [1e-4, 1e-4, 8e-4], (len(camera.stamp), 3))
    values = {axis: value + noise for (axis, value), noise in zip(camera.values.items(), blur.T, strict=True)}
    blurred = replace(run, sensors={"camera": replace(camera, values=values)})
    given = config(camera=CAMERA | PLACE | {"sd_deg": 1e-3})  # else the tool point counts what its orientation errs
    given = msgspec.structs.replace(given, tool=pf.Tool(reference=tuple(LEVEL.as_rotvec().tolist())))
    found = pf.tune(blurred, given, fit=("noise",), fix=("process",)).config.sensors["camera"]
    wanted = np.sqrt(4e-8 + FRAME.as_matrix() ** 2 @ np.square([1e-4, 1e-4, 8e-4]))
    assert [found.sd_of(axis) for axis in "xyz"] == pytest.approx(wanted, rel=0.15)  # of some 590 rows: 3 %


def test_the_noise_of_a_marker_far_from_the_tool_point_counts_how_it_is_turned() -> None:
    """Tool points that a camera tells scatter as its positions and as its orientations times the lever, in sum."""
    rng = np.random.default_rng(3)
    count, time = 40_000, np.arange(0.0, 4.0, PERIOD)
    still = np.zeros((len(time), 3))
    lever, sd, turning = np.array([0.0, 0.3, 0.4]), 2e-4, np.radians(0.1)
    oriented = Rotation.from_rotvec(rng.normal(0.0, turning, (count, 3))) * LEVEL
    seen = LEVEL.apply(lever) + rng.normal(0.0, sd, (count, 3))
    run = pf.Run.from_arrays(
        time,
        {**of_axes(still), "orientation": np.tile(LEVEL.as_quat(), (len(time), 1))},
        {"camera": (np.linspace(0.5, 4.0, count), {**of_axes(seen), "orientation": oriented.as_quat()})},
    )
    marker = {"marker": {"at_mm": (lever * 1e3).tolist()}}
    given = config(camera=CAMERA | marker)
    camera = in_base(run, given)[0].sensors["camera"]
    told = [float(given.sensors["camera"].sd_of(axis) or 0.0) * np.mean(camera.spread[axis]) for axis in "xyz"]
    found = [np.std(camera.values[axis]) for axis in "xyz"]
    assert np.sum(np.square(found)) == pytest.approx(np.sum(np.square(told)), rel=0.02)  # of 40,000: 0.7 %


@pytest.mark.parametrize(("far", "refused"), [(175.0, True), (130.0, False)])
def test_a_tool_that_turns_too_far_is_refused_and_one_that_turns_far_is_named(far: float, refused: bool) -> None:
    """Beyond 170° from the reference a rotation vector changes its sign; beyond 120° its axes are far from linear."""
    time = np.arange(0.0, 4.0, PERIOD)
    turned = Rotation.from_rotvec(np.outer(np.radians(far) * np.sin(time) ** 2, [0.0, 1.0, 0.0]))
    run = pf.Run.from_arrays(time, {**of_axes(np.zeros((200, 3))), "orientation": turned.as_quat()})
    given = msgspec.structs.replace(config(), tool=pf.Tool(reference=(0.0, 0.0, 0.0)))
    if refused:
        with pytest.raises(pf.RunError, match="175° from its reference"):
            in_base(run, given)
    else:
        assert any("130° from its reference" in note for note in in_base(run, given)[0].notes)


def test_a_marker_that_nothing_turns_is_refused() -> None:
    """Without any orientation nobody knows where the marker is from the tool point."""
    time = np.arange(0.0, 2.0, PERIOD)
    run = pf.Run.from_arrays(time, of_axes(np.zeros((100, 3))), {"camera": (time, of_axes(np.ones((100, 3))))})
    with pytest.raises(pf.ConfigError, match=r"sensors\.camera\.marker: nothing tells how the tool is turned"):
        in_base(run, config(camera=CAMERA | PLACE))
