"""`pumafuse fuse` and `pumafuse demo`."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from importlib.resources import as_file, files
from itertools import chain, count
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
from ..pieces.writing import fuse_in_pieces, is_long
from ..units import KINDS
from .many import progress_bar, report_failures, run_jobs
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
) -> None:
    """Fuse each run into a result folder; a run that fails is reported and does not stop the others.

    Raises:
        PumafuseError: The configuration is wrong, or at least one run failed.
    """
    given = FusionConfig.load(config)
    given.sensor_names(sensors)  # before any run is read
    how = partial(fuse, config=given, sensors=sensors, rate=rate, mode=mode, engine=engine)
    whole = partial(_fuse, how, part=part, rrd=rrd, figures=figures, force=force)
    in_pieces = partial(fuse_in_pieces, config=given, sensors=sensors, rate=rate, force=force)
    asked = {"--smooth": mode == "smoothed", "--as-live": mode == "as-live", "--engine": engine != "compiled"}
    asked |= {"--rrd": rrd, "--figures": figures, "--from": part[0] is not None, "--to": part[1] is not None}
    job = partial(_as_fits, whole, in_pieces, [option for option, given in asked.items() if given])
    if len(runs) == 1:
        with progress_bar(str(runs[0])) as progress:
            summary = job(runs[0], output, progress)
        _show(summary)
        typer.echo(f"written to {output}")
        return
    places = dict(zip(map(str, runs), _folders(runs, output), strict=True))
    jobs = {path: partial(job, Path(path), place) for path, place in places.items()}
    done, failed = run_jobs("fusing", jobs, places.values())
    if done:
        summaries = {places[path].name: summary for path, summary in done.items()}
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


def _as_fits(
    whole: Callable[..., Summary],
    in_pieces: Callable[..., Summary],
    asked: Sequence[str],
    path: Path,
    folder: Path,
    progress: Callable[[float], None] | None = None,
) -> Summary:
    """Fuse a run as a whole, or a long one in pieces, which some of the options ``asked`` for do not go with."""
    if not is_long(path):
        return whole(path, folder, progress)
    if asked:
        raise RunError(
            f"{path}: a run of so many rows is fused in pieces, which {asked[0]} does not go with; leave"
            " it out, or cut the log"
        )
    return in_pieces(path, folder=folder, progress=progress)


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

    return results.write(est, folder, force, extras)


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
    found: list[Path] = []
    for path in map(Path.resolve, runs):
        named = path.parent if path.name == "run.toml" else path
        name = named.name if named.is_dir() else re.sub(r"(\.csv|\.parquet)?(\.gz)?$", "", named.name)
        names = chain([name or "run"], (f"{name or 'run'}_{number}" for number in count(2)))
        found.append(next(output / name for name in names if output / name not in found))
    return found
