"""Verification of a model on a run that it was not made from: the paper's Table III and Figs. 8 and 9.

The model is driven by the run's commands alone and compared with the measurements, both without their means, as in the
paper. Beside it stands the best in class: the best linear model of the same order, refitted on this very run. Its
error is noise, friction and everything else that is not linear.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import msgspec
import numpy as np

from .. import units
from ..arrays import FloatArray
from ..errors import ConfigError, RunError
from ..filter.outcome import Outcome
from ..fusion.config import FusionConfig, Sensor
from ..fusion.overruns import overrun_notes, overruns
from ..fusion.segments import build_segment
from ..logs.axes import in_axes
from ..logs.clock import segments
from ..logs.run import REFERENCE, Run
from ..model.arm import ArmModel, commanded_speed
from ..model.plants import PLANTS
from ..toml import Interval
from ..tuning.arms import Arm, Limits, Measured, Recording
from ..tuning.plain import COMMANDS, LAGS, ROWS, delays
from ..units import Kind

RECOVERY = 0.1  # s, of an arm that states none: the presets' compromise
_FEWEST = 20  # measurements
_MOST_LEVELS = 8  # of a run whose start level is searched among them
_AS_GOOD, _FAR = 1.2, 3.0  # times the error of the best in class
_FARTHEST, _SLOWEST = 1e6, 1e4  # m or rad, from the start level; s
_SPIKE = 8.0  # robust standard deviations
_HOLDS = 50.0  # % fit
_BETTER = 0.8  # share of the error below which a recovery is recommended

_DAMPED = 1.0  # ζ of the grid, of second order
_STARTS = 3  # cells of it to search from
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


class AxisVerification(msgspec.Struct, frozen=True, kw_only=True):
    """One axis of a run against one source.

    Attributes:
        run: Its name.
        axis: The axis.
        kind: Whether it is a length or an angle.
        source: The sensor, or ``reference``.
        lag: The model's, behind the held command at constant velocity, at the commands' mean speed [s].
        measurements: How many were compared.
        amplitude: From the lowest to the highest command [m or rad].
        start: Level at which the arm was taken to rest before the first command [m or rad].
        start_from: Where that level comes from, in words.
        model: The model as it is.
        without_recovery: With a gain that never recovers.
        with_recovery: With a gain that recovers.
        recovery: Its time constant [s].
        best_in_class: The best linear model of this order on this run.
        outlying: How many measurements were left out because they jump away from their neighbours.
        commands: How many rows of the commands were ``used``, and of the others how many were left out for what.
        rows: Likewise of the source.
        holds: Whether the model follows the motion at all.
        verdict: In words.
        notes: What was wrong with the run, a sentence each; with the first axis and source of each part of it.
    """

    run: str
    axis: str
    kind: Kind
    source: str
    lag: float = msgspec.field(name="lag_ms")
    measurements: int
    amplitude: float = msgspec.field(name="amplitude_mm")
    start: float = msgspec.field(name="start_mm")
    start_from: str
    model: ModelFit
    without_recovery: ModelFit
    with_recovery: ModelFit
    recovery: float = msgspec.field(name="recovery_ms")
    best_in_class: BestInClass
    outlying: int
    commands: dict[str, int]
    rows: dict[str, int]
    holds: bool
    verdict: str
    notes: list[str]

    def __repr__(self) -> str:
        return f"AxisVerification({self.run!r}, {self.axis} by {self.source}: {self.verdict})"


@dataclass(frozen=True)
class Trace:
    """Measured and modelled position, without means, for a figure. Arrays (n,).

    Attributes:
        time: [s] since the first command.
        measured: [m or rad].
        modelled: [m or rad].
    """

    time: FloatArray
    measured: FloatArray
    modelled: FloatArray


def verify(
    run: Run, arm: ArmModel, *, sensors: Iterable[str] | None = None, start: Mapping[str, float] | None = None
) -> list[tuple[AxisVerification, Trace]]:
    """Simulate a run's commands and compare with the measurements.

    Args:
        run: With measurements or a reference whose stamps are right.
        arm: The model.
        sensors: Which sensors, or ``reference``; None: the reference where there is one, else every sensor.
        start: Level [m or rad] before the first command by axis; where it is not known from here or the run, it is
            chosen among the run's levels by RMS.

    Returns:
        The verification of each axis and source, and its traces.

    Raises:
        PumafuseError: The run has no such sensor, commands an axis that the arm has not, or nothing to compare with.
    """
    names = (sensors,) if isinstance(sensors, str) else sensors
    chosen = _select_sources(run, None if names is None else tuple(names))
    config = FusionConfig(arm=arm, sensors={name: Sensor(sd=1e-3) for name in chosen.sensors})
    parts, jumps = segments(in_axes(chosen.delayed(arm), None)[0])
    results: list[tuple[AxisVerification, Trace]] = []
    for number, part in enumerate(parts, 1):
        name = run.name if len(parts) == 1 else f"{run.name}, part {number}"
        part = replace(part, name=name, start={**part.start, **(start or {})})
        results.extend(_part(part, config, jumps if number == 1 else ()))
    if not results:
        raise RunError(
            f"run '{run.name}': no source has {_FEWEST} measurements of a commanded axis after the"
            " first command; record for longer, both by one clock"
        )
    return results


def _part(run: Run, config: FusionConfig, jumps: Sequence[str]) -> list[tuple[AxisVerification, Trace]]:
    """Every axis and source of one segment of a run."""
    segment, arm = build_segment(run, config), config.arm
    rows, part = segment.measurement_rows, list[tuple[AxisVerification, Trace]]()
    for number, axis in enumerate(segment.axes):
        stamp, command = segment.commands_of(axis)
        first = segment.start[axis]
        for index, source in enumerate(segment.sensors):
            here = np.flatnonzero((rows.source == index) & (rows.codes[:, number] == Outcome.FUSED))
            if len(here) < _FEWEST or not np.ptp(command) > 0.0:
                continue
            time, value = rows.time[here], rows.value[here, number] - first
            recording = Recording(stamp, command, first, time, value, np.zeros_like(time), np.ones(len(time)))
            measured = Measured([recording], arm.update_period, [source], arm.axes[axis])
            counts = {"used" if word == Outcome.FUSED.word else word: n for word, n in segment.counts[source].items()}
            notes = [*jumps, *segment.notes, *overrun_notes([overruns(segment, arm)], arm, segment.origin)]
            counted = {"commands": dict(segment.command_counts), "rows": counts}
            part.append(_verify_axis(measured, run, axis, arm, counted, [] if part else notes))
    return part


def _select_sources(run: Run, sensors: Sequence[str] | None) -> Run:
    """The run with only the sources that it is verified against, as sensors."""
    sources = dict(run.sensors)
    if run.reference is not None:
        sources[REFERENCE] = run.reference
    if sensors is None:
        sensors = (REFERENCE,) if run.reference is not None else tuple(sources)
    if unknown := [name for name in sensors if name not in sources]:
        raise RunError(f"run '{run.name}' has no sensor '{unknown[0]}'; it has {', '.join(sources) or 'none'}")
    return replace(run, sensors={name: sources[name] for name in sensors}, reference=None)


def _verify_axis(
    measured: Measured, run: Run, axis: str, arm: ArmModel, counted: Mapping[str, dict[str, int]], notes: list[str]
) -> tuple[AxisVerification, Trace]:
    """One axis of a run by one source, of which the rows are ``counted``."""
    model, configured = arm.axes[axis], Arm.of(arm.axes[axis], arm.delay_of(axis))
    recovery = configured.recovery or RECOVERY
    farthest = abs(measured.recordings[0].start) + np.abs(measured.responses(configured)[0]).max()
    if not (farthest <= _FARTHEST and configured.lag <= _SLOWEST):  # also where it is not a number
        raise ConfigError(f"axis '{axis}': a start level, gain or plant of no size that an arm has; check their units")
    measured, start_from = _set_start(measured, configured, axis in run.start)
    count = len(measured.recordings[0].time)
    measured = _drop_spikes(measured, configured)
    (recording,), (modelled,) = measured.recordings, measured.responses(configured)
    as_it_is, recovering = model_fit(measured, configured), model_fit(measured, configured._replace(recovery=recovery))
    best = best_in_class(measured, configured)
    lag = model.lag(configured.delay, float(speeds(measured).mean()))
    trace = Trace(
        units.seconds(recording.time, int(recording.stamp[0])),
        recording.value - recording.value.mean(),
        modelled - modelled.mean(),
    )
    verification = AxisVerification(
        run=run.name,
        axis=axis,
        kind=model.kind,
        source=measured.sensors[0],
        lag=lag,
        measurements=len(recording.time),
        amplitude=float(np.ptp(recording.command)),
        start=recording.start,
        start_from=start_from,
        model=as_it_is,
        without_recovery=model_fit(measured, configured._replace(recovery=0.0)),
        with_recovery=recovering,
        recovery=recovery,
        best_in_class=best,
        outlying=count - len(recording.time),
        **counted,
        holds=as_it_is.fit >= _HOLDS,
        verdict=_verdict(as_it_is, lag, best) + _recovers(as_it_is, recovering, recovery, model.kind),
        notes=notes,
    )
    return verification, trace


def _set_start(measured: Measured, arm: Arm, is_given: bool) -> tuple[Measured, str]:
    """The run from its level before the first command, and where that comes from."""
    (recording,) = measured.recordings
    levels = np.unique(recording.command)
    if is_given or len(levels) > _MOST_LEVELS:
        return measured, "given" if is_given else "the first command"
    tried = [
        measured.of([recording._replace(start=level, value=recording.value + recording.start - level)])
        for level in levels.tolist()
    ]
    best = min(tried, key=lambda other: float(np.std(other.left(arm))))
    return best, f"chosen among the run's {len(levels)} levels by RMS"


def _drop_spikes(measured: Measured, arm: Arm) -> Measured:
    """The run without measurements that jump away from their neighbours, whatever the model.

    A model that is wrong for a while must not be spared: only eight robust standard deviations from the running
    median of five count.
    """
    from scipy.ndimage import median_filter
    from scipy.stats import median_abs_deviation

    (residual,) = measured.residuals(arm)
    jump = residual - median_filter(residual, size=5, mode="nearest")
    kept = np.abs(jump) <= _SPIKE * max(float(median_abs_deviation(residual, scale="normal")), 1e-9)
    return measured.of([measured.recordings[0].of(kept)])


def _verdict(model: ModelFit, lag: float, best: BestInClass) -> str:
    """The model's error beside that of the best of its order, and where the two differ; lag [s]."""
    if max(best.fit.fit, model.fit) < _HOLDS:
        return "no linear model of this order fits: look at the log"
    ratio = model.rms / best.fit.rms if best.fit.rms > 0.0 else 1.0 if model.rms == 0.0 else np.inf
    if ratio < _AS_GOOD:
        return "as good as any model of its order"
    later = best.lag - lag
    difference = f"here the arm answers {abs(later) * units.MS:.1f} ms {'later' if later > 0.0 else 'sooner'}"
    holds = "does not hold" if model.fit < _HOLDS else "follows the motion" if ratio > _FAR else "holds"
    return (
        f"{holds}, with {ratio:.1f} times the error of the best model of its order: {difference}, with gain"
        f" {best.gain:.2f}"
    )


