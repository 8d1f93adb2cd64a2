"""Commands in joints that do not answer alike: by the tool alone it is found how much later each is."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pumafuse as pf
from pumafuse.logs.run import Run
from pumafuse.logs.source import Source
from pumafuse.registration.latencies import later
from pumafuse.registration.motion import Motion
from pumafuse.space.kinematics import Chain, Joints

URDF = Path(__file__).parents[2] / "examples" / "pose-virtual" / "puma560.urdf"
CHAIN = Chain.load(URDF, "base_link", "tool0")
PERIOD, DELAY, TIME_CONSTANT = 0.02, 0.04, 0.03  # s
LATER = np.array([0.0, 0.02, 0.03, 0.05, 0.06, 0.04])  # s
CORNER, CORNER_TURNED = np.array([2.1, -1.3, 0.7]), Rotation.from_rotvec([-148.0, 52.0, -7.0], degrees=True)
ON_AXIS = np.array([0.0, 0.0, 0.12])  # of the last joint, which does not move it
MARKER, MARKER_TURNED = np.array([0.03, -0.05, 0.12]), Rotation.from_rotvec([65.0, -41.0, -6.0], degrees=True)
SD, SD_DEG = 1.5e-4, 0.05
FINE = 1e-3  # s, of the simulation


def recorded(seed: int, later: np.ndarray, *, attitude: bool, marker: np.ndarray = MARKER) -> Run:
    """Smooth motion of six joints for 40 s, each a lag behind a dead time of its own, simulated in steps of 1 ms."""
    random = np.random.default_rng(seed)
    time = PERIOD * np.arange(2000)
    frequency, phase = random.uniform(0.1, 0.6, (2, 6, 4)) * np.array([1.0, 10.0])[:, None, None]
    swing = 0.09 * np.sin(2.0 * np.pi * frequency * time[:, None, None] + phase).sum(axis=2)
    told = np.radians([107.0, 45.0, 161.0, 19.0, 64.0, -98.0]) + swing * (1.0 - np.exp(-time))[:, None]
    fine = FINE * np.arange(round(time[-1] / FINE))
    left = np.exp(-FINE / TIME_CONSTANT)
    joints = np.empty((len(fine), 6))
    joints[0] = told[0]
    held = np.clip(np.floor((fine[:, None] - DELAY - later + 1e-9) / PERIOD).astype(int), 0, None)
    for step in range(1, len(fine)):
        joints[step] = left * joints[step - 1] + (1.0 - left) * told[held[step - 1], np.arange(6)]
    seen = slice(500, None, 10)
    point, quaternion = CHAIN.pose(joints[seen])
    turn = Rotation.from_quat(quaternion)
    noise = Rotation.from_rotvec(np.radians(SD_DEG) * random.standard_normal((len(point), 3)))
    measured = CORNER_TURNED.inv().apply(point + turn.apply(marker) - CORNER) + SD * random.standard_normal(point.shape)
    turned = (CORNER_TURNED.inv() * noise * turn * MARKER_TURNED).as_quat() if attitude else None

    def source(stamp: np.ndarray, position: np.ndarray, label: str, orientation: np.ndarray | None) -> Source:
        values = dict(zip("xyz", position.T.copy(), strict=True))
        return Source(np.round(1e9 * (10.0 + stamp)).astype(np.int64), values, label, orientation=orientation)

    command = source(time, np.zeros((len(time), 3)), "command", None).posed(Joints(CHAIN, told))
    camera = source(fine[seen], measured, "camera", turned)
    return Run("arm", command, {"camera": camera}, source(fine[seen], point, "truth", quaternion))


@pytest.mark.long
def test_the_tool_tells_how_late_each_joint_is() -> None:
    """Of an arm of which joints lag up to 60 ms apart: to 1 ms beside the earliest, and within the intervals.

    A joint that does not move what is seen, and is not told, is as late as the others are on average.
    """
    attitude = False
    marker = MARKER if attitude else ON_AXIS
    joints = pf.register(recorded(3, LATER, attitude=attitude, marker=marker)).details.joints
    known = 6 if attitude else 5
    assert [one.later_ci95 is not None for one in joints.values()] == [place < known for place in range(6)]
    later = np.array([joints[name].later for name in CHAIN.joints])
    np.testing.assert_allclose(later[:known], LATER[:known], atol=1e-3)
    assert later.min() == 0.0
    np.testing.assert_allclose(later[known:], later[:known].mean(), atol=1e-6)
    apart = later - LATER - np.mean((later - LATER)[:known])
    for name, by in zip(CHAIN.joints[:known], apart[:known], strict=True):
        low, high = joints[name].later_ci95 or (0.0, 0.0)
        assert abs(by) < 0.75 * (high - low)  # one and a half intervals: all at once


@pytest.mark.long
def test_joints_that_answer_alike_are_not_told_apart() -> None:
    """Then the arm has no [joints], and the registration is that of the poses."""
    run = recorded(4, np.zeros(6), attitude=True)
    alike = pf.register(run)
    posed = pf.register(replace(run, command=replace(run.command, joints=None)))
    assert not alike.details.joints and not alike.config.arm.joints
    assert alike.to_json() == posed.to_json()


@pytest.mark.long
def test_the_estimate_follows_joints_that_lag_apart(tmp_path: Path) -> None:
    """On another motion, without a sensor: half of what one lag for all joints leaves, by the file that was written."""
    run, other = recorded(3, LATER, attitude=True), recorded(5, LATER, attitude=True)
    pf.register(run).config.save(tmp_path)
    apart = pf.FusionConfig.load(tmp_path / "fusion.toml")
    alike = msgspec.structs.replace(apart, arm=msgspec.structs.replace(apart.arm, joints={}))
    assert _error(other, apart) < 0.5 * _error(other, alike)


def _error(run: Run, config: pf.FusionConfig) -> float:
    """How far the commands alone put the tool off its path [m], root mean square, at the best lag of all axes."""
    est = pf.fuse(run, config, sensors=[])
    truth, settled = est.reference, est.time > 2.0

    def off(later: float) -> float:
        told = [np.interp(est.time + later, truth.time, truth.position[axis]) for axis in "xyz"]
        return float(np.sqrt(np.mean(np.square(est.pose.position.T - told)[:, settled])))

    return min(off(later) for later in np.arange(-0.06, 0.07, 0.002))


def path(time: np.ndarray) -> np.ndarray:
    return 0.1 * np.column_stack([np.sin(1.1 * time), np.sin(1.7 * time + 1.0), np.cos(2.3 * time)])


def turned(time: np.ndarray) -> Rotation:
    """The tool turns as it moves, 30 ms later."""
    return Rotation.from_rotvec(3.0 * path(time - 0.03)[:, [1, 2, 0]])


def pair(late: float, seed: int, seconds: float = 30.0) -> tuple[Motion, Motion]:
    """Two sensors of one tool, the second one so much later [s], with outliers.

    Its frame is a little wrong, and what it sees is 1 mm from where the first one takes it to be.
    """
    rng = np.random.default_rng(seed)
    first, second = (np.sort(rng.uniform(0.0, seconds, int(rate * seconds))) for rate in (100.0, 40.0))
    one = path(first) + rng.normal(0.0, 2e-4, (len(first), 3))
    told = turned(first) * Rotation.from_rotvec(rng.normal(0.0, 1e-3, (len(first), 3)))
    point = path(second - late) + turned(second - late).apply(rng.normal(0.0, 1e-3, 3))
    other = point @ (np.eye(3) + 2e-3 * rng.normal(size=(3, 3))) + [1e-3, -2e-3, 0.0]
    other += rng.normal(0.0, 1e-4, other.shape)
    other[::97] += 0.05
    return Motion(first, one, told.as_quat()), Motion(second, other)


@pytest.mark.long
@pytest.mark.parametrize("late", [-0.035, 0.012])
def test_intervals_hold_the_true_difference(late: float) -> None:
    """Of 100 pairs 88 or more of 95 % intervals hold it, three standard deviations from 95; most are below 1 ms."""
    found = [later(*([one] for one in pair(late, seed))) for seed in range(100)]
    assert all(one is not None for one in found)
    held = [one.ci95[0] <= late <= one.ci95[1] for one in found if one is not None]
    assert 88 <= sum(held) <= 100
    assert np.median([one.ci95[1] - one.ci95[0] for one in found if one is not None]) < 1e-3


def test_a_frame_that_is_wrong_costs_nothing() -> None:
    """By 3 % of its lengths and 2 degrees, which is 5 mm at the ends of the path: as sure as beside a right one.

    12 ms later is +12 ms, with outliers and beside a marker that is wrong by 1 mm, too.
    """
    first, second = pair(0.012, 7)
    wrong = np.eye(3) + 0.03 * np.random.default_rng(8).normal(size=(3, 3))
    found, right = (later([first], [second._replace(position=second.position @ by)]) for by in (wrong, np.eye(3)))
    assert found is not None and right is not None
    assert right.value == pytest.approx(0.012, abs=5e-4)
    assert found.value == pytest.approx(right.value, abs=5e-5)
    assert found.half < 2.0 * right.half < 4e-4


def test_too_little_in_common_tells_nothing() -> None:
    """Sensors of different times, or of half a second, are not compared."""
    first, second = pair(0.0, 3)
    assert later([first.only(first.time < 10.0)], [second.only(second.time > 20.0)]) is None
    assert later([first], [second.only(second.time < 0.5)]) is None
    still = Motion(first.time, np.zeros_like(first.position))
    assert later([still], [still]) is None
