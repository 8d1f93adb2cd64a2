"""Scores of the velocity, on constructed estimates: against the reference's mean velocity over the coming period."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from executable import pumafuse
from pumafuse.fusion import results
from pumafuse.fusion.score import ReferenceTrack, score_velocity

PERIOD = 0.028


def path(time: np.ndarray) -> np.ndarray:
    """Where the axis is [m]."""
    return 0.5 + 0.05 * np.sin(2.0 * time)


def mean_velocity(time: np.ndarray) -> np.ndarray:
    return (path(time + PERIOD) - path(time)) / PERIOD


def track(time: np.ndarray, position: np.ndarray, *, sd: float = 0.0, segment: np.ndarray | None = None):
    whole = np.zeros(len(time), dtype=np.int64) if segment is None else segment
    return ReferenceTrack(time, {"radial": position}, {"radial": np.full(len(time), sd)}, whole)


def score(time: np.ndarray, velocity: np.ndarray, sd: float, reference: ReferenceTrack, **more: np.ndarray):
    segment = more.get("segment", np.zeros(len(time), dtype=np.int64))
    return score_velocity(time, segment, velocity, np.full(len(time), sd), reference, "radial", PERIOD)


def test_the_velocity_is_that_of_the_coming_period() -> None:
    """Exact mean velocities have no error; the last period has no end in the reference and is left out."""
    time = PERIOD * np.arange(200)
    found = score(time, mean_velocity(time) + 1e-3, 1e-3, track(time, path(time)))
    assert (found.rows, found.left_out) == (199, 1)
    assert (found.rmse, found.bias, found.nees) == pytest.approx((1e-3, 1e-3, 1.0), rel=1e-9)
    assert found.coverage == 1.0


def test_both_ends_of_the_period_need_the_reference_in_the_same_segment() -> None:
    """A gap of the reference, NaN in it and the end of a segment leave out every period that touches them."""
    time = 0.01 * np.arange(100)
    reference = path(time)
    reference[40:60] = np.nan  # from 0.39 to 0.60 s there is a gap
    segment = (time > 0.795).astype(np.int64)
    found = score(time, mean_velocity(time), 1e-3, track(time, reference, segment=segment), segment=segment)
    inside = [t for t in range(100) if (t + 2.8 <= 39 or t >= 60) and (t + 2.8 <= 79 or t >= 80) and t + 2.8 <= 99]
    assert (found.rows, found.left_out) == (len(inside), 100 - len(inside))


def test_error_bars_that_hold_have_95_percent_coverage() -> None:
    """The noise of the reference at both ends of the period, 2·sd²/T², is added to the variance of the velocity."""
    rng = np.random.default_rng(1)
    time = 2.0 * PERIOD * np.arange(20_000)  # no two periods share a row of the reference
    rows = PERIOD * np.arange(40_001)
    noisy = path(rows) + 1e-4 * rng.standard_normal(len(rows))
    velocity = mean_velocity(time) + 3e-3 * rng.standard_normal(len(time))
    found = score(time, velocity, 3e-3, track(rows, noisy, sd=1e-4))
    assert found.rmse == pytest.approx(np.hypot(3e-3, np.sqrt(2.0) * 1e-4 / PERIOD), rel=0.02)
    assert found.coverage == pytest.approx(0.95, abs=0.006)
    assert found.nees == pytest.approx(1.0, abs=0.04)


def estimates(*, smoothed: bool) -> pf.Estimates:
    """Exact positions, and mean velocities with an error of 2 mm/s where there are any."""
    time = PERIOD * np.arange(50)
    velocity = np.full(50, np.nan) if smoothed else mean_velocity(time) + 2e-3
    axis = pf.AxisEstimate(path(time), np.full(50, 1e-4), velocity, velocity * 0.0 + 1e-3, *np.zeros((4, 50)))
    run = pf.Run.from_arrays(time, {"radial": path(time)}, reference=(time, {"radial": path(time)}), name="made")
    est = pf.fuse(run, pf.FusionConfig(arm=pf.ArmModel.load("puma560-internal")))
    return replace(est, axes={"radial": axis}, mode="smoothed" if smoothed else "filtered")


def test_summary_table_and_compare_show_the_velocity(tmp_path: Path) -> None:
    """2 mm/s at an sd of 1 are never covered; `compare` finds the summary's numbers in the files."""
    summary = results.write(estimates(smoothed=False), tmp_path / "out", force=False)
    found = summary.axes["radial"].score
    assert found.velocity_rmse_mm_s == pytest.approx(2.0, rel=1e-6)
    assert found.velocity_coverage == 0.0
    (compared,) = json.loads(pumafuse("compare", tmp_path / "out", "--json").stdout)
    assert compared["axes"]["radial"]["velocity_rmse_mm_s"] == pytest.approx(2.0, rel=1e-6)
    assert compared["axes"]["radial"]["velocity_coverage"] == 0.0
    (row,) = [
        line for line in pumafuse("compare", tmp_path / "out").stdout.splitlines() if line.split()[-1:] == ["0.0%"]
    ]
    assert row.split()[-2:] == ["2.000", "0.0%"]
