"""`pumafuse tune`."""

from __future__ import annotations

import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from .. import folders
from ..errors import ConfigError
from ..fusion.config import FusionConfig
from ..fusion.score import Z95
from ..logs.run import Run
from ..tuning.maximise import Point
from ..tuning.parameters import kinds_of
from ..tuning.summary import TuningSummary
from ..tuning.tune import Progress, Tuning, tune
from ..views import formatting
from .tables import console

SUMMARY = "tuning.json"
PAGE = "report.html"
OURS = frozenset({SUMMARY, PAGE, "fusion.toml", "arm.toml"})
_WORSE, _INTERRUPTED = 3, 130


def run(
    paths: Sequence[Path],
    config: Path,
    output: Path,
    fit: Sequence[str],
    fix: Sequence[str],
    trust: str | None,
    validate: Path | None,
    report: bool,
    json: bool,
    force: bool,
) -> None:
    """Tune a configuration on recorded runs and write the result; the arguments are the options of the command.

    Raises:
        PumafuseError: Nothing can be fitted, or the output folder must not be replaced.
        Exit: With 3 where the result is worse on what it was validated on; with 130 after Ctrl-C.
    """
    folders.check_writable(output, force, [SUMMARY], OURS.__contains__)
    try:
        kinds = kinds_of(fit)
    except ConfigError as error:
        raise typer.BadParameter(str(error)) from None
    given = FusionConfig.load(config)
    runs = [Run.read(path) for path in paths]
    other = None if validate is None else Run.read(validate)
    with _progress() as progress:
        found = tune(runs, given, fit=kinds, fix=fix, trust=trust, validate=other, progress=progress)
    with folders.replacing(output) as new:
        found.config.save(new)
        (new / SUMMARY).write_text(found.to_json(), encoding="utf-8")
        if report:
            from ..views.tuning_report import page

            (new / PAGE).write_text(page(found, runs), encoding="utf-8")
    if json:
        print(found.to_json(), end="")
    else:
        _show(found, output)
    if found.summary.interrupted:
        raise typer.Exit(_INTERRUPTED)
    if found.summary.worse:
        raise typer.Exit(_WORSE)


@contextmanager
def _progress() -> Generator[Progress]:
    """Show the progress of the search in one line on stderr, if that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda _, __: None
        return
    with Console(stderr=True).status("preparing") as status:

        def show(what: str, at: Point) -> None:
            status.update(f"{what}: log-likelihood {at.log_likelihood:.1f} (Ctrl-C keeps the best so far)")

        yield show


def _show(found: Tuning, output: Path) -> None:
    """Print the summary on stdout."""
    out, summary = console(), found.summary
    out.print(_parameters(summary))
    lines = [f"{axis}: {why}" for axis, why in summary.orders.items()]
    lines += summary.not_identifiable
    lines += [formatting.together(pair) for pair in summary.correlations]
    for bias in summary.biases:
        off = f"{bias.bias_mm:.3f} ± {Z95 * bias.sd_mm:.3f} mm"
        lines.append(f"{bias.run}: {bias.sensor} is off by {off} on {bias.axis}")
    for line in lines:
        out.print(line, markup=False)
    table = _table("fitted on", "measurements", "log-likelihood before", "after")
    for axis, one in summary.likelihood.items():
        table.add_row(escape(axis), str(one.components), f"{one.before:.1f}", f"{one.after:.1f}")
    out.print(table)
    if summary.validation:
        out.print(_validation(summary))
    lines = [f"{one.run}, {one.axis}: {one.verdict}" for one in summary.validation or ()]
    lines += [f"written to {output}", f"next: pumafuse fuse RUN -c {output / 'fusion.toml'} -o DIR"]
    for line in lines:
        out.print(line, markup=False, soft_wrap=True)


def _table(*headings: str, left: int = 1) -> Table:
    """An empty table; the first columns are aligned left, the others right."""
    table = Table(box=box.SIMPLE_HEAD)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="left" if number < left else "right", no_wrap=number >= left)
    return table


def _parameters(summary: TuningSummary) -> Table:
    """The parameters with their intervals."""
    table = _table("parameter", "before", "fitted", "95 % interval")
    table.columns[0].no_wrap = True
    table.add_column("", overflow="fold")
    for one in summary.parameters:
        low, high = ("…" if end is None else f"{end:.4g}" for end in one.ci95)
        interval = "" if one.ci95 == (None, None) else f"{low} to {high}"
        before = "–" if one.before is None else f"{one.before:.4g}"
        table.add_row(escape(one.key), before, f"{one.value:.4g}", interval, one.notes)
    return table


def _validation(summary: TuningSummary) -> Table:
    """Before and after, on what was validated on: a row for each axis and sensor."""
    table = _table("validated on", "axis", "sensor", "RMSE, mm", "coverage", "NIS", "correlation at lag 1", left=3)
    for one in summary.validation or ():
        since = f" from {one.since_s:.1f} s" if one.since_s else ""
        pair = (one.before, one.after)
        rmse = formatting.change([state.rmse_mm for state in pair], ".3f")
        coverage = formatting.change([state.coverage for state in pair], ".3f")
        for name in one.before.sensors:
            sensors = [state.sensors.get(name) for state in pair]
            nis = formatting.change([None if sensor is None else sensor.nis for sensor in sensors], ".2f")
            correlation = formatting.change(
                [None if sensor is None else sensor.correlation for sensor in sensors], "+.2f"
            )
            table.add_row(escape(one.run) + since, escape(one.axis), escape(name), rmse, coverage, nis, correlation)
    return table
