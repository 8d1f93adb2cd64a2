"""Which part of a log is the commands, which are sensors, which is a reference; and which axis is which."""

from __future__ import annotations

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
from ..logs.run import REFERENCE, Run, Source
from ..units import AN, DEG, KINDS, OF_KIND, TURN, Kind, kind_of
from . import names
from .contents import NAMELESS, RANGES, RESTS, Part, Signal, is_nameless, no_commands, unused
from .following import LATEST, Following, following
from .matching import far_shift
from .names import Role
from .orientations import Attitude, in_order
from .own_frames import speeds_follow

_OF_POINT = 0.98  # correlation from which a joint moves one coordinate of a point alone, as a rail does
_SAME = 0.8  # correlation of changes from which one signal follows another, and may be its axis under another name
_ALIKE, _LEVEL = 0.98, 0.1  # correlation of columns of one axis, and share of their range by which their ends differ
_GAINS = 3.0  # ratio of the gains of the axes of one sensor, at the most
_EVEN, _MOSTLY = 0.05, 0.9  # of a step, by which those of a clock differ, as it has digits; of the steps
_AT_ONCE = 0.002  # s, by which a signal must be late to say that it follows: two sensors move together
_TO_AND_FRO = 10  # turns at rest, from which they are noise: an arm that settles turns a few times
_COPY = 0.9  # share of numbers that are the same, from which they are copies
_NEAR = -0.5, 1.5  # s, from and to which lag a sensor is on the commands' clock
_MOST_LAG, GUESSED_LAG = 0.5, 0.1  # s, that an arm is late where its clock is shifted
_FEWEST = 20  # rows
_MOST_PAIRS, _MOST_CANDIDATES = 400, 12  # that are compared, at 0.1 s a pair of axes
_MOST_APART = 40  # axes of a table that is taken apart by their names
_MOST_LISTED, _LONGEST = 8, 200  # columns in an error, letters of all of them
_NUMBERED = re.compile(r"joint\d+|position")
_AXIS_WORD = re.compile(r"[xyz]|\d+|")
_Group: TypeAlias = tuple[str, str, str, bool]  # words of roles, list, copy, whether they are desired values


@dataclass(frozen=True)
class Stream:
    """A source of the run to be: columns of a part that belong together."""

    name: str
    role: Role | None  # what it is; None: its names do not say
    why: str  # how that is known
    part: Part
    axes: Mapping[str, Sequence[Signal]]  # for each axis its columns, which are added up
    attitude: Attitude | None = None  # its orientation, if it tells one

    @property
    def source(self) -> Source:
        """Its rows that have a value."""
        assert self.part.clock is not None
        values = {axis: np.sum([one.value for one in signals], axis=0) for axis, signals in self.axes.items()}
        turned = None if self.attitude is None else self.attitude.quaternion
        source = Source(self.part.clock.stamp, values, self.part.label, orientation=turned)
        if self.part.entity:
            source, _ = source.on_timeline()
        has_own_rows = any(one.where for signals in self.axes.values() for one in signals)
        return source.pivoted() if has_own_rows else source.rows(source.has_value)

    @property
    def turns(self) -> dict[str, float]:
        """After what axes begin anew [rad], for those that do."""
        return {axis: TURN for axis, signals in self.axes.items() if any(one.turns for one in signals)}

    @property
    def guessed(self) -> bool:
        """Whether its units are a guess by their range."""
        return any(one.basis == "range" for signals in self.axes.values() for one in signals)

    def kind(self, axis: str) -> Kind:
        """What one of its axes is."""
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
        found = {one.name: one for one in self.sensors}
        return found if self.reference is None else {**found, REFERENCE: self.reference}

    @property
    def streams(self) -> list[Stream]:
        """The commands, and what measures."""
        return [self.command, *self.measured.values()]

    @property
    def run(self) -> Run:
        """The run as it would be read."""
        command = self.command.source
        sensors = {name: one.source.beside(command, one.turns) for name, one in self.measured.items()}
        kinds: dict[str, Kind] = {axis: self.command.kind(axis) for axis in self.command.axes}
        reference = None if self.reference is None else sensors.pop(REFERENCE)
        return Run("log", command, sensors, reference, kinds=kinds)

    def without(self, why_not: Mapping[tuple[str, str], str]) -> Roles:
        """The roles without axes of sensors or ``reference``, and without axes that nothing measures then."""
        left_out, found = [*self.left_out], dict[str, Stream]()
        for name, one in self.measured.items():
            bad = {axis: why_not[name, axis] for axis in one.axes if (name, axis) in why_not}
            left_out += [(replace(one, axes={axis: one.axes[axis]}), why) for axis, why in bad.items()]
            if kept := {axis: signals for axis, signals in one.axes.items() if axis not in bad}:
                found[name] = replace(one, axes=kept)
        measured = {axis for one in found.values() for axis in one.axes}
        told = {axis: signals for axis, signals in self.command.axes.items() if axis in measured}
        if unmeasured := {axis: signals for axis, signals in self.command.axes.items() if axis not in measured}:
            left_out.append((replace(self.command, axes=unmeasured), "nothing measures where these commands lead"))
        reference = found.pop(REFERENCE, None) if self.reference else None
        return Roles(replace(self.command, axes=told), list(found.values()), reference, left_out)


