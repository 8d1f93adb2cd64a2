"""Causes: what each gains against dense Gaussian densities, and which is named where one thing is wrong.

A run is made by the model; then one thing is changed in what its sensor says, or in what the arm does.
"""

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.signal import lfilter

import pumafuse as pf
from pumafuse.filter.response import response
from pumafuse.fusion.causes import Cause, Tried, Weight, evidence_of, suspects, together
from pumafuse.fusion.consistency import Consistency, Finding, consistency, log_likelihood
from pumafuse.fusion.summary import decode, encode
from pumafuse.fusion.verdicts import sentence
from tuning_runs import with_sensors

changed = msgspec.structs.replace
PERIOD, DELAY, TAU = 0.028, 0.060, 0.0425  # s
SD, LATENCY, EVERY = 0.3e-3, 0.020, 0.020  # m, s, s
AXES: tuple[str, ...] = ("a", "b")


def raster(count: int) -> np.ndarray:
    """Strokes to and fro of 30 and 60 mm/s with rests between them, as steps of commands."""
    speed = np.zeros(count)
    strokes = [(at, at + 54) for at in range(20, count, 66)]
    for number, (begin, end) in enumerate(strokes):
        speed[begin:end] = (0.03, 0.06)[number % 2] * (-1.0) ** (number // 2)
    return np.cumsum(speed) * PERIOD


def arm(tau: float = TAU, delay: float = DELAY) -> pf.ArmModel:
    plant = pf.AxisModel(plant=pf.FirstOrder(time_constant=tau))
    return pf.ArmModel(name="arm", update_period=PERIOD, delay=delay, axes=dict.fromkeys(AXES, plant))


def config(run: pf.Run | None = None, **sensor: float) -> pf.FusionConfig:
    """What is true of runs that are not changed, of their axes."""
    known = changed(pf.Sensor(sd=SD, latency=LATENCY, gate=0.0), **sensor)
    axes = AXES if run is None else run.axes
    model = changed(arm(), axes=dict.fromkeys(axes, arm().axes["a"]))
    process = dict.fromkeys(axes, pf.Process(input_noise=0.05e-3, drift=0.3e-3))
    return pf.FusionConfig(arm=model, start=pf.Start(offset_sd=2e-3), process=process, sensors={"camera": known})


def recorded(
    *,
    moved: Callable[[np.ndarray], np.ndarray] = lambda r: r,
    noise: Callable[[np.ndarray], np.ndarray] = lambda e: e,
    seen: Callable[[np.ndarray], np.ndarray] = lambda z: z,
    model: pf.ArmModel | None = None,
    process: float = 1.0,
    late: float = LATENCY,
    jitter: float = 0.0,
    others: Mapping[str, float] | None = None,
    seed: int = 1,
    axes: Sequence[str] = AXES,
    seconds: float = 40.0,
    told: Callable[[int], np.ndarray] = raster,
) -> pf.Run:
    """A run with one thing changed.

    Args:
        moved: What the arm makes of its response, every 2 ms.
        noise: What the sensor makes of white noise of variance 1.
        seen: What it makes of its values.
        model: The true arm.
        process: Factor on the process noise.
        late: The sensor's true latency [s].
        jitter: It scatters evenly by as much to either side [s].
        others: More sensors by name with their sd, as late as they are configured.
        seed: Of all noise.
        axes: Which all have the same commands.
        seconds: How long it is.
        told: So many commands.
    """
    rng, true = np.random.default_rng(seed), model or arm()
    command, fine = told(int(seconds / PERIOD) + 2), np.arange(0, round(seconds * 1e9), 2 * 10**6)
    given = np.rint(np.arange(len(command)) * PERIOD * 1e9).astype(np.int64)
    led = moved(response(true.axes["a"], PERIOD, true.delay, given, command, 0.0, fine))
    valid = np.rint(np.arange(0.2, seconds - 0.1, EVERY) * 1e9).astype(np.int64)
    decay = math.exp(-0.002 / TAU)
    spread = process * 0.05e-3 * math.sqrt((1.0 - decay**2) / (2.0 * TAU))
    values: dict[str, dict[str, np.ndarray]] = {name: {} for name in ("camera", *(others or {}))}
    for axis in axes:
        strays = lfilter([1.0], [1.0, -decay], spread * rng.standard_normal(len(fine)))
        walk = (
            2e-3 * rng.standard_normal() + process * 0.3e-3 * math.sqrt(0.002) * rng.standard_normal(len(fine)).cumsum()
        )
        position = np.interp(valid, fine, led + strays + walk)
        values["camera"][axis] = seen(position + SD * noise(rng.standard_normal(len(valid))))
        for name, sd in (others or {}).items():
            values[name][axis] = position + sd * rng.standard_normal(len(valid))
    stamps = dict.fromkeys(values, valid)
    stamps["camera"] = valid + np.rint((late + jitter * rng.uniform(-1.0, 1.0, len(valid))) * 1e9).astype(np.int64)
    sensors = {name: (stamps[name], values[name]) for name in values}
    return pf.Run.from_arrays(given, dict.fromkeys(axes, command), sensors)


def found(run: pf.Run, known: pf.FusionConfig, sensor: str = "camera") -> list[Consistency]:
    est = pf.fuse(run, known)
    each = [consistency(est, sensor, axis) for axis in AXES]
    return [one for one in each if one is not None]


def ar(rho: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda e: lfilter([math.sqrt(1.0 - rho**2)], [1.0, -rho], e)


def smoothed(z: np.ndarray) -> np.ndarray:
    """A low pass of three samples."""
    share = 1.0 - math.exp(-1.0 / 3.0)
    return z[0] + lfilter([share], [1.0, share - 1.0], z - z[0])


def echoed(z: np.ndarray) -> np.ndarray:
    """Two parts of five are the value before the last one."""
    return np.concatenate([z[:2], 0.6 * z[2:] + 0.4 * z[:-2]])


def with_play(r: np.ndarray) -> np.ndarray:
    place = [0.0]
    for at in r.tolist():
        place.append(min(max(place[-1], at - 0.75e-3), at + 0.75e-3))
    return np.array(place[1:])


def limited(r: np.ndarray) -> np.ndarray:
    """No faster than 54 mm/s, a step of 2 ms after the other."""
    place = [0.0]
    for at in r.tolist():
        place.append(place[-1] + min(max(at - place[-1], -1.08e-4), 1.08e-4))
    return np.array(place[1:])


def with_outliers(e: np.ndarray) -> np.ndarray:
    """Each fiftieth is twenty times as large."""
    return np.where(np.arange(len(e)) % 50 == 7, 20.0 * e, e)


def slow(fastest: float) -> pf.ArmModel:
    """An arm whose drive goes that fast [m/s]."""
    return changed(arm(), axes=dict.fromkeys(AXES, changed(arm().axes["a"], max_speed=fastest)))


def slow_config(fastest: float) -> pf.FusionConfig:
    return changed(config(), arm=slow(fastest))


LAG_OF_SMOOTHING = EVERY / (math.exp(1.0 / 3.0) - 1.0)
WORLDS = {
    "sd too large": (recorded, config(sd=3 * SD), Cause.NOISE, 1 / 3),
    "process noise too large": (lambda: recorded(process=1 / 3), config(), Cause.PROCESS, 1 / 3),
    "correlated": (lambda: recorded(noise=ar(0.8)), config(), Cause.CORRELATED, 0.0),
    "outliers": (lambda: recorded(noise=with_outliers), config(), Cause.OUTLIERS, 0.0),
    "stamped 20 ms early": (lambda: recorded(late=LATENCY - 0.02), config(), Cause.LAG, -0.02),
    "jitter": (lambda: recorded(jitter=9e-3), config(), Cause.JITTER, 9e-3 / math.sqrt(3.0)),
    "a delay of several periods": (lambda: recorded(model=arm(delay=DELAY + 0.09)), config(), Cause.LAG, 0.09),
    "a plant": (lambda: recorded(model=arm(TAU + 0.03)), config(), Cause.PLANT, 0.03),
    "delay for plant": (lambda: recorded(model=arm(TAU + 0.03, DELAY - 0.03)), config(), Cause.DYNAMICS, 0.0),
    "scale": (lambda: recorded(seen=lambda z: 1.04 * z), config(), Cause.POSITION, 0.04),
    "play": (lambda: recorded(moved=with_play), config(), Cause.PLAY, 1.5e-3),
    "limit": (lambda: recorded(moved=limited), config(), Cause.LIMIT, 0.0),
    "a fastest speed too small": (lambda: recorded(model=slow(0.045)), slow_config(0.04), Cause.FASTEST, 0.125),
    "a fastest speed far too small": (lambda: recorded(model=slow(0.045)), slow_config(0.035), Cause.FASTEST, 0.286),
    "a fastest speed too large": (lambda: recorded(model=slow(0.045)), slow_config(0.055), Cause.FASTEST, -0.18),
}


@pytest.mark.filterwarnings("ignore:.*ask for more than")
@pytest.mark.parametrize("world", WORLDS)
def test_the_one_thing_that_is_wrong_is_named_first_with_its_size(world: str) -> None:
    """On both axes, its size to a quarter; of a lag alone a latency is said."""
    run, known, cause, size = WORLDS[world]
    for one in found(run(), known):
        assert one.causes[0].cause is cause, sentence(one)
        assert one.causes[0].size == pytest.approx(size, rel=0.25)
        assert ("latency_ms" in sentence(one)) == (cause in (Cause.LAG, Cause.PLANT)), sentence(one)


@pytest.mark.parametrize(
    ("change", "late"), [(smoothed, LATENCY + LAG_OF_SMOOTHING), (echoed, LATENCY + 0.4 * 2 * EVERY)]
)
def test_smoothed_noise_is_not_taken_for_small_noise(change: Callable[[np.ndarray], np.ndarray], late: float) -> None:
    """Filtered values, their lag known: innovations are too small, but a smaller sd alone is not the advice."""
    for one in found(recorded(seen=change), config(latency=late)):
        assert one.finding is Finding.TOO_SMALL
        assert Cause.CORRELATED in [each.cause for each in one.causes], sentence(one)
        assert "the noise is correlated" in sentence(one) and "latency_ms" not in sentence(one)


def test_no_lag_is_said_that_is_longer_than_any_search() -> None:
    """As where commands left for a moment, which nobody followed: a speed times 50 s explains that, too."""
    for lag, causes in ((0.05, [Cause.LAG]), (50.0, [])):
        weight = Weight(score=lag * 1e6, information=1e6, number=100, squares=1e10)
        assert [one.cause for one in suspects({Tried(Cause.LAG, "camera"): weight})] == causes


def test_where_nothing_is_wrong_no_cause_is_named() -> None:
    """Six runs, two axes: nothing gains what a cause must gain."""
    for seed in range(6):
        est = pf.fuse(recorded(seed=seed), config())
        assert not any(suspects(evidence_of(est, axis)) for axis in AXES)


def test_beside_another_sensor_the_wrong_one_is_named() -> None:
    """The camera is 20 ms late; the tracker knows better, and the verdict on either says whose latency it is."""
    run = recorded(late=LATENCY + 0.02, others={"tracker": 0.2e-3})
    sensors = config().sensors | {"tracker": pf.Sensor(sd=0.2e-3, gate=0.0)}
    est = pf.fuse(run, changed(config(), sensors=sensors))
    for axis in AXES:
        one = consistency(est, "camera", axis)
        first = suspects(one.evidence())[0]
        assert (first.cause, first.sensor) == (Cause.LATENCY, "camera")
        assert first.size == pytest.approx(0.02, rel=0.1)
        if one.causes:
            assert re.search(r": latency_ms is (19|20|21)[.\d]* ms too small", sentence(one)), sentence(one)


def test_score_and_information_are_those_of_generalised_least_squares() -> None:
    """Σ x̃ ν/√S = xᵀC⁻¹z and Σ x̃² = xᵀC⁻¹x with the dense covariance C of all measurements, x the arm's velocity."""
    process = dict.fromkeys(AXES, pf.Process(input_noise=0.0, drift=0.3e-3))  # so that all covariances are known
    run, known = recorded(late=LATENCY + 0.01).between(None, 8.0), changed(config(), process=process)
    est = pf.fuse(run, known)
    measured = est.measurements.of("camera", "a")
    time = measured.time
    covariance = 4e-6 + 0.3e-3**2 * np.minimum.outer(time, time) + SD**2 * np.eye(len(time))
    stamp, command = est.segments[0].commands_of("a")
    led, late, early = (
        response(known.arm.axes["a"], PERIOD, DELAY, stamp, command, 0.0, np.rint((time + by) * 1e9).astype(np.int64))
        for by in (0.0, -PERIOD, PERIOD)
    )
    x = (late - early) / (2.0 * PERIOD)
    weight = evidence_of(est, "a")[Tried(Cause.LAG, "camera", 0.0)]
    assert weight.information == pytest.approx(x @ np.linalg.solve(covariance, x), rel=1e-5)
    assert weight.score == pytest.approx(x @ np.linalg.solve(covariance, measured.value - led), rel=1e-5)


@pytest.mark.parametrize("rows", [[], [1.0, 3.0]])
def test_another_noise_gains_what_the_likelihood_says(rows: list[float]) -> None:
    """Twice the sd, four times the process noise: the difference of the log-likelihoods of two fusions.

    Also where rows tell a noise of their own.
    """
    run, known = recorded(), config(sd=0.5 * SD)
    camera = run.sensors["camera"]
    run = replace(run, sensors={"camera": replace(camera, noise=np.resize(rows, len(camera.stamp) * bool(rows)))})
    doubled = with_sensors(known, sd=SD)
    each = {axis: pf.Process(input_noise=0.2e-3, drift=1.2e-3) for axis in AXES}
    est = [pf.fuse(run, one) for one in (known, doubled, changed(known, process=each))]
    of_axis = [one.measurements.where(one.measurements.axis == 0) for one in est]
    likelihood = [log_likelihood(one, known.sensors) for one in of_axis]
    gained = evidence_of(est[0], "a")
    assert gained[Tried(Cause.NOISE, "camera", 2.0)].gain == pytest.approx(likelihood[1] - likelihood[0], rel=1e-6)
    assert gained[Tried(Cause.PROCESS, "", 4.0)].gain == pytest.approx(likelihood[2] - likelihood[0], rel=1e-6)


def test_parts_of_a_run_tell_together_what_the_whole_tells() -> None:
    """The evidence of two halves adds up to that of both, but for what the second does not know of the first."""
    est = pf.fuse(recorded(late=LATENCY + 0.02), config())
    whole = suspects(evidence_of(est, "a"))[0]
    half = [pf.fuse(recorded(late=LATENCY + 0.02).between(*ends), config()) for ends in ((0.0, 20.0), (20.0, 40.0))]
    both = suspects(together(evidence_of(one, "a") for one in half))[0]
    assert (both.cause, both.sensor) == (whole.cause, whole.sensor)
    assert both.size == pytest.approx(whole.size, rel=0.05)
    assert both.gain == pytest.approx(whole.gain, rel=0.1)


@pytest.mark.parametrize(
    ("late", "cause", "size"), [(LATENCY + 0.02, Cause.LAG, "shift_ms"), (LATENCY, Cause.NOISE, "factor")]
)
def test_the_causes_of_a_verdict_are_in_the_summary(late: float, cause: Cause, size: str) -> None:
    """Each with its axis, whose fault it is, its words and its size, in the file's units and read again."""
    known = config() if cause is Cause.LAG else config(sd=SD / 3.0)
    summary = pf.summarise(pf.fuse(recorded(late=late), known))
    written = json.loads(encode(summary))["axes"]["a"]["sensors"]["camera"]
    first = written["causes"][0]
    assert (first["axis"], first["sensor"], first["cause"]) == ("a", "camera", cause.value)
    assert [one["words"] in written["verdict"] for one in written["causes"]] == [True] * len(written["causes"])
    assert first[size] == pytest.approx({"shift_ms": 20.0, "factor": 3.0}[size], rel=0.15)
    (again, *_), (found, *_) = (one.axes["a"].sensors["camera"].causes for one in (decode(encode(summary)), summary))
    assert msgspec.structs.astuple(again) == pytest.approx(msgspec.structs.astuple(found))
    right = pf.summarise(pf.fuse(recorded(), config()))
    assert not right.axes["a"].sensors["camera"].causes
