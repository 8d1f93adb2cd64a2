"""Numbers at the edge of what a configuration may say: estimates stay numbers, error bars are never less than nothing.

Every run goes through all three modes of the core, twice, with another run in between, and through its derivatives.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from fusion.test_innovations import beside, numbers
from pumafuse.filter.core import FINEST
from pumafuse.filter.outcome import Outcome
from pumafuse.fusion.engine import innovations, linearised
from pumafuse.fusion.estimates import Estimates
from pumafuse.fusion.segments import build
from pumafuse.logs.run import Run
from pumafuse.model.plants import Plant

MS = 1_000_000  # ns
DAY = 86_400_000 * MS
T = 28 * MS
MODES = {"filtered": {}, "smoothed": {"mode": "smoothed"}, "as-live": {"mode": "as-live"}}
FIELDS = ("position", "velocity", "offset")

PLANTS = {
    "lag": pf.FirstOrder(time_constant=0.04),
    "under-damped": pf.SecondOrder(natural_frequency=53.9, damping=0.4),
    "critical": pf.SecondOrder(natural_frequency=53.9, damping=1.0),
    "over-damped": pf.SecondOrder(natural_frequency=53.9, damping=20.0),
    "lag of 1 µs": pf.FirstOrder(time_constant=1e-6),
    "lag of 1000 s": pf.FirstOrder(time_constant=1e3),
    "fast": pf.SecondOrder(natural_frequency=1e4, damping=0.7),
    "fast, hardly damped": pf.SecondOrder(natural_frequency=1e4, damping=1e-6),
    "fast, stuck": pf.SecondOrder(natural_frequency=1e4, damping=1e4),
    "slow": pf.SecondOrder(natural_frequency=1e-3, damping=0.7),
    "slow, hardly damped": pf.SecondOrder(natural_frequency=1e-3, damping=1e-6),
    "slow, stuck": pf.SecondOrder(natural_frequency=1e-3, damping=1e4),
}
PAPER = pf.Gain(slope=0.0818, intercept=0.933)
PROCESSES = {
    "ordinary": pf.Process(input_noise=0.03e-3, drift=0.4e-3),
    "none": pf.Process(input_noise=0.0, drift=0.0),
    "huge": pf.Process(input_noise=1e3, drift=1e3),
    "huge input noise": pf.Process(input_noise=1e3, drift=0.0),
    "huge drift": pf.Process(input_noise=0.0, drift=1e3),
    "huge with maneuvers": pf.Process(input_noise=0.0, drift=0.0, maneuver_noise=1e3, maneuver_drift=1e3),
}


def sensor(sd: float = 0.05e-3, **kwargs: object) -> pf.Sensor:
    return pf.Sensor(sd=sd, gate=0.0, **kwargs)


def grid(count: int, step: int = 10 * MS, first: int = 0) -> np.ndarray:
    return first + step * np.arange(count)


@dataclass(frozen=True)
class Edge:
    """A run of one axis near 0.5 m: commands at ``commands`` [ns], each sensor's rows at ``rows``."""

    plant: Plant = PLANTS["under-damped"]
    process: pf.Process = PROCESSES["ordinary"]
    offset_sd: float = 5e-3
    delay: float = 0.06
    recovery: float | None = None
    commands: np.ndarray = field(default_factory=lambda: grid(12, T))
    sensors: Mapping[str, pf.Sensor] = field(default_factory=lambda: {"tracker": sensor(latency=0.008)})
    rows: np.ndarray | Mapping[str, np.ndarray] = field(default_factory=lambda: grid(40, first=3 * MS))
    values: Mapping[int, float] = field(default_factory=dict)  # by row: instead of the true one

    def made(self) -> tuple[Run, pf.FusionConfig]:
        rng = np.random.default_rng(5)
        command = 0.5 + rng.normal(0.0, 2e-3, len(self.commands))
        rows = self.rows if isinstance(self.rows, Mapping) else dict.fromkeys(self.sensors, self.rows)
        streams = {}
        for name, known in self.sensors.items():
            valid = rows[name]
            near = known.scale * np.interp(valid, self.commands, command) + rng.normal(0.0, 1e-3, len(valid))
            for row, value in self.values.items():
                near[row] = value
            if len(valid):
                streams[name] = valid + round(known.latency * 1e9), {"radial": near}
        model = pf.AxisModel(plant=self.plant, gain=PAPER, gain_recovery=self.recovery)
        config = pf.FusionConfig(
            arm=pf.ArmModel(name="an arm", update_period=0.028, delay=self.delay, axes={"radial": model}),
            start=pf.Start(offset_sd=self.offset_sd),
            process={"radial": self.process},
            sensors=dict(self.sensors),
        )
        return Run.from_arrays(self.commands, {"radial": command}, streams), config