def roles_of(parts: Iterable[Part], log: str) -> Roles:
    """Who is who among the parts of a log."""
    parts = list(parts)
    streams = [stream for part in parts for stream in streams_of(part)]
    if not streams:
        there = ", ".join(unused(parts)[:_MOST_LISTED])
        why = f"no columns of positions with a clock beside them{', but ' if there else ''}{there}"
        advice = f"{no_commands(parts)}say in run.toml where they are"
        if all(part.clock is None for part in parts):
            raise RunError(f"{log}: {why}; {advice}")
        raise UndecidedError(log, f"{why}; {advice}", parts)
    named = dict[str, Stream]()
    for one in _apart(streams[0]) if len(streams) == 1 else streams:
        name = _free(one.name, named.keys())
        named[name] = replace(one, name=name)
    streams = _looked_at(list(named.values()))
    if (known := _command(streams)) is None:
        what = "; ".join(f"{printable(one.part.label)}: {', '.join(list(one.axes)[:_MOST_LISTED])}" for one in streams)
        still = [f"{one}, {why}" for part in parts for one, why in part.left_out.items() if why.startswith(RESTS)]
        still = [one for one in still if names.column_role(one.rpartition(",")[0]) == "command"]
        called = "None is called command, goal, target, desired, setpoint or action"
        called = f"What is called so never moves: {printable('; '.join(still[:3]), _LONGEST)}" if still else called
        advice = f"{no_commands(parts)}say it in run.toml"
        beside = "".join(f"; {one}" for one in unused(part for part in parts if part.clock is None)[:_MOST_LISTED])
        why = f"{called}, and none runs ahead of others ({what}{beside}); {advice}"
        raise UndecidedError(log, f"which numbers are the commands? {why}", parts)
    command, why = known
    resting = {names.axis_of(column, []) for column, what in command.part.left_out.items() if what.startswith(RESTS)}
    left_out: list[tuple[Stream, str]] = []
    kept: list[Stream] = []
    for stream in streams:
        if stream is command:
            continue
        if stream.role == "command":
            left_out.append((stream, "other commands: a run has one source of them; exchange the two to use these"))
            continue
        stream = _on_one_clock(command, stream)
        axes, why_not = _matched(command, stream)
        if axes and _copies(command, replace(stream, axes=axes)):
            left_out.append((stream, "the same numbers as the commands, at the same time"))
            continue
        matched = replace(stream, axes={axis: axes[axis] for axis in command.axes if axis in axes})
        if stream.role is None and axes:
            late, otherwise = _follows(command, matched)
            matched = replace(matched, role="sensor" if late else None, why=f"it follows the commands {late}")
            why_not = (
                f"neither its name nor its motion says what it is: {otherwise}; if it measures their axes, say so in"
                " run.toml"
            )
        if axes and matched.role:
            kept.append(matched)
            used = {id(some) for some in axes.values()}
            others = {axis: some for axis, some in stream.axes.items() if id(some) not in used}
            for held in (True, False):
                why_not = "its command never moves" if held else "no command is left that is called so or moves alike"
                if some := {axis: columns for axis, columns in others.items() if (axis in resting) == held}:
                    left_out.append((replace(stream, axes=some), why_not))
        else:
            left_out.append((stream, another_clock(stream.source, command.source) or why_not))
    command, *kept = _in_order([command, *_raw(kept, left_out)], left_out)
    command, *kept = _renamed([replace(command, role="command", why=why), *kept])
    sensors = [one for one in kept if one.role == "sensor"]
    references = [one for one in kept if one.role == "reference"]
    left_out += [(one, "a second reference") for one in references[1:]]
    if not sensors:
        sensors = [replace(one, role="sensor", why=f"{one.why}, but nothing else measures") for one in references[:1]]
        references = []
    reports = [one for one in sensors if "reported" in one.name.split("_") and len(sensors) > 1]
    left_out += [(one, "what the controller itself reports: no measurement of where the tool is") for one in reports]
    sensors = [one for one in sensors if one not in reports]
    return _with_units(Roles(command, sensors, references[0] if references else None, left_out))


