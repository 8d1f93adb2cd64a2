"""From the trials of an axis to its model: which order, which plant, gain against speed, delay; the paper's Table II.

Intervals are clustered by trial: a trial counts as one observation, however many samples it has, because what makes
trials differ (a delay that jitters, friction, the pose) is the same for all samples of one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..model.arm import AxisModel, Gain
from ..model.plants import PLANTS, FirstOrder, SecondOrder
from .anova import ordered, outlying, speed_levels
from .choice import OrderChoice, choose
from .estimate import Estimate, common, mean, regression, robust
from .fit import HARDLY_MOVED, TOO_FEW, StepFit, flags, least_p
from .joint import JointFit, fit_together, inverse_square
from .paper import minimised, sensitivities
from .rows import Order, window
from .trials import Trial

if TYPE_CHECKING:
    from statsmodels.regression.linear_model import RegressionResults

_FEWEST = 3  # trials that a model is combined from
_ORDERS: tuple[Order, Order] = (1, 2)


@dataclass(frozen=True)
class Fitted:
    """One trial with its fits of both orders, and when it was first seen to move [s] (NaN: never)."""

    trial: Trial
    first: StepFit
    second: StepFit
    onset: float

    def of(self, order: Order) -> StepFit:
        """The fit of one order."""
        return self.first if order == 1 else self.second


class Delays(msgspec.Struct, frozen=True, kw_only=True):
    """Three answers to "how late is it?" [s].

    Attributes:
        onset: When the arm is first seen to move: above 3 standard deviations and 2 % of the step; null: never.
        fitted: Td of the model.
        lag: Behind the held command at constant velocity: Td + τ, or Td + 2ζ/ω.
    """

    onset: Estimate | None = msgspec.field(name="onset_ms")
    fitted: Estimate = msgspec.field(name="fitted_ms")
    lag: Estimate = msgspec.field(name="lag_ms")


class CombinedAxis(msgspec.Struct, frozen=True, kw_only=True):
    """One axis's model.

    Attributes:
        trials: How many it is made of.
        left_out: Trials that are not in it, and why.
        choice: Of the order.
        model: As ``arm.toml`` has it, with this axis's own delay.
        time_constant_mean: First order: the average of the trials' own τ [s].
        time_constant_robust: Their Huber mean [s].
        delays: Three of them.
        delay_spread: Standard deviation of Td from trial to trial [s].
        delay_noise: What the noise within a trial explains of it [s].
        lack_of_fit_p: Small: K is no straight line against speed; null where it cannot be told.
        gain_words: What the line says, and what it does not.
    """

    trials: int
    left_out: Mapping[str, str]
    choice: OrderChoice
    model: AxisModel
    time_constant_mean: Estimate = msgspec.field(name="time_constant_mean_ms")
    time_constant_robust: Estimate = msgspec.field(name="time_constant_robust_ms")
    delays: Delays
    delay_spread: float = msgspec.field(name="delay_spread_ms")
    delay_noise: float = msgspec.field(name="delay_noise_ms")
    lack_of_fit_p: float | None
    gain_words: str


@dataclass(frozen=True)
class Common:
    """What the trials of an axis have in common, and what each has of its own; arrays (n,).

    Attributes:
        choice: Of the order.
        plant: Of that order.
        lag: 2ζ/ω, or τ, with each trial's part in its error [s].
        delay: Td of each trial [s].
        delay_sd: What its noise lets expect [s].
        gain: K of each trial.
        gain_sd: What its noise lets expect.
    """

    choice: OrderChoice
    plant: PLANTS
    lag: FloatArray
    delay: FloatArray
    delay_sd: FloatArray
    gain: FloatArray
    gain_sd: FloatArray


@dataclass(frozen=True)
class Combination:
    """A combined axis, the trials that it is made of, and what they have in common."""

    axis: CombinedAxis
    used: Sequence[Fitted]
    common: Common

    @property
    def own(self) -> dict[str, tuple[float, float]]:
        """Td [s] and K of each trial under the common plant, by the trial's name."""
        pairs = zip(self.common.delay.tolist(), self.common.gain.tolist(), strict=True)
        return dict(zip((one.trial.name for one in self.used), pairs, strict=True))


