"""`pumafuse plan`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import ConfigError, warn
from ..identification import plan as plans
from ..identification.plan import Design
from ..logs import tables
from ..model.arm import CANONICAL_AXES, ArmModel
from ..units import SCREEN, SPEEDS, Kind, si
from .screen import say

_PERIOD = 0.028  # s, the paper's
# m/s and mm, the paper's; degrees/s and degrees, which are as far at 0.57 m from the joint
_SPEEDS: dict[Kind, tuple[float, ...]] = {"length": (0.071, 0.14, 0.28, 0.68), "angle": (7.1, 14.0, 28.0, 68.0)}
_AMPLITUDES: dict[Kind, tuple[float, ...]] = {"length": (4.0, 8.0, 14.0), "angle": (0.4, 0.8, 1.4)}


def run(
    output: Path,
    axes: Sequence[str] | None,
    period: float | None,
    positions: Path | None,
    arm: str | None,
    max_speed: float | None,
    speeds: Sequence[float] | None,
    amplitudes: Sequence[float] | None,
    force: bool,
    **design: Any,
) -> None:
    """Lay out a campaign and write it. Speeds are in m/s or degrees/s, amplitudes in mm or degrees.

    Args:
        output: Where it goes.
        axes: To step; None: those of the arm.
        period: Update period [s]; None: that of the arm.
        positions: Table of the positions to step at; None: where the arm is.
        arm: What is known of the arm, to check the plan.
        max_speed: Its limit; None: the arm's validity.
        speeds: Of the steps; None: the paper's.
        amplitudes: Of the white noise; None: the paper's.
        force: Replace an earlier campaign.
        design: The other attributes of :class:`Design`.

    Raises:
        PumafuseError: The campaign cannot be carried out, or the folder is in the way.
    """
    plans.check_writable(output, force)
    model = None if arm is None else ArmModel.load(arm)
    stepped = tuple(axes or (CANONICAL_AXES if model is None else model.axes))
    kind = "length" if model is None else plans.kind_of(stepped, model)
    size, speed = f"_{SCREEN[kind].unit}", SPEEDS[kind][0]
    planned = plans.plan(
        Design(
            axes=stepped,
            speeds=tuple(si(one, speed) for one in (_SPEEDS[kind] if speeds is None else speeds)),
            period=period or (_PERIOD if model is None else model.update_period),
            positions=({},) if positions is None else _positions(positions),
            amplitudes=tuple(si(one, size) for one in (_AMPLITUDES[kind] if amplitudes is None else amplitudes)),
            kind=kind,
            **design,
        ),
        model,
        None if max_speed is None else si(max_speed, speed),
    )
    warn(planned.warnings)
    plans.write(planned, output, force)
    say(
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
