"""Sensors in frames of their own: what they tell of the tool, along the base's axes.

The tool point is base_from_sensor · z − R · marker. R is the tool's orientation: as the same row tells it, else where
the commands have turned the tool by the instant of the measurement.
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np

from ..arrays import NO_STAMP, FloatArray, TimeArray, known_rows
from ..errors import ConfigError, RunError
from ..filter.core import Record
from ..filter.response import at_rest, follow, record_of
from ..logs.axes import in_axes, reference_orientation
from ..logs.clock import TOLERATED_STEP_BACK_NS, without_strays
from ..logs.frames import CARTESIAN, Placed
from ..logs.run import Run
from ..logs.screening import lost
from ..logs.source import Source
from ..model.arm import ArmModel
from ..space import rotations
from ..space.rotations import TURNING
from .config import FusionConfig, Placement, Sensor, Tool

_HERE = Placement()
_ELSEWHERE = np.radians(30.0)  # what no arm lags or errs by for most of a run
_QUIET = np.errstate(over="ignore", invalid="ignore")  # a sensor without a target may report infinity


def in_base(run: Run, config: FusionConfig, *, whole: bool = True) -> tuple[Run, Placed | None, FusionConfig]:
    """The run in the arm's axes, with what sensors in frames of their own tell of the tool.

    Beside it the frame as it is placed, and the configuration with the reference orientation of the run where it had
    none. A piece of a run is not ``whole``: it does not begin with the first command.
    """
    run = without_strays(run).delayed(config.arm)
    config = add_tool(config, run)
    tool = config.tool.reference if config.tool else None
    of_tool = {
        name: _of_tool(name, source, run, config, whole=whole)
        for name, source in run.sensors.items()
        if name in config.sensors and config.sensors[name].is_placed
    }
    in_axes_of_arm, placed = in_axes(replace(run, sensors={**run.sensors, **of_tool}), config.frame, tool)
    if in_axes_of_arm.tool is not None and not set(TURNING) & set(config.arm.axes):
        in_axes_of_arm = in_axes_of_arm.each(lambda _, source: source.without(TURNING))
    return in_axes_of_arm, placed, config


def add_tool(config: FusionConfig, run: Run) -> FusionConfig:
    """The configuration with the robot of a run, and the reference orientation of its commands where it has none."""
    tool, robot = reference_orientation(run) if config.tool is None else None, run.robot or config.robot
    return msgspec.structs.replace(config, tool=config.tool if tool is None else Tool(reference=tool), robot=robot)


class Placing:
    """What a sensor in a frame of its own tells of the tool, row by row: no bit of a row depends on other rows."""

    def __init__(self, sensor: Sensor, arm: ArmModel) -> None:
        """Take where the sensor stands, what it sees, and its noise."""
        # Whether the orientation that it tells is used: not without any noise of it, where the commands tell one. Some
        # attitudes do not belong to their positions.
        self.is_oriented = sensor.sd_of(TURNING[0]) is not None or not set(TURNING) <= set(arm.axes)
        frame, marker = sensor.frame or _HERE, sensor.marker or _HERE
        self._at, self._turn = np.array(frame.at), rotations.of_vectors(np.array([frame.rotation]))
        self._marker, self._back = np.array([marker.at]), rotations.of_vectors(-np.array([marker.rotation]))
        self.has_marker = any(marker.at)  # whether the tool's orientation is needed to know where it is
        self._variance = float(np.mean([(sensor.sd_of(axis) or 0.0) ** 2 for axis in TURNING]))
        self._sd = {axis: sd for axis in CARTESIAN if (sd := sensor.sd_of(axis))}

    @_QUIET
    def to_base(self, measured: FloatArray) -> FloatArray:
        """What it sees, along the base's axes [m], of x, y and z [m] in its own frame, (n, 3); NaN where it is lost."""
        return np.where(lost(measured)[:, None], np.nan, self._at + rotations.rotate(self._turn, measured))

    def orientation(self, measured: FloatArray) -> FloatArray:
        """The tool's orientation of what it measures, as quaternions, (n, 4) → (n, 4)."""
        return rotations.product(rotations.product(self._turn, measured), self._back)

    def lever(self, tool: FloatArray) -> FloatArray:
        """The way from the tool point to what it sees [m], by the tool's orientation, (n, 4) → (n, 3)."""
        return rotations.rotate(tool, self._marker)

    def spread(self, lever: FloatArray) -> dict[str, FloatArray]:
        """How much larger the noise of the tool point is than that of what it sees, as its orientation is noisy, too.

        The same along all axes, as the filters of the axes know no correlation: a third of the trace.
        """
        x, y, z = np.square(lever).T
        more = np.nan_to_num(2.0 / 3.0 * (x + y + z)) * self._variance
        return {axis: np.sqrt(1.0 + more / sd**2) for axis, sd in self._sd.items()}


