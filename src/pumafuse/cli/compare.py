"""`pumafuse compare`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .. import toml
from ..errors import RunError
from ..fusion import results
from ..fusion.summary import ScoreSummary, Summary
from ..units import KINDS
from .tables import print_json, print_tables, score_table, skill_table


def run(folders: Sequence[Path], reference: Path | None, json: bool) -> None:
    """Score result folders.

    Raises:
        PumafuseError: A folder holds no results, or nothing can be scored.
    """
    compared = list[tuple[str, Summary, Mapping[str, ScoreSummary]]]()
    for folder in folders:
        result = results.read(folder)
        track = result.reference
        if reference is not None:
            track = results.read_reference(reference, result.summary.origin_ns, result.config)
        if track is None:
            raise RunError(f"{folder}: the run had no reference; give one with --reference")
        scores = result.scores(track)
        if not scores:
            raise RunError(
                f"{folder}: the reference covers no estimate on any axis; do its axes ({', '.join(track.position)})"
                " and its clock fit the run?"
            )
        compared.append((str(folder), result.summary, scores))
    if json:
        print_json([_reported(*one) for one in compared])
        return
    print_tables(score_table(compared, kind) for kind in KINDS)
    print_tables(skill_table([(folder, summary) for folder, summary, _ in compared], kind) for kind in KINDS)


def _reported(folder: str, summary: Summary, scores: Mapping[str, ScoreSummary]) -> dict[str, Any]:
    """A result as JSON, in the units of its axes."""
    skill = {
        axis: {name: one.skill and toml.reported(one.skill, part.kind) for name, one in part.sensors.items()}
        for axis, part in summary.axes.items()
    }
    axes = {axis: toml.reported(one, summary.axes[axis].kind) for axis, one in scores.items()}
    return {"folder": folder, "run": summary.run, "mode": summary.mode, "axes": axes, "skill": skill}
