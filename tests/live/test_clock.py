"""Late, ahead, of another clock, of a clock that was reset: what stamps alone tell."""

import pytest

import pumafuse as pf
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
    clock = at(100.0)
    for step in range(4):
        assert clock.judge(50 * SECOND + step * T, source=None) is Verdict.BEHIND
        if step == 1:
            clock.confirm()


def pair() -> tuple[pf.LiveEstimator, pf.LiveEstimator]:
    """An estimator that gets wrong stamps, too, and one that does not."""
    return pf.LiveEstimator(CONFIG), pf.LiveEstimator(CONFIG)


@pytest.mark.parametrize("off", [30.0, -30.0, 86_400.0 * 365])
def test_one_sensor_of_another_clock_disturbs_nobody(off: float) -> None:
    """A sensor whose clock is wrong from the beginning on: the estimate is that without it, and the filter goes on."""
    live, alone = pair()
    for step in range(501):
        t = 0.028 * step
        for one in (live, alone):
            one.command(t, radial=0.5 + 1e-4 * step)
            one.measurement(t + 0.01, "tracker", radial=0.5 + 1e-4 * step)
        if step < 500:
            live.measurement(t + 0.012 + off, "camera", radial=0.9)
    assert live.estimate(14.0)["radial"] == alone.estimate(14.0)["radial"]
    assert live.segment == 0
    outcomes = live.health().sensors["camera"].outcomes
    assert outcomes["too_late" if off < 0 else "invalid"] == 500
    assert live.health().sensors["tracker"].outcomes["fused"] == 501


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


def test_two_sensors_that_are_wrong_do_not_confirm_each_other() -> None:
    """One 30 s ahead, one 60 s ahead, and right commands: no restart, and the estimate is that of the commands."""
    live, alone = pair()
    for step in range(501):
        t = 0.028 * step
        for one in (live, alone):
            one.command(t, radial=0.5 + 1e-4 * step)
        if step < 500:
            live.measurement(t + 30.0, "tracker", radial=0.9)
            live.measurement(t + 60.0, "camera", radial=0.1)
    assert live.segment == 0
    assert live.estimate(14.0) == alone.estimate(14.0)
    assert live.health().sensors["camera"].outcomes["invalid"] == 500


def test_an_axis_that_only_a_wild_command_gave_is_forgotten() -> None:
    """Row gates look at axes that have begun: one that a wrong stamp began shuts no gate after it is taken back."""
    config = pf.FusionConfig(
        arm=CONFIG.arm, sensors={"tracker": pf.Sensor(sd=1e-4, gate=3.0)}, start=pf.Start(offset_sd=1e-5)
    )
    live, clean = pf.LiveEstimator(config), pf.LiveEstimator(config)
    for step in range(150):
        for one in (live, clean):
            one.command(0.028 * step, radial=0.5)
            one.measurement(0.028 * step + 0.01, "tracker", radial=0.5, vertical=0.1 + 0.01 * (step % 7))
        if step == 50:
            live.command(20.0, radial=0.5, vertical=0.9)
    assert live.health().sensors["tracker"].outcomes == clean.health().sensors["tracker"].outcomes
    assert live.estimate() == clean.estimate()


def test_now_is_not_where_a_sensor_alone_has_run_to() -> None:
    """In doubt about a measurement 30 s ahead, now is where all others are, and they are not called stale."""
    live = pf.LiveEstimator(CONFIG)
    for step in range(100):
        live.command(0.028 * step, radial=0.5)
        live.measurement(0.028 * step, "tracker", radial=0.5)
    live.measurement(32.0, "camera", radial=0.5)
    assert live.estimate().stamp == round(0.028 * 99e9)
    assert not live.health().sensors["tracker"].stale
    live.command(2.8, radial=0.5)
    camera = live.health().sensors["camera"]
    assert (camera.silent, camera.outcomes["invalid"]) == (None, 1)


@pytest.mark.parametrize("window", [1e-3, 0.3, 1.0, 2.0])
@pytest.mark.parametrize("off", [0.03, 0.6, 0.95, -0.6, 1.5, 3.0])
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
