"""The tables that commands print."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..fusion.score import Z95
from ..fusion.summary import ScoreSummary, Summary

if TYPE_CHECKING:
    from ..views.report import TextTable

_FEW_RUNS = 20  # that get lines of their own


def console(*, soft_wrap: bool = False) -> Console:
    """Standard output for people; 120 columns wide where it is no terminal."""
    width = None if sys.stdout.isatty() else 120
    return Console(highlight=False, soft_wrap=soft_wrap, width=width)


def text_table(text: TextTable) -> Table:
    """A table of text as it is: numbers are right-justified, cells that have lines are not wrapped."""
    table = Table(box=box.SIMPLE_HEAD)
    for place, (heading, is_text) in enumerate(text.columns):
        lines = any("\n" in row[place] for row in text.rows)
        table.add_column(heading, justify="left" if is_text else "right", overflow="fold", no_wrap=lines)
    for row in text.rows:
        table.add_row(*map(escape, row))
    return table


def outcome_table(summary: Summary) -> Table:
    """Components by outcome, innovations and their expected size, for each axis and sensor."""
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
    """Scores against the reference, for each result and axis; columns of the velocity where a result has one."""
    moving = any(score.velocity_rmse_mm_s is not None for _, scores in results for score in scores.values())
    table = Table(box=box.SIMPLE_HEAD, collapse_padding=True)
    table.add_column("result", overflow="fold")
    table.add_column("axis")
    velocity = ("velocity RMSE, mm/s", "95 % coverage") if moving else ()
    for heading in ("RMSE, mm", "bias, mm", "95 % coverage", "NEES", "scored", "left out", *velocity):
        table.add_column(heading, justify="right", max_width=8)  # the result's name needs the width
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
                *([_mm(score.velocity_rmse_mm_s), _percent(score.velocity_coverage)] if moving else []),
            )
    return table


def runs_table(results: Mapping[str, Summary]) -> Table:
    """Many results: lines for each of up to 20 by name, and for each axis all of them together."""
    summaries = list(results.values())
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("result", overflow="fold")
    table.add_column("axis")
    for heading in ("RMSE, mm", "worst, mm", "95 % coverage", "NEES", "NIS", "fused", "rejected", "notes"):
        table.add_column(heading, justify="right")
    if len(summaries) <= _FEW_RUNS:
        for name, summary in results.items():
            for axis in summary.axes:
                table.add_row(escape(name), escape(axis), *_pooled([summary], axis))
        table.add_section()
    for axis in dict.fromkeys(axis for summary in summaries for axis in summary.axes):
        having = [summary for summary in summaries if axis in summary.axes]
        table.add_row(f"all {len(having)}", escape(axis), *_pooled(having, axis))
    return table


def _pooled(summaries: Sequence[Summary], axis: str) -> list[str]:
    """Cells of one axis over several runs; each estimate and each component counts once."""
    parts = [summary.axes[axis] for summary in summaries]
    scores = [part.score for part in parts if part.score is not None]
    sensors = [sensor for part in parts for sensor in part.sensors.values()]
    nis = [(sensor.nis_mean, sensor.outcomes.get("fused", 0)) for sensor in sensors if sensor.nis_mean is not None]
    fused, rejected = (sum(sensor.outcomes.get(word, 0) for sensor in sensors) for word in ("fused", "rejected"))
    rows = sum(score.rows for score in scores)
    cells = ["–"] * 4
    if rows:
        square = sum(score.rmse_mm**2 * score.rows for score in scores) / rows
        coverage = sum(score.coverage * score.rows for score in scores) / rows
        nees = [(score.nees_mean, score.rows) for score in scores if score.nees_mean is not None]
        cells = [_mm(square**0.5), _mm(max(score.rmse_mm for score in scores)), f"{coverage:.1%}", _mean(nees)]
    notes = sum(len(summary.notes) for summary in summaries)
    return [*cells, _mean(nis), str(fused), str(rejected), str(notes)]


def _mean(weighted: Sequence[tuple[float, int]]) -> str:
    total = sum(weight for _, weight in weighted)
    return f"{sum(value * weight for value, weight in weighted) / total:.2f}" if total else "–"


def _interval(value: float | None, sd: float | None) -> str:
    """A value with its 95 % interval."""
    return "–" if value is None or sd is None else f"{value:.3f} ± {Z95 * sd:.3f}"


def _mm(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{share:.1%}"
