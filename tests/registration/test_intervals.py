"""Intervals by the jackknife over blocks of the motion."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import t as student

from pumafuse.registration.intervals import blocks, inverse, of_poses


def test_intervals_are_those_of_the_numbers_worked_out_without_each_block() -> None:
    """Weighted least squares solved anew 20 times, each without one of 20 blocks: ((b − 1)/b Σ d²)½ of Student's t."""
    random = np.random.default_rng(1)
    slope, weight = random.normal(size=(230, 3, 4)), random.uniform(0.2, 2.0, 230)
    told = slope @ [1.0, -2.0, 0.5, 3.0] + np.repeat(random.normal(size=(23, 3)), 10, axis=0)
    numbers = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 2.0, -1.0]])

    def solved(rows: np.ndarray) -> np.ndarray:
        root = np.sqrt(np.repeat(weight[rows], 3))
        return np.linalg.lstsq(slope[rows].reshape(-1, 4) * root[:, None], told[rows].ravel() * root)[0]

    every = np.arange(230)
    whole = solved(every)
    ends = np.linspace(0, 230, 21).astype(int)
    cuts = [np.setdiff1d(every, np.arange(*between)) for between in pairwise(ends)]
    apart = np.array([numbers @ (solved(cut) - whole) for cut in cuts])
    wanted = student.ppf(0.975, 19) * np.sqrt(19.0 / 20.0 * np.sum(apart**2, axis=0))
    off = told - slope @ whole
    assert blocks(slope, off, weight, weight).half_widths(numbers) == pytest.approx(wanted, rel=1e-9)


def test_what_rows_do_not_tell_does_not_move() -> None:
    """Of a direction without information the inverse is zero; the others are inverted, whatever their units."""
    told = np.diag([4.0e-12, 0.0, 9.0e12])
    np.testing.assert_allclose(inverse(told), np.diag([0.25e12, 0.0, 1.0 / 9.0e12]), rtol=1e-12)


def test_what_goes_with_the_pose_is_told_as_by_dense_matrices() -> None:
    """Rao's MINQUE with V₀ = I and V₁ = exp(−distance) for all rows at once; of which each stands for four alike."""
    random = np.random.default_rng(4)
    pose, slope = random.uniform(-0.2, 0.2, (500, 6)), random.normal(size=(500, 3, 2))
    alike = np.exp(-np.linalg.norm(pose[:, None] - pose, axis=2))
    field = np.linalg.cholesky(alike) @ random.normal(size=(500, 3))
    seen = field + 0.2 * random.normal(size=(500, 3))
    table, dense = slope.reshape(-1, 2), np.kron(alike, np.eye(3))
    apart = np.eye(1500) - table @ np.linalg.inv(table.T @ table) @ table.T
    left = apart @ seen.ravel()
    both = [apart, apart @ dense]
    system = np.array([[np.sum(one * other.T) for other in both] for one in both])
    squares = [left @ left, left @ dense @ left]
    variances = np.linalg.inv(system)
    white, of_pose = variances @ squares
    assert of_pose == pytest.approx(1.0, abs=0.3)
    beyond = of_pose - 2.0 * white * np.sqrt(2.0 * variances[1, 1])
    rows = [np.repeat(part, 4, axis=0) for part in (slope, left.reshape(-1, 3), np.ones(500), pose)]
    told = of_poses(*rows)
    assert told == pytest.approx(16.0 * beyond * (table.T @ dense @ table), rel=1e-9)
    assert not of_poses(*rows[:1], np.repeat(random.normal(size=(500, 3)), 4, axis=0), *rows[2:]).any()
