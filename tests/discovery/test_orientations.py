"""Orientations in logs that nothing describes: which columns, which order, and what becomes of them."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import bag_files
import pumafuse as pf
from discovery.test_survey import asked, write, written, xyz
from pumafuse.arrays import FloatArray
from pumafuse.discovery.questions import decisions
from pumafuse.discovery.survey import Survey, survey
from pumafuse.logs.axes import in_axes
from pumafuse.space.rotations import TURNING

LATE = 0.13  # s
START = Rotation.from_euler("ZYX", [25.0, -40.0, 160.0], degrees=True)  # a tool that looks down, not along an axis
NAMES = ("qx", "qy", "qz", "qw")


def places(t: FloatArray) -> FloatArray:
    """The tool point [m], (n, 3)."""
    t = np.maximum(t, 0.0)[:, None]
    return np.array([0.21, 0.16, 0.12]) * np.sin(t * np.array([0.9, 1.3, 1.9])) + np.array([0.5, -0.2, 0.4])


def turned(t: FloatArray) -> Rotation:
    """How the tool is turned: by up to 40° about axes that stay."""
    t = np.maximum(t, 0.0)[:, None]
    return Rotation.from_rotvec(np.array([0.4, 0.5, 0.3]) * np.sin(t * np.array([1.1, 0.8, 1.7]))) * START


def poses(*, late: float = 0.0, seed: int = 0, frame: Rotation | None = None) -> tuple[dict[str, Any], Rotation]:
    """Columns t_s, x_m, y_m, z_m and orientations of a source in a turned frame, with noise where it is late."""
    t = 0.02 * np.arange(700) + (0.003 if late else 0.0)
    rng, frame = np.random.default_rng(seed), frame or Rotation.identity()
    at = frame.inv().apply(places(t - late) + rng.normal(scale=2e-4 * bool(late), size=(len(t), 3)))
    shaken = Rotation.from_rotvec(rng.normal(scale=1e-3 * bool(late), size=(len(t), 3)))
    return {"t_s": t, **xyz(at)}, frame.inv() * shaken * turned(t - late)


def quaternion(rotation: Rotation, names: Sequence[str] = NAMES, order: str = "xyzw") -> dict[str, FloatArray]:
    """The columns of a quaternion, of either sign, in the order of names, which are of x, y, z, w or w, x, y, z."""
    value = rotation.as_quat() * np.where(np.arange(len(rotation)) // 50 % 2, 1.0, -1.0)[:, None]
    value = value[:, [3, 0, 1, 2]] if order == "wxyz" else value
    return dict(zip(names, value.T.round(7), strict=True))


def log(folder: Path, told: dict[str, Any] | None, seen: dict[str, Any] | None, frame: Rotation | None = None) -> Path:
    """A folder of commands and of a tracker with these columns of orientations."""
    folder.mkdir()
    for name, late, more, where in (("commands", 0.0, told, None), ("tracker", LATE, seen, frame)):
        columns, _ = poses(late=late, frame=where)
        write(folder / f"{name}.csv", {**columns, **(more or {})})
    return folder


def both() -> tuple[Rotation, Rotation]:
    return poses()[1], poses(late=LATE)[1]


def check_follows(found: Survey, folder: Path) -> tuple[pf.Run, pf.FusionConfig]:
    """The tool turns as it was commanded, in the arm as in run.toml."""
    run, config = written(found, folder)
    assert tuple(config.arm.axes) == ("x", "y", "z", *TURNING)
    assert all(config.arm.axes[axis].kind == "angle" for axis in TURNING) and config.tool is not None
    there, mean = both()[0], Rotation.from_rotvec(config.tool.reference)
    assert (mean * there.mean().inv()).magnitude() < 1e-6
    told = in_axes(run, None)[0].command
    wanted = (there * mean.inv()).as_rotvec()
    assert np.abs(np.stack([told.values[axis] for axis in TURNING], axis=1) - wanted).max() < 1e-6
    for axis in ("x", "y", "z", *TURNING):
        one = found.relations["tracker", axis]
        assert one.correlation > 0.99 and one.lag == pytest.approx(LATE, abs=0.004), axis
    return run, config


@pytest.mark.parametrize(
    ("names", "order"),
    [
        (("q_w", "q_x", "q_y", "q_z"), "wxyz"),
        (("flangeQuatX", "flangeQuatY", "flangeQuatZ", "flangeQuatW"), "xyzw"),
        (("rot_i", "rot_j", "rot_k", "rot_w"), "xyzw"),
    ],
)
def test_quaternions_are_known_by_their_names(names: Sequence[str], order: str, tmp_path: Path) -> None:
    """In whatever order they stand, and of whatever sign: the tool turns as scipy has it."""
    told, seen = both()
    found = survey(log(tmp_path / "log", quaternion(told, names, order), quaternion(seen, names, order)))
    check_follows(found, tmp_path / "out")


@pytest.mark.parametrize(("numbers", "order", "leads"), [("0123", "wxyz", True), ("1234", "xyzw", False)])
def test_motion_tells_the_order_that_no_name_tells(numbers: str, order: str, leads: bool, tmp_path: Path) -> None:
    """Of the commands or of a sensor, where the other one is known."""
    told, seen = both()
    open_ = tuple(f"q{number}" for number in numbers)
    columns = (
        [quaternion(told, open_, order), quaternion(seen)]
        if leads
        else [quaternion(told), quaternion(seen, open_, order)]
    )
    found = survey(log(tmp_path / "log", *columns))
    check_follows(found, tmp_path / "out")
    assert not [one for one in asked(found) if "is w the first" in one]


def test_an_order_that_nothing_tells_is_asked_for(tmp_path: Path) -> None:
    """Of both q0 to q3: w first, as the convention is, with a question."""
    told, seen = both()
    columns = [quaternion(one, ("q0", "q1", "q2", "q3"), "wxyz") for one in (told, seen)]
    found = survey(log(tmp_path / "log", *columns))
    run, _ = check_follows(found, tmp_path / "out")
    assert run.command.orientation is not None
    assert any("is w the first of q0, q1, q2, q3?" in one for one in asked(found))


@pytest.mark.parametrize(
    ("told", "seen", "angles", "question"),
    [
        ("target_TCP_pose_{}", "actual_TCP_pose_{}", Rotation.as_rotvec, ""),
        ("wanted_flange[{}]", "flange[{}]", Rotation.as_quat, "is w the last of"),
        ("ee.setpoint_{}", "ee.state_{}", lambda turned: turned.as_euler("xyz"), "angles about x, y and z that stay"),
    ],
)
def test_a_list_of_a_tool_is_x_y_z_and_an_orientation(
    told: str, seen: str, angles: Callable[[Rotation], FloatArray], question: str, tmp_path: Path
) -> None:
    """Of Universal Robots a rotation vector in rad beside m, of others as their numbers are, and asked."""
    t = 0.02 * np.arange(700)
    rows: dict[str, Any] = {"timestamp": t}
    for name, late in ((told, 0.0), (seen, LATE)):
        pose = np.hstack([places(t - late), angles(turned(t - late))])
        rows |= {name.format(number): column for number, column in enumerate(pose.T)}
    write(tmp_path / "log.csv", rows)
    found = survey(tmp_path / "log.csv")
    run, config = written(found, tmp_path / "out")
    assert tuple(config.arm.axes) == ("x", "y", "z", *TURNING)
    assert run.command.orientation is not None
    assert (Rotation.from_quat(run.command.orientation) * turned(t).inv()).magnitude().max() < 1e-6
    assert np.abs(run.command.values["y"] - places(t)[:, 1]).max() < 1e-9
    assert [relation.lag for relation in found.relations.values()] == [pytest.approx(LATE, abs=0.004)] * 6
    assert any("o name says it" in line and question in line for line in asked(found)) == bool(question)


@pytest.mark.parametrize(("told", "seen", "first"), [("cmd_tcp_{}", "tcp_{}", 1), ("goal[{}]", "eef_pos[{}]", 0)])
def test_three_numbers_of_a_tool_are_a_place(told: str, seen: str, first: int, tmp_path: Path) -> None:
    """Also where only the sensor's name says so: no joints in rad."""
    t = 0.02 * np.arange(700)
    rows: dict[str, Any] = {"t": t}
    for name, late in ((told, 0.0), (seen, LATE)):
        rows |= {name.format(first + place): column for place, column in enumerate(places(t - late).T)}
    write(tmp_path / "log.csv", rows)
    run, _ = written(survey(tmp_path / "log.csv"), tmp_path / "out")
    assert run.kinds == dict.fromkeys("xyz", "length")
    assert np.abs(run.command.values["y"] - places(t)[:, 1]).max() < 1e-9


