"""The compiled engine against the reference engine: the same outcomes, estimates, error bars, innovations, biases.

A measurement whose innovation is within rounding of its gate may be judged either way; none of those here comes that
near.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pumafuse.fusion.outcome import Outcome

import pumafuse as pf
from fusion.test_oracle import CASES, MS, NOISE, PAPER, UNDER, Case, Heard, T, cases, every, one, plants
from fusion.test_oracle import sensor as ungated
from fusion_oracle import AxisOracle, nanoseconds
from pumafuse.fusion.estimates import Estimates, Measurements
from pumafuse.logs.run import Run
from pumafuse.simulation.scenario import Scenario
from pumafuse.simulation.simulate import simulate

MODES = {"filtered": {}, "smoothed": {"smooth": True}, "as-live": {"as_live": True}}
FIELDS = ("position", "velocity", "offset")
SCENARIOS = Path(__file__).parents[2] / "scenarios"
DATA = Path(pf.__file__).parent / "data"
mode_names = st.sampled_from(list(MODES))


def both(run: Run, config: pf.FusionConfig, mode: str, rate: float | None = None) -> tuple[Estimates, Estimates]:
    """What the compiled and the reference engine make of a run."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pf.PumafuseWarning)  # what is said of these runs is tested elsewhere
        compiled = pf.fuse(run, config, rate=rate, engine="compiled", **MODES[mode])
        return compiled, pf.fuse(run, config, rate=rate, engine="filterpy", **MODES[mode])


def margin(measurements: Measurements, config: pf.FusionConfig) -> float:
    """By how much any |ν|/√S misses its gate; a component that reacquired its gate has another √S by now."""
    gates = np.array([config.sensors[name].gate if name in config.sensors else 0.0 for name in measurements.sensors])
    judged = (measurements.outcome <= Outcome.REJECTED) & (gates[measurements.sensor] > 0.0)
    ratio = np.abs(measurements.innovation[judged]) / measurements.innovation_sd[judged]
    return float(np.abs(ratio - gates[measurements.sensor][judged]).min(initial=math.inf))


def agree(got: Estimates, wanted: Estimates, tolerance: float = 1e-9) -> None:
    """Outcomes are equal, means agree to ``tolerance`` sd + 1e-12 (m, m/s), variances to ``tolerance``."""
    assert got.engine == "compiled"
    assert wanted.engine == "filterpy"
    for name in ("time", "stamp", "sensor", "axis", "value", "outcome"):
        np.testing.assert_array_equal(getattr(got.measurements, name), getattr(wanted.measurements, name), err_msg=name)
    _close("innovation", got.measurements.innovation, got.measurements.innovation_sd,
           wanted.measurements.innovation, wanted.measurements.innovation_sd, tolerance)  # fmt: skip
    np.testing.assert_array_equal(got.time, wanted.time)
    np.testing.assert_array_equal(got.segment, wanted.segment)
    assert tuple(got.axes) == tuple(wanted.axes)
    for axis in wanted.axes:
        for field in FIELDS:
            mine, theirs = ((getattr(e[axis], field), getattr(e[axis], f"{field}_sd")) for e in (got, wanted))
            _close(f"{axis} {field}", *mine, *theirs, tolerance)
    assert [(name, tuple(of)) for name, of in got.biases.items()] == [
        (name, tuple(of)) for name, of in wanted.biases.items()
    ]
    for name, of in wanted.biases.items():
        for axis, bias in of.items():
            mine = got.biases[name][axis]
            _close(f"bias of {name} on {axis}", *map(np.array, (mine.value, mine.sd, bias.value, bias.sd)), tolerance)
    for name in wanted.cartesian or ():
        np.testing.assert_allclose(got.cartesian[name], wanted.cartesian[name], rtol=0.0, atol=tolerance)
    assert (got.cartesian is None) == (wanted.cartesian is None)
    assert got.notes == wanted.notes


def _close(
    what: str, mean: np.ndarray, sd: np.ndarray, right: np.ndarray, right_sd: np.ndarray, tolerance: float
) -> None:
    np.testing.assert_array_equal(np.isnan(mean), np.isnan(right), err_msg=what)
    np.testing.assert_array_equal(np.isnan(sd), np.isnan(right), err_msg=what)
    met = ~np.isnan(right)
    np.testing.assert_array_less(np.abs(mean - right)[met] - tolerance * right_sd[met], 1e-12, err_msg=what)
    np.testing.assert_allclose(sd[met] ** 2, right_sd[met] ** 2, rtol=tolerance, atol=0.0, err_msg=f"{what}, sd")


