"""The compiled engine against the filterpy engine: the same outcomes, estimates, error bars, innovations, biases.

A measurement whose innovation is within rounding of its gate may be decided either way; none of those here comes that
near.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from fusion_oracle import AxisOracle, nanoseconds
from pumafuse.filter.outcome import Outcome
from pumafuse.fusion.engine import Filtered, filter_segment
from pumafuse.fusion.estimates import Mode
from pumafuse.fusion.segments import build, output_times
from pumafuse.logs.run import Run
from pumafuse.model.plants import Plant

MS = 1_000_000  # ns
FIELDS = ("position", "velocity", "offset", "disturbance")
DATA = Path(pf.__file__).parent / "data"
PAPER = pf.Gain(slope=0.0818, intercept=0.933, intercept_ci95=(0.9, 0.95))


def both(run: Run, config: pf.FusionConfig, rate: float | None = None) -> tuple[Filtered, Filtered]:
    """What the compiled and the filterpy engine make of a run."""
    segment = build(run, config)
    times = output_times(segment, config, rate)
    compiled = filter_segment(segment, config, times, "filtered")
    return compiled, filter_segment(segment, config, times, "filtered", "filterpy")


def agree(got: Filtered, wanted: Filtered, tolerance: float = 1e-9) -> None:
    """Outcomes are equal, means agree to ``tolerance`` sd + 1e-12 (m, m/s), variances to ``tolerance``."""
    np.testing.assert_array_equal(got.results.outcome, wanted.results.outcome)
    np.testing.assert_array_equal(got.results.contradicts, wanted.results.contradicts)
    pairs = [(part.results.innovation, part.results.innovation_sd) for part in (got, wanted)]
    _close("innovation", *pairs[0], *pairs[1], tolerance)
    agree_on_axes(got.axes, wanted.axes, tolerance)
    assert got.biases.keys() == wanted.biases.keys()
    for name, of in wanted.biases.items():
        assert got.biases[name].keys() == of.keys()
        for axis, bias in of.items():
            mine = got.biases[name][axis]
            _close(f"bias of {name} on {axis}", *map(np.array, (mine.value, mine.sd, bias.value, bias.sd)), tolerance)


def agree_on_axes(
    got: Mapping[str, pf.AxisEstimate], wanted: Mapping[str, pf.AxisEstimate], tolerance: float = 1e-9
) -> None:
    assert tuple(got) == tuple(wanted)
    for axis in wanted:
        for field in FIELDS:
            mine, theirs = ((getattr(of[axis], field), getattr(of[axis], f"{field}_sd")) for of in (got, wanted))
            assert not np.isnan(theirs).any()
            _close(f"{axis} {field}", *mine, *theirs, tolerance)


def _close(
    what: str, mean: np.ndarray, sd: np.ndarray, right: np.ndarray, right_sd: np.ndarray, tolerance: float
) -> None:
    np.testing.assert_array_equal(np.isnan(mean), np.isnan(right), err_msg=what)
    known = ~np.isnan(right)
    np.testing.assert_array_less(np.abs(mean - right)[known] - tolerance * right_sd[known], 1e-12, err_msg=what)
    np.testing.assert_allclose(sd[known] ** 2, right_sd[known] ** 2, rtol=tolerance, atol=0.0, err_msg=f"{what}, sd")


# ---- whole logs: several axes and sensors, gates that reject and re-acquire, all a logger does --------------------

AXES = ("tangential", "radial", "vertical")
OFF = 0.05  # m


def every(rate: float, count: int, first: int = 0) -> np.ndarray:
    return first + np.rint(np.arange(count) * 1e9 / rate).astype(np.int64)


@st.composite
def plants(draw: st.DrawFn) -> Plant:
    if draw(st.booleans()):
        return pf.FirstOrder(time_constant=draw(st.floats(0.01, 0.1)))
    damping = st.floats(0.3, 3.0) | st.sampled_from([1.0, 1.0 + 1e-9, 1.0 - 1e-7])
    return pf.SecondOrder(natural_frequency=draw(st.floats(15.0, 90.0)), damping=draw(damping))


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
        bias_drift_sd=some(draw, 0.0, 1e-3),
        bias_time=some(draw, 0.05, 10.0),
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
def bends(draw: st.DrawFn) -> dict[str, object]:
    """A fastest speed, play and sag, one of them at least."""
    curve = pf.Sag(offset=1e-3, slope=-0.05, knee=0.5, slope_beyond=0.1, knee_below=0.49, slope_below=-0.9)
    one = {
        "max_speed": some(draw, 0.01, 0.05),
        "play": some(draw, 0.2e-3, 3e-3),
        "sag": some(draw, pf.Sag(slope=0.2), curve),
    }
    return {key: one[key] for key in draw(st.sets(st.sampled_from(sorted(one)), min_size=1))}


@st.composite
def logs(draw: st.DrawFn, bent: bool = False) -> tuple[Run, pf.FusionConfig, float | None]:
    """A run of 2 to 4 s with its configuration, and the rate of the estimates; of one axis that is ``bent``."""
    axes = AXES[: 1 if bent else draw(st.integers(1, 3))]
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    period = some(draw, 28 * MS, 20 * MS + 1)
    gaps = rng.choice([period, period, period, period + 3 * MS, 5, 4 * period], draw(st.integers(60, 110)))
    time = np.cumsum([0, *gaps])
    model = {
        axis: pf.AxisModel(
            plant=draw(plants()),
            gain=some(draw, pf.Gain(slope=0.0, intercept=1.0), pf.Gain(slope=0.0, intercept=0.8), PAPER),
            gain_recovery=some(draw, None, 0.1, 0.004, 3.0),
            delay=some(draw, None, 0.0, 0.033),
            lag_ci95=some(draw, None, (0.08, 0.12)),
            **(draw(bends()) if bent else {}),
        )
        for axis in axes
    }
    level = st.sampled_from([0.0, 0.2e-3, 1e-3])
    noise = {
        axis: pf.Process(
            input_noise=draw(level),
            drift=draw(level),
            maneuver_noise=draw(level),
            maneuver_drift=10 * draw(level),
            disturbance_sd=some(draw, 0.0, 1e-3),
            disturbance_time=some(draw, 0.02, 0.1, 3.0),
            disturbance_kind=some(draw, "matern", "ou"),
        )
        for axis in axes
    }
    command, near = {}, {}
    for axis in axes:
        command[axis] = 0.5 + np.cumsum(rng.normal(0.0, 0.5e-3, len(time)))
        command[axis][rng.random(len(time)) < 0.1] = np.nan
        command[axis][rng.random(len(time)) < 0.1] = 0.5  # there and back: a maneuver
        command[axis][0] = 0.5
        given = np.isfinite(command[axis])
        near[axis] = time[given], command[axis][given]
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
    shuffled = {axis: value[order] for axis, value in command.items()}
    start = some(draw, {}, {axes[0]: 0.505})
    run = Run.from_arrays(time[order], shuffled, {**streams, "stranger": streams[names[0]]}, start=start)
    return run, config, some(draw, None, 70.0)


def test_both_engines_make_the_same_of_any_log() -> None:
    """Random axes, delays, gains, noise, sensors, gates, outliers, gaps: every fate and estimate is the same."""
    seen = dict.fromkeys(Outcome, 0)

    @settings(max_examples=12)
    @given(logs())
    def check(log: tuple[Run, pf.FusionConfig, float | None]) -> None:
        got, wanted = both(*log)
        agree(got, wanted)
        for outcome in Outcome:
            seen[outcome] += bool((wanted.results.outcome == outcome).any())

    check()
    decided_before = {Outcome.TOO_LATE, Outcome.STRAY, Outcome.HELD}
    assert all(seen[outcome] for outcome in set(Outcome) - decided_before)


@pytest.mark.long
@settings(max_examples=6)
@given(logs(bent=True))
def test_both_engines_make_the_same_of_an_axis_that_bends(log: tuple[Run, pf.FusionConfig, float | None]) -> None:
    """A fastest speed, play and sag in closed form and by an ODE solver: every fate and estimate, to 1e-4 sd."""
    agree(*both(*log), 1e-4)


@pytest.mark.parametrize(("lasts", "pause"), [(0.3, 200.0), (0.001, 0.0), (1e-6, 0.0)])
def test_a_smooth_disturbance_is_forgotten_in_any_pause(lasts: float, pause: float) -> None:
    """Of 300 ms over 200 s, and of 1 ms and 1 µs over intervals of 28 ms: the same to 1e-9 sd."""
    time = 0.028 * np.arange(60)
    time[30:] += pause
    position = 0.01 * np.sin(3.0 * np.arange(60) * 0.028)
    run = pf.Run.from_arrays(time, {"x": position}, {"camera": (time + 0.01, {"x": position})})
    arm = pf.ArmModel(
        name="one", update_period=0.028, delay=0.05, axes={"x": pf.AxisModel(plant=pf.FirstOrder(time_constant=0.04))}
    )
    process = {"x": pf.Process(disturbance_sd=1e-3, disturbance_time=lasts)}
    config = pf.FusionConfig(arm=arm, process=process, sensors={"camera": pf.Sensor(sd=1e-3)})
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        warnings.simplefilter("ignore", pf.PumafuseWarning)
        got, wanted = pf.fuse(run, config)["x"], pf.fuse(run, config, engine="filterpy")["x"]
    assert np.abs(got.position - wanted.position).max() < 1e-9 * got.position_sd.min()
    assert got.position_sd == pytest.approx(wanted.position_sd, rel=1e-9)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
def test_fuse_by_filterpy_says_the_same_of_the_scan() -> None:
    """Measurements, notes and estimates of `fuse` by either engine, of 10 s with all its sensors; progress goes up."""
    run, config = Run.read(DATA / "scan1").between(until=10.0), pf.FusionConfig.load(DATA / "fusion.toml")
    done: list[float] = []
    got, wanted = pf.fuse(run, config), pf.fuse(run, config, engine="filterpy", progress=done.append)
    assert (got.engine, wanted.engine) == ("compiled", "filterpy")
    assert got.notes == wanted.notes
    for name in ("time", "stamp", "sensor", "axis", "value", "outcome"):
        np.testing.assert_array_equal(getattr(got.measurements, name), getattr(wanted.measurements, name))
    agree_on_axes(got.axes, wanted.axes)
    assert done == sorted(done)


@pytest.mark.parametrize("mode", ["smoothed", "as-live"])
def test_filterpy_only_filters(mode: Mode) -> None:
    with pytest.raises(ValueError, match=f"mode '{mode}' needs the compiled one"):
        pf.fuse(*wide("offset", 1e3), engine="filterpy", mode=mode)


# ---- wide priors ----------------------------------------------------------------------------------------------------

WIDE = {"offset": (1.0, 0.0), "bias": (5e-3, 1.0), "both": (1.0, 1.0)}  # offset_sd and bias_sd, m


def wide(kind: str, ratio: float) -> tuple[Run, pf.FusionConfig]:
    """A panel and a tracker, with priors of 1 m that are ``ratio`` times a measurement's noise."""
    offset_sd, bias_sd = WIDE[kind]
    rng, commands = np.random.default_rng(1), 28 * MS * np.arange(24)
    u, panel, tracker = 0.5 + rng.uniform(-0.005, 0.005, 24), every(40, 24, 2 * MS), every(90, 30, 240 * MS)
    panel_value = -np.interp(panel, commands, u) + rng.normal(0.0, 1e-3, 24) + bias_sd * 0.7
    tracker_value = np.interp(tracker, commands, u) + rng.normal(0.0, 1e-3, 30)
    streams = {
        "panel": (panel + 4 * MS, {"radial": panel_value}),
        "tracker": (tracker + 8 * MS, {"radial": tracker_value}),
    }
    plant = pf.SecondOrder(natural_frequency=45.0, damping=0.4)
    config = pf.FusionConfig(
        arm=pf.ArmModel(name="an arm", update_period=0.028, delay=0.06045, axes={"radial": pf.AxisModel(plant=plant)}),
        start=pf.Start(offset_sd=offset_sd),
        process={"radial": pf.Process(input_noise=0.3e-3, drift=0.8e-3, maneuver_noise=0.5e-3, maneuver_drift=5e-3)},
        sensors={
            "panel": pf.Sensor(sd=1.0 / ratio, latency=0.004, scale=-1.0, bias_sd=bias_sd, gate=0.0),
            "tracker": pf.Sensor(sd=1.0 / ratio, latency=0.008, gate=0.0),
        },
    )
    return Run.from_arrays(commands, {"radial": u}, streams), config


