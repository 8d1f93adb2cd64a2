"""The filter against the conditional Gaussian of section 2 of the design, worked out without any filter."""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from fusion_oracle import AxisOracle, check_estimates, check_innovations, nanoseconds
from pumafuse.errors import PumafuseWarning
from pumafuse.filter.core import Filter, Model
from pumafuse.filter.events import Events, Results
from pumafuse.filter.outcome import Outcome
from pumafuse.filter.response import response
from pumafuse.fusion.config import FusionConfig, Process, Sensor, Start
from pumafuse.fusion.engine import model_of
from pumafuse.fusion.estimates import Estimates, Mode
from pumafuse.fusion.offline import fuse
from pumafuse.fusion.segments import build_segment
from pumafuse.logs.run import Run
from pumafuse.logs.source import Source
from pumafuse.model.arm import ArmModel, AxisModel, Gain
from pumafuse.model.plants import FirstOrder, Plant, SecondOrder

MS = 1_000_000  # ns
T = 28 * MS
UNDER, CRITICAL, OVER = (SecondOrder(natural_frequency=45.0, damping=damping) for damping in (0.4, 1.0, 1.8))
LAG = FirstOrder(time_constant=0.0425)
replace_ = msgspec.structs.replace
NOISE = Process(input_noise=0.3e-3, drift=0.8e-3, maneuver_noise=0.5e-3, maneuver_drift=5e-3)
PAPER = Gain(slope=0.0818, intercept=0.933)


@dataclass(frozen=True)
class Seen:
    """A sensor and when its measurements are valid [ns since the first command], on ``axes`` (all for None)."""

    sensor: Sensor
    valid: np.ndarray
    axes: tuple[str, ...] | None = None
    missing: float = 0.0  # share of components that are NaN


def sensor(sd: float = 0.05e-3, **kwargs: object) -> Sensor:
    return Sensor(sd=sd, gate=0.0, **kwargs)


def every(rate: float, count: int, first: int = 0) -> np.ndarray:
    return first + np.rint(np.arange(count) * 1e9 / rate).astype(np.int64)


