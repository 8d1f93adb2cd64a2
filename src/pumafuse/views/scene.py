"""The tool in space, as Rerun shows it.

Entities below ``path``: ``command`` and ``estimate``, lines; ``tool``, a point, or of a tool that turns its axes;
``uncertainty``, the ellipsoid in which the tool point is with 95 %, enlarged; ``measured/<sensor>``, where measurements
put the tool; ``sensors/<sensor>``, the axes of a sensor where it stands; ``tool/markers/<sensor>``, of what it sees.
"""

from __future__ import annotations

import math
from functools import reduce

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..arrays import FloatArray
from ..filter.outcome import Outcome
from ..fusion.config import Placement
from ..fusion.estimates import Estimates
from ..fusion.pose import Pose
from ..logs.frames import CARTESIAN, in_space
from ..logs.run import Run
from ..space import rotations
from ..units import MM
from . import colours, styles
from .sink import Sink

_PATH_POINTS = 20_000  # a 3D path needs no more, whatever the rate of the estimates
_AXES = 0.15  # of the path's extent: the length of the tool's axes
_OF_MARKER = 0.5  # times that: those of a marker, which is on the tool
_OF_SENSOR = 0.15  # of its distance from the path: those of a sensor
_ELLIPSOID = 2.7954834829151074  # sds: a normal variable in space lies within with 95 %
_LARGEST = 0.4  # of the tool's axes: an ellipsoid that is enlarged
_FROM = np.array([1.0, -1.2, 0.8])  # the direction from which one looks at the scene
_FAR = 2.1  # times the radius of a sphere, from where it fills the height of a view


