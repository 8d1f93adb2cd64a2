"""The instants at which a simulated motion may be looked at.

All that is random is drawn on them, so that the motion is the same whoever looks.
"""

from __future__ import annotations

import numpy as np

from ..arrays import TimeArray

LATTICE = 60  # instants in each period


def lattice(ticks: int, period: float) -> TimeArray:
    """The instants of ``ticks`` periods of T [s] at which measurements and reference rows may be, int64 ns."""
    return np.rint(np.arange(ticks * LATTICE + 1) * (period * 1e9 / LATTICE)).astype(np.int64)
