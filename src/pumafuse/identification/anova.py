"""Dependence of coefficients and of the model's error on what was varied: the paper's Table I and Fig. 7.

The i-ratio is F of a one-way analysis of variance over its 95 % point: above 1 the means differ. It assumes equal
variances and one factor at a time. Beside it stand Welch's test, which does not assume equal variances, and an analysis
with all factors at once, which an unbalanced design needs.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import product

import msgspec
import numpy as np

from ..arrays import BoolArray, FloatArray
from ..model.arm import Validity
from ..units import MM, SCREEN, Kind, of_kind
from .estimate import fit_weighted
from .trials import Trial

_COUNTERS = frozenset({"replicate", "repetition", "repeat", "rep", "run", "observation"})  # columns that only count
_OUTLYING = 8.0  # robust standard deviations from the median
_LEAST_SD = 0.005  # of the median: the smallest robust standard deviation that is believed
_FEWEST = 5  # values among which one can be outlying
_MOST_LEVELS = 12  # a numeric factor with more is cut into quarters


class Level(msgspec.Struct, frozen=True, kw_only=True):
    """A coefficient at one level of a factor, in the coefficient's unit; sd is null of a single trial."""

    level: str
    trials: int
    mean: float
    sd: float | None


class Dependence(msgspec.Struct, frozen=True, kw_only=True):
    """Whether one coefficient depends on one factor."""

    coefficient: str  # with its unit
    factor: str  # what was varied
    levels: list[Level]  # the coefficient at each level
    # F over the 95 % point of its distribution; above 1 is dependent. Null where it cannot be computed
    i_ratio: float | None
    p: float | None  # of that F
    welch_p: float | None  # of Welch's test, which does not assume equal variances
    adjusted_p: float | None  # of the factor beside all the others; null where they are confounded
    verdict: str


class Scatter(msgspec.Struct, frozen=True, kw_only=True):
    """Scatter of one coefficient on one axis, in its unit."""

    coefficient: str  # with its unit
    axis: str  # of the trials
    median: float  # over the trials
    # of a Shapiro-Wilk test; small: not normally distributed, so do not trust means and i-ratios alone
    normal_p: float | None
    outlying: list[str]  # trials further from the median than eight robust standard deviations
    replicate_sd: float | None  # between trials of the same settings; null where none were repeated
    own_sd: float  # by the noise within a trial (median over the trials)


class Performance(msgspec.Struct, frozen=True, kw_only=True):
    """Error of the combined model by one factor."""

    factor: str  # what was varied
    levels: list[Level]  # RMS [mm or degrees] of the trials at each level
    limit: float | None  # where the mean RMS passes the tolerance, in the factor's unit; null where it does not
    verdict: str


