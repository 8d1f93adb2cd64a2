"""Checks that pumafuse and its peers agree, times them, and prints what it found.

    python benchmarks/run.py [--job JOB] [--only NAME] [--repeats N] [--json FILE] [--markdown]

Everything runs in a process of its own: what one leaves behind (thread pools, a grown heap that spares the next its
page faults, compiled code) then cannot flatter or hurt another. There it is checked against the reference on a short
problem, called once to warm up at full size, and timed. A timed call allocates its own output unless the name says
otherwise; letting go of the output is not timed, nor is building a model's matrices.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

import agreement
import native
import project
from ours import OURS
from peers import PEERS, Job, Peer

from model import Problem, make_problem

Row = dict[str, Any]

PACKAGES = (
    "pumafuse",
    "numpy",
    "scipy",
    "numba",
    "filterpy",
    "simdkalman",
    "kalman-py",
    "statsmodels",
    "dynamax",
    "jax",
    "torch",
    "torch-kf",
)
TITLES: dict[str, str] = {
    "filter": "`filter`: one run of 1,000,000 steps, ns a step",
    "batch": "`batch`: 1,000 runs of 1,000 steps, ns a step",
    "likelihood": "`likelihood`: 200 models on one run of 10,000 steps, one call each, ns a step",
    "grid": "`grid`: the same in one call, ns a step",
    "smooth": "`smooth`: one run of 100,000 steps, ns a step",
    "scan": "`scan`: the shipped scan repeated to 1,000,000 rows, three axes, ns a row and axis",
    "process": "`process`: whole processes on the shipped scan, s",
    "memory": "`memory`: the process's peak, GB",
}


@dataclass(frozen=True)
class Size:
    """How much a job is given: (steps,) or (runs, steps), and how many models to take the likelihood of."""

    shape: tuple[int] | tuple[int, int]
    grid: int = 0

    @property
    def steps(self) -> int:
        """Steps of a filter in all."""
        return math.prod(self.shape) * max(1, self.grid)


FULL: dict[Job, Size] = {
    "filter": Size((1_000_000,)),
    "batch": Size((1_000, 1_000)),
    "likelihood": Size((10_000,), grid=200),
    "grid": Size((10_000,), grid=200),
    "smooth": Size((100_000,)),
}
SHORT: dict[Job, Size] = {
    "filter": Size((2_000,)),
    "batch": Size((7, 300)),
    "likelihood": Size((500,), grid=5),
    "grid": Size((500,), grid=5),
    "smooth": Size((300,)),
}


def problem(peer: Peer, size: Size) -> Problem:
    """The peer's problem at that size."""
    return make_problem(size.shape, size.grid, peer.gaps)


def disagreement(peer: Peer) -> float:
    """How far the peer is from the reference on the short problem, see `agreement.error`."""
    short = problem(peer, SHORT[peer.job])
    if short.grid:
        wanted = agreement.likelihood_reference(short)
    elif peer.job == "smooth":
        wanted = agreement.smooth_reference(short)
    else:
        wanted = agreement.filter_reference(short)
    return agreement.error(peer.result(peer.adapter(short)()), wanted)


def measure(peer: Peer, repeats: int) -> list[Row]:
    """One row of the table."""
    row: Row = {"job": peer.job, "peer": peer.name, "note": peer.note, "error": disagreement(peer)}
    if not row["error"] <= agreement.TOLERANCE:
        return [row | {"failure": f"disagrees by {row['error']:.0e}"}]
    full = FULL[peer.job]
    size = Size((peer.steps,), full.grid) if peer.steps else full
    call = peer.adapter(problem(peer, size))
    call()
    seconds: list[float] = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = call()
        seconds.append(time.perf_counter() - start)
        del result
    per_step = [1e9 * s / size.steps for s in seconds]
    found = {"unit": "ns", "steps": size.steps, "minimum": min(per_step), "median": statistics.median(per_step)}
    return [row | found]


@dataclass(frozen=True)
class Case:
    """What one process measures, given the repeats."""

    job: str
    name: str
    measure: Callable[[int], list[Row]]


CASES: tuple[Case, ...] = (
    *(
        Case(peer.job, peer.name, partial(measure, peer))
        for job in get_args(Job)
        for peer in (*OURS, *PEERS)
        if peer.job == job
    ),
    *(Case(*job) for job in project.JOBS),
)


def in_own_process(case: Case, repeats: int) -> list[Row]:
    """Its rows; one that says what went wrong if it failed."""
    command = [sys.executable, __file__, "--repeats", str(repeats), "--worker", str(CASES.index(case))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["killed"])[-1]
        return [{"job": case.job, "peer": case.name, "note": "", "failure": last}]
    return json.loads(done.stdout.splitlines()[-1])


