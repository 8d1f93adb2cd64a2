"""How well the combined model fits by each factor, and up to where it is called valid: the paper's Fig. 7."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from .. import units
from ..arrays import FloatArray
from ..model.arm import Validity
from .anova import Level, levels_of, numbers


class Performance(msgspec.Struct, frozen=True, kw_only=True):
    """How well the combined model fits by one factor; levels hold RMS in mm.

    Attributes:
        factor: What was varied.
        levels: RMS [mm] of the trials at each level.
        limit: Where the mean RMS passes the tolerance, in the factor's unit; null where it does not.
        verdict: In words.
    """

    factor: str
    levels: list[Level]
    limit: float | None
    verdict: str


def performances(factors: Mapping[str, Sequence[str]], rms: FloatArray, tolerance: float) -> list[Performance]:
    """How well a model fits by each factor.

    Args:
        factors: By name, the level of each trial, (n,).
        rms: Of what the model leaves of each trial [m], (n,).
        tolerance: RMS beyond which it is not called valid [m].
    """
    found: list[Performance] = []
    for factor, cells in factors.items():
        levels = levels_of(rms * units.MM, cells)
        limit, verdict = _limit(levels, tolerance * units.MM)
        found.append(Performance(factor=factor, levels=levels, limit=limit, verdict=verdict))
    return found


def _limit(levels: Sequence[Level], tolerance: float) -> tuple[float | None, str]:
    """Where the mean RMS passes the tolerance, and in words. RMS and tolerance in mm."""
    within = [level.mean <= tolerance for level in levels]
    if all(within):
        return None, f"within {tolerance:g} mm at every level tried"
    if not any(within):
        return None, f"beyond {tolerance:g} mm at every level tried"
    first = within.index(False)
    at = numbers([level.level for level in levels])
    if at is None or not first or any(within[first:]):
        good = ", ".join(level.level for level, fine in zip(levels, within, strict=True) if fine)
        return None, f"within {tolerance:g} mm at {good} only"
    low, high = levels[first - 1].mean, levels[first].mean
    limit = at[first - 1] + (tolerance - low) / (high - low) * (at[first] - at[first - 1])
    between = f"between the levels {levels[first - 1].level} and {levels[first].level}"
    return limit, f"within {tolerance:g} mm up to {limit:.3g} ({between})"


def validity(performance: Sequence[Performance], fastest: float) -> Validity:
    """Limits that fuse can check: speed, and distance from the base where a factor is called so.

    Args:
        performance: By each factor.
        fastest: Speed of the fastest trial [m/s], which limits where no factor does.
    """
    limits = {one.factor: one.limit for one in performance}
    radius = limits.get("radius_mm")
    return Validity(
        max_speed=limits.get("speed_m_s") or fastest, max_radius=None if radius is None else radius / units.MM
    )
