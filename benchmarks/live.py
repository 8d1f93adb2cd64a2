"""How fast the live estimator is: one call, one late measurement, and whole processes on lines from standard input.

    python benchmarks/live.py [--rows N]

Three axes, the shipped configuration, one core. Beside it the loop that many write: a `filterpy` filter for each axis,
predicted and updated at each measurement, in order, without delay, latency, gate or late measurements.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable

import numpy as np
from filterpy.kalman import KalmanFilter
from project import CONFIG, START, lines, live_command

import pumafuse as pf

MS = 1_000_000


def percentiles(calls: list[Callable[[], object]]) -> tuple[float, float]:
    """Median and 99th percentile [µs] of one call each."""
    spent: list[int] = []
    for call in calls:
        begin = time.perf_counter_ns()
        call()
        spent.append(time.perf_counter_ns() - begin)
    return statistics.median(spent) / 1e3, float(np.percentile(spent, 99)) / 1e3


def thousand_hertz(live: pf.LiveEstimator, rows: int) -> list[Callable[[], object]]:
    """Measurements at 1 kHz on three axes."""
    rng = np.random.default_rng(0)
    values = rng.normal(0.0, 5e-5, (rows, 3))
    return [
        lambda row=row: live.measurement(
            (row + 1) * MS,
            "tracker",
            tangential=values[row, 0],
            radial=0.56 + values[row, 1],
            vertical=-0.1 + values[row, 2],
        )
        for row in range(rows)
    ]


def textbook(rows: int) -> list[Callable[[], object]]:
    """The same measurements into a `filterpy` filter for each axis."""
    rng = np.random.default_rng(0)
    values = rng.normal(0.0, 5e-5, (rows, 3))
    filters = []
    for _ in range(3):
        kf = KalmanFilter(dim_x=2, dim_z=1)
        kf.F, kf.H = np.array([[1.0, 1e-3], [0.0, 1.0]]), np.array([[1.0, 0.0]])
        kf.Q, kf.R = 1e-9 * np.eye(2), np.array([[2.5e-9]])
        filters.append(kf)

    def step(row: int) -> None:
        for axis, kf in enumerate(filters):
            kf.predict()
            kf.update(values[row, axis])

    return [lambda row=row: step(row) for row in range(rows)]


def rows_a_second(rows: int, *options: str) -> float:
    """Rows a second of the whole process on one core, start and all, after one short run that finds the kernels."""
    seconds = 0.0
    for count in (1000, rows):
        with tempfile.TemporaryFile("w+") as file:
            file.write(lines(count))
            file.seek(0)
            begin = time.perf_counter()
            subprocess.run(live_command(*options), stdin=file, capture_output=True, check=True)
            seconds = time.perf_counter() - begin
    return rows / seconds


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=200_000, help="lines for the whole process")
    rows = parser.parse_args().rows
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    live = pf.LiveEstimator(pf.FusionConfig.load(CONFIG))
    live.command(0, **START)
    measurements = thousand_hertz(live, 30_000)
    percentiles(measurements[:5000])
    measurement, theirs = percentiles(measurements[5000:]), percentiles(textbook(5000))
    newest = live.newest or 0
    late = [
        lambda n=n: live.measurement(newest - 100 * MS + n, "tracker", tangential=1e-6 * n, radial=0.56, vertical=-0.1)
        for n in range(1, 1000)
    ]
    table = [
        ("`measurement()` in order, three axes", measurement),
        ("`measurement()` 100 ms late: 100 rows of 1 kHz updated again", percentiles(late)),
        ("`command()`", percentiles([lambda n=n: live.command(newest + 28 * n * MS, **START) for n in range(1, 2000)])),
        ("`estimate()` now", percentiles([live.estimate] * 2000)),
        ("a `filterpy` loop, three axes, two states each", theirs),
    ]
    print("| call | median, µs | 99 %, µs | median over `measurement()` |\n|---|---|---|---|")
    for name, (median, high) in table:
        print(f"| {name} | {median:.1f} | {high:.1f} | {median / measurement[0]:.2f} |")
    print(f"\nfrom standard input: {rows_a_second(rows):,.0f} rows a second, an estimate a command")
    print(f"with --rate 100: {rows_a_second(rows, '--rate', '100'):,.0f}")


if __name__ == "__main__":
    main()
