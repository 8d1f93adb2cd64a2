"""`pumafuse plan`."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import ConfigError, PumafuseWarning
from ..identification import plan as plans
from ..identification.plan import Design
from ..logs import tables
from ..model.arm import CANONICAL_AXES, ArmModel
from .tables import console

_PERIOD = 0.028  # s, the paper's


@dataclass(frozen=True)
class Wanted:
    """Options of the command line, in s, m and m/s; axes and period as None are the arm's."""

    axes: Sequence[str] | None
    speeds: tuple[float, ...]
    positions: Path | None
    replicates: int
    period: float | None
    hold: float
    rest: float
    amplitudes: tuple[float, ...]
    noise_duration: float
    seed: int

    def design(self, arm: ArmModel | None) -> Design:
        """The campaign, for an arm that may be known."""
        axes = self.axes or (CANONICAL_AXES if arm is None else tuple(arm.axes))
        period = self.period or (_PERIOD if arm is None else arm.update_period)
        positions: tuple[Mapping[str, str], ...] = ({},) if self.positions is None else _positions(self.positions)
        options: dict[str, Any] = {**vars(self), "axes": tuple(axes), "period": period, "positions": positions}
        return Design(**options)


def run(output: Path, wanted: Wanted, arm: str | None, max_speed: float | None, force: bool) -> None:
    """Lay out a campaign and write it.

    Raises:
        PumafuseError: The campaign cannot be carried out, or the folder is in the way.
    """
    plans.check_writable(output, force)
    model = None if arm is None else ArmModel.load(arm)
    planned = plans.plan(wanted.design(model), model, max_speed)
    for warning in planned.warnings:
        warnings.warn(warning, PumafuseWarning, stacklevel=1)
    plans.write(planned, output, force)
    counted = f"{len(planned.trials)} step trials and {len(planned.noise)} white-noise sequences"
    console(soft_wrap=True).print(
        f"{counted}, {planned.duration / 60.0:.1f} minutes without the moves between positions, written to {output}"
        f"\nnext: record samples.csv beside trials.csv, then pumafuse identify {output} -o arm.toml",
        markup=False,
    )


def _positions(path: Path) -> tuple[Mapping[str, str], ...]:
    """A table's rows, a position each."""
    table = tables.read(path)
    if not table.rows:
        raise ConfigError(f"{path}: lists no position")
    rows = zip(*(table.texts(name) for name in table.columns), strict=True)
    return tuple(dict(zip(table.columns, row, strict=True)) for row in rows)
