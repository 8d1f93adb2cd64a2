"""Assignment of stamps to ticks by dynamic programming."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportReturnType=false

from __future__ import annotations

import math

from ..arrays import CodeArray, FloatArray, IntArray
from ..compiled import kernel

MOST_LATE = 9  # a stamp's ticks are sought from this many before it ...
CHOICES = MOST_LATE + 3  # ... to two after it
_LATE, _LATE_COST, _LATER_COST = math.sqrt(0.5), 0.5, 0.01


@kernel
def cheapest_ticks(place: FloatArray, first: IntArray, best: FloatArray, choice: CodeArray, ticks: IntArray) -> bool:
    """Fill in the strictly ascending ticks of least total cost; False if there are too few ticks about the stamps.

    A stamp's cost is the square of its distance from the tick in periods; beyond 0.7 late it hardly grows.

    Args:
        place: Each stamp in periods; ticks are whole numbers, (n,).
        first: The first of the CHOICES ticks open to each stamp, (n,).
        best: Workspace: the least cost so far if the last stamp has no later tick than this, (CHOICES,).
        choice: Workspace: the tick of this cost, counted from the first, (n, CHOICES).
        ticks: The ticks found, (n,).
    """
    for n in range(len(place)):
        ahead = first[n] - first[n - 1] - 1 if n else 0  # choice j comes after choice j + ahead of the row before
        for one in range(CHOICES):
            j = one if ahead >= 0 else CHOICES - 1 - one  # overwrite no cost that is still needed
            off = place[n] - (first[n] + j)
            cost = _LATE_COST + _LATER_COST * (off - _LATE) if off > _LATE else off * off
            if n:
                cost += best[min(j + ahead, CHOICES - 1)] if j + ahead >= 0 else math.inf
            best[j] = cost
        choice[n, 0] = 0
        for j in range(1, CHOICES):
            choice[n, j] = j
            if best[j - 1] < best[j]:
                best[j] = best[j - 1]
                choice[n, j] = choice[n, j - 1]
        if best[CHOICES - 1] == math.inf:
            return False
    upto = CHOICES - 1
    for n in range(len(place) - 1, -1, -1):
        ticks[n] = first[n] + choice[n, upto]
        if n:
            upto = min(ticks[n] - 1 - first[n - 1], CHOICES - 1)
    return True
