"""Simulates a scenario: a recorded run with its reference, :func:`simulate`, and its folder, :func:`write`."""

from __future__ import annotations

import shutil
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa

from .. import folders, toml
from ..arrays import FloatArray, TimeArray
from ..errors import ConfigError
from ..fusion.config import ARM_FILE, PROCESS, FusionConfig, of_axis
from ..logs import save, tables
from ..logs.frames import Cylindrical, Placed
from ..logs.run import Run
from ..logs.source import Source
from ..units import MM, SCREEN, of_kind
from .motion import POINTS, Motion, grid, simulate_axis
from .scenario import Scenario
from .trajectory import PathFromFile, Steps
from .true_sensor import measure, valid_times

SCENARIO, MANIFEST = "scenario.toml", "run.toml"
TRIALS, SAMPLES = "trials.csv", "samples.csv"  # of a campaign, as `identify` reads them
_ALWAYS_WRITTEN = frozenset({SCENARIO, MANIFEST, "fusion.toml", ARM_FILE})
_PATHS = ("path.csv", "path.csv.gz", "path.parquet")
_BEFORE = 0.05  # s of rest that a trial's samples begin with


@dataclass(frozen=True, repr=False)
class Simulated:
    """What :func:`simulate` returns.

    Attributes:
        scenario: What was simulated.
        seed: With which seed.
        run: The recorded run; its reference is the true motion.
        config: The filter's configuration.
        trials: The tables of a campaign's step trials, by the names of their files; else none.
    """

    scenario: Scenario
    seed: int
    run: Run
    config: FusionConfig
    trials: Mapping[str, pa.Table]

    def __repr__(self) -> str:
        return f"Simulated(seed {self.seed}: {self.run!r})"


def simulate(scenario: Scenario, seed: int | None = None) -> Simulated:
    """Simulate the true arm of a scenario along its trajectory, and what its sensors log of it.

    The same scenario and seed give the same numbers. Every axis and sensor draws from a stream of its own: another
    sensor changes no other measurement.

    Args:
        scenario: What happens.
        seed: Instead of the scenario's own.

    Raises:
        PumafuseError: The trajectory's file cannot be read, or it is too long.
    """
    seed = scenario.seed if seed is None else seed
    if seed < 0:
        raise ConfigError(f"seed: must be >= 0, not {seed}")
    period = scenario.arm.update_period
    commands = _commands(scenario, seed)
    axes, count = tuple(commands), len(next(iter(commands.values())))
    tick = np.rint(np.arange(count) * (period * 1e9)).astype(np.int64)
    instants = grid(count, period)
    true_axes, motions = scenario.true_axes, dict[str, Motion]()
    scales = {axis: SCREEN[kind].scale for axis, kind in scenario.arm.kind_of.items()}
    for axis, command in commands.items():
        process, draws = scenario.process.get(axis, PROCESS[scenario.arm.axes[axis].kind]), _stream(seed, "axis", axis)
        offset_sd = of_axis(scenario.start.offset_sd, axis)
        level = scenario.start.level.get(axis, 0.0)
        motions[axis] = simulate_axis(true_axes[axis], process, offset_sd, tick, command, period, draws, level)

    sensors: dict[str, Source] = {}
    for name, sensor in scenario.sensors.items():
        measured = axes if sensor.axes is None else tuple(axis for axis in axes if axis in sensor.axes)
        if measured:
            valid = valid_times(sensor, instants, _stream(seed, "rate", name))
            true = _to_log(scenario, {axis: motions[axis].at(valid) for axis in measured}, in_axes=bool(sensor.axes))
            source = measure(sensor, name, valid, true, _stream(seed, "sensor", name))
            sensors[name] = _round(source, scales)
    parts = scenario.reference.rows_per_command
    rows = instants[np.rint(np.arange(count * parts) * (POINTS / parts)).astype(np.int64)]
    noise = _stream(seed, "reference")
    reference = {
        axis: true + of_axis(scenario.reference.sd, axis) * noise.standard_normal(len(rows))
        for axis, true in _to_log(scenario, {axis: motion.at(rows) for axis, motion in motions.items()}).items()
    }
    jitter = scenario.command.stamp_jitter * _stream(seed, "stamps").standard_normal(count)
    stamp = np.maximum.accumulate(tick + np.rint(jitter * 1e9).astype(np.int64))
    start = _to_log(scenario, {axis: np.zeros(1) for axis in axes})
    run = Run(
        name=f"{scenario.name}, seed {seed}",
        command=_round(Source(stamp, _to_log(scenario, commands), "command"), scales),
        sensors=sensors,
        reference=_round(Source(rows, reference, "reference", sd=scenario.reference.sd), scales),
        start={axis: float(_round_as_files(level, scales.get(axis, MM))[0]) for axis, level in start.items()},
        clock=scenario.command.clock,
        frame=scenario.frame,
        kinds={axis: kind for axis, kind in scenario.arm.kind_of.items() if axis in start},
    )
    return Simulated(scenario, seed, run, scenario.config, _step_trials(scenario, tick, commands, sensors))


