"""The tables that commands print: one for the axes that are lengths, one for those that are angles."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from io import StringIO
from typing import Literal, TextIO

import msgspec
from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ..errors import printable
from ..fusion.score import Z95, OrientationScore
from ..fusion.segments import NOT_SELECTED
from ..fusion.skill import PredictionError
from ..fusion.summary import AxisSummary, ScoreSummary, SensorSummary, Summary, pool, weighted_mean
from ..units import DEG, SCREEN, Kind

# By heading: an attribute, its format, and what it is multiplied by; None: what positions are on the screen.
Columns = Mapping[str, tuple[str, str, float | None]]

_GIVEN = {"used", "fused", "rejected", "reacquired", NOT_SELECTED}  # what is no surprise
_WIDEST = 2000  # characters of a cell
_SENTENCE = 30  # characters, from which a cell is broken into lines
_FEW_RUNS = 20  # that get lines of their own
_SCORE: Columns = {
    "RMSE, {unit}": ("rmse", ".3f", None),
    "bias, {unit}": ("bias", "+.3f", None),
    "95 %\ncoverage": ("coverage", ".1%", 1.0),
    "NEES": ("nees_mean", ".2f", 1.0),
    "scored": ("rows", ".0f", 1.0),
    "left\nout": ("left_out", ".0f", 1.0),
    "velocity\nRMSE, {unit}/s": ("velocity_rmse", ".3f", None),
    "velocity\n95 % cov.": ("velocity_coverage", ".1%", 1.0),
}

_ORIENTATION: Columns = {
    "angle to the reference,\nRMS, deg": ("rms", ".3f", DEG),
    "expected,\ndeg": ("expected", ".3f", DEG),
    "scored": ("rows", ".0f", 1.0),
    "left\nout": ("left_out", ".0f", 1.0),
}


def console(file: TextIO) -> Console:
    """A stream for people: 120 columns wide where it is no terminal; nowhere if it is closed, which makes it None."""
    target = file or StringIO()
    return Console(file=target, highlight=False, emoji=False, width=None if target.isatty() else 120)


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None) -> Table:
    """A table for the terminal, without columns in which no row has anything.

    Columns of numbers are right-justified. They, names and cells of several lines are not wrapped, and sentences get no
    narrower than a few words: a digit that is cut off makes another number.
    """
    made = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", title_style="")
    kept: list[list[str]] = []
    for heading, *column in zip(headings, *rows, strict=True):
        if set(column) <= {"", "–"}:
            continue
        cells = ["\n".join(printable(line, _WIDEST) for line in cell.splitlines()) for cell in column]
        numbers = all(cell[:1] in "+-–…<0123456789" for cell in cells)
        longest = max(cell_len(line) for cell in (heading, *cells) for line in cell.splitlines())
        whole = numbers or any("\n" in cell for cell in cells) or longest <= _SENTENCE
        made.add_column(
            escape(heading),
            justify="right" if numbers else "left",
            overflow="ellipsis" if whole else "fold",
            no_wrap=whole,
            min_width=longest if whole else _SENTENCE,
        )
        kept.append([escape(cell) for cell in cells])
    for row in zip(*kept, strict=True):
        made.add_row(*row)
    return made


def print_tables(tables: Iterable[Table], stream: Literal["stdout", "stderr"] = "stdout") -> None:
    """Print the tables that have anything in them, whole, however narrow the screen is."""
    for table in tables:
        if table.columns:
            out = console(getattr(sys, stream))
            out.width = max(out.width, out.measure(table, options=out.options.update(width=_WIDEST)).minimum)
            out.print(table, crop=False)


def number(value: float | None, form: str = ".3f") -> str:
    """A number as the format specification says; a dash for None."""
    return "–" if value is None else format(value, form)


def position(value: float | None, kind: Kind) -> str:
    """A number with the unit of positions [SI] in that of the screen; a dash for None."""
    return "–" if value is None else f"{value * SCREEN[kind].scale:.3f}"


def interval(value: float | None, sd: float | None, kind: Kind) -> str:
    """A position with its 95 % interval in the screen's unit; a dash for None."""
    return "–" if value is None or sd is None else f"{position(value, kind)} ± {position(Z95 * sd, kind)}"


def headings(columns: Columns, kind: Kind) -> list[str]:
    """The headings of columns for axes of a kind."""
    return [heading.format(unit=SCREEN[kind].unit) for heading in columns]


def cells(row: object, columns: Columns, kind: Kind = "length") -> list[str]:
    """The attributes of ``row`` as text."""
    values = ((getattr(row, name), form, scale) for name, form, scale in columns.values())
    of_positions = SCREEN[kind].scale
    return [
        "–" if value is None else format(value * (of_positions if scale is None else scale), form)
        for value, form, scale in values
    ]


def outcome_table(summary: Summary, kind: Kind) -> Table:
    """Components by outcome, innovations and their expected size, for each axis of a kind and sensor."""
    sensors = [(axis, name, sensor) for _, axis, _, name, sensor in _sensors([("", summary)], kind)]
    words = sorted(
        {word for *_, sensor in sensors for word in sensor.outcomes}, key=lambda word: (word != "fused", word)
    )
    rows = [
        [
            axis,
            name,
            *(str(sensor.outcomes.get(word, 0)) for word in words),
            position(sensor.innovation_rms, kind),
            position(sensor.innovation_sd, kind),
            interval(sensor.bias, sensor.bias_sd, kind),
            sensor.verdict,
        ]
        for axis, name, sensor in sensors
    ]
    unit = SCREEN[kind].unit
    of_positions = (f"innovation, {unit}", f"expected, {unit}", f"bias, {unit}")
    return table(["axis", "sensor", *words, *of_positions, "verdict"], rows)