def factors_of(trials: Sequence[Trial], period: float, kind: Kind) -> dict[str, list[str]]:
    """The level of each trial for every factor that varies and is no mere counter; T [s] for speeds not recorded."""
    speeds = speed_levels(trials, period, kind)
    columns = {"axis": [trial.axis for trial in trials], of_kind("speed_m_s", kind): speeds}
    for name in trials[0].factors:
        if name not in _COUNTERS:
            columns[name] = _levels([trial.factors[name] for trial in trials])
    sense = ["+" if trial.step > 0.0 else "-" for trial in trials]
    if not any(len(set(zip(cells, sense, strict=True))) == len(set(cells)) == 2 for cells in columns.values()):
        columns["sense"] = sense
    return {name: levels for name, levels in columns.items() if 1 < len(set(levels)) <= max(len(trials) // 2, 2)}


def speed_levels(trials: Sequence[Trial], period: float, kind: Kind) -> list[str]:
    """Each trial's speed in m/s or degrees/s, to two digits."""
    shown = (f"{trial.speed_at(period) * SCREEN[kind].fast_scale:.2g}" for trial in trials)
    return [f"{float(speed):g}" for speed in shown]  # 140, not 1.4e+02


def numbers(cells: Sequence[str]) -> list[float] | None:
    """Levels as numbers; None where one is none."""
    try:
        numbers = [float(cell) for cell in cells]
    except ValueError:
        return None
    return numbers if np.isfinite(numbers).all() else None


def order_levels(levels: set[str]) -> list[str]:
    """Levels by number where they are numbers, else by name."""
    if numbers(list(levels)) is None:
        return sorted(levels)
    return sorted(levels, key=lambda level: (float(level), level))


def levels_of(values: FloatArray, cells: Sequence[str]) -> list[Level]:
    """Mean and scatter of (n,) values at each level named in ``cells`` (n,)."""
    return [
        Level(
            level=level,
            trials=len(group),
            mean=float(group.mean()),
            sd=float(group.std(ddof=1)) if len(group) > 1 else None,
        )
        for level, group in _groups(values, cells).items()
    ]


def dependences(coefficients: Mapping[str, FloatArray], factors: Mapping[str, Sequence[str]]) -> list[Dependence]:
    """Every coefficient, (trials,), against every factor, the level of each trial."""
    from scipy.stats import f, f_oneway

    dependences = list[Dependence]()
    for (coefficient, values), factor in product(coefficients.items(), factors):
        groups = list(_groups(values, factors[factor]).values())
        by_welch, adjusted, ratio, p = welch(groups), _adjusted_p(values, factor, factors), None, None
        if any(np.ptp(group) > 0.0 for group in groups):
            test = f_oneway(*groups)
            ratio = float(test.statistic / f.ppf(0.95, len(groups) - 1, len(values) - len(groups)))
            p = float(test.pvalue)
        dependences.append(
            Dependence(
                coefficient=coefficient,
                factor=factor,
                levels=levels_of(values, factors[factor]),
                i_ratio=ratio,
                p=p,
                welch_p=by_welch,
                adjusted_p=adjusted,
                verdict=_verdict(ratio, by_welch, adjusted, alone=len(factors) == 1),
            )
        )
    return dependences


def welch(groups: Sequence[FloatArray]) -> float | None:
    """P of the hypothesis that groups have one mean, whatever their variances; None where it cannot be tested."""
    from scipy.stats import f_oneway

    usable = [group for group in groups if len(group) > 1 and np.ptp(group) > 0.0]
    return float(f_oneway(*usable, equal_var=False).pvalue) if len(usable) > 1 else None


def scatter(coefficient: str, trials: Sequence[Trial], values: FloatArray, sd: FloatArray) -> Scatter:
    """Scatter of a coefficient, ``values`` (n,), among trials of one axis; ``sd`` is by the noise within each, (n,)."""
    from scipy.stats import shapiro

    normal = float(shapiro(values).pvalue) if len(values) >= 3 and np.ptp(values) > 0.0 else None
    return Scatter(
        coefficient=coefficient,
        axis=trials[0].axis,
        median=float(np.median(values)),
        normal_p=normal,
        outlying=[trial.name for trial, far in zip(trials, outlying(values, sd), strict=True) if far],
        replicate_sd=_replicate_sd(trials, values),
        own_sd=float(np.median(sd)),
    )


def outlying(values: FloatArray, sd: FloatArray) -> BoolArray:
    """Which values (n,) are further than eight robust standard deviations (1.4826 MAD) from the median, (n,).

    The ``sd`` of each by the noise within its trial, (n,), widens the limit.
    """
    from scipy.stats import median_abs_deviation

    if len(values) < _FEWEST:
        return np.zeros(len(values), dtype=bool)
    middle = float(np.median(values))
    spread = max(float(median_abs_deviation(values, scale="normal")), _LEAST_SD * abs(middle))
    return np.abs(values - middle) > _OUTLYING * np.hypot(spread, sd)


def performances(
    factors: Mapping[str, Sequence[str]], rms: FloatArray, tolerance: float, kind: Kind
) -> list[Performance]:
    """Error of a model by each factor: ``rms`` of each trial's residuals, (n,), and ``tolerance``, both [m or rad]."""
    screen, performances = SCREEN[kind], list[Performance]()
    for factor, cells in factors.items():
        levels = levels_of(rms * screen.scale, cells)
        limit, verdict = _limit(levels, tolerance * screen.scale, screen.unit)
        performances.append(Performance(factor=factor, levels=levels, limit=limit, verdict=verdict))
    return performances


def _levels(cells: Sequence[str]) -> list[str]:
    """A factor's levels; a numeric one with many is cut into quarters."""
    values = numbers(cells)
    if values is None or len(set(cells)) <= _MOST_LEVELS:
        return list(cells)
    quarter = np.searchsorted(np.quantile(values, [0.25, 0.5, 0.75]), values)
    middles = {part: f"{np.median(np.array(values)[quarter == part]):.4g}" for part in set(quarter.tolist())}
    return [middles[part] for part in quarter.tolist()]


def validity(performance: Sequence[Performance], fastest: float, kind: Kind) -> Validity:
    """Limits that `fuse` can check: speed, and distance from the base where a factor is called radius_mm.

    The speed of the ``fastest`` trial [m/s or rad/s] is the limit where no factor gives one.
    """
    limits = {tested.factor: tested.limit for tested in performance}
    radius, limit = limits.get("radius_mm"), limits.get(of_kind("speed_m_s", kind))
    speed = limit / SCREEN[kind].fast_scale if limit else fastest
    return Validity(
        max_speed=speed if kind == "length" else None,
        max_angular_speed=speed if kind == "angle" else None,
        max_radius=None if radius is None else radius / MM,
    )


def _groups(values: FloatArray, cells: Sequence[str]) -> dict[str, FloatArray]:
    """Values by level, in the order of the levels."""
    named = np.array(cells)
    return {level: values[named == level] for level in order_levels(set(cells))}


def _replicate_sd(trials: Sequence[Trial], values: FloatArray) -> float | None:
    """Pooled over groups of trials whose step and factors are the same."""
    groups: defaultdict[tuple[object, ...], list[float]] = defaultdict(list)
    for trial, value in zip(trials, values.tolist(), strict=True):
        settings = tuple(sorted((name, cell) for name, cell in trial.factors.items() if name not in _COUNTERS))
        groups[(trial.step, settings)].append(value)
    squares = sum(float(np.var(group)) * len(group) for group in groups.values())
    freedom = len(values) - len(groups)
    return float(np.sqrt(squares / freedom)) if freedom else None


def _adjusted_p(values: FloatArray, factor: str, factors: Mapping[str, Sequence[str]]) -> float | None:
    """P of one factor in a model with all of them (main effects)."""
    without = {name: cells for name, cells in factors.items() if name != factor}
    full, reduced = (
        fit_weighted(values, np.ones(len(values)), _design(values, columns)) for columns in (factors, without)
    )
    if full.freedom < 1 or full.freedom == reduced.freedom or full.squares <= 1e-24 * float(values @ values):
        return None
    return full.p_against(reduced)


def _design(values: FloatArray, factors: Mapping[str, Sequence[str]]) -> FloatArray:
    """A one, and for each factor a column for each level but its first, (n, k)."""
    columns = [np.ones(len(values))]
    for cells in factors.values():
        columns.extend(np.array(cells) == level for level in order_levels(set(cells))[1:])
    return np.column_stack(columns).astype(np.float64)


def _verdict(ratio: float | None, welch: float | None, adjusted: float | None, alone: bool) -> str:
    if ratio is None:
        return "cannot be tested: no scatter within any level"
    words = {True: "dependent", False: "independent"}
    verdict = words[ratio > 1.0]
    if welch is not None and (welch < 0.05) != (ratio > 1.0):
        verdict += f", but by Welch's test {words[welch < 0.05]}"
    if adjusted is None:
        return verdict if alone else f"{verdict}; confounded with the other factors"
    if (adjusted < 0.05) != (ratio > 1.0):
        verdict += f"; beside the other factors {words[adjusted < 0.05]}"
    return verdict


def _limit(levels: Sequence[Level], tolerance: float, unit: str) -> tuple[float | None, str]:
    """Where the mean RMS passes the tolerance, and in words. RMS and tolerance in ``unit``."""
    within = [level.mean <= tolerance for level in levels]
    if len(set(within)) == 1:
        return None, f"{'within' if within[0] else 'beyond'} {tolerance:g} {unit} at every level tried"
    at, first = numbers([level.level for level in levels]), within.index(False)
    if at is None or not first or any(within[first:]):
        good = ", ".join(level.level for level in levels if level.mean <= tolerance)
        return None, f"within {tolerance:g} {unit} at {good} only"
    low, high = levels[first - 1 : first + 1]
    limit = float(np.interp(tolerance, [low.mean, high.mean], at[first - 1 : first + 1]))
    return limit, f"within {tolerance:g} {unit} up to {limit:.3g} (between the levels {low.level} and {high.level})"
