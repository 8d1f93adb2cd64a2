"""Saving of a recorded run as a folder: a CSV file for each source, and ``run.toml``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from .. import toml
from ..errors import RunError
from ..units import SCREEN, Screen, seconds
from . import tables
from .run import Run
from .source import NOISE, Source

_KEYS = ("file", "topic", "entity", "where", "time", "start", "clock", NOISE, "arrived")  # of a source in run.toml
_TAKEN = ("commands", "truth", "trials", "samples", "path")


def save(run: Run, folder: Path) -> None:
    """Write a run that :meth:`Run.read` reads back: stamps to the ns within 26 days of 0, lengths to the nm."""
    for name in run.sensors:
        check_name(name)
    for axis in run.axes:
        check_axis(axis)
    manifest: dict[str, Any] = {"name": run.name, "command": _entry(run, run.command, "commands.csv", folder)}
    if run.start:
        manifest["command"]["start"] = {f"{axis}_{_screen(run, axis).unit}": level for axis, level in run.start.items()}
    if run.clock != "stamps":
        manifest["command"]["clock"] = run.clock
    if run.sensors:
        manifest["sensors"] = {name: _entry(run, source, f"{name}.csv", folder) for name, source in run.sensors.items()}
    if run.reference is not None:
        manifest["reference"] = _entry(run, run.reference, "truth.csv", folder)
        noise = {f"sd_{_screen(run, axis).unit}": run.reference.sd_of(axis) for axis in run.reference.values}
        manifest["reference"] |= {key: sd for key, sd in noise.items() if sd}
    if run.frame is not None:
        manifest["frame"] = toml.builtins(run.frame)
    (folder / "run.toml").write_text(toml.text(manifest), encoding="utf-8")


def check_name(sensor: str) -> None:
    """Refuse a sensor whose name cannot be that of its file."""
    plain = sensor.isprintable() and Path(sensor).name == sensor and not sensor.startswith(".")
    if not plain or not sensor or sensor in _TAKEN:
        raise RunError(
            f"sensor '{sensor}': its rows go into a file of its name, which must not be a path or one of"
            f" {', '.join(_TAKEN)}"
        )


def check_axis(axis: str) -> None:
    """Refuse an axis whose name is a key of run.toml."""
    if axis in _KEYS:
        raise RunError(f"axis '{axis}': run.toml uses this word itself; no axis can be called {', '.join(_KEYS)}")


def _screen(run: Run, axis: str) -> Screen:
    return SCREEN[run.kinds.get(axis, "length")]


def _entry(run: Run, source: Source, file: str, folder: Path) -> dict[str, Any]:
    screens = {axis: _screen(run, axis) for axis in source.values}
    columns = {
        f"{axis}_{screen.unit}": pa.array(np.round(source.values[axis] * screen.scale, 6), from_pandas=True)
        for axis, screen in screens.items()
    }
    if len(source.noise):
        columns[NOISE] = pa.array(source.noise)
    clocks = {"time": source.stamp} | ({"arrived": source.arrival} if len(source.arrival) else {})
    stamps = {f"{key}_s": pa.array(seconds(clock), from_pandas=True) for key, clock in clocks.items()}
    tables.write(pa.table({**stamps, **columns}), folder / file)
    noise = {NOISE: {"sd": NOISE, "typical": 1.0}} if len(source.noise) else {}
    named = {axis: f"{axis}_{screen.unit}" for axis, screen in screens.items()}
    return {"file": file, **{key: f"{key}_s" for key in clocks}, **named, **noise}
