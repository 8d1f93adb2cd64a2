"""What an axis was told, what was measured of it, and how well a simulated response fits."""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from ..arrays import FloatArray, TimeArray
from ..model.arm import AxisModel, commanded_speed
from ..model.drive import drive
from ..model.forced_response import forced_response

_SPIKE = 8.0  # robust standard deviations


class Fit(msgspec.Struct, frozen=True, kw_only=True):
    """How well a simulated position fits the measured one.

    Attributes:
        rms: Of the difference, without its mean [m].
        percent: Of the amplitude of the commands.
        fit: 100 (1 − ‖difference‖ / ‖measured‖), both without their means.
    """

    rms: float = msgspec.field(name="rms_mm")
    percent: float = msgspec.field(name="percent_of_signal")
    fit: float = msgspec.field(name="fit_percent")


@dataclass(frozen=True)
class Measured:
    """What one source measured of one axis; arrays (n,).

    Attributes:
        run: The run's name.
        source: The sensor, or ``reference``.
        time: When, int64 ns, ascending.
        position: Where [m], as logged.
    """

    run: str
    source: str
    time: TimeArray
    position: FloatArray

    def without_spikes(self, modelled: FloatArray) -> Measured:
        """The measurements that do not jump away from their neighbours: what is left runs on, whatever the model.

        A model that is wrong for a while must not be spared: only eight robust standard deviations from the running
        median of five count.
        """
        from scipy.ndimage import median_filter
        from scipy.stats import median_abs_deviation

        left = self.position - modelled
        jump = left - median_filter(left, size=5, mode="nearest")
        kept = np.abs(jump) <= _SPIKE * max(float(median_abs_deviation(left, scale="normal")), 1e-9)
        return replace(self, time=self.time[kept], position=self.position[kept])

    def fit(self, modelled: FloatArray, amplitude: float) -> Fit:
        """How well ``modelled`` [m] (n,) fits, whatever its mean, beside the ``amplitude`` of the commands [m]."""
        left = self.position - modelled
        rms, signal = float(np.std(left)), float(np.std(self.position))
        return Fit(
            rms=rms,
            percent=100.0 * rms / amplitude if amplitude > 0.0 else np.inf,
            fit=100.0 * (1.0 - rms / signal) if signal > 0.0 else -np.inf,
        )


@dataclass(frozen=True)
class Commands:
    """What one axis was told; arrays (k,).

    Attributes:
        time: When, int64 ns, ascending.
        value: u [m].
        period: T [s].
    """

    time: TimeArray
    value: FloatArray
    period: float

    @property
    def amplitude(self) -> float:
        """From the lowest to the highest [m]."""
        return float(np.ptp(self.value))

    @property
    def speeds(self) -> FloatArray:
        """Of the commands that move [m/s]."""
        return commanded_speed(np.diff(self.value)[np.diff(self.value) != 0.0], self.period)

    def moved(self, axis: AxisModel, delay: float, start: float, time: TimeArray) -> FloatArray:
        """Where the axis is at ``time`` [ns], relative to ``start`` [m], (n,)."""
        driven = drive(axis, self.time, self.value, start, self.period)
        return forced_response(axis.plant, driven.time + round(delay * 1e9), driven.value, time)
