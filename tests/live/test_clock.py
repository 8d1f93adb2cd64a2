"""Late, ahead, of another clock, of a clock that was reset: what stamps alone tell."""

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.filter.response import response
from pumafuse.live.clock import Clock, Verdict

SECOND = 1_000_000_000
T = 28_000_000
CONFIG = pf.FusionConfig(
    arm=pf.ArmModel.load("puma560-internal"), sensors={"tracker": pf.Sensor(sd=1e-4), "camera": pf.Sensor(sd=5e-4)}
)


def at(seconds: float) -> Clock:
    clock = Clock(2 * SECOND)
    clock.start(round(seconds * 1e9))
    return clock


@pytest.mark.parametrize("gap", [5, 3000])
def test_time_goes_on_after_a_pause_of_all(gap: int) -> None:
    """Two commands after a pause, or a second of measurements, end the doubt."""
    clock = at(0.0)
    assert clock.judge(gap * SECOND, source=None) is Verdict.ACCEPTED
    assert clock.sure == 0
    assert clock.judge(gap * SECOND + T, source=None) is Verdict.ACCEPTED
    assert clock.sure == gap * SECOND + T
    clock = at(0.0)
    for step in range(11):
        assert clock.judge(gap * SECOND + step * SECOND // 10, source="tracker") is Verdict.ACCEPTED
    assert clock.sure == (gap + 1) * SECOND


@pytest.mark.parametrize(("to", "verdict"), [(-3, Verdict.BEHIND), (4000, Verdict.AHEAD)])
def test_three_commands_of_another_time_are_a_reset(to: int, verdict: Verdict) -> None:
    """Behind the window, or ahead by more than an hour."""
    clock = at(100.0)
    verdicts = [clock.judge((100 + to) * SECOND + step * T, source=None) for step in range(3)]
    assert verdicts == [verdict, verdict, Verdict.RESET]


def test_a_command_of_the_right_time_rules_out_a_reset() -> None:
    """Two stale commands, a current one, two stale ones: no restart."""
    live = pf.LiveEstimator(CONFIG)
    for t in (100.0, 50.0, 50.028, 100.028, 50.056, 50.084):
        live.command(t, radial=0.5)
    assert live.segment == 0


@pytest.mark.parametrize("off", [{"camera": -30.0}, {"tracker": 30.0, "camera": 60.0}])
def test_sensors_of_other_clocks_disturb_nobody(off: dict[str, float]) -> None:
    """Wrong from the beginning on: no restart, and the estimate is that without them. Two do not confirm each other."""
    live, alone = pf.LiveEstimator(CONFIG), pf.LiveEstimator(CONFIG)
    for step in range(501):
        t = 0.028 * step
        for one in (live, alone):
            one.command(t, radial=0.5 + 1e-4 * step)
            if "tracker" not in off:
                one.measurement(t + 0.01, "tracker", radial=0.5 + 1e-4 * step)
        if step < 500:
            for sensor, by in off.items():
                live.measurement(t + 0.012 + by, sensor, radial=0.9)
    assert live.estimate(14.0) == alone.estimate(14.0)
    assert live.segment == 0
    health = live.health()
    assert health.sensors["camera"].outcomes["too_late" if off["camera"] < 0 else "invalid"] == 500
    assert "tracker" in off or health.sensors["tracker"].outcomes["fused"] == 501


def test_a_wild_command_is_taken_back() -> None:
    """One command half an hour ahead: when the next has the right time again, it is as if it had never come."""
    notices: list[str] = []
    live, clean = pf.LiveEstimator(CONFIG, on_notice=notices.append), pf.LiveEstimator(CONFIG)
    for step in range(200):
        t = 0.028 * step
        for one in (live, clean):
            one.command(t, radial=0.5 + 1e-4 * step, vertical=0.1)
            one.measurement(t + 0.01, "tracker", radial=0.5, vertical=0.1)
        if step in (100, 150):
            assert live.command(t + 1800.0, radial=9.0, vertical=9.0).outcome is pf.Outcome.FUSED
    assert live.estimate(5.6) == clean.estimate(5.6)
    assert live.health().commands == {**clean.health().commands, "invalid": 2}
    assert len(notices) == 2  # its speed, and that it was taken back; the next of these will be the tenth
    assert "a command ran 1799.972 s ahead of the others: taken back" in notices[1]


def test_a_measurement_cannot_contradict_a_command() -> None:
    """The controller's clock is set ahead by 30 s, the sensors' is not: commands go on, measurements are too late."""
    notices: list[str] = []
    live = pf.LiveEstimator(CONFIG, on_notice=notices.append)
    for step in range(1000):
        t = 0.028 * step
        live.command(t + (30.0 if step > 300 else 0.0), radial=0.5 + 1e-5 * step)
        live.measurement(t + 0.005, "tracker", radial=0.5 + 1e-5 * step)
    health = live.health()
    assert health.commands["fused"] == 1000
    assert live.newest == round((0.028 * 999 + 30.0) * 1e9)
    assert abs(live.estimate()["radial"].position - 0.51) < 1e-3
    assert 690 < health.sensors["tracker"].outcomes["too_late"] < 700
    assert notices == []


@pytest.mark.parametrize(("window", "off"), [(1e-3, 0.6), (0.3, -0.6), (1.0, 0.95), (2.0, 3.0)])
def test_one_sensor_ahead_or_behind_never_restarts_the_filter(window: float, off: float) -> None:
    """Whatever the window: no restart, no command lost, and within a second either way no measurement either."""
    live = pf.LiveEstimator(CONFIG, window=window, start={"radial": 0.5})
    for step in range(200):
        t = 10.0 + 0.028 * step
        live.command(t, radial=0.5 + 1e-4 * step)
        live.measurement(t + 0.01, "tracker", radial=0.5 + 1e-4 * step)
        live.measurement(t + 0.012 + off, "camera", radial=0.5)
    health = live.health()
    assert (live.segment, health.commands["fused"]) == (0, 200)
    bad = {name: health.sensors["camera"].outcomes[name] for name in ("too_late", "invalid")}
    assert off > 1.0 or not any(bad.values())
    assert sum(health.sensors["tracker"].outcomes[name] for name in bad) == 0


# ---- clocks that are set back by less than the window ---------------------------------------------------------------


def streamed(
    back: dict[str, float], seconds: float = 10.0, at: float = 5.0, rate: float = 100.0
) -> tuple[pf.LiveEstimator, list[str], float]:
    """A moving arm whose clocks are set ``back`` [s] at an instant, by source; notices, and the largest error then.

    Commands have no name, and each source that has none there goes on.
    """
    notices, worst = list[str](), 0.0
    live = pf.LiveEstimator(CONFIG, on_notice=notices.append)
    arm = CONFIG.arm
    given = np.arange(0.0, seconds, 0.028)
    u = 0.55 + 0.05 * np.sin(2.0 * given)
    stamp = np.rint(given * 1e9).astype(np.int64)
    seen = np.arange(0.1, seconds, 1.0 / rate)
    led, truths = (
        response(
            arm.axes["radial"],
            arm.update_period,
            arm.delay_of("radial"),
            stamp,
            u,
            float(u[0]),
            np.rint(time * 1e9).astype(np.int64),
        )
        for time in (seen, given)
    )
    noise = 1e-4 * np.random.default_rng(4).standard_normal(len(seen))
    events = [(t, "", value, truth) for t, value, truth in zip(given, u, truths, strict=True)]
    events += [(t, "tracker", value, 0.0) for t, value in zip(seen, led + noise, strict=True)]
    for t, sensor, value, truth in sorted(events, key=lambda event: (event[0], event[1] == "")):
        stamped = t - (back.get(sensor, 0.0) if t >= at else 0.0)
        if sensor:
            live.measurement(stamped, sensor, radial=value)
        else:
            live.command(stamped, radial=value)
            if t >= at + 1.0:
                worst = max(worst, abs(live.estimate(stamped)["radial"].position - truth))
    return live, notices, worst


@pytest.mark.parametrize(
    ("by", "rate"),
    [(0.9, 10.0), (0.12, 100.0), (1.8, 100.0)],
)
def test_all_clocks_that_are_set_back_begin_a_segment(by: float, rate: float) -> None:
    """As by NTP or a leap second: said with its size, nothing is lost nor counted twice, and estimates go on."""
    live, notices, worst = streamed({"": by, "tracker": by}, rate=rate)
    (told,) = [one for one in notices if "clock" in one]
    assert "all clocks were set back by" in told
    assert float(told.split(" by ")[1].split(" s at")[0]) == pytest.approx(by, abs=0.002)
    assert live.segment == 1 and worst < 5e-4
    health = live.health()
    assert health.commands["fused"] == sum(health.commands.values()) == 358
    tracker = health.sensors["tracker"]
    assert tracker.rows == sum(tracker.outcomes.values()) == round(9.9 * rate)


def test_the_clock_of_one_sensor_that_is_set_back_is_said_once() -> None:
    """The others go on, in the same segment."""
    live, notices, _ = streamed({"tracker": 0.06})
    (told,) = [one for one in notices if "step back" in one]
    assert told.startswith("sensor 'tracker': its stamps step back by")
    assert float(told.split(" by ")[1].split(" s at")[0]) == pytest.approx(0.06, abs=0.002)
    assert live.segment == 0


def test_commands_that_come_late_together_are_no_clock() -> None:
    """They fill a hole: what was missing is there, and the estimate is that of a stream in order."""
    late = slice(100, 130)
    order = [*range(late.start), *range(late.stop, 170), *range(late.start, late.stop), *range(170, 300)]
    notices = list[str]()
    live, clean = pf.LiveEstimator(CONFIG, on_notice=notices.append), pf.LiveEstimator(CONFIG)
    for one, steps in ((live, order), (clean, range(300))):
        for step in steps:
            one.command(0.028 * step, radial=0.5 + 1e-4 * step)
            one.measurement(0.028 * step + 0.01, "tracker", radial=0.5 + 1e-4 * step)
    assert live.segment == 0 and not [one for one in notices if "clock" in one]
    assert live.estimate().axes == clean.estimate().axes
