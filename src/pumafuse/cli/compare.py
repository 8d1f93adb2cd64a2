"""`pumafuse compare`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from ..errors import RunError
from ..fusion import results
from ..fusion.config import FusionConfig
from ..fusion.summary import ScoreSummary, score_summary
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
        truth = result.reference
        if reference is not None:
            frame = FusionConfig.load(folder / "fusion.toml").frame
            truth = results.read_reference(reference, result.summary.origin_ns, frame)
        if truth is None:
            raise RunError(f"{folder}: the run had no reference; give one with --reference")
        scores = {axis: score_summary(score) for axis, score in result.scores(truth).items()}
        if not scores:
            raise RunError(
                f"{folder}: the reference covers no estimate on any axis; do its axes ({', '.join(truth.position)})"
                " and its clock fit the run?"
            )
        compared.append(Compared(folder=str(folder), run=result.summary.run, mode=result.summary.mode, axes=scores))
    if json:
        print(msgspec.json.format(msgspec.json.encode(compared), indent=2).decode())
    else:
        console().print(score_table([(entry.folder, entry.axes) for entry in compared]))
