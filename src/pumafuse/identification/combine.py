"""From the trials of an axis to its model: order, plant, gain against speed, delay; the paper's Table II.

Intervals are clustered by trial: a trial counts as one observation, however many samples it has. What makes trials
differ (a delay that jitters, friction, the pose) is the same for all samples of one trial.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from ..arrays import FloatArray
from ..model.arm import AxisModel, Gain
from ..model.plants import PLANTS, FirstOrder
from ..units import MS, SCREEN, Kind
from .anova import order_levels, outlying, speed_levels
from .batch import Order
from .estimate import Estimate, common, fit_weighted, mean, regression, robust
from .fit import StepFit, doubt_words, least_p, plant_of
from .joint import JointFit, fit_together, inverse_square
from .paper import minimise
from .trials import Trial

_FEWEST = 3  # trials for a model


@dataclass(frozen=True)
class Fitted:
    """One trial with its fits of both orders, and its onset [s] (NaN: never)."""

    trial: Trial
    first: StepFit
    second: StepFit
    onset: float


class OrderChoice(msgspec.Struct, frozen=True, kw_only=True):
    """First or second order."""

    order: Order
    # root mean square residual of first order over all trials [m or rad]
    first_rms: float = msgspec.field(name="first_rms_mm")
    second_rms: float = msgspec.field(name="second_rms_mm")  # of second order [m or rad]
    f: float  # of the F-test of the additional parameters of second order
    p: float  # of that F
    aicc_gain: float | None  # by how much second order lowers AICc; negative: it raises it. Null: too few samples.
    # 1/ω² [s²] with its interval by trials; 0 is first order
    inverse_square: Estimate = msgspec.field(name="inverse_square_s2")
    why: str


class Delays(msgspec.Struct, frozen=True, kw_only=True):
    """Three delays [s]."""

    lag: Estimate = msgspec.field(name="lag_ms")  # behind the held command at constant velocity: Td + τ, or Td + 2ζ/ω
    fitted: Estimate = msgspec.field(name="fitted_ms")  # Td of the model
    # when the arm is first seen to move: above 3 standard deviations and 2 % of the step; null: never
    onset: Estimate | None = msgspec.field(name="onset_ms")


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
    """The common plant of an axis, and delay and gain of each trial under it; arrays (n,)."""

    trials: Sequence[Trial]  # that it is made of
    choice: OrderChoice
    plant: PLANTS
    lag: FloatArray  # 2ζ/ω, or τ, plus each trial's influence on it [s]
    delay: FloatArray  # Td of each trial [s]
    delay_sd: FloatArray  # its standard deviation by the noise [s]
    gain: FloatArray  # K of each trial
    gain_sd: FloatArray  # its standard deviation by the noise


def combine(fitted: Sequence[Fitted], period: float, paper: bool, kind: Kind) -> tuple[CombinedAxis, Common] | str:
    """The model of one axis from its trials, or why there is none; the period T is in s.

    ``paper``: average as the paper does, with all outliers, and with delay and gain as read off.
    """
    usual = usual_gain(fitted)
    if usual == 0.0:
        return "the arm does not move"
    unseen = [fit.trial.name for fit in fitted if not fit.onset < fit.trial.time[-1]]
    left_out = dict.fromkeys(unseen, "not seen to move within the window") if paper else _outlying(fitted)
    left_out |= {fit.trial.name: why for fit in fitted if (why := doubt_words(fit.first, usual)) is not None}
    used = [fit for fit in fitted if fit.trial.name not in left_out]
    if len(used) < _FEWEST:
        why = "; ".join(f"trial '{name}' {reason}" for name, reason in list(left_out.items())[:3])
        return f"{len(used)} usable trials, at least {_FEWEST} are needed" + (f" ({why})" if why else "")
    published = _combine_as_published(used, kind) if paper else _fit_together(used, kind)
    gain, lack, words = _gain_line(published, period, kind)
    delay = common(published.delay, published.delay_sd)
    tau = np.array([fit.first.shape.q for fit in used])
    seen = np.array([fit.onset for fit in used if np.isfinite(fit.onset)])
    axis = CombinedAxis(
        trials=len(used),
        left_out=left_out,
        choice=published.choice,
        model=AxisModel(kind=kind, plant=published.plant, gain=gain, delay=delay.value, delay_ci95=delay.ci95),
        time_constant_mean=mean(tau),
        time_constant_robust=robust(tau),
        delays=Delays(
            lag=common(published.delay + published.lag, published.delay_sd),
            fitted=delay,
            onset=mean(seen) if len(seen) else None,
        ),
        delay_spread=float(published.delay.std(ddof=1)),
        delay_noise=float(np.median(published.delay_sd)),
        lack_of_fit_p=lack,
        gain_words=words,
    )
    return axis, published


def combined_rms(trial: Trial, model: AxisModel, delay: float, period: float) -> float:
    """Equation 10 of one trial under a combined model [m or rad], its zero free."""
    gain = float(model.gain.at(np.array(trial.speed_at(period))))
    return float(np.std(trial.position - gain * trial.step * model.plant.step_response(trial.time - delay)))


def usual_gain(fitted: Sequence[Fitted]) -> float:
    """The median gain of trials."""
    return float(np.median([fit.first.gain for fit in fitted]))


def coefficients(fitted: Sequence[Fitted]) -> dict[str, tuple[FloatArray, FloatArray]]:
    """The paper's three coefficients of first-order fits with their sds, in the units of their names, (n,) each."""
    values = np.array([(*fit.first.shape, fit.first.gain) for fit in fitted])
    sds = np.array([fit.first.sd for fit in fitted])
    scales = {"delay_ms": (0, MS), "gain": (3, 1.0), "time_constant_ms": (1, MS)}
    return {name: (values[:, number] * unit, sds[:, number] * unit) for name, (number, unit) in scales.items()}


