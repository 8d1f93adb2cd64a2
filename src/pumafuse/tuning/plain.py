"""What least squares says of an arm, without a model of noise: the check of an arm that the likelihood has found.

A likelihood weighs a run by a model of its noise. Where that model is wrong — play, a limit of the speed, a sensor that
repeats old values — it may fit something else than how the arm follows its commands, and be sure of it. Plain least
squares of the response on the measurements knows less and cannot go so far astray, nor can the delayed command alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..arrays import FloatArray
from ..filter.response import response
from ..fusion.config import FusionConfig
from ..model.arm import AxisModel, Gain
from ..model.plants import FirstOrder
from ..units import MS
from .likelihood import Likelihood, Motion
from .parameters import changed, rounded

_LATEST, _DELAYS = 0.6, 61  # s, or five update periods: the longest dead time; how many are looked at
_LAGS = np.geomspace(1e-3, 2.0, 14)  # s, of a first-order plant
LONGEST = 2.6  # s, of a lag that is told: of both together
_COMMANDS = 6000  # of a recording that are looked at, where it moves most
_ROWS = 2000  # measurements of a recording that are looked at, evenly over all of it
_STARTS = 3  # cells from which the least squares are looked for
_AROUND = np.linspace(-1.5, 1.5, 7)  # logarithm of τ about the best one,
_BESIDE = np.linspace(-0.03, 0.03, 13)  # s, and lags about its lag: which of them are allowed
_OUTLIER = 8.0  # times the median distance from the best arm: what is farther does not count
_FEWEST = 4.0  # independent measurements, at least: however alike their errors are
_CHANCE = 3.84  # of χ² with one degree of freedom, 95 %
_ROUNDING = 1e-12  # of all squares: what is left of them where nothing is
_MOST = 0.8  # of the measurements: how far these are off is not decided by single commands that were never sent
_DOUBTED, _REFUTED = 1.25, 4.0  # times as far off as the delayed command: such an arm is doubted, or replaced


class PlainArm(NamedTuple):
    """The first-order arm with a gain that leaves the least squares.

    Attributes:
        delay: Dead time [s].
        time_constant: τ [s].
        gain: K.
        lag_ci95: The lags [s] that leave no more than chance beyond the least, of so many measurements as have errors
            of their own.
        rms: What it leaves [m].
        delayed: By how much the command alone is to be delayed to leave the least [s].
        delayed_off: How far that is off [m]; four fifths of the measurements are nearer.
    """

    delay: float
    time_constant: float
    gain: float
    lag_ci95: tuple[float, float]
    rms: float
    delayed: float
    delayed_off: float

    @property
    def lag(self) -> float:
        """Behind the held command at constant velocity [s]."""
        return self.delay + self.time_constant


class _Cell(NamedTuple):
    """An arm of the grid.

    Attributes:
        left: Sum of squares with the best gain [m²].
        delay: [s].
        time_constant: [s].
        gain: The best one, not below 0.
        unit: Sum of squares with a gain of 1 [m²].
    """

    left: float
    delay: float
    time_constant: float
    gain: float
    unit: float

    @property
    def lag(self) -> float:
        return self.delay + self.time_constant


class Recorded:
    """The recorded motion of an axis by one sensor, which may be off by a constant in each recording."""

    def __init__(self, motions: Sequence[Motion], period: float) -> None:
        """Look at the ``motions`` of an axis whose update period is ``period`` [s]."""
        self._period = period
        self._motions = [_thinned(_liveliest(one)) for one in motions]
        self._counts = [np.ones(len(one.time), dtype=np.bool_) for one in self._motions]
        self._known: dict[tuple[float, float], list[FloatArray]] = {}  # responses of cells, which are looked at twice

    def off(self, axis: AxisModel, delay: float) -> float:
        """How far an arm without noise is off [m]: four fifths of the measurements are nearer."""
        apart = self._measured() - self._response(axis, delay)
        return float(np.quantile(np.abs(apart - np.median(apart)), _MOST)) if len(apart) else 0.0

    def plain_arm(self) -> PlainArm | None:
        """The arm that leaves the least squares, without outliers; None where nothing moves or is measured."""
        if sum(map(len, self._counts)) < 2 * _FEWEST:
            return None
        delays = np.linspace(0.0, max(_LATEST, 5.0 * self._period), _DELAYS)
        self._leave_out_far_from(min(self._squares(delays, _LAGS)))
        cells = self._squares(delays, _LAGS)
        delayed = min((one for one in cells if one.time_constant == _LAGS[0]), key=lambda one: one.unit)
        for start in sorted(cells)[:_STARTS]:
            best = self._polished(start)
            lags = best.time_constant * np.exp(_AROUND)
            for lag in lags.tolist():  # along the ridge on which dead time and plant make up for each other
                cells += self._squares(np.maximum(best.lag - lag + _BESIDE, 0.0), np.array([lag]))
            cells.append(best)
        best = min(cells)
        count, power = sum(map(np.count_nonzero, self._counts)), best.left
        if count < 2 * _FEWEST or best.gain <= 0.0:
            return None
        rest = self._measured() - best.gain * self._response(_first_order(best.time_constant), best.delay)
        alike = min(max(float(rest[1:] @ rest[:-1]) / max(power, 1e-300), 0.0), 1.0)
        independent = max(count * (1.0 - alike) / (1.0 + alike), _FEWEST)
        most = power * (1.0 + _CHANCE / independent) + _ROUNDING * float(np.sum(self._measured() ** 2))
        allowed = [one.lag for one in cells if one.left <= most]
        return PlainArm(
            delay=best.delay,
            time_constant=best.time_constant,
            gain=best.gain,
            lag_ci95=(min(*allowed, delayed.lag), max(*allowed, delayed.lag)),
            rms=float(np.sqrt(power / count)),
            delayed=delayed.lag,
            delayed_off=self.off(_first_order(delayed.time_constant), delayed.delay),
        )

    def _squares(self, delays: FloatArray, lags: FloatArray) -> list[_Cell]:
        y, found = self._measured(), list[_Cell]()
        for delay in delays.tolist():
            for lag in lags.tolist():
                if (delay, lag) not in self._known:
                    self._known[delay, lag] = self._responses(_first_order(lag), delay)
                r = self._centred(self._known[delay, lag])
                power, along = float(r @ r), max(float(r @ y), 0.0)
                gain = along / power if power > 0.0 else 0.0
                left = max(float(y @ y) - gain * along, 0.0)
                found.append(_Cell(left, delay, lag, gain, left + power * (1.0 - gain) ** 2))
        return found

    def _polished(self, start: _Cell) -> _Cell:
        """The least squares near a cell."""
        from scipy import optimize

        y = self._measured()

        def rest(at: FloatArray) -> FloatArray:
            r = self._response(_first_order(float(np.exp(at[1]))), float(at[0]))
            return y - max(float(r @ y), 0.0) / max(float(r @ r), 1e-300) * r

        low, high = [0.0, np.log(0.1 * _LAGS[0])], [start.delay + 1.0, np.log(2.0 * _LAGS[-1])]
        begin = [max(start.delay, 1e-3), np.log(start.time_constant)]
        solve: Any = optimize.least_squares  # whose type pyright reads wrongly
        found = solve(rest, begin, bounds=(low, high), diff_step=1e-3, x_scale=[0.01, 0.1])
        delay, lag = np.array(found.x, dtype=np.float64)
        return min(start, *self._squares(np.array([delay]), np.exp(np.array([lag]))))

    def _leave_out_far_from(self, cell: _Cell) -> None:
        """Let measurements not count that are outliers beside an arm."""
        apart = np.abs(self._measured() - cell.gain * self._response(_first_order(cell.time_constant), cell.delay))
        near = apart <= _OUTLIER * max(float(np.median(apart)), 1e-9)
        ends = np.cumsum([len(one) for one in self._counts])[:-1]
        self._counts = np.split(near, ends)

    def _measured(self) -> FloatArray:
        return self._centred([one.value for one in self._motions])

    def _response(self, axis: AxisModel, delay: float) -> FloatArray:
        return self._centred(self._responses(axis, delay))

    def _responses(self, axis: AxisModel, delay: float) -> list[FloatArray]:
        return [
            response(axis, self._period, delay, one.given, one.command, one.start, one.time) for one in self._motions
        ]

    def _centred(self, parts: Sequence[FloatArray]) -> FloatArray:
        """What counts of each recording without its mean, one after the other."""
        kept = [part[counts] for part, counts in zip(parts, self._counts, strict=True) if counts.any()]
        return np.concatenate([part - part.mean() for part in kept] or [np.zeros(0)])


def _liveliest(motion: Motion) -> Motion:
    """The part of a long recording with the most motion, without what the commands before it still do."""
    given, command = motion.given, motion.command
    if len(given) <= _COMMANDS:
        return motion
    ends = np.append(np.arange(0, len(given) - _COMMANDS, _COMMANDS // 2), len(given) - _COMMANDS)
    way = np.append(0.0, np.cumsum(np.abs(np.diff(command))))
    first = int(max(ends, key=lambda one: way[one + _COMMANDS - 1] - way[one]))
    given, command = given[first : first + _COMMANDS], command[first : first + _COMMANDS]
    since = given[0] + round(LONGEST * 1e9) * (first > 0)
    mine = (motion.time >= since) & (motion.time <= given[-1])
    return Motion(motion.sensor, given, command, float(command[0]), motion.time[mine], motion.value[mine])


def _thinned(motion: Motion) -> Motion:
    """A motion with so many measurements as are looked at, evenly over all of it."""
    some = slice(None, None, len(motion.time) // _ROWS + 1)
    return motion._replace(time=np.ascontiguousarray(motion.time[some]), value=motion.value[some])


class Doubt(NamedTuple):
    """That an axis's arm predicts worse than the commands do when they are delayed.

    Attributes:
        arm: That of least squares.
        off: How far the axis's own is off [m]; four fifths of the measurements are nearer.
    """

    arm: PlainArm
    off: float

    @property
    def refutes(self) -> bool:
        """Whether it is so much worse that the arm of least squares is to take its place."""
        return self.off > _REFUTED * self.arm.delayed_off

    def sentence(self, config: FusionConfig, axis: str) -> str:
        """What to know of it, under the configuration that is doubted."""
        screen = config.arm.screen_of(axis)
        then = "The arm is that of least squares instead" if self.refutes else "The interval of its lag covers both"
        return (
            "the likelihood has fitted something else than how the axis follows its commands: its arm, a lag of"
            f" {config.arm.lag_of(axis) * MS:.4g} ms, is {self.off * screen.scale:.3g} {screen.unit} off, the commands"
            f" {self.arm.delayed * MS:.0f} ms later are {self.arm.delayed_off * screen.scale:.3g}. {then}. The cause"
            " may be play, a limit of the speed, a sensor that repeats old values, or too little motion"
        )


def doubts(likelihood: Likelihood, config: FusionConfig, axes: Iterable[str]) -> dict[str, Doubt]:
    """The arms of a configuration that predict worse than the delayed command, by axis.

    Args:
        likelihood: The measurements; of an axis those of the sensor count that an arm explains best.
        config: The configuration.
        axes: The axes to look at.
    """
    found: dict[str, Doubt] = {}
    for axis in axes:
        motions, arms = likelihood.motions(axis, config), list[tuple[float, PlainArm, Recorded]]()
        for name in dict.fromkeys(one.sensor for one in motions):
            recorded = Recorded([one for one in motions if one.sensor == name], config.arm.update_period)
            if (arm := recorded.plain_arm()) is not None:
                arms.append((arm.rms, arm, recorded))
        if arms:
            _, arm, recorded = min(arms, key=lambda one: one[0])
            off = recorded.off(config.arm.axes[axis], config.arm.delay_of(axis))
            if off > _DOUBTED * arm.delayed_off:
                found[axis] = Doubt(arm, off)
    return found


def with_plain_arm(config: FusionConfig, axis: str, arm: PlainArm) -> FusionConfig:
    """The configuration with an axis's arm by least squares: of first order, with a gain that stays."""
    plant, gain = _first_order(rounded(arm.time_constant)).plant, Gain(intercept=rounded(arm.gain))
    for name, value in {"plant": plant, "gain": gain, "gain_recovery": None, "delay": rounded(arm.delay)}.items():
        config = changed(config, ("arm", "axes", axis, name), value)
    return config


def _first_order(time_constant: float) -> AxisModel:
    return AxisModel(plant=FirstOrder(time_constant=time_constant))
