"""The parameters that can be fitted, a line of a table each, and configurations with one thing changed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, TypeAlias, TypeVar, cast, get_args

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..errors import ConfigError, suggestion
from ..fusion.config import SD_BOUNDS, FusionConfig, Process, Sensor
from ..model.arm import Sag
from ..model.plants import SecondOrder
from ..units import ending, of_kind, si
from .arms import BELIEF, BENDS, BEYOND, Arm, NoiseModel, longest_delay

Fit = Literal["noise", "delay", "plant", "gain", "latency", "scale", "bias"]
FITS: tuple[Fit, ...] = get_args(Fit)

Path: TypeAlias = tuple[str, ...]
T = TypeVar("T")

_replace = msgspec.structs.replace
LATENCIES = (-0.1, 0.3)  # s; bounds of a latency, relative to the configured one
RECOVERY = (0.020, 0.500)  # s; 95 % of the prior lie within
RECOVERY_PRIOR = (0.5 * math.log(RECOVERY[0] * RECOVERY[1]), math.log(RECOVERY[1] / RECOVERY[0]) / (2.0 * 1.96))
QUICKEST = 2.0  # update periods, of a disturbance
_PLANT_NOISE = ("input_noise", "maneuver_noise")  # what shakes the plant, and is filtered by it
_RINGS = 0.4  # damping below which a step overshoots by a quarter, and no drive that is sold is tuned so
_INTERCEPT = {"log": False, "scale": 0.1, "prior": (0.0, 0.1)}
_LEVELS = (-1e3, 1e3)  # m or rad
_TICK = 0.028  # s; a large change of a time, on any arm
# Of noise that follows innovations: by likelihood 0.1 to 0.3 on servos, loads and a trunk, at 30 to 100 Hz.
_ADAPTATION = 0.1
_DIGITS = 6  # of a number that is written
_AT_BOUND = 1e-6  # of the range of coordinates


def changed(config: T, path: Path, value: object) -> T:
    """A configuration with another value at a path of fields and keys.

    A confidence interval beside what changes is dropped. A sensor's ``sd`` of all axes becomes one for each.
    """
    return _changed(config, path, value, config)


def _changed(node: Any, path: Path, value: object, root: Any) -> Any:
    if not path:
        return value
    if isinstance(node, int | float):
        node = dict.fromkeys(root.arm.axes, node)
    name, tail = path[0], path[1:]
    if isinstance(node, dict):
        table = cast("dict[str, Any]", node)
        return {**table, name: _changed(table.get(name), tail, value, root)}
    other = copy(node)  # unchecked: a search moves a configuration thousands of times, within bounds
    msgspec.structs.force_setattr(other, name, _changed(getattr(node, name), tail, value, root))
    if not tail and hasattr(node, f"{name}_ci95"):
        msgspec.structs.force_setattr(other, f"{name}_ci95", None)
    return other


@dataclass(frozen=True)
class Parameter:
    """A number that can be fitted."""

    fit: Fit  # which kind of fitting it belongs to
    key: str  # its name: table, axis or sensor, and key as in 'fusion.toml' or 'arm.toml'
    path: Path  # where it is in a configuration: fields and keys
    bounds: tuple[float, float]  # lower and upper bound [SI]
    log: bool = True  # whether it is searched on a log scale: the coordinate is then the number's logarithm
    scale: float = 1.0  # A large change of the coordinate
    # mean and standard deviation of the coordinate a priori; None: uniform within the bounds
    prior: tuple[float, float] | None = None
    axis: str | None = None  # its axis; None where it belongs to all
    sensor: str | None = None  # its sensor, if it has one

    @property
    def unit(self) -> float:
        """One unit of the key in SI: 1e-3 for ``delay_ms``."""
        return next((si(1.0, unit) for part in self.key.split(".") if (unit := ending(part))), 1.0)

    @property
    def vanishes(self) -> bool:
        """Whether it may be 0, for which its lower bound stands."""
        return "bias_drift_sd" in self.path or (self.path[0] == "process" and self.path[-1] != "disturbance_time")

    @property
    def least(self) -> float:
        """What it can never be below [SI]."""
        return 0.0 if self.log or self.fit == "delay" else -math.inf

    @property
    def is_noise(self) -> bool:
        """Whether it is the noise of a sensor."""
        return self.fit == "noise" and self.sensor is not None

    @property
    def range(self) -> tuple[float, float]:
        """The bounds as coordinates."""
        return self.coordinate(self.bounds[0]), self.coordinate(self.bounds[1])

    def configured(self, config: FusionConfig) -> float | None:
        """The number as configured [SI]; None where it is not: no recovery, or a plant of the other order."""
        if self.fit == "delay" and self.axis is not None:
            return config.arm.delay_of(self.axis)
        node: Any = config
        for name in self.path:
            if isinstance(node, int | float):
                break  # an sd of all axes
            node = cast("dict[str, Any]", node).get(name) if isinstance(node, dict) else getattr(node, name, None)
        return node

    def number(self, config: FusionConfig) -> float:
        """The number in a configuration [SI]; the prior's mean where it is not configured."""
        value = self.configured(config)
        return self.value(cast("tuple[float, float]", self.prior)[0]) if value is None else value

    def set(self, config: FusionConfig, value: float) -> FusionConfig:
        """The configuration with another number [SI]."""
        return changed(config, self.path, value)

    def clipped(self, value: float) -> float:
        """The nearest number within the bounds."""
        return min(max(value, self.bounds[0]), self.bounds[1])

    def coordinate(self, value: float) -> float:
        """The coordinate of a number, which is clipped to the bounds."""
        return math.log(self.clipped(value)) if self.log else self.clipped(value)

    def at(self, config: FusionConfig) -> float:
        """The coordinate of the number in a configuration."""
        return self.coordinate(self.number(config))

    def value(self, coordinate: float) -> float:
        """The number at a coordinate [SI]."""
        return math.exp(coordinate) if self.log else coordinate

    def move(self, config: FusionConfig, coordinate: float) -> FusionConfig:
        """The configuration with this number at ``coordinate``."""
        return self.set(config, self.value(coordinate))

    def at_bound(self, config: FusionConfig) -> Literal["lower", "upper"] | None:
        """The bound at which the number lies in a configuration, if any."""
        low, high = self.range
        at, margin = self.at(config), _AT_BOUND * (high - low)
        return "lower" if at <= low + margin else "upper" if at >= high - margin else None

    def log_prior(self, config: FusionConfig) -> float:
        """Logarithm of the prior density, but for a constant."""
        return 0.0 if self.prior is None else -0.5 * self._from_prior(config) ** 2

    def prior_score(self, config: FusionConfig) -> tuple[float, float]:
        """How the prior's logarithm changes with the coordinate, and the prior's information of it."""
        if self.prior is None:
            return 0.0, 0.0
        return -self._from_prior(config) / self.prior[1], 1.0 / self.prior[1] ** 2

    def _from_prior(self, config: FusionConfig) -> float:
        mean, sd = cast("tuple[float, float]", self.prior)
        return (self.at(config) - mean) / sd

    def of(self, config: FusionConfig, axis: str | None, sensor: str | None) -> Parameter:
        """This line of the table for an axis and a sensor; bounds about the number in ``config`` if not log."""
        kind = config.arm.kinds[0] if axis is None else config.arm.axes[axis].kind
        key = ".".join(of_kind(part, kind) for part in self.key.split(".")).format(axis=axis, sensor=sensor)
        path = tuple(part.format(axis=axis, sensor=sensor) for part in self.path)
        line = replace(self, key=key, path=path, axis=axis, sensor=sensor)
        if line.path[-1] == "disturbance_time":  # what is faster is no motion of an arm but noise of its sensors
            return replace(line, bounds=(quickest(config), line.bounds[1]))
        if self.log or "sag" in path:
            return line
        middle, (low, high) = line.number(config), self.bounds
        if self.fit == "delay":
            return replace(line, bounds=(0.0, max(longest_delay(config.arm.update_period), middle)))
        if self.fit == "scale" or path[-1] == "intercept":  # shares of it: a scale of 0 is none
            low, high, line = low * abs(middle), high * abs(middle), replace(line, scale=self.scale * abs(middle))
        return replace(
            line, bounds=(middle + low, middle + high), prior=self.prior and (middle + self.prior[0], self.prior[1])
        )


