"""Times pumafuse on the shipped scan, beside a loop in C++, other filters, and another checkout of itself.

    python benchmarks/run.py [--only TEXT] [--against PATH] [--repeats N] [--rounds N] [--json FILE] [--markdown]

Everything runs in a process of its own: what one leaves behind (a grown heap, compiled code) then cannot flatter or
hurt another. With --against, the two checkouts take turns. Minima of all calls of all rounds are compared: on a
machine that does other work, too, they say most.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import peers
import project
from project import Row

HERE = Path(__file__).parent
CASES = [*((HERE / "project.py", name) for name in project.CASES), *((HERE / "peers.py", name) for name in peers.PEERS)]
PACKAGES = ("pumafuse", "numpy", "scipy", "numba", "filterpy", "statsmodels", "dynamax", "jax")
SCAN = "the shipped scan, three axes, ns a measured value"
TITLES = {
    "filter": f"`filter`: {SCAN}",
    "as live": f"`as live`: {SCAN}",
    "smooth": f"`smooth`: {SCAN}",
    "likelihood": f"`likelihood`: {SCAN}",
    "live": "`live`: three axes, µs a row",
    "process": "`process`: whole processes on the shipped scan, s",
    "compile": "`compile`: the first use on a machine, s more than the next",
    "memory": "`memory`: the process's peak, GB",
}
DIGITS = {"ns": 0, "µs": 2, "s": 2, "GB": 2}


def in_own_process(script: Path, name: str, repeats: int, checkout: str | None = None) -> list[Row]:
    """The rows of a case; one that says what went wrong if it failed."""
    environment = os.environ | ({} if checkout is None else {"PYTHONPATH": str(Path(checkout).resolve() / "src")})
    command = [sys.executable, str(script), name, str(repeats)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["killed"])[-1]
        return [{"job": "failed", "name": name, "unit": "s", "values": [], "note": last}]
    return json.loads(done.stdout.splitlines()[-1])


def measured(script: Path, name: str, given: argparse.Namespace) -> list[Row]:
    """The rows of a case over all rounds, with ``against`` where the other checkout was measured."""
    other = given.against is not None and script.name == "project.py"
    rows: dict[str, Row] = {}
    for _ in range(given.rounds):
        for key, checkout in (("values", None), ("against", given.against))[: 1 + other]:
            for row in in_own_process(script, name, given.repeats, checkout):
                kept = rows.setdefault(row["name"], row | {"values": []})
                kept[key] = [*kept.get(key, []), *row["values"]]
    return list(rows.values())


def with_ratios(rows: list[Row]) -> list[Row]:
    """Of the minimum to that of the first in its job."""
    first: dict[str, float] = {}
    for row in rows:
        if row["values"] and row["job"] in ("filter", "as live", "smooth", "likelihood"):
            row["ratio"] = min(row["values"]) / first.setdefault(row["job"], min(row["values"]))
    return rows


HEAD = ["", "min", "median", "ratio", "against", "this / against", "error", "note"]


def cells(row: Row) -> list[str]:
    """A row as text, as in HEAD."""
    values, against, digits = row["values"], row.get("against"), DIGITS[row["unit"]]
    if not values:
        return [row["name"], *[""] * (len(HEAD) - 2), f"failed: {row['note']}"]
    return [
        row["name"],
        f"{min(values):,.{digits}f}",
        f"{statistics.median(values):,.{digits}f}",
        f"{row['ratio']:.2f}" if "ratio" in row else "",
        f"{min(against):,.{digits}f}" if against else "",
        f"{min(values) / min(against):.2f}" if against else "",
        f"{row['error']:.0e}" if "error" in row else "",
        row["note"],
    ]


def machine() -> str:
    """It and the versions of all that is compared."""
    info = Path("/proc/cpuinfo")
    names = [line for line in info.read_text().splitlines() if line.startswith("model name")] if info.exists() else []
    cpu = names[0].split(":", 1)[1].strip() if names else platform.processor() or platform.machine()
    found: dict[str, str] = {"Python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "missing"
    versions = ", ".join(f"{name} {version}" for name, version in found.items())
    return f"{cpu}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}. {versions}."


def markdown(rows: list[Row]) -> str:
    """The tables of docs/comparison.md."""
    lines = [machine()]
    for job in dict.fromkeys(row["job"] for row in rows):
        found = [cells(row) for row in rows if row["job"] == job]
        kept = [index for index, name in enumerate(HEAD) if not name or any(row[index] for row in found)]
        lines += ["", f"**{TITLES.get(job, job)}**", ""]
        lines += ["| " + " | ".join(HEAD[index] for index in kept) + " |"]
        lines += ["|" + "|".join("---:" if 0 < index < len(HEAD) - 1 else "---" for index in kept) + "|"]
        lines += ["| " + " | ".join(row[index] for index in kept) + " |" for row in found]
    return "\n".join(lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="TEXT", help="what has this in its name")
    parser.add_argument("--against", metavar="PATH", help="another checkout of pumafuse, to be measured in turns")
    parser.add_argument("--repeats", type=int, default=5, help="calls in each process")
    parser.add_argument("--rounds", type=int, default=1, help="processes of each case")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all numbers there")
    parser.add_argument("--markdown", action="store_true", help="print the tables of docs/comparison.md")
    given = parser.parse_args()
    seen: Any = sys.stderr if given.markdown else sys.stdout
    print(f"{machine()}\n{'':<48}" + "".join(f"{name:>15}" for name in HEAD[1:]), file=seen, flush=True)
    rows: list[Row] = []
    for script, name in CASES:
        if given.only in name:
            found = measured(script, name, given)
            rows = with_ratios([*rows, *found])
            for row in found:
                label, *numbers, note = cells(row)
                print(f"{label:<48}" + "".join(f"{n:>15}" for n in numbers) + f"  {note}", file=seen, flush=True)
    if given.markdown:
        print(markdown(rows))
    if given.json:
        given.json.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=1) + "\n")
    if any(not row["values"] for row in rows):
        sys.exit(1)


if __name__ == "__main__":
    main()
