"""What a live estimator answers: what became of an event, and where the tool is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

from ..errors import UnknownNameError
from ..filter.outcome import Outcome

MET = frozenset({Outcome.FUSED, Outcome.REACQUIRED, Outcome.REJECTED})  # of what was compared with its prediction
_BEST = (  # first
    Outcome.FUSED,
    Outcome.REACQUIRED,
    Outcome.REJECTED,
    *(outcome for outcome in Outcome if outcome > Outcome.REACQUIRED),
)
_REASONS: Mapping[Outcome, str] = {
    Outcome.FUSED: "taken",
    Outcome.REJECTED: "farther from its prediction than the sensor's gate allows",
    Outcome.REACQUIRED: "the gate was reacquired after many rejections in a row: the offset was widened, the measurement taken",
    Outcome.DUPLICATE: "said before: the same stamp and values, or a command repeated within half a period",
    Outcome.BEFORE_START: "valid before the first command",
    Outcome.TOO_LATE: "stamped before the window",
    Outcome.INVALID: "not a finite position",
    Outcome.UNKNOWN: "no such sensor or axis",
}


class UpdateResult(NamedTuple):
    """What became of an event.

    Attributes:
        outcome: Of the event: of its axes the best, ``fused`` before ``reacquired`` before ``rejected`` and so on. A
            command that is taken is ``fused``, too.
        axes: Of each axis that it gives.
        reason: In words.
    """

    outcome: Outcome
    axes: Mapping[str, Outcome]
    reason: str


class AxisNow(NamedTuple):
    """One axis at one instant; SI units.

    Attributes:
        position: [m], in the stream's own coordinates.
        position_sd: [m].
        velocity: The model's drift [m/s].
        velocity_sd: [m/s].
        offset: How far the arm is from its model [m].
        offset_sd: [m].
    """

    position: float
    position_sd: float
    velocity: float
    velocity_sd: float
    offset: float
    offset_sd: float


@dataclass(frozen=True, slots=True)
class LiveEstimate:
    """Where the tool is, was, or will be; ``est["radial"]`` is one axis.

    Attributes:
        stamp: At which instant, int ns.
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


def told_of(outcomes: Mapping[str, Outcome]) -> UpdateResult:
    """What is told of an event by the outcome of each of its axes, of which there is at least one."""
    best = min(outcomes.values(), key=_BEST.index)
    reasons = "; ".join(dict.fromkeys(_REASONS[outcome] for outcome in outcomes.values()))
    return UpdateResult(best, MappingProxyType(dict(outcomes)), reasons)


def nowhere(stamp: int, outcome: Outcome, reason: str) -> LiveEstimate:
    """No estimate at ``stamp`` [ns], and why."""
    return LiveEstimate(stamp, {}, None, (), outcome, reason)
