"""`pumafuse verify`."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
from rich import box
from rich.markup import escape
from rich.table import Table

from .. import units
from ..errors import PumafuseWarning
from ..identification.verify import AxisVerification, verify
from ..logs.run import Run
from ..model.arm import ArmModel
from ..units import MM, MS
from ..views import formatting as words
from .tables import console


def run(
    paths: Sequence[Path],
    arm: str,
    sensors: list[str] | None,
    start: Mapping[str, float],
    report: Path | None,
    json: bool,
    force: bool,
) -> None:
    """Compare a model with runs that it was not made from.

    Raises:
        PumafuseError: The arm or a run cannot be read, or they do not fit together.
    """
    if report is not None:
        from ..views import report as reports

        reports.check_writable(report, force)
    model = ArmModel.load(arm)
    found = [one for path in paths for one in verify(Run.read(path), model, sensors=sensors, start=start)]
    if report is not None:
        from ..views import report as reports

        reports.write_verification(found, model, report, force)
    verified = [verification for verification, _ in found]
    for one in verified:
        for note in one.notes:
            warnings.warn(f"run '{one.run}': {note}", PumafuseWarning, stacklevel=1)
    if json:
        tree = [units.from_si(msgspec.to_builtins(one, enc_hook=float)) for one in verified]
        print(msgspec.json.format(msgspec.json.Encoder(decimal_format="number").encode(tree), indent=2).decode())
    else:
        _show(verified, report)


def _show(verified: Sequence[AxisVerification], report: Path | None) -> None:
    out = console()
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("run", "axis", "source"):
        table.add_column(heading, overflow="fold")
    for heading in ("signal, mm", "RMS, mm", "of signal", "fit", "no recovery", "recovery", "floor, mm"):
        table.add_column(heading, justify="right")
    for one in verified:
        table.add_row(
            escape(one.run),
            escape(one.axis),
            escape(one.source),
            *words.verification(one),
        )
    out.print(table)
    for one in verified:
        floor = one.floor
        left_out = f"; {one.outlying} outlying measurements left out" if one.outlying else ""
        refitted = f"K {floor.gain:.3f}, Td {floor.delay * MS:.1f} ms, {words.plant(floor.plant)}"
        out.print(
            f"{one.run}, {one.axis}: {one.verdict}; start level {one.start * MM:g} mm ({one.start_from}); gain recovery"
            f" tried with {one.recovery * MS:g} ms; the floor is {refitted}{left_out}",
            markup=False,
        )
    if report is not None:
        out.print(f"written to {report}", markup=False, soft_wrap=True)
