"""Result folders: the files that ``fuse`` writes and ``compare`` reads, in mm or degrees, and s."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pyarrow as pa

from .. import folders
from ..arrays import FloatArray, IndexArray, IntArray
from ..errors import RunError
from ..filter.outcome import Outcome
from ..folders import FolderError
from ..logs import manifest, tables
from ..logs.clock import segments
from ..logs.frames import CARTESIAN
from ..logs.run import Run
from ..logs.tables import Table
from ..model.arm import ArmModel
from ..units import AN, KINDS, SCREEN, SI, Kind, Screen, kind_of, of_kind, seconds
from .config import ARM_FILE, ROBOT_FILE, FusionConfig
from .engine import Engine
from .estimates import AxisEstimate, Estimates, Mode
from .placing import in_base
from .pose import orientation, relative_to
from .score import OrientationScore, ReferenceTrack, reference_track, score_orientation
from .summary import ScoreSummary, Summary, decode, encode, score_axis, summarise

ESTIMATES, MEASUREMENTS, REFERENCE = "estimates.parquet", "measurements.parquet", "reference.parquet"
SUMMARY, _LOG = "summary.json", "log.json"
_FILES = {ESTIMATES, MEASUREMENTS, REFERENCE, SUMMARY, _LOG, "fusion.toml", ARM_FILE, ROBOT_FILE} | {
    *("fused.rrd", "fused.png", "error.png", "validation.png", "path.png")
}  # a folder with anything else in it is never replaced
_RUN = "run.toml"
_REFERENCE_PREFIX = "reference."
_QUATERNION = ("qx", "qy", "qz", "qw")
_FUSE_AGAIN = "fuse the run again"


@dataclass(frozen=True)
class Result:
    """The parts of a result folder that a comparison needs."""

    summary: Summary  # its ``summary.json``
    config: FusionConfig  # its ``fusion.toml`` and ``arm.toml``
    time: FloatArray  # [s since the first command], (n,)
    segment: IntArray  # (n,)
    axes: Mapping[str, AxisEstimate]
    cartesian: Mapping[str, FloatArray] | None  # with a frame, the estimates in the log's ``x``, ``y`` and ``z`` [m]
    reference: ReferenceTrack | None  # its ``reference.parquet``, if there is one

    def positions(self, config: FusionConfig) -> dict[str, FloatArray]:
        """Positions by axis [m or rad], (n,); rx, ry, rz relative to the reference orientation of ``config``."""
        position = {axis: estimate.position for axis, estimate in self.axes.items()}
        turned = orientation(position, self.config) if config.tool != self.config.tool else None
        return position if turned is None else position | relative_to(turned, config)

    @property
    def track(self) -> ReferenceTrack:
        """The estimates as positions in time."""
        return ReferenceTrack(self.time, self.positions(self.config), {}, self.segment, self.cartesian)

    def scores(self, reference: ReferenceTrack) -> dict[str, ScoreSummary]:
        """The score of each axis that the reference has."""
        period = self.config.arm.update_period
        by_axis = {
            axis: score_axis(self.time, self.segment, estimate, reference, axis, period)
            for axis, estimate in self.axes.items()
        }
        return {axis: value for axis, value in by_axis.items() if value is not None}

    def orientation_score(self, reference: ReferenceTrack) -> OrientationScore | None:
        """The score of the axes rx, ry, rz together, where the reference has them."""
        sd = {axis: estimate.position_sd for axis, estimate in self.axes.items()}
        return score_orientation(self.time, self.segment, self.positions(self.config), sd, reference)


def check_writable(folder: Path, force: bool, with_run: bool = False) -> None:
    """Refuse a folder that :func:`write` must not replace, before any work is done: FolderError.

    One with a ``run.toml``, which is then written anew, is a result only ``with_run``.
    """
    ours = _FILES | {_RUN} if with_run else _FILES
    folders.check_writable(folder, force, [SUMMARY], ours.__contains__)


@dataclass(frozen=True)
class Recipe:
    """All that makes results differ, but for the log."""

    config: FusionConfig
    sensors: Sequence[str] | None = None  # those that are asked for; None: all
    rate: float | None = None  # of the even grid of estimates [Hz]; None: one for each command
    mode: Mode = "filtered"
    engine: Engine = "compiled"
    part: tuple[float | None, float | None] = None, None  # where the part of the run to use begins and ends [s]
    extras: Sequence[str] = ()  # files that are made beside the usual ones

    @property
    def selected(self) -> tuple[str, ...] | None:
        """The sensors that are asked for, in the order of the configuration."""
        return None if self.sensors is None else self.config.sensor_names(self.sensors)

    def read_summary(self, folder: Path, log: Path) -> Summary | None:
        """The summary of a result that is there and was made so from the log as it is; None where nothing is."""
        if not folder.is_dir() or not any(folder.iterdir()):
            return None
        check_writable(folder, force=True)
        summary = _summary(folder)
        differs = {
            f"pumafuse {summary.pumafuse}": summary.pumafuse != version("pumafuse"),
            "another fusion.toml": (folder / "fusion.toml").read_text(encoding="utf-8") != self.config.to_toml(),
            "another arm.toml": (folder / "arm.toml").read_text(encoding="utf-8") != self.config.arm.to_toml(),
            "another mode": (summary.mode, summary.engine) != (self.mode, self.engine),
            "another --rate": summary.rate_hz != self.rate,
            "other --sensors": summary.sensors != (self.selected and list(self.selected)),
            "another --from or --to": (summary.from_s, summary.to_s) != self.part,
            **{f"no {name}": not (folder / name).exists() for name in self.extras},
            "other files of the run": not (now := manifest.stamps_of(log)) or _stamps(folder) != now,
        }
        if how := next((how for how, holds in differs.items() if holds), None):
            raise FolderError(
                f"{folder}: an earlier result, with {how}; --resume keeps results that are made alike: choose another"
                " folder, or use --force, which makes all anew"
            )
        return summary


def write_stamps(folder: Path, stamps: Mapping[str, tuple[int, int]]) -> None:
    """Write of which files a result was made, for :meth:`Recipe.read_summary`; ``stamps`` are of before."""
    (folder / _LOG).write_bytes(msgspec.json.format(msgspec.json.encode(stamps)) + b"\n")


def _stamps(folder: Path) -> dict[str, tuple[int, int]]:
    try:
        return msgspec.json.decode((folder / _LOG).read_bytes(), type=dict[str, tuple[int, int]])
    except (OSError, msgspec.MsgspecError):
        return {}


def check_fused(counts: Mapping[str, Mapping[str, int]], config: FusionConfig) -> None:
    """Refuse a fusion of nothing, with what became of all rows."""
    if any(count.get(outcome.word) for count in counts.values() for outcome in (Outcome.FUSED, Outcome.REACQUIRED)):
        return
    rows = [
        f"'{name}' has {', '.join(f'{count} {word}' for word, count in of_sensor.items()) or 'no rows'}"
        for name, of_sensor in counts.items()
    ]
    absent = [f"'{name}' of fusion.toml is not in the run" for name in config.sensors if name not in counts]
    why = "; ".join([*rows, *absent]) or "neither the run nor fusion.toml has a sensor"
    raise RunError(f"nothing was fused, nothing is written: {why}")


def write(
    est: Estimates, folder: Path, force: bool, extras: Callable[[Path], None] | None = None, run_toml: str | None = None
) -> Summary:
    """Write a result folder: complete, or not at all; with what ``extras`` write, and the ``run.toml`` of a run."""
    check_writable(folder, force, run_toml is not None)
    summary = summarise(est)
    with folders.replacing(folder) as new:
        tables.write(estimates_table(est), new / ESTIMATES)
        tables.write(measurements_table(est), new / MEASUREMENTS)
        if est.reference is not None:
            tables.write(reference_table(est.reference, est.config), new / REFERENCE)
        est.config.save(new)
        (new / SUMMARY).write_bytes(encode(summary))
        if run_toml is not None:
            (new / _RUN).write_text(run_toml, encoding="utf-8")
        if extras is not None:
            extras(new)
    return summary


def read(folder: Path) -> Result:
    """Read a result folder."""
    summary = _summary(folder)
    config, table = FusionConfig.load(folder / "fusion.toml"), tables.read(folder / ESTIMATES)
    axes = {
        axis: AxisEstimate(*(_plain(table, axis, name, part.kind) for name in AxisEstimate.FIELDS))
        for axis, part in summary.axes.items()
    }
    time, segment = _time_and_segment(table)
    _check_unchanged(folder / ESTIMATES, time, segment, axes)
    path = folder / REFERENCE
    reference = _own_reference(tables.read(path), config) if path.exists() else None
    return Result(summary, config, time, segment, axes, _cartesian(table), reference)


def _summary(folder: Path) -> Summary:
    try:
        return decode((folder / SUMMARY).read_bytes())
    except (OSError, msgspec.MsgspecError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        advice = "give the folder of its --output"
        raise FolderError(f"{folder}: no result folder of `pumafuse fuse` ({SUMMARY}: {why}); {advice}") from None


def _check_unchanged(path: Path, time: FloatArray, segment: IntArray, axes: Mapping[str, AxisEstimate]) -> None:
    """Refuse estimates that were changed: a comparison would take them for what they are not."""
    if not len(time) or not axes:
        raise FolderError(f"{path}: no estimates; {_FUSE_AGAIN}")
    within = np.diff(segment) == 0
    if not np.isfinite(time).all() or (np.diff(time)[within] < 0.0).any() or (np.diff(segment) < 0).any():
        raise FolderError(f"{path}: time_s is not ascending: the file was changed; {_FUSE_AGAIN}")
    for axis, estimate in axes.items():
        if not np.isfinite([estimate.position, estimate.position_sd]).all():
            raise FolderError(f"{path}: positions of '{axis}' are missing: the file was changed; {_FUSE_AGAIN}")


def read_reference(path: Path, origin: int, config: FusionConfig) -> ReferenceTrack:
    """A reference from elsewhere, in the time of a result.

    That is a recorded run with a reference; or a table with ``time_s`` (the log's clock) and ``reference.<axis>_mm``;
    or one with ``time_s`` (since the first command) and ``<axis>.position_mm``, as in a result folder.
    """
    if path.is_dir() or path.suffix == ".toml":
        run = in_base(Run.read(path), config)[0]
        parts = [part.reference for part in segments(run)[0] if part.reference is not None]
        if not parts:
            raise RunError(f"{path}: the run has no reference; [reference] in run.toml names its file")
        for axis in set(run.kinds) & set(config.arm.axes):
            _check_kind(path, axis, run.kinds[axis], config.arm)
        return reference_track(parts, origin)
    table = tables.read(path)
    logged = [name for name in table.columns if name.startswith(_REFERENCE_PREFIX)]
    if not logged:
        return _own_reference(table, config)
    time = seconds(table.stamps("time_s")[0], origin)
    columns = {name[len(_REFERENCE_PREFIX) : name.rindex("_")]: name for name in logged}
    position = {axis: _numbers(table, axis, name, config.arm) for axis, name in columns.items()}
    exact = {axis: np.zeros(len(time)) for axis in position}
    return ReferenceTrack(time, position, exact, np.zeros(len(time), dtype=np.int64))


def estimates_table(est: Estimates, *, files: bool = True) -> pa.Table:
    """The estimates as a table, in the units of files (mm or degrees) or in SI (m or rad); null where there is none."""
    columns: dict[str, pa.Array] = {}
    for axis, estimate in est.axes.items():
        screen = est.config.arm.screen_of(axis) if files else SI[est.config.arm.axes[axis].kind]
        for name in AxisEstimate.FIELDS:
            unit = f"{screen.unit}_s" if name.startswith("velocity") else screen.unit
            columns[f"{axis}.{name}_{unit}"] = _column_of(getattr(estimate, name) * screen.scale)
    in_log = _in_log(est.cartesian, SCREEN["length"] if files else SI["length"])
    turned = _quaternion_columns(est.orientation)
    return pa.table({"time_s": _column_of(est.time), **columns, **in_log, **turned, **_segment_column(est.segment)})


def measurements_table(est: Estimates) -> pa.Table:
    """Every component of every measurement as a table, in the units of files."""
    r, positions = est.measurements, dict[str, pa.Array]()
    kinds = est.config.arm.kind_of
    kinds_seen: dict[Kind, None] = {kinds[axis]: None for axis in r.axes}
    for kind in kinds_seen:  # columns for each: null on axes of the other
        of_kind, screen = np.array([kinds[axis] == kind for axis in r.axes])[r.axis], SCREEN[kind]
        for name in ("value", "innovation", "innovation_sd"):
            positions[f"{name}_{screen.unit}"] = _column_of(np.where(of_kind, getattr(r, name) * screen.scale, np.nan))
    return pa.table(
        {
            "time_s": _column_of(r.time),
            "stamp_s": _column_of(r.stamp),
            "sensor": _names(r.sensor, r.sensors),
            "axis": _names(r.axis, r.axes),
            **positions,
            "nis": _column_of(r.nis),
            "noise_scale": _column_of(r.noise_scale),
            "outcome": _names(r.outcome, [outcome.word for outcome in Outcome]),
            **_segment_column(r.segment),
        }
    )


def reference_table(reference: ReferenceTrack, config: FusionConfig) -> pa.Table:
    """The reference as a table, in the units of files."""
    columns, arm = {"time_s": _column_of(reference.time)}, config.arm
    for axis, position in reference.position.items():
        kind = arm.axes[axis].kind if axis in arm.axes else "length"  # x, y and z
        columns[_column(axis, "position", kind)] = _column_of(position * SCREEN[kind].scale)
        columns[_column(axis, "position_sd", kind)] = _column_of(reference.sd[axis] * SCREEN[kind].scale)
    turned = _quaternion_columns(orientation(reference.position, config))
    return pa.table({**columns, **_in_log(reference.cartesian), **turned, **_segment_column(reference.segment)})


def _in_log(cartesian: Mapping[str, FloatArray] | None, screen: Screen = SCREEN["length"]) -> dict[str, pa.Array]:
    """Columns of the log's x, y and z; none without a frame."""
    return {f"{name}_{screen.unit}": _column_of(x * screen.scale) for name, x in (cartesian or {}).items()}


def _quaternion_columns(quaternion: FloatArray | None) -> dict[str, pa.Array]:
    """Columns of an orientation; none of a tool that does not turn."""
    return {} if quaternion is None else dict(zip(_QUATERNION, map(_column_of, quaternion.T), strict=True))


def _cartesian(table: Table) -> dict[str, FloatArray] | None:
    """The log's x, y and z [m] that a table has; None without any."""
    return {name: table.numbers(f"{name}_mm")[0] for name in CARTESIAN if f"{name}_mm" in table.columns} or None


def _own_reference(table: Table, config: FusionConfig) -> ReferenceTrack:
    position, noise = dict[str, FloatArray](), dict[str, FloatArray]()
    for kind in KINDS:
        ending = _column("", "position", kind)
        for name in table.columns:
            if name.endswith(ending):
                axis = name.removesuffix(ending)
                position[axis] = _numbers(table, axis, name, config.arm)
                sd = _column(axis, "position_sd", kind)
                noise[axis] = table.numbers(sd)[0] if sd in table.columns else np.zeros(table.rows)
    if not position:
        raise RunError(
            f"{table.path}: no column 'reference.<axis>_mm' or '<axis>.position_mm' (for an angle: _deg); it has:"
            f" {', '.join(table.columns)}"
        )
    if set(_QUATERNION) <= set(table.columns):  # its rx, ry, rz may be relative to another orientation
        position |= relative_to(np.column_stack([table.plain(name)[0] for name in _QUATERNION]), config)
    time, segment = _time_and_segment(table)
    return ReferenceTrack(time, position, noise, segment, _cartesian(table))


def _numbers(table: Table, axis: str, column: str, arm: ArmModel) -> FloatArray:
    """A column of positions of an axis [m or rad]."""
    numbers = table.numbers(column)[0]
    if axis in arm.axes:
        _check_kind(table.path, axis, kind_of(column) or "length", arm)
    return numbers


def _check_kind(path: Path, axis: str, kind: Kind, arm: ArmModel) -> None:
    if arm.axes[axis].kind != kind:
        differ = f"{AN[kind]} there, but {AN[arm.axes[axis].kind]} in the result"
        raise RunError(f"{path}: {axis} is {differ}; give another reference")


def _column(axis: str, name: str, kind: Kind) -> str:
    """The column of an :class:`AxisEstimate`'s array: ``x.velocity_sd_mm_s``."""
    return of_kind(f"{axis}.{name}_mm_s" if name.startswith("velocity") else f"{axis}.{name}_mm", kind)


def _plain(table: Table, axis: str, name: str, kind: Kind) -> FloatArray:
    """An array of an :class:`AxisEstimate`."""
    return table.plain(_column(axis, name, kind))[0] / SCREEN[kind].scale


def _names(index: npt.NDArray[np.integer[Any]], names: Sequence[str]) -> pa.Array:
    """The name of each index as a column of text."""
    texts = [name.encode() for name in names]
    ends = np.cumsum([0, *map(len, texts)], dtype=np.int32)
    words = pa.StringArray.from_buffers(len(texts), pa.py_buffer(ends), pa.py_buffer(b"".join(texts)))
    return pa.DictionaryArray.from_arrays(_column_of(index.astype(np.int32)), words).cast(pa.string())


def _time_and_segment(table: Table) -> tuple[FloatArray, IntArray]:
    time = seconds(table.stamps("time_s")[0])
    if "segment" not in table.columns:
        return time, np.zeros(table.rows, dtype=np.int64)
    segment, _ = table.plain("segment")
    if not np.isfinite(segment).all():
        raise RunError(f"{table.path}: segment is not a whole number in every row; fill it, or leave the column out")
    return time, segment.astype(np.int64)


def _segment_column(segment: IntArray | IndexArray) -> dict[str, pa.Array]:
    """A column only where the log's clock was set back: most runs are one segment."""
    return {"segment": _column_of(segment)} if segment.any() else {}


def _column_of(values: npt.NDArray[Any]) -> pa.Array:
    """Numbers as a column, NaN as null.

    ``pa.array`` would import pandas wherever there is one, which takes longer than to fuse.
    """
    is_known = ~np.isnan(values)
    bits = None if is_known.all() else pa.py_buffer(np.packbits(is_known, bitorder="little"))
    return pa.Array.from_buffers(
        pa.from_numpy_dtype(values.dtype), len(values), [bits, pa.py_buffer(np.ascontiguousarray(values))]
    )