@pytest.mark.parametrize(
    ("told", "seen", "by_rows"), [("O_T_EE_d[{}]", "O_T_EE[{}]", False), ("goal_{}", "T_{}", True)]
)
def test_a_matrix_of_a_pose_gives_its_place(told: str, seen: str, by_rows: bool, tmp_path: Path) -> None:
    """Of Franka Emika, one column after the other, and one row after the other; no T in it is a clock."""
    t = 0.02 * np.arange(700)
    rows: dict[str, Any] = {"t": t}
    for name, late in ((told, 0.0), (seen, LATE)):
        pose = np.zeros((700, 4, 4))
        pose[:, :3, :3], pose[:, :3, 3], pose[:, 3, 3] = turned(t - late).as_matrix(), places(t - late), 1.0
        elements = (pose if by_rows else pose.transpose(0, 2, 1)).reshape(700, 16)
        rows |= {name.format(number): column for number, column in enumerate(elements.T)}
    write(tmp_path / "log.csv", rows)
    found = survey(tmp_path / "log.csv")
    run, _ = written(found, tmp_path / "out")
    assert run.kinds == dict.fromkeys("xyz", "length")
    assert np.abs(run.command.values["z"] - places(t)[:, 2]).max() < 1e-9
    assert [relation.lag for relation in found.relations.values()] == [pytest.approx(LATE, abs=0.004)] * 3


