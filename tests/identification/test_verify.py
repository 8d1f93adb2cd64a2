"""Verification against runs of a known arm: superposed step responses plus noise, nothing of the package's own.

Where the model is true, the error is the noise itself, to the last digits; where it is not, the best in class is
the true one, found from the run alone.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.signal import lfilter

import pumafuse as pf
from pumafuse.arrays import FloatArray
from pumafuse.filter.response import response
from pumafuse.identification.verify import ModelFit, Trace
from pumafuse.model.plants import PLANTS
from refusals import one_line

RECORDED = Path(pf.__file__).parent / "data"
PERIOD, DELAY, NOISE = 0.028, 0.0604, 5e-5  # s, s, m
LOW, HIGH = 0.556, 0.564  # m, the levels of the white noise
FIRST = pf.FirstOrder(time_constant=0.0425)
SECOND = pf.SecondOrder(natural_frequency=53.9, damping=0.864)
GAIN = pf.Gain(slope=0.1, intercept=0.9)
RNG = np.random.default_rng(20240)
TICKS = 400
TIME = np.arange(TICKS) * PERIOD
BINARY = RNG.choice([LOW, HIGH], TICKS)
BINARY[:2] = HIGH, LOW  # the first command moves it
SAMPLED = np.arange(0.0, TIME[-1] + 0.3, 0.0041)


def arm(
    plant: PLANTS = FIRST, gain: pf.Gain = GAIN, delay: float = DELAY, recovery: float | None = None, axis: str = "tip"
) -> pf.ArmModel:
    axes = {axis: pf.AxisModel(plant=plant, gain=gain, gain_recovery=recovery)}
    return pf.ArmModel(name="known", update_period=PERIOD, delay=delay, axes=axes)


def moved(known: pf.ArmModel, command: FloatArray = BINARY, start: float = LOW, held: int = 1) -> FloatArray:
    """Where the arm is at SAMPLED: each command a step response of its own and a gain error, one in ``held`` T.

    The error, (K − 1) times the step, is an input that stays, or decays with the recovery, of a first-order plant only.
    """
    (model,) = known.axes.values()
    found = np.full(len(SAMPLED), start)
    for n, step in enumerate(np.diff(command, prepend=start)):
        since = np.maximum(SAMPLED - n * held * PERIOD - known.delay, 0.0)
        error = (model.gain.slope * abs(step) / PERIOD + model.gain.intercept - 1.0) * step
        lasting = model.plant.step_response(since)
        found += step * lasting
        if model.gain_recovery is not None:
            tau, recovery = model.plant.time_constant, model.gain_recovery
            lasting = (np.exp(-since / recovery) - np.exp(-since / tau)) / (1.0 - tau / recovery)
        found += error * lasting
    return found


def noise(seed: int = 0) -> FloatArray:
    return NOISE * np.random.default_rng(seed).standard_normal(len(SAMPLED))


def run_of(
    position: FloatArray, command: FloatArray = BINARY, held: int = 1, start: Mapping[str, float] | None = None
) -> pf.Run:
    time = np.arange(len(command)) * PERIOD * held
    return pf.Run.from_arrays(time, {"tip": command}, {"scope": (SAMPLED, {"tip": position})}, start=start, name="r")


def only(run: pf.Run, model: pf.ArmModel, start: Mapping[str, float] | None = None) -> pf.AxisVerification:
    ((found, _),) = pf.verify(run, model, start=start)
    return found


# ---- the model is the true one ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("plant", [FIRST, SECOND], ids=["first", "second"])
def test_the_error_of_a_true_model_is_exactly_the_noise(plant: PLANTS) -> None:
    """To nine digits; it is as good as any; the best in class is lower by no more than its degrees of freedom."""
    found = only(run_of(moved(arm(plant)) + noise()), arm(plant))
    assert found.model.rms == pytest.approx(np.std(noise()), rel=1e-9)
    assert (found.measurements, found.run, found.axis, found.source) == (len(SAMPLED), "r", "tip", "scope")
    assert found.verdict.startswith("as good as any")
    assert found.amplitude == pytest.approx(HIGH - LOW, rel=1e-12)
    assert found.without_recovery == found.model
    # each of up to four parameters takes a share chi-squared/n of the squares: 25 in all is beyond one in 10 000
    assert 1.0 - 25.0 / len(SAMPLED) < (found.best_in_class.fit.rms / found.model.rms) ** 2 <= 1.0 + 1e-9


@pytest.mark.parametrize(("recovery", "held"), [(0.05, 5), (0.14, 1)])
def test_a_gain_that_recovers_recovers_as_the_arm_says(recovery: float, held: int) -> None:
    """With its own time constant the error is the noise, also under held commands; without recovery far more."""
    known, command = arm(recovery=recovery), BINARY[: TICKS // held]
    found = only(run_of(moved(known, command, held=held) + noise(), command, held), known)
    assert found.model.rms == pytest.approx(np.std(noise()), rel=1e-8)
    assert (found.with_recovery, found.recovery) == (found.model, recovery)
    bare = moved(arm(), command, held=held)
    expected = np.std(moved(known, command, held=held) + noise() - bare)
    assert found.without_recovery.rms == pytest.approx(expected, rel=1e-8)
    assert expected > 1.5 * NOISE


# ---- definitions ----------------------------------------------------------------------------------------------------


def test_an_arm_with_play_and_a_fastest_speed_is_verified_as_one() -> None:
    """To nine digits; without them it is far off."""
    linear = arm()
    bent = msgspec.structs.replace(linear.axes["tip"], play=2e-3, max_speed=0.1)
    known = msgspec.structs.replace(linear, axes={"tip": bent})
    given, at = (np.rint(1e9 * time).astype(np.int64) for time in (TIME, SAMPLED))
    run = run_of(response(bent, PERIOD, DELAY, given, BINARY, LOW, at) + LOW + noise(), start={"tip": LOW})
    assert only(run, known).model.rms == pytest.approx(np.std(noise()), rel=1e-9)
    assert only(run, linear).model.rms > 1.5 * NOISE


def test_the_numbers_are_what_their_names_say() -> None:
    """RMS without the mean, percent of the commands' amplitude, fit against the measured signal, from plain numpy."""
    model = arm(pf.FirstOrder(time_constant=0.06), pf.Gain(intercept=1.1), 0.05)
    measured, modelled = moved(arm()) + noise(), moved(model)
    ((found, trace),) = pf.verify(run_of(measured), model)
    left = (measured - measured.mean()) - (modelled - modelled.mean())
    rms = np.sqrt(np.mean(left**2))
    expected = ModelFit(
        rms=rms,
        percent=100.0 * rms / (HIGH - LOW),
        fit=100.0 * (1.0 - np.linalg.norm(left) / np.linalg.norm(measured - measured.mean())),
    )
    np.testing.assert_allclose(msgspec.structs.astuple(found.model), msgspec.structs.astuple(expected), rtol=1e-8)
    assert isinstance(trace, Trace)
    np.testing.assert_allclose(trace.time, SAMPLED, atol=1e-9)
    np.testing.assert_allclose(trace.measured, measured - measured.mean(), atol=1e-12)
    np.testing.assert_allclose(trace.modelled, modelled - modelled.mean(), atol=1e-11)
    # the numbers of the best in class follow from its own plant, gain and delay
    best = found.best_in_class
    left = measured - moved(arm(best.plant, pf.Gain(intercept=best.gain), best.delay))
    assert best.fit.rms == pytest.approx(np.std(left), rel=1e-6)
    assert best.fit.percent == pytest.approx(100.0 * np.std(left) / (HIGH - LOW), rel=1e-6)
    assert best.fit.fit == pytest.approx(100.0 * (1.0 - np.std(left) / np.std(measured)), rel=1e-6)