def _step_trials(
    scenario: Scenario, tick: TimeArray, commands: Mapping[str, FloatArray], sensors: Mapping[str, Source]
) -> dict[str, pa.Table]:
    """The tables ``trials.csv`` and ``samples.csv`` of a step campaign, as `identify` reads them; else none.

    Commands [m or rad] were given at each ``tick``, int64 ns, (n,); the scope is among the sensors.
    """
    campaign = scenario.trajectory
    if not isinstance(campaign, Steps):
        return {}
    scope, period = sensors[campaign.scope], scenario.arm.update_period
    valid = scope.stamp / 1e9 - scenario.sensors[campaign.scope].latency
    pause = campaign.ticks_between(period)
    trials, samples = list[dict[str, object]](), list[pa.Table]()
    for number, at in enumerate(range(pause, len(tick), pause), 1):
        axis = next(axis for axis, command in commands.items() if command[at] != command[at - 1])
        step, screen = float(commands[axis][at] - commands[axis][at - 1]), scenario.arm.screen_of(axis)
        kind = scenario.arm.axes[axis].kind
        since = valid - tick[at] / 1e9
        inside = (since >= -_BEFORE) & (since <= campaign.window)
        trials.append(
            {
                "trial": number,
                "axis": axis,
                of_kind("step_mm", kind): round(step * screen.scale, 6),
                of_kind("speed_m_s", kind): round(abs(step) / period * screen.fast_scale, 6),
                "direction": "up" if step > 0.0 else "down",
            }
        )
        sampled: dict[str, Sequence[int] | FloatArray] = {
            "trial": [number] * int(inside.sum()),
            "time_s": np.round(since[inside], 9),
            of_kind("position_mm", kind): np.round(scope.values[axis][inside] * screen.scale, 6),
        }
        samples.append(pa.table(sampled))
    return {TRIALS: pa.Table.from_pylist(trials), SAMPLES: pa.concat_tables(samples)}


def check_writable(folder: Path, force: bool) -> None:
    """Refuse early what :func:`write` would refuse late."""
    folders.check_writable(folder, force, _ALWAYS_WRITTEN, lambda name: name in _files_of(folder))


def write(simulated: Simulated, folder: Path, force: bool) -> None:
    """Write a simulated run as a recorded run, with ``fusion.toml`` and ``arm.toml`` for a filter, and its step trials.

    ``scenario.toml`` in the folder makes the same run again; a path from a file is copied beside it.
    """
    check_writable(folder, force)
    scenario = simulated.scenario
    with folders.replacing(folder) as new:
        save.save(simulated.run, new)
        simulated.config.save(new)
        if isinstance(trajectory := scenario.trajectory, PathFromFile):
            name = next((name for name in _PATHS if trajectory.file.endswith(name[4:])), _PATHS[0])
            shutil.copyfile(trajectory.file, new / name)
            beside = msgspec.structs.replace(trajectory, file=name)
            scenario = msgspec.structs.replace(scenario, trajectory=beside)
        (new / SCENARIO).write_text(scenario.to_toml(simulated.seed, ARM_FILE), encoding="utf-8")
        for name, table in simulated.trials.items():
            tables.write(table, new / name)


def _files_of(folder: Path) -> set[str]:
    """Names of the files of which a simulated run in ``folder`` can consist, by its own run.toml."""
    try:
        manifest = toml.read(folder / MANIFEST)
    except ConfigError:
        return set(_ALWAYS_WRITTEN)
    sources = [manifest.get("command"), manifest.get("reference"), *manifest.get("sensors", {}).values()]
    files = {str(source["file"]) for source in sources if source}
    return {*_ALWAYS_WRITTEN, TRIALS, SAMPLES, *_PATHS, *files}


def _to_log(scenario: Scenario, moved: Mapping[str, FloatArray], *, in_axes: bool = False) -> dict[str, FloatArray]:
    """Positions ``moved`` [m] from the start level as the log has them: in x, y, z if it has a frame.

    ``in_axes``: in the axes also then, as a sensor that names its axes.
    """
    level = scenario.start.level
    positions = {axis: value + level.get(axis, 0.0) for axis, value in moved.items()}
    frame = scenario.frame
    if frame is None or in_axes:
        return positions
    if isinstance(frame, Cylindrical):
        placed = Placed(frame, level["radial"], scenario.start_azimuth)
    else:
        placed = Placed(frame, 1.0, frame.azimuth)
    return placed.in_log(positions)


def _stream(seed: int, *purpose: str) -> np.random.Generator:
    """Random numbers for one purpose, the same whatever else is drawn."""
    return np.random.default_rng([seed, *(zlib.crc32(word.encode()) for word in purpose)])


def _commands(scenario: Scenario, seed: int) -> dict[str, FloatArray]:
    """For each commanded axis in order, its commands relative to its start level [m], (ticks,)."""
    offsets = scenario.trajectory.offsets(scenario.arm.update_period, _stream(seed, "trajectory"))
    still = np.zeros(len(next(iter(offsets.values()))))
    commanded = set(offsets) if scenario.frame is None else set(scenario.arm.axes)  # x and y need both their axes
    commands = {axis: offsets.get(axis, still) for axis in scenario.arm.axes if axis in commanded}
    if isinstance(scenario.frame, Cylindrical) and (commands["radial"] + scenario.start.level["radial"] <= 0.0).any():
        raise ConfigError("trajectory: the commands cross the base's axis, beyond which radial has no meaning")
    return commands


def _round_as_files(value: FloatArray, scale: float) -> FloatArray:
    """Positions [m or rad] rounded as files have them, so that a run is the same in memory and read back."""
    return np.round(value * scale, 6) / scale


def _round(source: Source, scales: Mapping[str, float]) -> Source:
    values = {axis: _round_as_files(value, scales.get(axis, MM)) for axis, value in source.values.items()}
    return replace(source, values=values)