@pytest.mark.parametrize(
    ("names", "letters", "prefix"), [(("A", "B", "C"), "ZYX", "X Y Z"), (("roll", "pitch", "yaw"), "xyz", "x y z")]
)
def test_euler_angles_beside_a_place_are_an_orientation(
    names: Sequence[str], letters: str, prefix: str, tmp_path: Path
) -> None:
    """Of KUKA, and roll, pitch, yaw, in degrees: the orientations that scipy makes of them; and asked."""
    folder = tmp_path / "log"
    folder.mkdir()
    for name, late in (("goal", 0.0), ("tracker", LATE)):
        columns, there = poses(late=late)
        stamp, *place = columns.values()
        angles = there.as_euler(letters, degrees=True)
        three = dict(zip(prefix.split(), [1e3 * one for one in place], strict=True))
        write(folder / f"{name}.csv", {"t_s": stamp, **three, **dict(zip(names, angles.T, strict=True))})
    found = survey(folder)
    check_follows(found, tmp_path / "out")
    assert any(f"are {', '.join(names)} " in one for one in asked(found))


@pytest.mark.parametrize("has", ["commands", "sensor"])
def test_an_orientation_that_only_one_has_is_kept_and_is_no_axis(has: str, tmp_path: Path) -> None:
    """It is in run.toml, as a marker needs it; an arm has no axes that nobody commands, or measures."""
    told, seen = both()
    columns = [quaternion(told), None] if has == "commands" else [None, quaternion(seen)]
    run, config = written(survey(log(tmp_path / "log", *columns)), tmp_path / "out")
    assert tuple(config.arm.axes) == ("x", "y", "z") and config.tool is None
    assert (run.command if has == "commands" else run.sensors["tracker"]).orientation is not None
    assert pf.fuse(run, config).measurements.counts()["fused"] == 3 * 700


@pytest.mark.parametrize("angles", [(50.0, 20.0, -70.0), (0.0, 0.0, 90.0)])
def test_a_sensor_in_a_frame_of_its_own_is_named_and_not_paired(angles: Sequence[float], tmp_path: Path) -> None:
    """Its speeds follow, its axes do not: said with the angle; nothing of it is paired."""
    told, seen = both()
    frame = Rotation.from_euler("xyz", angles, degrees=True)
    folder = log(tmp_path / "log", quaternion(told), quaternion(frame.inv() * seen), frame)
    found = survey(folder)
    assert tuple(found.own_frames) == ("tracker",) and not found.run.sensors and not found.relations
    one = found.own_frames["tracker"]
    assert one.angle == pytest.approx(frame.magnitude(), abs=np.radians(3.0))
    assert one.speeds.correlation > 0.9 and one.speeds.lag == pytest.approx(LATE, abs=0.02)
    assert "frame of its own" in dict(row[:2] for row in decisions(found))["tracker"]
    run, config = written(found, tmp_path / "out")
    assert tuple(run.sensors) == ("tracker",) and not config.sensors and set(TURNING) <= set(config.arm.axes)


