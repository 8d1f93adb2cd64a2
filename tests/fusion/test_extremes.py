"""Numbers at the edge of what a configuration may say: estimates stay numbers, error bars are never less than nothing.

Every run goes through all three modes of the core, twice, with another run in between, and through its derivatives.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from fusion.test_innovations import near, numbers
from fusion.test_oracle import MODES, MS, PAPER, Case, Seen, T, one, replace_, sensor
from pumafuse.filter.core import FINEST
from pumafuse.filter.outcome import Outcome
from pumafuse.fusion.engine import innovation_derivatives, innovations
from pumafuse.fusion.segments import build_segment
from pumafuse.logs.run import Run
from pumafuse.model.plants import Plant

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")  # numpy's stay errors
DAY = 86_400_000 * MS
FIELDS = ("position", "velocity", "offset")
PLANTS: dict[str, Plant] = {
    "lag": pf.FirstOrder(time_constant=0.04),
    "lag of 1 µs": pf.FirstOrder(time_constant=1e-6),
    "lag of 1000 s": pf.FirstOrder(time_constant=1e3),
} | {
    f"{speed}, {how}": pf.SecondOrder(natural_frequency=omega, damping=damping)
    for speed, omega in (("fast", 1e4), ("slow", 1e-3))
    for how, damping in (("hardly damped", 1e-6), ("critical", 1.0), ("stuck", 1e4))
}
UNDER = pf.SecondOrder(natural_frequency=53.9, damping=0.4)
ORDINARY, NONE = pf.Process(input_noise=0.03e-3, drift=0.4e-3), pf.Process(input_noise=0.0, drift=0.0)
PROCESSES = [
    ORDINARY,
    NONE,
    *(pf.Process(input_noise=noise, drift=drift) for noise, drift in ((1e3, 1e3), (1e3, 0.0), (0.0, 1e3))),
    replace_(NONE, maneuver_noise=1e3, maneuver_drift=1e3),
]
ROWS = 3 * MS + 10 * MS * np.arange(40)


def edge(plant: Plant = UNDER, recovery: float | None = None, **changes: Any) -> Case:
    """A run of one axis that a tracker sees."""
    usual: dict[str, Any] = {"times": np.arange(12) * T, "process": ORDINARY, "seen": {"tracker": Seen(READ, ROWS)}}
    return Case(one(plant, gain=PAPER, gain_recovery=recovery), **usual | changes)


READ = sensor(latency=0.008)
BETWEEN = edge(PLANTS["lag"], seen={"other": Seen(pf.Sensor(sd=3e-4, bias_sd=0.2, gate=1.0), ROWS)})


def parts(estimates: pf.Estimates) -> dict[str, np.ndarray]:
    """Everything that is computed."""
    found = {f"{axis} {name}": getattr(of, name) for axis, of in estimates.axes.items() for name in of.FIELDS}
    found |= {name: getattr(estimates.measurements, name) for name in ("innovation", "innovation_sd", "outcome")}
    return found | {
        f"bias of {name}": np.array([bias.value, bias.sd])
        for name, of in estimates.biases.items()
        for bias in of.values()
    }


def check(run: Run, config: pf.FusionConfig, rate: float | None = None) -> dict[str, pf.Estimates]:
    """All modes: finite estimates, error bars not negative, and the same bits again after another run."""
    found = {mode: pf.fuse(run, config, rate=rate, **how) for mode, how in MODES.items()}
    for mode, estimates in found.items():
        measurements, known = estimates.measurements, parts(estimates)
        assert len(estimates.time)
        for name in FIELDS:
            mean, sd = known[f"radial {name}"], known[f"radial {name}_sd"]
            if (mode, name) == ("smoothed", "velocity"):  # nobody has one
                assert np.isnan([mean, sd]).all()
            else:
                assert np.isfinite([mean, sd]).all() and (sd >= 0.0).all(), (mode, name)
        decided = measurements.outcome <= Outcome.REACQUIRED
        assert np.isfinite([measurements.innovation[decided], measurements.innovation_sd[decided]]).all(), mode
        assert (measurements.innovation_sd[decided] > 0.0).all(), mode
        assert np.isnan(measurements.innovation[~decided]).all(), mode
        assert all(np.isfinite(value).all() and value[1] >= 0.0 for key, value in known.items() if "bias" in key)
        pf.fuse(*BETWEEN.made(), rate=33.0, **MODES[mode])
        again = parts(pf.fuse(run, config, rate=rate, **MODES[mode]))
        for name, value in known.items():
            assert value.tobytes() == again[name].tobytes(), (mode, name)
    segment = build_segment(run, config)
    outcome, each = innovations(segment, config).outcome, [near(config, path) for path in numbers(config, "radial")]
    assert all(
        np.isfinite(derivatives).all() for derivatives in innovation_derivatives(segment, config, outcome, each)[1:]
    )
    return found


# ---- each extreme beside every plant --------------------------------------------------------------------------------


@pytest.mark.parametrize("offset_sd", [0.0, 1e3])
def test_without_noise_an_offset_is_a_mean(offset_sd: float) -> None:
    """A certain one keeps every error bar at the least that there is, which is not 0, whatever is measured.

    An unknown one is the mean of the measurements.
    """
    for mode, estimates in check(*edge(process=NONE, offset_sd=offset_sd).made(), 170.0).items():
        radial, measurements = estimates["radial"], estimates.measurements
        assert mode == "smoothed" or (radial.velocity_sd == FINEST / 0.028).all()
        if offset_sd == 0.0:
            assert (radial.position_sd == FINEST).all() and not radial.offset.any()
        else:
            since = measurements.stamp if mode == "as_live" else measurements.time
            known = since <= (np.inf if mode == "smoothed" else estimates.time[-1])
            assert radial.position_sd[-1] == pytest.approx(0.05e-3 / np.sqrt(known.sum()), rel=1e-6)


@pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS.keys())
def test_a_day_of_rest_forgets_the_plant_and_widens_the_offset(plant: Plant) -> None:
    """After it the error bars are what noise alone makes of them: stationary for the plant, a walk for the offset."""
    if isinstance(plant, pf.FirstOrder):
        slowest, stationary = 1.0 / plant.time_constant, 0.5 / plant.time_constant
    else:
        omega, zeta = plant.natural_frequency, plant.damping
        slowest = omega / (zeta + np.sqrt(zeta**2 - 1.0)) if zeta > 1.0 else zeta * omega
        stationary = omega / (4.0 * zeta)
    rested = edge(plant, times=np.array([0, DAY]), seen={"tracker": Seen(READ, 10 * MS * np.arange(20))})
    radial = check(*rested.made())["filtered"]["radial"]
    walked = radial.offset_sd[-1] ** 2
    assert walked == pytest.approx(0.4e-3**2 * 86_400.0, rel=1e-4)
    if slowest * 86_400.0 > 20.0:
        assert radial.position_sd[-1] ** 2 - walked == pytest.approx(0.03e-3**2 * stationary, rel=1e-3)


# ---- measurements that are no measurements ---------------------------------------------------------------------------


def spoilt(case: Case, values: Mapping[int, float]) -> tuple[Run, pf.FusionConfig]:
    """The case with some rows of all its sensors replaced."""
    run, config = case.made()
    for source in run.sensors.values():
        source.values["radial"][list(values)] = list(values.values())
    return run, config


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e6])
def test_a_value_that_is_none_leaves_no_trace(value: float) -> None:
    """NaN, infinities and sentinels are invalid, and the estimates are those without the row, bit for bit."""
    case = edge(seen={f"gate {gate}": Seen(pf.Sensor(sd=1e-3, gate=gate), ROWS) for gate in (0.0, 5.0)})
    without = spoilt(case, dict.fromkeys((0, 7, 8, 39), np.nan))
    for mode, estimates in check(*spoilt(case, dict.fromkeys((0, 7, 8, 39), value)), 170.0).items():
        assert (estimates.measurements.outcome == Outcome.INVALID).sum() == 8
        wanted = parts(pf.fuse(*without, rate=170.0, **MODES[mode]))
        for name, values in parts(estimates).items():
            assert values.tobytes() == wanted[name].tobytes(), (mode, name)


def test_a_sensor_that_is_never_right_re_acquires_and_nothing_breaks() -> None:
    """A thousand kilometres off, again and again: the offset follows each time."""
    seen = {"tracker": Seen(pf.Sensor(sd=1e-6, gate=3.0), 10 * MS * np.arange(300))}
    off = {row: 9.9e5 * (-1.0) ** (row // 70) for row in range(300)}
    for estimates in check(*spoilt(edge(times=np.arange(120) * T, seen=seen), off), 170.0).values():
        assert (estimates.measurements.outcome == Outcome.REACQUIRED).sum() >= 3
        assert np.abs(estimates["radial"].offset).max() > 9e5


# ---- all together ---------------------------------------------------------------------------------------------------


@st.composite
def edges(draw: st.DrawFn) -> Case:
    def some(*values: Any) -> Any:
        return draw(st.sampled_from(values))

    steps = st.sampled_from([1, 1000, MS, 10 * MS, 1000 * MS, DAY])
    seen = {
        f"s{number}": Seen(
            pf.Sensor(
                sd=some(1e-9, 1e-6, 1e-3, 1.0, 1e3),
                latency=some(0.0, 0.008, 1.0, -0.5),
                latency_sd=some(0.0, 1e-3, 10.0),
                scale=some(1.0, -1.0, 1e-6, 1e6),
                bias_sd=some(0.0, 1e-9, 1.0, 1e3),
                gate=some(0.0, 1e-3, 5.0, 1e6),
                gate_rows=draw(st.booleans()),
            ),
            np.cumsum([some(-MS, 0, 60 * MS), *draw(st.lists(steps, max_size=12))]),
        )
        for number in range(draw(st.integers(0, 8)))
    }
    case = edge(
        some(*PLANTS.values()),
        some(None, 1e-9, 0.04, 1e6),
        process=some(*PROCESSES),
        offset_sd=some(0.0, 1e-9, 5e-3, 1e3),
        delay=some(0.0, 1e-9, 0.028, 0.06, 10.0),
        times=np.cumsum([0, *draw(st.lists(steps, max_size=10))]),
        seen=seen,
    )
    return replace(case, rate=some(None, None, 1e-3))


@pytest.mark.long
@settings(max_examples=100)
@given(edges())
def test_extremes_may_meet(case: Case) -> None:
    """Any of them together: estimates stay numbers, and the same bits come again."""
    check(*case.made(), case.rate)