def fused(edge: Edge, mode: str, rate: float | None = None) -> Estimates:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pf.PumafuseWarning)  # much of it is worth a warning; numpy's stay errors
        return pf.fuse(*edge.made(), rate=rate, **MODES[mode])


def parts(estimates: Estimates) -> dict[str, np.ndarray]:
    """Everything that is computed."""
    found = {f"{axis} {name}": getattr(of, name) for axis, of in estimates.axes.items() for name in of.FIELDS}
    found |= {name: getattr(estimates.measurements, name) for name in ("innovation", "innovation_sd", "outcome")}
    return found | {
        f"bias of {name}": np.array([bias.value, bias.sd])
        for name, of in estimates.biases.items()
        for bias in of.values()
    }


BETWEEN = Edge(PLANTS["lag"], sensors={"other": pf.Sensor(sd=3e-4, bias_sd=0.2, gate=1.0), "tracker": sensor(1e-3)})


def check(edge: Edge, rate: float | None = None) -> dict[str, Estimates]:
    """All modes: finite estimates, error bars not negative, and the same bits again after another run."""
    found = {mode: fused(edge, mode, rate) for mode in MODES}
    for mode, estimates in found.items():
        assert len(estimates.time)
        measurements = estimates.measurements
        for axis in estimates.axes:
            for name in FIELDS:
                mean, sd = getattr(estimates[axis], name), getattr(estimates[axis], f"{name}_sd")
                if (mode, name) == ("smoothed", "velocity"):  # nobody has one
                    assert np.isnan(mean).all()
                    assert np.isnan(sd).all()
                    continue
                assert np.isfinite(mean).all(), (mode, name)
                assert np.isfinite(sd).all(), (mode, name)
                assert (sd >= 0.0).all(), (mode, name)
        decided = measurements.outcome <= Outcome.REACQUIRED
        assert np.isfinite(measurements.innovation[decided]).all(), mode
        assert np.isfinite(measurements.innovation_sd[decided]).all(), mode
        assert (measurements.innovation_sd[decided] > 0.0).all(), mode
        assert np.isnan(measurements.innovation[~decided]).all(), mode
        for of in estimates.biases.values():
            for bias in of.values():
                assert np.isfinite(bias.value)
                assert 0.0 <= bias.sd < np.inf
        fused(BETWEEN, mode, 33.0)
        again = parts(fused(edge, mode, rate))
        for name, one in parts(estimates).items():
            assert one.tobytes() == again[name].tobytes(), (mode, name)
    check_derivatives(*edge.made())
    return found


