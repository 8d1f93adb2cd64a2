"""The configuration that registrations make: arm, frames, markers, latencies, biases and noise to begin with."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np

from ..discovery.contents import period_of
from ..discovery.guesses import guess
from ..discovery.roles import relations
from ..discovery.survey import Survey
from ..fusion.config import SD_BOUNDS, FusionConfig, Placement, Sensor, Start, Tool
from ..fusion.placing import in_base
from ..logs.axes import reference_orientation
from ..logs.frames import CARTESIAN
from ..logs.run import Run
from ..model.arm import ArmModel, AxisModel, Joint
from ..model.plants import FirstOrder
from ..space.rotations import TURNING
from ..tuning.latency import first_guess
from ..units import Kind
from .findings import Vector
from .register import Quantity, Registered, Registration, Response

DIGITS = 6  # of m, rad and s in a configuration: a micrometre
_SHORTEST = 1e-3  # s, of a plant
_SUREST = 1e-5  # s, of half the interval of a lag: no stamps are finer
_NO_EVIDENCE = 3.0  # times what the arm may be off: commands and sensors share it, and do not bear each other out


def arm_of(runs: Sequence[Run], registrations: Mapping[str, Registration]) -> FusionConfig:
    """The arm as the earliest sensor saw it answer."""
    positions = [registration.position for registration in registrations.values() if registration.position is not None]
    response, tool = min(positions, key=lambda position: position.lag.value), reference_orientation(runs[0])
    axes = {axis: AxisModel(plant=_plant(response)) for axis in CARTESIAN}
    if tool is not None:
        axes |= {axis: _turning(registrations.values(), response) for axis in TURNING}
    period = period_of(runs[0].command)
    arm = ArmModel(
        name="registered",
        update_period=float(f"{period:.4g}"),
        delay=max(round(response.delay.value, DIGITS), 0.0),
        axes=axes,
    )
    sensors = {
        name: Sensor(sd=max(registration.rms or 0.0, SD_BOUNDS[0])) for name, registration in registrations.items()
    }
    turned = None if tool is None else Tool(reference=tool)
    return FusionConfig(arm=arm, sensors=sensors, tool=turned, robot=runs[0].robot)


def configuration(
    runs: Sequence[Run],
    registrations: Mapping[str, Registration],
    latencies: Mapping[str, Quantity],
    begun: FusionConfig,
) -> FusionConfig:
    """A configuration to begin with: the arm that was found, and noise as it looks along the base's axes."""
    config = set_lags(set_placements(begun, registrations, latencies), registrations)
    placed = [in_base(run, config)[0] for run in runs]
    latency = {name: sensor.latency for name, sensor in config.sensors.items()}
    guessed = first_guess([guess(Survey(Path(run.name), run, relations(run)), latency) for run in placed])
    sensors = {
        name: msgspec.structs.replace(
            guessed.sensors[name],
            latency=sensor.latency,
            frame=sensor.frame,
            marker=sensor.marker,
            scale=1.0,
            bias_sd=sensor.bias_sd,
        )
        for name, sensor in config.sensors.items()
        if name in guessed.sensors
    }
    sensors = {**guessed.sensors, **sensors}
    constants = _constants(guessed.arm, registrations)
    offsets = {
        axis: max(guessed.start.offset_sd_of(axis), _NO_EVIDENCE * constants.get(axis, 0.0))
        for axis in guessed.arm.axes
    }
    models = {axis: model for axis, model in config.arm.axes.items() if axis in guessed.arm.axes}
    arm = msgspec.structs.replace(guessed.arm, delay=config.arm.delay, axes={**guessed.arm.axes, **models})
    return msgspec.structs.replace(
        guessed, arm=arm, sensors=sensors, start=Start(offset_sd=offsets), tool=config.tool, robot=config.robot
    )


def set_placements(
    config: FusionConfig, registrations: Mapping[str, Registration], latencies: Mapping[str, Quantity]
) -> FusionConfig:
    """The configuration with frame, marker, latency and bias of sensors."""
    constants = _constants(config.arm, registrations)
    count = sum(registration.frame is not None for registration in registrations.values())
    sensors = {
        name: msgspec.structs.replace(
            config.sensors[name],
            sd=_noise(config.sensors[name], _placement(registration.frame)),
            frame=_placement(registration.frame),
            marker=_placement(registration.marker),
            latency=round(latencies[name].value, DIGITS) if name in latencies else config.sensors[name].latency,
            bias_sd=_biases(config.sensors[name], constants, count)
            if registration.frame
            else config.sensors[name].bias_sd,
        )
        for name, registration in registrations.items()
    }
    return msgspec.structs.replace(config, sensors={**config.sensors, **sensors})


