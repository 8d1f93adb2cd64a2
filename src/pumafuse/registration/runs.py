"""Registration of the sensors of recorded runs: :func:`register`."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np

from .. import toml
from ..arrays import FloatArray
from ..discovery.contents import period_of
from ..discovery.guesses import guess
from ..discovery.own_frames import own_frames
from ..discovery.roles import relations
from ..discovery.survey import Survey
from ..errors import ConfigError, PumafuseWarning, RunError, UnknownNameError
from ..fusion.config import SD_BOUNDS, FusionConfig, Placement, Sensor, Start, Tool
from ..fusion.placing import Placing, in_base, with_tool
from ..logs.axes import reference_orientation
from ..logs.clock import without_strays
from ..logs.frames import CARTESIAN
from ..logs.run import Run, Source
from ..logs.screening import lost
from ..model.arm import ArmModel, AxisModel, Joint
from ..model.plants import FirstOrder
from ..space.rotations import TURNING
from ..toml import Interval
from ..tuning.latency import first_guess
from ..units import Kind, seconds
from .beside import later
from .findings import AS_READ, Finding, Vector
from .joints import Later, Told, joint_lags
from .motion import Answer, Motion, Plant
from .register import Quantity, Registered, Registration, Response, is_here, registered

FIXED = ("marker", "latency")  # what can be left as it is
_AS_CONFIGURED, _ALONG_BASE = "stays as configured", "is taken to measure along the base's axes"
_LEFT_OUT = "is left out, as it seems to stand in a frame of its own"
_DIGITS = 6  # of m and rad in a configuration: a micrometre
_SHORTEST = 1e-3  # s, of a plant
_FARTHEST = 1e6  # m: what is farther is a sentinel, no position
_SUREST = 1e-5  # s, of half the interval of a lag: no stamps are finer
_NO_EVIDENCE = 3.0  # times what the arm may be off: commands and sensors share it, and do not bear each other out


class RegisteredSensor(msgspec.Struct, frozen=True, kw_only=True):
    """What was found of one sensor.

    Attributes:
        frame: Where it stands; None where a finding prevents it. Of a sensor along the base's axes none is configured.
        marker: What it sees on the tool, likewise.
        lag: From a command to what the sensor tells of it, at constant velocity: the arm's lag and the sensor's latency
            together [s].
        lag_ci95: Its 95 % interval.
        latency: The sensor's own [s]: where the arm's lag is known, else beyond that of the earliest sensor.
        latency_ci95: Its interval.
        rms: What the registration leaves of positions, root mean square [m].
        angular_rms: Likewise of orientations [rad]; None where none is compared.
        rows: How many measurements were looked at.
        findings: What is wrong with it, or not told by the motion, by name.
        notes: The same in sentences.
    """

    frame: Registered | None = None
    marker: Registered | None = None
    lag: float | None = msgspec.field(name="lag_ms", default=None)
    lag_ci95: Interval | None = msgspec.field(name="lag_ms_ci95", default=None)
    latency: float | None = msgspec.field(name="latency_ms", default=None)
    latency_ci95: Interval | None = msgspec.field(name="latency_ms_ci95", default=None)
    rms: float | None = msgspec.field(name="rms_mm", default=None)
    angular_rms: float | None = msgspec.field(name="rms_deg", default=None)
    rows: int = 0
    findings: list[str] = []
    notes: list[str] = []


class RegistrationSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What ``register --json`` prints.

    Attributes:
        pumafuse: Version that made it.
        runs: Names of the runs.
        sensors: By sensor.
        joints: How much later joints answer than the first, where commands are in joints that do not answer alike.
    """

    pumafuse: str
    runs: list[str]
    sensors: dict[str, RegisteredSensor]
    joints: dict[str, Joint] = {}


@dataclass(frozen=True, repr=False)
class Registrations:
    """The result of :func:`register`.

    Attributes:
        config: The configuration with frame, marker and latency of each sensor that was registered.
        details: What it is in numbers [SI].
    """

    config: FusionConfig
    details: RegistrationSummary

    def __repr__(self) -> str:
        return f"Registrations({', '.join(self.details.runs)}: {', '.join(self.details.sensors)})"

    def to_json(self) -> str:
        """All of it as JSON, in the units of the names."""
        tree = toml.reported(self.details)
        return msgspec.json.format(msgspec.json.Encoder(decimal_format="number").encode(tree), indent=2).decode() + "\n"


