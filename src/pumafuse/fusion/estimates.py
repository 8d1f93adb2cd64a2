"""The result of a fusion: estimates in the log's coordinates, the outcome of every measurement, and notes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from decimal import Decimal
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from .. import folders
from ..arrays import BoolArray, CodeArray, FloatArray, IndexArray, IntArray, known_rows
from ..errors import RunError, UnknownNameError
from ..filter.outcome import Outcome
from ..logs.frames import CARTESIAN, Placed, in_space
from ..model.arm import ArmModel
from ..units import Kind, nanoseconds
from .config import FusionConfig
from .pose import Pose, covariance_in_log, orientation, turning_covariance
from .score import ReferenceTrack
from .segments import Segment
from .setup import turn_of

if TYPE_CHECKING:
    import pyarrow as pa

Mode = Literal["filtered", "as-live", "smoothed"]


@dataclass(frozen=True, repr=False)
class AxisEstimate:
    """Estimates of one axis in the log's coordinates, SI units, arrays (n,).

    Attributes:
        position: p [m].
        position_sd: Its standard deviation [m].
        velocity: Mean velocity over the coming update period [m/s]; NaN where smoothed.
        velocity_sd: Its standard deviation [m/s].
        offset: o [m], what the model cannot explain.
        offset_sd: Its standard deviation [m].
        disturbance: d [m], which reverts to 0; 0 where the model has none.
        disturbance_sd: Its standard deviation [m].
    """

    position: FloatArray
    position_sd: FloatArray
    velocity: FloatArray
    velocity_sd: FloatArray
    offset: FloatArray
    offset_sd: FloatArray
    disturbance: FloatArray
    disturbance_sd: FloatArray

    FIELDS = tuple(name + sd for name in ("position", "velocity", "offset", "disturbance") for sd in ("", "_sd"))

    def __repr__(self) -> str:
        return f"AxisEstimate({len(self.position):,} of position, velocity, offset, disturbance and their sd)"


@dataclass(frozen=True)
class Bias:
    """A sensor's constant bias on one axis [m], in the log's coordinates, and its standard deviation [m]."""

    value: float
    sd: float


@dataclass(frozen=True, repr=False)
class Measurements:
    """Every component of every sensor used, in the order of processing; arrays are (m,).

    Attributes:
        time: The instant at which the measurement is valid [s since the first command], NaN without a stamp.
        stamp: As logged [s since the first command], NaN without a stamp.
        sensor: Index into ``sensors``.
        axis: Index into ``axes``.
        segment: As in :class:`Estimates`.
        value: As logged [m].
        spread: By what its noise is scaled: as its row tells it, and by the lever of a marker or a frame.
        innovation: One step ahead [m], NaN where the filter did not use the component.
        innovation_sd: Predicted standard deviation of the innovation, √S [m].
        noise_scale: How many times as large as configured the arm's variances were (``adaptation``).
        outcome: An :class:`Outcome` each.
        sensors: Sensor names.
        axes: Axis names.
    """

    time: FloatArray
    stamp: FloatArray
    sensor: IndexArray
    axis: IndexArray
    segment: IndexArray
    value: FloatArray
    spread: FloatArray
    innovation: FloatArray
    innovation_sd: FloatArray
    noise_scale: FloatArray
    outcome: CodeArray
    sensors: tuple[str, ...]
    axes: tuple[str, ...]

    ARRAYS = (
        *("time", "stamp", "sensor", "axis", "segment"),
        *("value", "spread", "innovation", "innovation_sd", "noise_scale", "outcome"),
    )

    def __repr__(self) -> str:
        outcomes = ", ".join(f"{count:,} {word}" for word, count in self.counts().items()) or "none"
        return f"Measurements({', '.join(self.sensors)} on {', '.join(self.axes)}: {outcomes})"

    @property
    def nis(self) -> FloatArray:
        """ν²/S, (m,)."""
        return (self.innovation / self.innovation_sd) ** 2

    def of(self, sensor: str, axis: str) -> Measurements:
        """The components of one sensor on one axis."""
        of_sensor = self.sensor == self.sensors.index(sensor)
        return self.where(np.flatnonzero(of_sensor & (self.axis == self.axes.index(axis))))

    def where(self, chosen: BoolArray | IntArray) -> Measurements:
        """The components that a mask (m,) or their places select."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in self.ARRAYS})

    def counts(self) -> dict[str, int]:
        """The number of components with each outcome, without those that do not occur."""
        numbers = np.bincount(self.outcome, minlength=len(Outcome)).tolist()
        return {outcome.word: numbers[outcome] for outcome in Outcome if numbers[outcome]}


