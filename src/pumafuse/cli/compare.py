"""`pumafuse compare`."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from rich.table import Table

from .. import folders, toml
from ..errors import RunError
from ..folders import FolderError
from ..fusion import results
from ..fusion.estimates import write_tum
from ..fusion.results import Result
from ..fusion.score import OrientationScore, ReferenceTrack
from ..fusion.summary import ScoreSummary, SensorSummary
from ..logs.frames import CARTESIAN
from ..units import KINDS, SCREEN, Kind
from .screen import say, say_json
from .tables import (
    consistency_table,
    orientation_table,
    position,
    print_tables,
    score_table,
    share_rejected,
    skill_table,
    table,
)

FIGURE = "pumafuse-comparison.png"
_EQUAL = 2.0  # log-likelihood by which a result must be ahead
_EQUALLY = 0.01  # of an error, likewise


class Compared(NamedTuple):
    """A result with its scores, where it has a reference, and by how much it differs from the first of the same run."""

    name: str
    result: Result
    track: ReferenceTrack | None
    scores: Mapping[str, ScoreSummary]
    orientation: OrientationScore | None
    differences: Mapping[str, Difference]


class Difference(toml.Reported, frozen=True, kw_only=True):
    """Positions less those of the first result [m or rad]: root mean square, the largest, and when that is."""

    rms: float = msgspec.field(name="rms_mm")
    largest: float = msgspec.field(name="largest_mm")
    at: float = msgspec.field(name="at_s")


def run(paths: Sequence[Path], reference: Path | None, json: bool, tum: Path | None = None, draw: bool = False) -> None:
    """Compare result folders; write their trajectories and references into the folder ``tum``."""
    compared = list[Compared]()
    for folder in paths:
        result = results.read(folder)
        track = result.reference
        if reference is not None:
            track = results.read_reference(reference, result.summary.origin_ns, result.config)
        scores = {} if track is None else result.scores(track)
        if track is not None and not scores:
            raise RunError(
                f"{folder}: the reference covers no estimate on any axis; do its axes ({', '.join(track.position)})"
                " and its clock fit the run?"
            )
        first = compared[0].result if compared else result
        turned = None if track is None else result.orientation_score(track)
        compared.append(Compared(str(folder), result, track, scores, turned, _differences(first, result)))
    if tum is not None:
        _write_trajectories(compared, tum)
        if not json:
            say(f"trajectories written to {tum}")
    best, why = verdict(compared)
    if draw:
        _draw(compared, why)
    if json:
        say_json([{**_to_json(result), "take": result.name == best} for result in compared])
        return
    scored = [(result.name, result.result.summary, result.scores) for result in compared if result.scores]
    every = [(result.name, result.result.summary) for result in compared]
    print_tables(score_table(scored, kind) for kind in KINDS)
    print_tables([orientation_table((result.name, result.orientation) for result in compared)])
    print_tables(consistency_table(every, kind) for kind in KINDS)
    print_tables(skill_table(every, kind) for kind in KINDS)
    print_tables(_difference_table(compared, kind) for kind in KINDS)
    if why:
        say(why)


def _differences(first: Result, other: Result) -> dict[str, Difference]:
    """Differences by axis of both; none of the first itself, nor of another run."""
    same = first.summary.run == other.summary.run and first.summary.origin_ns == other.summary.origin_ns
    if other is first or not same or first.segment.any() or other.segment.any():
        return {}
    time = first.time[(first.time >= other.time[0]) & (first.time <= other.time[-1])]
    differences = dict[str, Difference]()
    positions, yours = (result.positions(first.config) for result in (first, other))
    for axis in (axis for axis in first.axes if axis in other.axes and len(time)):
        apart = np.interp(time, other.time, yours[axis]) - np.interp(time, first.time, positions[axis])
        at = int(np.argmax(np.abs(apart)))
        differences[axis] = Difference(
            rms=float(np.sqrt(np.mean(apart**2))), largest=float(apart[at]), at=float(time[at])
        )
    return differences


def verdict(compared: Sequence[Compared]) -> tuple[str | None, str]:
    """Which result to take, None where none is ahead, and why in a sentence; empty of one alone or of several runs.

    By the error where all have a reference; else by the log-likelihood if all have the same measurements and gates: a
    narrow gate would gain by rejecting; else by how well the next measurement of the sensors is predicted that all
    have.
    """
    every = [result.result.summary for result in compared]
    if len(every) < 2 or len({(summary.run, summary.origin_ns) for summary in every}) > 1:
        return None, ""
    if len({(summary.from_s, summary.to_s) for summary in every}) > 1:
        return None, "nothing is chosen: the results are of different parts of the run"
    by_error = _shared_means(
        [{axis: math.log(score.rmse) for axis, score in each.scores.items() if score.rmse > 0.0} for each in compared]
    )
    if by_error is not None:
        return _least(compared, by_error, "its error against the reference (RMSE, mean over the axes) is")
    if all(_count_measured(result.result) == _count_measured(compared[0].result) for result in compared):
        likelihood = [sum(axis.log_likelihood for axis in summary.axes.values()) for summary in every]
        order = sorted(range(len(compared)), key=lambda number: -likelihood[number])
        best, second = (compared[number].name for number in order[:2])
        ahead = likelihood[order[0]] - likelihood[order[1]]
        if ahead < _EQUAL and len({summary.mode for summary in every}) > 1:
            why = "innovations are those of one filter, and only a reference could tell how much a smoothed one gains"
            return None, f"no result is ahead: they differ in mode; {why}"
        if ahead < _EQUAL:
            return None, f"no result is ahead: the log-likelihoods of {best} and {second} differ by {ahead:.1f} only"
        why = "the log-likelihood of the same measurements, each before it is used, is"
        return best, f"take {best}: {why} {ahead:.1f} higher than that of {second}"
    predictions = _shared_means([_predictions(result.result) for result in compared])
    if predictions is None:
        return None, "nothing to choose by: the results have no reference, and no sensor in common"
    return _least(compared, predictions, "its error of predicting the next measurement (RMS, mean over the sensors) is")


def _least(compared: Sequence[Compared], logs: Sequence[float], what: str) -> tuple[str | None, str]:
    order = sorted(range(len(compared)), key=lambda number: logs[number])
    best, second = (compared[number].name for number in order[:2])
    less = -math.expm1(logs[order[0]] - logs[order[1]])
    if less < _EQUALLY:
        return None, f"no result is ahead: {best} and {second} differ by {less:.1%} only; {what} what was compared"
    return best, f"take {best}: {what} {less:.0%} smaller than that of {second}"


def _shared_means(each: Sequence[Mapping[str, float]]) -> list[float] | None:
    """The means over the keys that all have; None without any."""
    keys = set(each[0]).intersection(*each[1:])
    return [sum(by_key[key] for key in keys) / len(keys) for by_key in each] if keys else None


def _count_measured(result: Result) -> dict[tuple[str, str], tuple[int, float | None]]:
    """How many components were fused or rejected, and by which gate, by axis and sensor."""
    gates = {name: sensor.gate for name, sensor in result.config.sensors.items()}
    return {
        (axis, name): (
            sum(sensor.outcomes.get(word, 0) for word in ("fused", "rejected", "reacquired")),
            gates.get(name),
        )
        for axis, part in result.summary.axes.items()
        for name, sensor in part.sensors.items()
    }


def _predictions(result: Result) -> dict[str, float]:
    """Logarithms of the errors of prediction, by axis and sensor."""
    return {
        f"{axis}, {name}": math.log(sensor.skill.filter.rms)
        for axis, part in result.summary.axes.items()
        for name, sensor in part.sensors.items()
        if sensor.skill is not None and sensor.skill.filter.rms > 0.0
    }


def _difference_table(compared: Sequence[Compared], kind: Kind) -> Table:
    unit = SCREEN[kind].unit
    rows = [
        [each.name, axis, position(difference.rms, kind), position(difference.largest, kind), f"{difference.at:.2f}"]
        for each in compared
        for axis, difference in each.differences.items()
        if each.result.summary.axes[axis].kind == kind
    ]
    headings = ["result", "axis", f"RMS, {unit}", f"largest, {unit}", "at, s"]
    return table(headings, rows, f"Positions less those of {compared[0].name}")


def _draw(compared: Sequence[Compared], why: str) -> None:
    from ..views.figures import comparison_figure

    drawn = comparison_figure({result.name: result.result for result in compared}, compared[0].track, why)
    picture = io.BytesIO()
    drawn.savefig(picture, format="png", dpi=130)
    folders.write_file(Path(FIGURE), picture.getvalue())
    say(f"drawn in {FIGURE}", err=True)


def _write_trajectories(compared: Sequence[Compared], output: Path) -> None:
    """Write ``<folder>.tum`` for each result, and ``<folder>.reference.tum`` where it has a reference in x, y, z."""
    folders.check_writable(output, False, [], lambda _: False)
    names = [Path(result.name).resolve().name for result in compared]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise FolderError(f"{output}: two results are called '{twice}', and so would be their files; rename a folder")
    with folders.replacing(output) as new:
        for result, name in zip(compared, names, strict=True):
            track, of = result.track, (result.result.config, result.result.summary.origin_ns)
            write_tum(result.result.track, *of, result.name, new / f"{name}.tum")
            if track is not None and (track.cartesian or set(CARTESIAN) <= set(track.position)):
                write_tum(track, *of, f"{result.name}: the reference", new / f"{name}.reference.tum")


def _to_json(compared: Compared) -> dict[str, Any]:
    """A result as JSON, in the units of its axes."""
    summary, of = compared.result.summary, compared.result.summary.axes

    def by_sensor(number: Callable[[SensorSummary, Kind], object]) -> dict[str, dict[str, object]]:
        return {
            axis: {name: number(each, part.kind) for name, each in part.sensors.items()} for axis, part in of.items()
        }

    return {
        "folder": compared.name,
        "run": summary.run,
        "mode": summary.mode,
        "axes": {axis: toml.reported(each, of[axis].kind) for axis, each in compared.scores.items()},
        "orientation": compared.orientation and toml.reported(compared.orientation),
        "log_likelihood": {axis: part.log_likelihood for axis, part in of.items()},
        "nis": by_sensor(lambda each, _: each.nis_mean),
        "rejected": by_sensor(lambda each, _: share_rejected(each)),
        "skill": by_sensor(lambda each, kind: each.skill and toml.reported(each.skill, kind)),
        "difference": {axis: toml.reported(each, of[axis].kind) for axis, each in compared.differences.items()},
        "commands": summary.commands,
        "rows": summary.rows,
    }
