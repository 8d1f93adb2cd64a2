"""The tool in space, as Rerun shows it: of a recorded result, and parts that the live view shares.

Entities below ``path``: ``command`` and ``estimate``, lines; ``tool``, a point, or of a tool that turns its axes;
``uncertainty``, the ellipsoid in which the tool point is with 95 %, enlarged; ``measured/<sensor>``, where measurements
put the tool; ``sensors/<sensor>``, the axes of a sensor where it stands; ``tool/markers/<sensor>``, of what it sees;
``robot``, a line through the links of a robot whose joints are commanded.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..arrays import NO_STAMP, BoolArray, FloatArray, IntArray, TimeArray
from ..filter.outcome import Outcome
from ..fusion.config import Placement, Sensor
from ..logs.frames import CARTESIAN, in_space
from ..space import rotations
from ..units import KINDS, MM, Kind, seconds
from . import colours, styles
from .styles import Sink

if TYPE_CHECKING:  # the process of the live view begins sooner without
    from ..fusion.estimates import Estimates
    from ..logs.run import Run
    from ..logs.source import Source
    from ..space.kinematics import Joints

_PATH_POINTS = 20_000  # a 3D path needs no more, whatever the rate of the estimates
_ROBOT_POSES = 2000  # of a robot in motion: some tens a second of a minute, as many as one sees
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
        _send_strip(sink, "path/command", _points([command[name] for name in names]), colours.COMMAND, -0.7)
    path = _points([estimated[name] for name in names])
    _send_strip(sink, "path/estimate", path, colours.ESTIMATE, -1.2)
    if run.command.joints is not None:
        _send_robot(sink, run.command, run.command.joints, est.origin)
    every = slice(None, None, max(1, len(path) // _PATH_POINTS))
    if est.turns:
        length, pose, larger = _axes_length(path), est.pose, _enlargement(est)
        send_look(sink, length, larger)
        root = np.asarray(np.linalg.cholesky(pose.covariance[every, :3, :3]), dtype=np.float64)
        send_tool(sink, est.time[every], pose.position[every], pose.quaternion[every], root, larger)
        centre = np.mean(pose.position, axis=0)
        for sensor, colour in colours.sensor_colours(est.measurements.sensors).items():
            _send_measured(sink, est, sensor, colour)
            if configured := est.config.sensors.get(sensor):
                send_placed(sink, sensor, configured, colour, centre, length)
    else:
        style = rr.Points3D.from_fields(colors=[colours.rgb(colours.REJECTED)], radii=[-5.0])
        sink.log("path/tool", style)
        sink.send_columns("path/tool", est.time[every], rr.Points3D.columns(positions=path[every] * sink.scale))


def views(est: Estimates, run: Run) -> list[rrb.Spatial3DView]:
    """Views of the path of a tool that turns, and of the cell with the sensors and the robot."""
    path, larger = est.pose.position, _enlargement(est)
    frames = [configured.frame for name in est.measurements.sensors if (configured := est.config.sensors.get(name))]
    links = None if run.command.joints is None else _links(run.command, run.command.joints)[1].reshape(-1, 3)
    return two_views("tool", larger, _eye(path), cell_eye(path, frames, links))


def two_views(
    name: str, larger: float, near: rrb.EyeControls3D | None, cell: rrb.EyeControls3D | None
) -> list[rrb.Spatial3DView]:
    """Views of a scene in mm: of the tool from near by, and below it of the cell, if there is an eye for that."""
    name = f"{name} [mm]; where it is with 95 %" + (f", {larger:.0f} times as large" if larger > 1.0 else "")
    without_sensors, without_markers = (["$origin/**", f"- /path/{other}/**"] for other in ("sensors", "tool/markers"))
    two_views = [rrb.Spatial3DView(origin="/path", contents=without_sensors, name=name, eye_controls=near)]
    if cell is not None:
        two_views.append(
            rrb.Spatial3DView(origin="/path", contents=without_markers, name="cell [mm]", eye_controls=cell)
        )
    return two_views


def by_kind(plots: Mapping[str, rrb.View], kinds: Mapping[str, Kind], name: str) -> rrb.Container:
    """Plots of axes, those of rotations beside those of positions."""
    sides = [[plot for axis, plot in plots.items() if kinds[axis] == kind] for kind in KINDS]
    return rrb.Horizontal(*(rrb.Vertical(*side) for side in sides if side), name=name)


def _eye(points: FloatArray) -> rrb.EyeControls3D:
    """An eye that sees all of the points [m], (n, 3)."""
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    eye = centre + _FAR * radius * _FROM / np.linalg.norm(_FROM)
    return rrb.EyeControls3D(position=eye * MM, look_target=centre * MM, eye_up=[0.0, 0.0, 1.0])


def cell_eye(
    path: FloatArray, frames: Iterable[Placement | None], links: FloatArray | None = None
) -> rrb.EyeControls3D | None:
    """An eye that sees a path and links [m], (n, 3), base and sensors; None without a place of sensors or links."""
    others = [np.array([frame.at]) for frame in frames if frame is not None]
    others += [] if links is None else [links]
    return _eye(np.concatenate([path, np.zeros((1, 3)), *others])) if others else None


def _axes_length(path: FloatArray) -> float:
    """How long the axes of the tool are drawn beside its path [m]."""
    return _AXES * float(np.ptp(path, axis=0).max())


def _enlargement(est: Estimates) -> float:
    """A power of ten by which ellipsoids are enlarged, to be seen beside the tool's axes."""
    length = _axes_length(est.pose.position)
    usual = _ELLIPSOID * math.sqrt(float(np.median(np.max(est.pose.covariance[:, :3, :3], axis=(1, 2)))))
    return 10.0 ** max(math.floor(math.log10(_LARGEST * length / usual)), 0) if length > 0.0 else 1.0