def left_out_words(summary: Summary) -> str:
    """How many rows of which source the filter was not given, and why, in words; empty where it was given all."""
    sources = [("commands", summary.commands), *summary.rows.items()]
    return "; ".join(
        f"{', '.join(f'{count} {word}' for word, count in without.items())} of {sum(counts.values())} {name}"
        for name, counts in sources
        if (without := {word: count for word, count in counts.items() if word not in _GIVEN})
    )


def skill_table(results: Iterable[tuple[str, Summary]], kind: Kind) -> Table:
    """Errors of predicting each sensor's next measurement on axes of a kind, by this filter and by simpler means."""

    def prediction(error: PredictionError) -> str:
        return f"{position(error.rms, kind)} / {position(error.median, kind)}"

    rows = [
        [
            name,
            axis,
            sensor,
            str(of_sensor.skill.predictions),
            *map(prediction, msgspec.structs.astuple(of_sensor.skill)[1:]),
        ]
        for name, axis, _, sensor, of_sensor in _sensors(results, kind)
        if of_sensor.skill is not None
    ]
    by = ["last one\nheld", "constant\nvelocity", "command\nalone", "this\nfilter"]
    title = f"Error of predicting the next measurement, RMS / median in {SCREEN[kind].unit}, by …"
    return table(["result", "axis", "sensor", "predictions", *by], rows, title)


def consistency_table(results: Iterable[tuple[str, Summary]], kind: Kind) -> Table:
    """What each result says of itself on axes of a kind: likelihood, and of each sensor NIS and the share rejected."""
    rows = [
        [
            name,
            axis,
            f"{part.log_likelihood:.1f}",
            sensor,
            number(of_sensor.nis_mean),
            number(share_rejected(of_sensor), ".1%"),
        ]
        for name, axis, part, sensor, of_sensor in _sensors(results, kind)
    ]
    return table(["result", "axis", "log-likelihood", "sensor", "NIS", "rejected"], rows)


def _sensors(
    results: Iterable[tuple[str, Summary]], kind: Kind
) -> Iterator[tuple[str, str, AxisSummary, str, SensorSummary]]:
    """Each sensor on each axis of a kind: the result, the axis with its summary, the sensor with its own."""
    for name, summary in results:
        for axis, part in summary.axes.items():
            if part.kind == kind:
                for sensor, of_sensor in part.sensors.items():
                    yield name, axis, part, sensor, of_sensor


def share_rejected(sensor: SensorSummary) -> float | None:
    """The share of a sensor's components that were rejected; None where none was decided on."""
    rejected = sensor.outcomes.get("rejected", 0)
    every = rejected + sensor.outcomes.get("fused", 0) + sensor.outcomes.get("reacquired", 0)
    return rejected / every if every else None


def score_table(results: Iterable[tuple[str, Summary, Mapping[str, ScoreSummary]]], kind: Kind) -> Table:
    """Scores by axis against a reference, for each result and axis of a kind; of the velocity where there is one."""
    rows = [
        [name, axis, *cells(score, _SCORE, kind)]
        for name, summary, scores in results
        for axis, score in scores.items()
        if summary.axes[axis].kind == kind
    ]
    return table(["result", "axis", *headings(_SCORE, kind)], rows)


def orientation_table(results: Iterable[tuple[str, OrientationScore | None]]) -> Table:
    """The angle between estimated and reference orientation of each result, where there is one."""
    rows = [[name, *cells(score, _ORIENTATION)] for name, score in results if score is not None]
    return table(["result", *_ORIENTATION], rows)


def runs_table(results: Mapping[str, Summary], kind: Kind) -> Table:
    """Many results: lines for each of up to 20 by name, and for each axis of a kind all of them together."""
    axes = {
        name: [axis for axis, axis_summary in result.axes.items() if axis_summary.kind == kind]
        for name, result in results.items()
    }
    rows: list[list[str]] = []
    if len(results) <= _FEW_RUNS:
        rows += [[name, axis, *_pool([result], axis, kind)] for name, result in results.items() for axis in axes[name]]
    for axis in dict.fromkeys(axis for names in axes.values() for axis in names):
        having = [result for name, result in results.items() if axis in axes[name]]
        rows.append([f"all {len(having)}", axis, *_pool(having, axis, kind)])
    unit = SCREEN[kind].unit
    scores = (f"RMSE, {unit}", f"worst, {unit}", "95 % coverage", "NEES")
    return table(["result", "axis", *scores, "NIS", "prediction,\nof best other", "fused", "rejected", "notes"], rows)


def _pool(summaries: Sequence[Summary], axis: str, kind: Kind) -> list[str]:
    """Cells of one axis over several runs; each estimate and each component counts once."""
    parts = [summary.axes[axis] for summary in summaries]
    scores = [part.score for part in parts if part.score is not None]
    sensors = [sensor for part in parts for sensor in part.sensors.values()]
    fused, rejected = ([sensor.outcomes.get(word, 0) for sensor in sensors] for word in ("fused", "rejected"))
    score = pool(scores, [score.rows for score in scores])
    skills = [sensor.skill for sensor in sensors if sensor.skill is not None]
    return [
        position(score and score.rmse, kind),
        position(max((score.rmse for score in scores), default=None), kind),
        number(score and score.coverage, ".1%"),
        number(score and score.nees_mean, ".2f"),
        number(weighted_mean([sensor.nis_mean for sensor in sensors], fused), ".2f"),
        number(
            weighted_mean([skill.of_best_other for skill in skills], [skill.predictions for skill in skills]), ".2f"
        ),
        str(sum(fused)),
        str(sum(rejected)),
        str(sum(len(summary.notes) for summary in summaries)),
    ]
