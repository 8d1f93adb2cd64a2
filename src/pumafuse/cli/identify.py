"""`pumafuse identify`."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import typer

from ..errors import ConfigError, PumafuseWarning
from ..folders import FolderError, write_file
from ..identification.identify import Identification, identify
from ..identification.trials import StepTrials
from ..model.arm import ArmModel
from ..units import SCREEN, si
from ..views import report as reports
from .tables import console, table


def run(
    folder: Path,
    output: Path,
    period: float | None,
    samples: int | None,
    paper: bool,
    tolerance: float | None,
    report: Path | None,
    json: bool,
    force: bool,
) -> None:
    """Identify an arm from the step trials in ``folder``; period [s], tolerance in the screen's unit of its axes.

    Raises:
        PumafuseError: The trials cannot be used, or what is to be written is in the way.
    """
    if output.exists():
        _check_replaceable(output, force)
    if report is not None:
        reports.check_writable(report, force)
    trials, name = StepTrials.read(folder), folder.resolve().name
    most = None if tolerance is None else si(tolerance, f"_{SCREEN[trials.kind].unit}")
    found = identify(trials, period=period, samples=samples, paper=paper, tolerance=most, name=name)
    for note in found.notes:
        warnings.warn(note, PumafuseWarning, stacklevel=1)
    write_file(output, found.arm.to_toml())
    if report is not None:
        reports.write_identification(found, trials, report, force)
    if json:
        typer.echo(found.to_json())
        return
    _show(found)
    typer.echo(f"written to {output}" + (f" and {report}" if report is not None else ""))
    typer.echo(f"next: pumafuse verify RUN --arm {output}")


def _check_replaceable(path: Path, force: bool) -> None:
    """Refuse to replace a file that is no arm model, also with --force: its name may be a slip."""
    try:
        ArmModel.load(path)
    except ConfigError:
        raise FolderError(f"{path}: exists and is no arm model, which is not ours to replace; choose another") from None
    if not force:
        raise FolderError(f"{path}: exists; --force replaces it")


def _show(found: Identification) -> None:
    out = console(sys.stdout)
    out.print(table(*reports.models(found)))
    typer.echo("\n".join(reports.sentences(found)))
    if found.dependences:
        out.print(table(*reports.dependences(found)))
    out.print(table(*reports.scatter(found)))
    for one in found.performance:
        typer.echo(f"combined model by {one.factor}: {one.verdict}")
