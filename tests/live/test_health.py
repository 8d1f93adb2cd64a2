"""Rate, lateness, dropouts, NIS and outcomes of each sensor."""

import numpy as np
import pytest
from hypothesis import given, settings

import pumafuse as pf
from streams import any_stream, delayed, events_of, feed

CONFIG = pf.FusionConfig(
    arm=pf.ArmModel.load("puma560-internal"),
    process={"radial": pf.Process(input_noise=1e-7, drift=1e-7)},
    sensors={"tracker": pf.Sensor(sd=1e-4, gate=4.0), "camera": pf.Sensor(sd=5e-4), "never": pf.Sensor(sd=1.0)},
)


def stream(seconds: float, sd: float = 1e-4) -> pf.Run:
    """Commands that hold, and a tracker of 100 Hz."""
    rng = np.random.default_rng(7)
    commands, rows = np.arange(0.0, seconds, 0.028), np.arange(0.0, seconds, 0.01)
    return pf.Run.from_arrays(
        commands,
        {"radial": np.full(len(commands), 0.57)},
        {"tracker": (rows, {"radial": 0.57 + rng.normal(0.0, sd, len(rows))})},
    )


def test_a_right_sensor_has_its_rate_and_a_nis_of_one_until_its_noise_doubles() -> None:
    """100 Hz and noise as configured: NIS within the 99.99 % band of 6000 components. Then four, of the last minute."""
    live = pf.LiveEstimator(CONFIG)
    for event in events_of(stream(100.0)):
        feed(live, event)
    health = live.health().sensors["tracker"]
    assert health.rows == 10_000
    assert health.rate == pytest.approx(100.0, abs=1.0)
    assert health.nis == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 6000.0))
    assert (health.dropouts, health.lateness_max, health.stale) == (0, 0.0, False)
    assert health.outcomes["fused"] + health.outcomes["rejected"] == 10_000
    for event in events_of(stream(60.0, sd=2e-4)):
        feed(live, event._replace(stamp=event.stamp + round(100.04e9)))
    nis = live.health().sensors["tracker"].nis
    assert 3.0 < nis < 4.5  # the gate takes the largest away


def test_lateness_is_how_far_behind_the_newest_stamp_a_row_comes() -> None:
    """Delays even between 0 and 0.5 s: the mean is below 0.25 s, as the newest was late too. Late is no dropout."""
    live = pf.LiveEstimator(CONFIG)
    for event in delayed(events_of(stream(30.0)), 0.5, seed=1):
        feed(live, event)
    health = live.health().sensors["tracker"]
    assert 0.15 < health.lateness < 0.25
    assert 0.4 < health.lateness_max <= 0.5
    assert health.dropouts == 0


def test_gaps_are_dropouts_and_silence_is_stale() -> None:
    """Two gaps of 50 ms and a missing row in a 100 Hz stream are three dropouts; a silent sensor is stale."""
    live = pf.LiveEstimator(CONFIG)
    live.command(0.0, radial=0.57)
    for row in range(1000):
        if (row % 300 not in range(100, 105) and row != 50) or row // 300 == 2:
            live.measurement(row * 0.01, "tracker", radial=0.57)
    assert live.health().sensors["tracker"].dropouts == 3
    assert not live.health().sensors["tracker"].stale
    live.command(11.5, radial=0.57)
    health = live.health().sensors
    assert health["tracker"].stale
    assert health["tracker"].silent == pytest.approx(1.51)
    assert health["never"].silent is None
    assert health["never"].stale
    assert live.health(15.0).sensors["tracker"].silent == pytest.approx(5.01)  # while nothing comes at all
    assert live.health(1.0).sensors["tracker"].silent == pytest.approx(1.51)


def test_what_comes_too_late_has_come_and_says_how_late() -> None:
    """Three seconds behind a window of two: not one is fused, and the lateness says which window it takes."""
    live = pf.LiveEstimator(CONFIG)
    for step in range(400):
        live.command(step * 0.028, radial=0.57)
        if step > 150:
            live.measurement(step * 0.028 - 3.0, "camera", radial=0.57)
    health = live.health().sensors["camera"]
    assert health.rows == health.outcomes["too_late"] == 249
    assert health.lateness == pytest.approx(3.0) and health.lateness_max == pytest.approx(3.0)
    assert health.silent == pytest.approx(3.0)


@pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")
@settings(max_examples=40)
@given(any_stream())
def test_what_counts_is_what_became_of_a_row_in_the_end(drawn: tuple[pf.FusionConfig, pf.Run, int]) -> None:
    """Whatever comes late, commands too: NIS and outcomes are those of the innovations of the whole run."""
    config, run, seed = drawn
    offline, live = pf.fuse(run, config), pf.LiveEstimator(config, window=20.0, start=run.start)
    events = events_of(run)
    tied = {(event.stamp, event.sensor) for event in events}
    for event in delayed(events, 1.9, seed) if len(tied) == len(events) else events:
        feed(live, event)
    found, health = offline.measurements, live.health()
    taken = (found.outcome == pf.Outcome.FUSED) | (found.outcome == pf.Outcome.REACQUIRED)
    for number, name in enumerate(found.sensors):
        ours = taken & (found.sensor == number)
        if name in health.sensors and ours.any():
            nis = float(np.mean((found.innovation[ours] / found.innovation_sd[ours]) ** 2))
            assert health.sensors[name].nis == pytest.approx(nis, rel=1e-9)
            assert health.sensors[name].outcomes["fused"] == np.sum(found.outcome[ours] == pf.Outcome.FUSED)


def test_all_outcomes_are_counted() -> None:
    """A sensor that jumps by 20 mm is rejected for a period, then re-acquires; unknown and refused rows count, too."""
    live = pf.LiveEstimator(CONFIG)
    for row in range(400):
        live.command(row * 0.01, radial=0.57)
        live.measurement(row * 0.01, "tracker", radial=0.57 if row < 200 else 0.59)
    live.measurement(1.0, "tracker", radial=0.57)
    live.measurement(float("nan"), "tracker", radial=0.57)
    live.measurement(4.0, "lidar", radial=0.57)
    live.measurement(float("nan"), "lidar", radial=0.57)
    health = live.health()
    tracker = health.sensors["tracker"]
    assert tracker.reacquired == 1
    assert tracker.outcomes["rejected"] == 3  # rows of 10 ms in a period of 28 ms
    assert tracker.outcomes["too_late"] == 1
    assert tracker.outcomes["invalid"] == 1
    assert health.unknown == 2
    assert health.commands["fused"] + health.commands["duplicate"] == 400
    assert health.segments == 1
