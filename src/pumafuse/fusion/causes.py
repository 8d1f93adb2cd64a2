"""Causes: what would make the innovations of an axis more likely, if one thing were different.

Every cause is weighed by the log-likelihood that it gains, on the same measurements with the same outcomes:

- other noise (of a sensor, of the process, correlated, heavy-tailed): the likelihood of the filter that has it;
- what a model lacks moves the measurements by some shape times an unknown size: the arm's velocity for a lag, its
  position for a scale, what play or a limit of the speed take away. The innovations of measurements that are moved by
  the shape are those without it plus the *filtered* shape. Regressing on this is generalised least squares, of which
  the gain is ½ score² / information and the size score / information. A bare correlation of innovations with the
  velocity cannot tell a lag from play: the offset follows most of both.

All alternatives go through the filter at once, as axes of one model that measure the same.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, product
from operator import add
from typing import NamedTuple, TypeAlias, cast

import msgspec
import numpy as np

from ..arrays import BoolArray, FloatArray, IndexArray, IntArray, TimeArray, median
from ..filter.core import Filter, Model
from ..filter.events import COMMAND, Events, Results
from ..filter.outcome import Outcome
from ..filter.response import response
from ..model.arm import AxisModel
from ..model.plants import FirstOrder
from ..units import nanoseconds
from .config import FusionConfig
from .estimates import Estimates, Measurements
from .segments import Segment
from .setup import filter_model

_MOST = 2000  # components of an axis, from the middle of a segment: they tell enough, in 0.05 s
_FEWEST = 10  # components
_CLEAR = 10.0  # log-likelihood that a cause must gain: chance gives one of the shapes 8 in 1 of 16,000 cases
_CLOSE = 5.0  # log-likelihood within which another cause may be the right one: odds of 150
_NEAR = 0.95  # share of the best gain above which another cause may be the right one: no model is exact
_LAGS = 4  # at which innovations that are left are looked at
_COLOURED = 20.0  # Box-Pierce over its expectation, of 4 lags: 1 of 10,000 white ones
_REST = 0.5  # of what is too much of NIS, which a shape may leave
_LONGEST = 3  # causes named
_ROWS = 4 * _MOST  # components and commands
_COMMANDS = 3  # for each component, beyond which none is given to the filter unless it needs them
_SMALL = 1e-3  # standard deviations by which a shape moves the measurements: the filter is linear, angles do not turn
_FACTORS = (0.125, 0.25, 0.5, 0.7, 1.4, 2.0, 4.0, 8.0)  # of a noise; a parabola between them is good to a tenth
_OF_PROCESS = (*_FACTORS, 32.0)
_MANEUVERS = (3.0, 30.0)  # densities at the usual change of speed, over that of the drift
_CORRELATED = ((0.3, 0.1), (0.6, 0.1), (1.0, 0.1), (1.0, 0.8))  # drifting and white part, over sd
_TIMES = (1.5, 4.0, 15.0)  # intervals that the drifting part lasts
_TAILS = ((0.1, 5.0), (0.03, 10.0), (0.01, 30.0))  # share of outliers, and how many times as large they are
_JITTERS = (1e-3, 2e-3, 4e-3, 8e-3, 16e-3, 32e-3)  # s; standard deviation of a latency
_PLAYS = (1.0, 4.0, 16.0)  # half the play, over sd
_STILL = 1e-9  # m or rad; a shape that is smaller is none
_LIMITS = (0.95, 0.85, 0.7)  # of the speed, over the highest
_LEAST_DRIFT = 0.03  # 1/√s: density of the least drift, over the smallest sd, that is made larger; none stays none
_WHOLE_LAGS = 1.0, 3.0  # update periods: lags looked for as a whole: an accurate sensor sees more of them than velocity
_LONGEST_LAG = 2.0  # s; a search for an arm looks for none that is longer
_SLOWER = 1.1  # times the plant's lag: a derivative by it
_FASTER = 1.1, 1.5  # times the fastest speed


class Cause(enum.Enum):
    """What may be wrong, and which ``measure`` of :class:`pumafuse.FoundCause` its size is; "": it has none."""

    measure: str

    def __new__(cls, word: str, measure: str = "") -> Cause:
        """The word alone is its value."""
        cause = object.__new__(cls)
        cause._value_, cause.measure = word, measure
        return cause

    NOISE = "noise", "factor"  # a sensor's sd
    CORRELATED = "correlated"  # a sensor's noise goes on from measurement to measurement
    OUTLIERS = "outliers"  # a few innovations are far larger than the others
    PROCESS = "process", "factor"  # the process noise
    MANEUVERS = "maneuvers"  # process noise where the commanded speed changes
    JITTER = "jitter", "shift"  # a sensor's latency scatters from row to row
    LATENCY = "latency", "shift"  # of a sensor beside others
    LAG = "lag", "shift"  # of the arm, or the latency of the only sensor, which is named then
    PLANT = "plant", "shift"  # likewise of the plant
    DYNAMICS = "dynamics"  # the lag is right, but not how it is made up: delay, plant, smoothing
    SCALE = "scale", "share"  # of a sensor beside others
    POSITION = "position", "share"  # gain or sag, or the scale of the only sensor
    BIAS = "bias", "size"  # a sensor beside others is off by a constant
    PLAY = "play", "size"  # backlash
    LIMIT = "limit"  # of the speed
    FASTEST = "fastest", "share"  # the fastest speed that the model has


_ALIKE = {  # the better one of two is named
    Cause.MANEUVERS: Cause.PROCESS,
    Cause.PLANT: Cause.LAG,
    Cause.JITTER: Cause.NOISE,
}
_HANDICAPS = {
    Cause.CORRELATED: 8.0,  # two numbers more: the logarithm of some thousand measurements
    Cause.MANEUVERS: _CLOSE,  # a special case of process noise: to be named only if it is clearly the better one
}
_OF_ONE_SIGN = Cause.PLAY, Cause.LIMIT


class Suspect(NamedTuple):
    """A cause that explains the innovations."""

    cause: Cause
    sensor: str  # whose; "" of the arm
    size: float  # as :class:`Cause` says; 0 where it has none, infinite or 0 of a factor beyond those tried
    gain: float  # log-likelihood that it gains


class Tried(NamedTuple):
    """An alternative: a cause, a sensor or "", and which of several sizes or shapes of it."""

    cause: Cause
    sensor: str = ""
    which: float = 0.0


class Weight(NamedTuple):
    """What an alternative would change: a gain and a colour of another noise, the others of a shape."""

    gain: float = 0.0  # log-likelihood
    score: float = 0.0  # by the size of a shape, at 0
    information: float = 0.0
    number: float = 0.0  # of innovations
    squares: float = 0.0  # sum of their ν²/S
    colour: float = 0.0  # Box-Pierce statistic of what is left, over its expectation for white innovations


Evidence: TypeAlias = Mapping[Tried, Weight]


def evidence_of(est: Estimates, axis: str) -> Evidence:
    """What every alternative would gain on one axis."""
    measured = est.measurements
    decided = (measured.axis == measured.axes.index(axis)) & (measured.outcome <= Outcome.REACQUIRED)
    return together(
        _of_part(_part(est, segment, axis, measured.where(chosen)))
        for number, segment in enumerate(est.segments)
        if len(chosen := _middle(est.config, segment, axis, decided & (measured.segment == number))) >= _FEWEST
    )


def _middle(config: FusionConfig, segment: Segment, axis: str, decided: BoolArray) -> IntArray:
    """Components in the middle of a segment; so few that their commands, if they are needed, are not too many."""
    places, commands = np.flatnonzero(decided), len(segment.commands_of(axis)[0])
    most = _ROWS * len(places) // (len(places) + commands) if _needs_commands(config, axis) else _ROWS
    most = min(most, _MOST)
    skipped = max(len(places) - most, 0) // 2
    return places[skipped : skipped + most]


def _needs_commands(config: FusionConfig, axis: str) -> bool:
    """Whether a variance depends on them: that of maneuvers, or of a latency that wanders."""
    process = config.process[axis]
    wandering = any(sensor.latency_sd for sensor in config.sensors.values())
    return wandering or process.maneuver_noise > 0.0 or process.maneuver_drift > 0.0


def together(parts: Iterable[Evidence]) -> Evidence:
    """The evidence of several parts of a run: gains, scores and information add up."""
    weights: dict[Tried, Weight] = {}
    for part in parts:
        for tried, weight in part.items():
            weights[tried] = Weight(*map(add, weights.get(tried, Weight()), weight))
    return weights


def suspects(evidence: Evidence) -> tuple[Suspect, ...]:
    """The cause that explains the innovations best, and those that explain them about as well; best first."""
    best: dict[tuple[Cause, str], Suspect] = {}
    for weighed in _weigh(evidence):
        key = _ALIKE.get(weighed.cause, weighed.cause), weighed.sensor
        if key not in best or weighed.gain > best[key].gain:
            best[key] = weighed
    ordered = sorted(best.values(), key=lambda suspect: -suspect.gain)
    if not ordered or ordered[0].gain < _CLEAR:
        return ()
    first = ordered[0]
    least = max(_CLEAR, min(_NEAR * first.gain, first.gain - _CLOSE))
    doubtful = _least_of_correlated(evidence, first)
    return tuple(
        suspect
        for suspect in ordered[:_LONGEST]
        if suspect.gain >= least or (suspect.cause is Cause.CORRELATED and suspect.gain > doubtful)
    )


def _least_of_correlated(evidence: Evidence, first: Suspect) -> float:
    """What a correlated noise must gain to be named beside a noise that is too large.

    A smaller sd is the wrong thing to do about filtered values. If it leaves the innovations correlated, any gain will
    do.
    """
    if first.cause not in (Cause.NOISE, Cause.PROCESS) or first.size > 1.0:
        return math.inf
    weights = [
        weight for tried, weight in evidence.items() if (tried.cause, tried.sensor) == (first.cause, first.sensor)
    ]
    return 0.0 if max(weights, key=lambda weight: weight.gain).colour > _COLOURED else first.gain - _CLEAR


def _weigh(evidence: Evidence) -> Iterator[Suspect]:
    sizes: dict[tuple[Cause, str], list[tuple[float, float]]] = {}
    for (cause, sensor, which), weight in evidence.items():
        if cause in (Cause.NOISE, Cause.PROCESS, Cause.JITTER):
            sizes.setdefault((cause, sensor), [] if cause is Cause.JITTER else [(1.0, 0.0)]).append(
                (which, weight.gain)
            )
        elif weight.information > 0.0:
            size = weight.score / weight.information
            if _is_possible(cause, which, size):
                yield Suspect(cause, sensor, size * _unit(cause, which), _gain_of_shape(weight))
        else:
            yield Suspect(cause, sensor, 0.0, weight.gain - _HANDICAPS.get(cause, 0.0))
    for (cause, sensor), tried in sizes.items():
        yield Suspect(cause, sensor, *_highest(sorted(tried)))


def _gain_of_shape(weight: Weight) -> float:
    """Log-likelihood that the best size gains.

    No shape is exact. One that explains most of what is too much may leave a rest that is still larger than expected:
    then the variance of all innovations is that of the rest.
    """
    explained = weight.score**2 / weight.information
    before, after = weight.squares / weight.number, (weight.squares - explained) / weight.number
    widened = (
        0.5 * weight.number * (after - 1.0 - math.log(after)) if 1.0 < after < 1.0 + _REST * (before - 1.0) else 0.0
    )
    return 0.5 * explained + widened


def _is_possible(cause: Cause, which: float, size: float) -> bool:
    """Whether there is a cause of that size: no play is negative, and a lag of 1 ms does not look like one of 30."""
    if cause in (Cause.LAG, Cause.LATENCY, Cause.PLANT) and abs(size) > _LONGEST_LAG:
        return False
    if cause in (Cause.LAG, Cause.LATENCY, Cause.FASTEST):
        return which == 0.0 or 0.5 < size / which < 2.0
    return size > 0.0 or cause not in _OF_ONE_SIGN


def _unit(cause: Cause, which: float) -> float:
    """What a shape of size 1 is in the unit of its cause; 0 where it has none."""
    if cause is Cause.PLAY:
        return which
    return 0.0 if not cause.measure or (cause is Cause.POSITION and which) else 1.0


def _highest(tried: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The size with the largest gain, and that, by a parabola over its logarithm; none (0 or ∞) at an end."""
    size, gain = (np.array(column) for column in zip(*tried, strict=True))
    top = int(np.argmax(gain))
    if not 0 < top < len(gain) - 1:
        return (np.inf if top else 0.0), float(gain[top])
    x, y = np.log(size[top - 1 : top + 2] / size[top]), gain[top - 1 : top + 2]
    a, b, c = cast(FloatArray, np.polyfit(x, y, 2)).tolist()
    return float(size[top] * np.exp(-b / (2.0 * a))), float(c - b**2 / (4.0 * a))


