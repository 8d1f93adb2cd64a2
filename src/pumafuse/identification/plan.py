"""Plan of the commands to an arm: a randomised, balanced step campaign, and binary white noise for verification.

Every block of the campaign has every combination of position, axis and speed once, in an order of its own. So a drift
during the day does not look like a factor, and a campaign that is cut short after a block is still balanced.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from .. import folders
from ..arrays import FloatArray, IntArray
from ..errors import ConfigError
from ..logs import tables
from ..model.arm import ArmModel
from ..simulation.trajectory import WhiteNoise, ticks
from ..units import DEG, MS, SCREEN, SPEEDS, Kind, in_unit, of_kind, refuse_name

TRIALS, STEPS = "trials.csv", "steps.csv"
_NOISE = "white-noise-"
_SETTLED = 0.98  # share of the final value
_MOST_TRIALS, _MOST_ROWS = 100_000, 5_000_000
_TAKEN = frozenset({"trial", "axis", "step_mm", "step_deg", "speed_m_s", "speed_deg_s", "replicate", "tick", "time_s"})


class _Sizes(NamedTuple):
    """Sizes of steps [m or rad], and a speed [m/s or rad/s]."""

    least: float  # that a step can be
    most: float
    shortest: float  # less than this no sensor of an arm resolves
    fastest: float  # that no arm reaches


_SIZES: dict[Kind, _Sizes] = {
    "length": _Sizes(1e-6, 10.0, 50e-6, 10.0),
    "angle": _Sizes(1e-4 / DEG, 360.0 / DEG, 3e-3 / DEG, 3e3 / DEG),
}


@dataclass(frozen=True)
class Design:
    """Design of a campaign.

    Attributes:
        axes: To step, one at a time.
        speeds: Of the steps [m/s or rad/s]; a step is its speed times the update period.
        period: T [s].
        positions: A row of coordinates for each place where steps are made, as they are to be written; one empty row
            where the arm stays.
        replicates: Blocks.
        hold: How long a step is held [s].
        rest: How long the arm rests at 0 before and after each step [s].
        amplitudes: Of the white noise, a sequence for each axis [m or rad].
        noise_duration: Of each sequence [s].
        seed: Of the order and of the noise.
        kind: What the axes are.
    """

    axes: tuple[str, ...]
    speeds: tuple[float, ...]
    period: float
    positions: tuple[Mapping[str, str], ...]
    replicates: int
    hold: float
    rest: float
    amplitudes: tuple[float, ...]
    noise_duration: float
    seed: int
    kind: Kind = "length"

    def __post_init__(self) -> None:
        if not self.axes or len(set(self.axes)) < len(self.axes):
            raise ConfigError("plan: at least one axis, and each once")
        for axis in self.axes:
            refuse_name("axis", axis)
            if axis in _TAKEN or re.search(r"[^\w -]", axis):
                raise ConfigError(f"plan: an axis cannot be called '{axis}'")
        if not self.speeds or not self.positions:
            raise ConfigError("plan: at least one speed, and one position")
        if self.seed < 0:
            raise ConfigError(f"plan: seed must be >= 0, not {self.seed}")
        steps, sizes = [speed * self.period for speed in self.speeds], _SIZES[self.kind]
        for name, of_these in (("speeds", steps), ("amplitudes", self.amplitudes)):
            if any(not sizes.least <= size <= sizes.most for size in of_these):
                limits = (_written(limit, self.kind) for limit in (sizes.least, sizes.most))
                raise ConfigError(f"plan: {name} must make steps of {' to '.join(limits)}")
            if len({_written(size, self.kind) for size in of_these}) < len(of_these):
                raise ConfigError(f"plan: two {name} make the same step")
        if taken := sorted(_TAKEN & set(self.positions[0])):
            raise ConfigError(f"plan: positions cannot have a column '{taken[0]}': trials.csv needs it itself")
        count = len(self.positions) * len(self.axes) * len(self.speeds) * self.replicates
        rows = count * (self.hold + 2.0 * self.rest) / self.period
        if count > _MOST_TRIALS or not rows <= _MOST_ROWS:
            raise ConfigError(f"plan: {count} trials of {rows:.3g} ticks; at most {_MOST_TRIALS} of {_MOST_ROWS:g}")
        ticks(self.noise_duration + 2.0 * self.rest, self.period)


@dataclass(frozen=True)
class PlannedTrial:
    """One step of a campaign."""

    position: Mapping[str, str]
    axis: str
    speed: float
    replicate: int


@dataclass(frozen=True)
class Plan:
    """A campaign, ready to be sent.

    Attributes:
        design: What it was made for.
        trials: In the order in which they are to be made.
        noise: White noise [m or rad] by axis and amplitude, tick by tick, (n,).
        duration: Of all sequences [s], without the moves between positions.
        warnings: What is wrong with it, a sentence each.
    """

    design: Design
    trials: tuple[PlannedTrial, ...]
    noise: Mapping[tuple[str, float], FloatArray]
    duration: float
    warnings: tuple[str, ...]


def kind_of(axes: Iterable[str], arm: ArmModel) -> Kind:
    """What the axes of a campaign are: all of one kind.

    Raises:
        PumafuseError: They are not, or the arm has no such axis.
    """
    kinds: dict[Kind, str] = {arm.axis(axis).kind: axis for axis in axes}
    if len(kinds) > 1:
        words = f"{kinds['length']} is a length, {kinds['angle']} an angle"
        raise ConfigError(f"plan: {words}: plan a campaign for each, with --axes")
    return "angle" if "angle" in kinds else "length"


def plan(design: Design, arm: ArmModel | None = None, max_speed: float | None = None) -> Plan:
    """A campaign in random order, with its warnings.

    Args:
        design: What it is to vary.
        arm: What is known of the arm so far, for warnings; None: nothing.
        max_speed: The arm's limit [m/s or rad/s]; None: the arm's validity, where it is known.
    """
    rng = np.random.default_rng(design.seed)
    cells = list(product(design.positions, design.axes, design.speeds))
    trials = [
        PlannedTrial(*cells[index], block)
        for block in range(1, design.replicates + 1)
        for index in map(int, rng.permutation(len(cells)))
    ]
    resting = np.zeros(_ticks(design.rest, design.period))
    noise: dict[tuple[str, float], FloatArray] = {}
    for axis, amplitude in product(design.axes, design.amplitudes):
        sequence = WhiteNoise(axes=[axis], amplitude=amplitude, duration=design.noise_duration)
        noise[axis, amplitude] = np.concatenate((resting, sequence.offsets(design.period, rng)[axis], resting))
    count = len(trials) * len(_one_step(design)) + sum(map(len, noise.values()))
    return Plan(design, tuple(trials), noise, count * design.period, tuple(_warnings(design, arm, max_speed)))


def check_writable(folder: Path, force: bool) -> None:
    """Refuse early what :func:`write` would refuse late.

    Raises:
        FolderError: The folder exists and is not to be replaced, or holds something else than a plan.
    """
    folders.check_writable(
        folder, force, (TRIALS, STEPS), lambda name: name in (TRIALS, STEPS) or name.startswith(_NOISE)
    )


def write(planned: Plan, folder: Path, force: bool) -> None:
    """Write ``trials.csv`` as `identify` reads it, ``steps.csv`` tick by tick, and a file for each noise sequence.

    Raises:
        FolderError: See :func:`check_writable`, or the disk refuses.
    """
    check_writable(folder, force)
    design, trials, step = planned.design, planned.trials, _one_step(planned.design)
    kind = design.kind
    listed = {
        "trial": range(1, len(trials) + 1),
        "axis": [trial.axis for trial in trials],
        of_kind("step_mm", kind): _shown(np.array([trial.speed for trial in trials]) * design.period, kind),
        of_kind("speed_m_s", kind): [float(in_unit(trial.speed, SPEEDS[kind][0])) for trial in trials],
        **{name: [trial.position[name] for trial in trials] for name in design.positions[0]},
        "replicate": [trial.replicate for trial in trials],
    }
    offsets = {
        axis: np.outer([trial.speed * design.period * (trial.axis == axis) for trial in trials], step).ravel()
        for axis in design.axes
    }
    steps = _sequence(np.tile(np.arange(len(step)), len(trials)), design, offsets)
    files = {
        TRIALS: listed,
        STEPS: {"trial": np.repeat(listed["trial"], len(step)), **steps},
        **{
            f"{_NOISE}{axis}-{_written(size, kind, '')}.csv": _sequence(np.arange(len(noise)), design, {axis: noise})
            for (axis, size), noise in planned.noise.items()
        },
    }
    with folders.replacing(folder) as new:
        for name, columns in files.items():
            tables.write(pa.table(columns), new / name)


def _written(size: float, kind: Kind, between: str = " ") -> str:
    """A size as files have it, with its unit."""
    return f"{_shown(size, kind):.10g}{between}{SCREEN[kind].unit}"


def _shown(size: FloatArray | float, kind: Kind) -> FloatArray:
    """In mm to the nanometre, or in degrees to a millionth."""
    return np.round(np.asarray(size) * SCREEN[kind].scale, 6)


def _ticks(duration: float, period: float) -> int:
    return max(round(duration / period), 1)


def _one_step(design: Design) -> FloatArray:
    """0, 1, 0: a step of size 1 with the rest before and after it, tick by tick."""
    rest, hold = _ticks(design.rest, design.period), _ticks(design.hold, design.period)
    return np.repeat([0.0, 1.0, 0.0], [rest, hold, rest])


def _sequence(tick: IntArray, design: Design, offsets: Mapping[str, FloatArray]) -> dict[str, npt.NDArray[Any]]:
    """Columns of a sequence of commands [m or rad], tick by tick."""
    columns = {of_kind(f"{axis}_mm", design.kind): _shown(values, design.kind) for axis, values in offsets.items()}
    return {"tick": tick, "time_s": np.round(tick * design.period, 9), **columns}


def _warnings(design: Design, arm: ArmModel | None, max_speed: float | None) -> list[str]:
    found: list[str] = []
    if len(design.speeds) == 1:
        found.append("one speed only: the gain's dependence on speed is not identifiable")
    if design.replicates == 1:
        found.append("no replicates: scatter from trial to trial cannot be separated from the factors' effects")
    if not design.amplitudes:
        found.append("no white noise: there will be nothing to verify the model with")
    limit = arm.validity.limit_of(design.kind) if max_speed is None and arm is not None else max_speed
    screen, known = SCREEN[design.kind], _SIZES[design.kind]
    sizes = [*(speed * design.period for speed in design.speeds), *design.amplitudes]
    longest, fastest = max(sizes), max(sizes) / design.period
    top = f"{fastest * screen.fast_scale:.3g} {screen.fast}"
    if fastest > known.fastest or longest < known.shortest:
        found.append(f"steps are {longest * screen.scale:.3g} {screen.unit} at most, {top} at T; is a unit wrong?")
    if len({tuple(place.items()) for place in design.positions}) < len(design.positions):
        found.append("positions: one is listed twice: it is tried twice as often as the others")
    if limit is not None and fastest > limit * (1.0 + 1e-9):
        found.append(f"commanded speeds reach {top}, the limit is {limit * screen.fast_scale:.3g} {screen.fast}")
    if arm is None:
        return [*found, "not checked: whether steps settle within the hold; give --arm"]
    between = {"the hold": design.hold, "the rest between steps": 2.0 * design.rest + design.period}
    for axis, (name, length) in product(design.axes, between.items()):
        needed = arm.delay_of(axis) + _settling(arm, axis)
        if needed > length:
            times = f"{length * MS:.0f} ms is too short to settle: {needed * MS:.0f} ms are needed"
            found.append(f"{axis}: {name} of {times}")
    return found


def _settling(arm: ArmModel, axis: str) -> float:
    """Until the plant stays within 2 % of its final value [s]."""
    plant = arm.axis(axis).plant
    time = np.linspace(0.0, 20.0 * plant.lag + 1e-9, 4001)
    outside = np.flatnonzero(np.abs(plant.step_response(time) - 1.0) > 1.0 - _SETTLED)
    return float(time[outside[-1]])
