"""`pumafuse fuse` and `pumafuse demo`."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.resources import as_file, files
from itertools import count
from pathlib import Path

import numpy as np
import typer

from ..errors import RunError
from ..filter.outcome import Outcome
from ..fusion import results
from ..fusion.config import FusionConfig
from ..fusion.estimates import Estimates, Mode
from ..fusion.offline import Engine, fuse
from ..fusion.summary import Summary
from ..logs.run import Run
from ..units import KINDS
from .many import progress_bar, report_failures, run_jobs
from .resume import Wanted, results_there, source_of
from .tables import left_out, outcome_table, print_tables, runs_table, score_table, skill_table


def run(
    runs: Sequence[Path],
    config: Path,
    output: Path,
    sensors: Sequence[str] | None = None,
    rate: float | None = None,
    mode: Mode = "filtered",
    rrd: bool = False,
    figures: bool = False,
    engine: Engine = "compiled",
    force: bool = False,
    part: tuple[float | None, float | None] = (None, None),
    resume: bool = False,
) -> None:
    """Fuse each run into a result folder; a run that fails is reported and does not stop the others.

    Raises:
        PumafuseError: The configuration is wrong, a result to keep was made otherwise, or at least one run failed.
    """
    given = FusionConfig.load(config)
    given.sensor_names(sensors)  # before any run is read
    how = partial(fuse, config=given, sensors=sensors, rate=rate, mode=mode, engine=engine)
    job = partial(_fuse, how, part=part, rrd=rrd, figures=figures, force=force)
    folders = [output] if len(runs) == 1 else _folders(runs, output)
    places = dict(zip(map(str, runs), folders, strict=True))
    kept = dict[str, Summary]()
    if resume:
        extras = ["fused.rrd"] * rrd + ["fused.png"] * figures
        kept = results_there(places, Wanted(given, sensors, rate, mode, engine, part, extras))
    if len(runs) == 1:
        with progress_bar(str(runs[0])) as progress:
            (summary,) = kept.values() or [job(runs[0], output, progress)]
        _show(summary)
        typer.echo(f"written to {output}")
        return
    jobs = {path: partial(job, Path(path), place) for path, place in places.items() if path not in kept}
    done, failed = run_jobs("fusing", jobs, places.values())
    summaries = {place.name: known for path, place in places.items() if (known := kept.get(path) or done.get(path))}
    if summaries:
        print_tables(runs_table(summaries, kind) for kind in KINDS)
        typer.echo(f"written to {output}")
    report_failures(failed, len(places), output)


def demo(output: Path, force: bool) -> None:
    """Fuse the shipped scan, score it, draw it, and say what to open next.

    Raises:
        PumafuseError: The folder is in the way.
    """
    typer.echo(
        "A 60 s scan of a panel by a PUMA 560 (simulated with masses, friction, elastic joints and servos of which the"
        " filter knows\nnothing): a command every 28 ms, a camera (0.5 mm noise, 45 ms late, dropouts and outliers),"
        " and a reference to score\nagainst that the filter never sees.\n"
    )
    with as_file(files("pumafuse") / "data") as data:
        scan, config = data / "scan1", data / "fusion.toml"
        # without the laser tracker it shows best what a camera and a model do together
        run([scan], config, output, sensors=["vision"], rate=200.0, rrd=True, figures=True, force=force)
    typer.echo(
        f"\nWhat to open next:\n"
        f"  {output / 'fused.png'}   the run: command, measurements, estimate with its band\n"
        f"  {output / 'error.png'}   its error against the reference, and the error bars\n"
        f"  {output / 'validation.png'}   is the filter as good as it says?\n"
        f"  rerun {output / 'fused.rrd'}   the same in the Rerun viewer\n"
        f"  {output / 'summary.json'}   every number of it\n"
        f"The same with the laser tracker as well:\n"
        f"  pumafuse fuse {scan} -c {config} --sensors tracker,vision --rate 200 -o with-tracker\n"
        f"  pumafuse compare {output} with-tracker"
    )


def _fuse(
    how: Callable[..., Estimates],
    path: Path,
    folder: Path,
    progress: Callable[[float], None] | None = None,
    *,
    part: tuple[float | None, float | None],
    rrd: bool,
    figures: bool,
    force: bool,
) -> Summary:
    """Read a run, fuse a part of it and write its result folder, with ``fused.rrd`` and figures if wanted."""
    results.check_writable(folder, force)
    recorded = Run.read(path).between(*part)
    est = how(recorded, progress=progress)
    if not np.isin(est.measurements.outcome, [Outcome.FUSED, Outcome.REACQUIRED]).any():
        raise RunError(f"nothing was fused, nothing is written: {_why_nothing(est)}")

    def extras(new: Path) -> None:
        if rrd:
            from ..views.rerun import to_rerun

            to_rerun(est, recorded, new / "fused.rrd")
        if figures:
            from ..views.figures import error_figure, fused_figure, path_figure, validation_figure

            drawn = {
                "fused": fused_figure(est),
                "validation": validation_figure(est),
                "path": path_figure(est, recorded),
                "error": None if est.reference is None else error_figure(est),
            }
            for name, figure in drawn.items():
                if figure is not None:
                    figure.savefig(new / f"{name}.png", dpi=130)

    return results.write(est, folder, force, extras, source_of(path))


def _why_nothing(est: Estimates) -> str:
    """What became of all measurements of a run of which none was fused, and which configured sensors it lacks."""
    rows = [
        f"'{name}' has {', '.join(f'{count} {word}' for word, count in counts.items()) or 'no rows'}"
        for name, counts in est.counts.items()
    ]
    absent = [f"'{name}' of fusion.toml is not in the run" for name in est.config.sensors if name not in est.counts]
    return "; ".join([*rows, *absent]) or "neither the run nor fusion.toml has a sensor"


def _show(summary: Summary) -> None:
    """Print the tables of one fusion."""
    part = "" if summary.from_s is None else f" from {summary.from_s:g} s on"
    typer.echo(
        f"{summary.run}: {summary.estimates} estimates over {summary.duration_s:.1f} s{part}, {summary.mode},"
        f" arm {summary.arm}"
    )
    if without := left_out(summary):
        typer.echo(f"left out: {without}")
    scores = {axis: part.score for axis, part in summary.axes.items() if part.score is not None}
    print_tables(outcome_table(summary, kind) for kind in KINDS)
    print_tables(skill_table([("", summary)], kind) for kind in KINDS)
    print_tables(score_table([(summary.run, summary, scores)], kind) for kind in KINDS)


def _folders(runs: Sequence[Path], output: Path) -> list[Path]:
    """A folder for each run, named after its path; equal names get a number."""
    found, candidates = dict[Path, None](), dict[str, Iterator[Path]]()
    for named in map(source_of, runs):
        name = named.name if named.is_dir() else re.sub(r"(\.csv|\.parquet)?(\.gz)?$", "", named.name)
        free = candidates.setdefault(name, _numbered(output, name or "run"))
        found[next(folder for folder in free if folder not in found)] = None
    return list(found)


def _numbered(output: Path, name: str) -> Iterator[Path]:
    """``name``, ``name_2``, ``name_3`` and so on in ``output``."""
    yield output / name
    for number in count(2):
        yield output / f"{name}_{number}"
