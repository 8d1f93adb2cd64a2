"""How a simulated sensor measures, and the entry of ``fusion.toml`` that describes it."""

from __future__ import annotations

import math
from typing import Annotated, Any, TypeAlias

import msgspec

from ..toml import NotNegative, Positive

Share: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1)]
PerAxis: TypeAlias = float | dict[str, float]


class Bursts(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Spells in which all rows are lost.

    Attributes:
        per_minute: How many, at random instants.
        length: How long each lasts [s].
    """

    per_minute: Annotated[float, msgspec.Meta(gt=0, le=6000)]
    length: Positive = msgspec.field(name="length_s")


_GATE = 5.0  # of a sensor that has outliers


class Outliers(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Measurements with a large error.

    Attributes:
        share: Share of the rows.
        smallest: Smallest error [m].
        largest: Largest error [m]; either sign.
    """

    share: Share
    smallest: NotNegative = msgspec.field(name="from_mm")
    largest: NotNegative = msgspec.field(name="to_mm")


class TrueSensor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a sensor measures: z = scale · p(stamp − latency) + bias + noise.

    Attributes:
        rate: Rows a second [Hz].
        rate_jitter: Standard deviation of each row's instant around an even grid [s].
        axes: What it measures. Absent: everything, in x, y, z if the scenario has a frame; a sensor that names its
            axes is logged in them.
        sd: Standard deviation of the noise [m], one number or one for each axis.
        latency: From the valid time to the stamp [s].
        latency_sd: Standard deviation of each row's own latency [s].
        scale: Factor on the position.
        bias: Constant [m].
        bias_sd: Standard deviation of one more bias, drawn for each run and axis [m].
        bias_drift_sd: Standard deviation of one more bias that drifts and reverts to 0, on each axis [m]; 0: none.
        bias_time: How long such a drift lasts [s].
        quantisation: Step between two values [m]; 0: none.
        dropouts: Share of rows lost, one by one.
        bursts: Rows lost together.
        outliers: Rows with a large error.
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
    bias_drift_sd: NotNegative = msgspec.field(name="bias_drift_sd_mm", default=0.0)
    bias_time: Positive = msgspec.field(name="bias_time_s", default=10.0)
    quantisation: NotNegative = msgspec.field(name="quantisation_mm", default=0.0)
    dropouts: Share = 0.0
    bursts: Bursts | None = None
    outliers: Outliers | None = None
    outages: list[tuple[float, float]] = msgspec.field(name="outages_s", default=[])
    clock_offset: float = msgspec.field(name="clock_offset_ms", default=0.0)
    clock_drift: float = msgspec.field(name="clock_drift_ppm", default=0.0)

    def to_config(self) -> dict[str, Any]:
        """The sensor's keys of ``fusion.toml``, in SI: exactly what it does, the unknown biases as ``bias_sd_mm``."""
        sds = self.sd if isinstance(self.sd, dict) else dict.fromkeys(self.axes or [""], self.sd)  # "": of any axis
        sds = {axis: math.hypot(sd, self.quantisation / math.sqrt(12.0)) for axis, sd in sds.items()}
        gate = {} if self.outliers is None else {"gate": _GATE}
        biases = self.bias.values() if isinstance(self.bias, dict) else [self.bias]
        return {
            "sd_mm": sds.get("", sds),
            "latency_ms": self.latency,
            "latency_sd_ms": self.latency_sd,
            "scale": self.scale,
            "bias_sd_mm": math.hypot(self.bias_sd, *biases),
            "bias_drift_sd_mm": self.bias_drift_sd,
            "bias_time_s": self.bias_time,
            **gate,
        }
