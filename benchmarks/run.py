"""Times pumafuse on real jobs, beside other filters and another checkout of itself.

    python benchmarks/run.py [--only TEXT] [--against WHICH] [--repeats N] [--rounds N] [--json FILE] [--write]

Everything runs in a process of its own: what one leaves behind (a grown heap, compiled code) then cannot flatter or
hurt another. With --against, the two checkouts take turns. Minima of all calls of all rounds are compared: on a
machine that does other work, too, they say most. ``--write`` measures everything beside version 0.2 and puts the
tables into the pages.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import io
import json
import os
import platform
import statistics
import subprocess
import sys
import tarfile
import textwrap
from collections.abc import Callable, Iterable
from itertools import compress
from pathlib import Path

import peers
import project
from page import COMPARISON, LIVE, REPOSITORY, put, table
from project import Row

HERE = Path(__file__).parent
VERSION_0_2 = "a513260"  # its last commit; the next one moves the filter from numba to C++
CASES = [*((HERE / "peers.py", name) for name in peers.PEERS), *((HERE / "project.py", name) for name in project.CASES)]
ONCE = ("tune", "first use", "memory")  # what takes long is measured in one round
ALONE = ("response",)  # what version 0.2 has not
PACKAGES = ("numpy", "scipy", "numba", "filterpy", "statsmodels", "dynamax", "jax", "fast-kalman")
SCAN = "the scan, three axes, ns a measured value (a million rows are 2.56 million values)"
TITLES = {
    "filter": f"Filtering {SCAN}",
    "as live": f"As live: {SCAN}",
    "smooth": f"Smoothing {SCAN}",
    "likelihood": "The likelihood of a run, ns a measured value",
    "response": "The response of a bent arm, ns a command or an instant",
    "live": "Live, three axes, µs a call or row",
    "process": "Whole processes on the scan, s",
    "tune": "`pumafuse tune --fit noise,delay,plant`, s",
    "first use": "First use on a machine, and the next, s of wall time",
    "memory": "Memory at the peak, GB",
}
DIGITS = {"ns": 0, "µs": 1, "s": 2, "GB": 2}


def checkout(which: str) -> Path:
    """Another checkout of pumafuse: a folder, or a commit, which is laid down, and built, in one that git ignores."""
    if Path(which).is_dir():
        return Path(which).resolve()
    folder = HERE / ".build" / which
    if not folder.exists():
        command = ["git", "-C", str(REPOSITORY), "archive", "--format=tar", which]
        done = subprocess.run(command, capture_output=True, check=False)
        if done.returncode:
            sys.exit(f"no folder and no commit {which}: {done.stderr.decode().strip()}")
        with tarfile.open(fileobj=io.BytesIO(done.stdout)) as archive:
            archive.extractall(folder, filter="data")
    if (folder / "CMakeLists.txt").exists():  # version 0.2 has no library to build
        build = str(folder / "build")
        for step in (["-S", str(folder), "-B", build, "-DPUMAFUSE_INPLACE=ON"], ["--build", build]):
            subprocess.run([sys.executable, "-m", "cmake", *step], check=True, stdout=subprocess.DEVNULL)
    return folder


def in_own_process(script: Path, name: str, repeats: int, sources: Path) -> list[Row]:
    """The rows of a case; one that says what went wrong if it failed."""
    path = os.pathsep.join([str(sources / "src"), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, str(script), name, str(repeats)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["killed"])[-1]
        return [{"job": "failed", "name": name, "unit": "s", "values": [], "note": last}]
    return json.loads(done.stdout.splitlines()[-1])


def measured(script: Path, name: str, given: argparse.Namespace) -> list[Row]:
    """The rows of a case over all rounds, with ``against`` where the other checkout was measured."""
    rows: dict[str, Row] = {}
    compared = given.against and name in project.CASES and name not in ALONE
    checkouts = {"values": REPOSITORY} | ({"against": given.against} if compared else {})
    for _ in range(1 if name in ONCE else given.rounds):
        for key, sources in checkouts.items():
            for row in in_own_process(script, name, given.repeats, sources):
                kept = rows.setdefault(row["name"], row | {"values": [], "wall": [], "high": [], "against": []})
                kept[key] += row["values"]
                if key == "values":
                    kept["wall"] += row.get("wall", [])
                    kept["high"] += row.get("high", [])
    return list(rows.values())


HEAD = ("", "min", "median", "wall", "99 %", "0.2", "over 0.2", "error", "note")


def cells(row: Row) -> list[str]:
    """A row as text, as in HEAD."""
    values, against, digits = row["values"], row["against"], DIGITS[row["unit"]]

    def number(found: list[float], kind: Callable[[list[float]], float] = min) -> str:
        return f"{kind(found):,.{digits}f}" if found else ""

    if not values:
        return [row["name"], *[""] * (len(HEAD) - 2), f"failed: {row['note']}"]
    return [
        row["name"],
        number(values),
        number(values, statistics.median),
        number(row["wall"]),
        number(row["high"]),
        number(against),
        f"{min(values) / min(against):.2f}" if against else "",
        f"{row['error']:.0e}" if "error" in row else "",
        row["note"],
    ]


def machine() -> str:
    """It, when that was, and the versions of all that is compared."""
    info = Path("/proc/cpuinfo")
    names = [line for line in info.read_text().splitlines() if line.startswith("model name")] if info.exists() else []
    cpu = names[0].split(":", 1)[1].strip() if names else platform.processor() or platform.machine()
    found = [f"Python {platform.python_version()}"]
    for package in PACKAGES:
        try:
            found.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            found.append(f"{package} missing")
    here = f"{cpu}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}"
    return textwrap.fill(f"{datetime.date.today():%Y-%m-%d}, {here}, {', '.join(found)}.", 120)


def tables(rows: list[Row], jobs: Iterable[str]) -> str:
    """The tables of some jobs; where there are peers the fastest comes first."""
    compared, found = {peer.job for peer in peers.PEERS.values()}, list[str]()
    for job in jobs:
        mine = [row for row in rows if row["job"] == job]
        if job in compared:
            mine.sort(key=lambda row: min(row["values"]))
        lines = [cells(row) for row in mine]
        used = [any(line[column] for line in lines) and HEAD[column] != "median" for column in range(len(HEAD))]
        head = ["", mine[0]["unit"], *HEAD[2:-1], ""]
        text = [list(compress(line, used)) for line in (head, *lines)]
        found += [f"**{TITLES[job]}**", table(text[0], text[1:], 1, notes=int(used[-1]))]
    return "\n\n".join(found)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="TEXT", help="what has this in its name")
    parser.add_argument("--against", metavar="WHICH", help="a folder or a commit of pumafuse, to be measured in turns")
    parser.add_argument("--repeats", type=int, default=5, help="calls in each process")
    parser.add_argument("--rounds", type=int, default=2, help="processes of each case; what takes long has one")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all numbers there")
    parser.add_argument("--write", action="store_true", help="all, beside version 0.2, into the pages")
    given = parser.parse_args()
    if given.write and (given.only or given.against):
        parser.error("--write measures everything, beside version 0.2")
    if given.write:
        given.against = VERSION_0_2
    if given.against is not None:
        given.against = checkout(given.against)
    print(f"{machine()}\n{'':<48}" + "".join(f"{name:>12}" for name in HEAD[1:-1]), flush=True)
    rows: list[Row] = []
    for script, name in CASES:
        if given.only in name:
            found = measured(script, name, given)
            rows += found
            for row in found:
                label, *numbers, note = cells(row)
                print(f"{label:<48}" + "".join(f"{n:>12}" for n in numbers) + f"  {note}", flush=True)
    if given.json:
        given.json.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1) + "\n")
    if any(not row["values"] for row in rows):
        sys.exit("not all could be measured" + (": the pages stay as they are" if given.write else ""))
    if given.write:
        put(COMPARISON, "run.py", f"{machine()}\n\n{tables(rows, TITLES)}")
        put(LIVE, "run.py", tables(rows, ["live"]))


if __name__ == "__main__":
    main()