def _line(fit: Fit, key: str, path: str, low: float, high: float, **more: Any) -> Parameter:
    return Parameter(fit, key, tuple(path.split(".")), (low, high), **more)


# With the names of lengths. A process noise at its lower bound is none; bounds and prior of what is not logarithmic are
# relative.
_TABLE = (
    _line("noise", "process.{axis}.input_noise_mm_rtHz", "process.{axis}.input_noise", 1e-7, 1.0),
    _line("noise", "process.{axis}.drift_mm_rts", "process.{axis}.drift", 1e-7, 10.0),
    _line("noise", "process.{axis}.maneuver_noise_mm_rtHz_per_m_s", "process.{axis}.maneuver_noise", 1e-6, 30.0),
    _line("noise", "process.{axis}.maneuver_drift_mm_rts_per_m_s", "process.{axis}.maneuver_drift", 1e-5, 300.0),
    _line("noise", "process.{axis}.disturbance_sd_mm", "process.{axis}.disturbance_sd", 1e-7, 10.0),
    _line("noise", "process.{axis}.disturbance_time_ms", "process.{axis}.disturbance_time", 1e-3, 1e3),
    _line("noise", "sensors.{sensor}.sd_mm.{axis}", "sensors.{sensor}.sd.{axis}", *SD_BOUNDS),
    _line("delay", "axes.{axis}.delay_ms", "arm.axes.{axis}.delay", 0.0, 0.0, log=False, scale=_TICK),
    _line("delay", "delay_ms", "arm.delay", 0.0, 0.0, log=False, scale=_TICK),
    _line("plant", "axes.{axis}.time_constant_ms", "arm.axes.{axis}.plant.time_constant", 1e-4, 10.0),
    _line("plant", "axes.{axis}.natural_frequency_rad_s", "arm.axes.{axis}.plant.natural_frequency", 0.5, 5e3),
    _line("plant", "axes.{axis}.damping", "arm.axes.{axis}.plant.damping", 0.05, 20.0),
    _line("plant", "axes.{axis}.max_speed_mm_s", "arm.axes.{axis}.max_speed", *BENDS["max_speed"]),
    _line("plant", "axes.{axis}.play_mm", "arm.axes.{axis}.play", *BENDS["play"]),
    _line("plant", "axes.{axis}.sag.knee_mm", "arm.axes.{axis}.sag.knee", *_LEVELS, log=False, scale=0.1),
    _line("plant", "axes.{axis}.sag.slope_beyond", "arm.axes.{axis}.sag.slope_beyond", *BEYOND, log=False, scale=0.1),
    _line("plant", "axes.{axis}.sag.knee_below_mm", "arm.axes.{axis}.sag.knee_below", *_LEVELS, log=False, scale=0.1),
    _line("plant", "axes.{axis}.sag.slope_below", "arm.axes.{axis}.sag.slope_below", *BEYOND, log=False, scale=0.1),
    _line("gain", "axes.{axis}.gain.intercept", "arm.axes.{axis}.gain.intercept", -0.8, 3.0, **_INTERCEPT),
    _line("gain", "axes.{axis}.gain_recovery_ms", "arm.axes.{axis}.gain_recovery", *RECOVERY, prior=RECOVERY_PRIOR),
    _line("latency", "sensors.{sensor}.latency_ms", "sensors.{sensor}.latency", *LATENCIES, log=False, scale=_TICK),
    _line("scale", "sensors.{sensor}.scale", "sensors.{sensor}.scale", -0.5, 0.5, log=False, scale=0.1),
    _line("bias", "sensors.{sensor}.bias_drift_sd_mm", "sensors.{sensor}.bias_drift_sd", *SD_BOUNDS),
    _line("bias", "sensors.{sensor}.bias_drift_sd_mm.{axis}", "sensors.{sensor}.bias_drift_sd.{axis}", *SD_BOUNDS),
    _line("bias", "sensors.{sensor}.bias_time_s", "sensors.{sensor}.bias_time", 1e-2, 1e4),
)


