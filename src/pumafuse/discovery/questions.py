"""What the user has to decide, or should look into, about a log."""

from __future__ import annotations

from collections.abc import Iterator

from ..errors import printable
from ..units import MS
from .roles import another_clock
from .survey import Survey

_FOLLOWS = 0.5  # correlation of changes
_OTHER_UNIT = 3.0  # factor by which a sensor may move less or more than its command


def questions(found: Survey) -> Iterator[str]:
    """Sentences, the gravest first."""
    run = found.run
    lags: list[float] = []
    for name, source in run.sensors.items():
        mine = {axis: found.relations[name, axis] for axis in source.values if (name, axis) in found.relations}
        if not mine:
            why = another_clock(source, run.command)
            yield f"{name}: {why or 'too few measurements, or no motion, while there are commands'}"
        for axis, one in mine.items():
            if abs(one.correlation) < _FOLLOWS:
                yield (
                    f"{name} does not follow the commands on {axis} (correlation {one.correlation:+.2f}): are axes"
                    " exchanged, or its clock another one?"
                )
            elif not 1.0 / _OTHER_UNIT < abs(one.slope) < _OTHER_UNIT:
                yield f"{name} moves {abs(one.slope):.3g} times as far as commanded on {axis}: is its unit right?"
            elif one.lag < 0.0:
                yield f"{name} runs {-one.lag * MS:.0f} ms ahead of the commands on {axis}: is its clock another one?"
            lags.append(one.lag)
    if found.interpolation:
        yield (
            "are the commands samples of a path that the controller interpolates, or is a clock off? What measures"
            " follows that path sooner than an arm can that holds each command (interpolation_ms in run.toml)"
        )
    if found.roles is not None:
        roles = found.roles
        streams = [roles.command, *roles.sensors, *([] if roles.reference is None else [roles.reference])]
        yield from dict.fromkeys(one.part.clock.doubt for one in streams if one.part.clock and one.part.clock.doubt)
        guessed = {printable(one.part.label): one for one in streams if one.guessed}
        units = sorted({signal.unit for one in guessed.values() for some in one.axes.values() for signal in some})
        if guessed:
            yield f"are the numbers of {', '.join(guessed)} in {' and '.join(units)}? No name says it (run.toml)"
    if lags and run.reference is None:
        yield (
            "how old is a measurement when it is stamped? Commands and measurements tell only the sum of the arm's lag"
            " and that age (fusion.toml, latency_ms)"
        )
