"""A tool that turns, in a stream: orientations as axes, and what sensors in frames of their own tell of it.

Where a sensor tells no orientation, its rows are placed by the commands that act until they are valid. They are kept:
a command that comes late places them anew.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np

from ..arrays import ALWAYS, FloatArray, IntArray, TimeArray
from ..errors import ConfigError
from ..filter.core import Record
from ..filter.response import at_rest, follow
from ..fusion.config import FusionConfig
from ..fusion.placing import Placing, turning_axes
from ..logs.axes import FAR_TURN, FARTHEST_TURN
from ..logs.frames import CARTESIAN
from ..logs.screening import lost
from ..logs.source import NOISE
from ..model.arm import ArmModel
from ..space import rotations
from ..space.rotations import TURNING
from .commands import number
from .rate_limit import RateLimitedLog

ORIENTATION = "orientation"  # what an event calls its quaternion x, y, z, w
NO_TOOL = (
    "an orientation needs axes rx, ry, rz of the arm, and [tool] reference_rotation_vector_deg in fusion.toml; init,"
    " tune and register write it"
)


def axes_of(values: Iterable[str]) -> list[str]:
    """The axes that an event gives, under whatever names: an orientation is rx, ry and rz."""
    return [axis for name in values if name != NOISE for axis in (TURNING if name == ORIENTATION else (name,))]


def parse_noise(values: Mapping[str, Any]) -> float:
    """The factor on a row's noise; 1 where it does not tell a positive number."""
    factor = number(values.get(NOISE))
    return factor if 0.0 < factor < math.inf else 1.0


def check_tool(config: FusionConfig, start: Mapping[str, float]) -> None:
    """Refuse a configuration by which a stream cannot tell how the tool is turned."""
    turns = set(TURNING) <= set(config.arm.axes)
    if turns and config.tool is None:
        for name, sensor in config.sensors.items():
            if sensor.is_placed and Placing(sensor, config.arm).has_marker:
                raise ConfigError(f"sensors.{name}.marker: {NO_TOOL}")
    if config.tool is not None and (named := [axis for axis in TURNING if axis in start]):
        raise ConfigError(f"start: {named[0]}: a tool that turns starts at its first commanded orientation")


def takes_orientation(config: FusionConfig) -> bool:
    """Whether events may have an orientation: as axes, or to say where the tool point is from what a sensor sees."""
    if set(TURNING) <= set(config.arm.axes):
        return config.tool is not None
    return any(sensor.is_placed for sensor in config.sensors.values())


def tool_of(config: FusionConfig, log: RateLimitedLog) -> Tool | None:
    """The tool of a configuration that has a reference orientation, or sensors in frames of their own; else None."""
    placed = any(sensor.is_placed for sensor in config.sensors.values())
    return Tool(config, log) if placed or config.tool is not None else None


class OfTool(NamedTuple):
    """What a measurement tells of the tool."""

    values: dict[str, Any]  # by axis
    spread: dict[str, float]  # by what the noise of some is scaled
    seen: FloatArray | None  # along the base's axes [m], (3,), if the commands say where the tool point is from it


@dataclass(slots=True)
class Row:
    """A measurement of a sensor that tells no orientation."""

    stamp: int  # int ns
    seen: FloatArray  # what the sensor saw, along the base's axes [m], (3,)
    numbers: list[float]  # values and spreads as they are in the window, (2 A,)
    noise: float  # by what that of the row is scaled


