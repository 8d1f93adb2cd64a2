"""What each call answers: outcomes with their reasons, and estimates of the past, the present and the future."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pumafuse as pf
from pumafuse.filter.outcome import ABSENT, Outcome
from pumafuse.live.commands import Commands
from pumafuse.logs.clock import clock_faults

ARM = pf.ArmModel.load("puma560-internal")
CONFIG = pf.FusionConfig(
    arm=ARM,
    sensors={
        "tracker": pf.Sensor(sd=5e-5, latency=0.008),
        "camera": pf.Sensor(sd={"radial": 5e-4}, latency=0.045, gate=3.0),
    },
)
PERIOD = 0.028


def running(seconds: float = 1.0, **options: object) -> pf.LiveEstimator:
    """An arm at rest that a tracker sees."""
    live = pf.LiveEstimator(CONFIG, **options)
    for step in range(round(seconds / PERIOD) + 1):
        live.command(step * PERIOD, radial=0.57, vertical=0.1)
        live.measurement(step * PERIOD + 0.01, "tracker", radial=0.57, vertical=0.1)
    return live


def test_the_future_is_where_the_last_command_leads() -> None:
    """A step is given: long after it the arm is there, and on the way the model alone says where; sd only grows."""
    live = running()
    t = 1.1
    live.command(t, radial=0.58)
    ahead = [live.estimate(t + dt) for dt in (0.0, 0.06, 0.1, 0.2, 1.0, 10.0)]
    positions = [estimate["radial"].position for estimate in ahead]
    assert positions == sorted(positions)
    assert abs(positions[1] - 0.57) < 1e-4
    assert abs(positions[-1] - 0.58) < 2e-4
    spread = [estimate["radial"].position_sd for estimate in ahead]
    assert spread == sorted(spread)


def test_the_past_knows_no_later_measurement() -> None:
    """An estimate in the past is filtered by what was valid until then, and asking changes nothing."""
    live = running()
    before, now = live.estimate(0.8), live.estimate()
    live.measurement(1.3, "tracker", radial=0.60, vertical=0.1)
    assert live.estimate(0.8)["radial"] == before["radial"]
    assert now.reason == "now"
    assert before.reason == "filtered"
    assert live.estimate() == live.estimate(live.newest)


def test_times_that_have_no_estimate_say_why() -> None:
    """Before the first command, before the window, more than an hour ahead, or no time at all."""
    live = running(4.0)
    assert live.estimate(-0.1).outcome is pf.Outcome.BEFORE_START
    assert live.estimate(1.0).outcome is pf.Outcome.TOO_LATE
    assert "before the window" in live.estimate(1.0).reason
    assert live.estimate(2.1).outcome is pf.Outcome.FUSED
    assert live.estimate(4000.0).outcome is pf.Outcome.INVALID
    for nonsense in (math.nan, math.inf, 1e300, "now", [1.0], 10**5000, True):
        assert live.estimate(nonsense).outcome is pf.Outcome.INVALID
        assert live.command(nonsense, radial=0.57).outcome is pf.Outcome.INVALID
        assert live.measurement(nonsense, "tracker", radial=0.57).outcome is pf.Outcome.INVALID
    with pytest.raises(pf.UnknownNameError, match="before the window"):
        live.estimate(1.0)["radial"]
    with pytest.raises(pf.UnknownNameError, match="accepted: radial, vertical"):
        live.estimate(3.0)["tangential"]


def test_a_late_measurement_within_the_window_is_fused_and_beyond_it_is_too_late() -> None:
    """Two seconds late is in time, a nanosecond more is not; the reason tells by how much."""
    live = running(4.0)
    newest = live.newest
    assert live.measurement(newest - 2_000_000_000, "tracker", radial=0.57).outcome is pf.Outcome.FUSED
    told = live.measurement(newest - 2_000_000_001, "tracker", radial=0.57)
    assert told.outcome is pf.Outcome.TOO_LATE
    assert told.reason == "stamped 2.000 s behind the newest; the window is 2 s"
    assert live.command(newest - 2_000_000_001, radial=0.57).outcome is pf.Outcome.TOO_LATE
    wider = running(4.0, window=3.0)
    assert wider.measurement(newest - 2_500_000_000, "tracker", radial=0.57).outcome is pf.Outcome.FUSED


@pytest.mark.parametrize(
    ("sensor", "axes", "outcome", "reason"),
    [
        ("lidar", {"radial": 0.57}, "unknown", "accepted: tracker, camera"),
        ("traker", {"radial": 0.57}, "unknown", "did you mean 'tracker'"),
        ("tracker", {}, "unknown", "gives no axis"),
        ("camera", {"vertical": 0.1}, "unknown", "no such sensor or axis"),
        ("tracker", {"radial": math.nan}, "invalid", "not a finite position"),
        ("tracker", {"radial": 1e300}, "invalid", "not a finite position"),
        ("tracker", {"radial": 10**400}, "invalid", "not a finite position"),
        ("tracker", {"radial": "0.57"}, "invalid", "not a finite position"),
        ("tracker", {"radial": True}, "invalid", "not a finite position"),
        (["tracker"], {"radial": 0.57}, "unknown", "unknown sensor"),
        ("camera", {"radial": 0.9}, "rejected", "gate"),
    ],
)
def test_what_cannot_be_used_says_so(sensor: str, axes: dict, outcome: str, reason: str) -> None:
    """No bad measurement raises or changes the estimate; the outcome and the reason say what is wrong."""
    live = running()
    before = live.estimate(1.2)["radial"].position
    told = live.measurement(1.05, sensor, **axes)
    assert told.outcome.word == outcome
    assert reason in told.reason
    assert live.estimate(1.2)["radial"].position == before


def test_a_row_that_is_good_in_part_is_used_in_part() -> None:
    """One axis is not a number, one name is unknown: the rest is fused, and each has its outcome."""
    live = running()
    told = live.measurement(1.05, "tracker", radial=0.57, vertical=math.nan, quality=0.9)
    assert told.outcome is pf.Outcome.FUSED
    assert {axis: outcome.word for axis, outcome in told.axes.items()} == {
        "radial": "fused",
        "vertical": "invalid",
        "quality": "unknown",
    }
    assert "unknown axis 'quality'" in told.reason


def test_commands_answer_too() -> None:
    """Taken, said before, repeated within half a period, not finite, of no axis; also the first one of all."""
    live = pf.LiveEstimator(CONFIG)
    for nowhere in (1e300, math.nan):
        assert live.command(0, radial=nowhere).outcome is pf.Outcome.INVALID
    assert live.command(28_000_000, radial=0.5).outcome is pf.Outcome.FUSED
    assert live.estimate(28_000_000)["radial"].position == 0.5
    live = running()
    assert live.command(1.1, radial=0.58).outcome is pf.Outcome.FUSED
    assert live.command(1.1, radial=0.58).outcome is pf.Outcome.DUPLICATE
    assert live.command(1.105, radial=0.58).outcome is pf.Outcome.DUPLICATE
    assert live.command(1.128, radial=0.58).outcome is pf.Outcome.FUSED
    assert live.command(1.15, radial=math.nan).outcome is pf.Outcome.INVALID
    assert live.command(1.15, x=0.1).outcome is pf.Outcome.UNKNOWN
    assert live.command(math.nan, radial=0.5).outcome is pf.Outcome.INVALID


def test_silence_only_makes_the_estimate_less_certain() -> None:
    """Without measurements the sd grows and the axis is stale after the limit; a measurement ends that."""
    live = running(1.0, stale_after=0.5)
    assert live.estimate().stale == ()
    for step in range(37, 100):
        live.command(step * PERIOD, radial=0.57, vertical=0.1)
    late = live.estimate()
    assert late.stale == ("radial", "vertical")
    assert late["radial"].position_sd > 2.0 * live.estimate(1.0)["radial"].position_sd
    live.measurement(late.stamp, "tracker", radial=0.57)
    assert live.estimate().stale == ("vertical",)
    assert live.estimate(live.newest + 10_000_000_000).stale == ("radial", "vertical")


@pytest.mark.parametrize(
    "wrong",
    [
        {"window": 0.0},
        {"window": "2"},
        {"stale_after": -1.0},
        {"start": {"radal": 0.1}},
        {"start": {"radial": math.nan}},
    ],
)
def test_what_is_wrong_at_the_start_is_refused(wrong: dict) -> None:
    with pytest.raises(pf.PumafuseError, match=r"window|stale_after|radal|start"):
        pf.LiveEstimator(CONFIG, **wrong)


@pytest.mark.parametrize(
    ("interval", "said"),
    [
        (PERIOD, ""),
        (0.02, f"every 20 ms, {0.02 / PERIOD:.3g} times the arm's update_period_ms = {PERIOD * 1e3:g}"),
        (2 * PERIOD, "2 times the arm's update_period_ms"),
        (1e3 * PERIOD, "are its stamps ms that are called s"),
    ],
)
def test_commands_at_another_interval_are_said_once(interval: float, said: str) -> None:
    """After the first hundred, which may come out of order, with both periods; nothing at the arm's own."""
    notices: list[str] = []
    live = pf.LiveEstimator(CONFIG, on_notice=notices.append)
    for number in (1, 0, *range(2, 99)):
        live.command(number * interval, radial=0.57)
    assert not any("interval" in text or "commands come" in text for text in notices)
    for number in range(99, 400):
        live.command(number * interval, radial=0.57)
    of_interval = [text for text in notices if "commands come" in text]
    assert len(of_interval) == bool(said)
    assert said in "".join(of_interval)


