"""The result folder of a long run, written as it is fused."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as papq

from .. import folders
from ..errors import PumafuseWarning, RunError
from ..filter.outcome import Outcome
from ..fusion import results
from ..fusion.config import FusionConfig
from ..fusion.offline import NOT_COVERED
from ..fusion.score import ReferenceTrack
from ..fusion.summary import Summary, encode, summarise
from .fusing import Part, parts
from .merging import merged
from .reading import rows_of

MOST_IN_MEMORY = 10_000_000  # rows of a run that is fused as a whole
_NUMBER = re.compile(r"[-+]?\d[\d.,e%+-]*")


def is_long(path: Path) -> bool:
    """Whether a run goes through the filter in pieces: of Parquet, with more rows than are fused as a whole."""
    rows = rows_of(path)
    return rows is not None and rows > MOST_IN_MEMORY


def fuse_in_pieces(
    path: Path,
    config: FusionConfig,
    folder: Path,
    *,
    sensors: Iterable[str] | None = None,
    rate: float | None = None,
    force: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Summary:
    """Fuse a long run in bounded memory: filtered estimates, written as they are made.

    Args:
        path: As of :meth:`pumafuse.Run.read`; its tables are Parquet.
        config: Arm, noise and sensors.
        folder: Where to; it is complete or not there.
        sensors: Which of the configured sensors to use; all for None.
        rate: Estimates on an even grid [Hz]; one for each command for None.
        force: Replace an earlier result.
        progress: Called after each piece with the share done, 0 to 1.

    Warns:
        PumafuseWarning: For each note.

    Raises:
        PumafuseError: Run and configuration do not fit together, the run cannot be fused in pieces, nothing was fused,
            or the folder cannot be written.
    """
    results.check_writable(folder, force)
    with folders.replacing(folder) as new:
        summary = _written(parts(path, config, sensors, rate), config, new, progress)
        config.save(new)
        (new / results.SUMMARY).write_bytes(encode(summary))
    for note in summary.notes:
        warnings.warn(f"run '{summary.run}': {note}", PumafuseWarning, stacklevel=2)
    return summary


def _written(
    of_run: Iterable[Part], config: FusionConfig, folder: Path, progress: Callable[[float], None] | None
) -> Summary:
    """Write the tables of all parts, one after the other; what they say together."""
    summaries, notes, ends, biases = list[Summary](), _Notes(), list[float](), None
    with ExitStack() as open_files:
        tables = _Tables(folder, open_files)
        for part in of_run:
            est = part.est
            tables.add(results.ESTIMATES, results.estimates_table(est))
            tables.add(results.MEASUREMENTS, results.measurements_table(est))
            if est.reference is not None:
                own = _between(est.reference, *part.within)
                tables.add(results.REFERENCE, results.reference_table(own, config.arm))
            notes.add(est.notes, part.within)
            summaries.append(summarise(est))
            ends += [float(one) for one in est.time[[0, -1]]] if len(est.time) else []
            biases = part.biases
            if progress is not None:
                progress(part.share)
    summary = merged(summaries, config, biases or {}, ends[-1] - ends[0] if ends else 0.0)
    if not any({Outcome.FUSED.word, Outcome.REACQUIRED.word} & rows.keys() for rows in summary.rows.values()):
        raise RunError(f"nothing was fused, nothing is written: {_in_words(summary) or 'the run has no sensor'}")
    said = notes.sentences()
    if tables.has(results.REFERENCE) and not any(axis.score for axis in summary.axes.values()):
        said.append(NOT_COVERED)
    said.append(
        f"fused in {len(summaries)} pieces: medians of the errors of predictions, and correlations of innovations, are"
        " means of those of the pieces"
    )
    return msgspec.structs.replace(summary, notes=said)


def _in_words(summary: Summary) -> str:
    """What became of the rows of each sensor."""
    return "; ".join(
        f"'{name}' has {', '.join(f'{count} {word}' for word, count in rows.items()) or 'no rows'}"
        for name, rows in summary.rows.items()
    )


class _Tables:
    """Parquet files to which tables are added."""

    def __init__(self, folder: Path, open_files: ExitStack) -> None:
        self._folder, self._open_files, self._writers = folder, open_files, dict[str, papq.ParquetWriter]()

    def has(self, name: str) -> bool:
        """Whether anything was added to a file."""
        return name in self._writers

    def add(self, name: str, table: pa.Table) -> None:
        """Add rows to a file of the folder."""
        if name not in self._writers:
            writer = papq.ParquetWriter(str(self._folder / name), table.schema, compression="zstd")
            self._writers[name] = self._open_files.enter_context(writer)
        self._writers[name].write_table(table)


@dataclass
class _Note:
    """A sentence as the first piece has it, where that is [s], how many have it, and whether all in the same words."""

    sentence: str
    within: tuple[float, float]
    pieces: int = 0
    same: bool = True


class _Notes:
    """Sentences of pieces, each once: those that differ in numbers alone are the same."""

    def __init__(self) -> None:
        self._found, self._pieces = dict[str, _Note](), 0

    def add(self, sentences: Iterable[str], within: tuple[float, float]) -> None:
        """Add those of the next piece."""
        self._pieces += 1
        for sentence in dict.fromkeys(sentences):
            known = self._found.setdefault(_NUMBER.sub("#", sentence), _Note(sentence, within))
            known.pieces += 1
            known.same &= known.sentence == sentence

    def sentences(self) -> list[str]:
        """A sentence each, with the part of the run that it is about."""
        return [self._of_run(one) for one in self._found.values()]

    def _of_run(self, note: _Note) -> str:
        if note.same and note.pieces == self._pieces:
            return note.sentence
        begin, end = note.within
        others = f", and others like it in {note.pieces - 1} more parts" if note.pieces > 1 else ""
        return f"{note.sentence} (in the part from {max(begin, 0.0):.0f} to {end:.0f} s{others})"


def _between(track: ReferenceTrack, after: float, until: float) -> ReferenceTrack:
    """The rows of a reference after a time and until another one [s]."""
    mine = (track.time > after) & (track.time <= until)

    def of(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {name: column[mine] for name, column in columns.items()}

    cartesian = None if track.cartesian is None else of(dict(track.cartesian))
    return ReferenceTrack(
        track.time[mine], of(dict(track.position)), of(dict(track.sd)), track.segment[mine], cartesian
    )
