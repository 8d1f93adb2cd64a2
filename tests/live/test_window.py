"""The window's memory: it grows with a dense stream, within a bound, and nothing in it is lost or left behind."""

from __future__ import annotations

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.live import window
from streams import differences, events_of

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
MS = 1_000_000
GAIN = pf.Gain(slope=0.05, intercept=0.98)


def config_of(recovery: float | None = 0.1, period: float = 0.028) -> pf.FusionConfig:
    axis = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.05), gain=GAIN, gain_recovery=recovery)
    arm = pf.ArmModel(name="one", update_period=period, delay=0.06, axes={"radial": axis})
    return pf.FusionConfig(arm=arm, sensors={"fast": pf.Sensor(sd=1e-4, latency=0.01), "slow": pf.Sensor(sd=1e-3)})


def run_of(seconds: float, command_hz: float, measurement_hz: float) -> pf.Run:
    rng = np.random.default_rng(3)
    given = np.arange(0, seconds, 1.0 / command_hz)
    heard = np.arange(0, seconds, 1.0 / measurement_hz)
    measurements = (heard, {"radial": 0.5 + rng.normal(0.0, 1e-4, len(heard))})
    return pf.Run.from_arrays(given, {"radial": 0.5 + 0.01 * np.sin(given)}, {"fast": measurements})


@pytest.mark.parametrize(("command_hz", "measurement_hz"), [(36.0, 6000.0), (1000.0, 100.0), (3000.0, 3000.0)])
def test_more_than_the_first_arrays_hold(command_hz: float, measurement_hz: float) -> None:
    """Thousands of rows and commands in the window: the arrays grow, and the estimates are the offline ones."""
    run, config = run_of(3.0, command_hz, measurement_hz), config_of(period=1.0 / command_hz)
    live = pf.LiveEstimator(config)
    assert differences(live, events_of(run), pf.fuse(run, config), 1.5) == []
    memory = live._window.memory
    assert max(len(memory.heard.stamp) - 4096, memory.commands.time.shape[1] - 512) > 0


def test_the_first_arrays_serve_for_ever() -> None:
    """A usual stream is kept in the arrays that were there at first, however long it is."""
    run, config = run_of(120.0, 36.0, 200.0), config_of()
    live = pf.LiveEstimator(config)
    assert differences(live, events_of(run), pf.fuse(run, config), 0.1) == []
    memory = live._window.memory
    assert len(memory.heard.stamp) == 4096
    assert memory.commands.time.shape[1] == 512
    assert memory.axes.first[-1] == 1024


def test_long_decays_and_long_silence() -> None:
    """A gain error that recovers slowly is carried on over a minute of silence, and far ahead, as offline does."""
    config = config_of(recovery=20.0)
    given = np.concatenate((np.arange(0.0, 2.0, 0.028), [60.0, 60.028, 60.5]))
    run = pf.Run.from_arrays(
        given, {"radial": 0.5 + 0.001 * given}, {"fast": ([0.5, 30.0, 61.0], {"radial": [0.5] * 3})}
    )
    live, offline = pf.LiveEstimator(config, window=100.0), pf.fuse(run, config)
    assert live.estimate(90.0).outcome is pf.Outcome.BEFORE_START
    events = events_of(run)
    for event in events[:50]:
        live.command(event.stamp, **event.values) if not event.sensor else live.measurement(
            event.stamp, "fast", radial=0.5
        )
        live.estimate(event.stamp + 120_000_000_000)
    assert differences(live, events[50:], offline, 1e9) == []