def _outlying(fitted: Sequence[Fitted]) -> dict[str, str]:
    """Trials of which a coefficient is far from all the others."""
    reasons: dict[str, str] = {}
    for name, (values, sd) in coefficients(fitted).items():
        for row in np.flatnonzero(outlying(values, sd)).tolist():
            shown = f"{values[row]:.2f}" if name == "gain" else f"{values[row]:.0f} ms"
            word = name.removesuffix("_ms").replace("_", " ")
            reasons.setdefault(fitted[row].trial.name, f"outlying: its {word} is {shown}")
    return reasons


def _fit_together(used: Sequence[Fitted], kind: Kind) -> Common:
    """The common plant by least squares over all trials, and delays and gains under it."""
    trials, fits = [fit.trial for fit in used], [fit.second for fit in used]
    joints: tuple[JointFit, JointFit] = (fit_together(trials, fits, 1), fit_together(trials, fits, 2))
    count = joints[1].count
    choice = _choose(
        squares=[joint.cost for joint in joints],
        parameters=[3 * len(used) + order for order in (1, 2)],
        samples=int(count.sum()),
        rms=[float(np.sqrt(np.average(joint.rms**2, weights=count))) for joint in joints],
        inverse_square=inverse_square(*joints),
        kind=kind,
    )
    best = joints[choice.order - 1]
    return Common(
        trials=trials,
        choice=choice,
        plant=_plant(best.q, best.p, best.half_width),
        lag=best.q + best.influence[:, 0],
        # an error of the plant shifts every trial's delay and gain: that part belongs to the trials that cause it
        delay=best.delay + best.influence @ best.delay_slope.mean(axis=0),
        delay_sd=best.delay_sd,
        gain=best.gain + best.influence @ best.gain_slope.mean(axis=0),
        gain_sd=best.gain_sd,
    )


def _combine_as_published(used: Sequence[Fitted], kind: Kind) -> Common:
    """The paper's combination: averages of what was read off and of τ; equation 10 over all trials for ω and ζ."""
    trials, n = [fit.trial for fit in used], len(used)
    count = sum(fit.first.samples for fit in used)
    squares = [sum(fit.first.squares for fit in used), sum(fit.second.squares for fit in used)]
    choice = _choose(
        squares=squares,
        parameters=[(order + 3) * n for order in (1, 2)],  # what is read off counts as fitted
        samples=count,
        rms=[float(np.sqrt(square / count)) for square in squares],
        inverse_square=mean(np.array([fit.second.shape.p for fit in used])),
        kind=kind,
    )
    fits = [fit.first if choice.order == 1 else fit.second for fit in used]
    lags = np.array([fit.shape.q for fit in fits])

    def over(rows: list[int]) -> tuple[float, float]:
        if choice.order == 1:
            return float(lags[rows].mean()), 0.0
        q, p = minimise([trials[row] for row in rows], [fits[row] for row in rows])
        return q, max(p, least_p(q))

    q, p = over(list(range(n)))
    without = [over([other for other in range(n) if other != row]) for row in range(n)]
    influence = (n - 1) * (np.array([q, p]) - without)  # jackknife
    plant = _plant(q, p, lambda slope: float(np.ptp(mean(influence @ slope).ci95)) / 2.0)
    delay, gain = np.array([(fit.shape.delay, fit.gain) for fit in fits]).T
    return Common(trials, choice, plant, q + influence[:, 0], delay, np.zeros(n), gain, np.zeros(n))


