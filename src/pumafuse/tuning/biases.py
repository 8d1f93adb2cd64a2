"""Sensors that are off by a constant nobody told of: found by likelihood, and given a bias to estimate."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import msgspec
import numpy as np

from ..fusion.config import FusionConfig
from ..units import MM
from .climb import Point
from .likelihood import Evidence
from .parameters import is_held, least_sd

_GAIN = 3.0  # log-likelihood that a bias must be worth; its prior's width has been paid for in it
_TRIED = (1e-3, 1e-2, 1e-1)  # m, widths of the prior
_FAR = 20.0  # times all that is uncertain, from which a gap is no noise
_ROOM = 3.0  # width of the prior over what was found


def far_off(evidence: Evidence, config: FusionConfig, hold: Sequence[str]) -> tuple[FusionConfig, list[str]]:
    """The configuration with a bias for each sensor that is so far off that nothing could be learnt from it.

    Returns:
        The configuration, and a sentence on each.
    """
    gaps: dict[str, float] = {}
    misfit = dict(zip(evidence.axes, evidence.misfit(config).tolist(), strict=True))
    for (name, axis), (answer, seen) in evidence.answers(config, centred=False).items():
        gap = abs(float(np.median(seen - answer)))
        scatter = evidence.scatter.get(f"sensors.{name}.sd_mm.{axis}", 0.0)
        if gap > _FAR * (scatter + misfit[axis] + config.start.offset_sd):
            gaps[name] = max(gap, gaps.get(name, 0.0))
    widths = {name: _ROOM * gap for name, gap in gaps.items() if _may(config, name, hold)}
    notes = [
        f"sensor '{name}' is off by a constant of up to {gaps[name] * MM:.4g} mm: it was given a bias to estimate"
        for name in widths
    ]
    return _with_biases(config, widths), notes


def slightly_off(evidence: Evidence, best: Point, hold: Sequence[str]) -> tuple[FusionConfig, list[str]]:
    """The configuration with a bias for each sensor that contradicts a better one by a constant.

    Returns:
        The configuration, and a sentence on each.
    """
    config, notes = best.config, list[str]()
    heard = {name for names in evidence.heard.values() for name in names}
    ranked = sorted((name for name in config.sensors if name in heard), key=lambda name: least_sd(config, name))
    for name in reversed(ranked[1:]):  # the most accurate is believed, of equals the first in the file
        if not _may(config, name, hold):
            continue
        before = evidence.value(config).total
        tried = {width: evidence.value(_with_biases(config, {name: width})).total - before for width in _TRIED}
        width = max(tried, key=lambda width: tried[width])
        if tried[width] > _GAIN:
            config = _with_biases(config, {name: width})
            notes.append(
                f"sensor '{name}' is off by a constant: a bias to estimate (bias_sd_mm = {width * MM:g}) gains"
                f" {tried[width]:.1f} in log-likelihood"
            )
    return config, notes


def _may(config: FusionConfig, name: str, hold: Collection[str]) -> bool:
    return config.sensors[name].bias_sd == 0.0 and not is_held(f"sensors.{name}.bias_sd_mm", hold)


def _with_biases(config: FusionConfig, widths: Mapping[str, float]) -> FusionConfig:
    """The configuration with biases as wide as ``widths`` [m], in one digit."""
    sensors = dict(config.sensors)
    for name, width in widths.items():
        digit = 10.0 ** math.floor(math.log10(width))
        sensors[name] = msgspec.structs.replace(sensors[name], bias_sd=math.ceil(width / digit - 1e-9) * digit)
    return msgspec.structs.replace(config, sensors=sensors)