def _raw(streams: Sequence[Stream], left_out: list[tuple[Stream, str]]) -> list[Stream]:
    """Sources without the axes of filtered sensors of which the raw one is there, too."""
    found = list[Stream]()
    for one in streams:
        column = next(iter(one.axes.values()))[0].column
        beside = dict[str, str]()
        for other in streams if one.role == "sensor" else ():
            raw, apart = next(iter(other.axes.values()))[0].column, one.part.label != other.part.label
            filtered, not_raw = (
                names.has_word(f"{some.part.stem} {name}" if apart else name, names.FILTERED)
                for some, name in ((one, column), (other, raw))
            )
            same = names.quantity(one.part.stem, column) == names.quantity(other.part.stem, raw)
            if other.role == "sensor" and filtered and not not_raw and same:
                beside |= {axis: raw if not apart else other.part.label for axis in one.axes if axis in other.axes}
        if beside:
            raw = ", ".join(map(printable, dict.fromkeys(beside.values())))
            why = f"{printable(column)} is filtered by its name: {raw} beside it is raw, and is the sensor"
            left_out.append((replace(one, axes={axis: one.axes[axis] for axis in beside}), why))
        if axes := {axis: some for axis, some in one.axes.items() if axis not in beside}:
            found.append(replace(one, axes=axes))
    return found


def _in_order(streams: Sequence[Stream], left_out: list[tuple[Stream, str]]) -> list[Stream]:
    """The commands and what follows them, with quaternions in the order in which both turn alike."""
    command, *others = streams
    known = next((one for one in others if one.attitude and not one.attitude.is_open), None)
    if command.attitude and command.attitude.is_open and known is not None:
        command = replace(command, attitude=_ordered(command, known, leads=True))
    for place, one in enumerate(others):
        if command.attitude and not command.attitude.is_open and one.attitude and one.attitude.is_open:
            others[place] = replace(one, attitude=_ordered(one, command, leads=False))
    if command.attitude and command.attitude.farthest > FARTHEST_TURN:
        far = f"the tool is told to turn by {command.attitude.farthest * DEG:.0f}° from its mean orientation: too far"
        left_out.append((replace(command, axes={}), far))
        command = replace(command, attitude=None)
    return [command, *others]


def _ordered(stream: Stream, known: Stream, *, leads: bool) -> Attitude:
    assert stream.attitude and known.attitude and stream.part.clock and known.part.clock
    mine, theirs = stream.part.clock.stamp, known.part.clock.stamp
    return in_order(stream.attitude, mine, known.attitude, theirs, leads=leads)


def relations(run: Run) -> dict[tuple[str, str], Following]:
    """How each sensor, and ``reference``, follows the commands, by its name and the axis."""
    return {
        (name, axis): found
        for name, source in run.measured.items()
        for axis, value in source.values.items()
        if axis in run.command.values
        and (found := following((run.command.stamp, run.command.values[axis]), (source.stamp, value))) is not None
    }


def another_clock(source: Source, command: Source) -> str:
    """What to say of a source whose stamps are all before or all after those of the commands; empty for others."""
    mine, theirs = (one.stamp[one.stamp != NO_STAMP] / 1e9 for one in (source, command))
    if len(mine) and len(theirs) and (mine.max() < theirs.min() or mine.min() > theirs.max()):
        return (
            f"its stamps ({mine.min():.3f} to {mine.max():.3f} s) are not of the commands' time"
            f" ({theirs.min():.3f} to {theirs.max():.3f} s): name a clock that both have (run.toml, time)"
        )
    return ""


