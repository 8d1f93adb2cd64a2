"""What may become of a component, and the limits that decide it."""

from __future__ import annotations

import enum

import numpy as np

from ..arrays import BoolArray, FloatArray

REOPEN_AFTER = 10  # rejections in a row of one sensor …
REOPEN_SPAN_NS = 500_000_000  # … the first of them at least 0.5 s ago
FARTHEST = 1e6  # m; what is farther is a sentinel, no position


class Outcome(enum.IntEnum):
    """What became of a component."""

    FUSED = 0
    REJECTED = 1
    REACQUIRED = 2
    DUPLICATE = 3
    BEFORE_START = 4
    TOO_LATE = 5
    INVALID = 6
    UNKNOWN = 7

    @property
    def word(self) -> str:
        """As files and screens have it."""
        return self.name.lower()


def plausible(value: FloatArray) -> BoolArray:
    """Finite and no sentinel such as 3.4e38: within a thousand kilometres."""
    return np.abs(value) < FARTHEST
