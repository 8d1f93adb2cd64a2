"""Trajectories: commands on the ticks of T, as offsets from the start level."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import msgspec
import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import ConfigError
from ..logs import tables
from ..toml import NotNegative, Positive
from ..units import ending, seconds

_MOST_TICKS = 200_000  # 93 minutes at 28 ms; a gigabyte of work

Offsets: TypeAlias = dict[str, FloatArray]
Count: TypeAlias = Annotated[int, msgspec.Meta(gt=0, le=10_000)]


class Trajectory(msgspec.Struct, frozen=True, kw_only=True, tag_field="kind", forbid_unknown_fields=True):
    """Base of the trajectories; axes that one does not move hold their start level.

    ``moving`` names the axes that move. ``offsets(period, rng)`` are the commands [m or rad] relative to the start
    level at ticks 0, T, 2T, …, by axis, all of one length (ticks,).
    """


class OnAxes(Trajectory, frozen=True, kw_only=True):
    """Base of the trajectories that name their axes in a list."""

    axes: Annotated[list[str], msgspec.Meta(min_length=1)]  # the axes that move

    @property
    def moving(self) -> tuple[str, ...]:
        """The axes that move."""
        return tuple(self.axes)


class Timed(OnAxes, frozen=True, kw_only=True):
    """Base of the trajectories that say how long they last."""

    duration: Positive = msgspec.field(name="duration_s")  # [s]


class Raster(Trajectory, frozen=True, kw_only=True, tag="raster"):
    """Lines to and fro over a panel at constant speed, each one pitch beyond the last."""

    along: str = "tangential"  # the axis of the lines
    across: str = "vertical"  # the axis of the pitch
    width: Positive = msgspec.field(name="width_mm")  # length of a line [m]
    height: NotNegative = msgspec.field(name="height_mm")  # what the lines cover [m]
    pitch: Positive = msgspec.field(name="pitch_mm")  # between lines [m]
    speed: Positive = msgspec.field(name="speed_m_s")  # of the command [m/s]

    def __post_init__(self) -> None:
        if self.along == self.across:
            raise ConfigError(f"trajectory: along and across are both '{self.along}'")

    @property
    def moving(self) -> tuple[str, ...]:
        """Along and across."""
        return self.along, self.across

    def offsets(self, period: float, rng: np.random.Generator) -> Offsets:
        """The corner points, joined at constant speed."""
        ticks((self.height / self.pitch + 1.0) * self.width / self.speed, period)  # refused before the lines are made
        lines = int(self.height / self.pitch + 1e-9) + 1
        line = np.repeat(np.arange(lines), 2)
        side = np.tile([0.0, 1.0, 1.0, 0.0], lines // 2 + 1)[: 2 * lines]
        corners = {self.along: side * self.width, self.across: line * self.pitch}
        length = np.cumsum(np.hypot(*(np.diff(path, prepend=0.0) for path in corners.values())))
        way = ticks(float(length[-1]) / self.speed, period) * period * self.speed
        return {axis: np.interp(way, length, path) for axis, path in corners.items()}


class Steps(OnAxes, frozen=True, kw_only=True, tag="steps"):
    """A campaign of step trials: each step is one command, up and down in turn, with rests between.

    Every size on every axis in both directions, ``replicates`` times, in random order, the first ``trials`` of them.
    ``trials.csv`` and ``samples.csv`` are cut from the one run that goes through all of them.
    """

    sizes: Annotated[list[Positive], msgspec.Meta(min_length=1)] = msgspec.field(name="sizes_mm")  # of the steps [m]
    replicates: Count = 1  # of each combination
    trials: Count | None = None  # how many to keep, as of a campaign that was cut short; None: all
    rest: Positive = msgspec.field(name="rest_s", default=1.0)  # between steps [s]
    window: Positive = msgspec.field(name="window_s", default=0.33)  # how long a trial is sampled [s]
    scope: str  # the sensor that samples it

    def __post_init__(self) -> None:
        if self.window > self.rest:
            raise ConfigError("trajectory: window_s is longer than rest_s: a trial would see the next step")

    def plan(self, rng: np.random.Generator) -> list[tuple[str, float]]:
        """Axis and signed step [m] of each trial, in order: a step down on an axis follows one up on it."""
        pairs = [(axis, size) for axis in self.axes for size in self.sizes for _ in range(self.replicates)]
        order: list[int] = rng.permutation(len(pairs)).tolist()
        trials = [(axis, sign * size) for axis, size in (pairs[index] for index in order) for sign in (1.0, -1.0)]
        return trials[: self.trials]

    def offsets(self, period: float, rng: np.random.Generator) -> Offsets:
        """The sum of the steps so far."""
        plan, pause = self.plan(rng), self.ticks_between(period)
        ticks((len(plan) + 1) * pause * period, period)
        offsets = {axis: np.zeros((len(plan) + 1) * pause) for axis in self.axes}
        for number, (axis, step) in enumerate(plan, 1):
            offsets[axis][number * pause :] += step
        return offsets

    def ticks_between(self, period: float) -> int:
        """Ticks from one step to the next."""
        return max(round(self.rest / period), 1)


class WhiteNoise(Timed, frozen=True, kw_only=True, tag="white-noise"):
    """The paper's binary white noise on each axis: between two levels, changing with probability 0.5 each period."""

    amplitude: Positive = msgspec.field(name="amplitude_mm")  # from one level to the other [m]

    def offsets(self, period: float, rng: np.random.Generator) -> Offsets:
        """0 or the amplitude; the first command is the start level."""
        count = len(ticks(self.duration, period))
        offsets: Offsets = {}
        for axis in self.axes:
            switches = rng.random(count) < 0.5
            switches[0] = False
            offsets[axis] = np.where(np.cumsum(switches) % 2, self.amplitude, 0.0)
        return offsets


