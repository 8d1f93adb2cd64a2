"""`pumafuse tune`."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import typer
from rich.console import Console
from rich.table import Table

from .. import folders
from ..errors import ConfigError
from ..fusion.config import ARM_FILE, ROBOT_FILE, FusionConfig
from ..logs.run import Run
from ..tuning.arms import BENDS
from ..tuning.parameters import kinds_of
from ..tuning.summary import Fitted, TuningSummary
from ..tuning.tune import Progress, tune
from ..units import SCREEN
from ..views import formatting
from .screen import say
from .tables import interval, number, print_tables, table

SUMMARY = "tuning.json"
PAGE = "report.html"
OURS = frozenset({SUMMARY, PAGE, "fusion.toml", ARM_FILE, ROBOT_FILE})
_HEADINGS = ["parameter", "before", "fitted", "95 % interval"]
_PAIRS = 3  # of correlated parameters that are shown
WORSE, _INTERRUPTED = 3, 130


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
    given = FusionConfig.load(config)
    runs = [Run.read(path).between(*part) for path in paths]
    other = None if validate is None else Run.read(validate)
    with fitting() as progress:
        found = tune(
            runs,
            given,
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
        found.config.save(new)
        (new / SUMMARY).write_text(found.to_json(), encoding="utf-8")
        if report:
            from ..views.tuning_report import page

            (new / PAGE).write_text(page(found, runs), encoding="utf-8")
    if json:
        say(found.to_json().removesuffix("\n"))
    else:
        _show(found.details, found.config.arm.update_period)
        say(f"written to {output}\nnext: pumafuse fuse RUN -c {output / 'fusion.toml'} -o DIR")
    end(found.details)


def end(summary: TuningSummary) -> None:
    """Leave with the exit code of a tuning that was interrupted, or is worse on what it was validated on."""
    if summary.interrupted:
        raise typer.Exit(_INTERRUPTED)
    if summary.worse:
        raise typer.Exit(WORSE)


@contextmanager
def fitting() -> Generator[Progress]:
    """A line on stderr that says how far the fit is, where that is a terminal, and the function that changes it."""
    with Console(stderr=True).status("preparing") as status:
        yield lambda what, log_likelihood: status.update(
            f"{what}: log-likelihood {log_likelihood:.1f} (Ctrl-C keeps the best so far)"
        )


def show_lags(summary: TuningSummary, period: float) -> None:
    """Print the lags, and play, fastest speeds and sags where there are any; period [s]."""
    bends = [_row(one) for one in summary.parameters if any(f".{bend}" in one.key for bend in (*BENDS, "sag"))]
    print_tables([table(_HEADINGS, [*_lags(summary), *bends])])
    say(formatting.lag(period))


def _show(summary: TuningSummary, period: float) -> None:
    """Print the summary on stdout; period [s]."""
    print_tables([_parameters(summary)])
    if summary.lags:
        say(formatting.lag(period))
    lines = [*formatting.chosen(summary.orders), *summary.not_identifiable]
    pairs = sorted(summary.correlations, key=lambda pair: -abs(pair.correlation))
    lines += [formatting.together(pair) for pair in pairs[:_PAIRS]]
    if len(pairs) > _PAIRS:
        lines.append(f"and {len(pairs) - _PAIRS} more pairs: `correlations` in {SUMMARY}")
    for one in summary.biases:
        off = f"{interval(one.bias, one.sd, one.kind)} {SCREEN[one.kind].unit}"
        lines.append(f"{one.run}: {one.sensor} is off by {off} on {one.axis}")
    for line in lines:
        say(line)
    likelihood = [
        [axis, str(one.components), number(one.before, ".1f"), number(one.after, ".1f")]
        for axis, one in summary.likelihood.items()
    ]
    print_tables([table(["fitted on", "measurements", "log-likelihood before", "after"], likelihood)])
    if summary.validation:
        print_tables([_validation(summary)])
    for check in summary.validation or ():
        say(f"{check.run}, {check.axis}: {check.verdict}")


def _parameters(summary: TuningSummary) -> Table:
    """The lags and the parameters with their intervals."""
    rows = [[*_row(one), one.notes] for one in summary.parameters]
    made = table([*_HEADINGS, ""], [*([*row, ""] for row in _lags(summary)), *rows])
    made.columns[0].no_wrap = True
    return made


def _row(one: Fitted) -> list[str]:
    return [one.key, number(one.before, ".4g"), number(one.value, ".4g"), _limits(one.ci95)]


def _lags(summary: TuningSummary) -> list[list[str]]:
    return [
        [f"lag of {axis}, ms", f"{one.before_ms:.4g}", f"{one.lag_ms:.4g}", _limits(one.lag_ms_ci95)]
        for axis, one in summary.lags.items()
    ]


def _limits(ci95: tuple[float | None, float | None]) -> str:
    low, high = ("…" if end is None else f"{end:.4g}" for end in ci95)
    return "" if ci95 == (None, None) else f"{low} to {high}"


def _validation(summary: TuningSummary) -> Table:
    """Before and after, on what was validated on: a row for each axis and sensor."""
    rows: list[list[str]] = []
    for one in summary.validation or ():
        since = f" from {one.since_s:.1f} s" if one.since_s else ""
        pair = (one.before, one.after)
        rmse = formatting.change_of_positions([state.rmse for state in pair], one.kind)
        coverage = formatting.change([state.coverage for state in pair], ".3f")
        for name in one.before.sensors:
            sensors = [state.sensors.get(name) for state in pair]
            nis = formatting.change([sensor and sensor.nis for sensor in sensors], ".2f")
            correlation = formatting.change([sensor and sensor.correlation for sensor in sensors], "+.2f")
            rows.append([one.run + since, one.axis, name, rmse, coverage, nis, correlation])
    numbers = ("RMSE", "coverage", "NIS", "correlation at lag 1")
    return table(["validated on", "axis", "sensor", *numbers], rows)
