"""What a sensor truly does, and what a filter believes of it that knows it."""

from __future__ import annotations

import math
from typing import Annotated, Any, TypeAlias

import msgspec

from ..toml import NotNegative, Positive

Share: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1)]
PerAxis: TypeAlias = float | dict[str, float]


class Bursts(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Rows lost together.

    Attributes:
        per_minute: How often, at random instants.
        length: How long each lasts [s].
    """

    per_minute: Annotated[float, msgspec.Meta(gt=0, le=6000)]
    length: Positive = msgspec.field(name="length_s")


class Outliers(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Measurements that are wildly wrong.

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
        scale: Of the position in the measurement.
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
