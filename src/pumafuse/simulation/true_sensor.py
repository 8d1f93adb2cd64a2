"""How a simulated sensor measures, and the entry of ``fusion.toml`` that describes it."""

from __future__ import annotations

import math
from typing import Annotated, Any, TypeAlias

import msgspec

from ..fusion.config import PerAxis, of_axis
from ..toml import NotNegative, Positive

Share: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1)]
PER_AXIS = ("sd_mm", "bias_mm", "bias_sd_mm", "bias_drift_sd_mm", "quantisation_mm")  # keys that axes may have apart
OF_OUTLIERS = ("from_mm", "to_mm")  # likewise


class Bursts(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Spells in which all rows are lost."""

    per_minute: Annotated[float, msgspec.Meta(gt=0, le=6000)]  # how many, at random instants
    length: Positive = msgspec.field(name="length_s")  # how long each lasts [s]


_GATE = 5.0  # of a sensor that has outliers


class Outliers(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Measurements with a large error."""

    share: Share  # share of the rows
    smallest: PerAxis = msgspec.field(name="from_mm")  # smallest error [m or rad], for all axes or for each
    largest: PerAxis = msgspec.field(name="to_mm")  # largest error [m or rad]; either sign


class TrueSensor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a sensor measures: z = scale · p(stamp − latency) + bias + noise."""

    rate: Positive = msgspec.field(name="rate_hz")  # rows a second [Hz]
    # standard deviation of each row's instant around an even grid [s]
    rate_jitter: NotNegative = msgspec.field(name="rate_jitter_ms", default=0.0)
    # what it measures. Absent: everything, in x, y, z if the scenario has a frame; a sensor that names its axes is
    # logged in them
    axes: Annotated[list[str], msgspec.Meta(min_length=1)] | None = None
    # standard deviation of the noise [m or rad], one number or one for each axis; likewise all in that unit
    sd: Positive | dict[str, Positive] = msgspec.field(name="sd_mm")
    latency: float = msgspec.field(name="latency_ms", default=0.0)  # from the valid time to the stamp [s]
    # standard deviation of each row's own latency [s]
    latency_sd: NotNegative = msgspec.field(name="latency_sd_ms", default=0.0)
    scale: float = 1.0  # factor on the position
    bias: float | dict[str, float] = msgspec.field(name="bias_mm", default=0.0)  # constant [m or rad]
    # standard deviation of one more bias, drawn for each run and axis [m or rad]
    bias_sd: PerAxis = msgspec.field(name="bias_sd_mm", default=0.0)
    # standard deviation of one more bias, which drifts and reverts to 0 [m or rad]; 0: none
    bias_drift_sd: PerAxis = msgspec.field(name="bias_drift_sd_mm", default=0.0)
    bias_time: Positive = msgspec.field(name="bias_time_s", default=10.0)  # how long such a drift lasts [s]
    # step between two values [m or rad]; 0: none
    quantisation: PerAxis = msgspec.field(name="quantisation_mm", default=0.0)
    dropouts: Share = 0.0  # share of rows lost, one by one
    bursts: Bursts | None = None  # rows lost together
    outliers: Outliers | None = None  # rows with a large error
    # from and to, since the first command [s]
    outages: list[tuple[float, float]] = msgspec.field(name="outages_s", default=[])
    # of the sensor's clock against the commands' [s]
    clock_offset: float = msgspec.field(name="clock_offset_ms", default=0.0)
    # of the sensor's clock against the commands' [parts per million]
    clock_drift: float = msgspec.field(name="clock_drift_ppm", default=0.0)

    def to_config(self) -> dict[str, Any]:
        """The sensor's keys of ``fusion.toml``, in SI: exactly what it does, the unknown biases as ``bias_sd_mm``."""
        sds = (
            dict(self.sd) if isinstance(self.sd, dict) else dict.fromkeys(self.axes or [""], self.sd)
        )  # "": of any axis
        sds = {axis: math.hypot(sd, of_axis(self.quantisation, axis) / math.sqrt(12.0)) for axis, sd in sds.items()}
        gate = {} if self.outliers is None else {"gate": _GATE}
        biases = self.bias.values() if isinstance(self.bias, dict) else [self.bias]
        if isinstance(self.bias_sd, float):
            bias_sd: Any = math.hypot(self.bias_sd, *biases)
        else:  # of axes of both kinds
            bias_sd = {axis: math.hypot(of_axis(self.bias_sd, axis), of_axis(self.bias, axis)) for axis in sds}
        return {
            "sd_mm": sds.get("", sds),
            "latency_ms": self.latency,
            "latency_sd_ms": self.latency_sd,
            "scale": self.scale,
            "bias_sd_mm": bias_sd,
            "bias_drift_sd_mm": self.bias_drift_sd,
            "bias_time_s": self.bias_time,
            **gate,
        }