def combine(fitted: Sequence[Fitted], period: float, samples: int | None, paper: bool) -> Combination | str:
    """Combine the trials of one axis.

    Args:
        fitted: The trials with their fits.
        period: T [s].
        samples: Use only so many from each step on; all for None.
        paper: Average as the paper does, also what lies far out, with delay and gain as read off.

    Returns:
        The model, or why there is none.
    """
    if usual_gain(fitted) == 0.0:
        return "the arm does not move"
    left_out = _unseen(fitted, samples) if paper else _outlying(fitted)
    left_out |= _still(fitted)
    used = [one for one in fitted if one.trial.name not in left_out]
    if len(used) < _FEWEST:
        why = "; ".join(f"trial '{name}' {reason}" for name, reason in list(left_out.items())[:3])
        return f"{len(used)} usable trials, at least {_FEWEST} are needed" + (f" ({why})" if why else "")
    found = _published(used, samples) if paper else _fitted_together(used, samples)
    speed = np.array([one.trial.speed_at(period) for one in used])
    line, lack, words = _gain_line(speed, found, speed_levels([one.trial for one in used], period))
    delay = common(found.delay, found.delay_sd)
    tau = np.array([one.first.shape.q for one in used])
    seen = [one.onset for one in used if np.isfinite(one.onset)]
    axis = CombinedAxis(
        trials=len(used),
        left_out=left_out,
        choice=found.choice,
        model=AxisModel(plant=found.plant, gain=line, delay=delay.value, delay_ci95=delay.ci95),
        time_constant_mean=mean(tau),
        time_constant_robust=robust(tau),
        delays=Delays(
            onset=mean(np.array(seen)) if seen else None,
            fitted=delay,
            lag=common(found.delay + found.lag, found.delay_sd),
        ),
        delay_spread=float(found.delay.std(ddof=1)),
        delay_noise=float(np.median(found.delay_sd)),
        lack_of_fit_p=lack,
        gain_words=words,
    )
    return Combination(axis, used, found)


def combined_rms(trial: Trial, model: AxisModel, delay: float, period: float, samples: int | None) -> float:
    """Equation 10 of one trial under a combined model [m], its zero free."""
    time, position = window(trial, samples)
    gain = float(model.gain.at(np.array(trial.speed_at(period))))
    return float(np.std(position - gain * trial.step * model.plant.step_response(time - delay)))


def _still(fitted: Sequence[Fitted]) -> dict[str, str]:
    """Trials in which the arm hardly moved."""
    usual = usual_gain(fitted)
    return {
        one.trial.name: flag
        for one in fitted
        for flag in flags(one.first, usual)
        if flag.startswith((HARDLY_MOVED, TOO_FEW))
    }


def _unseen(fitted: Sequence[Fitted], samples: int | None) -> dict[str, str]:
    """Trials whose window ends before the arm is seen to move."""
    return {
        one.trial.name: "not seen to move within the window"
        for one in fitted
        if not one.onset < window(one.trial, samples)[0][-1]
    }


def usual_gain(fitted: Sequence[Fitted]) -> float:
    """The median gain of trials."""
    return float(np.median([one.first.gain for one in fitted]))


def _outlying(fitted: Sequence[Fitted]) -> dict[str, str]:
    """Trials of which a coefficient is far from all the others."""
    found: dict[str, str] = {}
    fits = [one.first for one in fitted]
    for word, values, sds in (
        ("delay", [fit.shape.delay for fit in fits], [fit.delay_sd for fit in fits]),
        ("time constant", [fit.shape.q for fit in fits], [fit.q_sd for fit in fits]),
        ("gain", [fit.gain for fit in fits], [fit.gain_sd for fit in fits]),
    ):
        for one, value, far in zip(fitted, values, outlying(np.array(values), np.array(sds)), strict=True):
            if far:
                shown = f"{value:.2f}" if word == "gain" else f"{1e3 * value:.0f} ms"
                found.setdefault(one.trial.name, f"outlying: its {word} is {shown}")
    return found


def _fitted_together(used: Sequence[Fitted], samples: int | None) -> Common:
    """One plant, the delays and gains under it, and how an error of it moves them."""
    trials, own = [one.trial for one in used], [one.second for one in used]
    joints: dict[Order, JointFit] = {order: fit_together(trials, own, order, samples) for order in _ORDERS}
    second = joints[2]
    choice = choose(
        squares={order: joint.cost for order, joint in joints.items()},
        parameters={order: 3 * len(used) + order for order in joints},
        samples=int(second.count.sum()),
        rms={order: float(np.sqrt(np.average(joint.rms**2, weights=joint.count))) for order, joint in joints.items()},
        inverse_square=inverse_square(joints[1], second),
    )
    best = joints[choice.order]
    return Common(
        choice=choice,
        plant=_plant(best, choice.order),
        lag=best.q + best.parts.influence[:, 0],
        # what an error of the plant does to every trial's delay and gain belongs to the trials that cause it
        delay=best.delay + best.parts.influence @ best.delay_slope.mean(axis=0),
        delay_sd=best.parts.delay_sd,
        gain=best.gain + best.parts.influence @ best.gain_slope.mean(axis=0),
        gain_sd=best.gain_sd,
    )


