"""The text of ``run.toml``, ``arm.toml`` and ``fusion.toml`` to begin with, from a survey of a log."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, cast

import tomli_w
from msgspec import to_builtins

from ..errors import printable
from ..logs.columns import leaf
from ..logs.frames import CARTESIAN
from ..space.rotations import TURNING
from ..units import DEG, MS, SCREEN, ending
from . import names
from .contents import Part, Signal, without_clock
from .guesses import ArmGuess, SensorGuess
from .roles import Roles, Stream, UndecidedError, streams_of
from .survey import Survey

FILES = MANIFEST, *_ = ("run.toml", "arm.toml", "fusion.toml")
BASES = {"name": "by name", "type": "by type of message", "turn": "by its turn", "range": "guessed by range"}
_COMMENT = 48  # column at which comments begin


def drafts(survey: Survey, arm: ArmGuess, sensors: Mapping[str, SensorGuess], folder: Path) -> dict[str, str]:
    """The three files by name, with the files of the log named from the folder where they will be."""
    made = _run_toml(survey, arm, folder), _arm_toml(survey, arm), _fusion_toml(survey, arm, sensors)
    return dict(zip(FILES, made, strict=True))


def sketch(name: str, undecided: UndecidedError, folder: Path) -> str:
    """``run.toml`` of a log that does not say who is who: what is in it, in comments that its owner sorts."""
    lines = [
        "# What is in the log. Lines that begin with # are not used: take the # from those that are meant.",
        "# [command] is what the arm is told. Each [sensors.NAME] is what measures the same axes: they are called the",
        "# same there as in [command], on the left of the =.",
        _pair("name", name),
    ]
    if undecided.roles is not None:
        lines += [*_source(["command"], undecided.roles.command, folder), *_unused(undecided.roles, folder)]
    else:
        lines += _either(undecided.parts, folder)
    for part in undecided.parts:
        lines += _other_columns(part)
    return "\n".join([*lines, ""])


def _either(parts: Sequence[Part], folder: Path) -> list[str]:
    """Lines for all columns, as any of them may hold the commands or the measurements."""
    lines = list[str]()
    clocked = [part for part in parts if part.clock is not None]
    streams = [stream for part in clocked for stream in streams_of(part) or [Stream(part.stem, None, "", part, {})]]
    if len(streams) == 1:  # of a table that holds both, each column may be either
        for table in (["command"], ["sensors", "measured"]):
            lines += [*_location(table, streams[0], folder), *(f"# {line}" for line in _columns(streams[0]))]
    else:
        for stream in streams:
            lines += ["", *(f"# {line}" for line in _source(["sensors", stream.name], stream, folder)[1:])]
    return lines


def _other_columns(part: Part) -> list[str]:
    """The columns of a part that are in no source, and why."""
    clockless = without_clock(part) if part.clock is None else ""
    others = dict.fromkeys((signal.column for signal in part.signals if clockless), clockless) | dict(part.left_out)
    lines = [f"# {_pair(names.identifier(column), column, printable(why, 200))}" for column, why in others.items()]
    return ["", f"# Of {printable(part.label)} not taken for positions:", *lines] if others else []


def _run_toml(survey: Survey, arm: ArmGuess, folder: Path) -> str:
    if survey.manifest is not None:
        return _rebased(survey, arm, folder)
    assert survey.roles is not None
    roles = survey.roles
    lines = [
        "# Where things are in the log, as `pumafuse init` found it. Lines that begin with # are not used.",
        f"name = {_value(survey.name)}",
    ]
    lines += _source(["command"], roles.command, folder)
    if survey.interpolation:
        why = "DECIDE: what measures follows the path between commands; without this line each is held"
        lines.append(_pair("interpolation_ms", survey.interpolation * MS, why))
    if levels := _levels(arm):
        lines.append(_pair("start", levels, "its sensor says so: not at its first command"))
    for sensor in roles.sensors:
        lines += _source(["sensors", sensor.name], sensor, folder)
    if roles.reference is not None:
        lines += _source(["reference"], roles.reference, folder)
    return "\n".join([*lines, *_unused(roles, folder), ""])


def _levels(arm: ArmGuess) -> dict[str, float]:
    """Where axes start by their sensors, which is not at their first command: the keys of ``start``."""
    return {
        f"{axis}_{SCREEN[guess.kind].unit}": _digits(guess.start * SCREEN[guess.kind].scale, 6)
        for axis, guess in arm.axes.items()
        if guess.start is not None and axis not in TURNING
    }


def _unused(roles: Roles, folder: Path) -> Iterator[str]:
    """Comments that list what a log holds and the draft does not use, with reasons."""
    for stream, why in roles.left_out:
        table = ["reference"] if stream.role == "reference" else ["sensors", stream.name]
        unused = [f"# {line}" for line in _source(table, stream, folder)[1:]]
        yield from ["", f"# Not used: {printable(why, 200)}", *unused]


def _source(table: Sequence[str], stream: Stream, folder: Path) -> list[str]:
    return [*_location(table, stream, folder), *_columns(stream)]


def _location(table: Sequence[str], stream: Stream, folder: Path) -> list[str]:
    part, clock = stream.part, stream.part.clock
    assert clock is not None
    lines = ["", _line(_header(table), printable(stream.why, 200)), _pair("file", _from(folder, part.file))]
    keys = {"topic": part.topic, "entity": part.entity, "where": dict(part.where)}
    lines += [_pair(key, value) for key, value in keys.items() if value]
    time: Any = {key: value for key, value in to_builtins(clock.time).items() if value}
    if set(time) <= {"column", "nanoseconds"}:
        time = list(time.values()) if clock.time.nanoseconds else clock.time.column
    lines.append(_pair("time", time, clock.basis))
    return lines


def _columns(stream: Stream) -> list[str]:
    lines = list[str]()
    pose = _pose(stream)
    if pose and stream.attitude:
        lines.append(_pair("pose", pose, "in m, and how it is turned"))
    for axis, signals in stream.axes.items() if not pose else ():
        columns: list[Any] = [_column(signal) for signal in signals]
        how = "DECIDE: unit " if signals[0].basis == "range" else "unit "
        lines.append(_pair(axis, columns[0] if len(columns) == 1 else columns, how + BASES[signals[0].basis]))
    if stream.attitude and not pose:
        asked = "DECIDE: " if stream.attitude.doubt else ""
        every: dict[str, Any] = to_builtins(stream.attitude.columns)
        told = {key: value for key, value in every.items() if value and value != "xyzw"}
        lines.append(_pair("orientation", told, f"{asked}{stream.attitude.basis}"))
    return lines


def _pose(stream: Stream) -> str:
    """The path of a pose in messages, if a stream's axes and orientation are all of that pose; else empty."""
    columns = stream.attitude.columns.quaternion if stream.attitude else None
    if columns is None or tuple(stream.axes) != CARTESIAN:
        return ""
    whole, dot, word = columns[0].removesuffix(".x").rpartition(".")
    position = {("transform", "rotation"): "translation"}.get((whole, word), "position")
    is_pose = word == ("rotation" if whole == "transform" else "orientation")
    places = [[(f"{whole}{dot}{position}.{axis}", "m")] for axis in CARTESIAN]
    columns_of_axes = [[(signal.column, signal.unit) for signal in signals] for signals in stream.axes.values()]
    turning = tuple(f"{whole}{dot}{word}.{part}" for part in "xyzw")
    return (whole or ".") if is_pose and places == columns_of_axes and turning == columns else ""


