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
from ..errors import ConfigError, RunError, counted, printable
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
    there = [name for name in FILES if (folder / name).exists()]
    if there and not force:
        raise ConfigError(f"{folder}: has {there[0]} already; --force replaces it, or choose another folder")
    try:
        found = survey(log, rate)
    except UndecidedError as error:
        write_file(folder / MANIFEST, sketch(name_of(log), error, folder), replace=force)
        then = f"`pumafuse fuse {shlex.quote(str(folder))} -o DIR`"
        raise RunError(f"{error}; what there is was written to {folder / MANIFEST}: sort it, then {then}") from None
    arm, sensors = guess(found)
    texts = drafts(found, arm, sensors, folder)
    show(found, sensors)
    if found.own_frames:
        recorded = described(drafts(found, arm, sensors, Path())["run.toml"], Path())
        try:
            config = registered(found, recorded)
        except RunError as error:  # what it was read by is there to be mended
            write_file(folder / MANIFEST, texts[MANIFEST], replace=force)
            again = f"what was read is in {folder / MANIFEST}: mend it, then `pumafuse init {folder} --force`"
            raise RunError(f"{error}; {again}") from None
        if config is not None:
            texts |= {"fusion.toml": config.to_toml(), "arm.toml": config.arm.to_toml()}
    for name, text in texts.items():
        write_file(folder / name, text, replace=force)
    place = shlex.quote(str(folder))
    say(f"written to {folder}: {', '.join(FILES)}; what to decide is in their comments, too\nnext:")
    tuned, fused = f"{place}/tuned", f"{place}/fused"
    if not found.own_frames:
        say(f"  pumafuse latency {place}")
    say(f"  pumafuse tune {place} -c {place}/fusion.toml -o {tuned} --fit noise,delay,plant")
    say(f"  pumafuse fuse {place} -c {tuned}/fusion.toml -o {fused} --rrd --figures")


def registered(found: Survey, recorded: Run) -> FusionConfig | None:
    """The configuration with the sensors registered that stand in frames of their own, which is printed."""
    from ..registration.runs import register  # scipy takes its time, and most logs need none of it
    from . import register as shown

    try:
        done = register(recorded, along_base=list(found.run.sensors))
    except RunError as error:
        if not found.run.sensors:
            raise
        say(f"not registered: {error}")
        return None
    shown.show(done.details)
    return done.config


def show(found: Survey, sensors: Mapping[str, SensorGuess]) -> None:
    """Print what was found, and what the user has to decide."""
    print_tables(_tables(found))
    for number, question in enumerate(questions(found, sensors), 1):
        say(f"{number}. {question}" if number > 1 else f"To decide:\n1. {question}")


def _tables(found: Survey) -> Iterator[Table]:
    """What the log holds, who is who, and what follows what."""
    parts = [_part_row(part) for part in found.parts] or _described_rows(found)
    yield table(["file or topic", "type", "rows", "rate, Hz", "gaps", "clock", "not used"], parts)
    if found.roles is not None:
        roles = found.roles
        named = [("command", roles.command), *((f"sensor {one.name}", one) for one in roles.sensors)]
        named += [] if roles.reference is None else [("reference", roles.reference)]
        rows = [row for what, stream in named for row in _axis_rows(what, stream)]
        rows += [["not used", ", ".join(one.axes), one.part.label, "", "", why] for one, why in roles.left_out]
        headings = ["what", "axis", "column", "unit", "range", "because"]
        yield table(headings, [[printable(cell, 200) for cell in row] for row in rows])
    yield _relations_table(found)
    yield table(["decided", "", "how surely"], [[printable(cell, 200) for cell in row] for row in decisions(found)])


def _part_row(part: Part) -> list[str]:
    interval, gaps = ("", "") if part.clock is None else _rate(part.clock.stamp)
    clock = "none found" if part.clock is None else f"{part.clock.time.column or 'rows'} ({part.clock.basis})"
    named = [f"{name}: {why}" for name, why in part.left_out.items()]
    more = [f"{len(named) - _FEW} more"] if len(named) > _FEW else []
    unused = "; ".join([*part.notes, *named[:_FEW], *more])
    kind = part.type.rpartition("/")[2]
    return [printable(cell, 200) for cell in (part.label, kind, str(part.rows), interval, gaps, clock, unused)]


def _described_rows(found: Survey) -> list[list[str]]:
    """Of a log whose run.toml says what is where."""
    sources = {"command": found.run.command, **found.run.measured}
    return [
        [printable(source.label_for(name)), "", str(len(source.stamp)), *_rate(source.stamp), "run.toml", ""]
        for name, source in sources.items()
    ]


def _rate(stamp: np.ndarray) -> tuple[str, str]:
    interval, gaps = rate_of(stamp)
    longest = f", longest {gaps.max():.3g} s" if len(gaps) else ""
    return f"{1.0 / interval:.4g}", f"{counted(len(gaps), 'gap')}{longest}" if len(gaps) else ""


def _axis_rows(what: str, stream: Stream) -> Iterator[list[str]]:
    because = stream.why
    if stream.attitude:
        angle = f"up to {stream.attitude.farthest * DEG:.3g}° from its mean"
        yield [what, "orientation", " ".join(stream.attitude.columns.columns), stream.attitude.basis, angle, because]
        what = because = ""
    for axis, signals in stream.axes.items():
        low, high = (f(signals[0].plain[np.isfinite(signals[0].plain)]) for f in (np.min, np.max))
        columns = " + ".join(_where(one) for one in signals)
        unit = f"{signals[0].unit}, {BASES[signals[0].basis]}"
        yield [what, axis, columns, unit, f"{low:.4g} … {high:.4g}", because]
        what = because = ""


def _where(one: Signal) -> str:
    """A column, and in which of the rows it is the axis."""
    return ", ".join([one.column, *(f"{name} = {key}" for name, key in one.where.items())])


def _relations_table(found: Survey) -> Table:
    rows: list[list[str]] = []
    for (name, axis), one in found.relations.items():
        screen = SCREEN[found.run.kinds.get(axis, "length")]
        sizes = [f"{size * screen.scale:.2g} {screen.unit}" for size in (one.offset, one.scatter, one.misfit)]
        numbers = [f"{one.lag * MS:.0f}", f"{one.correlation:+.3f}", f"{one.slope:.3f}"]
        rows.append([name, axis, *numbers, *sizes, f"{one.outliers:.1%}"])
    headings = ["follows the\ncommands", "axis", "lag, ms", "correlation", "gain", "offset", "noise", "left over"]
    return table([*headings, "outliers"], rows)
