"""Can anything be learnt from these measurements? A line for each reason why not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import PumafuseError
from ..fusion.config import FusionConfig
from ..units import MM
from .likelihood import Evidence

_FEWEST = 30  # components of an axis, or of a sensor that is asked whether it agrees
_STILL = 3.0  # motion over noise below which an axis has not moved
_AGREES = 0.5  # correlation of measurements with the arm's answer to its commands
_AS_FAR = (0.1, 10.0)  # times, that a sensor can move as far as the arm must
_MOVES = 10.0  # motion over scatter from which it must agree


class TuneError(PumafuseError):
    """Recorded runs from which nothing can be learnt."""


def moving(evidence: Evidence, config: FusionConfig) -> list[str]:
    """The axes that move and are seen to.

    Raises:
        TuneError: There are too few measurements, no axis moves, or a sensor does not follow the commands at all.
    """
    for axis, count in zip(evidence.axes, evidence.count.tolist(), strict=True):
        if 0 < count < _FEWEST:
            raise TuneError(f"{axis}: only {count} measurements; to learn from, at least {_FEWEST} are needed")
    if not evidence.count.any():
        raise TuneError("no measurement of a configured sensor lies within the runs: nothing to learn from")
    found = [axis for axis in evidence.heard if _moves(evidence, axis)]
    if not found:
        widest = max(evidence.travel.values()) * MM
        raise TuneError(
            f"no axis is commanded to move by more than its sensors' noise (at most {widest:.3g} mm): what rests tells"
            " nothing of an arm; record a run with motion"
        )
    _in_time(evidence)
    _agreeing(evidence, config, found)
    return found


def _in_time(evidence: Evidence) -> None:
    """Refuse a sensor whose clock is another one."""
    for name, share in evidence.afterwards.items():
        if share > 0.5:
            raise TuneError(
                f"sensor '{name}': {share:.0%} of its measurements lie more than 1 s after the last command: are both"
                " stamped by one clock?"
            )


def _moves(evidence: Evidence, axis: str) -> bool:
    sds = [evidence.scatter.get(f"sensors.{name}.sd_mm.{axis}", 0.0) for name in evidence.heard[axis]]
    return bool(sds) and evidence.travel[axis] > _STILL * min(sds)


def _agreeing(evidence: Evidence, config: FusionConfig, axes: Sequence[str]) -> None:
    """Refuse a sensor that does not go where the arm must go under its commands, or not as far, whatever its noise."""
    for (name, axis), (answer, seen) in evidence.answers(config).items():
        scatter = evidence.scatter.get(f"sensors.{name}.sd_mm.{axis}", 0.0)
        if axis not in axes or len(seen) < _FEWEST or float(np.ptp(answer)) < _MOVES * scatter:
            continue
        apart = np.abs(seen - answer)
        near = apart <= 10.0 * np.median(apart) + 1e-12  # outliers tell nothing
        power = float(np.sqrt(np.sum(answer[near] ** 2) * np.sum(seen[near] ** 2)))
        follows = float(np.sum(answer[near] * seen[near])) / power if power > 0.0 else 0.0
        if follows < _AGREES:
            what = "moves against" if follows < -_AGREES else "does not follow"
            raise TuneError(
                f"sensor '{name}' {what} the commands of {axis} (correlation {follows:+.2f}): is it that axis, is its"
                " scale right (-1 for a distance that falls), are both stamped by one clock?"
            )
        size = follows * float(np.sqrt(np.sum(seen[near] ** 2) / np.sum(answer[near] ** 2)))
        if not _AS_FAR[0] < size < _AS_FAR[1]:
            raise TuneError(
                f"sensor '{name}' moves {size:.3g} times as far as the commands of {axis} and its scale say: is a unit"
                " wrong?"
            )
