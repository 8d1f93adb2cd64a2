"""How the true arm differs from the model that the filter has, and the true axis that follows from both."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from .. import toml
from ..arrays import FloatArray
from ..errors import ConfigError
from ..model.arm import AxisModel, Gain, Sag
from ..model.plants import PLANTS, FirstOrder, SecondOrder
from ..toml import NotNegative, Positive

_OF_PLANTS = ("time_constant_ms", "natural_frequency_rad_s", "damping")


class GainCurve(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A gain that is no line: K at some speeds [m/s], linear between them and level outside."""

    speed: Annotated[list[NotNegative], msgspec.Meta(min_length=1)] = msgspec.field(name="speed_m_s")
    gain: Annotated[list[float], msgspec.Meta(min_length=1)]

    def __post_init__(self) -> None:
        if len(self.speed) != len(self.gain) or sorted(self.speed) != self.speed:
            raise ConfigError("gain_curve: speed_m_s must ascend and gain have as many entries")


class Imperfections(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a true axis does that no arm model has, but for play."""

    # standard deviation of each command's own Td [s]; commands do not overtake one another
    delay_jitter: NotNegative = msgspec.field(name="delay_jitter_ms", default=0.0)
    gain_curve: GainCurve | None = None  # K as a curve over speed, instead of the gain's line
    # time constant of a lag in series with the plant [s]
    extra_pole: Positive | None = msgspec.field(name="extra_pole_ms", default=None)
    # width of the play between plant and tool [m]; None: the model's
    backlash: NotNegative | None = msgspec.field(name="backlash_mm", default=None)
    # when a command acts, the drive goes to its input (command and gain error) if that is farther away than this [m];
    # it holds its place until the next command
    stiction: NotNegative = msgspec.field(name="stiction_mm", default=0.0)
    # amplitude of a slow sine on the position, as of warming up [m]
    slow_drift: NotNegative = msgspec.field(name="slow_drift_mm", default=0.0)
    slow_drift_period: Positive = msgspec.field(name="slow_drift_period_s", default=600.0)  # its period [s]


class TrueAxis(Imperfections, frozen=True, kw_only=True):
    """One axis of the true arm, complete.

    Attributes:
        plant: The plant.
        gain: K as a line over speed.
        gain_recovery: Time constant [s] with which the gain error decays; None: it stays.
        delay: Td [s].
        max_speed: The fastest that the plant goes [m/s or rad/s]; None: as fast as it is asked to.
        sag: How far a static load holds the tool off.
    """

    plant: PLANTS
    gain: Gain
    gain_recovery: float | None
    delay: float
    max_speed: float | None = None
    sag: Sag | None = None

    def gain_at(self, speed: FloatArray) -> FloatArray:
        """K at ``speed`` [m/s]."""
        if self.gain_curve is None:
            return self.gain.at(speed)
        return np.interp(speed, self.gain_curve.speed, self.gain_curve.gain)


class TrueArm(Imperfections, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the true arm differs on one axis or on all; what is absent is as in the filter's model."""

    plant: Literal["first-order", "second-order"] | None = None  # order of the plant
    # τ of a first-order plant [s]
    time_constant: Positive | None = msgspec.field(name="time_constant_ms", default=None)
    # ω of a second-order plant [rad/s]
    natural_frequency: Positive | None = msgspec.field(name="natural_frequency_rad_s", default=None)
    damping: Positive | None = None  # ζ of a second-order plant
    delay: NotNegative | None = msgspec.field(name="delay_ms", default=None)  # Td [s]
    gain: Gain | None = None  # K as a line over speed
    # time constant [s], or "never"
    gain_recovery: Positive | Literal["never"] | None = msgspec.field(name="gain_recovery_ms", default=None)
    # the fastest that the plant goes [m/s or rad/s], or "none"
    max_speed: Positive | Literal["none"] | None = msgspec.field(name="max_speed_mm_s", default=None)
    sag: Sag | None = None  # how far a static load holds the tool off

    def over(self, model: AxisModel, delay: float, where: str) -> TrueAxis:
        """The true axis: these differences over the ``model``, whose Td is ``delay`` [s]; errors call it ``where``.

        Raises:
            ConfigError: A parameter of the other plant is given, or one of a new plant is missing.
        """
        shared = {name: getattr(model, name) for name in ("gain", "gain_recovery", "max_speed", "sag")}
        different = {name: value for name in TrueAxis.__struct_fields__ if (value := getattr(self, name)) is not None}
        true: dict[str, Any] = {"delay": delay, "backlash": model.play or 0.0} | shared | different
        for name in ("gain_recovery", "max_speed"):
            true[name] = None if isinstance(true[name], str) else true[name]  # "never", "none"
        true["plant"] = self._plant(model.plant, where)
        return TrueAxis(**true)

    def _plant(self, model: PLANTS, where: str) -> PLANTS:
        kind = self.plant or model.__struct_config__.tag
        tree = toml.builtins(self)
        if model.__struct_config__.tag == kind:
            tree = toml.builtins(model) | tree
        keys = {key: value for key, value in tree.items() if key in _OF_PLANTS}
        chosen = FirstOrder if kind == "first-order" else SecondOrder
        return toml.struct(keys, chosen, f"{where}, a {kind} plant")
