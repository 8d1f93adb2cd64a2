"""How late sensors are, each beside the arm or beside another one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..arrays import FloatArray
from ..fusion.config import FusionConfig
from ..fusion.placing import Placing
from ..logs.run import Run
from .beside import later
from .configured import placed_by
from .motion import Answer, Motion, Plant
from .register import Quantity, Registration
from .sources import measured, motion_of


def latencies_of(
    runs: Sequence[Run], found: Mapping[str, Registration], config: FusionConfig, lag: float | None
) -> dict[str, Quantity]:
    """The latency of each sensor [s]: that of the surest lag beyond the arm's, those of others beside it.

    Where the arm's lag is not known, the earliest sensor has none. Sensors are compared with one that tells
    orientations, if there is one: it tells where the points are that others see.
    """
    lags = {
        name: one.position.lag for name, one in found.items() if one.position is not None and not one.read_otherwise
    }
    if not lags:
        return {}
    best = min(lags, key=lambda name: (found[name].rms_rotation is None, lags[name].half))
    beside, placed = {best: exactly(0.0)}, placed_by(config, found, {})
    for name in (one for one in lags if one != best):
        both = [run for run in runs if {name, best} <= run.sensors.keys()]
        points = [_of_point(run, best, found[best], placed, name) for run in both]
        told = later(points, [_in_base(run, name, placed) for run in both], lags[name].value - lags[best].value)
        beside[name] = told or _sum(lags[name], -lags[best].value)
    if lag is None:
        first, known = min(beside, key=lambda name: beside[name].value), exactly(0.0)
    else:
        first = min(lags, key=lambda name: lags[name].half)
        known = _sum(lags[first], -lag)
    return {
        name: known if name == first else _sum(one, known.value - beside[first].value, beside[first], known)
        for name, one in beside.items()
    }


def _in_base(run: Run, name: str, config: FusionConfig) -> Motion:
    """What a placed sensor sees, where it is in the base's frame."""
    seen = measured(run.sensors[name]).valid()
    return seen._replace(position=Placing(config.sensors[name], config.arm).seen(seen.position))


def _of_point(run: Run, name: str, found: Registration, config: FusionConfig, point: str) -> Motion:
    """What a placed sensor tells of the point that another one sees, and how the tool is turned, if that is told."""
    seen, placing = _in_base(run, name, config), Placing(config.sensors[name], config.arm)
    if seen.quaternion is not None and found.rms_rotation is not None:
        turned = placing.oriented(seen.quaternion)
    else:
        turned = _commanded(run, seen.time, found)
    if turned is None:
        return seen._replace(quaternion=None)
    lever = Placing(config.sensors[point], config.arm).lever(turned) - placing.lever(turned)
    return Motion(seen.time, seen.position + lever, turned)


def _commanded(run: Run, time: FloatArray, found: Registration) -> FloatArray | None:
    """How the commands have turned the tool when a sensor measures, as quaternions; None where they do not tell."""
    command, response = motion_of(run.command).valid(), found.rotation or found.position
    if command.quaternion is None or response is None:
        return None
    plant = Plant(response.delay.value, response.time_constant.value)
    return Answer([command], [time]).quaternions(plant)


def exactly(value: float) -> Quantity:
    """A number that is taken, not found."""
    return Quantity(value, (value, value))


def _sum(one: Quantity, by: float, *unsure: Quantity) -> Quantity:
    """A number moved by another one, which is as unsure as some others are together."""
    value, half = one.value + by, sum(each.half for each in (one, *unsure))
    return Quantity(value, (value - half, value + half))
