"""`pumafuse compare`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from .. import folders, toml
from ..errors import RunError
from ..folders import FolderError
from ..fusion import results
from ..fusion.estimates import write_tum
from ..fusion.results import Result
from ..fusion.score import ReferenceTrack
from ..fusion.summary import ScoreSummary, Summary
from ..logs.frames import CARTESIAN
from ..units import KINDS
from .tables import print_json, print_tables, score_table, skill_table


def run(given: Sequence[Path], reference: Path | None, json: bool, tum: Path | None = None) -> None:
    """Score result folders; write their trajectories and references into the folder ``tum``.

    Raises:
        PumafuseError: A folder holds no results, nothing can be scored, or there is no trajectory.
    """
    if tum is not None:
        _write_trajectories(given, reference, tum, quiet=json)
    compared = list[tuple[str, Summary, Mapping[str, ScoreSummary]]]()
    for folder in given:
        result = results.read(folder)
        track = _reference(result, reference)
        if track is None and tum is not None:
            continue  # evo can compare results with each other
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


def _reference(result: Result, path: Path | None) -> ReferenceTrack | None:
    """The reference to score a result against, its own or that of a file."""
    return result.reference if path is None else results.read_reference(path, result.summary.origin_ns, result.config)


def _write_trajectories(given: Sequence[Path], reference: Path | None, output: Path, quiet: bool) -> None:
    """Write ``<folder>.tum`` for each result, and ``<folder>.reference.tum`` where it has a reference in x, y, z."""
    folders.check_writable(output, False, [], lambda _: False)
    names = [folder.resolve().name for folder in given]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise FolderError(f"{output}: two results are called '{twice}', and so would be their files; rename a folder")
    with folders.replacing(output) as new:
        for folder, name in zip(given, names, strict=True):
            result = results.read(folder)
            of = result.config.arm, result.summary.origin_ns
            write_tum(result.track, *of, str(folder), new / f"{name}.tum")
            track = _reference(result, reference)
            if track is not None and (track.cartesian or set(CARTESIAN) <= set(track.position)):
                write_tum(track, *of, f"{folder}: the reference", new / f"{name}.reference.tum")
    if not quiet:
        typer.echo(f"trajectories written to {output}")


def _reported(folder: str, summary: Summary, scores: Mapping[str, ScoreSummary]) -> dict[str, Any]:
    """A result as JSON, in the units of its axes."""
    skill = {
        axis: {name: one.skill and toml.reported(one.skill, part.kind) for name, one in part.sensors.items()}
        for axis, part in summary.axes.items()
    }
    axes = {axis: toml.reported(one, summary.axes[axis].kind) for axis, one in scores.items()}
    return {"folder": folder, "run": summary.run, "mode": summary.mode, "axes": axes, "skill": skill} | {
        "commands": summary.commands,
        "rows": summary.rows,
    }
