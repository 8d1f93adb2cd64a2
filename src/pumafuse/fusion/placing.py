"""Sensors in frames of their own: what they tell of the tool, along the base's axes.

The tool point is base_from_sensor · z − R · marker. R is the tool's orientation: as the same row tells it, else where
the commands have turned the tool by the instant of the measurement.
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np

from ..arrays import NO_STAMP, FloatArray
from ..errors import ConfigError, RunError
from ..filter.response import response
from ..logs.axes import in_axes, reference_orientation
from ..logs.clock import TOLERATED_STEP_BACK_NS, without_strays
from ..logs.frames import CARTESIAN, Placed
from ..logs.run import Run, Source
from ..space import rotations
from ..space.rotations import TURNING
from .config import FusionConfig, Placement, Sensor, Tool

_HERE = Placement()


def in_base(run: Run, config: FusionConfig) -> tuple[Run, Placed | None, FusionConfig]:
    """The run in the arm's axes, with what sensors in frames of their own tell of the tool.

    Args:
        run: As logged.
        config: Says where sensors stand, what they see, and how the tool turns.

    Returns:
        The run (see :func:`pumafuse.logs.axes.in_axes`), its placed frame, and the configuration with the reference
        orientation of the run where it had none.

    Raises:
        RunError: See :func:`pumafuse.logs.axes.in_axes`; or a sensor in a frame of its own does not give x, y and z.
        ConfigError: The tool's orientation is needed and nothing tells it.
    """
    run = without_strays(run)
    config = with_tool(config, run)
    tool = config.tool.reference if config.tool else None
    of_tool = {
        name: _of_tool(name, source, run, config)
        for name, source in run.sensors.items()
        if name in config.sensors and config.sensors[name].is_placed
    }
    found, placed = in_axes(replace(run, sensors={**run.sensors, **of_tool}), config.frame, tool)
    if found.tool is not None and not set(TURNING) & set(config.arm.axes):
        found = found.each(_still)
    return found, placed, config


def with_tool(config: FusionConfig, run: Run) -> FusionConfig:
    """The configuration with the reference orientation of a run's commands, where it has none."""
    tool = reference_orientation(run) if config.tool is None else None
    return config if tool is None else msgspec.structs.replace(config, tool=Tool(reference=tool))


def _still(_: str, source: Source) -> Source:
    """A source without the axes of its orientation, for an arm that has none."""
    return replace(source, values={axis: value for axis, value in source.values.items() if axis not in TURNING})


def _of_tool(name: str, source: Source, run: Run, config: FusionConfig) -> Source:
    """What a sensor in a frame of its own tells of the tool."""
    sensor = config.sensors[name]
    if not set(CARTESIAN) <= source.values.keys():
        raise RunError(f"{source.label_for(name)}: has a frame or a marker, so that it must give x, y and z")
    frame, marker = sensor.frame or _HERE, sensor.marker or _HERE
    turn = rotations.of_vectors(np.array([frame.rotation]))
    measured = np.column_stack([source.values[axis] for axis in CARTESIAN])
    point = frame.at + rotations.turned(turn, measured)
    oriented, spread = source.orientation, dict(source.spread)
    if oriented is not None:
        back = rotations.of_vectors(-np.array([marker.rotation]))
        oriented = rotations.product(rotations.product(turn, oriented), back)
    if any(marker.at):
        tool = _commanded(name, source, run, config) if oriented is None else oriented
        lever = rotations.turned(tool, np.array([marker.at]))
        point = point - lever
        if oriented is not None:
            spread |= _spread(sensor, lever)
    values = dict(source.values) | dict(zip(CARTESIAN, point.T.copy(), strict=True))
    return replace(source, values=values, orientation=oriented, spread=spread)


def _spread(sensor: Sensor, lever: FloatArray) -> dict[str, FloatArray]:
    """How much larger the noise of the tool point is than that of the marker, as its orientation is noisy, too.

    The same along all axes, as the filters of the axes know no correlation: a third of the trace.
    """
    of_turning = np.mean([(sensor.sd_of(axis) or 0.0) ** 2 for axis in TURNING])
    more = np.nan_to_num(2.0 / 3.0 * np.sum(lever**2, axis=1)) * of_turning
    given = {axis: sd for axis in CARTESIAN if (sd := sensor.sd_of(axis))}
    return {axis: np.sqrt(1.0 + more / sd**2) for axis, sd in given.items()}


def _commanded(name: str, source: Source, run: Run, config: FusionConfig) -> FloatArray:
    """Where the commands have turned the tool by the instants of a sensor's measurements, as quaternions, (rows, 4).

    Raises:
        ConfigError: The arm or the commands have no orientation.
        RunError: The commands' clock was set back.
    """
    commanded, arm, where = run.command.orientation, config.arm, f"sensors.{name}.marker"
    if commanded is None or config.tool is None:
        raise ConfigError(f"{where}: nothing tells how the tool is turned: neither the sensor nor the commands")
    if not set(TURNING) <= set(arm.axes):
        raise ConfigError(f"{where}: the sensor tells no orientation, and the arm '{arm.name}' has no axes rx, ry, rz")
    reference, stamp = np.array(config.tool.reference), run.command.stamp
    vector = rotations.vectors(commanded, reference)
    told = np.isfinite(vector[:, 0]) & (stamp != NO_STAMP)
    given, vector = stamp[told], vector[told]
    if (np.diff(given) < -TOLERATED_STEP_BACK_NS).any():
        raise RunError(f"{run.command.label}: the clock is set back; sensor '{name}' needs one time: cut the log there")
    if (np.diff(given) < 0).any():
        order = np.argsort(given, kind="stable")
        given, vector = given[order], vector[order]
    asked = np.where(source.stamp == NO_STAMP, given[0], source.stamp - round(config.sensors[name].latency * 1e9))
    order = np.argsort(asked, kind="stable")
    found = np.empty((len(asked), 3))
    for column, axis in enumerate(TURNING):
        model, start = arm.axes[axis], float(vector[0, column])
        moved = response(model, arm.update_period, arm.delay_of(axis), given, vector[:, column], start, asked[order])
        found[order, column] = start + moved
    return rotations.quaternions(found, reference)
