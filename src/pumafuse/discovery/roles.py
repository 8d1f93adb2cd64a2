"""Which part of a log is the commands, which are sensors, which is a reference; and which axis is which."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import count, permutations, product, takewhile
from typing import TypeAlias

import numpy as np
from msgspec import structs

from ..arrays import NO_STAMP, FloatArray
from ..errors import RunError, printable
from ..logs.axes import FARTHEST_TURN
from ..logs.columns import leaf
from ..logs.frames import CARTESIAN
from ..logs.recordings import PATH_TIME
from ..logs.run import REFERENCE, Run
from ..logs.source import Source
from ..units import AN, DEG, GUESSED, KINDS, TURN, Kind, kind_of
from . import names
from .contents import (
    ARE_SPEEDS,
    RANGES,
    RESTS,
    Part,
    Signal,
    is_nameless,
    no_commands,
    period_of,
    unused,
    usual_size,
)
from .following import ABOUT_ONE, LATEST, Following, following
from .matching import far_shift
from .names import Role
from .orientations import Attitude, in_order
from .own_frames import speeds_follow

_OF_POINT = 0.98  # correlation from which a joint moves one coordinate of a point alone, as a rail does
SAME = 0.8  # correlation of changes from which one signal follows another, and may be its axis under another name
_ALIKE, _LEVEL = 0.98, 0.1  # correlation of columns of one axis, and share of their range by which their ends differ
_GAINS = 3.0  # ratio of the gains of the axes of one sensor, at the most
_EVEN, _MOSTLY = 0.05, 0.9  # of a step, by which those of a clock differ, as it has digits; of the steps
_AT_ONCE = 0.002  # s, by which a signal must be late to say that it follows: two sensors move together
_TO_AND_FRO = 10  # turns at rest, from which they are noise: an arm that settles turns a few times
_AS_WELL = 1.5  # times what another explanation leaves: of a motion that swings, a lag of a quarter leaves noise, too
_OF_BODY = 4  # followers that nothing names, from which all may be points of one body, and none be commanded
_LEADS, _FOLLOWS, _SAY = "others follow it", "it follows the commands", "say it in run.toml"
_COPY = 0.9  # share of numbers that are the same, from which they are copies
_NEAR = -0.5, 1.5  # s, from and to which lag a sensor is on the commands' clock
MOST_LAG, GUESSED_LAG = 0.5, 0.1  # s, that hardly an arm is late; and that one is where its clock is shifted
_FEWEST = 20  # rows
_MOST_PAIRS, _MOST_CANDIDATES = 400, 12  # that are compared, at 0.1 s a pair of axes
_MOST_APART = 40  # axes of a table that is taken apart by their names
_MOST_LISTED, _LONGEST = 8, 200  # columns in an error, letters of all of them
_NUMBERED = re.compile(r"joint\d+|position")
_OF_POSE = {*CARTESIAN, "roll", "pitch", "yaw"}  # axes whose names say so much that only the same motion says more
_POSES_OF_JOINTS = "; of joints, [robot] in run.toml makes poses by a URDF"
_AXIS_WORD = re.compile(r"[xyz]|\d+|")
_Group: TypeAlias = tuple[str, str, str, bool]  # words of roles, list, copy, whether they are desired values


@dataclass(frozen=True)
class Stream:
    """A source of the run to be: columns of a part that belong together."""

    name: str
    role: Role | None  # what it is; None: its names do not say
    why: str  # how that is known; of what is neither, why not, if that is known
    part: Part
    axes: Mapping[str, Sequence[Signal]]  # for each axis its columns, which are added up
    attitude: Attitude | None = None  # its orientation, if it tells one

    @property
    def source(self) -> Source:
        """Its rows that have a value."""
        assert self.part.clock is not None
        values = {axis: np.sum([signal.value for signal in signals], axis=0) for axis, signals in self.axes.items()}
        turned = None if self.attitude is None else self.attitude.quaternion
        source = Source(self.part.clock.stamp, values, self.part.label, orientation=turned)
        if self.part.entity:
            source, _ = source.on_timeline()
        has_own_rows = any(signal.where for signals in self.axes.values() for signal in signals)
        return source.pivoted() if has_own_rows else source.rows(source.has_value)

    @property
    def turns(self) -> dict[str, float]:
        """The angle [rad] after which an axis begins anew, for each axis that does."""
        return {axis: TURN for axis, signals in self.axes.items() if any(signal.turns for signal in signals)}

    @property
    def guessed(self) -> bool:
        """Whether its units are a guess by their range."""
        return any(signal.basis == "range" for signals in self.axes.values() for signal in signals)

    def kind(self, axis: str) -> Kind:
        """Whether one of its axes is a length or an angle."""
        return kind_of(f"_{self.axes[axis][0].unit}") or "length"


class UndecidedError(RunError):
    """A log with these parts does not say what is commanded, or what measures; roles as far as they are known."""

    def __init__(self, log: str, why: str, parts: Sequence[Part], roles: Roles | None = None) -> None:
        super().__init__(f"{log}: {why}")
        self.parts, self.roles = parts, roles


@dataclass(frozen=True)
class Roles:
    """Who is who."""

    command: Stream
    sensors: Sequence[Stream]
    reference: Stream | None
    left_out: Sequence[tuple[Stream, str]]  # what is none of them, or not for these axes, and why

    @property
    def measured(self) -> dict[str, Stream]:
        """Its sensors, and ``reference``, by name."""
        streams = {sensor.name: sensor for sensor in self.sensors}
        return streams if self.reference is None else {**streams, REFERENCE: self.reference}

    @property
    def streams(self) -> list[Stream]:
        """The commands, and what measures."""
        return [self.command, *self.measured.values()]

    @property
    def run(self) -> Run:
        """The run as it would be read."""
        command = self.command.source
        sensors = {name: stream.source.beside(command, stream.turns) for name, stream in self.measured.items()}
        kinds: dict[str, Kind] = {axis: self.command.kind(axis) for axis in self.command.axes}
        reference = None if self.reference is None else sensors.pop(REFERENCE)
        return Run("log", command, sensors, reference, kinds=kinds)

    def without(self, why_not: Mapping[tuple[str, str], str]) -> Roles:
        """The roles without axes of sensors or ``reference``, and without axes that nothing measures then."""
        left_out, kept_streams = [*self.left_out], dict[str, Stream]()
        for name, stream in self.measured.items():
            bad = {axis: why_not[name, axis] for axis in stream.axes if (name, axis) in why_not}
            left_out += [(replace(stream, axes={axis: stream.axes[axis]}), why) for axis, why in bad.items()]
            if kept := {axis: signals for axis, signals in stream.axes.items() if axis not in bad}:
                kept_streams[name] = replace(stream, axes=kept)
        measured = {axis for stream in kept_streams.values() for axis in stream.axes}
        told = {axis: signals for axis, signals in self.command.axes.items() if axis in measured}
        if unmeasured := {axis: signals for axis, signals in self.command.axes.items() if axis not in measured}:
            left_out.append((replace(self.command, axes=unmeasured), "nothing measures where these commands lead"))
        reference = kept_streams.pop(REFERENCE, None) if self.reference else None
        return Roles(replace(self.command, axes=told), list(kept_streams.values()), reference, left_out)


def roles_of(parts: Iterable[Part], log: str) -> Roles:
    """Who is who among the parts of a log."""
    parts = list(parts)
    streams = [stream for part in parts for stream in streams_of(part)]
    if not streams:
        not_used = ", ".join(unused(parts)[:_MOST_LISTED])
        why = f"no columns of positions with a clock beside them{', but ' if not_used else ''}{not_used}"
        advice = f"{no_commands(parts)}say in run.toml where they are"
        if all(part.clock is None for part in parts):
            raise RunError(f"{log}: {why}; {advice}")
        raise UndecidedError(log, f"{why}; {advice}", parts)
    named = dict[str, Stream]()
    for apart_stream in _apart_by_name(streams[0]) if len(streams) == 1 else streams:
        name = _unused(apart_stream.name, named.keys())
        named[name] = replace(apart_stream, name=name)
    streams = _set_seen_targets(list(named.values()))
    if (chosen := _command(streams)) is None:
        raise UndecidedError(log, f"which numbers are the commands? {_none_leads(parts, streams)}", parts)
    command, why = chosen
    at_rest = [column for column, what in command.part.left_out.items() if what.startswith(RESTS)]
    resting = {*(names.axis_of(column, []) for column in at_rest), *(tuple(names.bare(column)) for column in at_rest)}
    left_out, kept = list[tuple[Stream, str]](), list[Stream]()
    for stream in (stream for stream in streams if stream is not command):
        if stream.role == "command" or (stream.role is None and stream.why):
            others = f"other commands than {printable(command.name)}: exchange the two in run.toml to use these"
            left_out.append((stream, others if stream.role else stream.why))
            continue
        stream = _on_one_clock(command, stream)
        axes, why_not = _matched(command, stream)
        if axes and _copies(command, replace(stream, axes=axes)):
            left_out.append((stream, "the same numbers as the commands, at the same time"))
            continue
        matched = replace(stream, axes={axis: axes[axis] for axis in command.axes if axis in axes})
        if stream.role is None and axes:
            called = [other for other in streams if other.role == "sensor" and other.part is stream.part]
            late, otherwise = _follows(command, matched, may_be_at_once=not _followers(command, called)[0])
            matched = replace(matched, role="sensor" if late else None, why=f"{_FOLLOWS} {late}")
            says = f"neither its name nor its motion says what it is: {otherwise}"
            why_not = f"{says}; if it measures their axes, say so in run.toml"
        if axes and matched.role:
            kept.append(matched)
            used = {id(some) for some in axes.values()}
            others = {axis: some for axis, some in stream.axes.items() if id(some) not in used}
            for held in (True, False):
                why_not = "its command never moves" if held else "no command is left that is called so or moves alike"
                if some := {
                    axis: columns
                    for axis, columns in others.items()
                    if resting.isdisjoint([axis, tuple(names.bare(columns[0].name))]) != held
                }:
                    left_out.append((replace(stream, axes=some), why_not))
        else:
            left_out.append((stream, another_clock(stream.source, command.source) or why_not))
    unnamed = [stream.name for stream in kept if stream.why.startswith(_FOLLOWS)]
    if why == _LEADS and len(unnamed) >= _OF_BODY:
        alike = f"{command.name}, {', '.join(unnamed)} move alike, as points of one body do"
        raise UndecidedError(log, f"which numbers are the commands? None is called so, and {alike}; {_SAY}", parts)
    may_measure = command.role != "reference"  # beside commands; another set point measures nothing
    command, *kept = _in_order([command, *_drop_copies(_drop_filtered(kept, left_out), left_out)], left_out)
    command, *kept = _renamed([replace(command, role="command", why=why), *kept])
    sensors = [stream for stream in kept if stream.role == "sensor"]
    references = [stream for stream in kept if stream.role == "reference"]
    left_out += [(stream, "a second reference") for stream in references[1:]]
    alone = references[:1] if may_measure and not sensors else []
    sensors += [replace(stream, role="sensor", why=f"{stream.why}, but nothing else measures") for stream in alone]
    references = [] if alone else references
    reports = [sensor for sensor in sensors if "reported" in sensor.name.split("_") and len(sensors) > 1]
    no_measurement = "what the controller itself reports: no measurement of where the tool is"
    left_out += [(report, no_measurement) for report in reports]
    sensors = [sensor for sensor in sensors if sensor not in reports]
    return _set_units(Roles(command, sensors, references[0] if references else None, left_out))


def told_as_speeds(roles: Roles) -> str:
    """A sentence where the commands are velocities, because their sum follows the measurements; empty elsewhere.

    What is left out is asked only where nothing measures: an integral of a controller adds up, too.
    """
    others = [stream for stream, _ in roles.left_out if stream.role != "command"]
    for stream in roles.measured.values() if roles.sensors else others:
        shared = [axis for axis in roles.command.axes if axis in stream.axes]
        if shared and all(_adds_up(roles.command, stream, axis) for axis in shared):
            columns = ", ".join(roles.command.axes[axis][0].column for axis in shared[:_MOST_LISTED])
            return f"{ARE_SPEEDS.format(columns)}: they add up to {stream.name}"
    return ""


def _adds_up(command: Stream, stream: Stream, axis: str) -> bool:
    """Whether the integral of the commands moves as far as a sensor, and the commands themselves do not."""
    (stamp, speed), measured = (side.source.series(axis) for side in (command, stream))
    steps = 0.5 * (speed[1:] + speed[:-1]) * np.diff(stamp) / 1e9
    summed = following((stamp, np.concatenate(([0.0], np.cumsum(steps)))), measured)
    if summed is None or summed.correlation < SAME or not -_AT_ONCE < summed.lag < MOST_LAG:
        return False
    leading = following((stamp, speed), measured)
    if leading is None or leading.correlation < SAME:
        return _as_far(summed)
    leads = leading.lag < MOST_LAG and _as_far(leading)
    return _as_far(summed) and not leads and summed.misfit < _AS_WELL * leading.misfit


def _as_far(relation: Following) -> bool:
    return 1.0 / ABOUT_ONE < relation.slope < ABOUT_ONE


def _none_leads(parts: Sequence[Part], streams: Sequence[Stream]) -> str:
    """Why none of the streams is the commands, and what to do."""
    what = [f"{printable(stream.part.label)}: {', '.join(list(stream.axes)[:_MOST_LISTED])}" for stream in streams]
    still = [
        f"{column}, {why}"
        for part in parts
        for column, why in part.left_out.items()
        if why.startswith(RESTS) and "command" in (names.column_role(column), names.role_of(part.stem))
    ]
    called = "None is called command, goal, target, desired, setpoint or action"
    called = f"What is called so never moves: {printable('; '.join(still[:3]), _LONGEST)}" if still else called
    listed = "; ".join([*what, *unused(part for part in parts if part.clock is None)[:_MOST_LISTED]])
    return f"{called}, and none runs ahead of others ({listed}); {no_commands(parts)}{_SAY}"


def _drop_filtered(streams: Sequence[Stream], left_out: list[tuple[Stream, str]]) -> list[Stream]:
    """Sources without the axes of filtered sensors whose raw measurements are in the log, too.

    What moves as far as another that alone is called raw was computed from it.
    """
    kept = list[Stream]()
    for stream in streams:
        column = next(iter(stream.axes.values()))[0].column
        beside = dict[str, str]()
        for other in streams if stream.role == "sensor" else ():
            raw, apart = next(iter(other.axes.values()))[0].column, stream.part.label != other.part.label
            texts = [f"{some.part.stem} {name}" if apart else name for some, name in ((stream, column), (other, raw))]
            filtered, not_raw = (names.has_word(text, names.FILTERED) for text in texts)
            beside_raw = [names.has_word(text, names.RAW) for text in texts] == [False, True]
            filtered = filtered or (beside_raw and _as_wide(stream, other))
            same = names.quantity(stream.part.stem, column) == names.quantity(other.part.stem, raw)
            if other.role == "sensor" and filtered and not not_raw and same:
                beside |= {axis: raw if not apart else other.part.label for axis in stream.axes if axis in other.axes}
        if beside:
            raw = ", ".join(map(printable, dict.fromkeys(beside.values())))
            why = f"{printable(column)} is not raw by its name: {raw} beside it is, and is the sensor"
            left_out.append((replace(stream, axes={axis: stream.axes[axis] for axis in beside}), why))
        if axes := {axis: some for axis, some in stream.axes.items() if axis not in beside}:
            kept.append(replace(stream, axes=axes))
    return kept


def _as_wide(stream: Stream, other: Stream) -> bool:
    """Whether the axes that two have cover ranges of the same size, apart from their ends."""
    both = [(stream.source.values[axis], other.source.values[axis]) for axis in stream.axes if axis in other.axes]
    widths = [[float(np.subtract(*np.nanquantile(value, [0.95, 0.05]))) for value in pair] for pair in both]
    return all(1.0 / ABOUT_ONE < width / max(raw, 1e-12) < ABOUT_ONE for width, raw in widths)


def _drop_copies(streams: Sequence[Stream], left_out: list[tuple[Stream, str]]) -> list[Stream]:
    """Sources without sensors that repeat the numbers of another one in their table: they measure nothing anew."""
    kept = list[Stream]()
    for stream in streams:
        beside = [other for other in kept if other.part.label == stream.part.label]
        alike = [other for other in beside if stream.role == other.role == "sensor"]
        again = (other for other in alike if stream.axes.keys() <= other.axes.keys() and _copies(other, stream))
        if (first := next(again, None)) is None:
            kept.append(stream)
        else:
            left_out.append((stream, f"the same numbers as {printable(first.name)}, at the same time"))
    return kept


def _in_order(streams: Sequence[Stream], left_out: list[tuple[Stream, str]]) -> list[Stream]:
    """The commands and other streams, with w of each quaternion at the end at which they turn alike."""
    command, *others = streams
    reference = next((other for other in others if other.attitude and not other.attitude.is_open), None)
    if command.attitude and command.attitude.is_open and reference is not None:
        command = replace(command, attitude=_ordered(command, reference, leads=True))
    for number, other in enumerate(others):
        if command.attitude and not command.attitude.is_open and other.attitude and other.attitude.is_open:
            others[number] = replace(other, attitude=_ordered(other, command, leads=False))
    if command.attitude and command.attitude.farthest > FARTHEST_TURN:
        far = f"the tool is told to turn by {command.attitude.farthest * DEG:.0f}° from its mean orientation: too far"
        left_out.append((replace(command, axes={}), far))
        command = replace(command, attitude=None)
    return [command, *others]


def _ordered(stream: Stream, reference: Stream, *, leads: bool) -> Attitude:
    assert stream.attitude and reference.attitude and stream.part.clock and reference.part.clock
    stamp, theirs = stream.part.clock.stamp, reference.part.clock.stamp
    return in_order(stream.attitude, stamp, reference.attitude, theirs, leads=leads)


def relations(run: Run) -> dict[tuple[str, str], Following]:
    """How each sensor, and ``reference``, follows the commands, by its name and the axis."""
    told = {axis: (run.command.stamp, value) for axis, value in run.command.values.items()}
    return {
        (name, axis): relation
        for name, source in run.measured.items()
        for axis, value in source.values.items()
        if axis in told and (relation := following(told[axis], (source.stamp, value), is_moved=True)) is not None
    }


def another_clock(source: Source, command: Source) -> str:
    """A sentence on a source whose stamps all precede or all follow those of the commands; empty for others."""
    stamps, theirs = (rows.stamp[rows.stamp != NO_STAMP] / 1e9 for rows in (source, command))
    if len(stamps) and len(theirs) and (stamps.max() < theirs.min() or stamps.min() > theirs.max()):
        return (
            f"its stamps ({stamps.min():.3f} to {stamps.max():.3f} s) are not of the commands' time"
            f" ({theirs.min():.3f} to {theirs.max():.3f} s): name a clock that both have (run.toml, time)"
        )
    return ""


def _on_one_clock(command: Stream, stream: Stream) -> Stream:
    """A stream whose clock is shifted to that of the commands, with a question, where unshifted it follows nothing.

    On one clock it stays as it is: of a motion that repeats itself the lag may be a period longer, which is asked.
    How late it follows is the difference of the clocks and the arm's lag together. Where both begin, or end, at once,
    or differ by whole hours, that difference is known; else the lag is not.
    """
    told, source = command.source, stream.source
    axes = [axis for axis in stream.axes if axis in command.axes and _same_kind(command, axis, stream, axis)]
    clock, other = command.part.clock, stream.part.clock
    if not axes or clock is None or other is None:
        return stream
    led, measured = ({axis: rows.series(axis) for axis in axes} for rows in (told, source))
    if min(len(stamp) for stamp, _ in (*led.values(), *measured.values())) < _FEWEST:
        return stream
    if (late := far_shift(led, measured, _NEAR)) is None:
        return stream
    if clock.time == other.time and command.part.file == stream.part.file:
        doubt = (
            f"is {stream.name} {late:.1f} s late? That explains its motion far better than a lag up to {_NEAR[1]:g} s:"
            f" one that repeats itself looks alike a period sooner. If so, add shift_s = {GUESSED_LAG - late:.1f} to"
            f" its time (run.toml); what is left of the lag, {GUESSED_LAG * 1e3:.0f} ms, is a guess"
        )
        return replace(stream, part=replace(stream.part, clock=replace(other, doubt=doubt)))
    (begun, ended), (begins, ends) = (
        (min(int(at[0]) for at, _ in rows.values()), max(int(at[-1]) for at, _ in rows.values()))
        for rows in (led, measured)
    )
    hours = round(late / 3600.0) * 3600.0
    known_shifts = {"both begin at once": (begins - begun) / 1e9, "both end at once": (ends - ended) / 1e9}
    known_shifts |= {"time zones are hours apart": hours} if hours else {}
    why, ahead = next(
        ((words, by) for words, by in known_shifts.items() if 0.0 <= late - by < MOST_LAG),
        ("the lag is a guess: nothing tells what of it is the clock's", late - GUESSED_LAG),
    )
    side = "ahead of" if ahead > 0.0 else "behind"
    doubt = (
        f"is the clock of {stream.name} {abs(ahead):.3f} s {side} the commands'? So shifted (shift_s in run.toml) it"
        f" follows them {(late - ahead) * 1e3:.0f} ms late, as {why}; as stamped, {late:.3f} s"
    )
    shifted = replace(
        other,
        time=structs.replace(other.time, shift=-ahead),
        basis=f"{other.basis}, shifted",
        stamp=np.where(other.stamp == NO_STAMP, NO_STAMP, other.stamp - round(ahead * 1e9)),
        doubt=doubt,
    )
    return replace(stream, part=replace(stream.part, clock=shifted))


def streams_of(part: Part) -> list[Stream]:
    """The columns of a part as streams: names of roles, lists and copies tell streams apart."""
    if part.clock is None:
        return []
    groups: dict[_Group, list[Signal]] = {}
    beside = {names.last(column) for column in (*(signal.column for signal in part.signals), *part.left_out)}
    for signal in part.signals:
        called = _as_name(names.role_words(signal.name))
        listed, copy, measured = names.family(signal.column, beside)
        if copy or measured:
            signal = replace(signal, axis=names.axis_of(measured or signal.column.removesuffix(copy), []))
        groups.setdefault((called, listed, copy, bool(measured)), []).append(signal)
    groups = {key: some for group in groups.items() for key, some in _repeated_apart(*group)}
    roles = Counter(key for key, *_ in groups)
    told = {signal.axis for some in groups.values() for signal in some if names.column_role(signal.name) == "command"}
    of_file, of_columns = names.role_of(part.stem), {names.column_role(group[0].name) for group in groups.values()}
    of_file = None if len(groups) > 1 and of_file in of_columns else of_file  # then it is what these columns are
    streams, clock = list[Stream](), part.clock.time.column
    of_type: Role | None = "command" if part.type.endswith("JointTrajectory") or clock == PATH_TIME else None
    of_type = "sensor" if part.type.endswith("JointState") else of_type
    by_file, by_type = (of_file, f"it is called '{printable(part.stem)}'"), (of_type, f"its messages are {part.type}")
    by_clock = (names.column_role(clock), f"its clock is called '{printable(clock)}'")
    for (key, listed, copy, desired), signals in groups.items():
        wanted = ("command" if desired else None, f"'{signals[0].column}' is of desired values, by its name")
        by_column = (names.column_role(signals[0].name), f"its columns are called '{key.replace('_', ' ')}'")
        order = (by_column, by_file) if len(groups) > 1 else (by_file, by_column)
        role, why = next((choice for choice in (wanted, *order, by_clock, by_type) if choice[0]), (None, ""))
        name = key if roles[key] == 1 else names.identifier(f"{listed or key or part.stem}{copy}")
        # What has no word of its own beside commands is not called after the file: another of its kind fits then.
        beside_commands = roles.keys() > {""} and "command" in of_columns
        prefix = _prefix(signals, told, roles.keys()) if beside_commands else names.identifier(part.stem)
        name = name if len(groups) > 1 and name else prefix
        axes, attitude = _axes(signals), None
        if any(axis in CARTESIAN for axis in axes):
            attitude = next((attitude for attitude in part.attitudes if key == _as_name(attitude.role_words)), None)
        streams.append(Stream(name or "log", role, why, part, axes, attitude))  # pyright: ignore[reportArgumentType]
    return streams


def _prefix(signals: Sequence[Signal], told: Set[str], taken: Set[str]) -> str:
    """The name of columns beside commands: what all of them have in front of commanded axes, else ``measured``."""
    prefixes = {signal.axis.removesuffix(axis) for signal in signals for axis in told if _ends_with(signal.axis, axis)}
    return names.identifier(prefixes.pop()) if len(prefixes) == 1 and prefixes != {""} else _unused("measured", taken)


def _repeated_apart(key: _Group, signals: Sequence[Signal]) -> Iterator[tuple[_Group, list[Signal]]]:
    """A group of columns, and apart from it those that repeat its axes under another word: ``x_poses`` beside ``x``."""
    by_words = dict[tuple[str, ...], list[Signal]]()
    for signal in signals:
        silent = [word for word in names.words(leaf(signal.column)) if word not in names.words(signal.axis)]
        by_words.setdefault(tuple(silent), []).append(signal)
    first = max(by_words.values(), key=len)
    axes, apart = {signal.axis for signal in first}, dict[tuple[str, ...], list[Signal]]()
    for words, some in by_words.items():
        is_again = some is not first and len(some) > 1 and axes.issuperset(signal.axis for signal in some)
        if is_again and words and names.PARTS.isdisjoint(words):
            apart[words] = some
    taken = {id(signal) for some in apart.values() for signal in some}
    yield key, [signal for signal in signals if id(signal) not in taken]
    for words, some in apart.items():
        yield (key[0], _as_name(words), *key[2:]), some


def _as_name(words: Iterable[str]) -> str:
    """Words of roles as a name, each once."""
    return "_".join(dict.fromkeys(words))


def _axes(signals: Sequence[Signal]) -> dict[str, list[Signal]]:
    """Columns by axis: parts of a sum share their axis, and an axis whose name is taken gets a number."""
    by_axis: dict[str, list[Signal]] = {}
    for signal in signals:
        parts = {axis for axis, some in by_axis.items() if names.has_word(some[0].name, names.PARTS)}
        summed = parts if names.has_word(signal.name, names.PARTS) else set[str]()
        by_axis.setdefault(_unused(signal.axis, by_axis.keys() - summed), []).append(signal)
    return {
        axis: some
        for axis, some in by_axis.items()
        if any(np.nanmin(signal.plain) < np.nanmax(signal.plain) for signal in some)
    }


def _apart_by_name(stream: Stream) -> list[Stream]:
    """The only stream of a log, split by words in the names of its axes where one half then runs ahead of another.

    ``a_x`` and ``b_x``, ``q_d_0`` and ``q_0``, ``xd`` and ``x``; but words like x, y, z and numbers are axes.
    """
    by_word: dict[str, dict[tuple[str, ...], str]] = {"": {}}
    for axis in stream.axes if len(stream.axes) <= _MOST_APART else ():
        whole = tuple(axis.split("_"))
        if axis[-1:] == "d" and axis[:-1] in stream.axes:  # desired
            whole = axis[:-1], "d"
        by_word[""][whole] = axis
        for number, word in enumerate(whole):
            by_word.setdefault(word, {})[whole[:number] + whole[number + 1 :]] = axis

    def of(word: str, rests: Iterable[tuple[str, ...]]) -> Stream:
        axes = {names.axis_of("_".join(words_left), []): stream.axes[by_word[word][words_left]] for words_left in rests}
        others = frozenset(other for other in by_word if not _AXIS_WORD.fullmatch(other))

        def has_word(attitude: Attitude) -> bool:  # in its names; without a word, none of the others
            inside = names.words(attitude.columns.columns[0])
            return word in inside if word else others.isdisjoint(inside)

        attitude = next(filter(has_word, stream.part.attitudes), None)
        return Stream(names.identifier(word) or stream.name, None, "", stream.part, axes, attitude)

    ways = list[list[Stream]]()
    for word, axes_of_word in by_word.items():
        shared = {
            other: rests
            for other, words_left in by_word.items()
            if (rests := sorted(axes_of_word.keys() & words_left.keys())) and _tells_apart(word, other, rests, stream)
        }
        if shared:
            every = sorted(set[tuple[str, ...]]().union(*shared.values()))
            ways.append([of(word, every), *(of(other, rests) for other, rests in shared.items())])
    best = max(ways, key=lambda way: _followers(way[0], way), default=[stream])
    return best if len(best) > 1 and _followers(best[0], best)[0] else _apart_by_motion(stream)


def _apart_by_motion(stream: Stream) -> list[Stream]:
    """A stream of columns without names, taken apart where some follow others: as far, at the same level, later.

    Or at once, and noisier. Of two alone one may follow less closely, as no other could be taken for it. Where
    velocities tell which columns are positions, pairs without any of these are something else, as motor currents.
    """
    source, columns = stream.source, list(stream.axes)
    signals = [signal for some in stream.axes.values() for signal in some]
    if len(columns) > _MOST_APART or not stream.part.clock or not is_nameless(signals, stream.part.clock):
        return [stream]
    leads = dict[str, dict[str, float]]()  # of those that follow it, how late they do
    levels = {axis: np.array([value.min(), value.mean(), value.max()]) for axis, value in source.values.items()}
    alike = SAME if len(columns) == 2 else _ALIKE
    for leader, other in permutations(columns, 2):
        if np.abs(levels[leader] - levels[other]).max() > _LEVEL * np.ptp(levels[other]):
            continue
        relation = following((source.stamp, source.values[leader]), (source.stamp, source.values[other]))
        if relation is None or relation.correlation <= alike or not -_AT_ONCE < relation.lag < MOST_LAG:
            continue
        if relation.lag > _AT_ONCE or _stands_beside(source.values[leader], source.values[other]):
            leads.setdefault(leader, {})[other] = relation.lag
    followers = {other for followed in leads.values() for other in followed}
    pairs = dict[str, str]()
    for leader in (axis for axis in leads if axis not in followers):
        free = {other: lag for other, lag in leads[leader].items() if other not in pairs.values()}
        if free:
            pairs[leader] = min(free, key=free.__getitem__)
    paired, positions = {*pairs, *pairs.values()}, {axis for axis, some in stream.axes.items() if some[0].has_velocity}
    if not pairs or (positions and positions.isdisjoint(paired)):
        return [stream]
    beside = {other for leader in pairs for other in leads[leader]} - paired
    told = {leader: stream.axes[leader] for leader in pairs}
    seen = {leader: stream.axes[other] for leader, other in pairs.items()}
    again = {axis: stream.axes[axis] for axis in columns if axis in beside}
    others = {axis: some for axis, some in stream.axes.items() if axis not in paired | beside}
    every = (
        Stream("commanded", "command", "others follow it as far, later or noisier", stream.part, told),
        *(Stream("measured", None, "", stream.part, axes) for axes in (seen, again)),
        Stream("others", None, "they follow nothing as far, at the same level", stream.part, others),
    )
    return [of_log for of_log in every if of_log.axes]


def _stands_beside(told: FloatArray, seen: FloatArray) -> bool:
    """Whether, in the longest rest of a signal, another goes to and fro: what is commanded stands, its sensor is noisy.

    An encoder of coarse counts stands, too, but where its commands go on one way.
    """
    changes = np.flatnonzero(np.concatenate(([True], np.diff(told) != 0.0, [True])))
    longest = int(np.argmax(np.diff(changes)))
    steps = np.diff(seen[changes[longest] : changes[longest + 1]])
    return bool(np.count_nonzero(np.diff(np.sign(steps[steps != 0.0]))) >= _TO_AND_FRO)


def _tells_apart(word: str, other: str, rests: Sequence[tuple[str, ...]], stream: Stream) -> bool:
    """Whether two words in names of axes, of which the rests are the same, can be of commands and a sensor."""
    if word == other or (_AXIS_WORD.fullmatch(word) and _AXIS_WORD.fullmatch(other)):
        return False
    return rests != [()] or (len(stream.axes) == 2 and not any(map(names.is_turning, (word, other))))


def _set_seen_targets(streams: Sequence[Stream]) -> list[Stream]:
    """Streams in which one called target is a sensor where it follows another stream that has no role by name."""
    looked_at = list[Stream]()
    for stream in streams:
        called = [stream.part.stem, *(signal.column for signals in stream.axes.values() for signal in signals)]
        seen = stream.role == "command" and any(names.says_only(names.SEEN, [name]) for name in called)
        unnamed = [stream for stream in streams if seen and stream.role is None]
        fewest = 0.5 * len(stream.axes) if len(stream.axes) > len(CARTESIAN) else 0.0  # in space one, or its speed
        led = [nameless for nameless in unnamed if _followers(nameless, [replace(stream, role=None)])[0] > fewest]
        if seen and led:
            why = f"it is called target, but follows '{printable(led[0].name)}': it is what a sensor looks at"
            stream = replace(stream, role="sensor", why=why)
        looked_at.append(stream)
    return looked_at


def _unused(name: str, taken: Set[str]) -> str:
    """A name, with a number where it is taken: ``x``, ``x_2``."""
    numbered = (name if number == 1 else f"{name}_{number}" for number in count(1))
    return next(candidate for candidate in numbered if candidate not in taken)


def _command(streams: Sequence[Stream]) -> tuple[Stream, str] | None:
    """The commands, and how they are known: by name, and of several by what follows them; without names by that.

    Inputs drive a plant beside other commands, and where nothing follows them and others lead without a name.
    """
    inputs = [stream for stream in streams if stream.role == "command"]
    called = [cmd for cmd in inputs if not names.says_only(names.DRIVES, (some[0].name for some in cmd.axes.values()))]
    if len(called) == 1:
        return called[0], called[0].why
    is_input, called = not called, called or inputs
    # A reference that runs ahead, or that stands beside one other alone, is a set point, as control engineers call it.
    beside = [stream for stream in streams if stream.role != "reference"]
    if not called and len(streams) == 2 and len(beside) == 1:
        (set_point,) = (stream for stream in streams if stream.role == "reference")
        return set_point, f"{set_point.why}, and one other alone is beside them: a set point"
    candidates = (called or [stream for stream in streams if stream.role != "sensor"])[:_MOST_CANDIDATES]
    followers = {candidate.name: _followers(candidate, streams) for candidate in candidates}
    best = max(candidates, key=lambda candidate: followers[candidate.name], default=None)
    if best is None or (not called and not followers[best.name][0]):
        return None
    if called and is_input and not followers[best.name][0]:
        return _command([stream for stream in streams if stream.role != "command"]) or (best, best.why)
    return best, best.why or _LEADS


def _followers(leader: Stream, streams: Sequence[Stream]) -> tuple[float, float, float]:
    """How many axes of others run behind a stream, each as far as its motion is the same.

    Then by what factors they move less or more, in all, as a logarithm below 0, as they do of what set points are
    scaled from; and by how much they run behind, in all [s].

    Less than half a row is at once, and what is later than an arm counts where names say that it is commanded. Where
    these are most axes, the others only seem late, as two bodies in one frame do that turn.
    """
    count = scaled = late = 0.0
    latest = LATEST if leader.role == "command" else MOST_LAG
    for other in streams:
        if other is not leader and other.role != "command":
            axes, _ = _matched(leader, other)
            relations = _relations(leader, replace(other, axes=axes))
            if not any(abs(relation.correlation) >= SAME for relation in relations):
                relations = list(filter(None, [speeds_follow(leader.source, other.source)]))
            alike = [relation for relation in relations if abs(relation.correlation) >= SAME]
            at_once = max(_AT_ONCE, 0.5 * period_of(other.source))
            behind = [relation for relation in alike if at_once < relation.lag < latest]
            # Units are said, or those of one table: it goes as far.
            if leader.role != "command" and (leader.part is other.part or not (leader.guessed or other.guessed)):
                behind = list(filter(_as_far, behind))
            if 2 * len(behind) >= len(alike):
                count += sum(abs(relation.correlation) for relation in behind)
                scaled -= sum(abs(math.log(abs(relation.slope))) for relation in behind)
                late += sum(relation.lag for relation in behind)
    return round(count, 1), round(scaled), late


def _follows(command: Stream, stream: Stream, *, may_be_at_once: bool) -> tuple[str, str]:
    """By how much a stream that nothing names follows the commands, in words; empty if it does not, and why not."""
    if all(_rises_evenly(value) for value in stream.source.values.values()):
        return "", "it rises evenly, as a clock does"
    command = _set_units_by_range(command, {*command.axes}) if stream.guessed else _set_units_by_travel(command, stream)
    relations = _relations(command, _set_units_by_travel(stream, command))
    alike = [relation for relation in relations if relation.correlation >= SAME]
    soonest = -_AT_ONCE if may_be_at_once else 0.5 * period_of(stream.source)  # else it is the commands again
    behind = [relation for relation in alike if soonest < relation.lag < LATEST]
    gains, fewest = [relation.slope for relation in behind], len(relations) / 2
    fewest = 0.0 if _is_namesake(command, stream) else fewest
    called = [(axis, signal) for axis, some in stream.axes.items() for signal in some]
    is_open = all(signal.axis == axis and signal.basis == "range" for axis, signal in called)  # a unit that nobody says
    is_open = is_open and not any(names.number_of_nameless(signal.column) for _, signal in called)
    as_far = is_open or 1.0 / _GAINS < float(np.median(gains or 1.0)) < _GAINS
    if len(behind) > fewest and as_far and max(gains) < _GAINS * min(gains):
        return f"{float(np.median([relation.lag for relation in behind])) * 1e3:.0f} ms late", ""
    speeds = speeds_follow(command.source, stream.source)
    if speeds is not None and speeds.correlation >= SAME and soonest < speeds.lag < LATEST:
        return f"{speeds.lag * 1e3:.0f} ms late, by its speed", ""
    most, least = (end((relation.correlation for relation in relations), default=0.0) for end in (max, min))
    if not alike and least <= -SAME:
        return "", f"it moves against the commands (correlation {least:+.2f}), as errors do, or a sensor of scale -1"
    if not alike:
        return "", f"it does not follow the commands (correlation {most:+.2f} at most)"
    if len(behind) < len(alike):
        early = float(np.median([-relation.lag for relation in alike if relation not in behind]))
        when = f"{early * 1e3:.0f} ms before" if early > _AT_ONCE else f"{-early:.3f} s behind"
        return "", f"it does not follow the commands: it moves {when} them"
    few = f"it follows the commands on {len(behind)} of {len(relations)} axes"
    return "", few if len(behind) <= fewest else f"{few}, but by {min(gains):.3g} to {max(gains):.3g} times as far"


def _rises_evenly(value: FloatArray) -> bool:
    """Whether numbers rise in each row, and mostly by the same: no sensor of a position does."""
    steps = np.diff(value)
    even = np.abs(steps / np.median(steps) - 1.0) < _EVEN if len(steps) and steps.min() > 0.0 else np.zeros(1)
    return bool(even.mean() > _MOSTLY)


def _is_namesake(command: Stream, stream: Stream) -> bool:
    """Whether columns are called as those of the commands without a word of these: ``q[0]`` beside ``q_cmd[0]``."""
    shared = stream.axes.keys() & command.axes.keys()
    both = [[side.axes[axis][0] for side in (stream, command)] for axis in shared]
    return bool(both) and all(
        names.bare(first.name) == names.bare(other.name) and not names.number_of_nameless(first.column)
        for first, other in both
    )


def _copies(other: Stream, stream: Stream) -> bool:
    """Whether a stream repeats the numbers of another at the same instants, also where these change."""
    told, source = other.source, stream.source
    order = np.argsort(told.stamp, kind="stable")
    rows = np.searchsorted(told.stamp[order], source.stamp, side="right") - 1
    return all(
        float(np.mean(np.isclose(value, now, rtol=1e-9, atol=0.0)[np.append(True, np.diff(now) != 0.0)])) > _COPY
        for axis, value in source.values.items()
        if len(now := told.values[axis][order][rows])
    )


def _relation(leader: Stream, axis: str, follower: Stream, other: str) -> Following | None:
    first, second = leader.source, follower.source
    return following((first.stamp, first.values[axis]), (second.stamp, second.values[other]))


def _relations(leader: Stream, follower: Stream) -> list[Following]:
    shared = [axis for axis in follower.axes if axis in leader.axes]
    return [relation for axis in shared if (relation := _relation(leader, axis, follower, axis)) is not None]


def _matched(command: Stream, stream: Stream) -> tuple[dict[str, Sequence[Signal]], str]:
    """Axes of a stream by the names that the commands give them, by name or else by how they move; or why none is."""
    fits = {axis: signals for axis, signals in stream.axes.items() if axis in command.axes}
    fits = {axis: signals for axis, signals in fits.items() if _same_kind(command, axis, stream, axis)}
    few, told = len(command.axes) * len(stream.axes) <= _MOST_PAIRS, _without_shared_words(command.axes)
    others = [axis for axis in stream.axes if axis not in fits and axis not in command.axes]
    free = [axis for axis in command.axes if axis not in fits]
    named = {(name, axis) for name, axis in product(others, free) if _ends_with(name, told[axis])}  # as p_RS_R_x is x
    # Of joints names tell enough; coordinates may be another frame's.
    few = few and not (_OF_POSE.isdisjoint(told.values()) and {axis for _, axis in named} == {*free})
    follows = dict[tuple[str, str], float]()
    for name, axis in product(others, free):
        may_be = (few or (name, axis) in named) and _same_kind(command, axis, stream, name)
        if may_be and (relation := _relation(command, axis, stream, name)) is not None:
            follows[name, axis] = relation.correlation
    if not fits and (point := _turned_point(command, stream, follows)):
        return point, ""
    pairs = {pair: abs(correlation) for pair, correlation in follows.items()}
    points = [name for name in others if name in _OF_POSE]
    least = {name: _OF_POINT if name in points and len(points) > 1 else SAME for name in others}
    for name, axis in sorted(pairs, key=lambda pair: (pair in named, pairs[pair]), reverse=True):
        if pairs[name, axis] >= least[name] and axis not in fits and name in others:
            fits[axis] = stream.axes[name]
            others.remove(name)
    in_space = [{*CARTESIAN} <= sides.axes.keys() for sides in (command, stream)]
    few_joints = min(len(command.axes), len(stream.axes)) < len(CARTESIAN)
    poses = "" if in_space[0] == in_space[1] or few_joints else _POSES_OF_JOINTS
    if fits or not pairs:
        kinds = sorted({AN[stream.kind(axis)] for axis in stream.axes})
        none = f"none of the commands that were taken is {' or '.join(kinds)}, as {', '.join(stream.axes)} are{poses}"
        many = f"no axis is called as one of the commands', and {len(others)} are too many to compare how they move"
        return fits, none if few else many
    most = max(pairs, key=pairs.__getitem__)
    alike = f"at most {pairs[most]:.2f}, {most[1]}"
    return fits, f"its axes are called otherwise than the commands', and follow none ({alike}){poses}"


def _turned_point(
    command: Stream, stream: Stream, follows: Mapping[tuple[str, str], float]
) -> dict[str, Sequence[Signal]]:
    """Three columns as x, y and z, in their order, that are as fast as the commanded point and follow it in no order.

    Columns of a frame that is turned, each called after what it follows best, would be mirrored.
    """
    moving = [axis for axis in stream.axes if stream.source.travel(axis) > 0.0]
    if len(moving) != len(CARTESIAN) or not {*CARTESIAN} <= command.axes.keys():
        return {}
    orders = (zip(order, CARTESIAN, strict=True) for order in permutations(moving))
    if any(all(follows.get(pair, 0.0) >= SAME for pair in order) for order in orders):
        return {}
    point = {axis: stream.axes[name] for axis, name in zip(CARTESIAN, moving, strict=True)}
    speeds = speeds_follow(command.source, replace(stream, axes=point).source)
    return {} if speeds is None or speeds.correlation < SAME else point


def _ends_with(axis: str, words: str) -> bool:
    """Whether the name of an axis ends with some words."""
    return f"_{axis}".endswith(f"_{words}")


def _without_shared_words(axes: Iterable[str]) -> dict[str, str]:
    """Axes without the words that all of them begin with: ``left_arm_wrist``, ``left_arm_elbow`` are wrist, elbow."""
    apart = {axis: axis.split("_") for axis in axes}
    places = zip(*(words[:-1] for words in apart.values()), strict=False)
    shared = sum(1 for _ in takewhile(lambda alike: len({*alike}) == 1, places))
    return {axis: "_".join(words[shared:]) for axis, words in apart.items()}


def _same_kind(command: Stream, axis: str, stream: Stream, other: str) -> bool:
    """Whether the units of two axes allow them to be the same axis."""
    both = (*command.axes[axis], *stream.axes[other])
    return command.kind(axis) == stream.kind(other) or any(signal.basis == "range" for signal in both)


def _renamed(streams: Sequence[Stream]) -> list[Stream]:
    """Streams whose axes have the names that the first other stream gives them where the commands only number them."""
    command, *others = streams
    called = {axis: other.axes[axis][0].axis for other in reversed(others) for axis in other.axes}
    free = {axis: name for axis, name in called.items() if _NUMBERED.fullmatch(axis) and name not in command.axes}
    free = {} if len(set(free.values())) < len(free) else free
    return [
        replace(stream, axes={free.get(axis, axis): some for axis, some in stream.axes.items()}) for stream in streams
    ]


def _set_units(roles: Roles) -> Roles:
    """Roles whose guessed units make commands and measurements move equally far, one unit a kind and source."""
    command, reference = _kinds_by_name(roles), roles.reference
    others = [sensor for sensor in (reference, *reversed(roles.sensors)) if sensor is not None]
    sure = [other for other in others if not other.guessed]
    for sensor in sure:  # the first sensor has the last word
        command = _set_units_by_travel(command, sensor)
    if not sure:
        command = _set_units_by_range(command, {axis for other in others for axis in other.axes})
    sensors = [_set_units_by_travel(sensor, command) for sensor in roles.sensors]
    reference = None if reference is None else _set_units_by_travel(reference, command)
    return replace(roles, command=command, sensors=sensors, reference=reference)


def _kinds_by_name(roles: Roles) -> Stream:
    """The commands, in radians on axes that only the names of their sensors call angles, in metres on numbered ones.

    An axis that is only numbered would be a joint; as x, y or z of its sensors it is none.
    """
    axes = dict(roles.command.axes)
    for axis, signals in roles.command.axes.items():
        seen = [some for stream in roles.measured.values() for some in stream.axes.get(axis, ())]
        turning = [some for some in seen if names.turns(some.column, some.axis) and kind_of(f"_{some.unit}") == "angle"]
        if turning and signals[0].basis == "range" and roles.command.kind(axis) == "length":
            axes[axis] = _set_guessed_unit(signals, "_rad")
        in_space = [some for some in seen if some.axis in CARTESIAN and kind_of(f"_{some.unit}") == "length"]
        if in_space and _NUMBERED.fullmatch(signals[0].axis):
            axes[axis] = _set_guessed_unit(signals, "_m")
    return replace(roles.command, axes=axes)


def _set_units_by_range(stream: Stream, measured: Set[str]) -> Stream:
    """A stream whose guessed units are the likeliest for the range of those of its axes that are measured."""
    axes = dict(stream.axes)
    for kind in KINDS:
        small, large, most = RANGES[kind]
        of_kind = {axis: signals for axis, signals in stream.axes.items() if stream.kind(axis) == kind}
        plain = [
            signal.plain for axis in of_kind.keys() & measured for signal in of_kind[axis] if signal.basis == "range"
        ]
        unit = large if max(map(usual_size, plain), default=0.0) > most else small
        axes |= {axis: _set_guessed_unit(signals, unit) for axis, signals in of_kind.items()} if plain else {}
    return replace(stream, axes=axes)


def _set_units_by_travel(stream: Stream, anchor: Stream) -> Stream:
    """A stream whose guessed units, one of each kind, are those in which it moves as far as another."""
    made, anchored = dict(stream.axes), anchor.source
    shared = [axis for axis in anchor.axes if axis in made and any(signal.basis == "range" for signal in made[axis])]
    for kind in KINDS:
        axes = [axis for axis in shared if anchor.kind(axis) == kind]
        if not axes:
            continue

        def misfit(unit: str, of_kind: Sequence[str] = axes) -> float:
            moved = replace(stream, axes={axis: _set_guessed_unit(stream.axes[axis], unit) for axis in of_kind}).source
            ratios = [max(moved.travel(axis), 1e-12) / max(anchored.travel(axis), 1e-12) for axis in of_kind]
            return abs(float(np.median(np.log(ratios))))

        told = dict.fromkeys(f"_{signal.unit}" for axis in axes for signal in anchor.axes[axis])  # maybe cm
        unit = min((*told, *GUESSED[kind]), key=misfit)
        made |= {axis: _set_guessed_unit(made[axis], unit) for axis in axes}
    return replace(stream, axes=made)


def _set_guessed_unit(signals: Sequence[Signal], unit: str) -> list[Signal]:
    return [replace(signal, unit=unit.removeprefix("_")) if signal.basis == "range" else signal for signal in signals]
