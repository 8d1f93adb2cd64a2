"""The sources of a run as registration takes them: motions of the tool, in s and m."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from ..logs.frames import CARTESIAN
from ..logs.run import Run, Source
from ..logs.screening import lost
from ..units import seconds
from .motion import Motion

_FARTHEST = 1e6  # m: what is farther is a sentinel, no position


def motion_of(source: Source) -> Motion:
    """What a source with x, y and z tells."""
    position = np.column_stack([source.values[axis] for axis in CARTESIAN])
    return Motion(seconds(source.stamp), position, source.orientation)


def measured(source: Source) -> Motion:
    """What a sensor tells, without what is no news: values that it repeats, and zeros, as it writes them when lost."""
    motion = motion_of(source)
    far = ~(np.abs(motion.position) < _FARTHEST).all(axis=1)
    again = (np.diff(motion.position, axis=0, prepend=np.nan) == 0.0).all(axis=1)
    return motion._replace(position=np.where((far | again | lost(motion.position))[:, None], np.nan, motion.position))


def complete(run: Run) -> Run:
    """A run with the sensors that give x, y and z."""
    return without(run, incomplete(run))


def incomplete(run: Run) -> set[str]:
    """The sensors of a run that do not give x, y and z."""
    return {name for name, one in run.sensors.items() if not set(CARTESIAN) <= one.values.keys()}


def without(run: Run, names: Collection[str]) -> Run:
    """A run without some sensors."""
    return replace(run, sensors={name: one for name, one in run.sensors.items() if name not in names})
