"""Says while a stream runs that a sensor tells nonsense: as `fuse` does before it filters, by the last seconds."""

from __future__ import annotations

import math
import operator
from collections import deque
from collections.abc import Mapping, Sequence
from ctypes import Array, c_double
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from typing import TypeAlias

import msgspec
import numpy as np

from ..arrays import ALWAYS, NEVER, IndexArray, IntArray, TimeArray
from ..errors import PumafuseError
from ..filter.events import COMMAND, Results
from ..filter.outcome import Outcome
from ..filter.window import Window
from ..fusion.causes import Cause, evidence_of
from ..fusion.chi_square import upper_quantile
from ..fusion.config import FusionConfig, Start
from ..fusion.consistency import Finding, consistency
from ..fusion.estimates import Estimates
from ..fusion.faults import Fault, find_faults, settling_time
from ..fusion.offline import judge
from ..fusion.segments import Segment, build_segment
from ..fusion.verdicts import SHOWS, likeliest, sentence
from ..logs.run import Run
from ..logs.source import Source
from .rate_limit import RateLimitedLog

_SPAN_NS = 20_000_000_000  # of the past in which faults are looked for: within 5 s causes are mistaken for each other
_REST_NS = 600_000_000_000  # before the span, for which it rests where that begins: nobody knows what was before
_SHORTEST_NS = 5_000_000_000  # of the past below which nothing is looked for
_APART_NS = 2_500_000_000, 5_000_000_000  # between two looks for faults, of 5 to 10 ms each: at first, and later
_FINEST_NS = 8_000_000  # between two rows of a sensor that are kept: faults are looked for by 500 of a span
_TWICE = 2  # looks in a row that find a fault, or do not, until that is said; that a clock was set is said at once
_BEFORE_NS = 2_000_000_000  # before rows go on where stamps step back, that was said of them
_MOVING = 0.25  # of the commands, which move an axis: at rest what counts in steps, or repeats its value, has no noise
_MOVED = 0.5  # of the commanded motion that showed a fault, without which nothing shows that it is over

_SECOND_NS, _QUARTER_NS = 1_000_000_000, 250_000_000  # over which innovations are judged, and how often
_QUARTERS = _SECOND_NS // _QUARTER_NS
_LARGE, _HUGE = 4.0, 100.0  # NIS in each quarter of a second, and over all of it: 2 sd; one value of 100 by 100 sd
_CHANCE = 1e-12  # that a second of good measurements has so large a NIS: one in 10⁵ years at 10 axes
_CALM_NS = 5_000_000_000  # of usual innovations, after which it is over
_MOST_ROWS = 4096  # of a second that are judged

_Key: TypeAlias = tuple[tuple[str, ...], str | Cause | Finding, int]  # sensors, the cause of their fault, and when