def test_a_flood_shortens_the_window_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """More rows than are ever kept: the oldest are let go, what is late beyond them is refused, estimates go on."""
    monkeypatch.setattr(window, "MOST_ROWS", 4096)
    live, config = pf.LiveEstimator(config_of()), config_of()
    live.command(0, radial=0.5)
    rng = np.random.default_rng(1)
    values = (0.5 + rng.normal(0.0, 1e-4, 20_000)).tolist()
    for row, value in enumerate(values):
        assert (
            live.measurement(row * MS // 20, "fast" if row % 2 else "slow", radial=value).outcome
            is not pf.Outcome.TOO_LATE
        )
    assert len(live._window.memory.heard.stamp) == 4096
    newest = live.newest
    assert live.measurement(newest - 300 * MS, "slow", radial=0.5).outcome is pf.Outcome.TOO_LATE
    assert live.estimate(newest - 300 * MS).outcome is pf.Outcome.TOO_LATE
    assert live.measurement(newest - 50 * MS, "slow", radial=0.5).outcome is pf.Outcome.FUSED
    assert sum(sum(sensor.outcomes.values()) for sensor in live.health().sensors.values()) == 20_002
    run = pf.Run.from_arrays(
        np.array([0]),
        {"radial": np.array([0.5])},
        {
            name: (np.arange(start, 20_000, 2) * MS // 20, {"radial": np.array(values[start::2])})
            for name, start in (("fast", 1), ("slow", 0))
        },
    )
    untouched = pf.LiveEstimator(config)
    for event in events_of(run):
        untouched.measurement(event.stamp, event.sensor, **event.values) if event.sensor else untouched.command(
            event.stamp, **event.values
        )
    expected = pf.fuse(run, config, rate=1000.0)
    assert untouched.estimate(round(expected.time[-1] * 1e9))["radial"].position == expected["radial"].position[-1]


def test_a_flood_of_commands_shortens_the_window(monkeypatch: pytest.MonkeyPatch) -> None:
    """More commands than are ever kept: the oldest are let go, and the estimate is still the offline one."""
    monkeypatch.setattr(window, "MOST_ROWS", 1024)
    config = config_of(recovery=None)
    given = np.arange(5000) * MS // 4
    run = pf.Run.from_arrays(given, {"radial": 0.5 + 1e-6 * np.arange(5000)}, {"fast": ([0], {"radial": [0.5]})})
    live = pf.LiveEstimator(config)
    for event in events_of(run):
        live.command(event.stamp, **event.values) if not event.sensor else live.measurement(
            event.stamp, "fast", radial=0.5
        )
    assert live._window.memory.commands.time.shape[1] == 1024
    offline = pf.fuse(run, config)
    assert live.estimate(int(given[-1]))["radial"].position == offline["radial"].position[-1]
    assert live.command(int(given[0]) + 1, radial=0.4).outcome is pf.Outcome.TOO_LATE


def test_what_the_window_lets_go_for_an_event_is_gone_for_that_event_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Room for a late event costs the oldest eighth of the window: an event that is older still is too late."""
    monkeypatch.setattr(window, "MOST_ROWS", 1024)
    live, clean = (pf.LiveEstimator(config_of(recovery=None), window=600.0) for _ in range(2))
    for step in range(1024):
        for one in (live, clean):
            one.command(step * 28 * MS, radial=0.5 + 1e-5 * step)
            one.measurement(step * 28 * MS, "fast", radial=0.5 + 1e-5 * step)
    told = live.command(14 * MS, radial=0.4)
    assert told.outcome is pf.Outcome.TOO_LATE
    assert "the window holds no more" in told.reason
    assert live.estimate(1023 * 28 * MS) == clean.estimate(1023 * 28 * MS)


def test_a_repeated_command_before_a_long_silence() -> None:
    """The last command is said again at once, then only measurements come: its error decays on as it does offline."""
    config = config_of(recovery=5.0)
    heard = np.arange(0.0, 80.0, 0.1)
    run = pf.Run.from_arrays(
        [0.0, 1.0, 1.01], {"radial": [0.5, 0.51, 0.51]}, {"fast": (heard, {"radial": np.full(len(heard), 0.51)})}
    )
    offline = pf.fuse(run, config, rate=50.0)
    live = pf.LiveEstimator(config)
    assert differences(live, events_of(run), offline, 0.5) == []


def test_an_hour_ahead_with_a_long_recovery() -> None:
    """The farthest estimate there is, of an arm with a tick each ms: memory is bounded, the command table as it was."""
    live = pf.LiveEstimator(config_of(recovery=9.9, period=0.001))
    live.command(0, radial=0.5)
    live.command(MS, radial=0.51)
    assert live.estimate(3600 * 1000 * MS).outcome is pf.Outcome.FUSED
    memory = live._window.memory
    assert memory.axes.first[1] <= 2**20
    assert memory.commands.time.shape[1] == 512


def test_a_frozen_stamp_ends_in_a_shorter_window(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sensor whose stamp stands still: its rows are taken as far as they fit, then refused with the reason."""
    monkeypatch.setattr(window, "MOST_ROWS", 4096)
    live = pf.LiveEstimator(config_of())
    live.command(0, radial=0.5)
    told = [live.measurement(100 * MS, "slow", radial=0.5 + 1e-9 * row) for row in range(5000)]
    assert told[4000].outcome is pf.Outcome.FUSED
    assert told[-1].outcome is pf.Outcome.TOO_LATE
    assert "the window holds no more" in told[-1].reason
    assert live.command(128 * MS, radial=0.5).outcome is pf.Outcome.FUSED
