"""From lines to lines: estimates at commands or on a grid, and bad lines that are counted and reported."""

import math
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.live.sources import replay
from pumafuse.logs.source import Source
from streams import TRACKED, Both, line, lines

pytestmark = pytest.mark.filterwarnings("ignore::pumafuse.PumafuseWarning")


def test_pieces_of_any_size() -> None:
    """An estimate at each command's time; cut anywhere, a last line without its end, Windows line ends: the same."""
    whole = Both()
    whole.feed(lines(1.0))
    rng, cut = np.random.default_rng(0), Both()
    data = lines(1.0).replace(b"\n", b"\r\n\n")[:-3]
    while data:
        size = int(rng.integers(1, 200))
        cut.feed(data[:size])
        data = data[size:]
    cut.end()
    assert cut.estimates == whole.estimates
    assert cut.stream.bad == 0
    assert [found["t"] for found in whole.estimates] == [step * 28 / 1000 for step in range(36)]
    assert whole.said == []


def test_silence_goes_on_by_the_wall_clock() -> None:
    """While nothing comes the grid goes on with growing sd, marked as stale; the state is not touched."""
    both = Both(rate=10.0)
    both.feed(lines(2.0))
    before = both.live.estimate()
    both.stream.idle(5_000_000_000)
    assert [found["t"] for found in both.estimates] == [step / 10 for step in range(51)]
    spread = [found["radial"]["sd_mm"] for found in both.estimates[20:]]
    assert spread == sorted(spread)
    assert both.estimates[-1]["stale"] == ["radial"]
    assert both.live.estimate() == before
    both.feed(lines(1.0, begin=5.5))
    times = [found["t"] for found in both.estimates]
    assert times == sorted(set(times))


def test_a_command_that_jumps_ahead_has_an_estimate_once_the_next_has_too() -> None:
    """One stamp that is 10 s ahead is taken back: no estimate of then, no word of missing commands. A pause goes on."""

    def moving(first: int, last: int) -> bytes:
        steps = ((step, 570.0 + 20.0 * math.sin(0.02 * step)) for step in range(first, last))
        return b"".join(line(step * 0.028, radial=radial) for step, radial in steps)

    both = Both()
    both.feed(moving(0, 900))
    before = len(both.estimates)
    both.feed(line(35.2, radial=553.0))
    assert len(both.estimates) == before
    both.feed(moving(900, 1500))
    assert [round(found["t"] / 0.028, 6) for found in both.estimates] == list(range(1500))
    assert [sentence for sentence in both.said if "taken back" not in sentence] == []
    paused = Both()
    paused.feed(moving(0, 100) + line(13.0, radial=572.0) + line(13.028, radial=572.0))
    assert [found["t"] for found in paused.estimates[-2:]] == [13.0, 13.028]
    paused.feed(line(23.0, radial=572.0))
    paused.end()  # what nothing contradicts any more
    assert paused.estimates[-1]["t"] == 23.0


def test_a_wild_stamp_makes_no_grid() -> None:
    """A measurement half an hour ahead does not let the grid run half an hour ahead."""
    both = Both(rate=100.0)
    both.feed(lines(1.0) + line(1800.0, "tracker", radial=570.0) + lines(1.0, begin=1.008))
    both.end()
    assert max(found["t"] for found in both.estimates) < 2.1
    assert any("taken back" in text for text in both.said)


