"""Gates, and gates that reopen, against section 2 of the design worked out component by component.

An arm at rest with a first-order plant: two numbers know an axis, the plant's deviation x and the offset o, and their
covariance over time has a closed form.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pumafuse.fusion.outcome import Outcome

from fusion_oracle import Belief, check_estimates, nanoseconds
from pumafuse.errors import PumafuseWarning
from pumafuse.fusion.config import FusionConfig, Process, Sensor, Start
from pumafuse.fusion.consistency import log_likelihood
from pumafuse.fusion.estimates import Estimates
from pumafuse.fusion.offline import fuse
from pumafuse.logs.run import Run
from pumafuse.model.arm import ArmModel, AxisModel
from pumafuse.model.plants import FirstOrder

MS = 1_000_000  # ns
TAU, INPUT_NOISE, DRIFT, OFFSET_SD = 0.04, 0.1e-3, 0.5e-3, 1e-3
LEVEL = {"radial": 0.5, "vertical": -0.1}
OFF = 0.05  # m, far beyond any gate here
FUSED, REJECTED, REACQUIRED, DUPLICATE = Outcome.FUSED, Outcome.REJECTED, Outcome.REACQUIRED, Outcome.DUPLICATE


# ---- the design, by hand --------------------------------------------------------------------------------------------


@dataclass
class Known:
    """What is known of one axis: x and o, their variances and covariance; p − u₀ = x + o."""

    time: int = 0
    x: float = 0.0
    o: float = 0.0
    xx: float = 0.0
    xo: float = 0.0
    oo: float = OFFSET_SD**2

    @property
    def variance(self) -> float:
        return self.xx + 2.0 * self.xo + self.oo

    def at(self, time: int) -> Known:
        """Predicted: ẋ = (w − x)/τ, and o walks."""
        h = (time - self.time) * 1e-9
        a = math.exp(-h / TAU)
        xx = a * a * self.xx - INPUT_NOISE**2 * math.expm1(-2.0 * h / TAU) / (2.0 * TAU)
        return Known(time, a * self.x, self.o, xx, a * self.xo, self.oo + DRIFT**2 * h)

    def given(self, nu: float, S: float, scale: float) -> Known:
        """Updated with one component; the gains are the covariances with it over S."""
        x, o = scale * (self.xx + self.xo) / S, scale * (self.xo + self.oo) / S
        means = self.x + x * nu, self.o + o * nu
        return Known(self.time, *means, self.xx - x * x * S, self.xo - x * o * S, self.oo - o * o * S)


@dataclass(frozen=True)
class Row:
    """A row of a sensor: the instant it is true of [ns], and how far off its level each axis seems to be [m]."""

    valid: int
    sensor: str
    off: Mapping[str, float]


@dataclass
class Judge:
    """Meets rows in their total order and decides as the design says."""

    sensors: Mapping[str, Sensor]
    known: dict[str, Known] = field(default_factory=lambda: {axis: Known() for axis in LEVEL})
    rejections: dict[tuple[str, ...], list[int]] = field(default_factory=dict)  # when, of those in a row
    components: list[tuple[str, Outcome, float, float]] = field(default_factory=list)  # sensor, outcome, ν and S
    closest: float = math.inf  # of any |ν|/√S to its gate

    def meet(self, row: Row) -> None:
        if self.sensors[row.sensor].gate_rows:
            self._decide(row, list(row.off), (row.sensor,))
        else:
            for axis in row.off:
                self._decide(row, [axis], (row.sensor, axis))

    def _decide(self, row: Row, axes: list[str], who: tuple[str, ...]) -> None:
        sensor, rejected = self.sensors[row.sensor], self.rejections.setdefault(who, [])
        found = {axis: self._expected(row, axis) for axis in axes}
        fails = {axis for axis, (nu, S) in found.items() if sensor.gate and abs(nu) > sensor.gate * math.sqrt(S)}
        if fails and not (len(rejected) >= 10 and row.valid - rejected[0] >= 500 * MS):
            rejected.append(row.valid)
            self.components += [(row.sensor, REJECTED, nu, S) for nu, S in found.values()]
            return
        rejected.clear()
        for axis, (nu, S) in found.items():
            if axis in fails:
                self.known[axis].oo += nu**2
                S = self._expected(row, axis)[1]
            self.known[axis] = self.known[axis].given(nu, S, sensor.scale)
            self.components.append((row.sensor, REACQUIRED if axis in fails else FUSED, nu, S))

    def _expected(self, row: Row, axis: str) -> tuple[float, float]:
        """ν and S."""
        sensor, known = self.sensors[row.sensor], self.known[axis].at(row.valid)
        self.known[axis] = known
        assert isinstance(sensor.sd, float)
        nu, S = sensor.scale * (row.off[axis] - known.x - known.o), sensor.scale**2 * known.variance + sensor.sd**2
        self.closest = min(self.closest, abs(abs(nu) / math.sqrt(S) - sensor.gate))
        return nu, S


def judged(rows: Iterable[Row], sensors: Mapping[str, Sensor]) -> Judge:
    judge, rank = Judge(sensors), list(sensors)
    for row in sorted(rows, key=lambda row: (row.valid, rank.index(row.sensor))):
        judge.meet(row)
    return judge


def believed(rows: Sequence[Row], sensors: Mapping[str, Sensor], times: np.ndarray, as_live: bool) -> dict[str, Belief]:
    """Each axis at each of ``times``, everything judged anew from what is known by then."""
    late = {name: round(sensor.latency * 1e9) if as_live else 0 for name, sensor in sensors.items()}
    judges = [judged([row for row in rows if row.valid + late[row.sensor] <= time], sensors) for time in times]
    return {
        axis: _belief([j.known[axis].at(int(t)) for j, t in zip(judges, times, strict=True)], axis) for axis in LEVEL
    }


def _belief(known: Sequence[Known], axis: str) -> Belief:
    x, o, xx, xo, oo = np.array([(k.x, k.o, k.xx, k.xo, k.oo) for k in known]).T
    return Belief(LEVEL[axis] + x + o, np.sqrt(xx + 2.0 * xo + oo), -x / TAU, np.sqrt(xx) / TAU, o, np.sqrt(oo))


# ---- runs at rest ---------------------------------------------------------------------------------------------------


def sensor(gate: float = 5.0, sd: float = 0.2e-3, **kwargs: object) -> Sensor:
    return Sensor(sd=sd, gate=gate, **kwargs)


def series(
    name: str, rate: float, off: Iterable[float], axes: Iterable[str] = ("radial",), first: int = 0
) -> list[Row]:
    """A row every 1/rate, off by the same on all ``axes``."""
    return [Row(first + round(k * 1e9 / rate), name, dict.fromkeys(axes, value)) for k, value in enumerate(off)]


def recorded(rows: Iterable[Row], sensors: Mapping[str, Sensor]) -> tuple[Run, FusionConfig]:
    """A log with one command, long held, and the rows in order."""
    axes = dict.fromkeys(LEVEL, AxisModel(plant=FirstOrder(time_constant=TAU)))
    config = FusionConfig(
        arm=ArmModel(name="at rest", update_period=0.028, delay=0.06, axes=axes),
        start=Start(offset_sd=OFFSET_SD),
        process=dict.fromkeys(LEVEL, Process(input_noise=INPUT_NOISE, drift=DRIFT)),
        sensors=dict(sensors),
    )
    streams = {}
    for name, of in sensors.items():
        mine = [row for row in rows if row.sensor == name]
        stamps = np.array([row.valid for row in mine], dtype=np.int64) + round(of.latency * 1e9)
        seen = [axis for axis in LEVEL if any(axis in row.off for row in mine)]
        streams[name] = (
            stamps,
            {axis: [of.scale * (LEVEL[axis] + row.off.get(axis, np.nan)) for row in mine] for axis in seen},
        )
    return Run.from_arrays(np.zeros(1, dtype=np.int64), {axis: [u] for axis, u in LEVEL.items()}, streams), config


def fused(rows: Iterable[Row], sensors: Mapping[str, Sensor], **kwargs: object) -> Estimates:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PumafuseWarning)  # what is said of it all is tested apart
        return fuse(*recorded(rows, sensors), rate=20.0, **kwargs)


def outcomes(estimates: Estimates, name: str, axis: str = "radial") -> list[Outcome]:
    return [Outcome(code) for code in estimates.measurements.of(name, axis).outcome]


# ---- when a gate reopens --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axes", [["radial"], list(LEVEL)], ids=["one axis", "both axes"])
@pytest.mark.parametrize("gate_rows", [True, False])
@pytest.mark.parametrize(
    ("rate", "rejected"),
    [
        pytest.param(1.0, 10, id="1 Hz: ten of them"),
        pytest.param(10.0, 10, id="10 Hz: ten of them"),
        pytest.param(20.0, 10, id="20 Hz: ten of them and half a second"),
        pytest.param(1e9 / 49_999_999.95, 11, id="ten of them, 1 ns short of half a second"),
        pytest.param(100.0, 50, id="100 Hz: half a second"),
        pytest.param(1000.0, 500, id="1 kHz: half a second"),
    ],
)
def test_a_gate_reopens_after_ten_rejections_over_half_a_second(
    rate: float, rejected: int, gate_rows: bool, axes: list[str]
) -> None:
    """Rows are counted, not components; the one that reopens comes at least 0.5 s after the first of ten or more."""
    off = [0.0] * 5 + [OFF] * (rejected + 9)
    estimates = fused(series("tracker", rate, off, axes), {"tracker": sensor(gate_rows=gate_rows)})
    for axis in axes:
        assert outcomes(estimates, "tracker", axis) == [FUSED] * 5 + [REJECTED] * rejected + [REACQUIRED] + [FUSED] * 8


@pytest.mark.parametrize("good", [1, 3])
def test_a_measurement_that_passes_ends_the_row_of_rejections(good: int) -> None:
    """Count and clock both start anew: 49 rejections before it do not count."""
    off = [OFF] * 49 + [0.0] * good + [OFF] * 52
    estimates = fused(series("tracker", 100.0, off), {"tracker": sensor()})
    assert outcomes(estimates, "tracker") == [REJECTED] * 49 + [FUSED] * good + [REJECTED] * 50 + [REACQUIRED] + [FUSED]


def test_a_gate_that_has_reacquired_counts_anew() -> None:
    """After it ten rejections over half a second are needed again."""
    off = [OFF] * 51 + [0.0] * 51 + [OFF] * 51
    estimates = fused(series("tracker", 100.0, off), {"tracker": sensor()})
    assert outcomes(estimates, "tracker") == 3 * ([REJECTED] * 50 + [REACQUIRED])


def test_rejections_are_counted_for_each_sensor() -> None:
    """Six rejections of each of two sensors reopen nothing, though they are twelve over more than half a second."""
    rows = series("tracker", 10.0, [0.0] * 3 + [OFF] * 6 + [0.0]) + series(
        "vision", 10.0, [0.0] * 3 + [OFF] * 6 + [0.0], first=MS
    )
    estimates = fused(rows, {"tracker": sensor(), "vision": sensor()})
    for name in ("tracker", "vision"):
        assert outcomes(estimates, name) == [FUSED] * 3 + [REJECTED] * 6 + [FUSED]


def test_another_sensor_that_passes_does_not_end_the_row_of_rejections() -> None:
    """A sensor that contradicts another reopens its gate although the other's measurements are fused in between."""
    rows = series("tracker", 10.0, [0.0] * 3 + [OFF] * 11) + series("vision", 10.0, [0.0] * 14, first=-50 * MS)[1:]
    estimates = fused(rows, {"tracker": sensor(), "vision": sensor()})
    assert outcomes(estimates, "tracker") == [FUSED] * 3 + [REJECTED] * 10 + [REACQUIRED]
    assert outcomes(estimates, "vision") == [FUSED] * 13


