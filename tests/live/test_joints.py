"""Streams whose commands, and encoders, are in joints of a robot: as live, to the last bit."""

import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pumafuse as pf
from pumafuse.fusion.config import Placement
from pumafuse.fusion.placing import add_tool
from pumafuse.live.wire import LineDecoder
from pumafuse.logs.clock import without_strays
from pumafuse.logs.manifest import chain_of
from pumafuse.model.arm import Joint
from streams import (
    delayed,
    differences,
    estimates_are_as_live,
    events_of,
    record_is_as_live,
    replay_is_as_live,
)

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
URDF = Path(__file__).parents[2] / "examples" / "pose-virtual" / "puma560.urdf"
ROBOT = pf.Robot(urdf=str(URDF), base="base_link", tip="tool0")
JOINTS = tuple(f"j{number}" for number in range(1, 7))
LENGTH = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.04))
ANGLE = pf.AxisModel(kind="angle", plant=pf.FirstOrder(time_constant=0.03))
ARM = pf.ArmModel(
    name="any",
    update_period=0.028,
    delay=0.046,
    axes={**dict.fromkeys("xyz", LENGTH), **dict.fromkeys(("rx", "ry", "rz"), ANGLE)},
    joints={"j2": Joint(later=0.0307), "j5": Joint(later=0.071)},
)
SENSORS = {
    "encoders": pf.Sensor(sd={**dict.fromkeys("xyz", 1e-3), **dict.fromkeys(("rx", "ry", "rz"), 2e-3)}, latency=0.004),
    "tracker": pf.Sensor(
        sd=dict.fromkeys("xyz", 2e-4),
        latency=0.012,
        frame=Placement(at=(-0.9, 3.2, 0.45), rotation=(-0.035, 0.004, -1.955)),
        marker=Placement(at=(0.0, 0.062, 0.035)),
    ),
}


def joints_at(time: np.ndarray) -> np.ndarray:
    phase = np.arange(6) * 0.7
    return 0.4 * np.sin(time[:, None] * np.linspace(0.7, 1.9, 6) + phase) + [0.1, -0.6, 0.9, 0.2, 0.5, -0.3]