def _plant(best: JointFit, order: Order) -> PLANTS:
    if order == 1:
        half = best.parts.half_width([1.0, 0.0])
        return FirstOrder(time_constant=best.q, time_constant_ci95=(best.q - half, best.q + half))
    # log ω and log ζ, whose errors are nearer to normal
    omega_half = best.parts.half_width([0.0, -0.5 / best.p])
    zeta_half = best.parts.half_width([1.0 / best.q, -0.5 / best.p])
    return _second_order(best.q, best.p, omega_half, zeta_half)


def _second_order(q: float, p: float, omega_half: float, zeta_half: float) -> SecondOrder:
    """ω and ζ with half their intervals in the logarithm."""
    omega, zeta = p**-0.5, 0.5 * q * p**-0.5
    wide, wide_zeta = float(np.exp(omega_half)), float(np.exp(zeta_half))
    return SecondOrder(
        natural_frequency=omega,
        damping=zeta,
        natural_frequency_ci95=(omega / wide, omega * wide),
        damping_ci95=(zeta / wide_zeta, zeta * wide_zeta),
    )


def _published(used: Sequence[Fitted], samples: int | None) -> Common:
    """The paper's combination: averages of what was read off, and equation 10 over all trials for ω and ζ."""
    trials, orders = [one.trial for one in used], _ORDERS
    count = sum(one.first.samples for one in used)
    squares: dict[Order, float] = {order: sum(one.of(order).squares for one in used) for order in orders}
    choice = choose(
        squares=squares,
        parameters={order: (order + 3) * len(used) for order in orders},  # what is read off is fitted, too
        samples=count,
        rms={order: float(np.sqrt(squares[order] / count)) for order in orders},
        inverse_square=mean(np.array([one.second.shape.p for one in used])),
    )
    own = [one.of(choice.order) for one in used]
    zeros = np.zeros(len(used))
    if choice.order == 1:
        lag = np.array([fit.shape.q for fit in own])
        tau = mean(lag)
        plant: PLANTS = FirstOrder(time_constant=tau.value, time_constant_ci95=tau.ci95)
    else:
        q, p = minimised(trials, own, 2, samples)
        p = max(p, least_p(q))
        parts = sensitivities(trials, own, q, p, samples)
        lag = q + parts[:, 0]
        halves = [mean(parts @ slope) for slope in ([0.0, -0.5 / p], [1.0 / q, -0.5 / p])]
        plant = _second_order(q, p, *(0.5 * (one.ci95[1] - one.ci95[0]) for one in halves))
    return Common(
        choice=choice,
        plant=plant,
        lag=lag,
        delay=np.array([fit.shape.delay for fit in own]),
        delay_sd=zeros,
        gain=np.array([fit.gain for fit in own]),
        gain_sd=zeros,
    )


def _gain_line(speed: FloatArray, found: Common, levels: Sequence[str]) -> tuple[Gain, float | None, str]:
    """K = a·speed + b with intervals, the p of its lack of fit, and what the line says."""
    distinct = ordered(set(levels))
    if len(distinct) == 1 or len(speed) < 4:
        level = common(found.gain, found.gain_sd)
        why = f"one speed only ({distinct[0]} m/s)" if len(distinct) == 1 else "too few trials for a line"
        return Gain(slope=0.0, intercept=level.value, intercept_ci95=level.ci95), None, f"slope 0: {why}"
    line = regression(found.gain, found.gain_sd, np.column_stack((np.ones(len(speed)), speed)))
    (b_low, b_high), (a_low, a_high) = line.conf_int().tolist()
    b, a = line.params.tolist()
    gain = Gain(slope=a, intercept=b, slope_ci95=(a_low, a_high), intercept_ci95=(b_low, b_high))
    words = "K rises with speed" if a_low > 0.0 else "K falls with speed" if a_high < 0.0 else "no slope is proved"
    lack = None
    if 2 < len(distinct) < len(speed):
        lack = _lack_of_fit(line, levels)
        if lack < 0.05:
            words += "; not along a straight line"
    return gain, lack, words


def _lack_of_fit(line: RegressionResults, levels: Sequence[str]) -> float:
    """P of the hypothesis that the means at each level lie on the line."""
    from statsmodels.regression.linear_model import WLS

    cells = np.array(levels)
    design = np.column_stack([cells == level for level in ordered(set(levels))]).astype(np.float64)
    apart = WLS(line.model.endog, design, weights=line.model.weights).fit()
    return float(apart.compare_f_test(line)[1])
