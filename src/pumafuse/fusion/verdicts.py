"""What a sensor's consistency says, in words: the verdict, the likely causes, the keys to change."""

from __future__ import annotations

import math

import numpy as np

from ..filter.outcome import Outcome
from ..units import MS, SCREEN, Kind, of_kind
from .causes import Cause, Suspect
from .consistency import MANY_REJECTED, Consistency, Finding
from .estimates import Estimates

_WIDEST = 1e6  # largest ratio of prior to noise at which double precision keeps the error bars
_SURELY = 40.0  # log-likelihood that a cause gains: no chance; a real arm does not move by one noise all the time
_DETAIL = 1.2, 0.2  # factor on NIS, and correlation, within which it is a detail that a model of an arm lacks
_FAR = 6.0  # standard deviations by which more are rejected than is many
SHOWS = {  # what a sensor with a fault of the log shows
    "turns": "an angle that begins anew after each turn",
    "unit": "motion of another size",
    "columns": "exchanged columns",
    "sign": "motion against the commands",
    "clock": "another clock",
    "set": "a clock that was set",
    "frame": "a frame that is turned",
    "nothing": "a motion that follows nothing",
    "motion": "motion while the commands rest",
    "zero": "another zero",
}
_TOO_SMALL = "rejected: {sd}, latency_ms or the process noise too small"


def sensor_problems(est: Estimates) -> list[str]:
    """Notes on sensors with a fault, a sentence each: re-acquired gates, mostly rejected rows."""
    sentences, measured = list[str](), est.measurements
    alone = np.count_nonzero(np.bincount(measured.sensor)) < 2
    for number, name in enumerate(measured.sensors):
        rows = np.flatnonzero(measured.sensor == number)
        if not len(rows):
            continue
        outcome, axes = measured.outcome[rows], np.flatnonzero(np.bincount(measured.axis[rows])).tolist()
        rejected = np.count_nonzero(outcome == int(Outcome.REJECTED)) / len(rows)
        reacquired = len(set(measured.time[rows[outcome == int(Outcome.REACQUIRED)]].tolist()))
        kinds: dict[Kind, None] = {est.config.arm.axes[measured.axes[axis]].kind: None for axis in axes}
        sd, bias_sd, offset_sd = (
            "/".join(of_kind(key, kind) for kind in kinds) for key in ("sd_mm", "bias_sd_mm", "offset_sd_mm")
        )
        if (width := _width_of_prior(est, name)) > _WIDEST:
            sentences.append(
                f"{name}: its prior ({offset_sd}, {bias_sd}) is {width:.1e} times its noise: more than double precision"
                " resolves; use a narrower prior"
            )
        if reacquired:
            times = "once" if reacquired == 1 else f"{reacquired} times"
            of_all = f"the others or the model; if it is off by a constant, give it {bias_sd}"
            of_one = f"the model; {sd}, latency_ms or the process noise may be wrong"
            sentences.append(f"{name}: its gate reacquired {times}: it contradicts {of_one if alone else of_all}")
        if rejected > MANY_REJECTED:
            sentences.append(f"{name}: {rejected:.0%} of its components were {_TOO_SMALL.format(sd=sd)}")
    return sentences


def _width_of_prior(est: Estimates, name: str) -> float:
    """How many times the prior is as wide as a sensor's noise: beyond 1e6 double precision blurs the error bars."""
    sensor, start = est.config.sensors.get(name), est.config.start
    if sensor is None:
        return 0.0
    widths = [
        max(start.offset_sd_of(axis), sensor.bias_sd_of(axis)) / sd
        for axis in est.axes
        if (sd := sensor.sd_of(axis)) is not None
    ]
    return max(widths, default=0.0)


def sentence(consistency: Consistency) -> str:
    """The verdict on a sensor's components on an axis, in words."""
    if consistency.finding is Finding.FEW:
        return f"too few measurements ({consistency.count}) to tell"
    low, high = consistency.nis_band
    digits = next(
        n for n in range(2, 17) if _beside([consistency.nis, low, high]) == _beside([consistency.nis, low, high], n)
    )
    nis = f"NIS {consistency.nis:.{digits}f}, expected {low:.{digits}f} to {high:.{digits}f}"
    sd, lag = of_kind("sd_mm", consistency.kind), consistency.strongest_lag if len(consistency.correlation) else 0
    causes = ", or ".join(in_words(cause, consistency) for cause in consistency.causes)
    match consistency.finding:
        case Finding.REJECTED:
            return f"{nis}, but {consistency.rejected:.0%} were {_TOO_SMALL.format(sd=sd)}"
        case Finding.FAULTY:
            return f"{nis}: it shows {SHOWS[consistency.fault]}, see the warning"
        case Finding.NOT_WHITE:
            white = f"consistent in size, but not white (lag {lag}: {consistency.correlation[lag - 1]:+.2f})"
            return f"{nis}: {white}" + (f": {causes}" if causes else "")
        case Finding.AT_BOUND:
            return f"{nis}, but {sd} is at a bound of what can be fitted: error bars need not hold; configure it"
        case Finding.UNTESTED:
            return f"{nis}: untested"
        case Finding.CONSISTENT:
            return f"{nis}: consistent"
        case _:
            return f"{nis}: {causes or 'no one cause stands out'}"