@pytest.mark.parametrize("gate_rows", [True, False])
def test_rejections_are_counted_for_each_axis_where_rows_are_not_rejected(gate_rows: bool) -> None:
    """Rows off on alternate axes: rejected by rows the sensor fails time after time, rejected by axes neither axis does."""
    rows = [Row(k * 50 * MS, "tracker", {"radial": OFF * (k % 2), "vertical": OFF * (1 - k % 2)}) for k in range(12)]
    estimates = fused(rows, {"tracker": sensor(gate_rows=gate_rows)})
    got = [outcomes(estimates, "tracker", axis) for axis in LEVEL]
    if gate_rows:  # the eleventh row fails on its vertical axis alone and takes that far from what the twelfth says
        assert got == [[REJECTED] * 10 + [FUSED, REJECTED], [REJECTED] * 10 + [REACQUIRED, REJECTED]]
    else:
        assert got == [[FUSED, REJECTED] * 6, [REJECTED, FUSED] * 6]


def test_a_row_said_twice_is_rejected_once() -> None:
    """A duplicate is no rejection: ten distinct rows are needed."""
    once = series("tracker", 20.0, [OFF] * 11)
    estimates = fused([row for row in once for _ in range(2)], {"tracker": sensor()})
    got = outcomes(estimates, "tracker")
    assert got[0::2] == [REJECTED] * 10 + [REACQUIRED]
    assert got[1::2] == [DUPLICATE] * 11


