"""What can be fitted: each number of a configuration by the name it has in its file, and a coordinate to search in."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..errors import ConfigError, suggestion
from ..fusion.config import FusionConfig, Process
from ..model.arm import AxisModel
from ..model.plants import FirstOrder
from .variants import with_axis, with_order, with_process, with_recovery, with_sd, with_sensor

Fit = Literal["noise", "delay", "plant", "gain", "latency"]
FITS: tuple[Fit, ...] = get_args(Fit)

_replace = msgspec.structs.replace
_NOISES = {  # field of Process: the range it is looked for in, SI; the lower end stands for none
    "input_noise": (1e-7, 1.0),
    "drift": (1e-7, 10.0),
    "maneuver_noise": (1e-6, 30.0),
    "maneuver_drift": (1e-5, 300.0),
}
_SDS = (1e-7, 1.0)  # m
LATENCIES = (-0.1, 0.3)  # s; how far from the configured one a latency is looked for
DELAYS = (-0.1, 0.2)  # s; likewise a delay, but never below 0
_MM = _MS = 1e-3
_TICK = 0.028  # s; what is a large change of a time, on any arm
RECOVERY = ".gain_recovery_ms"
_RECOVERY = (0.020, 0.500)  # s
_RECOVERY_SD = math.log(_RECOVERY[1] / _RECOVERY[0]) / (2.0 * 1.96)  # 95 % of the prior lie in that range
_GAIN_SD = 0.1
_DIGITS = 6  # of a number that is written


@dataclass(frozen=True)
class Parameter:
    """A number to fit.

    Attributes:
        key: Its name: table, axis or sensor, and key as in ``fusion.toml`` or ``arm.toml``.
        fit: Which kind of fitting it belongs to.
        axis: The axis it is of; None where it is of all.
        log: Whether it is searched on a log scale: the coordinate is then the number's logarithm.
        bounds: Least and greatest value [SI].
        scale: What is a large change of the coordinate.
        get: The number in a configuration [SI].
        put: The configuration with another number [SI].
        unit: What one unit of the key is in SI: 1e-3 for ``delay_ms``.
        sensor: The sensor it is of, if it is of one.
        prior: Mean and standard deviation of the coordinate before any measurement; None: any within the bounds.
    """

    key: str
    fit: Fit
    axis: str | None
    log: bool
    bounds: tuple[float, float]
    scale: float
    get: Callable[[FusionConfig], float]
    put: Callable[[FusionConfig, float], FusionConfig]
    unit: float = 1.0
    sensor: str | None = None
    prior: tuple[float, float] | None = None

    @property
    def vanishes(self) -> bool:
        """Whether it may be 0, for which its least value stands."""
        return self.key.startswith("process.")

    def given(self, config: FusionConfig) -> float | None:
        """The number as configured [SI]; None where it is not: a recovery, or what a plant of the other order has."""
        if self.axis is not None and self.key.endswith(RECOVERY) and config.arm.axes[self.axis].gain_recovery is None:
            return None
        try:
            return self.get(config)
        except AttributeError:
            return None

    @property
    def range(self) -> tuple[float, float]:
        """The bounds as coordinates."""
        return self.coordinate(self.bounds[0]), self.coordinate(self.bounds[1])

    def inside(self, value: float) -> float:
        """The nearest number within the bounds."""
        return min(max(value, self.bounds[0]), self.bounds[1])

    def coordinate(self, value: float) -> float:
        """Of a number, which is moved into the bounds."""
        return math.log(self.inside(value)) if self.log else self.inside(value)

    def at(self, config: FusionConfig) -> float:
        """The coordinate of the number in a configuration."""
        return self.coordinate(self.get(config))

    def value(self, coordinate: float) -> float:
        """The number at a coordinate [SI]."""
        return math.exp(coordinate) if self.log else coordinate

    def move(self, config: FusionConfig, coordinate: float) -> FusionConfig:
        """The configuration with this number at ``coordinate``."""
        return self.put(config, self.value(coordinate))


def parameters(
    config: FusionConfig,
    known: FusionConfig,
    heard: Mapping[str, Sequence[str]],
    fit: Sequence[Fit],
    hold: Iterable[str] = (),
) -> list[Parameter]:
    """The numbers to fit, those of each axis together.

    Args:
        config: Its plants are of the orders to fit.
        known: What is known before: priors and bounds are around its gains and latencies.
        heard: For each axis the sensors with measurements of it.
        fit: Which kinds.
        hold: Parts of names: what has all the parts of one, in their order, stays as it is.
    """
    every = [*_of_axes(config, known, heard), *_latencies(known, heard)]
    return [one for one in every if one.fit in fit and not is_held(one.key, hold)]


def kinds_of(fit: Iterable[str]) -> list[Fit]:
    """The kinds that are asked for, in their order.

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


