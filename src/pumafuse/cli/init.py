"""`pumafuse init`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import typer

from ..arrays import NO_STAMP, TimeArray
from ..discovery.contents import Part, rate_of
from ..discovery.drafts import FILES, drafts
from ..discovery.names import printable
from ..discovery.survey import Survey, survey
from ..errors import ConfigError
from ..folders import write_file
from ..units import MS, SCREEN
from .tables import print_tables, table


def run(log: Path, output: Path | None, force: bool) -> None:
    """Look at a log, print what it holds, and write three files to begin with.

    Args:
        log: The log.
        output: Where they go; None: a new folder named after the log.
        force: Replace them.

    Raises:
        PumafuseError: The log cannot be read, has no commands or no sensor, or the files are in the way.
    """
    found = survey(log)
    folder = Path(f"{found.name}-fusion") if output is None else output
    there = [name for name in FILES if (folder / name).exists()]
    if there and not force:
        raise ConfigError(f"{folder}: has {there[0]} already; --force replaces it, or choose another folder")
    texts = drafts(found, folder)
    print_tables(_tables(found))
    for name, text in texts.items():
        write_file(folder / name, text)
    typer.echo(f"written to {folder}: {', '.join(FILES)}")


def _tables(found: Survey):
    """What is in the log; who is who; what follows what."""
    yield table(
        ["file or topic", "type", "rows", "rate, Hz", "gaps", "clock", "positions", "not used"],
        [_part_row(part) for part in found.parts],
    )
    roles = found.roles
    if roles is not None:
        streams = [("command", roles.command), *((f"sensor {one.name}", one) for one in roles.sensors)]
        streams += [] if roles.reference is None else [("reference", roles.reference)]
        rows = [[what, one.part.label, one.why, "", ""] for what, one in streams]
        rows = [
            [what, axis, " + ".join(signal.column for signal in signals), signals[0].unit, _SURE[signals[0].basis], _range(signals), one.why]
            for what, one in streams
            for axis, signals in one.axes.items()
        ]
        rows += [["not used", ", ".join(one.axes), one.part.label, "", "", "", why] for one, why in roles.left_out]
        yield table(["what", "axis", "column", "unit", "unit by", "range", "why"], [[printable(cell, 200) for cell in row] for row in rows])
    rows = []
    for (name, axis), one in found.relations.items():
        screen = SCREEN[found.run.kinds.get(axis, "length")]
        rows.append([
            name, axis, f"{one.lag * MS:.0f}", f"{one.correlation:+.3f}", f"{one.slope:.3f}", f"{one.offset * screen.scale:.3g} {screen.unit}",
            f"{one.scatter * screen.scale:.2g} {screen.unit}", f"{one.misfit * screen.scale:.2g} {screen.unit}", f"{one.outliers:.1%}",
        ])
    yield table(["follows the\ncommands", "axis", "lag, ms", "correlation", "gain", "offset", "noise", "left over", "outliers"], rows)


_SURE = {"name": "name", "type": "type of message", "range": "range: a guess"}


def _range(signals):
    low, high = np.nanmin(signals[0].plain), np.nanmax(signals[0].plain)
    return f"{low:.4g} … {high:.4g}"


def _part_row(part: Part) -> list[str]:
    interval, gaps = ("", "") if part.clock is None else rate_of(part.clock.stamp)
    clock = "none found" if part.clock is None else f"{part.clock.column} ({part.clock.basis})"
    unused = "; ".join([*part.notes, *(f"{name}: {why}" for name, why in part.left_out.items())])
    cells = [part.label, part.type, str(part.rows), f"{1 / interval:.3g}" if interval else "", gaps, clock, str(len(part.signals)), unused]
    return [printable(cell, 200) for cell in cells]