def _placement(placed: Registered | None) -> Placement | None:
    """A place as a configuration has it; None for one that is where the robot's is."""
    if placed is None:
        return None
    at, rotation = (_round(vector) for vector in (placed.at, placed.rotation))
    return Placement(at=at, rotation=rotation) if any(at) or any(rotation) else None


def _noise(sensor: Sensor, frame: Placement | None) -> float | dict[str, float]:
    """The noise of a sensor along the base's axes, where it was along its own until its frame was found."""
    if frame is None or sensor.frame is not None or not isinstance(sensor.sd, dict):
        return sensor.sd
    sd = sensor.sd.copy()
    for space in (CARTESIAN, TURNING):
        if sd.keys() >= set(space):
            sd |= zip(space, frame.turned_sd([sd[axis] for axis in space]), strict=True)
    return sd


def _round(vector: Vector) -> Vector:
    x, y, z = (round(number, DIGITS) for number in vector)
    return x, y, z


def _constants(arm: ArmModel, registrations: Mapping[str, Registration]) -> dict[str, float]:
    """How far off the arm itself may be by a constant [m or rad], of each axis.

    A registration follows the commanded poses, and so has a constant error of the arm's kinematics in it, which no
    motion shows. It is taken to be as large as what changes with the pose, which is what registrations leave.
    """
    placed = [registration for registration in registrations.values() if registration.frame is not None]
    left: dict[Kind, float] = {
        "length": max((_beyond_noise(registration) for registration in placed), default=0.0),
        "angle": max((registration.rms_rotation or 0.0 for registration in placed), default=0.0),
    }
    return {axis: left[arm.axes[axis].kind] for axis in (*CARTESIAN, *TURNING) if axis in arm.axes}


def _beyond_noise(registration: Registration) -> float:
    """What a registration leaves of positions beyond the white noise of their three coordinates [m]."""
    return float(np.sqrt(max((registration.rms or 0.0) ** 2 - 3.0 * registration.noise**2, 0.0)))


def _biases(sensor: Sensor, constants: Mapping[str, float], count: int) -> dict[str, float]:
    """How far off one of several sensors may be in the base [m or rad], where no bias is configured.

    They share what the arm is off, while the filter takes their biases to be independent: so each has √n times as much.
    """
    return {
        axis: sensor.bias_sd_of(axis) or float(f"{constant * count**0.5:.2g}") for axis, constant in constants.items()
    }


def set_lags(config: FusionConfig, registrations: Mapping[str, Registration]) -> FusionConfig:
    """The configuration whose arm is as late as sensors of known latencies saw it: by its delays.

    Each counts as its lag is sure.
    """
    lags = {name: registration.position.lag for name, registration in registrations.items() if registration.position}
    of_arm = [lag.value - config.sensors[name].latency for name, lag in lags.items()]
    weight = [max(lag.half, _SUREST) ** -2 for lag in lags.values()]
    later = float(np.average(of_arm, weights=weight)) - lag_in_space(config.arm)

    def moved(delay: float) -> float:
        return round(max(delay + later, 0.0), DIGITS)

    arm = msgspec.structs.replace(
        config.arm,
        delay=moved(config.arm.delay),
        axes={
            name: axis if axis.delay is None else msgspec.structs.replace(axis, delay=moved(axis.delay))
            for name, axis in config.arm.axes.items()
        },
    )
    return msgspec.structs.replace(config, arm=arm)


def lag_in_space(arm: ArmModel) -> float:
    """The lag of positions in space [s]."""
    return float(np.mean([arm.lag_of(axis) for axis in CARTESIAN]))


def _turning(registrations: Iterable[Registration], earliest: Response) -> AxisModel:
    """How the tool turns: as the sensor saw that is surest, less what it is later; else as it moves."""
    pairs = [(each.rotation, each.position) for each in registrations if each.rotation and each.position]
    if not pairs:
        return AxisModel(kind="angle", plant=_plant(earliest))
    rotation, position = min(pairs, key=lambda responses: responses[0].lag.half)
    delay = rotation.delay.value - (position.lag.value - earliest.lag.value)
    return AxisModel(kind="angle", plant=_plant(rotation), delay=max(round(delay, DIGITS), 0.0))


def _plant(response: Response) -> FirstOrder:
    return FirstOrder(time_constant=max(response.time_constant.value, _SHORTEST))


def set_joints(config: FusionConfig, joints: dict[str, Joint]) -> FusionConfig:
    """The configuration with other joints of its arm."""
    return msgspec.structs.replace(config, arm=msgspec.structs.replace(config.arm, joints=joints))
