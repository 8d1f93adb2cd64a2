"""The best linear model of an order on a run: no model of that order fits its measurements better."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from ..arrays import FloatArray, TimeArray
from ..filter.response import response
from ..model.arm import AxisModel, Gain, commanded_speed
from ..model.plants import PLANTS, SecondOrder
from ..toml import Interval
from .estimate import t_quantile
from .fit import plant_of

_SPIKE = 8.0  # robust standard deviations
_DELAYS, _LATEST = 13, 9.0  # of the first grid: how many, up to how many periods
_LAGS, _RATIOS = 5, (0.05, 0.25, 0.8)  # of 2ζ/ω; of 1/ω² over its square
_STARTS = 3  # cells of it to search from
_BLOCKS = 10  # of a run, whose errors count as independent of each other
_STEP = 1e-4  # of the derivatives for the lag's interval
_BOUNDS = -12.0, 6.0  # of √Td, log q and log √p


class ModelFit(msgspec.Struct, frozen=True, kw_only=True):
    """Error of a simulated position against the measured one.

    Attributes:
        rms: Of the difference, without its mean [m or rad].
        percent: Of the amplitude of the commands.
        fit: 100 (1 − ‖difference‖ / ‖measured‖), both without their means.
    """

    rms: float = msgspec.field(name="rms_mm")
    percent: float = msgspec.field(name="percent_of_signal")
    fit: float = msgspec.field(name="fit_percent")


class BestInClass(msgspec.Struct, frozen=True, kw_only=True):
    """The best linear model of the order, refitted on the run.

    Attributes:
        fit: Its error.
        lag: Behind the held command at constant velocity, at the commands' mean speed [s].
        lag_ci95: Its 95 % interval [s].
        delay: Td [s].
        gain: K, at the commands' mean speed.
        plant: Of unit gain.
    """

    fit: ModelFit
    lag: float = msgspec.field(name="lag_ms")
    lag_ci95: Interval = msgspec.field(name="lag_ms_ci95")
    delay: float = msgspec.field(name="delay_ms")
    gain: float
    plant: PLANTS


@dataclass(frozen=True)
class Measured:
    """Measurements of one axis by one source; arrays (n,).

    Attributes:
        run: The run's name.
        source: The sensor, or ``reference``.
        time: Of each, int64 ns, ascending.
        position: As logged [m or rad].
    """

    run: str
    source: str
    time: TimeArray
    position: FloatArray

    def without_spikes(self, modelled: FloatArray) -> Measured:
        """The measurements that do not jump away from their neighbours, whatever the model.

        A model that is wrong for a while must not be spared: only eight robust standard deviations from the running
        median of five count.
        """
        from scipy.ndimage import median_filter
        from scipy.stats import median_abs_deviation

        residual = self.position - modelled
        jump = residual - median_filter(residual, size=5, mode="nearest")
        kept = np.abs(jump) <= _SPIKE * max(float(median_abs_deviation(residual, scale="normal")), 1e-9)
        return replace(self, time=self.time[kept], position=self.position[kept])

    def fit(self, modelled: FloatArray, amplitude: float) -> ModelFit:
        """Error of ``modelled`` (n,) without its mean, beside the ``amplitude`` of the commands [both m or rad]."""
        rms, signal = float(np.std(self.position - modelled)), float(np.std(self.position))
        return ModelFit(
            rms=rms,
            percent=100.0 * rms / amplitude if amplitude > 0.0 else np.inf,
            fit=100.0 * (1.0 - rms / signal) if signal > 0.0 else -np.inf,
        )


@dataclass(frozen=True)
class Commands:
    """Commands of one axis; arrays (k,).

    Attributes:
        time: Of each, int64 ns, ascending.
        value: u [m or rad].
        period: T [s].
    """

    time: TimeArray
    value: FloatArray
    period: float

    @property
    def amplitude(self) -> float:
        """From the lowest to the highest [m or rad]."""
        return float(np.ptp(self.value))

    @property
    def speeds(self) -> FloatArray:
        """Of the commands that move [m/s or rad/s]."""
        return commanded_speed(np.diff(self.value)[np.diff(self.value) != 0.0], self.period)

    def moved(self, axis: AxisModel, delay: float, start: float, time: TimeArray) -> FloatArray:
        """Where the axis is at ``time`` [ns], relative to ``start`` [m or rad], (n,)."""
        return response(axis, self.period, delay, self.time, self.value, start, time)


def best_in_class(measured: Measured, command: Commands, model: AxisModel, delay: float, start: float) -> BestInClass:
    """The best gain, delay and plant of the model's order on this run.

    Args:
        measured: To be fitted.
        command: Of the axis.
        model: Its order and recovery stay; its plant is one start of the search.
        delay: Its Td, also a start [s].
        start: Level before the first command [m or rad].
    """
    columns = _gain_columns(command, model)
    problem = _Problem(measured, command, columns, start, measured.position - measured.position.mean())
    own = model.plant.natural_frequency**-2 if isinstance(model.plant, SecondOrder) else 0.0  # p
    best = problem.solve([_coordinates(delay, model.plant.lag, own), *problem.starts(second_order=own > 0.0)])
    modelled, share = problem.modelled(best)
    speed = np.array(command.speeds.mean())

    def axis_at(parameters: FloatArray) -> AxisModel:
        """The axis with these parameters, its gain at the mean speed."""
        share = parameters[len(best) :]
        gain = share[0] + sum(share[k] * (columns[k].gain.at(speed) - 1.0) for k in range(1, len(columns)))
        return msgspec.structs.replace(
            model, plant=_plant_at(parameters[: len(best)]), gain=Gain(intercept=float(gain))
        )

    def lag(parameters: FloatArray) -> float:
        return axis_at(parameters).lag(float(parameters[0]) ** 2)

    at = np.concatenate((best, share))
    steps = _STEP * np.eye(len(at))
    slope = np.array([lag(at + step) - lag(at - step) for step in steps])

    def positions(parameters: FloatArray) -> FloatArray:
        return problem.columns_at(parameters[: len(best)]) @ parameters[len(best) :]

    jacobian = np.stack([positions(at + step) - positions(at - step) for step in steps], axis=1)
    half = _half_width(jacobian, slope, problem.z - modelled)
    axis = axis_at(at)
    return BestInClass(
        fit=measured.fit(modelled, command.amplitude),
        lag=lag(at),
        lag_ci95=(lag(at) - half, lag(at) + half),
        delay=float(best[0]) ** 2,
        gain=axis.gain.intercept,
        plant=axis.plant,
    )


@dataclass(frozen=True)
class _Problem:
    """Least squares over delay and plant; the best gain at each is linear (Golub & Pereyra's variable projection).

    Attributes:
        measured: To be fitted.
        command: Of the axis.
        axes: With the gains whose responses span those of all gains.
        start: Level before the first command [m or rad].
        z: The measurements without their mean, (n,).
    """

    measured: Measured
    command: Commands
    axes: Sequence[AxisModel]
    start: float
    z: FloatArray

    def columns_at(self, x: FloatArray) -> FloatArray:
        """Simulated positions without their means, a gain column each, (n, g)."""
        axes = [msgspec.structs.replace(axis, plant=_plant_at(x)) for axis in self.axes]
        moved = [self.command.moved(axis, float(x[0]) ** 2, self.start, self.measured.time) for axis in axes]
        found = np.stack([moved[0], *(column - moved[0] for column in moved[1:])], axis=1)
        return found - found.mean(axis=0)

    def modelled(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Simulated position (n,), and the coefficients of the gain columns (g,), of the best gain."""
        found = self.columns_at(x)
        share = np.asarray(np.linalg.lstsq(found, self.z, rcond=None)[0], dtype=np.float64)
        return found @ share, share

    def residual(self, x: FloatArray) -> FloatArray:
        """What the best gain leaves over, (n,)."""
        return self.z - self.modelled(x)[0]

    def cost(self, x: FloatArray) -> float:
        """Its sum of squares."""
        return float(np.sum(self.residual(x) ** 2))

    def starts(self, *, second_order: bool) -> list[FloatArray]:
        """The best cells of a grid over delays and plants."""
        period = self.command.period
        lags = np.geomspace(0.2 * period, 10.0 * period, _LAGS).tolist()
        shapes = [(q, ratio * q * q) for q in lags for ratio in (_RATIOS if second_order else (0.0,))]
        delays = np.linspace(0.0, _LATEST * period, _DELAYS).tolist()
        cells = [min((_coordinates(td, q, p) for q, p in shapes), key=self.cost) for td in delays]
        return sorted(cells, key=self.cost)[:_STARTS]

    def solve(self, starts: Iterable[FloatArray]) -> FloatArray:
        """Delay and plant of least squares, from the best of several starts."""
        from scipy.optimize import least_squares

        found = [
            least_squares(self.residual, x, x_scale="jac", xtol=1e-10, ftol=1e-12, gtol=1e-12, max_nfev=300)
            for x in starts
        ]
        return min(found, key=lambda one: float(one.cost)).x


def _half_width(jacobian: FloatArray, slope: FloatArray, residual: FloatArray) -> float:
    """Half the 95 % interval of a quantity that is fitted by least squares.

    What a model leaves over of a run is correlated, and each measurement alone would count far too much: a block of the
    run counts as one observation (Bester, Conley & Hansen, J. Econometrics 165, 2011).

    Args:
        jacobian: Derivatives of the fitted positions, (n, k).
        slope: Of the quantity, (k,).
        residual: (n,).
    """
    size = np.linalg.norm(jacobian, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    weight = (slope / size) @ np.linalg.pinv(jacobian / size, rcond=1e-10)
    first = np.arange(_BLOCKS) * len(residual) // _BLOCKS
    variance = _BLOCKS / (_BLOCKS - 1) * float(np.sum(np.add.reduceat(weight * residual, first) ** 2))
    return t_quantile(_BLOCKS - 1) * variance**0.5


def _gain_columns(command: Commands, model: AxisModel) -> list[AxisModel]:
    """Axes whose responses span those of all gains: K = 1; another K where it recovers; K that rises with speed."""
    gains = [Gain()]
    if model.gain_recovery is not None:
        gains.append(Gain(intercept=2.0))
    if np.ptp(command.speeds) > 1e-6 * command.speeds.max():
        gains.append(Gain(slope=1.0))
    return [msgspec.structs.replace(model, gain=gain) for gain in gains]


def _coordinates(delay: float, q: float, p: float) -> FloatArray:
    """√Td, log q and, of second order, log √p: free of bounds."""
    return np.clip([np.sqrt(delay), np.log(q), *([0.5 * np.log(p)] if p > 0.0 else [])], *_BOUNDS)


def _plant_at(x: FloatArray) -> PLANTS:
    bounded = np.clip(x, *_BOUNDS)
    return plant_of(float(np.exp(bounded[1])), float(np.exp(2.0 * bounded[2])) if len(x) == 3 else 0.0)
