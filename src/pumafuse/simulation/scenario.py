"""``scenario.toml``: an arm model, the true arm, a trajectory, sensors, and the filter's configuration."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, cast

import msgspec
import numpy as np

from .. import toml, units
from ..errors import ConfigError, PumafuseError, UnknownNameError
from ..fusion.config import (
    PROCESS,
    FusionConfig,
    PerAxis,
    Process,
    by_axis,
    fill_defaults,
    load_arm,
    of_all_axes,
    of_axis,
    rename_to_kinds,
    rename_to_lengths,
)
from ..logs import save
from ..logs.frames import CARTESIAN, Frame
from ..logs.manifest import axis_of
from ..logs.run import Clock
from ..model.arm import ArmModel
from ..toml import NotNegative
from ..units import of_kind
from .motion import POINTS
from .trajectory import TRAJECTORIES, PathFromFile, Steps
from .true_arm import TrueArm, TrueAxis
from .true_sensor import OF_OUTLIERS, PER_AXIS, Outliers, TrueSensor

_OVERRIDES = ("start", "process", "sensors")
_SMALLEST, _LARGEST_LENGTH, _LARGEST = 1e-12, 1e5, 4e9  # SI; 100 km, 127 years


class CommandLog(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the commands are logged."""

    # standard deviation of the logger's stamps around the true ticks [s]
    stamp_jitter: NotNegative = msgspec.field(name="stamp_jitter_ms", default=0.0)
    clock: Clock = "stamps"  # what ``run.toml`` says of the stamps


