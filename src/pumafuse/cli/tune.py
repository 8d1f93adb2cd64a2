"""`pumafuse tune`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
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
from ..tuning.parameters import check_fixed, kinds_of
from ..tuning.summary import Fitted, TuningSummary
from ..tuning.tune import Tuning, tune
from ..tuning.validation import Check
from ..views import words
from .tables import console

SUMMARY = "tuning.json"
PAGE = "report.html"
OURS = frozenset({SUMMARY, PAGE, "fusion.toml", "arm.toml"})
_WORSE, _INTERRUPTED = 3, 130


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options of the command; see ``pumafuse tune --help``."""

    config: Path
    output: Path
    fit: Sequence[str]
    fix: Sequence[str]
    trust: str | None
    validate: Path | None
    report: bool
    json: bool
    force: bool


def run(paths: Sequence[Path], options: Options) -> None:
    """Tune a configuration on recorded runs and write the result.

    Raises:
        PumafuseError: Nothing can be fitted, or the output folder must not be replaced.
        Exit: With 3 where the result is worse on what it was validated on; with 130 after Ctrl-C.
    """
    folders.check_writable(options.output, options.force, [SUMMARY], OURS.__contains__)
    try:
        kinds = kinds_of(options.fit)
    except ConfigError as error:
        raise typer.BadParameter(str(error)) from None
    config = FusionConfig.load(options.config)
    check_fixed(config, options.fix)
    runs = [Run.read(path) for path in paths]
    validate = None if options.validate is None else Run.read(options.validate)
    with _progress() as progress:
        found = tune(
            runs,
            config,
            fit=kinds,
            fix=options.fix,
            trust=options.trust,
            validate=validate,
            progress=progress,
        )
    with folders.replacing(options.output) as new:
        found.config.save(new)
        (new / SUMMARY).write_text(found.to_json(), encoding="utf-8")
        if options.report:
            from ..views.tuning_report import page

            (new / PAGE).write_text(page(found, runs), encoding="utf-8")
    if options.json:
        print(found.to_json(), end="")
    else:
        _show(found, options)
    if found.summary.interrupted:
        raise typer.Exit(_INTERRUPTED)
    if found.summary.worse:
        raise typer.Exit(_WORSE)


@contextmanager
def _progress() -> Generator[Callable[[str, Point], None]]:
    """Show the progress of the search in one line on stderr, if that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda _, __: None
        return
    with Console(stderr=True).status("preparing") as status:

        def show(what: str, at: Point) -> None:
            status.update(f"{what}: log-likelihood {at.log_likelihood.total:.1f} (Ctrl-C keeps the best so far)")

        yield show


def _show(found: Tuning, options: Options) -> None:
    out, summary = console(), found.summary
    out.print(_parameters(summary.parameters))
    for axis, why in summary.orders.items():
        out.print(f"{axis}: {why}", markup=False)
    for one in summary.not_identifiable:
        out.print(one, markup=False)
    for pair in summary.correlations:
        out.print(words.together(pair), markup=False)
    for bias in summary.biases:
        off = f"{bias.bias_mm:.3f} ± {Z95 * bias.sd_mm:.3f} mm"
        out.print(f"{bias.run}: {bias.sensor} is off by {off} on {bias.axis}", markup=False)
    out.print(_likelihoods(summary))
    if summary.validation:
        out.print(_validation(summary.validation))
        for one in summary.validation:
            out.print(f"{one.run}, {one.axis}: {one.verdict}", markup=False, soft_wrap=True)
    out.print(f"written to {options.output}", markup=False, soft_wrap=True)
    out.print(f"next: pumafuse fuse RUN -c {options.output / 'fusion.toml'} -o DIR", markup=False, soft_wrap=True)


def _parameters(fitted: Sequence[Fitted]) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("parameter", no_wrap=True)
    for heading in ("before", "fitted", "95 % interval"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("", overflow="fold")
    for one in fitted:
        low, high = ("" if end is None else f"{end:.4g}" for end in one.ci95)
        interval = "" if one.ci95 == (None, None) else f"{low or '…'} to {high or '…'}"
        before = "–" if one.before is None else f"{one.before:.4g}"
        table.add_row(escape(one.key), before, f"{one.value:.4g}", interval, one.notes)
    return table


def _likelihoods(summary: TuningSummary) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("fitted on")
    for heading in ("measurements", "log-likelihood before", "after"):
        table.add_column(heading, justify="right")
    for axis, one in summary.likelihood.items():
        table.add_row(escape(axis), str(one.components), f"{one.before:.1f}", f"{one.after:.1f}")
    return table


def _validation(checks: Sequence[Check]) -> Table:
    """Before and after, on what was validated on: a row for each sensor, an axis's score in its first."""
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("validated on", overflow="fold")
    table.add_column("axis")
    for heading in ("RMSE, mm", "coverage"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("sensor")
    for heading in ("NIS", "correlation at lag 1"):
        table.add_column(heading, justify="right", no_wrap=True)
    for one in checks:
        since = f" from {one.since_s:.1f} s" if one.since_s else ""
        pair = (one.before, one.after)
        scores = (
            escape(one.run) + since,
            escape(one.axis),
            words.change([state.rmse_mm for state in pair], ".3f"),
            words.change([state.coverage for state in pair], ".3f"),
        )
        for number, name in enumerate(one.before.sensors):
            found = [state.sensors.get(name) for state in pair]
            table.add_row(
                *(scores if number == 0 else ("", "", "", "")),
                escape(name),
                words.change([None if sensor is None else sensor.nis for sensor in found], ".2f"),
                words.change([None if sensor is None else sensor.correlation for sensor in found], "+.2f"),
            )
    return table
