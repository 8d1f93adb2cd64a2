"""How each sensor of a stream does: what became of its rows, how late they come, which are missing."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..arrays import ALWAYS, BoolArray, FloatArray, IntArray, TimeArray
from ..filter.outcome import ABSENT, Outcome
from ..filter.window import FIRST_ROWS, Window

_SECOND = 1_000_000_000  # ns
_SECONDS = 60  # of the past that are counted
_ROWS, _LATENESS, _LATEST, _NIS, _VALUES = range(5)  # of each: rows, sum and most of lateness [s], NIS, fused values
_MOST = FIRST_ROWS // 32  # rows that are counted at once: no event waits long, and what has left is still there
_FEW, _MANY = 20, 100  # intervals before a usual one is known, and that it is a mean of
_GAP = 1.5  # usual intervals without a row: one is missing
_SLOWER = 1.1  # by dropouts in a row the usual interval grows, if a sensor is slower now


@dataclass(frozen=True)
class SensorHealth:
    """Rate, lateness, dropouts, NIS and outcomes of one sensor.

    Attributes:
        rows: How many have come.
        rate: Rows a second over the last minute of stream time [Hz].
        lateness: How far its stamps were behind the newest one of all when they came, mean of the last minute [s].
        lateness_max: The highest of that minute [s].
        silent: For how long nothing has come, in stream time [s]; None if nothing ever did.
        stale: Whether that is longer than the limit.
        dropouts: Intervals longer than one and a half times the usual one, once late rows are in.
        nis: Mean ν²/S of the last minute; 1 where the noise is as configured; None without a fused component.
        outcomes: Number of its components by the outcome's word.
    """

    rows: int
    rate: float
    lateness: float
    lateness_max: float
    silent: float | None
    stale: bool
    dropouts: int
    nis: float | None
    outcomes: Mapping[str, int]

    @property
    def reacquired(self) -> int:
        """Number of components that were fused although they failed the gate."""
        return self.outcomes[Outcome.REACQUIRED.word]


@dataclass(frozen=True)
class Health:
    """Counters of a whole stream.

    Attributes:
        newest: The newest stamp (but not one that a sensor alone has run ahead to), int ns; None before any event.
        segments: How often the filter has started: 1, and once more each time the commands' clock was reset.
        commands: Number of commands by the outcome's word.
        sensors: In the order of the configuration.
        unknown: Rows of sensors that the configuration does not know.
        faults: A sentence on each fault of a sensor, or of the commands, that shows now.
    """

    newest: int | None
    segments: int
    commands: Mapping[str, int]
    sensors: Mapping[str, SensorHealth]
    unknown: int
    faults: tuple[str, ...] = ()


def by_word(outcomes: IntArray) -> dict[str, int]:
    """How many there are of each outcome, (outcomes,), by its word."""
    return {outcome.word: count for outcome, count in zip(Outcome, outcomes.tolist(), strict=True)}


@dataclass(slots=True)
class _Intervals:
    """Intervals between the rows of a sensor that have left the window."""

    last: int | None = None  # stamp [ns]
    usual: float = 0.0  # [s]
    count: int = 0
    dropouts: int = 0
    in_a_row: int = 0

    def add(self, stamps: list[int]) -> None:
        """Count each interval [ns]: as a dropout, or to the usual one."""
        for stamp in stamps:
            last, self.last = self.last, stamp
            if last is None:
                continue
            interval = (stamp - last) / 1e9
            self.count += 1
            if self.count > _FEW and interval > _GAP * self.usual:
                self.dropouts += 1
                self.in_a_row += 1
                self.usual *= _SLOWER if self.in_a_row > 1 else 1.0
            else:
                self.in_a_row = 0
                self.usual += (interval - self.usual) / min(self.count, _MANY)


class Counts:
    """What there was of each sensor, but for what became of the rows that are still in the window.

    That may change as long as they are there; it is read once they have left, in the order of time: what came late is
    in then.
    """

    def __init__(self, sensors: int) -> None:
        self.rows: IntArray = np.zeros(sensors, dtype=np.int64)  # that came, (S,)
        self.outcomes: IntArray = np.zeros((sensors + 1, len(Outcome)), dtype=np.int64)  # of sensors, last of commands
        self._intervals = [_Intervals() for _ in range(sensors)]
        self.restart()

    def restart(self) -> None:
        """Begin anew with an empty window and another clock; numbers and usual intervals stay."""
        sensors = len(self.rows)
        self._last: TimeArray = np.full(sensors, ALWAYS)  # stamp
        self._second: TimeArray = np.full(sensors * _SECONDS, ALWAYS)  # each at its number modulo their count
        self._minute: FloatArray = np.zeros((_VALUES + 1, sensors * _SECONDS))
        self._came: list[tuple[int, int, int]] = []  # rows that are not counted yet
        self._unread = 0  # the first row that is not read yet
        for interval in self._intervals:
            interval.last = None

    def add_row(self, sensor: int, stamp: int, newest: int) -> None:
        """Count a row that comes; ``newest`` [ns] is the newest stamp of all."""
        self._came.append((sensor, stamp, newest))
        if len(self._came) >= _MOST:
            self._count_what_came()

    def count(self, window: Window) -> None:
        """Count some of what has left the window, if that is much; after each event, for it is not there for ever."""
        if window.port.begin - self._unread >= _MOST:
            self._count_rows(window, self._unread + _MOST)

    def snapshot(self, window: Window) -> Counts:
        """What there was until now, with what is still in the window."""
        self._count_all(window)
        now = copy.deepcopy(self)
        now._count_rows(window, window.port.end)
        return now

    def forget(self, window: Window, after: int) -> None:
        """Before the window does: what is stamped after ``after`` [ns] is invalid, and nothing else remains of it."""
        self._count_all(window)
        stamp, source, results = window.read(window.port.begin, window.port.end)
        late, measured = stamp > after, source >= 0
        given_rows = np.count_nonzero(results.outcome != ABSENT, axis=1)
        np.add.at(self.outcomes[:, Outcome.INVALID], source[late & measured], given_rows[late & measured])
        self._last[self._last > after] = ALWAYS
        np.maximum.at(self._last, source[~late & measured], stamp[~late & measured])
        self._second[self._second > after // _SECOND] = ALWAYS

    def health(self, sensor: int, outcomes: IntArray, newest: int | None, stale_ns: int) -> SensorHealth:
        """The health of a sensor, by what :meth:`snapshot` gives and by what was refused before, (outcomes,)."""
        last, places = int(self._last[sensor]), slice(sensor * _SECONDS, (sensor + 1) * _SECONDS)
        silent = None if newest is None or last == ALWAYS else max((newest - last) / 1e9, 0.0)
        now, second = newest or 0, self._second[places]
        recent = (second <= now // _SECOND) & (second > now // _SECOND - _SECONDS)
        minute = self._minute[:, places][:, recent]
        rows, values = float(minute[_ROWS].sum()), float(minute[_VALUES].sum())
        span = (now - _SECOND * int(second[recent].min(initial=now // _SECOND))) / 1e9
        return SensorHealth(
            rows=int(self.rows[sensor]),
            rate=rows / max(span, 1.0),
            lateness=float(minute[_LATENESS].sum()) / max(rows, 1.0),
            lateness_max=float(minute[_LATEST].max(initial=0.0)),
            silent=silent,
            stale=silent is None or silent > stale_ns / 1e9,
            dropouts=self._intervals[sensor].dropouts,
            nis=float(minute[_NIS].sum()) / values if values else None,
            outcomes=by_word(self.outcomes[sensor] + outcomes),
        )

    def _count_all(self, window: Window) -> None:
        """Count all that came and all that has left the window."""
        self._count_what_came()
        self._count_rows(window, window.port.begin)

    def _count_what_came(self) -> None:
        sensor, stamp, newest = np.array(self._came, dtype=np.int64).reshape(-1, 3).T
        self._came = []
        self.rows += np.bincount(sensor, minlength=len(self.rows))
        np.maximum.at(self._last, sensor, stamp)
        cell, is_recent = self._places(sensor, stamp)
        cell, late = cell[is_recent], np.maximum(newest - stamp, 0)[is_recent] / 1e9
        np.add.at(self._minute[_ROWS], cell, 1.0)
        np.add.at(self._minute[_LATENESS], cell, late)
        np.maximum.at(self._minute[_LATEST], cell, late)

    def _count_rows(self, window: Window, end: int) -> None:
        """Count what became of the rows to ``end``, which leave the window."""
        stamp, source, results = window.read(self._unread, end)
        self._unread, sensors, measured = end, len(self.rows), source >= 0
        stamp, source, codes = stamp[measured], source[measured].astype(np.int64), results.outcome[measured]
        table = np.bincount((256 * source[:, None] + codes).ravel(), minlength=256 * sensors).reshape(sensors, 256)
        self.outcomes[:-1] += table[:, : len(Outcome)]
        cell, is_recent = self._places(source, stamp)
        taken = ((codes == Outcome.FUSED) | (codes == Outcome.REACQUIRED)) & is_recent[:, None]
        nis = (results.innovation[measured][taken] / results.innovation_sd[measured][taken]) ** 2
        cell = cell[np.nonzero(taken)[0]]
        np.add.at(self._minute[_NIS], cell, nis)
        np.add.at(self._minute[_VALUES], cell, 1.0)
        for sensor, intervals in enumerate(self._intervals):
            intervals.add(stamp[source == sensor].tolist())

    def _places(self, sensor: IntArray, stamp: TimeArray) -> tuple[IntArray, BoolArray]:
        """Where in the last minute rows are counted (n,), and which of them are not a minute old (n,)."""
        second = stamp // _SECOND
        cell = _SECONDS * sensor + second % _SECONDS
        before = self._second.copy()
        np.maximum.at(self._second, cell, second)
        self._minute[:, self._second > before] = 0.0
        return cell, self._second[cell] == second
