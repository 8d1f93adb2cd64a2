"""`pumafuse verify`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import typer

from .. import toml
from ..errors import warn
from ..identification.verify import verify
from ..logs.run import Run
from ..model.arm import ArmModel
from ..units import si
from ..views import formatting
from ..views import report as reports
from .screen import say, say_json
from .tables import print_tables, table

_FAILED = 3


def run(
    paths: Sequence[Path],
    arm: str,
    sensors: Sequence[str] | None,
    start: Mapping[str, float],
    report: Path | None,
    json: bool,
    force: bool,
) -> None:
    """Compare a model with runs that it was not made from; start levels are in mm, or degrees."""
    if report is not None:
        reports.check_writable(report, force)
    model = ArmModel.load(arm)
    warn(model.doubts())
    levels = {axis: si(level, f"_{model.screen_of(axis).unit}") for axis, level in start.items()}
    results = [result for path in paths for result in verify(Run.read(path), model, sensors=sensors, start=levels)]
    if report is not None:
        reports.write_verification(results, model, report, force)
    verified = [verification for verification, _ in results]
    warn(f"run '{result.run}': {note}" for result in verified for note in result.notes)
    if json:
        say_json([toml.reported(result, result.kind) for result in verified])
    else:
        print_tables(table(*of_kind) for of_kind in reports.verifications(verified))
        say("\n".join([*formatting.lag(model), *map(reports.verdict, verified)]))
        if report is not None:
            say(f"written to {report}")
    if not all(result.holds for result in verified):
        raise typer.Exit(_FAILED)