def run_of(folder: Path, seconds: float = 5.0, stray: int | None = None) -> pf.Run:
    """A recorded run in joints, whose tracker tells no orientation; one value of j4 is nobody's, if asked for."""
    rng = np.random.default_rng(4)
    given = np.arange(0, round(seconds * 1e9), 28_000_000)
    given += rng.integers(0, 3_000_000, len(given))
    told = joints_at(given / 1e9)
    if stray is not None:
        told[stray, 3] += 1.0
    measured = np.sort(rng.integers(-40_000_000, round(seconds * 1e9), round(seconds * 80)))
    encoded = joints_at(measured / 1e9 - 0.09) + rng.normal(0.0, 1e-3, (len(measured), 6))
    shutil.copy(URDF, folder / "arm.urdf")
    for name, stamp, values in (("commands", given, told), ("encoders", measured, encoded)):
        rows = [",".join(["time_ns", *(f"{joint}_rad" for joint in JOINTS)])]
        rows += [",".join([str(at), *map(repr, row)]) for at, row in zip(stamp.tolist(), values.tolist(), strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(rows) + "\n")
    listed = ", ".join(f'{joint} = "{joint}_rad"' for joint in JOINTS)
    (folder / "run.toml").write_text(
        '[robot]\nurdf = "arm.urdf"\nbase = "base_link"\ntip = "tool0"\n'
        f'[command]\nfile = "commands.csv"\ntime = "time_ns"\njoints = {{ {listed} }}\n'
        f'[sensors.encoders]\nfile = "encoders.csv"\ntime = "time_ns"\njoints = {{ {listed} }}\n'
    )
    run = pf.Run.read(folder)
    position, turned = chain_of(ROBOT).pose(joints_at(measured / 1e9 - 0.1))
    frame, marker = SENSORS["tracker"].frame, SENSORS["tracker"].marker
    point = position + Rotation.from_quat(turned).apply(marker.at) - frame.at
    point = Rotation.from_rotvec(frame.rotation).inv().apply(point) + rng.normal(0.0, 2e-4, position.shape)
    tracker = replace(
        run.sensors["encoders"], values=dict(zip("xyz", point.T.copy(), strict=True)), orientation=None, joints=None
    )
    return replace(run, sensors={**run.sensors, "tracker": tracker})


def known(run: pf.Run) -> pf.FusionConfig:
    return add_tool(pf.FusionConfig(arm=ARM, sensors=SENSORS), run)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> pf.Run:
    return run_of(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def config(run: pf.Run) -> pf.FusionConfig:
    return known(run)


def test_in_any_order(run: pf.Run, config: pf.FusionConfig) -> None:
    """Each event up to 1.2 s late, a tenth twice: the offline estimates, also where joints answer later.

    Late commands change the poses of others, which are the same commands: of each one is counted.
    """
    offline, live = pf.fuse(run, config), pf.LiveEstimator(config)
    assert differences(live, delayed(events_of(run), 1.2, seed=5, twice=0.1), offline, 1.45) == []
    health = live.health()
    assert health.sensors["tracker"].outcomes["fused"] > 1000
    assert health.commands["fused"] == len(run.command.stamp)


def test_estimates_at_the_time_are_as_live(tmp_path: Path) -> None:
    """With a stray command among them; also of the run replayed as a stream."""
    run = run_of(tmp_path, stray=120)
    assert estimates_are_as_live(run, known(run)).command_counts["stray"] == 1
    replay_is_as_live(run, known(run))


def test_a_stray_joint_takes_its_pose_with_it(tmp_path: Path) -> None:
    """Recorded: a value of one joint that nobody sent leaves no pose, nor joints, of its row, and no other out."""
    run = without_strays(run_of(tmp_path, stray=120))
    assert run.command.stray.tolist() == [row == 120 for row in range(len(run.command.stamp))]
    assert [note for note in run.notes if "a value of j4 that leaps" in note]
    later = run.command.delayed(ARM.later)
    for source in (run.command, later):
        gone = [~np.isfinite(source.orientation).all(axis=1), ~np.isfinite(source.joints.values).all(axis=1)]
        gone += [~np.isfinite(source.values[axis]) for axis in "xyz"]
        assert all((one == run.command.stray).all() for one in gone)
    clean = run_of(tmp_path).command.rows(~run.command.stray).delayed(ARM.later)
    np.testing.assert_array_equal(later.values["x"][~run.command.stray], clean.values["x"])


def test_a_configuration_keeps_its_robot(tmp_path: Path, config: pf.FusionConfig) -> None:
    """Saved and loaded again, from anywhere, it reads joints to the same poses; what is saved says the same again."""
    (tmp_path / "saved").mkdir()
    config.save(tmp_path / "saved")
    again = pf.FusionConfig.load(tmp_path / "saved" / "fusion.toml")
    assert again.to_toml() == config.to_toml()
    for one in (config, again):
        live = pf.LiveEstimator(one)
        live.command(0, **dict.fromkeys(JOINTS, 0.3))
        position, _ = chain_of(ROBOT).pose(np.full((1, 6), 0.3))
        assert [live.estimate()[axis].position for axis in "xyz"] == position[0].tolist()
    (tmp_path / "saved" / "robot.urdf").unlink()
    with pytest.raises(pf.ConfigError, match=r"robot\.urdf: no such file"):
        pf.FusionConfig.load(tmp_path / "saved" / "fusion.toml")


BAD = {
    "a joint lacks": ({"j1": 0.1, "j2": 0.2}, "needs all joints of the .robot.; it has no j3, j4, j5, j6"),
    "a joint is none": ({**dict.fromkeys(JOINTS, 0.1), "j6": math.nan}, "it has no j6"),
    "a pose, too": ({**dict.fromkeys(JOINTS, 0.1), "x": 0.5}, "gives joints and x"),
    "a joint far away": ({**dict.fromkeys(JOINTS, 0.1), "j6": 1e300}, "joint j6 is where no robot can be"),
    "an orientation, too": ({**dict.fromkeys(JOINTS, 0.1), "orientation": (0, 0, 0, 1)}, "gives joints and orient"),
}


@pytest.mark.parametrize("case", BAD)
def test_joints_that_are_no_pose_are_refused(case: str, config: pf.FusionConfig) -> None:
    """With a reason, of commands and of measurements; nothing of such an event is used."""
    values, reason = BAD[case]
    live = pf.LiveEstimator(config)
    live.command(0.0, **dict.fromkeys(JOINTS, 0.1))
    before = live.estimate(0.1)
    for result in (live.command(0.1, **values), live.measurement(0.1, "encoders", **values)):
        assert result.outcome is pf.Outcome.INVALID
        assert re.search(reason, result.reason)
    assert live.estimate(0.1) == before


def test_a_robot_that_does_not_fit_is_refused_in_one_line(config: pf.FusionConfig) -> None:
    """An arm without x, y, z; a tool without a reference orientation; a joint that the chain has not."""
    flat = pf.FusionConfig(arm=pf.ArmModel.load("puma560-internal"), robot=config.robot)
    strange = msgspec.structs.replace(ARM, joints={"j9": Joint(later=0.01)})
    for one, words in (
        (flat, r"\[robot\]: its joints tell x, y and z"),
        (msgspec.structs.replace(config, tool=None, sensors={}), r"\[robot\]: .*\[tool\]"),
        (msgspec.structs.replace(config, arm=strange), "joint 'j9'"),
    ):
        with pytest.raises(pf.PumafuseError, match=words) as error:
            pf.LiveEstimator(one)
        assert "\n" not in str(error.value)


def test_joints_on_the_wire() -> None:
    """Angles are in degrees, lengths in mm, of commands and of sensors; no joint is called as a part of a line."""
    decoder = LineDecoder(ARM.kind_of, framed=False, joints={"j1": "angle", "rail": "length"})
    values = {"j1": math.radians(30.0), "rail": 0.5}
    assert decoder.decode(b'{"t": 1.0, "command": {"j1": 30.0, "rail": 500.0}}').values == values
    assert decoder.decode(b'{"t": 1.0, "sensor": "encoders", "j1": 30.0, "rail": 500.0}').values == values
    with pytest.raises(pf.ConfigError, match="joint 't'"):
        LineDecoder(ARM.kind_of, framed=False, joints={"t": "angle"})


@pytest.mark.long
def test_lines_in_joints_are_recorded_as_they_are(tmp_path: Path, run: pf.Run, config: pf.FusionConfig) -> None:
    """The estimates of lines are those of the record as live, which has joints where these came."""
    found, _, _ = record_is_as_live(tmp_path / "record", run, config)
    assert len(found.command.stamp) == len(run.command.stamp)
    assert found.command.joints is not None and found.sensors["tracker"].joints is None
