"""``fusion.toml``: the arm, the process noise, and the sensors.

Keys of one axis have the units of its kind; tables for all axes may hold both: ``sd_mm`` for the axes that are lengths,
``sd_deg`` for those that are angles.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import msgspec
import numpy as np

from .. import toml
from ..errors import ConfigError, UnknownNameError, shortened, suggestion
from ..logs.frames import CARTESIAN, Frame
from ..logs.manifest import Robot, chain_of
from ..model.arm import PRESETS, ArmModel, arm_of
from ..space import rotations
from ..space.rotations import TURNING
from ..toml import NotNegative, Positive, Time
from ..units import AN, KINDS, Kind, of_kind, refuse_name

PerAxis = (
    NotNegative | Annotated[dict[str, NotNegative], msgspec.Meta(min_length=1)]
)  # one number, or one for each axis

Vector = tuple[float, float, float]

SD_BOUNDS = (1e-7, 1.0)  # m or rad; of a sensor's noise that is fitted
_LONGEST_LATENCY = 3600.0  # s
_LARGEST_SCALE = 1e9  # as high as all numbers of a configuration
_OFFSET_SD: dict[Kind, float] = {"length": 5e-3, "angle": math.radians(5.0)}
_PER_AXIS = ("sd_mm", "bias_sd_mm", "bias_drift_sd_mm")  # keys of a sensor that may differ from axis to axis
ARM_FILE, ROBOT_FILE = "arm.toml", "robot.urdf"  # beside a saved configuration: its arm, and what its joints move


def of_axis(value: float | Mapping[str, float], axis: str, absent: float = 0.0) -> float:
    """A number of all axes, or that of one axis; ``absent`` where there is none of it."""
    return value.get(axis, absent) if isinstance(value, Mapping) else value


class Start(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Prior uncertainty at the start.

    Attributes:
        offset_sd: That of the offset [m or rad], for all axes or for each; None: 5 mm or 5°, by a configuration's arm.
    """

    offset_sd: PerAxis | None = msgspec.field(name="offset_sd_mm", default=None)

    def offset_sd_of(self, axis: str, kind: Kind = "length") -> float:
        """The uncertainty of one axis's offset [m or rad]."""
        default = _OFFSET_SD[kind]
        return default if self.offset_sd is None else of_axis(self.offset_sd, axis, default)

    def of_arm(self, arm: ArmModel) -> Start:
        """The start with a number for every axis: one, where it is the same for all."""
        each = {axis: self.offset_sd_of(axis, axis_model.kind) for axis, axis_model in arm.axes.items()}
        return Start(offset_sd=each if len(set(each.values())) > 1 else next(iter(each.values())))


