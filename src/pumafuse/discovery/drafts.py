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


def drafts(found: Survey, arm: ArmGuess, sensors: Mapping[str, SensorGuess], folder: Path) -> dict[str, str]:
    """The three files by name, with the files of the log named from the folder where they will be."""
    made = _run_toml(found, arm, folder), _arm_toml(found, arm), _fusion_toml(found, arm, sensors)
    return dict(zip(FILES, made, strict=True))


def sketch(name: str, undecided: UndecidedError, folder: Path) -> str:
    """``run.toml`` of a log that does not say who is who: what is in it, in comments that its owner sorts."""
    lines = ["# What is in the log. Lines that begin with # are not used: take the # from those that are meant."]
    if undecided.roles is not None:
        told = _source(["command"], undecided.roles.command, folder)
        return "\n".join([*lines, _pair("name", name), *told, *_unused(undecided.roles, folder), ""])
    lines += [
        "# [command] is what the arm is told. Each [sensors.NAME] is what measures the same axes: they are called the",
        "# same there as in [command], on the left of the =.",
        _pair("name", name),
    ]
    clocked = [part for part in undecided.parts if part.clock is not None]
    streams = [one for part in clocked for one in streams_of(part) or [Stream(part.stem, None, "", part, {})]]
    if len(streams) == 1:  # of a table that holds both, each column may be either
        for table in (["command"], ["sensors", "measured"]):
            lines += [*_place(table, streams[0], folder), *(f"# {line}" for line in _columns(streams[0]))]
    else:
        for one in streams:
            lines += ["", *(f"# {line}" for line in _source(["sensors", one.name], one, folder)[1:])]
    for part in undecided.parts:
        lines += _other_columns(part)
    return "\n".join([*lines, ""])


def _other_columns(part: Part) -> list[str]:
    """The columns of a part that are in no source, and why."""
    clockless = without_clock(part) if part.clock is None else ""
    others = dict.fromkeys((one.column for one in part.signals if clockless), clockless) | dict(part.left_out)
    lines = [f"# {_line(_pair(names.plain(column), column), printable(why, 200))}" for column, why in others.items()]
    return ["", f"# Of {printable(part.label)} not taken for positions:", *lines] if others else []


def _run_toml(found: Survey, arm: ArmGuess, folder: Path) -> str:
    if found.manifest is not None:
        return _rebased(found, arm, folder)
    assert found.roles is not None
    roles = found.roles
    lines = [
        "# Where things are in the log, as `pumafuse init` found it. Lines that begin with # are not used.",
        f"name = {_value(found.name)}",
    ]
    lines += _source(["command"], roles.command, folder)
    if found.interpolation:
        why = "DECIDE: what measures follows the path between commands; without this line each is held"
        lines.append(_line(_pair("interpolation_ms", found.interpolation * MS), why))
    if levels := _levels(arm):
        lines.append(_line(_pair("start", levels), "its sensor says so: not at its first command"))
    for one in roles.sensors:
        lines += _source(["sensors", one.name], one, folder)
    if roles.reference is not None:
        lines += _source(["reference"], roles.reference, folder)
    return "\n".join([*lines, *_unused(roles, folder), ""])


def _levels(arm: ArmGuess) -> dict[str, float]:
    """Where axes start by their sensors, which is not at their first command: the keys of ``start``."""
    return {
        f"{axis}_{SCREEN[one.kind].unit}": _digits(one.start * SCREEN[one.kind].scale, 6)
        for axis, one in arm.axes.items()
        if one.start is not None and axis not in TURNING
    }


def _unused(roles: Roles, folder: Path) -> Iterator[str]:
    """In comments what is in a log and not used, and why."""
    for stream, why in roles.left_out:
        table = ["reference"] if stream.role == "reference" else ["sensors", stream.name]
        unused = [f"# {line}" for line in _source(table, stream, folder)[1:]]
        yield from ["", f"# Not used: {printable(why, 200)}", *unused]


def _source(table: Sequence[str], stream: Stream, folder: Path) -> list[str]:
    return [*_place(table, stream, folder), *_columns(stream)]


