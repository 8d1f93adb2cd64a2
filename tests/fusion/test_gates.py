"""The gate's rule, on constructed runs and against the rule worked out measurement by measurement.

An arm at rest with a first-order plant: two numbers know an axis, the plant's deviation x and the offset o, and their
covariance over time has a closed form.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pumafuse.errors import PumafuseWarning
from pumafuse.filter.outcome import Outcome
from pumafuse.fusion.config import FusionConfig, Process, Sensor, Start
from pumafuse.fusion.engine import innovations
from pumafuse.fusion.estimates import Estimates
from pumafuse.fusion.offline import fuse
from pumafuse.fusion.segments import build
from pumafuse.logs.run import Run
from pumafuse.model.arm import ArmModel, AxisModel
from pumafuse.model.plants import FirstOrder

MS = 1_000_000  # ns
T = 28 * MS
TAU, INPUT_NOISE, DRIFT, OFFSET_SD = 0.04, 0.1e-3, 0.5e-3, 1e-3
LEVEL = {"radial": 0.5, "vertical": -0.1}
OFF = 0.05  # m, far beyond any gate here
FUSED, REJECTED, REACQUIRED = Outcome.FUSED, Outcome.REJECTED, Outcome.REACQUIRED


@dataclass(frozen=True)
class Row:
    """A row of a sensor: when it is valid [ns], and how far from its level each axis seems to be [m]."""

    valid: int
    sensor: str
    off: Mapping[str, float]


def sensor(gate: float = 5.0, sd: float = 0.2e-3, **kwargs: object) -> Sensor:
    return Sensor(sd=sd, gate=gate, **kwargs)


def rows_at(
    milliseconds: Iterable[float], off: Iterable[float], name: str = "tracker", axes: Iterable[str] = ("radial",)
) -> list[Row]:
    """Rows of one sensor, off by the same on all ``axes``."""
    pairs = zip(milliseconds, off, strict=True)
    return [Row(round(when * MS), name, dict.fromkeys(axes, value)) for when, value in pairs]


def every(interval: float, off: Sequence[float], first: float = 0.0, name: str = "tracker") -> list[Row]:
    """A row every ``interval`` [ms]."""
    return rows_at([first + interval * k for k in range(len(off))], off, name)


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
        values = {axis: [of.scale * (LEVEL[axis] + row.off.get(axis, np.nan)) for row in mine] for axis in seen}
        streams[name] = stamps, values
    return Run.from_arrays(np.zeros(1, dtype=np.int64), {axis: [u] for axis, u in LEVEL.items()}, streams), config


TRACKER = {"tracker": sensor()}
BOTH = {"tracker": sensor(), "camera": sensor()}


def fused(rows: Iterable[Row], sensors: Mapping[str, Sensor] = TRACKER, **kwargs: object) -> Estimates:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PumafuseWarning)  # what is said of it all is tested apart
        return fuse(*recorded(rows, sensors), rate=20.0, **kwargs)


def outcomes(estimates: Estimates, name: str = "tracker", axis: str = "radial") -> list[Outcome]:
    return [Outcome(code) for code in estimates.measurements.of(name, axis).outcome]


def contradictions(rows: Sequence[Row], sensors: Mapping[str, Sensor]) -> list[tuple[str, str]]:
    """Which sensor contradicts which, for each row of which that is said."""
    run, config = recorded(rows, sensors)
    segment = build(run, config)
    found, source = innovations(segment, config).contradicts, segment.measurement_rows.source
    return [(segment.sensors[a], segment.sensors[b]) for a, b in zip(source, found, strict=True) if b >= 0]


# ---- a sensor alone -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("apart", "second"), [(T, REACQUIRED), (T - 1, REJECTED), (20 * T, REACQUIRED)])
def test_two_that_agree_a_period_apart_are_believed(apart: int, second: Outcome) -> None:
    """Nearer than T the second may be the same glitch seen twice."""
    rows = [*every(100, [0.0] * 5), *rows_at([500, 500 + apart / MS], [OFF, OFF])]
    assert outcomes(fused(rows)) == [FUSED] * 5 + [REJECTED, second]


@pytest.mark.parametrize(("interval", "rejected"), [(1.0, 28), (10.0, 3), (28.0, 1), (1000.0, 1)])
def test_a_step_is_followed_after_a_period(interval: float, rejected: int) -> None:
    """At any rate: a measurement that comes sooner does not take the place of the first rejected one."""
    got = outcomes(fused(every(interval, [0.0] * 5 + [OFF] * (rejected + 5))))
    assert got == [FUSED] * 5 + [REJECTED] * rejected + [REACQUIRED] + [FUSED] * 4


def test_a_re_acquisition_is_counted_and_said() -> None:
    """The outcome is in the counts, and a warning names the sensor."""
    run, config = recorded(every(50, [0.0] * 5 + [OFF] * 5), TRACKER)
    with pytest.warns(PumafuseWarning) as said:
        estimates = fuse(run, config)
    assert estimates.measurements.counts() == {"fused": 8, "rejected": 1, "reacquired": 1}
    assert any("tracker" in str(one.message) and "reacquired" in str(one.message) for one in said)


@pytest.mark.parametrize("engine", ["compiled", "filterpy"])
@pytest.mark.parametrize(("share", "second"), [(0.99, REACQUIRED), (1.01, REJECTED)])
@pytest.mark.parametrize("kind", ["matern", "ou"])
def test_two_agree_as_far_as_a_disturbance_may_move_between(
    kind: str, share: float, second: Outcome, engine: str
) -> None:
    """Of covariance k(Δ), with nothing else that moves: within gate · √(R₁ + R₂ + 2 (k(0) − k(Δ))), and no farther."""
    rate, sd, apart = (math.sqrt(3.0) if kind == "matern" else 1.0) / 0.05, 1e-3, 0.040
    correlation = math.exp(-rate * apart) * (1.0 + rate * apart if kind == "matern" else 1.0)
    farthest = 5.0 * math.sqrt(2.0 * 0.2e-3**2 + 2.0 * sd**2 * (1.0 - correlation))
    run, config = recorded(rows_at([10, 50], [OFF, OFF + share * farthest]), TRACKER)
    moves = Process(input_noise=0.0, drift=0.0, disturbance_sd=sd, disturbance_time=0.05, disturbance_kind=kind)
    config = msgspec.structs.replace(config, start=Start(offset_sd=0.0), process=dict.fromkeys(LEVEL, moves))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PumafuseWarning)
        assert outcomes(fuse(run, config, engine=engine)) == [REJECTED, second]


# ---- two sensors ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("since", "wanted"), [(500.0, REJECTED), (500.000001, REACQUIRED)])
def test_a_sensor_stands_for_what_is_believed_for_half_a_second(since: float, wanted: Outcome) -> None:
    """From then on another one may re-acquire."""
    rows = every(100, [0.0] * 5) + rows_at([400 + since / 2, 400 + since], [OFF, OFF], "camera")
    assert outcomes(fused(rows, BOTH), "camera") == [REJECTED, wanted]


@pytest.mark.parametrize(
    ("settled", "quarrel", "wanted"),
    [(4.5, [], REACQUIRED), (5.5, [], REJECTED), (5.5, [3 * OFF, 5 * OFF], REACQUIRED)],
)
def test_re_acquisitions_are_forgotten_after_five_seconds_of_agreement(
    settled: float, quarrel: list[float], wanted: Outcome
) -> None:
    """Until then a sensor that followed the arm by itself does not stand against one that did not."""
    seen = [0.0] * 4 + [OFF] * round(10 * settled + 5)
    seen[30 : 30 + len(quarrel)] = quarrel
    rows = every(100, [0.0, *seen, *[OFF] * 10]) + every(100, [*seen, 2 * OFF, 2 * OFF], 30, "camera")
    estimates = fused(rows, BOTH)
    assert outcomes(estimates)[4:10] == [FUSED, *[REJECTED] * 4, REACQUIRED]
    assert outcomes(estimates, "camera")[-2:] == [REJECTED, wanted]


# ---- the rule, by hand ----------------------------------------------------------------------------------------------


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

    def updated(self, nu: float, S: float, scale: float) -> Known:
        """Updated with one component; the gains are the covariances with it over S."""
        x, o = scale * (self.xx + self.xo) / S, scale * (self.xo + self.oo) / S
        means = self.x + x * nu, self.o + o * nu
        return Known(self.time, *means, self.xx - x * x * S, self.xo - x * o * S, self.oo - o * o * S)

    def motion(self, h: float) -> float:
        """Variance of p(t + h) − p(t)."""
        a = math.exp(-h / TAU)
        return (a - 1.0) ** 2 * self.xx + INPUT_NOISE**2 * (1.0 - a * a) / (2.0 * TAU) + DRIFT**2 * h


@dataclass
class Trust:
    """What the gate remembers of one sensor on one axis."""

    rejected: tuple[float, int] | None = None  # ν and time of the one to agree with
    in_a_row: int = 0
    fused: int | None = None
    reacquired: int = 0


@dataclass
class Judge:
    """Takes rows in their total order and decides by the rule."""

    sensors: Mapping[str, Sensor]
    known: dict[str, Known] = field(default_factory=lambda: {axis: Known() for axis in LEVEL})
    trust: dict[tuple[str, str], Trust] = field(default_factory=dict)
    unsettled: dict[str, int] = field(default_factory=dict)
    components: list[tuple[str, Outcome, float, float]] = field(default_factory=list)  # sensor, outcome, ν and S
    contradictions: list[tuple[str, str]] = field(default_factory=list)
    closest: float = math.inf  # of any decision to where it would be another

    def add(self, row: Row) -> None:
        together = self.sensors[row.sensor].gate_rows
        for axes in [list(row.off)] if together else [[axis] for axis in row.off]:
            self._decide(row, axes)

    def _decide(self, row: Row, axes: list[str]) -> None:
        sensor = self.sensors[row.sensor]
        found = {axis: self._expected(row, axis) for axis in axes}
        beyond = {axis for axis, (nu, S) in found.items() if sensor.gate and abs(nu) > sensor.gate * math.sqrt(S)}
        for nu, S in found.values():
            self.closest = min(self.closest, abs(abs(nu) / math.sqrt(S) - sensor.gate))
        verdicts = {self._verdict(row, axis, found[axis][0]) for axis in beyond}
        others = [other for axis in beyond if (other := self._other(row, axis))]
        if beyond and verdicts == {"agrees"} and others:
            names = list(self.sensors)
            self.contradictions.append((row.sensor, max(others, key=names.index)))
        if beyond and (others or verdicts != {"agrees"}):
            for axis, (nu, S) in found.items():
                trust = self._trust(row.sensor, axis)
                if "too soon" not in verdicts or trust.rejected is None:
                    trust.rejected = nu, row.valid
                trust.in_a_row += 1
                if trust.in_a_row > 1 and axis in self.unsettled:
                    self.unsettled[axis] = row.valid
                self.components.append((row.sensor, REJECTED, nu, S))
            return
        for axis, (nu, before) in found.items():
            S, trust = before, self._trust(row.sensor, axis)
            if axis in beyond:
                self.known[axis].oo += (nu / sensor.scale) ** 2
                S = self._expected(row, axis)[1]
                trust.reacquired += 1
                self.unsettled[axis] = row.valid
            self.known[axis] = self.known[axis].updated(nu, S, sensor.scale)
            self.components.append((row.sensor, REACQUIRED if axis in beyond else FUSED, nu, S))
            trust.rejected, trust.in_a_row, trust.fused = None, 0, row.valid
            self._settle(axis, row.valid)

    def _trust(self, sensor: str, axis: str) -> Trust:
        return self.trust.setdefault((sensor, axis), Trust())

    def _verdict(self, row: Row, axis: str, nu: float) -> str:
        before, sensor = self._trust(row.sensor, axis).rejected, self.sensors[row.sensor]
        if before is None:
            return "is the first"
        if row.valid - before[1] < T:
            return "too soon"
        motion = sensor.scale**2 * self.known[axis].motion((row.valid - before[1]) / 1e9)
        spread = abs(nu - before[0]) / math.sqrt(2.0 * sensor.sd**2 + motion)
        self.closest = min(self.closest, abs(spread - sensor.gate))
        return "agrees" if spread <= sensor.gate else "disagrees"

    def _other(self, row: Row, axis: str) -> str | None:
        own = self._trust(row.sensor, axis).reacquired
        for other in self.sensors:
            trust = self._trust(other, axis)
            recent = trust.fused is not None and row.valid - trust.fused <= 500 * MS
            if other != row.sensor and recent and trust.reacquired <= own:
                return other
        return None

    def _settle(self, axis: str, now: int) -> None:
        of_axis = [self._trust(name, axis) for name in self.sensors]
        agreed = all(one.fused is None or now - one.fused <= 5000 * MS for one in of_axis)
        if agreed and axis in self.unsettled and now - self.unsettled[axis] >= 5000 * MS:
            del self.unsettled[axis]
            for one in of_axis:
                one.reacquired = 0

    def _expected(self, row: Row, axis: str) -> tuple[float, float]:
        """ν and S."""
        sensor, known = self.sensors[row.sensor], self.known[axis].at(row.valid)
        self.known[axis] = known
        assert isinstance(sensor.sd, float)
        return sensor.scale * (row.off[axis] - known.x - known.o), sensor.scale**2 * known.variance + sensor.sd**2


def judged(rows: Iterable[Row], sensors: Mapping[str, Sensor]) -> Judge:
    judge, rank = Judge(sensors), list(sensors)
    for row in sorted(rows, key=lambda row: (row.valid, rank.index(row.sensor))):
        judge.add(row)
    return judge


def check_estimates(estimates: Estimates, rows: Sequence[Row], sensors: Mapping[str, Sensor], as_live: bool) -> None:
    """Each axis at each instant, everything judged anew from what had arrived by then; to 1e-9 of an sd."""
    late = {name: round(sensor.latency * 1e9) if as_live else 0 for name, sensor in sensors.items()}
    times = [round(t * 1e9) for t in estimates.time.tolist()]
    judges = [judged([row for row in rows if row.valid + late[row.sensor] <= time], sensors) for time in times]
    for axis in LEVEL:
        known = [judge.known[axis].at(time) for judge, time in zip(judges, times, strict=True)]
        x, o, variance, oo = np.array([(one.x, one.o, one.variance, one.oo) for one in known]).T
        motion = np.array([one.motion(0.028) for one in known])
        wanted = {
            "position": (LEVEL[axis] + x + o, variance),
            "velocity": (x * math.expm1(-0.028 / TAU) / 0.028, motion / 0.028**2),
            "offset": (o, oo),
        }
        for name, (mean, square) in wanted.items():
            np.testing.assert_allclose(getattr(estimates[axis], f"{name}_sd") ** 2, square, rtol=1e-9, err_msg=name)
            difference = np.abs(getattr(estimates[axis], name) - mean)
            assert (difference <= 1e-9 * np.sqrt(square) + 1e-12).all(), name


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
    """Spells of rows that are off on no, one or both axes, in part by amounts that change from row to row."""
    sensors = {
        name: sensor(
            draw(st.sampled_from([5.0, 5.0, 3.0, 0.0])),
            draw(st.sampled_from([0.2e-3, 1e-3])),
            scale=draw(st.sampled_from([1.0, -1.0, 2.0])),
            gate_rows=draw(st.booleans()),
            latency=draw(st.sampled_from([0.0, 0.03, 0.25])),
        )
        for name in draw(st.sampled_from([["tracker"], ["tracker", "camera"], ["camera", "tracker"]]))
    }
    found = []
    for name in sensors:
        interval = draw(st.sampled_from([10.0, 50.0, 111.0, 700.0]))
        spells = draw(st.lists(st.tuples(st.integers(1, 12), st.sampled_from(SPELLS)), min_size=2, max_size=4))
        rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
        scatter = draw(st.sampled_from([0.3e-3, 0.3e-3, 3e-3]))
        for k, off in enumerate(off for count, off in spells for _ in range(count)):
            noisy = {axis: value + float(rng.normal(0.0, scatter)) for axis, value in off.items()}
            found.append(Row(round(k * interval * MS), name, noisy))
    return found, sensors


def check_log(rows: list[Row], sensors: dict[str, Sensor], as_live: bool) -> None:
    judge = judged(rows, sensors)
    assume(judge.closest > 1e-6)
    estimates = fused(rows, sensors, mode="as-live" if as_live else "filtered")
    if not as_live:
        decided = estimates.measurements.where(estimates.measurements.outcome <= REACQUIRED)
        name, outcome, nu, S = zip(*judge.components, strict=True)
        assert [decided.sensors[index] for index in decided.sensor] == list(name)
        assert [Outcome(code) for code in decided.outcome] == list(outcome)
        np.testing.assert_allclose(decided.innovation, nu, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(decided.innovation_sd**2, S, rtol=1e-9)
        if all(sensor.gate_rows for sensor in sensors.values()):  # else it is said of a row once for all its axes
            assert sorted(contradictions(rows, sensors)) == sorted(judge.contradictions)
    check_estimates(estimates, rows, sensors, as_live)


@settings(max_examples=60)
@given(logs(), st.booleans())
def test_any_log_is_decided_as_the_rule_says(log: tuple[list[Row], dict[str, Sensor]], as_live: bool) -> None:
    """Outcomes, innovations, estimates and error bars are those worked out by hand, with all that had arrived."""
    check_log(*log, as_live)


# ---- the likelihood -------------------------------------------------------------------------------------------------
