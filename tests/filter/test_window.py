"""The core's window without what stands before it in a live estimator: of any size, fed with anything."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.filter import window
from pumafuse.filter.events import COMMAND
from pumafuse.filter.outcome import ABSENT, Outcome
from pumafuse.filter.window import Window
from pumafuse.fusion.setup import filter_model

MS = 1_000_000  # ns
T = 28 * MS
PLANTS = (pf.FirstOrder(time_constant=0.05), pf.SecondOrder(natural_frequency=50.0, damping=0.8))
SENSORS = {
    "tracker": pf.Sensor(sd=1e-4, latency=0.008, gate=3.0),
    "vision": pf.Sensor(sd=5e-4, latency=0.1, latency_sd=0.002, gate=2.0, gate_rows=False, bias_sd=1e-3),
    "ahead": pf.Sensor(sd=3e-4, latency=-0.05, scale=-1.0, bias_drift_sd=1e-3),
}
WRONG = (np.nan, np.inf, -np.inf, 1e300, -3.4e38, 1e6)


def empty(delays: tuple[float, ...]) -> Window:
    axes = {f"axis {n}": pf.AxisModel(plant=PLANTS[n % 2], delay=delay) for n, delay in enumerate(delays)}
    arm = pf.ArmModel(name="any", update_period=0.028, delay=0.06, axes=axes)
    process = dict.fromkeys(axes, pf.Process(maneuver_noise=1e-3, maneuver_drift=1e-2, adaptation=0.1))
    config = pf.FusionConfig(arm=arm, sensors=SENSORS, process=process)
    return Window(filter_model(config, tuple(axes), tuple(SENSORS), None, [["vision", "ahead"]] * len(axes)))


@settings(max_examples=40)
@given(
    st.integers(0, 2**32),
    st.lists(st.sampled_from([0.0, 0.06, 0.5]), min_size=1, max_size=3),
    st.sampled_from([(1, 1), (3, 3), (2, 8), (4, 100), (4096, 4096)]),
)
def test_a_window_of_any_size_takes_anything(seed: int, delays: list[float], rooms: tuple[int, int]) -> None:
    """Rows early and late, values that are none, clocks set back: every row can be read, every estimate is a number."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(window, "FIRST_ROWS", rooms[0])
        patch.setattr(window, "MOST_ROWS", rooms[1])
        live = empty(tuple(delays))
    rng, axes = np.random.default_rng(seed), len(delays)
    now, given, unread = int(rng.integers(-(10**18), 10**18)), np.zeros(3, dtype=np.int64), 0
    read = np.zeros(3, dtype=np.int64)  # values that were found in rows, by sensor

    def count(begin: int, end: int) -> None:
        stamp, source, results = live.read(begin, end)
        measured = source >= 0
        assert (stamp <= now).all()
        assert (results.outcome[measured] != Outcome.DUPLICATE).all()
        np.add.at(read, source[measured], np.count_nonzero(results.outcome[measured] != ABSENT, axis=1))

    assert live.estimate(now) == [None] * axes
    for _ in range(200):
        now += int(rng.choice([0, 1, MS, T, 300 * MS]))
        oldest = max(now - 1000 * MS, live.port.floor)
        stamp = max(int(now - rng.choice([0, 0, 1, 5 * MS, 900 * MS])), oldest)
        sensor, bits = int(rng.integers(-1, 3)), int(rng.integers(1, 2**axes))
        for axis in range(axes):
            level = -0.5 if sensor == 2 else 0.5
            live.value[axis] = rng.choice(WRONG) if rng.random() < 0.05 else level + rng.normal(0.0, 3e-3)
        rows = live.port.end
        taken = live.add(stamp, sensor, bits, oldest)
        assert taken or live.port.end == rows
        if taken and sensor != COMMAND:
            given[sensor] += bits.bit_count() * (live.port.end - rows)
        for axis, code in enumerate(live.outcome):
            assert not taken or (code == ABSENT) != bool(bits >> axis & 1)
        assert 0 <= live.port.end - live.port.begin <= live.port.room <= max(rooms[1], 32 * axes) * 2
        if live.port.begin - unread > live.port.room // 32:
            count(unread, live.port.begin)
            unread = live.port.begin
        for time in (stamp, now, now + 300 * MS):
            for found in live.estimate(time, *([stamp] if rng.random() < 0.5 else [])):
                if found is not None:
                    assert np.isfinite(found[0]).all()
                    assert min(found[0][1::2]) >= 0.0
        if rng.random() < 0.01:
            count(unread, live.port.end)
            kept = live.port.end
            unread, now = live.port.begin, max(now - 200 * MS, live.port.floor)
            live.forget(now)
            assert live.port.begin == unread <= live.port.end <= kept
            read -= counted_in(live)
    count(unread, live.port.end)
    assert read.tolist() == given.tolist()


def counted_in(live: Window) -> np.ndarray:
    """The values that are in a window, by sensor."""
    _, source, results = live.read(live.port.begin, live.port.end)
    values = np.count_nonzero(results.outcome != ABSENT, axis=1)
    return np.array([values[source == sensor].sum() for sensor in range(len(SENSORS))])
