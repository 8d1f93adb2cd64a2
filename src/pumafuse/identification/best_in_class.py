"""The best linear model of an order on a run: no model of that order fits its measurements better."""

from __future__ import annotations

from itertools import product

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..model.arm import commanded_speed
from ..model.plants import PLANTS
from ..toml import Interval
from ..tuning.arms import Arm, Coordinates, Limits, Measured, Rest, covariance
from ..tuning.plain import COMMANDS, LAGS, ROWS, delays
from .estimate import t_quantile

_DAMPED = 1.0  # ζ of the grid, of second order
_STARTS = 3  # cells of it to search from
_BLOCKS = 10  # of a run, whose errors count as independent of each other
_STEP = 1e-5  # of a coordinate, by which the lag is varied
_REAL = -np.inf, np.inf
_ANY = Limits(  # s, s, 1, 1, s/m or s/rad: as far as arms may be given, and beyond what is seen of them
    {"delay": (0.0, 1e4), "lag": (1e-6, 1e4), "damping": (1e-3, 1e3), "gain": _REAL, "slope": _REAL}, {}
)


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


def speeds(measured: Measured) -> FloatArray:
    """Of the commands of a run that move [m/s or rad/s]."""
    steps = np.diff(measured.recordings[0].command)
    return commanded_speed(steps[steps != 0.0], measured.period)


def model_fit(measured: Measured, arm: Arm) -> ModelFit:
    """How well an arm fits a run."""
    (one,) = measured.recordings
    rms, signal = float(np.std(measured.left(arm))), float(np.std(one.value))
    return ModelFit(
        rms=rms,
        percent=100.0 * rms / float(np.ptp(one.command)),
        fit=100.0 * (1.0 - rms / signal) if signal > 0.0 else -np.inf,
    )


def best_in_class(measured: Measured, own: Arm) -> BestInClass:
    """The best gain, delay and plant of the model's order on one recording by one source.

    The order and recovery of the arm's ``own`` model stay; its numbers are one start of the search.
    """
    moving = speeds(measured)
    names = ["delay", "lag", *(["damping"] if own.damping else []), "gain"]
    if np.ptp(moving) > 1e-6 * moving.max():
        names.append("slope")
    starts = _on_grid(measured, own)
    rest = measured.white(starts[0])
    fits = [measured.fitted(arm, names, rest, _ANY) for arm in (own, *starts)]
    near = max(fits, key=lambda one: one.log_posterior).arm
    rest = measured.white(near)  # beside the noise of a poor start the last steps seemed to gain nothing
    best, speed = measured.fitted(near, names, rest, _ANY).arm, float(moving.mean())
    lag, half = best.model.lag(best.delay, speed), _half_width(measured, best, names, rest, speed)
    return BestInClass(
        fit=model_fit(measured, best),
        lag=lag,
        lag_ci95=(lag - half, lag + half),
        delay=best.delay,
        gain=best.slope * speed + best.gain,
        plant=best.model.plant,
    )


def _on_grid(measured: Measured, own: Arm) -> list[Arm]:
    """The best of a grid over dead times and plants, each with its best gain that is the same at every speed."""
    part, alike = measured.excerpt(COMMANDS, ROWS), own._replace(damping=_DAMPED if own.damping else 0.0, slope=0.0)
    arms = [alike._replace(delay=delay, lag=lag) for delay, lag in product(delays(part).tolist(), LAGS.tolist())]
    log, gain = part.weighed(arms, part.white(own), _ANY)
    return [arms[place]._replace(gain=float(gain[place])) for place in np.argsort(-log)[:_STARTS].tolist()]


def _half_width(measured: Measured, arm: Arm, names: Coordinates, rest: Rest, speed: float) -> float:
    """Half the 95 % interval of the lag at a ``speed`` [m/s or rad/s].

    What a model leaves over of a run is correlated, and each measurement alone would count far too much: a block of the
    run counts as one observation (Bester, Conley & Hansen, J. Econometrics 165, 2011).
    """
    free = [name for name, inside in zip(names, _ANY.inside(arm, names), strict=True) if inside]
    here, varied = arm.model, [arm.moved([name], [arm.coordinate(name) + _STEP]) for name in free]
    slope = np.array([one.model.lag(one.delay, speed) - here.lag(arm.delay, speed) for one in varied]) / _STEP
    information, scatter = measured.scattered(arm, free, rest, _ANY, _BLOCKS)
    weight = covariance(information) @ slope
    return t_quantile(_BLOCKS - 1) * float(weight @ scatter @ weight * _BLOCKS / (_BLOCKS - 1)) ** 0.5