# ---- one pass of the filter -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Part:
    """Components of one axis that follow each other, and the commands meanwhile."""

    config: FusionConfig
    segment: Segment  # its commands
    axis: str
    measured: Measurements  # the components, (m,)
    time: TimeArray  # when they are valid, int64 ns, (m,)
    scale: FloatArray  # of their sensors, (m,)
    start: float  # where it rests before the commands that the filter is given
    stamp: TimeArray  # when these are given, int64 ns, (k,)
    command: FloatArray  # these [m or rad], (k,)

    @cached_property
    def response(self) -> FloatArray:
        """Where all commands lead the axis at ``time`` [m or rad], (m,)."""
        return self.position(self.config.arm.axes[self.axis], self.time)

    @cached_property
    def speed(self) -> FloatArray:
        """Speed of where commands lead, over two update periods [m/s or rad/s], (m,)."""
        ns = round(self.config.arm.update_period * 1e9)
        late, early = (self.position(self.config.arm.axes[self.axis], self.time + by) for by in (ns, -ns))
        return 0.5e9 / ns * (late - early)

    @property
    def sensors(self) -> list[int]:
        """The sensors that measure."""
        return np.flatnonzero(np.bincount(self.measured.sensor)).tolist()  # numpy's unique imports masked arrays

    def position(self, model: AxisModel, time: TimeArray) -> FloatArray:
        """Where all commands lead an axis like this, (n,)."""
        return self.segment.start[self.axis] + self.segment.response(self.config.arm, self.axis, time, model)


