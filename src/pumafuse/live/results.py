"""Results of a live estimator: what became of an event, the estimate at an instant, the health of each sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

from ..arrays import ALWAYS
from ..errors import UnknownNameError
from ..filter.outcome import Outcome
from ..filter.window import CAME, DROPOUTS, LATENESS, MOST_LATE, NIS, ROWS, SCALARS, SECONDS, Counters

COMPARED = frozenset({Outcome.FUSED, Outcome.REACQUIRED, Outcome.REJECTED})  # with its prediction
_REASONS: Mapping[Outcome, str] = {  # the best first
    Outcome.FUSED: "taken",
    Outcome.REACQUIRED: "taken after rejections in a row: the offset was widened",
    Outcome.REJECTED: "farther from its prediction than the sensor's gate allows",
    Outcome.DUPLICATE: "received before: the same stamp and values, or a command repeated within half a period",
    Outcome.BEFORE_START: "valid before the first command",
    Outcome.TOO_LATE: "stamped before the window",
    Outcome.INVALID: "not a finite position",
    Outcome.UNKNOWN: "no such sensor or axis",
}
_ORDER = list(_REASONS)


class UpdateResult(NamedTuple):
    """What became of an event.

    Attributes:
        outcome: The best one of its axes: ``fused`` before ``reacquired`` before ``rejected`` and so on. A command that
            is taken is ``fused``, too.
        axes: The outcome of each axis that it gives.
        reason: In words.
    """

    outcome: Outcome
    axes: Mapping[str, Outcome]
    reason: str


def update_result(outcomes: Mapping[str, Outcome]) -> UpdateResult:
    """The result of an event from the outcomes of its axes, of which there is at least one."""
    best = min(outcomes.values(), key=_ORDER.index)
    reasons = "; ".join(dict.fromkeys(_REASONS[outcome] for outcome in outcomes.values()))
    return UpdateResult(best, MappingProxyType(dict(outcomes)), reasons)


class AxisNow(NamedTuple):
    """The estimate of one axis at one instant; SI units.

    Attributes:
        position: [m], in the stream's own coordinates.
        position_sd: [m].
        velocity: Mean over the coming update period [m/s].
        velocity_sd: [m/s].
        offset: How far the arm is from its model [m].
        offset_sd: [m].
        disturbance: What of that reverts to 0 [m]; beside the offset.
        disturbance_sd: [m].
    """

    position: float
    position_sd: float
    velocity: float
    velocity_sd: float
    offset: float
    offset_sd: float
    disturbance: float
    disturbance_sd: float


@dataclass(frozen=True, slots=True)
class LiveEstimate:
    """The estimate of every axis at one instant; ``est["x"]`` is one axis.

    Attributes:
        stamp: The instant, int ns.
        axes: Every axis that has been commanded.
        cartesian: With a frame, x, y and z [m] as far as the axes give them.
        stale: Axes on which no measurement was fused for longer than the limit.
        outcome: ``fused``; ``before_start`` or ``too_late`` where there is no estimate; ``invalid`` where there is none
            that far ahead.
        reason: In words.
    """

    stamp: int
    axes: Mapping[str, AxisNow]
    cartesian: Mapping[str, float] | None
    stale: tuple[str, ...]
    outcome: Outcome
    reason: str

    @property
    def time(self) -> float:
        """The instant in s."""
        return self.stamp / 1e9

    def __getitem__(self, axis: str) -> AxisNow:
        """The estimate of one axis.

        Raises:
            UnknownNameError: There is none; says why.
        """
        if axis not in self.axes:
            raise UnknownNameError(f"estimate at {self.time:.3f} s ({self.reason})", "axis", axis, self.axes)
        return self.axes[axis]


def no_estimate(stamp: int, outcome: Outcome, reason: str) -> LiveEstimate:
    """An estimate without axes at ``stamp`` [ns], and the reason for that."""
    return LiveEstimate(stamp, {}, None, (), outcome, reason)


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
    """

    newest: int | None
    segments: int
    commands: Mapping[str, int]
    sensors: Mapping[str, SensorHealth]
    unknown: int


def health_of(
    counters: Counters,
    refused: Mapping[str, Mapping[Outcome, int]],
    commands: Mapping[Outcome, int],
    unknown: int,
    segment: int,
    newest: int | None,
    stale_ns: int,
) -> Health:
    """Health from the window's counters, and from what was refused before it came into the window.

    Args:
        counters: Of each sensor in the window.
        refused: Number of refused components, by sensor and outcome.
        commands: Number of commands by outcome.
        unknown: Rows of unknown sensors.
        segment: How often the commands' clock was reset.
        newest: The newest stamp, int ns; None before any event.
        stale_ns: After how long a silent sensor is stale [ns].
    """
    sensors: dict[str, SensorHealth] = {}
    second = 0 if newest is None else newest // 1_000_000_000
    for number, (name, more) in enumerate(refused.items()):
        last = int(counters.last[number])
        silent = None if newest is None or last == ALWAYS else max((newest - last) / 1e9, 0.0)
        age = second - counters.second[number]
        recent = (age >= 0) & (age < SECONDS)
        minute = counters.minute[number][recent]
        rows, components = float(minute[:, ROWS].sum()), float(minute[:, SCALARS].sum())
        span = float(age[recent].max(initial=0)) + (0.0 if newest is None else newest / 1e9 - second)
        sensors[name] = SensorHealth(
            rows=int(counters.number[number, CAME]),
            rate=rows / max(span, 1.0),
            lateness=float(minute[:, LATENESS].sum()) / max(rows, 1.0),
            lateness_max=float(minute[:, MOST_LATE].max(initial=0.0)),
            silent=silent,
            stale=silent is None or silent > stale_ns / 1e9,
            dropouts=int(counters.number[number, DROPOUTS]),
            nis=float(minute[:, NIS].sum()) / components if components else None,
            outcomes={outcome.word: int(counters.number[number, outcome]) + more[outcome] for outcome in Outcome},
        )
    by_word = {outcome.word: count for outcome, count in commands.items()}
    return Health(newest, segment + 1, by_word, sensors, unknown)
