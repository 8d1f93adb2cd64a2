"""The step trials of a simulated campaign, cut from the run that goes through all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from ..arrays import FloatArray, IntArray, TimeArray
from ..logs import tables
from ..logs.run import Source
from ..units import MM
from .scenario import Scenario
from .trajectory import Steps

TRIALS, SAMPLES = "trials.csv", "samples.csv"
_BEFORE = 0.05  # s of rest that a trial's samples begin with


@dataclass(frozen=True)
class Trials:
    """A campaign of step trials; arrays are (trials,) and (samples,).

    Attributes:
        axis: Which axis is stepped.
        step: By how much, signed [m].
        speed: Of the step: its size over T [m/s].
        trial: Of each sample, its trial's number.
        time: Of each sample since its step's command [s].
        position: Of each sample [m], as the scope has it.
    """

    axis: tuple[str, ...]
    step: FloatArray
    speed: FloatArray
    trial: IntArray
    time: FloatArray
    position: FloatArray


def cut(
    scenario: Scenario, tick: TimeArray, told: Mapping[str, FloatArray], sensors: Mapping[str, Source]
) -> Trials | None:
    """The trials of a step campaign, cut from its run; None for another trajectory.

    Args:
        scenario: What was simulated.
        tick: When each command was given, int64 ns, (n,).
        told: By axis the commands [m], relative to the start level, (n,).
        sensors: The measurements of the run, among them the scope's.
    """
    campaign = scenario.trajectory
    if not isinstance(campaign, Steps):
        return None
    scope, period = sensors[campaign.scope], scenario.arm.update_period
    valid = scope.stamp / 1e9 - scenario.sensors[campaign.scope].latency
    axis_of, step, samples = list[str](), list[float](), list[tuple[int, FloatArray, FloatArray]]()
    for number in range(1, len(tick) // campaign.ticks_between(period)):
        at = number * campaign.ticks_between(period)
        axis = next(axis for axis, command in told.items() if command[at] != command[at - 1])
        since = valid - tick[at] / 1e9
        kept = (since >= -_BEFORE) & (since <= campaign.window)
        axis_of.append(axis)
        step.append(float(told[axis][at] - told[axis][at - 1]))
        samples.append((number, since[kept], scope.values[axis][kept]))
    return Trials(
        tuple(axis_of),
        np.array(step),
        np.abs(step) / period,
        np.concatenate([np.full(len(time), number) for number, time, _ in samples]),
        np.concatenate([time for _, time, _ in samples]),
        np.concatenate([position for _, _, position in samples]),
    )


def write(trials: Trials, folder: Path) -> None:
    """Write ``trials.csv`` and ``samples.csv`` as `identify` reads them."""
    listed = {
        "trial": np.arange(1, len(trials.axis) + 1),
        "axis": list(trials.axis),
        "step_mm": np.round(trials.step * MM, 6),
        "speed_m_s": np.round(trials.speed, 6),
        "direction": ["up" if step > 0.0 else "down" for step in trials.step.tolist()],
    }
    sampled = {
        "trial": trials.trial,
        "time_s": np.round(trials.time, 9),
        "position_mm": np.round(trials.position * MM, 6),
    }
    tables.write(pa.table(listed), folder / TRIALS)
    tables.write(pa.table(sampled), folder / SAMPLES)
