"""Jobs that no peer has: the whole of `pumafuse.fuse`, whole processes, memory."""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

import pumafuse as pf

Row = dict[str, Any]
Mode = Literal["filtered", "smoothed", "as live"]

DATA = Path(pf.__file__).parent / "data"
SCAN, CONFIG = DATA / "scan1", DATA / "fusion.toml"
AXES = ("tangential", "radial", "vertical")
LENGTH = 60_200_000_000  # ns, from one repetition of the scan to the next
JITTER = 0.2e-3  # s, so that no repetition has the intervals of another


def repeated(rows: int, axes: tuple[str, ...] = AXES) -> pf.Run:
    """The shipped scan, over and over, until its sensors have ``rows`` rows; stamps jitter anew each time."""
    scan, rng = pf.Run.read(SCAN), np.random.default_rng(1)
    sensors = {name: source for name, source in scan.sensors.items() if set(axes) & set(source.values)}
    per_scan = sum(len(source.stamp) for source in sensors.values())
    times = -(-rows // per_scan)

    def repeat(source: Any, jitter: float, wanted: float = 1.0) -> tuple[Any, dict[str, Any]]:
        count = round(wanted * times * len(source.stamp))
        stamp = (source.stamp + LENGTH * np.arange(times)[:, None]).ravel()
        stamp = np.sort(stamp + np.rint(rng.normal(0.0, 1e9 * jitter, len(stamp))).astype(np.int64))
        values = {axis: np.tile(value, times)[:count] for axis, value in source.values.items() if axis in axes}
        return stamp[:count], values

    share = rows / (times * per_scan)
    command = repeat(scan.command, 0.0, share)
    return pf.Run.from_arrays(*command, {name: repeat(source, JITTER, share) for name, source in sensors.items()})


def rows_of(run: pf.Run) -> int:
    """Of all sensors."""
    return sum(len(source.stamp) for source in run.sensors.values())


def fuse(run: pf.Run, mode: Mode = "filtered") -> pf.Estimates:
    """The shipped configuration, with the sensors that the run has."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pf.PumafuseWarning)  # the arm jumps home between repetitions
        config = pf.FusionConfig.load(CONFIG)
        return pf.fuse(run, config, sensors=run.sensors, smooth=mode == "smoothed", as_live=mode == "as live")


def scan(mode: Mode) -> Callable[[int], list[Row]]:
    """One million rows of three axes."""

    def measure(repeats: int) -> list[Row]:
        run = repeated(1_000_000)
        fuse(pf.Run.read(SCAN), mode)
        seconds: list[float] = []
        for _ in range(repeats):
            start = time.perf_counter()
            est = fuse(run, mode)
            seconds.append(time.perf_counter() - start)
            del est
        rows, components = rows_of(run), sum(len(s.stamp) * len(s.values) for s in run.sensors.values())
        each = f"{min(seconds):.2f} s in all, {1e9 * min(seconds) / components:,.0f} ns a value"
        return [row("scan", f"pumafuse.fuse, {mode}", "ns", [1e9 * s / rows / len(AXES) for s in seconds], rows, each)]

    return measure


def row(job: str, name: str, unit: str, values: list[float], steps: int | None = None, note: str = "") -> Row:
    """One row of the table."""
    found = {"job": job, "peer": name, "unit": unit, "minimum": min(values), "median": statistics.median(values)}
    return found | {"steps": steps, "note": note}


# Whole processes

LISTING = """
import sys
from pumafuse.cli.main import main
try:
    main()
finally:
    here = sys.stdlib_module_names | {"pumafuse", "__main__"}
    with open(FILE, "w") as file:
        file.writelines(f"{name}\\n" for name in list(sys.modules) if name.split(".")[0] not in here)
"""
SURVIVORS = """
import importlib, sys
lines = []
for name in open(sys.argv[1]).read().split():
    if not name.replace(".", "_").isidentifier():
        continue
    try:
        importlib.import_module(name)
    except Exception:  # made by an extension at run time
        continue
    lines.append(f"import {name}\\n")
open(sys.argv[2], "w").writelines(lines)
"""


def imports(folder: Path, name: str, arguments: list[str]) -> list[str]:
    """A command that imports, and does no more, the modules of libraries that ``pumafuse`` has when it is through."""
    listed, module = folder / f"{name}.txt", folder / f"{name}.py"
    code = LISTING.replace("FILE", repr(str(listed)))
    run([sys.executable, "-c", code, *arguments])
    run([sys.executable, "-c", SURVIVORS, str(listed), str(module)])
    return [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(folder)!r}); import {name}"]


def run(command: list[str]) -> float:
    """Seconds that a process takes, from start to end."""
    start = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - start


def processes(repeats: int) -> list[Row]:
    """Warm processes, in turn, so that a busy spell of the machine meets all of them."""
    executable = str(Path(sys.executable).with_name("pumafuse"))
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        fuse = ["fuse", str(SCAN), "--config", str(CONFIG), "--output", str(folder / "result"), "--force"]
        commands = {
            "pumafuse fuse": [executable, *fuse],
            "  its libraries' imports": imports(folder, "plain_imports", fuse),
            "pumafuse fuse --rrd": [executable, *fuse, "--rrd"],
            "  its libraries' imports ": imports(folder, "rrd_imports", [*fuse, "--rrd"]),
            "pumafuse --help": [executable, "--help"],
            "import pumafuse": [sys.executable, "-c", "import pumafuse"],
            "python": [sys.executable, "-c", "pass"],
        }
        for command in commands.values():
            run(command)
        found: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(repeats):
            for name, command in commands.items():
                found[name].append(run(command))
    rows = {name: row("process", name.rstrip(), "s", seconds) for name, seconds in found.items()}
    for whole, part, words in (
        ("pumafuse fuse", "  its libraries' imports", "its imports"),
        ("pumafuse fuse --rrd", "  its libraries' imports ", "its imports"),
        ("pumafuse --help", "python", "a bare Python"),
        ("import pumafuse", "python", "a bare Python"),
    ):
        more = {key: rows[whole][key] - rows[part][key] for key in ("minimum", "median")}
        rows[whole]["note"] = f"{more['minimum']:.3f} more than {words}; by medians {more['median']:.3f}"
    return list(rows.values())


# Memory


def memory(rows: int, axes: tuple[str, ...]) -> Callable[[int], list[Row]]:
    """The highest that the process's memory has been, of one call, whatever the repeats."""

    def measure(_repeats: int) -> list[Row]:
        resource.setrlimit(resource.RLIMIT_AS, (_free(), resource.RLIM_INFINITY))
        fuse(pf.Run.read(SCAN))
        run = repeated(rows, axes)
        before = _peak()
        sources = [run.command, *run.sensors.values()]
        given = sum(s.stamp.nbytes + sum(value.nbytes for value in s.values.values()) for s in sources) / 1e9
        start = time.perf_counter()
        est = fuse(run)
        seconds = time.perf_counter() - start
        kept = sum(getattr(est[axis], name).nbytes for axis in est.axes for name in pf.AxisEstimate.FIELDS) / 1e9
        note = f"the run {given:.2f}, estimates {kept:.2f}, {before:.2f} before the call; took {seconds:.1f} s"
        return [row("memory", _named(rows, axes), "GB", [_peak()], rows, note)]

    return measure


def _named(rows: int, axes: tuple[str, ...]) -> str:
    return f"{rows:,} rows, {len(axes)} {'axis' if len(axes) == 1 else 'axes'}"


@cache
def _free() -> int:
    """Bytes that the system can give; with more it would begin to swap, or end other processes."""
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _peak() -> float:
    """GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9


JOBS: tuple[tuple[str, str, Callable[[int], list[Row]]], ...] = (
    ("scan", "pumafuse.fuse, filtered", scan("filtered")),
    ("scan", "pumafuse.fuse, smoothed", scan("smoothed")),
    ("scan", "pumafuse.fuse, as live", scan("as live")),
    ("process", "processes", processes),
    ("memory", _named(10_000_000, AXES[:1]), memory(10_000_000, AXES[:1])),
    ("memory", _named(10_000_000, AXES), memory(10_000_000, AXES)),
)