# ---- the best in class ----------------------------------------------------------------------------------------------

TRUE_GAIN = 0.9 + 0.1 * (HIGH - LOW) / PERIOD


def wrong(order: int, seed: int, delays: tuple[float, float]) -> pf.ArmModel:
    """Any arm of an order: a lag of 10 to 120 ms, ζ of 0.4 to 2, a gain of 0.3 to 1.7."""
    rng = np.random.default_rng(seed)
    lag, damping = np.exp(rng.uniform(np.log([0.01, 0.4]), np.log([0.12, 2.0]))).tolist()
    plant = (
        pf.FirstOrder(time_constant=lag)
        if order == 1
        else pf.SecondOrder(natural_frequency=2.0 * damping / lag, damping=damping)
    )
    return arm(plant, pf.Gain(intercept=rng.uniform(0.3, 1.7)), rng.uniform(*delays))


@pytest.mark.parametrize(("order", "seed", "delays"), [(1, 0, (0.03, 0.12)), (2, 11, (0, 0.03))])
def test_the_best_in_class_is_found_from_a_wrong_arm(order: int, seed: int, delays: tuple[float, float]) -> None:
    """Delay and gain of the true arm within 1 %, its plant within 3 %, wherever the search begins."""
    true, model = FIRST if order == 1 else SECOND, wrong(order, seed, delays)
    found = only(run_of(moved(arm(true)) + noise(seed)), model, {"tip": LOW})
    best = found.best_in_class
    assert best.fit.rms <= min(found.model.rms, np.std(noise(seed))) * (1.0 + 1e-9)
    np.testing.assert_allclose([best.delay, best.gain], [DELAY, TRUE_GAIN], rtol=0.01)
    assert isinstance(best.plant, type(true))
    np.testing.assert_allclose(
        msgspec.structs.astuple(best.plant)[:order], msgspec.structs.astuple(true)[:order], rtol=0.03
    )