def test_a_gate_of_zero_rejects_nothing() -> None:
    """Measurements off by thousands of standard deviations are fused at once and plainly."""
    off = [0.0] * 5 + [OFF, -OFF] * 40
    estimates = fused(series("tracker", 100.0, off), {"tracker": sensor(0.0)})
    assert set(outcomes(estimates, "tracker")) == {FUSED}
    assert np.abs(estimates.measurements.innovation / estimates.measurements.innovation_sd).max() > 100.0


def test_a_reacquired_gate_is_counted_and_said() -> None:
    """The outcome is in the counts, and a warning names the sensor."""
    run, config = recorded(series("tracker", 100.0, [0.0] * 5 + [OFF] * 60), {"tracker": sensor()})
    with pytest.warns(PumafuseWarning) as said:
        estimates = fuse(run, config)
    assert estimates.measurements.counts() == {"fused": 14, "rejected": 50, "reacquired": 1}
    assert any("tracker" in str(one.message) and "reacquired" in str(one.message) for one in said)


# ---- what it does to the estimates ----------------------------------------------------------------------------------


def test_a_reacquired_gate_takes_the_offset_to_the_measurement() -> None:
    """With ν² more variance the offset moves by nearly ν in one measurement, and is as uncertain as that measurement."""
    estimates = fused(series("tracker", 20.0, [0.0] * 5 + [OFF] * 11), {"tracker": sensor()})
    radial, measurements = estimates["radial"], estimates.measurements
    nu = measurements.innovation[-1]
    assert measurements.innovation_sd[-1] == pytest.approx(nu, rel=1e-3)
    assert radial.offset[-1] - radial.offset[-2] == pytest.approx(nu, rel=1e-3)
    assert radial.position_sd[-1] == pytest.approx(0.2e-3, rel=1e-3)
    assert radial.offset_sd[-2] < 2e-3


