"""``scenario.toml``: an arm, what differs in the true one, a trajectory, sensors, and what the filter believes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, cast

import msgspec
import numpy as np

from .. import toml, units
from ..arrays import FloatArray
from ..errors import ConfigError, PumafuseError, UnknownNameError
from ..fusion.config import FusionConfig, Process, by_axis, load_arm
from ..model.arm import ArmModel, AxisModel, Gain
from ..model.plants import PLANTS, FirstOrder, NotNegative, Positive, SecondOrder
from ..runs import save
from ..runs.frames import CARTESIAN, Frame
from ..runs.manifest import axis_of
from ..runs.run import Clock
from .trajectory import TRAJECTORIES, PathFromFile, Steps

_OVERRIDES = ("start", "process", "sensors")
_LEAST, _FARTHEST, _LONGEST = 1e-12, 1e5, 4e9  # SI; 100 km, 127 years
LATTICE = 60  # instants in each period: all that is random is drawn on them, so that it is the same whoever looks

Share: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1)]
PerAxis: TypeAlias = float | dict[str, float]


class GainCurve(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A gain that is no line: K at some speeds [m/s], linear between them and level outside."""

    speed: Annotated[list[NotNegative], msgspec.Meta(min_length=1)] = msgspec.field(name="speed_m_s")
    gain: Annotated[list[float], msgspec.Meta(min_length=1)]

    def __post_init__(self) -> None:
        if len(self.speed) != len(self.gain) or sorted(self.speed) != self.speed:
            raise ConfigError("gain_curve: speed_m_s must ascend and gain have as many entries")