def send_look(sink: Sink, length: float, larger: float) -> None:
    """Send how the tool looks: axes of a length [m], and the ellipsoid of 95 %, enlarged by a factor."""
    sink.log("path/tool", rr.TransformAxes3D(length * sink.scale))
    style = rr.Ellipsoids3D(
        half_sizes=[1.0, 1.0, 1.0],
        colors=[colours.rgb(colours.ESTIMATE)],
        fill_mode="TransparentFillMajorWireframe",
        labels=f"95 %, {larger:.0f} times as large",
        show_labels=False,
    )
    sink.log("path/uncertainty", style)


def send_tool(
    sink: Sink, time: FloatArray, point: FloatArray, quaternion: FloatArray, root: FloatArray, larger: float
) -> None:
    """Send where the tool and its ellipsoid are at times [s], (n,).

    The point is in m, (n, 3), the quaternion x, y, z, w, (n, 4), and root the S of the covariance S Sᵀ of x, y, z [m].
    """
    point = point * sink.scale
    sink.send_columns("path/tool", time, rr.Transform3D.columns(translation=point, quaternion=quaternion))
    half = larger * _ELLIPSOID * sink.scale * root
    sink.send_columns("path/uncertainty", time, rr.Transform3D.columns(translation=point, mat3x3=half))


def _send_robot(sink: Sink, command: Source, joints: Joints, origin: int) -> None:
    """Send a line through the robot's links, from the base to the tip, where the joints are commanded to be.

    rerun-sdk's own reader of URDFs draws meshes and shapes only, which a file may not have.
    """
    stamp, links = _links(command, joints)
    sink.log("path/robot", rr.LineStrips3D.from_fields(colors=[colours.rgb(colours.COMMAND)], radii=[-2.0]))
    lines = rr.LineStrips3D.columns(strips=list(links * sink.scale))
    sink.send_columns("path/robot", seconds(stamp, origin), lines)