def parameters(
    config: FusionConfig,
    reference: FusionConfig,
    sensors: Mapping[str, Sequence[str]],
    fit: Sequence[Fit],
    fixed: Iterable[str] = (),
    resolution: Mapping[tuple[str, str], float] = MappingProxyType({}),
    believed: Mapping[tuple[str, str], float] = MappingProxyType({}),
) -> list[Parameter]:
    """The parameters to fit, those of each axis together.

    Args:
        config: Its plants are of the orders to fit.
        reference: The configuration as given: priors and bounds are around its gains and latencies.
        sensors: For each axis the sensors that measure it.
        fit: Which kinds.
        fixed: Parts of names: a parameter whose name has all the parts of one, in their order, is left out.
        resolution: The least noise of a sensor on an axis [m or rad]: at rest all its values may be one.
        believed: The noise that a sensor on an axis is believed to have, within a factor of some 2 [m or rad].
    """
    free = list[Parameter]()
    for parameter in _every(reference, sensors, fit):
        if is_fixed(parameter.key, fixed) or not _belongs(parameter, config, sensors):
            continue
        if parameter.is_noise:
            of = str(parameter.sensor), str(parameter.axis)
            least, most = parameter.bounds
            parameter = replace(parameter, bounds=(max(resolution.get(of, 0.0), least), most))
            if of in believed:
                parameter = replace(parameter, prior=(parameter.coordinate(believed[of]), BELIEF))
        free.append(parameter)
    return free


