"""Runs with one thing changed, as somebody may have logged them."""

from collections.abc import Callable
from dataclasses import replace

import pumafuse as pf
from pumafuse.logs.source import Source

Change = Callable[[Source], Source]


def of_sensor(run: pf.Run, sensor: str, change: Change) -> pf.Run:
    return replace(run, sensors={**run.sensors, sensor: change(run.sensors[sensor])})


def scaled(factor: float, *axes: str) -> Change:
    """The values of some axes, of all for none, times a factor."""
    return lambda one: replace(
        one, values={axis: value * (factor if axis in axes or not axes else 1.0) for axis, value in one.values.items()}
    )


def delayed(seconds: float) -> Change:
    return lambda one: replace(one, stamp=one.stamp + round(seconds * 1e9))


def exchanged(first: str, second: str) -> Change:
    return lambda one: replace(one, values={**one.values, first: one.values[second], second: one.values[first]})
