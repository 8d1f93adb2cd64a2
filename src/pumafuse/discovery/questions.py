"""What was decided about a log, how surely, and what the user has to decide, in the order in which one checks it.

Clock, units, who is who, what follows: each is nothing without the one before.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ..errors import printable
from ..logs.frames import CARTESIAN
from ..logs.run import Run
from ..units import MS
from . import names
from .following import ABOUT_ONE, LATEST, Following
from .guesses import SensorGuess
from .roles import MOST_LAG, SAME, Stream, another_clock
from .survey import FOLLOWS, Survey

_OTHER_UNIT = 3.0  # factor by which a sensor may move less or more than its command


def decisions(survey: Survey) -> Iterator[tuple[str, str, str]]:
    """What was checked, what it is, and how surely that is known."""
    if survey.roles is not None:
        roles = survey.roles
        streams = roles.streams
        clocks = {
            f"{stream.part.clock.time.column or 'rows'}": stream.part.clock for stream in streams if stream.part.clock
        }
        guessed = [
            column for column, clock in clocks.items() if clock.basis.endswith(("interval", "default", "motion"))
        ]
        yield "clock", ", ".join(f"{column}: {clock.basis}" for column, clock in clocks.items()), _sure(guessed)
        signals = [some[0] for stream in streams for some in stream.axes.values()]
        units = " and ".join(sorted({signal.unit for signal in signals}))
        yield "units", units, _sure([signal.column for signal in signals if signal.basis == "range"])
        if oriented := [stream.attitude for stream in streams if stream.attitude]:
            bases = ", ".join(f"{', '.join(attitude.columns.columns)}: {attitude.basis}" for attitude in oriented)
            yield "orientations", bases, _sure([attitude.columns.columns[0] for attitude in oriented if attitude.doubt])
        if turns := [f"{stream.name} {axis}" for stream in streams for axis in stream.turns]:
            yield "turns", f"{', '.join(turns)}: jumps by whole turns go on (turn_deg in run.toml)", "sure"
        who = ", ".join(f"{sensor.name} is a sensor" for sensor in roles.sensors)
        moved = [stream.name for stream in streams if "follow" in stream.why]
        yield "who is who", f"{roles.command.part.label} is commanded, {who}", _sure(moved, "by how they move")
    for name, own_frame in survey.own_frames.items():
        yield name, own_frame.words, "a guess, which registering it tries"
    for name in survey.run.sensors:
        by_axis = survey.of_source(name)
        if by_axis:
            lags = [relation.lag for relation in by_axis.values()]
            gain = float(np.median([relation.slope for relation in by_axis.values()]))
            least = min(abs(relation.correlation) for relation in by_axis.values())
            moves_as_far = all(_moves_as_far(survey.run, name, axis, relation) for axis, relation in by_axis.items())
            as_it_should = least >= SAME and moves_as_far and min(lags) >= 0.0 and max(lags) <= MOST_LAG
            told = f"{np.median(lags) * MS:.0f} ms late, gain {gain:.3g}, correlation {least:.3f}"
            yield f"{name} follows", told, "sure" if as_it_should else "a question"


def questions(survey: Survey, sensors: Mapping[str, SensorGuess]) -> Iterator[str]:
    """Sentences, in the order in which one checks."""
    run = survey.run
    roles = survey.roles
    streams = [] if roles is None else roles.streams
    yield from dict.fromkeys(
        stream.part.clock.doubt for stream in streams if stream.part.clock and stream.part.clock.doubt
    )
    yield from dict.fromkeys(stream.attitude.doubt for stream in streams if stream.attitude and stream.attitude.doubt)
    if survey.interpolation:
        yield (
            "are the commands samples of a path that the controller interpolates, or is a clock off? What measures"
            " follows that path sooner than an arm can that holds each command (interpolation_ms in run.toml)"
        )
    follow = any(abs(relation.correlation) >= SAME for relation in survey.relations.values())
    later = list[str]()
    for name, source in run.sensors.items():
        by_axis = survey.of_source(name)
        if not by_axis:
            why = another_clock(source, run.command)
            yield f"{name}: {why or 'too few measurements, or no motion, while there are commands'}"
        for axis, relation in by_axis.items():
            size = abs(relation.slope)
            if abs(relation.correlation) < SAME:
                ask = ": are axes exchanged, or its clock another one?"
                ask = ask if follow else ", and nothing else follows these."
                missing = [axis for axis in CARTESIAN if axis not in source.values]
                if axis in CARTESIAN and missing:
                    ask += f" It gives no {' and no '.join(missing)}, without which no frame of its own is found"
                how = "does not follow" if abs(relation.correlation) < FOLLOWS else "hardly follows"
                later.append(f"{name} {how} the commands on {axis} (correlation {relation.correlation:+.2f}){ask}")
                continue
            if relation.lag < 0.0:
                ahead = f"{-relation.lag * MS:.0f} ms ahead"
                yield f"{name} runs {ahead} of the commands on {axis}: is its clock another one?"
            elif relation.lag > MOST_LAG:
                most = " or more" if relation.lag >= LATEST else ""
                late = f"{relation.lag * MS:.0f} ms{most} late"
                yield f"{name} is {late} on {axis}; arms are rarely that late: is its clock another one?"
            if not _moves_as_far(run, name, axis, relation):
                unit = (
                    "is its unit right" if not 1.0 / _OTHER_UNIT < size < _OTHER_UNIT else "is that its gear, or a unit"
                )
                later.append(f"{name} moves {size:.3g} times as far as commanded on {axis}: {unit}?")
    for name, guess in sensors.items():
        if guess.pair:
            yield from guess.pair.alignment.doubts(name, guess.pair.other)
    if roles is not None:
        guessed = {printable(stream.part.label): stream for stream in streams if stream.guessed}
        units = sorted({signal.unit for stream in guessed.values() for some in stream.axes.values() for signal in some})
        if guessed:
            others = ", ".join(sorted({unit for stream in guessed.values() if (unit := _other_unit(stream))}))
            says = f"Names say {others}, which is no length and no angle" if others else "No name says it"
            yield f"are the numbers of {', '.join(guessed)} in {' and '.join(units)}? {says} (run.toml)"
        for stream, why in roles.left_out:
            if stream.name in run.sensors or stream.role == "command" or "follow" in why or "its commands" in why:
                yield f"{printable(stream.name)} is not used on {', '.join(stream.axes)}: {why}"
    yield from later
    for (name, axis), why in survey.unused.items():
        yield f"{name} is not used on {axis}: {why}. Is it in another frame, or stamped by another clock?"
    if survey.relations and run.reference is None:
        yield (
            "how old is a measurement when it is stamped? Commands and measurements tell only the sum of the arm's lag"
            " and that age (fusion.toml, latency_ms)"
        )


def _moves_as_far(run: Run, name: str, axis: str, following: Following) -> bool:
    """Whether a sensor moves about as far as it is told to, whatever its sign."""
    # Of steps, which a span cuts, how far both go tells a gain better.
    gains = abs(following.slope), run.measured[name].travel(axis) / max(run.command.travel(axis), 1e-12)
    return any(1.0 / ABOUT_ONE < gain < ABOUT_ONE for gain in gains)


def _other_unit(stream: Stream) -> str:
    """What names of a stream's columns say in brackets instead of a unit of positions; empty where none does."""
    signals = (signal for some in stream.axes.values() for signal in some)
    return printable(next(filter(None, (names.other_unit_of(signal.column) for signal in signals)), ""))


def _sure(doubtful: list[str], else_: str = "a guess") -> str:
    return f"{else_}: {', '.join(map(printable, dict.fromkeys(doubtful)))}" if doubtful else "sure"
