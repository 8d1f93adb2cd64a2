"""The forward pass: in pieces or at once, with outcomes given, as live."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.arrays import FloatArray, TimeArray
from pumafuse.filter.core import Filter
from pumafuse.filter.events import COMMAND, Events, Results, concatenate
from pumafuse.filter.outcome import Outcome
from pumafuse.fusion.engine import model_of
from pumafuse.fusion.segments import Segment, build_segment

MS = 1_000_000  # ns
AXES = {
    "radial": pf.AxisModel(
        plant=pf.SecondOrder(natural_frequency=45.0, damping=0.5),
        gain=pf.Gain(slope=0.08, intercept=0.93),
        gain_recovery=0.1,
        lag_ci95=(0.07, 0.09),
    ),
    "vertical": pf.AxisModel(plant=pf.FirstOrder(time_constant=0.04), delay=0.01),
}
CONFIG = pf.FusionConfig(
    arm=pf.ArmModel(name="an arm", update_period=0.028, delay=0.06, axes=AXES),
    process={
        "radial": pf.Process(maneuver_noise=1e-3, maneuver_drift=1e-2, adaptation=0.1),
        "vertical": pf.Process(maneuver_noise=1e-3, maneuver_drift=1e-2),
    },
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
    return build_segment(pf.Run.from_arrays(stamp, command, streams), CONFIG)


GRID = 20 * MS * np.arange(160)
LAST = GRID[-1:]
NONE = GRID[:0]
slips = settings(max_examples=10)


class Pass:
    """A filter, and what becomes of events and estimates in all that it runs over."""

    def __init__(self, segment: Segment) -> None:
        self.core = Filter(model_of(segment, CONFIG), segment.origin)
        self.results, self.outputs = list[Results](), list[FloatArray]()

    def run(self, events: Events, times: TimeArray, span: tuple[int, int] | None = None) -> Pass:
        results = Results.room(*events.codes.shape)
        self.outputs.append(self.core.run(events, results, times, span=span))
        self.results.append(results.rows(np.arange(*span)) if span else results)
        return self

    def check(self, whole: Pass) -> None:
        """Every outcome, innovation and estimate, and the biases at the end, are those of another to the bit."""
        for mine, theirs in zip(zip(*self.results, strict=True), zip(*whole.results, strict=True), strict=True):
            np.testing.assert_array_equal(np.concatenate(mine), np.concatenate(theirs))
        np.testing.assert_array_equal(np.concatenate(self.outputs, axis=2), np.concatenate(whole.outputs, axis=2))
        assert [self.core.bias(1, axis) for axis in range(2)] == [whole.core.bias(1, axis) for axis in range(2)]


@slips
@given(st.integers(0, 1000), st.lists(st.integers(0, 3100), max_size=4), st.booleans())
def test_ordered_pieces_are_one_pass(seed: int, cuts: list[int], in_place: bool) -> None:
    """What a filter remembers, the gate included, goes on from call to call, in one table or in one for each.

    Where the table is one, an estimate also knows the commands that come after the piece.
    """
    segment = segment_of(seed)
    events, _ = segment.events(CONFIG)
    pieces, times = Pass(segment), GRID if in_place else LAST
    ends = [*np.sort(cuts).tolist(), 10**6]
    for begin, end in pairwise([-1, *ends]):
        rows = tuple(np.searchsorted(events.time, (begin * MS, end * MS), side="right").tolist())
        asked = times[(times > begin * MS) & (times <= end * MS)]
        if in_place:
            pieces.run(events, asked, rows)
        else:
            pieces.run(events.rows(slice(*rows)), asked)
    whole = Pass(segment).run(events, times)
    pieces.check(whole)
    assert {Outcome.REJECTED, Outcome.REACQUIRED} <= set(np.unique(whole.results[0].outcome))


def test_estimates_leave_no_trace() -> None:
    """Asked for or not, events become the same; and the instants before and after do not matter to an estimate."""
    segment = segment_of(1)
    events, _ = segment.events(CONFIG)
    without, dense, sparse = (Pass(segment).run(events, times) for times in (NONE, GRID, GRID[::7].copy()))
    np.testing.assert_array_equal(dense.outputs[0][:, :, ::7], sparse.outputs[0])
    for one in (without, dense, sparse):
        one.outputs = [one.core.run(events.rows(slice(0)), Results.room(0, 2), LAST)]
        one.check(without)


@slips
@given(st.integers(0, 1000))
def test_late_events_end_as_events_in_time(seed: int) -> None:
    """However late each measurement comes, an estimate after the last of them is that of the whole pass."""
    segment = segment_of(seed)
    events, _ = segment.events(CONFIG)
    arrival = events.stamp + np.random.default_rng(seed).integers(0, 1500 * MS, len(events.time))
    late = events._replace(stamp=np.where(events.source == COMMAND, events.stamp, arrival))
    times, live, results = np.append(GRID, arrival.max()), Pass(segment), Results.room(*events.codes.shape)
    live.outputs.append(live.core.run(late, results, times, "as-live")[:, :, -1:])
    live.results.append(results)
    live.check(Pass(segment).run(late, times[-1:]))


def test_tables_are_joined_with_the_spread_that_one_of_them_has() -> None:
    """A table without one has noise as configured."""
    plain, spread = Events.empty(2, 3), Events.empty(2, 2)._replace(spread=np.full((2, 2), 4.0))
    assert concatenate([plain, plain]).spread.shape == (0, 2)
    assert concatenate([plain, spread]).spread.tolist() == [[1.0, 1.0]] * 3 + [[4.0, 4.0]] * 2
    assert concatenate([plain, spread]).rows(np.array([4, 0])).spread.tolist() == [[4.0, 4.0], [1.0, 1.0]]
    assert concatenate([plain, spread]).columns([1]).spread.shape == (5, 1)


def test_a_window_that_grows_says_no_contradiction_of_good_sensors() -> None:
    """More events than the first arrays hold, all of them in agreement."""
    notices: list[str] = []
    live, rng = pf.LiveEstimator(CONFIG, on_notice=notices.append), np.random.default_rng(0)
    for k in range(5000):
        if k % 28 == 0:
            live.command(k * MS, radial=0.5)
        live.measurement(k * MS, "tracker", radial=0.5 + 1e-4 * rng.standard_normal())
    assert not [notice for notice in notices if "contradicts" in notice]
