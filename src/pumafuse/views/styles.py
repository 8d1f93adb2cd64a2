"""Styles of Rerun entities, and sending of their values; recordings and the live view share them."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
import rerun as rr

from ..arrays import FloatArray
from . import colours

TIMELINE = "time"
Marker = Literal["Circle", "Cross"]
Style: TypeAlias = rr.SeriesLines | rr.SeriesPoints


def line(colour: str, label: str, *, width: float = 1.5, step: bool = False) -> rr.SeriesLines:
    """A line, or a step line for what holds until the next value."""
    mode = "StepAfter" if step else "Linear"
    return rr.SeriesLines(colors=[colours.rgb(colour)], widths=[width], names=label, interpolation_mode=mode)


def edge(label: str) -> rr.SeriesLines:
    """The upper or lower line of a band."""
    return line(colours.BAND, label, width=0.7)


def points(colour: str, label: str, marker: Marker = "Circle") -> rr.SeriesPoints:
    """Points; crosses are larger."""
    size = 3.0 if marker == "Cross" else 1.2
    return rr.SeriesPoints(colors=[colours.rgb(colour)], marker_sizes=[size], names=label, markers=[marker])


def timeline(time: FloatArray) -> list[rr.TimeColumn]:
    """The timeline of seconds since the first command, (n,)."""
    return [rr.TimeColumn(TIMELINE, duration=time)]


def send(stream: rr.RecordingStream, path: str, time: FloatArray, value: FloatArray) -> None:
    """Send the finite values of a series.

    Args:
        stream: Where to.
        path: The entity.
        time: [s], (n,).
        value: In the unit of the screen, so positions in mm, (n,).
    """
    there = np.isfinite(time) & np.isfinite(value)
    if there.any():
        rr.send_columns(path, timeline(time[there]), rr.Scalars.columns(scalars=value[there]), recording=stream)