def test_who_contradicts_whom_is_said_with_axes_and_sizes() -> None:
    """The camera is 50 mm off beside the tracker, on radial alone: once it is told, with its number."""
    notices: list[str] = []
    live = running(on_notice=notices.append)
    for step in range(20):
        t = 1.0 + (step + 1) * PERIOD
        live.command(t, radial=0.57, vertical=0.1)
        live.measurement(t, "tracker", radial=0.57, vertical=0.1)
        live.measurement(t, "camera", radial=0.62)
    (said,) = [text for text in notices if "contradicts" in text]
    assert said.startswith("sensor 'camera' contradicts 'tracker' since 1.")
    assert said.endswith("s (radial by +50 mm): its measurements are rejected")
    assert live.health().faults == ("sensor 'camera' contradicts 'tracker': its measurements are rejected",)
    live.measurement(t + PERIOD / 2, "camera", radial=0.57)
    assert live.health().faults == ()


@pytest.mark.parametrize(("lost", "said"), [(0, False), (10, True), (50, False)])
def test_missing_commands_are_counted(lost: int, said: bool) -> None:
    """One in ten lost in motion: said with its number after a thousand; none, or one in fifty: nothing.

    They may come in another order.
    """
    notices: list[str] = []
    live = pf.LiveEstimator(CONFIG, on_notice=notices.append)
    sent = [number for number in range(1200) if not lost or number % lost != 3]
    for number in (one for pair in zip(sent[1::2], sent[::2], strict=True) for one in pair):
        live.command(1000.0 + number * PERIOD, radial=0.57 + 0.01 * math.sin(0.01 * number))
    last = sent[999]
    gaps = sum(number % lost == 3 for number in range(last)) if said else 0
    found = [text for text in notices if "missing" in text]
    assert len(found) == said
    if said:
        assert f"until {1000.0 + last * PERIOD:.3f} s {gaps} of" in found[0]
        assert f"one is due every {PERIOD * 1e3:g} ms), the longest gap is {2 * PERIOD:.3g} s" in found[0]


