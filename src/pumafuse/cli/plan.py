"""`pumafuse plan`."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

from ..errors import ConfigError, PumafuseWarning
from ..identify import plan as plans
from ..identify.plan import Design
from ..model.arm import ArmModel
from ..runs import tables
from .tables import console


def run(
    output: Path, design: Design, positions: Path | None, arm: str | None, max_speed: float | None, force: bool
) -> None:
    """Lay out a campaign and write it.

    Raises:
        PumafuseError: The design cannot be carried out, or the folder is in the way.
    """
    plans.check_writable(output, force)
    model = None if arm is None else ArmModel.load(arm)
    planned = plans.plan(design if positions is None else _at(design, positions), model, max_speed)
    for warning in planned.warnings:
        warnings.warn(warning, PumafuseWarning, stacklevel=1)
    plans.write(planned, output, force)
    counted = f"{len(planned.trials)} step trials and {len(planned.noise)} white-noise sequences"
    console(soft_wrap=True).print(
        f"{counted}, {planned.duration / 60.0:.1f} minutes without the moves between positions, written to {output}"
        f"\nnext: record samples.csv beside trials.csv, then"
        f" pumafuse identify {output} -o arm.toml",
        markup=False,
    )


def _at(design: Design, path: Path) -> Design:
    """The design at the positions that a table lists, a row each."""
    table = tables.read(path)
    if not table.rows:
        raise ConfigError(f"{path}: lists no position")
    cells = {name: table.texts(name) for name in table.columns}
    rows = tuple(dict(zip(cells, row, strict=True)) for row in zip(*cells.values(), strict=True))
    return replace(design, positions=rows)