# Offset and bias both unknown, one measurement tells their sum alone: what is left of it costs as many digits again.
RATIOS = [
    *((kind, ratio, 1e-9) for kind in ("offset", "bias") for ratio in (1e3, 1e5)),
    *((kind, 1e6, 1e-6) for kind in ("offset", "bias")),
    *(("both", ratio, tolerance) for ratio, tolerance in ((1e3, 1e-9), (1e4, 1e-6), (1e6, 1e-6))),
]


@pytest.mark.parametrize(("kind", "ratio", "tolerance"), RATIOS)
def test_estimates_are_right_while_priors_are_wide(kind: str, ratio: float, tolerance: float) -> None:
    """Up to 1e5 times a measurement's noise to 1e-9, to 1e6 times to 1e-6.

    Both engines agree, and the smoother's means and error bars are the joint Gaussian's, worked out with 50 digits.
    """
    run, config = wide(kind, ratio)
    agree(*both(run, config, 110.0), tolerance)
    estimates = pf.fuse(run, config, rate=110.0, mode="smoothed")
    belief = AxisOracle(run, config, "radial").smoothed(nanoseconds(estimates))
    for field in ("position", "offset"):
        mean, sd, right, right_sd = (
            getattr(e, name) for e in (estimates["radial"], belief) for name in (field, f"{field}_sd")
        )
        _close(field, mean, sd, right, right_sd, tolerance)
