"""Cuts the step trials of a simulated campaign from the run that goes through all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa

from ..arrays import FloatArray, TimeArray
from ..logs.run import Source
from ..units import of_kind
from .scenario import Scenario
from .trajectory import Steps

TRIALS, SAMPLES = "trials.csv", "samples.csv"
_BEFORE = 0.05  # s of rest that a trial's samples begin with


def cut_trials(
    scenario: Scenario, tick: TimeArray, commands: Mapping[str, FloatArray], sensors: Mapping[str, Source]
) -> dict[str, pa.Table]:
    """The tables ``trials.csv`` and ``samples.csv`` of a step campaign, as `identify` reads them; else none.

    Commands [m or rad] were given at each ``tick``, int64 ns, (n,); the scope is among the sensors.
    """
    campaign = scenario.trajectory
    if not isinstance(campaign, Steps):
        return {}
    scope, period = sensors[campaign.scope], scenario.arm.update_period
    valid = scope.stamp / 1e9 - scenario.sensors[campaign.scope].latency
    pause = campaign.ticks_between(period)
    trials, samples = list[pa.Table](), list[pa.Table]()
    for number, at in enumerate(range(pause, len(tick), pause), 1):
        axis = next(axis for axis, command in commands.items() if command[at] != command[at - 1])
        step, screen = float(commands[axis][at] - commands[axis][at - 1]), scenario.arm.screen_of(axis)
        kind = scenario.arm.axes[axis].kind
        since = valid - tick[at] / 1e9
        inside = (since >= -_BEFORE) & (since <= campaign.window)
        trial = {
            "trial": number,
            "axis": axis,
            of_kind("step_mm", kind): round(step * screen.scale, 6),
            of_kind("speed_m_s", kind): round(abs(step) / period * screen.fast_scale, 6),
            "direction": "up" if step > 0.0 else "down",
        }
        sampled: dict[str, Sequence[int] | FloatArray] = {
            "trial": [number] * int(inside.sum()),
            "time_s": np.round(since[inside], 9),
            of_kind("position_mm", kind): np.round(scope.values[axis][inside] * screen.scale, 6),
        }
        trials.append(pa.Table.from_pylist([trial]))
        samples.append(pa.table(sampled))
    return {TRIALS: pa.concat_tables(trials), SAMPLES: pa.concat_tables(samples)}
