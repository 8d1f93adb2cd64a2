"""Array types, the special stamps, rows that are known, and a median."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
IndexArray: TypeAlias = npt.NDArray[np.int16]  # which of a few sensors or axes
ComplexArray: TypeAlias = npt.NDArray[np.complex128]
CodeArray: TypeAlias = npt.NDArray[np.uint8]
TimeArray: TypeAlias = npt.NDArray[np.int64]  # absolute stamps, int64 ns

NO_STAMP = -(2**63)  # in a TimeArray: a row without a readable stamp (numpy's NaT)
NEVER, ALWAYS = 2**63 - 1, 1 - 2**63  # in a TimeArray: after all stamps, before all stamps
SD_OF_MEDIAN = 1.4826  # the standard deviation of normal errors, over the median of their sizes
REACH_NS = 4.6e18  # |stamp| whose differences int64 ns can hold: the years 1824 to 2115


def known_rows(stamp: TimeArray, value: FloatArray) -> tuple[TimeArray, FloatArray]:
    """Stamps and values of the rows that have both, in the order of time; of one stamp the first, (n,) and (n, …)."""
    valid = (stamp != NO_STAMP) & np.isfinite(value).reshape(len(stamp), -1).all(axis=1)
    stamps, first = np.unique(stamp[valid], return_index=True)
    return stamps, value[valid][first]


def median(values: FloatArray) -> float:
    """The median; numpy's takes twice as long, and imports masked arrays (0.02 s)."""
    middle = len(values) // 2
    ordered = np.partition(values, [middle - 1, middle])
    return float(ordered[middle] if len(values) % 2 else (ordered[middle - 1] + ordered[middle]) / 2)