SPELLS = [
    {"radial": 0.0, "vertical": 0.0},
    {"radial": 0.0, "vertical": 0.0},
    {"radial": OFF, "vertical": 0.0},
    {"radial": OFF, "vertical": -OFF},
    {"radial": -2e-3, "vertical": 0.5e-3},
    {"vertical": OFF},
    {"radial": 0.0},
]


@st.composite
def logs(draw: st.DrawFn) -> tuple[list[Row], dict[str, Sensor]]:
    sensors = {
        name: sensor(
            draw(st.sampled_from([5.0, 5.0, 3.0, 0.0])),
            draw(st.sampled_from([0.2e-3, 1e-3])),
            scale=draw(st.sampled_from([1.0, -1.0, 2.0])),
            gate_rows=draw(st.booleans()),
            latency=draw(st.sampled_from([0.0, 0.03, 0.25])),
        )
        for name in draw(st.sampled_from([["tracker"], ["tracker", "vision"], ["vision", "tracker"]]))
    }
    found = []
    for name in sensors:
        rate = draw(st.sampled_from([9.0, 20.0, 31.0]))
        spells = draw(st.lists(st.tuples(st.integers(1, 20), st.sampled_from(SPELLS)), min_size=2, max_size=4))
        rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
        for k, off in enumerate(off for count, off in spells for _ in range(count)):
            noisy = {axis: value + float(rng.normal(0.0, 0.3e-3)) for axis, value in off.items()}
            found.append(Row(round(k * 1e9 / rate), name, noisy))
    return found, sensors


