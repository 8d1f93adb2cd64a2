"""`pumafuse fuse` and `pumafuse demo`."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from functools import partial
from importlib.resources import as_file, files
from itertools import chain, count
from pathlib import Path

from ..errors import RunError, printable, warn
from ..fusion import results
from ..fusion.config import FusionConfig
from ..fusion.estimates import Estimates, Mode
from ..fusion.offline import Engine, fuse
from ..fusion.summary import Summary, beaten_notes
from ..logs.manifest import stamps_of
from ..logs.run import Run
from ..pieces.fusing import fuse_to
from ..pieces.reading import needs_whole, rows_of
from ..units import KINDS
from .many import progress_bar, report_failures, run_jobs
from .screen import say
from .tables import left_out_words, orientation_table, outcome_table, print_tables, runs_table, score_table, skill_table

SHORT = 5_000_000  # rows of a run, each half a kB in memory; a longer one goes through piece by piece
MOST_IN_MEMORY = 30_000_000  # rows of one that cannot


def run(
    runs: Sequence[Path],
    config: Path,
    output: Path,
    sensors: Sequence[str] | None = None,
    rate: float | None = None,
    mode: Mode = "filtered",
    extras: Sequence[str] = (),
    engine: Engine = "compiled",
    force: bool = False,
    part: tuple[float | None, float | None] = (None, None),
    resume: bool = False,
) -> None:
    """Fuse each run into a result folder; a run that fails is reported and does not stop the others.

    With ``resume`` results that are there and were made in the same way are kept.
    """
    configured = FusionConfig.load(config)
    configured.sensor_names(sensors)  # before any run is read
    warn(configured.arm.doubts())
    for line in configured.arm.bends():
        say(line)
    recipe = results.Recipe(configured, sensors, rate, mode, engine, part, extras)
    job = partial(_fuse, recipe, force)
    if len(runs) == 1:
        summary = recipe.read_summary(output, runs[0]) if resume else None
        where = "written to" if summary is None else "there already:"
        if summary is None:
            with progress_bar(str(runs[0])) as progress:
                summary = job(runs[0], output, progress)
        show(summary)
        say(f"{where} {output}")
        return
    folders = dict(zip(map(str, runs), folders_of(runs, output), strict=True))
    done_before = {
        path: summary
        for path, folder in folders.items()
        if resume and (summary := recipe.read_summary(folder, Path(path)))
    }
    jobs = {path: partial(job, Path(path), folder) for path, folder in folders.items() if path not in done_before}
    done, failed = run_jobs("fusing", jobs, folders.values())
    if done_before or done:
        by_path = done_before | done
        summaries = {folder.name: by_path[path] for path, folder in folders.items() if path in by_path}
        print_tables(runs_table(summaries, kind) for kind in KINDS)
        say(
            f"written to {output}"
            + (f"; {len(done_before)} of {len(by_path)} were there already" if done_before else "")
        )
    report_failures(failed, len(folders), output)


def demo(output: Path, force: bool) -> None:
    """Fuse the shipped scan, score it, draw it, and say what to open next."""
    say(
        "A 60 s scan of a panel by a PUMA 560 (simulated with masses, friction, elastic joints and servos of which the"
        " filter knows\nnothing): a command every 28 ms, a camera (0.5 mm noise, 45 ms late, dropouts and outliers),"
        " and a reference to score\nagainst that the filter never sees.\n"
    )
    with as_file(files("pumafuse") / "data") as data:
        scan, config = data / "scan1", data / "fusion.toml"
        # without the laser tracker it shows best what a camera and a model do together
        run([scan], config, output, sensors=["vision"], rate=200.0, extras=["fused.rrd", "fused.png"], force=force)
    say(
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
    how: results.Recipe, force: bool, path: Path, folder: Path, progress: Callable[[float], None] | None = None
) -> Summary:
    """Fuse a run into its result folder: piece by piece a long one, where nothing, such as an option, forbids that."""
    results.check_writable(folder, force)
    stamps, rows, config = stamps_of(path), rows_of(path), how.config
    if rows > SHORT:
        options = {"--smooth": how.mode == "smoothed", "--as-live": how.mode == "as-live"}
        options |= {"--engine filterpy": how.engine != "compiled"}
        options |= {"--rrd": "fused.rrd" in how.extras, "--figures": "fused.png" in how.extras}
        needed = next((option for option, wanted in options.items() if wanted), None) or needs_whole(path, config)
        if needed is None:
            return fuse_to(path, folder, how, force, progress)
        if rows > MOST_IN_MEMORY:
            raise RunError(
                f"{path}: {needed} needs the whole run in memory, and {rows / 1e6:.0f} million rows are too many: do"
                " without, or cut the log into shorter runs"
            )
    recorded = Run.read(path).between(*how.part)
    est = fuse(
        recorded, config, sensors=how.sensors, rate=how.rate, mode=how.mode, engine=how.engine, progress=progress
    )
    results.check_fused(est.counts, est.config)

    def more(new: Path) -> None:
        results.write_stamps(new, stamps)
        draw(new, est, recorded, how.extras)

    return results.write(est, folder, force, more)


def draw(folder: Path, est: Estimates, recorded: Run, extras: Collection[str]) -> None:
    """Write ``fused.rrd``, and with ``fused.png`` the other figures, if they are among the ``extras``."""
    if "fused.rrd" in extras:
        from ..views.rerun import recording_of

        (folder / "fused.rrd").write_bytes(recording_of(est, recorded))
    if "fused.png" in extras:
        from ..views.figures import error_figure, fused_figure, path_figure, validation_figure

        drawn = {
            "fused": fused_figure(est),
            "validation": validation_figure(est),
            "path": path_figure(est, recorded),
            "error": None if est.reference is None else error_figure(est),
        }
        for name, figure in drawn.items():
            if figure is not None:
                figure.savefig(folder / f"{name}.png", dpi=130)


def show(summary: Summary) -> None:
    """Print the tables of one fusion."""
    part = "" if summary.from_s is None else f" from {summary.from_s:g} s on"
    made = f"{summary.estimates} estimates over {summary.duration_s:.1f} s{part}, {summary.mode}"
    say(f"{printable(summary.run)}: {made}, arm {printable(summary.arm)}")
    if without := left_out_words(summary):
        say(f"left out: {without}")
    scores = {axis: part.score for axis, part in summary.axes.items() if part.score is not None}
    print_tables(outcome_table(summary, kind) for kind in KINDS)
    print_tables(skill_table([("", summary)], kind) for kind in KINDS)
    print_tables(score_table([(summary.run, summary, scores)], kind) for kind in KINDS)
    print_tables([orientation_table([(summary.run, summary.orientation)])])
    for line in beaten_notes(summary.axes):
        say(line)


def folders_of(runs: Sequence[Path], output: Path) -> list[Path]:
    """A folder for each run, named after its path; equal names get a number."""
    names_of_runs = dict[str, None]()
    for path in map(Path.resolve, runs):
        named = path.parent if path.name == "run.toml" else path
        name = named.name if named.is_dir() else re.sub(r"(\.(csv|jsonl|ndjson|parquet))?(\.gz)?$", "", named.name)
        names = (f"{name or 'run'}{number}" for number in chain([""], map("_{}".format, count(2))))
        names_of_runs[next(name for name in names if name not in names_of_runs)] = None
    return [output / name for name in names_of_runs]
