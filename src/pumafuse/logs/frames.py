"""Frames: positions in a log's x, y, z as positions of the arm's axes, and back.

``cylindrical``: radial = r, tangential = R0·(θ − θ0), vertical = z about the base's vertical axis, with R0 and θ0 from
the start level. ``rotated``: a fixed rotation about z, for small motions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import Literal, TypeAlias

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..model.arm import CANONICAL_AXES, ArmModel

CARTESIAN = ("x", "y", "z")
Direction = Literal["counterclockwise", "clockwise"]
_TURN = 2.0 * math.pi
_QUIET = np.errstate(over="ignore", invalid="ignore")  # a sensor without a target may report infinity, or 1.8e308


class Cylindrical(
    msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="cylindrical", forbid_unknown_fields=True
):
    """Cylindrical axes about the arm's base.

    Attributes:
        base: The base's vertical axis in the log's x and y [m].
        positive: Direction of +tangential seen from above.
    """

    base: tuple[float, float] = msgspec.field(name="base_mm", default=(0.0, 0.0))
    positive: Direction = "counterclockwise"


class Rotated(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", tag="rotated", forbid_unknown_fields=True):
    """Axes at a fixed angle in the log's x and y.

    Attributes:
        azimuth: Direction of +radial, counterclockwise from x [rad].
        positive: Direction of +tangential seen from above: to the left of +radial, or to its right.
    """

    azimuth: float = msgspec.field(name="azimuth_deg")
    positive: Direction = "counterclockwise"


Frame: TypeAlias = Cylindrical | Rotated


def in_space(arm: ArmModel) -> tuple[str, ...]:
    """The axes that are a position in space, empty without such.

    x, y, z; tangential, radial, vertical; or else the first three lengths, or two that are a position in a plane.
    """
    lengths = [name for name, axis in arm.axes.items() if axis.kind == "length"]
    names_of_space = next((names for names in (CARTESIAN, CANONICAL_AXES) if set(lengths).issuperset(names)), None)
    return names_of_space or (tuple(lengths[:3]) if len(lengths) > 1 else ())


@dataclass(frozen=True)
class Placed:
    """A frame placed at a run's start level, which gives R0 and θ0.

    Attributes:
        frame: The frame.
        radius: R0 [m]; 1 in a rotated frame, where it has no meaning.
        angle: θ0, or the azimuth [rad].
    """

    frame: Frame
    radius: float
    angle: float

    @property
    def _sign(self) -> float:
        return 1.0 if self.frame.positive == "counterclockwise" else -1.0

    @property
    def _lever(self) -> float:
        """Tangential position [m] of an angle of 1 rad."""
        return self._sign * self.radius

    @_QUIET
    def to_axes(
        self, x: FloatArray, y: FloatArray, near: FloatArray | None = None, last: float = 0.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Tangential and radial position [m] of x and y [m] in the log, and the factor on the tangential noise.

        Args:
            x: (n,).
            y: (n,).
            near: Tangential positions [m] near by, (n,), which decide on whole turns; None: each position is less than
                half a turn from the one before.
            last: The tangential position [m] before the first one.

        Returns:
            Tangential (n,), radial (n,), and R0/r (n,), the factor on the noise of a tangential measurement. NaN, NaN
            and 1 for a row without x or y.
        """
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        if isinstance(self.frame, Rotated):
            cos, sin = math.cos(self.angle), math.sin(self.angle)
            finite = np.isfinite(x) & np.isfinite(y)
            x, y = np.where(finite, x, np.nan), np.where(finite, y, np.nan)
            return self._sign * (y * cos - x * sin), x * cos + y * sin, np.ones(len(x))
        dx, dy = x - self.frame.base[0], y - self.frame.base[1]
        r = np.hypot(dx, dy)
        is_seen = np.isfinite(x + y) & (r > 0.0)  # some sensors that lost their target report the base's axis
        r, turn = np.where(is_seen, (r, np.arctan2(dy, dx) - self.angle), np.nan)
        spread = np.where(is_seen, self.radius / r, 1.0)
        lever = self._lever
        if near is not None:
            return lever * (turn + _TURN * np.rint((near / lever - turn) / _TURN)), r, spread

        def follow(before: float, turn: float) -> float:  # from the position before, which is all that a stream keeps
            return lever * (turn + _TURN * round((before / lever - turn) / _TURN))

        tangential = np.full(len(x), np.nan)
        tangential[is_seen] = list(accumulate(turn[is_seen].tolist(), follow, initial=last))[1:]
        return tangential, r, spread

    @_QUIET
    def to_log(self, tangential: FloatArray, radial: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The log's x and y [m] of axis positions [m]; the inverse of :meth:`to_axes`."""
        if isinstance(self.frame, Rotated):
            across = self._sign * tangential
            cos, sin = math.cos(self.angle), math.sin(self.angle)
            return radial * cos - across * sin, radial * sin + across * cos
        theta = self.angle + tangential / self._lever
        return self.frame.base[0] + radial * np.cos(theta), self.frame.base[1] + radial * np.sin(theta)

    def in_log(self, position: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """The log's x, y and z [m] of positions of axes [m], those that these give."""
        in_log = {"z": position["vertical"].copy()} if "vertical" in position else {}
        if "tangential" in position and "radial" in position:
            x, y = self.to_log(position["tangential"], position["radial"])
            in_log = {"x": x, "y": y} | in_log
        return in_log

    def jacobian(self, tangential: FloatArray, radial: FloatArray) -> FloatArray:
        """How the log's x and y change with the tangential and the radial position [m], (n, 2, 2)."""
        rotated = isinstance(self.frame, Rotated)
        theta = np.full(len(radial), self.angle) if rotated else self.angle + tangential / self._lever
        along = self._sign if rotated else radial / self._lever
        cos, sin = np.cos(theta), np.sin(theta)
        return np.stack([-along * sin, cos, along * cos, sin], axis=1).reshape(-1, 2, 2)
