"""The window: it grows with a dense stream, within a bound, and nothing in it is lost."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings

import pumafuse as pf
from pumafuse.arrays import FloatArray
from pumafuse.filter import window
from streams import MS, Event, T, any_stream, check_in_any_order, counted, delayed, differences, events_of, feed

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
GAIN = pf.Gain(slope=0.05, intercept=0.98)
FIRST, SECOND = pf.FirstOrder(time_constant=0.05), pf.SecondOrder(natural_frequency=50.0, damping=0.8)


def config_of(recovery: float | None = 0.1, period: float = 0.028, delay: float = 0.06) -> pf.FusionConfig:
    axis = pf.AxisModel(plant=FIRST, gain=GAIN, gain_recovery=recovery)
    arm = pf.ArmModel(name="one", update_period=period, delay=delay, axes={"radial": axis})
    return pf.FusionConfig(arm=arm, sensors={"fast": pf.Sensor(sd=1e-4, latency=0.01), "slow": pf.Sensor(sd=1e-3)})


def run_of(seconds: float, command_hz: float, measurement_hz: float) -> pf.Run:
    rng = np.random.default_rng(3)
    given = np.arange(0, seconds, 1.0 / command_hz)
    measured = np.arange(0, seconds, 1.0 / measurement_hz)
    measurements = (measured, {"radial": 0.5 + rng.normal(0.0, 1e-4, len(measured))})
    return pf.Run.from_arrays(given, {"radial": 0.5 + 0.01 * np.sin(given)}, {"fast": measurements})


# ---- room -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("command_hz", "measurement_hz"), [(36.0, 6000.0), (3000.0, 1000.0)])
def test_a_dense_stream_has_more_room(command_hz: float, measurement_hz: float) -> None:
    """Thousands of measurements or commands in the window: it grows, and the estimates are the offline ones."""
    run, config = run_of(3.0, command_hz, measurement_hz), config_of(period=1.0 / command_hz)
    assert differences(pf.LiveEstimator(config), events_of(run), pf.fuse(run, config), 1.5) == []


def test_the_first_room_serves_for_ever() -> None:
    """A usual stream stays in the memory that was there at first, however long it is; what is old leaves it."""
    run, config = run_of(60.0, 36.0, 200.0), config_of()
    live = pf.LiveEstimator(config)
    assert differences(live, events_of(run), pf.fuse(run, config), 0.1) == []
    assert live._window.port.room == window.FIRST_ROWS
    port = live._window.port
    assert port.end - port.begin < 2.2 * 236.0


def flood(live: pf.LiveEstimator, values: FloatArray) -> None:
    """A measurement each 50 µs, of two sensors in turn."""
    for row, value in enumerate(values.tolist()):
        told = live.measurement(row * MS // 20, "fast" if row % 2 else "slow", radial=value)
        assert told.outcome is not pf.Outcome.TOO_LATE


def test_a_flood_of_measurements_shortens_the_window_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """More rows than are ever kept: the oldest are let go, what is later than them is refused, no estimate changes."""
    values = 0.5 + np.random.default_rng(1).normal(0.0, 1e-4, 20_000)
    whole = pf.LiveEstimator(config_of())
    whole.command(0, radial=0.5)
    flood(whole, values)
    monkeypatch.setattr(window, "MOST_ROWS", 4096)
    live = pf.LiveEstimator(config_of())
    live.command(0, radial=0.5)
    flood(live, values)
    newest = live.newest
    for time in (newest - 100 * MS, newest, newest + 100 * MS):
        assert live.estimate(time) == whole.estimate(time)
    told = live.measurement(newest - 300 * MS, "slow", radial=0.5)
    assert told.outcome is pf.Outcome.TOO_LATE
    assert "the window holds no more" in told.reason
    assert live.estimate(newest - 300 * MS).outcome is pf.Outcome.TOO_LATE
    assert live.measurement(newest - 50 * MS, "slow", radial=0.5).outcome is pf.Outcome.FUSED
    assert sum(sum(sensor.outcomes.values()) for sensor in live.health().sensors.values()) == 20_002


# ---- time -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stamp", [10**18, -4_599_990_000 * 10**9])
def test_any_clock_gives_the_same_estimates(stamp: int) -> None:
    """Stamps from 1824 to 2115, and a window of an hour: only differences count, and they are exact."""

    def estimates(origin: int) -> list[object]:
        live = pf.LiveEstimator(config_of(), window=3600.0)
        for step in range(20):
            live.command(np.int64(origin + step * T), radial=0.5 + 1e-3 * step)
            live.measurement(origin + step * T + 10 * MS, "fast", radial=0.5)
        return [live.estimate(origin + time)["radial"] for time in (0, 300 * MS, 600 * MS)]

    assert estimates(stamp) == estimates(0)


# ---- any stream -----------------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(any_stream())
def test_any_order_of_arrival_gives_the_same_window(
    drawn: tuple[pf.FusionConfig, pf.Run, int],
) -> None:
    """Estimates and counts are those of the events by stamp; only of one stamp and source the order counts.

    Which axes are in doubt is told by what has come so far.
    """
    (config, run, seed), events = drawn, events_of(drawn[1])
    in_order, shuffled = (pf.LiveEstimator(config, window=20.0, start=run.start) for _ in range(2))
    for event in events:
        feed(in_order, event)
    queues: dict[tuple[int, str], list[Event]] = {}
    for event in events:
        queues.setdefault((event.stamp, event.sensor), []).append(event)
    for event in delayed(events, 5.0, seed):  # ties keep their order: whoever comes, the first of its queue goes
        feed(shuffled, queues[event.stamp, event.sensor].pop(0))
    assert counted(shuffled) == counted(in_order)
    for time in range(events[0].stamp, events[-1].stamp + 100 * MS, 130 * MS):
        assert replace(shuffled.estimate(time), doubtful=()) == replace(in_order.estimate(time), doubtful=())


@settings(max_examples=35)
@given(any_stream())
def test_a_window_of_a_millisecond_is_enough_for_a_stream_in_order(
    drawn: tuple[pf.FusionConfig, pf.Run, int],
) -> None:
    """What leaves the window is not lost: answers, counts and estimates are those of a window of 10 s."""
    config, events = drawn[0], events_of(drawn[1])
    start = dict.fromkeys(config.arm.axes, 0.49)  # else a first command makes earlier measurements of its axis usable
    wide, narrow = (pf.LiveEstimator(config, window=window, start=start) for window in (20.0, 1e-3))
    for event in events:
        assert feed(narrow, event) == feed(wide, event)
        for ahead in (0, 50 * MS):
            assert narrow.estimate(event.stamp + ahead).axes == wide.estimate(event.stamp + ahead).axes
    assert counted(narrow) == counted(wide)


@settings(max_examples=60)
@given(any_stream())
def test_any_stream_is_fused_as_offline(drawn: tuple[pf.FusionConfig, pf.Run, int]) -> None:
    """In any order of arrival: the same outcomes and, at every command, the same bits."""
    check_in_any_order(*drawn)
