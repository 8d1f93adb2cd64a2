"""From a scenario and a seed to a recorded run with its truth: :func:`simulate`."""

from __future__ import annotations

import shutil
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from .. import folders, toml
from ..arrays import FloatArray, TimeArray
from ..errors import ConfigError
from ..fusion.config import ARM_FILE, FusionConfig, Process
from ..logs import save
from ..logs.frames import Cylindrical, Placed, Rotated
from ..logs.run import Reference, Run, Source
from ..model.arm import ordered_axes
from ..units import MM
from . import campaign, sensing
from .grid import POINTS, grid
from .motion import Motion, simulate_axis
from .scenario import Scenario
from .trajectory import PathFromFile

SCENARIO = "scenario.toml"
MANIFEST = "run.toml"
_OURS = frozenset({SCENARIO, MANIFEST, "fusion.toml", ARM_FILE})
_PATHS = ("path.csv", "path.csv.gz", "path.parquet")


@dataclass(frozen=True)
class Simulated:
    """What :func:`simulate` returns.

    Attributes:
        scenario: What was simulated.
        seed: With which seed.
        run: The recorded run; its reference is the truth.
        config: What the filter is to believe.
        trials: The step trials of a campaign.
    """

    scenario: Scenario
    seed: int
    run: Run
    config: FusionConfig
    trials: campaign.Trials | None


def simulate(scenario: Scenario, seed: int | None = None) -> Simulated:
    """Let the true arm of a scenario follow its trajectory under the eyes of its sensors.

    The same scenario and seed give the same numbers. Every axis and sensor draws from a stream of its own: another
    sensor changes no other measurement.

    Args:
        scenario: What happens.
        seed: Instead of the scenario's own.

    Raises:
        PumafuseError: The trajectory's file cannot be read, or it is too long.
    """
    seed = scenario.seed if seed is None else seed
    tick, told = _commands(scenario, seed)
    period = scenario.arm.update_period
    instants = grid(len(tick), period)
    axes, log = tuple(told), _Log(scenario, tuple(told))
    moved = _motions(scenario, seed, tick, told)

    sensors: dict[str, Source] = {}
    for name, sensor in scenario.sensors.items():
        seen = axes if sensor.axes is None else ordered_axes(set(sensor.axes) & set(axes))
        if seen:
            valid = sensing.valid_times(sensor, instants, _stream(seed, "rate", name))
            true = log.positions({axis: moved[axis].at(valid) for axis in seen}, in_axes=sensor.axes is not None)
            sensors[name] = _rounded(sensing.measure(sensor, name, valid, true, _stream(seed, "sensor", name)))
    parts = scenario.reference.rows_per_command
    rows = instants[np.rint(np.arange(len(tick) * parts) * (POINTS / parts)).astype(np.int64)]
    noise = _stream(seed, "reference")
    reference = {
        axis: true + scenario.reference.sd * noise.standard_normal(len(rows))
        for axis, true in log.positions({axis: motion.at(rows) for axis, motion in moved.items()}).items()
    }
    truth = _rounded(Source(rows, reference, "reference"))
    jitter = scenario.command.stamp_jitter * _stream(seed, "stamps").standard_normal(len(tick))
    stamp = np.maximum.accumulate(tick + np.rint(jitter * 1e9).astype(np.int64))
    start = {axis: value[0] for axis, value in log.positions({axis: np.zeros(1) for axis in axes}).items()}
    run = Run(
        name=f"{scenario.name}, seed {seed}",
        command=_rounded(Source(stamp, log.positions(told), "command")),
        sensors=sensors,
        reference=Reference(truth.stamp, truth.values, truth.label, sd=scenario.reference.sd),
        start={axis: float(_nanometres(level)) for axis, level in start.items()},
        clock=scenario.command.clock,
        frame=scenario.frame,
    )
    return Simulated(scenario, seed, run, scenario.config, campaign.cut(scenario, tick, told, sensors))


def check_writable(folder: Path, force: bool) -> None:
    """Refuse early what :func:`write` would refuse late.

    Raises:
        FolderError: The folder exists and is not to be replaced, or holds something else than a simulated run.
    """
    folders.check_writable(folder, force, _OURS, lambda name: name in _files_of(folder))


