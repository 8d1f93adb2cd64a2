"""The compiled engine against the filterpy engine: the same outcomes, estimates, error bars, innovations, biases.

A measurement whose innovation is within rounding of its gate may be decided either way; none of those here comes that
near.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from fusion.test_oracle import LAG, MS, Case, cases, every, replace_
from fusion_oracle import AxisOracle, nanoseconds
from pumafuse.fusion.engine import Filtered, filter_segment
from pumafuse.fusion.segments import build_segment, output_times
from pumafuse.logs.run import Run
from pumafuse.model.arm import AxisModel

FIELDS = ("position", "velocity", "offset", "disturbance")


def both(run: Run, config: pf.FusionConfig, rate: float | None = None) -> tuple[Filtered, Filtered]:
    """What the compiled and the filterpy engine make of a run."""
    segment = build_segment(run, config)
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


# ---- any run --------------------------------------------------------------------------------------------------------


@st.composite
def gated(draw: st.DrawFn, bent: bool = False) -> Case:
    """Runs of the oracle, with two axes, gates, latencies that wander, an arm that is hardly known; or that bends."""

    def some(*values: Any) -> Any:
        return draw(st.sampled_from(values))

    case = draw(cases())
    seen = {
        name: replace(
            each,
            sensor=replace_(
                each.sensor, gate=some(0.0, 1.0, 2.0), latency_sd=some(0.0, 0.003), gate_rows=some(False, True)
            ),
        )
        for name, each in case.seen.items()
    }
    (model,) = case.axes.values()
    if bent:
        curve = pf.Sag(offset=1e-3, slope=-0.05, knee=0.5, slope_beyond=0.1, knee_below=0.49, slope_below=-0.9)
        bends = {"max_speed": some(0.01, 0.05), "play": some(0.2e-3, 3e-3), "sag": some(pf.Sag(slope=0.2), curve)}
        chosen = draw(st.sets(st.sampled_from(sorted(bends)), min_size=1))
        return replace(case, axes={"radial": replace_(model, **{name: bends[name] for name in chosen})}, seen=seen)
    doubts = {"lag_ci95": some(None, (0.08, 0.12)), "unseen_lag_sd": some(None, 0.015)}
    axes = {"radial": replace_(model, **doubts), "vertical": AxisModel(plant=LAG, delay=0.033)}
    return replace(case, axes=axes, seen=seen)


@settings(max_examples=30)
@given(gated())
def test_both_engines_make_the_same_of_any_run(case: Case) -> None:
    """Random delays, gains, noise, sensors, gates: every fate and estimate is the same."""
    agree(*both(*case.made(), case.rate))


@pytest.mark.long
@settings(max_examples=6)
@given(gated(bent=True))
def test_both_engines_make_the_same_of_an_axis_that_bends(case: Case) -> None:
    """A fastest speed, play and sag in closed form and by an ODE solver: every fate and estimate, to 1e-4 sd."""
    agree(*both(*case.made(), case.rate), 1e-4)


@pytest.mark.parametrize(("lasts", "pause"), [(0.3, 200.0), (1e-6, 0.0)])
def test_a_smooth_disturbance_is_forgotten_in_any_pause(lasts: float, pause: float) -> None:
    """Of 300 ms over 200 s, and of 1 ms and 1 µs over intervals of 28 ms: the same to 1e-9 sd."""
    time = 0.028 * np.arange(60)
    time[30:] += pause
    position = 0.01 * np.sin(3.0 * np.arange(60) * 0.028)
    run = pf.Run.from_arrays(time, {"x": position}, {"camera": (time + 0.01, {"x": position})})
    axes = {"x": AxisModel(plant=LAG)}
    config = pf.FusionConfig(
        arm=pf.ArmModel(name="one", update_period=0.028, delay=0.05, axes=axes),
        process={"x": pf.Process(disturbance_sd=1e-3, disturbance_time=lasts)},
        sensors={"camera": pf.Sensor(sd=1e-3)},
    )
    agree(*both(run, config))


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"rate": 0.0}, "rate must be positive and finite, got 0.0"),
        ({"engine": "fast"}, "no engine 'fast'; there are: compiled, filterpy"),
        ({"mode": "as live"}, "no mode 'as live'; there are: filtered, as-live, smoothed"),
        ({"mode": "as-live", "engine": "filterpy"}, "mode 'as-live' needs the compiled one"),
    ],
)
def test_a_way_that_there_is_not_is_refused(how: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        pf.fuse(*wide("offset", 1e3), **how)


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


@pytest.mark.long
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
