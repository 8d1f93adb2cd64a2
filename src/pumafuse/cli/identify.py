"""`pumafuse identify`."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table

from ..errors import ConfigError, PumafuseWarning
from ..folders import FolderError, write_file
from ..identification.anova import Dependence, Scatter
from ..identification.identify import Identification, identify
from ..identification.trials import StepTrials
from ..model.arm import ArmModel
from ..model.plants import FirstOrder
from ..units import MM, MS
from ..views import formatting as words
from .tables import console


@dataclass(frozen=True)
class Options:
    """What the command line asks for, in s and m; see ``pumafuse identify --help``."""

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
        from ..views import report

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
    shown = found.to_json() if options.json else None
    write_file(options.output, found.arm.to_toml())
    if options.report is not None:
        from ..views import report

        report.write_identification(found, trials, options.report, options.force)
    if shown is None:
        _show(found, options)
    else:
        print(shown)


def _refuse_what_is_no_model(path: Path) -> None:
    """A slip in a file's name must not cost somebody's thesis, whatever is forced."""
    try:
        ArmModel.load(path)
    except ConfigError:
        raise FolderError(f"{path}: exists and is no arm model, which is not ours to replace; choose another") from None


def _show(found: Identification, options: Options) -> None:
    out = console()
    out.print(_models(found))
    for axis, combined in found.axes.items():
        out.print(f"{axis}: {combined.choice.why}; {combined.gain_words}", markup=False)
        if combined.delay_spread > 2.0 * combined.delay_noise:
            noise = (
                f"; the noise within a trial explains {combined.delay_noise * MS:.2g} ms" if not options.paper else ""
            )
            moves = f"the delay moves by {combined.delay_spread * MS:.2g} ms (sd) from trial to trial{noise}"
            out.print(f"{axis}: {moves}", markup=False)
        for trial, why in combined.left_out.items():
            out.print(f"{axis}: trial '{trial}' left out: {why}", markup=False)
    out.print(found.one_delay, markup=False)
    if found.dependences:
        out.print(_dependences(found.dependences))
    out.print(_scatter(found.scatter))
    for one in found.performance:
        out.print(f"combined model by {one.factor}: {one.verdict}", markup=False)
    written = f"written to {options.output}" + (f" and {options.report}" if options.report is not None else "")
    out.print(f"{written}\nnext: pumafuse verify RUN --arm {options.output}", markup=False, soft_wrap=True)


def _models(found: Identification) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("axis", no_wrap=True)
    for heading in ("trials", "plant", "K at speed s [m/s]", "Td, ms", "onset, ms", "lag, ms", "RMS, mm"):
        table.add_column(heading, justify="right")
    for axis, one in found.axes.items():
        delays, plant = one.delays, one.model.plant
        used = [trial.combined_rms for trial in found.trials if trial.axis == axis and trial.left_out is None]
        rms = [value for value in used if value is not None]
        table.add_row(
            escape(axis),
            str(one.trials),
            words.plant(plant).replace(", ", "\n"),
            words.gain(one.model.gain).replace(" + ", "\n+ "),
            words.milliseconds(delays.fitted),
            words.milliseconds(delays.onset),
            words.milliseconds(delays.lag),
            f"{MM * float(np.sqrt(np.mean(np.square(rms)))):.3f}",
        )
        if isinstance(plant, FirstOrder):
            averages = (words.milliseconds(one.time_constant_mean), words.milliseconds(one.time_constant_robust))
            table.add_row("", "", f"trials' mean {averages[0]},\nrobust {averages[1]} ms", "", "", "", "", "")
    return table


def _dependences(rows: list[Dependence]) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("coefficient")
    table.add_column("factor")
    table.add_column("level: mean ± sd (trials)", no_wrap=True)
    for heading in ("i-ratio", "Welch p", "adjusted p"):
        table.add_column(heading, justify="right")
    table.add_column("verdict", overflow="fold")
    for row in rows:
        levels = "\n".join(words.level(level) for level in row.levels)
        table.add_row(
            row.coefficient,
            escape(row.factor),
            escape(levels),
            "–" if row.i_ratio is None else f"{row.i_ratio:.2f}",
            words.p_value(row.welch_p),
            words.p_value(row.adjusted_p),
            row.verdict,
        )
    return table


def _scatter(rows: list[Scatter]) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("coefficient")
    table.add_column("axis")
    for heading in ("median", "normal p", "sd of replicates", "sd by noise"):
        table.add_column(heading, justify="right")
    table.add_column("outlying trials", overflow="fold")
    for row in rows:
        replicates = "–" if row.replicate_sd is None else f"{row.replicate_sd:.2g}"
        named = escape(", ".join(row.outlying)) or "none"
        table.add_row(
            row.coefficient,
            escape(row.axis),
            f"{row.median:.4g}",
            words.p_value(row.normal_p),
            replicates,
            f"{row.own_sd:.2g}",
            named,
        )
    return table