def test_axes_that_are_exchanged_or_dead_are_no_frame(tmp_path: Path) -> None:
    """Two columns that are exchanged, or one of noise: what is said of these stays."""
    for change in ("exchanged", "dead"):
        folder = tmp_path / change
        folder.mkdir()
        write(folder / "commands.csv", poses()[0])
        columns, _ = poses(late=LATE)
        if change == "exchanged":
            columns["x_m"], columns["y_m"] = columns["y_m"], columns["x_m"]
        else:
            columns["z_m"] = np.random.default_rng(1).normal(scale=1e-3, size=700)
        write(folder / "tracker.csv", columns)
        assert not survey(folder).own_frames, change


def test_messages_of_transforms_are_poses(tmp_path: Path) -> None:
    """Position and orientation of a message at once: `pose` in run.toml."""
    from mcap_ros2.writer import Writer

    with (tmp_path / "bag.mcap").open("wb") as file:
        writer, name = Writer(file), "geometry_msgs/msg/TransformStamped"
        schema = writer.register_msgdef(name, bag_files.definition_of(name))
        for topic, late in (("/command", 0.0), ("/tracker", LATE)):
            columns, there = poses(late=late)
            ns = 1_790_000_000_000_000_000 + np.rint(columns["t_s"] * 1e9).astype(np.int64)
            at = np.column_stack([columns[f"{axis}_m"] for axis in "xyz"])
            for stamp, point, turn in zip(ns.tolist(), at.tolist(), there.as_quat().tolist(), strict=True):
                header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "base"}
                place, turned_by = dict(zip("xyz", point, strict=True)), dict(zip("xyzw", turn, strict=True))
                transform = {"translation": place, "rotation": turned_by}
                message = {"header": header, "transform": transform, "child_frame_id": "tool0"}
                writer.write_message(topic, schema, message, log_time=stamp, publish_time=stamp)
        writer.finish()
    check_follows(survey(tmp_path / "bag.mcap"), tmp_path / "out")
    assert (tmp_path / "out" / "run.toml").read_text().count('pose = "transform"') == 2


def test_a_marker_beside_a_tool_that_turns_is_seen_by_how_it_turns(tmp_path: Path) -> None:
    """150 mm beside the tool it moves half as far again as the tool; it turns as fast, in whatever frame."""
    told, seen = both()
    frame = Rotation.from_euler("xyz", [140.0, -30.0, 65.0], degrees=True)
    folder = log(tmp_path / "log", quaternion(told), None)
    columns, _ = poses(late=LATE)
    t = columns["t_s"]
    at = frame.inv().apply(places(t - LATE) + turned(t - LATE).apply([0.09, -0.05, 0.11]))
    marked = frame.inv() * seen * Rotation.from_rotvec([0.4, -1.1, 0.7])
    places_ = dict(zip(("x_m", "y_m", "z_m"), at.T, strict=True))
    write(folder / "tracker.csv", {"t_s": t, **places_, **quaternion(marked)})
    one = survey(folder).own_frames["tracker"]
    assert one.speeds.correlation > 0.95 and one.speeds.lag == pytest.approx(LATE, abs=0.02)


def test_poses_without_a_header_are_poses(tmp_path: Path) -> None:
    """Eight columns t x y z qx qy qz qw: four have norm 1. The second frame is seen."""
    frame = Rotation.from_rotvec([0.3, -1.2, 2.0])
    for name, late, where in (("command", 0.0, None), ("camera", LATE, frame)):
        columns, rotation = poses(late=late, frame=where)
        table = np.column_stack([*columns.values(), *quaternion(rotation).values()])
        np.savetxt(tmp_path / f"{name}.csv", table, "%.7f", ",")
    found = survey(tmp_path)
    assert list(found.own_frames) == ["camera"]
    for stream in (found.roles.command, *found.roles.sensors):
        assert stream.attitude.columns.quaternion == ("column 5", "column 6", "column 7", "column 8")
        assert stream.attitude.columns.order == "xyzw"
        assert {axis: signals[0].column for axis, signals in stream.axes.items()} == {
            "x": "column 2", "y": "column 3", "z": "column 4"
        }  # fmt: skip
    assert any("w the last of column 5" in question for question in asked(found))


def test_seven_joints_without_a_header_are_no_pose(tmp_path: Path) -> None:
    """Their norm is not 1."""
    t = 0.02 * np.arange(700)
    path = np.column_stack([np.sin(t * (0.4 + 0.1 * joint)) for joint in range(7)])
    late = np.column_stack([np.interp(t - LATE, t, one) for one in path.T])
    for name, value in (("command", path), ("encoder", late)):
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack([t, value]), "%.7f", ",")
    found = survey(tmp_path)
    assert found.roles is not None and found.roles.command.attitude is None
    assert len(found.roles.command.axes) == 7
