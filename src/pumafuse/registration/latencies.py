"""How late sensors are, each beside the arm or beside another one that saw the same tool.

Beside another one by what both tell, never as a difference of lags: what the arm does not do as commanded is the same
to both, and so costs nothing. Frames and scales that are slightly wrong leave an affine function of the position, a
marker that is leaves R m: both are found beside the time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import BoolArray, FloatArray, median
from ..fusion.config import FusionConfig
from ..fusion.placing import Placing
from ..logs.run import Run
from .configured import set_placements
from .intervals import blocks
from .motion import Answer, Motion, Plant, drop_repeated, motion_of
from .register import Quantity, Registration
from .solve import MEDIAN, curvature, weights
from .start import despike

_SPEED = 0.05  # s, over which a velocity is taken
_ROUNDS = 10  # of the weights and of the time
_FEWEST = 60  # rows
_UNKNOWN = 0.05  # s, of half an interval
_ROUNDING = 1e-12  # m


def latencies_of(
    runs: Sequence[Run], registrations: Mapping[str, Registration], config: FusionConfig, lag: float | None
) -> dict[str, Quantity]:
    """The latency of each sensor [s]: that of the surest lag beyond the arm's, those of others beside it.

    Where the arm's lag is not known, the earliest sensor has none. Sensors are compared with one that tells
    orientations, if there is one: it tells where the points are that others see.
    """
    lags = {
        name: registration.position.lag
        for name, registration in registrations.items()
        if registration.position is not None and not registration.read_otherwise
    }
    if not lags:
        return {}
    best = min(lags, key=lambda name: (registrations[name].rms_rotation is None, lags[name].half))
    beside, placed = {best: Quantity.around(0.0)}, set_placements(config, registrations, {})
    for name in (other for other in lags if other != best):
        both = [run for run in runs if {name, best} <= run.sensors.keys()]
        points = [_of_point(run, best, registrations[best], placed, name) for run in both]
        by_both = later(points, [_in_base(run, name, placed) for run in both], lags[name].value - lags[best].value)
        beside[name] = by_both or _sum(lags[name], -lags[best].value)
    if lag is None:
        first, of_first = min(beside, key=lambda name: beside[name].value), Quantity.around(0.0)
    else:
        first = min(lags, key=lambda name: lags[name].half)
        of_first = _sum(lags[first], -lag)
    return {
        name: of_first
        if name == first
        else _sum(latency, of_first.value - beside[first].value, beside[first], of_first)
        for name, latency in beside.items()
    }


def _in_base(run: Run, name: str, config: FusionConfig) -> Motion:
    """What a placed sensor sees, where it is in the base's frame."""
    seen = drop_repeated(run.sensors[name]).valid()
    return seen._replace(position=Placing(config.sensors[name], config.arm).to_base(seen.position))


def _of_point(run: Run, name: str, registration: Registration, config: FusionConfig, point: str) -> Motion:
    """What a placed sensor tells of the point that another one sees, and how the tool is turned, if that is told."""
    seen, placing = _in_base(run, name, config), Placing(config.sensors[name], config.arm)
    if seen.quaternion is not None and registration.rms_rotation is not None:
        turned = placing.orientation(seen.quaternion)
    else:
        turned = _commanded_orientation(run, seen.time, registration)
    if turned is None:
        return seen._replace(quaternion=None)
    lever = Placing(config.sensors[point], config.arm).lever(turned) - placing.lever(turned)
    return Motion(seen.time, seen.position + lever, turned)


def _commanded_orientation(run: Run, time: FloatArray, registration: Registration) -> FloatArray | None:
    """How the commands have turned the tool when a sensor measures, as quaternions; None where they do not tell."""
    command, response = motion_of(run.command).valid(), registration.rotation or registration.position
    if command.quaternion is None or response is None:
        return None
    plant = Plant(response.delay.value, response.time_constant.value)
    return Answer([command], [time]).quaternions(plant)


def _sum(quantity: Quantity, by: float, *unsure: Quantity) -> Quantity:
    """A number moved by another one, which is as unsure as some others are together."""
    return Quantity.around(quantity.value + by, sum(each.half for each in (quantity, *unsure)))


def later(first: Sequence[Motion], other: Sequence[Motion], about: float = 0.0) -> Quantity | None:
    """How much later the stamps of one sensor's rows are than those of another's [s], ``about`` so much.

    The first one tells in the base's frame of the point that the other one sees there, and, where it is known, how the
    tool is turned; one entry a run. None where both have too little in common, or it is not known to 50 ms.
    """
    pairs = [(_Path(a.valid()), b.valid()) for a, b in zip(first, other, strict=True)]
    pairs = [(path, b.only(path.covers(b.time - about))) for path, b in pairs]
    pairs = [(path, b) for path, b in pairs if len(b.time) >= _FEWEST]
    if not pairs:
        return None
    late, weight = about, np.ones(sum(len(b.time) for _, b in pairs))
    half = np.inf
    for _ in range(_ROUNDS):
        parts = [path.beside(b, late) for path, b in pairs]
        apart, slope = (np.concatenate(part) for part in zip(*parts, strict=True))
        step = -blocks(slope, apart, weight, weight).step()
        left = apart - slope @ step
        half = float(blocks(slope, left, curvature(weight), weight).half_widths(np.eye(len(step))[-1:])[0])
        late += float(step[-1])
        far = np.linalg.norm(left, axis=1)
        weight = weights(far, max(median(far) / MEDIAN, _ROUNDING))
    return Quantity.around(late, half) if 0.0 < half < _UNKNOWN else None


class _Path:
    """What the first sensor tells of one run, at any instant."""

    def __init__(self, first: Motion) -> None:
        turned = [] if first.quaternion is None else [Rotation.from_quat(first.quaternion).as_matrix().reshape(-1, 9)]
        self._time, self._pose = first.time, np.hstack([despike(first.position), *turned])

    def covers(self, time: FloatArray) -> BoolArray:
        """Whether there are velocities at some instants, also when they are shifted a little."""
        first, last = (self._time[0], self._time[-1]) if len(self._time) else (np.inf, -np.inf)
        return (time >= first + 2.0 * _SPEED) & (time <= last - 2.0 * _SPEED)

    def _at(self, time: FloatArray) -> FloatArray:
        columns: list[FloatArray] = [np.interp(time, self._time, column) for column in self._pose.T]
        return np.column_stack(columns)

    def beside(self, other: Motion, late: float) -> tuple[FloatArray, FloatArray]:
        """How far the other sensor's rows are off [m], (n, 3), and the slopes of that, (n, 3, k): the last is of time.

        Before it are those of what is affine, and of the marker.
        """
        time = other.time - late
        pose, ahead, behind = self._at(time), self._at(time + _SPEED), self._at(time - _SPEED)
        position, turned = pose[:, :3], pose[:, 3:].reshape(len(pose), 3, -1)
        affine = np.column_stack([position - position.mean(axis=0), np.ones(len(position))])
        affine = np.einsum("ij,nk->nijk", np.eye(3), affine).reshape(len(position), 3, -1)
        speed = (behind - ahead)[:, :3, None] / (2.0 * _SPEED)
        return other.position - position, np.concatenate([affine, turned, speed], axis=-1)