def send_scene(sink: Sink, est: Estimates, run: Run) -> None:
    """Send command and estimate in 3D: the log's x, y, z, or the lengths among the axes; and the tool on its way."""
    names = in_space(est.config.arm) if est.cartesian is None else CARTESIAN
    estimated, command = est.cartesian or est.positions, run.command.values
    if not names or not all(name in estimated for name in names):
        return
    if all(name in command for name in names):
        _strip(sink, "path/command", _points([command[name] for name in names]), colours.COMMAND, -0.7)
    path = _points([estimated[name] for name in names])
    _strip(sink, "path/estimate", path, colours.ESTIMATE, -1.2)
    every = slice(None, None, max(1, len(path) // _PATH_POINTS))
    if est.turns:
        length = _axes_length(path) * sink.scale
        _tool(sink, est.time[every], est.pose, every, length)
        for sensor, colour in colours.sensor_colours(est.measurements.sensors).items():
            _measured(sink, est, sensor, colour)
            _placed(sink, est, sensor, colour, length)
    else:
        style = rr.Points3D.from_fields(colors=[colours.rgb(colours.REJECTED)], radii=[-5.0])
        sink.log("path/tool", style)
        sink.columns("path/tool", est.time[every], rr.Points3D.columns(positions=path[every] * sink.scale))


def views(est: Estimates) -> list[rrb.Spatial3DView]:
    """Two views of a tool that turns, in mm: its path from near by, and below it the cell with the sensors."""
    path = est.pose.position
    frames = [known.frame for name in est.measurements.sensors if (known := est.config.sensors.get(name))]
    sensors = [np.array([frame.at]) for frame in frames if frame is not None]
    larger = _enlargement(est.pose, _axes_length(path))
    name = "tool [mm]; where it is with 95 %" + (f", {larger:.0f} times as large" if larger > 1.0 else "")
    near, far = (["$origin/**", f"- /path/{other}/**"] for other in ("sensors", "tool/markers"))
    found = [rrb.Spatial3DView(origin="/path", contents=near, name=name, eye_controls=_eye(path))]
    if sensors:
        eye = _eye(np.concatenate([path, np.zeros((1, 3)), *sensors]))
        found.append(rrb.Spatial3DView(origin="/path", contents=far, name="cell [mm]", eye_controls=eye))
    return found


def _eye(points: FloatArray) -> rrb.EyeControls3D:
    """An eye that sees all of the points [m]."""
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    place = centre + _FAR * radius * _FROM / np.linalg.norm(_FROM)
    return rrb.EyeControls3D(position=place * MM, look_target=centre * MM, eye_up=[0.0, 0.0, 1.0])


def _axes_length(path: FloatArray) -> float:
    """How long the axes of the tool are drawn beside its path [m]."""
    return _AXES * float(np.ptp(path, axis=0).max())


def _enlargement(pose: Pose, length: float) -> float:
    """A power of ten by which ellipsoids are enlarged, to be seen beside axes of a length [m]."""
    usual = _ELLIPSOID * math.sqrt(float(np.median(np.max(pose.covariance[:, :3, :3], axis=(1, 2)))))
    return 10.0 ** max(math.floor(math.log10(_LARGEST * length / usual)), 0) if length > 0.0 else 1.0


def _tool(sink: Sink, time: FloatArray, pose: Pose, every: slice, length: float) -> None:
    """Send the axes of the tool, and the ellipsoid of its position, enlarged by a power of ten to be seen."""
    point, covariance = pose.position[every] * sink.scale, pose.covariance[every, :3, :3]
    sink.log("path/tool", rr.TransformAxes3D(length))
    sink.columns("path/tool", time, rr.Transform3D.columns(translation=point, quaternion=pose.quaternion[every]))
    larger = _enlargement(pose, length / sink.scale)
    half = larger * _ELLIPSOID * sink.scale * np.linalg.cholesky(covariance)
    style = rr.Ellipsoids3D(
        half_sizes=[1.0, 1.0, 1.0],
        colors=[colours.rgb(colours.ESTIMATE)],
        fill_mode="TransparentFillMajorWireframe",
        labels=f"95 %, {larger:.0f} times as large",
        show_labels=False,
    )
    sink.log("path/uncertainty", style)
    sink.columns("path/uncertainty", time, rr.Transform3D.columns(translation=point, mat3x3=half))


def _measured(sink: Sink, est: Estimates, sensor: str, colour: str) -> None:
    """Send where the measurements of a sensor put the tool; those that were rejected in red."""
    axes = CARTESIAN if est.placed is None else ("tangential", "radial", "vertical")
    parts = [est.measured_positions(sensor, axis) for axis in axes]
    stamps = reduce(np.intersect1d, (one.stamp[np.isfinite(one.stamp) & np.isfinite(one.value)] for one in parts))
    stamps = stamps[:: max(1, len(stamps) // _PATH_POINTS)]
    if not len(stamps):
        return
    order = [np.argsort(one.stamp, kind="stable") for one in parts]
    rows = [place[np.searchsorted(one.stamp[place], stamps)] for one, place in zip(parts, order, strict=True)]
    value = [one.value[row] for one, row in zip(parts, rows, strict=True)]
    if est.placed is not None:
        value[:2] = est.placed.to_log(value[0], value[1])
    outcome = np.stack([one.outcome[row] for one, row in zip(parts, rows, strict=True)])
    rejected = (outcome == Outcome.REJECTED).any(axis=0)
    shades = np.where(rejected[:, None], colours.rgb(colours.REJECTED), colours.rgb(colour)).astype(np.uint8)
    points = rr.Points3D(_points(value) * sink.scale, colors=shades, radii=[-0.8])
    sink.log(f"path/measured/{styles.entity(sensor)}", points)


def _placed(sink: Sink, est: Estimates, sensor: str, colour: str, length: float) -> None:
    """Send where a sensor stands and what it sees on the tool, where the configuration says so."""
    if sensor not in est.config.sensors:
        return
    known = est.config.sensors[sensor]
    if known.frame is not None:
        away = float(np.linalg.norm(np.mean(est.pose.position, axis=0) - known.frame.at))
        _frame(sink, f"path/sensors/{sensor}", known.frame, _OF_SENSOR * away * sink.scale, colour, sensor)
    if known.marker is not None:
        _frame(sink, f"path/tool/markers/{sensor}", known.marker, _OF_MARKER * length, colour, sensor)


def _frame(sink: Sink, path: str, place: Placement, length: float, colour: str, label: str) -> None:
    """Send a frame within that of the entity above it: its axes, and its name at their origin."""
    turned = rotations.of_vectors(np.array([place.rotation]))[0]
    sink.log(path, rr.Transform3D(translation=np.array(place.at) * sink.scale, quaternion=turned))
    sink.log(path, rr.TransformAxes3D(length))
    sink.log(path, rr.Points3D([0.0, 0.0, 0.0], colors=[colours.rgb(colour)], radii=[-4.0], labels=label))


def _strip(sink: Sink, path: str, points: FloatArray, colour: str, radius: float) -> None:
    """Send a path [m]; a negative radius is in points of the screen, right for a path of any size."""
    points = points[np.isfinite(points).all(axis=1)] * sink.scale
    points = points[:: max(1, len(points) // _PATH_POINTS)]
    line = rr.LineStrips3D([points], colors=[colours.rgb(colour)], radii=[radius])
    sink.log(path, line)


def _points(coordinates: list[FloatArray]) -> FloatArray:
    """Positions in space of two or three coordinates, (n, 3)."""
    found = np.zeros((len(coordinates[0]), 3))
    found[:, : len(coordinates)] = np.column_stack(coordinates)
    return found
