"""Registration of the sensors of recorded runs: :func:`register`."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version

import msgspec
import numpy as np

from .. import toml
from ..discovery.own_frames import own_frames
from ..errors import ConfigError, PumafuseWarning, RunError, UnknownNameError
from ..fusion.config import FusionConfig
from ..fusion.placing import add_tool
from ..logs.clock import missing_commands, without_strays
from ..logs.frames import CARTESIAN
from ..logs.run import Run
from ..model.arm import Joint
from ..toml import Interval
from .configured import DIGITS, arm_of, configuration, lag_in_space, set_joints, set_lags, set_placements
from .joints import Delay, Later, joint_lags
from .latencies import latencies_of
from .motion import Motion, drop_repeated, motion_of
from .register import Quantity, Registered, Registration, is_here, register_sensor

FIXED = ("marker", "latency")  # what can be left as it is
_AS_CONFIGURED, _ALONG_BASE = "stays as configured", "is taken to measure along the base's axes"
_LEFT_OUT = "is left out, as it seems to stand in a frame of its own"


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
        return toml.json_text(toml.reported(self.details)) + "\n"


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
    if unknown := next((name for name in fixed if name not in FIXED), None):
        raise UnknownNameError("--fix", "number", unknown, FIXED)
    if fixed and config is None:
        raise ConfigError(f"--fix {fixed[0]}: as configured where? Give a configuration (-c)")
    names = _sensors(every, config, sensor)
    left = [] if sensor else [name for name in _sensors_of(every, config) if name not in {*names, *along_base}]
    framed = {name for run in every for name in own_frames(run)} & set(left) if left and config is None else set[str]()
    instead = _AS_CONFIGURED if config else _ALONG_BASE
    notes = [_missing_note(every, name, _LEFT_OUT if name in framed else instead) for name in left]
    every = [_drop_sensors(run, framed | (_incomplete(run) & set(names))) for run in every]
    if config is not None and any(run.command.joints is None for run in every):
        notes += config.arm.joint_doubts()
    joints = _joints([_complete(run) for run in every], names) if config is None else config.arm.joints
    config = config and set_joints(config, {})  # they are heeded in the commands from here on
    later = {name: joint.later for name, joint in joints.items()}
    for run in every:
        if missing := missing_commands(run.command):
            notes.append(f"run '{run.name}': {missing}: what sensors saw in a gap is not used")
    every = [replace(run, command=run.command.delayed(later)) for run in every]
    whole = [_complete(run) for run in every]
    registrations = {name: _register_sensor(whole, name, config, fixed="marker" in fixed) for name in names}
    placed = {name: registration for name, registration in registrations.items() if registration.frame is not None}
    placed |= {name: _drop_frame(registration) for name, registration in placed.items() if registration.along_base}
    for name in placed.keys() & along_base:
        placed[name] = msgspec.structs.replace(placed[name], frame=None, marker=None)
    said = {
        name: [finding.sentence(f"sensor '{name}'") for finding in registration.findings]
        for name, registration in registrations.items()
    }
    if not placed:
        raise RunError("; ".join(note for notes_of in said.values() for note in notes_of))
    begun = arm_of(every, placed) if config is None else add_tool(config, every[0])
    if "latency" in fixed:
        begun = set_lags(begun, placed)
        kept = [name for name, registration in placed.items() if not registration.read_otherwise]
        latencies = {name: Quantity.around(begun.sensors[name].latency) for name in kept}
    else:
        latencies = latencies_of(whole, placed, begun, None if config is None else lag_in_space(config.arm))
    details = {
        name: _details(registration, latencies.get(name), said[name]) for name, registration in registrations.items()
    }
    if config is None:
        alone = placed.keys() if sensor else None
        config = configuration([_prepare(run, placed, alone) for run in every], placed, latencies, begun)
    else:
        config = set_placements(begun, placed, latencies)
    for note in (*(note for notes_of in said.values() for note in notes_of), *notes):
        warnings.warn(note, PumafuseWarning, stacklevel=2)
    named = [run.name for run in every]
    summary = RegistrationSummary(pumafuse=version("pumafuse"), runs=named, sensors=details, joints=joints)
    return Registrations(set_joints(config, joints), summary)


def _complete(run: Run) -> Run:
    """A run with the sensors that give x, y and z."""
    return _drop_sensors(run, _incomplete(run))


def _incomplete(run: Run) -> set[str]:
    """The sensors of a run that do not give x, y and z."""
    return {name for name, sensor in run.sensors.items() if not set(CARTESIAN) <= sensor.values.keys()}


def _drop_sensors(run: Run, names: Collection[str]) -> Run:
    """A run without some sensors."""
    return replace(run, sensors={name: sensor for name, sensor in run.sensors.items() if name not in names})


def _prepare(run: Run, registrations: Mapping[str, Registration], kept: Collection[str] | None) -> Run:
    """The run without orientations that do not follow the commanded ones, and with some sensors alone, if any are."""
    sensors = dict(run.sensors)
    for name, registration in registrations.items():
        if name in sensors and registration.rms_rotation is None and run.command.orientation is not None:
            sensors[name] = replace(sensors[name], orientation=None)
    return replace(run, sensors={name: sensor for name, sensor in sensors.items() if kept is None or name in kept})


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
        delay, sensor = _apart(runs, name)
        register = partial(register_sensor, sensor=sensor, loosely=True)
        begun = register(delay({}))
        if begun.position is None or begun.read_otherwise or begun.position.lag.half >= best:
            continue
        best, late = begun.position.lag.half, joint_lags(delay, order, sensor, register)
    return {
        name: Joint(later=round(lag.value, DIGITS), later_ci95=lag.ci95 if np.isfinite(lag.half) else None)
        for name, lag in late.items()
    }


def _apart(runs: Sequence[Run], name: str) -> tuple[Delay, list[Motion]]:
    """The commands of the runs that have a sensor, with joints delayed, and what the sensor saw."""
    runs_of_sensor = [run for run in runs if name in run.sensors]

    def delay(later: Later) -> list[Motion]:
        return [motion_of(run.command.delayed(later)) for run in runs_of_sensor]

    return delay, [drop_repeated(run.sensors[name]) for run in runs_of_sensor]


def _sensors(runs: Sequence[Run], config: FusionConfig | None, sensor: str | None) -> list[str]:
    """The sensors to register; an error where there is none, or commands or the arm have no x, y and z."""
    for run in runs:
        if not set(CARTESIAN) <= run.command.values.keys():
            raise RunError(f"{run.command.label}: a sensor is registered beside commands in x, y and z; there are only"
                           f" {', '.join(run.command.values) or 'orientations'}")  # fmt: skip
    if config is not None and not set(CARTESIAN) <= config.arm.axes.keys():
        raise ConfigError(f"arm '{config.arm.name}': sensors are registered along axes x, y and z, which it has not")
    configured = _sensors_of(runs, config)
    if sensor is not None and sensor not in configured:
        raise UnknownNameError("--sensor", "sensor", sensor, configured)
    names = [
        name for name in ([sensor] if sensor else configured) if any(name in _complete(run).sensors for run in runs)
    ]
    if not names:
        lacking = "; ".join(_lacking(runs, name) for name in ([sensor] if sensor else configured))
        raise RunError(f"no sensor gives x, y and z, by which it could be registered: {lacking or 'there is none'}")
    return names


def _sensors_of(runs: Sequence[Run], config: FusionConfig | None) -> list[str]:
    """The sensors of all runs; of a configuration only those in it."""
    every = dict.fromkeys(name for run in runs for name in run.sensors)
    return [name for name in every if config is None or name in config.sensors]


def _lacking(runs: Sequence[Run], name: str) -> str:
    """What a sensor lacks to be registered."""
    axes_measured = {axis for run in runs if name in run.sensors for axis in run.sensors[name].values}
    missing = [axis for axis in CARTESIAN if axis not in axes_measured]
    return f"sensor '{name}' gives no {' and no '.join(missing)}"


def _missing_note(runs: Sequence[Run], name: str, instead: str) -> str:
    """What to say of a sensor that does not give x, y and z."""
    return f"{_lacking(runs, name)}, without which it is not registered, and {instead}: add what is missing (run.toml)"


def _register_sensor(runs: Sequence[Run], name: str, config: FusionConfig | None, *, fixed: bool) -> Registration:
    """The registration of one sensor by the runs that have it."""
    delay, sensor = _apart(runs, name)
    marker = None if config is None or name not in config.sensors else config.sensors[name].marker
    return register_sensor(delay({}), sensor, marker=marker, fix_marker=fixed)


def _drop_frame(registration: Registration) -> Registration:
    """The registration without its frame, and without its marker where that is the tool point."""
    marker = registration.marker
    seen = marker if marker and not is_here(marker.at, marker.rotation) else None
    return msgspec.structs.replace(registration, frame=None, marker=seen)


def _details(registration: Registration, latency: Quantity | None, notes: list[str]) -> RegisteredSensor:
    """What was found of one sensor."""
    names = [finding.finding.value for finding in registration.findings]
    lag = registration.position and registration.position.lag
    return RegisteredSensor(
        frame=registration.frame,
        marker=registration.marker,
        lag=lag and lag.value,
        lag_ci95=lag and lag.ci95,
        latency=latency and latency.value,
        latency_ci95=latency and latency.ci95,
        rms=registration.rms,
        angular_rms=registration.rms_rotation,
        rows=registration.rows,
        findings=names,
        notes=notes,
    )
