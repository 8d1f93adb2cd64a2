"""The tables that commands print."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from typing import Any, TextIO

import msgspec
import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..fusion.score import Z95
from ..fusion.skill import PredictionError
from ..fusion.summary import ScoreSummary, Summary

Columns = Mapping[str, tuple[str, str, float]]  # by heading: an attribute, its format, and what it is multiplied by

_FEW_RUNS = 20  # that get lines of their own
_SCORE: Columns = {
    "RMSE, mm": ("rmse_mm", ".3f", 1.0),
    "bias, mm": ("bias_mm", "+.3f", 1.0),
    "95 %\ncoverage": ("coverage", ".1%", 1.0),
    "NEES": ("nees_mean", ".2f", 1.0),
    "scored": ("rows", ".0f", 1.0),
    "left\nout": ("left_out", ".0f", 1.0),
    "velocity\nRMSE, mm/s": ("velocity_rmse_mm_s", ".3f", 1.0),
    "velocity\n95 % cov.": ("velocity_coverage", ".1%", 1.0),
}


def console(file: TextIO) -> Console:
    """A stream for people: 120 columns wide where it is no terminal; nowhere if it is closed, which makes it None."""
    there = file or StringIO()
    return Console(file=there, highlight=False, width=None if there.isatty() else 120)


def print_json(tree: Any) -> None:
    """Print a tree of dictionaries, lists and structs on standard output."""
    encoded = msgspec.json.Encoder(decimal_format="number").encode(tree)
    typer.echo(msgspec.json.format(encoded, indent=2))


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """A table for the terminal, without columns in which no row has anything.

    Columns of numbers are right-justified. They and cells of several lines are not wrapped.
    """
    made = Table(box=box.SIMPLE_HEAD)
    kept: list[Sequence[str]] = []
    for heading, *cells in zip(headings, *rows, strict=True):
        if not set(cells) <= {"", "–"}:
            numbers = all(cell[:1] in "+-–…<0123456789" for cell in cells)
            whole = numbers or any("\n" in cell for cell in cells)
            made.add_column(heading, justify="right" if numbers else "left", overflow="fold", no_wrap=whole)
            kept.append([escape(cell) for cell in cells])
    for row in zip(*kept, strict=True):
        made.add_row(*row)
    return made


def number(value: float | None, form: str = ".3f") -> str:
    """A number as the format specification says; a dash for None."""
    return "–" if value is None else format(value, form)


def interval(value: float | None, sd: float | None) -> str:
    """A value with its 95 % interval; a dash for None."""
    return "–" if value is None or sd is None else f"{value:.3f} ± {Z95 * sd:.3f}"


def cells(row: object, columns: Columns) -> list[str]:
    """The attributes of ``row`` as text."""
    found = ((getattr(row, name), form, factor) for name, form, factor in columns.values())
    return ["–" if value is None else format(value * factor, form) for value, form, factor in found]


def outcome_table(summary: Summary) -> Table:
    """Components by outcome, innovations and their expected size, for each axis and sensor."""
    sensors = [(axis, name, one) for axis, part in summary.axes.items() for name, one in part.sensors.items()]
    words = sorted({word for *_, one in sensors for word in one.outcomes}, key=lambda word: (word != "fused", word))
    rows = [
        [
            axis,
            name,
            *(str(one.outcomes.get(word, 0)) for word in words),
            number(one.innovation_rms_mm),
            number(one.innovation_sd_mm),
            interval(one.bias_mm, one.bias_sd_mm),
            one.verdict,
        ]
        for axis, name, one in sensors
    ]
    return table(["axis", "sensor", *words, "innovation, mm", "expected, mm", "bias, mm", "verdict"], rows)


def skill_table(results: Iterable[tuple[str, Summary]]) -> Table:
    """Errors of predicting each sensor's next measurement, by this filter and by simpler means."""
    rows = [
        [name, axis, sensor, str(one.skill.predictions), *map(_prediction, msgspec.structs.astuple(one.skill)[1:])]
        for name, summary in results
        for axis, part in summary.axes.items()
        for sensor, one in part.sensors.items()
        if one.skill is not None
    ]
    by = ["last one\nheld", "constant\nvelocity", "command\nalone", "this\nfilter"]
    made = table(["result", "axis", "sensor", "predictions", *by], rows)
    made.title, made.title_justify, made.title_style = (
        "Error of predicting the next measurement, RMS / median in mm, by …",
        "left",
        "",
    )
    return made


def _prediction(error: PredictionError) -> str:
    return f"{error.rms_mm:.3f} / {error.median_mm:.3f}"


def score_table(results: Iterable[tuple[str, Mapping[str, ScoreSummary]]]) -> Table:
    """Scores against the reference, for each result and axis; of the velocity where a result has one."""
    rows = [[name, axis, *cells(one, _SCORE)] for name, scores in results for axis, one in scores.items()]
    return table(["result", "axis", *_SCORE], rows)


def runs_table(results: Mapping[str, Summary]) -> Table:
    """Many results: lines for each of up to 20 by name, and for each axis all of them together."""
    rows: list[list[str]] = []
    if len(results) <= _FEW_RUNS:
        rows += [[name, axis, *_pooled([one], axis)] for name, one in results.items() for axis in one.axes]
    for axis in dict.fromkeys(axis for one in results.values() for axis in one.axes):
        having = [one for one in results.values() if axis in one.axes]
        rows.append([f"all {len(having)}", axis, *_pooled(having, axis)])
    scores = ("RMSE, mm", "worst, mm", "95 % coverage", "NEES")
    return table(["result", "axis", *scores, "NIS", "prediction,\nof best other", "fused", "rejected", "notes"], rows)


def _pooled(summaries: Sequence[Summary], axis: str) -> list[str]:
    """Cells of one axis over several runs; each estimate and each component counts once."""
    parts = [summary.axes[axis] for summary in summaries]
    scores = [part.score for part in parts if part.score is not None]
    sensors = [sensor for part in parts for sensor in part.sensors.values()]
    fused, rejected = ([sensor.outcomes.get(word, 0) for sensor in sensors] for word in ("fused", "rejected"))
    rows = [score.rows for score in scores]
    skills = [sensor.skill for sensor in sensors if sensor.skill is not None]
    square = _mean([score.rmse_mm**2 for score in scores], rows)
    return [
        number(None if square is None else square**0.5),
        number(max((score.rmse_mm for score in scores), default=None)),
        number(_mean([score.coverage for score in scores], rows), ".1%"),
        number(_mean([score.nees_mean for score in scores], rows), ".2f"),
        number(_mean([sensor.nis_mean for sensor in sensors], fused), ".2f"),
        number(_mean([one.of_best_other for one in skills], [one.predictions for one in skills]), ".2f"),
        str(sum(fused)),
        str(sum(rejected)),
        str(sum(len(summary.notes) for summary in summaries)),
    ]


def _mean(values: Sequence[float | None], weights: Sequence[int]) -> float | None:
    """The weighted mean of the values that there are; None without any."""
    known = [(value, weight) for value, weight in zip(values, weights, strict=True) if value is not None]
    total = sum(weight for _, weight in known)
    return sum(value * weight for value, weight in known) / total if total else None