def _on_one_clock(command: Stream, stream: Stream) -> Stream:
    """A stream on the commands' clock, where it has another one by which it follows nothing, with a question.

    On one clock it stays as it is: of a motion that repeats itself the lag may be a period longer, which is asked.
    How late it follows is the difference of the clocks and the arm's lag together. Where both begin, or end, at once,
    or differ by whole hours, that difference is known; else the lag is not.
    """
    told, source = command.source, stream.source
    axes = [axis for axis in stream.axes if axis in command.axes and _same_kind(command, axis, stream, axis)]
    one, other = command.part.clock, stream.part.clock
    if not axes or one is None or other is None:
        return stream
    led, measured = ({axis: rows.series(axis) for axis in axes} for rows in (told, source))
    if min(len(stamp) for stamp, _ in (*led.values(), *measured.values())) < _FEWEST:
        return stream
    if (late := far_shift(led, measured, _NEAR)) is None:
        return stream
    if one.time == other.time and command.part.file == stream.part.file:
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
    known = {"both begin at once": (begins - begun) / 1e9, "both end at once": (ends - ended) / 1e9}
    known |= {"time zones are hours apart": hours} if hours else {}
    why, ahead = next(
        ((words, by) for words, by in known.items() if 0.0 <= late - by < _MOST_LAG),
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
    """The columns of a part, those apart whose names say that they are something else, or another list."""
    if part.clock is None:
        return []
    groups: dict[_Group, list[Signal]] = {}
    beside = {names.last(one) for one in (*(signal.column for signal in part.signals), *part.left_out)}
    for signal in part.signals:
        called = _joined(names.role_words(signal.name))
        listed, copy, measured = names.family(signal.column, beside)
        if copy or measured:
            signal = replace(signal, axis=names.axis_of(measured or signal.column.removesuffix(copy), []))
        groups.setdefault((called, listed, copy, bool(measured)), []).append(signal)
    groups = {key: some for one in groups.items() for key, some in _seen_twice(*one)}
    roles = Counter(key for key, *_ in groups)
    told = {one.axis for some in groups.values() for one in some if names.column_role(one.name) == "command"}
    of_file, of_columns = names.role_of(part.stem), {names.column_role(one[0].name) for one in groups.values()}
    of_file = None if len(groups) > 1 and of_file in of_columns else of_file  # then it is what these columns are
    found = list[Stream]()
    by_type = "command" if part.type.endswith("JointTrajectory") or part.clock.time.column == PATH_TIME else None
    by_type = "sensor" if part.type.endswith("JointState") else by_type
    for (key, listed, copy, desired), signals in groups.items():
        wanted = ("command" if desired else None, f"'{signals[0].column}' is of desired values, by its name")
        own = (names.column_role(signals[0].name), f"its columns are called '{key.replace('_', ' ')}'")
        file = (of_file, f"it is called '{printable(part.stem)}'")
        clock = (
            names.column_role(part.clock.time.column),
            f"its clock is called '{printable(part.clock.time.column)}'",
        )
        typed, order = (by_type, f"its messages are {part.type}"), (own, file) if len(groups) > 1 else (file, own)
        role, why = next((one for one in (wanted, *order, clock, typed) if one[0]), (None, ""))
        name = key if roles[key] == 1 else names.plain(f"{listed or key or part.stem}{copy}")
        # What has no word of its own beside commands is not called after the file: another of its kind fits then.
        beside_commands = roles.keys() > {""} and "command" in of_columns
        rest = _prefix(signals, told, roles.keys()) if beside_commands else names.plain(part.stem)
        name = name if len(groups) > 1 and name else rest
        axes, attitude = _axes(signals), None
        if any(axis in CARTESIAN for axis in axes):
            attitude = next((one for one in part.attitudes if key == _joined(one.role_words)), None)
        found.append(Stream(name or "log", role, why, part, axes, attitude))  # pyright: ignore[reportArgumentType]
    return found


def _prefix(signals: Sequence[Signal], told: Set[str], taken: Set[str]) -> str:
    """What columns beside commands are called: by what all of them have before axes that are told, else measured."""
    own = {one.axis.removesuffix(axis) for one in signals for axis in told if f"_{one.axis}".endswith(f"_{axis}")}
    return names.plain(own.pop()) if len(own) == 1 and own != {""} else _free("measured", taken)


def _seen_twice(key: _Group, signals: Sequence[Signal]) -> Iterator[tuple[_Group, list[Signal]]]:
    """A group of columns, those apart that are axes of others under another word: ``x_poses`` beside ``x``."""
    by_words = dict[tuple[str, ...], list[Signal]]()
    for one in signals:
        silent = [word for word in names.words(leaf(one.column)) if word not in names.words(one.axis)]
        by_words.setdefault(tuple(silent), []).append(one)
    first = max(by_words.values(), key=len)
    axes = {one.axis for one in first}
    apart = {
        words: some
        for words, some in by_words.items()
        if some is not first
        and words
        and len(some) > 1
        and {one.axis for one in some} <= axes
        and names.PARTS.isdisjoint(words)
    }
    taken = {id(one) for some in apart.values() for one in some}
    yield key, [one for one in signals if id(one) not in taken]
    for words, some in apart.items():
        yield (key[0], _joined(words), *key[2:]), some


def _joined(words: Iterable[str]) -> str:
    """Words of roles as a name, each once."""
    return "_".join(dict.fromkeys(words))


def _axes(signals: Sequence[Signal]) -> dict[str, list[Signal]]:
    """Columns by axis: parts of a sum together; others that would be called the same get a number."""
    found: dict[str, list[Signal]] = {}
    for signal in signals:
        parts = {axis for axis, some in found.items() if names.has_word(some[0].name, names.PARTS)}
        summed = parts if names.has_word(signal.name, names.PARTS) else set[str]()
        found.setdefault(_free(signal.axis, found.keys() - summed), []).append(signal)
    return {
        axis: some for axis, some in found.items() if any(np.nanmin(one.plain) < np.nanmax(one.plain) for one in some)
    }


def _apart(stream: Stream) -> list[Stream]:
    """The only stream of a log, taken apart where a word tells axes of two apart, and one of these runs ahead.

    ``a_x`` and ``b_x``, ``q_d_0`` and ``q_0``, ``xd`` and ``x``; but words like x, y, z and numbers are axes.
    """
    by_word: dict[str, dict[tuple[str, ...], str]] = {"": {}}
    for axis in stream.axes if len(stream.axes) <= _MOST_APART else ():
        whole = tuple(axis.split("_"))
        if axis[-1:] == "d" and axis[:-1] in stream.axes:  # desired
            whole = axis[:-1], "d"
        by_word[""][whole] = axis
        for place, word in enumerate(whole):
            by_word.setdefault(word, {})[whole[:place] + whole[place + 1 :]] = axis

    def of(word: str, rests: Iterable[tuple[str, ...]]) -> Stream:
        axes = {names.axis_of("_".join(rest), []): stream.axes[by_word[word][rest]] for rest in rests}
        others = frozenset(other for other in by_word if not _AXIS_WORD.fullmatch(other))
        for one in stream.part.attitudes:  # with the word in its names; without one, with none of the others
            inside = names.words(one.columns.columns[0])
            if word in inside if word else others.isdisjoint(inside):
                return Stream(names.plain(word) or stream.name, None, "", stream.part, axes, one)
        return Stream(names.plain(word) or stream.name, None, "", stream.part, axes)

    ways = list[list[Stream]]()
    for word, mine in by_word.items():
        shared = {
            other: rests
            for other, rest in by_word.items()
            if (rests := sorted(mine.keys() & rest.keys())) and _tells_apart(word, other, rests, stream)
        }
        if shared:
            every = sorted(set[tuple[str, ...]]().union(*shared.values()))
            ways.append([of(word, every), *(of(other, rests) for other, rests in shared.items())])
    best = max(ways, key=lambda way: _followers(way[0], way), default=[stream])
    return best if len(best) > 1 and _followers(best[0], best)[0] else _led(stream)


def _led(stream: Stream) -> list[Stream]:
    """A stream of columns without names, taken apart where some follow others: as far, at the same level, later.

    Or at once, and noisier.
    """
    source, columns = stream.source, list(stream.axes)
    mine = [one for some in stream.axes.values() for one in some]
    if len(columns) > _MOST_APART or not stream.part.clock or not is_nameless(mine, stream.part.clock):
        return [stream]
    leads = dict[str, dict[str, float]]()  # of those that follow it, how late they do
    ends = {one: np.quantile(value, (0.0, 0.5, 1.0)) for one, value in source.values.items()}
    for one, other in permutations(columns, 2):
        if np.abs(ends[one] - ends[other]).max() > _LEVEL * np.ptp(ends[other]):
            continue
        found = following((source.stamp, source.values[one]), (source.stamp, source.values[other]))
        if found is None or found.correlation <= _ALIKE or found.lag <= -_AT_ONCE:
            continue
        if found.lag > _AT_ONCE or _stands_beside(source.values[one], source.values[other]):
            leads.setdefault(one, {})[other] = found.lag
    followers = {other for mine in leads.values() for other in mine}
    pairs = dict[str, str]()
    for one in (one for one in leads if one not in followers):
        free = {other: lag for other, lag in leads[one].items() if other not in pairs.values()}
        if free:
            pairs[one] = min(free, key=free.__getitem__)
    if not pairs:
        return [stream]
    rest = {axis: some for axis, some in stream.axes.items() if axis not in {*pairs, *pairs.values()}}
    told, seen = {one: stream.axes[one] for one in pairs}, {one: stream.axes[other] for one, other in pairs.items()}
    command = Stream("commanded", "command", "others follow it as far, later or noisier", stream.part, told)
    others = {"measured": seen, "others": rest}
    return [command, *(Stream(name, None, "", stream.part, axes) for name, axes in others.items() if axes)]


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


def _looked_at(streams: Sequence[Stream]) -> list[Stream]:
    """Streams of which one that is called target, but moves after another that nothing names, is a sensor's."""
    found = list[Stream]()
    for stream in streams:
        columns = [one.column for signals in stream.axes.values() for one in signals]
        seen = stream.role == "command" and any(map(names.may_be_seen, [stream.part.stem, *columns]))
        unnamed = [one for one in streams if seen and one.role is None]
        fewest = 0.5 * len(stream.axes) if len(stream.axes) > len(CARTESIAN) else 0.0  # in space one, or its speed
        led = [one for one in unnamed if _followers(one, [replace(stream, role=None)])[0] > fewest]
        if seen and led:
            why = f"it is called target, but follows '{printable(led[0].name)}': it is what a sensor looks at"
            stream = replace(stream, role="sensor", why=why)
        found.append(stream)
    return found


def _free(name: str, taken: Set[str]) -> str:
    """A name, with a number where it is taken: ``x``, ``x_2``."""
    numbered = (name if number == 1 else f"{name}_{number}" for number in count(1))
    return next(one for one in numbered if one not in taken)


def _command(streams: Sequence[Stream]) -> tuple[Stream, str] | None:
    """The commands, and how they are known: by name, and of several by what follows them; without names by that."""
    called = [one for one in streams if one.role == "command"]
    if len(called) == 1:
        return called[0], called[0].why
    # A reference that runs ahead, or that stands beside one other alone, is a set point, as control engineers call it.
    beside = [one for one in streams if one.role != "reference"]
    if not called and len(streams) == 2 and len(beside) == 1:
        (set_point,) = (one for one in streams if one.role == "reference")
        return set_point, f"{set_point.why}, and one other alone is beside them: a set point"
    candidates = (called or [one for one in streams if one.role != "sensor"])[:_MOST_CANDIDATES]
    followers = {one.name: _followers(one, streams) for one in candidates}
    best = max(candidates, key=lambda one: followers[one.name], default=None)
    if best is None or (not called and not followers[best.name][0]):
        return None
    return best, best.why or "others follow it"


def _followers(leader: Stream, streams: Sequence[Stream]) -> tuple[float, float]:
    """How many axes of others run behind a stream, each as far as its motion is the same; by how much, in all [s]."""
    count = late = 0.0
    for other in streams:
        if other is not leader and other.role != "command":
            axes, _ = _matched(leader, other)
            relations = _relations(leader, replace(other, axes=axes))
            if not any(abs(found.correlation) >= _SAME for found in relations):
                relations = list(filter(None, [speeds_follow(leader.source, other.source)]))
            for found in relations:
                if abs(found.correlation) >= _SAME and found.lag > _AT_ONCE:
                    count, late = count + abs(found.correlation), late + found.lag
    return round(count, 1), late


def _follows(command: Stream, stream: Stream) -> tuple[str, str]:
    """By how much a stream that nothing names follows the commands, in words; empty if it does not, and why not."""
    if all(_rises_evenly(value) for value in stream.source.values.values()):
        return "", "it rises evenly, as a clock does"
    found = _relations(command, stream)
    alike = [one for one in found if one.correlation >= _SAME]
    behind = [one for one in alike if -_AT_ONCE < one.lag < LATEST]
    gains, fewest = [one.slope for one in behind], 0.0 if _is_namesake(command, stream) else len(found) / 2
    if len(behind) > fewest and max(gains) < _GAINS * min(gains):
        return f"{float(np.median([one.lag for one in behind])) * 1e3:.0f} ms late", ""
    speeds = speeds_follow(command.source, stream.source)
    if speeds is not None and speeds.correlation >= _SAME and -_AT_ONCE < speeds.lag < LATEST:
        return f"{speeds.lag * 1e3:.0f} ms late, by its speed", ""
    most = max((one.correlation for one in found), default=0.0)
    if not alike:
        return "", f"it does not follow the commands (correlation {most:+.2f} at most)"
    if len(behind) < len(alike):
        early = float(np.median([-one.lag for one in alike if one not in behind]))
        when = f"{early * 1e3:.0f} ms before" if early > 0.0 else f"{-early:.1f} s behind"
        return "", f"it does not follow the commands: it moves {when} them"
    few = f"it follows the commands on {len(behind)} of {len(found)} axes"
    return "", few if len(behind) <= fewest else f"{few}, but by {min(gains):.3g} to {max(gains):.3g} times as far"


def _rises_evenly(value: FloatArray) -> bool:
    """Whether numbers rise in each row, and mostly by the same: no sensor of a position does."""
    steps = np.diff(value)
    even = np.abs(steps / np.median(steps) - 1.0) < _EVEN if len(steps) and steps.min() > 0.0 else np.zeros(1)
    return bool(even.mean() > _MOSTLY)


def _is_namesake(command: Stream, stream: Stream) -> bool:
    """Whether columns are called as those of the commands without a word of these: ``q[0]`` beside ``q_cmd[0]``."""

    def called(signals: Sequence[Signal]) -> list[str]:
        return [word for word in names.words(signals[0].name) if word not in names.role_words(signals[0].name)]

    shared = stream.axes.keys() & command.axes.keys()
    names_of = [(called(stream.axes[axis]), called(command.axes[axis])) for axis in shared]
    return bool(names_of) and all(one == other and one[:1] != NAMELESS for one, other in names_of)


def _copies(command: Stream, stream: Stream) -> bool:
    """Whether a stream says again what is commanded just then, also where that changes: one that is late does not."""
    told, source = command.source, stream.source
    order = np.argsort(told.stamp, kind="stable")
    place = np.searchsorted(told.stamp[order], source.stamp, side="right") - 1
    return all(
        float(np.mean(np.isclose(value, now, rtol=1e-9, atol=0.0)[np.append(True, np.diff(now) != 0.0)])) > _COPY
        for axis, value in source.values.items()
        if len(now := told.values[axis][order][place])
    )


def _relation(leader: Stream, axis: str, follower: Stream, other: str) -> Following | None:
    first, second = leader.source, follower.source
    return following((first.stamp, first.values[axis]), (second.stamp, second.values[other]))


def _relations(leader: Stream, follower: Stream) -> list[Following]:
    shared = [axis for axis in follower.axes if axis in leader.axes]
    return [found for axis in shared if (found := _relation(leader, axis, follower, axis)) is not None]


def _matched(command: Stream, stream: Stream) -> tuple[dict[str, Sequence[Signal]], str]:
    """Axes of a stream by the names that the commands give them, by name or else by how they move; or why none is."""
    fits = {axis: signals for axis, signals in stream.axes.items() if axis in command.axes}
    fits = {axis: signals for axis, signals in fits.items() if _same_kind(command, axis, stream, axis)}
    few, told, seen = len(command.axes) * len(stream.axes) <= _MOST_PAIRS, _bare(command.axes), _bare(stream.axes)
    others = [own for own in stream.axes if own not in fits and own not in command.axes]
    alike = [
        (own, axis)
        for own, axis in product(others, [axis for axis in command.axes if axis not in fits])
        if (few or seen[own] == told[axis]) and _same_kind(command, axis, stream, own)
    ]
    pairs = {
        pair: abs(one.correlation)
        for pair in alike
        if (one := _relation(command, pair[1], stream, pair[0])) is not None
    }
    points = [own for own in others if own in CARTESIAN]
    pairs = {pair: one for pair, one in pairs.items() if one >= _OF_POINT or len(points) < 2 or pair[0] not in points}
    named = {(own, axis) for own, axis in pairs if axis in (seen[own], own.rpartition("_")[2])}  # as p_RS_R_x is x
    for own, axis in sorted(pairs, key=lambda pair: (pair in named, pairs[pair]), reverse=True):
        if pairs[own, axis] >= _SAME and axis not in fits and own in others:
            fits[axis] = stream.axes[own]
            others.remove(own)
    if fits or not pairs:
        kinds = sorted({AN[stream.kind(axis)] for axis in stream.axes})
        none = f"none of the commands that were taken is {' or '.join(kinds)}, as {', '.join(stream.axes)} are"
        many = f"no axis is called as one of the commands', and {len(others)} are too many to compare how they move"
        return fits, none if few else many
    most = max(pairs, key=pairs.__getitem__)
    alike = f"at most {pairs[most]:.2f}, {most[1]}"
    return fits, f"its axes are called otherwise than the commands', and follow none ({alike})"


def _bare(axes: Iterable[str]) -> dict[str, str]:
    """Axes without the words that all begin with: ``left_arm_wrist`` and ``left_arm_elbow`` are wrist and elbow."""
    apart = {axis: axis.split("_") for axis in axes}
    places = zip(*(words[:-1] for words in apart.values()), strict=False)
    shared = sum(1 for _ in takewhile(lambda alike: len({*alike}) == 1, places))
    return {axis: "_".join(words[shared:]) for axis, words in apart.items()}


def _same_kind(command: Stream, axis: str, stream: Stream, own: str) -> bool:
    """Whether two axes can be the same by their units."""
    both = (*command.axes[axis], *stream.axes[own])
    return command.kind(axis) == stream.kind(own) or any(one.basis == "range" for one in both)


def _renamed(streams: Sequence[Stream]) -> list[Stream]:
    """Streams in which axes that the commands only number are called as the first other stream does."""
    command, *others = streams
    called = {axis: one.axes[axis][0].axis for one in reversed(others) for axis in one.axes}
    free = {axis: own for axis, own in called.items() if _NUMBERED.fullmatch(axis) and own not in command.axes}
    if len(set(free.values())) < len(free):
        return list(streams)
    return [replace(one, axes={free.get(axis, axis): one.axes[axis] for axis in one.axes}) for one in streams]


def _with_units(roles: Roles) -> Roles:
    """Units that are guesses made to fit, one of a kind for each source, by the axes that somebody measures."""
    command, reference = _angles_by_name(roles), roles.reference
    others = [one for one in (reference, *reversed(roles.sensors)) if one is not None]
    sure = [one for one in others if not one.guessed]
    for one in sure:  # the first sensor has the last word
        command = _fitted(command, one)
    if not sure:
        command = _ranged(command, {axis for one in others for axis in one.axes})
    sensors = [_fitted(one, command) for one in roles.sensors]
    return replace(
        roles, command=command, sensors=sensors, reference=None if reference is None else _fitted(reference, command)
    )


def _angles_by_name(roles: Roles) -> Stream:
    """The commands, in units of angles where nothing says it of them, but the name of what measures them."""
    found = dict(roles.command.axes)
    for axis, signals in roles.command.axes.items():
        seen = [some for one in roles.measured.values() for some in one.axes.get(axis, ())]
        guessed = signals[0].basis == "range" and roles.command.kind(axis) == "length"
        if guessed and any(names.is_turning(one.axis) and kind_of(f"_{one.unit}") == "angle" for one in seen):
            found[axis] = _in(signals, "_rad")
    return replace(roles.command, axes=found)


def _ranged(stream: Stream, measured: Set[str]) -> Stream:
    """A stream whose guessed units are the likeliest for the range of those of its axes that are measured."""
    found = dict(stream.axes)
    for kind in KINDS:
        small, large, most = RANGES[kind]
        mine = {axis: signals for axis, signals in stream.axes.items() if stream.kind(axis) == kind}
        plain = [one.plain for axis in mine.keys() & measured for one in mine[axis] if one.basis == "range"]
        unit = large if max((float(np.nanmax(np.abs(one))) for one in plain), default=0.0) > most else small
        found |= {axis: _in(signals, unit) for axis, signals in mine.items()} if plain else {}
    return replace(stream, axes=found)


def _fitted(stream: Stream, anchor: Stream) -> Stream:
    """A stream whose guessed units, one of each kind, are those in which it moves as far as another."""
    made = dict(stream.axes)
    shared = [axis for axis in anchor.axes if axis in made and any(one.basis == "range" for one in made[axis])]
    for kind in KINDS:
        mine = [axis for axis in shared if anchor.kind(axis) == kind]
        if not mine:
            continue

        def misfit(unit: str, mine: Sequence[str] = mine) -> float:
            found = replace(stream, axes={axis: _in(stream.axes[axis], unit) for axis in mine})
            ratios = [max(_travel(found, axis), 1e-12) / max(_travel(anchor, axis), 1e-12) for axis in mine]
            return abs(float(np.median(np.log(ratios))))

        unit = min(OF_KIND[kind], key=misfit)
        made |= {axis: _in(made[axis], unit) for axis in mine}
    return replace(stream, axes=made)


def _in(signals: Sequence[Signal], unit: str) -> list[Signal]:
    return [replace(one, unit=unit.removeprefix("_")) if one.basis == "range" else one for one in signals]


def _travel(stream: Stream, axis: str) -> float:
    """How far an axis moves, outliers apart [m or rad]."""
    value = stream.source.values[axis]
    low, high = np.nanquantile(value, [0.02, 0.98])
    return float(high - low) or float(np.nanmax(value) - np.nanmin(value))
