"""`pumafuse latency`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from ..folders import write_file
from ..logs.run import Run
from ..tuning.latency import Latency, latency
from ..views import report as reports
from .screen import say
from .tables import print_tables, table


def run(
    paths: Sequence[Path],
    sensor: str | None,
    report: Path | None,
    json: bool,
    force: bool,
    part: tuple[float | None, float | None] = (None, None),
) -> None:
    """Tell how late everything is; the arguments are the options of the command."""
    found = _told(paths, sensor, report, json, force, part=part)
    if found is None:
        return
    say("\nto write into fusion.toml and arm.toml (pumafuse identify RUN -o arm.toml writes the latter):\n")
    say(reports.settings(found))
    say("elsewhere:")
    for line in reports.elsewhere(found.details):
        say(f"  {line}")
    if report is not None:
        say(f"written to {report}")


def identify(
    paths: Sequence[Path], output: Path, sensor: str | None, report: Path | None, json: bool, force: bool
) -> None:
    """Make a model of an arm from recorded motion."""
    if _told(paths, sensor, report, json, force, output=output) is None:
        return
    say(f"written to {output}" + (f" and {report}" if report is not None else ""))
    say(f"next: pumafuse verify RUN --arm {output}, with a run that it was not made from")


def _told(
    paths: Sequence[Path],
    sensor: str | None,
    report: Path | None,
    json: bool,
    force: bool,
    part: tuple[float | None, float | None] = (None, None),
    output: Path | None = None,
) -> Latency | None:
    """What was found, after it is written and its answers printed; None if that was JSON, which is all then."""
    if report is not None:
        reports.check_writable(report, force)
    runs = [Run.read(path).between(*part) for path in paths]
    with Console(stderr=True).status("looking at how motion follows the commands"):
        found = latency(runs, sensor=sensor)
    if output is not None:
        write_file(output, found.arm.to_toml(), replace=force)
    if report is not None:
        reports.write_latency(found, report, force)
    if json:
        say(found.to_json().removesuffix("\n"))
        return None
    for line in reports.answers(found.details):
        say(line)
    print_tables([table(*reports.lags(found.details))])
    if any(one.shared_delay for one in found.details.axes.values()):
        say("* one dead time for several axes")
    return found
