"""Conversion between a stream's x, y, z and the arm's axes, once its start is known."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..arrays import FloatArray
from ..errors import UnknownNameError
from ..logs.axes import placed_at
from ..logs.frames import CARTESIAN, Frame, Placed, Rotated


class FrameStart:
    """A frame that starts at the start level, or at the first command."""

    def __init__(self, frame: Frame | None, axes: tuple[str, ...]) -> None:
        """Wait for a start, unless the frame is rotated: then it needs none."""
        self._frame, self._axes = frame, axes
        self.placed: Placed | None = placed_at(frame, 0.0, 0.0, "") if isinstance(frame, Rotated) else None
        self.since: int | None = None  # stamp of the command that gave the start [ns]
        self._last = 0.0  # tangential position of the command before [m]

    @property
    def waits(self) -> bool:
        """Whether a command is needed to know the start."""
        return self._frame is not None and self.placed is None

    def start_at_level(self, level: Mapping[str, float]) -> dict[str, float]:
        """Convert a start level to axes [m]; its x and y start the frame."""
        in_axes = {name: value for name, value in level.items() if name in self._axes}
        others = {name: value for name, value in level.items() if name not in in_axes}
        if others and (
            self._frame is None or not others.keys() <= set(CARTESIAN) or ("x" in others) != ("y" in others)
        ):
            raise UnknownNameError("start", "axis", next(iter(others)), self._axes)
        if self._frame is not None and "x" in others:
            self.placed = self.placed or placed_at(self._frame, others["x"], others["y"], "start")
        return in_axes | {axis: value for axis, (value, _) in self.in_axes(others, None).items()}

    def start_at_command(self, stamp: int, x: float, y: float) -> None:
        """Start the frame at a command's x and y [m]."""
        assert self._frame is not None
        self.placed, self.since = placed_at(self._frame, x, y, "command"), stamp

    def in_axes(self, values: Mapping[str, float], near: FloatArray | None) -> dict[str, tuple[float, float]]:
        """Convert x, y, z [m] to axes: for each its position [m], and the factor by which its noise grows.

        A measurement comes with the commanded tangential position [m], (1,); x without y is NaN on both axes.
        """
        starts: dict[str, tuple[float, float]] = {}
        if self.placed is not None and ("x" in values or "y" in values):
            x, y = (np.array([values.get(name, np.nan)]) for name in ("x", "y"))
            tangential, radial, spread = self.placed.to_axes(x, y, near, self._last)
            if near is None and np.isfinite(tangential[0]):
                self._last = float(tangential[0])
            starts["tangential"] = float(tangential[0]), float(spread[0])
            starts["radial"] = float(radial[0]), 1.0
        if "z" in values:
            starts["vertical"] = values["z"], 1.0
        return {axis: component for axis, component in starts.items() if axis in self._axes}

    def in_log(self, positions: Mapping[str, float]) -> dict[str, float] | None:
        """Convert axis positions [m] back to x, y, z [m], as far as they give these; None before the start is known."""
        if self.placed is None:
            return None
        in_log = self.placed.in_log({axis: np.array([position]) for axis, position in positions.items()})
        return {name: float(level[0]) for name, level in in_log.items()}
