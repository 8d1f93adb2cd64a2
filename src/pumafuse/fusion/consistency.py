"""Is the filter as good as it says? Innovations against their predicted spread."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..units import MM
from .config import Sensor
from .estimates import Readings
from .timeline import Outcome


def log_likelihood(readings: Readings, sensors: Mapping[str, Sensor]) -> float:
    """Log-likelihood of the scalars with positions in mm.

    Σ −½(ln 2πS + ν²/S) over fused and reopened scalars; a gated one contributes −½(ln 2πS + gate²), so that rejecting
    a reading never costs less than meeting the gate and a tuner cannot gain by rejecting.
    """
    gate = np.array([sensors[name].gate if name in sensors else 0.0 for name in readings.sensors])
    met = readings.outcome <= Outcome.REOPENED
    variance = (readings.innovation_sd[met] * MM) ** 2
    gated = readings.outcome[met] == Outcome.GATED
    square = np.where(gated, gate[readings.sensor[met]] ** 2, readings.nis[met])
    return float(-0.5 * np.sum(np.log(2.0 * np.pi * variance) + square))
