"""`pumafuse identify`."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table

from ..errors import PumafuseWarning
from ..folders import FolderError, write_file
from ..identify.anova import Dependence, Scatter
from ..identify.estimate import Estimate
from ..identify.identify import Identification, identify
from ..identify.trials import StepTrials
from ..model.plants import FirstOrder, Interval
from ..units import MM
from .tables import console


@dataclass(frozen=True)
class Options:
    """What the command line asks for."""

    output: Path
    period: float | None
    samples: int | None
    paper: bool
    tolerance: float
    report: Path | None
    json: bool
    force: bool


def run(folder: Path, options: Options) -> None:
    """Identify an arm from the step trials in ``folder``.

    Raises:
        PumafuseError: The trials cannot be used, or what is to be written is in the way.
    """
    if options.output.exists() and not options.force:
        raise FolderError(f"{options.output}: exists; --force replaces it")
    if options.report is not None:
        from ..views import report

        report.check_writable(options.report, options.force)
    trials = StepTrials.read(folder)
    found = identify(
        trials,
        period=options.period,
        samples=options.samples,
        paper=options.paper,
        tolerance=options.tolerance,
        name=folder.resolve().name,
    )
    for note in found.notes:
        warnings.warn(note, PumafuseWarning, stacklevel=1)
    write_file(options.output, found.arm.to_toml())
    if options.report is not None:
        from ..views import report

        report.write_identification(found, trials, options.report, options.force)
    if options.json:
        print(found.to_json())
    else:
        _show(found, options)


def _show(found: Identification, options: Options) -> None:
    out = console()
    out.print(_models(found))
    for axis, combined in found.axes.items():
        out.print(f"{axis}: {combined.choice.why}; {combined.gain_words}", markup=False)
        if combined.delay_spread > 2.0 * combined.delay_noise:
            noise = (
                f"; the noise within a trial explains {combined.delay_noise * MM:.2g} ms" if not options.paper else ""
            )
            moves = f"the delay moves by {combined.delay_spread * MM:.2g} ms (sd) from trial to trial{noise}"
            out.print(f"{axis}: {moves}", markup=False)
        for trial, why in combined.left_out.items():
            out.print(f"{axis}: trial '{trial}' left out: {why}", markup=False)
    out.print(found.one_delay, markup=False)
    if found.dependences:
        out.print(_dependences(found.dependences))
    out.print(_scatter(found.scatter))
    for one in found.performance:
        out.print(f"combined model by {one.factor}: {one.verdict}", markup=False)
    written = f"written to {options.output}" + (f" and {options.report}" if options.report is not None else "")
    out.print(f"{written}\nnext: pumafuse verify RUN --arm {options.output}", markup=False, soft_wrap=True)


def _models(found: Identification) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("axis")
    for heading in ("trials", "plant", "K at speed s [m/s]", "Td, ms", "onset, ms", "lag, ms", "RMS, mm"):
        table.add_column(heading, justify="right")
    for axis, one in found.axes.items():
        plant, gain = one.model.plant, one.model.gain
        shape = (
            f"τ {_with(plant.time_constant, plant.time_constant_ci95, MM)} ms"
            if isinstance(plant, FirstOrder)
            else f"ω {_with(plant.natural_frequency, plant.natural_frequency_ci95)} rad/s\n"
            f"ζ {_with(plant.damping, plant.damping_ci95)}"
        )
        line = f"{_with(gain.intercept, gain.intercept_ci95)}"
        if gain.slope:
            line += f"\n+ {_with(gain.slope, gain.slope_ci95)} s"
        rms = [
            t.combined_rms for t in found.trials if t.axis == axis and t.left_out is None and t.combined_rms is not None
        ]
        delays = one.delays
        table.add_row(
            escape(axis),
            str(one.trials),
            shape,
            line,
            _ms(delays.fitted),
            _ms(delays.onset),
            _ms(delays.lag),
            f"{MM * float(np.sqrt(np.mean(np.square(rms)))):.3f}",
        )
        if isinstance(plant, FirstOrder):
            averages = f"trials' mean {_ms(one.time_constant_mean)}, robust {_ms(one.time_constant_robust)} ms"
            table.add_row("", "", averages, "", "", "", "", "")
    return table


def _dependences(rows: list[Dependence]) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("coefficient")
    table.add_column("factor")
    table.add_column("level: mean ± sd (trials)", no_wrap=True)
    for heading in ("i-ratio", "Welch p", "adjusted p"):
        table.add_column(heading, justify="right")
    table.add_column("verdict", overflow="fold")
    for row in rows:
        levels = "\n".join(
            f"{level.level}: {level.mean:.4g}"
            + ("" if level.sd is None else f" ± {level.sd:.2g}")
            + f" ({level.trials})"
            for level in row.levels
        )
        table.add_row(
            row.coefficient,
            escape(row.factor),
            escape(levels),
            "–" if row.i_ratio is None else f"{row.i_ratio:.2f}",
            _p(row.welch_p),
            _p(row.adjusted_p),
            row.verdict,
        )
    return table


def _scatter(rows: list[Scatter]) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("coefficient")
    table.add_column("axis")
    for heading in ("median", "normal p", "sd of replicates", "sd by noise"):
        table.add_column(heading, justify="right")
    table.add_column("outlying trials", overflow="fold")
    for row in rows:
        replicates = "–" if row.replicate_sd is None else f"{row.replicate_sd:.2g}"
        named = escape(", ".join(row.outlying)) or "none"
        table.add_row(
            row.coefficient,
            escape(row.axis),
            f"{row.median:.4g}",
            _p(row.normal_p),
            replicates,
            f"{row.own_sd:.2g}",
            named,
        )
    return table


def _p(value: float | None) -> str:
    return "–" if value is None else "< 0.001" if value < 1e-3 else f"{value:.3f}"


def _ms(estimate: Estimate) -> str:
    return _with(estimate.value, estimate.ci95, MM)


def _with(value: float, interval: Interval | None, unit: float = 1.0) -> str:
    """A number with half its interval, in as many digits as the interval is worth."""
    if interval is None or not np.isfinite(interval).all():
        return f"{value * unit:.4g}"
    half = 0.5 * (interval[1] - interval[0]) * unit
    digits = max(1 - int(np.floor(np.log10(half))), 0) if half > 0.0 else 3
    return f"{value * unit:.{min(digits, 6)}f} ± {half:.{min(digits, 6)}f}"
