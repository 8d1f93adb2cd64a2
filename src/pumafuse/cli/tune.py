"""`pumafuse tune`."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import typer
from rich.console import Console

from .. import folders
from ..errors import ConfigError
from ..fusion.config import ARM_FILE, ROBOT_FILE, FusionConfig
from ..logs.run import Run
from ..model.arm import ArmModel
from ..tuning.arms import BENDS
from ..tuning.parameters import kinds_of
from ..tuning.summary import TuningSummary
from ..tuning.tune import Progress, tune
from ..units import SCREEN
from ..views import formatting
from .screen import INTERRUPTED, say
from .tables import interval, print_tables, table

SUMMARY = "tuning.json"
PAGE = "report.html"
OURS = frozenset({SUMMARY, PAGE, "fusion.toml", ARM_FILE, ROBOT_FILE})
_HEADINGS = ["parameter", "before", "fitted", "95 % interval"]
_PAIRS = 3  # of correlated parameters that are shown
WORSE = 3


def run(
    paths: Sequence[Path],
    config: Path,
    output: Path,
    fit: Sequence[str],
    fix: Sequence[str],
    share: Literal["delay"] | None,
    trust: str | None,
    validate: Path | None,
    sd_prior: bool,
    report: bool,
    json: bool,
    force: bool,
    part: tuple[float | None, float | None] = (None, None),
) -> None:
    """Tune a configuration on recorded runs and write the result; the arguments are the options of the command."""
    folders.check_writable(output, force, [SUMMARY], OURS.__contains__)
    try:
        kinds = kinds_of(fit)
    except ConfigError as error:
        raise typer.BadParameter(str(error)) from None
    configured = FusionConfig.load(config)
    runs = [Run.read(path).between(*part) for path in paths]
    other = None if validate is None else Run.read(validate)
    with fitting() as progress:
        tuning = tune(
            runs,
            configured,
            fit=kinds,
            fix=fix,
            share=[share] if share else [],
            trust=trust,
            validate=other,
            sd_prior=sd_prior,
            profiles=report,
            progress=progress,
        )
    with folders.replacing(output) as new:
        tuning.config.save(new)
        (new / SUMMARY).write_text(tuning.to_json(), encoding="utf-8")
        if report:
            from ..views.tuning_report import page

            (new / PAGE).write_text(page(tuning, runs), encoding="utf-8")
    if json:
        say(tuning.to_json().removesuffix("\n"))
    else:
        _show(tuning.details, tuning.config.arm)
        say(f"written to {output}\nnext: pumafuse fuse RUN -c {output / 'fusion.toml'} -o DIR")
    end(tuning.details)


def end(summary: TuningSummary) -> None:
    """Leave with the exit code of a tuning that was interrupted, or is worse on what it was validated on."""
    if summary.interrupted:
        raise typer.Exit(INTERRUPTED)
    if summary.worse:
        raise typer.Exit(WORSE)


@contextmanager
def fitting() -> Generator[Progress]:
    """A line on stderr that says how far the fit is, where that is a terminal, and the function that changes it."""
    with Console(stderr=True).status("preparing") as status:
        yield lambda what, log_likelihood: status.update(
            f"{what}: log-likelihood {log_likelihood:.1f} (Ctrl-C keeps the best so far)"
        )


def show_lags(summary: TuningSummary, arm: ArmModel) -> None:
    """Print the lags, and play, fastest speeds and sags where there are any."""
    shown = ("lag of ", *(f".{bend}" for bend in (*BENDS, "sag")))
    rows = [row[:-1] for row in formatting.fitted_rows(summary) if any(part in row[0] for part in shown)]
    print_tables([table(_HEADINGS, rows)])
    say("\n".join(formatting.lag(arm)))


def _show(summary: TuningSummary, arm: ArmModel) -> None:
    """Print the summary on stdout."""
    parameters = table([*_HEADINGS, ""], formatting.fitted_rows(summary))
    parameters.columns[0].no_wrap = True
    print_tables([parameters])
    if summary.lags:
        say("\n".join(formatting.lag(arm)))
    lines = [*formatting.chosen_orders(summary.orders), *summary.not_identifiable]
    pairs = sorted(summary.correlations, key=lambda pair: -abs(pair.correlation))
    lines += [formatting.together(pair) for pair in pairs[:_PAIRS]]
    if len(pairs) > _PAIRS:
        lines.append(f"and {len(pairs) - _PAIRS} more pairs: `correlations` in {SUMMARY}")
    for bias in summary.biases:
        off = f"{interval(bias.bias, bias.sd, bias.kind)} {SCREEN[bias.kind].unit}"
        lines.append(f"{bias.run}: {bias.sensor} is off by {off} on {bias.axis}")
    for line in lines:
        say(line)
    likelihood = [
        [axis, str(likelihood.components), f"{likelihood.before:.1f}", f"{likelihood.after:.1f}"]
        for axis, likelihood in summary.likelihood.items()
    ]
    print_tables([table(["fitted on", "measurements", "log-likelihood before", "after"], likelihood)])
    validation = [
        [check.run, check.axis, *of_sensor[:1], check.rmse, check.coverage, *of_sensor[1:]]
        for check in map(formatting.validation_rows, summary.validation or ())
        for of_sensor in zip(check.sensors, check.nis, check.correlation, strict=True)
    ]
    headings = ["validated on", "axis", "sensor", "RMSE", "coverage", "NIS", "correlation at lag 1"]
    print_tables([table(headings, validation)])
    for check in summary.validation or ():
        say(f"{check.run}, {check.axis}: {check.verdict}")
