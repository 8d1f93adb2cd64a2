"""From the trials of an axis to its model: order, plant, gain against speed, delay; the paper's Table II.

Intervals are clustered by trial: a trial counts as one observation, however many samples it has. What makes trials
differ (a delay that jitters, friction, the pose) is the same for all samples of one trial.
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
from .batch import Order
from .estimate import Estimate, common, mean, regression, robust
from .fit import HARDLY_MOVED, UNKNOWN_GAIN, StepFit, flags, least_p
from .joint import JointFit, fit_together, inverse_square
from .paper import minimise
from .trials import Trial

if TYPE_CHECKING:
    from statsmodels.regression.linear_model import RegressionResults

_FEWEST = 3  # trials for a model


@dataclass(frozen=True)
class Fitted:
    """One trial with its fits of both orders, and its onset [s] (NaN: never)."""

    trial: Trial
    first: StepFit
    second: StepFit
    onset: float


class OrderChoice(msgspec.Struct, frozen=True, kw_only=True):
    """First or second order.

    Attributes:
        order: The choice.
        first_rms: Root mean square residual of first order over all trials [m].
        second_rms: Of second order [m].
        f: Of the F-test of the additional parameters of second order.
        p: Of that F.
        aicc_gain: By how much second order lowers AICc; negative: it raises it. Null: too few samples.
        inverse_square: 1/ω² [s²] with its interval by trials; 0 is first order.
        why: In words.
    """

    order: Order
    first_rms: float = msgspec.field(name="first_rms_mm")
    second_rms: float = msgspec.field(name="second_rms_mm")
    f: float
    p: float
    aicc_gain: float | None
    inverse_square: Estimate = msgspec.field(name="inverse_square_s2")
    why: str


class Delays(msgspec.Struct, frozen=True, kw_only=True):
    """Three delays [s].

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
        delays: Onset, Td and lag.
        delay_spread: Standard deviation of Td from trial to trial [s].
        delay_noise: Standard deviation of Td by the noise within a trial [s].
        lack_of_fit_p: Small: K is no straight line against speed; null where it cannot be tested.
        gain_words: What the gain line shows.
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
    """The common plant of an axis, and delay and gain of each trial under it; arrays (n,).

    Attributes:
        choice: Of the order.
        plant: Of that order.
        lag: 2ζ/ω, or τ, plus each trial's influence on it [s].
        delay: Td of each trial [s].
        delay_sd: Its standard deviation by the noise [s].
        gain: K of each trial.
        gain_sd: Its standard deviation by the noise.
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
    """A combined axis, its common plant, and the names of the trials in it."""

    axis: CombinedAxis
    common: Common
    names: Sequence[str]

    @property
    def own(self) -> dict[str, tuple[float, float]]:
        """Td [s] and K of each trial under the common plant, by the trial's name."""
        pairs = zip(self.common.delay.tolist(), self.common.gain.tolist(), strict=True)
        return dict(zip(self.names, pairs, strict=True))


def combine(fitted: Sequence[Fitted], period: float, paper: bool) -> Combination | str:
    """Combine the trials of one axis.

    Args:
        fitted: The trials with their fits.
        period: T [s].
        paper: Average as the paper does, with all outliers, and with delay and gain as read off.

    Returns:
        The model, or why there is none.
    """
    if usual_gain(fitted) == 0.0:
        return "the arm does not move"
    left_out = (_unseen(fitted) if paper else _outlying(fitted)) | _still(fitted)
    used = [one for one in fitted if one.trial.name not in left_out]
    if len(used) < _FEWEST:
        why = "; ".join(f"trial '{name}' {reason}" for name, reason in list(left_out.items())[:3])
        return f"{len(used)} usable trials, at least {_FEWEST} are needed" + (f" ({why})" if why else "")
    found = _published(used) if paper else _fitted_together(used)
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
    return Combination(axis, found, [one.trial.name for one in used])


def combined_rms(trial: Trial, model: AxisModel, delay: float, period: float) -> float:
    """Equation 10 of one trial under a combined model [m], its zero free."""
    gain = float(model.gain.at(np.array(trial.speed_at(period))))
    return float(np.std(trial.position - gain * trial.step * model.plant.step_response(trial.time - delay)))


def usual_gain(fitted: Sequence[Fitted]) -> float:
    """The median gain of trials."""
    return float(np.median([one.first.gain for one in fitted]))


