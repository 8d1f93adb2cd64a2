"""`pumafuse plan`."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import ConfigError, PumafuseWarning
from ..identification import plan as plans
from ..identification.plan import Design
from ..logs import tables
from ..model.arm import CANONICAL_AXES, ArmModel
from .tables import console

_PERIOD = 0.028  # s, the paper's


@dataclass(frozen=True)
class Wanted:
    """What the command line asks for, in s, m and m/s; axes and period as None are the arm's."""

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
        axes = CANONICAL_AXES if arm is None else tuple(arm.axes)
        return Design(
            axes=axes if self.axes is None else tuple(self.axes),
            speeds=self.speeds,
            period=self.period or (_PERIOD if arm is None else arm.update_period),
            positions=({},) if self.positions is None else _positions(self.positions),
            replicates=self.replicates,
            hold=self.hold,
            rest=self.rest,
            amplitudes=self.amplitudes,
            noise_duration=self.noise_duration,
            seed=self.seed,
        )


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
    cells = {name: table.texts(name) for name in table.columns}
    return tuple(dict(zip(cells, row, strict=True)) for row in zip(*cells.values(), strict=True))
