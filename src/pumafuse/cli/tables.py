"""The tables that commands print."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..fusion.score import Z95
from ..fusion.summary import ScoreSummary, Summary


def console(*, soft_wrap: bool = False) -> Console:
    """Standard output for people; wide enough for our tables where it is no terminal."""
    width = None if sys.stdout.isatty() else 120
    return Console(highlight=False, soft_wrap=soft_wrap, width=width)


def outcome_table(summary: Summary) -> Table:
    """Scalars by outcome, and innovations against what the filter expected, for each axis and sensor."""
    table = Table(box=box.SIMPLE_HEAD)
    biased = any(sensor.bias_mm is not None for axis in summary.axes.values() for sensor in axis.sensors.values())
    words = sorted(
        {word for axis in summary.axes.values() for sensor in axis.sensors.values() for word in sensor.outcomes}
    )
    words.sort(key=lambda word: word != "fused")
    for heading in ("axis", "sensor"):
        table.add_column(heading)
    for heading in (*words, "innovation, mm", "expected, mm", *(["bias, mm"] if biased else [])):
        table.add_column(heading, justify="right")
    table.add_column("verdict", overflow="fold")
    for axis, part in summary.axes.items():
        for name, sensor in part.sensors.items():
            counts = [str(sensor.outcomes.get(word, 0)) for word in words]
            spread = [_mm(sensor.innovation_rms_mm), _mm(sensor.innovation_sd_mm)]
            bias = [_interval(sensor.bias_mm, sensor.bias_sd_mm)] if biased else []
            table.add_row(escape(axis), escape(name), *counts, *spread, *bias, sensor.verdict)
    return table


def score_table(results: Sequence[tuple[str, Mapping[str, ScoreSummary]]]) -> Table:
    """Scores against the reference, for each result and axis."""
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("result", overflow="fold")
    table.add_column("axis")
    for heading in ("RMSE, mm", "bias, mm", "95 % cover", "NEES", "scored", "left out"):
        table.add_column(heading, justify="right")
    for name, scores in results:
        for axis, score in scores.items():
            table.add_row(
                escape(name),
                escape(axis),
                _mm(score.rmse_mm),
                f"{score.bias_mm:+.3f}",
                f"{score.coverage:.1%}",
                "–" if score.nees_mean is None else f"{score.nees_mean:.2f}",
                str(score.rows),
                str(score.left_out),
            )
    return table


def _interval(value: float | None, sd: float | None) -> str:
    """A value with its 95 % interval."""
    return "–" if value is None or sd is None else f"{value:.3f} ± {Z95 * sd:.3f}"


def _mm(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