class TrueArm(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is different about the true arm, on one axis or all; what is absent is as the filter believes.

    Attributes:
        plant: Order of the plant.
        time_constant: τ of a first-order plant [s].
        natural_frequency: ω of a second-order plant [rad/s].
        damping: ζ of a second-order plant.
        delay: Td [s].
        delay_jitter: Standard deviation of each command's own Td [s]; commands do not overtake one another.
        gain: K as a line over speed.
        gain_curve: K as a curve over speed.
        gain_recovery: Time constant [s], or "never".
        extra_pole: Time constant of a lag that the model does not have, in series with the plant [s].
        backlash: Width of the play between plant and tool [m].
        stiction: The drive does not follow changes of its input smaller than this [m].
        slow_drift: Amplitude of a slow sine on the position, as of warming up [m].
        slow_drift_period: Its period [s].
    """

    plant: Literal["first-order", "second-order"] | None = None
    time_constant: Positive | None = msgspec.field(name="time_constant_ms", default=None)
    natural_frequency: Positive | None = msgspec.field(name="natural_frequency_rad_s", default=None)
    damping: Positive | None = None
    delay: NotNegative | None = msgspec.field(name="delay_ms", default=None)
    delay_jitter: NotNegative = msgspec.field(name="delay_jitter_ms", default=0.0)
    gain: Gain | None = None
    gain_curve: GainCurve | None = None
    gain_recovery: Positive | Literal["never"] | None = msgspec.field(name="gain_recovery_ms", default=None)
    extra_pole: Positive | None = msgspec.field(name="extra_pole_ms", default=None)
    backlash: NotNegative = msgspec.field(name="backlash_mm", default=0.0)
    stiction: NotNegative = msgspec.field(name="stiction_mm", default=0.0)
    slow_drift: NotNegative = msgspec.field(name="slow_drift_mm", default=0.0)
    slow_drift_period: Positive = msgspec.field(name="slow_drift_period_s", default=600.0)

    def over(self, believed: AxisModel, delay: float, where: str) -> TrueAxis:
        """The true axis: this over the believed one, whose Td is ``delay`` [s]; errors call it ``where``.

        Raises:
            ConfigError: A parameter of the other plant is given, or one of a new plant is missing.
        """
        recovery = believed.gain_recovery if self.gain_recovery is None else self.gain_recovery
        return TrueAxis(
            plant=self._plant(believed.plant, where),
            gain=believed.gain if self.gain is None else self.gain,
            gain_curve=self.gain_curve,
            gain_recovery=None if recovery == "never" else recovery,
            delay=delay if self.delay is None else self.delay,
            delay_jitter=self.delay_jitter,
            extra_pole=self.extra_pole,
            backlash=self.backlash,
            stiction=self.stiction,
            slow_drift=self.slow_drift,
            slow_drift_period=self.slow_drift_period,
        )

    def _plant(self, believed: PLANTS, where: str) -> PLANTS:
        kind = self.plant or believed.__struct_config__.tag
        parameters = {
            "time_constant_ms": self.time_constant,
            "natural_frequency_rad_s": self.natural_frequency,
            "damping": self.damping,
        }
        given = {name: value for name, value in parameters.items() if value is not None}
        chosen = FirstOrder if kind == "first-order" else SecondOrder
        kept = toml.builtins(believed) if believed.__struct_config__.tag == kind else {}
        tree = {key: value for key, value in {**kept, **given}.items() if key != "plant"}
        return toml.struct(tree, chosen, f"{where}, a {kind} plant")


class TrueAxis(msgspec.Struct, frozen=True, kw_only=True):
    """One axis of the true arm, whole; fields as in :class:`TrueArm`."""

    plant: PLANTS
    gain: Gain
    gain_curve: GainCurve | None
    gain_recovery: float | None
    delay: float
    delay_jitter: float
    extra_pole: float | None
    backlash: float
    stiction: float
    slow_drift: float
    slow_drift_period: float

    def gain_at(self, speed: FloatArray) -> FloatArray:
        """K at ``speed`` [m/s]."""
        if self.gain_curve is None:
            return self.gain.at(speed)
        return np.interp(speed, self.gain_curve.speed, self.gain_curve.gain)


class Bursts(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Rows lost together.

    Attributes:
        per_minute: How often, at random instants.
        length: How long each lasts [s].
    """

    per_minute: Annotated[float, msgspec.Meta(gt=0, le=6000)]
    length: Positive = msgspec.field(name="length_s")


class Outliers(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Readings that are wildly wrong.

    Attributes:
        share: Of the rows.
        smallest: How wrong at least [m].
        largest: How wrong at most [m]; either sign.
    """

    share: Share
    smallest: NotNegative = msgspec.field(name="from_mm")
    largest: NotNegative = msgspec.field(name="to_mm")


class TrueSensor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a sensor truly does: z = scale · p(stamp − latency) + bias + noise.

    Attributes:
        rate: Rows a second [Hz].
        rate_jitter: Standard deviation of each row's instant around an even grid [s].
        axes: What it measures; absent: everything, in x, y, z with a frame. With a frame, a sensor that names its
            axes is logged in them.
        sd: Noise [m], one number or one for each axis.
        latency: From the valid time to the stamp [s].
        latency_sd: How far it wanders, from row to row [s].
        scale: Of the position in the reading.
        bias: Constant [m].
        bias_sd: More bias, drawn for each run [m].
        quantisation: Step between two values [m].
        dropouts: Share of rows lost, one by one.
        bursts: Rows lost together.
        outliers: Rows that are wildly wrong.
        outages: From and to, since the first command [s].
        clock_offset: Of the sensor's clock against the commands' [s].
        clock_drift: Of the sensor's clock against the commands' [parts per million].
    """

    rate: Positive = msgspec.field(name="rate_hz")
    rate_jitter: NotNegative = msgspec.field(name="rate_jitter_ms", default=0.0)
    axes: Annotated[list[str], msgspec.Meta(min_length=1)] | None = None
    sd: Positive | dict[str, Positive] = msgspec.field(name="sd_mm")
    latency: float = msgspec.field(name="latency_ms", default=0.0)
    latency_sd: NotNegative = msgspec.field(name="latency_sd_ms", default=0.0)
    scale: float = 1.0
    bias: PerAxis = msgspec.field(name="bias_mm", default=0.0)
    bias_sd: NotNegative = msgspec.field(name="bias_sd_mm", default=0.0)
    quantisation: NotNegative = msgspec.field(name="quantisation_mm", default=0.0)
    dropouts: Share = 0.0
    bursts: Bursts | None = None
    outliers: Outliers | None = None
    outages: list[tuple[float, float]] = msgspec.field(name="outages_s", default=[])
    clock_offset: float = msgspec.field(name="clock_offset_ms", default=0.0)
    clock_drift: float = msgspec.field(name="clock_drift_ppm", default=0.0)

    def believed(self) -> dict[str, Any]:
        """The keys of ``fusion.toml`` for a filter that knows this sensor, in SI."""
        sd = self.sd if isinstance(self.sd, dict) else dict.fromkeys(self.axes or [""], self.sd)
        with_steps = {axis: math.hypot(value, self.quantisation / math.sqrt(12.0)) for axis, value in sd.items()}
        biases = self.bias.values() if isinstance(self.bias, dict) else [self.bias]
        return {
            "sd_mm": with_steps if self.axes or isinstance(self.sd, dict) else with_steps[""],
            "latency_ms": self.latency,
            "latency_sd_ms": self.latency_sd,
            "scale": self.scale,
            "bias_sd_mm": math.hypot(self.bias_sd, *biases),
        }


class CommandLog(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the commands are logged.

    Attributes:
        stamp_jitter: Standard deviation of the logger's stamps around the true ticks [s].
        clock: What ``run.toml`` says of the stamps.
    """

    stamp_jitter: NotNegative = msgspec.field(name="stamp_jitter_ms", default=0.0)
    clock: Clock = "stamps"


class Truth(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the reference is recorded.

    Attributes:
        rows_per_command: Rows in each update period, the first at the command's own instant.
        sd: Noise of its own [m].
    """

    rows_per_command: Annotated[int, msgspec.Meta(gt=0, le=LATTICE)] = 5
    sd: NotNegative = msgspec.field(name="sd_mm", default=0.0)


class TrueStart(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the arm rests before the first command.

    Attributes:
        offset_sd: Of the offset there, drawn for each run and axis [m].
        level: By axis [m]; 0 where absent.
    """

    offset_sd: NotNegative = msgspec.field(name="offset_sd_mm", default=0.0)
    level: dict[str, float] = msgspec.field(default_factory=dict[str, float])


class Scenario(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What ``scenario.toml`` holds, in SI units.

    Attributes:
        name: For people and for the runs' names.
        teaches: A sentence on what it is good for.
        seed: Of the first run.
        arm: What the filter believes.
        true_arm: What is different about the true arm, by axis.
        trajectory: What the arm is told.
        start: Where it rests before.
        process: How each axis strays from its model.
        command: How the commands are logged.
        reference: How the truth is recorded.
        sensors: What each sensor truly does.
        frame: With one, commands, sensors and reference are logged in x, y, z.
        start_azimuth: Direction of the start level from the base, counterclockwise from x [degrees, as in the file].
        filter: What the filter believes otherwise than it is: tables of ``fusion.toml`` that override.
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
    reference: Truth = Truth()
    sensors: dict[str, TrueSensor] = {}
    frame: Frame | None = None
    start_azimuth: float = msgspec.field(name="start_azimuth_deg", default=0.0)
    filter: dict[str, Any] = {}

    def __post_init__(self) -> None:
        for name in (*self.trajectory.named, *self.start.level):
            self.arm.axis(name)
        for name in self.arm.axes:
            save.check_axis(name)
        for name, sensor in self.sensors.items():
            save.check_name(name)
            self._check(f"sensors.{name}", sensor)
        if isinstance(self.trajectory, Steps):
            self._check_steps(self.trajectory)
        for key in self.filter:
            if key not in _OVERRIDES:
                raise UnknownNameError("filter", "table", key, _OVERRIDES)
        if self.frame is not None:
            if not {"tangential", "radial"} <= set(self.arm.axes):
                raise ConfigError("frame: an arm in x, y, z needs the axes tangential and radial")
            if not self.start.level.get("radial", 0.0) > 0.0:
                raise ConfigError("frame: start.level.radial_mm must say how far from the base's axis the arm starts")
        _ = self.config, self.true_axes  # what does not fit together is said now

    def _check(self, where: str, sensor: TrueSensor) -> None:
        logged = CARTESIAN if self.frame is not None and sensor.axes is None else tuple(self.arm.axes)
        named = {
            "axes": sensor.axes or [],
            "sd_mm": sensor.sd if isinstance(sensor.sd, dict) else [],
            "bias_mm": sensor.bias if isinstance(sensor.bias, dict) else [],
        }
        for key, names in named.items():
            for name in names:
                if name not in logged:
                    raise UnknownNameError(f"{where}.{key}", "axis", name, logged)
        if logged is CARTESIAN and isinstance(sensor.sd, dict):
            raise ConfigError(f"{where}.sd_mm: one number for a sensor in x, y, z")
        seen = set(self.trajectory.named) if sensor.axes is None else set(sensor.axes) & set(self.trajectory.named)
        for axis in sorted(seen - set(sensor.sd)) if isinstance(sensor.sd, dict) else []:
            raise ConfigError(f"{where}.sd_mm: no entry for '{axis}', which it measures")
        fastest = LATTICE / self.arm.update_period
        if sensor.rate > fastest:
            raise ConfigError(
                f"{where}.rate_hz: at most {fastest:g} on this arm ({LATTICE} rows a command), got {sensor.rate:g}"
            )
        if sensor.outliers is not None and sensor.outliers.largest < sensor.outliers.smallest:
            raise ConfigError(f"{where}.outliers: to_mm is smaller than from_mm")
        for start, end in sensor.outages:
            if end <= start:
                raise ConfigError(f"{where}.outages_s: [{start:g}, {end:g}] ends before it begins")

    def _check_steps(self, campaign: Steps) -> None:
        if campaign.scope not in self.sensors:
            raise UnknownNameError("trajectory.scope", "sensor", campaign.scope, self.sensors)
        seen = self.sensors[campaign.scope].axes
        if self.frame is not None and seen is None:
            raise ConfigError(f"sensors.{campaign.scope}.axes: name the axes of a scope where the log is in x, y, z")
        for axis in campaign.axes:
            if seen is not None and axis not in seen:
                raise ConfigError(f"sensors.{campaign.scope}.axes: the scope does not see '{axis}', which is stepped")

    @property
    def true_axes(self) -> dict[str, TrueAxis]:
        """The true arm, whole."""
        delay = self.arm.delay_of
        return {
            name: self.true_arm.get(name, TrueArm()).over(axis, delay(name), f"true_arm.{name}")
            for name, axis in self.arm.axes.items()
        }

    @property
    def config(self) -> FusionConfig:
        """What the filter believes: the truth, where ``filter`` says nothing else."""
        sensors = {name: sensor.believed() for name, sensor in self.sensors.items()}
        process = {axis: toml.builtins(self.process.get(axis, Process())) for axis in self.arm.axes}
        tree: dict[str, Any] = {
            "start": {"offset_sd_mm": self.start.offset_sd},
            "process": process,
            "sensors": sensors,
        }
        override = dict(self.filter)
        if isinstance(override.get("process"), dict):
            override["process"] = by_axis(override["process"], Process, self.arm, "filter", "process")
        if isinstance(override.get("sensors"), dict):
            for name in override["sensors"]:
                if name not in self.sensors:
                    raise UnknownNameError("filter.sensors", "sensor", name, self.sensors)
        return toml.struct({**_merged(tree, override), "arm": self.arm}, FusionConfig, "filter")

    def to_toml(self, seed: int, arm: str) -> str:
        """The text of a ``scenario.toml`` with this ``seed``, and its arm in the file ``arm``."""
        tree = toml.builtins(self)
        tree["arm"], tree["seed"] = arm, seed
        tree["start"]["level"] = {f"{axis}_mm": level for axis, level in self.start.level.items()}
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
        _check_sizes({key: value for key, value in tree.items() if key != "seed"}, where)
        tree["arm"] = load_arm(tree, path)
        for key, kind in (("true_arm", TrueArm), ("process", Process)):
            if isinstance(tree.get(key), dict):
                tree[key] = by_axis(tree[key], kind, tree["arm"], where, key)
        start = tree.get("start")
        if isinstance(start, dict) and isinstance(levels := cast(dict[str, Any], start).get("level"), dict):
            named = cast(dict[str, Any], levels)
            start["level"] = {axis_of(key, where, "start.level"): level for key, level in named.items()}
            if len(start["level"]) < len(named):
                raise ConfigError(f"{where}: start.level gives an axis twice")
        scenario = toml.struct(tree, Scenario, where)
        trajectory = scenario.trajectory
        if isinstance(trajectory, PathFromFile):
            beside = msgspec.structs.replace(trajectory, file=str(path.parent / trajectory.file))
            scenario = msgspec.structs.replace(scenario, trajectory=beside)
        try:
            scenario.trajectory.offsets(scenario.arm.update_period, np.random.default_rng(scenario.seed))
        except PumafuseError as error:
            raise ConfigError(f"{where}: {error}") from None
        return scenario


def _check_sizes(tree: Mapping[str, Any], where: str, path: str = "", inherited: str | None = None) -> None:
    """Refuse numbers (SI) with which nothing could be computed."""
    for key, value in tree.items():
        unit = units.ending(key) or inherited
        most = _FARTHEST if unit in units.LENGTHS else _LONGEST
        if isinstance(value, Mapping):
            _check_sizes(cast(Mapping[str, Any], value), where, f"{path}{key}.", unit)
        for number in cast(list[Any], value if isinstance(value, list) else [value]):
            if isinstance(number, float | int) and number and not _LEAST <= abs(number) <= most:
                raise ConfigError(f"{where}: {path}{key}: a size with which nothing can be simulated")


def _merged(tree: Mapping[str, Any], override: Mapping[str, Any]) -> dict[str, Any]:
    """``tree`` with the entries of ``override`` in their places."""
    merged = dict(tree)
    for key, value in override.items():
        there = merged.get(key)
        merged[key] = _merged(there, value) if isinstance(there, Mapping) and isinstance(value, Mapping) else value  # pyright: ignore
    return merged
