"""The grid of instants at which a simulated motion is known.

All random numbers are drawn on it, so that the motion does not depend on who measures it.
"""

from __future__ import annotations

import numpy as np

from ..arrays import TimeArray

POINTS = 60  # in each period


def grid(ticks: int, period: float) -> TimeArray:
    """Instants of ``ticks`` periods of T [s] at which measurements and reference rows may be taken, int64 ns."""
    return np.rint(np.arange(ticks * POINTS + 1) * (period * 1e9 / POINTS)).astype(np.int64)