class Recent:
    """What came of commands and measurements in the last seconds, in the arm's axes."""

    def __init__(self, config: FusionConfig) -> None:
        self._config, self._axes, self._sensors = config, tuple(config.arm.axes), tuple(config.sensors)
        self._settled = round(max(settling_time(config, axis) for axis in self._axes) * 1e9)
        self._rests = _REST_NS - np.array([2, 1, 0]) * round(config.arm.update_period * 1e9)
        self.restart()

    def restart(self) -> None:
        """Begin anew."""
        self._rows = list[tuple[int, int, int, bytes]]()  # stamp, source, given axes as bits, values and spreads
        self._latest, self._start, self._first = [ALWAYS] * len(self._sensors), dict[str, float](), NEVER

    def add(self, stamp: int, source: int, bits: int, values: Array[c_double], spread: Array[c_double]) -> None:
        """Add an event: its values [m or rad], (A,), of axes that ``bits`` name, and by what their noise is scaled.

        Of a dense sensor some are kept.
        """
        if source == COMMAND:
            self._first = min(self._first, stamp)
            if len(self._start) < len(self._axes):
                begun = {name: values[axis] for axis, name in enumerate(self._axes) if bits >> axis & 1}
                self._start = {name: value for name, value in begun.items() if math.isfinite(value)} | self._start
        elif abs(stamp - self._latest[source]) < _FINEST_NS:
            return
        else:
            self._latest[source] = stamp
        self._rows.append((stamp, source, bits, bytes(values) + bytes(spread)))

    def forget(self, after: int) -> None:
        """Take back what is stamped after ``after`` [ns]."""
        self._rows = [row for row in self._rows if row[0] <= after]
        self._latest = [min(stamp, after) for stamp in self._latest]

    def part(self, now: int) -> tuple[Run, Segment, FusionConfig] | None:
        """What came in the span before ``now`` [ns]; None where that is too little. What is older is forgotten.

        By the configuration that is given, the arm may have strayed from its start.
        """
        self._rows = [row for row in self._rows if now - _SPAN_NS < row[0] <= now]
        ordered = sorted(self._rows, key=operator.itemgetter(0))
        stamp, source, bits = np.array([row[:3] for row in ordered], dtype=np.int64).reshape(-1, 3).T
        table = np.frombuffer(bytearray().join(row[3] for row in ordered)).reshape(-1, 2, len(self._axes))
        value, spread = table[:, 0], table[:, 1]
        commands = source == COMMAND
        if not commands.any() or stamp[-1] - stamp[commands][0] < _SHORTEST_NS:
            return None
        has_value = bits[:, None] >> np.arange(len(self._axes)) & 1
        value[has_value == 0] = np.nan
        commanded = [axis for axis in range(len(self._axes)) if np.isfinite(value[commands, axis]).any()]
        usable = commands | (stamp >= stamp[commands][0] + self._settled)  # where the arm was before is not

        def rows(chosen: IntArray, label: str) -> Source:
            present = [axis for axis in commanded if has_value[chosen, axis].any()]
            values, spreads = ({self._axes[axis]: part[chosen, axis] for axis in present} for part in (value, spread))
            return Source(stamp[chosen], values, label, spreads, apart=True)

        every = {name: np.flatnonzero(usable & (source == number)) for number, name in enumerate(self._sensors)}
        sensors = {name: rows(chosen, name) for name, chosen in every.items() if len(chosen)}
        names, kinds = {self._axes[axis] for axis in commanded}, self._config.arm.kind_of
        start = {name: level for name, level in self._start.items() if name in names}
        sent = rows(np.flatnonzero(commands), "commands")
        rested = [np.insert(part, 0, part[np.isfinite(part)][:1].repeat(3)) for part in sent.values.values()]
        stamp = np.insert(sent.stamp, 0, sent.stamp[0] - self._rests)
        command = Source(stamp, dict(zip(sent.values, rested, strict=True)), "commands", apart=True)
        age, process = (now - self._first) / 1e9, self._config.process
        strayed = {
            axis: math.hypot(self._config.start.offset_sd_of(axis), process[axis].drift * math.sqrt(age))
            for axis in self._axes
        }
        config = msgspec.structs.replace(self._config, start=Start(offset_sd=strayed))
        try:
            run = Run("stream", command, sensors, start=start, kinds=kinds)
            return run, build_segment(run, config), config
        except PumafuseError:  # of what is there nothing can be made
            return None


@dataclass
class _Trouble:
    """A fault that a look has found."""

    fault: Fault  # as the last look has found it
    travel: float = 0.0  # how far apart the commands of its axes were then [m or rad]
    seen: int = 0  # in how many looks in a row it was found
    missed: int = 0  # in how many looks in a row it was not, though they would have shown it

    @property
    def is_said(self) -> bool:
        """Whether it was found often enough."""
        return self.seen >= (1 if self.fault.cause == "set" else _TWICE)


