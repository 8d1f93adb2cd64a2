"""The total order of events: what acts on the plant when, and which measurement is valid when.

Time is int64 ns. At one instant commands come before measurements, then sensors in the order of ``fusion.toml``, then
stamp, place in the file and axis. The axes are independent but for row gates, so rows are kept together and each axis
still meets its components in the order (time, sensor, stamp, place in the file).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray, TimeArray
from ..errors import RunError, UnknownNameError
from ..logs.frames import CARTESIAN
from ..logs.run import Run
from ..model.drive import Drive, drive
from .commands import given_commands
from .components import Components, components_of
from .config import FusionConfig

LONGEST_TAIL_NS = 3_600_000_000_000  # measurements this long after the last command no longer belong to the run
_MOST_ESTIMATES = 10_000_000


@dataclass(frozen=True)
class AxisInput:
    """What drives one axis.

    Attributes:
        name: The axis.
        start: The level u₀ [m] that everything inside the filter is relative to.
        given: When each command was given, int64 ns, (n,).
        command: u as logged [m], (n,).
        drive: The plant's input, by the time it is issued.
        delay: Td, int ns.
    """

    name: str
    start: float
    given: TimeArray
    command: FloatArray
    drive: Drive
    delay: int

    @property
    def acting(self) -> TimeArray:
        """When each entry of the drive reaches the plant, int64 ns."""
        return self.drive.time + self.delay


@dataclass(frozen=True)
class Timeline:
    """One segment of a run, ready to be filtered.

    Attributes:
        origin: The first command, int ns: time 0 of the run.
        commands: Stamps of the commands, ascending, int64 ns, (n,).
        axes: What drives each axis.
        components: The measurements.
        end: Where an even grid of estimates ends, int ns: with the last command or measurement. Measurements an hour
            after the last command are on another clock.
        speed: Highest commanded speed on any axis [m/s].
        notes: Every anomaly once: how many, where first.
    """

    origin: int
    commands: TimeArray
    axes: tuple[AxisInput, ...]
    components: Components
    end: int
    speed: float
    notes: tuple[str, ...]


def build(run: Run, config: FusionConfig, sensors: Iterable[str] | None = None) -> Timeline:
    """Put a run's commands and measurements into their total order.

    Args:
        run: One segment of a recorded run.
        config: Arm and sensors.
        sensors: Which of the configured sensors to use; all for None.

    Raises:
        PumafuseError: The run commands an axis that the arm has not, or a chosen sensor is not configured.
    """
    arm, notes = config.arm, list(run.notes)
    for axis in run.axes:
        if axis in CARTESIAN and axis not in arm.axes:
            raise RunError(f"{run.command.label}: commands are in x, y, z; give a [frame] in run.toml or fusion.toml")
        if axis not in arm.axes:
            raise UnknownNameError(
                f"{run.command.label}: the arm '{arm.name}' has no such axis", "axis", axis, arm.axes
            )
    for name, source in run.sensors.items():
        if any(axis in CARTESIAN and axis not in run.axes for axis in source.values):
            raise RunError(
                f"sensor '{name}' is in x, y, z, the commands are not; give a [frame], and them in x, y, z too"
            )
    command, used = given_commands(run, arm.update_period, notes)
    inputs: list[AxisInput] = []
    for name in run.axes:
        given, values = command.stamp[used[name]], command.values[name][used[name]]
        start = run.start.get(name, float(values[0]))
        driven = drive(arm.axes[name], given, values, start, arm.update_period)
        inputs.append(AxisInput(name, start, given, values, driven, round(arm.delay_of(name) * 1e9)))
    same = all(np.array_equal(axis.given, inputs[0].given) for axis in inputs)
    commands = inputs[0].given if same else np.unique(np.concatenate([axis.given for axis in inputs]))
    origin = int(commands[0])

    named = tuple(name for name in config.sensor_names(sensors) if name in run.sensors)
    others = tuple(name for name in run.sensors if name not in config.sensors) if sensors is None else ()
    silent = [name for name in config.sensor_names(sensors) if name not in run.sensors]
    notes.extend(f"sensor '{name}' of the configuration has no measurements in this run" for name in silent)
    components = components_of(run, config, named + others, origin, notes)
    valid = components.valid[components.candidates]
    end = int(valid[valid <= commands[-1] + LONGEST_TAIL_NS].max(initial=commands[-1]))
    speed = max(axis.drive.speed for axis in inputs)
    return Timeline(origin, commands, tuple(inputs), components, end, speed, tuple(notes))


def output_times(timeline: Timeline, rate: float | None) -> TimeArray:
    """When estimates are asked for: at each command, or on an even grid of ``rate`` [Hz] from the first command on."""
    if rate is None:
        return timeline.commands
    span = timeline.end - timeline.origin
    count = int(span / 1e9 * rate) + 2
    if count > _MOST_ESTIMATES:
        raise RunError(
            f"{rate:g} estimates a second over {span / 86400e9:.1f} days are {count:.1e} estimates, more than"
            f" {_MOST_ESTIMATES:.0e}: a lower --rate? Or are not all stamps on one clock?"
        )
    grid = np.rint(np.arange(count) * (1e9 / rate)).astype(np.int64)
    return timeline.origin + grid[grid <= span]