def register(
    runs: Sequence[Run] | Run,
    config: FusionConfig | None = None,
    *,
    sensor: str | None = None,
    fix: Iterable[str] = (),
    along_base: Collection[str] = (),
) -> Registrations:
    """Find where sensors stand, what they see on the tool, and how late they are, from any motion.

    Args:
        runs: Recorded runs of one set-up.
        config: Arm and sensors, whose markers are where the search begins; the arm's lag is believed. None: the arm is
            found, too, and the earliest sensor is taken to have no latency.
        sensor: The one to register; None: each that gives x, y and z. One that does not is named.
        fix: ``marker``: it stays as configured. ``latency``: likewise, and the arm's delay is what they leave.
        along_base: Sensors that measure along the base's axes, and are only compared.

    Returns:
        The configuration with frames, markers and latencies, and their 95 % intervals.

    Warns:
        PumafuseWarning: For what is wrong with a sensor or not told by the motion.

    Raises:
        PumafuseError: No sensor can be registered; says why.
    """
    every = [without_strays(run) for run in ([runs] if isinstance(runs, Run) else runs)]
    fixed = list(fix)
    if unknown := next((one for one in fixed if one not in FIXED), None):
        raise UnknownNameError("--fix", "number", unknown, FIXED)
    if fixed and config is None:
        raise ConfigError(f"--fix {fixed[0]}: as configured where? Give a configuration (-c)")
    names = _sensors(every, config, sensor)
    left = [] if sensor else [name for name in _known(every, config) if name not in {*names, *along_base}]
    aside = {name for run in every for name in own_frames(run)} & set(left) if left and config is None else set[str]()
    instead = _AS_CONFIGURED if config else _ALONG_BASE
    notes = [_not_registered(every, name, _LEFT_OUT if name in aside else instead) for name in left]
    every = [_without(run, aside | (_incomplete(run) & set(names))) for run in every]
    if config is not None and any(run.command.joints is None for run in every):
        notes += config.arm.unheeded()
    joints = _joints([_complete(run) for run in every], names) if config is None else config.arm.joints
    config = config and _with_joints(config, {})  # they are heeded in the commands from here on
    later = {name: joint.later for name, joint in joints.items()}
    every = [replace(run, command=run.command.delayed(later)) for run in every]
    whole = [_complete(run) for run in every]
    found = {name: _registered(whole, name, config, fixed="marker" in fixed) for name in names}
    placed = {name: one for name, one in found.items() if one.frame is not None}
    placed |= {name: _without_frame(one) for name, one in placed.items() if _is_along_base(one)}
    placed |= {name: _without_place(placed[name]) for name in along_base if name in placed}
    said = {name: [one.sentence(f"sensor '{name}'") for one in mine.findings] for name, mine in found.items()}
    if not placed:
        raise RunError("; ".join(note for mine in said.values() for note in mine))
    begun = _arm(every, placed) if config is None else with_tool(config, every[0])
    if "latency" in fixed:
        begun = _as_late(begun, placed)
        latencies = {name: _exactly(begun.sensors[name].latency) for name in placed if not _as_read(placed[name])}
    else:
        latencies = _latencies(whole, placed, begun, None if config is None else _lag(config.arm))
    details = {name: _details(one, latencies.get(name), said[name]) for name, one in found.items()}
    if config is None:
        kept = placed.keys() if sensor else None
        config = _configuration([_as_registered(run, placed, kept) for run in every], placed, latencies, begun)
    else:
        config = _placed(begun, placed, latencies)
    for note in (*(note for mine in said.values() for note in mine), *notes):
        warnings.warn(note, PumafuseWarning, stacklevel=2)
    named = [run.name for run in every]
    summary = RegistrationSummary(pumafuse=version("pumafuse"), runs=named, sensors=details, joints=joints)
    return Registrations(_with_joints(config, joints), summary)


