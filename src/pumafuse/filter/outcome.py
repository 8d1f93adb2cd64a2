"""What may become of a component of an event."""

from __future__ import annotations

import enum

FARTHEST = 1e6  # m or rad; what is farther is a sentinel, no position
ABSENT = 255  # in an array of outcomes: the row gives no value for this axis


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
    STRAY = 8
    HELD = 9

    @property
    def word(self) -> str:
        """The word for it in files and on screens."""
        return self.name.lower()