def _part(est: Estimates, segment: Segment, axis: str, measured: Measurements) -> _Part:
    """Components with the commands that act meanwhile, or without, where these are many and not needed."""
    arm, time = est.config.arm, est.origin + nanoseconds(measured.time)
    stamp, command = segment.commands_of(axis)
    first, last = np.searchsorted(stamp + round(arm.delay_of(axis) * 1e9), time[[0, -1]]).tolist()
    if last - first > _COMMANDS * len(time) and not _needs_commands(est.config, axis):
        last = first
    start = float(command[first - 1]) if first else segment.start[axis]
    scales = np.array(
        [est.config.sensors[name].scale if name in est.config.sensors else 1.0 for name in measured.sensors]
    )
    commands = start, stamp[first:last], command[first:last]
    return _Part(est.config, segment, axis, measured, time, scales[measured.sensor], *commands)


def _of_part(part: _Part) -> Evidence:
    measured, base = part.measured, _model(part)
    jitters = dict(_jitters(part, base))
    other = [*_process(part, base), *_sensors(part, base), *((tried, base) for tried in jitters)]
    shapes = {tried: x for tried, x in _shapes(part) if np.abs(x).max() > _STILL}
    unit = _SMALL * float(np.nanmin(base.view["sd"]))
    moves = {tried: unit / float(np.abs(x).max()) for tried, x in shapes.items()}
    moved = np.zeros((len(part.time), 1 + len(other) + len(shapes)))
    for column, (tried, x) in enumerate(shapes.items(), 1 + len(other)):
        moved[:, column] = moves[tried] * x
    spread = np.repeat(part.measured.spread[:, None], moved.shape[1], axis=1)
    spread[:, 1 + len(other) - len(jitters) : 1 + len(other)] *= np.column_stack(list(jitters.values()))
    models = [base, *(model for _, model in other), *(base for _ in shapes)]
    nu, sd, sensor = _filter(part, models, moved, spread)
    normalised = nu / sd
    density = -np.log(sd) - 0.5 * normalised**2
    gains = (density - density[:, :1]).sum(axis=0)
    weights = dict[Tried, Weight]()
    for column, (tried, _) in enumerate(other, 1):
        asked = [number for number in part.sensors if tried.sensor in ("", measured.sensors[number])]
        colour = sum(_colour(normalised[sensor == number, column]) for number in asked)
        weights[tried] = Weight(gain=float(gains[column]), colour=colour)
    for column, (tried, move) in enumerate(moves.items(), 1 + len(other)):
        x = (normalised[:, column] - normalised[:, 0]) / move
        score, squares = float(x @ normalised[:, 0]), float(normalised[:, 0] @ normalised[:, 0])
        weights[tried] = Weight(score=score, information=float(x @ x), number=len(x), squares=squares)
    for number in part.sensors:
        for share, times in _TAILS:
            gain = _heavy_tailed(normalised[sensor == number, 0], share, times)
            weights[Tried(Cause.OUTLIERS, measured.sensors[number], times)] = Weight(gain)
    return weights


