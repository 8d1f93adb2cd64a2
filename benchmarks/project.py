"""What pumafuse itself takes: `fuse` on the scan, its likelihood, the live estimator, whole processes, memory.

    python benchmarks/project.py NAME REPEATS    prints the rows of one of CASES as JSON; run.py calls it

It measures the pumafuse that Python finds, of version 0.1, too: `run.py --against` puts another on PYTHONPATH.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

import pumafuse as pf

Row = dict[str, Any]

DATA = Path(str(files("pumafuse") / "data"))
SCAN, CONFIG = DATA / "scan1", DATA / "fusion.toml"
AXES = ("tangential", "radial", "vertical")
START = {"tangential": 0.0, "radial": 0.56, "vertical": -0.1}  # m
ROWS = 1_000_000
LENGTH = 60_200_000_000  # ns, from one repetition of the scan to the next
MS = 1_000_000  # ns
JITTER = 0.2e-3  # s, so that no repetition has the intervals of another
PUMAFUSE = (sys.executable, "-c", "from pumafuse.cli.main import main; main()")


def repeated(rows: int) -> pf.Run:
    """The shipped scan, over and over, until its sensors have ``rows`` rows; stamps jitter anew each time."""
    scan, rng = pf.Run.read(SCAN), np.random.default_rng(1)
    per_scan = sum(len(source.stamp) for source in scan.sensors.values())
    times = -(-rows // per_scan)

    def repeat(source: Any, jitter: float) -> tuple[Any, dict[str, Any]]:
        count = round(rows / per_scan * len(source.stamp))
        stamp = (source.stamp + LENGTH * np.arange(times)[:, None]).ravel()
        stamp = np.sort(stamp + np.rint(rng.normal(0.0, 1e9 * jitter, len(stamp))).astype(np.int64))
        return stamp[:count], {axis: np.tile(value, times)[:count] for axis, value in source.values.items()}

    command = repeat(scan.command, 0.0)
    return pf.Run.from_arrays(*command, {name: repeat(source, JITTER) for name, source in scan.sensors.items()})


def values_of(run: pf.Run) -> int:
    """How many numbers the sensors of a run measured: a row has one for each axis that it gives."""
    return sum(len(source.stamp) * len(source.values) for source in run.sensors.values())


def timed(call: Callable[[], Any], repeats: int) -> list[float]:
    """CPU seconds of each call, after one that is not counted; letting go of what it gives is not, either."""
    call()
    found: list[float] = []
    for _ in range(repeats):
        begin = time.process_time()
        result = call()
        found.append(time.process_time() - begin)
        del result
    return found


def row(job: str, name: str, unit: str, values: list[float], note: str = "") -> Row:
    """One row of a table."""
    return {"job": job, "name": name, "unit": unit, "values": values, "note": note}


# In one process


def fuse(job: str, repeats: int, **options: bool) -> list[Row]:
    """One million rows of three axes."""
    run, config = repeated(ROWS), pf.FusionConfig.load(CONFIG)
    seconds = timed(lambda: pf.fuse(run, config, **options), repeats)
    given = "".join(f", {name}=True" for name in options)
    note = f"everything, from the run to its estimates: {min(seconds):.2f} s for a million rows"
    return [row(job, f"pumafuse.fuse{given}", "ns", [1e9 * s / values_of(run) for s in seconds], note)]


def likelihood(repeats: int) -> list[Row]:
    """What one step of a search by likelihood takes."""
    from pumafuse.fusion.engine import innovations

    try:
        from pumafuse.fusion.segments import build
    except ImportError:  # version 0.1
        from pumafuse.fusion.timeline import build
    run, config = repeated(ROWS), pf.FusionConfig.load(CONFIG)
    segment = build(run, config)
    seconds = timed(lambda: innovations(segment, config), repeats)
    name, note = "pumafuse, innovations", "the run's table ready"
    return [row("likelihood", name, "ns", [1e9 * s / values_of(run) for s in seconds], note)]


def live(repeats: int) -> list[Row]:
    """One call with three axes, rows at 1 kHz, a command and an estimate every 28 ms: medians, so often.

    Beside it the loop that many write: a ``filterpy`` filter for each axis, predicted and updated at each measurement,
    in order, without delay, latency, gate or late measurements.
    """
    medians: dict[str, list[float]] = defaultdict(list)
    highs: dict[str, list[float]] = defaultdict(list)
    values = np.random.default_rng(0).normal(list(START.values()), 5e-5, (6000, 3)).tolist()
    for _ in range(repeats):
        estimator = pf.LiveEstimator(pf.FusionConfig.load(CONFIG))
        filters = textbook_filters()
        add = getattr(estimator, "measurement", None) or estimator.reading  # version 0.1
        calls: list[tuple[str, Callable[[], object]]] = []
        for n, (x, y, z) in enumerate(values):
            place = {"tangential": x, "radial": y, "vertical": z}
            if n % 28 == 0:
                calls.append(("LiveEstimator.command", partial(estimator.command, n * MS, **place)))
                calls.append(("LiveEstimator.estimate", estimator.estimate))
            calls.append(("LiveEstimator.measurement", partial(add, n * MS + MS // 2, "tracker", **place)))
        late = [partial(add, 5900 * MS + n, "tracker", **START) for n in range(1000)]
        calls += [("LiveEstimator.measurement, 100 ms late", call) for call in late]
        calls += [("a filterpy loop", partial(textbook_step, filters, measured)) for measured in values[:1000]]
        spent: dict[str, list[float]] = defaultdict(list)
        for name, call in calls:
            begin = time.perf_counter_ns()
            call()
            spent[name].append((time.perf_counter_ns() - begin) / 1e3)
        for name, times in spent.items():
            half, high = np.percentile(times[len(times) // 6 :], [50, 99])
            medians[name].append(float(half))
            highs[name].append(float(high))
    return [row("live", f"{name}, median", "µs", medians[name], f"99 %: {min(highs[name]):.0f} µs") for name in medians]


def textbook_filters() -> list[Any]:
    """Filters of two states, one for each of three axes."""
    from filterpy.kalman import KalmanFilter

    filters = [KalmanFilter(dim_x=2, dim_z=1) for _ in START]
    for kf in filters:
        kf.F, kf.H = np.array([[1.0, 1e-3], [0.0, 1.0]]), np.array([[1.0, 0.0]])
        kf.Q, kf.R = 1e-9 * np.eye(2), np.array([[2.5e-9]])
    return filters


def textbook_step(filters: list[Any], measured: list[float]) -> None:
    """One measurement of each axis."""
    for kf, value in zip(filters, measured, strict=True):
        kf.predict()
        kf.update(value)


def memory(_repeats: int) -> list[Row]:
    """The highest that the process's memory has been, of one call."""
    pf.fuse(pf.Run.read(SCAN), pf.FusionConfig.load(CONFIG))
    run = repeated(10 * ROWS)
    before = _peak()
    est = pf.fuse(run, pf.FusionConfig.load(CONFIG))
    note = f"{before:.2f} before the call, with the run"
    return [row("memory", f"pumafuse.fuse, {10 * ROWS:,} rows of three axes", "GB", [_peak()], note)] if est else []