def _place(table: Sequence[str], stream: Stream, folder: Path) -> list[str]:
    part, clock = stream.part, stream.part.clock
    assert clock is not None
    lines = ["", _line(_header(table), printable(stream.why, 200)), _line(_pair("file", _from(folder, part.file)))]
    keys = {"topic": part.topic, "entity": part.entity, "where": dict(part.where)}
    lines += [_line(_pair(key, value)) for key, value in keys.items() if value]
    time: Any = {key: value for key, value in to_builtins(clock.time).items() if value}
    if set(time) <= {"column", "nanoseconds"}:
        time = list(time.values()) if clock.time.nanoseconds else clock.time.column
    lines.append(_line(_pair("time", time), clock.basis))
    return lines


def _columns(stream: Stream) -> list[str]:
    lines = list[str]()
    pose = _pose(stream)
    if pose and stream.attitude:
        lines.append(_line(_pair("pose", pose), "in m, and how it is turned"))
    for axis, signals in stream.axes.items() if not pose else ():
        columns: list[Any] = [_column(one) for one in signals]
        how = "DECIDE: unit " if signals[0].basis == "range" else "unit "
        lines.append(_line(_pair(axis, columns[0] if len(columns) == 1 else columns), how + BASES[signals[0].basis]))
    if stream.attitude and not pose:
        asked = "DECIDE: " if stream.attitude.doubt else ""
        every: dict[str, Any] = to_builtins(stream.attitude.columns)
        told = {key: value for key, value in every.items() if value and value != "xyzw"}
        lines.append(_line(_pair("orientation", told), f"{asked}{stream.attitude.basis}"))
    return lines


def _pose(stream: Stream) -> str:
    """Where a message has its whole pose, if its axes and its orientation are this; else empty."""
    columns = stream.attitude.columns.quaternion if stream.attitude else None
    if columns is None or tuple(stream.axes) != CARTESIAN:
        return ""
    whole, dot, word = columns[0].removesuffix(".x").rpartition(".")
    position = {("transform", "rotation"): "translation"}.get((whole, word), "position")
    is_pose = word == ("rotation" if whole == "transform" else "orientation")
    places = [[(f"{whole}{dot}{position}.{axis}", "m")] for axis in CARTESIAN]
    found = [[(one.column, one.unit) for one in signals] for signals in stream.axes.values()]
    turning = tuple(f"{whole}{dot}{word}.{part}" for part in "xyzw")
    return (whole or ".") if is_pose and places == found and turning == columns else ""


def _column(one: Signal) -> Any:
    """A column, with what its name does not say."""
    more = {} if ending(leaf(one.column)) == f"_{one.unit}" else {"unit": one.unit}
    more |= {"turn_deg": 360} if one.turns else {}
    more |= {"where": dict(one.where)} if one.where else {}
    return {"column": one.column, **more} if more else one.column


def _rebased(found: Survey, arm: ArmGuess, folder: Path) -> str:
    """The log's own ``run.toml`` for another folder; if it says of no axis where it starts, the sensors do."""
    tree: Any = {"name": found.name} | deepcopy(dict(found.manifest or {}))
    levels = {key: level for key, level in _levels(arm).items() if key.rpartition("_")[0] in tree["command"]}
    if levels:
        tree["command"].setdefault("start", levels)
    beside = found.log if found.log.is_dir() else found.log.parent
    for table in (tree["command"], tree.get("reference"), *tree.get("sensors", {}).values()):
        if table is not None:
            table["file"] = _from(folder, beside / table["file"])
    if "robot" in tree:
        tree["robot"]["urdf"] = _from(folder, beside / tree["robot"]["urdf"])
    return (
        f"# The log's own run.toml ({printable(str(beside))}), with its files named from here.\n{tomli_w.dumps(tree)}"
    )


