"""What figures and recordings share: colours, where a sensor saw the tool, and where to look first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..fusion.estimates import Estimates, Measurements

COMMAND = "#8a8f98"
ESTIMATE = "#0b6bcb"
BAND = "#7fb2ea"
REFERENCE = "#1a1c1f"
REFERENCE_3D = "#c9ccd1"  # the viewer is dark
REJECTED = "#d1242f"
_SENSORS = ("#e8890c", "#2da44e", "#8250df", "#bf3989", "#1b7c83", "#9a6700")


def sensor_colours(sensors: Sequence[str]) -> dict[str, str]:
    """A colour for each sensor, by its place."""
    return {name: _SENSORS[number % len(_SENSORS)] for number, name in enumerate(sensors)}


def rgb(colour: str) -> tuple[int, int, int]:
    """``#rrggbb`` as three bytes."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def positions(est: Estimates, sensor: str, axis: str) -> Measurements:
    """A sensor's components as positions in the log's coordinates: scale and the estimated bias taken off."""
    measurements = est.measurements.of(sensor, axis)
    if sensor not in est.config.sensors:
        return measurements.where(np.zeros(len(measurements.value), dtype=bool))
    bias = est.biases.get(sensor, {}).get(axis)
    return measurements.as_position(est.config.sensors[sensor].scale, 0.0 if bias is None else bias.value)


def busiest(est: Estimates, length: float) -> tuple[float, float]:
    """Start and end [s] of the ``length`` [s] with the most motion, each axis counted by its share of its own."""
    travelled = np.zeros(len(est.time))
    for axis in est.axes.values():
        steps = np.abs(np.diff(axis.position, prepend=axis.position[0]))
        travelled += np.cumsum(steps) / max(float(steps.sum()), 1e-12)
    ends = np.minimum(np.searchsorted(est.time, est.time + length), len(est.time) - 1)
    start = float(est.time[np.argmax(travelled[ends] - travelled)])
    return start, start + length