def _model(part: _Part) -> Model:
    names, sensors = part.measured.sensors, part.config.sensors
    biased = [name for name in names if name in sensors and sensors[name].is_biased(part.axis)]
    return filter_model(part.config, [part.axis], names, {part.axis: part.start}, [biased])


def _filter(
    part: _Part, models: Sequence[Model], moved: FloatArray, spread: FloatArray
) -> tuple[FloatArray, FloatArray, IndexArray]:
    """Innovations and their sd by k models (n, k), and whose they are, (n,).

    Measurements are moved, and their noise is scaled, by (m, k).
    """
    arm, axis, count, measured = part.config.arm, part.axis, len(models), part.measured
    delay = arm.delay_of(axis)
    acts = part.stamp + round(delay * 1e9)
    led = part.start + response(
        arm.axes[axis], arm.update_period, delay, part.stamp, part.command, part.start, part.time
    )  # by the commands that the filter is given; those before are taken off
    value = (measured.value - part.scale * (part.response - led))[:, None] + moved
    instants = np.concatenate([acts, part.time])
    order = np.argsort(instants, kind="stable")  # commands first
    instants = instants[order]
    values = np.concatenate([np.repeat(part.command[:, None], count, axis=1), value])[order]
    spread = np.concatenate([np.ones((len(acts), count)), spread])[order]
    source = np.concatenate([np.full(len(acts), COMMAND, dtype=np.int16), measured.sensor])[order]
    outcome = np.concatenate([np.zeros(len(acts), dtype=np.uint8), measured.outcome])[order]
    codes = np.zeros(values.shape, dtype=np.uint8)
    results = Results.room(*values.shape)
    results.outcome[:] = outcome[:, None]
    axes, view = np.concatenate([model.axis for model in models]), np.hstack([model.view for model in models])
    core = Filter(Model(axes, models[0].sensor, view), min(part.segment.origin, int(instants[0])))
    events = Events(instants, source, instants, values, spread, codes)
    core.run(events, results, np.zeros(0, dtype=np.int64), "repeated")
    fused = (source != COMMAND) & (outcome == int(Outcome.FUSED))
    return results.innovation[fused], results.innovation_sd[fused], source[fused]