def _arm_toml(found: Survey, arm: ArmGuess) -> str:
    lines = [
        "# The arm to begin with. `pumafuse tune --fit noise,delay,plant` finds better numbers; `gain` may be added.",
        f"name = {_value(found.name)}",
        _line(_pair("update_period_ms", _digits(arm.period * MS, 6)), "median time between commands"),
        _line(_pair("delay_ms", _digits(arm.delay * MS)), "a guess: 60 % of the shortest lag; the rest is the plant's"),
    ]
    for axis, one in arm.axes.items():
        lines += ["", _header(["axes", axis])]
        if one.kind == "angle":
            lines.append(_pair("kind", "angle"))
        known = f"with the delay {one.lag * MS:.0f} ms behind the held command, as {one.follows} is"
        lag = known if one.follows else "a guess: nothing follows this axis"
        lines += [_pair("plant", "first-order"), _line(_pair("time_constant_ms", _digits(one.time_constant * MS)), lag)]
        if one.follows and abs(one.gain - 1.0) > 0.05:
            why = f"{one.follows} moves {one.gain:.2f} times as far as commanded: try it, or tune --fit gain"
            lines.append(_line(f"# {_pair('gain', {'intercept': round(one.gain, 2)})}", why))
    return "\n".join([*lines, ""])


def _fusion_toml(found: Survey, arm: ArmGuess, sensors: Mapping[str, SensorGuess]) -> str:
    offsets = {axis: one.offset_sd for axis, one in arm.axes.items()}
    lines = [
        "# How far the arm and each sensor are trusted. `pumafuse tune` finds better numbers.",
        *(_pair("arm", "arm.toml"), "", _header(["start"])),
        *_by_kind("offset_sd", offsets, arm, "how far the arm may be from its command at the start"),
    ]
    for axis, one in arm.axes.items():
        unit, scale = SCREEN[one.kind].unit, SCREEN[one.kind].scale
        left = f"a guess: {_digits(one.misfit * scale)} {unit} are left where the command is delayed by the lag"
        lines += [
            "",
            _header(["process", axis]),
            _line(_pair(f"input_noise_{unit}_rtHz", _digits(one.input_noise * scale)), left),
            _line(_pair(f"drift_{unit}_rts", _digits(one.drift * scale)), "likewise"),
        ]
    if found.run.tool is not None:
        reference = [_digits(angle * DEG, 8) for angle in found.run.tool]
        lines += ["", _header(["tool"])]
        lines.append(_line(_pair("reference_rotation_vector_deg", reference), "the mean commanded orientation"))
    for name, one in found.own_frames.items():
        lines += ["", f"# Not used: {printable(name)} {one.words}", f"# {_header(['sensors', name])}"]
    for name, one in sensors.items():
        lines += ["", _header(["sensors", name])]
        lines += _by_kind("sd", one.sd, arm, "its scatter from one measurement to the next")
        lines.append(_line(_pair("latency_ms", _digits(one.latency * MS, 3)), one.latency_words))
        if one.latency_sd:
            lines.append(_line(_pair("latency_sd_ms", _digits(one.latency_sd * MS)), "by its rows and steps"))
        if one.scale < 0.0:
            lines.append(_line(_pair("scale", -1.0), "it moves against the commands, as a distance may"))
        if one.bias:
            lines += _by_kind("bias_sd", one.bias, arm, "its zero is another than the commands'")
        if one.turns:
            lines.append(_line(_pair("turn_deg", 360), "it measures within a turn"))
        lines.append(_line(_pair("gate", one.gate), "it has outliers" if one.gate else "it has no outliers: 0 is none"))
    return "\n".join([*lines, ""])


def _by_kind(key: str, values: Mapping[str, float], arm: ArmGuess, comment: str) -> Iterable[str]:
    for kind, screen in SCREEN.items():
        mine = {axis: _digits(value * screen.scale) for axis, value in values.items() if arm.axes[axis].kind == kind}
        if mine:
            yield f"# {comment}"
            yield _pair(f"{key}_{screen.unit}", mine)


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
    return f"[{'.'.join(_key(one) for one in table)}]"


def _pair(key: str, value: Any) -> str:
    return f"{_key(key)} = {_value(value)}"


def _key(key: str) -> str:
    return tomli_w.dumps({key: 0}).removesuffix(" = 0\n")


def _value(value: Any) -> str:
    """A value on one line; the library writes tables and lists over several."""
    if isinstance(value, Mapping):
        pairs = (_pair(key, one) for key, one in cast(Mapping[str, Any], value).items())
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_value(one) for one in cast(Sequence[Any], value))}]"
    return tomli_w.dumps({"v": value}).removeprefix("v = ").rstrip("\n")