# ---- runs of the oracle's tests -------------------------------------------------------------------------------------


WANDERING = Case(
    one(UNDER),
    delay=0.02,
    heard={"tracker": Heard(ungated(0.05e-3, latency=0.02, latency_sd=0.004, scale=-1.5), every(70, 28))},
)
EVERY = CASES | {"a latency that wanders": WANDERING}


@pytest.mark.parametrize(
    "mode",
    ["filtered", pytest.param("smoothed", marks=pytest.mark.long), pytest.param("as-live", marks=pytest.mark.long)],
)
@pytest.mark.parametrize("case", EVERY.values(), ids=EVERY.keys())
def test_both_engines_make_the_same_of_a_run(case: Case, mode: str) -> None:
    """Plants, delays, gains, clocks, sensors, axes: wherever the oracle is asked, either engine gives its answer."""
    run, config = case.made()
    agree(*both(run, config, mode, case.rate))


@pytest.mark.long
@settings(derandomize=True, deadline=None, max_examples=40)
@given(cases(), mode_names)
def test_both_engines_make_the_same_of_any_run_of_the_oracle(case: Case, mode: str) -> None:
    """Random plants, delays, gains, gaps, noise and sensors, smoothed with priors that leave the reference digits."""
    run, config = (tame(case) if mode == "smoothed" else case).made()
    agree(*both(run, config, mode, case.rate))


def tame(case: Case) -> Case:
    """Priors of at most 30 times a measurement's noise."""
    heard = {
        name: replace(ear, sensor=msgspec.structs.replace(
            ear.sensor, sd=max(ear.sensor.sd, 0.3e-3), bias_sd=min(ear.sensor.bias_sd, 9e-3)))
        for name, ear in case.heard.items()
    }  # fmt: skip
    return replace(case, heard=heard, offset_sd=min(case.offset_sd, 5e-3))


# ---- whole logs: several axes and sensors, gates that reject and reopen, everything a logger does --------------------

AXES = ("tangential", "radial", "vertical")
OFF = 0.05  # m


def some(draw: st.DrawFn, *values: object) -> object:
    return draw(st.sampled_from(values))


@st.composite
def sensors(draw: st.DrawFn, axes: tuple[str, ...]) -> pf.Sensor:
    sd = some(draw, 0.2e-3, 1e-3, {axis: 0.3e-3 * (1 + place) for place, axis in enumerate(axes)})
    return pf.Sensor(
        sd=sd,
        latency=some(draw, 0.0, 0.008, 0.09, 0.31, -0.02),
        latency_sd=some(draw, 0.0, 0.0, 0.003),
        scale=some(draw, 1.0, -1.0, 2.5),
        bias_sd=some(draw, 0.0, 0.0, 5e-3),
        gate=some(draw, 0.0, 2.0, 3.0, 5.0),
        gate_rows=draw(st.booleans()),
    )


