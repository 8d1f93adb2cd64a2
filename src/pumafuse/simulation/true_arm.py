"""What differs in the true arm from the one that the filter believes in, and the two put together."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np

from .. import toml
from ..arrays import FloatArray
from ..errors import ConfigError
from ..model.arm import AxisModel, Gain
from ..model.plants import PLANTS, FirstOrder, SecondOrder
from ..toml import NotNegative, Positive


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