class Process(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Process noise of one axis, m being rad for an angle; the variances of the two parts of each density add up.

    Attributes:
        input_noise: Density of the white noise at the plant's input [m/√Hz]. The default in a file is 0.03 mm/√Hz, or
            that in degrees for an angle.
        drift: Density of the offset's random walk [m/√s]. The default in a file is 0.4 mm/√s, or that in degrees.
        maneuver_noise: More input noise per m/s of change in commanded speed [m/√Hz per m/s].
        maneuver_drift: More drift per m/s of change in commanded speed [m/√s per m/s].
        disturbance_sd: Standard deviation of a disturbance that reverts to 0 [m]; 0: there is none.
        disturbance_time: How long it lasts [s].
        disturbance_kind: ``matern``: of smoothness 3/2, or ``ou``: Ornstein-Uhlenbeck, of smoothness 1/2.
        adaptation: How fast all of these follow what innovations show, a step of the logarithm of their variances;
            0: they stay as they are, 1: the most.
    """

    input_noise: NotNegative = msgspec.field(name="input_noise_mm_rtHz", default=0.03e-3)
    drift: NotNegative = msgspec.field(name="drift_mm_rts", default=0.4e-3)
    maneuver_noise: NotNegative = msgspec.field(name="maneuver_noise_mm_rtHz_per_m_s", default=0.0)
    maneuver_drift: NotNegative = msgspec.field(name="maneuver_drift_mm_rts_per_m_s", default=0.0)
    disturbance_sd: NotNegative = msgspec.field(name="disturbance_sd_mm", default=0.0)
    disturbance_time: Time = msgspec.field(name="disturbance_time_ms", default=0.3)
    disturbance_kind: Literal["matern", "ou"] = "matern"
    adaptation: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0


PROCESS: dict[Kind, Process] = {  # what is not configured
    "length": Process(),
    "angle": Process(input_noise=math.radians(0.03), drift=math.radians(0.4)),
}


class Placement(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A place and an orientation in another frame.

    Attributes:
        at: Where it is [m].
        rotation: Its orientation as a rotation vector [rad].
    """

    at: Vector = msgspec.field(name="at_mm", default=(0.0, 0.0, 0.0))
    rotation: Vector = msgspec.field(name="rotation_vector_deg", default=(0.0, 0.0, 0.0))

    def turned_sd(self, sds: Sequence[float]) -> list[float]:
        """The noise along the other frame's axes of what is independent along its own; the correlation is lost."""
        return np.hypot.reduce(rotations.matrix(np.array(self.rotation)) * np.array(sds), axis=1).tolist()


class Tool(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A tool that turns.

    Attributes:
        reference: The orientation R₀ at which the axes rx, ry, rz are 0, as a rotation vector [rad].
    """

    reference: Vector = msgspec.field(name="reference_rotation_vector_deg")


class Sensor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """z = scale · p(stamp − latency) + bias + noise.

    Attributes:
        sd: Noise [m or rad], one number or one for each axis of the arm.
        latency: From the instant at which the measurement is valid to its stamp [s].
        latency_sd: Standard deviation of the latency from measurement to measurement [s].
        scale: Factor on the position; −1 for a distance to a panel in front.
        bias_sd: Prior uncertainty of a constant bias [m or rad], one number or one for each axis; 0: no bias is
            estimated.
        bias_drift_sd: Standard deviation of a bias that drifts and reverts to 0, beside the constant one, likewise.
        bias_time: How long such a drift lasts [s].
        turn: After which it measures an angle again [rad]: a measurement is the nearest of all turns; 0: never.
        gate: A measurement beyond this many standard deviations is rejected; 0: never.
        gate_rows: Whether one rejected axis rejects the whole row; None: unless all its axes are angles, as of an
            encoder each.
        frame: Where it stands, base_from_sensor; None: it measures along the base's axes.
        marker: What it sees, on the tool, tool_from_marker; None: the tool point.
    """

    sd: Positive | Annotated[dict[str, Positive], msgspec.Meta(min_length=1)] = msgspec.field(name="sd_mm")
    latency: float = msgspec.field(name="latency_ms", default=0.0)
    latency_sd: NotNegative = msgspec.field(name="latency_sd_ms", default=0.0)
    scale: float = 1.0
    bias_sd: PerAxis = msgspec.field(name="bias_sd_mm", default=0.0)
    bias_drift_sd: PerAxis = msgspec.field(name="bias_drift_sd_mm", default=0.0)
    bias_time: Time = msgspec.field(name="bias_time_s", default=10.0)
    turn: NotNegative = msgspec.field(name="turn_deg", default=0.0)
    gate: NotNegative = 50.0
    gate_rows: bool | None = None
    frame: Placement | None = None
    marker: Placement | None = None

    @property
    def is_placed(self) -> bool:
        """Whether it stands, or sees the tool, elsewhere than the robot says."""
        return self.frame is not None or self.marker is not None

    def sd_of(self, axis: str) -> float | None:
        """The noise on one axis of the arm [m or rad]; None where the sensor has none and so is not used."""
        return self.sd.get(axis) if isinstance(self.sd, dict) else self.sd

    def bias_sd_of(self, axis: str) -> float:
        """The uncertainty of its constant bias on one axis [m or rad]; 0 where none is estimated."""
        return of_axis(self.bias_sd, axis)

    def bias_drift_sd_of(self, axis: str) -> float:
        """The standard deviation of its drifting bias on one axis [m or rad]; 0 where there is none."""
        return of_axis(self.bias_drift_sd, axis)

    def gates_rows(self, arm: ArmModel) -> bool:
        """Whether one rejected axis rejects the whole row."""
        if self.gate_rows is not None:
            return self.gate_rows
        return any(model.kind == "length" and self.sd_of(axis) is not None for axis, model in arm.axes.items())

    def is_biased(self, axis: str) -> bool:
        """Whether it has a bias on one axis, constant or drifting."""
        return self.bias_sd_of(axis) > 0.0 or self.bias_drift_sd_of(axis) > 0.0

    def is_at_bound(self, axis: str) -> bool:
        """Whether its noise on an axis is at a bound of what is fitted, or beyond: no measurement determined it."""
        sd = self.sd_of(axis)
        return sd is not None and not SD_BOUNDS[0] < sd < SD_BOUNDS[1]


class FusionConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The content of ``fusion.toml`` in SI units.

    Attributes:
        arm: The arm model.
        start: Prior uncertainty at the start.
        process: Process noise by axis; every axis of the arm is there.
        frame: For streams and runs in x, y, z that have no frame of their own.
        tool: The reference orientation of a tool that turns; None: a run's mean.
        robot: The chain by which joints of a stream are poses of the tool.
        sensors: By name, in the order of processing of measurements valid at the same instant.
    """

    arm: ArmModel
    start: Start = Start()
    process: dict[str, Process] = {}
    frame: Frame | None = None
    tool: Tool | None = None
    robot: Robot | None = None
    sensors: dict[str, Sensor] = {}

    def __post_init__(self) -> None:
        _known_axes("process", self.process, self.arm)
        _check("start", self.start, self.arm.kinds[0])
        for axis, process in self.process.items():
            _check(f"process.{axis}", process, self.arm.axes[axis].kind)
        for name, sensor in self.sensors.items():
            _check(f"sensors.{name}", sensor, self.arm.kinds[0])
            refuse_name("sensor", name)
            if not math.isfinite(sensor.scale + sensor.latency + sensor.gate + sensor.latency_sd):
                raise ConfigError(f"sensors.{name}: scale, latency, gate and sds must be finite")
            for key, value in zip(_PER_AXIS, (sensor.sd, sensor.bias_sd, sensor.bias_drift_sd), strict=True):
                if isinstance(value, dict):
                    _known_axes(f"sensors.{name}.{key}", value, self.arm)
            if abs(sensor.latency) > _LONGEST_LATENCY:
                raise ConfigError(f"sensors.{name}.latency_ms: more than an hour; is it in ms?")
            if sensor.turn and "angle" not in self.arm.kinds:
                raise ConfigError(f"sensors.{name}.turn_deg: no axis of the arm is an angle")
            if not 1.0 / _LARGEST_SCALE <= abs(sensor.scale) <= _LARGEST_SCALE:
                raise ConfigError(f"sensors.{name}.scale: {sensor.scale:g} is no sensor's: 1e-9 to 1e9")
        complete = {axis: self.process.get(axis, PROCESS[model.kind]) for axis, model in self.arm.axes.items()}
        msgspec.structs.force_setattr(self, "process", complete)
        msgspec.structs.force_setattr(self, "start", self.start.of_arm(self.arm))

    def __repr__(self) -> str:
        sensors = ", ".join(self.sensors) or "no sensor"
        return f"FusionConfig(arm {self.arm.name!r} with {', '.join(self.arm.axes)}; {sensors})"

    @staticmethod
    def load(path: str | Path) -> FusionConfig:
        """Read ``fusion.toml`` and the arm it names.

        Raises:
            ConfigError: The file or its arm is not as declared; names file, key and the accepted names.
        """
        path = Path(path)
        tree, where = toml.read(path), str(path)
        config = _config(tree, load_arm(tree, path), where)
        if config.robot is None:
            return config
        robot = config.robot.beside(path.parent)
        chain_of(robot)  # what is wrong with it is said before anything begins
        return msgspec.structs.replace(config, robot=robot)

    @staticmethod
    def parse(source: str | Mapping[str, Any], arm: ArmModel | None = None) -> FusionConfig:
        """Make a configuration of the text of a ``fusion.toml``, or of a dict with the same keys.

        Args:
            source: The text or the dict. Its ``arm`` is the name of a preset, a table with the keys of an
                ``arm.toml``, or left out where an arm is given.
            arm: The arm.

        Raises:
            ConfigError: It is not as declared; names the key and the accepted ones.
        """
        where = "configuration"
        tree = toml.parsed(source, where)
        named = tree.get("arm")
        if arm is None and isinstance(named, Mapping):
            arm = arm_of(cast(Mapping[str, Any], named), f"{where}: arm")
        elif arm is None and isinstance(named, str) and named in PRESETS:
            arm = ArmModel.load(named)
        elif arm is None:
            raise ConfigError(f"{where}: 'arm' must be a preset ({', '.join(PRESETS)}), a table, or given as arm=")
        elif not isinstance(arm, ArmModel):  # pyright: ignore  (who is not checked may give its name)
            raise ConfigError(f"{where}: arm= takes what ArmModel.load or ArmModel.parse gives, not {arm!r:.40}")
        return _config(tree, arm, where)

    def save(self, folder: Path) -> None:
        """Write ``fusion.toml``, and beside it the arm as ``arm.toml`` and the robot as ``robot.urdf``.

        Raises:
            ConfigError: There is no such URDF any more.
        """
        (folder / "fusion.toml").write_text(self.to_toml(), encoding="utf-8")
        self.arm.save(folder / ARM_FILE)
        if self.robot is not None:
            (folder / ROBOT_FILE).write_text(toml.text_of(Path(self.robot.urdf)), encoding="utf-8")

    def to_toml(self) -> str:
        """The text of ``fusion.toml``, with ``arm.toml`` and, of a robot, ``robot.urdf`` beside it."""
        tree = toml.builtins(self)
        tree["arm"] = ARM_FILE
        if self.robot is not None:
            tree["robot"]["urdf"] = ROBOT_FILE
        tree["process"] = {
            axis: toml.builtins(process, self.arm.axes[axis].kind) for axis, process in self.process.items()
        }
        tree["start"] = rename_to_kinds(tree["start"], self.arm, ["offset_sd_mm"])
        tree["sensors"] = {name: rename_to_kinds(table, self.arm, _PER_AXIS) for name, table in tree["sensors"].items()}
        for sensor in tree["sensors"].values():
            if not sensor["turn_deg"]:
                del sensor["turn_deg"]
        return toml.text(tree)

    def sensor_names(self, chosen: Iterable[str] | None) -> tuple[str, ...]:
        """The sensors to use, in the order of the file; all of them for None.

        Raises:
            UnknownNameError: A chosen name is not configured.
        """
        if chosen is None:
            return tuple(self.sensors)
        wanted = {chosen} if isinstance(chosen, str) else set(map(str, chosen))
        for name in sorted(wanted - set(self.sensors)):
            raise UnknownNameError("sensors", "sensor", name, self.sensors)
        return tuple(name for name in self.sensors if name in wanted)


def _config(tree: Mapping[str, Any], arm: ArmModel, where: str) -> FusionConfig:
    """The configuration of parsed tables (SI numbers)."""
    tree = rename_to_lengths({**tree, "arm": arm}, arm, where)
    if isinstance(tree.get("process"), dict):
        tree["process"] = fill_defaults(tree["process"], arm)
    for name, table in cast(dict[str, Any], tree.get("sensors", {})).items():
        if isinstance(table, dict) and "sd_mm" not in table:
            sd = " or ".join(f"'sensors.{name}.{of_kind('sd_mm', of)}'" for of in arm.kinds)
            raise ConfigError(f"{where}: {sd} is missing; accepted: {', '.join(_accepted(Sensor, arm, _PER_AXIS))}")
    return toml.struct(tree, FusionConfig, where)


def _check(path: str, part: msgspec.Struct, kind: Kind) -> None:
    """Refuse a table that was made in Python and is out of range. A search makes thousands: the words come after."""
    try:
        msgspec.convert(toml.builtins(part), type(part))
    except msgspec.ValidationError:
        toml.struct(toml.builtins(part, kind), type(part), "configuration", path, kind)


def load_arm(tree: Mapping[str, Any], path: Path) -> ArmModel:
    """The arm that the tables ``tree`` of the file ``path`` name: a file beside it, or a preset."""
    name = tree.get("arm")
    if not isinstance(name, str):
        raise ConfigError(f"{path}: 'arm' is missing; give a file beside this one, or a preset, as in arm = 'arm.toml'")
    beside = path.parent / name
    is_file = os.path.isfile(beside)  # noqa: PTH113 - Path.is_file raises on a name that is too long
    if name in PRESETS and not is_file:
        return ArmModel.load(name)
    if not is_file:
        presets = ", ".join(PRESETS)
        raise ConfigError(f"{path}: arm = '{shortened(name)}': no such file beside it, and not a preset ({presets})")
    return ArmModel.load(beside)


def rename_to_lengths(tree: Mapping[str, Any], arm: ArmModel, where: str) -> dict[str, Any]:
    """The tables of a ``fusion.toml`` (SI numbers) with the key names for lengths, where those of angles are."""
    lengths = dict(tree)
    if isinstance(lengths.get("process"), dict):
        lengths["process"] = by_axis(lengths["process"], Process, arm, where, "process")
    if "start" in lengths:
        lengths["start"] = of_all_axes(lengths["start"], Start, arm, where, "start", ["offset_sd_mm"])
    if isinstance(sensors := lengths.get("sensors"), dict):
        named = cast(dict[str, Any], sensors)
        lengths["sensors"] = {name: _sensor(table, arm, where, f"sensors.{name}") for name, table in named.items()}
    return lengths


def by_axis(
    table: Mapping[str, Any], kind: type[msgspec.Struct], arm: ArmModel, where: str, path: str
) -> dict[str, dict[str, Any]]:
    """A table for each axis of the arm: ``[process]`` is for all axes, ``[process.x]`` overrides it for one.

    They have the key names for lengths.
    """
    names = {of: {of_kind(field.encode_name, of) for field in msgspec.structs.fields(kind)} for of in KINDS}
    keys = names["length"] | names["angle"]
    of_axes: dict[str, Any] = {k: value for k, value in table.items() if isinstance(value, dict) and k not in keys}
    _known_axes(f"{where}: {path}", of_axes, arm)
    common = {k: value for k, value in table.items() if k not in of_axes}
    of_arm = set[str]().union(*(names[of] for of in arm.kinds))
    numbers_by_axis: dict[str, dict[str, Any]] = {}
    for axis, model in arm.axes.items():
        numbers = {k: value for k, value in common.items() if k in names[model.kind] or k not in of_arm}
        numbers |= of_axes.get(axis, {})
        toml.struct(numbers, kind, where, f"{path}.{axis}" if axis in of_axes else path, model.kind)
        numbers_by_axis[axis] = toml.as_lengths(numbers, kind)
    return numbers_by_axis


def of_all_axes(
    table: Any, kind: type[msgspec.Struct], arm: ArmModel, where: str, path: str, per_axis: Sequence[str]
) -> Any:
    """A table for all axes of the arm as one of lengths; where axes are of both kinds, with a number for each axis."""
    if not isinstance(table, dict):
        return table
    lengths = cast(dict[str, Any], table).copy()
    types = {field.encode_name: field.type for field in msgspec.structs.fields(kind)}
    for key in per_axis:
        each: dict[str, Any] = {}
        for of in KINDS:
            name = of_kind(key, of)
            if name not in lengths:
                continue
            value = _by_axis(lengths.pop(name), of, arm)
            if of not in arm.kinds:
                right = of_kind(key, arm.kinds[0])
                raise ConfigError(f"{where}: {path}.{name}: no axis of the arm is {AN[of]}; give {right}")
            toml.check(value, types[key], where, f"{path}.{name}")
            if len(arm.kinds) == 1:
                lengths[key] = value
            else:
                axes_of_kind = [axis for axis, model in arm.axes.items() if model.kind == of]
                each |= cast(dict[str, Any], value) if isinstance(value, dict) else dict.fromkeys(axes_of_kind, value)
        if each:
            same = len(each) == len(arm.axes) and len(set(each.values())) == 1
            lengths[key] = next(iter(each.values())) if same else each
    for key in lengths.keys() - types.keys():
        raise ConfigError(f"{where}: unknown key '{path}.{key}'; {suggestion(key, _accepted(kind, arm, per_axis))}")
    return lengths


def _sensor(table: Any, arm: ArmModel, where: str, path: str) -> Any:
    """A sensor's table as one of lengths.

    The noise of three axes of its frame, as of one that sees depth less well, becomes that along the base's.
    """
    if isinstance(table, dict) and "frame" in table:
        table = cast(dict[str, Any], table).copy()
        frame = toml.struct(table["frame"], Placement, where, f"{path}.frame")
        for key in (of_kind("sd_mm", of) for of in KINDS):
            if isinstance(sds := table.get(key), list):
                toml.check(sds, tuple[Positive, Positive, Positive], where, f"{path}.{key}")
                table[key] = frame.turned_sd(cast(list[float], sds))
    return of_all_axes(table, Sensor, arm, where, path, _PER_AXIS)


def _by_axis(value: Any, kind: Kind, arm: ArmModel) -> Any:
    """Three numbers by axis; anything else as it is."""
    axes = CARTESIAN if kind == "length" else TURNING
    if not isinstance(value, list) or len(cast(list[Any], value)) != len(axes) or not set(axes) <= set(arm.axes):
        return cast(Any, value)
    return dict(zip(axes, cast(list[Any], value), strict=True))


def _accepted(kind: type[msgspec.Struct], arm: ArmModel, per_axis: Sequence[str]) -> list[str]:
    """The keys of a table for all axes of an arm."""
    keys = (field.encode_name for field in msgspec.structs.fields(kind))
    return [name for key in keys for name in ([of_kind(key, of) for of in arm.kinds] if key in per_axis else [key])]


def fill_defaults(process: Mapping[str, Mapping[str, Any]], arm: ArmModel) -> dict[str, dict[str, Any]]:
    """The tables of axes, with the key names for lengths, with what they leave out."""
    return {axis: {**toml.builtins(PROCESS[arm.axes[axis].kind]), **table} for axis, table in process.items()}


def rename_to_kinds(table: Mapping[str, Any], arm: ArmModel, per_axis: Sequence[str]) -> dict[str, Any]:
    """The inverse of :func:`of_all_axes`: a table of lengths with a key for each kind of the arm's axes."""
    with_kinds: dict[str, Any] = {}
    for key, value in table.items():
        if key not in per_axis:
            with_kinds[key] = value
        elif not isinstance(value, dict):
            with_kinds.update((of_kind(key, of), value) for of in arm.kinds)
        else:
            each = cast(dict[str, Any], value)
            for of in KINDS:
                if of_axes := {axis: size for axis, size in each.items() if arm.kind_of.get(axis, "length") == of}:
                    with_kinds[of_kind(key, of)] = of_axes
    return with_kinds


def _known_axes(where: str, named: Mapping[str, object], arm: ArmModel) -> None:
    for axis in named:
        if axis not in arm.axes:
            raise UnknownNameError(where, "axis", axis, arm.axes)
