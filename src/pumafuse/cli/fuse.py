"""`pumafuse fuse`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from ..fusion import results
from ..fusion.config import FusionConfig
from ..fusion.estimates import Estimates
from ..fusion.offline import Engine, fuse
from ..fusion.summary import Summary
from ..logs.run import Run
from .many import report_failures, run_jobs
from .tables import console, outcome_table, runs_table, score_table


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options of ``pumafuse fuse``; see its ``--help``."""

    config: Path
    output: Path
    sensors: Sequence[str] | None
    rate: float | None
    smooth: bool
    as_live: bool
    rrd: bool
    figures: bool
    engine: Engine
    force: bool


def run(runs: Sequence[Path], options: Options) -> None:
    """Fuse each run into a result folder; a run that fails is reported and does not stop the others.

    Raises:
        PumafuseError: The configuration is wrong, or at least one run failed.
    """
    config = FusionConfig.load(options.config)
    config.sensor_names(options.sensors)
    if len(runs) == 1:
        results.check_writable(options.output, options.force)
        recorded = Run.read(runs[0])
        with progress_of(recorded.name) as progress:
            summary = _fuse(recorded, options.output, config, options, progress)
        show(summary, options.output)
        return
    places = _folders(runs, options.output)
    jobs = {
        str(path): partial(_read_and_fuse, path, folder, config, options)
        for path, folder in zip(runs, places, strict=True)
    }
    done, failed = run_jobs("fusing", jobs, places)
    if done:
        names = dict(zip(jobs, (place.name for place in places), strict=True))
        console().print(runs_table({names[path]: summary for path, summary in done.items()}))
        console(soft_wrap=True).print(f"written to {options.output}", markup=False)
    report_failures(failed, len(jobs), str(options.output))


def show(summary: Summary, folder: Path) -> None:
    """Print the tables of a fusion."""
    out = console()
    out.print(
        f"[bold]{escape(summary.run)}[/bold]: {summary.estimates} estimates over {summary.duration_s:.1f} s,"
        f" {summary.mode}, arm {escape(summary.arm)}"
    )
    if any(axis.sensors for axis in summary.axes.values()):
        out.print(outcome_table(summary))
    scores = {axis: part.score for axis, part in summary.axes.items() if part.score is not None}
    if scores:
        out.print(score_table([(summary.run, scores)]))
    out.print(f"written to {folder}", soft_wrap=True, markup=False)


def write(est: Estimates, recorded: Run, folder: Path, *, rrd: bool, figures: bool, force: bool) -> Summary:
    """Write a result folder, with ``fused.rrd`` and figures if wanted.

    Raises:
        FolderError: See :func:`pumafuse.fusion.results.write`.
    """

    def extras(new: Path) -> None:
        if rrd:
            from ..views.rerun import to_rerun

            to_rerun(est, recorded, new / "fused.rrd")
        if figures:
            from ..views.figures import error_figure, fused_figure, validation_figure

            fused_figure(est, recorded, new / "fused.png")
            validation_figure(est, new / "validation.png")
            if est.reference is not None:
                error_figure(est, new / "error.png")

    return results.write(est, folder, force, extras)


def _read_and_fuse(path: Path, folder: Path, config: FusionConfig, options: Options) -> Summary:
    results.check_writable(folder, options.force)
    return _fuse(Run.read(path), folder, config, options)


def _fuse(
    recorded: Run,
    folder: Path,
    config: FusionConfig,
    options: Options,
    progress: Callable[[float], None] | None = None,
) -> Summary:
    est = fuse(
        recorded,
        config,
        sensors=options.sensors,
        rate=options.rate,
        smooth=options.smooth,
        as_live=options.as_live,
        engine=options.engine,
        progress=progress,
    )
    return write(est, recorded, folder, rrd=options.rrd, figures=options.figures, force=options.force)


def _folders(runs: Sequence[Path], output: Path) -> list[Path]:
    """A folder for each run, named after its path; equal names get a number."""
    names: list[str] = []
    for path in runs:
        resolved = path.resolve()
        plain = resolved.parent.name if resolved.name == "run.toml" else resolved.name
        plain = plain if resolved.is_dir() else _without_endings(plain)
        name, number = plain or "run", 2
        while name in names:
            name, number = f"{plain}_{number}", number + 1
        names.append(name)
    return [output / name for name in names]


def _without_endings(name: str) -> str:
    for ending in (".gz", ".csv", ".parquet"):
        name = name.removesuffix(ending)
    return name


@contextmanager
def progress_of(name: str) -> Generator[Callable[[float], None]]:
    """A progress bar on stderr, and the function that moves it; nothing where stderr is no terminal."""
    columns = (TextColumn(name), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task(name, total=1.0)

        def move(done: float) -> None:
            bar.update(task, completed=done)

        yield move


_DEMO_SENSOR = "vision"  # alone: without the laser tracker it shows best what a camera and a model do together


def demo(output: Path, force: bool) -> None:
    """Fuse the shipped scan, score it, draw it, and say what to open next.

    Raises:
        PumafuseError: The folder is in the way.
    """
    results.check_writable(output, force)
    out = console(soft_wrap=True)
    out.print(
        "A 60 s scan of a panel by a PUMA 560 (simulated with masses, friction, elastic joints and servos of which the"
        " filter knows\nnothing): a command every 28 ms, a camera (0.5 mm noise, 45 ms late, dropouts and outliers),"
        " and a reference to score\nagainst that the filter never sees.\n"
    )
    with as_file(files("pumafuse") / "data") as data:
        recorded, config = Run.read(data / "scan1"), FusionConfig.load(data / "fusion.toml")
        with progress_of(recorded.name) as progress:
            est = fuse(recorded, config, sensors=[_DEMO_SENSOR], rate=200.0, progress=progress)
        summary = write(est, recorded, output, rrd=True, figures=True, force=force)
        show(summary, output)
        out.print(
            f"\nWhat to open next:\n"
            f"  {output / 'fused.png'}   the run: command, measurements, estimate with its band\n"
            f"  {output / 'error.png'}   its error against the reference, and the error bars\n"
            f"  {output / 'validation.png'}   is the filter as good as it says?\n"
            f"  rerun {output / 'fused.rrd'}   the same in the Rerun viewer\n"
            f"  {output / 'summary.json'}   every number of it\n"
            f"The same with the laser tracker as well:\n"
            f"  pumafuse fuse {data / 'scan1'} -c {data / 'fusion.toml'} --sensors tracker,vision --rate 200"
            f" -o with-tracker\n"
            f"  pumafuse compare {output} with-tracker"
        )
