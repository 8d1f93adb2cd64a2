"""Styles and the timeline of Rerun entities, which recordings and the live view share."""

from __future__ import annotations

from typing import Literal, TypeAlias

import rerun as rr

from ..arrays import FloatArray
from . import colours

TIMELINE = "time"
Marker = Literal["Circle", "Cross"]
Style: TypeAlias = rr.SeriesLines | rr.SeriesPoints | rr.Measurements

_NOT_OF_SENSORS = {"command", "estimate", "reference", "upper", "lower"}


def entity(sensor: str) -> str:
    """The entity of a sensor, apart from those that are not a sensor's."""
    return f"{sensor}_sensor" if sensor in _NOT_OF_SENSORS else sensor


def line(colour: str, label: str, *, width: float = 1.5, step: bool = False) -> rr.SeriesLines:
    """A line, or a step line for what holds until the next value."""
    mode = "StepAfter" if step else "Linear"
    return rr.SeriesLines(colors=[colours.rgb(colour)], widths=[width], names=label, interpolation_mode=mode)


def edge(label: str) -> rr.SeriesLines:
    """The upper or lower line of a band."""
    return line(colours.BAND, label, width=0.7)


def banded(label: str, unit: str) -> rr.Measurements:
    """A line with a translucent band of a standard deviation each way."""
    return rr.Measurements.from_fields(colors=[colours.rgb(colours.ESTIMATE)], widths=[1.8], names=label, units=unit)


def points(colour: str, label: str, marker: Marker = "Circle") -> rr.SeriesPoints:
    """Points; crosses are larger."""
    size = 3.0 if marker == "Cross" else 1.2
    return rr.SeriesPoints(colors=[colours.rgb(colour)], marker_sizes=[size], names=label, markers=[marker])


def timeline(time: FloatArray) -> list[rr.TimeColumn]:
    """The timeline of seconds since the first command, (n,)."""
    return [rr.TimeColumn(TIMELINE, duration=time)]