def check_holds(config: FusionConfig, hold: Iterable[str]) -> None:
    """Refuse what names no number of a configuration, whichever the order of its plants.

    Raises:
        ConfigError: It names none.
    """
    heard = dict.fromkeys(config.arm.axes, tuple(config.sensors))
    keys = {f"sensors.{name}.bias_sd_mm" for name in config.sensors}
    for order in (1, 2):
        for axis in heard:
            config = with_order(config, axis, order)
        keys |= {one.key for one in parameters(config, config, heard, FITS)}
    for name in hold:
        if not any(_named(name, key) for key in keys):
            parts = sorted({part for key in keys for part in key.split(".")})
            raise ConfigError(f"--hold: '{name}' names nothing that can be fitted; parts of names: {', '.join(parts)}")


def least_sd(config: FusionConfig, name: str) -> float:
    """The noise of a sensor [m], on the axis where it has least."""
    sd = config.sensors[name].sd
    return min(sd.values()) if isinstance(sd, dict) else sd


def coordinates(config: FusionConfig, free: Sequence[Parameter]) -> FloatArray:
    """The coordinate of each parameter in a configuration, (k,)."""
    return np.array([one.at(config) for one in free])


def moved(config: FusionConfig, free: Sequence[Parameter], coordinates: Iterable[float]) -> FusionConfig:
    """The configuration with every parameter at its coordinate."""
    for one, coordinate in zip(free, coordinates, strict=True):
        config = one.move(config, float(coordinate))
    return config


def rounded(value: float) -> float:
    """A number as it is written: more digits would only look exact."""
    return float(f"{value:.{_DIGITS}g}")


def _of_axes(config: FusionConfig, known: FusionConfig, heard: Mapping[str, Sequence[str]]) -> list[Parameter]:
    found: list[Parameter] = []
    for axis, sensors in heard.items():
        found += [_noise(axis, field, bounds) for field, bounds in _NOISES.items()]
        found += [_sd(axis, name) for name in sensors]
        found.append(_delay(axis, known.arm.delay_of(axis)))
        found += _plant(axis, config.arm.axes[axis])
        found += _gain(axis, known.arm.axes[axis].gain.intercept)
    return found


def is_held(key: str, hold: Iterable[str]) -> bool:
    """Whether any of the names to hold is part of ``key``."""
    return any(_named(name, key) for name in hold)


def _named(name: str, key: str) -> bool:
    """Whether all parts of ``name`` are among those of ``key``, in their order."""
    parts = iter(key.split("."))
    return all(part in parts for part in name.split("."))


def _key(kind: type[msgspec.Struct], field: str) -> str:
    return next(entry.encode_name for entry in msgspec.structs.fields(kind) if entry.name == field)


def _noise(axis: str, field: str, bounds: tuple[float, float]) -> Parameter:
    def put(config: FusionConfig, value: float) -> FusionConfig:
        return with_process(config, axis, _replace(config.process[axis], **{field: value}))

    key = f"process.{axis}.{_key(Process, field)}"
    return Parameter(
        key, "noise", axis, True, bounds, 1.0, lambda config: getattr(config.process[axis], field), put, _MM
    )


