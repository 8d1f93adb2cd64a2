"""`pumafuse identify`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import ConfigError, warn
from ..folders import check_replaceable, write_file
from ..identification.identify import Identification, identify
from ..identification.trials import StepTrials
from ..model.arm import ArmModel
from ..units import SCREEN, si
from ..views import report as reports
from .screen import say
from .tables import print_tables, table


def run(
    paths: Sequence[Path],
    output: Path,
    sensor: str | None,
    period_ms: float | None,
    samples: int | None,
    paper: bool,
    tolerance: float | None,
    report: Path | None,
    json: bool,
    force: bool,
) -> None:
    """Identify an arm from the step trials in a folder, or from recorded runs."""
    check_replaceable(output, force, output.exists() and _is_arm(output), "arm model")
    trials = [path for path in paths if (path / "trials.csv").exists()]
    if not trials:
        from . import latency

        if period_ms is not None or samples is not None or paper or tolerance is not None:
            raise ConfigError("--period, --samples, --paper and --tolerance are for step trials, not for recorded runs")
        latency.run(paths, sensor, report, json, force, arm=output)
        return
    if len(paths) > 1 or sensor is not None:
        raise ConfigError(f"{trials[0]}: has step trials: give this folder alone, and no --sensor")
    (folder,) = trials
    if report is not None:
        reports.check_writable(report, force)
    campaign, name = StepTrials.read(folder), folder.resolve().name
    most = None if tolerance is None else si(tolerance, f"_{SCREEN[campaign.kind].unit}")
    period = None if period_ms is None else si(period_ms, "_ms")
    identification = identify(campaign, period=period, samples=samples, paper=paper, tolerance=most, name=name)
    warn(identification.notes)
    write_file(output, identification.arm.to_toml(), replace=force)
    if report is not None:
        reports.write_identification(identification, campaign, report, force)
    if json:
        say(identification.to_json())
        return
    _show(identification)
    say(f"written to {output}" + (f" and {report}" if report is not None else ""))
    say(f"next: pumafuse verify RUN --arm {output}")


def _is_arm(path: Path) -> bool:
    try:
        ArmModel.load(path)
    except ConfigError:
        return False
    return True


def _show(identification: Identification) -> None:
    print_tables([table(*reports.models(identification))])
    say("\n".join(reports.sentences(identification)))
    if identification.dependences:
        print_tables([table(*reports.dependences(identification))])
    print_tables([table(*reports.scatter(identification))])
    for performance in identification.performance:
        say(f"combined model by {performance.factor}: {performance.verdict}")