def _plant(q: float, p: float, half_width: Callable[[list[float]], float]) -> PLANTS:
    """The plant with its intervals; ``half_width`` is of half a 95 % interval, by its gradient in q and p (2,)."""
    plant = plant_of(q, p)
    if isinstance(plant, FirstOrder):
        half = half_width([1.0, 0.0])
        return msgspec.structs.replace(plant, time_constant_ci95=(q - half, q + half))
    # of log ω and log ζ, whose errors are nearer to normal than those of ω and ζ
    wide = np.exp(half_width([0.0, -0.5 / p]))
    damping_wide = np.exp(half_width([1.0 / q, -0.5 / p]))
    return msgspec.structs.replace(
        plant,
        natural_frequency_ci95=(float(plant.natural_frequency / wide), float(plant.natural_frequency * wide)),
        damping_ci95=(float(plant.damping / damping_wide), float(plant.damping * damping_wide)),
    )


def _choose(
    squares: Sequence[float],
    parameters: Sequence[int],
    samples: int,
    rms: Sequence[float],
    inverse_square: Estimate,
    kind: Kind,
) -> OrderChoice:
    """Choose the order by F-test, AICc and the interval of 1/ω² [s²].

    Second order is chosen if the F-test (5 %) and AICc prefer it and the interval of 1/ω² by trials lies above 0:
    samples of one trial are not independent, trials are. ``squares``, ``parameters`` and ``rms`` [m or rad] are those
    of first and second order; ``samples`` are in all trials.
    """
    from scipy.stats import f as fisher

    more, freedom = parameters[1] - parameters[0], max(samples - parameters[1], 1)
    F = (squares[0] - squares[1]) / more / (squares[1] / freedom) if squares[1] > 0.0 else 0.0
    p = float(fisher.sf(F, more, freedom))
    gain, words = None, "too few samples for AICc"
    if samples > parameters[1] + 2:  # the noise is one parameter more
        counts = np.array(parameters) + 1
        aicc = samples * (np.log(np.maximum(squares, 1e-300)) + 2.0 * counts / (samples - counts - 1))
        gain = float(aicc[0] - aicc[1])
        words = f"AICc {abs(gain):.3g} {'lower' if gain > 0.0 else 'higher'}"
    preferred = p < 0.05 and gain is not None and gain > 0.0
    order: Order = 2 if preferred and inverse_square.ci95[0] > 0.0 else 1
    unit, (first, second) = SCREEN[kind].unit, [rms_of_order * SCREEN[kind].scale for rms_of_order in rms]
    why = (
        f"{'second' if order == 2 else 'first'} order: first order leaves {first:.3g} {unit}, second"
        f" {second:.3g} (each trial weighted by its noise: F({more}, {freedom}) = {F:.3g},"
        f" p {'< 0.001' if p < 1e-3 else f'= {p:.2g}'}; {words})"
    )
    if preferred:
        why += (
            ", and the trials agree that 1/ω² is above 0" if order == 2 else ", but as the trials scatter 1/ω² may be 0"
        )
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


def _gain_line(together: Common, period: float, kind: Kind) -> tuple[Gain, float | None, str]:
    """K = a·speed + b with intervals, the p of its lack of fit, and what the line shows."""
    speed = np.array([trial.speed_at(period) for trial in together.trials])
    levels = speed_levels(together.trials, period, kind)
    distinct = order_levels(set(levels))
    if len(distinct) == 1 or len(speed) < 4:
        level = common(together.gain, together.gain_sd)
        why = (
            f"one speed only ({distinct[0]} {SCREEN[kind].fast})" if len(distinct) == 1 else "too few trials for a line"
        )
        return Gain(slope=0.0, intercept=level.value, intercept_ci95=level.ci95), None, f"slope 0: {why}"
    line = regression(together.gain, together.gain_sd, np.column_stack((np.ones(len(speed)), speed)))
    (b_low, b_high), (a_low, a_high) = line.ci95.tolist()
    b, a = line.values.tolist()
    gain = Gain(slope=a, intercept=b, slope_ci95=(a_low, a_high), intercept_ci95=(b_low, b_high))
    words = "the slope is not significant"
    if a_low > 0.0 or a_high < 0.0:
        words = "K rises with speed" if a > 0.0 else "K falls with speed"
    if not 2 < len(distinct) < len(speed):
        return gain, None, words
    at_levels = np.array(levels)[:, None] == np.array(distinct)
    apart = fit_weighted(together.gain, line.weights, at_levels.astype(np.float64))
    lack = apart.p_against(line)  # of the hypothesis that the means of all levels lie on the line
    return gain, lack, words + ("; not along a straight line" if lack < 0.05 else "")