@pytest.mark.parametrize(("copied", "later"), [(False, 0.02), (True, 0.006)])
def test_two_senders_are_named_and_no_command_is_called_missing(later: float, copied: bool) -> None:
    """Two nodes, each at the arm's period: said once, with both intervals; recorded as live."""
    notices: list[str] = []
    live = pf.LiveEstimator(CONFIG, on_notice=notices.append)
    t = np.sort(np.concatenate([np.arange(1500) * PERIOD, np.arange(1500) * PERIOD + later]))
    u = 0.57 + 0.01 * np.sin(np.repeat(np.arange(1500) * PERIOD, 2) if copied else t)
    for time, value in zip(t.tolist(), u.tolist(), strict=True):
        live.command(time, radial=value)
    words = (
        f"commands of two senders: each sends every {PERIOD * 1e3:g} ms, one"
        f" {1e3 * min(later, PERIOD - later):g} ms after the other"
    )
    assert len([one for one in notices if words in one]) == 1
    assert not [one for one in notices if "missing" in one or "commands come every" in one]
    recorded = clock_faults(pf.Run.from_arrays(t, {"radial": u}), PERIOD, [])
    assert len(recorded) == 1 and words in recorded[0]
    twice = np.sort(np.concatenate([np.arange(len(t)), np.arange(0, len(t), 50)]))  # some rows are there twice
    recorded = clock_faults(pf.Run.from_arrays(t[twice], {"radial": u[twice]}), PERIOD, [])
    assert len(recorded) == 1 and words in recorded[0]


FUSED = int(Outcome.FUSED)
START = (0.25, np.nan)
COMMANDS = st.lists(
    st.tuples(
        st.integers(-20, 20),
        st.sampled_from([(FUSED, FUSED), (FUSED, ABSENT), (ABSENT, FUSED), (int(Outcome.INVALID), FUSED)]),
        st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    ),
    max_size=60,
)


@settings(max_examples=300)
@given(COMMANDS, st.integers(5, 25), st.integers(0, 25), st.booleans())
def test_any_order_of_commands_has_the_one_that_was_in_force(
    commands: list[tuple[int, tuple[int, int], tuple[float, float]]], window: int, back: int, forgets: bool
) -> None:
    """At any instant that the window may ask for, and the latest with its step, as in a table of all that was fused.

    Of one stamp the last that came counts. What is taken back was never there.
    """
    ours, table, newest = Commands(START), [{}, {}], -20
    for stamp, codes, values in commands:
        newest = max(newest, stamp)
        stamp = max(stamp, newest - window)
        ours.add(stamp, bytes(codes), values, newest - window)
        for axis in range(2):
            if codes[axis] == FUSED:
                table[axis][stamp] = values[axis]
    if forgets:
        after = newest - window + min(back, window)
        ours.forget(after)
        table = [{stamp: value for stamp, value in one.items() if stamp <= after} for one in table]
    for axis, (one, found) in enumerate(zip(table, ours.latest(), strict=True)):
        stamps = sorted(one)
        if not stamps:
            assert found is None
            assert ours.at(axis, newest) is None
            continue
        level = START[axis] if axis == 0 else one[stamps[0]]
        before = one[stamps[-2]] if len(stamps) > 1 else level
        assert found == (stamps[-1], one[stamps[-1]], one[stamps[-1]] - before)
        for instant in range(newest - window, newest + 2):
            passed = [stamp for stamp in stamps if stamp <= instant]
            assert ours.at(axis, instant) == (one[passed[-1]] if passed else level)