def _recovers(model: ModelFit, recovering: ModelFit, recovery: float, kind: Kind) -> str:
    if recovering.rms > _BETTER * model.rms:
        return ""
    left = f"{recovering.rms * units.SCREEN[kind].scale:.3g} {units.SCREEN[kind].unit}"
    return f"; with gain_recovery_ms = {recovery * units.MS:g} {left} are left"


def speeds(measured: Measured) -> FloatArray:
    """Speeds of the commands of a run that move [m/s or rad/s]."""
    steps = np.diff(measured.recordings[0].command)
    return commanded_speed(steps[steps != 0.0], measured.period)


def model_fit(measured: Measured, arm: Arm) -> ModelFit:
    """How well an arm fits a run."""
    (recording,) = measured.recordings
    rms, signal = float(np.std(measured.left(arm))), float(np.std(recording.value))
    return ModelFit(
        rms=rms,
        percent=100.0 * rms / float(np.ptp(recording.command)),
        fit=100.0 * (1.0 - rms / signal) if signal > 0.0 else -np.inf,
    )


def best_in_class(measured: Measured, configured: Arm) -> BestInClass:
    """The best gain, delay and plant of the model's order on one recording by one source.

    The order and recovery of the arm's ``configured`` model stay; its numbers are one start of the search.
    """
    moving = speeds(measured)
    names = ["delay", "lag", *(["damping"] if configured.damping else []), "gain"]
    if np.ptp(moving) > 1e-6 * moving.max():
        names.append("slope")
    starts = _on_grid(measured, configured)
    noise = measured.white(starts[0])
    fits = [measured.fitted(arm, names, noise, _ANY) for arm in (configured, *starts)]
    near = max(fits, key=lambda fit: fit.log_posterior).arm
    noise = measured.white(near)  # beside the noise of a poor start the last steps seemed to gain nothing
    best, speed = measured.fitted(near, names, noise, _ANY).arm, float(moving.mean())
    lag = best.model.lag(best.delay, speed)
    half = measured.half_width(best, names, noise, _ANY, lambda arm: arm.model.lag(arm.delay, speed))
    return BestInClass(
        fit=model_fit(measured, best),
        lag=lag,
        lag_ci95=(lag - half, lag + half),
        delay=best.delay,
        gain=best.slope * speed + best.gain,
        plant=best.model.plant,
    )


def _on_grid(measured: Measured, arm: Arm) -> list[Arm]:
    """The best of a grid over dead times and plants, each with its best gain that is the same at every speed."""
    part, alike = measured.excerpt(COMMANDS, ROWS), arm._replace(damping=_DAMPED if arm.damping else 0.0, slope=0.0)
    arms = [alike._replace(delay=delay, lag=lag) for delay, lag in product(delays(part).tolist(), LAGS.tolist())]
    return part.likeliest(arms, part.white(arm), _ANY, _STARTS)