def check_derivatives(run: Run, config: pf.FusionConfig) -> None:
    """By every number of the configuration: finite."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pf.PumafuseWarning)
        segment = build(run, config)
    outcome, each = innovations(segment, config).outcome, [beside(config, path) for path in numbers(config, "radial")]
    assert all(np.isfinite(one).all() for one in linearised(segment, config, outcome, each)[1:])


# ---- each extreme beside every plant --------------------------------------------------------------------------------


any_plant = pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS.keys())


@pytest.mark.parametrize("offset_sd", [0.0, 1e3])
def test_without_noise_an_offset_is_a_mean(offset_sd: float) -> None:
    """A certain one keeps every error bar at the least that there is, which is not 0, whatever is measured.

    An unknown one is the mean of the measurements.
    """
    for mode, estimates in check(Edge(process=PROCESSES["none"], offset_sd=offset_sd), 170.0).items():
        radial = estimates["radial"]
        assert mode == "smoothed" or (radial.velocity_sd == FINEST / 0.028).all()
        if offset_sd == 0.0:
            assert (radial.position_sd == FINEST).all()
            assert not radial.offset.any()
        else:
            measurements, live = estimates.measurements, mode == "as-live"
            known = (measurements.stamp if live else measurements.time) <= (
                np.inf if mode == "smoothed" else estimates.time[-1]
            )
            assert radial.position_sd[-1] == pytest.approx(0.05e-3 / np.sqrt(known.sum()), rel=1e-6)


@any_plant
def test_a_day_of_rest_forgets_the_plant_and_widens_the_offset(plant: Plant) -> None:
    """After it the error bars are what noise alone makes of them: stationary for the plant, a walk for the offset."""
    edge = Edge(plant, commands=np.array([0, DAY]), rows=grid(20))
    if isinstance(plant, pf.FirstOrder):
        slowest, stationary = 1.0 / plant.time_constant, 0.5 / plant.time_constant
    else:
        omega, zeta = plant.natural_frequency, plant.damping
        slowest = omega / (zeta + np.sqrt(zeta**2 - 1.0)) if zeta > 1.0 else zeta * omega
        stationary = omega / (4.0 * zeta)
    radial = check(edge)["filtered"]["radial"]
    walked = radial.offset_sd[-1] ** 2
    assert walked == pytest.approx(0.4e-3**2 * 86_400.0, rel=1e-4)
    if slowest * 86_400.0 > 20.0:
        assert radial.position_sd[-1] ** 2 - walked == pytest.approx(0.03e-3**2 * stationary, rel=1e-3)


def test_no_measurements_is_a_run() -> None:
    """No sensor at all, a sensor without rows, and one with rows only before the first command."""
    plain = check(Edge(sensors={}))
    early = Edge(rows=grid(10, first=-2000 * MS))
    for mode, estimates in check(early).items():
        assert set(estimates.measurements.outcome) == {Outcome.BEFORE_START}
        for name, values in parts(plain[mode]).items():
            if name.startswith("radial"):
                np.testing.assert_array_equal(parts(estimates)[name], values)
    check(Edge(rows=grid(0)))


# ---- measurements that are no measurements ---------------------------------------------------------------------------

SENTINELS = [np.nan, np.inf, -np.inf, 1e300, -1e300, 3.4e38, 1e6, -1.8e308]


@pytest.mark.parametrize("gate", [0.0, 5.0])
@pytest.mark.parametrize("value", SENTINELS)
def test_a_value_that_is_none_leaves_no_trace(value: float, gate: float) -> None:
    """NaN, infinities and sentinels are invalid, and the estimates are those without the row, bit for bit."""
    known = {"tracker": pf.Sensor(sd=1e-3, latency=0.008, gate=gate), "other": pf.Sensor(sd=1e-3, gate=gate)}
    rows = grid(40, first=3 * MS)
    spoilt = Edge(sensors=known, rows=rows, values={0: value, 7: value, 8: value, 39: value})
    wanted = replace(spoilt, values={0: np.nan, 7: np.nan, 8: np.nan, 39: np.nan})
    for mode, estimates in check(spoilt, 170.0).items():
        assert (estimates.measurements.outcome == Outcome.INVALID).sum() == 8
        without = parts(fused(wanted, mode, 170.0))
        for name, values in parts(estimates).items():
            assert values.tobytes() == without[name].tobytes(), (mode, name)


def test_a_sensor_that_is_never_right_re_acquires_and_nothing_breaks() -> None:
    """A thousand kilometres off, again and again: the offset follows each time."""
    off = {row: 9.9e5 * (-1.0) ** (row // 70) for row in range(300)}
    edge = Edge(
        commands=grid(120, T), sensors={"tracker": pf.Sensor(sd=1e-6, gate=3.0)}, rows=grid(300), values=off
    )  # fmt: skip
    for estimates in check(edge, 170.0).values():
        assert (estimates.measurements.outcome == Outcome.REACQUIRED).sum() >= 3
        assert np.abs(estimates["radial"].offset).max() > 9e5


# ---- all together ---------------------------------------------------------------------------------------------------


@st.composite
def edges(draw: st.DrawFn) -> tuple[Edge, float | None]:
    known = {
        f"s{number}": pf.Sensor(
            sd=draw(st.sampled_from([1e-9, 1e-6, 1e-3, 1.0, 1e3])),
            latency=draw(st.sampled_from([0.0, 0.008, 1.0, -0.5])),
            latency_sd=draw(st.sampled_from([0.0, 1e-3, 10.0])),
            scale=draw(st.sampled_from([1.0, -1.0, 1e-6, 1e6])),
            bias_sd=draw(st.sampled_from([0.0, 1e-9, 1.0, 1e3])),
            gate=draw(st.sampled_from([0.0, 1e-3, 5.0, 1e6])),
            gate_rows=draw(st.booleans()),
        )
        for number in range(draw(st.integers(0, 8)))
    }
    steps = st.sampled_from([1, 1000, MS, 10 * MS, 1000 * MS, DAY])
    rows = {
        name: np.cumsum([draw(st.sampled_from([-MS, 0, 60 * MS])), *draw(st.lists(steps, max_size=12))])
        for name in known
    }
    edge = Edge(
        plant=draw(st.sampled_from(list(PLANTS.values()))),
        process=draw(st.sampled_from(list(PROCESSES.values()))),
        offset_sd=draw(st.sampled_from([0.0, 1e-9, 5e-3, 1e3])),
        delay=draw(st.sampled_from([0.0, 1e-9, 0.028, 0.06, 10.0])),
        recovery=draw(st.sampled_from([None, 1e-9, 0.04, 1e6])),
        commands=np.cumsum([0, *draw(st.lists(steps, max_size=10))]),
        sensors=known,
        rows=rows,
    )
    return edge, draw(st.sampled_from([None, None, 1e-3]))


@pytest.mark.long
@settings(max_examples=100)
@given(edges())
def test_extremes_may_meet(made: tuple[Edge, float | None]) -> None:
    """Any of them together: estimates stay numbers, and the same bits come again."""
    check(*made)