def _still(fitted: Sequence[Fitted]) -> dict[str, str]:
    """Trials in which the arm hardly moved."""
    usual = usual_gain(fitted)
    found = {one.trial.name: flag for one in fitted for flag in flags(one.first, usual)[:1]}
    return {name: flag for name, flag in found.items() if flag.startswith((HARDLY_MOVED, UNKNOWN_GAIN))}


def _unseen(fitted: Sequence[Fitted]) -> dict[str, str]:
    """Trials whose window ends before the arm is seen to move."""
    unseen = [one.trial.name for one in fitted if not one.onset < one.trial.time[-1]]
    return dict.fromkeys(unseen, "not seen to move within the window")


def _outlying(fitted: Sequence[Fitted]) -> dict[str, str]:
    """Trials of which a coefficient is far from all the others."""
    found: dict[str, str] = {}
    values = [(*one.first.shape[:2], one.first.gain) for one in fitted]
    sds = [(*one.first.sd[:2], one.first.sd.gain) for one in fitted]
    for word, column, sd in zip(("delay", "time constant", "gain"), np.array(values).T, np.array(sds).T, strict=True):
        for place in np.flatnonzero(outlying(column, sd)).tolist():
            shown = f"{column[place]:.2f}" if word == "gain" else f"{1e3 * column[place]:.0f} ms"
            found.setdefault(fitted[place].trial.name, f"outlying: its {word} is {shown}")
    return found


def _fitted_together(used: Sequence[Fitted]) -> Common:
    """The common plant by least squares over all trials, and delays and gains under it."""
    trials, own = [one.trial for one in used], [one.second for one in used]
    joints: tuple[JointFit, JointFit] = (fit_together(trials, own, 1), fit_together(trials, own, 2))
    count = joints[1].count
    choice = _choose(
        squares=[joint.cost for joint in joints],
        parameters=[3 * len(used) + order for order in (1, 2)],
        samples=int(count.sum()),
        rms=[float(np.sqrt(np.average(joint.rms**2, weights=count))) for joint in joints],
        inverse_square=inverse_square(*joints),
    )
    best = joints[choice.order - 1]
    if choice.order == 1:
        half = best.half_width([1.0, 0.0])
        plant: PLANTS = FirstOrder(time_constant=best.q, time_constant_ci95=(best.q - half, best.q + half))
    else:
        halves = [best.half_width(slope) for slope in _log_slopes(best.q, best.p)]
        plant = _second_order(best.q, best.p, *halves)
    return Common(
        choice=choice,
        plant=plant,
        lag=best.q + best.influence[:, 0],
        # an error of the plant shifts every trial's delay and gain: that part belongs to the trials that cause it
        delay=best.delay + best.influence @ best.delay_slope.mean(axis=0),
        delay_sd=best.delay_sd,
        gain=best.gain + best.influence @ best.gain_slope.mean(axis=0),
        gain_sd=best.gain_sd,
    )


def _published(used: Sequence[Fitted]) -> Common:
    """The paper's combination: averages of what was read off, and equation 10 over all trials for ω and ζ."""
    count = sum(one.first.samples for one in used)
    squares = [sum(one.first.squares for one in used), sum(one.second.squares for one in used)]
    choice = _choose(
        squares=squares,
        parameters=[(order + 3) * len(used) for order in (1, 2)],  # what is read off counts as fitted
        samples=count,
        rms=[float(np.sqrt(square / count)) for square in squares],
        inverse_square=mean(np.array([one.second.shape.p for one in used])),
    )
    own = [one.first if choice.order == 1 else one.second for one in used]
    if choice.order == 1:
        lag = np.array([fit.shape.q for fit in own])
        tau = mean(lag)
        plant: PLANTS = FirstOrder(time_constant=tau.value, time_constant_ci95=tau.ci95)
    else:
        trials = [one.trial for one in used]
        q, p = minimise(trials, own, 2)
        p = max(p, least_p(q))
        without = [minimise(trials[:k] + trials[k + 1 :], own[:k] + own[k + 1 :], 2) for k in range(len(own))]
        influence = (len(own) - 1) * (np.array([q, p]) - without)  # jackknife
        lag = q + influence[:, 0]
        intervals = [mean(influence @ slope).ci95 for slope in _log_slopes(q, p)]
        plant = _second_order(q, p, *(0.5 * (high - low) for low, high in intervals))
    zeros = np.zeros(len(used))
    delay, gain = np.array([fit.shape.delay for fit in own]), np.array([fit.gain for fit in own])
    return Common(choice, plant, lag, delay, zeros, gain, zeros)