@pytest.mark.long
@pytest.mark.parametrize("correlation", [1e-4, 0.1])
def test_the_interval_of_the_lag_covers_the_true_one(correlation: float) -> None:
    """In 90 to 99 of 100 runs, also where errors of measurements 4 ms apart are alike for 0.1 s."""
    held, alike = [], np.exp(-0.0041 / correlation)
    for seed in range(150):
        white = np.random.default_rng(seed).standard_normal(len(SAMPLED))
        error = lfilter([np.sqrt(1.0 - alike**2)], [1.0, -alike], white)
        best = only(run_of(moved(arm()) + NOISE * error), arm(), {"tip": LOW}).best_in_class
        held.append(best.lag_ci95[0] <= DELAY + FIRST.lag <= best.lag_ci95[1])
    assert 0.9 <= np.mean(held) <= 0.99


def test_the_verdict_compares_with_the_best_in_class() -> None:
    """How many times, by how many milliseconds the arm answers later or sooner; and where no arm's answer is seen."""
    run = run_of(moved(arm()) + noise())
    for tau, begins, word in (
        (0.0465, "holds, with ", "sooner"),
        (0.0385, "holds, with ", "later"),
        (0.3000, "does not hold, with ", "sooner"),
    ):
        found = only(run, arm(pf.FirstOrder(time_constant=tau)))
        ratio, plant = found.model.rms / found.best_in_class.fit.rms, found.best_in_class.plant
        assert ratio > 1.5
        assert isinstance(plant, pf.FirstOrder)
        apart = abs(DELAY + tau - found.best_in_class.delay - plant.time_constant)
        assert apart == pytest.approx(abs(tau - FIRST.time_constant), abs=2e-4)
        assert found.verdict.startswith(f"{begins}{ratio:.1f} times the error"), found.verdict
        assert found.verdict.endswith(f"answers {1e3 * apart:.1f} ms {word}, with gain 0.93"), found.verdict
    still = only(run_of(LOW + noise()), arm())
    assert still.best_in_class.fit.fit < 5.0
    assert still.verdict == "no linear model of this order fits: look at the log"


# ---- the start level ------------------------------------------------------------------------------------------------


