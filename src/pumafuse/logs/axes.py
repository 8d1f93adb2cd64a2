"""Conversion of runs logged in x, y, z, and with orientations, into runs in the arm's axes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..arrays import FloatArray, known_rows
from ..errors import RunError
from ..space import rotations
from ..space.rotations import TURNING
from .clock import segments, without_strays
from .frames import CARTESIAN, Frame, Placed, Rotated
from .run import Run
from .source import Source

FARTHEST_TURN = math.radians(170.0)  # at 180° a rotation vector changes its sign
FAR_TURN = math.radians(120.0)  # from where on the axes of a rotation vector are far from linear


def in_axes(run: Run, frame: Frame | None, tool: tuple[float, float, float] | None = None) -> tuple[Run, Placed | None]:
    """The run with sources in x, y, z converted into axes, and the placed frame; without a frame as it is, and None.

    Orientations become axes rx, ry, rz where the commands have one, too; ``tool`` is the reference orientation as a
    rotation vector [rad], None: the mean of the commanded ones. ``frame`` is for runs without one of their own.

    Stray stamps are removed first (:func:`pumafuse.logs.clock.without_strays`): the start level and the whole turns,
    which x and y leave open, must not come from them.
    """
    run = _turning(without_strays(run), tool)
    frame = frame if run.frame is None else run.frame
    named = set(run.command.values).union(*(source.values for source in run.sensors.values()))
    if frame is None or named.isdisjoint(CARTESIAN):
        return run, None
    placed = _placed(run, frame)
    command = _converted(run.command, placed, None)
    at_rest = Source(np.zeros(1, np.int64), {axis: np.array([level]) for axis, level in run.start.items()}, "start")
    start = {axis: float(level[0]) for axis, level in _converted(at_rest, placed, None).values.items()}
    converted = run.each(lambda _, source: command if source is run.command else _converted(source, placed, command))
    return replace(converted, start=start, frame=None), placed


def reference_orientation(run: Run) -> tuple[float, float, float] | None:
    """The mean of the commanded orientations as a rotation vector [rad]; None where none is commanded."""
    commanded = run.command.orientation
    if commanded is None or np.isnan(commanded).all():
        return None
    x, y, z = rotations.mean(commanded).tolist()
    return x, y, z


def _turning(run: Run, tool: tuple[float, float, float] | None) -> Run:
    """The run with axes rx, ry, rz instead of orientations, if the commands have one; else without these."""
    tool = tool or reference_orientation(run)
    if tool is None or run.command.orientation is None:
        return run.each(lambda _, source: replace(source, orientation=None)) if run.has_orientation else run
    reference, notes = np.array(tool), list(run.notes)

    def turning(_: str, source: Source) -> Source:
        if source.orientation is None:
            return source
        vector = rotations.vectors(source.orientation, reference)
        values = {**source.values, **dict(zip(TURNING, vector.T.copy(), strict=True))}
        of_turning = {} if source is run.command else dict.fromkeys(TURNING, rotations.spread(vector))
        return replace(source, values=values, spread={**source.spread, **of_turning}, orientation=None)

    turned = run.each(turning)
    told = np.stack([turned.command.values[axis] for axis in TURNING])
    farthest = float(np.sqrt(np.nanmax(np.sum(told**2, axis=0))))
    by = f"{math.degrees(farthest):.0f}° from its reference orientation"
    far = f"{run.command.label}: the tool is told to turn by {by}"
    if farthest > FARTHEST_TURN:
        raise RunError(f"{far}; up to 170° can be followed: cut the log, or give another [tool] in fusion.toml")
    if farthest > FAR_TURN:
        notes.append(f"{far}: beyond 120° error bars of its orientation are too small")
    kinds = dict(run.kinds) | dict.fromkeys(TURNING, "angle")
    return replace(turned, tool=tool, kinds=kinds, notes=tuple(notes))


def _placed(run: Run, frame: Frame) -> Placed:
    where = f"run '{run.name}'"
    if isinstance(frame, Rotated) or run.start.keys() >= {"x", "y"}:
        return placed_at(frame, run.start.get("x", 0.0), run.start.get("y", 0.0), where)
    if not run.command.values.keys() >= {"x", "y"}:
        level = "a cylindrical frame takes its radius and angle from the start level"
        raise RunError(f"{where}: {level}; give the commands, or start, in x and y")
    command = segments(run)[0][0].command
    _, level = known_rows(command.stamp, np.column_stack([command.values["x"], command.values["y"]]))
    if not len(level):
        raise RunError(f"{command.label}: no command has both x and y; log both in one row")
    return placed_at(frame, float(level[0, 0]), float(level[0, 1]), where)


def placed_at(frame: Frame, x: float, y: float, label: str) -> Placed:
    """The frame placed at a start level of x and y [m] in the log."""
    if isinstance(frame, Rotated):
        return Placed(frame, 1.0, frame.azimuth)
    dx, dy = x - frame.base[0], y - frame.base[1]
    if dx == 0.0 and dy == 0.0:
        raise RunError(f"{label}: the arm starts on its base's axis, where it has no angle; check base_mm")
    return Placed(frame, float(np.hypot(dx, dy)), float(np.arctan2(dy, dx)))


def _converted(source: Source, placed: Placed, command: Source | None) -> Source:
    cartesian = [name for name in CARTESIAN if name in source.values]
    if not cartesian:
        return source
    if ("x" in cartesian) != ("y" in cartesian):
        gives = "x without y" if "x" in cartesian else "y without x"
        raise RunError(f"{source.label}: gives {gives}; a frame needs both")
    named, spread, converted = source.without(CARTESIAN).values, dict(source.spread), dict[str, FloatArray]()
    if "x" in cartesian:
        near = None  # where the commands are then, tangential [m], (rows,)
        if command is not None and not isinstance(placed.frame, Rotated):
            if "tangential" not in command.values:
                both = f"{source.label} is in x and y, the commands are not; give them in x and y too"
                raise RunError(f"{command.label}: {both}")
            near = np.interp(source.stamp, *command.series("tangential"))
        x, y = source.values["x"], source.values["y"]
        converted["tangential"], converted["radial"], spread["tangential"] = placed.to_axes(x, y, near)
    if "z" in cartesian:
        converted["vertical"] = source.values["z"]
    if twice := next((axis for axis in converted if axis in named), None):
        raise RunError(f"{source.label}: gives {twice} both by its name and by {', '.join(cartesian)}; give one")
    return replace(source, values={**named, **converted}, spread=spread)
