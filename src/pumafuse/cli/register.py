"""`pumafuse register`."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import typer
from rich.console import Console

from .. import folders
from ..fusion.config import ARM_FILE, ROBOT_FILE, FusionConfig
from ..logs.run import Run
from ..registration.findings import AS_READ
from ..registration.register import Registered
from ..registration.runs import RegisteredSensor, RegistrationSummary, register
from ..toml import Interval
from ..units import DEG, MM, MS
from .screen import say
from .tables import print_tables, table

SUMMARY = "registration.json"
_OURS = frozenset({SUMMARY, "fusion.toml", ARM_FILE, ROBOT_FILE})
_MENDED = {finding.value for finding in AS_READ}  # findings after which run.toml is to be mended
_NOT_ALL = 3  # exit code: some sensor was not registered


def run(
    paths: Sequence[Path],
    config: Path | None,
    sensor: str | None,
    fix: Sequence[str],
    output: Path | None,
    json: bool,
    force: bool,
    part: tuple[float | None, float | None] = (None, None),
) -> None:
    """Register sensors and write the configuration; the arguments are the options of the command."""
    if output is not None:
        folders.check_writable(output, force, [SUMMARY], _OURS.__contains__)
    configured = None if config is None else FusionConfig.load(config)
    runs = [Run.read(path).between(*part) for path in paths]
    with Console(stderr=True).status("looking for frames and markers"):
        registration = register(runs, configured, sensor=sensor, fix=fix)
    if output is not None:
        with folders.replacing(output) as new:
            registration.config.save(new)
            (new / SUMMARY).write_text(registration.to_json(), encoding="utf-8")
    if json:
        say(registration.to_json().removesuffix("\n"))
    else:
        show(registration.details)
        if output is not None:
            folder = shlex.quote(str(output))
            first = any(_MENDED.intersection(sensor.findings) for sensor in registration.details.sensors.values())
            after = "mend run.toml as said above, and register anew" if first else None
            say(f"written to {output}\nnext: {after or f'pumafuse tune RUN -c {folder}/fusion.toml -o DIR'}")
    if any(sensor.frame is None for sensor in registration.details.sensors.values()):
        raise typer.Exit(_NOT_ALL)


def show(summary: RegistrationSummary) -> None:
    """Print what was found of each sensor on stdout."""
    for name, sensor in summary.sensors.items():
        _show(name, sensor)
    if summary.joints:
        say("joints do not answer alike; each is later than the one that answers first by")
        rows = [
            [n, f"{joint.later * MS:.2f}", _limits(joint.later_ci95, MS, ".2f")] for n, joint in summary.joints.items()
        ]
        print_tables([table(["joint", "later_ms", "95 % interval"], rows)])


def _show(name: str, registered: RegisteredSensor) -> None:
    """Print what was found of one sensor."""
    if registered.frame is None or registered.marker is None or registered.lag is None:
        say(f"{name}: not registered")
        return
    turned = "" if registered.angular_rms is None else f" and {registered.angular_rms * DEG:.3g}°"
    say(f"{name}: {registered.rows} measurements; left over {(registered.rms or 0.0) * MM:.3g} mm{turned} RMS")
    rows = [*_places("frame", registered.frame), *_places("marker", registered.marker)]
    rows.append(["lag, ms", f"{registered.lag * MS:.2f}", _limits(registered.lag_ci95, MS, ".2f")])
    if registered.latency is not None:
        rows.append(["latency_ms", f"{registered.latency * MS:.2f}", _limits(registered.latency_ci95, MS, ".2f")])
    print_tables([table(["number", "found", "95 % interval"], rows)])
    if registered.latency is not None and registered.latency_ci95 == (registered.latency, registered.latency):
        say(latency_note(name, registered.latency))


def latency_note(name: str, latency: float) -> str:
    """What to say of a latency [s] that nothing in a run tells."""
    return (
        f"the latency of {name} is taken to be {latency * MS:.4g} ms, not found: error bars do not count how far off"
        " that is; by each ms the position is off by what the tool moves in it (fusion.toml, latency_ms)"
    )


def _places(what: str, registered: Registered) -> list[list[str]]:
    """Rows of a place and an orientation."""
    parts = [("at_mm", registered.at, registered.at_ci95, MM)]
    if what == "frame" or any(registered.rotation):
        parts.append(("rotation_vector_deg", registered.rotation, registered.rotation_ci95, DEG))
    return [
        [f"{what}.{key}, {axis}", f"{value * scale:.3f}", _limits(interval, scale, ".3f")]
        for key, values, limits, scale in parts
        for axis, value, interval in zip("xyz", values, limits, strict=True)
    ]


def _limits(interval: Interval | None, scale: float, form: str) -> str:
    if interval is None or abs(interval[0]) == float("inf"):
        return "the motion does not tell"
    if interval[0] == interval[1]:
        return "taken, not found"
    return " to ".join(format(end * scale, form) for end in interval)