def _every(reference: FusionConfig, sensors: Mapping[str, Sequence[str]], fit: Sequence[Fit]) -> list[Parameter]:
    """The lines of the table for each axis and its sensors, then those that belong to no axis."""
    used = {name for names in sensors.values() for name in names}
    return [
        line.of(reference, axis, name)
        for axis, names in (*sensors.items(), (None, [name for name in reference.sensors if name in used]))
        for line in _TABLE
        if line.fit in fit and ("{axis}" in line.key) == (axis is not None)
        for name in (names if "{sensor}" in line.key else [None])
    ]


def _belongs(parameter: Parameter, config: FusionConfig, axes: Iterable[str]) -> bool:
    """Whether a configuration has it: a plant's order, play, an own delay, a recovery, a disturbance, a drift.

    An axis that rings, and has no plant noise yet, gets none. Friction and loads hold a tool off, and noise that
    shakes such a plant brings it back within half a period: then the estimate of a slower motion is pulled off.
    """
    if parameter.axis is not None and parameter.path[-1].startswith("disturbance"):
        return config.process[parameter.axis].disturbance_sd > 0.0
    if parameter.axis is not None and parameter.path[-1] in _PLANT_NOISE and rings(config, parameter.axis):
        return parameter.at_bound(config) != "lower"
    if parameter.fit == "bias" and parameter.sensor is not None:
        drift = config.sensors[parameter.sensor].bias_drift_sd
        if isinstance(drift, dict):  # one for each axis
            if parameter.axis is None:
                return parameter.path[-1] == "bias_time"
            return drift.get(parameter.axis, 0.0) > 0.0
        return parameter.axis is None and drift > 0.0
    if parameter.fit == "delay":
        shares = [axis for axis in axes if config.arm.axes[axis].delay is None]
        return bool(shares) if parameter.axis is None else parameter.axis not in shares
    return parameter.configured(config) is not None and (parameter.path[-1] != "play" or parameter.number(config) > 0.0)