def _colour(values: FloatArray) -> float:
    """Box-Pierce: n Σ r², less the number of its lags."""
    power = float(values @ values)
    if len(values) <= _LAGS or power == 0.0:
        return 0.0
    products = [float(values[lag:] @ values[:-lag]) for lag in range(1, _LAGS + 1)]
    return len(values) * sum(product**2 for product in products) / power**2 - _LAGS


def _heavy_tailed(normalised: FloatArray, share: float, times: float) -> float:
    """What the log-likelihood gains if a share of normal values has a standard deviation that many times as large."""
    tail = np.log(share / times) + 0.5 * normalised**2 * (1.0 - times**-2)
    return float(np.logaddexp(np.log1p(-share), tail).sum())


# ---- other noise ----------------------------------------------------------------------------------------------------


def _process(part: _Part, base: Model) -> Iterator[tuple[Tried, Model]]:
    least = float(np.nanmin(base.view["sd"])) * _LEAST_DRIFT
    changes = np.diff(part.command, 2) / part.config.arm.update_period
    usual = float(np.sqrt(np.mean(changes**2))) if len(changes) else 0.0
    for factor in _OF_PROCESS:
        axis = base.axis.copy()
        axis["drift"] = np.maximum(axis["drift"], least * (factor > 1.0))
        for name in ("input_noise", "drift", "maneuver_noise", "maneuver_drift", "disturbance_sd"):
            axis[name] *= factor
        yield Tried(Cause.PROCESS, which=factor), base._replace(axis=axis)
    for factor in _MANEUVERS if usual > 0.0 else ():
        axis = base.axis.copy()
        axis["maneuver_drift"] += factor * np.maximum(axis["drift"], least) / usual
        yield Tried(Cause.MANEUVERS, which=factor), base._replace(axis=axis)