def _as_registered(run: Run, found: Mapping[str, Registration], kept: Collection[str] | None) -> Run:
    """The run without orientations that do not follow the commanded ones, and with some sensors alone, if any are."""
    sensors = dict(run.sensors)
    for name, one in found.items():
        if name in sensors and one.rms_rotation is None and run.command.orientation is not None:
            sensors[name] = replace(sensors[name], orientation=None)
    return replace(run, sensors={name: one for name, one in sensors.items() if kept is None or name in kept})


def _with_joints(config: FusionConfig, joints: dict[str, Joint]) -> FusionConfig:
    return msgspec.structs.replace(config, arm=msgspec.structs.replace(config.arm, joints=joints))


def _joints(runs: Sequence[Run], names: Sequence[str]) -> dict[str, Joint]:
    """How much later joints answer than the first, by the sensor with the surest lag; nothing where they answer alike.

    A joint of which the motion does not tell has no interval.
    """
    joints = {None if run.command.joints is None else run.command.joints.chain.joints for run in runs}
    order = joints.pop()
    if order is None or joints:
        return {}
    best, late = np.inf, dict[str, Quantity]()
    for name in names:
        told, sensor = _apart(runs, name)
        register = partial(registered, sensor=sensor, loosely=True)
        begun = register(told({}))
        if begun.position is None or _as_read(begun) or begun.position.lag.half >= best:
            continue
        best, late = begun.position.lag.half, joint_lags(told, order, sensor, register)
    return {
        name: Joint(later=round(one.value, _DIGITS), later_ci95=one.ci95 if np.isfinite(one.half) else None)
        for name, one in late.items()
    }


def _apart(runs: Sequence[Run], name: str) -> tuple[Told, list[Motion]]:
    """The commands of the runs that have a sensor, with joints told later, and what the sensor told."""
    mine = [run for run in runs if name in run.sensors]

    def told(later: Later) -> list[Motion]:
        return [_motion(run.command.delayed(later)) for run in mine]

    return told, [_measured(run.sensors[name]) for run in mine]


def _sensors(runs: Sequence[Run], config: FusionConfig | None, sensor: str | None) -> list[str]:
    """The sensors to register.

    Raises:
        RunError: There is none, or no commands in x, y and z.
        UnknownNameError: The one that is asked for is in no run, or not configured.
        ConfigError: The arm has no axes x, y, z.
    """
    for run in runs:
        if not set(CARTESIAN) <= run.command.values.keys():
            raise RunError(f"{run.command.label}: a sensor is registered beside commands in x, y and z; there are only"
                           f" {', '.join(run.command.values) or 'orientations'}")  # fmt: skip
    if config is not None and not set(CARTESIAN) <= config.arm.axes.keys():
        raise ConfigError(f"arm '{config.arm.name}': sensors are registered along axes x, y and z, which it has not")
    known = _known(runs, config)
    if sensor is not None and sensor not in known:
        raise UnknownNameError("--sensor", "sensor", sensor, known)
    names = [name for name in ([sensor] if sensor else known) if any(name in _complete(run).sensors for run in runs)]
    if not names:
        lacking = "; ".join(_lacking(runs, name) for name in ([sensor] if sensor else known))
        raise RunError(f"no sensor gives x, y and z, by which it could be registered: {lacking or 'there is none'}")
    return names


def _known(runs: Sequence[Run], config: FusionConfig | None) -> list[str]:
    """The sensors of all runs; of a configuration only those in it."""
    every = dict.fromkeys(name for run in runs for name in run.sensors)
    return [name for name in every if config is None or name in config.sensors]


def _complete(run: Run) -> Run:
    """A run with the sensors that give x, y and z."""
    return _without(run, _incomplete(run))


def _incomplete(run: Run) -> set[str]:
    """The sensors of a run that do not give x, y and z."""
    return {name for name, one in run.sensors.items() if not set(CARTESIAN) <= one.values.keys()}


def _without(run: Run, names: Collection[str]) -> Run:
    return replace(run, sensors={name: one for name, one in run.sensors.items() if name not in names})


def _lacking(runs: Sequence[Run], name: str) -> str:
    """What a sensor lacks to be registered."""
    given = {axis for run in runs if name in run.sensors for axis in run.sensors[name].values}
    missing = [axis for axis in CARTESIAN if axis not in given]
    return f"sensor '{name}' gives no {' and no '.join(missing)}"


