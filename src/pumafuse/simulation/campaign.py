"""Cuts the step trials of a simulated campaign from the run that goes through all of them."""

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
        axis: Axis of each trial.
        step: Its step, signed [m].
        speed: The step's size over T [m/s].
        trial: Number of each sample's trial.
        time: Time of each sample since its step's command [s].
        position: Position of each sample [m], as the scope measured it.
    """

    axis: tuple[str, ...]
    step: FloatArray
    speed: FloatArray
    trial: IntArray
    time: FloatArray
    position: FloatArray


def cut_trials(
    scenario: Scenario, tick: TimeArray, commands: Mapping[str, FloatArray], sensors: Mapping[str, Source]
) -> Trials | None:
    """The trials of a step campaign, cut from its run; None for another trajectory.

    Args:
        scenario: What was simulated.
        tick: When each command was given, int64 ns, (n,).
        commands: The commands by axis [m], (n,).
        sensors: The measurements of the run, among them the scope's.
    """
    campaign = scenario.trajectory
    if not isinstance(campaign, Steps):
        return None
    scope, period = sensors[campaign.scope], scenario.arm.update_period
    valid = scope.stamp / 1e9 - scenario.sensors[campaign.scope].latency
    pause = campaign.ticks_between(period)
    axes, step = list[str](), list[float]()
    trial, time, position = list[IntArray](), list[FloatArray](), list[FloatArray]()
    for number, at in enumerate(range(pause, len(tick), pause), 1):
        axis = next(axis for axis, command in commands.items() if command[at] != command[at - 1])
        since = valid - tick[at] / 1e9
        inside = (since >= -_BEFORE) & (since <= campaign.window)
        axes.append(axis)
        step.append(float(commands[axis][at] - commands[axis][at - 1]))
        trial.append(np.full(int(inside.sum()), number))
        time.append(since[inside])
        position.append(scope.values[axis][inside])
    return Trials(
        axis=tuple(axes),
        step=np.array(step),
        speed=np.abs(step) / period,
        trial=np.concatenate(trial),
        time=np.concatenate(time),
        position=np.concatenate(position),
    )


def write_trials(trials: Trials, folder: Path) -> None:
    """Write ``trials.csv`` and ``samples.csv`` as `identify` reads them."""
    of_trials = {
        "trial": np.arange(1, len(trials.axis) + 1),
        "axis": list(trials.axis),
        "step_mm": np.round(trials.step * MM, 6),
        "speed_m_s": np.round(trials.speed, 6),
        "direction": np.where(trials.step > 0.0, "up", "down"),
    }
    of_samples = {
        "trial": trials.trial,
        "time_s": np.round(trials.time, 9),
        "position_mm": np.round(trials.position * MM, 6),
    }
    tables.write(pa.table(of_trials), folder / TRIALS)
    tables.write(pa.table(of_samples), folder / SAMPLES)