class Diagnosis:
    """Says once what is wrong with a stream, and once that it is over."""

    def __init__(self, config: FusionConfig, log: RateLimitedLog) -> None:
        self._config, self._log = config, log
        self._axes, self._sensors = tuple(config.arm.axes), tuple(config.sensors)
        self.recent = Recent(config)
        self.restart()

    def restart(self) -> None:
        """Begin anew by another clock."""
        self.recent.restart()
        self.due, self._faults_due, self.doubtful = ALWAYS, ALWAYS, tuple[str, ...]()
        self._since = ALWAYS  # the first look [ns]
        self._ends = deque[int](maxlen=_QUARTERS + 2)  # of the window's rows, at the last looks
        self._troubles = dict[_Key, _Trouble]()
        self._large = dict[str, dict[str, int]]()  # by sensor and axis, when innovations were last too large [ns]
        self._reacquired = dict[str, int]()  # when each sensor was taken again [ns]
        self.set_back = dict[str, int]()  # when it was said of a sensor that its stamps step back [ns]

    @property
    def shown(self) -> tuple[str, ...]:
        """A sentence on each fault that shows now."""
        said = [trouble.fault for trouble in self._troubles.values() if trouble.is_said]
        explained = {name for fault in said for name in fault.sensors}
        large = [
            f"{_innovations(name, axes)} are far larger than expected"
            for name, axes in self._large.items()
            if name not in explained
        ]
        return (*(fault.sentence for fault in said), *large)

    def diagnose(self, window: Window, now: int) -> None:
        """Look at what has come until ``now`` [ns]."""
        port = window.port
        if now >= self.due:
            self._since = now if self.due == ALWAYS else self._since
            self.due = now + _QUARTER_NS
            self._ends.append(port.end)
        if now >= self._faults_due:
            self._faults_due = now + _APART_NS[now >= self._since + _SPAN_NS]
            if (part := self.recent.part(now)) is not None:
                self._find_faults(*part, now)
        stamp, source, results = window.read(max(port.begin, self._ends[0], port.end - _MOST_ROWS), port.end)
        recent = (stamp > now - _SECOND_NS) & (stamp <= now) & (source >= 0)
        stamp, source, results = stamp[recent], source[recent], results.rows(np.flatnonzero(recent))
        doubtful = self._find_reacquired(stamp, source, results)
        fused = self._find_large_innovations(now, stamp, source, results)
        doubtful.update(axis for axes in self._large.values() for axis in axes)
        for trouble in self._troubles.values():
            if trouble.is_said:  # what the gate keeps out harms nothing
                doubtful.update(
                    axis for name in trouble.fault.sensors for axis in trouble.fault.axes if (name, axis) in fused
                )
        self.doubtful = tuple(axis for axis in self._axes if axis in doubtful)

    # ---- faults of the log ------------------------------------------------------------------------------------------

    def _find_faults(self, run: Run, segment: Segment, config: FusionConfig, now: int) -> None:
        travel = {axis: float(np.ptp(segment.commands_of(axis)[1])) for axis in segment.axes}
        explained = {name for (names, *_), trouble in self._troubles.items() if trouble.is_said for name in names}
        faults = [
            fault
            for fault in find_faults(segment, config, origin=0)
            if fault.cause != "nothing" or explained.isdisjoint(fault.sensors)
        ]
        faults += self._unexpected_innovations(judge(run, segment, config), faults)
        for fault in faults:
            key = _key(fault)
            trouble = self._troubles.setdefault(key, _Trouble(fault))
            was_said = trouble.is_said
            trouble.fault, trouble.missed, trouble.seen = fault, 0, trouble.seen + 1
            trouble.travel = max((travel[axis] for axis in fault.axes), default=0.0)
            if trouble.is_said and not was_said and not self._is_set_back(fault):
                self._log.write(str(key), f"{fault.sentence} (by {now / 1e9:.3f} s)")
        keys, named = set(map(_key, faults)), {name for fault in faults for name in fault.sensors}
        for key in [key for key in self._troubles if key not in keys]:
            self._count_missed(key, travel, not named.isdisjoint(key[0]), now)

    def _is_set_back(self, fault: Fault) -> bool:
        """Whether stamps alone have shown, and it was said, that a clock was set back."""
        since = [self.set_back.get(name, ALWAYS) for name in fault.sensors]
        return fault.cause == "set" and fault.size < 0.0 and max(since) > fault.at - _BEFORE_NS

    def _count_missed(self, key: _Key, travel: Mapping[str, float], is_replaced: bool, now: int) -> None:
        """Count that a fault does not show, and say so where the commands would show it, unless another one does."""
        (sensors, cause, _), trouble = key, self._troubles[key]
        moved = max((travel.get(axis, 0.0) for axis in trouble.fault.axes), default=0.0)
        trouble.missed += moved >= _MOVED * trouble.travel
        if trouble.is_said and trouble.missed < _TWICE:
            return
        del self._troubles[key]
        if trouble.is_said and not is_replaced and cause != "set":
            shows = SHOWS[cause] if isinstance(cause, str) else "what the verdict says"
            named = f"sensor{'s' if len(sensors) > 1 else ''} {', '.join(map(repr, sensors))}"
            who = named if sensors else "the commands"
            self._log.write(f"{key} over", f"{who}: {shows} shows no more at {now / 1e9:.3f} s")

    def _unexpected_innovations(self, estimates: Estimates, faults: Sequence[Fault]) -> list[Fault]:
        """What `fuse` says of innovations in the span where no fault is: of each sensor the clearest, of the arm once.

        A cause that was said of a sensor stays, as long as there is any.
        """
        said = [trouble.fault for trouble in self._troubles.values() if trouble.is_said]
        causes = {fault.sensors: fault.cause for fault in said if not isinstance(fault.cause, str)}
        named = [fault for fault in (*faults, *said) if isinstance(fault.cause, str)]
        faulty = {each for fault in named for each in (*fault.sensors, *fault.axes)}
        evidence, clearest = cache(partial(evidence_of, estimates)), dict[str, tuple[tuple[float, bool], str, Fault]]()
        steps = {axis: np.diff(estimates.segments[0].commands_of(axis)[1]) for axis in estimates.axes}
        moving = [axis for axis, step in steps.items() if np.count_nonzero(step) > _MOVING * len(step)]
        for axis, name in product(moving, estimates.measurements.sensors):
            verdict = consistency(estimates, name, axis, partial(evidence, axis))
            if not faulty.isdisjoint((axis, name)) or verdict is None or (first := likeliest(verdict)) is None:
                continue
            cause, whose, gain = first
            weight, sensor = (gain, whose == name), whose or name
            if sensor not in faulty and (sensor not in clearest or weight > clearest[sensor][0]):
                harmed = () if verdict.finding is Finding.TOO_SMALL else (axis,)  # error bars that are too wide hold
                words = f"sensor '{name}' on {axis}: {sentence(verdict)}"
                clearest[sensor] = weight, whose, Fault((sensor,), harmed, causes.get((sensor,), cause), gain, words)
        ordered = sorted(clearest.values(), key=operator.itemgetter(0))
        return list({(fault.cause, whose): fault for _, whose, fault in ordered}.values())

    # ---- innovations ------------------------------------------------------------------------------------------------

    def _find_large_innovations(
        self, now: int, stamp: TimeArray, source: IndexArray, results: Results
    ) -> set[tuple[str, str]]:
        """Judge what became of the measurements of the last second; of which sensors and axes some were fused."""
        taken = (results.outcome == Outcome.FUSED) | (results.outcome == Outcome.REACQUIRED)
        row, axis = np.nonzero(taken)
        quarter = (now - stamp[row]) // _QUARTER_NS
        cell = (source[row].astype(np.int64) * len(self._axes) + axis) * _QUARTERS + quarter
        squares, shape = (results.innovation[taken] / results.innovation_sd[taken]) ** 2, (-1, _QUARTERS)
        size = len(self._sensors) * len(self._axes) * _QUARTERS
        count = np.bincount(cell, minlength=size).reshape(shape)
        total = np.bincount(cell, weights=squares, minlength=size).reshape(shape)
        number, nis = count.sum(axis=1), total.sum(axis=1) / np.maximum(count.sum(axis=1), 1)
        everywhere = ((total > _LARGE * count) | (count == 0)).all(axis=1) & (number > 0)
        large = dict[str, dict[str, float]]()
        for pair in np.flatnonzero(everywhere | (nis > _HUGE)).tolist():
            if nis[pair] > _HUGE or nis[pair] * number[pair] > upper_quantile(int(number[pair]), _CHANCE):
                name, of_axis = self._names(pair)
                large.setdefault(name, {})[of_axis] = float(nis[pair])
        self._say_large(large, now)
        return {self._names(pair) for pair in np.flatnonzero(number).tolist()}

    def _say_large(self, large: Mapping[str, Mapping[str, float]], now: int) -> None:
        """Say which innovations have become far larger than expected, by their NIS, and which are so no more."""
        for name, nis in large.items():
            axes = self._large.setdefault(name, {})
            if new := [axis for axis in nis if axis not in axes]:
                worst = max(nis[axis] for axis in new)
                self._log.write(
                    f"{name} NIS",
                    f"{_innovations(name, new)} are far larger than expected at {now / 1e9:.3f} s (NIS {worst:.3g} over"
                    " the last second): error bars do not hold meanwhile",
                )
            axes |= dict.fromkeys(nis, now)
        for name, axes in list(self._large.items()):
            if max(axes.values()) < now - _CALM_NS:
                del self._large[name]
                self._log.write(f"{name} NIS over", f"{_innovations(name, axes)} are as expected at {now / 1e9:.3f} s")

    def _names(self, pair: int) -> tuple[str, str]:
        sensor, axis = divmod(pair, len(self._axes))
        return self._sensors[sensor], self._axes[axis]

    def _find_reacquired(self, stamp: TimeArray, source: IndexArray, results: Results) -> set[str]:
        """The axes on which a sensor was taken again in the last second; what is new of that is said."""
        again = results.outcome == Outcome.REACQUIRED
        for row in np.flatnonzero(again.any(axis=1)).tolist():
            name, at = self._sensors[int(source[row])], int(stamp[row])
            if at <= self._reacquired.get(name, ALWAYS):
                continue
            self._reacquired[name] = at
            axes = ", ".join(self._axes[axis] for axis in np.flatnonzero(again[row]).tolist())
            self._log.write(
                f"{name} reacquired",
                f"sensor '{name}' was rejected time after time on {axes} and is believed again since {at / 1e9:.3f} s:"
                " the estimate goes over to where it sees the arm",
            )
        return {self._axes[axis] for axis in np.flatnonzero(again.any(axis=0)).tolist()}


def _key(fault: Fault) -> _Key:
    return fault.sensors, fault.cause, fault.at


def _innovations(sensor: str, axes: Mapping[str, int] | Sequence[str]) -> str:
    return f"sensor '{sensor}': its innovations on {', '.join(axes)}"
