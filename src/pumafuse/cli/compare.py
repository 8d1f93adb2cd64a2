"""`pumafuse compare`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from ..errors import RunError
from ..fusion import results
from ..fusion.summary import ScoreSummary
from .tables import console, score_table


class Compared(msgspec.Struct, frozen=True, kw_only=True):
    """One entry of the list that ``compare --json`` prints: a result folder and its scores by axis."""

    folder: str
    run: str
    mode: str
    axes: dict[str, ScoreSummary]


def run(folders: Sequence[Path], reference: Path | None, json: bool) -> None:
    """Score result folders.

    Raises:
        PumafuseError: A folder holds no results, or nothing can be scored.
    """
    compared: list[Compared] = []
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
        compared.append(Compared(folder=str(folder), run=result.summary.run, mode=result.summary.mode, axes=scores))
    if json:
        print(msgspec.json.format(msgspec.json.encode(compared), indent=2).decode())
    else:
        console().print(score_table([(entry.folder, entry.axes) for entry in compared]))