@dataclass(frozen=True)
class Case:
    """What a run and its configuration are made of; the measurements follow the commands with 1 mm of noise."""

    axes: Mapping[str, AxisModel] = field(default_factory=lambda: {"radial": AxisModel(plant=LAG)})
    delay: float = 0.06045
    period: float = 0.028
    times: np.ndarray = field(default_factory=lambda: GRID)
    process: Process | Mapping[str, Process] = NOISE
    offset_sd: float = 5e-3
    seen: Mapping[str, Seen] = field(default_factory=lambda: {"tracker": TRACKER})
    start: Mapping[str, float] = field(default_factory=dict)
    origin: int | float = 0  # stamp of the first command: int ns, or float seconds
    rate: float | None = None
    seed: int = 1

    def made(self) -> tuple[Run, FusionConfig]:
        rng = np.random.default_rng(self.seed)
        level = 0.5 + 0.05 * np.arange(len(self.axes))
        command = {
            axis: u + rng.uniform(-0.005, 0.005, len(self.times)) for axis, u in zip(self.axes, level, strict=True)
        }
        process = self.process if isinstance(self.process, Mapping) else dict.fromkeys(self.axes, self.process)
        config = FusionConfig(
            arm=ArmModel(name="an arm", update_period=self.period, delay=self.delay, axes=dict(self.axes)),
            start=Start(offset_sd=self.offset_sd),
            process=dict(process),
            sensors={name: seen.sensor for name, seen in self.seen.items()},
        )
        sensors = {name: self._measurements(seen, command, rng) for name, seen in self.seen.items()}
        shuffled = dict(reversed(sensors.items()))  # the order that counts is the configuration's
        return Run.from_arrays(self._stamps(self.times), command, shuffled, start=self.start), config

    def _stamps(self, ns: np.ndarray) -> np.ndarray:
        return self.origin + (ns if isinstance(self.origin, int) else ns * 1e-9)

    def _measurements(
        self, seen: Seen, command: Mapping[str, np.ndarray], rng: np.random.Generator
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        values: dict[str, np.ndarray] = {}
        bias = rng.normal(0.0, seen.sensor.bias_sd)
        for axis in seen.axes or command:
            near = np.interp(seen.valid, self.times, command[axis]) + rng.normal(0.0, 1e-3, len(seen.valid))
            values[axis] = seen.sensor.scale * near + bias
            values[axis][rng.random(len(seen.valid)) < seen.missing] = np.nan
        return self._stamps(seen.valid + round(seen.sensor.latency * 1e9)), values


def anomalous(run: Run, config: FusionConfig) -> bool:
    """Some component is not finite or valid before the first command, so that a warning is due."""
    origin = run.command.stamp.min()
    return any(
        (source.stamp - round(config.sensors[name].latency * 1e9) < origin).any()
        or not all(np.isfinite(value).all() for value in source.values.values())
        for name, source in run.sensors.items()
    )


def warned(run: Run, config: FusionConfig) -> AbstractContextManager[object]:
    """Expects the warning that is due."""
    return pytest.warns(PumafuseWarning) if anomalous(run, config) else nullcontext()


MODES = {"filtered": {}, "as_live": {"mode": "as-live"}, "smoothed": {"mode": "smoothed"}}


def check(case: Case, mode: str = "filtered", engine: str = "compiled") -> None:
    """Estimates and innovations of a case agree with the oracle."""
    run, config = case.made()
    with warned(run, config):
        estimates = fuse(run, config, rate=case.rate, engine=engine, **MODES[mode])
    times = nanoseconds(estimates)
    grid = case.times if case.rate is None else every(case.rate, len(times))
    assert times.tolist() == grid.tolist()
    assert case.rate is None or times[-1] + 1e9 / case.rate > case.times[-1]
    fused = estimates.measurements.where(estimates.measurements.outcome == Outcome.FUSED)
    for number, axis in enumerate(estimates.axes):
        oracle = AxisOracle(run, config, axis)
        check_innovations(fused.where(fused.axis == number), oracle)
        check_estimates(estimates[axis], getattr(oracle, mode)(times))
        if mode != "as_live" and estimates.biases:
            check_biases(estimates, axis, oracle)


def check_biases(estimates: Estimates, axis: str, oracle: AxisOracle) -> None:
    """Means given all measurements to 1e-9 sd + 1e-12 m, variances to 1e-9."""
    found, wanted = {name: of[axis] for name, of in estimates.biases.items() if axis in of}, oracle.biases()
    assert found.keys() == wanted.keys()
    for name, (mean, sd) in wanted.items():
        assert abs(found[name].value - mean) < 1e-9 * sd + 1e-12
        assert found[name].sd ** 2 == pytest.approx(sd**2, rel=1e-9)


NEARLY = SecondOrder(natural_frequency=45.0, damping=1.0 + 1e-9)


# ---- the filter -----------------------------------------------------------------------------------------------------

GRID = np.arange(16) * T
IRREGULAR = np.cumsum([0, 28, 31, 20, 28, 3, 28, 400, 28, 28, 5, 28, 90, 28]) * MS
TRACKER = Seen(sensor(latency=0.008), every(90, 36))
VISION = Seen(sensor(0.4e-3, latency=0.090), every(25, 10, 7 * MS))
LATE = replace(TRACKER, valid=every(90, 20, 240 * MS))
SLOW = Seen(sensor(0.2e-3, latency=0.240), every(12.5, 5, 3 * MS))
PANEL = Seen(sensor(0.3e-3, latency=0.004, scale=-1.0, bias_sd=1.0), every(40, 16, 2 * MS))
AHEAD = Seen(sensor(0.3e-3, latency=-0.050), every(15, 6, 61 * MS))  # stamped before it is true
THREE = {
    "tangential": AxisModel(
        plant=SecondOrder(natural_frequency=53.9, damping=0.864), gain=Gain(slope=0.05, intercept=1.01)
    ),
    "radial": AxisModel(plant=LAG, gain=PAPER, gain_recovery=0.1, delay=0.0385),
    "vertical": AxisModel(plant=FirstOrder(time_constant=0.0356), delay=0.0),
}


def one(plant: Plant, **kwargs: object) -> dict[str, AxisModel]:
    return {"radial": AxisModel(plant=plant, **kwargs)}


CASES = {
    "nearly critical": Case(one(NEARLY)),
    "a delay of two periods exactly": Case(delay=0.056),
    "a delay beyond the run": Case(delay=2.0),
    "irregular commands, recovering gain": Case(one(OVER, gain=PAPER, gain_recovery=0.1), times=IRREGULAR),
    "recovery at the plant's own rate": Case(one(LAG, gain=PAPER, gain_recovery=LAG.time_constant)),
    "recovery at a double pole": Case(one(CRITICAL, gain=PAPER, gain_recovery=1.0 / 45.0), times=IRREGULAR),
    "recovery at once": Case(one(UNDER, gain=PAPER, gain_recovery=1e-3), delay=0.0113, rate=90.0),
    "recovery in periods of no whole ns": Case(
        one(FirstOrder(time_constant=0.01), gain=Gain(slope=0.5, intercept=1.4), gain_recovery=0.05),
        period=1.0 / 30.0,
        times=IRREGULAR,
    ),
    "smooth disturbance": Case(one(UNDER), process=replace_(NOISE, disturbance_sd=2e-3, disturbance_time=0.2)),
    "rough disturbance": Case(
        process=replace_(NOISE, drift=0.0, disturbance_sd=1e-3, disturbance_time=0.05, disturbance_kind="ou")
    ),
    "nearly of constant velocity": Case(
        process=Process(input_noise=0.0, drift=0.0, disturbance_sd=1.0, disturbance_time=100.0), offset_sd=0.0
    ),
    "a bias that drifts beside a constant one": Case(
        process=NOISE,
        seen={
            "panel": Seen(sensor(1e-4, bias_sd=1e-2, bias_drift_sd=1e-3, bias_time=0.3), VISION.valid),
            "vision": VISION,
        },
    ),
    "maneuver alone": Case(process=Process(input_noise=0.0, drift=0.0, maneuver_noise=1e-3, maneuver_drift=1e-2)),
    "measured as commands act": Case(delay=0.0565, seen={"tracker": Seen(sensor(latency=0.0033), GRID + 56_500_000)}),
    "two at the same instants": Case(
        seen={"vision": replace(VISION, valid=GRID), "tracker": replace(TRACKER, valid=GRID)}
    ),
    "rates and latencies": Case(one(UNDER), seen={"vision": VISION, "slow": SLOW, "ahead": AHEAD, "tracker": TRACKER}),
    "a bias of every scale": Case(
        seen={
            str(scale): Seen(sensor(0.3e-3, scale=scale, bias_sd=bias_sd), every(30, 9, 40 * MS))
            for scale, bias_sd in ((1.0, 0.0), (-1.0, 0.5), (2.5, 1e-3), (-0.2, 0.02))
        },
        start={"radial": 0.51},
    ),
    "a gap in the measurements": Case(
        one(UNDER), seen={"tracker": replace(LATE, valid=np.r_[every(90, 15), LATE.valid])}
    ),
    "a latency that wanders, by the speed of plant and disturbance": Case(
        one(UNDER),
        delay=0.02,
        process=replace_(NOISE, disturbance_sd=2e-3, disturbance_time=0.05),
        seen={"wandering": Seen(sensor(latency=0.02, latency_sd=0.004, scale=-1.5), GRID), "vision": VISION},
    ),
    "a panel before the tracker": Case(one(UNDER), seen={"panel": PANEL, "tracker": LATE}, rate=60.0),
    "nanosecond stamps": Case(origin=1_700_000_000_123_456_789, rate=100.0),
    "axes and missing values": Case(
        THREE,
        process={"tangential": NOISE, "radial": Process(input_noise=1e-3), "vertical": Process(drift=0.0)},
        seen={
            "vision": Seen(VISION.sensor, VISION.valid, missing=0.4),
            "panel": Seen(PANEL.sensor, PANEL.valid, axes=("vertical",)),
            "tracker": Seen(
                sensor({"radial": 0.05e-3, "tangential": 0.08e-3}), every(60, 12), ("radial", "tangential"), missing=0.2
            ),
        },
        start={"vertical": 0.59},
        rate=60.0,
    ),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*sensors.ahead.latency_ms:pumafuse.PumafuseWarning")
@pytest.mark.filterwarnings("ignore:.*(where the commands lead|whose commands rest):pumafuse.PumafuseWarning")
@pytest.mark.parametrize(
    ("case", "mode"),
    [
        pytest.param(case, mode, id=f"{name}-{mode}", marks=[] if mode == "filtered" else pytest.mark.long)
        for name, case in CASES.items()
        for mode in MODES
        if mode != "as_live" or not any(seen.sensor.latency_sd for seen in case.seen.values())
    ],
)
def test_estimates_are_conditional_means(case: Case, mode: str) -> None:
    """Estimates, error bars, biases and innovations are those of the joint Gaussian given what they may know."""
    check(case, mode)


LATE = replace_(PAPER, intercept_ci95=(0.833, 1.033))
DOUBTED = {
    "second order, its gain too, disturbed": Case(
        one(UNDER, gain=LATE, lag_ci95=(0.03, 0.17)), process=replace_(NOISE, disturbance_sd=2e-3, disturbance_time=0.2)
    ),
    "gain": Case(one(OVER, gain=LATE), times=IRREGULAR, seen={"panel": PANEL, "tracker": TRACKER}, rate=70.0),
    "a gain that recovers is a lag": Case(one(UNDER, gain=LATE, gain_recovery=0.1, lag_ci95=(0.06, 0.16))),
    "rough, late": Case(
        one(LAG, gain=LATE, lag_ci95=(0.09, 0.12)),
        process=Process(maneuver_noise=1e-3, drift=0.0, disturbance_sd=1e-3, disturbance_kind="ou"),
        seen={"vision": VISION, "ahead": AHEAD},
    ),
}


@pytest.mark.filterwarnings("ignore:.*sensors.ahead.latency_ms:pumafuse.PumafuseWarning")
@pytest.mark.parametrize("case", DOUBTED.values(), ids=DOUBTED.keys())
def test_error_bars_count_how_well_the_arm_is_known(case: Case) -> None:
    """Estimates weigh measurements as if lag and gain were right, and bars are those of their error where they are not.

    With weights W the error of W z as an estimate of a position is Gaussian, of which the lag's standard deviation
    times (the speed there - W times the speeds at the measurements) is an independent part.
    """
    check(case, engine="filterpy")
    run, config = case.made()
    axes = {axis: replace_(one, lag_ci95=None, gain=replace_(one.gain, intercept_ci95=None)) for axis, one in
            config.arm.axes.items()}  # fmt: skip
    known = replace_(config, arm=replace_(config.arm, axes=axes))
    for mode, how in MODES.items():
        check(case, mode)
        with warned(run, config):
            doubted, certain = (fuse(run, one, **how) for one in (config, known))
        assert np.array_equal(doubted["radial"].position, certain["radial"].position)
        assert np.array_equal(doubted.measurements.innovation_sd, certain.measurements.innovation_sd)


@pytest.mark.parametrize("mode", ["filtered", "smoothed"])
def test_error_bars_count_a_lag_that_no_measurement_sees(mode: Mode) -> None:
    """It widens the bars of positions alone, by its sd times the speed of the response over the coming period."""
    run, config = DOUBTED["gain"].made()
    model = config.arm.axes["radial"]
    unseen = replace_(model, seen_lag_sd=0.0, unseen_lag_sd=0.2, lag_ci95=(0.0, 1.0))
    configs = (replace_(config, arm=replace_(config.arm, axes={"radial": axis})) for axis in (model, unseen))
    with warned(run, config):
        seen, doubted = (fuse(run, each, mode=mode)["radial"] for each in configs)
    (u,), stamp = run.command.values.values(), run.command.stamp
    now, later = (response(model, T / 1e9, config.arm.delay, stamp, u, u[0], stamp + ahead) for ahead in (0, T))
    more = (0.2 * (later - now) / (T / 1e9)) ** 2
    assert doubted.position_sd**2 == pytest.approx(seen.position_sd**2 + more, rel=1e-9)
    assert np.median(more) > np.median(seen.position_sd**2)
    for name in ("position", "velocity", "velocity_sd", "offset", "offset_sd", "disturbance", "disturbance_sd"):
        assert np.array_equal(getattr(doubted, name), getattr(seen, name), equal_nan=True)


def plants() -> st.SearchStrategy[Plant]:
    first = st.builds(FirstOrder, time_constant=st.floats(0.008, 0.1))
    damping = st.one_of(st.floats(0.1, 1.8), st.just(1.0))
    return st.one_of(first, st.builds(SecondOrder, natural_frequency=st.floats(8.0, 70.0), damping=damping))


def sensors(first: int, bias_sd: float) -> st.SearchStrategy[Seen]:
    """A sensor of up to 13 measurements; latencies, so the order of arrival, are anything."""
    ms = st.integers(0, 300).map(lambda latency: latency * 1e-3)
    read = st.builds(
        sensor,
        st.floats(0.3e-3 if bias_sd else 0.05e-3, 1e-3),
        latency=ms,
        scale=st.sampled_from([1.0, -1.0, 0.3]),
        bias_sd=st.just(bias_sd),
        bias_drift_sd=st.sampled_from([0.0, 1e-3]),
        bias_time=st.sampled_from([0.05, 10.0]),
    )
    valid = st.builds(
        every, st.floats(8.0, 150.0), st.integers(3, 13), st.integers(0, 200).map(lambda t: t * MS + first)
    )
    return st.builds(Seen, read, valid, missing=st.sampled_from([0.0, 0.2]))


@st.composite
def cases(draw: st.DrawFn) -> Case:
    period = draw(st.sampled_from([28 * MS, 10 * MS, 4 * MS + 1]))
    whole, fraction = draw(st.integers(0, 9)), draw(st.sampled_from([0, 1, period // 3, period - 1]))
    gaps = draw(
        st.lists(
            st.sampled_from([period, period, 2 * period, period + 3 * MS, period // 2 + 1, 170 * MS]),
            min_size=3,
            max_size=24,
        )
    )
    level = st.one_of(st.just(0.0), st.floats(1e-5, 2e-3))
    process = st.builds(
        Process,
        input_noise=level,
        drift=level,
        maneuver_noise=level,
        maneuver_drift=level.map(lambda d: 10 * d),
        disturbance_sd=level,
        disturbance_time=st.sampled_from([0.004, 0.1, 3.0, 1e3]),
        disturbance_kind=st.sampled_from(["matern", "ou"]),
    )
    axis = AxisModel(
        plant=draw(plants()),
        gain=Gain(slope=draw(st.floats(0.0, 0.2)), intercept=draw(st.floats(0.9, 1.1))),
        gain_recovery=draw(st.none() | st.floats(0.02, 0.3)),
    )
    names = draw(st.permutations(["tracker", "vision", "panel"]))[: draw(st.integers(1, 3))]
    return Case(
        {"radial": axis},
        delay=(whole * period + fraction) * 1e-9,
        period=period * 1e-9,
        times=np.cumsum([0, *gaps]),
        process=draw(process),
        offset_sd=draw(st.sampled_from([0.0, 1e-3, 0.02])),
        seen={name: draw(sensors(fraction, bias_sd=float(name == "panel"))) for name in names},
        start=draw(st.sampled_from([{}, {"radial": 0.512}])),
        rate=draw(st.none() | st.floats(20.0, 60.0)),
        seed=draw(st.integers(0, 2**32 - 1)),
    )  # fmt: skip


def tame(case: Case) -> Case:
    """Priors and drifts of at most some 30 times a measurement's noise; beyond, rounding can pass 1e-12 m.

    And no disturbance: at the very start of a run it costs the smoother up to 1e-7 of a standard deviation.
    """
    seen = {
        name: replace(each, sensor=replace_(
            each.sensor, sd=max(each.sensor.sd, 0.3e-3), bias_sd=min(each.sensor.bias_sd, 9e-3)))
        for name, each in case.seen.items()
    }  # fmt: skip
    process = replace_(case.process, maneuver_drift=min(case.process.maneuver_drift, 5e-3), disturbance_sd=0.0)
    return replace(case, seen=seen, process=process, offset_sd=min(case.offset_sd, 5e-3))


@settings(max_examples=50)
@given(cases(), st.sampled_from(list(MODES)))
def test_any_run_is_fused_like_the_conditional_gaussian(case: Case, mode: str) -> None:
    """Random plants, delays, gains, gaps, noise and sensors: nothing deviates from the joint Gaussian."""
    check(tame(case) if mode == "smoothed" else case, mode)


# ---- long runs ------------------------------------------------------------------------------------------------------


def core_of(case: Case) -> tuple[Filter, Model, Events]:
    """The filter of a case at rest, its model, and its events."""
    run, config = case.made()
    segment = build_segment(run, config)
    model = model_of(segment, config)
    return Filter(model, segment.origin), model, segment.events(config)[0]


def test_a_million_steps_leave_the_covariance_as_it_was() -> None:
    """Rounding does not add up, beside a bias of 1 m either: error bars are those of a filter that has just begun.

    In that one the bias is known, as it is after 200 000 measurements; and its error bar only becomes smaller.
    """
    count = 700_000
    process = Process(input_noise=0.03e-3, drift=0.4e-3, maneuver_noise=0.5e-3, maneuver_drift=5e-3)
    seen = {
        "panel": Seen(sensor(0.3e-3, scale=-1.0, bias_sd=1.0), 3 * T * np.arange(count // 3) + 2 * MS),
        "tracker": Seen(sensor(0.05e-3, latency=0.008), T * np.arange(count) + 5 * MS),
    }
    core, model, events = core_of(Case(one(UNDER), times=np.arange(count) * T, process=process, seen=seen))
    assert len(events.time) > 1_000_000
    last, results, sds = events.time[-1000:], Results.room(*events.codes.shape), list[float]()
    for begin in range(0, len(events.time) - 5000, 5000):
        outputs = core.run(events, results, events.time[begin : begin + 1], span=(begin, begin + 5000))
        assert (outputs[1:6:2] >= 0.0).all()
        sds.append(core.bias(0, 0)[1])
    assert (np.diff(sds) < 0.0).all()
    outputs = core.run(events, results, last, span=(begin + 5000, len(events.time)))
    model.view["bias_sd"] = 0.0
    begun = Filter(model, int(events.time[-5000]))
    wanted = begun.run(events.rows(slice(-5000, None)), Results.room(5000, 1), last)
    np.testing.assert_allclose(outputs[1:6:2], wanted[1:6:2], rtol=1e-5)


def test_smoothing_does_not_reach_across_a_clock_that_was_set_back() -> None:
    """Each side is smoothed as if it were a run of its own."""
    parts = [Case(one(UNDER), seed=seed).made() for seed in (1, 2)]
    later, config = 60_000 * MS, parts[0][1]

    def joined(*sources: Source) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        stamps = np.concatenate([sources[0].stamp + later, sources[1].stamp])
        return stamps, {"radial": np.concatenate([source.values["radial"] for source in sources])}

    command = joined(*(run.command for run, _ in parts))
    tracker = joined(*(run.sensors["tracker"] for run, _ in parts))
    with pytest.warns(PumafuseWarning):
        both = fuse(Run.from_arrays(*command, {"tracker": tracker}), config, mode="smoothed")
    for number, (run, _) in enumerate(parts):
        alone, here = fuse(run, config, mode="smoothed")["radial"], both.segment == number
        np.testing.assert_array_equal(both["radial"].position[here], alone.position)
        np.testing.assert_array_equal(both["radial"].position_sd[here], alone.position_sd)


# ---- gates ----------------------------------------------------------------------------------------------------------


def check_gated(run: Run, config: FusionConfig, estimates: Estimates, mode: str) -> dict[Outcome, set[tuple[str, int]]]:
    """Estimates are those of the Gaussian without what was rejected; what re-acquired adds (ν/scale)² to the offset's.

    Returns:
        The rows with each outcome.
    """
    found = estimates.measurements
    stamps = np.rint(found.stamp * 1e9).astype(np.int64) + estimates.origin
    sources = [(found.sensors[number], run.sensors[found.sensors[number]].stamp) for number in found.sensor]
    rows = [(name, int(np.searchsorted(of, stamp))) for (name, of), stamp in zip(sources, stamps, strict=True)]
    by = {kind: {row for row, outcome in zip(rows, found.outcome, strict=True) if outcome == kind} for kind in Outcome}
    oracle = AxisOracle(run, config, "radial", leave_out=by[Outcome.REJECTED], reacquired=by[Outcome.REACQUIRED])
    check_innovations(found.where(np.isin(found.outcome, [Outcome.FUSED, Outcome.REACQUIRED])), oracle)
    check_estimates(estimates["radial"], getattr(oracle, mode)(nanoseconds(estimates)))
    return by


@pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
@settings(max_examples=30)
@given(cases(), st.sampled_from(["filtered", "smoothed"]))
def test_any_gated_run_is_fused_like_the_conditional_gaussian(case: Case, mode: str) -> None:
    """Gates narrow enough to reject and to re-acquire."""
    run, config = tame(case).made()
    config = msgspec.structs.replace(
        config, sensors={name: msgspec.structs.replace(each, gate=1.0) for name, each in config.sensors.items()}
    )
    check_gated(run, config, fuse(run, config, rate=case.rate, **MODES[mode]), mode)


# ---- biases ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("level", "start"), [(-2.0, None), (3.0, 5e-3)])
def test_a_bias_is_in_the_coordinates_of_the_log(level: float, start: float | None) -> None:
    """Measurements 600.4 mm − p have a bias of 600.4 mm wherever the arm starts, configured or by its first command."""
    case = Case(seen={"panel": PANEL, "tracker": TRACKER}, start={} if start is None else {"radial": 0.5 + start})
    run, config = case.made()
    shift = level - 0.5
    for name, bias in (("panel", 0.6004), ("tracker", 0.0)):
        of, values = config.sensors[name], run.sensors[name].values["radial"]
        values[:] = of.scale * (AxisOracle(run, config, "radial").undisturbed(case.seen[name].valid)[0] + shift) + bias
    run.command.values["radial"][:] += shift
    moved = replace(run, start={axis: u + shift for axis, u in run.start.items()})
    bias = fuse(moved, config).biases["panel"]["radial"]
    assert abs(bias.value - 0.6004) < 2.0 * bias.sd**2 / 1.0**2  # all that the prior of 0 ± 1 m takes from it, twice
    assert bias.sd < 0.5e-3


# ---- latencies that wander ------------------------------------------------------------------------------------------

SCALE, JITTER, DRIFT = -1.5, 0.004, 0.3e-3


def moving(seen: Seen, process: Process) -> tuple[Run, FusionConfig]:
    """Three seconds of swinging to and fro by 60 mm at up to 0.11 m/s, commands every 10 ms."""
    times = np.arange(300) * 10 * MS
    case = Case(one(UNDER), times=times, period=0.01, process=process, offset_sd=1e-3, seen={"tracker": seen})
    run, config = case.made()
    run.command.values["radial"][:] = 0.5 + 0.03 * np.sin(2.0 * np.pi * 0.6e-9 * times)
    return run, config


def jittering_nis(latency_sd: float, seed: int) -> np.ndarray:
    """NIS of 150 measurements whose latency really wanders, of an arm whose offset really walks."""
    rng, valid = np.random.default_rng(seed), every(50, 150)
    of = sensor(0.1e-3, latency=0.02, scale=SCALE, latency_sd=latency_sd)
    run, config = moving(Seen(of, valid), Process(input_noise=0.0, drift=DRIFT))
    actual = np.maximum(valid + np.rint(rng.normal(0.0, JITTER * 1e9, len(valid))).astype(np.int64), 0)
    order = np.argsort(actual)
    offset = np.empty(len(valid))
    step = np.sqrt(np.diff(actual[order], prepend=0) * 1e-9) * DRIFT
    offset[order] = rng.normal(0.0, config.start.offset_sd) + np.cumsum(step * rng.normal(size=len(valid)))
    position = AxisOracle(run, config, "radial").undisturbed(actual)[0] + offset
    run.sensors["tracker"].values["radial"][:] = SCALE * position + rng.normal(0.0, 0.1e-3, len(valid))
    return fuse(run, config).measurements.nis


def test_measurements_whose_latency_wanders_are_consistent_where_latency_sd_says_so() -> None:
    """Mean NIS over many runs is 1 within the 99.9 % band of χ²; without latency_sd the errors look far too large."""
    right, wrong = (np.concatenate([jittering_nis(sd, seed) for seed in range(25)]) for sd in (JITTER, 0.0))
    low, high = chi2.ppf([0.0005, 0.9995], len(right)) / len(right)
    assert low < right.mean() < high
    assert wrong.mean() > 3.0