def logged(
    rng: np.random.Generator, of: pf.Sensor, valid: np.ndarray, near: Mapping[str, np.ndarray], spells: float
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A sensor's rows as a bad logger has them: outliers one by one and by spells, NaN, twice, out of order, gaps."""
    kept = np.ones(len(valid), dtype=bool)
    if len(valid) > 20:
        gap = rng.integers(len(valid) - 10)
        kept[gap : gap + rng.integers(10)] = False
    valid = valid[kept]
    second = valid / 1e9
    values = {}
    for axis, position in near.items():
        here = position[kept] + rng.normal(0.0, 0.5e-3, len(valid))
        here += OFF * (np.sin(second * 2.1 + rng.uniform(0.0, 7.0)) > 1.0 - spells)  # off for up to a second or two
        here += np.where(rng.random(len(valid)) < 0.03, rng.normal(0.0, 0.02, len(valid)), 0.0)
        values[axis] = of.scale * here + of.bias_sd * rng.normal()
        values[axis][rng.random(len(valid)) < 0.05] = np.nan
        values[axis][rng.random(len(valid)) < 0.01] = np.inf
    rows = np.arange(len(valid)).repeat(1 + (rng.random(len(valid)) < 0.05))  # some twice
    order = rows[np.argsort(rows + rng.uniform(0.0, 3.0, len(rows)) * (rng.random(len(rows)) < 0.1), kind="stable")]
    stamp = valid + round(of.latency * 1e9)
    return stamp[order], {axis: value[order] for axis, value in values.items()}


@st.composite
def logs(draw: st.DrawFn) -> tuple[Run, pf.FusionConfig, float | None]:
    """A run of 2 to 4 s with its configuration, and the rate of the estimates."""
    axes = AXES[: draw(st.integers(1, 3))]
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    period = some(draw, 28 * MS, 20 * MS + 1)
    gaps = rng.choice([period, period, period, period + 3 * MS, 5, 4 * period], draw(st.integers(60, 110)))
    time = np.cumsum([0, *gaps])
    model = {
        axis: pf.AxisModel(
            plant=draw(plants()),
            gain=some(draw, pf.Gain(slope=0.0, intercept=1.0), PAPER),
            gain_recovery=some(draw, None, 0.1),
            delay=some(draw, None, 0.0, 0.033),
        )
        for axis in axes
    }
    level = st.sampled_from([0.0, 0.2e-3, 1e-3])
    noise = {
        axis: pf.Process(
            input_noise=draw(level), drift=draw(level), maneuver_noise=draw(level), maneuver_drift=10 * draw(level)
        )
        for axis in axes
    }
    command, near = {}, {}
    for axis in axes:
        command[axis] = 0.5 + np.cumsum(rng.normal(0.0, 0.5e-3, len(time)))
        command[axis][rng.random(len(time)) < 0.1] = np.nan
        command[axis][rng.random(len(time)) < 0.1] = 0.5  # there and back: a maneuver
        command[axis][0] = 0.5
        told = np.isfinite(command[axis])
        near[axis] = time[told], command[axis][told]
    names = draw(st.permutations(["tracker", "vision", "panel", "probe"]))[: draw(st.integers(1, 4))]
    known, streams = {}, {}
    for name in names:
        seen = axes if draw(st.booleans()) else axes[:1]
        known[name] = draw(sensors(axes))
        rate, first = some(draw, 12.0, 25.0, 60.0), some(draw, 0, 28 * MS, -100 * MS, 700 * MS)
        valid = every(rate, int(time[-1] / 1e9 * rate) + 3, first)
        positions = {axis: np.interp(valid, *near[axis]) for axis in seen}
        streams[name] = logged(rng, known[name], valid, positions, some(draw, 0.0, 0.3, 1.0))
    config = pf.FusionConfig(
        arm=pf.ArmModel(name="an arm", update_period=period / 1e9, delay=some(draw, 0.06045, 0.0, 0.056), axes=model),
        start=pf.Start(offset_sd=some(draw, 0.0, 1e-3, 5e-3)),
        process=noise,
        sensors=known,
    )
    order = rng.permutation(len(time)) if draw(st.booleans()) else np.arange(len(time))
    order = np.argsort(np.arange(len(time)) + 3.0 * rng.random(len(time)) * (order > len(time) // 2), kind="stable")
    told = {axis: value[order] for axis, value in command.items()}
    start = some(draw, {}, {axes[0]: 0.505})
    run = Run.from_arrays(time[order], told, {**streams, "stranger": streams[names[0]]}, start=start)
    return run, config, some(draw, None, 70.0)


# Where an unknown bias and a gate that reacquired leave only sums known, a backward pass loses digits in either engine:
# of 400 logs the two smoothers differ by more than 1e-9 sd in 18, by at most 2.4e-8 sd; the filters never by 5e-11.
SAME = {"filtered": 1e-9, "as-live": 1e-9, "smoothed": 1e-6}


def check_logs(count: int, mode: str) -> None:
    """``count`` logs, of which some have each outcome that a filter decides on or is told."""
    seen = dict.fromkeys(Outcome, 0)

    @settings(derandomize=True, deadline=None, max_examples=count)
    @given(logs())
    def check(log: tuple[Run, pf.FusionConfig, float | None]) -> None:
        run, config, rate = log
        got, wanted = both(run, config, mode, rate)
        assume(margin(wanted.measurements, config) > 1e-6)
        agree(got, wanted, SAME[mode])
        for outcome in Outcome:
            seen[outcome] += bool((wanted.measurements.outcome == outcome).any())

    check()
    for outcome in set(Outcome) - {Outcome.TOO_LATE}:
        assert seen[outcome] > count / 20, outcome


@pytest.mark.parametrize(
    "mode",
    ["filtered", pytest.param("smoothed", marks=pytest.mark.long), pytest.param("as-live", marks=pytest.mark.long)],
)
def test_both_engines_make_the_same_of_any_log(mode: str) -> None:
    """Random axes, sensors, gates, outliers, gaps, latencies: every component's fate and every estimate are the same."""
    check_logs(30, mode)


@pytest.mark.long
@pytest.mark.parametrize("mode", MODES)
def test_both_engines_make_the_same_of_many_logs(mode: str) -> None:
    """As above, of two hundred."""
    check_logs(200, mode)


# ---- wide priors ----------------------------------------------------------------------------------------------------

WIDE = {"offset": (1.0, {}), "bias": (5e-3, {"bias_sd": 1.0}), "both": (1.0, {"bias_sd": 1.0})}


def wide(kind: str, ratio: float) -> Case:
    """A panel and a tracker, with priors of 1 m that are ``ratio`` times a measurement's noise."""
    offset_sd, panel = WIDE[kind]
    heard = {
        "panel": Heard(ungated(1.0 / ratio, latency=0.004, scale=-1.0, **panel), every(40, 24, 2 * MS)),
        "tracker": Heard(ungated(1.0 / ratio, latency=0.008), every(90, 30, 240 * MS)),
    }
    return Case(one(UNDER), times=np.arange(24) * T, process=NOISE, offset_sd=offset_sd, heard=heard, rate=110.0)


# Offset and bias both unknown, one measurement tells their sum alone: what is left of it costs as many digits again.
RATIOS = [
    *((kind, ratio, 1e-9) for kind in ("offset", "bias") for ratio in (1e3, 1e4, 1e5)),
    *((kind, 1e6, 1e-6) for kind in ("offset", "bias")),
    *(("both", ratio, 1e-9) for ratio in (1e2, 1e3)),
    *(("both", ratio, 1e-6) for ratio in (1e4, 1e5, 1e6)),
]


@pytest.mark.parametrize("mode", ["filtered", "as-live"])
@pytest.mark.parametrize(("kind", "ratio", "tolerance"), RATIOS)
def test_engines_agree_while_priors_are_wide(kind: str, ratio: float, tolerance: float, mode: str) -> None:
    """To 1e-9 while a prior is up to 1e5 times a measurement's noise, to 1e-6 up to 1e6 times."""
    agree(*both(*wide(kind, ratio).made(), mode, 110.0), tolerance)


@pytest.mark.parametrize(("kind", "ratio", "tolerance"), RATIOS)
def test_smoothed_estimates_are_right_while_priors_are_wide(kind: str, ratio: float, tolerance: float) -> None:
    """Means and error bars of the compiled smoother are the joint Gaussian's, worked out with 50 digits."""
    run, config = wide(kind, ratio).made()
    estimates = pf.fuse(run, config, rate=110.0, smooth=True)
    belief = AxisOracle(run, config, "radial").smoothed(nanoseconds(estimates))
    for field in FIELDS:
        mean, sd, right, right_sd = (
            getattr(e, name) for e in (estimates["radial"], belief) for name in (field, f"{field}_sd")
        )
        _close(field, mean, sd, right, right_sd, tolerance)


# ---- scenarios and the shipped scan ---------------------------------------------------------------------------------

STORIES = sorted(path.stem for path in SCENARIOS.glob("*.toml") if "[trajectory]" in path.read_text())


@pytest.mark.long
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", STORIES)
def test_both_engines_make_the_same_of_a_scenario(name: str, mode: str) -> None:
    """Every scenario of the repository, whole: the same fates, estimates and error bars."""
    made = simulate(Scenario.load(SCENARIOS / f"{name}.toml"))
    got, wanted = both(made.run, made.config, mode)
    assert margin(wanted.measurements, made.config) > 1e-8
    agree(got, wanted)


@pytest.mark.long
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("sensors", [["tracker", "vision"], ["vision"], ["range", "vision"]], ids="+".join)
def test_both_engines_make_the_same_of_the_scan(sensors: list[str], mode: str) -> None:
    """The shipped scan with its own configuration: a camera's outliers, a tracker, a panel 1 m of bias away."""
    run, config = Run.read(DATA / "scan1"), pf.FusionConfig.load(DATA / "fusion.toml")
    known = {name: config.sensors[name] for name in sensors}
    config = msgspec.structs.replace(config, sensors=known)
    run = replace(run, sensors={name: run.sensors[name] for name in sensors})
    got, wanted = both(run, config, mode, 200.0)
    assert margin(wanted.measurements, config) > 1e-8
    agree(got, wanted)