def _sensors(part: _Part, base: Model) -> Iterator[tuple[Tried, Model]]:
    measured = part.measured
    for number in part.sensors:
        name, sd = measured.sensors[number], float(base.view["sd"][number, 0])
        gaps = np.diff(measured.time[measured.sensor == number])
        interval = median(gaps) if len(gaps) else 0.0
        for factor in _FACTORS:
            yield Tried(Cause.NOISE, name, factor), _change_view(base, number, sd=factor * sd)
        for which, ((drifting, white), lasting) in enumerate(product(_CORRELATED, _TIMES) if interval > 0.0 else ()):
            noise = {"sd": white * sd, "bias_drift_sd": drifting * sd, "bias_time": lasting * interval}
            yield Tried(Cause.CORRELATED, name, which), _change_view(base, number, **noise)


def _jitters(part: _Part, base: Model) -> Iterator[tuple[Tried, FloatArray]]:
    """Factors on the noise of each component, (m,), if the latency of one sensor scatters by one size."""
    moved = np.abs(part.scale * part.speed)
    for number in part.sensors:
        noise = moved * (part.measured.sensor == number) / (part.measured.spread * base.view["sd"][number, 0])
        for latency_sd in _JITTERS:
            yield Tried(Cause.JITTER, part.measured.sensors[number], latency_sd), np.hypot(1.0, latency_sd * noise)


def _change_view(base: Model, sensor: int, **numbers: float) -> Model:
    view = base.view.copy()
    for name, value in numbers.items():
        view[name][sensor, 0] = value
    return base._replace(view=view)


# ---- shapes ---------------------------------------------------------------------------------------------------------


