"""The floor under a verification: the best that a linear model of the same order can do on the run itself."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..model.arm import AxisModel, Gain
from ..model.plants import PLANTS, FirstOrder, SecondOrder
from .measured import Commands, Fit, Measured

_DELAYS, _LATEST = 13, 9.0  # of the first grid: how many, up to how many periods
_LAGS, _RATIOS = 5, (0.05, 0.25, 0.8)  # of 2ζ/ω; of 1/ω² over its square
_STARTS = 3  # cells of it to go on from


class Floor(msgspec.Struct, frozen=True, kw_only=True):
    """The best linear model of the order, refitted on the run.

    Attributes:
        fit: How well it fits.
        delay: Td [s].
        gain: K, at the commands' mean speed.
        plant: Of unit gain.
    """

    fit: Fit
    delay: float = msgspec.field(name="delay_ms")
    gain: float
    plant: PLANTS


def best_of_order(measured: Measured, command: Commands, model: AxisModel, delay: float, start: float) -> Floor:
    """The best gain, delay and plant of the model's order on this run; gain and bias are linear.

    Args:
        measured: To be fitted.
        command: What drives the axis.
        model: Its order and recovery stay; the search also begins at its plant.
        delay: Its Td, where the search also begins [s].
        start: Level before the first command [m].
    """
    from scipy.optimize import least_squares

    z = measured.position - measured.position.mean()
    columns = _gain_columns(command, model)

    def basis(x: FloatArray) -> FloatArray:
        refitted = [msgspec.structs.replace(axis, plant=_plant_at(x)) for axis in columns]
        moved = [command.moved(axis, float(x[0]) ** 2, start, measured.time) for axis in refitted]
        independent = np.stack([moved[0], *(column - moved[0] for column in moved[1:])], axis=1)
        return independent - independent.mean(axis=0)

    def shares(design: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.lstsq(design, z, rcond=None)[0], dtype=np.float64)

    def left(x: FloatArray) -> FloatArray:
        design = basis(x)
        return z - design @ shares(design)

    starts = [_coordinates(delay, model.plant), *_starts(left, command.period, model.plant)]
    best = min(
        (least_squares(left, x, x_scale="jac", xtol=1e-10, ftol=1e-12, gtol=1e-12, max_nfev=300) for x in starts),
        key=lambda found: found.cost,
    )
    design = basis(best.x)
    share = shares(design)
    speed = np.array(command.speeds.mean())
    return Floor(
        fit=measured.fit(design @ share, command.amplitude),
        delay=float(best.x[0]) ** 2,
        gain=float(share[0] + sum(share[k] * (columns[k].gain.at(speed) - 1.0) for k in range(1, len(columns)))),
        plant=_plant_at(best.x),
    )


def _gain_columns(command: Commands, model: AxisModel) -> list[AxisModel]:
    """Axes whose responses span those of all gains: K = 1; another K where it recovers; K that rises with speed."""
    gains = [Gain()]
    if model.gain_recovery is not None:
        gains.append(Gain(intercept=2.0))
    if np.ptp(command.speeds) > 1e-6 * command.speeds.max():
        gains.append(Gain(slope=1.0))
    return [msgspec.structs.replace(model, gain=gain) for gain in gains]


def _starts(left: Callable[[FloatArray], FloatArray], period: float, plant: PLANTS) -> list[FloatArray]:
    """The best cells of a grid of delays and plants, of different delays."""
    ratios = (None,) if isinstance(plant, FirstOrder) else _RATIOS
    found: list[tuple[float, FloatArray]] = []
    for delay in np.linspace(0.0, _LATEST * period, _DELAYS).tolist():
        cells = [
            np.array([np.sqrt(delay), np.log(q), *([] if ratio is None else [0.5 * np.log(ratio * q * q)])])
            for q in np.geomspace(0.2 * period, 10.0 * period, _LAGS).tolist()
            for ratio in ratios
        ]
        found.append(min(((float(np.sum(left(x) ** 2)), x) for x in cells), key=lambda one: one[0]))
    return [x for _, x in sorted(found, key=lambda one: one[0])[:_STARTS]]


def _coordinates(delay: float, plant: PLANTS) -> FloatArray:
    """√Td and log τ, or log 2ζ/ω and log 1/ω: free of bounds."""
    if isinstance(plant, FirstOrder):
        return np.array([np.sqrt(delay), np.log(plant.time_constant)])
    return np.array([np.sqrt(delay), np.log(plant.lag), -np.log(plant.natural_frequency)])


def _plant_at(x: FloatArray) -> PLANTS:
    q = float(np.exp(np.clip(x[1], -12.0, 6.0)))
    if len(x) == 2:
        return FirstOrder(time_constant=q)
    omega = float(np.exp(-np.clip(x[2], -12.0, 6.0)))
    return SecondOrder(natural_frequency=omega, damping=0.5 * q * omega)
