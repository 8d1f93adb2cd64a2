"""The gate's rule, on constructed runs of an arm at rest and against the filterpy engine, which has its own."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.test_engines import agree, agree_on_axes
from pumafuse.errors import PumafuseWarning
from pumafuse.filter.outcome import Outcome
from pumafuse.fusion.config import FusionConfig, Process, Sensor, Start
from pumafuse.fusion.engine import filter_segment
from pumafuse.fusion.estimates import AxisEstimate, Estimates
from pumafuse.fusion.offline import fuse
from pumafuse.fusion.segments import build_segment
from pumafuse.logs.run import Run
from pumafuse.model.arm import ArmModel, AxisModel
from pumafuse.model.plants import FirstOrder

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.errors.PumafuseWarning")
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
        if mine:
            values = {axis: [of.scale * (LEVEL[axis] + row.off.get(axis, np.nan)) for row in mine] for axis in seen}
            streams[name] = stamps, values
    return Run.from_arrays(np.zeros(1, dtype=np.int64), {axis: [u] for axis, u in LEVEL.items()}, streams), config


TRACKER = {"tracker": sensor()}
BOTH = {"tracker": sensor(), "camera": sensor()}


def fused(rows: Iterable[Row], sensors: Mapping[str, Sensor] = TRACKER, **kwargs: object) -> Estimates:
    return fuse(*recorded(rows, sensors), rate=20.0, **kwargs)


def outcomes(estimates: Estimates, name: str = "tracker", axis: str = "radial") -> list[Outcome]:
    return [Outcome(code) for code in estimates.measurements.of(name, axis).outcome]


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


@pytest.mark.parametrize(
    ("engine", "kind", "share", "second"),
    [
        ("compiled", "matern", 0.99, REACQUIRED),
        ("compiled", "ou", 1.01, REJECTED),
        ("filterpy", "ou", 0.99, REACQUIRED),
    ],
)
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
    assert outcomes(fuse(run, config, engine=engine)) == [REJECTED, second]


# ---- two sensors ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("since", "wanted"), [(500.0, REJECTED), (500.000001, REACQUIRED)])
def test_a_sensor_stands_for_what_is_believed_for_half_a_second(since: float, wanted: Outcome) -> None:
    """From then on another one may re-acquire."""
    rows = every(100, [0.0] * 5) + rows_at([400 + since / 2, 400 + since], [OFF, OFF], "camera")
    assert outcomes(fused(rows, BOTH), "camera") == [REJECTED, wanted]


@pytest.mark.parametrize(
    ("engine", "settled", "quarrel", "wanted"),
    [
        ("compiled", 4.5, [], REACQUIRED),
        ("compiled", 5.5, [], REJECTED),
        ("filterpy", 5.5, [3 * OFF, 5 * OFF], REACQUIRED),
    ],
)
def test_re_acquisitions_are_forgotten_after_five_seconds_of_agreement(
    settled: float, quarrel: list[float], wanted: Outcome, engine: str
) -> None:
    """Until then a sensor that followed the arm by itself does not stand against one that did not."""
    seen = [0.0] * 4 + [OFF] * round(10 * settled + 5)
    seen[30 : 30 + len(quarrel)] = quarrel
    rows = every(100, [0.0, *seen, *[OFF] * 10]) + every(100, [*seen, 2 * OFF, 2 * OFF], 30, "camera")
    estimates = fused(rows, BOTH, engine=engine)
    assert outcomes(estimates)[4:10] == [FUSED, *[REJECTED] * 4, REACQUIRED]
    assert outcomes(estimates, "camera")[-2:] == [REJECTED, wanted]


# ---- any log ---------------------------------------------------------------------------------------------------------

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


@settings(max_examples=15)
@given(logs())
def test_any_log_is_decided_as_by_the_reference(log: tuple[list[Row], dict[str, Sensor]]) -> None:
    """Outcomes, innovations, contradictions, estimates; and as live, the reference's of what had arrived."""
    rows, sensors = log
    times = np.linspace(0.0, max(row.valid for row in rows), 5)[1:].astype(np.int64)
    run, config = recorded(rows, sensors)
    segment = build_segment(run, config)
    agree(*(filter_segment(segment, config, times, "filtered", engine) for engine in ("compiled", "filterpy")))
    live = filter_segment(segment, config, times, "as-live")
    for n, time in enumerate(times.tolist()):
        arrived = [row for row in rows if row.valid + round(sensors[row.sensor].latency * 1e9) <= time]
        then = filter_segment(
            build_segment(*recorded(arrived, sensors)), config, times[n : n + 1], "filtered", "filterpy"
        )
        agree_on_axes({axis: at(one, n) for axis, one in live.axes.items()}, then.axes)


def at(estimate: AxisEstimate, n: int) -> AxisEstimate:
    return AxisEstimate(*(getattr(estimate, name)[n : n + 1] for name in AxisEstimate.FIELDS))