def test_the_start_level_is_found_among_the_runs() -> None:
    """And that it was found, not known."""
    found = only(run_of(moved(arm(), start=HIGH) + noise()), arm())
    assert found.start == HIGH
    assert found.start_from == "chosen among the run's 2 levels by RMS"
    assert found.model.rms == pytest.approx(np.std(noise()), rel=1e-9)


# ---- logs as they are -----------------------------------------------------------------------------------------------


def test_what_cannot_be_verified_is_refused_in_one_line() -> None:
    """Too few measurements, no sensor at all, one that is unknown, an axis that the arm or the run has not."""
    run, no_source = run_of(moved(arm()) + noise()), "no source has 20 measurements of a commanded axis"
    few = pf.Run.from_arrays(TIME, {"tip": BINARY}, {"scope": (SAMPLED[:19], {"tip": SAMPLED[:19]})})
    early = pf.Run.from_arrays(TIME, {"tip": BINARY}, {"scope": (SAMPLED - 60.0, {"tip": SAMPLED})})
    fast = arm(pf.SecondOrder(natural_frequency=50.0, damping=1e300))
    options: list[tuple[str, pf.Run, pf.ArmModel, dict[str, Any]]] = [
        (no_source, few, arm(), {}),
        (no_source, early, arm(), {}),
        (no_source, pf.Run.from_arrays(TIME, {"tip": BINARY}), arm(), {}),
        ("run 'r' has no sensor 'eye'; it has scope", run, arm(), {"sensors": ["eye"]}),
        ("the arm 'known' has no such axis", run, arm(axis="elbow"), {}),
        ("elbow", run, arm(), {"start": {"elbow": 0.1}}),
        ("not finite", run, arm(), {"start": {"tip": np.nan}}),
        ("of no size that an arm has", run, arm(), {"start": {"tip": 1e20}}),
        ("of no size that an arm has", run, fast, {}),
    ]
    for words, of, model, more in options:
        assert words in one_line(pf.PumafuseError, lambda of=of, model=model, more=more: pf.verify(of, model, **more))


# ---- recorded -------------------------------------------------------------------------------------------------------

LIMITS = {"preset": (0.66e-3, 0.28e-3, 0.31e-3), "identified": (1.02e-3, 0.40e-3, 0.35e-3)}


@pytest.mark.long
def test_recorded_white_noise_is_met_as_well_as_promised() -> None:
    """The preset and an arm from 86 trials at 8 mm, tangential, radial, vertical: RMS within LIMITS."""
    identified = pf.identify(pf.StepTrials.read(RECORDED / "steps")).arm
    for name, model in {"preset": pf.ArmModel.load("puma560-internal"), "identified": identified}.items():
        for limit, axis in zip(LIMITS[name], ("tangential", "radial", "vertical"), strict=True):
            found = only(pf.Run.read(RECORDED / "white-noise" / f"{axis}_8mm_r1"), model)
            assert found.model.rms <= limit, (name, axis)
            assert found.amplitude == pytest.approx(0.008)


def test_spikes_are_left_out_and_counted_and_a_wrong_model_is_not_spared() -> None:
    """2 % of the measurements 20 mm away change nothing; a second of a stuck arm stays in the error."""
    rng = np.random.default_rng(12)
    known = arm(FIRST)
    clean = moved(known) + noise()
    far = rng.random(len(clean)) < 0.02
    far[1:] &= ~far[:-1]
    spiked = clean + 0.02 * far * rng.choice([-1.0, 1.0], len(clean))
    expected, found = only(run_of(clean), known), only(run_of(spiked), known)
    assert expected.outlying == 0
    assert found.outlying == int(far.sum())
    assert found.model.rms == pytest.approx(expected.model.rms, rel=0.03)
    stuck = clean.copy()
    stuck[500:750] = moved(known)[500] + (clean - moved(known))[500:750]  # its sensor still scatters
    found = only(run_of(stuck), known)
    assert found.outlying < 10
    assert found.model.rms > 0.9 * float(np.std(stuck - moved(known)))