def kinds_of(fit: Iterable[str]) -> list[Fit]:
    """The kinds that are asked for, in the order of :data:`FITS`.

    Raises:
        ConfigError: One is unknown, or there is none.
    """
    asked = list(fit)
    for kind in asked:
        if kind not in FITS:
            raise ConfigError(f"--fit: unknown '{kind}'; {suggestion(kind, FITS)}")
    if not asked:
        raise ConfigError(f"--fit: names nothing; accepted: {', '.join(FITS)}")
    return [kind for kind in FITS if kind in asked]


def check_fixed(config: FusionConfig, fixed: Iterable[str]) -> None:
    """Refuse a name to fix that names no number of a configuration, whichever the order of its plants.

    Raises:
        ConfigError: It names none.
    """
    measured = {
        axis: [name for name, sensor in config.sensors.items() if sensor.sd_of(axis) is not None]
        for axis in config.arm.axes
    }
    keys = {parameter.key for parameter in _every(config, measured, FITS)}
    keys |= {f"sensors.{name}.{of_kind('bias_sd_mm', kind)}" for name in config.sensors for kind in config.arm.kinds}
    for name in fixed:
        if not any(is_fixed(key, [name]) for key in keys):
            parts = sorted({part for key in keys for part in key.split(".")})
            raise ConfigError(f"--fix: '{name}' names nothing that can be fitted; parts of names: {', '.join(parts)}")


def is_fixed(key: str, fixed: Iterable[str]) -> bool:
    """Whether all parts of any of the names to fix are parts of ``key``, in their order."""
    for name in fixed:
        parts = iter(key.split("."))
        if all(part in parts for part in name.split(".")):
            return True
    return False


def set_drifts(config: FusionConfig, fixed: Sequence[str] = ()) -> FusionConfig:
    """The configuration with a drifting bias of every sensor, by default as large as its noise; none that is fixed."""
    for name, sensor in config.sensors.items():
        if any(sensor.bias_drift_sd_of(axis) for axis in config.arm.axes):
            continue
        if any(key.startswith(f"sensors.{name}.bias_drift_sd") for key in fixed):
            continue
        drift = smallest_sd(config, name)
        if len(config.arm.kinds) > 1:
            drift = {axis: sd for axis in config.arm.axes if (sd := sensor.sd_of(axis)) is not None}
        config = changed(config, ("sensors", name, "bias_drift_sd"), drift)
    return config


def quickest(config: FusionConfig) -> float:
    """The shortest time of a disturbance [s] that is believed."""
    return QUICKEST * config.arm.update_period


def smallest_sd(config: FusionConfig, name: str) -> float:
    """The noise of a sensor [m or rad], on the axis where it is smallest."""
    sd = config.sensors[name].sd
    return min(sd.values()) if isinstance(sd, dict) else sd


def coordinates(config: FusionConfig, free: Sequence[Parameter]) -> FloatArray:
    """The coordinate of each parameter in a configuration, (k,)."""
    return np.array([parameter.at(config) for parameter in free])


def moved(config: FusionConfig, free: Sequence[Parameter], coordinates: Iterable[float]) -> FusionConfig:
    """The configuration with every parameter at its coordinate."""
    for parameter, coordinate in zip(free, coordinates, strict=True):
        config = parameter.move(config, float(coordinate))
    return config


def rounded(value: float) -> float:
    """A number as it is written: more digits would only look exact."""
    return float(f"{value:.{_DIGITS}g}")