def _not_registered(runs: Sequence[Run], name: str, instead: str) -> str:
    """What to say of a sensor that does not give x, y and z."""
    return f"{_lacking(runs, name)}, without which it is not registered, and {instead}: add what is missing (run.toml)"


def _registered(runs: Sequence[Run], name: str, config: FusionConfig | None, *, fixed: bool) -> Registration:
    """The registration of one sensor by the runs that have it."""
    pairs = [(_motion(run.command), _measured(run.sensors[name])) for run in runs if name in run.sensors]
    marker = None if config is None or name not in config.sensors else config.sensors[name].marker
    command, sensor = [told for told, _ in pairs], [seen for _, seen in pairs]
    return registered(command, sensor, marker=marker, fix_marker=fixed)


def _motion(source: Source) -> Motion:
    position = np.column_stack([source.values[axis] for axis in CARTESIAN])
    return Motion(seconds(source.stamp), position, source.orientation)


def _latencies(
    runs: Sequence[Run], found: Mapping[str, Registration], config: FusionConfig, lag: float | None
) -> dict[str, Quantity]:
    """The latency of each sensor [s]: that of the surest lag beyond the arm's, those of others beside it.

    Where the arm's lag is not known, the earliest sensor has none. Sensors are compared with one that tells
    orientations, if there is one: it tells where the points are that others see.
    """
    lags = {name: one.position.lag for name, one in found.items() if one.position is not None and not _as_read(one)}
    if not lags:
        return {}
    best = min(lags, key=lambda name: (found[name].rms_rotation is None, lags[name].half))
    beside, placed = {best: _exactly(0.0)}, _placed(config, found, {})
    for name in lags.keys() - {best}:
        both = [run for run in runs if {name, best} <= run.sensors.keys()]
        points = [_of_point(run, best, found[best], placed, name) for run in both]
        told = later(points, [_in_base(run, name, placed) for run in both], lags[name].value - lags[best].value)
        beside[name] = told or _sum(lags[name], -lags[best].value)
    if lag is None:
        first, known = min(beside, key=lambda name: beside[name].value), _exactly(0.0)
    else:
        first = min(lags, key=lambda name: lags[name].half)
        known = _sum(lags[first], -lag)
    return {
        name: known if name == first else _sum(one, known.value - beside[first].value, beside[first], known)
        for name, one in beside.items()
    }


def _as_read(one: Registration) -> bool:
    """Whether a sensor's rows had to be read otherwise than run.toml says, which is to be mended first."""
    return any(found.finding in AS_READ for found in one.findings)


def _in_base(run: Run, name: str, config: FusionConfig) -> Motion:
    """What a placed sensor sees, where it is in the base's frame."""
    seen = _measured(run.sensors[name]).valid()
    return seen._replace(position=Placing(config.sensors[name]).seen(seen.position))


def _of_point(run: Run, name: str, found: Registration, config: FusionConfig, point: str) -> Motion:
    """What a placed sensor tells of the point that another one sees, and how the tool is turned, if that is told."""
    seen, placing = _in_base(run, name, config), Placing(config.sensors[name])
    if seen.quaternion is not None and found.rms_rotation is not None:
        turned = placing.oriented(seen.quaternion)
    else:
        turned = _commanded(run, seen.time, found)
    if turned is None:
        return seen._replace(quaternion=None)
    lever = Placing(config.sensors[point]).lever(turned) - placing.lever(turned)
    return Motion(seen.time, seen.position + lever, turned)


def _commanded(run: Run, time: FloatArray, found: Registration) -> FloatArray | None:
    """How the commands have turned the tool when a sensor measures, as quaternions; None where they do not tell."""
    command, response = _motion(run.command).valid(), found.rotation or found.position
    if command.quaternion is None or response is None:
        return None
    plant = Plant(response.delay.value, response.time_constant.value)
    return Answer([command], [time]).quaternions(plant)


def _lag(arm: ArmModel) -> float:
    """The lag of positions in space [s]."""
    return float(np.mean([arm.lag_of(axis) for axis in CARTESIAN]))