BAD = [
    b"x" * 70_000,
    b'{"t": 1.0, "sensor": "tracker", "radial": ' + b"1" * 70_000 + b"}",
    b'{"t": 31536000.0, "sensor": "tracker", "radial": 570.0}',
    b'{"t": -31536000.0, "command": {"radial": 570.0}}',
    b'{"t": 1.0, "sensor": "tracker", "radial": 1e300}',
    b'{"t": 1.0, "command": {"radial": 1e300}}',
    b'{"t": 1e300, "command": {"radial": 570.0}}',
    b"[" * 50_000,
    b'{"t": 1.0, "sensor": "tracker", "radial": ' + b"[" * 30_000 + b"}",
    bytes(range(1, 10)) + bytes(range(11, 256)),
    b'{"t": 1.0, "sensor": "lidar", "radial": 570.0}',
    b'{"t": 1.0, "sensor": "tracker", "radal": 570.0}',
    b'{"t": 1.0, "command": {"radal": 570.0}}',
    b'{"t": 1.0, "command": {"t": 5.0, "command": {"radial": 1.0}}}',
    b"null",
    b'{"t_ns": 9223372036854775808, "sensor": "tracker", "radial": 570.0}',
    b'{"t_ns": 99999999999999999999999999, "sensor": "tracker", "radial": 570.0}',
]


def test_bad_lines_change_nothing_and_are_reported() -> None:
    """Between good lines, each kind of bad one: the estimates are those without them, and the log names each kind."""
    clean, both = Both(), Both()
    clean.feed(lines(1.0) + lines(1.0, begin=1.008))
    both.feed(lines(1.0) + b"\n".join(BAD) + b"\n" + lines(1.0, begin=1.008))
    assert both.estimates == clean.estimates
    log = "\n".join(both.said)
    for expected in ("longer than 64 KiB", "lidar", "radal", "days|s ahead", "not a finite position", "not JSON"):
        assert any(part in log for part in expected.split("|")), expected
    assert all(len(text) < 400 for text in both.said)
    health = both.live.health()
    refused = sum(count for word, count in health.commands.items() if word != "fused")
    refused += sum(count for one in health.sensors.values() for word, count in one.outcomes.items() if word != "fused")
    assert both.stream.bad + refused + health.unknown == len(BAD)


def test_random_bytes_change_no_bit() -> None:
    """Thousands of lines of noise between good ones: the estimates are those without them."""
    rng, clean, both = np.random.default_rng(12), Both(), Both()
    clean.feed(lines(0.28) + lines(0.28, begin=0.28))
    noise = rng.integers(1, 256, 250_000, dtype=np.uint8)
    noise[rng.random(len(noise)) < 0.02] = 10
    both.feed(lines(0.28) + noise.tobytes() + b"\n" + lines(0.28, begin=0.28))
    assert both.stream.bad > 4500
    assert both.written == clean.written


def test_the_log_is_short_and_plain_whatever_a_line_calls_itself() -> None:
    """Of bad lines the first, the tenth, and so on; names of 1 kB with colours and line breaks, thousands of them."""
    both = Both()
    both.feed(lines(0.1) + b"nonsense\n" * 10_000)
    assert both.stream.bad == 10_000 and len(both.said) == 5
    assert "10000 of this kind" in both.said[-1]
    for number in range(2000):
        name = f"\x1b[31m{number}\n" + "x" * 1000
        both.feed(line(0.1, name, radial=570.0) + line(0.1, "tracker", radial=570.0, **{name: 1.0}))
    assert len(both.said) < 25
    assert all(text.isprintable() and len(text) < 500 for text in both.said)


def test_a_long_pause_is_not_filled() -> None:
    """At 1 kHz a pause of an hour would be millions of lines at once: it is left out, and reported."""
    both = Both(rate=1000.0)
    both.feed(lines(1.0) + lines(1.0, begin=3500.0))
    both.end()
    assert 1900 < len(both.estimates) < 4000
    assert any("no estimates on the grid" in text for text in both.said)
    times = [found["t"] for found in both.estimates]
    assert times == sorted(times)


def test_a_line_without_end_is_not_kept() -> None:
    """A megabyte without a line end is one bad line, held nowhere."""
    both = Both()
    for _ in range(100):
        both.feed(b"x" * 10_000)
    assert len(both.lines._torn) <= 64 * 1024
    both.feed(b"\n" + lines(0.1))
    assert both.stream.bad == 1
    assert len(both.estimates) == 4