@dataclass(frozen=True, repr=False)
class Estimates:
    """What :func:`pumafuse.fuse` returns. Arrays are (n,), one entry for each estimate.

    Attributes:
        run: The run's name.
        time: [s since the run's first command].
        axes: Estimates by axis; ``est["x"]`` is the short way.
        cartesian: With a frame, the estimates in the log's ``x``, ``y`` and ``z`` [m].
        measurements: Every component with its innovation and outcome.
        biases: By sensor and axis, estimated from all measurements (of the last segment, if there are several).
        reference: The run's reference, where it has one.
        origin: Stamp of the first command, int ns.
        segment: 0, and one more after each time the log's clock was set back.
        segments: The commands of each segment as the filter was given them.
        mode: Which measurements an estimate uses, as :func:`pumafuse.fuse` has it.
        engine: Which engine computed it.
        config: The configuration as used.
        speed: Highest commanded speed for each kind of axis [m/s or rad/s].
        radius: Greatest distance of a command from the base's axis [m]; None without a cylindrical frame.
        command_counts: How many rows of the commands were ``used``, and of the others how many were left out for what.
        counts: How many rows of each sensor were ``fused``, ``rejected``, ``reacquired`` or left out for what; of a row
            of several axes the best that became of any.
        notes: What was noticed, a sentence each.
        since: Where the part of the run that was used begins [s]; None: with the run.
        until: Where it ends [s], likewise.
        rate: Of the even grid of estimates [Hz]; None: one for each command.
        selected: The sensors that were asked for; None: all that are configured.
        placed: The frame in which the axes are, if there is one.
        fitted: Whether the configuration was fitted to this very run, so that the run is no test of it.
        faults: What is wrong with the log of a sensor on an axis, where it is not where the commands lead: a cause of
            :class:`pumafuse.fusion.faults.Fault`.
    """

    run: str
    time: FloatArray
    axes: Mapping[str, AxisEstimate]
    cartesian: Mapping[str, FloatArray] | None
    measurements: Measurements
    biases: Mapping[str, Mapping[str, Bias]]
    reference: ReferenceTrack | None
    origin: int
    segment: IntArray
    segments: tuple[Segment, ...]
    mode: Mode
    engine: str
    config: FusionConfig
    speed: Mapping[Kind, float]
    radius: float | None
    command_counts: Mapping[str, int]
    counts: Mapping[str, Mapping[str, int]]
    notes: tuple[str, ...]
    since: float | None = None
    until: float | None = None
    rate: float | None = None
    selected: tuple[str, ...] | None = None
    placed: Placed | None = None
    fitted: bool = False
    faults: Mapping[tuple[str, str], str] = field(default_factory=dict[tuple[str, str], str])

    def __getitem__(self, axis: str) -> AxisEstimate:
        """The estimates of one axis.

        Raises:
            UnknownNameError: The run has no such axis.
        """
        if axis not in self.axes:
            raise UnknownNameError(f"run '{self.run}'", "axis", str(axis), self.axes)
        return self.axes[axis]

    def __repr__(self) -> str:
        span = f"{self.time[0]:.4g} to {self.time[-1]:.4g} s" if len(self.time) else "no time"
        return f"Estimates({self.run!r}, {self.mode}: {len(self.time):,} of {', '.join(self.axes)}; {span})"

    @property
    def positions(self) -> dict[str, FloatArray]:
        """Positions of each axis [m or rad], (n,)."""
        return {axis: estimate.position for axis, estimate in self.axes.items()}

    @property
    def orientation(self) -> FloatArray | None:
        """Quaternions x, y, z, w of the tool, (n, 4); None without axes rx, ry, rz."""
        return orientation(self.positions, self.config)

    @property
    def turns(self) -> bool:
        """Whether there is a :attr:`pose`."""
        axes = self.axes if self.cartesian is None else self.cartesian
        return set(CARTESIAN) <= axes.keys() and self.orientation is not None

    @cached_property
    def pose(self) -> Pose:
        """Position, quaternion and covariance of the tool.

        Raises:
            RunError: The run has no x, y and z, neither as axes nor by a frame, or no orientation.
        """
        where, turned = f"run '{self.run}'", self.orientation
        position = points(self.positions, self.cartesian, self.config.arm, where, "a pose")
        if turned is None:
            raise RunError(
                f"{where}: a pose needs an orientation: commands that have one, and axes rx, ry, rz of the arm; it has"
                f" {', '.join(self.axes)}"
            )
        sd = {axis: estimate.position_sd for axis, estimate in self.axes.items()}
        covariance = np.zeros((len(self.time), 6, 6))
        covariance[:, :3, :3] = covariance_in_log(self.placed, self.positions, sd)
        covariance[:, 3:, 3:] = turning_covariance(self.positions, sd)
        return Pose(position, turned, covariance)

    def to_arrow(self) -> pa.Table:
        """All estimates as an Arrow table in SI.

        Columns are ``time_s`` since the first command, ``x.position_m`` and so on (``_rad`` of an angle), the log's
        ``x_m``, ``y_m`` and ``z_m`` with a frame, ``qx``, ``qy``, ``qz`` and ``qw`` of a tool that turns, and
        ``segment`` where the clock was set back; null where there is no number, as of smoothed velocities.
        """
        from .results import estimates_table

        return estimates_table(self, files=False)

    def to_pandas(self) -> Any:
        """What :meth:`to_arrow` gives, as a data frame of pandas.

        Raises:
            ImportError: pandas is not installed.
        """
        return self.to_arrow().to_pandas()

    def to_polars(self) -> Any:
        """What :meth:`to_arrow` gives, as a data frame of polars.

        Raises:
            ImportError: polars is not installed.
        """
        import polars  # pyright: ignore  (not among what is installed with pumafuse)

        return polars.from_arrow(self.to_arrow())  # pyright: ignore

    def save(self, folder: str | Path, *, force: bool = False) -> None:
        """Write a result folder, complete or not at all: what ``pumafuse fuse -o`` writes and ``compare`` reads.

        Args:
            folder: Where to; its parents are made.
            force: Replace an earlier result there.

        Raises:
            FolderError: There is something that must not be replaced, or the disk refuses.
        """
        from .results import write

        write(self, Path(folder), force)

    def to_tum(self, path: str | Path) -> None:
        """Write the trajectory in the TUM format, which ``evo`` reads: a line ``stamp x y z qx qy qz qw`` an estimate.

        Stamps are those of the log's clock [s], with all digits; positions are in m; without axes rx, ry, rz the
        quaternion is ``0 0 0 1``.

        Args:
            path: The file; an earlier one is replaced.

        Raises:
            RunError: The run has no x, y and z, neither as axes nor by a frame; or its clock was set back.
            FolderError: The file cannot be written.
        """
        track = ReferenceTrack(self.time, self.positions, {}, self.segment, self.cartesian)
        write_tum(track, self.config, self.origin, f"run '{self.run}'", Path(path))

    def measured_positions(self, sensor: str, axis: str) -> Measurements:
        """A sensor's components with positions for values [m]: (z − estimated bias) / scale; none if not configured."""
        measurements = self.measurements.of(sensor, axis)
        if sensor not in self.config.sensors:
            return measurements.where(np.zeros(len(measurements.value), dtype=bool))
        bias = self.biases.get(sensor, {}).get(axis)
        position = measurements.value if bias is None else measurements.value - bias.value
        configured, turn = self.config.sensors[sensor], turn_of(self.config, sensor, axis)
        position = position / configured.scale
        if turn:  # the nearest to the estimate
            turn /= abs(configured.scale)
            away = position - np.interp(measurements.time, self.time, self[axis].position)
            position = position - turn * np.round(away / turn)
        return replace(measurements, value=position)

    def busiest(self, length: float) -> tuple[float, float]:
        """Start and end of the interval of ``length`` with the most motion [s]; every axis has the same weight."""
        return busiest(self.time, self.positions, length)