@pytest.mark.long
@settings(derandomize=True, deadline=None, max_examples=150)
@given(logs(), st.booleans())
def test_any_log_is_rejected_as_the_design_says(log: tuple[list[Row], dict[str, Sensor]], as_live: bool) -> None:
    """Outcomes, innovations, estimates and error bars are those worked out by hand, with all that had arrived."""
    rows, sensors = log
    judge = judged(rows, sensors)
    assume(judge.closest > 1e-6)
    estimates = fused(rows, sensors, as_live=as_live)
    times = nanoseconds(estimates)
    if not as_live:
        met = estimates.measurements.where(estimates.measurements.outcome <= REACQUIRED)
        name, outcome, nu, S = zip(*judge.components, strict=True)
        assert [met.sensors[index] for index in met.sensor] == list(name)
        assert [Outcome(code) for code in met.outcome] == list(outcome)
        np.testing.assert_allclose(met.innovation, nu, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(met.innovation_sd**2, S, rtol=1e-9)
    for axis, belief in believed(rows, sensors, times, as_live).items():
        check_estimates(estimates[axis], belief)


# ---- the likelihood -------------------------------------------------------------------------------------------------


def test_the_log_likelihood_is_the_sum_over_all_components_met() -> None:
    """−½(ln 2πS + ν²/S) each, in mm, and −½(ln 2πS + gate²) for a rejected one, whether or not its own axis failed."""
    off = [{"radial": 0.1e-3 * k, "vertical": OFF * (4 <= k < 40)} for k in range(-5, 50)]
    rows = [Row(k * 30 * MS, "tracker", one) for k, one in enumerate(off)]
    rows += series("vision", 7.0, [1e-3, -1e-3, OFF, 0.0, 2e-3, OFF], first=3 * MS)
    sensors = {"tracker": sensor(4.0), "vision": sensor(0.0, 1e-3)}
    estimates, total = fused(rows, sensors), 0.0
    judge = judged(rows, sensors)
    for name, outcome, nu, S in judge.components:
        square = sensors[name].gate ** 2 if outcome == REJECTED else nu**2 / S
        total -= 0.5 * (math.log(2.0 * math.pi * S * 1e6) + square)
    assert {outcome for _, outcome, _, _ in judge.components} == {FUSED, REJECTED, REACQUIRED}
    assert log_likelihood(estimates.measurements, sensors) == pytest.approx(total, rel=1e-9)


def test_components_that_were_never_met_do_not_count_in_the_likelihood() -> None:
    """Neither a duplicate, nor a row before the first command, nor a missing value, nor an unknown sensor."""
    rows, sensors = series("tracker", 20.0, [0.1e-3] * 6), {"tracker": sensor()}
    more = [*rows[2:4], Row(-100 * MS, "tracker", {"radial": 0.0}), Row(75 * MS, "tracker", {"radial": math.nan})]
    more.append(Row(0, "other", {"radial": 0.0}))
    run, _ = recorded([*rows, *more], {**sensors, "other": sensor()})
    plain = fused(rows, sensors)
    with pytest.warns(PumafuseWarning):
        estimates = fuse(run, plain.config)
    assert len(estimates.measurements.value) == len(rows) + 5
    assert log_likelihood(estimates.measurements, sensors) == log_likelihood(plain.measurements, sensors)