def _column(signal: Signal) -> Any:
    """A column, with what its name does not say."""
    more = {} if ending(leaf(signal.column)) == f"_{signal.unit}" else {"unit": signal.unit}
    more |= {"turn_deg": 360} if signal.turns else {}
    more |= {"where": dict(signal.where)} if signal.where else {}
    return {"column": signal.column, **more} if more else signal.column


def _rebased(survey: Survey, arm: ArmGuess, folder: Path) -> str:
    """The log's own ``run.toml`` for another folder; if it says of no axis where it starts, the sensors do."""
    tree: Any = {"name": survey.name} | deepcopy(dict(survey.manifest or {}))
    levels = {key: level for key, level in _levels(arm).items() if key.rpartition("_")[0] in tree["command"]}
    if levels:
        tree["command"].setdefault("start", levels)
    beside = survey.log if survey.log.is_dir() else survey.log.parent
    for table in (tree["command"], tree.get("reference"), *tree.get("sensors", {}).values()):
        if table is not None:
            table["file"] = _from(folder, beside / table["file"])
    if "robot" in tree:
        tree["robot"]["urdf"] = _from(folder, beside / tree["robot"]["urdf"])
    return (
        f"# The log's own run.toml ({printable(str(beside))}), with its files named from here.\n{tomli_w.dumps(tree)}"
    )