class SineSweep(Timed, frozen=True, kw_only=True, tag="sine-sweep"):
    """A sine whose frequency grows by the same factor each second."""

    amplitude: Positive = msgspec.field(name="amplitude_mm")  # of the sine [m]
    start_frequency: Positive = msgspec.field(name="from_hz")  # [Hz]
    end_frequency: Positive = msgspec.field(name="to_hz")  # [Hz]

    def offsets(self, period: float, rng: np.random.Generator) -> Offsets:
        """A sin φ with φ = 2π ∫ f dt and f = f₀ (f₁/f₀)^(t/duration)."""
        time = ticks(self.duration, period) * period
        growth = float(np.log(self.end_frequency / self.start_frequency)) / self.duration
        turns = time if growth == 0.0 else np.expm1(growth * time) / growth
        sine = self.amplitude * np.sin(2.0 * np.pi * self.start_frequency * turns)
        return {axis: sine.copy() for axis in self.axes}


class Hold(Timed, frozen=True, kw_only=True, tag="hold"):
    """Nothing moves for ``duration``."""

    def offsets(self, period: float, rng: np.random.Generator) -> Offsets:
        """Zeros."""
        return {axis: np.zeros(len(ticks(self.duration, period))) for axis in self.axes}


class PathFromFile(OnAxes, frozen=True, kw_only=True, tag="path"):
    """A path from a table, linear between its rows, relative to its first row."""

    file: str  # a CSV or Parquet table beside the scenario with ``time_s`` and ``<axis>_mm`` (or any unit)

    def offsets(self, period: float, rng: np.random.Generator) -> Offsets:
        """The path on the ticks."""
        table = tables.read(Path(self.file))
        if table.notes:  # a row that is left out is a path of its own
            raise ConfigError("; ".join(table.notes))
        time = seconds(table.stamps("time_s")[0])
        if not np.isfinite(time).all() or (np.diff(time) <= 0.0).any():
            raise ConfigError(f"{self.file}: time_s must ascend from row to row")
        at = ticks(float(time[-1] - time[0]), period) * period + time[0]
        offsets: Offsets = {}
        for axis in self.axes:
            column = next((name for name in table.columns if name.removesuffix(ending(name) or "") == axis), None)
            values, _ = table.numbers(column or f"{axis}_mm")
            if not np.isfinite(values).all():
                raise ConfigError(f"{self.file}: {column} has a cell without a number")
            offsets[axis] = np.interp(at, time, values) - values[0]
        return offsets


TRAJECTORIES: TypeAlias = Raster | Steps | WhiteNoise | SineSweep | Hold | PathFromFile


def ticks(duration: float, period: float) -> IntArray:
    """Numbers of the ticks from 0 to ``duration`` [s], the last at or after it; not too many to simulate at a time."""
    if not duration / period < _MOST_TICKS:
        raise ConfigError(f"trajectory: {duration / period + 1.0:.6g} commands; at most {_MOST_TICKS} in one run")
    return np.arange(int(np.ceil(duration / period - 1e-9)) + 1)
