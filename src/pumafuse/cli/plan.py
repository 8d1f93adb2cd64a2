"""`pumafuse plan`."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from ..errors import ConfigError, PumafuseWarning
from ..identification import plan as plans
from ..identification.plan import Design
from ..logs import tables
from ..model.arm import CANONICAL_AXES, ArmModel

_PERIOD = 0.028  # s, the paper's


def run(
    output: Path,
    axes: Sequence[str] | None,
    period: float | None,
    positions: Path | None,
    arm: str | None,
    max_speed: float | None,
    force: bool,
    **design: Any,
) -> None:
    """Lay out a campaign and write it.

    Args:
        output: Where it goes.
        axes: To step; None: those of the arm.
        period: Update period [s]; None: that of the arm.
        positions: Table of the positions to step at; None: where the arm is.
        arm: What is known of the arm, to check the plan.
        max_speed: Its limit [m/s]; None: the arm's validity.
        force: Replace an earlier campaign.
        design: The other attributes of :class:`Design`.

    Raises:
        PumafuseError: The campaign cannot be carried out, or the folder is in the way.
    """
    plans.check_writable(output, force)
    model = None if arm is None else ArmModel.load(arm)
    planned = plans.plan(
        Design(
            axes=tuple(axes or (CANONICAL_AXES if model is None else model.axes)),
            period=period or (_PERIOD if model is None else model.update_period),
            positions=({},) if positions is None else _positions(positions),
            **design,
        ),
        model,
        max_speed,
    )
    for warning in planned.warnings:
        warnings.warn(warning, PumafuseWarning, stacklevel=1)
    plans.write(planned, output, force)
    typer.echo(
        f"{len(planned.trials)} step trials and {len(planned.noise)} white-noise sequences,"
        f" {planned.duration / 60.0:.1f} minutes without the moves between positions, written to {output}"
        f"\nnext: record samples.csv beside trials.csv, then pumafuse identify {output} -o arm.toml"
    )


def _positions(path: Path) -> tuple[Mapping[str, str], ...]:
    """A table's rows, a position each."""
    table = tables.read(path)
    if not table.rows:
        raise ConfigError(f"{path}: lists no position")
    rows = zip(*(table.texts(name) for name in table.columns), strict=True)
    return tuple(dict(zip(table.columns, row, strict=True)) for row in rows)