def _shapes(part: _Part) -> Iterator[tuple[Tried, FloatArray]]:
    """What a cause of unit size adds to the measurements [m or rad], (m,)."""
    arm, time, led, scale, measured = part.config.arm, part.time, part.response, part.scale, part.measured
    model, used = arm.axes[part.axis], part.sensors
    lags = dict[float, FloatArray]()
    for ns in (round(periods * arm.update_period * 1e9) for periods in _WHOLE_LAGS):
        late, early = part.position(model, time - ns) - led, part.position(model, time + ns) - led
        lags.setdefault(0.0, 0.5e9 / ns * (late - early))
        lags |= {1e-9 * ns: 1e9 / ns * late, -1e-9 * ns: -1e9 / ns * early}
    slow, quick = (part.position(_slower(model, factor), time) for factor in (_SLOWER, 1.0 / _SLOWER))
    by_plant = (slow - quick) / (model.plant.lag * (_SLOWER - 1.0 / _SLOWER))
    only = measured.sensors[used[0]] if len(used) == 1 else ""
    for which, x in lags.items():
        yield Tried(Cause.LAG, only, which), scale * x
    yield Tried(Cause.PLANT, only), scale * by_plant
    yield Tried(Cause.DYNAMICS), scale * (by_plant - lags[0.0])
    middle = led - (led.max() + led.min()) / 2.0
    yield Tried(Cause.POSITION, only, 0), scale * middle
    if np.ptp(led) > 0.0:
        yield Tried(Cause.POSITION, only, 1), scale * middle**2 / np.ptp(led)
    least = min(sd for sensor in part.config.sensors.values() if (sd := sensor.sd_of(part.axis)))
    for half_play in (times * least for times in _PLAYS):
        yield Tried(Cause.PLAY, which=2.0 * half_play), scale * (_apply_play(led, half_play) - led)
    for share in _LIMITS if model.max_speed is None else ():
        farthest = share * float(np.abs(lags[0.0]).max()) * np.diff(time, prepend=time[0]) / 1e9
        yield Tried(Cause.LIMIT, which=share), scale * (_limit_speed(led, farthest) - led)
    for factor in (each for times in _FASTER for each in (times, 1.0 / times) if model.max_speed is not None):
        faster = msgspec.structs.replace(model, max_speed=factor * (model.max_speed or 0.0))
        yield (Tried(Cause.FASTEST, which=factor - 1.0), scale * (part.position(faster, time) - led) / (factor - 1.0))
    for number in used if len(used) > 1 else ():
        name, rows = measured.sensors[number], measured.sensor == number
        for which, x in lags.items():
            yield Tried(Cause.LATENCY, name, which), np.where(rows, scale * x, 0.0)
        yield Tried(Cause.SCALE, name), np.where(rows, scale * middle, 0.0)
        yield Tried(Cause.BIAS, name), rows.astype(np.float64)


def _slower(model: AxisModel, factor: float) -> AxisModel:
    """The axis with a plant whose lag is so many times as long."""
    plant = model.plant
    if isinstance(plant, FirstOrder):
        slower = msgspec.structs.replace(plant, time_constant=factor * plant.time_constant)
    else:
        slower = msgspec.structs.replace(plant, natural_frequency=plant.natural_frequency / factor)
    return msgspec.structs.replace(model, plant=slower)


def _apply_play(drive: FloatArray, half: float) -> FloatArray:
    """Where a tool is that its drive takes along at either end of its play, (m,)."""
    pushed = accumulate(drive.tolist(), lambda tool, at: min(max(tool, at - half), at + half))
    return np.fromiter(pushed, dtype=np.float64)


def _limit_speed(drive: FloatArray, farthest: FloatArray) -> FloatArray:
    """Where an axis is that follows, but in each interval no farther than that, (m,)."""
    moves = zip(drive[1:].tolist(), farthest[1:].tolist(), strict=True)
    driven = accumulate(moves, lambda now, move: min(max(move[0], now - move[1]), now + move[1]), initial=drive[0])
    return np.fromiter(driven, dtype=np.float64)