def _as_late(config: FusionConfig, found: Mapping[str, Registration]) -> FusionConfig:
    """The configuration whose arm is as late as sensors of known latencies saw it: by its delays.

    Each counts as its lag is sure.
    """
    lags = {name: one.position.lag for name, one in found.items() if one.position}
    of_arm = [lag.value - config.sensors[name].latency for name, lag in lags.items()]
    weight = [max(lag.half, _SUREST) ** -2 for lag in lags.values()]
    later = float(np.average(of_arm, weights=weight)) - _lag(config.arm)

    def moved(delay: float) -> float:
        return round(max(delay + later, 0.0), _DIGITS)

    arm = msgspec.structs.replace(
        config.arm,
        delay=moved(config.arm.delay),
        axes={
            name: axis if axis.delay is None else msgspec.structs.replace(axis, delay=moved(axis.delay))
            for name, axis in config.arm.axes.items()
        },
    )
    return msgspec.structs.replace(config, arm=arm)


def _exactly(value: float) -> Quantity:
    return Quantity(value, (value, value))


def _sum(one: Quantity, by: float, *unsure: Quantity) -> Quantity:
    """A number moved by another one, which is as unsure as some others are together."""
    value, half = one.value + by, sum(each.half for each in (one, *unsure))
    return Quantity(value, (value - half, value + half))


def _without_place(one: Registration) -> Registration:
    """The same of a sensor that stands where the robot does."""
    return msgspec.structs.replace(one, frame=None, marker=None)


def _is_along_base(one: Registration) -> bool:
    """Whether a sensor measures along the base's axes, as far as the motion tells."""
    return any(found.finding is Finding.ALONG_BASE for found in one.findings)


def _without_frame(one: Registration) -> Registration:
    """The same of a sensor that needs no frame, nor a marker where that is the tool point."""
    seen = one.marker if one.marker and not is_here(one.marker.at, one.marker.rotation) else None
    return msgspec.structs.replace(one, frame=None, marker=seen)


def _measured(source: Source) -> Motion:
    """What a sensor tells, without what is no news: values that it repeats, and zeros, as it writes them when lost."""
    motion = _motion(source)
    far = ~(np.abs(motion.position) < _FARTHEST).all(axis=1)
    again = (np.diff(motion.position, axis=0, prepend=np.nan) == 0.0).all(axis=1)
    return motion._replace(position=np.where((far | again | lost(motion.position))[:, None], np.nan, motion.position))


def _details(one: Registration, latency: Quantity | None, notes: list[str]) -> RegisteredSensor:
    """What was found of one sensor."""
    names = [found.finding.value for found in one.findings]
    if one.position is None:
        return RegisteredSensor(findings=names, notes=notes)
    return RegisteredSensor(
        frame=one.frame,
        marker=one.marker,
        lag=one.position.lag.value,
        lag_ci95=one.position.lag.ci95,
        latency=None if latency is None else latency.value,
        latency_ci95=None if latency is None else latency.ci95,
        rms=one.rms,
        angular_rms=one.rms_rotation,
        rows=one.rows,
        findings=names,
        notes=notes,
    )


def _placement(found: Registered | None) -> Placement | None:
    """A place as a configuration has it; None for one that is where the robot's is."""
    if found is None:
        return None
    at, rotation = (_rounded(one) for one in (found.at, found.rotation))
    return Placement(at=at, rotation=rotation) if any(at) or any(rotation) else None


def _rounded(vector: Vector) -> Vector:
    x, y, z = (round(one, _DIGITS) for one in vector)
    return x, y, z


def _placed(config: FusionConfig, found: Mapping[str, Registration], latencies: Mapping[str, Quantity]) -> FusionConfig:
    """The configuration with frame, marker, latency and bias of sensors."""
    constants, count = _constants(config.arm, found), sum(one.frame is not None for one in found.values())
    sensors = {
        name: msgspec.structs.replace(
            config.sensors[name],
            frame=_placement(one.frame),
            marker=_placement(one.marker),
            latency=round(latencies[name].value, _DIGITS) if name in latencies else config.sensors[name].latency,
            bias_sd=_biases(config.sensors[name], constants, count) if one.frame else config.sensors[name].bias_sd,
        )
        for name, one in found.items()
    }
    return msgspec.structs.replace(config, sensors={**config.sensors, **sensors})