def _arm_toml(survey: Survey, arm: ArmGuess) -> str:
    lines = [
        "# The arm to begin with. `pumafuse tune --fit noise,delay,plant` finds better numbers; `gain` may be added.",
        f"name = {_value(survey.name)}",
        _pair("update_period_ms", _digits(arm.period * MS, 6), "median time between commands"),
        _pair("delay_ms", _digits(arm.delay * MS), "a guess: 60 % of the shortest lag; the rest is the plant's"),
    ]
    for axis, guess in arm.axes.items():
        lines += ["", _header(["axes", axis])]
        if guess.kind == "angle":
            lines.append(_pair("kind", "angle"))
        as_late_as = f"with the delay {guess.lag * MS:.0f} ms behind the held command, as {guess.follows} is"
        lag = as_late_as if guess.follows else "a guess: nothing follows this axis"
        lines += [_pair("plant", "first-order"), _pair("time_constant_ms", _digits(guess.time_constant * MS), lag)]
        if guess.follows and abs(guess.gain - 1.0) > 0.05:
            why = f"{guess.follows} moves {guess.gain:.2f} times as far as commanded: try it, or tune --fit gain"
            lines.append(_line(f"# {_pair('gain', {'intercept': round(guess.gain, 2)})}", why))
    return "\n".join([*lines, ""])


def _fusion_toml(survey: Survey, arm: ArmGuess, sensors: Mapping[str, SensorGuess]) -> str:
    offsets = {axis: guess.offset_sd for axis, guess in arm.axes.items()}
    lines = [
        "# How far the arm and each sensor are trusted. `pumafuse tune` finds better numbers.",
        *(_pair("arm", "arm.toml"), "", _header(["start"])),
        *_by_kind("offset_sd", offsets, arm, "how far the arm may be from its command at the start"),
    ]
    for axis, guess in arm.axes.items():
        unit, scale = SCREEN[guess.kind].unit, SCREEN[guess.kind].scale
        left = f"a guess: {_digits(guess.misfit * scale)} {unit} are left where the command is delayed by the lag"
        lines += [
            "",
            _header(["process", axis]),
            _pair(f"input_noise_{unit}_rtHz", _digits(guess.input_noise * scale), left),
            _pair(f"drift_{unit}_rts", _digits(guess.drift * scale), "likewise"),
        ]
    if survey.run.tool is not None:
        reference = [_digits(angle * DEG, 8) for angle in survey.run.tool]
        lines += ["", _header(["tool"])]
        lines.append(_pair("reference_rotation_vector_deg", reference, "the mean commanded orientation"))
    for name, own_frame in survey.own_frames.items():
        lines += ["", f"# Not used: {printable(name)} {own_frame.words}", f"# {_header(['sensors', name])}"]
    for name, guess in sensors.items():
        lines += ["", _header(["sensors", name])]
        lines += _by_kind("sd", guess.sd, arm, "its scatter from one measurement to the next")
        lines.append(_pair("latency_ms", _digits(guess.latency * MS, 3), guess.latency_words))
        if guess.pair and (scatter := guess.pair.alignment.unsteadiness):
            lines.append(_pair("latency_sd_ms", _digits(scatter * MS), "by its rows and steps"))
        if guess.scale < 0.0:
            lines.append(_pair("scale", -1.0, "it moves against the commands, as a distance may"))
        if guess.bias:
            lines += _by_kind("bias_sd", guess.bias, arm, "its zero is another than the commands'")
        if guess.turns:
            lines.append(_pair("turn_deg", 360, "it measures within a turn"))
        lines.append(_pair("gate", guess.gate, "it has outliers" if guess.gate else "it has no outliers: 0 is none"))
    return "\n".join([*lines, ""])


def _by_kind(key: str, values: Mapping[str, float], arm: ArmGuess, comment: str) -> Iterable[str]:
    for kind, screen in SCREEN.items():
        numbers = {axis: _digits(value * screen.scale) for axis, value in values.items() if arm.axes[axis].kind == kind}
        if numbers:
            yield f"# {comment}"
            yield _pair(f"{key}_{screen.unit}", numbers)


def _digits(value: float, digits: int = 2) -> float:
    return float(f"{value:.{digits}g}")


def _from(folder: Path, file: Path) -> str:
    try:
        return Path(os.path.relpath(file.absolute(), folder.absolute())).as_posix()
    except ValueError:  # on another drive
        return file.absolute().as_posix()


def _line(text: str, comment: str = "") -> str:
    return f"{text.ljust(_COMMENT - 1)} # {comment}" if comment else text


def _header(table: Sequence[str]) -> str:
    return f"[{'.'.join(_key(word) for word in table)}]"


def _pair(key: str, value: Any, comment: str = "") -> str:
    return _line(f"{_key(key)} = {_value(value)}", comment)


def _key(key: str) -> str:
    return tomli_w.dumps({key: 0}).removesuffix(" = 0\n")


def _value(value: Any) -> str:
    """A value on one line; the library writes tables and lists over several."""
    if isinstance(value, Mapping):
        pairs = (_pair(key, item) for key, item in cast(Mapping[str, Any], value).items())
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_value(item) for item in cast(Sequence[Any], value))}]"
    return tomli_w.dumps({"v": value}).removeprefix("v = ").rstrip("\n")
