"""`pumafuse identify`."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

from ..errors import ConfigError, PumafuseWarning
from ..folders import FolderError, write_file
from ..identification.identify import Identification, identify
from ..identification.trials import StepTrials
from ..model.arm import ArmModel
from ..views import report
from .tables import console, text_table


@dataclass(frozen=True)
class Options:
    """Options of the command line, in s and m; see ``pumafuse identify --help``."""

    output: Path
    period: float | None
    samples: int | None
    paper: bool
    tolerance: float
    report: Path | None
    json: bool
    force: bool


def run(folder: Path, options: Options) -> None:
    """Identify an arm from the step trials in ``folder``.

    Raises:
        PumafuseError: The trials cannot be used, or what is to be written is in the way.
    """
    if options.output.is_dir():
        raise FolderError(f"{options.output}: is a folder; give the name of a file")
    if options.output.exists():
        if not options.force:
            raise FolderError(f"{options.output}: exists; --force replaces it")
        _refuse_what_is_no_model(options.output)
    if options.report is not None:
        report.check_writable(options.report, options.force)
    trials = StepTrials.read(folder)
    found = identify(
        trials,
        period=options.period,
        samples=options.samples,
        paper=options.paper,
        tolerance=options.tolerance,
        name=folder.resolve().name,
    )
    for note in found.notes:
        warnings.warn(note, PumafuseWarning, stacklevel=1)
    json = found.to_json() if options.json else None
    write_file(options.output, found.arm.to_toml())
    if options.report is not None:
        report.write_identification(found, trials, options.report, options.force)
    if json is None:
        _show(found, options)
    else:
        print(json)


def _refuse_what_is_no_model(path: Path) -> None:
    """Refuse to replace a file that is no arm model, also with --force: its name may be a slip."""
    try:
        ArmModel.load(path)
    except ConfigError:
        raise FolderError(f"{path}: exists and is no arm model, which is not ours to replace; choose another") from None


def _show(found: Identification, options: Options) -> None:
    out = console()
    out.print(text_table(report.models(found)))
    for line in report.sentences(found):
        out.print(line, markup=False)
    if found.dependences:
        out.print(text_table(report.dependences(found)))
    out.print(text_table(report.scatter(found)))
    for one in found.performance:
        out.print(f"combined model by {one.factor}: {one.verdict}", markup=False)
    written = f"written to {options.output}" + (f" and {options.report}" if options.report is not None else "")
    out.print(f"{written}\nnext: pumafuse verify RUN --arm {options.output}", markup=False, soft_wrap=True)