def write(simulated: Simulated, folder: Path, force: bool) -> None:
    """Write a simulated run as a recorded run, with ``fusion.toml`` and ``arm.toml`` for a filter, and its step trials.

    ``scenario.toml`` in the folder makes the same run again; a path from a file is beside it.

    Raises:
        FolderError: See :func:`check_writable`, or the disk refuses.
    """
    check_writable(folder, force)
    with folders.replacing(folder) as new:
        save.save(simulated.run, new)
        simulated.config.save(new)
        scenario = _with_path(simulated.scenario, new)
        (new / SCENARIO).write_text(scenario.to_toml(simulated.seed, ARM_FILE), encoding="utf-8")
        if simulated.trials is not None:
            campaign.write(simulated.trials, new)


def _with_path(scenario: Scenario, folder: Path) -> Scenario:
    """The scenario with its path's table, if it has one, copied into ``folder``."""
    trajectory = scenario.trajectory
    if not isinstance(trajectory, PathFromFile):
        return scenario
    endings = (name for name in _PATHS if trajectory.file.endswith(name.removeprefix("path")))
    name = next(endings, _PATHS[0])
    shutil.copyfile(trajectory.file, folder / name)
    return msgspec.structs.replace(scenario, trajectory=msgspec.structs.replace(trajectory, file=name))


def _files_of(folder: Path) -> set[str]:
    """What a simulated run in ``folder`` can consist of, by its own run.toml."""
    try:
        manifest = toml.read(folder / MANIFEST)
    except ConfigError:
        return set(_OURS)
    sensors = manifest.get("sensors")
    sources = [manifest.get("command"), manifest.get("reference"), *(sensors.values() if sensors else ())]
    return {*_OURS, campaign.TRIALS, campaign.SAMPLES, *_PATHS, *(str(source["file"]) for source in sources if source)}


class _Log:
    """In which coordinates the log is: the axes, or x, y, z."""

    def __init__(self, scenario: Scenario, axes: tuple[str, ...]) -> None:
        self._level = {axis: scenario.start.level.get(axis, 0.0) for axis in axes}
        self._placed: Placed | None = None
        if isinstance(scenario.frame, Cylindrical):
            azimuth = float(np.deg2rad(scenario.start_azimuth))
            self._placed = Placed(scenario.frame, self._level["radial"], azimuth)
        elif isinstance(scenario.frame, Rotated):
            self._placed = Placed(scenario.frame, 1.0, float(np.deg2rad(scenario.frame.azimuth)))

    def positions(self, moved: Mapping[str, FloatArray], *, in_axes: bool = False) -> dict[str, FloatArray]:
        """What is ``moved`` [m] from the start level as the log has it; ``in_axes``: as a source that names axes."""
        along = {axis: value + self._level[axis] for axis, value in moved.items()}
        if self._placed is None or in_axes:
            return along
        x, y = self._placed.to_log(along["tangential"], along["radial"])
        return {"x": x, "y": y} | ({"z": along["vertical"]} if "vertical" in along else {})


def _stream(seed: int, *purpose: str) -> np.random.Generator:
    """Random numbers for one purpose, the same whatever else is drawn."""
    return np.random.default_rng([seed, *(zlib.crc32(word.encode()) for word in purpose)])


def _commands(scenario: Scenario, seed: int) -> tuple[TimeArray, dict[str, FloatArray]]:
    """The ticks [int64 ns] and, for each commanded axis in order, u relative to its start level [m]."""
    period = scenario.arm.update_period
    offsets = scenario.trajectory.offsets(period, _stream(seed, "trajectory"))
    count = len(next(iter(offsets.values())))
    named = set(offsets) if scenario.frame is None else set(scenario.arm.axes)  # x and y need both their axes
    told = {axis: offsets.get(axis, np.zeros(count)) for axis in ordered_axes(named)}
    if isinstance(scenario.frame, Cylindrical) and (told["radial"] + scenario.start.level["radial"] <= 0.0).any():
        raise ConfigError("trajectory: the commands cross the base's axis, beyond which radial has no meaning")
    return np.rint(np.arange(count) * (period * 1e9)).astype(np.int64), told


def _motions(scenario: Scenario, seed: int, tick: TimeArray, told: Mapping[str, FloatArray]) -> dict[str, Motion]:
    true_axes = scenario.true_axes
    return {
        axis: simulate_axis(
            true_axes[axis],
            scenario.process.get(axis, Process()),
            scenario.start.offset_sd,
            tick,
            command,
            scenario.arm.update_period,
            _stream(seed, "axis", axis),
        )
        for axis, command in told.items()
    }


def _nanometres(value: FloatArray) -> FloatArray:
    """Lengths [m] rounded as files have them, so that a run is the same in memory and read back."""
    return np.round(value * MM, 6) / MM


def _rounded(source: Source) -> Source:
    return replace(source, values={axis: _nanometres(value) for axis, value in source.values.items()})