def _sd(axis: str, name: str) -> Parameter:
    def get(config: FusionConfig) -> float:
        return config.sensors[name].sd_of(axis) or 0.0

    def put(config: FusionConfig, value: float) -> FusionConfig:
        return with_sd(config, name, axis, value)

    return Parameter(f"sensors.{name}.sd_mm.{axis}", "noise", axis, True, _SDS, 1.0, get, put, _MM, name)


def _delay(axis: str, configured: float) -> Parameter:
    def put(config: FusionConfig, value: float) -> FusionConfig:
        return with_axis(config, axis, _replace(config.arm.axes[axis], delay=value, delay_ci95=None))

    key, bounds = f"axes.{axis}.delay_ms", (max(configured + DELAYS[0], 0.0), configured + DELAYS[1])
    return Parameter(key, "delay", axis, False, bounds, _TICK, lambda config: config.arm.delay_of(axis), put, _MS)


def _plant(axis: str, model: AxisModel) -> list[Parameter]:
    def of(field: str, bounds: tuple[float, float]) -> Parameter:
        def get(config: FusionConfig) -> float:
            return getattr(config.arm.axes[axis].plant, field)

        def put(config: FusionConfig, value: float) -> FusionConfig:
            plant = _replace(config.arm.axes[axis].plant, **{field: value, f"{field}_ci95": None})
            return with_axis(config, axis, _replace(config.arm.axes[axis], plant=plant))

        key, unit = _key(type(model.plant), field), _MS if field == "time_constant" else 1.0
        return Parameter(f"axes.{axis}.{key}", "plant", axis, True, bounds, 1.0, get, put, unit)

    if isinstance(model.plant, FirstOrder):
        return [of("time_constant", (1e-4, 10.0))]
    return [of("natural_frequency", (0.5, 5e3)), of("damping", (0.05, 20.0))]


def _gain(axis: str, centre: float) -> list[Parameter]:
    def intercept(config: FusionConfig) -> float:
        return config.arm.axes[axis].gain.intercept

    def put_intercept(config: FusionConfig, value: float) -> FusionConfig:
        gain = _replace(config.arm.axes[axis].gain, intercept=value, intercept_ci95=None)
        return with_axis(config, axis, _replace(config.arm.axes[axis], gain=gain))

    def put_recovery(config: FusionConfig, value: float) -> FusionConfig:
        return with_recovery(config, axis, value)

    middle = 0.5 * math.log(_RECOVERY[0] * _RECOVERY[1])
    return [
        Parameter(
            f"axes.{axis}.gain.intercept", "gain", axis, False, (centre - 0.5, centre + 0.5), _GAIN_SD,
            intercept, put_intercept, prior=(centre, _GAIN_SD),
        ),
        Parameter(
            f"axes.{axis}{RECOVERY}", "gain", axis, True, _RECOVERY, 1.0,
            lambda config: config.arm.axes[axis].gain_recovery or math.exp(middle), put_recovery, _MS,
            prior=(middle, _RECOVERY_SD),
        ),
    ]  # fmt: skip


def _latencies(known: FusionConfig, heard: Mapping[str, Sequence[str]]) -> list[Parameter]:
    used = {name for sensors in heard.values() for name in sensors}
    return [_latency(name, sensor.latency) for name, sensor in known.sensors.items() if name in used]


def _latency(name: str, configured: float) -> Parameter:
    def put(config: FusionConfig, value: float) -> FusionConfig:
        return with_sensor(config, name, _replace(config.sensors[name], latency=value))

    key = f"sensors.{name}.latency_ms"
    bounds = (configured + LATENCIES[0], configured + LATENCIES[1])
    return Parameter(
        key, "latency", None, False, bounds, _TICK, lambda config: config.sensors[name].latency, put, _MS, name
    )