def rings(config: FusionConfig, axis: str) -> bool:
    """Whether the plant of an axis is lightly damped."""
    plant = config.arm.axes[axis].plant
    return isinstance(plant, SecondOrder) and plant.damping < _RINGS


def set_own_delays(config: FusionConfig, axes: Iterable[str]) -> FusionConfig:
    """The configuration with a delay of its own for each of these axes, the same as before."""
    for axis in axes:
        config = changed(config, ("arm", "axes", axis, "delay"), config.arm.delay_of(axis))
    return config


def set_shared_delay(config: FusionConfig, axes: Iterable[str], delay: float) -> FusionConfig:
    """The configuration with one delay [s] of the arm for these axes."""
    for axis in axes:
        config = changed(config, ("arm", "axes", axis, "delay"), None)
    return changed(config, ("arm", "delay"), delay)


def set_disturbance(
    config: FusionConfig, axis: str, sd: float, time: float, kind: Literal["matern", "ou"] = "matern"
) -> FusionConfig:
    """The configuration with a disturbance of an axis of this sd [m] and time [s]."""
    process = _replace(config.process[axis], disturbance_sd=sd, disturbance_time=time, disturbance_kind=kind)
    return changed(config, ("process", axis), process)


def adapting(config: FusionConfig, axis: str) -> FusionConfig:
    """The configuration with noise of an axis that adapts, as is configured or else by default."""
    return changed(config, ("process", axis, "adaptation"), config.process[axis].adaptation or _ADAPTATION)


def set_axis_of(config: FusionConfig, other: FusionConfig, axis: str) -> FusionConfig:
    """The configuration with all numbers of one axis from another: its model, its process noise, its sensors' noise."""
    config = changed(config, ("arm", "axes", axis), other.arm.axes[axis])
    for name, sensor in other.sensors.items():
        if isinstance(sensor.sd, dict) and axis in sensor.sd:
            config = changed(config, ("sensors", name, "sd", axis), sensor.sd[axis])
    return changed(config, ("process", axis), other.process[axis])


def set_arm(config: FusionConfig, axis: str, arm: Arm) -> FusionConfig:
    """The configuration with another arm of an axis, and a delay of its own; a load that is given stays."""
    model, sag = arm.model, config.arm.axes[axis].sag or Sag()
    if arm.beyond or arm.below:
        config = changed(config, ("arm", "axes", axis, "sag"), arm.sag_beside(sag))
    for name in ("plant", "gain", "gain_recovery", *BENDS):
        config = changed(config, ("arm", "axes", axis, name), getattr(model, name))
    return changed(config, ("arm", "axes", axis, "delay"), arm.delay)


def set_noise(config: FusionConfig, axis: str, noise: NoiseModel, sensors: Sequence[str]) -> FusionConfig:
    """The configuration with what an arm leaves of an axis as its noise and that of these sensors."""
    process = Process(
        input_noise=0.0,
        drift=rounded(noise.walk),
        disturbance_sd=rounded(noise.disturbance_sd),
        disturbance_time=rounded(noise.disturbance_time),
        disturbance_kind="matern" if noise.smoothness > 1.0 else "ou",
        adaptation=config.process[axis].adaptation,
    )
    for name, sd in zip(sensors, noise.sd.tolist(), strict=True):
        config = changed(config, ("sensors", name, "sd", axis), rounded(sd))
    return changed(config, ("process", axis), process)


def set_gates(config: FusionConfig, gated: FusionConfig, wider: float | None = None) -> FusionConfig:
    """The configuration with the gates of another; with ``wider`` so many times as wide, each component for itself."""
    sensors: dict[str, Sensor] = {}
    for name, sensor in config.sensors.items():
        gate, rows = gated.sensors[name].gate, gated.sensors[name].gate_rows if wider is None else False
        sensors[name] = _replace(sensor, gate=(wider or 1.0) * gate, gate_rows=rows)
    return _replace(config, sensors=sensors)
