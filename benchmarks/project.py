"""What pumafuse itself takes: `fuse` on the scan, a likelihood, live, whole processes, `tune`, first use, memory.

    python benchmarks/project.py NAME REPEATS    prints the rows of one of CASES as JSON; run.py calls it

It measures the pumafuse that Python finds: `run.py --against` puts another on PYTHONPATH, of version 0.2 or later.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from page import REPOSITORY

import pumafuse as pf
from pumafuse.fusion.engine import innovations
from pumafuse.fusion.estimates import Mode
from pumafuse.fusion.segments import build_segment

Row = dict[str, Any]

DATA = Path(str(files("pumafuse") / "data"))
SCAN, CONFIG = DATA / "scan1", DATA / "fusion.toml"
TRUNK = REPOSITORY / "examples" / "trunk-servo"
START = {"tangential": 0.0, "radial": 0.56, "vertical": -0.1}  # m
ROWS = 1_000_000
LENGTH = 60_200_000_000  # ns, from one repetition of the scan to the next
MS = 1_000_000  # ns
JITTER = 0.2e-3  # s, so that no repetition has the intervals of another
FIT = "noise,delay,plant"
KEPT = ("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR")  # where processes keep something: the last one is of version 0.2
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


def row(job: str, name: str, unit: str, values: list[float], note: str = "", **more: list[float]) -> Row:
    """One row of a table; ``more`` are ``wall``, or what ``high`` values are."""
    return {"job": job, "name": name, "unit": unit, "values": values, "note": note, **more}


# In one process


def fuse(job: str, mode: Mode, repeats: int) -> list[Row]:
    """One million rows of three axes."""
    run, config = repeated(ROWS), pf.FusionConfig.load(CONFIG)
    seconds = timed(lambda: pf.fuse(run, config, mode=mode), repeats)
    name = "pumafuse.fuse" if mode == "filtered" else f"pumafuse.fuse, {mode}"
    return [
        row(job, name, "ns", [1e9 * s / values_of(run) for s in seconds], "everything, from the run to its estimates")
    ]


def likelihood(repeats: int) -> list[Row]:
    """What one step of a search by likelihood takes."""
    run, config = repeated(ROWS), pf.FusionConfig.load(CONFIG)
    segment = build_segment(run, config)
    seconds = timed(lambda: innovations(segment, config), repeats)
    note = "the run's table ready; the gates decide"
    return [row("likelihood", "pumafuse, innovations", "ns", [1e9 * s / values_of(run) for s in seconds], note)]


def bends(repeats: int) -> list[Row]:
    """The response r of an arm that swings, to a minute of sines which ask for more than its fastest speed."""
    from pumafuse.filter.response import response  # version 0.2 has none

    stamp = 28 * MS * np.arange(2143)
    time = np.rint(1e9 * np.arange(0.01, 59.5, 1.0 / 30.0)).astype(np.int64)
    command = 0.1 * np.sin(1e-9 * np.pi * stamp) + 0.03 * np.sin(2.6e-9 * np.pi * stamp)  # m
    arm = partial(pf.AxisModel, plant=pf.SecondOrder(natural_frequency=30.0, damping=0.8))
    kinds = {"linear": {}, "play": {"play": 0.004}, "limit": {"max_speed": 0.25}}
    kinds["play and limit"] = kinds["play"] | kinds["limit"]
    rows: list[Row] = []
    for name, bend in kinds.items():
        axis = arm(**bend)
        spent = timed(
            lambda axis=axis: [response(axis, 0.028, 0.06, stamp, command, 0.0, time) for _ in range(100)], repeats
        )
        values = [1e9 * s / (100 * (len(stamp) + len(time))) for s in spent]
        note = f"{min(values) / min(rows[0]['values']):.2f} of a linear one" if rows else ""
        rows.append(row("response", f"response, {name}", "ns", values, note))
    return rows


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
        add = estimator.measurement
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
        later = [partial(add, (6000 + n) * MS, "tracker", **START) for n in range(1000)]
        beside = [("LiveEstimator.measurement beside a busy thread", call) for call in later]
        spent: dict[str, list[float]] = defaultdict(list)
        for some, surroundings in ((calls, nullcontext()), (beside, busy_thread())):
            with surroundings:
                for name, call in some:
                    begin = time.perf_counter_ns()
                    call()
                    spent[name].append((time.perf_counter_ns() - begin) / 1e3)
        for name, times in spent.items():
            half, high = np.percentile(times[len(times) // 6 :], [50, 99])
            medians[name].append(float(half))
            highs[name].append(float(high))
    return [
        row("live", f"{name}, median", "µs", medians[name], NOTES.get(name, ""), high=highs[name]) for name in medians
    ]


NOTES = {
    "LiveEstimator.measurement": "rows at 1 kHz, in order",
    "LiveEstimator.measurement, 100 ms late": "100 rows of 1 kHz are updated again",
    "LiveEstimator.measurement beside a busy thread": "in Python, as of a node that does something else, too",
    "LiveEstimator.command": "every 28 ms",
    "LiveEstimator.estimate": "now",
    "a filterpy loop": "two states an axis; no delay, lateness or gate",
}


@contextmanager
def busy_thread() -> Iterator[None]:
    """A thread that never waits of its own accord."""
    stop = threading.Event()

    def work() -> None:
        while not stop.is_set():
            pass

    thread = threading.Thread(target=work)
    thread.start()
    yield
    stop.set()
    thread.join()


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


class Spent(NamedTuple):
    """Seconds that a process took, from start to end."""

    cpu: float
    wall: float

    def __sub__(self, other: Spent) -> Spent:
        return Spent(self.cpu - other.cpu, self.wall - other.wall)


def seconds_of(command: list[str], stdin: str = "", home: str | None = None) -> Spent:
    """What a process takes, with those that it starts; what it keeps for the next one goes to the folder ``home``."""
    environment = os.environ | ({} if home is None else dict.fromkeys(KEPT, home))
    with tempfile.TemporaryFile("w+") as file:
        file.write(stdin)
        file.seek(0)
        before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(command, stdin=file, capture_output=True, check=False, env=environment)
        after, end = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    if done.returncode not in (0, 3):  # 3: done, but what was tuned is no better everywhere
        sys.exit(done.stderr.decode())
    return Spent(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, end - begin)


def fuse_command(folder: str) -> list[str]:
    """``pumafuse fuse`` on the shipped scan."""
    return [*PUMAFUSE, "fuse", str(SCAN), "--config", str(CONFIG), "--output", f"{folder}/result", "--force"]


def tune_command(folder: str, run: Path, config: Path, *options: str) -> list[str]:
    """``pumafuse tune``."""
    return [*PUMAFUSE, "tune", str(run), "-c", str(config), "-o", f"{folder}/tuned", "--force", "--fit", FIT, *options]


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
        each = [10.0 * (seconds_of(command, many) - seconds_of(command, few)).cpu for _ in range(min(repeats, 3))]
        note = "CPU time of a row, beside the process's start"
        found.append(row("live", f"pumafuse live stdin, {name}", "µs", each, note))
    return found


def processes(repeats: int) -> list[Row]:
    """Warm processes, in turn, so that a busy spell of the machine meets all of them."""
    with tempfile.TemporaryDirectory() as folder:
        commands = {
            "pumafuse fuse": fuse_command(folder),
            "pumafuse --help": [*PUMAFUSE, "--help"],
            "import numpy, pyarrow": [sys.executable, "-c", "import numpy, pyarrow"],
            "import pumafuse": [sys.executable, "-c", "import pumafuse"],
            "python": [sys.executable, "-c", "pass"],
        }
        found: dict[str, list[Spent]] = {name: [] for name in commands}
        for _ in range(repeats + 1):
            for name, command in commands.items():
                found[name].append(seconds_of(command))
    cpu = {name: [spent.cpu for spent in seconds[1:]] for name, seconds in found.items()}
    wall = {name: [spent.wall for spent in seconds[1:]] for name, seconds in found.items()}
    whole, needed = "pumafuse fuse", "import numpy, pyarrow"
    for kind in (cpu, wall):
        kind["pumafuse fuse, more than these imports"] = [min(kind[whole]) - min(kind[needed])]
    return [row("process", name, "s", cpu[name], wall=wall[name]) for name in cpu]


def tune(_repeats: int) -> list[Row]:
    """The shipped scan; a minute of a servo."""
    with tempfile.TemporaryDirectory() as folder:
        minute = tune_command(folder, TRUNK / "0g", TRUNK / "fusion.toml", "--to", "60")
        commands = {"the scan": tune_command(folder, SCAN, CONFIG), "a minute of examples/trunk-servo/0g": minute}
        found = {name: seconds_of(command) for name, command in commands.items()}
    return [row("tune", name, "s", [spent.cpu], wall=[spent.wall]) for name, spent in found.items()]


def first_use(repeats: int) -> list[Row]:
    """Processes of somebody who has never used pumafuse, and the same once more."""
    found: dict[str, list[float]] = defaultdict(list)
    for _ in range(min(repeats, 2)):
        for name in ("fuse", "live stdin"):
            with tempfile.TemporaryDirectory() as home:
                command = (fuse_command(home), "") if name == "fuse" else (live_command(), lines(100))
                for use in ("first", "next"):
                    found[f"pumafuse {name}, {use} use"].append(seconds_of(*command, home).wall)
    return [row("first use", name, "s", seconds) for name, seconds in found.items()]


CASES: dict[str, Callable[[int], list[Row]]] = {
    "pumafuse.fuse": partial(fuse, "filter", "filtered"),
    "pumafuse.fuse, as-live": partial(fuse, "as live", "as-live"),
    "pumafuse.fuse, smoothed": partial(fuse, "smooth", "smoothed"),
    "pumafuse, likelihood": likelihood,
    "response": bends,
    "LiveEstimator.measurement": live,
    "pumafuse live stdin": stdin,
    "processes": processes,
    "tune": tune,
    "first use": first_use,
    "memory": memory,
}

if __name__ == "__main__":
    warnings.simplefilter("ignore", pf.PumafuseWarning)  # the arm jumps home between repetitions
    print(json.dumps(CASES[sys.argv[1]](int(sys.argv[2]))))