def likeliest(consistency: Consistency) -> tuple[Cause | Finding, str, float] | None:
    """What makes innovations other than expected, surely and by so much that it matters; None where nothing does.

    A cause, whose it is ("" of the arm), and the log-likelihood that it gains; or that so many are rejected.
    """
    fused = consistency.count
    if consistency.finding is Finding.REJECTED:
        decided = fused / (1.0 - consistency.rejected)
        usual = MANY_REJECTED * decided
        surely = decided - fused > usual + _FAR * math.sqrt(usual)
        return (Finding.REJECTED, consistency.sensor, decided - fused) if surely else None
    (factor, correlation), nis = _DETAIL, consistency.nis
    if 1.0 / factor < nis < factor and np.abs(consistency.correlation).max(initial=0.0) < correlation:
        return None
    for cause, sensor, size, gain in consistency.causes[:1]:
        is_guess = cause is Cause.PROCESS and size < 1.0  # process noise that is too large: bars are wide, and hold
        return None if gain < _SURELY or is_guess else (cause, sensor, gain)
    return None


def in_words(suspect: Suspect, consistency: Consistency) -> str:
    """A cause as a clause."""
    sd, drift, bias = (of_kind(key, consistency.kind) for key in ("sd_mm", "bias_drift_sd_mm", "bias_sd_mm"))
    maneuvers = of_kind("maneuver_drift_mm_rts_per_m_s", consistency.kind)
    of_sensor = f" of {suspect.sensor}" if suspect.sensor not in ("", consistency.sensor) else ""
    size, small, screen = abs(suspect.size), "small" if suspect.size > 0.0 else "large", SCREEN[consistency.kind]
    match suspect.cause:
        case Cause.NOISE:
            return f"{sd}{of_sensor} is {_factor(suspect.size)}"
        case Cause.PROCESS:
            return f"the process noise is {_factor(suspect.size)}"
        case Cause.MANEUVERS:
            return f"the arm strays more where its speed changes ({maneuvers})"
        case Cause.CORRELATED:
            return f"the noise{of_sensor} is correlated, as of filtered or repeated values ({drift}, bias_time_s)"
        case Cause.OUTLIERS:
            larger = f"a few innovations{of_sensor} are far larger than the others"
            return f"{larger}: outliers of the sensor, or jerks of the arm"
        case Cause.JITTER:
            by = f" by {size * MS:.2g} ms" if 0.0 < size < math.inf else ""
            return f"the latency{of_sensor} scatters{by} from row to row (latency_sd_ms)"
        case Cause.LATENCY:
            return f"latency_ms{of_sensor} is {size * MS:.3g} ms too {small}"
        case Cause.LAG | Cause.PLANT:
            whose, keys = ("the", "latency_ms, ") if suspect.sensor else ("the arm's", "")
            return f"{whose} lag is {size * MS:.3g} ms too {small} ({keys}delay_ms or plant)"
        case Cause.DYNAMICS:
            return "the error follows the acceleration: delay_ms against the plant, or a sensor that smooths its values"
        case Cause.SCALE:
            return f"scale{of_sensor} is {size:.2g} of itself too {small}"
        case Cause.POSITION:
            share = f" by {suspect.size:+.1%} of it" if size else ""
            scale = "scale, " if suspect.sensor else ""
            return f"the error follows the position{share}: {scale}gain or a sag"
        case Cause.BIAS:
            return f"{suspect.sensor} is off by a constant of {size * screen.scale:.2g} {screen.unit} ({bias})"
        case Cause.PLAY:
            return f"the error turns with the direction: a play of about {size * screen.scale:.2g} {screen.unit}"
        case Cause.LIMIT:
            return "the arm falls behind where it is fastest: a limit of its speed"
        case Cause.FASTEST:
            return f"{of_kind('max_speed_mm_s', consistency.kind)} is {size:.2g} of itself too {small}"


def _factor(size: float) -> str:
    """How far a noise is off that is to be multiplied by ``size``, in words."""
    small, times = ("small", size) if size > 1.0 else ("large", 1.0 / size if size else math.inf)
    return f"too {small}" + ("" if math.isinf(times) else f" by a factor of {times:.2g}")


def _beside(numbers: list[float], digits: int = 16) -> tuple[bool, bool]:
    """Whether a number, as printed, is below a band and whether it is above."""
    value, low, high = (round(number, digits) for number in numbers)
    return value < low, value > high
