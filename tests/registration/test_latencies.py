"""Sensor against sensor."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pumafuse.registration.latencies import later
from pumafuse.registration.motion import Motion


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
