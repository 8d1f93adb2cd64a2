"""Colours that figures and recordings share."""

from __future__ import annotations

from collections.abc import Sequence

COMMAND = "#8a8f98"
ESTIMATE = "#0b6bcb"
BAND = "#7fb2ea"
REFERENCE = "#1a1c1f"
REFERENCE_3D = "#17a2b8"  # seen on the dark and on the light of the viewer
REJECTED = "#d1242f"
OUTCOMES = {"fused": "#2da44e", "reacquired": "#e8890c", "rejected": REJECTED, "silent": "#30343a"}  # all others: grey
_SENSORS = ("#e8890c", "#2da44e", "#8250df", "#bf3989", "#1b7c83", "#9a6700")


def sensor_colours(sensors: Sequence[str]) -> dict[str, str]:
    """A colour for each sensor, by its place."""
    return {name: _SENSORS[number % len(_SENSORS)] for number, name in enumerate(sensors)}


def several(count: int) -> list[str]:
    """A colour for each of several lines that are alike."""
    every = (ESTIMATE, *_SENSORS)
    return [every[number % len(every)] for number in range(count)]


def rgb(colour: str) -> tuple[int, int, int]:
    """``#rrggbb`` as three bytes."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