def _log_slopes(q: float, p: float) -> tuple[list[float], list[float]]:
    """∂/∂(q, p) of log ω and of log ζ, whose errors are nearer to normal than those of ω and ζ."""
    return [0.0, -0.5 / p], [1.0 / q, -0.5 / p]


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


def _choose(
    squares: Sequence[float],
    parameters: Sequence[int],
    samples: int,
    rms: Sequence[float],
    inverse_square: Estimate,
) -> OrderChoice:
    """Choose the order by F-test, AICc and the interval of 1/ω².

    Second order is chosen if the F-test (5 %) and AICc prefer it and the interval of 1/ω² by trials lies above 0:
    samples of one trial are not independent, trials are.

    Args:
        squares: Sum of squared residuals of first and second order, in units of noise or not.
        parameters: How many each has.
        samples: In all trials.
        rms: Of the residuals of each [m].
        inverse_square: 1/ω² [s²].
    """
    from scipy.stats import f as fisher

    more, freedom = parameters[1] - parameters[0], max(samples - parameters[1], 1)
    F = (squares[0] - squares[1]) / more / (squares[1] / freedom) if squares[1] > 0.0 else 0.0
    p = float(fisher.sf(F, more, freedom))
    first, second = (_aicc(one, samples, count + 1) for one, count in zip(squares, parameters, strict=True))
    gain = first - second if np.isfinite(second) else None
    aicc = "too few samples for AICc"
    if gain is not None:
        aicc = f"AICc {abs(gain):.3g} {'lower' if gain > 0.0 else 'higher'}"
    numbers = (
        f"first order leaves {1e3 * rms[0]:.3g} mm, second {1e3 * rms[1]:.3g} (each trial weighted by its noise:"
        f" F({more}, {freedom}) = {F:.3g}, p {'< 0.001' if p < 1e-3 else f'= {p:.2g}'}; {aicc})"
    )
    preferred = p < 0.05 and gain is not None and gain > 0.0
    order: Order = 1
    if preferred and inverse_square.ci95[0] > 0.0:
        order, why = 2, f"second order: {numbers}, and the trials agree that 1/ω² is above 0"
    elif preferred:
        why = f"first order: {numbers}, but as the trials scatter 1/ω² may be 0"
    else:
        why = f"first order: {numbers}"
    return OrderChoice(
        order=order,
        first_rms=rms[0],
        second_rms=rms[1],
        f=F,
        p=p,
        aicc_gain=gain,
        inverse_square=inverse_square,
        why=why,
    )


def _aicc(squares: float, samples: int, parameters: int) -> float:
    """Akaike's criterion, corrected for few samples (infinite where there are too few)."""
    room = samples - parameters - 1
    if room <= 0:
        return np.inf
    return samples * float(np.log(max(squares, 1e-300))) + 2.0 * parameters * (1.0 + (parameters + 1) / room)


def _gain_line(speed: FloatArray, found: Common, levels: Sequence[str]) -> tuple[Gain, float | None, str]:
    """K = a·speed + b with intervals, the p of its lack of fit, and what the line shows."""
    distinct = ordered(set(levels))
    if len(distinct) == 1 or len(speed) < 4:
        level = common(found.gain, found.gain_sd)
        why = f"one speed only ({distinct[0]} m/s)" if len(distinct) == 1 else "too few trials for a line"
        return Gain(slope=0.0, intercept=level.value, intercept_ci95=level.ci95), None, f"slope 0: {why}"
    line = regression(found.gain, found.gain_sd, np.column_stack((np.ones(len(speed)), speed)))
    (b_low, b_high), (a_low, a_high) = line.conf_int().tolist()
    b, a = line.params.tolist()
    gain = Gain(slope=a, intercept=b, slope_ci95=(a_low, a_high), intercept_ci95=(b_low, b_high))
    words = "the slope is not significant"
    if a_low > 0.0 or a_high < 0.0:
        words = "K rises with speed" if a > 0.0 else "K falls with speed"
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