def _peak() -> float:
    """GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9


# Whole processes


def seconds_of(command: list[str], stdin: str = "", cache: str | None = None) -> float:
    """CPU seconds that a process takes, from start to end; what it compiles goes to ``cache``."""
    environment = os.environ | ({} if cache is None else {"NUMBA_CACHE_DIR": cache})
    with tempfile.TemporaryFile("w+") as file:
        file.write(stdin)
        file.seek(0)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, stdin=file, capture_output=True, check=True, env=environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def fuse_command(folder: str) -> list[str]:
    """``pumafuse fuse`` on the shipped scan."""
    return [*PUMAFUSE, "fuse", str(SCAN), "--config", str(CONFIG), "--output", f"{folder}/result", "--force"]


def live_command(*options: str) -> list[str]:
    """``pumafuse live stdin`` with the shipped configuration."""
    return [*PUMAFUSE, "live", "stdin", "-c", str(CONFIG), *options]


def lines(rows: int) -> str:
    """Rows of a tracker at 1 kHz with a command every 28 ms."""
    place = {axis: u * 1e3 for axis, u in START.items()}
    found: list[str] = []
    for n in range(rows):
        if n % 28 == 0:
            found.append(json.dumps({"t": n / 1000, "command": place}))
        found.append(json.dumps({"t": n / 1000, "sensor": "tracker", **place}))
    return "\n".join(found) + "\n"


def stdin(repeats: int) -> list[Row]:
    """Lines through a whole process: what more of them take."""
    found: list[Row] = []
    few, many = lines(1000), lines(101_000)
    for name, options in (("an estimate a command", ()), ("--rate 100", ("--rate", "100"))):
        command = live_command(*options)
        seconds_of(command, few)
        each = [10.0 * (seconds_of(command, many) - seconds_of(command, few)) for _ in range(min(repeats, 3))]
        note = f"{1e6 / min(each):,.0f} rows a second, beside the process's start"
        found.append(row("live", f"pumafuse live stdin, {name}", "µs", each, note))
    return found


def processes(repeats: int) -> list[Row]:
    """Warm processes, in turn, so that a busy spell of the machine meets all of them."""
    with tempfile.TemporaryDirectory() as folder:
        commands = {
            "pumafuse fuse": fuse_command(folder),
            "pumafuse --help": [*PUMAFUSE, "--help"],
            "import pumafuse": [sys.executable, "-c", "import pumafuse"],
            "python": [sys.executable, "-c", "pass"],
        }
        found: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(repeats + 1):
            for name, command in commands.items():
                found[name].append(seconds_of(command))
    return [row("process", name, "s", seconds[1:]) for name, seconds in found.items()]


def first_use(_repeats: int) -> list[Row]:
    """What compiling takes: a process on a machine that has nothing compiled, less the same once more."""
    found: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, command, text in (
            ("pumafuse fuse", fuse_command(folder), ""),
            ("pumafuse live stdin", live_command(), lines(100)),
        ):
            cache = f"{folder}/{name}"
            cold, warm = (seconds_of(command, text, cache) for _ in range(2))
            found.append(row("compile", f"{name}, compiled for the first time", "s", [cold - warm]))
    return found


CASES: dict[str, Callable[[int], list[Row]]] = {
    "pumafuse.fuse": partial(fuse, "filter"),
    "pumafuse.fuse, as_live": partial(fuse, "as live", mode="as-live"),
    "pumafuse.fuse, smooth": partial(fuse, "smooth", mode="smoothed"),
    "pumafuse, likelihood": likelihood,
    "LiveEstimator.measurement": live,
    "pumafuse live stdin": stdin,
    "processes": processes,
    "first use": first_use,
    "memory": memory,
}

if __name__ == "__main__":
    warnings.simplefilter("ignore", pf.PumafuseWarning)  # the arm jumps home between repetitions
    print(json.dumps(CASES[sys.argv[1]](int(sys.argv[2]))))
