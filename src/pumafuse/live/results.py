"""Results of a live estimator: what became of an event, the estimate at an instant."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

from ..errors import UnknownNameError
from ..filter.outcome import Outcome

COMPARED = frozenset({Outcome.FUSED, Outcome.REACQUIRED, Outcome.REJECTED})  # with its prediction
REASONS: Mapping[Outcome, str] = {  # the best first
    Outcome.FUSED: "taken",
    Outcome.REACQUIRED: "taken after rejections in a row: the offset was widened",
    Outcome.REJECTED: "farther from its prediction than the sensor's gate allows",
    Outcome.DUPLICATE: "received before: the same stamp and values, or a command repeated within half a period",
    Outcome.BEFORE_START: "valid before the first command",
    Outcome.TOO_LATE: "stamped before the window",
    Outcome.INVALID: "not a finite position",
    Outcome.UNKNOWN: "no such sensor or axis",
    Outcome.STRAY: "leaps away from the commands before and after",
    Outcome.HELD: "the value before, to the last digit, while the commands move the axis",
}
_ORDER = list(REASONS)


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
    reasons = "; ".join(dict.fromkeys(REASONS[outcome] for outcome in outcomes.values()))
    return UpdateResult(best, MappingProxyType(dict(outcomes)), reasons)


def refuse(values: Iterable[str], outcome: Outcome, reason: str) -> UpdateResult:
    """The result of an event that never came to the filter, whatever it gives."""
    return UpdateResult(outcome, MappingProxyType(dict.fromkeys(values, outcome)), reason)


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
        orientation: Of a tool that turns, a quaternion x, y, z, w; else None.
        doubtful: Axes on which a fused sensor tells nonsense, or innovations are far larger than expected: their
            standard deviations are not to be believed.
    """

    stamp: int
    axes: Mapping[str, AxisNow]
    cartesian: Mapping[str, float] | None
    stale: tuple[str, ...]
    outcome: Outcome
    reason: str
    orientation: tuple[float, float, float, float] | None = None
    doubtful: tuple[str, ...] = ()

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
