"""How late is it? The arm of recorded runs from their motion alone, and the latency of each sensor: :func:`latency`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from .. import toml
from ..arrays import FloatArray
from ..discovery.guesses import ArmGuess, AxisGuess, Pair, SensorGuess, guess
from ..discovery.own_frames import own_frames
from ..discovery.roles import relations
from ..discovery.sensors import aligned
from ..discovery.survey import SOONER, Survey, early, interpolation, soonest, too_early
from ..errors import PumafuseWarning, UnknownNameError
from ..fusion.config import SD_BOUNDS, FusionConfig, Process, Sensor, Start
from ..logs.axes import in_axes
from ..logs.run import REFERENCE, Run
from ..model.arm import ArmModel, AxisModel, Sag
from ..model.plants import FirstOrder
from ..toml import Interval
from ..units import MS, Kind
from .arm_search import GATE, ArmSearch, Chosen, Freedom, chosen_arms
from .arms import BENDS, Arm
from .identifiability import FEW, TuneError, excited_axes
from .likelihood import Likelihood, in_threads
from .parameters import changed, rounded, set_arm, set_noise, set_shared_delay
from .plain import LONGEST, Doubt, doubts, lag_steps, set_plain_arm
from .posterior import Model, Quantity

_MARGIN = 1.25  # by which intervals of all but the lag are widened: found by simulation, see docs/comparison.md
_HIGHEST = 700.0  # logarithm of what a number can be
_SAMPLED = (
    "{}: what measures follows the path between commands sooner than an arm can that holds each; if they are samples of"
    " a path that the controller interpolates, write interpolation_ms = {:g} below [command] in run.toml"
)
_AHEAD_OF = "{}: what measures is {:.0f} ms ahead of the commands, and the lag is wrong: are both stamped by one clock?"
_APART = "{}: sees no motion that {} sees: its latency is not known"
_FINEST = 2e-5  # s: no stamp of a log is better, whatever the likelihood says where measurements pass commands
_ROUGHLY = 0.1  # tolerance in log-likelihood
_GATE = 8.0  # standard deviations, of a sensor that has outliers: what jerks is none
_WIDE, _WIDE_LAG, _WIDE_GAIN = 0.3, 0.02, 0.1  # of the lag, s, of 1: intervals from which a number is not known
_PARTS = 10  # of a run, the lag of each of which is reported
_DRIFTS = 3.5  # standard deviations from which a drift is named
_WANDERS = 1e-4  # probability below which a wandering is named
_SMALLEST = 1e-3  # s, of a drift or a wandering that is named


class AxisLag(msgspec.Struct, frozen=True, kw_only=True):
    """How late an axis is, and what it is made of.

    Attributes:
        sensor: The sensor it is known by, whose stamps are taken to be right.
        lag: Behind the held command at constant velocity [s].
        lag_ci95: Its 95 % interval.
        seen_lag_sd: Its standard deviation at the measurements [s], where these are in step with commands; else null.
        unseen_lag_sd: What is more than that at the commands, where no measurement tells; likewise.
        delay: The dead time [s].
        delay_ci95: Its interval.
        shared_delay: Whether it is one for several axes.
        plant: The order of the plant.
        time_constant: τ of a first-order plant [s].
        time_constant_ci95: Its interval.
        natural_frequency: ω of a second-order plant [rad/s].
        natural_frequency_ci95: Its interval.
        damping: ζ.
        damping_ci95: Its interval.
        gain: K of slow motion.
        gain_ci95: Its interval; null where it was taken to be 1.
        gain_recovery: Time constant with which the gain recovers [s]; null: it does not.
        gain_recovery_ci95: Its interval.
        kind: Whether its positions are lengths [m] or angles [rad].
        play: Width of the backlash between drive and tool [m or rad]; null: none was found.
        play_ci95: Its interval.
        max_speed: The fastest that the axis itself goes [m/s or rad/s]; null: no limit was found.
        max_speed_ci95: Its interval.
        sag: How far a load holds the tool off, with intervals; null: no sag was found.
        drift: How much later it is at the end than at the beginning [s]; null: not known.
        drift_sd: Its standard deviation [s].
        drifts: Whether that is more than chance.
        wander: How far the lag wanders beside that, one standard deviation [s]; 0: not seen to.
        course: Of each part of the run its middle [s after the first command], by how much later it is there than on
            the whole [s], and the standard deviation of that [s].
        notes: What the motion was too poor for, a sentence each.
    """

    sensor: str
    lag: float = msgspec.field(name="lag_ms")
    lag_ci95: Interval = msgspec.field(name="lag_ms_ci95")
    seen_lag_sd: float | None = msgspec.field(name="seen_lag_sd_ms", default=None)
    unseen_lag_sd: float | None = msgspec.field(name="unseen_lag_sd_ms", default=None)
    delay: float = msgspec.field(name="delay_ms")
    delay_ci95: Interval = msgspec.field(name="delay_ms_ci95")
    shared_delay: bool
    plant: str
    time_constant: float | None = msgspec.field(name="time_constant_ms", default=None)
    time_constant_ci95: Interval | None = msgspec.field(name="time_constant_ms_ci95", default=None)
    natural_frequency: float | None = msgspec.field(name="natural_frequency_rad_s", default=None)
    natural_frequency_ci95: Interval | None = msgspec.field(name="natural_frequency_rad_s_ci95", default=None)
    damping: float | None = None
    damping_ci95: Interval | None = None
    gain: float
    gain_ci95: Interval | None = None
    gain_recovery: float | None = msgspec.field(name="gain_recovery_ms", default=None)
    gain_recovery_ci95: Interval | None = msgspec.field(name="gain_recovery_ms_ci95", default=None)
    kind: Kind = "length"
    play: float | None = msgspec.field(name="play_mm", default=None)
    play_ci95: Interval | None = msgspec.field(name="play_mm_ci95", default=None)
    max_speed: float | None = msgspec.field(name="max_speed_mm_s", default=None)
    max_speed_ci95: Interval | None = msgspec.field(name="max_speed_mm_s_ci95", default=None)
    sag: Sag | None = None
    drift: float | None = msgspec.field(name="drift_ms", default=None)
    drift_sd: float | None = msgspec.field(name="drift_sd_ms", default=None)
    drifts: bool = False
    wander: float = msgspec.field(name="wander_ms", default=0.0)
    course: list[PartLag] = []
    notes: list[str] = []


class PartLag(msgspec.Struct, frozen=True, kw_only=True):
    """A part of a run: its middle [s], how much later it is than the whole [s], and its standard deviation [s]."""

    time: float = msgspec.field(name="time_s")
    shift: float = msgspec.field(name="shift_ms")
    sd: float = msgspec.field(name="sd_ms")


class LatencyStep(msgspec.Struct, frozen=True, kw_only=True):
    """A latency that steps: when [s after the first command], from what and to what [s]."""

    time: float = msgspec.field(name="time_s")
    before: float = msgspec.field(name="before_ms")
    after: float = msgspec.field(name="after_ms")


class SensorLag(msgspec.Struct, frozen=True, kw_only=True):
    """How much older a sensor's measurements are when stamped than those of the sensor whose stamps are right.

    Attributes:
        latency: The latency [s]; where it steps, that of the longest part.
        latency_ci95: Its 95 % interval; where it steps, of all parts.
        latency_sd: Its standard deviation from row to row [s]; 0: none is seen.
        scale: How far it moves where that sensor moves by 1; ± 1 unless it surely differs.
        scale_ci95: The interval of what was fitted; null where axes do not agree.
        steps: Where the latency steps.
    """

    latency: float = msgspec.field(name="latency_ms")
    latency_ci95: Interval = msgspec.field(name="latency_ms_ci95")
    latency_sd: float = msgspec.field(name="latency_sd_ms", default=0.0)
    scale: float = 1.0
    scale_ci95: Interval | None = None
    steps: list[LatencyStep] = []


class LatencySummary(msgspec.Struct, frozen=True, kw_only=True):
    """What ``latency --json`` prints.

    Attributes:
        pumafuse: Version that made it.
        runs: Names of the runs.
        sensor: The sensor whose stamps are taken to be right.
        update_period: Between commands [s].
        axes: By axis.
        sensors: By sensor, those beside that one.
        clock_drift: By how much all axes together are later at the end, where they agree: a clock that drifts [s].
        clock_wander: How far all axes wander together: a clock that wanders [s].
        notes: Everything noticed, a sentence each.
    """

    pumafuse: str
    runs: list[str]
    sensor: str
    update_period: float = msgspec.field(name="update_period_ms")
    axes: dict[str, AxisLag]
    sensors: dict[str, SensorLag]
    clock_drift: float | None = msgspec.field(name="clock_drift_ms", default=None)
    clock_wander: float | None = msgspec.field(name="clock_wander_ms", default=None)
    notes: list[str]

    def __repr__(self) -> str:
        return f"LatencySummary({', '.join(self.runs)} by {self.sensor}: {', '.join(self.axes)})"


@dataclass(frozen=True, repr=False)
class Latency:
    """The result of :func:`latency`.

    Attributes:
        config: Arm, noise and sensors, ready for :func:`pumafuse.fuse` or :func:`pumafuse.tune`.
        details: What it is in numbers [SI].
        runs: The runs in the arm's axes; a reference is one of their sensors.
    """

    config: FusionConfig
    details: LatencySummary
    runs: Sequence[Run]

    def __repr__(self) -> str:
        lags = ", ".join(f"{axis} {lag.lag * MS:.4g} ms" for axis, lag in self.details.axes.items())
        return f"Latency({', '.join(self.details.runs)} by {self.details.sensor}: {lags})"

    @property
    def arm(self) -> ArmModel:
        """The arm with its intervals and where it is from, for ``arm.toml``."""
        arm: ArmModel = self.config.arm
        for axis, lag in self.details.axes.items():
            for name in ("time_constant", "natural_frequency", "damping"):
                if hasattr(arm.axes[axis].plant, name):
                    arm = changed(arm, ("axes", axis, "plant", f"{name}_ci95"), getattr(lag, f"{name}_ci95"))
            arm = changed(arm, ("axes", axis, "gain", "intercept_ci95"), lag.gain_ci95)
            for name in ("sag", "seen_lag_sd", "unseen_lag_sd"):
                arm = changed(arm, ("axes", axis, name), getattr(lag, name))
            for name in ("gain_recovery", *BENDS, "lag"):
                arm = changed(arm, ("axes", axis, f"{name}_ci95"), getattr(lag, f"{name}_ci95"))
            has_own_delay = arm.axes[axis].delay is not None
            arm = changed(arm, ("axes", axis, "delay_ci95") if has_own_delay else ("delay_ci95",), lag.delay_ci95)
        provenance = {"identified_on": self.details.runs, "sensor": self.details.sensor}
        return msgspec.structs.replace(arm, provenance=provenance)

    def to_json(self) -> str:
        """All of it as JSON, in the units of the names."""
        tree = toml.reported(self.details)
        tree["axes"] = {axis: toml.reported(lag, lag.kind) for axis, lag in self.details.axes.items()}
        return toml.json_text(tree) + "\n"


def latency(runs: Sequence[Run] | Run, *, sensor: str | None = None) -> Latency:
    """Tell how late each axis is behind its commands, and each sensor behind another, from recorded motion alone.

    Nothing has to be known beforehand: delay, order, plant and gain of each axis are found by maximum likelihood, from
    delays of 0 to 0.6 s and lags of 1 ms to 2 s. Intervals are quantiles of the posterior over all models.

    Args:
        runs: Recorded runs of one arm.
        sensor: The sensor whose stamps are right, ``reference`` for the runs' reference; None: the reference, or the
            sensor with the least noise.

    Warns:
        PumafuseWarning: For each note.

    Raises:
        PumafuseError: The runs tell nothing: no motion, too few measurements, a sensor that does not follow.
    """
    every = [in_axes(run, None)[0] for run in ([runs] if isinstance(runs, Run) else runs)]
    if not every:
        raise TuneError("no run to look at; give one at least")
    measured = [{REFERENCE: run.reference, **run.sensors} if run.reference else run.sensors for run in every]
    every = [replace(run, sensors=sources, reference=None) for run, sources in zip(every, measured, strict=True)]
    elsewhere = {name: own_frame.words for run in every for name, own_frame in own_frames(run).items()}
    every = [replace(run, sensors={k: v for k, v in run.sensors.items() if k not in elsewhere}) for run in every]
    turned = [
        f"sensor '{name}' {words}: `pumafuse register` finds it; it is not used" for name, words in elsewhere.items()
    ]
    if turned and not any(run.sensors for run in every):
        raise TuneError("; ".join(turned))
    surveys = [Survey(Path(run.name), run, relations(run)) for run in sorted(every, key=_motion, reverse=True)]
    guesses = [guess(survey) for survey in surveys]
    config = first_guess(guesses)
    trusted = _trusted(config, every, sensor)
    sooner = {axis: by for survey in surveys for axis, by in early(survey, trusted).items()}
    if sooner and not {axis for survey in surveys for name, axis in survey.relations if name == trusted} - set(sooner):
        raise TuneError(f"{every[0].name}: {too_early(trusted, max(sooner.values()))}")
    likelihood = Likelihood(every, _set_right_stamps(config, trusted), [trusted])
    moving = [axis for axis in excited_axes(likelihood, likelihood.config) if axis not in sooner]
    searches = dict(zip(moving, in_threads(lambda axis: _arm_search(likelihood, axis), moving), strict=True))
    lost = [axis for axis, search in searches.items() if search.plain is None]
    config, lags = _arm(likelihood.config, {axis: searches[axis] for axis in moving if axis not in lost}, trusted)
    if endless := [axis for axis, lag in lags.items() if lag.lag > LONGEST]:
        lost += endless
        config, lags = _arm(likelihood.config, {axis: searches[axis] for axis in moving if axis not in lost}, trusted)
    for axis, doubt in doubts({axis: searches[axis].plain for axis in lags}, config).items():
        lags[axis] = _doubted(lags[axis], doubt, doubt.sentence(config, axis))
        if doubt.refutes:
            config = set_plain_arm(config, axis, doubt.plain.arm)
    looked_at = [each for _, each in guesses] if len(every) == 1 else []
    pairs = {name: one_guess.pair for each in looked_at for name, one_guess in each.items() if one_guess.pair}
    best, sensors, said = _sensors(every, config, trusted, pairs)
    lags, clock = _set_courses(likelihood, config, lags, searches)
    still = [axis for axis in config.arm.axes if axis not in moving and axis not in sooner]
    notes = [*turned, *likelihood.notes, *said, *likelihood.overruns(config.arm)]
    notes += [f"{axis}: does not move, or {trusted} does not measure it" for axis in still]
    notes += lag_steps({axis: searches[axis].plain for axis in lags}, config)
    notes += [f"{axis}: {trusted} does not follow its commands: no lag is told" for axis in lost]
    notes += [f"{axis}: {too_early(trusted, by)}" for axis, by in sooner.items()]
    notes += [_SAMPLED.format(survey.run.name, step * MS) for survey in surveys if (step := interpolation(survey))]
    notes += [_AHEAD_OF.format(survey.run.name, -lag * MS) for survey in surveys if (lag := soonest(survey)) < -SOONER]
    summary = LatencySummary(
        pumafuse=version("pumafuse"),
        runs=[run.name for run in every],
        sensor=trusted,
        update_period=config.arm.update_period,
        axes=lags,
        sensors=sensors,
        clock_drift=clock[0],
        clock_wander=clock[1],
        notes=list(dict.fromkeys(notes)),
    )
    for note in summary.notes:
        warnings.warn(note, PumafuseWarning, stacklevel=2)
    return Latency(best, summary, every)


# ---- the first guess ------------------------------------------------------------------------------------------------


def first_guess(guesses: Sequence[tuple[ArmGuess, Mapping[str, SensorGuess]]]) -> FusionConfig:
    """A configuration by correlation: lags, noise and latencies of the runs, those with the most motion first.

    Raises:
        RunError: There are fewer than two commands.
    """
    arms, axes, sensors = list[ArmGuess](), dict[str, AxisGuess](), dict[str, SensorGuess]()
    for arm, sensor_guesses in guesses:
        arms.append(arm)
        axes = {**arm.axes, **axes}
        for name, sensor_guess in sensor_guesses.items():
            before = sensors.get(name, sensor_guess)
            sd, bias = {**sensor_guess.sd, **before.sd}, {**sensor_guess.bias, **before.bias}
            sensors[name] = replace(before, sd=sd, bias=bias)
    model = ArmModel(
        name="identified from motion",
        update_period=float(f"{arms[0].period:.4g}"),
        delay=rounded(arms[0].delay),
        axes={
            name: AxisModel(kind=axis.kind, plant=FirstOrder(time_constant=axis.time_constant))
            for name, axis in axes.items()
        },
    )
    return FusionConfig(
        arm=model,
        start=Start(offset_sd={name: axis.offset_sd for name, axis in axes.items()}),
        process={name: Process(input_noise=axis.input_noise, drift=axis.drift) for name, axis in axes.items()},
        sensors={name: _sensor(sensor) for name, sensor in sensors.items()},
    )


def _motion(run: Run) -> float:
    """How much a run moves: the lengths of its commanded paths, each in units of its range."""
    motion = 0.0
    for value in run.command.values.values():
        values = value[np.isfinite(value)]
        if len(values) > 1 and np.ptp(values) > 0.0:
            motion += float(np.abs(np.diff(values)).sum() / np.ptp(values))
    return motion


def _sensor(guess: SensorGuess) -> Sensor:
    bias: float | dict[str, float] = {axis: guess.bias.get(axis, 0.0) for axis in guess.sd} if guess.bias else 0.0
    gate = _GATE if guess.gate else 0.0  # without outliers only a poor model is rejected, and that pays
    return Sensor(sd=dict(guess.sd), latency=guess.latency, scale=guess.scale, bias_sd=bias, gate=gate)


def _trusted(config: FusionConfig, runs: Sequence[Run], asked: str | None) -> str:
    """The sensor whose stamps are right: as asked, the reference, or that with the least noise.

    Raises:
        UnknownNameError: The asked one is not there.
        TuneError: There is none.
    """
    if not config.sensors:
        raise TuneError("no sensor and no reference to compare the commands with; add one to run.toml")
    if asked is not None:
        if asked not in config.sensors:
            raise UnknownNameError("the runs", "sensor", asked, config.sensors)
        return asked
    if REFERENCE in config.sensors:
        return REFERENCE

    travel = dict.fromkeys(config.arm.axes, 0.0)
    for run in runs:
        for axis, value in run.command.values.items():
            travel[axis] = max(travel.get(axis, 0.0), float(np.ptp(value[np.isfinite(value)])))

    def rank(name: str) -> tuple[int, float]:
        sd = config.sensors[name].sd
        shares = [sd_here / max(travel[axis], 1e-12) for axis, sd_here in sd.items()] if isinstance(sd, dict) else [sd]
        return -len(shares), float(np.median(shares))

    return min(config.sensors, key=rank)


def _set_right_stamps(config: FusionConfig, trusted: str) -> FusionConfig:
    """The configuration with the trusted sensor's stamps right, and the others' latencies as much shorter."""
    late = config.sensors[trusted].latency
    for name, sensor in config.sensors.items():
        config = changed(config, ("sensors", name, "latency"), sensor.latency - late)
    return config


# ---- axes -----------------------------------------------------------------------------------------------------------


def _arm_search(likelihood: Likelihood, axis: str) -> ArmSearch:
    """The arm of one axis."""
    config, names = likelihood.config, likelihood.sensors[axis]
    least = [likelihood.resolution.get((name, axis), 0.0) for name in names]
    measured, freedom = likelihood.measured(axis, config), Freedom(Arm(0.0, 0.1))
    if measured.count < FEW:
        freedom = freedom._replace(orders=(1,), gains=("given",))
    return ArmSearch(measured, freedom, least)


def _arm(
    config: FusionConfig, searches: Mapping[str, ArmSearch], trusted: str
) -> tuple[FusionConfig, dict[str, AxisLag]]:
    """The arm of all axes with what it leaves, and the lag of each with its intervals."""
    (chosen, delay), lags = chosen_arms(searches, searches), dict[str, AxisLag]()
    for axis, choice in chosen.items():
        arm = Arm(*(rounded(number) for number in choice.arm))
        config = set_noise(set_arm(config, axis, arm), axis, searches[axis].noise, [trusted])
        lags[axis] = _axis_lag(searches[axis], choice._replace(arm=arm), trusted, config.arm.axes[axis].kind)
    shares = [axis for axis, choice in chosen.items() if choice.shares]
    return set_shared_delay(config, shares, rounded(delay)) if delay is not None else config, lags


def _notes(lag: AxisLag, gains: tuple[float, float]) -> list[str]:
    """What the motion was too poor for, and what to record instead; beside the least and the largest gain."""
    notes: list[str] = []
    width = lag.lag_ci95[1] - lag.lag_ci95[0]
    if width > max(_WIDE * abs(lag.lag), _WIDE_LAG):
        notes.append(
            "the motion is too poor for the lag: it is known to"
            f" ± {0.5 * width * MS:.0f} ms; record faster or longer motion"
        )
    elif lag.delay_ci95[1] - lag.delay_ci95[0] > max(_WIDE * lag.lag, 2.0 * width):
        notes.append(
            "the lag is known, its parts are not: dead time and plant make up for each other in motion this slow;"
            " record steps, or reversals within the lag, to tell them apart"
        )
    if lag.gain_ci95 is not None and lag.gain_ci95[1] - lag.gain_ci95[0] > _WIDE_GAIN:
        notes.append("the motion is too poor for the gain; record motion over more of the range")
    if lag.gain in gains:
        notes.append(
            f"the gain lies at the end of what is believed, {lag.gain:g}: the axis moves otherwise than these models"
            " do, and its lag and gain mean little"
        )
    return notes


def _axis_lag(search: ArmSearch, chosen: Chosen, trusted: str, kind: Kind) -> AxisLag:
    arm, model, mixture, shared, _ = chosen

    def interval(quantity: Quantity, value: float, margin: float = _MARGIN) -> Interval:
        """The interval by the models like the chosen one, also of what they have as a logarithm."""
        log = quantity not in ("lag", "delay", "gain")

        def alike(other: Model) -> bool:
            if quantity in ("gain", "gain_recovery"):
                return other.gain == model.gain
            return quantity in ("lag", "delay", *BENDS) or other.order == model.order

        middle = math.log(value) if log else value
        low, high = mixture.quantiles(quantity, alike)
        centre, half = 0.5 * (low + high), 0.5 * margin * (high - low)
        if quantity in ("lag", "delay"):
            half = max(half, _FINEST)
        low, high = centre - half, centre + half
        if not low < middle < high:  # other models say otherwise: both count, and no interval ends at its estimate
            low, high = min(low, middle - half), max(high, middle + half)
        if quantity == "delay":
            low = max(low, 0.0)
        return (math.exp(low), math.exp(high) if high < _HIGHEST else math.inf) if log else (low, high)

    plant, values = arm.model.plant, dict[str, Any]()
    for name in ("time_constant", "natural_frequency", "damping"):
        if (value := getattr(plant, name, None)) is not None:
            values |= {name: value, f"{name}_ci95": interval(name, value)}
    for bend in search.freedom.bends:
        values |= {bend: getattr(arm, bend), f"{bend}_ci95": interval(bend, getattr(arm, bend))}
    if arm.recovery:
        values |= {"gain_recovery": arm.recovery, "gain_recovery_ci95": interval("gain_recovery", arm.recovery)}
    if search.bent is not None and (sag := arm.model.sag) is not None:
        sizes = {name: (getattr(sag, name), _MARGIN * half) for name, half in search.bent.sag_half.items()}
        ends = {f"{name}_ci95": (size - half, size + half) for name, (size, half) in sizes.items()}
        values["sag"] = msgspec.structs.replace(sag, **ends)
    sds = search.lag_sds(arm, mixture)
    lag = AxisLag(
        sensor=trusted,
        lag=arm.total,
        lag_ci95=interval("lag", arm.total, search.lag_scatter(model, arm)),
        seen_lag_sd=sds.seen if sds else None,
        unseen_lag_sd=sds.unseen if sds else None,
        delay=arm.delay,
        delay_ci95=interval("delay", arm.delay),
        shared_delay=shared,
        plant="first-order" if model.order == 1 else "second-order",
        gain=arm.gain,
        gain_ci95=None if model.gain == "given" else interval("gain", arm.gain),
        kind=kind,
        **values,
    )
    notes = list[str]()
    if search.bent is not None:
        bends = {name: values[name] for name in ("play_ci95", "max_speed_ci95", "sag") if name in values}
        notes.append("; ".join(search.bent.sentences(msgspec.structs.replace(arm.model, kind=kind, **bends))))
    return msgspec.structs.replace(lag, notes=[*notes, *_notes(lag, search.limits.bounds["gain"])])


def _doubted(lag: AxisLag, doubt: Doubt, sentence: str) -> AxisLag:
    """The lag of an axis with an interval that covers what least squares says, or that of least squares instead."""
    arm, (low, high) = doubt.plain.arm, doubt.lag_ci95
    if not doubt.refutes:
        both = min(low, lag.lag_ci95[0]), max(high, lag.lag_ci95[1])
        return msgspec.structs.replace(lag, lag_ci95=both, notes=[*filter(None, [sentence]), *lag.notes])
    return AxisLag(  # which does not know its parts
        sensor=lag.sensor,
        lag=arm.total,
        lag_ci95=(low, high),
        delay=arm.delay,
        delay_ci95=(0.0, high),
        shared_delay=False,
        plant="first-order",
        time_constant=arm.lag,
        time_constant_ci95=(0.0, high),
        gain=arm.gain,
        kind=lag.kind,
        notes=[sentence],
    )


# ---- sensors --------------------------------------------------------------------------------------------------------


def _sensors(
    runs: Sequence[Run], config: FusionConfig, trusted: str, pairs: Mapping[str, Pair]
) -> tuple[FusionConfig, dict[str, SensorLag], list[str]]:
    """The configuration with noise, latency and scale of the other sensors; these with intervals; what is to be said.

    No arm is needed for it. ``pairs``: what was found for the first guess, beside some sensor.
    """
    lags, notes = dict[str, SensorLag](), list[str]()
    for name, sensor in config.sensors.items():
        if name == trusted:
            continue
        beside = pairs.get(name)
        alignment = beside.alignment if beside and beside.other == trusted else aligned(runs, trusted, name)
        if alignment is None:
            notes.append(_APART.format(name, trusted))
            continue
        lags[name] = msgspec.convert(alignment, SensorLag, from_attributes=True)
        notes += alignment.doubts(name, trusted)
        sd = sensor.sd if isinstance(sensor.sd, dict) else {}
        better = msgspec.structs.replace(
            sensor,
            sd={**sd, **{axis: max(rounded(value), SD_BOUNDS[0]) for axis, value in alignment.sd.items()}},
            latency=rounded(alignment.latency),
            latency_sd=rounded(alignment.latency_sd),
            scale=rounded(alignment.scale) * config.sensors[trusted].scale,
        )
        config = changed(config, ("sensors", name), better)
    return config, lags, notes


# ---- the lag over the run -------------------------------------------------------------------------------------------


class _Course(NamedTuple):
    """How much later an axis is in each part of a run: middles [s], shifts [s], their information [1/s²]."""

    time: FloatArray
    shift: FloatArray
    information: FloatArray

    @property
    def variance(self) -> FloatArray:
        """Variances of the shifts [s²], (n,): what all have in common was fitted away."""
        inverse = np.asarray(np.linalg.pinv(self.information, 1e-6, hermitian=True), dtype=np.float64)
        return np.diag(inverse)


class _Trend(NamedTuple):
    """A drift over the run and its standard deviation [s], whether it is more than chance, and a wandering [s]."""

    drift: float
    drift_sd: float
    drifts: bool
    wander: float  # 0 where it is no more than chance


def _set_courses(
    likelihood: Likelihood, config: FusionConfig, lags: Mapping[str, AxisLag], searches: Mapping[str, ArmSearch]
) -> tuple[dict[str, AxisLag], tuple[float | None, float | None]]:
    """The lags with their courses over the longest run, and drift and wandering of a clock that all axes share."""
    courses: dict[str, _Course] = {}
    for axis in lags:
        arm, noise = Arm.of(config.arm.axes[axis], config.arm.delay_of(axis)), searches[axis].noise
        fitted = ["delay", "lag", *(name for name, none in Arm._field_defaults.items() if getattr(arm, name) != none)]
        shifts = likelihood.measured(axis, config).gated(arm, noise, GATE).shifts(arm, fitted, noise, _PARTS)
        if shifts is not None and np.trace(shifts[2]) > 0.0:
            courses[axis] = _Course(*shifts)
    with_courses = dict(lags)
    for axis, course in courses.items():
        trend, sd = _trend(course), np.sqrt(course.variance)
        parts = zip(course.time.tolist(), course.shift.tolist(), sd.tolist(), strict=True)
        with_courses[axis] = msgspec.structs.replace(
            with_courses[axis],
            **trend._asdict(),
            course=[PartLag(time=time, shift=shift, sd=sd_here) for time, shift, sd_here in parts],
        )
    return with_courses, _clock(list(courses.values()))


def _trend(course: _Course) -> _Trend:
    """A straight line through the shifts by least squares; its deviation is as large as the rest makes it."""
    from scipy.special import chdtrc

    G, span = course.information, len(course.time) * float(course.time[1] - course.time[0])
    x = (course.time - course.time.mean()) / span
    power = float(x @ G @ x)
    drift = float(x @ G @ course.shift) / power
    left = course.shift - drift * x
    free = len(left) - 2
    chi2 = float(left @ G @ left)
    variance = course.variance
    weight = 1.0 / np.maximum(variance, 1e-18)
    wander = math.sqrt(max(float(weight @ (left**2 - variance) / weight.sum()), 0.0))
    sd = math.sqrt(max(1.0, chi2 / free) / power)
    wanders = wander > _SMALLEST and float(chdtrc(free, chi2)) < _WANDERS
    return _Trend(drift, sd, abs(drift) > max(_DRIFTS * sd, _SMALLEST), wander if wanders else 0.0)


def _clock(courses: Sequence[_Course]) -> tuple[float | None, float | None]:
    """How much all axes drift and wander together; None where they do not, or each for itself."""
    if len(courses) < 2:
        return None, None
    information: FloatArray = np.sum([course.information for course in courses], axis=0)
    moved: FloatArray = np.sum([course.information @ course.shift for course in courses], axis=0)
    shift = np.asarray(np.linalg.pinv(information, 1e-6, hermitian=True) @ moved, dtype=np.float64)
    every = sum(float(course.shift @ course.information @ course.shift) for course in courses)
    if float(shift @ information @ shift) < 0.5 * every:
        return None, None
    trend = _trend(_Course(courses[0].time, shift, information))
    return trend.drift if trend.drifts else None, trend.wander or None
