"""`pumafuse fuse` of a log of which nothing is known."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import typer

from ..arrays import SD_OF_MEDIAN
from ..discovery.drafts import drafts
from ..discovery.guesses import guess
from ..discovery.roles import UndecidedError
from ..discovery.survey import FOLLOWS, Survey, early, survey, too_early
from ..errors import RunError
from ..fusion import results
from ..fusion.config import FusionConfig
from ..fusion.consistency import Finding
from ..fusion.estimates import Mode
from ..fusion.offline import Engine, fuse
from ..fusion.summary import Summary
from ..logs.run import described
from ..logs.source import Source
from ..model.arm import ArmModel
from ..tuning.identifiability import LostError
from ..tuning.parameters import Fit
from ..tuning.summary import FittedLag
from ..tuning.tune import tune
from ..units import MS, SCREEN
from . import init
from .fuse import draw, show
from .register import latency_note
from .screen import say
from .tune import WORSE, end, fitting, show_lags

_STRAYS_FAR = 2.0  # times as far off as the path through the commands: no arm was found
_NOTHING = 1e-3  # of the range that is measured, by which it is off at least
_OTHERWISE = 1.0  # times the smaller of two lags, by which they differ at least to be another one
_SAME_LAG_MS = 50.0  # and by which a lag of any size does
_BAGS = (".mcap", ".db3")  # which ROS 2 records
_FITTED_ARM: Sequence[Fit] = ("delay", "plant", "gain")  # whose intervals the error bars count
_FITTED: Sequence[Fit] = ("noise", *_FITTED_ARM)


def run(
    log: Path,
    output: Path,
    sensors: Sequence[str] | None,
    rate: float | None,
    mode: Mode,
    extras: Sequence[str],
    engine: Engine,
    force: bool,
    part: tuple[float | None, float | None],
) -> None:
    """Fuse a log of which nothing is known into a result folder: what ``init``, ``tune`` and ``fuse`` do, at once.

    The folder also has the ``run.toml`` that was found, so that every other command takes it for a run.
    """
    results.check_writable(output, force, with_run=True)
    try:
        surveyed = survey(log)
    except UndecidedError as error:
        raise RunError(f"{error}; `pumafuse init {shlex.quote(str(log))}` writes one to sort") from None
    for name in surveyed.run.sensors:
        if by := early(surveyed, name):
            raise RunError(f"{log}: {too_early(name, max(by.values()))}{_its_run_toml(surveyed, log)}")
    surveyed = replace(surveyed, run=surveyed.run.between(*part))  # so that latencies are those of the part
    arm, begins = guess(surveyed)
    init.show(surveyed, begins)
    while True:
        texts, here = drafts(surveyed, arm, begins, output), Path()
        recorded = described(drafts(surveyed, arm, begins, here)["run.toml"], here).between(*part)
        registered = init.register_sensors(surveyed, recorded) if surveyed.own_frames else None
        begun = registered or FusionConfig.parse(texts["fusion.toml"], ArmModel.parse(texts["arm.toml"]))
        begun.sensor_names(sensors)  # before anything is fitted
        try:
            with fitting() as progress:
                fitted = tune(recorded, begun, fit=_FITTED, intervals=_FITTED_ARM, progress=progress)
            break
        except LostError as error:
            if (others := _drop_lost(surveyed, error)) is None:
                advice = _its_run_toml(surveyed, log) if "run.toml" in str(error) else ""
                raise RunError(f"{error}{advice}") from None
            surveyed = others
            say(f"left out: {error}")
            arm, begins = guess(surveyed)
    est = fuse(recorded, fitted.config, sensors=sensors, rate=rate, mode=mode, engine=engine)
    est = replace(est, fitted=True)
    results.check_fused(est.counts, est.config)
    summary = results.write(est, output, force, lambda new: draw(new, est, recorded, extras), texts["run.toml"])
    show_lags(fitted.details, fitted.config.arm)
    show(summary)
    strays = _off_the_path(surveyed, summary)
    slow = otherwise_than_at_first(surveyed, fitted.details.lags, fitted.config.arm)
    for line in [*strays, *slow, *_lone_sensor_notes(summary)]:
        say(line)
    if registered is None:  # which says it beside what it found
        for name in (name for name, sensor in fitted.config.sensors.items() if sensor.latency == 0.0):
            say(latency_note(name, 0.0))
    folder = shlex.quote(str(output))
    another = "pumafuse fuse ANOTHER_LOG"
    if surveyed.roles is not None:  # it is read by what `init` finds in it, as this one was
        another = "pumafuse init ANOTHER_LOG -o ANOTHER && pumafuse fuse ANOTHER"
    say(f"written to {output}\nnext: {another} -c {folder}/fusion.toml -o DIR")
    if any(path.suffix in _BAGS for path in (log.iterdir() if log.is_dir() else [log])):
        say(f"or as a node of ROS 2: pumafuse live ros2:{folder}/run.toml -c {folder}/fusion.toml")
    end(fitted.details)
    if strays:
        raise typer.Exit(WORSE)


def _its_run_toml(survey: Survey, log: Path) -> str:
    """Where the run.toml is that an error names; "" where the log has one."""
    return f" (`pumafuse init {shlex.quote(str(log))}` writes one)" if survey.roles else ""


def _drop_lost(survey: Survey, lost: LostError) -> Survey | None:
    """What was found, without axes on which a sensor follows nothing; None if nothing else follows."""
    bad = {(name, axis) for name in lost.fault.sensors for axis in lost.fault.axes}
    measured = {name: sensor.values for name, sensor in survey.run.sensors.items()}
    kept = {name: {axis: of[axis] for axis in of if (name, axis) not in bad} for name, of in measured.items()}
    related = {key: relation for key, relation in survey.relations.items() if key not in bad}
    follows = any(abs(relation.correlation) >= FOLLOWS for (name, _), relation in related.items() if name in kept)
    if lost.fault.cause != "nothing" or not follows or all(len(kept[name]) == len(measured[name]) for name in measured):
        return None
    sensors = {name: replace(survey.run.sensors[name], values=values) for name, values in kept.items() if values}
    return replace(survey, run=replace(survey.run, sensors=sensors), relations=related)


def _off_the_path(survey: Survey, summary: Summary) -> list[str]:
    """A sentence on each axis of which the filter predicts every sensor much worse than the path through the commands.

    The path needs no arm, but it knows the next command: what moves as that is given was commanded earlier.
    """
    lines, follows = dict[str, str](), set[str]()
    for (name, axis), relation in survey.relations.items():
        part = summary.axes.get(axis)  # a sensor in a frame of its own, or one not asked for, has none
        skill = part.sensors[name].skill if part is not None and name in part.sensors else None
        if part is None or skill is None or abs(relation.correlation) < FOLLOWS:
            continue
        screen, off = SCREEN[part.kind], SD_OF_MEDIAN * skill.filter.median
        least = _NOTHING * float(np.ptp(survey.run.sensors[name].values[axis]))
        if off < max(_STRAYS_FAR * relation.misfit, least):
            follows.add(axis)
        lines[axis] = (
            f"{axis}: {name} is {relation.misfit * screen.scale:.3g} {screen.unit} off the path through the commands"
            f" {relation.lag * MS:.0f} ms before, and the filter predicts it to {off * screen.scale:.3g}: no arm was"
            f" found by which {axis} follows. Does its controller go on between commands (interpolation_ms in"
            " run.toml), or were these given earlier than they are stamped (shift_s)?"
        )
    return [line for axis, line in lines.items() if axis not in follows]


def otherwise_than_at_first(survey: Survey, lags: Mapping[str, FittedLag], arm: ArmModel) -> list[str]:
    """A sentence on the axes whose fitted lag is far from that of the first look, which needs no arm.

    What has play or a fastest speed lags otherwise with each motion. So much play as explains it does, and no less.
    """
    seen = {axis for (_, axis), relation in survey.relations.items() if abs(relation.correlation) >= FOLLOWS}
    others = [
        f"{axis} ({lag.before_ms:.0f} ms at the first look, {lag.lag_ms:.0f} fitted)"
        for axis, lag in lags.items()
        if axis in seen
        and not arm.axes[axis].max_speed
        and abs(lag.lag_ms - lag.before_ms)
        > max(
            _OTHERWISE * min(lag.lag_ms, lag.before_ms),
            _SAME_LAG_MS,
            MS * (arm.axes[axis].play or 0.0) / _speed(survey.run.command, axis),
        )
    ]
    if not others:
        return []
    return [
        f"do not trust the lag of {', '.join(others)}: an axis that sticks or carries a load is taken for a slow one,"
        " or the look was at too little. Fit where it moves more (--from, --to), and look at fused.png (--figures)"
    ]


def _speed(command: Source, axis: str) -> float:
    """How fast an axis is commanded to move, over all of a run [m/s or rad/s]; above 0."""
    way = float(np.abs(np.diff(command.values[axis])).sum())
    return max(way * 1e9 / max(int(np.ptp(command.stamp)), 1), 1e-12)


def _lone_sensor_notes(summary: Summary) -> list[str]:
    """A sentence on each sensor that is alone on axes where its noise is told from the arm's by being white alone."""
    by_reason = dict[str, list[str]]()
    for axis, part in summary.axes.items():
        for name, sensor in part.sensors.items():
            if sensor.finding == Finding.UNTESTED.value:
                by_reason.setdefault(name, []).append(axis)
    return [
        f"{name} alone measures {', '.join(axes)}: what strays there is taken for the arm. If {name} filters its"
        " values, or its noise lasts, nothing here shows it, and error bars are too small"
        for name, axes in by_reason.items()
    ]