def cpu() -> str:
    """Its name, where the system tells."""
    told = Path("/proc/cpuinfo")
    names = (
        [line.split(":", 1)[1].strip() for line in told.read_text().splitlines() if line.startswith("model name")]
        if told.exists()
        else []
    )
    return names[0] if names else platform.processor() or platform.machine()


def machine() -> dict[str, str]:
    """It and the versions of all that is compared."""
    gxx = subprocess.run(["g++", "--version"], capture_output=True, text=True, check=True).stdout.splitlines()[0]
    found = {package: importlib.metadata.version(package) for package in PACKAGES}
    system = {"CPU": cpu(), "cores": str(os.cpu_count()), "system": f"{platform.system()} {platform.machine()}"}
    return system | {"Python": platform.python_version(), "g++": gxx.split()[-1]} | found


def machine_line(told: dict[str, str]) -> str:
    """It in words."""
    versions = ", ".join(f"{name} {version}" for name, version in list(told.items())[3:])
    return f"{told['CPU']}, {told['cores']} cores, {told['system']}. {versions}."


def with_ratios(rows: list[Row]) -> list[Row]:
    """Of the minimum to pumafuse's in the same job, where there is one and others stand beside it."""
    ours = {row["job"]: row["minimum"] for row in rows if row["peer"] == "pumafuse" and "minimum" in row}
    return [
        row | {"ratio": row["minimum"] / ours[row["job"]]} if row["job"] in ours and "minimum" in row else row
        for row in rows
    ]


def cells(row: Row) -> list[str]:
    """Name, minimum, median, ratio, error and note as text."""
    if "failure" in row:
        return [row["peer"], "–", "–", "–", "–", f"failed: {row['failure']}"]
    digits = {"ns": 1, "s": 3, "GB": 2}[row["unit"]]
    ratio, error = row.get("ratio"), row.get("error")
    whole = row["job"] not in FULL or row["steps"] == FULL[row["job"]].steps
    notes = [row["note"], "" if whole else f"{row['steps']:,} steps"]
    return [
        row["peer"],
        f"{row['minimum']:,.{digits}f}",
        f"{row['median']:,.{digits}f}",
        "" if ratio is None else f"{ratio:,.2f}" if ratio < 10.0 else f"{ratio:,.0f}",
        "" if error is None else f"{error:.0e}",
        "; ".join(filter(None, notes)),
    ]


def plain(row: Row) -> str:
    """A row of the table on a screen."""
    name, *numbers, note = cells(row)
    return f"{row['job']:<11}{name:<28}" + "".join(f"{number:>10} " for number in numbers) + f" {note}"


HEAD = ["", "min", "median", "ratio", "error", "note"]


def markdown(rows: list[Row], told: dict[str, str]) -> str:
    """The same for docs/benchmarks.md."""
    lines = [machine_line(told)]
    for job, title in TITLES.items():
        found = [cells(row) for row in rows if row["job"] == job]
        if not found:
            continue
        kept = [index for index, name in enumerate(HEAD) if not name or any(row[index] for row in found)]
        table = [HEAD, *found]
        lines += ["", f"**{title}**", ""]
        drawn = ["| " + " | ".join(row[index].strip() for index in kept) + " |" for row in table]
        rule = "|" + "|".join("---:" if 0 < index < 5 else "---" for index in kept) + "|"
        lines += [drawn[0], rule, *drawn[1:]]
    return "\n".join(lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--job", choices=list(TITLES))
    parser.add_argument("--only", default="", help="what has this in its name")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all numbers there")
    parser.add_argument("--markdown", action="store_true", help="print the tables of docs/benchmarks.md")
    parser.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker is not None:
        print(json.dumps(CASES[given.worker].measure(given.repeats)))
        return

    native.library()
    told = machine()
    seen = sys.stderr if given.markdown else sys.stdout
    print(machine_line(told), file=seen)
    print(f"{'':<39}" + "".join(f"{name:>10} " for name in HEAD[1:]), file=seen, flush=True)
    rows: list[Row] = []
    for case in CASES:
        if given.job in (None, case.job) and given.only in case.name:
            found = in_own_process(case, given.repeats)
            rows = with_ratios([*rows, *found])
            print(*map(plain, rows[-len(found) :]), sep="\n", file=seen, flush=True)
    if given.markdown:
        print(markdown(rows, told))
    if given.json:
        given.json.write_text(json.dumps({"machine": told, "rows": rows}, indent=1) + "\n")
    if any("failure" in row for row in rows):
        sys.exit(1)


if __name__ == "__main__":
    main()
