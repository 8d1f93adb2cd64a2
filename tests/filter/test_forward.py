"""The forward pass: in pieces or at once, with outcomes given, as live."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.arrays import CodeArray, FloatArray, TimeArray
from pumafuse.filter.axis import Model, Sensors, State
from pumafuse.filter.events import COMMAND, Events, Results, joined
from pumafuse.filter.forward import ALL_THERE, Filter, Output, filter_events, no_history
from pumafuse.filter.outcome import Outcome
from pumafuse.fusion.engine import arranged, biased_sensors
from pumafuse.fusion.segments import Segment, build

MS = 1_000_000  # ns
AXES = {
    "radial": pf.AxisModel(
        plant=pf.SecondOrder(natural_frequency=45.0, damping=0.5),
        gain=pf.Gain(slope=0.08, intercept=0.93),
        gain_recovery=0.1,
    ),
    "vertical": pf.AxisModel(plant=pf.FirstOrder(time_constant=0.04), delay=0.01),
}
CONFIG = pf.FusionConfig(
    arm=pf.ArmModel(name="an arm", update_period=0.028, delay=0.06, axes=AXES),
    process=dict.fromkeys(AXES, pf.Process(maneuver_noise=1e-3, maneuver_drift=1e-2)),
    sensors={
        "tracker": pf.Sensor(sd=1e-4, latency=0.008, gate=3.0),
        "camera": pf.Sensor(sd=5e-4, latency=0.1, latency_sd=0.002, gate=3.0, gate_rows=False, bias_sd=1e-3),
    },
)


def segment_of(seed: int) -> Segment:
    """Three seconds with outliers, and a slip of 20 mm that both sensors see."""
    rng, stamp = np.random.default_rng(seed), 28 * MS * np.arange(107)
    command = {axis: 0.5 + np.cumsum(rng.normal(0.0, 1e-3, len(stamp))) for axis in AXES}
    streams = {}
    for name, interval in (("tracker", 17 * MS), ("camera", 45 * MS)):
        valid = interval * np.arange(3000 * MS // interval)
        values = {}
        for axis in AXES:
            near = (
                np.interp(valid, stamp, command[axis]) + rng.normal(0.0, 1e-3, len(valid)) + 0.02 * (valid > 1500 * MS)
            )
            values[axis] = near + np.where(rng.random(len(valid)) < 0.05, 0.05, 0.0)
        streams[name] = valid + round(CONFIG.sensors[name].latency * 1e9), values
    return build(pf.Run.from_arrays(stamp, command, streams), CONFIG)


@dataclass
class Pass:
    """A state, and what becomes of events and estimates."""

    model: Model
    sensors: Sensors
    state: State
    results: list[Results]
    outputs: list[FloatArray]

    @staticmethod
    def over(segment: Segment, places: int = 0) -> Pass:
        return Pass(*arranged(segment, CONFIG, biased_sensors(segment, CONFIG), places), [], [])

    def run(self, events: Events, times: TimeArray, outcome: CodeArray | None = None) -> None:
        results, outputs = (
            Results.room(len(events.time), len(AXES)),
            np.zeros((len(Output), len(AXES), len(times))),
        )
        if outcome is not None:
            results.outcome[:] = outcome
        count, history = len(events.time), no_history(len(AXES), self.state.x.shape[1])
        arrays = Filter(self.model, self.sensors, events, self.state, results, history).flat()
        filter_events(arrays, outcome is not None, 0, count, count, *ALL_THERE, 0, times, outputs)
        self.results.append(results)
        self.outputs.append(outputs)

    def compare(self, other: Pass) -> None:
        """Every outcome, innovation and estimate, and the state at the end, to the bit."""
        for mine, theirs in zip(zip(*self.results, strict=True), zip(*other.results, strict=True), strict=True):
            np.testing.assert_array_equal(np.concatenate(mine), np.concatenate(theirs))
        np.testing.assert_array_equal(np.concatenate(self.outputs, axis=2), np.concatenate(other.outputs, axis=2))
        for mine, theirs in zip(self.state[:-1], other.state[:-1], strict=True):
            np.testing.assert_array_equal(mine[: len(AXES)], theirs[: len(AXES)])


GRID = 20 * MS * np.arange(160)


@settings(derandomize=True, deadline=None, max_examples=20)
@given(st.integers(0, 1000), st.lists(st.integers(0, 3100), max_size=4))
def test_ordered_pieces_are_one_pass(seed: int, cuts: list[int]) -> None:
    """A pass takes a state in and gives one out; what the gate remembers is part of it."""
    segment = segment_of(seed)
    events, _ = segment.events(CONFIG)
    whole, pieces = Pass.over(segment), Pass.over(segment)
    whole.run(events, np.empty(0, dtype=np.int64))
    edges = [0, *np.searchsorted(events.time, np.sort(cuts) * MS).tolist(), len(events.time)]
    for begin, end in pairwise(edges):
        pieces.run(events.rows(slice(begin, end)), np.empty(0, dtype=np.int64))
    pieces.compare(whole)
    assert {Outcome.REJECTED, Outcome.REACQUIRED} <= set(np.unique(whole.results[0].outcome))


def test_estimates_leave_no_trace() -> None:
    """Asked for or not, events become the same; and the instants before and after do not matter to an estimate."""
    segment = segment_of(1)
    events, _ = segment.events(CONFIG)
    without, dense, sparse = (Pass.over(segment) for _ in range(3))
    without.run(events, np.empty(0, dtype=np.int64))
    dense.run(events, GRID)
    sparse.run(events, GRID[::7].copy())
    np.testing.assert_array_equal(dense.results[0].outcome, without.results[0].outcome)
    np.testing.assert_array_equal(dense.state.x[:2], without.state.x[:2])
    np.testing.assert_array_equal(dense.outputs[0][:, :, ::7], sparse.outputs[0])


@settings(derandomize=True, deadline=None, max_examples=20)
@given(st.integers(0, 1000))
def test_late_events_end_as_events_in_time(seed: int) -> None:
    """However late each event comes, an estimate after the last of them is that of the whole pass."""
    segment = segment_of(seed)
    events, _ = segment.events(CONFIG)
    rng, count = np.random.default_rng(seed), len(events.time)
    arrival = events.time + rng.integers(0, 1500 * MS, count)
    arrival[events.source == COMMAND] = events.stamp[events.source == COMMAND]
    times = np.append(GRID, arrival.max())
    live, whole = Pass.over(segment, count + 1), Pass.over(segment)
    results, outputs = Results.room(count, 2), np.zeros((len(Output), 2, len(times)))
    arrived, history = np.zeros(count, dtype=np.bool_), no_history(len(AXES), live.state.x.shape[1])
    queue = np.argsort(arrival, kind="stable")
    arrays = Filter(live.model, live.sensors, events, live.state, results, history).flat()
    filter_events(arrays, False, 0, count, count, arrival, queue, arrived, count + 1, times, outputs)
    live.results.append(results)
    live.outputs.append(outputs[:, :, -1:])
    whole.run(events, times[-1:])
    live.compare(whole)


def test_tables_are_joined_with_the_spread_that_one_of_them_has() -> None:
    """A table without one has noise as configured."""
    plain, spread = Events.empty(2, 3), Events.empty(2, 2)._replace(spread=np.full((2, 2), 4.0))
    assert joined([plain, plain]).spread.shape == (0, 2)
    assert joined([plain, spread]).spread.tolist() == [[1.0, 1.0]] * 3 + [[4.0, 4.0]] * 2
    assert joined([plain, spread]).rows(np.array([4, 0])).spread.tolist() == [[4.0, 4.0], [1.0, 1.0]]
    assert joined([plain, spread]).columns([1]).spread.shape == (5, 1)


def test_a_window_that_grows_says_no_contradiction_of_good_sensors() -> None:
    """More events than the first arrays hold, all of them in agreement."""
    notices: list[str] = []
    live, rng = pf.LiveEstimator(CONFIG, on_notice=notices.append), np.random.default_rng(0)
    for k in range(5000):
        if k % 28 == 0:
            live.command(k * MS, radial=0.5)
        live.measurement(k * MS, "tracker", radial=0.5 + 1e-4 * rng.standard_normal())
    assert not [notice for notice in notices if "contradicts" in notice]
