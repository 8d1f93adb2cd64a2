"""`pumafuse compare`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import RunError
from ..fusion import results
from .tables import console, print_json, score_table


def run(folders: Sequence[Path], reference: Path | None, json: bool) -> None:
    """Score result folders.

    Raises:
        PumafuseError: A folder holds no results, or nothing can be scored.
    """
    compared: list[dict[str, Any]] = []
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
        run, mode = result.summary.run, result.summary.mode
        compared.append({"folder": str(folder), "run": run, "mode": mode, "axes": scores})
    if json:
        print_json(compared)
    else:
        console(sys.stdout).print(score_table((one["folder"], one["axes"]) for one in compared))