def _links(command: Source, joints: Joints) -> tuple[TimeArray, FloatArray]:
    """Stamps [ns], (n,), and where each link is then [m], (n, L, 3)."""
    rows = np.flatnonzero(command.stamp != NO_STAMP)
    rows = rows[:: max(1, len(rows) // _ROBOT_POSES)]
    links = joints.chain.frames(joints.values[rows])[:, :, :3, 3]
    is_known = np.isfinite(links).all(axis=(1, 2))
    return command.stamp[rows[is_known]], links[is_known]


def _send_measured(sink: Sink, est: Estimates, sensor: str, colour: str) -> None:
    """Send where the measurements of a sensor put the tool."""
    axes = CARTESIAN if est.placed is None else ("tangential", "radial", "vertical")
    parts = [est.measured_positions(sensor, axis) for axis in axes]
    rows = in_all([np.where(np.isfinite(part.value), part.stamp, np.nan) for part in parts])
    rows = [row[:: max(1, len(row) // _PATH_POINTS)] for row in rows]
    if not len(rows[0]):
        return
    value = [part.value[row] for part, row in zip(parts, rows, strict=True)]
    if est.placed is not None:
        value[:2] = est.placed.to_log(value[0], value[1])
    outcome = np.stack([part.outcome[row] for part, row in zip(parts, rows, strict=True)])
    rejected = (outcome == Outcome.REJECTED).any(axis=0)
    sink.log(measured_entity(sensor), measured_points(_points(value) * sink.scale, rejected, colour))


def measured_entity(sensor: str) -> str:
    """The entity of where the measurements of a sensor put the tool."""
    return f"path/measured/{styles.entity(sensor)}"


def in_all(stamps: Sequence[FloatArray]) -> list[IntArray]:
    """The rows of each of several tables that have the stamps which all tables have; NaN is no stamp."""
    common = reduce(np.intersect1d, stamps)
    order = [np.argsort(stamp, kind="stable") for stamp in stamps]
    return [rows[np.searchsorted(stamp[rows], common)] for stamp, rows in zip(stamps, order, strict=True)]


def measured_points(point: FloatArray, rejected: BoolArray, colour: str) -> rr.Points3D:
    """Measurements (n, 3), in the unit of the scene; those that were rejected in red."""
    shades = np.where(rejected[:, None], colours.rgb(colours.REJECTED), colours.rgb(colour)).astype(np.uint8)
    return rr.Points3D(point, colors=shades, radii=[-0.8])


def send_placed(sink: Sink, name: str, sensor: Sensor, colour: str, tool: FloatArray, length: float) -> None:
    """Send where a sensor stands and what it sees on the tool, as far as this is known."""
    if sensor.frame is not None:
        away = float(np.linalg.norm(tool - sensor.frame.at))
        _send_frame(sink, f"path/sensors/{name}", sensor.frame, _OF_SENSOR * away, colour, name)
    if sensor.marker is not None:
        _send_frame(sink, f"path/tool/markers/{name}", sensor.marker, _OF_MARKER * length, colour, name)


def _send_frame(sink: Sink, path: str, placement: Placement, length: float, colour: str, label: str) -> None:
    """Send a frame within that of the entity above it: its axes, and its name at their origin."""
    turned = rotations.of_vectors(np.array([placement.rotation]))[0]
    sink.log(path, rr.Transform3D(translation=np.array(placement.at) * sink.scale, quaternion=turned))
    sink.log(path, rr.TransformAxes3D(length * sink.scale))
    sink.log(path, rr.Points3D([0.0, 0.0, 0.0], colors=[colours.rgb(colour)], radii=[-4.0], labels=label))


def _send_strip(sink: Sink, path: str, points: FloatArray, colour: str, radius: float) -> None:
    """Send a path [m]; a negative radius is in points of the screen, right for a path of any size."""
    points = points[np.isfinite(points).all(axis=1)] * sink.scale
    points = points[:: max(1, len(points) // _PATH_POINTS)]
    line = rr.LineStrips3D([points], colors=[colours.rgb(colour)], radii=[radius])
    sink.log(path, line)


def _points(coordinates: list[FloatArray]) -> FloatArray:
    """Positions in space of two or three coordinates, (n, 3)."""
    points = np.zeros((len(coordinates[0]), 3))
    points[:, : len(coordinates)] = np.column_stack(coordinates)
    return points
