"""What was decided about a log, how surely, and what the user has to decide, in the order in which one checks it.

Clock, units, who is who, what follows: each is nothing without the one before.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ..errors import printable
from ..logs.frames import CARTESIAN
from ..logs.run import Run, Source
from ..units import MS
from .following import LATEST, Following
from .guesses import SensorGuess
from .roles import another_clock
from .survey import FOLLOWS, Survey

_SAME = 0.8  # correlation of changes from which one follows another for sure
_OTHER_UNIT, _ABOUT_ONE = 3.0, 1.25  # factors by which a sensor may move less or more than its command
_LONG = 0.5  # s, of a lag that hardly an arm has


def decisions(found: Survey) -> Iterator[tuple[str, str, str]]:
    """What was checked, what it is, and how surely that is known."""
    if found.roles is not None:
        roles = found.roles
        streams = roles.streams
        clocks = {f"{one.part.clock.time.column or 'rows'}": one.part.clock for one in streams if one.part.clock}
        guessed = [column for column, one in clocks.items() if one.basis.endswith(("interval", "default", "motion"))]
        yield "clock", ", ".join(f"{column}: {one.basis}" for column, one in clocks.items()), _sure(guessed)
        signals = [some[0] for one in streams for some in one.axes.values()]
        units = " and ".join(sorted({one.unit for one in signals}))
        yield "units", units, _sure([one.column for one in signals if one.basis == "range"])
        if oriented := [one.attitude for one in streams if one.attitude]:
            bases = ", ".join(f"{', '.join(one.columns.columns)}: {one.basis}" for one in oriented)
            yield "orientations", bases, _sure([one.columns.columns[0] for one in oriented if one.doubt])
        if turns := [f"{one.name} {axis}" for one in streams for axis in one.turns]:
            yield "turns", f"{', '.join(turns)}: jumps by whole turns go on (turn_deg in run.toml)", "sure"
        who = ", ".join(f"{one.name} is a sensor" for one in roles.sensors)
        moved = [one.name for one in streams if "follow" in one.why]
        yield "who is who", f"{roles.command.part.label} is commanded, {who}", _sure(moved, "by how they move")
    for name in found.run.sensors:
        mine = {axis: one for (source, axis), one in found.relations.items() if source == name}
        if mine:
            lag, gain = (float(np.median([getattr(one, key) for one in mine.values()])) for key in ("lag", "slope"))
            least = min(abs(one.correlation) for one in mine.values())
            moves_as_far = all(_moves_as_far(found.run, name, axis, one) for axis, one in mine.items())
            as_it_should = least >= _SAME and moves_as_far and all(0.0 <= one.lag <= _LONG for one in mine.values())
            told = f"{lag * MS:.0f} ms late, gain {gain:.3g}, correlation {least:.3f}"
            yield f"{name} follows", told, "sure" if as_it_should else "a question"


def questions(found: Survey, sensors: Mapping[str, SensorGuess]) -> Iterator[str]:
    """Sentences, in the order in which one checks."""
    run = found.run
    roles = found.roles
    streams = [] if roles is None else roles.streams
    yield from dict.fromkeys(one.part.clock.doubt for one in streams if one.part.clock and one.part.clock.doubt)
    yield from dict.fromkeys(one.attitude.doubt for one in streams if one.attitude and one.attitude.doubt)
    for name, one in found.own_frames.items():
        yield f"{name} {one.words}: `pumafuse register` finds where it stands, and what it sees of the tool"
    if found.interpolation:
        yield (
            "are the commands samples of a path that the controller interpolates, or is a clock off? What measures"
            " follows that path sooner than an arm can that holds each command (interpolation_ms in run.toml)"
        )
    follow = any(abs(one.correlation) >= _SAME for one in found.relations.values())
    later = list[str]()
    for name, source in run.sensors.items():
        mine = {axis: found.relations[name, axis] for axis in source.values if (name, axis) in found.relations}
        if not mine:
            why = another_clock(source, run.command)
            yield f"{name}: {why or 'too few measurements, or no motion, while there are commands'}"
        for axis, one in mine.items():
            size = abs(one.slope)
            if abs(one.correlation) < _SAME:
                ask = (
                    ": are axes exchanged, or its clock another one?" if follow else ", nor anything else its commands"
                )
                missing = [one for one in CARTESIAN if one not in source.values]
                if axis in CARTESIAN and missing:
                    ask += f" It gives no {' and no '.join(missing)}, without which no frame of its own is found"
                how = "does not follow" if abs(one.correlation) < FOLLOWS else "hardly follows"
                later.append(f"{name} {how} the commands on {axis} (correlation {one.correlation:+.2f}){ask}")
                continue
            if one.lag < 0.0:
                yield f"{name} runs {-one.lag * MS:.0f} ms ahead of the commands on {axis}: is its clock another one?"
            elif one.lag > _LONG:
                most = " or more" if one.lag >= LATEST else ""
                late = f"{one.lag * MS:.0f} ms{most} late"
                yield f"{name} is {late} on {axis}, as hardly an arm is: is its clock another one?"
            if not _moves_as_far(run, name, axis, one):
                unit = (
                    "is its unit right" if not 1.0 / _OTHER_UNIT < size < _OTHER_UNIT else "is that its gear, or a unit"
                )
                later.append(f"{name} moves {size:.3g} times as far as commanded on {axis}: {unit}?")
    for one in sensors.values():
        yield from one.doubts
    if roles is not None:
        guessed = {printable(one.part.label): one for one in streams if one.guessed}
        units = sorted({signal.unit for one in guessed.values() for some in one.axes.values() for signal in some})
        if guessed:
            yield f"are the numbers of {', '.join(guessed)} in {' and '.join(units)}? No name says it (run.toml)"
        for stream, why in roles.left_out:
            if stream.name in {*run.sensors, roles.command.name} or "follow" in why or "its commands" in why:
                yield f"{printable(stream.name)} is not used on {', '.join(stream.axes)}: {why}"
    yield from later
    for (name, axis), why in found.unused.items():
        yield f"{name} is not used on {axis}: {why}. Is it in another frame, or stamped by another clock?"
    if found.relations and run.reference is None:
        yield (
            "how old is a measurement when it is stamped? Commands and measurements tell only the sum of the arm's lag"
            " and that age (fusion.toml, latency_ms)"
        )


def _is_one(gain: float) -> bool:
    """Whether a gain is about 1, whatever its sign."""
    return 1.0 / _ABOUT_ONE < abs(gain) < _ABOUT_ONE


def _moves_as_far(run: Run, name: str, axis: str, one: Following) -> bool:
    """Whether a sensor moves about as far as it is told to, whatever its sign."""
    return _is_one(one.slope) or _is_one(_reach(run.measured[name], axis) / _reach(run.command, axis))


def _reach(source: Source, axis: str) -> float:
    """How far an axis goes, outliers apart [m or rad]: of steps, which a span cuts, that tells a gain better."""
    low, high = np.nanquantile(source.values[axis], [0.02, 0.98])
    return max(float(high - low), 1e-12)


def _sure(doubtful: list[str], else_: str = "a guess") -> str:
    return f"{else_}: {', '.join(map(printable, dict.fromkeys(doubtful)))}" if doubtful else "sure"
