"""Commands that ask an axis for more than the fastest speed that it goes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import ALWAYS, NEVER
from ..model.arm import EXCEEDED, ArmModel, commanded_speed
from .segments import WHOLE, Segment, owned_rows


class Overrun(NamedTuple):
    """Commands of an axis that ask for more than the fastest speed that it goes."""

    commands: int  # how many commands there are
    beyond: int  # how many of them ask for more
    first: int  # stamp of the first of these, int ns
    last: int  # of the last
    fastest: float  # the highest commanded speed [m/s or rad/s]


def overruns(segment: Segment, arm: ArmModel, span: tuple[int, int] = WHOLE) -> dict[str, Overrun]:
    """Overruns of each axis with a fastest speed, by its commands after and until the instants ``span`` [int ns]."""
    by_axis = dict[str, Overrun]()
    for axis in segment.axes:
        if (limit := arm.axes[axis].max_speed) is not None:
            stamp, value = segment.commands_of(axis)
            speed, rows = (
                commanded_speed(np.diff(value, prepend=segment.start[axis]), arm.update_period),
                owned_rows(stamp, span),
            )
            stamp, speed = stamp[rows], speed[rows]
            beyond = stamp[speed > limit * EXCEEDED]
            ends = int(beyond.min(initial=NEVER)), int(beyond.max(initial=ALWAYS))
            by_axis[axis] = Overrun(len(stamp), len(beyond), *ends, float(speed.max(initial=0.0)))
    return by_axis


def overrun_notes(parts: Sequence[Mapping[str, Overrun]], arm: ArmModel, origin: int) -> list[str]:
    """A sentence on each axis with such commands in the parts of a run since ``origin`` [int ns]."""
    sentences = list[str]()
    for axis in dict.fromkeys(axis for part in parts for axis in part):
        commands, beyond, first, last, fastest = zip(*(part[axis] for part in parts if axis in part), strict=True)
        if sum(beyond):
            screen, limit = arm.screen_of(axis), arm.axes[axis].max_speed or 0.0
            begin, end = ((instant - origin) / 1e9 for instant in (min(first), max(last)))
            sentences.append(
                f"{axis}: {sum(beyond)} of {sum(commands)} commands ask for more than the {limit * screen.scale:.4g}"
                f" {screen.unit}/s that it goes, the fastest for {max(fastest) * screen.scale:.4g}, from {begin:.2f} s"
                f" to {end:.2f} s"
            )
    return sentences