def busiest(time: FloatArray, positions: Mapping[str, FloatArray], length: float) -> tuple[float, float]:
    """Start and end of the interval of a length in which positions at times (n,) move most [s], as a share of all."""
    travelled = np.zeros(len(time))
    for position in positions.values():
        steps = np.abs(np.diff(position, prepend=position[0]))
        travelled += np.cumsum(steps) / max(float(steps.sum()), 1e-12)
    ends = np.minimum(np.searchsorted(time, time + length), len(time) - 1)
    start = float(time[np.argmax(travelled[ends] - travelled)])
    return start, start + length


def points(
    position: Mapping[str, FloatArray], cartesian: Mapping[str, FloatArray] | None, arm: ArmModel, where: str, what: str
) -> FloatArray:
    """Positions in space [m], (n, 3), of axes x, y, z or of a frame's x, y and z; errors say ``where`` and ``what``."""
    tool = position if cartesian is None and in_space(arm) == CARTESIAN else cartesian or {}
    if not all(name in tool for name in CARTESIAN):
        raise RunError(
            f"{where}: {what} needs x, y and z, as axes of the arm or by a [frame]; there are only"
            f" {', '.join(tool or position)}"
        )
    return np.column_stack([tool[name] for name in CARTESIAN])


def write_tum(track: ReferenceTrack, config: FusionConfig, origin: int, where: str, path: Path) -> None:
    """Write whole rows as a trajectory in the TUM format, see :meth:`Estimates.to_tum`; of a stamp the first."""
    row = points(track.position, track.cartesian, config.arm, where, "a trajectory")
    if track.segment.any():
        raise RunError(f"{where}: the log's clock was set back, so that it is no one trajectory; use --from and --to")
    turned = orientation(track.position, config)
    if turned is not None:
        row = np.column_stack([row, turned])
    stamp, row = known_rows(origin + nanoseconds(track.time), row)
    unturned = " 0 0 0 1" if turned is None else ""
    lines = (
        f"{Decimal(ns).scaleb(-9):f} {' '.join(map(repr, numbers))}{unturned}\n"
        for ns, numbers in zip(stamp.tolist(), row.tolist(), strict=True)
    )
    folders.write_file(path, "".join(lines))