class Tool:
    """What events tell of a tool that turns, as axes; bit for bit as :mod:`pumafuse.fusion.placing` has it."""

    def __init__(self, config: FusionConfig, log: RateLimitedLog) -> None:
        self._log, arm = log, config.arm
        turns = set(TURNING) <= set(arm.axes)
        self._reference = np.array(config.tool.reference) if turns and config.tool is not None else None
        self._placings = {name: Placing(sensor, arm) for name, sensor in config.sensors.items() if sensor.is_placed}
        self._takes_orientation = takes_orientation(config)
        self._latency = {name: round(config.sensors[name].latency * 1e9) for name in self._placings}
        self._rows: dict[str, list[Row]] = {}
        if self._reference is not None:
            self._rows = {name: [] for name, placing in self._placings.items() if placing.has_marker}
        self._turn = CommandedTurn(arm) if self._rows else None
        self._behind = round((max(map(arm.delay_of, arm.axes)) + max((*self._latency.values(), 0)) / 1e9) * 1e9)

    def parse(self, sensor: str | None, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """An event's values: a commanded orientation as axes, a measured one as a quaternion, (1, 4)."""
        if self._reference is not None and (twice := next((axis for axis in TURNING if axis in values), None)):
            raise ValueError(f"'{twice}': with [tool] an orientation comes as a quaternion x, y, z, w")
        if ORIENTATION not in values:
            return values
        if not self._takes_orientation:
            raise ValueError(NO_TOOL)
        parsed = dict(values)
        orientation = unit(parsed.pop(ORIENTATION))
        if sensor is not None:
            return parsed | {ORIENTATION: orientation}
        return parsed if self._reference is None else parsed | self._commanded_axes(orientation, self._reference)

    def _commanded_axes(self, orientation: FloatArray, reference: FloatArray) -> dict[str, float]:
        """A commanded orientation (1, 4) as axes."""
        vector: list[float] = rotations.vectors(orientation, reference)[0].tolist()
        turn = math.hypot(*vector)
        far = f"the tool is told to turn by {math.degrees(turn):.0f}° from its reference orientation"
        if turn > FARTHEST_TURN:
            raise ValueError(f"{far}; up to 170° can be followed: give another [tool] in fusion.toml")
        if turn > FAR_TURN:
            self._log.write("turn", f"{far}: beyond 120° error bars of its orientation are too small")
        return dict(zip(TURNING, vector, strict=True))

    def to_tool(self, sensor: str, stamp: int, values: Mapping[str, Any]) -> OfTool:
        """What a sensor tells of the tool."""
        of_axes, spread = dict(values), dict[str, FloatArray]()
        oriented: FloatArray | None = of_axes.pop(ORIENTATION, None)
        placing, seen = self._placings.get(sensor), None
        if placing is not None:
            oriented = oriented if placing.is_oriented else None
            measured = np.array([[number(values.get(axis)) for axis in CARTESIAN]])
            point = placing.to_base(measured)
            if oriented is not None:
                oriented = np.where(lost(measured)[:, None], np.nan, placing.orientation(oriented))
            if placing.has_marker and oriented is None:
                seen = point[0]
                point = point - self._lever(sensor, np.array([stamp]))
            elif placing.has_marker and oriented is not None:
                lever = placing.lever(oriented)
                point, spread = point - lever, placing.spread(lever)
            of_axes.update(zip(CARTESIAN, point[0].tolist(), strict=True))
        if oriented is not None and self._reference is not None:
            vector = rotations.vectors(oriented, self._reference)
            of_axes.update(zip(TURNING, vector[0].tolist(), strict=True))
            spread |= dict.fromkeys(TURNING, rotations.spread(vector))
        return OfTool(of_axes, {axis: float(factor[0]) for axis, factor in spread.items()}, seen)

    def _lever(self, sensor: str, stamp: TimeArray) -> FloatArray:
        """The way from the tool point to what a sensor sees [m], by the commands, (n, 3); NaN before any."""
        if self._turn is None or self._reference is None:
            return np.full((len(stamp), 3), np.nan)
        turn = self._turn.at(stamp - self._latency[sensor])
        return self._placings[sensor].lever(rotations.quaternions(turn, self._reference))

    def add(self, sensor: str, row: Row, oldest: int) -> None:
        """Add a row that the commands place; nothing that is stamped before ``oldest`` [ns] will come any more."""
        if (rows := self._rows.get(sensor)) is not None:
            rows.insert(bisect_right(rows, row.stamp, key=_stamp), row)
            if rows[0].stamp < oldest - self._behind:
                del rows[0]

    def command(self, stamp: int, values: Mapping[str, Any], oldest: int) -> int | None:
        """Add a command; from which instant on it turns the tool otherwise than was known [ns], if from any."""
        if self._turn is None or any(axis not in values for axis in TURNING):
            return None
        return self._turn.add(stamp, [values[axis] for axis in TURNING], oldest - self._behind)

    def forget(self, after: int) -> int | None:
        """Take back all that is stamped after an instant [ns]; from when on the tool is turned otherwise then [ns]."""
        for rows in self._rows.values():
            del rows[bisect_right(rows, after, key=_stamp) :]
        return None if self._turn is None else self._turn.forget(after)

    def placed_since(self, since: int) -> Iterator[tuple[str, Sequence[Row], list[list[float]]]]:
        """The rows of each sensor that are valid from an instant [ns] on, and where they place the tool point now."""
        for name, rows in self._rows.items():
            late = rows[bisect_left(rows, since, key=lambda row: row.stamp - self._latency[name]) :]
            if late:
                lever = self._lever(name, np.array([row.stamp for row in late]))
                yield name, late, (np.array([row.seen for row in late]) - lever).tolist()

    def orientation(self, turn: Sequence[float]) -> tuple[float, float, float, float] | None:
        """The quaternion x, y, z, w of rx, ry and rz [rad]; None where these are no orientation."""
        if self._reference is None or len(turn) != len(TURNING):
            return None
        x, y, z, w = rotations.quaternions(np.array([turn]), self._reference)[0].tolist()
        return x, y, z, w


class CommandedTurn:
    """How the commands turn the tool, without noise: by all that have come, in whatever order."""

    def __init__(self, arm: ArmModel) -> None:
        self._axes: list[Record] = turning_axes(arm)
        self._delay = [round(arm.delay_of(axis) * 1e9) for axis in TURNING]
        self._stamps: list[int] = []
        self._vector: list[list[float]] = []
        self._motion: list[list[Record]] = []  # of each axis, after each of them
        self._start = [math.nan] * len(TURNING)

    def add(self, stamp: int, vector: list[float], oldest: int) -> int | None:
        """Add rx, ry, rz [rad] in the place of what had the same stamp; from when on that turns the tool otherwise."""
        row = bisect_left(self._stamps, stamp)
        again = row < len(self._stamps) and self._stamps[row] == stamp
        if again and self._vector[row] == vector:
            return None
        self._stamps[row : row + again], self._vector[row : row + again] = [stamp], [vector]
        if row == 0:
            self._start = vector
        del self._motion[row:]
        for later in range(row, len(self._stamps)):
            self._motion.append([self._after(later, axis) for axis in range(len(TURNING))])
        if len(self._stamps) > 2 and self._stamps[2] <= oldest:  # one acts then, and one may be given anew
            del self._stamps[0], self._vector[0], self._motion[0]
        return stamp + min(self._delay) if row else ALWAYS

    def _after(self, row: int, axis: int) -> Record:
        motion = self._motion[row - 1][axis].copy() if row else at_rest()
        stamps, relative = self._commands(slice(row, row + 1), axis)
        follow(self._axes[axis], motion, stamps, relative, np.empty(0, np.int64))
        return motion

    def _commands(self, chosen: slice, axis: int) -> tuple[TimeArray, FloatArray]:
        """Stamps of commands, and an axis relative to where it starts."""
        relative = np.array([vector[axis] - self._start[axis] for vector in self._vector[chosen]])
        return np.array(self._stamps[chosen], dtype=np.int64), relative

    def at(self, time: IntArray) -> FloatArray:
        """rx, ry and rz [rad] at some instants, int64 ns, ascending, (n,) → (n, 3); NaN before any command is known."""
        turned = np.full((len(time), len(TURNING)), np.nan)
        if not self._stamps:
            return turned
        first, last = int(time[0]), int(time[-1])
        for axis, delay in enumerate(self._delay):
            row, end = (bisect_right(self._stamps, instant - delay) for instant in (first, last))
            motion = self._motion[row - 1][axis].copy() if row else at_rest()
            moved = follow(self._axes[axis], motion, *self._commands(slice(row, end), axis), time)
            turned[:, axis] = self._start[axis] + moved
        return turned

    def forget(self, after: int) -> int | None:
        """Take back the commands stamped after an instant [ns]; from when on the tool is turned otherwise then [ns]."""
        row = bisect_right(self._stamps, after)
        if row == len(self._stamps):
            return None
        since = self._stamps[row] + min(self._delay)
        del self._stamps[row:], self._vector[row:], self._motion[row:]
        return since if row else ALWAYS


def unit(orientation: Any) -> FloatArray:
    """A quaternion x, y, z, w of norm 1, (1, 4)."""
    listed = isinstance(orientation, list | tuple) or (isinstance(orientation, np.ndarray) and orientation.ndim == 1)
    cells = cast(Sequence[Any], orientation) if listed else ()
    parts = [number(cell) for cell in cells] if len(cells) == 4 else [math.nan] * 4
    of_quaternions = rotations.of_quaternions(np.array([parts]))
    if not np.isfinite(of_quaternions).all():
        raise ValueError(f"the orientation is no quaternion x, y, z, w of norm 1: {orientation!r:.60}")
    return of_quaternions


def _stamp(row: Row) -> int:
    return row.stamp
