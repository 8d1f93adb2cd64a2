"""`pumafuse latency`, and `pumafuse identify` of recorded runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from ..folders import write_file
from ..logs.run import Run
from ..tuning.latency import latency
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
    arm: Path | None = None,
) -> None:
    """Tell how late everything is, and what to write where; or write the model of the arm into ``arm``."""
    if report is not None:
        reports.check_writable(report, force)
    runs = [Run.read(path).between(*part) for path in paths]
    with Console(stderr=True).status("looking at how motion follows the commands"):
        result = latency(runs, sensor=sensor)
    if arm is not None:
        write_file(arm, result.arm.to_toml(), replace=force)
    if report is not None:
        reports.write_latency(result, report, force)
    if json:
        say(result.to_json().removesuffix("\n"))
        return
    say("\n".join(reports.answers(result.details)))
    print_tables([table(*reports.lags(result.details))])
    if any(axis.shared_delay for axis in result.details.axes.values()):
        say("* one dead time for several axes")
    if arm is None:
        say("\nto write into fusion.toml and arm.toml (pumafuse identify RUN -o arm.toml writes the latter):\n")
        say(reports.settings(result))
        say("\n  ".join(["elsewhere:", *reports.elsewhere(result.details)]))
    if written := [str(path) for path in (arm, report) if path is not None]:
        say(f"written to {' and '.join(written)}")
    if arm is not None:
        say(f"next: pumafuse verify RUN --arm {arm}, with a run that it was not made from")
