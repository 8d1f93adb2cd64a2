"""`pumafuse init`."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from rich.table import Table

from ..discovery.contents import Part, Signal, rate_of
from ..discovery.drafts import BASES, FILES, MANIFEST, drafts, sketch
from ..discovery.guesses import SensorGuess, guess
from ..discovery.questions import decisions, questions
from ..discovery.roles import Stream, UndecidedError
from ..discovery.survey import Survey, name_of, survey
from ..errors import ConfigError, RunError, plural, printable
from ..folders import write_file
from ..fusion.config import FusionConfig
from ..logs.run import Run, described
from ..units import DEG, MS, SCREEN
from .screen import say
from .tables import print_tables, table

_FEW = 4  # columns that are named


def run(log: Path, output: Path | None, rate: float, force: bool) -> None:
    """Look at a log, print what it holds, and write three files to begin with."""
    folder = Path(f"{name_of(log)}-fusion") if output is None else output
    existing = [name for name in FILES if (folder / name).exists()]
    if existing and not force:
        raise ConfigError(f"{folder}: has {existing[0]} already; --force replaces it, or choose another folder")
    try:
        surveyed = survey(log, rate)
    except UndecidedError as error:
        write_file(folder / MANIFEST, sketch(name_of(log), error, folder), replace=force)
        then = f"`pumafuse fuse {shlex.quote(str(folder))} -o DIR`"
        raise RunError(f"{error}; what there is was written to {folder / MANIFEST}: sort it, then {then}") from None
    arm, sensors = guess(surveyed)
    texts = drafts(surveyed, arm, sensors, folder)
    show(surveyed, sensors)
    if surveyed.own_frames:
        recorded = described(drafts(surveyed, arm, sensors, Path())["run.toml"], Path())
        try:
            config = register_sensors(surveyed, recorded)
        except RunError as error:  # what it was read by is there to be mended
            write_file(folder / MANIFEST, texts[MANIFEST], replace=force)
            again = f"what was read is in {folder / MANIFEST}: mend it, then `pumafuse init {folder} --force`"
            raise RunError(f"{error}; {again}") from None
        if config is not None:
            texts |= {"fusion.toml": config.to_toml(), "arm.toml": config.arm.to_toml()}
    for name, text in texts.items():
        write_file(folder / name, text, replace=force)
    quoted = shlex.quote(str(folder))
    say(f"written to {folder}: {', '.join(FILES)}; what to decide is in their comments, too\nnext:")
    tuned, fused = f"{quoted}/tuned", f"{quoted}/fused"
    if not surveyed.own_frames:
        say(f"  pumafuse latency {quoted}")
    say(f"  pumafuse tune {quoted} -c {quoted}/fusion.toml -o {tuned} --fit noise,delay,plant")
    say(f"  pumafuse fuse {quoted} -c {tuned}/fusion.toml -o {fused} --rrd --figures")


def register_sensors(survey: Survey, recorded: Run) -> FusionConfig | None:
    """The configuration with the sensors registered that stand in frames of their own, which is printed."""
    from ..registration.runs import register  # scipy takes its time, and most logs need none of it
    from . import register as shown

    try:
        done = register(recorded, along_base=list(survey.run.sensors))
    except RunError as error:
        if not survey.run.sensors:
            raise
        say(f"not registered: {error}")
        return None
    shown.show(done.details)
    return done.config


def show(survey: Survey, sensors: Mapping[str, SensorGuess]) -> None:
    """Print what was found, and what the user has to decide."""
    print_tables(_tables(survey))
    for number, question in enumerate(questions(survey, sensors), 1):
        say(f"{number}. {question}" if number > 1 else f"To decide:\n1. {question}")


def _tables(survey: Survey) -> Iterator[Table]:
    """What the log holds, who is who, and what follows what."""
    parts = [_part_row(part) for part in survey.parts] or _described_rows(survey)
    yield table(["file or topic", "type", "rows", "rate, Hz", "gaps", "clock", "not used"], parts)
    if survey.roles is not None:
        roles = survey.roles
        named = [("command", roles.command), *((f"sensor {sensor.name}", sensor) for sensor in roles.sensors)]
        named += [] if roles.reference is None else [("reference", roles.reference)]
        rows = [row for what, stream in named for row in _axis_rows(what, stream)]
        rows += [["not used", ", ".join(stream.axes), stream.part.label, "", "", why] for stream, why in roles.left_out]
        headings = ["what", "axis", "column", "unit", "range", "because"]
        yield table(headings, [[printable(cell, 200) for cell in row] for row in rows])
    yield _relations_table(survey)
    yield table(["decided", "", "how surely"], [[printable(cell, 200) for cell in row] for row in decisions(survey)])


def _part_row(part: Part) -> list[str]:
    interval, gaps = ("", "") if part.clock is None else _rate(part.clock.stamp)
    clock = "none found" if part.clock is None else f"{part.clock.time.column or 'rows'} ({part.clock.basis})"
    named = [f"{name}: {why}" for name, why in part.left_out.items()]
    more = [f"{len(named) - _FEW} more"] if len(named) > _FEW else []
    unused = "; ".join([*part.notes, *named[:_FEW], *more])
    kind = part.type.rpartition("/")[2]
    return [printable(cell, 200) for cell in (part.label, kind, str(part.rows), interval, gaps, clock, unused)]


def _described_rows(survey: Survey) -> list[list[str]]:
    """Rows of a log whose run.toml says what is where."""
    sources = {"command": survey.run.command, **survey.run.measured}
    return [
        [printable(source.label_for(name)), "", str(len(source.stamp)), *_rate(source.stamp), "run.toml", ""]
        for name, source in sources.items()
    ]


def _rate(stamp: np.ndarray) -> tuple[str, str]:
    interval, gaps = rate_of(stamp)
    longest = f", longest {gaps.max():.3g} s" if len(gaps) else ""
    return f"{1.0 / interval:.4g}", f"{plural(len(gaps), 'gap')}{longest}" if len(gaps) else ""


def _axis_rows(what: str, stream: Stream) -> Iterator[list[str]]:
    because = stream.why
    if stream.attitude:
        angle = f"up to {stream.attitude.farthest * DEG:.3g}° from its mean"
        yield [what, "orientation", " ".join(stream.attitude.columns.columns), stream.attitude.basis, angle, because]
        what = because = ""
    for axis, signals in stream.axes.items():
        low, high = (f(signals[0].plain[np.isfinite(signals[0].plain)]) for f in (np.min, np.max))
        columns = " + ".join(_where(signal) for signal in signals)
        unit = f"{signals[0].unit}, {BASES[signals[0].basis]}"
        yield [what, axis, columns, unit, f"{low:.4g} … {high:.4g}", because]
        what = because = ""


def _where(signal: Signal) -> str:
    """A column, and in which of the rows it is the axis."""
    return ", ".join([signal.column, *(f"{name} = {key}" for name, key in signal.where.items())])


def _relations_table(survey: Survey) -> Table:
    rows: list[list[str]] = []
    for (name, axis), relation in survey.relations.items():
        screen = SCREEN[survey.run.kinds.get(axis, "length")]
        sizes = [
            f"{size * screen.scale:.2g} {screen.unit}" for size in (relation.offset, relation.scatter, relation.misfit)
        ]
        numbers = [f"{relation.lag * MS:.0f}", f"{relation.correlation:+.3f}", f"{relation.slope:.3f}"]
        rows.append([name, axis, *numbers, *sizes, f"{relation.outliers:.1%}"])
    headings = ["follows the\ncommands", "axis", "lag, ms", "correlation", "gain", "offset", "noise", "left over"]
    return table([*headings, "outliers"], rows)