def test_a_replay_brings_rows_when_they_came() -> None:
    """Of a tracker that came 90 ms late the estimate at a command knows what had come, as in `fuse --as-live`."""
    rng, stamp, seen = np.random.default_rng(3), np.arange(300) * 0.028, np.arange(0.0, 8.0, 0.01)
    sensors = {"tracker": (seen, {"radial": 0.57 + 1e-3 * rng.random(len(seen))})}
    run = pf.Run.from_arrays(stamp, {"radial": 0.57 + 1e-4 * np.arange(300)}, sensors)
    at_once, (command, tracker) = pf.fuse(run, TRACKED, mode="as-live"), (run.command, run.sensors["tracker"])
    late = {"tracker": replace(tracker, arrival=tracker.stamp + 90_000_000)}
    run = replace(run, command=replace(command, arrival=command.stamp), sensors=late)
    offline, both = pf.fuse(run, TRACKED, mode="as-live"), Both()
    both.replay(run)
    position = (offline["radial"].position * 1e3).tolist()
    assert [found["radial"]["position_mm"] for found in both.estimates] == position
    assert position != (at_once["radial"].position * 1e3).tolist()


@pytest.mark.parametrize(("pause", "commands_first", "rate"), [(1.5, True, 100.0), (20.0, False, 33.3)])
def test_the_grid_goes_on_over_a_pause(pause: float, commands_first: bool, rate: float) -> None:
    """All pause for longer than the window: each point of `fuse --as-live --rate` is there, to the last bit."""
    rng = np.random.default_rng(0)
    first, again = (-0.003, 0.5) if commands_first else (1.2, 0.0)
    command = np.r_[0:2.8:0.028, pause + 2.8 + max(first, 0.0) : pause + 5.6 : 0.028]
    fast = np.r_[0.003:2.8:0.01, pause + 2.8 + again : pause + 5.6 : 0.01]
    slow = np.r_[0.11:2.8:0.05, pause + 2.85 + again : pause + 5.6 : 0.05]
    read = {name: (t, {"radial": 0.57 + 1e-4 * rng.random(len(t))}) for name, t in {"fast": fast, "slow": slow}.items()}
    run = pf.Run.from_arrays(command, {"radial": 0.57 + 1e-3 * rng.random(len(command))}, read)
    sensors = {"fast": pf.Sensor(sd=5e-5, latency=0.008), "slow": pf.Sensor(sd=5e-4, latency=0.1)}
    config = pf.FusionConfig(arm=TRACKED.arm, sensors=sensors)
    offline, both = pf.fuse(run, config, rate=rate, mode="as-live"), Both(config, rate, window=1.0)
    both.replay(run)
    assert len(both.estimates) >= len(offline.time)
    found = [(one["t"], one["radial"]["position_mm"]) for one in both.estimates[: len(offline.time)]]
    assert found == list(zip(offline.time.tolist(), (offline.axes["radial"].position * 1e3).tolist(), strict=True))


def test_a_replayed_row_of_one_axis_says_nothing_of_the_others() -> None:
    """Where axes have rows of their own, a row is no invalid measurement of the others."""
    stamp = np.array([10_000_000, 20_000_000])
    seen = Source(stamp, {"x": np.array([0.1, np.nan]), "y": np.array([np.nan, 0.2])}, "eye", apart=True)
    run = pf.Run("any", Source(stamp, {"x": np.zeros(2), "y": np.zeros(2)}, "commands"), {"eye": seen})
    axis = pf.AxisModel(plant=pf.FirstOrder(time_constant=0.05))
    arm = pf.ArmModel(name="any", update_period=0.01, delay=0.0, axes={"x": axis, "y": axis})
    config = pf.FusionConfig(arm=arm, sensors={"eye": pf.Sensor(sd=1e-3)})
    events = chain.from_iterable(replay(run, config, 1e6))
    assert [event.values for event in events if event.sensor] == [{"x": 0.1}, {"y": 0.2}]
