"""How a simulated sensor measures, the entry of ``fusion.toml`` that describes it, and the rows that it logs."""

from __future__ import annotations

import math
from typing import Annotated, Any, TypeAlias

import msgspec
import numpy as np

from ..arrays import BoolArray, FloatArray, TimeArray
from ..fusion.config import PerAxis, of_axis
from ..logs.source import Source
from ..toml import NotNegative, Positive
from . import reverting

Share: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1)]
PER_AXIS = ("sd_mm", "bias_mm", "bias_sd_mm", "bias_drift_sd_mm", "quantisation_mm")  # keys that axes may have apart
OF_OUTLIERS = ("from_mm", "to_mm")  # likewise
_GATE = 5.0  # of a sensor that has outliers


class Bursts(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Spells in which all rows are lost."""

    per_minute: Annotated[float, msgspec.Meta(gt=0, le=6000)]  # how many, at random instants
    length: Positive = msgspec.field(name="length_s")  # how long each lasts [s]


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


def valid_times(sensor: TrueSensor, grid: TimeArray, rng: np.random.Generator) -> TimeArray:
    """The instants of the even ``grid`` (int64 ns) at which the sensor measures, ascending, (rows,)."""
    end = grid[-1] / 1e9
    count = int(end * sensor.rate) + 1
    jitter = sensor.rate_jitter * rng.standard_normal(count)
    instant = (rng.random() + np.arange(count)) / sensor.rate + jitter
    nearest = np.unique(np.rint(instant * ((len(grid) - 1) / end)).astype(np.int64))
    return grid[nearest[(nearest >= 0) & (nearest < len(grid))]]


def measure(
    sensor: TrueSensor, name: str, valid: TimeArray, position: dict[str, FloatArray], rng: np.random.Generator
) -> Source:
    """The sensor's log, in the order of its stamps.

    It measures at ``valid`` instants, int64 ns, (rows,), true positions [m or rad] in the coordinates of its log.
    """
    noises = rng.spawn(7)  # so that one kind of fault changes no other
    count, seconds = len(valid), valid / 1e9
    outlier = _outliers(sensor, count, list(position), noises[1])
    values: dict[str, FloatArray] = {}
    for axis, true in position.items():
        sd, step = of_axis(sensor.sd, axis), of_axis(sensor.quantisation, axis)
        bias = of_axis(sensor.bias, axis) + of_axis(sensor.bias_sd, axis) * noises[2].standard_normal()
        if drift := of_axis(sensor.bias_drift_sd, axis):
            bias = bias + reverting.rough(valid, drift, sensor.bias_time, noises[6])
        z = sensor.scale * true + bias + sd * noises[0].standard_normal(count) + outlier[axis]
        values[axis] = np.rint(z / step) * step if step else z
    late = sensor.latency + sensor.latency_sd * noises[3].standard_normal(count)
    own_clock = (seconds + late) * (1.0 + sensor.clock_drift * 1e-6) + sensor.clock_offset
    logged = (noises[4].random(count) >= sensor.dropouts) & ~_find_lost(sensor, seconds, noises[5])
    source = Source(np.rint(own_clock * 1e9).astype(np.int64), values, name).rows(logged)
    return source.rows(np.argsort(source.stamp, kind="stable").astype(np.int64))


def _outliers(sensor: TrueSensor, count: int, axes: list[str], rng: np.random.Generator) -> dict[str, FloatArray]:
    """The error that is added to each row [m or rad], by axis: 0 for rows that are no outliers."""
    if sensor.outliers is None:
        return dict.fromkeys(axes, np.zeros(count))
    chosen = rng.random(count) < sensor.outliers.share
    errors: dict[str, FloatArray] = {}
    for axis in axes:
        size = rng.uniform(of_axis(sensor.outliers.smallest, axis), of_axis(sensor.outliers.largest, axis), count)
        errors[axis] = chosen * size * rng.choice([-1.0, 1.0], count)
    return errors


def _find_lost(sensor: TrueSensor, seconds: FloatArray, rng: np.random.Generator) -> BoolArray:
    """Rows within an outage or a burst of losses."""
    spans = list(sensor.outages)
    if sensor.bursts is not None and len(seconds):
        length = float(seconds[-1])
        starts = rng.uniform(0.0, length, rng.poisson(sensor.bursts.per_minute * length / 60.0))
        spans += [(start, start + sensor.bursts.length) for start in starts.tolist()]
    lost = np.zeros(len(seconds), dtype=np.bool_)
    for start, end in spans:
        lost |= (seconds >= start) & (seconds < end)
    return lost
