"""Result folders: the files that ``fuse`` writes and ``compare`` reads, in mm and s."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pyarrow as pa

from .. import folders
from ..arrays import FloatArray, IntArray
from ..errors import RunError
from ..filter.outcome import Outcome
from ..folders import FolderError
from ..logs import tables
from ..logs.axes import in_axes
from ..logs.clock import segments
from ..logs.frames import Frame
from ..logs.run import Run
from ..logs.tables import Table
from ..units import MM, seconds
from .config import FusionConfig
from .estimates import AxisEstimate, Estimates
from .score import ReferenceTrack, reference_track
from .summary import ScoreSummary, Summary, score_axis, summarise

ESTIMATES, MEASUREMENTS, REFERENCE = "estimates.parquet", "measurements.parquet", "reference.parquet"
SUMMARY = "summary.json"
_FILES = {ESTIMATES, MEASUREMENTS, REFERENCE, SUMMARY, "fusion.toml", "arm.toml"} | {
    "fused.rrd",
    "fused.png",
    "error.png",
    "validation.png",
}  # a folder with anything else in it is never replaced
_REFERENCE_PREFIX = "reference."


@dataclass(frozen=True)
class Result:
    """The parts of a result folder that a comparison needs.

    Attributes:
        summary: Its ``summary.json``.
        config: Its ``fusion.toml`` and ``arm.toml``.
        time: [s since the first command], (n,).
        segment: (n,).
        axes: Estimates by axis.
        reference: Its ``reference.parquet``, if there is one.
    """

    summary: Summary
    config: FusionConfig
    time: FloatArray
    segment: IntArray
    axes: Mapping[str, AxisEstimate]
    reference: ReferenceTrack | None

    def scores(self, reference: ReferenceTrack) -> dict[str, ScoreSummary]:
        """The score of each axis that the reference has."""
        period = self.config.arm.update_period
        found = {
            axis: score_axis(self.time, self.segment, estimate, reference, axis, period)
            for axis, estimate in self.axes.items()
        }
        return {axis: value for axis, value in found.items() if value is not None}


def check_writable(folder: Path, force: bool) -> None:
    """Refuse a folder that :func:`write` must not replace, before any work is done.

    Raises:
        FolderError: The folder exists and is not to be replaced, or holds something else than results.
    """
    folders.check_writable(folder, force, [SUMMARY], _FILES.__contains__)


def write(est: Estimates, folder: Path, force: bool, extras: Callable[[Path], None] | None = None) -> Summary:
    """Write a result folder: complete, or not at all.

    Args:
        est: What to write.
        folder: Where to; its parents are made.
        force: Replace an earlier result.
        extras: Writes more files into the folder before it takes its place.

    Raises:
        FolderError: See :func:`check_writable`, or the disk refuses.
    """
    check_writable(folder, force)
    summary = summarise(est)
    with folders.replacing(folder) as new:
        tables.write(_estimates_table(est), new / ESTIMATES)
        tables.write(_measurements_table(est), new / MEASUREMENTS)
        if est.reference is not None:
            tables.write(_reference_table(est.reference), new / REFERENCE)
        est.config.save(new)
        (new / SUMMARY).write_bytes(msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n")
        if extras is not None:
            extras(new)
    return summary


def read(folder: Path) -> Result:
    """Read a result folder.

    Raises:
        PumafuseError: It is none, or one of its files is damaged.
    """
    try:
        summary = msgspec.json.decode((folder / SUMMARY).read_bytes(), type=Summary)
    except (OSError, msgspec.MsgspecError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise FolderError(f"{folder}: no result folder of `pumafuse fuse` ({SUMMARY}: {why})") from None
    config, table = FusionConfig.load(folder / "fusion.toml"), tables.read(folder / ESTIMATES)
    axes = {
        axis: AxisEstimate(*(table.plain(_column(axis, name))[0] / MM for name in AxisEstimate.FIELDS))
        for axis in summary.axes
    }
    path = folder / REFERENCE
    reference = _own_reference(tables.read(path)) if path.exists() else None
    return Result(summary, config, *_time_and_segment(table), axes, reference)


def read_reference(path: Path, origin: int, frame: Frame | None = None) -> ReferenceTrack:
    """A reference from elsewhere, in the time of a result.

    Args:
        path: A recorded run with a reference; or a table with ``time_s`` (the log's clock) and ``reference.<axis>_mm``;
            or one with ``time_s`` (since the first command) and ``<axis>.position_mm``, as in a result folder.
        origin: Stamp of the result's first command, int ns.
        frame: For a run in x, y, z that brings no frame of its own.

    Raises:
        PumafuseError: It is none of these.
    """
    if path.is_dir() or path.suffix == ".toml":
        run, _ = in_axes(Run.read(path), frame)
        parts = [part.reference for part in segments(run)[0] if part.reference is not None]
        if not parts:
            raise RunError(f"{path}: the run has no reference")
        return reference_track(parts, origin)
    table = tables.read(path)
    logged = [name for name in table.columns if name.startswith(_REFERENCE_PREFIX)]
    if not logged:
        return _own_reference(table)
    time = seconds(table.stamps("time_s")[0], origin)
    position = {name[len(_REFERENCE_PREFIX) : name.rindex("_")]: table.numbers(name)[0] for name in logged}
    exact = {axis: np.zeros(len(time)) for axis in position}
    return ReferenceTrack(time, position, exact, np.zeros(len(time), dtype=np.int64))


def _estimates_table(est: Estimates) -> pa.Table:
    columns = {
        _column(axis, name): _nullable(getattr(estimate, name) * MM)
        for axis, estimate in est.axes.items()
        for name in AxisEstimate.FIELDS
    }
    columns |= {f"{name}_mm": _nullable(position * MM) for name, position in (est.cartesian or {}).items()}
    return pa.table({"time_s": est.time, **columns, **_segment_column(est.segment)})


def _measurements_table(est: Estimates) -> pa.Table:
    r = est.measurements
    return pa.table(
        {
            "time_s": _nullable(r.time),
            "stamp_s": _nullable(r.stamp),
            "sensor": _names(r.sensor, r.sensors),
            "axis": _names(r.axis, r.axes),
            "value_mm": _nullable(r.value * MM),
            "innovation_mm": _nullable(r.innovation * MM),
            "innovation_sd_mm": _nullable(r.innovation_sd * MM),
            "nis": _nullable(r.nis),
            "outcome": _names(r.outcome, [outcome.word for outcome in Outcome]),
            **_segment_column(r.segment),
        }
    )


def _reference_table(reference: ReferenceTrack) -> pa.Table:
    columns: dict[str, pa.Array | FloatArray] = {"time_s": reference.time}
    for axis, position in reference.position.items():
        columns[_column(axis, "position")] = _nullable(position * MM)
        columns[_column(axis, "position_sd")] = reference.sd[axis] * MM
    return pa.table({**columns, **_segment_column(reference.segment)})


def _own_reference(table: Table) -> ReferenceTrack:
    ending = _column("", "position")
    axes = [name.removesuffix(ending) for name in table.columns if name.endswith(ending)]
    if not axes:
        raise RunError(
            f"{table.path}: no column 'reference.<axis>_mm' or '<axis>{ending}'; it has: {', '.join(table.columns)}"
        )
    position, noise = (
        {axis: table.numbers(column)[0] for axis in axes if (column := _column(axis, name)) in table.columns}
        for name in ("position", "position_sd")
    )
    time, segment = _time_and_segment(table)
    return ReferenceTrack(time, position, {axis: np.zeros(table.rows) for axis in axes} | noise, segment)


def _column(axis: str, name: str) -> str:
    """The column of an :class:`AxisEstimate`'s array: ``radial.velocity_sd_mm_s``."""
    return f"{axis}.{name}_mm_s" if name.startswith("velocity") else f"{axis}.{name}_mm"


def _names(index: npt.NDArray[np.integer[Any]], names: Sequence[str]) -> pa.Array:
    """The name of each index as a column of text."""
    return pa.DictionaryArray.from_arrays(index.astype(np.int32), list(names)).cast(pa.string())


def _time_and_segment(table: Table) -> tuple[FloatArray, IntArray]:
    time = seconds(table.stamps("time_s")[0])
    if "segment" not in table.columns:
        return time, np.zeros(table.rows, dtype=np.int64)
    return time, table.columns["segment"].to_numpy().astype(np.int64)


def _segment_column(segment: IntArray) -> dict[str, IntArray]:
    """A column only where the log's clock was set back: most runs are one segment."""
    return {"segment": segment} if segment.any() else {}


def _nullable(values: FloatArray) -> pa.Array:
    return pa.array(values, from_pandas=True)