class ReferenceLog(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the reference is recorded."""

    # rows in each update period, the first at the command's own instant
    rows_per_command: Annotated[int, msgspec.Meta(gt=0, le=POINTS)] = 5
    # standard deviation of its noise [m or rad], of all axes or of each
    sd: PerAxis = msgspec.field(name="sd_mm", default=0.0)


class TrueStart(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the arm rests before the first command."""

    # standard deviation of the offset there, drawn for each run and axis [m or rad]
    offset_sd: PerAxis = msgspec.field(name="offset_sd_mm", default=0.0)
    level: dict[str, float] = msgspec.field(default_factory=dict[str, float])  # by axis [m or rad]; 0 where absent


class Scenario(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What ``scenario.toml`` holds, in SI units.

    Attributes:
        name: For people and for the runs' names.
        teaches: A sentence on what it is good for.
        seed: Seed of the first run.
        arm: The arm model that the filter has.
        true_arm: How the true arm differs from it, by axis.
        trajectory: The commands.
        start: Where the arm rests before the first command.
        process: True process noise, by axis.
        command: How the commands are logged.
        reference: How the true motion is recorded.
        sensors: How each sensor measures.
        frame: With one, commands, sensors and reference are logged in x, y, z.
        start_azimuth: Direction of the start level from the base, counterclockwise from x [rad].
        filter: Tables of ``fusion.toml`` in which the filter's configuration differs from what is simulated.
    """

    name: str
    teaches: str = ""
    seed: Annotated[int, msgspec.Meta(ge=0)] = 1
    arm: ArmModel
    true_arm: dict[str, TrueArm] = {}
    trajectory: TRAJECTORIES
    start: TrueStart = TrueStart()
    process: dict[str, Process] = {}
    command: CommandLog = CommandLog()
    reference: ReferenceLog = ReferenceLog()
    sensors: dict[str, TrueSensor] = {}
    frame: Frame | None = None
    start_azimuth: float = msgspec.field(name="start_azimuth_deg", default=0.0)
    filter: dict[str, Any] = {}

    def __repr__(self) -> str:
        sensors = ", ".join(self.sensors) or "no sensor"
        return f"Scenario(arm {self.arm.name!r} with {', '.join(self.arm.axes)}; {sensors})"

    def __post_init__(self) -> None:
        for name in (*self.trajectory.moving, *self.start.level):
            self.arm.axis(name)
        for name in self.arm.axes:
            save.check_axis(name)
        for name, sensor in self.sensors.items():
            save.check_name(name)
            self._check(f"sensors.{name}", sensor)
        if isinstance(self.trajectory, Steps):
            self._check_scope(self.trajectory)
        for key in self.filter:
            if key not in _OVERRIDES:
                raise UnknownNameError("filter", "table", key, _OVERRIDES)
        if self.frame is not None:
            if not {"tangential", "radial"} <= set(self.arm.axes):
                raise ConfigError(
                    "frame: is for an arm with the axes tangential and radial; an arm in x, y, z needs none"
                )
            if not self.start.level.get("radial", 0.0) > 0.0:
                raise ConfigError("frame: start.level.radial_mm must say how far from the base's axis the arm starts")
        _ = self.config, self.true_axes  # raise now if something does not fit together

    def _check(self, where: str, sensor: TrueSensor) -> None:
        logged, fastest = self._logged_axes(sensor), POINTS / self.arm.update_period
        sd, bias = (of_kind(key, self.arm.kinds[0]) for key in ("sd_mm", "bias_mm"))
        for key, named in (("axes", sensor.axes), (sd, sensor.sd), (bias, sensor.bias)):
            for name in named if isinstance(named, list | dict) else ():
                if name not in logged:
                    raise UnknownNameError(f"{where}.{key}", "axis", name, logged)
        if isinstance(sensor.sd, dict):
            if logged is CARTESIAN:
                raise ConfigError(f"{where}.{sd}: one number for a sensor in x, y, z")
            for axis in self.trajectory.moving:
                if axis in (sensor.axes or logged) and axis not in sensor.sd:
                    raise ConfigError(f"{where}.{sd}: no entry for '{axis}', which it measures")
        if sensor.rate > fastest:
            limit = f"at most {fastest:g} on this arm ({POINTS} rows a command)"
            raise ConfigError(f"{where}.rate_hz: {limit}, got {sensor.rate:g}")
        for axis, model in self.arm.axes.items():
            if (wrong := sensor.outliers) and of_axis(wrong.largest, axis) < of_axis(wrong.smallest, axis):
                smaller, larger = (of_kind(key, model.kind) for key in OF_OUTLIERS)
                raise ConfigError(f"{where}.outliers: {larger} is smaller than {smaller}")
        for start, end in sensor.outages:
            if end <= start:
                raise ConfigError(f"{where}.outages_s: [{start:g}, {end:g}] ends before it begins")

    def _check_scope(self, campaign: Steps) -> None:
        if campaign.scope not in self.sensors:
            raise UnknownNameError("trajectory.scope", "sensor", campaign.scope, self.sensors)
        scope = self.sensors[campaign.scope]
        for axis in campaign.axes:
            if axis not in (scope.axes or self._logged_axes(scope)):
                raise ConfigError(f"sensors.{campaign.scope}.axes: the scope must measure '{axis}', which is stepped")

    def _logged_axes(self, sensor: TrueSensor) -> tuple[str, ...]:
        """The axes in which a sensor can be logged."""
        return CARTESIAN if self.frame is not None and sensor.axes is None else tuple(self.arm.axes)

    @property
    def true_axes(self) -> dict[str, TrueAxis]:
        """The true arm, axis by axis."""
        return {
            name: self.true_arm.get(name, TrueArm()).over(axis, self.arm.delay_of(name), f"true_arm.{name}")
            for name, axis in self.arm.axes.items()
        }

    @property
    def config(self) -> FusionConfig:
        """The filter's configuration: what is simulated, overridden by ``filter``."""
        simulated: dict[str, Any] = {
            "start": {"offset_sd_mm": self.start.offset_sd},
            "process": {
                axis: toml.builtins(self.process.get(axis, PROCESS[model.kind]))
                for axis, model in self.arm.axes.items()
            },
            "sensors": {name: sensor.to_config() for name, sensor in self.sensors.items()},
        }
        override = rename_to_lengths(self.filter, self.arm, "filter")
        if isinstance(override.get("sensors"), dict):
            for name in override["sensors"]:
                if name not in self.sensors:
                    raise UnknownNameError("filter.sensors", "sensor", name, self.sensors)
        return toml.struct({**_merge(simulated, override), "arm": self.arm}, FusionConfig, "filter")

    def to_toml(self, seed: int, arm: str) -> str:
        """The text of a ``scenario.toml`` with this ``seed``, and its arm in the file ``arm``."""
        tree, models = toml.builtins(self), self.arm.axes
        tree["arm"], tree["seed"] = arm, seed
        for key, parts in (("true_arm", self.true_arm), ("process", self.process)):
            tree[key] = {axis: toml.builtins(part, models[axis].kind) for axis, part in parts.items()}
        tree["trajectory"] = toml.builtins(self.trajectory, _kind_of(self.trajectory.moving, self.arm))
        tree["start"] = rename_to_kinds(tree["start"], self.arm, ["offset_sd_mm"])
        screens = {axis: self.arm.screen_of(axis) for axis in self.start.level}
        tree["start"]["level"] = {f"{axis}_{screens[axis].unit}": level for axis, level in self.start.level.items()}
        tree["reference"] = rename_to_kinds(tree["reference"], self.arm, ["sd_mm"])
        for name, sensor in tree["sensors"].items():
            tree["sensors"][name] = rename_to_kinds(sensor, self.arm, PER_AXIS)
            if "outliers" in sensor:
                tree["sensors"][name]["outliers"] = rename_to_kinds(sensor["outliers"], self.arm, OF_OUTLIERS)
        return toml.text({key: value for key, value in tree.items() if value != {}})

    @staticmethod
    def load(path: str | Path) -> Scenario:
        """Read ``scenario.toml`` and the arm it names.

        Raises:
            ConfigError: The file or its arm is not as declared; names file, key and the accepted names.
            UnknownNameError: A table is of an axis that the arm does not have.
        """
        path = Path(path)
        tree, where = toml.read(path), str(path)
        _check_magnitudes({key: value for key, value in tree.items() if key != "seed"}, where)
        tree["arm"] = load_arm(tree, path)
        scenario = toml.struct(_rename_to_lengths(tree, tree["arm"], where), Scenario, where)
        trajectory = scenario.trajectory
        if isinstance(trajectory, PathFromFile):
            beside = msgspec.structs.replace(trajectory, file=str(path.parent / trajectory.file))
            scenario = msgspec.structs.replace(scenario, trajectory=beside)
        try:
            scenario.trajectory.offsets(scenario.arm.update_period, np.random.default_rng(scenario.seed))
        except PumafuseError as error:
            raise ConfigError(f"{where}: {error}") from None
        return scenario


def _rename_to_lengths(tree: Mapping[str, Any], arm: ArmModel, where: str) -> dict[str, Any]:
    """The tables of a file (SI numbers) with the key names for lengths, where those of angles are."""
    lengths = dict(tree)
    for key, kind in (("true_arm", TrueArm), ("process", Process)):
        if isinstance(lengths.get(key), dict):
            lengths[key] = by_axis(lengths[key], kind, arm, where, key)
    if isinstance(lengths.get("process"), dict):
        lengths["process"] = fill_defaults(lengths["process"], arm)
    if isinstance(start := lengths.get("start"), dict):
        lengths["start"] = _start(cast(dict[str, Any], start), arm, where)
    if "reference" in lengths:
        lengths["reference"] = of_all_axes(lengths["reference"], ReferenceLog, arm, where, "reference", ["sd_mm"])
    if isinstance(sensors := lengths.get("sensors"), dict):
        named = cast(dict[str, Any], sensors)
        lengths["sensors"] = {name: _sensor(table, arm, where, f"sensors.{name}") for name, table in named.items()}
    if isinstance(trajectory := lengths.get("trajectory"), dict):
        table = cast(dict[str, Any], trajectory)
        axes: Any = table.get("axes", [table.get(key) for key in ("along", "across")])
        kind = _kind_of(cast(list[Any], axes) if isinstance(axes, list) else [], arm)
        lengths["trajectory"] = toml.struct(table, cast(Any, TRAJECTORIES), where, "trajectory", kind)
    return lengths


def _start(table: Mapping[str, Any], arm: ArmModel, where: str) -> dict[str, Any]:
    start = of_all_axes(table, TrueStart, arm, where, "start", ["offset_sd_mm"])
    if isinstance(levels := start.get("level"), dict):
        named, start["level"] = cast(dict[str, Any], levels), dict[str, Any]()
        for key, level in named.items():
            axis = axis_of(key, where, "start.level")
            if axis in start["level"]:
                raise ConfigError(f"{where}: start.level gives an axis twice")
            if axis in arm.axes and arm.axes[axis].kind != units.kind_of(key):
                raise ConfigError(f"{where}: start.level.{key}: {axis} is {units.AN[arm.axes[axis].kind]}")
            start["level"][axis] = level
    return start


def _sensor(table: Any, arm: ArmModel, where: str, path: str) -> Any:
    sensor = of_all_axes(table, TrueSensor, arm, where, path, PER_AXIS)
    if isinstance(sensor, dict) and "outliers" in sensor:
        sensor["outliers"] = of_all_axes(sensor["outliers"], Outliers, arm, where, f"{path}.outliers", OF_OUTLIERS)
    return sensor  # pyright: ignore[reportUnknownVariableType]


def _kind_of(moving: Iterable[object], arm: ArmModel) -> units.Kind:
    """The kind of the axes that a trajectory moves: one."""
    kinds: list[units.Kind] = [arm.axes[axis].kind for axis in moving if isinstance(axis, str) and axis in arm.axes]
    if len(set(kinds)) > 1:
        raise ConfigError("trajectory: moves lengths and angles; its sizes would have two units")
    return kinds[0] if kinds else "length"


def _check_magnitudes(tree: Mapping[str, Any], where: str, path: str = "", inherited: str | None = None) -> None:
    """Refuse numbers (SI) with which nothing could be computed."""
    for key, value in tree.items():
        unit = units.ending(key) or inherited
        largest = _LARGEST_LENGTH if unit in units.LENGTHS else _LARGEST
        if isinstance(value, Mapping):
            _check_magnitudes(cast(Mapping[str, Any], value), where, f"{path}{key}.", unit)
        for number in cast(list[Any], value if isinstance(value, list) else [value]):
            if isinstance(number, float | int) and number and not _SMALLEST <= abs(number) <= largest:
                raise ConfigError(f"{where}: {path}{key}: a size with which nothing can be simulated")


def _merge(tree: Mapping[str, Any], override: Mapping[str, Any]) -> dict[str, Any]:
    """``tree`` with the entries of ``override`` in their places."""
    merged = dict(tree)
    for key, value in override.items():
        before = merged.get(key)
        merged[key] = _merge(before, value) if isinstance(before, Mapping) and isinstance(value, Mapping) else value  # pyright: ignore
    return merged
