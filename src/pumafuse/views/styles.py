"""How Rerun gets entities, in recordings and in the live view: their styles, their timeline, and where they go."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
import rerun as rr

from ..arrays import FloatArray
from ..units import MM, Screen
from . import colours

TIMELINE = "time"
Marker = Literal["Circle", "Cross"]
Style: TypeAlias = rr.SeriesLines | rr.SeriesPoints | rr.Measurements

_NOT_OF_SENSORS = {"command", "estimate", "reference", "upper", "lower", "noise"}


def entity(sensor: str) -> str:
    """The entity of a sensor, apart from those that are not a sensor's."""
    return f"{sensor}_sensor" if sensor in _NOT_OF_SENSORS else sensor


def line(colour: str, label: str, *, width: float = 1.5, step: bool = False) -> rr.SeriesLines:
    """A line, or a step line for what holds until the next value."""
    mode = "StepAfter" if step else "Linear"
    return rr.SeriesLines(colors=[colours.rgb(colour)], widths=[width], names=label, interpolation_mode=mode)


def points(colour: str, label: str, marker: Marker = "Circle") -> rr.SeriesPoints:
    """Points; crosses are larger."""
    size = 3.0 if marker == "Cross" else 1.2
    return rr.SeriesPoints(colors=[colours.rgb(colour)], marker_sizes=[size], names=label, markers=[marker])


def timeline(time: FloatArray) -> list[rr.TimeColumn]:
    """The timeline of seconds since the first command, (n,)."""
    return [rr.TimeColumn(TIMELINE, duration=time)]


@dataclass(frozen=True)
class Sink:
    """Where entities go."""

    stream: rr.RecordingStream
    times: Callable[[FloatArray], list[rr.TimeColumn]] = timeline  # of seconds since the first command, (n,)
    root: str = ""  # what paths begin with
    scale: float = MM  # how many units of the scene a metre is
    _styled: set[str] = field(default_factory=set[str])

    def log(self, path: str, part: rr.AsComponents) -> None:
        """Send what holds at all times."""
        rr.log(f"{self.root}{path}", part, static=True, recording=self.stream)

    def log_at(self, time: float, path: str, part: rr.AsComponents) -> None:
        """Send what holds from a time on [s]."""
        self.stream.set_time(TIMELINE, duration=time)
        self.stream.log(f"{self.root}{path}", part)

    def send_columns(self, path: str, time: FloatArray, columns: rr.ComponentColumnList) -> None:
        """Send what is for times [s since the first command], (n,)."""
        rr.send_columns(f"{self.root}{path}", self.times(time), columns, recording=self.stream)

    def send_series(
        self, path: str, style: Style, time: FloatArray, value: FloatArray, screen: Screen | None = None
    ) -> None:
        """Send the finite values of an entity, with a screen from SI."""
        is_known = np.isfinite(time) & np.isfinite(value)
        scale = 1.0 if screen is None else screen.scale
        self._send(path, style, time[is_known], rr.Scalars.columns(scalars=value[is_known] * scale))

    def send_band(
        self, path: str, label: str, time: FloatArray, value: FloatArray, sd: FloatArray, screen: Screen
    ) -> None:
        """Send values [SI] with their variances: a line with a translucent band of a standard deviation each way."""
        colour = colours.rgb(colours.ESTIMATE)
        style = rr.Measurements.from_fields(colors=[colour], widths=[1.8], names=label, units=screen.unit)
        columns = rr.Measurements.columns(values=value * screen.scale, variances=(sd * screen.scale) ** 2)
        self._send(path, style, time, columns)

    def _send(self, path: str, style: Style, time: FloatArray, columns: rr.ComponentColumnList) -> None:
        """Send columns, with the first of them their style; nothing where there are none."""
        if not len(time):
            return
        if path not in self._styled:
            self._styled.add(path)
            self.log(path, style)
        self.send_columns(path, time, columns)