def _constants(arm: ArmModel, found: Mapping[str, Registration]) -> dict[str, float]:
    """How far off the arm itself may be by a constant [m or rad], of each axis.

    A registration follows the commanded poses, and so has a constant error of the arm's kinematics in it, which no
    motion shows. It is taken to be as large as what changes with the pose, which is what registrations leave.
    """
    placed = [one for one in found.values() if one.frame is not None]
    left: dict[Kind, float] = {
        "length": max((_beyond_noise(one) for one in placed), default=0.0),
        "angle": max((one.rms_rotation or 0.0 for one in placed), default=0.0),
    }
    return {axis: left[arm.axes[axis].kind] for axis in (*CARTESIAN, *TURNING) if axis in arm.axes}


def _beyond_noise(one: Registration) -> float:
    """What a registration leaves of positions beyond the white noise of their three coordinates [m]."""
    return float(np.sqrt(max((one.rms or 0.0) ** 2 - 3.0 * one.noise**2, 0.0)))


def _biases(sensor: Sensor, constants: Mapping[str, float], count: int) -> dict[str, float]:
    """How far off one of several sensors may be in the base [m or rad], where no bias is configured.

    They share what the arm is off, while the filter takes their biases to be independent: so each has √n times as much.
    """
    return {axis: sensor.bias_sd_of(axis) or float(f"{one * count**0.5:.2g}") for axis, one in constants.items()}


def _arm(runs: Sequence[Run], found: Mapping[str, Registration]) -> FusionConfig:
    """The arm as the earliest sensor saw it answer."""
    positions = [one.position for one in found.values() if one.position is not None]
    response, tool = min(positions, key=lambda one: one.lag.value), reference_orientation(runs[0])
    axes = {axis: AxisModel(plant=_plant(response)) for axis in CARTESIAN}
    if tool is not None:
        axes |= {axis: _turning(found.values(), response) for axis in TURNING}
    period = period_of(runs[0].command)
    arm = ArmModel(
        name="registered",
        update_period=float(f"{period:.4g}"),
        delay=max(round(response.delay.value, _DIGITS), 0.0),
        axes=axes,
    )
    sensors = {name: Sensor(sd=max(one.rms or 0.0, SD_BOUNDS[0])) for name, one in found.items()}
    return FusionConfig(arm=arm, sensors=sensors, tool=None if tool is None else Tool(reference=tool))


def _configuration(
    runs: Sequence[Run], found: Mapping[str, Registration], latencies: Mapping[str, Quantity], begun: FusionConfig
) -> FusionConfig:
    """A configuration to begin with: the arm that was found, and noise as it looks along the base's axes."""
    config = _as_late(_placed(begun, found, latencies), found)
    placed = [in_base(run, config)[0] for run in runs]
    guessed = first_guess([guess(Survey(Path(run.name), run, relations(run))) for run in placed])
    sensors = {
        name: msgspec.structs.replace(
            guessed.sensors[name],
            latency=one.latency,
            frame=one.frame,
            marker=one.marker,
            scale=1.0,
            bias_sd=one.bias_sd,
        )
        for name, one in config.sensors.items()
        if name in guessed.sensors
    }
    sensors = {**guessed.sensors, **sensors}
    constants = _constants(guessed.arm, found)
    offsets = {
        axis: max(guessed.start.offset_sd_of(axis), _NO_EVIDENCE * constants.get(axis, 0.0))
        for axis in guessed.arm.axes
    }
    known = {axis: one for axis, one in config.arm.axes.items() if axis in guessed.arm.axes}
    arm = msgspec.structs.replace(guessed.arm, delay=config.arm.delay, axes={**guessed.arm.axes, **known})
    start = Start(offset_sd=offsets)
    return msgspec.structs.replace(guessed, arm=arm, tool=config.tool, sensors=sensors, start=start)


def _turning(found: Iterable[Registration], earliest: Response) -> AxisModel:
    """How the tool turns: as a sensor saw that tells orientations, less what it is later; else as it moves."""
    for one in found:
        if one.rotation is not None and one.position is not None:
            delay = one.rotation.delay.value - (one.position.lag.value - earliest.lag.value)
            return AxisModel(kind="angle", plant=_plant(one.rotation), delay=max(round(delay, _DIGITS), 0.0))
    return AxisModel(kind="angle", plant=_plant(earliest))


def _plant(response: Response) -> FirstOrder:
    return FirstOrder(time_constant=max(response.time_constant.value, _SHORTEST))
