"""`pumafuse export`."""

from __future__ import annotations

from pathlib import Path

from ..errors import ConfigError, warn
from ..folders import check_replaceable, write_file
from ..fusion.config import FusionConfig
from ..live.estimator import LiveEstimator
from ..live.export import MARK, header, identifier, omissions
from .screen import say


def run(config: Path, output: Path, force: bool) -> None:
    """Write a configuration as a C header."""
    ours = output.is_file() and output.read_bytes().startswith(MARK.encode())
    check_replaceable(output, force, ours, "header of pumafuse export")
    name = identifier(output.stem)
    if name.lower() in ("pf", "pumafuse"):
        raise ConfigError(f"{output}: its names would be those of pumafuse.h; choose another")
    configured = FusionConfig.load(config)
    if not configured.sensors:
        raise ConfigError(f"{config}: has no sensor: without one there is nothing to fuse")
    LiveEstimator(configured)  # refuses what it cannot follow
    warn(configured.arm.doubts() + configured.arm.joint_doubts())
    write_file(output, header(configured, name, str(config)), replace=force)
    axes = ", ".join(configured.arm.axes)
    say(f"{name}_model, of {axes} measured by {', '.join(configured.sensors)}, written to {output}")
    if configured.frame is not None:
        say(f"it is in the arm's axes: turning x, y, z into {axes}, as [frame] says, is left to the controller")
    if configured.tool is not None or any(sensor.is_placed for sensor in configured.sensors.values()):
        say(
            f"it is in the base's axes: {omissions(configured)} left to the controller, which gives {axes} of the tool"
            " point"
        )
