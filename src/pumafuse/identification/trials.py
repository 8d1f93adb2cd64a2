"""Step trials as recorded: what each was, and how the tool moved."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray
from ..errors import PumafuseError, RunError
from ..logs import tables
from ..units import KINDS, OF_KIND, SPEEDS, Kind, ending, seconds, si_of

FEWEST_SAMPLES = 8  # samples from the step on: a second-order fit with delay, gain and zero has five unknowns
_AGREE = 0.03  # relative difference of step over speed between trials that is still one update period
_PERIODS = (0.001, 0.2)  # s, range of an update period found from the trials
_GIVEN = (1e-4, 10.0)  # s, range of an update period given by the user
_LATEST, _FARTHEST = 3600.0, 1e6  # s and m or rad that a sample can be away from its command and from 0
_SHOWN = 4  # sentences in the line of an error
_STEPS = (1e-9, 1e3)  # m or rad, range of a step


class TrialsError(PumafuseError):
    """Step trials cannot be read or used as they are."""


@dataclass(frozen=True, repr=False)
class Trial:
    """One step; arrays are (n,).

    Attributes:
        name: Of the trial.
        axis: Which axis was stepped.
        step: Signed size of the step [m or rad].
        speed: Step size over the update period [m/s or rad/s]; NaN where it is not recorded.
        factors: What else was varied, as written.
        time: Of each sample since the step's command [s], ascending.
        position: Of each sample [m or rad]; its zero is the sensor's.
    """

    name: str
    axis: str
    step: float
    speed: float
    factors: Mapping[str, str]
    time: FloatArray
    position: FloatArray

    def __repr__(self) -> str:
        return f"Trial({self.name!r}: {self.axis}, step {self.step:.4g}, {len(self.time):,} samples)"

    def speed_at(self, period: float) -> float:
        """The speed as recorded, or step over ``period`` [s] where it is not [m/s or rad/s]."""
        return self.speed if self.speed > 0.0 else abs(self.step) / period

    def cut(self, samples: int | None) -> Trial:
        """The trial with only ``samples`` samples from the step on, and all before it; unchanged for None."""
        end = None if samples is None else int(np.searchsorted(self.time, 0.0)) + samples
        return replace(self, time=self.time[:end], position=self.position[:end])


@dataclass(frozen=True, repr=False)
class StepTrials:
    """A campaign.

    Attributes:
        trials: Those that can be fitted, in the order of the list.
        notes: Every trial that was left out and every repair, a sentence each.
        kind: Whether the axes are lengths or angles; a campaign has one kind.
    """

    trials: tuple[Trial, ...]
    notes: tuple[str, ...]
    kind: Kind = "length"

    def __repr__(self) -> str:
        return f"StepTrials({len(self.trials)} trials of {', '.join(self.axes)}; {len(self.notes)} notes)"

    @property
    def axes(self) -> tuple[str, ...]:
        """The axes that were stepped, in the order of their first trials."""
        return tuple(dict.fromkeys(trial.axis for trial in self.trials))

    def of(self, axis: str) -> list[Trial]:
        """The trials of one axis."""
        return [trial for trial in self.trials if trial.axis == axis]

    def period(self, period: float | None = None) -> float:
        """The update period T [s]: as ``period``, or step over speed where all trials agree on it.

        Raises:
            TrialsError: The trials do not agree, or on no period of 1 to 200 ms.
        """
        if period is not None:
            if not _GIVEN[0] <= period <= _GIVEN[1]:
                raise TrialsError(f"an update period of {period * 1e3:g} ms: it must be 0.1 ms to 10 s")
            return period
        timed = [trial for trial in self.trials if trial.speed > 0.0]
        step, speed = np.abs([trial.step for trial in timed]), np.array([trial.speed for trial in timed])
        middle = float(np.median(step / speed)) if timed else np.nan
        if not _PERIODS[0] <= middle <= _PERIODS[1] or (np.abs(step / speed / middle - 1.0) > _AGREE).any():
            raise TrialsError("step over speed is not one update period of 1 to 200 ms in all trials: give --period")
        # least squares through 0: speeds are rounded, the small ones the most for their size
        fitted_period = float(step @ speed / (speed @ speed))
        whole, scatter = round(fitted_period, 3), float(np.std(step / speed / fitted_period))
        return whole if abs(whole / fitted_period - 1.0) <= 0.5 * scatter else fitted_period

    @staticmethod
    def read(folder: str | Path) -> StepTrials:
        """Read ``trials`` and ``samples`` of a folder, CSV (gzip allowed) or Parquet.

        Args:
            folder: Where they are. ``trials``: ``trial``, ``axis``, ``step_mm``, ``speed_m_s``; any further column is a
                factor. ``samples``: ``trial``, ``time_s`` since the command, ``position_mm``. Of angles ``step_deg``,
                ``speed_deg_s``, ``position_deg``. Other units by name.

        Raises:
            RunError: A table is absent or cannot be read.
            TrialsError: No trial is left, or it is a campaign of lengths and of angles.
        """
        listed, sampled = _table(Path(folder), "trials"), _table(Path(folder), "samples")
        notes = [*listed.notes, *sampled.notes]
        kind = _kind(listed, sampled)
        step = _read_column(listed.numbers(_column(listed, "step")), notes)
        speed, speed_column = _speed(listed, kind, notes)
        names, axes = listed.texts("trial"), listed.texts("axis")
        described = {"trial", "axis", speed_column, _column(listed, "step")}
        factors = {column: listed.texts(column) for column in listed.columns if column not in described}
        samples = _samples(sampled, notes)
        listings = Counter(names)
        if unlisted := [name for name in samples if name not in listings]:
            notes.append(f"{sampled.path.name}: {len(unlisted)} trials are not listed, first '{unlisted[0]}': left out")
        trials: list[Trial] = []
        for row, name in enumerate(names):
            if not name:
                notes.append(f"{listed.path.name}: row {row + 1} names no trial: left out")
                continue
            time, position = samples.get(name, (np.zeros(0), np.zeros(0)))
            is_real = (np.abs(time) < _LATEST) & (np.abs(position) < _FARTHEST)
            reason = _unusable(listings[name], axes[row], float(step[row]), time[is_real], position[is_real])
            if reason is not None:
                notes.append(f"trial '{name}': {reason}: left out")
                continue
            if not is_real.all():
                notes.append(f"trial '{name}': {int((~is_real).sum())} samples without a number: left out")
            if (np.diff(time[is_real]) < 0.0).any():
                notes.append(f"trial '{name}': times step back: sorted")
            order = np.argsort(time, kind="stable")
            time, position = time[order[is_real[order]]], position[order[is_real[order]]]
            of = {factor: cells[row] for factor, cells in factors.items()}
            trials.append(Trial(name, axes[row], float(step[row]), float(speed[row]), of, time, position))
        if not trials:
            raise TrialsError("; ".join([f"{folder}: no trial can be used", *first_few(notes)]))
        return StepTrials(tuple(trials), tuple(notes), kind)


def first_few(notes: Sequence[str]) -> list[str]:
    """The first few of many sentences, and how many more there are, for an error of one readable line."""
    more = len(notes) - _SHOWN
    return [*notes[:_SHOWN], *([f"and {more} more"] if more > 0 else [])]


def _unusable(times_listed: int, axis: str, step: float, time: FloatArray, position: FloatArray) -> str | None:
    """Why a trial cannot be fitted; None when it can. ``time`` [s] and ``position`` [m or rad] are of its samples."""
    if times_listed > 1:
        return f"listed {times_listed} times"
    if not axis:
        return "it names no axis"
    if not _STEPS[0] <= abs(step) <= _STEPS[1]:
        return "its step is 0 or no number, or of no size an arm has"
    after = len(np.unique(time[time >= 0.0]))
    if after < FEWEST_SAMPLES:
        return f"{after} samples from the step on, at least {FEWEST_SAMPLES} are needed"
    return "its position never changes" if np.ptp(position) == 0.0 else None


def _table(folder: Path, stem: str) -> tables.Table:
    for suffix in (".csv", ".csv.gz", ".parquet"):
        if (folder / f"{stem}{suffix}").exists():
            return tables.read(folder / f"{stem}{suffix}")
    raise RunError(f"{folder}: no {stem}.csv (or .csv.gz, .parquet) in it")


def _find_columns(table: tables.Table, stem: str) -> list[str]:
    """The columns of this name with any unit."""
    return [name for name in table.columns if name.removesuffix(ending(name) or "") == stem]


def _column(table: tables.Table, stem: str) -> str:
    """The first column of this name with any unit."""
    if named := _find_columns(table, stem):
        return named[0]
    raise RunError(f"{table.path}: no column '{stem}' with a unit in its name; it has {', '.join(table.columns)}")


def _kind(listed: tables.Table, sampled: tables.Table) -> Kind:
    """The kind of the axes, of which all columns of steps, speeds and positions must be."""
    columns = [*_find_columns(listed, "step"), *_find_columns(listed, "speed"), *_find_columns(sampled, "position")]
    length, angle = (
        next((name for name in columns if ending(name) in (*OF_KIND[kind], *SPEEDS[kind])), None) for kind in KINDS
    )
    if length and angle:
        raise TrialsError(
            f"{listed.path.parent}: {length} is of a length, {angle} of an angle: identify lengths and angles in two"
            " campaigns, then put the axes into one arm.toml"
        )
    return "angle" if angle else "length"


def _speed(listed: tables.Table, kind: Kind, notes: list[str]) -> tuple[FloatArray, str | None]:
    """The speed of each trial [m/s or rad/s], NaN where it is not recorded, and its column."""
    column = next((name for name in _find_columns(listed, "speed") if ending(name) in SPEEDS[kind]), None)
    if column is None:
        return np.full(listed.rows, np.nan), None
    return si_of(_read_column(listed.plain(column), notes), ending(column) or ""), column


def _read_column(column: tuple[Any, str | None], notes: list[str]) -> Any:
    """The values of a column; its note goes to ``notes``."""
    notes.extend(note for note in column[1:] if note)
    return column[0]


def _samples(table: tables.Table, notes: list[str]) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Times [s] and positions [m or rad] of each trial, in the order of the file."""
    time = seconds(_read_column(table.stamps(_column(table, "time")), notes))
    position = _read_column(table.numbers(_column(table, "position")), notes)
    rows: defaultdict[str, list[int]] = defaultdict(list)
    for row, name in enumerate(table.texts("trial")):
        rows[name].append(row)
    return {name: (time[part], position[part]) for name, part in rows.items()}
