"""What least squares says of an arm, without a model of noise: the check of an arm that the likelihood has found.

A likelihood weighs a run by a model of its noise. Where that model is wrong — play, a limit of the speed, a sensor that
repeats old values — it may fit something else than how the arm follows its commands, and be sure of it. Plain least
squares of the response on the measurements knows less and cannot go so far astray, nor can the delayed command alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..arrays import FloatArray
from ..fusion.config import FusionConfig
from ..units import MS
from .arms import Arm, Limits, Measured, NoiseModel, longest_delay
from .parameters import rounded, set_arm

_DELAYS = 61  # dead times that are looked at
LAGS = np.geomspace(1e-3, 2.0, 14)  # s, of a first-order plant
LONGEST = 2.6  # s, of a lag that is told: of both together
COMMANDS, ROWS = 6000, 2000  # of a recording that are looked at: where it moves most, and evenly of that
_STARTS = 3  # cells from which the least squares are looked for
_AROUND = np.linspace(-1.5, 1.5, 7)  # logarithm of τ about the best one,
_BESIDE = np.linspace(-0.03, 0.03, 13)  # s, and lags about its lag: which of them are allowed
_OUTLIER = 8.0  # times the median distance from the best arm: what is farther does not count
_FEWEST = 4.0  # independent measurements, at least: however alike their errors are
FOLLOWS = 40.0  # of χ² that an arm must explain: of some hundred arms with noise beside them none does by chance
_ANYHOW = 1.0  # times what it leaves, from which it follows whatever chance would make of it
_CHANCE = 3.84  # of χ² with one degree of freedom, 95 %
_ROUNDING = 1e-12  # of all squares: what is left of them where nothing is
_MOST = 0.8  # of the measurements: how far these are off is not decided by single commands that were never sent
_DOUBTED, _REFUTED = 1.25, 4.0  # times as far off as the delayed command: such an arm is doubted, or replaced,
_NOTHING = 1e-3  # of the range that is measured: nothing is said of what is off by less
_NOTABLE = 0.1  # of the lag, by which it lies outside of what least squares allow, or steps: it is said
_ANOTHER = 1.0 / 3.0  # of the lag, from which an arm's is quite another one
_SPLITS = np.linspace(0.1, 0.9, 9)  # of a run, where its lag may step: sooner is its start
_OF_QUARTERS = np.linspace(0.125, 0.875, 7)  # likewise, of a long one of which parts of its quarters are looked at
_HALVED = 0.5  # of the squares, which two lags, or an arm of quite another lag, must leave less than
_ANY = Limits({"delay": (0.0, 10.0), "lag": (0.1 * LAGS[0], 2.0 * LAGS[-1]), "gain": (-np.inf, np.inf)}, {})


class LagStep(NamedTuple):
    """A step of the lag: ``before`` until an instant [s after the first command], then ``after`` [s]."""

    time: float
    before: float
    after: float

    def __str__(self) -> str:
        """A sentence."""
        digits = 0 if self.time >= 2.0 else 1
        return (
            f"by least squares the lag is {self.before * MS:.0f} ms until about {self.time:.{digits}f} s and"
            f" {self.after * MS:.0f} ms from then on, and no one arm explains both: did a latency step? Use parts,"
            " --to and --from"
        )


class PlainArm(NamedTuple):
    """The first-order arm with a gain that leaves the least squares."""

    arm: Arm  # the arm
    # the lags [s] that leave no more than chance beyond the least, of so many measurements as have errors of their
    # own
    lag_ci95: tuple[float, float]
    delayed: Arm  # the command alone, as it is or times a gain, delayed so that it leaves the least
    delayed_off: float  # how far that is off where the axis moves [m]; four fifths of the measurements are nearer
    measured: Measured  # what was looked at, without outliers
    whole: Measured  # with them
    step: LagStep | None = None  # that it is another one in the second part of the run, where that leaves much less


def delays(measured: Measured) -> FloatArray:
    """The dead times that are looked at [s]."""
    return np.linspace(0.0, longest_delay(measured.period), _DELAYS)


def off(measured: Measured, arm: Arm) -> float:
    """How far an arm without noise is off where the axis moves [m]: four fifths of the measurements are nearer."""
    apart = measured.left(arm)
    return float(np.quantile(np.abs(apart - np.median(apart))[measured.moving], _MOST)) if len(apart) else 0.0


def independent(left: FloatArray) -> float:
    """How many independent measurements as many with these errors are, where an error goes on from one to the next."""
    alike = min(max(float(left[1:] @ left[:-1]) / max(float(left @ left), 1e-300), 0.0), 1.0)
    return max(len(left) * (1.0 - alike) / (1.0 + alike), _FEWEST)


def plain_arm(measured: Measured) -> PlainArm | None:
    """The arm that leaves the least squares, without outliers; None where nothing follows the commands."""
    begin = min((int(recording.stamp[0]) for recording in measured.recordings), default=0)
    quarters = measured.liveliest(COMMANDS)
    measured = whole = measured.excerpt(COMMANDS, ROWS)
    if measured.count < 2 * _FEWEST or not any(np.ptp(recording.command) > 0.0 for recording in measured.recordings):
        return None
    late, noise = delays(measured).tolist(), measured.white(Arm(0.0, float(LAGS[0])))
    arms = [Arm(delay, lag) for lag in LAGS.tolist() for delay in late]
    measured = measured.without_far_from(_fitted(measured, arms, noise, 1)[0], _OUTLIER)
    starts = _fitted(measured, arms, noise, _STARTS)
    noise = measured.white(starts[0])
    begun = [measured.fitted(arm, ["delay", "lag", "gain"], noise, _ANY).arm for arm in starts]
    for start in begun:  # along the ridge on which dead time and plant make up for each other
        for lag in (start.lag * np.exp(_AROUND)).tolist():
            arms += [Arm(delay, lag) for delay in np.maximum(start.delay + start.lag - lag + _BESIDE, 0.0).tolist()]
    arms += begun
    log, gains = measured.weighed(arms, noise, _ANY)
    best = int(np.argmax(log))
    arm = arms[best]._replace(gain=float(gains[best]))
    if arm.gain <= 0.0 or measured.count < 2 * _FEWEST:
        return None
    left, sd = measured.left(arm), float(noise.sd[0])
    power = float(left @ left)
    number = independent(left)
    if measured.power - power < min(FOLLOWS / number, _ANYHOW) * power:
        return None
    most = 0.5 * (power * _CHANCE / number + _ROUNDING * measured.power) / sd**2
    allowed = [arm.delay + arm.lag for arm, behind in zip(arms, log[best] - log, strict=True) if behind <= most]
    later = [Arm(delay, float(LAGS[0])) for delay in late]
    each = [*measured.likeliest(later, noise, None, 1), *_fitted(measured, later, noise, 1)]
    delayed = min(each, key=lambda candidate: off(measured, candidate))
    between = float(min(allowed)), float(max(allowed))
    step = None
    if len(whole.recordings) == 1:  # of several nothing is told
        long = len(quarters.recordings) > 1
        step = _lag_step(quarters.without_far_from(arm, _OUTLIER) if long else measured, arm, begin)
    return PlainArm(arm, between, delayed, off(measured, delayed), measured, whole, step)


def _lag_step(measured: Measured, arm: Arm, begin: int) -> LagStep | None:
    """Where another lag in the second part of a run, or of parts of one, leaves much less than an arm for all of it.

    None where none does, or where another gain alone does: a stop or a load. The ``arm`` is near that of all; the first
    command was given at ``begin`` [ns].
    """
    noise = measured.white(arm)
    arm = measured.fitted(arm, ["delay", "gain"], noise, _ANY).arm
    least, step = _HALVED * measured.squares(arm), None
    time = np.sort(np.concatenate([recording.time for recording in measured.recordings]))
    splits = _SPLITS if len(measured.recordings) == 1 else _OF_QUARTERS
    for row in np.rint(splits * (len(time) - 1)).astype(int).tolist():
        edge = 0.5 * float(time[row - 1] + time[row])  # between parts of a recording it may be anywhere
        squares, with_one_lag, lags = 0.0, 0.0, list[float]()
        for later in (False, True):
            parts = [
                recording._replace(weight=recording.weight * ((recording.time >= edge) == later))
                for recording in measured.recordings
            ]
            part = measured.of(parts)
            fitted = part.fitted(arm, ["delay", "gain"], noise, _ANY).arm
            squares, lags = squares + part.squares(fitted), [*lags, fitted.total]
            with_one_lag += part.squares(part.fitted(arm, ["gain"], noise, _ANY).arm)
        if squares < min(least, _HALVED * with_one_lag) and abs(lags[1] - lags[0]) > _NOTABLE * arm.total:
            least, step = squares, LagStep((edge - begin) / 1e9, *lags)
    return step


def _fitted(measured: Measured, arms: list[Arm], noise: NoiseModel, count: int) -> list[Arm]:
    """The arms that leave the least squares with their best gain."""
    log, gain = measured.weighed(arms, noise, _ANY)
    log = np.where(gain > 0.0, log, -np.inf)
    return [arms[number]._replace(gain=float(gain[number])) for number in np.argsort(-log)[:count].tolist()]


class Doubt(NamedTuple):
    """An arm that predicts worse than the commands do when they are delayed, or is of a lag that they exclude."""

    plain: PlainArm  # that of least squares
    off: float  # how far the axis's own is off where it moves [m]; four fifths of the measurements are nearer
    lag: float  # its own [s]
    # whether a filter predicts the next measurement better with the arm of least squares in its place
    is_beaten: bool = False

    @property
    def lag_ci95(self) -> tuple[float, float]:
        """The lags [s] that least squares allow, and that of the delayed command where it predicts better."""
        (low, high), delayed = self.plain.lag_ci95, self.plain.delayed.total
        return (min(low, delayed), max(high, delayed)) if self.is_worse else (low, high)

    @property
    def is_worse(self) -> bool:
        """Whether it predicts worse than the delayed command."""
        return self.off > _DOUBTED * self.plain.delayed_off

    @property
    def is_another(self) -> bool:
        """Whether its lag is quite another one: how an axis hardly follows its commands, a model of noise decides."""
        lag = self.plain.arm.total
        return abs(self.lag - lag) > max(_ANOTHER * lag, self.plain.measured.period)

    @property
    def refutes(self) -> bool:
        """Whether the arm of least squares is to take its place."""
        return self.is_beaten or (self.is_worse and self.off > _REFUTED * self.plain.delayed_off)

    def sentence(self, config: FusionConfig, axis: str) -> str:
        """What to know of it, under the configuration that is doubted; empty where that is little."""
        screen, (low, high) = config.arm.screen_of(axis), self.lag_ci95
        longest = float(LAGS[-1])  # that is searched: beyond it a number says nothing
        lag = f"{self.lag * MS:.4g} ms" if self.lag <= longest else f"more than {longest:.3g} s"
        then = "The arm is that of least squares instead" if self.refutes else "The interval of its lag covers both"
        matters = self.off > _NOTHING * self.plain.measured.range
        if self.is_worse and matters:
            delayed, far = self.plain.delayed, self.plain.delayed_off * screen.scale
            gain = f"{delayed.gain:.3g}"
            times = "" if gain == "1" else f" times {gain},"
            what = (
                "the likelihood has fitted something else than how the axis follows its commands: its arm, a lag of"
                f" {lag}, is {self.off * screen.scale:.3g} {screen.unit} off where the axis moves, the"
                f" commands{times} {delayed.total * MS:.0f} ms later are {far:.3g}"
            )
        elif ((self.is_beaten or self.is_another) and matters) or (
            max(low - self.lag, self.lag - high) > _NOTABLE * self.plain.arm.total
        ):
            what = (
                f"the likelihood says a lag of {lag}, least squares, which have no model of noise,"
                f" {self.plain.arm.total * MS:.4g} ({low * MS:.4g} to {high * MS:.4g})"
            )
        else:
            return ""
        return (
            f"{what}. {then}. The cause may be play, a limit of the speed, a sensor that repeats old values, or too"
            " little motion"
        )


def doubts(plain: Mapping[str, PlainArm | None], config: FusionConfig) -> dict[str, Doubt]:
    """The arms of a configuration that predict worse than the delayed command, or lag otherwise, by axis.

    Play, a fastest speed and a gain of the speed make a lag another one with each motion: then it is not compared.
    Quite another lag is doubted although least squares allow it: where an axis hardly follows, they allow any.
    """
    doubts_by_axis: dict[str, Doubt] = {}
    for axis, plain_here in plain.items():
        if plain_here is not None:
            configured = Arm.of(config.arm.axes[axis], config.arm.delay_of(axis))
            doubt = Doubt(plain_here, off(plain_here.measured, configured), configured.total)
            ends, measured = (*plain_here.lag_ci95, plain_here.delayed.total), plain_here.measured
            allowed = min(ends) <= configured.total <= max(ends)
            if doubt.is_another:  # it may be, if it explains much more
                allowed = allowed and measured.squares(configured) < _HALVED * measured.squares(plain_here.arm)
            if doubt.is_worse or not (allowed or configured.play or configured.max_speed or configured.slope):
                doubts_by_axis[axis] = doubt
    return doubts_by_axis


def lag_steps(plain: Mapping[str, PlainArm | None], config: FusionConfig) -> list[str]:
    """Sentences on lags that step, of axes whose configured arm, with all that bends it, explains no more of it."""
    notes: list[str] = []
    for axis, plain_here in plain.items():
        if plain_here is not None and plain_here.step is not None:
            measured = plain_here.measured
            configured = Arm.of(config.arm.axes[axis], config.arm.delay_of(axis))
            if measured.squares(configured) > _HALVED * measured.squares(plain_here.arm):
                notes.append(f"{axis}: {plain_here.step}")
    return notes


def set_plain_arm(config: FusionConfig, axis: str, arm: Arm) -> FusionConfig:
    """The configuration with an axis's arm by least squares: of first order, with a gain that stays."""
    return set_arm(config, axis, Arm(*(rounded(number) for number in arm)))
