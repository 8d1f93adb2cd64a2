"""What may be wrong with rows of a log, and how it is told."""

from __future__ import annotations

import numpy as np

from ..arrays import BoolArray
from .run import Source


def said_before(source: Source) -> BoolArray:
    """Rows whose stamp and values all stood in an earlier row, (rows,)."""
    found = np.zeros(len(source.stamp), dtype=bool)
    if (np.diff(source.stamp) > 0).all():
        return found
    keys = [source.stamp, *(np.ascontiguousarray(value).view(np.int64) for value in source.values.values())]
    order = np.lexsort(keys)
    again = np.all([np.diff(key[order]) == 0 for key in keys], axis=0)
    found[order[1:][again]] = True
    return found


def tell(notes: list[str], label: str, rows: BoolArray, what: str, first: str = "") -> None:
    """Note how many of a source's rows have ``what`` and where the first is, with a word on that one; none: nothing."""
    found = np.flatnonzero(rows)
    if len(found):
        plural = "row has" if len(found) == 1 else "rows have"
        notes.append(f"{label}: {len(found)} {plural} {what} (first: row {found[0] + 1}{first})")