def _of_tool(name: str, source: Source, run: Run, config: FusionConfig, *, whole: bool) -> Source:
    """What a sensor in a frame of its own tells of the tool."""
    if not set(CARTESIAN) <= source.values.keys():
        raise RunError(f"{source.label_for(name)}: has a frame or a marker, so that it must give x, y and z")
    placing, spread = Placing(config.sensors[name], config.arm), dict(source.spread)
    turned = source.orientation if placing.is_oriented else None
    measured = np.column_stack([source.values[axis] for axis in CARTESIAN])
    point = placing.to_base(measured)
    oriented = None if turned is None else np.where(lost(measured)[:, None], np.nan, placing.orientation(turned))
    if oriented is not None and whole and _can_be_commanded(run, config):
        _check_orientation(name, source, oriented, run)
    if placing.has_marker:
        lever = np.full(point.shape, np.nan) if oriented is None else placing.lever(oriented)
        spread |= placing.spread(lever)
        untold = np.isnan(lever[:, 0]) & np.isfinite(point[:, 0])
        if untold.any() and not whole:
            raise RunError(
                f"{source.label_for(name)}: rows without an orientation, which only the commands"
                " of a whole run tell; so long a run is fused piece by piece: cut it into shorter ones"
            )
        if oriented is None or (untold.any() and _can_be_commanded(run, config)):
            lever[untold] = placing.lever(_commanded_orientation(name, source.stamp[untold], run, config))
        point = point - lever
    values = dict(source.values) | dict(zip(CARTESIAN, point.T.copy(), strict=True))
    return replace(source, values=values, orientation=oriented, spread=spread)


def _check_orientation(name: str, source: Source, oriented: FloatArray, run: Run) -> None:
    """Whether a sensor tells the tool to be turned about as it is commanded to be."""
    assert run.command.orientation is not None
    commanded_at, commanded = known_rows(run.command.stamp, run.command.orientation)
    stamp, seen = known_rows(source.stamp, oriented)
    if not len(commanded_at) or not len(stamp):
        return
    last = np.clip(np.searchsorted(commanded_at, stamp, side="right") - 1, 0, None)
    off = float(np.median(rotations.angle_between(seen, commanded[last])))
    if off > _ELSEWHERE:
        raise RunError(
            f"{source.label_for(name)}: it tells the tool to be turned {np.degrees(off):.0f}° from where it is"
            f" commanded to be: give rotation_vector_deg of sensors.{name}.marker, which `pumafuse register` finds, or"
            " leave its orientation out of run.toml"
        )


def _can_be_commanded(run: Run, config: FusionConfig) -> bool:
    """Whether commands turn the tool."""
    return run.command.orientation is not None and config.tool is not None and set(TURNING) <= set(config.arm.axes)


def _commanded_orientation(name: str, stamp: TimeArray, run: Run, config: FusionConfig) -> FloatArray:
    """Where the commands have turned the tool by the instants of a sensor's measurements, as quaternions, (rows, 4)."""
    commanded, arm, where = run.command.orientation, config.arm, f"sensors.{name}.marker"
    if commanded is None or config.tool is None or np.isnan(commanded).all():
        raise ConfigError(f"{where}: nothing tells how the tool is turned: neither the sensor nor the commands")
    if not set(TURNING) <= set(arm.axes):
        raise ConfigError(f"{where}: the sensor tells no orientation, and the arm '{arm.name}' has no axes rx, ry, rz")
    reference, commanded_at = np.array(config.tool.reference), run.command.stamp
    vector = rotations.vectors(commanded, reference)
    usable = np.isfinite(vector[:, 0]) & (commanded_at != NO_STAMP)
    commanded_at, vector = commanded_at[usable], vector[usable]
    if (np.diff(commanded_at) < -TOLERATED_STEP_BACK_NS).any():
        raise RunError(f"{run.command.label}: the clock is set back; sensor '{name}' needs one time: cut the log there")
    order = np.argsort(commanded_at, kind="stable")
    commanded_at, vector = commanded_at[order], vector[order]
    last = np.append(np.diff(commanded_at) > 0, True)  # of a stamp the last command counts
    commanded_at, vector = commanded_at[last], vector[last]
    asked = np.where(stamp == NO_STAMP, commanded_at[0], stamp - round(config.sensors[name].latency * 1e9))
    order = np.argsort(asked, kind="stable")
    vectors = np.empty((len(asked), 3))
    for column, record in enumerate(turning_axes(arm)):
        relative = vector[:, column] - vector[0, column]
        vectors[order, column] = vector[0, column] + follow(record, at_rest(), commanded_at, relative, asked[order])
    return rotations.quaternions(vectors, reference)


def turning_axes(arm: ArmModel) -> list[Record]:
    """The axes rx, ry and rz of an arm, without noise, as the core takes them, relative to where they rest."""
    return [record_of(arm.axes[axis], arm.update_period, arm.delay_of(axis), 0.0) for axis in TURNING]
