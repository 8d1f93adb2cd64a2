"""`pumafuse compare`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import RunError
from ..fusion import results
from ..fusion.summary import Summary
from .tables import console, print_json, score_table, skill_table


def run(folders: Sequence[Path], reference: Path | None, json: bool) -> None:
    """Score result folders.

    Raises:
        PumafuseError: A folder holds no results, or nothing can be scored.
    """
    compared, summaries = list[dict[str, Any]](), dict[str, Summary]()
    for folder in folders:
        result = results.read(folder)
        track = result.reference
        if reference is not None:
            track = results.read_reference(reference, result.summary.origin_ns, result.config.frame)
        if track is None:
            raise RunError(f"{folder}: the run had no reference; give one with --reference")
        scores = result.scores(track)
        if not scores:
            raise RunError(
                f"{folder}: the reference covers no estimate on any axis; do its axes ({', '.join(track.position)})"
                " and its clock fit the run?"
            )
        run, mode, summaries[str(folder)] = result.summary.run, result.summary.mode, result.summary
        skill = {
            axis: {name: one.skill for name, one in part.sensors.items()} for axis, part in result.summary.axes.items()
        }
        compared.append({"folder": str(folder), "run": run, "mode": mode, "axes": scores, "skill": skill})
    if json:
        print_json(compared)
    else:
        for table in (score_table((one["folder"], one["axes"]) for one in compared), skill_table(summaries.items())):
            if table.columns:
                console(sys.stdout).print(table)
